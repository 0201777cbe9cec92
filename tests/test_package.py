import subprocess
import sys

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
