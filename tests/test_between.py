"""Every quantity of a verdict is that of continuous time, or says that it is known at samples alone."""

import io
import json
import math
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import rigidfleet as rf
from rigidfleet.assessment import Verdict, safety
from rigidfleet.assessment.verdict import CheckResult
from rigidfleet.mission import Mission, load_mission
from rigidfleet.preflight.check import check as foresee
from rigidfleet.reporting import report_page
from rigidfleet.result import Extremum, Result
from rigidfleet.simulation.together import simulate_together
from rigidfleet.sweep.metrics import METRICS, measure_metrics

#: Limits by direction that no flight here reaches.
FREE = {
    "horizontal_speed": 99.0,
    "vertical_speed": 99.0,
    "horizontal_acceleration": 99.0,
    "vertical_acceleration": 99.0,
}
#: Quantities of which nothing is known between samples: of points, and what is more of vehicles with rotors.
AT_SAMPLES = {"singular_value", "tracking_error"}
OF_ROTORS = {"singular_value", "constraint", "tension"}


def checks(verdict: Verdict) -> dict[str, CheckResult]:
    return {check.check: check for check in verdict.checks}


def flown(name: str, step: float, **tables: Any) -> tuple[Result, dict[str, CheckResult]]:
    """A flight of a shipped mission with limits by direction, recorded every ``step`` [s], and its checks."""
    data = load_mission(name).to_dict()
    for key, table in tables.items():
        data[key] = data.get(key, {}) | table if isinstance(table, dict) else table
    data["limits"] = FREE | data.get("limits", {}) | tables.get("limits", {})
    result = rf.simulate(Mission.from_dict(data | {"output_step": step}))
    return result, checks(rf.assess(result))


def extreme(result: Result, name: str) -> Extremum:
    x = result.extreme(name)
    assert x is not None
    return x


def words_of(verdict: Verdict) -> str:
    console = Console(width=200, file=io.StringIO(), record=True)
    console.print(verdict)
    return console.export_text()


# -- limits by direction


@pytest.mark.parametrize("step", [0.05, 1.0])
def test_a_limit_by_direction_is_held_between_samples(step):
    """In wind, 3.302 m/s^2 are flown over the ground, between samples of .05 s as of 1 s: 3.25 are not kept."""
    result, found = flown("windy-passage", step, limits={"horizontal_acceleration": 3.25})
    dense, _ = flown("windy-passage", 1e-3)
    right = np.hypot(*np.moveaxis(dense.acceleration[..., :2], -1, 0)).max()
    assert right == pytest.approx(3.302, abs=1e-3)
    check = found["horizontal_acceleration"]
    assert check.worst == pytest.approx(right, rel=1e-4)
    assert not check.passed
    assert not check.at_samples
    assert extreme(result, "horizontal_acceleration").value == check.worst


def compared(name: str, steps: list[float], **tables: Any) -> None:
    """Assert that no value of a verdict is better than that of samples a millisecond apart, unless it is marked.

    A sample at one of these moments is no better than the quantity in continuous time, whatever the code under test.
    """
    _, right = flown(name, 1e-3, **tables)
    sampled = OF_ROTORS if "rotor_force" in right else AT_SAMPLES
    for step in steps:
        _, found = flown(name, step, **tables)
        assert {c.check for c in found.values() if c.at_samples} <= sampled
        for key, check in found.items():
            dense = right[key]
            if check.worst is None or dense.worst is None or check.at_samples:
                continue
            worse = dense.worst - check.worst
            if check.check == "tension":
                worse = abs(dense.worst) - abs(check.worst)
            worse = -worse if check.at_least else worse
            assert worse <= 1e-4 * max(1.0, abs(dense.worst)), (name, step, key, check, dense)


@pytest.mark.parametrize("seed", [1, 2])
def test_no_value_of_a_flight_in_wind_is_understated(seed):
    """Of points in gusts and noise, at seeded output steps of .05 to 1 s, against samples every millisecond."""
    rng = np.random.default_rng(seed)
    disturbances = load_mission("windy-passage").to_dict()["disturbances"]
    for part in ("gusts", "noise"):
        disturbances[part]["seed"] = seed
    phases = load_mission("windy-passage").to_dict()["phases"][:2]
    steps = (10.0 ** rng.uniform(math.log10(0.05), 0.0, 2)).tolist()
    compared("windy-passage", steps, disturbances=disturbances, phases=phases)


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["narrow-passage", "windy-passage", "cube-passage", "passage-quadrotors", "crazyflies"]
)
def test_no_value_of_a_shipped_flight_is_understated(name):
    """Points, cubes and quadrotors, at seeded output steps of .05 to 1 s, against samples every millisecond."""
    rng = np.random.default_rng(5)
    compared(name, (10.0 ** rng.uniform(math.log10(0.05), 0.0, 4)).tolist())


