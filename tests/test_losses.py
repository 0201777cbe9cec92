"""What the others do when a vehicle or link is lost: they brake without a jump, and hold or land."""

import copy
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

import rigidfleet as rf
from rigidfleet import assess, check, simulate
from rigidfleet.errors import MissionError
from rigidfleet.math import splines
from rigidfleet.math.attitude import angle_between
from rigidfleet.mission import Mission
from rigidfleet.result import Result
from rigidfleet.web.live.pilot import Pilot

RADIUS = 0.25
START = [[0.0, 0, 5], [4.2, 0, 5], [4, 4.1, 5], [0, 4, 5]]
PHASES: list[dict[str, Any]] = [
    {"kind": "establish", "formation": "square", "duration": 5.0, "blend": 5.0},
    {"kind": "fly", "position": [20.0, 5.0, 10.0], "yaw_deg": 60.0, "duration": 10.0},
    {"kind": "hold", "duration": 5.0},
]
LOST = {"lost": [{"agent": 2, "time": 8.0}]}


def data(disturbances: dict[str, Any], **tables: Any) -> dict[str, Any]:
    """Four vehicles that form a square, fly and hold, above a ground."""
    given = {
        "schema_version": 1, "name": "lossy", "smoothness": "jerk",
        "agents": {"mass": 1.0, "position": START},
        "formations": {"square": {"shape": "square", "size": 4.0}},
        "obstacles": [{"kind": "ground"}], "disturbances": disturbances, "phases": PHASES,
    }  # fmt: skip
    return copy.deepcopy(given | tables)


def mission(disturbances: dict[str, Any], **tables: Any) -> Mission:
    return Mission.from_dict(data(disturbances, **tables))


def rotors(disturbances: dict[str, Any], **tables: Any) -> Mission:
    """The same flown by quadrotors."""
    given = {
        "agents": {"vehicle": "drone", "position": START},
        "vehicles": {"drone": {"model": "paper"}},
        "tracking": {"drag_feedforward": True},
    }
    return mission(disturbances, **(given | tables))


def names(result: Result) -> list[str]:
    return [phase.name for phase in result.phases]


def slots(result: Result, order: int) -> Any:
    """Derivative (K, N, 3) of the slots of an order: velocity, acceleration or jerk."""
    name = ("slot_position", "slot_velocity", "slot_acceleration", "slot_jerk")[order]
    found = getattr(result, name)
    assert found is not None
    return found


def jumps(result: Result, t: float, who: list[int]) -> list[float]:
    """Jumps of the slots at a switch, of position and three derivatives."""
    k = int(np.searchsorted(result.time, t))
    assert result.time[k] == t
    assert result.time[k + 1] == np.nextafter(t, np.inf)
    found = []
    for order in range(4):
        x = slots(result, order)[k : k + 2, who]
        found.append(float(np.abs(np.diff(x, axis=0)).max()))
    return found


# -- braking ------------------------------------------------------------------------------------------


def test_a_stop_has_the_least_snap():
    """Of all ways to rest from a state, ending anywhere, the piece has the least integral of snap^2."""
    begin, T = np.array([1.0, 3.0, -0.5, 0.7]), 2.5
    (piece,) = splines.stopping_piece(T, begin)
    way = np.polynomial.Polynomial(piece)
    np.testing.assert_allclose([way.deriv(m)(0.0) if m else way(0.0) for m in range(4)], begin)
    np.testing.assert_allclose([way.deriv(m)(T) for m in (1, 2, 3)], 0.0, atol=1e-12)
    u = np.polynomial.Polynomial([0.0, 1.0])

    def cost(x):
        return quad(lambda t: x.deriv(4)(t) ** 2, 0.0, T)[0]

    # All variations keep the state at the start and the rest at the end; the second one moves the end.
    for other in (
        u**4 * (T - u) ** 4,
        (u**4 * (T - u) ** 3).integ(),
        (u**3 * (T - u) ** 3).integ(),
    ):
        for size in (1e-2, -1e-2):
            assert cost(way + size * other) > cost(way)
    steady = np.polynomial.Polynomial(splines.stopping_piece(T, np.array([0.0, 3.0, 0, 0]))[0])
    assert steady(T) == pytest.approx(3.0 * T / 2)
    t = np.linspace(0, T, 20001)
    assert np.abs(steady.deriv(2)(t)).max() == pytest.approx(15 * 3.0 / (8 * T), rel=1e-6)
    assert np.abs(steady.deriv(3)(t)).max() == pytest.approx(10 * 3.0 / (3**0.5 * T**2), rel=1e-6)


