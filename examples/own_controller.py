"""Fly your own controller: a plain Python function, called at a control rate like one on a vehicle.

A steady wind rises while the formation flies to its waypoint. Under the built-in law (an LQR without
integral action), the wind displaces the formation by wind / (m k1); a PID brings it back.
"""

import numpy as np

import rigidfleet as rf

WIND = np.array([1.0, -0.5, 0.0])  # [N] on each vehicle


def wind(t, r, v):
    """External force (N, 3) [N]: none before 8 s, all of it from 10 s on, a smooth rise between."""
    x = np.clip((t - 8.0) / 2.0, 0.0, 1.0)
    return np.tile(x * x * (3.0 - 2.0 * x) * WIND, (len(r), 1))


class PID:
    """Position control of each vehicle, with the reference's acceleration fed forward.

    Its poles are at -1.5 /s, three of them. The integral is clipped, lest it winds up.
    """

    def __init__(self, rate, k_p=6.75, k_d=4.5, k_i=3.375, most=1.0):
        self.step = 1.0 / rate  # [s]
        self.k_p, self.k_d, self.k_i = k_p, k_d, k_i  # [1/s^2], [1/s], [1/s^3]
        self.most = most  # [m s]
        self.integral = 0.0

    def __call__(self, seen):
        """Input force (N, 3) [N] of every vehicle, its weight included."""
        error = seen.position - seen.reference_position
        error_rate = seen.velocity - seen.reference_velocity
        self.integral = np.clip(self.integral + self.step * error, -self.most, self.most)
        a = seen.reference_acceleration + [0.0, 0.0, seen.gravity]
        a = a - self.k_p * error - self.k_d * error_rate - self.k_i * self.integral
        return seen.masses[:, None] * a


def main():
    """Fly once with the built-in law, once with the PID at 100 Hz; return the misses [m]."""
    mission = rf.load_mission("single-waypoint")
    built_in = rf.simulate(mission, force=wind)
    own = rf.simulate(mission, force=wind, controller=PID(rate=100.0), rate=100.0)
    misses = {}
    for name, result in {"built-in law": built_in, "own PID": own}.items():
        misses[name] = float(np.linalg.norm(result.cm[-1] - result.cm_reference[-1]))
        print(f"{name:>12}: {misses[name]:.4f} m off at t = {result.time[-1]:g} s")
    return misses


if __name__ == "__main__":
    main()
