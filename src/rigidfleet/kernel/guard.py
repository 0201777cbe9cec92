"""The guard: accepts, replaces or refuses the acceleration of each vehicle, so that all can always brake in time.

Vehicle i brakes with b_i, and its stop segment S_i reaches from r_i to where it then comes to rest. The states with
dist(S_i, S_j) >= D_ij and dist(S_i, O) >= R_i for all pairs and obstacles form a set C. If all brake, every S_i only
shrinks, so that C is never left, whatever the number of vehicles. At a tick, all are first taken to brake. One vehicle
after the other then takes what it wants, if its motion over the tick and its stop segment after it keep their distances
from what the others do at present; else the nearest of some fixed accelerations that does; else it brakes. The proof is
in docs/avoidance.md.

A quadrotor is led by a point ahead of it that obeys at once (`move_to_lag_free_point`), and keeps its distances with
the hull of this point, its stop point and what comes behind: while it brakes, this hull only shrinks, too.

Vehicles or obstacles that are nearer than they should be must not come nearer still.

Beside an obstacle that moves, the stop segment is that of the relative velocity: braking relative to it keeps it, and
is one of the candidates. This is braking to rest for no other, so that the proof holds for none of these.
"""

import math

from rigidfleet.kernel.avoidance import (
    ACTS,
    BARRIER,
    BRAKE,
    FULL,
    GUARD,
    LISTED,
    OBSTACLE,
    PAIR,
    TICKS,
)
from rigidfleet.kernel.barriers import filter_accelerations, limit_thrust, weaken_edge_forces
from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.fleet import TICKS as FLIGHT_TICKS
from rigidfleet.kernel.fleet import thrust_of
from rigidfleet.kernel.moving import (
    braking_relative_to_obstacle,
    is_obstacle_known,
    margin_to_moving_obstacles,
    miss_distance,
    relative_braking_limit,
    required_obstacle_distance,
    steer_round_obstacles,
    update_tracks,
    way_to_rest,
    write_stop_relative_to_obstacle,
)
from rigidfleet.kernel.rigid_body import attitude_matrix
from rigidfleet.kernel.sampled_flight import write_measured_states
from rigidfleet.kernel.segments import (
    hull_gap,
    obstacle_distance,
    parabola_min,
    refined_obstacle_distance,
    segment_distance,
    segment_obstacle_distance,
)

#: Neighbours are listed for speeds higher by this share and summand [m/s], and for ways of this share of their
#: distance, or this way [m].
_FASTER, _LEAST_SPEED, _NEARER, _LEAST_WAY = 0.25, 0.2, 0.15, 0.2
#: Shortfall of a distance from which a vehicle evades what moves as well as it can, and that counts as rounding [m].
_LATE, _ROUNDING = 0.05, 1e-9

_curve = jit_inline(thrust_of)


# -- what a vehicle does -------------------------------------------------------------------------------


@jit
def stop_distance(speed, i, a):
    """Way [m] of vehicle i to rest from a speed [m/s]."""
    return way_to_rest(speed, a.b[i], a.lag[i], a.period)


@jit
def predict_motion(i, r, v, c, a, out):
    """Motion of vehicle i from r, v (3,) under an acceleration c (3,) held for a tick; see `AvoidanceArrays.trial`.

    Returns the distance from r that it cannot leave in the tick, and by braking after it.
    """
    E, first, second = a.coast[i, 0], a.coast[i, 1], a.coast[i, 2]
    drag = (1.0 - E) / first
    speed = end = rise = 0.0
    for q in range(3):
        after = v[q] * E + c[q] * first
        out[0, q], out[1, q], out[2, q] = r[q], r[q] + v[q] * first + c[q] * second, after
        out[3, q], out[4, q] = c[q], c[q] - drag * v[q]
        speed += v[q] * v[q]
        end += after * after
        rise += out[4, q] * out[4, q]
    speed, end = math.sqrt(speed), math.sqrt(end)
    stop = stop_distance(end, i, a)
    for q in range(3):
        out[2, q] = out[1, q] + stop / max(end, 1e-12) * out[2, q]
    return max(a.behind[i], a.period * (speed + 0.5 * a.period * math.sqrt(rise)) + stop)


