"""Check a mission as a whole: every table by itself, then what only several keys together tell.

Each table is judged even where another has errors, so that one look shows all there is to mend. A check
that would need a key which is wrong itself is passed over.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from rigidfleet.errors import MissionError
from rigidfleet.formation import SHAPES
from rigidfleet.mission import disturbances, formations, phases
from rigidfleet.mission.notes import Notes, near_shape, unknown_key
from rigidfleet.mission.schema import (
    Agents,
    Allocation,
    BodyFrame,
    Box,
    Constraint,
    Contents,
    Disturbances,
    Geofence,
    Ground,
    Header,
    Integrator,
    Limits,
    Lqr,
    Obstacle,
    Part,
    Regulator,
    Start,
    Tracking,
)

_TABLES: dict[str, type[Part]] = {
    "agents": Agents,
    "constraint": Constraint,
    "lqr": Lqr,
    "tracking": Tracking,
    "allocation": Allocation,
    "integrator": Integrator,
    "body_frame": BodyFrame,
    "limits": Limits,
    "disturbances": Disturbances,
}
_OBSTACLES: dict[str, type[Part]] = {"box": Box, "ground": Ground}


def check(data: Mapping[str, Any], origin: str) -> dict[str, Any]:
    """The parts of a mission that is in order, by the fields of `Contents`.

    Raises
    ------
    MissionError
        With a finding for everything that is not.
    """
    notes = Notes(data, origin)
    parts = _tables(notes)
    for judge in (_agents, _gains, _regulators, _tracking, _allocation, _geofence):
        judge(notes, parts)
    n = _count(data)
    parts["obstacles"] = _obstacles(notes)
    parts["formations"] = formations.check(notes, n)
    parts["phases"] = phases.check(notes, parts, n)
    disturbances.check(notes, parts, n)
    if notes.findings:
        raise MissionError(notes.findings)
    return parts


def _tables(notes: Notes) -> dict[str, Any]:
    """The header's keys and the tables, without those of which nothing can be made."""
    for key in notes.data:
        if key not in Contents.model_fields:
            notes.add((key,), *unknown_key(key, Contents.model_fields))
    own = {key: value for key, value in notes.data.items() if key in Header.model_fields}
    header = notes.validate(Header, own, ())
    parts = {key: getattr(header, key) for key in Header.model_fields} if header else {}
    for key, kind in _TABLES.items():
        if key in notes.data:
            data = notes.data[key] if key != "agents" else _placed(notes, notes.data[key])
            part = None if data is None else notes.validate(kind, data, (key,))
            parts |= {key: part} if part is not None else {}
    if "agents" not in notes.data:
        notes.add(("agents",), "is missing", "add a table [agents] with mass and position")
    return parts


def _placed(notes: Notes, agents: Any) -> Any:
    """[agents] with positions written out where they are given as a shape; None where that is wrong."""
    if not (isinstance(agents, dict) and isinstance(agents.get("position"), dict)):
        return agents
    path = ("agents", "position")
    start = notes.validate(Start, agents["position"], path)
    if start is None or not notes.right((), *path[:1]):
        return None
    try:
        return agents | {"position": start.points().tolist()}
    except ValueError as error:
        known = "" if start.shape in SHAPES else near_shape(start.shape)
        remedy = known or "change the shape, its size, or the number of agents"
        notes.add((*path, "shape"), str(error), remedy)
        return None


def _count(data: Mapping[str, Any]) -> int | None:
    """Number of agents, as far as it can be told."""
    agents = data.get("agents")
    position = agents.get("position") if isinstance(agents, dict) else None
    if isinstance(position, dict):
        count = position.get("count")
        return count if isinstance(count, int) and count > 0 else None
    return len(position) if isinstance(position, list) and position else None


def _agents(notes: Notes, parts: dict[str, Any]) -> None:
    agents: Agents | None = parts.get("agents")
    if agents is None:
        return
    n = len(agents.position)
    for key in ("mass", "velocity", "radius", "thrust_limit"):
        given = len(getattr(agents, key))
        if given != n and notes.right(("agents",), key):
            problem = f"has {given} entries for {n} agents"
            notes.add(("agents", key), problem, f"give one for each agent, {n} in all")
    for i, j in formations.coincident(agents.position):
        problem = f"agent {j + 1} starts where agent {i + 1} does"
        notes.add(("agents", "position", j), problem, "start them apart")
    written = notes.data["agents"].get("thrust_limit", 0.0)
    if math.inf in (written if isinstance(written, list) else [written]):
        notes.add(("agents", "thrust_limit"), "is not finite", "leave it out for no limit")
    unlimited = all(math.isinf(limit) for limit in agents.thrust_limit)
    if agents.saturate and unlimited and notes.right(("agents",), "thrust_limit"):
        notes.add(
            ("agents", "saturate"), "there is no limit to cut off at", "give thrust_limit [N]"
        )


