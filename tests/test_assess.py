import io
import json
import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from sample_flights import quadrotors

from rigidfleet._common.waypoints import SHAPE_TOLERANCE
from rigidfleet.assessment import Verdict, assess
from rigidfleet.assessment.checks import all_checks
from rigidfleet.assessment.fits import Fit, fits_by_sample, shape_of_slots
from rigidfleet.assessment.measure import Measurements
from rigidfleet.assessment.verdict import CheckResult
from rigidfleet.formation import distance_geometry, graphs, shapes
from rigidfleet.math import attitude as att
from rigidfleet.math import rigid_body
from rigidfleet.math.proximity import clearance, separation
from rigidfleet.mission import Mission
from rigidfleet.result import LABELS, VARIABLES, PhaseRecord, Result
from rigidfleet.simulation.flight import simulate
from rigidfleet.typing import Floats

TRIANGLE = {"triangle": {"shape": "triangle", "size": 4.0}}
LINE = {"line": {"shape": "line", "size": 4.0}}
CUBE = {"cube": {"shape": "cube", "size": 4.0}}
HEIGHT = np.array([0.0, 0.0, 10.0])


def a_mission(formations: dict[str, Any], n: int, phases: Any = None, **tables: Any) -> Mission:
    """A mission of n agents that take the (first) formation within 10 s."""
    name = next(iter(formations), None)
    agents: dict[str, Any] = {
        "mass": 1.0,
        "position": [[3.0 * i, i**2, 10.0 + i**3] for i in range(n)],
    }
    agents |= tables.pop("agents", {})
    one = [{"name": "form", "kind": "establish", "formation": name, "until": 10.0}]
    data: dict[str, Any] = {"schema_version": 1, "name": "test", "agents": agents}
    data["formations"] = formations
    return Mission.from_dict(data | {"phases": phases or one} | tables)


def flown(mission: Mission, position: Any, **changes: Any) -> Result:
    """A flight through positions (K, N, 3), or at rest at (N, 3), with all else quiet.

    Samples are spread evenly over 10 s; phases change where `phase` says, one phase by default.
    """
    r = np.array(position, dtype=float)
    if r.ndim == 2:
        r = np.broadcast_to(r, (5, *r.shape))
    K, N = r.shape[:2]
    edges = mission.edges
    sizes = {"time": K, "agent": N, "edge": len(edges)} | {d: len(n) for d, n in LABELS.items()}
    zero: dict[str, Any] = {
        name: np.zeros([sizes[d] for d in v.dims])
        for name, v in VARIABLES.items()
        if name not in ("vehicle_attitude", "vehicle_rates", "rotor_force", "saturated")
        and name not in ("message_age", "messages", "oldest_message", "vehicle_clock")
    }
    nothing: dict[str, Any] = {
        name: zero[name] * np.nan
        for name in VARIABLES
        if name.endswith("reference") or name in ("attitude", "frame", "slot_position")
    }
    apart, pair = separation(r, mission.agents.radius)
    clear, agent, obstacle = clearance(r, mission.agents.radius, mission.obstacles)
    phase = mission.phases[0]
    formation = getattr(phase, "formation", None)
    given: dict[str, Any] = {
        "time": np.linspace(0, 10, K),
        "position": r,
        "cm": r.mean(axis=1),
        "edges": edges,
        "distance": np.linalg.norm(r[:, edges[:, 0]] - r[:, edges[:, 1]], axis=2),
        "singular_value": np.ones(K),
        "thrust": np.full((K, N), 9.81),
        "separation": apart,
        "separation_pair": pair,
        "clearance": clear,
        "clearance_agent": agent,
        "clearance_obstacle": obstacle,
        "phases": [PhaseRecord(phase.name, phase.kind, "open", formation, 0.0, 10.0)],
        "mission_text": mission.text,
    }
    return Result(**(zero | nothing | given | changes))


def found(verdict: Verdict, check: str) -> CheckResult:
    """The one finding of a check."""
    (finding,) = [f for f in verdict.checks if f.check == check]
    return finding


def failures(verdict: Verdict) -> set[str]:
    assert verdict.passed == all(f.passed for f in verdict.checks)
    return {f.check for f in verdict.checks if not f.passed}


def other_notes(verdict: Verdict) -> list[str]:
    """Notes but the last: that these records do not tell what happens between their samples."""
    *notes, last = verdict.notes
    assert last.startswith("only samples are judged")
    return notes


def slots(mission: Mission, name: str) -> Any:
    s = mission.formation_slots(name)
    assert s is not None
    return s


def pulse(shape: tuple[int, ...], at: tuple[int, ...], value: float) -> Any:
    """Zeros but for one value."""
    x = np.zeros(shape)
    x[at] = value
    return x


# -- attitudes


@pytest.mark.parametrize(("commanded", "passes"), [(0.0, True), (2.0, False)])
def test_an_attitude_that_is_commanded_decides_over_the_integrated_frame(commanded, passes):
    """A plane that lies as commanded has not flipped, wherever the integrated frame has gone; and else it has."""
    mission = a_mission(TRIANGLE, 3)
    p = slots(mission, "triangle")
    asked = att.quaternion_from_dcm(att.dcm_from_euler([commanded, 0.0, 0.0]))
    frame = att.quaternion_from_dcm(att.dcm_from_euler([1.6, 0.0, 0.0]))
    quaternions = {
        "attitude_reference": np.tile(asked, (5, 1)), "frame": np.tile(frame, (5, 1))
    }  # fmt: skip
    verdict = assess(flown(mission, p + HEIGHT, **quaternions))
    assert failures(verdict) == (set() if passes else {"flip"})


# -- shapes


def turned(p: Any, roll: float = 0.3, pitch: float = -0.2, yaw: float = 2.0) -> Any:
    return p @ att.dcm_from_euler([roll, pitch, yaw])


@pytest.mark.parametrize(
    ("formations", "n", "handed", "order"),
    [(TRIANGLE, 3, None, None), (LINE, 3, None, True), (CUBE, 8, True, None)],
)
def test_a_formation_that_is_reached_passes(formations, n, handed, order):
    """A shape turned and moved anywhere is that shape: its errors are zero and no check fails."""
    mission = a_mission(formations, n)
    verdict = assess(flown(mission, turned(slots(mission, next(iter(formations)))) + HEIGHT))
    assert verdict.passed, verdict.summary
    (phase,) = verdict.phases
    assert phase.shape == pytest.approx(0, abs=1e-12)
    assert phase.distances == pytest.approx(0, abs=1e-12)
    assert (phase.handedness, phase.flip, phase.order) == (handed, None, order)


