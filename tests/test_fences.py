"""Fences and people: distances from polygons, falls, files of polygons, and how flights beside them are judged."""

import hashlib
import json
import math
import re

import numpy as np
import pytest
from matplotlib.path import Path as Outline
from sample_missions import three_points, three_quadrotors
from scipy.integrate import solve_ivp

import rigidfleet as rf
from rigidfleet.errors import MissionError
from rigidfleet.math import falls
from rigidfleet.math.bernstein import greatest_curve_measure
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.mission import boundaries, fences
from rigidfleet.mission.geojson import read_geojson
from rigidfleet.mission.schema import GeodeticOrigin
from rigidfleet.plotting.areas import fall_places_by_sample
from rigidfleet.reporting import report_page
from rigidfleet.simulation.together import simulate_together
from rigidfleet.solids.polygons import Region, edges_cross

L_SHAPE = np.array([[0, 0], [10, 0], [10, 4], [4, 4], [4, 10], [0, 10]], dtype=float)
HOLE = np.array([[1, 1], [1, 3], [3, 3], [3, 1]], dtype=float)
RINGS = [L_SHAPE, HOLE]
RNG = np.random.default_rng(7)


def distance(p, rings, low=-math.inf, high=math.inf):
    """Signed distance of a point (3,) from a prism, edge by edge, with matplotlib's test of what is inside."""
    inside = Outline(rings[0]).contains_point(p[:2]) and not any(
        Outline(ring).contains_point(p[:2]) for ring in rings[1:]
    )
    least = math.inf
    for ring in rings:
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            t = min(max(float(np.dot(p[:2] - a, b - a) / np.dot(b - a, b - a)), 0.0), 1.0)
            least = min(least, math.dist(p[:2], a + t * (b - a)))
    x, z = -least if inside else least, max(low - p[2], p[2] - high)
    return max(x, z) if max(x, z) <= 0 else math.hypot(max(x, 0), max(z, 0))


def curves(n, spread=6.0):
    """Random curves (n, 3, 5) by control points about the polygon."""
    return RNG.uniform(-2, 12, (n, 3, 1)) + RNG.normal(0, spread, (n, 3, 5))


def signed(region, points):
    """Signed distances of points (M, 3), which are curves of one control point."""
    return region.curve_depths_and_bounds(points[:, :, None], outside=True)[0]


def along(points, t):
    """Values (T, C) of one curve (C, P) at places (T,)."""
    p = points.shape[1] - 1
    basis = np.stack([math.comb(p, k) * t**k * (1 - t) ** (p - k) for k in range(p + 1)])
    return (points @ basis).T


@pytest.mark.parametrize("turned", [False, True])
def test_a_signed_distance_is_that_of_the_nearest_edge(turned):
    """Inside negative, with a concave corner and a hole, whichever way round the corners are given."""
    rings = [ring[::-1] for ring in RINGS] if turned else RINGS
    points = RNG.uniform(-3, 13, (400, 3))
    expected = [distance(p, RINGS, 2.0, 7.0) for p in points]
    assert signed(Region.of_rings(rings, 2.0, 7.0), points) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("outside", [True, False])
def test_the_worst_of_a_curve_is_between_no_samples(outside):
    """It is the greatest of 20,001 places, to a millimetre, and no bound along the way is below it."""
    region, sign = Region.of_rings(RINGS, 2.0, 7.0), 1.0 if outside else -1.0
    for points in curves(30):
        dense = (sign * signed(region, along(points, np.linspace(0, 1, 20_001)))).max()
        value, bound = (x[0] for x in region.curve_depths_and_bounds(points[None], outside=outside))
        assert value <= dense + 1e-9
        assert bound >= dense - 1e-9

        def measure(p, _):
            value, bound = region.curve_depths_and_bounds(p, outside=outside)
            return value, np.full(len(p), 0.5), bound

        worst = greatest_curve_measure(points[None], measure, lambda _: 1e-3)
        assert dense - 1e-3 <= worst.value <= dense + 1e-3
        place = along(points, np.array([worst.place]))
        assert sign * signed(region, place)[0] == pytest.approx(worst.value, abs=1e-9)


