"""Figures over time: distances, centre of mass, attitude, forces, errors, clearance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.math import attitude as att
from rigidfleet.math import proximity
from rigidfleet.plotting import style as st
from rigidfleet.plotting.style import styled
from rigidfleet.result import Extremum, Result
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from rigidfleet.mission import Mission

SINGLE = 6  # so many edges have a colour each; more share one by their lengths
_PAIRS = 5e7  # distances of pairs that are looked at, in all
_SMALLEST = 1e-12  # error that is drawn on a logarithmic axis [m]; below is rounding
_IDLE = 1e-6  # force [N] or way [m] below which there is nothing to draw but rounding
_LOW = 0.45  # share of its height that a row has left in which nothing happens
_TOLD = 0.7  # and one that holds words alone


# -- edges -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class EdgeGroup:
    """Edges that are drawn alike."""

    edges: list[int]
    lengths: tuple[float, ...]  # [m] in each formation in turn, NaN where it is not held
    colour: str
    label: str


def edge_groups(result: Result) -> list[EdgeGroup]:
    """Edges grouped by their intended lengths in all formations, short ones dark, long ones light.

    Few edges each make a group of their own.
    """
    mission, m = result.mission, len(result.edges)
    lengths = np.full((m, len(mission.formations)), np.nan)
    place = {edge: k for k, edge in enumerate(map(tuple, result.edges.tolist()))}
    for f, name in enumerate(mission.formations):
        pairs = map(tuple, mission.formation_edges(name).tolist())
        for pair, d in zip(pairs, mission.formation_distances(name), strict=True):
            lengths[place[pair], f] = d
    keys: dict[tuple[str, ...], list[int]] = {}
    for k, row in enumerate(lengths):
        keys.setdefault(
            tuple(f"{d:.4g}" for d in row) + ((str(k),) if m <= SINGLE else ()), []
        ).append(k)
    if m > st.MANY:
        return _by_formation(result, lengths)
    groups = list(keys.values())
    if m > SINGLE:
        groups.sort(key=lambda g: np.nan_to_num(lengths[g[0]], nan=0.0).tolist())
    return [
        EdgeGroup(g, tuple(lengths[g[0]].tolist()), colour, _edge_label(result, g, lengths[g[0]]))
        for g, colour in zip(groups, st.scale(len(groups)), strict=True)
    ]


def _by_formation(result: Result, lengths: Floats) -> list[EdgeGroup]:
    """Of many edges, a group for those of each formation, or of the same formations."""
    names = list(result.mission.formations)
    kinds, kind = np.unique(np.isfinite(lengths), axis=0, return_inverse=True)
    groups = []
    for k, (held, colour) in enumerate(zip(kinds, st.scale(len(kinds)), strict=True)):
        edges = np.flatnonzero(kind.ravel() == k)
        own = lengths[edges][:, held]
        of = " and ".join(st.clean(name, 20) for name, h in zip(names, held, strict=True) if h)
        label = f"{len(edges)} edges of {of}: {own.min():.3g} to {own.max():.3g} m"
        groups.append(EdgeGroup(edges.tolist(), tuple(lengths[edges[0]].tolist()), colour, label))
    return groups


def _edge_label(result: Result, edges: list[int], lengths: Floats) -> str:
    if len(result.edges) <= SINGLE:
        return result.edge_labels[edges[0]]
    names = ["–" if np.isnan(d) else f"{d:.3g}" for d in lengths]
    steps = [name for i, name in enumerate(names) if i == 0 or name != names[i - 1]]
    return f"{len(edges)} edge{'s' if len(edges) > 1 else ''}: {' → '.join(steps)} m"


def edge_lines(ax: Axes, result: Result, values: Floats, **look: Any) -> None:
    """A line for each edge, values (K, m), in the colour of its group; of many the spread of each group."""
    for group in edge_groups(result):
        if len(result.edges) > st.MANY:
            active = np.isfinite(result.constraint[:, group.edges])
            st.spread(
                ax, result.time, np.where(active, values[:, group.edges], np.nan), group.colour
            )
            continue
        for k in group.edges:
            st.line(ax, result.time, values[:, k], color=group.colour, **look)


def edge_handles(result: Result) -> list[Line2D]:
    """Legend entries of the groups of edges."""
    from matplotlib.lines import Line2D

    groups = edge_groups(result)
    chosen = [groups[i] for i in st.some(len(groups), 9)]
    return [Line2D([], [], color=g.colour, label=g.label) for g in chosen]


def _reference_handle(*values: Floats) -> list[Line2D]:
    """Legend entry of references, if there are any."""
    from matplotlib.lines import Line2D

    if not any(np.isfinite(v).any() for v in values):
        return []
    return [Line2D([], [], color=st.INK, linewidth=0.8, linestyle=st.DASHES, label="reference")]


def draw_distances(ax: Axes, result: Result) -> None:
    """Lengths of the edges, and their references."""
    ax.set_ylabel("distance [m]")
    if not len(result.edges):
        st.note(ax, "no edges")
        return
    edge_lines(ax, result, result.distance, linewidth=1.9)
    wanted = result.distance_reference
    if len(result.edges) > st.MANY:
        wanted = np.column_stack([np.fmin.reduce(wanted, axis=1), np.fmax.reduce(wanted, axis=1)])
    for k in _distinct(wanted):
        st.reference(ax, result.time, wanted[:, k])


def _distinct(values: Floats) -> list[int]:
    """Columns of values (K, m), without those that look like one before."""
    keys = np.round(np.nan_to_num(values[:: max(1, len(values) // 200)], nan=-1.0), 3)
    return sorted(np.unique(keys, axis=1, return_index=True)[1].tolist())


@styled
def distances(result: Result) -> Figure:
    """Distances between agents with their references."""
    fig, axes = st.time_figure(result, "Distances between agents", 1, height=3.4)
    ax = axes[0, 0]
    draw_distances(ax, result)
    if len(result.edges):
        title = "edge" if len(result.edges) <= SINGLE else ""
        st.legend(ax, [*edge_handles(result), *_reference_handle(result.distance_reference)], title)
    st.name_phases(fig, [ax], result)
    return fig


# -- the formation as a whole --------------------------------------------------------------------------


def _components(
    result: Result,
    axes: Any,
    flown: Floats,
    wanted: Floats,
    targets: list[tuple[float, Any]],
    names: tuple[str, str, str],
    unit: str,
) -> None:
    """A row for each of three components: flown and reference (K, 3), targets (time, [3])."""
    for i, ax in enumerate(axes):
        asked = np.array([goal[i] for _, goal in targets], dtype=float)
        st.line(ax, result.time, flown[:, i], color=st.FLOWN, linewidth=2.4)
        st.reference(ax, result.time, wanted[:, i])
        for t, goal in targets:
            ax.plot(
                t, goal[i], "o", markersize=5.5, markerfacecolor="white", markeredgecolor=st.INK,
                markeredgewidth=1.0, zorder=4, clip_on=False,
            )  # fmt: skip
        ax.set_ylabel(f"{names[i]} [{unit}]")
        if not st.still(ax, np.concatenate([flown[:, i], wanted[:, i], asked]), unit):
            widen(ax, 0.1)


def _shares(*columns: tuple[Floats, Floats]) -> list[float]:
    """Share of its height for each of three rows: less where nothing moves, of (flown, wanted) of each column."""
    return [
        _LOW if all(st.is_still(f[:, i], w[:, i]) for f, w in columns) else 1.0 for i in range(3)
    ]


def widen(ax: Axes, least: float) -> None:
    """Do not blow rounding errors up to the height of an axes."""
    low, high = ax.get_ylim()
    if high - low < least:
        middle = (low + high) / 2
        ax.set_ylim(middle - least / 2, middle + least / 2)


def _whole_legend(ax: Axes, references: list[Line2D], *, targets: bool) -> None:
    from matplotlib.lines import Line2D

    ring = Line2D(
        [], [], linestyle="", marker="o", markersize=5.5, markerfacecolor="white",
        markeredgecolor=st.INK, label="waypoint",
    )  # fmt: skip
    flown = Line2D([], [], color=st.FLOWN, linewidth=2.4, label="flown")
    st.legend(ax, [flown, *references, *([ring] if targets else [])])


def _targets(result: Result, key: str) -> list[tuple[float, Any]]:
    """Time [s] and value of what waypoints ask for, as far as the flight came."""
    found = [(p.target["time"], p.target.get(key)) for p in result.phases if p.target is not None]
    return [(t, value) for t, value in found if value is not None and t <= result.time[-1] + 1e-9]


@styled
def cm(result: Result) -> Figure:
    """Position and velocity of the centre of mass with their references and waypoints."""
    columns = (result.cm, result.cm_reference), (result.cm_velocity, result.cm_velocity_reference)
    fig, axes = st.time_figure(result, "Centre of mass", 3, 2, height=1.5, shares=_shares(*columns))
    places, speeds = _targets(result, "position"), _targets(result, "velocity")
    _components(result, axes[:, 0], result.cm, result.cm_reference, places, ("x", "y", "z"), "m")
    _components(
        result, axes[:, 1], result.cm_velocity, result.cm_velocity_reference, speeds,
        ("ẋ", "ẏ", "ż"), "m/s",
    )  # fmt: skip
    references = _reference_handle(result.cm_reference, result.cm_velocity_reference)
    _whole_legend(axes[0, 1], references, targets=bool(places or speeds))
    st.name_phases(fig, axes[0], result)
    return fig


def euler_deg(quaternions: Floats) -> Floats:
    """Euler angles (K, 3) [deg] (roll, pitch, yaw) without jumps of a whole turn; NaN where unknown."""
    angles = att.euler_from_quaternion(quaternions)
    known = np.isfinite(angles).all(axis=1)
    angles[known] = np.unwrap(angles[known], axis=0)
    return np.degrees(angles)


def _nearest_turn(angles: Floats, to: Floats) -> Floats:
    """Angles [deg] shifted by whole turns to lie near others, where both are known."""
    shift = np.round((to - angles) / 360.0) * 360.0
    return angles + np.where(np.isfinite(shift), shift, 0.0)


def flown_and_wanted_euler(result: Result) -> tuple[Floats, Floats, list[tuple[float, Floats]]]:
    """Euler angles [deg] flown and commanded (K, 3), and those of waypoints (time, (3,))."""
    flown = euler_deg(result.attitude)
    wanted = _nearest_turn(euler_deg(result.attitude_reference), flown)
    targets = []
    for t, q in _targets(result, "attitude"):
        k = int(np.abs(result.time - t).argmin())
        targets.append((t, _nearest_turn(euler_deg(np.array([q], dtype=float)), flown[[k]])[0]))
    return flown, wanted, targets


@styled
def attitude(result: Result) -> Figure:
    """Euler angles (3-2-1) and body rates of the formation with their references and waypoints."""
    title = "Attitude of the formation"
    flown, wanted, targets = flown_and_wanted_euler(result)
    if not np.isfinite([flown, wanted]).any():
        fig, axes = st.time_figure(result, title, 1)
        st.note(axes[0, 0], "no body frame attached")
        st.name_phases(fig, axes[0], result)
        return fig
    turned = np.degrees(result.rates), np.degrees(result.rates_reference)
    shares = _shares((flown, wanted), turned)
    fig, axes = st.time_figure(result, title, 3, 2, height=1.5, shares=shares)
    _components(result, axes[:, 0], flown, wanted, targets, ("roll", "pitch", "yaw"), "deg")
    turning = [(t, np.degrees(rates)) for t, rates in _targets(result, "rates")]
    _components(result, axes[:, 1], *turned, turning, ("p", "q", "r"), "deg/s")
    references = _reference_handle(wanted, result.rates_reference)
    _whole_legend(axes[0, 1], references, targets=bool(targets or turning))
    st.name_phases(fig, axes[0], result)
    return fig


# -- forces ------------------------------------------------------------------------------------------


def thrust_limits(mission: Mission) -> list[tuple[float, str, str]]:
    """Each thrust limit [N] there is, with a label and a colour: the agent's if it is its alone."""
    limits = mission.fleet.thrust_limit
    colours = st.agent_colours(len(limits))
    found = []
    for value in np.unique(limits[np.isfinite(limits)]).tolist():
        of = np.flatnonzero(limits == value)
        colour = colours[of[0]] if len(of) == 1 < len(limits) else st.ALERT
        who = "" if len(of) == len(limits) else " of " + ", ".join(str(i + 1) for i in of[:6])
        found.append((value, f"limit{who} {value:g} N", colour))
    return found


