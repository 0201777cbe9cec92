"""Why a flight failed, asked from Python: what, how much, its limit, when and who."""

import sys
from pathlib import Path

import rigidfleet as rf

sys.path.insert(0, str(Path(__file__).parents[1]))
from sample_flights import swarm

result = swarm(4, 10.0)
failed = [check for check in rf.assess(result).checks if not check.passed]
facts = [check.fact for check in failed]
lines = [f"{f.name}: {f.value:.3g} {f.unit} ({f.bound}) at {f.when:.2f} s, {f.who}" for f in facts]
assert failed
for line, check in zip(lines, failed, strict=True):
    assert line.startswith(check.check.replace("_", " "))
    assert f"{check.worst:.3g}" in line
    assert f"{check.limit:.3g}" in line
print("done")
