"""Bounds of what a step can reach, for eight flights in the lanes of vectors, so that few steps need the monitor.

In most steps nothing comes nearer, faster, lower or higher than in others of the same flight, and no force is greater.
Bounds from control points, and the parabolas through forces at the ends of steps by which `kernel.monitor` searches
them, say so for eight flights at once. The monitor then searches the other steps alone, and finds what it would have
found in all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rigidfleet.kernel.bernstein import CLOSE
from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.compiler.simd import (
    WIDTH,
    LaneArray,
    empty,
    fill_lanes,
    inverse_root_of,
    pack,
    put,
    unpack,
    where_positive,
)
from rigidfleet.kernel.records import (
    ACCELERATION,
    CLEARANCE,
    CONSTRAINT,
    CONSTRAINT_FORCE,
    HIGHEST,
    HORIZONTAL_SPEED,
    LISTED_DISTANCES,
    LOWEST,
    SEPARATION,
    SPEED,
    TENSION,
    THRUST,
    THRUST_MARGIN,
    Monitor,
    Trail,
)
from rigidfleet.typing import Floats, Ints

#: Columns of bounds over a step: separation, height, height downwards and clearance [m], square of the speed
#: [m^2/s^2]. The least counts; heights downwards and speeds have the opposite sign. Then the distance of two agents
#: seen from above [m].
SEPARATIONS, LOWS, HIGHS, CLEARANCES, SPEEDS, DISTANCES = range(6)
STACKS = DISTANCES
#: Columns of the greater one of a force at the end of a step, and of what it promises to be near it: thrust,
#: acceleration, constraint force, tension, constraint, thrust beyond its limit. The greatest counts.
FIRST_FORCE, FORCES = STACKS + 1, 6
COLUMNS = FIRST_FORCE + FORCES
_QUANTITIES = np.array([SEPARATION, LOWEST, HIGHEST, CLEARANCE, SPEED])
_OF_FORCES = np.array([THRUST, ACCELERATION, CONSTRAINT_FORCE, TENSION, CONSTRAINT, THRUST_MARGIN])
_FAR = 1e100
#: Distance and share by which bounds must miss the worst value: the monitor's own accuracy, and rounding.
_MARGIN, _SHARE = 4.0 * CLOSE, 1e-9
#: Share of the monitor's accuracy that it does not tell apart.
_SAME = 0.1 * CLOSE


class Search(NamedTuple):
    """Steps of eight flights with bounds, and what these are computed from. Rows are those of each flight's trail."""

    clock: Floats  # (rows, 2) start and length [s]
    points: LaneArray  # (rows, 5, n) control points
    gauge: LaneArray  # (rows, 3N + 2m or 5N + 2m) forces at the end
    bounds: LaneArray  # (rows, columns)
    least: LaneArray  # (5,) least distances so far, at the ends of steps
    greatest: LaneArray  # (6,) greatest forces so far, at the ends of steps
    nearest: LaneArray  # (1,) least bound of the clearance
    radius: LaneArray  # (N,) [m]
    pairs: Ints  # (P, 2) of agents
    boxes: LaneArray  # (B, 6) obstacles [m]
    limit: LaneArray  # (N,) of thrust [N]
    # (2, 3N + 2m or 5N + 2m) sizes of the forces at the ends of the last two steps
    forces: LaneArray
    moments: Floats  # (2,) when these were [s]
    # (4, 8) addresses of each flight's control points, forces, forces at the start, and times of steps
    trails: Ints


#: No search: steps are not kept.
NO_SEARCH = Search(
    np.zeros((0, 2)), empty((0, 5, 1)), empty((0, 1)), empty((0, 1)), empty((0,)), empty((0,)), empty((0,)),
    empty((0,)), np.zeros((0, 2), dtype=np.int64), empty((0, 6)), empty((0,)), empty((2, 0)), np.zeros(2),
    np.zeros((4, WIDTH), dtype=np.int64),
)  # fmt: skip


def search(
    monitors: Sequence[Monitor], trails: Sequence[Trail], clock: Floats, limit: LaneArray
) -> Search:
    """A search of eight flights: of monitors for the same pairs and trails of the same size, with a clock (rows, 2).

    ``limit`` (N,) is that of thrust [N].
    """
    (rows, _, n), (_, forces) = trails[0].points.shape, trails[0].gauge.shape
    lanes = lambda name: pack(np.stack([getattr(x, name) for x in monitors], axis=-1))  # noqa: E731
    names = "points", "gauge", "start", "clock"
    return Search(
        clock, empty((rows, 5, n)), empty((rows, forces)), empty((rows, COLUMNS)), empty((DISTANCES,)),
        empty((FORCES,)), empty((1,)), lanes("radius"), monitors[0].pairs, lanes("boxes"), limit,
        empty((2, forces)), np.zeros(2),
        np.array([[getattr(trail, name).ctypes.data for trail in trails] for name in names]),
    )  # fmt: skip


