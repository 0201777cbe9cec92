"""Exact derivatives of the references that the kernel flies, up to snap, and the yaw of each vehicle.

The kernel evaluates position, velocity and acceleration of each slot on its way. What needs jerk and snap, or many
times at once (vehicles with attitude, limits of a plan, records), takes them from here. Everything is a product of
polynomials and rotations, whose Taylor series are exact (`rigidfleet.math.series`). The functions hold while slots are
tracked (control "tracking"); otherwise there is no slot reference.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial import Polynomial

from rigidfleet.kernel.problem import Motion, Reference, septic_polynomial
from rigidfleet.math import series
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.mission.schema import VehicleYaw
from rigidfleet.typing import Floats, Ints

#: Number of coefficients of a series: position, velocity, acceleration, jerk, snap.
ORDERS = 5
#: Coefficients (8,) of the blend s(x), ascending.
_BLEND = septic_polynomial(Polynomial([0.0, 1.0])).coef
#: Speed from which yaw "along" follows the way, and length over which it turns into the way (`yaw_derivatives`).
SLOW, _TRAIL = 0.5, 1.0
#: Share of the turn towards one side, by which a vehicle that starts backwards turns round.
_SIDE = 0.5
#: Rotation vector that is taken as zero [rad]: at ten metres it moves a slot by no more than positions are rounded.
_NO_TURN = 1e-14
#: Step in which yaw "along" is integrated [s]: exact to 1e-9 rad at accelerations of some m/s^2.
_STEP = 0.01


def slot_derivatives(
    reference: Reference, motion: Motion, time: Floats, orders: int = ORDERS
) -> Floats:
    """Position, velocity, acceleration, jerk and snap (K, 5, N, 3) [m, m/s, ...] of each slot, world axes.

    r_i = r_cm + T1^T Exp(phi) p_i, with slots p_i = Exp(s turn) (p0_i + s dp_i) or on their ways, as in the kernel's
    `desired_agents` and `blend_slots`; at times (K,) [s] of a phase's problem with control "tracking". At a knot,
    the piece after it counts. With fewer ``orders``, the last ones are left out.
    """
    derivatives = series.taylor_derivatives(
        slot_taylor(reference, body_taylor(motion, time, orders), time)
    )
    return derivatives.transpose(3, 0, 2, 1)


def reference_of_agents(reference: Reference, who: Ints) -> Reference:
    """The reference of some agents' slots."""
    ways = reference.ways[:, who] if len(reference.knots) else reference.ways
    return reference._replace(p0=reference.p0[who], dp=reference.dp[who], ways=ways)


def slots_by_own_clocks(reference: Reference, motion: Motion, time: Floats, tau: Floats) -> Floats:
    """Position, velocity, acceleration and jerk (K, 4, N, 3) of slots, each by the clock of its vehicle.

    At times (K,) [s], clocks differ by ``tau[..., 0]`` (K, N) [s], have the rates ``tau[..., 1]``, and these the rates
    ``tau[..., 2]`` [1/s]. Before the first knot, slots move as they do there.
    """
    out = np.empty((len(time), 4, tau.shape[1], 3))
    for i in range(tau.shape[1]):
        alone = reference_of_agents(reference, np.array([i]))
        own, (s, slope) = time + tau[:, i, 0], tau[:, i, 1:3].T[..., None]
        inside = np.maximum(own, motion.knots[0])
        r, v, a, j = slot_derivatives(alone, motion, inside, 4)[:, :, 0].swapaxes(0, 1)
        early = own < inside
        a[early] = j[early] = 0.0
        out[:, 0, i], out[:, 1, i] = r + (own - inside)[:, None] * v, s * v
        out[:, 2, i], out[:, 3, i] = s * s * a + slope * v, s**3 * j + 3.0 * s * slope * a
    return out


def slot_taylor(reference: Reference, body: tuple[Floats, Floats], time: Floats) -> Floats:
    """Taylor series (5, 3, N, K) of each slot, from the `body_taylor` at times (K,) [s]; see `slot_derivatives`."""
    cm, axes = body
    if len(reference.knots):
        ways = slot_way_taylor(reference, time)[: len(cm)]
        slots = series.product(ways, axes.swapaxes(1, 2), _matrix_product).swapaxes(1, 2)
        return slots + cm[:, :, None]
    s = blend_taylor(time, reference.t0, reference.T_b)[: len(cm)]
    if reference.turn.any():
        turned = series.rotation_series(s[..., None] * reference.turn).transpose(0, 2, 3, 1)
        axes = series.product(axes, turned, _matrix_product)
    slots = reference.p0 @ axes
    if reference.dp.any():
        slots = slots + reference.dp @ series.product(s[:, None, None], axes)
    return slots + cm[:, :, None]


