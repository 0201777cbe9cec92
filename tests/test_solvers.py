"""Large formations: elimination, the vertex graph and the dense factor solve the same law."""

import gc
import os
import shutil
import subprocess
import sys
import weakref
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest

from rigidfleet.formation import graphs, shapes
from rigidfleet.kernel import block_cholesky
from rigidfleet.kernel.compiler.cache import cache_directory
from rigidfleet.kernel.large import ordering
from rigidfleet.kernel.large.solver import LargeSolver, Setup
from rigidfleet.kernel.problem import EXACT, ITERATED, ConstraintLaw, Vehicles, workspace
from rigidfleet.mission import Mission
from rigidfleet.planning import solvers
from rigidfleet.rigidity import jacobian
from rigidfleet.simulation.flight import Flight, simulate


def lattice(side: int, *, seed: int = 0) -> np.ndarray:
    """A cubic lattice of side^3 points 1 m apart, out of order by 2 cm."""
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid + np.random.default_rng(seed).uniform(-0.02, 0.02, grid.shape)


def directions(p, edges) -> np.ndarray:
    """Unit vectors (m, 3) of the edges."""
    u = p[edges[:, 0]] - p[edges[:, 1]]
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def solver_of(p, edges, masses, law, *, eliminated=False, tolerance=1e-13) -> LargeSolver:
    """A solver in the state p (N, 3)."""
    law = ConstraintLaw(3.0, 12**0.5, 8.0, law, 0.03, 3, 0.1, 1e-12, 0.0)
    vehicles = Vehicles(
        masses, 1.0 / masses, float(masses.sum()), float(masses.mean()), masses, False, 9.81
    )
    work = workspace(len(p), len(edges), large=True)
    work.r[:] = p
    work.u[:] = directions(p, edges)
    order = None
    if eliminated:
        steps = solvers.henneberg_steps(len(p), edges)
        order = None if steps is None else ordering.order_of_steps(steps, edges)
    setup = Setup(order, cache(partial(solvers.agent_dissection_order, p, edges)), tolerance)
    return LargeSolver(vehicles, edges.astype(np.uint32), law, work, setup)


def solved(solver, b) -> np.ndarray:
    solver.workspace.b[:] = b
    solver.solve()
    solver.find_multipliers()
    return solver.workspace.multiplier.copy()


def gram(p, edges, masses) -> np.ndarray:
    """A = J M^-1 J^T, dense."""
    J = jacobian(p, edges)
    return J / np.repeat(masses, 3) @ J.T


@pytest.fixture(scope="module")
def rng():
    return np.random.default_rng(1)


@pytest.mark.parametrize("side", [3, 4, 5])
def test_sweep_vertex_graph_and_dense_factor_agree_on_the_exact_law(side, rng):
    """Undamped, of unequal masses, the three solves agree to 1e-9 where A is well conditioned."""
    p = lattice(side)
    edges, masses = graphs.henneberg(p), rng.uniform(0.5, 2.0, len(p))
    b = rng.normal(size=len(edges))
    A = gram(p, edges, masses)
    assert np.linalg.cond(A) < 1e5
    dense = np.linalg.solve(A, b)
    eliminated = solved(solver_of(p, edges, masses, EXACT, eliminated=True), b)
    sparse = solved(solver_of(p, edges, masses, EXACT), b)
    np.testing.assert_allclose(eliminated, dense, rtol=0, atol=1e-12 * np.abs(dense).max())
    np.testing.assert_allclose(sparse, dense, rtol=0, atol=1e-9 * np.abs(dense).max())


def test_elimination_finds_the_force_before_the_multipliers(rng):
    """Of unequal masses, the force is M a of the exact law at once; the multipliers, asked for later, agree with it."""
    p = lattice(4)
    edges, masses = graphs.henneberg(p), rng.uniform(0.5, 2.0, len(p))
    J, b = jacobian(p, edges), rng.normal(size=len(edges))
    solver = solver_of(p, edges, masses, EXACT, eliminated=True)
    w = solver.workspace
    w.b[:] = b
    solver.solve()
    force = w.f_C.ravel().copy()
    exact = J.T @ np.linalg.solve(gram(p, edges, masses), b)
    np.testing.assert_allclose(force, exact, rtol=0, atol=1e-9 * np.abs(exact).max())
    np.testing.assert_allclose(
        J / np.repeat(masses, 3) @ force, b, rtol=0, atol=1e-11 * np.abs(b).max()
    )
    for _ in range(2):  # asked for once or twice
        solver.find_multipliers()
        assert (w.f_C.ravel() == force).all()
        np.testing.assert_allclose(
            J.T @ w.multiplier, force, rtol=0, atol=1e-9 * np.abs(force).max()
        )


