"""Find the extremes of a flight in continuous time, over the steps of the integrator.

The integrator records every step in its `Trail`: the continuous extension of each state, a polynomial of fourth
degree, by its Bernstein coefficients (control points), and the forces at the end of the step.

Extremes of distances are exact: `kernel.bernstein` finds the least value of each curve. In the body formulation,
positions in the world are quartics through five points of each step. The steps are cut so short that these quartics
are exact to 1e-9 of the formation's size.

Forces are known where the law is evaluated: at the end of each step, and on both sides of a jump. If an end is higher
than both its neighbours, the law is evaluated in between, until the parabola through three values promises no further
rise: to 1e-5 of the value. What integration leaves of forces that are none is not searched: constraint forces and
tensions are found to 1e-9 of the greatest thrust if that is more, and constraint errors to 1e-9 m. In large formations,
whose multipliers are iterated, it is 1e-6 of that thrust, the accuracy that the solver's residual allows. Large
formations use a separate solver for these evaluations (`LargeSolver.thread_solver`), because a solver keeps state and
another thread calls the monitor. The flight is therefore the same to the bit with and without a monitor. The extremes
do not depend on where the trail is cut, because the order of evaluations does not.
"""

import math

from rigidfleet.kernel.bernstein import (
    ACCURACY,
    ball_radius,
    distance_to_box,
    gap_and_normal,
    least_height_in_cylinder,
    least_norm_above,
    least_norm_of_curve,
    least_polynomial_value,
    norm_at,
    point_at,
    write_bernstein_basis,
    write_squared_norm_coefficients,
)
from rigidfleet.kernel.compiler.jit import jit
from rigidfleet.kernel.gauge import write_watched_forces
from rigidfleet.kernel.linalg import copy_vector
from rigidfleet.kernel.outside import call_recorder
from rigidfleet.kernel.records import (
    ACCELERATION,
    CLEARANCE,
    CONSTRAINT,
    CONSTRAINT_FORCE,
    FIRST_ROW,
    FLYING,
    FROM_KNOTS,
    GEOFENCE,
    HIGHEST,
    HORIZONTAL_ACCELERATION,
    HORIZONTAL_SPEED,
    KNOTS,
    LOST,
    LOWEST,
    SEPARATION,
    SEPARATION_BELOW,
    SEPARATION_FLYING,
    SPEED,
    STANDING,
    STAYED,
    TENSION,
    THRUST,
    THRUST_MARGIN,
    TRAILED,
    VERTICAL_ACCELERATION,
    VERTICAL_SPEED,
)
from rigidfleet.kernel.rigid_body import attitude_matrix, inertia_inverse
from rigidfleet.solids.distance import STEEP, box_normal

#: Relative accuracy of a greatest force, direct and iterated; that of constraint forces and tensions next to nothing,
#: as a share of the greatest thrust, and of such constraint errors [m].
_CLOSE_FORCE, _CLOSE_ITERATED, _CLOSE_SMALL = 1e-7, 1e-6, 1e-12
#: Greatest rotation of one piece of a step in the body formulation [rad].
_TURN = 0.1
#: Least interval in which a peak of forces is searched, as a share of the whole interval.
_NARROW = 1e-3


@jit
def store_if_worse(kind, value, t, first, second, monitor):
    """Store a value that is worse than the worst one of its kind; a smaller ``value`` is worse."""
    if value < monitor.worst[kind]:
        monitor.worst[kind] = value
        monitor.when[kind] = t
        monitor.who[kind, 0], monitor.who[kind, 1] = first, second


# -- positions -----------------------------------------------------------------------------------------


@jit
def quaternion_rate_and_length(points, p):
    """Greatest rate, over a step, and least length of the quaternion of the body axes, by its control points."""
    first = 6 * p.vehicles.m.shape[0] + p.graph.edges.shape[0]
    fastest, least = 0.0, math.inf
    for k in range(5):
        squared_length = squared_rate = 0.0
        for s in range(first, first + 4):
            squared_length += points[k, s] ** 2
            squared_rate += (4.0 * (points[min(k + 1, 4), s] - points[k, s])) ** 2
        fastest, least = max(fastest, squared_rate), min(least, squared_length)
    return math.sqrt(fastest), math.sqrt(least)