def test_the_others_brake_and_hold():
    """After a loss the others brake without a jump, within 2 m/s^2 and 5 m/s^3, and hold the shape to the end."""
    result = simulate(mission(LOST | {"on_loss": "hold"}))
    assert names(result) == ["establish 1", "fly 2", "brake (loss)", "hold (loss)"]
    assert [p.abandoned for p in result.phases] == [False, True, False, False]
    left = [0, 2, 3]
    assert max(jumps(result, 8.0, left)) < 1e-9
    assert max(jumps(result, result.phases[2].t_end, left)) < 1e-9
    after = result.time > 8.0
    assert np.linalg.norm(slots(result, 2)[after][:, left], axis=2).max() < 2.03
    assert np.linalg.norm(slots(result, 3)[after][:, left], axis=2).max() < 5.06
    brakes = result.phases[2]
    still = result.time > brakes.t_end
    assert np.abs(slots(result, 1)[still][:, left]).max() < 1e-9
    assert np.ptp(result.position[still][:, left], axis=0).max() < 1e-3
    assert result.time[-1] == 20.0
    assert result.complete
    verdict = assess(result)
    assert verdict.passed, verdict.summary
    assert "phases abandoned after a loss: 2" in verdict.summary
    assert (
        "after the loss of agent 2 at 8.00 s, 'fly 2' was left and is not judged; 'hold 3' was not flown"
    ) in verdict.notes
    assert verdict.phases[1].waypoint is None
    assert not any("waypoint" in c.check for c in verdict.checks if c.phase == "fly 2")


def test_an_orbit_brakes_from_its_acceleration():
    """A circle at 2.4 m/s^2 goes on with this acceleration and jerk, turning as it does, and comes to rest."""
    orbit = {
        "kind": "orbit", "centre": [12, 2, 5], "radius": 10.0, "rate_deg_s": 28.0, "yaw": "along", "blend": 5.0,
        "duration": 20.0,
    }  # fmt: skip
    lost = {"lost": [{"agent": 1, "time": 15.03}], "on_loss": "hold", "hold_until": 26.0}
    result = simulate(mission(lost, phases=[PHASES[0], orbit]))
    left = [1, 2, 3]
    k = int(np.searchsorted(result.time, 15.03))
    assert np.linalg.norm(slots(result, 2)[k, left], axis=1).max() > 2.3
    assert max(jumps(result, 15.03, left)) < 1e-6
    assert np.abs(slots(result, 1)[-1, left]).max() < 1e-9
    assert result.time[-1] == 26.0
    assert assess(result).passed


@pytest.mark.parametrize("smoothness", ["jerk", "lqr"])
def test_no_reference_jumps(smoothness):
    """Acceleration continues through the loss also where the legs of a mission are those of regulators."""
    result = simulate(mission(LOST | {"on_loss": "land"}, smoothness=smoothness))
    position, velocity, acceleration, _ = jumps(result, 8.0, [0, 2, 3])
    assert max(position, velocity) < 1e-9
    assert acceleration < 1e-6
    assert assess(result).passed


def test_a_change_of_shape_is_completed():
    """A loss during a blend does not bend its way: it ends where and when it would have, while the body stands."""
    lost = {"lost": [{"agent": 2, "time": 2.0}]}
    result = simulate(mission(lost | {"on_loss": "hold"}))
    whole = simulate(mission(lost))
    assert names(result) == ["establish 1", "brake (loss)", "hold (loss)"]
    assert result.phases[1].t_end == pytest.approx(5.0)
    for order in (0, 2):
        one, other = (
            slots(r, order)[(r.time <= 5.0) & (r.phase < 2)][:, [0, 2, 3]] for r in (result, whole)
        )
        times = [r.time[(r.time <= 5.0) & (r.phase < 2)] for r in (result, whole)]
        both = np.isin(times[1], times[0])
        np.testing.assert_allclose(one[np.isin(times[0], times[1])], other[both], rtol=0, atol=1e-9)
    assert assess(result).passed


# -- landing ------------------------------------------------------------------------------------------


def test_the_others_land():
    """They descend straight down, in shape, and end 5 cm above the ground, at 0.2 m/s, at 1 m/s at most."""
    result = simulate(mission(LOST | {"on_loss": "land"}))
    assert names(result)[1:] == ["fly 2", "brake (loss)", "land (loss)"]
    left, land = [0, 2, 3], result.samples(3)
    places = result.slot_position[land][:, left]
    assert np.ptp(places[..., :2], axis=0).max() < 1e-9
    speed = slots(result, 1)[land][:, left, 2]
    assert -1.0 < speed.min() < -0.8
    assert speed.max() < 1e-9
    np.testing.assert_allclose(speed[-1], -0.2, atol=1e-9)
    np.testing.assert_allclose(result.position[-1, left, 2], RADIUS + 0.05, atol=1e-6)
    verdict = assess(result)
    assert verdict.passed, verdict.summary
    told = {c.check: c for c in verdict.checks}
    assert told["clearance_end"].worst == pytest.approx(0.05, abs=1e-6)
    assert told["waypoint_position"].phase == "land (loss)"
    assert told["abandoned"].worst == 2.0


