"""The compiled kernel against finite differences, NumPy, SciPy and exact solutions."""

import ast
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, get_type_hints

import numba
import numpy as np
import pytest
from numba import types
from oracles import jacobian
from scipy.spatial.transform import Rotation

import rigidfleet
from rigidfleet import physics
from rigidfleet.kernel import (
    constraint,
    control,
    linalg,
    records,
    references,
    rigid_body,
)
from rigidfleet.kernel.compiler.cache import cache_directory
from rigidfleet.kernel.engine import build, native, packing
from rigidfleet.kernel.engine.native import has_machine_code
from rigidfleet.kernel.problem import (
    EXACT,
    SHAPE,
    SQUARED,
    ConstraintLaw,
    Feedback,
    Problem,
    Reference,
    Workspace,
    workspace,
)
from rigidfleet.kernel.problem import graph as kernel_graph
from rigidfleet.math import attitude
from rigidfleet.mission import Mission
from rigidfleet.planning.legs import leg_of
from rigidfleet.planning.plan import PhaseState, plan_phase
from rigidfleet.simulation.flight import simulate

# Central differences of sixth order: errors of h^6 and eps/h.
STENCIL = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60
SECOND = np.array([2, -27, 270, -490, 270, -27, 2]) / 180


def derivatives(f, t: float, h: float = 1e-2) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivative of an array-valued f(t)."""
    values = np.array([f(t + i * h) for i in range(-3, 4)])
    return np.tensordot(STENCIL, values, 1) / h, np.tensordot(SECOND, values, 1) / h**2


def skew(a: np.ndarray) -> np.ndarray:
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def a_mission(**changes: Any) -> Mission:
    """Three agents, a triangle by distances, at rest under weight balance."""
    data: dict[str, Any] = {
        "schema_version": 1,
        "name": "kernel",
        "agents": {"mass": 1.0, "position": [[1, 6, 3], [8, 3, 3], [7, 6, 3]]},
        "formations": {"shape": {"distances": [4, 4, 4]}},
        "phases": [
            {
                "kind": "establish",
                "formation": "shape",
                "reference": "distances",
                "control": "open",
                "until": 6.0,
            }
        ],
    }
    return Mission.from_dict(data | changes)


def a_problem(mission: Mission, index: int = 0, now: PhaseState | None = None) -> Problem:
    """The problem of a phase, begun at the mission's initial state unless told otherwise."""
    phase = mission.phases[index]
    if now is None:
        agents = mission.agents
        now = PhaseState(0.0, np.array(agents.position), np.array(agents.velocity))
    return plan_phase(mission, leg_of(mission, phase, now)).problem


def random_vectors(seed: int, n: int, scale: float = 1.0) -> np.ndarray:
    return scale * np.random.default_rng(seed).normal(size=(n, 3))


# -- time functions --------------------------------------------------------------------------------


def test_septic_blend_and_its_derivatives():
    """The septic runs from 0 to 1; its two rates are its derivatives everywhere."""
    t0, T_b = 1.5, 4.0
    for t in np.linspace(1.6, 5.4, 24):
        s, rate, second = references.septic(t, t0, T_b)
        x = (t - t0) / T_b
        assert s == pytest.approx(35 * x**4 - 84 * x**5 + 70 * x**6 - 20 * x**7, abs=1e-13)
        first = derivatives(lambda t: np.array(references.septic(t, t0, T_b)), t)[0]
        assert first[0] == pytest.approx(rate, abs=1e-10)
        assert first[1] == pytest.approx(second, abs=1e-9)


@pytest.mark.parametrize(("t", "s"), [(-1.0, 0.0), (1.5, 0.0), (5.5, 1.0), (9.0, 1.0)])
def test_septic_blend_rests_at_both_ends(t, s):
    """Before, after and at either end nothing moves, and the third derivative vanishes there too."""
    assert references.septic(t, 1.5, 4.0) == (s, 0.0, 0.0)
    near = references.septic(min(max(t, 1.5 + 1e-4), 5.5 - 1e-4), 1.5, 4.0)
    assert abs(near[2]) < 420 * (1e-4 / 4.0) ** 2  # falls with the square, so d3s/dt3 = 0


def test_a_blend_of_no_length_is_a_step():
    """T_b = 0 gives the end value from its time on, and the start value before."""
    assert references.septic(2.0, 2.0, 0.0) == (1.0, 0.0, 0.0)
    assert references.septic(1.999, 2.0, 0.0) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.0, 0.0, 1e-7), (0.3, -1.2, 2.0)])
def test_slots_and_distances_move_as_their_derivatives_say(turn):
    """Slots blended while they turn, and the distances between them, against finite differences."""
    n = 5
    edges = np.array([(i, j) for i in range(n) for j in range(i + 1, n)])
    zero = np.zeros(0)
    p0, dp = random_vectors(1, n, 3.0), random_vectors(2, n)
    ref = Reference(SHAPE, 0.5, 4.0, zero, zero, p0, dp, np.array(turn))

    def slots(t: float) -> np.ndarray:
        p = np.zeros((3, n, 3))
        references.blend_slots(t, ref, *p)
        return p

    def distances(t: float) -> np.ndarray:
        d = np.zeros((3, len(edges)))
        references.distance_references(t, ref, edges, *slots(t), *d)
        return d

    for t in (1.0, 2.2, 3.9):
        for f in (slots, distances):
            first, second = derivatives(f, t, 2e-2)
            np.testing.assert_allclose(first[0], f(t)[1], rtol=0, atol=1e-8)
            np.testing.assert_allclose(second[0], f(t)[2], rtol=0, atol=1e-7)
        s = references.septic(t, 0.5, 4.0)[0]
        exact = (p0 + s * dp) @ Rotation.from_rotvec(s * np.array(turn)).as_matrix().T
        np.testing.assert_allclose(slots(t)[0], exact, rtol=0, atol=1e-14)
        lengths = np.linalg.norm(exact[edges[:, 0]] - exact[edges[:, 1]], axis=1)
        np.testing.assert_allclose(distances(t)[0], lengths, rtol=1e-14)
    np.testing.assert_array_equal(slots(0.5)[0], p0)


