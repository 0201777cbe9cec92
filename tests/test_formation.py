import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from rigidfleet.errors import MissionError
from rigidfleet.formation import distance_geometry, graphs, point_files, shapes
from rigidfleet.math import rigid_body
from rigidfleet.planning.solvers import henneberg_steps
from rigidfleet.rigidity import jacobian, spectrum

NAMED = [
    ("line", 4.0, 3),
    ("line", 4.0, 2),
    ("triangle", 4.0, 3),
    ("square", 4.0, 4),
    ("polygon", 4.0, 7),
    ("hexagon", 4.0, 6),
    ("pyramid", 4.0, 4),
    ("pyramid", 4.0, 5),
    ("pyramid", 4.0, 6),
    ("cube", 4.0, 8),
    ("cuboid", [8.0, 2.0, 4.0], 8),
    ("v", 4.0, 7),
    ("grid", 4.0, 7),
    ("sphere", 4.0, 20),
    ("shells", 4.0, 44),
    ("helix", [4.0, 3.0, 2.0], 9),
    ("tetrahedron", 4.0, 4),
    ("octahedron", 4.0, 6),
    ("icosahedron", 4.0, 12),
    ("dodecahedron", 4.0, 20),
]
SEEDS = st.integers(0, 2**32 - 1)


def points(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape)


def rotation(seed):
    return Rotation.random(random_state=np.random.RandomState(seed)).as_matrix()


# -- shapes


@pytest.mark.parametrize(("shape", "size", "n"), NAMED)
def test_shape_is_centred(shape, size, n):
    """Every named shape has a slot for each agent, about its geometric centre."""
    p = shapes.slots(shape, size, n)
    assert p.shape == (n, 3)
    np.testing.assert_allclose(p.mean(axis=0), 0, atol=1e-15)


@pytest.mark.parametrize(("shape", "size", "n"), NAMED)
def test_size_is_edge_length(shape, size, n):
    """The shortest distance in a shape is its size, the smallest of them for a cuboid."""
    assert pdist(shapes.slots(shape, size, n)).min() == pytest.approx(np.min(size))


@pytest.mark.parametrize(
    ("shape", "n", "edges"),
    [
        ("tetrahedron", 4, 6),
        ("octahedron", 6, 12),
        ("icosahedron", 12, 30),
        ("dodecahedron", 20, 30),
    ],
)
def test_regular_solids(shape, n, edges):
    """Vertices on one sphere, as many shortest distances as the solid has edges, counted from below."""
    p = shapes.slots(shape, 4.0, n)
    d = pdist(p)
    assert np.count_nonzero(d < d.min() + 1e-9) == edges
    np.testing.assert_allclose(np.linalg.norm(p, axis=1), np.linalg.norm(p[0]))
    assert (np.diff(p[:, 2]) >= -1e-12).all()


def test_v_flies_point_first():
    """Agent 1 leads on x; the wings trail at 45 degrees, left (+y) first."""
    p = shapes.slots("v", np.sqrt(2), 5)
    np.testing.assert_allclose(
        p - p[0], [[0, 0, 0], [-1, 1, 0], [-1, -1, 0], [-2, 2, 0], [-2, -2, 0]]
    )


def test_grid_fills_rows():
    """Seven agents stand in rows of three along x; the last row has one."""
    p = shapes.slots("grid", 2.0, 7)
    assert (p - p[0])[[1, 3, 6]].tolist() == [[2, 0, 0], [0, 2, 0], [0, 4, 0]]


def test_helix_has_its_sizes():
    """Radius, rise per turn and the distance of neighbours are those asked for."""
    p = shapes.slots("helix", [4.0, 3.0, 2.0], 9)
    axis = p[:, :2] - (p[:, :2] - 0)[0] + [4, 0]
    np.testing.assert_allclose(np.linalg.norm(axis, axis=1), 4)
    np.testing.assert_allclose(np.linalg.norm(np.diff(p, axis=0), axis=1), 2)
    turn = np.unwrap(np.arctan2(axis[:, 1], axis[:, 0]))
    np.testing.assert_allclose(p[:, 2] - p[0, 2], 3 * turn / (2 * np.pi))
    with pytest.raises(ValueError, match=r"at most 8\.139 m"):
        shapes.slots("helix", [4.0, 3.0, 9.0], 3)


