"""The sampled flight of a fleet: measurements, formation law and attitude control at ticks, fixed steps in between.

Tick k is at ``start + k steps h``. At each tick, states are measured; at every ``every``-th tick the formation law
gives each vehicle a desired force; then attitude control gives it rotor speeds, which are held to the next tick.
Between ticks the true states follow the equations of motion by the classical Runge-Kutta method with the step h. Gusts
are evaluated at each stage, a user's force in the middle of each step, downwash once per step.
"""

import math

from rigidfleet.kernel.aerodynamics import add_downwash_to_air, write_air_velocity_in_step
from rigidfleet.kernel.attitude_control import command_rotors, rotor_speed
from rigidfleet.kernel.clock_records import OFF, RATE, SLOPE
from rigidfleet.kernel.clocks import (
    advance_clocks,
    apply_own_clock,
    post_clock,
    write_slots_by_own_clock,
    zero_own_constraint_force,
)
from rigidfleet.kernel.compiler.jit import jit
from rigidfleet.kernel.control import local_law
from rigidfleet.kernel.fleet import (
    ACCELERATION,
    ANSWERED,
    CONSTRAINT_FORCE,
    ERROR,
    FORCE,
    HORIZONTAL,
    LAW_TICKS,
    LAW_TIME,
    LOAD,
    OWN,
    SAMPLES,
    STEPS,
    TICKS,
    TIME,
    TRAILED,
    UPRIGHT,
    VERTICAL,
)
from rigidfleet.kernel.linalg import copy, copy_vector
from rigidfleet.kernel.mail import NONE, PULL, SATURATED, SLOT, TRACKED, A, R, U, V
from rigidfleet.kernel.neighbours import (
    extrapolate_neighbour,
    fade_silent_edges,
    observe_disturbance,
    solve_own_constraint_force,
)
from rigidfleet.kernel.network import receive, send
from rigidfleet.kernel.outside import call_external, call_recorder
from rigidfleet.kernel.problem import SHAPE
from rigidfleet.kernel.quadrotor import normalise_quaternion, rotor_curve, runge_kutta
from rigidfleet.kernel.records import ASKS, COLLAPSED, FINISHED, PAUSED
from rigidfleet.kernel.references import blend_slots, distance_references
from rigidfleet.kernel.rigid_body import (
    attitude_matrix,
    mean_axes,
    multiply,
    multiply_transposed,
    quaternion_rate,
)

#: Times that differ by less than this share of a step are the same.
_SAME = 1e-9


# -- what is known -------------------------------------------------------------------------------------


@jit
def path_coordinate(k, i, q, tables):
    """Coordinate q of r, v of vehicle i's path at tick k, or the first one of the table; 0 without paths."""
    return tables.path[max(k - tables.first, 0), i, q] if tables.path.shape[0] > 0 else 0.0


@jit
def measure_states(k, flight, state):
    """Measured states of all vehicles at tick k, into ``state.seen``.

    States are kept as what they differ from a path by. A state that is old when it is used is then added to the path of
    now, not of then: a measurement that carries its time.
    """
    sensing, tables, depth = flight.sensing, flight.tables, state.history.shape[0]
    n, now = state.S.shape[0], k % depth
    for i in range(n):
        for q in range(6):
            state.history[now, i, q] = state.S[i, q] - path_coordinate(k, i, q, tables)
    if k % sensing.every == 0:
        # The tables begin with the first measurement at or after their first tick.
        u = k // sensing.every - (tables.first + sensing.every - 1) // sensing.every
        noisy = tables.noise_r.shape[0] > 0
        for i in range(n):
            if tables.dropped.shape[0] > 0 and tables.dropped[u, i]:
                continue
            then = (k - sensing.delay[i]) % depth
            for q in range(3):
                r, v = state.history[then, i, q], state.history[then, i, 3 + q]
                state.seen[i, q] = r + (tables.noise_r[u, i, q] if noisy else 0.0)
                state.seen[i, 3 + q] = v + (tables.noise_v[u, i, q] if noisy else 0.0)


# -- the formation law ---------------------------------------------------------------------------------


