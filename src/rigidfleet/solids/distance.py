"""Signed distances to solids: exact outside and inside, for one point or for arrays of points.

Every function takes coordinates x, y, z that are numbers, or arrays of one shape. NumPy runs it on arrays. The kernel
compiles the same source for numbers (`rigidfleet.kernel.compiler.elementwise`), so there is one distance in plan,
flight and verdict. What differs between numbers and arrays is in the first functions, up to `floor`.

Points are in the solid's own axes, unless a docstring says otherwise.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rigidfleet.solids.records import CYLINDER, HEIGHTS, ROUNDED

#: A number [m], or an array of them.
Numbers = Any


def where(test: Numbers, this: Numbers, other: Numbers) -> Numbers:
    """One number where the test holds, the other elsewhere."""
    return np.where(test, this, other)


def any_true(test: Numbers) -> Any:
    """Whether the test holds for any point."""
    return np.any(test)


def pick(test: Numbers, values: Any) -> Any:
    """The values of those points alone for which the test holds; of one point, its own."""
    return tuple(np.asarray(value)[test] for value in values)


def put(test: Numbers, values: Any, picked: Any) -> Any:
    """The values with those of `pick` in their places."""
    whole = np.array(values)
    whole[:, test] = picked
    return tuple(whole)


def floor(x: Numbers) -> Any:
    """The greatest integer below."""
    return np.floor(x).astype(np.int64)


def choose_four(test: Numbers, these: Any, others: Any) -> Any:
    """Four numbers where the test holds, four others elsewhere."""
    a, b, c, d = these
    i, j, k, m = others
    return where(test, a, i), where(test, b, j), where(test, c, k), where(test, d, m)


# -- boxes, balls, half spaces -------------------------------------------------------------------------


def box_distance(x: Numbers, y: Numbers, z: Numbers, box: Any) -> Numbers:
    """Signed distance [m] from a box (6,), which may be infinite in both x and y."""
    c = np.maximum(box[2] - z, z - box[5])  # positive outside
    if not (box[0] > -math.inf or box[3] < math.inf):
        return c
    a = np.maximum(box[0] - x, x - box[3])
    b = np.maximum(box[1] - y, y - box[4])
    inside = np.minimum(np.maximum(np.maximum(a, b), c), 0.0)
    a, b, c = np.maximum(a, 0.0), np.maximum(b, 0.0), np.maximum(c, 0.0)
    return np.sqrt(a * a + b * b + c * c) + inside


def box_normal(x: Numbers, y: Numbers, z: Numbers, box: Any) -> Any:
    """Outward unit normal: away from the nearest point of a box, or inside towards its nearest face."""
    a = np.maximum(x - box[3], 0.0) - np.maximum(box[0] - x, 0.0)
    b = np.maximum(y - box[4], 0.0) - np.maximum(box[1] - y, 0.0)
    c = np.maximum(z - box[5], 0.0) - np.maximum(box[2] - z, 0.0)
    p = np.maximum(box[0] - x, x - box[3])
    q = np.maximum(box[1] - y, y - box[4])
    r = np.maximum(box[2] - z, z - box[5])
    most = np.maximum(np.maximum(p, q), r)
    inside = most <= 0.0
    along_x, along_y = inside & (p >= most), inside & (q >= most) & (p < most)
    along_z = inside & (q < most) & (p < most)
    a = where(along_x, where(box[0] - x > x - box[3], -1.0, 1.0), a)
    b = where(along_y, where(box[1] - y > y - box[4], -1.0, 1.0), b)
    c = where(along_z, where(box[2] - z > z - box[5], -1.0, 1.0), c)
    size = np.sqrt(a * a + b * b + c * c)
    return a / size, b / size, c / size


# -- cylinders -----------------------------------------------------------------------------------------


def cylinder_distance(x: Numbers, y: Numbers, z: Numbers, size: Any) -> Numbers:
    """Signed distance [m] from a cylinder along z about the origin, of radius size[0] and half length size[1]."""
    a, b = np.sqrt(x * x + y * y) - size[0], np.abs(z) - size[1]
    inside = np.minimum(np.maximum(a, b), 0.0)
    a, b = np.maximum(a, 0.0), np.maximum(b, 0.0)
    return np.sqrt(a * a + b * b) + inside


def cylinder_normal(x: Numbers, y: Numbers, z: Numbers, size: Any) -> Any:
    """Outward unit normal at the nearest point of a cylinder's surface."""
    far = np.sqrt(x * x + y * y)
    a, b = far - size[0], np.abs(z) - size[1]
    inside = np.maximum(a, b) <= 0.0
    radial = where(inside, where(a >= b, 1.0, 0.0), np.maximum(a, 0.0))
    axial = where(inside, where(a >= b, 0.0, 1.0), np.maximum(b, 0.0))
    axial = where(z < 0.0, -axial, axial)
    length = np.sqrt(radial * radial + axial * axial)
    on_axis = far <= 0.0
    across = where(on_axis, 1.0, far)
    u, v = where(on_axis, 1.0, x) / across, y / across
    return radial * u / length, radial * v / length, axial / length


