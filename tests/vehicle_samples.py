"""Vehicles of other programs, for tests and benchmarks of quadrotors, and problems that give them forces.

`SCIPY_ARRAY_API=1 python tests/vehicle_samples.py tests/frozen_vehicles.json` writes what RotorPy and crazyflow make of
random states. It needs both (`make .venv/.vehicles`), and crazyflow needs the variable.
"""

from __future__ import annotations

import json
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from rigidfleet.kernel import fleet
from rigidfleet.kernel.engine import packing
from rigidfleet.kernel.problem import (
    OPEN,
    RIGID,
    Control,
    Problem,
    Vehicles,
    Workspace,
    graph,
    no_disturbance,
    workspace,
)
from rigidfleet.kernel.records import NO_TRAIL, Trail
from rigidfleet.mission import load_mission
from rigidfleet.planning.legs import leg_of
from rigidfleet.planning.plan import plan_phase
from rigidfleet.planning.reference import PhaseState

FROZEN = Path(__file__).with_name("frozen_vehicles.json")
G = 9.81
HALF = 0.70710678118  # as RotorPy writes the cosine of 45 deg
SQUARE = HALF * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])


def derivatives(
    flight: fleet.SampledFlight,
    S: np.ndarray,
    command: np.ndarray,
    air: np.ndarray | None = None,
) -> np.ndarray:
    """Derivatives (N, 17) of states by the equations of motion; commands (N, 4), in still air or one that moves."""
    from rigidfleet.kernel import quadrotor  # which loads the compiler

    out, none = np.empty_like(S), np.zeros(3)
    for i in range(len(S)):
        wind = none if air is None else air[i]
        quadrotor.write_quadrotor_derivative(
            S[i], command[i], i, flight.vehicles, flight.air, wind, none, np.eye(3), out[i]
        )
    return out


def lag(tau: float) -> tuple[float, ...]:
    """Motors of a first-order lag with this time constant [s]."""
    return (1.0 / tau, 0.0, 1.0 / tau, 0.0)


#: RotorPy 3.0.0, `vehicles/*_params.py`, with the gains of its `SE3Control`.
ROTORPY = {
    "hummingbird": fleet.VehicleDynamics(
        0.5, (3.65e-3, 3.68e-3, 7.03e-3), 0.17 * SQUARE, (1, -1, 1, -1), (0, 0, 5.57e-6), (0, 0, 1.36e-7),
        (1.19e-4, 2.32e-4), 3.39e-3, (0.5e-2, 0.5e-2, 1e-2), motor=lag(0.005), speed=(0, 1500),
        k_R=3 * [544.0], k_omega=3 * [46.64],
    ),
    "px4_sihsim_quadx": fleet.VehicleDynamics(
        1.0, (0.025, 0.025, 0.030), 0.17 * np.array([[1, -1, 0], [-1, 1, 0], [1, 1, 0], [-1, -1, 0]]),
        (-1, -1, 1, 1), (0, 0, 5e-6), (0, 0, 1e-7), c=(1e-2, 1e-2, 1e-2), motor=lag(0.05), speed=(0, 1000),
        k_R=3 * [310.0], k_omega=3 * [57.0],
    ),
    "crazyflie": fleet.VehicleDynamics(
        0.03, (1.43e-5, 1.43e-5, 2.89e-5), 0.043 * SQUARE, (1, -1, 1, -1), (0, 0, 2.3e-8), (0, 0, 7.8e-10),
        (10.2506e-07, 7.553e-07), motor=lag(0.072), speed=(0, 2500), k_R=3 * [310.0], k_omega=3 * [57.0],
    ),
}  # fmt: skip
#: 1 kg and 4 x 5.9 N as in the paper; the rest, which it leaves open, is chosen. Flown by RotorPy in a test.
PAPER = fleet.VehicleDynamics(
    1.0, (0.01, 0.01, 0.0187), 0.17 * SQUARE, (1, -1, 1, -1), (0, 0, 5.9e-6), (0, 0, 5.9e-6 * 0.0152),
    (1.16e-4, 1.16e-4), 0.0, (0.5e-2, 0.5e-2, 1e-2), motor=lag(0.02), speed=(0, 1000), k_R=3 * [544.0],
    k_omega=3 * [46.64],
)  # fmt: skip
#: Drones of crazyflow 0.4.0, whose parameters are read from it.
CRAZYFLOW = ("cf2x_L250", "cf2x_P250")


