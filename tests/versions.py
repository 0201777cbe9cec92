"""Fly with other versions, of Python and of packages, in environments of their own.

`python tests/versions.py` (`make versions`) flies, with all extras,

- with exactly the lowest versions that `pyproject.toml` declares (`constraints-lowest.txt`), on the oldest Python;
- with the pinned ones (`constraints.txt`), on each other Python of `PYTHONS` that is on this machine;
- with the newest that can be had, on the newest of these.

The pinned ones fly the wheel: that of `make package` if it is of these sources, or one that is built here, once. The
others compile: theirs is another compiler. Two environments fly at a time.

Words choose among them: `python tests/versions.py newest`, or `pinned 3.12`.

The first two must fly. What fails with the newest alone is reported, and ends nothing: it was released after the
change that is being tested. A Python that is not here is named, and nothing is claimed of it.
"""

from __future__ import annotations

import lzma
import os
import platform
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

ROOT = Path(__file__).parents[1]
#: Versions of Python that are looked for, the oldest first.
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
EXTRAS = f"[{','.join(PROJECT['optional-dependencies'])}]"
PINS = ("--build-constraints", "constraints.txt")
#: Environments that fly at a time.
AT_A_TIME = 2
#: What is flown, by the command: all of its libraries of machine code, and each package that it or an extra needs.
COMMANDS = (
    "run narrow-passage --figures all --format png --replay --out flown",
    "run moving-obstacles --no-figures --out guarded",
    "check passage-quadrotors",
    "sweep narrow-passage --vary agents.mass.2=uniform(0.9,1.1) --runs 24 --workers 2 --out swept",
    "export flown/narrow-passage.nc --format setpoints --flown --out flown/ways.csv",
    "assess flown/ways.csv",
    "report flown/narrow-passage.nc --force",
    *(f"export flown/narrow-passage.nc --format {kind}" for kind in ("skyc", "mcap", "rrd")),
    "new drawn --show --formations drawing.svg,strokes:A",
    "check drawn.toml",
)
DRAWING = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 9 9"><path d="M1 1C3 9 6 9 8 1Z"/></svg>'
)
#: Logs of autopilots, which packages of the extra `logs` read.
LOGS = ("plane.bin", "cube.ulg")
#: The same in Python: a sweep by a cluster, and what xarray sees of it and of a flight; logs; a step of learning.
SCRIPT = """
from pathlib import Path

import distributed, xarray, zstandard
from rigidfleet.foreign.files import read_trajectories
from rigidfleet.simulation.environment import FormationEnv
from rigidfleet.sweep import Sweep, fly, load

if __name__ == "__main__":
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        fly(Sweep.of("narrow-passage", ["agents.mass.* = uniform(0.9, 1.1)"], runs=24), "here", workers=1)
        fly(Sweep.of("narrow-passage", ["agents.mass.* = uniform(0.9, 1.1)"], runs=24), "there",
            cluster=cluster.scheduler_address)
    assert load("here").drop_vars("wall").equals(load("there").drop_vars("wall"))
    with xarray.open_dataset("flown/narrow-passage.nc", engine="h5netcdf") as flight:
        assert flight.sizes["agent"] == 3
    for log in ("plane.bin", "cube.ulg", "flown/narrow-passage.mcap"):
        assert read_trajectories(Path(log)).curves
    env = FormationEnv("cube-by-neighbours")
    env.reset(seed=1)
    assert len(env.step({name: env.action_space(name).sample() for name in env.agents})[1]) == 8
"""


class CommandError(Exception):
    """What failed, and its last words."""


