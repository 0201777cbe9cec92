"""A flight step by step: as `simulate` flies it, with looks and changes on the way."""

import numpy as np
import pytest

import rigidfleet as rf
from rigidfleet.errors import FlightError, MissionError
from rigidfleet.mission import Mission
from rigidfleet.mission.kinds import Fly, Reshape

FLY = {"kind": "fly", "position": [8.0, 0.0, 12.0], "duration": 8.0}


@pytest.fixture(scope="module")
def whole() -> rf.Result:
    return rf.simulate("narrow-passage")


def test_without_stops_a_flight_is_that_of_simulate(whole):
    """Phase by phase, bit for bit."""
    flight = rf.Flight("narrow-passage")
    while flight.begin():
        assert not flight.advance()
    result = flight.finish()
    assert result.complete
    np.testing.assert_array_equal(result.time, whole.time)
    np.testing.assert_array_equal(result.position, whole.position)
    assert [p.extremes for p in result.phases] == [p.extremes for p in whole.phases]
    assert rf.assess(result).json() == rf.assess(whole).json()


def test_stops_change_no_more_than_the_tolerances(whole):
    """Stops are recorded, and what is seen there is what is recorded there."""
    flight = rf.Flight("narrow-passage")
    seen = {}
    while flight.begin():
        while flight.advance(0.77):
            seen[flight.t] = flight.observe()
    result = flight.finish()
    assert result.complete
    both = np.isin(result.time, whole.time)
    there = np.isin(whole.time, result.time)
    assert both.sum() > 1700
    np.testing.assert_allclose(result.position[both], whole.position[there], atol=1e-5)
    assert len(seen) > 100
    for t, look in seen.items():
        k = int(np.flatnonzero(result.time == t)[0])
        np.testing.assert_allclose(look.position, result.position[k], atol=1e-9)
    assert rf.assess(result).passed


def test_a_phase_that_settles_can_be_stopped():
    """Whether it has settled is asked at the same moments, wherever somebody looks."""
    whole = rf.simulate("line-singular")
    flight = rf.Flight("line-singular")
    while flight.begin():
        while flight.advance(0.033):
            pass
    result = flight.finish()
    for one, other in zip(result.phases, whole.phases, strict=True):
        assert one.t_end == pytest.approx(other.t_end, abs=0.11)
        assert one.settled == other.settled


def test_another_target_on_the_way():
    """The reference goes on from where it is; the target that was left is no waypoint; the record says what flew."""
    flight = rf.Flight("narrow-passage")
    flight.begin()
    flight.advance()
    flight.begin(FLY)
    assert flight.advance(4.0)
    before = flight.pose()
    flight.begin(FLY | {"position": [4.0, 6.0, 12.0]})
    after = flight.pose()
    np.testing.assert_allclose(after.r, before.r, atol=1e-9)
    np.testing.assert_allclose(after.v, before.v, atol=1e-9)
    assert not flight.advance()
    result = flight.finish()
    assert result.complete
    assert rf.assess(result).passed
    np.testing.assert_allclose(result.cm[-1], [4.0, 6.0, 12.0], atol=1e-3)
    assert [p.t_end for p in result.phases] == pytest.approx([6.0, 10.0, 18.0])
    assert len(result.mission.phases) == 3


def test_the_mission_goes_on_where_it_was_left():
    """After a phase of one's own the mission's next one begins."""
    flight = rf.Flight("square")
    names = []
    flight.begin()
    flight.advance(2.0)
    flight.begin({"kind": "hold", "duration": 1.0})
    assert not flight.advance()
    while flight.begin():
        names.append(flight.plan.phase.name)
        flight.advance()
    assert names == [p.name for p in rf.load_mission("square").phases[1:]]


def test_a_flight_that_ends_early_says_so():
    """Half a mission is an incomplete record, which fails its verdict."""
    flight = rf.Flight("narrow-passage")
    flight.begin()
    flight.advance(2.0)
    result = flight.finish()
    assert not result.complete
    assert "ended at t = 2.00 s" in result.ending
    assert result.time[-1] == 2.0
    assert not rf.assess(result).passed


