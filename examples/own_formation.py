"""Build a mission in Python: a skein of five unequal vehicles that flies, turns and closes up.

The dictionary has the keys of a mission file. It is checked as a file is, with every error at once.
"""

import numpy as np

import rigidfleet as rf


def skein(arm, angle_deg=35.0):
    """Slots (5, 3) [m] of a V that points along x: the leader, then two vehicles on each side."""
    back, side = arm * np.cos(np.deg2rad(angle_deg)), arm * np.sin(np.deg2rad(angle_deg))
    return np.array(
        [[0, 0, 0], [-back, side, 0], [-back, -side, 0],
         [-2 * back, 2 * side, 0], [-2 * back, -2 * side, 0]]
    )  # fmt: skip


def mission():
    """Five vehicles, the leader twice as heavy, that start in no order on the ground."""
    start = np.array([[0, 0, 0.3], [-2, 3, 0.3], [-3, -2, 0.3], [-6, 4, 0.3], [-5, -5, 0.3]])
    return rf.Mission.from_dict(
        {
            "schema_version": 1,
            "name": "skein",
            "title": "A skein of five unequal vehicles",
            "agents": {"mass": [2.0, 1.0, 1.0, 1.2, 1.2], "position": start, "thrust_limit": 30.0},
            "formations": {
                "wide": {"slots": skein(4.0)},
                "close": {"slots": skein(2.5)},
            },
            "lqr": {"S": [1e4, 1e3], "attitude": {"S": [1e5, 1e4]}},
            "obstacles": [{"kind": "ground"}],
            "limits": {"separation": 1.0, "speed": 8.0},
            "phases": [
                # Climb in the shape of the start, form the skein in the air, then go.
                {"kind": "fly", "position": [-3.0, 0.0, 6.0], "duration": 6.0},
                {"kind": "establish", "formation": "wide", "duration": 6.0},
                {"kind": "fly", "position": [20.0, 0.0, 10.0], "yaw_deg": 0.0, "duration": 10.0},
                {"kind": "turn", "yaw_deg": 60.0, "duration": 6.0},
                {"kind": "reshape", "formation": "close", "duration": 5.0},
                {"kind": "fly", "position": [30.0, 17.3, 10.0], "yaw_deg": 60.0, "duration": 8.0},
            ],
        }
    )


def main():
    """Fly it and print the verdict; return the result."""
    result = rf.simulate(mission())
    print(rf.assess(result).summary)
    print(f"peak thrust of each vehicle [N]: {result.thrust.max(axis=0).round(2)}")
    return result


if __name__ == "__main__":
    main()
