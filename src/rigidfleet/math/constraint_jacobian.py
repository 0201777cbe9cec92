"""The constraint Jacobian of distances, J (m, 3N) with rows u_ij and -u_ij, Eq. (5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.typing import Floats, Ints

# Greatest number of values in a temporary array.
_ELEMENTS = 8_000_000


def jacobian(points: ArrayLike, edges: ArrayLike) -> Floats:
    """J (..., m, N d), Eq. (5), of edges (m, 2) at points (..., N, d): a row holds the unit vector u at i and -u at j.

    A row is not finite if its agents are at the same place.
    """
    p = np.asarray(points, dtype=np.float64)
    i, j = np.asarray(edges, dtype=np.int64).reshape(-1, 2).T
    u, row = p.take(i, axis=-2) - p.take(j, axis=-2), np.arange(len(i))
    with np.errstate(divide="ignore", invalid="ignore"):
        u = u / np.sqrt(np.add.reduce(u * u, axis=-1, keepdims=True))
    # Agents of an edge first, samples last, so that an assignment is one pass.
    J = np.zeros((len(i), p.shape[-2], *p.shape[:-2], p.shape[-1]))
    J[row, i] = np.moveaxis(u, -2, 0)
    J[row, j] = -J[row, i]
    J = np.moveaxis(J, (0, 1), (-3, -2))
    return J.reshape(*p.shape[:-2], len(i), p.shape[-2] * p.shape[-1])


def filter_factors(
    w: ArrayLike,
    solver: str,
    *,
    damping: float = 0.03,
    iterations: int = 3,
    threshold: float = 0.1,
    cutoff: float = 1e-3,
) -> Floats:
    """Filter factors w phi(w) of a solver (theory, section 3) for eigenvalues w >= 0 of mbar A, in their shape.

    They are the share of the exact law that the solver keeps: 1 where its multipliers are exact, 0 where it has none
    (Hansen 1998, doi:10.1137/1.9780898719697). "exact" has no solution at w = 0, but the share is 0 there, too.

    Raises
    ------
    ValueError
        The solver is none of those of a mission.
    """
    w = np.asarray(w, dtype=np.float64)
    if solver == "exact":
        return (w > 0).astype(np.float64)
    if solver == "iterated":
        return -np.expm1(iterations * np.log(damping / (w + damping)))
    if solver == "spectral":
        return w / (w + 0.25 * threshold * np.maximum(0.0, 1.0 - w / threshold) ** 2)
    if solver == "pinv":
        x = np.minimum(w / max(cutoff * w.max(initial=0.0), np.finfo(float).tiny), 1.0)
        return (3.0 - 2.0 * x) * x * x
    raise ValueError(f"unknown solver {solver!r}; choose iterated, spectral, exact or pinv")


def smallest_singular_value(r: Floats, edges: Ints, masses: ArrayLike | None = None) -> Floats:
    """Smallest non-zero singular value (K,) of the constraint Jacobian J at r (K, N, 3).

    Eq. (4) counts independent constraints: their number is the rank of J. Zero means below 1e-7 of the largest.
    NaN without edges, and where agents of an edge are at the same place. With ``masses`` the Jacobian is weighted,
    J M^-1/2 sqrt(mbar), whose squares are the eigenvalues w of mbar A.
    """
    if not len(edges):
        return np.full(len(r), np.nan)
    # A few samples at a time: J of all samples may not fit into memory.
    some = max(1, _ELEMENTS // (len(edges) * r.shape[1] * 3))
    if len(r) > some:
        parts = [r[k : k + some] for k in range(0, len(r), some)]
        return np.concatenate([smallest_singular_value(part, edges, masses) for part in parts])
    if masses is None and len(edges) == 3:
        return _least_singular_of_three_edges(r, edges)
    return least_singular(jacobian(r, edges), masses)


def least_singular(J: Floats, masses: ArrayLike | None = None) -> Floats:
    """`smallest_singular_value` (K,) of Jacobians J (K, m, 3N), m > 0."""
    if masses is not None:
        m = np.asarray(masses, dtype=float)
        J = J * np.repeat(np.sqrt(m.mean() / m), 3)
    # The smaller Gram matrix takes a third of the time of a decomposition of J itself.
    turned = J.swapaxes(1, 2)
    gram = J @ turned if J.shape[1] <= J.shape[2] else turned @ J
    known = np.isfinite(gram).all(axis=(1, 2))
    gram[~known] = 0.0
    w = np.asarray(np.linalg.eigvalsh(gram), dtype=float)
    w[~known] = np.nan
    return _root_of_least_nonzero(w)


def _least_singular_of_three_edges(r: Floats, edges: Ints) -> Floats:
    """`smallest_singular_value` (K,) of three edges, in a tenth of the time, which is a third of a first verdict.

    With the cosines c of the angles between edges that share an agent, 0 of others, J J^T is 2 + S, where S has no
    diagonal. Its eigenvalues are the roots of x^3 - p x - 2 c_1 c_2 c_3, p = c_1^2 + c_2^2 + c_3^2, by Viete's formula.
    """
    (i, j), after = np.transpose(edges), [1, 2, 0]
    x = np.ascontiguousarray(r.T)  # rows of samples are faster
    u = x.take(i, axis=1) - x.take(j, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u /= np.sqrt(np.add.reduce(u * u))
    incidence = np.subtract(*np.eye(r.shape[1])[[i, j]])
    c = np.add.reduce(u * u[:, after]) * (incidence * incidence[after]).sum(axis=1)[:, None]
    square = c * c
    p, apart = np.add.reduce(square), square - square[after]
    # p^3 - 27 (c_1 c_2 c_3)^2 as a sum of squares, which is exact where two eigenvalues are nearly equal.
    spread = np.add.reduce((0.5 * p + 3.0 * square[[2, 0, 1]]) * apart * apart)
    angle = np.arctan2(np.sqrt(spread), np.sqrt(27.0) * c[0] * c[1] * c[2]) / 3.0
    turns = 2.0 * np.pi / 3.0 * np.array([[1.0], [2.0], [0.0]])
    return _root_of_least_nonzero((2.0 + 2.0 * np.sqrt(p / 3.0) * np.cos(angle + turns)).T)


def _root_of_least_nonzero(w: Floats) -> Floats:
    """Roots (K,) of the smallest of eigenvalues (K, s), in ascending order, that are not zero."""
    w[w < 1e-14 * w[:, -1:]] = np.inf
    return np.sqrt(w.min(axis=1))
