"""Models of vehicles, whose numbers and their sources are in `vehicles.toml`, and the check of [vehicles].

The model of a quadrotor is that of RotorPy (Folk, Paulos, Kumar, "RotorPy: A Python-based Multirotor Simulator with
Aerodynamics for Education and Research", arXiv 2306.04485): rotor thrust and drag torque by the square of the speed,
motors with a first-order lag, drag of the rotors and of the body.
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from rigidfleet.mission.findings import look_up, suggest
from rigidfleet.mission.rules import Breach, Breaches, Draft
from rigidfleet.mission.schema import Vehicle

_GRAVITY = 9.81
#: Least gravity in which quadrotors fly [m/s^2].
_LEAST_GRAVITY = 1.0


class VehicleModel(NamedTuple):
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
    def rotor_thrust_limit(self) -> float:
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


#: The numbers of each model by key, each with its source.
MODELS: dict[str, dict[str, tuple[Any, str]]] = {
    name: {key: (tuple(x) if isinstance(x, list) else x, why) for key, (x, why) in table.items()}
    for name, table in tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8")).items()
}

#: Keys that only a point has, and those of a quadrotor in their place.
_OF_POINTS = {"thrust_limit": "thrust_coefficient", "drag": "rotor_drag"}


def model_of_vehicle(vehicle: Vehicle) -> VehicleModel:
    """The model of a checked table, with what the table gives in place of the model's own numbers."""
    own = {
        key: value
        for key in Vehicle.model_fields
        if key != "model" and (value := getattr(vehicle, key)) is not None
    }
    if vehicle.model == "point":
        return VehicleModel(point=True, **own)
    usual = {key: value for key, (value, _) in MODELS[vehicle.model].items()}
    model = VehicleModel(point=False, **(usual | own))
    return model._replace(thrust_limit=4.0 * model.rotor_thrust_limit)


def validate_vehicles(m: Draft) -> None:
    """Validate the tables [vehicles.NAME]; invalid ones are left out."""
    m.parts["vehicles"] = {}
    tables = m.data.get("vehicles", {})
    if not isinstance(tables, dict):
        m.add(("vehicles",), "is not a table", "write tables [vehicles.NAME]")
        return
    for name, data in tables.items():
        path = ("vehicles", name)
        if (vehicle := m.validate(Vehicle, data, path)) is not None:
            before = len(m.findings)
            m.record_breaches(path, _vehicle_rules(vehicle))
            if len(m.findings) == before:
                m.vehicles[name] = vehicle


def _vehicle_rules(vehicle: Vehicle) -> Breaches:
    """The keys of a table suit its model, and its vehicle can hover."""
    if vehicle.model == "point":
        for key in Vehicle.model_fields:
            if key not in ("model", "mass", *_OF_POINTS) and getattr(vehicle, key) is not None:
                problem = "has no effect on a point"
                yield Breach(key, problem, "remove it, or name a quadrotor")
        if vehicle.mass is None:
            yield Breach((), "a point needs a mass", "add mass [kg]")
        return
    wrong = [key for key in _OF_POINTS if getattr(vehicle, key) is not None]
    for key in wrong:
        remedy = f"remove it; a quadrotor has {_OF_POINTS[key]}"
        yield Breach(key, "is for points alone", remedy)
    if wrong:
        return
    x = model_of_vehicle(vehicle)
    low, high = x.rotor_speed
    if low >= high:
        yield Breach("rotor_speed", "the least speed is not below the greatest", "swap them")
    elif x.thrust_limit <= x.mass * _GRAVITY:
        problem = (
            f"cannot hover: its four rotors give {x.thrust_limit:.3g} N, its weight is "
            f"{x.mass * _GRAVITY:.3g} N"
        )
        yield Breach((), problem, "reduce mass, or raise thrust_coefficient or rotor_speed", None)
    elif low >= x.hover_speed:
        problem = f"the least speed is above the speed in hover, {x.hover_speed:.4g} rad/s"
        yield Breach("rotor_speed", problem, "reduce it", list(x.rotor_speed))
    k_R, k_omega = x.attitude_gains
    slowest = max(x.motor_time)
    # Routh's criterion of tau s^3 + s^2 + k_omega s + k_R.
    if k_omega <= slowest * k_R:
        problem = (
            f"is unstable with motors of {slowest:g} s: k_omega must exceed {slowest * k_R:.4g} /s"
        )
        remedy = "raise k_omega, lower k_R, or take quicker motors"
        yield Breach("attitude_gains", problem, remedy, list(x.attitude_gains))