def _gains(notes: Notes, parts: dict[str, Any]) -> None:
    c: Constraint = parts.get("constraint", Constraint())
    if c.stabilisation == "none":
        return
    if not notes.right(("constraint",), "stabilisation", "alpha", "beta", "gamma"):
        return
    poles = "three poles at -p: alpha = 1.5 p, beta = sqrt(3) p, gamma = p^3"
    for key, needed in (("alpha", "> 0"), ("beta", "> 0"), ("gamma", ">= 0")):
        gain = getattr(c, key)
        if gain < 0 or (gain == 0 and key != "gamma"):
            remedy = f"use a stable gain ({poles}), or stabilisation = 'none' for no feedback"
            notes.add(("constraint", key), f"is unstable, must be {needed}", remedy, gain)
    bound = 2 * c.alpha * c.beta**2
    if bound <= c.gamma and notes.right(("constraint",), "alpha", "beta"):
        problem = f"is unstable, must be below 2 alpha beta^2 = {bound:.6g}"
        remedy = f"lower gamma, or raise alpha or beta ({poles})"
        notes.add(("constraint", "gamma"), problem, remedy, c.gamma)


#: Weights below this are none: a Riccati equation cannot tell them from zero.
_NO_WEIGHT = 1e-12
#: An input that costs less than this part of an error costs nothing, and its gains know no bound.
_FREE = 1e-15


def _regulators(notes: Notes, parts: dict[str, Any]) -> None:
    lqr: Lqr = parts.get("lqr", Lqr())
    _regulator(notes, lqr, "lqr")
    _regulator(notes, lqr.attitude, "lqr", "attitude")
    _free_input(notes, lqr)


def _regulator(notes: Notes, weights: Regulator, *path: str) -> None:
    keys = ("horizon", "Q", "S")
    if not (notes.right(("lqr",), *keys) and notes.right(path, *keys)):
        return
    if weights.horizon == "infinite" and weights.Q[0] < _NO_WEIGHT:
        problem = f"an infinite horizon needs a weight > 0 on the error, {_NO_WEIGHT:g} at least"
        notes.add((*path, "Q"), problem, "give Q = [1.0, 1.0], say", weights.Q)
    if weights.horizon == "finite" and not any(weights.Q) and not any(weights.S):
        problem = "with Q and S zero there is nothing to steer for"
        notes.add((*path, "S"), problem, "give S = [1e3, 1e2], say", weights.S)


def _free_input(notes: Notes, lqr: Lqr) -> None:
    for weights, name in ((lqr, "lqr"), (lqr.attitude, "lqr.attitude")):
        path, most = tuple(name.split(".")), max(*weights.Q, *weights.S)
        if _FREE * most > weights.R and notes.right(("lqr",), "R") and notes.right(path, "R"):
            inherited = name != "lqr" and "R" not in notes.data["lqr"].get("attitude", {})
            _unbounded(notes, weights.R, most, ("lqr",) if inherited else path, name)


def _unbounded(notes: Notes, R: float, most: float, where: tuple[str, ...], name: str) -> None:
    problem = (
        f"is less than {_FREE:g} of the largest weight of {name}, {most:g}:"
        " gains would have no bound"
    )
    notes.add((*where, "R"), problem, f"raise R, or lower the weights of {name}", R)


def _tracking(notes: Notes, parts: dict[str, Any]) -> None:
    tracking: Tracking = parts.get("tracking", Tracking())
    if not notes.right(("tracking",), "Q"):
        return
    if tracking.Q[0] < _NO_WEIGHT:
        problem = f"tracking needs a weight > 0 on the position error, {_NO_WEIGHT:g} at least"
        notes.add(("tracking", "Q"), problem, "give Q = [4.0, 4.0], say")
    if _FREE * max(tracking.Q) > tracking.R and notes.right(("tracking",), "R"):
        _unbounded(notes, tracking.R, max(tracking.Q), ("tracking",), "tracking")


def _allocation(notes: Notes, parts: dict[str, Any]) -> None:
    allocation: Allocation = parts.get("allocation", Allocation())
    if (
        allocation.method == "rigid"
        and "torque_split" in allocation.model_fields_set
        and notes.right(("allocation",), "method")
    ):
        problem = "has no effect with method 'rigid'"
        notes.add(("allocation", "torque_split"), problem, "remove it, or use method = 'pinv'")


def _geofence(notes: Notes, parts: dict[str, Any]) -> None:
    fence = parts.get("limits", Limits()).geofence
    if fence is not None:
        _ordered(notes, fence, ("limits", "geofence"))


def _ordered(notes: Notes, box: Box | Geofence, path: tuple[str | int, ...]) -> None:
    for axis, low, high in zip("xyz", box.min, box.max, strict=True):
        if low >= high:
            problem = f"min must be below max, but in {axis} {low:g} >= {high:g} m"
            notes.add(path, problem, "exchange the two", None)


def _obstacles(notes: Notes) -> tuple[Obstacle, ...]:
    obstacles = []
    for k, data in enumerate(phases.tables(notes, "obstacles")):
        kind = phases.kind(notes, data, ("obstacles", k), _OBSTACLES)
        if kind is None:
            continue
        name = "ground" if kind is Ground else f"box {k + 1}"
        obstacle = notes.validate(kind, {"name": name} | data, ("obstacles", k))
        if isinstance(obstacle, Box):
            _ordered(notes, obstacle, ("obstacles", k))
        obstacles += [obstacle] if obstacle is not None else []
    return tuple(obstacles)
