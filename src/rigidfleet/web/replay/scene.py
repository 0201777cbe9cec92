"""Content of a page: from the mission, before the flight, and from samples of the flight."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.math import attitude as att
from rigidfleet.plotting import agent_colours
from rigidfleet.plotting.areas import fall_places_by_sample
from rigidfleet.plotting.logged import off_plan
from rigidfleet.plotting.quadrotors import has_rotors, rotor_forces, rotor_limit
from rigidfleet.result import quantities
from rigidfleet.result.lights import has_lights, light_colours
from rigidfleet.solids.outline import outline_of_solid
from rigidfleet.solids.records import swept_extent
from rigidfleet.typing import Floats, Ints
from rigidfleet.web.replay.pack import PackedColumn

if TYPE_CHECKING:
    from rigidfleet.mission import Mission, Obstacle
    from rigidfleet.mission.fences import Area
    from rigidfleet.result import PhaseRecord, Result

#: Greatest number of edges drawn; more would hide the vehicles.
EDGES = 3000
_LINES = 12  # greatest number of lines in a plot; for more agents, the least and the greatest value
#: Greatest number of obstacles that an overview fits one by one; more are fitted together.
_BOXES = 200
#: Distance from the flight up to which ways of obstacles are in sight, as a share of its length.
_BESIDE = 0.15
_FLOOR = 1e-6  # least constraint error that is distinguished from zero [m]


def describe_scene(result: Result, shown_edges: Ints, max_tension: float) -> dict[str, Any]:
    """Description of obstacles, fences, people, vehicles, ``shown_edges`` by number, and plots.

    Full colour of an edge stands for ``max_tension`` [N].
    """
    mission = result.mission
    boxes = [(o.name, o.box_bounds) for o in mission.obstacles if is_plain_box(o) and o.box_bounds]
    fence = mission.limits.geofence
    rotors = {"rotors": np.isfinite(rotor_limit(mission)).tolist()} if has_rotors(result) else {}
    return {
        "name": mission.name,
        "title": mission.title,
        "radius": mission.agents.radius,
        "colours": agent_colours(mission.n_agents),
        **rotors,
        "edges": result.edges[shown_edges],
        "tension": max_tension,
        "boxes": [{"name": name, "min": ends[:3], "max": ends[3:]} for name, ends in boxes],
        "solids": [_solid_surface(o) for o in mission.solids if not is_plain_box(o)],
        "fence": None if fence is None else {"min": fence.min, "max": fence.max},
        "areas": _area_rings(mission),
        "ground": mission.ground if np.isfinite(mission.ground) else 0.0,
        "solid": bool(np.isfinite(mission.ground)),
        "plots": [plot for plot, _ in _plots(result)],
    }


def describe_phases(phases: Sequence[PhaseRecord]) -> list[dict[str, Any]]:
    """Name, start and end [s] of each phase, and its goal [m]."""
    return [
        {"name": p.name, "start": p.t_start, "end": p.t_end, "position": (p.target or {}).get("position")}
        for p in phases
    ]  # fmt: skip


def is_plain_box(thing: Obstacle) -> bool:
    """Whether an obstacle is a box along the axes at rest, and no zone; the page has a picture of its own for these."""
    return thing.kind == "box" and thing.box_bounds is not None and not thing.zone


def _solid_surface(thing: Obstacle) -> dict[str, Any]:
    """Surface of an obstacle, to 0.1 mm, and its way: corners, triangles and lines as indices, times and places."""
    surface, solid = outline_of_solid(thing.solid), thing.solid
    points = np.concatenate([surface.triangles.reshape(-1, 3), surface.lines.reshape(-1, 3)])
    corners, index = np.unique(points.round(4), axis=0, return_inverse=True)
    index, cut = index.reshape(-1), 3 * len(surface.triangles)
    return {
        "name": thing.name,
        "zone": thing.zone,
        "corners": corners,
        "triangles": index[:cut],
        "lines": index[cut:],
        "times": solid.times,
        "ways": solid.ways,
        "there": [x if np.isfinite(x) else None for x in solid.there[0].tolist()],
    }


def _area_rings(mission: Mission) -> list[dict[str, Any]]:
    """Fences and places with people: their rings (m, 2) [m], and their heights [m], None where they have no end."""
    areas: list[tuple[Area, str, bool]] = [
        (x, "soft" if x.soft else "fence", x.kind == "exclusion") for x in mission.fences
    ]
    areas += [(x, "people", True) for x in mission.people]
    return [
        {
            "name": area.name,
            "kind": kind,
            "hatched": hatched,
            "rings": area.rings(mission.geodetic_origin),
            "heights": [x if np.isfinite(x) else None for x in area.height_span(mission.ground)],
        }
        for area, kind, hatched in areas
    ]


def page_samples(result: Result, edges: Ints, max_tension: float) -> dict[str, PackedColumn]:
    """Samples for the page, at the result's times; ``edges`` are those drawn."""
    mission = result.mission
    # Fine enough for a vehicle that fills the screen.
    fine = max(typical_formation_radius(result), *mission.agents.radius, 1e-9) / 20_000
    return {
        "position": PackedColumn(result.position, fine),
        **dict(_attitude_columns(result)),
        **dict(_optional_columns(result, edges, fine)),
        "slot": PackedColumn(result.slot_position - result.position, fine),
        "cm": PackedColumn(result.cm, fine),
        "attitude": PackedColumn(result.attitude, 1e-4),
        "reference": PackedColumn(result.attitude_reference, 1e-4),
        "tension": PackedColumn(_tensions(result, edges), max_tension / 1000),
        **{plot["column"]: samples for plot, samples in _plots(result)},
    }


