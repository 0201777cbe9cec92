"""What a page shows: of a mission before anything flies, and of samples of a flight."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.plotting import agent_colours
from rigidfleet.typing import Floats, Ints
from rigidfleet.web.replay.pack import PackedColumn

if TYPE_CHECKING:
    pass
    from rigidfleet.mission import Mission
    from rigidfleet.result import Result

_LINES = 12  # in a plot at most; of more agents the least and the greatest
_BOXES = 200  # that an overview fits one by one; more together
_FLOOR = 1e-6  # least constraint error that is told apart from none [m]


def describe(mission: Mission, edges: Ints, tension: float) -> dict[str, Any]:
    """The things that stand still, the vehicles, edges (m, 2) and plots.

    Full colour of an edge stands for ``tension`` [N].
    """
    ground = [o.height for o in mission.obstacles if o.kind == "ground"]
    boxes = [o for o in mission.obstacles if o.kind == "box"]
    fence = mission.limits.geofence
    return {
        "name": mission.name,
        "title": mission.title,
        "radius": mission.agents.radius,
        "colours": agent_colours(mission.n_agents),
        "edges": edges,
        "tension": tension,
        "boxes": [{"name": o.name, "min": o.min, "max": o.max} for o in boxes],
        "fence": None if fence is None else {"min": fence.min, "max": fence.max},
        "ground": max(ground, default=0.0),
        "solid": bool(ground),
        "plots": _plots(mission),
    }


def observe(result: Result, shown: Ints, tension: float) -> dict[str, PackedColumn]:
    """Samples as the page sees them, at the result's times; ``shown`` are the edges drawn."""
    mission = result.mission
    # Fine enough for a view of one vehicle that fills the screen.
    fine = max(size(result), *mission.agents.radius, 1e-9) / 20_000
    force = result.input_force + result.constraint_force
    return {
        "position": PackedColumn(result.position, fine),
        "thrust": PackedColumn(thrust_directions(force, mission.fleet.mass), 5e-4),
        "slot": PackedColumn(result.slot_position - result.position, fine),
        "cm": PackedColumn(result.cm, fine),
        "attitude": PackedColumn(result.attitude, 1e-4),
        "reference": PackedColumn(result.attitude_reference, 1e-4),
        "tension": PackedColumn(-result.multiplier[:, shown], tension / 1000),
        **_plotted(result),
    }


def sight(mission: Mission, low: Floats, high: Floats) -> Floats:
    """Points (P, 3) [m] that an overview has in sight: 8 corners of a flight's box, then those of obstacles near it.

    Of what reaches further from the flight than the flight is long, the part that is near; ``low`` and
    ``high`` (3,) are the flight's least and greatest coordinates [m].
    """
    reach = max(float(np.linalg.norm(high - low)), 1e-6)
    seen = []
    for box in mission.obstacles:
        if box.kind == "box":
            near = np.maximum(box.min, low - reach), np.minimum(box.max, high + reach)
            seen += [near] if (near[0] <= near[1]).all() else []
    if len(seen) > _BOXES:
        seen = [(np.min([a for a, _ in seen], axis=0), np.max([b for _, b in seen], axis=0))]
    ends = np.array([(low, high), *seen])  # (1 + boxes, 2, 3)
    pick = np.indices((2, 2, 2)).reshape(3, 8)  # corners
    return np.stack([ends[:, pick[a], a] for a in range(3)], axis=2).reshape(-1, 3)


def thrust_directions(force: Floats, mass: Floats) -> Floats:
    """Unit vectors (..., N, 3) along the thrust, which a vehicle's rotors must point along.

    Upwards where there is next to no thrust (2 % of the weight on Earth), whose direction is noise.
    """
    strength = np.linalg.norm(force, axis=-1)
    up = np.maximum(0.2 * mass - strength, 0.0)
    force = force + up[..., None] * np.array([0.0, 0.0, 1.0])
    return force / np.maximum(np.linalg.norm(force, axis=-1, keepdims=True), 1e-300)


