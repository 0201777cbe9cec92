"""Obstacles that move: random scenes flown with flow alone, with barriers and guard, and with all three.

One vehicle, or eight as a cube, fly straight along x and track their slots. Two balls cross their course at random,
about where and when the vehicles pass. They are seen within RANGE alone, with noise, and known by the Kalman filter of
the kernel. Accelerations are at most 5 m/s^2. Least distances are those in continuous time: commands are held, so that
relative paths are parabolas between ticks.

A scene counts as feasible by a criterion that knows nothing of any of these methods: from the first moment at which an
undisturbed vehicle has the ball within RANGE, one constant acceleration of SHARE of the greatest one, the same for all
vehicles and held for HELD, in one of 38 directions, or none, leads them past it, SPARE away, for the next AHEAD.

    python benchmarks/moving.py [--scenes 1000] [--seed 0]
"""

from __future__ import annotations

import argparse
import time
from typing import NamedTuple

import numpy as np
from crowds import PERIOD, THRUST, kernel, least_distance

from rigidfleet.kernel.avoidance import TICKS, candidates, sight
from rigidfleet.kernel.engine import native, sampled
from rigidfleet.solids.records import Solids, ball, joined, single
from rigidfleet.typing import Floats

#: Speeds of vehicles, and greatest speeds of obstacles [m/s].
SPEEDS = ((2.0, 2.0), (2.0, 6.0), (5.0, 6.0))
#: Radii of vehicles and obstacles, length of the course, edge of the cube [m].
RADIUS, BALL, COURSE, EDGE = 0.3, 0.7, 24.0, 3.0
#: Sensing range, its noise [m].
RANGE, NOISE = 10.0, 0.05
#: The criterion: share of the acceleration, for how long [s], what to keep [m], for how long [s].
SHARE, HELD, SPARE, AHEAD = 0.6, 1.5, 0.1, 6.0
#: Distance of centres below which distances are taken [m].
NEAR = 1.5
#: Methods: what `kernel.avoidance.avoidance` is asked for.
METHODS = {
    "flow": {"flow": True, "guarded": False, "filtered": False},
    "barriers, guard": {},
    "flow, barriers, guard": {"flow": True},
}


class Scene(NamedTuple):
    """Slots (n, 3) at the start, speed along x, and places and velocities (2, 3) of the obstacles at the start."""

    slots: Floats
    speed: float
    place: Floats
    velocity: Floats


class Flown(NamedTuple):
    """Least distances of surfaces [m], from obstacles and between vehicles, time of arrival [s] and cost [us]."""

    obstacle: float
    pair: float
    arrived: float
    cost: float


