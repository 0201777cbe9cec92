import warnings
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from rigidfleet.formation import distance_geometry, graphs, shapes
from rigidfleet.math.constraint_jacobian import smallest_singular_value
from rigidfleet.rigidity import Kind, RigidityClass, analyse, full_rank, jacobian, realisations

RIGID, STABLE = RigidityClass.INFINITESIMALLY_RIGID, RigidityClass.PRESTRESS_STABLE
FLEXIBLE, UNDECIDED = RigidityClass.FLEXIBLE, RigidityClass.UNDECIDED
SEEDS = st.integers(0, 2**32 - 1)
SPREAD = np.array([[-1, -2, -3], [2, 1, 0.5], [0.3, 2, 1], [1.5, -0.7, 2], [-2, 1.1, -0.4]])


def graph(seed, n, share):
    """Some of the edges between n agents."""
    edges = graphs.complete_graph(n)
    return edges[np.random.default_rng(seed).random(len(edges)) < share]


def shape(seed, n, dimension):
    p = np.zeros((n, 3))
    p[:, :dimension] = np.random.default_rng(seed).normal(size=(n, dimension))
    return p


def hull(p):
    """Edges of the triangulated convex hull of points."""
    sides = {pair for t in ConvexHull(p).simplices.tolist() for pair in combinations(sorted(t), 2)}
    return np.array(sorted(sides))


def double_banana(seed=0):
    """Two triangular bipyramids that share their tips, agents 4 and 5."""
    one = [(0, 1), (0, 2), (1, 2), *((i, j) for i in (0, 1, 2) for j in (3, 4))]
    two = [(5, 6), (5, 7), (6, 7), *((i, j) for i in (3, 4) for j in (5, 6, 7))]
    return shape(seed, 8, 3), np.array(one + two)


def blocks(result, p):
    """Whether the stress is in balance and has positive energy on every flex."""
    J = jacobian(p, result.edges)
    omega = result.stress / distance_geometry.distances(p, result.edges)
    i, j = result.edges.T
    step = np.array([flex.motion[i] - flex.motion[j] for flex in result.flexes])
    energy = np.einsum("k,akx,bkx->ab", omega, step, step)
    balance = np.abs(result.stress @ J).max()
    return balance < 1e-9 and np.linalg.eigvalsh(energy)[0] > 0


# -- the paper's shapes


def test_cube_of_paper_is_infinitesimally_rigid():
    """The 18 edges of the paper's cube are independent, and w = 0.2586."""
    result = analyse(shapes.slots("cube", 4.0, 8), graphs.CUBE_EDGES)
    assert result.rigidity_class is RIGID
    assert (result.rank, result.reachable, result.needed) == (18, 18, 18)
    assert result.w == pytest.approx(0.2586, abs=5e-5)
    assert len(result.redundant) == len(result.flexes) == 0


def test_double_banana_is_flexible_with_as_many_edges():
    """Eight agents and 18 edges are no guarantee: the double banana has rank 17 and turns about its tips."""
    p, edges = double_banana()
    result = analyse(p, edges)
    assert (len(edges), result.rank, result.needed) == (18, 17, 18)
    assert result.rigidity_class is FLEXIBLE
    assert [flex.agents for flex in result.flexes] in ([(0, 1, 2)], [(5, 6, 7)])
    assert len(result.redundant) == 18
    assert len(result.spare) == 1


@pytest.mark.parametrize(
    ("name", "n", "edges", "rank", "flexes"),
    [
        ("line", 3, 3, 2, 2),
        ("square", 4, 6, 5, 1),
        ("hexagon", 6, 12, 9, 3),
        ("hexagon", 6, 15, 9, 3),
    ],
)
def test_flat_shapes_are_at_best_prestress_stable(name, n, edges, rank, flexes):
    """4-8-4, the square and the hexagon reach ranks 2, 5 and 9: a self-stress holds them, no more."""
    p, graph = shapes.slots(name, 4.0, n), graphs.complete_graph(n)
    if edges < len(graph):  # the hexagon without its long diagonals
        graph = graph[distance_geometry.distances(p, graph) < 7.9]
    result = analyse(p, graph)
    assert (len(graph), result.rank, result.reachable, len(result.flexes)) == (
        edges,
        rank,
        rank,
        flexes,
    )
    assert result.rigidity_class is STABLE
    assert blocks(result, p)
    assert result.within is not None
    assert result.within.rigidity_class is RIGID


