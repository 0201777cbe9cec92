"""What a flight and its verdict cost: processor time [ms] of simulate() and assess(), least of several.

A verdict is timed twice: of a flight of which nothing has been asked before, as in a sweep, and of one judged before.

It uses nothing but the public interface, so that two versions can be compared: run it by turns in the checkout of each.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable

import rigidfleet as rf

FLIGHTS = {
    "narrow-passage": 25, "windy-passage": 9, "cube-passage": 15, "establish-triangle": 40
}  # fmt: skip


def least(job: Callable[[], object], repeats: int) -> float:
    """Least processor time [ms] of a job."""
    found = []
    for _ in range(repeats):
        start = time.process_time()
        job()
        found.append(1e3 * (time.process_time() - start))
    return round(min(found), 2)


def first_verdict(name: str, repeats: int) -> float:
    """Least processor time [ms] of the verdict on a flight of which nothing has been asked before."""
    found = []
    for _ in range(repeats):
        result = rf.simulate(rf.load_mission(name))
        start = time.process_time()
        rf.assess(result)
        found.append(1e3 * (time.process_time() - start))
    return round(min(found), 2)


def main() -> None:
    """Print a line of JSON."""
    table = {}
    for name, repeats in FLIGHTS.items():
        result = rf.simulate(rf.load_mission(name))
        rf.assess(result)
        table[name] = {
            "simulate": least(lambda name=name: rf.simulate(rf.load_mission(name)), repeats),
            "first assess": first_verdict(name, repeats),
            "assess": least(lambda result=result: rf.assess(result), repeats),
        }
    print(json.dumps(table))


if __name__ == "__main__":
    main()
