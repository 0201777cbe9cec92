"""The first layers of avoidance: the virtual clock and the body layer against independent solvers, and in flight."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.optimize import minimize

import rigidfleet as rf
from rigidfleet.planning.body_layer import (
    Detour,
    least_norm_feasible,
    motion_and_growth_rows,
    nearest_accelerations,
)
from rigidfleet.planning.derivatives import slot_derivatives
from rigidfleet.planning.virtual_clock import STEEPEST, VirtualClock
from rigidfleet.simulation.leading import Leader, LeaderState
from rigidfleet.web.replay.scene import page_samples

#: A ball that crosses the path of the formation just ahead of it, from the side, and one that never comes near.
CROSSING = {
    "kind": "sphere",
    "centre": [12.0, -15.0, 5.0],
    "radius": 0.8,
    "velocity": [0.0, 2.0, 0.0],
}
FAR = {"kind": "sphere", "centre": [0.0, 500.0, 5.0], "radius": 0.8, "velocity": [0.0, 1.0, 0.0]}


def triangle(
    obstacle: dict[str, Any], *, phases: Any = (), vehicle: Any = None, **avoidance: Any
) -> rf.Mission:
    """Three points in a triangle fly 20 m along x, and hold."""
    flown = phases or [{"kind": "fly", "position": [20.0, 0.0, 5.0], "duration": 12.0}]
    return rf.Mission.from_dict(
        {
            "schema_version": 1, "name": "order", "output_step": 0.1,
            "agents": {"vehicle": "point", "position": {"shape": "triangle", "size": 3.0, "count": 3,
                                                         "centre": [0.0, 0.0, 5.0]},
                       "radius": 0.2},
            "vehicles": {"point": vehicle or {"model": "point", "mass": 1.0, "thrust_limit": 16.0}},
            "formations": {"triangle": {"shape": "triangle", "size": 3.0},
                           "wide": {"shape": "triangle", "size": 4.0}},
            "limits": {"separation_allowance": 3.0},
            "avoidance": avoidance, "obstacles": [obstacle],
            "phases": [
                {"kind": "establish", "formation": "triangle", "duration": 1.0, "blend": 0.5}, *flown,
                {"kind": "hold", "duration": 3.0},
            ],
        }
    )  # fmt: skip


class Layers(NamedTuple):
    """What the layers did: rate of the clock (K,), displacement (K, 3) of the body [m], bits (K, N) of the others."""

    rate: Any
    displacement: Any
    acts: Any


def layers(result: rf.Result) -> Layers:
    """The record of the layers, which every flight with [avoidance] has."""
    found = result.clock_rate, result.body_displacement, result.avoidance_layers
    assert all(x is not None for x in found)
    return Layers(*found)


# -- the clock -----------------------------------------------------------------------------------------


@example([(0.0, 1.0, 3.5), (0.0, 1.0, 1.0), (0.0, 2.0, 1.0), (0.0, 2.0, 1.0)])
@settings(max_examples=30)
@given(
    st.lists(
        st.tuples(st.floats(0.0, 1.0), st.floats(0.01, 2.0), st.floats(0.1, 9.0)),
        min_size=1,
        max_size=8,
    )
)
def test_the_clock_follows_three_lags_and_never_runs_backwards_or_faster(steps):
    """Whatever the targets, the rate is that of an ODE solver, between 0 and 1, and its slope within its bound."""
    clock, state = VirtualClock(), np.array([0.0, 1.0, 0.0, 0.0])
    elapsed = 0.0
    for target, duration, omega in steps:
        clock.set_aim(target, omega)
        k = clock.omega

        def law(_, y, k=k, target=target):
            return [y[1], y[2], y[3], k**3 * (target - y[1]) - 3 * k**2 * y[2] - 3 * k * y[3]]

        found = solve_ivp(law, (0.0, duration), state, rtol=1e-10, atol=1e-12)
        times = np.linspace(0.0, duration, 9)
        _, rate, slope, _ = clock.progress_in(times)
        assert (rate >= -1e-9).all()
        assert (rate <= 1.0 + 1e-9).all()
        assert (abs(slope) <= STEEPEST * k + 1e-9).all()
        clock.advance_and_count_delay(duration)
        end, elapsed, scale = found.y[:, -1], elapsed + duration, k ** np.arange(3)
        assert elapsed - clock.delay == pytest.approx(end[0], abs=1e-7)
        # A clock that is steady to 1e-6 of its bandwidth becomes steady.
        assert clock.rate / scale == pytest.approx(end[1:] / scale, abs=1.01e-6)
        state = np.array([elapsed - clock.delay, *clock.rate])


def led(phase, deviation, clock):
    """A leader in the middle of a phase, and its plan."""
    flight = rf.Flight(triangle(FAR, phases=[phase]))
    flight.begin()
    flight.advance()
    flight.begin()
    active, given = flight._active, flight.mission.avoidance
    assert active is not None
    assert given is not None
    leader = Leader(given, active.plan, 0.02)
    leader.clock, leader.deviation = clock, deviation
    leader.now = LeaderState(5.0, clock, deviation)
    return leader


@pytest.mark.parametrize(
    "phase",
    [
        {"kind": "turn", "yaw_deg": 120.0, "pitch_deg": 30.0, "duration": 8.0},
        {"kind": "orbit", "centre": [0.0, 6.0, 5.0], "radius": 6.0, "rate_deg_s": 20.0, "duration": 8.0},
        {"kind": "reshape", "formation": "wide", "duration": 8.0, "blend": 7.0, "reference": "shape"},
    ],
)  # fmt: skip
def test_a_path_at_the_clock_s_time_obeys_the_chain_rule(phase):
    """What is flown is r(tau(t)): its velocity and acceleration are the differences of its places, to rounding."""
    clock = VirtualClock()
    clock.set_aim(0.0, 2.0)
    clock.advance_and_count_delay(0.9)
    leader = led(phase, Detour(), clock)
    h = 0.1
    problem = leader._detour_problem(5.0, h, np.zeros(7))
    times = 5.0 + np.linspace(0.0, h, 5)
    tau = 5.0 - clock.delay + clock.progress_in(times - 5.0)[0]
    wanted = slot_derivatives(leader.problem.reference, leader.problem.motion, tau, 1)[:, 0]
    flown = slot_derivatives(problem.reference, problem.motion, times, 3)
    assert 0.2 < clock.rate[0] < 0.9
    assert clock.rate[1] < -0.1
    np.testing.assert_allclose(flown[:, 0], wanted, atol=1e-8)
    e = 1e-3

    def place(t):
        tau = 5.0 - clock.delay + clock.progress_in(t - 5.0)[0]
        return slot_derivatives(leader.problem.reference, leader.problem.motion, tau, 1)[:, 0]

    before, now, after = place(times - e), place(times), place(times + e)
    assert abs(after - before).max() > 1e-4  # it moves
    np.testing.assert_allclose(flown[:, 1], (after - before) / (2 * e), atol=2e-5)
    np.testing.assert_allclose(flown[:, 2], (after - 2 * now + before) / e**2, atol=2e-3)


# -- the body ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
def test_the_body_is_steered_as_an_independent_solver_would(seed):
    """The change of all accelerations is the least in the sense of Gauss for which the rows hold."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 9))
    masses, arms, scale = rng.uniform(0.5, 2.0, n), rng.normal(size=(n, 3)), rng.uniform(0.7, 1.3)
    normals = rng.normal(size=(6, 3)) + [2.0, 0.0, 0.0]  # so that there is a solution
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rows = motion_and_growth_rows(normals, arms[rng.integers(n, size=6)], scale)
    asked, needed = rng.normal(size=7), rng.normal(size=6) + 1.0
    found = nearest_accelerations(asked, rows, needed, masses, arms, scale)
    assert found is not None
    assert (rows @ found >= needed - 1e-7).all()

    def cost(z):
        change = z - asked
        a = change[:3] + np.cross(change[3:6], arms) + change[6] / scale * arms
        return 0.5 * float(masses @ (a * a).sum(axis=1))

    limits = {"type": "ineq", "fun": lambda z: rows @ z - needed, "jac": lambda z: rows}
    other = minimize(
        cost, asked, constraints=limits, method="SLSQP", options={"ftol": 1e-10, "maxiter": 500}
    )
    assert other.success
    assert cost(found) == pytest.approx(cost(other.x), rel=2e-4, abs=1e-7)


