"""Clearance to obstacles of every kind, still or moving, in continuous time, over the steps of the integrator.

Missions with none but boxes along the axes and grounds that stand still do not load this module: `kernel.monitor`
handles those. Otherwise it handles all, by the distance of `rigidfleet.solids.distance`, which is compiled here.

In the axes of an obstacle that moves straight, the path of an agent over a step is a polynomial of fourth degree; steps
are cut at waypoints. The signed distance to a convex solid is convex along the path, and nowhere below its tangent
plane. A height map is not convex, but each of its triangles is: outside, its distance is the least of theirs, and exact
to `bernstein.ACCURACY` as well. Inside, its depth is that at five points of each step, and its sign is certain.
"""

import math

from rigidfleet.kernel.bernstein import ball_radius, distance_to_box, point_at
from rigidfleet.kernel.compiler import elementwise  # noqa: F401 -- the functions of numbers below
from rigidfleet.kernel.compiler.jit import compiled_copy, jit
from rigidfleet.kernel.linalg import copy_vector
from rigidfleet.kernel.monitor import (
    clearance_to_beat,
    count_pieces,
    frame_rotation_bound,
    note_obstacle_departure,
    store_obstacle_clearance,
    write_world_control_points,
)
from rigidfleet.solids.distance import (
    box_distance,
    is_solid_below,
    is_solid_present,
    local_point,
    outward_normal,
    signed_distance,
    solid_displacement,
    triangle_vector_and_square,
)
from rigidfleet.solids.records import HEIGHTS

#: Length of the shortest piece of a step.
_SHORTEST = 2.0**-32


@jit
def solid_gap_and_normal(x, y, z, b, triangle, solids):
    """As `bernstein.gap_and_normal`, of solid b, or of one of its triangles if that is not -1."""
    if triangle < 0:
        nx, ny, nz = outward_normal(x, y, z, b, solids)
        return signed_distance(x, y, z, b, solids), nx, ny, nz
    nx, ny, nz, squared = triangle_vector_and_square(x, y, z, solids.triangles[triangle])
    away = math.sqrt(squared)
    if away == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    return away, nx / away, ny / away, nz / away


#: As `distance_to_box`, of solid b or of one of its triangles.
nearest_along = compiled_copy(distance_to_box, "nearest_along", gap_and_normal=solid_gap_and_normal)


@jit
def distance_to_height_map(curve, b, to_beat, pieces, solids):
    """The same for a height map: the least over its triangles near the curve, and inside the depth at five points."""
    best, at = to_beat, -1.0
    x, y, z, span = curve[2, 0], curve[2, 1], curve[2, 2], ball_radius(curve)
    node, last = solids.first[b, 0], solids.last[b, 0]
    while node < last:
        if box_distance(x, y, z, solids.nodes[node]) - span >= best:
            node = solids.after[node]
            continue
        for triangle in range(solids.leaf[node, 0], solids.leaf[node, 1]):
            value, place = nearest_along(curve, b, triangle, best, pieces, solids)
            if place >= 0.0:
                best, at = value, place
        node += 1
    for k in range(5):
        share = 0.25 * k
        x, y, z = point_at(curve, share)
        value = signed_distance(x, y, z, b, solids)
        if value < best:
            best, at = value, share
    return best, at


@jit
def cut_curve(curve, start, end, work, out):
    """Control points (5, 3) of the part of a curve between two places, by its blossom."""
    for k in range(5):
        for q in range(3):
            copy_vector(curve[:, q], work)
            for level in range(4):
                x = end if level < k else start
                for i in range(4 - level):
                    work[i] = (1.0 - x) * work[i] + x * work[i + 1]
            out[k, q] = work[0]


@jit
def write_curve_in_solid_axes(curve, t, h, b, solids, out):
    """Control points (5, 3) in the axes of solid b, which moves straight from t to t + h."""
    x0, y0, z0 = solid_displacement(t, b, solids)
    x1, y1, z1 = solid_displacement(t + h, b, solids)
    for k in range(5):
        share = 0.25 * k
        x = curve[k, 0] - (x0 + share * (x1 - x0))
        y = curve[k, 1] - (y0 + share * (y1 - y0))
        z = curve[k, 2] - (z0 + share * (z1 - z0))
        out[k, 0], out[k, 1], out[k, 2] = local_point(x, y, z, b, solids)


