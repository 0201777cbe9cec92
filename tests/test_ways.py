"""Ways found round obstacles: phases of kind "go"."""

import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from rigidfleet import assess, check, simulate
from rigidfleet._common.progress import report_steps_to
from rigidfleet.errors import MissionError
from rigidfleet.math import proximity
from rigidfleet.math.attitude import dcm_from_rotation_vector
from rigidfleet.mission import Mission, load_mission
from rigidfleet.planning import ways
from rigidfleet.planning.clearance import clearance_to, slot_speed_bounds, speed_bounds
from rigidfleet.planning.derivatives import slot_derivatives
from rigidfleet.planning.lattice import FreeSpace, is_clear
from rigidfleet.planning.preview import preview_phases
from rigidfleet.planning.timing import complete_times, expand_mission
from rigidfleet.simulation.flight import Flight

FORMS = {
    "square": {"shape": "square", "size": 3.0},
    "line": {"shape": "line", "size": 1.6},
}


def going(*obstacles: dict[str, Any], **keys: Any) -> Mission:
    """Four vehicles in a square, 24 m before their goal, with obstacles between."""
    changes = {k: keys.pop(k) for k in ("limits", "formations", "phases", "smoothness") if k in keys}  # fmt: skip
    at = np.array([[-1.5, -1.5, 0], [1.5, -1.5, 0], [1.5, 1.5, 0], [-1.5, 1.5, 0]])
    go = {"kind": "go", "name": "go", "position": [12, 0, 8], "duration": "auto"} | keys
    data = {
        "schema_version": 1,
        "name": "going",
        "smoothness": "jerk",
        "agents": {"mass": 1.0, "radius": 0.25, "position": at + [-12, 0, 8]},
        "formations": FORMS,
        "limits": {"speed": 5.0, "acceleration": 3.0, "separation": 0.5},
        "obstacles": list(obstacles),
        "phases": [
            {"kind": "establish", "formation": "square", "blend": 1.0, "duration": 1.0},
            {k: v for k, v in go.items() if v is not None},
        ],
    }
    return Mission.from_dict(data | changes)


def wall(width: float, y: float = 0.0, **turned: float) -> list[dict[str, Any]]:
    """A wall too wide and high to fly round, with a gap, turned about its middle."""
    boxes: list[dict[str, Any]] = []
    for name, (a, b) in {"left": (y + width / 2, 200.0), "right": (-200.0, y - width / 2)}.items():
        boxes.append({"kind": "box", "name": name, "min": [-1, a, -200], "max": [1, b, 200]})
    yaw = np.deg2rad(turned.get("yaw_deg", 0.0))
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    for box in boxes:
        middle = (np.array(box["min"]) + box["max"]) / 2
        half = (np.array(box["max"]) - box["min"]) / 2
        box.update(min=turn @ middle - half, max=turn @ middle + half, **turned)
    return boxes


def sampled(mission: Mission) -> float:
    """Least distance [m] of a vehicle's surface from a box along the axes, a sphere or an upright cylinder: samples."""
    least = np.inf
    for planned in preview_phases(complete_times(mission))[0]:
        r = planned.position
        for o in mission.obstacles:
            if o.kind == "box":
                out = np.maximum(np.maximum(np.array(o.min) - r, r - np.array(o.max)), 0.0)
            elif o.kind == "sphere":
                out = np.linalg.norm(r - o.centre, axis=-1, keepdims=True) - o.radius
            else:
                assert o.kind == "cylinder"
                across = np.linalg.norm((r - np.array(o.ends[0]))[..., :2], axis=-1) - o.radius
                out = np.stack([np.maximum(across, 0), np.maximum(r[..., 2] - o.ends[1][2], 0)], -1)
            least = min(least, float(np.linalg.norm(out, axis=-1).min()) - 0.25)
    return least


SOLIDS = {
    "box": [{"kind": "box", "min": [-1, -6, -50], "max": [1, 8, 20]}],
    "sphere": [{"kind": "sphere", "centre": [0, 0.5, 8], "radius": 5.0}],
    "cylinder": [{"kind": "cylinder", "ends": [[0, 1, -20], [0, 1, 40]], "radius": 4.0}],
    "hull": [{"kind": "hull", "points": [[-3, -4, 0], [3, -5, 0], [0, 6, 0], [0, 0, 22]]}],
    "heights": [
        {
            "kind": "heights",
            "corner": [-6, -30],
            "spacing": 6.0,
            "heights": [[5.0] * 11, [11.0] * 11, [6.0] * 11],
        }
    ],
    "zone": [{"kind": "box", "zone": True, "min": [-2, -5, -50], "max": [2, 5, 50]}],
    "turned box": [{"kind": "box", "min": [-1, -8, -40], "max": [1, 6, 40], "yaw_deg": 35.0}],
}