@jit
def braking_acceleration(i, v, a, out):
    """Acceleration (3,) that brakes vehicle i from a velocity v (3,): by b, or to rest within the tick, with drag."""
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    most = a.b[i] * speed / max(speed + a.soft[i], 1e-12) if a.soft[i] > 0.0 else a.b[i]
    size = min(most, speed * a.coast[i, 0] / a.coast[i, 1]) / max(speed, 1e-12)
    for q in range(3):
        out[q] = -size * v[q]


@jit
def store_candidate(i, far, a):
    """Make the candidate ``trial`` the present choice of vehicle i."""
    trial = a.trial
    a.far[i] = far
    for q in range(3):
        for k in range(3):
            a.ways[i, k, q] = trial[k, q]
        a.chosen[i, q], a.rise[i, q] = trial[3, q], trial[4, q]


@jit
def is_apart(i, v_i, j, v_j, floor, a):
    """Whether the candidate of vehicle i keeps its distance from the present choice of j; velocities v_i and v_j (3,).

    The relative path over the tick lies beyond the parabola of its part along any unit vector. The vector is that to
    the nearest point of the chord.
    """
    mine, other, rise = a.trial, a.ways[j], a.rise[j]
    if a.soft[i] + a.soft[j] > 0.0:  # quadrotors, by their hulls
        return hull_gap(mine, 2, a.ways[i, 4:], other, 2, other[4:], floor, a.normal) >= floor
    # After the tick: from then on both may brake, and their stop segments only shrink.
    if segment_distance(mine[1], mine[2], other[1], other[2]) < floor:
        return False
    # During the tick: the chord of the relative path, and how far the path may be from it.
    x, y, z = mine[0, 0] - other[0, 0], mine[0, 1] - other[0, 1], mine[0, 2] - other[0, 2]
    chord_x = mine[1, 0] - other[1, 0] - x
    chord_y = mine[1, 1] - other[1, 1] - y
    chord_z = mine[1, 2] - other[1, 2] - z
    length, share = chord_x * chord_x + chord_y * chord_y + chord_z * chord_z, 0.0
    if length > 0.0:
        share = min(max(-(x * chord_x + y * chord_y + z * chord_z) / length, 0.0), 1.0)
    n0, n1, n2 = x + share * chord_x, y + share * chord_y, z + share * chord_z
    size = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if size < floor or size == 0.0:
        return size >= floor
    n0, n1, n2 = n0 / size, n1 / size, n2 / size
    along = n0 * x + n1 * y + n2 * z
    rate = n0 * (v_i[0] - v_j[0]) + n1 * (v_i[1] - v_j[1]) + n2 * (v_i[2] - v_j[2])
    own = n0 * mine[4, 0] + n1 * mine[4, 1] + n2 * mine[4, 2]
    theirs = n0 * rise[0] + n1 * rise[1] + n2 * rise[2]
    # Drag lets accelerations decay during the tick
    least = min(own, own * a.coast[i, 0]) - max(theirs, theirs * a.coast[j, 0])
    return parabola_min(along, rate, least, a.period) >= floor


@jit
def clears_static_obstacles(i, v, far, a):
    """Whether the candidate of vehicle i, with a velocity v (3,), keeps its distances from obstacles at rest."""
    way, normal = a.trial, a.normal
    for o in range(a.solids.kind.shape[0]):
        if a.sight.moves[o] != 0:
            continue
        floor = a.walls[i, o]
        # Farther away than it can come: most obstacles take one distance.
        if obstacle_distance(way[0, 0], way[0, 1], way[0, 2], o, a.solids, normal) - far >= floor:
            continue
        # Its stop segment after the tick, then its path over the tick as in `is_apart`: a parabola beyond the chord.
        after = a.ways[i, 4] if a.soft[i] > 0.0 else way[1]
        bound, _, _ = segment_obstacle_distance(after, way[2], o, a.solids, floor, normal)
        if bound < floor:
            return False
        bound, value, x = segment_obstacle_distance(way[0], way[1], o, a.solids, floor, normal)
        if bound < floor:
            return False
        along = rate = rise = 0.0
        for q in range(3):
            along += normal[q] * (way[1, q] - way[0, q])
            rate += normal[q] * v[q]
            rise += normal[q] * way[4, q]
        rise = min(rise, rise * a.coast[i, 0])
        if parabola_min(value - x * along, rate, rise, a.period) < floor:
            return False
    return True