def test_edges_that_cross_are_known():
    """Of a bow tie, not of a triangle, and of edges that lie on each other."""
    assert edges_cross(Region.of_rings([np.array([[0, 0], [4, 4], [4, 0], [0, 4.0]])]).edges)
    assert not edges_cross(Region.of_rings([np.array([[0, 0], [4, 0], [0, 4.0]])]).edges)
    assert edges_cross(Region.of_rings([np.array([[0, 0], [4, 0], [1, 0], [1, 4.0]])]).edges)


def test_a_fall_without_drag_is_a_parabola():
    """Time and place are those of the closed formula, to rounding."""
    h, v = RNG.uniform(0, 100, 50), RNG.normal(0, 6, (50, 3))
    tau = falls.fall_time(h, v[:, 2], np.zeros(50), 0.0, 9.81)
    expected = (v[:, 2] + np.sqrt(v[:, 2] ** 2 + 2 * 9.81 * h)) / 9.81
    assert tau == pytest.approx(expected, abs=1e-12)
    place = falls.landing_places(np.zeros((50, 3)), v, tau, np.zeros(50), np.array([5.0, 0, 0]))
    assert place == pytest.approx(v[:, :2] * expected[:, None], abs=1e-11)


@pytest.mark.parametrize("k", [1e-7, 0.01, 0.3, 4.0])
def test_a_fall_with_drag_solves_its_differential_equation(k):
    """In wind, upwards or downwards at first: as SciPy integrates it, to a micrometre."""
    wind, g = np.array([6.0, -3.0, 0.4]), 9.81
    for v in ([4.0, -2.0, 7.0], [0.0, 0.0, -30.0], [-9.0, 3.0, 0.0]):

        def rates(_, y):
            return [*y[3:], *(k * (wind - y[3:]) - [0, 0, g])]

        def ground(_, y):
            return y[2]

        vars(ground).update(terminal=True, direction=-1)
        start = [1.0, 2.0, 60.0, *v]
        solved = solve_ivp(rates, [0, 500], start, rtol=1e-12, atol=1e-12, events=ground)
        tau = falls.fall_time(np.array(60.0), np.array(v[2]), np.array(k), wind[2], g)
        assert tau == pytest.approx(solved.t_events[0][0], rel=1e-9)
        place = falls.landing_places(np.array(start[:3]), np.array(v), tau, np.array(k), wind)
        assert place == pytest.approx(solved.y_events[0][0][:2], abs=1e-6)
        places = falls.fall_places(np.array(start[:3]), np.array(v), solved.t, k, wind, g)
        assert places == pytest.approx(solved.y[:3].T, abs=1e-6)


