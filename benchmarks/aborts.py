"""Ways home from every second of a show: how many are proved, how near vehicles come, and how long it takes.

    python benchmarks/aborts.py [MISSION]

By default of show-1000, to any landing place and to the own ones, within 60 s and 5 min on two cores.
"""

from __future__ import annotations

import sys
import time

from rigidfleet.mission import Mission, load_mission
from rigidfleet.planning.timing import complete_times
from rigidfleet.preflight.aborts import check_aborts


def main(name: str = "show-1000") -> None:
    """Plan the aborts of a mission in both ways; print a table."""
    print(f"{'to':5}{'times':>7}{'ways':>6}{'least [m]':>11}{'processor [s]':>15}{'wall [s]':>10}")
    for to in ("any", "own"):
        data = load_mission(name).to_dict() | {"abort": {"to": to}}
        busy, wall = time.process_time(), time.perf_counter()
        check = check_aborts(complete_times(Mission.from_dict(data)))
        busy, wall = time.process_time() - busy, time.perf_counter() - wall
        ways = sum(bool(x.way) for x in check.aborts)
        print(f"{to:5}{len(check.aborts):7}{ways:6}{check.least:11.3f}{busy:15.1f}{wall:10.1f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