def test_square_without_one_edge_folds():
    """Five edges hold a square in its plane; in space it folds about the diagonal, and one agent moves."""
    result = analyse(shapes.slots("square", 4.0, 4), [[0, 1], [1, 2], [2, 3], [0, 3], [0, 2]])
    assert result.rigidity_class is FLEXIBLE
    assert [flex.agents for flex in result.flexes] == [(1,)]
    assert result.within is not None
    assert result.within.rigidity_class is RIGID


@pytest.mark.parametrize(
    ("n", "edges", "rigidity_class"),
    [(1, [], RIGID), (2, [[0, 1]], RIGID), (2, [], FLEXIBLE), (3, [[0, 1], [1, 2]], FLEXIBLE)],
)
def test_few_agents(n, edges, rigidity_class):
    """One agent is rigid, two need an edge and three need three."""
    assert analyse(SPREAD[:n], edges).rigidity_class is rigidity_class


def test_shipped_index_is_that_of_a_flight():
    """The index is the smallest non-zero singular value of J M^-1/2 sqrt(mbar), as recorded in flight."""
    p, masses = shapes.slots("cube", 4.0, 8), np.linspace(0.5, 2, 8)
    want = smallest_singular_value(p[None], graphs.CUBE_EDGES, masses)[0]
    assert analyse(p, graphs.CUBE_EDGES, masses=masses).index == pytest.approx(want)


def test_force_and_offset_are_reached():
    """In the weakest direction J^T A^-1 b has the norm |b| m / index, and the displacement is |c| / index."""
    p = shapes.slots("cube", 4.0, 8)
    result, J = analyse(p, graphs.CUBE_EDGES), jacobian(p, graphs.CUBE_EDGES)
    b = np.linalg.svd(J)[0][:, -1]
    A = J @ J.T / 2.0
    assert np.linalg.norm(J.T @ np.linalg.solve(A, b)) == pytest.approx(
        result.constraint_force_bound(1.0, mass=2.0)
    )
    assert np.linalg.norm(np.linalg.pinv(J) @ b) == pytest.approx(result.offset(1.0))


# -- general theorems


@pytest.mark.parametrize("n", [4, 6, 10, 25])
def test_triangulated_convex_polyhedra_are_rigid(n):
    """Dehn (1916): a convex polyhedron with triangular faces is infinitesimally rigid, with 3N - 6 edges."""
    p = shape(n, n, 3)
    p /= np.linalg.norm(p, axis=1)[:, None]
    edges = hull(p)
    result = analyse(p, edges)
    assert len(edges) == result.rank == 3 * n - 6
    assert result.rigidity_class is RIGID


def test_polyhedron_without_an_edge_moves_on():
    """Take one edge away, and one motion is free, for good."""
    p = shape(3, 10, 3)
    p /= np.linalg.norm(p, axis=1)[:, None]
    result = analyse(p, hull(p)[1:])
    assert result.rigidity_class is FLEXIBLE
    assert len(result.flexes) == 1


@given(SEEDS, st.integers(2, 9), st.integers(1, 3))
@settings(max_examples=25)
def test_complete_graphs_are_rigid(seed, n, dimension):
    """All distances determine a shape: rigid in space, prestress-stable where flat (Connelly, 1982)."""
    p = shape(seed, n, dimension)
    result = analyse(p, graphs.complete_graph(n))
    assert result.rank == result.reachable == full_rank(n, dimension)
    assert result.rigidity_class is (RIGID if n <= dimension + 1 or dimension == 3 else STABLE)
    if result.stress is not None:
        assert blocks(result, p)


