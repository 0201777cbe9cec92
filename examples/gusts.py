"""What gusts do to the constraint force, when each vehicle tracks its slot anyway.

In calm air, tracking alone moves the formation and the constraint force is idle. Gusts push each
vehicle differently. Four flights: calm; in gusts; in the same gusts by tracking alone (a
formation without edges); and by a constraint force on board that does not know the gusts. The
paper's law is told every external force and cancels it at once, which no vehicle can do; the last
flight shows what its stabilisation alone achieves.
"""

import numpy as np

import rigidfleet as rf
from rigidfleet import physics
from rigidfleet.formation.distance_geometry import distances
from rigidfleet.formation.graphs import complete_graph

COUNTED = 12.0  # [s] measurements start after this
DRAG = 0.25  # [N s/m] of each vehicle
WIND = np.array([2.0, 1.0, 0.0])  # [m/s] mean wind
GUST = 3.0  # [m/s] amplitude of each component's three waves
WAVES = ((0.7, 1.1, 0.3), (1.3, -0.6, 1.9), (2.9, 0.8, -1.2))  # [rad/s], and [rad/m] along x and y


def gusts(t, r, v):
    """Drag (N, 3) [N] against a wind that differs from place to place, smooth in time and space."""
    rise = np.clip((t - 1.0) / 2.0, 0.0, 1.0)
    air = np.tile(WIND, (len(r), 1))
    for axis in range(3):
        for rate, kx, ky in WAVES:
            phase = rate * t - kx * r[:, 0] - ky * r[:, 1] + 2.0 * axis
            air[:, axis] += GUST / len(WAVES) * np.sin(phase)
    return DRAG * (rise * rise * (3.0 - 2.0 * rise) * air - v)


def mission(**formation):
    """Three vehicles in a triangle of 4 m that fly 30 m in 20 s."""
    start = np.array([[1.0, 6.0, 3.0], [8.0, 3.0, 3.0], [7.0, 6.0, 3.0]])
    return rf.Mission.from_dict(
        {
            "schema_version": 1,
            "name": "gusts",
            "agents": {"mass": 1.0, "position": start, "thrust_limit": 23.6},
            "formations": {"triangle": {"shape": "triangle", "size": 4.0, **formation}},
            "phases": [
                {"kind": "establish", "formation": "triangle", "duration": 6.0},
                {"kind": "fly", "position": [35.0, 5.0, 10.0], "duration": 20.0},
            ],
        }
    )


class OnBoard:
    """Tracking plus the constraint force, computed 100 times a second from what a vehicle knows."""

    rate = 100.0  # [Hz]

    def __init__(self):
        self.edges = complete_graph(3)
        self.integral = np.zeros(3)  # of the constraint error [m s]
        self.peak = 0.0  # of its constraint force [N]

    def __call__(self, seen):
        """Input force (3, 3) [N]: the built-in tracking law and, once established, f_C on top."""
        m = seen.masses[:, None]
        error = seen.position - seen.reference_position
        error_rate = seen.velocity - seen.reference_velocity
        a = seen.reference_acceleration - 2.0 * error - 8.0**0.5 * error_rate
        f = m * (a + [0.0, 0.0, seen.gravity])
        if not seen.phase.startswith("fly"):
            return f
        held = physics.constraint_force(
            seen.position, seen.velocity, seen.masses, self.edges, 4.0,
            integral=self.integral, f_E=m * a,
        )  # fmt: skip
        self.integral = self.integral + held.c / self.rate
        if seen.t > COUNTED:
            self.peak = max(self.peak, float(np.linalg.norm(held.f_C, axis=1).max()))
        return f + held.f_C


def main():
    """Fly all four; return peak constraint force [N] and worst pair and slot errors [m] of each."""
    on_board = OnBoard()
    flights = {
        "calm": rf.simulate(mission()),
        "gusts": rf.simulate(mission(), force=gusts),
        "gusts, tracking alone": rf.simulate(mission(edges=[]), force=gusts),
        "gusts, f_C on board": rf.simulate(
            mission(edges=[]), force=gusts, controller=on_board, rate=on_board.rate
        ),
    }
    numbers = {}
    print(f"{'':>22}  peak f_C   pair error   slot error   peak thrust")
    for name, result in flights.items():
        flying = result.time > COUNTED
        r = result.position[flying]
        pairs = np.array([distances(at, complete_graph(3)) for at in r])
        f_C = float(np.linalg.norm(result.constraint_force[flying], axis=2).max())
        if name.endswith("on board"):  # there it is part of the input
            f_C = on_board.peak
        pair = float(np.abs(pairs - 4.0).max())
        slot = float(np.linalg.norm(r - result.slot_position[flying], axis=2).max())
        thrust = float(result.thrust[flying].max())
        numbers[name] = {"f_C": f_C, "pair": pair, "slot": slot, "thrust": thrust}
        print(f"{name:>22}  {f_C:8.1e} N {pair:8.1e} m   {slot:8.1e} m   {thrust:6.2f} N")
    return numbers


if __name__ == "__main__":
    main()
