"""Missions flown by vehicles: shipped ones and their promises, sampled points against continuous ones, bits."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from sample_missions import three_quadrotors

import rigidfleet as rf
from rigidfleet._common.text import percent_text
from rigidfleet.kernel import control, references
from rigidfleet.kernel.problem import workspace
from rigidfleet.math import attitude as att
from rigidfleet.mission import Mission, load_mission
from rigidfleet.planning.vehicles import TickTables, YawTurn, sampled_flight
from rigidfleet.result import Result


def changed(name, **tables):
    """A shipped mission with other tables; a table of None is removed."""
    data = load_mission(name).to_dict()
    for key, table in tables.items():
        if table is None:
            data.pop(key, None)
        elif isinstance(table, dict) and isinstance(data.get(key), dict):
            data[key] = data[key] | table
        else:
            data[key] = table
    return rf.Mission.from_dict(data)


def errors(result):
    """Greatest position error, and greatest shape error over all pairs [m], while slots are tracked."""
    off = np.linalg.norm(result.position - result.slot_position, axis=2)
    i, j = np.triu_indices(result.n_agents, 1)
    shape = abs(
        np.linalg.norm(result.position[:, i] - result.position[:, j], axis=2)
        - np.linalg.norm(result.slot_position[:, i] - result.slot_position[:, j], axis=2)
    )
    return float(np.nanmax(off)), float(np.nanmax(shape))


@pytest.fixture(scope="module")
def passage():
    return rf.simulate("passage-quadrotors")


# -- shipped missions -------------------------------------------------------------------------------


def test_the_papers_vehicle_flies_the_passage(passage):
    """Four rotors of 5.9 N fly the narrow passage: to 5 cm, with 1 cm of shape, and half of each rotor left."""
    position, shape = errors(passage)
    assert position < 0.05
    assert shape < 0.01
    verdict = rf.assess(passage)
    assert verdict.passed
    x = passage.extreme("rotor_force")
    assert x is not None
    assert x.value < 0.55 * 5.9
    told = {check.check: check for check in verdict.checks}
    assert told["rotor_force"].limit == pytest.approx(5.9)
    assert told["saturation"].worst == 0.0
    assert "rotors peak at" in verdict.summary


def test_what_check_foresees_is_what_rotors_give(passage):
    """The rotor force that the check derives from the plan is that of the flight, to a few per cent."""
    found = rf.check("passage-quadrotors", search=False)
    assert found.vehicles is not None
    x = passage.extreme("rotor_force")
    assert x is not None
    assert found.vehicles.rotor_force[0] == pytest.approx(x.value, rel=0.05)
    tilt = passage.extreme("tilt")
    assert tilt is not None
    assert found.vehicles.tilt[0] == pytest.approx(math.degrees(tilt.value), rel=0.05)
    assert found.vehicles.jump is not None
    assert found.vehicles.jump[0] < 1e-6


def test_a_regulators_way_jumps():
    """On the paper's regulator legs, the check tells the jump; the flight asks for more than rotors give."""
    mission = changed("passage-quadrotors", smoothness="lqr")
    found = rf.check(mission, search=False)
    (remark,) = (r for r in found.remarks if r.topic == "jumps")
    assert "jumps by 2.47 m/s² (14.1 deg of tilt) at 65.00 s" in remark.text
    x = rf.simulate(mission).extreme("saturation")
    assert x is not None
    assert x.value > 0.01


@pytest.mark.long
def test_the_cube_passes_with_px4s_vehicle():
    """Eight vehicles with slow motors: to 6 cm, with 1 cm of shape."""
    result = rf.simulate("cube-passage-quadrotors")
    position, shape = errors(result)
    assert position < 0.06
    assert shape < 0.01
    assert rf.assess(result).passed


NOISE = {"position": 0.01, "velocity": 0.02, "rate": 100.0, "delay": 0.02}


