"""Fences and places with people, drawn on the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.plotting import style as st
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

    from rigidfleet.mission import Mission
    from rigidfleet.mission.fences import Area
    from rigidfleet.result import Result

#: Colour of places with people.
PEOPLE = "#6A3D9A"
#: Line of a soft fence.
_SOFT = 0, (4, 2)
#: Colour of places where vehicles fall; the most places of a kind that are drawn.
_FALLS, _MOST = "#E69F00", 4000


def drawn_areas(mission: Mission) -> list[tuple[str, list[Floats], dict[str, Any]]]:
    """Name, rings (m, 2) [m] and look of each fence and place with people; hatched where no vehicle may be."""
    drawn: list[tuple[Area, dict[str, Any]]] = []
    for fence in mission.fences:
        look: dict[str, Any] = {"edgecolor": st.ALERT, "facecolor": "none", "linewidth": 1.1}
        look |= {"linestyle": _SOFT} if fence.soft else {}
        look |= {"hatch": "////"} if fence.kind == "exclusion" else {}
        drawn.append((fence, look))
    look = {"edgecolor": PEOPLE, "facecolor": f"{PEOPLE}2E", "linewidth": 0.8}
    drawn += [(people, look) for people in mission.people]
    return [(area.name, area.rings(mission.geodetic_origin), look) for area, look in drawn]


def draw_areas_from_above(ax: Axes, mission: Mission) -> None:
    """Draw fences and people from above, with their names as far as these fit."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    for name, rings, look in drawn_areas(mission):
        path = Path.make_compound_path(*(Path([*ring, ring[0]], closed=True) for ring in rings))
        patch = ax.add_patch(PathPatch(path, **look, zorder=1.2, gid="area"))
        low, high = rings[0].min(axis=0), rings[0].max(axis=0)
        st.name_box(ax, patch, 0.5 * (low[0] + high[0]), low[1], name)


def draw_areas_in_space(ax: Axes3D, mission: Mission, floor: float) -> None:
    """Draw fences and people on a plane at a height [m]."""
    for _, rings, look in drawn_areas(mission):
        style = {key: look[key] for key in ("linewidth", "linestyle") if key in look}
        for ring in rings:
            x, y = np.vstack([ring, ring[:1]]).T
            ax.plot(x, y, np.full(len(x), floor), color=look["edgecolor"], **style, zorder=1)


def fall_places_by_sample(result: Result) -> Floats:
    """Where each vehicle falls that fails at a sample: places (K, N, 2) [m], as `Boundaries.ends_of_falls`.

    Terrain and roofs count at some heights of each fall. NaN where nothing falls, for want of gravity.
    """
    from rigidfleet.mission.boundaries import Boundaries

    if result.mission.gravity < 1.0:
        return np.full((*result.position.shape[:2], 2), np.nan)
    return Boundaries(result.mission).ends_of_falls(result.position, result.velocity)[..., :2]


@st.styled_figure()
def draw_ground(result: Result, falls: Floats) -> Figure:
    """The ground from above: fences, people, and where vehicles fly and fall (`fall_places_by_sample`)."""
    from matplotlib.patches import Patch

    fig = st.blank_figure(5.2, 3.6, "constrained")
    ax = fig.subplots()
    draw_areas_from_above(ax, result.mission)
    handles = []
    for what, places, colour in (
        ("vehicles that fail fall", falls, _FALLS),
        ("vehicles fly", result.position[..., :2], st.FLOWN),
    ):
        flat = places[result.left]
        ax.plot(*flat[:: 1 + len(flat) // _MOST].T, ".", markersize=2, color=colour, zorder=2)
        handles.append(st.legend_entry(what, linestyle="", marker="o", markersize=5, color=colour))
    drawn = drawn_areas(result.mission)
    for look in {str(look): look for *_, look in drawn}.values():
        names = ", ".join(name for name, _, other in drawn if other == look)
        handles.append(Patch(label=st.clean_name(names, 80), **look))
    ax.set(xlabel="x, east [m]", ylabel="y, north [m]")
    ax.margins(0.06)
    ax.set_aspect("equal", adjustable="box")
    fig.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 4))
    return fig
