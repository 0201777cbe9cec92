"""The body layer: a formation is steered round obstacles as one body, before single vehicles give way.

The reference of the virtual body deviates from the planned one by a displacement x, a rotation Q about the body's
origin and a scale z of the slots: slot i is at r + x + z d_i, with d_i = Q (r_i - r). The second derivatives a, alpha,
z'' add a + alpha x (z d_i) + z'' d_i to its acceleration. They are those that bring the deviation back,

    a = -2 k x' - k^2 x, and so on, with both poles at -k,

changed by the least 1/2 sum m_i |da_i|^2 (Gauss's principle for the whole body) so that the barriers of all slots hold.
This is a problem of least distance; Lawson and Hanson (*Solving Least Squares Problems*, 1974, chapter 23) reduce it to
non-negative least squares, which an active-set method of finitely many steps solves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from rigidfleet.math import attitude as att
from rigidfleet.math import series
from rigidfleet.typing import Floats

#: Rates at which a deviation decays [1/s], and while a barrier is near: returning against it would use up the thrust.
DECAY, NEAR = 0.9, 0.5
#: Displacement [m], rotation [rad] and scale, and their derivatives, below which a deviation has ended.
_ENDED = 1e-3
#: Least and greatest scale, and rate at which these bounds are approached [1/s]. A formation that does not shrink keeps
#: the separation that is proved of its plan.
_LEAST, _GREATEST, _APPROACH = 1.0, 1.3, 2.0
#: Least moment of inertia, over the trace: bodies that are lines or points do not turn about themselves.
_THIN = 1e-9


@dataclass
class Detour:
    """What the reference of a body deviates from the planned one by, in world axes."""

    # Displacement, two derivatives [m, s].
    x: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    Q: Floats = field(default_factory=lambda: np.eye(3))  # rotation
    omega: Floats = field(default_factory=lambda: np.zeros((2, 3)))  # rates [rad/s], derivative
    scale: Floats = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))  # and two derivatives

    @property
    def is_zero(self) -> bool:
        """Whether there is none."""
        rest = self.scale - [1.0, 0.0, 0.0]
        return not (self.x.any() or self.omega.any() or rest.any() or self.rotation_vector.any())

    @property
    def rotation_vector(self) -> Floats:
        """Rotation vector (3,) [rad]."""
        return att.rotation_vector_from_dcm(self.Q.T)

    def decay_accelerations(self, k: float = DECAY) -> Floats:
        """Second derivatives (7,) of displacement, rotation and scale that bring the deviation back at a rate [1/s]."""
        return np.concatenate(
            [
                -2 * k * self.x[1] - k * k * self.x[0], -2 * k * self.omega[0] - k * k * self.rotation_vector,
                [-2 * k * self.scale[1] - k * k * (self.scale[0] - 1.0)],
            ]
        )  # fmt: skip

    def end_if_small_and_still(self, still: bool) -> None:
        """Take it as ended if it is small; ``still``: nothing else is asked of it."""
        rest = self.scale - [1.0, 0.0, 0.0]
        parts = self.x, self.omega, self.rotation_vector, rest
        if still and max(float(np.abs(part).max()) for part in parts) < _ENDED:
            self.x, self.Q, self.omega = np.zeros((3, 3)), np.eye(3), np.zeros((2, 3))
            self.scale = np.array([1.0, 0.0, 0.0])

    def state_after(self, dt: float, accelerations: Floats, ramp_time: float) -> Detour:
        """The deviation after dt [s], if its second derivatives go linearly to those asked for (7,) in a time [s]."""
        share = dt / ramp_time

        def derivatives_after_dt(x: Floats, end: Floats) -> Floats:
            value, rate, second = x
            bend = (end - second) * share
            place = value + dt * (rate + dt * (second / 2 + bend / 6))
            return np.array([place, rate + dt * (second + bend / 2), second + bend])

        # The rotation vector from Q, whose rates are those of the body as long as it is small
        spin = derivatives_after_dt(np.array([np.zeros(3), *self.omega]), accelerations[3:6])
        Q = att.dcm_from_rotation_vector(spin[0]).T @ self.Q
        x = derivatives_after_dt(self.x, accelerations[:3])
        scale = derivatives_after_dt(self.scale, accelerations[6])
        return Detour(x, Q, spin[1:], scale)

    def similarity_series(self) -> tuple[Floats, Floats, Floats]:
        """Taylor series of displacement (3, 3), rotation (3, 3, 3), body to world, and scale (3,)."""
        # In the axes of Q, in which the derivative of the rates is the same.
        own = self.omega @ self.Q
        Q = series.rotation_series_from_rates(self.Q, own)
        return series.series_by_derivatives(self.x), Q, series.series_by_derivatives(self.scale)


def least_norm_feasible(G: Floats, h: Floats) -> Floats | None:
    """The shortest y (n,) with G y >= h, for G (m, n), or None if there is none; Lawson and Hanson, algorithm LDP."""
    from scipy.optimize import nnls  # takes long to load

    E = np.vstack([G.T, h])
    f = np.zeros(len(E))
    f[-1] = 1.0
    u, _ = nnls(E, f)
    r = E @ u - f
    # The residual of a consistent problem is not zero, and its last entry is its square.
    if -r[-1] <= 1e-12:
        return None
    return -r[:-1] / r[-1]


def motion_and_growth_rows(normals: Floats, arms: Floats, scale: float) -> Floats:
    """Rows (R, 7) of n . a of points at arms (R, 3) from the body's origin, along unit normals (R, 3)."""
    along = (normals * arms).sum(axis=1, keepdims=True)
    return np.hstack([normals, np.cross(arms, normals), along / scale])