# -- neighbours ----------------------------------------------------------------------------------------


@jit
def interaction_range(u, accel, a):
    """Distance [m] beyond which vehicles with speeds up to u [m/s] neither meet by the next tick nor meet a barrier.

    A barrier asks for nothing while rate h + B s/sqrt(2 B (L - D)) is above the greatest relative acceleration, twice
    that asked for, ``accel`` [m/s^2]; s is at least -2 u.
    """
    room = stop = strongest = lift = lag = behind = soft = 0.0
    weakest = math.inf
    for i in range(a.b.shape[0]):
        room, lag = max(room, a.room[i] + a.spare[i]), max(lag, a.lag[i])
        behind, soft = max(behind, a.lead[i, 0] * u), max(soft, a.soft[i])
        stop, lift = max(stop, stop_distance(u, i, a)), max(lift, a.lift[i])
        weakest, strongest = min(weakest, a.b[i]), max(strongest, a.b[i])
    meet = 2.0 * (stop + a.period * (u + a.period * (lift + a.g)))
    barrier = 0.0
    if a.filtered:
        half, B = a.rate * (u + a.share * soft) + accel, 2.0 * a.share * strongest
        root = (half + math.sqrt(half * half + 2.0 * a.rate * B * u)) / a.rate
        barrier = root * root / (4.0 * a.share * weakest) + 2.0 * u * lag
    return 2.0 * (room + behind) + max(meet, barrier)


@jit
def list_neighbours(r, lost, way, a):
    """List for each vehicle those within a distance ``way`` [m]; returns False if the list is too short."""
    # By sweep and prune: along the axis in which the fleet is widest, only those within ``way`` are compared.
    n, order = a.b.shape[0], a.order
    axis, widest = 0, -1.0
    for q in range(3):
        low = high = r[0, q]
        for i in range(n):
            low, high = min(low, r[i, q]), max(high, r[i, q])
        if high - low > widest:
            axis, widest = q, high - low
    for k in range(1, n):  # by insertion: mostly sorted from the time before
        i, at = order[k], k
        while at > 0 and r[order[at - 1], axis] > r[i, axis]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = i
    for i in range(n + 1):
        a.start[i] = 0
    # First to count, so that each list begins where the one before ends; then to write.
    for fill in range(2):
        for k in range(n):
            i = order[k]
            for l in range(k + 1, n):
                j = order[l]
                x = r[j, axis] - r[i, axis]
                if x > way:
                    break
                x, y, z = r[j, 0] - r[i, 0], r[j, 1] - r[i, 1], r[j, 2] - r[i, 2]
                if x * x + y * y + z * z > way * way or lost[i] or lost[j]:
                    continue
                if fill:
                    a.near[a.start[i]], a.near[a.start[j]] = j, i
                a.start[i] += 1
                a.start[j] += 1
        if fill == 0:
            total = 0
            for i in range(n):
                total += a.start[i]
                a.start[i] = total - a.start[i]
            a.start[n] = total
            if total > a.near.shape[0]:
                return False
    for i in range(n, 0, -1):  # each entry has moved to the start of the next vehicle
        a.start[i] = a.start[i - 1]
    a.start[0] = 0
    return True


@jit
def greatest_row_norm(x):
    """Greatest length of the rows of x (N, 3)."""
    longest = 0.0
    for i in range(x.shape[0]):
        longest = max(longest, x[i, 0] * x[i, 0] + x[i, 1] * x[i, 1] + x[i, 2] * x[i, 2])
    return math.sqrt(longest)


