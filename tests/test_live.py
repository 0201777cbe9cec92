"""Flying by hand: the pilot, the session around it, and the address it is served on."""

import base64
import http.client
import json
import math
import queue
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from rigidfleet.assessment import assess
from rigidfleet.cli import app as cli
from rigidfleet.errors import FlightError, ResultError
from rigidfleet.math import attitude as att
from rigidfleet.mission import Mission, load_mission, mission_names
from rigidfleet.result import Result
from rigidfleet.simulation.flight import StoppedError
from rigidfleet.web.live import balls, live
from rigidfleet.web.live import session as sessions
from rigidfleet.web.live.guarding import with_avoidance_or_reason
from rigidfleet.web.live.pilot import TICK, Gust, Pilot
from rigidfleet.web.live.server import Server
from rigidfleet.web.live.session import Session
from rigidfleet.web.replay import replay_page

TRIANGLE = load_mission("narrow-passage")  # triangle and line


def mission(**changes) -> Mission:
    """Three vehicles, a triangle and a line, with changes."""
    data = TRIANGLE.to_dict()
    data["phases"] = [{"kind": "establish", "formation": "triangle", "until": 6.0}]
    return Mission.from_dict(data | changes)


def flown(pilot: Pilot, seconds: float) -> list:
    """Records of all ticks."""
    return [pilot.fly_tick() for _ in range(round(seconds / TICK))]


def worst(records: list, name: str) -> float:
    """Largest absolute value in records, where there is one."""
    values = np.concatenate([np.ravel(getattr(r, name)) for r in records])
    return float(np.nanmax(np.abs(values)))


def slot_error(record) -> float:
    return float(np.linalg.norm(record.slot_position - record.position, axis=2).max())


# -- the pilot


def test_follows_the_hand():
    """The body goes where the target was moved and turned, and stays there."""
    pilot = Pilot(TRIANGLE)
    flown(pilot, 6.0)
    start, yaw = pilot.target.r.copy(), pilot.target.euler[2]
    for _ in range(40):
        pilot.steer(np.array([1.0, -0.5, 0.25]), np.array([0.0, 0.0, 0.3]))
        pilot.fly_tick()
    np.testing.assert_allclose(pilot.target.r - start, [2.0, -1.0, 0.5], atol=1e-9)
    assert pilot.target.euler[2] - yaw == pytest.approx(0.6)
    pilot.steer(np.zeros(3), np.zeros(3))
    last = flown(pilot, 12.0)[-1]
    np.testing.assert_allclose(last.cm[0], pilot.target.r, atol=1e-4)
    away = att.angle_between(last.attitude[0], att.quaternion_from_dcm(pilot.target.attitude))
    assert float(away) < 1e-4


@pytest.mark.parametrize("yaw", ["formation", "fixed", "along", "towards"])
def test_quadrotors_follow_the_hand(yaw):
    """Quadrotors led by hand turn smoothly, stay near their slots, and are asked for no more than their rotors give."""
    data = load_mission("passage-quadrotors").to_dict()
    data["yaw"] = {"kind": yaw} | ({"point": [50.0, 0.0, 10.0]} if yaw == "towards" else {})
    pilot = Pilot(Mission.from_dict(data))
    flown(pilot, 6.0)
    records = []
    for _ in range(120):
        pilot.steer(np.array([1.5, 0.5, 0.0]), np.array([0.0, 0.0, 0.3]))
        records.append(pilot.fly_tick())
    assert pilot.flight.ending == ""
    assert max(map(slot_error, records)) < 0.02
    assert worst(records, "saturated") == 0.0
    assert worst(records, "vehicle_rates") < 1.5
    attitude = records[-1].vehicle_attitude
    assert attitude is not None
    turned = att.euler_from_quaternion(attitude[0])[:, 2]
    formation = att.euler_from_quaternion(records[-1].attitude)[0, 2]
    wanted = {"formation": formation, "fixed": 0.0}.get(yaw)
    if wanted is not None:
        np.testing.assert_allclose(turned, wanted, atol=0.05)


def test_quadrotors_by_hand_are_kept():
    """A flight of quadrotors by hand is kept with their attitudes and rotors, sample by sample, and can be judged."""
    pilot = Pilot(load_mission("crazyflies"))
    records = flown(pilot, 5.0)
    result = pilot.result()
    last = records[-1]
    for name in ("vehicle_attitude", "vehicle_rates", "rotor_force", "saturated"):
        kept = getattr(result, name)
        assert kept.shape[:2] == result.position.shape[:2]
        np.testing.assert_array_equal(kept[-1], getattr(last, name)[-1])
    checks = {check.check for check in assess(result).checks}
    assert {"rotor_force", "tilt", "tracking_error", "saturation"} <= checks


def test_stays_rigid():
    """Whatever the hand does, the formation holds its shape to a micrometre: references are fed forward."""
    pilot = Pilot(TRIANGLE)
    records = flown(pilot, 4.5)
    rng = np.random.default_rng(1)
    for k in range(200):
        if k % 8 == 0:
            pilot.steer(rng.normal(size=3), 0.4 * rng.normal(size=3))
        if k == 60:
            pilot.change_formation("line")
        records.append(pilot.fly_tick())
    assert pilot.formation == "line"
    assert worst(records, "constraint") < 1e-6
    assert max(map(slot_error, records)) < 1e-6


