"""Formations sketched: agents, edges and axes of each; meshes of many agents."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rigidfleet.formation import distance_geometry
from rigidfleet.plotting import curves
from rigidfleet.plotting import style as st
from rigidfleet.result import Result
from rigidfleet.result.lights import camera_axes, view_angles
from rigidfleet.solids.distance import vector_from_segment
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rigidfleet.mission import Mission


def slots_or_layout(mission: Mission, name: str) -> tuple[Floats, bool]:
    """Positions (N, 3) [m] at which a formation's graph is drawn, and whether they are its slots.

    If the distances fix no shape, classical scaling of the shortest paths in the graph gives positions.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import shortest_path

    slots = mission.formation_slots(name)
    if slots is not None:
        return slots, True
    n, edges = mission.n_agents, mission.formation_edges(name)
    lengths = mission.formation_distances(name)
    d = shortest_path(coo_array((lengths, edges.T), (n, n)), directed=False)
    # Between components that no edge joins
    d[np.isinf(d)] = 1.5 * d[np.isfinite(d)].max(initial=1.0)
    value, vector = distance_geometry.gram_eigensystem(d)
    places = np.zeros((n, 3))
    places[:, : min(n, 3)] = (vector * np.sqrt(np.maximum(value, 0)))[:, ::-1][:, :3]
    return places, False


def tiled_figure(n: int, above: float, below: float) -> tuple[Figure, list[Axes]]:
    """A figure with n pictures, up to three side by side, and room above and below them [in]."""
    columns = min(n, 3)
    rows = math.ceil(n / columns)
    high = 3.35 * rows + above + below
    fig = st.blank_figure(max(3.4 * columns, 6.0), high)
    room = {"top": 1 - (above + 0.6) / high, "bottom": (below + 0.1) / high, "hspace": 0.25}
    axes = fig.subplots(rows, columns, squeeze=False, gridspec_kw=room | {"left": 0, "right": 1})
    for ax in axes.flat:
        ax.axis("off")
    return fig, axes.ravel().tolist()[:n]


@st.styled_figure(lambda result: result.mission.formations, "the mission has no formation")
def formations(result: Result) -> Figure:
    """Formations with their edges and body axes."""
    names = list(result.mission.formations)
    entries = curves.edge_handles(result) if len(result.edges) > curves.SINGLE else []
    columns = max(min(len(names) + 1, 4, len(entries)), 1)
    below = 0.3 * bool(entries) + 0.2 * math.ceil(len(entries) / columns)
    fig, axes = tiled_figure(len(names), 0.4, below)
    st.draw_flight_heading(fig, result, "Formations with their body axes")
    for ax, name in zip(axes, names, strict=True):
        _draw_formation(ax, result, name)
    if entries:
        fig.legend(handles=entries, loc="lower center", ncols=columns, borderaxespad=0.8)
    return fig


def _draw_formation(ax: Axes, result: Result, name: str) -> None:
    """Draw a formation with the colours of its edges in all figures, and its body axes."""
    mission, edges = result.mission, result.mission.formation_edges(name).tolist()
    formation, colours = mission.formations[name], {}
    for group in curves.edges_by_length(result):
        colours |= {tuple(result.edges[k].tolist()): group.colour for k in group.edges}
    words = formation.shape or ("slots" if formation.slots is not None else "by distances")
    words += f", {len(edges)} edge{'s' if len(edges) != 1 else ''}" * bool(edges)
    of_edge = [colours[i, j] for i, j in edges]
    drawn = draw_formation_sketch(ax, mission, name, of_edge, words, most=curves.SINGLE)
    if drawn.placed and mission.n_agents > 1 and not mission.formation_colours(name):
        share = (0.3, 0.3, 0.42, 0.5)[distance_geometry.dimension(drawn.p, 1e-3)]
        length = share * float(np.linalg.norm(drawn.p, axis=1).max())
        _draw_formation_axes(ax, drawn.turn.T, length, (drawn.p @ drawn.turn.T)[:, :2])