# -- triangles -----------------------------------------------------------------------------------------


def vector_from_segment(x: Numbers, y: Numbers, z: Numbers, a: Any, b: Any) -> Any:
    """Vector from the nearest point of the segment between a and b (3,) to the point."""
    u, v, w = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    x, y, z = x - a[0], y - a[1], z - a[2]
    length = u * u + v * v + w * w
    if length > 0.0:
        share = np.minimum(np.maximum((x * u + y * v + z * w) / length, 0.0), 1.0)
        x, y, z = x - share * u, y - share * v, z - share * w
    return x, y, z


def edge_side(x: Numbers, y: Numbers, z: Numbers, a: Any, b: Any, normal: Any) -> Numbers:
    """Positive on the inner side of a triangle's edge from a to b (3,)."""
    u, v, w = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    x, y, z = x - a[0], y - a[1], z - a[2]
    return (v * z - w * y) * normal[0] + (w * x - u * z) * normal[1] + (u * y - v * x) * normal[2]


def facet_cross_product(t: Any) -> Any:
    """Normal of a triangle (3, 3), twice as long as its area is large."""
    e, f, g = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
    p, q, r = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
    return f * r - g * q, g * p - e * r, e * q - f * p


def triangle_vector_and_square(x: Numbers, y: Numbers, z: Numbers, t: Any) -> Any:
    """Vector from the nearest point of a triangle (3, 3) to the point, and its squared length."""
    a, b, c, n = t[0], t[1], t[2], facet_cross_product(t)
    area = n[0] * n[0] + n[1] * n[1] + n[2] * n[2]
    i, j, k = vector_from_segment(x, y, z, a, b)
    best = i * i + j * j + k * k
    for m in range(1, 3):
        u, v, w = vector_from_segment(x, y, z, t[m], t[(m + 1) % 3])
        d = u * u + v * v + w * w
        nearer = d < best
        i, j, k, best = choose_four(nearer, (u, v, w, d), (i, j, k, best))
    if area > 0.0:
        over = edge_side(x, y, z, a, b, n) >= 0.0
        over = over & (edge_side(x, y, z, b, c, n) >= 0.0) & (edge_side(x, y, z, c, a, n) >= 0.0)
        height = ((x - a[0]) * n[0] + (y - a[1]) * n[1] + (z - a[2]) * n[2]) / area
        straight = (height * n[0], height * n[1], height * n[2], height * height * area)
        i, j, k, best = choose_four(over, straight, (i, j, k, best))
    return i, j, k, best


# -- surfaces of triangles -----------------------------------------------------------------------------


def vector_from_solid_surface(x: Numbers, y: Numbers, z: Numbers, b: int, solids: Any) -> Any:
    """Vector from the nearest point of the surface of solid b, of triangles, to the point, and its squared length."""
    first, last = solids.first[b], solids.last[b]
    t = solids.triangles[first[1]]
    i, j, k = x - t[0, 0], y - t[0, 1], z - t[0, 2]
    if solids.kind[b] == HEIGHTS:  # straight below
        u, v, h = point_on_height_map(x, y, b, solids)
        i, j, k = x - u, y - v, z - h
    best = i * i + j * j + k * k
    node = first[0]
    while node < last[0]:
        far = np.maximum(box_distance(x, y, z, solids.nodes[node]), 0.0)
        near = far * far < best
        if not any_true(near):
            node = solids.after[node]
            continue
        if solids.leaf[node, 1] > 0:
            p, q, r = pick(near, (x, y, z))
            nearest = pick(near, (i, j, k, best))
            for m in range(solids.leaf[node, 0], solids.leaf[node, 1]):
                this = triangle_vector_and_square(p, q, r, solids.triangles[m])
                nearest = choose_four(this[3] < nearest[3], this, nearest)
            i, j, k, best = put(near, (i, j, k, best), nearest)
        node += 1
    return i, j, k, best


