"""The cache of compiled code: what is run is what this user wrote."""

import os
import pickle
import shutil
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import pytest

from rigidfleet.kernel.compiler import cache, jit
from rigidfleet.kernel.compiler.cache import cache_directory
from rigidfleet.kernel.engine import native, objects
from rigidfleet.kernel.engine.native import has_machine_code

PLANTED, OWN = 666, 1
SOMEONE = 12345
ROOT = os.geteuid() == 0
COMMAND = Path(sys.executable).with_name("rigidfleet")
needs_root = pytest.mark.skipif(not ROOT, reason="only root can give files to others")


def code(answer: int) -> bytes:
    """Machine code with the kernel's two entries, which return a number."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    text = "define i64 @{}(i64, i64, i64, i64) {{ ret i64 {} }}"
    symbols = map(objects.symbol_name, objects.ENTRIES["flight"])
    module = llvm.parse_assembly("\n".join(text.format(name, answer) for name in symbols))
    return objects.target_machine().emit_object(module)


def answer() -> int:
    """Which machine code a new process would call."""
    found = native._load_library("flight")
    return found.integrate(0, 0, 0, 0)


def forget() -> None:
    """Let the next warning be the first."""
    cache.warned.clear()


@pytest.fixture
def base(tmp_path, monkeypatch) -> Iterator[Path]:
    """A base of the cache in which code is planted that would be run; what is compiled anew is `OWN`."""
    folder = tmp_path / "base"
    folder.mkdir(0o700)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))
    monkeypatch.setattr(native, "_compile_part", lambda _: [code(OWN)])
    monkeypatch.setattr(native, "_loaded", {})
    file = native._cache_file("flight")
    file.write_bytes(objects.pack_object_codes([code(PLANTED)]))
    file.chmod(0o600)
    forget()
    yield folder
    forget()


def place(base: Path) -> Path:
    """The kernel's folder in a base."""
    return base / "rigidfleet" / cache_directory().name


def planted(base: Path) -> Path:
    (file,) = base.glob("rigidfleet/kernel-*/flight-*.o")
    return file


def test_what_this_user_wrote_is_run(base):
    """Machine code in folders that this user alone can write is loaded, and nothing is compiled."""
    assert has_machine_code()
    assert answer() == PLANTED


@pytest.mark.parametrize("which", ["outer", "inner"])
@pytest.mark.parametrize("right", [0o777, 0o770, 0o1777])
def test_a_folder_that_others_can_write(which, right, base):
    """Machine code is not run from a folder that others can write, or one in such a folder; a warning says which,
    and how to keep what was compiled."""
    folder = {"outer": base / "rigidfleet", "inner": place(base)}[which]
    folder.chmod(right)
    assert not has_machine_code()
    with pytest.warns(RuntimeWarning) as warned:
        assert answer() == OWN
    (only,) = warned
    text = str(only.message)
    assert f"others can write to {folder}; forbid it with `chmod go-w {folder}`" in text
    assert "compiles again what rigidfleet was not installed with. Set NUMBA_CACHE_DIR" in text
    folder.chmod(0o700)
    assert answer() == PLANTED


@needs_root
@pytest.mark.parametrize("which", ["outer", "inner", "file"])
def test_what_belongs_to_others(which, base):
    """Machine code that belongs to another user, or lies in their folder, is not run."""
    chosen = {"outer": base / "rigidfleet", "inner": place(base), "file": planted(base)}[which]
    os.chown(chosen, SOMEONE, -1)
    assert not has_machine_code()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        assert answer() == OWN
    if which == "file":  # in a folder of one's own it is replaced
        assert not warned
        assert answer() == OWN
        assert planted(base).stat().st_uid == os.geteuid()
    else:
        assert f"{chosen} belongs to another user" in str(warned[0].message)


def test_a_file_that_others_can_write(base):
    """Machine code that others could have written is compiled again, and kept as one's own."""
    planted(base).chmod(0o666)
    assert answer() == OWN
    assert planted(base).stat().st_mode & 0o777 == 0o600
    assert answer() == OWN


@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_what_is_no_file(kind, base, tmp_path):
    """A link, a pipe or a folder in place of the machine code is neither followed nor waited for."""
    file = planted(base)
    file.rename(tmp_path / "elsewhere")
    if kind == "link":
        file.symlink_to(tmp_path / "elsewhere")
    elif kind == "pipe":
        os.mkfifo(file)
    else:
        file.mkdir()
    assert not has_machine_code()
    with pytest.warns(RuntimeWarning) if kind == "folder" else warnings.catch_warnings():
        assert answer() == OWN


