"""Distances to solids, against independent oracles; missions, flights, checks and pictures with every kind of them."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.spatial import ConvexHull

from rigidfleet import assess, simulate
from rigidfleet.errors import MissionError
from rigidfleet.math import proximity
from rigidfleet.math.attitude import dcm_from_euler
from rigidfleet.mission import Mission, load_mission
from rigidfleet.mission.obstacles import Box
from rigidfleet.plotting import plot, space
from rigidfleet.preflight.check import check
from rigidfleet.result import Result
from rigidfleet.solids import distance, records
from rigidfleet.solids.outline import outline_of_solid
from rigidfleet.web.replay import scene

RNG = np.random.default_rng(5)
POINTS = RNG.normal(size=(24, 3))
TURN = dcm_from_euler([0.4, -0.7, 1.9])
ENDS = np.array([[0.5, -1.0, 0.2], [1.5, 1.0, 2.0]])
MAP = RNG.uniform(0.0, 1.5, (6, 8))
FORMS = {
    "box": records.box([-1.0, -2.0, 0.0], [1.5, 1.0, 0.8]),
    "turned box": records.box([-1.0, -2.0, 0.0], [1.5, 1.0, 0.8], TURN),
    "ground": records.half_space(0.3),
    "sphere": records.ball([0.3, -0.2, 0.5], 0.9),
    "cylinder": records.cylinder(ENDS, 0.7),
    "hull": records.hull(POINTS),
    "heights": records.height_map([-1.5, -2.0], [0.6, 0.6], MAP, -1.0),
}
WHERE = RNG.normal(size=(3, 300)) * 1.6


def of(form: records.Form, points) -> np.ndarray:
    """Signed distances (K,) of points (3, K)."""
    return proximity.distances(*np.asarray(points, dtype=float), records.one_solid(form))


def to_half_spaces(A, b, points) -> np.ndarray:
    """Distances of points (K, 3) from {y: A y + b <= 0}, by least distance programming (Lawson and Hanson, 1974)."""
    found = []
    for x in points:
        h = A @ x + b
        if (h <= 0).all():
            found.append(0.0)
            continue
        E = np.vstack([-A.T, h])
        r = E @ nnls(E, [0, 0, 0, 1.0], maxiter=1000)[0] - [0, 0, 0, 1.0]
        found.append(np.linalg.norm(r[:3] / r[3]))
    return np.array(found)


def test_a_hull_is_as_far_as_a_quadratic_program_says_and_as_deep_as_its_nearest_face():
    """Outside, the nearest point of half spaces; inside, the least distance to a face's plane."""
    found, planes = of(FORMS["hull"], WHERE), ConvexHull(POINTS).equations
    A, b = planes[:, :3], planes[:, 3]
    outside = to_half_spaces(A, b, WHERE.T)
    beyond = (A @ WHERE + b[:, None]).max(axis=0)
    assert 10 < (beyond < 0).sum() < 290
    np.testing.assert_allclose(found, np.where(beyond > 0, outside, beyond), rtol=0, atol=1e-9)


def test_a_turned_box_is_as_far_as_a_quadratic_program_says():
    """The box's faces, turned about its centre."""
    low, high = np.array([-1.0, -2.0, 0.0]), np.array([1.5, 1.0, 0.8])
    A = np.vstack([TURN, -TURN])
    b = -np.concatenate([(high - low) / 2] * 2) - A @ ((low + high) / 2)
    beyond = (A @ WHERE + b[:, None]).max(axis=0)
    expected = np.where(beyond > 0, to_half_spaces(A, b, WHERE.T), beyond)
    np.testing.assert_allclose(of(FORMS["turned box"], WHERE), expected, rtol=0, atol=1e-9)


def test_a_cylinder_is_as_far_as_the_projection_onto_it():
    """Outside, the nearest point has the axial place and the radius cut; inside, the nearest of its three faces."""
    a, axis = ENDS[0], ENDS[1] - ENDS[0]
    length = np.linalg.norm(axis)
    axis = axis / length
    along = axis @ (WHERE - a[:, None])
    off = WHERE - a[:, None] - axis[:, None] * along
    far = np.linalg.norm(off, axis=0)
    nearest = (
        a[:, None] + axis[:, None] * np.clip(along, 0, length) + off * np.minimum(1, 0.7 / far)
    )
    depth = np.maximum.reduce([far - 0.7, -along, along - length])
    expected = np.where(depth > 0, np.linalg.norm(WHERE - nearest, axis=0), depth)
    assert (depth < 0).any()
    np.testing.assert_allclose(of(FORMS["cylinder"], WHERE), expected, rtol=0, atol=1e-12)