def point_on_height_map(x: Numbers, y: Numbers, b: int, solids: Any) -> Any:
    """The point (x, y, height) of a height map straight below or above the point, or its nearest rim."""
    size, first = solids.size[b], solids.first[b, 2]
    n, m = solids.grid[b, 0], solids.grid[b, 1]
    u = np.minimum(np.maximum(x, 0.0), size[3])
    v = np.minimum(np.maximum(y, 0.0), size[4])
    p, q = u / size[3] * (n - 1), v / size[4] * (m - 1)
    i, j = floor(np.minimum(p, n - 1.5)), floor(np.minimum(q, m - 1.5))
    p, q, at = p - i, q - j, first + i * m + j
    low, high = solids.heights[at], solids.heights[at + m + 1]
    lower = low + p * (solids.heights[at + m] - low) + q * (high - solids.heights[at + m])
    upper = low + q * (solids.heights[at + 1] - low) + p * (high - solids.heights[at + 1])
    return u, v, where(p >= q, lower, upper)


def is_inside(x: Numbers, y: Numbers, z: Numbers, b: int, solids: Any) -> Any:
    """Whether the point is inside a solid of triangles: a convex hull or a height map."""
    inside = box_distance(x, y, z, solids.size[b]) <= 0.0
    if not any_true(inside):
        return inside
    if solids.kind[b] == HEIGHTS:
        _, _, height = point_on_height_map(x, y, b, solids)
        return inside & (z <= height)
    for m in range(solids.first[b, 1], solids.last[b, 1]):
        t = solids.triangles[m]
        n = facet_cross_product(t)
        out = (x - t[0, 0]) * n[0] + (y - t[0, 1]) * n[1] + (z - t[0, 2]) * n[2]
        inside = inside & (out <= 0.0)
    return inside


# -- any solid -----------------------------------------------------------------------------------------


def signed_distance(x: Numbers, y: Numbers, z: Numbers, b: int, solids: Any) -> Numbers:
    """Signed distance [m] from solid b of some; negative inside."""
    kind = solids.kind[b]
    if kind == ROUNDED:
        return box_distance(x, y, z, solids.size[b]) - solids.rounding[b]
    if kind == CYLINDER:
        return cylinder_distance(x, y, z, solids.size[b])
    _, _, _, squared = vector_from_solid_surface(x, y, z, b, solids)
    away = np.sqrt(squared)
    return where(is_inside(x, y, z, b, solids), -away, away)


def outward_normal(x: Numbers, y: Numbers, z: Numbers, b: int, solids: Any) -> Any:
    """Unit gradient of the signed distance; three zeros on the surface of a hull or height map, where it is unknown."""
    kind = solids.kind[b]
    if kind == ROUNDED:
        return box_normal(x, y, z, solids.size[b])
    if kind == CYLINDER:
        return cylinder_normal(x, y, z, solids.size[b])
    i, j, k, squared = vector_from_solid_surface(x, y, z, b, solids)
    away = np.sqrt(squared)
    away = where(is_inside(x, y, z, b, solids), -away, away)
    known = squared > 0.0
    i, j, k, away = choose_four(known, (i, j, k, away), (0.0, 0.0, 0.0, 1.0))
    return i / away, j / away, k / away


def solid_displacement(t: Numbers, b: int, solids: Any) -> Any:
    """Displacement [m] of solid b at time t [s]: straight between waypoints, at rest before and after them."""
    first, last, times = solids.first[b, 3], solids.last[b, 3], solids.times
    x = y = z = 0.0 * t
    if last > first:
        x, y, z = x + solids.ways[first, 0], y + solids.ways[first, 1], z + solids.ways[first, 2]
    for k in range(first, last - 1):
        share = np.minimum(np.maximum((t - times[k]) / (times[k + 1] - times[k]), 0.0), 1.0)
        x = x + share * (solids.ways[k + 1, 0] - solids.ways[k, 0])
        y = y + share * (solids.ways[k + 1, 1] - solids.ways[k, 1])
        z = z + share * (solids.ways[k + 1, 2] - solids.ways[k, 2])
    return x, y, z