def test_a_cache_reached_by_a_link(base, tmp_path, monkeypatch):
    """A link may lead to the base; but one in place of the cache is not followed, whoever may have made it."""
    (tmp_path / "one").symlink_to(base)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "one"))
    assert answer() == PLANTED
    (tmp_path / "two").mkdir()
    (tmp_path / "two" / "rigidfleet").symlink_to(base / "rigidfleet")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "two"))
    with pytest.warns(RuntimeWarning, match="two/rigidfleet is a link"):
        assert answer() == OWN


def test_modes_and_owners_that_mean_nothing(base, monkeypatch):
    """Where there are no owners, as on Windows, every mode reads 0o777 or 0o666, and the cache is used all the same."""
    place(base).chmod(0o777)
    planted(base).chmod(0o666)
    monkeypatch.delattr(os, "geteuid")
    assert answer() == PLANTED


@pytest.mark.parametrize("home", ["/dev/null", "", "unknown"])
def test_no_home(home, base, tmp_path, monkeypatch):
    """Without a home folder nothing is read from the temporary folder, where anyone may plant; one warning says so."""
    if home == "":  # on a machine whose root folder this user cannot write
        monkeypatch.setattr(Path, "mkdir", refused)
    monkeypatch.setenv("TMPDIR", str(base))
    monkeypatch.setattr(tempfile, "tempdir", None)
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    if home == "unknown":
        monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    else:
        monkeypatch.setenv("HOME", home)
    why = {
        "/dev/null": "Not a directory",
        "": "Permission denied",
        "unknown": "there is no home",
    }[home]
    with pytest.warns(RuntimeWarning, match=why):
        assert answer() == OWN
    assert jit.jit(lambda x: x + 1.0)(1.0) == 2.0  # and no second warning


def refused(*_: object, **__: object) -> None:
    raise PermissionError(13, "Permission denied")


