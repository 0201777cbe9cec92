"""Check a mission as a whole: first each table by itself, then conditions that involve several keys.

A table is checked even if another one has errors, so that one run reports all errors. A rule is skipped if it needs
a key that has an error itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from rigidfleet._common.quantities import MOTIONS
from rigidfleet.errors import MissionError
from rigidfleet.formation.graphs import count_pairs_within
from rigidfleet.formation.shapes import SHAPES
from rigidfleet.mission import (
    avoidance,
    bounds,
    disturbances,
    fences,
    formations,
    losses,
    network,
    obstacles,
    phases,
    vehicles,
)
from rigidfleet.mission.files import NOT_A_FILE
from rigidfleet.mission.findings import Keys, look_up, model_of, suggest_shape
from rigidfleet.mission.rules import Breach, Breaches, Draft, unused_key_rules
from rigidfleet.mission.schema import Agents, Contents, MissionHeader, Regulator, Start, Tracking

#: Models of the single tables. Obstacles, phases, fences and people are arrays of tables.
_TABLES = {
    key: model
    for key, field in Contents.model_fields.items()
    if (model := model_of(field.annotation)) is not None
    and key not in ("obstacles", "phases", *fences.TABLES)
}


@cache
def default_tables() -> dict[str, Any]:
    """What a mission has for tables that are not given: immutable; made anew, a load would take 1.4 times as long."""
    fields = Contents.model_fields.items()
    return {
        name: field.get_default(call_default_factory=True)
        for name, field in fields
        if not field.is_required()
    }


def check_parts(data: Mapping[str, Any], origin: str) -> dict[str, Any]:
    """Check the data of a mission and return its parts, by the fields of `Contents`.

    Raises
    ------
    MissionError
        With a finding for each error.
    """
    m = Draft(data, origin, default_tables())
    m.n = _count_agents(data)
    m.record_breaches((), _count_bound_rules(m))
    if m.findings:  # the other checks would take long
        raise MissionError(m.findings)
    _validate_tables(m)
    for path, rules in (
        (("agents",), _agent_rules),
        (("constraint",), _constraint_gain_rules),
        (("lqr",), _regulator_rules),
        (("tracking",), _tracking_rules),
        (("allocation",), _torque_allocation_rules),
        (("limits",), _limit_rules),
        (("yaw",), _yaw_rules),
        ((), _each_obstacle_rules),
        ((), _all_area_rules),
        (("formations",), formations.formation_rules),
        ((), _too_many_touching_rules),
        ((), phases.phase_rules),
        (("disturbances",), disturbances.disturbance_rules),
        (("network",), network.network_rules),
        ((), losses.loss_rules),
        (("disturbances",), disturbances.disturbance_storage_rules),
        ((), vehicles.vehicle_flight_rules),
        (("agents", "fixed"), _fixed_agent_rules),
        ((), avoidance.avoidance_rules),
    ):
        m.record_breaches(path, rules(m))
    if m.findings:
        raise MissionError(m.findings)
    return m.parts


def _count_bound_rules(m: Draft) -> Breaches:
    """Counts beyond the bounds, before anything else is checked."""
    agents, forms = m.data.get("agents"), m.data.get("formations")
    lists: list[tuple[Keys, int, str]] = [
        (("formations",), bounds.FORMATIONS, "split them into several missions"),
        (("phases",), bounds.PHASES, "split them into several missions"),
        (("obstacles",), bounds.OBSTACLES, "merge those that touch, and remove those out of reach"),
        *(((key,), bounds.FENCES, "merge those that touch") for key in fences.TABLES),
    ]
    if isinstance(agents, dict):
        lists += [(("agents", key), bounds.AGENTS, "use fewer agents") for key in agents]
    for path, most, remedy in lists:
        entries = look_up(m.data, path)
        if isinstance(entries, list | dict) and len(entries) > most:
            problem = f"has {len(entries):,} entries; the maximum is {most:,}"
            yield Breach(path, problem, remedy, None)
    n = m.n or 0
    if isinstance(forms, dict) and len(forms) > 1 and n * len(forms) > bounds.SLOTS:
        slots = n * len(forms)
        problem = f"{len(forms)} formations of {n:,} agents have {slots:,} slots; the maximum is {bounds.SLOTS:,}"
        yield Breach("formations", problem, "use fewer formations, or fewer agents", None)
    assignment = m.data.get("assignment", "given")
    if assignment != "each" and "assignment_downwash" in m.data:
        problem = f"has no effect with assignment {assignment!r}"
        yield Breach("assignment_downwash", problem, "use assignment = 'each', or remove this key")
    if assignment != "given" and n > bounds.ALL_PAIRS:
        problem = f"compares all agents with all slots, which takes too long for {n:,} agents"
        remedy = f"for more than {bounds.ALL_PAIRS:,} agents use 'given' and order the agents as their slots"
        yield Breach("assignment", problem, remedy)


def _validate_tables(m: Draft) -> None:
    """Validate the keys of the header and the tables; invalid ones are left out."""
    for key in m.data:
        if key not in Contents.model_fields:
            m.add_unknown_key((key,), Contents.model_fields)
    own = {key: value for key, value in m.data.items() if key in MissionHeader.model_fields}
    if header := m.validate(MissionHeader, own, ()):
        m.parts |= {key: getattr(header, key) for key in MissionHeader.model_fields}
    vehicles.validate_vehicles(m)
    for key, kind in _TABLES.items():
        if key in m.data:
            data = m.data[key]
            if key == "agents":
                data = vehicles.fill_agents_table(m, _replace_start_shape(m, data))
            part = None if data is None else m.validate(kind, data, (key,))
            m.parts |= {} if part is None else {key: part}
    if "agents" not in m.data:
        m.add(("agents",), "is missing", "add a table [agents] with mass and position")


def _replace_start_shape(m: Draft, agents_table: Any) -> Any:
    """Return [agents] with a shape of `position` replaced by its points; None if the shape has errors."""
    path, position = ("agents", "position"), look_up(agents_table, ("position",))
    if isinstance(position, str):
        remedy = "load the mission from its file, or give the positions as points"
        m.add(path, NOT_A_FILE, remedy)
        return None
    if not isinstance(position, dict):
        return agents_table
    start = m.validate(Start, position, path)
    if start is None or not m.is_valid((), "agents"):
        return None
    try:
        points = start.points()
    except ValueError as error:
        known = "" if start.shape in SHAPES else suggest_shape(start.shape)
        remedy = known or "change the shape, its size, or the number of agents"
        m.add((*path, "shape"), str(error), remedy)
        return None
    if not np.abs(points).max() <= bounds.LENGTH.most:
        problem = f"agents start farther than {bounds.LENGTH.most:g} m from the origin"
        m.add(path, problem, "reduce size, count or centre")
        return None
    return agents_table | {"position": points.tolist()}


def _count_agents(data: Mapping[str, Any]) -> int | None:
    """Number of agents; None if it is not known."""
    position = look_up(data, ("agents", "position"))
    if isinstance(position, dict):
        count = position.get("count")
        return count if type(count) is int and 0 < count <= bounds.AGENTS else None
    return len(position) if isinstance(position, list) and position else None


def _agent_rules(m: Draft) -> Breaches:
    """One entry per agent, apart from each other, with numbers that go together."""
    agents: Agents | None = m.agents
    if agents is None:
        return
    for key in ("mass", "velocity", "radius", "thrust_limit"):
        yield from m.one_per_agent_rules(agents, key)
    # Without a formation, nothing divides by distances: the start may be one that others flew.
    shaped = look_up(m.data, ("formations",))
    for i, j in formations.coincident_pairs(agents.position) if shaped else ():
        problem = f"agents {i + 1} and {j + 1} start at the same point"
        yield Breach(("position", j), problem, "move them apart", agents.position[j])
    if max(agents.mass, default=1.0) > bounds.MASS_RATIO * min(agents.mass, default=1.0):
        problem = f"the largest mass is more than {bounds.MASS_RATIO:g} times the smallest"
        yield Breach("mass", problem, "give all masses in kg")
    if any(bounds.FORCE.most < limit < math.inf for limit in agents.thrust_limit):
        yield Breach("thrust_limit", f"must be <= {bounds.FORCE.most:g}", "omit it for no limit")
    written = m.data["agents"].get("thrust_limit", 0.0)
    if math.inf in (written if isinstance(written, list) else [written]):
        yield Breach("thrust_limit", "is not finite", "omit it for no limit")
    unlimited = all(math.isinf(limit) for limit in agents.thrust_limit)
    if agents.saturate and unlimited and m.is_valid(("agents",), "thrust_limit"):
        yield Breach("saturate", "no limit to saturate at is given", "give thrust_limit [N]")


def _fixed_agent_rules(m: Draft) -> Breaches:
    """Fixed agents exist, and nothing is to move them or to change what they hold."""
    if m.findings or not m.agents.fixed:
        return
    agents, n, solver = m.agents, m.n or 0, m.constraint.solver
    yield from phases.named_agent_rules(m, agents.fixed)
    lost = m.disturbances and m.disturbances.lost
    for wrong, problem, remedy in (
        (any(any(agents.velocity[i - 1]) for i in agents.fixed if i <= n), "starts with a velocity", "remove it"),
        (agents.vehicle or lost, "needs points that are not lost", "remove these keys"),
        (solver not in ("pinv", "spectral"), "needs another solver", "use constraint.solver = 'pinv'"),
        (any(p.control != "open" for p in m.phases), "cannot track slots", "use control = 'open' in all phases"),
    ):  # fmt: skip
        if wrong:
            yield Breach((), problem, remedy)


def _too_many_touching_rules(m: Draft) -> Breaches:
    """No radii so large that a list of all touching pairs would fill memory."""
    n = m.n
    if m.findings or n is None or n * (n - 1) // 2 <= bounds.TOUCHING:
        return
    agents: Agents = m.agents
    places = {"at the start": np.array(agents.position)}
    places |= {f"in '{name}'": form.slot_array(n) for name, form in m.formations.items()}
    for where, points in places.items():
        pairs = 0 if points is None else count_pairs_within(points, 2 * max(agents.radius))
        if pairs > bounds.TOUCHING:
            problem = (
                f"with the largest radius, {pairs:,} pairs of agents touch {where};"
                f" the maximum is {bounds.TOUCHING:,}"
            )
            remedy = "reduce the radius or increase the distances"
            yield Breach(("agents", "radius"), problem, remedy)
            return


def _constraint_gain_rules(m: Draft) -> Breaches:
    """The feedback of constraints is stable."""
    c = m.constraint
    if c.stabilisation == "none":
        return
    if not m.is_valid(("constraint",), "stabilisation", "alpha", "beta", "gamma"):
        return
    poles = "three poles at -p: alpha = 1.5 p, beta = sqrt(3) p, gamma = p^3"
    for key, needed in (("alpha", "> 0"), ("beta", "> 0"), ("gamma", ">= 0")):
        gain = getattr(c, key)
        if gain < 0 or (gain == 0 and key != "gamma"):
            remedy = f"use a stable gain ({poles}) or stabilisation = 'none' for no feedback"
            yield Breach(key, f"is unstable, must be {needed}", remedy, gain)
    bound = 2 * c.alpha * c.beta**2
    if bound <= c.gamma and m.is_valid(("constraint",), "alpha", "beta"):
        problem = f"is unstable, must be below 2 alpha beta^2 = {bound:.6g}"
        yield Breach("gamma", problem, f"lower gamma or raise alpha or beta ({poles})", c.gamma)


#: Weights below this value count as zero: the Riccati solution does not depend on them.
_NO_WEIGHT = 1e-12
#: Smallest ratio of the weight R to the largest other weight. Below it, the gains grow without bound.
_FREE = 1e-15


def _regulator_rules(m: Draft) -> Breaches:
    """The regulators of the virtual body act, with gains that are bounded."""
    keys = ("horizon", "Q", "S")
    for weights, below in ((m.lqr, ()), (m.lqr.attitude, ("attitude",))):
        path = ("lqr", *below)
        if m.is_valid(("lqr",), *keys) and m.is_valid(path, *keys):
            if weights.horizon == "infinite" and weights.Q[0] < _NO_WEIGHT:
                problem = (
                    f"an infinite horizon needs a weight of at least {_NO_WEIGHT:g} on the error"
                )
                remedy = "for example, give Q = [1.0, 1.0]"
                yield Breach((*below, "Q"), problem, remedy, weights.Q)
            if weights.horizon == "finite" and not any(weights.Q) and not any(weights.S):
                problem = "with Q and S zero the regulator does nothing"
                remedy = "for example, give S = [1e3, 1e2]"
                yield Breach((*below, "S"), problem, remedy, weights.S)
        if m.is_valid(("lqr",), "R") and m.is_valid(path, "R"):
            inherited = look_up(m.data, (*path, "R")) is None
            yield from _bounded_gain_rules(weights, () if inherited else below, ".".join(path))


def _bounded_gain_rules(weights: Regulator | Tracking, below: Keys, name: str) -> Breaches:
    """R is large enough beside the other weights."""
    most = max(*weights.Q, *getattr(weights, "S", ()))
    if _FREE * most > weights.R:
        problem = f"is less than {_FREE:g} times the largest weight of {name}, {most:g}: the gains would be unbounded"
        yield Breach((*below, "R"), problem, f"raise R or lower the weights of {name}", weights.R)


def _tracking_rules(m: Draft) -> Breaches:
    """Tracking acts, with gains that are bounded."""
    if m.tracking.Q[0] < _NO_WEIGHT:
        problem = f"tracking needs a weight of at least {_NO_WEIGHT:g} on the position error"
        yield Breach("Q", problem, "for example, give Q = [4.0, 4.0]")
    if m.is_valid(("tracking",), "Q"):
        yield from _bounded_gain_rules(m.tracking, (), "tracking")


def _torque_allocation_rules(m: Draft) -> Breaches:
    """The torque is divided by the method that divides it."""
    if m.is_valid(("allocation",), "method"):
        yield from unused_key_rules(m.allocation, "torque_split", "method", "pinv")


def _limit_rules(m: Draft) -> Breaches:
    """Limits have an effect."""
    limits = m.limits
    if limits.geofence is not None:
        yield from _corner_rules(limits.geofence, ("geofence",))
    if limits.separation_altitude is not None and limits.separation is None:
        problem = "has no effect without separation"
        yield Breach("separation_altitude", problem, "remove it or add separation")
    jerks = (q.name for q in MOTIONS if q.order == 3)
    # Of vehicles, the verdict judges the tilt.
    for key in jerks if m.flies_vehicles else (*jerks, "tilt_deg"):
        if getattr(limits, key) is not None and not m.are_ways_smooth:
            problem = "has no effect: only the plan of a smooth mission keeps it"
            yield Breach(key, problem, "remove it or add smoothness = 'jerk' at the top")


def _yaw_rules(m: Draft) -> Breaches:
    """The yaw of vehicles has what its kind needs, and no more."""
    yaw = m.yaw
    if not m.is_valid(("yaw",), "kind", "yaw_deg", "point"):
        return
    if yaw.kind == "towards" and yaw.point is None:
        remedy = "add point: the point to look at, [x, y, z] [m]"
        yield Breach("point", "is missing", remedy)
    for key, kind in (("yaw_deg", "fixed"), ("point", "towards")):
        yield from unused_key_rules(yaw, key, "kind", kind)


def _corner_rules(box: Any, below: Keys) -> Breaches:
    """The lowest corner of a box is below the highest."""
    for axis, low, high in zip("xyz", box.min, box.max, strict=True):
        if low >= high:
            problem = f"min must be below max, but {axis} has {low:g} >= {high:g} m"
            yield Breach(below, problem, "swap them", None)


def _each_obstacle_rules(m: Draft) -> Breaches:
    """Each obstacle by itself."""
    things = []
    for k, data in enumerate(m.tables("obstacles")):
        path = ("obstacles", k)
        if (kind := m.model_class_of_kind(data, path, obstacles.OBSTACLE_KINDS)) is None:
            continue
        name = "ground" if kind is obstacles.Ground else f"{data['kind']} {k + 1}"
        if (thing := m.validate(kind, data, path, {"name": name})) is not None:
            m.record_breaches(path, obstacles.obstacle_rules(m, thing, path))
            if isinstance(thing, obstacles.Box):
                yield from _corner_rules(thing, path)
            things.append(thing)
    m.parts["obstacles"] = tuple(things)


def _all_area_rules(m: Draft) -> Breaches:
    """Each fence, and each place with people, by itself."""
    for table, (kind, word) in fences.TABLES.items():
        areas = []
        for k, data in enumerate(m.tables(table)):
            path = (table, k)
            if (area := m.validate(kind, data, path, {"name": f"{word} {k + 1}"})) is not None:
                m.record_breaches(path, fences.area_rules(m, area, path))
                areas.append(area)
        m.parts[table] = tuple(areas)
    if m.people and m.is_valid((), "gravity") and m.gravity < 1.0:
        remedy = "raise it, or remove [[people]]"
        yield Breach("gravity", "is too low for falls onto people", remedy)
    if m.limits.model_fields_set & {"people"} and not m.data.get("people"):
        yield Breach(("limits", "people"), "has no effect without people", "add [[people]]")
