"""Controllers of users on vehicles: what they see and when, where they are called, and forces beside them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from vehicle_samples import rotorpy, rotorpy_derivative

import rigidfleet as rf

NOISE = {"position": 0.005, "velocity": 0.01, "delay": 0.03, "rate": 100.0, "dropped": 0.1}
NETWORK = {"delay": 0.03, "rate": 50.0}
SMALLER = {"shape": "triangle", "size": 3.5, "count": 3, "centre": [3.0, 5.0, 3.0]}
TRIANGLE = {"triangle": {"shape": "triangle", "size": 4.0}}


def mission(model: str = "paper", /, **tables: Any) -> rf.Mission:
    """Three vehicles that form a triangle for 2 s and fly for 2 s."""
    vehicle = {"model": model} | ({"mass": 1.0} if model == "point" else {})
    data = {
        "schema_version": 1, "name": "own", "smoothness": "jerk", "vehicles": {"v": vehicle}, "formations": TRIANGLE,
        "agents": {"vehicle": "v", "position": SMALLER},
        "phases": [
            {"kind": "establish", "formation": "triangle", "blend": 1.5, "until": 2.0},
            {"kind": "fly", "position": [4.0, 5.0, 3.5], "until": 4.0},
        ],
    }  # fmt: skip
    return rf.Mission.from_dict(data | tables)


def built_in(o: rf.Observation) -> np.ndarray:
    """The built-in law of default weights: k1 = 2, k2 = sqrt(8)."""
    a = o.reference_acceleration - 2.0 * (o.position - o.reference_position)
    a = a - np.sqrt(8.0) * (o.velocity - o.reference_velocity) + [0.0, 0.0, o.gravity]
    return o.masses[:, None] * a


class Watched:
    """A controller that keeps what it saw."""

    def __init__(self, law: Any = built_in) -> None:
        self.law, self.seen = law, []

    def __call__(self, o: rf.Observation) -> Any:
        self.seen.append(o)
        return self.law(o)


UNEVEN = {
    "phases": [
        {"kind": "establish", "formation": "triangle", "blend": 1.5, "until": 1.5037},
        {"kind": "fly", "position": [4.0, 5.0, 3.2], "until": 3.0011},
        {"kind": "hold", "until": 3.7},
    ]
}
SLOW = {"autopilot": {"rate": 50.0, "formation_rate": 10.0}}
LOST = {"lost": [{"agent": 2, "time": 2.6043}], "on_loss": "continue"}


# -- what is seen ------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["paper", "point"])
@pytest.mark.parametrize(
    "tables",
    [
        {},
        UNEVEN,
        SLOW,
        {"disturbances": {"noise": NOISE, "wind": [2.0, 1.0, 0.0], "mass_error": [0.02, 0, -0.02]}},
        UNEVEN | {"disturbances": LOST | {"noise": NOISE}},
        {"disturbances": {"noise": NOISE}, "autopilot": {"delay_compensation": False}},
    ],
    ids=["exact", "uneven", "slow", "noise", "lost", "uncompensated"],
)
def test_the_built_in_law_as_a_controller_flies_the_same_way(model, tables):
    """A user who writes down the built-in law gets its flight, to 1e-10 m: what it sees is what that law knows.

    Also where phases begin and vehicles are lost between ticks of the formation's laws.
    """
    m = mission(model, **tables)
    law = rf.simulate(m)
    own = rf.simulate(m, controller=built_in, rate=m.autopilot.formation_rate)
    np.testing.assert_allclose(own.time, law.time, rtol=0, atol=1e-12)
    np.testing.assert_allclose(own.position, law.position, rtol=0, atol=1e-10)


@pytest.mark.parametrize("rate", [500.0, 100.0, 30.0, 7.0])
def test_without_noise_a_controller_sees_the_state_of_now(rate):
    """At each call, positions, velocities and attitudes are those that the record has of that time."""
    watched = Watched()
    rf.simulate(mission(), controller=watched, rate=rate)
    times = np.unique([o.t for o in watched.seen])
    record = rf.simulate(mission(), controller=built_in, rate=rate, times=times[1:])
    assert len(times) == len(watched.seen) >= int(4 * rate)
    for name, recorded in (
        ("position", record.position), ("velocity", record.velocity),
        ("attitude", record.vehicle_attitude), ("reference_position", record.slot_position),
    ):  # fmt: skip
        assert recorded is not None
        seen = np.array([getattr(o, name) for o in watched.seen[1:]])
        np.testing.assert_allclose(seen, recorded, rtol=0, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("compensated", [True, False])
@pytest.mark.parametrize("rate", [100.0, 25.0])
def test_with_noise_a_controller_sees_what_the_law_knows_at_that_tick(rate, compensated):
    """It is what the record says is known from that tick on, measured with noise, late, or not at all."""
    tables = {"disturbances": {"noise": NOISE}, "autopilot": {"delay_compensation": compensated}}
    watched = Watched()
    rf.simulate(mission(**tables), controller=watched, rate=rate)
    times = np.array([o.t for o in watched.seen])
    record = rf.simulate(mission(**tables), controller=built_in, rate=rate, times=times + 1e-3)
    for name in ("position", "velocity"):
        seen = np.array([getattr(o, name) for o in watched.seen])
        known = getattr(record, f"measured_{name}")
        np.testing.assert_allclose(seen, known, rtol=0, atol=1e-12, err_msg=name)
    off = np.linalg.norm(np.array([o.position for o in watched.seen]) - record.position, axis=2)
    assert 0.006 < np.sqrt((off**2).mean()) < 0.05  # noise, and 30 ms of way where that counts


@pytest.mark.parametrize("tables", [{}, UNEVEN], ids=["even", "uneven"])
def test_a_flight_observes_the_state_of_now(tables):
    """`Flight.observe` gives the state of its time at every stop, also between two ticks, and before the first one."""
    flight, seen = rf.Flight(mission(**tables)), []
    while flight.begin():
        seen.append(flight.observe())
        while flight.advance(0.1237):
            seen.append(flight.observe())
    result = flight.finish()
    for o in seen[1:]:
        assert o.t == pytest.approx(result.time[np.abs(result.time - o.t).argmin()], abs=1e-9)
        k = np.abs(result.time - o.t).argmin()
        np.testing.assert_allclose(o.position, result.position[k], rtol=0, atol=1e-9)
        np.testing.assert_allclose(o.velocity, result.velocity[k], rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    "tables",
    [
        {"disturbances": {"noise": NOISE}},
        {"network": NETWORK | {"lost": [{"between": [1, 2], "time": 1.0}]}},
        {
            "network": NETWORK | {"lost": [{"between": [1, 2], "time": 1.0}]},
            "autopilot": {"delay_compensation": False},
        },
    ],
    ids=["noise", "lost link", "uncompensated"],
)
def test_to_observe_changes_no_bit(tables):
    """A flight with stops at ticks that is looked at is that without, also where a link is lost."""
    flight = rf.Flight(mission(**tables))
    while flight.begin():
        flight.observe()
        while flight.advance(0.05):
            flight.observe()
    whole = rf.simulate(mission(**tables))
    assert flight.finish().position[-1].tobytes() == whole.position[-1].tobytes()


def circle(t: float) -> dict[str, Any]:
    """A circle of 1 m at .2 Hz, 2 m high, as RotorPy's laws take it."""
    w = 0.4 * np.pi
    c, s = np.cos(w * t), np.sin(w * t)
    return {
        "x": np.array([c, s, 2.0]), "x_dot": w * np.array([-s, c, 0.0]), "x_ddot": -w * w * np.array([c, s, 0.0]),
        "yaw": 0.0, "yaw_dot": 0.0,
    }  # fmt: skip


