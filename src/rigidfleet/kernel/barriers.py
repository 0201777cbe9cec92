"""Barriers: edges that can only push, composed with the formation's edges by Gauss's principle.

With L the distance, D what is to be kept and B a share of the braking that both have,

    h = sqrt(2 B (L - D)) + dL/dt >= 0

says that braking by B still stops them in time. dh/dt >= -rate h is linear in the accelerations: with u the unit vector
and s = dL/dt,

    u . (a_i - a_j) >= -rate h - B s / sqrt(2 B (L - D)) - (|v|^2 - s^2) / L.

Beside an obstacle that moves, a second row steers: what would pass too near passes at the distance to keep.

The accelerations change by the least of 1/2 sum m_i |da_i|^2 (Gauss) so that these rows hold and edges keep the
accelerations that the law gave them, softly: with A = J M^-1 J^T of edges E and barriers B,

    [A_EE + soft, A_EB; A_BE, A_BB] [pull; push] = [0; needed - J_B a] + [0; w],  0 <= push <= most, w >= 0,
    push w = 0 where push < most.

This is the same minimum as that of the law and the barriers together, because the law's accelerations are the
projection of the free ones onto the edges. Between vehicles, the pushes add no net force and no torque. Their bound
makes the problem solvable where barriers contradict each other. Edges let go while barriers push vehicles.
"""

import math

from rigidfleet.kernel.attitude_control import limit_tilt_in_place
from rigidfleet.kernel.avoidance import BARRIER, KNOWN, MOST_ROWS
from rigidfleet.kernel.avoidance import needed_gap_acceleration as _needed_rate
from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.constraint import find_multipliers
from rigidfleet.kernel.linalg import cholesky, cholesky_solve, copy_vector
from rigidfleet.kernel.moving import relative_braking_limit
from rigidfleet.kernel.segments import obstacle_distance, segment_obstacle_bounds

#: Greatest number of sweeps, change of an acceleration that ends them [m/s^2].
_SWEEPS, _CLOSE = 10, 5e-5
#: Number of sweeps over barriers that push between those over all, and the factor of over-relaxation.
_INNER, _BEYOND = 8, 1.5
#: Share of its braking by which barriers push a vehicle whose edges let go completely.
_FULL = 0.5
#: Time for which vehicles look ahead to where obstacles that move pass them [s].
_AHEAD = 3.0
#: Square of the cosine between their way and a direction that still counts as beside it.
_ACROSS = 0.25
#: Least share to which an edge holds in the equations.
_LOOSE = 1e-3

needed_rate = jit_inline(_needed_rate)


@jit
def weaken_all_edge_forces(p, w, state, avoid):
    """Take from the forces of edges what they let go, and from their integrals what the tick has added to it.

    All edges let go by one share, that of the vehicle that is pushed most: where edges are redundant, forces of single
    ones are large and cancel each other, so that what is left without some of them would drive the formation apart.
    """
    edges, free = p.graph.edges, 0.0
    for e in range(edges.shape[0]):
        free = max(free, 1.0 - min(avoid.hold[edges[e, 0]], avoid.hold[edges[e, 1]]))
    if free > 0.0:
        find_multipliers(p.graph)
    for e in range(edges.shape[0] if free > 0.0 else 0):
        i, j = edges[e, 0], edges[e, 1]
        for q in range(3):
            force = free * w.multiplier[e] * w.u[e, q]
            state.force[i, q] -= force
            state.force[j, q] += force
        if not (state.saturated[i] or state.saturated[j]):
            state.integral[e] -= free * avoid.period * w.c[e]


@jit
def add_barrier(count, i, j, entry, n, missing_accel, limit, avoid):
    """Add a barrier along n (3,), with its entry of ``last``; returns the number of them.

    It changes the acceleration along n by twice ``limit`` [m/s^2] at most.
    """
    if count < avoid.rows.shape[0]:
        avoid.rows[count, 0], avoid.rows[count, 1], avoid.rows[count, 2] = i, j, entry
        copy_vector(n, avoid.normals[count])
        reduced = 1.0 / (avoid.inverse[i] + (avoid.inverse[j] if j >= 0 else 0.0))
        avoid.missing[count], avoid.most[count] = missing_accel, 2.0 * limit * reduced
        avoid.push[count], avoid.reduced[count] = min(avoid.last[entry], avoid.most[count]), reduced
        count += 1
    return count