@pytest.mark.parametrize(("scale", "passes"), [(0.99, True), (1.01, False)])
def test_a_shape_fails_just_beyond_its_tolerance(scale, passes):
    """One agent off by just less or more than 1 % of the shortest distance decides."""
    mission = a_mission(TRIANGLE, 3)
    s = slots(mission, "triangle")
    d = s[2] - s[0]
    s[2] += scale * SHAPE_TOLERANCE * 4 * d / np.linalg.norm(d)
    verdict = assess(flown(mission, s + HEIGHT))
    assert verdict.passed == passes
    assert failures(verdict) == (set() if passes else {"distances", "shape"})
    assert found(verdict, "shape").worst == pytest.approx(scale * 0.04, rel=1e-3)
    assert found(verdict, "shape").who == "agents 1 and 3"


@pytest.mark.parametrize(("factor", "passes"), [(1.0, True), (1.02, False)])
def test_what_slots_alone_hold_is_judged_by_its_shape(factor, passes):
    """A formation without edges has no distances to judge, but a shape."""
    mission = a_mission({"triangle": TRIANGLE["triangle"] | {"edges": []}}, 3)
    verdict = assess(flown(mission, factor * slots(mission, "triangle") + HEIGHT))
    assert failures(verdict) == (set() if passes else {"shape"})
    assert "distances" not in {f.check for f in verdict.checks}
    assert "is not reached" in found(verdict, "shape").message or passes


def test_rigid_but_no_cube():
    """All 18 edges hold and the shape is another: the verdict says rigid, but no cube."""
    # Table 4 of the paper as printed, its pair (d45, d48) swapped: a skewed shape. Solved here by Newton.
    base = shapes.slots("cube", 4.0, 8)
    edges = graphs.CUBE_EDGES
    length = distance_geometry.distances(base, edges)
    swap = [(edges == e).all(axis=1).argmax() for e in [(3, 4), (3, 7)]]
    length[swap] = length[swap[::-1]]
    p = np.random.default_rng(0).normal(size=(8, 3)) * 0.5 + base
    for _ in range(200):
        i, j = edges.T
        u = p[i] - p[j]
        L = np.linalg.norm(u, axis=1)
        J = np.zeros((18, 8, 3))
        J[range(18), i], J[range(18), j] = u / L[:, None], -u / L[:, None]
        p -= 0.5 * (np.linalg.pinv(J.reshape(18, 24)) @ (L - length)).reshape(8, 3)
    assert np.abs(distance_geometry.distances(p, edges) - length).max() < 1e-9
    form = {
        "shape": "cube",
        "size": 4.0,
        "edges": (edges + 1).tolist(),
        "distances": length.tolist(),
    }
    phase = {"kind": "establish", "formation": "cube", "until": 10.0}
    phase |= {"reference": "distances", "control": "open"}
    verdict = assess(flown(a_mission({"cube": form}, 8, [phase]), p + HEIGHT))
    assert failures(verdict) == {"shape"}
    assert "'cube' is rigid, but no cube: all 18 edges hold" in found(verdict, "shape").message


def test_a_mirrored_cube_fails_and_a_mirrored_square_does_not():
    """Distances cannot tell a cube from its mirror image, the verdict can; a plane's mirror image is its back."""
    mirror = np.array([1, -1, 1])
    mission = a_mission(CUBE, 8)
    verdict = assess(flown(mission, turned(slots(mission, "cube") * mirror) + HEIGHT))
    assert failures(verdict) == {"handedness"}
    assert "mirror image" in found(verdict, "handedness").message
    larger = assess(flown(mission, 1.5 * slots(mission, "cube") * mirror + HEIGHT))
    assert failures(larger) == {"distances", "shape"}  # of no cube at all, a hand says nothing
    mission = a_mission({"square": {"shape": "square", "size": 4.0}}, 4)
    assert assess(flown(mission, slots(mission, "square") * mirror + HEIGHT)).passed


@pytest.mark.parametrize("reference", ["attitude_reference", "frame"])
@pytest.mark.parametrize(("roll", "passes"), [(0, True), (80, True), (100, False), (180, False)])
def test_a_triangle_upside_down_is_flipped(reference, roll, passes):
    """A planar shape whose normal is more than 90 deg from the commanded or integrated frame is flipped."""
    mission = a_mission(TRIANGLE, 3)
    p = slots(mission, "triangle") @ att.dcm_from_euler([math.radians(roll), 0, 0])
    yawed = np.tile(att.quaternion_from_euler([0, 0, 0.7]), (5, 1))  # no yaw turns it over
    verdict = assess(flown(mission, p + HEIGHT, **{reference: yawed}))
    assert verdict.phases[0].flip == pytest.approx(roll, abs=1e-9)
    assert failures(verdict) == (set() if passes else {"flip"})


@pytest.mark.parametrize(
    ("flip", "words"), [(90.0, "has not flipped"), (math.nextafter(90.0, 91.0), "has flipped")]
)
def test_a_quarter_turn_is_not_yet_flipped(flip, words):
    """At 90 deg itself the check passes and says so; its words and its outcome are never at odds."""
    mission = a_mission(TRIANGLE, 3)
    measured = Measurements(flown(mission, slots(mission, "triangle") + HEIGHT))
    phases = [replace(p, flip=flip) for p in measured.phase_verdicts()]
    (check,) = [c for c in all_checks(measured, phases) if c.check == "flip"]
    assert check.passed == (words == "has not flipped")
    assert words in check.message


@pytest.mark.parametrize(("turn", "noted"), [((0.0, 0.0, 2.0), False), ((math.pi, 0.0, 2.0), True)])
def test_a_triangle_that_comes_back_upside_down_is_noted(turn, noted):
    """Where nothing commands an attitude, a planar shape that comes back turned over is a note, no failure."""
    names = ["triangle", "line", "triangle"]
    kinds = ["establish", "reshape", "reshape"]
    phases = [
        {"kind": k, "formation": f, "duration": 5.0} for k, f in zip(kinds, names, strict=True)
    ]
    mission = a_mission(TRIANGLE | LINE, 3, phases)
    up, line = slots(mission, "triangle"), slots(mission, "line")
    back = up @ att.dcm_from_euler(turn)
    records = [
        PhaseRecord(f"{k}", "reshape", "open", names[k], 5.0 * k, 5.0 * k + 5) for k in range(3)
    ]
    path = np.array([up, up, line, line, back, back]) + HEIGHT
    times = [0.0, 5.0, 5.1, 10.0, 10.1, 15.0]
    verdict = assess(flown(mission, path, time=times, phases=records, phase=[0, 0, 1, 1, 2, 2]))
    assert verdict.passed
    assert len(other_notes(verdict)) == noted
    if noted:
        assert "turns over between 5.00 s and 15.00 s" in verdict.notes[0]


