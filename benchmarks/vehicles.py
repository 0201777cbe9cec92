"""How fast quadrotors fly on one core, and how exact their steps are; beside RotorPy and crazyflow if installed.

``make bench`` runs it; ``--json`` keeps what it measured for `docs/performance.py`. A vehicle-step is one step of one
vehicle, with attitude control at 500 Hz on all sides. RotorPy (its SE(3) law, adaptive steps within each period) and
crazyflow (its attitude law, float32, Runge-Kutta) hover; our vehicles fly the passage of the cube, or hover. The
kernel's flight has no planning and no record; whole flights have all that `simulate` does. Times are CPU times: other
work on the machine counts less.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from datetime import date
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from vehicle_samples import ROTORPY, G, begun

from rigidfleet.kernel import fleet
from rigidfleet.kernel.engine import sampled
from rigidfleet.kernel.problem import workspace
from rigidfleet.kernel.records import FINISHED
from rigidfleet.mission import load_mission
from rigidfleet.planning.legs import leg_of
from rigidfleet.planning.plan import plan_phase
from rigidfleet.planning.reference import PhaseState
from rigidfleet.simulation.flight import simulate

VEHICLE = ROTORPY["px4_sihsim_quadx"]
RATE = 500.0  # of attitude control and formation law [Hz]
#: Shipped missions flown as a whole, and the goal of the first one [times real time].
WHOLE = ("cube-passage-quadrotors", "passage-quadrotors")
GOAL = 150.0
#: crazyflow must be imported before SciPy: a process of its own.
CRAZYFLOW = """
import sys, time
import numpy as np
from crazyflow.control import Control
from crazyflow.sim import Sim
n = int(sys.argv[1])
sim = Sim(n_drones=n, control=Control.attitude, freq=500, attitude_freq=500, integrator="rk4")
command = np.zeros((1, n, 4))
command[..., 3] = 0.0328 * 9.81
sim.reset()
best = 0.0
for _ in range(4):  # the first one compiles
    begun = time.process_time()
    sim.attitude_control(command)
    sim.step(500)
    sim.data.states.pos.block_until_ready()
    best = max(best, 500 * n / (time.process_time() - begun))
print("rate", best)
"""


def hover(n: int, h: float) -> float:
    """Vehicle-steps per second of n vehicles that hover, of 4 s of flight."""
    problem, work, flight, state = begun([VEHICLE] * n, h=h, steps=round(1.0 / (RATE * h)))
    start = time.process_time()
    sampled.fly_ticks(problem, work, flight, state, fleet.sampled_segment(n, 0, 4.0))
    return n * int(state.count[fleet.STEPS]) / (time.process_time() - start)


def passage(h: float) -> tuple[float, float, np.ndarray]:
    """The cube's passage, 90 s of eight vehicles: flown time, time spent in the kernel [s], positions at 10 Hz."""
    mission = load_mission("cube-passage")
    agents, state, spent, path = mission.agents, None, 0.0, []
    now = PhaseState(0.0, np.array(agents.position), np.array(agents.velocity))
    vehicles = fleet.quadrotor_arrays([VEHICLE] * len(now.r), G)
    flight = fleet.new_ideal_flight(vehicles, start=0.0, h=h, steps=round(1.0 / (RATE * h)))
    S = fleet.hover_states(vehicles, now.r, now.v)
    for phase in mission.phases:
        plan = plan_phase(mission, leg_of(mission, phase, now))
        m = len(plan.edges)
        work = workspace(len(S), m, solver=plan.problem.law.solver)
        integral = plan.initial_state()[6 * len(S) : 6 * len(S) + m]
        if state is None:
            state = fleet.initial_state(flight, S, work)
        state = fleet.state_under_problem(state, work, integral)
        times = plan.start + 0.1 * np.arange(1, round(10.0 * (plan.t_end - plan.start)) + 1)
        call = fleet.sampled_segment(len(S), m, plan.t_end, times)
        begun_at = time.process_time()
        status = sampled.fly_ticks(plan.problem, work, flight, state, call)
        spent += time.process_time() - begun_at
        if status != FINISHED:
            raise RuntimeError(f"the flight ended in phase {phase.name!r}")
        path.append(call.S[..., :3])
        S = state.S
        state.count[fleet.SAMPLES] = 0
        y = np.concatenate([S[:, :3].ravel(), S[:, 3:6].ravel(), state.integral])
        now = plan.state_at_end(plan.t_end, y, work)
    return now.t, spent, np.concatenate(path)


