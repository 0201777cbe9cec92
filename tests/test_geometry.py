"""Closeness, attitudes of slots and ranks, against SciPy, PyRigi and plain geometry."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import jacobian
from scipy.spatial.transform import Rotation

from rigidfleet.formation import distance_geometry, graphs, shapes
from rigidfleet.kernel.engine import native
from rigidfleet.kernel.measured import Measured, measurement_arrays
from rigidfleet.math import attitude, constraint_jacobian, proximity, rigid_body
from rigidfleet.mission.obstacles import Box, Ground

seeds = st.integers(0, 2**32 - 1)


# -- closeness -------------------------------------------------------------------------------------


@settings(max_examples=20)
@given(seed=seeds, n=st.integers(2, 7))
def test_separation_is_the_least_over_all_pairs(seed, n):
    """At each sample, centre distance minus both radii, least over pairs; the pair is named."""
    rng = np.random.default_rng(seed)
    r, radius = rng.normal(size=(5, n, 3)) * 3, rng.uniform(0.1, 1.0, n)
    least, pair = proximity.separation(r, radius)
    for k in range(5):
        distance = {
            (i, j): np.linalg.norm(r[k, i] - r[k, j]) - radius[i] - radius[j]
            for i in range(n)
            for j in range(i + 1, n)
        }
        closest = min(distance, key=lambda p: distance[p])
        assert tuple(pair[k]) == closest
        assert least[k] == pytest.approx(distance[closest], abs=1e-14)


@pytest.mark.parametrize("sizes", ["equal", "different"])
def test_separation_of_many_is_the_least_over_all_pairs_while_they_move_and_mix(sizes):
    """As found among all pairs, in a formation that turns and flies off, wobbles, and then falls apart."""
    rng = np.random.default_rng(2)
    n = 300
    radius = np.full(n, 0.1) if sizes == "equal" else rng.uniform(0.1, 0.5, n)
    shape = shapes.slots("sphere", 2.0, n)
    velocity = rng.normal(size=shape.shape)
    r = np.empty((24, n, 3))
    for k in range(24):
        turned = Rotation.from_rotvec([0.02 * k, 0.0, 0.1 * k]).apply(shape)
        r[k] = turned + 5.0 * k + rng.uniform(-0.03, 0.03, shape.shape)
        r[k] += max(0, k - 12) * velocity
    r[20, 7] = np.nan
    least, pair = proximity.separation(r, radius)
    for k in range(24):
        apart = np.linalg.norm(r[k, :, None] - r[k], axis=2) - radius - radius[:, None]
        apart[np.tril_indices(n)] = np.inf
        np.testing.assert_allclose(least[k], np.nanmin(apart), rtol=0, atol=1e-12)
        assert pair[k, 0] < pair[k, 1]
        assert apart[tuple(pair[k])] == pytest.approx(least[k], abs=1e-12)


def test_one_agent_is_apart_from_nobody():
    """Without a pair the separation is infinite and names nobody."""
    least, pair = proximity.separation(np.zeros((2, 1, 3)), [0.5])
    np.testing.assert_array_equal(least, [np.inf, np.inf])
    np.testing.assert_array_equal(pair, -1)


BOX = Box(kind="box", name="wall", min=(1.0, 2.0, 3.0), max=(4.0, 6.0, 8.0))


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ([0.0, 3.0, 4.0], 1.0),  # before a face
        ([7.0, 10.0, 5.0], 5.0),  # beside an edge
        ([0.0, 0.0, 1.0], 3.0),  # off a corner
        ([1.0, 4.0, 5.0], 0.0),  # on a face
        ([1.5, 4.0, 5.0], -0.5),  # inside, nearest to a face
        ([2.5, 4.0, 7.9], -0.1),
    ],
)
def test_clearance_of_a_box(point, distance):
    """Distance to the box's nearest point minus the radius; inside, minus the depth as well."""
    r = np.array([[[50.0, 50.0, 50.0], point]])
    least, agent, obstacle = proximity.clearance(r, [0.25, 0.25], [BOX])
    assert least[0] == pytest.approx(distance - 0.25, abs=1e-14)
    assert (agent[0], obstacle[0]) == (1, 0)