def begin(s: Search, monitors: Sequence[Monitor]) -> None:
    """Begin with the worst values that monitors know."""
    worst = np.array([monitor.worst for monitor in monitors]).T
    least = unpack(s.least)
    least[:] = worst[_QUANTITIES]
    least[SPEEDS] *= np.abs(least[SPEEDS])
    unpack(s.greatest)[:] = -worst[_OF_FORCES]
    unpack(s.nearest)[:] = _FAR


@jit_inline
def _square(x, y, z):
    return x * x + y * y + z * z


@jit_inline
def _outside(below, above):
    """How far something is below or above an interval [m]."""
    outside = max(below, above)
    return max(outside, 0.0)


@jit_inline
def _keep(out, least, c, bound, end):
    """Write the bound of a distance over a step, ``end`` at its end; far, if an earlier step has come as near."""
    before = least[c]
    out[c] = where_positive(bound - (before - _SAME), fill_lanes(_FAR), bound)
    least[c] = min(before, end)


@jit
def bound_step(s, row):
    """Write the bounds of the step in row ``row`` of a `Search` s."""
    points, out, least, n = s.points[row], s.bounds[row], s.least, s.radius.shape[0]
    near, at_end, beside = fill_lanes(_FAR), fill_lanes(_FAR), fill_lanes(_FAR)
    for pair in range(s.pairs.shape[0]):
        i, j = s.pairs[pair, 0], s.pairs[pair, 1]
        radii = s.radius[i] + s.radius[j]
        X = points[2, 3 * i] - points[2, 3 * j]
        Y = points[2, 3 * i + 1] - points[2, 3 * j + 1]
        Z = points[2, 3 * i + 2] - points[2, 3 * j + 2]
        along, level = fill_lanes(_FAR), fill_lanes(_FAR)
        x = y = z = X
        for k in range(5):
            x = points[k, 3 * i] - points[k, 3 * j]
            y = points[k, 3 * i + 1] - points[k, 3 * j + 1]
            z = points[k, 3 * i + 2] - points[k, 3 * j + 2]
            flat = X * x + Y * y
            level, along = min(level, flat), min(along, flat + Z * z)
        # The component along a fixed direction is no longer than the vector.
        near = min(near, along * inverse_root_of(_square(X, Y, Z)) - radii)
        beside = min(beside, level * inverse_root_of(X * X + Y * Y + 1e-30) - radii)
        end = _square(x, y, z)
        at_end = min(at_end, end * inverse_root_of(end) - radii)
    _keep(out, least, SEPARATIONS, near, at_end)
    out[STACKS] = beside
    low, low_end, clear, clear_end = (
        fill_lanes(_FAR),
        fill_lanes(_FAR),
        fill_lanes(_FAR),
        fill_lanes(_FAR),
    )
    high, high_end, fast, fast_end = (
        fill_lanes(-_FAR),
        fill_lanes(-_FAR),
        fill_lanes(0.0),
        fill_lanes(0.0),
    )
    for i in range(n):
        q = 3 * i
        v = 3 * n + q
        x = x0 = x1 = points[4, q]
        y = y0 = y1 = points[4, q + 1]
        z = z0 = z1 = points[4, q + 2]
        end = _square(points[4, v], points[4, v + 1], points[4, v + 2])
        fast, fast_end = max(fast, end), max(fast_end, end)
        for k in range(4):
            fast = max(fast, _square(points[k, v], points[k, v + 1], points[k, v + 2]))
            x0, x1 = min(x0, points[k, q]), max(x1, points[k, q])
            y0, y1 = min(y0, points[k, q + 1]), max(y1, points[k, q + 1])
            z0, z1 = min(z0, points[k, q + 2]), max(z1, points[k, q + 2])
        low, high = min(low, z0), max(high, z1)
        low_end, high_end = min(low_end, z), max(high_end, z)
        far, far_end = fill_lanes(_FAR), fill_lanes(_FAR)  # squares
        for b in range(s.boxes.shape[0]):
            x_low, y_low, z_low = s.boxes[b, 0], s.boxes[b, 1], s.boxes[b, 2]
            x_high, y_high, z_high = s.boxes[b, 3], s.boxes[b, 4], s.boxes[b, 5]
            # The distance of the box about the control points, and that of the end.
            a = _outside(x_low - x1, x0 - x_high)
            c = _outside(y_low - y1, y0 - y_high)
            d = _outside(z_low - z1, z0 - z_high)
            far = min(far, _square(a, c, d))
            a = _outside(x_low - x, x - x_high)
            c = _outside(y_low - y, y - y_high)
            d = _outside(z_low - z, z - z_high)
            far_end = min(far_end, _square(a, c, d))
        clear = min(clear, far * inverse_root_of(far + 1e-30) - s.radius[i])
        clear_end = min(clear_end, far_end * inverse_root_of(far_end + 1e-30) - s.radius[i])
    _keep(out, least, LOWS, low, low_end)
    _keep(out, least, HIGHS, 0.0 - high, 0.0 - high_end)
    _keep(out, least, CLEARANCES, clear, clear_end)
    _keep(out, least, SPEEDS, 0.0 - fast, 0.0 - fast_end)
    s.nearest[0] = min(s.nearest[0], clear)


