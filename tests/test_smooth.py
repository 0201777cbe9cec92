"""References and their derivatives: what vehicles with attitude are told, and how smooth it is."""

import math
import re
from typing import Any

import numpy as np
import pytest
from sample_missions import three_points
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from rigidfleet.assessment import assess
from rigidfleet.cli import app as cli
from rigidfleet.errors import MissionError
from rigidfleet.kernel import control, references
from rigidfleet.kernel.problem import SHAPE, Motion, Reference, workspace
from rigidfleet.math import series, splines
from rigidfleet.mission import Mission, load_mission
from rigidfleet.mission.draft import draft
from rigidfleet.mission.schema import VehicleYaw
from rigidfleet.planning import derivatives as d
from rigidfleet.planning.legs import Leg, leg_of
from rigidfleet.planning.limits import limits_of, use_of_limits
from rigidfleet.planning.preview import preview_phases
from rigidfleet.planning.timing import broken_limits, complete_times
from rigidfleet.preflight.check import check
from rigidfleet.result import Result
from rigidfleet.simulation.flight import Flight, simulate

#: Central differences of eighth order.
_FIRST = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
_SECOND = np.array([-1 / 560, 8 / 315, -1 / 5, 8 / 5, -205 / 72, 8 / 5, -1 / 5, 8 / 315, -1 / 560])


def random(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


def a_reference(powers: int = 6) -> tuple[Reference, Motion]:
    """Four slots that reshape, in a body that moves on polynomials and turns about all axes."""
    knots = np.array([0.0, 1.5, 4.0])
    scale = 0.5 ** np.arange(powers)
    pieces = random(7, 2, 6, powers) * scale
    motion = Motion(
        knots, np.ascontiguousarray(pieces), Rotation.from_rotvec([0.4, -1, 2]).as_matrix()
    )
    slots = 2.0 * random(3, 4, 3)
    reference = Reference(
        SHAPE, 0.5, 2.5, np.zeros(3), np.zeros(3), slots, random(4, 4, 3), np.array([0.3, 0.9, -0.4])
    )  # fmt: skip
    return reference, motion


def flown(reference: Reference, motion: Motion, t: float) -> np.ndarray:
    """Position, velocity and acceleration (3, N, 3) of the slots, as the kernel flies them."""
    w = workspace(len(reference.p0), 0)
    references.blend_slots(t, reference, w.p, w.p_dot, w.p_ddot)
    control.reference_motion(t, motion, w)
    control.desired_agents(w)
    return np.array([w.r_ref, w.v_ref, w.a_ref])


@pytest.mark.parametrize("t", [0.2, 0.9, 1.5, 2.2, 3.5, 4.7])
def test_slots_have_the_kernels_position_velocity_and_acceleration(t):
    """Before, in and after a blend, at a knot and beyond the last one."""
    reference, motion = a_reference()
    found = d.slot_derivatives(reference, motion, np.array([t]))[0]
    np.testing.assert_allclose(found[:3], flown(reference, motion, t), rtol=1e-12, atol=1e-11)


def still(motion: Motion) -> Motion:
    """The same motion of a body that does not turn."""
    pieces = motion.coefficients.copy()
    pieces[:, 3:] = 0.0
    return motion._replace(coefficients=pieces)


def test_slots_of_a_body_that_does_not_turn_are_the_kernels():
    """At many times at once, before, in and after a blend that turns the slots, and one that does not."""
    reference, motion = a_reference()
    time = np.linspace(0.1, 4.9, 25)
    for turn in (reference.turn, np.zeros(3)):
        of = reference._replace(turn=turn)
        many = d.slot_derivatives(of, still(motion), time)[:, :3]
        own = [flown(of, still(motion), t) for t in time]
        np.testing.assert_allclose(many, own, rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("turns", [True, False])
def test_fewer_orders_are_the_first_of_all_bit_for_bit(turns):
    """Who needs positions alone gets the numbers of who needs snap, also of slots on ways of their own."""
    blend, motion = a_reference()
    ways = blend._replace(knots=np.array([0.5, 2.0, 3.0]), ways=random(5, 2, 4, 3, 8))
    time = np.linspace(0.1, 4.9, 25)
    for reference in (blend, ways):
        of = reference, motion if turns else still(motion), time
        for orders in range(1, d.ORDERS):
            assert np.array_equal(
                d.slot_derivatives(*of, orders), d.slot_derivatives(*of)[:, :orders]
            )


@pytest.mark.parametrize("t", [0.3, 0.9, 2.2, 3.5])
def test_jerk_and_snap_are_differences_of_the_kernels_acceleration(t):
    """Eighth-order differences of what the compiled kernel flies."""
    reference, motion = a_reference()
    h = 0.02
    a = np.array([flown(reference, motion, t + k * h)[2] for k in range(-4, 5)])
    found = d.slot_derivatives(reference, motion, np.array([t]))[0]
    scale = np.abs(found[3:]).max()
    np.testing.assert_allclose(found[3], np.tensordot(_FIRST, a, 1) / h, atol=1e-7 * scale)
    np.testing.assert_allclose(found[4], np.tensordot(_SECOND, a, 1) / h**2, atol=1e-6 * scale)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 1.0, 3.0, 3.99, 4.01, 30.0, 600.0])
