import ast
import os
import platform
import re
import shutil
import sqlite3
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from contextlib import closing
from datetime import date
from functools import cache
from importlib import import_module
from importlib.metadata import packages_distributions
from pathlib import Path
from types import SimpleNamespace

import pytest
import versions
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version
from test_levels import SEEMS

import rigidfleet
from rigidfleet.kernel.compiler import levels

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


@pytest.mark.parametrize("first", ["import rigidfleet.{home}", "pass"])
def test_public_names(first):
    """A public name is the function or class, also where its module, of the same name, was imported first."""
    names = {
        name: rigidfleet._HOME[name] for name in sorted({*rigidfleet.__all__} - {"__version__"})
    }
    code = f"""
import importlib, sys
for name, home in {names}.items():
    for module in [x for x in sys.modules if x.partition(".")[0] == "rigidfleet"]:
        del sys.modules[module]  # as if this were a new process, but for packages of others
    import rigidfleet
    exec({first!r}.format(home=home))
    expected = getattr(importlib.import_module("rigidfleet." + home), name)
    assert getattr(rigidfleet, name) is expected, name
    assert callable(expected), name
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


def test_other_versions_fly_with_all_extras():
    """Each extra that is declared is installed with the other versions of packages and of Python that CI flies."""
    assert Requirement(f"rigidfleet{versions.EXTRAS}").extras == {*PROJECT["optional-dependencies"]}


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
    """No module reads pickles, nor runs text as code, as SECURITY.md says.

    But the compiler's own: it writes the entries of machine code from names of the kernel.
    """
    assert not imported() & {"pickle", "marshal", "shelve", "cloudpickle"}
    run = []
    for node in nodes():
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            run += [ast.unparse(node)] if node.func.id in {"eval", "exec", "compile"} else []
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            assert ast.unparse(node.value) == "False"
    assert [text.partition("(")[2][:20] for text in run] == ["f'def entry(x):\\n    "[:20]]


# -- the wheel ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with wheel and sdist: those of `make package` if they are of these sources, or built as it does."""
    if versions.is_package_of(ROOT, ROOT / "dist"):
        return ROOT / "dist"
    folder = tmp_path_factory.mktemp("dist")
    uv("build", "--build-constraints", "constraints.txt", "--out-dir", str(folder), ".")
    return folder


def test_a_package_of_other_sources_is_none(tmp_path):
    """A wheel is of these sources if its sdist has each file as it is now, and every file of the package."""
    root, folder = tmp_path / "root", tmp_path / "dist"
    (root / "src").mkdir(parents=True)
    folder.mkdir()
    (root / "src" / "a.py").write_text("a = 1\n")
    (root / "pyproject.toml").touch()
    with tarfile.open(folder / "p-1.tar.gz", "w:gz") as archive:
        for name in ("src/a.py", "pyproject.toml"):
            archive.add(root / name, f"p-1/{name}")
    assert not versions.is_package_of(root, folder)  # no wheel
    (folder / "p-1.whl").touch()
    assert versions.is_package_of(root, folder)
    (root / "src" / "b.py").touch()
    assert not versions.is_package_of(root, folder)
    (root / "src" / "b.py").unlink()
    (root / "src" / "a.py").write_text("a = 2\n")
    assert not versions.is_package_of(root, folder)
    (root / "src" / "a.py").write_text("a = 1\n")
    (root / "pyproject.toml").unlink()
    assert not versions.is_package_of(root, folder)


def uv(*words: str) -> None:
    """Run the uv that set-up has brought, in the repository."""
    command = [str(Path(sys.executable).with_name("uv")), words[0], "--quiet", *words[1:]]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_wheel_and_sdist_are_whole(built):
    """The wheel holds every file of the package and its machine code, and nothing else; the sdist what tests and
    documents need."""
    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    assert rigidfleet.__version__ in wheel.name
    assert rigidfleet.__version__ in sdist.name
    package = ROOT / "src" / "rigidfleet"
    files = {p.relative_to(package.parent).as_posix() for p in package.rglob("*") if p.is_file()}
    files = {name for name in files if "__pycache__" not in name}
    held = set(zipfile.ZipFile(wheel).namelist())
    package_files = {name for name in held if ".dist-info/" not in name}
    assert {name for name in package_files if not name.endswith(".so")} == files
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for name in ("README.md", "LICENSE", "pyproject.toml", "tests/conftest.py", "docs/index.md"):
        assert name in names


