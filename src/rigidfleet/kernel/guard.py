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
from rigidfleet.kernel.barriers import filter_accelerations, limit_thrust, weaken_all_edge_forces
from rigidfleet.kernel.compiler.jit import jit
from rigidfleet.kernel.fleet import TICKS as FLIGHT_TICKS
from rigidfleet.kernel.linalg import copy, copy_vector
from rigidfleet.kernel.moving import (
    is_obstacle_known,
    miss_distance,
    moving_obstacle_margin,
    relative_braking_limit,
    steer_round_obstacles,
    update_tracks,
    way_to_rest,
    write_braking_relative_to_obstacle,
    write_stop_relative_to_obstacle,
)
from rigidfleet.kernel.quadrotor import rotor_curve
from rigidfleet.kernel.rigid_body import attitude_matrix
from rigidfleet.kernel.sampled_flight import write_measured_r_and_v
from rigidfleet.kernel.segments import (
    hull_gap,
    least_value,
    obstacle_distance,
    refined_obstacle_distance,
    segment_distance,
    segment_obstacle_bounds,
)

#: Neighbours are listed for speeds higher by this share and summand [m/s], and for ways of this share of their
#: distance, or this way [m].
_FASTER, _LEAST_SPEED, _NEARER, _LEAST_WAY = 0.25, 0.2, 0.15, 0.2
#: Shortfall of a distance from which a vehicle evades what moves as well as it can, and that counts as rounding [m].
_LATE, _ROUNDING = 0.05, 1e-9


# -- what a vehicle does -------------------------------------------------------------------------------


@jit
def stop_distance(speed, i, avoid):
    """Way [m] of vehicle i to rest from a speed [m/s]."""
    return way_to_rest(speed, avoid.b[i], avoid.lag[i], avoid.period)


@jit
def predict_motion(i, r, v, c, avoid, out):
    """Motion of vehicle i from r, v (3,) under an acceleration c (3,) held for a tick; see `AvoidanceArrays.trial`.

    Returns the distance from r that it cannot leave in the tick, and by braking after it.
    """
    E, first, second, T = avoid.coast[i, 0], avoid.coast[i, 1], avoid.coast[i, 2], avoid.period
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
    stop = stop_distance(end, i, avoid)
    for q in range(3):
        out[2, q] = out[1, q] + stop / max(end, 1e-12) * out[2, q]
    return max(avoid.behind[i], T * (speed + 0.5 * T * math.sqrt(rise)) + stop)


@jit
def write_braking_acceleration(i, v, avoid, out):
    """Acceleration (3,) that brakes vehicle i from a velocity v (3,): by b, or to rest within the tick, with drag."""
    speed, b, soft = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), avoid.b[i], avoid.soft[i]
    most = b * speed / max(speed + soft, 1e-12) if soft > 0.0 else b
    size = min(most, speed * avoid.coast[i, 0] / avoid.coast[i, 1]) / max(speed, 1e-12)
    for q in range(3):
        out[q] = -size * v[q]


@jit
def commit_trial(i, far, avoid):
    """Make the candidate ``trial`` the present choice of vehicle i."""
    trial = avoid.trial
    avoid.far[i] = far
    copy(trial[:3], avoid.ways[i])
    copy_vector(trial[3], avoid.chosen[i])
    copy_vector(trial[4], avoid.rise[i])


@jit
def is_apart(i, v_i, j, v_j, floor, avoid):
    """Whether the candidate of vehicle i keeps its distance from the present choice of j; velocities v_i and v_j (3,).

    The relative path over the tick lies beyond the parabola of its part along any unit vector. The vector is that to
    the nearest point of the chord.
    """
    mine, ways, other, rise = avoid.trial, avoid.ways, avoid.ways[j], avoid.rise[j]
    if avoid.soft[i] + avoid.soft[j] > 0.0:  # quadrotors, by their hulls
        return hull_gap(mine, 2, ways[i, 4:], other, 2, other[4:], floor, avoid.normal) >= floor
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
    least = min(own, own * avoid.coast[i, 0]) - max(theirs, theirs * avoid.coast[j, 0])
    return least_value(along, rate, least, avoid.period) >= floor


