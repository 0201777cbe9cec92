"""What no flight may change: momentum, the frame it is told in, the order of agents, the equations."""

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rigidfleet import physics
from rigidfleet.math import attitude, pid
from rigidfleet.mission import Mission, load_mission
from rigidfleet.result import Result
from rigidfleet.simulation.flight import simulate

SOLVERS = ["iterated", "spectral", "exact", "pinv"]
TIMES = np.linspace(0.0, 4.0, 9)
TIGHT = {"rtol": 1e-9, "atol": 1e-11}

seeds = st.integers(0, 2**32 - 1)
some = settings(max_examples=20)
few = settings(max_examples=8)  # with forces written in Python

Data = dict[str, Any]


def complete(n: int) -> np.ndarray:
    return np.column_stack(np.triu_indices(n, 1))


def lengths(r: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.linalg.norm(r[..., edges[:, 0], :] - r[..., edges[:, 1], :], axis=-1)


def spread(rng: np.random.Generator, n: int) -> np.ndarray:
    """Positions (n, 3) that fill space evenly: no two close, no four near a plane."""
    directions = np.array(
        [[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1], [0, 0, 2.5], [2.5, 0, 0], [0, -2.5, 0]]
    )
    turn = Rotation.random(random_state=rng)
    return turn.apply(2.0 * directions[:n] + rng.uniform(-0.3, 0.3, (n, 3)))


def a_flight(rng: np.random.Generator, n: int, **changes: Any) -> Data:
    """A mission that reshapes n unequal agents by constraint forces alone, as plain data."""
    r = spread(rng, n) + [2, -1, 20]
    goal = r * rng.uniform(0.8, 1.3, 3) + rng.uniform(-0.2, 0.2, (n, 3))
    data: Data = {
        "schema_version": 1,
        "name": "invariant",
        "agents": {
            "mass": rng.uniform(0.5, 2.0, n),
            "position": r,
            "velocity": rng.normal(size=(n, 3)) * 0.3,
        },
        "integrator": TIGHT,
        "formations": {"goal": {"slots": goal}},
        "phases": [{"kind": "establish", "formation": "goal", "control": "open", "until": 4.0}],
    }
    return data | changes


def fly(data: Data, times: np.ndarray = TIMES, force: Any = None) -> Result:
    result = simulate(Mission.from_dict(data), times=times, force=force)
    assert result.complete, result.ending
    return result


# -- the constraint force --------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
@settings(max_examples=50)
@given(seed=seeds, n=st.integers(2, 8), flat=st.sampled_from([1.0, 1e-3, 0.0]))
def test_constraint_force_has_no_net_force_and_no_net_torque(solver, seed, n, flat):
    """Sum of f_C and of r x f_C vanish: any graph, masses, shape (flat too) and solver."""
    rng = np.random.default_rng(seed)
    r = rng.normal(size=(n, 3)) * [4, 4, 4 * flat]
    edges = rng.permutation(complete(n))[: rng.integers(1, n * (n - 1) // 2, endpoint=True)]
    options: dict[str, Any] = {"solver": solver, "f_E": rng.normal(size=(n, 3))}
    force = physics.constraint_force(
        r, rng.normal(size=(n, 3)), rng.uniform(0.3, 3.0, n), edges,
        rng.uniform(1, 8, len(edges)), integral=rng.normal(size=len(edges)), **options,
    )  # fmt: skip
    f = force.f_C
    assume(np.isfinite(f).all())  # the exact solver where there is no inverse
    scale = np.abs(force.multiplier).sum()
    np.testing.assert_allclose(f.sum(axis=0), 0, atol=1e-13 * scale)
    torque = np.cross(r - r.mean(axis=0), f).sum(axis=0)
    np.testing.assert_allclose(torque, 0, atol=1e-13 * scale * np.abs(r).max())


@pytest.mark.parametrize("solver", ["iterated", "spectral", "pinv"])
@settings(max_examples=10)
@given(seed=seeds, n=st.integers(2, 6))
def test_momentum_and_angular_momentum_are_conserved(solver, seed, n):
    """Without external force neither constraint forces nor deformation damping change P or L."""
    rng = np.random.default_rng(seed)
    data = a_flight(rng, n, gravity=0.0, constraint={"solver": solver, "deformation_damping": 2.0})
    result = fly(data)
    assert np.abs(result.constraint_force).max() > 0.1
    m = np.array(data["agents"]["mass"])[:, None]
    momentum = (m * result.velocity).sum(axis=1)
    spin = (m * np.cross(result.position, result.velocity)).sum(axis=1)
    np.testing.assert_allclose(momentum, np.tile(momentum[0], (len(momentum), 1)), atol=1e-11)
    np.testing.assert_allclose(spin, np.tile(spin[0], (len(spin), 1)), atol=2e-8)


@some
@given(seed=seeds, n=st.integers(2, 5), p=st.floats(0.8, 2.5), ringing=st.booleans())
def test_errors_follow_their_closed_form(seed, n, p, ringing):
    """After a step each c obeys c''' + 2 alpha c'' + beta^2 c' + gamma c = 0, whatever forces act.

    The paper's law (exact, undamped), unequal masses, agents in motion, gravity not balanced.
    """
    rng = np.random.default_rng(seed)
    edges = complete(n)[:9]  # of five agents, all but one: ten are redundant
    r = spread(rng, n)
    alpha, beta, gamma = pid.triple_pole(p)
    if ringing:
        beta *= 1.5
    d = lengths(r + rng.uniform(-0.15, 0.15, (n, 3)), edges)
    data = a_flight(
        rng,
        n,
        constraint={
            "solver": "exact",
            "deformation_damping": 0.0,
            "alpha": alpha,
            "beta": beta,
            "gamma": gamma,
        },
        formations={"goal": {"edges": edges + 1, "distances": d}},
    )
    data["agents"] |= {"position": r, "velocity": rng.normal(size=(n, 3)) * 0.1}
    data["phases"][0] |= {"reference": "step", "input_force": [0.1, -0.2, -1.0]}
    result = fly(data, force=lambda t, r, v: np.sin(t) - 0.1 * v)
    u = r[edges[:, 0]] - r[edges[:, 1]]
    u /= np.linalg.norm(u, axis=1)[:, None]
    v = data["agents"]["velocity"]
    c_dot = np.einsum("ka,ka->k", u, v[edges[:, 0]] - v[edges[:, 1]])
    c, _, integral = pid.error_response(
        alpha, beta, gamma, lengths(r, edges) - d, c_dot, 0.0, TIMES
    )
    np.testing.assert_allclose(result.constraint, c, rtol=0, atol=1e-8)
    np.testing.assert_allclose(result.integral, integral, rtol=0, atol=1e-8)


# -- the equations of motion -----------------------------------------------------------------------


@few
@given(seed=seeds, n=st.integers(2, 6))
def test_newton_and_the_body_frame_fly_alike(seed, n):
    """Newton's equations and the paper's in the body frame: the same positions, attitude and rates.

    Unequal masses that deform under constraint forces and a force of t, r and v.
    """
    rng = np.random.default_rng(seed)
    data = a_flight(rng, n, body_frame={"roll_deg": 20.0, "pitch_deg": -50.0, "yaw_deg": 130.0})

    def force(t: float, r: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.sin(t + np.arange(3 * len(r))).reshape(-1, 3) - 0.2 * v + 0.05 * r[:, [2, 0, 1]]

    newton = fly(data, force=force)
    body = fly(data | {"formulation": "body"}, force=force)
    np.testing.assert_allclose(body.position, newton.position, rtol=0, atol=1e-7)
    np.testing.assert_allclose(body.velocity, newton.velocity, rtol=0, atol=1e-7)
    np.testing.assert_allclose(body.constraint, newton.constraint, rtol=0, atol=1e-8)
    np.testing.assert_allclose(body.frame, newton.frame, rtol=0, atol=1e-7)
    np.testing.assert_allclose(body.rates, newton.rates, rtol=0, atol=1e-7)
    turned = np.linalg.norm(newton.frame[-1] - newton.frame[0])
    assert turned > 0.01


@pytest.mark.parametrize(
    ("name", "architecture"),
    [
        ("single-waypoint", "local"),
        ("single-waypoint", "body"),
        ("cube-waypoint", "body"),
        ("establish-triangle", "local"),
        ("narrow-passage", "local"),
    ],
)
def test_both_formulations_fly_the_papers_missions_alike(name, architecture):
    """The closed loop too is the same in both formulations, through switches and past the line."""
    data = load_mission(name).to_dict() | {"architecture": architecture}
    data["integrator"] = {"rtol": 1e-10, "atol": 1e-12}
    times = np.arange(0.0, Mission.from_dict(data).latest_end, 0.5)
    newton = fly(data, times=times)
    body = fly(data | {"formulation": "body"}, times=times)
    np.testing.assert_allclose(body.position, newton.position, rtol=0, atol=1e-6)
    np.testing.assert_allclose(body.thrust, newton.thrust, rtol=0, atol=1e-5)
    both = np.isfinite(newton.attitude[:, 0]) & np.isfinite(body.attitude[:, 0])
    angle = attitude.angle_between(body.attitude[both], newton.attitude[both])
    assert angle.max(initial=0.0) < 1e-6


# -- the frame and the order in which a flight is told ---------------------------------------------


@some
@given(seed=seeds, n=st.integers(2, 6))
def test_the_order_of_agents_does_not_matter(seed, n):
    """Agents renumbered, with their masses, slots and edges, fly as before."""
    rng = np.random.default_rng(seed)
    edges = rng.permutation(complete(n))
    data = a_flight(rng, n)
    goal = data["formations"]["goal"]
    goal["edges"] = edges + 1
    new = rng.permutation(n)  # agent i becomes agent new[i]
    old = np.argsort(new)
    other = data | {
        "agents": {key: value[old] for key, value in data["agents"].items()},
        "formations": {"goal": {"slots": goal["slots"][old], "edges": new[edges] + 1}},
    }
    a, b = fly(data), fly(other)
    np.testing.assert_allclose(b.position, a.position[:, old], rtol=0, atol=1e-8)
    np.testing.assert_allclose(b.constraint_force, a.constraint_force[:, old], rtol=0, atol=1e-7)
    np.testing.assert_allclose(b.multiplier, a.multiplier, rtol=0, atol=1e-7)


@few
@given(seed=seeds, n=st.integers(2, 6))
def test_a_turned_world_flies_as_before(seed, n):
    """World, gravity and inputs turned together: every vector turns with them, no distance changes."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(random_state=rng).as_matrix()
    data = a_flight(rng, n, gravity=0.0)
    m = data["agents"]["mass"][:, None]

    def pushed(turn: np.ndarray) -> Any:
        """Gravity, and a force of t, r and v, of a world that is turned."""

        def force(t: float, r: np.ndarray, v: np.ndarray) -> np.ndarray:
            r, v = r @ turn, v @ turn
            f = [0.0, 0.0, -9.81] * m + np.sin(t + np.arange(3)) - 0.1 * v + 0.02 * r[:, [1, 2, 0]]
            return f @ turn.T

        return force

    turned = data | {
        "agents": {
            "mass": data["agents"]["mass"],
            "position": data["agents"]["position"] @ R.T,
            "velocity": data["agents"]["velocity"] @ R.T,
        }
    }
    push = np.array([0.1, 0.3, 9.0])
    data["phases"] = [data["phases"][0] | {"input_force": push}]
    turned["phases"] = [data["phases"][0] | {"input_force": R @ push}]
    a, b = fly(data, force=pushed(np.eye(3))), fly(turned, force=pushed(R))
    np.testing.assert_allclose(b.position, a.position @ R.T, rtol=0, atol=1e-7)
    np.testing.assert_allclose(b.constraint_force, a.constraint_force @ R.T, rtol=0, atol=1e-7)
    np.testing.assert_allclose(b.multiplier, a.multiplier, rtol=0, atol=1e-7)
    np.testing.assert_allclose(b.distance, a.distance, rtol=0, atol=1e-7)


@some
@given(seed=seeds, n=st.integers(2, 6))
def test_a_moved_world_flies_as_before(seed, n):
    """Every start moved by one vector: every position is, and nothing else changes."""
    rng = np.random.default_rng(seed)
    move = rng.uniform(-50, 50, 3)
    data = a_flight(rng, n)
    moved = data | {"agents": data["agents"] | {"position": data["agents"]["position"] + move}}
    a, b = fly(data), fly(moved)
    np.testing.assert_allclose(b.position, a.position + move, rtol=0, atol=1e-7)
    np.testing.assert_allclose(b.constraint_force, a.constraint_force, rtol=0, atol=1e-7)


def a_tour(architecture: str, yaw: float, move: np.ndarray, order: np.ndarray) -> Data:
    """Establish, fly with a turn, reshape: turned about the vertical, moved, agents renumbered."""
    turn = Rotation.from_euler("z", yaw, degrees=True)
    old = np.argsort(order)
    start = np.array([[1.0, 6.0, 3.0], [8.0, 3.0, 3.5], [7.0, 6.0, 3.0], [4.0, 3.0, 6.0]])
    first = np.array([[0.0, 2.0, 0.0], [0.0, -2.0, 0.0], [3.0, 0.0, 0.0], [1.0, 0.0, 3.0]])
    second = first * [1.5, 0.8, 0.7]
    return {
        "schema_version": 1,
        "name": "tour",
        "architecture": architecture,
        "agents": {"mass": np.array([1.0, 1.2, 0.8, 1.5])[old], "position": turn.apply(start)[old] + move},
        "integrator": TIGHT,
        "lqr": {"attitude": {"S": [1e5, 1e4]}},
        "formations": {"first": {"slots": first[old]}, "second": {"slots": second[old]}},
        "phases": [
            {"kind": "establish", "formation": "first", "control": "open", "duration": 6.0},
            {
                "kind": "fly",
                "position": turn.apply([10.0, -3.0, 9.0]) + move,
                "velocity": turn.apply([0.5, 1.0, 0.2]),
                "yaw_deg": 40.0 + yaw,
                "rates_deg_s": [0.0, 0.0, 3.0],
                "duration": 9.0,
            },
            {"kind": "reshape", "formation": "second", "duration": 5.0},
            {"kind": "hold", "duration": 2.0},
        ],
    }  # fmt: skip


@pytest.mark.parametrize("architecture", ["local", "body"])
def test_a_whole_mission_is_told_alike_in_any_frame_and_order(architecture):
    """Waypoints, attitudes and reshaping: a mission turned, moved and renumbered is the same flight."""
    times = np.arange(0.0, 22.1, 0.5)
    yaw, move, order = 75.0, np.array([30.0, -20.0, 5.0]), np.array([2, 0, 3, 1])
    a = fly(a_tour(architecture, 0.0, np.zeros(3), np.arange(4)), times=times)
    b = fly(a_tour(architecture, yaw, move, order), times=times)
    turn = Rotation.from_euler("z", yaw, degrees=True).as_matrix()
    old = np.argsort(order)
    np.testing.assert_allclose(b.position, (a.position @ turn.T)[:, old] + move, rtol=0, atol=1e-6)
    np.testing.assert_allclose(b.thrust, a.thrust[:, old], rtol=0, atol=1e-5)
    np.testing.assert_allclose(b.rates, a.rates, rtol=0, atol=1e-6)
    turned = attitude.quaternion_multiply(
        attitude.quaternion_from_euler([0.0, 0.0, np.deg2rad(yaw)]), a.attitude
    )
    known = np.isfinite(a.attitude[:, 0])
    assert known.any()
    assert attitude.angle_between(b.attitude[known], turned[known]).max() < 1e-6