def test_rotations_of_any_angle(size):
    """The series of Exp(phi) is SciPy's rotation a little later, from no turn to a hundred."""
    phi = random(5, 5, 3) * 0.3
    phi[0] *= size / np.linalg.norm(phi[0])
    R = series.rotation_series(phi)
    for h in (0.0, 0.01):
        later = Rotation.from_rotvec(sum(x * h**k for k, x in enumerate(phi))).as_matrix()
        sum_ = sum(x * h**k for k, x in enumerate(R))
        np.testing.assert_allclose(sum_, later, rtol=0, atol=1e-9 if h else 1e-12)


def test_rotation_vectors_invert_rotations():
    """Rotation vectors, their rotations and body rates are series of one another."""
    phi = random(6, 5, 3) * 0.5
    R = series.rotation_series(phi)
    np.testing.assert_allclose(series.rotation_vector_taylor(R), phi, rtol=0, atol=1e-12)
    again = series.rotation_series_from_rates(R[0], series.body_rates_series(R))
    np.testing.assert_allclose(again, R, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["formation", "along", "towards"])
def test_yaw_and_its_rates_belong_together(kind):
    """Rate and acceleration of the yaw are differences of the yaw."""
    reference, motion = a_reference()
    yaw = VehicleYaw(kind=kind, point=(20.0, -5.0, 3.0))
    h, t = 0.01, 1.9
    grid = t + h * np.arange(-4, 5)
    time = np.concatenate([[1.6], grid])
    found = d.yaw_derivatives(reference, motion, time, yaw)[1:]
    np.testing.assert_allclose(found[4, 1], np.tensordot(_FIRST, found[:, 0], 1) / h, atol=1e-6)
    np.testing.assert_allclose(found[4, 2], np.tensordot(_SECOND, found[:, 0], 1) / h**2, atol=1e-4)


def test_yaw_with_the_formation_is_its_euler_angle_when_it_does_not_roll():
    """A body that pitches by 50 deg and yaws: the vehicles' yaw is the 3-2-1 yaw."""
    reference, _ = a_reference()
    attitude = Rotation.from_euler("ZYX", [130.0, 50.0, 0.0], degrees=True).as_matrix()
    still = Motion(np.array([0.0, 1.0]), np.zeros((1, 6, 6)), attitude.T)
    found = d.yaw_derivatives(reference, still, np.array([0.5]), VehicleYaw())
    np.testing.assert_allclose(np.rad2deg(found[0, 0]), 130.0, atol=1e-12)
    np.testing.assert_allclose(found[0, 1:], 0.0, atol=1e-12)


def straight(*legs: tuple[float, float]) -> Motion:
    """The CM at rest at the origin, then along x by (distance, duration) with quintic starts and stops."""
    from rigidfleet.math import lqr

    knots = np.concatenate([[0.0], np.cumsum([time for _, time in legs])])
    x = np.zeros((len(knots), 6))
    x[1:, 0] = np.cumsum([way for way, _ in legs])
    zero = np.zeros_like(x)
    return Motion(knots, np.ascontiguousarray(lqr.quintic_pieces(knots, x, zero, zero)), np.eye(3))


