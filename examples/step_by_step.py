"""Fly a mission step by step: look at every second, change the target on the way, go on.

Run it: python examples/step_by_step.py
"""

import numpy as np

import rigidfleet as rf


def main() -> rf.Result:
    """Form the triangle of the narrow passage, then fly to other targets than the mission's."""
    flight = rf.Flight("narrow-passage")
    flight.begin()  # the mission's first phase
    while flight.advance(1.0):  # False at the phase's end
        r = flight.observe().position
        sides = np.linalg.norm(r - np.roll(r, 1, axis=0), axis=1)
        print(f"{flight.t:5.1f} s  sides of the triangle: {sides.round(3)} m")

    # In place of the mission's next phase, a target of our own ...
    flight.begin({"kind": "fly", "position": [8.0, 0.0, 12.0], "duration": 10.0})
    flight.advance(5.0)
    print(f"{flight.t:5.1f} s  half way at {flight.pose().r.round(1)} m: another target")

    # ... which gives way to another target half way. The reference continues without a jump.
    flight.begin({"kind": "fly", "position": [4.0, 6.0, 12.0], "yaw_deg": 90.0, "duration": 10.0})
    flight.advance()  # to the phase's end
    return flight.finish()


if __name__ == "__main__":
    print(rf.assess(main()).summary)
