"""Obstacles that move: random scenes flown with flow alone, with barriers and guard, and with all three.

One vehicle, or eight as a cube, fly straight along x and track their slots. Two balls cross their course at random,
about where and when the vehicles pass. They are seen within RANGE alone, with noise, and known by the Kalman filter of
the kernel. Accelerations are at most 5 m/s^2. Least distances are those in continuous time: commands are held, so that
relative paths are parabolas between ticks.

A scene counts as feasible by a criterion that knows nothing of any of these methods: every vehicle has an *escape*, a
way among both balls at once, SPARE away from them and from the escapes of the others. Vehicles fly undisturbed until a
ball can be known: SETTLE after the first moment at which one of them has it within RANGE. From then on each escapes
with one of 27 constant accelerations: SHARE of the greatest one in 26 directions, or none. It is held for HELD, or
until the second ball can be known, when another one may begin; then the vehicle goes on straight. That is watched for
AHEAD. So an escape needs no more thrust than there is, takes no heed of a ball before it is known, and need not lead
back to the slots.

    python benchmarks/moving.py [--scenes 1000] [--seed 0]
"""

from __future__ import annotations

import argparse
import time
from typing import Any, NamedTuple

import numpy as np
from crowds import PERIOD, THRUST, kernel, on_parabolas

from rigidfleet.kernel.avoidance import candidate_accelerations, initial_sight
from rigidfleet.kernel.engine import native
from rigidfleet.kernel.engine.packing import Packed, pack
from rigidfleet.solids.records import Solids, ball, join_solids, one_solid
from rigidfleet.typing import Floats

#: Speeds of vehicles, and greatest speeds of obstacles [m/s].
SPEEDS = ((2.0, 2.0), (2.0, 6.0), (5.0, 6.0))
#: Radii of vehicles and obstacles, length of the course, edge of the cube [m].
RADIUS, BALL, COURSE, EDGE = 0.3, 0.7, 24.0, 3.0
#: Sensing range, its noise [m], acceleration of obstacles that is reckoned with [m/s^2].
RANGE, NOISE, SWERVE = 10.0, 0.05, 0.2
#: The criterion: time until a ball that is seen is known [s], share of the acceleration, for how long [s], what to keep
#: [m], for how long [s], at times so far apart [s].
SETTLE, SHARE, HELD, SPARE, AHEAD, LOOK = 0.3, 0.6, 1.5, 0.1, 6.0, 0.04
#: Distance of centres below which distances are taken [m].
NEAR = 1.5
#: Time for which a flight goes on after its slots have arrived [s].
LATER = 12.0
#: Methods: what `kernel.avoidance.avoidance_arrays` is asked for.
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


def bend(s: Floats, held: float) -> Floats:
    """Displacement by an acceleration of 1 m/s^2 that begins at s = 0 [s] and is held for some time [m]."""
    part = np.clip(s, 0.0, held)
    return part * (s - 0.5 * part)


def escapes(given: Scene) -> tuple[Any, Floats]:
    """Which manoeuvres keep each vehicle clear of all balls (K, n), and their displacements (K, T, 3) [m]."""
    fly = np.array([given.speed, 0.0, 0.0])
    t = np.arange(0.0, COURSE / given.speed + AHEAD, LOOK)
    gap = given.slots[:, None] - given.place  # (n, 2, 3)
    x = gap[:, :, None] + t[:, None] * (fly - given.velocity)[:, None]  # (n, 2, T, 3), undisturbed
    away = np.linalg.norm(x, axis=3).min(axis=0) - BALL
    known = np.sort([t[np.argmax(each <= RANGE)] for each in away if (each <= RANGE).any()])
    known += SETTLE
    t = t[t <= max(known, default=0.0) + AHEAD]
    push = (
        np.concatenate([candidate_accelerations()[-1:], candidate_accelerations()[:26]])
        * SHARE
        * THRUST
    )
    shift = np.zeros((1, len(t), 3))
    for begin, held in zip(known, [*np.minimum(np.diff(known), HELD), HELD], strict=False):
        own = push[:, None] * bend(t - begin, held)[:, None]
        shift = (shift[:, None] + own).reshape(-1, len(t), 3)
    clear, size = np.ones((len(shift), len(given.slots)), dtype=bool), (shift**2).sum(axis=2)
    for i in range(len(given.slots)):
        for path in x[i, :, : len(t)]:
            square = size + 2.0 * np.einsum("ktq,tq->kt", shift, path) + (path**2).sum(axis=1)
            clear[:, i] &= square.min(axis=1) > (RADIUS + BALL + SPARE) ** 2
    return clear, shift


def feasible(given: Scene) -> bool:
    """Whether all vehicles have escapes that keep apart from each other; see above."""
    clear, shift = escapes(given)
    if not clear.any(axis=0).all():
        return False
    if clear.all(axis=1).any():  # the same for all: they stay a cube
        return True
    chosen: list[Floats] = []
    for i, slot in enumerate(given.slots):  # the first that keeps apart from those before
        paths = slot + shift[clear[:, i]]
        for other in chosen:
            paths = paths[np.linalg.norm(paths - other, axis=2).min(axis=1) > 2 * RADIUS + SPARE]
        if not len(paths):
            return False
        chosen.append(paths[0])
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
    return join_solids(
        [
            one_solid(ball(place, BALL), ends, np.outer(ends, w))
            for place, w in zip(given.place, given.velocity, strict=True)
        ]
    )


def prepared(given: Scene, method: str) -> tuple[Any, list[Packed]]:
    """State of a scene in the kernel, and what its avoidance is called with: flight, state, avoidance and the law."""
    things = solids(given)
    problem, work, flight, state, a = kernel(
        len(given.slots), radius=RADIUS, solids=things, separation=0.1, clearance=0.05,
        seen=initial_sight(things, RANGE, NOISE, SWERVE), **METHODS[method],
    )  # fmt: skip
    law = [pack(problem), pack(work)]
    a.law[:] = [each.address for each in law]
    return state, [pack(flight), pack(state), pack(a), *law]


def take_least(least: Floats, x: Floats, w: Floats, rise: Floats) -> None:
    """Take the least lengths of relative parabolas (S, P, 3) into those of the scenes (S,), where they are near."""
    scenes, pairs = np.nonzero((x * x).sum(axis=2) < NEAR**2)
    if len(scenes):
        at = scenes, pairs
        np.minimum.at(least, scenes, on_parabolas(x[at], w[at], rise[at]))


def fly(scenes: list[Scene], method: str) -> Flown:
    """Fly scenes of one kind, tick by tick together; they know nothing of each other."""
    count, n, speed = len(scenes), len(scenes[0].slots), scenes[0].speed
    made, avoid = [prepared(each, method) for each in scenes], native.library("avoidance").avoid
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
    native.library("avoidance")
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