def draw_thrust(ax: Axes, result: Result) -> None:
    """Thrust of each agent under its limit, from zero."""
    ax.set_ylabel(r"thrust $|f_u + f_C|$ [N]")
    st.agent_lines(ax, result, result.thrust)
    limits = thrust_limits(result.mission)
    for value, label, colour in limits:
        st.limit(ax, value, label, colour)
    top = max([*(value for value, *_ in limits), _sane(result, result.thrust)])
    ax.set_ylim(0, 1.12 * top if top > 0 else 1.0)
    _extremes(ax, result, result.thrust, "N", _agent, name="thrust", always=False)


def _sane(result: Result, values: Floats) -> float:
    """Greatest value, or if the flight broke down, the greatest before the peak in which it ended."""
    size = np.abs(values[np.isfinite(values)])
    if not len(size):
        return 0.0
    usual = float(np.quantile(size, 0.99))
    peak = float(size.max())
    return peak if result.complete or peak < 10 * usual else 2 * usual


@styled
def inputs(result: Result) -> Figure:
    """Input magnitude |f_u + f_C| of each agent under its limit, and enlarged."""
    fig, axes = st.time_figure(result, "Thrust of each agent", 2)
    above, below = axes[:, 0]
    draw_thrust(above, result)
    st.agent_lines(below, result, result.thrust)
    below.set_ylabel("enlarged [N]")
    if not st.still(below, result.thrust, "N"):
        _within(below, result, result.thrust)
        widen(below, 0.1)
        _extremes(below, result, result.thrust, "N", _agent, name="thrust")
    st.agents_legend(above, result.n_agents)
    st.name_phases(fig, [above], result)
    return fig


