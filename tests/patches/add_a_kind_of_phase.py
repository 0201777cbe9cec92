"""The made-up kind "climb" is checked, flown, judged, exported and shown, and has its section."""

import importlib
import sys
from pathlib import Path

import numpy as np

import rigidfleet as rf
from rigidfleet.mission import Mission

sys.path.insert(0, "docs")
tables = importlib.import_module("tables")  # of the patched copy

mission = Mission.from_dict(
    {
        "schema_version": 1, "name": "climbing", "smoothness": "jerk", "output_step": 0.1,
        "agents": {"mass": 1.0, "radius": 0.2, "position": [[0, -2, 5], [0, 2, 5], [3, 0, 5]]},
        "formations": {"line": {"shape": "line", "size": 2.0}}, "limits": {"speed": 2.0},
        "phases": [
            {"kind": "establish", "formation": "line", "blend": 8.0, "duration": 10.0},
            {"kind": "climb", "name": "up", "by": 6.0, "travel": 8.0, "duration": 10.0},
            {"kind": "climb", "name": "down", "by": -2.0, "duration": 5.0},
        ],
    }
)  # fmt: skip
assert mission.phases[1].leads_to == "+6 m"

# Checked: where it leads, and a limit that it breaks
preflight = rf.check(mission)
up = preflight.planned_phases[1]
np.testing.assert_allclose(up.position[-1] - up.position[0], [[0.0, 0.0, 6.0]] * 3, atol=1e-9)
assert not [x for x in preflight.remarks if x.level == "fails"], preflight.remarks
hurried = mission.to_dict()
hurried["phases"][1] |= {"travel": 3.0}
fails = [x for x in rf.check(Mission.from_dict(hurried)).remarks if x.level == "fails"]
assert [x.topic for x in fails] == ["speed"]
assert "the least travel of this phase is 6.5" in fails[0].text

# Flown and judged: on a septic from rest to rest
result = rf.simulate(mission)
verdict = rf.assess(result)
assert verdict.passed, verdict.summary
assert [p.kind for p in result.phases] == ["establish", "climb", "climb"]
target = result.phases[1].target
assert target is not None
assert target["position"] == (up.position[0].mean(axis=0) + [0, 0, 6]).tolist()
x = np.clip((result.time - 10.0) / 8.0, 0.0, 1.0)
rise = 6.0 * x**4 * (35.0 - 84.0 * x + 70.0 * x**2 - 20.0 * x**3)
some = result.phase == 1
np.testing.assert_allclose(
    result.position[some, :, 2], result.position[some][0, :, 2] + rise[some, None], atol=1e-6
)

# With a time that follows from the limits: a septic from rest to rest is fastest half way, 35/16 of its mean speed
timed = mission.to_dict()
timed["phases"][1] |= {"travel": None, "duration": "auto"}
hurry = rf.simulate(Mission.from_dict(timed))
assert rf.assess(hurry).passed
length = hurry.phases[1].t_end - hurry.phases[1].t_start
np.testing.assert_allclose(length, 35.0 / 16.0 * 6.0 / 2.0, rtol=0.01)

# Recorded, exported and shown
out = Path("out")
out.mkdir()
result.save(out / "climbing.nc")
again = rf.Result.load(out / "climbing.nc")
assert again.mission.phases[1] == mission.phases[1]
assert rf.assess(again).json() == verdict.json()
export = rf.export(again, out / "climbing.skyc", "skyc")
assert export.deviation < 0.01
rf.plot(again, out, names=["trajectory"], formats=["svg"])
rf.report(again, out / "climbing.html")
assert "climb" in (out / "climbing.html").read_text()

# Documented
page = Path("docs/missions.md").read_text()
assert not tables.kinds_without_section(page)
assert "| `by` | number | required | height to climb [m]; < 0 descends |" in tables.render(page)
print("done")