@jit
def add_obstacle_barrier(count, i, entry, needed, avoid):
    """Add a barrier of vehicle i along ``normal``, if it may act; the number of them, and whether this is violated."""
    n, c = avoid.normal, avoid.wanted[i]
    missing = needed - (n[0] * c[0] + n[1] * c[1] + n[2] * c[2])
    if missing > -avoid.b[i]:
        count = add_barrier(count, i, -1, entry, n, missing, avoid.b[i], avoid)
    return count, missing > 0.0


@jit
def least_passing_acceleration(i, o, r, v, avoid):
    """Least acceleration of vehicle i with which obstacle o, which moves, passes it; ``normal`` is its direction.

    Both go on straight to where they are nearest, in the time t, with a part of the distance to keep missing. An
    acceleration of 2 / t^2 times that part along the normal there, held until then, makes up for it. Without it, a
    vehicle would be driven along by an obstacle that comes straight at it, until others are in its way. A wide
    obstacle, which is left in or against the direction of the way, asks for nothing: braking has to do.
    """
    x, p, q, bound = avoid.sight.track[o], avoid.shifted[0], avoid.shifted[2], avoid.sight.bound[o]
    for k in range(3):
        p[k] = r[k] - x[k] - avoid.lead[i, k] * x[3 + k]
        q[k] = p[k] + _AHEAD * (v[k] - x[3 + k])
    keep = avoid.reach[i] + avoid.spare[i] + bound[0]
    most = keep + _AHEAD * bound[1]
    if segment_obstacle_bounds(p, q, o, avoid.solids, most, avoid.normal)[1] >= most:  # quick
        return -math.inf
    _, away, share = segment_obstacle_bounds(p, q, o, avoid.solids, math.nan, avoid.normal)
    t = _AHEAD * share
    missing = keep + t * bound[1] - away
    along = fast = 0.0
    for k in range(3):
        along += avoid.normal[k] * (q[k] - p[k])
        fast += (q[k] - p[k]) ** 2
    if missing <= 0.0 or along * along > _ACROSS * fast:
        return -math.inf
    return 2.0 * missing / max(t - avoid.lag[i], avoid.period) ** 2