def test_line_is_4_8_4():
    """Three agents on a line are -4, 0 and 4 m along x: the 4-8-4 of Table 1."""
    assert shapes.slots("line", 4.0, 3).tolist() == [[-4, 0, 0], [0, 0, 0], [4, 0, 0]]


def test_triangle_lies_as_paper_attaches_it():
    """x points to agent 3, y runs along r1 - r2."""
    a, h = 4.0, 2 * np.sqrt(3)
    want = [[-h / 3, a / 2, 0], [-h / 3, -a / 2, 0], [2 * h / 3, 0, 0]]
    np.testing.assert_allclose(shapes.slots("triangle", a, 3), want, atol=1e-15)


def test_cube_counts_counter_clockwise_from_below():
    """Agents 1-4 are counter-clockwise from (-, -, -) at the bottom, 5-8 above them."""
    p = shapes.slots("cube", 2.0, 8)
    assert p[:4].tolist() == [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]]
    np.testing.assert_array_equal(p[4:] - p[:4], np.tile([0, 0, 2], (4, 1)))


def test_paper_edges_of_cube_are_sides_and_face_diagonals():
    """The 18 edges of Table 4 are 12 sides and one diagonal of each face, as a rigid cube needs."""
    d = np.sort(distance_geometry.distances(shapes.slots("cube", 4.0, 8), graphs.CUBE_EDGES))
    np.testing.assert_allclose(d, [4.0] * 12 + [4 * np.sqrt(2)] * 6)
    assert len({tuple(e) for e in graphs.CUBE_EDGES.tolist()}) == 18


@pytest.mark.parametrize(("n", "height"), [(4, np.sqrt(2 / 3)), (5, np.sqrt(1 / 2))])
def test_pyramid_has_equal_edges(n, height):
    """A pyramid's apex is one size from each agent of its base."""
    p = shapes.slots("pyramid", 1.0, n)
    np.testing.assert_allclose(np.linalg.norm(p[:-1] - p[-1], axis=1), 1)
    assert p[-1, 2] - p[0, 2] == pytest.approx(height)


@pytest.mark.parametrize(
    ("shape", "size", "n", "message"),
    [
        ("tringle", 4.0, 3, "unknown shape"),
        ("triangle", 4.0, 4, "takes 3 agents, not 4"),
        ("pyramid", 4.0, 7, "takes 4 to 6 agents, not 7"),
        ("polygon", 4.0, 2, "takes 3 or more agents, not 2"),
        ("cuboid", 4.0, 8, "3 sizes"),
        ("cube", [4.0, 4.0, 4.0], 8, "one size"),
        ("line", 0.0, 3, "> 0 m"),
        ("line", np.nan, 3, "> 0 m"),
    ],
)
def test_impossible_shapes_are_refused(shape, size, n, message):
    """A shape that does not exist, or not for so many agents, says so."""
    with pytest.raises(ValueError, match=message):
        shapes.slots(shape, size, n)


# -- points from files


