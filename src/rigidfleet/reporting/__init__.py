"""A flight, or several side by side, as one HTML page that reads and prints well.

`report` writes it: the verdict first, then what a show operator asks (how close, how fast, how high, how
hard, each against its limit), the figures, the mission with its gains and what they mean, and versions.
The page holds everything itself and asks nothing of any network. Its words and tables are templates
beside this module; it sees nothing but results.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rigidfleet._arguments import as_path
from rigidfleet._files import write_file
from rigidfleet.errors import wrong_type
from rigidfleet.result import Result, as_result

if TYPE_CHECKING:
    from rigidfleet.assessment import Verdict

__all__ = ["html_page", "report"]


def report(
    results: Result | str | Path | Sequence[Result | str | Path],
    path: str | Path,
    *,
    labels: Sequence[str] | None = None,
    verdicts: Sequence[Verdict] | None = None,
) -> None:
    """Write one flight, or several side by side, as one HTML page.

    Parameters
    ----------
    results : one or more flights, each a `Result` or the path of one that was saved
    path : the page; a file that is there is replaced, whole or not at all
    labels : what to call each flight; the name of its mission by default
    verdicts : those of `assess`, if they are there already

    Raises
    ------
    ResultError
        The page cannot be written, or a result or the mission inside a result cannot be read.
    ValueError
        There is no result, or not one label and verdict for each.
    """
    target = as_path(path)
    write_file(target, html_page(results, labels=labels, verdicts=verdicts).encode())


def html_page(
    results: Result | str | Path | Sequence[Result | str | Path],
    *,
    labels: Sequence[str] | None = None,
    verdicts: Sequence[Verdict] | None = None,
) -> str:
    """The page that `report` writes."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    from rigidfleet.reporting.contents import contents
    from rigidfleet.web.policy import content_policy

    if isinstance(results, Result | str | Path):
        results = [results]
    elif not isinstance(results, Sequence):
        raise wrong_type("a flight, or several (a Result or the path of one, or a list)", results)
    flights = [as_result(result) for result in results]
    environment = Environment(
        loader=PackageLoader("rigidfleet.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    style = environment.get_template("style.css").render()
    return environment.get_template("page.html").render(
        contents(flights, labels, verdicts),
        policy=content_policy(style=style),
        style=style,
    )