@given(SEEDS, st.integers(4, 15), st.integers(1, 3), st.floats(0, 1))
@settings(max_examples=40)
def test_verdicts_of_small_formations(seed, n, dimension, share):
    """Lines, planes and shapes in space with any edges: each rigidity_class comes with what it rests on."""
    p, edges = shape(seed, n, dimension), graph(seed, n, share)
    result = analyse(p, edges)
    assert result.rank == np.linalg.matrix_rank(jacobian(p, edges), tol=1e-6) <= result.reachable
    assert (result.rigidity_class is RIGID) == (result.rank == result.needed)
    assert len(result.flexes) == 3 * n - result.rank - (5 if dimension == 1 else 6)
    for flex in result.flexes:
        assert np.abs(jacobian(p, edges) @ flex.motion.ravel()).max(initial=0) < 1e-6
        assert flex.agents == tuple(np.flatnonzero(flex.motion.any(axis=1)))
    if result.rigidity_class is STABLE:
        assert blocks(result, p)
    if result.deformed is not None:
        want, pairs = distance_geometry.distances(p, edges), graphs.complete_graph(n)
        np.testing.assert_allclose(
            distance_geometry.distances(result.deformed, edges), want, atol=1e-9
        )
        assert (
            np.abs(
                distance_geometry.distances(result.deformed, pairs)
                - distance_geometry.distances(p, pairs)
            ).max()
            > 1e-6
        )


@given(SEEDS, st.integers(3, 8), st.integers(1, 3), st.floats(0.3, 1), st.floats(0.01, 100))
@settings(max_examples=25)
def test_verdict_knows_neither_place_nor_size_nor_numbers(seed, n, dimension, share, scale):
    """Turned, shifted, scaled and renumbered, a formation has the same ranks, index, flexes and rigidity_class."""
    p, edges = shape(seed, n, dimension), graph(seed, n, share)
    R = Rotation.random(random_state=np.random.RandomState(seed)).as_matrix()
    number = np.random.default_rng(seed).permutation(n)
    q = np.empty_like(p)
    q[number] = scale * p @ R.T + [5, -3, 2]
    one, two = analyse(p, edges), analyse(q, number[edges])
    assert (one.rank, one.dimension, one.rigidity_class) == (
        two.rank,
        two.dimension,
        two.rigidity_class,
    )
    assert one.index == pytest.approx(two.index, rel=1e-6, nan_ok=True)
    np.testing.assert_array_equal(one.redundant, two.redundant)
    assert [len(x.agents) for x in one.flexes if len(x.agents) == 1] == [
        len(x.agents) for x in two.flexes if len(x.agents) == 1
    ]


@given(SEEDS, st.integers(4, 8), st.floats(0.5, 1))
@settings(max_examples=20)
def test_redundant_edges_are_those_that_can_go(seed, n, share):
    """An edge is redundant exactly if J keeps its rank without it; all the spare ones can go together."""
    p, edges = shape(seed, n, 3), graph(seed, n, share)
    result, J = analyse(p, edges), jacobian(p, edges)
    can_go = [
        k
        for k in range(len(edges))
        if np.linalg.matrix_rank(np.delete(J, k, 0), 1e-6) == result.rank
    ]
    assert result.redundant.tolist() == can_go
    assert len(result.spare) == len(edges) - result.rank
    assert np.linalg.matrix_rank(np.delete(J, result.spare, 0), 1e-6) == result.rank


