"""A flight, or several side by side, as one HTML page for screen and print.

`report` writes the page. The first page of one flight is for those who decide: the verdict, what is planned, proved and
rehearsed, where things fall, and versions with digests. Then follow a safety table (distances, speed, altitude and
thrust, each with its limit), the figures and the mission; vehicles, gains and all checks are an appendix. The page
contains everything it needs and loads nothing from a network. Its templates are in this package; its only input is
results.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rigidfleet._common.arguments import as_path
from rigidfleet._common.files import write_file
from rigidfleet.errors import wrong_type
from rigidfleet.result import Result, as_result

if TYPE_CHECKING:
    from rigidfleet.assessment import Verdict

__all__ = ["report", "report_page"]


def report(
    results: Result | str | Path | Sequence[Result | str | Path],
    path: str | Path,
    *,
    labels: Sequence[str] | None = None,
    verdicts: Sequence[Verdict] | None = None,
    rehearsed: Sequence[str] = (),
    abort: Sequence[str] = (),
) -> None:
    """Write one flight, or several side by side, as one HTML page.

    Parameters
    ----------
    results : one or more flights, each a `Result` or the path of a saved one
    path : file of the page; an existing one is replaced, completely or not at all
    labels : name of each flight; by default the name of its mission
    verdicts : those of `assess`, if they have been computed already
    rehearsed, abort : of one flight, what drills have shown and how it is aborted, in sentences for the first page

    Raises
    ------
    ResultError
        The page cannot be written, or a result or the mission inside a result cannot be read.
    ValueError
        There is no result, or the number of labels or verdicts differs from that of results.
    TypeError
        ``results`` holds what is neither a flight nor a path.
    """
    target = as_path(path)
    page = report_page(results, labels=labels, verdicts=verdicts, rehearsed=rehearsed, abort=abort)
    write_file(target, page.encode())


def report_page(
    results: Result | str | Path | Sequence[Result | str | Path],
    *,
    labels: Sequence[str] | None = None,
    verdicts: Sequence[Verdict] | None = None,
    **beside: Sequence[str],
) -> str:
    """The page that `report` writes; ``beside`` are what was rehearsed, and how the flight is aborted."""
    from rigidfleet._common.templates import templates
    from rigidfleet.reporting.contents import page_contents
    from rigidfleet.web.policy import content_policy

    if isinstance(results, Result | str | Path):
        results = [results]
    elif not isinstance(results, Sequence):
        raise wrong_type("a flight, or several (a Result or the path of one, or a list)", results)
    flights = [as_result(result) for result in results]
    environment = templates("rigidfleet.reporting")
    style = environment.get_template("style.css").render()
    return environment.get_template("page.html").render(
        page_contents(flights, labels, verdicts, **beside),
        policy=content_policy(style=style),
        style=style,
    )