def test_levels_and_clears_the_ground():
    """At its start the body turns upright, and rises so far that it can turn without touching the ground."""
    last = flown(Pilot(TRIANGLE), 12.0)[-1]
    roll, pitch, _ = att.euler_from_quaternion(last.attitude[0])
    assert (abs(roll), abs(pitch)) < (1e-3, 1e-3)
    slots = TRIANGLE.formation_slots("triangle")
    assert slots is not None
    assert last.cm[0, 2] > np.linalg.norm(slots, axis=1).max() + 0.25


def test_one_change_after_another():
    """A change of formation waits until the one before is over; asking for the present one cancels it."""
    pilot = Pilot(TRIANGLE)
    pilot.change_formation("line")
    pilot.fly_tick()
    assert (pilot.formation, pilot.waiting, pilot.is_changing) == ("triangle", "line", True)
    flown(pilot, 4.1)
    assert (pilot.formation, pilot.waiting, pilot.is_changing) == ("line", None, True)
    pilot.change_formation("triangle")
    pilot.change_formation("line")
    flown(pilot, 5.0)
    assert (pilot.formation, pilot.is_changing) == ("line", False)
    assert [p.name for p in pilot.flight.phases] == ["establish triangle", "change to line"]


def test_lets_go():
    """A hand that is no longer heard of has let go."""
    pilot = Pilot(TRIANGLE)
    start = pilot.target.r[0]
    pilot.steer(np.array([1.0, 0.0, 0.0]), np.zeros(3))
    flown(pilot, 3.0)
    assert pilot.target.r[0] - start == pytest.approx(0.6, abs=TICK + 1e-9)


def test_speed_limit():
    """The hand moves the target no faster than 70 % of the mission's speed limit."""
    pilot = Pilot(mission(limits={"speed": 2.0}))
    pilot.steer(np.array([30.0, 40.0, 0.0]), np.zeros(3))
    np.testing.assert_allclose(pilot.target.move, [0.84, 1.12, 0.0])


def test_gust():
    """A gust displaces the vehicles one after the other and loads the edges; then all is as before."""
    pilot = Pilot(TRIANGLE)
    flown(pilot, 8.0)
    pilot.send_gust(np.array([2.0, 0.0, 0.0]), 3.0)
    hit = flown(pilot, 3.0)
    assert max(map(slot_error, hit)) > 0.2
    assert worst(hit, "multiplier") > 0.3
    assert max(r.external_force[0, :, 0].max() for r in hit) == pytest.approx(3.0, rel=0.05)
    after = flown(pilot, 12.0)
    assert pilot.gusts == []
    assert slot_error(after[-1]) < 1e-3
    np.testing.assert_allclose(after[-1].external_force[0], [[0, 0, -9.81]] * 3)


def test_gust_passes_over():
    """A gust is a front: further along its way it comes later, by distance over speed."""
    gust = Gust(start=10.0, origin=-2.0, direction=np.array([0.0, 1.0, 0.0]), strength=3.0)
    r = np.array([[5.0, -2.0, 1.0], [0.0, 6.0, 9.0]])
    first = gust.force(10.8, r, np.array([1.0, 2.0]))
    np.testing.assert_allclose(first, [[0, 3, 0], [0, 0, 0]], atol=1e-12)
    second = gust.force(11.8, r, np.array([1.0, 2.0]))
    np.testing.assert_allclose(second, [[0, 0, 0], [0, 6, 0]], atol=1e-12)


def test_by_body():
    """In the body architecture distances establish the formation, then the wrench on the body follows the hand."""
    pilot = Pilot(mission(architecture="body"))
    flown(pilot, 6.0)
    assert pilot.flight.phases[-1].control == "open"
    pilot.steer(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.2]))
    records = flown(pilot, 0.6)
    records += flown(pilot, 12.0)
    assert pilot.flight.phases[-1].control == "body"
    np.testing.assert_allclose(records[-1].cm[0], pilot.target.r, atol=1e-3)
    assert worst(records, "constraint") < 1e-3
    pilot.change_formation("line")
    flown(pilot, 6.0)
    assert pilot.formation == "line"
    assert pilot.flight.ending == ""


def test_nothing_to_fly():
    """A mission whose formations have no slots cannot be flown by hand, and says why."""
    edges = [[1, 2], [2, 3]]
    formations = {"chain": {"edges": edges, "distances": [4.0, 4.0]}}
    chain = {"kind": "establish", "formation": "chain", "reference": "distances", "control": "open"}
    with pytest.raises(FlightError, match="no formation has slots"):
        Pilot(mission(formations=formations, phases=[chain | {"until": 6.0}]))


def test_cannot_go_on(monkeypatch):
    """A flight that cannot go on says why, and stays where it is."""
    pilot = Pilot(TRIANGLE)
    before = flown(pilot, 1.0)[-1]

    def stop(*_):
        raise StoppedError("too steep")

    monkeypatch.setattr(pilot.flight._active, "fly_to", stop)
    after = pilot.fly_tick()
    assert pilot.flight.ending == "too steep"
    assert after is before


# -- obstacles


def settled(**changes) -> Pilot:
    """A pilot with the guard whose triangle hovers."""
    pilot = Pilot(with_avoidance_or_reason(mission(**changes))[0])
    flown(pilot, 7.0)
    return pilot


def places(pilot: Pilot) -> np.ndarray:
    return pilot.flight.observe().position


def target_slots(pilot: Pilot) -> np.ndarray:
    """Where the target would have the vehicles."""
    slots = pilot.flight.plan.slots
    assert slots is not None
    return slots @ pilot.target.attitude + pilot.target.r


def kept(result: Result, ball: int) -> Any:
    """A ball of the record."""
    return result.mission.obstacles[ball]


