"""Figures over time: distances, centre of mass, attitude, forces, errors, clearance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet._common.quantities import MOTIONS, QUANTITIES, Quantity
from rigidfleet.math import attitude as att
from rigidfleet.plotting import quadrotors
from rigidfleet.plotting import style as st
from rigidfleet.plotting.peaks import IDLE, Panel, peak_before_breakdown
from rigidfleet.result import Extremum, Result
from rigidfleet.result.quantities import owner_name, samples
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D


SINGLE = 6  # greatest number of edges with a colour each; more edges share one by length
_PAIRS = 5e7  # greatest number of pair distances computed in all
_SMALLEST = 1e-12  # least error drawn on a logarithmic axis [m]; smaller ones are rounding
_STILL_ROW = 0.45  # height of a row in which nothing happens, as a share of the full height
_TEXT_ROW = 0.7  # height of a row that holds only text


# -- edges -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EdgeGroup:
    """Edges that are drawn in the same way."""

    edges: list[int]
    colour: str
    label: str


def edges_by_length(result: Result) -> list[EdgeGroup]:
    """Edges grouped by their intended lengths in all formations, short ones dark, long ones light.

    If there are few edges, each is a group of its own.
    """
    mission, m = result.mission, len(result.edges)
    lengths = np.full((m, len(mission.formations)), np.nan)
    place = {edge: k for k, edge in enumerate(map(tuple, result.edges.tolist()))}
    for f, name in enumerate(mission.formations):
        pairs = map(tuple, mission.formation_edges(name).tolist())
        for pair, d in zip(pairs, mission.formation_distances(name), strict=True):
            lengths[place[pair], f] = d
    if m > st.MANY:
        return _groups_by_formation(result, lengths)
    keys: dict[Any, list[int]] = {}
    for k, row in enumerate(lengths):
        key = k if m <= SINGLE else tuple(f"{d:.4g}" for d in row)
        keys.setdefault(key, []).append(k)
    groups = list(keys.values())
    if m > SINGLE:
        groups.sort(key=lambda g: np.nan_to_num(lengths[g[0]], nan=0.0).tolist())
    return [
        EdgeGroup(g, colour, _edge_label(result, g, lengths[g[0]]))
        for g, colour in zip(groups, st.colour_scale(len(groups)), strict=True)
    ]


def _groups_by_formation(result: Result, lengths: Floats) -> list[EdgeGroup]:
    """Groups of many edges: one for each formation, or for each set of formations that share edges."""
    names = list(result.mission.formations)
    kinds, kind = np.unique(np.isfinite(lengths), axis=0, return_inverse=True)
    groups = []
    for k, (held, colour) in enumerate(zip(kinds, st.colour_scale(len(kinds)), strict=True)):
        edges = np.flatnonzero(kind.ravel() == k)
        own = lengths[edges][:, held]
        of = " and ".join(st.clean_name(name, 20) for name, h in zip(names, held, strict=True) if h)
        label = f"{len(edges)} edges of {of}: {own.min():.3g} to {own.max():.3g} m"
        groups.append(EdgeGroup(edges.tolist(), colour, label))
    return groups


def _edge_label(result: Result, edges: list[int], lengths: Floats) -> str:
    if len(result.edges) <= SINGLE:
        return result.edge_labels[edges[0]]
    names = ["–" if np.isnan(d) else f"{d:.3g}" for d in lengths]
    steps = [name for i, name in enumerate(names) if i == 0 or name != names[i - 1]]
    return f"{len(edges)} edge{'s' if len(edges) > 1 else ''}: {' → '.join(steps)} m"


def draw_edge_lines(ax: Axes, result: Result, values: Floats, **look: Any) -> None:
    """A line for each edge, values (K, m), in the colour of its group; for many edges, the spread of each group."""
    for group in edges_by_length(result):
        of_group = values[:, group.edges]
        if len(result.edges) > st.MANY:
            of_group = np.where(np.isfinite(result.constraint[:, group.edges]), of_group, np.nan)
            st.draw_spread(ax, result.time, of_group, group.colour)
            continue
        for x in of_group.T:
            ax.plot(result.time, x, color=group.colour, **look)


def edge_handles(result: Result) -> list[Line2D]:
    """Legend entries of the groups of edges."""
    groups = edges_by_length(result)
    chosen = [groups[i] for i in st.spaced_indices(len(groups), 9)]
    return [st.legend_entry(g.label, color=g.colour) for g in chosen]


def _reference_handle(*values: Floats) -> list[Line2D]:
    """Legend entry of references, if there are any."""
    if not any(np.isfinite(v).any() for v in values):
        return []
    return [st.legend_entry("reference", **st.REFERENCE)]


def draw_edge_lengths(ax: Axes, result: Result) -> None:
    """Lengths of the edges, and their references."""
    ax.set_ylabel("distance [m]")
    draw_edge_lines(ax, result, result.distance, linewidth=1.9)
    wanted = result.distance_reference
    if len(result.edges) > st.MANY:
        wanted = np.column_stack([np.fmin.reduce(wanted, axis=1), np.fmax.reduce(wanted, axis=1)])
    for k in _distinct_columns(wanted):
        st.draw_reference(ax, result.time, wanted[:, k])
    _widen_limits(ax, 0.1)


def _distinct_columns(values: Floats) -> list[int]:
    """Columns of values (K, m), without those that look the same as an earlier one."""
    keys = np.round(np.nan_to_num(values[:: max(1, len(values) // 200)], nan=-1.0), 3)
    return sorted(np.unique(keys, axis=1, return_index=True)[1].tolist())


def has_edges(result: Result) -> bool:
    """Whether there are edges in any formation."""
    return len(result.edges) > 0


@st.styled_figure(has_edges, "no edges")
def distances(result: Result) -> Figure:
    """Distances of the active edges, with their references (dashed)."""
    fig, (ax,) = st.time_figure(result, "Distances between agents", 1, height=3.4)
    draw_edge_lengths(ax, result)
    handles = [*edge_handles(result), *_reference_handle(result.distance_reference)]
    st.draw_legend(ax, handles, "edge" if len(result.edges) <= SINGLE else "")
    return fig


# -- the formation as a whole --------------------------------------------------------------------------


#: Flown and commanded values (K, 3), those of waypoints (time, [3]), names of the components and their unit.
_Column = tuple[Floats, Floats, list[tuple[float, Any]], str, str]
#: A waypoint.
_RING = st.marker_look(st.INK, 5.5, hollow=True)


def _draw_components(result: Result, axes: Any, column: _Column) -> None:
    """A row for each of three components."""
    flown, wanted, targets, names, unit = column
    for i, (ax, name) in enumerate(zip(axes, names.split(), strict=True)):
        goals = np.array([goal[i] for _, goal in targets], dtype=float)
        ax.plot(result.time, flown[:, i], color=st.FLOWN, linewidth=2.4)
        st.draw_reference(ax, result.time, wanted[:, i])
        for t, goal in targets:
            ax.plot(t, goal[i], **_RING, zorder=4, clip_on=False)
        ax.set_ylabel(f"{name} [{unit}]")
        fit_to_variation(ax, np.concatenate([flown[:, i], wanted[:, i], goals]), unit)


def fit_to_variation(ax: Axes, values: Floats, unit: str) -> None:
    """Note the value if it does not vary; else choose limits so that rounding errors do not fill the axes."""
    if not st.note_if_constant(ax, values, unit):
        _widen_limits(ax, 0.1)


def _widen_limits(ax: Axes, least: float) -> None:
    """Widen the limits so that rounding errors do not fill the axes."""
    low, high = ax.get_ylim()
    if high - low < least:
        middle = (low + high) / 2
        ax.set_ylim(middle - least / 2, middle + least / 2)


def _waypoint_values(result: Result, key: str) -> list[tuple[float, Any]]:
    """Time [s] and value of the waypoints that the flight reached."""
    values = [(at["time"], at.get(key)) for _, at in st.phase_targets(result)]
    return [(t, value) for t, value in values if value is not None and t <= result.time[-1] + 1e-9]


def _body_figure(result: Result, title: str, *columns: _Column) -> Figure:
    """Components of the body's state in rows, lower ones where nothing changes; each column beside the other."""
    still = [
        all(st.is_constant(np.stack([f[:, i], w[:, i]])) for f, w, *_ in columns) for i in range(3)
    ]
    shares = [_STILL_ROW if x else 1.0 for x in still]
    fig, axes = st.time_figure(result, title, 3, len(columns), height=1.5, shares=shares)
    for k, column in enumerate(columns):
        _draw_components(result, axes[:, k], column)
    entries = [st.legend_entry("flown", color=st.FLOWN, linewidth=2.4)]
    entries += _reference_handle(*(wanted for _, wanted, *_ in columns))
    entries += [st.legend_entry("waypoint", **_RING)] if any(c[2] for c in columns) else []
    st.draw_legend(axes[0, 1], entries)
    return fig


