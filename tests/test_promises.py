"""What phases promise of their ends, and what a verdict holds against it: staying, tolerances, free velocities."""

from dataclasses import replace

import numpy as np
import pytest

import rigidfleet as rf
from rigidfleet.cli.app import main
from rigidfleet.errors import MissionError
from rigidfleet.interchange import FORMATS
from rigidfleet.mission import KINDS, Mission
from rigidfleet.planning.preview import preview_phases
from rigidfleet.preflight.check import check
from rigidfleet.sweep import Sweep
from rigidfleet.sweep.run import fly_runs

SLOTS = [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 3.0]]
WIDE = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0]]
START = (np.array(SLOTS) + [0.0, 0.0, 10.0]).tolist()
ESTABLISH = {"kind": "establish", "formation": "a", "duration": 4.0}


def mission(*phases, start=START, **tables):
    """Points in space that hold a formation, or none."""
    forms = {"a": {"slots": SLOTS}, "b": {"slots": WIDE}}
    used = {
        name: form
        for name, form in forms.items()
        if any(p.get("formation") == name for p in phases)
    }
    data = {
        "schema_version": 1, "name": "promises", "agents": {"mass": 1.0, "position": start},
        "obstacles": [{"kind": "ground"}], "phases": list(phases),
    }  # fmt: skip
    return Mission.from_dict(data | ({"formations": used} if used else {}) | tables)


def tracking(o):
    """A law that follows the slots well: feedforward and a stiff spring with its damper."""
    weight = o.masses[:, None] * [0.0, 0.0, o.gravity]
    off, rate = o.reference_position - o.position, o.reference_velocity - o.velocity
    return weight + o.masses[:, None] * (o.reference_acceleration + 4.0 * off + 4.0 * rate)


def pushed(phase, push, after=0.0):
    """The same law, but for a push (N, 3) [N] in one phase, from some mission time [s] on."""

    def law(o):
        return tracking(o) + (push if o.phase == phase and o.t >= after else 0.0)

    return law


def failed(result):
    """Names of the checks that fail, each with its phase."""
    return {(c.check, c.phase) for c in rf.assess(result).checks if not c.passed}


def off(result, k=-1):
    """How far a phase is off the place and state that it promises for its end."""
    stay = rf.assess(result).phases[k].stay
    assert stay is not None
    return stay


def test_vehicles_that_fall_in_a_hold_fail():
    """Two points without thrust fall g t^2 / 2 in 20 s, and are that far off the place where they were to stay."""
    hold = mission(
        {"kind": "hold", "name": "h", "duration": 20.0}, start=[[0, 0, 3e3], [3, 0, 3e3]]
    )
    result = rf.simulate(hold, controller=lambda o: 0.0 * o.position, rate=5.0)
    verdict = rf.assess(result)
    (place,) = [c for c in verdict.checks if c.check == "waypoint_position"]
    assert not place.passed
    assert place.worst == pytest.approx(0.5 * hold.gravity * 20.0**2, rel=1e-9)
    assert off(result).velocity == pytest.approx(hold.gravity * 20.0, rel=1e-9)
    assert rf.assess(rf.simulate(hold)).passed


#: A piece of 6 s at rest at the centre of mass.
REST = [6.0, 0.75, 0.0, 0.75, 0.0, 10.75, 0.0, 0.0, 0.0]
#: A phase of each kind that stays or goes on after its arrival, those before it, and the time of the push [s].
FLOWN = {
    "hold": ([ESTABLISH, {"kind": "hold", "duration": 4.0}], 5.0),
    "establish": ([ESTABLISH], 0.5),
    "reshape": ([ESTABLISH, {"kind": "reshape", "formation": "b", "duration": 6.0}], 6.0),
    "turn": ([ESTABLISH, {"kind": "turn", "yaw_deg": 20.0, "duration": 6.0}], 6.0),
    "brake": ([ESTABLISH, {"kind": "brake", "duration": 4.0}], 5.0),
    "fly": ([{"kind": "fly", "position": [4, 0, 9], "travel": 6.0, "duration": 10.0}], 7.0),
    "passing": (
        [{"kind": "fly", "position": [4, 0, 9], "velocity": [1, 0, 0], "travel": 6.0, "duration": 10.0}],
        7.0,
    ),
    "follow": (
        [{"kind": "follow", "trajectories": [[REST]], "travel": 5.0, "duration": 9.0}],
        6.0,
    ),
    "takeoff": ([{"kind": "takeoff", "height": 12.0, "travel": 5.0, "duration": 9.0}], 6.0),
}  # fmt: skip