@pytest.mark.parametrize("seed", [1, 2])
def test_noise_and_delay_leave_three_centimetres(seed):
    """With 1 cm and 2 cm/s of noise and 20 ms of delay, the shape keeps within 3 cm."""
    mission = changed("passage-quadrotors", disturbances={"noise": NOISE | {"seed": seed}})
    assert errors(rf.simulate(mission))[1] < 0.03


def test_old_measurements_are_compared_with_the_reference_of_their_time():
    """Without that, the fold into a line is off by the way of 20 ms: five times as much."""
    late = {"noise": {"delay": 0.02, "rate": 500.0}}
    with_time = errors(rf.simulate(changed("passage-quadrotors", disturbances=late)))[1]
    without = changed(
        "passage-quadrotors", disturbances=late, autopilot={"delay_compensation": False}
    )
    assert errors(rf.simulate(without))[1] > 4.0 * with_time


@pytest.mark.parametrize("name", ["crazyflies", "downwash-cube"])
def test_shipped_missions_pass(name):
    """Crazyflies in a room, and a cube in its own downwash, pass their verdict."""
    assert rf.assess(rf.simulate(name)).passed


def test_fifty_milliseconds_late():
    """As the check foresees, slots survive 50 ms and edges with these gains do not; with slower ones they do."""
    found = rf.check("delayed", search=False)
    (remark,) = (r for r in found.remarks if r.level == "fails")
    assert "unstable with the vehicles' lag and delay" in remark.text
    verdict = rf.assess(rf.simulate("delayed"))
    failed = {check.phase for check in verdict.checks if not check.passed}
    assert failed == {"with edges"}
    p = 2.0
    slower = {"alpha": 1.5 * p, "beta": math.sqrt(3.0) * p, "gamma": p**3}
    mission = changed("delayed", constraint=slower)
    assert rf.check(mission, search=False).passed
    assert rf.assess(rf.simulate(mission)).passed


# -- properties -------------------------------------------------------------------------------------


def test_sampled_points_fly_as_continuous_ones():
    """Points with sampled control differ from those of continuous laws by what falls with the rate."""
    smooth = changed("narrow-passage", smoothness="jerk")
    whole = rf.simulate(smooth)
    off = []
    for rate in (100.0, 400.0):
        data = smooth.to_dict() | {
            "vehicles": {"p": {"model": "point", "mass": 1.0, "thrust_limit": 23.6}},
            "autopilot": {"rate": rate, "formation_rate": rate},
        }
        kept = {k: v for k, v in data["agents"].items() if k not in ("mass", "thrust_limit")}
        flown = rf.simulate(rf.Mission.from_dict(data | {"agents": kept | {"vehicle": "p"}}))
        at = np.searchsorted(whole.time, flown.time[::20]).clip(max=len(whole.time) - 1)
        same = whole.time[at] == flown.time[::20]
        off.append(np.abs(whole.position[at] - flown.position[::20])[same].max())
    assert off[0] < 0.05
    assert off[1] < 0.4 * off[0]


def short(**tables):
    """Six seconds of three quadrotors that establish a triangle and fly."""
    fly = {"kind": "fly", "position": [6.0, 5.0, 4.0], "until": 6.0}
    return rf.Mission.from_dict(three_quadrotors(fly) | tables)


NOISY = {
    "noise": NOISE | {"dropped": 0.1},
    "wind": [3.0, 1.0, 0.0],
    "mass_error": [0.02, 0.0, -0.02],
}
NETWORK = {"delay": 0.03, "rate": 50.0, "loss": 0.2, "jitter": 0.02}


@pytest.mark.parametrize(
    "tables", [{}, {"disturbances": NOISY}, {"disturbances": NOISY, "network": NETWORK}]
)
def test_flights_repeat_bit_for_bit(tables):
    """The same mission flies the same bits; other samples are those of the same flight."""
    first, again = (rf.simulate(short(**tables)) for _ in range(2))
    assert first.position.tobytes() == again.position.tobytes()
    coarse = rf.simulate(short(**tables, output_step=0.5))
    at = np.searchsorted(first.time, coarse.time)
    np.testing.assert_array_equal(first.position[at], coarse.position)
    assert coarse.extreme("rotor_force") == first.extreme("rotor_force")


