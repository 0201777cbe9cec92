"""Samples of random processes for gusts and sensor noise, with a spectrum and correlation between places.

Shaping filters are discretised exactly: from the first sample on, samples have the covariances of the continuous
process for any step. The input is white standard-normal samples, so that the caller controls the seeds.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.typing import Floats

_FOOT = 0.3048  # [m]


def first_order(white: Floats, step: float, tau: float) -> Floats:
    """Gauss-Markov process (K, ...) of unit variance and autocorrelation exp(-|t| / tau).

    x_{k+1} = a x_k + sqrt(1 - a^2) e_k with a = exp(-step / tau), stationary from the start (Uhlenbeck and
    Ornstein, 1930). Parameters: white samples e (K, ...); their step and tau [s].
    """
    a = math.exp(-step / tau)
    x = white * math.sqrt(-math.expm1(-2.0 * step / tau))
    x[0] = white[0]
    return _followed(x.reshape(len(x), 1, -1), np.array([[a]])).reshape(x.shape)


def second_order(white: Floats, step: float, tau: float) -> Floats:
    """Dryden's transverse process (K, ...), unit variance, autocorrelation exp(-s) (1 - s / 2), s = |t| / tau.

    Its spectrum is that of (1 + sqrt(3) tau s) / (1 + tau s)^2, the lateral and vertical filter of MIL-F-8785C. In
    partial fractions it is y = sqrt(3) z1 + (1 - sqrt(3)) z2 with tau dz1/dt = -z1 + e, tau dz2/dt = -z2 + z1,
    whose transition matrix and covariances are known in closed form.

    Parameters: white samples (K, 2, ...), two for each sample; their step and tau [s].
    """
    from scipy.special import gammainc

    s = step / tau
    A = math.exp(-s) * np.array([[1.0, 0.0], [s, 1.0]])
    P = np.array([[1.0, 0.5], [0.5, 0.5]])  # stationary
    # P - A P A^T by incomplete gamma functions: for a short step, differences would cancel.
    q11, q12, q22 = gammainc([1, 2, 3], 2.0 * s) * [1.0, 0.5, 0.5]
    low = q12 / math.sqrt(q11)
    root = np.array([[math.sqrt(q11), 0.0], [low, math.sqrt(q22 - low**2)]])
    start = np.linalg.cholesky(P)
    z = np.einsum("ab,kb...->ka...", root, white)
    z[0] = np.tensordot(start, white[0], 1)
    z = _followed(z.reshape(len(z), 2, -1), A).reshape(z.shape)
    return (math.sqrt(3.0) * z[:, 0] + (1.0 - math.sqrt(3.0)) * z[:, 1]) / math.sqrt(2.0)


def _followed(x: Floats, A: Floats) -> Floats:
    """Solve z_{k+1} = A z_k + x_{k+1} from z_0 = x_0; x and z (K, n, M), A (n, n).

    By doubling: after the pass with a shift of s samples, z_k holds the terms A^j x_{k-j} with j < 2 s.
    """
    shift = 1
    while shift < len(x) and A.any():
        x = np.concatenate([x[:shift], x[shift:] + A @ x[:-shift]])
        shift, A = 2 * shift, A @ A
    return x


def low_altitude(height: float, wind: float) -> tuple[Floats, Floats]:
    """Intensities (3,) [m/s] and lengths (3,) [m] of Dryden's gusts near the ground, by MIL-F-8785C.

    Along the wind, across and vertical, h in feet: sigma_w = 0.1 W, sigma_u = sigma_v = sigma_w / (0.177 + 0.000823
    h)^0.4; L_w = h, L_u = L_v = h / (0.177 + 0.000823 h)^1.2. Valid from 10 to 1000 ft.

    Parameters: height above ground [m]; mean wind speed W 20 ft above ground [m/s].
    """
    h = height / _FOOT
    factor = 0.177 + 0.000823 * h
    vertical = 0.1 * wind
    along = h / factor**1.2 * _FOOT
    return (
        np.array([vertical / factor**0.4, vertical / factor**0.4, vertical]),
        np.array([along, along, height]),
    )


def correlate_evenly(white: Floats, correlation: float) -> Floats:
    """Samples (..., N, 3) with the same correlation between any two agents, from white samples (..., N + 1, 3)."""
    own, common = white[..., :-1, :], white[..., -1:, :]
    return math.sqrt(1.0 - correlation) * own + math.sqrt(correlation) * common


def correlate_by_distance(white: Floats, points: ArrayLike, length: float) -> Floats:
    """Samples (..., N, 3) with the correlation exp(-distance / length) between agents at points (N, 3) [m]."""
    p = np.asarray(points, dtype=np.float64)
    apart = np.linalg.norm(p[:, None] - p[None], axis=2)
    # Nearly coincident places would make the matrix singular to rounding.
    C = np.exp(-apart / length) + 1e-12 * np.eye(len(p))
    return np.einsum("ij,...jq->...iq", np.linalg.cholesky(C), white)


def spline_coefficients(samples: Floats) -> Floats:
    """Coefficients (K + 2, ...) of the natural cubic B-spline through samples (K, ...), K >= 2, on even knots."""
    from scipy.linalg import solve_banded

    n = len(samples)
    flat = samples.reshape(n, -1)
    inner = np.empty_like(flat)
    inner[0], inner[-1] = flat[0], flat[-1]
    if n > 2:
        right = 6.0 * flat[1:-1]
        right[0] -= flat[0]
        right[-1] -= flat[-1]
        bands = np.ones((3, n - 2))
        bands[1] = 4.0
        inner[1:-1] = solve_banded((1, 1), bands, right, overwrite_b=True)
    ends = 2.0 * inner[[0]] - inner[[1]], 2.0 * inner[[-1]] - inner[[-2]]
    return np.concatenate([ends[0], inner, ends[1]]).reshape(n + 2, *samples.shape[1:])