@settings(max_examples=20)
@given(seed=seeds)
def test_clearance_of_a_box_is_the_distance_to_its_nearest_point(seed):
    """Outside, no point of the box is nearer than the one a projection finds."""
    rng = np.random.default_rng(seed)
    r = rng.uniform(-10, 15, (20, 1, 3))
    least, _, _ = proximity.clearance(r, [0.0], [BOX])
    low, high = np.array(BOX.min), np.array(BOX.max)
    nearest = np.clip(r[:, 0], low, high)
    distance = np.linalg.norm(r[:, 0] - nearest, axis=1)
    outside = distance > 0
    np.testing.assert_allclose(least[outside], distance[outside], rtol=1e-14)
    assert (least[~outside] <= 0).all()


def test_clearance_names_the_nearest_of_several_obstacles():
    """Over time the nearest obstacle and the agent next to it change, and are named."""
    ground = Ground(kind="ground", name="ground", height=0.5)
    r = np.array(
        [
            [[2.0, 4.0, 1.2], [20.0, 0.0, 9.0]],  # agent 0 above the ground, below the box
            [[2.0, 4.0, 2.9], [20.0, 0.0, 9.0]],  # agent 0 under the box
            [[2.0, 20.0, 9.0], [20.0, 0.0, 0.3]],  # agent 1 in the ground
        ]
    )
    least, agent, obstacle = proximity.clearance(r, [0.1, 0.2], [ground, BOX])
    np.testing.assert_allclose(least, [0.6, 0.0, -0.4], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(agent, [0, 0, 1])
    np.testing.assert_array_equal(obstacle, [0, 1, 0])


def test_no_obstacle_is_clear():
    """Without obstacles the clearance is infinite and names nothing."""
    least, agent, obstacle = proximity.clearance(np.zeros((2, 3, 3)), [0.1] * 3, [])
    np.testing.assert_array_equal(least, np.inf)
    np.testing.assert_array_equal(np.concatenate([agent, obstacle]), -1)


# -- attitude --------------------------------------------------------------------------------------

LINE = np.array([[-4.0, 0, 0], [0, 0, 0], [4, 0, 0]])
EYE = np.eye(3)


def shape(name: str, rng: np.random.Generator) -> np.ndarray:
    """Slots (N, 3) in any position about their own axes."""
    flat = {"spatial": [1, 1, 1], "planar": [1, 1, 0]}[name]
    return Rotation.random(random_state=rng).apply(rng.normal(size=(5, 3)) * 3 * np.array(flat))


def measure(x, v, p, m, near) -> Measured:
    """The kernel's measurement of agents at x with velocities v, slots p (K, N, 3) and masses m (N,).

    ``near`` (K, 3, 3) are attitudes commanded; one (3, 3) is the attitude before the first sample.
    """
    x, p = np.ascontiguousarray(x), np.ascontiguousarray(p)
    K, n = x.shape[:2]
    zero = np.zeros_like(x)
    commanded = near if near.ndim == 3 else np.full((K, 3, 3), np.nan)
    found = measurement_arrays(
        n, 0, K, time=np.arange(K, dtype=float), start=np.array([0, K]), attached=np.ones(1, dtype=bool),
        framed=False, mass=m, lost_at=np.full(n, np.inf), limit=np.full(n, np.inf),
        edges=np.zeros((0, 2), dtype=np.int64), r=x, v=np.ascontiguousarray(v), f_u=zero, f_C=zero, p=p,
        T_ref=np.ascontiguousarray(commanded),
    )  # fmt: skip
    if near.ndim == 2:
        found.work[5, :3, :3] = near
    native.measure_samples(found)
    return found


def fit_attitudes(x, p, m, near) -> tuple[np.ndarray, np.ndarray]:
    """Attitudes (K, 3, 3) of slots p (K, N, 3) fitted to agents x, and whether these are lines; as in `measure`."""
    found = measure(x, np.zeros_like(x), p, m, near)
    return attitude.dcm_from_quaternion(found.attitude), found.line


@pytest.mark.parametrize("name", ["spatial", "planar"])
@settings(max_examples=20)
@given(seed=seeds)
def test_fit_finds_the_attitude_of_turned_slots(name, seed):
    """Agents at T^T p give T back, whatever is expected: spatial and planar shapes, any weights."""
    rng = np.random.default_rng(seed)
    m = rng.uniform(0.5, 2.0, 5)
    p = shape(name, rng)
    p -= m @ p / m.sum()
    T = Rotation.random(4, random_state=rng).as_matrix()
    x = np.einsum("kba,ib->kia", T, p)
    found, _ = fit_attitudes(x, np.broadcast_to(p, x.shape), m, EYE)
    np.testing.assert_allclose(found, T, rtol=0, atol=1e-12)


@settings(max_examples=20)
@given(seed=seeds)
def test_fit_of_a_deformed_shape_is_scipys(seed):
    """Where slots do not fit exactly, the weighted least-squares rotation is SciPy's."""
    rng = np.random.default_rng(seed)
    m = rng.uniform(0.5, 2.0, 5)
    p = shape("spatial", rng)
    p -= m @ p / m.sum()
    T = Rotation.random(random_state=rng)
    x = T.inv().apply(p) + rng.normal(size=p.shape) * 0.2
    x -= m @ x / m.sum()
    found = fit_attitudes(x[None], p[None], m, EYE)[0][0]
    expected = Rotation.align_vectors(p, x, weights=m)[0].as_matrix()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


def test_a_mirror_image_gets_a_rotation_all_the_same():
    """Of a spatial shape's mirror image the fit is a proper rotation, det +1, and no exact one."""
    rng = np.random.default_rng(3)
    p = shape("spatial", rng)
    p -= p.mean(axis=0)
    x = p * [1, 1, -1]
    T = fit_attitudes(x[None], p[None], np.ones(5), EYE)[0][0]
    assert np.linalg.det(T) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(T @ T.T, EYE, rtol=0, atol=1e-12)
    assert np.abs(x @ T.T - p).max() > 0.5


def turned_line(T: np.ndarray) -> np.ndarray:
    """Agents on a line of attitude T (K, 3, 3)."""
    return np.einsum("kba,ib->kia", T, LINE)


@settings(max_examples=20)
@given(seed=seeds)
def test_a_line_takes_the_attitude_nearest_to_the_one_expected(seed):
    """Its axis points along the agents; about it the line does not spin against what is expected."""
    rng = np.random.default_rng(seed)
    near = Rotation.random(3, random_state=rng).as_matrix()
    small = Rotation.from_rotvec(rng.normal(size=(3, 3)) * 0.3).as_matrix()
    x = turned_line(small @ near)
    found, _ = fit_attitudes(x, np.broadcast_to(LINE, x.shape), np.ones(3), near)
    np.testing.assert_allclose(
        np.einsum("kab,kib->kia", found, x), np.broadcast_to(LINE, x.shape), atol=1e-12
    )
    # The rotation from the expected attitude is about an axis across the line: none along it.
    between = Rotation.from_matrix(np.einsum("kab,kcb->kac", found, near)).as_rotvec()
    np.testing.assert_allclose(between[:, 0], 0, atol=1e-12)
    # No attitude with the same axis is nearer.
    for k in range(3):
        least = np.linalg.norm(between[k])
        for spin in (-0.1, 0.1):
            other = Rotation.from_rotvec([spin, 0, 0]).as_matrix() @ found[k]
            turn = Rotation.from_matrix(other @ near[k].T).magnitude()
            assert turn > least - 1e-12


def test_a_line_is_followed_from_sample_to_sample():
    """A line that turns slowly keeps the roll it had, through more than half a turn, without a jump."""
    yaw = np.linspace(0, 1.5 * np.pi, 60)
    roll = Rotation.from_rotvec([0.7, 0, 0]).as_matrix()
    T = roll @ Rotation.from_euler("z", -yaw[:, None]).as_matrix()
    x = turned_line(T)
    found, _ = fit_attitudes(x, np.broadcast_to(LINE, x.shape), np.ones(3), T[0])
    np.testing.assert_allclose(found, T, rtol=0, atol=1e-10)


def test_a_line_turned_about_by_half_a_turn_has_an_attitude():
    """Where every axis across the line would do, one is taken: a rotation that brings the line home."""
    found = fit_attitudes(-LINE[None], LINE[None], np.ones(3), EYE)[0][0]
    np.testing.assert_allclose(-LINE @ found.T, LINE, rtol=0, atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("short", [1e-3, 1e-5, 1.5e-6, 1e-7, 2e-8, 1e-9, 0.0])
def test_lines_that_are_nearly_reversed_have_attitudes(short):
    """Next to half a turn the smallest rotation is one still, and lays the line where the agents are."""
    towards = np.array([np.cos(np.pi - short), np.sin(np.pi - short), 0.0])
    x = np.outer(LINE[:, 0], towards)
    for near in (EYE, EYE[None]):
        T = fit_attitudes(x[None], LINE[None], np.ones(3), near)[0][0]
        np.testing.assert_allclose(T @ T.T, EYE, rtol=0, atol=1e-7)
        np.testing.assert_allclose(LINE @ T, x, rtol=0, atol=1e-6)
        assert np.linalg.det(T) > 0


def test_attitude_goes_on_through_a_line():
    """A triangle that folds into a line and opens again keeps its attitude all the way."""
    triangle = shapes.slots("triangle", 4.0, 3)
    s = np.concatenate([np.linspace(1, 0, 30), np.linspace(0, 1, 30)])[:, None, None]
    p = LINE[[0, 1, 2]] * (1 - s) + triangle * s
    p -= p.mean(axis=1, keepdims=True)
    T = Rotation.from_euler("ZYX", [50, 20, -30], degrees=True).as_matrix().T
    x = p @ T
    found, _ = fit_attitudes(x, p, np.ones(3), T)
    np.testing.assert_allclose(found, np.broadcast_to(T, found.shape), rtol=0, atol=1e-9)


def test_an_agent_that_is_lost_does_not_turn_the_line_of_the_others():
    """Two of three that are left are a line, wherever the third falls."""
    T = Rotation.from_euler("z", -0.3).as_matrix()
    p = np.array([[-2.0, 0, 0], [2.0, 0, 0], [0, 3.0, 0]])
    x = np.broadcast_to(p @ T, (4, 3, 3)).copy()
    x[:, 2] += [5.0, -7.0, -20.0]
    found, line = fit_attitudes(x, np.broadcast_to(p, x.shape), np.array([1.0, 1.0, 0.0]), T)
    assert line.all()
    np.testing.assert_allclose(found, np.broadcast_to(T, found.shape), rtol=0, atol=1e-12)


def test_one_agent_has_the_attitude_expected():
    """A point has no attitude of its own."""
    near = Rotation.from_euler("z", [[0.3], [0.4]]).as_matrix()
    found, _ = fit_attitudes(np.zeros((2, 1, 3)), np.zeros((2, 1, 3)), np.ones(1), near)
    np.testing.assert_allclose(found, near, rtol=0, atol=1e-15)


@settings(max_examples=20)
@given(seed=seeds, n=st.integers(1, 6))
def test_mean_axis_rates_are_those_of_the_rigid_motion(seed, n):
    """v = omega x r gives omega; of a pair its part across the line, of a point nothing."""
    rng = np.random.default_rng(seed)
    m = rng.uniform(0.5, 2.0, n)
    x = rng.normal(size=(3, n, 3)) * 2
    x -= np.einsum("i,kia->ka", m, x)[:, None] / m.sum()
    omega = rng.normal(size=(3, 3))
    y = np.cross(omega[:, None], x)
    found = rigid_body.mean_axis_rates(x, y, m)
    if n == 1:
        omega = np.zeros((3, 3))
    elif n == 2:
        u = x[:, 0] / np.linalg.norm(x[:, 0], axis=1)[:, None]
        omega = omega - np.einsum("ka,ka->k", u, omega)[:, None] * u
    np.testing.assert_allclose(found, omega, rtol=0, atol=1e-9)
    at_rest = np.broadcast_to(EYE, (3, 3, 3))
    spatial = n > 2  # slots on a line would have no spin about themselves
    rates = measure(x, y, x, m, at_rest).rates if spatial else omega
    np.testing.assert_allclose(rates, omega, rtol=0, atol=1e-9)


@pytest.mark.parametrize("off", [0.0, 1e-7, 1e-3, 0.1, 1.0, 4.0])
def test_rates_of_a_line_leave_out_the_spin_about_it(off):
    """As the pseudo-inverse of the inertia does, whose small eigenvalues are zero: also of agents beside their line."""
    rng = np.random.default_rng(1)
    x, y = LINE + off * rng.normal(size=(5, 3, 3)), rng.normal(size=(5, 3, 3))
    x, y = (
        z - z.mean(axis=1, keepdims=True) for z in (x @ Rotation.random(rng=rng).as_matrix(), y)
    )
    found = measure(
        x, y, np.broadcast_to(LINE, x.shape), np.ones(3), np.broadcast_to(EYE, (5, 3, 3))
    )
    assert found.line.all()
    inertia = np.einsum("kia,kia,bc->kbc", x, x, EYE) - np.einsum("kib,kic->kbc", x, x)
    rates = (np.linalg.pinv(inertia, rcond=0.01) @ np.cross(x, y).sum(axis=1)[..., None])[..., 0]
    T = attitude.dcm_from_quaternion(found.attitude)
    np.testing.assert_allclose(found.rates, (T @ rates[..., None])[..., 0], rtol=0, atol=1e-12)


# -- ranks -----------------------------------------------------------------------------------------


CYCLE = np.array([(0, 1), (1, 2), (2, 3), (0, 3)])
CUBE = shapes.slots("cube", 4.0, 8)
HEXAGON_EDGES = np.array(
    [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (0, 5), (0, 2), (1, 3), (2, 4), (3, 5), (0, 4), (1, 5)]
)
PRINTED = {  # slots, edges, rank of J
    "pair": (shapes.slots("line", 4.0, 2), graphs.complete_graph(2), 1),
    "triangle": (shapes.slots("triangle", 4.0, 3), graphs.complete_graph(3), 3),
    "line": (LINE, graphs.complete_graph(3), 2),
    "square": (shapes.slots("square", 4.0, 4), graphs.complete_graph(4), 5),
    "cycle": (shapes.slots("square", 4.0, 4), CYCLE, 4),
    "tetrahedron": (shapes.slots("pyramid", 4.0, 4), graphs.complete_graph(4), 6),
    "hexagon": (shapes.slots("hexagon", 4.0, 6), HEXAGON_EDGES, 9),
    "cube": (CUBE, graphs.CUBE_EDGES, 18),
    "complete cube": (CUBE, graphs.complete_graph(8), 18),
}


@pytest.mark.parametrize("name", PRINTED)
def test_smallest_singular_value_is_the_last_above_the_rank(name):
    """It is the singular value that NumPy finds at the rank, not a zero beyond it."""
    r, edges, rank = PRINTED[name]
    values = np.linalg.svd(jacobian(r, edges), compute_uv=False)
    assert np.linalg.matrix_rank(jacobian(r, edges), 1e-9) == rank
    found = constraint_jacobian.smallest_singular_value(r[None], edges)
    assert found[0] == pytest.approx(values[rank - 1], rel=1e-9)


@settings(max_examples=20)
@given(seed=seeds, n=st.integers(2, 9))
def test_singular_values_of_many_samples_are_those_of_each(seed, n):
    """At random places, of any number of edges, on the smaller and the larger side of J."""
    rng = np.random.default_rng(seed)
    edges = rng.permutation(graphs.complete_graph(n))[: rng.integers(1, 4 * n)]
    r = rng.normal(size=(4, n, 3)) * 3
    found = constraint_jacobian.smallest_singular_value(r, edges)
    for k in range(4):
        values = np.linalg.svd(jacobian(r[k], edges), compute_uv=False)
        least = values[values > 1e-6 * values[0]].min()
        assert found[k] == pytest.approx(least, rel=1e-7)


def test_singular_values_of_triangles_are_right_however_flat():
    """The least eigenvalue is exact to rounding; at each sample alone it is the same, and two agents in one place spoil
    no other sample."""
    rng = np.random.default_rng(3)
    r = rng.normal(size=(21, 3, 3))
    r[:, :, 1:] *= np.logspace(-6, 0, 21)[:, None, None]
    r[5, 1] = r[5, 0]
    edges = graphs.complete_graph(3)
    found = constraint_jacobian.smallest_singular_value(r, edges)
    assert np.isnan(found).tolist() == [k == 5 for k in range(21)]
    for k in set(range(21)) - {5}:
        values = np.linalg.svd(jacobian(r[k], edges), compute_uv=False)
        assert found[k] ** 2 == pytest.approx(values[values > 1e-7].min() ** 2, rel=0, abs=5e-15)
        assert constraint_jacobian.smallest_singular_value(r[[k]], edges)[0] == found[k]


@pytest.mark.parametrize(
    "points",
    [
        [[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1]],  # from one agent, at equal angles
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],  # at right angles
        [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]],  # on a line: two eigenvalues are zero
    ],
)
@pytest.mark.parametrize("edges", [[[0, 1], [0, 2], [3, 0]], [[0, 1], [2, 1], [2, 3]]])
def test_singular_values_of_three_edges_are_right_where_some_are_equal(points, edges):
    """The least eigenvalue is exact to rounding where it is a double one, and however near to that."""
    rng = np.random.default_rng(4)
    off = np.array([0, 1e-300, 1e-16, 1e-12, 1e-8, 1e-4])
    r = np.array(points) + off[:, None, None] * rng.normal(size=(6, 4, 3))
    found = constraint_jacobian.smallest_singular_value(r, np.array(edges))
    for k in range(6):
        values = np.linalg.svd(jacobian(r[k], edges), compute_uv=False)
        least = values[values > 1e-7 * values[0]].min()
        assert found[k] ** 2 == pytest.approx(least**2, rel=0, abs=5e-15)