@pytest.mark.parametrize("reach", [1.5, 1.9])
def test_vertex_graph_is_the_damped_law_of_redundant_edges(reach, rng):
    """Iterated Tikhonov on the vertex graph is its definition in edge space, of unequal masses."""
    p = lattice(5)
    edges, masses = graphs.neighbour_edges(p, reach), rng.uniform(0.5, 2.0, len(p))
    b, mbar, mu = rng.normal(size=len(edges)), masses.mean(), 0.03
    regular = mbar * gram(p, edges, masses) + mu * np.eye(len(edges))
    y = np.zeros(len(edges))
    for _ in range(3):
        y = np.linalg.solve(regular, mbar * b + mu * y)
    found = solved(solver_of(p, edges, masses, ITERATED), b)
    np.testing.assert_allclose(found, y, rtol=0, atol=1e-9 * np.abs(y).max())


def test_factor_is_kept_while_the_formation_turns(rng):
    """One factor serves a formation turned by any angle; one that has changed its shape gets a new one."""
    p = shapes.slots("sphere", 1.0, 200)
    edges = graphs.neighbour_edges(p)
    solver = solver_of(p, edges, np.ones(200), ITERATED, tolerance=1e-10)
    b = rng.normal(size=len(edges))
    before = solved(solver, b)
    c, s = np.cos(2.0), np.sin(2.0)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def move(points):
        solver.workspace.r[:] = points
        w = solver.workspace
        w.u[:] = directions(points, edges)

    move(p @ turn.T)
    np.testing.assert_allclose(solved(solver, b), before, atol=1e-7 * np.abs(before).max())
    assert solver.counts.factors == 1
    move(p * [1.0, 1.0, 3.0])
    solved(solver, b)
    assert solver.counts.factors == 2


def test_a_solve_starts_from_the_best_of_past_solutions(rng):
    """What past solutions span is found at once, though they repeat themselves; of others what is nearest to it."""
    p = lattice(4)
    edges, masses = graphs.neighbour_edges(p, 1.5), rng.uniform(0.5, 2.0, 64)
    u, mbar, mu = directions(p, edges), masses.mean(), 0.03
    J = jacobian(p, edges)
    K = mbar * J.T @ J + mu * np.diag(np.repeat(masses, 3))
    past = rng.normal(size=(4, 64, 3))
    past[2] = past[0] - 2.0 * past[1]
    past[3] = 0.0
    wanted = 3.0 * past[0] + 0.5 * past[1]
    x, gram = np.full((64, 3), np.nan), np.empty((4, 6))
    g = (K @ wanted.ravel()).reshape(64, 3)
    block_cholesky.project_on_past_solutions(u, edges, masses, mbar, mu, g, past, gram, x)
    np.testing.assert_allclose(x, wanted, atol=1e-9)
    g = rng.normal(size=(64, 3))
    block_cholesky.project_on_past_solutions(u, edges, masses, mbar, mu, g, past, gram, x)
    rest = g - (K @ x.ravel()).reshape(64, 3)
    np.testing.assert_allclose((past * rest).sum(axis=(1, 2)), 0.0, atol=1e-9)


def test_solves_along_a_motion_take_fewer_iterations(rng):
    """As a formation bends smoothly, past solutions leave less for conjugate gradients to find."""
    p = shapes.slots("sphere", 1.0, 200)
    edges, b = graphs.neighbour_edges(p), rng.normal(size=len(graphs.neighbour_edges(p)))
    taken = {}
    for past in (True, False):
        solver = solver_of(p, edges, np.ones(200), ITERATED, tolerance=1e-8)
        for step in range(12):
            bent = p * [1.0, 1.0, 1.0 + 0.002 * step]
            solver.workspace.r[:], solver.workspace.u[:] = bent, directions(bent, edges)
            if step and not past:
                solver.past[:] = 0.0
            solved(solver, b)
        taken[past] = solver.counts.iterations
    assert taken[True] < 0.7 * taken[False]


