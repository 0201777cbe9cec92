"""Fences and places with people, drawn on the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.plotting import style as st
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D

    from rigidfleet.mission import Mission

#: Colour of places with people.
PEOPLE = "#6A3D9A"


def areas(mission: Mission) -> list[tuple[str, list[Floats], dict[str, Any]]]:
    """Name, rings (m, 2) [m] and look of each fence and place with people; hatched where no vehicle may be."""
    drawn: list[tuple[str, list[Floats], dict[str, Any]]] = []
    looks: list[dict[str, Any]] = []
    for fence in mission.fences:
        looks.append({"edgecolor": st.ALERT, "facecolor": "none", "linewidth": 1.1})
        looks[-1] |= {"linestyle": (0, (4, 2))} if fence.soft else {}
        looks[-1] |= {"hatch": "////"} if fence.kind == "exclusion" else {}
    looks += [{"edgecolor": PEOPLE, "facecolor": f"{PEOPLE}2E", "linewidth": 0.8}] * len(
        mission.people
    )
    for x, look in zip((*mission.fences, *mission.people), looks, strict=True):
        rings = [ring for polygon in x.polygons(mission.geodetic_origin) for ring in polygon]
        drawn.append((x.name, rings, look))
    return drawn


def draw_from_above(ax: Axes, mission: Mission) -> None:
    """Draw fences and people from above, with their names as far as these fit."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    for name, rings, look in areas(mission):
        path = Path.make_compound_path(*(Path([*ring, ring[0]], closed=True) for ring in rings))
        patch = ax.add_patch(PathPatch(path, **look, zorder=1.2, gid="area"))
        low, high = rings[0].min(axis=0), rings[0].max(axis=0)
        st.name_box(ax, patch, 0.5 * (low[0] + high[0]), low[1], name)


def draw_in_space(ax: Axes3D, mission: Mission, floor: float) -> None:
    """Draw fences and people on a plane at a height [m]."""
    for _, rings, look in areas(mission):
        style = {key: look[key] for key in ("linewidth", "linestyle") if key in look}
        for ring in rings:
            x, y = np.vstack([ring, ring[:1]]).T
            ax.plot(x, y, np.full(len(x), floor), color=look["edgecolor"], **style, zorder=1)