def _tensions(result: Result, shown: Ints) -> Floats:
    """Tension (K, m) [N] of the edges shown, NaN while they are not active; 0 of a log, which tells no forces."""
    tension = -result.multiplier[:, shown]
    return np.where(np.isfinite(result.constraint[:, shown]), np.nan_to_num(tension), tension)


def _attitude_columns(result: Result) -> Iterator[tuple[str, PackedColumn]]:
    """Samples that turn vehicles: attitudes and shares of the rotors' limits, and of points the thrust's direction."""
    mission = result.mission
    limits = rotor_limit(mission)
    known = np.isfinite(limits) & has_rotors(result)
    if not known.all():
        force = result.input_force + result.constraint_force
        yield "thrust", PackedColumn(thrust_directions(force, mission.fleet.mass), 5e-4)
    q, force, saturated = result.vehicle_attitude, result.rotor_force, result.saturated
    if known.any() and q is not None and force is not None and saturated is not None:
        share = np.where(known[:, None], force / np.where(known, limits, 1.0)[:, None], 0.0)
        yield "turn", PackedColumn(att.unwrap_quaternion(q.swapaxes(0, 1)).swapaxes(0, 1), 1e-3)
        yield "rotors", PackedColumn(share, 0.01)
        yield "saturated", PackedColumn(np.where(result.left, saturated != 0, 0.0), 1.0)


def _optional_columns(
    result: Result, shown: Ints, fine: float
) -> Iterator[tuple[str, PackedColumn]]:
    """Samples that some flights have: layers of avoidance, lights, ages of messages, falls, doubt."""
    mission, layers, age = result.mission, result.avoidance_layers, result.message_age
    way = result.body_displacement
    if layers is not None and way is not None and result.clock_rate is not None:
        yield "clock", PackedColumn(result.clock_rate, 0.01)
        yield "aside", PackedColumn(np.linalg.norm(way, axis=1), 0.01)
        # 1 where barriers act, 2 the guard
        acts = np.where(layers > 1, 2.0, np.where(layers == 1, 1.0, 0.0))
        yield "acts", PackedColumn(acts, 1.0)
    if has_lights(result):  # red, green and blue
        yield "light", PackedColumn(light_colours(result, result.time), 1 / 255)
    if age is not None and (net := mission.network) is not None:
        # How near an edge is to being let go for want of messages, from 0 to 1
        oldest = np.where(np.isnan(age), np.inf, age)[:, shown].max(axis=2)
        yield "silent", PackedColumn(np.minimum(oldest / net.silence, 1.0), 0.01)
    if mission.fences or mission.people:
        yield "fall", PackedColumn(fall_places_by_sample(result), fine)
    if (off := off_plan(result)) is not None:
        yield "doubt", PackedColumn(off.doubt, fine)


def scene_points(mission: Mission, low: Floats, high: Floats) -> Floats:
    """Points (P, 3) [m] that an overview shows: 8 corners of the flight's box, then those of obstacles near it.

    An obstacle is cut at the distance from the flight that equals the flight's length, the way of one that moves
    nearer. ``low`` and ``high`` (3,) are the flight's least and greatest coordinates [m].
    """
    reach = max(float(np.linalg.norm(high - low)), 1e-6)
    boxes = []
    for box in mission.solids:  # of a height map only what is drawn
        ends = swept_extent(box.solid)
        if box.kind == "heights":
            ends[0, 2] = box.solid.heights.min()
        boxes.append((*ends, reach * (_BESIDE if box.solid.moves else 1.0)))
    for area in _area_rings(mission):
        flat, (floor, ceiling) = np.concatenate(area["rings"]), area["heights"]
        heights = low[2] if floor is None else floor, high[2] if ceiling is None else ceiling
        boxes.append((*np.column_stack([[flat.min(axis=0), flat.max(axis=0)], heights]), reach))
    near = [(np.maximum(a, low - far), np.minimum(b, high + far)) for a, b, far in boxes]
    seen = [ends for ends in near if (ends[0] <= ends[1]).all()]
    if len(seen) > _BOXES:
        seen = [(np.min([a for a, _ in seen], axis=0), np.max([b for _, b in seen], axis=0))]
    ends = np.array([(low, high), *seen])  # (1 + boxes, 2, 3)
    pick = np.indices((2, 2, 2)).reshape(3, 8)  # corners
    return np.stack([ends[:, pick[a], a] for a in range(3)], axis=2).reshape(-1, 3)


