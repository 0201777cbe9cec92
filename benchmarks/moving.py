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
from typing import Any, NamedTuple

import numpy as np
from crowds import PERIOD, THRUST, kernel, on_parabolas

from rigidfleet.kernel.avoidance import candidates, sight
from rigidfleet.kernel.engine import native
from rigidfleet.kernel.engine.packing import Packed, packed
from rigidfleet.solids.records import Solids, ball, joined, single
from rigidfleet.typing import Floats

#: Speeds of vehicles, and greatest speeds of obstacles [m/s].
SPEEDS = ((2.0, 2.0), (2.0, 6.0), (5.0, 6.0))
#: Radii of vehicles and obstacles, length of the course, edge of the cube [m].
RADIUS, BALL, COURSE, EDGE = 0.3, 0.7, 24.0, 3.0
#: Sensing range, its noise [m], acceleration of obstacles that is reckoned with [m/s^2].
RANGE, NOISE, SWERVE = 10.0, 0.05, 0.2
#: The criterion: share of the acceleration, for how long [s], what to keep [m], for how long [s].
SHARE, HELD, SPARE, AHEAD = 0.6, 1.5, 0.1, 6.0
#: Distance of centres below which distances are taken [m].
NEAR = 1.5
#: Time for which a flight goes on after its slots have arrived [s].
LATER = 12.0
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
    """Of S scenes: least distances of surfaces [m], times of arrival [s], cost per vehicle and tick [us]."""

    obstacle: Floats  # (S,) from obstacles
    pair: Floats  # (S,) between vehicles
    arrived: Floats  # (S,) infinity if not all arrive
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
    """Accelerations (S, n, 3) that track the slots, which stop at the end of the course."""
    moving = speed * t < COURSE
    e = slots + [min(speed * t, COURSE), 0.0, 0.0] - r
    e *= np.minimum(1.0, 1.5 / np.maximum(np.linalg.norm(e, axis=2, keepdims=True), 1e-12))
    a = 2.0 * e + 2.5 * ([speed if moving else 0.0, 0.0, 0.0] - v)
    return a * np.minimum(1.0, THRUST / np.maximum(np.linalg.norm(a, axis=2, keepdims=True), 1e-12))


def solids(given: Scene) -> Solids:
    """The obstacles of a scene, for a minute."""
    ends = np.array([0.0, 60.0])
    return joined(
        [
            single(ball(place, BALL), ends, np.outer(ends, w))
            for place, w in zip(given.place, given.velocity, strict=True)
        ]
    )


def prepared(given: Scene, method: str) -> tuple[Any, list[Packed]]:
    """State of a scene in the kernel, and what its avoidance is called with: flight, state, avoidance and the law."""
    things = solids(given)
    problem, work, flight, state, a = kernel(
        len(given.slots), radius=RADIUS, solids=things, separation=0.1, clearance=0.05,
        seen=sight(things, RANGE, NOISE, SWERVE), **METHODS[method],
    )  # fmt: skip
    law = [packed(problem), packed(work)]
    a.law[:] = [each.address for each in law]
    return state, [packed(flight), packed(state), packed(a), *law]


def take_least(least: Floats, x: Floats, w: Floats, rise: Floats) -> None:
    """Take the least lengths of relative parabolas (S, P, 3) into those of the scenes (S,), where they are near."""
    scenes, pairs = np.nonzero((x * x).sum(axis=2) < NEAR**2)
    if len(scenes):
        at = scenes, pairs
        np.minimum.at(least, scenes, on_parabolas(x[at], w[at], rise[at]))


def fly(scenes: list[Scene], method: str) -> Flown:
    """Fly scenes of one kind, tick by tick together; they know nothing of each other."""
    count, n, speed = len(scenes), len(scenes[0].slots), scenes[0].speed
    made, avoid = [prepared(each, method) for each in scenes], native.avoiding().avoid
    slots = np.array([each.slots for each in scenes])
    place, velocity = (np.array([each[k] for each in scenes])[:, None] for k in (2, 3))
    r, v = slots.copy(), np.zeros((count, n, 3)) + [speed, 0.0, 0.0]
    own, other = np.triu_indices(n, 1)
    least, arrived = np.full((2, count), np.inf), np.full(count, np.inf)
    cost, ticks, flying = 0.0, 0, np.arange(count)
    for k in range(int((COURSE / speed + LATER) / PERIOD)):
        t = k * PERIOD
        c = asked(r, v, slots, speed, t)
        begun = time.process_time()
        for s in flying:
            state, given = made[s]
            state.seen[:, :3], state.seen[:, 3:], state.force[:] = r[s], v[s], c[s]
            state.work.law_time[0] = t
            if not avoid(given[0].address, given[1].address, given[2].address, 0):
                raise SystemExit("too many neighbours")
            c[s] = state.force
        cost += time.process_time() - begun
        ticks += len(flying)
        assert (c[flying] ** 2).sum(axis=2).max() <= THRUST**2 * (1 + 1e-9)
        x = (r[:, :, None] - place - t * velocity)[flying]
        w, shape = (v[:, :, None] - velocity)[flying], (len(flying), -1, 3)
        rise = np.broadcast_to(c[flying, :, None], x.shape)
        found = np.full((2, len(flying)), np.inf)
        take_least(found[0], x.reshape(shape), w.reshape(shape), rise.reshape(shape))
        x, w, rise = (y[flying][:, own] - y[flying][:, other] for y in (r, v, c))
        take_least(found[1], x, w, rise)
        least[:, flying] = np.minimum(least[:, flying], found)
        r, v = r + v * PERIOD + 0.5 * c * PERIOD**2, v + c * PERIOD
        if speed * t > COURSE:
            far = np.linalg.norm(r[flying] - slots[flying] - [COURSE, 0.0, 0.0], axis=2).max(axis=1)
            arrived[flying[far < 0.3]] = t
            flying = flying[far >= 0.3]
            if not len(flying):
                break
    return Flown(least[0] - RADIUS - BALL, least[1] - 2 * RADIUS, arrived, 1e6 * cost / (ticks * n))


def row(scenes: list[Scene], fit: Any, method: str) -> str:
    """A row of the table."""
    flown = fly(scenes, method)
    least = np.minimum(flown.obstacle, flown.pair)
    hit, late = least < 0.0, flown.arrived[fit]
    closest = f"{least[fit].min():.3f}" if least[fit].min() < np.inf else "-"
    return (
        f"| {method} | {(hit & fit).sum()} | {(hit & ~fit).sum()} | {closest} |"
        f" {100 * np.isfinite(late).mean():.1f} % | {np.median(late):.1f} | {flown.cost:.1f} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", type=int, default=1000, help="scenes of each kind")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    native.avoiding()
    print(
        "| vehicles | speed [m/s] | obstacles' speed | feasible | flown with | contacts | of the infeasible"
        " | least distance [m] | arrive | median time [s] | cost [us] |"
    )
    print("|---" * 11 + "|")
    for n in (1, 8):
        for speed, fastest in SPEEDS:
            scenes = [scene(n, speed, fastest, chosen.seed + k) for k in range(chosen.scenes)]
            fit = np.array([feasible(each) for each in scenes])
            head = f"| {n} | {speed:g} | to {fastest:g} | {fit.sum()} of {len(fit)} "
            for method in METHODS:
                print(head + row(scenes, fit, method), flush=True)


if __name__ == "__main__":
    main()
