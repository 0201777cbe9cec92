"""Print the tables of rigidity.md: shapes with the distances of the cube, and designed graphs.

`python docs/designs.py`, about a minute.
"""

from collections import Counter

from rigidfleet.formation.graphs import CUBE_EDGES, complete_graph
from rigidfleet.formation.shapes import slots
from rigidfleet.rigidity import Kind, RigidityClass, analyse, realisations
from rigidfleet.rigidity.design import design

SHAPES = [
    ("triangle", 4.0, 3),
    ("tetrahedron", 4.0, 4),
    ("square", 4.0, 4),
    ("pyramid", 4.0, 5),
    ("hexagon", 4.0, 6),
    ("octahedron", 4.0, 6),
    ("cube", 4.0, 8),
    ("cuboid", [8.0, 2.0, 4.0], 8),
    ("v", 4.0, 7),
    ("line", 4.0, 5),
    ("grid", 4.0, 9),
    ("icosahedron", 4.0, 12),
    ("dodecahedron", 4.0, 20),
    ("helix", [4.0, 3.0, 3.0], 16),
    ("sphere", 4.0, 30),
    ("sphere", 4.0, 100),
]


def _row(*cells: object) -> None:
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


def main() -> None:
    """Print both tables."""
    cube = slots("cube", 4.0, 8)
    _row("edges", "$w$", "converged", *Kind, "other shapes")
    _row(*["---"] * 8)
    for name, edges in (
        ("the paper's 18", CUBE_EDGES),
        ("designed, 18", design(cube)),
        ("designed, 18 + 3", design(cube, extra=3)),
        ("all 28", complete_graph(8)),
    ):
        search = realisations(cube, edges, starts=2000)
        found = Counter[Kind]()
        for shape in search.shapes:
            found[shape.kind] += shape.starts
        others = sum(shape.kind in (Kind.FOLDED, Kind.COINCIDENT) for shape in search.shapes)
        counts = [found[kind] for kind in Kind]
        _row(name, f"{analyse(cube, edges).w:.4f}", search.converged, *counts, others)
    print()
    _row(
        "shape",
        "agents",
        "edges",
        *["$w$", "class"],
        *["3 more: $w$", "class"],
        *["all: $w$", "class"],
    )
    _row(*["---"] * 9)
    for name, size, n in SHAPES:
        p = slots(name, size, n)
        graphs = [design(p), design(p, extra=3), complete_graph(n)]
        cells = []
        for edges in graphs:
            result = analyse(p, edges)
            rigid = result.rigidity_class is RigidityClass.INFINITESIMALLY_RIGID
            cells += [f"{result.w:.4f}", "rigid" if rigid else str(result.rigidity_class)]
        _row(name, n, len(graphs[0]), *cells)


if __name__ == "__main__":
    main()
