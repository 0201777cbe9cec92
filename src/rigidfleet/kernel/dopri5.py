"""The closed loop's right-hand side, its integrator and its recorder.

States: inertial formulation [r (3N), v (3N), int c (m), q (4, if there is a frame)];
body formulation [x (3N), y (3N), int c (m), q (4), r_cm (3), v_cm (3)], x_i = T (r_i - r_cm),
y_i = T (v_i - v_cm).
"""

import math

import numpy as np
from numba import types
from numba.extending import intrinsic

from rigidfleet.kernel.compiler.jit import compiled, inlined
from rigidfleet.kernel.compiler.pointers import by_address
from rigidfleet.kernel.compiler.simd import blocks, rough_inverse, spread, total_or_worst
from rigidfleet.kernel.constraint import constraint_force
from rigidfleet.kernel.control import input_law
from rigidfleet.kernel.disturbances import disturb, sense
from rigidfleet.kernel.gauge import read_gauge
from rigidfleet.kernel.problem import BODY, LOCAL, OPEN, Program, Workspace
from rigidfleet.kernel.records import (
    ATOL,
    COLLAPSED,
    FINISHED,
    LEAST_ERROR,
    PAUSED,
    STATE,
    TRIAL,
    Integrator,
    integrator,
)
from rigidfleet.kernel.references import blend_slots
from rigidfleet.kernel.rigid_body import (
    attitude_matrix,
    centre_of_mass,
    mean_axes,
    multiply,
    quaternion_rate,
)


@intrinsic
def call_external(_context, address, t, r, v, f):
    """Call the C function at ``address``: void(double t, double *r, *v, *f, ssize_t n)."""
    from llvmlite import ir

    def generate(context, builder, signature, arguments):
        pointer, double, size = ir.IntType(8).as_pointer(), ir.DoubleType(), ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [double, pointer, pointer, pointer, size])
        function = builder.inttoptr(arguments[0], kind.as_pointer())
        arrays = [
            context.make_array(signature.args[k])(context, builder, arguments[k]) for k in (2, 3, 4)
        ]
        data = [builder.bitcast(a.data, pointer) for a in arrays]
        count = builder.extract_value(arrays[0].shape, 0)
        builder.call(function, [arguments[1], *data, count])
        return context.get_dummy_value()

    return types.void(types.int64, types.float64, r, v, f), generate


@inlined
def closed_loop(t, y, dy, p, w):
    """Right-hand side dy of the closed loop at time t [s] and state y.

    Newton's law with the constraint force: M dv/dt = f_E + f_u + f_C (Eq. 2), f_u from the input
    law of the phase, f_C from the multipliers (Eq. 12), both from measured states and believed
    masses. Everything computed stays in ``w``.
    """
    vehicles, graph, disturbance = p.vehicles, p.graph, p.disturbance
    m, g = vehicles.m, vehicles.g
    n = m.shape[0]
    n_edges = graph.edges.shape[0]
    r, v, T = w.r, w.v, w.T
    q = 6 * n + n_edges
    if p.has_frame:
        attitude_matrix(y[q : q + 4], T)
    for i in range(n):
        for s in range(3):
            r[i, s], v[i, s] = y[3 * i + s], y[3 * n + 3 * i + s]
        w.f_E[i, 0], w.f_E[i, 1], w.f_E[i, 2] = 0.0, 0.0, -m[i] * g
    if p.body_formulation:
        world_states(y, p, w)
    if p.external != 0:
        for i in range(n):
            w.a[i, 0], w.a[i, 1], w.a[i, 2] = 0.0, 0.0, 0.0
        call_external(p.external, t, r, v, w.a)
        for i in range(n):
            for s in range(3):
                w.f_E[i, s] += w.a[i, s]
    if disturbance.active:
        sense(t, disturbance, w)

    input_law(t, p, w)

    if graph.edges.shape[0] > 0:
        constraint_force(t, y, dy, p, w)
    if disturbance.active:
        disturb(t, m, g, disturbance, w)
        if p.has_frame and disturbance.noise_r.shape[0] > 0:  # the frame turns as the body does
            mean_axes(r, v, m, vehicles.M, w)
    accelerate(dy, p, w)
    if p.body_formulation:
        body_derivatives(y, dy, p, w)
    if p.has_frame:
        multiply(T, w.cm[2], w.cm[4])
        quaternion_rate(y[q : q + 4], w.cm[4], dy[q : q + 4])