def clearance_of(result: Result, ball: int) -> float:
    """Least distance of all samples from a ball of the record, from places alone."""
    thing = kept(result, ball)
    there = (result.time >= thing.appears) & (result.time <= (thing.vanishes or math.inf))
    way = np.stack(
        [np.interp(result.time[there], thing.times, axis) for axis in np.transpose(thing.waypoints)], axis=1
    )  # fmt: skip
    away = np.linalg.norm(result.position[there] - way[:, None], axis=2)
    return float((away - thing.radius - result.mission.fleet.radius).min())


def test_a_ball_is_avoided_and_kept():
    """Vehicles give way to a ball that flies at one of them; the record has it: when, where, how it moved."""
    pilot = settled()
    start, appeared = places(pilot)[0] + [9.0, 0.0, 0.0], pilot.t
    ball = pilot.add_ball(start, 0.8, np.array([-2.0, 0.0, 0.0]))
    flown(pilot, 7.0)
    gone = pilot.t
    np.testing.assert_allclose(ball.place, start - [14.0, 0.0, 0.0], atol=1e-9)
    pilot.remove_ball(ball.slot)
    flown(pilot, 1.0)
    assert pilot.flight.ending == ""
    result = pilot.result()
    index = len(TRIANGLE.obstacles)
    thing = kept(result, index)
    assert (thing.name, thing.kind, thing.radius) == ("ball 1", "sphere", 0.8)
    assert (thing.appears, thing.vanishes) == pytest.approx((appeared, gone))
    np.testing.assert_allclose(thing.waypoints, [start, start - [14.0, 0.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(thing.times, [appeared, gone], atol=1e-9)
    assert clearance_of(result, index) > 0.0
    checks = {check.check: check for check in assess(result).checks}
    assert checks["clearance"].passed
    assert result.clearance_obstacle[result.time < appeared].max() < index
    assert result.clearance_obstacle[result.time > gone].max() < index
    assert index in result.clearance_obstacle
    assert result.avoidance_layers is not None  # barriers or guard, while the ball is near
    assert result.avoidance_layers[(result.time > appeared) & (result.time < gone)].any()
    assert not result.avoidance_layers[result.time < appeared].any()


def test_without_the_guard_contact_ends_the_flight():
    """Points that nothing guards meet the ball; the flight ends, and says who met what and when."""
    pilot = Pilot(mission())
    flown(pilot, 7.0)
    ball = pilot.add_ball(places(pilot)[1] + [0.0, 0.0, 5.0], 1.0, np.array([0.0, 0.0, -2.0]))
    flown(pilot, 4.0)
    met = 7.0 + (5.0 - 1.25) / 2.0  # the surfaces
    assert pilot.flight.ending.startswith("agent 2 met 'ball 1' at 8.")
    assert float(pilot.flight.ending.split()[-2]) == pytest.approx(met, abs=TICK)
    assert pilot.t == pytest.approx(met, abs=TICK)
    place = ball.place.copy()
    flown(pilot, 1.0)
    np.testing.assert_array_equal(ball.place, place)
    verdict = assess(pilot.result())
    assert not verdict.passed
    assert "agent 2 met 'ball 1'" in verdict.summary


def test_a_ball_is_drawn():
    """A ball follows where it is drawn to, no faster than allowed, and stays where it is let go."""
    pilot = settled()
    start = places(pilot).mean(axis=0) + [0.0, 12.0, 0.0]
    ball = pilot.add_ball(start, 0.5, np.zeros(3))
    pilot.pull_ball(ball.slot, start + [6.0, 0.0, 0.0])
    before = ball.place
    for _ in range(20):
        pilot.fly_tick()
        assert np.linalg.norm(ball.place - before) <= balls.QUICKEST * TICK + 1e-12
        before = ball.place
    assert ball.place[0] > start[0] + 2.0
    pilot.pull_ball(ball.slot, None)
    flown(pilot, 0.5)
    np.testing.assert_array_equal(ball.place, before)
    result = pilot.result()
    thing = kept(result, -1)
    assert thing.vanishes is None
    np.testing.assert_allclose(thing.waypoints[-1], before)
    pilot.pull_ball(ball.slot, start)
    flown(pilot, 4.0)
    np.testing.assert_allclose(ball.place, start, atol=2e-3)


@pytest.mark.parametrize(
    ("radius", "velocity", "away", "words"),
    [
        (0.01, 0.0, 9.0, "radius of a ball is 0.1 to 5 m, not 0.01 m"),
        (9.0, 0.0, 30.0, "not 9 m"),
        (1.0, 6.0, 9.0, "up to 5 m/s, not 6 m/s"),
        (1.0, 0.0, 2.0, "0.75 m from agent 1: put it at least 1 m away"),
    ],
)
def test_balls_have_limits(radius, velocity, away, words):
    """A ball that is too small, large, fast or near is refused in one line, and the flight goes on as it was."""
    pilot = settled()
    place = places(pilot)[0] + [-away, 0.0, 0.0]
    with pytest.raises(ValueError, match=re.escape(words)) as refused:
        pilot.add_ball(place, radius, np.array([velocity, 0.0, 0.0]))
    assert "\n" not in str(refused.value)
    assert pilot.balls == []


def test_eight_balls_at_once():
    """No more than eight balls are there at the same time; one that is gone makes room, and cannot be pushed."""
    pilot = settled()
    up = places(pilot).max(axis=0) + [0.0, 0.0, 10.0]
    for k in range(balls.AT_ONCE):
        assert pilot.add_ball(up + [k, 0.0, 0.0], 0.3, np.zeros(3)).slot == k
    with pytest.raises(ValueError, match="remove one first"):
        pilot.add_ball(up, 0.3, np.zeros(3))
    pilot.fly_tick()
    pilot.remove_ball(3)
    with pytest.raises(ValueError, match="gone"):
        pilot.pull_ball(3, up)
    assert pilot.add_ball(up, 0.3, np.zeros(3)).name == "ball 9"
    assert [ball.slot for ball in pilot.flying_balls].count(3) == 1


def test_the_target_stays_out_of_obstacles():
    """The target does not enter ground or walls, along which it moves on; it says what holds it off."""
    pilot = settled()
    for _ in range(100):
        pilot.steer(np.array([1.0, 0.0, -2.0]), np.zeros(3))
        pilot.fly_tick()
    assert pilot.held_off == "ground"
    slots = target_slots(pilot)
    assert 0.25 <= slots[:, 2].min() < 0.25 + 0.1 + 2.0 * TICK
    assert pilot.target.r[0] > 9.0
    flown(pilot, 4.0)
    assert places(pilot)[:, 2].min() > 0.25
    pilot.steer(np.array([0.0, 0.0, 1.0]), np.zeros(3))
    pilot.fly_tick()
    assert pilot.held_off == ""
    for _ in range(400):
        pilot.steer(np.array([4.0, 0.0, 0.0]), np.zeros(3))
        pilot.fly_tick()
    assert pilot.held_off == "hall"  # its west side is at x = 21 m
    slots = target_slots(pilot)
    assert 20.75 - 0.3 <= slots[:, 0].max() <= 20.75
    assert pilot.flight.ending == ""


def test_a_formation_without_room_is_refused():
    """A formation whose way leads through a wall is refused with the wall's name, and the one before stays."""
    wall = {"kind": "box", "name": "wall", "min": [8.5, -10.0, 0.0], "max": [9.0, 20.0, 9.0]}
    pilot = settled(obstacles=[{"kind": "ground"}, wall])
    assert pilot.flight.ending == ""
    with pytest.raises(ValueError, match=r"'line' has no room here: agent 3 would meet 'wall'"):
        pilot.change_formation("line")
    assert pilot.waiting is None


def test_points_fly_with_the_guard():
    """Live gives points vehicles and [avoidance], so that nothing is met; the text of the mission says it."""
    flies, why = with_avoidance_or_reason(TRIANGLE)
    assert why == ""
    assert flies.avoidance is not None
    assert Mission.from_toml(flies.text).avoidance == flies.avoidance
    assert flies.fleet.mass.tolist() == TRIANGLE.fleet.mass.tolist()
    assert flies.fleet.thrust_limit.tolist() == TRIANGLE.fleet.thrust_limit.tolist()
    pilot = Pilot(flies)
    records = flown(pilot, 8.0)
    for k in range(120):
        pilot.steer(np.array([1.0, -0.5, 0.25]), np.array([0.0, 0.0, 0.3 * (k < 40)]))
        records.append(pilot.fly_tick())
    assert max(map(slot_error, records)) < 6e-3
    result = pilot.result()
    assert "pushed" not in result.statistics  # no gust has blown
    assert {check.check: check.passed for check in assess(result).checks}["guarantee"]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"agents": TRIANGLE.to_dict()["agents"] | {"thrust_limit": 9.0}}, "nothing to brake with"),
        ({"obstacles": [{"kind": "ground", "height": 2.9}]}, "starts in an obstacle"),
        (
            {"agents": {k: x for k, x in TRIANGLE.to_dict()["agents"].items() if k != "thrust_limit"}},
            "no limit of thrust",
        ),
    ],
)  # fmt: skip
def test_why_there_is_no_guard(changes, why):
    """Where the guard cannot be had, the mission stays as it is, and the page says why."""
    given = mission(**changes)
    flies, words = with_avoidance_or_reason(given)
    assert flies is given
    assert why in words
    assert why in Session(given).html()