def test_weighted_singular_values_are_those_of_the_law():
    """With masses, the squares are the eigenvalues of mbar J M^-1 J^T, which the solvers see."""
    rng = np.random.default_rng(0)
    r, m = rng.normal(size=(4, 5, 3)), rng.uniform(0.5, 2.0, 5)
    edges = graphs.complete_graph(5)[:8]
    found = constraint_jacobian.smallest_singular_value(r, edges, m)
    for k in range(4):
        J = jacobian(r[k], edges)
        w = np.linalg.eigvalsh(m.mean() * (J / np.repeat(m, 3)) @ J.T)
        assert found[k] ** 2 == pytest.approx(w[0], rel=1e-9)


def test_without_edges_there_is_no_singular_value():
    """No edge, no Jacobian: NaN at every sample."""
    found = constraint_jacobian.smallest_singular_value(
        np.zeros((3, 2, 3)), np.zeros((0, 2), dtype=np.int64)
    )
    assert np.isnan(found).all()
    assert found.shape == (3,)


def test_the_line_shows_in_the_singular_value():
    """An offset h from the line of three leaves lambda_min = h^2/8, so sigma = h/sqrt(8)."""
    for h in (1e-1, 1e-2, 1e-3):
        r = LINE + [[0, 0, 0], [0, h, 0], [0, 0, 0]]
        sigma = constraint_jacobian.smallest_singular_value(r[None], graphs.complete_graph(3))[0]
        assert sigma == pytest.approx(h / np.sqrt(8), rel=5e-3)


