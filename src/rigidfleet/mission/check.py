"""Check a mission as a whole: first each table by itself, then conditions that involve several keys.

A table is checked even if another one has errors, so that one run reports all errors. A check is skipped if it needs
a key that has an error itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from rigidfleet._common.quantities import MOTIONS
from rigidfleet.errors import MissionError
from rigidfleet.formation.graphs import count_within
from rigidfleet.formation.shapes import SHAPES
from rigidfleet.mission import (
    avoidance,
    bounds,
    disturbances,
    formations,
    obstacles,
    phases,
    vehicles,
)
from rigidfleet.mission.files import NOT_A_FILE
from rigidfleet.mission.findings import (
    FindingCollector,
    Keys,
    Shared,
    look_up,
    model_of,
    near_shape,
)
from rigidfleet.mission.obstacles import Box, Obstacle
from rigidfleet.mission.schema import (
    Agents,
    Allocation,
    Constraint,
    Contents,
    Disturbances,
    Geofence,
    Limits,
    Lqr,
    MissionHeader,
    Regulator,
    Start,
    Tracking,
    VehicleYaw,
)

#: Models of the single tables. Obstacles and phases are arrays of tables, whose kinds have models.
_TABLES = {
    key: model
    for key, field in Contents.model_fields.items()
    if (model := model_of(field.annotation)) is not None and key not in ("obstacles", "phases")
}


def check(data: Mapping[str, Any], origin: str, shared: Shared | None = None) -> dict[str, Any]:
    """Check the data of a mission and return its parts, by the fields of `Contents`.

    Tables that are ``shared`` with other missions are validated once for all of them.

    Raises
    ------
    MissionError
        With a finding for each error.
    """
    collector = FindingCollector(data, origin, shared)
    _numbers(collector)
    if collector.findings:  # the other checks would take long
        raise MissionError(collector.findings)
    parts = _tables(collector)
    for judge in (_agents, _gains, _regulators, _tracking, _allocation, _limits, _yaw, _planned):
        judge(collector, parts)
    n = _count(data)
    parts["obstacles"] = _obstacles(collector)
    parts["formations"] = formations.check(collector, n)
    if not collector.findings and n is not None:
        _touching(collector, parts, n)
    parts["phases"] = phases.check(collector, parts, n)
    disturbances.check(collector, parts, n)
    vehicles.check_flight(collector, parts)
    if not collector.findings and n is not None and parts["agents"].fixed:
        _fixed(collector, parts, n)
    avoidance.check(collector, parts)
    if collector.findings:
        raise MissionError(collector.findings)
    return parts


def _numbers(collector: FindingCollector) -> None:
    """Find counts beyond the bounds, before anything else is checked."""

    def bounded(path: Keys, given: object, most: int, remedy: str) -> None:
        if isinstance(given, list | dict) and len(given) > most:
            collector.add(
                path, f"has {len(given):,} entries; the maximum is {most:,}", remedy, None
            )

    for key, most, remedy in (
        ("formations", bounds.FORMATIONS, "split them into several missions"),
        ("phases", bounds.PHASES, "split them into several missions"),
        ("obstacles", bounds.OBSTACLES, "merge those that touch, and remove those out of reach"),
    ):
        bounded((key,), collector.data.get(key), most, remedy)
    agents = collector.data.get("agents")
    for key, given in agents.items() if isinstance(agents, dict) else ():
        bounded(("agents", key), given, bounds.AGENTS, "use fewer agents")
    n, forms = _count(collector.data) or 0, collector.data.get("formations")
    if isinstance(forms, dict) and len(forms) > 1 and n * len(forms) > bounds.SLOTS:
        slots = n * len(forms)
        problem = f"{len(forms)} formations of {n:,} agents have {slots:,} slots; the maximum is {bounds.SLOTS:,}"
        collector.add(("formations",), problem, "use fewer formations, or fewer agents", None)
    assignment = collector.data.get("assignment", "given")
    if assignment != "each" and "assignment_downwash" in collector.data:
        path, remedy = ("assignment_downwash",), "use assignment = 'each', or remove this key"
        collector.add(path, f"has no effect with assignment {assignment!r}", remedy)
    if assignment != "given" and n > bounds.ALL_PAIRS:
        problem = f"compares all agents with all slots, which takes too long for {n:,} agents"
        remedy = f"for more than {bounds.ALL_PAIRS:,} agents use 'given' and order the agents as their slots"
        collector.add(("assignment",), problem, remedy)


def _tables(collector: FindingCollector) -> dict[str, Any]:
    """Validate the keys of the header and the tables; invalid ones are left out."""
    for key in collector.data:
        if key not in Contents.model_fields:
            collector.unknown((key,), Contents.model_fields)
    own = {key: value for key, value in collector.data.items() if key in MissionHeader.model_fields}
    header = collector.validate(MissionHeader, own, ())
    parts = {key: getattr(header, key) for key in MissionHeader.model_fields} if header else {}
    models = vehicles.check(collector)
    parts["vehicles"] = models
    for key, kind in _TABLES.items():
        if key in collector.data:
            data = collector.data[key]
            if key == "agents":
                data = vehicles.equipped(collector, _placed(collector, data), models)
            part = None if data is None else collector.validate(kind, data, (key,))
            parts |= {key: part} if part is not None else {}
    if "agents" not in collector.data:
        collector.add(("agents",), "is missing", "add a table [agents] with mass and position")
    return parts


def _placed(collector: FindingCollector, agents: Any) -> Any:
    """Return [agents] with a shape of `position` replaced by its points; None if the shape has errors."""
    if isinstance(agents, dict) and isinstance(agents.get("position"), str):
        remedy = "load the mission from its file, or give the positions as points"
        collector.add(("agents", "position"), NOT_A_FILE, remedy)
        return None
    if not (isinstance(agents, dict) and isinstance(agents.get("position"), dict)):
        return agents
    path = ("agents", "position")
    start = collector.validate(Start, agents["position"], path)
    if start is None or not collector.right((), *path[:1]):
        return None
    try:
        points = start.points()
        if not np.abs(points).max() <= bounds.LENGTH.most:
            problem = f"agents start farther than {bounds.LENGTH.most:g} m from the origin"
            collector.add(path, problem, "reduce size, count or centre")
            return None
        return agents | {"position": points.tolist()}
    except ValueError as error:
        known = "" if start.shape in SHAPES else near_shape(start.shape)
        remedy = known or "change the shape, its size, or the number of agents"
        collector.add((*path, "shape"), str(error), remedy)
        return None


def _count(data: Mapping[str, Any]) -> int | None:
    """Number of agents; None if it is not known."""
    agents = data.get("agents")
    position = agents.get("position") if isinstance(agents, dict) else None
    if isinstance(position, dict):
        count = position.get("count")
        whole = isinstance(count, int) and not isinstance(count, bool)
        return count if whole and 0 < count <= bounds.AGENTS else None
    return len(position) if isinstance(position, list) and position else None


def _agents(collector: FindingCollector, parts: dict[str, Any]) -> None:
    agents: Agents | None = parts.get("agents")
    if agents is None:
        return
    n = len(agents.position)
    for key in ("mass", "velocity", "radius", "thrust_limit"):
        given = len(getattr(agents, key))
        if given != n and collector.right(("agents",), key):
            problem = f"has {given} entries for {n} agents"
            collector.add(("agents", key), problem, f"give one entry per agent, {n} in all")
    # Without a formation, nothing divides by distances: the start may be one that others flew.
    shaped = look_up(collector.data, ("formations",))
    for i, j in formations.coincident(agents.position) if shaped else ():
        problem = f"agents {i + 1} and {j + 1} start at the same point"
        collector.add(("agents", "position", j), problem, "move them apart", agents.position[j])
    if max(agents.mass, default=1.0) > bounds.MASS_RATIO * min(agents.mass, default=1.0):
        problem = f"the largest mass is more than {bounds.MASS_RATIO:g} times the smallest"
        collector.add(("agents", "mass"), problem, "give all masses in kg")
    above = [limit for limit in agents.thrust_limit if bounds.FORCE.most < limit < math.inf]
    if above:
        problem = f"must be <= {bounds.FORCE.most:g}"
        collector.add(("agents", "thrust_limit"), problem, "omit it for no limit")
    written = collector.data["agents"].get("thrust_limit", 0.0)
    if math.inf in (written if isinstance(written, list) else [written]):
        collector.add(("agents", "thrust_limit"), "is not finite", "omit it for no limit")
    unlimited = all(math.isinf(limit) for limit in agents.thrust_limit)
    if agents.saturate and unlimited and collector.right(("agents",), "thrust_limit"):
        collector.add(
            ("agents", "saturate"), "no limit to saturate at is given", "give thrust_limit [N]"
        )


def _fixed(collector: FindingCollector, parts: dict[str, Any], n: int) -> None:
    """Check that fixed agents exist, and that nothing is to move them or to change what they hold."""
    agents, where = parts["agents"], ("agents", "fixed")
    phases.members(collector, agents.fixed, n, where)
    solver = parts.get("constraint", Constraint()).solver
    d = parts.get("disturbances", Disturbances())
    for wrong, problem, remedy in (
        (any(any(agents.velocity[i - 1]) for i in agents.fixed if i <= n), "starts with a velocity", "remove it"),
        (agents.vehicle or d.lost or (d.links and d.links.lost), "needs points that are not lost", "remove these keys"),
        (solver not in ("pinv", "spectral"), "needs another solver", "use constraint.solver = 'pinv'"),
        (any(p.control != "open" for p in parts["phases"]), "cannot track slots", "use control = 'open' in all phases"),
    ):  # fmt: skip
        if wrong:
            collector.add(where, problem, remedy)


def _touching(collector: FindingCollector, parts: dict[str, Any], n: int) -> None:
    """Find radii so large that a list of all touching pairs would fill memory."""
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
                f"with the largest radius, {pairs:,} pairs of agents touch {where};"
                f" the maximum is {bounds.TOUCHING:,}"
            )
            collector.add(
                ("agents", "radius"), problem, "reduce the radius or increase the distances"
            )
            return


def _gains(collector: FindingCollector, parts: dict[str, Any]) -> None:
    c: Constraint = parts.get("constraint", Constraint())
    if c.stabilisation == "none":
        return
    if not collector.right(("constraint",), "stabilisation", "alpha", "beta", "gamma"):
        return
    poles = "three poles at -p: alpha = 1.5 p, beta = sqrt(3) p, gamma = p^3"
    for key, needed in (("alpha", "> 0"), ("beta", "> 0"), ("gamma", ">= 0")):
        gain = getattr(c, key)
        if gain < 0 or (gain == 0 and key != "gamma"):
            remedy = f"use a stable gain ({poles}) or stabilisation = 'none' for no feedback"
            collector.add(("constraint", key), f"is unstable, must be {needed}", remedy, gain)
    bound = 2 * c.alpha * c.beta**2
    if bound <= c.gamma and collector.right(("constraint",), "alpha", "beta"):
        problem = f"is unstable, must be below 2 alpha beta^2 = {bound:.6g}"
        remedy = f"lower gamma or raise alpha or beta ({poles})"
        collector.add(("constraint", "gamma"), problem, remedy, c.gamma)


#: Weights below this value count as zero: the Riccati solution does not depend on them.
_NO_WEIGHT = 1e-12
#: Smallest ratio of the weight R to the largest other weight. Below it, the gains grow without bound.
_FREE = 1e-15


def _regulators(collector: FindingCollector, parts: dict[str, Any]) -> None:
    lqr: Lqr = parts.get("lqr", Lqr())
    for weights, path in ((lqr, ("lqr",)), (lqr.attitude, ("lqr", "attitude"))):
        _regulator(collector, weights, *path)
        if collector.right(("lqr",), "R") and collector.right(path, "R"):
            inherited = look_up(collector.data, (*path, "R")) is None
            _unbounded(collector, weights, ("lqr",) if inherited else path, ".".join(path))


def _regulator(collector: FindingCollector, weights: Regulator, *path: str) -> None:
    keys = ("horizon", "Q", "S")
    if not (collector.right(("lqr",), *keys) and collector.right(path, *keys)):
        return
    if weights.horizon == "infinite" and weights.Q[0] < _NO_WEIGHT:
        problem = f"an infinite horizon needs a weight of at least {_NO_WEIGHT:g} on the error"
        collector.add((*path, "Q"), problem, "for example, give Q = [1.0, 1.0]", weights.Q)
    if weights.horizon == "finite" and not any(weights.Q) and not any(weights.S):
        problem = "with Q and S zero the regulator does nothing"
        collector.add((*path, "S"), problem, "for example, give S = [1e3, 1e2]", weights.S)


def _unbounded(
    collector: FindingCollector, weights: Regulator | Tracking, where: Keys, name: str
) -> None:
    most = max(*weights.Q, *getattr(weights, "S", ()))
    if _FREE * most > weights.R:
        problem = f"is less than {_FREE:g} times the largest weight of {name}, {most:g}: the gains would be unbounded"
        remedy = f"raise R or lower the weights of {name}"
        collector.add((*where, "R"), problem, remedy, weights.R)


def _tracking(collector: FindingCollector, parts: dict[str, Any]) -> None:
    tracking: Tracking = parts.get("tracking", Tracking())
    if not collector.right(("tracking",), "Q"):
        return
    if tracking.Q[0] < _NO_WEIGHT:
        problem = f"tracking needs a weight of at least {_NO_WEIGHT:g} on the position error"
        collector.add(("tracking", "Q"), problem, "for example, give Q = [4.0, 4.0]")
    if collector.right(("tracking",), "R"):
        _unbounded(collector, tracking, ("tracking",), "tracking")


def _allocation(collector: FindingCollector, parts: dict[str, Any]) -> None:
    allocation: Allocation = parts.get("allocation", Allocation())
    if (
        allocation.method == "rigid"
        and "torque_split" in allocation.model_fields_set
        and collector.right(("allocation",), "method")
    ):
        problem = "has no effect with method 'rigid'"
        collector.add(("allocation", "torque_split"), problem, "remove it or use method = 'pinv'")


def _limits(collector: FindingCollector, parts: dict[str, Any]) -> None:
    limits = parts.get("limits", Limits())
    if limits.geofence is not None:
        _ordered(collector, limits.geofence, ("limits", "geofence"))
    if limits.separation_altitude is not None and limits.separation is None:
        where, problem = ("limits", "separation_altitude"), "has no effect without separation"
        collector.add(where, problem, "remove it or add separation")


def _yaw(collector: FindingCollector, parts: dict[str, Any]) -> None:
    yaw: VehicleYaw | None = parts.get("yaw")
    if yaw is None or not collector.right(("yaw",), "kind", "yaw_deg", "point"):
        return
    if yaw.kind == "towards" and yaw.point is None:
        collector.add(
            ("yaw", "point"), "is missing", "add point: the point to look at, [x, y, z] [m]"
        )
    for key, kind in (("yaw_deg", "fixed"), ("point", "towards")):
        if key in yaw.model_fields_set and yaw.kind != kind:
            problem = f"has no effect with kind '{yaw.kind}'"
            collector.add(("yaw", key), problem, f"remove it or use kind = '{kind}'")


def _planned(collector: FindingCollector, parts: dict[str, Any]) -> None:
    """Find limits of the plan in a mission whose plan keeps none."""
    limits = parts.get("limits", Limits())
    flown = vehicles.flies_vehicles(collector)  # the verdict judges their tilt
    jerks = (q.name for q in MOTIONS if q.order == 3)
    for key in jerks if flown else (*jerks, "tilt_deg"):
        if getattr(limits, key) is not None and parts.get("smoothness") == "lqr":
            problem = "has no effect: only the plan of a smooth mission keeps it"
            collector.add(
                ("limits", key), problem, "remove it or add smoothness = 'jerk' at the top"
            )


def _ordered(collector: FindingCollector, box: Box | Geofence, path: tuple[str | int, ...]) -> None:
    for axis, low, high in zip("xyz", box.min, box.max, strict=True):
        if low >= high:
            problem = f"min must be below max, but {axis} has {low:g} >= {high:g} m"
            collector.add(path, problem, "swap them", None)


def _obstacles(collector: FindingCollector) -> tuple[Obstacle, ...]:
    found = []
    for k, data in enumerate(phases.tables(collector, "obstacles")):
        kind = phases.kind(collector, data, ("obstacles", k), obstacles.KINDS)
        obstacle = None if kind is None else obstacles.checked(collector, kind, data, k)
        if isinstance(obstacle, Box):
            _ordered(collector, obstacle, ("obstacles", k))
        found += [obstacle] if obstacle is not None else []
    return tuple(found)
