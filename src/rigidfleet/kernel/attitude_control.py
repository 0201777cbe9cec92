"""From a desired force to rotor speeds: tilt limit, desired attitude, attitude control, allocation to the rotors.

The attitude law is that of Lee, Leok and McClamroch (2010); the feedforward follows from differential flatness, as in
Mellinger and Kumar (2011), without drag. A desired attitude is an array (5, 3): T (3, 3), world -> body, whose rows are
the body axes b1, b2, b3; the rates omega [rad/s] and accelerations [rad/s^2] in these axes.
"""

import math

from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.fleet import ATTITUDE, ROTOR_SPEEDS, speed_of
from rigidfleet.kernel.linalg import copy_vector
from rigidfleet.kernel.rigid_body import attitude_matrix

# Least vertical part of a force whose tilt is limited, as a share of the weight: a force downwards has no tilt to keep.
_LEAST_LIFT = 0.05

rotor_speed = jit_inline(speed_of)


@jit
def limit_tilt_in_place(F, tilt, weight):
    """Limit the tilt of a desired force F (3,) [N] to ``tilt`` [rad]; none from pi/2 on. Returns whether F changed.

    The vertical part is kept, but is at least a twentieth of the ``weight`` [N]; the horizontal one is shortened.
    """
    if tilt >= 0.5 * math.pi:
        return False
    up = max(F[2], _LEAST_LIFT * weight)
    aside = math.sqrt(F[0] * F[0] + F[1] * F[1])
    share = min(1.0, up * math.tan(tilt) / max(aside, 1e-300))
    limited = share < 1.0 or up > F[2]
    F[0], F[1], F[2] = share * F[0], share * F[1], up
    return limited


@jit
def write_flat_attitude(F, F_dot, F_ddot, yaw, out):
    """Attitude, rates and accelerations (5, 3) with the thrust axis along F (3,) and a heading.

    Parameters
    ----------
    F, F_dot, F_ddot : (3,) desired force and its derivatives [N, N/s, N/s^2]
    yaw : (3,) heading [rad], its rate and acceleration: b2 is normal to (cos yaw, sin yaw, 0)

    With n = |F|: b3 = F/n, db3 = (dF - (b3 . dF) b3)/n; omega and its derivative follow from db3 = omega x b3, from
    d2b3 = alpha x b3 + omega x (omega x b3), and about b3 from two derivatives of b2 . (cos yaw, sin yaw, 0) = 0.
    """
    b1, b2, b3, omega, alpha = out[0], out[1], out[2], out[3], out[4]
    n = max(math.sqrt(F[0] * F[0] + F[1] * F[1] + F[2] * F[2]), 1e-12)
    cos, sin = math.cos(yaw[0]), math.sin(yaw[0])
    z0, z1, z2 = F[0] / n, F[1] / n, F[2] / n
    y0, y1, y2 = -z2 * sin, z2 * cos, z0 * sin - z1 * cos  # b3 x (cos, sin, 0)
    scale = 1.0 / max(math.sqrt(y0 * y0 + y1 * y1 + y2 * y2), 1e-9)
    y0, y1, y2 = y0 * scale, y1 * scale, y2 * scale
    x0, x1, x2 = y1 * z2 - y2 * z1, y2 * z0 - y0 * z2, y0 * z1 - y1 * z0
    b1[0], b1[1], b1[2] = x0, x1, x2
    b2[0], b2[1], b2[2] = y0, y1, y2
    b3[0], b3[1], b3[2] = z0, z1, z2
    stretch = z0 * F_dot[0] + z1 * F_dot[1] + z2 * F_dot[2]
    P = -(y0 * F_dot[0] + y1 * F_dot[1] + y2 * F_dot[2]) / n
    Q = (x0 * F_dot[0] + x1 * F_dot[1] + x2 * F_dot[2]) / n
    # Products with the heading c1 = (cos, sin, 0) and with c2 = (-sin, cos, 0); b2 . c1 = 0
    x_c1, z_c1 = x0 * cos + x1 * sin, z0 * cos + z1 * sin
    x_c2, y_c2, z_c2 = x1 * cos - x0 * sin, y1 * cos - y0 * sin, z1 * cos - z0 * sin
    R = (P * z_c1 + yaw[1] * y_c2) / x_c1
    omega[0], omega[1], omega[2] = P, Q, R
    along1 = (x0 * F_ddot[0] + x1 * F_ddot[1] + x2 * F_ddot[2] - 2.0 * stretch * Q) / n
    along2 = (y0 * F_ddot[0] + y1 * F_ddot[1] + y2 * F_ddot[2] + 2.0 * stretch * P) / n
    alpha[0] = -along2 + Q * R
    alpha[1] = along1 - P * R
    x_c1_dot = -Q * z_c1 + yaw[1] * x_c2
    y_c2_dot = P * z_c2 - R * x_c2
    z_c1_dot = Q * x_c1 + yaw[1] * z_c2
    alpha[2] = (
        alpha[0] * z_c1 + P * z_c1_dot + yaw[2] * y_c2 + yaw[1] * y_c2_dot - R * x_c1_dot
    ) / x_c1