def _agent(i: int) -> str:
    return f"agent {i + 1}"


def _edge(x: Extremum) -> str:
    return f"edge {x.who + 1}-{x.other + 1}"


def _extremes(
    ax: Axes,
    result: Result,
    values: Floats,
    unit: str,
    who: Callable[[int], str],
    *,
    name: str = "",
    always: bool = True,
) -> None:
    """Write the greatest of values (K, n) into the axes, and mark what it cuts off at top and bottom.

    That between samples, too, if the record has it by ``name``. Without ``always``, only what is cut off.
    """
    between = result.extreme(name)
    low, high = ax.get_ylim()
    for sign, edge, marker in ((1.0, high, "^"), (-1.0, low, "v")):
        size = np.where(np.isfinite(values), sign * values, -np.inf)
        k, i = np.unravel_index(int(size.argmax()), size.shape)
        cut = size[k, i] > sign * edge
        if not np.isfinite(size[k, i]) or not (cut or (always and sign > 0)):
            continue
        peak, when, whose = float(values[k, i]), float(result.time[k]), who(int(i))
        if between is not None and sign > 0 and between.value > peak:
            peak, when = between.value, between.time
            whose = _edge(between) if between.other >= 0 else _agent(between.who)
        told = f"peak {peak:.3g} {unit}: {whose} at {when:.2f} s"
        if not cut:
            if high <= peak < 1.5 * high:
                ax.set_ylim(low, peak + 0.05 * (peak - low))
            if peak > values[k, i]:
                ax.plot(
                    when, peak, "o", markersize=4, markerfacecolor="none", markeredgecolor=st.INK
                )
            st.annotate(ax, told, st.corners())
            continue
        t = result.time[int((size > sign * edge).any(axis=1).argmax())]
        look: dict[str, Any] = {"color": st.ALERT, "markersize": 5, "clip_on": False, "zorder": 6}
        ax.plot(t, edge, marker, **look, gid="cut")
        st.annotate(ax, f"cut off: {told}", [*st.around(t, edge), *st.corners()], color=st.ALERT)