@jit
def clears_static_obstacles(i, v, far, avoid):
    """Whether the candidate of vehicle i, with a velocity v (3,), keeps its distances from obstacles at rest."""
    way, normal, solids = avoid.trial, avoid.normal, avoid.solids
    for o in range(solids.kind.shape[0]):
        if avoid.sight.moves[o] != 0:
            continue
        floor = avoid.walls[i, o]
        # Farther away than it can come: most obstacles take one distance.
        if obstacle_distance(way[0, 0], way[0, 1], way[0, 2], o, solids, normal) - far >= floor:
            continue
        # Its stop segment after the tick, then its path over the tick as in `is_apart`: a parabola beyond the chord.
        after = avoid.ways[i, 4] if avoid.soft[i] > 0.0 else way[1]
        bound, _, _ = segment_obstacle_bounds(after, way[2], o, solids, floor, normal)
        if bound < floor:
            return False
        bound, value, x = segment_obstacle_bounds(way[0], way[1], o, solids, floor, normal)
        if bound < floor:
            return False
        along = rate = rise = 0.0
        for q in range(3):
            along += normal[q] * (way[1, q] - way[0, q])
            rate += normal[q] * v[q]
            rise += normal[q] * way[4, q]
        rise = min(rise, rise * avoid.coast[i, 0])
        if least_value(value - x * along, rate, rise, avoid.period) < floor:
            return False
    return True


# -- neighbours ----------------------------------------------------------------------------------------


@jit
def interaction_range(u, accel, avoid):
    """Distance [m] beyond which vehicles with speeds up to u [m/s] neither meet by the next tick nor meet a barrier.

    A barrier asks for nothing while rate h + B s/sqrt(2 B (L - D)) is above the greatest relative acceleration, twice
    that asked for, ``accel`` [m/s^2]; s is at least -2 u.
    """
    room = stop = strongest = lag = behind = soft = 0.0
    weakest = math.inf
    for i in range(avoid.b.shape[0]):
        room, lag = max(room, avoid.room[i] + avoid.spare[i]), max(lag, avoid.lag[i])
        behind, soft = max(behind, avoid.lead[i, 0] * u), max(soft, avoid.soft[i])
        # After a tick with all its thrust, downwards, it takes far longer to come to rest than before.
        after = u + avoid.period * avoid.lift[i] + avoid.period * avoid.g
        stop = max(stop, stop_distance(after, i, avoid) + avoid.period * after)
        weakest, strongest = min(weakest, avoid.b[i]), max(strongest, avoid.b[i])
    barrier = 0.0
    if avoid.filtered:
        half, B = avoid.rate * (u + avoid.share * soft) + accel, 2.0 * avoid.share * strongest
        root = (half + math.sqrt(half * half + 2.0 * avoid.rate * B * u)) / avoid.rate
        barrier = root * root / (4.0 * avoid.share * weakest) + 2.0 * u * lag
    return 2.0 * (room + behind) + max(2.0 * stop, barrier)


@jit
def list_neighbours(r, lost, way, avoid):
    """List for each vehicle those within a distance ``way`` [m]; returns False if the list is too short."""
    # By sweep and prune: along the axis in which the fleet is widest, only those within ``way`` are compared.
    n, order = avoid.b.shape[0], avoid.order
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
    avoid.start[:] = 0
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
                    avoid.near[avoid.start[i]], avoid.near[avoid.start[j]] = j, i
                avoid.start[i] += 1
                avoid.start[j] += 1
        if fill == 0:
            total = 0
            for i in range(n):
                total += avoid.start[i]
                avoid.start[i] = total - avoid.start[i]
            avoid.start[n] = total
            if total > avoid.near.shape[0]:
                return False
    for i in range(n, 0, -1):  # each entry has moved to the start of the next vehicle
        avoid.start[i] = avoid.start[i - 1]
    avoid.start[0] = 0
    return True


@jit
def greatest_row_norm(x):
    """Greatest length of the rows of x (N, 3)."""
    longest = 0.0
    for i in range(x.shape[0]):
        longest = max(longest, x[i, 0] * x[i, 0] + x[i, 1] * x[i, 1] + x[i, 2] * x[i, 2])
    return math.sqrt(longest)


