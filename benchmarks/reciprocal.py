"""Antipodal swaps on a ring in the plane: reciprocal velocity obstacles (ORCA, by pyrvo) beside barriers and guard.

Both want the same velocities, straight to the opposite place. ORCA (van den Berg, Guy, Lin and Manocha, *Reciprocal
n-Body Collision Avoidance*, 2011) knows no bound on accelerations: its velocities are flown at once, or with at most 5
m/s^2, as those of the guard, whose candidates lie in the plane here. Distances are the least in continuous time. Costs
are processor time, of ORCA all of a step but the calls that set positions and velocities.

    python benchmarks/reciprocal.py [--runs 20]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from crowds import APART, PERIOD, SPEED, Flown, Law, asked, fly, kernel, limited, places, preferred

from rigidfleet.kernel.engine import native, sampled
from rigidfleet.typing import Floats

#: Number of vehicles, radius of the ring [m]; time after which a flight ends [s].
RINGS, LONGEST = ((10, 4.0), (30, 6.0)), 60.0
#: Time for which ORCA looks ahead [s]: the one of its example of a circle, and one that suits these speeds.
HORIZONS = (10.0, 2.0)


def guarded(goal: Floats) -> Law:
    """Barriers and guard."""
    problem, work, flight, state, a = kernel(len(goal))
    for some in (slice(0, 26), slice(26, 38)):
        size = np.linalg.norm(a.candidates[some][0])
        angle = np.linspace(0.0, 2 * np.pi, some.stop - some.start, endpoint=False)
        a.candidates[some] = size * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)

    def law(_t: float, r: Floats, v: Floats) -> tuple[Floats, float]:
        state.seen[:, :3], state.seen[:, 3:], state.force[:] = r, v, asked(r, v, goal)
        begun = time.process_time()
        assert sampled.correct_forces(problem, work, flight, state, a)
        return state.force.copy(), time.process_time() - begun

    return law


def reciprocal(goal: Floats, horizon: float, *, bounded: bool) -> Law:
    """ORCA, with accelerations that reach its velocity in a step, or with those that can be flown."""
    import pyrvo

    n = len(goal)
    simulator: Any = pyrvo.RVOSimulator(PERIOD, 15.0, n - 1, horizon, horizon, APART / 2, SPEED)
    for x in -goal:
        simulator.add_agent((x[0], x[1]))

    def law(_t: float, r: Floats, v: Floats) -> tuple[Floats, float]:
        aims = preferred(r, goal)
        for i in range(n):
            simulator.set_agent_position(i, (r[i, 0], r[i, 1]))
            simulator.set_agent_velocity(i, (v[i, 0], v[i, 1]))
            simulator.set_agent_pref_velocity(i, (aims[i, 0], aims[i, 1]))
        begun = time.process_time()
        simulator.do_step()
        took = time.process_time() - begun
        found = np.zeros((n, 3))
        found[:, :2] = [simulator.get_agent_velocity(i).to_tuple() for i in range(n)]
        a = (found - v) / PERIOD
        return limited(a) if bounded else a, took

    return law


def swap(
    n: int, radius: float, seed: int, made: Callable[[Floats], Law], *, at_once: bool
) -> Flown:
    """Fly one swap in the plane."""
    start = places(n, radius, ring=True, rng=np.random.default_rng(seed))
    start[:, 2] = 0.0
    law = made(-start)

    def level(t: float, r: Floats, v: Floats) -> tuple[Floats, float]:
        assert np.abs(r[:, 2]).max() == 0.0
        return law(t, r, v)

    return fly(start, level, LONGEST, at_once=at_once)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--runs", type=int, default=20, help="swaps of each kind")
    chosen = parser.parse_args()
    methods: list[tuple[str, Callable[[Floats], Law], bool]] = [("barriers, guard", guarded, False)]
    try:
        import pyrvo  # noqa: F401
    except ImportError:
        print("ORCA is left out: pyrvo is not installed (`make .venv/.crowds`)")
    else:
        for horizon in HORIZONS:
            for bounded in (False, True):
                words = "within the thrust" if bounded else "velocities at once"
                methods.append(
                    (
                        f"ORCA, {horizon:g} s ahead, {words}",
                        lambda goal, h=horizon, b=bounded: reciprocal(goal, h, bounded=b),
                        not bounded,
                    )
                )
    native.library("avoidance")
    print(
        f"| ring of | flown by | least distance ({APART}) | below it | all arrive | last at | cost |"
    )
    print("|---|---|---|---|---|---|---|")
    for n, radius in RINGS:
        for name, made, at_once in methods:
            runs = [swap(n, radius, seed, made, at_once=at_once) for seed in range(chosen.runs)]
            done = [run.arrived for run in runs if run.arrived < np.inf]
            last = f"{np.median(done):.1f} s" if done else "-"
            print(
                f"| {n} | {name} | {min(run.least for run in runs):.4f} m |"
                f" {sum(run.least < APART - 1e-6 for run in runs)} | {len(done)} of {len(runs)} | {last} |"
                f" {np.median([run.cost for run in runs]):.1f} us |",
                flush=True,
            )


if __name__ == "__main__":
    main()