def test_a_flight_that_cannot_go_on_says_why():
    """The diagnosis is in `ending`; nothing begins any more."""
    flight = rf.Flight("line-singular")
    while flight.begin():
        flight.advance()
    assert "cannot go on" in flight.ending
    assert not flight.begin({"kind": "hold", "duration": 1.0})
    assert flight.finish().ending == flight.ending


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"kind": "orbiting"}, "kind"),
        (FLY | {"position": [1.0, 2.0]}, "position"),
        (FLY | {"formation": "no such"}, "formation"),
        ({"kind": "reshape", "formation": "no such", "duration": 3.0}, "no such"),
    ],
)
def test_a_phase_with_errors_is_refused(table, words):
    """As in a mission file; the flight goes on."""
    flight = rf.Flight("narrow-passage")
    flight.begin()
    flight.advance()
    with pytest.raises(MissionError, match=words):
        flight.begin(table)
    assert flight.begin(FLY)


def test_what_makes_no_sense_is_refused():
    """No phase under way, a time that is none, nothing flown."""
    flight = rf.Flight("square")
    with pytest.raises(FlightError, match="no phase is under way"):
        flight.advance()
    with pytest.raises(FlightError, match="before the first time"):
        flight.finish()
    flight.begin()
    for wrong in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="duration must be positive"):
            flight.advance(wrong)
    with pytest.raises(TypeError, match="a duration"):
        flight.advance("1")  # ty: ignore[invalid-argument-type]


def test_a_refused_phase_leaves_the_one_under_way(whole):
    """What was begun flies on to its end, and the record is that of the mission."""
    flight = rf.Flight("narrow-passage")
    flight.begin()
    flight.advance(2.0)
    with pytest.raises(MissionError, match="position"):
        flight.begin(FLY | {"position": [1.0, 2.0]})
    for wrong in ("hold", 3, [FLY]):
        with pytest.raises(TypeError, match="a phase"):
            flight.begin(wrong)  # ty: ignore[invalid-argument-type]
    with pytest.raises(MissionError, match="no such formation"):
        flight.begin(Reshape(kind="reshape", name="x", formation="no such", duration=3.0))
    assert flight.t == 2.0
    assert not flight.advance()
    assert flight.t == whole.phases[0].t_end


def test_a_phase_begun_and_not_flown_leaves_no_trace():
    """It has no length, so the record and the next phase know nothing of it."""
    flight = rf.Flight("narrow-passage")
    flight.begin()
    flight.begin(FLY)
    flight.begin(FLY | {"position": [1.0, 2.0, 10.0]})
    flight.advance()
    flight.begin({"kind": "hold", "duration": 1.0})
    result = flight.finish()
    assert [p.kind for p in result.mission.phases] == [p.kind for p in result.phases] == ["fly"]
    assert result.complete


def test_a_phase_of_the_mission_that_was_cut_short():
    """The record's mission has the phase as long as it was flown, and flies the same again."""
    data = rf.load_mission("square").to_dict()
    data["phases"].append({"kind": "hold", "duration": 1.0})
    flight = rf.Flight(Mission.from_dict(data))
    flight.begin()
    flight.advance(9.0)
    while flight.begin():
        flight.advance()
    result = flight.finish()
    assert [p.until for p in result.mission.phases] == [9.0, 10.0]
    again = rf.simulate(result.mission)
    np.testing.assert_allclose(again.position[-1], result.position[-1], atol=1e-6)


def test_a_flight_whose_controller_failed_is_not_complete():
    """Its mission did not come to its end."""

    def controller(seen):
        if seen.t > 7.0:
            raise RuntimeError("broken")
        return seen.masses[:, None] * [0.0, 0.0, seen.gravity]

    flight = rf.Flight("single-waypoint", controller=controller)
    while flight.begin() and flight.phases[-1].control != "tracking":
        flight.advance()
    with pytest.raises(FlightError, match="broken"):
        flight.advance()
    result = flight.finish()
    assert not result.complete
    assert "before the mission's end" in result.ending