def _idle(ax: Axes, result: Result, values: Floats, unit: str, who: Callable[[int], str]) -> bool:
    """If values (K, n) are nothing but rounding, say so in the axes; whether that is so."""
    size = np.where(np.isfinite(values), np.abs(values), -np.inf)
    k, i = np.unravel_index(int(size.argmax()), size.shape) if size.size else (0, 0)
    if not size.size or not np.isfinite(size[k, i]) or size[k, i] > _IDLE:
        return False
    where = f", {who(int(i))} at {result.time[k]:.2f} s" if size[k, i] else ""
    st.note(ax, f"none but rounding: at most {size[k, i]:.3g} {unit}{where}")
    return True


def _within(ax: Axes, result: Result, values: Floats) -> None:
    """Leave the peak in which a flight broke down out of the picture."""
    top = _sane(result, values)
    if top < np.nanmax(np.abs(values), initial=0.0):
        finite = values[np.isfinite(values)]
        low = max(float(finite.min()), -top)
        ax.set_ylim(low - 0.05 * (top - low), top)


@styled
def constraint_force(result: Result) -> Figure:
    """Constraint force |f_C| on each agent and tension of each edge."""

    def edge(k: int) -> str:
        return f"edge {result.edge_labels[k]}"

    force, tension = np.linalg.norm(result.constraint_force, axis=2), -result.multiplier
    shares = [
        _TOLD if np.nanmax(np.abs(v), initial=0.0) <= _IDLE else 1.0 for v in (force, tension)
    ]
    fig, axes = st.time_figure(result, "Constraint force", 2, shares=shares)
    above, below = axes[:, 0]
    above.set_ylabel(r"force $|f_C|$ [N]")
    if _from_none(above, result, force, "N", "constraint_force"):
        st.agents_legend(above, result.n_agents)
    below.set_ylabel(r"tension $-\lambda$ [N]")
    if not len(result.edges):
        st.note(below, "no edges")
    elif not _idle(below, result, tension, "N", edge):
        edge_lines(below, result, tension)
        below.axhline(0.0, color=st.FAINT, linewidth=0.6, zorder=1)
        _within(below, result, tension)
        _extremes(below, result, tension, "N", edge, name="tension", always=False)
        st.legend(below, edge_handles(result))
    st.name_phases(fig, [above], result)
    return fig


