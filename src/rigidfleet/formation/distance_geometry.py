"""Distance geometry: from points to distances, and from distances to points."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.math.rigid_body import centred
from rigidfleet.typing import Bools, Floats

#: Relative tolerance within which given distances must be realisable. Flat and straight shapes lie exactly
#: on the limit, so distances need about seven digits: 5.656854, not 5.657.
REALISABLE = 1e-6


def distances(points: ArrayLike, edges: ArrayLike) -> Floats:
    """Lengths (..., m) [m] of edges (m, 2) between points (..., N, 3)."""
    p = np.asarray(points, dtype=np.float64)
    e = np.asarray(edges, dtype=np.int64).reshape(-1, 2)
    ways = p.take(e[:, 0], axis=-2) - p.take(e[:, 1], axis=-2)
    # In half the time of a norm, and with the same bits.
    return np.sqrt(np.add.reduce(ways * ways, axis=-1))


def dimension(points: ArrayLike, tol: float = 1e-6) -> int:
    """0 for a point, 1 for a line, 2 for a plane, 3 for a spatial shape.

    `tol` is relative: a shape is flat when it is `tol` times as thick as it is long (in the sense of the
    singular values of its centred points).
    """
    s = np.linalg.svd(centred(points), compute_uv=False)
    rounding = 1e-12 * np.abs(points).max(initial=0.0)
    return int(np.count_nonzero(s > max(tol * s[0], rounding)))


class Violation(NamedTuple):
    """Given distances that no points in space have."""

    agents: tuple[int, ...]
    edges: tuple[int, ...]
    excess: float
    """Triangle: by how much the longest side is too long [m]. Tetrahedron: its squared volume [m^6], < 0."""


def violations(edges: ArrayLike, lengths: ArrayLike) -> list[Violation]:
    """All triangles and tetrahedra among the given distances that do not exist in space.

    A triangle whose three sides are given must meet the triangle inequality; a quadruple with all six
    distances, and faces that exist, must have a Cayley-Menger determinant 288 V^2 >= 0. Both hold within
    `REALISABLE` of their own size, so that straight (4-8-4) and flat shapes pass. Other quadruples are not checked,
    and distances between more than four agents may be unrealisable even if every four are consistent.
    """
    pairs = np.sort(np.asarray(edges, dtype=np.int64).reshape(-1, 2), axis=1).tolist()
    index = {(i, j): k for k, (i, j) in enumerate(pairs)}
    length = np.asarray(lengths, dtype=np.float64)
    after: dict[int, set[int]] = {i: set() for pair in pairs for i in pair}
    for i, j in pairs:
        after[i].add(j)
    broken: list[Violation] = []
    for size, excess_of in ((3, _triangle_excess_and_violations), (4, _squared_volumes_impossible)):
        cliques = list(_cliques(after, size))
        numbers = (index[pair] for agents in cliques for pair in combinations(agents, 2))
        sides = np.fromiter(numbers, np.int64).reshape(-1, size * (size - 1) // 2)
        excess, wrong = excess_of(length[sides])
        faces = {v.agents for v in broken}
        for k in np.flatnonzero(wrong):
            if faces.isdisjoint(combinations(cliques[k], 3)):
                broken.append(Violation(cliques[k], tuple(sides[k].tolist()), float(excess[k])))
    return broken


def _cliques(after: dict[int, set[int]], size: int) -> Iterator[tuple[int, ...]]:
    """Agents i < j < ... of which every pair has an edge."""

    def cliques_of_size(clique: tuple[int, ...], common: set[int]) -> Iterator[tuple[int, ...]]:
        if len(clique) == size:
            yield clique
            return
        for i in sorted(common):
            yield from cliques_of_size((*clique, i), common & after[i])

    return cliques_of_size((), set(after))


def _triangle_excess_and_violations(sides: Floats) -> tuple[Floats, Bools]:
    """By how much the longest side of triangles (K, 3) [m] is too long, and where that is no rounding."""
    longest = sides.max(axis=1)
    excess = 2 * longest - sides.sum(axis=1)
    return excess, excess > REALISABLE * longest


def _squared_volumes_impossible(sides: Floats) -> tuple[Floats, Bools]:
    """Squared volumes of tetrahedra of sides 12, 13, 14, 23, 24, 34 (K, 6) [m], and where they are negative."""
    a, b, c, ab, ac, bc = squares = sides.T**2
    # Gram matrix of the three edges from the first agent, doubled: its determinant is 288 V^2 (Cayley-Menger).
    x, y, z = a + b - ab, a + c - ac, b + c - bc
    volume2 = (8 * a * b * c + 2 * x * y * z - 2 * (a * z**2 + b * y**2 + c * x**2)) / 288
    return volume2, volume2 < -REALISABLE * squares.max(axis=0) ** 3


def gram_eigensystem(d: Floats) -> tuple[Floats, Floats]:
    """Squared extents (N,) [m^2] and axes (N, N) of points with distances (N, N) [m]: classical scaling."""
    centring = np.eye(len(d)) - 1 / len(d)
    return np.linalg.eigh(-0.5 * centring @ d**2 @ centring)


def slots_of_all_distances(n: int, edges: ArrayLike, lengths: ArrayLike) -> Floats | None:
    """Slots (n, 3) [m] of a *complete* set of distances (classical multidimensional scaling).

    Distances determine neither attitude nor handedness; both follow a convention that agrees with the paper's
    triangle and with the handedness of every named shape. x points from the centre to the last agent, and y along
    r1 - r2 made orthogonal to x. A spatial shape has the handedness for which its first four agents that span space,
    a < b < c < d, have (b - a) x (c - a) . (d - a) > 0.

    Returns None if a distance is missing, since the shape is then not determined.

    Raises
    ------
    ValueError
        No points in space have these distances, within `REALISABLE` of the largest.
    """
    e = np.asarray(edges, dtype=np.int64).reshape(-1, 2)
    length = np.asarray(lengths, dtype=np.float64)
    pairs = n * (n - 1) // 2
    if len(e) < pairs or len({(min(i, j), max(i, j)) for i, j in e.tolist()}) < pairs:
        return None
    d = np.zeros((n, n))
    d[e[:, 0], e[:, 1]] = d[e[:, 1], e[:, 0]] = length
    value, vector = gram_eigensystem(d)
    # An eigenvalue is a squared extent; rounding errors alone are no thickness.
    top = np.where(value[-3:] > 1e-12 * value[-1], value[-3:], 0.0)[::-1]
    p = np.zeros((n, 3))
    p[:, : len(top)] = vector[:, -3:][:, ::-1] * np.sqrt(top)
    error = float(np.abs(distances(p, e) - length).max(initial=0.0))
    # Near a flat shape, an error e in a distance moves points by sqrt(e); therefore distances decide, not the volume.
    largest = d.max(initial=0.0)
    if error > np.sqrt(REALISABLE) * largest or value[0] < -REALISABLE * n * largest**2:
        # Eigenvalues alone: their vectors, and so the points, are not unique where eigenvalues are equal.
        off = np.sqrt((np.abs(value).sum() - top.sum()) / n)
        raise ValueError(
            f"no points in space have these distances (they miss space by {off:.3g} m in the root mean square)"
        )
    return _turn_to_slot_convention(p)


def _turn_to_slot_convention(p: Floats) -> Floats:
    """Turn and mirror centred points (N, 3) to the convention of `slots_of_all_distances`."""
    x = _first_nonzero_direction(p[::-1], p)
    if x is None:
        return p
    across = p - np.outer(p @ x, x)
    y = _first_nonzero_direction((a - b for a, b in combinations(across, 2)), p)
    if y is None:
        return np.outer(p @ x, [1.0, 0.0, 0.0])
    out = p @ np.column_stack([x, y, np.cross(x, y)])
    return out * [1, 1, -1] if handedness(out) < 0 else out


def _first_nonzero_direction(vectors: Iterable[Floats], shape: Floats) -> Floats | None:
    """Unit vector along the first of the vectors that is not small relative to a shape."""
    small = 1e-6 * np.abs(shape).max(initial=0.0)
    return next((v / np.linalg.norm(v) for v in vectors if np.linalg.norm(v) > small), None)


def handedness(points: ArrayLike) -> int:
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
        if length <= 1e-6 * size:
            continue
        if len(basis) == 2:
            return int(np.sign(np.cross(basis[0], basis[1]) @ q))
        basis.append(rest / length)
    return 0
