"""Obstacles that move: what is known of them, how vehicles fly relative to them, and the flow round them.

An obstacle is known in advance, or seen while it is within a range of any vehicle; vehicles share what they see. Places
are seen with noise, of the same size along each axis. A Kalman filter with the model of a constant velocity
(Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 2001, section 6.2.2) follows
each obstacle; its three axes share one covariance. Where a filter is not sure of the velocity yet, the obstacle counts
as unknown.

Relative to an obstacle of constant velocity, a vehicle brakes as it does relative to one that stands still: its
stop segment is that of its relative velocity. Drag, which acts against the velocity through the air, takes from the
braking what it is at the obstacle's velocity, and so does the acceleration of the obstacle that is reckoned with.
"""

import math

from rigidfleet.kernel.avoidance import FOLLOWED, KNOWN, UNKNOWN
from rigidfleet.kernel.compiler import elementwise  # noqa: F401 -- the functions of numbers below
from rigidfleet.kernel.compiler.jit import jit
from rigidfleet.kernel.segments import least_value, obstacle_distance, segment_obstacle_bounds
from rigidfleet.solids.distance import is_solid_present, solid_displacement

#: Standard deviations that bounds of an estimate have.
_SIGMAS = 3.0
#: Standard deviation of the speed of an obstacle at first sight, and below which it is known [m/s].
_FIRST, _SURE = 10.0, 0.5
#: Time that an acceleration of an obstacle is taken to last [s]; it makes white noise of it.
_LASTS = 1.0
#: Standard deviation of its place with which an obstacle out of sight is forgotten [m].
_FORGET = 1.0
#: Longest time [s] and number of times at which a miss is looked for.
_FARTHEST, _LOOKS = 3.0, 12
#: Least share of its braking that a vehicle is taken to have relative to an obstacle.
_LEAST = 0.1
#: Rate at which flow leads a vehicle's velocity [1/s], its radius over that of the obstacle with the vehicle, and the
#: least share of a velocity that it changes.
_FLOW_RATE, _WIDER, _WEAK = 4.0, 1.2, 1e-3


# -- what is known -------------------------------------------------------------------------------------


@jit
def predict_track(o, T, sight):
    """Predict the track of obstacle o by T [s]: constant velocity, with white noise of its acceleration."""
    x, P = sight.track[o], sight.spread[o]
    q = sight.swerve * sight.swerve * _LASTS  # density of the noise [m^2/s^3]
    for axis in range(3):
        x[axis] += T * x[3 + axis]
    P[0] += T * (2.0 * P[1] + T * (P[2] + q * T / 3.0))
    P[1] += T * (P[2] + 0.5 * q * T)
    P[2] += q * T


@jit
def correct_track(o, z, sight):
    """Correct the track of obstacle o by a measured displacement z (3,) [m]."""
    x, P = sight.track[o], sight.spread[o]
    total = P[0] + sight.noise * sight.noise
    near, fast = P[0] / total, P[1] / total
    for axis in range(3):
        wrong = z[axis] - x[axis]
        x[axis] += near * wrong
        x[3 + axis] += fast * wrong
    P[2] -= fast * P[1]
    P[1] *= 1.0 - near
    P[0] *= 1.0 - near


@jit
def obstacle_velocity(t, o, solids):
    """Velocity [m/s] of obstacle o at t [s], free of the rounding that differences of places would have."""
    for k in range(solids.first[o, 3], solids.last[o, 3] - 1):
        if solids.times[k] <= t < solids.times[k + 1]:
            span = solids.times[k + 1] - solids.times[k]
            x, y = solids.ways[k], solids.ways[k + 1]
            return (y[0] - x[0]) / span, (y[1] - x[1]) / span, (y[2] - x[2]) / span
    return 0.0, 0.0, 0.0


@jit
def is_in_sight(o, dx, dy, dz, r, lost, avoid):
    """Whether any vehicle is within sensing range of obstacle o, displaced by dx, dy, dz [m]."""
    solids, reach = avoid.solids, avoid.sight.reach
    for i in range(r.shape[0]):
        u, v, w = r[i, 0] - dx, r[i, 1] - dy, r[i, 2] - dz
        if not lost[i] and obstacle_distance(u, v, w, o, solids, avoid.normal) <= reach:
            return True
    return False


@jit
def track_obstacle(o, tick, dx, dy, dz, u, v, w, avoid):
    """Take a measurement of obstacle o at a tick, displaced by dx, dy, dz [m] with the velocity u, v, w [m/s]."""
    s = avoid.sight
    track, spread, seen = s.track[o], s.spread[o], avoid.shifted[0]
    seen[0], seen[1], seen[2] = dx, dy, dz
    if s.noise == 0.0:
        track[0], track[1], track[2], track[3], track[4], track[5] = dx, dy, dz, u, v, w
        spread[0], spread[1], spread[2] = 0.0, 0.0, 0.0
        return
    for axis in range(3):
        at = (3 * (tick * s.moves.shape[0] + o) + axis) % s.normals.shape[0]
        seen[axis] += s.noise * s.normals[at]
    if s.known[o] == UNKNOWN:
        for axis in range(3):
            track[axis], track[3 + axis] = seen[axis], 0.0
        spread[0], spread[1], spread[2] = s.noise * s.noise, 0.0, _FIRST * _FIRST
    else:
        correct_track(o, seen, s)