def _from_none(ax: Axes, result: Result, values: Floats, unit: str, name: str = "") -> bool:
    """Each agent's values (K, N) from zero, with the greatest in words; whether there was anything to draw."""
    if _idle(ax, result, values, unit, _agent):
        return False
    st.agent_lines(ax, result, values)
    top = _sane(result, values)
    if top > 0.0:
        ax.set_ylim(-0.04 * top, 1.12 * top)
    _extremes(ax, result, values, unit, _agent, name=name)
    return True


@styled
def disturbance(result: Result) -> Figure:
    """Force of the air |f_D| on each agent, and how far each is from its slot."""
    fig, axes = st.time_figure(result, "Force of the air, and distance from the slots", 2)
    above, below = axes[:, 0]
    above.set_ylabel(r"force $|f_D|$ [N]")
    if result.disturbance_force is None:
        st.note(above, "still air")
    else:
        force = np.where(result.left, np.linalg.norm(result.disturbance_force, axis=2), np.nan)
        if _from_none(above, result, force, "N"):
            st.agents_legend(above, result.n_agents)
    below.set_ylabel("from the slot [m]")
    off = np.linalg.norm(result.position - result.slot_position, axis=2)
    if np.isfinite(off).any():
        _from_none(below, result, off, "m")
    else:
        st.note(below, "no slots are tracked")
    st.name_phases(fig, [above], result)
    return fig


# -- errors ------------------------------------------------------------------------------------------


