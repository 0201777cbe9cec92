"""Find the extremes of a flight in continuous time, over the steps of the integrator.

The integrator records every step in its `Trail`: the continuous extension of each state, a polynomial of fourth
degree, by its Bernstein coefficients (control points), and the forces at the end of the step.

Extremes of distances are exact: `kernel.bernstein` finds the least value of each curve. In the body formulation,
positions in the world are quartics through five points of each step. The steps are cut so short that these quartics
are exact to 1e-9 of the formation's size.

Forces are known where the law is evaluated: at the end of each step, and on both sides of a jump. If an end is higher
than both its neighbours, the law is evaluated in between, until the parabola through three values promises no further
rise: to 1e-5 of the value. The same holds for large formations, whose multipliers are iterated, with one exception:
constraint forces and tensions below a tenth of the greatest thrust are found to 1e-6 of that thrust, the accuracy that
the solver's residual allows. Large formations use a separate solver for these evaluations (`LargeSolver.aside`),
because a solver keeps state and another thread calls the monitor. The flight is therefore the same to the bit with and
without a monitor. The extremes do not depend on where the trail is cut, because the order of evaluations does not.
"""

import math

from rigidfleet.kernel.bernstein import (
    CLOSE,
    from_box,
    length_at,
    lowest,
    lowest_overlap,
    nearest_box,
    shortest,
    square,
    weights,
)
from rigidfleet.kernel.compiler.jit import compiled
from rigidfleet.kernel.gauge import read_gauge
from rigidfleet.kernel.outside import call_recorder
from rigidfleet.kernel.records import (
    ACCELERATION,
    CLEARANCE,
    CONSTRAINT,
    CONSTRAINT_FORCE,
    FLYING,
    FROM_KNOTS,
    GEOFENCE,
    HIGHEST,
    KNOTS,
    LOST,
    LOWEST,
    SEPARATION,
    SEPARATION_BELOW,
    SPEED,
    STANDING,
    TENSION,
    THRUST,
    THRUST_MARGIN,
)

#: Relative accuracy of a greatest force, direct and iterated.
_CLOSE_FORCE, _CLOSE_ITERATED = 1e-7, 1e-6
#: Greatest rotation of one piece of a step in the body formulation [rad].
_TURN = 0.1
#: Least interval in which a peak of forces is searched, as a share of the whole interval.
_NARROW = 1e-3


@compiled
def take(kind, key, t, first, second, monitor):
    """Store a value that is worse than the worst one of its kind; a smaller ``key`` is worse."""
    if key < monitor.worst[kind]:
        monitor.worst[kind] = key
        monitor.when[kind] = t
        monitor.who[kind, 0], monitor.who[kind, 1] = first, second


# -- positions -----------------------------------------------------------------------------------------


@compiled
def angle_of(points, p):
    """Upper bound of the rotation [rad] of the body frame over a step."""
    n = p.vehicles.m.shape[0]
    q = 6 * n + p.graph.edges.shape[0]
    fastest, size = 0.0, math.inf
    for k in range(5):
        here, rate = 0.0, 0.0
        for s in range(4):
            here += points[k, q + s] * points[k, q + s]
            if k < 4:
                d = 4.0 * (points[k + 1, q + s] - points[k, q + s])
                rate += d * d
        fastest, size = max(fastest, rate), min(size, here)
    return 2.0 * math.sqrt(fastest) / max(math.sqrt(size), 1e-3)