@jit
def evaluate_law(k, t, p, w, flight, state, call):
    """Evaluate the formation law at tick k, time t [s], for the states that are known; results in w."""
    known, y = state.seen, state.work.law_state[0]
    n, m = known.shape[0], state.integral.shape[0]
    for i in range(n):
        for q in range(3):
            y[3 * i + q] = known[i, q] + path_coordinate(k, i, q, flight.tables)
            y[3 * n + 3 * i + q] = known[i, 3 + q] + path_coordinate(k, i, 3 + q, flight.tables)
    copy_vector(state.integral, y[6 * n :])
    copy_vector(state.frame[0], y[6 * n + m :])
    state.work.law_time[0] = t
    call_recorder(call.recorder, p, w, call.segment, call.record)


@jit
def integrate_constraints(dt, p, w, state):
    """Add c dt to the integral of each constraint, unless a vehicle of its edge is saturated."""
    edges = p.graph.edges
    for k in range(edges.shape[0]):
        if not (state.saturated[edges[k, 0]] or state.saturated[edges[k, 1]]):
            state.integral[k] += dt * w.c[k]


@jit
def compensate_drag(i, v, share, vehicles, state):
    """Add a share of the drag that vehicle i meets at a velocity v (3,) in still air to its desired force.

    The drag of rotors grows with their speed, which is that of the desired thrust.
    """
    T, x, force = state.work.T, state.work.x, state.force[i]
    attitude_matrix(state.S[i, 6:10], T)
    multiply(T, v, x[0])
    speed = math.sqrt(x[0, 0] ** 2 + x[0, 1] ** 2 + x[0, 2] ** 2)
    across = along = 0.0
    if not vehicles.point[i]:
        load = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
        k0, k1, k2 = vehicles.thrust[i, 0], vehicles.thrust[i, 1], vehicles.thrust[i, 2]
        rotors = 4.0 * rotor_speed(0.25 * load, k0, k1, k2)  # sum of their speeds
        across, along = vehicles.rotor_drag[i, 0] * rotors, vehicles.rotor_drag[i, 1] * rotors
    for q in range(3):
        rotor = across if q < 2 else along
        x[0, q] *= share * (rotor + vehicles.drag[i, q] + speed * vehicles.c[i, q])
    multiply_transposed(T, x[0], x[1])
    for q in range(3):
        force[q] += x[1, q]


@jit
def write_desired_force(k, i, dt, p, w, flight, state):
    """Desired force of vehicle i [N] from the law just evaluated, with what is added after it, if it is not its own."""
    vehicles, guidance, own = flight.vehicles, flight.guidance, flight.commands.kind == OWN
    m, pull = p.vehicles.m[i], 0.0
    for q in range(3):
        state.f_u[i, q], state.f_C[i, q] = w.f_u[i, q], w.f_C[i, q]
        state.force[i, q] = w.f_u[i, q] + w.f_C[i, q]
        pull += w.f_C[i, q] * w.f_C[i, q]
    if not vehicles.lost[i]:
        record_if_worse(i, CONSTRAINT_FORCE, math.sqrt(pull), state.work.law_time[0], state)
    if p.control.tracks_slots:
        if guidance.drag[i] > 0.0 and not own:
            compensate_drag(i, w.v_ref[i], guidance.drag[i], vehicles, state)
        for q in range(0 if own else 3):
            if not state.saturated[i]:
                known = state.seen[i, q] + path_coordinate(k, i, q, flight.tables)
                state.error[i, q] += dt * (known - w.r_ref[i, q])
            state.force[i, q] -= m * guidance.k_i[i, q] * state.error[i, q]
        if not vehicles.lost[i]:
            e = 0.0
            for q in range(3):
                e += (state.S[i, q] - w.r_ref[i, q]) ** 2
            record_if_worse(i, ERROR, math.sqrt(e), state.work.law_time[0], state)


@jit
def record_if_worse(i, kind, value, t, state):
    """Keep a value of vehicle i and its time if it is the greatest so far."""
    if value > state.worst[i, kind]:
        state.worst[i, kind], state.worst_time[i, kind] = value, t


@jit
def write_states_and_plan(k, t, p, w, flight, state):
    """What each vehicle knows at tick k, time t [s], into w: its measured state and, by one clock, the plan."""
    write_measured_r_and_v(k, w.r, w.v, flight, state)
    if not flight.clocks.own:
        evaluate_plan(t, p, w)