@pytest.mark.parametrize("name", PRINTED)
def test_ranks_are_pyrigis(name):
    """The rank at the shape, and the rank that a generic shape has, are those of PyRigi."""
    from pyrigi import Framework, Graph

    r, edges, rank = PRINTED[name]
    n = len(r)
    graph: Any = Graph([(int(i), int(j)) for i, j in edges])
    at = lambda points: Framework(graph, {i: list(map(float, p)) for i, p in enumerate(points)})  # noqa: E731
    assert at(r).rigidity_matrix_rank(numerical=True) == rank
    points = np.random.default_rng(n).normal(size=(n, 3)) * 3
    generic = np.linalg.matrix_rank(jacobian(points, edges), 1e-9)
    assert at(points).rigidity_matrix_rank(numerical=True) == generic
    rigid = (
        graph.is_rigid(dim=3, algorithm="randomized") if n > 3 else len(edges) == n * (n - 1) / 2
    )
    assert rigid == (generic == max(3 * n - 6, n - 1))
    values = np.linalg.svd(jacobian(points, edges), compute_uv=False)
    found = constraint_jacobian.smallest_singular_value(points[None], edges)[0]
    assert found == pytest.approx(values[generic - 1], rel=1e-9)
    # Planar and straight shapes lose rank: at most 2 N - 3 and N - 1 of what a generic shape has.
    dimension = distance_geometry.dimension(r)
    assert rank <= {1: n - 1, 2: 2 * n - 3, 3: 3 * n - 6}[dimension]