def test_body_axes_come_to_the_same_limits_by_direction():
    """Both formulations have the same greatest speeds and accelerations by direction."""
    one, other = (
        flown("narrow-passage", 1.0, **({"formulation": kind} | _shorten_text("narrow-passage")))[1]
        for kind in ("inertial", "body")
    )
    for name in FREE:
        assert one[name].worst == pytest.approx(other[name].worst, rel=1e-4), name


def _shorten_text(name: str) -> dict[str, Any]:
    return {"phases": load_mission(name).to_dict()["phases"][:2]}


def test_flights_side_by_side_have_the_limits_by_direction_of_single_ones():
    """What a sweep finds of eight flights in wind is what each finds alone."""
    missions = []
    for k in range(8):
        data = load_mission("windy-passage").to_dict() | _shorten_text("windy-passage")
        data["disturbances"]["gusts"]["seed"] = k
        missions.append(Mission.from_dict(data | {"limits": FREE, "output_step": 1.0}))
    for result, mission in zip(simulate_together(missions), missions, strict=True):
        alone = rf.simulate(mission)
        for name in FREE:
            assert extreme(result, name).value == pytest.approx(
                extreme(alone, name).value, rel=2e-3
            )


def test_a_large_fleet_has_limits_by_direction():
    """Of 45 points under a constant force, the closed form: v = v0 + f t, a = f."""
    n = 45
    position = [[3.0 * i, 0.0, 20.0] for i in range(n)]
    hold = {"kind": "hold", "control": "open", "until": 1.0, "input_force": [0.3, 0.4, -1.2]}
    mission = Mission.from_dict(
        {
            "schema_version": 1, "name": "many", "limits": FREE, "output_step": 1.0, "phases": [hold],
            "agents": {"mass": 1.0, "position": position, "velocity": [[0.0, 0.0, 2.0]] * n},
        }
    )  # fmt: skip
    found = checks(rf.assess(rf.simulate(mission)))
    expected = {
        "horizontal_speed": 0.5,
        "vertical_speed": 2.0,
        "horizontal_acceleration": 0.5,
        "vertical_acceleration": 1.2,
    }
    for name, value in expected.items():
        assert found[name].worst == pytest.approx(value, abs=1e-6), name


def test_curves_of_others_have_limits_by_direction_in_closed_form():
    """A helix of 2 m at 1.5 rad/s that climbs at .7 m/s, sampled with speeds and accelerations."""
    t = np.linspace(0.0, 6.0, 61)
    c, s, w = np.cos(1.5 * t), np.sin(1.5 * t), 1.5
    r = np.stack([2 * c, 2 * s, 5 + 0.7 * t], axis=1)[:, None]
    v = np.stack([-2 * w * s, 2 * w * c, 0.7 + 0 * t], axis=1)[:, None]
    a = np.stack([-2 * w * w * c, -2 * w * w * s, 0 * t], axis=1)[:, None]
    found = checks(rf.assess(rf.trajectories(t, r, velocity=v, acceleration=a, limits=FREE)))
    expected = (3.0, 0.7, 4.5, 0.0)
    for name, value in zip(FREE, expected, strict=True):
        assert found[name].worst == pytest.approx(value, abs=2e-4), name
        assert not found[name].at_samples


# -- what is marked


def test_what_is_known_at_samples_alone_is_marked_in_table_json_and_report(tmp_path):
    """An older file, which has no extremes by direction, is judged by its samples, and says so in every form."""
    result, _ = flown("windy-passage", 1.0, **_shorten_text("windy-passage"))
    for phase in result.phases:
        for name in FREE:
            phase.extremes.pop(name)
    result.save(tmp_path / "old.nc")
    old = Result.load(tmp_path / "old.nc")
    verdict = rf.assess(old)
    found = checks(verdict)
    right = np.hypot(old.acceleration[..., 0], old.acceleration[..., 1]).max()
    assert found["horizontal_acceleration"].worst == pytest.approx(right)
    marked = {check["check"] for check in verdict.to_dict()["checks"] if check["at_samples"]}
    assert marked == AT_SAMPLES | set(FREE)
    assert verdict.to_dict()["worst"]["singular_value"]["at_samples"]
    assert not verdict.to_dict()["worst"]["speed"]["at_samples"]
    assert "horizontal acceleration, at samples" in words_of(verdict)
    rows = {row.quantity: row.worst for row in safety(old, verdict) if row.worst is not None}
    assert rows["horizontal speed"].at_samples
    assert not rows["speed"].at_samples
    assert "horizontal acceleration, at samples" in report_page([old])


