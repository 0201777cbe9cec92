"""Machine code that came with the package: which is loaded, and which is not."""

import os
import platform
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from test_cache import OWN, PLANTED, answer, base  # noqa: F401 -- fixtures

from rigidfleet.cli import app as cli
from rigidfleet.cli import codes
from rigidfleet.errors import RigidfleetError
from rigidfleet.kernel.compiler import cache, levels
from rigidfleet.kernel.engine import native, objects

LOADER = Path("/lib64/ld-linux-x86-64.so.2")
SHIPPED = 333
linux = pytest.mark.skipif(
    (sys.platform, platform.machine()) != ("linux", "x86_64") or not shutil.which("cc"),
    reason="machine code is shipped for Linux on x86-64, and linked by cc",
)


@pytest.mark.skipif(not LOADER.exists(), reason="asks glibc's loader")
def test_levels_are_those_of_the_loader():
    """The levels that this machine runs are those for which the system's own loader would search its libraries."""
    listed = subprocess.run([LOADER, "--help"], capture_output=True, text=True, check=False).stdout
    runs = set(re.findall(r"(x86-64-v\d) \(supported", listed))
    if "x86-64-v" not in listed:
        pytest.skip("a loader that does not tell")
    assert set(levels.machine_instruction_levels()) == runs & set(levels.LEVELS)


@pytest.fixture
def machine(monkeypatch):
    """A machine of the lower level, in whose environment no level is fixed."""
    monkeypatch.delenv(levels.KEY, raising=False)
    monkeypatch.setattr(levels, "machine_instruction_levels", lambda: ("x86-64-v3",))


def test_the_highest_level_is_taken(monkeypatch, machine):
    """Without the key the level is the machine's highest, and where there are no levels, this very machine."""
    assert levels.runnable_instruction_level() == "x86-64-v3"
    monkeypatch.setattr(levels, "machine_instruction_levels", lambda: levels.LEVELS)
    assert levels.runnable_instruction_level() == "x86-64-v4"
    monkeypatch.setattr(levels, "machine_instruction_levels", tuple)
    assert levels.runnable_instruction_level() == levels.HOST


@pytest.mark.parametrize("fixed", ["x86-64-v4", "x86-64-v9", "v3"])
def test_a_level_that_cannot_be_run(fixed, monkeypatch, machine, capsys, tmp_path):
    """A level beyond the machine, or none at all, is refused in one sentence with those that can be chosen."""
    monkeypatch.setenv(levels.KEY, fixed)
    monkeypatch.setattr(native, "_loaded", {})
    monkeypatch.chdir(tmp_path)
    assert cli.main(["run", "two-agents", "--no-figures"]) == codes.BAD_INPUT
    said = capsys.readouterr().err
    assert f"RIGIDFLEET_LEVEL: this machine cannot run '{fixed}'. Choose x86-64-v3," in said
    assert "Traceback" not in said


@pytest.fixture
def shipped(base, tmp_path, monkeypatch):  # noqa: F811
    """A folder of the package's own machine code, with a shared object whose functions return a number."""
    monkeypatch.setattr(
        objects, "shipped_object_path", lambda of, digest: tmp_path / f"{of}-{digest}.so"
    )
    monkeypatch.setattr(native, "shipped_object_path", objects.shipped_object_path)
    source = tmp_path / "code.c"
    names = map(objects.symbol_name, objects.ENTRIES["flight"])
    source.write_text("\n".join(f"long {x}(long a) {{ return {SHIPPED}; }}" for x in names))
    file = objects.shipped_object_path(levels.target_instruction_level(), cache.sources_digest())
    subprocess.run(["cc", "-shared", "-fPIC", "-o", file, source], check=True)
    return file


@linux
def test_shipped_code_is_loaded(shipped, monkeypatch):
    """Code that came with the package, made of its sources, goes before the cache, and nothing is compiled."""
    monkeypatch.delattr(native, "_compile_part")
    assert native.has_machine_code()
    assert answer() == SHIPPED


@linux
def test_a_damaged_object_is_named(shipped):
    """A file of the package that is no shared object is named, with the remedy."""
    shipped.write_bytes(b"")
    with pytest.raises(
        RigidfleetError, match=rf"{shipped.name}: file too short\. Install rigidfleet again\."
    ):
        answer()