@jit
def frame_rotation_bound(points, p):
    """Upper bound of the rotation [rad] of the axes of the states over a step: 0 in the inertial formulation."""
    if not p.body_formulation:
        return 0.0
    rate, length = quaternion_rate_and_length(points, p)
    return 2.0 * rate / max(length, 1e-3)


@jit
def count_pieces(angle):
    """Number of pieces into which a step is cut whose axes turn by an angle [rad]."""
    return int(min(max(1.0, math.ceil(angle / _TURN)), 1e4))


@jit
def write_body_frames(points, part, parts, p, monitor):
    """Attitude, centre and its velocity at five knots of a piece of a step, in the body formulation."""
    first = 6 * p.vehicles.m.shape[0] + p.graph.edges.shape[0]
    quaternion = monitor.scratch[0]
    for k in range(5):
        basis = monitor.basis[k]
        write_bernstein_basis((part + KNOTS[k]) / parts, basis)
        for s in range(4):
            quaternion[s] = bernstein_column_value(basis, points, first + s)
        for s in range(6):
            monitor.centres[k, s] = bernstein_column_value(basis, points, first + 4 + s)
        attitude_matrix(quaternion, monitor.attitudes[k])


@jit
def bernstein_column_value(basis, points, q):
    """Column q of control points (5, n) where a curve has the Bernstein polynomials ``basis`` (5,)."""
    value = 0.0
    for k in range(5):
        value += basis[k] * points[k, q]
    return value


