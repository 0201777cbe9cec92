"""Equations of motion of a quadrotor: a rigid body, four rotors with lag, and drag in moving air.

The model is that of RotorPy (Folk, Paulos and Kumar 2023, arXiv:2306.04485) with polynomial curves of thrust and
torque, linear drag, a quadratic lag of the motors and the rotors' angular momentum, as in crazyflow's
`first_principles`.

Eight vehicles are a vector: what is written for the numbers of one vehicle acts on those of eight (`kernel.vectors`).
"""

import math

from rigidfleet.kernel.aerodynamics import ground_effect_factor
from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.disturbances import ground_contact
from rigidfleet.kernel.fleet import LANES, STATES, thrust_of
from rigidfleet.kernel.rigid_body import attitude_matrix, quaternion_rate
from rigidfleet.kernel.vectors import as_lanes
from rigidfleet.solids.distance import height_below

#: Rows of `SampledWork.y`.
_START, _TRIAL, _RATES, _END = 0, 1, 2, 6
#: Places in `SampledWork.parameters`: mass, inertia (3), places of the rotors (4, 3), their spin (4), curves of thrust
#: (3) and torque (3), drag (2) and lift; parasitic drag (3), linear drag (3), inertia of a rotor, motor (4).
_MASS, _INERTIA, _ROTOR_PLACES, _SPIN, _THRUST, _TORQUE, _ROTOR_DRAG = 0, 1, 4, 16, 20, 23, 26
_LIFT, _PARASITIC_DRAG, _LINEAR_DRAG, _ROTOR_INERTIA, _MOTOR = 28, 29, 32, 35, 36
#: Places in `SampledWork.inputs`: command (4), push (3), factor of the thrust near the ground, air at the start, the
#: middle and the end of a step (3, 3).
_COMMAND, _PUSH, _GAIN, _AIR = 0, 4, 7, 8

_curve = jit_inline(thrust_of)


@jit
def point_derivative(y, command, i, vehicles, air, push, dy):
    """Derivative dy (17,) of vehicle i, an ideal point with the force ``command`` [N], limited by its own rules."""
    m = vehicles.m[i]
    for q in range(3):
        force = command[q] + push[q] + vehicles.drag[i, q] * (air[q] - y[3 + q])
        dy[q], dy[3 + q] = y[3 + q], force / m
    dy[5] -= vehicles.g
    for q in range(6, 17):
        dy[q] = 0.0


@jit
def quadrotor_derivative(y, p, inputs, air, g, T, dy):
    """Derivative dy (17,) of states y (17,), see `fleet.STATES`: numbers, or vectors of eight vehicles.

    Parameters
    ----------
    p : (40,) parameters, see `_MASS`
    inputs : (17,) commands and surroundings, see `_COMMAND`
    air : (3,) velocity of the air, world [m/s]
    g : [m/s^2]
    T : (3, 3) work; holds world -> body afterwards
    """
    m = p[_MASS]
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
    F0 = -(speed * p[_PARASITIC_DRAG] + p[_LINEAR_DRAG]) * b0
    F1 = -(speed * p[_PARASITIC_DRAG + 1] + p[_LINEAR_DRAG + 1]) * b1
    F2 = -(speed * p[_PARASITIC_DRAG + 2] + p[_LINEAR_DRAG + 2]) * b2
    gain = inputs[_GAIN]
    k0, k1, k2 = gain * p[_THRUST], gain * p[_THRUST + 1], gain * p[_THRUST + 2]
    k_d, k_z, k_h = p[_ROTOR_DRAG], p[_ROTOR_DRAG + 1], p[_LIFT]
    M0 = M1 = M2 = momentum = turning = 0.0 * gain
    for j in range(4):
        place = _ROTOR_PLACES + 3 * j
        x0, x1, x2 = p[place], p[place + 1], p[place + 2]
        w, spin, command = y[13 + j], p[_SPIN + j], inputs[_COMMAND + j]
        u0, u1, u2 = b0 + Q * x2 - R * x1, b1 + R * x0 - P * x2, b2 + P * x1 - Q * x0
        h0, h1 = -k_d * w * u0, -k_d * w * u1
        h2 = _curve(w, k0, k1, k2) + k_h * (u0 * u0 + u1 * u1) - k_z * w * u2
        F0, F1, F2 = F0 + h0, F1 + h1, F2 + h2
        M0 += x1 * h2 - x2 * h1
        M1 += x2 * h0 - x0 * h2
        M2 += x0 * h1 - x1 * h0 + spin * _curve(w, p[_TORQUE], p[_TORQUE + 1], p[_TORQUE + 2])
        error, both = command - w, command + w
        rise = max(error, 0.0)
        rate = rise * (p[_MOTOR] + p[_MOTOR + 1] * both)
        rate += (error - rise) * (p[_MOTOR + 2] + p[_MOTOR + 3] * both)
        dy[13 + j] = rate
        momentum, turning = momentum + spin * w, turning + spin * rate
    # A rotor turns against its torque on the body
    h, I0, I1, I2 = p[_ROTOR_INERTIA], p[_INERTIA], p[_INERTIA + 1], p[_INERTIA + 2]
    dy[10] = (M0 + Q * h * momentum - (I2 - I1) * Q * R) / I0
    dy[11] = (M1 - P * h * momentum - (I0 - I2) * P * R) / I1
    dy[12] = (M2 + h * turning - (I1 - I0) * P * Q) / I2
    dy[0], dy[1], dy[2] = y[3], y[4], y[5]
    dy[3] = (T00 * F0 + T10 * F1 + T20 * F2 + inputs[_PUSH]) / m
    dy[4] = (T01 * F0 + T11 * F1 + T21 * F2 + inputs[_PUSH + 1]) / m
    dy[5] = (T02 * F0 + T12 * F1 + T22 * F2 + inputs[_PUSH + 2]) / m - g


