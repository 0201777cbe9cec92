import copy
import math
import os
import pickle
import subprocess
import sys
import tomllib
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigidfleet._common.toml import to_toml
from rigidfleet.errors import MissionError
from rigidfleet.formation import distance_geometry, graphs, shapes
from rigidfleet.mission import (
    Fly,
    Mission,
    json_schema,
    load_mission,
    mission_names,
    mission_text,
)
from rigidfleet.mission.obstacles import Box
from rigidfleet.simulation.flight import simulate

SHIPPED = [
    "bridge-inspection",
    "change-of-picture",
    "crazyflies",
    "cube-by-neighbours",
    "cube-passage",
    "cube-passage-quadrotors",
    "cube-waypoint",
    "delayed",
    "downwash-cube",
    "drift",
    "establish-cube",
    "establish-cube-as-printed",
    "establish-triangle",
    "falling-light",
    "ferris-wheel",
    "hexagon",
    "hill-search",
    "line-singular",
    "lossy-passage",
    "market-square",
    "moving-obstacles",
    "narrow-passage",
    "narrow-passage-found",
    "passage-quadrotors",
    "pyramid",
    "show-1000",
    "single-waypoint",
    "square",
    "statue",
    "two-agents",
    "windy-passage",
]

SCENES = [
    "bridge-inspection",
    "change-of-picture",
    "falling-light",
    "ferris-wheel",
    "hill-search",
    "statue",
]

HELD = [{"kind": "hold", "duration": 5.0}]

PLAIN: dict[str, Any] = {
    "schema_version": 1,
    "name": "plain",
    "agents": {"mass": 1.0, "position": [[1, 6, 3], [8, 3, 3], [7, 6, 3]]},
    "formations": {
        "triangle": {"shape": "triangle", "size": 4.0},
        "line": {"distances": [4, 8, 4]},
    },
    "phases": [
        {"kind": "establish", "formation": "triangle", "until": 6.0},
        {"kind": "fly", "position": [5, 5, 8], "yaw_deg": 10.0, "duration": 9.0},
        {"kind": "hold", "until": 20.0},
    ],
}
REMOVED: Any = object()
ORBIT = {"kind": "orbit", "centre": [5, 5, 8], "radius": 4.0, "rate_deg_s": 30.0, "duration": 9.0}
ORBIT_SETTLES = {key: value for key, value in ORBIT.items() if key != "duration"} | {
    "settle": {"timeout": 3.0},
    "blend": 2.0,
}


def changed(*edits: tuple[str, Any], base: dict[str, Any] = PLAIN) -> dict[str, Any]:
    """The plain mission with entries replaced, added or removed: (path, value) each."""
    data = copy.deepcopy(base)
    for path, value in edits:
        *above, last = path.split("/")
        table: Any = data
        for step in above:
            table = table[int(step)] if isinstance(table, list) else table.setdefault(step, {})
        place: Any = int(last) if isinstance(table, list) else last
        if value is REMOVED:
            del table[place]
        elif isinstance(table, list) and place == len(table):
            table.append(copy.deepcopy(value))
        else:
            table[place] = copy.deepcopy(value)
    return data


def findings(*edits, base=PLAIN):
    with pytest.raises(MissionError) as caught:
        Mission.from_dict(changed(*edits, base=base), "plain.toml")
    return caught.value.findings


def slots(mission, name):
    found = mission.formation_slots(name)
    assert found is not None
    return found


def fails(call, *args):
    with pytest.raises(MissionError) as caught:
        call(*args)
    (finding,) = caught.value.findings
    return finding


# -- shipped missions


def test_all_missions_of_the_paper_are_shipped():
    """The tables, the appendix, the two failures that the paper's plain laws have, a show, and vehicles."""
    assert mission_names() == SHIPPED


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_mission_is_in_order(name):
    """A shipped mission loads, carries its name, says what it shows and, but for the scenes, where it is from."""
    mission = load_mission(name)
    assert mission.name == name
    assert mission.title
    assert mission.source or name in (
        "show-1000",
        "crazyflies",
        "cube-by-neighbours",
        "delayed",
        "downwash-cube",
        "lossy-passage",
        "market-square",
        "moving-obstacles",
        *SCENES,
    )
    assert mission.text == mission_text(name)
    assert mission.text.startswith("# ")


@pytest.mark.parametrize("name", ["establish-cube", "cube-waypoint", "cube-passage"])
def test_cube_missions_have_corrected_table_4(name):
    """The 18 edges are the paper's, with d45 a diagonal and d48 a side."""
    mission = load_mission(name)
    np.testing.assert_array_equal(mission.formation_edges("cube"), graphs.CUBE_EDGES)
    length = {
        tuple(e): d
        for e, d in zip(
            mission.formation_edges("cube").tolist(),
            mission.formation_distances("cube"),
            strict=True,
        )
    }
    assert length[3, 4] == pytest.approx(4 * math.sqrt(2))
    assert length[3, 7] == pytest.approx(4)


def test_table_4_as_printed_keeps_its_swapped_pair():
    """As printed d45 is 4 m and d48 a diagonal, and the shape that is meant is still the cube."""
    mission = load_mission("establish-cube-as-printed")
    off = mission.formation_distances("cube") - distance_geometry.distances(
        slots(mission, "cube"), mission.formation_edges("cube")
    )
    swapped = mission.formation_edges("cube")[np.abs(off) > 1e-9]
    assert swapped.tolist() == [[3, 4], [3, 7]]
    assert off[np.abs(off) > 1e-9] == pytest.approx([4 - 4 * math.sqrt(2), 4 * math.sqrt(2) - 4])


def test_passages_share_their_environment():
    """Both passages fly among the same obstacles; the gap takes 2 m and two radii, but not 4 m."""
    triangle, cube = load_mission("narrow-passage"), load_mission("cube-passage")
    assert triangle.obstacles == cube.obstacles
    walls = {o.name: o for o in triangle.obstacles if isinstance(o, Box)}
    gap = walls["east wall"].min[0] - walls["west wall"].max[0]
    width = 2 * triangle.agents.radius[0]
    assert 2 + width < gap < 4 + width
    assert walls["east wall"].max[1] < 84


# -- what a mission holds


def test_numbers_stand_for_all_agents():
    """Masses, radii and limits come out as one for each agent; agents without velocity are at rest."""
    agents = Mission.from_dict(changed(("agents/thrust_limit", 23.6))).agents
    assert agents.mass == (1.0, 1.0, 1.0)
    assert agents.radius == (0.25, 0.25, 0.25)
    assert agents.thrust_limit == (23.6, 23.6, 23.6)
    assert agents.velocity == ((0.0, 0.0, 0.0),) * 3
    assert Mission.from_dict(PLAIN).agents.thrust_limit == (math.inf,) * 3


def test_lists_stand_for_one_agent_each():
    """Agents may differ."""
    agents = Mission.from_dict(
        changed(("agents/mass", [1, 2, 3]), ("agents/radius", [0, 1, 2]))
    ).agents
    assert agents.mass == (1.0, 2.0, 3.0)
    assert agents.radius == (0.0, 1.0, 2.0)