@compiled
def attitudes(points, part, parts, p, monitor):
    """Attitude, centre and its velocity at five knots of a piece of a step, in the body formulation."""
    n = p.vehicles.m.shape[0]
    first = 6 * n + p.graph.edges.shape[0]
    state = monitor.scratch[0]
    for k in range(5):
        basis, pose = monitor.basis[k], monitor.poses[k]
        weights((part + KNOTS[k]) / parts, basis)
        size = 0.0
        for s in range(10):
            state[s] = 0.0
            for j in range(5):
                state[s] += basis[j] * points[j, first + s]
        for s in range(4):
            size += state[s] * state[s]
        size = 1.0 / math.sqrt(size)
        a, b, c, d = state[0] * size, state[1] * size, state[2] * size, state[3] * size
        # Columns of T^T, body -> world (the quaternion of Eq. (21), scalar first).
        pose[0], pose[1], pose[2] = (
            1 - 2 * (c * c + d * d),
            2 * (b * c - a * d),
            2 * (b * d + a * c),
        )
        pose[3], pose[4], pose[5] = (
            2 * (b * c + a * d),
            1 - 2 * (b * b + d * d),
            2 * (c * d - a * b),
        )
        pose[6], pose[7], pose[8] = (
            2 * (b * d - a * c),
            2 * (c * d + a * b),
            1 - 2 * (b * b + c * c),
        )
        for s in range(6):
            pose[9 + s] = state[4 + s]


@compiled
def in_world(points, i, moving, p, monitor, out):
    """Control points (5, 3) of agent i's position in the world, or of its velocity (``moving`` 1)."""
    n = p.vehicles.m.shape[0]
    first = 3 * i + 3 * n * moving
    if not p.body_formulation:
        for k in range(5):
            for q in range(3):
                out[k, q] = points[k, first + q]
        return
    at, x = monitor.knots, monitor.scratch[1]
    for k in range(5):
        basis, pose = monitor.basis[k], monitor.poses[k]
        for q in range(3):
            x[q] = 0.0
            for j in range(5):
                x[q] += basis[j] * points[j, first + q]
        for q in range(3):
            at[k, q] = pose[9 + 3 * moving + q]
            for s in range(3):
                at[k, q] += pose[3 * q + s] * x[s]
    for k in range(5):
        for q in range(3):
            out[k, q] = 0.0
            for j in range(5):
                out[k, q] += FROM_KNOTS[k, j] * at[j, q]


# -- distances ---------------------------------------------------------------------------------------


@compiled
def span_of(curve):
    """Radius [m] of a ball about the middle control point that holds a curve with control points (5, 3)."""
    far = 0.0
    for k in range(5):
        x, y, z = curve[k, 0] - curve[2, 0], curve[k, 1] - curve[2, 1], curve[k, 2] - curve[2, 2]
        far = max(far, x * x + y * y + z * z)
    return math.sqrt(far)


@compiled
def place(points, monitor):
    """Control points of all agents' positions over a step, in the axes of the states, and their spans."""
    for i in range(monitor.places.shape[0]):
        curve = monitor.places[i]
        for k in range(5):
            for q in range(3):
                curve[k, q] = points[k, 3 * i + q]
        monitor.span[i] = span_of(curve)


@compiled
def apart(i, j, axes, reach, monitor):
    """Whether agents i and j stay at least ``reach`` [m] apart over a step, by their balls, along the first ``axes``.

    If so, their curves need not be compared. False does not say that they come closer.
    """
    far, reach = 0.0, reach + monitor.span[i] + monitor.span[j] + CLOSE
    for q in range(axes):
        x = monitor.places[i, 2, q] - monitor.places[j, 2, q]
        far += x * x
    return reach > 0.0 and far >= reach * reach


@compiled
def between(i, j, monitor):
    """Control points (5, 3) of r_i - r_j, into ``monitor.curve``."""
    for k in range(5):
        for q in range(3):
            monitor.curve[k, q] = monitor.places[i, k, q] - monitor.places[j, k, q]


@compiled
def watch_pairs(kind, pairs, t, h, monitor):
    """Least distance between the surfaces of pairs of agents (P, 2) over a step."""
    for k in range(pairs.shape[0]):
        i, j = pairs[k, 0], pairs[k, 1]
        radii = monitor.radius[i] + monitor.radius[j]
        floor = monitor.worst[kind] + radii
        if apart(i, j, 3, floor, monitor):
            continue
        between(i, j, monitor)
        value, at = shortest(monitor.curve, floor, monitor.work, monitor.pieces)
        if at >= 0.0:
            take(kind, value - radii, t + at * h, i, j, monitor)