@pytest.mark.parametrize("kind", FLOWN)
def test_what_drifts_after_its_arrival_fails(kind):
    """Flown well a phase passes; pushed by .5 N from the moment at which it should stay, it is off its place."""
    phases, when = FLOWN[kind]
    level = [[0, 0, 10], [3, 0, 10], [0, 3, 10], [3, 3, 10]]
    plan = mission(*phases, start=level if kind == "takeoff" else START)
    last = plan.phases[-1].name
    assert rf.assess(rf.simulate(plan)).passed
    flown = rf.simulate(plan, controller=tracking)
    assert rf.assess(flown).passed, rf.assess(flown).summary
    push = np.full((4, 3), [2.0, 0.0, 0.0])
    drifted = rf.simulate(plan, controller=pushed(last, push, when))
    assert ("waypoint_position", last) in failed(drifted)
    assert off(drifted).position == pytest.approx(0.5, abs=0.02)  # 2 N / (4 N/m)


def test_what_moves_on_is_judged_where_it_has_moved():
    """A waypoint passed at (1, 0, 0) m/s is 4 m further at the end of the phase, 4 s after the arrival."""
    result = rf.simulate(mission(*FLOWN["passing"][0]))
    end = {"time": 10.0, "position": [8.0, 0.0, 9.0], "velocity": [1.0, 0.0, 0.0]}
    assert result.phases[0].stay == end
    assert off(result).position == pytest.approx(0.0, abs=1e-3)


def test_vehicles_that_part_fail_though_their_centre_stays():
    """Without a formation each vehicle has its own place: two that drift apart fail, with the centre at rest."""
    hold = mission({"kind": "hold", "name": "h", "duration": 10.0}, start=[[0, 0, 9], [3, 0, 9]])
    apart = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    result = rf.simulate(hold, controller=pushed("h", apart))
    assert np.abs(result.cm - result.cm[0]).max() < 1e-9
    assert failed(result) == {("waypoint_position", "h")}
    assert off(result).position == pytest.approx(0.25, abs=1e-3)


@pytest.mark.parametrize("kind", ["hold", "brake", "reshape"])
def test_an_attitude_commanded_before_is_kept(kind):
    """A formation that turns by 10 degrees about the vertical through its centre fails, in any phase that stays."""
    keys = {"formation": "a"} if kind == "reshape" else {}
    plan = mission(
        ESTABLISH,
        {"kind": kind, "name": "x", "duration": 8.0, **keys},
        constraint={"stabilisation": "none"},
    )
    angle = np.deg2rad(10.0)
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )

    def turned(o):
        if o.phase != "x":
            return tracking(o)
        centre = o.reference_position.mean(axis=0)
        wanted = centre + (o.reference_position - centre) @ turn.T
        return tracking(replace(o, reference_position=wanted))

    result = rf.simulate(plan, controller=turned)
    assert ("waypoint_attitude", "x") in failed(result)
    assert off(result).attitude == pytest.approx(10.0, abs=0.1)
    assert rf.assess(rf.simulate(plan)).passed


@pytest.mark.parametrize("horizon", ["finite", "infinite"])
def test_a_hold_returns_to_a_waypoint_passed_at_speed(horizon):
    """It is at the waypoint at its end, however far it swings out; one too short is not, and `check` says so."""
    fly = {"kind": "fly", "position": [8, 0, 12], "velocity": [2, 0, 0], "duration": 8.0}
    lqr = {"horizon": horizon, "Q": [1.0, 1.0]} if horizon == "infinite" else {}
    for length, right in ((12.0, True), (0.1, False)):
        hold = {"kind": "hold", "name": "h", "duration": length}
        plan = mission(ESTABLISH, fly, hold, lqr=lqr)
        missed = {
            phase for check, phase in failed(rf.simulate(plan)) if check.startswith("waypoint")
        }
        assert ("h" in missed) != right
        told = [r.text for r in check(plan).remarks if r.level == "fails" and "'h'" in r.text]
        assert bool(told) != right


def test_an_open_phase_promises_no_place():
    """Weight balance alone leads nobody anywhere: points that drift at .2 m/s pass, as they are asked to."""
    agents = {"mass": 1.0, "position": START, "velocity": [[0.2, 0.0, 0.0]] * 4}
    plan = mission({"kind": "hold", "control": "open", "duration": 5.0}, agents=agents)
    result = rf.simulate(plan)
    assert result.cm[-1, 0] - result.cm[0, 0] == pytest.approx(1.0)
    assert result.phases[0].stay is None
    assert rf.assess(result).passed