def test_yaw_along_turns_into_the_way_keeps_still_at_rest_and_turns_back():
    """A vehicle that looks sideways turns into the way, stays so at rest, and turns round for the way back."""
    reference, _ = a_reference()
    still = reference._replace(dp=np.zeros((4, 3)), turn=np.zeros(3))
    motion = straight((30.0, 10.0), (0.0, 5.0), (-30.0, 10.0))
    time = np.linspace(0.0, 25.0, 251)
    found = d.yaw_derivatives(still, motion, time, VehicleYaw(kind="along"), np.full(4, 1.5))
    yaw = np.rad2deg(found[:, 0])
    np.testing.assert_allclose(yaw[90:151], 0.0, atol=0.1)
    np.testing.assert_allclose(yaw[150], yaw[101], atol=1e-9)
    np.testing.assert_allclose(np.cos(found[-1, 0]), -1.0, atol=1e-4)
    assert np.abs(found[:, 1]).max() < 3.0  # rad/s


# -- smooth missions -------------------------------------------------------------------------------


def a_mission(*phases: dict, **more) -> Mission:
    """Three vehicles that form a triangle, and then fly these phases smoothly."""
    data = three_points({"blend": 7.5, "duration": 8.0}, *phases)
    return Mission.from_dict(data | more)


def ends_of_phases(mission: Mission) -> list[tuple[np.ndarray, np.ndarray]]:
    """Reference of the slots (5, N, 3) at each switch, before and after it, as flown."""
    flight, found, last = Flight(mission), [], None
    while flight.begin():
        problem, start = flight.plan.problem, flight.plan.start
        (first,) = d.slot_derivatives(problem.reference, problem.motion, np.array([start]))
        if last is not None:
            found.append((last, first))
        flight.advance()
        (last,) = d.slot_derivatives(problem.reference, problem.motion, np.array([flight.t]))
    assert not flight.ending
    flight.finish()
    return found


WAYS = [
    {"kind": "fly", "position": [20, 5, 8], "velocity": [2, 1, 0], "yaw_deg": 140.0, "pitch_deg": 30.0,
     "rates_deg_s": [5, 0, 8], "duration": 9.0},
    {"kind": "reshape", "formation": "wide", "duration": 6.0},
    {"kind": "fly", "position": [30, 20, 9], "duration": 9.0},
    {"kind": "orbit", "centre": [30, 10, 9], "radius": 8.0, "rate_deg_s": 20.0, "duration": 10.0, "yaw": "along"},
    {"kind": "fly", "position": [0, 0, 9], "duration": 14.0, "yaw_deg": -90.0,
     "through": [{"position": [20, -10, 12]}, {"position": [5, 10, 7]}]},
    {"kind": "turn", "yaw_deg": 90.0, "travel": 4.0, "settle": {"tolerance": 0.01, "dwell": 0.5}},
    {"kind": "fly", "position": [5, 5, 9], "duration": 6.0},
    {"kind": "orbit", "centre": [5, 0, 9], "radius": 5.0, "rate_deg_s": -25.0, "blend": 3.0, "duration": 4.0},
    {"kind": "hold", "duration": 8.0},
]  # fmt: skip


def test_acceleration_and_jerk_are_continuous_through_every_switch():
    """Waypoints with velocity and rates, a change of shape in motion, orbits, points to pass, a settled turn."""
    mission = a_mission(*WAYS)
    for number, (before, after) in enumerate(ends_of_phases(mission)):
        for order, bound in enumerate((1e-9, 1e-9, 1e-8, 1e-7)):
            error = np.abs(after[order] - before[order]).max()
            assert error < bound, f"derivative {order} jumps by {error} after phase {number + 1}"
    verdict = assess(simulate(mission))
    assert verdict.passed, verdict.summary
    for waypoint in (phase.waypoint for phase in verdict.phases):
        if waypoint is not None and waypoint.position is not None:
            assert waypoint.position < 1e-3
            assert (waypoint.velocity or 0.0) < 0.03