def test_a_height_map_is_as_far_as_the_nearest_of_its_prisms():
    """The prism below each triangle, as half spaces, one by one; inside, the sign is that of a triangulated surface."""
    from matplotlib.tri import LinearTriInterpolator, Triangulation

    form, points = FORMS["heights"], WHERE[:, :120]
    n, m = MAP.shape
    x, y = -1.5 + 0.6 * np.arange(n), -2.0 + 0.6 * np.arange(m)
    X, Y = (g.reshape(-1) for g in np.meshgrid(x, y, indexing="ij"))
    k = np.arange(n * m).reshape(n, m)
    a, b, c, d = k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]
    corners = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    outside = np.full(points.shape[1], np.inf)
    for t in corners:
        top = np.stack([X[t], Y[t], MAP.reshape(-1)[t]], axis=1)
        under = top * [1, 1, 0] + [0, 0, -1.0]
        planes = ConvexHull(np.vstack([top, under])).equations
        outside = np.minimum(outside, to_half_spaces(planes[:, :3], planes[:, 3], points.T))
    surface = LinearTriInterpolator(Triangulation(X, Y, corners), MAP.reshape(-1))
    height = np.ma.filled(surface(*points[:2]), -np.inf)
    inside = (points[2] < height) & (points[2] > -1.0)
    found = of(form, points)
    assert inside.any()
    np.testing.assert_array_equal(found < 0, inside)
    np.testing.assert_allclose(np.maximum(found, 0), outside, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", FORMS)
def test_a_normal_is_the_gradient_and_leads_to_the_surface(name):
    """Against differences of the distance; a step against it, of the distance, ends on the surface."""
    s = records.one_solid(FORMS[name])
    r = np.array(distance.local_point(*WHERE, 0, s))
    d = np.asarray(distance.signed_distance(*r, 0, s))
    n = np.array(distance.outward_normal(*r, 0, s))
    steps = 1e-6 * np.eye(3)[:, :, None]
    rise = [
        distance.signed_distance(*(r + e), 0, s) - distance.signed_distance(*(r - e), 0, s)
        for e in steps
    ]
    smooth = (
        np.abs(np.linalg.norm(rise, axis=0) / 2e-6 - 1) < 1e-6
    )  # not on a ridge, where it has no gradient
    assert smooth.mean() > 0.9
    np.testing.assert_allclose(n[:, smooth], np.array(rise)[:, smooth] / 2e-6, rtol=0, atol=1e-6)
    reached = distance.signed_distance(*(r - d * n), 0, s)
    np.testing.assert_allclose(reached, 0, atol=1e-9)


def test_distances_agree_with_coal():
    """Coal (hpp-fcl) finds the same distances and depths of a point, by GJK and EPA."""
    coal = pytest.importorskip("coal")
    faces, corners = coal.StdVec_Triangle(), coal.StdVec_Vec3s()
    for p in POINTS:
        corners.append(p)
    for t in ConvexHull(POINTS).simplices:
        faces.append(coal.Triangle(*map(int, t)))
    length = float(np.linalg.norm(ENDS[1] - ENDS[0]))
    shapes = {
        "turned box": coal.Box(2.5, 3.0, 0.8), "cylinder": coal.Cylinder(0.7, length),
        "hull": coal.Convex(corners, faces), "sphere": coal.Sphere(0.9),
    }  # fmt: skip
    request = coal.DistanceRequest()
    request.gjk_tolerance = request.epa_tolerance = 1e-12
    request.gjk_max_iterations = request.epa_max_iterations = 1000
    for name, shape in shapes.items():
        form = FORMS[name]
        place = coal.Transform3s(form.turn.T, form.origin if name != "hull" else np.zeros(3))
        expected = []
        for x in WHERE.T:
            at = coal.Transform3s()
            at.setTranslation(x)
            expected.append(
                coal.distance(shape, place, coal.Sphere(1e-12), at, request, coal.DistanceResult())
            )
        found, expected = of(form, WHERE), np.array(expected)
        if name == "cylinder":  # EPA does not always find the least depth in round shapes
            found, expected = found[found > 0], expected[found > 0]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7, err_msg=name)