def test_a_loss_before_take_off_stays_on_the_ground():
    """Vehicles that stand on the ground brake and are done."""
    start = [[x, y, RADIUS] for x, y, _ in START]
    lift = {"kind": "fly", "position": [2, 2, 5], "duration": 6.0}
    m = mission(
        {"lost": [{"agent": 4, "time": 0.5}], "on_loss": "land"},
        agents={"mass": 1.0, "position": start},
        phases=[{"kind": "hold", "duration": 1.0}, lift, *PHASES],
    )
    result = simulate(m)
    assert names(result) == ["hold 1", "brake (loss)"]
    assert np.abs(result.velocity[:, :3]).max() < 1e-6
    verdict = assess(result)
    assert verdict.passed, verdict.summary
    # a little later, in the first centimetres, they go up no further than they must, and come down again
    result = simulate(
        mission(
            {"lost": [{"agent": 4, "time": 2.5}], "on_loss": "land"},
            agents={"mass": 1.0, "position": start},
            phases=[{"kind": "hold", "duration": 1.0}, lift, *PHASES],
        )
    )
    assert names(result)[-2:] == ["brake (loss)", "land (loss)"]
    np.testing.assert_allclose(result.position[-1, :3, 2], RADIUS + 0.05, atol=1e-6)


CUBE = {"cube": {"shape": "cube", "size": 4.0}, "flat": {"shape": "grid", "size": 4.0}}


def cube(disturbances: dict[str, Any]) -> Mission:
    places = 4.0 * np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)]) + [0, 0, 8.0]
    phases = [
        {"kind": "establish", "formation": "cube", "duration": 8.0},
        {"kind": "turn", "roll_deg": 40.0, "yaw_deg": 30.0, "duration": 6.0},
    ]
    return mission(
        disturbances, formations=CUBE, agents={"mass": 1.0, "position": places}, phases=phases,
        assignment="each",
    )  # fmt: skip


def test_a_stack_spreads_and_levels_before_it_lands():
    """A cube that is rolling brakes its turn, takes a level formation, lies level, and lands."""
    lost = {"lost": [{"agent": 3, "time": 11.0}], "on_loss": "land"}
    with pytest.raises(MissionError) as refused:
        cube(lost)
    (finding,) = refused.value.findings
    assert finding.key == "disturbances.on_loss"
    assert "its vehicles differ by 4 m in height, and agents 1 and 5 stand one" in finding.problem
    assert "landing_formation" in finding.remedy
    result = simulate(cube(lost | {"landing_formation": "flat"}))
    tail = ["brake (loss)", "spread (loss)", "level (loss)", "land (loss)"]
    assert names(result) == ["establish 1", "turn 2", *tail]
    left = [i for i in range(8) if i != 2]
    for phase in result.phases[1:-1]:
        assert max(jumps(result, phase.t_end, left)[:3]) < 1e-6
    np.testing.assert_allclose(result.position[-1, left, 2], RADIUS + 0.05, atol=1e-4)
    assert assess(result).passed


# -- near the ground ----------------------------------------------------------------------------------


def lowest(result: Result) -> float:
    """How high above what is below it the surface of a vehicle that is left comes at the least, by samples [m]."""
    r = np.where(result.left[..., None], result.position, 99.0)
    m = result.mission
    return float((r[..., 2] - m.height_below(*np.moveaxis(r[..., :2], 2, 0)) - RADIUS).min())


PADS = [[x, y, RADIUS] for x, y, _ in START]
RISE: dict[str, Any] = {"kind": "takeoff", "height": 8.0, "duration": 6.0}


@pytest.mark.parametrize("on_loss", ["hold", "land", "abort"])
@pytest.mark.parametrize(("rotors_", "times"), [(False, [11.9, 12.5]), (True, [12.2])])
def test_a_brake_from_a_fast_descent_stays_above_the_ground(on_loss, rotors_, times):
    """A descent of 7 m in 3.5 s, which 2 m/s^2 cannot stop, is slowed down along the plan: nobody comes lower."""
    down = {"kind": "fly", "position": [2.0, 2.0, 0.8], "duration": 3.5}
    phases = [RISE, PHASES[0], down, {"kind": "hold", "duration": 3.0}]
    agents = {"position": PADS} | ({"vehicle": "drone"} if rotors_ else {"mass": 1.0})
    make = rotors if rotors_ else mission
    whole = lowest(simulate(make({}, agents=agents, phases=phases)))
    for t in times:
        lost = {"lost": [{"agent": 2, "time": t}], "on_loss": on_loss}
        result = simulate(make(lost, agents=agents, phases=phases))
        assert result.complete
        assert lowest(result) > min(whole, 0.05) - 2e-3
        assert assess(result).passed