def test_gains_default_to_a_triple_pole():
    """The default gains have three poles at -2 /s: (s + 2)^3 = s^3 + 6 s^2 + 12 s + 8."""
    c = Mission.from_dict(PLAIN).constraint
    np.testing.assert_allclose([2 * c.alpha, c.beta**2, c.gamma], np.poly([-2, -2, -2])[1:])


def test_attitude_inherits_weights():
    """Weights of the attitude are those of the centre of mass unless given, key by key."""
    plain = Mission.from_dict(changed(("lqr", {"R": 2.0}))).lqr
    assert (plain.attitude.R, plain.attitude.S) == (2.0, (1e3, 1e2))
    given = Mission.from_dict(changed(("lqr", {"R": 2.0, "attitude": {"S": [1e5, 1e4]}}))).lqr
    assert (given.attitude.R, given.attitude.S, given.S) == (2.0, (1e5, 1e4), (1e3, 1e2))


@pytest.mark.parametrize(
    ("architecture", "controls"),
    [("local", ["tracking", "tracking", "tracking"]), ("body", ["open", "body", "body"])],
)
def test_control_follows_architecture(architecture, controls):
    """Locally every phase tracks slots; the virtual body is controlled once it is established."""
    mission = Mission.from_dict(changed(("architecture", architecture)))
    assert [p.control for p in mission.phases] == controls


def test_an_orbit_tracks_slots_in_both_architectures():
    """It does so by default, and no wrench on the virtual body can lead it."""
    body = ("architecture", "body")
    assert Mission.from_dict(changed(body, ("phases/1", ORBIT))).phases[1].control == "tracking"
    (finding,) = findings(body, ("phases/1", ORBIT | {"control": "body"}))
    assert finding.key == "phases[2].control"
    assert "cannot be flown by a wrench" in finding.problem


def test_an_orbit_is_told_in_words():
    """Where it leads to is told as of any phase."""
    phase = Mission.from_dict(changed(("phases/1", ORBIT))).phases[1]
    assert phase.leads_to == "round (5, 5, 8) m at 4 m, 30°/s"


def test_names_default_to_kind_and_number():
    """Phases and obstacles without a name can be told apart."""
    boxes = [{"kind": "box", "min": [0, 0, 0], "max": [1, 1, 1]}, {"kind": "ground"}]
    mission = Mission.from_dict(changed(("obstacles", boxes)))
    assert [p.name for p in mission.phases] == ["establish 1", "fly 2", "hold 3"]
    assert [o.name for o in mission.obstacles] == ["box 1", "ground"]


def test_angles_are_given_together_or_kept():
    """With one angle given the others are 0; with none the commanded attitude is kept."""
    for value, angles in ((-90, (0.0, 0.0, -90.0)), (REMOVED, None)):
        fly = Mission.from_dict(changed(("phases/1/yaw_deg", value))).phases[1]
        assert isinstance(fly, Fly)
        assert fly.attitude_deg == angles


def test_edges_are_the_union_of_all_formations():
    """Edges of all formations, each once, counted from 0, in the order in which they appear."""
    base = load_mission("cube-passage").to_dict()
    base["formations"]["cuboid"]["edges"] += [[8, 1]]
    edges = Mission.from_dict(base).edges
    np.testing.assert_array_equal(edges, [*graphs.CUBE_EDGES.tolist(), [0, 7]])


def test_slots_are_centred_and_derived_from_distances():
    """Slots come about their centre, and from a complete set of distances where none are given."""
    own = [[1.0, 0, 0], [2, 0, 0], [3, 3, 0]]
    mission = Mission.from_dict(changed(("formations/own", {"slots": own})))
    np.testing.assert_allclose(slots(mission, "own"), np.array(own) - [2, 1, 0])
    np.testing.assert_allclose(
        slots(mission, "line"), [[-4, 0, 0], [0, 0, 0], [4, 0, 0]], atol=1e-9
    )
    some = {"edges": [[1, 2], [2, 3]], "distances": [4, 4]}
    assert Mission.from_dict(changed(("formations/some", some))).formation_slots("some") is None


def test_latest_end_counts_time_outs():
    """A mission is over at its last `until`, or after each time-out at the latest."""
    assert Mission.from_dict(PLAIN).latest_end == 20.0
    hold = {"kind": "hold", "settle": {"timeout": 30.0}}
    assert Mission.from_dict(changed(("phases/2", hold))).latest_end == 45.0


def test_one_agent_is_a_mission():
    """A single vehicle flies without any formation."""
    agents = {"mass": 1.0, "position": [[0, 0, 1]]}
    phases = [{"kind": "fly", "position": [1, 0, 1], "until": 5.0}]
    mission = Mission.from_dict(
        {"schema_version": 1, "name": "one", "agents": agents, "phases": phases}
    )
    assert mission.edges.shape == (0, 2)


# -- plain data and TOML


@pytest.mark.parametrize("name", SHIPPED)
def test_mission_survives_a_round_trip(name):
    """A mission written as plain data and read again is the same mission."""
    mission = load_mission(name)
    again = Mission.from_dict(mission.to_dict())
    assert again.model_dump() == mission.model_dump()
    assert Mission.from_toml(again.text).model_dump() == mission.model_dump()


def test_agents_may_start_in_a_shape():
    """A start given as a shape is the list of its slots, about its centre."""
    shape = {"shape": "grid", "size": 2.0, "count": 7, "centre": [1, 2, 3]}
    mission = Mission.from_dict(
        changed(("agents/position", shape)) | {"formations": {}, "phases": HELD}
    )
    np.testing.assert_allclose(mission.agents.position, shapes.slots("grid", 2.0, 7) + [1, 2, 3])
    assert len(mission.agents.mass) == mission.n_agents == 7
    assert mission.to_dict()["agents"]["position"] == shape


@pytest.mark.parametrize(
    ("edit", "key", "words"),
    [
        ({"shape": "gird"}, "agents.position.shape", "did you mean 'grid'?"),
        ({"count": 0}, "agents.position.count", "must be >= 1"),
        ({"count": 3}, "agents.position.shape", "takes 4 or more agents, not 3"),
        ({"sise": 1.0}, "agents.position.sise", "did you mean 'size'?"),
    ],
)
def test_errors_of_a_start_in_a_shape(edit, key, words):
    """What is wrong with the shape is said where it stands."""
    start = {"shape": "grid", "size": 2.0, "count": 7} | edit
    with pytest.raises(MissionError) as caught:
        Mission.from_dict(changed(("agents/position", start)) | {"formations": {}, "phases": HELD})
    assert [f.key for f in caught.value.findings] == [key]
    assert words in str(caught.value)


