"""The kernel's source as straight-line code: `rigidfleet.kernel.engine.tracer` and `kernel.engine.codegen`."""

from typing import Any

import numba
import numpy as np
import pytest

from rigidfleet.kernel.compiler.simd import pack_lanes, unpack_lanes
from rigidfleet.kernel.engine import codegen, lane_steps, native
from rigidfleet.kernel.engine.tracer import (
    Code,
    Trace,
    UnfitError,
    code_structure,
    elimination_order,
)
from rigidfleet.kernel.problem import Problem, workspace
from rigidfleet.mission import Mission
from rigidfleet.planning.legs import leg_of
from rigidfleet.planning.plan import plan_phase
from rigidfleet.planning.reference import PhaseState

#: What a problem is made of: its agents, and what differs from the default.
CASES: dict[str, tuple[int, dict[str, Any]]] = {
    "the paper's law": (4, {"constraint": {"solver": "exact", "deformation_damping": 0.0}}),
    "the default law": (5, {}),
    "redundant edges, in the agents' coordinates": (6, {"edges": "complete"}),
    "equal masses": (5, {"mass": 1.0}),
    "thrust limits": (5, {"thrust_limit": 9.0}),
    "two agents": (2, {"edges": "complete"}),
    "a line": (4, {"line": True, "edges": "complete"}),
}


def make(agents: int, data: dict[str, Any]) -> tuple[Problem, np.ndarray]:
    """A problem that establishes some shape from some other, and its start (n,)."""
    random = np.random.default_rng(agents)
    slots = random.uniform(-5.0, 5.0, (agents, 3))
    if "line" in data:
        slots[:, 1:] = 0.0
        slots[:, 0] = 3.0 * np.arange(agents)
    r = slots + random.uniform(-0.5, 0.5, slots.shape)
    edges = [[i, j] for i in range(2, agents + 1) for j in range(max(1, i - 3), i)]
    whole: dict[str, Any] = {
        "schema_version": 1,
        "name": "some",
        "title": "Some shape",
        "agents": {
            "mass": data.get("mass", random.uniform(0.5, 2.0, agents).tolist()),
            "position": r.tolist(),
        },
        "constraint": data.get("constraint", {}),
        "formations": {"some": {"slots": slots.tolist(), "edges": data.get("edges", edges)}},
        "phases": [
            {"kind": "establish", "formation": "some", "control": "open", "duration": 9.0,
             "reference": "squares", "blend": 4.0, "input_force": [0.1, 0.0, -0.2]},
        ],
    }  # fmt: skip
    if "thrust_limit" in data:
        whole["agents"] |= {"thrust_limit": data["thrust_limit"], "saturate": True}
    mission = Mission.from_dict(whole)
    now = PhaseState(0.0, r, np.zeros_like(r))
    plan = plan_phase(mission, leg_of(mission, mission.phases[0], now))
    return plan.problem, r


def derivative(p: Problem, y: np.ndarray, t: float) -> np.ndarray:
    """dy/dt by the compiled kernel of single flights."""
    n, m = len(p.vehicles.m), len(p.graph.edges)
    w = workspace(n, m, solver=p.law.solver)
    out = native.record(p, w, np.array([t]), y[None])
    return np.concatenate([out.v[0].ravel(), out.a[0].ravel(), out.c[0]])


@numba.njit(error_model="numpy")
def call(p, y, dy, t):
    """dy/dt by straight-line code, of eight states."""
    codegen._closed_loop(t, y, dy, p, None)


def in_lanes(p: Problem, y: np.ndarray, t: float) -> np.ndarray:
    """dy/dt (8, n) of states y (8, n); the code leaves out positions, whose derivatives are velocities."""
    ready = codegen.unrolled(p)
    before = pack_lanes(np.repeat(p.reference.d0[:, None], 8, axis=1))
    dy = pack_lanes(np.zeros_like(y.T))
    call(ready._replace(before=before), pack_lanes(y.T), dy, t)
    found, coordinates = unpack_lanes(dy).T, 3 * len(p.vehicles.m)
    assert not found[:, :coordinates].any()
    found[:, :coordinates] = y[:, coordinates : 2 * coordinates]
    return found


@pytest.mark.parametrize("case", CASES)
def test_straight_line_code_is_the_kernel(case: str):
    """Of random states, at the blend's start, within it and after it, the derivative is the kernel's."""
    p, r = make(*CASES[case])
    n = 6 * len(r) + len(p.graph.edges)
    random = np.random.default_rng(0)
    for t in (0.0, 1.3, 8.0):
        y = np.concatenate([r.ravel(), np.zeros(n - r.size)]) + 0.3 * random.normal(size=(8, n))
        expected = np.array([derivative(p, one, t) for one in y])
        np.testing.assert_allclose(in_lanes(p, y, t), expected, rtol=1e-9, atol=1e-9)


