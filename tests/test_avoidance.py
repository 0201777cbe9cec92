"""Avoidance in flight: the guard's theorem, barriers against an exact solver, what missions may ask, what is told."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear
from vehicle_samples import planned

import rigidfleet as rf
from rigidfleet.errors import MissionError
from rigidfleet.kernel import fleet
from rigidfleet.kernel.avoidance import avoidance_arrays
from rigidfleet.kernel.engine import sampled
from rigidfleet.kernel.problem import graph, workspace
from rigidfleet.solids.records import half_space, one_solid

G = 9.81


def crowd(position, *, limit=14.0, period=0.02, until=3.0, velocity=None, **tables):
    """Points of 1 kg and radius 0.25 m under [avoidance], which take the shape in which they start."""
    agents: dict[str, Any] = {"vehicle": "point", "position": np.asarray(position).tolist()}
    if velocity is not None:
        agents["velocity"] = np.asarray(velocity).tolist()
    data: dict[str, Any] = {
        "schema_version": 1, "name": "crowd", "output_step": 0.1, "agents": agents,
        "vehicles": {"point": {"model": "point", "mass": 1.0, "thrust_limit": limit}},
        "autopilot": {"rate": 1.0 / period, "formation_rate": 1.0 / period, "step": 0.01},
        "formations": {"own": {"slots": np.asarray(position).tolist(), "edges": [[1, 2]]}},
        "phases": [
            {"kind": "establish", "formation": "own", "control": "tracking", "until": until, "blend": 0.5}
        ],
        "avoidance": {},
    }  # fmt: skip
    return rf.Mission.from_dict(data | tables)


def worst(result, name):
    """The worst value of a flight in continuous time."""
    found = result.extreme(name)
    assert found is not None
    return found.value


def scattered(rng, n, least, size):
    """Positions (n, 3) [m] at least some distance apart."""
    found = [rng.uniform(-size, size, 3)]
    while len(found) < n:
        x = rng.uniform(-size, size, 3)
        if min(np.linalg.norm(x - y) for y in found) > least:
            found.append(x)
    return np.array(found)


class Wild:
    """Forces at random: often the greatest ones, straight at a neighbour, or held for some time."""

    def __init__(self, rng, limit):
        self.rng, self.limit, self.force = rng, limit, None

    def __call__(self, seen):
        rng, n = self.rng, len(seen.position)
        if self.force is None or rng.random() < 0.2:
            way = rng.normal(size=(n, 3))
            other = rng.permutation(n)
            aim = rng.random(n) < 0.7
            way[aim] = (seen.position[other] - seen.position + 1e-9)[aim]
            size = self.limit * rng.choice([0.3, 1.0, 3.0], (n, 1))
            self.force = way / np.linalg.norm(way, axis=1, keepdims=True) * size
            self.force[:, 2] += rng.choice([0.0, G])
        return self.force


OBSTACLES = [
    {"kind": "box", "min": [-0.4, -5.0, -5.0], "max": [0.1, 5.0, -0.6]},
    {"kind": "box", "min": [0.8, 0.5, -5.0], "max": [3.0, 2.0, 5.0]},
    {"kind": "ground", "height": -2.5},
]


# -- the theorem --------------------------------------------------------------------------------------


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 2**31), n=st.integers(2, 14), period=st.sampled_from([0.01, 0.02, 0.1]),
    walls=st.booleans(), drag=st.sampled_from([0.0, 0.4]), barrier=st.booleans(),
)  # fmt: skip
def test_whatever_is_commanded_nobody_collides(seed, n, period, walls, drag, barrier):
    """Random forces, mostly beyond the thrust there is: in continuous time, nobody comes nearer than the separation.

    The oracle is the monitor of extremes, which knows nothing of the guard.
    """
    rng = np.random.default_rng(seed)
    position = scattered(rng, 3 * n, 0.8, 1.0 + 0.7 * n ** (1 / 3))
    if walls:
        free = [x for x in position if clearance(x) > 0.35]
        position = np.array(free)[:n]
        if len(position) < 2:
            return
    position = position[:n]
    limit = float(rng.uniform(11.0, 30.0))
    mission = crowd(
        position, limit=limit, period=period, until=4.0, obstacles=OBSTACLES if walls else [],
        vehicles={"point": {"model": "point", "mass": 1.0, "thrust_limit": limit, "drag": drag}},
        avoidance={"separation": 0.1, "clearance": 0.05, "barrier": barrier},
    )  # fmt: skip
    result = rf.simulate(mission, controller=Wild(rng, limit), rate=1.0 / period)
    assert result.complete, result.ending
    assert worst(result, "separation") >= 0.1 - 1e-8
    if walls:
        assert worst(result, "clearance") >= 0.05 - 1e-8
    check = {c.check: c for c in rf.assess(result).checks}["guarantee"]
    assert check.passed
    assert "proved" in check.message


def clearance(x):
    """Distance [m] of a point from the obstacles."""
    found = []
    for thing in OBSTACLES:
        low = np.array(thing.get("min", [-np.inf] * 3))
        high = np.array(thing.get("max", [np.inf, np.inf, thing.get("height", 0.0)]))
        found.append(np.linalg.norm(np.maximum(np.maximum(low - x, x - high), 0.0)))
    return min(found)


def test_without_avoidance_the_same_commands_collide():
    """The property above is no accident: the same forces bring vehicles without [avoidance] into each other."""
    rng = np.random.default_rng(5)
    mission = crowd(scattered(rng, 10, 0.8, 2.0), limit=20.0, until=2.0)
    data = mission.to_dict()
    del data["avoidance"]
    free = rf.simulate(
        rf.Mission.from_dict(data), controller=Wild(np.random.default_rng(1), 20.0), rate=50.0
    )
    kept = rf.simulate(mission, controller=Wild(np.random.default_rng(1), 20.0), rate=50.0)
    assert worst(free, "separation") < -0.1
    assert worst(kept, "separation") >= -1e-8


def test_the_recorded_margin_is_that_of_the_nearest_stop_segments():
    """At the first tick, the margin is the least distance of all pairs of stop segments minus what is to be kept."""
    rng = np.random.default_rng(7)
    r, v = scattered(rng, 60, 0.9, 4.0), rng.normal(0.0, 0.4, (60, 3))
    result = rf.simulate(crowd(r, until=0.5, velocity=v), times=[0.0])
    first = next(p.extremes["guarantee"] for p in result.phases)
    b = 14.0 - G
    stop = r + v * np.linalg.norm(v, axis=1, keepdims=True) / (2 * b)
    share = np.linspace(0.0, 1.0, 41)[:, None, None]
    along = r + share * (stop - r)  # (41, N, 3)
    i, j = np.triu_indices(60, 1)
    apart = min(np.linalg.norm(x[i] - along[:, j], axis=2).min(axis=0).min() for x in along)
    assert first.value <= apart - 0.5 + 1e-3  # held commands stop a little later than b alone says
    if first.time == 0.0:
        assert first.value == pytest.approx(apart - 0.5, abs=5e-3)


# -- the barriers -------------------------------------------------------------------------------------


def by_scipy(A, right, low, high):
    """Minimise x A x / 2 - right x within bounds, by SciPy's least squares."""
    L = np.linalg.cholesky(A)
    return lsq_linear(L.T, np.linalg.solve(L, right), (low, high), method="bvls", tol=1e-14).x


