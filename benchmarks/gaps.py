"""Random walls with one gap: does a way through come of itself, wherever there is one?

``make avoidance`` runs it. Four vehicles may fly as a rectangle, or fold into a line. Each wall has one window of
random width, height, place and thickness, and fills everything else that the geofence leaves. An oracle that knows
nothing of the planner takes every shape and yaw in turn, marks the places of a fine grid in which all vehicles keep
their clearance, and floods them from one side of the wall: where it reaches the other side, there is a way.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.ndimage import binary_propagation

from rigidfleet.errors import MissionError
from rigidfleet.mission import Mission
from rigidfleet.planning.preview import preview_phases
from rigidfleet.planning.timing import complete_times
from rigidfleet.typing import Floats

RADIUS, CLEARANCE = 0.25, 0.2
START, GOAL = np.array([-12.0, 0.0, 8.0]), np.array([12.0, 3.0, 9.0])
FENCE = np.array([[-22.0, -14.0, 0.5], [22.0, 14.0, 16.0]])
SHAPES = {
    "rectangle": np.array([[1.5, 1.0, 0], [-1.5, 1.0, 0], [-1.5, -1.0, 0], [1.5, -1.0, 0]]),
    "line": np.array([[2.4, 0, 0], [0.8, 0, 0], [-0.8, 0, 0], [-2.4, 0, 0]]),
}
#: The oracle's grid: distance of places [m], of yaws [deg].
STEP, TURN = 0.1, 7.5


def wall(seed: int) -> list[dict[str, Any]]:
    """Four boxes round a window."""
    rng = np.random.default_rng(seed)
    width, height = rng.uniform(0.7, 4.0), rng.uniform(0.7, 2.0)
    y, z = rng.uniform(-10.0, 10.0), rng.uniform(3.0, 13.0)
    x = rng.uniform(-2.0, 2.0) + np.array([-0.5, 0.5]) * rng.uniform(0.1, 4.0)
    y, z = y + np.array([-0.5, 0.5]) * width, z + np.array([-0.5, 0.5]) * height
    (_, y0, z0), (_, y1, z1) = FENCE + [[-5.0], [5.0]]
    corners = {
        "left": ([x[0], y0, z0], [x[1], y[0], z1]),
        "right": ([x[0], y[1], z0], [x[1], y1, z1]),
        "below": ([x[0], y[0], z0], [x[1], y[1], z[0]]),
        "above": ([x[0], y[0], z[1]], [x[1], y[1], z1]),
    }
    return [
        {"kind": "box", "name": name, "min": low, "max": high}
        for name, (low, high) in corners.items()
    ]


def mission(boxes: Sequence[dict[str, Any]]) -> Mission:
    """The mission that asks for a way through the wall."""
    return Mission.from_dict(
        {
            "schema_version": 1,
            "name": "gap",
            "smoothness": "jerk",
            "agents": {"mass": 1.0, "radius": RADIUS, "position": SHAPES["rectangle"] + START},
            "formations": {name: {"slots": x} for name, x in SHAPES.items()},
            "limits": {
                "speed": 5.0,
                "acceleration": 3.0,
                "separation": 0.5,
                "geofence": {"min": FENCE[0], "max": FENCE[1]},
            },
            "obstacles": list(boxes),
            "phases": [
                {"kind": "establish", "formation": "rectangle", "blend": 1.0, "duration": 1.0},
                {"kind": "go", "position": GOAL, "clearance": CLEARANCE, "duration": "auto"},
            ],
        }
    )


def feasible(boxes: Sequence[dict[str, Any]]) -> bool:
    """Whether some shape passes the wall in some yaw: a flood of the grid from before the wall gets behind it.

    The grid reaches 4 m beyond the wall and the window. Outside of it there is room for every turn and change, and a
    shape that turns or changes as it passes needs more room than one that does not.
    """
    below, above = boxes[2:]
    window = [
        *zip(below["min"][:2], below["max"][:2], strict=True),
        (below["max"][2], above["min"][2]),
    ]
    low = np.maximum([a - 4.0 for a, _ in window], FENCE[0])
    high = np.minimum([b + 4.0 for _, b in window], FENCE[1])
    axes = [np.arange(a, b + 1e-9, STEP) for a, b in zip(low, high, strict=True)]
    for slots in SHAPES.values():
        for yaw in np.deg2rad(np.arange(0.0, 180.0, TURN)):
            c, s = np.cos(yaw), np.sin(yaw)
            turned = slots @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
            free = np.logical_and.reduce([clear(axes, p, boxes) for p in turned])
            before = np.zeros_like(free)
            before[0] = free[0]
            if binary_propagation(before, mask=free)[-1].any():
                return True
    return False


def clear(axes: list[Floats], offset: Floats, boxes: Sequence[dict[str, Any]]) -> Any:
    """Where a vehicle at an offset from the places of a grid keeps its clearance, and is inside the fence."""
    x = [a + o for a, o in zip(axes, offset, strict=True)]
    inside = [(a >= lo) & (a <= hi) for a, lo, hi in zip(x, *FENCE, strict=True)]
    free = inside[0][:, None, None] & inside[1][:, None] & inside[2]
    for box in boxes:
        out = [
            np.maximum(np.maximum(lo - a, a - hi), 0.0) ** 2
            for a, lo, hi in zip(x, box["min"], box["max"], strict=True)
        ]
        near = [np.flatnonzero(d < (RADIUS + CLEARANCE) ** 2) for d in out]
        i, j, k = near
        apart = out[0][i, None, None] + out[1][j, None] + out[2][k]
        free[np.ix_(*near)] &= apart >= (RADIUS + CLEARANCE) ** 2
    return free


def kept(flown: Mission, boxes: Sequence[dict[str, Any]]) -> float:
    """Least clearance [m] of the planned paths: dense samples, beside the proof."""
    least = np.inf
    for planned in preview_phases(flown)[0]:
        for box in boxes:
            r = planned.position
            out = np.maximum(np.maximum(np.array(box["min"]) - r, r - box["max"]), 0.0)
            least = min(least, float(np.linalg.norm(out, axis=2).min()) - RADIUS)
    return least


def main() -> None:
    """Plan and judge the walls."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--walls", type=int, default=100)
    asked = parser.parse_args()
    complete_times(mission([]))  # loads SciPy
    counts = {(a, b): 0 for a in (True, False) for b in (True, False)}
    times: dict[bool, list[float]] = {True: [0.0], False: [0.0]}
    least, missed, folded = np.inf, [], 0
    for seed in range(asked.walls):
        boxes = wall(seed)
        begin = time.process_time()
        try:
            flown = complete_times(mission(boxes))
        except MissionError:
            flown = None
        times[flown is not None].append(time.process_time() - begin)
        found, possible = flown is not None, feasible(boxes)
        counts[possible, found] += 1
        if flown is not None:
            least = min(least, kept(flown, boxes))
            folded += any(p.kind == "reshape" for p in flown.phases)
        elif possible:
            missed.append(seed)
    feasible_walls = counts[True, True] + counts[True, False]
    rows = {
        "walls": asked.walls,
        "feasible on the grid": feasible_walls,
        "of these found": counts[True, True],
        "found beside": counts[False, True],
        "folded": folded,
        "slowest found [s]": f"{max(times[True]):.2f}",
        "slowest refused [s]": f"{max(times[False]):.2f}",
        "least clearance [m]": f"{least:.3f}",
    }
    shown = Table(title="Random walls with one gap", title_justify="left")
    for column in rows:
        shown.add_column(column, justify="right")
    shown.add_row(*map(str, rows.values()))
    Console(width=130).print(shown)
    if missed:
        print("missed:", missed)


if __name__ == "__main__":
    main()