linux = pytest.mark.skipif(
    (sys.platform, platform.machine()) != ("linux", "x86_64") or not shutil.which("cc"),
    reason="wheels have machine code on Linux on x86-64, where cc links it",
)


@pytest.mark.parametrize("lacking", ["cc", "nm"])
def test_what_links_is_looked_for_first(lacking, monkeypatch):
    """Where a program is lacking that makes shared objects, set-up names it, and compiles nothing."""
    interface = SimpleNamespace(BuildHookInterface=object)  # hatchling's, which is not installed
    monkeypatch.setitem(sys.modules, "hatchling.builders.hooks.plugin.interface", interface)
    monkeypatch.syspath_prepend(ROOT)
    build = import_module("hatch_build")
    monkeypatch.setattr(build, "HERE", True)
    monkeypatch.setattr(build.shutil, "which", lambda name: None if name == lacking else name)
    hook, said, made = build.MachineCode(), [], {}
    hook.app = SimpleNamespace(display_warning=said.append)  # without what announces compiling
    hook.initialize("standard", made)
    assert said == [f"The wheel has no machine code: no {lacking}"]
    assert not made


@linux
@pytest.mark.long
def test_machine_code_needs_little(built, tmp_path):
    """The wheel fits every Python on every Linux that its tag promises: no function outside is newer than glibc 2.17,
    and none is Python's, Numba's or a C compiler's. The licence of what Numba compiled into it is there."""
    (wheel,) = built.glob("*.whl")
    assert wheel.name.endswith("-py3-none-manylinux_2_17_x86_64.whl")
    assert wheel.stat().st_size < 15e6
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    code = sorted(tmp_path.rglob("*.so"))
    assert [file.name.rsplit("-", 1)[0] for file in code] == ["x86-64-v3", "x86-64-v4"]
    for file in code:
        listed = subprocess.run(
            ["objdump", "-pT", file], capture_output=True, text=True, check=True
        )
        versions = {
            tuple(map(int, x.split("."))) for x in re.findall(r"GLIBC_([\d.]+)", listed.stdout)
        }
        assert versions
        assert max(versions) <= (2, 17)
        assert set(re.findall(r"NEEDED\s+(\S+)", listed.stdout)) <= {"libm.so.6", "libc.so.6"}
        outside = re.findall(r"UND.* (\w+)$", listed.stdout, re.MULTILINE)
        assert not [name for name in outside if re.match("_|Py|NRT|numba", name)]
    (licence,) = tmp_path.rglob("licenses/numba.txt")
    assert "Redistribution and use in source and binary forms" in licence.read_text()