@jit
def list_barriers(r, v, lost, avoid):
    """Write the barriers that may act at this tick; returns their number, and whether one of them is violated."""
    count, violated, n, walls, sight = 0, False, avoid.normal, avoid.near.shape[0], avoid.sight
    for i in range(avoid.b.shape[0]):
        if lost[i]:
            continue
        c = avoid.wanted[i]
        for e in range(avoid.start[i], avoid.start[i + 1]):
            j = avoid.near[e]
            if j < i:
                continue
            x, y, z = r[i, 0] - r[j, 0], r[i, 1] - r[j, 1], r[i, 2] - r[j, 2]
            L = math.sqrt(x * x + y * y + z * z)
            inverse = 1.0 / L
            n[0], n[1], n[2] = inverse * x, inverse * y, inverse * z
            X, Y, Z = v[i, 0] - v[j, 0], v[i, 1] - v[j, 1], v[i, 2] - v[j, 2]
            s, d = n[0] * X + n[1] * Y + n[2] * Z, avoid.wanted[j]
            both = avoid.b[i] + avoid.b[j]
            gap = L - avoid.room[i] - avoid.room[j] - avoid.spare[i] - avoid.spare[j]
            soft = avoid.share * (avoid.soft[i] + avoid.soft[j])
            across = (X * X + Y * Y + Z * Z - s * s) * inverse
            # A point with a lag flies on for it; of a quadrotor, the point led knows its lags.
            if soft == 0.0:
                gap -= max(0.0, -s) * max(avoid.lag[i], avoid.lag[j])
                needed = needed_rate(gap, s, across, avoid.share * both, avoid.rate)
            else:
                needed = needed_rate(gap, s, across, avoid.share * both, avoid.rate, soft)
            have = n[0] * (c[0] - d[0]) + n[1] * (c[1] - d[1]) + n[2] * (c[2] - d[2])
            if needed > have - both:  # one that others may yet push into it is listed, too
                violated = violated or needed > have
                count = add_barrier(count, i, j, e, n, needed - have, both, avoid)
        for o in range(avoid.solids.kind.shape[0]):
            B = avoid.b[i]
            if sight.moves[o] == 0:
                away = obstacle_distance(r[i, 0], r[i, 1], r[i, 2], o, avoid.solids, n)
                gap = away - avoid.reach[i] - avoid.spare[i]
                s = n[0] * v[i, 0] + n[1] * v[i, 1] + n[2] * v[i, 2]
            elif sight.known[o] == KNOWN:
                x, bound, B = sight.track[o], sight.bound[o], relative_braking_limit(i, o, avoid)
                for q in range(3):
                    n[q] = r[i, q] - x[q] - avoid.lead[i, q] * x[3 + q]
                away = obstacle_distance(n[0], n[1], n[2], o, avoid.solids, n)
                gap = away - avoid.reach[i] - avoid.spare[i] - bound[0]
                s = n[0] * (v[i, 0] - x[3]) + n[1] * (v[i, 1] - x[4]) + n[2] * (v[i, 2] - x[5])
                s -= bound[1]
            else:
                continue
            if avoid.soft[i] == 0.0:
                gap -= max(0.0, -s) * avoid.lag[i]
                needed = needed_rate(gap, s, 0.0, avoid.share * B, avoid.rate)
            else:
                soft = avoid.share * B * avoid.soft[i] / avoid.b[i]
                needed = needed_rate(gap, s, 0.0, avoid.share * B, avoid.rate, soft)
            entry = walls + 2 * (i * avoid.solids.kind.shape[0] + o)
            count, worse = add_obstacle_barrier(count, i, entry, needed, avoid)
            violated = violated or worse
            if sight.moves[o] != 0:
                needed = least_passing_acceleration(i, o, r[i], v[i], avoid)
                count, worse = add_obstacle_barrier(count, i, entry + 1, needed, avoid)
                violated = violated or worse
    return count, violated


@jit
def difference_along(i, j, n, x):
    """The part along a unit vector n (3,) of the difference of rows i and j of x (N, 3); of row i if j is -1."""
    along = n[0] * x[i, 0] + n[1] * x[i, 1] + n[2] * x[i, 2]
    if j >= 0:
        along -= n[0] * x[j, 0] + n[1] * x[j, 1] + n[2] * x[j, 2]
    return along


@jit
def apply_force(i, j, n, force, avoid):
    """Add the accelerations of a force [N] along a unit vector n (3,) on i, and against it on j if j is not -1."""
    for q in range(3):
        avoid.shift[i, q] += force * avoid.inverse[i] * n[q]
        if j >= 0:
            avoid.shift[j, q] -= force * avoid.inverse[j] * n[q]


@jit
def edge_compliance(e, p, avoid):
    """What an edge adds to its own diagonal of A: the law's damping, and more the less it holds."""
    i, j = p.graph.edges[e, 0], p.graph.edges[e, 1]
    hold = max(min(avoid.hold[i], avoid.hold[j]), _LOOSE)
    return p.law.mu / p.vehicles.mean + (1.0 / hold - 1.0) * p.graph.diagonal[e]


@jit
def enforce_barrier(k, avoid):
    """Let barrier k push as it must with the present accelerations; returns the change that it makes [m/s^2]."""
    i, j, n = avoid.rows[k, 0], avoid.rows[k, 1], avoid.normals[k]
    rest = avoid.missing[k] - difference_along(i, j, n, avoid.shift)
    # Over-relaxed, then back between its bounds: projected Gauss-Seidel converges for any factor below 2.
    push = min(max(avoid.push[k] + _BEYOND * rest * avoid.reduced[k], 0.0), avoid.most[k])
    more = push - avoid.push[k]
    if more == 0.0:
        return 0.0
    apply_force(i, j, n, more, avoid)
    avoid.push[k] = push
    return abs(more) * (avoid.inverse[i] + (avoid.inverse[j] if j >= 0 else 0.0))


