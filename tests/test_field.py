"""Keys that published examples of the field need: points with a velocity, places of formations, fixed agents.

The examples themselves, on the page docs/examples-of-the-field.md, are run at the end.
"""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_missions import three_points
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from rigidfleet.assessment import Verdict, assess
from rigidfleet.errors import MissionError
from rigidfleet.math import splines
from rigidfleet.mission import Mission
from rigidfleet.preflight.check import check
from rigidfleet.result import Result
from rigidfleet.simulation import ensemble
from rigidfleet.simulation.flight import Flight, simulate
from rigidfleet.simulation.together import simulate_together

Data = dict[str, Any]
G = 9.81


def a_mission(*phases: Data, **more: Any) -> Mission:
    """Three agents that form a triangle about (2, 1, 5) m and then fly these phases, smoothly unless told."""
    data = three_points({"duration": 5.0}, *phases)
    return Mission.from_dict(data | more)


def errors(make: Any) -> str:
    """What a mission is refused for."""
    with pytest.raises(MissionError) as caught:
        make()
    return str(caught.value)


# -- points with a velocity --------------------------------------------------------------------------


def least_snap(times: Any, x: Any, begin: Any, end: Any, velocities: Any) -> np.ndarray:
    """Coefficients (n, 8) of the least integral of snap^2, by the conditions of optimality of its quadratic programme.

    Position at all points, three derivatives at the ends, velocities where they are given, and continuity of three
    derivatives are constraints; nothing is said of higher derivatives.
    """
    n, h = len(times) - 1, np.diff(times)
    cost = np.zeros((8 * n, 8 * n))
    p = np.arange(4, 8)
    f = p * (p - 1.0) * (p - 2.0) * (p - 3.0)
    for i in range(n):
        at = slice(8 * i + 4, 8 * i + 8)
        cost[at, at] = np.outer(f, f) * h[i] ** (p[:, None] + p - 7) / (p[:, None] + p - 7)
    rows, sides = [], []

    def row(i: int, order: int, u: float) -> np.ndarray:
        found = np.zeros(8 * n)
        for k in range(order, 8):
            found[8 * i + k] = math.perm(k, order) * u ** (k - order)
        return found

    for i in range(n):
        rows += [row(i, 0, 0.0), row(i, 0, h[i])]
        sides += [x[i], x[i + 1]]
    for order in range(1, 4):
        rows += [row(0, order, 0.0), row(n - 1, order, h[-1])]
        sides += [begin[order - 1], end[order - 1]]
        for i in range(n - 1):
            rows.append(row(i, order, h[i]) - row(i + 1, order, 0.0))
            sides.append(0.0)
    for i, v in enumerate(velocities):
        if v is not None:
            rows.append(row(i + 1, 1, 0.0))
            sides.append(v)
    A, m = np.array(rows), len(rows)
    K = np.block([[cost, A.T], [A, np.zeros((m, m))]])
    rest = np.concatenate([np.zeros(8 * n), sides])
    return np.linalg.lstsq(K, rest, rcond=1e-15)[0][: 8 * n].reshape(n, 8)