@pytest.mark.parametrize("kind", SOLIDS)
def test_each_kind_of_obstacle_is_flown_round(kind):
    """The straight way meets the obstacle; the way found keeps its clearance, as the check proves."""
    straight = going(*SOLIDS[kind]).to_dict()
    straight["phases"][1] = {"kind": "fly", "position": [12, 0, 8], "duration": "auto"}
    assert not check(Mission.from_dict(straight)).passed
    mission = going(*SOLIDS[kind], clearance=0.5)
    ahead = check(mission)
    assert ahead.passed
    assert min(clearance for _, clearance, *_ in ahead.clearance) >= 0.5
    if kind in ("box", "sphere", "cylinder", "zone"):
        assert sampled(mission) >= 0.5
    goal = preview_phases(complete_times(mission))[0][-1].leg.planned_end_state.goal
    assert goal is not None
    assert np.array_equal(goal.r, [12, 0, 8])


@pytest.mark.parametrize("yaw", [0.0, 30.0])
@pytest.mark.parametrize(
    ("width", "fold"),
    [(4.0, False), (3.92, False), (3.0, True), (0.92, True)],
    ids=["wide", "just", "narrow", "slit"],
)
def test_a_gap_is_passed_as_it_is_or_folded(width, fold, yaw):
    """The square passes gaps of 3.9 m as it is, and folds for others, down to a vehicle and its clearance."""
    turned = {"yaw_deg": yaw} if yaw else {}
    mission = going(*wall(width, 4.0, **turned))
    planned = complete_times(mission)
    taken = [p.shaping.formation for p in planned.phases if p.shaping is not None]
    assert taken == (["square", "line", "square"] if fold else ["square"])
    ahead = check(mission)
    assert ahead.passed
    assert min(clearance for _, clearance, *_ in ahead.clearance) >= 0.2 - 1e-3


def test_a_gap_is_passed_smaller():
    """Without another formation, the square shrinks for the gap, and is itself again behind it."""
    mission = going(*wall(2.8), formations={"square": FORMS["square"]}, scales=[0.9, 0.6])
    planned = complete_times(mission)
    taken = [p.shaping.formation for p in planned.phases if p.shaping is not None]
    assert taken == ["square", "square x 0.6", "square"]
    whole, small = (planned.formation_slots(f"square{x}") for x in ("", " x 0.6"))
    assert whole is not None
    assert small is not None
    np.testing.assert_allclose(small, 0.6 * whole, atol=1e-12)
    result = simulate(mission)
    assert assess(result).passed
    assert len(result.mission.phases) == len(result.phases)
    again = simulate(Mission.from_toml(result.mission_text))
    assert np.array_equal(result.position, again.position)
    assert result.mission.formation_slots("square x 0.6") is not None


@pytest.mark.parametrize(
    ("keys", "needs"),
    [({"formations": {"square": FORMS["square"]}}, 3.9), ({"clearance": 0.4}, 1.3)],
    ids=["square", "line"],
)
def test_no_way_says_what_stands_in_it(keys, needs):
    """Without a fold, or with much clearance, the error has the gap, its width, and what the slimmest shape needs."""
    with pytest.raises(MissionError) as caught:
        complete_times(going(*wall(1.2), **keys))
    (finding,) = caught.value.findings
    assert "no way is found" in finding.problem
    assert f"needs {needs:.2f} m between '" in finding.problem
    assert f"which leave 1.20 m: {needs - 1.2:.2f} m are missing" in finding.problem


@pytest.mark.parametrize("bottom", [-60.0, 0.0])
def test_walls_on_the_ground_are_named_and_not_the_ground(bottom):
    """Walls that begin at the ground leave a gap above it: what is named is the gap, and a place within the walls."""
    walls = [
        {"kind": "box", "name": name, "min": [-0.5, a, bottom], "max": [0.5, b, 90]}
        for name, a, b in (("left", 0.2, 90.0), ("right", -90.0, -0.2))
    ]
    with pytest.raises(MissionError) as caught:
        complete_times(going({"kind": "ground"}, *walls, formations={"square": FORMS["square"]}))
    (finding,) = caught.value.findings
    assert "between 'left' and 'right', which leave 0.40 m" in finding.problem
    place = re.findall(r"\((.*), (.*), (.*)\) m, 'square' at yaw (.*)° needs", finding.problem)[0]
    x, _, z, yaw = map(float, place)
    turn = dcm_from_rotation_vector(np.array([0.0, 0.0, np.deg2rad(yaw)]))
    corners = [x, 0.0, 0.0] + np.array(
        [[a, b, 0.0] for a in (-1.5, 1.5) for b in (-1.5, 1.5)]
    ) @ turn
    assert (abs(corners[:, 0]) < 0.75).any()  # a vehicle is in a wall: all of y is, but for 0.4 m
    assert z > 0.25


