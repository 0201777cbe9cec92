"""The closed loop: equations of motion with the control and constraint laws of the phase.

States: inertial formulation [r (3N), v (3N), int c (m), q (4, if there is a frame)];
body formulation [x (3N), y (3N), int c (m), q (4), r_cm (3), v_cm (3)], x_i = T (r_i - r_cm),
y_i = T (v_i - v_cm).
"""

import math

from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.constraint import constraint_force
from rigidfleet.kernel.control import input_law
from rigidfleet.kernel.disturbances import restore_states_and_disturb, swap_in_measured_states
from rigidfleet.kernel.outside import call_external
from rigidfleet.kernel.rigid_body import (
    attitude_matrix,
    centre_of_mass,
    mean_axes,
    multiply,
    quaternion_rate,
)


@jit_inline
def closed_loop(t, y, dy, p, w):
    """Right-hand side dy of the closed loop at time t [s] and state y.

    Newton's law with the constraint force, Eqs. (1), (2): M dv/dt = f_E + f_u + f_C, f_u from the
    input law of the phase, f_C by Eq. (12), both from measured states and believed masses.
    Everything computed stays in ``w``.
    """
    vehicles, graph, disturbance = p.vehicles, p.graph, p.disturbance
    m, g = vehicles.m, vehicles.g
    n = m.shape[0]
    n_edges = graph.edges.shape[0]
    r, v, T = w.r, w.v, w.T
    q = 6 * n + n_edges
    if p.has_frame:
        attitude_matrix(y[q : q + 4], T)
    if p.body_formulation:
        write_world_states(y, p, w)
    else:
        for i in range(n):
            for s in range(3):
                r[i, s], v[i, s] = y[3 * i + s], y[3 * n + 3 * i + s]
    for i in range(n):
        w.f_E[i, 0], w.f_E[i, 1], w.f_E[i, 2] = 0.0, 0.0, -m[i] * g
    if p.external.address != 0:
        w.a[:] = 0.0
        call_external(p.external.address, t, r, v, w.a)
        for i in range(n):
            for s in range(3):
                w.f_E[i, s] += w.a[i, s]
    if disturbance.active:
        swap_in_measured_states(t, disturbance, w)

    input_law(t, p, w)

    if graph.edges.shape[0] > 0:
        constraint_force(t, y, dy, p, w)
    if disturbance.active:
        restore_states_and_disturb(t, m, g, disturbance, w)
        # The frame rotates with the true motion of the body
        if p.has_frame and disturbance.noise_r.shape[0] > 0:
            mean_axes(r, v, m, vehicles.M, w)
    write_accelerations(dy, p, w)
    if p.body_formulation:
        write_body_frame_derivatives(y, dy, p, w)
    if p.has_frame:
        multiply(T, w.cm[2], w.cm[4])
        quaternion_rate(y[q : q + 4], w.cm[4], dy[q : q + 4])


@jit_inline
def write_accelerations(dy, p, w):
    """Newton's law, Eqs. (1), (2), with true masses and what vehicles can give: w.a (N, 3) [m/s^2].

    In world axes, also dy of r and v.
    """
    vehicles, inverse, v = p.vehicles, p.disturbance.inverse, w.v
    n = inverse.shape[0]
    for i in range(n):
        share = 1.0
        if vehicles.saturate:
            thrust = 0.0
            for s in range(3):
                force = w.f_u[i, s] + w.f_C[i, s]
                thrust += force * force
            share = min(1.0, vehicles.thrust_limit[i] / max(math.sqrt(thrust), 1e-300))
        for s in range(3):
            net = w.f_E[i, s] + share * (w.f_u[i, s] + w.f_C[i, s])
            w.a[i, s] = inverse[i] * net
            if not p.body_formulation:
                dy[3 * i + s], dy[3 * n + 3 * i + s] = v[i, s], w.a[i, s]


@jit
def write_world_states(y, p, w):
    """Positions and velocities in world axes from the states of the body formulation: v by Eq. (22)."""
    n = p.vehicles.m.shape[0]
    q = 6 * n + p.graph.edges.shape[0]
    turn_to_world(w.T, y[: 3 * n], y[q + 4 : q + 7], w.r)
    turn_to_world(w.T, y[3 * n : 6 * n], y[q + 7 : q + 10], w.v)


@jit
def turn_to_world(T, x, origin, out):
    """out_i = origin + T^T x_i (N, 3), of x (3N,)."""
    # Scalars instead of elements: for the compiler, the output could alias the elements.
    T00, T01, T02 = T[0, 0], T[0, 1], T[0, 2]
    T10, T11, T12 = T[1, 0], T[1, 1], T[1, 2]
    T20, T21, T22 = T[2, 0], T[2, 1], T[2, 2]
    o0, o1, o2 = origin[0], origin[1], origin[2]
    for i in range(out.shape[0]):
        x0, x1, x2 = x[3 * i], x[3 * i + 1], x[3 * i + 2]
        out[i, 0] = o0 + T00 * x0 + T10 * x1 + T20 * x2
        out[i, 1] = o1 + T01 * x0 + T11 * x1 + T21 * x2
        out[i, 2] = o2 + T02 * x0 + T12 * x1 + T22 * x2


@jit
def write_body_frame_derivatives(y, dy, p, w):
    """The paper's equations of motion in the body frame, Eqs. (15), (16), in their well-posed form.

    The paper's pair for d2x/dt2 and domega/dt is linearly dependent: omega of a deforming body is
    a choice of frame. With mean axes, omega = I^+ h, and y_i = dx_i/dt + omega x x_i, Eq. (14), in
    place of dx_i/dt, Eq. (16) reads

        dx_i/dt = y_i - omega x x_i,   dy_i/dt = -omega x y_i + T (f_i/m_i - F/M),

    regular on a line too. Substituting y_i gives Eq. (16) back with all its Coriolis terms.
    """
    n = p.vehicles.m.shape[0]
    q = 6 * n + p.graph.edges.shape[0]
    T, omega, a_cm = w.T, w.cm[4], w.E[0]
    multiply(T, w.cm[2], omega)
    centre_of_mass(w.a, p.vehicles.m, p.vehicles.M, a_cm)
    for s in range(3):
        dy[q + 4 + s], dy[q + 7 + s] = y[q + 7 + s], a_cm[s]
    P, Q, R = omega[0], omega[1], omega[2]
    A0, A1, A2 = a_cm[0], a_cm[1], a_cm[2]
    T00, T01, T02 = T[0, 0], T[0, 1], T[0, 2]
    T10, T11, T12 = T[1, 0], T[1, 1], T[1, 2]
    T20, T21, T22 = T[2, 0], T[2, 1], T[2, 2]
    for i in range(n):
        j, k = 3 * i, 3 * (n + i)
        x0, x1, x2 = y[j], y[j + 1], y[j + 2]
        v0, v1, v2 = y[k], y[k + 1], y[k + 2]
        a0, a1, a2 = w.a[i, 0] - A0, w.a[i, 1] - A1, w.a[i, 2] - A2
        dy[j] = v0 - (Q * x2 - R * x1)
        dy[j + 1] = v1 - (R * x0 - P * x2)
        dy[j + 2] = v2 - (P * x1 - Q * x0)
        dy[k] = T00 * a0 + T01 * a1 + T02 * a2 - (Q * v2 - R * v1)
        dy[k + 1] = T10 * a0 + T11 * a1 + T12 * a2 - (R * v0 - P * v2)
        dy[k + 2] = T20 * a0 + T21 * a1 + T22 * a2 - (P * v1 - Q * v0)