def test_a_flight_step_by_step_is_the_same():
    """Stops divide a step of the integrator at most."""
    flight = rf.Flight(short())
    while flight.begin():
        while flight.advance(0.37):
            flight.observe()
    result, whole = flight.finish(), rf.simulate(short())
    at = np.isin(result.time, whole.time)
    np.testing.assert_allclose(
        result.position[at], whole.position[np.isin(whole.time, result.time)], atol=1e-9
    )


def test_a_result_keeps_its_vehicles(tmp_path):
    """Attitudes, rotors and saturation are saved, and the flight repeats from its result."""
    result = rf.simulate(short())
    result.save(tmp_path / "short.nc")
    loaded = Result.load(tmp_path / "short.nc")
    for name in ("vehicle_attitude", "vehicle_rates", "rotor_force", "saturated"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(result, name))
    assert rf.assess(loaded).passed == rf.assess(result).passed
    again = rf.simulate(loaded.mission)
    assert again.position.tobytes() == loaded.position.tobytes()
    np.testing.assert_array_equal(again.rotor_force, loaded.rotor_force)


def test_newton_holds_in_the_record():
    """Mass times acceleration is the rotors' thrust along the vehicle's axis and all external forces."""
    result = rf.simulate(short(disturbances={"wind": [3.0, 1.0, 0.0]}))
    assert result.rotor_force is not None
    assert result.vehicle_attitude is not None
    w, x, y, z = np.moveaxis(result.vehicle_attitude, -1, 0)
    up = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    thrust = result.rotor_force.sum(axis=2)
    np.testing.assert_allclose(thrust, result.thrust, rtol=1e-12)
    np.testing.assert_allclose(
        result.acceleration, result.external_force + thrust[..., None] * up, atol=1e-9
    )


@pytest.mark.parametrize("lost", [[], [{"agent": 2, "time": 3.5}]])
def test_each_step_of_vehicles_counts_once(lost):
    """A flight has as many steps as fit into it, whatever its phases and losses, with four evaluations each."""
    mission = short(disturbances={"lost": lost})
    result = rf.simulate(mission)
    steps = round(float(result.time[-1]) / sampled_flight(mission).h)
    assert result.statistics["steps"] == steps
    assert result.statistics["evaluations"] == 4 * steps


def test_a_lost_vehicle_falls_and_the_others_fly_on():
    """Without thrust a vehicle falls; the rest of the formation keeps its shape."""
    result = rf.simulate(
        short(
            disturbances={"lost": [{"agent": 2, "time": 3.5}]},
            obstacles=[{"kind": "ground", "height": 0.0}],
        )
    )
    assert result.complete
    assert result.position[-1, 1, 2] < 0.5
    assert np.abs(result.position[-1, [0, 2], 2] - 4.0).max() < 0.1


def test_a_controller_flies_vehicles():
    """A user's force replaces the tracking; it sees what is measured."""

    def fly(seen):
        e = seen.position - seen.reference_position
        e_dot = seen.velocity - seen.reference_velocity
        a = seen.reference_acceleration - 2.0 * e - 2.8 * e_dot
        return seen.masses[:, None] * (a + [0.0, 0.0, seen.gravity])

    result = rf.simulate(short(), controller=fly, rate=100.0)
    own = rf.simulate(short(tracking={}))  # without drag, which the controller does not know
    assert result.complete
    assert errors(result)[0] == pytest.approx(errors(own)[0], rel=0.1)


def hover(seen, **changes):
    """Thrust and attitude that lead to a place level, each vehicle by itself."""
    e = seen.position - seen.reference_position
    a = seen.reference_acceleration - e - 2.0 * (seen.velocity - seen.reference_velocity)
    force = seen.masses[:, None] * (a + [0.0, 0.0, seen.gravity])
    size = np.linalg.norm(force, axis=1)
    # The least rotation from upright to the force
    q = np.concatenate([(size + force[:, 2])[:, None], np.cross([0.0, 0.0, 1.0], force)], axis=1)
    return rf.AttitudeCommand(**({"thrust": size, "attitude": q} | changes))


