"""Constraint graphs of points: which agents share an edge."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.math.proximity import all_pairs, nearest
from rigidfleet.typing import Floats, Ints

#: Reach of neighbours, in spacings: up to second neighbours on a shell or in a lattice.
REACH = 1.9
#: The 18 edges of the paper's cube (its Table 4 with the swapped pair d45, d48 corrected), counted from 0.
CUBE_EDGES: Ints = np.array(
    [(0, 1), (0, 3), (0, 4), (0, 5), (1, 2), (1, 3), (1, 5), (1, 6), (2, 3), (2, 6), (2, 7), (3, 4)]
    + [(3, 7), (4, 5), (4, 7), (5, 6), (5, 7), (6, 7)],
    dtype=np.int64,
)


def complete_graph(n: int) -> Ints:
    """All n (n - 1) / 2 edges (i, j), i < j, in lexical order, shape (m, 2)."""
    return np.ascontiguousarray(all_pairs(n).T)


def neighbour_edges(points: ArrayLike, reach: float = REACH) -> Ints:
    """Edges (m, 2), i < j, between points (N, 3) no further apart than ``reach`` times their spacing.

    The spacing is the median distance to the nearest point. At a reach of 1.9, second neighbours are joined, too, which
    keeps shells and lattices from folding; at 1.5, a cubic lattice has its face diagonals.
    """
    from scipy.spatial import KDTree

    distance = _neighbour_range(points, reach)
    pairs = KDTree(points).query_pairs(distance, output_type="ndarray")
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].astype(np.int64)


def count_neighbour_edges(points: ArrayLike, reach: float = REACH) -> int:
    """Number of edges that `neighbour_edges` would return, without building them."""
    return count_pairs_within(points, _neighbour_range(points, reach))


def count_pairs_within(points: ArrayLike, distance: float) -> int:
    """Number of pairs of points (N, 3) within a distance [m] of each other, without building them."""
    from scipy.spatial import KDTree

    tree = KDTree(points)
    return (int(tree.count_neighbors(tree, distance)) - tree.n) // 2


def _neighbour_range(points: ArrayLike, ratio: float) -> float:
    """Greatest distance [m] between neighbours among points (N, 3); infinite for a single one."""
    p = np.asarray(points, dtype=np.float64)
    return ratio * float(np.median(nearest(p))) * (1 + 1e-9)


def refuse_flat_shapes(points: ArrayLike) -> None:
    """Raise a ValueError with the reason if `henneberg` and `henneberg_multilevel` have no edges for points (N, 3)."""
    p = np.asarray(points, dtype=np.float64)
    _put_spanning_points_first(p, np.arange(len(p)))


def henneberg(points: ArrayLike) -> Ints:
    """3N - 6 edges (m, 2), i < j, that join each of N points in space to three nearer to the centre.

    Henneberg type-I steps give a generically rigid graph, whose exact law is solved in O(N). Each point is joined to
    those three of the twelve nearest earlier points whose directions span the largest volume. Edges are short;
    chains of agents reach from the centre to the border.

    Raises
    ------
    ValueError
        The points do not span space.
    """
    from scipy.spatial import KDTree

    p = np.asarray(points, dtype=np.float64)
    n = len(p)
    away = ((p - p.mean(axis=0)) ** 2).sum(axis=1)
    order = _put_spanning_points_first(p, np.argsort(away, kind="stable"))
    rank = np.empty(n, dtype=np.int64)
    rank[order] = np.arange(n)
    tree = KDTree(p)
    edges = [_edges_of_first_three(order)]
    for some in np.array_split(order[3:], max(1, n // 4000)):
        near = tree.query(p[some], k=min(n, 48))[1]
        later = rank[near] >= rank[some][:, None]
        lone = np.flatnonzero((~later).sum(axis=1) < 12)  # few of the nearest points come earlier
        at = np.take_along_axis(near, np.argsort(later, axis=1, kind="stable"), axis=1)[:, :12]
        at = np.pad(at, ((0, 0), (0, 12 - at.shape[1])), constant_values=-1)
        for k in lone:
            before = order[: rank[some[k]]]
            d = ((p[before] - p[some[k]]) ** 2).sum(axis=1)
            few = before[np.argsort(d, kind="stable")[:12]]
            at[k] = np.append(few, np.full(12 - len(few), -1))
        u, length = _directions_and_distances(p, some, at)
        a, b, c = (u[:, _TRIPLES[:, k]] for k in range(3))
        volume = np.abs((a * np.cross(b, c)).sum(axis=2))
        # Among equally good triples, the one with the shortest edges.
        worth = volume.round(3) - 1e-6 * length[:, _TRIPLES].sum(axis=2) / length.max()
        edges.append(_edges_to_triple(some, at, _TRIPLES[worth.argmax(axis=1)]))
    return np.sort(np.concatenate(edges), axis=1).astype(np.int64)


def henneberg_multilevel(points: ArrayLike) -> Ints:
    """3N - 6 edges (m, 2), i < j, that join each of N points in space to three before it, from coarse to fine.

    The graph is of the same kind as `henneberg`'s, and its law is solved as fast. It begins with points far apart and
    repeatedly doubles their number, each new point between earlier ones, so that no chain of agents is longer than
    log N. Each point is joined to those three of the twelve nearest earlier points that hold it most stiffly: with
    the inverse G of their directions, and the softness e_k of each, the sum of |G_k|^2 (1 + e_k) is least. This graph
    holds lattices better than `henneberg`. It also holds shells, which `henneberg` leaves flexible. Its first edges
    are as long as the shape.

    Raises
    ------
    ValueError
        The points do not span space.
    """
    from scipy.spatial import KDTree

    p = np.asarray(points, dtype=np.float64)
    n = len(p)
    away = np.linalg.norm(p - p.mean(axis=0), axis=1)
    first = farthest_points(p, min(n, 12), int(away.argmax()))
    order = _order_from_coarse_to_fine(p)
    order = _put_spanning_points_first(p, np.concatenate([first, order[~np.isin(order, first)]]))
    edges, soft, done = [_edges_of_first_three(order)], np.zeros(n), 3
    while done < n:
        some = order[done : 2 * done if done >= 12 else done + 1]
        near = KDTree(p[order[:done]]).query(p[some], k=min(done, 12))[1]
        at = np.pad(order[near], ((0, 0), (0, 12 - near.shape[1])), constant_values=-1)
        square = _softness_by_triple(p, some, at, soft)
        # All near points lie in one plane with it
        flat = np.flatnonzero(square.min(axis=1) > _FLAT)
        if len(flat):
            at[flat] = first[np.arange(12) % len(first)]
            square[flat] = _softness_by_triple(p, some[flat], at[flat], soft)
        soft[some] = square.min(axis=1)
        edges.append(_edges_to_triple(some, at, _TRIPLES[square.argmin(axis=1)]))
        done += len(some)
    return np.sort(np.concatenate(edges), axis=1).astype(np.int64)


def _softness_by_triple(p: Floats, some: Ints, at: Ints, soft: Floats) -> Floats:
    """Softness (k, 220) of points (k,) joined to each triple of those at (k, 12), which have the softness ``soft``.

    Triples that lie in a plane with the point, or are incomplete, give about 1e18.
    """
    u, _ = _directions_and_distances(p, some, at)
    a, b, c = (u[:, _TRIPLES[:, k]] for k in range(3))
    rows = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    volume = (a * rows[0]).sum(axis=2)
    each = 1 + np.where(at >= 0, soft[at], 0.0)
    square = sum((g**2).sum(axis=2) * each[:, _TRIPLES[:, k]] for k, g in enumerate(rows))
    return np.maximum(square, 1e-6) / np.maximum(volume**2, 1e-24)


#: Softness beyond which a point lies in a plane with all near points.
_FLAT = 1e12
#: All triples out of twelve.
_TRIPLES = np.array(list(combinations(range(12), 3)))


def _edges_of_first_three(order: Ints) -> Ints:
    return np.array([order[[0, 1]], order[[0, 2]], order[[1, 2]]])


def _directions_and_distances(p: Floats, some: Ints, at: Ints) -> tuple[Floats, Floats]:
    """Unit vectors (k, 12, 3) and distances from points (k,) to others (k, 12); 0 for -1, which means none."""
    x = p[at] - p[some][:, None]
    length = np.linalg.norm(x, axis=2)
    there = (at >= 0) & (length > 0)
    return np.where(there[..., None], x / np.maximum(length, 1e-300)[..., None], 0.0), length


def _edges_to_triple(some: Ints, candidates: Ints, columns: Ints) -> Ints:
    """Edges (3k, 2) of points (k,) to three (k, 3) of those ``candidates`` (k, 12)."""
    return np.column_stack([np.repeat(some, 3), np.take_along_axis(candidates, columns, 1).ravel()])


def farthest_points(p: Floats, count: int, first: int = 0) -> Ints:
    """Indices (count,) of points (N, d): a first one, and each of the others the farthest from all before it."""
    chosen = [first]
    away = np.linalg.norm(p - p[first], axis=1)
    while len(chosen) < count:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(p - p[chosen[-1]], axis=1))
    return np.array(chosen)


def _order_from_coarse_to_fine(p: Floats) -> Ints:
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


def _put_spanning_points_first(p: Floats, order: Ints) -> Ints:
    """The order (N,) with four points that span space moved to the front, each the earliest possible one."""
    if len(p) < 4:
        few = f"{len(p)} points cannot have three edges each"
        raise ValueError(f"{few}; at least four points are needed")
    x = p[order] - p[order[0]]
    x = x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-300)
    chosen = [0, 1]
    for size in (
        lambda: np.linalg.norm(np.cross(x, x[1]), axis=1),
        lambda: np.abs(x @ np.cross(x[1], x[chosen[2]])),
    ):
        fits = np.flatnonzero(size() > 0.2)
        if not len(fits):
            flat = "points in a plane or on a line cannot be held by three edges each"
            raise ValueError(f"{flat}; they need slots")
        chosen.append(int(fits[0]))
    return np.concatenate([order[chosen], np.delete(order, chosen)])


#: Graphs with a name in missions, made from slots (N, 3) and, for neighbours, their reach in spacings.
GRAPHS: dict[str, Callable[[Floats, float], Ints]] = {
    "complete": lambda p, _: complete_graph(len(p)),
    "neighbours": neighbour_edges,
    "henneberg": lambda p, _: henneberg(p),
    "henneberg-multilevel": lambda p, _: henneberg_multilevel(p),
}
