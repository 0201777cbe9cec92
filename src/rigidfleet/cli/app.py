"""The command ``rigidfleet``: it parses, calls and prints.

What was asked for goes to standard output: verdicts, tables, JSON. Progress and errors go to standard
error. Colours and animation are for terminals, and `NO_COLOR` is respected.

Exit codes
----------
- 0: done; for `run` and `report`: the flight passed its verdict; for `sweep`: every run is flown,
  passed or not
- 1: flew, but failed its verdict, as a flight does that could not be flown to its end; for `check`:
  something will fail
- 2: bad input, or files that cannot be read or written
- 130: interrupted (Ctrl-C); what flew is saved, marked incomplete

Packages that take long to load are imported by the commands that need them.
"""

from __future__ import annotations

import gc
import math
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

from cyclopts import App, CycloptsError, Parameter, UnknownOptionError, UnusedCliTokensError

from rigidfleet._version import __version__
from rigidfleet.cli import console
from rigidfleet.cli.outputs import Files, taken
from rigidfleet.errors import MissionError, RigidfleetError

if TYPE_CHECKING:
    from rigidfleet.assessment import Verdict
    from rigidfleet.mission import Mission
    from rigidfleet.result import Result
    from rigidfleet.sweep import Sweep

PASSED, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130

#: A format of figures, and those drawn unless others are asked for.
Format = Literal["png", "svg", "pdf"]
_DRAWN: tuple[Format, ...] = ("png", "svg")

#: A design of so many agents is compared with all pairs; one of more than the latter is judged by the ends of its
#: spectrum alone.
_COMPARED, _DENSE = 60, 200


def _exact(_type: Any, tokens: Sequence[Any]) -> int:
    """A whole number as it is written: none is rounded."""
    return _whole(tokens[0].value)


app = App(
    name="rigidfleet",
    help="Fly many air vehicles as one rigid body: simulate, judge and draw formation flights.",
    help_epilogue="Exit codes: 0 done, or the flight passed; 1 it flew but failed its verdict, or "
    "will fail (check); 2 bad input; 130 interrupted, what flew is saved.",
    help_format="plaintext",
    version=f"rigidfleet {__version__}",
    version_flags=["--version"],
    default_parameter=Parameter(negative=(), show_default=False),
    exit_on_error=False,
    print_error=False,
    suppress_keyboard_interrupt=False,
    result_action="return_value",
)