def nearest_accelerations(
    accelerations: Floats, rows: Floats, needed: Floats, masses: Floats, arms: Floats, scale: float
) -> Floats | None:
    """Second derivatives (7,) nearest to those asked for, with rows (R, 7) . them >= needed (R,); None if none exist.

    The distance is that of Gauss's principle, of masses (N,) at ``arms`` (N, 3) from the body's origin.
    """
    squares = (arms * arms).sum(axis=1)
    spread = np.eye(3) * squares[:, None, None] - arms[:, :, None] * arms[:, None]
    inertia = np.einsum("i,ijk->jk", masses, spread)
    radial = float(masses @ squares) / scale**2
    centre = masses @ arms
    # Of a body whose origin is not its centre of mass, displacement and rotation are coupled.
    H = np.zeros((7, 7))
    H[:3, :3] = masses.sum() * np.eye(3)
    H[3:6, 3:6] = inertia
    H[:3, 3:6] = np.cross(centre, np.eye(3))
    H[3:6, :3] = H[:3, 3:6].T
    H[:3, 6] = H[6, :3] = centre / scale
    H[6, 6] = radial
    H[3:, 3:] += (_THIN * max(np.trace(inertia), radial) + 1e-12) * np.eye(4)
    L = np.linalg.cholesky(H)
    G = np.linalg.solve(L, rows.T).T
    size = np.linalg.norm(G, axis=1)
    y = least_norm_feasible(G / size[:, None], (needed - rows @ accelerations) / size)
    return None if y is None else accelerations + np.linalg.solve(L.T, y)


def rows_bounding_scale(deviation: Detour) -> tuple[Floats, Floats]:
    """Rows (2, 7) and what they need (2,), so that the scale stays between its bounds."""
    value, rate, _ = deviation.scale
    rows, needed = np.zeros((2, 7)), np.zeros(2)
    for k, (sign, gap) in enumerate(((1.0, value - _LEAST), (-1.0, _GREATEST - value))):
        rows[k, 6] = sign
        needed[k] = -(_APPROACH**2) * gap - 2.0 * _APPROACH * sign * rate
    return rows, needed


def greatest_point_acceleration(change: Floats, arms: Floats, scale: float) -> float:
    """Greatest |a + alpha x arm + z'' arm / z| [m/s^2] of points at arms (N, 3), of changes (7,)."""
    a = change[:3] + np.cross(change[3:6], arms) + change[6] / scale * arms
    return math.sqrt(float((a * a).sum(axis=1).max()))