def test_pattern_without_fill_solves_as_well(rng, monkeypatch):
    """Where a complete factor would fill up, an incomplete one preconditions, with more iterations."""
    p = lattice(6)
    edges, masses = graphs.neighbour_edges(p, 1.5), np.ones(216)
    b = rng.normal(size=len(edges))
    full = solver_of(p, edges, masses, ITERATED)
    want = solved(full, b)
    monkeypatch.setattr("rigidfleet.kernel.large.solver._FILL", 0.0)
    lean = solver_of(p, edges, masses, ITERATED)
    np.testing.assert_allclose(solved(lean, b), want, atol=1e-9 * np.abs(want).max())
    assert full.pattern is not None
    assert lean.pattern is not None
    assert len(lean.pattern.row) == len(p) + len(edges) < len(full.pattern.row)
    assert lean.counts.iterations > full.counts.iterations


def test_factor_is_that_of_the_matrix(rng):
    """L L^T is K, block by block, in the order of the dissection."""
    p = lattice(4)
    edges, masses = graphs.neighbour_edges(p, 1.5), rng.uniform(0.5, 2.0, 64)
    found = ordering.symbolic_factorisation(
        64, edges, solvers.agent_dissection_order(p, edges), 1e9
    )
    blocks, at = np.empty((len(found.row), 9)), np.empty(64, dtype=np.int64)
    u = directions(p, edges)
    block_cholesky.assemble(
        u, edges, masses, 1.3, 0.1, found.place, found.column, found.of_edge, blocks
    )
    assert block_cholesky.factor(
        found.column, found.row, found.first, found.left, found.block, blocks, at
    )
    L = np.zeros((64, 3, 64, 3))
    column = np.repeat(np.arange(64), np.diff(found.column))
    L[found.row, :, column] = blocks.reshape(-1, 3, 3)
    L = L.reshape(192, 192)
    for i in range(64):  # the diagonal blocks hold inverse pivots, and nothing above them
        d = slice(3 * i, 3 * i + 3)
        L[d, d] = np.tril(L[d, d], -1) + np.diag(1 / np.diag(L[d, d]))
    J = jacobian(p, edges)
    K = 1.3 * J.T @ J + 0.1 * np.diag(np.repeat(masses, 3))
    inverse = (3 * found.place[:, None] + np.arange(3)).ravel()
    np.testing.assert_allclose((L @ L.T)[np.ix_(inverse, inverse)], K, atol=1e-12)


def test_a_lost_pivot_falls_back_and_is_counted(rng):
    """Where an agent lies in a plane with its three, elimination has no pivot; the vertex graph goes on."""
    p = lattice(3)
    edges = graphs.henneberg(p)
    steps = solvers.henneberg_steps(27, edges)
    assert steps is not None
    i, mine = steps[-1, 0], steps[-1, 1:]
    a, b, c = (int(x) for x in edges[mine].sum(axis=1) - i)
    p[i] = 0.5 * p[a] + 0.2 * p[b] + 0.3 * p[c]
    solver = solver_of(p, edges, np.ones(27), EXACT, eliminated=True, tolerance=1e-12)
    # A right side that some motion has, so that the singular system has a solution.
    found = solved(solver, jacobian(p, edges) @ rng.normal(size=81))
    assert solver.counts.fallbacks == 1
    assert solver.counts.failures == 0
    J = jacobian(p, edges)
    np.testing.assert_allclose(J @ J.T @ found, solver.workspace.b, atol=1e-6)
    force = solver.workspace.f_C.ravel()
    np.testing.assert_allclose(J.T @ found, force, rtol=0, atol=1e-12 * np.abs(force).max())


def test_what_is_not_finite_has_no_solution(rng):
    """NaN goes in, NaN comes out, and the next solve is none the worse."""
    p = lattice(4)
    edges = graphs.neighbour_edges(p, 1.5)
    solver = solver_of(p, edges, np.ones(64), ITERATED)
    b = rng.normal(size=len(edges))
    want = solved(solver, b)
    assert np.isnan(solved(solver, b * np.nan)).all()
    assert solver.counts.failures == 1
    np.testing.assert_allclose(solved(solver, b), want, atol=1e-9)


