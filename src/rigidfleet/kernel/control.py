"""Input laws: the reference motion of the virtual body, local tracking, and LQR of the body."""

import math

from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.linalg import copy, copy_vector
from rigidfleet.kernel.problem import BODY, SHAPE, TRACKING
from rigidfleet.kernel.references import blend_slots, piece_at
from rigidfleet.kernel.rigid_body import (
    allocate,
    damp_deformation,
    mean_axes,
    multiply,
    multiply_transposed,
    rotation_vector,
)


@jit
def _body_rate_factors_series(xx, s):
    a = 0.5 - xx * (1 / 24 - xx * (1 / 720 - xx / 40320))
    b = 1 / 6 - xx * (1 / 120 - xx * (1 / 5040 - xx / 362880))
    a_dot = -s * (1 / 12 - xx * (1 / 180 - xx * (1 / 6720 - xx / 453600)))
    b_dot = -s * (1 / 60 - xx * (1 / 1260 - xx * (1 / 60480 - xx / 4989600)))
    return a, b, a_dot, b_dot


@jit
def _body_rate_factors_closed(xx, s):
    x = math.sqrt(xx)
    sin, cos = math.sin(x), math.cos(x)
    a, b = (1.0 - cos) / xx, (x - sin) / (xx * x)
    a_dot = s * (x * sin - 2.0 + 2.0 * cos) / (xx * xx)
    b_dot = s * (3.0 * sin - 2.0 * x - x * cos) / (xx * xx * x)
    return a, b, a_dot, b_dot


@jit
def rate_factors(xx, s):
    """a, b and their derivatives over time, of `body_rates`, for xx = |phi|^2 and s = phi . dphi/dt."""
    return _body_rate_factors_series(xx, s) if xx < 0.04 else _body_rate_factors_closed(xx, s)


@jit
def body_rates(phi, phi_dot, phi_ddot, omega, omega_dot):
    """Body-axes rates of R = Exp(phi): omega = J_r(phi) phi_dot, and its derivative.

    J_r = 1 - a [phi x] + b [phi x]^2, a = (1 - cos x)/x^2, b = (x - sin x)/x^3, x = |phi|; the
    rates of a and b enter through a'/x and b'/x, all by their series for small x.
    """
    xx = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    s = phi[0] * phi_dot[0] + phi[1] * phi_dot[1] + phi[2] * phi_dot[2]  # x dx/dt
    a, b, a_dot, b_dot = rate_factors(xx, s)
    for q in range(3):
        i, j = (q + 1) % 3, (q + 2) % 3
        pv_i = phi[j] * phi_dot[q] - phi[q] * phi_dot[j]  # components of phi x phi_dot
        pv_j = phi[q] * phi_dot[i] - phi[i] * phi_dot[q]
        pv_q = phi[i] * phi_dot[j] - phi[j] * phi_dot[i]
        pa_i = phi[j] * phi_ddot[q] - phi[q] * phi_ddot[j]
        pa_j = phi[q] * phi_ddot[i] - phi[i] * phi_ddot[q]
        pa_q = phi[i] * phi_ddot[j] - phi[j] * phi_ddot[i]
        ppv = phi[i] * pv_j - phi[j] * pv_i
        vpv = phi_dot[i] * pv_j - phi_dot[j] * pv_i
        ppa = phi[i] * pa_j - phi[j] * pa_i
        omega[q] = phi_dot[q] - a * pv_q + b * ppv
        omega_dot[q] = phi_ddot[q] - a_dot * pv_q - a * pa_q + b_dot * ppv + b * (vpv + ppa)


@jit
def exp_transposed(phi, E):
    """E (3, 3) = Exp(phi)^T."""
    xx = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    x = max(math.sqrt(xx), 1e-8)
    a = math.sin(x) / x
    half = math.sin(0.5 * x) / (0.5 * x)
    b = 0.5 * half * half
    for i in range(3):
        for j in range(3):
            E[i, j] = b * phi[i] * phi[j]
        E[i, i] += 1.0 - b * xx
    E[0, 1] += a * phi[2]
    E[1, 0] -= a * phi[2]
    E[0, 2] -= a * phi[1]
    E[2, 0] += a * phi[1]
    E[1, 2] += a * phi[0]
    E[2, 1] -= a * phi[0]


@jit
def rotate_after(E, T, out):
    """out = E T for (3, 3) matrices."""
    for i in range(3):
        for j in range(3):
            out[i, j] = E[i, 0] * T[0, j] + E[i, 1] * T[1, j] + E[i, 2] * T[2, j]