@jit
def evaluate_distributed_law(k, t, dt, p, w, flight, state):
    """Desired force of each vehicle from its own measured state, the plan and its neighbours' messages.

    ``dt`` [s] is the time between two evaluations. Of w, only the plan and the rows of vehicle i are read for i.
    Vehicles that follow laws of their own have answered in ``state.f_u`` with their whole force.
    """
    net, mail, tick, stuck = flight.network, state.mail, flight.steps * flight.h, False
    state.work.law_time[0] = t
    write_states_and_plan(k, t, p, w, flight, state)
    state.integral[:] = 0.0
    last = mail.multiplier.shape[1] - 1
    for i in range(state.S.shape[0]):
        if flight.vehicles.lost[i]:
            continue
        if flight.clocks.own:
            evaluate_plan(max(t + state.tau[i, OFF], p.motion.knots[0]), p, w)
            stuck = apply_own_clock(i, k, t, p, w, flight, state)
        observe_disturbance(i, dt, w.v[i], net, mail)
        fade_silent_edges(i, k, flight.every, net, mail)
        if flight.commands.kind == OWN:
            for q in range(3):
                w.f_u[i, q], w.f_C[i, q] = state.f_u[i, q], 0.0
        else:
            solve_own_constraint_force(i, k, dt, tick, p, w, net, mail, state.saturated[i])
        if stuck:
            zero_own_constraint_force(i, w, net, state)
        write_desired_force(k, i, dt, p, w, flight, state)
        for q in range(3):
            mail.commanded[i, q] = state.force[i, q] * p.vehicles.inverse[i]
        mail.commanded[i, 2] -= p.vehicles.g
        for l in range(net.first[i], net.first[i + 1]):
            if mail.edge[l] >= 0:
                state.integral[mail.edge[l]] += 0.5 * mail.multiplier[l, last]
    if flight.clocks.own:
        write_slots_by_own_clock(p, w, state)


@jit
def evaluate_plan(t, p, w):
    """Slots, input forces and desired distances of the plan at t [s], into w, for the states in w."""
    if p.reference.kind == SHAPE or p.control.tracks_slots:
        blend_slots(t, p.reference, w.p, w.p_dot, w.p_ddot)
    if p.control.tracks_slots:
        local_law(t, p, w)
    else:
        copy(p.control.force, w.f_u)
    distance_references(
        t, p.reference, p.graph.edges, w.p, w.p_dot, w.p_ddot, w.d, w.d_dot, w.d_ddot
    )


@jit
def write_measured_r_and_v(k, r, v, flight, state):
    """Measured states of vehicles at tick k, each of its own, into r and v (N, 3)."""
    for i in range(state.S.shape[0]):
        for q in range(3):
            r[i, q] = state.seen[i, q] + path_coordinate(k, i, q, flight.tables)
            v[i, q] = state.seen[i, 3 + q] + path_coordinate(k, i, 3 + q, flight.tables)


@jit
def prepare_messages(k, p, w, flight, state):
    """Have ready what each vehicle could send at tick k: what it knows of itself, and what it does."""
    mail, row = state.mail, k % state.mail.due.shape[1]
    write_measured_r_and_v(k, w.r, w.v, flight, state)
    for i in range(state.S.shape[0]):
        message, m = mail.post[row, i], p.vehicles.inverse[i]
        for q in range(3):
            message[R + q], message[V + q] = w.r[i, q], w.v[i, q]
            message[A + q] = mail.commanded[i, q] + mail.estimate[i, 3 + q]
            message[U + q] = m * state.f_u[i, q]
            message[SLOT + q], message[SLOT + 3 + q] = w.r_ref[i, q], w.v_ref[i, q]
            message[SLOT + 6 + q] = w.a_ref[i, q]
        message[TRACKED] = 1.0 if p.control.tracks_slots else 0.0
        message[SATURATED] = 1.0 if state.saturated[i] else 0.0
        post_clock(k, i, flight.clocks, state.tau[i], message)
        copy_vector(mail.pull[i], message[PULL:])
    copy(mail.multiplier, mail.posted[row])


@jit
def is_well_predicted(j, k, p, w, flight, mail):
    """Whether neighbours guess at tick k where vehicle j is, in w.r, well enough by its last broadcast."""
    net, since, square = flight.network, k - mail.said[j], 0.0
    if net.event == 0.0 or mail.said[j] == NONE or since >= net.longest:
        return False
    age, tracks = since * flight.steps * flight.h, p.control.tracks_slots
    for q in range(3):
        place, _, _ = extrapolate_neighbour(j, q, age, mail.last[j], tracks, w, 0.0, 0.0)
        square += (w.r[j, q] - place) ** 2
    return square < net.event**2