@jit
def write_world_control_points(points, part, parts, p, monitor):
    """Write control points (5, 6N) of positions and velocities in the world over a piece of a step in body axes."""
    write_body_frames(points, part, parts, p, monitor)
    at_knots, in_body, out = monitor.knots, monitor.scratch[1], monitor.world
    n = p.vehicles.m.shape[0]
    for i in range(2 * n):  # positions, then velocities
        for k in range(5):
            T = monitor.attitudes[k]
            for q in range(3):
                in_body[q] = bernstein_column_value(monitor.basis[k], points, 3 * i + q)
            for q in range(3):
                at_knots[k, q] = monitor.centres[k, 3 * (i // n) + q]
                for s in range(3):
                    at_knots[k, q] += T[s, q] * in_body[s]
        for k in range(5):
            for q in range(3):
                out[k, 3 * i + q] = 0.0
                for j in range(5):
                    out[k, 3 * i + q] += FROM_KNOTS[k, j] * at_knots[j, q]


# -- distances ---------------------------------------------------------------------------------------


@jit
def centred_control_point(points, k, i, mean):
    """Control point k of agent i, from the mean of those of the agents that are monitored."""
    return (
        points[k, 3 * i] - mean[k, 0],
        points[k, 3 * i + 1] - mean[k, 1],
        points[k, 3 * i + 2] - mean[k, 2],
    )


@jit
def write_mean_control_points(points, monitor, mean):
    """Mean (5, 3) of the control points of the agents that are monitored."""
    count = 0
    for i in range(monitor.left.shape[0]):
        count += 1 if monitor.left[i] else 0
    for k in range(5):
        for q in range(3):
            total = 0.0
            for i in range(monitor.left.shape[0]):
                if monitor.left[i]:
                    total += points[k, 3 * i + q]
            mean[k, q] = total / count


@jit
def rotation_vector_over_step(points, mean, monitor):
    """Rotation [rad] about each axis by which agents turn about their mean over a step.

    It is that of a rigid body with their moment of momentum, for equal masses at the places halfway: no other leaves
    less of their motion, in the sum of squares.
    """
    xx = xy = xz = yy = yz = zz = moment_x = moment_y = moment_z = 0.0
    for i in range(monitor.left.shape[0]):
        if monitor.left[i]:
            x0, y0, z0 = centred_control_point(points, 0, i, mean)
            x1, y1, z1 = centred_control_point(points, 4, i, mean)
            x, y, z = 0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * (z0 + z1)
            dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
            xx, yy, zz = xx + y * y + z * z, yy + x * x + z * z, zz + x * x + y * y
            xy, xz, yz = xy - x * y, xz - x * z, yz - y * z
            moment_x += y * dz - z * dy
            moment_y += z * dx - x * dz
            moment_z += x * dy - y * dx
    I, inverse = monitor.attitudes[0], monitor.attitudes[1]
    I[0, 0], I[0, 1], I[0, 2] = xx, xy, xz
    I[1, 0], I[1, 1], I[1, 2] = xy, yy, yz
    I[2, 0], I[2, 1], I[2, 2] = xz, yz, zz
    inertia_inverse(I, inverse)
    return (
        inverse[0, 0] * moment_x + inverse[0, 1] * moment_y + inverse[0, 2] * moment_z,
        inverse[1, 0] * moment_x + inverse[1, 1] * moment_y + inverse[1, 2] * moment_z,
        inverse[2, 0] * moment_x + inverse[2, 1] * moment_y + inverse[2, 2] * moment_z,
    )


@jit
def write_first_step_change_bounds(p, state, monitor):
    """Bounds [m] of the change of any distance over the trail's first step, in space and as seen from above.

    They are written into ``monitor.moves``. With r_i' = any rigid motion + u_i, the rate of a distance is at most
    |u_i| + |u_j|, and |u_i| is at most its greatest Bernstein coefficient. The rotation is the one that leaves the
    smallest u_i. As seen from above, tilting rotations change distances, too.
    """
    points, mean = state.trail.points[trail_row_of(0, state)], monitor.knots
    write_mean_control_points(points, monitor, mean)
    turn_x, turn_y, turn_z = rotation_vector_over_step(points, mean, monitor)
    fastest = farthest = 0.0
    for i in range(monitor.left.shape[0]):
        if not monitor.left[i]:
            continue
        x, y, z = centred_control_point(points, 0, i, mean)
        before_x = before_y = before_z = 0.0
        for k in range(5):
            next_x, next_y, next_z = centred_control_point(points, min(k + 1, 4), i, mean)
            after_x, after_y, after_z = next_x - x, next_y - y, next_z - z
            # The rate of a quartic has, in quartic form, k (x_k - x_k-1) + (4 - k) (x_k+1 - x_k) as coefficients; the
            # rotation takes its cross product with the place from it.
            rate_x = k * before_x + (4 - k) * after_x - (turn_y * z - turn_z * y)
            rate_y = k * before_y + (4 - k) * after_y - (turn_z * x - turn_x * z)
            rate_z = k * before_z + (4 - k) * after_z - (turn_x * y - turn_y * x)
            fastest = max(fastest, rate_x * rate_x + rate_y * rate_y + rate_z * rate_z)
            farthest = max(farthest, x * x + y * y + z * z)
            x, y, z = next_x, next_y, next_z
            before_x, before_y, before_z = after_x, after_y, after_z
    tilt = math.hypot(turn_x, turn_y)
    if p.body_formulation:
        # The axes turn as well, and where the vertical is in them is not asked: any rotation may tilt. A quaternion
        # between its control points may be shorter than they are, hence the tenth.
        rate, length = quaternion_rate_and_length(points, p)
        turn = math.sqrt(turn_x * turn_x + turn_y * turn_y + turn_z * turn_z)
        tilt = 2.0 * rate / max(length - 0.1, 0.1) + turn
    # Of two agents, each may move by its part, and tilting moves each by at most its distance from the mean.
    monitor.moves[0] = 2.0 * math.sqrt(fastest)
    monitor.moves[1] = monitor.moves[0] + tilt * 2.0 * math.sqrt(farthest)


@jit
def enclose_agents_in_balls(points, monitor):
    """Balls about the agents' middle control points that hold their positions over a step."""
    for i in range(monitor.balls.shape[0]):
        curve, ball = points[:, 3 * i : 3 * i + 3], monitor.balls[i]
        copy_vector(curve[2], ball)
        ball[3] = ball_radius(curve)


@jit
def surely_apart(i, j, n_axes, reach, monitor):
    """Whether agents i and j stay at least ``reach`` [m] apart over a step, by balls, in the first ``n_axes`` axes.

    If so, their curves need not be compared. False does not say that they come closer.
    """
    balls = monitor.balls
    far, reach = 0.0, reach + balls[i, 3] + balls[j, 3] + ACCURACY
    for q in range(n_axes):
        x = balls[i, q] - balls[j, q]
        far += x * x
    return reach > 0.0 and far >= reach * reach


@jit
def watch_pairs(kind, pairs, points, t, h, monitor):
    """Least distance, or height, between the surfaces of pairs of agents (P, 2) over a step.

    Distances may be those in any axes; heights, and distances while one of the two is at the altitude that counts,
    are those of control points (5, n) in world axes.
    """
    below, flying = kind == SEPARATION_BELOW, kind == SEPARATION_FLYING
    axes, pieces = 2 if below else 3, monitor.pieces
    for k in range(pairs.shape[0]):
        i, j = pairs[k, 0], pairs[k, 1]
        # Surfaces that overlap count by how deep, so that the floor may be below the sum of the radii.
        radii = monitor.radius[i] + monitor.radius[j]
        floor = monitor.worst[kind] + radii
        if surely_apart(i, j, axes, radii if below else floor, monitor):
            continue
        own, other = points[:, 3 * i : 3 * i + 3], points[:, 3 * j : 3 * j + 3]
        for s in range(5):
            for q in range(3):
                pieces[0, 3 * s + q] = own[s, q] - other[s, q]
        if below:
            value, at = least_height_in_cylinder(radii, floor, pieces)
        elif flying:
            value, at = least_norm_above(own, other, monitor.altitude, floor, pieces)
        else:
            value, at = least_norm_of_curve(floor, monitor.work, pieces)
        if at >= 0.0:
            store_if_worse(kind, value - radii, t + at * h, i, j, monitor)


@jit
def watch_coordinate(kind, curve, axis, sign, offset, t, h, i, monitor):
    """Least of sign r[axis] - offset over a curve (5, 3)."""
    work, bound = monitor.work, math.inf
    for k in range(5):
        bound = min(bound, sign * curve[k, axis] - offset)
    if bound < monitor.worst[kind] - ACCURACY:
        for k in range(5):
            work[0, k] = sign * curve[k, axis] - offset
        value, at = least_polynomial_value(work, 4, monitor.worst[kind])
        if at >= 0.0:
            store_if_worse(kind, value, t + at * h, i, -1, monitor)


@jit
def watch_speed(kind, curve, low, high, t, h, i, monitor):
    """Greatest length of the coordinates from ``low`` to before ``high`` of a velocity over a curve (5, 3)."""
    fastest, piece = 0.0, monitor.pieces[0]
    for k in range(5):
        size = 0.0
        for q in range(low, high):
            size += curve[k, q] ** 2
        fastest = max(fastest, size)
    greatest = -monitor.worst[kind]  # -inf at first
    if fastest <= greatest * abs(greatest):
        return
    for k in range(5):
        for q in range(3):
            piece[3 * k + q] = curve[k, q] if low <= q < high else 0.0
    write_squared_norm_coefficients(piece, -1.0, monitor.work[0])
    _, at = least_polynomial_value(monitor.work, 8, -greatest * abs(greatest))
    if at >= 0.0:
        store_if_worse(kind, -norm_at(piece, at), t + at * h, i, -1, monitor)


@jit
def clearance_to_beat(i, monitor):
    """Clearance of agent i from which on it is worse than what is stored."""
    # A clearance is stored under three names, and is of no interest only if it is worse than none of them.
    own = monitor.worst[FLYING]
    if monitor.standing[i] != 0:
        own = max(own, monitor.worst[STANDING])
    return max(own, monitor.worst[CLEARANCE])


@jit
def store_obstacle_clearance(value, t, i, b, above, monitor):
    """Store the clearance of agent i to obstacle b; of one ``above`` it, which may be landing, until it leaves."""
    low = monitor.low
    store_if_worse(CLEARANCE, value, t, i, b, monitor)
    if not above:
        store_if_worse(FLYING, value, t, i, b, monitor)
    elif monitor.standing[i] != 0:
        store_if_worse(STANDING, value, t, i, b, monitor)
    elif value < low[i, 0]:
        low[i, 0], low[i, 1], low[i, 2] = value, t, float(b)


@jit
def note_obstacle_departure(i, monitor):
    """Agent i is away from all obstacles below it: it no longer stands on one, and was not landing."""
    low = monitor.low
    if monitor.standing[i] != 0:
        monitor.standing[i] = 0
    else:
        store_if_worse(FLYING, low[i, 0], low[i, 1], i, int(low[i, 2]), monitor)
        low[i, 0] = math.inf


@jit
def watch_obstacles(i, curve, t, h, last, monitor):
    """Clearance of agent i's surface to obstacles over a piece of a step; ``last`` is the clearance at its end.

    An agent that has been within ``pad`` of an obstacle below it since the start stands on it. A flying agent that
    comes this near may be landing; its clearance is stored separately until it moves away again. An obstacle is below
    where its outward normal points up by `STEEP` or more: nobody stands on the wall beside.
    """
    radius, standing = monitor.radius[i], monitor.standing[i] != 0
    x, y, z, span = curve[2, 0], curve[2, 1], curve[2, 2], monitor.balls[i, 3]
    floor = clearance_to_beat(i, monitor) + radius
    for b in range(monitor.boxes.shape[0]):
        box = monitor.boxes[b]
        far = max(0.0, box[0] - x, x - box[3]) ** 2 + max(0.0, box[1] - y, y - box[4]) ** 2
        far += max(0.0, box[2] - z, z - box[5]) ** 2
        if far >= (floor + span) ** 2 and floor + span > 0.0:  # far from the whole obstacle
            continue
        value, at = distance_to_box(curve, b, -1, floor, monitor.pieces, monitor.boxes)
        if at >= 0.0:
            x_near, y_near, z_near = point_at(curve, at)
            _, _, up = box_normal(x_near, y_near, z_near, box)
            store_obstacle_clearance(value - radius, t + at * h, i, b, up >= STEEP, monitor)
            floor = clearance_to_beat(i, monitor) + radius
    if not last or not (standing or monitor.low[i, 0] < math.inf):
        return
    for b in range(monitor.boxes.shape[0]):
        end, _, _, up = gap_and_normal(curve[4, 0], curve[4, 1], curve[4, 2], b, -1, monitor.boxes)
        if end - radius <= monitor.pad and up >= STEEP:
            return
    note_obstacle_departure(i, monitor)


@jit
def watch_trail_distances(first, end, p, state, monitor):
    """Take the extremes of distances and speeds over the steps of a trail from ``first`` to before ``end``."""
    for step in range(first, end):
        watch_distances_and_speeds(step, p, state, monitor)


@jit
def watch_distances_and_speeds(step, p, state, monitor):
    """Take the extremes of distances and speeds over one step of the trail."""
    trail, row, n = state.trail, trail_row_of(step, state), monitor.left.shape[0]
    points, t, h = trail.points[row], trail.clock[row, 0], trail.clock[row, 1]
    enclose_agents_in_balls(points, monitor)
    watch_pairs(SEPARATION, monitor.pairs, points, t, h, monitor)
    watch_pairs(LOST, monitor.struck, points, t, h, monitor)
    angle = frame_rotation_bound(points, p)
    parts = count_pieces(angle)
    h /= parts
    for part in range(parts):
        start = t + part * h
        world = monitor.world if p.body_formulation else points
        if p.body_formulation:
            write_world_control_points(points, part, parts, p, monitor)
            enclose_agents_in_balls(world, monitor)
        for i in range(n):
            if not monitor.left[i]:
                continue
            curve = world[:, 3 * (n + i) : 3 * (n + i) + 3]
            watch_speed(SPEED, curve, 0, 3, start, h, i, monitor)
            if monitor.worst[HORIZONTAL_SPEED] > -math.inf:
                watch_speed(HORIZONTAL_SPEED, curve, 0, 2, start, h, i, monitor)
                watch_speed(VERTICAL_SPEED, curve, 2, 3, start, h, i, monitor)
            curve = world[:, 3 * i : 3 * i + 3]
            watch_coordinate(LOWEST, curve, 2, 1.0, 0.0, start, h, i, monitor)
            watch_coordinate(HIGHEST, curve, 2, -1.0, 0.0, start, h, i, monitor)
            for f in range(monitor.fence.shape[0]):
                for q in range(3):
                    low, high = monitor.fence[f, q], monitor.fence[f, 3 + q]
                    watch_coordinate(GEOFENCE, curve, q, 1.0, low, start, h, i, monitor)
                    watch_coordinate(GEOFENCE, curve, q, -1.0, -high, start, h, i, monitor)
            if monitor.boxes.shape[0] > 0:
                watch_obstacles(i, curve, start, h, part == parts - 1, monitor)
        watch_pairs(SEPARATION_BELOW, monitor.columns, world, start, h, monitor)
        if monitor.altitude < math.inf:
            watch_pairs(SEPARATION_FLYING, monitor.pairs, world, start, h, monitor)


# -- forces ------------------------------------------------------------------------------------------


@jit
def update_force_extremes(values, t, p, monitor):
    """Take the forces of a gauge (3N + 2m or 5N + 2m,) at time t [s] into account."""
    n, edges = p.vehicles.m.shape[0], p.graph.edges
    m = edges.shape[0]
    for i in range(n):
        if monitor.left[i]:
            thrust = values[i]
            store_if_worse(THRUST, -thrust, t, i, -1, monitor)
            store_if_worse(THRUST_MARGIN, p.vehicles.thrust_limit[i] - thrust, t, i, -1, monitor)
            store_if_worse(ACCELERATION, -values[n + i], t, i, -1, monitor)
            store_if_worse(CONSTRAINT_FORCE, -values[2 * n + i], t, i, -1, monitor)
            if values.shape[0] > 3 * n + 2 * m:
                across, up = values[3 * n + 2 * m + i], values[4 * n + 2 * m + i]
                store_if_worse(HORIZONTAL_ACCELERATION, -across, t, i, -1, monitor)
                store_if_worse(VERTICAL_ACCELERATION, -abs(up), t, i, -1, monitor)
    for k in range(m):
        pull, c = values[3 * n + k], values[3 * n + m + k]
        if -abs(pull) < monitor.worst[TENSION]:
            monitor.sign[0] = 1.0 if pull > 0.0 else -1.0
        store_if_worse(TENSION, -abs(pull), t, edges[k, 0], edges[k, 1], monitor)
        store_if_worse(CONSTRAINT, -abs(c), t, edges[k, 0], edges[k, 1], monitor)


@jit
def write_worst_forces(p, monitor, out):
    """Write the greatest value so far of the quantity of each entry of a gauge; infinity for an agent that is lost."""
    n, m, worst = p.vehicles.m.shape[0], p.graph.edges.shape[0], monitor.worst
    for i in range(n):
        limit, left = p.vehicles.thrust_limit[i], monitor.left[i]
        beyond = limit - worst[THRUST_MARGIN] if limit < math.inf else math.inf
        out[i] = min(-worst[THRUST], beyond) if left else math.inf
        out[n + i] = -worst[ACCELERATION] if left else math.inf
        out[2 * n + i] = -worst[CONSTRAINT_FORCE] if left else math.inf
        if out.shape[0] > 3 * n + 2 * m:
            out[3 * n + 2 * m + i] = -worst[HORIZONTAL_ACCELERATION] if left else math.inf
            out[4 * n + 2 * m + i] = -worst[VERTICAL_ACCELERATION] if left else math.inf
    for k in range(m):
        out[3 * n + k], out[3 * n + m + k] = -worst[TENSION], -worst[CONSTRAINT]


@jit
def evaluate_forces(t, step, p, w, state, monitor, values):
    """Forces at time t [s], within a step of the trail, into a gauge."""
    trail, row = state.trail, trail_row_of(step, state)
    x = (t - trail.clock[row, 0]) / trail.clock[row, 1]
    basis, y = monitor.basis[0], monitor.states[0]
    write_bernstein_basis(min(max(x, 0.0), 1.0), basis)
    for q in range(y.shape[0]):
        y[q] = bernstein_column_value(basis, trail.points[row], q)
    monitor.time[0] = t
    # The recorder contains the compiled law; without rows to write, it leaves all values in the workspace.
    call_recorder(monitor.recorder, p, w, monitor.segment, monitor.record)
    write_watched_forces(p, w, values)
    update_force_extremes(values, t, p, monitor)


@jit
def parabola_excess_and_time(c, worst, a, b, v, ta, tb, tc, p, monitor):
    """Expected excess over the worst value, and its time, from the parabola through |values| a, b, v at ta < tb < tc.

    The excess of entry c is a share of the worst value, with the rise to the top of the parabola counted twice. It is
    not positive if there is nothing to expect.
    """
    # Newton's divided differences: slopes of the two chords, and half the second derivative.
    left, right = (b - a) / (tb - ta), (v - b) / (tc - tb)
    bend = (right - left) / (tc - ta)
    if not (left >= 0.0 and right <= 0.0 and bend < 0.0):
        return 0.0, tb
    top = 0.5 * (ta + tb) - 0.5 * left / bend
    gain = -bend * (top - tb) ** 2
    n, m, direct = p.vehicles.m.shape[0], p.graph.edges.shape[0], p.graph.solver == 0
    close = (_CLOSE_FORCE if direct else _CLOSE_ITERATED) * worst
    if 2 * n <= c < 3 * n + m:
        # Rounding and steps, or the solver's residual, make an error in proportion to the greatest force.
        close = max(close, (_CLOSE_SMALL if direct else _CLOSE_ITERATED) * -monitor.worst[THRUST])
    elif 3 * n + m <= c < 3 * n + 2 * m:
        close = max(close, _CLOSE_SMALL)
    beyond = b + 2.0 * gain - worst - close
    if not beyond > 0.0:
        return 0.0, tb
    short = 1e-3 * (tc - ta)  # points too close together give no information
    if abs(top - tb) < short:
        top = tb + short if tc - tb > tb - ta else tb - short
    return beyond / worst, top


@jit
def most_promising_peak(before, middle, after, ta, tb, tc, best, top, p, monitor):
    """The greatest `parabola_excess_and_time` of all entries, and its time; ``best`` and ``top`` if none is greater.

    Few entries pass the bound by the worst values, which are ``monitor.gauge[2]``.
    """
    # Twice the rise of a parabola above its middle value is at most the greater one of these shares of both falls.
    x, y = tb - ta, tc - tb
    left, right = 0.5 * y * y / (x * (x + y)), 0.5 * x * x / (y * (x + y))
    worst = monitor.gauge[2]
    for c in range(middle.shape[0]):
        a, b, v = abs(before[c]), abs(middle[c]), abs(after[c])
        if b + max(left * (b - a), right * (b - v)) > worst[c]:
            more, at = parabola_excess_and_time(c, worst[c], a, b, v, ta, tb, tc, p, monitor)
            if more > best:
                best, top = more, at
    return best, top


@jit
def search_force_peaks(before, middle, after, step, ta, tb, tc, p, w, state, monitor):
    """Search for the greatest forces between ta and tc, from gauges at ta < tb < tc.

    The law is evaluated where the parabola through three neighbouring values of an entry promises most. All entries
    are judged there: if thousands rise and fall together, a few evaluations are enough. The search ends when no
    parabola promises a further rise.
    """
    at, rank, values = monitor.instants, monitor.rank, monitor.nodes
    write_worst_forces(p, monitor, monitor.gauge[2])
    best, top = most_promising_peak(before, middle, after, ta, tb, tc, 0.0, tb, p, monitor)
    if best == 0.0:
        return
    for c in range(middle.shape[0]):
        values[0, c], values[1, c], values[2, c] = before[c], middle[c], after[c]
    for k in range(3):
        at[k], rank[k] = ta if k == 0 else tb if k == 1 else tc, k
    # Entries peak at different times: the most promising one is looked at first, and all are judged there.
    for count in range(3, at.shape[0]):
        in_step = step if top <= step_end_time(step, state) else step + 1
        evaluate_forces(top, in_step, p, w, state, monitor, values[count])
        write_worst_forces(p, monitor, monitor.gauge[2])
        # Into its place by time: values stay where they are, ``rank`` says their order.
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
            best, top = most_promising_peak(
                values[i], values[j], values[l], at[i], at[j], at[l], best, top, p, monitor
            )
        if best == 0.0:
            return


@jit
def trail_row_of(step, state):
    """Row of the trail that holds one of the steps in it, which are numbered from 0."""
    return (state.count[FIRST_ROW] + step) % state.trail.clock.shape[0]


@jit
def step_end_time(step, state):
    """Time [s] at which a step of the trail ends."""
    row = trail_row_of(step, state)
    return state.trail.clock[row, 0] + state.trail.clock[row, 1]


@jit
def watch_single_step_forces(step, before, after, p, w, state, monitor):
    """Search a step that has no neighbour, because of a jump or the end."""
    start, end = state.trail.clock[trail_row_of(step, state), 0], step_end_time(step, state)
    middle, values = 0.5 * (start + end), monitor.gauge[1]
    evaluate_forces(middle, step, p, w, state, monitor, values)
    search_force_peaks(before, values, after, step, start, middle, end, p, w, state, monitor)


@jit
def watch_forces(is_last, p, w, state, monitor):
    """Take the extremes of forces over the steps of a trail; with ``is_last``, no further step of the segment follows.

    Otherwise the last step stays in the trail: a peak at its end shows only once the next step is known.
    """
    trail, before, steps = state.trail, monitor.gauge[0], state.count[TRAILED]
    stayed = monitor.count[STAYED] == 1
    for step in range(steps):
        new = step > 0 or not stayed
        row = trail_row_of(step, state)
        start, end = trail.clock[row, 0], step_end_time(step, state)
        after = trail.gauge[row]
        earlier = trail.gauge[trail_row_of(step - 1, state)] if step > 0 else before
        if step == 0 and new:
            copy_vector(trail.start, before)
            update_force_extremes(before, start, p, monitor)
        if new:
            update_force_extremes(after, end, p, monitor)
        if step == 0 and new:
            watch_single_step_forces(0, before, after, p, w, state, monitor)
        if step + 1 < steps:
            then, until = trail.gauge[trail_row_of(step + 1, state)], step_end_time(step + 1, state)
            search_force_peaks(earlier, after, then, step, start, end, until, p, w, state, monitor)
        elif is_last and (step > 0 or not new):
            watch_single_step_forces(step, earlier, after, p, w, state, monitor)
    if is_last or steps == 0:
        monitor.count[STAYED], state.count[TRAILED] = 0, 0
    else:
        keep_only_last_step(steps, state, monitor)


@jit
def keep_only_last_step(steps, state, monitor):
    """Leave the last of the ``steps`` alone in the trail, and keep the forces at the end of the one before it."""
    if steps > 1:
        copy_vector(state.trail.gauge[trail_row_of(steps - 2, state)], monitor.gauge[0])
    state.count[FIRST_ROW] = trail_row_of(steps - 1, state)
    monitor.count[STAYED], state.count[TRAILED] = 1, 1