def test_a_line_out_of_order_fails():
    """A line has its agents in order, from either end; swapped ones fail."""
    mission = a_mission(LINE, 3)
    s = slots(mission, "line")
    for yaw in (0, 2, 4):
        assert assess(flown(mission, turned(s, yaw=yaw) + HEIGHT)).passed
        assert assess(flown(mission, turned(s[::-1], yaw=yaw) + HEIGHT)).passed
    verdict = assess(flown(mission, turned(s[[1, 0, 2]]) + HEIGHT))
    assert failures(verdict) == {"distances", "shape", "order"}
    assert "not in order" in found(verdict, "order").message


@pytest.mark.parametrize(("control", "passes"), [("tracking", False), ("open", True)])
def test_a_steered_line_must_point_the_right_way(control, passes):
    """Where slots are tracked a line that points backwards has flipped; elsewhere nothing steers it."""
    mission = a_mission(LINE, 3)
    record = PhaseRecord("form", "establish", control, "line", 0.0, 10.0)
    ahead = np.tile([1.0, 0, 0, 0], (5, 1))
    backwards = slots(mission, "line")[::-1] + HEIGHT
    verdict = assess(flown(mission, backwards, attitude_reference=ahead, phases=[record]))
    assert failures(verdict) == (set() if passes else {"flip"})


def test_distances_without_slots_are_judged_by_themselves():
    """A formation of distances that do not give its slots is judged by its edges alone."""
    form = {"path": {"edges": [[1, 2], [2, 3]], "distances": [4.0, 4.0]}}
    phase = {"kind": "establish", "formation": "path", "until": 10.0, "reference": "distances"}
    mission = a_mission(form, 3, [phase | {"control": "open"}])
    bent = np.array([[4.0, 0, 10], [0, 0, 10], [0, 4, 10]])
    verdict = assess(flown(mission, bent))
    assert verdict.passed
    assert verdict.phases[0].shape is None
    assert failures(assess(flown(mission, bent * [1.1, 1, 1]))) == {"distances"}


def test_a_lost_shape_fails_at_the_end_of_the_flight_only():
    """A shape may bend while it flies; at the flight's end, and where it is formed, it must be there."""
    phases = [
        {"kind": "establish", "formation": "triangle", "until": 4.0},
        {"kind": "hold", "until": 7.0},
        {"kind": "hold", "until": 10.0},
    ]
    mission = a_mission(TRIANGLE, 3, phases)
    s = slots(mission, "triangle") + HEIGHT
    records = [
        PhaseRecord("form", "establish", "tracking", "triangle", 0.0, 4.0),
        PhaseRecord("fly", "hold", "tracking", "triangle", 4.0, 7.0),
        PhaseRecord("stay", "hold", "tracking", "triangle", 7.0, 10.0),
    ]
    for lost, fails in [(0, True), (1, False), (2, True)]:
        p = np.array([s] * 6)
        p[2 * lost + 1, 0] += 0.5
        times = [0.0, 4.0, 4.1, 7.0, 7.1, 10.0]
        verdict = assess(flown(mission, p, time=times, phases=records, phase=[0, 0, 1, 1, 2, 2]))
        assert failures(verdict) == ({"distances", "shape"} if fails else set())
        assert (verdict.phases[lost].shape or 0) > 0.1


def test_every_phase_that_fails_is_named():
    """Of several lost shapes each has its own finding."""
    phases = [
        {"kind": k, "formation": "triangle", "duration": 5.0} for k in ("establish", "reshape")
    ]
    mission = a_mission(TRIANGLE, 3, phases)
    records = [PhaseRecord(n, "reshape", "open", "triangle", 0.0, 5.0) for n in ("a", "b")]
    p = slots(mission, "triangle") * 1.2 + HEIGHT
    verdict = assess(flown(mission, p, phases=records, phase=[0, 0, 1, 1, 1]))
    assert [f.phase for f in verdict.checks if f.check == "shape"] == ["a", "b"]


# -- waypoints


def a_waypoint(**miss: float) -> Verdict:
    """A flight of a triangle to (1, 2, 10) at 2 m/s and yaw 90 deg turning at 3 deg/s, which misses by so much."""
    phases = [
        {"kind": "establish", "formation": "triangle", "until": 4.0},
        {"kind": "fly", "position": [1.0, 2.0, 10.0], "until": 10.0},
    ]
    mission = a_mission(TRIANGLE, 3, phases)
    q = att.quaternion_from_euler([0, 0, math.pi / 2])
    target = {"time": 10.0, "position": [1.0, 2.0, 10.0], "velocity": [2.0, 0.0, 0.0]}
    target |= {"attitude": q.tolist(), "rates": [0.0, 0.0, math.radians(3)]}
    records = [
        PhaseRecord("form", "establish", "open", "triangle", 0.0, 4.0),
        PhaseRecord("WP1", "fly", "tracking", "triangle", 4.0, 10.0, None, target),
    ]
    times, phase = [0.0, 4.0, 4.1, 7.0, 10.0], [0, 0, 1, 1, 1]
    triangle = slots(mission, "triangle") + HEIGHT
    flight = flown(mission, triangle, time=times, phases=records, phase=phase)
    flight.cm[-1] = [1, 2 + miss.get("position", 0), 10]
    flight.cm_velocity[-1] = [2 - miss.get("velocity", 0), 0, 0]
    flight.attitude[-1] = att.quaternion_from_euler(
        [0, 0, math.pi / 2 + math.radians(miss.get("attitude", 0))]
    )
    flight.rates[-1] = [math.radians(miss.get("rates", 0)), 0, math.radians(3)]
    return assess(flight)


@pytest.mark.parametrize(
    ("what", "limit"), [("position", 0.1), ("velocity", 0.1), ("attitude", 1.0), ("rates", 1.0)]
)
def test_a_waypoint_is_met_or_missed(what, limit):
    """The miss in position, velocity, attitude [deg] and rates [deg/s] is measured at the waypoint's time."""
    for miss, fails in [(0.0, False), (0.9 * limit, False), (1.1 * limit, True)]:
        verdict = a_waypoint(**{what: miss})
        point = verdict.phases[1].waypoint
        assert point is not None
        assert point.time == 10
        misses = {w: getattr(point, w) for w in ("position", "velocity", "attitude", "rates")}
        assert misses == pytest.approx(dict.fromkeys(misses, 0.0) | {what: miss}, abs=1e-9)
        assert failures(verdict) == ({f"waypoint_{what}"} if fails else set())
        assert found(verdict, f"waypoint_{what}").phase == "WP1"