@st.styled_figure()
def cm(result: Result) -> Figure:
    """Centre of mass: flown, reference (dashed) and waypoints (rings)."""
    places, speeds = _waypoint_values(result, "position"), _waypoint_values(result, "velocity")
    place = result.cm, result.cm_reference, places, "x y z", "m"
    speed = result.cm_velocity, result.cm_velocity_reference, speeds, "ẋ ẏ ż", "m/s"
    return _body_figure(result, "Centre of mass", place, speed)


def euler_deg(quaternions: Floats) -> Floats:
    """Euler angles (K, 3) [deg] (roll, pitch, yaw) without jumps of a full turn; NaN if unknown."""
    angles = att.euler_from_quaternion(quaternions)
    known = np.isfinite(angles).all(axis=1)
    angles[known] = np.unwrap(angles[known], axis=0)
    return np.degrees(angles)


def _unwrap_near(degrees: Floats, to: Floats) -> Floats:
    """Angles [deg] shifted by full turns to lie near the angles ``to``, where both are known."""
    shift = np.round((to - degrees) / 360.0) * 360.0
    return degrees + np.where(np.isfinite(shift), shift, 0.0)


def flown_and_wanted_euler(result: Result) -> tuple[Floats, Floats, list[tuple[float, Floats]]]:
    """Euler angles [deg] flown and commanded (K, 3), and those of waypoints (time, (3,))."""
    flown = euler_deg(result.attitude)
    wanted = _unwrap_near(euler_deg(result.attitude_reference), flown)
    targets = []
    for t, q in _waypoint_values(result, "attitude"):
        k = int(np.abs(result.time - t).argmin())
        targets.append((t, _unwrap_near(euler_deg(np.array([q], dtype=float)), flown[[k]])[0]))
    return flown, wanted, targets