def test_points_on_the_way_are_judged():
    """Points to pass are met, each at its time, at any output step; a flight beside one of them misses it."""
    paper = load_mission("narrow-passage")
    tables: dict[str, Any] = paper.to_dict() | {"smoothness": "jerk", "output_step": 0.7}
    start = paper.fleet.position.mean(axis=0)
    points = [
        {"position": list(start + [2.0, 1.0, 3.0])},
        {"position": list(start + [5.0, -1.0, 4.0])},
    ]
    fly = {
        "kind": "fly",
        "position": list(start + [8.0, 0.0, 3.0]),
        "through": points,
        "duration": 9.0,
    }
    result = simulate(Mission.from_dict(tables | {"phases": [*tables["phases"][:1], fly]}))
    through = assess(result).phases[1].through
    times = [at["time"] for at in (result.phases[1].target or {})["through"]]
    assert [at.time for at in through] == times
    assert all((at.position or 0.0) < 1e-3 for at in through)
    result.cm[result.time == times[1]] += [0.0, 0.3, 0.0]
    failed = [c for c in assess(result).checks if c.check == "waypoint_position" and not c.passed]
    assert [c.when for c in failed] == [times[1]]
    assert failed[0].message.startswith(
        f"point 2 on the way of phase '{result.phases[1].name}' is missed"
    )


@pytest.mark.parametrize("beside", [3e-5, 1e-6, 4e-4, -2e-5])
def test_a_sample_just_beside_another_shows_no_rounding(beside):
    """A point is passed a moment before or after an output time: jerk and worst values are those of the way."""
    through = [{"position": [4.0, 2.0, 13.0], "time": 3.0 - beside}]
    mission = a_mission(
        {"kind": "fly", "position": [9.0, 1.0, 11.0], "through": through, "duration": 7.0},
        output_step=0.02,
        limits={"vertical_acceleration": 5.0, "horizontal_acceleration": 5.0},
    )
    result = simulate(mission)
    assert np.abs(np.diff(result.time) - abs(beside)).min() < 1e-9
    jerk = result.setpoints_at_samples(flown=True).state[:, 3]
    assert np.abs(jerk - result.setpoints_at_samples().state[:, 3]).max() < 0.2
    acceleration = result.setpoints_at_samples().state[:, 2]
    worst = {check.check: check.worst for check in assess(result).checks}
    up = np.abs(acceleration[..., 2]).max()
    along = np.hypot(acceleration[..., 0], acceleration[..., 1]).max()
    assert worst["vertical_acceleration"] == pytest.approx(up, rel=1e-3)
    assert worst["horizontal_acceleration"] == pytest.approx(along, rel=1e-3)


def test_legs_of_the_regulators_jump():
    """The same switches are not continuous in a mission of the paper: the tests above can fail."""
    data = load_mission("narrow-passage").to_dict()
    lqr, smooth = (
        max(np.abs(after - before)[2].max() for before, after in ends_of_phases(mission)[1:])
        for mission in (Mission.from_dict(data), Mission.from_dict(data | {"smoothness": "jerk"}))
    )
    assert lqr > 2.0
    assert smooth < 1e-8


def test_the_next_way_starts_from_the_reference_wherever_a_phase_is_left():
    """Left by hand in the middle of a turning flight, the next way begins with its velocity, acceleration and jerk."""
    mission = a_mission(WAYS[0])
    flight = Flight(mission)
    flight.begin()
    flight.advance()
    flight.begin()
    flight.advance(4.3)
    problem = flight.plan.problem
    (before,) = d.slot_derivatives(problem.reference, problem.motion, np.array([flight.t]))
    assert np.linalg.norm(before[3], axis=1).min() > 0.1
    flight.begin({"kind": "fly", "position": [0, 0, 20], "duration": 8.0, "yaw_deg": 0.0})
    problem = flight.plan.problem
    (after,) = d.slot_derivatives(problem.reference, problem.motion, np.array([flight.plan.start]))
    np.testing.assert_allclose(after[:4], before[:4], rtol=0, atol=1e-8)