def from_crazyflow(given: dict[str, Any]) -> fleet.VehicleDynamics:
    """A vehicle from parameters of crazyflow's `first_principles`, which are in revolutions per minute."""
    unit = 2.0 * np.pi / 60.0
    powers = np.array([1.0, 1.0 / unit, 1.0 / unit**2])
    y, x, spin = given["mixing_matrix"] * np.array([[given["L"]], [-given["L"]], [1.0]])
    a, b, c, d = given["rotor_dyn_coef"]
    return fleet.VehicleDynamics(
        given["mass"], np.diag(given["J"]), np.stack([x, y, 0 * x], axis=1), spin, given["rpm2thrust"] * powers,
        given["rpm2torque"] * powers, drag=-np.diag(given["drag_matrix"]), rotor_inertia=given["prop_inertia"],
        motor=(a, b / unit, c, d / unit), speed=(0.0, 25000.0 * unit),
    )  # fmt: skip


def open_problem(vehicles: fleet.Quadrotors) -> Problem:
    """A problem without edges, whose input force ``control.force`` (N, 3) [N] can be overwritten between ticks."""
    m = vehicles.m.copy()
    n = len(m)
    return packing.example_of(Problem)._replace(
        vehicles=Vehicles(m, 1 / m, m.sum(), m.mean(), np.full(n, np.inf), False, vehicles.g),
        graph=graph(np.zeros((0, 2), dtype=np.int64), m),
        control=Control(OPEN, False, False, np.zeros((n, 3)), 0.0, 0.0, RIGID),
        disturbance=no_disturbance(m),
    )


def begun(
    vehicles: list[fleet.VehicleDynamics],
    r: Any = None,
    *,
    h: float = 1e-3,
    steps: int = 2,
    rows: int = 0,
) -> tuple[Problem, Workspace, fleet.SampledFlight, fleet.SampledState]:
    """Vehicles that hover side by side, or at r (N, 3), under a problem without edges that balances their weight."""
    fleet_ = fleet.quadrotor_arrays(vehicles, G)
    n = len(vehicles)
    flight = fleet.new_ideal_flight(fleet_, start=0.0, h=h, steps=steps)
    problem, work = open_problem(fleet_), workspace(n, 0)
    problem.control.force[:, 2] = fleet_.m * G
    S = fleet.hover_states(fleet_, 10.0 * np.eye(n, 3) if r is None else r, np.zeros((n, 3)))
    return problem, work, flight, with_trail(fleet.initial_state(flight, S, work), rows)


def with_trail(state: fleet.SampledState, rows: int) -> fleet.SampledState:
    """The state with a trail into which so many steps fit."""
    points, none = np.empty((rows, 5, 6 * len(state.S))), np.zeros((rows, 0))
    trail = Trail(np.empty((rows, 2)), points, none, np.zeros(0))
    return state._replace(trail=trail if rows else NO_TRAIL)


def planned(
    name: str, index: int, vehicle: fleet.VehicleDynamics, *, h: float = 2e-3, steps: int = 1, every: int = 1,
    rows: int = 0,
) -> tuple[Problem, Workspace, fleet.SampledFlight, fleet.SampledState]:  # fmt: skip
    """A phase of a shipped mission from the mission's start, flown by vehicles of one kind."""
    mission = load_mission(name)
    now = PhaseState(0.0, np.array(mission.agents.position), np.array(mission.agents.velocity))
    plan = plan_phase(mission, leg_of(mission, mission.phases[index], now))
    n = len(now.r)
    fleet_ = fleet.quadrotor_arrays([vehicle] * n, plan.problem.vehicles.g)
    flight = fleet.new_ideal_flight(fleet_, start=plan.start, h=h, steps=steps, every=every)
    work = workspace(n, len(plan.edges), solver=plan.problem.law.solver)
    S = fleet.hover_states(fleet_, now.r, now.v)
    return plan.problem, work, flight, with_trail(fleet.initial_state(flight, S, work), rows)


def random_states(vehicle: fleet.VehicleDynamics, n: int, seed: int) -> tuple[np.ndarray, ...]:
    """States (n, 17), commands (n, 4) [rad/s] and winds (n, 3) [m/s] far from hover."""
    rng = np.random.default_rng(seed)
    S = 3.0 * rng.normal(size=(n, fleet.STATES))
    S[:, 6:10] /= np.linalg.norm(S[:, 6:10], axis=1)[:, None]
    most = np.asarray(vehicle.speed)[1]
    S[:, 13:] = most * rng.random((n, 4))
    return S, most * rng.random((n, 4)), 4.0 * rng.normal(size=(n, 3))


# -- what the others make of it ------------------------------------------------------------------------