def test_the_kernel_compiles_the_same_distances():
    """Numbers, compiled, against arrays: the same source gives the same values, of every kind and while it moves."""
    from rigidfleet.kernel import obstacles

    s = records.join_solids(
        [records.one_solid(f, [1.0, 3.0], [[0, 0, 0], [1, 2, 3]]) for f in FORMS.values()]
    )
    where = WHERE[:, :60]
    for b, form in enumerate(FORMS.values()):
        alone = records.one_solid(form, [1.0, 3.0], [[0, 0, 0], [1, 2, 3]])
        expected = proximity.distances(*where, alone, 2.0)
        own = np.array([obstacles.point_in_solid_axes(*x, 2.0, b, s) for x in where.T])
        found = [obstacles.solid_gap_and_normal(*x, b, -1, s)[0] for x in own]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", FORMS)
def test_points_together_are_as_far_as_each_alone(name):
    """Arrays of any shape, and single numbers, give the same distances and normals."""
    solid = records.one_solid(FORMS[name])
    here = distance.local_point(*WHERE, 0, solid)
    for measure in (distance.signed_distance, distance.outward_normal):
        line = np.array(measure(*here, 0, solid))
        grid = measure(*(x.reshape(20, 15) for x in here), 0, solid)
        each = [measure(*x, 0, solid) for x in np.transpose(here).tolist()]
        np.testing.assert_allclose(np.reshape(grid, line.shape), line, rtol=0, atol=1e-14)
        np.testing.assert_allclose(np.transpose(each), line, rtol=0, atol=1e-14)


def test_a_solid_is_where_its_waypoints_say():
    """Straight between waypoints, at rest before the first and after the last."""
    times, ways = np.array([1.0, 2.0, 5.0]), RNG.normal(size=(3, 3))
    s, t = records.one_solid(FORMS["box"], times, ways), np.linspace(0, 6, 61)
    found = np.array(distance.solid_displacement(t, 0, s))
    expected = [np.interp(t, times, ways[:, q]) for q in range(3)]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("yaw", [0.0, 30.0])
def test_waypoints_lead_the_centre_of_a_box(yaw):
    """A box, turned or not, begins where its corners place it if the first waypoint is the middle between them."""
    box = Box(
        kind="box", min=(4, 0, 0), max=(6, 2, 4), yaw_deg=yaw, waypoints=((5, 1, 2), (9, 1, 3)), times=(0, 5)
    )  # fmt: skip
    np.testing.assert_array_equal(box.solid.ways, [[0, 0, 0], [4, 0, 1]])


@pytest.mark.parametrize("name", [name for name in FORMS if name != "ground"])
def test_an_outline_lies_on_the_surface_within_the_extent(name):
    """What is drawn has distance 0, but for chords of round things and sides of terrain, and fits what is measured."""
    form = FORMS[name]
    s = records.one_solid(form)
    drawn = outline_of_solid(s)
    points = np.concatenate([drawn.triangles.reshape(-1, 3), drawn.lines.reshape(-1, 3)])
    low, high = records.swept_extent(s)
    assert ((points >= low - 1e-9) & (points <= high + 1e-9)).all()
    off = of(form, points.T)
    if name == "heights":  # its sides are drawn down to the lowest height only
        off = off[points[:, 2] > MAP.min() + 1e-9]
    np.testing.assert_allclose(off, 0, atol=1e-9)
    a, b, c = drawn.triangles.swapaxes(0, 1)  # seen from outside
    middle, normal = (a + b + c) / 3, np.cross(b - a, c - a)
    kept = np.linalg.norm(normal, axis=1) > 1e-9
    step = 1e-4 * normal[kept] / np.linalg.norm(normal[kept], axis=1, keepdims=True)
    assert (of(form, (middle[kept] + step).T) > of(form, (middle[kept] - step).T)).all()


# -- missions ------------------------------------------------------------------------------------------