def test_pieces_of_degree_seven_fly_as_polynomials():
    """The kernel evaluates pieces of degree 7 and 5 with the same values and derivatives as NumPy's polynomials."""
    for powers in (6, 8):
        _, motion = a_reference(powers)
        w = workspace(4, 0)
        for t in (0.7, 2.9):
            control.reference_motion(t, motion, w)
            low = int(t >= 1.5)
            for q in range(3):
                p = np.polynomial.Polynomial(motion.coefficients[low, q])
                for k in range(3):
                    expected = (p.deriv(k) if k else p)(t - motion.knots[low])
                    np.testing.assert_allclose(w.body[k, q], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"smoothness": "lqr"}, "through.*needs a smooth mission"),
        ({"architecture": "body"}, "needs control = 'tracking'"),
    ],
)
def test_what_a_smooth_mission_refuses(changed, told):
    """Points to pass without smoothness, and regulators of their own with it."""
    with pytest.raises(MissionError, match=told):
        a_mission(WAYS[4], **changed)


# -- minimum snap ----------------------------------------------------------------------------------


def test_minimum_snap_is_the_spline_of_degree_seven():
    """Through points, it is SciPy's interpolating spline of degree 7 with the same ends."""
    t, x = np.cumsum([0, 1.3, 0.7, 2.2, 1.1]), random(0, 5, 3)
    begin, end = random(1, 3, 3), random(2, 3, 3)
    conditions = [[(k + 1, y[k]) for k in range(3)] for y in (begin, end)]
    spline = make_interp_spline(t, x, k=7, bc_type=tuple(conditions))
    pieces = splines.minimum_snap(t, x, begin, end)
    for piece, u in ((0, 0.4), (1, 0.3), (2, 1.7), (3, 1.0)):
        x = series.taylor_derivatives(
            series.polynomial_series(pieces[piece][None], np.array([u]), 7)
        )[:, 0]
        for order in range(7):
            expected = spline(t[piece] + u, order)
            np.testing.assert_allclose(x[order], expected, rtol=1e-8, atol=1e-8)


def test_minimum_snap_from_rest_to_rest():
    """One metre in one second, from rest to rest: 35 u^4 - 84 u^5 + 70 u^6 - 20 u^7, and the cost 100800 m^2/s^7."""
    zero = np.zeros((3, 1))
    pieces = splines.minimum_snap(np.array([0.0, 1.0]), np.array([[0.0], [1.0]]), zero, zero)
    np.testing.assert_allclose(pieces[0, 0], [0, 0, 0, 0, 35, -84, 70, -20], atol=1e-12)
    np.testing.assert_allclose(splines.snap_cost(pieces, np.array([0.0, 1.0])), 100800.0)


# -- limits and least times ------------------------------------------------------------------------

LIMITS = {"speed": 3.0, "acceleration": 1.5, "jerk": 1.5, "tilt_deg": 8.0}


def dense(leg: Leg, mission: Mission) -> dict[str, float]:
    """The greatest share of each limit at 20,001 samples of a leg, from positions alone."""
    time = np.linspace(leg.start, leg.end, 20_001)
    x = d.slot_derivatives(leg.reference, leg.motion, time)
    force = x[:, 2] + np.array([0.0, 0.0, mission.gravity])
    across = np.linalg.norm(force[..., :2], axis=-1)
    found = {
        "speed": np.linalg.norm(x[:, 1], axis=-1) / LIMITS["speed"],
        "acceleration": np.linalg.norm(x[:, 2], axis=-1) / LIMITS["acceleration"],
        "jerk": np.linalg.norm(x[:, 3], axis=-1) / LIMITS["jerk"],
        "tilt": np.rad2deg(np.arctan(across / force[..., 2])) / LIMITS["tilt_deg"],
        "thrust": np.linalg.norm(force, axis=-1) / 15.0,
    }
    return {name: float(share.max()) for name, share in found.items()}


def limited(*phases: dict, **more) -> Mission:
    """`a_mission` with limits of speed, acceleration, jerk, tilt and thrust."""
    agents = {"mass": 1.0, "position": [[0, 0, 5], [4, 0, 5], [2, 3, 5]], "thrust_limit": 15.0}
    return a_mission(*phases, **({"limits": LIMITS, "agents": agents} | more))


