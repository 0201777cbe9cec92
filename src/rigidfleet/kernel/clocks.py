"""Each vehicle's own copy of the virtual body's clock: the time tau at which it flies the plan.

Without messages, the clock of vehicle i starts late and drifts. With them, it follows those of its neighbours,

    dtau_i/dt = s_i (1 + drift_i) + g sum(tau_j - tau_i),

a consensus on the sum over neighbours j that it hears; tau_j is the newest one heard, brought forward by the rate that
came with it. The pace s_i from 0 to 1 falls with the greatest distance of any vehicle from its slot, as far as i knows:
all wait for one that is stuck. By the chain rule, a path r(tau) is flown with the velocity r' dtau/dt.
"""

import math

from rigidfleet.kernel.clock_records import (
    FASTEST,
    OFF,
    PACE,
    PLACE,
    RATE,
    SINCE,
    SLOPE,
    SLOT,
    WORST,
)
from rigidfleet.kernel.compiler.jit import jit
from rigidfleet.kernel.mail import CLOCK

#: Bandwidth of the pace [1/s]: two equal lags, so that the acceleration of a reference does not jump.
_BANDWIDTH = 5.0


@jit
def fill_path_tables(k, i, tick, flight, state):
    """Fill the rows of vehicle i for tick k in the tables of its path, yaw, jerk and snap, by its own clock."""
    tables, rate, here = flight.tables, state.tau[i, RATE], k - flight.tables.first
    rows = tables.by_clock.shape[0]
    if rows == 0:
        return
    x = k + state.tau[i, OFF] / tick - tables.origin
    x = min(x, rows - 1.0) if x >= 0.0 else 0.0  # not a number in a flight that has come apart
    row = int(x)
    after, x = min(row + 1, rows - 1), x - row
    before, then, scale = tables.by_clock[row, i], tables.by_clock[after, i], 1.0
    # Position, velocity, jerk and snap have three columns each; yaw comes with two derivatives.
    for q in range(3):
        tables.path[here, i, q] = before[q] + x * (then[q] - before[q])
        tables.path[here, i, 3 + q] = rate * (before[3 + q] + x * (then[3 + q] - before[3 + q]))
        tables.yaw[here, i, q] = scale * (before[6 + q] + x * (then[6 + q] - before[6 + q]))
        tables.jerk[here, i, q] = rate**3 * (before[9 + q] + x * (then[9 + q] - before[9 + q]))
        tables.snap[here, i, q] = rate**4 * (before[12 + q] + x * (then[12 + q] - before[12 + q]))
        scale *= rate


@jit
def neighbour_clock_offset_and_rate(link, tick_number, tick, mail):
    """What the clock of a link's sender differs by from the time at a tick [s] by its newest message, and its rate."""
    rate = mail.heard[link, CLOCK + 1]
    return mail.heard[link, CLOCK] + (tick_number - mail.stamp[link]) * tick * (rate - 1.0), rate


@jit
def advance_clocks(k, tick, flight, state):
    """Advance all clocks to tick k, ``tick`` [s] after the one before, and choose their rates until the next.

    The age of a message is known to its receiver, though its stamp is by the sender's oscillator: two vehicles that
    hear each other learn how their oscillators differ, up to half the difference of the two delays (as Cristian's
    algorithm and NTP do); and what drifts over the age of a message is a millionth of it.
    """
    clocks, net, mail = flight.clocks, flight.network, state.mail
    for i in range(state.tau.shape[0]):
        own = state.tau[i]
        own[OFF] += tick * (own[RATE] - 1.0)
        if k < clocks.late[i]:
            own[RATE] = 0.0
            fill_path_tables(k, i, tick, flight, state)
            continue
        target = min(max(2.0 - 2.0 * own[WORST] / clocks.wait, 0.0), 1.0)
        second = _BANDWIDTH * (_BANDWIDTH * (target - own[PACE]) - 2.0 * own[SLOPE])
        own[PACE] = max(0.0, own[PACE] + tick * own[SLOPE])
        own[SLOPE] += tick * second
        pull, heard = 0.0, 0
        for l in range(net.first[i], net.first[i + 1]):
            if mail.stamp[l] >= 0 and k - mail.stamp[l] <= net.silence:
                pull += neighbour_clock_offset_and_rate(l, k, tick, mail)[0] - own[OFF]
                heard += 1
        # Of the sum, the own clock counts at the end of the tick: stable at any gain
        pull *= clocks.gain / (1.0 + tick * clocks.gain * heard)
        own[RATE] = min(max(own[PACE] * (1.0 + clocks.drift[i]) + pull, 0.0), FASTEST)
        fill_path_tables(k, i, tick, flight, state)


