"""The least clearance of planned paths to obstacles, in continuous time, by conservative advancement.

Between two samples a distance falls by no more than the way that is flown relative to the obstacle, and the speed of a
slot over a span of time is bounded by the coefficients of its polynomials. So a span in which there is more room than
way needs no look inside, and every other is halved.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from rigidfleet.kernel.problem import Motion, Reference
from rigidfleet.math import proximity, series
from rigidfleet.math.piecewise import piece_index
from rigidfleet.mission import Obstacle
from rigidfleet.planning.derivatives import reference_of_agents, slot_derivatives
from rigidfleet.planning.preview import PlannedPhase
from rigidfleet.solids.records import Solids
from rigidfleet.typing import Bools, Floats, Ints

#: Accuracy of a planned clearance [m].
CLEARANCE_ACCURACY = 1e-3
#: Greatest number of times that the time between two samples is halved, and of positions: in one step, and in all.
_HALVINGS, _AT_ONCE, _IN_ALL = 16, 200_000, 4_000_000
#: Greatest rate of the septic blend, 140 x^3 (1 - x)^3 at x = 1/2.
_BLEND_RATE = 140.0


def slot_speed_bounds(reference: Reference, motion: Motion, begin: Floats, end: Floats) -> Floats:
    """Upper bounds (L, N) [m/s] of the speed of each slot over spans of time, from ``begin`` to ``end`` (L,) [s].

    About the middle of a span of length 2 h, a polynomial with Taylor coefficients c_k has a rate of at most the sum of
    k |c_k| h^(k-1). The body turns no faster than its rotation vector changes, since the Jacobian of the exponential
    map has no singular value above 1. A slot that blends lies on a straight way, whose ends are its greatest levers.
    """
    c = motion.coefficients
    speed = _upper_bounds(motion.knots, c[:, None, :3], begin, end)[1][:, 0]
    turning = _upper_bounds(motion.knots, c[:, None, 3:], begin, end)[1][:, 0]
    if len(reference.knots):
        lever, rate = _upper_bounds(reference.knots, reference.ways, begin, end)
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


def _upper_bounds(knots: Floats, ways: Floats, begin: Floats, end: Floats) -> tuple[Floats, Floats]:
    """Upper bounds (L, n) of size and rate of polynomials (K, n, 3, P) over spans, from ``begin`` to ``end`` (L,)."""
    first = piece_index(knots, begin)
    last = np.maximum(piece_index(knots, end, "left"), first)
    size = rate = np.zeros((len(begin), ways.shape[1]))
    for k in range(int((last - first).max(initial=0)) + 1):
        piece = np.minimum(first + k, last)
        low, high = (np.clip(t, knots[piece], knots[piece + 1]) for t in (begin, end))
        half = (high - low) / 2
        x = series.polynomial_series(ways[piece], (low + high) / 2 - knots[piece], ways.shape[-1])
        powers = half ** np.arange(float(len(x)))[:, None]
        far = (np.linalg.norm(x, axis=-1) * powers[..., None]).sum(axis=0)
        fast = (np.linalg.norm(series.rate_series(x), axis=-1) * powers[:-1, :, None]).sum(axis=0)
        size, rate = np.maximum(size, far), np.maximum(rate, fast)
    return size, rate


def speed_bounds(planned: PlannedPhase) -> Floats:
    """Bounds (K - 1, N) [m/s] of the speeds between the samples of a planned phase."""
    time = planned.time
    return slot_speed_bounds(*planned.leg.slots_and_motion, time[:-1], time[1:])


class Closest(NamedTuple):
    """The least clearance of a planned phase to an obstacle in continuous time."""

    clearance: float  # [m]
    agent: int
    time: float  # [s]
    proved: float  # never less clearance [m]: to `CLEARANCE_ACCURACY` as a rule, less if that took too long


class _Spans(NamedTuple):
    """Spans of time between two positions known, of some agents."""

    first: Floats  # (L,) beginning [s]
    length: Floats  # (L,) [s]
    near: Floats  # (L, n) clearance at the beginning [m]
    far: Floats  # (L, n) and at the end [m]
    speed: Floats  # (L, n) greatest speed within [m/s]
    who: Ints  # (n,) agents
    halved: int

    def select(self, rows: Ints, columns: Ints) -> _Spans:
        """Some spans, of some of the agents."""
        both = np.ix_(rows, columns)
        kept = (x[both] for x in (self.near, self.far, self.speed))
        return _Spans(self.first[rows], self.length[rows], *kept, self.who[columns], self.halved)


def clearance_to(
    planned: PlannedPhase, thing: Obstacle, radius: Floats, speed: Floats, lost: Bools | None = None
) -> Closest:
    """Least clearance of a planned phase to an obstacle in continuous time, of all agents but the ``lost``.

    ``speed`` is the `speed_bounds` of the phase. Where the room between two samples might not do, the plan is evaluated
    in the middle, and so on.
    """
    (reference, motion), solid = planned.leg.slots_and_motion, thing.solid
    time, position = planned.time, planned.position
    if np.isfinite(solid.there).any():
        time, position, speed = _path_and_speeds(planned, *solid.there[0].tolist(), speed)
    if not len(time):
        return Closest(np.inf, 0, float(planned.time[0]), np.inf)
    each, _ = proximity.obstacle_clearances(position, radius, [thing], time)
    if lost is not None:
        each[:, lost] = np.inf
    k, i = np.unravel_index(int(each.argmin()), each.shape)
    best, agent, when = float(each[k, i]), int(i), float(time[k])
    everybody, least, done = np.arange(each.shape[1]), np.inf, 0
    # The shortest spans last, so that the time for all is not spent on some.
    todo = deque([_Spans(time[:-1], np.diff(time), each[:-1], each[1:], speed, everybody, 0)])
    while todo:
        spans = todo.popleft()
        way = spans.speed * spans.length[:, None]
        if solid.moves:
            way = way + shift_bound(solid, spans.first, spans.first + spans.length)[:, None]
        low = 0.5 * (spans.near + spans.far - way)
        open_ = low < best - CLEARANCE_ACCURACY
        if not open_.any():
            continue
        if spans.halved == _HALVINGS or done > _IN_ALL:
            least = min(least, float(low.min()))
            continue
        spans = spans.select(np.flatnonzero(open_.any(axis=1)), np.flatnonzero(open_.any(axis=0)))
        rows, columns = np.arange(len(spans.first)), np.arange(len(spans.who))
        # Not all are near at the same time.
        if len(rows) > 1 and len(rows) * len(columns) > _AT_ONCE:
            halves = np.array_split(np.argsort(spans.first, kind="stable"), 2)
            todo.extendleft(spans.select(half, columns) for half in halves)
            continue
        done += len(rows) * len(columns)
        half = 0.5 * spans.length
        middle, who = spans.first + half, spans.who
        r = slot_derivatives(reference_of_agents(reference, who), motion, middle, 1)[:, 0]
        between, _ = proximity.obstacle_clearances(r, radius[who], [thing], middle)
        k, i = np.unravel_index(int(between.argmin()), between.shape)
        if between[k, i] < best:
            best, agent, when = float(between[k, i]), int(who[i]), float(middle[k])
        # Samples are near each other: a bound for both halves together is hardly greater than each half's own.
        todo.append(
            _Spans(
                np.concatenate([spans.first, middle]), np.tile(half, 2), np.concatenate([spans.near, between]),
                np.concatenate([between, spans.far]), np.tile(spans.speed, (2, 1)), who, spans.halved + 1,
            )
        )  # fmt: skip
    return Closest(best, agent, when, min(least, best - CLEARANCE_ACCURACY))


def _path_and_speeds(
    planned: PlannedPhase, since: float, until: float, speed: Floats
) -> tuple[Floats, Floats, Floats]:
    """Times (K,) of a phase from one time to another [s], positions (K, N, 3), and speeds (K - 1, N) between them."""
    time = planned.time
    ends = np.array([max(since, time[0]), min(until, time[-1])])
    if ends[0] > ends[1]:
        return time[:0], planned.position[:0], speed[:0]
    within = (time > ends[0]) & (time < ends[1])
    first, last = slot_derivatives(*planned.leg.slots_and_motion, ends, 1)[:, :1]
    at = np.concatenate([ends[:1], time[within], ends[1:]])
    span = piece_index(time, at[:-1])
    return at, np.concatenate([first, planned.position[within], last]), speed[span]


def shift_bound(solid: Solids, begins: Floats, ends: Floats) -> Floats:
    """Greatest way (L,) [m] of a solid between times (L,) [s]: its greatest speed counts wherever it moves."""
    speed = np.linalg.norm(np.diff(solid.ways, axis=0), axis=1) / np.diff(solid.times)
    within = (solid.times[:-1] < ends[:, None]) & (solid.times[1:] > begins[:, None])
    return np.where(within, speed, 0.0).max(axis=1, initial=0.0) * (ends - begins)