@pytest.mark.parametrize("on_loss", ["hold", "land"])
@pytest.mark.parametrize("t", [0.5, 3.0, 4.5])
def test_who_stands_stays_where_others_take_off(on_loss, t):
    """Of two that take off and two that stand, a loss stops the first and leaves the others on the ground."""
    phases = [RISE | {"agents": [1, 2]}, {"kind": "hold", "duration": 2.0}]
    lost = {"lost": [{"agent": 2, "time": t}], "on_loss": on_loss}
    result = simulate(mission(lost, agents={"mass": 1.0, "position": PADS}, phases=phases))
    assert lowest(result) > -1e-6
    standing = result.position[:, [2, 3]]
    assert np.abs(standing - standing[0]).max() < 1e-6
    assert result.position[-1, 0, 2] - RADIUS < (0.05 + 1e-6 if on_loss == "land" else 8.0)
    assert assess(result).passed


@pytest.mark.parametrize("on_loss", ["hold", "land"])
@pytest.mark.parametrize("t", [0.5, 12.0, 16.5])
def test_stops_above_a_roof_and_the_ground(on_loss, t):
    """Two start on a roof of 2 m, all fly level and land each where it is: nobody sinks into roof or ground."""
    roof = {"kind": "box", "name": "roof", "min": [-50, 2.0, 0], "max": [50, 50, 2.0]}
    pads = [[x, y, z + (2.0 if y > 2.0 else 0.0)] for x, y, z in PADS]
    land = {"kind": "land", "duration": 7.0, "agents": [1, 2, 3, 4]}
    lost = {"lost": [{"agent": 2, "time": t}], "on_loss": on_loss, "landing_formation": "square"}
    if on_loss == "hold":
        del lost["landing_formation"]
    result = simulate(
        mission(
            lost,
            agents={"mass": 1.0, "position": pads},
            obstacles=[{"kind": "ground"}, roof],
            phases=[RISE, PHASES[0], land],
        )
    )
    assert lowest(result) > -1e-6


# -- when ---------------------------------------------------------------------------------------------


def test_a_loss_while_a_phase_settles():
    """It is left as one that was abandoned, not as one that did not settle."""
    phases = [
        {"kind": "establish", "formation": "square", "settle": {"dwell": 3.0, "tolerance": 1e-9}},
        *PHASES[1:],
    ]
    lost = {"lost": [{"agent": 1, "time": 6.51}]}
    result = simulate(mission(lost | {"on_loss": "hold"}, phases=phases))
    assert result.phases[0].t_end == 6.51
    assert result.phases[0].settled is None
    assert result.phases[0].abandoned
    assert result.complete
    verdict = assess(result)
    assert verdict.passed, verdict.summary
    assert not any(c.check == "settled" for c in verdict.checks)


def test_a_loss_at_a_switch():
    """The phase that ends there is judged, those after it are not flown."""
    lost = {"lost": [{"agent": 1, "time": 15.0}]}
    result = simulate(mission(lost | {"on_loss": "land"}))
    assert names(result)[1:] == ["fly 2", "brake (loss)", "land (loss)"]
    assert not any(p.abandoned for p in result.phases)
    verdict = assess(result)
    assert verdict.phases[1].waypoint is not None
    assert "after the loss of agent 1 at 15.00 s, 'hold 3' was not flown" in verdict.notes


def test_points_passed_before_the_loss_are_judged():
    """Of a way through points, those passed before the loss count; those after it, and the waypoint, do not."""
    points = [
        {"position": [5.0, 2.0, 6.0], "time": 2.0},
        {"position": [12.0, 4.0, 8.0], "time": 5.0},
    ]
    way = PHASES[1] | {"through": points}
    result = simulate(mission(LOST | {"on_loss": "land"}, phases=[PHASES[0], way, PHASES[2]]))
    verdict = assess(result)
    (judged,) = verdict.phases[1].through
    assert judged.time == 7.0
    assert judged.position is not None
    assert judged.position < 1e-3
    assert verdict.phases[1].waypoint is None
    assert verdict.passed, verdict.summary


def test_a_second_loss_does_not_begin_anew():
    """The second vehicle drops out of the landing, which goes on to the ground on the same way."""
    two = {"lost": [*LOST["lost"], {"agent": 4, "time": 16.0}], "on_loss": "land"}
    one, result = (simulate(mission(d)) for d in (LOST | {"on_loss": "land"}, two))
    assert names(result) == names(one)
    np.testing.assert_allclose(result.position[-1, [0, 2]], one.position[-1, [0, 2]], atol=1e-4)
    np.testing.assert_array_equal(result.left[-1], [True, False, True, False])
    assert result.complete
    together = {"lost": [*LOST["lost"], {"agent": 4, "time": 8.0}], "on_loss": "hold"}
    result = simulate(mission(together))
    assert "after the loss of agents 2 and 4 at 8.00 s" in " ".join(assess(result).notes)
    assert assess(result).passed


