"""Solids as arrays: a few primitive kinds, in which every obstacle of a mission is expressed.

A solid is given in its own axes, and placed by an origin, a turn and a motion without turning. Boxes, half spaces and
balls are *rounded boxes*: all points within a distance of a box, which may be infinite or a single point. Convex hulls
and height maps are closed surfaces of triangles, sorted into a tree of boxes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.typing import Floats, Ints

#: Kinds of solids.
ROUNDED, CYLINDER, HULL, HEIGHTS = range(4)
#: Greatest number of triangles in a leaf of a tree.
_LEAF = 6


class Solids(NamedTuple):
    """B solids with M nodes, T triangles, H heights and W waypoints of all together.

    The first axis of `first` and `last` counts the solid's nodes, triangles, heights and waypoints.
    """

    kind: Ints  # (B,)
    origin: Floats  # (B, 3) origin of the solid's own axes in the world, without motion [m]
    turn: Floats  # (B, 3, 3) from world axes to the solid's own
    turned: Ints  # (B,) 1 if origin or turn are not those of the world
    size: Floats  # (B, 6) lowest and highest corner [m]; of a cylinder radius and half its length
    rounding: Floats  # (B,) radius by which a box is rounded [m]
    first: Ints  # (B, 4) index of the first node, triangle, height, waypoint
    last: Ints  # (B, 4) index after the last one
    grid: Ints  # (B, 2) number of heights along x and y
    nodes: Floats  # (M, 6) corners of the boxes of a tree, parents before children [m]
    after: Ints  # (M,) the node to continue with when a node is far
    leaf: Ints  # (M, 2) triangles of a node: the first, and after the last; none: an inner node
    triangles: Floats  # (T, 3, 3) corners [m]
    heights: Floats  # (H,) [m]
    there: Floats  # (B, 2) times from which and until which it is there [s]; infinite: always
    times: Floats  # (W,) of waypoints, increasing [s]
    ways: Floats  # (W, 3) displacement at these times [m]

    @property
    def moves(self) -> bool:
        """Whether any solid moves."""
        return len(self.times) > 0


class Form(NamedTuple):
    """A solid without motion: the fields of `Solids`, of one."""

    kind: int
    origin: Floats
    turn: Floats
    size: Sequence[float]
    rounding: float = 0.0
    triangles: Floats = np.zeros((0, 3, 3))
    heights: Floats = np.zeros((0, 0))


#: Times from which and until which a solid is there that always is [s].
ALWAYS = (-math.inf, math.inf)
_UPRIGHT = np.eye(3)
_MIDDLE = np.zeros(3)


def box(low: ArrayLike, high: ArrayLike, turn: Floats | None = None) -> Form:
    """A box between two corners (3,) [m], or turned about its centre: ``turn`` from world axes to its own."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    if turn is None:
        return Form(ROUNDED, _MIDDLE, _UPRIGHT, [*low, *high])
    half = (high - low) / 2
    return Form(ROUNDED, (low + high) / 2, turn, [*-half, *half])


def half_space(height: float) -> Form:
    """Everything below a height [m]."""
    return Form(ROUNDED, _MIDDLE, _UPRIGHT, [*(-math.inf,) * 3, math.inf, math.inf, height])


def ball(centre: ArrayLike, radius: float) -> Form:
    """A ball."""
    return Form(ROUNDED, np.asarray(centre, dtype=float), _UPRIGHT, [0.0] * 6, radius)


def cylinder(ends: ArrayLike, radius: float) -> Form:
    """A solid cylinder between the centres of its ends (2, 3) [m]."""
    a, b = np.asarray(ends, dtype=float)
    length = float(np.linalg.norm(b - a))
    z = (b - a) / length
    x = np.cross(np.eye(3)[int(np.abs(z).argmin())], z)
    x /= np.linalg.norm(x)
    turn = np.array([x, np.cross(z, x), z])
    return Form(CYLINDER, (a + b) / 2, turn, [radius, length / 2, 0, 0, 0, 0])


def hull(points: ArrayLike) -> Form:
    """The convex hull of points (P, 3) [m], about their mean.

    Raises
    ------
    ValueError
        The points lie in a plane, or nearly so.
    """
    from scipy.spatial import ConvexHull, QhullError

    points = np.asarray(points, dtype=float)
    origin = points.mean(axis=0)
    about = points - origin
    try:
        convex = ConvexHull(about)
    except QhullError as error:
        raise ValueError("the points lie in a plane") from error
    corners = about[convex.simplices]  # (T, 3, 3), the order of corners as Qhull happens to give it
    inwards = np.einsum("ta,ta->t", double_area_normals(corners), convex.equations[:, :3]) < 0
    corners[inwards] = corners[inwards][:, [0, 2, 1]]
    low, high = about.min(axis=0), about.max(axis=0)
    return Form(HULL, origin, _UPRIGHT, [*low, *high], triangles=corners)