@jit
def write_attitude_torque(T, omega, desired, inertia, k_R, k_omega, tau):
    """Torque tau (3,) [N m] that leads the attitude T (3, 3) with rates omega (3,) to a desired one (5, 3).

    With E = T_d T^T, from body to desired body axes, the errors are e_R = (E - E^T)^v / 2 and
    e_omega = omega - E^T omega_d, and (Lee et al. 2010; gains per unit inertia)

        tau = I (-k_R e_R - k_omega e_omega - omega x E^T omega_d + E^T domega_d) + omega x I omega.
    """
    d = desired
    E00 = d[0, 0] * T[0, 0] + d[0, 1] * T[0, 1] + d[0, 2] * T[0, 2]
    E01 = d[0, 0] * T[1, 0] + d[0, 1] * T[1, 1] + d[0, 2] * T[1, 2]
    E02 = d[0, 0] * T[2, 0] + d[0, 1] * T[2, 1] + d[0, 2] * T[2, 2]
    E10 = d[1, 0] * T[0, 0] + d[1, 1] * T[0, 1] + d[1, 2] * T[0, 2]
    E11 = d[1, 0] * T[1, 0] + d[1, 1] * T[1, 1] + d[1, 2] * T[1, 2]
    E12 = d[1, 0] * T[2, 0] + d[1, 1] * T[2, 1] + d[1, 2] * T[2, 2]
    E20 = d[2, 0] * T[0, 0] + d[2, 1] * T[0, 1] + d[2, 2] * T[0, 2]
    E21 = d[2, 0] * T[1, 0] + d[2, 1] * T[1, 1] + d[2, 2] * T[1, 2]
    E22 = d[2, 0] * T[2, 0] + d[2, 1] * T[2, 1] + d[2, 2] * T[2, 2]
    P, Q, R = omega[0], omega[1], omega[2]
    w0 = E00 * d[3, 0] + E10 * d[3, 1] + E20 * d[3, 2]
    w1 = E01 * d[3, 0] + E11 * d[3, 1] + E21 * d[3, 2]
    w2 = E02 * d[3, 0] + E12 * d[3, 1] + E22 * d[3, 2]
    a0 = E00 * d[4, 0] + E10 * d[4, 1] + E20 * d[4, 2] - (Q * w2 - R * w1)
    a1 = E01 * d[4, 0] + E11 * d[4, 1] + E21 * d[4, 2] - (R * w0 - P * w2)
    a2 = E02 * d[4, 0] + E12 * d[4, 1] + E22 * d[4, 2] - (P * w1 - Q * w0)
    I0, I1, I2 = inertia[0], inertia[1], inertia[2]
    tau[0] = I0 * (a0 - 0.5 * k_R[0] * (E21 - E12) - k_omega[0] * (P - w0)) + (I2 - I1) * Q * R
    tau[1] = I1 * (a1 - 0.5 * k_R[1] * (E02 - E20) - k_omega[1] * (Q - w1)) + (I0 - I2) * P * R
    tau[2] = I2 * (a2 - 0.5 * k_R[2] * (E10 - E01) - k_omega[2] * (R - w2)) + (I1 - I0) * P * Q