@compiled
def watch_stacks(t, h, monitor):
    """Least height between the surfaces of two agents, one below the other, over a step."""
    for k in range(monitor.columns.shape[0]):
        i, j = monitor.columns[k, 0], monitor.columns[k, 1]
        radii = monitor.radius[i] + monitor.radius[j]
        if apart(i, j, 2, radii, monitor):
            continue
        between(i, j, monitor)
        floor = monitor.worst[SEPARATION_BELOW] + radii
        value, at = lowest_overlap(monitor.curve, radii, floor, monitor.pieces)
        if at >= 0.0:
            take(SEPARATION_BELOW, value - radii, t + at * h, i, j, monitor)


@compiled
def watch_coordinate(kind, curve, axis, sign, offset, t, h, i, monitor):
    """Least of sign r[axis] - offset over a curve (5, 3)."""
    work, bound = monitor.work, math.inf
    for k in range(5):
        work[0, k] = sign * curve[k, axis] - offset
        bound = min(bound, work[0, k])
    if bound < monitor.worst[kind] - CLOSE:
        value, at = lowest(work, 4, monitor.worst[kind])
        if at >= 0.0:
            take(kind, value, t + at * h, i, -1, monitor)


@compiled
def clearance_of_interest(i, monitor):
    """Clearance of agent i from which on it is worse than what is stored."""
    own = min(monitor.low[i, 0], monitor.worst[FLYING])
    if monitor.standing[i] != 0:
        own = monitor.worst[STANDING]
    return max(own, monitor.worst[CLEARANCE])


@compiled
def take_clearance(value, t, i, b, monitor):
    """Store the clearance of agent i to obstacle b; of one that may be landing, until it leaves."""
    low = monitor.low
    take(CLEARANCE, value, t, i, b, monitor)
    if monitor.standing[i] != 0:
        take(STANDING, value, t, i, b, monitor)
    elif value < low[i, 0]:
        low[i, 0], low[i, 1], low[i, 2] = value, t, float(b)


@compiled
def leave(i, monitor):
    """Agent i is away from all obstacles: it no longer stands on one, and was not landing."""
    low = monitor.low
    if monitor.standing[i] != 0:
        monitor.standing[i] = 0
    else:
        take(FLYING, low[i, 0], low[i, 1], i, int(low[i, 2]), monitor)
        low[i, 0] = math.inf


@compiled
def watch_obstacles(i, curve, t, h, last, monitor):
    """Clearance of agent i's surface to obstacles over a piece of a step; ``last`` is the clearance at its end.

    An agent that has been within ``pad`` of an obstacle since the start stands on it. A flying agent that comes this
    near may be landing; its clearance is stored separately until it moves away again.
    """
    radius, standing = monitor.radius[i], monitor.standing[i] != 0
    low, normal = monitor.low, monitor.scratch[2]
    x, y, z, span = curve[2, 0], curve[2, 1], curve[2, 2], monitor.span[i]
    for b in range(monitor.boxes.shape[0]):
        box = monitor.boxes[b]
        floor = clearance_of_interest(i, monitor) + radius
        far = max(0.0, box[0] - x, x - box[3]) ** 2 + max(0.0, box[1] - y, y - box[4]) ** 2
        far += max(0.0, box[2] - z, z - box[5]) ** 2
        if far >= (floor + span) ** 2 and floor + span > 0.0:  # far from the whole obstacle
            continue
        value, at = nearest_box(curve, box, floor, monitor.pieces, normal)
        if at >= 0.0:
            take_clearance(value - radius, t + at * h, i, b, monitor)
    if not last or not (standing or low[i, 0] < math.inf):
        return
    for b in range(monitor.boxes.shape[0]):
        end = from_box(curve[4, 0], curve[4, 1], curve[4, 2], monitor.boxes[b], normal)
        if end - radius <= monitor.pad:
            return
    leave(i, monitor)