def height_map(corner: ArrayLike, spacing: ArrayLike, heights: ArrayLike, base: float) -> Form:
    """Everything between a base and heights (I, J) [m], which stand at ``corner`` (2,) + (i, j) * ``spacing`` (2,).

    Each cell of the grid is two triangles, divided from its lowest i, j to its highest.
    """
    z = np.asarray(heights, dtype=float)
    x, y = np.asarray(spacing, dtype=float)
    i, j = np.indices(z.shape)
    top = np.stack([i * x, j * y, z], axis=-1)
    low = top.copy()
    low[..., 2] = base
    faces = [triangles_of_squares(top[:-1, :-1], top[1:, :-1], top[1:, 1:], top[:-1, 1:])]
    for rim, under in (
        (top[0], low[0]), (top[-1, ::-1], low[-1, ::-1]), (top[::-1, 0], low[::-1, 0]), (top[:, -1], low[:, -1]),
    ):  # fmt: skip
        faces.append(np.stack([rim[:-1], rim[1:], under[1:]], axis=1))
        faces.append(np.stack([rim[:-1], under[1:], under[:-1]], axis=1))
    a, b, c, d = low[0, 0], low[-1, 0], low[-1, -1], low[0, -1]
    faces.append(np.array([[a, c, b], [a, d, c]]))
    size = [0.0, 0.0, base, *top[-1, -1, :2], float(z.max())]
    origin = np.array([*np.asarray(corner, dtype=float), 0.0])
    return Form(HEIGHTS, origin, _UPRIGHT, size, triangles=np.concatenate(faces), heights=z)


def double_area_normals(triangles: Floats) -> Floats:
    """Normals (T, 3) of triangles (T, 3, 3), anticlockwise from their ends, twice as long as the areas are large."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def triangles_of_squares(*corners: Floats) -> Floats:
    """Triangles (2 K, 3, 3) of K squares, of which the first, second, third and fourth corners (..., 3) are given."""
    a, b, c, d = (x.reshape(-1, 3) for x in corners)
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


# -- many solids in one record -------------------------------------------------------------------------


def one_solid(
    form: Form, times: ArrayLike = (), ways: ArrayLike = (), there: ArrayLike = ALWAYS
) -> Solids:
    """The record of one solid, which moves in straight lines: displacements (W, 3) [m] at times (W,) [s].

    It is there from the first time of ``there`` (2,) [s] until the second.
    """
    times = np.asarray(times, dtype=float)
    ways = np.asarray(ways, dtype=float).reshape(-1, 3)
    triangles, nodes, after, leaf = _triangles_and_tree(form.triangles)
    last = [len(nodes), len(triangles), form.heights.size, len(times)]
    turned = bool(np.any(form.origin) or np.any(form.turn != _UPRIGHT))
    return Solids(
        np.array([form.kind]), form.origin[None], form.turn[None], np.array([int(turned)]),
        np.array([form.size], dtype=float), np.array([form.rounding]), np.zeros((1, 4), dtype=np.int64),
        np.array([last]), np.array([[*form.heights.shape]]), nodes, after, leaf, triangles,
        form.heights.reshape(-1), np.array([there], dtype=float), times, ways,
    )  # fmt: skip


def join_solids(parts: Sequence[Solids]) -> Solids:
    """All solids of several records in one."""
    if not parts:
        return one_solid(half_space(0.0))._replace(kind=np.zeros(0, dtype=np.int64))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    joint = Solids(*columns)
    counts = np.array(
        [(len(p.nodes), len(p.triangles), len(p.heights), len(p.times)) for p in parts]
    )
    before = np.cumsum(counts, axis=0) - counts
    own = np.repeat(before, [len(p.kind) for p in parts], axis=0)
    nodes = np.repeat(before[:, :2], counts[:, 0], axis=0)
    return joint._replace(
        first=joint.first + own,
        last=joint.last + own,
        after=joint.after + nodes[:, 0],
        leaf=joint.leaf + nodes[:, 1:],
    )


def box_corners(low: ArrayLike, high: ArrayLike) -> Floats:
    """Corners (8, 3) of a box from ``low`` to ``high`` (3,): those with the lowest x first, and so on."""
    return np.array(list(product(*np.transpose([low, high]))))


def swept_extent(solid: Solids) -> Floats:
    """Lowest and highest corner (2, 3) [m] of the space that a solid, alone in its record, ever takes."""
    size, turn = solid.size[0], solid.turn[0]
    if solid.kind[0] == CYLINDER:
        radius, half = size[0], size[1]
        reach = half * np.abs(turn[2]) + radius * np.sqrt(np.maximum(1.0 - turn[2] ** 2, 0.0))
        low, high = -reach, reach
    elif solid.turned[0]:
        points = box_corners(size[:3], size[3:]) @ turn  # from own axes to the world's
        low, high = points.min(axis=0), points.max(axis=0)
    else:
        low, high = size[:3], size[3:]
    ends = np.array([low - solid.rounding[0], high + solid.rounding[0]]) + solid.origin[0]
    if solid.moves:
        ends += np.array([solid.ways.min(axis=0), solid.ways.max(axis=0)])
    return ends


def _triangles_and_tree(triangles: Floats) -> tuple[Floats, Floats, Ints, Ints]:
    """Triangles (T, 3, 3) in the order of a tree's leaves, and its nodes, depth first: corners, successors, leaves."""
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    centre, order = (low + high) / 2, np.arange(len(triangles))
    nodes: list[Floats] = []
    after: list[int] = []
    leaf: list[tuple[int, int]] = []

    def grow(first: int, last: int) -> None:
        who, own = order[first:last], len(nodes)
        nodes.append(np.concatenate([low[who].min(axis=0), high[who].max(axis=0)]))
        after.append(0)
        leaf.append((first, last) if last - first <= _LEAF else (0, 0))
        if last - first > _LEAF:
            axis, half = int(np.ptp(centre[who], axis=0).argmax()), (last - first) // 2
            order[first:last] = who[np.argpartition(centre[who, axis], half)]
            grow(first, first + half)
            grow(first + half, last)
        after[own] = len(nodes)

    if len(triangles):
        grow(0, len(triangles))
    return (
        triangles[order], np.array(nodes).reshape(-1, 6), np.array(after, dtype=np.int64),
        np.array(leaf, dtype=np.int64).reshape(-1, 2),
    )  # fmt: skip
