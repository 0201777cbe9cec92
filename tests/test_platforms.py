"""What other platforms lack is taken away here: from Python, from the package in it, and from every process it starts.

Nothing else runs there: see the README for what was never run.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from rigidfleet.cli import outputs
from rigidfleet.errors import ResultError

#: Run by every Python as it starts. What Windows does not have is gone, and modes are those that it reports. A file
#: that is open is neither replaced nor removed, text is not UTF-8 unless one says so, and nothing is below /proc.
ELSEWHERE = """
import os, signal, sys, warnings

for name in "fcntl grp pwd resource termios".split():
    sys.modules[name] = None
real = {name: getattr(os, name) for name in "listdir mkdir open readlink replace rename remove".split()}

def hide(path):
    if isinstance(path, (str, os.PathLike)) and os.fspath(path).startswith("/proc"):
        raise FileNotFoundError(2, "there is no such path", path)

def opening(path, flags, mode=0o777, **keys):
    hide(path)
    return real["open"](path, flags, 0o666, **keys)

def listing(path="."):
    hide(path)
    return real["listdir"](path)

def opened():
    for number in real["listdir"]("/proc/self/fd"):
        try:
            yield real["readlink"]("/proc/self/fd/" + number)
        except OSError:
            pass

def unless_open(change):
    def changed(*paths, **keys):
        for path in paths:
            if os.path.realpath(path) in opened():
                raise PermissionError(13, "a process has opened it", os.fspath(path))
        return change(*paths, **keys)
    return changed

os.umask(0)
os.open, os.listdir, os.chmod = opening, listing, lambda *_, **__: None
os.mkdir = lambda path, mode=0o777, **keys: real["mkdir"](path, 0o777, **keys)
os.replace, os.rename = unless_open(real["replace"]), unless_open(real["rename"])
os.remove = os.unlink = unless_open(real["remove"])
for name in (
    "fork forkpty geteuid getuid getegid getgid getgroups sched_getaffinity chown lchown fchown mkfifo getxattr "
    "listxattr setxattr nice killpg getpgid setsid register_at_fork getloadavg O_NOFOLLOW O_NONBLOCK"
).split():
    if hasattr(os, name):
        delattr(os, name)
for name in "pthread_sigmask SIGKILL SIGHUP SIGALRM SIGUSR1 alarm setitimer".split():
    delattr(signal, name)
warnings.filterwarnings("error", category=EncodingWarning, module="rigidfleet")
"""
#: A sweep by two processes, a store that is begun again, and files that replace those they were read from.
SCRIPT = """
import multiprocessing
import rigidfleet as rf
from rigidfleet.sweep import Sweep, fly, runner

if __name__ == "__main__":
    runner._WORTH = 0.0
    sweep = Sweep.of("two-agents", ["agents.mass.* *= uniform(0.9, 1.1)"], runs=80)
    most = []
    rows = fly(sweep, "two", workers=2, progress=lambda p: most.append(len(multiprocessing.active_children())))
    alone = fly(sweep, "one", workers=1)
    assert max(most) == 2
    assert rows.complete and rows.passed.all() and {*rows.metrics} == {*alone.metrics}
    for name, values in rows.metrics.items():
        assert values.tobytes() == alone.metrics[name].tobytes(), name
    fly(sweep, "two", workers=1, replace=True)
    result = rf.Result.load("out/two-agents.nc")
    result.save("out/two-agents.nc")
    rf.export(rf.Result.load("out/two-agents.nc"), "ways", format="polynomial", flown=True)
    rf.export(rf.Result.load("out/two-agents.nc"), "ways", format="polynomial", flown=True)
"""


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory) -> Path:
    """An empty home, with what every Python there runs as it starts."""
    home = tmp_path_factory.mktemp("elsewhere")
    (home / "site").mkdir()
    (home / "site" / "sitecustomize.py").write_text(ELSEWHERE, encoding="utf-8")
    (home / "script.py").write_text(SCRIPT, encoding="utf-8")
    return home


def run(home: Path, *words: str) -> str:
    """What a Python without the rest of the platform prints: output and errors."""
    left = {"PATH": os.environ["PATH"], "HOME": str(home), "MPLBACKEND": "Agg"}
    asks = {"PYTHONPATH": str(home / "site"), "PYTHONWARNDEFAULTENCODING": "1", "PYTHONUTF8": "0"}
    done = subprocess.run(
        [sys.executable, *words], cwd=home, env=left | asks | {"PYTHONIOENCODING": "cp1252"},
        capture_output=True, check=False,
    )  # fmt: skip
    text = (done.stdout + done.stderr).decode("cp1252")
    assert done.returncode == 0, text
    return text


@pytest.mark.long
def test_flights_without_the_rest_of_the_platform(elsewhere):
    """Without owners, modes, forks and /proc the first flight compiles, the second does not, figures are drawn, and
    two processes fly the rows of one, bit for bit."""
    flight = ("-m", "rigidfleet", "run", "two-agents", "--out", "out")
    assert "Compiling" in run(elsewhere, *flight, "--no-figures")
    second = run(elsewhere, *flight, "--force", "--replay", "--figures", "all", "--format", "png")
    assert "Passed" in second
    assert not re.search("Compiling|cannot be cached", second)
    assert (elsewhere / "out" / "figures" / "trajectory.png").stat().st_size > 10_000
    kept = [path for path in (elsewhere / ".cache").rglob("*") if path.is_file()]
    assert kept
    assert {path.stat().st_mode & 0o777 for path in kept} == {0o666}  # or this would prove nothing
    run(elsewhere, "-m", "rigidfleet", "report", "out/two-agents.nc", "--force")
    run(elsewhere, "script.py")


def test_what_is_taken_away_is_gone(elsewhere):
    """The processes of the test above have no owners, forks, and no way to replace a file that is open."""
    code = """
import os, subprocess, sys, tempfile
assert not {"fork", "geteuid", "sched_getaffinity"} & set(dir(os))
for name in "grp", "pwd", "fcntl":
    try:
        __import__(name)
    except ImportError:
        continue
    raise SystemExit(name)
with open("held", "wb"), open("new", "wb") as new:
    new.close()
    try:
        os.replace("new", "held")
    except PermissionError:
        print("kept")
"""
    assert run(elsewhere, "-c", code) == "kept\n"


def test_a_stream_that_is_closed_takes_every_letter(elsewhere):
    """A program without standard output, as behind a window, may print any letter, whatever the platform's code."""
    code = """
import sys
from rigidfleet.cli import console
sys.stdout = None
console.prepare_streams()
print("\u03c9")
"""
    assert run(elsewhere, "-c", code) == ""


def test_a_drive_that_is_not_there(monkeypatch):
    """Where no folder above a path exists, as on a missing drive, there is one clear error, and no endless search."""

    def refuse(**_: object) -> None:
        raise FileNotFoundError(2, "The system cannot find the path specified")

    monkeypatch.setattr(os.path, "lexists", lambda _: False)
    monkeypatch.setattr(outputs, "TemporaryFile", refuse)
    with pytest.raises(ResultError, match="the system cannot find the path"):
        outputs.Files(Path("Z:/flights/a"), "a").check_folder_writable()