def fill_agents_table(m: Draft, agents: Any) -> Any:
    """The table [agents], with masses and thrust limits of its vehicles; None if they cannot be known."""
    if not isinstance(agents, dict) or "vehicle" not in agents:
        if m.vehicles and isinstance(agents, dict):
            names = " or ".join(f"'{name}'" for name in list(m.vehicles)[:3])
            problem = "no agent flies any of the vehicles"
            m.add(("vehicles",), problem, f"add vehicle = {names} to [agents]", None)
        return agents
    written, tables = agents["vehicle"], m.data.get("vehicles", {})
    names = [written] * (m.n or 1) if isinstance(written, str) else written
    where = ("agents", "vehicle")
    if not (isinstance(names, list) and names and all(isinstance(name, str) for name in names)):
        m.add(where, "is not a name or a list of names", 'write vehicle = "NAME"')
        return None
    if m.n is None:  # the model says what is wrong with the positions
        return agents | {"vehicle": names, "mass": [1.0]}
    if len(names) != m.n:
        problem = f"has {len(names)} entries for {m.n} agents"
        m.add(where, problem, f"give one name, or {m.n}", None)
        return None
    known = tables if isinstance(tables, dict) else {}
    for name in dict.fromkeys(names):
        if name not in known:
            remedy = suggest(name, known) or f"add a table [vehicles.{name}]"
            m.add(where, f"there is no vehicle '{name}'", remedy, name)
            return None
    for name in known:
        if name not in names:
            m.add(("vehicles", name), "no agent flies it", "remove it", None)
    for key, where_else in (("mass", "mass"), ("thrust_limit", "its rotors")):
        if key in agents:
            problem = f"is given twice: the vehicle has {where_else}"
            remedy = "remove it here; change the vehicle in [vehicles.NAME]"
            m.add(("agents", key), problem, remedy)
    if "saturate" in agents:
        problem = "has no effect: vehicles never give more than they can"
        m.add(("agents", "saturate"), problem, "remove it")
    if not set(names) <= set(m.vehicles):
        return None  # has errors of its own
    models = {name: model_of_vehicle(m.vehicles[name]) for name in set(names)}
    return agents | {
        "vehicle": names,
        "mass": [models[name].mass for name in names],
        "thrust_limit": [models[name].thrust_limit for name in names],
    }


#: Problem and remedy of what points without sampled control cannot have.
NOT_SAMPLED = (
    "needs sampled control, which only vehicles have",
    "give the agents a vehicle; model = 'point' flies points with sampled control",
)


def vehicle_flight_rules(m: Draft) -> Breaches:
    """Vehicles have nothing beside them that they cannot have, and rates that go together."""
    if not m.flies_vehicles:
        for key in ("integral", "drag_feedforward"):
            if getattr(m.tracking, key):
                yield Breach(("tracking", key), *NOT_SAMPLED)
        if "autopilot" in m.data:
            problem = "has no effect on point masses that give any force at once"
            yield Breach("autopilot", problem, "remove it, or give the agents a vehicle", None)
        return
    rate = m.autopilot.rate
    ratio = rate / m.autopilot.formation_rate
    if abs(ratio - round(ratio)) > 1e-9 or ratio < 1.0:
        remedy = f"use {rate / max(1, math.ceil(ratio)):g} Hz, for example"
        problem = f"is not a whole part of rate, {rate:g} Hz"
        yield Breach(("autopilot", "formation_rate"), problem, remedy)
    rotors = any(vehicle.model != "point" for vehicle in m.vehicles.values())
    if rotors and m.gravity < _LEAST_GRAVITY:
        problem = (
            f"must be >= {_LEAST_GRAVITY:g}: the attitude of a quadrotor follows from its thrust"
        )
        yield Breach("gravity", problem, "raise it, or fly points")
    if m.formulation == "body":
        problem = "formulation = 'body' is that of point masses"
        yield Breach("formulation", problem, "use formulation = 'inertial' with vehicles")
    if look_up(m.data, ("disturbances", "drag"), None) is not None:
        problem = "is given twice: the vehicles have a drag of their own"
        remedy = (
            "remove it here; change rotor_drag and body_drag (of a point: drag) in [vehicles.NAME]"
        )
        yield Breach(("disturbances", "drag"), problem, remedy)