def by_daqp(A, right, low, high):
    """The same by DAQP (Arnström, Bemporad and Axehill, 2022)."""
    daqp = pytest.importorskip("daqp")
    rows, kinds = np.zeros((0, len(A))), np.zeros(len(A), dtype=np.int32)
    far = (np.clip(x, -1e30, 1e30) for x in (high, low))
    x, _, status, _ = daqp.solve(A, -right, rows, *far, kinds, eps_prox=1e-6, primal_tol=1e-10)
    assert status == 1
    return x


@pytest.mark.parametrize("solve", [by_scipy, by_daqp])
@pytest.mark.parametrize("seed", range(12))
def test_barriers_change_accelerations_as_exact_solvers_do(seed, solve):
    """Barriers and soft edges give the accelerations of the quadratic programme, solved by others on its dual."""
    rng = np.random.default_rng(seed)
    n, D, rate, share = 5, 0.5, 3.0, 0.9
    r, v = scattered(rng, n, 0.6, 0.8), rng.normal(0.0, 0.7, (n, 3))
    m, b, wanted = rng.uniform(0.5, 2.0, n), rng.uniform(4.0, 8.0, n), rng.normal(0.0, 1.0, (n, 3))
    edges = np.array([[0, 1], [1, 2], [2, 3], [0, 4]])
    hold, mu = rng.uniform(0.2, 1.0, n), 0.02
    ground = r[:, 2].min() - 0.5
    plan = planned("square", 0, fleet.VehicleDynamics(1.0, point=True), h=0.02)
    found = graph(edges, m)
    problem = plan[0]._replace(graph=found, law=plan[0].law._replace(mu=mu))
    problem = problem._replace(vehicles=problem.vehicles._replace(mean=float(m.mean())))
    work = workspace(n, len(edges))
    u = r[edges[:, 0]] - r[edges[:, 1]]
    work.u[:] = u / np.linalg.norm(u, axis=1, keepdims=True)
    points = [fleet.VehicleDynamics(x, point=True) for x in m]
    flight = fleet.new_ideal_flight(fleet.quadrotor_arrays(points, 0.0), start=0.0, h=0.02, steps=1)
    state = fleet.initial_state(flight, np.zeros((n, fleet.STATES)), work)
    a = avoidance_arrays(
        period=0.02, b=b, lift=np.full(n, 1e3), mass=m, g=0.0, radius=np.full(n, D / 2), rate=rate, share=share,
        solids=one_solid(half_space(ground)), guarded=False, edges=len(edges),
    )  # fmt: skip
    state.seen[:, :3], state.seen[:, 3:] = r, v
    for ask in (20.0 * (r.mean(axis=0) - r), wanted):
        a.hold[:], state.force[:] = hold, m[:, None] * ask
        assert (a.last > 0.0).any() == (ask is wanted)  # the search begins with other pushes
        assert sampled.correct_forces(problem, work, flight, state, a)
    # The same problem from its definition
    rows, needed, most = [], [], []
    for e, (i, j) in enumerate(edges):
        row = np.zeros((n, 3))
        row[i], row[j] = work.u[e], -work.u[e]
        rows.append(row)
    for i in range(n):
        for j in range(i):
            x, w = r[j] - r[i], v[j] - v[i]
            L = float(np.linalg.norm(x))
            x = x / L
            s, B = float(x @ w), share * (b[i] + b[j])
            root = math.sqrt(2 * B * max(L - D, 1e-6))
            row = np.zeros((n, 3))
            row[j], row[i] = x, -x
            rows.append(row)
            needed.append(-rate * (root + s) - B * s / root - (w @ w - s * s) / L)
            most.append(2 * (b[i] + b[j]) / (1 / m[i] + 1 / m[j]))
        gap, s = r[i, 2] - ground - D / 2, v[i, 2]
        root = math.sqrt(2 * share * b[i] * gap)
        row = np.zeros((n, 3))
        row[i, 2] = 1.0
        rows.append(row)
        needed.append(-rate * (root + s) - share * b[i] * s / root)
        most.append(2 * b[i] * m[i])
    J = np.array(rows).reshape(len(rows), -1)
    inverse = np.repeat(1 / m, 3)
    A = J @ (inverse[:, None] * J.T)
    loose = np.minimum(hold[edges[:, 0]], hold[edges[:, 1]])
    A[: len(edges), : len(edges)] += np.diag(mu / m.mean() + (1 / loose - 1) * found.diagonal)
    right = np.concatenate(
        [np.zeros(len(edges)), np.array(needed) - J[len(edges) :] @ wanted.ravel()]
    )
    low = np.concatenate([np.full(len(edges), -np.inf), np.zeros(len(needed))])
    high = np.concatenate([np.full(len(edges), np.inf), most])
    pushes = solve(A + 1e-11 * np.eye(len(A)), right, low, high)
    expected = wanted + (inverse * (J.T @ pushes)).reshape(n, 3)
    assert np.abs(state.force / m[:, None] - expected).max() < 1e-4
    if not (a.push[a.rows[:, 1] < 0] > 0).any():  # between vehicles alone
        change = state.force - m[:, None] * wanted
        assert np.abs(change.sum(axis=0)).max() < 1e-9
        assert np.abs(np.cross(r, change).sum(axis=0)).max() < 1e-9


