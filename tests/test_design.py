import tomllib
from contextlib import ExitStack
from itertools import combinations, pairwise, permutations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from threadpoolctl import threadpool_info, threadpool_limits

from rigidfleet._common.threads import single_blas_thread
from rigidfleet.formation import assignment, distance_geometry, graphs, shapes
from rigidfleet.rigidity import RigidityClass, analyse, full_rank, jacobian
from rigidfleet.rigidity import design as design_module
from rigidfleet.rigidity.design import design, free_motions_text, mission_fragment
from rigidfleet.sweep import Sweep, workers

CUBE = shapes.slots("cube", 4.0, 8)
BEST_CUBE = (3 - np.sqrt(5)) / 2  # 0.38197


def index(p, edges):
    """Smallest non-zero eigenvalue w of J J^T."""
    return analyse(p, edges).w


def test_designed_cube_beats_the_paper():
    """18 edges with w = 0.3820 hold a cube better than the paper's, w = 0.2586."""
    edges = design(CUBE)
    result = analyse(CUBE, edges)
    assert len(edges) == 18
    assert result.rigidity_class is RigidityClass.INFINITESIMALLY_RIGID
    assert result.w == pytest.approx(BEST_CUBE)
    assert index(CUBE, graphs.CUBE_EDGES) == pytest.approx(0.2586, abs=5e-5)