@jit
def add_ground_contact(i, y, vehicles, around, dy):
    """Add to the derivative dy (17,) of vehicle i, which is lost, what the ground does to it."""
    m = vehicles.m[i]
    over = height_below(y[0], y[1], y[2], around.roofs) + around.radius[i]
    damping, lift = ground_contact(m, vehicles.g, max(around.floor[i], over), y[2])
    if damping > 0.0:
        for q in range(3):
            dy[3 + q] -= damping / m * y[3 + q]
            dy[10 + q] -= damping / m * y[10 + q]
        dy[5] += lift / m


@jit
def take_parameters(vehicles, work):
    """Write the parameters of `Quadrotors` into the vectors of ``work``."""
    v = vehicles
    for i in range(v.m.shape[0]):
        own = work.parameters[i // LANES, i % LANES :: LANES]
        own[_MASS], own[_LIFT], own[_ROTOR_INERTIA] = v.m[i], v.lift[i], v.rotor_inertia[i]
        for q in range(3):
            own[_INERTIA + q], own[_THRUST + q] = v.inertia[i, q], v.thrust[i, q]
            own[_TORQUE + q], own[_LINEAR_DRAG + q] = v.torque[i, q], v.drag[i, q]
            own[_PARASITIC_DRAG + q] = v.c[i, q]
        for j in range(4):
            own[_SPIN + j], own[_MOTOR + j] = v.spin[i, j], v.motor[i, j]
            for q in range(3):
                own[_ROTOR_PLACES + 3 * j + q] = v.rotors[i, j, q]
        own[_ROTOR_DRAG], own[_ROTOR_DRAG + 1] = v.rotor_drag[i, 0], v.rotor_drag[i, 1]


@jit
def take_inputs(commands, push, work):
    """Write commands (N, 4), pushes (N, 3) and the air of ``work`` into its vectors."""
    for i in range(commands.shape[0]):
        own = work.inputs[i // LANES, i % LANES :: LANES]
        for j in range(4):
            own[_COMMAND + j] = commands[i, j]
        for q in range(3):
            own[_PUSH + q] = push[i, q]
            for s in range(3):
                own[_AIR + 3 * s + q] = work.air[s, i, q]


@jit
def fleet_derivative(stage, vehicles, around, work):
    """Derivatives of all vehicles at the trial states of ``work.y``, into the row of a stage, with its air."""
    y, dy, first = work.y[_TRIAL], work.y[_RATES + stage], _AIR + 3 * ((stage + 1) // 2)
    if around.ground_effect:
        for i in range(vehicles.m.shape[0]):
            own, gain = y[i // LANES, i % LANES :: LANES], 1.0
            over = max(around.ground, height_below(own[0], own[1], own[2], around.roofs))
            if over > -math.inf:
                gain = ground_effect_factor(own[2] - over, vehicles.radius[i], vehicles.span[i])
            work.inputs[i // LANES, i % LANES :: LANES][_GAIN] = gain
    states, rates, p = as_lanes(y), as_lanes(dy), as_lanes(work.parameters)
    inputs, T = as_lanes(work.inputs), as_lanes(work.axes)
    for k in range(states.shape[0]):
        air = inputs[k, first : first + 3]
        quadrotor_derivative(states[k], p[k], inputs[k], air, vehicles.g, T, rates[k])
    for i in range(vehicles.m.shape[0]):
        own, rate = y[i // LANES, i % LANES :: LANES], dy[i // LANES, i % LANES :: LANES]
        if vehicles.point[i]:
            force = work.inputs[i // LANES, i % LANES :: LANES]
            air, push = force[first : first + 3], force[_PUSH:]
            point_derivative(own, force, i, vehicles, air, push, rate)
        if vehicles.lost[i]:
            add_ground_contact(i, own, vehicles, around, rate)


@jit
def runge_kutta(h, commands, vehicles, around, push, work):
    """Advance all vehicles by h [s] from row 0 of ``work.y`` to row 6, the classical method of fourth order.

    ``work.air`` holds the air at the start, the middle and the end. The quaternion is normalised after the step. Row 2
    then holds the derivative at the start.
    """
    take_inputs(commands, push, work)
    rows = as_lanes(work.y)
    for k in range(rows.shape[1]):
        for q in range(STATES):
            rows[_TRIAL, k, q] = rows[_END, k, q] = rows[_START, k, q]
    for stage in range(4):
        fleet_derivative(stage, vehicles, around, work)
        weight = h / 6.0 if stage in (0, 3) else h / 3.0
        reach = h if stage == 2 else 0.5 * h
        for k in range(rows.shape[1]):
            for q in range(STATES):
                change = rows[_RATES + stage, k, q]
                rows[_END, k, q] += weight * change
                rows[_TRIAL, k, q] = rows[_START, k, q] + reach * change
    for k in range(rows.shape[1]):
        normalise_quaternion(rows[_END, k, 6:10])


@jit
def normalise_quaternion(q):
    """Scale a quaternion (4,) to unit length."""
    scale = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for k in range(4):
        q[k] *= scale
