"""Choose the edges of a formation: the fewest that hold the shape, or some more, with the best rigidity index.

Among all graphs that hold a shape with a given number of edges, the best one has the Jacobian with the greatest
smallest singular value, because forces, and displacements due to small length errors, grow with its inverse
(`rigidity.Rigidity.force`). In statistics this is the E-optimal design of an experiment. The search
drops the least useful of all candidates, and then exchanges edges as long as that helps.
"""

from __future__ import annotations

from bisect import bisect_left
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet._common.arguments import as_numbers
from rigidfleet._common.renamed import getattr_of_earlier_names
from rigidfleet._common.threads import single_blas_thread
from rigidfleet.errors import wrong_type
from rigidfleet.formation.distance_geometry import dimension, distances
from rigidfleet.formation.graphs import complete_graph
from rigidfleet.rigidity import full_rank, jacobian, rigid_motions
from rigidfleet.rigidity.analysis import as_framework, flatten_points
from rigidfleet.typing import Floats, Ints

#: Positions of the exchange's barrier, as shares of the smallest eigenvalue, step by step.
_BARRIERS = (0.0, 0.5, 0.8, 0.95)

#: Work of a search, in multiplications: a second or two.
_WORK = 2e9

#: Eigenvalues below this count as zero: an edge is missing.
_SINGULAR = 1e-9

#: Number of perturbed designs without improvement, in a row, after which the search ends.
_PATIENCE = 60

#: Number of candidate edges, the most helpful ones, that are tried against all that could be removed: more take twice
#: the time, for designs that are as good.
_WORTH = 100


@single_blas_thread()
def design(
    slots: ArrayLike,
    *,
    extra: int | Literal["complete"] = 0,
    sensing_range: float | None = None,
    seed: int = 0,
) -> Ints:
    """Edges (m, 2), i < j, in lexical order, that hold a shape, with the best rigidity index found.

    The number of edges is 3N - 6 in space, 2N - 3 in a plane and N - 1 on a line (`limits` says what distances do not
    hold there), plus `extra` redundant ones. Let M be the sum of a a^T over the chosen rows a of J (without the rigid
    motions), and w its smallest eigenvalue. Edges are exchanged, the best pair at a time, as long as this lowers the
    barrier potential tr (M - t)^-1, for t = 0 and then closer and closer to w (Batson, Spielman and Srivastava,
    2012). The search starts from all candidates thinned out, from Delaunay's triangulation or from the convex hull,
    whichever is best, and again from perturbed designs while its budget lasts: a tenth of a second for 8 agents, one
    or two seconds for 30, some seconds for 100.

    Parameters
    ----------
    slots : (N, 3) [m]
    extra : number of redundant edges, or "complete" for all within range
    sensing_range : the greatest length of an edge [m], default unlimited
    seed : of the perturbations; the same seed gives the same graph

    Raises
    ------
    ValueError
        Two slots coincide; or no edges within range hold the shape (the message gives a sufficient range).
    """
    p, _ = as_framework(as_numbers("slots [m]", slots), [])
    flat, _ = flatten_points(p, max(1, dimension(p)))
    n, d = flat.shape
    edges = complete_graph(n)
    length = distances(p, edges)
    if (length <= 1e-9 * length.max(initial=0.0)).any():
        i, j = edges[length.argmin()] + 1
        raise ValueError(f"slots {i} and {j} coincide")
    if not (extra == "complete" or isinstance(extra, int | np.integer)):
        raise wrong_type("a number of extra edges or 'complete'", extra)
    if extra != "complete" and extra < 0:
        raise ValueError(f"extra must be >= 0 or 'complete', not {extra}")
    reach = np.inf if sensing_range is None else sensing_range * (1 + 1e-9)
    near = edges[length <= reach]
    rank = full_rank(n, d)
    if rank == 0:
        return near if extra == "complete" else near[:0]
    rows = _jacobian_nonrigid_part(flat, edges)
    _assert_reach_holds_shape(rows, length, reach, rank)
    wanted = len(near) if extra == "complete" else rank + extra
    if wanted >= len(near):
        return near
    rows = rows[length <= reach]
    meshes = [np.arange(len(near)), *_delaunay_hull_edge_indices(flat, near)]
    starts = [_add_rows(rows, _keep_best_rows(rows, some, wanted), wanted) for some in meshes]
    chosen = max(starts, key=lambda some: _least_eigenvalue(rows[some]))
    rng = np.random.default_rng(seed)
    best, best_w = chosen, _least_eigenvalue(rows[chosen])
    work, idle = 0.0, 0
    while True:
        chosen, used = _better_rows_and_work(rows, chosen)
        w = _least_eigenvalue(rows[chosen])
        idle += 1
        if w > best_w * (1 + 1e-9):
            best, best_w, idle = chosen, w, 0
        work += used
        if work + used > _WORK or idle == _PATIENCE:
            return near[np.sort(best)]
        chosen = _perturb(rows, best, rng)