@jit
def begin_forces(t, gauge, s):
    """Begin with the forces ``gauge`` (5N + 2m,) at a start or after a jump, at t [s]."""
    for c in range(s.forces.shape[1]):
        s.forces[1, c] = abs(gauge[c])
    s.moments[0], s.moments[1] = -math.inf, t


@jit
def bound_forces(t, s, row, before):
    """Write the bounds of forces at the end t [s] of the step in row ``row``, and around that of the row ``before``.

    As `monitor.promise` says: the top of the parabola through three values, with twice the rise that counts there.
    Where accelerations by direction are watched, too, every step is searched, and bounds do not matter.
    """
    n, gauge, forces = s.radius.shape[0], s.gauge[row], s.forces
    m = (gauge.shape[0] - 3 * n) // 2
    ends, peaks = s.bounds[row, FIRST_FORCE:], s.bounds[before, FIRST_FORCE:]
    ta, tb = s.moments[0], s.moments[1]
    for kind in range(FORCES):
        ends[kind] = fill_lanes(-_FAR)
    for c in range(gauge.shape[0]):
        kind = c // n if c < 3 * n else 3 + (c - 3 * n) // m
        a, b, v = forces[0, c], forces[1, c], abs(gauge[c])
        forces[0, c], forces[1, c] = b, v
        ends[kind] = max(ends[kind], v)
        if c < n:
            ends[5] = max(ends[5], v - s.limit[c])
        if ta > -math.inf:
            left, right = (b - a) * (1.0 / (tb - ta)), (v - b) * (1.0 / (t - tb))
            bend = (left - right) * (1.0 / (t - ta))  # downwards
            off = 0.5 * left / bend - 0.5 * (tb - ta)
            top = b + 4.0 * bend * off * off
            rises = min(left, 0.0 - right) + 1e-30
            top = where_positive(rises, where_positive(bend, top, b), b)
            peaks[kind] = max(peaks[kind], top)
            if c < n:
                peaks[5] = max(peaks[5], top - s.limit[c])
    for kind in range(FORCES):
        s.greatest[kind] = max(s.greatest[kind], ends[kind])
    s.moments[0], s.moments[1] = tb, t


def list_steps(s: Search, first: int, steps: range, monitors: Sequence[Monitor]) -> None:
    """List, for eight flights' monitors, the new ``steps`` of their trails in which they can find anything worse.

    The steps of the trails, which are numbered, begin in row ``first``. Those listed are written into the trails, with
    their neighbours.

    A step cannot hold a least value if its bound is above the least of those known and of those at the ends of steps;
    or if an earlier step has come as near, up to a tenth of `CLOSE`, which the monitor does not tell apart. Near the
    end of a step no force can be greatest if neither its value there nor what it promises is as great as the greatest
    at the ends of steps; the first step of a trail has no neighbour, and the last one has none yet.
    """
    limits, margins = empty((DISTANCES + FORCES,)), empty((2,))
    listed = np.empty((WIDTH, 2, steps.stop), dtype=np.int64)
    count = np.zeros((WIDTH, 2), dtype=np.int64)
    nearest = unpack(s.nearest)[0].tolist()
    unpack(s.nearest)[:] = _FAR
    # Where an agent stands, lands or takes off, what is stored depends on every step; there are no bounds by direction.
    directed = [x.worst[HORIZONTAL_SPEED] > -math.inf for x in monitors]
    pairs = zip(nearest, monitors, strict=True)
    landed = [near <= x.pad + _MARGIN or _landing(x) for near, x in pairs]
    every = np.array([np.logical_or(landed, directed), directed]).T
    _list_steps(
        s, first, steps.start, steps.stop, every, limits, margins, unpack(margins), listed, count,
        unpack(s.points), unpack(s.gauge),
    )  # fmt: skip
    for lane, monitor in enumerate(monitors):
        distances, forces = count[lane].tolist()
        monitor.listed[0, :distances] = listed[lane, 0, :distances]
        monitor.listed[1, :forces] = listed[lane, 1, :forces]
        monitor.count[LISTED_DISTANCES:] = distances, forces