class Sketch(NamedTuple):
    """A formation that is drawn: places (N, 3) [m] about its centre, whether these are its slots; the turn.

    The rows of ``turn`` (3, 3) point to the right, upwards and towards the viewer.
    """

    p: Floats
    placed: bool
    turn: Floats


def draw_formation_sketch(
    ax: Axes, mission: Mission, name: str, colours: list[str], words: str, *,
    most: int, dashed: Sequence[bool] = (), sideways: bool = False,
) -> Sketch:  # fmt: skip
    """Draw a formation's graph under its name and ``words``; lengths of up to ``most`` edges.

    A flat one is seen from its own side unless ``sideways``, lights from where they are meant to be.
    """
    p, placed = slots_or_layout(mission, name)
    masses = mission.fleet.mass
    p = p - masses @ p / masses.sum()
    edges, lengths = mission.formation_edges(name), mission.formation_distances(name)
    flat = float(np.ptp(p[:, 2])) < 1e-3 * max(1e-9, float(np.ptp(p)))
    turn, lit = np.eye(3), mission.formation_colours(name)
    if lit:
        turn = camera_axes(*view_angles(p))
    elif sideways or not flat:
        turn = camera_axes(*np.radians([-70.0, 30.0 if flat else 16.0]))
    words += "" if placed else ";\ntheir distances fix no positions"
    ax.set_title(st.clean_name(name), pad=24, fontsize=9, fontweight="bold", parse_math=False)
    at: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "top"}
    look: dict[str, Any] = {"fontsize": 7.5, "color": st.GREY, "parse_math": False}
    ax.annotate(words, (0.5, 1), (0, 20), "axes fraction", **at, **look)
    shown = lengths if len(edges) <= most else None
    draw_graph(ax, p @ turn.T, edges, colours, shown, dashed=dashed, lights=lit)
    return Sketch(p, placed, turn)


def draw_graph(
    ax: Axes,
    p: Floats,
    edges: Any,
    colours: list[str],
    lengths: Floats | None,
    *,
    dashed: Sequence[bool] = (),
    lights: Sequence[str] | None = None,
) -> None:
    """Draw agents at p (N, 3), seen along the last axis, as numbered discs, with edges and their lengths [m].

    With the colour of each agent's light, it is night.
    """
    from matplotlib.colors import to_rgb

    n = len(p)
    room = 1.25 * float(np.abs(p[:, :2]).max()) or 1.0
    ax.set(xlim=(-room, room), ylim=(-room, room), aspect="equal")
    ax.axis("off")
    if lights:
        ax.axhspan(-room, room, facecolor=st.NIGHT, linewidth=0, zorder=0, gid="night")
    shown = lights or st.agent_colours(n)
    if n > st.MANY:
        _draw_many(ax, p, edges, colours, shown)
        return
    for e in np.argsort(p[edges, 2].mean(axis=1)) if len(edges) else []:
        i, j = edges[e]
        a, b = p[i], p[j]
        # In the middle of a diagonal, the label would cover other edges and the body axes.
        middle = a + (b - a) * (0.5 if np.hypot(*(a + b)[:2]) > 0.3 * room else 0.28)
        others = np.delete(p, [i, j], axis=0)
        path = np.array([a, b])[:, :2]
        beside = np.linalg.norm(vector_from_segment(*others.T, a, b), axis=0)
        if beside.min(initial=room) < 0.02 * room:
            # A straight edge would run through another agent.
            across = np.array([a[1] - b[1], b[0] - a[0]]) * -0.22
            s = np.linspace(0, 1, 40)[:, None]
            path = (1 - s) * a[:2] + s * b[:2] + 4 * s * (1 - s) * across
            middle = np.append((a + b)[:2] / 2 + across, 0.0)
        dash: Any = st.DASHES if dashed and dashed[e] else "-"
        look: dict[str, Any] = {"color": colours[e], "linewidth": 1.6, "linestyle": dash}
        ax.plot(*path.T, **look, zorder=2, gid=f"edge-{i + 1}-{j + 1}")
        if lengths is not None:
            x, y = middle[:2]
            ax.text(
                x, y, f"{lengths[e]:.3g} m", fontsize=7.5, ha="center", va="center", zorder=3,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
            )  # fmt: skip
    size = (14.0 if n <= 12 else 60.0 / math.sqrt(n)) * (0.6 if lights else 1.0)
    for i in np.argsort(p[:, 2]):
        colour = shown[i]
        x, y = p[i, :2]
        ax.plot(x, y, **st.marker_look(colour, size), zorder=5, gid=f"agent-{i + 1}")
        if size > 7:
            light = float(np.dot(to_rgb(colour), (0.299, 0.587, 0.114)))
            ax.text(
                x, y, str(i + 1), fontsize=0.6 * size, color="white" if light < 0.6 else st.INK, ha="center",
                va="center_baseline", zorder=6, fontweight="bold",
            )  # fmt: skip


