"""Barriers: edges that can only push, composed with the formation's edges by Gauss's principle.

With L the distance, D what is to be kept and B a share of the braking that both have,

    h = sqrt(2 B (L - D)) + dL/dt >= 0

says that braking by B still stops them in time. dh/dt >= -rate h is linear in the accelerations: with u the unit vector
and s = dL/dt,

    u . (a_i - a_j) >= -rate h - B s / sqrt(2 B (L - D)) - (|v|^2 - s^2) / L.

The accelerations change by the least of 1/2 sum m_i |da_i|^2 (Gauss) so that these rows hold and edges keep the
accelerations that the law gave them, softly: with A = J M^-1 J^T of edges E and barriers B,

    [A_EE + soft, A_EB; A_BE, A_BB] [pull; push] = [0; needed - J_B a] + [0; w],  0 <= push <= most, w >= 0,
    push w = 0 where push < most.

This is the same minimum as that of the law and the barriers together, because the law's accelerations are the
projection of the free ones onto the edges. Between vehicles, the pushes add no net force and no torque. Their bound
makes the problem solvable where barriers contradict each other. Edges let go while barriers push vehicles.
"""

import math

from rigidfleet.kernel.avoidance import BARRIER, EXACT, KNOWN
from rigidfleet.kernel.avoidance import needed_rate as _needed_rate
from rigidfleet.kernel.compiler.jit import compiled, inlined
from rigidfleet.kernel.linalg import cholesky, cholesky_solve
from rigidfleet.kernel.moving import braking_beside
from rigidfleet.kernel.segments import from_solid

#: Greatest number of sweeps, change of an acceleration that ends them [m/s^2].
_SWEEPS, _CLOSE = 100, 1e-7
#: Share of its braking by which barriers push a vehicle whose edges let go completely.
_FULL = 0.5
#: Least share to which an edge holds in the equations.
_LOOSE = 1e-3

needed_rate = inlined(_needed_rate)


@compiled
def loosen(p, w, state, a):
    """Take from the forces of edges what they let go, and from their integrals what the tick has added to it.

    All edges let go by one share, that of the vehicle that is pushed most: where edges are redundant, forces of single
    ones are large and cancel each other, so that what is left without some of them would drive the formation apart.
    """
    edges, free = p.graph.edges, 0.0
    for e in range(edges.shape[0]):
        free = max(free, 1.0 - min(a.hold[edges[e, 0]], a.hold[edges[e, 1]]))
    for e in range(edges.shape[0] if free > 0.0 else 0):
        i, j = edges[e, 0], edges[e, 1]
        for q in range(3):
            force = free * w.multiplier[e] * w.u[e, q]
            state.force[i, q] -= force
            state.force[j, q] += force
        if not (state.saturated[i] or state.saturated[j]):
            state.integral[0, e] -= free * a.period * w.c[e]


@compiled
def add_row(count, i, j, n0, n1, n2, needed, most, a):
    """Add a barrier; returns the number of them."""
    if count < a.rows.shape[0]:
        a.rows[count, 0], a.rows[count, 1] = i, j
        a.normals[count, 0], a.normals[count, 1], a.normals[count, 2] = n0, n1, n2
        a.needed[count], a.push[count], a.most[count] = needed, 0.0, most
        count += 1
    return count