@pytest.mark.parametrize(
    ("n", "count", "law", "method"),
    [
        (8, "complete", "iterated", "dense"),
        (8, "henneberg", "exact", "dense"),
        (64, "henneberg", "exact", "elimination"),
        (64, "neighbours", "exact", "sparse"),
        (64, "henneberg", "iterated", "sparse"),
        (64, "neighbours", "iterated", "sparse"),
        (64, "neighbours", "spectral", "dense"),
        (64, "neighbours", "pinv", "dense"),
    ],
)
def test_solve_is_chosen_by_size_law_and_graph(n, count, law, method):
    """Small ones and laws with eigenvalues are dense, exact ones of three edges each eliminated."""
    p = lattice(round(n ** (1 / 3)))
    made = {
        "complete": lambda: graphs.complete_graph(n),
        "henneberg": lambda: graphs.henneberg(p),
        "neighbours": lambda: graphs.neighbour_edges(p, 1.5),
    }
    assert solvers.choose_method(n, made[count](), law) == method


def test_order_of_the_sweep_is_found_whatever_the_numbers(rng):
    """Each agent comes after the three it is joined to, and every edge once; a cube's graph has no such order."""
    p = lattice(5)
    edges = graphs.henneberg(p)
    for order in (np.arange(125), rng.permutation(125)):
        renamed = np.sort(order[edges], axis=1)
        steps = solvers.henneberg_steps(125, renamed)
        assert steps is not None
        place = np.argsort(steps[:, 0])
        assert sorted(steps[:, 1:][steps[:, 1:] >= 0].tolist()) == list(range(len(edges)))
        for s, (i, *mine) in enumerate(steps.tolist()):
            others = [renamed[e].sum() - i for e in mine if e >= 0]
            assert len(others) == min(s, 3)
            assert all(place[j] < s for j in others)
    assert solvers.henneberg_steps(8, graphs.CUBE_EDGES) is None


def test_dissection_orders_every_agent_once():
    """A permutation, of coincident points, too."""
    p = np.repeat(lattice(3), 2, axis=0)
    assert sorted(solvers.agent_dissection_order(p, graphs.complete_graph(54))) == list(range(54))


def flight(law: str, kind: str, **integrator) -> Mission:
    """64 agents on a lattice, 2 cm off, that turn and are pushed."""
    p = lattice(4, seed=2)
    rest = np.rint(p)
    edges = graphs.henneberg(rest) if kind == "henneberg" else graphs.neighbour_edges(rest, 1.5)
    return Mission.from_dict(
        {
            "schema_version": 1,
            "name": "lattice",
            "agents": {
                "mass": np.random.default_rng(3).uniform(0.5, 2.0, 64),
                "position": 4.0 * p,
                "velocity": np.cross([0.0, 0.0, 0.1], 4.0 * p),
            },
            "constraint": {"solver": law},
            "integrator": {"rtol": 1e-8, "atol": 1e-8} | integrator,
            "formations": {"lattice": {"slots": 4.0 * rest, "edges": edges + 1}},
            "output_step": 0.5,
            "phases": [
                {"kind": "establish", "formation": "lattice", "control": "open", "duration": 4.0},
                {
                    "kind": "hold",
                    "control": "open",
                    "input_force": [0.1, 0.0, 0.0],
                    "duration": 1.0,
                },
            ],
        }
    )


def test_the_memory_of_a_phase_is_free_when_the_next_one_flies():
    """Without waiting for the garbage collector: large formations would need it twice."""
    flown = Flight(flight("exact", "henneberg"))
    gc.disable()
    try:
        flown.begin()
        while flown.advance(1.0):
            pass
        assert flown._ended is not None
        active = flown._ended.integration
        assert active.solver is not None
        kept = [weakref.ref(x) for x in (active.solver, active.workspace.r.base)]
        kept += [
            weakref.ref(x)
            for x in (
                active.solver.thread_solver,
                active.solver.thread_solver.workspace.r.base,
            )
        ]
        kept.append(weakref.ref(active.state.K.base))
        del active
        assert flown.begin()
        assert [x() for x in kept] == [None] * 5
    finally:
        gc.enable()


