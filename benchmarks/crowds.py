"""Crowds under bounded thrust: antipodal swaps by barriers and guard alone, and by a plan, and what both cost.

Every vehicle flies straight for the opposite place, as fast as it may, and knows nothing of a plan. Its acceleration
is at most 5 m/s^2. Distances are the least in continuous time: commands are held, so that each relative path is a
parabola between ticks. Costs are processor time.

By the plan, ways of all are found together and proved (`rigidfleet.planning.transfers`), with limits of each axis that
keep speed and acceleration within the same in every direction.

    python benchmarks/crowds.py [--runs 20] [--planned 1] [--seed 0]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import rigidfleet as rf
from rigidfleet.kernel import fleet
from rigidfleet.kernel.avoidance import BARRIER, GUARD, TICKS, avoidance_arrays
from rigidfleet.kernel.engine import native, sampled
from rigidfleet.kernel.problem import graph, workspace
from rigidfleet.planning.legs import leg_of
from rigidfleet.planning.plan import plan_phase
from rigidfleet.planning.reference import PhaseState
from rigidfleet.planning.transfers import least_duration, plan_transfer
from rigidfleet.typing import Floats

#: Greatest acceleration and speed, what centres are to keep, period of the commands.
THRUST, SPEED, APART, PERIOD = 5.0, 3.0, 0.5, 0.02
#: Number of vehicles, radius of the sphere or ring [m], whether it is a ring, longest flight [s].
SWAPS = (
    (10, 4.0, False, 60.0), (10, 4.0, True, 60.0), (30, 5.0, False, 60.0), (30, 6.0, True, 60.0),
    (100, 8.0, False, 60.0),
)  # fmt: skip


#: Swaps by the plan: number of vehicles, radius [m], whether it is a ring.
PLANNED = ((30, 5.0, False), (100, 8.0, False), (100, 14.0, True))


#: Accelerations of vehicles from time, positions and velocities, and the processor time that it took [s].
Law = Callable[[float, Floats, Floats], tuple[Floats, float]]


class Swap(NamedTuple):
    """What one swap came to."""

    least: float  # distance of centres [m]
    margin: float  # of stop segments [m]
    arrived: float  # time of the last arrival [s], infinity if not all arrive
    barrier: float  # shares of ticks and vehicles at which each acted
    guard: float
    cost: float  # of filter and guard per vehicle and tick [us]


def places(n: int, radius: float, *, ring: bool, rng: np.random.Generator) -> Floats:
    """Places (n, 3) [m] evenly on a ring or sphere, to a millimetre."""
    i = np.arange(n)
    if ring:
        angle = 2 * np.pi * i / n
        found = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    else:
        polar, angle = np.arccos(1 - 2 * (i + 0.5) / n), np.pi * (1 + 5**0.5) * (i + 0.5)
        across = np.sin(polar)
        found = radius * np.stack(
            [np.cos(angle) * across, np.sin(angle) * across, np.cos(polar)], axis=1
        )
    return found + rng.normal(0.0, 1e-3, found.shape)


def kernel(n: int, **given: Any) -> tuple[Any, ...]:
    """Problem, workspace, flight, state and avoidance of n free vehicles of 1 kg without gravity."""
    mission = rf.load_mission("square")
    one = mission.fleet
    plan = plan_phase(
        mission, leg_of(mission, mission.phases[0], PhaseState(0.0, one.position, one.velocity))
    )
    mass = np.ones(n)
    problem = plan.problem._replace(graph=graph(np.zeros((0, 2), dtype=np.int64), mass))
    vehicles = fleet.quadrotor_arrays(
        [fleet.VehicleDynamics(1.0, point=True, limit=THRUST)] * n, 0.0
    )
    flight = fleet.new_ideal_flight(vehicles, start=0.0, h=PERIOD, steps=1)
    work = workspace(n, 0)
    state = fleet.initial_state(flight, np.zeros((n, fleet.STATES)), work)
    given = {"radius": 0.5 * APART} | given
    radius = given.pop("radius") * mass
    a = avoidance_arrays(
        period=PERIOD, b=THRUST * mass, lift=THRUST * mass, mass=mass, g=0.0, radius=radius, **given,
    )  # fmt: skip
    return problem, work, flight, state, a


def preferred(r: Floats, goal: Floats) -> Floats:
    """Velocities straight towards a goal, at most SPEED fast."""
    way = goal - r
    far = np.linalg.norm(way, axis=1, keepdims=True)
    fast = np.minimum(SPEED, np.sqrt(THRUST * far))
    return np.where(far < 0.3, 1.5 * way, way / np.maximum(far, 1e-9) * fast)


def limited(a: Floats) -> Floats:
    """Accelerations of THRUST at most."""
    return a * np.minimum(1.0, THRUST / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-12))


def asked(r: Floats, v: Floats, goal: Floats) -> Floats:
    """Accelerations that lead to the preferred velocity."""
    return limited(3.0 * (preferred(r, goal) - v))


def least_norm_solution(r: Floats, v: Floats, a: Floats, pairs: tuple[Any, Any]) -> float:
    """Least distance [m] of any two over a period with constant accelerations."""
    i, j = pairs
    x = r[i] - r[j]
    near = np.flatnonzero((x * x).sum(axis=1) < (3 * APART) ** 2)
    if not len(near):
        return np.inf
    i, j = i[near], j[near]
    return float(on_parabolas(x[near], v[i] - v[j], a[i] - a[j]).min())


def on_parabolas(x: Floats, w: Floats, rise: Floats) -> Floats:
    """Least lengths (P,) of x + w t + rise t^2 / 2 (P, 3) over a period [m].

    Stationary points of a quartic, by Newton's method from eight places, and the ends.
    """
    t = np.linspace(0.0, PERIOD, 8)[:, None] + np.zeros(len(x))
    for _ in range(4):
        y = x + w * t[..., None] + 0.5 * rise * t[..., None] ** 2
        rate = w + rise * t[..., None]
        slope = (y * rate).sum(axis=2)
        bend = (rate * rate + y * rise).sum(axis=2)
        t = np.clip(t - slope / np.where(bend > 1e-12, bend, np.inf), 0.0, PERIOD)
    t = np.concatenate([t, np.zeros((1, len(x))), np.full((1, len(x)), PERIOD)])
    y = x + w * t[..., None] + 0.5 * rise * t[..., None] ** 2
    return np.linalg.norm(y, axis=2).min(axis=0)


class Flown(NamedTuple):
    """What a flight of a crowd came to."""

    least: float  # distance of centres [m]
    arrived: float  # time of the last arrival [s], infinity if not all arrive
    cost: float  # of the law per vehicle and tick [us]


def fly(r: Floats, law: Law, longest: float, *, at_once: bool = False) -> Flown:
    """Fly vehicles at r (N, 3) [m] to the opposite places; ``at_once``: velocities change at once, then are held."""
    n, goal, v = len(r), -r, np.zeros_like(r)
    pairs = np.triu_indices(n, 1)
    least, cost, arrived, k = np.inf, 0.0, np.full(n, np.inf), 0
    for k in range(int(longest / PERIOD)):
        c, took = law(k * PERIOD, r, v)
        cost += took
        if at_once:
            v, c = v + c * PERIOD, 0.0 * c
        least = min(least, least_norm_solution(r, v, c, pairs))
        r, v = r + v * PERIOD + 0.5 * c * PERIOD**2, v + c * PERIOD
        there = np.linalg.norm(r - goal, axis=1) < 0.1
        arrived = np.where(there, np.minimum(arrived, (k + 1) * PERIOD), np.inf)
        if there.all():
            break
    return Flown(least, float(arrived.max()), 1e6 * cost / ((k + 1) * n))


def swap(
    n: int,
    radius: float,
    *,
    ring: bool,
    longest: float,
    seed: int,
    keep: list[tuple[Floats, Floats]] | None = None,
) -> Swap:
    """Fly one swap; ``keep`` takes the states at the ticks."""
    start = places(n, radius, ring=ring, rng=np.random.default_rng(seed))
    problem, work, flight, state, a = kernel(n)

    def law(t: float, r: Floats, v: Floats) -> tuple[Floats, float]:
        if keep is not None:
            keep.append((r, v))
        state.seen[:, :3], state.seen[:, 3:] = r, v
        state.force[:] = asked(r, v, -start)
        state.work.law_time[0] = t
        begun = time.process_time()
        if not sampled.correct_forces(problem, work, flight, state, a):
            raise SystemExit("too many neighbours")
        took = time.process_time() - begun
        c = state.force.copy()
        assert np.linalg.norm(c, axis=1).max() <= THRUST + 1e-9
        return c, took

    flown = fly(start, law, longest)
    shares = a.acted[[BARRIER, GUARD]].sum(axis=1) / (int(a.count[TICKS]) * n)
    return Swap(flown.least, float(a.margin[0, 0]), flown.arrived, *map(float, shares), flown.cost)


def planned(n: int, radius: float, *, ring: bool, seed: int) -> tuple[float, float, float]:
    """Proved distance [m], makespan as a multiple of the slowest vehicle's alone, and planning time [s] of a swap."""
    s = places(n, radius, ring=ring, rng=np.random.default_rng(seed))
    box = np.full(3, radius + 3.0)
    speed, acceleration = SPEED / 3**0.5, THRUST / 3**0.5
    begun = time.process_time()
    found = plan_transfer(
        s, -s, distance=APART, speed=speed, acceleration=acceleration, box=(-box, box), seed=seed
    )
    took = time.process_time() - begun
    if found is None:
        return 0.0, np.inf, took
    alone = least_duration(s, -s, speed, acceleration)
    return found.certificate.separation, found.duration / alone, took