def large(**form) -> dict[str, Any]:
    """Thirty agents that start in a grid and take one formation, by edges with names."""
    return changed(("agents/position", {"shape": "grid", "size": 3.0, "count": 30})) | {
        "formations": {"f": {"shape": "sphere", "size": 2.0} | form},
        "phases": [{"kind": "establish", "formation": "f", "duration": 9.0}],
    }


def test_graphs_have_names():
    """'neighbours', 'henneberg' and 'henneberg-multilevel' are the graphs that the functions of those names make."""
    p = shapes.slots("sphere", 2.0, 30)
    for form, want in (
        ({"edges": "neighbours"}, graphs.neighbour_edges(p)),
        ({"edges": "neighbours", "reach": 1.2}, graphs.neighbour_edges(p, 1.2)),
        ({"edges": "henneberg"}, graphs.henneberg(p)),
        ({"edges": "henneberg-multilevel"}, graphs.henneberg_multilevel(p)),
    ):
        np.testing.assert_array_equal(Mission.from_dict(large(**form)).formation_edges("f"), want)


@pytest.mark.parametrize(
    ("form", "key", "words"),
    [
        ({"edges": "henneberg", "reach": 1.5}, "formations.f.reach", "has no effect"),
        ({"edges": "henneberg", "shape": "grid"}, "formations.f.edges", "need slots"),
        ({"edges": "neighbours", "distances": [1.0]}, "formations.f.edges", "needs slots"),
        (
            {"edges": "all"},
            "formations.f.edges",
            "must be 'complete', 'neighbours', 'henneberg' or 'henneberg-multilevel'",
        ),
    ],
)
def test_errors_of_graphs_with_names(form, key, words):
    """A graph that cannot be made says why."""
    with pytest.raises(MissionError) as caught:
        Mission.from_dict(large(**form))
    assert key in [f.key for f in caught.value.findings]
    assert words in str(caught.value)


def test_slots_are_assigned_anew_at_each_change():
    """By 'each', every change takes the least sum of squares, and edges go with their slots."""
    data: dict[str, Any] = large(edges="neighbours") | {"assignment": "each"}
    data["formations"]["g"] = {"shape": "helix", "size": [6.0, 3.0, 2.0], "edges": []}
    data["phases"].append({"kind": "reshape", "formation": "g", "duration": 9.0})
    mission = Mission.from_dict(data)
    places = np.array(mission.agents.position)
    for name in ("f", "g"):
        slots = mission.formation_slots(name)
        assert slots is not None
        taken = mission.assigned_slots[name]
        own = mission.formations[name].slot_array(30)
        assert own is not None
        np.testing.assert_array_equal(slots, own[taken])
        # Least squares: no two agents are better off with each other's slot.
        x, y = places @ slots.T, (places * slots).sum(axis=1)
        assert (x + x.T <= y[:, None] + y + 1e-9).all()
        places = slots
    slots = mission.formation_slots("f")
    assert slots is not None
    between = distance_geometry.distances(slots, mission.formation_edges("f"))
    np.testing.assert_allclose(between, mission.formation_distances("f"))


def test_arrays_of_numpy_are_plain_data():
    """Positions may come as an array, numbers as NumPy's; None stands for an absent key."""
    edits = ("agents/position", np.eye(3)), ("gravity", np.float64(1.62)), ("title", None)
    mission = Mission.from_dict(changed(*edits))
    assert mission.agents.position == ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    assert mission.gravity == 1.62
    assert mission.title == ""


def test_points_are_written_one_to_a_line():
    """A mission written from plain data has each point on a line of its own, and numbers on one line."""
    data = changed(("agents/position", np.eye(3)), ("agents/mass", [1.0, 2.0, -3e-22]))
    text = to_toml(data)
    assert "position = [\n    [1.0, 0.0, 0.0],\n    [0.0, 1.0, 0.0]," in text
    assert "mass = [1.0, 2.0, -3e-22]\n" in text
    title = 'of "[\n    1,\n]"'
    assert tomllib.loads(to_toml({"title": title})) == {"title": title}


def test_awkward_names_survive_toml():
    """Quotes, dots, controls and other scripts in names come back as they were."""
    name = 'a "quoted" .dotted\\ \u03b1\x7f\n'
    data = changed(
        (f"formations/{name}", {"shape": "line", "size": 2}), ("phases/0/formation", name)
    )
    assert list(Mission.from_dict(data).formations) == ["triangle", "line", name]


def test_what_has_no_toml_form_is_named():
    """An object in plain data is refused with its type."""
    finding = fails(Mission.from_dict, changed(("agents/mass", object())))
    assert "object has no place in a mission" in finding.problem


def test_missions_cross_processes():
    """A mission comes back whole from a worker process, its text included."""
    mission = load_mission("square")
    again = pickle.loads(pickle.dumps(mission))
    assert again == mission
    assert again.text == mission.text


def test_a_mission_that_is_changed_has_a_text_of_its_own():
    """Other phases, or another assignment, are in the text, whose digest a report names; known times leave it."""
    data = load_mission("square").to_dict()
    mission = Mission.from_dict(data)
    later = [x | {"name": f"{k}"} for k, x in enumerate(data["phases"])]
    for other in (mission.with_phases(later), mission.with_assignment("safe")):
        assert other.digest != mission.digest
        assert Mission.from_toml(other.text).model_dump() == other.model_dump()
    assert mission.with_phases(data["phases"]).digest == mission.digest


def test_a_copy_has_nothing_that_follows_from_what_is_changed():
    """A copy of a mission that has flown is flown with its own gusts, masses and roofs."""
    mission = load_mission("windy-passage")
    first, data = simulate(mission).position, mission.to_dict()
    data["disturbances"]["gusts"]["seed"] = 9
    assert (mission.roofs.kind.size, mission.fleet.mass[0]) == (5, 1.0)
    other = Mission.from_dict(data).disturbances
    heavy = mission.agents.model_copy(update={"mass": (2.0, 2.0, 2.0)})
    roof = Box.model_validate({"kind": "box", "name": "roof", "min": [0, 0, 0], "max": [1, 1, 1]})
    copies = {"disturbances": other, "agents": heavy, "obstacles": (roof,)}
    gusty, loaded, roofed = (mission.model_copy(update={k: x}) for k, x in copies.items())
    assert not np.array_equal(simulate(gusty).position, first)
    assert (loaded.fleet.mass[0], roofed.roofs.kind.size) == (2.0, 1)
    assert np.array_equal(simulate(mission.model_copy()).position, first)


# -- what is found