def test_edges_let_go_near_a_barrier_and_take_hold_again():
    """An edge that would pull two vehicles too near each other gives way; the flight then regains its shape."""
    x = [[0.0, 0, 5], [3.0, 0, 5], [0.0, 3, 5], [3.0, 3, 5]]
    data = crowd(x, until=3.0, avoidance={"separation": 0.8}).to_dict()
    near = [[0.0, 0, 0], [1.0, 0, 0], [0.0, 3, 0], [3.0, 3, 0]]
    data["formations"]["near"] = {"slots": near}
    data["formations"]["own"].pop("edges")
    data["phases"] += [
        {"kind": "reshape", "formation": "near", "control": "tracking", "until": 10.0, "blend": 5.0},
        {"kind": "reshape", "formation": "own", "control": "tracking", "until": 20.0, "blend": 5.0},
    ]  # fmt: skip
    result = rf.simulate(rf.Mission.from_dict(data))
    assert result.complete, result.ending
    assert worst(result, "separation") >= 0.8 - 1e-8
    assert worst(result, "barrier") > 0.0
    off = np.linalg.norm(result.position[-1] - result.slot_position[-1], axis=1)
    assert off.max() < 0.02


# -- what is told -------------------------------------------------------------------------------------


def guarantee(mission, **given):
    """The finding on the guarantee, and the notes."""
    verdict = rf.assess(rf.simulate(mission, **given))
    return {check.check: check for check in verdict.checks}.get("guarantee"), verdict.notes


