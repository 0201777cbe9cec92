"""Check a mission as a whole: every table by itself, then what only several keys together tell.

Each table is judged even where another has errors, so that one look shows all there is to mend. A check
that would need a key which is wrong itself is passed over.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from rigidfleet.errors import MissionError
from rigidfleet.formation.graphs import count_within
from rigidfleet.formation.shapes import SHAPES
from rigidfleet.mission import bounds, disturbances, formations, phases
from rigidfleet.mission.findings import FindingCollector, Keys, near_shape
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
    IntegratorOptions,
    Limits,
    Lqr,
    MissionHeader,
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
    "integrator": IntegratorOptions,
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
    notes = FindingCollector(data, origin)
    _numbers(notes)
    if notes.findings:  # what follows would take long
        raise MissionError(notes.findings)
    parts = _tables(notes)
    for judge in (_agents, _gains, _regulators, _tracking, _allocation, _geofence):
        judge(notes, parts)
    n = _count(data)
    parts["obstacles"] = _obstacles(notes)
    parts["formations"] = formations.check(notes, n)
    if not notes.findings and n is not None:
        _touching(notes, parts, n)
    parts["phases"] = phases.check(notes, parts, n)
    disturbances.check(notes, parts, n)
    if notes.findings:
        raise MissionError(notes.findings)
    return parts


def _numbers(notes: FindingCollector) -> None:
    """Refuse more of anything than a mission may have, before it is looked at."""

    def bounded(path: Keys, given: object, most: int, remedy: str) -> None:
        if isinstance(given, list | dict) and len(given) > most:
            notes.add(path, f"has {len(given):,} entries, more than {most:,}", remedy, None)

    for key, most, remedy in (
        ("formations", bounds.FORMATIONS, "fly them in several missions"),
        ("phases", bounds.PHASES, "fly them in several missions"),
        ("obstacles", bounds.OBSTACLES, "join those that touch, and leave out those out of reach"),
    ):
        bounded((key,), notes.data.get(key), most, remedy)
    agents = notes.data.get("agents")
    for key, given in agents.items() if isinstance(agents, dict) else ():
        bounded(("agents", key), given, bounds.AGENTS, "fly fewer vehicles")
    n, forms = _count(notes.data) or 0, notes.data.get("formations")
    if isinstance(forms, dict) and len(forms) > 1 and n * len(forms) > bounds.SLOTS:
        problem = f"{len(forms)} of {n:,} agents have {n * len(forms):,} slots, more than {bounds.SLOTS:,}"
        notes.add(("formations",), problem, "use fewer formations, or fewer agents", None)
    assignment = notes.data.get("assignment", "given")
    if assignment != "given" and n > bounds.ALL_PAIRS:
        problem = f"compares each agent with each slot, too many for {n:,} agents"
        remedy = (
            f"use 'given' beyond {bounds.ALL_PAIRS:,} agents, and number them as they are to go"
        )
        notes.add(("assignment",), problem, remedy)


def _tables(notes: FindingCollector) -> dict[str, Any]:
    """The header's keys and the tables, without those of which nothing can be made."""
    for key in notes.data:
        if key not in Contents.model_fields:
            notes.unknown((key,), Contents.model_fields)
    own = {key: value for key, value in notes.data.items() if key in MissionHeader.model_fields}
    header = notes.validate(MissionHeader, own, ())
    parts = {key: getattr(header, key) for key in MissionHeader.model_fields} if header else {}
    for key, kind in _TABLES.items():
        if key in notes.data:
            data = notes.data[key] if key != "agents" else _placed(notes, notes.data[key])
            part = None if data is None else notes.validate(kind, data, (key,))
            parts |= {key: part} if part is not None else {}
    if "agents" not in notes.data:
        notes.add(("agents",), "is missing", "add a table [agents] with mass and position")
    return parts


def _placed(notes: FindingCollector, agents: Any) -> Any:
    """[agents] with positions written out where they are given as a shape; None where that is wrong."""
    if not (isinstance(agents, dict) and isinstance(agents.get("position"), dict)):
        return agents
    path = ("agents", "position")
    start = notes.validate(Start, agents["position"], path)
    if start is None or not notes.right((), *path[:1]):
        return None
    try:
        points = start.points()
        if not np.abs(points).max() <= bounds.LENGTH.most:
            problem = f"agents would start farther than {bounds.LENGTH.most:g} m from the origin"
            notes.add(path, problem, "lower size, count or centre")
            return None
        return agents | {"position": points.tolist()}
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
        whole = isinstance(count, int) and not isinstance(count, bool)
        return count if whole and 0 < count <= bounds.AGENTS else None
    return len(position) if isinstance(position, list) and position else None