def test_the_guard_of_the_mission_stays():
    """A mission with [avoidance] of its own is flown as it is."""
    given = load_mission("moving-obstacles")
    assert with_avoidance_or_reason(given) == (given, "")


# -- what is kept of a flight


def by_hand(pilot: Pilot, seconds: float, change: float = math.inf) -> list:
    """Records of all ticks of a lively hand, which takes the other formation at a time."""
    rng, records = np.random.default_rng(2), []
    for k in range(round(seconds / TICK)):
        if k % 8 == 0:
            pilot.steer(rng.normal(size=3) + [0.0, 0.0, 0.7], 0.3 * rng.normal(size=3))
        if k == round(change / TICK) if math.isfinite(change) else False:
            pilot.change_formation(
                next(name for name in pilot.formations if name != pilot.formation)
            )
        records.append(pilot.fly_tick())
    return records


def test_flight_is_kept(tmp_path):
    """What flew is a result like any other: every tick as it was shown, phases as flown; judged, drawn and loaded."""
    pilot = Pilot(TRIANGLE)
    records = by_hand(pilot, 14.0, change=7.0)
    result = pilot.result()
    assert result.complete
    assert [p.name for p in result.phases] == ["establish triangle", "change to line"]
    assert [p.name for p in result.mission.phases] == ["establish triangle", "change to line"]
    assert result.phases[1].t_start == pytest.approx(7.0, abs=TICK + 1e-9)
    assert result.mission.name == "narrow-passage-live"
    for record in records:
        k = int(np.abs(result.time - record.time[-1]).argmin())
        assert result.time[k] == record.time[-1]
        for name in ("position", "velocity", "thrust", "attitude", "multiplier", "external_force"):
            shown, kept = getattr(record, name)[-1], getattr(result, name)[k]
            np.testing.assert_allclose(kept, shown, atol=1e-12, err_msg=name)
    # Positions are the integral of the velocities that are kept, so that nothing is missing in between.
    moved = np.cumsum(
        np.diff(result.time)[:, None, None] * (result.velocity[1:] + result.velocity[:-1]) / 2,
        axis=0,
    )
    np.testing.assert_allclose(result.position[1:] - result.position[0], moved, atol=5e-3)
    result.save(tmp_path / "flight.nc")
    loaded = Result.load(tmp_path / "flight.nc")
    assert assess(loaded).summary == assess(result).summary
    checks = {f.check: f for f in assess(loaded).checks}
    assert checks["complete"].passed
    assert checks["shape"].passed
    assert "by hand" in loaded.mission.title
    assert "change to line" in replay_page(loaded)