def has_attitude(result: Result) -> bool:
    """Whether a body frame is attached to the formation, or commanded."""
    return bool(np.isfinite([result.attitude, result.attitude_reference]).any())


@st.styled_figure(has_attitude, "no body frame attached")
def attitude(result: Result) -> Figure:
    """Attitude of the formation: flown, reference (dashed) and waypoints (rings)."""
    flown, wanted, targets = flown_and_wanted_euler(result)
    turning = [(t, np.degrees(rates)) for t, rates in _waypoint_values(result, "rates")]
    rates = np.degrees(result.rates), np.degrees(result.rates_reference), turning, "p q r", "deg/s"
    angles = flown, wanted, targets, "roll pitch yaw", "deg"
    return _body_figure(result, "Attitude of the formation", angles, rates)


# -- forces ------------------------------------------------------------------------------------------


def has_thrust(result: Result) -> bool:
    """Whether the thrust is known."""
    return bool(np.isfinite(result.thrust).any())


def draw_thrust_or_distance(ax: Axes, result: Result) -> None:
    """Thrust of each agent with its limit, from zero; of a log, which has none, the distance from its slot."""
    if has_thrust(result):
        quadrotors.draw_with_limit(ax, result, "thrust", result.thrust, always=False)
    else:
        quadrotors.draw_with_limit(ax, result, "tracking_error")


@st.styled_figure(has_thrust, "forces are not known")
def inputs(result: Result) -> Figure:
    """Thrust of each vehicle with its limit, and enlarged."""
    fig, (above, below) = st.time_figure(result, "Thrust of each agent", 2)
    draw_thrust_or_distance(above, result)
    st.draw_agent_lines(below, result, result.thrust)
    below.set_ylabel("enlarged [N]")
    if not st.note_if_constant(below, result.thrust, "N"):
        panel = Panel(below, result, result.thrust, "N", result.extreme("thrust"))
        panel.crop_final_peak()
        _widen_limits(below, min(0.1, 0.1 * peak_before_breakdown(result, result.thrust)))
        panel.write_peak()
    st.draw_agents_legend(above, result.n_agents)
    return fig


@st.styled_figure(has_edges, "no edges")
def constraint_force(result: Result) -> Figure:
    """Constraint force on each vehicle, and tension of each edge (negative: the edge pushes)."""
    force, tension = np.linalg.norm(result.constraint_force, axis=2), -result.multiplier
    idle = [np.nanmax(np.abs(v), initial=0.0) <= IDLE for v in (force, tension)]
    shares = [_TEXT_ROW if still else 1.0 for still in idle]
    fig, (above, below) = st.time_figure(result, "Constraint force", 2, shares=shares)
    if quadrotors.draw_with_limit(above, result, "constraint_force", force):
        st.draw_agents_legend(above, result.n_agents)
    below.set_ylabel("tension [N]")
    name = lambda k: f"edge {result.edge_labels[k]}"  # noqa: E731
    edges = Panel(below, result, tension, "N", result.extreme("tension"), name)
    if not edges.note_if_rounding():
        draw_edge_lines(below, result, tension)
        below.axhline(0.0, color=st.FAINT, linewidth=0.6, zorder=1)
        edges.crop_final_peak()
        edges.write_peak(always=False)
        st.draw_legend(below, edge_handles(result))
    return fig