@pytest.mark.parametrize(
    ("misses", "listed"),
    [((0.02, 0.05), ["WP2"]), ((0.3, 0.05), ["WP1"]), ((0.3, 0.4), ["WP1", "WP2"])],
)
def test_all_waypoints_that_are_missed_are_listed_or_the_one_missed_most(misses, listed):
    """Of two, each with its miss; and the flight that reached its end is said to at its last sample."""
    goals = [[1.0, 2.0, 10.0], [3.0, 2.0, 10.0]]
    phases: list[dict[str, Any]] = [{"kind": "establish", "formation": "triangle", "until": 4.0}]
    phases += [
        {"kind": "fly", "position": x, "until": t} for x, t in zip(goals, (7.0, 10.0), strict=True)
    ]
    mission = a_mission(TRIANGLE, 3, phases)
    records = [PhaseRecord("form", "establish", "open", "triangle", 0.0, 4.0)]
    for k, (start, end) in enumerate([(4.0, 7.0), (7.0, 10.0)]):
        target = {"time": end, "position": goals[k]} | dict.fromkeys(
            ("velocity", "attitude", "rates")
        )
        records.append(
            PhaseRecord(f"WP{k + 1}", "fly", "tracking", "triangle", start, end, None, target)
        )
    times, phase = [0.0, 4.0, 4.1, 7.0, 7.1, 10.0], [0, 0, 1, 1, 2, 2]
    triangle = np.broadcast_to(slots(mission, "triangle") + HEIGHT, (6, 3, 3))
    flight = flown(mission, triangle, time=times, phases=records, phase=phase)
    for sample, goal, miss in zip((3, 5), goals, misses, strict=True):
        flight.cm[sample] = np.add(goal, [0.0, miss, 0.0])
    verdict = assess(flight)
    points = [c for c in verdict.checks if c.check == "waypoint_position"]
    assert [c.phase for c in points] == listed
    assert points[-1].worst == pytest.approx(max(misses))
    assert found(verdict, "complete").when == 10.0


def test_a_waypoint_asks_only_for_what_it_names():
    """A turn has no position, and a flight before a frame is attached no attitude: nothing is judged there."""
    flight = flown(a_mission(TRIANGLE, 3), slots(a_mission(TRIANGLE, 3), "triangle") + HEIGHT)
    target = {
        "time": 10.0,
        "position": None,
        "velocity": None,
        "attitude": [1.0, 0, 0, 0],
        "rates": None,
    }
    flight.phases[0] = replace(flight.phases[0], kind="turn", target=target)
    verdict = assess(flight)
    point = verdict.phases[0].waypoint
    assert point is not None
    assert (point.position, point.velocity, point.attitude, point.rates) == (None,) * 4
    assert not [f for f in verdict.checks if f.check.startswith("waypoint")]


# -- too close, too fast, too far


def two(
    gap: float, direction: tuple[float, float, float] = (1.0, 0.0, 0.0), **limits: Any
) -> Verdict:
    """Two agents of radius 0.25 m whose surfaces are so far apart at 5 s."""
    mission = a_mission({}, 2, [{"kind": "hold", "until": 10.0}], limits=limits)
    p = np.array([[[0.0, 0, 10], [10.0, 0, 10]]] * 5)
    p[2, 1] = p[2, 0] + (gap + 0.5) * np.array(direction)
    record = PhaseRecord("hold", "hold", "tracking", None, 0.0, 10.0)
    return assess(flown(mission, p, phases=[record]))


@pytest.mark.parametrize(("gap", "fails"), [(0.01, False), (0.0, True), (-0.1, True)])
def test_agents_that_touch_collide(gap, fails):
    """Without a limit, surfaces that touch or overlap fail, and the message says who, when and how deep."""
    verdict = two(gap)
    assert failures(verdict) == ({"separation"} if fails else set())
    finding = found(verdict, "separation")
    assert (finding.worst, finding.when, finding.who) == (pytest.approx(gap), 5.0, "agents 1 and 2")
    if gap < 0:
        assert (
            "first at 5.00 s; agents 1 and 2 overlap the most, by 0.1 m at 5.00 s"
            in finding.message
        )


@pytest.mark.parametrize(("gap", "fails"), [(0.51, False), (0.5, False), (0.49, True)])
def test_separation_has_a_limit(gap, fails):
    """A separation below the mission's limit fails; exactly the limit holds."""
    verdict = two(gap, separation=0.5)
    assert failures(verdict) == ({"separation"} if fails else set())


@pytest.mark.parametrize(
    ("nearer", "listed"),
    [((0.02, 0.05), ["b"]), ((0.05, 0.02), ["a"]), ((0.3, 0.05), ["a"]), ((0.3, 0.4), ["a", "b"])],
)
def test_phases_nearer_than_planned_are_listed_or_the_one_that_loses_most(nearer, listed):
    """Of two phases in which agents come nearer than planned, each by so much; 0.1 m are allowed."""
    phases = [{"kind": "establish", "formation": "line", "duration": 5.0, "name": "a"}]
    phases.append({"kind": "hold", "duration": 5.0, "name": "b"})
    mission = a_mission(LINE, 2, phases, agents={"radius": 0.5})
    proved = [{"separation": 4.0 - 2 * 0.5 + less} for less in nearer]
    records = [
        PhaseRecord("a", "establish", "tracking", "line", 0.0, 5.0, planned=proved[0]),
        PhaseRecord("b", "hold", "tracking", "line", 5.0, 10.0, planned=proved[1]),
    ]
    position = slots(mission, "line") + HEIGHT
    flight = flown(mission, position, phases=records, phase=[0, 0, 1, 1, 1])
    checks = [c for c in assess(flight).checks if c.check == "separation_as_planned"]
    assert [c.phase for c in checks] == listed
    assert checks[-1].worst == pytest.approx(max(nearer))
    assert [c.passed for c in checks] == [max(nearer) < 0.1] * len(checks)


@pytest.mark.parametrize(
    ("gap", "direction", "fails"),
    [
        (1.49, (0.0, 0.0, -1.0), True),
        (1.51, (0.0, 0.0, 1.0), False),
        (1.51, (0.0, 0.0, -1.0), False),
        (1.49, (1.0, 0.0, 0.0), False),
        (1.3, (0.2, 0.0, math.sqrt(0.96)), True),
        (1.3, (0.6, 0.0, 0.8), False),
    ],
)
def test_more_room_below_than_beside(gap, direction, fails):
    """The vertical separation counts where spheres overlap seen from above, whoever is on top; not beside."""
    verdict = two(gap, direction, separation_below=1.5)
    assert failures(verdict) == ({"separation_below"} if fails else set())


def test_nobody_below_another_is_fine():
    """Agents side by side have nothing to fail by separation_below."""
    finding = found(two(1.0, separation_below=1.5), "separation_below")
    assert (finding.passed, finding.worst, finding.message) == (
        True,
        None,
        "no agent flies below another",
    )