def whole(name: str) -> tuple[float, float]:
    """All of `simulate` of a shipped mission: flown time, time spent [s]."""
    start = time.process_time()
    result = simulate(name)
    return float(result.time[-1]), time.process_time() - start


def rotorpy(steps: int) -> float:
    """Vehicle-steps per second of RotorPy, its law at 500 Hz."""
    from rotorpy.controllers.quadrotor_control import SE3Control
    from rotorpy.vehicles.multirotor import Multirotor
    from rotorpy.vehicles.px4_sihsim_quadx_params import quad_params

    model, law = Multirotor(quad_params), SE3Control(quad_params)
    rest = {name: np.zeros(3) for name in ("x", "x_dot", "x_ddot")} | {"yaw": 0.0, "yaw_dot": 0.0}
    state = {
        "x": np.zeros(3), "v": np.zeros(3), "q": np.array([0.0, 0, 0, 1]), "w": np.zeros(3), "wind": np.zeros(3),
        "rotor_speeds": np.full(4, VEHICLE.rotor_speed_at(VEHICLE.m * G / 4)),
    }  # fmt: skip
    start = time.process_time()
    for k in range(steps):
        state = model.step(state, law.update(k / RATE, state, rest), 1.0 / RATE)
    return steps / (time.process_time() - start)


def crazyflow(n: int) -> float:
    """Vehicle-steps per second of crazyflow on one core."""
    environment = os.environ | {"SCIPY_ARRAY_API": "1", "JAX_PLATFORMS": "cpu"}
    pinned = f"import os; os.sched_setaffinity(0, {{{min(os.sched_getaffinity(0))}}})\n"
    with tempfile.TemporaryDirectory() as folder:  # MuJoCo writes a log into the current one
        done = subprocess.run(
            [sys.executable, "-c", pinned + CRAZYFLOW, str(n)], env=environment, cwd=folder, check=True,
            capture_output=True, text=True,
        )  # fmt: skip
    return float(done.stdout.split("rate")[-1])


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5, help="rounds, of which the median counts")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    arguments = parser.parse_args()
    rounds = arguments.rounds
    hover(1, 2e-3)  # compiled now, if not before
    rates: list[dict[str, Any]] = []

    def hovering(name: str, n: int, step: float | None, found: list[float]) -> None:
        rates.append({"name": name, "vehicles": n, "step": step, "rates": found})
        steps = "" if step is None else f", steps of {1e3 * step:g} ms"
        print(f"  {name}, {n} vehicles{steps}: {median(found):.3g}")

    print("vehicle-steps per second on one core, attitude control at 500 Hz")
    for n in (1, 8, 100):
        for h in (2e-3, 1e-3):
            hovering("rigidfleet", n, h, [hover(n, h) for _ in range(rounds)])
    if find_spec("rotorpy"):
        hovering("RotorPy", 1, None, [rotorpy(300) for _ in range(rounds)])
    if find_spec("crazyflow"):
        for n in (1, 8, 100):
            hovering("crazyflow, float32", n, 1.0 / RATE, [crazyflow(n)])
    flights = []
    exact = passage(2.5e-4)[2]
    for h in (2e-3, 1e-3):
        found = [passage(h) for _ in range(rounds)]
        flights.append(
            {"name": "the kernel alone, cube-passage", "step": h, "ratios": [t / spent for t, spent, _ in found],
             "goal": GOAL, "error": float(np.abs(found[0][2] - exact).max())}
        )  # fmt: skip
    for name in WHOLE:
        whole(name)  # compiled and read
        found = [whole(name) for _ in range(rounds)]
        flights.append(
            {"name": f"simulate(), {name}", "step": load_mission(name).autopilot.step, "error": None,
             "ratios": [t / spent for t, spent in found], "goal": GOAL if name == WHOLE[0] else None}
        )  # fmt: skip
    for row in flights:
        error = (
            "" if row["error"] is None else f", positions within {row['error']:.1e} m of 0.25 ms"
        )
        low, high = min(row["ratios"]), max(row["ratios"])
        print(
            f"{row['name']}, steps of {1e3 * row['step']:g} ms: {median(row['ratios']):.0f} times real time"
            f" ({low:.0f} to {high:.0f}){error}"
        )
    if arguments.json:
        machine = (
            f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
        )
        head = {"date": str(date.today()), "machine": machine, "version": version("rigidfleet")}
        arguments.json.write_text(
            json.dumps({"vehicles": head | {"rates": rates, "flights": flights}}, indent=1)
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