def test_a_phase_left_early_promises_nothing():
    """A hold that another phase ends before its time is not judged; one that is flown to its end is."""
    flight = rf.Flight(mission({"kind": "hold", "duration": 5.0}))
    flight.begin({"kind": "hold", "name": "left", "duration": 9.0})
    flight.advance(2.0)
    flight.begin({"kind": "hold", "name": "whole", "duration": 3.0})
    flight.advance()
    left, whole = flight.finish().phases
    assert left.stay is None
    assert whole.stay is not None
    assert whole.stay["time"] == pytest.approx(5.0)


def test_a_result_keeps_what_was_promised(tmp_path):
    """Saved and read, a flight has the same verdict, to the last digit."""
    phases, when = FLOWN["hold"]
    plan = mission(*phases)
    result = rf.simulate(plan, controller=pushed("hold 2", np.full((4, 3), 1.0), when))
    result.save(tmp_path / "a.nc")
    assert rf.assess(tmp_path / "a.nc").json() == rf.assess(result).json()


def test_kinds_without_a_promise_are_named():
    """Each kind of phase is in the table of promises of the documents."""
    with open("docs/missions.md", encoding="utf-8") as page:
        text = page.read().split("**What a phase promises.**")[1].split("\n\n**")[0]
    assert all(f"`{kind}`" in text for kind in KINDS)


def test_tracking_error_of_points():
    """Agent 2 hangs .3 m below its slot, where 1.2 N act against a spring of 4 N/m: judged against the limit."""
    sag = np.zeros((4, 3))
    sag[1, 2] = -1.2
    phases = [{"kind": "hold", "name": "h", "duration": 8.0}]
    for limit, passed in ((0.25, False), (0.35, True), (None, True)):
        limits = {} if limit is None else {"tracking_error": limit}
        plan = mission(*phases, limits=limits)
        verdict = rf.assess(rf.simulate(plan, controller=pushed("h", sag)))
        (check,) = [c for c in verdict.checks if c.check == "tracking_error"]
        assert check.worst == pytest.approx(0.3, abs=0.01)
        assert (check.passed, check.judged, check.who) == (passed, limit is not None, "agent 2")
        assert "at samples" in check.message
    open_ = mission(
        {"kind": "hold", "control": "open", "duration": 1.0}, limits={"tracking_error": 0.1}
    )
    (check,) = [c for c in rf.assess(rf.simulate(open_)).checks if c.check == "tracking_error"]
    assert check.worst is None
    assert "no slots are tracked" in check.message


def test_a_plan_is_judged_where_it_is_flown():
    """A controller of one's own that draws points together keeps no plan: only limits, where there are any, fail it."""
    start = [[0, 0, 9], [3, 0, 9]]

    def nearer(o):
        middle = o.reference_position.mean(axis=0)
        return tracking(
            replace(o, reference_position=middle + 0.5 * (o.reference_position - middle))
        )

    for limits in ({}, {"separation": 2.0}):
        plan = mission({"kind": "hold", "name": "h", "duration": 8.0}, start=start, limits=limits)
        own = rf.simulate(plan, controller=nearer)
        assert own.separation.min() < 1.6
        found = {c.check: c.passed for c in rf.assess(own).checks}
        assert "separation_as_planned" not in found
        assert found["separation"] == (not limits)
        assert "separation_as_planned" in {c.check for c in rf.assess(rf.simulate(plan)).checks}


# -- tolerance -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "limit"),
    [
        ({}, 0.03),
        ({"tolerance": 0.2}, 0.2),
        ({"tolerance_share": 0.05}, 0.15),
        ({"tolerance": 0.1}, 0.1),
    ],
)
def test_tolerance_of_a_shape(keys, limit):
    """Slots 4 % too far apart: the longest of 3 sqrt 2 m is .170 m off, judged by metres or a share of 3 m."""
    error = 0.04 * 3.0 * np.sqrt(2.0)

    def larger(o):
        middle = o.reference_position.mean(axis=0)
        return tracking(
            replace(o, reference_position=middle + 1.04 * (o.reference_position - middle))
        )

    form = {"slots": SLOTS, "edges": []} | keys
    plan = mission(ESTABLISH, {"kind": "hold", "duration": 4.0}, formations={"a": form})
    verdict = rf.assess(rf.simulate(plan, controller=larger))
    (shape, *_) = [c for c in verdict.checks if c.check == "shape"]
    assert shape.limit == pytest.approx(limit)
    assert shape.worst == pytest.approx(error, rel=0.02)
    assert shape.passed == (error < limit)