def run(program: str | Path, *words: str | Path, cwd: Path = ROOT, **environment: str) -> str:
    """Run a command and return what it printed."""
    command = [program, *words]
    done = subprocess.run(
        command, cwd=cwd, env=os.environ | environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise CommandError(f"{' '.join(map(str, command))}\n{(done.stdout + done.stderr)[-2000:]}")
    return done.stdout


def uv(*words: str | Path, **environment: Any) -> str:
    """Run the uv that set-up has brought."""
    return run(Path(sys.executable).with_name("uv"), *words, **environment)


def interpreters() -> dict[str, str]:
    """The Pythons of this machine, by version; pyenv keeps those that are not chosen off PATH."""
    pyenv = Path(os.environ.get("PYENV_ROOT", "~/.pyenv")).expanduser().glob("versions/3.*/bin")
    path = os.pathsep.join([*map(str, sorted(pyenv)), os.environ["PATH"]])
    there = {}
    for version in PYTHONS:
        try:
            found = uv("python", "find", "--system", "--no-python-downloads", version, PATH=path)
        except CommandError:
            continue
        there[version] = found.strip()
    return there


def environment(python: str, folder: Path) -> Path:
    """Make an environment in a folder and return its Python."""
    home = folder / "environment"
    uv("venv", "--quiet", "--python", python, home)
    return home / ("Scripts" if os.name == "nt" else "bin") / "python"


def is_package_of(root: Path, folder: Path) -> bool:
    """Whether a folder has a wheel beside an sdist whose files are those of ``root``, all of the package among them.

    `make package` builds the wheel from the sdist, so that it is of these sources, too.
    """
    sdists = [*folder.glob("*.tar.gz")]
    if len(sdists) != 1 or len([*folder.glob("*.whl")]) != 1:
        return False
    with tarfile.open(sdists[0]) as archive:
        held = {
            member.name.partition("/")[2]: stream.read()
            for member in archive
            if (stream := archive.extractfile(member))
        }
    held.pop("PKG-INFO", None)
    files = {p.relative_to(root).as_posix() for p in (root / "src").rglob("*") if p.is_file()}
    return {name for name in files if "__pycache__" not in name} <= {*held} and all(
        (root / name).is_file() and (root / name).read_bytes() == content
        for name, content in held.items()
    )


@cache
def wheel(place: Path) -> Path:
    """The wheel of these sources: that of `make package`, or built into a folder."""
    made = ROOT / "dist"
    if not is_package_of(ROOT, made):
        uv("build", "--quiet", "--wheel", *PINS, "--out-dir", place, ".")
        made = place
    return next(made.glob("*.whl"))


#: Of two environments that need the wheel, one builds it.
_BUILDING = Lock()


def fly(python: Path, folder: Path) -> None:
    """Fly in an environment, with nothing compiled before."""
    (folder / "drawing.svg").write_text(DRAWING, encoding="utf-8")
    (folder / "script.py").write_text(SCRIPT, encoding="utf-8")
    for log in LOGS:
        packed = (ROOT / "tests" / "data" / "logs" / f"{log}.xz").read_bytes()
        (folder / log).write_bytes(lzma.decompress(packed))
    commands = [("-m", "rigidfleet", *command.split()) for command in COMMANDS]
    for command in (*commands, ("script.py",)):
        run(python, *command, cwd=folder, NUMBA_CACHE_DIR=str(folder / "cache"))


def newer(python: Path) -> str:
    """The packages of an environment that are not those of the pins."""
    pinned = {
        line.split()[0] for line in (ROOT / "constraints.txt").read_text("utf-8").splitlines()
    }
    packages = uv("pip", "freeze", "--python", python).lower().splitlines()
    return ", ".join(x for x in packages if "==" in x and x not in pinned) or "none"


def main() -> int:
    """Fly in each environment, say how it went, and return 1 if one failed that must fly."""
    here, own = interpreters(), ".".join(platform.python_version_tuple()[:2])
    # On this Python all tests run with the pins.
    plan = [("pinned", version, "constraints.txt") for version in here if version != own]
    if PYTHONS[0] in here:
        plan.insert(0, ("lowest", PYTHONS[0], "constraints-lowest.txt"))
    plan.append(("newest", [*here][-1], os.devnull))
    plan = [entry for entry in plan if {*sys.argv[1:]} <= {*entry}]
    with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(AT_A_TIME) as pool:
        failed = [*pool.map(lambda entry: fly_or_tell(*entry, here[entry[1]], Path(place)), plan)]
    if missing := [version for version in PYTHONS if version not in here]:
        print(f"Python {', '.join(missing)}: not on this machine, not flown")
    return int(any(failed))


def fly_or_tell(what: str, version: str, constraints: str, python: str, place: Path) -> bool:
    """Fly with these versions, say how it went, and return whether this fails what is tested."""
    begun, folder = time.perf_counter(), place / f"{what}-{version}"
    words = f"{what} versions, Python {version}"
    try:
        there = environment(python, folder)
        with _BUILDING:
            package = str(wheel(place)) if what == "pinned" else "."
        uv(
            "pip", "install", "--quiet", "--python", there, "--constraints", constraints, *PINS,
            *(("--editable",) if what != "pinned" else ()), f"{package}{EXTRAS}",
        )  # fmt: skip
        words += f" (not pinned: {newer(there)})" if what == "newest" else ""
        fly(there, folder)
    except CommandError as error:
        print(f"{'WARNING' if what == 'newest' else 'ERROR'}: {words}: {error}", flush=True)
        return what != "newest"
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    print(f"{words}: flies ({time.perf_counter() - begun:.0f} s)", flush=True)
    return False


if __name__ == "__main__":
    sys.exit(main())