@pytest.mark.parametrize(("height", "fails"), [(0.26, False), (0.24, True)])
def test_obstacles_are_not_to_be_touched(height, fails):
    """An agent whose surface meets an obstacle fails, with the obstacle's name."""
    obstacles = [
        {"kind": "box", "name": "wall", "min": [90, 0, 0], "max": [91, 1, 1]},
        {"kind": "ground"},
    ]
    mission = a_mission(TRIANGLE, 3, obstacles=obstacles)
    s = slots(mission, "triangle")
    verdict = assess(flown(mission, [s + HEIGHT, s + [0, 0, height], s + HEIGHT]))
    assert failures(verdict) == ({"clearance"} if fails else set())
    finding = found(verdict, "clearance")
    assert (finding.when, finding.who) == (5.0, "agent 1, ground")
    assert finding.worst == pytest.approx(height - 0.25)
    if fails:
        assert "first at 5.00 s; agent 1 is deepest in 'ground', by 0.01 m" in finding.message


@pytest.mark.parametrize(
    ("check", "array", "unit"),
    [("speed", "velocity", "m/s"), ("acceleration", "acceleration", "m/s^2")],
)
@pytest.mark.parametrize(("limit", "fails"), [(None, False), (3.0, False), (2.9, True)])
def test_speed_and_acceleration_have_limits(check, array, unit, limit, fails):
    """The greatest value is reported with when and who, and fails beyond a limit."""
    mission = a_mission(TRIANGLE, 3, limits={} if limit is None else {check: limit})
    p = slots(mission, "triangle") + HEIGHT
    verdict = assess(flown(mission, p, **{array: pulse((5, 3, 3), (3, 1, 2), -3.0)}))
    assert failures(verdict) == ({check} if fails else set())
    finding = found(verdict, check)
    assert (finding.worst, finding.limit, finding.unit) == (3.0, limit, unit)
    assert (finding.when, finding.who, finding.judged) == (7.5, "agent 2", limit is not None)


def test_thrust_is_held_against_each_agents_own_limit():
    """The agent that passes its own limit is found, not the one with the greatest thrust."""
    mission = a_mission(TRIANGLE, 3, agents={"thrust_limit": [30.0, 20.0, 30.0]})
    p = slots(mission, "triangle") + HEIGHT
    thrust = np.tile([29.0, 19.0, 10.0], (5, 1))
    verdict = assess(flown(mission, p, thrust=thrust))
    assert verdict.passed
    thrust[2, 1] = 20.5
    finding = found(assess(flown(mission, p, thrust=thrust)), "thrust")
    assert (finding.passed, finding.worst, finding.limit, finding.who) == (
        False,
        20.5,
        20.0,
        "agent 2",
    )
    unlimited = a_mission(TRIANGLE, 3)
    finding = found(assess(flown(unlimited, p, thrust=thrust)), "thrust")
    assert (finding.passed, finding.worst, finding.limit, finding.judged) == (
        True,
        29.0,
        None,
        False,
    )


def test_saturated_thrust_is_noted():
    """Thrust cut off at its limit is within it, but worth a note."""
    mission = a_mission(TRIANGLE, 3, agents={"thrust_limit": 20.0, "saturate": True})
    thrust = np.full((5, 3), 10.0) + pulse((5, 3), (1, 0), 10.0) + pulse((5, 3), (2, 2), 10 + 1e-12)
    verdict = assess(flown(mission, slots(mission, "triangle") + HEIGHT, thrust=thrust))
    assert verdict.passed
    assert other_notes(verdict) == [
        "the thrust of agents 1 and 3 saturates at its limit, first at 2.50 s"
    ]


@pytest.mark.parametrize("agent", [0, 1, 2])
def test_the_rotor_nearest_to_its_limit_names_its_vehicle(agent):
    """Agents count from 1; the other rotors give half of their limit."""
    flight = quadrotors(3, 4.0)
    assert flight.rotor_force is not None
    flight.rotor_force[:] = 2.5
    flight.rotor_force[4, agent, LABELS["rotor"].index("rear left")] = 4.5
    check = found(assess(flight), "rotor_force")
    assert (check.who, check.worst) == (f"agent {agent + 1}", 4.5)
    assert f"the rear left rotor of agent {agent + 1} gives up to 4.5 N" in check.message


@pytest.mark.parametrize(("share", "passed"), [(1.0, True), (1 + 5e-10, True), (1 + 2e-9, False)])
def test_a_rotor_at_its_limit_keeps_it(share, passed):
    """But for rounding, of a billionth."""
    flight = quadrotors(3, 4.0)
    assert flight.rotor_force is not None
    flight.rotor_force[:] = 2.5
    limit = found(assess(flight), "rotor_force").limit
    flight.rotor_force[4, 1, 0] = share * limit
    assert found(assess(flight), "rotor_force").passed is passed


@pytest.mark.parametrize(
    ("down", "words"), [(1, "1 vehicle"), (2, "2 vehicles"), (3, "3 vehicles")]
)
def test_a_landing_counts_who_may_switch_off(down, words):
    """Of three vehicles, those that stand on the ground at its end; the others are 5 m above."""
    position = [[3.0 * i, 0.0, 0.25 if i < down else 5.25] for i in range(3)]
    agents = {"radius": 0.25, "position": position}
    ground = [{"kind": "ground", "height": 0.0}]
    mission = a_mission(
        {}, 3, [{"kind": "land", "duration": 10.0}], agents=agents, obstacles=ground
    )
    check = found(assess(flown(mission, position)), "touch_down")
    assert check.passed
    assert check.message.endswith(f"; {words} may switch off")


@pytest.mark.parametrize(("top", "fails"), [(10.0, False), (9.9, True)])
def test_the_geofence_holds_centres(top, fails):
    """An agent's centre may be on the fence, not beyond."""
    fence = {"min": [-20.0, -20.0, 0.0], "max": [20.0, 20.0, top]}
    mission = a_mission(TRIANGLE, 3, limits={"geofence": fence})
    verdict = assess(flown(mission, slots(mission, "triangle") + HEIGHT))
    assert failures(verdict) == ({"geofence"} if fails else set())
    if fails:
        assert "leaves the geofence by 0.1 m" in found(verdict, "geofence").message


def test_below_ground_level_is_noted_where_there_is_no_ground():
    """Agents below z = 0 are a note where the mission has no ground, a collision where it has."""
    fence = {"min": [-20.0, -20.0, -5.0], "max": [20.0, 20.0, 20.0]}
    s = slots(a_mission(TRIANGLE, 3), "triangle")
    low = s + [[0, 0, 1], [0, 0, -0.6], [0, 0, 1]]
    path = [s + HEIGHT, low, s + HEIGHT]
    verdict = assess(flown(a_mission(TRIANGLE, 3), path))
    assert verdict.passed
    assert other_notes(verdict) == [
        "agent 2 dips to z = -0.60 m at 5.00 s; the mission has no ground there"
    ]
    assert (
        "agents 1, 2 and 3 are below"
        in assess(flown(a_mission(TRIANGLE, 3), [low - HEIGHT, s + HEIGHT])).notes[0]
    )
    assert other_notes(assess(flown(a_mission(TRIANGLE, 3), [s + HEIGHT, s, s + HEIGHT]))) == []
    assert (
        other_notes(assess(flown(a_mission(TRIANGLE, 3, limits={"geofence": fence}), path))) == []
    )
    ground = assess(flown(a_mission(TRIANGLE, 3, obstacles=[{"kind": "ground"}]), path))
    assert other_notes(ground) == []
    assert failures(ground) == {"clearance"}