def layers(n: int = 30, repeats: int = 5) -> tuple[float, float, float]:
    """Processor time of call, filter and guard [us] per vehicle and tick, at the states of a swap in space."""
    states: list[tuple[Floats, Floats]] = []
    swap(n, 5.0, ring=False, longest=20.0, seed=0, keep=states)
    found = []
    for given in (
        {"filtered": False, "guarded": False}, {"guarded": False}, {"filtered": False},
    ):  # fmt: skip
        problem, work, flight, state, a = kernel(n, **given)
        cost = 0.0
        for r, v in states * repeats:
            state.seen[:, :3], state.seen[:, 3:] = r, v
            state.force[:] = asked(r, v, -states[0][0])
            begun = time.process_time()
            sampled.correct_forces(problem, work, flight, state, a)
            cost += time.process_time() - begun
        found.append(1e6 * cost / (repeats * len(states) * n))
    return found[0], found[1] - found[0], found[2] - found[0]


def out_of_range() -> float:
    """Share of the flight that avoidance costs where nothing is in range: eight vehicles far apart that reshape."""
    took = []
    for tables in ({}, {"avoidance": {}}):
        i = np.arange(8)
        cube = 20.0 * np.stack([i % 2, i // 2 % 2, i // 4], axis=1)
        data = {
            "schema_version": 1, "name": "wide",
            "vehicles": {"point": {"model": "point", "mass": 1.0, "thrust_limit": 20.0}},
            "agents": {"vehicle": "point", "position": (cube + [0, 0, 5.0]).tolist()},
            "formations": {
                "small": {"slots": cube.tolist()},
                "large": {"slots": (1.2 * cube).tolist()},
            },
            "phases": [
                {"kind": "establish", "formation": "small", "control": "tracking", "until": 5.0},
                {"kind": "reshape", "formation": "large", "control": "tracking", "until": 25.0, "blend": 15.0},
            ],
        } | tables  # fmt: skip
        mission = rf.Mission.from_dict(data)
        rf.simulate(mission)
        times = []
        for _ in range(5):
            begun = time.process_time()
            rf.simulate(mission)
            times.append(time.process_time() - begun)
        took.append(min(times))
    return took[1] / took[0] - 1.0


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--runs", type=int, default=20, help="swaps of each kind")
    parser.add_argument("--planned", type=int, default=1, help="swaps of each kind by the plan")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    native.library("avoidance")
    print(
        "| swap | least distance (0.5) | least margin | arrive | last at | barrier | guard | both cost |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for n, radius, ring, longest in SWAPS:
        runs = [
            swap(n, radius, ring=ring, longest=longest, seed=chosen.seed + k)
            for k in range(chosen.runs)
        ]
        done = [run.arrived for run in runs if run.arrived < np.inf]
        share = 100 * len(done) / len(runs)
        middle = f"{np.median(done):.1f} s" if done else "-"
        print(
            f"| {n} {'on a ring' if ring else 'in space'} | {min(run.least for run in runs):.6f} m |"
            f" {min(run.margin for run in runs):.1e} m | {share:.0f} % of {len(runs)} | {middle} |"
            f" {100 * np.mean([run.barrier for run in runs]):.0f} % |"
            f" {100 * np.mean([run.guard for run in runs]):.0f} % |"
            f" {np.median([run.cost for run in runs]):.2f} us |",
            flush=True,
        )
    print("\n| swap by the plan | least distance proved (0.5) | arrive | makespan | planning |")
    print("|---|---|---|---|---|")
    for n, radius, ring in PLANNED:
        seeds = range(chosen.seed, chosen.seed + chosen.planned)
        found = [planned(n, radius, ring=ring, seed=seed) for seed in seeds]
        proved = [x for x in found if x[0] >= APART]
        least = f"{min(x[0] for x in proved):.3f} m" if proved else "-"
        slow = f"{max(x[1] for x in proved):.2f}" if proved else "-"
        print(
            f"| {n} {'on a ring' if ring else 'in space'} | {least} |"
            f" {100 * len(proved) / max(len(found), 1):.0f} % of {len(found)} | {slow} |"
            f" {np.median([x[2] for x in found]) if found else 0.0:.0f} s |",
            flush=True,
        )
    call, barrier, guard = layers()
    print(f"\nAt the states of a swap of 30, a vehicle and tick take {call:.2f} us for the call,")
    print(f"{barrier:.2f} us for the filter, {guard:.2f} us for the guard.")
    print(f"Nothing in range: {100 * out_of_range():.1f} % of a flight of eight.")


if __name__ == "__main__":
    main()
