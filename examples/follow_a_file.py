"""A formation follows a trajectory that another program made.

The other program is stood in for by a few lines that write a table of setpoints: a figure eight,
twenty samples a second. The mission takes the formation to its first point, follows it, and
holds. `check` says that the file is too fast for the mission's limits, and names the least
duration; with that, the mission passes.
"""

import math
import tempfile
from pathlib import Path

import numpy as np

import rigidfleet as rf

LASTS = 12.0  # [s] of the file
MISSION = """
schema_version = 1
name = "eight"

[agents]
mass = 1.2                        # [kg]
radius = 0.25                     # [m]
thrust_limit = 26.0               # [N]
position = [[1.5, 0.0, 4.0], [-1.0, 1.2, 4.0], [-1.0, -1.2, 4.0]]

[limits]
separation = 0.5                  # [m]
acceleration = 3.0                # [m/s^2]

[formations.arrow]
slots = [[1.5, 0.0, 0.0], [-1.0, 1.2, 0.0], [-1.0, -1.2, 0.0]]
edges = "complete"

[[phases]]
kind = "establish"
formation = "arrow"
duration = 4.0

[[phases]]
kind = "fly"
position = [0.0, 0.0, 6.0]
duration = 6.0

[[phases]]
kind = "follow"
file = "eight.csv"
# duration

[[phases]]
kind = "hold"
duration = 2.0
"""


def table() -> str:
    """A figure eight of 8 m by 4 m, from rest to rest."""
    rows = ["time_s,x_m,y_m,z_m"]
    for t in np.arange(0.0, LASTS + 0.025, 0.05):
        s = t / LASTS
        angle = 2 * math.pi * s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3)
        x, y = 4.0 * math.sin(angle), 2.0 * math.sin(2 * angle)
        rows.append(f"{t:.3f},{x:.6f},{y:.6f},6.0")
    return "\n".join(rows) + "\n"


def main() -> None:
    """Check as the file is, slow it down as check says, fly, and judge."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "eight.toml")
        Path(folder, "eight.csv").write_text(table())
        path.write_text(MISSION)
        remark = next(r for r in rf.check(path).remarks if r.level == "fails")
        print(remark.text)
        least = float(remark.text.rsplit(" is ", 1)[1].split()[0])
        path.write_text(MISSION.replace("# duration", f"duration = {least}"))
        result = rf.simulate(path)
    verdict = rf.assess(result)
    print(verdict.summary)
    off = np.linalg.norm(result.position - result.slot_position, axis=2)
    print(f"tracking error at most {1e3 * np.nanmax(off):.3g} mm")
    print(f"trajectories kept in the result: {'trajectories' in result.mission.text}")


if __name__ == "__main__":
    main()