@pytest.mark.parametrize("second", [2, 3, 4])
def test_two_that_are_left_show_the_attitude_that_they_are_led_in(second):
    """Two vehicles are a line, whose attitude is the commanded one as far as they show it; it was one by chance."""
    slots = [[0.5, -2.0, -1.5], [0.5, 2.0, -1.5], [-0.5, -2.0, 1.5], [-0.5, 2.0, 1.5]]
    lost = [{"agent": 1, "time": 8.0}, {"agent": second, "time": 12.0}]
    form = {"square": {"slots": slots}}
    result = simulate(mission({"lost": lost, "on_loss": "hold"}, formations=form))
    assert names(result)[-1] == "hold (loss)"
    off = angle_between(result.attitude, result.attitude_reference)[result.time > 12.0]
    assert len(off) > 10
    assert np.degrees(off).max() < 1e-3
    assert assess(result).by_name["waypoint_attitude"].passed


def test_without_a_loss_nothing_changes():
    """A mission that ends before its loss, or loses nothing, flies to its end."""
    plain = simulate(mission({"wind": [1.0, 0.0, 0.0]}))
    asked = simulate(mission({"wind": [1.0, 0.0, 0.0], "on_loss": "land"}))
    assert names(plain) == names(asked)
    np.testing.assert_allclose(plain.position, asked.position, rtol=0, atol=1e-9)
    assert not any(p.abandoned for p in asked.phases)


# -- records ------------------------------------------------------------------------------------------


def test_a_flight_repeats_from_its_result(tmp_path):
    """The file holds the phases flown and the mission asked, which flies the same bits again, gusts and noise too."""
    stormy = {
        "wind": [2.0, 0, 0], "gusts": {"model": "first-order", "intensity": 0.5, "time_scale": 2.0, "seed": 4},
        "noise": {"position": 0.01, "velocity": 0.02, "seed": 5},
    }  # fmt: skip
    result = simulate(mission(LOST | stormy | {"on_loss": "land"}))
    result.save(tmp_path / "lossy.nc")
    loaded = Result.load(tmp_path / "lossy.nc")
    assert [p.abandoned for p in loaded.phases] == [False, True, False, False]
    assert names(loaded) == names(result)
    assert assess(loaded).json() == assess(result).json()
    again = simulate(Mission.from_toml(loaded.mission_text))
    assert again.position.tobytes() == loaded.position.tobytes()


def test_a_flight_step_by_step():
    """`Flight` ends the phase at the loss and goes on to what follows; stops change nothing."""
    flight = rf.Flight(mission(LOST | {"on_loss": "land"}))
    ends = []
    while flight.begin():
        while flight.advance(0.7):
            pass
        ends.append(flight.t)
    result = flight.finish()
    whole = simulate(mission(LOST | {"on_loss": "land"}))
    assert result.complete
    assert ends == [p.t_end for p in whole.phases]
    np.testing.assert_allclose(result.position[-1], whole.position[-1], atol=1e-6)
    flight = rf.Flight(mission(LOST | {"on_loss": "land"}))
    while flight.begin():
        flight.advance(6.0)
    stopped = flight.finish()
    assert not stopped.complete or stopped.phases[-1].t_end == whole.phases[-1].t_end


def test_by_hand_a_loss_ends_no_phase():
    """A phase begun by hand goes on; its record has the phases flown, and asks for nothing at a loss."""
    flight = rf.Flight(mission(LOST | {"on_loss": "land"}))
    assert flight.begin()
    flight.advance()
    assert flight.begin({"kind": "fly", "position": [10.0, 2.0, 8.0], "duration": 6.0})
    assert not flight.advance()
    assert flight.t == pytest.approx(11.0)
    result = flight.finish("landed elsewhere")
    assert result.mission.on_loss == "continue"
    assert result.mission.lost_at[1] == 8.0
    assert not any(p.abandoned for p in result.phases)
    assert simulate(result.mission).position[-1] == pytest.approx(result.position[-1], abs=1e-6)


def test_a_live_flight_goes_on():
    """The pilot decides: a loss ends no phase flown live, and the record repeats what was flown."""
    pilot = Pilot(mission({"lost": [{"agent": 2, "time": 6.0}], "on_loss": "land"}))
    while pilot.t < 8.0:
        pilot.fly_tick()
    assert not pilot.flight.ending
    result = pilot.result()
    assert result.mission.on_loss == "continue"
    assert result.mission.lost_at[1] == 6.0
    assert np.isnan(result.slot_position[-1, 1]).all()
    np.testing.assert_allclose(result.position[-1, [0, 2, 3], 2], 5.0, atol=1e-3)


