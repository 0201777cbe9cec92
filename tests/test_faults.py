"""Faults from outside, met by the whole command: a clear error, nothing lost, no half of a file that looks whole."""

import os
import random
import resource
import signal
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rigidfleet.cli import app as cli
from rigidfleet.cli import codes, console
from rigidfleet.errors import ResultError
from rigidfleet.kernel.compiler import cache, jit
from rigidfleet.kernel.engine import native
from rigidfleet.result import Result

MISSION = """
schema_version = 1
name = "pair"
[agents]
mass = 1.0
position = [[0, 0, 0], [4, 0, 0]]
[formations.pair]
shape = "line"
size = 4.0
[[phases]]
kind = "establish"
formation = "pair"
until = 5.0
"""
HOME = Path("flights", "pair")
RUN = ("run", "pair.toml", "--no-figures", "--force")
#: A process that is killed for good when half of its result is written.
DYING = """if True:
    import builtins, io, os, signal, sys
    from rigidfleet.cli import app as cli
    whole = builtins.open
    def half(path, mode="r", *arguments, **more):
        if mode != "xb":
            return whole(path, mode, *arguments, **more)
        file = io.FileIO(path, "xb")
        write = file.write
        def some(data):
            write(data[: len(data) // 2])
            os.kill(os.getpid(), signal.SIGKILL)
        file.write = some
        return file
    builtins.open = half
    cli.main(sys.argv[1:])
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to stand in, with a mission."""
    monkeypatch.chdir(tmp_path)
    Path("pair.toml").write_text(MISSION, encoding="utf-8")
    console.console.cache_clear()
    return tmp_path


@pytest.fixture
def flown() -> bytes:
    """An earlier flight's result, byte by byte."""
    assert cli.main([*RUN, "--quiet"]) == codes.PASSED
    return (HOME / "pair.nc").read_bytes()


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one error that a command prints."""
    capsys.readouterr()
    assert cli.main(list(arguments)) == codes.BAD_INPUT
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert err.count("error: ") == 1
    return " ".join(err.split())


def files() -> set[str]:
    """Everything below the flight's folder."""
    return {p.name for p in HOME.rglob("*")}


@contextmanager
def nobody() -> Generator[None]:
    """Not to be root, to whom everything is permitted."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def test_a_binary_file(capsys: pytest.CaptureFixture[str]):
    """Noise in place of a mission or of a result is told from both."""
    noise = random.Random(1).randbytes(5000)
    Path("noise").write_bytes(noise)
    for command in ("run", "check"):
        assert "noise: is not UTF-8 text" in refused(capsys, command, "noise")
    assert "noise: is not a netCDF-4 file" in refused(capsys, "report", "noise")
    assert not HOME.exists()
    assert Path("noise").read_bytes() == noise


def test_a_directory(capsys: pytest.CaptureFixture[str], flown: bytes):
    """A folder in place of a file, or in the way of one, is named; what it holds stays."""
    assert "flights: is a folder" in refused(capsys, "run", "./flights")
    assert "flights: is a folder" in refused(capsys, "report", "flights")
    Path("taken", "pair.nc", "mine").mkdir(parents=True)
    assert "pair.nc" in refused(capsys, *RUN, "--out", "taken")
    assert [p.name for p in Path("taken").rglob("*")] == ["pair.nc", "mine"]
    assert (HOME / "pair.nc").read_bytes() == flown


def test_no_permission(
    capsys: pytest.CaptureFixture[str], folder: Path, monkeypatch: pytest.MonkeyPatch, flown: bytes
):
    """What may not be read or written is said before anything is flown, and stays as it is."""
    monkeypatch.setattr(
        sys.modules["rigidfleet.simulation.flight"],
        "simulate",
        lambda *_, **__: pytest.fail("it flew"),
    )
    folder.chmod(0o755)
    Path("secret.toml").write_text(MISSION, encoding="utf-8")
    for locked in (Path("secret.toml"), HOME / "pair.nc"):
        locked.chmod(0)
    HOME.chmod(0o555)
    try:
        with nobody():
            assert "secret.toml: cannot be read: permission denied" in refused(
                capsys, "run", "secret.toml"
            )
            assert "cannot be read: permission denied" in refused(
                capsys, "report", str(HOME / "pair.nc")
            )
            assert "pair" in refused(capsys, *RUN)
    finally:
        HOME.chmod(0o755)
    assert files() == {"pair.nc", "verdict.json"}
    (HOME / "pair.nc").chmod(0o644)
    assert (HOME / "pair.nc").read_bytes() == flown


def test_a_full_disk(capsys: pytest.CaptureFixture[str], flown: bytes):
    """A disk that fills up in the middle of the result: the earlier flight is still there, whole."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(flown) // 2, limit[1]))
    try:
        message = refused(capsys, *RUN, "--quiet")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert "pair.nc: cannot be written: File too large. Choose another place." in message
    assert files() == {"pair.nc", "verdict.json"}
    assert (HOME / "pair.nc").read_bytes() == flown


def test_kill_in_the_middle_of_a_write(flown: bytes):
    """kill -9 with half of a result written: the earlier one is whole, the half is no result, and one can go on."""
    done = subprocess.run([sys.executable, "-c", DYING, *RUN, "--quiet"], check=False, timeout=300)
    assert done.returncode == -signal.SIGKILL
    assert (HOME / "pair.nc").read_bytes() == flown
    (half,) = files() - {"pair.nc", "verdict.json"}
    assert half.startswith(".pair.nc.")
    assert half.endswith(".part")
    assert (HOME / half).stat().st_size == pytest.approx(len(flown) / 2, rel=0.2)
    with pytest.raises(ResultError, match="damaged"):
        Result.load(HOME / half)
    assert cli.main([*RUN, "--quiet"]) == codes.PASSED
    assert Result.load(HOME / "pair.nc").complete


def test_a_full_disk_while_the_kernel_is_kept():
    """A kernel that cannot be written to its cache flies all the same; a warning names the folder and the reason."""
    cache.warned.clear()
    double: Any = jit.jit(lambda x: 2.0 * x)
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (16, limit[1]))
    try:
        with pytest.warns(
            RuntimeWarning, match=r"cannot be cached in /.*kernel-\w+.*: File too large"
        ):
            assert double(2.0) == 4.0
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert double.stats.cache_path == str(native.cache_directory())


def test_a_full_disk_while_machine_code_is_kept(tmp_path, monkeypatch):
    """Nothing is left of machine code that could not be written, but a warning."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    cache.warned.clear()
    file = native._cache_file("flight")
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (16, limit[1]))
    try:
        with pytest.warns(RuntimeWarning, match="File too large"):
            native._cache_code([b"machine code"], "flight")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert not any(file.parent.iterdir())