@jit
def greatest_move_beside_mean(r, avoid):
    """Greatest way [m] of a vehicle since neighbours were listed, beside the way that all have gone."""
    # What all have gone together changes no distance: a fleet that travels keeps its lists.
    n, farthest = avoid.b.shape[0], 0.0
    mean_x, mean_y, mean_z = 0.0, 0.0, 0.0
    for i in range(n):
        mean_x += (r[i, 0] - avoid.listed[i, 0]) / n
        mean_y += (r[i, 1] - avoid.listed[i, 1]) / n
        mean_z += (r[i, 2] - avoid.listed[i, 2]) / n
    for i in range(n):
        x = r[i, 0] - avoid.listed[i, 0] - mean_x
        y = r[i, 1] - avoid.listed[i, 1] - mean_y
        z = r[i, 2] - avoid.listed[i, 2] - mean_z
        farthest = max(farthest, x * x + y * y + z * z)
    return math.sqrt(farthest)


@jit
def update_neighbours(r, v, lost, avoid):
    """Renew the list of neighbours if others could have come near; returns False if it is too short."""
    fastest, hardest = greatest_row_norm(v), greatest_row_norm(avoid.wanted)
    due = avoid.count[LISTED] == 0 or fastest > avoid.span[1] or hardest > avoid.span[2]
    # Nor for speeds far below those for which it was made
    due = due or 2.5 * fastest + _LEAST_SPEED < 0.8 * avoid.span[1]
    if not (due or 2.0 * greatest_move_beside_mean(r, avoid) > avoid.span[0]):
        return True
    speed, hard = (1.0 + _FASTER) * fastest + _LEAST_SPEED, (1.0 + _FASTER) * hardest + 1.0
    way = interaction_range(speed, hard, avoid)
    avoid.span[0], avoid.span[1], avoid.span[2] = max(_NEARER * way, _LEAST_WAY), speed, hard
    copy(r, avoid.listed)
    avoid.count[LISTED], avoid.last[:] = 1, 0.0
    return list_neighbours(r, lost, way + avoid.span[0], avoid)


# -- the tick ------------------------------------------------------------------------------------------


@jit
def note_margin(kind, value, t, i, j, avoid):
    """Note a margin [m] of vehicle i to j, or to obstacle j, if it is the least so far, or the first negative one."""
    if value < avoid.margin[kind, 0]:
        avoid.margin[kind, 0], avoid.margin[kind, 1] = value, t
        avoid.between[kind, 0], avoid.between[kind, 1] = i, j
    if value < -_ROUNDING and not avoid.lost[kind, 0] < math.inf:
        avoid.lost[kind, 0], avoid.lost[kind, 1] = t, value
        avoid.loser[kind, 0], avoid.loser[kind, 1] = i, j


@jit
def has_nothing_to_avoid(i, avoid):
    """Whether vehicle i has neither neighbours nor obstacles."""
    return avoid.start[i + 1] == avoid.start[i] and avoid.solids.kind.shape[0] == 0


@jit
def set_obstacle_distance_to_keep(t, i, o, r, v, least_excess, avoid):
    """Find the distance that the relative stop segment of vehicle i keeps from obstacle o, which moves.

    Returns the least by which such a segment exceeds what it needs so far, at most 0; `threat` is its obstacle.
    """
    if not is_obstacle_known(o, avoid):
        return least_excess
    stop, speed = write_stop_relative_to_obstacle(i, o, r, v, avoid)
    way, bound, braking = avoid.shifted, avoid.sight.bound[o], relative_braking_limit(i, o, avoid)
    need = avoid.reach[i] + avoid.spare[i] + bound[0] + bound[1] * speed / braking
    apart = obstacle_distance(way[0, 0], way[0, 1], way[0, 2], o, avoid.solids, avoid.normal) - stop
    avoid.walls[i, o] = need
    if avoid.threat[i] < 0:  # also one that is still far: a single tick may bring it near
        avoid.threat[i] = o
    if apart < need or apart - need < avoid.margin[OBSTACLE, 0]:
        # Rounding alone must not make the bound a loose one: the vehicle could lose a little at each tick
        enough = need - 10.0 * _ROUNDING
        kept = refined_obstacle_distance(way[0], way[2], o, avoid.solids, enough, avoid.normal)
        avoid.walls[i, o] = min(need, kept)
        note_margin(OBSTACLE, kept - avoid.reach[i], t, i, o, avoid)
        if kept - need < least_excess or (apart < need and least_excess == 0.0):
            avoid.threat[i], least_excess = o, min(kept - need, 0.0)
    return least_excess


