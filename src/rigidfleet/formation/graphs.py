"""Constraint graphs of points: who keeps a distance from whom."""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.math.proximity import nearest
from rigidfleet.typing import Floats, Ints

#: How far neighbours reach, in spacings: to the second, on a shell or in a lattice.
REACH = 1.9


#: The 18 edges of the paper's cube (its Table 4 with the swapped pair d45, d48 put right), counted from 0.
CUBE_EDGES: Ints = np.array(
    [(0, 1), (0, 3), (0, 4), (0, 5), (1, 2), (1, 3), (1, 5), (1, 6), (2, 3), (2, 6), (2, 7), (3, 4)]
    + [(3, 7), (4, 5), (4, 7), (5, 6), (5, 7), (6, 7)],
    dtype=np.int64,
)


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
    """ValueError, with a reason, where `henneberg` and `henneberg_multilevel` have no edges for points (N, 3)."""
    p = np.asarray(points, dtype=np.float64)
    _spanning_first(p, np.arange(len(p)))


def henneberg(points: ArrayLike) -> Ints:
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


def henneberg_multilevel(points: ArrayLike) -> Ints:
    """3N - 6 edges (m, 2), i < j, that join each of N points in space to three before it, far ones first.

    Of the kind that `henneberg` makes, and solved as fast; but it begins with points far apart, and doubles their
    number again and again, each new one between those there are, so that no chain of agents is longer than log N.
    Of the twelve nearest before it a point is joined to the three that leave it the stiffest: with the inverse G of
    their directions, and e of each its own, least sum of |G_k|^2 (1 + e_k). It holds lattices better than `henneberg`,
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
