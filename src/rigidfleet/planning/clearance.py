"""The least clearance of planned paths to obstacles, in continuous time, by conservative advancement.

Between two samples a distance falls by no more than the way that is flown relative to the obstacle, and the speed of a
slot over a span of time is bounded by the coefficients of its polynomials. So a span in which there is more room than
way needs no look inside, and every other is halved.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rigidfleet.kernel.problem import Motion, Reference
from rigidfleet.math import proximity, series
from rigidfleet.mission import Obstacle
from rigidfleet.planning.derivatives import slot_derivatives
from rigidfleet.planning.preview import PlannedPhase
from rigidfleet.solids.records import Solids
from rigidfleet.typing import Floats

#: Accuracy of a planned clearance [m].
CLOSE = 1e-3
#: Greatest number of times that the time between two samples is halved, and of positions in one such step.
_HALVINGS, _OPEN = 16, 200_000
#: Greatest rate of the septic blend, 140 x^3 (1 - x)^3 at x = 1/2.
_BLEND_RATE = 140.0


def greatest_speeds(reference: Reference, motion: Motion, begin: Floats, end: Floats) -> Floats:
    """Upper bounds (L, N) [m/s] of the speed of each slot over spans of time, from ``begin`` to ``end`` (L,) [s].

    About the middle of a span of length 2 h, a polynomial with Taylor coefficients c_k has a rate of at most the sum of
    k |c_k| h^(k-1). The body turns no faster than its rotation vector changes, since the Jacobian of the exponential
    map has no singular value above 1. A slot that blends lies on a straight way, whose ends are its greatest levers.
    """
    c = motion.coefficients
    speed = _bounds(motion.knots, c[:, None, :3], begin, end)[1][:, 0]
    turning = _bounds(motion.knots, c[:, None, 3:], begin, end)[1][:, 0]
    if len(reference.knots):
        lever, rate = _bounds(reference.knots, reference.ways, begin, end)
        return speed[:, None] + turning[:, None] * lever + rate
    p0, p1 = reference.p0, reference.p0 + reference.dp
    lever = np.maximum(np.linalg.norm(p0, axis=1), np.linalg.norm(p1, axis=1))
    blending = np.zeros(len(begin))
    if reference.T_b > 0.0:
        x = np.clip((np.array([begin, end]) - reference.t0) / reference.T_b, 0.0, 1.0)
        nearest = np.clip(0.5, x[0], x[1])  # to the middle of the blend, where it is fastest
        blending = _BLEND_RATE * (nearest * (1.0 - nearest)) ** 3 / reference.T_b
    turning = turning + blending * float(np.linalg.norm(reference.turn))
    ways = np.linalg.norm(reference.dp, axis=1)
    return speed[:, None] + turning[:, None] * lever + blending[:, None] * ways


def _bounds(knots: Floats, ways: Floats, begin: Floats, end: Floats) -> tuple[Floats, Floats]:
    """Upper bounds (L, n) of size and rate of polynomials (K, n, 3, P) over spans, from ``begin`` to ``end`` (L,)."""
    first = np.clip(np.searchsorted(knots, begin, side="right") - 1, 0, len(ways) - 1)
    last = np.clip(np.searchsorted(knots, end, side="left") - 1, first, len(ways) - 1)
    size = rate = np.zeros((len(begin), ways.shape[1]))
    for k in range(int((last - first).max(initial=0)) + 1):
        piece = np.minimum(first + k, last)
        low, high = (np.clip(t, knots[piece], knots[piece + 1]) for t in (begin, end))
        half = (high - low) / 2
        x = series.of_polynomials(ways[piece], (low + high) / 2 - knots[piece], ways.shape[-1])
        powers = half ** np.arange(float(len(x)))[:, None]
        far = (np.linalg.norm(x, axis=-1) * powers[..., None]).sum(axis=0)
        fast = (np.linalg.norm(series.rate(x), axis=-1) * powers[:-1, :, None]).sum(axis=0)
        size, rate = np.maximum(size, far), np.maximum(rate, fast)
    return size, rate


def pace(planned: PlannedPhase) -> Floats:
    """Bounds (K - 1, N) [m/s] of the speeds between the samples of a planned phase."""
    leg, time = planned.leg, planned.time
    return greatest_speeds(leg.reference, leg.motion, time[:-1], time[1:])


def closest(
    planned: PlannedPhase, thing: Obstacle, radius: Floats, speed: Floats
) -> tuple[float, int, float]:
    """Least clearance [m] of a planned phase to an obstacle in continuous time, exact to `CLOSE`; agent, and time [s].

    ``speed`` is the `pace` of the phase. Where the room between two samples might not do, the plan is evaluated in the
    middle, and so on.
    """
    leg, time, moves = planned.leg, planned.time, thing.solid.moves
    met = _from_sample_to_sample(thing, time)
    each, _ = proximity.obstacle_clearances(planned.position, radius, [met], time)
    k, i = np.unravel_index(int(each.argmin()), each.shape)
    best, agent, when = float(each[k, i]), int(i), float(time[k])
    first, length = time[:-1], np.diff(time)
    near, far = each[:-1], each[1:]
    for _ in range(_HALVINGS):
        way = speed * length[:, None]
        if moves:
            way = way + _way(met, first, first + length)[:, None]
        open_ = np.flatnonzero((0.5 * (near + far - way)).min(axis=1) < best - CLOSE)
        if not len(open_) or len(open_) * each.shape[1] > _OPEN:
            break
        first, length, speed = first[open_], 0.5 * length[open_], speed[open_]
        middle = first + length
        r = slot_derivatives(leg.reference, leg.motion, middle, 1)[:, 0]
        between, _ = proximity.obstacle_clearances(r, radius, [met], middle)
        k, i = np.unravel_index(int(between.argmin()), between.shape)
        if between[k, i] < best:
            best, agent, when = float(between[k, i]), int(i), float(middle[k])
        near, far = np.concatenate([near[open_], between]), np.concatenate([between, far[open_]])
        # Samples are near each other: a bound for both halves together is hardly greater than each half's own.
        first, length = np.concatenate([first, middle]), np.tile(length, 2)
        speed = np.concatenate([speed, speed])
    return best, agent, when


class _Thing(NamedTuple):
    """An obstacle that is there from one sample to another."""

    solid: Solids


def _from_sample_to_sample(thing: Obstacle, time: Floats) -> Obstacle | _Thing:
    """The obstacle; one that appears or vanishes is taken to be there from the sample before to the one after."""
    if not np.isfinite(thing.solid.there).any():
        return thing
    since, until = thing.solid.there[0]
    first = max(int(np.searchsorted(time, since, side="right")) - 1, 0)
    last = min(int(np.searchsorted(time, until)), len(time) - 1)
    there = np.array([[min(time[first], since), max(time[last], until)]])
    return _Thing(thing.solid._replace(there=there))


def _way(thing: Obstacle | _Thing, begin: Floats, end: Floats) -> Floats:
    """Greatest way (L,) [m] of an obstacle between times (L,) [s]: its greatest speed counts wherever it moves."""
    solid = thing.solid
    speed = np.linalg.norm(np.diff(solid.ways, axis=0), axis=1) / np.diff(solid.times)
    within = (solid.times[:-1] < end[:, None]) & (solid.times[1:] > begin[:, None])
    return np.where(within, speed, 0.0).max(axis=1, initial=0.0) * (end - begin)