@jit
def greatest_move_since_listing(r, a):
    """Greatest way [m] of a vehicle since neighbours were listed, beside the way that all have gone."""
    # What all have gone together changes no distance: a fleet that travels keeps its lists.
    n, farthest = a.b.shape[0], 0.0
    mean_x, mean_y, mean_z = 0.0, 0.0, 0.0
    for i in range(n):
        mean_x += (r[i, 0] - a.listed[i, 0]) / n
        mean_y += (r[i, 1] - a.listed[i, 1]) / n
        mean_z += (r[i, 2] - a.listed[i, 2]) / n
    for i in range(n):
        x = r[i, 0] - a.listed[i, 0] - mean_x
        y = r[i, 1] - a.listed[i, 1] - mean_y
        z = r[i, 2] - a.listed[i, 2] - mean_z
        farthest = max(farthest, x * x + y * y + z * z)
    return math.sqrt(farthest)


@jit
def update_neighbours(r, v, lost, a):
    """Renew the list of neighbours if others could have come near; returns False if it is too short."""
    fastest, hardest = greatest_row_norm(v), greatest_row_norm(a.wanted)
    due = a.count[LISTED] == 0 or fastest > a.span[1] or hardest > a.span[2]
    # Nor for speeds far below those for which it was made
    due = due or 2.5 * fastest + _LEAST_SPEED < 0.8 * a.span[1]
    if not (due or 2.0 * greatest_move_since_listing(r, a) > a.span[0]):
        return True
    speed, hard = (1.0 + _FASTER) * fastest + _LEAST_SPEED, (1.0 + _FASTER) * hardest + 1.0
    way = interaction_range(speed, hard, a)
    a.span[0], a.span[1], a.span[2] = max(_NEARER * way, _LEAST_WAY), speed, hard
    for i in range(a.b.shape[0]):
        for q in range(3):
            a.listed[i, q] = r[i, q]
    a.count[LISTED], a.last[:] = 1, 0.0
    return list_neighbours(r, lost, way + a.span[0], a)


# -- the tick ------------------------------------------------------------------------------------------


@jit
def note_margin(kind, value, t, i, j, a):
    """Note a margin [m] of vehicle i to j, or to obstacle j, if it is the least so far, or the first negative one."""
    if value < a.margin[kind, 0]:
        a.margin[kind, 0], a.margin[kind, 1] = value, t
        a.between[kind, 0], a.between[kind, 1] = i, j
    if value < -_ROUNDING and not a.lost[kind, 0] < math.inf:
        a.lost[kind, 0], a.lost[kind, 1] = t, value
        a.loser[kind, 0], a.loser[kind, 1] = i, j


@jit
def is_alone(i, a):
    """Whether vehicle i has neither neighbours nor obstacles."""
    return a.start[i + 1] == a.start[i] and a.solids.kind.shape[0] == 0


@jit
def set_obstacle_distance_to_keep(t, i, o, r, v, closest, a):
    """Find the distance that the relative stop segment of vehicle i keeps from obstacle o, which moves.

    Returns the least by which such a segment exceeds what it needs so far, at most 0; `threat` is its obstacle.
    """
    if not is_obstacle_known(o, a):
        return closest
    stop, speed = write_stop_relative_to_obstacle(i, o, r, v, a)
    need, way = (
        required_obstacle_distance(i, o, speed, relative_braking_limit(i, o, a), a),
        a.shifted,
    )
    apart = obstacle_distance(way[0, 0], way[0, 1], way[0, 2], o, a.solids, a.normal) - stop
    a.walls[i, o] = need
    if a.threat[i] < 0:  # also one that is still far: a single tick may bring it near
        a.threat[i] = o
    if apart < need or apart - need < a.margin[OBSTACLE, 0]:
        # Rounding alone must not make the bound a loose one: the vehicle could lose a little at each tick
        enough = need - 10.0 * _ROUNDING
        kept = refined_obstacle_distance(way[0], way[2], o, a.solids, enough, a.normal)
        a.walls[i, o] = min(need, kept)
        note_margin(OBSTACLE, kept - a.reach[i], t, i, o, a)
        if kept - need < closest or (apart < need and closest == 0.0):
            a.threat[i], closest = o, min(kept - need, 0.0)
    return closest