@pytest.mark.parametrize(
    "text",
    [
        "0,0,0\n4,0,0\n0,4,0\n",
        "x,y,z\n0,0,0\n4,0,0\n0,4,0",
        "# slots [m]\n\nx;y\n0;0\n4;0  # agent 2\n0;4\n",
        "\ufeff0 0 0\r\n4\t0 0\r\n 0  4e0 -0 \r\n",
    ],
)
def test_points_are_read(tmp_path, text):
    """Commas, semicolons or blanks; names, comments, two columns, a byte-order mark: all the same points."""
    path = tmp_path / "points.csv"
    path.write_bytes(text.encode())
    np.testing.assert_array_equal(
        point_files.read_points(path).slots, [[0, 0, 0], [4, 0, 0], [0, 4, 0]]
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "has no points"),
        (b"x,y,z\n", "has no points"),
        (b"0,0,0\n1,two,3\n", "line 2 = '1,two,3': y is two, not a finite number"),
        (b"0,0,0\n1\n", "line 2 = '1': has 1 numbers"),
        (b"1,5;2,5;0.5\n", "x is 1,5, not a finite number\n    .*decimals with a point"),
        (b"0,0,0\nnan,0,0\n", "line 2 = 'nan,0,0': x is nan, not a finite number"),
        (b"0,0,0\n1,0,0\n0,0.0,0\n", "line 3 = '\\[0.0, 0.0, 0.0\\]': repeats the point of line 1"),
        (b"\xff\xfe\x00", "is neither text in UTF-8"),
    ],
)
def test_files_without_points_are_refused(tmp_path, text, message):
    """What is no list of points says so, with its line and a remedy."""
    path = tmp_path / "points.csv"
    path.write_bytes(text)
    with pytest.raises(MissionError, match=message):
        point_files.read_points(path)


def test_all_wrong_lines_are_named(tmp_path):
    """One reading tells of every line that is wrong."""
    path = tmp_path / "points.csv"
    path.write_text("0,0,0\na,b,c\n1,2,3,4\n")
    with pytest.raises(MissionError) as caught:
        point_files.read_points(path)
    assert [finding.key for finding in caught.value.findings] == ["line 2", "line 3"]


def test_missing_files_and_directories_are_refused(tmp_path):
    """A file that cannot be opened is named."""
    with pytest.raises(MissionError, match=r"none\.csv: cannot be read: no such file"):
        point_files.read_points(tmp_path / "none.csv")
    with pytest.raises(MissionError, match="cannot be read: is a directory"):
        point_files.read_points(tmp_path)


# -- edges, distances, dimension


def test_complete_graph_is_in_lexical_order():
    """Edges run 12, 13, 14, 23, 24, 34, the order in which distances are given."""
    assert graphs.complete_graph(4).tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]
    assert graphs.complete_graph(1).shape == (0, 2)


def test_distances_agree_with_scipy():
    """Distances over the complete graph are SciPy's pdist, in its order."""
    p = points(1, 6, 3)
    np.testing.assert_allclose(distance_geometry.distances(p, graphs.complete_graph(6)), pdist(p))


@pytest.mark.parametrize(
    ("shape", "n", "want"),
    [("line", 1, 0), ("line", 2, 1), ("line", 3, 1), ("square", 4, 2), ("cube", 8, 3)],
)
def test_dimension(shape, n, want):
    """A line has dimension 1 and a square 2, wherever they lie; rounding does not add one."""
    far = shapes.slots(shape, 4.0, n) @ rotation(3).T + [1e3, -2e3, 50.0]
    assert distance_geometry.dimension(far) == want


@given(SEEDS)
def test_handedness_follows_rotations_and_flips_in_mirrors(seed):
    """Turning a shape keeps its hand, mirroring changes it."""
    p, R = points(seed, 5, 3), rotation(seed)
    hand = distance_geometry.handedness(p)
    assert hand in (-1, 1)
    assert distance_geometry.handedness(p @ R.T) == hand
    assert distance_geometry.handedness(p * [1, -1, 1]) == -hand


def test_flat_shapes_have_no_hand():
    """A planar shape is its own mirror image, turned over."""
    assert distance_geometry.handedness(shapes.slots("hexagon", 4.0, 6)) == 0


# -- distances that exist


@given(SEEDS, st.integers(2, 7), st.integers(1, 3))
def test_measured_distances_exist(seed, n, dimension):
    """Distances measured between points, be they on a line or in a plane, are never refused."""
    p = points(seed, n, 3)
    p[:, dimension:] = 0
    edges = graphs.complete_graph(n)
    assert distance_geometry.violations(edges, distance_geometry.distances(p, edges)) == []