def test_squared_distances_move_as_their_derivatives_say():
    """Distances blended in their squares, against finite differences; still before and after."""
    ref = Reference(
        SQUARED, 6.0, 4.0, np.array([4.0, 4.0]), np.array([4.0, 8.0]), *np.zeros((2, 0, 3)),
        np.zeros(3),
    )  # fmt: skip

    def distances(t: float) -> np.ndarray:
        d = np.zeros((3, 2))
        references.distance_references(t, ref, np.zeros((2, 2), int), *np.zeros((3, 0, 3)), *d)
        return d

    for t in (7.0, 8.1, 9.7):
        first, second = derivatives(distances, t)
        np.testing.assert_allclose(first[0], distances(t)[1], rtol=0, atol=1e-10)
        np.testing.assert_allclose(second[0], distances(t)[2], rtol=0, atol=1e-8)
    np.testing.assert_array_equal(distances(5.0), [[4, 4], [0, 0], [0, 0]])
    np.testing.assert_array_equal(distances(11.0), [[4, 8], [0, 0], [0, 0]])


# -- attitude --------------------------------------------------------------------------------------


# Small angles take a series, up to |phi| = 0.2; both sides of that border are here.
@pytest.mark.parametrize("size", [0.0, 1e-5, 0.05, 0.1999, 0.2001, 1.0, 3.0, 3.1415])
@pytest.mark.parametrize("seed", range(3))
def test_body_rates_are_those_of_the_rotation(size, seed):
    """Omega of R = Exp(phi(t)) is R^T dR/dt, and omega_dot its derivative."""
    phi, phi_dot, phi_ddot = random_vectors(seed, 3)
    phi *= size / np.linalg.norm(phi)

    def rotation(t: float) -> np.ndarray:
        E = np.zeros((3, 3))
        control.exp_transposed(phi + phi_dot * t + phi_ddot * t * t / 2, E)
        return E.T

    def rates(t: float) -> np.ndarray:
        out = np.zeros((2, 3))
        now = phi + phi_dot * t + phi_ddot * t * t / 2
        control.body_rates(now, phi_dot + phi_ddot * t, phi_ddot, out[0], out[1])
        return out

    R_dot = derivatives(rotation, 0.0)[0]
    np.testing.assert_allclose(rotation(0).T @ R_dot, skew(rates(0)[0]), rtol=0, atol=1e-10)
    np.testing.assert_allclose(derivatives(rates, 0.0)[0][0], rates(0)[1], rtol=0, atol=1e-9)
    exact = Rotation.from_rotvec(phi).as_matrix()
    np.testing.assert_allclose(rotation(0.0), exact, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    "angle",
    [0.0, 1e-160, 1e-12, 1e-8, 1e-4, 0.5, 2.0, 3.0, math.pi - 1e-4, math.pi - 1e-8, math.pi],
)
@pytest.mark.parametrize("seed", range(5))
def test_rotation_vector_is_exact_at_every_angle(angle, seed):
    """The logarithm of a rotation matrix agrees with SciPy's, near zero and half a turn as well."""
    axis = random_vectors(seed, 1)[0]
    axis[seed % 3] *= 1e-3  # a small component, which a careless branch divides by
    given = angle * axis / np.linalg.norm(axis)
    R = Rotation.from_rotvec(given).as_matrix()
    phi = np.zeros(3)
    rigid_body.rotation_vector(R, phi)
    if angle > math.pi - 1e-7:  # the axis of half a turn has no sign
        phi *= np.sign(phi @ given)
    # 1e-15 of the matrix is that much of the angle; near zero that is all it holds.
    np.testing.assert_allclose(phi, given, rtol=0, atol=4e-15)


def test_attitude_and_its_rate_are_those_of_the_attitude_module():
    """The compiled T(q) and dq/dt equal the NumPy ones, whatever the quaternion's length."""
    for seed in range(5):
        q = np.random.default_rng(seed).normal(size=4)
        omega = random_vectors(seed + 10, 1)[0]
        T, rate = np.zeros((3, 3)), np.zeros(4)
        rigid_body.attitude_matrix(q, T)
        rigid_body.quaternion_rate(q, omega, rate)
        np.testing.assert_allclose(T, attitude.dcm_from_quaternion(q), rtol=0, atol=1e-15)
        np.testing.assert_allclose(rate, attitude.quaternion_rate(q, omega), rtol=0, atol=1e-15)


# -- linear algebra --------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 7, 18, 28])
def test_cholesky_solves(n):
    """The factor solves A x = b as NumPy does, reading the lower triangle alone."""
    rng = np.random.default_rng(n)
    B = rng.normal(size=(n, n))
    A, b = B @ B.T + np.eye(n), rng.normal(size=n)
    factor, x = np.tril(A) + np.triu(np.full((n, n), np.nan), 1), b.copy()
    assert linalg.cholesky(factor)
    linalg.cholesky_solve(factor, x)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=0, atol=1e-12 * np.abs(x).max() * n)


@pytest.mark.parametrize("last", [-1e-9, -3.0, math.nan])
def test_cholesky_refuses_what_is_not_positive_definite(last):
    """A negative eigenvalue, or NaN, is reported and never rooted."""
    Q = np.linalg.qr(np.random.default_rng(0).normal(size=(6, 6)))[0]
    A = Q @ np.diag([1, 2, 3, 4, 5, last]) @ Q.T
    assert not linalg.cholesky(A)


