"""Flights that others made, judged as curves in continuous time."""

import os
import subprocess
import sys
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import BPoly, CubicSpline
from scipy.spatial.distance import pdist

import rigidfleet as rf
from rigidfleet.math.bernstein import greatest_convex_value
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.mission import Mission
from rigidfleet.simulation.trajectories import result_of_curve


def check_of(verdict, name):
    return next(c for c in verdict.checks if c.check == name)


def least(r):
    """Least distance of any two, (K, N, 3)."""
    return min(
        np.linalg.norm(r[:, i] - r[:, j], axis=1).min()
        for i, j in combinations(range(r.shape[1]), 2)
    )


def test_lines_that_cross_between_samples():
    """Two vehicles whose samples are a metre apart, and which meet half way between two of them."""
    a = np.array([[0.0, 0, 2], [1, 0, 2], [2, 0, 2]])
    b = np.array([[0.0, 1, 2], [1, -1, 2], [2, -2, 2]])
    verdict = rf.assess(rf.trajectories([0.0, 1.0, 2.0], np.stack([a, b], axis=1), separation=0.1))
    assert not verdict.passed
    found = check_of(verdict, "separation")
    assert found.worst == pytest.approx(0.0, abs=1e-9)
    assert found.when == pytest.approx(0.5)
    assert any("straight lines between samples" in note for note in verdict.notes)
    assert check_of(verdict, "speed").worst == pytest.approx(np.sqrt(5.0))