def test_triangle_inequality():
    """4-8-4 is a line and exists; 4-8.1-4 does not, by 0.1 m."""
    edges = graphs.complete_graph(3)
    assert distance_geometry.violations(edges, [4, 8, 4]) == []
    (found,) = distance_geometry.violations(edges, [4, 8.1, 4])
    assert found.agents == (0, 1, 2)
    assert found.excess == pytest.approx(0.1)


@given(arrays(float, 6, elements=st.floats(1.0, 1.9)))
def test_cayley_menger(d):
    """Quadruples whose faces exist are refused where the 5 x 5 Cayley-Menger determinant is negative."""
    squares = np.zeros((5, 5))
    squares[0, 1:] = squares[1:, 0] = 1
    i, j = graphs.complete_graph(4).T + 1
    squares[i, j] = squares[j, i] = d**2
    determinant = np.linalg.det(squares)  # 288 V^2
    found = distance_geometry.violations(graphs.complete_graph(4), d)
    if determinant < -1e-2:
        assert [v.agents for v in found] == [(0, 1, 2, 3)]
        assert found[0].excess == pytest.approx(determinant / 288)
    elif determinant > 0:
        assert found == []


def test_only_complete_quadruples_are_judged():
    """Without one of its six distances a quadruple is free to exist."""
    edges = graphs.complete_graph(4)
    d = [4, 4, 4, 4, 4, 7.5]
    assert len(distance_geometry.violations(edges, d)) == 1
    assert distance_geometry.violations(edges[[0, 1, 2, 3, 5]], np.array(d)[[0, 1, 2, 3, 5]]) == []


def test_edges_may_be_written_either_way():
    """Edge 21 is edge 12."""
    assert len(distance_geometry.violations([[1, 0], [2, 0], [2, 1]], [4, 9, 4])) == 1


# -- slots from distances


@pytest.mark.parametrize(("shape", "size", "n"), NAMED)
def test_slots_come_back_from_distances(shape, size, n):
    """A complete set of distances gives the shape back, in its own handedness."""
    want, edges = shapes.slots(shape, size, n), graphs.complete_graph(n)
    got = distance_geometry.slots_of_all_distances(
        n, edges, distance_geometry.distances(want, edges)
    )
    assert got is not None
    np.testing.assert_allclose(got.mean(axis=0), 0, atol=1e-12)
    R = rigid_body.kabsch(want, got)
    np.testing.assert_allclose(got @ R.T, want, atol=1e-12)


@pytest.mark.parametrize(("shape", "n"), [("line", 3), ("triangle", 3)])
def test_slots_from_distances_lie_as_the_named_shapes(shape, n):
    """Table 1 gives distances alone: its triangle and line come out where the paper puts them."""
    want, edges = shapes.slots(shape, 4.0, n), graphs.complete_graph(n)
    got = distance_geometry.slots_of_all_distances(
        n, edges, distance_geometry.distances(want, edges)
    )
    assert got is not None
    np.testing.assert_allclose(got, want, atol=1e-12)


def test_incomplete_distances_give_no_slots():
    """One missing distance leaves the shape open."""
    edges = graphs.complete_graph(4)[:-1]
    assert distance_geometry.slots_of_all_distances(4, edges, np.ones(5)) is None


def test_distances_of_four_dimensions_are_refused():
    """Five agents that are all 1 m apart need a fourth dimension."""
    with pytest.raises(ValueError, match="no points in space"):
        distance_geometry.slots_of_all_distances(5, graphs.complete_graph(5), np.ones(10))


# -- Kabsch


@given(SEEDS)
def test_kabsch_agrees_with_scipy(seed):
    """In general position the weighted fit is SciPy's align_vectors about the weighted centres."""
    target, source = points(seed, 2, 5, 3)
    w = np.random.default_rng(seed).random(5) + 0.1
    centre = (w[:, None] * np.stack([target, source])).sum(axis=1) / w.sum()
    want, _ = Rotation.align_vectors(target - centre[0], source - centre[1], weights=w)
    np.testing.assert_allclose(rigid_body.kabsch(target, source, w), want.as_matrix(), atol=1e-7)