@jit
def update_tracks(t, r, lost, avoid):
    """Bring what is known of all obstacles that move to t [s], with vehicles at r (N, 3)."""
    s, T = avoid.sight, avoid.period
    k = int(t / T + 0.5)
    for o in range(s.moves.shape[0]):
        if s.moves[o] == 0:
            continue
        if not is_solid_present(t, o, avoid.solids):
            s.known[o] = UNKNOWN
            continue
        x, y, z = solid_displacement(t, o, avoid.solids)
        u, v, w = obstacle_velocity(t + 0.5 * T, o, avoid.solids)
        if s.known[o] != UNKNOWN:
            predict_track(o, T, s)
        if not s.reach < math.inf or is_in_sight(o, x, y, z, r, lost, avoid):
            track_obstacle(o, k, x, y, z, u, v, w, avoid)
            s.known[o] = FOLLOWED
        if s.known[o] == UNKNOWN:
            continue
        place, speed = math.sqrt(s.spread[o, 0]), math.sqrt(s.spread[o, 2])
        s.bound[o, 0], s.bound[o, 1] = _SIGMAS * place, _SIGMAS * speed
        s.known[o] = KNOWN if speed <= _SURE else FOLLOWED
        if place > _FORGET:
            s.known[o] = UNKNOWN


# -- relative motion -----------------------------------------------------------------------------------


@jit
def is_obstacle_known(o, avoid):
    """Whether obstacle o stands still, or moves and is known."""
    return avoid.sight.moves[o] == 0 or avoid.sight.known[o] == KNOWN


@jit
def relative_braking_limit(i, o, avoid):
    """Acceleration [m/s^2] with which vehicle i can always brake relative to obstacle o, which moves."""
    x = avoid.sight.track[o]
    speed = math.sqrt(x[3] * x[3] + x[4] * x[4] + x[5] * x[5])
    drag = (1.0 - avoid.coast[i, 0]) / avoid.coast[i, 1]
    return max(avoid.b[i] - drag * speed - avoid.sight.swerve, _LEAST * avoid.b[i])


@jit
def write_braking_relative_to_obstacle(i, o, v, avoid, out):
    """Acceleration (3,) that brakes vehicle i from a velocity v (3,) relative to obstacle o, straight, with drag.

    It bears the drag that the vehicle has at the obstacle's velocity, so that what is left acts on the relative one.
    """
    x, E, first = avoid.sight.track[o], avoid.coast[i, 0], avoid.coast[i, 1]
    speed = 0.0
    for q in range(3):
        speed += (v[q] - x[3 + q]) ** 2
    speed = math.sqrt(speed)
    size = min(relative_braking_limit(i, o, avoid), speed * E / first) / max(speed, 1e-12)
    for q in range(3):
        out[q] = (1.0 - E) / first * x[3 + q] - size * (v[q] - x[3 + q])


@jit
def way_to_rest(u, b, lag, period):
    """Way [m] to rest from a speed u [m/s], with commands held for a period: n whole ones, then one to rest."""
    change = b * period
    # A command holds for a whole period, so that the last one brakes by less: the way is a little more than u^2 / 2b.
    n = math.floor(u / change)
    rest = u - n * change
    return period * (n * (u - 0.5 * n * change) + 0.5 * rest) + lag * u


@jit
def write_stop_relative_to_obstacle(i, o, r, v, avoid):
    """Write the relative stop segment of vehicle i to ``shifted`` 0 and 2; returns its length and relative speed."""
    x, out = avoid.sight.track[o], avoid.shifted
    speed = 0.0
    for q in range(3):
        out[0, q], out[3, q] = r[q] - x[q] - avoid.lead[i, q] * x[3 + q], v[q] - x[3 + q]
        speed += out[3, q] * out[3, q]
    speed = math.sqrt(speed)
    stop = way_to_rest(speed, relative_braking_limit(i, o, avoid), avoid.lag[i], avoid.period)
    for q in range(3):
        out[2, q] = out[0, q] + stop / max(speed, 1e-12) * out[3, q]
    return stop, speed