def shape_error(result: Result) -> Floats:
    """Greatest error (K,) [m] of all pairs' distances against the slots of the phase's formation.

    NaN where the formation has no slots, and of many agents at all but some samples.
    """
    error = np.full(len(result.time), np.nan)
    for k, phase in enumerate(result.phases):
        rows = result.samples(k)
        slots = None if phase.formation is None else result.mission.formation_slots(phase.formation)
        if slots is None or len(slots) < 2 or rows.start == rows.stop:
            continue
        most = max(3, int(_PAIRS / len(slots) ** 2 / len(result.phases)))
        at = rows.start + np.array(st.some(rows.stop - rows.start, most))
        r = np.where(result.left[at, :, None], result.position[at], np.nan)
        worst = np.full(len(r), np.nan)
        for i in range(len(slots) - 1):
            flown = np.linalg.norm(r[:, i + 1 :] - r[:, i : i + 1], axis=2)
            asked = np.linalg.norm(slots[i + 1 :] - slots[i], axis=1)
            worst = np.fmax(worst, np.fmax.reduce(np.abs(flown - asked), axis=1))
        error[at] = worst
    return error


def draw_error(ax: Axes, result: Result) -> list[Line2D]:
    """Errors |c| of the edges, the greatest, and that of all pairs; returns legend entries of the last two."""
    from matplotlib.lines import Line2D

    ax.set_ylabel(r"error $|c|$ of an edge [m]")
    size, shape = np.abs(result.constraint), shape_error(result)
    handles = []
    if np.isfinite(shape).any():
        look: dict[str, Any] = {"color": st.FLOWN, "linewidth": 2.0, "zorder": 1.9}
        known = np.isfinite(shape) if result.n_agents > st.MANY else slice(None)
        st.line(ax, result.time[known], shape[known], **look)
        handles.append(Line2D([], [], label="all pairs, to the slots", **look))
    if np.isfinite(size).any():
        edge_lines(ax, result, size, linewidth=0.6, alpha=0.7)
        look = {"color": st.INK, "linewidth": 1.3}
        st.line(ax, result.time, np.fmax.reduce(size, axis=1), **look)
        handles.append(Line2D([], [], label="greatest |c| of an edge", **look))
    if not handles:
        st.note(ax, "no edges, no slots")
        return []
    ax.set_yscale("log", nonpositive="clip")
    seen = np.concatenate([size.ravel(), shape])
    seen = seen[np.isfinite(seen)]
    large = seen[seen > _SMALLEST]
    if len(large):
        ax.set_ylim(max(_SMALLEST, 0.5 * float(large.min())), 3 * float(large.max()))
        if ax.get_ylim()[0] == _SMALLEST and len(large) < len(seen):
            st.annotate(
                ax,
                f"rounding below {_SMALLEST:g} m is not drawn",
                st.corners()[::-1],
                color=st.GREY,
            )
    else:
        ax.set_ylim(_SMALLEST, 1.0)
        st.note(ax, f"none but rounding: at most {seen.max():.1g} m")
    return handles


@styled
def constraint_error(result: Result) -> Figure:
    """Constraint errors |c| of the edges and their greatest, and the error of all pairs."""
    fig, axes = st.time_figure(
        result, "Constraint error, and that of all pairs against the slots", 1, height=3.6
    )
    ax = axes[0, 0]
    handles = draw_error(ax, result)
    if handles:
        st.legend(ax, [*handles, *(edge_handles(result) if len(result.edges) else [])])
    st.name_phases(fig, [ax], result)
    return fig


# -- clearance ---------------------------------------------------------------------------------------


def room_below(result: Result) -> Floats:
    """Least vertical room (K,) [m] between agents whose spheres overlap seen from above; NaN if none."""
    radius = result.mission.agents.radius
    least = proximity.headroom(result.position, radius, result.left)[0]
    return np.where(np.isfinite(least), least, np.nan)


