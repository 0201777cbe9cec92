"""The figure of the trajectory among the obstacles, in space and from above."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rigidfleet.plotting import areas, solids
from rigidfleet.plotting import style as st
from rigidfleet.result import Result
from rigidfleet.result.lights import angles_facing_formation as seen
from rigidfleet.result.lights import has_lights, light_colours
from rigidfleet.solids.records import box_corners
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D


_GROUND = "#E9E6DF"
_AZIMUTH, _ELEVATION = -55.0, 24.0  # of the camera [deg]
#: Least and greatest elevation of the camera in front of lights, and how far it stands aside, to show the axes [deg].
_LOW, _HIGH, _ASIDE = 12.0, 60.0, 15.0
_TRAIL = 1500  # points of an agent's path
_LINES = 2000  # edges that are drawn among paths
_ONE_PLACE = 0.03  # distance of waypoints that have one name, as a share of the scene's diagonal


# -- the content ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """Paths, formations and surroundings of a flight, limited to what can be drawn."""

    paths: Floats  # (K', N, 3) [m]
    centre: Floats  # (K', 3) path of the centre of mass [m]
    shots: list[int]  # samples at which the formation is drawn
    low: Floats  # (3,) corners of the space shown [m]
    high: Floats
    floor: float  # height of the plane that shadows fall on [m]
    ground: bool  # whether this plane is the ground
    shapes: list[solids.DrawnObstacle]
    waypoints: list[tuple[str, Floats]]


def trajectory_scene(result: Result) -> Scene:
    """Content of the trajectory figure."""
    mission, r = result.mission, result.position
    rows = np.flatnonzero(np.isfinite(r).all(axis=(1, 2)))
    thin = rows[st.spaced_indices(len(rows), _TRAIL if r.shape[1] <= st.MANY else _TRAIL // 10)]
    waypoints = _waypoints(result)
    seen = np.concatenate([r[thin].reshape(-1, 3), *(place[None] for _, place in waypoints)])
    seen = seen if len(seen) else np.zeros((1, 3))
    low, high = seen.min(axis=0), seen.max(axis=0)
    near = float((high - low).max()) + 5.0
    if stands := mission.ground > low[2] - near:  # on a ground that is near
        low[2] = min(low[2], mission.ground)
    begin, end = float(result.time[0]), float(result.time[-1])
    shapes = solids.drawn_obstacles(mission, begin, end, low - near, high + near)
    seen_too = [np.clip(shape.extent, low - near, high + near) for shape in shapes]
    for _, rings, _ in areas.drawn_areas(mission):
        flat = np.concatenate(rings)
        ends = np.array([[*f(flat, axis=0), z] for f, z in ((np.min, low[2]), (np.max, high[2]))])
        seen_too.append(np.clip(ends, low - near, high + near))
    low = np.minimum.reduce([low, *(ends[0] for ends in seen_too)])
    high = np.maximum.reduce([high, *(ends[1] for ends in seen_too)])
    # A margin around it; no direction too thin to see.
    size = float((high - low).max()) or 2.0
    lack = np.maximum(0.3 * size - (high - low), 0.08 * size) / 2
    floor = mission.ground if stands else low[2] - lack[2]
    high = high + lack
    low = np.array([low[0] - lack[0], low[1] - lack[1], min(floor, low[2])])
    shots = _drawn_samples(result, rows)
    return Scene(r[thin], result.cm[thin], shots, low, high, floor, stands, shapes, waypoints)


def _waypoints(result: Result) -> list[tuple[str, Floats]]:
    """Short name and position of each waypoint, once for each position."""
    names: dict[tuple[float, ...], str] = {}
    for phase, at in st.phase_targets(result):
        if at.get("position") is not None:
            place = tuple(np.round(np.asarray(at["position"], dtype=float), 6).tolist())
            names.setdefault(place, st.clean_name(phase.name.split(":")[0], 12))
    return [(name, np.array(place)) for place, name in names.items()]


def _waypoint_names_by_place(view: Scene, axes: int) -> list[tuple[str, Floats]]:
    """Names of the waypoints, of those joined that are at one place as it is seen in 2 or 3 axes.

    Several waypoints of one name have it at the last one.
    """
    near = _ONE_PLACE * np.linalg.norm(view.high - view.low)
    joined: list[tuple[list[str], Floats]] = []
    for name, place in dict(view.waypoints).items():
        there = (names for names, at in joined if np.linalg.norm((at - place)[:axes]) < near)
        if (names := next(there, None)) is None:
            joined.append(([name], place))
        else:
            names.append(name)
    return [(", ".join(names), place) for names, place in joined]


def _drawn_samples(result: Result, rows: Any) -> list[int]:
    """Samples at which the formation is drawn: start, end, ends of phases, and some in between.

    Samples whose drawing would cover an earlier one are left out.
    """
    if not len(rows):
        return []
    if has_lights(result):  # of two at one place, the later light
        rows = rows[::-1]
    r = result.position
    about = r[rows] - r[rows].mean(axis=1, keepdims=True)
    size = 2 * float(np.median(np.linalg.norm(about, axis=2).max(axis=1))) or 1e-9
    path = float(np.linalg.norm(np.diff(r[rows].mean(axis=1), axis=0), axis=1).sum())
    ends = [result.samples(i).stop - 1 for i in range(len(result.phases))]
    usable = set(rows.tolist())
    kept = [int(rows[0])]

    def keep_if_apart(candidates: list[int], gap: float) -> None:
        for k in candidates:
            apart = np.sqrt(np.mean(np.sum((r[k] - r[kept]) ** 2, axis=2), axis=1))
            if k in usable and apart.min() > gap:
                kept.append(k)

    keep_if_apart([int(rows[-1])], 1e-3 * size)
    keep_if_apart(ends, 0.3 * size)
    keep_if_apart(rows[st.spaced_indices(len(rows), 80)].tolist(), max(1.2 * size, path / 14))
    return sorted(kept)


def _edge_segments(result: Result, shots: list[int]) -> Floats:
    """Edges active at samples as segments (n, 2, 3); none of very many, which would hide everything."""
    drawn = [result.position[k][result.edges[np.isfinite(result.constraint[k])]] for k in shots]
    edges = np.concatenate([np.zeros((0, 2, 3)), *drawn])
    return edges if len(edges) <= _LINES else edges[:0]


# -- paths ---------------------------------------------------------------------------------------------


def _draw_paths(ax: Axes, result: Result, view: Scene, axes: int) -> None:
    """Draw paths, agents at the drawn samples, start, end and waypoints, in 2 or 3 axes."""
    for _, place in view.waypoints:
        ax.plot(*place[:axes, None], **_waypoint_look(result), zorder=7)
    n, night, shots = result.n_agents, has_lights(result), result.position[view.shots, :, :axes]
    colours = [st.GREY] * n if night else st.agent_colours(n)
    width, alpha = (0.4, 0.3) if night else (0.4, 0.5) if n > st.MANY else (0.8, 0.9)
    for i in st.spaced_indices(n, st.MANY):
        path: dict[str, Any] = {"color": colours[i], "linewidth": width, "alpha": alpha}
        ax.plot(*view.paths[:, i, :axes].T, **path, zorder=3, gid=f"agent-{i + 1}")
    if night:
        shown = light_colours(result, result.time[view.shots]).reshape(-1, 3)
        look: dict[str, Any] = {"depthshade": False} if axes == 3 else {}
        r = shots.reshape(-1, axes)
        ax.scatter(*r.T, s=5, c=shown, linewidths=0, zorder=5, gid="lights", **look)
    elif n > st.MANY:
        _draw_many_agents(ax, shots, colours)
    else:
        for colour, r in zip(colours, shots.transpose(1, 2, 0), strict=True):
            ax.plot(*r, **st.marker_look(colour, 3), zorder=5)
            ax.plot(*r[:, :1], **st.marker_look(colour, 5, hollow=True), zorder=6, gid="start")
            ax.plot(*r[:, -1:], **st.marker_look(colour, 5, marker="s"), zorder=6, gid="end")


def _draw_many_agents(ax: Axes, shots: Floats, colours: list[str]) -> None:
    """Draw many agents at places (K, N, axes); the first are hollow, the last squares."""
    last = len(shots) - 1
    for k, r in enumerate(shots):
        hollow = k == 0 != last
        look: dict[str, Any] = {"c": "white" if hollow else colours, "edgecolors": colours}
        look |= {"marker": "s" if k == last else "o", "linewidths": 0.5 if hollow else 0.0}
        ax.scatter(*r.T, s=4 if k in (0, last) else 3, **look, zorder=6 if hollow else 5)


def _waypoint_look(result: Result) -> dict[str, Any]:
    """Look of a waypoint, which is seen at night, too."""
    colour = st.GREY if has_lights(result) else st.INK
    return st.marker_look(colour, 7, marker="+") | {"markeredgewidth": 1.3}


def _waypoint_name_look(result: Result) -> dict[str, Any]:
    """Look of the name of a waypoint, with an outline in the colour of the background."""
    from matplotlib.patheffects import withStroke

    ink, behind = (st.FAINT, st.NIGHT) if has_lights(result) else (st.INK, "white")
    look = {"color": ink, "path_effects": [withStroke(linewidth=2.5, foreground=behind)]}
    return look | {"fontsize": 7.5, "zorder": 8, "parse_math": False}


# -- three dimensions --------------------------------------------------------------------------------


def draw_trajectory_in_space(
    fig: Figure, result: Result, view: Scene, rect: tuple[float, float, float, float]
) -> Axes3D:
    """Draw the trajectory in three dimensions, with one scale on all axes, as large as `rect` of the figure allows."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    ax = cast("Axes3D", fig.add_axes(rect, projection="3d"))
    ax.computed_zorder = False
    ax.set_proj_type("ortho")
    low, high = view.low, view.high
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    ax.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    _set_ticks(ax)
    azimuth, elevation = _AZIMUTH, _ELEVATION
    if night := has_lights(result):
        ax.grid(visible=False)
        walls: tuple[Any, ...] = (ax.xaxis, ax.yaxis, ax.zaxis)
        for wall in walls:
            wall.set_pane_color(st.NIGHT)
            wall.set_tick_params(pad=2.5)  # dark walls would hide the ends of numbers
        azimuth, elevation = np.degrees(seen(result)) + [_ASIDE, 0.0]
        elevation = min(max(elevation, _LOW), _HIGH)
    if view.ground and not night:
        flat = box_corners(low, high)[[0, 2, 6, 4]]
        flat[:, 2] = view.floor
        ax.add_collection3d(Poly3DCollection([flat], facecolor=_GROUND, alpha=0.8, zorder=0))
    for shape in view.shapes:
        solids.draw_obstacle_in_space(ax, shape)
    areas.draw_areas_in_space(ax, result.mission, view.floor)
    shadow = np.full(len(view.centre), view.floor)
    ax.plot(*view.centre[:, :2].T, shadow, color=st.FAINT, linewidth=1.0, zorder=1)
    edges = _edge_segments(result, view.shots)
    if len(edges):
        ax.add_collection3d(Line3DCollection(edges, colors=st.INK, linewidths=0.6, zorder=4))
    _draw_paths(ax, result, view, 3)
    for names, place in _waypoint_names_by_place(view, 3):
        ax.text(*place, f"  {names}", va="bottom", **_waypoint_name_look(result))
    ax.view_init(elevation, azimuth)
    _fit_axes(fig, ax, view, rect)
    return ax