BALL = {"kind": "sphere", "radius": 1.0}
TERRAIN = {"kind": "heights", "spacing": 2.0, "heights": [[0, 1, 2], [0, 1, 2], [1, 3, 2]]}


def a_mission(obstacles: list[dict[str, Any]], until: float = 4.0, **agents: Any) -> Mission:
    """Vehicles that fly straight on."""
    hold = [{"kind": "hold", "control": "open", "until": until}]
    data = {"schema_version": 1, "name": "solids", "phases": hold, "obstacles": obstacles}
    return Mission.from_dict(data | {"agents": {"mass": 1.0, "radius": 0.25} | agents})


@pytest.mark.parametrize(
    ("obstacle", "key", "problem", "remedy"),
    [
        ({"kind": "sphere"}, "radius", "is missing", "radius"),
        ({"kind": "cylinder", "radius": 1, "ends": [[1, 2, 3], [1, 2, 3]]}, "ends", "same place", "two ends"),
        ({"kind": "hull", "points": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]}, "points", "in a plane", "thin"),
        ({"kind": "hull", "points": [[0, 0, 0], [1, 0, 0], [0, 1, 0]]}, "points", "4", "four or more"),
        (TERRAIN | {"heights": [[0, 1], [0]]}, "heights", "rows of 1 to 2", "same length"),
        (TERRAIN | {"heights": [[0, 1, 2]]}, "heights", "1 of them", "two rows or more"),
        (TERRAIN | {"base": 0.5}, "base", "above the lowest height, 0 m", "below all heights"),
        ({"kind": "heights", "spacing": 1.0}, "heights", "is missing", "file"),
        ({"kind": "heights", "spacing": 1.0, "file": "a.csv"}, "file", "only with a mission file", "give heights"),
        (TERRAIN | {"velocity": [1, 0, 0]}, "velocity", "unknown key", "corner"),
        (BALL | {"appears": 3, "vanishes": 3}, "vanishes", "not after 3 s", "after it has appeared"),
        (BALL | {"times": [0, 1]}, "waypoints", "times need it", "add waypoints"),
        (BALL | {"waypoints": [[0, 0, 0], [1, 0, 0]]}, "times", "waypoints need it", "add times"),
        (BALL | {"waypoints": [[0, 0, 0], [1, 0, 0]], "times": [1]}, "times", "1 entries for 2", "each waypoint"),
        (BALL | {"waypoints": [[0, 0, 0], [1, 0, 0]], "times": [1, 1]}, "times", "increase", "order"),
        (
            BALL | {"waypoints": [[0, 0, 0], [1, 0, 0]], "times": [0, 1], "velocity": [1, 0, 0]},
            "velocity", "no effect", "remove one",
        ),
    ],
)  # fmt: skip
def test_a_bad_obstacle_is_refused_with_a_remedy(obstacle, key, problem, remedy):
    """One finding, at the key, with what to do."""
    with pytest.raises(MissionError) as error:
        a_mission([obstacle], position=[[0.0, 0.0, 50.0]])
    (finding,) = error.value.findings
    assert finding.key == f"obstacles[1].{key}"
    assert problem in finding.problem
    assert remedy in finding.remedy


#: A grid as geographers list it: a place and its height in each row.
PLACES = "".join(f"{x},{y},{x + y}\n" for x in range(4) for y in range(3))


@pytest.mark.parametrize("suffix", ["csv", "npy"])
def test_heights_from_a_file_are_held_by_the_result(tmp_path, suffix):
    """The flight can be repeated from its result after the file is gone."""
    file = tmp_path / f"terrain.{suffix}"
    if suffix == "csv":
        np.savetxt(file, MAP, delimiter=",")
    else:
        np.save(file, MAP)
    text = f"""
schema_version = 1
name = "terrain"  # kept
[agents]
mass = 1.0
position = [[1.0, 1.0, 9.0]]
[[obstacles]]
kind = "heights"
spacing = 0.6
file = "{file.name}"
[[phases]]
kind = "hold"
control = "open"
until = 0.5
"""
    (tmp_path / "m.toml").write_text(text)
    mission = load_mission(tmp_path / "m.toml")
    file.unlink()
    simulate(mission).save(tmp_path / "r.nc")
    again = Result.load(tmp_path / "r.nc")
    held = again.mission.obstacles[0]
    assert held.kind == "heights"
    assert held.heights == tuple(map(tuple, MAP.tolist()))
    with pytest.raises(MissionError, match="no such file"):
        load_mission(tmp_path / "m.toml")
    file = file.with_suffix(".csv")
    (tmp_path / "m.toml").write_text(text.replace(".npy", ".csv"))
    for rows, words in (("1,2\n3,x\n", "not a table of numbers"), (PLACES, "list of places x, y")):
        file.write_text(rows)
        with pytest.raises(MissionError, match=words):
            load_mission(tmp_path / "m.toml")