@pytest.mark.parametrize(
    ("edit", "key", "problem", "remedy"),
    [
        # keys and types
        (("gravty", 9.81), "gravty", "unknown key", "did you mean 'gravity'?"),
        (("agents/masses", 1.0), "agents.masses", "unknown key", "did you mean 'mass'?"),
        (("phases/1/yaw", 3.0), "phases[2].yaw", "unknown key", "did you mean 'yaw_deg'?"),
        (("phases/2/position", [0, 0, 0]), "phases[3].position", "unknown key", "known keys"),
        (("lqr/attitude/q", [1, 1]), "lqr.attitude.q", "unknown key", "did you mean 'Q'?"),
        (("schema_version", REMOVED), "schema_version", "is missing", "1"),
        (("schema_version", 2), "schema_version", "must be 1", "use 1"),
        (("name", "../up"), "name", "characters", "letters, digits"),
        (("title", "two\nlines"), "title", "characters", "one line"),
        (("architecture", "locl"), "architecture", "'local' or 'body'", "did you mean 'local'?"),
        (("gravity", "9.81"), "gravity", "must be a number", "[m/s^2]"),
        (("phases/0/blend", "4 s"), "phases[1].blend", "must be numeric, or 'auto'", "[s]"),
        (("gravity", True), "gravity", "must be a number", "[m/s^2]"),
        (("gravity", math.nan), "gravity", "must be finite", "[m/s^2]"),
        (("gravity", 10**400), "gravity", "must be", "[m/s^2]"),
        (("agents", REMOVED), "agents", "is missing", "[agents]"),
        (("agents", 3), "agents", "must be a table", "[agents]"),
        (("formations", [1]), "formations", "must be a table", "[formations.NAME]"),
        (("formations/line", 3), "formations.line", "must be a table", "[formations.line]"),
        (("obstacles", {"kind": "box"}), "obstacles", "array of tables", "[[obstacles]]"),
        (("phases", []), "phases", "there is no phase", "[[phases]]"),
        (("phases/0", 3), "phases[1]", "must be a table", "[[phases]]"),
        # agents
        (("agents/mass", -1.0), "agents.mass", "must be > 0", "[kg]"),
        (("agents/mass", [1, 0, 1]), "agents.mass[2]", "must be > 0", "[kg]"),
        (("agents/mass", [1, 1]), "agents.mass", "2 entries for 3 agents", "3 in all"),
        (("agents/mass", math.inf), "agents.mass", "must be finite", "[kg]"),
        (("agents/mass", REMOVED), "agents.mass", "is missing", "[kg]"),
        (("agents/position", []), "agents.position", "is empty", "[m]"),
        (("agents/position/1", [8, 3]), "agents.position[2]", "3 numbers, not 2", "[x, y, z]"),
        (("agents/position/1/2", math.nan), "agents.position[2][3]", "must be finite", "[m]"),
        (("agents/position/1", [1, 6, 3]), "agents.position[2]", "agents 1 and 2 start at the same point", "apart"),
        (("agents/velocity", [[0, 0, 0]]), "agents.velocity", "1 entries for 3", "3 in all"),
        (("agents/thrust_limit", 0), "agents.thrust_limit", "must be > 0", "[N]"),
        (("agents/thrust_limit", math.nan), "agents.thrust_limit", "must be", "[N]"),
        (("agents/saturate", True), "agents.saturate", "no limit", "thrust_limit"),
        (("agents/saturate", 1), "agents.saturate", "true or false", "thrust_limit"),
        # gains and weights
        (("constraint/alpha", 0.0), "constraint.alpha", "unstable, must be > 0", "stabilisation"),
        (("constraint/beta", -1.0), "constraint.beta", "unstable, must be > 0", "sqrt(3) p"),
        (("constraint/gamma", -1.0), "constraint.gamma", "unstable, must be >= 0", "p^3"),
        (("constraint/gamma", 72.0), "constraint.gamma", "below 2 alpha beta^2 = 72", "lower gamma"),
        (("constraint/solver", "exat"), "constraint.solver", "must be", "did you mean 'exact'?"),
        (("constraint/iterations", 0), "constraint.iterations", "must be >= 1", "iterations"),
        (("constraint/iterations", 3.0), "constraint.iterations", "whole number", "iterations"),
        (("lqr/R", 0), "lqr.R", "must be > 0", "acceleration"),
        (("lqr/Q", [1, -1]), "lqr.Q[2]", "must be >= 0", "rate error"),
        (("lqr/horizon", "infinite"), "lqr.Q", "infinite horizon needs", "Q = [1.0, 1.0]"),
        (("lqr/S", [0, 0]), "lqr.S", "regulator does nothing", "S = [1e3, 1e2]"),
        (("lqr/R", 1e-13), "lqr.R", "gains would be unbounded", "raise R"),
        (("lqr", {"R": 1e-12, "attitude": {"S": [1e5, 0]}}), "lqr.R", "lqr.attitude, 100000", "raise R"),
        (
            ("lqr", {"R": 1e-12, "attitude": {"R": 1e-12, "S": [1e5, 0]}}),
            "lqr.attitude.R",
            "gains would be unbounded",
            "raise R",
        ),
        (("lqr/attitude", {"R": 1e-13}), "lqr.attitude.R", "gains would be unbounded", "raise R"),
        (("lqr/attitude", {"S": [0, 0]}), "lqr.attitude.S", "regulator does nothing", "S ="),
        (("tracking/R", 1e-15), "tracking.R", "gains would be unbounded", "raise R"),
        (("tracking/Q", [0, 1]), "tracking.Q", "weight of at least", "[4.0, 4.0]"),
        (("allocation/torque_split", "equal"), "allocation.torque_split", "no effect", "pinv"),
        (("integrator/rtol", 0), "integrator.rtol", "must be > 0", "relative"),
        # formations
        (("formations/triangle/shape", "triangel"), "formations.triangle.shape", "unknown", "did you"),
        (("formations/triangle/size", REMOVED), "formations.triangle.size", "is missing", "[m]"),
        (("formations/triangle/shape", "cube"), "formations.triangle.shape", "8 agents, not 3", "chan"),
        (("formations/triangle/size", [1, 2]), "formations.triangle.size", "3 numbers, not 2", "[m]"),
        (("formations/a.b", {}), 'formations."a.b"', "neither shape", "give shape"),
        (("formations/line/distances", [4, 4]), "formations.line.distances", "2 entries for 3", "one per edge"),
        (("formations/line/distances/1", 8.5), "formations.line.distances", "no triangle", "0.5 m"),
        (("formations/line/distances/1", 0), "formations.line.distances[2]", "must be > 0", "[m]"),
        (("formations/line/edges", [[1, 4]]), "formations.line.edges[1]", "agent outside 1 to 3", "from 1"),
        (("formations/line/edges", [[0, 1]]), "formations.line.edges[1]", "agent outside 1 to 3", "from 1"),
        (("formations/line/edges", [[2, 2]]), "formations.line.edges[1]", "to itself", "two different agents"),
        (("formations/line/edges", [[1, 2], [2, 1]]), "formations.line.edges[2]", "repeats edge 1", "rem"),
        (("formations/line/edges", [[1, 2, 3]]), "formations.line.edges[1]", "2 numbers, not 3", "pairs"),
        (("formations/line/edges", [[1, 2.0]]), "formations.line.edges[1][2]", "whole number", "pairs"),
        (("formations/line/edges", "all"), "formations.line.edges", "must be 'complete'", "complete"),
        # obstacles and limits
        (("obstacles", [{"kind": "bx"}]), "obstacles[1].kind", "unknown kind", "did you mean 'box'?"),
        (("obstacles", [{}]), "obstacles[1].kind", "is missing", "box, ground"),
        (("limits/geofence", {"min": [0, 0, 0]}), "limits.geofence.max", "is missing", "corner"),
        (("limits/geofence", {"min": [0, 0, 9], "max": [1, 1, 1]}), "limits.geofence", "z has 9 >= 1 m", "swap"),
        (("limits/speed", 0), "limits.speed", "must be > 0", "[m/s]"),
        # phases
        (("phases/1/kind", "flly"), "phases[2].kind", "unknown kind", "did you mean 'fly'?"),
        (("phases/1/kind", REMOVED), "phases[2].kind", "is missing", "establish, fly"),
        (("phases/0/until", REMOVED), "phases[1]", "has no ending", "until, duration, settle"),
        (("phases/0/duration", 6.0), "phases[1]", "two endings, until and duration", "one of until"),
        (("phases/2/until", 15.0), "phases[3].until", "starts at 15 s", "duration is a length"),
        (("phases/0/blend", 6.5), "phases[1].blend", "lasts 6 s", "blend <= 6"),
        (("phases/0/until", 3.0), "phases[1].blend", "lasts 3 s", "blend <= 3"),
        (("phases/0/settle", {"timout": 3}), "phases[1].settle.timout", "unknown key", "'timeout'"),
        (("phases/0/name", "hold 3"), "phases[3].name", "name of phase 1", "its own"),
        (("phases/0/formation", "triangel"), "phases[1].formation", "no such", "'triangle'?"),
        (("phases/0/formation", REMOVED), "phases[1].formation", "is missing", "name of the"),
        (("phases/0/kind", "reshape"), "phases[1].kind", "no formation has been established", "establish"),
        (("phases/0/control", "body"), "phases[1].control", "architecture = 'body'", "tracking"),
        (("phases/1/control", "open"), "phases[2].control", "needs feedback control", "tracking"),
        (("phases/0/input_force", [1, 0, 0]), "phases[1].input_force", "no effect", "open"),
        (("phases/1/position", REMOVED), "phases[2].position", "is missing", "[m]"),
        (("phases/1", {"kind": "turn", "duration": 3.0}), "phases[2]", "no target angle", "yaw_deg"),
        (("phases/1", ORBIT | {"rate_deg_s": 0.0}), "phases[2].rate_deg_s", "must not be 0", "a rate"),
        (("phases/1", ORBIT | {"rate_deg_s": 5e3}), "phases[2].rate_deg_s", "maximum is 100", "lower"),
        (("phases/1", ORBIT | {"rate_deg_s": 1e6, "radius": 1e4}), "phases[2].rate_deg_s", "m/s^2", "lower"),
        (("phases/1", ORBIT | {"radius": 0.0}), "phases[2].radius", "must be > 0", "[m]"),
        (("phases/1", ORBIT | {"radius": -3.0}), "phases[2].radius", "must be > 0", "[m]"),
        (("phases/1", ORBIT | {"center": [0, 0, 0]}), "phases[2].center", "unknown key", "'centre'?"),
        (("phases/1", ORBIT | {"blend": 9.5}), "phases[2].blend", "lasts 9 s", "blend <= 9"),
        (("phases/1", ORBIT | {"yaw": "free"}), "phases[2].yaw", "'fixed' or 'along'", "use fixed"),
        (("phases/1", ORBIT | {"control": "open"}), "phases[2].control", "needs feedback control", "'tracking'"),
        (("phases/1", ORBIT | {"control": "body"}), "phases[2].control", "architecture = 'body'", "tracking"),
        (("phases/1", ORBIT_SETTLES), "phases[2].settle", "needs a time at which it ends", "duration or until"),
        (("output_step", 30.0), "output_step", "longer than the mission", "reduce"),
        (("output_step", 1e-6), "output_step", "would have 2e+07 samples", "or more"),
        (("output_step", 0), "output_step", "must be > 0", "[s]"),
    ],
)  # fmt: skip
def test_error_is_found(edit, key, problem, remedy):
    """Each error is found alone, at its key, with its problem and a remedy."""
    (finding,) = findings(edit)
    assert finding.file == "plain.toml"
    assert finding.key == key
    assert problem in finding.problem
    assert remedy in finding.remedy