def test_limits_are_found_between_samples():
    """What each leg reaches of each limit is that of 20,001 samples, to 1e-3, with its agent and time."""
    mission = limited(*WAYS)
    for planned in preview_phases(mission)[0]:
        leg = planned.leg
        expected = dense(leg, mission)
        for x in use_of_limits(limits_of(mission), leg.reference, leg.motion, leg.start, leg.end):
            share = expected[x.limit.of.name_in_words]
            assert x.share == pytest.approx(share, rel=1e-3, abs=1e-9)
            who = np.array([x.agent])
            at = d.slot_derivatives(leg.reference, leg.motion, np.array([x.time]))[:, :, who]
            assert x.limit.values(at, who)[0, 0] == pytest.approx(x.value, rel=1e-9, abs=1e-12)


def test_a_time_that_is_too_short_is_refused_with_the_least_one():
    """The check names limit, agent, time and least duration; with it the check passes, with 2 % less it does not."""
    way = {"kind": "fly", "position": [20, 5, 8], "yaw_deg": 90.0, "name": "over there"}
    told = [
        r.text
        for r in check(limited(way | {"duration": 4.0}), search=False).remarks
        if r.level == "fails"
    ]
    assert len(told) == 1
    found = re.fullmatch(
        r"agent \d would need [\d.]+ m/s³ of jerk at [\d.]+ s in 'over there' \(limit 1.5 m/s³\); the least"
        r" duration of this phase is ([\d.]+) s",
        told[0],
    )
    assert found, told
    least = float(found[1])
    assert check(limited(way | {"duration": least}), search=False).passed
    assert not check(limited(way | {"duration": 0.98 * least}), search=False).passed
    seven = np.linalg.norm(
        [20 - 2, 5 - 1, 3]
    )  # of the CM alone, without the turn: least times of the septic
    assert least > max(
        35 / 16 * seven / 3.0, (7.513 * seven / 1.5) ** 0.5, (52.5 * seven / 1.5) ** (1 / 3)
    )


@pytest.mark.parametrize("name", ["speed", "acceleration", "jerk"])
def test_least_times_from_rest_to_rest(name):
    """One limit, a straight way: the closed form of the septic blend."""
    peak = {
        "speed": 35 / 16,
        "acceleration": 84 * 5**0.5 / 25,
        "jerk": 52.5,
    }[name]
    power = {"speed": 1.0, "acceleration": 0.5, "jerk": 1 / 3}[name]
    agents = {"mass": 1.0, "position": [[0, 0, 5], [4, 0, 5], [2, 3, 5]]}
    here = np.mean(agents["position"], axis=0)
    phases = [{"kind": "fly", "position": (here + [30, 0, 0]).tolist(), "duration": "auto"}]
    mission = a_mission(phases=phases, agents=agents, limits={name: 2.0})
    assert isinstance(duration := complete_times(mission).phases[0].duration, float)
    assert duration == pytest.approx((peak * 30 / 2.0) ** power, rel=0.012)
    assert duration > (peak * 30 / 2.0) ** power


AUTO = [
    {"kind": "fly", "position": [20, 5, 8], "velocity": [2, 1, 0], "yaw_deg": 140.0, "duration": "auto"},
    {"kind": "fly", "position": [40, 5, 8], "duration": "auto", "through": [{"position": [30, 15, 9]}]},
    {"kind": "reshape", "formation": "wide", "duration": "auto", "blend": "auto"},
    {"kind": "orbit", "centre": [40, 15, 8], "radius": 10.0, "rate_deg_s": 10.0, "duration": 60.0, "blend": "auto"},
    {"kind": "turn", "yaw_deg": 0.0, "travel": "auto", "settle": {"tolerance": 0.01, "dwell": 0.5}},
    {"kind": "reshape", "formation": "triangle", "duration": "auto", "blend": 9.0},
]  # fmt: skip


def test_automatic_times_keep_the_limits_and_no_shorter_ones_do():
    """Every kind of automatic time: the flight keeps its limits, and nine tenths of one time would break one."""
    mission = limited(*AUTO)
    assert math.isnan(mission.latest_end)
    resolved = complete_times(mission)
    assert resolved.text == mission.text
    assert math.isfinite(resolved.latest_end)
    assert check(mission, search=False).passed
    result = simulate(mission)
    assert assess(result).passed, assess(result).summary
    again = simulate(Mission.from_toml(result.mission_text))
    np.testing.assert_array_equal(again.position, result.position)
    for k, phase in enumerate(resolved.phases[1:-1], start=1):
        key = (
            "blend"
            if phase.kind in ("reshape", "orbit")
            else "travel"
            if phase.kind == "turn"
            else "duration"
        )
        now = preview_phases(resolved)[0][k - 1].leg.planned_end_state
        fast = {key: 0.95 * getattr(phase, key)}
        if phase.kind == "fly" and phase.through:
            fast["through"] = tuple(
                at.model_copy(update={"time": 0.95 * (at.time or 0.0)}) for at in phase.through
            )
        quick = leg_of(resolved, phase.model_copy(update=fast), now)
        assert quick is not None
        assert broken_limits(resolved, quick), f"phase {k + 1} could be shorter"


