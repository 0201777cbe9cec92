"""Distances of points and segments from each other and from convex solids, at a moment."""

import math

from rigidfleet.kernel.compiler import elementwise  # noqa: F401 -- the functions of numbers below
from rigidfleet.kernel.compiler.jit import jit
from rigidfleet.solids.distance import local_point, outward_normal, signed_distance

#: Greatest number of tangents by which the nearest point of a segment to an obstacle is sought.
_TANGENTS = 40
#: Greatest number of steps by which the distance of two hulls is sought.
_STEPS = 100


@jit
def obstacle_distance(x, y, z, o, solids, normal):
    """Signed distance [m] of a point from obstacle o, as it stands without motion; writes its gradient (3,)."""
    x, y, z = local_point(x, y, z, o, solids)
    u, v, w = outward_normal(x, y, z, o, solids)
    normal[0], normal[1], normal[2] = u, v, w
    if solids.turned[o] != 0:
        T = solids.turn[o]
        for q in range(3):
            normal[q] = T[0, q] * u + T[1, q] * v + T[2, q] * w
    return signed_distance(x, y, z, o, solids)


@jit
def segment_distance(p, q, r, s):
    """Least distance [m] between the segments from p to q and from r to s (3,); Ericson 2005, section 5.1.9."""
    d0, d1, d2 = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    e0, e1, e2 = s[0] - r[0], s[1] - r[1], s[2] - r[2]
    x, y, z = p[0] - r[0], p[1] - r[1], p[2] - r[2]
    dd, ee = d0 * d0 + d1 * d1 + d2 * d2, e0 * e0 + e1 * e1 + e2 * e2
    f, c = e0 * x + e1 * y + e2 * z, d0 * x + d1 * y + d2 * z
    a, b = 0.0, 0.0
    if dd <= 1e-24:
        b = min(max(f / ee, 0.0), 1.0) if ee > 1e-24 else 0.0
    elif ee <= 1e-24:
        a = min(max(-c / dd, 0.0), 1.0)
    else:
        de = d0 * e0 + d1 * e1 + d2 * e2
        area = dd * ee - de * de
        if area > 1e-12 * dd * ee:
            a = min(max((de * f - c * ee) / area, 0.0), 1.0)
        b = (de * a + f) / ee
        if b < 0.0:
            b, a = 0.0, min(max(-c / dd, 0.0), 1.0)
        elif b > 1.0:
            b, a = 1.0, min(max((de - c) / dd, 0.0), 1.0)
    x, y, z = x + a * d0 - b * e0, y + a * d1 - b * e1, z + a * d2 - b * e2
    return math.sqrt(x * x + y * y + z * z)


@jit
def hull_gap(p, p_third, p_more, q, q_third, q_more, enough, x):
    """Least distance [m] between the hulls of p[0], p[1], p[p_third], p_more (2, 3) and of q likewise; x (3,): work.

    Gilbert's algorithm on the differences of points (SIAM J. Control 4, 1966): a lower bound, exact to 1e-9 unless it
    is certain to be at least, or below, ``enough`` (NaN: always), or after many steps: then it is low
    by some hundredths of their size at most.
    """
    for k in range(3):
        x[k] = p_more[0, k] - q_more[0, k]
    bound = 0.0
    for _ in range(_STEPS):
        size = math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
        if size < enough or size == 0.0:
            return size
        near, far = math.inf, -math.inf
        u, w = p_more[0], q_more[0]
        for k in range(5):
            y = p_more[k - 3] if k > 2 else p[p_third if k == 2 else k]
            along = x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
            if along < near:
                near, u = along, y
            y = q_more[k - 3] if k > 2 else q[q_third if k == 2 else k]
            along = x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
            if along > far:
                far, w = along, y
        bound = max(bound, (near - far) / size)
        if bound >= enough or size - bound <= 1e-9:
            break
        y0, y1, y2 = u[0] - w[0] - x[0], u[1] - w[1] - x[1], u[2] - w[2] - x[2]
        length = y0 * y0 + y1 * y1 + y2 * y2
        share = min(max(-(x[0] * y0 + x[1] * y1 + x[2] * y2) / length, 0.0), 1.0)
        x[0], x[1], x[2] = x[0] + share * y0, x[1] + share * y1, x[2] + share * y2
    return bound


@jit
def segment_distance_and_slope(p, q, x, o, solids, normal):
    """Distance of a point at a share x of a segment from obstacle o, and its rate along it; writes the normal."""
    u, v, w = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    value = obstacle_distance(p[0] + x * u, p[1] + x * v, p[2] + x * w, o, solids, normal)
    return value, normal[0] * u + normal[1] * v + normal[2] * w


@jit
def segment_obstacle_bounds(p, q, o, solids, enough, normal):
    """Distance of the segment from p to q (3,) from obstacle o: a lower bound, and a place near the nearest point.

    The distance to a convex obstacle is convex along the segment, so that it lies above its tangents. The bound is
    exact, to rounding, unless it is certain to be at least, or below, ``enough`` (NaN: always). Returns the bound, the
    distance at a share of the segment, and this share, for which ``normal`` (3,) is that of a supporting plane.
    """
    high, falls = segment_distance_and_slope(p, q, 1.0, o, solids, normal)
    if falls <= 0.0:
        return high, high, 1.0
    low, rises = segment_distance_and_slope(p, q, 0.0, o, solids, normal)
    if rises >= 0.0:
        return low, low, 0.0
    a, b = 0.0, 1.0
    bound, value, x = low + rises, low, 0.0
    for _ in range(_TANGENTS):
        x = min(max((high - low + rises * a - falls * b) / (rises - falls), a), b)
        bound = low + rises * (x - a)
        value, rate = segment_distance_and_slope(p, q, x, o, solids, normal)
        if bound >= enough or value < enough or value - bound <= 1e-13:
            break
        if rate < 0.0:
            a, low, rises = x, value, rate
        else:
            b, high, falls = x, value, rate
    return bound, value, x


@jit
def refined_obstacle_distance(p, q, o, solids, need, normal):
    """Distance of the segment from p to q (3,) from obstacle o: exact below ``need``, else a lower bound."""
    kept, _, _ = segment_obstacle_bounds(p, q, o, solids, need, normal)
    if kept < need:
        kept, _, _ = segment_obstacle_bounds(p, q, o, solids, math.nan, normal)
    return kept


@jit
def least_value(x, rate, rise, T):
    """Least value of x + rate t + rise t^2 / 2 over [0, T]."""
    least = min(x, x + T * (rate + 0.5 * T * rise))
    if rise > 0.0 and -rise * T < rate < 0.0:
        least = x - 0.5 * rate * rate / rise
    return least