def main(tokens: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code; without `tokens`, on the arguments of the process."""
    if tokens is None:
        # Imports make a hundred thousand objects that stay: looked through as often as by default, they
        # would take a tenth longer.
        gc.set_threshold(100_000)
        warnings.showwarning = cast("Any", console.warn)
        # Matrices are small here: threads over them wait for each other, and on a busy machine for long.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    console.prepare_streams()
    try:
        return app(tokens, console=console.out(), error_console=console.err()) or PASSED
    except CycloptsError as error:
        console.complain(_usage(error))
        return BAD_INPUT
    except RigidfleetError as error:
        console.complain(error)
        return BAD_INPUT
    except BrokenPipeError:
        console.hang_up(sys.stdout)
        return PASSED
    except OSError as error:  # a full disk and the like: no fault of the program
        if error.filename is None:
            console.hang_up(sys.stdout)
        console.complain(f"{error.filename or 'standard output'}: {error.strerror or error}")
        return BAD_INPUT
    except KeyboardInterrupt:
        console.err().print("Interrupted", style="yellow")
        return INTERRUPTED
    except MemoryError:
        console.complain(
            "There is too little memory for this. Use fewer agents, edges or samples, or a larger machine."
        )
        return BAD_INPUT
    except Exception as error:
        if sys.flags.dev_mode:
            raise
        console.complain(_own_fault(error))
        return BAD_INPUT


# -- commands ----------------------------------------------------------------------------------------


@app.command(sort_key=1)
def run(
    mission: str,
    /,
    *,
    out: Path | None = None,
    force: bool = False,
    no_figures: bool = False,
    format: list[Format] | None = None,
    no_titles: bool = False,
    replay: bool = False,
    csv: bool = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Fly a mission: simulate it, judge it, draw it.

    Parameters
    ----------
    mission : str
        A shipped mission (see "rigidfleet missions") or a mission file.
    out : Path
        Folder for the files: NAME.nc, verdict.json and figures/; flights/NAME if not given.
    force : bool
        Replace the files of an earlier flight; without it they are kept and nothing is flown.
    no_figures : bool
        Draw no figures; "rigidfleet report" can do so later.
    format : list
        Format of the figures, png and svg if not given; may be repeated: --format pdf --format png.
    no_titles : bool
        Draw figures without titles, for a paper with captions.
    replay : bool
        Also write replay.html: the flight to be watched in a browser.
    csv : bool
        Also write NAME.csv: time, position, velocity and yaw of each agent.
    json : bool
        Print the verdict as JSON.
    quiet : bool
        Print nothing but errors, and the JSON if asked for.
    """
    from rigidfleet.mission import load_mission

    flown = load_mission(mission)
    files = Files(out or Path("flights", flown.name), flown.name)
    files.claim(replace=force)
    watch = None if quiet else console.FlightWatch()
    with watch or nullcontext():
        result, interrupted = _fly(flown, watch)

    from rigidfleet.assessment import assess
    from rigidfleet.result import write_file

    files.make_folder()
    result.save(files.result)
    files.forget()
    if csv:
        result.to_csv(files.table)
    verdict = assess(result)
    write_file(files.verdict, (verdict.json() + "\n").encode())
    if json:
        console.print_exactly(verdict.json() + "\n")
    elif not quiet:
        console.out().print(verdict)
    what = "what flew is saved, marked incomplete," if interrupted else "the flight is saved"
    if not interrupted:
        try:
            if replay:
                _write_replay(result, files.replay)
            if not no_figures:
                _draw(result, files.figures, format, titles=not no_titles, quiet=quiet)
        except KeyboardInterrupt:
            interrupted = True
    if not (json or quiet):
        console.out().print()
        _list(files)
    if interrupted:
        console.err().print(
            f"Interrupted: {what} in {files.result}", style="yellow", soft_wrap=True
        )
        return INTERRUPTED
    return PASSED if verdict.passed else FAILED


@app.command(sort_key=2)
def missions(
    *, print_: Annotated[str, Parameter(name="--print")] = "", schema: bool = False
) -> int:
    """List the missions that ship with the program.

    Parameters
    ----------
    print_ : str
        Print the file of this mission instead, to be copied and changed.
    schema : bool
        Print the JSON schema of mission files instead, for editors.
    """
    from rigidfleet.mission import json_schema, mission_names, mission_text

    if print_ and schema:
        raise RigidfleetError("--print and --schema exclude each other. Give one of them.")
    if print_:
        console.print_exactly(mission_text(print_))
    elif schema:
        console.print_json(json_schema())
    else:
        import tomllib

        table = console.table("mission", "what it shows", "in the paper")
        for name in mission_names():
            head = tomllib.loads(mission_text(name))
            table.add_row(name, head.get("title", ""), head.get("source", ""))
        console.print_table(table)
    return PASSED


@app.command(sort_key=3)
def check(
    mission: str,
    /,
    *,
    realisations: Annotated[bool | None, Parameter(negative="--no-realisations")] = None,
    figure: Path | None = None,
    json: bool = False,
) -> int:
    """Check whether a mission is right, and what it will meet, without flying it.

    Rigidity of its formations, gains, and the planned way: collisions, thrust, gaps.

    Parameters
    ----------
    mission : str
        A shipped mission or a mission file.
    realisations : bool
        Search for other shapes with the same distances, 40 random starts for each formation; if
        neither is given, for up to 12 agents.
    figure : Path
        Draw the graphs to this file, .png, .svg or .pdf: redundant edges dashed, flexes as arrows.
    json : bool
        Print what was found as JSON.
    """
    from rigidfleet.mission import counted, ending, goal, load_mission

    watch = console.CheckWatch(mission)
    try:
        with watch:
            found = load_mission(mission)
    except MissionError as error:
        if not json:
            raise
        findings = [
            {"key": f.key, "value": f.value, "problem": f.problem, "remedy": f.remedy}
            for f in error.findings
        ]
        console.print_json({"mission": mission, "right": False, "findings": findings})
        return BAD_INPUT
    from rigidfleet.preflight.check import check as preflight

    with watch:
        ahead = preflight(found, search=realisations, progress=watch.update)
    if figure is not None:
        from rigidfleet.plotting.graph import draw_graphs

        judged = {f.name: f.rigidity for f in ahead.formations}
        draw_graphs(found, judged, figure)
    if json:
        console.print_json({"mission": mission, "right": True} | _facts(found) | ahead.data())
        return PASSED if ahead.passed else FAILED
    table = console.table("#", "phase", "kind", "to", "ends", "control")
    for n, phase in enumerate(found.phases, start=1):
        table.add_row(str(n), phase.name, phase.kind, goal(phase), ending(phase), phase.control)
    console.out().print(f"{found.name}: right: {counted(found)}")
    console.print_table(table)
    console.out().print()
    console.print_words(ahead.describe())
    if ahead.remarks:
        console.out().print()
        console.print_words((remark.level, remark.text) for remark in ahead.remarks)
    verdict = "nothing found that will fail" if ahead.passed else "it will fail as it is"
    console.out().print(f"\n{found.name}: {verdict}", style=None if ahead.passed else "bold red")
    return PASSED if ahead.passed else FAILED


@app.command(sort_key=4)
def design(
    shape: str,
    /,
    *,
    agents: Annotated[int | None, Parameter(converter=_exact)] = None,
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
    from rigidfleet.formation.graphs import CUBE_EDGES, REACH, complete_graph
    from rigidfleet.result import write_file
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
            more = extra if extra == "complete" else _whole(extra)
            kinds = {"designed": designs.design(slots, extra=more, sensing_range=sensing_range)}
            if shape == "cube":
                kinds["the paper's 18"] = CUBE_EDGES
            if len(slots) <= _COMPARED:
                kinds["all pairs"] = complete_graph(len(slots))
        text = designs.mission_fragment(name, slots, edges or kinds["designed"], reach)
        judged = {what: _judged(slots, graph) for what, graph in kinds.items()}
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


def _judged(slots: Any, edges: Any) -> tuple[dict[str, Any], tuple[str, ...]]:
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


@app.command(sort_key=5)
def new(
    name: str = "",
    /,
    *,
    shape: str | None = None,
    agents: Annotated[int | None, Parameter(converter=_exact)] = None,
    size: Annotated[list[float] | None, Parameter(consume_multiple=True)] = None,
    mass: float | None = None,
    thrust_limit: float | None = None,
    to: list[tuple[float, float, float]] | None = None,
    force: bool = False,
    quiet: bool = False,
    json: bool = False,
) -> int:
    """Write a mission to start from: commented, checked, ready to fly.

    Without options, on a terminal, it asks a few questions.

    Parameters
    ----------
    name : str
        Name of the mission, which is written to NAME.toml; or a path that ends so.
    shape : str
        line, triangle, square, polygon, hexagon, pyramid, cube, cuboid, v, grid, sphere, shells,
        helix, tetrahedron, octahedron, icosahedron or dodecahedron.
    agents : int
        Number of vehicles; as many as the shape needs if not given.
    size : float
        Edge length of the shape [m]; of a cuboid or a helix one, or three.
    mass : float
        Mass of each vehicle [kg].
    thrust_limit : float
        Greatest thrust of each vehicle [N]; 2.2 times its weight if not given.
    to : float
        Waypoint to fly to, X Y Z [m]; may be repeated.
    force : bool
        Replace a file that is there already.
    quiet : bool
        Print nothing but errors, and the JSON if asked for. Ask nothing.
    json : bool
        Print what was written as JSON. Ask nothing.
    """
    from rigidfleet.mission import Mission, counted, draft
    from rigidfleet.preflight.check import check as preflight
    from rigidfleet.result import write_file

    given: dict[str, Any] = {
        "shape": shape, "agents": agents, "size": size, "mass": mass,
        "thrust_limit": thrust_limit, "waypoints": to,
    }  # fmt: skip
    asked = {key: value for key, value in given.items() if value is not None}
    if not (asked or quiet or json) and sys.stdin.isatty() and console.err().is_terminal:
        name, asked = _ask(name)
    file = Path(name or "mission")
    file = file if file.suffix == ".toml" else file.with_name(f"{file.name}.toml")
    if file.exists() and not force:
        raise RigidfleetError(f"{file}: exists already and is kept. Replace it by --force.")
    try:
        text = draft.draft(file.stem, file=str(file), **asked)
    except ValueError as error:
        raise RigidfleetError(str(error)) from None
    mission = Mission.from_toml(text, str(file))
    fails = [r.text for r in preflight(mission, search=False).remarks if r.level == "fails"]
    if fails:
        raise RigidfleetError(
            f"{file}: is not written, as it would fail: {'; '.join(fails)}. Change what you ask for."
        )
    write_file(file, text.encode())
    if json:
        console.print_json({"file": str(file)} | _facts(mission))
    elif not quiet:
        console.out().print(f"{file}: {counted(mission)}", soft_wrap=True)
        console.out().print(f"Fly it by: rigidfleet run {file}", soft_wrap=True)
    return PASSED


@app.command(sort_key=6)
def report(
    result: Path,
    /,
    *others: Path,
    out: Path | None = None,
    force: bool = False,
    no_figures: bool = False,
    format: list[Format] | None = None,
    no_titles: bool = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Judge and draw a flight again, and write a report to print and to send.

    Of several flights, write one report that shows them side by side: comparison.html.

    Parameters
    ----------
    result : Path
        Result of a flight, NAME.nc.
    others : Path
        Results of more flights, to be compared with it.
    out : Path
        Folder for report.html, verdict.json and figures/; that of the result if not given. For
        comparison.html, the working folder.
    force : bool
        Replace files that are there already; without it they are kept.
    no_figures : bool
        Write no files of figures; those in the report are drawn in any case.
    format : list
        Format of these files, png and svg if not given; may be repeated: --format pdf --format png.
    no_titles : bool
        Draw these files without titles, for a paper with captions.
    json : bool
        Print the verdict as JSON; of several flights a list of them.
    quiet : bool
        Print nothing but errors, and the JSON if asked for.
    """
    from rigidfleet.assessment import assess
    from rigidfleet.result import Result, write_file

    paths = [result, *others]
    records = [Result.load(path) for path in paths]
    if others:
        page = (out or Path()) / "comparison.html"
        if page.exists() and not force:
            raise taken(page)
    files = Files(out or (Path() if others else result.parent), records[0].mission.name)
    files.try_out()
    verdicts = [assess(record) for record in records]
    if json:
        found = [verdict.to_dict() for verdict in verdicts]
        console.print_json(found if others else found[0])
    files.make_folder()
    if others:
        labels = _labels(paths, records)
        if not (json or quiet):
            for label, verdict in zip(labels, verdicts, strict=True):
                console.out().print(f"{label}: {verdict.summary}", soft_wrap=True)
        _write_report(records, verdicts, page, labels=labels, quiet=quiet)
        if not (json or quiet):
            console.out().print(f"\nReport   {page}", soft_wrap=True)
    else:
        if not (json or quiet):
            console.out().print(verdicts[0])
        drawn = [] if no_figures else _of_formats(files.figures, format)
        made = [files.verdict, files.report, *drawn]
        kept = [] if force else [path for path in made if path.exists()]
        if files.verdict not in kept:
            write_file(files.verdict, (verdicts[0].json() + "\n").encode())
        left = [path for path in drawn if path not in kept]
        _draw(records[0], left, format, titles=not no_titles, quiet=quiet)
        if files.report not in kept:
            _write_report(records, verdicts, files.report, quiet=quiet)
        if not (json or quiet):
            console.out().print()
            _list(files)
        if kept and not quiet:
            console.err().print(
                f"{console.count(len(kept), 'file')} kept as before; --force makes them again"
            )
    return PASSED if all(verdict.passed for verdict in verdicts) else FAILED


@app.command(sort_key=7)
def replay(result: Path, /, *, out: Path | None = None, force: bool = False) -> int:
    """Write a flight as a page to be watched in a browser, and to be sent: it needs no network.

    Parameters
    ----------
    result : Path
        Result of a flight, NAME.nc.
    out : Path
        The page; replay.html beside the result if not given.
    force : bool
        Replace a page that is there already.
    """
    from rigidfleet.result import Result

    record = Result.load(result)
    page = out or Files(result.parent, record.mission.name).replay
    if page.exists() and not force:
        raise taken(page)
    _write_replay(record, page)
    console.out().print(f"Replay   {page}", soft_wrap=True)
    return PASSED


@app.command(sort_key=8)
def live(
    mission: str,
    /,
    *,
    out: Path | None = None,
    port: Annotated[int, Parameter(converter=_exact)] = 0,
    no_browser: bool = False,
) -> int:
    """Fly a mission's vehicles by hand, in the browser, in real time; each flight is saved when it ends.

    Parameters
    ----------
    mission : str
        A shipped mission or a mission file: its vehicles, formations, gains and obstacles.
    out : Path
        Folder for the files: NAME-live.nc and verdict.json; flights/NAME-live if not given. Where it is taken,
        a number is added, and nothing is replaced.
    port : int
        Port on this machine, which alone can reach it; any that is free if not given.
    no_browser : bool
        Only print the address.
    """
    from rigidfleet.kernel.engine.native import is_compiled
    from rigidfleet.mission import load_mission

    flown = load_mission(mission)
    if not is_compiled():
        console.err().print(console.COMPILING)
    from rigidfleet.assessment import assess
    from rigidfleet.result import write_file
    from rigidfleet.web.live import live as fly

    place = Files(out or Path("flights", f"{flown.name.removesuffix('-live')}-live"), "")
    place.try_out()

    def landed(result: Result) -> str:
        files = Files(place.folder, result.mission.name).make_new_folder()
        result.save(files.result)
        verdict = assess(result)
        write_file(files.verdict, (verdict.json() + "\n").encode())
        console.out().print(verdict)
        console.out().print()
        _list(files)
        return f"It is saved in {files.result}."

    def ready(url: str) -> None:
        console.out().print(f"Flying {flown.name} at {url}", soft_wrap=True)
        console.err().print("Ctrl-C ends the flight, and so does closing its page")

    with _heeding_interrupts():
        fly(flown, port=port, browser=not no_browser, ready=ready, landed=landed)
    return PASSED


def _ask(name: str) -> tuple[str, dict[str, Any]]:
    """Name and contents of a new mission, asked for one by one; an empty answer takes what is offered."""
    from rigidfleet.formation.shapes import SHAPES, agents_taken, slots
    from rigidfleet.mission import draft

    def answer(question: str, offered: str, take: Callable[[str], Any]) -> Any:
        while True:
            try:
                text = (
                    console.err().input(f"{question} [{offered}]: ", markup=False).strip()
                    or offered
                )
            except EOFError:
                raise RigidfleetError("No answer, so nothing is written. Give options.") from None
            try:
                return take(text)
            except ValueError as error:
                console.err().print(f"  {error}", style="yellow")

    def number(text: str) -> float:
        value = _number(text)
        if not value > 0:
            raise ValueError("It must be positive.")
        return value

    def known(text: str) -> str:
        draft.shape_known(text)
        return text

    def count(text: str) -> int:
        slots(shape, [1.0] * SHAPES[shape].sizes, _whole(text))
        return _whole(text)

    def point(text: str) -> tuple[float, ...]:
        values = tuple(map(_number, text.replace(",", " ").split()))
        if len(values) != 3:
            raise ValueError("Three numbers: x, y, z.")
        return values

    name = name or answer("Name", "mission", str)
    shape = answer(f"Shape ({', '.join(SHAPES)})", "triangle", known)
    asked: dict[str, Any] = {"shape": shape}
    usual = draft.agents_for(shape)
    if len(SHAPES[shape].agents) > 1:
        asked["agents"] = answer(f"Vehicles ({agents_taken(shape)})", str(usual), count)
    asked["size"] = [answer("Edge length [m]", f"{draft.SIZE:g}", number)]
    asked["mass"] = answer("Mass of each [kg]", f"{draft.MASS:g}", number)
    there = " ".join(f"{x:g}" for x in draft.WAYPOINT)
    waypoint = answer("Fly to x y z [m]", there, point)
    if waypoint != draft.WAYPOINT:  # of which a large shape takes a higher one
        asked["waypoints"] = [waypoint]
    return name, asked


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"'{text}' is no number.") from None


def _whole(text: str) -> int:
    try:
        return int(text)  # every digit of a large one counts
    except ValueError:
        number = _number(text)
    if not (math.isfinite(number) and number == round(number)):
        raise ValueError(f"'{text}' is no whole number.")
    return int(number)


@app.command(sort_key=9)
def sweep(
    mission: str,
    /,
    *,
    vary: list[str] | None = None,
    runs: Annotated[int | None, Parameter(converter=_exact)] = None,
    seed: Annotated[int | None, Parameter(converter=_exact)] = None,
    out: Path | None = None,
    force: bool = False,
    final_states: bool = False,
    workers: Annotated[int | None, Parameter(converter=_exact)] = None,
    cluster: str | None = None,
    summary: bool = False,
    map_: Annotated[tuple[str, str] | None, Parameter(name="--map")] = None,
    metric: str = "",
    no_figures: bool = False,
    format: list[Format] | None = None,
    no_titles: bool = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Fly a mission many times, varied: how many flights pass, and what makes others fail.

    Stopped at any moment, even by kill -9, the same command goes on where it was.

    Parameters
    ----------
    mission : str
        A mission, a sweep file, or the folder of a sweep, to go on with it.
    vary : str
        What varies: "PATH = KIND(NUMBERS)", with += to add to and *= to scale what the mission has; may be
        repeated. KIND is normal, uniform, log-uniform, choice, grid, linspace or geomspace.
    runs : int
        Number of runs; one for each point of the grid if not given. More may be added later.
    seed : int
        Seed of the random numbers, 0 if not given.
    out : Path
        Folder for sweep.db, summary.json and figures/; sweeps/NAME if not given.
    force : bool
        Replace another sweep in that folder; without it, it is kept and nothing is flown.
    final_states : bool
        Evaluate where phases end alone: open-loop missions whose starts vary then fly by the thousand in a second.
    workers : int
        Processes on this machine; as many as it has cores if not given.
    cluster : str
        Address of a Dask scheduler, whose workers fly instead.
    summary : bool
        Fly nothing; sum up and draw again the sweep of a folder.
    map_ : str
        The two paths that the map is drawn over.
    metric : str
        What the map shows: success or a metric.
    no_figures : bool
        Draw no figures.
    format : list
        Format of the figures, png and svg if not given; may be repeated: --format pdf --format png.
    no_titles : bool
        Draw figures without titles, for a paper with captions.
    json : bool
        Print the summary as JSON.
    quiet : bool
        Print nothing but errors, and the JSON if asked for.
    """
    from rigidfleet.sweep import store
    from rigidfleet.sweep.summary import summarise

    if workers is not None and workers < 1:
        raise RigidfleetError(f"--workers = {workers}: must be at least 1.")
    if summary:
        folder = Path(mission)
        table = store.read(folder)
    else:
        asked, folder = _asked(mission, vary or [], runs, seed, out, final_states=final_states)
        watch = None if quiet else console.SweepWatch()
        try:
            with watch or nullcontext(), _heeding_interrupts():
                table = _fly_sweep(asked, folder, workers, cluster, force, watch)
        except KeyboardInterrupt:
            done = len(store.read(folder).run) if store.is_store(folder) else 0
            words = f"Interrupted: {done} of {asked.runs} runs are kept in {folder}"
            again = f"Go on by: rigidfleet sweep {folder}"
            console.err().print(f"{words}\n{again}", style="yellow", soft_wrap=True)
            return INTERRUPTED
    found = summarise(table)
    from rigidfleet.result import write_file

    write_file(folder / "summary.json", (found.json() + "\n").encode())
    if json:
        console.print_exactly(found.json() + "\n")
    elif not quiet:
        console.print_table(found)
    drawn: list[Path] = []
    if not no_figures:
        from rigidfleet.sweep.figures import plot

        shown = console.err().is_interactive and not quiet
        with console.err().status("Drawing the figures") if shown else nullcontext():
            drawn = plot(
                table, folder / "figures", formats=format or _DRAWN, over=map_ or (), metric=metric,
                titles=not no_titles,
            )  # fmt: skip
    if not (json or quiet):
        console.out().print(f"\nRuns     {folder / store.FILE}", soft_wrap=True)
        console.out().print(f"Summary  {folder / 'summary.json'}", soft_wrap=True)
        if drawn:
            text = f"Figures  {drawn[0].parent}{os.sep} ({console.count(len(drawn), 'file')})"
            console.out().print(text, soft_wrap=True)
    return PASSED


def _asked(
    what: str,
    vary: list[str],
    runs: int | None,
    seed: int | None,
    out: Path | None,
    *,
    final_states: bool,
) -> tuple[Sweep, Path]:
    """The sweep that is asked for, and its folder."""
    from rigidfleet.mission import mission_names
    from rigidfleet.sweep import Sweep, store
    from rigidfleet.sweep.definition import is_sweep_file

    if store.is_store(Path(what)):
        if vary or seed is not None or out is not None or final_states:
            raise RigidfleetError(
                f"{what}: is a sweep already, and goes on as it is. Remove --vary, --seed, --final-states and --out."
            )
        found = store.read_sweep(Path(what))
        found.runs = runs or found.runs
        return found, Path(what)
    evaluate: Literal["final"] | None = "final" if final_states else None
    if what not in mission_names() and is_sweep_file(what):
        found = Sweep.load(what, more=vary, runs=runs, seed=seed, evaluate=evaluate)
    else:
        found = Sweep.of(
            what,
            vary,
            runs=runs,
            seed=seed or 0,
            evaluate=evaluate or "flight",
            origin="rigidfleet sweep",
        )
    return found, out or Path("sweeps", found.name)


def _fly_sweep(
    asked: Sweep,
    folder: Path,
    workers: int | None,
    cluster: str | None,
    force: bool,
    watch: console.SweepWatch | None,
) -> Any:
    """Fly a sweep; returns the table of its rows."""
    from rigidfleet.kernel.engine.native import is_compiled
    from rigidfleet.sweep import fly

    if watch is not None and not is_compiled():
        watch.compiling()
    return fly(
        asked,
        folder,
        workers=workers,
        cluster=cluster,
        replace=force,
        progress=None if watch is None else watch.update,
    )


# -- flying ------------------------------------------------------------------------------------------


def _fly(mission: Mission, watch: console.FlightWatch | None) -> tuple[Result, bool]:
    """Result of a mission, and whether the flight was interrupted."""
    from rigidfleet.kernel.engine.native import is_compiled

    if watch is not None and not is_compiled():
        watch.compiling()
    from rigidfleet.simulation.flight import FlightInterrupted, simulate

    try:
        with _heeding_interrupts():
            return simulate(mission, progress=None if watch is None else watch.update), False
    except FlightInterrupted as stop:
        return stop.result, True


@contextmanager
def _heeding_interrupts() -> Generator[None]:
    """Ctrl-C inside the compiler may come out of it as any error: make it Ctrl-C again."""
    interrupted = False

    def note(*_: object) -> None:
        nonlocal interrupted
        interrupted = True
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield
    except Exception:
        if interrupted:
            raise KeyboardInterrupt from None
        raise
    finally:
        signal.signal(signal.SIGINT, before)


def _of_formats(figures: Iterable[Path], formats: Iterable[Format] | None) -> list[Path]:
    """Those of the figures' files that are of the formats asked for."""
    kinds = {f".{kind}" for kind in formats or _DRAWN}
    return [path for path in figures if path.suffix in kinds]


def _draw(
    result: Result,
    figures: Iterable[Path],
    kinds: Iterable[Format] | None,
    *,
    titles: bool,
    quiet: bool = False,
) -> None:
    """Draw figures, each to the file of its name, of which the flight has something to show."""
    from rigidfleet.plotting import figure_names, plot

    names = figure_names(result)
    formats: dict[Path, list[str]] = {}
    for path in _of_formats(figures, kinds):
        if path.stem not in names:
            continue
        formats.setdefault(path.with_suffix(""), []).append(path.suffix[1:])
    shown = console.err().is_interactive and not quiet
    with console.err().status("Drawing the figures") if shown else nullcontext() as status:
        for n, (path, wanted) in enumerate(formats.items(), start=1):
            if status is not None:
                status.update(f"Drawing figure {n} of {len(formats)}: {path.name}")
            plot(result, path.parent, names=[path.name], formats=wanted, titles=titles)


def _write_report(
    records: list[Result],
    verdicts: list[Verdict],
    path: Path,
    *,
    labels: list[str] | None = None,
    quiet: bool = False,
) -> None:
    """Write the page of a flight, or of several."""
    from rigidfleet.reporting import report as write

    shown = console.err().is_interactive and not quiet
    with console.err().status("Writing the report") if shown else nullcontext():
        write(records, path, labels=labels, verdicts=verdicts)


def _write_replay(result: Result, path: Path) -> None:
    """Write the page that plays a flight."""
    from rigidfleet.web.replay import replay as write

    write(result, path)


def _labels(paths: list[Path], records: list[Result]) -> list[str]:
    """What to call each of several flights: what tells them apart, and is short."""
    missions = [record.mission.name for record in records]
    stems = [path.stem for path in paths]
    folders = [str(path.parent / path.stem) for path in paths]
    return next((names for names in (missions, stems) if len({*names}) == len(names)), folders)


def _list(files: Files) -> None:
    """Print where the files of a flight are."""
    for what, path in (
        ("Result", files.result),
        ("Verdict", files.verdict),
        ("Table", files.table),
        ("Report", files.report),
        ("Replay", files.replay),
    ):
        if path.exists():
            console.out().print(f"{what:8} {path}", soft_wrap=True)
    drawn = [path for path in files.figures if path.exists()]
    if drawn:
        text = f"Figures  {drawn[0].parent}{os.sep} ({console.count(len(drawn), 'file')})"
        console.out().print(text, soft_wrap=True)


# -- a mission in words ------------------------------------------------------------------------------


def _facts(mission: Mission) -> dict[str, object]:
    """A mission in plain data."""
    from rigidfleet.mission import ending, goal

    return {
        "name": mission.name,
        "title": mission.title,
        "source": mission.source,
        "agents": mission.n_agents,
        "formations": list(mission.formations),
        "phases": [
            {"name": p.name, "kind": p.kind, "to": goal(p), "ends": ending(p), "control": p.control}
            for p in mission.phases
        ],
        "latest_end_s": mission.latest_end,
    }


def _own_fault(error: Exception) -> str:
    """What to say of an error that nobody has foreseen."""
    *_, at = traceback.extract_tb(error.__traceback__)
    text = f"{type(error).__name__} in {Path(at.filename).name}, line {at.lineno}: {error}".rstrip(
        ": "
    )
    return (
        f"{text}\n    this is a fault of rigidfleet, not of yours: please report it, with the file that led to it"
        " (python -X dev -m rigidfleet ... shows all of it)"
    )


def _usage(error: CycloptsError) -> str:
    """What is wrong with the command as typed."""
    from rigidfleet._renamed import successor

    command = " ".join(("rigidfleet", *(error.command_chain or ()), "--help"))
    text = str(error)
    if isinstance(error, UnusedCliTokensError):
        text = f"Unexpected: {' '.join(error.unused_tokens or ())}."
    if isinstance(error, UnknownOptionError) and (told := successor(error.token.keyword)):
        text = f"Unknown option: {error.token.keyword}; {told}."
    return f"{text}\n    see `{command}`"
