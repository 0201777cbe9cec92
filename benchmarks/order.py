"""The order of avoidance: random scenes of `moving.py` as missions, with and without the clock and the body layer.

Eight points as a cube fly 24 m straight past two balls that they see within 10 m, with noise. All edges of the cube are
held by the constraint law. Contacts, edges and delays are those of the record, in continuous time where it is.

    python benchmarks/order.py [--scenes 20] [--seed 0]
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from moving import BALL, COURSE, EDGE, NOISE, RADIUS, RANGE, SPEEDS, SWERVE, Scene, feasible, scene

import rigidfleet as rf

#: What is on: the clock, the body layer; in words.
LAYERS = (
    (False, False, "barriers, guard"),
    (True, False, "clock, barriers, guard"),
    (False, True, "body, barriers, guard"),
    (True, True, "clock, body, barriers, guard"),
)
#: Mass of a point [kg], its braking [m/s^2], gravity [m/s^2], height of the course [m], time before it starts [s].
MASS, BRAKING, G, HEIGHT, STILL = 1.0, 5.0, 9.81, 50.0, 1.0


def mission(given: Scene, clock: bool, body: bool) -> rf.Mission:
    """A scene as a mission; obstacles start their way when the formation does."""
    centre = [0.0, 0.0, HEIGHT]
    duration = 1.5 * COURSE / given.speed  # of a smooth flight, which is fastest in its middle
    obstacles: list[dict[str, Any]] = []
    for place, velocity in zip(given.place, given.velocity, strict=True):
        start = place + centre - velocity * STILL
        obstacles.append(
            {"kind": "sphere", "centre": start.tolist(), "radius": BALL, "velocity": velocity.tolist()}
        )  # fmt: skip
    return rf.Mission.from_dict(
        {
            "schema_version": 1, "name": "order", "output_step": 0.1,
            "vehicles": {"point": {"model": "point", "mass": MASS, "thrust_limit": MASS * (G + BRAKING)}},
            "agents": {"vehicle": "point", "radius": RADIUS,
                       "position": {"shape": "cube", "size": EDGE, "count": 8, "centre": centre}},
            "formations": {"cube": {"shape": "cube", "size": EDGE}},
            "limits": {"separation_allowance": EDGE},
            "avoidance": {"clock": clock, "body": body, "separation": 0.1, "clearance": 0.05,
                          "sensing_range": RANGE, "sensing_noise": NOISE, "obstacle_acceleration": SWERVE},
            "obstacles": obstacles,
            "phases": [
                {"kind": "establish", "formation": "cube", "duration": STILL, "blend": 0.5},
                {"kind": "fly", "position": [COURSE, 0.0, HEIGHT], "duration": duration},
                {"kind": "hold", "duration": 4.0},
            ],
        }
    )  # fmt: skip


def row(scenes: list[Scene], clock: bool, body: bool) -> str:
    """Contacts, edge errors, delays and cost of a way of flying, as cells of the table."""
    contacts, least, edges, delays, arrived, cost = 0, np.inf, [], [], 0, []
    for each in scenes:
        begun = time.process_time()
        result = rf.simulate(mission(each, clock, body))
        cost.append(time.process_time() - begun)
        worst = [result.extreme(name) for name in ("separation", "clearance")]
        nearest = min(x.value for x in worst if x is not None)
        contacts, least = contacts + (nearest < 0.0), min(least, nearest)
        edges.append(float(np.nanmax(np.abs(result.constraint))))
        waited = result.extreme("clock")
        delays.append(0.0 if waited is None else waited.value)
        off = np.linalg.norm(result.position[-1] - result.slot_position[-1], axis=1).max()
        arrived += bool(result.complete and off < 0.3)
    return (
        f"{contacts} | {least:.3f} | {np.median(edges):.3f} | {max(edges):.3f} | {np.median(delays):.2f} |"
        f" {max(delays):.1f} | {arrived} | {np.median(cost):.2f} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", type=int, default=20, help="scenes of each kind")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    print(
        "| speed [m/s] | obstacles' speed | scenes | flown with | contacts | least distance [m] | edge error [m]"
        " | greatest [m] | delay, median [s] | longest [s] | arrive | flight [s] |"
    )
    print("|---" * 12 + "|")
    for speed, fastest in SPEEDS:
        scenes = [scene(8, speed, fastest, chosen.seed + k) for k in range(chosen.scenes)]
        scenes = [each for each in scenes if feasible(each)]
        for clock, body, words in LAYERS:
            cells = row(scenes, clock, body)
            print(f"| {speed:g} | to {fastest:g} | {len(scenes)} | {words} | {cells}", flush=True)


if __name__ == "__main__":
    main()