@pytest.mark.parametrize(
    ("law", "kind", "method"),
    [
        ("exact", "henneberg", "elimination"),
        ("exact", "henneberg", "sparse"),
        ("iterated", "neighbours", "sparse"),
    ],
)
def test_flights_are_the_same_whatever_the_solve(law, kind, method, monkeypatch):
    """A flight by elimination, and one on the vertex graph, is the one with dense factors, and says which it was."""
    found = {}
    for each in ("dense", method):
        monkeypatch.setattr(solvers, "choose_method", lambda *_, each=each: each)
        found[each] = simulate(flight(law, kind))  # a new mission: plans are kept with one
    assert found["dense"].statistics["solvers"] == {}
    counts = found[method].statistics["solvers"][method]
    assert counts["evaluations"] >= found[method].statistics["evaluations"]
    assert counts["fallbacks"] == counts["failures"] == 0
    np.testing.assert_allclose(found[method].position, found["dense"].position, atol=1e-6)
    np.testing.assert_allclose(found[method].multiplier, found["dense"].multiplier, atol=1e-4)


SAME_BITS = """
import hashlib, sys
sys.path.insert(0, sys.argv[1])
from test_solvers import flight, simulate, solvers
for law, kind, method in ("exact", "henneberg", "elimination"), ("iterated", "neighbours", "sparse"):
    solvers.choose_method = lambda *_: method
    print(hashlib.sha256(simulate(flight(law, kind)).position.tobytes()).hexdigest())
"""


@pytest.mark.long
def test_a_process_that_compiles_flies_the_bits_of_one_that_loads(tmp_path):
    """Sums are reordered where functions are compiled into others: each has to be compiled in one way only."""
    folder = tmp_path / cache_directory().relative_to(cache_directory().parents[1])
    folder.mkdir(parents=True)
    for library in cache_directory().glob("flight-*.o"):
        shutil.copy2(library, folder)  # the solver alone is compiled
    command = [sys.executable, "-c", SAME_BITS, str(Path(__file__).parent)]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    compiled, loaded = (
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    )
    assert compiled == loaded
    assert len(set(compiled.split())) == 2


def test_the_integral_does_not_set_the_step(monkeypatch):
    """Held to the tolerance of its distance, the integral of c costs no steps, and no accuracy of the place."""
    monkeypatch.setattr(solvers, "FROM_ELIMINATION", 1)
    strict = simulate(
        flight("exact", "henneberg", atol=1e-12, atol_velocity=1e-8, atol_integral=1e-14)
    )
    loose = simulate(flight("exact", "henneberg", atol=1e-12, atol_velocity=1e-8))
    assert loose.statistics["steps"] < 0.8 * strict.statistics["steps"]
    np.testing.assert_allclose(loose.position, strict.position, atol=1e-6)


def test_velocities_are_held_to_what_places_are():
    """In large formations, unless told otherwise: fewer steps, and places as near as their own tolerance asks."""
    best = simulate(flight("exact", "henneberg", rtol=1e-10, atol=1e-10, atol_velocity=1e-10))
    strict, loose = (
        simulate(flight("exact", "henneberg", rtol=1e-6, atol=1e-6, **given))
        for given in ({"atol_velocity": 1e-6}, {})
    )
    assert loose.statistics["steps"] < 0.85 * strict.statistics["steps"]
    np.testing.assert_allclose(loose.position, best.position, atol=1e-5)


def test_large_formations_do_not_creep_into_a_phase(monkeypatch):
    """Their first step is found from two evaluations: fewer steps, and the same flight."""
    found = simulate(flight("exact", "henneberg"))
    monkeypatch.setattr("rigidfleet.simulation.point_propagator.first_step", lambda *_: 1e-3)
    crept = simulate(flight("exact", "henneberg"))
    assert found.statistics["steps"] <= crept.statistics["steps"] - 2
    assert found.statistics["rejected"] <= crept.statistics["rejected"]
    np.testing.assert_allclose(found.position, crept.position, atol=1e-7)
