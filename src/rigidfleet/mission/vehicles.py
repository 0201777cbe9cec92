"""Models of vehicles, with the source of every number, and the check of [vehicles].

The model of a quadrotor is that of RotorPy (Folk, Paulos, Kumar, "RotorPy: A Python-based Multirotor Simulator with
Aerodynamics for Education and Research", arXiv 2306.04485): rotor thrust and drag torque by the square of the speed,
motors with a first-order lag, drag of the rotors and of the body.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from rigidfleet.mission.findings import FindingCollector, near
from rigidfleet.mission.schema import Autopilot, Vehicle

_GRAVITY = 9.81
#: Least gravity in which quadrotors fly [m/s^2].
_LEAST_GRAVITY = 1.0


@dataclass(frozen=True)
class VehicleModel:
    """A vehicle with all its numbers. A point has mass, thrust limit and drag alone; its other numbers are zero.

    Attributes
    ----------
    point : whether it is a point mass that gives any force at once
    mass : [kg]
    inertia : about the body's axes [kg m^2]
    arm : distance of each rotor from the centre of mass [m]
    thrust_coefficient, torque_coefficient : k_f [N s^2/rad^2] and k_m [N m s^2/rad^2] of a rotor
    rotor_speed : least and greatest [rad/s]
    motor_time : time constants, up and down [s]
    rotor_drag, rotor_inflow, rotor_lift : k_d, k_z [kg/rad] and k_h [kg/m]
    body_drag : along the body's axes [N s^2/m^2]
    rotor_radius : [m]
    attitude_gains : k_R [1/s^2] and k_omega [1/s], per moment of inertia
    tilt_limit_deg : maximum tilt commanded [deg]
    thrust_limit : maximum thrust [N]; of a quadrotor that of its four rotors
    drag : force per velocity relative to the air [N s/m], for a point
    """

    point: bool
    mass: float
    inertia: tuple[float, ...] = (0.0, 0.0, 0.0)
    arm: float = 0.0
    thrust_coefficient: float = 0.0
    torque_coefficient: float = 0.0
    rotor_speed: tuple[float, ...] = (0.0, 0.0)
    motor_time: tuple[float, ...] = (0.0, 0.0)
    rotor_drag: float = 0.0
    rotor_inflow: float = 0.0
    rotor_lift: float = 0.0
    body_drag: tuple[float, ...] = (0.0, 0.0, 0.0)
    rotor_radius: float = 0.0
    attitude_gains: tuple[float, ...] = (0.0, 0.0)
    tilt_limit_deg: float = 90.0
    thrust_limit: float = math.inf
    drag: float = 0.0

    @property
    def rotor_limit(self) -> float:
        """Maximum thrust of one rotor [N]."""
        return self.thrust_coefficient * self.rotor_speed[1] ** 2

    @property
    def hover_speed(self) -> float:
        """Speed of the rotors in hover [rad/s]."""
        return math.sqrt(self.mass * _GRAVITY / 4.0 / self.thrust_coefficient)

    @property
    def linear_drag(self) -> tuple[float, float, float]:
        """Drag per velocity relative to the air near hover, along the body's axes [N s/m]."""
        if self.point:
            return self.drag, self.drag, self.drag
        across, along = (4.0 * k * self.hover_speed for k in (self.rotor_drag, self.rotor_inflow))
        return (across, across, along)