def free_motions_text(slots: ArrayLike) -> str:
    """Motions of a flat or straight shape that distances cannot prevent, in words; "" for a spatial shape."""
    n, d = len(np.asarray(slots)), dimension(slots)
    if d == 3 or n <= d + 1:
        return ""
    where, count, free = {
        1: ("straight", 2 * (n - 2), "sideways off the line"),
        2: ("flat", n - 3, "out of the plane"),
    }.get(d, ("a point", 0, ""))
    return (
        f"The shape is {where}: to first order no distance resists motion {free}, so {count} "
        f"motion{'s' * (count != 1)} stay{'s' * (count == 1)} free with any edges. Redundant edges can block them by a "
        "self-stress, but only softly; slots hold them firmly (control = 'tracking')."
    )


def mission_fragment(
    name: str, slots: ArrayLike, edges: ArrayLike | str, reach: float | None = None
) -> str:
    """A formation as a part of a mission file, agents counted from 1.

    The name is quoted if TOML requires it. Slots keep all digits, because flat shapes need them. ``edges`` may
    be one of `formation.graphs.GRAPHS`.
    """
    from rigidfleet._common.toml import to_toml

    pairs = edges if isinstance(edges, str) else np.reshape(edges, (-1, 2)).astype(np.int64) + 1
    points = np.asarray(slots, dtype=np.float64) + 0.0  # no -0.0
    return to_toml({"formations": {name: {"slots": points, "edges": pairs, "reach": reach}}})


def _jacobian_nonrigid_part(flat: Floats, edges: Ints) -> Floats:
    """Rows of J (m, r) in coordinates of the non-rigid motions."""
    n, d = flat.shape
    rigid = rigid_motions(flat)
    rest = np.linalg.svd(rigid, full_matrices=True)[0][:, rigid.shape[1] :].reshape(n, d, -1)
    u = jacobian(flat, edges).reshape(-1, n, d)
    i, j = edges.T
    at = np.arange(len(edges))
    return np.einsum("md,mdr->mr", u[at, i], rest[i] - rest[j])


def _least_eigenvalue(rows: Floats) -> float:
    """Smallest eigenvalue of the sum of a a^T over rows a (m, r)."""
    if len(rows) < rows.shape[1]:
        return 0.0
    return float(np.linalg.svd(rows, compute_uv=False)[-1] ** 2)


def _assert_reach_holds_shape(rows: Floats, length: Floats, reach: float, rank: int) -> None:
    def rank_within(r: float) -> int:
        within = rows[length <= r]
        return int(np.linalg.matrix_rank(within.T @ within, tol=1e-10)) if len(within) else 0

    got = rank_within(reach)
    if got == rank:
        return
    steps = np.unique(np.round(length, 9))
    enough = bisect_left(steps[:-1].tolist(), rank, key=lambda r: rank_within(r * (1 + 1e-8)))
    raise ValueError(
        f"a sensing range of {reach:.6g} m gives only {got} of the {rank} independent edges that "
        f"hold this shape; {steps[enough]:.6g} m is enough"
    )


def _delaunay_hull_edge_indices(flat: Floats, near: Ints) -> list[Ints]:
    """The edges, as indices into `near`, of Delaunay's triangulation and of the convex hull of points (N, d)."""
    from scipy.spatial import ConvexHull, Delaunay, QhullError

    if flat.shape[1] < 2:
        return []
    meshes = []
    number = {tuple(edge): k for k, edge in enumerate(near.tolist())}
    for mesh in (Delaunay, ConvexHull):
        try:
            cells = mesh(flat).simplices.tolist()
        except QhullError:
            continue
        pairs = {pair for cell in cells for pair in combinations(sorted(cell), 2)}
        meshes.append(np.array(sorted(number[p] for p in pairs if p in number), dtype=np.int64))
    return meshes