@jit_inline
def reference_motion(t, motion, w):
    """Reference motion of the virtual body at t into w.body (see `Workspace`) and w.T_ref.

    After the last knot, the CM and the attitude continue at the rates they have there.
    """
    body = w.body
    low, x, beyond = piece_at(t, motion.knots)
    powers = motion.coefficients.shape[2]
    for q in range(6):
        c = motion.coefficients[low, q]
        if powers == 6:
            value = ((((c[5] * x + c[4]) * x + c[3]) * x + c[2]) * x + c[1]) * x + c[0]
            rate = (((5 * c[5] * x + 4 * c[4]) * x + 3 * c[3]) * x + 2 * c[2]) * x + c[1]
            second = ((20 * c[5] * x + 12 * c[4]) * x + 6 * c[3]) * x + 2 * c[2]
        else:
            value = rate = second = 0.0  # Horner's scheme for a polynomial and two derivatives
            for k in range(powers - 1, -1, -1):
                second = second * x + 2.0 * rate
                rate = rate * x + value
                value = value * x + c[k]
        if beyond > 0.0:
            value += beyond * rate
            second = 0.0
        row = 0 if q < 3 else 5
        body[row, q % 3] = value
        body[row + 1, q % 3] = rate
        body[row + 2, q % 3] = second
    body_rates(body[5], body[6], body[7], body[3], body[4])
    exp_transposed(body[5], w.E)
    rotate_after(w.E, motion.T1, w.T_ref)


@jit_inline
def desired_agents(w):
    """Desired position of each agent, r_i = r_cm + T^T p_i, and two derivatives, into w.r_ref etc.

    v_i = v_cm + T^T (dp + omega x p), which is Eq. (22),
    a_i = a_cm + T^T (ddp + 2 omega x dp + domega x p + omega x (omega x p)).
    """
    T, o, o_dot = w.T_ref, w.body[3], w.body[4]
    for i in range(w.p.shape[0]):
        x, y, z = w.p[i, 0], w.p[i, 1], w.p[i, 2]
        X, Y, Z = w.p_dot[i, 0], w.p_dot[i, 1], w.p_dot[i, 2]
        c0, c1, c2 = o[1] * z - o[2] * y, o[2] * x - o[0] * z, o[0] * y - o[1] * x  # omega x p
        # dp + omega x p, and 2 dp + omega x p for the acceleration
        v0, v1, v2 = X + c0, Y + c1, Z + c2
        e0, e1, e2 = X + v0, Y + v1, Z + v2
        a0 = w.p_ddot[i, 0] + o_dot[1] * z - o_dot[2] * y + o[1] * e2 - o[2] * e1
        a1 = w.p_ddot[i, 1] + o_dot[2] * x - o_dot[0] * z + o[2] * e0 - o[0] * e2
        a2 = w.p_ddot[i, 2] + o_dot[0] * y - o_dot[1] * x + o[0] * e1 - o[1] * e0
        for q in range(3):
            w.r_ref[i, q] = w.body[0, q] + T[0, q] * x + T[1, q] * y + T[2, q] * z
            w.v_ref[i, q] = w.body[1, q] + T[0, q] * v0 + T[1, q] * v1 + T[2, q] * v2
            w.a_ref[i, q] = w.body[2, q] + T[0, q] * a0 + T[1, q] * a1 + T[2, q] * a2


@jit_inline
def local_law(t, p, w):
    """Local LQR of every agent (paper, section V): f_i = m_i (a_i + g - k1 e_i - k2 de_i).

    For slots w.p at t [s]. Writes w.f_u and, into w.wrench, the wrench of the reference motion itself.
    """
    r, v, m, g, control = w.r, w.v, p.vehicles.m, p.vehicles.g, p.control
    reference_motion(t, p.motion, w)
    desired_agents(w)
    w.wrench[:] = 0.0
    for i in range(r.shape[0]):
        for q in range(3):
            e = r[i, q] - w.r_ref[i, q]
            e_dot = v[i, q] - w.v_ref[i, q]
            a = w.a_ref[i, q] + (g if q == 2 else 0.0)
            w.f_u[i, q] = m[i] * (a - control.k1 * e - control.k2 * e_dot)
            w.wrench[q] += m[i] * a
        x = w.r_ref[i, 0] - w.body[0, 0]
        y = w.r_ref[i, 1] - w.body[0, 1]
        z = w.r_ref[i, 2] - w.body[0, 2]
        a0, a1, a2 = m[i] * w.a_ref[i, 0], m[i] * w.a_ref[i, 1], m[i] * (w.a_ref[i, 2] + g)
        w.wrench[3] += y * a2 - z * a1
        w.wrench[4] += z * a0 - x * a2
        w.wrench[5] += x * a1 - y * a0