@jit
def moving_obstacle_margin(i, v, avoid):
    """By how much the candidate of vehicle i keeps its distances from obstacles that move [m]; infinite if it is far.

    The candidate is ``trial``, the velocity before it v (3,).
    """
    way, out, T, normal, room = avoid.trial, avoid.shifted, avoid.period, avoid.normal, math.inf
    E, first, solids = avoid.coast[i, 0], avoid.coast[i, 1], avoid.solids
    for o in range(avoid.sight.moves.shape[0]):
        if avoid.sight.moves[o] == 0 or avoid.sight.known[o] != KNOWN:
            continue
        x, floor = avoid.sight.track[o], avoid.walls[i, o]
        before = after = rise = 0.0
        for q in range(3):
            end = v[q] * E + way[3, q] * first - x[3 + q]
            out[0, q] = way[0, q] - x[q] - avoid.lead[i, q] * x[3 + q]
            out[1, q] = way[1, q] - x[q] - (avoid.lead[i, q] + T) * x[3 + q]
            out[2, q], out[3, q] = end, v[q] - x[3 + q]
            before += out[3, q] * out[3, q]
            after += end * end
            rise += way[4, q] * way[4, q]
        before, after = math.sqrt(before), math.sqrt(after)
        stop = way_to_rest(after, relative_braking_limit(i, o, avoid), avoid.lag[i], T)
        far = T * (before + 0.5 * T * math.sqrt(rise)) + stop
        if obstacle_distance(out[0, 0], out[0, 1], out[0, 2], o, solids, normal) - far >= floor:
            continue
        # Three distances: of the stop segment after the tick, of the chord of the tick, and of the parabola beyond it.
        for q in range(3):
            out[2, q] = out[1, q] + stop / max(after, 1e-12) * out[2, q]
        bound, value, _ = segment_obstacle_bounds(out[1], out[2], o, solids, floor, normal)
        room = min(room, (value if value < floor else bound) - floor)
        bound, value, share = segment_obstacle_bounds(out[0], out[1], o, solids, floor, normal)
        room = min(room, (value if value < floor else bound) - floor)
        along = rate = lift = 0.0
        for q in range(3):
            along += normal[q] * (out[1, q] - out[0, q])
            rate += normal[q] * out[3, q]
            lift += normal[q] * way[4, q]
        room = min(room, least_value(value - share * along, rate, min(lift, lift * E), T) - floor)
    return room


@jit
def miss_distance(r, v, accel, avoid):
    """By how much a vehicle at r with v (3,) misses all obstacles that move [m], if it holds an acceleration (3,).

    That is the least distance of its centre at some times, up to twice that of the nearest approach without it.
    """
    least = math.inf
    for o in range(avoid.sight.moves.shape[0]):
        if avoid.sight.moves[o] == 0 or avoid.sight.known[o] != KNOWN:
            continue
        x, w = avoid.sight.track[o], avoid.shifted[3]
        nearing = fast = 0.0
        for q in range(3):
            w[q] = v[q] - x[3 + q]
            nearing -= (r[q] - x[q] - avoid.sight.centre[o, q]) * w[q]
            fast += w[q] * w[q]
        until = min(2.0 * nearing / max(fast, 1e-12), _FARTHEST)
        for k in range(1, _LOOKS + 1):
            t = max(until, avoid.period) * k / _LOOKS
            away = obstacle_distance(
                r[0] - x[0] + t * (w[0] + 0.5 * t * accel[0]), r[1] - x[1] + t * (w[1] + 0.5 * t * accel[1]),
                r[2] - x[2] + t * (w[2] + 0.5 * t * accel[2]), o, avoid.solids, avoid.normal,
            )  # fmt: skip
            least = min(least, away)
    return least


# -- flow ----------------------------------------------------------------------------------------------


@jit
def steer_round_obstacles(i, r, v, avoid):
    """Lead what vehicle i is asked for round obstacles, as a flow round balls leads a fluid; whether it does.

    The law asks for a velocity V = v + a / rate. With the obstacle's velocity w, the stream U = V - w that meets a
    ball of radius R has at a distance q from its middle, in the direction n, the velocity of a doublet in it:
    U + (R / q)^3 / 2 (U - 3 (U . n) n) (Lamb, *Hydrodynamics*, section 92). R is that of a ball round the obstacle,
    with the vehicle, and a fifth more; nearer than R, q is R.
    """
    s, turned, normal, ask = avoid.sight, False, avoid.normal, avoid.shifted[0]
    for q in range(3):
        ask[q] = v[q] + avoid.wanted[i, q] / _FLOW_RATE
    for o in range(s.moves.shape[0]):
        if not (s.ball[o] < math.inf and is_obstacle_known(o, avoid)):
            continue
        x = s.track[o]
        away = obstacle_distance(r[0] - x[0], r[1] - x[1], r[2] - x[2], o, avoid.solids, normal)
        size = _WIDER * (s.ball[o] + avoid.reach[i] + avoid.spare[i])
        share = 0.5 * (size / max(away + s.ball[o], size)) ** 3
        if share < _WEAK:
            continue
        along = 0.0
        for q in range(3):
            along += (ask[q] - x[3 + q]) * normal[q]
        for q in range(3):
            turn = share * (ask[q] - x[3 + q] - 3.0 * along * normal[q])
            avoid.wanted[i, q] += _FLOW_RATE * turn
        turned = True
    return turned