@jit
def brake_and_set_gaps_to_keep(t, r, v, lost, avoid):
    """Let all vehicles brake, and find the distances that their stop segments keep, as they should or as they do."""
    n, c, normal, solids = avoid.b.shape[0], avoid.trial[3], avoid.normal, avoid.solids
    for i in range(n):
        if has_nothing_to_avoid(i, avoid):
            continue
        write_braking_acceleration(i, v[i], avoid, c)
        speed = math.sqrt(v[i, 0] ** 2 + v[i, 1] ** 2 + v[i, 2] ** 2)
        stop = stop_distance(speed, i, avoid)
        for q in range(3):
            avoid.ways[i, 3, q] = r[i, q] + stop / max(speed, 1e-12) * v[i, q]
        # It stays on the stop segment, also after the tick
        commit_trial(i, max(predict_motion(i, r[i], v[i], c, avoid, avoid.trial), stop), avoid)
    # A vehicle that is nearer than it should be keeps what it has: a floor that nobody meets would stop all.
    for i in range(n):
        if lost[i]:
            continue
        for e in range(avoid.start[i], avoid.start[i + 1]):
            j = avoid.near[e]
            need = avoid.room[i] + avoid.room[j] + avoid.spare[i] + avoid.spare[j]
            x, y, z = r[i, 0] - r[j, 0], r[i, 1] - r[j, 1], r[i, 2] - r[j, 2]
            apart = math.sqrt(x * x + y * y + z * z) - avoid.far[i] - avoid.far[j]
            avoid.floor[e] = need
            if apart < need or apart - need < avoid.margin[PAIR, 0]:
                if avoid.soft[i] + avoid.soft[j] > 0.0:
                    mine, other = avoid.ways[i], avoid.ways[j]
                    kept = hull_gap(mine, 3, mine[4:], other, 3, other[4:], math.nan, normal)
                else:
                    kept = segment_distance(r[i], avoid.ways[i, 3], r[j], avoid.ways[j, 3])
                avoid.floor[e] = min(need, kept)
                if i < j:
                    note_margin(PAIR, kept - avoid.room[i] - avoid.room[j], t, i, j, avoid)
        avoid.threat[i], avoid.late[i], closest = -1, 0.0, 0.0
        for o in range(solids.kind.shape[0]):
            if avoid.sight.moves[o] != 0:
                closest = set_obstacle_distance_to_keep(t, i, o, r[i], v[i], closest, avoid)
                avoid.late[i] = closest
                continue
            need = avoid.reach[i] + avoid.spare[i]
            apart = obstacle_distance(r[i, 0], r[i, 1], r[i, 2], o, solids, normal) - avoid.far[i]
            avoid.walls[i, o] = need
            if apart < need or apart - need < avoid.margin[OBSTACLE, 0]:
                way = avoid.ways[i]
                kept = refined_obstacle_distance(way[4], way[3], o, solids, need, normal)
                avoid.walls[i, o] = min(need, kept)
                note_margin(OBSTACLE, kept - avoid.reach[i], t, i, o, avoid)


@jit
def is_safe_among_all(i, r, v, far, avoid):
    """Whether the candidate of vehicle i is compatible with the present choices of all others and with obstacles."""
    for e in range(avoid.start[i], avoid.start[i + 1]):
        j, floor = avoid.near[e], avoid.floor[e]
        x, y, z = r[i, 0] - r[j, 0], r[i, 1] - r[j, 1], r[i, 2] - r[j, 2]
        reach = floor + far + avoid.far[j]
        if x * x + y * y + z * z < reach * reach and not is_apart(i, v[i], j, v[j], floor, avoid):
            return False
    return clears_static_obstacles(i, v[i], far, avoid)


@jit
def is_barrier_active(i, avoid):
    """Whether barriers push vehicle i."""
    push = avoid.known[2, i]
    return push[0] * push[0] + push[1] * push[1] + push[2] * push[2] > 0.0


@jit
def propose_acceleration(i, k, v, avoid, c):
    """Candidate k of vehicle i into c (3,): what it wants, fixed ones, then braking relative to its threat."""
    last = avoid.candidates.shape[0] + 1
    if k == 0:
        c[0], c[1], c[2] = avoid.wanted[i, 0], avoid.wanted[i, 1], avoid.wanted[i, 2]
        if avoid.soft[i] > 0.0 and avoid.overruled[i] == 0 and not is_barrier_active(i, avoid):
            for q in range(3):
                c[q] = lag_compensating_choice(i, q, avoid)
    elif k < last:
        for q in range(3):
            c[q] = avoid.b[i] * avoid.candidates[k - 1, q]
    else:
        write_braking_relative_to_obstacle(i, avoid.threat[i], v, avoid, c)