def test_a_controller_may_command_attitudes():
    """Thrust and attitude of a controller lead vehicles as forces do; it knows their attitudes."""
    seen = []

    def fly(observation):
        seen.append(observation)
        return hover(observation)

    result = rf.simulate(short(), controller=fly, rate=100.0)
    assert result.complete
    assert errors(result)[0] < 0.4  # without feedforward of drag
    assert result.vehicle_attitude is not None
    assert seen[0].attitude.shape == (3, 4)
    np.testing.assert_allclose(np.linalg.norm(seen[-1].attitude, axis=1), 1.0)


def test_a_controller_may_command_rotors():
    """Speeds of rotors are those that the rotors take; four alike at hover keep a vehicle where it is."""
    speed = math.sqrt(9.81 / 4 / 5.9e-6)
    phases = [{"kind": "establish", "formation": "triangle", "blend": 0.5, "until": 1.0}]
    result = rf.simulate(
        short(phases=phases), controller=lambda _: rf.RotorCommand(np.full((3, 4), speed))
    )
    assert result.rotor_force is not None
    np.testing.assert_allclose(result.rotor_force, 9.81 / 4, rtol=1e-9)
    np.testing.assert_allclose(
        result.position, np.tile(result.position[0], (len(result.time), 1, 1)), atol=1e-9
    )


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (lambda seen: hover(seen, thrust=np.ones(2)), "returned an AttitudeCommand .* whose thrust is not an array"),
        (lambda seen: hover(seen, attitude=np.zeros((3, 4))), "attitude of norm zero"),
        (lambda _: rf.RotorCommand(np.full((3, 4), np.nan)), "returned a RotorCommand .* whose speed is not"),
        (lambda _: rf.RotorCommand("fast"), "RotorCommand .* whose speed is not"),
    ],
)  # fmt: skip
def test_commands_that_are_wrong(command, words):
    """A command of the wrong form is one error that names it."""
    with pytest.raises(rf.FlightError, match=words):
        rf.simulate(short(), controller=command)


def test_points_take_forces_alone():
    """Point masses have no attitude to command."""
    with pytest.raises(rf.FlightError, match="point masses do not take"):
        rf.simulate("narrow-passage", controller=lambda _: rf.RotorCommand(np.ones((3, 4))))


def test_an_external_force_pushes_vehicles():
    """A user's force acts on the vehicles themselves."""
    still = rf.simulate(short())
    pushed = rf.simulate(short(), force=lambda t, r, v: np.full_like(r, 0.3) * [1.0, 0.0, 0.0])
    assert (pushed.position[-1] - still.position[-1])[:, 0].min() > 0.02


def test_bits_do_not_hang_on_wind_that_is_not_there():
    """Downwash and ground effect act only when they are asked for, and then they do."""
    still = rf.simulate(short())
    ground = [{"kind": "ground", "height": 2.7}]
    near = rf.simulate(short(obstacles=ground, disturbances={"ground_effect": True}))
    far = rf.simulate(short(obstacles=ground))
    assert far.position.tobytes() == still.position.tobytes()
    assert np.abs(near.position - still.position).max() > 1e-4


def test_a_record_of_rotors_that_lies_is_found():
    """Samples above the recorded peak, and thrust that is not the rotors', are judged as they are."""
    result = rf.simulate(short())
    assert result.rotor_force is not None
    result.rotor_force[50, 1, 2] = 7.0
    found = {c.check: c for c in rf.assess(result).checks}
    assert not found["rotor_force"].passed
    assert found["rotor_force"].worst == pytest.approx(7.0)
    assert not found["record"].passed