def _set_ticks(ax: Axes3D) -> None:
    from matplotlib.ticker import MaxNLocator

    spans = [np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim()), np.ptp(ax.get_zlim())]
    for axis, span in zip((ax.xaxis, ax.yaxis, ax.zaxis), spans, strict=True):
        axis.set_major_locator(MaxNLocator(max(2, round(6 * span / max(spans)))))
        axis.set_tick_params(labelsize=7, pad=-1, color=st.FAINT)
        axis.labelpad = 0.0
    ax.set_box_aspect([float(s) for s in spans])
    ax.patch.set_visible(False)


def _screen_positions(ax: Axes3D, points: Floats) -> Floats:
    """Screen positions (n, 2) [pixels] of points (n, 3)."""
    from mpl_toolkits.mplot3d.proj3d import proj_transform

    x, y, _ = proj_transform(*points.T, ax.get_proj())
    return ax.transData.transform(np.column_stack([x, y]))


def _fit_axes(
    fig: Figure, ax: Axes3D, view: Scene, rect: tuple[float, float, float, float]
) -> None:
    """Zoom so that the box of the axes with its labels fills `rect` (left, bottom, width, height)."""
    size = fig.get_size_inches() * fig.dpi
    left, bottom, width, height = np.array(rect) * np.tile(size, 2)
    side, margin = max(width, height), 0.55 * fig.dpi  # for tick and axis labels
    corner = left + (width - side) / 2, bottom + (height - side) / 2
    ax.set_position((*(corner / size), *(side / size)))
    extent = np.ptp(_screen_positions(ax, box_corners(view.low, view.high)), axis=0)
    zoom = min((width - 2 * margin) / extent[0], (height - 2 * margin) / extent[1])
    ax.set_box_aspect([float(s) for s in view.high - view.low], zoom=zoom)
    # Names stand off their numbers by a share of the box, which is too little where it is thin: by 20 points at least.
    corners = _screen_positions(ax, box_corners(view.low, view.high))
    for axis, i, k in ((ax.xaxis, 2, 1), (ax.yaxis, 4, 1), (ax.zaxis, 4, 2)):
        across = np.linalg.norm([corners[i] - corners[k], corners[i + k] - corners[0]], axis=1)
        axis.labelpad = max(10.4 * side / float(across.max()) - 14.0, 0.0)