@pytest.fixture(scope="module")
def bare(built, tmp_path_factory):
    """The environment of the wheel alone, installed under the constraints, as a function that runs its programs.

    Nothing of this environment is seen: not its variables, its home, its compiled code, nor its folder.
    """
    (wheel,) = built.glob("*.whl")
    folder = tmp_path_factory.mktemp("home")
    home = folder / "bare"
    python = home / ("Scripts" if os.name == "nt" else "bin") / "python"
    uv("venv", "--python", sys.executable, str(home))
    where = ("--python", str(python), "--constraints", "constraints.txt")
    uv("pip", "install", *where, str(wheel))

    def run(program: str, *words: str, **settings: str) -> str:
        command = [str(python.with_name(program)), *words]
        seen = {"PATH": os.defpath, "HOME": str(folder), "LANG": "C.UTF-8"} | settings
        done = subprocess.run(
            command, cwd=folder, env=seen, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return folder, run


#: Flies missions by the command without figures; what it needed of the compiler is printed.
WITHOUT_COMPILER = """
import sys
from rigidfleet.cli.app import main
for name in sys.argv[1:]:
    assert main(["run", name, "--no-figures", "--quiet", "--force"]) == 0, name
print(sorted({"numba", "llvmlite"} & set(sys.modules)))
"""


@linux
@pytest.mark.long
def test_a_flight_from_the_wheel_needs_no_compiler(bare):
    """Points, quadrotors, obstacles that move, avoidance and a large formation fly from the wheel without the
    compiler, and nothing is compiled into a cache."""
    folder, run = bare
    names = ("narrow-passage", "passage-quadrotors", "moving-obstacles", "crazyflies", "show-1000")
    assert run("python", "-c", WITHOUT_COMPILER, *names).splitlines()[-1] == "[]"
    assert not (folder / ".cache").exists()


@linux
@pytest.mark.long
def test_workers_fly_the_same_bits_on_a_level(bare):
    """On one level of x86-64 the rows of a sweep depend neither on the number of workers nor on the processor."""
    folder, run = bare
    vary = ("--vary", "disturbances.mass_error = normal(0, 0.02)", "--runs", "6", "--no-figures")
    flown: dict[str, list[list[tuple[object, ...]]]] = {}
    for name in levels.machine_instruction_levels():
        flown[name] = []
        for workers, seems in ("1", {}), ("2", SEEMS[name]):
            out = folder / f"{name}-{workers}"
            words = ("passage-quadrotors", *vary, "--workers", workers, "--out", str(out))
            run("rigidfleet", "sweep", *words, RIGIDFLEET_LEVEL=name, **seems)
            with closing(sqlite3.connect(out / "sweep.db")) as store:
                rows = store.execute("SELECT * FROM runs ORDER BY run")
                wall = [column[0] for column in rows.description].index("wall")
                flown[name].append([(*row[:wall], *row[wall + 1 :]) for row in rows])
        one, two = flown[name]
        assert one == two
        assert len(one) == 6
    assert len(flown) > 0


@linux
@pytest.mark.long
def test_flights_have_the_same_bits_on_a_level(bare):
    """On one level of x86-64 a flight by the command is the same bit for bit, whatever the processor seems to be."""
    folder, run = bare
    for name in levels.machine_instruction_levels():
        for mission in ("narrow-passage", "passage-quadrotors", "cube-passage", "moving-obstacles"):
            flown = []
            for seems in {}, SEEMS[name]:
                out = folder / f"{name}-{mission}-{len(seems)}"
                words = ("run", mission, "--no-figures", "--out", str(out))
                run("rigidfleet", *words, RIGIDFLEET_LEVEL=name, **seems)
                result = rigidfleet.Result.load(out / f"{mission}.nc")
                flown.append([x.tobytes() for x in (result.time, result.position, result.velocity)])
            assert flown[0] == flown[1], (name, mission)


@pytest.mark.long
def test_wheel_flies_on_its_own(bare):
    """Installed under the constraints into a bare environment, the wheel flies, far from the repository."""
    folder, run = bare
    at = run("python", "-c", "import rigidfleet; print(rigidfleet.__file__)")
    assert Path(at.strip()).is_relative_to(folder / "bare")
    out = run("rigidfleet", "run", "narrow-passage", "--replay", "--format", "png", "--force")
    assert "Passed" in out
    flown = folder / "flights" / "narrow-passage"
    assert (flown / "narrow-passage.nc").stat().st_size > 100_000
    assert "<canvas" in (flown / "replay.html").read_text(encoding="utf-8")
    assert (flown / "figures" / "trajectory.png").exists()
    run("rigidfleet", "report", str(flown / "narrow-passage.nc"))
    assert (flown / "report.html").exists()
    run("python", "-c", "import rigidfleet as rf; [getattr(rf, name) for name in rf.__all__]")