@jit
def brake_and_set_distances(t, r, v, lost, a):
    """Let all vehicles brake, and find the distances that their stop segments keep, as they should or as they do."""
    n, acceleration = a.b.shape[0], a.trial[3]
    for i in range(n):
        if is_alone(i, a):
            continue
        braking_acceleration(i, v[i], a, acceleration)
        speed = math.sqrt(v[i, 0] ** 2 + v[i, 1] ** 2 + v[i, 2] ** 2)
        stop = stop_distance(speed, i, a)
        for q in range(3):
            a.ways[i, 3, q] = r[i, q] + stop / max(speed, 1e-12) * v[i, q]
        # It stays on the stop segment, also after the tick
        store_candidate(i, max(predict_motion(i, r[i], v[i], acceleration, a, a.trial), stop), a)
    # A vehicle that is nearer than it should be keeps what it has: a floor that nobody meets would stop all.
    for i in range(n):
        if lost[i]:
            continue
        for e in range(a.start[i], a.start[i + 1]):
            j = a.near[e]
            need = a.room[i] + a.room[j] + a.spare[i] + a.spare[j]
            x, y, z = r[i, 0] - r[j, 0], r[i, 1] - r[j, 1], r[i, 2] - r[j, 2]
            apart = math.sqrt(x * x + y * y + z * z) - a.far[i] - a.far[j]
            a.floor[e] = need
            if apart < need or apart - need < a.margin[PAIR, 0]:
                if a.soft[i] + a.soft[j] > 0.0:
                    mine, other = a.ways[i], a.ways[j]
                    kept = hull_gap(mine, 3, mine[4:], other, 3, other[4:], math.nan, a.normal)
                else:
                    kept = segment_distance(r[i], a.ways[i, 3], r[j], a.ways[j, 3])
                a.floor[e] = min(need, kept)
                if i < j:
                    note_margin(PAIR, kept - a.room[i] - a.room[j], t, i, j, a)
        a.threat[i], a.late[i], closest = -1, 0.0, 0.0
        for o in range(a.solids.kind.shape[0]):
            if a.sight.moves[o] != 0:
                closest = set_obstacle_distance_to_keep(t, i, o, r[i], v[i], closest, a)
                a.late[i] = closest
                continue
            need = a.reach[i] + a.spare[i]
            apart = obstacle_distance(r[i, 0], r[i, 1], r[i, 2], o, a.solids, a.normal) - a.far[i]
            a.walls[i, o] = need
            if apart < need or apart - need < a.margin[OBSTACLE, 0]:
                way = a.ways[i]
                kept = refined_obstacle_distance(way[4], way[3], o, a.solids, need, a.normal)
                a.walls[i, o] = min(need, kept)
                note_margin(OBSTACLE, kept - a.reach[i], t, i, o, a)


@jit
def is_safe(i, r, v, far, a):
    """Whether the candidate of vehicle i is compatible with the present choices of all others and with obstacles."""
    for e in range(a.start[i], a.start[i + 1]):
        j = a.near[e]
        x, y, z = r[i, 0] - r[j, 0], r[i, 1] - r[j, 1], r[i, 2] - r[j, 2]
        reach = a.floor[e] + far + a.far[j]
        if x * x + y * y + z * z < reach * reach and not is_apart(i, v[i], j, v[j], a.floor[e], a):
            return False
    return clears_static_obstacles(i, v[i], far, a)


@jit
def is_barrier_active(i, a):
    """Whether barriers push vehicle i."""
    push = a.known[2, i]
    return push[0] * push[0] + push[1] * push[1] + push[2] * push[2] > 0.0


@jit
def propose_acceleration(i, k, v, a, c):
    """Candidate k of vehicle i into c (3,): what it wants, fixed ones, then braking relative to its threat."""
    last = a.candidates.shape[0] + 1
    if k == 0:
        c[0], c[1], c[2] = a.wanted[i, 0], a.wanted[i, 1], a.wanted[i, 2]
        if a.soft[i] > 0.0 and a.overruled[i] == 0 and not is_barrier_active(i, a):
            for q in range(3):
                c[q] = lag_compensating_choice(i, q, a)
    elif k < last:
        for q in range(3):
            c[q] = a.b[i] * a.candidates[k - 1, q]
    else:
        braking_relative_to_obstacle(i, a.threat[i], v, a, c)


