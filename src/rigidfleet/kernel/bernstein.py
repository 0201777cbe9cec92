"""Least values of polynomials and curves in Bernstein form over [0, 1], and where they lie.

A polynomial in Bernstein form lies in the convex hull of its coefficients (control points), so the least coefficient
bounds it from below. If the bound of a piece is no better than the least value so far, the piece is done. Otherwise it
is halved by de Casteljau's algorithm, until the bound of each piece is within `ACCURACY` of an attained value. Squared
distances of two agents are polynomials of eighth degree. The distance to a box is convex and nowhere below its tangent
plane, so the least coefficient along the plane's normal bounds it.
"""

import math

import numpy as np

from rigidfleet.kernel.compiler import elementwise  # noqa: F401 -- the functions of numbers below
from rigidfleet.kernel.compiler.jit import jit
from rigidfleet.solids.distance import box_distance, box_normal

#: Accuracy of a least value [m, m/s].
ACCURACY = 1e-9
#: Length of the shortest piece of a step.
_SHORTEST = 2.0**-32
#: Maximum number of pieces examined per step.
_MOST = 10_000
#: Rounding error, as a share of a number's size.
_ROUNDING = 4e-15

#: Coefficients of a square: C(4, i) C(4, j) / C(8, i + j).
_SQUARE = np.array(
    [[math.comb(4, i) * math.comb(4, j) / math.comb(8, i + j) for j in range(5)] for i in range(5)]
)


@jit
def least_polynomial_value(work, degree, to_beat):
    """Least value of a polynomial over [0, 1] and its place, if below ``to_beat``; otherwise ``to_beat`` and -1.

    ``work[0]`` holds the Bernstein coefficients. The value is exact to `ACCURACY` and rounding; for squares, of eighth
    degree, its root is. After `_MOST` pieces, more than any known flight needs, the bound itself is returned, which
    errs on the safe side.
    """
    best, at, top, pieces, size = to_beat, -1.0, 0, 0, 0.0
    start, width = degree + 1, degree + 2
    work[0, start], work[0, width] = 0.0, 1.0
    for k in range(degree + 1):
        size = max(size, abs(work[0, k]))
    while top >= 0:
        piece, pieces = work[top], pieces + 1
        bound, value = piece[0], piece[0]
        for k in range(1, degree + 1):
            bound = min(bound, piece[k])
        if piece[degree] < value:
            value = piece[degree]
            if value < best:
                best, at = value, piece[start] + piece[width]
        elif value < best:
            best, at = value, piece[start]
        # Of a square s, an error e of its root is an error 2 e sqrt(s) + e^2 of s.
        close = ACCURACY
        if degree == 8:
            close = ACCURACY * (2.0 * math.sqrt(min(abs(best), size)) + ACCURACY)
        close = max(close, _ROUNDING * size)
        if bound < best - close and pieces > _MOST:
            best, at = bound, piece[start]
        if not bound < best - close or piece[width] <= _SHORTEST:
            top -= 1
            continue
        # De Casteljau: the first numbers of all levels are the left half, what is left of the last one the right.
        left = work[top + 1]
        half = 0.5 * piece[width]
        left[start], left[width] = piece[start], half
        piece[start] += half
        piece[width] = half
        left[0] = piece[0]
        for k in range(1, degree + 1):
            for i in range(degree + 1 - k):
                piece[i] = 0.5 * (piece[i] + piece[i + 1])
            left[k] = piece[0]
        top += 1
    return best, at


@jit
def halve_curve(piece, left):
    """Halve a curve (15 control points, start and width): write its first half into ``left``, keep the second."""
    half = 0.5 * piece[16]
    left[15], left[16] = piece[15], half
    piece[15] += half
    piece[16] = half
    for q in range(3):
        left[q] = piece[q]
    for k in range(1, 5):
        for i in range(5 - k):
            for q in range(3):
                piece[3 * i + q] = 0.5 * (piece[3 * i + q] + piece[3 * i + 3 + q])
        for q in range(3):
            left[3 * k + q] = piece[q]


@jit
def write_squared_norm_coefficients(points, sign, out):
    """Bernstein coefficients (9,) of sign |r|^2 of a curve with control points (15,)."""
    for k in range(9):
        out[k] = 0.0
    for i in range(5):
        for j in range(5):
            dot = 0.0
            for q in range(3):
                dot += points[3 * i + q] * points[3 * j + q]
            out[i + j] += sign * _SQUARE[i, j] * dot


@jit
def norm_at(points, x):
    """|r| of a curve with control points (15,) at x."""
    rest, total = 1.0 - x, 0.0
    for q in range(3):
        value = rest**4 * points[q] + x**4 * points[12 + q]
        value += 4.0 * x * rest * (rest * rest * points[3 + q] + x * x * points[9 + q])
        value += 6.0 * x * x * rest * rest * points[6 + q]
        total += value * value
    return math.sqrt(total)