def test_tolerance_of_distances():
    """A formation of distances alone is judged by its tolerance, too, also where final states alone are flown."""
    for keys, limit in (({}, 0.04), ({"tolerance": 0.5}, 0.5)):
        form = {"distances": [4.0] * 6} | keys
        plan = mission(ESTABLISH | {"reference": "squares"}, formations={"a": form})
        (check,) = [c for c in rf.assess(rf.simulate(plan)).checks if c.check == "distances"]
        assert check.limit == pytest.approx(limit)


def test_final_states_know_the_tolerance():
    """A step of which .026 m remain after 4 s passes within .1 m and fails within .001 m, whole or by its end alone."""
    for tolerance, passes in ((0.001, False), (0.1, True)):
        form = {"slots": WIDE, "tolerance": tolerance}
        phase = ESTABLISH | {"control": "open", "reference": "step"}
        plan = mission(phase, formations={"a": form})
        starts = ["agents.position.1.1 += uniform(-0.001, 0.001)"]
        for evaluate in ("final", "flight"):
            rows = fly_runs(Sweep.of(plan, starts, runs=2, evaluate=evaluate), [0, 1])
            assert [row.reason == "" for row in rows] == [passes] * 2


def test_tolerance_is_given_once():
    """Metres and a share beside each other are an error with its remedy."""
    form = {"slots": SLOTS, "tolerance": 0.1, "tolerance_share": 0.1}
    with pytest.raises(MissionError, match=r"tolerance_share.*no effect beside tolerance"):
        mission(ESTABLISH, formations={"a": form})


@pytest.mark.parametrize("key", ["tolerance", "tolerance_share"])
def test_no_shape_is_exact(key):
    """A tolerance of zero, which no flight keeps, is refused in metres as in shares."""
    with pytest.raises(MissionError, match=rf"{key} = 0.0: must be > 0"):
        mission(ESTABLISH, formations={"a": {"slots": SLOTS, key: 0.0}})


def test_a_flight_by_hand_keeps_the_tolerance():
    """The record of phases begun by hand has tolerance and dimension, also where agents are assigned to slots."""
    flat = [[x, y, 0.0] for x, y, _ in SLOTS[:3]] + [[3.0, 3.0, 0.0]]
    form = {"slots": flat, "tolerance": 0.2, "dimension": 2}
    flight = rf.Flight(mission(ESTABLISH, formations={"a": form}, assignment="shortest"))
    flight.begin(ESTABLISH | {"duration": 3.0, "blend": 2.0})
    flight.advance()
    kept = flight.finish().mission.formations["a"]
    assert (kept.tolerance, kept.dimension) == (0.2, 2)


# -- free velocity ---------------------------------------------------------------------------------

FREE = {
    "kind": "fly",
    "name": "f",
    "position": [9.0, 0.0, 12.0],
    "velocity": "free",
    "duration": 6.0,
}
FIXED = {"kind": "hold", "duration": 2.0}


@pytest.mark.parametrize("architecture", ["local", "body"])
def test_free_velocity_of_the_regulator(architecture):
    """From rest, the least integral of a^2 to a place at distance d in T arrives at 1.5 d / T, and is not judged."""
    control = {"control": "body"} if architecture == "body" else {}
    plan = mission(FREE | control, architecture=architecture)
    result = rf.simulate(plan)
    way = np.array(FREE["position"]) - result.cm[0]
    np.testing.assert_allclose(result.cm_velocity[-1], 1.5 * way / 6.0, rtol=2e-3)
    assert np.linalg.norm(result.cm[-1] - FREE["position"]) < 0.02
    verdict = rf.assess(result)
    assert verdict.passed
    assert "waypoint_velocity" not in {c.check for c in verdict.checks}