def thrust_directions(thrust: Floats, mass: Floats) -> Floats:
    """Unit vectors (..., N, 3) along the thrust, in which the vehicles' rotors point.

    Upwards if the thrust is below 2 % of the weight on Earth, since its direction is then noise.
    """
    strength = np.linalg.norm(thrust, axis=-1)
    up = np.maximum(0.2 * mass - strength, 0.0)
    thrust = thrust + up[..., None] * np.array([0.0, 0.0, 1.0])
    return thrust / np.maximum(np.linalg.norm(thrust, axis=-1, keepdims=True), 1e-300)


def typical_formation_radius(result: Result) -> float:
    """Typical greatest distance [m] of an agent from the centre of mass."""
    reach = np.linalg.norm(result.position - result.cm[:, None], axis=2).max(axis=1)
    return float(np.median(reach))


def mean_weight(mission: Mission) -> float:
    """Weight [N] of a vehicle; without gravity a tenth of that on Earth."""
    return float(np.mean(mission.agents.mass)) * max(mission.gravity, 1.0)


def _envelope_if_many(values: Floats) -> Floats:
    """Lines (K, L) of a plot: the values (K, N) of each vehicle, or of many the least and the greatest."""
    if values.shape[1] <= _LINES:
        return values
    return np.stack([np.fmin.reduce(values, axis=1), np.fmax.reduce(values, axis=1)], axis=1)


def _plots(result: Result) -> Iterator[tuple[dict[str, Any], PackedColumn]]:
    """Quantities drawn over time, as the page knows them, each with its samples."""
    mission, off, n = result.mission, off_plan(result), result.n_agents
    limits = mission.limits
    colours = agent_colours(n) if n <= _LINES else ["#8FA3B8", "#20262D"]

    def plot_entry(name: str, title: str, values: Floats, rounding_step: float, **look: Any) -> Any:
        basic = {
            "column": f"{name} plot", "title": title, "unit": "m", "colours": ["#20262D"], "worst": "greatest",
            "limits": [None], "least": None, "log": False, "floor": _FLOOR, "band": False,
        }  # fmt: skip
        return basic | look, PackedColumn(values, rounding_step)

    if has_rotors(result):
        share = 100.0 * rotor_forces(result).max(axis=2) / rotor_limit(mission)
        look: dict[str, Any] = {"unit": "%", "colours": colours, "limits": [100.0] * len(colours)}
        yield plot_entry("rotor", "Rotors, share of limit", _envelope_if_many(share), 0.1, **look)
    elif off is None and result.interpolation is None:  # else nobody knows the thrust
        title, thrust, most = "Greatest thrust", result.thrust, mission.fleet.thrust_limit
        look = {"unit": "N", "colours": colours, "limits": mission.agents.thrust_limit}
        if n > _LINES:  # with different limits, thrust is drawn as a share of them
            look["limits"] = [None, most[0]]
            if len(set(mission.agents.thrust_limit)) > 1:
                title, thrust = f"{title}, as share of limit", 100.0 * thrust / most
                look |= {"unit": "%", "limits": [None, 100.0]}
        yield plot_entry("thrust", title, _envelope_if_many(thrust), 1e-3, **look)
    if off is not None or has_rotors(result):
        worst, limit = quantities.samples(result, "tracking_error").worst, limits.tracking_error
        if off is not None:  # beside the line, the band that it may be in
            worst = np.stack([worst, *np.fmax.reduce(off.distance_interval, axis=2)], axis=1)
        yield plot_entry("off", "Tracking error", worst, 1e-4, limits=[limit], band=off is not None)
    if len(mission.edges):
        # Without active edges there is no error.
        error = np.where(np.isnan(result.constraint), -1.0, np.abs(result.constraint))
        error = error.max(axis=1, initial=-1.0)
        error = np.where(error < 0.0, np.nan, error)
        yield plot_entry("error", "Constraint error", error, _FLOOR, log=True)
    least = {"worst": "least", "least": limits.separation_at_all_heights}
    if n > 1:
        yield plot_entry("separation", "Separation", result.separation, 1e-3, **least)
    if mission.obstacles:
        yield plot_entry("clearance", "Clearance", result.clearance, 1e-3, **least | {"least": 0.0})
