"""Report and replay of a flight: `report` and `replay`."""

from __future__ import annotations

import json
from contextlib import nullcontext
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rigidfleet.cli import console
from rigidfleet.cli.codes import FAILED, PASSED
from rigidfleet.cli.outputs import Files, refuse_overwriting
from rigidfleet.cli.run import DRAWN, Format, check_width, write_figures, write_replay
from rigidfleet.errors import ResultError, RigidfleetError

if TYPE_CHECKING:
    from rigidfleet.assessment import Verdict
    from rigidfleet.mission import Mission
    from rigidfleet.result import Result


def report(
    result: Path,
    /,
    *others: Path,
    drill: Path | None = None,
    abort: Path | None = None,
    out: Path | None = None,
    force: bool = False,
    figures: Literal["few", "all"] = "few",
    no_figures: bool = False,
    format: list[Format] | None = None,
    no_titles: bool = False,
    width: float | None = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Evaluate and draw a flight again, and write a report to print or to send.

    With several flights, write one report that compares them: comparison.html.

    Parameters
    ----------
    result : Path
        Result of a flight, NAME.nc.
    others : Path
        Results of further flights to compare.
    drill : Path
        Folder of "sweep --drill": its first page says what the flight bears.
    abort : Path
        Folder of "check --abort --out": its first page says how the flight is aborted.
    out : Path
        Folder for report.html, verdict.json and figures/. Default: the folder of the result, or for
        comparison.html the current folder.
    force : bool
        Overwrite existing files. Without it they are kept.
    figures : str
        Which files to draw: few (summary and trajectory) or all that show something. Default: few.
    no_figures : bool
        Write no figure files. The report has its figures in any case.
    format : list
        Format of the figure files; may be repeated: --format pdf --format png. Default: png.
    no_titles : bool
        Draw the figure files without titles, for papers with captions.
    width : float
        Width of the figure files [mm], such as 88 for one column of a paper; summary and formations keep their own.
    json : bool
        Print the verdict as JSON; for several flights, a list of verdicts.
    quiet : bool
        Print only errors, and JSON with --json.
    """
    from rigidfleet._common.files import make_folder
    from rigidfleet.assessment import assess
    from rigidfleet.result import Result

    check_width(width)
    if others and (drill or abort):
        raise RigidfleetError("--drill and --abort are of one flight. Give one result.")
    paths = [result, *others]
    records = [Result.load(path) for path in paths]
    beside = {
        "rehearsed": _drill_sentences(drill, records[0].mission) if drill else [],
        "abort": _abort_sentences(abort, records[0].mission) if abort else [],
    }
    if others:
        page = (out or Path()) / "comparison.html"
        refuse_overwriting(page, force=force)
    files = Files(out or (Path() if others else result.parent), records[0].mission.name)
    files.check_folder_writable()
    verdicts = [assess(record) for record in records]
    if json:
        verdict_data = [verdict.to_dict() for verdict in verdicts]
        console.print_json(verdict_data if others else verdict_data[0])
    make_folder(files.folder)
    if others:
        labels = labels_of(paths)
        write_report(records, verdicts, page, quiet=quiet, labels=labels)
        if not (json or quiet):
            for label, verdict in zip(labels, verdicts, strict=True):
                console.out().print(f"{label}: {verdict.summary}")
            console.out().print(f"\nReport   {page} (open it in a browser)", soft_wrap=True)
    else:
        console.show_verdict(verdicts[0], quiet=json or quiet)
        drawn = [] if no_figures else files.list_figure_paths(figures, format or DRAWN)
        made = [files.verdict, files.report, *drawn]
        kept = [] if force else [path for path in made if path.exists()]
        if files.verdict not in kept:
            files.write_verdict(verdicts[0])
        left = [path for path in drawn if path not in kept]
        if files.report not in kept:
            write_report(records, verdicts, files.report, quiet=quiet, **beside)
        write_figures(records[0], left, quiet=quiet, titles=not no_titles, width=width)
        if not (json or quiet):
            files.print_paths()
        if kept and not quiet:
            console.err().print(
                f"{console.count_text(len(kept), 'existing file')} kept; use --force to overwrite"
            )
    return PASSED if all(verdict.passed for verdict in verdicts) else FAILED


def replay(result: Path, /, *, out: Path | None = None, force: bool = False) -> int:
    """Write a page that replays a flight in a browser, without a network connection.

    Parameters
    ----------
    result : Path
        Result of a flight, NAME.nc.
    out : Path
        Path of the page. Default: replay.html beside the result.
    force : bool
        Overwrite an existing page.
    """
    from rigidfleet.result import Result

    record = Result.load(result)
    page = out or Files(result.parent, record.mission.name).replay
    refuse_overwriting(page, force=force)
    write_replay(record, page)
    console.out().print(f"Replay   {page} (open it in a browser)", soft_wrap=True)
    return PASSED


def write_report(
    records: list[Result], verdicts: list[Verdict], path: Path, *, quiet: bool = False, **beside: list[str]
) -> None:  # fmt: skip
    """Write the report of one or several flights, with what stands ``beside`` them."""
    from rigidfleet.reporting import report as write

    shown = console.err().is_interactive and not quiet
    with console.err().status("Writing the report") if shown else nullcontext():
        write(records, path, verdicts=verdicts, **beside)


def _drill_sentences(folder: Path, mission: Mission) -> list[str]:
    """What a mission bears by its drill, fault by fault.

    Raises
    ------
    ResultError
        The folder has no drill, or that of another mission.
    """
    from rigidfleet.planning.timing import expand_mission
    from rigidfleet.sweep import store
    from rigidfleet.sweep.summary import summarise

    table = store.read(folder)
    outcome, path, own = summarise(table), folder / store.FILE, table.sweep.mission
    if not outcome.drill:
        raise ResultError(
            f"{path}: has no faults of the day. `rigidfleet sweep --drill` flies them."
        )
    if own.digest != mission.digest:  # a result has the ways that were planned for its mission
        _refuse_other_mission(path, expand_mission(own).digest, mission)
    return [*outcome.drill_sentences(), _name_and_digest_text(path)]


def _abort_sentences(folder: Path, mission: Mission) -> list[str]:
    """How a mission is aborted, from when and when not, and what follows if a vehicle does not hear the order.

    Raises
    ------
    ResultError
        The folder has no aborts, or those of another mission.
    """
    path = folder / "aborts.json"
    try:
        data = json.loads(path.read_bytes())
        digest, sentences = data["mission_sha256"], [*map(str, data["sentences"])]
    except (OSError, ValueError, LookupError, TypeError):
        raise ResultError(
            f"{path}: is no file of aborts of this version. `rigidfleet check --abort --out {folder}` writes it."
        ) from None
    _refuse_other_mission(path, digest, mission)
    return [*sentences, _name_and_digest_text(path)]


def _refuse_other_mission(path: Path, digest: str, mission: Mission) -> None:
    if digest != mission.digest:
        raise ResultError(
            f"{path}: is of another mission, SHA-256 {digest[:16]}, and the flight of {mission.digest[:16]}. Make it"
            " again with the mission of the flight."
        )


def _name_and_digest_text(path: Path) -> str:
    return f"{path.name}, SHA-256 {sha256(path.read_bytes()).hexdigest()}"


def labels_of(paths: list[Path]) -> list[str]:
    """Short labels that distinguish several flights: names of files, of folders, or both."""
    files = [path.stem for path in paths]
    folders = [path.absolute().parent.name for path in paths]
    both = [str(path.parent / path.stem) for path in paths]
    return next((names for names in (files, folders) if len({*names}) == len(names)), both)
