"""Report and replay of a flight: `report` and `replay`."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rigidfleet.cli import console
from rigidfleet.cli.outputs import Files, keep_existing

if TYPE_CHECKING:
    from rigidfleet.assessment import Verdict
    from rigidfleet.result import Result
from rigidfleet.cli.codes import FAILED, PASSED
from rigidfleet.cli.run import (
    Format,
    check_width,
    of_formats,
    write_figures,
    write_replay,
)


def report(
    result: Path,
    /,
    *others: Path,
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
    paths = [result, *others]
    records = [Result.load(path) for path in paths]
    if others:
        page = (out or Path()) / "comparison.html"
        keep_existing(page, force=force)
    files = Files(out or (Path() if others else result.parent), records[0].mission.name)
    files.try_out()
    verdicts = [assess(record) for record in records]
    if json:
        verdict_data = [verdict.to_dict() for verdict in verdicts]
        console.print_json(verdict_data if others else verdict_data[0])
    make_folder(files.folder)
    if others:
        labels = labels_of(paths, records)
        if not (json or quiet):
            for label, verdict in zip(labels, verdicts, strict=True):
                console.out().print(f"{label}: {verdict.summary}", soft_wrap=True)
        write_report(records, verdicts, page, labels=labels, quiet=quiet)
        if not (json or quiet):
            console.out().print(f"\nReport   {page}", soft_wrap=True)
    else:
        console.show_verdict(verdicts[0], quiet=json or quiet)
        drawn = [] if no_figures else of_formats(files.figures, figures, format)
        made = [files.verdict, files.report, *drawn]
        kept = [] if force else [path for path in made if path.exists()]
        if files.verdict not in kept:
            files.write_verdict(verdicts[0])
        left = [path for path in drawn if path not in kept]
        if files.report not in kept:
            write_report(records, verdicts, files.report, quiet=quiet)
        write_figures(records[0], left, quiet=quiet, titles=not no_titles, width=width)
        if not (json or quiet):
            files.show()
        if kept and not quiet:
            console.err().print(
                f"{console.count(len(kept), 'existing file')} kept; use --force to overwrite"
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
    keep_existing(page, force=force)
    write_replay(record, page)
    console.out().print(f"Replay   {page}", soft_wrap=True)
    return PASSED


def write_report(
    records: list[Result],
    verdicts: list[Verdict],
    path: Path,
    *,
    labels: list[str] | None = None,
    quiet: bool = False,
) -> None:
    """Write the report of one or several flights."""
    from rigidfleet.reporting import report as write

    shown = console.err().is_interactive and not quiet
    with console.err().status("Writing the report") if shown else nullcontext():
        write(records, path, labels=labels, verdicts=verdicts)


def labels_of(paths: list[Path], records: list[Result]) -> list[str]:
    """Short labels that distinguish several flights."""
    missions = [record.mission.name for record in records]
    stems = [path.stem for path in paths]
    folders = [str(path.parent / path.stem) for path in paths]
    return next((names for names in (missions, stems) if len({*names}) == len(names)), folders)
