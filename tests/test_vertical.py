"""Take-off and landing: straight up and down, together, some vehicles, or one group after another."""

import dataclasses
import json
import zipfile
from typing import Any

import numpy as np
import pytest

from rigidfleet import assess, check, export, simulate
from rigidfleet.errors import MissionError
from rigidfleet.mission import Mission
from rigidfleet.planning.timing import complete_times

RADIUS = 0.15
UP = {"kind": "takeoff", "name": "up", "height": 10.0, "duration": 5.0}
DOWN = {"kind": "land", "name": "down", "duration": 6.0}


def mission(*phases: dict[str, Any], **tables: Any) -> Mission:
    """Nine vehicles of unequal masses, three by three, on the ground; one stands on a box."""
    x, y = np.divmod(np.arange(9), 3)
    position = np.stack([2.0 * x, 2.0 * y, 0.0 * x + 0.2], axis=1)
    position[4, 2] = 0.7
    given = {
        "schema_version": 1, "name": "vertical", "smoothness": "jerk",
        "agents": {"mass": [0.3, 0.5] * 4 + [0.4], "radius": RADIUS, "position": position},
        "formations": {
            "ball": {"shape": "sphere", "size": 2.0, "edges": []},
            "flat": {"shape": "grid", "size": 2.0, "edges": []},
        },
        "obstacles": [{"kind": "ground", "height": 0.0}],
        "phases": [*phases],
    }  # fmt: skip
    return Mission.from_dict(given | tables)


def places(m: Mission) -> np.ndarray:
    return np.array(m.agents.position)


@pytest.mark.parametrize("smoothness", ["jerk", "lqr"])
def test_a_take_off_is_vertical_and_ends_level(smoothness):
    """All arrive at one height above the ground, over the points where they stood, at rest."""
    m = mission(UP, smoothness=smoothness)
    result = simulate(m)
    assert assess(result).passed
    r = result.position
    np.testing.assert_allclose(
        r[..., :2], np.broadcast_to(places(m)[:, :2], r[..., :2].shape), atol=1e-6
    )
    np.testing.assert_allclose(r[-1, :, 2], 10.0, atol=1e-6)
    # The septic from rest to rest is half way at half the time.
    k = int(np.abs(result.time - 2.5).argmin())
    np.testing.assert_allclose(r[k, :, 2], 0.5 * (places(m)[:, 2] + 10.0), atol=1e-6)
    assert np.abs(result.velocity[-1]).max() < 1e-6


def test_groups_go_one_after_another():
    """Rows of one y leave from south to north, each when the row before has arrived; the others stay."""
    m = mission(UP | {"stagger": 4.0, "duration": 11.0}, DOWN | {"stagger": 5.0, "duration": 15.0})
    result = simulate(m)
    assert assess(result).passed
    assert [p.name for p in result.phases] == [
        f"{name}: {k} of 3" for name in ("up", "down") for k in (1, 2, 3)
    ]
    y, height = places(m)[:, 1], result.position[..., 2]
    for k, row in enumerate((0.0, 2.0, 4.0)):
        start, own = 4.0 * k, y == row
        before, after = result.time <= start, (result.time >= start + 3.0) & (result.time <= 11.0)
        np.testing.assert_allclose(height[np.ix_(before, own)] - places(m)[own, 2], 0.0, atol=1e-6)
        np.testing.assert_allclose(height[np.ix_(after, own)], 10.0, atol=1e-6)
        landed = result.time >= 11.0 + 5.0 * (k + 1)
        np.testing.assert_allclose(height[np.ix_(landed, own)], 0.05 + RADIUS, atol=1e-6)
    np.testing.assert_allclose(result.position[..., 1] - y, 0.0, atol=1e-6)


def test_vehicles_one_by_one_and_named_ones():
    """By vehicles, each goes alone; named ones go, and nobody else."""
    some = mission(UP | {"agents": [7, 2], "stagger": 3.0, "by": "vehicles", "duration": 6.0})
    phases = complete_times(some).phases
    assert [p.vertical.agents for p in phases if p.vertical] == [(7,), (2,)]
    end = simulate(some).position[-1, :, 2]
    wanted = places(some)[:, 2]
    wanted[[6, 1]] = 10.0
    np.testing.assert_allclose(end, wanted, atol=1e-6)


def test_the_plan_is_proved_and_assigned_from_the_level():
    """Certificates cover every group, and slots are assigned for the vehicles as they hover, not as they stood."""
    m = mission(
        UP, {"kind": "establish", "formation": "ball", "duration": 6.0}, assignment="each",
        limits={"separation": 0.8},
    )  # fmt: skip
    ahead = check(m)
    assert ahead.passed
    assert ahead.certificates["up"].separation == pytest.approx(2.0 - 2 * RADIUS)
    assert assess(simulate(m)).passed


def test_after_a_landing_slots_are_assigned_anew():
    """A formation taken again after a landing one by one starts from the ground: it is another one, with its proof."""
    ball = {"kind": "establish", "formation": "ball", "duration": 6.0}
    flat = {"kind": "reshape", "formation": "flat", "duration": 6.0}
    down = DOWN | {"stagger": 4.0, "duration": 12.0}
    m = mission(
        UP, ball, flat, down, UP | {"name": "again"}, ball | {"name": "second"},
        assignment="each", limits={"separation": 0.5},
    )  # fmt: skip
    taken = [p.shaping.formation for p in m.phases if p.shaping]
    assert taken == ["ball", "flat", "ball (2)"]
    ahead = check(m)
    assert ahead.passed
    # The promise to an assignment: slots 2 m apart keep 2 m / sqrt(2).
    promised = 2.0 / np.sqrt(2.0) - 2 * RADIUS
    assert ahead.certificates["second"].separation >= promised - 1e-9


