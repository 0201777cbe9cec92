"""Write the text of a new mission: it has comments, flies as it is, and is meant to be edited."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from rigidfleet._common.renamed import getattr_of_earlier_names
from rigidfleet._common.templates import templates
from rigidfleet.formation import distance_geometry, shapes
from rigidfleet.math import proximity
from rigidfleet.mission.findings import suggest_shape
from rigidfleet.typing import Floats

#: Defaults of a new mission: mass of a vehicle [kg], its radius [m], size of the shape [m], waypoint [m].
MASS, RADIUS, SIZE, WAYPOINT = 1.2, 0.25, 4.0, (20.0, 10.0, 10.0)
#: Thrust-to-weight ratio of a typical vehicle.
LIFT = 2.2
#: Speed [m/s] and acceleration [m/s^2] from which the durations of phases are chosen.
_SPEED, _ACCELERATION = 4.0, 1.2
#: Distance of vehicles on the ground, centre to centre [m].
_APART = 1.2
#: Agents start below their slots. Those with slots above each other start on a grid with spacing _WIDE [m], more than
#: sqrt(2) (two radii + separation).
_WIDE = 1.5
#: Time to settle after a change of formation, and duration of the hold at the end [s].
_SETTLE, _HOLD = 2, 3
#: Approximate number of agent positions that the result of a new mission stores.
_STORED = 2e6
#: More than _ALL_PAIRS agents are held by their slots alone, without edges; MOST_AGENTS is the greatest number.
_ALL_PAIRS, MOST_AGENTS = 40, 2000
#: Column in which comments beside keys begin.
_COLUMN = 34


def draft(
    name: str,
    *,
    shape: str | None = None,
    agents: int | None = None,
    size: Sequence[float] = (SIZE,),
    mass: float = MASS,
    thrust_limit: float | None = None,
    waypoints: Sequence[Sequence[float]] | None = None,
    file: str = "",
) -> str:
    """Return the TOML text of a mission: take off, form a shape, fly it to waypoints, hold.

    With a shape and a number of agents alone, the mission flies as it is. Other numbers are not validated here but when
    the mission is checked. Agents start below their slots; where slots lie above each other, they start on a grid
    and take the nearest slots.

    Parameters
    ----------
    shape : a name in `rigidfleet.formation.shapes.SHAPES`; by default one that suits the number of agents
    agents : number of agents; by default as many as the shape needs
    size : edge length of the shape [m], or its three sizes
    mass : mass of each agent [kg]
    thrust_limit : maximum thrust of each agent [N]; by default 2.2 times its weight
    waypoints : waypoints of the centre of mass [m], in order; by default one that is high enough
    file : name of the file, for the comments

    Raises
    ------
    ValueError
        The shape is unknown or does not suit the number of agents or sizes; there are too many agents; a number is
        not finite; or a waypoint is too close to the ground.
    """
    if shape is None:
        shape = shape_for(agents)
    check_shape_name(shape)
    n = agents_for(shape) if agents is None else agents
    if n > MOST_AGENTS:
        raise ValueError(f"{n} agents are too many: a new mission has at most {MOST_AGENTS}")
    if not np.isfinite([thrust_limit or 0.0, mass, *size, *np.ravel(waypoints or ())]).all():
        raise ValueError("masses, sizes, limits and waypoints must be finite")
    if len(size) == 1 and shapes.SHAPES[shape].sizes == 3:
        size = [size[0]] * 3
    slots = shapes.slots(shape, list(size), n)
    nearest = float(proximity.nearest(slots).min()) if n > 1 else SIZE
    radius = min(RADIUS, nearest / 4)
    start, below = _starts_and_whether_below(slots, min(_APART, nearest))
    low = float(-slots[:, 2].min()) + radius
    height = max(5.0, math.ceil(np.ptp(slots[:, 2]) + 3.0))
    if waypoints is None:
        waypoints = [(*WAYPOINT[:2], max(WAYPOINT[2], math.ceil(low + 3.0)))]
    for number, waypoint in enumerate(waypoints, start=1):
        if waypoint[2] < low:
            raise ValueError(
                f"waypoint {number} is at z = {waypoint[2]:g} m, but the {shape} reaches {low:.3g} m below its centre:"
                f" use z = {math.ceil(low + 0.5)} m or higher"
            )
    centre = start.mean(axis=0)
    aloft = np.array([centre[0], centre[1], height])
    way = float(np.linalg.norm(slots - (start - centre), axis=1).max())
    if not below:  # some agents cross the whole shape
        way = float(np.linalg.norm(np.ptp(np.vstack([slots, start - centre]), axis=0)))
    blend = max(4, blend_time(way))
    stops, climb = np.array([aloft, *waypoints]), _rest_to_rest_seconds(aloft - centre)
    # Each waypoint as a list in TOML, and the duration of the way there.
    flights = [(_toml_row(b), _rest_to_rest_seconds(b - a)) for a, b in pairwise(stops)]
    lasts = climb + blend + _SETTLE + sum(time for _, time in flights) + _HOLD
    limit = math.ceil(LIFT * mass * 9.81) if thrust_limit is None else thrust_limit
    extent = json.dumps([float(x) for x in size]) if len(size) > 1 else f"{size[0]:g}"
    text = templates("rigidfleet.mission", escape=False).get_template("mission.toml").render(
        name=json.dumps(name, ensure_ascii=False), file=file or f"{name}.toml",
        title=f"{n} vehicles fly as a {shape}" if n > 1 else "One vehicle flies",
        mass=f"{mass:g}", start=[_toml_row(place) for place in start], below=below, step=output_step(n, lasts),
        radius=f"{radius:.3g}", thrust=f"{limit:g}", shape=shape, size=extent, many=n > _ALL_PAIRS,
        takes=shapes.agents_taken(shape), text=shapes.SHAPES[shape].text, separation=f"{min(0.5, nearest / 6):.3g}",
        # In a small spatial shape, or one of many agents, some agents pass below others in any case.
        warned=below and (distance_geometry.dimension(slots) < 3 or nearest >= 3.0),
        aloft=_toml_row(aloft), climb=climb, blend=blend, settle=_SETTLE, flights=flights, hold=_HOLD,
    )  # fmt: skip
    return align_comments(text)


def check_shape_name(shape: str) -> None:
    """Raise ValueError, with the most similar name, if there is no such shape."""
    if shape not in shapes.SHAPES:
        raise ValueError(f"there is no shape {shape!r}: {suggest_shape(shape)}")


def shape_for(agents: int | None) -> str:
    """Return the usual shape for a number of agents."""
    usual = {None: "triangle", 1: "line", 2: "line", 3: "triangle", 4: "square", 6: "hexagon"}
    return usual.get(agents, "cube" if agents == 8 else "polygon")


def agents_for(shape: str) -> int:
    """Return the usual number of agents of a shape."""
    usual = {"line": 3, "polygon": 5, "pyramid": 5, "v": 5, "grid": 9, "sphere": 12, "helix": 12}
    return usual.get(shape, shapes.SHAPES[shape].agents.start)


def _starts_and_whether_below(slots: Floats, apart: float) -> tuple[Floats, bool]:
    """Return start positions (N, 3) [m] on the ground, and whether each is below its slot.

    Where slots lie above each other, agents start on a grid, or few on a line.
    """
    n = len(slots)
    across = slots * [1.0, 1.0, 0.0]
    ground = np.array([0.0, 0.0, 0.3])
    if n == 1 or proximity.nearest(across).min() >= apart * (1 - 1e-9):
        return across + ground, True
    # Straight paths to the nearest slots need this spacing (docs/many.md).
    pads = "grid" if n in shapes.SHAPES["grid"].agents else "line"
    return shapes.slots(pads, max(_WIDE, apart), n) + ground, False


def blend_time(way: float) -> int:
    """Duration [s] of a blend, or of a smooth flight, over a distance [m] that keeps to `_SPEED` and `_ACCELERATION`.

    The septic blend has a peak rate of 35/16 times the mean and a peak second derivative of 7.52.
    """
    return math.ceil(max(35 / 16 * way / _SPEED, math.sqrt(7.52 * way / _ACCELERATION)))


def output_step(n: int, lasts: float) -> float:
    """Time between samples [s] with which a mission of this duration [s] does not store too much."""
    return math.ceil(20 * lasts * n / _STORED) / 20


def _rest_to_rest_seconds(way: Floats) -> int:
    """Duration [s] of a rest-to-rest flight by a vector (3,) [m] that keeps to `_SPEED` and `_ACCELERATION`."""
    return max(4, blend_time(float(np.linalg.norm(way))))


def align_comments(text: str) -> str:
    """Align the comments beside keys in one column."""
    beside = re.compile(r"^([^#\n]*[^#\s]) +# ?(.*)$", re.MULTILINE)
    return beside.sub(lambda m: f"{m[1]:<{_COLUMN - 1}} # {m[2]}", text)


__getattr__ = getattr_of_earlier_names(
    __name__, shape_known="check_shape_name", aligned="align_comments"
)


def _toml_row(values: Sequence[float] | Floats) -> str:
    # Adding zero removes the sign of a negative zero.
    return f"[{', '.join(f'{round(float(x), 3) + 0.0:g}' for x in values)}]"