def test_what_is_written_flies_the_same_bits(tmp_path):
    """The phases that are found, written and read again, fly exactly as the mission that asks for them."""
    mission = going(*wall(2.0, 3.0))
    written = Mission.from_toml(expand_mission(mission).text)
    assert not any(p.kind == "go" for p in written.phases)
    one, two = simulate(mission), simulate(written)
    assert np.array_equal(one.position, two.position)
    assert np.array_equal(one.time, two.time)
    assert assess(one).passed
    assert assess(two).passed
    assert one.mission.to_dict() == written.to_dict()


def test_the_shipped_passage_folds_by_itself():
    """It takes the line between the walls, and its clearance there is that of the mission made by hand."""
    found, made = (check(load_mission(f"narrow-passage{x}")) for x in ("-found", ""))
    assert found.passed
    walls = [
        dict((name, x) for name, x, *_ in c.clearance if "wall" in name) for c in (found, made)
    ]
    for name in walls[0]:
        assert walls[0][name] >= walls[1][name] - 2e-3
    planned = complete_times(load_mission("narrow-passage-found"))
    assert [p.shaping.formation for p in planned.phases if p.shaping] == ["triangle", "line", "triangle"]  # fmt: skip


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"duration": None, "settle": {}}, "needs a time at which it ends"),
        ({"control": "open"}, "needs feedback control"),
        ({"formations": FORMS, "clearance": -1.0}, "clearance"),
        ({"scales": [1.5]}, "scales"),
        ({"position": [0, 0, 8]}, "at the narrowest place of the best one"),
    ],
)
def test_bad_input_is_refused(keys, words):
    """One error says what is wrong with a way that cannot be asked for."""
    with pytest.raises(MissionError, match=words):
        complete_times(going(*wall(0.0001), **keys))


def test_a_formation_on_the_way_exists():
    """A name that the mission does not have is refused with the names that it has."""
    data = going().to_dict()
    data["phases"][1]["formations"] = ["lime"]
    with pytest.raises(MissionError, match="no such formation"):
        Mission.from_dict(data)


def test_a_way_begins_at_rest_and_in_a_formation():
    """A start in motion, and a start without a formation, are refused."""
    data = going().to_dict()
    fly = {"kind": "fly", "position": [-10, 0, 8], "velocity": [1, 0, 0], "duration": "auto"}
    with pytest.raises(MissionError, match="begins at 1 m/s, but a way begins at rest"):
        complete_times(
            Mission.from_dict(data | {"phases": [data["phases"][0], fly, data["phases"][1]]})
        )
    with pytest.raises(MissionError, match="needs a formation"):
        complete_times(Mission.from_dict(data | {"phases": [data["phases"][1]]}))


def test_an_obstacle_that_moves_is_met_or_not():
    """Ways lead round what is at rest; one that meets what moves is refused, with the time."""
    ball = {"kind": "sphere", "name": "ball", "radius": 2.0}
    complete_times(going(ball | {"centre": [0, 0, 8], "velocity": [0, 8.0, 0]}))
    with pytest.raises(MissionError, match="from 'ball' at"):
        complete_times(going(ball | {"centre": [0, 0, 8], "velocity": [0.1, 0, 0]}))


def test_nothing_begins_a_way_by_hand():
    """In flight there is no search: begin() refuses."""
    flight = Flight(going())
    with pytest.raises(MissionError, match="before the flight"):
        flight.begin({"kind": "go", "position": [0, 0, 8], "duration": 5.0})


def test_a_geofence_bounds_the_way():
    """With a fence that leaves no way round, there is none."""
    box = {"kind": "box", "min": [-1, -6, -50], "max": [1, 8, 50]}
    fence = {"min": [-30, -7, 0], "max": [30, 9, 20]}
    limits = {"speed": 5.0, "acceleration": 3.0, "separation": 0.5}
    complete_times(going(box, limits=limits))
    with pytest.raises(MissionError, match="no way is found"):
        complete_times(going(box, limits=limits | {"geofence": fence}))