def test_reports_show_the_phases_flown(tmp_path):
    """Report, replay and figures name what followed the loss."""
    result = simulate(mission(LOST | {"on_loss": "land"}))
    rf.report(result, tmp_path / "report.html")
    rf.replay(result, tmp_path / "replay.html")
    for name in ("report.html", "replay.html"):
        assert "land (loss)" in (tmp_path / name).read_text(encoding="utf-8")


# -- links and quadrotors -----------------------------------------------------------------------------

NETWORK = {"delay": 0.02, "rate": 50.0}
CUT = NETWORK | {"lost": [{"between": [3, 1], "time": 8.0}]}


@pytest.mark.parametrize("on_loss", ["hold", "land"])
def test_quadrotors_hold_or_land(on_loss):
    """Vehicles with rotors do the same, with noise; the same seed flies the same bits."""
    noise = {"noise": {"position": 0.005, "velocity": 0.01, "seed": 2}}
    m = rotors(LOST | noise | {"on_loss": on_loss})
    result = simulate(m)
    assert names(result) == ["establish 1", "fly 2", "brake (loss)", f"{on_loss} (loss)"]
    assert max(jumps(result, 8.0, [0, 2, 3])) < 1e-9
    verdict = assess(result)
    assert verdict.passed, verdict.summary
    if on_loss == "land":
        np.testing.assert_allclose(result.position[-1, [0, 2, 3], 2], RADIUS + 0.05, atol=0.03)
    assert simulate(m).position.tobytes() == result.position.tobytes()


def test_a_lost_link_drops_its_edge():
    """No force acts along it after the loss; the others hold the shape, and the verdict says what happened."""
    result = simulate(rotors({}, network=CUT))
    whole = simulate(rotors({}, network=NETWORK))
    k = result.edges.tolist().index([0, 2])
    after = result.time > 8.0
    assert np.isfinite(result.multiplier[~after][:, k]).all()
    assert np.isnan(result.multiplier[after][:, k]).all()
    assert np.isfinite(np.delete(result.multiplier, k, axis=1)).all()
    verdict = assess(result)
    assert verdict.passed, verdict.summary
    assert (
        "the link 1-3 is lost at 8.00 s: after that, no edge joins agents 1 and 3" in verdict.notes
    )
    both = [
        r.position[np.isin(r.time, result.time) & np.isin(r.time, whole.time)]
        for r in (result, whole)
    ]
    np.testing.assert_allclose(*both, rtol=0, atol=0.02)
    assert np.abs(both[0] - both[1]).max() > 1e-6


def test_without_a_link_states_of_the_other_do_not_count(monkeypatch):
    """Once the link is lost, what one of the two does changes the force on the other through third ones alone.

    With two vehicles there is no third one: agent 1 flies the same bits, however agent 2 is blown about.
    """
    pair = {
        "agents": {"vehicle": "drone", "position": [[0.0, 0, 5], [4.0, 0, 5]]},
        "formations": {"square": {"shape": "line", "size": 4.0}},
    }
    cut = NETWORK | {"lost": [{"between": [1, 2], "time": 6.0}]}
    ways = []
    for strength in (0.0, 3.0):

        def push(t, r, v, strength=strength):
            force = np.zeros_like(r)
            force[1, 0] = strength * np.clip(t - 6.5, 0.0, 1.0)
            return force

        ways.append(simulate(rotors({}, network=cut, **pair), force=push))
    assert np.abs(ways[0].position[-1, 1] - ways[1].position[-1, 1]).max() > 0.1
    np.testing.assert_array_equal(ways[0].position[:, 0], ways[1].position[:, 0])


def test_without_a_link_a_common_lag_costs_no_force():
    """Vehicles that lag by 0.5 m, all alike, keep the forces that they had with the link."""
    cut, whole = (simulate(rotors({}, network=d, tracking={})) for d in (CUT, NETWORK))
    lag = np.linalg.norm(cut.position - cut.slot_position, axis=2)
    assert np.nanmax(lag) > 0.4
    forces = [r.extreme("constraint_force") for r in (cut, whole)]
    assert forces[0] is not None
    assert forces[1] is not None
    assert forces[0].value < 1.3 * forces[1].value


@pytest.mark.parametrize("on_loss", ["hold", "land"])
def test_the_loss_of_a_link_is_answered(on_loss):
    """As for a vehicle; all four go on together."""
    result = simulate(rotors({"on_loss": on_loss}, network=CUT))
    assert names(result)[1:] == ["fly 2", "brake (loss)", f"{on_loss} (loss)"]
    assert max(jumps(result, 8.0, [0, 1, 2, 3])) < 1e-9
    verdict = assess(result)
    assert verdict.passed, verdict.summary
    assert any(
        note.startswith("after the loss of the link 1-3 at 8.00 s") for note in verdict.notes
    )