@pytest.mark.parametrize("seed", range(3))
def test_splines_are_judged_as_scipy_evaluates_them(seed):
    """Extremes of cubic splines agree with dense samples of SciPy's own evaluation."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.3, 1.2, 25))
    p = np.cumsum(rng.normal(0, 1, (25, 6, 3)), axis=0) + [0, 0, 40]
    limits = dict.fromkeys(
        (
            "speed",
            "acceleration",
            "horizontal_speed",
            "vertical_speed",
            "horizontal_acceleration",
            "vertical_acceleration",
        ),
        1000.0,
    )
    flight = rf.trajectories(t, p, cubic=True, separation=0.0, limits=limits)
    verdict = rf.assess(flight)
    c = CubicSpline(t, p)
    dense = np.linspace(t[0], t[-1], 100_001)
    r, v, a = (c(dense, k) for k in range(3))
    expected = {
        "separation": least(r),
        "speed": np.linalg.norm(v, axis=2).max(),
        "acceleration": np.linalg.norm(a, axis=2).max(),
        "horizontal_speed": np.hypot(v[..., 0], v[..., 1]).max(),
        "vertical_speed": abs(v[..., 2]).max(),
        "horizontal_acceleration": np.hypot(a[..., 0], a[..., 1]).max(),
        "vertical_acceleration": abs(a[..., 2]).max(),
    }
    for name, value in expected.items():
        assert check_of(verdict, name).worst == pytest.approx(value, rel=1e-4), name
        if name != "separation":
            assert check_of(verdict, name).worst >= value * (1 - 1e-12), name
    assert check_of(verdict, "separation").worst <= expected["separation"] + 1e-9


@pytest.mark.parametrize("count", [2, 3, 4])
def test_pieces_meet_all_that_is_given(count):
    """With velocities, accelerations and jerks, the curve is the polynomial that meets them (SciPy's BPoly)."""
    rng = np.random.default_rng(count)
    t = np.cumsum(rng.uniform(0.5, 2.0, 8))
    x = rng.normal(0, 1, (count, 8, 4, 3)) * 5.0
    known: dict[str, Any] = dict(zip(("velocity", "acceleration", "jerk"), x[1:], strict=False))
    flight = rf.trajectories(t, x[0], **known, separation=0.0)
    curve = BPoly.from_derivatives(t, x.swapaxes(0, 1))
    np.testing.assert_allclose(flight.position, curve(flight.time), atol=1e-9)
    inside = np.abs(flight.time[:, None] - t).min(axis=1) > 1e-6
    np.testing.assert_allclose(flight.velocity[inside], curve(flight.time[inside], 1), atol=1e-7)
    dense = np.linspace(t[0], t[-1], 40_001)
    worst = flight.phases[0].extremes
    separation = min(pdist(r).min() for r in curve(dense))
    assert worst["separation"].value == pytest.approx(separation, abs=1e-3)
    assert worst["separation"].value <= separation + 2e-6
    speed = np.linalg.norm(curve(dense, 1), axis=2).max()
    assert worst["speed"].value == pytest.approx(speed, rel=1e-5)
    acceleration = np.linalg.norm(curve(dense, 2), axis=2).max()
    assert worst["acceleration"].value == pytest.approx(acceleration, rel=1e-4)
    assert worst["highest"].value == pytest.approx(curve(dense)[..., 2].max(), abs=1e-4)


def test_a_flight_of_our_own_judged_again_from_its_setpoints(tmp_path):
    """The same worst values, from the positions that a flight wrote; the mission gives obstacles, radii and limits."""
    own = rf.simulate("narrow-passage")
    motion = own.setpoints(flown=True)
    r, v, a, _ = motion.state.swapaxes(0, 1)
    again = rf.trajectories(motion.time, r, velocity=v, acceleration=a, mission="narrow-passage")
    first, second = rf.assess(own), rf.assess(again)
    for name in ("separation", "clearance", "speed"):
        assert check_of(second, name).worst == pytest.approx(
            check_of(first, name).worst, rel=1e-3
        ), name
    assert second.passed
    again.save(tmp_path / "again.nc")
    loaded = rf.assess(rf.Result.load(tmp_path / "again.nc"))
    assert loaded.to_dict() == second.to_dict()
    rf.report(again, tmp_path / "report.html")
    rf.replay(again, tmp_path / "replay.html")
    assert rf.plot(again, tmp_path / "figures", formats=["png"])
    rf.export(again, tmp_path / "again.csv", "setpoints")


def test_limits_of_a_direction_hold_for_our_own_flights():
    """A mission's limits up and down, and over the ground, are judged, and planned where times are automatic."""
    data = rf.load_mission("narrow-passage").to_dict()
    data["limits"] = data.get("limits", {}) | {"horizontal_speed": 0.5, "vertical_speed": 50.0}
    verdict = rf.assess(rf.simulate(Mission.from_dict(data)))
    assert not check_of(verdict, "horizontal_speed").passed
    assert check_of(verdict, "vertical_speed").passed
    climb = {
        "schema_version": 1, "name": "climb", "smoothness": "jerk",
        "agents": {"mass": 1.0, "position": [[0, 0, 0], [3, 0, 0]]},
        "formations": {"row": {"slots": [[0, 0, 0], [3, 0, 0]]}},
        "limits": {"speed": 5.0, "vertical_speed": 1.0},
        "phases": [
            {"kind": "establish", "formation": "row", "control": "tracking", "duration": 2.0, "blend": 1.0},
            {"kind": "fly", "position": [1.5, 0, 10], "duration": "auto"},
        ],
    }  # fmt: skip
    flown = rf.simulate(Mission.from_dict(climb))
    assert flown.time[-1] == pytest.approx(
        2.0 + 10.0 * 35 / 16, rel=1e-2
    )  # the septic's peak is 35/16 of its mean
    assert check_of(rf.assess(flown), "vertical_speed").worst == pytest.approx(1.0, abs=1e-2)


def test_what_straight_lines_do_not_have_is_not_passed():
    """A limit of acceleration fails where lines are assumed, and holds with cubics."""
    t = np.linspace(0, 4, 9)
    p = np.stack([np.sin(t), np.cos(t), 0 * t + 5], axis=1)[:, None]
    limits = {"acceleration": 1.5}
    lines = rf.assess(rf.trajectories(t, p, limits=limits))
    assert "cannot be judged" in check_of(lines, "acceleration").message
    assert not lines.passed
    assert rf.assess(rf.trajectories(t, p, cubic=True, limits=limits)).passed


T = [0.0, 1.0, 2.0]
P = np.zeros((3, 2, 3)) + [[0, 0, 1], [1, 0, 1]]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"time": [0, 1, 1], "position": P}, "times must increase: sample 3 is at 1 s"),
        ({"time": [0, 1], "position": P}, "position has shape"),
        ({"time": T, "position": P * np.nan}, "position has a value that is not finite"),
        ({"time": T, "position": "here"}, "position is no array of numbers"),
        ({"time": T, "position": P[:, 0]}, "needs 3 dimensions"),
        ({"time": [0.0], "position": P[:1]}, "needs two samples"),
        ({"time": T, "position": P, "acceleration": P}, "without velocity"),
        ({"time": T, "position": P, "velocity": P[:2]}, "velocity has shape"),
        ({"time": T, "position": P, "yaw": P[..., 0][:2]}, "yaw has shape"),
        ({"time": T, "position": P, "mission": "narrow-passage"}, "has 3 agents, and there are 2"),
    ],
)
def test_what_is_no_trajectory_is_refused(given, message):
    with pytest.raises(rf.ResultError, match=message):
        rf.trajectories(**given)