@jit
def decide_broadcasts(k, p, w, flight, state):
    """Decide which vehicles do not broadcast what they have posted at tick k; keep what the others send."""
    mail = state.mail
    for j in range(state.S.shape[0]):
        quiet = flight.vehicles.lost[j] or mail.mute[j]
        mail.silent[j] = quiet or is_well_predicted(j, k, p, w, flight, mail)
        if not mail.silent[j]:
            mail.said[j] = k
            copy_vector(mail.post[k % mail.due.shape[1], j], mail.last[j])


@jit
def find_desired_forces(k, t, p, w, flight, state, call):
    """Desired forces of all vehicles at tick k, time t [s]; returns False if there are none (a singular law)."""
    dt = flight.every * flight.steps * flight.h
    advance_frame(t, p, state)
    if flight.network.every > 0:
        evaluate_distributed_law(k, t, dt, p, w, flight, state)
    else:
        evaluate_law(k, t, p, w, flight, state, call)
        integrate_constraints(dt, p, w, state)
        for i in range(state.S.shape[0]):
            write_desired_force(k, i, dt, p, w, flight, state)
    if p.has_frame:
        copy(state.S[:, :3], w.r)
        copy(state.S[:, 3:6], w.v)
        mean_axes(w.r, w.v, p.vehicles.m, p.vehicles.M, w)
        multiply(w.T, w.cm[2], w.cm[4])
        copy_vector(state.frame[1], state.frame[2])
        quaternion_rate(state.frame[0], w.cm[4], state.frame[1])
    state.clock[LAW_TIME] = t
    state.count[LAW_TICKS] += 1
    finite = abs(state.force.sum()) < math.inf
    if finite and call.guard != 0:
        return call_recorder(call.guard, flight, state, call.avoidance, 0) != 0
    return finite


@jit
def advance_frame(t, p, state):
    """Advance the mean-axis frame from the last evaluation of the law to t [s], by the rates of the last two.

    The frame turns with the true motion. The method of Adams and Bashforth is of second order.
    """
    if p.has_frame and state.count[LAW_TICKS] > 0:
        dt, first = t - state.clock[LAW_TIME], state.count[LAW_TICKS] == 1
        for q in range(4):
            before = state.frame[1, q] if first else state.frame[2, q]
            state.frame[0, q] += dt * (1.5 * state.frame[1, q] - 0.5 * before)
        normalise_quaternion(state.frame[0])


@jit
def measure_and_command_rotors(k, t, p, w, flight, state, call):
    """Measure, desire and steer at tick k, time t [s]; returns False if the law gives no force."""
    if flight.network.every > 0:
        if flight.clocks.own:
            advance_clocks(k, flight.steps * flight.h, flight, state)
        receive(k, flight.network, state.mail)
    measure_states(k, flight, state)
    due = flight.commands.kind in (FORCE, OWN) and k % flight.every == 0
    if due and not find_desired_forces(k, t, p, w, flight, state, call):
        return False
    for i in range(state.S.shape[0]):
        state.saturated[i] = command_rotors(k, i, flight, state)
        if state.saturated[i]:
            state.saturations[i] += 1
    if flight.network.every > 0:
        prepare_messages(k, p, w, flight, state)
        if k % flight.network.every == 0:
            decide_broadcasts(k, p, w, flight, state)
            send(k, state.S, flight.network, state.mail)
    return True


# -- between ticks -------------------------------------------------------------------------------------


@jit
def advance_states(start, h, flight, state):
    """Advance all vehicles by h [s] in ``work.y``, from states ``start`` (N, 17) to row 6."""
    work = state.work
    for i in range(start.shape[0]):
        copy_vector(start[i], work.y[0, 17 * i :])
    runge_kutta(h, state.command, flight.vehicles, flight.air, state.push, work)


@jit
def find_air_and_push(t, h, S, p, flight, state):
    """Velocity of the air [m/s] over a step from states S (N, 17), into ``work.air``; a user's force in its middle.

    The force is asked before: position and velocity in the middle of the step stand in rows of the air's until then.
    Returns whether it is finite.
    """
    work = state.work
    state.push[:] = 0.0
    if p.external.address != 0:
        for i in range(S.shape[0]):
            for q in range(3):
                work.air[0, i, q], work.air[1, i, q] = S[i, q] + 0.5 * h * S[i, 3 + q], S[i, 3 + q]
        call_external(p.external.address, t + 0.5 * h, work.air[0], work.air[1], state.push)
    write_air_velocity_in_step(t, h, flight.air, work.air)
    if flight.air.downwash:
        add_downwash_to_air(state.S, flight.vehicles, flight.air.density, work.T, work.air)
    return abs(state.push.sum()) < math.inf