@pytest.mark.parametrize("step", [0.01, 0.03, 0.1])
def test_kept_at_the_output_step(step):
    """Samples come at the mission's output step, whatever the ticks are, and phases end on one."""
    pilot = Pilot(mission(output_step=step))
    by_hand(pilot, 6.0, change=1.0)
    result = pilot.result()
    wanted = np.arange(0, round(6.0 / step) + 1) * step
    away = np.abs(result.time[:, None] - wanted).min(axis=0)
    assert away.max() < 1e-9
    for p in result.phases:
        assert np.abs(result.time - p.t_end).min() < 1e-12
    assert result.mission.output_step == step


def test_kept_in_bounded_memory():
    """A long flight is kept ever coarser: within its bound, with the ends of phases, and its extremes of all times."""
    pilot = Pilot(TRIANGLE)
    pilot.archive.most = 20_000.0
    records = by_hand(pilot, 40.0, change=20.0)
    kept = sum(sum(x.size for x in p.record) for p in pilot.archive.pieces())
    assert kept < 25_000  # with ends
    assert pilot.archive.step > 0.05
    result = pilot.result()
    assert len(result.time) < 250
    assert np.diff(result.time).max() < 2 * pilot.archive.step
    for name, sign in (("separation", -1.0), ("clearance", -1.0), ("thrust", 1.0)):
        shown = max(sign * np.max(sign * getattr(r, name)[-1]) * sign for r in records)
        worst = result.extreme(name)
        # What happened between the samples that are kept is known, too.
        assert worst is not None
        assert sign * worst.value >= shown - 1e-9, name
    for p in result.phases:
        assert np.abs(result.time - p.t_end).min() < 1e-12


def test_ended_on_the_way():
    """A flight that is ended while a formation is taken is incomplete, and says so."""
    pilot = Pilot(TRIANGLE)
    by_hand(pilot, 7.0, change=5.0)
    result = pilot.result()
    assert not result.complete
    assert result.ending == "ended by hand on the way to 'line'"
    assert not assess(result).passed


def test_again_and_again():
    """A formation taken twice is two phases of two names."""
    pilot = Pilot(TRIANGLE)
    for name in ("line", "triangle", "line"):
        pilot.change_formation(name)
        flown(pilot, 5.0)
    names = [p.name for p in pilot.result().mission.phases]
    assert names == [
        "establish triangle", "change to line", "change to triangle", "change to line (2)"
    ]  # fmt: skip


@pytest.mark.parametrize("assignment", ["given", "shortest", "each"])
def test_slots_are_those_flown(assignment):
    """In the mission of a flight each agent has the slot that it flew to, however slots were assigned."""
    pilot = Pilot(mission(assignment=assignment))
    by_hand(pilot, 6.0)
    result = pilot.result()
    slots = result.mission.formation_slots("triangle")
    assert slots is not None
    flown_to = result.position[-1] - result.cm[-1]
    T = att.dcm_from_quaternion(result.attitude[-1])
    np.testing.assert_allclose(slots @ T, flown_to, atol=1e-5)


def test_lost_by_hand():
    """Of vehicles that the mission loses, the flight's mission loses those that were lost."""
    lost = [{"agent": 1, "time": 2.5}, {"agent": 2, "time": 5.0}]
    pilot = Pilot(mission(disturbances={"lost": lost}))
    flown(pilot, 4.0)
    result = pilot.result()
    assert result.mission.lost_at.tolist() == [2.5, math.inf, math.inf]
    assert result.left[-1].tolist() == [False, True, True]
    assert np.isnan(result.distance[-1]).sum() == 2  # its edges are gone


@pytest.mark.long
@pytest.mark.parametrize("name", [n for n in mission_names() if n != "show-1000"])
def test_every_mission_by_hand(name):
    """A flight by hand in any mission that ships is kept as a result that can be judged."""
    try:
        pilot = Pilot(load_mission(name))
    except FlightError:
        return
    by_hand(pilot, 8.0)
    result = pilot.result()
    assert result.mission.name == f"{name}-live"
    assert assess(result).phases[0].name == result.phases[0].name


# -- the session


