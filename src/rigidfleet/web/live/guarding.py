"""Keeping a flight by hand out of walls and ground: the guard of [avoidance], where the mission allows it."""

from __future__ import annotations

from typing import Any

import numpy as np

from rigidfleet.errors import MissionError
from rigidfleet.math import proximity
from rigidfleet.mission import Mission

#: Greatest number of vehicles that fly with the guard in real time.
_MOST = 100
#: Distance from obstacles that the guard keeps, unless a vehicle starts nearer [m].
_CLEARANCE = 0.1


def with_avoidance_or_reason(mission: Mission) -> tuple[Mission, str]:
    """The mission with [avoidance], and why not if that is impossible.

    Points fly as vehicles of the model "point", with the same mass, thrust limit and drag. The mission's text then has
    [vehicles] and [avoidance].
    """
    if mission.avoidance is not None and mission.avoidance.guard:
        return mission, ""
    if mission.avoidance is not None:
        return mission, "the mission switches the guard off"
    if mission.n_agents > _MOST:
        return mission, f"more than {_MOST} vehicles"
    if not np.isfinite(mission.fleet.thrust_limit).all():
        return mission, "a vehicle has no limit of thrust"
    fleet = mission.fleet
    near, _ = proximity.obstacle_clearances(fleet.position, fleet.radius, mission.obstacles)
    clear = min(_CLEARANCE, float(near.min()))
    if clear < 0.0:
        return mission, "a vehicle starts in an obstacle"
    data = mission.to_dict()
    if mission.vehicle_models is None:
        data |= _points_as_vehicles(mission, data)
    try:
        return mission.rewritten(data | {"avoidance": {"clearance": clear}}), ""
    except MissionError as error:
        return mission, error.findings[0].problem


def _points_as_vehicles(mission: Mission, data: dict[str, Any]) -> dict[str, Any]:
    """Tables in which the points of a mission are vehicles of their own."""
    kinds: dict[tuple[float, ...], str] = {}
    names = []
    for properties in zip(
        mission.agents.mass, mission.agents.thrust_limit, mission.drag, strict=True
    ):
        names.append(kinds.setdefault(properties, f"point {len(kinds) + 1}"))
    agents = {
        k: x for k, x in data["agents"].items() if k not in ("mass", "thrust_limit", "saturate")
    }
    tables: dict[str, Any] = {
        "agents": agents | {"vehicle": names},
        "vehicles": {
            name: {"model": "point", "mass": mass, "thrust_limit": float(limit), "drag": float(drag)}
            for (mass, limit, drag), name in kinds.items()
        },
    }  # fmt: skip
    if "disturbances" in data:
        tables["disturbances"] = {k: x for k, x in data["disturbances"].items() if k != "drag"}
    return tables