@st.styled_figure(lambda result: result.disturbance_force is not None, "still air")
def disturbance(result: Result) -> Figure:
    """Aerodynamic force on each vehicle, and distance of each vehicle from its slot."""
    title = "Aerodynamic force, and distance from the slots"
    fig, (above, below) = st.time_figure(result, title, 2)
    above.set_ylabel("aerodynamic force [N]")
    assert result.disturbance_force is not None
    force = np.where(result.left, np.linalg.norm(result.disturbance_force, axis=2), np.nan)
    if Panel(above, result, force, "N").draw():
        st.draw_agents_legend(above, result.n_agents)
    quadrotors.draw_with_limit(below, result, "tracking_error")
    return fig


# -- errors ------------------------------------------------------------------------------------------


def greatest_pair_error(result: Result) -> Floats:
    """Greatest error (K,) [m] of all pairs' distances against the slots of the phase's formation.

    NaN if the formation has no slots; with many agents, also NaN at most samples.
    """
    error = np.full(len(result.time), np.nan)
    for k, phase in enumerate(result.phases):
        rows = result.samples(k)
        slots = None if phase.formation is None else result.mission.formation_slots(phase.formation)
        if slots is None or len(slots) < 2 or rows.start == rows.stop:
            continue
        most = max(3, int(_PAIRS / len(slots) ** 2 / len(result.phases)))
        at = rows.start + np.array(st.spaced_indices(rows.stop - rows.start, most))
        r = np.where(result.left[at, :, None], result.position[at], np.nan)
        worst = np.full(len(r), np.nan)
        for i in range(len(slots) - 1):
            flown = np.linalg.norm(r[:, i + 1 :] - r[:, i : i + 1], axis=2)
            intended = np.linalg.norm(slots[i + 1 :] - slots[i], axis=1)
            worst = np.fmax(worst, np.fmax.reduce(np.abs(flown - intended), axis=1))
        error[at] = worst
    return error


def draw_constraint_error(ax: Axes, result: Result) -> list[Line2D]:
    """Draw the errors |c| of the edges, the greatest, and that of all pairs; return legend entries of the last two."""
    ax.set_ylabel("error |c| of an edge [m]" if has_edges(result) else "error of all pairs [m]")
    size, shape = np.abs(result.constraint), greatest_pair_error(result)
    handles = []
    if np.isfinite(shape).any():
        look: dict[str, Any] = {"color": st.FLOWN, "linewidth": 2.0, "zorder": 1.9}
        known = np.isfinite(shape) if result.n_agents > st.MANY else slice(None)
        ax.plot(result.time[known], shape[known], **look)
        handles.append(st.legend_entry("greatest error of all pairs", **look))
    if np.isfinite(size).any():
        draw_edge_lines(ax, result, size, linewidth=0.6, alpha=0.7)
        look = {"color": st.INK, "linewidth": 1.3}
        ax.plot(result.time, np.fmax.reduce(size, axis=1), **look)
        handles.append(st.legend_entry("greatest |c| of an edge", **look))
    if not handles:
        st.mark_empty(ax, "neither edges nor slots")
        return []
    seen = np.concatenate([size.ravel(), shape])
    seen = seen[np.isfinite(seen)]
    large = seen[seen > _SMALLEST]
    if len(large):
        ax.set_ylim(max(_SMALLEST, 0.5 * float(large.min())), 3 * float(large.max()))
    else:
        ax.set_ylim(_SMALLEST, 1.0)
        words = f"only rounding errors: at most {seen.max():.1g} m"
        st.mark_empty(ax, words if seen.max() else "0 m throughout")
    ax.set_yscale("log", nonpositive="clip")  # with limits, as zeros alone have none
    return handles


@st.styled_figure(lambda result: has_edges(result) or result.mission.formations)
def constraint_error(result: Result) -> Figure:
    """Constraint error |c| of each edge (length minus reference), and shape error of all pairs."""
    title = "Constraint error, and shape error" if has_edges(result) else "Shape error"
    title = f"{title} of all pairs against the slots"
    fig, (ax,) = st.time_figure(result, title, 1, height=3.6)
    if handles := draw_constraint_error(ax, result):
        st.draw_legend(ax, [*handles, *(edge_handles(result) if len(result.edges) else [])])
    return fig


# -- clearance ---------------------------------------------------------------------------------------