def test_a_relative_path(base, monkeypatch):
    """A cache that is named relative to the current folder is none: whoever made that folder would have filled it."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", base.name)
    monkeypatch.chdir(base.parent)
    with pytest.warns(RuntimeWarning, match="the path is not absolute"):
        assert answer() == OWN


def test_what_is_made_is_private(tmp_path, monkeypatch):
    """Folders and files of the cache are this user's alone, though whatever else they make is everybody's."""
    base = tmp_path / "a" / "b"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(base))
    monkeypatch.setattr(native, "_compile_part", lambda _: [code(OWN)])
    before = os.umask(0)
    try:
        assert answer() == OWN
        assert jit.jit(lambda x: 2.0 * x)(1.0) == 2.0
    finally:
        os.umask(before)
    made = list(base.rglob("*"))
    assert {path.suffix for path in made if path.is_file()} >= {".o", ".nbi", ".nbc"}
    assert all(path.stat().st_mode & 0o077 == 0 for path in [base, *made])


def test_writers_at_the_same_time(base):
    """However many write the machine code at the same time, who reads it finds one of them whole."""
    ours = [[bytes([k]) * 200_000] for k in range(4)]
    native._cache_code(ours[0], "flight")
    writers = [
        threading.Thread(
            target=lambda k=k: [native._cache_code(ours[k], "flight") for _ in range(50)]
        )
        for k in range(4)
    ]
    for writer in writers:
        writer.start()
    while any(writer.is_alive() for writer in writers):
        assert native._read_cached_code("flight") in ours
    assert [file.name for file in place(base).iterdir()] == [planted(base).name]


# -- Numba's pickles ---------------------------------------------------------------------------------


class Hostile:
    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.write_text, (self.mark, "executed")


def double(x):
    return 2.0 * x


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("which", ["folder", "file", "owner"])
def test_planted_pickles(suffix, which, tmp_path, monkeypatch):
    """What Numba keeps is not unpickled where others could have written it, nor what belongs to them."""
    if which == "owner" and not ROOT:
        pytest.skip("only root can give files to others")
    base, mark = tmp_path / "base", tmp_path / "mark"
    base.mkdir(0o700)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(base))
    monkeypatch.setattr(jit, "_CACHE", cache_directory(), raising=False)
    assert jit.jit(double)(1.0) == 2.0
    (file,) = base.rglob("*double*" + suffix)
    file.write_bytes(pickle.dumps(Hostile(mark)))
    with suppress(Exception):  # a pickle of one's own is read
        jit.jit(double)(1.0)
    assert mark.exists()
    mark.unlink()
    forget()
    file.write_bytes(pickle.dumps(Hostile(mark)))
    if which == "owner":
        os.chown(file, SOMEONE, -1)
    else:
        (base / "rigidfleet" if which == "folder" else file).chmod(0o777)
    with pytest.warns(RuntimeWarning) if which == "folder" else warnings.catch_warnings():
        assert jit.jit(double)(1.0) == 2.0
    assert not mark.exists()


# -- processes that are started ----------------------------------------------------------------------

#: Names that a process looks for as it starts, as it starts another, and as it compiles.
NAMES = (
    "copy",
    "numba",
    "pickle",
    "multiprocessing",
    "selectors",
    "random",
    "sitecustomize",
    "usercustomize",
)


@pytest.fixture
def hostile(tmp_path) -> Path:
    """A folder with modules of well-known names, which leave a mark and end the process."""
    folder = tmp_path / "hostile"
    folder.mkdir()
    for name in NAMES:
        text = f"import os\nopen({str(folder / 'mark')!r}, 'a').write({name!r})\nos._exit(3)\n"
        (folder / f"{name}.py").write_text(text)
    return folder


def run(*command: object, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    env = os.environ | environment
    return subprocess.run(
        [*map(str, command)], cwd=cwd, env=env, capture_output=True, text=True, check=False
    )


@pytest.mark.long
def test_compiling_in_a_hostile_folder(hostile, tmp_path):
    """While a library is compiled no module of the current folder is run, and none of its settings read."""
    native.library()
    cache = tmp_path / "cache"
    kept = cache / "rigidfleet" / cache_directory().name
    kept.mkdir(parents=True)
    shutil.copy2(native._cache_file("flight"), kept)  # a smaller library is left to compile
    (hostile / ".numba_config.yaml").write_text("disable_jit: 1\n")
    asked = [COMMAND, "run", "bridge-inspection", "--no-figures", "--out", tmp_path / "out"]
    done = run(*asked, cwd=hostile, NUMBA_CACHE_DIR=str(cache))
    assert done.returncode == 0, done.stderr
    assert not (hostile / "mark").exists()
    assert len([*cache.rglob("solids-*.o")]) == 1


IMPORTS = (
    "import sys; sys.path[:] = sys.argv[1:]; import copy, numba, rigidfleet, extra; print(sys.path)"
)


@pytest.mark.parametrize("way", ["added", "relative", "PYTHONPATH"])
def test_a_build_process_imports_what_its_parent_does(way, hostile, tmp_path, monkeypatch):
    """A process that compiles finds what its parent finds, by absolute paths, and nothing in the current folder."""
    (tmp_path / "libraries").mkdir()
    (tmp_path / "libraries" / "extra.py").touch()
    monkeypatch.chdir(hostile)
    given = "../libraries" if way == "relative" else str(tmp_path / "libraries")
    monkeypatch.setattr(sys, "path", ["", *sys.path, given])
    monkeypatch.setattr(objects, "_BUILD", IMPORTS)
    done = run(
        *objects.build_command(),
        cwd=hostile,
        **({"PYTHONPATH": given} if way == "PYTHONPATH" else {}),
    )
    assert done.returncode == 0, done.stderr
    assert not (hostile / "mark").exists()
    path = eval(done.stdout)
    assert all(map(os.path.isabs, path))
    assert str(hostile) not in path
    assert str(tmp_path / "libraries") in path


def test_a_build_process_heeds_its_parents_flags():
    """A Python that leaves out the user's packages and the environment starts one that does, too."""
    code = "from rigidfleet.kernel.engine import objects; print(objects.build_command()[1:-1])"
    done = subprocess.run(
        [sys.executable, "-sE", "-c", code], capture_output=True, text=True, check=True
    )
    assert {"-s", "-E", "-P"} <= set(eval(done.stdout))


WORKER = """
from rigidfleet.sweep import workers
if __name__ == "__main__":
    with workers.start_processes(1) as pool:
        print(pool.submit(abs, -3).result())
"""


def test_workers_in_a_hostile_folder(hostile, tmp_path):
    """Workers of a sweep, and what looks after them, run no module of the current folder as they start."""
    script = tmp_path / "script.py"
    script.write_text(WORKER)
    done = run(sys.executable, script, cwd=hostile)
    assert not (hostile / "mark").exists()
    assert done.stdout == "3\n", done.stderr


@pytest.mark.long
def test_one_warning_for_a_sweep(tmp_path):
    """A sweep on two processes whose kernel cannot be kept compiles it once, warns once, and passes."""
    base = tmp_path / "base"
    (base / "rigidfleet").mkdir(parents=True)
    (base / "rigidfleet").chmod(0o777)
    vary = ["--vary", "agents.position.*.* += normal(0, 0.1)", "--runs", "6000", "--workers", "2"]
    asked = [COMMAND, "sweep", "narrow-passage", *vary, "--no-figures", "--out", tmp_path / "out"]
    done = run(*asked, cwd=tmp_path, NUMBA_CACHE_DIR=str(base))
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("cannot be cached") == 1
    assert "2 workers" in done.stderr
    assert not [*(base / "rigidfleet").iterdir()]