def test_every_limit_that_fails_a_flight_is_a_metric_of_a_sweep():
    """A limit of 1 cm/s or 1 cm/s^2 fails a flight, and a sweep keeps the value that failed it."""
    for name in ("speed", "acceleration", *FREE):
        result, found = flown(
            "windy-passage", 1.0, limits={name: 0.01}, **_shorten_text("windy-passage")
        )
        verdict = rf.assess(result)
        assert not found[name].passed
        assert measure_metrics(result, verdict)[name] == found[name].worst
        assert name in METRICS


# -- first contacts


def straight(obstacles: list[dict[str, Any]], **changes: Any) -> Result:
    """Vehicles that fly straight on at a constant velocity, from 10 m above z = 0, for 4 s."""
    agents = {
        "mass": 1.0,
        "radius": 0.25,
        "position": [[0.0, 0.0, 10.0]],
        "velocity": [[10.0, 0.0, -1.0]],
    }
    phase = {"kind": "hold", "control": "open", "until": 4.0, "input_force": [0.0, 0.0, 0.0]}
    data = {
        "schema_version": 1, "name": "straight", "agents": agents | changes, "obstacles": obstacles,
        "phases": [phase], "gravity": 0.0, "output_step": 0.5,
    }  # fmt: skip
    return rf.simulate(Mission.from_dict(data))


GROUND = {"kind": "ground", "height": 7.0}
SILL = {"kind": "box", "name": "sill", "min": [14.0, -5.0, 0.0], "max": [14.1, 5.0, 20.0]}
BALL = {"kind": "sphere", "name": "ball", "centre": [14.0, 0.0, 8.6], "radius": 0.5}


@pytest.mark.parametrize(
    ("obstacles", "what", "when"),
    [
        ([GROUND, SILL], "sill", 1.375),
        ([SILL, GROUND], "sill", 1.375),
        ([GROUND, BALL], "ball", 1.325),
        ([GROUND, BALL, SILL], "ball", 1.325),
        ([GROUND], "ground", 2.75),
    ],
)
def test_the_obstacle_that_is_hit_first_is_named(obstacles, what, when, tmp_path):
    """Of a sill, a ball and the ground, which is entered last and deepest, by a straight line: when and what.

    The integrator's steps are long here: several of them are hit in one. The line passes the ball's centre.
    """
    result = straight(obstacles)
    verdict = rf.assess(result)
    check = checks(verdict)["clearance"]
    assert not check.passed
    assert check.first is not None
    assert check.first.who == f"agent 1, {what}"
    assert check.first.when == pytest.approx(when, abs=2e-3 if what == "ball" else 1e-5)
    assert f"agent 1 hits '{what}', first at {check.first.when:.2f} s" in verdict.summary
    first = next(c for c in verdict.to_dict()["checks"] if c["check"] == "clearance")["first"]
    assert (first["who"], first["when"]) == (check.first.who, check.first.when)
    assert f"first agent 1, {what}" in words_of(verdict)
    result.save(tmp_path / "a.nc")
    assert checks(rf.assess(tmp_path / "a.nc"))["clearance"].first == check.first
    json.loads(verdict.json())


def test_report_and_replay_name_the_first_contact():
    """Both pages name the sill, which is hit before the ground."""
    result = straight([GROUND, SILL])
    page = report_page([result])
    assert "agent 1 hits &#39;sill&#39;, first at 1.38 s" in page
    assert "first agent 1, sill" in page
    assert "agent 1 first hits sill" in rf.replay(result).html