@compiled
def list_barriers(r, v, lost, a):
    """Write the barriers that may act at this tick; returns their number, and whether one of them is violated."""
    count, violated = 0, False
    for i in range(a.b.shape[0]):
        if lost[i]:
            continue
        c = a.wanted[i]
        for e in range(a.start[i], a.start[i + 1]):
            j = a.near[e]
            if j < i:
                continue
            x, y, z = r[i, 0] - r[j, 0], r[i, 1] - r[j, 1], r[i, 2] - r[j, 2]
            L = math.sqrt(x * x + y * y + z * z)
            x, y, z = x / L, y / L, z / L
            X, Y, Z = v[i, 0] - v[j, 0], v[i, 1] - v[j, 1], v[i, 2] - v[j, 2]
            s, d = x * X + y * Y + z * Z, a.wanted[j]
            both = a.b[i] + a.b[j]
            gap = L - a.room[i] - a.room[j] - a.spare[i] - a.spare[j]
            gap -= max(0.0, -s) * max(a.lag[i], a.lag[j])
            across = (X * X + Y * Y + Z * Z - s * s) / L
            needed = needed_rate(gap, s, across, a.share * both, a.rate)
            have = x * (c[0] - d[0]) + y * (c[1] - d[1]) + z * (c[2] - d[2])
            if needed > have - both:
                violated = violated or needed > have
                most = 2.0 * both / (1.0 / a.weight[i] + 1.0 / a.weight[j])
                count = add_row(count, i, j, x, y, z, needed, most, a)
        normal = a.normal
        for o in range(a.solids.kind.shape[0]):
            B = a.b[i]
            if a.sight.moves[o] == 0:
                away = from_solid(r[i, 0], r[i, 1], r[i, 2], o, a.solids, normal)
                gap = away - a.reach[i] - a.spare[i]
                s = normal[0] * v[i, 0] + normal[1] * v[i, 1] + normal[2] * v[i, 2]
            elif a.sight.known[o] == KNOWN:
                x, bound, B = a.sight.track[o], a.sight.bound[o], braking_beside(i, o, a)
                away = from_solid(
                    r[i, 0] - x[0], r[i, 1] - x[1], r[i, 2] - x[2], o, a.solids, normal
                )
                gap = away - a.reach[i] - a.spare[i] - bound[0]
                s = normal[0] * (v[i, 0] - x[3]) + normal[1] * (v[i, 1] - x[4])
                s += normal[2] * (v[i, 2] - x[5]) - bound[1]
            else:
                continue
            gap -= max(0.0, -s) * a.lag[i]
            needed = needed_rate(gap, s, 0.0, a.share * B, a.rate)
            have = normal[0] * c[0] + normal[1] * c[1] + normal[2] * c[2]
            if needed > have - a.b[i]:
                violated = violated or needed > have
                most = 2.0 * a.b[i] * a.weight[i]
                count = add_row(count, i, -1, normal[0], normal[1], normal[2], needed, most, a)
    return count, violated


@compiled
def relative(i, j, n, x):
    """The part along a unit vector n (3,) of the difference of rows i and j of x (N, 3); of row i if j is -1."""
    along = n[0] * x[i, 0] + n[1] * x[i, 1] + n[2] * x[i, 2]
    if j >= 0:
        along -= n[0] * x[j, 0] + n[1] * x[j, 1] + n[2] * x[j, 2]
    return along


@compiled
def shove(i, j, n, force, a):
    """Add the accelerations of a force [N] along a unit vector n (3,) on i, and against it on j if j is not -1."""
    for q in range(3):
        a.shift[i, q] += force / a.weight[i] * n[q]
        if j >= 0:
            a.shift[j, q] -= force / a.weight[j] * n[q]


@compiled
def softness(e, p, a):
    """What an edge adds to its own diagonal of A: the law's damping, and more the less it holds."""
    i, j = p.graph.edges[e, 0], p.graph.edges[e, 1]
    hold = max(min(a.hold[i], a.hold[j]), _LOOSE)
    return p.law.mu / p.vehicles.mean + (1.0 / hold - 1.0) * p.graph.diagonal[e]


@compiled
def sweep(count, p, w, a):
    """One sweep of projected Gauss-Seidel over barriers and edges; returns the greatest change [m/s^2]."""
    change = 0.0
    for k in range(count):
        i, j, n = a.rows[k, 0], a.rows[k, 1], a.normals[k]
        diagonal = 1.0 / a.weight[i] + (1.0 / a.weight[j] if j >= 0 else 0.0)
        rest = a.needed[k] - relative(i, j, n, a.wanted) - relative(i, j, n, a.shift)
        push = min(max(a.push[k] + rest / diagonal, 0.0), a.most[k])
        if push != a.push[k]:
            change = max(change, abs(push - a.push[k]) * diagonal)
            shove(i, j, n, push - a.push[k], a)
            a.push[k] = push
    for e in range(p.graph.edges.shape[0]):
        i, j, n = p.graph.edges[e, 0], p.graph.edges[e, 1], w.u[e]
        soft = softness(e, p, a)
        diagonal = p.graph.diagonal[e]
        pull = -(relative(i, j, n, a.shift) + soft * a.pull[e]) / (diagonal + soft)
        if pull != 0.0:
            change = max(change, abs(pull) * diagonal)
            shove(i, j, n, pull, a)
            a.pull[e] += pull
    return change


@compiled
def entry(i, j, n, k, l, m, a):
    """Entry of A for two rows: unit vectors n and m (3,), vehicles i and j, k and l (-1: none)."""
    found = 0.0
    dot = n[0] * m[0] + n[1] * m[1] + n[2] * m[2]
    if i == k:
        found += dot / a.weight[i]
    elif i == l:
        found -= dot / a.weight[i]
    if j >= 0:
        if j == k:
            found -= dot / a.weight[j]
        elif j == l:
            found += dot / a.weight[j]
    return found