def test_flexes_name_the_few():
    """A chain of three tetrahedra, hinged at two edges: either end swings by itself."""
    p = np.array(
        [[0, 1, 0], [0, -1, 0.1], [-2, 0, 1], [-2, 0.3, -1.2], [3, 1, 1.1], [3.2, -1, 0.8]]
    )
    p = np.vstack([p, [[5, 0.1, 2], [5.3, 0, -0.5]]])
    bodies = [(0, 1, 2, 3), (0, 1, 4, 5), (4, 5, 6, 7)]
    edges = sorted({pair for body in bodies for pair in combinations(body, 2)})
    result = analyse(p, edges)
    assert result.rigidity_class is FLEXIBLE
    assert [flex.agents for flex in result.flexes] == [(2, 3), (6, 7)]


def test_loose_agent_on_a_flat_shape():
    """Where J is singular because of a rigid part, a loose agent is found by following its motion."""
    p = np.vstack([shapes.slots("square", 4.0, 4), [[6, 0.5, 0]]])
    result = analyse(p, [*graphs.complete_graph(4).tolist(), [1, 4], [2, 4]])
    assert result.rigidity_class is FLEXIBLE
    assert result.deformed is not None
    assert result.within is not None
    assert result.within.rigidity_class is RIGID


def test_sheet_folds_along_its_lines():
    """A grid of crossed squares keeps its plane to second order in no way: it folds along any grid line."""
    p = shapes.slots("grid", 1.0, 16)
    edges = graphs.complete_graph(16)
    result = analyse(p, edges[distance_geometry.distances(p, edges) < 1.5])
    assert result.rigidity_class is FLEXIBLE
    braced = analyse(p, edges[distance_geometry.distances(p, edges) < 2.3])
    assert braced.rigidity_class is STABLE


def test_barely_rigid_says_so():
    """Three agents a hair off a line are rigid in name; the reason warns."""
    result = analyse([[-4, 0, 0], [0, 1e-3, 0], [4, 0, 0]], graphs.complete_graph(3))
    assert result.rigidity_class is RIGID
    assert "large forces" in result.reason