@jit
def update_edge_pulls(p, w, avoid):
    """Let all edges pull as they must with the present accelerations; returns the change that it makes [m/s^2]."""
    change = 0.0
    for e in range(p.graph.edges.shape[0]):
        i, j, n = p.graph.edges[e, 0], p.graph.edges[e, 1], w.u[e]
        along = difference_along(i, j, n, avoid.shift)
        if along == 0.0 and avoid.pull[e] == 0.0:
            continue
        soft, diagonal = edge_compliance(e, p, avoid), p.graph.diagonal[e]
        pull = -_BEYOND * (along + soft * avoid.pull[e]) / (diagonal + soft)
        change = max(change, abs(pull) * diagonal)
        apply_force(i, j, n, pull, avoid)
        avoid.pull[e] += pull
    return change


@jit
def sweep_gauss_seidel(barrier_count, p, w, avoid):
    """Projected Gauss-Seidel: a sweep over all barriers and edges, then some over those that push alone.

    Returns the greatest change of the first one [m/s^2].
    """
    first, pushing = 0.0, 0
    for k in range(barrier_count):
        first = max(first, enforce_barrier(k, avoid))
        if avoid.push[k] > 0.0:
            avoid.pushing[pushing] = k
            pushing += 1
    first = max(first, update_edge_pulls(p, w, avoid))
    for _ in range(_INNER if first >= _CLOSE else 0):
        change = 0.0
        for k in range(pushing):
            change = max(change, enforce_barrier(avoid.pushing[k], avoid))
        if max(change, update_edge_pulls(p, w, avoid)) < _CLOSE:
            break
    return first


@jit
def matrix_entry(i, j, n_ij, k, l, n_kl, avoid):
    """Entry of A for two rows: unit vectors n_ij and n_kl (3,), vehicles i and j, k and l (-1: none)."""
    value = 0.0
    dot = n_ij[0] * n_kl[0] + n_ij[1] * n_kl[1] + n_ij[2] * n_kl[2]
    if i == k:
        value += dot / avoid.weight[i]
    elif i == l:
        value -= dot / avoid.weight[i]
    if j >= 0:
        if j == k:
            value -= dot / avoid.weight[j]
        elif j == l:
            value += dot / avoid.weight[j]
    return value


@jit
def solve_active_set(count, p, w, avoid):
    """Solve exactly for the barriers that push less than they may, and the edges, if the sweeps have found which.

    Nothing changes if there are too many, or if the solution is none: a push that is negative, or greater than it may
    be.
    """
    size, m = 0, p.graph.edges.shape[0]
    for k in range(count):
        if 0.0 < avoid.push[k] < avoid.most[k]:
            if size + m >= MOST_ROWS:
                return
            avoid.active[size] = k
            size += 1
    whole = size + m
    # The unknowns are corrections of pushes, then of pulls. A push at a bound stays: the sweeps have chosen it.
    for row in range(whole):
        i, j, n = pair_and_normal_of_row(row, size, p, w, avoid)
        for column in range(row + 1):
            k, l, other = pair_and_normal_of_row(column, size, p, w, avoid)
            avoid.system[row, column] = matrix_entry(i, j, n, k, l, other, avoid)
        # What is left by the pushes so far and by those at their bounds
        avoid.right[row] = -difference_along(i, j, n, avoid.shift)
        if row < size:
            avoid.right[row] += avoid.missing[avoid.active[row]]
        else:
            soft = edge_compliance(row - size, p, avoid)
            avoid.system[row, row] += soft
            avoid.right[row] -= soft * avoid.pull[row - size]
    if not cholesky(avoid.system[:whole, :whole]):
        return
    cholesky_solve(avoid.system[:whole, :whole], avoid.right[:whole])
    for row in range(size):
        push = avoid.push[avoid.active[row]] + avoid.right[row]
        if not 0.0 <= push <= avoid.most[avoid.active[row]]:
            return
    for row in range(whole):
        i, j, n = pair_and_normal_of_row(row, size, p, w, avoid)
        apply_force(i, j, n, avoid.right[row], avoid)
        if row < size:
            avoid.push[avoid.active[row]] += avoid.right[row]
        else:
            avoid.pull[row - size] += avoid.right[row]


