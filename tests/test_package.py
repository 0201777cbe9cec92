import subprocess
import sys
from importlib.util import find_spec

import pytest

import rigidfleet


def test_import_is_light():
    """`import rigidfleet` loads none of the packages that take long to load."""
    heavy = {"numba", "scipy", "matplotlib", "h5netcdf", "h5py", "pydantic", "xarray", "numpy"}
    code = f"import sys, rigidfleet; print(*sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_unknown_name():
    """A name that the package does not have is an AttributeError that gives the name."""
    with pytest.raises(AttributeError, match="no attribute 'fly_me'"):
        rigidfleet.fly_me  # noqa: B018


@pytest.mark.parametrize("name", sorted(set(rigidfleet.__all__) - {"__version__"}))
@pytest.mark.parametrize("first", ["import rigidfleet.{home}", "pass"])
def test_public_names(name, first):
    """A public name is the function or class, also where its module, of the same name, was imported first."""
    home = rigidfleet._HOME[name]
    if find_spec(f"rigidfleet.{home}") is None:
        pytest.skip(f"rigidfleet.{home} is not written yet")
    code = f"""
import rigidfleet
{first.format(home=home)}
from rigidfleet.{home} import {name} as expected
assert rigidfleet.{name} is expected, rigidfleet.{name}
assert callable(expected)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
