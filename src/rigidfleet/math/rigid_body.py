"""Rigid bodies: the rotation that fits points to points, and mean axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.typing import Floats


def centred(points: ArrayLike) -> Floats:
    """Points (N, 3) with their geometric centre moved to 0."""
    p = np.asarray(points, dtype=np.float64)
    return p - p.mean(axis=0)


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