def test_wrong_limits_are_refused():
    with pytest.raises(rf.MissionError, match="sped"):
        rf.trajectories(T, P, limits={"sped": 1.0})


def test_greatest_of_curves():
    """The greatest length of random curves is that of dense samples, and not less."""
    rng = np.random.default_rng(5)
    c, h = rng.normal(size=(40, 3, 6)), rng.uniform(0.2, 2.0, 40)
    points = Piecewise(np.append(0.0, np.cumsum(h)), c).control_points()
    found = greatest_convex_value(points, lambda x: np.linalg.norm(x, axis=-1))
    x = np.linspace(0, 1, 20_001)[:, None] * h
    dense = np.linalg.norm(
        np.stack([sum(c[:, q, p] * x**p for p in range(6)) for q in range(3)], -1), axis=-1
    )
    assert found.value == pytest.approx(dense.max(), rel=1e-6)
    assert found.value >= dense.max() * (1 - 1e-9)
    assert found.curve == dense.max(axis=0).argmax()


@pytest.mark.parametrize("cubic", [False, True])
def test_the_positions_of_a_result_are_judged_again(cubic):
    """Two samples at a switch of phases are one knot with two states; the least distance is that of the lines."""
    own = rf.simulate("narrow-passage")
    assert (np.nextafter(own.time[:-1], np.inf) >= own.time[1:]).any()
    yaw = np.repeat(0.1 * own.time[:, None], 3, axis=1)
    again = rf.trajectories(own.time, own.position, yaw=yaw, cubic=cubic, separation=0.3)
    dense = np.linspace(own.time[0], own.time[-1], 200_001)
    r = np.stack(
        [[np.interp(dense, own.time, x) for x in y.T] for y in own.position.swapaxes(0, 1)]
    )
    between = least(r.transpose(2, 0, 1))
    within = 1e-3 if cubic else 1e-9
    assert again.phases[0].extremes["separation"].value == pytest.approx(between, abs=within)
    assert rf.assess(again).passed == (between >= 0.3)
    at = np.searchsorted(again.time, own.time)
    np.testing.assert_allclose(again.position[at], own.position, atol=1e-9)
    assert again.yaw is not None
    np.testing.assert_allclose(again.yaw[at], yaw, atol=1e-9)


@pytest.mark.parametrize("cubic", [False, True])
def test_a_jump_at_a_switch_is_refused(cubic):
    """Two samples at one time with places a metre apart are no flight, whatever is assumed between samples."""
    t = [0.0, 1.0, np.nextafter(1.0, 2.0), 2.0, 3.0]
    x = np.array([[0.0, 0, 1], [1, 0, 1], [2, 0, 1], [3, 0, 1], [4, 0, 1]])[:, None]
    with pytest.raises(rf.ResultError, match=r"agent 1 jumps by 1 m at 1 s"):
        rf.trajectories(t, x, cubic=cubic)
    with pytest.raises(rf.ResultError, match="a trajectory lasts"):
        rf.trajectories(t[1:3], x[1:3])


def test_starts_stay_where_they_are(tmp_path):
    """Vehicles that begin at one place are judged there: nothing is moved, in memory or in the file."""
    t = np.linspace(0.0, 3.0, 4)
    x = np.zeros((4, 3, 3)) + [0.0, 0, 5]
    x[1:, 1, 0], x[:, 2, 2] = [1, 2, 3], 5.0 + 1e-12
    flight = rf.trajectories(t, x, separation=0.2)
    flight.save(tmp_path / "same.nc")
    for result in (flight, rf.Result.load(tmp_path / "same.nc")):
        np.testing.assert_array_equal(result.mission.fleet.position, x[0])
        np.testing.assert_array_equal(result.position[0], x[0])
        assert result.phases[0].extremes["separation"].value == 0.0
        assert not rf.assess(result).passed