def test_points_have_a_path_in_tables_and_no_attitude():
    """States are measured about the slots that the kernel flies; nothing is made that only an attitude reads."""
    mission = load_mission("moving-obstacles")
    flight = rf.Flight(mission)
    while flight.begin() and flight.plan.phase.kind != "fly":
        flight.advance()
    problem, first = flight.plan.problem, round(flight.t * mission.autopilot.rate)
    sampled = sampled_flight(mission)
    tables, turn = (
        TickTables(mission, sampled),
        YawTurn(flight.t, np.zeros((2, 8)), np.zeros((2, 8))),
    )
    tables.switch_path(problem, first, sampled.tables)
    made = tables.tables_for(first, first + 600, problem, turn)
    assert not any(map(len, (made.yaw, made.jerk, made.snap)))
    w = workspace(8, 0)
    for row in (0, 250, 599):
        t = (first + row) / mission.autopilot.rate
        references.blend_slots(t, problem.reference, w.p, w.p_dot, w.p_ddot)
        control.reference_motion(t, problem.motion, w)
        control.desired_agents(w)
        np.testing.assert_allclose(made.path[row], np.hstack([w.r_ref, w.v_ref]), atol=1e-9)
    assert np.ptp(made.path[:, :, 0], axis=0).min() > 0.1  # they move
    before = tables.switch_path(problem, first + 250, made)
    assert np.array_equal(before, made.path[250])


def test_yaw_along_the_way_goes_on_from_table_to_table():
    """Tables made one after the other hold the yaw of one table for the whole phase, on the same grid."""
    mission = changed("passage-quadrotors", yaw={"kind": "along"})
    flight = rf.Flight(mission)
    while flight.begin() and flight.plan.phase.name != "WP2":
        flight.advance()
    problem, start = flight.plan.problem, flight.plan.start
    first = round(start * mission.autopilot.rate)
    turn = YawTurn(start, np.array([[0.3, -0.2, 1.0], [0, 0, 0]]), np.zeros((2, 3)))
    sampled = sampled_flight(mission)
    whole = TickTables(mission, sampled).tables_for(first, first + 1500, problem, turn).yaw
    tables, ends = TickTables(mission, sampled), first + np.array([0, 7, 403, 1001, 1500])
    pieces = [tables.tables_for(a, b, problem, turn).yaw for a, b in itertools.pairwise(ends)]
    np.testing.assert_allclose(
        np.concatenate(pieces), whole, rtol=0, atol=1e-9
    )  # of an integration
    assert np.ptp(whole[:, :, 0], axis=0).min() > 0.1


def _legs(model: str, *legs: dict[str, Any], **tables: Any) -> Mission:
    """Three vehicles that take a triangle of 4 m and fly some phases."""
    begin = {"kind": "establish", "formation": "triangle", "duration": 5.0}
    return Mission.from_dict(
        {
            "schema_version": 1, "name": "legs", "smoothness": "jerk", "vehicles": {"one": {"model": model}},
            "agents": {"vehicle": "one", "position": [[0, 0, 5], [4, 0, 5], [2, 3.5, 5]]},
            "tracking": {"drag_feedforward": True}, "formations": {"triangle": {"shape": "triangle", "size": 4.0}},
            "phases": [begin, *legs], **tables,
        }
    )  # fmt: skip


@pytest.mark.parametrize(
    "yaw", [{"kind": "along"}, {"kind": "fixed", "yaw_deg": 170.0}, {"kind": "formation"}]
)
def test_check_foresees_the_rotors_of_every_yaw(yaw):
    """Yaw costs rotor force: the check turns the vehicles as the flight does, also from the yaw of the phase before."""
    way = {"kind": "fly", "position": [15, 5, 8], "yaw_deg": 60.0, "duration": 8.0}
    mission = _legs("px4-sih", way, {"kind": "hold", "duration": 2.0}, yaw=yaw)
    found = rf.check(mission, search=False).vehicles
    flown = rf.simulate(mission).extreme("rotor_force")
    assert found is not None
    assert flown is not None
    assert found.rotor_force[0] == pytest.approx(flown.value, rel=0.02)
    assert found.beyond is None