@jit
def ball_radius(curve):
    """Radius [m] of the ball about the middle one of control points (5, 3) that holds all."""
    far = 0.0
    for k in range(5):
        x, y, z = curve[k, 0] - curve[2, 0], curve[k, 1] - curve[2, 1], curve[k, 2] - curve[2, 2]
        far = max(far, x * x + y * y + z * z)
    return math.sqrt(far)


@jit
def bernstein_at(x):
    """The five Bernstein polynomials of fourth degree at x."""
    y = 1.0 - x
    return y**4, 4.0 * x * y**3, 6.0 * x * x * y * y, 4.0 * x**3 * y, x**4


@jit
def point_at(curve, x):
    """Point of a curve with control points (5, 3) at x."""
    a, b, c, d, e = bernstein_at(x)
    return (
        a * curve[0, 0] + b * curve[1, 0] + c * curve[2, 0] + d * curve[3, 0] + e * curve[4, 0],
        a * curve[0, 1] + b * curve[1, 1] + c * curve[2, 1] + d * curve[3, 1] + e * curve[4, 1],
        a * curve[0, 2] + b * curve[1, 2] + c * curve[2, 2] + d * curve[3, 2] + e * curve[4, 2],
    )


@jit
def least_norm_of_curve(to_beat, work, pieces):
    """Least |r| of a curve and its place, if below ``to_beat``; else ``to_beat`` and -1.

    The curve's control points (15,) are ``pieces[0]``.

    Rounding of a squared length of some metres hides lengths of a millimetre. Therefore both halves of a long piece
    are examined again once their least length is roughly known.
    """
    best, at, top, count = to_beat, -1.0, 0, 0
    start_piece_stack(pieces)
    while top >= 0:
        piece, count = pieces[top], count + 1
        middle, along, size = 0.0, math.inf, 0.0
        for q in range(3):
            middle += piece[6 + q] * piece[6 + q]
        for k in range(5):
            dot, far = 0.0, 0.0
            for q in range(3):
                dot += piece[6 + q] * piece[3 * k + q]
                far += piece[3 * k + q] * piece[3 * k + q]
            along, size = min(along, dot), max(size, far)
        top -= 1
        # All control points lie beyond a plane across the middle one that is farther than the best length.
        if middle > 0.0 and not along < best * math.sqrt(middle):
            continue
        start = norm_at(piece, 0.0)
        if start < best:
            best, at = start, piece[15]
        write_squared_norm_coefficients(piece, 1.0, work[0])
        _, place = least_polynomial_value(work, 8, best * best)
        if place >= 0.0:
            length = norm_at(piece, place)
            if length < best:
                best, at = length, piece[15] + place * piece[16]
        close = max(ACCURACY, _ROUNDING * math.sqrt(size))  # the accuracy that rounding allows
        known = _ROUNDING * size <= close * max(2.0 * best, 1e-5)
        if count > _MOST and not known and along < best * math.sqrt(middle):
            best, at = along / math.sqrt(middle), piece[15]
        elif not known and piece[16] > _SHORTEST:
            halve_curve(piece, pieces[top + 2])
            top += 2
    return best, at


@jit
def distance_bound_by_plane(piece, distance, x, y, z):
    """Lower bound of the distance between a curve with control points (15,) and something convex.

    The tangent plane at the nearest point to any point bounds it; the middle control point is near the curve. The plane
    is given by that point's ``distance`` and its unit normal; where the normal is not known, three zeros, the extent of
    the curve takes its place.
    """
    least, known = 0.0, x != 0.0 or y != 0.0 or z != 0.0
    for k in range(0, 15, 3):
        dx, dy, dz = piece[k] - piece[6], piece[k + 1] - piece[7], piece[k + 2] - piece[8]
        along = x * dx + y * dy + z * dz
        least = min(least, along if known else -math.sqrt(dx * dx + dy * dy + dz * dz))
    return distance + least


@jit
def gap_and_normal(x, y, z, b, _, boxes):
    """Signed distance of a point from box b, negative inside, and the normal of its tangent plane."""
    nx, ny, nz = box_normal(x, y, z, boxes[b])
    return box_distance(x, y, z, boxes[b]), nx, ny, nz


@jit
def halve_or_prune_piece(bound, best, at, close, count, top, pieces):
    """Halve the piece on top of the stack if its lower bound may be below the best value, else drop it.

    After `_MOST` pieces, the bound itself is taken. Returns the best value, its place, and the new top.
    """
    piece = pieces[top]
    if bound < best - close:
        if count > _MOST:
            return bound, piece[15], top - 1
        if piece[16] > _SHORTEST:
            halve_curve(piece, pieces[top + 1])
            return best, at, top + 1
    return best, at, top - 1