def test_a_bent_line_has_no_attitude_about_itself():
    """Slots a tenth as wide as agents are off them lie as expected about their axis, and spin about it by nothing."""
    rng = np.random.default_rng(5)
    p = np.array([[-4.0, 0.02, 0], [0, -0.04, 0], [4, 0.02, 0]])
    T = Rotation.random(20, random_state=rng).as_matrix()
    off = rng.normal(size=(20, 3, 3)) * 0.2
    x = np.einsum("kba,ib->kia", T, p) + off
    x -= x.mean(axis=1, keepdims=True)
    found, line = fit_attitudes(x, np.broadcast_to(p, x.shape), np.ones(3), T)
    assert line.all()
    away = np.einsum("kab,kcb->kac", found, T)
    assert np.degrees(np.arccos((np.trace(away, axis1=1, axis2=2) - 1) / 2)).max() < 10
    y = rng.normal(size=x.shape)
    rates = measure(x, y, np.broadcast_to(p, x.shape), np.ones(3), T).rates
    omega = np.einsum("kba,kb->ka", found, rates)
    axis = np.linalg.svd(x)[2][:, 0]
    assert np.abs(np.einsum("ka,ka->k", omega, axis)).max() < 1e-9


def test_a_narrow_shape_that_fits_keeps_its_attitude():
    """Narrow slots that agents are on, to a hundredth of the width, are no line: their roll is found."""
    rng = np.random.default_rng(6)
    p = np.array([[-4.0, 0.1, 0], [0, -0.2, 0], [4, 0.1, 0]])
    T = Rotation.random(20, random_state=rng).as_matrix()
    x = np.einsum("kba,ib->kia", T, p) + rng.normal(size=(20, 3, 3)) * 1e-3
    x -= x.mean(axis=1, keepdims=True)
    found, line = fit_attitudes(x, np.broadcast_to(p, x.shape), np.ones(3), T)
    assert not line.any()
    np.testing.assert_allclose(found, T, rtol=0, atol=0.03)


@pytest.mark.parametrize("n", [30, 210])
def test_headroom_is_the_least_height_above_another(n: int):
    """Of pairs that overlap as seen from above the nearest in height; by trying all of them."""
    rng = np.random.default_rng(7)
    r, radius = rng.uniform(0, 6, (5, n, 3)), rng.uniform(0.1, 0.6, n)
    r[:, 4] = np.nan  # who has left is below nobody
    distance, pair = proximity.headroom(r, radius)
    for k in range(5):
        found = [
            (abs(r[k, i, 2] - r[k, j, 2]) - radius[i] - radius[j], i, j)
            for i in range(n)
            for j in range(i + 1, n)
            if np.hypot(*(r[k, i] - r[k, j])[:2]) <= radius[i] + radius[j]
        ]
        assert (distance[k], *pair[k]) == pytest.approx(min(found))
    far = np.full((1, n, 3), np.nan)
    for far[0, :2] in (
        [[0.0, 0, 0], [9, 0, 0]],
        np.nan,
    ):  # apart from each other, and nobody is there
        distance, pair = proximity.headroom(far, np.full(n, 0.1))
        assert np.isinf(distance[0])
        assert pair.tolist() == [[-1, -1]]
