"""A broken limit is marked by other words: on the console, in a notebook and on a page."""

import io
import re
import sys
from pathlib import Path

from rich.console import Console

import rigidfleet as rf
from rigidfleet import plotting
from rigidfleet.reporting import report_page

sys.path.insert(0, str(Path(__file__).parents[1]))
from sample_flights import swarm

setattr(plotting, "render_figure", lambda *_: {"svg": b"<svg/>"})  # noqa: B010
result, printed = swarm(4, 10.0), io.StringIO()
verdict = rf.assess(result)
Console(width=200, file=printed).print(verdict)
for text in (printed.getvalue(), verdict._repr_html_(), report_page(result)):
    shown = re.sub("<[^>]*>", " ", text)
    assert "not kept" in shown
    assert "FAILED" not in shown
print("done")
