"""Rigid bodies: rotations that fit points to points, and mean axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.typing import Bools, Floats

#: Factors of the columns of U that turn a reflection into a rotation.
_MIRROR = np.array([1.0, 1.0, -1.0])


def centred(points: ArrayLike) -> Floats:
    """Points (N, 3) with their geometric centre moved to 0."""
    p = np.asarray(points, dtype=np.float64)
    return p - p.mean(axis=0)


def rigid_motions(points: Floats, masses: Floats | None = None) -> Floats:
    """Orthonormal basis (N d, t) of translations and rotations of points (N, d).

    With ``masses`` (N,) [kg], motions are weighted by the root of the mass, as in J M^-1/2.
    """
    n, d = points.shape
    m = np.ones(n) if masses is None else masses
    x = about_cm(points, m)
    scale = max(np.linalg.norm(x), np.finfo(float).tiny)
    motions = [np.tile(axis, (n, 1)) / np.sqrt(n) for axis in np.eye(d)]
    for a in range(d):
        for b in range(a + 1, d):
            turn = np.zeros((n, d))
            turn[:, a], turn[:, b] = -x[:, b] / scale, x[:, a] / scale
            motions.append(turn)
    weighted = np.array(motions) * np.sqrt(m / m.mean())[:, None]
    u, s, _ = np.linalg.svd(weighted.reshape(len(motions), n * d).T, full_matrices=False)
    return u[:, s > 1e-9]


def kabsch(
    target: ArrayLike,
    source: ArrayLike,
    weights: ArrayLike | None = None,
    near: ArrayLike | None = None,
    tol: float = 1e-9,
) -> Floats:
    """Rotation R minimising sum_i w_i |target_i - R source_i|^2, both sets taken about their weighted centres.

    With slots as source and positions in the world as target, R is body -> world, the transpose of
    the matrix in Eq. (23). If several rotations fit equally well (points on a line, a mirrored symmetric
    shape), the one nearest to `near` is taken, so that a line gets the *minimal* rotation and no spin about itself.

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
    p, q = (x - np.add.reduce(w * x, axis=-2, keepdims=True) for x in (p, q))
    return best_rotation(*np.linalg.svd((w * p).swapaxes(-1, -2) @ q), near, tol)[0]


def best_rotation(
    u: Floats, s: Floats, vt: Floats, near: ArrayLike | None = None, tol: float = 1e-9
) -> tuple[Floats, Bools]:
    """The rotations of `kabsch`, from the decomposition u, s, vt of sum_i w_i target_i source_i^T (..., 3, 3).

    Returns also where they need no reflection (...).
    """
    rotation = u @ vt
    proper = np.linalg.det(rotation) > 0
    turned = u
    if not proper.all():
        turned = u * np.where(proper[..., None], 1.0, _MIRROR)[..., None, :]
        rotation = turned @ vt
    first, second, third = s[..., 0], s[..., 1], s[..., 2]
    free = (second <= tol * first) | (~proper & (second - third <= tol * first))
    if free.any():
        guide = np.eye(3) if near is None else np.asarray(near, dtype=np.float64)
        equal = np.add.reduce(s <= s[..., 2:] + tol * s[..., :1], axis=-1, dtype=np.int64)
        for some in set(equal[free].tolist()):
            these = ... if s.ndim == 1 else free & (equal == some)
            rotation[these] = _nearest_fit(turned[these], vt[these], guide, some)
        rotation[first == 0.0] = guide
    return rotation, proper


def _nearest_fit(u: Floats, vt: Floats, near: Floats, equal: int) -> Floats:
    """Of the rotations that fit as well as U V^T, the ones nearest to `near` (3, 3); u, vt (..., 3, 3).

    With the last column of U reversed, they are U (1 - 2 n n^T) V^T, where n is any unit vector in the span of
    the smallest singular directions, of which so many are ``equal``.
    """
    u = u * _MIRROR
    overlap = (vt @ near.T @ u)[..., -equal:, -equal:]
    n = np.linalg.eigh(overlap + overlap.swapaxes(-1, -2))[1][..., :1]
    u[..., -equal:] -= 2.0 * (u[..., -equal:] @ n) * n.swapaxes(-1, -2)
    return u @ vt


def mean_axis_rates(x: Floats, y: Floats, masses: Floats) -> Floats:
    """Angular velocity omega = I^+ h (K, 3) [rad/s], world axes, of agents about their CM.

    h is that of Eq. (17).

    x, y (K, N, 3): positions and velocities about the CM [m, m/s]; masses (N,) or (K, N).
    """
    masses = np.broadcast_to(masses, x.shape[:2])
    weighted = np.swapaxes(masses[..., None] * x, 1, 2)
    C, D = weighted @ x, weighted @ y
    D = D - np.swapaxes(D, 1, 2)  # of which h is the axial vector
    h = np.stack([D[:, 1, 2], D[:, 2, 0], D[:, 0, 1]], axis=1)
    inertia = np.trace(C, axis1=1, axis2=2)[:, None, None] * np.eye(3) - C
    # Far from a line, the inverse equals the pseudo-inverse and takes a third of the time.
    size = np.trace(inertia, axis1=1, axis2=2)
    with np.errstate(over="ignore", invalid="ignore"):  # without inertia there are no rates
        round_ = np.linalg.det(inertia) > 1e-4 * size**3
    omega = np.empty((len(x), 3))
    omega[round_] = np.linalg.solve(inertia[round_], h[round_, :, None])[:, :, 0]
    if not round_.all():
        pseudo = np.linalg.pinv(inertia[~round_], 1e-9, hermitian=True)
        omega[~round_] = np.einsum("kab,kb->ka", pseudo, h[~round_])
    # A single point has no rates; rounding would give some.
    return np.where(np.count_nonzero(masses, axis=1)[:, None] > 1, omega, 0.0)


def about_cm(points: Floats, masses: Floats) -> Floats:
    """Points (N, 3) [m] relative to their centre of mass."""
    return points - masses @ points / masses.sum()