@pytest.mark.long
def test_rotorpys_loop_is_flown_as_rotorpy_flies_it():
    """RotorPy's law on its Crazyflie, at 100 Hz on a circle of 1 m: the same path to 1e-9 m, integrated by DOP853."""
    pytest.importorskip("rotorpy")
    from rotorpy.controllers.quadrotor_control import SE3Control
    from rotorpy.vehicles.crazyflie_params import quad_params as given
    from scipy.integrate import solve_ivp

    law, model = SE3Control(given), rotorpy("crazyflie")

    def speeds(t: float, r: Any, v: Any, q: Any, omega: Any) -> np.ndarray:
        state = {"x": r, "v": v, "q": np.roll(q, -1), "w": omega}
        return np.clip(law.update(t, state, circle(t))["cmd_motor_speeds"], 0.0, 2500.0)

    def own(o: rf.Observation) -> rf.RotorCommand:
        assert o.attitude is not None
        assert o.rates is not None
        x = o.position[0], o.velocity[0], o.attitude[0], o.rates[0]
        return rf.RotorCommand(speeds(o.t, *x)[None])

    vehicle = {
        "model": "crazyflie", "mass": given["mass"], "inertia": [given[f"I{q}{q}"] for q in "xyz"], "arm": 0.043,
        "thrust_coefficient": given["k_eta"], "torque_coefficient": given["k_m"], "rotor_speed": [0.0, 2500.0],
        "motor_time": [given["tau_m"]] * 2, "rotor_drag": given["k_d"], "rotor_inflow": given["k_z"],
        "rotor_lift": 0.0, "body_drag": [0.0, 0.0, 0.0],
    }  # fmt: skip
    m = rf.Mission.from_dict({
        "schema_version": 1, "name": "circle", "output_step": 0.01, "vehicles": {"v": vehicle},
        "agents": {"vehicle": "v", "position": [[1.0, 0.0, 2.0]]},
        "autopilot": {"rate": 100.0, "formation_rate": 100.0, "step": 2.5e-4},
        "phases": [{"kind": "hold", "duration": 5.0}],
    })  # fmt: skip
    result = rf.simulate(m, controller=own, rate=100.0)
    hover = np.sqrt(given["mass"] * 9.81 / 4 / given["k_eta"])
    S = np.concatenate([[1, 0, 2], np.zeros(3), [1], np.zeros(6), np.full(4, hover)])
    path = [S[:3]]
    for k in range(500):
        command = speeds(0.01 * k, S[:3], S[3:6], S[6:10], S[10:13])
        S = solve_ivp(
            lambda _, y, command=command: rotorpy_derivative(model, y, command, np.zeros(3)), (0.0, 0.01), S,
            method="DOP853", rtol=1e-11, atol=1e-12,
        ).y[:, -1]  # fmt: skip
        S[6:10] /= np.linalg.norm(S[6:10])
        path.append(S[:3])
    np.testing.assert_allclose(result.position[:, 0], path, rtol=0, atol=1e-9)