FAR = {"min": [60, -90, -12], "max": [90, 90, -9]}
TERRAIN = {"kind": "heights", "spacing": 90.0, "heights": [[-9.0, -9.0], [-9.0, -9.0]]}


@pytest.mark.parametrize(
    ("below", "noted"),
    [
        ({"kind": "ground", "height": -9.0}, []),
        ({"kind": "box", "min": [-90, -90, -12], "max": [90, 90, -9]}, []),
        ({"kind": "box", "min": [-90, -90, -12], "max": [90, 90, -9], "yaw_deg": 9.0}, []),
        (TERRAIN | {"corner": [-45, -45]}, []),
        (TERRAIN | {"corner": [60, -45]}, [1, 2]),
        ({"kind": "box"} | FAR, [1, 2]),
        ({"kind": "box", "zone": True, "min": [-90, -90, -12], "max": [90, 90, -9]}, [1, 2]),
        ({"kind": "sphere", "centre": [0, 0, -20], "radius": 9.0}, [1, 2]),
        # Agent 1 is over it, and dips lower.
        ({"kind": "box", "min": [-8, -90, -12], "max": [0, 90, -9]}, [2]),
    ],
    ids=["ground", "roof", "turned", "terrain", "ends before", "beside", "zone", "sphere", "one"],
)
def test_ground_is_whatever_is_below(below, noted):
    """Agents below z = 0 are noted where neither ground, terrain nor roof is below them, and no others."""
    mission = a_mission(TRIANGLE, 3, obstacles=[below])
    high = np.array([[-4.0, 0, 9], [4.0, 0, 9], [9.0, 0, 9]])
    low = high - [[0, 0, 11], [0, 0, 9.6], [0, 0, 0]]
    notes = other_notes(assess(flown(mission, [high, low, high])))
    lowest = {1: "agent 1 dips to z = -2.00 m", 2: "agent 2 dips to z = -0.60 m"}
    others = " (agents 1 and 2 are below 0 at times)" if len(noted) > 1 else ""
    words = [f"{lowest[i]} at 5.00 s{others}; the mission has no ground there" for i in noted[:1]]
    assert [note for note in notes if "ground" in note] == words


@pytest.mark.parametrize("height", [0.26, 0.24])
def test_an_obstacle_may_have_a_comma_in_its_name(height):
    """It is told whole, hit or not."""
    named = {"kind": "box", "name": "roof, north, old", "min": [-50, -50, -9], "max": [50, 50, 0]}
    mission = a_mission(TRIANGLE, 3, obstacles=[named])
    s = slots(mission, "triangle")
    finding = found(
        assess(flown(mission, [s + HEIGHT, s + [0, 0, height], s + HEIGHT])), "clearance"
    )
    assert finding.who == "agent 1, roof, north, old"
    words = (
        "deepest in 'roof, north, old'"
        if height < 0.25
        else "agent 1 comes within 0.01 m of 'roof, north, old'"
    )
    assert words in finding.message


def test_who_starts_on_an_obstacle_with_a_comma_in_its_name_stands_on_it():
    """The name is told whole there, too."""
    roof = {"kind": "box", "name": "roof, north", "min": [-9, -9, -9], "max": [9, 9, 0]}
    one = {"mass": 1.0, "radius": 0.25, "position": [[0.0, 0.0, 0.25]]}
    up = [{"kind": "fly", "position": [0, 0, 3], "duration": 4.0}]
    finding = found(
        assess(simulate(a_mission({}, 1, up, agents=one, obstacles=[roof]))), "clearance_start"
    )
    assert finding.who == "agent 1, roof, north"
    assert "agent 1 stands in contact with 'roof, north'" in finding.message


def test_a_record_says_how_many_contradictions_it_has():
    """The first one is told, and how many others there are."""
    mission = a_mission(TRIANGLE, 3)
    one = flown(mission, slots(mission, "triangle") + HEIGHT)
    one.separation[:] += 1.0
    message = found(assess(one), "record").message
    assert "more like that" not in message
    one.distance[:] += 1.0
    assert "and 1 more like that" in found(assess(one), "record").message


def test_losses_are_told_by_whom_and_when():
    """Agents count from 1; phases that a loss ended, and those never begun, are listed."""
    agents = {"mass": 1.0, "position": [[0, 0, 9], [5, 0, 9], [0, 5, 9]]}
    phases = [{"kind": "hold", "control": "open", "name": x, "duration": 1.0} for x in "abc"]
    lost = {"lost": [{"agent": 3, "time": 0.25}, {"agent": 1, "time": 0.5}]}
    mission = a_mission({}, 3, phases, agents=agents, disturbances=lost)
    finding = found(assess(simulate(mission)), "lost")
    assert "lost: agent 1 at 0.50 s, agent 3 at 0.25 s" in finding.message


# -- the flight as a whole


@pytest.mark.parametrize("ending", ["the flight cannot go on at t = 9 s", ""])
def test_an_incomplete_flight_fails(ending):
    """What did not fly to its end fails, with the diagnosis; its last phase is not judged further."""
    mission = a_mission(TRIANGLE, 3)
    p = slots(mission, "triangle") * 2 + HEIGHT
    verdict = assess(flown(mission, p, complete=False, ending=ending))
    assert failures(verdict) == {"complete"}
    assert (ending or "it was stopped") in verdict.summary
    assert not verdict.phases[0].finished
    assert verdict.phases[0].shape == pytest.approx(4)


@pytest.mark.parametrize("settled", [True, False])
def test_a_phase_that_does_not_settle_fails(settled):
    """A phase that was to settle either did, or fails the flight."""
    mission = a_mission(TRIANGLE, 3)
    flight = flown(mission, slots(mission, "triangle") + HEIGHT)
    flight.phases[0] = replace(flight.phases[0], settled=settled)
    verdict = assess(flight)
    assert failures(verdict) == (set() if settled else {"settled"})
    how = "settled after" if settled else "did not settle within"
    assert found(verdict, "settled").message == f"phase 'form' {how} 10.00 s"


def test_positions_that_are_not_finite_fail():
    """A flight into infinity fails and does not upset the rest of the verdict."""
    mission = a_mission(TRIANGLE, 3)
    p = np.array([slots(mission, "triangle") + HEIGHT] * 5)
    p[3:] = np.nan
    verdict = assess(flown(mission, p))
    assert failures(verdict) == {"complete"}
    assert "agents 1, 2 and 3 is not finite, first at 7.50 s" in verdict.summary
    json.loads(verdict.json())