def test_automatic_times_of_a_phase_begun_by_hand():
    """A phase begun in flight takes its least time from the state at its start."""
    mission = limited({"kind": "hold", "duration": 30.0})
    flight = Flight(mission)
    flight.begin()
    flight.advance()
    flight.begin({"kind": "fly", "position": [20, 0, 8], "duration": "auto"})
    length = flight.plan.t_end - flight.plan.start
    assert 5.0 < length < 25.0
    assert not flight.advance()
    result = flight.finish()
    assert result.phases[-1].t_end - result.phases[-1].t_start == pytest.approx(length)


@pytest.mark.parametrize(
    ("phase", "more", "told"),
    [
        ({"kind": "fly", "position": [9, 0, 8], "duration": "auto"}, {"limits": {}}, "needs a limit that bounds it"),
        ({"kind": "hold", "duration": "auto"}, {}, "has no least duration"),
        ({"kind": "turn", "yaw_deg": 9.0, "duration": "auto", "travel": 2.0}, {}, "has no effect with duration"),
        ({"kind": "turn", "yaw_deg": 9.0, "duration": "auto"}, {"smoothness": "lqr", "limits": {}}, "a smooth mission"),
        ({"kind": "fly", "position": [9, 0, 8], "settle": {}}, {}, "needs a time of arrival"),
        ({"kind": "fly", "position": [9, 0, 8], "duration": 9.0,
          "through": [{"position": [1, 1, 8], "time": 9.5}]}, {}, "passes its last point at 9.5 s"),
        ({"kind": "reshape", "formation": "wide", "duration": 9.0, "reference": "step"}, {}, "jumps"),
        ({"kind": "hold", "duration": 9.0}, {"smoothness": "lqr", "limits": {"jerk": 2.0}}, "has no effect: only"),
        ({"kind": "hold", "duration": 9.0}, {"yaw": {"kind": "towards"}}, "the point to look at"),
        ({"kind": "hold", "duration": 9.0}, {"yaw": {"yaw_deg": 3.0}}, "has no effect with kind 'formation'"),
    ],
)  # fmt: skip
def test_errors_of_automatic_times_and_points(phase, more, told):
    """Each mistake gets one error that says what to do."""
    agents = {"mass": 1.0, "position": [[0, 0, 5], [4, 0, 5], [2, 3, 5]]}
    with pytest.raises(MissionError, match=told) as error:
        limited(phase, agents=agents, **more)
    assert len(error.value.findings) == 1


def test_a_limit_that_no_time_keeps():
    """An orbit whose circle itself breaks a limit has no least blend: an error says so."""
    orbit = {
        "kind": "orbit",
        "centre": [5, 0, 8],
        "radius": 10.0,
        "rate_deg_s": 40.0,
        "duration": 30.0,
    }
    with pytest.raises(MissionError, match="no time keeps the limits"):
        complete_times(limited(orbit | {"blend": "auto"}))
    told = [r.text for r in check(limited(orbit), search=False).remarks]
    assert any("no blend of this phase keeps all limits" in text for text in told)


# -- what is recorded, and setpoints ---------------------------------------------------------------


@pytest.fixture(scope="module")
def flown_ways() -> Result:
    """A smooth flight of all kinds of phases, looking along its way."""
    return simulate(a_mission(*WAYS, yaw={"kind": "along"}))