def test_many_agents_find_a_way_as_one_ball():
    """Beyond 60 agents the search moves one ball round all; the proof counts every vehicle."""
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(9.0), [0.0]), axis=-1).reshape(-1, 3)
    data = going(*SOLIDS["sphere"]).to_dict()
    data["agents"]["position"] = (grid - [4, 4, 0] + [-16, 0, 8]).tolist()
    data["agents"]["radius"] = 0.1
    data["formations"] = {"grid": {"slots": grid.tolist(), "edges": []}}
    data["phases"][0]["formation"] = "grid"
    data["phases"][1]["position"] = [16, 0, 8]
    assert check(Mission.from_dict(data), search=False).passed


@pytest.mark.parametrize("name", ["narrow-passage", "cube-passage", "show-1000"])
def test_speeds_between_samples_are_bounded(name):
    """No slot is faster within a span than its bound, and the bounds of short spans are close."""
    for planned in preview_phases(complete_times(load_mission(name)))[0]:
        leg, time = planned.leg, planned.time[::10]
        bound = slot_speed_bounds(leg.reference, leg.motion, time[:-1], time[1:])
        inside = time[:-1, None] + np.linspace(0, 1, 7)[1:-1] * np.diff(time)[:, None]
        v = slot_derivatives(leg.reference, leg.motion, inside.ravel(), 2)[:, 1]
        speed = np.linalg.norm(v, axis=-1).reshape(*inside.shape, -1).max(axis=1)
        if leg.reference.T_b > 0.0 or not leg.reference.dp.any():
            assert (speed <= bound + 1e-9).all()


def test_the_least_clearance_is_between_samples():
    """A thin plate that lies between two samples is found, to the accuracy that is promised."""
    plate = {"kind": "box", "min": [-0.001, -1, 0], "max": [0.001, 1, 7.0]}
    data = going(plate).to_dict()
    data["phases"][1] = {"kind": "fly", "position": [12, 0, 8], "duration": 4.0}
    mission = Mission.from_dict(data)
    planned = preview_phases(mission)[0][1]
    found = clearance_to(planned, mission.obstacles[0], mission.fleet.radius, speed_bounds(planned))
    t = np.linspace(planned.time[0], planned.time[-1], 40001)
    r = slot_derivatives(planned.leg.reference, planned.leg.motion, t, 1)[:, 0]
    out = np.maximum(np.maximum([-0.001, -1, 0] - r, r - [0.001, 1, 7.0]), 0.0)
    dense = float(np.linalg.norm(out, axis=-1).min()) - 0.25
    assert dense - 1e-3 <= found.clearance <= dense + 1e-3
    assert found.proved == found.clearance - 1e-3


def past_a_ball(count: int) -> Mission:
    """A grid of vehicles that flies past a ball of 2 cm at up to 33 m/s, one of them near it."""
    ball = {"kind": "sphere", "name": "bird", "centre": [300.31, 0.43, 10.07], "radius": 0.02}
    grid = {"shape": "grid", "size": 2.0, "count": count, "centre": [0.0, 0.0, 10.0]}
    return Mission.from_dict(
        {
            "schema_version": 1, "name": "past", "agents": {"mass": 0.3, "radius": 0.1, "position": grid},
            "obstacles": [ball], "phases": [{"kind": "fly", "position": [600.0, 0.0, 10.0], "duration": 40.0}],
        }
    )  # fmt: skip


@pytest.mark.parametrize("at_once", [20_000, 200_000])
def test_the_least_clearance_of_many_is_between_samples(at_once, monkeypatch):
    """Also where not all vehicles and spans fit at once."""
    monkeypatch.setattr("rigidfleet.planning.clearance._AT_ONCE", at_once)
    mission = past_a_ball(1000)
    planned = preview_phases(mission)[0][0]
    found = clearance_to(planned, mission.obstacles[0], mission.fleet.radius, speed_bounds(planned))
    assert found.proved == found.clearance - 1e-3
    t = np.linspace(found.time - 0.3, found.time + 0.3, 6001)
    near = slot_derivatives(planned.leg.reference, planned.leg.motion, t, 1)[:, 0, found.agent]
    dense = float(np.linalg.norm(near - [300.31, 0.43, 10.07], axis=-1).min()) - 0.12
    assert found.clearance == pytest.approx(dense, abs=1e-3)
    each, _ = proximity.obstacle_clearances(
        slot_derivatives(planned.leg.reference, planned.leg.motion, t[::10], 1)[:, 0],
        mission.fleet.radius, mission.obstacles, t[::10],
    )  # fmt: skip
    assert found.clearance <= each.min() + 1e-3


