import ast
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from datetime import date
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import versions
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

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


# -- what is declared --------------------------------------------------------------------------------

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
NEEDED = [Requirement(text) for text in PROJECT["dependencies"]]
EXTRA = [Requirement(text) for some in PROJECT["optional-dependencies"].values() for text in some]


def versions_in(name: str) -> dict[str, list[Version]]:
    """The versions of each package in a file of constraints: one, or one for each Python."""
    versions_of: dict[str, list[Version]] = {}
    for line in (ROOT / name).read_text("utf-8").splitlines():
        package, version = line.split(" ;")[0].split("==")
        versions_of.setdefault(package, []).append(Version(version.strip()))
    return versions_of


def test_the_lowest_versions_are_those_declared():
    """Every dependency and extra has a lowest version, which is the one that CI flies, and pins are in bounds."""
    lowest, pinned = versions_in("constraints-lowest.txt"), versions_in("constraints.txt")
    for need in NEEDED + EXTRA:
        name = canonicalize_name(need.name)
        (least,) = (bound.version for bound in need.specifier if bound.operator == ">=")
        assert lowest[name] == [Version(least)], need
        assert all(version in need.specifier for version in pinned[name]), need


@cache
def nodes() -> list[ast.AST]:
    """Every import, call and argument in the package."""
    kinds = ast.Import | ast.ImportFrom | ast.Call | ast.keyword
    trees = (ast.parse(path.read_text("utf-8")) for path in (ROOT / "src").rglob("*.py"))
    return [node for tree in trees for node in ast.walk(tree) if isinstance(node, kinds)]


def imported() -> set[str]:
    """Modules that the package imports, and those from which it imports names."""
    names = {x.name for node in nodes() if isinstance(node, ast.Import) for x in node.names}
    return names | {node.module or "" for node in nodes() if isinstance(node, ast.ImportFrom)}


def test_what_is_imported_is_declared():
    """A package that the code imports is a dependency or an extra, not what a dependency happens to bring."""
    names = {canonicalize_name(need.name) for need in NEEDED + EXTRA}
    others = {name.partition(".")[0] for name in imported()} - sys.stdlib_module_names
    assert {"llvmlite", "numba", "numpy"} <= others
    brought = packages_distributions()
    # A notebook, which alone calls the code that imports it, has IPython; Pydantic documents its core as part of it.
    others -= {"rigidfleet", "IPython", "pydantic_core"}
    for module in others & {*brought}:  # an extra that is not installed here has no module
        assert names & {canonicalize_name(name) for name in brought[module]}, module


def test_who_uses_internals_bounds_them():
    """A package whose internals the code uses has an upper bound in `pyproject.toml`."""
    internal = {name.partition(".")[0] for name in imported() if re.search(r"\.(core\b|_)", name)}
    assert "numba" in internal
    bounded = {
        need.name for need in NEEDED + EXTRA if any(x.operator == "<" for x in need.specifier)
    }
    assert internal - {"rigidfleet"} <= bounded


def test_pythons_that_are_declared():
    """The oldest Python that is declared is the oldest that CI looks for, and it looks for each that is named."""
    named = [words.rsplit(" ", 1)[1] for words in PROJECT["classifiers"] if "Python :: 3." in words]
    assert PROJECT["requires-python"] == f">={versions.PYTHONS[0]}"
    assert {*named} <= {*versions.PYTHONS}


def test_citation_is_of_this_version():
    """CITATION.cff has this version and its date: that of the changelog once it is released."""
    text = (ROOT / "CITATION.cff").read_text("utf-8")
    top = dict(re.findall(r"^([\w-]+): (.+)$", text, re.MULTILINE))
    assert top["version"] == rigidfleet.__version__
    day = date.fromisoformat(top["date-released"])
    heading = rf"^## \[{re.escape(rigidfleet.__version__)}\] - (.+)$"
    released = re.search(heading, (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)
    assert released is None or date.fromisoformat(released[1]) == day


def test_nothing_that_others_made_is_executed():
    """No module reads pickles, nor runs text as code, as SECURITY.md says."""
    assert not imported() & {"pickle", "marshal", "shelve", "cloudpickle"}
    for node in nodes():
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in {"eval", "exec", "compile"}
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            assert ast.unparse(node.value) == "False"


# -- the wheel ---------------------------------------------------------------------------------------


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