@pytest.mark.parametrize(
    ("given", "key", "problem", "remedy"),
    [
        ([1], "", "must be a table", "[disturbances]"),
        ({"winds": [1, 0, 0]}, "winds", "unknown key", "did you mean 'wind'?"),
        ({"wind": [1, 0]}, "wind", "must have 3 numbers", "[m/s]"),
        ({"drag": -0.1}, "drag", "must be >= 0", "[N s/m]"),
        ({"drag": [0.1, 0.2]}, "drag", "2 entries for 3 agents", "3 in all"),
        ({"wind": [1, 0, 0], "drag": 0}, "drag", "have no effect", "omit it"),
        ({"mass_error": -1}, "mass_error", "must be > -1", "true mass"),
        ({"mass_error": [0.1]}, "mass_error", "1 entries for 3 agents", "3 in all"),
        ({"gusts": {"model": "drydn"}}, "gusts.model", "'first-order' or 'dryden'", "mean 'dryden'?"),
        ({"noise": {}}, "noise", "is zero", "position [m]"),
        ({"noise": {"position": -1}}, "noise.position", "must be >= 0", "[m]"),
        ({"noise": {"position": 1, "rate": 1e4}}, "noise.rate", "must be <= 1000", "[Hz]"),
        ({"lost": {"agent": 4, "time": 1}}, "lost", "must be a list", "vehicles lost"),
        ({"lost": [{"agent": 4, "time": 1}]}, "lost[1].agent", "no such agent", "from 1 to 3"),
        ({"lost": [{"agent": 1, "time": 0}]}, "lost[1].time", "must be > 0", "[s]"),
        ({"lost": [{"agent": 1, "time": 20}]}, "lost[1].time", "end of the mission at 20 s", "earlier"),
        ({"lost": [{"agent": 1, "at": 2, "time": 3}]}, "lost[1].at", "unknown key", "'agent'"),
        ({"lost": [{"agent": 1, "time": t} for t in (2, 3)]}, "lost[2].agent", "twice", "remove"),
        ({"lost": [{"agent": i, "time": 2} for i in (1, 2, 3)]}, "lost", "all vehicles", "keep at least one"),
    ],
)  # fmt: skip
def test_error_of_disturbances_is_found(given, key, problem, remedy):
    """Each error of [disturbances] is found alone, at its key, with its problem and a remedy."""
    (finding,) = findings(("disturbances", given))
    assert finding.key == f"disturbances.{key}".rstrip(".")
    assert problem in finding.problem
    assert remedy in finding.remedy