def test_the_pair_that_collides_first_is_named():
    """Of three in a row, the two that touch at .45 s are named, not those that overlap most, from 1 s on."""
    result = straight(
        [],
        position=[[0.0, 0.0, 10.0], [5.0, 0.45, 10.0], [10.5, 0.0, 10.0]],
        velocity=[[10.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    )
    verdict = rf.assess(result)
    check = checks(verdict)["separation"]
    assert (check.who, check.worst) == ("agents 1 and 3", pytest.approx(-0.5, abs=1e-6))
    assert check.first is not None
    assert check.first.who == "agents 1 and 2"
    touch = (5.0 - math.sqrt(0.5**2 - 0.45**2)) / 10.0
    assert check.first.when == pytest.approx(touch, abs=1e-5)
    assert "agent 1 first hits agent 2" in rf.replay(result).html


def test_flights_side_by_side_name_the_first_contact_of_single_ones():
    """Eight that meet one after the other, at other times each: as alone."""
    missions = []
    for k in range(8):
        data = straight([GROUND, SILL]).mission.to_dict()
        data["agents"]["velocity"] = [[10.0 + 0.1 * k, 0.0, -1.0]]
        missions.append(Mission.from_dict(data))
    for k, result in enumerate(simulate_together(missions)):
        x = extreme(result, "clearance_first")
        assert (x.who, x.other) == (0, 1)
        assert x.time == pytest.approx(13.75 / (10.0 + 0.1 * k), abs=1e-5)


def test_first_contacts_of_curves_and_of_large_fleets_are_named():
    """A straight line that others made, and 45 vehicles of which the last two touch at 1 s."""
    t = np.linspace(0.0, 4.0, 5)
    line = np.stack([10 * t, 0 * t, 10 - t], axis=1)[:, None]
    judged = straight([GROUND, SILL]).mission
    x = extreme(rf.trajectories(t, line, mission=judged), "clearance_first")
    assert (x.other, x.time) == (1, pytest.approx(1.375, abs=1e-5))
    position = [[3.0 * i, 0.0, 10.0] for i in range(44)] + [[3.0 * 43 + 10.5, 0.0, 10.0]]
    velocity = [[0.0, 0.0, 0.0]] * 44 + [[-10.0, 0.0, 0.0]]
    x = extreme(straight([], position=position, velocity=velocity), "separation_first")
    assert (x.who, x.other, x.time) == (43, 44, pytest.approx(1.0, abs=1e-5))


def test_of_samples_alone_the_first_contact_is_that_of_the_first_sample():
    """A record without extremes names the first sample that touches, and is marked."""
    result = straight([GROUND, SILL])
    for phase in result.phases:
        phase.extremes.clear()
    check = checks(rf.assess(result))["clearance"]
    assert check.first is not None
    assert check.first.when in result.time
    assert check.at_samples


# -- standing


def ends_beside(obstacles: list[dict[str, Any]], end: list[float], **tables: Any) -> Result:
    """A vehicle of .25 m that flies from (0, 0, 5) to a point, along a straight line in 6 s, and stays for 2 s."""
    phases = [
        {"kind": "fly", "position": end, "duration": 6.0},
        {"kind": "hold", "duration": 2.0},
    ]
    one = {"mass": 1.0, "radius": 0.25, "position": [[0.0, 0.0, 5.0]]}
    data = {
        "schema_version": 1,
        "name": "beside",
        "smoothness": "jerk",
        "agents": one,
        "phases": phases,
    }
    return rf.simulate(Mission.from_dict(data | {"obstacles": obstacles} | tables))


WALL = {"kind": "box", "name": "wall", "min": [4.0, -5.0, 0.0], "max": [4.2, 5.0, 9.0]}
#: A ball that comes to .012 m above the vehicle's place and stays until the end.
MOVING = {
    "kind": "sphere",
    "name": "moving",
    "radius": 0.5,
    "waypoints": [[3.0, 0.0, 11.0], [3.0, 0.0, 5.762]],
    "times": [0.0, 8.0],
}
SLOPE = {"kind": "heights", "name": "terrain", "spacing": 10.0, "corner": [-10, -10]}


@pytest.mark.parametrize("recorded", [True, False])
@pytest.mark.parametrize(
    ("obstacles", "end", "stands"),
    [
        ([WALL], [3.738, 0.0, 5.0], False),
        ([WALL | {"yaw_deg": 1e-9}], [3.738, 0.0, 5.0], False),
        ([{"kind": "ground", "height": -9.0}, WALL], [3.738, 0.0, 5.0], False),
        ([{"kind": "ground", "height": 4.7}, WALL], [3.738, 0.0, 5.0], False),
        ([MOVING], [3.0, 0.0, 5.0], False),
        ([{"kind": "sphere", "name": "lamp", "centre": [3.0, 0.0, 5.762], "radius": 0.5}], [3.0, 0.0, 5.0], False),
        ([{"kind": "ground", "height": 0.0}], [3.0, 0.0, 0.262], True),
        ([WALL], [4.1, 0.0, 9.262], True),
        ([WALL | {"yaw_deg": 1e-9}], [4.1, 0.0, 9.262], True),
        ([SLOPE | {"heights": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [2.0, 2.0, 2.0]]}], [3.0, 0.0, 1.564], True),
    ],
)  # fmt: skip
def test_only_what_is_below_is_stood_upon(obstacles, end, stands, recorded):
    """A vehicle that ends .012 m beside a wall, under a lamp or a ball flies; on ground, roof and slope it stands.

    From extremes in continuous time and from samples alone.
    """
    above = {"mass": 1.0, "radius": 0.25, "position": [[end[0], end[1], end[2] + 5.0]]}
    result = ends_beside(obstacles, end, **({"agents": above} if stands else {}))
    if not recorded:
        for phase in result.phases:
            phase.extremes.clear()
    verdict = rf.assess(result)
    found = checks(verdict)
    assert verdict.passed, verdict.summary
    assert ("clearance_end" in found) == stands
    assert ("clearance_start" in found) == (obstacles[0].get("height") == 4.7)
    least = found["clearance_end" if stands else "clearance"]
    assert least.worst == pytest.approx(0.012, abs=1e-3)
    if not stands:
        assert obstacles[-1].get("name", "") in least.who


def test_a_vehicle_that_starts_beside_a_wall_flies_beside_it():
    """The .012 m to a wall beside the start count in flight, on the ground as above it."""
    for height in (0.25, 5.0):
        beside = WALL | {"max": [0.0 - 0.262, 5.0, 9.0], "min": [-1.0, -5.0, -1.0]}
        start = {"mass": 1.0, "radius": 0.25, "position": [[0.0, 0.0, height]]}
        ground = {"kind": "ground"}
        result = ends_beside([ground, beside], [3.0, 0.0, 3.0], agents=start)
        found = checks(rf.assess(result))
        assert found["clearance"].worst == pytest.approx(0.012, abs=1e-9)
        assert "wall" in found["clearance"].who
        assert ("clearance_start" in found) == (height == 0.25)


def test_nobody_lands_on_a_wall():
    """At the end of a landing that ends in the air beside a wall, no vehicle is on the ground."""
    data = {
        "schema_version": 1,
        "name": "beside",
        "agents": {"mass": 1.0, "radius": 0.25, "position": [[3.738, 0.0, 5.0]]},
        "obstacles": [{"kind": "ground"}, WALL],
        "phases": [{"kind": "land", "duration": 5.0}],
    }
    result = rf.simulate(Mission.from_dict(data))
    assert checks(rf.assess(result))["touch_down"].passed
    last = result.samples(-1).stop - 1
    position = result.position.copy()
    position[..., 2] += 1.0
    lifted = result.position[last].copy()
    result.position[:] = position
    assert lifted[0, 2] < 0.4
    check = checks(rf.assess(result))["touch_down"]
    assert not check.passed
    assert "no vehicle is on the ground" in check.message


@pytest.mark.parametrize("phases", [["takeoff"], ["takeoff", "land"]])
@pytest.mark.parametrize("depth", [0.0, 1e-5])
def test_a_check_lets_vehicles_stand_on_the_ground(phases, depth):
    """Vehicles that start in contact with the ground pass, and a check foresees no hit; .01 mm in it, both fail."""
    every = {"takeoff": {"kind": "takeoff", "height": 6.0}, "land": {"kind": "land"}}
    data = {
        "schema_version": 1, "name": "pad", "obstacles": [{"kind": "ground"}],
        "agents": {"mass": 1.0, "radius": 0.25, "position": [[0.0, 0.0, 0.25 - depth], [4.0, 0.0, 0.25]]},
        "phases": [every[kind] | {"duration": 8.0} for kind in phases],
    }  # fmt: skip
    pad = Mission.from_dict(data)
    assert any(remark.level == "fails" for remark in foresee(pad).remarks) == (depth > 0.0)
    assert rf.assess(rf.simulate(pad)).passed == (depth == 0.0)