def test_an_agent_that_is_nowhere_hides_no_other():
    """With one agent's position lost, the collision of two others is found all the same."""
    mission = a_mission(TRIANGLE, 3, agents={"radius": 0.25}, limits={"separation_below": 0.1})
    p = np.array([slots(mission, "triangle") + HEIGHT] * 5)
    p[2, 1] = p[2, 2] + [0.0, 0.0, 0.3]
    p[1:, 0] = np.nan
    verdict = assess(flown(mission, p))
    assert failures(verdict) == {"complete", "separation", "separation_below"}
    assert found(verdict, "complete").who == "agent 1"
    assert found(verdict, "separation").who == "agents 2 and 3"
    assert found(verdict, "separation_below").when == 5.0


def test_a_moment_without_a_sample_is_not_passed():
    """A shape or a waypoint that no sample shows fails the verdict, with the moment to record."""
    mission = a_mission(TRIANGLE, 3)
    flight = flown(mission, slots(mission, "triangle") + HEIGHT)
    assert assess(flight).passed
    flight.time = flight.time * 0.9
    verdict = assess(flight)
    assert failures(verdict) == {"samples"}
    assert (
        "the end of phase 'form' (10.00 s) is not judged: the nearest sample is 1 s"
        in verdict.summary
    )


@pytest.mark.parametrize("moment", ["waypoint", "point 1 on the way"])
def test_a_moment_before_the_end_needs_a_sample_of_its_own(moment):
    """A sample of the end of the phase shows neither its waypoint nor a point on the way at 6 s."""
    phases = [
        {"kind": "establish", "formation": "triangle", "until": 4.0},
        {"kind": "fly", "position": [1.0, 2.0, 10.0], "until": 10.0},
    ]
    mission = a_mission(TRIANGLE, 3, phases)
    point = {"time": 6.0, "position": [0.0, 0.0, 10.0]} | dict.fromkeys(
        ("velocity", "attitude", "rates")
    )
    target = point if moment == "waypoint" else point | {"time": 10.0, "through": [point]}
    records = [
        PhaseRecord("form", "establish", "open", "triangle", 0.0, 4.0),
        PhaseRecord("WP1", "fly", "tracking", "triangle", 4.0, 10.0, None, target),
    ]
    triangle = slots(mission, "triangle") + HEIGHT
    for near, missing in [(6.0, False), (6.005, False), (6.2, True)]:
        times = [0.0, 4.0, 4.1, near, 10.0]
        verdict = assess(
            flown(mission, triangle, time=times, phases=records, phase=[0, 0, 1, 1, 1])
        )
        assert failures(verdict) == ({"samples"} if missing else set())
    words = f"the {moment} of phase 'WP1' (6.00 s) is not judged: the nearest sample is 0.2 s"
    assert found(verdict, "samples").message.startswith(words)


@pytest.mark.parametrize("left_by", ["a loss", "the end of the flight"])
def test_a_moment_of_a_phase_that_was_left_needs_no_sample(left_by):
    """Nobody asks for a sample of the end of a phase that was abandoned, or that the flight did not reach."""
    mission = a_mission(TRIANGLE, 3)
    flight = flown(mission, slots(mission, "triangle") + HEIGHT)
    flight.time = flight.time * 0.9
    assert "samples" in failures(assess(flight))
    if left_by == "a loss":
        flight.phases[0].abandoned = True
    else:
        flight.complete = False
    assert "samples" not in failures(assess(flight))


def test_a_phase_never_sampled_has_no_numbers():
    """A phase recorded in the moment the flight stopped is there, without numbers."""
    mission = a_mission(TRIANGLE, 3)
    flight = flown(mission, slots(mission, "triangle") + HEIGHT, complete=False)
    flight.phases.append(PhaseRecord("next", "hold", "tracking", "triangle", 10.0, 10.0))
    last = assess(flight).phases[1]
    assert (last.finished, last.worst, last.shape, last.constraint) == (False, {}, None, None)


def test_one_agent_alone():
    """One agent has no edges, no separation and no shape, and passes."""
    mission = a_mission({}, 1, [{"kind": "hold", "until": 10.0}])
    record = PhaseRecord("hold", "hold", "tracking", None, 0.0, 10.0)
    flight = flown(mission, [[0.0, 0, 10]], phases=[record], singular_value=np.full(5, np.nan))
    verdict = assess(flight)
    assert verdict.passed
    assert {"separation", "shape", "distances", "singular_value"}.isdisjoint(
        f.check for f in verdict.checks
    )


def test_worst_values_know_when_and_who():
    """Each extreme is found in its phase and over the flight, with time and name; tension keeps its sign."""
    phases = [
        {"kind": "establish", "formation": "triangle", "until": 5.0},
        {"kind": "hold", "until": 10.0},
    ]
    mission = a_mission(TRIANGLE, 3, phases)
    records = [
        PhaseRecord("form", "establish", "open", "triangle", 0.0, 5.0),
        PhaseRecord("hold", "hold", "tracking", "triangle", 5.0, 10.0),
    ]
    verdict = assess(
        flown(
            mission, slots(mission, "triangle") + HEIGHT, phases=records, phase=[0, 0, 0, 1, 1],
            constraint=pulse((5, 3), (1, 2), -0.3) + pulse((5, 3), (4, 0), 0.1),
            constraint_force=pulse((5, 3, 3), (3, 2, 0), -7.0),
            multiplier=pulse((5, 3), (3, 1), 5.0) + pulse((5, 3), (0, 1), -4.0),
            singular_value=[1.0, 0.5, 1.0, 0.2, 1.0],
        )
    )  # fmt: skip
    first, last = verdict.phases
    told = {name: (e.value, e.when, e.who, e.phase) for name, e in verdict.worst.items()}
    assert told["constraint"] == (0.3, 2.5, "edge 2-3", "form")
    assert told["constraint_force"] == (7.0, 7.5, "agent 3", "hold")
    assert told["tension"] == (-5.0, 7.5, "edge 1-3", "hold")
    assert told["singular_value"] == (0.2, 7.5, "", "hold")
    assert (last.constraint, last.worst["constraint"].value) == (0.1, 0.1)
    assert (first.worst["tension"].value, first.worst["singular_value"].value) == (4.0, 0.5)
    assert found(verdict, "tension").worst == -5.0


