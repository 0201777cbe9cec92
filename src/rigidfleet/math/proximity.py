"""Distances between agents' surfaces, and between agents and obstacles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet._common.renamed import getattr_of_earlier_names
from rigidfleet.solids import distance
from rigidfleet.solids.records import HEIGHTS, HULL, Solids
from rigidfleet.typing import Bools, Floats, Ints

# Number of agents beyond which a tree finds near pairs, instead of a search of all pairs.
_MANY = 200


# Number of agents whose nearest neighbours give a first estimate.
_SAMPLE = 256


# Number of values that fit into the processor's cache.
CACHED = 60_000
#: Kinds of solids whose distance takes a search of triangles.
_SURFACES = HULL, HEIGHTS


class Obstacle(Protocol):
    """An obstacle: a solid that may move."""

    @property
    def solid(self) -> Solids:
        """The solid, alone in its record."""
        ...


def separation(r: Floats, radius: ArrayLike) -> tuple[Floats, Ints]:
    """Least distance between two agents' surfaces (K,) [m], and their pair (K, 2).

    Parameters: r (K, N, 3) [m], radius (N,) [m]. For a single agent: infinity and (-1, -1).
    """
    radius = np.asarray(radius, dtype=float)
    known = np.isfinite(r)
    if not known.all():  # agents without a position do not affect the others
        return separation_of_remaining(r, radius, np.logical_and.reduce(known, axis=2))
    if r.shape[1] > _MANY:
        return _closest_pair_of_many(r, radius)
    return _least_of_pairs(r, radius, lambda d, radii: root_of_squares(d) - radii)


def _least_of_pairs(
    r: Floats, radius: Floats, measure: Callable[[Floats, Floats], Floats]
) -> tuple[Floats, Ints]:
    """Least of a measure over all pairs of agents r (K, N, 3) at each sample (K,), and the pair (K, 2).

    ``measure`` (m, K) is of how the pairs are apart (3, m, K), which it may overwrite, and of sums of radii (m, 1).
    Infinity is of no pair, (-1, -1).
    """
    least, pair = np.full(len(r), np.inf), np.full((2, len(r)), -1)
    x = np.ascontiguousarray(r.T)  # rows of samples are faster
    pairs = all_pairs(r.shape[1])
    some = max(1, CACHED // max(1, 3 * len(r)))
    for first in range(0, pairs.shape[1], some):
        i, j = part = pairs[:, first : first + some]
        d = x.take(j, axis=1)
        d -= x.take(i, axis=1)
        values = measure(d, (radius[i] + radius[j])[:, None])
        value = values.min(axis=0)
        closer = value < least
        if closer.any():
            np.copyto(least, value, where=closer)
            np.copyto(pair, part.take(values.argmin(axis=0), axis=1), where=closer)
    return least, pair.T


@lru_cache(16)
def all_pairs(n: int) -> Ints:
    """All pairs (2, n (n - 1) / 2) of n agents, i < j; kept, as flights and verdicts of three would take 1.06 times."""
    return np.stack(np.triu_indices(n, 1))


def pair_distances(r: Floats, pairs: Ints) -> Floats:
    """Distances (m, K) [m] of pairs (m, 2) of agents r (K, N, 3): a row for each pair, which is faster."""
    x, apart = np.ascontiguousarray(r.T), np.empty((len(pairs), len(r)))
    some = max(1, CACHED // (3 * len(r)))
    for first in range(0, len(pairs), some):
        i, j = pairs[first : first + some].T
        d = x.take(i, axis=1)
        d -= x.take(j, axis=1)
        apart[first : first + some] = root_of_squares(d)
    return apart


def root_of_squares(d: Floats) -> Floats:
    """Lengths (...) of vectors (3, ...), which are overwritten."""
    d *= d
    d[0] += d[1]
    d[0] += d[2]
    return np.sqrt(d[0])


def _closest_pair_of_many(r: Floats, radius: Floats) -> tuple[Floats, Ints]:
    """`separation` of many agents r (K, N, 3), all finite, in O(N log N) per sample: a tree finds the near pairs."""
    from scipy.spatial import KDTree

    least, pair = np.empty(len(r)), np.empty((len(r), 2), dtype=np.int64)
    some = np.arange(0, len(radius), max(1, len(radius) // _SAMPLE))
    for k, points in enumerate(r):
        p = np.ascontiguousarray(points.T)
        p -= p.mean(axis=1, keepdims=True)
        # Balancing the tree costs more than it saves here. A few agents give an estimate of the least distance.
        tree = KDTree(p.T, balanced_tree=False, compact_nodes=False)
        d, j = tree.query(p.T[some], k=2)
        # Of two agents at the same place, either may be found as its own nearest one.
        other = np.where(j[:, 1] == some, j[:, 0], j[:, 1])
        estimate = float((d[:, 1] - radius[some] - radius[other]).min())
        reach = estimate + 2.0 * float(radius.max()) + 1e-9 * float(np.abs(p).max())
        near = tree.query_pairs(reach, output_type="ndarray").T
        apart = root_of_squares(p[:, near[0]] - p[:, near[1]]) - radius[near].sum(axis=0)
        at = int(apart.argmin())
        least[k], pair[k] = apart[at], near[:, at]
    return least, pair


def headroom(r: Floats, radius: ArrayLike, among: Bools | None = None) -> tuple[Floats, Ints]:
    """Least height (K,) [m] between the surfaces of two agents, one below the other, and the pair (K, 2).

    An agent is below another if they overlap as seen from above. Infinity and (-1, -1) if there is no such pair.
    r (K, N, 3) [m], radius (N,); ``among`` (K, N) selects agents, all by default.
    """
    radius = np.asarray(radius, dtype=float)
    if among is not None and not among.all():
        r = np.where(among[:, :, None], r, np.nan)
    if r.shape[1] > _MANY:
        least, pair = np.empty(len(r)), np.empty((len(r), 2), dtype=np.int64)
        for k, points in enumerate(r):
            least[k], pair[k] = _least_vertical_gap(points, radius)
        return least, pair

    def vertical_gap(d: Floats, radii: Floats) -> Floats:
        overlap = d[0] ** 2 + d[1] ** 2 <= radii**2  # false for agents without a position
        return np.where(overlap & np.isfinite(d[2]), np.abs(d[2]) - radii, np.inf)

    return _least_of_pairs(r, radius, vertical_gap)


def _least_vertical_gap(r: Floats, radius: Floats) -> tuple[float, Ints]:
    """Least height between two of many agents (N, 3), one below the other, and the pair."""
    from scipy.spatial import KDTree

    who = np.flatnonzero(np.isfinite(r).all(axis=1))
    near = who[KDTree(r[who, :2]).query_pairs(2.0 * radius.max(), output_type="ndarray")]
    apart, radii = r[near[:, 0]] - r[near[:, 1]], radius[near].sum(axis=1)
    overlap = apart[:, 0] ** 2 + apart[:, 1] ** 2 <= radii**2
    height = np.where(overlap, abs(apart[:, 2]) - radii, np.inf)
    if not overlap.any():
        return np.inf, np.array([-1, -1])
    at = int(height.argmin())
    return float(height[at]), np.sort(near[at])


def clearance(
    r: Floats, radius: ArrayLike, obstacles: Sequence[Obstacle], time: ArrayLike = 0.0
) -> tuple[Floats, Ints, Ints]:
    """Least distance to an obstacle (K,) [m], with the agent and the obstacle (K,).

    Negative if they overlap; infinity, -1 and -1 without obstacles. r (K, N, 3), radius (N,), time (K,) [s].
    """
    return least_clearance(*obstacle_clearances(r, radius, obstacles, time))


def least_clearance(clearance: Floats, nearest: Ints) -> tuple[Floats, Ints, Ints]:
    """Least of the `obstacle_clearances` (K, N) of each sample (K,), with the agent and the obstacle (K,)."""
    rows, samples = np.ascontiguousarray(clearance.T), np.arange(len(clearance))
    agent = rows.argmin(axis=0)
    obstacle = nearest[samples, agent]
    return rows.min(axis=0), np.where(obstacle < 0, -1, agent), obstacle


def separation_of_remaining(r: Floats, radius: ArrayLike, left: Bools) -> tuple[Floats, Ints]:
    """`separation` among the agents ``left`` (K, N) at each sample."""
    radius = np.asarray(radius, dtype=float)
    if left.all():
        return separation(r, radius)
    least, pair = np.full(len(r), np.inf), np.full((len(r), 2), -1)
    for who in np.unique(left, axis=0):
        rows, agents = (left == who).all(axis=1), np.flatnonzero(who)
        least[rows], near = separation(r[rows][:, agents], radius[agents])
        pair[rows] = np.append(agents, -1)[near]  # -1 stays -1
    return least, pair


class Closeness(NamedTuple):
    """How near agents come to each other and to obstacles, at K samples; infinity and -1 where there is nothing."""

    separation: Floats  # (K,) least distance between two agents' surfaces [m]
    pair: Ints  # (K, 2) these agents
    each: Floats  # (K, N) least distance of each agent's surface to an obstacle [m]
    nearest: Ints  # (K, N) this obstacle
    clearance: Floats  # (K,) the least of `each`
    agent: Ints  # (K,)
    obstacle: Ints  # (K,)


def closeness(
    r: Floats, radius: ArrayLike, obstacles: Sequence[Obstacle], time: Floats, left: Bools
) -> Closeness:
    """Distances of the agents ``left`` (K, N) at r (K, N, 3), with radius (N,), to each other and to obstacles."""
    each, nearest = obstacle_clearances(r, radius, obstacles, time)
    each[~left] = np.inf
    return Closeness(
        *separation_of_remaining(r, radius, left), each, nearest, *least_clearance(each, nearest)
    )


def obstacle_clearances(
    r: Floats,
    radius: ArrayLike,
    obstacles: Sequence[Obstacle],
    time: ArrayLike = 0.0,
    most: ArrayLike = np.inf,
) -> tuple[Floats, Ints]:
    """Least distance (..., N) [m] of agents r (..., N, 3) to an obstacle, and the obstacle; infinity and -1 without.

    Obstacles that move are where they are at ``time`` (...) [s]. Distances beyond ``most`` (..., N) [m] need not be
    known: these are ``most``, without an obstacle.
    """
    nearest = np.full(r.shape[-2::-1], -1)
    least = np.broadcast_to(np.asarray(most, dtype=float).T, nearest.shape).copy()
    n = r.shape[-2]
    radius = np.broadcast_to(np.asarray(radius, dtype=float), n)
    some = max(1, CACHED * n // max(1, r.size))
    for first in range(0, n if obstacles else 0, some):
        part = slice(first, first + some)
        # Axis by axis, in rows of samples, which is faster.
        places = np.ascontiguousarray(r[..., part, :].T)
        own, near, which = radius[part].reshape(-1, *[1] * (r.ndim - 2)), least[part], nearest[part]
        for k, thing in enumerate(obstacles):
            far = near + own if thing.solid.kind[0] in _SURFACES else np.inf
            clearance = distances(*places, thing.solid, time, far)
            clearance -= own
            np.putmask(which, clearance < near, k)
            np.fmin(near, clearance, out=near)  # NaN is no distance
    return least.T, nearest.T


def below(
    r: Floats, radius: Floats, obstacles: Sequence[Obstacle], time: Floats, reach: float
) -> Bools:
    """Which obstacles (B, M) are below spheres at r (M, 3), with radius (M,), and within ``reach`` [m] of them.

    At times (M,) [s]. On these a vehicle may stand: on ground, roof or terrain, not on a wall beside or on what moves.
    """
    under = np.zeros((len(obstacles), len(r)), dtype=np.bool_)
    for b, thing in enumerate(obstacles):
        near = distances(*r.T, thing.solid, time) <= radius + reach
        under[b, near] = distance.is_solid_below(*r[near].T, 0, thing.solid)
    return under


def distances(
    x: Floats, y: Floats, z: Floats, solid: Solids, time: ArrayLike = 0.0, most: ArrayLike = np.inf
) -> Floats:
    """Signed distance (...) [m] of points to a solid at ``time``, infinite while it is not there.

    Points farther than ``most`` may have infinity, too.
    """
    if solid.moves:
        shift = distance.solid_displacement(np.asarray(time, dtype=float).T, 0, solid)
        x, y, z = x - shift[0], y - shift[1], z - shift[2]
    x, y, z = distance.local_point(x, y, z, 0, solid)
    if solid.kind[0] in _SURFACES:
        away = np.full(x.shape, np.inf)
        near = distance.box_distance(x, y, z, solid.size[0]) < most
        away[near] = distance.signed_distance(x[near], y[near], z[near], 0, solid)
    else:
        away = distance.signed_distance(x, y, z, 0, solid)
    if not any(map(math.isfinite, solid.there[0].tolist())):
        return away
    there = distance.is_solid_present(np.asarray(time, dtype=float).T, 0, solid)
    return np.where(there, away, np.inf)


#: Number of points up to which all distances are compared: importing what finds neighbours faster takes longer.
_FEW = 400


def nearest(points: ArrayLike) -> Floats:
    """Distance (N,) [m] of each of N points (N, 3) to the nearest other."""
    p = np.asarray(points, dtype=np.float64)
    if len(p) <= _FEW:
        apart = np.linalg.norm(p[:, None] - p, axis=2)
        np.fill_diagonal(apart, np.inf)
        return apart.min(axis=1)
    from scipy.spatial import KDTree

    return KDTree(p).query(p, k=2)[0][:, 1]


__getattr__ = getattr_of_earlier_names(
    __name__, separation_of_left="separation_of_remaining", lengths="pair_distances"
)