FIRST = {"model": "first-order", "time_scale": 1.0, "intensity": 0.5}
DRYDEN = {"model": "dryden", "length": 10.0, "intensity": 0.5, "airspeed": 3.0}


@pytest.mark.parametrize(
    ("gusts", "key", "problem", "remedy"),
    [
        (FIRST | {"time_scale": None}, "time_scale", "is missing", "[s]"),
        (FIRST | {"intensity": None}, "intensity", "is missing", "[m/s]"),
        (FIRST | {"intensity": [1, 2]}, "intensity", "must have 3 numbers", "[m/s]"),
        (FIRST | {"length": 3.0}, "length", "no effect with model 'first-order'", "'dryden'"),
        (FIRST | {"altitude": 9.0}, "altitude", "no effect with model 'first-order'", "'dryden'"),
        (FIRST | {"airspeed": 3.0}, "airspeed", "no effect with model 'first-order'", "'dryden'"),
        (FIRST | {"correlation": 1.5}, "correlation", "must be <= 1", "0 to 1"),
        (FIRST | {"correlation": 0.5, "correlation_length": 9.0}, "correlation", "with correlation_length", "one of"),
        (FIRST | {"seed": -1}, "seed", "must be >= 0", "random numbers"),
        (FIRST | {"time_scale": 1e-6}, "", "too much memory", "increase the scales"),
        (DRYDEN | {"time_scale": 1.0}, "time_scale", "no effect with model 'dryden'", "'first-order'"),
        (DRYDEN | {"length": None}, "length", "is missing", "altitude"),
        (DRYDEN | {"altitude": 9.0}, "length", "together with altitude", "one of them"),
        (DRYDEN | {"length": None, "altitude": 1.0}, "altitude", "must be >= 3.048", "[m]"),
        (DRYDEN | {"airspeed": None}, "airspeed", "no wind", "[m/s]"),
        (DRYDEN | {"intensity": None}, "intensity", "altitude and wind together", "[m/s]"),
    ],
)  # fmt: skip
def test_error_of_gusts_is_found(gusts, key, problem, remedy):
    """Each error of gusts is found alone, at its key, with its problem and a remedy."""
    (finding,) = findings(("disturbances/gusts", gusts))
    assert finding.key == f"disturbances.gusts.{key}".rstrip(".")
    assert problem in finding.problem
    assert remedy in finding.remedy


def test_tables_of_noise_that_fit_into_no_memory_are_refused():
    """A thousand measurements a second of three agents over days are refused, not attempted."""
    edits = ("disturbances/noise", {"position": 0.1, "rate": 1000.0}), ("phases/2/until", 1e5)
    (finding,) = findings(*edits, ("output_step", 10.0))
    assert finding.key == "disturbances.noise.rate"
    assert "3 agents over 100000 s" in finding.problem


def test_correlation_by_distance_is_for_formations_not_swarms():
    """Beyond 2000 agents, correlation by distance names the other key."""
    place = [[float(i), 0.0, 5.0] for i in range(2001)]
    data = changed(
        ("agents/position", place), ("formations", {}), ("disturbances/gusts", FIRST | {"correlation_length": 9.0}),
        ("phases", [{"kind": "hold", "duration": 1.0}]),
    )  # fmt: skip
    (finding,) = findings(base=data)
    assert finding.key == "disturbances.gusts.correlation_length"
    assert "use correlation" in finding.remedy


@pytest.mark.parametrize(("key", "cure"), [("architecture", "local"), ("formulation", "inertial")])
def test_a_body_cannot_lose_a_vehicle(key, cure):
    """Where the states or the wrench are those of one body of all agents, a loss is refused in clear words."""
    (finding,) = findings((key, "body"), ("disturbances/lost", [{"agent": 2, "time": 3.0}]))
    assert finding.key == "disturbances.lost"
    assert f"{key} = 'body' does not support lost vehicles" in finding.problem
    assert finding.remedy == f"use {key} = '{cure}'"


def test_drag_defaults_where_air_moves():
    """Without a number, drag is 0.3 N s/m for each kg where there is wind or a gust, and none in still air."""
    masses = ("agents/mass", [1.0, 2.0, 0.5])
    windy = Mission.from_dict(changed(masses, ("disturbances/wind", [1, 0, 0])))
    np.testing.assert_allclose(windy.drag, [0.3, 0.6, 0.15])
    gusty = Mission.from_dict(changed(masses, ("disturbances/gusts", FIRST)))
    np.testing.assert_allclose(gusty.drag, [0.3, 0.6, 0.15])
    given = Mission.from_dict(changed(masses, ("disturbances/drag", 0.2)))
    np.testing.assert_allclose(given.drag, 0.2)
    still = Mission.from_dict(changed(masses, ("disturbances/mass_error", [0.1, 0.0, -0.1])))
    np.testing.assert_allclose(still.drag, 0.0)
    np.testing.assert_allclose(still.true_mass, [1.1, 2.0, 0.45])


@pytest.mark.parametrize(
    ("edits", "key", "problem"),
    [
        # A settling phase has a latest end, which a later `until` must leave room for.
        (
            [("phases/1", {"kind": "hold", "settle": {"timeout": 60.0}})],
            "phases[3].until",
            "as late as 66 s",
        ),
        # A finite horizon needs to know when to arrive.
        (
            [
                ("phases/1/duration", REMOVED),
                ("phases/1/settle", {"timeout": 10.0}),
                ("lqr/attitude", {"horizon": "infinite", "Q": [1, 1]}),
            ],
            "phases[2].settle",
            "finite horizon of lqr needs a time of arrival",
        ),
        (
            [("phases/1/travel", 30.0)],
            "phases[2].travel",
            "longer than the phase, which ends after",
        ),
        ([("phases/0/settle", {"dwell": 9, "timeout": 9}), ("phases/0/until", REMOVED),
          ("phases/2/until", 90.0)], "phases[1].settle", "times out before"),
        # Distances alone give slots only where they are complete.
        (
            [("formations/triangle", {"edges": [[1, 2], [2, 3]], "distances": [4, 4]}),
             ("phases/0/reference", "distances"), ("phases/0/control", "open"),
             ("phases/1", REMOVED)],
            "phases[2].control",
            "'triangle' has no slots to track",
        ),
        (
            [("formations/triangle", {"edges": [[1, 2], [2, 3]], "distances": [4, 4]}),
             ("phases/0/control", "open"), ("phases", PLAIN["phases"][:1]),
             ("phases/0/control", "open")],
            "phases[1].reference",
            "'triangle' has no slots to blend",
        ),
        # Distances beside a shape are typing errors unless they are flown as such.
        (
            [("formations/triangle/distances", [4, 4, 4.1])],
            "formations.triangle.distances[3]",
            "slots of agents 2 and 3 are 4 m apart",
        ),
        (
            [("phases/0/reference", "step"), ("phases/0/blend", 2.0)],
            "phases[1].blend",
            "no effect with reference 'step'",
        ),
        (
            [("dimension", 2), ("agents/position", [[0, 0, 0], [1, 1, 1], [3, 3, 4], [0, 1, 2]]),
             ("formations", {"triangle": {"shape": "pyramid", "size": 4.0}}), ("phases", PLAIN["phases"][:1])],
            "formations.triangle.dimension",
            "do not lie in a plane",
        ),
        (
            [("formations/line", {"slots": [[0, 0, 0], [1, 0, 0], [0, 0, 0]]})],
            "formations.line.slots[3]",
            "same point as slot 1",
        ),
        (
            [("formations/triangle/slots", [[0, 0, 0], [1, 0, 0], [2, 0, 0]])],
            "formations.triangle.slots",
            "a shape has its own slots",
        ),
        ([("formations/line", {"slots": [[0, 0, 0], [1, 0, 0]]})], "formations.line.slots", "2 slots"),
    ],
)  # fmt: skip
def test_contradiction_is_found(edits, key, problem):
    """What only several keys together tell is found at the key to change."""
    (finding,) = findings(*edits)
    assert finding.key == key
    assert problem in finding.problem
    assert finding.remedy


