"""Obstacles that move: the Kalman filter, the flow, what the guard keeps beside them, and what is told of it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_avoidance import Wild, crowd, guarantee, worst
from vehicle_samples import planned

import rigidfleet as rf
from rigidfleet.kernel import fleet
from rigidfleet.kernel.avoidance import KNOWN, UNKNOWN, avoidance_arrays, initial_sight
from rigidfleet.kernel.engine import sampled
from rigidfleet.kernel.problem import graph, workspace
from rigidfleet.solids.records import ball, box, half_space, join_solids, one_solid

#: Period of the commands [s].
T = 0.02


class One:
    """One free vehicle of 1 kg without gravity, called tick by tick."""

    def __init__(self, solids, **options):
        plan = planned("square", 0, fleet.VehicleDynamics(1.0, point=True), h=T)
        edges, mass = np.zeros((0, 2), dtype=np.int64), np.ones(1)
        self.problem, self.work = plan[0]._replace(graph=graph(edges, mass)), workspace(1, 0)
        points = fleet.quadrotor_arrays([fleet.VehicleDynamics(1.0, point=True)], 0.0)
        self.flight = fleet.new_ideal_flight(points, start=0.0, h=T, steps=1)
        self.state = fleet.initial_state(self.flight, np.zeros((1, fleet.STATES)), self.work)
        seen = {
            key: options.pop(key) for key in ("reach", "noise", "swerve", "seed") if key in options
        }
        self.a = avoidance_arrays(
            period=T, b=5.0 * mass, lift=50.0 * mass, mass=mass, g=0.0, radius=0.3 * mass, solids=solids,
            seen=initial_sight(solids, **seen), **options,
        )  # fmt: skip

    def __call__(self, t, r, v, force):
        """The acceleration (3,) that is given at t [s] for one asked for."""
        self.state.seen[0, :3], self.state.seen[0, 3:], self.state.force[0] = r, v, force
        self.state.work.law_time[0] = t
        assert sampled.correct_forces(self.problem, self.work, self.flight, self.state, self.a)
        return self.state.force[0].copy()


def passing(place, velocity, radius=0.7):
    """A ball of constant velocity."""
    ends = np.array([0.0, 60.0])
    return one_solid(ball(place, radius), ends, np.outer(ends, velocity))


# -- the filter ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("swerve", [0.0, 0.7])
def test_the_filter_is_the_conditional_mean(swerve):
    """Estimate and variance are those of the Gaussian of all places and velocities, given all measurements at once."""
    noise, ticks, velocity = 0.05, 30, np.array([1.0, -2.0, 0.5])
    things = join_solids([one_solid(half_space(-90.0)), passing([5.0, 0, 0], velocity)])
    fly = One(things, reach=50.0, noise=noise, swerve=swerve, seed=3)
    for k in range(ticks):
        fly(k * T, np.zeros(3), np.zeros(3), np.zeros(3))
    s = fly.a.sight
    # States of one axis at all ticks as a linear map of the first one and of the noise of each step
    F, q = np.array([[1.0, T], [0.0, 1.0]]), swerve**2
    Q = q * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]])
    big = np.zeros((2 * ticks, 2 * ticks))  # covariance of all states, place before velocity
    cov = np.diag([1e6, 100.0])  # nothing is known of the place, 10 m/s of the velocity
    for k in range(ticks):
        big[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = cov
        for later in range(k + 1, ticks):
            cross = np.linalg.matrix_power(F, later - k) @ cov
            big[2 * later : 2 * later + 2, 2 * k : 2 * k + 2] = cross
            big[2 * k : 2 * k + 2, 2 * later : 2 * later + 2] = cross.T
        cov = F @ cov @ F.T + Q
    seen = big[::2, ::2] + noise**2 * np.eye(ticks)
    gain = np.linalg.solve(seen, big[::2, -2:]).T
    left = big[-2:, -2:] - gain @ big[::2, -2:]
    draws = np.arange(ticks)[:, None] * 6 + 3 + np.arange(3)
    z = T * np.arange(ticks)[:, None] * velocity + noise * s.normals[draws]
    expected = gain @ z
    assert s.known[1] == KNOWN
    assert s.track[1] == pytest.approx(expected.ravel(), rel=1e-5, abs=1e-6)
    assert s.spread[1] == pytest.approx([left[0, 0], left[0, 1], left[1, 1]], rel=1e-4)
    assert s.bound[1] == pytest.approx(3 * np.sqrt(np.diag(left)), rel=1e-4)


def test_bounds_of_the_filter_hold_as_often_as_they_should():
    """Over many seeds, squared errors over variances have the mean of a chi-squared distribution."""
    velocity, found = np.array([1.0, -2.0, 0.5]), []
    for seed in range(60):
        fly = One(passing([5.0, 0, 0], velocity), reach=50.0, noise=0.05, seed=seed)
        for k in range(25):
            fly(k * T, np.zeros(3), np.zeros(3), np.zeros(3))
        s = fly.a.sight
        wrong = s.track[0] - np.concatenate([24 * T * velocity, velocity])
        P = np.array([[s.spread[0, 0], s.spread[0, 1]], [s.spread[0, 1], s.spread[0, 2]]])
        found += [wrong[k::3] @ np.linalg.solve(P, wrong[k::3]) for k in range(3)]
    assert np.mean(found) == pytest.approx(2.0, abs=4 * 2 / np.sqrt(len(found)))


def test_an_obstacle_is_known_within_range_and_expected_to_go_on_beyond():
    """Out of range nothing is known; after it the track goes on straight."""
    fly = One(passing([4.0, 0, 0], [-2.0, 4.0, 0]), reach=3.0)
    known = []
    for k in range(150):
        fly(k * T, np.zeros(3), np.zeros(3), np.zeros(3))
        known.append(int(fly.a.sight.known[0]))
    assert known[0] == UNKNOWN
    assert known[-1] == KNOWN
    assert fly.a.sight.track[0] == pytest.approx([-2 * 149 * T, 4 * 149 * T, 0, -2, 4, 0])


# -- the flow -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_the_flow_is_that_of_a_doublet_in_a_stream(seed):
    """What is asked for leads to the gradient of U . x (1 + R^3 / (2 |x|^3)), taken by differences."""
    rng = np.random.default_rng(seed)
    place, w, radius = rng.normal(size=3) * 5, rng.normal(size=3), 0.7
    fly = One(passing(place, w, radius), flow=True, guarded=False, filtered=False)
    x, v, force = rng.normal(size=3), rng.normal(size=3), rng.normal(size=3)
    x *= 2.0 / np.linalg.norm(x)
    R, U = 1.2 * (radius + 0.3), v + force / 4.0 - w

    def potential(y):
        return U @ y * (1 + R**3 / (2 * np.linalg.norm(y) ** 3))

    step = 1e-5
    flow = [(potential(x + e) - potential(x - e)) / (2 * step) for e in step * np.eye(3)]
    given = fly(0.0, place + x, v, force)
    assert given == pytest.approx(4.0 * (np.array(flow) + w - v), rel=1e-6)


# -- the barriers -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_a_vehicle_steers_past_what_would_pass_too_near(seed):
    """Held until the nearest approach, the least change of what is asked for leads past at the distance to keep."""
    rng = np.random.default_rng(seed)
    fly = One(passing([6.0, 0, 0], [-3.0, 0, 0]), guarded=False, clearance=0.1)
    r, v, force = rng.normal(0, 0.2, 3), rng.normal(0, 0.2, 3), rng.normal(0, 0.1, 3)
    change = fly(0.0, r, v, force) - force
    x, u = r - [6.0, 0, 0], v - [-3.0, 0, 0]
    t = -(x @ u) / (u @ u)
    beside = x + t * u  # at right angles to the way, which both would go on straight
    n = beside / np.linalg.norm(beside)
    asked = n @ force
    led = np.linalg.norm(beside) + 0.5 * (asked + n @ change) * t * t
    assert led == pytest.approx(0.7 + 0.3 + 0.1, abs=1e-4)
    assert np.linalg.norm(np.cross(n, change)) < 1e-6


def test_nobody_steers_round_a_wall():
    """A wide plate that comes from afar asks for nothing: there is no way past it, and braking suffices later."""
    ends, plate = np.array([0.0, 60.0]), box([6.0, -4.5, -4.5], [6.01, 4.5, 4.5])
    fly = One(one_solid(plate, ends, np.outer(ends, [-2.5, 0, 0])), guarded=False)
    given = fly(0.0, np.zeros(3), np.zeros(3), np.zeros(3))
    assert given == pytest.approx(np.zeros(3), abs=1e-12)


def test_a_ball_does_not_drive_a_vehicle_into_another():
    """One of two vehicles in line is met straight from ahead: it gives way beside, not towards the other."""
    mission = crowd(
        [[0.0, 0, 5], [-2.0, 0, 5]], limit=15.0, until=6.0,
        obstacles=[{"kind": "sphere", "centre": [10.0, 0.01, 5], "radius": 0.7, "velocity": [-2.5, 0, 0]}],
        avoidance={"separation": 0.1, "clearance": 0.05},
    )  # fmt: skip
    result = rf.simulate(mission)
    assert worst(result, "clearance") >= 0.05 - 1e-6
    assert worst(result, "separation") >= 0.1 - 1e-6
    assert guarantee(mission)[0].passed


# -- the guard ----------------------------------------------------------------------------------------


@settings(max_examples=10, deadline=None)
@given(
    seed=st.integers(0, 2**31), period=st.sampled_from([0.01, 0.02, 0.1]), drag=st.sampled_from([0.0, 0.2]),
    barrier=st.booleans(), reference=st.sampled_from(["path", "flow"]),
)  # fmt: skip
def test_one_vehicle_is_never_met_by_one_obstacle(seed, period, drag, barrier, reference):
    """Random forces beside an obstacle whose velocity is known: in continuous time, it never comes too near."""
    rng = np.random.default_rng(seed)
    w = rng.normal(size=3)
    w *= rng.uniform(0.3, 6.0) / np.linalg.norm(w)
    limit = float(rng.uniform(14.0, 30.0))
    b = limit - 9.81 - drag * np.linalg.norm(w)
    if b < 1.5:
        return
    way = w @ w / (2 * b) + np.linalg.norm(w) * period + 1.0
    start = np.array([0.0, 0, 5]) - w / np.linalg.norm(w) * (way + 1.0) + rng.normal(0, 0.3, 3)
    mission = crowd(
        [[0.0, 0, 5], [900.0, 0, 5]], limit=limit, period=period, until=4.0,
        vehicles={"point": {"model": "point", "mass": 1.0, "thrust_limit": limit, "drag": drag}},
        obstacles=[{"kind": "sphere", "centre": start.tolist(), "radius": 0.5, "velocity": w.tolist()}],
        avoidance={"clearance": 0.05, "barrier": barrier, "reference": reference},
    )  # fmt: skip
    result = rf.simulate(mission, controller=Wild(rng, limit), rate=1.0 / period)
    assert result.complete, result.ending
    assert (
        worst(result, "clearance") >= 0.05 - 1e-6
    )  # its place is known to some 1e-9 m at each tick
    check = {c.check: c for c in rf.assess(result).checks}["guarantee"]
    assert check.passed
    assert "held" in check.message


def fast(**options):
    """Two vehicles that hover, and a ball that flies at one of them, too fast and too near to brake relative to it."""
    return crowd(
        [[0.0, 0, 5], [4.0, 0, 5]], until=2.0, limit=15.0,
        obstacles=[{"kind": "sphere", "centre": [-6.0, 0.1, 5.0], "radius": 0.5, "velocity": [9.0, 0, 0]}],
        avoidance=options,
    )  # fmt: skip


def test_a_vehicle_that_cannot_brake_in_time_evades():
    """The guarantee is lost at once, and the verdict says by what; yet the ball is missed."""
    result = rf.simulate(fast())
    found, _ = guarantee(fast())
    assert not found.passed
    assert found.when == 0.0
    assert "lost at 0.00 s, by agent 1" in found.message
    assert worst(result, "clearance") > 0.0
    unguarded = rf.simulate(fast(guard=False, barrier=False, reference="flow"))
    assert worst(unguarded, "clearance") < 0.0  # it would be hit


def test_with_noise_the_flight_is_the_same_for_the_same_seed_alone():
    """The same seed gives the same flight, another one another, and sensing too short a range changes nothing."""

    def flown(**options):
        mission = crowd(
            [[0.0, 0, 5], [3.0, 0, 5]], until=3.0,
            obstacles=[{"kind": "sphere", "centre": [-4.0, 0.1, 5], "radius": 0.5, "velocity": [2.0, 0, 0]}],
            avoidance=options,
        )  # fmt: skip
        result = rf.simulate(mission)
        return result.position, worst(result, "clearance")

    one, room = flown(sensing_range=5.0, sensing_noise=0.05, seed=1)
    again, _ = flown(sensing_range=5.0, sensing_noise=0.05, seed=1)
    other, _ = flown(sensing_range=5.0, sensing_noise=0.05, seed=2)
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)
    assert room > 0.0
    blind, room = flown(sensing_range=0.01)
    assert room < 0.0
    assert np.ptp(blind[:15], axis=0).max() < 1e-9