# -- from above --------------------------------------------------------------------------------------


def draw_trajectory_from_above(ax: Axes, result: Result, view: Scene) -> None:
    """Draw the trajectory from above, with one scale on both axes."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Rectangle

    ax.set(xlim=(view.low[0], view.high[0]), ylim=(view.low[1], view.high[1]))
    ax.set(xlabel="x [m]", ylabel="y [m]")
    ax.set_aspect("equal", adjustable="box")
    ax.apply_aspect()
    if has_lights(result):
        ax.set_facecolor(st.NIGHT)
        ax.grid(visible=False)
    for shape in view.shapes:
        solids.draw_obstacle_from_above(ax, shape)
    areas.draw_areas_from_above(ax, result.mission)
    fence = result.mission.limits.geofence
    if fence is not None:
        look: dict[str, Any] = {"fill": False, "edgecolor": st.ALERT, "linestyle": (0, (6, 2))}
        (x, y), size = fence.min[:2], np.subtract(fence.max, fence.min)
        ax.add_artist(Rectangle((x, y), *size[:2], **look, zorder=1, gid="geofence"))
    edges = _edge_segments(result, view.shots)[..., :2]
    ax.add_collection(LineCollection(list(edges), colors=st.INK, linewidths=0.6, zorder=4))
    _draw_paths(ax, result, view, 2)
    for names, (x, y, _) in _waypoint_names_by_place(view, 2):
        name = ax.annotate(
            names, (x, y), (5, 4), textcoords="offset points", **_waypoint_name_look(result)
        )
        # Within the axes, with its outline
        beyond = np.subtract(name.get_window_extent().max, ax.bbox.max) * 72 / ax.figure.dpi + 2
        name.set_position(tuple((5, 4) - np.maximum(beyond, 0.0)))


def trajectory_legend_entries(result: Result, view: Scene) -> list[Any]:
    """Legend entries of a trajectory."""
    waypoints = [st.legend_entry("waypoint", **_waypoint_look(result))] if view.waypoints else []
    if has_lights(result):
        return waypoints
    ends = [
        st.legend_entry("start", **st.marker_look(st.GREY, 5, hollow=True)),
        st.legend_entry("end", **st.marker_look(st.GREY, 5, marker="s")),
    ]
    return [*st.agent_handles(result.n_agents, marker="o", markersize=4), *ends, *waypoints]


@st.styled_figure()
def trajectory(result: Result) -> Figure:
    """Paths of the vehicles, and the formation at selected times."""
    wide = st.figure_width(10.5)
    fig = st.blank_figure(wide, 2.2 * wide if st.is_narrow() else 6.2)
    st.draw_flight_heading(fig, result, "Trajectory")
    view = trajectory_scene(result)
    entries = trajectory_legend_entries(result, view)
    columns = max(1, min(len(entries), max(int(0.9 * wide), 2) if st.is_narrow() else 11))
    if st.is_narrow():  # the view from above stands below
        draw_trajectory_in_space(fig, result, view, (0.0, 0.5, 1.0, 0.44))
        low = (0.65 + 0.18 * math.ceil(len(entries) / columns)) / fig.get_figheight()
        above = fig.add_axes((0.55 / wide, low, 0.96 - 0.55 / wide, 0.48 - low))
    else:
        draw_trajectory_in_space(fig, result, view, (0.0, 0.07, 0.6, 0.87))
        above = fig.add_axes((0.66, 0.16, 0.32, 0.74))
    draw_trajectory_from_above(above, result, view)
    above.set_anchor("C")
    fig.legend(
        handles=entries, loc="lower center", ncols=columns, borderaxespad=0.8, columnspacing=1.4
    )
    return fig