@jit
def point_in_solid_axes(x, y, z, t, b, solids):
    """Coordinates of a point of the world in the axes of solid b at time t [s]."""
    u, v, w = solid_displacement(t, b, solids)
    return local_point(x - u, y - v, z - w, b, solids)


@jit
def watch_solid(i, b, curve, t, h, solids, monitor):
    """Clearance of agent i's surface to solid b over a piece of a step."""
    radius, part, own = monitor.radius[i], monitor.curves[0], monitor.curves[1]
    start, stop, way, last = 0.0, 1.0, solids.first[b, 3], solids.last[b, 3]
    if solids.there[b, 0] > t:
        start = (solids.there[b, 0] - t) / h
    if solids.there[b, 1] < t + h:
        stop = (solids.there[b, 1] - t) / h
    while start < stop:
        end = stop
        while way < last and solids.times[way] <= t + start * h:
            way += 1
        if way < last and solids.times[way] < t + h:
            end = min(stop, max((solids.times[way] - t) / h, start + _SHORTEST))
        if start > 0.0 or end < 1.0:
            cut_curve(curve, start, end, monitor.scratch[2], part)
            write_curve_in_solid_axes(part, t + start * h, (end - start) * h, b, solids, own)
        else:
            write_curve_in_solid_axes(curve, t, h, b, solids, own)
        x, y, z = own[2, 0], own[2, 1], own[2, 2]
        floor, span = clearance_to_beat(i, monitor) + radius, ball_radius(own)
        if not (floor < math.inf and distance_bound(x, y, z, b, solids) - span >= floor):
            if solids.kind[b] == HEIGHTS:
                value, at = distance_to_height_map(own, b, floor, monitor.pieces, solids)
            else:
                value, at = nearest_along(own, b, -1, floor, monitor.pieces, solids)
            if at >= 0.0:
                share = start + at * (end - start)
                x, y, z = point_at(curve, share)
                above = is_solid_below(x, y, z, b, solids)
                store_obstacle_clearance(value - radius, t + share * h, i, b, above, monitor)
        start = end


@jit
def distance_bound(x, y, z, b, solids):
    """Lower bound of the distance of a point from solid b, in its axes: that from the box around it."""
    if solids.leaf.shape[0] > 0 and solids.last[b, 0] > solids.first[b, 0]:
        return box_distance(x, y, z, solids.size[b])
    return signed_distance(x, y, z, b, solids)


@jit
def watch_departure(i, curve, t, s, monitor):
    """At the end (time t) of a step, tell whether agent i has left all obstacles below it."""
    if not (monitor.standing[i] != 0 or monitor.low[i, 0] < math.inf):
        return
    for b in range(s.kind.shape[0]):
        if not is_solid_present(t, b, s):
            continue
        u, v, w = curve[4, 0], curve[4, 1], curve[4, 2]
        x, y, z = point_in_solid_axes(u, v, w, t, b, s)
        near = monitor.radius[i] + monitor.pad
        if distance_bound(x, y, z, b, s) > near or signed_distance(x, y, z, b, s) > near:
            continue
        if is_solid_below(u, v, w, b, s):
            return
    note_obstacle_departure(i, monitor)


@jit
def watch_clearances(points, start, length, p, solids, monitor):
    """Take the clearances of a step from ``start`` of a ``length`` [s]: control points (5, n) of the states."""
    parts = count_pieces(frame_rotation_bound(points, p))
    h = length / parts
    for part in range(parts):
        t = start + part * h
        world = monitor.world if p.body_formulation else points
        if p.body_formulation:
            write_world_control_points(points, part, parts, p, monitor)
        for i in range(monitor.left.shape[0]):
            if not monitor.left[i]:
                continue
            curve = world[:, 3 * i : 3 * i + 3]
            for b in range(solids.kind.shape[0]):
                watch_solid(i, b, curve, t, h, solids, monitor)
            if part == parts - 1:
                watch_departure(i, curve, t + h, solids, monitor)