# -- flights -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("formulation", ["inertial", "body"])
def test_a_thin_wall_that_flies_past_between_samples_is_met(formulation):
    """A plate 2 cm thick at 40 m/s: the verdict and the check name it, the vehicle, and the time of the middle."""
    plate = {
        "kind": "box", "name": "plate", "min": [-30.01, -3, 5], "max": [-29.99, 3, 15], "velocity": [40.0, 0, 0],
    }  # fmt: skip
    hold = [
        {"kind": "establish", "formation": "a", "control": "tracking", "until": 2.0, "blend": 2.0}
    ]
    data = {
        "schema_version": 1, "name": "plate", "formulation": formulation, "phases": hold, "obstacles": [plate],
        "agents": {"mass": 1.0, "radius": 0.25, "position": [[0.0, 0.0, 10.0], [9.0, 9.0, 10.0], [9.0, -9.0, 10.0]]},
        "formations": {"a": {"slots": [[0.0, 0.0, 10.0], [9.0, 9.0, 10.0], [9.0, -9.0, 10.0]]}},
    }  # fmt: skip
    mission = Mission.from_dict(data)
    result = simulate(mission)
    verdict = assess(result)
    (failed,) = [c for c in verdict.checks if not c.passed]
    (x,) = [p.extremes["clearance"] for p in result.phases]
    assert (x.who, x.other) == (0, 0)
    assert x.value == pytest.approx(-0.26, abs=1e-6)
    assert x.time == pytest.approx(0.75, abs=1e-6)
    assert "agent 1 is deepest in 'plate'" in failed.message
    (remark,) = [r for r in check(mission).remarks if r.topic == "obstacle"]
    assert remark.level == "fails"
    assert "agent 1 hits 'plate' at 0.75 s" in remark.text


@pytest.mark.parametrize(
    ("since", "until"), [(0.0, 1.98765), (1.98765, 2.5), (2.43219, 3.0), (None, 1.1), (2.7, None), (5.0, 9.0)]
)  # fmt: skip
def test_an_obstacle_appears_and_vanishes(since, until):
    """A point passes the place of a ball at 2 s: it counts while it is there, to the moment, and else is nowhere."""
    ball = {"kind": "sphere", "centre": [0.0, 1.0, 20.0], "radius": 0.5}
    ball |= {name: t for name, t in (("appears", since), ("vanishes", until)) if t is not None}
    result = simulate(a_mission([ball], position=[[-4.0, 0.0, 20.0]], velocity=[[2.0, 0.0, 0.0]]))

    def away(t):
        return np.hypot(2.0 * t - 4.0, 1.0) - 0.75

    begin, end = since or 0.0, min(until or 4.0, 4.0)
    there = (result.time >= begin) & (result.time <= end)
    sampled, _, _ = proximity.clearance(
        result.position, 0.25, result.mission.obstacles, result.time
    )
    np.testing.assert_allclose(sampled[there], away(result.time[there]), atol=1e-9)
    assert np.isinf(sampled[~there]).all()
    found = result.phases[0].extremes.get("clearance")
    if begin > 4.0:
        assert found is None
        return
    when = float(np.clip(2.0, begin, end))
    assert found is not None
    assert found.time == pytest.approx(when, abs=1e-4)
    assert found.value == pytest.approx(away(when), abs=1e-8)
    planned = check(result.mission)
    assert not [remark for remark in planned.remarks if remark.topic == "obstacle"]