def test_to_judge_plans_nothing_and_writes_no_text(monkeypatch):
    """Without planner, integrator, and missions as text, a trajectory is judged as with them."""
    t = np.linspace(0.0, 4.0, 9)
    x = np.stack([np.sin(t), np.cos(t), 0 * t + 5], axis=1)[:, None] + [[0, 0, 0], [0, 0, 2]]
    wanted = rf.assess(rf.trajectories(t, x, cubic=True, separation=0.5)).to_dict()

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError

    for place in (
        "rigidfleet.planning.plan.plan_phase",
        "rigidfleet.kernel.records.integrator",
        "rigidfleet.mission.model.to_toml",
        "rigidfleet.mission.model.parse_toml",
    ):
        monkeypatch.setattr(place, refuse)
    judging = sys.modules["rigidfleet.simulation.trajectories"]
    assert not {"plan_phase", "workspace", "integrator"} & set(vars(judging))
    flight = rf.trajectories(t, x, cubic=True, separation=0.5)
    assert rf.assess(flight).to_dict() == wanted


@pytest.mark.parametrize("powers", [2, 6, 8])
def test_long_pieces_of_any_degree_are_watched_exactly(powers):
    """Of pieces of ten seconds, whose highest powers bend most at their end, extremes are those of dense samples."""
    rng = np.random.default_rng(powers)
    time = np.array([0.0, 10.0, 20.0])
    ends = rng.normal(0, 3, (powers // 2, 3, 2, 4))
    curve = Piecewise.hermite(time, ends)
    flight = result_of_curve(curve, "a curve", separation=0.0)
    dense = np.linspace(0.0, 20.0, 400_001)
    r = curve.at(dense)[..., :3]
    extremes = flight.phases[0].extremes
    apart = np.linalg.norm(r[:, 0] - r[:, 1], axis=1).min()
    assert extremes["separation"].value == pytest.approx(apart, abs=3e-6)
    assert extremes["highest"].value == pytest.approx(r[..., 2].max(), abs=3e-6)
    assert extremes["lowest"].value == pytest.approx(r[..., 2].min(), abs=3e-6)
    speed = np.linalg.norm(curve.states(dense[1:-1], 2)[1, ..., :3], axis=-1).max()
    assert extremes["speed"].value == pytest.approx(speed, rel=1e-5)


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells the peak of a process alone")
def test_a_thousand_vehicles_are_judged_in_little_memory():
    """480 samples each: the process needs less than 0.7 GB, curves, packages and threads included (measured: 0.47)."""
    code = """
from pathlib import Path
import numpy as np
import rigidfleet as rf
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.math.piecewise import stack_ways
from rigidfleet.simulation.trajectories import result_of_curve
from scipy.interpolate import CubicSpline
rng, t = np.random.default_rng(3), np.arange(480) * 0.1
curves = []
for i in range(1000):
    x = [3.0 * (i % 32), 3.0 * (i // 32), 20.0, 0.0] + np.sin(0.3 * t[:, None] + rng.uniform(0, 6, 4)) / 2
    curves.append(Piecewise(t, np.ascontiguousarray(np.moveaxis(CubicSpline(t, x).c[::-1], 0, -1))))
assert rf.assess(result_of_curve(stack_ways(curves), "splines", separation=0.5)).passed
print(next(x.split()[1] for x in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in x))
"""
    usual = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    process = subprocess.run(
        [sys.executable, "-c", code], env=usual, capture_output=True, text=True, check=True
    )
    assert int(process.stdout) * 1024 < 0.7e9


def test_yaw_has_its_rate():
    """A vehicle that turns evenly has that rate of yaw, also where its yaw is given from -pi to pi."""
    time = np.linspace(0.0, 8.0, 81)
    turned = (1.3 * time + np.pi) % (2 * np.pi) - np.pi
    place = np.stack([np.cos(time), np.sin(time), 0 * time], axis=1)[:, None]
    made = rf.trajectories(time, place, cubic=True, yaw=turned[:, None])
    assert made.yaw is not None
    assert made.yaw_rate is not None
    np.testing.assert_allclose(made.yaw_rate, 1.3, atol=1e-9)
    np.testing.assert_allclose(np.cos(made.yaw[:, 0] - 1.3 * made.time), 1.0)


def test_a_day_is_judged():
    """A span far beyond that of missions is judged as a short one: no key of a flight limits it."""
    place = np.array([[[0.0, 0, 2], [3, 0, 2]], [[5, 0, 1], [6, 0, 1]]])
    verdict = rf.assess(rf.trajectories([0.0, 86_400.0], place, separation=0.5))
    assert verdict.passed
    assert check_of(verdict, "separation").worst == pytest.approx(1.0)
