"""Choose the edges of a formation: `design`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from rigidfleet.cli import console
from rigidfleet.cli.arguments import exact, parse_whole
from rigidfleet.cli.codes import PASSED
from rigidfleet.errors import RigidfleetError

#: Maximum number of agents for which a design is compared with all pairs.
_COMPARED = 60
#: Maximum number of agents for which rigidity is computed in full; beyond, only the ends of the spectrum.
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
    """Choose the edges that make a shape most rigid, and write the formation for a mission file.

    The search uses the fewest edges that hold the shape, maximises the rigidity index and compares the result with
    all pairs. For more than a few hundred agents the search takes hours: choose a graph by --edges instead.

    Parameters
    ----------
    shape : str
        A named shape, or a file of points with x, y, z of one agent per line.
    agents : int
        Number of agents. Default: as many as the shape needs.
    size : float
        Edge length of a named shape [m], or three sizes for a cuboid or a helix. Default: 4.
    extra : str
        Number of additional, redundant edges, or "complete" for all pairs.
    sensing_range : float
        Maximum length of an edge [m].
    edges : str
        Use this graph instead of a search: complete, neighbours, henneberg or henneberg-multilevel.
    reach : float
        Maximum length of edges "neighbours", in distances of nearest neighbours. Default: 1.9.
    out : Path
        Write the formation to this file. Default: print it.
    force : bool
        Overwrite this file.
    json : bool
        Print the result as JSON.
    """
    from rigidfleet._common.files import write_file
    from rigidfleet.formation.graphs import CUBE_EDGES, REACH, complete_graph
    from rigidfleet.rigidity import design as designs

    if out is not None and out.exists() and not force:
        raise RigidfleetError(f"{out}: already exists; use --force to overwrite.")
    try:
        name, slots = _points(shape, agents, size)
        if edges is not None:
            _reject(edges, reach, searched=extra != "0" or sensing_range is not None)
            kinds = {edges: designs.GRAPHS[edges](slots, REACH if reach is None else reach)}
        else:
            if reach is not None:
                raise ValueError("--reach has no effect without --edges neighbours; remove it")
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
    table = console.table("graph", "edges", "rank", "index", "cond.", "longest", "class")
    table.columns[0].no_wrap = True
    for what, (_, cells) in judged.items():
        table.add_row(what, *cells)
    # Standard output has the formation alone, so that it can be piped.
    output = console.out() if out is not None else console.err()
    output.print(table)
    if limits:
        output.print(limits)
    if out is None:
        console.print_exactly(text)
    else:
        output.print(f"Formation  {out}", soft_wrap=True)
    return PASSED


def _reject(edges: str, reach: float | None, *, searched: bool) -> None:
    """Reject an unknown graph, and options that have no effect on it.

    Raises
    ------
    ValueError
        The graph is unknown, or --extra, --range or --reach cannot be combined with it.
    """
    from rigidfleet._common.renamed import successor
    from rigidfleet.rigidity.design import GRAPHS

    if edges not in GRAPHS:
        told = successor("edges", edges) or f"graphs: {', '.join(GRAPHS)}"
        raise ValueError(f"there is no graph {edges!r}; {told}")
    if searched:
        raise ValueError("--extra and --range have no effect with --edges; remove them or --edges")
    if reach is not None and edges != "neighbours":
        raise ValueError(f"--reach has no effect on edges {edges!r}; remove it")
    if reach is not None and not 0.0 < reach < math.inf:
        raise ValueError(f"--reach must be a positive number, not {reach:g}")


def compare_graph(slots: Any, edges: Any) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Rigidity of slots (N, 3) with a graph: as data, and as cells of a row of the table."""
    import numpy as np

    from rigidfleet.formation.distance_geometry import distances
    from rigidfleet.rigidity import analyse, jacobian, spectrum

    longest = f"{distances(slots, edges).max(initial=0.0):.3g} m"
    if len(slots) <= _DENSE:
        found = analyse(slots, edges)
        # The smallest non-zero value counts, as in the index.
        held = len(edges) > 0 and found.w > 0
        ratio = float(np.linalg.norm(jacobian(slots, edges), 2) ** 2) / found.w if held else None
        condition = "" if ratio is None else f"{ratio:.3g}"
        cells = (f"{found.index:.4f}", condition, longest)
        rank = f"{found.rank} of {found.needed}"
        data = found.data() | {"condition": ratio}
        return data, (str(len(edges)), rank, *cells, str(found.rigidity_class))
    ends = spectrum(slots, edges, [1.0] * len(slots))
    rigidity_class = "flexible to first order" if ends.free else "infinitesimally rigid"
    rank = "" if ends.free else "full"
    cells = (f"{ends.index:.3g}", f"{ends.condition:.3g}", longest)
    data = {"edges": len(edges), "index": ends.index, "w": ends.w, "free": ends.free}
    data["condition"] = ends.condition if ends.w > 0 else None
    return data | {"rigidity_class": rigidity_class}, (
        f"{len(edges):,}",
        rank,
        *cells,
        rigidity_class,
    )


def _points(shape: str, agents: int | None, size: list[float] | None) -> tuple[str, Any]:
    """Name and slots (N, 3) [m] of a named shape or of a file of points.

    Raises
    ------
    ValueError
        The shape does not suit the number of agents or sizes, or an option has no effect on a file.
    """
    from rigidfleet.formation.point_files import read_points
    from rigidfleet.formation.shapes import SHAPES, agents_taken, slots
    from rigidfleet.math.rigid_body import centred

    if shape in SHAPES:
        form = SHAPES[shape]
        count = form.agents.start if agents is None else agents
        if agents is None and len(form.agents) > 1:
            raise ValueError(f"takes {agents_taken(shape)}; give --agents")
        return shape, slots(shape, size or [4.0] * form.sizes, count)
    if not Path(shape).exists():
        raise ValueError(f"is neither a shape nor a file; shapes: {', '.join(SHAPES)}")
    if agents is not None or size is not None:
        raise ValueError("a file of points determines agents and size; remove --agents and --size")
    return Path(shape).stem, centred(read_points(shape))
