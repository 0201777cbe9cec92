"""Where a vehicle falls that has no thrust: ballistic, with drag that is linear in the speed through steady air.

With k the drag per mass, w the wind and g gravity, v' = k (w - v) - g z. A time tau after the failure

    r = r0 + v0 phi + w (tau - phi) - g psi z,    phi = (1 - exp(-k tau)) / k,    psi = (tau - phi) / k,

which is the parabola where k is zero, and the same as r0 + v0 tau + psi (k (w - v0) - g z).
"""

from __future__ import annotations

import numpy as np

from rigidfleet.typing import Floats

#: k tau below which psi is a series, whose rest is below 1e-13 of it; steps of Halley's iteration, and the last one,
#: relative: the error is about its cube.
_SMALL, _STEPS, _CLOSE = 0.02, 60, 1e-5


def drag_integrals(k: Floats, tau: Floats) -> tuple[Floats, Floats]:
    """phi [s] and psi [s^2] of a drag per mass k [1/s] and a time tau [s]."""
    x = k * tau
    far = np.maximum(x, _SMALL)
    series = 0.5 - x / 6.0 * (1.0 - x / 4.0 * (1.0 - x / 5.0 * (1.0 - x / 6.0 * (1.0 - x / 7.0))))
    share = np.where(x < _SMALL, series, (far + np.expm1(-far)) / far**2)
    return tau - x * tau * share, tau * tau * share


def fall_time(height: Floats, climb: Floats, k: Floats, wind: float, g: float) -> Floats:
    """Time [s] until a fall is through a height [m] below its start, downwards; from a ``climb`` [m/s] upwards.

    ``k`` is the drag per mass [1/s], ``wind`` the speed of the air upwards [m/s], ``g`` gravity [m/s^2]. All arrays are
    of one shape. A height below zero counts as zero.
    """
    height = np.maximum(height, 0.0)
    tau = (climb + np.sqrt(climb * climb + 2.0 * g * height)) / g
    if not np.any(k):
        return np.maximum(tau, 0.0)
    for _ in range(_STEPS):
        phi, psi = drag_integrals(k, tau)
        z = height + climb * phi + wind * (tau - phi) - g * psi
        speed = climb * (1.0 - k * phi) + k * phi * wind - g * phi
        pull = k * (wind - speed) - g
        newton = z / np.minimum(speed, -1e-9)
        step = newton / np.maximum(1.0 - 0.5 * newton * pull / np.minimum(speed, -1e-9), 0.5)
        tau = np.maximum(tau - step, 0.0)
        if (np.abs(step) <= _CLOSE * (1.0 + tau)).all():
            break
    return tau


def landing_places(r: Floats, v: Floats, tau: Floats, k: Floats, wind: Floats) -> Floats:
    """Places (..., 2) [m] as seen from above, a time (...) [s] after vehicles at r, with v (..., 3), have failed."""
    phi = drag_integrals(k, tau)[0][..., None]
    return r[..., :2] + v[..., :2] * phi + wind[:2] * (tau[..., None] - phi)


def fall_places(r: Floats, v: Floats, time: Floats, k: float, wind: Floats, g: float) -> Floats:
    """Places (K, 3) [m] at times (K,) [s] after a vehicle at r, with v (3,), has failed."""
    psi = drag_integrals(np.full(len(time), k), time)[1][:, None]
    return r + v * time[:, None] + psi * (k * (wind - v) - g * np.array([0.0, 0.0, 1.0]))
