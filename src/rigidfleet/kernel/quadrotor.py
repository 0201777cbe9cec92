"""Equations of motion of a quadrotor: a rigid body, four rotors with lag, and drag in moving air.

The model is that of RotorPy (Folk, Paulos and Kumar 2023, arXiv:2306.04485) with polynomial curves of thrust and
torque, linear drag, a quadratic lag of the motors and the rotors' angular momentum, as in crazyflow's
`first_principles`.
"""

import math

from rigidfleet.kernel.aerodynamics import ground_effect_factor
from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.disturbances import ground_damping_and_lift
from rigidfleet.kernel.fleet import thrust_of
from rigidfleet.kernel.rigid_body import attitude_matrix, quaternion_rate
from rigidfleet.kernel.vectors import as_lanes
from rigidfleet.solids.distance import top_of_solids_below

#: Rows of `SampledWork.y`.
_START, _TRIAL, _RATES, _END = 0, 1, 2, 6

rotor_curve = jit_inline(thrust_of)


@jit
def write_point_derivative(y, command, i, vehicles, air, push, dy):
    """Derivative dy (17,) of vehicle i, an ideal point with the force ``command`` [N], limited by its own rules."""
    m = vehicles.m[i]
    for q in range(3):
        force = command[q] + push[q] + vehicles.drag[i, q] * (air[q] - y[3 + q])
        dy[q], dy[3 + q] = y[3 + q], force / m
    dy[5] -= vehicles.g
    dy[6:] = 0.0


@jit
def write_quadrotor_derivative(y, command, i, vehicles, around, air, push, T, dy):
    """Derivative dy (17,) of the state y (17,) of vehicle i, see `fleet.STATES`.

    Parameters
    ----------
    command : (4,) commanded speeds of the rotors [rad/s], or force of a point [N]
    vehicles, around : `Quadrotors`, `Air`
    air : (3,) velocity of the air, world [m/s]
    push : (3,) further force, world [N]
    T : (3, 3) work; holds world -> body afterwards
    """
    m, inertia = vehicles.m[i], vehicles.inertia[i]
    damping, lift = 0.0, 0.0
    if vehicles.lost[i]:
        over = top_of_solids_below(y[0], y[1], y[2], around.roofs) + around.radius[i]
        damping, lift = ground_damping_and_lift(m, vehicles.g, max(around.floor[i], over), y[2])
    if vehicles.point[i]:
        write_point_derivative(y, command, i, vehicles, air, push, dy)
    else:
        attitude_matrix(y[6:10], T)
        quaternion_rate(y[6:10], y[10:13], dy[6:10])
        T00, T01, T02 = T[0, 0], T[0, 1], T[0, 2]
        T10, T11, T12 = T[1, 0], T[1, 1], T[1, 2]
        T20, T21, T22 = T[2, 0], T[2, 1], T[2, 2]
        P, Q, R = y[10], y[11], y[12]
        # Velocity through the air, body axes
        a0, a1, a2 = y[3] - air[0], y[4] - air[1], y[5] - air[2]
        b0 = T00 * a0 + T01 * a1 + T02 * a2
        b1 = T10 * a0 + T11 * a1 + T12 * a2
        b2 = T20 * a0 + T21 * a1 + T22 * a2
        speed = math.sqrt(b0 * b0 + b1 * b1 + b2 * b2)
        F0 = -(speed * vehicles.c[i, 0] + vehicles.drag[i, 0]) * b0
        F1 = -(speed * vehicles.c[i, 1] + vehicles.drag[i, 1]) * b1
        F2 = -(speed * vehicles.c[i, 2] + vehicles.drag[i, 2]) * b2
        M0 = M1 = M2 = momentum = turning = 0.0
        gain = 1.0
        if around.ground_effect:
            over = max(around.ground, top_of_solids_below(y[0], y[1], y[2], around.roofs))
            if over > -math.inf:
                gain = ground_effect_factor(y[2] - over, vehicles.radius[i], vehicles.span[i])
        k0 = gain * vehicles.thrust[i, 0]
        k1 = gain * vehicles.thrust[i, 1]
        k2 = gain * vehicles.thrust[i, 2]
        c0, c1, c2 = vehicles.torque[i, 0], vehicles.torque[i, 1], vehicles.torque[i, 2]
        k_d, k_z, k_h = vehicles.rotor_drag[i, 0], vehicles.rotor_drag[i, 1], vehicles.lift[i]
        for j in range(4):
            x0 = vehicles.rotors[i, j, 0]
            x1 = vehicles.rotors[i, j, 1]
            x2 = vehicles.rotors[i, j, 2]
            w, spin = y[13 + j], vehicles.spin[i, j]
            u0, u1, u2 = b0 + Q * x2 - R * x1, b1 + R * x0 - P * x2, b2 + P * x1 - Q * x0
            h0, h1 = -k_d * w * u0, -k_d * w * u1
            h2 = rotor_curve(w, k0, k1, k2) + k_h * (u0 * u0 + u1 * u1) - k_z * w * u2
            F0, F1, F2 = F0 + h0, F1 + h1, F2 + h2
            M0 += x1 * h2 - x2 * h1
            M1 += x2 * h0 - x0 * h2
            M2 += x0 * h1 - x1 * h0 + spin * rotor_curve(w, c0, c1, c2)
            error = command[j] - w
            up = error > 0.0
            linear = vehicles.motor[i, 0] if up else vehicles.motor[i, 2]
            quadratic = vehicles.motor[i, 1] if up else vehicles.motor[i, 3]
            rate = error * (linear + quadratic * (command[j] + w))
            dy[13 + j] = rate
            momentum, turning = momentum + spin * w, turning + spin * rate
        # A rotor turns against its torque on the body
        h = vehicles.rotor_inertia[i]
        I0, I1, I2 = inertia[0], inertia[1], inertia[2]
        dy[10] = (M0 + Q * h * momentum - (I2 - I1) * Q * R) / I0
        dy[11] = (M1 - P * h * momentum - (I0 - I2) * P * R) / I1
        dy[12] = (M2 + h * turning - (I1 - I0) * P * Q) / I2
        dy[0], dy[1], dy[2] = y[3], y[4], y[5]
        dy[3] = (T00 * F0 + T10 * F1 + T20 * F2 + push[0]) / m
        dy[4] = (T01 * F0 + T11 * F1 + T21 * F2 + push[1]) / m
        dy[5] = (T02 * F0 + T12 * F1 + T22 * F2 + push[2]) / m - vehicles.g
    if damping > 0.0:
        for q in range(3):
            dy[3 + q] -= damping / m * y[3 + q]
            dy[10 + q] -= damping / m * y[10 + q]
        dy[5] += lift / m