def test_a_fall_ends_on_terrain_where_that_is_hit():
    """On a slope, and on a roof: where SciPy's integration hits them, to the step between the heights looked at."""
    slope = {
        "kind": "heights",
        "corner": [-40, -40],
        "spacing": 80.0,
        "heights": [[-8, -8], [8, 8]],
    }
    roof = {"kind": "box", "min": [2.0, -30.0, -40.0], "max": [30.0, 30.0, 2.5]}
    wind = [3.0, -1.0, 0.0]
    mission = rf.Mission.from_dict(
        beside(obstacles=[slope, roof], disturbances={"wind": wind, "drag": 0.3})
    )
    result = rf.simulate(mission)
    places, k = fall_places_by_sample(result), mission.drag / mission.true_mass

    def surface(x, y):
        return (
            max(0.2 * x, 2.5 if 2.0 < x < 30.0 and abs(y) < 30.0 else -math.inf)
            if abs(x) < 40
            else -math.inf
        )

    for row in range(0, len(result.time), max(1, len(result.time) // 12)):
        for i in range(3):

            def rates(_, y, k=k[i]):
                return [*y[3:], *(k * (np.array(wind) - y[3:]) - [0, 0, mission.gravity])]

            def above(_, y):
                return y[2] - surface(y[0], y[1])

            vars(above).update(terminal=True, direction=-1)
            start = [*result.position[row, i], *result.velocity[row, i]]
            solved = solve_ivp(rates, [0, 50], start, rtol=1e-9, max_step=0.01, events=above)
            assert places[row, i] == pytest.approx(solved.y_events[0][0][:2], abs=0.1)


def beside(**more):
    """Three points that fly 8 m along x and 4 m along y, beside what is given."""
    fly = {"kind": "fly", "position": [8.0, 4.0, 9.0], "duration": 4.0}
    return three_points({"blend": 3.0, "until": 3.5}, fly) | more


def square(x, y, half=2.0):
    return [[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]]


def checks(mission):
    """The verdict's checks by name, and the flight."""
    result = rf.simulate(mission)
    return rf.assess(result).by_name, result


def states(result):
    """States (K, N, 3) of a flight: its samples, which these tests take densely."""
    return result.position, result.velocity


def test_a_fall_lands_where_a_vehicle_falls_that_the_flight_loses():
    """In wind, with drag: the place is that of the lost vehicle as flown when it is as high as that."""
    lost = {"wind": [4.0, -2.0, 0.0], "drag": 0.4, "lost": [{"agent": 2, "time": 5.0}]}
    data = beside(disturbances=lost, people=[{"polygon": square(99, 99)}], output_step=0.01)
    result = rf.simulate(rf.Mission.from_dict(data))
    k = int(np.searchsorted(result.time, 5.0))
    later = k + 80
    level = float(result.position[later, 1, 2])
    r, v = (x[k : k + 1] for x in states(result))
    place = boundaries.Boundaries(result.mission).places_of_falls(r, v, level)[0, 1]
    assert result.position[k, 1, 2] - level > 1.0
    assert place == pytest.approx(result.position[later, 1, :2], abs=1e-4)


BELOW_ZERO = {
    "roof": {"kind": "box", "min": [-9, -8, -7], "max": [9, 8, -3]},
    "turned roof": {"kind": "box", "min": [-9, -2, -13], "max": [9, 2, 3], "roll_deg": 90.0},
    "hill": {"kind": "heights", "corner": [-9, -9], "spacing": 18, "heights": [[-4, -4], [-2, -2]]},
}


@pytest.mark.parametrize("thing", BELOW_ZERO)
@pytest.mark.parametrize("ground", [None, -2.0, -9.0])
def test_falls_end_on_roofs_and_terrain_below_zero(thing, ground):
    """On roofs and a hill at -3 m, or on the ground if that is higher; beside them, no higher, as on the ground."""
    data = beside(people=[{"polygon": square(99, 99), "floor": -9.0, "ceiling": 2.0}])
    floor = [] if ground is None else [{"kind": "ground", "height": ground}]
    data["obstacles"] = [BELOW_ZERO[thing], *floor]
    own = boundaries.Boundaries(rf.Mission.from_dict(data))
    r = np.array([[[0.0, 0.0, 20.0], [0.0, 30.0, 20.0], [30.0, 0.0, 20.0]]])
    ends = own.ends_of_falls(r, np.zeros((1, 3, 3)))[0]
    on, *beside_it = ends[:, 2].tolist()
    level = -np.inf if ground is None else ground
    assert on == pytest.approx(max(-3.0, level), abs=0.25)
    assert all(z <= -3.0 if ground is None else z == ground for z in beside_it)
    assert ends[:, :2] == pytest.approx(r[0, :, :2], abs=1e-6)


@pytest.mark.parametrize("turned", [{}, {"yaw_deg": 30.0}, {"yaw_deg": 30.0, "pitch_deg": 2.0}])
def test_falls_beside_a_house_with_a_cellar_end_at_zero(turned):
    """Without a ground, falls end on its roof and beside it at z = 0, however it is turned."""
    data = beside(people=[{"polygon": square(99, 99), "floor": -9.0, "ceiling": 2.0}])
    data["obstacles"] = [{"kind": "box", "min": [-6, -6, -7], "max": [6, 6, 3]} | turned]
    own = boundaries.Boundaries(rf.Mission.from_dict(data))
    r = np.array([[[0.0, 0.0, 20.0], [0.0, 30.0, 20.0], [30.0, 0.0, 20.0]]])
    on, *beside_it = own.ends_of_falls(r, np.zeros((1, 3, 3)))[0, :, 2].tolist()
    assert on == pytest.approx(3.0, abs=0.25)
    assert beside_it == [0.0, 0.0]


@pytest.mark.parametrize("flown", ["points", "body", "vehicles", "curves"])
def test_flights_are_judged_between_samples(flown):
    """Records with two samples a second have the worst values of the same flight with 500, of every kind of flight."""
    areas = {
        "fences": [
            {"kind": "inclusion", "polygon": square(4, 3, 8), "ceiling": 8.9},
            {"kind": "exclusion", "polygon": square(12, 2)},
            {"kind": "exclusion", "polygon": square(-5, 3), "soft": True},
        ],
        "people": [{"polygon": square(14, 9), "ceiling": 0.0}],
        "disturbances": {"wind": [2.0, 1.0, 0.0]},
    }
    data = beside(**areas)
    if flown == "body":
        data |= {"formulation": "body"}
    if flown == "vehicles":
        data = (
            three_quadrotors({"kind": "fly", "position": [8.0, 4.0, 9.0], "duration": 4.0}) | areas
        )
    dense = rf.simulate(rf.Mission.from_dict(data | {"output_step": 0.002}))
    result = rf.simulate(rf.Mission.from_dict(data | {"output_step": 0.5}))
    if flown == "curves":
        t = np.unique(dense.time.round(9))
        rows = np.searchsorted(dense.time, t)
        r, v = dense.position[rows][::50], dense.velocity[rows][::50]
        result = rf.trajectories(t[::50], r, velocity=v, mission=result.mission)
    own = boundaries.Boundaries(dense.mission)
    for name, close in (("fence", 2e-3), ("soft_fence", 2e-3), ("people", 2e-2)):
        values = own.worst_by_area(name, *states(dense))[0]
        worst = values.min() if name == "people" else values.max()
        check = rf.assess(result).by_name[name]
        assert check.worst == pytest.approx(worst, abs=close)
        assert check.when is not None
        assert check.at_samples is False
        k = int(np.argmin(abs(dense.time - check.when)))
        agent = int(check.who.split(",")[0].removeprefix("agent ")) - 1
        assert values[k, agent] == pytest.approx(worst, abs=close + 0.02)


def test_the_nearest_fall_is_that_of_all_instants_and_heights():
    """Beside people two metres tall: never farther than of 1,000 falls at 30 heights, and a quarter metre at most."""
    mission = rf.Mission.from_dict(beside(people=[{"polygon": L_SHAPE.tolist(), "ceiling": 2.0}]))
    own, region = boundaries.Boundaries(mission), Region.of_rings([L_SHAPE])
    time = np.array([0.0, 1.0])
    for seed in range(5):
        rng = np.random.default_rng(seed)
        pieces = (
            rng.normal(0, 4, (1, 3, 3, 4)) + np.array([14.0, 9.0, 25.0])[:, None] * np.eye(4)[0]
        )
        way = Piecewise(time, pieces)
        watch = boundaries.BoundaryWatch(mission)
        watch.add_way(way)
        worst = watch.search()["people"]
        t = np.linspace(0, 1, 1000)
        r, v = way.states(t, 2)
        nearest = min(
            region.distance(own.places_of_falls(r, v, level).reshape(-1, 2)).min()
            for level in np.linspace(0, 2, 30)
        )
        nearest -= mission.agents.radius[0]
        assert nearest - 0.25 <= worst.value <= nearest + 0.01 + 1e-6


def test_hard_fences_fail_and_soft_ones_tell():
    """One mission with each: the verdict says whom, by how much and when, and check says so before the flight."""
    crossed = {"kind": "inclusion", "name": "site", "polygon": square(0, 0, 6)}
    hard, _ = checks(rf.Mission.from_dict(beside(fences=[crossed])))
    soft, result = checks(rf.Mission.from_dict(beside(fences=[crossed | {"soft": True}])))
    assert not hard["fence"].passed
    assert "crosses the fence 'site' by" in hard["fence"].message
    assert soft["soft_fence"].passed
    assert "fence" not in soft
    assert "crosses the soft fence 'site' by" in soft["soft_fence"].message
    assert soft["soft_fence"].worst == hard["fence"].worst
    by = np.abs(result.position[..., :2]).max() - 6.0
    assert hard["fence"].worst == pytest.approx(by, abs=2e-3)
    for extra, level in (({}, "fails"), ({"soft": True}, "note")):
        before = rf.check(rf.Mission.from_dict(beside(fences=[crossed | extra])))
        assert [r.level for r in before.remarks if r.topic == "fence"] == [level]


def test_a_fall_on_people_fails_by_its_limit():
    """Check, verdict and sweep's metric say the distance; a greater limit fails a flight that another one passes."""
    people = [{"name": "stand", "polygon": square(18, 4)}]
    data = beside(people=people)
    passed, result = checks(rf.Mission.from_dict(data))
    assert passed["people"].passed
    assert passed["people"].worst > 0.5
    assert "from people in 'stand' if it fails at" in passed["people"].message
    strict = rf.Mission.from_dict(data | {"limits": {"people": 8.0}})
    failed, _ = checks(strict)
    assert not failed["people"].passed
    assert failed["people"].worst == passed["people"].worst
    remarks = [r for r in rf.check(strict).remarks if r.topic == "people"]
    assert [r.level for r in remarks] == ["fails"]
    assert not [r for r in rf.check(rf.Mission.from_dict(data)).remarks if r.topic == "people"]
    windy = rf.Mission.from_dict(data | {"disturbances": {"wind": [9.0, 0.0, 0.0]}})
    assert checks(windy)[0]["people"].worst < passed["people"].worst - 1.0
    x = result.extreme("people")
    assert x is not None
    assert x.value == passed["people"].worst


def test_flights_side_by_side_are_watched_as_alone():
    """Eight missions at once have the worst values of each alone."""
    fence = [{"kind": "inclusion", "polygon": square(4, 3, 8)}]
    missions = [
        rf.Mission.from_dict(beside(fences=fence, people=[{"polygon": square(20 - k, 4)}]))
        for k in range(8)
    ]
    for mission, result in zip(missions, simulate_together(missions), strict=True):
        alone = rf.simulate(mission)
        for name in ("fence", "people"):
            one, other = (x.extreme(name) for x in (result, alone))
            assert one is not None
            assert other is not None
            assert one.value == pytest.approx(other.value, abs=1e-2)


def test_records_keep_their_fences(tmp_path):
    """Saved and read again, a flight has the same verdict."""
    mission = rf.Mission.from_dict(
        beside(
            fences=[{"kind": "inclusion", "polygon": square(0, 0, 6)}],
            people=[{"polygon": square(18, 4)}],
        )
    )
    result = rf.simulate(mission)
    result.save(tmp_path / "a.nc")
    again = rf.assess(rf.Result.load(tmp_path / "a.nc"))
    assert [c.message for c in again.checks] == [c.message for c in rf.assess(result).checks]


def test_the_first_page_is_for_those_who_decide():
    """Before the safety table: what is planned, proved, rehearsed, how it is aborted, where things fall, digests."""
    people = [{"name": "stand", "polygon": square(18, 4)}]
    wind = {"wind": [3.0, 4.0, 0.0], "drag": 0.3}
    mission = rf.Mission.from_dict(beside(people=people, disturbances=wind))
    result = rf.simulate(mission)
    drilled = ["Two seconds late, no two vehicles touch."]
    text = report_page(result, rehearsed=drilled, abort=["Every second has a way home."])
    first = re.sub(r"<[^>]+>", " ", text.split("<main>")[1].split("<h2>Safety")[0])
    for words in (
        "3 vehicles fly for 7.5 s", *drilled, "Every second has a way home.", "wind of 5 m/s",
        "from people in &#39;stand&#39; if it fails at",
        hashlib.sha256(result.mission_text.encode()).hexdigest(),
    ):  # fmt: skip
        assert words in first
    falls_at = boundaries.Boundaries(mission).places_of_falls(*states(result), 0.0)
    low, high = falls_at.min(axis=(0, 1)), falls_at.max(axis=(0, 1))
    assert f"x = {low[0]:.1f} and {high[0]:.1f} m, y = {low[1]:.1f} and {high[1]:.1f} m" in first
    assert "No drill belongs to this report." in report_page(result)


# -- degrees and files -------------------------------------------------------------------------------


def test_degrees_are_metres_on_the_ellipsoid():
    """Within a kilometre, they are those of the radii of curvature in the meridian and across it, to 1 cm."""

    def metres(corner, *place):
        origin = GeodeticOrigin(
            **dict(zip(("latitude_deg", "longitude_deg", "altitude"), place, strict=True))
        )
        fence = fences.Fence(kind="inclusion", coordinates=[[[corner, [0, 0], [1, 1]]]])
        return fence.rings(origin)[0][0]

    lat, lon, h = 47.4979, 19.0402, 120.0
    a, e2 = 6_378_137.0, 0.00669437999014
    s2 = math.sin(math.radians(lat)) ** 2
    across = a / math.sqrt(1 - e2 * s2)
    along = a * (1 - e2) / (1 - e2 * s2) ** 1.5
    for east, north in ((300.0, 0.0), (0.0, -250.0), (120.0, 90.0)):
        dlat = math.degrees(north / (along + h))
        dlon = math.degrees(east / ((across + h) * math.cos(math.radians(lat))))
        place = metres([lon + dlon, lat + dlat], lat, lon, h)
        assert place == pytest.approx([east, north], abs=0.01)
    west = metres([-179.999, 0.0], 0.0, 179.999, 0.0)
    assert west[0] == pytest.approx(222.6, abs=0.1)  # across the date line


RING = [[0.0, 0.0], [0.001, 0.0], [0.001, 0.001], [0.0, 0.001]]
CLOSED = [*RING, RING[0]]


@pytest.mark.parametrize(
    ("data", "polygons", "note"),
    [
        ({"type": "Polygon", "coordinates": [CLOSED]}, [[RING]], None),
        ({"type": "Polygon", "coordinates": [CLOSED[::-1]]}, [[CLOSED[::-1][:-1]]], None),
        ({"type": "Polygon", "coordinates": [RING]}, [[RING]], "not closed"),
        ({"type": "Polygon", "coordinates": [[RING[0], *CLOSED]]}, [[RING]], None),
        ({"type": "Polygon", "coordinates": [[[*p, 99.0] for p in CLOSED]]}, [[RING]], "altitudes"),
        ({"type": "MultiPolygon", "coordinates": [[CLOSED, CLOSED], [CLOSED]]}, [[RING, RING], [RING]], None),
        (
            {"type": "FeatureCollection", "features": [
                {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [CLOSED]}},
                {"type": "Feature", "properties": None, "geometry": None},
                {"type": "Feature", "geometry": {"type": "Point", "coordinates": [0, 0]}},
            ]},
            [[RING]], "a Point is left out",
        ),
        (
            {"type": "Polygon", "coordinates": [CLOSED], "crs": {"properties": {"name": "urn:ogc:CRS84"}}},
            [[RING]], None,
        ),
    ],
)  # fmt: skip
def test_polygons_of_geojson(data, polygons, note):
    """Of each kind of object, closed or not, with or without altitudes; what is mended is told."""
    read, notes = read_geojson(json.dumps(data).encode(), "site.geojson")
    assert read == polygons
    assert (note is None and not notes) or (note is not None and note in " ".join(notes))


def test_parts_of_a_polygon_that_is_cut_are_to_be_joined():
    """A cut, as at the antimeridian, is no border where vehicles may be beside it: whole, the area holds them."""
    origin = {"latitude_deg": 0.0, "longitude_deg": 180.0}
    west, east = (
        [[a, -1e-3], [b, -1e-3], [b, 1e-3], [a, 1e-3]]
        for a, b in ((179.999, 180.0), (-180.0, -179.999))
    )
    fence = {"kind": "inclusion", "coordinates": [[west], [east]]}
    with pytest.raises(MissionError, match="join polygons that overlap or adjoin"):
        rf.Mission.from_dict(beside(geodetic_origin=origin, fences=[fence]))
    fence["coordinates"] = [[[west[0], east[1], east[2], west[3]]]]
    (area,) = rf.Mission.from_dict(beside(geodetic_origin=origin, fences=[fence])).fences
    region = area.region(rf.Mission.from_dict(beside(geodetic_origin=origin)).geodetic_origin, 0.0)
    assert region.distance(np.zeros((1, 2)))[0] == pytest.approx(-110.57, abs=0.01)


def test_an_island_in_a_hole_is_inside():
    """A polygon within the hole of another counts, as it does by the parity of the rings around random points."""

    def ring(half):
        return [[x / 1e4, y / 1e4] for x, y in square(0.0, 0.0, half)]

    origin = {"latitude_deg": 0.0, "longitude_deg": 0.0}
    coordinates = [[ring(9.0), ring(5.0)], [ring(3.0), ring(1.0)]]
    fence = {"kind": "inclusion", "coordinates": coordinates}
    mission = rf.Mission.from_dict(beside(geodetic_origin=origin, fences=[fence]))
    (area,) = mission.fences
    points = RNG.uniform(-110.0, 110.0, (400, 2))
    rings = area.rings(mission.geodetic_origin)
    around = sum(Outline(x).contains_points(points).astype(int) for x in rings)
    inside = area.region(mission.geodetic_origin, 0.0).distance(points) < 0.0
    assert np.array_equal(inside, around % 2 == 1)
    assert 50 < inside.sum() < 350


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("{", "is no GeoJSON"),
        ("[1]", "is no GeoJSON"),
        ('{"type": "Point", "coordinates": [0, 0]}', "has no polygon"),
        ('{"type": "Polygon", "coordinates": [[[0], [1], [2]]]}', "no polygons"),
        ('{"type": "Polygon", "coordinates": []}', "has no polygon"),
        ('{"type": "Polygon", "coordinates": [[]]}', "no polygons"),
        (
            '{"type": "Polygon", "coordinates": [[[500000, 5e6], [500100, 5e6], [500000, 6e6]]]}',
            "in degrees",
        ),
        ('{"type": "Polygon", "coordinates": [[[NaN, 1], [2, 3], [3, 4]]]}', "in degrees"),
        ('{"type": "Polygon", "coordinates": [[["1", 1], [2, 3], [3, 4]]]}', "in degrees"),
        ('{"type": "Polygon", "coordinates": [[[true, 1], [2, 3], [3, 4]]]}', "in degrees"),
        (
            '{"type": "Polygon", "coordinates": [], "crs": {"properties": {"name": "urn:ogc:def:crs:EPSG::3857"}}}',
            "coordinate reference system",
        ),
    ],
)
def test_what_is_no_polygon_is_refused(text, problem):
    """With what is wrong, not a traceback."""
    with pytest.raises(MissionError, match=problem):
        read_geojson(text.encode(), "site.geojson")