def test_commands():
    """Commands do what they say, and anything else is refused."""
    session = Session(TRIANGLE)
    session.execute_command({"move": [1, 0, 0], "turn": [0, 0, 0.5]})
    assert session.pilot.target.move.tolist() == [1, 0, 0]
    session.execute_command({"formation": "line"})
    assert session.pilot.waiting == "line"
    session.execute_command({"gust": [0, 1, 0], "strength": 1e9})
    assert session.pilot.gusts[0].strength == 20.0
    session.execute_command({"pause": True})
    session.execute_command({"speed": 2})
    assert (session.paused, session.speed) == (True, 2.0)
    first = session.pilot
    session.execute_command({"again": True})
    assert session.pilot is not first
    for wrong in (
        {}, {"move": [1, 0], "turn": [0, 0, 0]}, {"move": [1, 0, "x"], "turn": [0, 0, 0]},
        {"move": [1, 0, math.nan], "turn": [0, 0, 0]}, {"move": [True, 0, 0], "turn": [0, 0, 0]},
        {"formation": "star"}, {"gust": [0, 0, 0], "strength": 1},
        {"gust": [1e-320, 0, 0], "strength": 1}, {"pause": 1}, {"speed": 3}, {"stop": 1},
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"\w"):
            session.execute_command(wrong)
    session.execute_command({"stop": True})
    assert session.stopped.is_set()


def told(messages: queue.Queue) -> tuple[str, str]:
    """The next event: its name and data."""
    name, data = messages.get(timeout=5).decode().strip().split("\n")
    return name.removeprefix("event: "), data.removeprefix("data: ")


def test_samples_are_the_flight():
    """A page hears the story, then samples of the flight, as long as somebody looks."""
    session = Session(TRIANGLE)
    thread = threading.Thread(target=session.run)
    thread.start()
    time.sleep(0.3)
    assert session.result.time[-1] == pytest.approx(TICK)  # nobody looks: it waits
    messages = session.add_page()
    name, data = told(messages)
    assert name == "story"
    assert json.loads(data)["formation"] == "triangle"
    while name != "sample":
        name, data = told(messages)
    numbers = np.frombuffer(base64.b64decode(data), "<f4")
    n, m = 3, len(TRIANGLE.edges)
    assert len(numbers) == 1 + 9 * n + 3 + 8 + m + (n + 3) + 7 + 4 * balls.AT_ONCE + (2 + n)
    position = numbers[1 : 1 + 3 * n].reshape(n, 3)
    np.testing.assert_allclose(position, TRIANGLE.agents.position, atol=0.05)
    session.execute_command({"stop": True})
    thread.join(5)
    assert not thread.is_alive()
    while (last := messages.get(timeout=5)) is not None:
        assert last.startswith(b"event: ")


def test_real_time():
    """A flight takes as long as it lasts, and at twice the speed half of it."""
    session = Session(TRIANGLE)
    thread = threading.Thread(target=session.run)
    messages = session.add_page()
    thread.start()
    marks = []
    for speed in (1, 2):
        session.execute_command({"speed": speed})
        t, begun = session.pilot.t, time.monotonic()
        time.sleep(1.0)
        marks.append((session.pilot.t - t) / (time.monotonic() - begun))
        session.execute_command({"pause": True})
        time.sleep(0.15)
        t = session.pilot.t
        time.sleep(0.2)
        assert session.pilot.t == t
        session.execute_command({"pause": False})
    session.stop()
    session.remove_page(messages)
    thread.join(5)
    assert marks == pytest.approx([1.0, 2.0], rel=0.35)


def test_last_page_closed(monkeypatch):
    """Some time after the last page was closed, the flight ends."""
    monkeypatch.setattr(sessions, "_PATIENCE", 0.3)
    session = Session(TRIANGLE)
    thread = threading.Thread(target=session.run)
    thread.start()
    time.sleep(0.5)
    assert thread.is_alive()  # the first page is still awaited
    session.remove_page(session.add_page())
    thread.join(3)
    assert not thread.is_alive()


# -- the address


@pytest.fixture(scope="module")
def server():
    session = Session(TRIANGLE)
    with Server(session) as server:
        yield server
        session.stop()


def ask(server: Server, method: str, path: str, body: str | None = None, **headers: str | None):
    """Status and text of an answer; a path without / is in the session's folder.

    The origin is that of the page, if it is not given (None: none is sent).
    """
    where = urlsplit(server.url)
    given = {"Origin": f"http://{where.netloc}"} | headers
    with closing(http.client.HTTPConnection(where.netloc, timeout=5)) as connection:
        connection.request(
            method,
            path if path.startswith("/") else where.path + path,
            body,
            {name: value for name, value in given.items() if value is not None},
        )
        answer = connection.getresponse()
        return answer.status, answer.read().decode()


def test_page(server):
    """The address gives a page that may talk to nobody but its flight."""
    status, text = ask(server, "GET", "")
    assert status == 200
    assert "default-src 'none'" in text
    assert "connect-src 'self'" in text
    assert "EventSource" in text


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        pytest.param("/", {}, id="no secret"),
        pytest.param("", {"Host": "evil.example"}, id="another host"),
        pytest.param("", {"Host": "evil.example:{port}"}, id="another host at our port"),
        pytest.param("", {"Host": "127.0.0.1.evil.example:{port}"}, id="a host like ours"),
        pytest.param("", {"Host": "127.0.0.1"}, id="another port"),
        pytest.param("", {"Host": ""}, id="no host"),
        pytest.param("", {"Origin": "http://evil.example"}, id="from another page"),
        pytest.param("", {"Origin": "http://127.0.0.1:1"}, id="from another port"),
        pytest.param("", {"Origin": "https://127.0.0.1:{port}"}, id="from another scheme"),
        pytest.param("", {"Origin": "127.0.0.1:{port}"}, id="from no origin at all"),
        pytest.param("", {"Origin": "http://localhost:{port}"}, id="from our other name"),
        pytest.param("", {"Origin": "null"}, id="from a file"),
    ],
)
def test_others_are_refused(server, path, headers):
    """Without the secret, under another name (rebound to us), or from another page, nothing is to be had."""
    headers = {k: v.replace("{port}", str(server.http.server_port)) for k, v in headers.items()}
    paused = server.http.RequestHandlerClass.session.paused
    assert ask(server, "GET", path, **headers)[0] == 403
    command = path if path == "/" else "command"
    for method in ("POST", "PUT", "OPTIONS", "HEAD"):
        assert ask(server, method, command, '{"pause": true}', **headers)[0] == 403
    assert server.http.RequestHandlerClass.session.paused == paused