@pytest.mark.parametrize(
    ("legs", "tables", "words"),
    [
        (
            [{"kind": "fly", "position": [15, 5, 8], "yaw_deg": 60.0, "duration": 8.0}],
            {"yaw": {"kind": "towards", "point": [7, 3, 0]}},
            "rotor forces of",
        ),
        ([{"kind": "fly", "position": [15, 5, 8], "duration": 3.2}], {}, "deg of tilt (limit 45 deg)"),
    ],
)  # fmt: skip
def test_check_tells_what_vehicles_cannot_give(legs, tables, words):
    """A vehicle passes a point that it looks at, or has to tilt more than it may: the check and the flight fail."""
    mission = _legs("px4-sih", *legs, **tables)
    found = rf.check(mission, search=False)
    (remark,) = (r for r in found.remarks if r.topic == "rotors")
    assert remark.level == "fails"
    assert words in remark.text
    verdict = rf.assess(rf.simulate(mission))
    saturation = next(c for c in verdict.checks if c.check == "saturation")
    assert not saturation.passed


@pytest.mark.parametrize("integral", [0.0, 1.0])
def test_check_knows_the_integral_of_the_tracking(integral):
    """A steady wind holds vehicles off their slots, unless the tracking has an integral."""
    mission = _legs(
        "paper",
        {"kind": "hold", "duration": 30.0},
        tracking={"integral": integral},
        disturbances={"wind": [2.0, 0.0, 0.0]},
    )
    found = rf.check(mission, search=False)
    assert found.disturbed is not None
    flown = rf.simulate(mission)
    off = np.linalg.norm(flown.position - flown.slot_position, axis=2)[-1].max()
    assert found.disturbed.offset[0] == pytest.approx(off, rel=0.05, abs=2e-3)
    assert any("no integral" in r.text for r in found.remarks) == (integral == 0.0)


@pytest.mark.parametrize(
    ("share", "words"), [(1.0, "100 %"), (0.5714, "57 %"), (0.0996, "10 %"), (0.00251, "0.25 %")]
)
def test_shares_in_per_cent(share, words):
    """Shares are told without powers of ten."""
    assert percent_text(share) == words


@pytest.mark.parametrize("kind", ["formation", "fixed", "along"])
def test_the_yaw_recorded_is_the_one_that_vehicles_are_asked_for(kind):
    """Begun at another yaw, vehicles turn from there without a jump, and the record has this turn."""
    result = rf.simulate(short(yaw={"kind": kind}, body_frame={"yaw_deg": 40.0}))
    assert result.vehicle_attitude is not None
    assert result.yaw is not None
    T = att.dcm_from_quaternion(result.vehicle_attitude)
    known = np.isfinite(result.yaw)
    flown = np.arctan2(T[..., 0, 1], T[..., 0, 0])
    off = np.degrees(np.abs((flown - result.yaw + np.pi) % (2.0 * np.pi) - np.pi))
    assert known.any()
    assert off[known].max() < 3.0
    first = np.argmax(known[:, 0])
    assert np.degrees(result.yaw[first]) == pytest.approx(40.0, abs=1e-6)


@pytest.mark.parametrize("inertia", [1e-9, 1e-6])
def test_what_grows_beyond_all_bounds_is_judged_up_to_there(inertia):
    """A vehicle that its own attitude control tears apart has an incomplete flight, and finite numbers."""
    vehicles = {"drone": {"model": "paper", "inertia": [inertia] * 3}}
    verdict = rf.assess(rf.simulate(short(vehicles=vehicles, obstacles=[{"kind": "ground"}])))
    failed = {c.check: c for c in verdict.checks if not c.passed}
    assert "complete" in failed
    assert "record" not in failed
    assert all(c.worst is None or math.isfinite(c.worst) for c in verdict.checks)
    assert "inf" not in " ".join(c.message for c in verdict.checks)