_ROTORPY = "RotorPy 3.0"
_CHOSEN = "chosen"
#: Numbers of each model, with their source.
MODELS: dict[str, dict[str, tuple[Any, str]]] = {
    # The paper gives mass and thrust of a rotor. The rest is chosen: arm and drag as of the Hummingbird, inertia and
    # ratio of torque to thrust as of quadrotors of about a kilogram, gains as RotorPy's for the Hummingbird.
    "paper": {
        "mass": (1.0, "paper, Tables 2 and 3"),
        "inertia": ((0.01, 0.01, 0.0187), _CHOSEN),
        "arm": (0.17, _CHOSEN),
        "thrust_coefficient": (5.9e-6, "paper: 5.9 N at the greatest speed"),
        "torque_coefficient": (5.9e-6 * 0.0152, _CHOSEN),
        "rotor_speed": ((0.0, 1000.0), _CHOSEN),
        "motor_time": ((0.02, 0.02), _CHOSEN),
        "rotor_drag": (1.16e-4, _CHOSEN),
        "rotor_inflow": (1.16e-4, _CHOSEN),
        "rotor_lift": (0.0, _CHOSEN),
        "rotor_radius": (0.127, _CHOSEN + ": propellers of ten inches"),
        "body_drag": ((0.5e-2, 0.5e-2, 1e-2), _CHOSEN),
        "attitude_gains": ((544.0, 46.64), _CHOSEN),
    },
    "px4-sih": {
        "mass": (1.0, f"PX4 SIH_MASS, {_ROTORPY} px4_sihsim_quadx_params"),
        "inertia": ((0.025, 0.025, 0.030), "PX4 SIH_IXX, SIH_IYY, SIH_IZZ"),
        "arm": (0.17 * math.sqrt(2.0), _ROTORPY),
        "thrust_coefficient": (5e-6, "PX4 SIH_T_MAX"),
        "torque_coefficient": (1e-7, "PX4 SIH_Q_MAX"),
        "rotor_speed": ((0.0, 1000.0), _ROTORPY),
        "motor_time": ((0.05, 0.05), "PX4 SIH_T_TAU"),
        "rotor_drag": (0.0, _ROTORPY),
        "rotor_inflow": (0.0, _ROTORPY),
        "rotor_lift": (0.0, _ROTORPY),
        "rotor_radius": (0.1, _CHOSEN),
        "body_drag": ((1e-2, 1e-2, 1e-2), _ROTORPY),
        "attitude_gains": ((310.0, 57.0), f"{_ROTORPY} SE3Control"),
    },
    "hummingbird": {
        "mass": (0.5, f"{_ROTORPY} hummingbird_params"),
        "inertia": ((3.65e-3, 3.68e-3, 7.03e-3), _ROTORPY),
        "arm": (0.17, _ROTORPY),
        "thrust_coefficient": (5.57e-6, _ROTORPY),
        "torque_coefficient": (1.36e-7, _ROTORPY),
        "rotor_speed": ((0.0, 1500.0), _ROTORPY),
        "motor_time": ((0.005, 0.005), _ROTORPY),
        "rotor_drag": (1.19e-4, _ROTORPY),
        "rotor_inflow": (2.32e-4, _ROTORPY),
        "rotor_lift": (3.39e-3, _ROTORPY),
        "rotor_radius": (0.1, _ROTORPY),
        "body_drag": ((0.5e-2, 0.5e-2, 1e-2), _ROTORPY),
        "attitude_gains": ((544.0, 46.64), _ROTORPY),
    },
    "crazyflie": {
        "mass": (0.03, f"{_ROTORPY} crazyflie_params"),
        "inertia": ((1.43e-5, 1.43e-5, 2.89e-5), _ROTORPY),
        "arm": (0.043, _ROTORPY),
        "thrust_coefficient": (2.3e-8, "Förster, System Identification of the Crazyflie 2.0, 2015"),
        "torque_coefficient": (7.8e-10, "Förster 2015"),
        "rotor_speed": ((0.0, 2500.0), _ROTORPY),
        "motor_time": ((0.072, 0.072), "Eschmann et al., arXiv 2404.07837"),
        "rotor_drag": (1.02506e-6, "Förster 2015"),
        "rotor_inflow": (7.553e-7, "Förster 2015"),
        "rotor_lift": (0.0, _ROTORPY),
        "rotor_radius": (0.0225, "propellers of 45 mm"),
        "body_drag": ((0.0, 0.0, 0.0), _ROTORPY),
        "attitude_gains": ((310.0, 57.0), _ROTORPY),
    },
    "x500": {
        "mass": (2.064307692, "PX4 Gazebo models, x500_base and its four rotors"),
        "inertia": ((0.0216667, 0.0216667, 0.04), "PX4 Gazebo models, x500_base"),
        "arm": (0.174 * math.sqrt(2.0), "PX4 Gazebo models, x500"),
        "thrust_coefficient": (8.54858e-6, "PX4 Gazebo models, x500: motorConstant"),
        "torque_coefficient": (8.54858e-6 * 0.016, "PX4 Gazebo models, x500: momentConstant"),
        "rotor_speed": ((0.0, 1000.0), "PX4 Gazebo models, x500: maxRotVelocity"),
        "motor_time": ((0.0125, 0.025), "PX4 Gazebo models, x500: timeConstantUp and -Down"),
        "rotor_drag": (8.06428e-5, "PX4 Gazebo models, x500: rotorDragCoefficient"),
        "rotor_inflow": (0.0, "PX4 Gazebo models, x500: the model has none"),
        "rotor_lift": (0.0, "PX4 Gazebo models, x500: the model has none"),
        "rotor_radius": (0.128, "PX4 Gazebo models, x500: propellers of ten inches"),
        "body_drag": ((0.0, 0.0, 0.0), "PX4 Gazebo models, x500: the model has none"),
        "attitude_gains": ((310.0, 57.0), f"{_ROTORPY} SE3Control"),
    },
}
for _numbers in MODELS.values():
    _numbers["tilt_limit_deg"] = (
        45.0,
        f"{_CHOSEN}; PX4 allows as much by default (MPC_TILTMAX_AIR)",
    )