def threads_of_blas():
    """Of each library that is loaded; some have one for ever."""
    return {x["filepath"]: x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas"}


def test_long_work_takes_one_thread_of_blas(monkeypatch):
    """A design, exchanges of slots and a chunk of a sweep; afterwards there are as many as before."""
    seen = []

    def spy(module, name):
        function = getattr(module, name)

        def noting(*arguments):
            seen.append(set(threads_of_blas().values()))
            return function(*arguments)

        monkeypatch.setattr(module, name, noting)

    points = np.random.default_rng(1).normal(size=(1100, 3))
    sweep = Sweep.of("narrow-passage", vary=["agents.mass.* *= normal(1, 0.05)"], runs=1)
    with threadpool_limits(2, user_api="blas"):
        before = threads_of_blas()
        spy(design_module, "_best_swap")
        design(CUBE)
        spy(assignment, "order_by_exchanges")
        assignment.least_squares_assignment(points, points[::-1])
        spy(workers, "fly_runs")
        workers.fly_chunk(sweep.json(), sweep.version, [0])
        assert before.items() <= threads_of_blas().items()
    assert 2 in before.values()
    assert len(seen) > 2
    assert all(each == {1} for each in seen)


def test_threads_of_blas_come_back_when_the_last_one_leaves():
    """Of two that overlap, the first to leave changes nothing for the other."""
    with threadpool_limits(2, user_api="blas"):
        before, seen = threads_of_blas(), []
        with ExitStack() as one, ExitStack() as other:
            for stack in (one, other):
                stack.enter_context(single_blas_thread())
            for stack in (one, other):
                seen.append(set(threads_of_blas().values()))
                stack.close()
        assert threads_of_blas() == before
    assert seen == [{1}, {1}]


@pytest.mark.long
def test_designed_cube_is_the_best_of_all():
    """Of all 13 123 110 graphs of 18 edges, looked at one by one up to symmetry, none has a greater w."""
    edges = graphs.complete_graph(8)
    number = {pair: k for k, pair in enumerate(map(tuple, edges.tolist()))}
    ones = np.array([k.bit_count() for k in range(1 << 14)])
    halves = [np.flatnonzero(ones == k).astype(np.uint32) for k in range(15)]
    chosen = np.concatenate(
        [((halves[k][:, None] << 14) | halves[18 - k]).ravel() for k in range(4, 15)]
    )
    assert len(chosen) == 13_123_110
    least, bits = chosen.copy(), np.arange(1 << 14)[:, None] >> np.arange(14) & 1
    for axes, signs in product(permutations(range(3)), product([1, -1], repeat=3)):
        to = [int(((CUBE - q) ** 2).sum(axis=1).argmin()) for q in CUBE[:, axes] * signs]
        image = [1 << number[min(to[i], to[j]), max(to[i], to[j])] for i, j in edges.tolist()]
        low = (bits @ np.array(image[:14])).astype(np.uint32)
        high = (bits @ np.array(image[14:])).astype(np.uint32)
        np.minimum(least, low[chosen & 0x3FFF] | high[chosen >> 14], out=least)
    J, best = jacobian(CUBE, edges), 0.0
    distinct = np.unique(least)
    for some in np.array_split(distinct, 20):
        rows = J[np.nonzero((some[:, None] >> np.arange(28)) & 1)[1].reshape(-1, 18)]
        best = max(best, np.linalg.eigvalsh(rows @ rows.transpose(0, 2, 1))[:, 0].max())
    assert best == pytest.approx(BEST_CUBE)


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_small_designs_are_the_best_of_all(dimension):
    """For five agents the search finds the best of all graphs, in space, in a plane and on a line."""
    p = np.zeros((5, 3))
    p[:, :dimension] = np.random.default_rng(dimension).normal(size=(5, dimension))
    m = full_rank(5, dimension)
    J = jacobian(p[:, :dimension], graphs.complete_graph(5))
    every = np.array(list(combinations(range(10), m)))
    w = np.linalg.svd(J[every], compute_uv=False)[:, -1].max() ** 2
    assert index(p, design(p)) == pytest.approx(w)


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 3), st.integers(0, 3))
@settings(max_examples=20)
def test_designs_hold_the_shape(seed, n, dimension, extra):
    """As many edges as asked for, in lexical order, of the rank that the shape can reach."""
    p = np.zeros((n, 3))
    p[:, :dimension] = np.random.default_rng(seed).normal(size=(n, dimension))
    edges = design(p, extra=extra)
    result = analyse(p, edges)
    assert len(edges) == min(result.reachable + extra, n * (n - 1) // 2)
    assert result.rank == result.reachable
    assert edges.tolist() == sorted(edges.tolist())
    assert (edges[:, 0] < edges[:, 1]).all()


def test_more_edges_are_no_worse():
    """Each redundant edge keeps or raises the index of the cube; all 28 have w = 1."""
    w = [index(CUBE, design(CUBE, extra=k)) for k in (0, 1, 2, 4, 7)]
    assert all(b >= a - 1e-9 for a, b in pairwise(w))
    assert design(CUBE, extra="complete").tolist() == graphs.complete_graph(8).tolist()


def test_edges_stay_within_sensing_range():
    """No edge is longer than vehicles can sense: face diagonals, but no space diagonals."""
    edges = design(CUBE, sensing_range=5.7)
    assert distance_geometry.distances(CUBE, edges).max() < 5.7
    assert analyse(CUBE, edges).rigidity_class is RigidityClass.INFINITESIMALLY_RIGID


def test_short_range_says_what_would_do():
    """Along its sides alone a cube does not hold; the message gives the range that does."""
    with pytest.raises(ValueError, match=r"only 12 of the 18 .*; 5.65685 m is enough"):
        design(CUBE, sensing_range=4.5)
    assert len(design(CUBE, sensing_range=5.65685425)) == 18


@pytest.mark.parametrize(
    "n", [16, pytest.param(30, marks=pytest.mark.long), pytest.param(100, marks=pytest.mark.long)]
)
def test_designed_spheres_are_no_worse_than_their_hulls(n):
    """A triangulated sphere is rigid; the designed graph, with as many edges, has at least its index."""
    p = shapes.slots("sphere", 4.0, n)
    triangles = ConvexHull(p).simplices.tolist()
    hull = sorted({pair for t in triangles for pair in combinations(sorted(t), 2)})
    edges = design(p)
    assert len(edges) == len(hull) == 3 * n - 6
    assert index(p, edges) >= index(p, hull) - 1e-9
    assert index(p, design(p, extra=2)) >= index(p, edges) - 1e-9


def test_same_seed_same_graph():
    """A design is repeatable."""
    p = np.random.default_rng(8).normal(size=(9, 3))
    np.testing.assert_array_equal(design(p, seed=1), design(p, seed=1))


@pytest.mark.parametrize(
    ("name", "n", "words"),
    [
        ("line", 5, "so 6 motions"),
        ("hexagon", 6, "so 3 motions"),
        ("square", 4, "1 motion "),
    ],
)
def test_limits_of_flat_shapes(name, n, words):
    """What distances do not hold is what the analysis finds free, for every graph."""
    p = shapes.slots(name, 4.0, n)
    assert words in free_motions_text(p)
    assert f"so {len(analyse(p, graphs.complete_graph(n)).flexes)} motion" in free_motions_text(p)


@pytest.mark.parametrize("p", [CUBE, CUBE[:3], CUBE[:2], CUBE[:1]])
def test_no_limits_where_distances_suffice(p):
    """A spatial shape, a triangle, a pair and one agent have no motion that distances cannot hold."""
    assert free_motions_text(p) == ""


def test_bad_requests_are_refused():
    """Coincident slots, a negative surplus and points that are not finite are named."""
    with pytest.raises(ValueError, match="slots 2 and 4 coincide"):
        design([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]])
    with pytest.raises(ValueError, match="extra must be >= 0"):
        design(CUBE, extra=-1)
    with pytest.raises(ValueError, match="finite"):
        design([[0, 0, np.inf]])


@pytest.mark.parametrize("name", ["cube", "my shape", '1.5 "m"'])
def test_fragment_is_toml_of_a_formation(name):
    """The fragment reads back as the formation it was made of, whatever its name."""
    p = shapes.slots("icosahedron", 3.0, 12)
    edges = design(p)
    table = tomllib.loads(mission_fragment(name, p, edges))["formations"][name]
    assert table["slots"] == p.tolist()
    assert table["edges"] == (edges + 1).tolist()
