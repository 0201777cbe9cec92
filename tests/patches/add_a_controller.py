"""The made-up law "soft", a tracking law whose pull is bounded, is checked, flown, judged and recorded."""

from pathlib import Path

import numpy as np
import pytest

import rigidfleet as rf
from rigidfleet.mission import Mission
from rigidfleet.preflight.margins import phase_gains

WIND, DRAG = 2.0, 0.05
mission = Mission.from_dict(
    {
        "schema_version": 1, "name": "softly", "smoothness": "jerk", "output_step": 0.1,
        "agents": {"mass": 1.0, "radius": 0.2, "position": [[0, -2, 5], [0, 2, 5], [3, 0, 5]]},
        "formations": {"line": {"shape": "line", "size": 2.0}}, "limits": {"speed": 2.0},
        "disturbances": {"wind": [WIND, 0, 0], "drag": DRAG},
        "phases": [
            {"kind": "establish", "formation": "line", "control": "soft", "duration": 10.0},
            {"kind": "fly", "position": [2, 0, 8], "control": "soft", "duration": "auto"},
            {"kind": "hold", "control": "soft", "duration": 30.0},
        ],
    }
)  # fmt: skip

# Checked as a law that tracks slots: with a least time, a proof and margins
preflight = rf.check(mission)
assert not [x for x in preflight.remarks if x.level == "fails"], preflight.remarks
assert preflight.planned_phases[1].leg.certificate is not None
assert phase_gains(mission, mission.phases[1], None).control == "tracking"

# Flown: in a steady wind, vehicles stand where k1 e / (1 + e) is the drag of a unit mass
result = rf.simulate(mission)
k1, _ = mission.tracking_gains
e = WIND * DRAG / k1
off = result.position[-1].mean(axis=0) - result.cm_reference[-1]
np.testing.assert_allclose(off, [e / (1.0 - e), 0.0, 0.0], atol=1e-4)

# Judged and recorded
verdict = rf.assess(result)
result.save("soft.nc")
again = rf.Result.load(Path("soft.nc"))
assert [p.control for p in again.phases] == ["soft"] * 3
assert rf.assess(again).json() == verdict.json()

# Nobody flies it where it is not written: vehicles that know each other by messages alone
with pytest.raises(rf.MissionError, match="has control 'soft', which no vehicle computes"):
    Mission.from_dict(mission.to_dict() | {"network": {}})
print("done")
