"""Two states of the program by turns: the rows of `make bench` that a user waits for, as ratios of their times.

    python benchmarks/turns.py OTHER [--rounds 11]

OTHER is another checkout of the repository, set up by `make setup` there, such as a worktree of an earlier commit. Both
measure the same work in turn, each in a process of its own, so that a drift of the machine slows both alike. Times are
those of the processor, with all threads and child processes, so that other work on the machine counts little. A ratio
is our time over that of the other; the median of the rounds counts.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parent.parent


def processor_time() -> float:
    """What this process and its children that ended took of the processor so far [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def least(job: Callable[[], object], repeats: int, count: int = 1) -> float:
    """The least processor time [ms] of a job among some repeats, each of ``count`` jobs; one goes before."""
    job()
    times = []
    for _ in range(repeats):
        start = processor_time()
        for _ in range(count):
            job()
        times.append((processor_time() - start) / count * 1e3)
    return min(times)


def measured() -> dict[str, float]:
    """Times [ms] of this process's own checkout, by row."""
    import numpy as np

    import rigidfleet as rf
    from rigidfleet.simulation.together import simulate_together

    rows: dict[str, float] = {}
    for source, n in (("establish-triangle", 3), ("establish-cube", 8)):
        for law in ("undamped", "default"):
            tables: dict[str, Any] = rf.load_mission(source).to_dict()
            name = tables["phases"][0]["formation"]
            steps = "step" if law == "undamped" else "squares"
            tables["phases"] = [
                {"kind": "establish", "formation": name, "reference": steps, "control": "open", "duration": 20.0}
            ]  # fmt: skip
            tables["formations"] = {name: tables["formations"][name]}
            tables["integrator"] = {"rtol": 1e-8, "atol": 1e-8}
            if law == "undamped":
                tables["constraint"] = {"solver": "exact", "deformation_damping": 0.0}
            mission = rf.Mission.from_dict(tables)
            rows[f"simulate(), {n} agents, {law}"] = least(lambda m=mission: rf.simulate(m), 15, 20)
            rng = np.random.default_rng(1)
            starts = np.array(mission.agents.position) + rng.uniform(-0.25, 0.25, (1000, n, 3))
            rows[f"1,000 flights, {n} agents, {law}"] = least(
                lambda m=mission, s=starts: rf.establish(m, s), 5
            )
    for name in ("narrow-passage", "windy-passage"):
        mission = rf.load_mission(name)
        rows[f"simulate(), {name}"] = least(lambda m=mission: rf.simulate(m), 5)
        result = rf.simulate(mission)
        rows[f"assess(), {name}"] = least(lambda r=result: rf.assess(r), 9, 5)
        eight = [mission] * 8
        rows[f"eight side by side with verdicts, {name}"] = least(
            lambda e=eight: [rf.assess(r) for r in simulate_together(e)], 4
        )
    for name in ("passage-quadrotors", "cube-passage-quadrotors"):
        mission = rf.load_mission(name)
        rows[f"simulate(), {name}"] = least(lambda m=mission: rf.simulate(m), 2)
    flight = ["run", "narrow-passage"]
    for words in (["--help"], ["check", "narrow-passage"], [*flight, "--no-figures"], flight):
        rows[f"command: {' '.join(words)}"] = least(lambda w=words: command(w), 3)
    return rows


def command(words: list[str]) -> None:
    """Run the command of this checkout as a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(
            [sys.executable, "-m", "rigidfleet", *words], cwd=folder, check=True, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip


def main() -> int:
    """Measure both by turns and print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("other", type=Path)
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measured()))
        return 0
    times: dict[str, list[dict[str, float]]] = {"ours": [], "other": []}
    for k in range(options.rounds):
        sides = [("ours", ROOT), ("other", options.other.resolve())]
        for side, root in sides if k % 2 else sides[::-1]:
            done = subprocess.run(
                [root / ".venv/bin/python", __file__, str(options.other), "--measure"], check=True,
                capture_output=True, text=True,
            )  # fmt: skip
            times[side].append(json.loads(done.stdout))
    print(f"{'':44} {'ours [ms]':>10} {'other [ms]':>10}  ratio  rounds")
    for name in times["ours"][0]:
        ours, other = ([run[name] for run in times[side]] for side in ("ours", "other"))
        ratios = [a / b for a, b in zip(ours, other, strict=True)]
        print(
            f"{name:44} {median(ours):10.3g} {median(other):10.3g}  {median(ratios):5.2f}"
            f"  {min(ratios):.2f} to {max(ratios):.2f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