@inlined
def accelerate(dy, p, w):
    """Newton's law (Eq. 2) with true masses and what the vehicles can give: w.a (N, 3) [m/s^2], and dy of r and v."""
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
            dy[3 * i + s], dy[3 * n + 3 * i + s] = v[i, s], w.a[i, s]


@compiled
def world_states(y, p, w):
    """Positions and velocities in world axes from the states of the body formulation."""
    n = p.vehicles.m.shape[0]
    q = 6 * n + p.graph.edges.shape[0]
    turn_back(w.T, y[: 3 * n], y[q + 4 : q + 7], w.r)
    turn_back(w.T, y[3 * n : 6 * n], y[q + 7 : q + 10], w.v)


@compiled
def turn_back(T, x, origin, out):
    """out_i = origin + T^T x_i (N, 3), of x (3N,)."""
    # Numbers rather than elements: what is stored could be one of them, for all that the compiler knows.
    T00, T01, T02 = T[0, 0], T[0, 1], T[0, 2]
    T10, T11, T12 = T[1, 0], T[1, 1], T[1, 2]
    T20, T21, T22 = T[2, 0], T[2, 1], T[2, 2]
    o0, o1, o2 = origin[0], origin[1], origin[2]
    for i in range(out.shape[0]):
        x0, x1, x2 = x[3 * i], x[3 * i + 1], x[3 * i + 2]
        out[i, 0] = o0 + T00 * x0 + T10 * x1 + T20 * x2
        out[i, 1] = o1 + T01 * x0 + T11 * x1 + T21 * x2
        out[i, 2] = o2 + T02 * x0 + T12 * x1 + T22 * x2