@pytest.mark.parametrize(
    "values",
    [
        [2.0],
        [1.0, 2.0, 3.0, 4.0],
        [1.0, 1.0, 1.0, 2.0, 2.0],
        [0.0, 0.0, 1e-9, 1e-3, 1.0, 1e3],
        [-2.0, 0.0, 2.0],
        np.linspace(0.0, 3.0, 28),
        [0.0, 0.0, 0.0],
    ],
)
def test_jacobi_finds_all_eigenvalues(values):
    """Eigenvalues equal NumPy's, clustered, zero and negative ones too; eigenvectors diagonalise."""
    w = np.array(values)
    n = len(w)
    Q = np.linalg.qr(np.random.default_rng(n).normal(size=(n, n)))[0]
    A = Q @ np.diag(w) @ Q.T
    lower, V, found = np.tril(A), np.full((n, n), np.nan), np.full(n, np.nan)
    largest = linalg.jacobi_eigen(lower, V, found)
    scale = max(np.abs(w).max(), 1.0) * n
    np.testing.assert_allclose(np.sort(found), np.linalg.eigvalsh(A), rtol=0, atol=1e-15 * scale)
    np.testing.assert_allclose(V.T @ V, np.eye(n), rtol=0, atol=1e-14)
    np.testing.assert_allclose(V @ np.diag(found) @ V.T, A, rtol=0, atol=2e-15 * scale)
    assert largest == found.max()
    # It ends as nothing is left to rotate, not as its sweeps are used up.
    assert (np.tril(lower, -1) ** 2).sum() <= 1e-32 * (A**2).sum()


def test_jacobi_keeps_small_eigenvalues_accurate():
    """Of a graded matrix, the smallest of eigenvalues 20 decades apart comes out to rounding.

    The oracle is the largest eigenvalue of the inverse, known without cancellation.
    """
    rng = np.random.default_rng(0)
    B = rng.normal(size=(6, 6))
    M = B @ B.T / 6 + np.eye(6)
    D = 10.0 ** (-2 * rng.permutation(6))
    inverse = np.linalg.inv(M) / np.outer(D, D)
    found, V = np.zeros(6), np.zeros((6, 6))
    linalg.jacobi_eigen(D[:, None] * M * D, V, found)
    assert found.min() < 1e-19
    assert found.min() == pytest.approx(1 / np.linalg.eigvalsh(inverse)[-1], rel=1e-13)


# -- the virtual rigid body ------------------------------------------------------------------------

BODIES = {
    "spatial": random_vectors(3, 6, 2.0),
    "planar": random_vectors(4, 5, 2.0) * [1, 1, 0],
    "line": np.outer([-4.0, 0.5, 3.0], [1.0, 2.0, -2.0]) / 3,
    "two": np.array([[0.0, 0.0, 3.0], [1.0, 2.0, 4.0]]),
    "point": np.array([[1.0, 2.0, 3.0]]),
    "point that rounds": np.array([[0.3, 0.1, 0.7]]),
}


def about_cm(r: np.ndarray, m: np.ndarray) -> np.ndarray:
    return r - m @ r / m.sum()


def inertia_of(x: np.ndarray, m: np.ndarray) -> np.ndarray:
    return sum(-mi * skew(xi) @ skew(xi) for mi, xi in zip(m, x, strict=True))


@pytest.mark.parametrize("name", BODIES)
def test_inertia_and_its_pseudo_inverse(name):
    """Inertia is -sum m [x][x]; its inverse is NumPy's pseudo-inverse, on a line and a point too."""
    r = BODIES[name]
    m = 1.3 + 0.1 * np.arange(len(r))
    cm, I, inverse = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    rigid_body.centre_of_mass(r, m, m.sum(), cm)
    rigid_body.inertia(r, m, cm, I)
    rigid_body.inertia_inverse(I, inverse)
    np.testing.assert_allclose(cm, m @ r / m.sum(), rtol=1e-15)
    np.testing.assert_allclose(I, inertia_of(about_cm(r, m), m), rtol=0, atol=1e-13)
    expected = np.linalg.pinv(I, 1e-9, hermitian=True)
    np.testing.assert_allclose(inverse, expected, rtol=0, atol=1e-14 * max(1, np.abs(I).max()))