#: Keys that only a point has.
_OF_POINTS = ("thrust_limit", "drag")


def resolve(vehicle: Vehicle) -> VehicleModel:
    """The model of a checked table, with what the table gives in place of the model's own numbers."""
    given = {
        key: value
        for key in Vehicle.model_fields
        if key != "model" and (value := getattr(vehicle, key)) is not None
    }
    if vehicle.model == "point":
        return VehicleModel(point=True, **given)
    own = {key: value for key, (value, _) in MODELS[vehicle.model].items()}
    found = VehicleModel(point=False, **(own | given))
    limit = 4.0 * found.rotor_limit
    return replace(found, thrust_limit=limit)


def check(collector: FindingCollector) -> dict[str, Vehicle]:
    """Validate the tables [vehicles.NAME]; invalid ones are left out."""
    tables = collector.data.get("vehicles", {})
    if not isinstance(tables, dict):
        collector.add(("vehicles",), "is not a table", "write tables [vehicles.NAME]")
        return {}
    found = {}
    for name, data in tables.items():
        path = ("vehicles", name)
        if not isinstance(data, dict):
            collector.add(path, "is not a table", f"write a table [vehicles.{name}]")
            continue
        vehicle = collector.validate(Vehicle, data, path)
        if vehicle is not None and _sound(collector, vehicle, path):
            found[name] = vehicle
    return found


def _sound(collector: FindingCollector, vehicle: Vehicle, path: tuple[str, ...]) -> bool:
    """Whether the keys of a table suit its model, and its vehicle can hover."""
    before = len(collector.findings)
    if vehicle.model == "point":
        for key in Vehicle.model_fields:
            if key not in ("model", "mass", *_OF_POINTS) and getattr(vehicle, key) is not None:
                collector.add(
                    (*path, key), "has no effect on a point", "remove it, or name a quadrotor"
                )
        if vehicle.mass is None:
            collector.add(path, "a point needs a mass", "add mass [kg]")
        return len(collector.findings) == before
    for key, other in zip(_OF_POINTS, ("thrust_coefficient", "rotor_drag"), strict=True):
        if getattr(vehicle, key) is not None:
            remedy = f"remove it; a quadrotor has {other}"
            collector.add((*path, key), "is for points alone", remedy)
    if len(collector.findings) > before:
        return False
    found = resolve(vehicle)
    low, high = found.rotor_speed
    if low >= high:
        collector.add(
            (*path, "rotor_speed"), "the least speed is not below the greatest", "swap them"
        )
    elif found.thrust_limit <= found.mass * _GRAVITY:
        problem = (
            f"cannot hover: its four rotors give {found.thrust_limit:.3g} N, its weight is "
            f"{found.mass * _GRAVITY:.3g} N"
        )
        collector.add(
            path, problem, "reduce mass, or raise thrust_coefficient or rotor_speed", None
        )
    elif low >= found.hover_speed:
        problem = f"the least speed is above the speed in hover, {found.hover_speed:.4g} rad/s"
        collector.add((*path, "rotor_speed"), problem, "reduce it", list(found.rotor_speed))
    k_R, k_omega = found.attitude_gains
    slowest = max(found.motor_time)
    # Routh's criterion of tau s^3 + s^2 + k_omega s + k_R.
    if k_omega <= slowest * k_R:
        problem = (
            f"is unstable with motors of {slowest:g} s: k_omega must exceed {slowest * k_R:.4g} /s"
        )
        remedy = "raise k_omega, lower k_R, or take quicker motors"
        collector.add((*path, "attitude_gains"), problem, remedy, list(found.attitude_gains))
    return len(collector.findings) == before


