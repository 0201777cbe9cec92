"""A made-up limit of constraint forces is judged, has its metric, its row on the page, and its key in the document."""

import importlib
import sys
from pathlib import Path

import numpy as np

import rigidfleet as rf
from rigidfleet.assessment import safety
from rigidfleet.mission import json_schema
from rigidfleet.reporting import report_page
from rigidfleet.sweep import METRICS
from rigidfleet.sweep.metrics import measure_metrics

sys.path.insert(0, "docs")
tables = importlib.import_module("tables")  # of the patched copy

base = rf.load_mission("establish-triangle").to_dict()
greatest = np.linalg.norm(rf.simulate("establish-triangle").constraint_force, axis=2).max()
for limit, passes in ((1.01 * greatest, True), (0.5 * greatest, False)):
    result = rf.simulate(rf.Mission.from_dict(base | {"limits": {"constraint_force": limit}}))
    verdict = rf.assess(result)
    (check,) = [c for c in verdict.checks if c.check == "constraint_force"]
    assert check.passed == passes == verdict.passed, verdict.summary
    assert check.worst is not None
    assert greatest * (1 - 1e-9) <= check.worst <= 1.01 * greatest
    assert measure_metrics(result, verdict)["constraint_force"] == check.worst
    (row,) = [row for row in safety(result, verdict) if row.quantity == "constraint force"]
    assert row.passed == passes
    assert row.margin is not None
    assert (row.margin > 0.0) == passes

assert report_page(result).count('class="words">constraint force') == 2
assert METRICS["constraint_force"].unit == "N"
assert json_schema()["$defs"]["Limits"]["properties"]["constraint_force"]["description"]
assert "| `constraint_force` | number |" in tables.render(Path("docs/missions.md").read_text())
print("done")