@jit
def pair_and_normal_of_row(row, barriers, p, w, avoid):
    """Vehicles and unit vector of a row of the system: of one of the ``barriers``, or after these of an edge."""
    if row < barriers:
        k = avoid.active[row]
        return avoid.rows[k, 0], avoid.rows[k, 1], avoid.normals[k]
    return p.graph.edges[row - barriers, 0], p.graph.edges[row - barriers, 1], w.u[row - barriers]


@jit
def solve_barriers(count, p, w, avoid):
    """Pushes of barriers, pulls of edges, and the changes of accelerations that they make (``shift``).

    It begins with the pushes of the tick before.
    """
    avoid.shift[:] = 0.0
    avoid.pull[:] = 0.0
    for k in range(count):
        if avoid.push[k] > 0.0:
            apply_force(avoid.rows[k, 0], avoid.rows[k, 1], avoid.normals[k], avoid.push[k], avoid)
    for _ in range(3):
        for _ in range(_SWEEPS):
            if sweep_gauss_seidel(count, p, w, avoid) < _CLOSE:
                return
        solve_active_set(count, p, w, avoid)  # a sweep after it tells whether that was all


@jit
def limit_thrust(i, avoid):
    """Limit the thrust of an acceleration asked for."""
    c = avoid.wanted[i]
    size = math.sqrt(c[0] * c[0] + c[1] * c[1] + (c[2] + avoid.g) ** 2)
    if size > avoid.lift[i]:
        share = avoid.lift[i] / size
        c[0], c[1], c[2] = share * c[0], share * c[1], share * (c[2] + avoid.g) - avoid.g
    if avoid.tilt[i] < math.inf:
        c[2] += avoid.g
        limit_tilt_in_place(c, avoid.tilt[i], avoid.g)
        c[2] -= avoid.g


@jit
def filter_accelerations(t, r, v, lost, p, w, avoid):
    """Change what is asked for as little as possible, so that all barriers hold; returns whether any did not."""
    count, violated = list_barriers(r, v, lost, avoid)
    n = avoid.b.shape[0]
    if violated:
        solve_barriers(count, p, w, avoid)
    avoid.known[2] = 0.0
    avoid.last[:] = 0.0
    for k in range(count if violated else 0):
        avoid.last[avoid.rows[k, 2]] = avoid.push[k]
        for side in range(2):
            i = avoid.rows[k, side]
            if i >= 0 and avoid.push[k] > 0.0:
                for q in range(3):
                    avoid.known[2, i, q] += (1 - 2 * side) * avoid.push[k] * avoid.normals[k, q]
    for i in range(n):
        push = avoid.known[2, i]
        pushed = math.sqrt(push[0] * push[0] + push[1] * push[1] + push[2] * push[2])
        if pushed > 0.0:
            avoid.acted[BARRIER, i] += 1
            avoid.first[BARRIER, i] = min(avoid.first[BARRIER, i], t)
        # Edges let go and take hold gradually, over `release`: forces do not jump.
        aim = 1.0 - min(1.0, pushed / (_FULL * avoid.weight[i] * avoid.b[i]))
        avoid.hold[i] += (aim - avoid.hold[i]) * min(1.0, avoid.period / avoid.release)
        if avoid.hold[i] > 1.0 - 1e-6:
            avoid.hold[i] = 1.0
        if violated:
            for q in range(3):
                avoid.wanted[i, q] += avoid.shift[i, q]
            limit_thrust(i, avoid)
    return violated