@compiled
def body_derivatives(y, dy, p, w):
    """The paper's equations of motion in the body frame, in their well-posed form.

    The paper's pair for d2x/dt2 and domega/dt is linearly dependent: omega of a deforming body is
    a choice of frame. With mean axes, omega = I^+ h, and y_i = dx_i/dt + omega x x_i in place of
    dx_i/dt, its Eq. 16 reads

        dx_i/dt = y_i - omega x x_i,   dy_i/dt = -omega x y_i + T (f_i/m_i - F/M),

    regular on a line too. Substituting y_i gives Eq. 16 back with all its Coriolis terms.
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


# Dormand and Prince's 5(4) pair, with Hairer's fourth-order continuous extension.
_A = np.zeros((7, 6))
_A[1, :1] = 1 / 5
_A[2, :2] = 3 / 40, 9 / 40
_A[3, :3] = 44 / 45, -56 / 15, 32 / 9
_A[4, :4] = 19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729
_A[5, :5] = 9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656
_A[6] = 35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84
_C = np.array([0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1, 1])
_E = np.array([71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
_D = np.array(
    [
        -12715105075 / 11282082432, 0, 87487479700 / 32700410799, -10690763975 / 1880347072,
        701980252875 / 199316789632, -1453857185 / 822651844, 69997945 / 29380423,
    ]
)  # fmt: skip


@compiled
def forget_stages(k, first):
    """Make the stages from ``first`` on zero: NaN left in them would outlive its weight of zero."""
    for s in range(first, 7):
        for q in range(k.shape[1]):
            k[s, q] = spread(0.0)


@inlined
def advance(k, stage, a, h):
    """Write the state of a stage: y + h sum a[stage, s] k_s."""
    # All six terms at once: stages still to come have no weight, and finite values.
    a0, a1, a2 = h * a[stage, 0], h * a[stage, 1], h * a[stage, 2]
    a3, a4, a5 = h * a[stage, 3], h * a[stage, 4], h * a[stage, 5]
    for q in range(k.shape[1]):
        k[TRIAL, q] = ((a0 * k[0, q] + a1 * k[1, q]) + (a2 * k[2, q] + a3 * k[3, q])) + (
            k[STATE, q] + (a4 * k[4, q] + a5 * k[5, q])
        )


@compiled
def keep_start(p, w, state):
    """Leave the forces behind a jump in the trail."""
    read_gauge(p, w, state.trail.start)


@compiled
def keep_step(t, h, p, w, state):
    """Leave a step in the trail: its continuous extension by Bernstein coefficients, and the forces at its end.

    With the terms of Hairer's form, y + x (rise + (1 - x) (bend + x (rest + (1 - x) twist))).
    """
    K, row = state.K, state.count[4]
    points = state.trail.points[row]
    state.trail.clock[row, 0], state.trail.clock[row, 1] = t, h
    for q in range(points.shape[1]):
        y, rise = K[STATE, q], K[TRIAL, q] - K[STATE, q]
        bend = h * K[0, q] - rise
        rest = rise - h * K[6, q] - bend
        twist = _D[0] * K[0, q] + _D[2] * K[2, q] + _D[3] * K[3, q]
        twist = h * (twist + _D[4] * K[4, q] + _D[5] * K[5, q] + _D[6] * K[6, q])
        points[0, q] = y
        points[1, q] = y + 0.25 * (rise + bend)
        points[2, q] = y + 0.5 * rise + bend / 3.0 + (rest + twist) / 6.0
        points[3, q] = y + 0.75 * rise + 0.25 * (bend + rest)
        points[4, q] = K[TRIAL, q]
    read_gauge(p, w, state.trail.gauge[row])
    state.count[4] = row + 1


@compiled
def integrate(p, w, state, t_end, fresh, times, samples, max_steps):
    """Integrate `closed_loop` to ``t_end`` [s]; adaptive Dormand-Prince 5(4), PI step control.

    Parameters
    ----------
    p, w, state : Program, Workspace, Integrator (changed in place)
    t_end : time to land on [s]
    fresh : True at a start or after a switch, where the derivative at y is not known yet
    times, samples : (K,) [s] increasing and (K, n): where to write the dense output; the next
        index to write is ``state.count[3]``
    max_steps : pause after so many steps

    Returns FINISHED, PAUSED (the trail may be full), or COLLAPSED where the step size fell to nothing
    (singular constraints, non-finite forces); y and t are then those of the last step that was good.
    """
    p, w, state = by_address(p), by_address(w), by_address(state)
    K, clock, count = state.K, state.clock, state.count
    n, room = state.y.shape[0], state.trail.clock.shape[0]
    y, trial = K[STATE], K[TRIAL]
    for q in range(n):
        y[q] = state.y[q]
    k = blocks(K)
    t, h, last = clock[0], clock[1], clock[2]
    if fresh:
        forget_stages(k, 0)
    first = 0 if fresh else 1
    status = PAUSED
    for _ in range(max_steps):
        h = min(h, t_end - t)
        stage = first
        # One call site of the right-hand side: stage 0 is the derivative at y itself.
        while stage < 7:
            advance(k, stage, _A, h)
            closed_loop(t + _C[stage] * h, trial, K[stage], p, w)
            if stage == 0 and room > 0:
                keep_start(p, w, state)
            count[0] += 1
            stage += 1
        squares = spread(0.0)
        for q in range(k.shape[1]):
            e = h * (
                (_E[0] * k[0, q] + _E[2] * k[2, q] + _E[3] * k[3, q])
                + (_E[4] * k[4, q] + _E[5] * k[5, q] + _E[6] * k[6, q])
            )
            size = max(abs(k[STATE, q]), abs(k[TRIAL, q]))
            e *= rough_inverse(k[ATOL, q] + state.rtol * size)
            squares += e * e
        error = math.sqrt(total_or_worst(squares, y) / n)
        if not error <= 1.0:  # NaN too
            count[2] += 1
            first = 1
            shrink = 0.1
            if error < math.inf:
                shrink = 0.9 * error**-0.2
            else:
                forget_stages(k, 1)
            h *= max(0.1, shrink)
            if h < 1e-12 * max(1.0, abs(t)):
                status = COLLAPSED
                break
            continue
        t_new = t + h if t + h < t_end else t_end
        if count[3] < times.shape[0] and times[count[3]] <= t_new:
            for q in range(n):  # into K[1], which has no weight in the sums
                d = _D[0] * K[0, q]
                for s in range(1, 7):
                    d += _D[s] * K[s, q]
                K[1, q] = h * d
        while count[3] < times.shape[0] and times[count[3]] <= t_new:
            x = (times[count[3]] - t) / h
            for q in range(n):
                rise = trial[q] - y[q]
                bend = h * K[0, q] - rise
                rest = rise - h * K[6, q] - bend
                inner = bend + x * (rest + (1.0 - x) * K[1, q])
                samples[count[3], q] = y[q] + x * (rise + (1.0 - x) * inner)
            count[3] += 1
        if room > 0:
            keep_step(t, h, p, w, state)
        for q in range(k.shape[1]):
            k[STATE, q] = k[TRIAL, q]
            k[0, q] = k[6, q]
        t = t_new
        first = 1
        count[1] += 1
        # 0.9 error^-0.17 last^0.04, by logarithms: two powers would take as long as half an evaluation.
        error = math.log(max(error, 1e-8))
        h *= min(5.0, max(0.2, 0.9 * math.exp(0.04 * last - 0.17 * error)))
        last = max(error, LEAST_ERROR)
        if t >= t_end:
            status = FINISHED
            break
        if room > 0 and count[4] == room:
            break
    for q in range(n):
        state.y[q] = y[q]
    clock[0], clock[1], clock[2] = t, h, last
    return status


@compiled
def copy(a, out):
    """Copy a into out, both two-dimensional."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i, j] = a[i, j]