def test_results_record_references_with_derivatives(flown_ways, tmp_path):
    """Slot velocity, acceleration and jerk are differences of the slots' positions, and survive the file."""
    flown_ways.save(tmp_path / "a.nc")
    again = Result.load(tmp_path / "a.nc")
    for name in ("slot_velocity", "slot_acceleration", "slot_jerk", "yaw", "yaw_rate"):
        np.testing.assert_array_equal(getattr(again, name), getattr(flown_ways, name))
    part = flown_ways.samples(5)  # through points
    t = flown_ways.time[part]
    spline = make_interp_spline(t, flown_ways.slot_position[part], k=7)
    inner = slice(20, -20)
    for order, name in enumerate(("slot_velocity", "slot_acceleration", "slot_jerk"), start=1):
        expected = spline(t[inner], order)
        np.testing.assert_allclose(
            getattr(flown_ways, name)[part][inner], expected, rtol=0, atol=1e-6
        )


def test_yaw_is_continuous_over_the_whole_flight(flown_ways):
    """Looking along the way: no jump of yaw or yaw rate at a switch, and the rate is that of the yaw."""
    t, yaw, rate = flown_ways.time, flown_ways.yaw, flown_ways.yaw_rate
    step = np.diff(t)[:, None]
    assert np.abs(np.diff(yaw, axis=0) - 0.5 * step * (rate[1:] + rate[:-1])).max() < 0.01
    at_switch = np.diff(flown_ways.phase) > 0
    assert np.abs(np.diff(rate, axis=0)[at_switch]).max() < 1e-6
    fast = np.linalg.norm(flown_ways.slot_velocity[..., :2], axis=-1) > 2.5
    v = flown_ways.slot_velocity[fast]
    off = np.angle(np.exp(1j * (yaw[fast] - np.arctan2(v[:, 1], v[:, 0]))))
    assert np.median(np.abs(off)) < np.deg2rad(5)


#: Names and units of position and its derivatives in a table of setpoints.
UNITS = (("", "m"), ("v", "m_s"), ("a", "m_s2"), ("j", "m_s3"))


def test_setpoints_at_any_rate_are_the_reference(tmp_path):
    """At 333 Hz, between samples 50 ms apart, setpoints are the kernel's own reference to 1e-8."""
    mission = a_mission(*WAYS[:4])
    result = simulate(mission)
    result.to_csv(tmp_path / "a.csv", rate=333.0)
    table = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True)
    time = np.repeat(np.arange(len(table) // 3) / 333.0, 3)
    np.testing.assert_allclose(table["time_s"], time, rtol=5e-9)
    flight = Flight(mission)
    checked = 0
    while flight.begin():
        plan = flight.plan
        which = (time > plan.start + 1e-6) & (time < plan.t_end - 1e-6)
        for agent in (1, 2, 3):
            mine = which & (table["agent"] == agent)
            rows, problem = table[mine], plan.problem
            exact = d.slot_derivatives(problem.reference, problem.motion, time[mine])[
                :, :, agent - 1
            ]
            for order, (name, unit) in enumerate(UNITS):
                for axis, letter in enumerate("xyz"):
                    told = rows[f"{name}{letter}_{unit}"]
                    np.testing.assert_allclose(
                        told, exact[:, order, axis], rtol=6e-9, atol=1e-9 * 30.0**order
                    )
            checked += len(rows)
        flight.advance()
    assert checked > 0.99 * len(table)


def test_the_command_writes_setpoints(tmp_path, monkeypatch):
    """`run --csv --csv-rate 10` writes ten rows a second and agent; its options need --csv."""
    monkeypatch.chdir(tmp_path)
    text = a_mission(WAYS[0]).text
    (tmp_path / "m.toml").write_text(text, encoding="utf-8")
    assert cli.main(["run", "m.toml", "--no-figures", "--csv", "--csv-rate", "10", "--flown"]) == 0
    rows = (tmp_path / "flights" / "smooth" / "smooth.csv").read_text(encoding="utf-8").splitlines()
    assert len(rows) == 1 + 3 * 171
    assert cli.main(["run", "m.toml", "--flown"]) == 2


def test_new_missions_are_smooth():
    """What `rigidfleet new` writes flies without jumps in acceleration or jerk."""
    mission = Mission.from_toml(draft("new", shape="hexagon"))
    assert mission.smooth
    for before, after in ends_of_phases(mission):
        np.testing.assert_allclose(after[:4], before[:4], rtol=0, atol=1e-7)