def scene(n: int, speed: float, fastest: float, seed: int) -> Scene:
    """One scene of n vehicles; obstacles start at least 6 m from all of them."""
    rng = np.random.default_rng((n, int(10 * speed), int(10 * fastest), seed))
    i = np.arange(n)
    slots = EDGE * np.stack([i % 2, i // 2 % 2, i // 4], axis=1) - (0.0 if n == 1 else EDGE / 2)
    found: list[tuple[Floats, Floats]] = []
    while len(found) < 2:
        x, way = rng.uniform(7.0, 18.0), rng.normal(size=3)
        w = way / np.linalg.norm(way) * rng.uniform(0.3, 1.0) * fastest
        start = slots[rng.integers(n)] + [x, 0.0, 0.0] + rng.normal(0.0, 0.3, 3) - w * x / speed
        if np.linalg.norm(start - slots, axis=1).min() > 6.0:
            found.append((start, w))
    return Scene(slots, speed, np.array([f[0] for f in found]), np.array([f[1] for f in found]))


def feasible(given: Scene) -> bool:
    """Whether every obstacle, alone and at first sight, can be evaded by all vehicles in one way; see above."""
    t = np.arange(0.0, COURSE / given.speed, PERIOD)
    fly = np.array([given.speed, 0.0, 0.0])
    push = np.concatenate([candidates()[:26], candidates()[-1:]]) * SHARE * THRUST
    s = np.arange(0.0, AHEAD, PERIOD)
    bend = np.where(s < HELD, 0.5 * s * s, HELD * s - 0.5 * HELD * HELD)
    for place, w in zip(given.place, given.velocity, strict=True):
        x = given.slots - place
        away = np.linalg.norm(x[:, None] + t[:, None] * (fly - w), axis=2).min(axis=0) - BALL
        seen = np.flatnonzero(away <= RANGE)
        if not len(seen):
            continue
        x = x + t[seen[0]] * (fly - w)
        clear = np.ones(len(push), dtype=bool)
        for own in x:
            path = own + s[:, None] * (fly - w) + push[:, None, :] * bend[:, None]
            clear &= np.linalg.norm(path, axis=2).min(axis=1) > RADIUS + BALL + SPARE
        if not clear.any():
            return False
    return True


def asked(r: Floats, v: Floats, slots: Floats, speed: float, t: float) -> Floats:
    """Accelerations that track the slots, which stop at the end of the course."""
    moving = speed * t < COURSE
    ahead = min(speed * t, COURSE)
    e = slots + [ahead, 0.0, 0.0] - r
    e *= np.minimum(1.0, 1.5 / np.maximum(np.linalg.norm(e, axis=1, keepdims=True), 1e-12))
    a = 2.0 * e + 2.5 * ([speed if moving else 0.0, 0.0, 0.0] - v)
    return a * np.minimum(1.0, THRUST / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-12))


def solids(given: Scene) -> Solids:
    """The obstacles of a scene, for a minute."""
    ends = np.array([0.0, 60.0])
    return joined(
        [
            single(ball(place, BALL), ends, np.outer(ends, w))
            for place, w in zip(given.place, given.velocity, strict=True)
        ]
    )


def fly(given: Scene, method: str) -> Flown:
    """Fly one scene."""
    n, things = len(given.slots), solids(given)
    problem, work, flight, state, a = kernel(
        n, radius=RADIUS, solids=things, separation=0.1, clearance=0.05,
        seen=sight(things, RANGE, NOISE, 0.2), **METHODS[method],
    )  # fmt: skip
    r, v = given.slots.copy(), np.zeros((n, 3)) + [given.speed, 0.0, 0.0]
    own, other = np.triu_indices(n, 1)
    across = np.repeat(np.arange(n), 2), n + np.tile([0, 1], n)
    nearest, apart, cost, ticks = np.inf, np.inf, 0.0, 0
    goal, rest, arrived = given.slots + [COURSE, 0.0, 0.0], np.zeros((2, 3)), np.inf
    for k in range(int((COURSE / given.speed + 12.0) / PERIOD)):
        t = k * PERIOD
        state.seen[:, :3], state.seen[:, 3:] = r, v
        state.force[:] = asked(r, v, given.slots, given.speed, t)
        state.work.law_time[0] = t
        begun = time.process_time()
        if not sampled.avoid(problem, work, flight, state, a):
            raise SystemExit("too many neighbours")
        cost += time.process_time() - begun
        ticks += 1
        c = state.force.copy()
        assert (c * c).sum(axis=1).max() <= THRUST**2 * (1 + 1e-9)
        place = given.place + t * given.velocity
        if ((r[:, None] - place) ** 2).sum(axis=2).min() < NEAR**2:
            both = np.concatenate([r, place]), np.concatenate([v, given.velocity])
            nearest = min(nearest, least_distance(*both, np.concatenate([c, rest]), across))
        if n > 1 and ((r[own] - r[other]) ** 2).sum(axis=1).min() < NEAR**2:
            apart = min(apart, least_distance(r, v, c, (own, other)))
        r, v = r + v * PERIOD + 0.5 * c * PERIOD**2, v + c * PERIOD
        if given.speed * t > COURSE and np.linalg.norm(r - goal, axis=1).max() < 0.3:
            arrived = t
            break
    assert a.count[TICKS] == ticks
    return Flown(nearest - RADIUS - BALL, apart - 2 * RADIUS, arrived, 1e6 * cost / (ticks * n))


def row(n: int, speeds: tuple[float, float], count: int, seed: int, method: str) -> str:
    """A row of the table."""
    scenes = [scene(n, *speeds, seed + k) for k in range(count)]
    fit = np.array([feasible(each) for each in scenes])
    flown = [fly(each, method) for each in scenes]
    least = np.array([min(x.obstacle, x.pair) for x in flown])
    late, hit = np.array([x.arrived for x in flown]), least < 0.0
    closest = f"{least[fit].min():.3f}" if least[fit].min() < np.inf else "-"
    return (
        f"| {n} | {speeds[0]:g} | {speeds[1]:g} | {fit.sum()} of {count} | {method} | {(hit & fit).sum()} |"
        f" {(hit & ~fit).sum()} | {closest} | {100 * np.isfinite(late[fit]).mean():.1f} % |"
        f" {np.median(late[fit]):.1f} | {np.median([x.cost for x in flown]):.1f} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", type=int, default=1000, help="scenes of each kind")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    native.avoiding()
    print(
        "| vehicles | their speed | obstacles' | feasible | flown with | contacts | of the infeasible"
        " | least distance [m] | arrive | median time [s] | cost [us] |"
    )
    print("|---" * 11 + "|")
    for n in (1, 8):
        for speeds in SPEEDS:
            for method in METHODS:
                print(row(n, speeds, chosen.scenes, chosen.seed, method), flush=True)


if __name__ == "__main__":
    main()