@jit
def start_piece_stack(pieces):
    """Start a stack with the curve ``pieces[0]`` (15 control points); returns the accuracy that its rounding allows."""
    close = ACCURACY
    for k in range(15):
        close = max(close, _ROUNDING * abs(pieces[0, k]))
    pieces[0, 15], pieces[0, 16] = 0.0, 1.0
    return close


@jit
def distance_to_box(curve, b, part, to_beat, pieces, boxes):
    """Least distance of a curve with control points (5, 3) from box b, if below ``to_beat``, and its place; else -1.

    `obstacles` makes of this source the same for any solid, or a ``part`` of one, by another `gap_and_normal`.
    """
    for k in range(5):
        for q in range(3):
            pieces[0, 3 * k + q] = curve[k, q]
    best, at, top, count, close = to_beat, -1.0, 0, 0, start_piece_stack(pieces)
    while top >= 0:
        piece, count = pieces[top], count + 1
        distance, x, y, z = gap_and_normal(piece[6], piece[7], piece[8], b, part, boxes)
        bound = distance_bound_by_plane(piece, distance, x, y, z)
        if bound < best - close:
            for k in (0, 12):
                distance, _, _, _ = gap_and_normal(
                    piece[k], piece[k + 1], piece[k + 2], b, part, boxes
                )
                if distance < best:
                    best, at = distance, piece[15] + (piece[16] if k == 12 else 0.0)
        best, at, top = halve_or_prune_piece(bound, best, at, close, count, top, pieces)
    return best, at


@jit
def least_height_in_cylinder(reach, to_beat, pieces):
    """Least |z| of a curve with control points ``pieces[0]`` while within ``reach`` of the z axis, and its place."""
    best, at, top, count, close = to_beat, -1.0, 0, 0, start_piece_stack(pieces)
    while top >= 0:
        piece, count = pieces[top], count + 1
        for k in (0, 4):
            x, y, z = piece[3 * k], piece[3 * k + 1], abs(piece[3 * k + 2])
            if x * x + y * y <= reach * reach and z < best:
                best, at = z, piece[15] + (piece[16] if k == 4 else 0.0)
        x, y = piece[6], piece[7]
        along, low, high = math.inf, math.inf, -math.inf
        for k in range(5):
            along = min(along, x * piece[3 * k] + y * piece[3 * k + 1])
            low, high = min(low, piece[3 * k + 2]), max(high, piece[3 * k + 2])
        apart = along > reach * math.sqrt(x * x + y * y)
        bound = math.inf if apart else max(0.0, low, -high)
        if bound < best - close and piece[16] <= _SHORTEST:
            best, at = bound, piece[15]  # at the limit of an overlap: count it as one
        best, at, top = halve_or_prune_piece(bound, best, at, close, count, top, pieces)
    return best, at


@jit
def least_norm_above(own, other, altitude, to_beat, pieces):
    """Least |r| of a curve ``pieces[0]`` while one of two others (5, 3) is at z >= ``altitude``, and its place."""
    best, at, top, count, close, rate = to_beat, -1.0, 0, 0, start_piece_stack(pieces), 0.0
    for k in range(1, 5):
        rate = max(rate, abs(own[k, 2] - own[k - 1, 2]), abs(other[k, 2] - other[k - 1, 2]))
    while top >= 0:
        piece, count = pieces[top], count + 1
        a, b, c = piece[6], piece[7], piece[8]
        middle, along, high = math.sqrt(a * a + b * b + c * c), math.inf, -math.inf
        for k in range(5):
            u, v, w = piece[3 * k], piece[3 * k + 1], piece[3 * k + 2]
            along = min(along, a * u + b * v + c * w)
            if k % 4 == 0:
                x, far = piece[15] + 0.25 * k * piece[16], math.sqrt(u * u + v * v + w * w)
                z = max(point_at(own, x)[2], point_at(other, x)[2])
                high = max(high, z)
                if z >= altitude and far < best:
                    best, at = far, x
        # Between its ends, a height rises above the higher one by at most half of its greatest change.
        bound = max(along / middle, 0.0) if middle > 0.0 else 0.0
        if high + 2.0 * rate * piece[16] < altitude:
            bound = math.inf
        best, at, top = halve_or_prune_piece(bound, best, at, close, count, top, pieces)
    return best, at


@jit
def write_bernstein_basis(x, out):
    """Write the Bernstein polynomials (5,) of fourth degree at x."""
    out[0], out[1], out[2], out[3], out[4] = bernstein_at(x)