def test_least_times():
    """With duration auto, a take-off takes the time of the speed limit: 35/16 of the mean speed."""
    m = mission(UP | {"duration": "auto"}, limits={"speed": 3.0})
    (phase,) = complete_times(m).phases
    assert phase.duration == pytest.approx(35 / 16 * 9.8 / 3.0, rel=0.01)


def test_touch_down_is_judged():
    """A landing that ends fast fails by name; the speed is that of the fastest vehicle that is down."""
    result = simulate(mission(UP, DOWN))
    told = {c.check: c for c in assess(result).checks}["touch_down"]
    assert told.passed
    assert told.worst == pytest.approx(
        0.2, abs=0.05
    )  # a landing of all together comes down at 0.2 m/s
    velocity = result.velocity.copy()
    velocity[-1, 3, 2] = -0.9
    hard = {c.check: c for c in assess(dataclasses.replace(result, velocity=velocity)).checks}
    assert not hard["touch_down"].passed
    assert hard["touch_down"].who == "agent 4"
    assert hard["touch_down"].worst == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("phase", "words"),
    [
        (UP | {"height": -1.0}, "height"),
        (UP | {"agents": [10]}, "there is no such agent"),
        (UP | {"agents": [3, 3]}, "names an agent twice"),
        (UP | {"by": "rows"}, "no effect without stagger"),
        (UP | {"stagger": 2.0, "travel": 1.0}, "no effect with stagger"),
        (UP | {"stagger": 2.0, "duration": "auto"}, "does not say how long"),
        (UP | {"travel": 9.0}, "is longer than the phase"),
        (UP | {"control": "open"}, "needs feedback control"),
    ],
    ids=str,
)
def test_what_is_refused(phase, words):
    """What cannot be flown is one error."""
    with pytest.raises(MissionError, match=words) as told:
        mission(phase, limits={"speed": 5.0})
    assert len(told.value.findings) == 1


@pytest.mark.parametrize("duration", [2.0, 7.0])
def test_groups_that_have_no_time_or_overlap(duration):
    """Three rows 2 s apart need more than 4 s, and at most 6 s; the error says so."""
    m = mission(UP | {"stagger": 2.0, "duration": duration})
    with pytest.raises(MissionError, match="give a duration of 6 s, or up to 2 s less"):
        complete_times(m)


def test_without_ground():
    """Height is above the ground: a mission without one is refused."""
    with pytest.raises(MissionError, match="needs a ground"):
        mission(UP, obstacles=[])


def test_motors_are_off_after_the_last_landing(tmp_path):
    """A group that has landed may switch off at once; one that takes off again, or never lands, not."""
    m = mission(
        UP, DOWN | {"name": "some", "agents": [1, 2, 3]}, UP | {"name": "again", "agents": [3]},
        DOWN | {"name": "last", "agents": [3, 4]},
    )  # fmt: skip
    result = simulate(m)
    expected = [11.0, 11.0, 22.0, 22.0] + 5 * [np.inf]
    np.testing.assert_allclose(result.motors_off, expected)
    verdict = assess(result)
    said = [c.message for c in verdict.checks if c.check == "touch_down"]
    assert [text.split("; ")[1] for text in said] == ["4 vehicles may switch off"]
    with zipfile.ZipFile(export(result, tmp_path / "show.skyc", "skyc").path) as show:
        landings = [
            json.loads(show.read(f"drones/agent-{i}/trajectory.json"))["landingTime"]
            for i in range(1, 10)
        ]
    assert landings == pytest.approx(np.minimum(expected, 22.0))


def test_a_landed_vehicle_is_disarmed(tmp_path):
    """The last message to a vehicle that has landed is the command to disarm, with a right checksum."""
    mavutil = pytest.importorskip("pymavlink.mavutil", reason="pymavlink: make .venv/.interchange")
    result = simulate(
        mission(UP, DOWN | {"agents": [1], "duration": 6.0}, UP | {"name": "two", "agents": [2]})
    )
    made = export(result, tmp_path / "logs", "tlog", rate=10.0)
    assert made.span == (0.0, 16.0)
    for agent, end in ((1, 11.0), (2, 16.0)):
        log = mavutil.mavlink_connection(str(tmp_path / "logs" / f"agent-{agent}.tlog"))
        messages = []
        while (message := log.recv_match()) is not None:
            messages.append(message)
        log.close()
        kinds = [message.get_type() for message in messages]
        setpoints = [x for x in messages if x.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]
        assert setpoints[-1].time_boot_ms == 1e3 * end
        if agent == 2:
            assert {*kinds} == {"SET_POSITION_TARGET_LOCAL_NED"}
            continue
        last = messages[-1]
        assert kinds.count("COMMAND_LONG") == 1
        assert (last.command, last.param1, last.target_system) == (400, 0.0, 1)
        assert last._timestamp == pytest.approx(end)