# -- before the flight --------------------------------------------------------------------------------


@pytest.mark.parametrize("lost", [2, 3])
@pytest.mark.parametrize("into", ["another", "a ball", "a fence", "air of another"])
def test_a_lost_vehicle_is_where_others_would_lead_it_no_more(lost, into):
    """The slot of agent 2 in the landing is where no vehicle may be: check and flight fail unless agent 2 is lost."""
    slots = [[0.0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]]
    slots[1] = {"another": [0.3, 0, 0], "air of another": [0.4, 0, 0]}.get(into, [8, 0, 0])
    tables: dict[str, Any] = {}
    if into == "a ball":
        ball = {"kind": "sphere", "centre": [21.9, 7.1, 5.0], "radius": 1.0}
        tables["obstacles"] = [{"kind": "ground"}, ball]
    elif into == "a fence":
        corners = [[20.5, 5.5], [23, 5.5], [23, 8.5], [20.5, 8.5]]
        tables["fences"] = [{"kind": "exclusion", "polygon": corners}]
    elif into == "air of another":
        tables["limits"] = {"separation_below": 0.5}
    form = {"square": {"shape": "square", "size": 4.0}, "place": {"slots": slots}}
    d = {"lost": [{"agent": lost, "time": 9.0}], "on_loss": "land", "landing_formation": "place"}
    m = mission(
        d, formations=form, agents={"mass": 1.0, "radius": RADIUS, "position": START}, **tables
    )
    ahead, verdict = check(m, search=False), assess(simulate(m))
    assert ahead.passed == verdict.passed == (lost == 2), (ahead.remarks, verdict.summary)


def test_check_follows_the_way_after_the_loss():
    """It tells where the others stop and when they land, and finds a box that one would scrape."""
    m = mission(LOST | {"on_loss": "land"})
    found, flown = check(m, search=False), simulate(m)
    (told,) = [r.text for r in found.remarks if r.topic == "loss"]
    stop, down = flown.phases[2].t_end, flown.phases[3].t_end
    assert f"by {stop:.1f} s, and land by {down:.1f} s" in told
    assert found.passed
    x, y, _ = flown.position[-1, 0]
    box = {"kind": "box", "min": [x + 0.05, y - 0.2, 0.0], "max": [x + 0.4, y + 0.2, 1.0]}
    blocked = mission(LOST | {"on_loss": "land"}, obstacles=[{"kind": "ground"}, box])
    found = check(blocked, search=False)
    assert any(r.level == "fails" and "land (loss)" in r.text for r in found.remarks)
    assert not assess(simulate(blocked)).passed


def test_a_check_has_the_plan_and_what_is_flown_of_it():
    """The planned phases are all of the mission's; those flown end where the plan is left."""
    m = mission(LOST | {"on_loss": "land"})
    found = check(m, search=False)
    assert [x.phase for x in found.planned_phases] == [p.name for p in m.phases]
    assert found.planned_phases[-1].time[-1] == m.latest_end
    assert found.flown_phases[-1].time[-1] == m.abandons_at < m.latest_end


def test_check_tells_what_a_link_does_to_rigidity():
    """A square of all pairs that loses a diagonal keeps 5 edges, which in the plane are just enough."""
    found = check(rotors({}, network=CUT), search=False)
    (told,) = [r.text for r in found.remarks if r.topic == "loss"]
    assert told.startswith("without the lost links (1-3 at 8 s), 'square' has 5 of 6 edges: ")
    assert "5 of 6 independent distances" in told


