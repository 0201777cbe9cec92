"""What shows a limit of a flight beside its verdict: figure, page, metric, schema and documents."""

import importlib
import sys
from pathlib import Path

from matplotlib.text import Text

from rigidfleet import Result, plotting
from rigidfleet.mission import json_schema
from rigidfleet.reporting import report_page
from rigidfleet.sweep import METRICS


def assert_limit_is_shown(result: Result, key: str, unit: str, limit: float, figure: str) -> None:
    """Assert that a flight's limit by its key is in a figure, on the page, among metrics and keys, and documented.

    To be called in a copy of the repository, whose documents are read.
    """
    sys.path.insert(0, "docs")
    tables = importlib.import_module("tables")
    (picture,) = plotting.plot(result, names=[figure])
    drawn = [text.get_text() for text in picture.findobj(Text)]
    words = f"limit {limit:g} {unit}"
    assert any(words in text.replace("\N{NO-BREAK SPACE}", " ") for text in drawn)
    assert report_page(result).count(f'class="words">{key.replace("_", " ")}') == 2
    assert METRICS[key].unit == unit
    assert json_schema()["$defs"]["Limits"]["properties"][key]["description"]
    assert f"| `{key}` | number |" in tables.render(Path("docs/missions.md").read_text())
