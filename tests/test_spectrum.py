"""The ends of the spectrum of large formations."""

import numpy as np
import pytest

from rigidfleet.formation import graphs, shapes
from rigidfleet.rigidity import analyse, jacobian, spectrum


@pytest.mark.parametrize("edges", [graphs.neighbour_edges, graphs.henneberg])
def test_spectrum_is_that_of_the_dense_analysis(edges):
    """Lanczos finds the smallest and the largest eigenvalue of mbar A, of unequal masses."""
    rng = np.random.default_rng(4)
    p, masses = rng.normal(size=(40, 3)), rng.uniform(0.5, 2.0, 40)
    graph = (
        graphs.complete_graph(40)[::2] if edges is graphs.neighbour_edges else graphs.henneberg(p)
    )
    found, dense = spectrum(p, graph, masses), analyse(p, graph, masses=masses)
    assert found.free == 0
    assert found.w == pytest.approx(dense.w, rel=1e-6)
    J = np.zeros((len(graph), 40, 3))
    u = p[graph[:, 0]] - p[graph[:, 1]]
    u /= np.linalg.norm(u, axis=1)[:, None]
    rows = np.arange(len(graph))
    J[rows, graph[:, 0]], J[rows, graph[:, 1]] = u, -u
    J = (J * np.sqrt(masses.mean() / masses)[:, None]).reshape(len(graph), -1)
    assert found.w_max == pytest.approx(np.linalg.norm(J, 2) ** 2, rel=1e-6)
    assert found.condition == pytest.approx(found.w_max / found.w)


@pytest.mark.parametrize(("n", "space"), [(2, 3), (2, 2), (3, 2), (3, 3)])
def test_spectrum_of_few_agents(n, space):
    """Two and three agents, too, have both ends: without their rigid motions, few eigenvalues are left."""
    p = np.random.default_rng(n).normal(size=(n, space))
    edges = graphs.complete_graph(n)
    found = spectrum(p, edges, np.ones(n))
    values = np.linalg.svd(jacobian(p, edges), compute_uv=False) ** 2
    assert (found.w, found.w_max) == pytest.approx((values.min(), values.max()), rel=1e-6)
    assert found.free == 0


def test_flexible_formations_are_found():
    """A cubic lattice with edges along its axes alone shears in three ways, and in more at its sides."""
    side = np.arange(5.0)
    p = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    loose = spectrum(p, graphs.neighbour_edges(p, 1.1), np.ones(125))
    assert loose.w == 0
    assert loose.free > 0
    assert loose.condition == np.inf
    assert spectrum(p, graphs.neighbour_edges(p, 1.5), np.ones(125)).free == 0


def test_a_crowd_of_free_motions_is_told_in_time():
    """Where so many motions are next to free that Lanczos cannot part them, the formation is flexible."""
    p = shapes.slots("sphere", 2.0, 600)
    chain = np.column_stack([np.arange(599), np.arange(1, 600)])
    found = spectrum(p, chain, np.ones(600))
    assert found.w == 0
    assert found.free > 0


@pytest.mark.parametrize("graph", [graphs.neighbour_edges, graphs.henneberg_multilevel])
def test_no_eigenvalue_of_a_shell_is_missed(graph):
    """Next to the six of rigid motions, which are equal, the lowest is found: that of the dense matrix."""
    p = shapes.slots("sphere", 2.0, 300)
    J = jacobian(p, graph(p))
    found = spectrum(p, graph(p), np.ones(300))
    assert found.w == pytest.approx(np.linalg.eigvalsh(J.T @ J)[6], rel=1e-6)
    assert found.free == 0