@jit
def allocate_rotors(thrust, tau, B, least, most, f):
    """Forces f (4,) [N] of the rotors for a thrust [N] and torque (3,) [N m], by the inverse mixing matrix B (4, 4).

    If a force leaves [least, most], what cannot be delivered is given up in this order: yaw torque first, then thrust,
    then roll and pitch torque, which are scaled together. Returns whether that happened.
    """
    saturated = False
    for i in range(4):
        f[i] = B[i, 0] * thrust + B[i, 1] * tau[0] + B[i, 2] * tau[1] + B[i, 3] * tau[2]
        if not least <= f[i] <= most:
            saturated = True
    if not saturated:
        return False
    # Roll and pitch: the greatest share for which any thrust keeps all rotors within their limits
    share = 1.0
    for i in range(4):
        low = B[i, 1] * tau[0] + B[i, 2] * tau[1]
        for j in range(4):
            high = B[j, 1] * tau[0] + B[j, 2] * tau[1]
            apart = high / B[j, 0] - low / B[i, 0]
            if apart > 0.0:
                share = min(share, (most / B[j, 0] - least / B[i, 0]) / apart)
    lowest, highest = -math.inf, math.inf
    for i in range(4):
        f[i] = share * (B[i, 1] * tau[0] + B[i, 2] * tau[1])
        lowest = max(lowest, (least - f[i]) / B[i, 0])
        highest = min(highest, (most - f[i]) / B[i, 0])
    thrust = max(min(thrust, highest), lowest)
    share = 1.0
    for i in range(4):
        f[i] += B[i, 0] * thrust
        yaw = B[i, 3] * tau[2]
        room = most - f[i] if yaw > 0.0 else least - f[i]
        if abs(yaw) > abs(room):
            share = min(share, room / yaw)
    for i in range(4):
        f[i] = min(max(f[i] + max(share, 0.0) * B[i, 3] * tau[2], least), most)
    return True


@jit
def rotor_speeds(f, curve, limits, out):
    """Speeds out (4,) [rad/s] of rotors with forces f (4,) [N], within limits (2,), by their thrust curve (3,)."""
    for j in range(4):
        out[j] = min(max(rotor_speed(f[j], curve[0], curve[1], curve[2]), limits[0]), limits[1])


@jit
def write_desired_attitude(k, i, flight, state, F):
    """Desired attitude of vehicle i at tick k, for the desired force F (3,), into ``work.desired``."""
    vehicles, tables, work = flight.vehicles, flight.tables, state.work
    m, row = vehicles.m[i], k - tables.first
    yaw, F_dot, F_ddot = work.x[1], work.x[2], work.x[3]
    limited = limit_tilt_in_place(F, vehicles.tilt[i], m * vehicles.g) or state.layers[i] != 0
    for q in range(3):
        yaw[q] = tables.yaw[row, i, q] if tables.yaw.shape[0] > 0 else 0.0
        # At the limit of tilt, the force does not follow the reference's jerk
        F_dot[q] = m * tables.jerk[row, i, q] if tables.jerk.shape[0] > 0 and not limited else 0.0
        F_ddot[q] = m * tables.snap[row, i, q] if tables.snap.shape[0] > 0 and not limited else 0.0
    write_flat_attitude(F, F_dot, F_ddot, yaw, work.desired)


@jit
def command_rotors(k, i, flight, state):
    """Rotor speeds commanded to vehicle i at tick k, into ``state.command``; returns whether it saturates.

    A point's force is limited, and a lost vehicle gets none.
    """
    vehicles, commands, work = flight.vehicles, flight.commands, state.work
    command, S = state.command[i], state.S[i]
    F, tau, f = work.x[0], work.x[1], work.x[2]
    copy_vector(state.force[i], F)
    if vehicles.lost[i]:
        command[:] = 0.0
        return False
    if vehicles.point[i]:
        size = math.sqrt(F[0] * F[0] + F[1] * F[1] + F[2] * F[2])
        share = min(1.0, vehicles.limit[i] / max(size, 1e-300))
        for q in range(3):
            command[q] = share * F[q]
        return share < 1.0
    least, most = vehicles.speed[i, 0], vehicles.speed[i, 1]
    if commands.kind == ROTOR_SPEEDS:
        saturated = False
        for j in range(4):
            command[j] = min(max(commands.speeds[i, j], least), most)
            saturated = saturated or command[j] != commands.speeds[i, j]
        return saturated
    T, desired = work.T, work.desired
    attitude_matrix(S[6:10], T)
    if commands.kind == ATTITUDE:
        thrust = commands.thrust[i]
        attitude_matrix(commands.attitude[i], desired)
        for q in range(3):
            desired[3, q], desired[4, q] = commands.rates[i, q], 0.0
    else:
        write_desired_attitude(k, i, flight, state, F)
        thrust = F[0] * T[2, 0] + F[1] * T[2, 1] + F[2] * T[2, 2]
    write_attitude_torque(
        T, S[10:13], desired, vehicles.inertia[i], vehicles.k_R[i], vehicles.k_omega[i], tau
    )
    saturated = allocate_rotors(
        thrust, tau, vehicles.unmix[i], vehicles.force[i, 0], vehicles.force[i, 1], f
    )
    rotor_speeds(f, vehicles.thrust[i], vehicles.speed[i], command)
    return saturated