def test_flexes_of_more_agents_hold_none_of_fewer():
    """A square of four sides: agent 1 leaves the plane, and apart from that 1, 2 and 4 shear within it."""
    result = analyse(shapes.slots("square", 4.0, 4), [[0, 1], [1, 2], [2, 3], [0, 3]])
    fold, shear = result.flexes
    assert (fold.agents, shear.agents) == ((0,), (0, 1, 3))
    np.testing.assert_allclose(np.abs(fold.motion[0]), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(shear.motion[:, 2], 0, atol=1e-9)


@pytest.mark.parametrize("kind", ["complete", "near", "few", "line", "plane"])
def test_hundred_agents_of_any_graph(kind):
    """Of 100 agents, rank and flexes add up to what the shape can reach, whatever the graph."""
    p, edges = shape(1, 100, {"line": 1, "plane": 2}.get(kind, 3)), graphs.complete_graph(100)
    if kind != "complete":
        reach = np.quantile(
            distance_geometry.distances(p, edges), {"near": 0.1, "few": 0.03}.get(kind, 0.15)
        )
        edges = edges[distance_geometry.distances(p, edges) <= reach]
    result = analyse(p, edges)
    assert result.agents == 100
    assert result.rank + len(result.flexes) == 300 - (5 if kind == "line" else 6)  # rigid motions


@pytest.mark.parametrize(
    ("slots", "edges", "message"),
    [
        (SPREAD, [[0, 5]], "edge 1, agents 1 and 6, names an agent"),
        (SPREAD, [[0, 1], [1, 0]], "repeats edge 1"),
        (SPREAD, [[2, 2]], "joins an agent to itself"),
        (np.zeros((2, 3)), [[0, 1]], "slots coincide"),
        ([[0, 0, np.nan]], [], "slot 1 is not finite"),
        (np.zeros((0, 3)), [], "N >= 1"),
    ],
)
def test_what_is_no_framework_is_refused(slots, edges, message):
    """Edges and slots that make no framework are named, counted from 1."""
    with pytest.raises(ValueError, match=message):
        analyse(slots, edges)


def test_space_must_hold_the_shape():
    """A spatial shape has no rigidity in a plane."""
    with pytest.raises(ValueError, match="dimension 3 does not fit into a plane"):
        analyse(SPREAD, graphs.complete_graph(5), space=2)


def test_data_counts_from_one():
    """Plain data for JSON name agents and edges as messages do."""
    data = analyse(shapes.slots("square", 4.0, 4), graphs.complete_graph(4)).data()
    assert data["redundant"][0] == [1, 2]
    assert data["flexes"][0]["agents"] == [1]
    assert data["rigidity_class"] == "prestress-stable"
    assert data["within"]["rigidity_class"] == "infinitesimally rigid"


# -- PyRigi's named frameworks

# name, arguments, rigidity_class; from PyRigi's documentation and the papers it cites
PYRIGI = [
    ("Square", (), FLEXIBLE),
    ("Diamond", (), RIGID),
    ("Cube", (), FLEXIBLE),
    ("Octahedron", (), RIGID),
    ("Octahedron", ("Bricard_line",), FLEXIBLE),
    ("Octahedron", ("Bricard_plane",), FLEXIBLE),
    ("Icosahedron", (), RIGID),
    ("Dodecahedron", (), FLEXIBLE),
    ("K33plusEdge", (), RIGID),
    ("Complete", (5,), RIGID),
    ("Complete", (4, 1), RIGID),
    ("Complete", (4, 3), RIGID),
    ("Path", (5,), FLEXIBLE),
    ("Cycle", (5,), FLEXIBLE),
    ("ThreePrism", (), RIGID),
    ("ThreePrism", ("parallel",), STABLE),
    ("ThreePrism", ("flexible",), FLEXIBLE),
    ("ThreePrismPlusEdge", (), RIGID),
    ("CompleteBipartite", (3, 3), RIGID),
    ("CompleteBipartite", (4, 4, "dixonI"), FLEXIBLE),
    ("Frustum", (3,), STABLE),
    ("Frustum", (5,), STABLE),
    ("CnSymmetricFourRegular", (8,), STABLE),
    ("CnSymmetricWithFixedVertex", (8,), STABLE),
    ("Wheel", (6,), RIGID),
    ("SecondOrderRigid", (), UNDECIDED),
]


@pytest.fixture(scope="module")
def pyrigi():
    """PyRigi's database of frameworks; its import takes seconds."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from pyrigi import frameworkDB

        yield frameworkDB


@pytest.mark.parametrize(("name", "arguments", "rigidity_class"), PYRIGI)
def test_named_frameworks_of_pyrigi(pyrigi, name, arguments, rigidity_class):
    """Flexes, stresses, infinitesimal rigidity and prestress stability agree with PyRigi's."""
    framework = getattr(pyrigi, name)(*arguments)
    agents, place = framework.graph.vertex_list(), framework.realization(numerical=True)
    slots = np.array([np.ravel(place[v]) for v in agents], dtype=float)
    edges = [[agents.index(i), agents.index(j)] for i, j in framework.graph.edges]
    result = analyse(slots, edges, space=framework.dim)
    assert result.rigidity_class is rigidity_class
    assert len(result.flexes) == len(framework.inf_flexes(numerical=True))
    assert len(edges) - result.rank == len(framework.stresses(numerical=True))
    assert (result.rigidity_class is RIGID) == framework.is_inf_rigid(numerical=True)
    if rigidity_class is not UNDECIDED and result.flexes:
        assert (rigidity_class is STABLE) == framework.is_prestress_stable(numerical=True)


# -- other shapes with the same distances


def test_former_names_of_realisations_work_and_warn():
    """`found` of a search, and of one of its shapes, still gives what it gave, with a warning."""
    search = realisations(shapes.slots("triangle", 4.0, 3), graphs.complete_graph(3), starts=4)
    former = "found"
    for thing, was in (search, search.shapes), (search.shapes[0], search.shapes[0].starts):
        with pytest.warns(DeprecationWarning, match="found is now"):
            assert getattr(thing, former) == was
    assert search.data()["found"][0]["found"] == search.shapes[0].starts


def test_cube_of_paper_has_folded_twins():
    """The 18 distances of the cube have solutions with coincident agents, found far more often than the cube."""
    p = shapes.slots("cube", 4.0, 8)
    found = realisations(p, graphs.CUBE_EDGES)
    assert found.shapes[0].kind is Kind.SAME
    assert not found.unique
    folded = [r for r in found.shapes if r.kind is Kind.COINCIDENT]
    assert sum(r.starts for r in folded) > found.converged / 2
    for r in found.shapes:
        got = distance_geometry.distances(r.slots, graphs.CUBE_EDGES)
        np.testing.assert_allclose(
            got, distance_geometry.distances(p, graphs.CUBE_EDGES), atol=1e-6
        )


@pytest.mark.parametrize("n", [5, 8])
def test_all_distances_leave_only_the_mirror_image(n):
    """With all pairs prescribed there is nothing but the shape and its mirror image."""
    p = shape(n, n, 3)
    found = realisations(p, graphs.complete_graph(n), starts=60)
    assert {r.kind for r in found.shapes} == {Kind.SAME, Kind.MIRRORED}
    assert found.unique


def test_flat_shapes_are_their_own_mirror_images():
    """A hexagon turned over is the hexagon."""
    found = realisations(shapes.slots("hexagon", 4.0, 6), graphs.complete_graph(6), starts=40)
    assert [r.kind for r in found.shapes] == [Kind.SAME]


def test_bipyramid_folds_over():
    """Two tetrahedra on one triangle: the tips on either side, or on the same side and coincident."""
    p = np.array([[1, 0, 0], [-0.5, 0.9, 0], [-0.5, -0.9, 0], [0, 0, 1.5], [0, 0, -1.5]])
    edges = [e for e in graphs.complete_graph(5).tolist() if e != [3, 4]]
    found = realisations(p, edges, starts=60)
    assert {r.kind for r in found.shapes} == {Kind.SAME, Kind.MIRRORED, Kind.COINCIDENT}
    assert all(r.rigid for r in found.shapes)


def test_start_decides_the_side():
    """From near the shape one gets there; from near its mirror image, to that."""
    p = shape(2, 4, 3)
    edges = graphs.complete_graph(4)
    for side, kind in ((1, Kind.SAME), (-1, Kind.MIRRORED)):
        start = p * [1, 1, side] + 0.05 * shape(3, 4, 3)
        found = realisations(p, edges, starts=20, start=start)
        assert found.leads_to is not None
        assert found.shapes[found.leads_to].kind is kind


def test_search_is_repeatable():
    """The same seed finds the same shapes as often."""
    p = shapes.slots("cube", 4.0, 8)
    one, two = (realisations(p, graphs.CUBE_EDGES, starts=50, seed=4).data() for _ in range(2))
    assert one == two


@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_agents_have_one_shape(n):
    """Up to three agents, all distances leave one shape."""
    found = realisations(SPREAD[:n], graphs.complete_graph(n), starts=10)
    assert [r.kind for r in found.shapes] == [Kind.SAME]


#: Two triangles joined by three edges.
PRISM = [[0, 1], [0, 2], [1, 2], [3, 4], [3, 5], [4, 5], [0, 3], [1, 4], [2, 5]]


def assembly_modes(p):
    """All shapes (., 6, 2) of a three-prism up to reflection: the assembly modes of a planar platform on three legs.

    The upper triangle is turned by an angle; two differences of the legs' equations are linear in its place, and the
    third equation is left, a sextic for either hand of the triangle (Gosselin and Merlet, 1994).
    """
    legs = np.linalg.norm(p[:3] - p[3:], axis=1)
    found = []
    for hand in (1, -1):
        q = (p[3:] - p[3]) * [1, hand]

        def placed(angle, q=q):
            c, s = np.cos(angle), np.sin(angle)
            turned = q @ np.array([[c, s], [-s, c]])
            w = turned - p[:3] + p[0]
            A = 2 * w[1:]
            b = legs[1:] ** 2 - legs[0] ** 2 - (w[1:] ** 2).sum(axis=1)
            det = np.linalg.det(A)
            x = np.array([A[1, 1] * b[0] - A[0, 1] * b[1], A[0, 0] * b[1] - A[1, 0] * b[0]])
            return x @ x - (legs[0] * det) ** 2, x / det + p[0] + turned

        angles = 0.1 + np.linspace(0, 2 * np.pi, 9001)  # off the root at 0, which is p
        values = np.array([placed(angle)[0] for angle in angles])
        for k in np.flatnonzero(values[:-1] * values[1:] < 0):
            root = brentq(lambda angle: placed(angle)[0], angles[k], angles[k + 1], xtol=1e-14)
            found.append(np.vstack([p[:3], placed(root)[1]]))
    return np.array(found)


@pytest.mark.parametrize(
    ("p", "count"),
    [
        # Twelve is the greatest number that these edges have in the plane (Borcea and Streinu, 2004).
        ([[1.7, 0.6], [1.3, -2.5], [0.8, 2.9], [-0.5, -2.3], [2.7, 1.1], [-1.8, 1.0]], 12),
        ([[2.0, -0.8], [1.2, 2.2], [0.8, 0.3], [1.6, 1.3], [-0.2, 0.4], [1.5, -2.6]], 10),
        ([[0.8, -1.4], [-2.8, -2.9], [1.9, 2.5], [0.6, 1.4], [0.3, 2.6], [1.9, -3.0]], 8),
    ],
)
def test_three_prism_has_up_to_twelve_shapes_in_its_plane(p, count):
    """Searched in its plane, a flat three-prism has the shapes that its sextics have, up to reflection."""
    tilt = Rotation.from_euler("xyz", [0.3, -0.5, 0.8]).as_matrix()
    slots = np.pad(p, [(0, 0), (0, 1)]) @ tilt.T
    found = realisations(slots, PRISM, starts=400, dimension=2)
    kinds = [r.kind for r in found.shapes]
    assert kinds[:2] == [Kind.SAME, Kind.MIRRORED]
    shapes_found = [
        r.slots for r, kind in zip(found.shapes, kinds, strict=True) if kind is not Kind.MIRRORED
    ]
    wanted = assembly_modes(np.array(p))
    assert len(shapes_found) == len(wanted) == count
    pairs = graphs.complete_graph(6)
    got = np.array([distance_geometry.distances(q, pairs) for q in shapes_found])
    for q in wanted:
        apart = np.abs(got - distance_geometry.distances(np.pad(q, [(0, 0), (0, 1)]), pairs))
        assert apart.max(axis=1).min() < 1e-5
    assert all(r.rigid and not r.bends for r in found.shapes)


def test_in_a_plane_no_shape_is_turned_over():
    """A flat shape by all distances is one shape in space, and itself and its mirror image in its plane."""
    p = shape(4, 5, 2)
    edges = graphs.complete_graph(5)
    assert [r.kind for r in realisations(p, edges, starts=40).shapes] == [Kind.SAME]
    found = realisations(p, edges, starts=40, dimension=2)
    assert [r.kind for r in found.shapes] == [Kind.SAME, Kind.MIRRORED]
    for side in (1, -1):
        start = p * [1, side, 1] + 0.05 * shape(3, 5, 2)
        led = realisations(p, edges, starts=20, dimension=2, start=start)
        assert led.leads_to is not None
        assert (
            led.shapes[led.leads_to].kind is Kind.SAME
        )  # from either side: agents in space are turned over


@given(SEEDS, st.integers(3, 8), st.floats(0.4, 1))
@settings(max_examples=15)
def test_dimension_two_is_the_rigidity_within_the_plane(seed, n, share):
    """Analysed in its plane, a flat shape has the rank, class and flexes that it has within it in space."""
    p, edges = shape(seed, n, 2), graph(seed, n, share)
    flat, within = analyse(p, edges, dimension=2), analyse(p, edges).within
    assert within is not None
    assert (flat.space, flat.rank, flat.needed) == (2, within.rank, 2 * n - 3)
    assert flat.rigidity_class is within.rigidity_class
    assert len(flat.flexes) == 2 * n - 3 - np.linalg.matrix_rank(jacobian(p, edges), tol=1e-6)


def test_spatial_shapes_have_no_plane():
    """Shapes in space are refused where they are searched in a plane."""
    with pytest.raises(ValueError, match="dimension 3 does not fit into a plane"):
        realisations(SPREAD, graphs.complete_graph(5), dimension=2)


@pytest.mark.parametrize("dimension", [0, 4, 2.0, None, "2"])
@pytest.mark.parametrize("search", [analyse, realisations])
def test_a_dimension_is_that_of_a_space(search, dimension):
    """A dimension that no space has is refused by its value."""
    with pytest.raises(ValueError, match="dimension must be 1, 2 or 3"):
        search(SPREAD[:, :2], graphs.complete_graph(5), dimension=dimension)


def chair(bond=4.0, angle=110.0):
    """A ring of six with equal sides and angles, up and down in turn, as cyclohexane's, with sides and next sides."""
    across = 2 * bond * np.sin(np.deg2rad(angle) / 2)  # of next neighbours
    radius = across / np.sqrt(3)
    height = np.sqrt(bond**2 - radius**2)
    k = np.arange(6)
    p = np.column_stack(
        [radius * np.cos(k * np.pi / 3), radius * np.sin(k * np.pi / 3), height / 2 * (-1.0) ** k]
    )
    return p, np.array([[i, (i + step) % 6] for i in range(6) for step in (1, 2)])


@pytest.mark.parametrize(
    ("bond", "angle", "starts"), [(5.0, 109.47, 40), (3.0, 112.0, 60), (4.0, 105.0, 40)]
)
def test_chair_is_rigid_and_its_boats_are_one_family(bond, angle, starts):
    """Rings of six like cyclohexane's have a rigid chair, with its mirror image, and one family of boats that bends.

    Known since Sachse (1890): the octahedron of the ring's twelve distances is flexible as Bricard's in the boat.
    """
    p, edges = chair(bond, angle)
    found = realisations(p, np.sort(edges, axis=1), starts=starts, seed=1)
    family = found.shapes[-1]
    assert {r.kind for r in found.shapes[:-1]} <= {Kind.SAME, Kind.MIRRORED}
    assert not any(r.bends for r in found.shapes[:-1])
    assert (family.kind, family.rigid, family.bends) == (Kind.FOLDED, False, True)
    assert family.starts > 0.5 * starts
    assert not found.unique


@pytest.mark.parametrize("seed", range(6))
def test_linkages_of_four_have_the_families_of_grashof(seed):
    """In the plane, four bars in a ring have two families if s + l < p + q, and else one (Grashof, 1883)."""
    p = np.random.default_rng(seed).uniform(-2, 2, (4, 2))
    ring = [[0, 1], [1, 2], [2, 3], [0, 3]]
    s, a, b, length = np.sort(np.linalg.norm(p - np.roll(p, -1, axis=0), axis=1))
    found = realisations(p, ring, starts=16, dimension=2)
    assert len(found.shapes) == (2 if s + length < a + b else 1)
    assert all(r.bends for r in found.shapes)
    assert len(realisations(p, ring, starts=16).shapes) == 1  # in space, it folds over


def test_start_must_fit():
    """A start of the wrong size is refused."""
    with pytest.raises(ValueError, match=r"start must be \(5, 3\)"):
        realisations(SPREAD, graphs.complete_graph(5), start=np.zeros((4, 3)))