def test_a_finished_flight_is_over():
    """It flies no further; its record can be asked for again."""
    flight = rf.Flight("square")
    flight.begin()
    flight.advance(0.5)
    result = flight.finish()
    for use in (flight.begin, lambda: flight.begin(FLY), flight.advance, flight.observe):
        with pytest.raises(FlightError, match="the flight is finished"):
            use()
    np.testing.assert_array_equal(flight.finish().time, result.time)


def test_the_shortest_of_all_phases():
    """A phase as long as the least step of a number has one sample."""
    flight = rf.Flight("square")
    flight.begin()
    flight.advance(1.0)
    for _ in range(2):
        flight.begin({"kind": "hold", "duration": 1.0})
        flight.advance(np.spacing(1.0))
    assert np.all(np.diff(flight.finish().time) > 0.0)


def test_names_may_repeat():
    """The record tells phases of one name apart, whatever they were called."""
    flight = rf.Flight("square")
    flight.begin()
    flight.advance()
    for name in ("wait", "wait", "wait (2)", "wait"):
        flight.begin({"kind": "hold", "name": name, "duration": 1.0})
        flight.advance()
    result = flight.finish()
    names = ["establish 1", "wait", "wait (3)", "wait (2)", "wait (4)"]
    assert [p.name for p in result.mission.phases] == [p.name for p in result.phases] == names


def test_an_orbit_left_on_the_way_leads_nowhere_else():
    """A hold after it comes back to where the orbit was left, as it does in the record's mission."""
    flight = rf.Flight("narrow-passage")
    flight.begin()
    flight.advance()
    flight.begin(
        {"kind": "orbit", "centre": [5, 5, 8], "radius": 4, "rate_deg_s": 20, "duration": 30}
    )
    flight.advance(8.0)
    left = flight.pose()
    flight.begin({"kind": "hold", "duration": 10.0})
    flight.advance()
    result = flight.finish()
    np.testing.assert_allclose(result.cm[-1], left.r, atol=1e-2)
    again = rf.simulate(result.mission)
    np.testing.assert_allclose(again.position[-1], result.position[-1], atol=1e-4)


def test_a_step_can_be_left():
    """A phase whose distances jump has no blend: phases of one's own follow it, and the record has them."""
    flight = rf.Flight("line-singular")
    flight.begin()
    flight.advance(3.0)
    flight.begin({"kind": "hold", "control": "open", "duration": 2.0})
    flight.advance()
    result = flight.finish()
    assert [p.kind for p in result.mission.phases] == ["establish", "hold"]
    assert [p.name for p in result.mission.phases] == [p.name for p in result.phases]


def test_a_phase_begun_is_not_skipped():
    """A second begin before anything was flown is refused; another phase puts the mission's one off."""
    flight = rf.Flight("establish-triangle")
    flight.begin()
    with pytest.raises(
        FlightError, match="nothing of phase 'establish 1' has been flown: call advance"
    ):
        flight.begin()
    flight.begin({"kind": "hold", "control": "open", "duration": 1.0})
    flight.advance()
    while flight.begin():
        flight.advance()
    result = flight.finish()
    kinds = ["hold", *(p.kind for p in rf.load_mission("establish-triangle").phases)]
    assert [p.kind for p in result.mission.phases] == [p.kind for p in result.phases] == kinds


def test_a_waypoint_that_was_left_is_noted():
    """Its phase ends where it was left, with the goal that it had; the verdict says that it is not judged."""
    flight = rf.Flight("narrow-passage")
    flight.begin()
    flight.advance()
    flight.begin(FLY | {"name": "first"})
    flight.advance(4.0)
    flight.begin(FLY | {"name": "second", "position": [4.0, 6.0, 12.0]})
    flight.advance()
    result = flight.finish()
    _, first, second = result.mission.phases
    assert isinstance(first, Fly)
    assert (list(first.position), first.until) == ([8.0, 0.0, 12.0], 10.0)
    (note,) = rf.assess(result).notes
    assert note.startswith("'first' was left at 10.00 s, before its arrival")
    assert [p.waypoint is None for p in rf.assess(result).phases] == [True, True, False]
    assert second.name == "second"
