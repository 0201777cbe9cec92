"""The rigidity index of large formations: both ends of the spectrum of J, without a dense matrix."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.math.rigid_body import rigid_motions
from rigidfleet.rigidity.framework import ZERO
from rigidfleet.typing import Floats, Ints

#: Number of eigenvalues computed at the lower end, besides those of rigid motions.
_LOWEST = 6
#: Number of restarts after which eigenvalues not found count as zero; some seconds at 2,000 agents.
_MOST_RESTARTS = 300
#: Number of agents beyond which the required factor is too large.
MOST_FACTORED = 5000


@dataclass(frozen=True)
class Spectrum:
    """Ends of the spectrum of mbar A, A = J M^-1 J^T.

    ``w`` is the smallest eigenvalue that belongs to no rigid motion, 0 if the formation is flexible to first order;
    ``free`` counts the non-rigid motions that no distance resists, as far as they were computed.
    """

    w: float
    w_max: float
    free: int

    @property
    def index(self) -> float:
        """Smallest non-zero singular value of J, of equal masses."""
        return float(np.sqrt(self.w))

    @property
    def condition(self) -> float:
        """Condition number of A without rigid motions; infinite if the formation is flexible."""
        return self.w_max / self.w if self.w > 0 else np.inf

    def data(self) -> dict[str, Any]:
        """Plain data."""
        condition = self.condition if self.w > 0 else None
        return {"w": self.w, "index": self.index, "condition": condition, "free": self.free}


def spectrum(points: ArrayLike, edges: Ints, masses: ArrayLike) -> Spectrum:
    """Both ends of the spectrum of a formation, by Lanczos' method, with inversion at the lower end.

    Parameters: points (N, d) [m], d the dimension of the space in which they move; edges (m, 2); masses (N,) [kg].
    """
    from scipy.sparse import csr_array, eye_array
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh, splu

    p, m = np.asarray(points, dtype=np.float64), np.asarray(masses, dtype=np.float64)
    (n, d), count = p.shape, len(edges)
    u = p[edges[:, 0]] - p[edges[:, 1]]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    share = np.sqrt(m.mean() / m)
    data = np.stack([u * share[edges[:, 0], None], -u * share[edges[:, 1], None]], axis=1)
    columns = d * edges[:, :, None] + np.arange(d)
    rows = np.arange(0, 2 * d * count + 1, 2 * d)
    J = csr_array((data.ravel(), columns.ravel(), rows), (count, d * n))
    K = (J.T @ J).tocsc()
    start = np.random.default_rng(0).normal(size=d * n)
    w_max = float(eigsh(K, k=1, v0=start, return_eigenvectors=False)[0])
    # A shift slightly below zero, where K can be factored. Rigid motions are removed: they would hide the next ones.
    shift = -1e-6 * w_max
    solve, rigid = splu(K - shift * eye_array(d * n, format="csc")).solve, rigid_motions(p, m)

    def apply_inverse(x: Floats) -> Floats:
        y = solve(x - rigid @ (rigid.T @ x))
        return y - rigid @ (rigid.T @ y)

    operator = LinearOperator(K.shape, matvec=apply_inverse, dtype=np.float64)  # ty: ignore
    few = min(_LOWEST, d * n - rigid.shape[1])
    try:
        held = eigsh(
            K, k=few, sigma=shift, OPinv=operator, v0=apply_inverse(start), return_eigenvectors=False, tol=1e-9,
            maxiter=_MOST_RESTARTS,
        )  # fmt: skip
    except ArpackNoConvergence:  # many eigenvalues close to zero cannot be separated
        return Spectrum(0.0, w_max, _LOWEST)
    zero = held < (10 * ZERO) ** 2 * w_max
    return Spectrum(0.0 if zero.any() else float(held.min()), w_max, int(np.count_nonzero(zero)))