def is_solid_present(t: Numbers, b: int, solids: Any) -> Any:
    """Whether solid b is there at time t [s]: some appear, and vanish."""
    return (t >= solids.there[b, 0]) & (t <= solids.there[b, 1])


def local_point(x: Numbers, y: Numbers, z: Numbers, b: int, solids: Any) -> Any:
    """Coordinates in the axes of solid b, without its motion, of a point in the world."""
    if solids.turned[b] == 0:
        return x, y, z
    o, T = solids.origin[b], solids.turn[b]
    x, y, z = x - o[0], y - o[1], z - o[2]
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z,
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z,
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z,
    )


#: Distance by which a point is lowered to see whether a solid is below [m], and the share of it by which the point then
#: has to be nearer: slopes of up to 60 degrees.
_LOWERED, STEEP = 1e-3, 0.5


def is_solid_below(x: Numbers, y: Numbers, z: Numbers, b: int, solids: Any) -> Any:
    """Whether the nearest part of solid b is below a point of the world, so that a vehicle may stand on it.

    Nobody stands on what moves.
    """
    u, v, w = local_point(x, y, z, b, solids)
    i, j, k = local_point(x, y, z - _LOWERED, b, solids)
    still = solids.last[b, 3] == solids.first[b, 3]
    nearer = signed_distance(u, v, w, b, solids) - signed_distance(i, j, k, b, solids)
    return (nearer >= STEEP * _LOWERED) & still


#: How far below the top of a box a point still counts as on it, rather than beside it [m]: as far as what hits the top
#: goes in.
_DEEP = 1.0
#: What makes a quotient by zero infinite, and changes no other; a place beyond all solids [m].
_TINY, _FAR = 1e-200, 1e30


def height_range(x: Numbers, y: Numbers, b: int, solids: Any) -> Any:
    """Lowest and highest z [m] of solid b, a box or a height map at rest, over points (x, y) of the world.

    Where there is nothing of it, the first is above the second.
    """
    o, T, size = solids.origin[b], solids.turn[b], solids.size[b]
    x, y = where(np.isfinite(x), x, _FAR) - o[0], where(np.isfinite(y), y, _FAR) - o[1]
    if solids.turned[b] == 0 or solids.kind[b] == HEIGHTS:
        over = (x >= size[0]) & (x <= size[3]) & (y >= size[1]) & (y <= size[4])
        top = point_on_height_map(x, y, b, solids)[2] if solids.kind[b] == HEIGHTS else size[5]
        return where(over, size[2], math.inf), where(over, top, -math.inf)
    low, top = x * 0.0 - math.inf, x * 0.0 + math.inf
    for k in range(3):
        a, d = T[k, 0] * x + T[k, 1] * y - T[k, 2] * o[2], T[k, 2] + _TINY
        u, v = (size[k] - a) / d, (size[k + 3] - a) / d
        low, top = np.maximum(low, np.minimum(u, v)), np.minimum(top, np.maximum(u, v))
    return low, top


def top_of_solids_below(x: Numbers, y: Numbers, z: Numbers, solids: Any) -> Numbers:
    """Height [m] of the highest of all solids, boxes and height maps at rest, below points; minus infinity: none."""
    height = x * 0.0 - math.inf
    for b in range(solids.kind.shape[0]):
        low, top = height_range(x, y, b, solids)
        on = (low <= top) & (z >= low) & ((z >= top - _DEEP) | (solids.kind[b] == HEIGHTS))
        height = where(on, np.maximum(height, top), height)
    return height


#: The functions that the kernel compiles, each after those that it calls.
ELEMENTWISE = (
    choose_four, box_distance, box_normal, cylinder_distance, cylinder_normal,
    vector_from_segment, edge_side, facet_cross_product, triangle_vector_and_square, point_on_height_map,
    vector_from_solid_surface, is_inside, signed_distance, outward_normal, solid_displacement, is_solid_present,
    local_point, is_solid_below, height_range, top_of_solids_below,
)  # fmt: skip