@jit
def least_margin_if_braking(i, r, v, too_late, a):
    """What `choose_acceleration` compares of vehicle i, if it brakes [m]."""
    c = a.trial[3]
    braking_acceleration(i, v[i], a, c)
    if too_late:
        return miss_distance(r[i], v[i], c, a)
    predict_motion(i, r[i], v[i], c, a, a.trial)
    return margin_to_moving_obstacles(i, v[i], a)


@jit
def choose_acceleration(i, r, v, a):
    """Choose for vehicle i: what it wants, else the nearest safe candidate, else braking; returns which.

    0 means what it wants, 1 a candidate, 2 braking. Obstacles that move can leave no safe candidate and make braking
    unsafe, too: then the one counts that keeps all else and has the most room beside them. Where a vehicle could
    not brake in time any more, the one counts that misses them most, held.
    """
    wanted, c, best, nearest = a.wanted[i], a.trial[3], math.inf, -1
    most, second = -math.inf, -1
    late = a.threat[i] >= 0 and a.late[i] < -_LATE
    for k in range(a.candidates.shape[0] + (2 if a.threat[i] >= 0 else 1)):
        propose_acceleration(i, k, v[i], a, c)
        away = 0.0
        for q in range(3):
            away += (c[q] - wanted[q]) ** 2
        if away >= best:  # before it is tried: distances cost far more
            continue
        far = predict_motion(i, r[i], v[i], c, a, a.trial)
        if not is_safe(i, r, v, far, a):
            continue
        room = miss_distance(r[i], v[i], c, a) if late else margin_to_moving_obstacles(i, v[i], a)
        if late or room < 0.0:
            if room > most:
                most, second = room, k
            continue
        best, nearest = away, k
        if k == 0:
            store_candidate(i, far, a)
            return 0
    if nearest < 0:
        if second < 0 or least_margin_if_braking(i, r, v, late, a) >= most:
            return 2
        nearest = second
    propose_acceleration(i, nearest, v[i], a, c)
    store_candidate(i, predict_motion(i, r[i], v[i], c, a, a.trial), a)
    return 1


@jit
def count_action(kind, i, t, a):
    """Count that a layer has acted on vehicle i at this tick."""
    a.acted[kind, i] += 1
    a.first[kind, i] = min(a.first[kind, i], t)


@jit
def command_force(i, state, a):
    """Give vehicle i the force of the acceleration chosen for it; a quadrotor's follows it with a lag."""
    c, u = a.chosen[i], a.commanded[i]
    for q in range(3):
        u[q] = c[q] - a.ahead[i, q, 2] / (a.period + a.ahead[i, q, 2]) * (c[q] - u[q])
        state.force[i, q] = a.weight[i] * (u[q] + (a.g if q == 2 else 0.0))


@jit
def wanted_acceleration(i, state, a):
    """The acceleration that vehicle i is asked for, with its thrust limited."""
    force = state.force[i]
    size = math.sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2])
    share = min(1.0, a.lift[i] * a.weight[i] / max(size, 1e-300))
    for q in range(3):
        a.wanted[i, q] = share * force[q] / a.weight[i] - (a.g if q == 2 else 0.0)
    if a.soft[i] > 0.0:
        limit_thrust(i, a)
        off = 0.0
        for q in range(3):
            a.requested[i, q] = a.wanted[i, q]
            if not a.commanded[i, q] < math.inf:
                a.commanded[i, q] = a.requested[i, q]
            a.wanted[i, q] = lag_compensating_choice(i, q, a)
        limit_thrust(i, a)
        for q in range(3):
            off = max(off, abs(a.wanted[i, q] - lag_compensating_choice(i, q, a)))
        if off < _ROUNDING:
            a.overruled[i] = 0


@jit
def lag_compensating_choice(i, q, a):
    """The choice, along axis q, that has vehicle i follow what it is asked for at once."""
    return a.commanded[i, q] + (1.0 + a.ahead[i, q, 2] / a.period) * (
        a.requested[i, q] - a.commanded[i, q]
    )