def test_no_loop_is_left_and_nothing_is_computed_twice():
    """Products with zero are gone, equal numbers are one, what is known before a flight is not computed in it."""
    p, _ = make(*CASES["the paper's law"])
    code = Code(Trace(p))
    made = [(x.operation, x.arguments) for x in code.lines]
    assert len(set(made)) == len(made)
    assert not any(0.0 in [a for a in x.arguments if isinstance(a, float)] for x in code.lines)
    first = {x.serial: k for k, x in enumerate(code.lines)}
    for k, x in enumerate(code.lines):
        needed = [a.serial for a in x.arguments if hasattr(a, "serial")]
        assert all(first.get(serial, -1) < k for serial in needed)


def test_other_numbers_need_no_other_code():
    """Another gain or mass flies by the same code; numbers that become equal do not."""
    p, _ = make(*CASES["the default law"])
    law = p.law._replace(alpha=1.7 * p.law.alpha)
    assert code_structure(p)[0] == code_structure(p._replace(law=law))[0]
    law = p.law._replace(alpha=p.law.beta)
    assert code_structure(p)[0] != code_structure(p._replace(law=law))[0]
    assert code_structure(p)[0] != code_structure(p._replace(law=p.law._replace(k_def=0.0)))[0]


def test_a_state_without_multipliers_has_no_derivative():
    """Agents on a line with all edges have no multipliers under the exact law: that lane is NaN, the others are not."""
    p, r = make(
        4, {"constraint": {"solver": "exact", "deformation_damping": 0.0}, "edges": "complete"}
    )
    n = 6 * len(r) + len(p.graph.edges)
    y = np.zeros((8, n))
    y[:, : r.size] = r.ravel()
    line = np.zeros_like(r)
    line[:, 0] = np.arange(4)
    y[3, : r.size] = line.ravel()
    dy = in_lanes(p, y, 1.0)
    assert np.isnan(dy).any(axis=1).tolist() == [k == 3 for k in range(8)]


def test_edges_are_eliminated_by_least_degree():
    """Each edge once; of a chain its ends first, so that no row of the factor has more than one entry."""
    chain = np.array([[3, 4], [1, 2], [0, 1], [2, 3]])
    order = elimination_order(chain).tolist()
    assert sorted(order) == [0, 1, 2, 3]
    assert order[0] in (0, 2)


@pytest.mark.parametrize("solver", ["pinv", "spectral"])
def test_what_branches_on_the_state_is_refused(solver: str):
    """Where no factor exists these go on by rotations until they have converged: no straight line."""
    p, _ = make(4, {"constraint": {"solver": solver}, "edges": "complete"})
    with pytest.raises(UnfitError):
        Trace(p)


def rooted_trees(A: np.ndarray, c: np.ndarray, most: int) -> list[tuple[int, np.ndarray, int]]:
    """Order, elementary weights of the stages, and density of each rooted tree of at most so many nodes."""
    found = [(1, np.ones_like(c), 1)]

    def grow(first: int, left: int, weights: np.ndarray, density: int, order: int) -> None:
        """Add trees of some order, with branches from ``first`` on among the smaller ones."""
        if not left:
            made.append((order, weights, density * order))
        for k, (size, branch, dense) in enumerate(smaller[first:], start=first):
            if size <= left:
                grow(k, left - size, weights * (A @ branch), density * dense, order)

    for order in range(2, most + 1):
        smaller, made = found[:], []
        grow(0, order - 1, np.ones_like(c), 1, order)
        found += made
    return found


def test_the_pair_for_lanes_has_its_orders():
    """Its weights meet Butcher's conditions of sixth order, those of the error vanish up to the fifth.

    Halfway through the step, the weights have the fifth order, too.
    """
    A, c = lane_steps.A, lane_steps.C
    np.testing.assert_allclose(A.sum(axis=1), c, atol=1e-15)
    trees = rooted_trees(A, c, 6)
    assert np.bincount([order for order, *_ in trees]).tolist() == [0, 1, 1, 2, 4, 9, 20]
    for order, weights, density in trees:
        assert A[-1] @ weights == pytest.approx(1.0 / density, abs=1e-14)
        if order <= 5:
            assert lane_steps.E @ weights == pytest.approx(0.0, abs=1e-15)
            assert lane_steps.HALF @ weights == pytest.approx(0.5**order / density, abs=1e-15)
    assert max(abs(lane_steps.E @ weights) for order, weights, _ in trees if order == 6) > 1e-5