def test_tetrahedra_are_judged():
    """Six distances whose faces exist but whose volume would be imaginary are named by their agents."""
    square = load_mission("square").to_dict()
    d = 4 * math.sqrt(2)
    square["formations"]["square"] = {"distances": [4, d, 4, 4, d, 4]}
    assert Mission.from_dict(square).formation_slots("square") is not None
    (finding,) = findings(("formations/square/distances", [4, d, 4, 4, d + 0.1, 4]), base=square)
    assert "agents 1, 2, 3 and 4 form no tetrahedron (Cayley-Menger < 0)" in finding.problem
    assert "d24 = 5.75685" in finding.problem


def test_contradictions_of_five_agents_are_found():
    """Distances of which every four exist, but not all together, are refused."""
    p = shapes.slots("pyramid", 4.0, 5)
    d = distance_geometry.distances(p, graphs.complete_graph(5))
    base = load_mission("pyramid").to_dict()
    base["formations"]["pyramid"] = {"distances": d.tolist()}
    assert Mission.from_dict(base).formation_slots("pyramid") is not None
    ones = findings(("formations/pyramid/distances", [1.0] * 10), base=base)
    assert [f.key for f in ones] == ["formations.pyramid.distances"]
    assert "no points in space" in ones[0].problem


def test_many_contradictions_are_counted():
    """A set of distances that is wrong all over does not flood the screen."""
    base = load_mission("cube-passage").to_dict()
    base["formations"]["cube"] = {"distances": [1.0, 9.0] * 14}
    found = findings(base=base)
    assert len(found) < 10
    assert any("more triangles or tetrahedra" in f.problem for f in found)


def test_no_stabilisation_needs_no_stable_gains():
    """`stabilisation = "none"` is the named way to fly without feedback."""
    edits = ("constraint", {"stabilisation": "none", "alpha": 0, "beta": 0, "gamma": 0})
    assert Mission.from_dict(changed(edits)).constraint.alpha == 0


def test_planar_start_is_a_mission():
    """Eight agents in a plane are read, whatever moves them: a mission does not know the forces of its flight."""
    base = load_mission("establish-cube").to_dict()
    for p in base["agents"]["position"]:
        p[2] = p[0] + p[1] * 0.5
    assert Mission.from_dict(base)
    base["formations"]["cube"]["edges"] = []
    assert Mission.from_dict(base)


def test_all_errors_at_once():
    """Errors in every part are found in one look, each at its key, though other keys beside it are wrong."""
    found = findings(
        ("nam", "x"),
        ("gravity", -1),
        ("agents/mass", 0),
        ("agents/position/1", [1, 6, 3]),
        ("agents/colour", "red"),
        ("constraint", {"gamma": 100.0, "solver": "exat"}),
        ("lqr", {"R": 0, "horizon": "infinite"}),
        ("formations/line", {"distances": [4, 9, 4], "colour": 1}),
        ("formations/star", {"shape": "str", "edges": [[1, 9]]}),
        ("obstacles", [{"kind": "box", "min": [0, 0, 0], "max": [1, 1, -1], "nme": "x"}]),
        ("limits", {"sped": 1.0, "geofence": {"min": [0, 0, 0], "max": [0, 1, 1]}}),
        ("phases/0/formation", "triangel"),
        ("phases/1/position", [1, 2]),
        ("phases/1/duration", -1.0),
        ("phases/2/until", "soon"),
        ("phases/2/input_force", [1, 0, 0]),
        ("phases/3", {"kind": "turn", "until": 30.0, "control": "body"}),
        ("phases/4", {"kind": "hold", "until": 29.0}),
    )
    assert {f.key for f in found} == {
        "nam",
        "gravity",
        "agents.mass",
        "agents.position[2]",
        "agents.colour",
        "constraint.gamma",
        "constraint.solver",
        "lqr.R",
        "lqr.Q",
        "formations.line.distances",
        "formations.line.colour",
        "formations.star.shape",
        "formations.star.edges[1]",
        "obstacles[1]",
        "obstacles[1].nme",
        "limits.sped",
        "limits.geofence",
        "phases[1].formation",
        "phases[2].position",
        "phases[2].duration",
        "phases[3].until",
        "phases[3].input_force",
        "phases[4]",
        "phases[4].control",
        "phases[5].until",
    }
    assert all(f.file == "plain.toml" and f.problem and f.remedy for f in found)


def test_values_are_shown_as_written():
    """A finding carries the value that the user wrote."""
    (finding,) = findings(("agents/position/1", [8, 3]))
    assert finding.value == [8, 3]
    (finding,) = findings(("agents/mass", -1))
    assert finding.value == -1


def test_wrong_keys_cause_no_errors_elsewhere():
    """A wrong value is reported once; what would follow from it is not."""
    assert [f.key for f in findings(("formations/triangle/shape", 3))] == [
        "formations.triangle.shape"
    ]
    assert [f.key for f in findings(("phases/0/until", "6"))] == ["phases[1].until"]
    assert [f.key for f in findings(("lqr/Q", [-1, 0]))] == ["lqr.Q[1]"]
    assert [f.key for f in findings(("phases/0/blend", "x"), ("phases/0/until", 3.0))] == [
        "phases[1].blend"
    ]


# -- files


def test_mission_is_read_from_a_file(tmp_path):
    """A path is read as a file; its errors name it."""
    path = tmp_path / "mine.toml"
    path.write_text(mission_text("square"))
    assert load_mission(path).origin == str(path)
    assert load_mission(str(path)).name == "square"
    path.write_text(mission_text("square") + "colour = 1\n")
    with pytest.raises(MissionError) as caught:
        load_mission(path)
    assert caught.value.findings[0].file == str(path)