# -- where it is called ------------------------------------------------------------------------------

STAND = {"mass": 1.0, "position": {"shape": "triangle", "size": 4.0, "count": 3}}
OPEN = [
    {"kind": "establish", "formation": "triangle", "blend": 2.0, "duration": 3.0, "control": "open"}
]


def points(**tables: Any) -> rf.Mission:
    """Three point masses in a triangle."""
    data = {"schema_version": 1, "name": "points", "agents": STAND, "formations": TRIANGLE}
    return rf.Mission.from_dict(data | tables)


def fly(**keys: Any) -> dict[str, Any]:
    return {"kind": "fly", "position": [1.0, 0.0, 0.0], "duration": 3.0} | keys


@pytest.mark.parametrize(
    ("m", "phase"),
    [
        (lambda: points(architecture="body", phases=[OPEN[0], fly()]), "fly 2"),
        (lambda: points(phases=OPEN), "establish 1"),
        (lambda: points(phases=[{"kind": "hold", "duration": 1.0, "control": "open"}]), "hold 1"),
        (lambda: mission(phases=OPEN), "establish 1"),
        (lambda: mission("point", phases=OPEN), "establish 1"),
    ],
    ids=["body", "open", "open hold", "vehicles", "sampled points"],
)
def test_a_controller_that_no_phase_calls_is_refused(m, phase):
    """A mission without tracked slots is not flown under a law that the user did not write."""
    watched = Watched()
    with pytest.raises(rf.FlightError, match=f"never be called.*'{phase}'.*control = 'tracking'"):
        rf.simulate(m(), controller=watched)
    assert not watched.seen
    assert rf.simulate(m()).complete


@pytest.mark.parametrize("law", [built_in, "attitude", "rotors"])
def test_the_verdict_names_phases_under_another_law(law, tmp_path):
    """Beside its word, the verdict says where the controller was not called: in words, JSON, report and saved file."""
    if law == "attitude":

        def law(o):
            f = built_in(o)
            return rf.AttitudeCommand(f[:, 2], np.tile([1.0, 0, 0, 0], (3, 1)))
    elif law == "rotors":

        def law(o):
            return rf.RotorCommand(np.full((3, 4), np.sqrt(o.gravity / 4 / 5.9e-6)))

    m = mission(phases=[OPEN[0], fly(position=[3.0, 5.0, 3.0])])
    watched = Watched(law)
    result = rf.simulate(m, controller=watched)
    assert {o.phase for o in watched.seen} == {"fly 2"}
    assert [p.controller for p in result.phases] == [False, True]
    words = "controller was not called in 'establish 1', as no slots are tracked there"
    result.save(tmp_path / "own.nc")
    for verdict in (rf.assess(result), rf.assess(tmp_path / "own.nc")):
        assert words in verdict.summary
        assert words in json.loads(verdict.json())["summary"]
    if law is built_in:
        rf.report(result, tmp_path / "own.html")
        page = (tmp_path / "own.html").read_text(encoding="utf-8").replace("&#39;", "'")
        assert words in page