@jit
def obstacle_margin_if_braking(i, r, v, too_late, avoid):
    """What `choose_acceleration` compares of vehicle i, if it brakes [m]."""
    c = avoid.trial[3]
    write_braking_acceleration(i, v[i], avoid, c)
    if too_late:
        return miss_distance(r[i], v[i], c, avoid)
    predict_motion(i, r[i], v[i], c, avoid, avoid.trial)
    return moving_obstacle_margin(i, v[i], avoid)


@jit
def choose_acceleration(i, r, v, avoid):
    """Choose for vehicle i: what it wants, else the nearest safe candidate, else braking; returns which.

    0 means what it wants, 1 a candidate, 2 braking. Obstacles that move can leave no safe candidate and make braking
    unsafe, too: then the one counts that keeps all else and has the most room beside them. Where a vehicle could
    not brake in time any more, the one counts that misses them most, held.
    """
    v_i, wanted, c, best, nearest = v[i], avoid.wanted[i], avoid.trial[3], math.inf, -1
    most, second = -math.inf, -1
    late = avoid.threat[i] >= 0 and avoid.late[i] < -_LATE
    for k in range(avoid.candidates.shape[0] + (2 if avoid.threat[i] >= 0 else 1)):
        propose_acceleration(i, k, v_i, avoid, c)
        away = 0.0
        for q in range(3):
            away += (c[q] - wanted[q]) ** 2
        if away >= best:  # before it is tried: distances cost far more
            continue
        far = predict_motion(i, r[i], v_i, c, avoid, avoid.trial)
        if not is_safe_among_all(i, r, v, far, avoid):
            continue
        room = miss_distance(r[i], v_i, c, avoid) if late else moving_obstacle_margin(i, v_i, avoid)
        if late or room < 0.0:
            if room > most:
                most, second = room, k
            continue
        best, nearest = away, k
        if k == 0:
            commit_trial(i, far, avoid)
            return 0
    if nearest < 0:
        if second < 0 or obstacle_margin_if_braking(i, r, v, late, avoid) >= most:
            return 2
        nearest = second
    propose_acceleration(i, nearest, v_i, avoid, c)
    commit_trial(i, predict_motion(i, r[i], v_i, c, avoid, avoid.trial), avoid)
    return 1


@jit
def count_action(kind, i, t, avoid):
    """Count that a layer has acted on vehicle i at this tick."""
    avoid.acted[kind, i] += 1
    avoid.first[kind, i] = min(avoid.first[kind, i], t)


@jit
def set_commanded_force(i, state, avoid):
    """Give vehicle i the force of the acceleration chosen for it; a quadrotor's follows it with a lag."""
    c, u = avoid.chosen[i], avoid.commanded[i]
    for q in range(3):
        u[q] = c[q] - avoid.ahead[i, q, 2] / (avoid.period + avoid.ahead[i, q, 2]) * (c[q] - u[q])
        state.force[i, q] = avoid.weight[i] * (u[q] + (avoid.g if q == 2 else 0.0))


@jit
def set_wanted_acceleration(i, state, avoid):
    """The acceleration that vehicle i is asked for, with its thrust limited."""
    force = state.force[i]
    size = math.sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2])
    share = min(1.0, avoid.lift[i] * avoid.weight[i] / max(size, 1e-300))
    for q in range(3):
        avoid.wanted[i, q] = share * force[q] / avoid.weight[i] - (avoid.g if q == 2 else 0.0)
    if avoid.soft[i] > 0.0:
        limit_thrust(i, avoid)
        off = 0.0
        for q in range(3):
            avoid.requested[i, q] = avoid.wanted[i, q]
            if not avoid.commanded[i, q] < math.inf:
                avoid.commanded[i, q] = avoid.requested[i, q]
            avoid.wanted[i, q] = lag_compensating_choice(i, q, avoid)
        limit_thrust(i, avoid)
        for q in range(3):
            off = max(off, abs(avoid.wanted[i, q] - lag_compensating_choice(i, q, avoid)))
        if off < _ROUNDING:
            avoid.overruled[i] = 0


@jit
def lag_compensating_choice(i, axis, avoid):
    """The choice, along an axis, that has vehicle i follow what it is asked for at once."""
    return avoid.commanded[i, axis] + (1.0 + avoid.ahead[i, axis, 2] / avoid.period) * (
        avoid.requested[i, axis] - avoid.commanded[i, axis]
    )