@jit
def runge_kutta(h, commands, vehicles, around, push, work):
    """Advance all vehicles by h [s] from row 0 of ``work.y`` to row 6, the classical method of fourth order.

    A row holds the states of all vehicles, one after the other. ``work.air`` holds the air at the start, the middle and
    the end. The quaternion is normalised after the step. Row 2 then holds the derivative at the start. Each stage takes
    all vehicles, so that rows are added eight numbers at a time.
    """
    y, rows = work.y, as_lanes(work.y)
    for q in range(rows.shape[1]):
        rows[_TRIAL, q] = rows[_END, q] = rows[_START, q]
    for stage in range(4):
        trial, rate = y[_TRIAL], y[_RATES + stage]
        for i in range(vehicles.m.shape[0]):
            first, air = 17 * i, work.air[(stage + 1) // 2, i]
            write_quadrotor_derivative(
                trial[first : first + 17], commands[i], i, vehicles, around, air, push[i], work.T,
                rate[first : first + 17],
            )  # fmt: skip
        weight = h / 6.0 if stage in (0, 3) else h / 3.0
        reach = h if stage == 2 else 0.5 * h
        for q in range(rows.shape[1]):
            change = rows[_RATES + stage, q]
            rows[_END, q] += weight * change
            rows[_TRIAL, q] = rows[_START, q] + reach * change
    for i in range(vehicles.m.shape[0]):
        normalise_quaternion(y[_END, 17 * i + 6 : 17 * i + 10])


@jit
def normalise_quaternion(q):
    """Scale a quaternion (4,) to unit length."""
    scale = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for k in range(4):
        q[k] *= scale