def test_a_passed_flight_under_another_law_says_so():
    """Step by step, phases of the mission that track no slots are flown, and named beside "Passed"."""
    flight = rf.Flight(points(phases=OPEN), controller=built_in)
    while flight.begin():
        flight.advance()
    summary = rf.assess(flight.finish()).summary
    assert summary.startswith("Passed")
    assert summary.endswith(
        "\nThe controller was not called in 'establish 1', as no slots are tracked there."
    )


def test_flights_without_a_controller_or_under_it_say_nothing():
    """Nothing is said of a controller that there is not, or that flew all phases."""
    both = rf.simulate(mission()), rf.simulate(mission(), controller=built_in)
    assert [[p.controller for p in r.phases] for r in both] == [[None, None], [True, True]]
    assert not any("controller" in rf.assess(r).summary for r in both)


@pytest.mark.parametrize("make", [points, mission])
def test_without_slots_nothing_is_to_be_followed(make):
    """An observation has no references where no slots are tracked: they are NaN, not somewhere."""
    flight = rf.Flight(make(phases=[OPEN[0], {"kind": "hold", "duration": 1.0}]))
    for tracked in (False, True):
        flight.begin()
        flight.advance(0.5)
        o = flight.observe()
        for x in (o.reference_position, o.reference_velocity, o.reference_acceleration):
            assert x.shape == (3, 3)
            assert np.isfinite(x).all() if tracked else np.isnan(x).all()
        flight.advance()


# -- forces from outside -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["rotors", "attitude"])
def test_a_force_pushes_vehicles_whatever_commands_them(kind):
    """Vehicles without drag that hover by a command move by F t^2 / 2 m under a constant force."""
    still = {"rotor_drag": 0.0, "rotor_inflow": 0.0, "rotor_lift": 0.0, "body_drag": [0.0] * 3}
    m = mission(
        vehicles={"v": {"model": "paper"} | still}, phases=[{"kind": "hold", "duration": 2.0}]
    )
    level = np.tile([1.0, 0, 0, 0], (3, 1))
    commands = {
        "rotors": rf.RotorCommand(np.full((3, 4), np.sqrt(9.81 / 4 / 5.9e-6))),
        "attitude": rf.AttitudeCommand(np.full(3, 9.81), level),
    }
    F = np.array([[0.3, 0, 0], [0, 0.2, 0], [0.1, 0, 0.4]])
    result = rf.simulate(m, controller=lambda _: commands[kind], force=lambda t, r, v: F)
    moved = result.position - result.position[0]
    np.testing.assert_allclose(moved, F * result.time[:, None, None] ** 2 / 2, rtol=0, atol=1e-9)


@pytest.mark.parametrize("noise", [None, NOISE | {"delay": 0.0, "velocity": 0.3}])
def test_a_force_meets_vehicles_where_they_are(noise):
    """Drag as a user's force is the vehicle's own drag, to .1 % of its effect: it acts on true states, at each step."""
    drag, ways = 0.5, []
    for own, force in ((drag, None), (0.0, lambda t, r, v: -drag * v), (0.0, None)):
        vehicle = {"model": "point", "mass": 1.0, "drag": own}
        tables = {} if noise is None else {"disturbances": {"noise": noise}}
        m = mission(
            vehicles={"v": vehicle},
            formations={"triangle": TRIANGLE["triangle"] | {"edges": []}},
            **tables,
        )
        ways.append(rf.simulate(m, force=force).position)
    assert np.abs(ways[0] - ways[2]).max() > 0.1
    np.testing.assert_allclose(
        ways[0], ways[1], rtol=0, atol=1e-3 * np.abs(ways[0] - ways[2]).max()
    )


@pytest.mark.parametrize("kind", ["force", "rotors"])
def test_a_force_that_fails_ends_a_flight_of_vehicles(kind):
    """The error names time and cause, and what had flown is kept and finite, whatever commands the vehicles."""

    def broken(t, r, v):
        if t > 1.0:
            raise LookupError("no wind today")
        return np.zeros_like(r)

    speeds = np.full((3, 4), np.sqrt(9.81 / 4 / 5.9e-6))
    own = None if kind == "force" else lambda _: rf.RotorCommand(speeds)
    with pytest.raises(rf.FlightError, match=r"LookupError at t = 1\.00. s: no wind") as stop:
        rf.simulate(mission(), force=broken, controller=own)
    assert stop.value.result.time[-1] == pytest.approx(1.0, abs=0.06)
    assert np.isfinite(stop.value.result.position).all()