@compiled
def watch_distances(row, p, state, monitor):
    """Monitor distances and speeds over one step of the trail."""
    trail = state.trail
    points, t, h = trail.points[row], trail.clock[row, 0], trail.clock[row, 1]
    place(points, monitor)
    watch_pairs(SEPARATION, monitor.pairs, t, h, monitor)
    watch_pairs(LOST, monitor.struck, t, h, monitor)
    parts = 1
    if p.body_formulation:
        parts = int(min(max(1.0, math.ceil(angle_of(points, p) / _TURN)), 1e4))
    h /= parts
    for part in range(parts):
        start = t + part * h
        if p.body_formulation:
            attitudes(points, part, parts, p, monitor)
        for i in range(monitor.left.shape[0]):
            if not monitor.left[i]:
                continue
            curve = monitor.curve
            in_world(points, i, 1, p, monitor, curve)
            fastest = 0.0
            for k in range(5):
                size = 0.0
                for q in range(3):
                    size += curve[k, q] * curve[k, q]
                fastest = max(fastest, size)
            greatest = -monitor.worst[SPEED]  # -inf at first
            if not fastest <= greatest * abs(greatest):
                piece = monitor.pieces[0]
                for k in range(5):
                    for q in range(3):
                        piece[3 * k + q] = curve[k, q]
                square(piece, -1.0, monitor.work[0])
                floor = -greatest * abs(greatest)
                _, at = lowest(monitor.work, 8, floor)
                if at >= 0.0:
                    take(SPEED, -length_at(piece, at), start + at * h, i, -1, monitor)
            curve = monitor.places[i]
            if p.body_formulation:
                in_world(points, i, 0, p, monitor, curve)
                monitor.span[i] = span_of(curve)
            watch_coordinate(LOWEST, curve, 2, 1.0, 0.0, start, h, i, monitor)
            watch_coordinate(HIGHEST, curve, 2, -1.0, 0.0, start, h, i, monitor)
            for f in range(monitor.fence.shape[0]):
                for q in range(3):
                    low, high = monitor.fence[f, q], monitor.fence[f, 3 + q]
                    watch_coordinate(GEOFENCE, curve, q, 1.0, low, start, h, i, monitor)
                    watch_coordinate(GEOFENCE, curve, q, -1.0, -high, start, h, i, monitor)
            if monitor.boxes.shape[0] > 0:
                watch_obstacles(i, curve, start, h, part == parts - 1, monitor)
        if monitor.columns.shape[0] > 0:
            watch_stacks(start, h, monitor)


# -- forces ------------------------------------------------------------------------------------------


@compiled
def judge_forces(values, t, p, monitor):
    """Take the forces of a gauge (3N + 2m,) at time t [s] into account."""
    n, edges = p.vehicles.m.shape[0], p.graph.edges
    m = edges.shape[0]
    for i in range(n):
        if monitor.left[i]:
            thrust = values[i]
            take(THRUST, -thrust, t, i, -1, monitor)
            take(THRUST_MARGIN, p.vehicles.thrust_limit[i] - thrust, t, i, -1, monitor)
            take(ACCELERATION, -values[n + i], t, i, -1, monitor)
            take(CONSTRAINT_FORCE, -values[2 * n + i], t, i, -1, monitor)
    for k in range(m):
        pull, c = values[3 * n + k], values[3 * n + m + k]
        if -abs(pull) < monitor.worst[TENSION]:
            monitor.sign[0] = 1.0 if pull > 0.0 else -1.0
        take(TENSION, -abs(pull), t, edges[k, 0], edges[k, 1], monitor)
        take(CONSTRAINT, -abs(c), t, edges[k, 0], edges[k, 1], monitor)


