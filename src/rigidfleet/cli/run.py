"""Fly a mission, and list the shipped ones: `run` and `missions`."""

from __future__ import annotations

import signal
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from rigidfleet.cli import console
from rigidfleet.cli.arguments import MissionName
from rigidfleet.cli.outputs import Files
from rigidfleet.errors import RigidfleetError

if TYPE_CHECKING:
    from rigidfleet.result import Result
from rigidfleet.cli.codes import FAILED, INTERRUPTED, PASSED

#: A format of figures.
Format = Literal["png", "svg", "pdf"]
#: Default formats of figures.
DRAWN: tuple[Format, ...] = ("png",)


def run(
    mission: MissionName,
    /,
    *,
    out: Path | None = None,
    force: bool = False,
    figures: Literal["few", "all"] = "few",
    no_figures: bool = False,
    format: list[Format] | None = None,
    no_titles: bool = False,
    width: float | None = None,
    replay: bool = False,
    csv: bool = False,
    csv_rate: float | None = None,
    flown: bool = False,
    abort_at: float | None = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Fly a mission: simulate it, evaluate it and draw its figures.

    Parameters
    ----------
    mission : str
        A shipped mission (see "rigidfleet missions") or a mission file.
    out : Path
        Folder for NAME.nc, verdict.json and figures/. Default: flights/NAME.
    force : bool
        Overwrite the files of an earlier flight. Without it, the command stops before the flight.
    figures : str
        Which to draw: few (summary and trajectory) or all that show something. Default: few.
    no_figures : bool
        Draw no figures; "rigidfleet report" can draw them later.
    format : list
        Format of the figures; may be repeated: --format pdf --format png. Default: png.
    no_titles : bool
        Draw figures without titles, for papers with captions.
    width : float
        Width of the figures [mm], such as 88 for one column of a paper; summary and formations keep their own.
    replay : bool
        Also write replay.html, which replays the flight in a browser.
    csv : bool
        Also write NAME.csv: setpoints of each agent, the reference with acceleration, jerk and yaw.
    csv_rate : float
        Setpoints per second [Hz] in NAME.csv. Default: the samples of the result.
    flown : bool
        Write the motion flown into NAME.csv instead of the reference.
    abort_at : float
        Abort the flight at this mission time [s], as "check --abort" plans it.
    json : bool
        Print the verdict as JSON.
    quiet : bool
        Print only errors, and JSON with --json.
    """
    if not csv and (csv_rate is not None or flown):
        raise RigidfleetError("--csv-rate and --flown say what --csv writes. Add --csv.")
    if csv_rate is not None and not csv_rate > 0.0:
        raise RigidfleetError(f"--csv-rate must be positive [Hz], not {csv_rate:g}.")
    check_width(width)
    from rigidfleet.mission import load_mission

    loaded = load_mission(mission)
    if abort_at is not None:
        data = loaded.to_dict()
        loaded = loaded.rewritten(data | {"abort": data.get("abort", {}) | {"at": abort_at}})
    files = Files(out or Path("flights", loaded.name), loaded.name)
    files.check_writable(replace=force)
    from rigidfleet.simulation.flight import FlightInterrupted, simulate

    with show_progress(None if quiet else console.FlightWatch()) as progress:
        try:
            result, interrupted = simulate(loaded, progress=progress), False
        except FlightInterrupted as stop:
            result, interrupted = stop.result, True
    verdict = files.save_result_and_verdict(result)
    if csv:
        try:
            result.to_csv(files.table, rate=csv_rate, flown=flown)
        except ValueError as error:
            raise RigidfleetError(f"--csv-rate: {error}.") from None
    console.show_verdict(verdict, json=json, quiet=quiet)
    what = "the complete flight is saved"
    if interrupted:
        what = "the flight so far is saved, marked incomplete,"
    else:
        try:
            if replay:
                write_replay(result, files.replay)
            if not no_figures:
                paths = files.list_figure_paths(figures, format or DRAWN)
                write_figures(result, paths, quiet=quiet, titles=not no_titles, width=width)
        except KeyboardInterrupt:
            interrupted = True
    if not (json or quiet):
        files.print_paths()
    if interrupted:
        words = f"Interrupted: {what} in {files.result}"
        console.err().print(words, style="yellow", soft_wrap=True)
        return INTERRUPTED
    return PASSED if verdict.passed else FAILED


def missions(
    *, print_: Annotated[MissionName, Parameter(name="--print")] = "", schema: bool = False
) -> int:
    """List the shipped missions, in groups.

    Parameters
    ----------
    print_ : str
        Print the file of this mission instead, as a start for your own.
    schema : bool
        Print the JSON schema of mission files instead, for editors.
    """
    from rigidfleet.mission import json_schema, mission_text
    from rigidfleet.mission.text import FIRST, GROUPS

    if print_ and schema:
        raise RigidfleetError("--print and --schema cannot be combined. Give one of them.")
    if print_:
        console.print_exactly(mission_text(print_))
    elif schema:
        console.print_json(json_schema())
    else:
        import tomllib

        from rigidfleet._common.facts import FactTable, Row

        def row(mission: str) -> Row:
            head = tomllib.loads(mission_text(mission))
            return Row((f"  {mission}", head.get("title"), head.get("source")))

        rows = [
            x for group, names in GROUPS.items() for x in (Row((group, "", "")), *map(row, names))
        ]
        heads = ("mission", "what it shows", "in the paper")
        first = f"\nLook first at {', '.join(FIRST)}: rigidfleet run {FIRST[0]}"
        console.out().print(FactTable(heads, rows, heads))
        console.out().print(first, soft_wrap=True)
    return PASSED


@contextmanager
def show_progress(
    watch: console.FlightWatch | console.SweepWatch | None,
) -> Generator[Callable[..., None] | None]:
    """Show what is computed in this context, and heed interrupts; what is entered receives the progress."""
    from rigidfleet.kernel.engine.native import has_machine_code

    with watch or nullcontext(), raise_interrupts():
        if watch is not None and not has_machine_code():
            watch.announce_compilation()
        yield None if watch is None else watch.update


@contextmanager
def raise_interrupts() -> Generator[None]:
    """Raise KeyboardInterrupt on Ctrl-C even if the compiler turns it into another exception."""
    interrupted = False

    def note_and_raise(*_: object) -> None:
        nonlocal interrupted
        interrupted = True
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note_and_raise)
    try:
        yield
    except Exception:
        if interrupted:
            raise KeyboardInterrupt from None
        raise
    finally:
        signal.signal(signal.SIGINT, before)


def check_width(width: float | None) -> None:
    """Raise an error if figures cannot have this width [mm]."""
    from rigidfleet.plotting import WIDTHS

    if width is not None and not WIDTHS[0] <= width <= WIDTHS[1]:
        raise RigidfleetError("--width must be {:g} to {:g} [mm], not {:g}.".format(*WIDTHS, width))


def write_figures(result: Result, paths: Iterable[Path], *, quiet: bool, **look: Any) -> None:
    """Draw the figures with these paths that apply to the flight, with `plot`'s ``look``."""
    from rigidfleet.plotting import figure_names, plot

    names = figure_names(result)
    formats: dict[Path, list[str]] = {}
    for path in paths:
        if path.stem in names:
            formats.setdefault(path.with_suffix(""), []).append(path.suffix[1:])
    shown = console.err().is_interactive and not quiet
    with console.err().status("Drawing the figures") if shown else nullcontext() as status:
        for n, (path, kinds) in enumerate(formats.items(), start=1):
            if status is not None:
                status.update(f"Drawing the figures: {path.name}, {n} of {len(formats)}")
            plot(result, path.parent, names=[path.name], formats=kinds, **look)


def write_replay(result: Result, path: Path) -> None:
    """Write the page that replays a flight."""
    from rigidfleet.web.replay import replay as write

    write(result, path)
