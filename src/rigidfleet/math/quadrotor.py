"""Statics and flatness of quadrotors: rotors to wrench, and attitude and rates from a path and its derivatives.

Mellinger and Kumar, "Minimum Snap Trajectory Generation and Control for Quadrotors", ICRA 2011: position and yaw over
time determine attitude, rates, torques and rotor forces.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rigidfleet.math import series
from rigidfleet.typing import Floats

#: Rotors of an X quadrotor, a row each: x forward and y left as shares of the diagonal, and the sign of the torque
#: about z that the drag of the rotor has on the body. Front left, front right, rear right, rear left.
ROTORS = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, -1.0]]) * [
    np.sqrt(0.5),
    np.sqrt(0.5),
    1.0,
]


def mixing(arm: float, ratio: float) -> Floats:
    """Matrix (4, 4) from rotor forces [N] to thrust [N] and torque (x, y, z) [N m].

    Parameters
    ----------
    arm : distance of the rotors from the centre of mass [m]
    ratio : torque per thrust of a rotor, k_m / k_f [m]
    """
    x, y, spin = ROTORS.T
    return np.stack([np.ones(4), arm * y, -arm * x, ratio * spin])


class Flat(NamedTuple):
    """What a path asks of a quadrotor, at K times."""

    thrust: Floats  # (K,) [N]
    axes: Floats  # (K, 3, 3) columns are the body's axes in the world
    omega: Floats  # (K, 3) body axes [rad/s]
    omega_dot: Floats  # (K, 3) [rad/s^2]

    @property
    def tilt(self) -> Floats:
        """Angle (K,) [rad] of the thrust from the vertical."""
        return np.arccos(np.clip(self.axes[:, 2, 2], -1.0, 1.0))

    def rotor_forces(self, inertia: Floats, mix: Floats) -> Floats:
        """Force (K, 4) [N] of each rotor, for moments of inertia (3,) [kg m^2] and a matrix of `mixing`."""
        momentum = self.omega * inertia
        torque = self.omega_dot * inertia + np.cross(self.omega, momentum)
        return np.column_stack([self.thrust, torque]) @ np.linalg.inv(mix).T


def flat(force: Floats, yaw: Floats) -> Flat:
    """Thrust, attitude and rates from the thrust vector and the yaw, each with two derivatives.

    The thrust vector is m (a + g) and the opposite of all other forces, such as drag.

    Parameters
    ----------
    force : (K, 3, 3): thrust vector [N] and its derivatives [N/s, N/s^2], in the second axis; not zero, nor horizontal
        along the heading's normal
    yaw : (K, 3): yaw [rad] and its derivatives
    """
    z, thrust = _unit_with_derivatives(force)
    psi, rate, second = yaw.T
    cos, sin, none = np.cos(psi), np.sin(psi), np.zeros(len(psi))
    heading = np.empty_like(force)
    heading[:, 0] = np.stack([cos, sin, none], axis=1)
    heading[:, 1] = np.stack([-sin * rate, cos * rate, none], axis=1)
    heading[:, 2] = np.stack(
        [-cos * rate**2 - sin * second, -sin * rate**2 + cos * second, none], axis=1
    )
    y, _ = _unit_with_derivatives(_cross_with_derivatives(z, heading))
    x = _cross_with_derivatives(y, z)

    def dot_b_rate_and_rate(a: Floats, b: Floats) -> tuple[Floats, Floats]:
        """a . b', and its derivative."""
        along = np.einsum("ki,ki->k", a[:, 0], b[:, 1])
        turn = np.einsum("ki,ki->k", a[:, 1], b[:, 1]) + np.einsum("ki,ki->k", a[:, 0], b[:, 2])
        return along, turn

    # R^T R' = [omega x], column by column
    parts = [dot_b_rate_and_rate(z, y), dot_b_rate_and_rate(x, z), dot_b_rate_and_rate(y, x)]
    omega, omega_dot = (np.stack(column, axis=1) for column in zip(*parts, strict=True))
    return Flat(thrust, np.stack([x[:, 0], y[:, 0], z[:, 0]], axis=2), omega, omega_dot)


def _unit_with_derivatives(v: Floats) -> tuple[Floats, Floats]:
    """Unit vectors of v (K, 3, 3), a vector and two derivatives, with theirs; and the length of v (K,)."""
    size = np.linalg.norm(v[:, 0], axis=1)
    u = np.empty_like(v)
    u[:, 0] = v[:, 0] / size[:, None]
    grows = np.einsum("ki,ki->k", u[:, 0], v[:, 1])
    u[:, 1] = (v[:, 1] - grows[:, None] * u[:, 0]) / size[:, None]
    turned = np.einsum("ki,ki->k", u[:, 1], u[:, 1])
    faster = np.einsum("ki,ki->k", u[:, 0], v[:, 2]) + size * turned
    u[:, 2] = (v[:, 2] - faster[:, None] * u[:, 0] - 2.0 * grows[:, None] * u[:, 1]) / size[:, None]
    return u, size


def _cross_with_derivatives(a: Floats, b: Floats) -> Floats:
    """Cross product of two vectors with two derivatives, (K, 3, 3) each."""
    x, y = (series.series_by_derivatives(v.swapaxes(0, 1)) for v in (a, b))
    return series.taylor_derivatives(series.product(x, y, np.cross)).swapaxes(0, 1)
