"""Why a flight failed is said from Python, with the facts of its failed checks."""

import sys
from pathlib import Path

import numpy as np

import rigidfleet as rf

sys.path.insert(0, str(Path(__file__).parents[1]))
from sample_flights import swarm

result = swarm(4, 10.0)
facts = [check.fact for check in rf.assess(result).checks if not check.passed]
lines = [f"{f.name}: {f.value:.3g} {f.unit} ({f.bound}) at {f.when:.2f} s, {f.who}" for f in facts]
i, j = result.edges.T
lengths = np.linalg.norm(result.position[:, i] - result.position[:, j], axis=2)
rest = np.array([result.mission.formation_distances("sheet")])
(last,) = np.flatnonzero(result.time == 10.0)
worst = np.abs(lengths - rest)[last].max()
assert any(line.startswith(f"distances: {worst:.3g} m (<= ") for line in lines), lines
assert all(
    (" at " in line and "agent" in line) or "round" in line or "establish" in line for line in lines
)
assert len(lines) == str(rf.assess(result).summary).count("\n- ")
print("done")