def test_commands_say_where_they_come_from(server):
    """A command without an origin, which no page of today sends, is refused; a page may be asked for without."""
    assert ask(server, "GET", "", Origin=None)[0] == 200
    assert ask(server, "POST", "command", '{"pause": false}', Origin=None)[0] == 403
    assert ask(server, "POST", "command", '{"pause": false}')[0] == 204


def test_two_hosts(server):
    """A request that names two hosts is refused, whichever of them a server in between would have taken."""
    port = server.http.server_port
    hosts = [f"Host: 127.0.0.1:{port}", "Host: evil.example"]
    for order in (hosts, hosts[::-1]):
        lines = [f"GET {urlsplit(server.url).path} HTTP/1.1", *order, "", ""]
        with socket.create_connection(("127.0.0.1", port), timeout=5) as connection:
            connection.sendall("\r\n".join(lines).encode())
            assert b" 403 " in connection.recv(100)


def test_answers_stay_here(server):
    """No other page may frame an answer, and none is kept, sniffed, or told of in a referrer."""
    where = urlsplit(server.url)
    with closing(http.client.HTTPConnection(where.netloc, timeout=5)) as connection:
        connection.request("GET", where.path)
        said = connection.getresponse().headers
    assert said["Content-Security-Policy"] == "frame-ancestors 'none'"
    assert said["Cache-Control"] == "no-store"
    assert said["Referrer-Policy"] == "no-referrer"
    assert said["X-Content-Type-Options"] == "nosniff"
    assert "Python" not in said["Server"]


def test_only_this_machine(server):
    """Nobody but this machine can reach the flight."""
    assert urlsplit(server.url).hostname == "127.0.0.1"
    assert server.http.socket.getsockname()[0] == "127.0.0.1"


@pytest.mark.parametrize("body", ["", "[]", "{", '{"fly": 1}', " " * 20_000])
def test_wrong_commands(server, body):
    """What is no command is refused, and nothing happens."""
    assert ask(server, "POST", "command", body)[0] == 400


def odd(rng: np.random.Generator, depth: int) -> str:
    """JSON of any kind, with numbers beyond every float, and nested as deep as fits into a command."""
    kinds = (
        "null", "true", "0", "-1", "1" * 400, "-" + "9" * 400, "1e400", "NaN", "-Infinity", "1e-320", '"x"', "[]",
        "{}", "[0, 0, 0]", "[1e-320, 0, 0]", f"[{'7' * 400}, 0, 0]", "[" * depth + "]" * depth,
        '{"a":' * 900 + "1" + "}" * 900,
    )  # fmt: skip
    return kinds[rng.integers(len(kinds))]


def test_every_command_has_an_answer(server):
    """Whatever stands where a command has its values, the answer says that it is done or why not; none is cut off."""
    rng, answers = np.random.default_rng(3), set()
    forms = (
        ("move", "turn"), ("formation",), ("gust", "strength"), ("ball", "radius", "velocity"), ("pull", "to"),
        ("remove",), ("pause",), ("speed",), ("again",), ("stop",), ("other",),
    )  # fmt: skip
    for k in range(300):
        keys = forms[k % len(forms)]
        if k % len(forms) in {6, 8, 9}:  # what would end or hold the flight of the other tests
            body = f'{{"{keys[0]}": {odd(rng, 4000).replace("true", "1")}}}'
        else:
            body = f"{{{', '.join(f'{json.dumps(key)}: {odd(rng, 4000)}' for key in keys)}}}"
        answers.add(ask(server, "POST", "command", body)[0])
    assert answers == {204, 400}


def test_idle_connections_end(server, monkeypatch):
    """Who connects and sends nothing, or half a request, is hung up on: threads do not pile up."""
    assert 0 < server.http.RequestHandlerClass.timeout <= 30  # [s]
    monkeypatch.setattr(server.http.RequestHandlerClass, "timeout", 0.2)
    where = urlsplit(server.url)
    head = f"POST {where.path}command HTTP/1.1\r\nHost: {where.netloc}\r\nOrigin: http://{where.netloc}\r\n"
    for begun in ("", "POST /", head + "Content-Length: 20\r\n\r\n{"):
        with socket.create_connection((where.hostname, where.port), timeout=5) as idle:
            idle.sendall(begun.encode())
            assert idle.recv(1) == b""  # closed by the server, before our own time is up


def test_command(server):
    """A command is done, and answered with nothing."""
    assert ask(server, "POST", "command", '{"formation": "line"}') == (204, "")
    assert server.http.RequestHandlerClass.session.pilot.waiting == "line"
    assert ask(server, "GET", "other")[0] == 404
    assert ask(server, "POST", "other", "{}")[0] == 404