def _mark_least(ax: Axes, result: Result, values: Floats, name: str) -> None:
    """Ring the least value, between samples, too, and say how much, when and who."""
    known = np.where(np.isfinite(values), values, np.inf)
    k = int(known.argmin())
    if not np.isfinite(known[k]):
        return
    t, value, pair = float(result.time[k]), float(values[k]), None
    between = result.extreme(name)
    if between is not None and between.value <= value:
        t, value, pair = between.time, between.value, (between.who, between.other)
    elif name == "separation":
        pair = tuple(result.separation_pair[k])
    elif name == "clearance":
        pair = result.clearance_agent[k], result.clearance_obstacle[k]
    ax.plot(
        t, value, "o", markersize=5, markerfacecolor="none", markeredgecolor=st.INK, clip_on=False
    )
    who = "" if pair is None else _who(result, name, *map(int, pair))
    st.annotate(ax, f"{value:.3g} m at {t:.2f} s{who}", st.around(t, value))


def _who(result: Result, name: str, first: int, second: int) -> str:
    if name != "clearance":
        return f", agents {min(first, second) + 1} and {max(first, second) + 1}"
    if first < 0 or not 0 <= second < len(result.mission.obstacles):
        return ""
    return f", agent {first + 1} to {st.clean(result.mission.obstacles[second].name)}"


def draw_separation(ax: Axes, result: Result) -> None:
    """Least room between two agents, with its limit."""
    ax.set_ylabel("between agents [m]")
    values = np.where(np.isfinite(result.separation), result.separation, np.nan)
    if not np.isfinite(values).any():
        st.note(ax, "one agent alone" if result.n_agents == 1 else "not known")
        return
    st.line(ax, result.time, values, color=st.TONES[0])
    least = result.mission.limits.separation
    st.limit(
        ax, 0.0 if least is None else least, "contact" if least is None else f"limit {least:g} m"
    )
    _mark_least(ax, result, values, "separation")
    _from_zero(ax, values)


def draw_clearance(ax: Axes, result: Result) -> None:
    """Least room to an obstacle."""
    ax.set_ylabel("to obstacles [m]")
    values = np.where(np.isfinite(result.clearance), result.clearance, np.nan)
    if not np.isfinite(values).any():
        st.note(ax, "no obstacles" if not result.mission.obstacles else "not known")
        return
    st.line(ax, result.time, values, color=st.TONES[0])
    st.limit(ax, 0.0, "contact")
    _mark_least(ax, result, values, "clearance")
    _from_zero(ax, values)


def _from_zero(ax: Axes, values: Floats) -> None:
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    room = 0.25 * max(high, -low, 0.1)
    ax.set_ylim(min(low, 0.0) - room, max(high, 0.0) + room)


def draw_below(ax: Axes, result: Result, least: float) -> None:
    """Least vertical room below an agent, with its limit."""
    ax.set_ylabel("straight below [m]")
    values = room_below(result)
    if np.isfinite(values).any():
        st.line(ax, result.time, values, color=st.TONES[0])
        _mark_least(ax, result, values, "separation_below")
        _from_zero(ax, np.append(values, least))
    else:
        ax.text(
            0.5, 0.3, "nobody is ever straight below another", transform=ax.transAxes,
            ha="center", va="center", color=st.GREY,
        )  # fmt: skip
        ax.set_ylim(0, 1.4 * least or 1.0)
    st.limit(ax, least, f"limit {least:g} m")


@styled
def clearance(result: Result) -> Figure:
    """Least room between agents, straight below an agent, and to obstacles, with the limits."""
    mission = result.mission
    panels: list[Callable[[Axes], None]] = []
    if result.n_agents > 1 or not mission.obstacles:
        panels.append(lambda ax: draw_separation(ax, result))
    below = mission.limits.separation_below
    if below is not None and result.n_agents > 1:
        panels.append(lambda ax: draw_below(ax, result, below))
    if mission.obstacles:
        panels.append(lambda ax: draw_clearance(ax, result))
    height = 3.2 if len(panels) == 1 else 1.8
    fig, axes = st.time_figure(result, "Clearance between surfaces", len(panels), height=height)
    for draw, ax in zip(panels, axes[:, 0], strict=True):
        draw(ax)
    st.name_phases(fig, axes[0], result)
    return fig