def rotorpy(name: str) -> Any:
    """RotorPy's vehicle of this name."""
    from importlib import import_module

    from rotorpy.vehicles.multirotor import Multirotor

    return Multirotor(import_module(f"rotorpy.vehicles.{name}_params").quad_params)


def rotorpy_derivative(
    model: Any, S: np.ndarray, command: np.ndarray, wind: np.ndarray
) -> np.ndarray:
    """Its derivative (17,) of a state; it puts the scalar of a quaternion last and has the wind among the states."""
    s = np.concatenate([S[:6], S[[7, 8, 9, 6]], S[10:13], wind, S[13:]])
    d = model._s_dot_fn(0.0, s, command)
    return np.concatenate([d[:6], d[[9, 6, 7, 8]], d[10:13], d[16:]])


def random_inputs(vehicle: fleet.VehicleDynamics) -> tuple[np.ndarray, np.ndarray]:
    """A hovering state (17,) and commands (50, 4), each held for 20 ms."""
    S = fleet.hover_states(
        fleet.quadrotor_arrays([vehicle], G), np.zeros((1, 3)), np.zeros((1, 3))
    )[0]
    scatter = np.random.default_rng(5).uniform(0.9, 1.1, size=(50, 4))
    return S, S[13:] * scatter


def rotorpy_flight(model: Any, S: np.ndarray, commands: np.ndarray) -> np.ndarray:
    """State after all commands, integrated by DOP853 to 1e-12."""
    from scipy.integrate import solve_ivp

    still = np.zeros(3)
    for command in commands:
        S = solve_ivp(
            lambda _, y, command=command: rotorpy_derivative(model, y, command, still), (0.0, 0.02), S,
            method="DOP853", rtol=1e-12, atol=1e-12,
        ).y[:, -1]  # fmt: skip
        S[6:10] /= np.linalg.norm(S[6:10])
    return S


def crazyflow_parameters(name: str) -> dict[str, Any]:
    """Parameters of crazyflow's `first_principles`."""
    import tomllib

    import crazyflow.dynamics as package

    path = Path(package.__file__).parent / "first_principles" / "params.toml"
    found = tomllib.loads(path.read_text())[name]
    return {k: np.asarray(v, dtype=float) if isinstance(v, list) else v for k, v in found.items()}


def crazyflow_derivative(given: dict[str, Any], S: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Its derivative (17,) of a state, with rotor speeds in revolutions per minute, as those of its parameters."""
    from crazyflow.dynamics.first_principles import dynamics

    unit = 2.0 * np.pi / 60.0
    names = (
        "mass",
        "L",
        "prop_inertia",
        "J",
        "rpm2thrust",
        "rpm2torque",
        "mixing_matrix",
        "drag_matrix",
        "rotor_dyn_coef",
    )
    parts = dynamics(
        S[:3], S[[7, 8, 9, 6]], S[3:6], S[10:13], command / unit, S[13:] / unit, gravity_vec=np.array([0, 0, -G]),
        J_inv=np.linalg.inv(given["J"]), **{name: given[name] for name in names},
    )  # fmt: skip
    r, q, v, omega, speeds = (np.asarray(x) for x in parts)
    return np.concatenate([r, v, q[[3, 0, 1, 2]], omega, speeds * unit])


def freeze() -> dict[str, Any]:
    """The contents of the file."""
    frozen: dict[str, Any] = {"rotorpy": version("rotorpy"), "crazyflow": version("crazyflow")}
    frozen["derivatives"], frozen["flights"] = {}, {}
    for name, vehicle in ROTORPY.items():
        model = rotorpy(name)
        S, command, wind = random_states(vehicle, 4, 1)
        d = [rotorpy_derivative(model, *row) for row in zip(S, command, wind, strict=True)]
        frozen["derivatives"][name] = {"S": S, "command": command, "wind": wind, "dS": np.array(d)}
        S, command = random_inputs(vehicle)
        end = rotorpy_flight(model, S, command)
        frozen["flights"][name] = {"S": S, "command": command, "end": end}
    for name in CRAZYFLOW:
        given = crazyflow_parameters(name)
        S, command, _ = random_states(from_crazyflow(given), 4, 2)
        d = [crazyflow_derivative(given, *row) for row in zip(S, command, strict=True)]
        given = {k: np.asarray(v) for k, v in given.items()}
        frozen["derivatives"][name] = {
            "S": S, "command": command, "wind": np.zeros((4, 3)), "dS": np.array(d), "parameters": given,
        }  # fmt: skip
    return frozen


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(json.dumps(freeze(), default=lambda x: x.tolist()) + "\n")