@linux
def test_code_of_other_sources_is_not_loaded(shipped, base):  # noqa: F811
    """Where the installed sources are not those that the code was made of, they are compiled, with a warning; what was
    compiled of them is then taken from the cache, without one."""
    shipped.rename(shipped.with_name(f"{levels.target_instruction_level()}-0123456789abcdef.so"))
    (file,) = base.rglob("flight-*.o")
    file.unlink()
    assert not native.has_machine_code()
    with pytest.warns(RuntimeWarning, match="sources were changed since its machine code was made"):
        assert answer() == OWN
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert answer() == OWN


@linux
def test_code_of_another_level_is_not_loaded(shipped):
    """Code of a level that is neither fixed nor the machine's highest is left alone."""
    shipped.rename(objects.shipped_object_path("x86-64-v1", cache.sources_digest()))
    assert answer() == PLANTED


def test_the_digest_is_of_what_is_compiled(tmp_path, monkeypatch):
    """Any change in any source of the kernel changes the digest; nothing else does."""
    package = Path(cache.__file__).parents[2]
    for name in ("kernel", "solids"):
        shutil.copytree(package / name, tmp_path / name)
    monkeypatch.setattr(cache, "__file__", str(tmp_path / "kernel" / "compiler" / "cache.py"))
    digest = cache.sources_digest.__wrapped__
    before = digest()
    assert before == cache.sources_digest()
    (tmp_path / "kernel" / "note.txt").write_text("nothing")
    assert digest() == before
    for name in ("kernel/dopri5.py", "kernel/compiler/simd.py", "solids/distance.py"):
        with (tmp_path / name).open("a") as source:
            source.write("\n")
        assert digest() != before
        before = digest()


def test_the_compiler_serves_the_level(monkeypatch):
    """With the key Numba itself compiles for the level; without it for this machine."""
    code = "from rigidfleet.kernel.compiler import simd; import numba; print(numba.config.CPU_NAME, simd._ESTIMATES)"

    def of(**settings: str) -> list[str]:
        env = {k: v for k, v in os.environ.items() if k != levels.KEY} | settings
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
        return done.stdout.split()

    runs = levels.machine_instruction_levels()
    if not runs:
        pytest.skip("no levels here")
    assert of()[0] == "None"
    for name in runs:
        assert of(RIGIDFLEET_LEVEL=name) == [name, str(name == "x86-64-v4")]


#: Settings by which this machine seems to be of a level, to libraries that choose code by processor.
SEEMS = {
    "x86-64-v3": {"OPENBLAS_CORETYPE": "Zen", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_SKX"},
    "x86-64-v4": {"OPENBLAS_CORETYPE": "Cooperlake"},
}
#: Runs the command; then prints what follows from the code that OpenBLAS and NumPy have chosen.
CHOSEN = """
import sys
from rigidfleet.__main__ import main
sys.argv[1:] = ["missions"]
main()
import numpy as np
x = np.linspace(0.1, 3.0, 900)
print(np.linalg.inv(np.sin(x * x).reshape(30, 30)).tobytes().hex(), np.exp(x).tobytes().hex())
"""


def test_libraries_keep_to_a_fixed_level():
    """In the command OpenBLAS and NumPy take the code of a fixed level, whatever the processor seems to be."""

    def digits(**settings: str) -> str:
        env = {k: v for k, v in os.environ.items() if not k.startswith(("OPENBLAS", "NPY"))}
        command = [sys.executable, "-c", CHOSEN]
        done = subprocess.run(
            command, env=env | settings, capture_output=True, text=True, check=True
        )
        return done.stdout.splitlines()[-1]

    page = Path(__file__).parents[1].joinpath("docs", "install.md").read_text("utf-8")
    for name in levels.machine_instruction_levels():
        for key, value in levels.LIBRARY_SETTINGS.get(name, {}).items():
            assert f"{key}={value}" in page.replace('"', "")
        assert digits(RIGIDFLEET_LEVEL=name) == digits(RIGIDFLEET_LEVEL=name, **SEEMS[name])


def test_a_refused_level_is_an_error_from_python(monkeypatch, machine):
    """From Python a level that cannot be run is the package's own error."""
    monkeypatch.setenv(levels.KEY, "x86-64-v4")
    with pytest.raises(RigidfleetError, match="cannot run"):
        native.has_machine_code()