def _keep_best_rows(rows: Floats, chosen: Ints, wanted: int) -> Ints:
    """The chosen rows reduced to (wanted,): the least useful are removed, a tenth of the surplus at a time.

    Without row a, tr M^-1 grows by |M^-1 a|^2 / (1 - a^T M^-1 a).
    """
    if len(chosen) <= wanted or _least_eigenvalue(rows[chosen]) < _SINGULAR:
        return chosen[:wanted]
    share = 0.1
    while (surplus := len(chosen) - wanted) > 0:
        A = rows[chosen]
        G = np.linalg.inv(A.T @ A)
        GA = A @ G
        left = 1 - (GA * A).sum(axis=1)
        loss = np.where(left > 1e-9, (GA**2).sum(axis=1) / np.maximum(left, 1e-9), np.inf)
        drop = max(1, int(share * surplus))
        keep = np.sort(np.argsort(loss, kind="stable")[drop:])
        if drop > 1 and _least_eigenvalue(A[keep]) < 1e-3 * _least_eigenvalue(A):
            share /= 2  # rank lost: remove fewer at a time
            continue
        chosen = chosen[keep]
    return chosen


def _add_rows(rows: Floats, chosen: Ints, wanted: int) -> Ints:
    """The chosen rows and the most useful of the others, (wanted,); arbitrary others if the chosen rows lack rank."""
    while len(chosen) < wanted:
        A = rows[chosen]
        other = np.setdiff1d(np.arange(len(rows)), chosen)
        w = _least_eigenvalue(A)
        if w < _SINGULAR:
            return np.append(chosen, other[: wanted - len(chosen)])
        BG = rows[other] @ np.linalg.inv(A.T @ A - 0.5 * w * np.eye(A.shape[1]))
        gain = (BG**2).sum(axis=1) / (1 + (BG * rows[other]).sum(axis=1))
        chosen = np.append(chosen, other[gain.argmax()])
    return chosen


def _better_rows_and_work(rows: Floats, chosen: Ints) -> tuple[Ints, float]:
    """A design that no exchange of one edge improves, and the work spent."""
    m, r = rows.shape
    work = 0.0
    for barrier in _BARRIERS:
        for _ in range(4 * r):
            work += 0.1 * m * r**2 + 2.0 * r**3 + 5e5
            least = _least_eigenvalue(rows[chosen]) if barrier else 0.0
            swap = _best_swap(rows, chosen, barrier * least)
            if swap is None or work > _WORK:
                break
            chosen = np.append(np.delete(chosen, swap[0]), swap[1])
    return chosen, work


def _best_swap(rows: Floats, chosen: Ints, floor: float) -> tuple[int, int] | None:
    """The exchange (position in chosen, row) that most lowers tr (M - floor)^-1 and keeps M > floor; None if none does.

    Two rank-one updates of the inverse G = (M - floor)^-1, for all pairs at once: first b comes, then a goes.
    """
    A = rows[chosen]
    r = A.shape[1]
    other = np.delete(np.arange(len(rows)), chosen)
    B = rows[other]
    G = np.linalg.inv(A.T @ A - floor * np.eye(r))
    AG, BG = A @ G, B @ G
    b1, b2 = 1 + (BG * B).sum(axis=1), (BG**2).sum(axis=1)
    top = np.argsort(-b2 / b1, kind="stable")[:_WORTH]
    other, B, BG, b1, b2 = other[top], B[top], BG[top], b1[top], b2[top]
    cross, cross2 = AG @ B.T, AG @ BG.T  # a G b and a G^2 b
    a1, a2 = (AG * A).sum(axis=1), (AG**2).sum(axis=1)
    gain = b2 / b1
    left = 1 - a1[:, None] + cross**2 / b1
    ratio = cross / b1
    cost = a2[:, None] - 2 * ratio * cross2 + ratio**2 * b2
    change = np.where(left > 1e-9, cost / np.maximum(left, 1e-9), np.inf) - gain
    a, b = np.unravel_index(change.argmin(), change.shape)
    if change[a, b] > -1e-9 * np.trace(G):
        return None
    return int(a), int(other[b])


def _perturb(rows: Floats, chosen: Ints, rng: np.random.Generator) -> Ints:
    """The design with some edges exchanged at random."""
    m, wanted = len(rows), len(chosen)
    other = np.setdiff1d(np.arange(m), chosen)
    add = min(len(other), int(rng.integers(2, max(3, wanted // 3) + 1)))
    some = np.concatenate([chosen, rng.choice(other, add, replace=False)])
    # Old edges are removed first, in random order; added ones stay unless rank is lost.
    order = rng.permutation(wanted)
    keep = np.ones(len(some), dtype=bool)
    gone = 0
    for k in [*order, *range(wanted, len(some))]:
        if gone == add:
            break
        keep[k] = False
        if _least_eigenvalue(rows[some[keep]]) < _SINGULAR:
            keep[k] = True
        else:
            gone += 1
    return some[keep] if gone == add else chosen


__getattr__ = getattr_of_earlier_names(__name__, limits="free_motions_text")