def slot_way_taylor(reference: Reference, time: Floats) -> Floats:
    """Taylor series (5, N, 3, K) of slots on their ways, body axes, at times (K,) [s]; at rest before and after."""
    ways = Piecewise(reference.knots, reference.ways)
    inside = np.clip(time, ways.time[0], ways.time[-1])
    values = ways.taylor_coefficients(inside, ORDERS).transpose(0, 2, 3, 1)
    values[1:, ..., inside != time] = 0.0
    return values


def _matrix_product(a: Floats, b: Floats) -> Floats:
    """Products (..., N, 3, K) of matrices (..., N, 3, K) and (..., 3, 3, K)."""
    return (a[..., :, :, None, :] * b[..., None, :, :, :]).sum(axis=-3)


def body_taylor(motion: Motion, time: Floats, orders: int = ORDERS) -> tuple[Floats, Floats]:
    """Taylor series (5, 3, K) [m] of the CM and (5, 3, 3, K) of the attitude, body to world, at times (K,) [s].

    Of a body that does not turn, the attitude has one time instead of K, and so nothing is multiplied K times. Fewer
    ``orders`` have the same numbers. After the last knot, the CM and the rotation vector continue at the rates they
    have there. Times are the last axis, also in memory, here and in `slot_taylor`: arithmetic on long rows is fast.
    """
    way = Piecewise(motion.knots, motion.coefficients)
    inside = np.minimum(time, way.time[-1])
    x = np.ascontiguousarray(way.taylor_coefficients(inside, ORDERS).swapaxes(1, 2))
    beyond = time > inside
    x[0][:, beyond] += (time - inside)[beyond] * x[1][:, beyond]
    x[2:, :, beyond] = 0.0
    cm, phi = x[:orders, :3], x[:, 3:]
    if np.abs(phi).max(initial=0.0) <= _NO_TURN:  # most ways do not turn, but for rounding
        axes = np.zeros((orders, 3, 3, 1))
        axes[0] = motion.T1.T[..., None]
        return cm, axes
    turned = series.rotation_series(phi.swapaxes(1, 2), orders).transpose(0, 2, 3, 1)
    return cm, (motion.T1.T @ turned.reshape(orders, 3, -1)).reshape(turned.shape)


def blend_taylor(time: Floats, t0: float, T_b: float) -> Floats:
    """Taylor series (5, K) at times (K,) [s] of the blend s from 0 to 1 over [t0, t0 + T_b]; T_b = 0 is a step."""
    since = time - t0
    s = np.zeros((ORDERS, len(time)))
    s[0] = since >= T_b
    under_way = (since > 0.0) & (since < T_b)
    if under_way.any():
        x = since[under_way] / T_b
        powers = np.broadcast_to(_BLEND, (len(x), len(_BLEND)))
        scale = T_b ** -np.arange(ORDERS, dtype=float)
        s[:, under_way] = series.polynomial_series(powers, x, ORDERS) * scale[:, None]
    return s


def yaw_derivatives(
    reference: Reference, motion: Motion, time: Floats, yaw: VehicleYaw, start: Floats | None = None
) -> Floats:
    """Yaw [rad], its rate [rad/s] and acceleration [rad/s^2] (K, 3, N) of each vehicle at increasing times (K,) [s].

    "formation": the yaw of the level attitude nearest to the body's (swing and twist). It equals the 3-2-1 Euler angle
    unless the body both rolls and pitches, and is undefined only upside down. "towards": the direction to a point,
    undefined straight above it. "along": the heading h follows the horizontal velocity v of the slot by

        yaw' = (v x a) / (|v|^2 + SLOW^2) + (h x v + _SIDE (|v| - h . v)) / _TRAIL.

    The first term is the rate at which the way turns. The second one turns the vehicle into its way, as the trail of a
    castor does; its last part decides to which side a vehicle turns that starts backwards. All terms are smooth, and
    vanish with the speed, so that a slow vehicle keeps its heading.

    Parameters
    ----------
    start : yaw (N,) [rad] at ``time[0]`` for "along"; by default the direction of the velocity there, or that of the
        body if a vehicle is at rest
    """
    body = body_taylor(motion, time)
    slots = slot_taylor(reference, body, time)
    if yaw.kind == "along":
        return yaw_along(reference, motion, time, slots, start)[0].transpose(2, 0, 1)
    return yaw_derivatives_but_along(body, slots, yaw).transpose(2, 0, 1)


def yaw_derivatives_but_along(
    body: tuple[Floats, Floats], slots: Floats, yaw: VehicleYaw
) -> Floats:
    """Yaw with two derivatives (3, N, K) of every kind but "along", see `yaw_derivatives`.

    From the `body_taylor` and the `slot_taylor` at the same times.
    """
    n, times = slots.shape[2:]
    angles = np.zeros((3, n, times))
    if yaw.kind == "fixed":
        angles[0] = math.radians(yaw.yaw_deg)
        return angles
    if yaw.kind == "formation":
        M = body[1][:3]
        turned = series.angle_series(M[:, 1, 0] - M[:, 0, 1], M[:, 0, 0] + M[:, 1, 1])[:, None]
    else:
        away = -slots[:3, :2]
        away[0] += np.array(yaw.point)[:2, None, None]
        turned = series.angle_series(away[:, 1], away[:, 0])
    turned[0] = np.unwrap(turned[0])
    angles[:] = series.taylor_derivatives(turned)
    return angles


