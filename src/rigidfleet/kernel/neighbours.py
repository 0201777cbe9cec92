"""The constraint force of each vehicle by what it knows of its neighbours.

Eq. (12) of the paper couples all edges. A vehicle knows its own state of now, and of each neighbour what its newest
message says: position, velocity, acceleration and its part in their edge. It solves the rows of its own edges exactly
for its own multipliers, and takes what its neighbours' other edges do to them as heard. Sent once a tick, this is
Jacobi's iteration over overlapping blocks, one for each vehicle; its fixed point is the law of all edges.

Each end holds its own multiplier. Four things keep the two from parting, and the delay from being felt:

* a neighbour is taken to be where its acceleration has brought it since, with the input that it has there;
* that acceleration includes what the vehicle estimates of gusts, from its own velocity;
* of what a vehicle knows of itself and its neighbour does not know yet, it believes half: the force that it exerts
  without a counterforce is half as large, while its own feedback stays prompt;
* the integrals of the two ends are drawn together as they were when the message was sent.
"""

import math

from rigidfleet.kernel.compiler.jit import jit
from rigidfleet.kernel.linalg import cholesky, cholesky_solve
from rigidfleet.kernel.mail import (
    FRESH,
    NONE,
    PULL,
    SATURATED,
    SLOT,
    TOGETHER,
    TRACKED,
    UNDER_WAY,
    A,
    R,
    U,
    V,
)
from rigidfleet.kernel.problem import ITERATED

# Columns of `Mail.rows`: unit vector, right side, multiplier, link.
_UNIT, _RIGHT, _UNKNOWN, _LINK = 0, 3, 4, 5


@jit
def observe_disturbance(i, dt, v, net, mail):
    """Estimate what accelerates vehicle i beside its desired force, from its velocity v (3,), for the last dt [s].

    An observer of second order: the velocity that the estimate foretells is corrected by what is measured.
    """
    lag = max(net.lag, 4.0 * dt)
    for q in range(3):
        known = mail.estimate[i, q] + dt * (mail.commanded[i, q] + mail.estimate[i, 3 + q])
        off = v[q] - known
        mail.estimate[i, q] = known + min(1.0, 2.0 * dt / lag) * off
        mail.estimate[i, 3 + q] += dt / (lag * lag) * off


@jit
def reduce_integral_difference(l, messages, mail):
    """Draw i's integral of the edge of link l towards j's, both as when the newest message was sent."""
    share = mail.multiplier.shape[1] - 1
    part = min(TOGETHER, UNDER_WAY / max(messages, 1.0))
    mail.multiplier[l, share] -= part * (mail.ours[l, share] - mail.theirs[l, share])


@jit
def fade_silent_edges(i, k, ticks, net, mail):
    """Let go of silent neighbours of vehicle i over some time, and take hold again as smoothly.

    ``ticks`` is the number of ticks since the last evaluation.
    """
    for l in range(net.first[i], net.first[i + 1]):
        silent = mail.stamp[l] < 0 or k - mail.stamp[l] > net.silence
        step = ticks / net.silence
        mail.grip[l] = max(0.0, mail.grip[l] - step) if silent else min(1.0, mail.grip[l] + step)
        if mail.edge[l] == NONE or mail.stamp[l] < 0:
            mail.grip[l] = 0.0
        elif mail.fresh[l]:
            reduce_integral_difference(l, (k - mail.stamp[l]) / net.every, mail)
        mail.fresh[l] = False


@jit
def extrapolate_neighbour(j, axis, age, message, tracks_slots, w, k1, k2):
    """Where vehicle j is along an axis, how fast, and what its input accelerates it by, ``age`` [s] after a message.

    What it is off its slot moves on by its acceleration; the slot moves as planned, whatever the age. Without a slot,
    the vehicle itself moves on. Its input follows what it is off by the gains k1 [1/s^2] and k2 [1/s].
    """
    r, v, a, put = message[R + axis], message[V + axis], message[A + axis], message[U + axis]
    if not tracks_slots or message[TRACKED] == 0.0:  # or sent before slots were tracked
        return r + age * (v + 0.5 * age * a), v + age * a, put
    v, a = v - message[SLOT + 3 + axis], a - message[SLOT + 6 + axis]
    place = w.r_ref[j, axis] + r - message[SLOT + axis] + age * (v + 0.5 * age * a)
    put += w.a_ref[j, axis] - message[SLOT + 6 + axis] - age * (k1 * (v + 0.5 * age * a) + k2 * a)
    return place, w.v_ref[j, axis] + v + age * a, put