def test_contradictory_rows_have_no_least_distance():
    """x >= 1 and -x >= 1: no motion of the body satisfies both, and none is made up."""
    assert least_norm_feasible(np.array([[1.0], [-1.0]]), np.ones(2)) is None
    assert least_norm_feasible(np.array([[1.0], [2.0]]), np.array([1.0, 3.0])) == pytest.approx(
        [1.5]
    )


@pytest.mark.parametrize("dt", [0.0, 0.04, 0.1])
def test_a_deviation_moves_as_its_derivatives_say(dt):
    """Series of displacement, rotation and scale agree with differences."""
    given_ = Detour(
        np.array([[0.5, 0.1, 0.0], [0.3, -0.2, 0.1], [0.1, 0.2, -0.4]]),
        np.eye(3), np.array([[0.2, 0.3, -0.1], [0.5, 0.1, 0.2]]), np.array([1.1, 0.1, -0.3]),
    ).state_after(0.1, np.full(7, 0.3), 0.1)  # fmt: skip
    asked, e = np.linspace(-1.0, 1.0, 7), 1e-4
    before, now, after = (given_.state_after(dt + k * e, asked, 0.1) for k in (-1, 0, 1))
    for part in range(3):
        x, y, z = (each.similarity_series()[part] for each in (before, now, after))
        np.testing.assert_allclose(y[1], (z[0] - x[0]) / (2 * e), atol=1e-3)
        np.testing.assert_allclose(2.0 * y[2], (z[0] - 2 * y[0] + x[0]) / e**2, atol=0.06)
    np.testing.assert_allclose(now.Q @ now.Q.T, np.eye(3), atol=1e-12)