@given(SEEDS)
def test_kabsch_finds_the_rotation_of_moved_points(seed):
    """Points that were turned and shifted are turned back, flat ones, too."""
    R = rotation(seed)
    for shape, n in (("cube", 8), ("hexagon", 6)):
        p = shapes.slots(shape, 4.0, n)
        np.testing.assert_allclose(rigid_body.kabsch(p @ R.T + [9, 8, 7], p), R, atol=1e-12)


@given(SEEDS, SEEDS)
def test_line_turns_minimally(seed, near_seed):
    """On a line the fit is the shortest rotation from the guide: no spin about the line."""
    p, T, near = shapes.slots("line", 4.0, 3), rotation(seed), rotation(near_seed)
    R = rigid_body.kabsch(p @ T.T, p, near=near)
    np.testing.assert_allclose(R[:, 0], T[:, 0], atol=1e-12)
    # The shortest turn takes the guide's x axis to the line by the angle between them, and no more.
    turned = Rotation.from_matrix(R @ near.T).magnitude()
    between = np.arctan2(np.linalg.norm(np.cross(near[:, 0], T[:, 0])), near[:, 0] @ T[:, 0])
    assert turned == pytest.approx(between, abs=1e-7)


@given(SEEDS)
def test_mirrored_cube_fits_as_near_as_possible(seed):
    """A mirrored cube fits many ways equally well: the nearest to the guide is a proper rotation."""
    near, p = rotation(seed), shapes.slots("cube", 2.0, 8)
    mirrored = p * [1, 1, -1]
    R = rigid_body.kabsch(mirrored, p, near=near)
    assert np.linalg.det(R) == pytest.approx(1)
    best = np.sum((mirrored - p @ R.T) ** 2)
    others = Rotation.random(500, random_state=np.random.RandomState(seed)).as_matrix()
    assert best <= np.sum((mirrored - p @ np.swapaxes(others, 1, 2)) ** 2, axis=(1, 2)).min() + 1e-9
    # Each mirror after the mirror fits as well; none of them is nearer.
    n = points(seed, 500, 3)
    n /= np.linalg.norm(n, axis=1)[:, None]
    equal = (np.eye(3) - 2 * n[:, :, None] * n[:, None]) * [1, 1, -1]
    fit = np.sum((mirrored - p @ np.swapaxes(equal, 1, 2)) ** 2, axis=(1, 2))
    np.testing.assert_allclose(fit, best)
    assert np.trace(near.T @ R) >= np.trace(near.T @ equal, axis1=1, axis2=2).max() - 1e-9


def test_point_keeps_the_guide():
    """Coincident points have no attitude: the guide stands."""
    near = rotation(5)
    np.testing.assert_array_equal(
        rigid_body.kabsch(np.zeros((3, 3)), np.zeros((3, 3)), near=near), near
    )


def test_kabsch_takes_samples_at_once():
    """Samples along leading axes are fitted each by itself, degenerate ones among them."""
    line, triangle = shapes.slots("line", 4.0, 3), shapes.slots("triangle", 4.0, 3)
    targets = np.stack([triangle @ rotation(1).T, line @ rotation(2).T, triangle])
    many = rigid_body.kabsch(targets, triangle)
    for target, R in zip(targets, many, strict=True):
        np.testing.assert_allclose(R, rigid_body.kabsch(target, triangle), atol=1e-12)


# -- graphs of many -------------------------------------------------------------------------------


