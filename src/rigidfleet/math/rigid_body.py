"""Rigid bodies: rotations that fit points to points, and mean axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.typing import Bools, Floats


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

    With the last column of U reversed, they are U (1 - 2 n n^T) V^T, where n is any unit vector in the span of
    the equal smallest singular directions.
    """
    if s[0] == 0:
        return near.copy()
    u = u * [1, 1, -1]
    equal = int(np.count_nonzero(s <= s[2] + tol * s[0]))
    overlap = (vt @ near.T @ u)[-equal:, -equal:]
    n = np.zeros(3)
    n[-equal:] = np.linalg.eigh(overlap + overlap.T)[1][:, 0]
    return (u - 2 * np.outer(u @ n, n)) @ vt


# Slots thinner than this, relative to their length, count as a line in an attitude fit.
_THIN = 1e-3


# Slots narrower than the first count as a line unless their width exceeds the agents' errors by the second factor.
_NARROW = 0.1


_SURE = 4.0


# A rotation counts as half a turn if 1 + cos of its angle is smaller: within 1e-8 rad.
_HALF_TURN = 5e-17


def fit_attitudes(x: Floats, p: Floats, masses: Floats, near: Floats) -> tuple[Floats, Bools]:
    """Attitude T (K, 3, 3), world -> body, of slots fitted to agents at each of K samples (Kabsch).

    Also returns whether the slots count as a line (K,). If the expected attitude is known, narrow slots count as a
    line when the agents' errors exceed their width, because the rotation about the long axis is then random.

    Parameters
    ----------
    x, p : (K, N, 3) agents about their CM in world axes, and slots in body axes [m]
    masses : (N,) weights [kg]
    near : (K, 3, 3) or (3, 3) the expected attitude, which decides what the fit leaves open: the spin of a line
        about itself. With one matrix, each later sample uses the attitude of the sample before.
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
    # Each sample on a line continues from the sample before; all rotations between samples are computed first.
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

    For points too wide to be a line, two other values with a ratio that shows this.
    """
    # Slots are mostly constant: one decomposition then serves all samples.
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
    """Attitudes (K, 3, 3) of lines: ``near``, followed by the smallest rotation that aligns each axis."""
    now = np.einsum("kba,kb->ka", near, axis)
    return near @ _smallest_turns(now, _directions(x, p, axis)).swapaxes(1, 2)


def _directions(x: Floats, p: Floats, axis: Floats) -> Floats:
    """Direction of the slots' long axis (K, 3) among agents x (K, N, 3): unit vectors, or zero."""
    there = np.einsum("ki,kia->ka", np.einsum("kia,ka->ki", p, axis), x)
    length = np.linalg.norm(there, axis=1)
    return there / np.where(length == 0.0, 1.0, length)[:, None]


def _smallest_turns(now: Floats, there: Floats) -> Floats:
    """Smallest rotations (K, 3, 3) from unit vectors to others (K, 3); the identity for zero vectors."""
    # 1 + c with the cosine c of the angle, accurate up to half a turn; irrelevant for zero vectors.
    near = 0.5 * ((now + there) ** 2).sum(axis=1)
    opposite = (near < _HALF_TURN) & now.any(axis=1) & there.any(axis=1)
    skew = there[:, :, None] * now[:, None, :]  # of now x there, less its transpose
    skew = skew - skew.swapaxes(1, 2)
    R = np.eye(3) + skew + skew @ skew / np.where(near < _HALF_TURN, 1.0, near)[:, None, None]
    for k in np.flatnonzero(opposite):  # half a turn: any axis perpendicular to the line
        across = np.cross(now[k], np.eye(3)[np.abs(now[k]).argmin()])
        across /= np.linalg.norm(across)
        R[k] = 2.0 * np.outer(across, across) - np.eye(3)
    return R


def mean_axis_rates(x: Floats, y: Floats, masses: Floats, line: ArrayLike = False) -> Floats:
    """Angular velocity omega = I^+ h (K, 3) [rad/s], world axes, of agents about their CM.

    h is that of Eq. (17).

    x, y (K, N, 3): positions and velocities about the CM [m, m/s]; masses (N,) or (K, N); line (K,): whether the
    agents count as a line, without spin about itself. The spin of a line bent by some centimetres would be noise.
    """
    masses = np.broadcast_to(masses, x.shape[:2])
    h = np.einsum("ki,kia->ka", masses, np.cross(x, y))
    C = np.einsum("ki,kia,kib->kab", masses, x, x)
    inertia = np.trace(C, axis1=1, axis2=2)[:, None, None] * np.eye(3) - C
    # Far from a line, the inverse equals the pseudo-inverse and takes a third of the time.
    size = np.trace(inertia, axis1=1, axis2=2)
    with np.errstate(over="ignore", invalid="ignore"):  # without inertia there are no rates
        round_ = ~np.broadcast_to(line, len(x)) & (np.linalg.det(inertia) > 1e-4 * size**3)
    omega = np.empty((len(x), 3))
    omega[round_] = np.linalg.solve(inertia[round_], h[round_, :, None])[:, :, 0]
    rest = ~round_
    cutoff = np.broadcast_to(np.where(line, _NARROW**2, 1e-9), len(x))[rest]
    pseudo = np.linalg.pinv(inertia[rest], cutoff, hermitian=True)
    omega[rest] = np.einsum("kab,kb->ka", pseudo, h[rest])
    # A single point has no rates; rounding would give some.
    return np.where(np.count_nonzero(masses, axis=1)[:, None] > 1, omega, 0.0)


def about_cm(points: Floats, masses: Floats) -> Floats:
    """Points (N, 3) [m] relative to their centre of mass."""
    return points - masses @ points / masses.sum()
