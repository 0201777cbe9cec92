"""Write the text of a new show: take off from a grid, go through formations, return and land."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rigidfleet._common.templates import templates
from rigidfleet._common.toml import toml_key
from rigidfleet.formation import shapes
from rigidfleet.formation.assignment import assign_slots
from rigidfleet.formation.point_files import Points
from rigidfleet.formation.rest import rest_places_beside
from rigidfleet.math import proximity
from rigidfleet.mission.draft import (
    LIFT,
    MOST_AGENTS,
    align_comments,
    blend_time,
    check_shape_name,
    output_step,
)
from rigidfleet.typing import Floats

#: Mass of a vehicle of a show [kg], greatest radius [m], and that as a share of the spacing.
_MASS, _RADIUS, _SLIM = 0.3, 0.15, 1 / 8
#: Least height of a slot above the ground and of the whole show [m], and of a vehicle that stands.
_ALOFT, _LOWEST, _STANDS = 5.0, 10.0, 0.05
#: Share of the distance that is proved, which the mission asks for.
_SHARE = 0.9
#: Times to hold each formation, and to settle after a change [s].
_SHOWN, _SETTLED = 4.0, 1.0
#: Rise of a turn of a helix, in spacings.
_RISE = 1.5


class ShowFormation(NamedTuple):
    """A formation of a show.

    Attributes
    ----------
    name : of the formation
    slots : (N, 3) [m]
    table : lines of its table, `shape` and `size`, or `slots`
    """

    name: str
    slots: Floats
    table: str


def shape_scene(shape: str, agents: int, spacing: float) -> ShowFormation:
    """A named shape whose nearest two agents are a spacing [m] apart.

    Raises
    ------
    ValueError
        There is no such shape, or not for this number of agents.
    """
    check_shape_name(shape)
    if not 0.0 < spacing < math.inf:
        raise ValueError(f"the spacing must be a positive length, not {spacing:g}")
    size = [spacing] * shapes.SHAPES[shape].sizes
    if shape == "helix":  # as high as it is wide: N spacing / (2 pi R) turns of one rise each
        rise = _RISE * spacing
        size = [round(math.sqrt(agents * spacing * rise / (4 * math.pi)), 3), rise, spacing]
    slots = shapes.slots(shape, size, agents)
    least = float(proximity.nearest(slots).min())
    if least < spacing * (1 - 1e-9):
        size = [math.ceil(1e3 * x * spacing / least) / 1e3 for x in size]
        slots = shapes.slots(shape, size, agents)
    written = json.dumps(size if len(size) > 1 else size[0])
    return ShowFormation(
        shape, slots, f'shape = "{shape}"\nsize = {written}                 # [m]\n'
    )


def points_scene(name: str, points: Points, source: str, *, by_name: bool = False) -> ShowFormation:
    """A formation of points, written as numbers, with their notes as comments, or by the name of their file."""
    slots, colours, notes = points
    if by_name:
        return ShowFormation(name, slots, f"slots = {json.dumps(source)}\n")
    lights = "" if colours is None else f"colour = {json.dumps(colours)}\n"
    rows = "".join(f"    {row},\n" for row in np.round(slots + 0.0, 6).tolist())
    about = "".join(f"# {note}\n" for note in (f"points of {json.dumps(source)}", *notes))
    return ShowFormation(name, slots, f"{about}slots = [\n{rows}]\n{lights}")


def _add_resting_vehicles(one: ShowFormation, agents: int) -> ShowFormation:
    """A scene in which the vehicles that have no point rest at its sides."""
    waiting = agents - len(one.slots)
    if waiting < 1:
        return one
    slots = np.concatenate([one.slots, rest_places_beside(one.slots, waiting)])
    line = f'rest = "sides"                  # {waiting} vehicles wait, dark\n'
    return ShowFormation(one.name, slots, one.table + line)


def show_mission_text(
    name: str, scenes: Sequence[ShowFormation], *, agents: int, spacing: float, mass: float = _MASS,
    thrust_limit: float | None = None, file: str = "",
) -> str:  # fmt: skip
    """Return the TOML text of a show: from a grid through the scenes, and back.

    Slots are assigned anew at each change, with the least squares of all ways, so that two agents come no nearer than
    the spacing over sqrt(2) (`rigidfleet.formation.assignment.assign_slots`).

    Raises
    ------
    ValueError
        There are too many or too few agents, a scene has another number of them or is too narrow, or a number is not
        positive.
    """
    if not 2 <= agents <= MOST_AGENTS:
        raise ValueError(f"a show takes 2 to {MOST_AGENTS} agents, not {agents}")
    numbers = {"spacing": spacing, "mass": mass, "thrust limit": thrust_limit or 1.0}
    for what, value in numbers.items():
        if not 0.0 < value < math.inf:
            raise ValueError(f"the {what} must be a positive number, not {value:g}")
    if not scenes:
        raise ValueError("a show needs formations")
    ground = "grid" if agents in shapes.SHAPES["grid"].agents else "line"
    pads = shape_scene(ground, agents, spacing)._replace(name="pads")
    tables, scenes = {"pads": pads}, [_add_resting_vehicles(one, agents) for one in scenes]
    for i, one in enumerate(scenes):
        key, k = one.name, 2
        while key == "pads" or tables.get(key, one).table != one.table:
            key, k = f"{one.name} {k}", k + 1
        scenes[i] = tables[key] = one._replace(name=key)
    for one in scenes:
        if len(one.slots) != agents:
            raise ValueError(f"'{one.name}' has {len(one.slots)} points for {agents} agents")
        least = float(proximity.nearest(one.slots).min())
        if least < spacing * (1 - 1e-6):
            raise ValueError(f"the points of '{one.name}' are {least:.3g} m apart, not {spacing:g}")
    radius = min(_RADIUS, _SLIM * spacing)
    height = max(_LOWEST, math.ceil(max(-one.slots[:, 2].min() for one in scenes) + _ALOFT))
    start = radius + _STANDS
    climb = blend_time(height - start)
    places, lasts, phases, taken = pads.slots, 2.0 * climb, [], set[str]()
    for k, one in enumerate([*scenes, pads]):
        slots = one.slots - one.slots.mean(axis=0)
        slots = slots[assign_slots(places, slots, turn=np.eye(3)).order]
        blend = max(4, blend_time(float(np.linalg.norm(slots - places, axis=1).max())))
        title = one.name if one.name not in taken else f"{one.name}, phase {k + 2}"
        shown = _SHOWN if one is not pads else _SETTLED
        phases.append({
            "name": json.dumps(title), "kind": "reshape" if k else "establish", "formation": json.dumps(one.name),
            "blend": f"{blend:.1f}", "duration": f"{blend + shown:.1f}",
        })  # fmt: skip
        taken.add(one.name)
        places, lasts = slots, lasts + blend + shown
    separation = math.floor(100 * _SHARE * (spacing / math.sqrt(2) - 2 * radius)) / 100
    if separation <= 0.0:
        raise ValueError(f"a spacing of {spacing:g} m is too small for a show")
    what = f"A show of {agents} vehicles: {', '.join(one.name for one in scenes)}"
    what = " ".join(what.split())  # a name may have line breaks
    text = templates("rigidfleet.mission", escape=False).get_template("show.toml").render(
        name=json.dumps(name, ensure_ascii=False), file=file or f"{name}.toml",
        what=what, title=json.dumps(what, ensure_ascii=False),
        step=output_step(agents, lasts), mass=f"{mass:g}", radius=f"{radius:.3g}",
        limit=math.ceil(LIFT * mass * 98.1) / 10 if thrust_limit is None else f"{thrust_limit:g}",
        spacing=f"{spacing:g}", agents=agents, ground=ground, start=f"{start:.4g}", separation=f"{separation:g}",
        formations={toml_key(key): one.table for key, one in tables.items()},
        height=f"{height:.1f}", climb=f"{climb:.1f}", phases=phases,
    )  # fmt: skip
    return align_comments(text)