def test_shipped_name_wins(tmp_path, monkeypatch):
    """A shipped name means the shipped mission, `./name` a file of that name."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "square").write_text(mission_text("pyramid"))
    assert load_mission("square").name == "square"
    assert load_mission("./square").name == "pyramid"


def test_windows_files_are_read(tmp_path):
    """A byte order mark and Windows' line ends do not matter."""
    path = tmp_path / "mine.toml"
    path.write_bytes(b"\xef\xbb\xbf" + mission_text("square").replace("\n", "\r\n").encode())
    assert load_mission(path).name == "square"


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("narow-passage", "did you mean 'narrow-passage'?"),
        ("missions/establish-cub.toml", "did you mean 'establish-cube'?"),
        ("zzz", "shipped missions: bridge-inspection, "),
    ],
)
def test_unknown_missions_are_near_known_ones(name, remedy):
    """A name that is neither shipped nor a file is answered with what was perhaps meant."""
    finding = fails(load_mission, name)
    assert finding.file == name
    assert remedy in finding.remedy
    assert fails(mission_text, name).remedy == finding.remedy


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"a = ", "is not valid TOML: Invalid value (at end of document)"),
        (b"a = 1\na = 2\n", "at line 2"),
        (b"\x89PNG\r\n\x1a\n\0\0", "is not UTF-8 text (byte 1)"),
        ("name = 'Zürich'".encode("latin-1"), "is not UTF-8 text (byte 10)"),
        (b"a = " + b"[" * 100_000, "depth of brackets is 9 at line 1"),
        (b"a = " + b"1" * 10_000, "cannot be read as TOML"),
    ],
)
def test_files_that_are_no_missions(tmp_path, content, problem):
    """What is no TOML is refused with the place, whatever it is."""
    path = tmp_path / "mine.toml"
    path.write_bytes(content)
    finding = fails(load_mission, path)
    assert finding.file == str(path)
    assert problem in finding.problem
    assert finding.remedy


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be", "latin-1"])
def test_text_in_another_encoding_is_to_be_saved_anew(tmp_path, encoding):
    """A mission in UTF-16, as PowerShell's > writes it, is one, and is to be saved as UTF-8."""
    path = tmp_path / "mine.toml"
    mark = b"\xfe\xff" if encoding == "utf-16-be" else b""
    path.write_bytes(mark + "name = 'Zürich'".encode(encoding))
    assert fails(load_mission, path).remedy == "save it as UTF-8"


def test_paths_that_are_no_files(tmp_path):
    """A directory, an impossible name and an endless device are refused in a sentence."""
    assert "is a folder" in fails(load_mission, tmp_path).problem
    assert "cannot be read" in fails(load_mission, "a\0b").problem
    assert "cannot be read" in fails(load_mission, "x" * 5000).problem


@pytest.mark.skipif(not os.path.exists("/dev/zero"), reason="needs an endless device")
def test_endless_files_end(monkeypatch):
    """A file larger than any mission is refused before it fills memory."""
    monkeypatch.setattr("rigidfleet.mission.bounds.BYTES", 2**20)
    assert "larger than 1 MiB" in fails(load_mission, "/dev/zero").problem


def test_unreadable_files(monkeypatch):
    """A file without permission is refused in a sentence."""

    def refused(*_):
        raise PermissionError

    monkeypatch.setattr("rigidfleet.mission.text.open", refused, raising=False)
    assert "cannot be read: permission denied" in fails(load_mission, "mine.toml").problem


# -- robustness

JUNK = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 12),
    st.integers(),
    st.floats(),
    st.text(max_size=4),
    st.sampled_from(["open", "tracking", "body", "step", "distances", "complete", "cube", "fly"]),
    st.lists(st.floats(-9, 9), max_size=4),
    st.lists(st.lists(st.integers(-1, 9), max_size=3), max_size=9),
    st.dictionaries(
        st.sampled_from(["S", "min", "max", "kind", "timeout"]), st.floats(), max_size=2
    ),
)


def places(data, path=()):
    """Every place in plain data."""
    yield path
    for key, value in data.items() if isinstance(data, dict) else enumerate(data):
        if isinstance(value, dict | list):
            yield from places(value, (*path, key))
        else:
            yield (*path, key)


@given(
    st.sampled_from(SHIPPED),
    st.lists(st.tuples(st.integers(0, 10**6), JUNK), min_size=1, max_size=3),
)
def test_nothing_but_findings(name, changes):
    """Whatever is put in whatever place, a mission is either accepted or refused with findings."""
    data = tomllib.loads(mission_text(name))
    for pick, junk in changes:
        every = [p for p in places(data) if p]
        *above, last = every[pick % len(every)]
        table: Any = data
        for step in above:
            table = table[step]
        table[last] = junk
    try:
        mission = Mission.from_dict(data)
    except MissionError as error:
        refused = error
    else:
        assert mission.latest_end > 0
        for form in mission.formations:
            d = mission.formation_distances(form)
            assert d.shape == (len(mission.formation_edges(form)),)
            assert (d > 0).all()
        return
    assert all(f.problem and f.remedy for f in refused.findings)
    assert str(refused)


# -- for editors, and for a quick start


def test_schema_explains_every_key():
    """Each key of the format has a description in the JSON schema, each table its own."""
    schema = json_schema()
    tables = {"Mission": schema} | schema["$defs"]
    assert {"Agents", "Formation", "Establish", "Fly", "Box"} <= tables.keys()
    for name, table in tables.items():
        assert table["additionalProperties"] is False, name
        assert table["description"], name
        assert all(key["description"] for key in table["properties"].values()), name


def test_schema_takes_a_number_for_all_agents():
    """The schema accepts what the reader accepts: a number, or a list."""
    mass = json_schema()["$defs"]["Agents"]["properties"]["mass"]
    assert [choice["type"] for choice in mass["anyOf"]] == ["number", "array"]


def test_reading_missions_waits_for_no_compiler():
    """Checking a mission imports neither Numba nor SciPy."""
    code = (
        "import sys; from rigidfleet.mission import load_mission; load_mission('narrow-passage'); "
        "sys.exit(any(m in sys.modules for m in ('numba', 'scipy', 'matplotlib', 'xarray')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_mission_builds_the_models_that_it_has():
    """Models of what it lacks are not built, and what reads files of others is not imported."""
    code = (
        "import sys; from rigidfleet.mission import load_mission, kinds, obstacles, schema; load_mission('square'); "
        "unused = [schema.Vehicle, schema.Autopilot, schema.Constraint, schema.Tracking, schema.Disturbances, "
        "kinds.Go, kinds.Follow, obstacles.Heights]; "
        "print(*(m.__name__ for m in unused if m.__pydantic_complete__)); "
        "print(*(m for m in ('difflib', 'rigidfleet.foreign.files', 'rigidfleet._common.tables') if m in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("value", [REMOVED, 0, []])
def test_a_formation_with_errors_in_a_plane_is_a_finding(value):
    """Where a formation of dimension 2 has no distances, or wrong ones, the check says so and computes no slots."""
    keys = findings(("dimension", 2), ("formations/line/distances", value))
    assert {f.key for f in keys} <= {"formations.line", "formations.line.distances"}
