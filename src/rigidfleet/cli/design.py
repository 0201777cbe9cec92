"""Choose edges for a shape: `design`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from rigidfleet.cli import console
from rigidfleet.cli.arguments import exact, parse_whole
from rigidfleet.errors import RigidfleetError

if TYPE_CHECKING:
    pass
from rigidfleet.cli.codes import PASSED

#: A design of so many agents is compared with all pairs; one of more than the latter is judged by the ends of its
#: spectrum alone.
_COMPARED = 60


#: See `_COMPARED`.
_DENSE = 200


def design(
    shape: str,
    /,
    *,
    agents: Annotated[int | None, Parameter(converter=exact)] = None,
    size: Annotated[list[float] | None, Parameter(consume_multiple=True)] = None,
    extra: str = "0",
    sensing_range: Annotated[float | None, Parameter(name="--range")] = None,
    edges: str | None = None,
    reach: float | None = None,
    out: Path | None = None,
    force: bool = False,
    json: bool = False,
) -> int:
    """Choose the edges that hold a shape best, and write the formation for a mission file.

    As few edges as hold it, of the greatest rigidity index found; compared with all pairs. For more than some
    hundred agents, where that search would take hours, choose a graph by --edges; its index is reported.

    Parameters
    ----------
    shape : str
        A named shape, or a file of points: x, y, z of one agent a line.
    agents : int
        Number of agents; as many as the shape needs if not given.
    size : float
        Edge length of a named shape [m], 4 if not given; three for a cuboid or a helix.
    extra : str
        Number of redundant edges besides, or "complete" for all.
    sensing_range : float
        No edge is longer than this [m].
    edges : str
        Do not search, but take this graph: complete, neighbours, henneberg or henneberg-multilevel.
    reach : float
        How far edges "neighbours" reach, in distances of nearest neighbours; 1.9 if not given.
    out : Path
        Write the formation to this file; else it is printed.
    force : bool
        Replace that file if it is there already.
    json : bool
        Print all of it as JSON.
    """
    from rigidfleet._files import write_file
    from rigidfleet.formation.graphs import CUBE_EDGES, REACH, complete_graph
    from rigidfleet.rigidity import design as designs

    if out is not None and out.exists() and not force:
        raise RigidfleetError(f"{out}: exists already and is kept. Replace it by --force.")
    try:
        name, slots = _points(shape, agents, size)
        if edges is not None:
            _reject(edges, reach, searched=extra != "0" or sensing_range is not None)
            kinds = {edges: designs.GRAPHS[edges](slots, REACH if reach is None else reach)}
        else:
            if reach is not None:
                raise ValueError("--reach has no effect without --edges neighbours, remove it")
            if sensing_range is not None and not sensing_range > 0.0:
                raise ValueError(f"--range must be a positive length [m], not {sensing_range:g}")
            more = extra if extra == "complete" else parse_whole(extra)
            kinds = {"designed": designs.design(slots, extra=more, sensing_range=sensing_range)}
            if shape == "cube":
                kinds["the paper's 18"] = CUBE_EDGES
            if len(slots) <= _COMPARED:
                kinds["all pairs"] = complete_graph(len(slots))
        text = designs.mission_fragment(name, slots, edges or kinds["designed"], reach)
        judged = {what: compare_graph(slots, graph) for what, graph in kinds.items()}
    except ValueError as error:
        raise RigidfleetError(f"{shape}: {str(error).rstrip('.')}.") from None
    limits = designs.limits(slots)
    if out is not None:
        write_file(out, text.encode())
    if json:
        found = {what: data for what, (data, _) in judged.items()}
        console.print_json({"name": name, "toml": text, "limits": limits, "graphs": found})
        return PASSED
    table = console.table("graph", "edges", "rank", "index", "cond.", "longest", "verdict")
    table.columns[0].no_wrap = True  # a name is not cut
    for what, (_, cells) in judged.items():
        table.add_row(what, *cells)
    output = (
        console.out() if out is not None else console.err()
    )  # so that the formation alone can be piped
    output.print(table)
    if limits:
        output.print(limits)
    if out is None:
        console.print_exactly(text)
    else:
        output.print(f"Formation  {out}", soft_wrap=True)
    return PASSED


def _reject(edges: str, reach: float | None, *, searched: bool) -> None:
    """Say so where a named graph is none, or goes with options of the search.

    Raises
    ------
    ValueError
    """
    from rigidfleet._renamed import successor
    from rigidfleet.rigidity.design import GRAPHS

    if edges not in GRAPHS:
        told = successor("edges", edges) or f"graphs: {', '.join(GRAPHS)}"
        raise ValueError(f"no graph is called {edges!r}; {told}")
    if searched:
        raise ValueError("--extra and --range are of the search, remove them or --edges")
    if reach is not None and edges != "neighbours":
        raise ValueError(f"--reach has no effect on edges {edges!r}, remove it")
    if reach is not None and not 0.0 < reach < math.inf:
        raise ValueError(f"--reach must be a positive number of spacings, not {reach:g}")


def compare_graph(slots: Any, edges: Any) -> tuple[dict[str, Any], tuple[str, ...]]:
    """How a graph holds slots (N, 3): as data, and as the cells of a row of `design`."""
    import numpy as np

    from rigidfleet.formation.distance_geometry import distances
    from rigidfleet.rigidity import analyse, jacobian, spectrum

    longest = f"{distances(slots, edges).max(initial=0.0):.3g} m"
    if len(slots) <= _DENSE:
        found = analyse(slots, edges)
        # The smallest value counts that is not zero, as in the index.
        held = len(edges) > 0 and found.w > 0
        ratio = float(np.linalg.norm(jacobian(slots, edges), 2) ** 2) / found.w if held else None
        condition = "" if ratio is None else f"{ratio:.3g}"
        cells = (f"{found.index:.4f}", condition, longest)
        rank = f"{found.rank} of {found.needed}"
        data = found.data() | {"condition": ratio}
        return data, (str(len(edges)), rank, *cells, str(found.verdict))
    ends = spectrum(slots, edges, [1.0] * len(slots))
    verdict = "flexible to first order" if ends.free else "infinitesimally rigid"
    rank = "" if ends.free else "full"
    cells = (f"{ends.index:.3g}", f"{ends.condition:.3g}", longest)
    data = {"edges": len(edges), "index": ends.index, "w": ends.w, "free": ends.free}
    data["condition"] = ends.condition if ends.w > 0 else None
    return data | {"verdict": verdict}, (f"{len(edges):,}", rank, *cells, verdict)


def _points(shape: str, agents: int | None, size: list[float] | None) -> tuple[str, Any]:
    """Name and slots (N, 3) [m] of a named shape, or of a file of points.

    Raises
    ------
    ValueError
        The shape takes other numbers of agents or sizes, or an option has no effect on a file.
    """
    from rigidfleet.formation.point_files import read_points
    from rigidfleet.formation.shapes import SHAPES, agents_taken, slots
    from rigidfleet.math.rigid_body import centred

    if shape in SHAPES:
        form = SHAPES[shape]
        count = form.agents.start if agents is None else agents
        if agents is None and len(form.agents) > 1:
            raise ValueError(f"takes {agents_taken(shape)}, give --agents")
        return shape, slots(shape, size or [4.0] * form.sizes, count)
    if not Path(shape).exists():
        raise ValueError(f"neither a shape nor a file; shapes: {', '.join(SHAPES)}")
    if agents is not None or size is not None:
        raise ValueError("a file has its own points, remove --agents and --size")
    return Path(shape).stem, centred(read_points(shape))