@jit
def move_to_lag_free_point(i, vehicles, state, r, v, a):
    """Lead r and v (3,) of vehicle i to the point that obeys the guard at once; keeps the points behind it.

    From a command u to the acceleration, attitude and motors act as u = a + a1 da/dt + a2 d2a/dt2 + ..., so that
    x = r + a1 v + a2 a + ... has the second derivative u. Commands follow the guard's choice c with the lag s, so that
    x + s dx/dt (and a part of a period) has the second derivative c.
    """
    T, S, away = state.work.T, state.S[i], 0.0
    attitude_matrix(S[6:10], T)
    lift, k = 0.0, vehicles.thrust[i]
    for j in range(4):
        lift += _curve(S[13 + j], k[0], k[1], k[2]) / a.weight[i]
    for q in range(3):
        a1, a2, late, u = a.ahead[i, q, 0], a.ahead[i, q, 1], a.ahead[i, q, 2], a.commanded[i, q]
        rise = lift * T[2, q] - (a.g if q == 2 else 0.0)
        a.ways[i, 4, q] = r[q]
        a.ways[i, 5, q] = r[q] + a1 * v[q] + a2 * rise
        v[q] += a1 * rise + a2 * lift * (S[11] * T[0, q] - S[10] * T[1, q])
        r[q] = a.ways[i, 5, q] + late * (v[q] - 0.5 * a.period * u)
        v[q] += late * u
        away += (r[q] - a.ways[i, 4, q]) ** 2
    a.behind[i] = math.sqrt(away)


@jit
def correct_forces(p, w, flight, state, a):
    """Filter and guard the forces that the formation's law has just given; returns 0 if neighbours are too many."""
    n, lost, t = a.b.shape[0], flight.vehicles.lost, state.work.law_time[0]
    r, v, k = a.known[0], a.known[1], state.count[FLIGHT_TICKS]
    if a.filtered:
        weaken_edge_forces(p, w, state, a)
    write_measured_states(k, r, v, flight, state)
    for i in range(n):
        wanted_acceleration(i, state, a)
        if a.soft[i] > 0.0:
            move_to_lag_free_point(i, flight.vehicles, state, r[i], v[i], a)
        else:
            for q in range(3):
                a.ways[i, 4, q] = a.ways[i, 5, q] = r[i, q]
        state.layers[i] = 0
    update_tracks(t, a.ways[:, 4], lost, a)
    flows = False
    if a.flow:
        for i in range(n):
            if steer_round_obstacles(i, r[i], v[i], a):
                limit_thrust(i, a)
                flows = True
    if not update_neighbours(r, v, lost, a):
        a.count[FULL] = 1
        return 0
    a.count[TICKS] += 1
    brake_and_set_distances(t, r, v, lost, a)
    changed = a.filtered and filter_accelerations(t, r, v, lost, p, w, a)
    for k in range(n):
        i = (k + a.count[TICKS]) % n  # each comes first in turn
        if changed and is_barrier_active(i, a):
            state.layers[i] = ACTS[BARRIER]
        if lost[i]:
            continue
        free = is_alone(i, a) or not a.guarded
        # Its choice counts for those that come after it, who keep their distances from it: the order makes the proof.
        how = 0 if free else choose_acceleration(i, r, v, a)
        if free:
            for q in range(3):
                a.chosen[i, q] = a.wanted[i, q]
        if how > 0:
            count_action(GUARD, i, t, a)
            state.layers[i] |= ACTS[GUARD]
        if how > 1:
            count_action(BRAKE, i, t, a)
            state.layers[i] |= ACTS[BRAKE]
        if a.soft[i] > 0.0:
            if how + state.layers[i] + a.overruled[i] == 0:
                for q in range(3):
                    a.commanded[i, q] = a.requested[i, q]
                continue
            a.overruled[i] = 1
            if state.layers[i] == 0:
                state.layers[i] = ACTS[GUARD]
            command_force(i, state, a)
        elif how > 0 or changed or flows:
            command_force(i, state, a)
    return 1