@pytest.mark.parametrize(
    ("since", "until"), [(0.4, 0.9), (1.3, 1.71), (2.503, 3.2), (0.7, 3.3)]
)  # fmt: skip
def test_an_obstacle_counts_in_the_phases_in_which_it_is_there(since, until):
    """Plan, flight and verdict agree on it; a phase without it lacks nothing."""
    ball = {"kind": "sphere", "centre": [4.0, 0.5, 5.0], "radius": 0.5}
    ball |= {"appears": since, "vanishes": until}
    fly = [{"kind": "fly", "position": [x, 0.0, 5.0], "duration": 1.0} for x in (4.0, 4.0, 0.0)]
    shape = {"slots": [[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]]}
    mission = Mission.from_dict({
        "schema_version": 1, "name": "ball", "obstacles": [ball], "formations": {"pair": shape},
        "agents": {"mass": 1.0, "position": [[0.0, -1.0, 5.0], [0.0, 1.0, 5.0]], "radius": 0.1},
        "phases": [{"kind": "establish", "formation": "pair", "duration": 1.0, "blend": 0.5}, *fly],
    })  # fmt: skip
    flight = simulate(mission)
    checks = {check.check: check for check in assess(flight).checks}
    assert "record" not in checks or checks["record"].passed
    flown = flight.extreme("clearance")
    assert flown is not None
    ((_, planned, when, _),) = check(mission).clearance
    assert planned == pytest.approx(flown.value, abs=2e-3)
    assert since <= when <= until
    for phase in flight.phases:
        assert ("clearance" in phase.extremes) == (phase.t_start < until and phase.t_end > since)
    assert checks["clearance"].passed == (flown.value > 0.0)


def test_a_ball_among_waypoints_comes_as_near_as_the_closed_form_says():
    """Points on straight ways: the least of the closed forms of all legs, at its time, whatever the steps are."""
    ways, times = np.array([[-9.0, 0, 20], [3, 1, 22], [5, -8, 19]]), np.array([0.3, 1.7, 3.6])
    start, v = (
        np.array([[4.0, -6.0, 20.0], [60.0, 0.0, 20.0]]),
        np.array([[-2.0, 3.0, 0.4], [0.0, 0.0, 0.0]]),
    )
    ball = {"kind": "sphere", "radius": 0.5, "waypoints": ways.tolist(), "times": times.tolist()}
    result = simulate(a_mission([ball], position=start.tolist(), velocity=v.tolist()))
    best = np.inf, 0.0
    legs = [(0.0, times[0], ways[0], ways[0]), *zip(times, times[1:], ways, ways[1:], strict=False)]
    for a, b, p, q in [*legs, (times[-1], 4.0, ways[-1], ways[-1])]:
        u = v[0] - (q - p) / (b - a)
        x = start[0] + v[0] * a - p
        t = np.clip(-(x @ u) / max(u @ u, 1e-300), 0, b - a)
        best = min(best, (float(np.linalg.norm(x + t * u)), float(a + t)))
    x = result.phases[0].extremes["clearance"]
    assert x.value == pytest.approx(best[0] - 0.75, abs=1e-8)
    assert x.time == pytest.approx(best[1], abs=1e-4)
    assert assess(result).passed


@pytest.mark.parametrize("name", FORMS)
def test_the_monitor_finds_the_least_of_each_kind(name):
    """Vehicles on straight ways past and through it: never above the least of dense samples, and as near as those."""
    made = {
        "box": {"kind": "box", "min": [-1, -2, 0], "max": [1.5, 1, 0.8]},
        "turned box": {"kind": "box", "min": [-1, -2, 0], "max": [1.5, 1, 0.8], "yaw_deg": 40.0, "roll_deg": -25.0},
        "ground": {"kind": "ground", "height": 0.3},
        "sphere": {"kind": "sphere", "centre": [0.3, -0.2, 0.5], "radius": 0.9},
        "cylinder": {"kind": "cylinder", "ends": ENDS.tolist(), "radius": 0.7},
        "hull": {"kind": "hull", "points": POINTS.tolist()},
        "heights": {"kind": "heights", "corner": [-1.5, -2.0], "spacing": 0.6, "heights": MAP.tolist()},
    }[name]  # fmt: skip
    far = {
        "kind": "sphere",
        "centre": [0.0, 0.0, -900.0],
        "radius": 1.0,
    }  # so that all go the same way
    for aim in [0.0, 0.0, 0.2], [0.4, 0.3, 2.6], [-0.5, 0.6, 3.0]:
        rng = np.random.default_rng(len(name))
        start = np.array([*rng.uniform(3, 5, 2), 4.0])
        v = (np.array(aim) - start) / 2
        mission = a_mission([made, far], position=[start.tolist()], velocity=[v.tolist()])
        result = simulate(mission)
        t = np.linspace(0, 4, 40_001)
        each = proximity.distances(*(start + v * t[:, None]).T, mission.obstacles[0].solid) - 0.25
        found = [x for p in result.phases for k, x in p.extremes.items() if k == "clearance"]
        step = np.linalg.norm(v) * t[1]
        if name == "heights" and each.min() < -0.25:  # inside, only the sign is promised
            assert found[0].value < -0.25
            continue
        assert found[0].value <= each.min() + 1e-9
        assert found[0].value >= each.min() - step / 2 - 1e-9