@pytest.mark.parametrize(
    ("change", "key", "words"),
    [
        ({"disturbances": LOST | {"on_loss": "land"}, "obstacles": []}, "disturbances.on_loss", "needs a ground"),
        ({"phases": [*PHASES, {"kind": "land", "duration": 9.0}], "obstacles": []}, "phases[4].kind", "needs a ground"),
        ({"disturbances": LOST | {"hold_until": 30.0}}, "disturbances.hold_until", "has no effect"),
        ({"disturbances": LOST | {"on_loss": "hold", "hold_until": 8.0}}, "disturbances.hold_until", "is not after"),
        ({"disturbances": LOST | {"landing_formation": "square"}}, "disturbances.landing_formation", "has no effect"),
        (
            {"disturbances": LOST | {"on_loss": "land", "landing_formation": "sqare"}},
            "disturbances.landing_formation", "there is no such formation",
        ),
        (
            {"disturbances": LOST | {"on_loss": "hold"},
             "phases": [PHASES[0], {"kind": "hold", "control": "open", "duration": 9.0}]},
            "phases[2].control", "only tracked slots can brake",
        ),
        ({"network": CUT}, "network", "needs sampled control"),
        ({"phases": [*PHASES, {"kind": "brake", "settle": {}}]}, "phases[4].settle", "needs a time at which it ends"),
        (
            {"phases": [*PHASES, {"kind": "brake", "duration": 2.0, "travel": 3.0}]}, "phases[4].travel",
            "is longer than the phase",
        ),
        ({"phases": [*PHASES, {"kind": "land", "control": "open", "duration": 9.0}]}, "phases[4].control", "feedback"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(change, key, words):
    """Each in one sentence, with its key and a remedy."""
    with pytest.raises(MissionError) as refused:
        Mission.from_dict(data(LOST) | change)
    (finding,) = refused.value.findings
    assert finding.key == key
    assert words in finding.problem
    assert finding.remedy


@pytest.mark.parametrize(
    ("lost", "key", "words"),
    [
        ([{"between": [1, 5], "time": 8.0}], "network.lost[1].between", "no such agent"),
        ([{"between": [2, 2], "time": 8.0}], "network.lost[1].between", "to itself"),
        ([{"between": [1, 2], "time": 8.0}, {"between": [2, 1], "time": 9.0}], "network.lost[2].between",
         "lost twice"),
        ([{"between": [1, 2], "time": 88.0}], "network.lost[1].time", "is not before the end"),
    ],
)  # fmt: skip
def test_wrong_links_are_refused(lost, key, words):
    """Agents that do not exist, the same one twice, the same link twice, or too late."""
    with pytest.raises(MissionError) as refused:
        rotors({}, network=NETWORK | {"lost": lost})
    (finding,) = refused.value.findings
    assert finding.key == key
    assert words in finding.problem


def test_kinds_of_their_own():
    """A mission may brake and land by itself, from any speed."""
    phases = [
        PHASES[0],
        {
            "kind": "fly",
            "position": [20.0, 5.0, 10.0],
            "velocity": [2.0, 0.0, 0.0],
            "duration": 10.0,
        },
        {"kind": "brake", "duration": 4.0, "travel": 3.0},
        {"kind": "land", "duration": 20.0},
    ]
    result = simulate(mission({}, phases=phases))
    np.testing.assert_allclose(
        result.cm_reference[result.samples(2)][-1], [23.0, 5.0, 10.0], atol=1e-9
    )
    np.testing.assert_allclose(result.slot_position[-1, :, 2], RADIUS + 0.05, atol=1e-9)
    assert assess(result).passed


def test_what_vehicles_did_before_a_loss_still_counts():
    """The regulator's way asks most of rotors as it begins; who is lost later has been there."""
    whole, lossy = (simulate(rotors(x, smoothness="lqr")) for x in ({}, LOST))
    before, after = (x.phases[1].extremes for x in (whole, lossy))
    for name in ("rotor_force", "tilt", "tracking_error", "acceleration"):
        assert before[name].time < 8.0, name
        assert after[name] == before[name]
    flown = lossy.phases[1].t_end - lossy.phases[1].t_start
    assert 0.0 <= after["saturation"].value < 1.0
    assert flown == 10.0


@pytest.mark.parametrize(
    ("speed", "hits", "dwell"), [(2.0, False, None), (3.2, True, None), (3.2, True, 1.0)]
)
def test_check_tells_who_lands_on_a_lost_vehicle(speed, hits, dwell):
    """A vehicle that brakes and lands hits the wreck of the one ahead by the check if it does in flight.

    Behind a phase that ends by settling, where the wreck falls is an estimate: a note says that it may.
    """
    line = {"shape": "line", "size": 2.0}
    ends = {"duration": 4.0} if dwell is None else {"settle": {"dwell": dwell}}
    phases = [
        {"kind": "establish", "formation": "line", "attitude": "free"} | ends,
        {
            "kind": "fly",
            "position": [20.0, 0.0, 5.0],
            "velocity": [speed, 0.0, 0.0],
            "duration": 9.0,
        },
        {"kind": "fly", "position": [40.0, 0.0, 5.0], "duration": 9.0},
    ]
    m = mission(
        {"lost": [{"agent": 2, "time": 13.0}], "on_loss": "land"},
        agents={"mass": 1.0, "radius": RADIUS, "position": [[0.0, 0, 5], [2.0, 0, 5]]},
        formations={"line": line}, phases=phases,
    )  # fmt: skip
    remarks = [r for r in check(m, search=False).remarks if "'lost agent 2' at" in r.text]
    result = simulate(m)
    after = result.position[result.time > 13.0]
    assert (np.linalg.norm(after[:, 0] - after[:, 1], axis=1).min() < 2.0 * RADIUS) == hits
    words = ("fails", "agent 1 hits ") if dwell is None else ("note", "agent 1 may hit ")
    assert [(r.level, r.text.partition("'")[0]) for r in remarks] == [words] * hits
    assert assess(result).passed != hits