def test_what_a_check_has_no_time_to_prove_is_told(monkeypatch):
    """The bound holds, is worse than a millimetre, and is said."""
    monkeypatch.setattr("rigidfleet.planning.clearance._IN_ALL", 10_000)
    mission = past_a_ball(1000)
    planned = preview_phases(mission)[0][0]
    found = clearance_to(planned, mission.obstacles[0], mission.fleet.radius, speed_bounds(planned))
    t = np.linspace(planned.time[0], planned.time[-1], 4001)
    r = slot_derivatives(planned.leg.reference, planned.leg.motion, t, 1)[:, 0]
    dense = float(np.linalg.norm(r - [300.31, 0.43, 10.07], axis=-1).min()) - 0.12
    assert found.proved < found.clearance - 1e-3
    assert found.proved <= dense
    (said,) = [x for x in check(mission).remarks if "proved to" in x.text]
    assert said.level == "note"
    assert "'bird' is proved to" in said.text


# -- the search itself -------------------------------------------------------------------------------


def test_a_fence_is_compared_exactly():
    """Motions beside a fence keep their room if a dense look at them says so, and take one look at obstacles."""
    rng = np.random.default_rng(4)
    fence = np.array([[-3.0, -2.0, 0.0], [3.0, 2.0, 4.0]])
    looks = []

    class Counting(FreeSpace):
        def clearance_to_obstacles(self, r, radius, most):
            looks.append(len(r))
            return super().clearance_to_obstacles(r, radius, most)

    space, radius, need = Counting([], fence), np.full(3, 0.1), 0.2
    share = np.linspace(0.0, 1.0, 2001)
    for turning in (False, True):
        offsets, axis = rng.normal(size=(3, 3)), rng.normal(size=3)
        ways = np.linalg.norm(axis) * np.linalg.norm(offsets, axis=1) * turning

        def path(t, offsets=offsets, axis=axis, turning=turning):
            return (
                offsets @ dcm_from_rotation_vector(np.outer(t, axis)) if turning else offsets[None]
            )

        a = rng.uniform(-2.0, 2.0, (300, 3)) + [0.0, 0.0, 2.0]
        b = a if turning else rng.uniform(-2.0, 2.0, (300, 3)) + [0.0, 0.0, 2.0]
        a[:40, 2] = b[:40, 2] = fence[0, 2] + need - offsets[:, 2].min() + 1e-6  # along the floor
        centres = a[:, None, None] + share[:, None, None] * (b - a)[:, None, None] + path(share)
        room = np.minimum(centres - fence[0], fence[1] - centres).min(axis=(1, 2, 3))
        looks.clear()
        kept = is_clear(space, a, b, path, ways, radius, need)
        assert 0 < kept.sum() < len(kept)
        assert not (kept & (room < need)).any()
        assert kept[room > need + float(ways.max()) / 4000].all()
        assert len(looks) <= 1
    assert kept[:40].any() or not (room[:40] > need).any()


def test_a_search_says_what_it_looks_for(monkeypatch):
    """Whoever watches hears the phase and the search, of a way and of automatic times."""
    heard: list[str] = []
    with report_steps_to(heard.append):
        complete_times(load_mission("narrow-passage-found"))
    assert any("looking for a way of '" in step and "round obstacles" in step for step in heard)


def test_a_way_whose_proof_lacks_room_is_looked_for_again_with_more(monkeypatch):
    """If the proof lacks 0.9 m, the way that is found next has it, at samples of its straight parts."""
    tried: list[tuple[float, float]] = []
    try_way = ways._Search._mission_legs_and_shortfall

    def lacking_at_first(search, roadmap, way):
        room, stops = np.inf, list(zip(way.places, way.layers, strict=True))
        for (a, i), (b, j) in pairwise(stops):
            if i == j:
                straight = a + np.linspace(0.0, 1.0, 50)[:, None] * (b - a)
                places = straight[:, None] + roadmap.layers[i].offsets
                room = min(room, roadmap.space.clearance(places, roadmap.radius).min())
        tried.append((roadmap.need, room))
        mission, legs, lacking = try_way(search, roadmap, way)
        return mission, legs, 0.9 if len(tried) == 1 else lacking

    monkeypatch.setattr(ways._Search, "_mission_legs_and_shortfall", lacking_at_first)
    complete_times(load_mission("narrow-passage-found"))
    (need, room), (more, roomier) = tried
    assert more == pytest.approx(need + 0.902)
    assert room < more <= roomier