@pytest.mark.parametrize("name", BODIES)
def test_mean_axes_carry_all_angular_momentum(name):
    """In mean axes h = I omega: sum m x cross (v - omega x r) = 0."""
    r = BODIES[name]
    m = 1.3 + 0.1 * np.arange(len(r))
    v = random_vectors(9, len(r))
    w = workspace(len(r), 0)
    rigid_body.mean_axes(r, v, m, m.sum(), w)
    x, y = about_cm(r, m), about_cm(v, m)
    rest = y - np.cross(w.cm[2], x)
    np.testing.assert_allclose(m @ np.cross(x, rest), 0, atol=1e-13)
    np.testing.assert_allclose(w.cm[3], m @ np.cross(x, y), rtol=0, atol=1e-13)
    np.testing.assert_allclose(w.cm[1], m @ v / m.sum(), rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", BODIES)
def test_deformation_damping_leaves_rigid_motion_alone(name):
    """Damping is a force on the deformation alone, without net force or torque."""
    r = BODIES[name]
    m = 1.3 + 0.1 * np.arange(len(r))
    omega, v_cm = random_vectors(5, 2)
    w = workspace(len(r), 0)
    rigid = v_cm + np.cross(omega, about_cm(r, m))
    for v, still in ((rigid, True), (rigid + random_vectors(6, len(r)), len(r) == 1)):
        f = np.zeros_like(r)
        rigid_body.mean_axes(r, v, m, m.sum(), w)
        rigid_body.damp_deformation(r, v, m, 2.0, w.cm, f)
        np.testing.assert_allclose(f.sum(axis=0), 0, atol=1e-13)
        np.testing.assert_allclose(np.cross(r, f).sum(axis=0), 0, atol=1e-12)
        assert bool(np.abs(f).max() < 1e-13) is still


@pytest.mark.parametrize("name", BODIES)
def test_rigid_allocation_moves_agents_as_one_body(name):
    """The exact allocation achieves every wrench a rigid body can take, with no relative motion.

    Only a torque about a line's own axis, or on a point, is out of reach.
    """
    r = BODIES[name]
    m = 1.3 + 0.1 * np.arange(len(r))
    x = about_cm(r, m)
    F, tau, omega = random_vectors(7, 3)
    I = inertia_of(x, m)
    I_inv = np.linalg.pinv(I, 1e-9, hermitian=True)
    f = physics.allocate(r, m, F, tau, omega)
    reached = physics.wrench(r, m, f)
    turning = np.cross(omega, I @ omega)
    expected = I @ I_inv @ (tau - turning) + turning
    np.testing.assert_allclose(reached, np.concatenate([F, expected]), rtol=0, atol=1e-13)
    if name in {"spatial", "planar"}:
        np.testing.assert_allclose(reached[3:], tau, rtol=0, atol=1e-13)
    # Accelerations of one rigid body: a cross product and a centripetal term about the CM.
    alpha = I_inv @ (tau - turning)
    a = F / m.sum() + np.cross(alpha, x) + np.cross(omega, np.cross(omega, x))
    np.testing.assert_allclose(f / m[:, None], a, rtol=0, atol=1e-13)


@pytest.mark.parametrize("split", ["equal", "inertia", "inertia+force"])
@pytest.mark.parametrize("name", BODIES)
def test_pseudo_inverse_of_the_papers_h(name, split):
    """H^+ [F; tau_i] by the kernel equals NumPy's least-norm least-squares solution of the paper's H."""
    r = BODIES[name]
    n = len(r)
    m = 1.3 + 0.1 * np.arange(n)
    x = about_cm(r, m)
    F, tau = random_vectors(8, 2)
    H = np.vstack([np.hstack([np.eye(3)] * n), np.zeros((3 * n, 3 * n))])
    for i in range(n):
        H[3 + 3 * i : 6 + 3 * i, 3 * i : 3 * i + 3] = skew(x[i])
    if split == "equal":
        torques = np.tile(tau / n, (n, 1))
    else:
        alpha = np.linalg.pinv(inertia_of(x, m), 1e-9, hermitian=True) @ tau
        torques = np.array([-m[i] * skew(x[i]) @ skew(x[i]) @ alpha for i in range(n)])
        if split == "inertia+force":
            torques = torques + np.cross(x, np.outer(m, F) / m.sum())
    expected = np.linalg.pinv(H, 1e-6) @ np.concatenate([F, torques.ravel()])
    options: dict[str, Any] = {"method": "pinv", "torque_split": split}
    f = physics.allocate(r, m, F, tau, **options)
    np.testing.assert_allclose(f.ravel(), expected, rtol=0, atol=1e-12)


# -- the constraint force --------------------------------------------------------------------------


def complete(n: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(n) for j in range(i + 1, n)]


LINE = np.array([[-4.0, 0.0, 0.0], [0.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
SQUARE = np.array([[0.0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]])
GRAPHS: dict[str, tuple[np.ndarray, list[tuple[int, int]], int]] = {
    # positions, edges, rank of J
    "pair": (BODIES["two"], [(0, 1)], 1),
    "triangle": (np.array([[1.0, 6, 3], [8, 3, 3], [7, 6, 3]]), complete(3), 3),
    "tree": (random_vectors(1, 5, 2.0), [(0, 1), (0, 2), (3, 0), (4, 3)], 4),
    "tetrahedron": (random_vectors(2, 4, 2.0), complete(4), 6),
    "line": (LINE, complete(3), 2),
    "almost a line": (LINE + [[0, 0, 0], [0, 0.05, 0], [0, 0, 0]], complete(3), 3),
    "square": (SQUARE, complete(4), 5),
    "redundant": (random_vectors(3, 6, 2.0), complete(6), 12),
}
SOLVERS: dict[str, Any] = {
    "iterated": lambda w: (1 - (0.03 / (w + 0.03)) ** 3) / np.where(w > 0, w, 1.0),
    "spectral": lambda w: 1 / (w + 0.025 * np.maximum(0.0, 1 - w / 0.1) ** 2),
    "exact": lambda w: 1 / w,
    "pinv": lambda w: rolled_off(w, 1e-3 * w.max()),
}


def rolled_off(w: np.ndarray, least: float) -> np.ndarray:
    """1/w, and below ``least`` the parabola that goes on from there with its slope, to 0 at 0."""
    x = w / least
    return np.where(x >= 1, 1 / np.where(x >= 1, w, 1.0), x * (3 - 2 * x) / least)


@pytest.mark.parametrize(
    ("name", "solver"),
    [
        (name, solver)
        for name, (_, edges, rank) in GRAPHS.items()
        for solver in SOLVERS
        if solver != "exact" or rank == len(edges)
    ],
)
def test_multipliers_are_the_named_function_of_the_spectrum(name, solver):
    """Each solver gives lambda = mbar phi(mbar A) b, b the bracket of the paper's law: full in NumPy.

    Unequal masses; trees, redundant edges, and singular shapes where the solver has an answer.
    """
    r, edges, rank = GRAPHS[name]
    e, n = np.array(edges), len(r)
    rng = np.random.default_rng(5)
    m = rng.uniform(0.5, 2.0, n)
    v, f = rng.normal(size=(2, n, 3))
    d, d_dot, d_ddot, integral = rng.normal(size=(4, len(e)))
    J = jacobian(r, e)
    assert np.linalg.matrix_rank(J, 1e-8) == rank
    L = np.linalg.norm(r[e[:, 0]] - r[e[:, 1]], axis=1)
    dv = v[e[:, 0]] - v[e[:, 1]]
    along = J @ v.ravel()
    J_dot_v = ((dv**2).sum(axis=1) - along**2) / L
    M_inv = np.repeat(1 / m, 3)
    alpha, beta, gamma = 2.0, 3.0, 5.0
    b = (
        d_ddot - J_dot_v - J @ (M_inv * f.ravel()) - 2 * alpha * (along - d_dot)
        - beta**2 * (L - d) - gamma * integral
    )  # fmt: skip
    mbar = m.mean()
    w, V = np.linalg.eigh(mbar * (J * M_inv) @ J.T)
    w = np.where(w < 1e-13 * w.max(), 0.0, w)
    phi = SOLVERS[solver](w)
    if solver == "iterated":
        phi = np.where(w > 0, phi, 3 / 0.03)
    options: dict[str, Any] = {"solver": solver, "alpha": alpha, "beta": beta, "gamma": gamma}
    force = physics.constraint_force(
        r, v, m, e, d, d_dot=d_dot, d_ddot=d_ddot, integral=integral, f_E=f, **options
    )
    expected = mbar * (V * phi) @ V.T @ b
    scale = mbar * np.abs(phi).max() * np.linalg.norm(b)
    # What rounding makes of w = 0, some 1e-15, is multiplied by 3/W^2 in pinv: a stress without force.
    idle = 3e-15 / (1e-3 * w.max()) ** 2 * mbar * np.linalg.norm(b) if solver == "pinv" else 0.0
    np.testing.assert_allclose(force.multiplier, expected, rtol=0, atol=1e-12 * scale + idle)
    np.testing.assert_allclose(force.c, L - d, rtol=0, atol=1e-15)
    np.testing.assert_allclose(force.c_dot, along - d_dot, rtol=0, atol=1e-14)
    f_C = (J.T @ expected).reshape(n, 3)
    np.testing.assert_allclose(force.f_C, f_C, rtol=0, atol=1e-11 * scale)
    # What the law is for: the error's acceleration is the one commanded (exactly, where it can be).
    if solver == "exact":
        c_ddot = J_dot_v + J @ (M_inv * (f + force.f_C).ravel()) - d_ddot
        asked = -2 * alpha * (along - d_dot) - beta**2 * (L - d) - gamma * integral
        np.testing.assert_allclose(c_ddot, asked, rtol=0, atol=1e-10 * scale)


@pytest.mark.parametrize("solver", ["exact", "pinv"])
def test_solvers_agree_where_nothing_is_singular(solver):
    """On a well-shaped graph the paper's inverse and the pseudo-inverse are one; spectral is as well."""
    r, edges, _ = GRAPHS["triangle"]
    call: dict[str, Any] = {"d": [4, 4, 4], "f_E": random_vectors(4, 3)}
    a = physics.constraint_force(r, 0 * r, 1.0, edges, **call, solver=solver)
    b = physics.constraint_force(r, 0 * r, 1.0, edges, **call, solver="spectral")
    np.testing.assert_allclose(a.multiplier, b.multiplier, rtol=1e-12)


def test_the_pseudo_inverse_has_no_jump():
    """Across the cut-off and down to a line the force of pinv changes by little at a time, and has a bound.

    Three agents near a line, whose smallest w goes with the square of the offset: one that drops what is below a
    cut-off jumps there by all of its force.
    """
    edges, offsets = complete(3), np.geomspace(1e-7, 1.0, 2000)
    lines = [LINE + [[0, 0, 0], [0, h, 0], [0, 0, 0]] for h in offsets]
    call: dict[str, Any] = {"d": [4.0, 8.5, 4.0], "d_ddot": 1.0, "solver": "pinv"}
    f = np.array([physics.constraint_force(r, 0 * r, 1.0, edges, **call).f_C for r in lines])
    across = np.abs(f[..., 1]).max(axis=1)
    assert across[0] < 1e-6 * across.max()
    assert np.abs(np.diff(across)).max() < 0.02 * across.max()
    call["solver"] = "exact"
    exact = physics.constraint_force(lines[-1], 0 * LINE, 1.0, edges, **call)
    np.testing.assert_allclose(f[-1], exact.f_C, rtol=1e-9, atol=1e-12)


def test_more_iterations_come_closer_to_the_papers_law():
    """Iterated Tikhonov deviates by (mu/(w + mu))^k: each iteration multiplies by mu/(w + mu)."""
    r, edges, _ = GRAPHS["pair"]
    call: dict[str, Any] = {"d": [4.0], "damping": 0.03}
    exact = physics.constraint_force(r, 0 * r, 1.0, edges, **call, solver="exact").multiplier[0]
    for iterations in (1, 2, 3, 5):
        found = physics.constraint_force(r, 0 * r, 1.0, edges, iterations=iterations, **call)
        deviation = 1 - found.multiplier[0] / exact
        assert deviation == pytest.approx((0.03 / 2.03) ** iterations, rel=1e-6)  # w = 2 for a pair


def test_exact_solver_has_no_answer_on_a_line():
    """Where J M^-1 J^T is singular the exact law gives NaN, never a finite guess."""
    force = physics.constraint_force(LINE, 0 * LINE, 1.0, complete(3), [4, 8, 4.1], solver="exact")
    assert np.isnan(force.multiplier).all()


def test_only_edges_that_share_an_agent_are_assembled():
    """A = scale J M^-1 J^T + shift, from the pairs of edges that meet, whichever way they point."""
    r = random_vectors(8, 6, 2.0)
    edges = np.array([(0, 1), (2, 1), (2, 3), (3, 0), (5, 4), (1, 5)])
    m = np.random.default_rng(1).uniform(0.5, 2.0, 6)
    graph = kernel_graph(edges, m)
    w = workspace(6, 6)
    at_rest = np.zeros((6, 3))
    law = ConstraintLaw(1.0, 1.0, 0.0, EXACT, 0.0, 1, 0.0, 0.0, 0.0)
    constraint.right_side(r, at_rest, np.zeros(6), at_rest, graph.edges, law, w)
    constraint.assemble(w.u, graph, 1.7, 0.3, w.A)
    J = jacobian(r, edges)
    expected = 1.7 * (J / np.repeat(m, 3)) @ J.T + 0.3 * np.eye(6)
    np.testing.assert_allclose(np.tril(w.A), np.tril(expected), rtol=0, atol=1e-14)
    assert len(graph.pairs) == np.count_nonzero(np.tril(np.abs(J) @ np.abs(J).T, -1))


# -- the closed loop -------------------------------------------------------------------------------


def a_flight_with_a_turn() -> tuple[Problem, Workspace]:
    """A reshaping that turns its slots on a body that moves and turns: every term is at work."""
    mission = a_mission(
        formations={
            "first": {"slots": [[0, 2, 0], [0, -2, 0], [3, 0, 0.5]]},
            "second": {"slots": [[-4, 0.2, 0], [0, 0, 1], [4, 0, 0]]},
        },
        phases=[
            {"kind": "establish", "formation": "first", "duration": 6.0},
            {
                "kind": "fly",
                "position": [10, 2, 8],
                "velocity": [1, 2, 0.5],
                "yaw_deg": 80.0,
                "pitch_deg": 30.0,
                "rates_deg_s": [5, -3, 8],
                "duration": 5.0,
            },
            {"kind": "reshape", "formation": "second", "duration": 5.0},
        ],
    )
    now = PhaseState(0.0, np.array(mission.agents.position), np.zeros((3, 3)))
    fly = plan_phase(mission, leg_of(mission, mission.phases[1], now)).problem
    shape = random_vectors(3, 3, 2.0)
    ref = Reference(
        SHAPE, 0.0, 4.0, np.zeros(3), np.zeros(3), shape, random_vectors(4, 3), np.array([0.3, 0.9, -0.4])
    )  # fmt: skip
    return fly._replace(reference=ref), workspace(3, 0)


def test_desired_agents_move_as_their_derivatives_say():
    """Desired positions of agents on a body that moves, turns and reshapes: velocity, acceleration."""
    problem, w = a_flight_with_a_turn()

    def desired(t: float) -> np.ndarray:
        references.blend_slots(t, problem.reference, w.p, w.p_dot, w.p_ddot)
        control.reference_motion(t, problem.motion, w)
        control.desired_agents(w)
        return np.array([w.r_ref, w.v_ref, w.a_ref])

    for t in (0.4, 1.7, 3.3):
        first, second = derivatives(desired, t)
        np.testing.assert_allclose(first[0], desired(t)[1], rtol=0, atol=1e-7)
        np.testing.assert_allclose(first[1], desired(t)[2], rtol=0, atol=1e-6)
        np.testing.assert_allclose(second[0], desired(t)[2], rtol=0, atol=1e-5)


def test_reference_motion_goes_on_after_its_end():
    """After the last knot the body keeps its velocity and its rates, and accelerates no more."""
    problem, w = a_flight_with_a_turn()
    control.reference_motion(5.0, problem.motion, w)
    end = w.body.copy()
    control.reference_motion(5.5, problem.motion, w)
    np.testing.assert_allclose(w.body[0], end[0] + 0.5 * end[1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(w.body[1], end[1], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(w.body[2], np.zeros(3))
    np.testing.assert_allclose(end[0], [10, 2, 8], atol=0.1)
    np.testing.assert_allclose(np.rad2deg(end[3]), [5, -3, 8], atol=0.5)


def test_gains_are_interpolated_over_the_time_to_go():
    """Cubics between the table's entries, its last one before it begins, held ones after arrival."""
    to_go, powers = np.array([0.0, 1.0, 3.0]), np.array([[1.0, 2.0, -1.0, 0.5]])
    gain = np.tile(to_go[:, None] ** np.arange(4) @ powers.T, 4)  # a cubic, met exactly
    slope = np.tile(np.polyval([1.5, -2.0, 2.0], to_go)[:, None], 4)
    feedback = Feedback(
        to_go, gain, slope, 10.0, *np.zeros((2, 3)), np.eye(3), np.zeros(3), np.full(4, -1.0)
    )
    out = np.zeros(4)
    for t, tau in ((10.0, 0.0), (9.5, 0.5), (9.0, 1.0), (8.0, 2.0), (7.0, 3.0), (2.0, 3.0)):
        control.body_gains(t, feedback, out)
        np.testing.assert_allclose(out, np.polyval([0.5, -1, 2, 1], tau), rtol=0, atol=1e-13)
    control.body_gains(10.1, feedback, out)
    np.testing.assert_array_equal(out, -1.0)


def test_edges_that_meet_give_the_products_of_the_constraint_jacobian():
    """Pairs and weights of a graph make J M^-1 J^T, also of edges that share both agents, either way round."""
    rng = np.random.default_rng(4)
    edges = np.array([[0, 1], [1, 2], [3, 2], [1, 0], [0, 1], [4, 3]])
    m, r = rng.uniform(0.5, 3.0, 5), rng.normal(size=(5, 3))
    g = kernel_graph(edges, m)
    u = r[edges[:, 0]] - r[edges[:, 1]]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    A = np.diag(g.diagonal)
    for (k, l), weight in zip(g.pairs.tolist(), g.weight, strict=True):
        A[k, l] = A[l, k] = weight * (u[k] @ u[l])
    J = jacobian(r, edges)
    np.testing.assert_allclose(A, J / np.repeat(m, 3) @ J.T, atol=1e-14)
    assert (g.pairs[:, 0] > g.pairs[:, 1]).all()


# -- the integrator --------------------------------------------------------------------------------


def a_dumbbell() -> tuple[Problem, Workspace, Any]:
    """Two unequal masses that turn about each other at a fixed distance, and their exact motion."""
    m, d, omega = np.array([1.0, 2.0]), 4.0, 1.3
    mission = a_mission(
        gravity=0.0,
        agents={"mass": m, "position": [[0, 0, 0], [d, 0, 0]]},
        constraint={"solver": "exact", "deformation_damping": 0.0},
        formations={"shape": {"distances": [d]}},
        body_frame={},
    )
    problem = a_problem(mission)._replace(has_frame=True)
    out = np.array([-2 * d / 3, d / 3])

    def exact(t: float) -> np.ndarray:
        along = np.array([math.cos(omega * t), math.sin(omega * t), 0.0])
        across = omega * np.array([-math.sin(omega * t), math.cos(omega * t), 0.0])
        centre = np.array([1.0, 0.2, -0.1]) * t
        r, v = np.outer(out, along) + centre, np.outer(out, across) + [1.0, 0.2, -0.1]
        q = [math.cos(omega * t / 2), 0.0, 0.0, math.sin(omega * t / 2)]
        return np.concatenate([r.ravel(), v.ravel(), [0.0], q])

    return problem, workspace(2, 1), exact


def fixed_steps(h: float, t_end: float, sampled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """State at t_end, and the dense output, of the dumbbell in steps of exactly h."""
    problem, w, exact = a_dumbbell()
    state = records.integrator(exact(0.0), 0.0, rtol=1e6, atol=np.full(17, 1e6))
    samples = np.empty((len(sampled), 17))
    for step in range(round(t_end / h)):
        state.clock[1] = h  # whatever the step control would like
        fresh = step == 0
        native.Integration(problem, w, state, t_end + 1.0, sampled, samples)(fresh, 1)
    assert state.clock[0] == pytest.approx(t_end)
    return state.y, samples


def slope(h: np.ndarray, error: np.ndarray) -> float:
    return float(np.polyfit(np.log(h), np.log(error), 1)[0])


def test_order_of_the_integrator():
    """Halving the step divides the error by 2^5: a log-log slope of 4.7 or more, position to attitude.

    The exact solution is a turning pair of unequal masses, held together by the constraint force.
    """
    h = np.array([1 / 4, 1 / 6, 1 / 8, 1 / 12, 1 / 16])
    exact = a_dumbbell()[2](3.0)
    errors = np.array([np.abs(fixed_steps(step, 3.0, np.zeros(0))[0] - exact) for step in h])
    for part in (slice(0, 6), slice(6, 12), slice(13, 17)):  # positions, velocities, quaternion
        assert slope(h, errors[:, part].max(axis=1)) >= 4.7
    assert errors[-1].max() < 1e-5


def test_order_of_the_dense_output():
    """Between steps the error falls with the fourth power of the step: a slope of 3.7 or more."""
    h = np.array([1 / 4, 1 / 6, 1 / 8, 1 / 12, 1 / 16])
    times = np.linspace(0.013, 2.97, 57)
    exact = np.array([a_dumbbell()[2](t) for t in times])
    errors = np.array([np.abs(fixed_steps(step, 3.0, times)[1] - exact).max() for step in h])
    assert slope(h, errors) >= 3.7
    assert errors[-1] < 1e-5


def test_error_follows_the_tolerance():
    """A hundred times tighter tolerance makes the flight ten times as exact at the least."""
    problem, w, exact = a_dumbbell()
    errors = []
    for rtol in (1e-5, 1e-7, 1e-9, 1e-11):
        state = records.integrator(exact(0.0), 0.0, rtol=rtol, atol=np.full(17, rtol / 100))
        unsampled = np.zeros(0), np.zeros((0, 17))
        status = native.Integration(problem, w, state, 5.0, *unsampled)(True, 100_000)
        assert status == records.FINISHED
        assert state.clock[0] == 5.0
        errors.append(np.abs(state.y - exact(5.0)).max())
    assert (np.array(errors[1:]) < 0.1 * np.array(errors[:-1])).all()
    assert errors[-1] < 1e-9


@pytest.mark.parametrize("pause", [1, 7, 40])
def test_a_flight_that_pauses_goes_on_as_if_it_had_not(pause):
    """Stopping after any number of steps changes no bit of states, samples or counts."""
    mission = a_mission()
    problem = a_problem(mission)
    y0 = np.concatenate([np.ravel(mission.agents.position), np.zeros(12)])
    times = np.linspace(0.0, 6.0, 121)

    def fly(steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
        state = records.integrator(y0, 0.0, rtol=1e-8, atol=np.full(21, 1e-10))
        samples, w, pauses, fresh = np.zeros((121, 21)), workspace(3, 3), 0, True
        go_on = native.Integration(problem, w, state, 6.0, times, samples)
        while go_on(fresh, steps):
            fresh = False
            pauses += 1
        return state.y, samples, state.count, pauses

    *whole, none = fly(100_000)
    *parts, pauses = fly(pause)
    assert none == 0
    assert pauses >= 2
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_array_equal(a, b)


def test_samples_lie_on_the_flight():
    """The first sample is the start itself; others equal the end of a flight that ends there."""
    mission = a_mission()
    result = simulate(mission, times=[0.0, 4.321, 5.1, 6.0])
    np.testing.assert_array_equal(result.position[0], mission.agents.position)
    for row, t in enumerate(result.time[1:], 1):
        data = mission.to_dict()
        data["phases"][0]["until"] = float(t)
        end = simulate(Mission.from_dict(data), times=[t])
        np.testing.assert_allclose(result.position[row], end.position[0], rtol=0, atol=1e-8)
        np.testing.assert_allclose(result.velocity[row], end.velocity[0], rtol=0, atol=1e-7)


def test_nothing_is_compiled_twice(tmp_path, monkeypatch):
    """The kernel is in the cache once it has flown; the folder is named by its sources."""
    simulate(a_mission(), times=[6.0])
    assert has_machine_code()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    folder = cache_directory()
    assert folder.is_relative_to(tmp_path)
    assert folder == cache_directory()
    assert not has_machine_code()


def test_a_flight_needs_no_compiler():
    """Once the machine code is in the cache, a whole flight imports neither Numba nor SciPy."""
    simulate(a_mission(), times=[6.0])
    code = """
import sys
from rigidfleet import assess, load_mission, simulate
for name in ("narrow-passage", "windy-passage"):
    assert assess(simulate(load_mission(name))).passed
assert not {"numba", "scipy"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_half_a_kernel_is_none(tmp_path, monkeypatch):
    """Machine code that was cut off in the writing is compiled again, not called."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    native._cache_code([b"machine", b"code"], "flight")
    assert native._read_cached_code("flight") == [b"machine", b"code"]
    file = native._cache_file("flight")
    file.write_bytes(file.read_bytes()[:-1])
    assert native._read_cached_code("flight") is None


def test_functions_that_are_inlined_by_name_exist():
    """Under another name a function is inlined no more, and nobody is told."""
    files = Path(build.__file__).parents[1].rglob("*.py")
    trees = [ast.parse(file.read_text("utf-8")) for file in files]
    defined = {x.name for tree in trees for x in ast.walk(tree) if isinstance(x, ast.FunctionDef)}
    assert {*build._HOT, *build._HOT_SAMPLED} <= defined


@pytest.mark.long
@pytest.mark.parametrize("helped", [True, False])
def test_a_second_process_makes_what_is_apart(helped):
    """It is not made again; if the second process fails, the first one makes it. What each makes alone is left out."""
    code = f"""
import subprocess
from rigidfleet.kernel.engine import build, objects
build._ir_text = lambda *_, **__: ("module", "symbol")
build._object_code = lambda module, symbol, name, **_: name.encode()
second = subprocess.Popen(objects.build_command("apart"), stdout=subprocess.PIPE)
if not {helped}:
    second.kill()
codes = build.flight_object_code(second)
assert [code.decode() for code in codes[:2]] == ["integrate", "record"]
names = [name for name in objects.ENTRIES["flight"] if name.encode() not in codes[:2]]
for name, code in zip(names, codes[2:], strict=True):
    assert (objects.symbol_name(name).encode() in code) if {helped} else (code == name.encode())
"""
    environment = os.environ | {"NUMBA_OPT": "0"}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)


@pytest.mark.parametrize("change", ["type", "order", "dimensions"])
def test_the_kernel_refuses_other_types(change):
    """Arrays of another type, layout or dimension than those that the code is made for are an error, not a crash."""
    problem = a_problem(a_mission())
    r = problem.control.force
    wrong = {"type": r.astype(np.float32), "order": np.asfortranarray(r), "dimensions": r.ravel()}
    other = problem._replace(control=problem.control._replace(force=wrong[change]))
    with pytest.raises(TypeError):
        native.closed_loop(0.0, np.zeros(21), np.zeros(21), other, workspace(3, 3))


# -- a user's force --------------------------------------------------------------------------------


def test_a_force_in_python_and_a_compiled_one_fly_alike():
    """An external force through ctypes and one by Numba's cfunc, of t, r and v, make the same flight."""
    pointer = types.CPointer(types.float64)
    signature = types.void(types.float64, pointer, pointer, pointer, types.intp)

    @numba.cfunc(signature)
    def compiled(t, r, v, f, n):
        for i in range(n):
            for q in range(3):
                s = 3 * i + q
                f[s] = 0.3 * math.sin(t + i) - 0.2 * v[s] - 0.05 * (q + 1) * r[s]

    def python(t, r, v):
        i = np.arange(len(r))[:, None]
        return 0.3 * np.sin(t + i) - 0.2 * v - 0.05 * np.array([1, 2, 3]) * r

    mission = a_mission()
    a, b = simulate(mission, force=python), simulate(mission, force=compiled)
    np.testing.assert_allclose(a.position, b.position, rtol=0, atol=1e-12)
    np.testing.assert_allclose(a.external_force, b.external_force, rtol=0, atol=1e-12)
    windless = simulate(mission)
    assert np.abs(a.position[-1] - windless.position[-1]).max() > 0.5
    weight = np.array([0, 0, -9.81])
    for row in (0, 50, -1):
        f = python(a.time[row], a.position[row], a.velocity[row])
        np.testing.assert_allclose(a.external_force[row], f + weight, rtol=0, atol=1e-12)


def declared(x: Any, sizes: dict[str, int], path: str) -> None:
    """Check that arrays of a named tuple have the extents that its types declare."""
    hints = get_type_hints(type(x), include_extras=True)
    for name, value in zip(x._fields, x, strict=True):
        if isinstance(value, tuple):
            declared(value, sizes, f"{path}.{name}")
        for extents in getattr(hints[name], "__metadata__", ()):
            for has, asked in zip(value.shape, extents, strict=True):
                if has == 0 and asked is None:
                    break  # without rows, nothing is read
                want = sizes.setdefault(asked, has) if isinstance(asked, str) else asked
                assert want in (None, has), f"{path}.{name} {value.shape} is declared as {extents}"


@pytest.mark.parametrize("mission", ["narrow-passage", "windy-passage", "cube-passage", "drift"])
def test_arrays_have_the_extents_that_the_kernel_is_compiled_for(mission, monkeypatch):
    seen = set()

    def pack(x: Any) -> packing.Packed:
        declared(x, {}, type(x).__name__)
        seen.add(type(x).__name__)
        return real(x)

    real = packing.pack_uncached
    monkeypatch.setattr(packing, "pack_uncached", pack)
    monkeypatch.setattr(native, "pack_uncached", pack)
    packing._last.packed.clear()
    simulate(mission).compute_lazy_values()
    assert {"Problem", "Workspace", "IntegratorState", "Monitor", "Record", "Segment"} <= seen


def places_by_number() -> list[str]:
    """Where the package reads places of an array of codes by a number, and not by a name; `[:0]` reads none."""
    root, lines = Path(rigidfleet.__file__).parent, []
    for path in sorted(root.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Subscript):
                continue
            array = getattr(node.value, "attr", getattr(node.value, "id", ""))
            at = node.slice
            parts = [at.lower, at.upper] if isinstance(at, ast.Slice) else [at]
            named = not any(isinstance(part, ast.Constant) for part in parts)
            if array in {"flags", "count", "clock"} and not named and ast.unparse(at) != ":0":
                lines.append(f"{path.relative_to(root)}:{node.lineno}: {ast.unparse(node)}")
    return lines


def test_codes_have_names():
    """No array of counters and times is read by a number: `count[TRAILED]`, not `count[4]`."""
    assert places_by_number() == []


def test_codes_of_an_array_fill_it():
    """Each place has one name, and there is none without a name."""
    state = records.integrator(np.zeros(6), 2.5, rtol=1e-6, atol=np.ones(6), step=0.125)
    named = {records.TIME: 2.5, records.NEXT_STEP: 0.125, records.LAST_ERROR: math.log(1e-4)}
    assert [named[k] for k in range(len(state.clock))] == state.clock.tolist()
    counted = (
        records.EVALUATIONS, records.ACCEPTED, records.REJECTED, records.SAMPLES, records.TRAILED,
        records.FIRST_ROW,
    )  # fmt: skip
    assert sorted(counted) == list(range(len(state.count)))
    watch = records.new_monitor(np.ones(1), np.zeros((0, 6)), np.zeros((0, 6)), 6, 3)
    assert len(watch.count) == records.STAYED + 1
