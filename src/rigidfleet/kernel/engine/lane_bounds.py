"""Bounds of what a step can reach, for eight flights in the lanes of vectors, so that few steps need the monitor.

In most steps nothing comes nearer, faster, lower or higher than in others of the same flight, and no force is greater.
Bounds from control points, and the parabolas through forces at the ends of steps by which `kernel.monitor` searches
them, say so for eight flights at once. The monitor then searches the other steps alone, and finds what it would have
found in all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rigidfleet.kernel.bernstein import CLOSE
from rigidfleet.kernel.compiler.jit import compiled, inlined
from rigidfleet.kernel.compiler.simd import (
    LaneArray,
    filled,
    inverse_root_of,
    unpack,
    where_positive,
)
from rigidfleet.kernel.records import (
    ACCELERATION,
    CLEARANCE,
    CONSTRAINT,
    CONSTRAINT_FORCE,
    HIGHEST,
    LOWEST,
    SEPARATION,
    SPEED,
    TENSION,
    THRUST,
    THRUST_MARGIN,
    Monitor,
)
from rigidfleet.typing import Ints

#: Columns of bounds over a step, and after `ENDS` more of the values at its end: separation, height, height downwards
#: and clearance [m], square of the speed [m^2/s^2]. The least counts; heights downwards and speeds have the opposite
#: sign. Then the distance of two agents seen from above [m].
SEPARATIONS, LOWS, HIGHS, CLEARANCES, SPEEDS, ENDS = range(6)
STACKS = 2 * ENDS
#: Columns of what a force promises to be near the end of a step, and after `FORCES` more of its value there: thrust,
#: acceleration, constraint force, tension, constraint, thrust beyond its limit. The greatest counts.
FIRST_FORCE, FORCES = STACKS + 1, 6
COLUMNS = FIRST_FORCE + 2 * FORCES
_QUANTITIES = np.array([SEPARATION, LOWEST, HIGHEST, CLEARANCE, SPEED])
_OF_FORCES = np.array([THRUST, ACCELERATION, CONSTRAINT_FORCE, TENSION, CONSTRAINT, THRUST_MARGIN])
_FAR = 1e100
#: Distance and share by which bounds must miss the worst value: the monitor's own accuracy, and rounding.
_MARGIN, _SHARE = 4.0 * CLOSE, 1e-9


@inlined
def _square(x, y, z):
    return x * x + y * y + z * z


@inlined
def _outside(below, above):
    """How far something is below or above an interval [m]."""
    outside = max(below, above)
    return max(outside, 0.0)


@compiled
def bound_step(points, p, row):
    """Write the bounds of a step with control points (5, n), in lanes, into row ``row`` of ``p.bounds``."""
    out, n = p.bounds[row], p.radius.shape[0]
    near, at_end, beside = filled(_FAR), filled(_FAR), filled(_FAR)
    for k in range(p.pairs.shape[0]):
        i, j = p.pairs[k, 0], p.pairs[k, 1]
        radii = p.radius[i] + p.radius[j]
        X = points[2, 3 * i] - points[2, 3 * j]
        Y = points[2, 3 * i + 1] - points[2, 3 * j + 1]
        Z = points[2, 3 * i + 2] - points[2, 3 * j + 2]
        along, level = filled(_FAR), filled(_FAR)
        x = y = z = X
        for s in range(5):
            x = points[s, 3 * i] - points[s, 3 * j]
            y = points[s, 3 * i + 1] - points[s, 3 * j + 1]
            z = points[s, 3 * i + 2] - points[s, 3 * j + 2]
            flat = X * x + Y * y
            level, along = min(level, flat), min(along, flat + Z * z)
        # The component along a fixed direction is no longer than the vector.
        near = min(near, along * inverse_root_of(_square(X, Y, Z)) - radii)
        beside = min(beside, level * inverse_root_of(X * X + Y * Y + 1e-30) - radii)
        end = _square(x, y, z)
        at_end = min(at_end, end * inverse_root_of(end) - radii)
    out[SEPARATIONS], out[ENDS + SEPARATIONS], out[STACKS] = near, at_end, beside
    low, low_end, clear, clear_end = filled(_FAR), filled(_FAR), filled(_FAR), filled(_FAR)
    high, high_end, fast, fast_end = filled(-_FAR), filled(-_FAR), filled(0.0), filled(0.0)
    for i in range(n):
        q = 3 * i
        v = 3 * n + q
        x = x0 = x1 = points[4, q]
        y = y0 = y1 = points[4, q + 1]
        z = z0 = z1 = points[4, q + 2]
        end = _square(points[4, v], points[4, v + 1], points[4, v + 2])
        fast, fast_end = max(fast, end), max(fast_end, end)
        for s in range(4):
            fast = max(fast, _square(points[s, v], points[s, v + 1], points[s, v + 2]))
            x0, x1 = min(x0, points[s, q]), max(x1, points[s, q])
            y0, y1 = min(y0, points[s, q + 1]), max(y1, points[s, q + 1])
            z0, z1 = min(z0, points[s, q + 2]), max(z1, points[s, q + 2])
        low, high = min(low, z0), max(high, z1)
        low_end, high_end = min(low_end, z), max(high_end, z)
        far, far_end = filled(_FAR), filled(_FAR)  # squares
        for b in range(p.boxes.shape[0]):
            x_low, y_low, z_low = p.boxes[b, 0], p.boxes[b, 1], p.boxes[b, 2]
            x_high, y_high, z_high = p.boxes[b, 3], p.boxes[b, 4], p.boxes[b, 5]
            # The distance of the box about the control points, and that of the end.
            a = _outside(x_low - x1, x0 - x_high)
            c = _outside(y_low - y1, y0 - y_high)
            d = _outside(z_low - z1, z0 - z_high)
            far = min(far, _square(a, c, d))
            a = _outside(x_low - x, x - x_high)
            c = _outside(y_low - y, y - y_high)
            d = _outside(z_low - z, z - z_high)
            far_end = min(far_end, _square(a, c, d))
        clear = min(clear, far * inverse_root_of(far + 1e-30) - p.radius[i])
        clear_end = min(clear_end, far_end * inverse_root_of(far_end + 1e-30) - p.radius[i])
    out[LOWS], out[ENDS + LOWS] = low, low_end
    out[HIGHS], out[ENDS + HIGHS] = 0.0 - high, 0.0 - high_end
    out[CLEARANCES], out[ENDS + CLEARANCES] = clear, clear_end
    out[SPEEDS], out[ENDS + SPEEDS] = 0.0 - fast, 0.0 - fast_end


@compiled
def begin_forces(t, p):
    """Begin with the forces at a start or after a jump, at t [s]."""
    for c in range(p.gauge.shape[0]):
        p.forces[1, c] = abs(p.gauge[c])
    p.moments[0], p.moments[1] = -math.inf, t


@compiled
def bound_forces(t, p, row, before):
    """Write the forces at the end t [s] of a step into row ``row``, and what those of the row ``before`` promise.

    As `monitor.promise` says: the top of the parabola through three values, with twice the rise that counts there.
    """
    n, m, forces = p.radius.shape[0], p.before.shape[0], p.forces
    ends, peaks = p.bounds[row, FIRST_FORCE + FORCES :], p.bounds[before, FIRST_FORCE:]
    ta, tb = p.moments[0], p.moments[1]
    for kind in range(FORCES):
        ends[kind] = filled(-_FAR)
        if ta > -math.inf:
            peaks[kind] = filled(-_FAR)
    for c in range(p.gauge.shape[0]):
        kind = c // n if c < 3 * n else 3 + (c - 3 * n) // m
        a, b, v = forces[0, c], forces[1, c], abs(p.gauge[c])
        forces[0, c], forces[1, c] = b, v
        ends[kind] = max(ends[kind], v)
        if c < n:
            ends[5] = max(ends[5], v - p.limit[c])
        if ta > -math.inf:
            left, right = (b - a) * (1.0 / (tb - ta)), (v - b) * (1.0 / (t - tb))
            bend = (left - right) * (1.0 / (t - ta))  # downwards
            off = 0.5 * left / bend - 0.5 * (tb - ta)
            top = b + 4.0 * bend * off * off
            rises = min(left, 0.0 - right) + 1e-30
            top = where_positive(rises, where_positive(bend, top, b), b)
            peaks[kind] = max(peaks[kind], top)
            if c < n:
                peaks[5] = max(peaks[5], top - p.limit[c])
    p.moments[0], p.moments[1] = tb, t


def mark_quiet(bounds: LaneArray, rows: Ints, monitors: Sequence[Monitor]) -> None:
    """Mark the steps in some rows of eight flights' trails in which none of their monitors can find anything worse.

    A step cannot hold a least value if its bound is above the least of those known and of those at the ends of steps;
    or if it is no lower than the least of those before: then an earlier step has it, up to a tenth of `CLOSE`, which
    the monitor does not tell apart. Near the end of a step no force can be greatest if neither its value there nor what
    it promises is as great as the greatest at the ends of steps; the last step has no neighbour yet.
    """
    worst = np.array([monitor.worst for monitor in monitors]).T
    known = np.concatenate([worst[_QUANTITIES], -worst[_OF_FORCES]])
    known[SPEEDS] *= np.abs(known[SPEEDS])
    quiet, calm = np.empty((2, len(rows), len(monitors)), dtype=np.bool_)
    nearest = np.empty(len(monitors))
    _mark(unpack(bounds), rows, known, known.copy(), quiet, calm, nearest)
    for lane, (monitor, near) in enumerate(zip(monitors, nearest.tolist(), strict=True)):
        # Where an agent stands, lands or takes off, what is stored depends on every step.
        landed = near <= monitor.pad + _MARGIN or len(monitor.fence) > 0
        landed = landed or monitor.standing.any() or monitor.low[:, 0].min() < np.inf
        monitor.quiet[rows] = False if landed else quiet[:, lane]
        monitor.calm[rows] = calm[:, lane]


@compiled
def _mark(bounds, rows, known, limit, quiet, calm, nearest):
    """Of bounds (R, columns, 8), the steps (S, 8) to leave out, and the least bound of the clearance (8,).

    ``known`` and ``limit`` (11, 8), which are overwritten, hold the worst values of distances and of forces.
    """
    steps, lanes = rows.shape[0], nearest.shape[0]
    for lane in range(lanes):
        nearest[lane] = _FAR
    for k in range(steps):
        found = bounds[rows[k]]
        for c in range(ENDS):
            for lane in range(lanes):
                limit[c, lane] = min(limit[c, lane], found[ENDS + c, lane])
        for c in range(FORCES):
            for lane in range(lanes):
                end = found[FIRST_FORCE + FORCES + c, lane]
                limit[ENDS + c, lane] = max(limit[ENDS + c, lane], end)
        for lane in range(lanes):
            nearest[lane] = min(nearest[lane], found[CLEARANCES, lane])
    for k in range(steps):
        found = bounds[rows[k]]
        for lane in range(lanes):
            quiet[k, lane], calm[k, lane] = found[STACKS, lane] > _MARGIN, k + 1 < steps
        for c in range(ENDS):
            for lane in range(lanes):
                bound, least, before = found[c, lane], limit[c, lane], known[c, lane]
                above = bound > least + _MARGIN + _SHARE * abs(least)
                quiet[k, lane] &= above or bound >= before - 0.1 * CLOSE
                known[c, lane] = min(before, found[ENDS + c, lane])
        for c in range(FORCES):
            for lane in range(lanes):
                peak, end = found[FIRST_FORCE + c, lane], found[FIRST_FORCE + FORCES + c, lane]
                greatest = limit[ENDS + c, lane]
                unlimited = greatest < -0.5 * _FAR  # thrust beyond a limit that is none
                calm[k, lane] &= unlimited or (peak <= greatest and end < greatest)