@jit
def move_to_lag_free_point(i, vehicles, state, r, v, avoid):
    """Lead r and v (3,) of vehicle i to the point that obeys the guard at once; keeps the points behind it.

    From a command u to the acceleration, attitude and motors act as u = a + a1 da/dt + a2 d2a/dt2 + ..., so that
    x = r + a1 v + a2 a + ... has the second derivative u. Commands follow the guard's choice c with the lag s, so that
    x + s dx/dt (and a part of a period) has the second derivative c.
    """
    T, S, ahead, away = state.work.T, state.S[i], avoid.ahead[i], 0.0
    attitude_matrix(S[6:10], T)
    lift, k = 0.0, vehicles.thrust[i]
    for j in range(4):
        lift += rotor_curve(S[13 + j], k[0], k[1], k[2]) / avoid.weight[i]
    for q in range(3):
        a1, a2, late, u = ahead[q, 0], ahead[q, 1], ahead[q, 2], avoid.commanded[i, q]
        rise = lift * T[2, q] - (avoid.g if q == 2 else 0.0)
        avoid.ways[i, 4, q] = r[q]
        avoid.ways[i, 5, q] = r[q] + a1 * v[q] + a2 * rise
        v[q] += a1 * rise + a2 * lift * (S[11] * T[0, q] - S[10] * T[1, q])
        r[q] = avoid.ways[i, 5, q] + late * (v[q] - 0.5 * avoid.period * u)
        v[q] += late * u
        away += (r[q] - avoid.ways[i, 4, q]) ** 2
    avoid.behind[i] = math.sqrt(away)


@jit
def correct_forces(p, w, flight, state, avoid):
    """Filter and guard the forces that the formation's law has just given; returns 0 if neighbours are too many."""
    n, lost, t = avoid.b.shape[0], flight.vehicles.lost, state.work.law_time[0]
    r, v, k = avoid.known[0], avoid.known[1], state.count[FLIGHT_TICKS]
    if avoid.filtered:
        weaken_all_edge_forces(p, w, state, avoid)
    write_measured_r_and_v(k, r, v, flight, state)
    for i in range(n):
        set_wanted_acceleration(i, state, avoid)
        if avoid.soft[i] > 0.0:
            move_to_lag_free_point(i, flight.vehicles, state, r[i], v[i], avoid)
        else:
            for q in range(3):
                avoid.ways[i, 4, q] = avoid.ways[i, 5, q] = r[i, q]
        state.layers[i] = 0
    update_tracks(t, avoid.ways[:, 4], lost, avoid)
    flows = False
    if avoid.flow:
        for i in range(n):
            if steer_round_obstacles(i, r[i], v[i], avoid):
                limit_thrust(i, avoid)
                flows = True
    if not update_neighbours(r, v, lost, avoid):
        avoid.count[FULL] = 1
        return 0
    avoid.count[TICKS] += 1
    brake_and_set_gaps_to_keep(t, r, v, lost, avoid)
    changed = avoid.filtered and filter_accelerations(t, r, v, lost, p, w, avoid)
    for k in range(n):
        i = (k + avoid.count[TICKS]) % n  # each comes first in turn
        if changed and is_barrier_active(i, avoid):
            state.layers[i] = ACTS[BARRIER]
        if lost[i]:
            continue
        free = has_nothing_to_avoid(i, avoid) or not avoid.guarded
        # Its choice counts for those that come after it, who keep their distances from it: the order makes the proof.
        how = 0 if free else choose_acceleration(i, r, v, avoid)
        if free:
            copy_vector(avoid.wanted[i], avoid.chosen[i])
        if how > 0:
            count_action(GUARD, i, t, avoid)
            state.layers[i] |= ACTS[GUARD]
        if how > 1:
            count_action(BRAKE, i, t, avoid)
            state.layers[i] |= ACTS[BRAKE]
        if avoid.soft[i] > 0.0:
            if how + state.layers[i] + avoid.overruled[i] == 0:
                copy_vector(avoid.requested[i], avoid.commanded[i])
                continue
            avoid.overruled[i] = 1
            if state.layers[i] == 0:
                state.layers[i] = ACTS[GUARD]
            set_commanded_force(i, state, avoid)
        elif how > 0 or changed or flows:
            set_commanded_force(i, state, avoid)
    return 1