def test_neighbours_reach_so_many_spacings():
    """In a cubic lattice 1.5 spacings take in faces' diagonals, 1.9 those of the cube."""
    side = np.arange(5.0)
    p = np.stack(np.meshgrid(3.0 * side, 3.0 * side, 3.0 * side, indexing="ij"), axis=-1)
    p = p.reshape(-1, 3)
    for reach, lengths in ((1.1, [1]), (1.5, [1, 2]), (1.9, [1, 2, 3])):
        edges = graphs.neighbour_edges(p, reach)
        squares = np.unique((distance_geometry.distances(p, edges) / 3.0).round(9) ** 2)
        np.testing.assert_allclose(squares, lengths)
        assert len(np.unique(edges, axis=0)) == len(edges)
    degree = np.bincount(graphs.neighbour_edges(p, 1.9).ravel())
    assert degree.max() == 26


@pytest.mark.parametrize("n", [4, 5, 13, 64])
def test_joined_is_minimally_rigid(n):
    """Three edges each, from the centre outwards: 3N - 6 in all, of full rank."""
    p = np.random.default_rng(n).normal(size=(n, 3))
    edges = graphs.henneberg(p)
    assert edges.shape == (3 * n - 6, 2)
    assert np.linalg.matrix_rank(jacobian(p, edges)) == 3 * n - 6


@pytest.mark.parametrize("n", [4, 5, 13, 200])
def test_trees_are_minimally_rigid(n):
    """3N - 6 edges of full rank, each agent joined to three of those that come before; of chains of length log N."""
    p = shapes.slots("sphere", 2.0, n)
    edges = graphs.henneberg_multilevel(p)
    assert len(np.unique(edges, axis=0)) == 3 * n - 6
    assert (edges[:, 0] < edges[:, 1]).all()
    assert np.linalg.matrix_rank(jacobian(p, edges)) == 3 * n - 6
    steps = henneberg_steps(n, edges)
    assert steps is not None
    depth = np.zeros(n, dtype=int)
    for i, *mine in steps.tolist():
        before = [int(edges[e].sum()) - i for e in mine if e >= 0]
        depth[i] = 1 + max((depth[j] for j in before), default=0)
    assert depth.max() <= 12 + np.ceil(np.log2(max(1, n / 12)))


def test_trees_hold_lattices_better_and_shells_at_all():
    """Chains from the centre outwards end soft, and in a shell all of an agent's neighbours lie in its plane."""
    side = np.arange(8.0)
    lattice = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    multilevel, plain = (
        spectrum(lattice, graph(lattice), np.ones(512))
        for graph in (graphs.henneberg_multilevel, graphs.henneberg)
    )
    assert multilevel.index > 3 * plain.index
    assert multilevel.condition < plain.condition / 2
    shell = shapes.slots("sphere", 2.0, 500)
    assert spectrum(shell, graphs.henneberg(shell), np.ones(500)).free > 0
    assert spectrum(shell, graphs.henneberg_multilevel(shell), np.ones(500)).index > 0.01


@pytest.mark.parametrize("n", [40, 41, 300])
def test_shells_are_two_spheres_one_size_apart(n):
    """Nobody is nearer than `size`, not even to the other skin, which lies at that distance; two hold more than one."""
    p = shapes.slots("shells", 2.0, n)
    apart = distance_geometry.distances(p, graphs.complete_graph(n))
    assert apart.min() == pytest.approx(2.0)
    radius = np.sort(np.linalg.norm(p - p.mean(axis=0), axis=1))
    jump = int(np.diff(radius).argmax())
    assert 2.0 - 0.1 < radius[jump + 1] - radius[jump] < 2.6
    if n == 300:
        one = shapes.slots("sphere", 2.0, n)
        two, single = (spectrum(x, graphs.neighbour_edges(x), np.ones(n)).index for x in (p, one))
        assert two > 1.4 * single


def test_joined_of_a_lattice_has_good_pivots():
    """On a lattice, whose points lie in planes, no agent is joined within a plane."""
    side = np.arange(6.0)
    p = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    edges = graphs.henneberg(p)
    assert np.linalg.svd(jacobian(p, edges), compute_uv=False)[-1] > 0.01
    with pytest.raises(ValueError, match="need slots"):
        graphs.henneberg(p[:36])
