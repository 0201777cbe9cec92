"""Gusts: their intensities and lengths near the ground, and their correlation between places."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.typing import Floats

_FOOT = 0.3048  # [m]


def low_altitude_gusts(height: float, wind: float) -> tuple[Floats, Floats]:
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


def correlate_agents(white: Floats, correlation: float) -> Floats:
    """Samples (..., N, 3) with the same correlation between any two agents, from white samples (..., N + 1, 3)."""
    own, common = white[..., :-1, :], white[..., -1:, :]
    return math.sqrt(1.0 - correlation) * own + math.sqrt(correlation) * common


def correlate_by_distance(white: Floats, points: ArrayLike, length: float) -> Floats:
    """Samples (..., N, 3) with the correlation exp(-distance / length) between agents at points (N, 3) [m]."""
    p = np.asarray(points, dtype=np.float64)
    apart = np.linalg.norm(p[:, None] - p, axis=2)
    # Nearly coincident places would make the matrix singular to rounding.
    mixing = np.linalg.cholesky(np.exp(-apart / length) + 1e-12 * np.eye(len(p)))
    by_axis = np.moveaxis(white, -1, 0)
    mixed = by_axis.reshape(-1, len(mixing)) @ mixing.T  # one product, not many small ones
    return np.moveaxis(mixed.reshape(by_axis.shape), 0, -1)
