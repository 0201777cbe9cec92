"""Exact derivatives of the references that the kernel flies, up to snap, and the yaw of each vehicle.

The kernel evaluates position, velocity and acceleration of each slot on its way. What needs jerk and snap, or many
times at once (vehicles with attitude, limits of a plan, records), takes them from here. Everything is a product of
polynomials and rotations, whose Taylor series are exact (`rigidfleet.math.series`). The functions hold while slots are
tracked (control "tracking"); otherwise there is no slot reference.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from rigidfleet.kernel.problem import Motion, Reference, septic_polynomial
from rigidfleet.math import series
from rigidfleet.typing import Floats

#: Number of coefficients of a series: position, velocity, acceleration, jerk, snap.
ORDERS = 5
#: Coefficients (8,) of the blend s(x), ascending.
_BLEND = septic_polynomial(Polynomial([0.0, 1.0])).coef
#: Speed from which yaw "along" follows the way, and length over which it turns into the way (`yaw_derivatives`).
SLOW, TRAIL = 0.5, 1.0
#: Share of the turn towards one side, by which a vehicle that starts backwards turns round.
_SIDE = 0.5
#: Step in which yaw "along" is integrated [s]: exact to 1e-9 rad at accelerations of some m/s^2.
_STEP = 0.01


class Yaw(NamedTuple):
    """How vehicles turn about the vertical. Angle [rad] of "fixed", point (3,) [m] of "towards"."""

    kind: Literal["formation", "fixed", "along", "towards"] = "formation"
    angle: float = 0.0
    point: tuple[float, ...] = (0.0, 0.0, 0.0)


def slot_derivatives(
    reference: Reference, motion: Motion, time: Floats, orders: int = ORDERS
) -> Floats:
    """Position, velocity, acceleration, jerk and snap (K, 5, N, 3) [m, m/s, ...] of each slot, world axes.

    r_i = r_cm + T1^T Exp(phi) Exp(s turn) (p0_i + s dp_i), as in the kernel's `desired_agents` and `blend_slots`; at
    times (K,) [s] of a phase's problem with control "tracking". At a knot, the piece after it counts. With fewer
    ``orders``, the last ones are left out.
    """
    cm, axes = (x[:orders] for x in body_series(motion, time))
    s = blend_series(time, reference.t0, reference.T_b)[:orders]
    if reference.turn.any():
        axes = series.product(axes, series.rotation(s[..., None] * reference.turn), np.matmul)
    moved = series.product(s[..., None, None], axes)
    found = np.einsum("mkab,nb->kmna", axes, reference.p0)
    if reference.dp.any():
        found += np.einsum("mkab,nb->kmna", moved, reference.dp)
    found += cm.transpose(1, 0, 2)[:, :, None]
    return series.derivatives(found.swapaxes(0, 1)).swapaxes(0, 1)


def body_series(motion: Motion, time: Floats) -> tuple[Floats, Floats]:
    """Taylor series (5, K, 3) [m] of the CM and (5, K, 3, 3) of the attitude, body to world, at times (K,) [s].

    After the last knot, the CM and the rotation vector continue at the rates they have there.
    """
    knots = motion.knots
    inside = np.minimum(time, knots[-1])
    low = np.clip(np.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
    x = series.of_polynomials(motion.coefficients[low], inside - knots[low], ORDERS)
    beyond = time > knots[-1]
    x[0, beyond] += (time - inside)[beyond, None] * x[1, beyond]
    x[2:, beyond] = 0.0
    cm, phi = x[..., :3], x[..., 3:]
    if not phi.any():  # most ways do not turn
        axes = np.zeros((ORDERS, len(time), 3, 3))
        axes[0] = motion.T1.T
        return cm, axes
    return cm, motion.T1.T @ series.rotation(phi)


def blend_series(time: Floats, t0: float, T_b: float) -> Floats:
    """Taylor series (5, K) at times (K,) [s] of the blend s from 0 to 1 over [t0, t0 + T_b]; T_b = 0 is a step."""
    since = time - t0
    s = np.zeros((ORDERS, len(time)))
    s[0] = since >= T_b
    under_way = (since > 0.0) & (since < T_b)
    if under_way.any():
        x = since[under_way] / T_b
        powers = np.broadcast_to(_BLEND, (len(x), len(_BLEND)))
        scale = T_b ** -np.arange(ORDERS, dtype=float)
        s[:, under_way] = series.of_polynomials(powers, x, ORDERS) * scale[:, None]
    return s


def yaw_derivatives(
    reference: Reference, motion: Motion, time: Floats, yaw: Yaw, start: Floats | None = None
) -> Floats:
    """Yaw [rad], its rate [rad/s] and acceleration [rad/s^2] (K, 3, N) of each vehicle at increasing times (K,) [s].

    "formation": the yaw of the level attitude nearest to the body's (swing and twist). It equals the 3-2-1 Euler angle
    unless the body both rolls and pitches, and is undefined only upside down. "towards": the direction to a point,
    undefined straight above it. "along": the heading h follows the horizontal velocity v of the slot by

        yaw' = (v x a) / (|v|^2 + SLOW^2) + (h x v + _SIDE (|v| - h . v)) / TRAIL.

    The first term is the rate at which the way turns. The second one turns the vehicle into its way, as the trail of a
    castor does; its last part decides to which side a vehicle turns that starts backwards. All terms are smooth, and
    vanish with the speed, so that a slow vehicle keeps its heading.

    Parameters
    ----------
    start : yaw (N,) [rad] at ``time[0]`` for "along"; by default the direction of the velocity there, or that of the
        body if a vehicle is at rest
    """
    n, times = len(reference.p0), len(time)
    if yaw.kind == "fixed":
        found = np.zeros((times, 3, n))
        found[:, 0] = yaw.angle
        return found
    if yaw.kind == "formation":
        M = body_series(motion, time)[1][:3]
        found = series.derivatives(
            series.angle(M[..., 1, 0] - M[..., 0, 1], M[..., 0, 0] + M[..., 1, 1])
        )
        found[0] = np.unwrap(found[0])
        return np.repeat(found.T[..., None], n, axis=2)
    if yaw.kind == "towards":
        r = slot_derivatives(reference, motion, time, 3).swapaxes(0, 1)
        away = -series.from_derivatives(r)
        away[0] += np.array(yaw.point)
        found = series.derivatives(series.angle(away[..., 1], away[..., 0]))
        found[0] = np.unwrap(found[0], axis=0)
        return found.swapaxes(0, 1)
    return _along(reference, motion, time, start)


def _along(reference: Reference, motion: Motion, time: Floats, start: Floats | None) -> Floats:
    """As `yaw_derivatives` for "along": Runge-Kutta of fourth order on a fixed grid, exact rates at ``time``."""
    ends = np.append(np.arange(time[0], time[-1], _STEP), time[-1])
    middles = 0.5 * (ends[:-1] + ends[1:])
    at_ends, between = (
        slot_derivatives(reference, motion, t, 4)[:, 1:, :, :2] for t in (ends, middles)
    )
    if start is None:
        body = yaw_derivatives(reference, motion, ends[:1], Yaw())[0, 0]
        v = at_ends[0, 0]
        start = np.where(np.hypot(*v.T) > SLOW, np.arctan2(v[:, 1], v[:, 0]), body)
    grid = np.empty((len(ends), len(start)))
    grid[0] = start
    for k, h in enumerate(np.diff(ends)):
        y, middle = grid[k], between[k]
        k1 = _turning(y, at_ends[k])[0]
        k2 = _turning(y + 0.5 * h * k1, middle)[0]
        k3 = _turning(y + 0.5 * h * k2, middle)[0]
        k4 = _turning(y + h * k3, at_ends[k + 1])[0]
        grid[k + 1] = y + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    if len(time) == len(ends) and np.array_equal(time, ends):
        angles = grid
    else:
        rates = np.stack([_turning(y, x)[0] for y, x in zip(grid, at_ends, strict=True)])
        angles = _hermite(ends, grid, rates, time)
    motions = slot_derivatives(reference, motion, time, 4)[:, 1:, :, :2]
    first, second = _turning(angles, motions.swapaxes(0, 1))
    return np.stack([angles, first, second], axis=1)


def _turning(yaw: Floats, x: Floats) -> tuple[Floats, Floats]:
    """Rate and acceleration of yaw "along" at yaws (..., N), from velocity, acceleration and jerk (3, ..., N, 2)."""
    v, a, j = x
    cos, sin = np.cos(yaw), np.sin(yaw)

    def cross(p: Floats, q: Floats) -> Floats:
        return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]

    vv, va = (v * v).sum(axis=-1), (v * a).sum(axis=-1)
    size, turned, speed = vv + SLOW**2, cross(v, a), np.sqrt(vv)
    root = np.sqrt(size)
    ahead, beside = v[..., 0] * cos + v[..., 1] * sin, v[..., 1] * cos - v[..., 0] * sin
    astern = (vv - speed * ahead) / root  # |v| - h . v, but smooth at rest
    first = turned / size + (beside + _SIDE * astern) / TRAIL
    ahead_dot = a[..., 0] * cos + a[..., 1] * sin + first * beside
    beside_dot = a[..., 1] * cos - a[..., 0] * sin - first * ahead
    speed_dot = va / np.where(speed > 0.0, speed, 1.0)
    astern_dot = (2.0 * va - speed_dot * ahead - speed * ahead_dot - astern * va / root) / root
    second = (cross(v, j) - 2.0 * va * turned / size) / size
    second += (beside_dot + _SIDE * astern_dot) / TRAIL
    return first, second


def _hermite(knots: Floats, y: Floats, rates: Floats, time: Floats) -> Floats:
    """Cubics through values and rates (n, N) at knots (n,), at times (K,) between them."""
    k = np.clip(np.searchsorted(knots, time, side="right") - 1, 0, len(knots) - 2)
    h = np.diff(knots)[k][:, None]
    s = (time - knots[k])[:, None] / np.where(h > 0.0, h, 1.0)
    rise = y[k + 1] - y[k]
    v0, v1 = h * rates[k], h * rates[k + 1]
    return y[k] + s * (v0 + s * (3.0 * rise - 2.0 * v0 - v1 + s * (v0 + v1 - 2.0 * rise)))
