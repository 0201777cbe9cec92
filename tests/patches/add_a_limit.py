"""A made-up limit of constraint forces is judged or refused, and has its metric, row, line in a figure, and key."""

import sys
from pathlib import Path

import numpy as np
import pytest

import rigidfleet as rf
from rigidfleet.assessment import safety
from rigidfleet.cli import assess as assess_command
from rigidfleet.errors import ResultError
from rigidfleet.sweep.metrics import measure_metrics

sys.path.insert(0, str(Path(__file__).parents[1]))
from limit_readers import assert_limit_is_shown

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

# The check lists what is planned with its limit, and no forces, which no plan has.
limited = rf.Mission.from_dict(base | {"limits": {"constraint_force": 1.0, "speed": 0.5}})
paths = rf.check(limited).data()["paths"]
assert paths["speed"]["limit_m_s"] == 0.5
assert "constraint_force" not in paths
# Of curves that others made nobody knows forces: the limit is not offered, is refused, and one of a mission left out.
time, places = np.linspace(0.0, 4.0, 41), np.zeros((41, 3, 3)) + [[0.0], [2.0], [4.0]]
assert "constraint_force" not in assess_command._LIMITS
with pytest.raises(ResultError, match=r"limits\.constraint_force: is judged by forces"):
    rf.trajectories(time, places, limits={"constraint_force": 1.0})
verdict = rf.assess(rf.trajectories(time, places, mission=limited))
assert not [c for c in verdict.checks if c.check == "constraint_force"]

assert_limit_is_shown(result, "constraint_force", "N", 0.5 * greatest, "constraint_force")
print("done")
