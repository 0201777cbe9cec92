"""What the first flight from the wheel costs beside the second: processor time, in a bare environment, without figures.

``make bench`` runs it. The wheel is built and installed as users do, every mission begins with an empty home, and
nothing of this environment is seen.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
MISSIONS = ("narrow-passage", "passage-quadrotors", "moving-obstacles", "show-1000")
GOAL = 3.0


def spent(*command: object, folder: Path, **environment: str) -> float:
    """Processor time [s] of a command and all that it starts."""

    def of_children() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    before = of_children()
    words, seen = [*map(str, command)], environment or None
    done = subprocess.run(words, cwd=folder, env=seen, check=False, stdout=subprocess.DEVNULL)
    if done.returncode != 1:  # a flight that fails its verdict
        done.check_returncode()
    return of_children() - before


def bare(folder: Path, wheel: Path | None) -> Path:
    """The command `rigidfleet` of a bare environment, in which pip has installed the wheel under the constraints."""
    uv = Path(sys.executable).with_name("uv")
    if wheel is None:
        constraints = ("--build-constraints", "constraints.txt")
        made = spent(
            uv, "build", "--quiet", "--wheel", *constraints, "--out-dir", folder, ".", folder=ROOT
        )
        (wheel,) = folder.glob("*.whl")
        print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB, {made:.0f} s to build")
    environment = folder / "bare"
    spent(sys.executable, "-m", "venv", environment, folder=folder)
    pip = (environment / "bin" / "python", "-m", "pip", "install", "--quiet")
    spent(*pip, "--constraint", ROOT / "constraints.txt", wheel, folder=folder)
    return environment / "bin" / "rigidfleet"


def main() -> int:
    """Print the table; return 0 if every first flight costs at most `GOAL` times the second."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("missions", nargs="*", default=MISSIONS, help="names of shipped missions")
    parser.add_argument("--wheel", type=Path, help="a wheel that is built already")
    arguments = parser.parse_args()
    worst = 0.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = bare(folder, arguments.wheel and arguments.wheel.resolve())
        for mission in arguments.missions:
            home = folder / mission
            home.mkdir()
            seen = {"PATH": os.defpath, "HOME": str(home), "LANG": "C.UTF-8"}
            fly = (command, "run", mission, "--no-figures", "--quiet", "--force")
            first, second = (spent(*fly, folder=home, **seen) for _ in range(2))
            worst = max(worst, first / second)
            print(f"{mission:24} {first:6.2f} s {second:6.2f} s  {first / second:5.2f}", flush=True)
    print(f"worst {worst:.2f}, goal {GOAL:g}")
    return 0 if worst <= GOAL else 1


if __name__ == "__main__":
    sys.exit(main())