def test_free_velocity_of_a_smooth_way():
    """The least snap from rest to a place without acceleration and jerk there: x^(6) = 0, from 8 linear equations."""
    result = rf.simulate(mission(FREE, FIXED, smoothness="jerk"))
    rows = [np.polynomial.Polynomial.basis(k) for k in range(8)]
    ends = [(0, 0), (1, 0), (2, 0), (3, 0), (0, 1), (2, 1), (3, 1), (6, 1)]
    A = [[row.deriv(m)(x) if m else row(x) for row in rows] for m, x in ends]
    unit = np.polynomial.Polynomial(np.linalg.solve(A, [0, 0, 0, 0, 1, 0, 0, 0]))
    k = result.samples(0).stop - 1
    way = np.array(FREE["position"]) - result.cm[0]
    np.testing.assert_allclose(
        result.cm_velocity_reference[k], unit.deriv()(1.0) * way / 6.0, rtol=1e-9
    )
    assert rf.assess(result).passed  # the hold after it returns


def test_free_velocity_through_points():
    """Through a point, no other velocity has less snap: compared with 40 others by SciPy's polynomials."""
    through = [{"position": [4.0, 3.0, 11.0], "time": 2.5}]
    leg = preview_phases(mission(FREE | {"through": through}, smoothness="jerk"))[0][0].leg
    knots, pieces = leg.motion.knots, leg.motion.coefficients[:, :3]

    def snap(c):
        h = np.diff(knots)
        k = np.arange(4, 8)
        total = 0.0
        for piece, width in zip(c, h, strict=True):
            for axis in piece:
                poly = np.polynomial.Polynomial(axis[4:] * k * (k - 1) * (k - 2) * (k - 3))
                total += (poly * poly).integ()(width)
        return total

    from rigidfleet.math import splines

    x = np.array([[0.75, 0.75, 10.75], [4, 3, 11], FREE["position"]])
    rng = np.random.default_rng(1)
    assert leg.planned_end_state.goal is not None
    v = leg.planned_end_state.goal.v
    for change in rng.normal(scale=0.1, size=(40, 3)):
        end = np.stack([v + change, np.zeros(3), np.zeros(3)])
        assert snap(splines.minimum_snap(knots, x, np.zeros((3, 3)), end)) > snap(pieces)


def test_an_intercept_is_met_at_any_velocity():
    """A controller that meets a point to a micrometre at 2.8 m/s passes; asked for rest there, it fails."""
    for velocity, passed in (("free", True), ([0.0, 0.0, 0.0], False)):
        plan = mission(FREE | {"velocity": velocity})
        start = np.array(START)
        shift = np.array(FREE["position"]) - start.mean(axis=0)

        def law(o, start=start, shift=shift):
            s, rate = (
                3 * (o.t / 6) ** 2 / 2 - (o.t / 6) ** 3 / 2,
                (3 * o.t / 36 - 1.5 * o.t**2 / 216),
            )
            wanted = replace(
                o, reference_position=start + s * shift, reference_velocity=0 * start + rate * shift,
                reference_acceleration=0 * start + (3 / 36 - 3 * o.t / 216) * shift,
            )  # fmt: skip
            return tracking(wanted)

        result = rf.simulate(plan, controller=law)
        verdict = rf.assess(result)
        assert ("waypoint_position", "f") not in failed(result)
        assert verdict.passed == passed, verdict.summary


def test_free_velocity_in_words():
    """A mission says it, its schema allows it, and another word is refused."""
    assert "any velocity" in mission(FREE).phases[0].leads_to
    with pytest.raises(MissionError, match="velocity"):
        mission(FREE | {"velocity": "any"})
    assert rf.simulate(mission(FREE)).mission.to_dict()["phases"][0]["velocity"] == "free"


# -- export ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("why", ["failed", "incomplete"])
def test_export_asks_for_force(why, tmp_path, capsys):
    """A flight that failed, or was stopped, is refused in any format with the reason; --force writes it, and warns."""
    plan = mission(ESTABLISH, {"kind": "hold", "name": "h", "duration": 4.0})
    if why == "failed":
        result = rf.simulate(plan, controller=pushed("h", np.full((4, 3), 3.0)))
    else:
        flight = rf.Flight(plan)
        flight.begin()
        flight.advance()
        result = flight.finish("interrupted at t = 4.00 s")
    file, out = tmp_path / "a.nc", tmp_path / "out"
    result.save(file)
    told = "off in position" if why == "failed" else "interrupted at t = 4.00 s"
    for name in FORMATS:
        assert main(["export", str(file), "--format", name, "--out", str(out)]) == 2
        error = capsys.readouterr().err
        assert told in error
        assert "Use --force" in error
        assert not out.exists()
    assert main(["export", str(file), "--format", "poly4d", "--out", str(out), "--force"]) == 0
    assert told in capsys.readouterr().err
    assert len(list(out.iterdir())) == 4