@pytest.mark.parametrize(
    "velocities",
    [[2.0], [None], [0.0, None, -1.5], [None, 0.7, None], [1.0, -1.0, 0.5]],
    ids=str,
)
def test_points_with_a_velocity_have_the_least_snap(velocities):
    """The way is that of a quadratic programme solved as such, whichever points have a velocity."""
    n = len(velocities) + 1
    rng = np.random.default_rng(n)
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.6, 1.8, n))])
    x, begin, end = rng.normal(size=n + 1), rng.normal(size=3), rng.normal(size=3)
    expected = least_snap(times, x, begin, end, velocities)
    column = [np.array([np.nan if v is None else v]) for v in velocities]
    found = splines.minimum_snap(times, x[:, None], begin[:, None], end[:, None], *column)[:, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
    cost = splines.snap_cost(found[:, None], times)
    assert cost == pytest.approx(splines.snap_cost(expected[:, None], times), rel=1e-9)


def through(**more: Any) -> Data:
    """A leg of 20 m past two points, the second with a velocity."""
    points = [
        {"position": [8, 4, 7], "time": 3.0},
        {"position": [15, -2, 6], "time": 6.0, "velocity": [2.5, 0.0, 0.5]},
    ]
    return {"kind": "fly", "position": [20, 0, 5], "through": points, "duration": 9.0} | more


def test_a_velocity_on_the_way_is_flown_and_judged(tmp_path):
    """It is flown to the integrator's accuracy, stands in the record, and a flight that misses it fails."""
    mission = a_mission(through())
    result = simulate(mission)
    verdict = assess(result)
    assert verdict.passed, verdict.summary
    first, second = verdict.phases[1].through
    assert first.velocity is None
    assert second.velocity == pytest.approx(0.0, abs=1e-3)
    k = int(np.argmin(abs(result.time - 11.0)))  # 6 s after the start of the leg
    np.testing.assert_allclose(result.cm_velocity[k], [2.5, 0.0, 0.5], atol=1e-3)
    result.save(tmp_path / "flight.nc")
    again = Result.load(tmp_path / "flight.nc")
    assert again.phases[1].target == result.phases[1].target
    again.cm_velocity[k] += [0.0, 0.3, 0.0]
    (missed,) = [c for c in assess(again).checks if c.check == "waypoint_velocity" and not c.passed]
    assert missed.message.startswith("point 2 on the way of phase 'fly 2' is missed, 0.3")


@pytest.mark.parametrize("speed", [0.5, 2.0, 3.0])
def test_times_of_points_with_a_velocity_have_the_least_snap(speed):
    """Without times, no other moment for the point costs less snap."""
    points = [{"position": [8, 4, 7], "velocity": [speed, 0.0, 0.0]}]
    mission = a_mission({"kind": "fly", "position": [20, 0, 5], "through": points, "duration": 9.0})
    flight = Flight(mission)
    flight.begin()
    flight.advance()
    flight.begin()
    plan = flight.plan
    t = plan.through[0]["time"] - plan.start
    states = np.array([[2, 1, 5], [8, 4, 7], [20, 0, 5]])

    def cost(at: float) -> float:
        times, zero = np.array([0.0, at, 9.0]), np.zeros((3, 3))
        pieces = splines.minimum_snap(times, states, zero, zero, np.array([speed, 0.0, 0.0]))
        return splines.snap_cost(pieces, times)

    assert all(cost(t) <= cost(t + d) for d in (-0.3, -0.02, 0.02, 0.3))


def test_automatic_times_keep_the_limits_past_a_point_with_a_velocity():
    """The least time of such a leg keeps the limits in flight; a velocity beyond the limit has no least time."""
    limits = {"speed": 3.0, "acceleration": 2.0}
    points = [{"position": [8, 4, 7], "velocity": [2.0, 0.0, 0.0]}]
    leg = {"kind": "fly", "position": [20, 0, 5], "through": points, "duration": "auto"}
    verdict = assess(simulate(a_mission(leg, limits=limits)))
    assert verdict.passed, verdict.summary
    assert verdict.worst["acceleration"].value < 2.0
    assert verdict.worst["speed"].value == pytest.approx(3.0, rel=0.02)
    points[0]["velocity"] = [4.0, 0.0, 0.0]
    assert "no time keeps the limits" in errors(lambda: simulate(a_mission(leg, limits=limits)))


# -- places of formations ----------------------------------------------------------------------------


def at_place(result: Result, phase: int, place: Any) -> Verdict:
    """The verdict on a flight, of which a phase has to end at rest at a place."""
    verdict = assess(result)
    waypoint = verdict.phases[phase].waypoint
    assert waypoint is not None
    assert waypoint.position == pytest.approx(0.0, abs=5e-3)
    assert waypoint.velocity == pytest.approx(0.0, abs=0.03)
    k = int(np.flatnonzero(result.time <= result.phases[phase].t_end + 1e-9)[-1])
    np.testing.assert_allclose(result.cm[k], place, atol=5e-3)
    return verdict


def test_establish_leads_to_its_place_on_the_septic():
    """From rest to rest, the centre's reference is x0 + (x1 - x0)(35 s^4 - 84 s^5 + 70 s^6 - 20 s^7)."""
    phase = {"kind": "establish", "formation": "triangle", "position": [9, -3, 8], "duration": 6.0}
    result = simulate(a_mission(phases=[phase]))
    assert at_place(result, 0, [9, -3, 8]).passed
    s = result.time / 6.0
    blend = s**4 * (35 - s * (84 - s * (70 - 20 * s)))
    start = np.array([2.0, 1.0, 5.0])
    expected = start + blend[:, None] * (np.array([9, -3, 8]) - start)
    np.testing.assert_allclose(result.cm_reference, expected, atol=1e-9)


PLACED: dict[str, Data] = {
    "straight": {},
    "layers": {"transition": "layers", "duration": 18.0, "blend": 12.0},
    "auto": {"transition": "auto"},
    "ways": {"transition": "ways"},
    "settle": {"duration": None, "settle": {"tolerance": 0.01, "timeout": 20.0}},
    "least time": {"duration": "auto", "blend": "auto"},
    "least duration": {"duration": "auto", "blend": 3.0},
    "by distances": {"reference": "squares"},
}


@pytest.mark.parametrize("how", PLACED)
def test_reshape_leads_to_its_place(how):
    """However the shape changes and the phase ends, the formation is at rest at the place, and stays there."""
    phase = {"kind": "reshape", "formation": "wide", "position": [6, 4, 9], "duration": 10.0}
    phase = {key: x for key, x in (phase | PLACED[how]).items() if x is not None}
    limits = {"speed": 3.0, "acceleration": 2.0, "separation": 0.5}
    mission = a_mission(phase, {"kind": "hold", "duration": 3.0}, limits=limits)
    assert check(mission).passed
    result = simulate(mission)
    verdict = at_place(result, -2, [6, 4, 9])
    assert verdict.passed, verdict.summary
    np.testing.assert_allclose(result.cm[-1], [6, 4, 9], atol=5e-3)


@pytest.mark.parametrize("architecture", ["local", "body"])
def test_regulators_lead_to_places_too(architecture):
    """Of missions that are not smooth: the shape, its place and its attitude are met together."""
    establish = {
        "kind": "establish",
        "formation": "triangle",
        "position": [6, 2, 8],
        "yaw_deg": 40.0,
    }
    establish |= {"duration": 10.0, "control": "tracking"}
    reshape = {"kind": "reshape", "formation": "wide", "position": [2, 2, 6], "duration": 10.0}
    reshape |= {"control": "tracking"}
    mission = a_mission(phases=[establish, reshape], smoothness="lqr", architecture=architecture)
    result = simulate(mission)
    at_place(result, 0, [6, 2, 8])
    verdict = at_place(result, 1, [2, 2, 6])
    assert verdict.passed, verdict.summary
    (first, _) = (phase.waypoint for phase in verdict.phases)
    assert first is not None
    assert first.attitude == pytest.approx(0.0, abs=0.1)


def test_places_need_tracked_slots():
    """Forces between agents lead nowhere, and a wrench on the body has no place for a change of shape."""
    phase = {"kind": "establish", "formation": "triangle", "position": [0, 0, 5], "duration": 5.0}
    more = {"smoothness": "lqr", "phases": [phase | {"control": "open"}]}
    told = errors(lambda: a_mission(**more))
    assert "position" in told
    assert "needs tracked slots" in told
    assert "use control = 'tracking'" in told
    reshape = {"kind": "reshape", "formation": "wide", "position": [0, 0, 5], "duration": 5.0}
    body = {"smoothness": "lqr", "architecture": "body"}
    assert "needs tracked slots" in errors(lambda: a_mission(reshape, **body))


# -- fixed agents ------------------------------------------------------------------------------------


def hung(*rods: tuple[int, int, float], position: Any, **more: Any) -> Mission:
    """Agents joined by rods (agent, agent, length [m]); gravity is for a user's force, and the first agent is fixed."""
    agents = {"mass": 1.0, "position": position, "fixed": [1]} | more.pop("agents", {})
    data: Data = {
        "schema_version": 1,
        "name": "hung",
        "output_step": 0.01,
        "agents": agents,
        "constraint": {"solver": "pinv", "deformation_damping": 0.0},
        "integrator": {"rtol": 1e-10, "atol": 1e-12},
        "formations": {
            "rods": {"edges": [rod[:2] for rod in rods], "distances": [rod[2] for rod in rods]}
        },
        "phases": [
            {"kind": "establish", "formation": "rods", "control": "open", "reference": "step", "duration": 6.0}
        ],
    }  # fmt: skip
    return Mission.from_dict(data | more)


def weight(mission: Mission) -> Any:
    """The weight of all agents, as a user's force: without it, agents without slots are held against gravity."""
    masses = mission.fleet.mass

    def force(t: float, r: Any, v: Any) -> Any:
        return masses[:, None] * [0.0, 0.0, -G]

    return force


@pytest.mark.parametrize("formulation", ["inertial", "body"])
@pytest.mark.parametrize("degrees", [5.0, 60.0, 150.0])
def test_a_pendulum_has_the_period_of_the_elliptic_integral(degrees, formulation):
    """T = 4 sqrt(L/g) K(sin^2(theta/2)); the pivot does not move, whatever its mass."""
    L, angle = 1.0, math.radians(degrees)
    bob = [L * math.sin(angle), 0.0, 10.0 - L * math.cos(angle)]
    agents = {"mass": [0.3, 2.0]}
    mission = hung((1, 2, L), position=[[0, 0, 10], bob], agents=agents, formulation=formulation)
    result = simulate(mission, force=weight(mission))
    still = 0.0 if formulation == "inertial" else 1e-8
    assert np.abs(result.position[:, 0] - [0, 0, 10]).max() <= still
    period = 4.0 * math.sqrt(L / G) * ellipk(math.sin(angle / 2) ** 2)
    for turns in range(1, int(6.0 / period) + 1):  # back at the start, after each period
        x = [np.interp(turns * period, result.time, result.position[:, 1, s]) for s in (0, 2)]
        np.testing.assert_allclose(x, [bob[0], bob[2]], atol=2e-4)  # of an interpolation by lines
    speed = np.sum(result.velocity[:, 1] ** 2, axis=1)
    energy = 0.5 * speed + G * result.position[:, 1, 2]
    np.testing.assert_allclose(energy, energy[0], rtol=1e-8)


def test_a_double_pendulum_is_that_of_lagrange():
    """Two rods, from SciPy's solution of the equations of motion in angles."""
    L, m1, m2 = 1.5, 1.0, 2.0
    mission = hung(
        (1, 2, L), (2, 3, L),
        position=[[0, 0, 10], [L, 0, 10], [L, 0, 10 - L]], agents={"mass": [5.0, m1, m2]},
    )  # fmt: skip
    result = simulate(mission, force=weight(mission))

    def rates(t: float, y: Any) -> list[float]:
        a, b, p, q = y
        c, s = math.cos(a - b), math.sin(a - b)
        A = L * L * np.array([[m1 + m2, m2 * c], [m2 * c, m2]])
        f = L * np.array([
            -m2 * L * q * q * s - (m1 + m2) * G * math.sin(a), m2 * L * p * p * s - m2 * G * math.sin(b),
        ])  # fmt: skip
        return [p, q, *np.linalg.solve(A, f)]

    at = result.time[result.time <= 4.0]
    y = solve_ivp(rates, (0, 4), [math.pi / 2, 0, 0, 0], rtol=1e-12, atol=1e-13, t_eval=at).y
    one = np.stack([L * np.sin(y[0]), 0 * at, 10 - L * np.cos(y[0])], axis=1)
    two = one + np.stack([L * np.sin(y[1]), 0 * at, -L * np.cos(y[1])], axis=1)
    np.testing.assert_allclose(result.position[: len(at), 1], one, atol=1e-7)
    np.testing.assert_allclose(result.position[: len(at), 2], two, atol=1e-7)


@pytest.mark.parametrize("solver", ["pinv", "spectral"])
def test_an_agent_hung_from_two_pivots_swings_as_about_an_axis(solver):
    """It swings about the line through both, as a pendulum as long as it hangs below; a rod between them is idle."""
    rods = [(1, 2, 2.0), (1, 3, math.sqrt(2.0)), (2, 3, math.sqrt(2.0))]
    a = math.radians(40.0)
    places = [[-1, 0, 10], [1, 0, 10], [0.0, math.sin(a), 10 - math.cos(a)]]
    for some in (rods[1:], rods) if solver == "pinv" else (rods[1:],):
        constraint = {"solver": solver, "deformation_damping": 0.0}
        mission = hung(*some, position=places, agents={"fixed": [2, 1]}, constraint=constraint)
        result = simulate(mission, force=weight(mission))
        assert not result.ending
        assert (result.position[:, :2] == result.position[0, :2]).all()
        period = 4.0 * math.sqrt(1.0 / G) * ellipk(math.sin(a / 2) ** 2)
        y = np.interp(2 * period, result.time, result.position[:, 2, 1])
        assert y == pytest.approx(math.sin(a), abs=1e-4)


def test_wind_and_other_flights_leave_fixed_agents_alone():
    """Wind, errors of masses, a sweep's eight flights and an ensemble: no fixed agent moves, and the others circle."""
    d: Data = {"wind": [5.0, 2.0, 1.0], "mass_error": 0.3}
    places = [[0, 0, 10], [2, 0, 10]]
    blown = hung((1, 2, 2.0), position=places, disturbances=d)
    result = simulate(blown)
    assert (result.position[:, 0] == [0, 0, 10]).all()
    assert np.abs(result.position[-1, 1] - [2, 0, 10]).max() > 0.1
    turning = [
        hung((1, 2, 2.0), position=places, agents={"mass": [m, 2.0], "velocity": [[0, 0, 0], [0, 1, 0]]})
        for m in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
    ]  # fmt: skip
    for found in simulate_together(turning):  # at rest about the pivot, at v / L
        turned = 0.5 * found.time
        circle = [2 * np.cos(turned), 2 * np.sin(turned), np.full(len(turned), 10.0)]
        np.testing.assert_allclose(found.position[:, 1], np.transpose(circle), atol=1e-6)
        assert (found.position[:, 0] == [0, 0, 10]).all()
    ends = ensemble.establish(turning[0], np.array([places]), np.array([[[0, 0, 0], [0, 1, 0]]]))
    expected = [[0, 0, 10], [2 * math.cos(3.0), 2 * math.sin(3.0), 10]]
    np.testing.assert_allclose(ends.position[0], expected, atol=1e-6)


@pytest.mark.parametrize(
    ("agents", "more", "words"),
    [
        ({"fixed": [3]}, {}, "there is no such agent"),
        ({"fixed": [1, 1]}, {}, "names an agent twice"),
        ({"velocity": [[0, 1, 0], [0, 0, 0]]}, {}, "starts with a velocity"),
        ({}, {"constraint": {}}, "use constraint.solver = 'pinv'"),
        ({}, {"disturbances": {"lost": [{"agent": 2, "time": 1.0}]}}, "not lost"),
    ],
    ids=lambda x: "" if isinstance(x, dict) else x,
)
def test_what_fixed_agents_cannot_do_is_refused(agents, more, words):
    """Each error names the key, and what to do about it."""
    told = errors(
        lambda: hung((1, 2, 2.0), position=[[0, 0, 10], [2, 0, 10]], agents=agents, **more)
    )
    assert "agents.fixed" in told
    assert words in told


def test_fixed_agents_track_nothing():
    """With tracked slots, a fixed agent is refused, as its slot may move."""
    agents = {"mass": 1.0, "position": [[0, 0, 5], [4, 0, 5], [2, 3, 5]], "fixed": [1]}
    told = errors(lambda: a_mission(agents=agents, constraint={"solver": "pinv"}))
    assert "cannot track slots" in told
    assert "control = 'open'" in told


# -- the page ----------------------------------------------------------------------------------------


def test_each_example_of_the_page_prints_what_it_says(capsys):
    """Each block of the page runs after those above it, asserts its comparison, and prints the lines below it."""
    text = Path(__file__).parents[1].joinpath("docs/examples-of-the-field.md").read_text("utf-8")
    blocks = re.findall(
        r"^```python\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?", text, re.DOTALL | re.MULTILINE
    )
    assert len(blocks) == 7
    number, names = re.compile(r"-?\d+\.?\d*(?:e[-+]\d+)?"), {}
    for code, shown in blocks:
        exec(compile(code, "examples-of-the-field.md", "exec"), names)
        printed = capsys.readouterr().out
        assert number.sub("", printed) == number.sub("", shown)
        assert "assert " in code or not shown
        for x, y in zip(number.findall(printed), number.findall(shown), strict=True):
            if "e" in y:  # an error of a method, which other processors round otherwise
                assert abs(float(x)) <= 10 * abs(float(y))
            else:
                assert float(x) == pytest.approx(float(y), rel=1e-6)


def test_a_free_arrival_keeps_velocities_on_the_way():
    """A way with velocities at its points whose own arrival is free: both hold, and no other arrival costs less."""
    times, x = np.array([0.0, 2.0, 5.0]), np.array([[0.0], [3.0], [4.0]])
    begin, v = np.zeros((3, 1)), np.array([[1.5]])[0]

    def cost(way):  # the integral of the square of the snap
        total = 0.0
        for piece, h in zip(way[:, 0], np.diff(times), strict=True):
            snap = np.polynomial.Polynomial(piece).deriv(4)
            total += (snap * snap).integ()(h)
        return total

    free = splines.minimum_snap(times, x, begin, np.array([[np.nan], [0.0], [0.0]]), v)
    assert np.polynomial.Polynomial(free[0, 0]).deriv()(2.0) == pytest.approx(1.5)
    for speed in np.linspace(-3.0, 3.0, 25):
        fixed = splines.minimum_snap(times, x, begin, np.array([[speed], [0.0], [0.0]]), v)
        assert cost(free) <= cost(fixed) * (1 + 1e-9)