@jit
def write_equation_of_edge(row, link, k, dt, tick, p, w, net, mail, saturated):
    """Row of vehicle i's own equations for the edge of a link, from its state in w.r and w.v, and its message.

    Fills the unit vector from the neighbour and the right side of Eq. (12) without any constraint force; integrates the
    constraint over dt [s].
    """
    i, j, c = net.links[link, 0], net.links[link, 1], mail.edge[link]
    rows, heard, own, law = mail.rows, mail.heard[link], mail.own[link], p.law
    age = (k - mail.stamp[link]) * tick
    mail.oldest[link] = max(mail.oldest[link], k - mail.stamp[link])
    tracks = p.control.tracks_slots
    distance = along = square = pull = 0.0
    x, k1, k2 = rows[row, _UNIT:_RIGHT], p.control.k1, p.control.k2
    for q in range(3):
        theirs, speed, put = extrapolate_neighbour(j, q, age, heard, tracks, w, k1, k2)
        mine, pace, _ = extrapolate_neighbour(i, q, age, own, tracks, w, k1, k2)
        # Where both are by what both know, and half of what only i knows of itself.
        x[q] = mine + FRESH * (w.r[i, q] - mine) - theirs
        pace += FRESH * (w.v[i, q] - pace) - speed
        distance += x[q] * x[q]
        along += x[q] * pace
        square += pace * pace
        pull += x[q] * (w.f_u[i, q] * p.vehicles.inverse[i] - put)
    distance = math.sqrt(distance)
    along, pull = along / distance, pull / distance
    for q in range(3):
        x[q] /= distance
    d_dot = d_ddot = 0.0
    if c >= 0:
        mail.length[link], d_dot, d_ddot = w.d[c], w.d_dot[c], w.d_ddot[c]
    off, share = distance - mail.length[link], mail.multiplier.shape[1] - 1
    if not saturated and heard[SATURATED] == 0.0:
        mail.multiplier[link, share] += dt * off
    rows[row, _RIGHT] = (
        d_ddot
        - (square - along * along) / distance
        - pull
        - 2.0 * law.alpha * (along - d_dot)
        - law.beta * law.beta * off
        - law.gamma * mail.multiplier[link, share]
    )
    rows[row, _LINK] = link


@jit
def solve_own_constraint_force(i, k, dt, tick, p, w, net, mail, saturated):
    """Constraint force of vehicle i, into w.f_C[i] [N], from the slots, distances and input force in w.

    Of other vehicles, only messages are read. With damping mu, each iterate of the law (`constraint.solve_multipliers`)
    has its own multipliers: y_n of (mbar A + mu) y_n = mbar b + mu y_(n-1).
    """
    rows, matrix, inverse, mbar = mail.rows, mail.matrix, p.vehicles.inverse, p.vehicles.mean
    iterated = p.law.solver == ITERATED
    mu, d = p.law.mu if iterated else 0.0, 0
    for l in range(net.first[i], net.first[i + 1]):
        if mail.grip[l] > 0.0:
            write_equation_of_edge(d, l, k, dt, tick, p, w, net, mail, saturated)
            d += 1
    w.f_C[i] = 0.0
    for a in range(d):
        j = net.links[int(rows[a, _LINK]), 1]
        for b in range(a):
            dot = 0.0
            for q in range(3):
                dot += rows[a, _UNIT + q] * rows[b, _UNIT + q]
            matrix[a, b] = mbar * inverse[i] * dot
        # An edge that slips gives way: without a grip it would have no force, and the others all of it.
        matrix[a, a] = (mbar * (inverse[i] + inverse[j]) + mu) / mail.grip[int(rows[a, _LINK])]
    if d == 0 or not cholesky(matrix[:d, :d]):
        # Nobody to hold on to; or, without damping, no force at this shape: the law of all edges has none either.
        if d > 0:
            w.f_C[i, 0] = math.nan
        return
    iterations = mail.multiplier.shape[1] - 1
    for n in range(iterations):
        for a in range(d):
            l = int(rows[a, _LINK])
            j, rest = net.links[l, 1], 0.0
            for q in range(3):
                x = rows[a, _UNIT + q]
                # What the neighbour's other edges do: its force without that of this edge, which pulls along -x.
                rest += x * (mail.heard[l, PULL + 3 * n + q] + mail.theirs[l, n] * x * inverse[j])
            before = rows[a, _UNKNOWN] if n > 0 else 0.0
            rows[a, _UNKNOWN] = mbar * (rows[a, _RIGHT] + rest) + mu * before
        cholesky_solve(matrix[:d, :d], rows[:d, _UNKNOWN])
        mail.pull[i, 3 * n : 3 * n + 3] = 0.0
        for a in range(d):
            l = int(rows[a, _LINK])
            mail.multiplier[l, n] = rows[a, _UNKNOWN]
            for q in range(3):
                mail.pull[i, 3 * n + q] += mail.multiplier[l, n] * rows[a, _UNIT + q] * inverse[i]
    for q in range(3):
        w.f_C[i, q] = mail.pull[i, 3 * (iterations - 1) + q] * p.vehicles.m[i]