PAIR = [[0.0, 0, 5], [2.0, 0, 5]]


def test_a_guarantee_that_never_was_is_lost_at_the_start():
    """Two vehicles that start too fast to brake in time: lost at once, by whom, and the flight fails."""
    found, _ = guarantee(crowd(PAIR, velocity=[[6.0, 0, 0], [-6.0, 0, 0]], until=0.6))
    assert not found.passed
    assert found.when == 0.0
    assert found.who == "agents 1 and 2"
    assert "lost at 0.00 s" in found.message


@pytest.mark.parametrize(
    ("tables", "why"),
    [
        ({"disturbances": {"wind": [1.0, 0.0, 0.0]}, "vehicles": {
            "point": {"model": "point", "mass": 1.0, "thrust_limit": 14.0, "drag": 0.2}}}, "wind"),
        ({"disturbances": {"noise": {"position": 0.01, "rate": 50.0}}}, "noise"),
        ({"disturbances": {"mass_error": 0.05}}, "masses"),
        ({"vehicles": {"point": {"model": "paper"}}, "autopilot": {}}, "quadrotors"),
    ],
)  # fmt: skip
def test_what_is_not_proved_is_called_held(tables, why):
    """With wind, noise, wrong masses or quadrotors, the guarantee was held at most."""
    found, notes = guarantee(crowd(PAIR, until=1.0, **tables))
    assert found.passed
    assert "held" in found.message
    assert any("not proved" in note and why in note for note in notes)


def test_without_its_guard_nothing_is_guaranteed():
    """Barriers alone are no guarantee, and the verdict says so."""
    found, notes = guarantee(crowd(PAIR, until=0.6, avoidance={"guard": False}))
    assert found is None
    assert any("guarantees nothing" in note for note in notes)


def test_a_force_from_outside_is_not_proved():
    """A user's force, which the guard does not know, leaves no theorem."""
    found, notes = guarantee(crowd(PAIR, until=0.6), force=lambda t, r, v: 0.0 * r)
    assert found.passed
    assert any("outside" in note for note in notes)


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"avoidance": {"guard": False, "barrier": False}}, "neither guard nor barrier"),
        ({"vehicles": {"point": {"model": "point", "mass": 1.0}}}, "thrust_limit"),
        ({"vehicles": {"point": {"model": "point", "mass": 2.0, "thrust_limit": 19.0}}}, "nothing to brake with"),
        ({"network": {"rate": 50.0}}, "network"),
        ({"avoidance": {"sensing_noise": 0.1}}, "sensing_range"),
        ({"disturbances": {"wind": [9.0, 0, 0]}, "vehicles": {
            "point": {"model": "point", "mass": 1.0, "thrust_limit": 12.0, "drag": 0.3}}}, "nothing to brake with"),
    ],
)  # fmt: skip
def test_what_avoidance_cannot_do_is_refused(tables, words):
    """No braking, no limit, no common states: an error with a remedy."""
    with pytest.raises(MissionError, match=words):
        crowd(PAIR, **tables)


def test_avoidance_needs_vehicles():
    """Point masses without sampled control have no ticks at which to avoid."""
    data = rf.load_mission("square").to_dict() | {"avoidance": {}}
    with pytest.raises(MissionError, match="sampled control"):
        rf.Mission.from_dict(data)


def test_ways_that_begin_elsewhere_are_refused_beside_avoidance():
    """Avoidance leads the body beside its plan, but never the slots about it."""
    data = rf.load_mission("moving-obstacles").to_dict()
    slots = rf.Mission.from_dict(data).formation_slots("cube")
    assert slots is not None
    data["formations"]["big"] = {"shape": "cube", "size": 6.0}
    points = [slots[::-1].tolist()] * 4 + [(1.5 * slots).tolist()] * 4
    data["phases"] = data["phases"][:1] + [
        {"kind": "reshape", "formation": "big", "blend": 6.0, "duration": 7.0, "control_points": points,
         "alignment": "none", "control": "tracking"}
    ]  # fmt: skip
    data["obstacles"] = [data["obstacles"][0] | {"centre": [100.0, 100.0, 9.5]}]
    with pytest.raises(rf.MissionError, match="begins in other slots"):
        rf.simulate(rf.Mission.from_dict(data))