@compiled
def worst_of(c, p, monitor):
    """The greatest value so far of the quantity of entry c of a gauge."""
    n, m = p.vehicles.m.shape[0], p.graph.edges.shape[0]
    if c < 3 * n and not monitor.left[c % n]:
        return math.inf
    if c < n:
        limit = p.vehicles.thrust_limit[c]
        beyond = limit - monitor.worst[THRUST_MARGIN] if limit < math.inf else math.inf
        return min(-monitor.worst[THRUST], beyond)
    if c < 2 * n:
        return -monitor.worst[ACCELERATION]
    if c < 3 * n:
        return -monitor.worst[CONSTRAINT_FORCE]
    return -monitor.worst[TENSION if c < 3 * n + m else CONSTRAINT]


@compiled
def evaluate(t, row, p, w, state, monitor, values):
    """Forces at time t [s], within a step of the trail, into a gauge."""
    trail = state.trail
    x = (t - trail.clock[row, 0]) / trail.clock[row, 1]
    basis, y = monitor.basis[0], monitor.states[0]
    weights(min(max(x, 0.0), 1.0), basis)
    for q in range(y.shape[0]):
        y[q] = 0.0
        for k in range(5):
            y[q] += basis[k] * trail.points[row, k, q]
    monitor.time[0] = t
    # The recorder contains the compiled law; without rows to write, it leaves all values in the workspace.
    call_recorder(monitor.recorder, p, w, monitor.segment, monitor.record)
    read_gauge(p, w, values)
    judge_forces(values, t, p, monitor)


@compiled
def promise(c, a, b, v, ta, tb, tc, p, monitor):
    """Expected excess over the worst value, and its time, from the parabola through |values| a, b, v at ta < tb < tc.

    The excess of entry c is a share of the worst value, with the rise to the top of the parabola counted twice. It is
    not positive if there is nothing to expect.
    """
    left, right = (b - a) / (tb - ta), (v - b) / (tc - tb)
    bend = (right - left) / (tc - ta)
    if not (left >= 0.0 and right <= 0.0 and bend < 0.0):
        return 0.0, tb
    top = 0.5 * (ta + tb) - 0.5 * left / bend
    gain = -bend * (top - tb) ** 2
    worst = worst_of(c, p, monitor)
    close = _CLOSE_FORCE * worst
    if p.graph.solver != 0:
        # The solver's residual makes an error of constraint forces and tensions in proportion to the greatest force.
        n, m = p.vehicles.m.shape[0], p.graph.edges.shape[0]
        within = 2 * n <= c < 3 * n + m
        close = _CLOSE_ITERATED * (max(worst, -monitor.worst[THRUST]) if within else worst)
    beyond = b + 2.0 * gain - worst - close
    if not beyond > 0.0:
        return 0.0, tb
    short = 1e-3 * (tc - ta)  # points too close together give no information
    if abs(top - tb) < short:
        top = tb + short if tc - tb > tb - ta else tb - short
    return beyond / worst, top


@compiled
def look_between(before, middle, after, row, ta, tb, tc, p, w, state, monitor):
    """Search for the greatest forces between ta and tc, from gauges at ta < tb < tc.

    The law is evaluated where the parabola through three neighbouring values of an entry promises most. All entries
    are judged there: if thousands rise and fall together, a few evaluations are enough. The search ends when no
    parabola promises a further rise.
    """
    at, rank, values = monitor.instants, monitor.rank, monitor.nodes
    best, top = 0.0, tb
    for c in range(middle.shape[0]):
        a, b, v = abs(before[c]), abs(middle[c]), abs(after[c])
        if b >= a and b >= v:
            more, x = promise(c, a, b, v, ta, tb, tc, p, monitor)
            if more > best:
                best, top = more, x
    if best == 0.0:
        return
    for c in range(middle.shape[0]):
        values[0, c], values[1, c], values[2, c] = before[c], middle[c], after[c]
    for k in range(3):
        at[k], rank[k] = ta if k == 0 else tb if k == 1 else tc, k
    for count in range(3, at.shape[0]):
        evaluate(
            top, row if top <= end_of(row, state) else row + 1, p, w, state, monitor, values[count]
        )
        k = count
        while at[rank[k - 1]] > top:
            rank[k] = rank[k - 1]
            k -= 1
        at[count], rank[k] = top, count
        best = 0.0
        for k in range(1, count):
            i, j, l = rank[k - 1], rank[k], rank[k + 1]
            if at[l] - at[i] < _NARROW * (tc - ta):
                continue
            for c in range(middle.shape[0]):
                a, b, v = abs(values[i, c]), abs(values[j, c]), abs(values[l, c])
                if b >= a and b >= v:
                    more, x = promise(c, a, b, v, at[i], at[j], at[l], p, monitor)
                    if more > best:
                        best, top = more, x
        if best == 0.0:
            return