@jit
def body_gains(t, feedback, out):
    """Gains (4,) at t, from cubics through the table over the time to go; after arrival, the holding gains."""
    remaining = feedback.arrival - t
    if remaining < 0.0 or feedback.to_go.shape[0] == 0:
        copy_vector(feedback.hold, out)
        return
    low, since, _ = piece_at(remaining, feedback.to_go)
    h = feedback.to_go[low + 1] - feedback.to_go[low]
    s = since / h
    for q in range(4):
        x0, x1 = feedback.gain[low, q], feedback.gain[low + 1, q]
        v0, v1 = h * feedback.slope[low, q], h * feedback.slope[low + 1, q]
        rise = x1 - x0
        out[q] = x0 + s * (v0 + s * (3.0 * rise - 2.0 * v0 - v1 + s * (v0 + v1 - 2.0 * rise)))


@jit
def body_law(t, p, w):
    """LQR of the virtual body: from CM and attitude to the wrench w.wrench, which `allocate` distributes.

    The target moves: r_wp + v_wp (t - T), and turns at omega_wp. With the attitude error phi,
    body = target Exp(phi): F = M (g - K e), tau = I (-K phi ...) + omega x I omega, world axes.
    """
    M, g, T, feedback, gain = p.vehicles.M, p.vehicles.g, w.T, p.feedback, w.gain
    body_gains(t, feedback, gain)
    since = t - feedback.arrival
    F, tau = w.wrench[:3], w.wrench[3:]
    for q in range(3):
        e = w.cm[0, q] - feedback.r[q] - feedback.v[q] * since
        F[q] = M * (-gain[0] * e - gain[1] * (w.cm[1, q] - feedback.v[q]))
    F[2] += M * g
    turned = w.body[5]
    for q in range(3):
        turned[q] = feedback.omega[q] * since
    exp_transposed(turned, w.E)
    rotate_after(w.E, feedback.T1, w.T_ref)
    # Exp(phi) = T_ref T^T; phi in body axes, common to both frames.
    for i in range(3):
        for j in range(3):
            w.E[i, j] = w.T_ref[i, 0] * T[j, 0] + w.T_ref[i, 1] * T[j, 1] + w.T_ref[i, 2] * T[j, 2]
    phi, alpha, omega = w.body[5], w.body[6], w.body[3]
    rotation_vector(w.E, phi)
    multiply(T, w.cm[2], omega)
    for q in range(3):
        alpha[q] = -gain[2] * phi[q] - gain[3] * (omega[q] - feedback.omega[q])
    world = w.body[7]
    multiply_transposed(T, alpha, world)
    multiply(w.I, world, tau)
    o, h = w.cm[2], w.body[4]
    multiply(w.I, o, h)
    tau[0] += o[1] * h[2] - o[2] * h[1]
    tau[1] += o[2] * h[0] - o[0] * h[2]
    tau[2] += o[0] * h[1] - o[1] * h[0]


@jit_inline
def input_law(t, p, w):
    """Input force w.f_u (N, 3) [N] at t [s] by the phase's law, plus the deformation damping, for w.r and w.v.

    Also computes the mean axes (w.cm, w.I), if they are needed, and the slots (w.p).
    """
    m, M, control = p.vehicles.m, p.vehicles.M, p.control
    if p.law.k_def > 0.0 or p.has_frame or control.leads_body:
        mean_axes(w.r, w.v, m, M, w)
    if p.reference.kind == SHAPE or control.tracks_slots:
        blend_slots(t, p.reference, w.p, w.p_dot, w.p_ddot)
    if control.kind == TRACKING:
        local_law(t, p, w)
    elif control.kind == BODY:
        body_law(t, p, w)
        for i in range(m.shape[0]):
            for q in range(3):
                w.a[i, q] = w.r[i, q] - w.cm[0, q]
        F, tau = w.wrench[:3], w.wrench[3:]
        allocate(
            w.a, m, M, F, tau, w.cm[2], control.allocation, w.I, w.I_inv, w.f_u, w.H, w.H_V, w.H_w
        )
    else:
        copy(control.force, w.f_u)
    if p.law.k_def > 0.0:
        damp_deformation(w.r, w.v, m, p.law.k_def, w.cm, w.f_u)