def _draw_many(ax: Axes, p: Floats, edges: Any, edge_hues: list[str], hues: Sequence[str]) -> None:
    """Draw a graph of many agents in the colours shown, with the far parts first and fainter."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgba_array

    depth = p[:, 2] - p[:, 2].min()
    # All are as near as the nearest if none is deeper.
    depth = 0.15 + 0.85 * depth / max(float(depth.max()), 1e-9) if depth.any() else 1.0 + depth
    if len(edges):
        near = depth[edges].mean(axis=1)
        order = np.argsort(near)
        look = to_rgba_array(edge_hues)
        look[:, 3] = near
        lines = LineCollection(list(p[edges[order]][:, :, :2]), colors=look[order], linewidths=0.5)
        lines.set_gid("edges")
        ax.add_collection(lines)
    order = np.argsort(p[:, 2])
    dots = to_rgba_array(list(hues))
    dots[:, 3] = depth
    ax.scatter(*p[order, :2].T, s=2000 / len(p) + 1, c=dots[order], linewidths=0, zorder=3)


def _draw_formation_axes(ax: Axes, axes: Floats, length: float, agents: Floats) -> None:
    """Draw body axes from the centre of mass; rows of `axes` (3, 3), the last column towards the viewer.

    One that points to the viewer is a ring with a dot, beside the centre, where an agent may be. The names of others
    stand before or beside their tips, where agents (N, 2) and lengths of edges are farthest.
    """
    lengths = [x.get_position() for x in ax.texts if x.get_transform() == ax.transData]
    taken = np.concatenate([agents, np.reshape(lengths, (-1, 2))])
    beside = 0.13 * float(np.ptp(ax.get_xlim())) / 2
    look: dict[str, Any] = {
        "ha": "center", "va": "center", "zorder": 7, "fontsize": 9.5, "gid": "body-axis",
        "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8},
    }  # fmt: skip
    for (x, y, _), label in zip(length * axes, "xyz", strict=True):
        if np.hypot(x, y) < 1e-6 * length:
            ax.annotate(f"⊙ {label}", (0, 0), (-16, -14), textcoords="offset points", **look)
            continue
        arrow = {"arrowstyle": "-|>", "color": st.INK, "linewidth": 1.3, "shrinkA": 0, "shrinkB": 0}
        ax.annotate("", (x, y), (0, 0), zorder=4, arrowprops=arrow)
        across = beside * np.array([-y, x]) / np.hypot(x, y)
        places = [np.array([x, y]) * 1.1, [x, y] + across, [x, y] - across]
        least = [np.linalg.norm(taken - place, axis=1).min() for place in places]
        ax.annotate(label, places[int(np.argmax(np.minimum(least, 1.3 * beside)))], **look)