def _agents(notes: FindingCollector, parts: dict[str, Any]) -> None:
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
        notes.add(("agents", "position", j), problem, "start them apart", agents.position[j])
    if max(agents.mass, default=1.0) > bounds.MASS_RATIO * min(agents.mass, default=1.0):
        problem = f"the heaviest vehicle has more than {bounds.MASS_RATIO:g} times the mass of the lightest"
        notes.add(("agents", "mass"), problem, "give masses in kg")
    above = [limit for limit in agents.thrust_limit if bounds.FORCE.most < limit < math.inf]
    if above:
        notes.add(
            ("agents", "thrust_limit"),
            f"must be <= {bounds.FORCE.most:g}",
            "leave it out for no limit",
        )
    written = notes.data["agents"].get("thrust_limit", 0.0)
    if math.inf in (written if isinstance(written, list) else [written]):
        notes.add(("agents", "thrust_limit"), "is not finite", "leave it out for no limit")
    unlimited = all(math.isinf(limit) for limit in agents.thrust_limit)
    if agents.saturate and unlimited and notes.right(("agents",), "thrust_limit"):
        notes.add(
            ("agents", "saturate"), "there is no limit to cut off at", "give thrust_limit [N]"
        )


def _touching(notes: FindingCollector, parts: dict[str, Any], n: int) -> None:
    """Refuse spheres so large that lists of all that touch would fill memory."""
    if n * (n - 1) // 2 <= bounds.TOUCHING:
        return
    agents: Agents = parts["agents"]
    places = {"at the start": np.array(agents.position)}
    for name, form in parts["formations"].items():
        slots = form.slot_array(n)
        places |= {} if slots is None else {f"in '{name}'": slots}
    for where, points in places.items():
        pairs = count_within(points, 2 * max(agents.radius))
        if pairs > bounds.TOUCHING:
            problem = (
                f"{pairs:,} pairs of agents touch {where}, more than {bounds.TOUCHING:,}, if all are as large as the"
                " largest"
            )
            notes.add(("agents", "radius"), problem, "lower it, or keep them apart")
            return


def _gains(notes: FindingCollector, parts: dict[str, Any]) -> None:
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


def _regulators(notes: FindingCollector, parts: dict[str, Any]) -> None:
    lqr: Lqr = parts.get("lqr", Lqr())
    _regulator(notes, lqr, "lqr")
    _regulator(notes, lqr.attitude, "lqr", "attitude")
    _free_input(notes, lqr)


def _regulator(notes: FindingCollector, weights: Regulator, *path: str) -> None:
    keys = ("horizon", "Q", "S")
    if not (notes.right(("lqr",), *keys) and notes.right(path, *keys)):
        return
    if weights.horizon == "infinite" and weights.Q[0] < _NO_WEIGHT:
        problem = f"an infinite horizon needs a weight > 0 on the error, {_NO_WEIGHT:g} at least"
        notes.add((*path, "Q"), problem, "give Q = [1.0, 1.0], say", weights.Q)
    if weights.horizon == "finite" and not any(weights.Q) and not any(weights.S):
        problem = "with Q and S zero there is nothing to steer for"
        notes.add((*path, "S"), problem, "give S = [1e3, 1e2], say", weights.S)


def _free_input(notes: FindingCollector, lqr: Lqr) -> None:
    for weights, name in ((lqr, "lqr"), (lqr.attitude, "lqr.attitude")):
        path, most = tuple(name.split(".")), max(*weights.Q, *weights.S)
        if _FREE * most > weights.R and notes.right(("lqr",), "R") and notes.right(path, "R"):
            inherited = name != "lqr" and "R" not in notes.data["lqr"].get("attitude", {})
            _unbounded(notes, weights.R, most, ("lqr",) if inherited else path, name)


def _unbounded(
    notes: FindingCollector, R: float, most: float, where: tuple[str, ...], name: str
) -> None:
    problem = (
        f"is less than {_FREE:g} of the largest weight of {name}, {most:g}:"
        " gains would have no bound"
    )
    notes.add((*where, "R"), problem, f"raise R, or lower the weights of {name}", R)


def _tracking(notes: FindingCollector, parts: dict[str, Any]) -> None:
    tracking: Tracking = parts.get("tracking", Tracking())
    if not notes.right(("tracking",), "Q"):
        return
    if tracking.Q[0] < _NO_WEIGHT:
        problem = f"tracking needs a weight > 0 on the position error, {_NO_WEIGHT:g} at least"
        notes.add(("tracking", "Q"), problem, "give Q = [4.0, 4.0], say")
    if _FREE * max(tracking.Q) > tracking.R and notes.right(("tracking",), "R"):
        _unbounded(notes, tracking.R, max(tracking.Q), ("tracking",), "tracking")


def _allocation(notes: FindingCollector, parts: dict[str, Any]) -> None:
    allocation: Allocation = parts.get("allocation", Allocation())
    if (
        allocation.method == "rigid"
        and "torque_split" in allocation.model_fields_set
        and notes.right(("allocation",), "method")
    ):
        problem = "has no effect with method 'rigid'"
        notes.add(("allocation", "torque_split"), problem, "remove it, or use method = 'pinv'")


def _geofence(notes: FindingCollector, parts: dict[str, Any]) -> None:
    fence = parts.get("limits", Limits()).geofence
    if fence is not None:
        _ordered(notes, fence, ("limits", "geofence"))


def _ordered(notes: FindingCollector, box: Box | Geofence, path: tuple[str | int, ...]) -> None:
    for axis, low, high in zip("xyz", box.min, box.max, strict=True):
        if low >= high:
            problem = f"min must be below max, but in {axis} {low:g} >= {high:g} m"
            notes.add(path, problem, "exchange the two", None)


def _obstacles(notes: FindingCollector) -> tuple[Obstacle, ...]:
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