def equipped(collector: FindingCollector, agents: Any, vehicles: Mapping[str, Vehicle]) -> Any:
    """The table [agents], with masses and thrust limits of its vehicles; None if they cannot be known."""
    if not isinstance(agents, dict) or "vehicle" not in agents:
        if vehicles and isinstance(agents, dict):
            names = " or ".join(f"'{name}'" for name in list(vehicles)[:3])
            problem = "no agent flies any of the vehicles"
            collector.add(("vehicles",), problem, f"add vehicle = {names} to [agents]", None)
        return agents
    given, tables = agents["vehicle"], collector.data.get("vehicles", {})
    n = len(agents["position"]) if isinstance(agents.get("position"), list) else 0
    names = [given] * n if isinstance(given, str) else given
    where = ("agents", "vehicle")
    if not (isinstance(names, list) and names and all(isinstance(name, str) for name in names)):
        collector.add(where, "is not a name or a list of names", 'write vehicle = "NAME"')
        return None
    if len(names) != n:
        collector.add(
            where, f"has {len(names)} entries for {n} agents", f"give one name, or {n}", None
        )
        return None
    known = tables if isinstance(tables, dict) else {}
    for name in dict.fromkeys(names):
        if name not in known:
            remedy = near(name, known) or f"add a table [vehicles.{name}]"
            collector.add(where, f"there is no vehicle '{name}'", remedy, name)
            return None
    for name in dict.fromkeys(known):
        if name not in names:
            collector.add(("vehicles", name), "no agent flies it", "remove it", None)
    for key, where_else in (("mass", "mass"), ("thrust_limit", "its rotors")):
        if key in agents:
            problem = f"is given twice: the vehicle has {where_else}"
            remedy = "remove it here; change the vehicle in [vehicles.NAME]"
            collector.add(("agents", key), problem, remedy)
    if "saturate" in agents:
        problem = "has no effect: vehicles never give more than they can"
        collector.add(("agents", "saturate"), problem, "remove it")
    if not set(names) <= set(vehicles):
        return None  # has errors of its own
    models = {name: resolve(vehicles[name]) for name in set(names)}
    own = {
        "vehicle": names,
        "mass": [models[name].mass for name in names],
        "thrust_limit": [models[name].thrust_limit for name in names],
    }
    return {key: value for key, value in agents.items() if key != "saturate"} | own


#: Problem and remedy of what points without sampled control cannot have.
NOT_SAMPLED = (
    "needs sampled control, which only vehicles have",
    "give the agents a vehicle; model = 'point' flies points with sampled control",
)


def flies_vehicles(collector: FindingCollector) -> bool:
    """Whether the agents of a mission are to fly vehicles."""
    agents = collector.data.get("agents")
    return isinstance(agents, dict) and "vehicle" in agents


def check_flight(collector: FindingCollector, parts: Mapping[str, Any]) -> None:
    """Find what vehicles cannot have beside them, and rates of the autopilot that do not go together."""
    autopilot: Autopilot = parts.get("autopilot", Autopilot())
    if not flies_vehicles(collector):
        tracking = parts.get("tracking")
        for key in ("integral", "drag_feedforward") if tracking is not None else ():
            if getattr(tracking, key):
                collector.add(("tracking", key), *NOT_SAMPLED)
        if "autopilot" in collector.data:
            problem = "has no effect on point masses that give any force at once"
            collector.add(("autopilot",), problem, "remove it, or give the agents a vehicle", None)
        return
    ratio = autopilot.rate / autopilot.formation_rate
    if abs(ratio - round(ratio)) > 1e-9 or ratio < 1.0:
        problem = f"is not a whole part of rate, {autopilot.rate:g} Hz"
        low = autopilot.rate / max(1, math.ceil(ratio))
        collector.add(("autopilot", "formation_rate"), problem, f"use {low:g} Hz, for example")
    rotors = any(vehicle.model != "point" for vehicle in parts.get("vehicles", {}).values())
    if rotors and parts.get("gravity", _GRAVITY) < _LEAST_GRAVITY:
        problem = (
            f"must be >= {_LEAST_GRAVITY:g}: the attitude of a quadrotor follows from its thrust"
        )
        collector.add(("gravity",), problem, "raise it, or fly points")
    if parts.get("formulation") == "body":
        problem = "formulation = 'body' is that of point masses"
        collector.add(("formulation",), problem, "use formulation = 'inertial' with vehicles")
    disturbances = collector.data.get("disturbances", {})
    if isinstance(disturbances, dict) and "drag" in disturbances:
        problem = "is given twice: the vehicles have a drag of their own"
        remedy = (
            "remove it here; change rotor_drag and body_drag (of a point: drag) in [vehicles.NAME]"
        )
        collector.add(("disturbances", "drag"), problem, remedy)
