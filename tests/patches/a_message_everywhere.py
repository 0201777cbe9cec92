"""The mark of a broken limit has other words on console, notebook and page, and none says what it said before."""

import io
import re
import sys
from pathlib import Path
from typing import Any

from rich.console import Console

import rigidfleet as rf
from rigidfleet import plotting
from rigidfleet.reporting import html_page

sys.path.insert(0, str(Path(__file__).parents[1]))
from sample_flights import swarm

figures: Any = plotting
figures.rendered = lambda *_: {"svg": b"<svg/>"}  # none
result = swarm(4, 10.0)
verdict = rf.assess(result)
printed = io.StringIO()
console = Console(file=printed, width=200)
console.print(verdict)
for text in (printed.getvalue(), verdict._repr_html_(), html_page(result)):
    shown = re.sub("<[^>]*>", " ", text)
    assert "not kept" in shown
    assert "FAILED" not in shown
print("done")