def size(result: Result) -> float:
    """Typical greatest distance [m] of an agent from the centre of mass."""
    reach = np.linalg.norm(result.position - result.cm[:, None], axis=2).max(axis=1)
    return float(np.median(reach))


def weight(mission: Mission) -> float:
    """Weight [N] of a vehicle; without gravity a tenth of that on Earth."""
    return float(np.mean(mission.agents.mass)) * max(mission.gravity, 1.0)


def _plots(mission: Mission) -> list[dict[str, Any]]:
    """Quantities drawn over time; ``column`` holds the samples of each."""
    n, limits = mission.n_agents, mission.limits
    basic = {
        "unit": "m",
        "colours": ["#20262D"],
        "worst": "greatest",
        "limits": [None],
        "least": None,
        "log": False,
        "floor": _FLOOR,
    }
    plots = [{"column": "thrust plot", **_thrust_plot(mission)}]
    if len(mission.edges):
        plots.append({"title": "Constraint error", "column": "error plot", "log": True})
    least = {"worst": "least", "least": limits.separation}
    if n > 1:
        plots.append({"title": "Separation", "column": "separation plot", **least})
    if mission.obstacles:
        plots.append({"title": "Clearance", "column": "clearance plot", **least, "least": 0.0})
    return [basic | plot for plot in plots]


def _alike(mission: Mission) -> list[Ints] | None:
    """Vehicles whose greatest thrust is one line, as they have one limit; None of too many limits."""
    limits = mission.fleet.thrust_limit
    if len(limits) <= _LINES:
        return [np.array([i]) for i in range(len(limits))]
    known = np.unique(limits)
    return [np.flatnonzero(limits == x) for x in known] if len(known) <= _LINES else None


def _thrust_plot(mission: Mission) -> dict[str, Any]:
    """Lines of thrust, each under its own limit."""
    alike, limits = _alike(mission), mission.agents.thrust_limit
    title, grey = "Greatest thrust", ["#8FA3B8", "#20262D"]
    if alike is None:  # as many limits: shares of them
        limit: dict[str, Any] = {"unit": "%", "colours": grey, "limits": [None, 100.0]}
        return {"title": f"{title}, of its limit", **limit}
    if len(alike) == 1 < len(limits):  # a crowd with one limit: the least and the greatest
        return {"title": title, "unit": "N", "colours": grey, "limits": [None, limits[0]]}
    own = [limits[int(who[0])] for who in alike]
    return {"title": title, "unit": "N", "colours": agent_colours(len(alike)), "limits": own}


def _thrust_lines(mission: Mission, thrust: Floats) -> Floats:
    """Samples (K, lines) of `_thrust_plot`."""
    alike = _alike(mission)
    if alike is None:
        thrust = 100.0 * thrust / mission.fleet.thrust_limit
    elif len(alike) > 1 or thrust.shape[1] == 1:
        return np.stack([thrust[:, who].max(axis=1) for who in alike], axis=1)
    return np.stack([thrust.min(axis=1), thrust.max(axis=1)], axis=1)


def _plotted(result: Result) -> dict[str, PackedColumn]:
    """Samples of each plot."""
    thrust = _thrust_lines(result.mission, result.thrust)
    # Where no edge is active there is no error.
    error = np.where(np.isnan(result.constraint), -1.0, np.abs(result.constraint))
    error = error.max(axis=1, initial=-1.0)
    samples = {
        "thrust plot": PackedColumn(thrust, 1e-3),
        "error plot": PackedColumn(np.where(error < 0.0, np.nan, error), _FLOOR),
        "separation plot": PackedColumn(result.separation, 1e-3),
        "clearance plot": PackedColumn(result.clearance, 1e-3),
    }
    return {plot["column"]: samples[plot["column"]] for plot in _plots(result.mission)}