@jit
def write_derivatives(sample, t, p, flight, state, call):
    """Derivatives of the states of a sample: those at the start of a step without length."""
    find_air_and_push(t, 0.0, call.S[sample], p, flight, state)
    advance_states(call.S[sample], 0.0, flight, state)
    for i in range(state.S.shape[0]):
        copy_vector(state.work.y[2, 17 * i : 17 * i + 17], call.dS[sample, i])


@jit
def write_samples(t, h, p, flight, state, call):
    """Write the samples up to t + h [s]: each is a step of its own from t."""
    work, count, times = state.work, state.count, call.times
    while count[SAMPLES] < times.shape[0]:
        c = count[SAMPLES]
        x = max(times[c] - t, 0.0)
        if x > h * (1.0 + _SAME):
            return
        x = h if x > h * (1.0 - _SAME) else x
        find_air_and_push(t, x, state.S, p, flight, state)
        advance_states(state.S, x, flight, state)
        for i in range(state.S.shape[0]):
            copy_vector(work.y[6, 17 * i : 17 * i + 17], call.S[c, i])
            copy_vector(state.command[i], call.command[c, i])
            for q in range(3):
                call.f_u[c, i, q], call.f_C[c, i, q] = state.f_u[i, q], state.f_C[i, q]
            for q in range(6):
                call.seen[c, i, q] = state.seen[i, q] + path_coordinate(
                    count[TICKS] - 1, i, q, flight.tables
                )
            call.saturated[c, i] = state.saturated[i]
            call.layers[c, i] = state.layers[i]
            since = t + x - flight.start - (count[TICKS] - 1) * flight.steps * flight.h
            call.tau[c, i, 0] = state.tau[i, OFF] + since * (state.tau[i, RATE] - 1.0)
            call.tau[c, i, 1], call.tau[c, i, 2] = state.tau[i, RATE], state.tau[i, SLOPE]
        write_derivatives(c, t + x, p, flight, state, call)
        copy_vector(state.integral, call.integral[c])
        for q in range(4):
            call.frame[c, q] = (
                state.frame[0, q] + (t + x - state.clock[LAW_TIME]) * state.frame[1, q]
            )
        normalise_quaternion(call.frame[c])
        copy_vector(state.mail.stamp, call.stamp[c])
        count[SAMPLES] = c + 1


@jit
def write_step_curve(i, h, work, points):
    """Bernstein coefficients (5, 6 N) of vehicle i over a step: of the quartic through r0, v0, a0, r1, v1; its rate."""
    own = slice(17 * i, 17 * i + 17)
    first, end, rate = work.y[0, own], work.y[6, own], work.y[2, own]
    n = points.shape[1] // 6
    for q in range(3):
        r0, v0, a0, r1, v1 = first[q], first[3 + q], rate[3 + q], end[q], end[3 + q]
        column = 3 * i + q
        p1, p2, p3 = r0 + 0.25 * h * v0, r0 + 0.5 * h * v0 + h * h * a0 / 12.0, r1 - 0.25 * h * v1
        points[0, column], points[1, column], points[2, column] = r0, p1, p2
        points[3, column], points[4, column] = p3, r1
        d1, d2 = 4.0 * (p2 - p1) / h, 4.0 * (p3 - p2) / h
        column += 3 * n
        points[0, column], points[1, column] = v0, 0.25 * (v0 + 3.0 * d1)
        points[2, column] = 0.5 * (d1 + d2)
        points[3, column], points[4, column] = 0.25 * (3.0 * d2 + v1), v1