# -- in flight -----------------------------------------------------------------------------------------


def test_without_need_the_flight_is_the_same_to_the_last_bit():
    """A ball that never comes near changes nothing: clock and body rest."""
    on = rf.simulate(triangle(FAR))
    off = rf.simulate(triangle(FAR, clock=False, body=False))
    assert (layers(on).rate == 1.0).all()
    assert not layers(on).displacement.any()
    for name in ("time", "position", "velocity", "input_force", "slot_position", "constraint"):
        assert getattr(on, name).tobytes() == getattr(off, name).tobytes(), name


def test_a_formation_waits_for_a_ball_that_crosses_and_arrives(tmp_path):
    """Its edges keep their lengths, which they do not if single vehicles give way; the phase ends as much later."""
    waits = rf.simulate(triangle(CROSSING, body=False))
    evades = rf.simulate(triangle(CROSSING, clock=False, body=False))
    assert layers(waits).rate.min() < 0.8
    assert layers(waits).rate.max() <= 1.0
    fly = waits.phases[1]
    delay = fly.extremes["clock"].value
    assert delay > 0.5
    assert fly.t_end - fly.t_start == pytest.approx(12.0 + delay, abs=1e-9)
    # The rate's integral is the progress of the plan.
    lost = np.trapezoid(1.0 - layers(waits).rate, waits.time)
    assert lost == pytest.approx(delay, abs=0.01)
    assert abs(waits.constraint).max() < 1e-3
    assert abs(evades.constraint).max() > 0.1
    assert not layers(waits).acts.any()
    assert layers(evades).acts.any()
    assert waits.complete
    assert rf.assess(waits).passed
    waits.save(tmp_path / "waits.nc")
    again = rf.Result.load(tmp_path / "waits.nc")
    for name in ("clock_rate", "body_displacement", "avoidance_layers"):
        np.testing.assert_array_equal(getattr(again, name), getattr(waits, name))
    assert again.phases[1].extremes["clock"] == fly.extremes["clock"]