@compiled
def end_of(row, state):
    """Time [s] at which a step of the trail ends."""
    return state.trail.clock[row, 0] + state.trail.clock[row, 1]


@compiled
def watch_middle(row, before, after, p, w, state, monitor):
    """Search a step that has no neighbour, because of a jump or the end."""
    start, end = state.trail.clock[row, 0], end_of(row, state)
    middle, values = 0.5 * (start + end), monitor.gauge[1]
    evaluate(middle, row, p, w, state, monitor, values)
    look_between(before, values, after, row, start, middle, end, p, w, state, monitor)


@compiled
def watch_forces(p, w, state, monitor, rows, last):
    """Monitor forces over the steps of a trail; with ``last``, no further step of the segment follows."""
    trail, before = state.trail, monitor.gauge[0]
    for row in range(rows):
        new = row > 0 or monitor.flags[3] == 0
        start, end = trail.clock[row, 0], end_of(row, state)
        after = trail.gauge[row]
        a_row = trail.gauge[row - 1] if row > 0 else before
        if row == 0 and new:
            for c in range(before.shape[0]):
                before[c] = trail.start[c]
            judge_forces(before, start, p, monitor)
        if new:
            judge_forces(after, end, p, monitor)
        if row == 0 and new:
            watch_middle(0, before, after, p, w, state, monitor)
        if row + 1 < rows:
            then, until = trail.gauge[row + 1], end_of(row + 1, state)
            look_between(a_row, after, then, row, start, end, until, p, w, state, monitor)
        elif last and (row > 0 or not new):
            watch_middle(row, a_row, after, p, w, state, monitor)


# -- entry point ------------------------------------------------------------------------------------


@compiled
def watch(p, w, state, monitor):
    """Take the extremes of the steps in a trail.

    Distances are monitored for the steps from ``monitor.flags[0]`` to before ``flags[1]``. ``flags[2]`` chooses the
    forces: none (0); all but the last step, which stays in the trail until its neighbour is known (1); or all steps,
    because none follows (2). ``flags[3]`` is 1 if a step has stayed in the trail.
    """
    trail, flags = state.trail, monitor.flags
    for row in range(flags[0], flags[1]):
        watch_distances(row, p, state, monitor)
    if flags[2] == 0:
        return 0
    rows, last = state.count[4], flags[2] == 2
    watch_forces(p, w, state, monitor, rows, last)
    if last or rows == 0:
        flags[3], state.count[4] = 0, 0
        return 0
    if rows > 1:
        copy(trail.gauge[rows - 2 : rows - 1], monitor.gauge)
        copy(trail.gauge[rows - 1 :], trail.gauge[:1])
        copy(trail.clock[rows - 1 :], trail.clock[:1])
        copy(trail.points[rows - 1], trail.points[0])
    flags[3], state.count[4] = 1, 1
    return 0


@compiled
def copy(a, out):
    """Copy rows of a into out, as many as both have."""
    for k in range(min(a.shape[0], out.shape[0])):
        for c in range(a.shape[1]):
            out[k, c] = a[k, c]