@compiled
def record(times, samples, p, w, dy, out):
    """Evaluate the closed loop at the sampled states and keep its forces and references.

    Without rows in ``out``, what the last evaluation leaves in the workspace is all that was asked for.
    """
    for k in range(times.shape[0]):
        closed_loop(times[k], samples[k], dy, p, w)
        if k < out.r.shape[0]:
            keep(times[k], p, w, k, out)


@compiled
def keep(t, p, w, k, out):
    """Copy what the closed loop has left in the workspace at time t [s] into row k of a record."""
    kind = p.control.kind
    for i in range(w.c.shape[0]):
        out.c[k, i], out.L[k, i], out.multiplier[k, i] = w.c[i], w.L[i], w.multiplier[i]
        out.d[k, i], out.d_dot[k, i] = w.d[i], w.d_dot[i]
    copy(w.r, out.r[k])
    copy(w.v, out.v[k])
    copy(w.a, out.a[k])
    copy(w.f_E, out.f_E[k])
    copy(w.f_u, out.f_u[k])
    copy(w.f_C, out.f_C[k])
    if p.disturbance.active:
        copy(w.f_D, out.f_D[k])
        if p.disturbance.noise_r.shape[0] > 0:
            copy(w.r_seen, out.r_seen[k])
            copy(w.v_seen, out.v_seen[k])
    for q in range(6):
        out.wrench[k, q] = w.wrench[q]
    # Where only distances are blended, their slots still say how the formation lies.
    blend_slots(t, p.reference, w.p, w.p_dot, w.p_ddot)
    copy(w.p, out.p[k])
    if kind != OPEN:
        copy(w.T_ref, out.T_ref[k])
    if kind == LOCAL:
        copy(w.r_ref, out.r_ref[k])
        for q in range(3):
            out.motion[k, q], out.motion[k, 3 + q] = w.body[0, q], w.body[1, q]
            out.rates[k, q] = w.body[3, q]
    elif kind == BODY:
        since = t - p.feedback.arrival
        for q in range(3):
            out.motion[k, q] = p.feedback.r[q] + p.feedback.v[q] * since
            out.motion[k, 3 + q] = p.feedback.v[q]
            out.rates[k, q] = p.feedback.omega[q]


__all__ = ["FINISHED", "Integrator", "Program", "Workspace", "integrate", "integrator", "record"]