def test_velocities_recorded_are_the_differences_of_slots_while_the_clock_slows():
    """The reference that is recorded is the one that was flown, in all its derivatives."""
    result = rf.simulate(triangle(CROSSING, body=False))
    slow = (layers(result).rate < 0.9) & (layers(result).rate > 0.01)
    k = np.flatnonzero(slow[1:-1] & slow[2:] & slow[:-2]) + 1
    k = k[
        (result.time[k + 1] - result.time[k - 1] < 0.21)
        & (result.time[k + 1] - result.time[k - 1] > 0.19)
    ]
    assert len(k) > 5
    over = (result.time[k + 1] - result.time[k - 1])[:, None, None]
    slope = (result.slot_position[k + 1] - result.slot_position[k - 1]) / over
    assert result.slot_velocity is not None
    np.testing.assert_allclose(slope, result.slot_velocity[k], atol=0.02)


def test_without_patience_no_formation_waits():
    """patience = 0 leaves all to the layers below."""
    result = rf.simulate(triangle(CROSSING, body=False, patience=0.0))
    assert (layers(result).rate == 1.0).all()
    assert "clock" not in result.phases[1].extremes


def test_a_formation_evades_as_a_body_and_returns():
    """A ball that comes towards a formation: waiting does not help, but its edges keep their lengths nevertheless."""
    ball = {
        "kind": "sphere",
        "centre": [40.0, 0.3, 5.2],
        "radius": 0.8,
        "velocity": [-2.0, 0.0, 0.0],
    }
    result = rf.simulate(triangle(ball))
    alone = rf.simulate(triangle(ball, clock=False, body=False))
    assert abs(layers(result).displacement).max() > 0.3
    assert abs(layers(result).displacement[-1]).max() < 1e-2
    assert abs(result.constraint).max() < 0.2 * abs(alone.constraint).max()
    assert rf.assess(result).passed
    assert 0.0 < result.phases[1].extremes["body"].value < 1.0


def test_steps_of_the_caller_do_not_change_what_the_layers_decide():
    """Decisions are made at multiples of their own period, so that a flight in pieces ends at the same states."""
    mission = triangle(CROSSING)
    whole = rf.simulate(mission)
    flight = rf.Flight(mission)
    while flight.begin():
        while flight.advance(0.37):
            pass
    pieces = flight.finish()
    assert pieces.time[-1] == pytest.approx(whole.time[-1], abs=1e-9)
    np.testing.assert_allclose(pieces.position[-1], whole.position[-1], atol=1e-6)


def test_quadrotors_wait_with_their_feed_forward_right():
    """Quadrotors that wait stay on their slots as well as they do in a flight without obstacles."""
    errors = []
    for ball in (CROSSING, FAR):
        result = rf.simulate(
            triangle(ball, body=False, barrier=False, vehicle={"model": "px4-sih"})
        )
        worst = result.extreme("tracking_error")
        assert worst is not None
        errors.append(worst.value)
        assert ball is FAR or layers(result).rate.min() < 0.8
    assert errors[0] < 1.5 * errors[1] + 0.02


def test_the_verdict_and_the_page_tell_which_layer_acted():
    """The longest wait and the shares of time are told; the page has the clock, the body and who gives way."""
    result = rf.simulate(triangle(CROSSING, body=False))
    clock = result.phases[1].extremes["clock"]
    notes = " ".join(rf.assess(result).notes)
    assert f"ends {clock.value:.3g} s later than planned" in notes
    slow = np.where(layers(result).rate < 0.99, 1.0, 0.0)
    share = float(np.trapezoid(slow, result.time)) / result.time[-1]
    assert f"the clock slowed {100 * share:.2g} %" in notes
    columns = page_samples(result, np.arange(3), 1.0)
    np.testing.assert_array_equal(columns["clock"].values, layers(result).rate)
    assert not columns["acts"].values.any()
    evades = rf.simulate(triangle(CROSSING, clock=False, body=False))
    acts = page_samples(evades, np.arange(3), 1.0)["acts"].values
    np.testing.assert_array_equal(acts > 0.0, layers(evades).acts > 0)
    assert "clock" not in page_samples(rf.simulate("square"), np.arange(0), 1.0)