def test_port_taken():
    """A port that is taken is an error that says so."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(FlightError, match="cannot be used"):
            live(TRIANGLE, port=taken.getsockname()[1], browser=False)


def test_stops_from_the_page():
    """The flight ends when the page says so, and the page hears of it."""
    heard: list[str] = []
    threads: list[threading.Thread] = []

    def look(url: str) -> None:
        where = urlsplit(url)

        def listen() -> None:
            with closing(http.client.HTTPConnection(where.netloc, timeout=10)) as stream:
                stream.request("GET", f"{where.path}stream")
                heard.append(stream.getresponse().read().decode())

        def end() -> None:
            with closing(http.client.HTTPConnection(where.netloc, timeout=10)) as control:
                origin = {"Origin": f"http://{where.netloc}"}
                control.request("POST", f"{where.path}command", '{"stop": true}', origin)
                control.getresponse().read()

        threads.extend([threading.Thread(target=listen), threading.Timer(0.5, end)])
        for thread in threads:
            thread.start()

    live(TRIANGLE, browser=False, ready=look)
    for thread in threads:
        thread.join(5)
    assert heard[0].startswith("event: story")
    assert heard[0].count("event: sample") > 3
    assert heard[0].endswith('event: end\ndata: ""\n\n')


class Visitor:
    """A page that looks on for some seconds, sends commands, and hears the end."""

    def __init__(self, *commands: str, seconds: float = 1.0) -> None:
        self.commands, self.seconds = commands, seconds
        self.heard = ""

    def __call__(self, url: str) -> bool:
        where = urlsplit(url)

        def listen() -> None:
            with closing(http.client.HTTPConnection(where.netloc, timeout=120)) as stream:
                stream.request("GET", f"{where.path}stream")
                self.heard = stream.getresponse().read().decode()

        def tell() -> None:
            for command in self.commands:
                time.sleep(self.seconds)
                with closing(http.client.HTTPConnection(where.netloc, timeout=120)) as control:
                    origin = {"Origin": f"http://{where.netloc}"}
                    control.request("POST", f"{where.path}command", command, origin)
                    assert control.getresponse().status == 204

        self.threads = [threading.Thread(target=listen), threading.Thread(target=tell)]
        for thread in self.threads:
            thread.start()
        return True

    @property
    def farewell(self) -> str:
        for thread in self.threads:
            thread.join(60)
        return json.loads(self.heard.rpartition("event: end\ndata: ")[2])


def test_saved_at_the_end(tmp_path, monkeypatch, capsys):
    """`live` saves each flight in a folder of its own, keeps what is there, and tells where; it can be reported."""
    monkeypatch.chdir(tmp_path)
    visitor = Visitor('{"again": true}', '{"stop": true}')
    monkeypatch.setattr("webbrowser.open", visitor)
    assert cli.main(["live", "narrow-passage"]) == 0
    first, second = (
        tmp_path / "flights" / f"narrow-passage-live{number}" / "narrow-passage-live.nc"
        for number in ("", "-2")
    )
    assert str(second.relative_to(tmp_path)) in visitor.farewell
    assert str(first.relative_to(tmp_path)) in capsys.readouterr().out
    assert first.with_name("verdict.json").exists()
    before = first.read_bytes(), second.read_bytes()
    monkeypatch.setattr("webbrowser.open", Visitor('{"stop": true}'))
    assert cli.main(["live", "narrow-passage"]) == 0
    assert (tmp_path / "flights" / "narrow-passage-live-3" / "narrow-passage-live.nc").exists()
    assert (first.read_bytes(), second.read_bytes()) == before
    assert cli.main(["replay", str(second)]) == 0
    assert (second.parent / "replay.html").exists()


@pytest.mark.long
def test_reported(tmp_path):
    """A flight by hand can be reported, with its own phases in the tables."""
    pilot = Pilot(TRIANGLE)
    by_hand(pilot, 12.0, change=5.0)
    pilot.result().save(tmp_path / "flight.nc")
    assert cli.main(["report", str(tmp_path / "flight.nc"), "--no-figures", "--quiet"]) == 0
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "change to line" in text
    assert "at 12 s" in text


def test_nothing_flown_nothing_saved(tmp_path, monkeypatch):
    """A flight that nobody has looked at leaves no file."""
    monkeypatch.chdir(tmp_path)

    def interrupt(url: str) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr("webbrowser.open", interrupt)
    assert cli.main(["live", "narrow-passage"]) == 0
    assert list(tmp_path.iterdir()) == []


def test_nowhere_to_save(tmp_path):
    """Where a flight could not be saved, nothing is flown: the command says so at once."""
    (tmp_path / "file").write_text("")
    assert cli.main(["live", "narrow-passage", "--out", str(tmp_path / "file" / "folder")]) == 2


def test_disk_full():
    """A flight begun anew whose forerunner cannot be saved goes on, and its page hears why."""
    session = Session(TRIANGLE)
    flown(session.pilot, 0.2)
    pilot = session.pilot

    def full(_: Result) -> str:
        raise ResultError("flights: cannot be written (no space left on device)")

    session.landed = full
    with Server(session) as server:
        status, words = ask(server, "POST", "command", '{"again": true}')
    assert status == 400
    assert "no space left" in words
    assert session.pilot is pilot


def test_python_gets_the_flight():
    """`live` returns the flight."""
    visitor = Visitor('{"stop": true}', seconds=0.8)
    result = live(TRIANGLE, browser=False, ready=visitor)
    assert result is not None
    assert result.time[-1] > 0.3
    assert visitor.farewell == ""


@pytest.mark.long
def test_ctrl_c():
    """Ctrl-C ends the flight at once, without a trace of an error."""
    code = (
        # A shell that starts the tests in the background makes them, and what they start, ignore Ctrl-C.
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from rigidfleet.mission import load_mission; from rigidfleet.web.live import live\n"
        "live(load_mission('narrow-passage'), browser=False, ready=lambda url: print(url, flush=True))\n"
        "print('landed')"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("http://127.0.0.1:")
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=10)
    assert (process.returncode, out, err) == (0, "landed\n", "")