def draw_least(ax: Axes, result: Result, name: str) -> None:
    """Least values, such as distances to others, to obstacles, or of falls to people, with their limit."""
    q, sampled = QUANTITIES[name], samples(result, name)
    unit = q.display_unit
    ax.set_ylabel(f"{q.axis or q.name_in_words} [{unit}]")
    values, limit = getattr(result, name, sampled.worst), q.limit_of(result.mission) or 0.0
    values = np.where(np.isfinite(values), values, np.nan)
    if not np.isfinite(values).any():
        known = {"separation": result.n_agents == 1, "clearance": not result.mission.obstacles}
        st.mark_empty(ax, q.nothing if known.get(name, True) else "unknown")
        if limit:
            ax.set_ylim(0.0, 1.4 * limit)
            st.draw_limit(ax, limit, f"limit {limit:g} {unit}")
        return
    ax.plot(result.time, values, color=st.TONES[0])
    st.draw_limit(ax, limit, f"limit {limit:g} {unit}" if limit or name == "people" else "contact")
    if name == "separation":
        _draw_planned_separation(ax, result)
        if (flying := QUANTITIES["separation_flying"].limit_of(result.mission)) is not None:
            altitude = result.mission.limits.separation_altitude
            st.draw_limit(ax, flying, f"limit {flying:g} m from z = {altitude:g} m on")
    k = int(np.nanargmin(values))
    x = result.extreme(name)
    if x is None or x.value > values[k]:
        place = () if sampled.values.ndim == 1 else (int(sampled.rank[k].argmax()),)
        who = *sampled.owner(k, *place), -1
        x = Extremum(float(values[k]), float(result.time[k]), *who[:2])
    look: dict[str, Any] = {"markerfacecolor": "none", "markeredgecolor": st.INK}
    ax.plot(x.time, x.value, "o", markersize=5, clip_on=False, **look)
    who = st.clean_name(owner_name(result, q, x.who, x.other))
    st.write_above(ax, f"least {x.value:.3g} {unit} at {x.time:.2f} s, {who}")
    low, high = min(float(np.nanmin(values)), limit), max(float(np.nanmax(values)), limit)
    room = 0.25 * max(high, -low, 0.1)
    ax.set_ylim(min(low, 0.0) - room, max(high, 0.0) + room)


def _draw_planned_separation(ax: Axes, result: Result) -> None:
    """The separation that the plan of each phase proves, less what is allowed for tracking."""
    allowed = result.mission.limits.separation_allowance
    proved = [(p.planned["separation"] - allowed, p) for p in result.phases if p.planned]
    for least, p in proved:
        ax.hlines(least, p.t_start, p.t_end, st.ALERT, linewidth=0.8, linestyle=":", gid="planned")
    if proved:
        st.write_above(ax, f"dotted: as planned, less {allowed:g} m")


def _least_distance_quantities(result: Result) -> list[str]:
    """Which least distances there are."""
    mission, several = result.mission, result.n_agents > 1
    there = {
        "separation": several,
        "separation_below": several and mission.limits.separation_below is not None,
        "clearance": mission.obstacles,
        "people": mission.people,
    }
    return [name for name in there if there[name]]


@st.styled_figure(_least_distance_quantities, "only one agent, and nothing near it")
def clearance(result: Result) -> Figure:
    """Distances between surfaces, with the limits."""
    names = _least_distance_quantities(result)
    height = 3.2 if len(names) == 1 else 1.8
    fig, axes = st.time_figure(result, "Clearance between surfaces", len(names), height=height)
    for name, ax in zip(names, axes, strict=True):
        draw_least(ax, result, name)
    return fig


# -- motion ------------------------------------------------------------------------------------------


def limited_motions(result: Result) -> list[Quantity]:
    """What the mission limits of speeds, accelerations, jerks, and what else positions and velocities show."""
    every = (q for q in QUANTITIES.values() if q in MOTIONS or (q.measure and not q.limit))
    return [q for q in every if q.limit_of(result.mission) is not None]


@st.styled_figure(limited_motions)
def motion(result: Result) -> Figure:
    """Speed, acceleration and jerk of each vehicle, as far as they are limited, with their limits."""
    drawn = limited_motions(result) or [q for q in MOTIONS if q.by_phase]
    fig, axes = st.time_figure(result, "Speed, acceleration and jerk", len(drawn), height=1.8)
    for q, ax in zip(drawn, axes, strict=True):
        (draw_least if q.at_least else quadrotors.draw_with_limit)(ax, result, q.name)
    st.draw_agents_legend(axes[0], result.n_agents)
    return fig
