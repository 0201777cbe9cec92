"""Shapes, edges and the distances between them: what a formation is before it flies.

Agents count from 0 here; a shape is an (N, 3) array of *slots* [m] in the body frame, one per
agent, with its geometric centre at the origin. Distances alone know neither a mirror image nor an attitude;
slots do.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import combinations, islice, permutations, product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.errors import Finding, MissionError
from rigidfleet.typing import Floats, Ints

#: Relative tolerance within which given distances must be realisable. Flat and straight shapes sit exactly
#: on the limit, so distances need about seven digits: 5.656854, not 5.657.
REALISABLE = 1e-6

#: Up to so many points distances are compared all with all, and up to so many orders of slots tried, which takes
#: less time than to import what does it better.
_FEW, _TRIED = 400, 6
#: How far neighbours reach, in spacings: to the second, on a shell or in a lattice.
REACH = 1.9

#: The 18 edges of the paper's cube (its Table 4 with the swapped pair d45, d48 put right), counted from 0.
CUBE_EDGES: Ints = np.array(
    [(0, 1), (0, 3), (0, 4), (0, 5), (1, 2), (1, 3), (1, 5), (1, 6), (2, 3), (2, 6), (2, 7), (3, 4)]
    + [(3, 7), (4, 5), (4, 7), (5, 6), (5, 7), (6, 7)],
    dtype=np.int64,
)


# -- shapes ------------------------------------------------------------------------------------------


def _line(size: Floats, n: int) -> Floats:
    x = size[0] * np.arange(n)
    return np.column_stack([x, 0 * x, 0 * x])


def _triangle(size: Floats, n: int) -> Floats:
    # The paper's attachment: x towards agent 3, y along r1 - r2.
    a, h = size[0], size[0] * np.sqrt(3) / 2
    return np.array([[0, a / 2, 0], [0, -a / 2, 0], [h, 0, 0]])


def _polygon(size: Floats, n: int) -> Floats:
    angle = 2 * np.pi * np.arange(n) / n
    radius = size[0] / (2 * np.sin(np.pi / n))
    return radius * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])


def _cuboid(size: Floats, n: int) -> Floats:
    base = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    return np.vstack([base, base + [0, 0, 1]]) * size


def _square(size: Floats, n: int) -> Floats:
    return _cuboid(size, 8)[:4]


def _pyramid(size: Floats, n: int) -> Floats:
    base = _polygon(size, n - 1) if n != 5 else _square(size, 4) - size * [0.5, 0.5, 0]
    height = np.sqrt(size[0] ** 2 - base[0] @ base[0])
    return np.vstack([base, [0, 0, height]])


def _v(size: Floats, n: int) -> Floats:
    # Wings at 45 degrees: 0, then left, right, left, ... in ranks behind the leader.
    rank, side = (np.arange(n) + 1) // 2, np.where(np.arange(n) % 2, 1.0, -1.0)
    step = size[0] / np.sqrt(2) * rank
    return np.column_stack([-step, side * step, 0 * step])


def _grid(size: Floats, n: int) -> Floats:
    row, column = np.divmod(np.arange(n), int(np.ceil(np.sqrt(n))))
    return size[0] * np.column_stack([column, row, 0 * row])


def _sphere(size: Floats, n: int) -> Floats:
    # Fibonacci's spiral: equal areas in height, the golden angle around.
    z = (2 * np.arange(n) + 1) / n - 1
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    across = np.sqrt(1 - z**2)
    p = np.column_stack([across * np.cos(angle), across * np.sin(angle), z])
    return p * size[0] / nearest(p).min()


def _shells(size: Floats, n: int) -> Floats:
    """Two concentric spheres, the outer one first, as near to each other as agents on each are."""

    def radius(count: int) -> float:
        return float(np.linalg.norm(_sphere(size, count)[0]))

    low, high = n // 2, n - 4  # agents of the outer one: too few, and enough
    if radius(high) - radius(n - high) < size[0]:
        raise ValueError(f"{n} agents are too few for a sphere within a sphere")
    while high - low > 1:
        middle = (low + high) // 2
        apart = radius(middle) - radius(n - middle)
        low, high = (middle, high) if apart < size[0] else (low, middle)
    return np.concatenate([_sphere(size, high), _sphere(size, n - high)])


def _helix(size: Floats, n: int) -> Floats:
    radius, rise, spacing = size

    def chord(angle: float) -> float:
        return float(np.hypot(2 * radius * np.sin(angle / 2), rise * angle / (2 * np.pi)))

    low, high = 0.0, np.pi
    if spacing > chord(high):
        raise ValueError(
            f"a helix of radius {radius:g} m that rises {rise:g} m a turn takes a distance of neighbours of at "
            f"most {chord(high):.4g} m, half a turn, not {spacing:g}"
        )
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if chord(middle) < spacing else (low, middle)
    angle = high * np.arange(n)
    return np.column_stack(
        [radius * np.cos(angle), radius * np.sin(angle), rise * angle / 2 / np.pi]
    )


def _rings(*rings: tuple[int, float, float, float]) -> Floats:
    """Rings (count, radius, height, angle of the first), each counter-clockwise, one after the other."""
    points = []
    for count, radius, height, first in rings:
        angle = first + 2 * np.pi * np.arange(count) / count
        points += [radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)]
    return np.column_stack([np.concatenate(points[axis::3]) for axis in range(3)])


def _octahedron(size: Floats, n: int) -> Floats:
    r = size[0] / np.sqrt(2)
    return _rings((1, 0, -r, 0), (4, r, 0, 0), (1, 0, r, 0))


def _icosahedron(size: Floats, n: int) -> Floats:
    # Circumradius R; two rings of five, the upper half a step ahead, at heights -+ R / sqrt 5.
    R = size[0] * np.sqrt((5 + np.sqrt(5)) / 8)
    ring, height = 2 * R / np.sqrt(5), R / np.sqrt(5)
    return _rings((1, 0, -R, 0), (5, ring, -height, 0), (5, ring, height, np.pi / 5), (1, 0, R, 0))


def _dodecahedron(size: Floats, n: int) -> Floats:
    golden = (1 + np.sqrt(5)) / 2
    outer = size[0] / (2 * np.sin(np.pi / 5))
    # Face at the top and bottom; between them two rings, golden times as wide.
    top = size[0] / 2 * np.sqrt((25 + 11 * np.sqrt(5)) / 10)
    low = top - size[0] * np.sqrt(1 - (outer * (golden - 1) / size[0]) ** 2)
    wide, half = golden * outer, np.pi / 5
    return _rings(
        (5, outer, -top, 0), (5, wide, -low, 0), (5, wide, low, half), (5, outer, top, half)
    )


class Shape(NamedTuple):
    """A named shape: which numbers of agents it takes, how many sizes, and what it looks like."""

    agents: range
    sizes: int
    make: Callable[[Floats, int], Floats]
    text: str


_ANY = 1 << 30
SHAPES: dict[str, Shape] = {
    "line": Shape(range(1, _ANY), 1, _line, "along x, `size` apart, in the order of the agents"),
    "triangle": Shape(range(3, 4), 1, _triangle, "equilateral; x towards agent 3, y along r1 - r2"),
    "square": Shape(range(4, 5), 1, _square, "1-4 counter-clockwise from (-, -)"),
    "polygon": Shape(range(3, _ANY), 1, _polygon, "regular, counter-clockwise, agent 1 on x"),
    "hexagon": Shape(range(6, 7), 1, _polygon, "regular, counter-clockwise, agent 1 on x"),
    "pyramid": Shape(
        range(4, 7), 1, _pyramid, "all edges equal; the base counter-clockwise, the apex last"
    ),
    "cube": Shape(
        range(8, 9), 1, _cuboid, "1-4 counter-clockwise from (-, -, -) below, 5-8 above them"
    ),
    "cuboid": Shape(range(8, 9), 3, _cuboid, "as the cube, with three edge lengths [x, y, z]"),
    "v": Shape(
        range(3, _ANY), 1, _v, "flying along x, wings at 45°: agent 1 leads, then left, right, ..."
    ),
    "grid": Shape(
        range(4, _ANY), 1, _grid, "rows along x, as near to square as can be, then rows along y"
    ),
    "sphere": Shape(
        range(4, _ANY), 1, _sphere, "Fibonacci spiral from below; `size` is the least distance"
    ),
    "shells": Shape(
        range(40, _ANY),
        1,
        _shells,
        "a sphere and, `size` below it, a second one within; each as `sphere`, the outer first",
    ),
    "helix": Shape(
        range(3, _ANY),
        3,
        _helix,
        "round z, rising; sizes [radius, rise per turn, neighbours' distance]",
    ),
    "tetrahedron": Shape(range(4, 5), 1, _pyramid, "1-3 counter-clockwise below, 4 above"),
    "octahedron": Shape(
        range(6, 7), 1, _octahedron, "1 below, 2-5 counter-clockwise from x, 6 above"
    ),
    "icosahedron": Shape(
        range(12, 13), 1, _icosahedron, "1 below, rings 2-6 and 7-11 counter-clockwise, 12 above"
    ),
    "dodecahedron": Shape(
        range(20, 21), 1, _dodecahedron, "rings 1-5, 6-10, 11-15, 16-20 upwards, counter-clockwise"
    ),
}


#: Polygons by name, and the agents that make them.
POLYGONS = {
    "pentagon": 5, "heptagon": 7, "octagon": 8, "nonagon": 9, "decagon": 10, "hendecagon": 11, "dodecagon": 12,
}  # fmt: skip


def slots(shape: str, size: float | Sequence[float], n: int) -> Floats:
    """Slots of a named shape of `n` agents, geometric centre at 0.

    Parameters
    ----------
    shape : a key of `SHAPES`
    size : edge length [m]; three of them for a cuboid, or the helix's radius, rise per turn and distance
    n : number of agents

    Returns
    -------
    (n, 3) slots [m]

    Raises
    ------
    ValueError
        The shape is unknown, takes another number of agents or sizes, or a size is not positive.
    """
    if shape not in SHAPES:
        raise ValueError(f"unknown shape {shape!r}; known: {', '.join(SHAPES)}")
    form = SHAPES[shape]
    sizes = np.atleast_1d(np.asarray(size, dtype=np.float64))
    if n not in form.agents:
        raise ValueError(f"shape {shape!r} takes {agents_taken(shape)}, not {n}")
    if sizes.shape != (form.sizes,):
        names = "[radius, rise per turn, distance]" if shape == "helix" else "[x, y, z]"
        wanted = "one size, its edge length" if form.sizes == 1 else f"{form.sizes} sizes {names}"
        raise ValueError(f"shape {shape!r} takes {wanted}")
    if not (np.isfinite(sizes).all() and (sizes > 0).all()):
        raise ValueError(f"shape {shape!r} needs sizes > 0 m, not {size}")
    return _slots(shape, tuple(sizes.tolist()), n).copy()


@lru_cache(8)
def _slots(shape: str, sizes: tuple[float, ...], n: int) -> Floats:
    """Slots as `slots` returns them, made once: those of many agents take seconds."""
    return centred(SHAPES[shape].make(np.array(sizes), n))


def agents_taken(shape: str) -> str:
    """How many agents a named shape takes, in words."""
    taken = SHAPES[shape].agents
    if len(taken) == 1:
        return f"{taken.start} agents"
    if taken.stop == _ANY:
        return f"{taken.start} or more agents"
    return f"{taken.start} to {taken.stop - 1} agents"


def read_points(path: str | Path) -> Floats:
    """Slots (N, 3) [m] from a text file: one agent a line, x, y and z (or x and y, for z = 0).

    Numbers are separated by commas, semicolons or blanks; empty lines and what follows `#` are passed over,
    and so is a first line of names (`x,y,z`).

    Raises
    ------
    MissionError
        The file cannot be read or has no points; with a finding for each line that is none.
    """
    lines = _lines(Path(path))
    findings, points, first = [], [], {}
    for number, line in enumerate(lines, start=1):
        fields = [f for f in re.split(r"\s*[,;]\s*|\s+", line.partition("#")[0].strip()) if f]
        if not fields or (not points and not findings and _are_names(fields)):
            continue
        problem = remedy = ""
        try:
            point = [float(field) for field in fields]
        except ValueError:
            point = []
            problem, remedy = "is no point", "write x, y, z as numbers, with decimal points"
        if point and len(point) not in (2, 3):
            problem = f"has {len(point)} numbers"
            remedy = "write x, y, z (or x, y); decimal points, not commas"
        elif not np.isfinite(point).all():
            problem, remedy = "is not finite", "write x, y, z [m] as finite numbers"
        if not problem:
            at = first.setdefault(tuple(round(x, 9) for x in (*point, 0.0)[:3]), number)
            if at != number:
                problem, remedy = f"is the point of line {at} again", "keep the slots apart"
        if problem:
            findings.append(Finding(str(path), f"line {number}", line.strip(), problem, remedy))
        else:
            points.append((*point, 0.0)[:3])
    if not points and not findings:
        remedy = "write one agent a line: x, y, z"
        findings.append(Finding(str(path), "", None, "has no points", remedy))
    if findings:
        raise MissionError(findings)
    return np.array(points, dtype=np.float64)


def _are_names(fields: list[str]) -> bool:
    def number(field: str) -> bool:
        try:
            float(field)
        except ValueError:
            return False
        return True

    return not any(number(f) or f[0].isdigit() for f in fields)


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        problem = "is not text"
    except OSError as error:
        problem = f"cannot be read: {(error.strerror or str(error)).lower()}"
    raise MissionError(
        [Finding(str(path), "", None, problem, "give a text file, one agent a line")]
    )


def centred(points: ArrayLike) -> Floats:
    """Points (N, 3) with their geometric centre moved to 0."""
    p = np.asarray(points, dtype=np.float64)
    return p - p.mean(axis=0)


# -- edges and distances -----------------------------------------------------------------------------


def complete_graph(n: int) -> Ints:
    """All n (n - 1) / 2 edges (i, j), i < j, in lexical order, shape (m, 2)."""
    return _complete_graph(n).copy()


@lru_cache(8)
def _complete_graph(n: int) -> Ints:
    return np.column_stack(np.triu_indices(n, 1)).astype(np.int64)


def neighbours(points: ArrayLike, reach: float = REACH) -> Ints:
    """Edges (m, 2), i < j, between points (N, 3) no further apart than ``reach`` times their spacing.

    The spacing is the median distance to the nearest point. At 1.9 second neighbours are joined, too, which
    keeps shells and lattices from folding; at 1.5 a cubic lattice has its diagonals of faces.
    """
    from scipy.spatial import KDTree

    p = np.asarray(points, dtype=np.float64)
    if len(p) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    pairs = KDTree(p).query_pairs(_within(p, reach), output_type="ndarray")
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].astype(np.int64)


def count_neighbours(points: ArrayLike, reach: float = REACH) -> int:
    """How many edges `neighbours` would find, without making them."""
    p = np.asarray(points, dtype=np.float64)
    if len(p) < 2:
        return 0
    return count_within(p, _within(p, reach))


def count_within(points: ArrayLike, distance: float) -> int:
    """How many pairs of points (N, 3) are no farther apart than a distance [m], without making them."""
    from scipy.spatial import KDTree

    tree = KDTree(points)
    return (int(tree.count_neighbors(tree, distance)) - tree.n) // 2


def _within(p: Floats, reach: float) -> float:
    """How far [m] neighbours of points (N, 3) are at most."""
    return reach * float(np.median(nearest(p))) * (1 + 1e-9)


def spans_space(points: ArrayLike) -> None:
    """ValueError, with a reason, where `joined` and `coarse_to_fine` have no edges for points (N, 3)."""
    p = np.asarray(points, dtype=np.float64)
    _spanning_first(p, np.arange(len(p)))


def joined(points: ArrayLike) -> Ints:
    """3N - 6 edges (m, 2), i < j, that join each of N points in space to three nearer to the centre.

    A generically rigid graph by Henneberg's first step, whose exact law is solved in O(N). Of the nearest twelve
    points that come earlier those three are taken that span the largest volume of directions. Edges are short, and
    chains of agents as long as from the centre to the border.

    Raises
    ------
    ValueError
        The points do not span space.
    """
    from scipy.spatial import KDTree

    p = np.asarray(points, dtype=np.float64)
    n = len(p)
    order = _spanning_first(p, np.argsort(((p - p.mean(axis=0)) ** 2).sum(axis=1), kind="stable"))
    rank = np.empty(n, dtype=np.int64)
    rank[order] = np.arange(n)
    tree = KDTree(p)
    edges = [_triangle_of(order)]
    for some in np.array_split(order[3:], max(1, n // 4000)):
        near = tree.query(p[some], k=min(n, 48))[1]
        later = rank[near] >= rank[some][:, None]
        lone = np.flatnonzero((~later).sum(axis=1) < 12)  # few of the nearest come before
        at = np.take_along_axis(near, np.argsort(later, axis=1, kind="stable"), axis=1)[:, :12]
        at = np.pad(at, ((0, 0), (0, 12 - at.shape[1])), constant_values=-1)
        for k in lone:
            before = order[: rank[some[k]]]
            d = ((p[before] - p[some[k]]) ** 2).sum(axis=1)
            few = before[np.argsort(d, kind="stable")[:12]]
            at[k] = np.append(few, np.full(12 - len(few), -1))
        u, length = _towards(p, some, at)
        a, b, c = (u[:, _TRIPLES[:, k]] for k in range(3))
        volume = np.abs((a * np.cross(b, c)).sum(axis=2))
        # Of as good triples the shortest.
        worth = volume.round(3) - 1e-6 * length[:, _TRIPLES].sum(axis=2) / length.max()
        edges.append(_edges_to(some, at, _TRIPLES[worth.argmax(axis=1)]))
    return np.sort(np.concatenate(edges), axis=1).astype(np.int64)


def coarse_to_fine(points: ArrayLike) -> Ints:
    """3N - 6 edges (m, 2), i < j, that join each of N points in space to three before it, far ones first.

    Of the kind that `joined` makes, and solved as fast; but it begins with points far apart, and doubles their
    number again and again, each new one between those there are, so that no chain of agents is longer than log N.
    Of the twelve nearest before it a point is joined to the three that leave it the stiffest: with the inverse G of
    their directions, and e of each its own, least sum of |G_k|^2 (1 + e_k). It holds lattices better than `joined`,
    and shells, which that one leaves flexible; its first edges are as long as the shape.

    Raises
    ------
    ValueError
        The points do not span space.
    """
    from scipy.spatial import KDTree

    p = np.asarray(points, dtype=np.float64)
    n = len(p)
    first = _far_apart(p, min(n, 12))
    order = _halves(p)
    order = _spanning_first(p, np.concatenate([first, order[~np.isin(order, first)]]))
    edges, soft, done = [_triangle_of(order)], np.zeros(n), 3
    while done < n:
        some = order[done : 2 * done if done >= 12 else done + 1]
        near = KDTree(p[order[:done]]).query(p[some], k=min(done, 12))[1]
        at = np.pad(order[near], ((0, 0), (0, 12 - near.shape[1])), constant_values=-1)
        square = _softness(p, some, at, soft)
        flat = np.flatnonzero(square.min(axis=1) > _FLAT)  # all near ones lie in one plane with it
        if len(flat):
            at[flat] = first[np.arange(12) % len(first)]
            square[flat] = _softness(p, some[flat], at[flat], soft)
        soft[some] = square.min(axis=1)
        edges.append(_edges_to(some, at, _TRIPLES[square.argmin(axis=1)]))
        done += len(some)
    return np.sort(np.concatenate(edges), axis=1).astype(np.int64)


def _softness(p: Floats, some: Ints, at: Ints, soft: Floats) -> Floats:
    """How soft (k, 220) points (k,) are that are joined to three of those at (k, 12), of which each is so ``soft``.

    Three that lie in a plane with the point, or are not there, give some 1e18.
    """
    u, _ = _towards(p, some, at)
    a, b, c = (u[:, _TRIPLES[:, k]] for k in range(3))
    rows = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    volume = (a * rows[0]).sum(axis=2)
    each = 1 + np.where(at >= 0, soft[at], 0.0)
    square = sum((g**2).sum(axis=2) * each[:, _TRIPLES[:, k]] for k, g in enumerate(rows))
    return np.maximum(square, 1e-6) / np.maximum(volume**2, 1e-24)


#: Softer than this is who lies in a plane with all those near.
_FLAT = 1e12
#: Three out of twelve.
_TRIPLES = np.array(list(combinations(range(12), 3)))


def _triangle_of(order: Ints) -> Ints:
    return np.array([order[[0, 1]], order[[0, 2]], order[[1, 2]]])


def _towards(p: Floats, some: Ints, at: Ints) -> tuple[Floats, Floats]:
    """Unit vectors (k, 12, 3) from some points (k,) to others (k, 12), and how far; 0 where they are -1: none."""
    x = p[at] - p[some][:, None]
    length = np.linalg.norm(x, axis=2)
    there = (at >= 0) & (length > 0)
    return np.where(there[..., None], x / np.maximum(length, 1e-300)[..., None], 0.0), length


def _edges_to(some: Ints, at: Ints, triple: Ints) -> Ints:
    """Edges (3k, 2) of points (k,) to three (k, 3) of those ``at`` (k, 12)."""
    return np.column_stack([np.repeat(some, 3), np.take_along_axis(at, triple, 1).ravel()])


def _far_apart(p: Floats, count: int) -> Ints:
    """So many points, each the farthest from all before it, the first from the centre."""
    away = np.linalg.norm(p - p.mean(axis=0), axis=1)
    found = [int(away.argmax())]
    away = np.linalg.norm(p - p[found[0]], axis=1)
    while len(found) < count:
        found.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(p - p[found[-1]], axis=1))
    return np.array(found)


def _halves(p: Floats) -> Ints:
    """Order (N,) of points: the middle one across the longest extent, the middles of both halves, and so on."""
    order, todo = [], [np.arange(len(p))]
    while todo:
        parts, todo = todo, []
        for some in parts:
            axis = int(np.ptp(p[some], axis=0).argmax())
            along, middle = some[np.argsort(p[some, axis], kind="stable")], len(some) // 2
            order.append(along[middle])
            todo += [half for half in (along[:middle], along[middle + 1 :]) if len(half)]
    return np.array(order)


def _spanning_first(p: Floats, order: Ints) -> Ints:
    """The order (N,) with four points in front that span space, each the earliest that will do."""
    if len(p) < 4:
        raise ValueError(f"{len(p)} points have no three edges each, four at least do")
    x = p[order] - p[order[0]]
    x = x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-300)
    found = [0, 1]
    for size in (
        lambda: np.linalg.norm(np.cross(x, x[1]), axis=1),
        lambda: np.abs(x @ np.cross(x[1], x[found[2]])),
    ):
        fits = np.flatnonzero(size() > 0.2)
        if not len(fits):
            raise ValueError(
                "points in a plane or on a line have no three edges each; they need slots"
            )
        found.append(int(fits[0]))
    return np.concatenate([order[found], np.delete(order, found)])


def nearest(points: ArrayLike) -> Floats:
    """Distance (N,) [m] of each of N points (N, 3) to the nearest other."""
    p = np.asarray(points, dtype=np.float64)
    if len(p) <= _FEW:
        apart = np.linalg.norm(p[:, None] - p, axis=2)
        np.fill_diagonal(apart, np.inf)
        return apart.min(axis=1)
    from scipy.spatial import KDTree

    return KDTree(p).query(p, k=2)[0][:, 1]


def distances(points: ArrayLike, edges: ArrayLike) -> Floats:
    """Lengths (m,) [m] of edges (m, 2) between points (N, 3)."""
    p = np.asarray(points, dtype=np.float64)
    e = np.asarray(edges, dtype=np.int64).reshape(-1, 2)
    return np.linalg.norm(p[e[:, 0]] - p[e[:, 1]], axis=1)


def dimension(points: ArrayLike, tol: float = 1e-6) -> int:
    """0 for a point, 1 for a line, 2 for a plane, 3 for a spatial shape.

    `tol` is relative: a shape is flat when it is `tol` times as thick as it is long (in the sense of the
    singular values of its centred points).
    """
    s = np.linalg.svd(centred(points), compute_uv=False)
    rounding = 1e-12 * np.abs(points).max(initial=0.0)
    return int(np.count_nonzero(s > max(tol * s[0], rounding)))


class Violation(NamedTuple):
    """Given distances which no points in space have."""

    agents: tuple[int, ...]
    edges: tuple[int, ...]
    excess: float
    """Triangle: by how much the longest side is too long [m]. Tetrahedron: its squared volume [m^6], < 0."""


def unrealisable(edges: ArrayLike, lengths: ArrayLike, tol: float = REALISABLE) -> list[Violation]:
    """Every triangle and tetrahedron among the given distances that does not exist in space.

    A triangle whose three sides are given must meet the triangle inequality; a quadruple with all six
    distances, and faces that exist, must have a Cayley-Menger determinant 288 V^2 >= 0. Both hold within
    `tol` of their own size, so that straight (4-8-4) and flat shapes pass. Other quadruples are not judged,
    and more agents than four may contradict each other where every four agree.
    """
    pairs = np.sort(np.asarray(edges, dtype=np.int64).reshape(-1, 2), axis=1).tolist()
    index = {(i, j): k for k, (i, j) in enumerate(pairs)}
    length = np.asarray(lengths, dtype=np.float64)
    after: dict[int, set[int]] = {i: set() for pair in pairs for i in pair}
    for i, j in pairs:
        after[i].add(j)

    found: list[Violation] = []
    for agents, sides in _measured(_cliques(after, 3), index):
        a = length[sides]
        excess = 2 * a.max(axis=1) - a.sum(axis=1)
        for t in np.flatnonzero(excess > tol * a.max(axis=1)):
            found.append(Violation(agents[t], tuple(sides[t].tolist()), float(excess[t])))
    broken = {v.agents for v in found}
    for agents, sides in _measured(_cliques(after, 4), index):
        d2 = length[sides] ** 2
        volume2 = _squared_volume(*d2.T)
        for q in np.flatnonzero(volume2 < -tol * d2.max(axis=1) ** 3):
            if not any(face in broken for face in combinations(agents[q], 3)):
                found.append(Violation(agents[q], tuple(sides[q].tolist()), float(volume2[q])))
    return found


def _cliques(after: dict[int, set[int]], size: int) -> Iterator[tuple[int, ...]]:
    """Agents i < j < ... of which every two share an edge."""

    def extend(clique: tuple[int, ...], common: set[int]) -> Iterator[tuple[int, ...]]:
        if len(clique) == size:
            yield clique
            return
        for i in sorted(common):
            yield from extend((*clique, i), common & after[i])

    return extend((), set(after))


def _measured(
    cliques: Iterator[tuple[int, ...]], index: dict[tuple[int, int], int]
) -> Iterator[tuple[list[tuple[int, ...]], Ints]]:
    """Some thousands of cliques at a time, each with the numbers of its edges 12, 13, ..., 23, ..."""
    while agents := list(islice(cliques, 4096)):
        yield agents, np.array([[index[i, j] for i, j in combinations(c, 2)] for c in agents])


def _squared_volume(a: Floats, b: Floats, c: Floats, ab: Floats, ac: Floats, bc: Floats) -> Floats:
    """Squared volume of tetrahedra from squared lengths 12, 13, 14, 23, 24, 34 (Cayley-Menger / 288)."""
    # Gram matrix of the three edges from the first agent, doubled: its determinant is 288 V^2.
    x, y, z = a + b - ab, a + c - ac, b + c - bc
    return (8 * a * b * c + 2 * x * y * z - 2 * (a * z**2 + b * y**2 + c * x**2)) / 288


def slots_from_distances(
    n: int, edges: ArrayLike, lengths: ArrayLike, tol: float = REALISABLE
) -> Floats | None:
    """Slots (n, 3) [m] of a *complete* set of distances (classical multidimensional scaling).

    Distances know neither attitude nor mirror image; both follow a convention in which the paper's triangle
    comes out as it attaches it, and every named shape with its own handedness: x points from the centre
    to the last agent, y along r1 - r2 made orthogonal to x, and of a spatial shape that mirror image is taken
    whose first four agents that span space, a < b < c < d, have (b - a) x (c - a) . (d - a) > 0.

    Returns None where a distance is missing, since the shape is then not determined.

    Raises
    ------
    ValueError
        No points in space have these distances, within `tol` of the largest.
    """
    e = np.asarray(edges, dtype=np.int64).reshape(-1, 2)
    given = np.asarray(lengths, dtype=np.float64)
    pairs = n * (n - 1) // 2
    if len(e) < pairs or len({(min(i, j), max(i, j)) for i, j in e.tolist()}) < pairs:
        return None
    d = np.zeros((n, n))
    d[e[:, 0], e[:, 1]] = d[e[:, 1], e[:, 0]] = given
    centring = np.eye(n) - 1 / n
    value, vector = np.linalg.eigh(-0.5 * centring @ d**2 @ centring)
    # An eigenvalue is a squared extent: what rounding alone leaves is no thickness.
    top = np.where(value[-3:] > 1e-12 * value[-1], value[-3:], 0.0)[::-1]
    p = np.zeros((n, 3))
    p[:, : len(top)] = vector[:, -3:][:, ::-1] * np.sqrt(top)
    error = float(np.abs(distances(p, e) - given).max(initial=0.0))
    # Near a flat shape, an error e in a distance moves points by sqrt(e): judged by distances, not by volume.
    if error > np.sqrt(tol) * d.max(initial=0.0) or value[0] < -tol * n * d.max(initial=0.0) ** 2:
        raise ValueError(
            f"no points in space have these distances (nearest set is {error:.3g} m off)"
        )
    return _conventional(p)


def _conventional(p: Floats) -> Floats:
    """Turn and mirror centred points (N, 3) to the convention of `slots_from_distances`."""
    x = _first_direction(p[::-1], p)
    if x is None:
        return p
    across = p - np.outer(p @ x, x)
    y = _first_direction((a - b for a, b in combinations(across, 2)), p)
    if y is None:
        return np.outer(p @ x, [1.0, 0.0, 0.0])
    out = p @ np.column_stack([x, y, np.cross(x, y)])
    return out * [1, 1, -1] if handedness(out) < 0 else out


def _first_direction(vectors: Iterable[Floats], p: Floats) -> Floats | None:
    """Unit vector along the first of the vectors that is not small beside the shape of p."""
    small = 1e-6 * np.abs(p).max(initial=0.0)
    return next((v / np.linalg.norm(v) for v in vectors if np.linalg.norm(v) > small), None)


def handedness(points: ArrayLike, tol: float = 1e-6) -> int:
    """+1 or -1 for a spatial shape and its mirror image, 0 for a planar one.

    The sign of (b - a) x (c - a) . (d - a) for the first four agents a < b < c < d that span space, and so the
    same for every rotation of the shape.
    """
    p = np.asarray(points, dtype=np.float64)
    size = float(np.abs(p - p.mean(axis=0)).max(initial=0.0))
    basis: list[Floats] = []
    for q in p[1:] - p[0]:
        rest = q.copy()
        for b in basis:
            rest -= (rest @ b) * b
        length = np.linalg.norm(rest)
        if length <= tol * size:
            continue
        if len(basis) == 2:
            return int(np.sign(np.cross(basis[0], basis[1]) @ q))
        basis.append(rest / length)
    return 0


# -- attitude of a shape -----------------------------------------------------------------------------


def kabsch(
    target: ArrayLike,
    source: ArrayLike,
    weights: ArrayLike | None = None,
    near: ArrayLike | None = None,
    tol: float = 1e-9,
) -> Floats:
    """Rotation R minimising sum_i w_i |target_i - R source_i|^2, both sets taken about their weighted centres.

    With slots as source and positions in the world as target, R is body -> world, the transpose of the paper's
    T. Where several rotations fit equally well (points on a line, a mirrored symmetric shape), the one nearest
    to `near` is taken, so that a line gets the *minimal* rotation and no spin about itself.

    Parameters
    ----------
    target, source : (..., N, 3), leading axes (samples in time) broadcast
    weights : (N,) >= 0, default equal
    near : (3, 3) rotation, default the identity
    tol : singular values below `tol` times the largest count as zero, and so do differences between them

    Returns
    -------
    (..., 3, 3) rotations, det +1
    """
    p, q = np.asarray(target, dtype=np.float64), np.asarray(source, dtype=np.float64)
    w = np.ones(p.shape[-2]) if weights is None else np.asarray(weights, dtype=np.float64)
    w = w[:, None] / w.sum()
    p, q = p - (w * p).sum(axis=-2, keepdims=True), q - (w * q).sum(axis=-2, keepdims=True)
    u, s, vt = np.linalg.svd(np.swapaxes(w * p, -1, -2) @ q)
    proper = np.linalg.det(u @ vt) > 0
    u[..., 2] *= np.where(proper, 1.0, -1.0)[..., None]
    rotation = u @ vt
    alike = tol * s[..., 0]
    free = (s[..., 1] <= alike) | (~proper & (s[..., 1] - s[..., 2] <= alike))
    guide = np.eye(3) if near is None else np.asarray(near, dtype=np.float64)
    for at in np.argwhere(free):
        k = tuple(at)
        rotation[k] = _nearest_fit(u[k], s[k], vt[k], guide, tol)
    return rotation


def _nearest_fit(u: Floats, s: Floats, vt: Floats, near: Floats, tol: float) -> Floats:
    """Of the rotations that fit as well as U V^T, the one nearest to `near`.

    With the last column of U reversed they are U (1 - 2 n n^T) V^T, n any unit vector among the
    directions of the equal smallest singular values.
    """
    if s[0] == 0:
        return near.copy()
    u = u * [1, 1, -1]
    equal = int(np.count_nonzero(s <= s[2] + tol * s[0]))
    overlap = (vt @ near.T @ u)[-equal:, -equal:]
    n = np.zeros(3)
    n[-equal:] = np.linalg.eigh(overlap + overlap.T)[1][:, 0]
    return (u - 2 * np.outer(u @ n, n)) @ vt


# -- who takes which slot ----------------------------------------------------------------------------


class Assigned(NamedTuple):
    """Who takes which slot, and how the slots lie before those that the agents come from while they blend."""

    order: Ints  # (N,) slot of each agent, from 0
    turn: Floats  # (3, 3) rotation of the slots; they are blended as it turns them, and by no other


def nearest_way(
    start: ArrayLike, end: ArrayLike, radius: ArrayLike | None = None
) -> tuple[float, tuple[int, int], float]:
    """Least room between agents that go straight from start to end (N, 3) [m], all in step.

    Exact, in closed form, over all pairs and the whole way; memory grows with N alone.

    Returns
    -------
    room : between two surfaces [m] (between centres without radii (N,)); infinite for one agent
    pair : the two agents, from 0
    share : of the way at which they are nearest, in [0, 1]
    """
    p, q = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    n = len(p)
    r = np.zeros(n) if radius is None else np.asarray(radius, dtype=np.float64)
    best = np.inf, (0, 0), 0.0
    rows = max(1, _PAIRS // n)
    for first in range(0, n - 1, rows):
        i = np.arange(first, min(first + rows, n - 1))
        x = p[i, None] - p[first + 1 :]
        y = q[i, None] - q[first + 1 :] - x
        # Nearest on the way: a line from x to x + y past zero.
        xy, yy = (x * y).sum(axis=2), (y * y).sum(axis=2)
        s = np.clip(-xy / np.maximum(yy, 1e-300), 0.0, 1.0)
        room = np.linalg.norm(x + s[..., None] * y, axis=2) - r[i, None] - r[first + 1 :]
        room[np.tri(*room.shape, -1, dtype=np.bool_)] = np.inf  # each pair once
        k, j = np.unravel_index(int(room.argmin()), room.shape)
        if room[k, j] < best[0]:
            best = float(room[k, j]), (int(i[k]), first + 1 + int(j)), float(s[k, j])
    return best


def assigned(
    start: ArrayLike,
    slots: ArrayLike,
    *,
    turn: ArrayLike | None = None,
    radius: ArrayLike | None = None,
) -> Assigned:
    """Slots (N, 3) that agents at start (N, 3) [m] are to take, and how these are turned meanwhile.

    The turn is chosen first and the order last, by the least sum of squared ways to slots that are turned already:
    then two agents come no nearer than D / sqrt(2) on straight ways in step with each other, D the least distance
    of both shapes, as long as the turn flown is the one returned. For if i and j took each other's slots, the
    squares would grow or stay, which says x . y >= 0 for x = p_i - p_j and y = q_i - q_j, the slots as turned. So
    |(1 - s) x + s y|^2 >= (1 - s)^2 |x|^2 + s^2 |y|^2 >= D^2 / 2. Agents count alike here, whatever their masses:
    squares weighted by mass prove nothing. Nor do the centres matter, since x and y know none.

    Parameters
    ----------
    turn : (3, 3) the rotation of the slots in which they are to be reached; any will do where it is not given
    radius : (N,) [m] asks for the safest in place of the shortest

    The shortest has the least squares for the turn given; or else among some, found from several attitudes in turn
    by assigning the slots and turning them to the agents (Kabsch) until nothing changes. The safest has the most room
    between surfaces among the shortest, others of that kind, whose turn differs from the one given, and the order
    given; among all but equal ones the shorter is taken, and never less room than the shortest has. The order given is
    kept where nothing is better. Many agents try fewer attitudes: two assignments in all from some 1,000 on.
    """
    p, q = centred(start), centred(slots)
    n = len(p)
    given, scale = np.arange(n), float((p**2).sum() + (q**2).sum())
    fits = Assigned(given, kabsch(p, q))
    options = [fits]
    if turn is not None:
        fixed = np.asarray(turn, dtype=np.float64)
        short = Assigned(_nearest_slots(p, q @ fixed.T), fixed)
        options = [short, Assigned(given, fixed)] + ([] if radius is None else [fits])
    if turn is None or radius is not None:
        left = max(1, int(_WORK / n**3))
        for attitude in [fits.turn, *_attitudes()]:
            if left > 0:
                option, used = _settled(p, q, attitude, min(left, _ROUNDS))
                options.append(option)
                left -= used

    def worth(option: Assigned) -> tuple[float, bool, float]:
        to, swing = option.turn, 0.0
        if turn is not None:
            to, swing = fixed, float(np.linalg.norm(option.turn - fixed))
        squares = float(((q[option.order] @ to.T - p) ** 2).sum()) / max(scale, 1e-300)
        return round(squares, 12), bool((option.order != given).any()), swing

    straight = [o for o in options if turn is None or o.turn is fixed]
    shortest = min(straight, key=worth)
    if radius is None:
        return shortest
    room = {id(o): nearest_way(p, q[o.order] @ o.turn.T, radius)[0] for o in options}
    safe = [o for o in options if room[id(o)] >= room[id(shortest)]]
    return min(safe, key=lambda o: (-round(room[id(o)], 2), *worth(o)))


#: Pairs of agents that are looked at together; work on assignments, N^3 each, in some seconds.
_PAIRS, _WORK = 200_000, 2e9
#: From one attitude so many assignments at most.
_ROUNDS = 20


def _nearest_slots(p: Floats, q: Floats) -> Ints:
    """Of slots q (N, 3) those (N,) that make the sum of squared ways from p least."""
    near = p @ q.T  # |p|^2 + |q|^2 is the same for every order
    n = len(p)
    if n <= _TRIED:
        orders = np.array(list(permutations(range(n))), dtype=np.int64)
        return orders[near[np.arange(n), orders].sum(axis=1).argmax()]
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment(-near)[1]


def _settled(p: Floats, q: Floats, turn: Floats, most: int) -> tuple[Assigned, int]:
    """Slots q (N, 3) assigned to agents p and turned onto them in turns, until nothing changes.

    Each lessens the same sum of squares; the last is an assignment. Also how many there were, ``most`` at most.
    """
    order = _nearest_slots(p, q @ turn.T)
    for used in range(1, most):
        turned = kabsch(p, q[order])
        new = _nearest_slots(p, q @ turned.T)
        if (new == order).all():
            return Assigned(order, turned), used + 1
        order, turn = new, turned
    return Assigned(order, turn), most


def _attitudes() -> list[Floats]:
    """The 24 rotations of a cube: attitudes to start from."""
    turns = []
    for axes in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.eye(3)[list(axes)] * np.array(signs)[:, None]
            if np.linalg.det(R) > 0:
                turns.append(R)
    return turns
