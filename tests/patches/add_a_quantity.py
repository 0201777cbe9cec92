"""A made-up quantity of positions with a limit is in verdict, check, metrics, report, safety page, figures and help."""

import sys
from pathlib import Path

import numpy as np
import pytest

import rigidfleet as rf
from rigidfleet.assessment import safety
from rigidfleet.cli import assess as assess_command
from rigidfleet.foreign.curves import ASSUMED, Trajectories, curve_through_samples
from rigidfleet.simulation.as_logged import Doubts, judge_log
from rigidfleet.sweep.metrics import measure_metrics

sys.path.insert(0, str(Path(__file__).parents[1]))
from limit_readers import assert_limit_is_shown

base = rf.load_mission("establish-triangle").to_dict()
r = rf.simulate("establish-triangle").position
mass = np.ones(3) * base["agents"]["mass"]
apart = np.linalg.norm(r - np.average(r, axis=1, weights=mass)[:, None], axis=2)
greatest = apart.max()
for limit, passes in ((1.01 * greatest, True), (0.5 * greatest, False)):
    mission = rf.Mission.from_dict(base | {"limits": {"spread": limit}})
    result = rf.simulate(mission)
    verdict = rf.assess(result)
    (check,) = [c for c in verdict.checks if c.check == "spread"]
    assert check.passed == passes == verdict.passed, verdict.summary
    assert check.at_samples
    assert check.worst == pytest.approx(greatest, rel=1e-12)
    assert measure_metrics(result, verdict)["spread"] == check.worst
    (row,) = [row for row in safety(result, verdict) if row.quantity == "spread"]
    assert row.passed == passes
    assert row.margin == pytest.approx(limit - greatest)
    ahead = rf.check(mission)
    assert any(remark.topic == "spread" for remark in ahead.remarks) != passes
    planned = ahead.data()["paths"]["spread"]
    assert planned["limit_m"] == limit
    assert planned["spread_m"] == pytest.approx(greatest, rel=0.05)
    (words,) = [words for heading, words in ahead.describe() if heading == "spread"]
    assert f"limit <= {limit:.3g} m" in words

# Curves that others made are judged by it, a log with an interval that the noise of all vehicles widens.
time, steady = np.linspace(0.0, 4.0, 401), np.zeros((401, 3, 3)) + [[0.0], [2.0], [4.0]]
noisy = steady + np.random.default_rng(1).normal(0.0, 0.01, steady.shape)
verdict = rf.assess(rf.trajectories(time, steady, limits={"spread": 1.0}))
assert verdict.by_name["spread"].worst == pytest.approx(np.sqrt(12.0))
assert not verdict.passed
curves = tuple(curve_through_samples(time, noisy[:, i], None, "cubic", str) for i in range(3))
log = Trajectories(("a", "b", "c"), curves, ASSUMED["cubic"])
_, verdict = judge_log(log, None, Doubts(0.01), limits={"spread": 9.0})
low, high = verdict.by_name["spread"].interval or (np.inf, np.inf)
assert low < np.sqrt(12.0) < high < np.sqrt(12.0) + 0.05

assert "spread" in assess_command._LIMITS
assert_limit_is_shown(result, "spread", "m", 0.5 * greatest, "motion")
print("done")