def yaw_along(
    reference: Reference, motion: Motion, time: Floats, slots: Floats, start: Floats | None
) -> tuple[Floats, tuple[float, Floats]]:
    """Yaw with two derivatives (3, N, K) of kind "along", see `yaw_derivatives`.

    By the Runge-Kutta method of fourth order on a grid from ``time[0]``; rates at ``time`` are exact. Beside it, a time
    of the grid shortly before the end and the yaw (N,) there, to continue on the same grid.
    """
    end = time[-1] if time[-1] > time[0] else time[0] + _STEP  # of a single time
    ends = np.unique(np.append(np.arange(time[0], end, _STEP), end))
    grid_time = np.concatenate([ends, 0.5 * (ends[:-1] + ends[1:])])
    body = body_taylor(motion, grid_time)
    on_grid = slot_taylor(reference, body, grid_time)
    if start is None:
        v = on_grid[1, :2, :, 0]
        from_body = yaw_derivatives_but_along(body, on_grid, VehicleYaw())[0, :, 0]
        start = np.where(np.hypot(*v) > SLOW, np.arctan2(v[1], v[0]), from_body)
    terms = np.ascontiguousarray(_yaw_ode_terms(on_grid)[0].transpose(2, 0, 1))  # (times, 3, N)
    between = terms[len(ends) :]
    grid = np.empty((len(ends), len(start)))
    grid[0] = start
    for k, h in enumerate(np.diff(ends)):
        y, middle = grid[k], between[k]
        k1 = _yaw_rate(y, terms[k])
        k2 = _yaw_rate(y + 0.5 * h * k1, middle)
        k3 = _yaw_rate(y + 0.5 * h * k2, middle)
        k4 = _yaw_rate(y + h * k3, terms[k + 1])
        grid[k + 1] = y + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    angles = grid
    if not np.array_equal(time, ends):
        rates = _yaw_rate(grid, terms[: len(ends)].swapaxes(0, 1))
        angles = Piecewise.hermite(ends, np.stack([grid, rates])).at(time)
    known = max(len(ends) - 3, 0)
    angles = angles.T
    now, (A_dot, B_dot, C_dot) = _yaw_ode_terms(slots)
    cos, sin = np.cos(angles), np.sin(angles)
    first = _yaw_rate(angles, now)
    second = A_dot + B_dot * cos + C_dot * sin + first * (now[2] * cos - now[1] * sin)
    return np.stack([angles, first, second]), (float(ends[known]), grid[known])


def _yaw_ode_terms(taylor: Floats) -> tuple[Floats, Floats]:
    """Terms A, B, C (3, N, K) of yaw' = A + B cos yaw + C sin yaw of kind "along", and their rates, from `slot_taylor`.

    |v| - h . v becomes (|v|^2 - |v| h . v) / sqrt(|v|^2 + SLOW^2), which is smooth at rest.
    """
    v, a, j = series.taylor_derivatives(taylor[:4, :2])[1:]
    vv, va = (v * v).sum(axis=0), (v * a).sum(axis=0)
    size, speed = vv + SLOW**2, np.sqrt(vv)
    root = np.sqrt(size)
    speed_dot, root_dot = va / np.where(speed > 0.0, speed, 1.0), va / root
    turned = (v[0] * a[1] - v[1] * a[0]) / size
    turned_dot = (v[0] * j[1] - v[1] * j[0] - 2.0 * va * turned) / size
    astern, back = _SIDE / _TRAIL * vv / root, _SIDE / _TRAIL * speed / root
    astern_dot = (_SIDE / _TRAIL * 2.0 * va - astern * root_dot) / root
    back_dot = (_SIDE / _TRAIL * speed_dot - back * root_dot) / root
    terms = turned + astern, v[1] / _TRAIL - back * v[0], -v[0] / _TRAIL - back * v[1]
    rates = (
        turned_dot + astern_dot,
        a[1] / _TRAIL - back_dot * v[0] - back * a[0],
        -a[0] / _TRAIL - back_dot * v[1] - back * a[1],
    )
    return np.stack(terms), np.stack(rates)


def _yaw_rate(yaw: Floats, terms: Floats) -> Floats:
    """Rate of yaw "along" [rad/s] at yaws (...) from the `_yaw_ode_terms` terms (3, ...)."""
    return terms[0] + terms[1] * np.cos(yaw) + terms[2] * np.sin(yaw)