@compiled
def finish(count, p, w, a):
    """Solve exactly for the barriers that push less than they may, and the edges, if the sweeps have found which.

    Returns whether the solution is one: no push is negative, and no other barrier violated.
    """
    size, m = 0, p.graph.edges.shape[0]
    for k in range(count):
        if 0.0 < a.push[k] < a.most[k]:
            if size + m >= EXACT:
                return False
            a.active[size] = k
            size += 1
    whole = size + m
    if whole == 0:
        return False
    for x in range(whole):
        barrier = x < size
        k = a.active[x] if barrier else x - size
        i = a.rows[k, 0] if barrier else p.graph.edges[k, 0]
        j = a.rows[k, 1] if barrier else p.graph.edges[k, 1]
        n = a.normals[k] if barrier else w.u[k]
        for y in range(x + 1):
            other = y < size
            l = a.active[y] if other else y - size
            c = a.rows[l, 0] if other else p.graph.edges[l, 0]
            d = a.rows[l, 1] if other else p.graph.edges[l, 1]
            a.system[x, y] = entry(i, j, n, c, d, a.normals[l] if other else w.u[l], a)
        if not barrier:
            a.system[x, x] += softness(k, p, a)
        # What is left by the pushes found and by those at their bounds
        a.right[x] = -relative(i, j, n, a.shift)
        if barrier:
            a.right[x] += a.needed[k] - relative(i, j, n, a.wanted)
        else:
            a.right[x] -= softness(k, p, a) * a.pull[k]
    if not cholesky(a.system[:whole, :whole]):
        return False
    cholesky_solve(a.system[:whole, :whole], a.right[:whole])
    for x in range(size):
        push = a.push[a.active[x]] + a.right[x]
        if not 0.0 <= push <= a.most[a.active[x]]:
            return False
    for x in range(whole):
        k = a.active[x] if x < size else x - size
        if x < size:
            a.push[k] += a.right[x]
            shove(a.rows[k, 0], a.rows[k, 1], a.normals[k], a.right[x], a)
        else:
            a.pull[k] += a.right[x]
            shove(p.graph.edges[k, 0], p.graph.edges[k, 1], w.u[k], a.right[x], a)
    return True


@compiled
def solve_barriers(count, p, w, a):
    """Pushes of barriers, pulls of edges, and the changes of accelerations that they make (``shift``)."""
    for i in range(a.b.shape[0]):
        for q in range(3):
            a.shift[i, q] = 0.0
    for e in range(a.pull.shape[0]):
        a.pull[e] = 0.0
    for _ in range(3):
        change = _CLOSE
        for _ in range(_SWEEPS):
            change = sweep(count, p, w, a)
            if change < _CLOSE:
                return
        finish(count, p, w, a)  # a sweep after it tells whether that was all


@compiled
def limit(i, a):
    """Limit the thrust of an acceleration asked for."""
    c = a.wanted[i]
    size = math.sqrt(c[0] * c[0] + c[1] * c[1] + (c[2] + a.g) ** 2)
    if size > a.lift[i]:
        share = a.lift[i] / size
        c[0], c[1], c[2] = share * c[0], share * c[1], share * (c[2] + a.g) - a.g


@compiled
def filter_accelerations(t, r, v, lost, p, w, a):
    """Change what is asked for as little as possible, so that all barriers hold; returns whether any did not."""
    count, violated = list_barriers(r, v, lost, a)
    n = a.b.shape[0]
    if violated:
        solve_barriers(count, p, w, a)
    for i in range(n):
        for q in range(3):
            a.known[2, i, q] = 0.0
    for k in range(count if violated else 0):
        for side in range(2):
            i = a.rows[k, side]
            if i >= 0 and a.push[k] > 0.0:
                for q in range(3):
                    a.known[2, i, q] += (1 - 2 * side) * a.push[k] * a.normals[k, q]
    for i in range(n):
        push = a.known[2, i]
        pushed = math.sqrt(push[0] * push[0] + push[1] * push[1] + push[2] * push[2])
        if pushed > 0.0:
            a.acted[BARRIER, i] += 1
            a.first[BARRIER, i] = min(a.first[BARRIER, i], t)
        aim = 1.0 - min(1.0, pushed / (_FULL * a.weight[i] * a.b[i]))
        a.hold[i] += (aim - a.hold[i]) * min(1.0, a.period / a.release)
        if a.hold[i] > 1.0 - 1e-6:
            a.hold[i] = 1.0
        if violated:
            for q in range(3):
                a.wanted[i, q] += a.shift[i, q]
            limit(i, a)
    return violated