@jit
def update_extremes(i, t, h, vehicles, state):
    """Extremes of vehicle i over a step from t [s]: at its end, the acceleration at its start.

    A rotor's speed is monotone while its command is held, so the ends of steps have its greatest thrust. The
    acceleration of a point jumps at ticks, and is the highest after them.
    """
    own = slice(17 * i, 17 * i + 17)
    rate, end = state.work.y[2, own], state.work.y[6, own]
    across = rate[3] ** 2 + rate[4] ** 2
    record_if_worse(i, ACCELERATION, math.sqrt(across + rate[5] ** 2), t, state)
    record_if_worse(i, HORIZONTAL, math.sqrt(across), t, state)
    record_if_worse(i, VERTICAL, abs(rate[5]), t, state)
    command, load = state.command[i], 0.0
    if vehicles.point[i]:
        load = math.sqrt(command[0] ** 2 + command[1] ** 2 + command[2] ** 2)
        record_if_worse(i, LOAD, load, t, state)
        return
    for j in range(4):
        w = end[13 + j]
        force = rotor_curve(w, vehicles.thrust[i, 0], vehicles.thrust[i, 1], vehicles.thrust[i, 2])
        load += force
        if force > state.peak[i, j]:
            state.peak[i, j], state.peak_time[i, j] = force, t + h
    record_if_worse(i, LOAD, load, t + h, state)
    upright = 1.0 - 2.0 * (end[7] * end[7] + end[8] * end[8])
    if upright < state.worst[i, UPRIGHT]:
        state.worst[i, UPRIGHT], state.worst_time[i, UPRIGHT] = upright, t + h


@jit
def advance_fleet(t, h, p, flight, state):
    """Advance all vehicles from t by h [s], and record the step in the trail, if there is one.

    Returns False, and advances none, if a user's force is not finite.
    """
    if not find_air_and_push(t, h, state.S, p, flight, state):
        return False
    row, trail = state.count[TRAILED], state.trail
    kept = trail.clock.shape[0] > 0
    if kept:
        trail.clock[row, 0], trail.clock[row, 1] = t, h
        state.count[TRAILED] = row + 1
    advance_states(state.S, h, flight, state)
    for i in range(state.S.shape[0]):
        if not flight.vehicles.lost[i]:
            update_extremes(i, t, h, flight.vehicles, state)
        if kept:
            write_step_curve(i, h, state.work, trail.points[row])
        copy_vector(state.work.y[6, 17 * i : 17 * i + 17], state.S[i])
    return True


@jit
def measure_for_laws(k, t, p, w, flight, state):
    """Measure at tick k, time t [s]; where vehicles follow laws of their own, have ready what they know there."""
    measure_states(k, flight, state)
    if flight.commands.kind == OWN:
        receive(k, flight.network, state.mail)
        write_states_and_plan(k, t, p, w, flight, state)


@jit
def fly_ticks(p, w, flight, state, call):
    """Fly to ``call.t_end`` [s]; see `fleet` for the arguments.

    Returns FINISHED; PAUSED if the trail is full, the tables end or ``max_steps`` are done; or COLLAPSED if the law
    gives no force (a singular law) or a user's function none: states and time are then those before. A pause changes no
    bit of the flight, unless ``t_end`` lies between two steps, where it divides one. With no steps to do, a flight at a
    tick measures what the law will know there; to measure once more changes nothing. Where vehicles follow laws of
    their own, it returns ASKS before each of their ticks, with what they know in w and the mail: their forces go into
    ``state.f_u``, and tick + 1 into ``state.count``.
    """
    count, clock = state.count, state.clock
    if call.max_steps == 0 and count[TICKS] == count[STEPS] // flight.steps:
        measure_for_laws(count[TICKS], clock[TIME], p, w, flight, state)
    room = state.trail.clock.shape[0]
    for _ in range(call.max_steps):
        t, step = clock[TIME], count[STEPS]
        if t >= call.t_end - _SAME * flight.h:
            return FINISHED
        if room > 0 and count[TRAILED] >= room:
            return PAUSED
        k = step // flight.steps
        if step % flight.steps == 0 and count[TICKS] == k:
            if k >= flight.tables.last:
                return PAUSED
            if flight.commands.kind == OWN and k % flight.every == 0 and count[ANSWERED] <= k:
                measure_for_laws(k, t, p, w, flight, state)
                return ASKS
            if not measure_and_command_rotors(k, t, p, w, flight, state, call):
                return COLLAPSED
            count[TICKS] = k + 1
        grid, until = flight.start + (step + 1) * flight.h, flight.start + step * flight.h
        whole = grid <= call.t_end + _SAME * flight.h
        end = grid if whole else call.t_end
        h = flight.h if whole and t == until else end - t
        write_samples(t, h, p, flight, state, call)
        if not advance_fleet(t, h, p, flight, state):
            return COLLAPSED
        clock[TIME] = end
        if whole:
            count[STEPS] = step + 1
    return PAUSED
