"""How close agents come to each other and to obstacles, and how a formation lies in space."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.typing import Bools, Floats, Ints

if TYPE_CHECKING:
    from rigidfleet.mission import Box, Ground


# Slots thinner than this, relative to their length, are a line to an attitude fit.
_THIN = 1e-3
# Narrower ones than this are a line where they are not so many times wider than agents are off them.
_NARROW, _SURE = 0.1, 4.0
# A turn is half a turn where 1 + cos of its angle is less: 1e-8 rad from it.
_HALF_TURN = 5e-17
# Beyond so many agents two that are near each other are found by a tree, not among all pairs.
_MANY = 200
# So many agents are asked for their nearest, to begin with.
_ASKED = 256
# Pairs watched are those within so many times what the closest two are apart.
_SPARE = 1.2
# Numbers that stay in the processor's cache.
_CACHED = 60_000
# Numbers in a temporary array at most.
_ELEMENTS = 8_000_000


def separation(r: Floats, radius: ArrayLike) -> tuple[Floats, Ints]:
    """Least room between two agents' surfaces (K,) [m], and the pair (K, 2) that has it.

    Parameters: r (K, N, 3) [m], radius (N,) [m]. One agent alone: infinity and (-1, -1).
    """
    n = r.shape[1]
    radius = np.asarray(radius, dtype=float)
    least, pair = np.full(len(r), np.inf), np.full((2, len(r)), -1).T
    if n > _MANY:
        whole = np.isfinite(r.reshape(len(r), -1)).all(axis=1)
        if whole.all():
            return _closest_of_many(r, radius)
        least[whole], pair[whole] = _closest_of_many(r[whole], radius)
        for k in np.flatnonzero(~whole):  # who is nowhere hides nobody else
            who = np.flatnonzero(np.isfinite(r[k]).all(axis=1))
            if len(who) > 1:
                least[k : k + 1], near = _closest_of_many(r[k : k + 1, who], radius[who])
                pair[k] = who[near[0]]
        return least, pair
    x = np.ascontiguousarray(r.T)
    for i in range(n - 1):  # rows of samples, which is faster than rows of agents
        d = x[:, i + 1 :] - x[:, i : i + 1]
        room = _root(d) - (radius[i] + radius[i + 1 :])[:, None]
        for j in np.flatnonzero((room < least).any(axis=1)).tolist():
            closer = room[j] < least  # false where it is NaN
            np.copyto(least, room[j], where=closer)
            np.copyto(pair[:, 0], i, where=closer)
            np.copyto(pair[:, 1], i + 1 + j, where=closer)
    return least, pair


def lengths(r: Floats, pairs: Ints) -> Floats:
    """Distances (m, K) [m] of pairs (m, 2) of agents r (K, N, 3): a row for each pair, which is faster."""
    x, found = np.ascontiguousarray(r.T), np.empty((len(pairs), len(r)))
    some = max(1, _CACHED // (3 * len(r)))
    for first in range(0, len(pairs), some):
        i, j = pairs[first : first + some].T
        d = x[:, i]
        d -= x[:, j]
        found[first : first + some] = _root(d)
    return found


def _root(d: Floats) -> Floats:
    """Lengths (...) of vectors (3, ...), which are overwritten."""
    d *= d
    d[0] += d[1]
    d[0] += d[2]
    return np.sqrt(d[0])


def _closest_of_many(r: Floats, radius: Floats) -> tuple[Floats, Ints]:
    """`separation` of many agents r (K, N, 3), all of them somewhere, in O(N) or O(N log N) a sample.

    A tree finds the pairs near each other at one sample. They serve the next samples, too, for as long as no other
    pair can have come as near: whatever moves as a whole, agents that have moved by ``moved`` within it
    have changed no distance by more than twice that.
    """
    least, pair = np.empty(len(r)), np.empty((len(r), 2), dtype=np.int64)
    near, rest = None, np.zeros((3, 0))
    for k, points in enumerate(r):
        p = np.ascontiguousarray(points.T)  # sums over agents take a quarter of the time so
        p -= p.mean(axis=1, keepdims=True)
        if near is not None:
            room = near.rooms(p)
            at = int(room.argmin())
        if near is None or room[at] > near.beyond - 2.0 * _moved(rest, p):
            near, rest = _near(p, radius), p
            room = near.rooms(p)
            at = int(room.argmin())
        least[k], pair[k] = room[at], near.pairs[:, at]
    return least, pair


class _Near(NamedTuple):
    """Pairs of agents (2, m), i < j, each with both radii (m,); all others have more room than ``beyond`` [m]."""

    pairs: Ints
    radii: Floats
    beyond: float

    def rooms(self, p: Floats) -> Floats:
        """Room (m,) [m] between the surfaces of the pairs, of agents p (3, N)."""
        x = p.take(self.pairs[0], axis=1)
        x -= p.take(self.pairs[1], axis=1)
        x *= x
        return np.sqrt(x[0] + x[1] + x[2]) - self.radii


def _near(p: Floats, radius: Floats) -> _Near:
    """The pairs of agents p (3, N) that are not much farther apart than the closest two."""
    from scipy.spatial import KDTree

    # A balanced tree takes longer to make than it saves here; and some agents tell how near all may be.
    tree = KDTree(p.T, balanced_tree=False, compact_nodes=False)
    some = np.arange(0, len(radius), max(1, len(radius) // _ASKED))
    d, j = tree.query(p.T[some], k=2)
    widest, rounding = 2.0 * float(radius.max()), 1e-9 * float(np.abs(p).max())
    room = float((d[:, 1] - radius[some] - radius[j[:, 1]]).min())
    pairs = tree.query_pairs(_SPARE * (room + widest) + rounding, output_type="ndarray").T
    found = _Near(pairs, radius[pairs].sum(axis=0), 0.0)
    rooms = found.rooms(p)
    beyond = _SPARE * (float(rooms.min()) + widest) + rounding - widest
    near = rooms <= beyond
    return _Near(np.ascontiguousarray(pairs[:, near]), found.radii[near], beyond)


def _moved(before: Floats, after: Floats) -> float:
    """The farthest way [m] of an agent, from (3, N) to (3, N), within the motion of all as one body."""
    U, _, Vt = np.linalg.svd(after @ before.T)
    way = after - (U @ Vt) @ before  # a reflection keeps distances, too
    return float(np.sqrt(np.einsum("ai,ai->i", way, way).max()))


def headroom(r: Floats, radius: ArrayLike, among: Bools | None = None) -> tuple[Floats, Ints]:
    """Least height between two agents of which one is below the other (K,) [m], and the pair (K, 2).

    Below is who overlaps as seen from above. Infinity and (-1, -1) where nobody is. r (K, N, 3) [m],
    radius (N,); ``among`` (K, N): whom to look at, all by default.
    """
    n = r.shape[1]
    radius = np.asarray(radius, dtype=float)
    least, pair = np.full(len(r), np.inf), np.full((2, len(r)), -1).T
    if among is not None and not among.all():
        r = np.where(among[:, :, None], r, np.nan)
    if n > _MANY:
        for k, points in enumerate(r):
            least[k], pair[k] = _lowest(points, radius)
        return least, pair
    x = np.ascontiguousarray(r.T)
    for i in range(n - 1):
        d, radii = x[:2, i + 1 :] - x[:2, i : i + 1], radius[i] + radius[i + 1 :]
        d *= d
        d[0] += d[1]
        overlap = d[0] <= (radii**2)[:, None]  # who is nowhere is below nobody
        for j in np.flatnonzero(overlap.any(axis=1)).tolist():
            room = abs(x[2, i + 1 + j] - x[2, i]) - radii[j]
            lower = overlap[j] & (room < least)
            np.copyto(least, room, where=lower)
            np.copyto(pair[:, 0], i, where=lower)
            np.copyto(pair[:, 1], i + 1 + j, where=lower)
    return least, pair


def _lowest(r: Floats, radius: Floats) -> tuple[float, Ints]:
    """Least height between two of many agents (N, 3) of which one is below the other, and the pair."""
    from scipy.spatial import KDTree

    who = np.flatnonzero(np.isfinite(r).all(axis=1))
    if not len(who):
        return np.inf, np.array([-1, -1])
    near = who[KDTree(r[who, :2]).query_pairs(2.0 * radius.max(), output_type="ndarray")]
    apart, radii = r[near[:, 0]] - r[near[:, 1]], radius[near].sum(axis=1)
    overlap = apart[:, 0] ** 2 + apart[:, 1] ** 2 <= radii**2
    room = np.where(overlap, abs(apart[:, 2]) - radii, np.inf)
    if not overlap.any():
        return np.inf, np.array([-1, -1])
    at = int(room.argmin())
    return float(room[at]), np.sort(near[at])


def clearance(
    r: Floats, radius: ArrayLike, obstacles: Sequence[Box | Ground]
) -> tuple[Floats, Ints, Ints]:
    """Least room to an obstacle (K,) [m], and the agent and the obstacle (K,) that have it.

    Negative where they overlap; infinity, -1 and -1 without obstacles. r (K, N, 3), radius (N,).
    """
    return least_room(*rooms(r, radius, obstacles))


def least_room(room: Floats, nearest: Ints) -> tuple[Floats, Ints, Ints]:
    """The least of the `rooms` (K, N) of each sample (K,), and the agent and the obstacle (K,) that have it."""
    agent, samples = room.argmin(axis=1), np.arange(len(room))
    obstacle = nearest[samples, agent]
    return room[samples, agent], np.where(obstacle < 0, -1, agent), obstacle


def separation_of_left(r: Floats, radius: ArrayLike, left: Bools) -> tuple[Floats, Ints]:
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


def rooms(r: Floats, radius: ArrayLike, obstacles: Sequence[Box | Ground]) -> tuple[Floats, Ints]:
    """Least room (..., N) [m] of agents r (..., N, 3) to an obstacle, and the obstacle; infinity and -1 without."""
    radius = np.asarray(radius, dtype=float)
    least, nearest = np.full(r.shape[-2::-1], np.inf), np.full(r.shape[-2::-1], -1)
    # Axis by axis, and rows of samples, which is faster.
    places = np.ascontiguousarray(r.T) if obstacles else r.T
    radius = radius.reshape(-1, *[1] * (r.ndim - 2))
    for k, thing in enumerate(obstacles):
        if thing.kind == "ground":
            room = places[2] - thing.height - radius
        else:
            outside, inside = np.zeros(least.shape), np.full(least.shape, -np.inf)
            for x, low, high in zip(places, thing.min, thing.max, strict=True):
                beyond = np.maximum(low - x, x - high)  # positive outside
                np.maximum(inside, beyond, out=inside)
                np.maximum(beyond, 0.0, out=beyond)
                outside += beyond * beyond
            room = np.sqrt(outside) + np.minimum(inside, 0.0) - radius
        closer = room < least  # false where it is NaN
        np.copyto(least, room, where=closer)
        np.copyto(nearest, k, where=closer)
    return least.T, nearest.T


def fit_attitudes(x: Floats, p: Floats, masses: Floats, near: Floats) -> tuple[Floats, Bools]:
    """Attitude T (K, 3, 3), world -> body, of slots fitted to agents at each of K samples (Kabsch).

    Also returns where the slots are one line (K,). So are narrow slots, if the attitude expected is known, where
    agents are off them by more than their width: how those lie about their long axis is chance.

    Parameters
    ----------
    x, p : (K, N, 3) agents about their CM in world axes, and slots in body axes [m]
    masses : (N,) weights [kg]
    near : (K, 3, 3) or (3, 3) the attitude expected, which decides what the fit leaves open: the
        spin of a line about itself. One matrix: each sample's is taken from the sample before.
    """
    fit = np.einsum("i,kia,kib->kab", masses, p, x)
    U, _, Vt = np.linalg.svd(fit)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    T = U @ Vt
    weights = np.sqrt(masses)[:, None]
    width, long, axes = _long_axes(weights * p)
    line = width <= _THIN * long
    if near.ndim == 3:
        thin = np.flatnonzero(width <= _NARROW * long)
        along = _turn_lines(x[thin], p[thin], axes[thin], near[thin])
        off = np.linalg.norm(weights * (x[thin] - p[thin] @ along), axis=(1, 2))
        line[thin] |= width[thin] <= _SURE * off
        T[thin] = np.where(line[thin, None, None], along, T[thin])
        return T, line
    # Out of samples on a line, each turns on from the one before: what turns them is known beforehand.
    if not line.any():
        return T, line
    there = _directions(x, p, axes)
    follows = line[1:] & line[:-1] & (axes[1:] == axes[:-1]).all(axis=1) & there[:-1].any(axis=1)
    first = np.flatnonzero(line & ~np.append(False, follows))
    now = np.concatenate([there[:1], there[:-1]])
    now[first] = 0.0
    turns = _smallest_turns(now, there)
    guess = near
    for k in range(len(p)):
        if line[k]:
            turn = turns[k]
            if not now[k].any():
                turn = _smallest_turns((axes[k] @ guess)[None], there[k : k + 1])[0]
            T[k] = guess @ turn.T
        guess = T[k]
    return T, line


def _long_axes(p: Floats) -> tuple[Floats, Floats, Floats]:
    """Second and first singular value (K,) of points p (K, N, 3), and the direction (K, 3) of the first.

    Of points so wide that they are no line, two others whose ratio says so.
    """
    # Slots mostly stand still: one decomposition then serves all samples.
    few = p[:1] if (p == p[:1]).all() else p
    C = few.swapaxes(1, 2) @ few
    # Eigenvalues a >= b >= c of C: with s = a + b + c, b >= (ab + ac + bc) / 3s.
    s = np.trace(C, axis1=1, axis2=2)
    long = np.sqrt(s)
    width = np.sqrt(
        np.maximum(s * s - (C * C).sum(axis=(1, 2)), 0.0) / (6.0 * np.where(s > 0.0, s, 1.0))
    )
    axis = np.zeros((len(few), 3))
    slim = np.flatnonzero(width <= _NARROW * long)
    if len(slim) and p.shape[1] > 1:
        _, spread, axes = np.linalg.svd(few[slim], full_matrices=False)
        long[slim], width[slim], axis[slim] = spread[:, 0], spread[:, 1], axes[:, 0]
    K = len(p)
    return np.broadcast_to(width, K), np.broadcast_to(long, K), np.broadcast_to(axis, (K, 3))


def _turn_lines(x: Floats, p: Floats, axis: Floats, near: Floats) -> Floats:
    """Attitudes (K, 3, 3) of lines, from ``near`` by the smallest rotation that brings each axis home."""
    now = np.einsum("kba,kb->ka", near, axis)
    return near @ _smallest_turns(now, _directions(x, p, axis)).swapaxes(1, 2)


def _directions(x: Floats, p: Floats, axis: Floats) -> Floats:
    """Where the long axis (K, 3) of slots p points among agents x (K, N, 3): unit vectors, or zero."""
    there = np.einsum("ki,kia->ka", np.einsum("kia,ka->ki", p, axis), x)
    length = np.linalg.norm(there, axis=1)
    return there / np.where(length == 0.0, 1.0, length)[:, None]


def _smallest_turns(now: Floats, there: Floats) -> Floats:
    """Smallest rotations (K, 3, 3) from unit vectors to others (K, 3); none to or from zero."""
    # 1 + c of their angle's cosine c, in digits that are good up to half a turn; of zero vectors it does not matter.
    near = 0.5 * ((now + there) ** 2).sum(axis=1)
    opposite = (near < _HALF_TURN) & now.any(axis=1) & there.any(axis=1)
    skew = there[:, :, None] * now[:, None, :]  # of now x there, less its transpose
    skew = skew - skew.swapaxes(1, 2)
    R = np.eye(3) + skew + skew @ skew / np.where(near < _HALF_TURN, 1.0, near)[:, None, None]
    for k in np.flatnonzero(opposite):  # half a turn: any axis across the line will do
        across = np.cross(now[k], np.eye(3)[np.abs(now[k]).argmin()])
        across /= np.linalg.norm(across)
        R[k] = 2.0 * np.outer(across, across) - np.eye(3)
    return R


def mean_axis_rates(x: Floats, y: Floats, masses: Floats, line: ArrayLike = False) -> Floats:
    """Angular velocity omega = I^+ h (K, 3) [rad/s], world axes, of agents about their CM.

    x, y (K, N, 3): positions and velocities about the CM [m, m/s]; masses (N,) or (K, N); line (K,):
    where they are one, and have no spin about themselves. That of a line bent by some centimetres would be noise.
    """
    masses = np.broadcast_to(masses, x.shape[:2])
    h = np.einsum("ki,kia->ka", masses, np.cross(x, y))
    C = np.einsum("ki,kia,kib->kab", masses, x, x)
    inertia = np.trace(C, axis1=1, axis2=2)[:, None, None] * np.eye(3) - C
    # Far from a line the inverse is the pseudo-inverse, for a third of the time.
    size = np.trace(inertia, axis1=1, axis2=2)
    with np.errstate(over="ignore", invalid="ignore"):  # what has no inertia has no rates
        round_ = ~np.broadcast_to(line, len(x)) & (np.linalg.det(inertia) > 1e-4 * size**3)
    omega = np.empty((len(x), 3))
    omega[round_] = np.linalg.solve(inertia[round_], h[round_, :, None])[:, :, 0]
    rest = ~round_
    cutoff = np.broadcast_to(np.where(line, _NARROW**2, 1e-9), len(x))[rest]
    pseudo = np.linalg.pinv(inertia[rest], cutoff, hermitian=True)
    omega[rest] = np.einsum("kab,kb->ka", pseudo, h[rest])
    # Of a point none; not what rounding makes of it.
    return np.where(np.count_nonzero(masses, axis=1)[:, None] > 1, omega, 0.0)


def smallest_singular_value(r: Floats, edges: Ints, masses: ArrayLike | None = None) -> Floats:
    """Smallest non-zero singular value (K,) of the constraint Jacobian J at r (K, N, 3).

    Zero means below 1e-7 of the largest. NaN without edges. With ``masses`` the Jacobian is
    weighted, J M^-1/2 sqrt(mbar), whose squares are the eigenvalues w of mbar A.
    """
    if not len(edges):
        return np.full(len(r), np.nan)
    # Some samples at a time: J of all of them may not fit into memory.
    some = max(1, _ELEMENTS // (len(edges) * r.shape[1] * 3))
    if len(r) > some:
        parts = [r[k : k + some] for k in range(0, len(r), some)]
        return np.concatenate([smallest_singular_value(part, edges, masses) for part in parts])
    i, j = edges.T
    u = r[:, i] - r[:, j]
    u /= np.linalg.norm(u, axis=2, keepdims=True)
    J = np.zeros((len(edges), r.shape[1], len(r), 3))
    rows = np.arange(len(edges))
    J[rows, i], J[rows, j] = u.swapaxes(0, 1), -u.swapaxes(0, 1)
    J = J.transpose(2, 0, 1, 3)
    if masses is not None:
        m = np.asarray(masses, dtype=float)
        J = J * np.sqrt(m.mean() / m)[:, None]
    J = J.reshape(len(r), len(edges), -1)
    # The smaller Gram matrix: a third of the time of a decomposition of J itself.
    gram = J @ J.swapaxes(1, 2) if J.shape[1] <= J.shape[2] else J.swapaxes(1, 2) @ J
    w = np.linalg.eigvalsh(gram)
    w[w < 1e-14 * w[:, -1:]] = np.inf
    return np.sqrt(w.min(axis=1))


#: See `_TRIED`.
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