@jit
def post_clock(k, i, clocks, own, message):
    """Write into a message of vehicle i what neighbours need of its clock: its rate is that without their pull."""
    message[CLOCK] = own[OFF]
    message[CLOCK + 1] = 0.0 if k < clocks.late[i] else own[PACE] * (1.0 + clocks.drift[i])
    message[CLOCK + 2], message[CLOCK + 3] = own[WORST], own[SINCE]


@jit
def update_worst_tracking_error(i, k, error, net, mail, own):
    """Take the error of vehicle i [m] at tick k, or a greater one that it has heard of.

    What was measured a time of silence ago counts nothing, and newer errors count more until then. So a great error
    spreads as far as messages do, stays known while it lasts, and is then forgotten by all, who had it from whomever.
    """
    own[WORST], own[SINCE], most = error, k, error
    for l in range(net.first[i], net.first[i + 1]):
        worst, since = mail.heard[l, CLOCK + 2], mail.heard[l, CLOCK + 3]
        weighed = worst * (1.0 - (k - since) / net.silence)
        if mail.stamp[l] >= 0 and weighed > most:
            own[WORST], own[SINCE], most = worst, since, weighed


@jit
def apply_own_clock(i, k, t, p, w, flight, state):
    """Turn the plan in w, evaluated at the time of vehicle i's own clock, into what i flies at tick k, t [s].

    The slots of i and its neighbours and the lengths of their edges change by the chain rule; then follows the input
    force of i. Before the plan's first knot, slots move as they do there. Returns whether i is stuck: it then flies to
    where it was when that began.
    """
    net, mail, own, g = flight.network, state.mail, state.tau[i], p.vehicles.g
    rate, slope, tick = own[RATE], own[SLOPE], flight.steps * flight.h
    tracks = p.control.tracks_slots
    early, error = min(t + own[OFF] - p.motion.knots[0], 0.0), 0.0
    for l in range(net.first[i] - 1, net.first[i + 1]):
        j, ahead, pace = i, early, rate
        if l >= net.first[i]:  # a neighbour's slot is where its own clock has it
            there, pace = neighbour_clock_offset_and_rate(l, k, tick, mail)
            j, ahead = net.links[l, 1], early + (there - own[OFF] if mail.stamp[l] >= 0 else 0.0)
        for q in range(3 if tracks else 0):
            v, a = w.v_ref[j, q], w.a_ref[j, q] if early == 0.0 else 0.0
            w.r_ref[j, q] += ahead * (v + 0.5 * ahead * a)
            v += ahead * a
            w.v_ref[j, q], w.a_ref[j, q] = pace * v, pace * pace * a + slope * v
        c = mail.edge[l] if l >= net.first[i] else -1
        if c >= 0:
            w.d_ddot[c] = rate * rate * w.d_ddot[c] + slope * w.d_dot[c]
            w.d_dot[c] *= rate
    if tracks:
        for q in range(3):
            away, apart = w.r[i, q] - w.r_ref[i, q], w.v[i, q] - w.v_ref[i, q]
            a = w.a_ref[i, q] - p.control.k1 * away - p.control.k2 * apart
            w.f_u[i, q] = p.vehicles.m[i] * (a + (g if q == 2 else 0.0))
            error += away * away
            own[SLOT + q], own[SLOT + 3 + q] = w.r_ref[i, q], w.v_ref[i, q]
            own[SLOT + 6 + q] = w.a_ref[i, q]
    update_worst_tracking_error(i, k, math.sqrt(error), net, mail, own)
    stuck = False
    for n in range(flight.clocks.stuck.shape[0]):
        one = flight.clocks.stuck[n]
        stuck = stuck or (one[0] == i and one[1] <= k < one[2])
    for q in range(3):
        if not stuck or math.isnan(own[PLACE + q]):
            own[PLACE + q] = w.r[i, q] if stuck else math.nan
        if stuck:
            a = p.control.k1 * (own[PLACE + q] - w.r[i, q]) - p.control.k2 * w.v[i, q]
            w.f_u[i, q] = p.vehicles.m[i] * (a + (g if q == 2 else 0.0))
    return stuck


@jit
def write_slots_by_own_clock(p, w, state):
    """Put into w the slot of each vehicle by its own clock: what others know of it is no longer needed."""
    for i in range(state.tau.shape[0] if p.control.tracks_slots else 0):
        for q in range(3):
            w.r_ref[i, q], w.v_ref[i, q] = state.tau[i, SLOT + q], state.tau[i, SLOT + 3 + q]
            w.a_ref[i, q] = state.tau[i, SLOT + 6 + q]


@jit
def zero_own_constraint_force(i, w, net, state):
    """Exert no constraint force as vehicle i; its integrals of constraints go on, as its neighbours' do."""
    mail = state.mail
    state.saturated[i] = True  # its own integral rests; steering says anew whether it is
    w.f_C[i] = mail.pull[i] = 0.0
    for l in range(net.first[i], net.first[i + 1]):
        mail.multiplier[l, :-1] = 0.0
