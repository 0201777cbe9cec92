"""Turn a shape, a file or words into a formation, and choose its edges: `design`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from rigidfleet.cli import console
from rigidfleet.cli.arguments import parse_whole, to_whole_number
from rigidfleet.cli.codes import PASSED
from rigidfleet.cli.outputs import refuse_overwriting
from rigidfleet.errors import RigidfleetError

#: Maximum number of agents for which a design is compared with all pairs.
_COMPARED = 60
#: Maximum number of agents for which rigidity is computed in full; beyond, only the ends of the spectrum.
_DENSE = 200


def design(
    shape: str,
    /,
    *,
    agents: Annotated[int | None, Parameter(converter=to_whole_number)] = None,
    size: Annotated[list[float] | None, Parameter(consume_multiple=True)] = None,
    spacing: float | None = None,
    font: str | None = None,
    extra: str = "0",
    sensing_range: Annotated[float | None, Parameter(name="--range")] = None,
    edges: str | None = None,
    reach: float | None = None,
    out: Path | None = None,
    force: bool = False,
    json: bool = False,
) -> int:
    """Choose the edges that make a shape most rigid, and write the formation for a mission file.

    The shape may also come from a file of points, a drawing (SVG) or words in a font, whose outlines are sampled with
    even spacing.

    The search uses the fewest edges that hold the shape, maximises the rigidity index and compares the result with
    all pairs. For more than a few hundred agents the search takes hours: choose a graph by --edges instead.

    Parameters
    ----------
    shape : str
        A named shape; a file of points (CSV, NPY or PLY) with x, y, z of one agent per line; a drawing (SVG); or
        text:WORDS, in outlines, or strokes:WORDS, in single strokes. Drawings and words stand upright, x to the east
        and z up.
    agents : int
        Number of agents. Default: as many as the shape needs, or the file has.
    size : float
        Edge length of a named shape [m], or three sizes for a cuboid or a helix. Default: 4.
    spacing : float
        Distance of the nearest two agents of a file or of words [m], which are scaled to it.
    font : str
        Font of text:WORDS (default: DejaVu Sans) or of strokes:WORDS (default: futural).
    extra : str
        Number of additional, redundant edges, or "complete" for all pairs.
    sensing_range : float
        Maximum length of an edge [m].
    edges : str
        Use this graph instead of a search: complete, neighbours, henneberg, henneberg-multilevel, or none.
    reach : float
        Maximum length of edges "neighbours", in distances of nearest neighbours. Default: 1.9.
    out : Path
        Write the formation to this file; its points alone if it ends in .csv. Default: print it.
    force : bool
        Overwrite this file.
    json : bool
        Print the result as JSON.
    """
    from json import dumps

    from rigidfleet._common.facts import FactTable, Row
    from rigidfleet._common.files import write_file
    from rigidfleet.formation.graphs import CUBE_EDGES, GRAPHS, REACH, complete_graph
    from rigidfleet.formation.point_files import csv_of_points
    from rigidfleet.rigidity import design as designs

    refuse_overwriting(out, force=force)
    try:
        name, (slots, colours, notes) = load_shape_points(shape, agents, size, spacing, font)
        kinds: dict[str, Any] = {}
        _refuse_options_that_clash(edges, reach, extra, sensing_range)
        if edges is None:
            more = extra if extra == "complete" else parse_whole(extra, "--extra: ")
            kinds = {"designed": designs.design(slots, extra=more, sensing_range=sensing_range)}
            if shape == "cube":
                kinds["the paper's 18"] = CUBE_EDGES
            if len(slots) <= _COMPARED:
                kinds["all pairs"] = complete_graph(len(slots))
        elif edges != "none":
            kinds[edges] = GRAPHS[edges](slots, REACH if reach is None else reach)
        chosen = [] if edges == "none" else edges or kinds["designed"]
        text = "".join(f"# {note}\n" for note in notes)
        text += designs.mission_fragment(name, slots, chosen, reach)
        if colours is not None:
            text += f"colour = {dumps(colours)}\n"
        judged = {what: rigidity_data_and_row(slots, graph) for what, graph in kinds.items()}
    except ValueError as error:
        words = str(error).rstrip(".")
        raise RigidfleetError(f"{shape}: {words}{'' if words.endswith('?') else '.'}") from None
    limits = designs.free_motions_text(slots)
    for note in notes:
        console.err().print(f"Note: {shape}: {note}.")
    if out is not None:
        table = csv_of_points(slots, colours) if out.suffix.lower() == ".csv" else text
        write_file(out, table.encode())
    if json:
        graphs = {what: data for what, (data, _) in judged.items()}
        console.print_json({"name": name, "toml": text, "limits": limits, "graphs": graphs})
        return PASSED
    heads = ("graph", "edges", "rank", "index", "condition", "longest [m]", "class")
    rows = [Row((what, *cells)) for what, (_, cells) in judged.items()]
    # Standard output has the formation alone, so that it can be piped.
    output = console.out() if out is not None else console.err()
    if kinds:
        output.print(FactTable(heads, rows, ("class",)))
    if limits and kinds:
        output.print(limits)
    if out is None:
        console.print_exactly(text)
    else:
        output.print(f"Formation  {out}", soft_wrap=True)
    return PASSED


def _refuse_options_that_clash(
    edges: str | None, reach: float | None, extra: str, sensing_range: float | None
) -> None:
    """Reject an unknown graph, and options that have no effect on it or on a search.

    Raises
    ------
    ValueError
        The graph is unknown, a value is not positive, or --extra, --range or --reach cannot be combined with it.
    """
    from rigidfleet._common.renamed import rename_hint
    from rigidfleet.formation.graphs import GRAPHS

    if edges is None:
        if reach is not None:
            raise ValueError("--reach has no effect without --edges neighbours; remove it")
        if sensing_range is not None and not sensing_range > 0.0:
            raise ValueError(f"--range must be a positive length [m], not {sensing_range:g}")
        return
    if edges not in GRAPHS and edges != "none":
        remedy = rename_hint("edges", edges) or f"graphs: {', '.join(GRAPHS)}, none"
        raise ValueError(f"there is no graph {edges!r}; {remedy}")
    if extra != "0" or sensing_range is not None:
        raise ValueError("--extra and --range have no effect with --edges; remove them or --edges")
    if reach is not None and edges != "neighbours":
        raise ValueError(f"--reach has no effect on edges {edges!r}; remove it")
    if reach is not None and not 0.0 < reach < math.inf:
        raise ValueError(f"--reach must be a positive number, not {reach:g}")


def rigidity_data_and_row(slots: Any, edges: Any) -> tuple[dict[str, Any], tuple[Any, ...]]:
    """Rigidity of slots (N, 3) with a graph: as data, and as cells of a row of the table."""
    import numpy as np

    from rigidfleet.formation.distance_geometry import distances
    from rigidfleet.rigidity import analyse, jacobian, spectrum

    longest = float(distances(slots, edges).max(initial=0.0))
    if len(slots) <= _DENSE:
        rigidity = analyse(slots, edges)
        # The smallest non-zero value counts, as in the index.
        held = len(edges) > 0 and rigidity.w > 0
        ratio = float(np.linalg.norm(jacobian(slots, edges), 2) ** 2) / rigidity.w if held else None
        data = rigidity.data() | {"condition": ratio}
        rank = f"{rigidity.rank} of {rigidity.needed}"
    else:
        ends = spectrum(slots, edges, [1.0] * len(slots))
        rigidity_class = "flexible to first order" if ends.free else "infinitesimally rigid"
        data = {"edges": len(edges), **ends.data(), "rigidity_class": rigidity_class}
        rank = "" if ends.free else "full"
    condition, kind = data["condition"], data["rigidity_class"]
    index = f"{data['index']:.4f}" if len(slots) <= _DENSE else data["index"]
    return data, (f"{len(edges):,}", rank, index, condition, longest, kind)


def load_shape_points(
    shape: str,
    agents: int | None,
    size: list[float] | None = None,
    spacing: float | None = None,
    font: str | None = None,
) -> tuple[str, Any]:
    """Name and `formation.point_files.Points` of a named shape, of a file of points or a drawing, or of words.

    Their notes say what of a drawing is left out, and by how much, and why, points are scaled.

    Raises
    ------
    ValueError
        The shape does not suit the number of agents or sizes, or an option is missing or has no effect.
    """
    import numpy as np

    from rigidfleet.formation import outlines
    from rigidfleet.formation.point_files import Points, read_points
    from rigidfleet.formation.shapes import SHAPES, agents_taken, slots
    from rigidfleet.math.rigid_body import centred
    from rigidfleet.mission.findings import suggest_shape

    kind, _, words = shape.partition(":")
    letters = {"text": outlines.text_outlines, "strokes": outlines.stroke_outlines}.get(kind)
    notes: list[str] = []
    if font is not None and letters is None:
        raise ValueError("--font has no effect without text:WORDS or strokes:WORDS; remove it")
    if shape in SHAPES:
        form = SHAPES[shape]
        count = form.agents.start if agents is None else agents
        if spacing is not None:
            raise ValueError("--spacing has no effect on a named shape; use --size")
        if agents is None and len(form.agents) > 1:
            raise ValueError(f"takes {agents_taken(shape)}; give --agents")
        return shape, Points(slots(shape, size or [4.0] * form.sizes, count), None)
    if letters is None and not Path(shape).exists():
        if Path(shape).suffix or len(Path(shape).parts) > 1:
            raise ValueError("no such file")
        raise ValueError(f"is neither a shape nor a file: {suggest_shape(shape)}")
    if size is not None:
        raise ValueError("--size has no effect on a file or on words; use --spacing")
    if letters is not None or Path(shape).suffix.lower() == ".svg":
        if agents is None or spacing is None:
            raise ValueError("an outline needs --agents and --spacing")
        own = [] if font is None else [font]
        drawn = letters(words, *own) if letters else outlines.svg_outlines(shape, notes)
        points = outlines.slots_on_outlines(drawn, agents, spacing)
        wide, _, high = np.ptp(points, axis=0)
        notes += [
            f"{wide:,.4g} m wide, {high:,.4g} m high: the nearest two are {spacing:g} m apart"
        ]
        return words if letters else Path(shape).stem, Points(points, None, tuple(notes))
    points, colours, doubts = read_points(shape, repeated=True)
    if agents is not None and agents != len(points):
        kept = outlines.most_even_points(points, agents)
        points, colours = points[kept], colours and tuple(colours[k] for k in kept.tolist())
    if spacing is None:
        return Path(shape).stem, Points(centred(points), colours, doubts)
    scaled = outlines.scale_to_spacing(points, spacing)
    notes += [*doubts, *outlines.scale_in_words(points, scaled)]
    return Path(shape).stem, Points(scaled, colours, tuple(notes))