def _landing(monitor: Monitor) -> bool:
    """Whether an agent stands on an obstacle or may be landing, or there is a fence or an altitude of flight."""
    # Of few numbers, Python's own take less time than NumPy's.
    low = min(monitor.low[:, 0].tolist())
    fenced = len(monitor.fence) > 0 or monitor.altitude < math.inf
    return low < math.inf or any(monitor.standing.tolist()) or fenced


@jit
def _hand_over(s, points, gauge, first, stop, listed, count):
    """Write into each flight's trail its listed steps, and what a search for forces asks of their neighbours."""
    rows, states, forces = s.bounds.shape[0], points.shape[2], gauge.shape[1]
    for lane in range(listed.shape[0]):
        trail = s.trails[:, lane]
        for kind in range(2):
            for k in range(count[lane, kind]):
                step = listed[lane, kind, k]
                for near in range(max(step - kind, 0), min(step + kind + 1, stop)):
                    row = (first + near) % rows
                    for q in range(2):
                        put(s.clock[row, q], trail[3], 2 * row + q)
                    if near >= step:
                        for i in range(5):
                            for q in range(states):
                                place = (5 * row + i) * states + q
                                put(points[row, i, q, lane], trail[0], place)
                    for g in range(forces):
                        put(gauge[row, g, lane], trail[1], forces * row + g)


@jit
def _list_steps(
    s, first, start, stop, every, limits, margins, of_lanes, listed, count, points, gauge
):
    """Write the steps to search, for distances and for forces, into ``listed`` (8, 2, S), their number into ``count``.

    Of flights with ``every`` (8, 2), all steps, for distances and for forces. ``limits`` (11,) and ``margins`` (2,) are
    lanes to work with; ``of_lanes`` (2, 8) is a view of the latter, ``points`` (rows, 5, n, 8) and ``gauge`` (rows,
    3N + 2m or more, 8) are views of those of the search.
    """
    rows = s.bounds.shape[0]
    for c in range(DISTANCES):
        limits[c] = s.least[c] + (_MARGIN + _SHARE * abs(s.least[c]))
        if c in (SEPARATIONS, CLEARANCES):  # a first contact counts, too
            limits[c] = max(limits[c], fill_lanes(_MARGIN))
    for c in range(FORCES):  # thrust beyond a limit that is none is never greatest
        greatest = s.greatest[c]
        limits[DISTANCES + c] = where_positive(-0.5 * _FAR - greatest, fill_lanes(0.0), greatest)
    if start > 0:  # the step that has stayed
        for lane in range(listed.shape[0]):
            listed[lane, 1, 0], count[lane, 1] = 0, 1
    row = (first + start) % rows
    for step in range(start, stop):
        bounds = s.bounds[row]
        margin = bounds[STACKS] - _MARGIN
        for c in range(DISTANCES):
            margin = min(margin, bounds[c] - limits[c])
        margins[0] = margin
        margin = limits[DISTANCES] - bounds[FIRST_FORCE]
        for c in range(1, FORCES):
            margin = min(margin, limits[DISTANCES + c] - bounds[FIRST_FORCE + c])
        margins[1] = margin
        for lane in range(listed.shape[0]):
            if every[lane, 0] or not of_lanes[0, lane] > 0.0:
                listed[lane, 0, count[lane, 0]] = step
                count[lane, 0] += 1
            if every[lane, 1] or not of_lanes[1, lane] > 0.0 or step in (0, stop - 1):
                listed[lane, 1, count[lane, 1]] = step
                count[lane, 1] += 1
        row = row + 1 if row + 1 < rows else 0
    _hand_over(s, points, gauge, first, stop, listed, count)