def test_json_holds_everything_and_is_strict():
    """The JSON parses strictly, without NaN or Infinity, and has the verdict, checks, phases and tolerances."""
    mission = a_mission(CUBE, 8)
    flight = flown(
        mission, slots(mission, "cube") * 1.5 + HEIGHT, constraint=np.full((5, 28), np.nan)
    )

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    data = json.loads(assess(flight).json(), parse_constant=refuse)
    assert data["passed"] is False
    assert data["mission"] == "test"
    assert {f["check"] for f in data["checks"] if not f["passed"]} == {"distances", "shape"}
    assert data["phases"][0]["constraint"] is None
    assert data["phases"][0]["worst"]["separation"]["who"].startswith("agents ")
    assert data["tolerances"]["shape"] == SHAPE_TOLERANCE


def printed(make: Callable[[], Verdict], **options: Any) -> str:
    out = io.StringIO()
    Console(file=out, **options).print(make())
    return out.getvalue()


def test_a_verdict_prints_within_80_columns():
    """Printed to a pipe there are no colours, no line beyond 80 columns, and the words say it all."""
    text = printed(lambda: a_waypoint(position=0.2), width=80)
    assert "\x1b" not in text
    assert max(map(len, text.splitlines())) <= 80
    words = " ".join(text.split())
    assert "waypoint position 0.2 m <= 0.1 m 10.00 WP1 FAILED" in words
    assert (
        "Failed: 1 of 8 checks. - the waypoint of phase 'WP1' is missed, 0.2 m off in position"
        in words
    )
    passed = " ".join(printed(a_waypoint, width=80).split())
    assert "Passed: all 8 checks hold; shapes are within" in passed
    assert "[m/s]" in passed  # a unit, not markup
    assert "\x1b[" in printed(a_waypoint, width=80, force_terminal=True)


def test_names_in_a_mission_are_not_markup():
    """A phase or obstacle may be called [red] or [/]: it is printed as it is."""
    mission = a_mission(TRIANGLE, 3, [{"name": "[/] [red]", "kind": "hold", "until": 10.0}])
    flight = flown(
        mission, slots(mission, "triangle") + HEIGHT,
        phases=[PhaseRecord("[/] [red]", "hold", "tracking", None, 0.0, 10.0)],
    )  # fmt: skip
    assert "[/] [red]" in printed(lambda: assess(flight), width=120)


def test_judging_is_light():
    """Neither rich nor the compiler nor any plotting is imported to judge a flight."""
    code = (
        "import sys, rigidfleet.assessment; "
        "heavy = {'rich', 'numba', 'scipy', 'pydantic', 'h5netcdf', 'matplotlib'} & set(sys.modules); "
        "sys.exit(str(heavy) if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def _fit(p: Floats, slots: Floats) -> Fit:
    """The fit of slots to agents (N, 3) at one sample."""
    return next(fits_by_sample(p[None], shape_of_slots(slots), np.arange(len(p)), float))


@pytest.mark.parametrize("flown", ["near", "mirrored", "larger", "exchanged", "scattered"])
def test_worst_pair_is_that_of_all_pairs(flown):
    """However the agents lie, though few pairs are looked at; turned and elsewhere, as flights are."""
    rng = np.random.default_rng(5)
    slots = shapes.slots("sphere", 2.0, 250)
    p = {
        "near": slots + 0.01 * rng.normal(size=slots.shape),
        "mirrored": slots * [1.0, 1.0, -1.0] + 1e-5 * rng.normal(size=slots.shape),
        "larger": 1.01 * slots,
        "exchanged": slots[rng.permutation(250)],
        "scattered": rng.normal(size=slots.shape),
    }[flown]
    fit = _fit(p @ att.dcm_from_euler([0.3, -0.2, 1.0]) + [5.0, -3.0, 20.0], slots)
    pairs = graphs.complete_graph(250)
    error = np.abs(
        distance_geometry.distances(p, pairs) - distance_geometry.distances(slots, pairs)
    )
    i, j = fit.pair
    assert fit.error == pytest.approx(error.max(), abs=1e-10)
    assert fit.flown == pytest.approx(np.linalg.norm(p[i] - p[j]))
    assert fit.intended == pytest.approx(np.linalg.norm(slots[i] - slots[j]))
    assert fit.limit == pytest.approx(2.0)
    assert fit.is_mirrored == (flown == "mirrored") or flown in ("exchanged", "scattered")


@pytest.mark.parametrize("agents", [2, 3, 5, 16, 17])
def test_worst_pair_of_few_agents(agents):
    """Few agents are compared at once; 17 are too many for that, and give the same."""
    rng = np.random.default_rng(agents)
    slots = rng.normal(size=(agents, 3))
    p = slots + 0.1 * rng.normal(size=slots.shape)
    fit = _fit(p, slots)
    flown, intended = (np.linalg.norm(x[:, None] - x, axis=2) for x in (p, slots))
    i, j = fit.pair
    assert i < j
    assert fit.error == pytest.approx(np.abs(flown - intended).max(), rel=1e-12)
    assert fit.flown == pytest.approx(flown[i, j])
    assert fit.intended == pytest.approx(intended[i, j])
    assert fit.error == pytest.approx(abs(fit.flown - fit.intended), rel=1e-9)


def test_of_pairs_equally_wrong_the_first_is_named():
    """A triangle that is too large is so along all edges, which differ by rounding alone."""
    slots = shapes.slots("triangle", 4.0, 3)
    for turn in range(20):
        p = 1.1 * slots @ att.dcm_from_euler([0.1 * turn, 0.2, 0.3 * turn]) + [9.0, 7.0, 5.0]
        assert _fit(p, slots).pair == (0, 1)


@pytest.mark.parametrize("shape", ["triangle", "square", "line"])
@pytest.mark.parametrize("error", [0.0, 0.05])
def test_an_axis_points_where_the_best_rotation_turns_it(shape, error):
    """A plane's normal and a line's direction, against the decomposition that fits slots to agents."""
    rng = np.random.default_rng(3)
    slots = shapes.slots(shape, 4.0, 4 if shape == "square" else 3)
    for _ in range(20):
        T = att.dcm_from_euler(rng.uniform(-3.0, 3.0, 3))
        p = slots @ T + rng.normal(scale=5.0, size=3) + error * rng.normal(size=slots.shape)
        fit = _fit(p, slots)
        wanted = rigid_body.kabsch(p, slots) @ fit.axis
        found = np.array(fit.turned_axis) / np.linalg.norm(fit.turned_axis)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)


def test_a_plane_whose_agents_are_on_a_line_points_where_the_nearest_rotation_turns_it():
    """Agents on a line show no normal: of all rotations that fit, the nearest to none is taken."""
    slots = shapes.slots("triangle", 4.0, 3)
    p = slots * [1.0, 0.0, 0.0]
    np.testing.assert_allclose(
        _fit(p, slots).turned_axis,
        rigid_body.kabsch(p, slots) @ _fit(p, slots).axis,
        rtol=0,
        atol=1e-12,
    )
    assert np.isfinite(_fit(np.zeros((3, 3)), slots).turned_axis).all()
