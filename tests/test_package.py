import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import rigidfleet

ROOT = Path(__file__).parents[1]


def test_import_is_light():
    """`import rigidfleet` loads none of the packages that take long to load."""
    heavy = {"numba", "scipy", "matplotlib", "h5netcdf", "h5py", "pydantic", "xarray", "numpy"}
    code = f"import sys, rigidfleet; print(*sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_unknown_name():
    """A name that the package does not have is an AttributeError that gives the name."""
    with pytest.raises(AttributeError, match="no attribute 'fly_me'"):
        rigidfleet.fly_me  # noqa: B018  # ty: ignore[missing-attribute]


@pytest.mark.parametrize("name", sorted(set(rigidfleet.__all__) - {"__version__"}))
@pytest.mark.parametrize("first", ["import rigidfleet.{home}", "pass"])
def test_public_names(name, first):
    """A public name is the function or class, also where its module, of the same name, was imported first."""
    home = rigidfleet._HOME[name]
    code = f"""
import rigidfleet
{first.format(home=home)}
from rigidfleet.{home} import {name} as expected
assert rigidfleet.{name} is expected, rigidfleet.{name}
assert callable(expected)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with the wheel and the sdist, built as `make package` does."""
    folder = tmp_path_factory.mktemp("dist")
    uv("build", "--build-constraints", "constraints.txt", "--out-dir", str(folder), ".")
    return folder


def uv(*words: str) -> None:
    """Run the uv that set-up has brought, in the repository."""
    command = [str(Path(sys.executable).with_name("uv")), words[0], "--quiet", *words[1:]]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_wheel_and_sdist_are_whole(built):
    """The wheel holds every file of the package, and nothing else; the sdist what tests and documents need."""
    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    assert rigidfleet.__version__ in wheel.name
    assert rigidfleet.__version__ in sdist.name
    package = ROOT / "src" / "rigidfleet"
    files = {p.relative_to(package.parent).as_posix() for p in package.rglob("*") if p.is_file()}
    files = {name for name in files if "__pycache__" not in name}
    held = set(zipfile.ZipFile(wheel).namelist())
    assert {name for name in held if ".dist-info/" not in name} == files
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for name in ("README.md", "LICENSE", "pyproject.toml", "tests/conftest.py", "docs/index.md"):
        assert name in names


@pytest.mark.long
def test_wheel_flies_on_its_own(built, tmp_path):
    """Installed under the constraints into a bare environment, the wheel flies, far from the repository."""
    (wheel,) = built.glob("*.whl")
    home = tmp_path / "bare"
    python = home / ("Scripts" if os.name == "nt" else "bin") / "python"
    uv("venv", "--python", sys.executable, str(home))
    where = ("--python", str(python), "--constraints", "constraints.txt")
    uv("pip", "install", *where, str(wheel))
    # Nothing of this environment: not its variables, its home, its compiled code, nor its folder.
    bare = {"PATH": os.defpath, "HOME": str(tmp_path), "LANG": "C.UTF-8"}

    def run(program: str, *words: str) -> str:
        command = [str(python.with_name(program)), *words]
        done = subprocess.run(
            command, cwd=tmp_path, env=bare, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    at = run("python", "-c", "import rigidfleet; print(rigidfleet.__file__)")
    assert Path(at.strip()).is_relative_to(home)
    out = run("rigidfleet", "run", "narrow-passage", "--replay", "--format", "png")
    assert "Passed" in out
    flown = tmp_path / "flights" / "narrow-passage"
    assert (flown / "narrow-passage.nc").stat().st_size > 100_000
    assert "<canvas" in (flown / "replay.html").read_text(encoding="utf-8")
    assert (flown / "figures" / "trajectory.png").exists()
    run("rigidfleet", "report", str(flown / "narrow-passage.nc"))
    assert (flown / "report.html").exists()
    run("python", "-c", "import rigidfleet as rf; [getattr(rf, name) for name in rf.__all__]")