def test_a_fence_of_a_file_is_that_of_its_metres(tmp_path):
    """A mission with a GeoJSON file repeats from its record without the file, and says its digest and notes."""
    origin = {"latitude_deg": 47.0, "longitude_deg": 19.0}
    step = 1.0 / 111_194.0
    ring = [
        [19.0 + x * step / math.cos(math.radians(47.0)), 47.0 + y * step]
        for x, y in square(4, 3, 8)
    ]
    (tmp_path / "site.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    data = beside(geodetic_origin=origin, fences=[{"kind": "inclusion", "file": "site.geojson"}])
    path = tmp_path / "m.toml"
    path.write_text(
        rf.Mission.from_dict(beside(geodetic_origin=origin)).text
        + '\n[[fences]]\nkind = "inclusion"\nfile = "site.geojson"\n'
    )
    mission = rf.load_mission(path)
    (corners,) = mission.fences[0].polygons(mission.geodetic_origin)
    assert corners[0] == pytest.approx(np.array(square(4, 3, 8)), rel=5e-3, abs=0.05)
    assert any("SHA-256" in line for line in mission.text.splitlines())
    assert any("not closed" in r.text for r in rf.check(mission).remarks)
    again = rf.Mission.from_toml(mission.text)
    assert again.fences == mission.fences
    with pytest.raises(MissionError, match="is read only with a mission file"):
        rf.Mission.from_dict(data)


def test_a_fence_on_the_way_of_those_left_is_told_before_the_flight() -> None:
    """Lights above a closed area stay out of it; those that land after a loss do not, as check and flight say."""
    data = rf.load_mission("market-square").to_dict()
    corners = [[-9.0, 6.0], [9.0, 6.0], [9.0, 14.0], [-9.0, 14.0]]
    closed = {"name": "stage", "kind": "exclusion", "polygon": corners, "ceiling": 6.0}
    data["fences"] = [*data["fences"], closed]
    assert rf.check(rf.Mission.from_dict(data)).passed
    lost = {"lost": [{"agent": 3, "time": 13.5}], "on_loss": "land"}
    mission = rf.Mission.from_dict(data | {"disturbances": data["disturbances"] | lost})
    broken = [x for x in rf.check(mission).remarks if x.topic == "fence" and x.level == "fails"]
    assert "'stage'" in broken[0].text
    assert "land (loss)" in broken[0].text
    assert not rf.assess(rf.simulate(mission)).by_name["fence"].passed