def test_a_vehicle_that_starts_on_terrain_stands_there():
    """Its clearance at the start is told apart from that in flight; leaving, it may touch nothing else."""
    flat = {
        "kind": "heights",
        "spacing": 4.0,
        "corner": [-4, -4],
        "heights": [[2, 2, 2], [2, 2, 2], [2, 2, 2]],
    }
    mission = a_mission([flat], position=[[0.1, 0.2, 2.25]], velocity=[[0.0, 0.0, 1.0]])
    verdict = assess(simulate(mission))
    assert verdict.passed
    assert {"clearance_start", "clearance"} <= {c.check for c in verdict.checks}
    dive = a_mission([flat], position=[[0.1, 0.2, 5.0]], velocity=[[0.3, 0.0, -1.0]])
    assert not assess(simulate(dive)).passed


# -- pictures ------------------------------------------------------------------------------------------


def every_kind() -> Mission:
    """A flight above one obstacle of each kind; a zone, and one that moves."""
    return a_mission(
        [
            {"kind": "ground"},
            {"kind": "box", "min": [2, 2, 0], "max": [3, 4, 2], "yaw_deg": 20.0},
            BALL | {"name": "moving", "waypoints": [[0, 0, 2], [4, 0, 2]], "times": [0, 3]},
            {"kind": "cylinder", "ends": ENDS.tolist(), "radius": 0.7, "zone": True},
            {"kind": "hull", "points": POINTS.tolist()},
            TERRAIN,
        ],
        position=[[0.0, 0.0, 8.0], [2.0, 0.0, 8.0]],
        velocity=[[1.0, 0.5, 0.0]] * 2,
    )  # fmt: skip


def test_figures_draw_every_kind(tmp_path):
    """Without a warning; what moves is drawn at several places, from first to last."""
    result = simulate(every_kind())
    view = space.trajectory_scene(result)
    assert [s.name for s in view.shapes] == ["box 2", "moving", "cylinder 4", "hull 5", "heights 6"]
    moving = view.shapes[1]
    np.testing.assert_allclose(moving.at[[0, -1]], [[0, 0, 2], [4, 0, 2]], atol=1e-12)
    assert [s.zone for s in view.shapes] == [False, False, True, False, False]
    for shape in view.shapes:
        assert (shape.extent[0] >= view.low - 1e-9).all()
        assert (shape.extent[1] <= view.high + 1e-9).all()
    assert plot(result, tmp_path, formats=["svg"], names=["trajectory"])


def test_the_replay_has_surfaces_and_ways():
    """Corners of triangles lie on the solids; the way of what moves is that of the mission."""
    result = simulate(every_kind())
    described = scene.describe_scene(result, np.arange(len(result.edges)), 1.0)
    assert described["boxes"] == []
    names = [s["name"] for s in described["solids"]]
    assert names == ["box 2", "moving", "cylinder 4", "hull 5", "heights 6"]
    hull = described["solids"][3]
    corners = hull["corners"][hull["triangles"]]
    np.testing.assert_allclose(of(FORMS["hull"], corners.T), 0, atol=1e-4)
    np.testing.assert_array_equal(described["solids"][1]["ways"], [[0, 0, 2], [4, 0, 2]])
