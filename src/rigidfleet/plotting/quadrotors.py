"""Figures of flights by vehicles with rotors: forces of the rotors, tilt, tracking error, saturation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rigidfleet._common.quantities import QUANTITIES
from rigidfleet.plotting import style as st
from rigidfleet.plotting.logged import true_runs
from rigidfleet.plotting.peaks import Panel, distinct_limits
from rigidfleet.result import LABELS, Extremum, Result
from rigidfleet.result.quantities import samples
from rigidfleet.typing import Bools, Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rigidfleet.mission import Mission

_TEXT_ROW = 0.35  # height of a row that holds only text


def rotor_limit(mission: Mission) -> Floats:
    """Maximum thrust (N,) of a rotor of each vehicle [N]; NaN for points, which have none."""
    limits = np.zeros(mission.n_agents)
    limits[:] = QUANTITIES["rotor_force"].limit_of(mission) or 0.0
    return np.where(limits > 0.0, limits, np.nan)


def has_rotors(result: Result) -> bool:
    """Whether a vehicle with rotors flies, and what they give is known."""
    return result.rotor_force is not None and bool(np.isfinite(rotor_limit(result.mission)).any())


def rotor_forces(result: Result) -> Floats:
    """Thrust (K, N, 4) of each rotor [N]; NaN for points and for vehicles that are lost."""
    assert result.rotor_force is not None
    known = result.left & np.isfinite(rotor_limit(result.mission))
    return np.where(known[..., None], result.rotor_force, np.nan)


def tilt(result: Result) -> Floats:
    """Tilt (K, N) of each vehicle [deg]; NaN for points and for vehicles that are lost."""
    known = np.isfinite(rotor_limit(result.mission))
    return np.where(known, samples(result, "tilt").values, np.nan)


def _rotor_nearest_to_limit(result: Result, limits: Floats) -> Extremum | None:
    """The rotor that comes nearest to its limit between samples; its ``other`` is the rotor."""
    every = [p.extremes["rotor_force"] for p in result.phases if "rotor_force" in p.extremes]
    return max(every, key=lambda x: x.value / limits[x.who], default=None)


@st.styled_figure(has_rotors, "no rotors")
def rotors(result: Result) -> Figure:
    """Greatest force of a rotor of each vehicle as a share of its limit; all rotors of the one nearest to its limit."""
    fig, (above, below) = st.time_figure(result, "Force of the rotors", 2)
    _draw_rotor_limit_shares(above, result)
    st.draw_agents_legend(above, result.n_agents)
    _draw_rotors_of_nearest(below, result)
    return fig


def _draw_rotor_limit_shares(ax: Axes, result: Result) -> None:
    """The greatest of the four rotors of each vehicle, as a share of its limit."""
    limits = rotor_limit(result.mission)
    share = 100.0 * rotor_forces(result).max(axis=2) / limits
    between = _rotor_nearest_to_limit(result, limits)
    if between is not None:
        between = between._replace(value=100.0 * between.value / limits[between.who], other=-1)
    ax.set_ylabel("share of the rotor limit [%]")
    Panel(ax, result, share, "%", between).draw([(100.0, "limit 100 %", st.ALERT)])


def _draw_rotors_of_nearest(ax: Axes, result: Result) -> None:
    """The four rotors of the vehicle that comes nearest to its limit, enlarged."""
    limits, force = rotor_limit(result.mission), rotor_forces(result)
    nearest = _rotor_nearest_to_limit(result, limits)
    peak = np.fmax.reduce(force, axis=(0, 2)) / limits
    i = int(np.nanargmax(peak)) if nearest is None else nearest.who
    colours = st.colour_scale(4)
    for k, colour in enumerate(colours):
        ax.plot(result.time, force[:, i, k], color=colour, linewidth=1.9 - 0.35 * k)
    Panel(ax, result, force[:, i], "N").crop_final_peak()
    low, high = ax.get_ylim()
    if limits[i] < high + 0.3 * (high - low):
        st.draw_limit(ax, float(limits[i]), f"limit {limits[i]:.4g} N")
    ax.set_ylabel(f"rotors of agent {i + 1} [N]")
    looks = zip(LABELS["rotor"], colours, strict=True)
    entries = [st.legend_entry(name, color=colour) for name, colour in looks]
    st.draw_legend(ax, entries, "nearest to its limit")


@st.styled_figure(has_rotors, "no rotors")
def vehicles(result: Result) -> Figure:
    """Tilt of each vehicle, its distance from its slot, and when it is asked for more than its rotors give."""
    saturated = np.zeros(result.left.shape, dtype=np.bool_)
    if result.saturated is not None:
        saturated = (result.saturated != 0) & result.left
    shares = (1.0, 1.0, 0.6 if saturated.any() else _TEXT_ROW)
    title = "Tilt, tracking error and saturation of the vehicles"
    fig, (above, middle, below) = st.time_figure(result, title, 3, height=1.9, shares=shares)
    draw_with_limit(above, result, "tilt", tilt(result))
    st.draw_agents_legend(above, result.n_agents)
    draw_with_limit(middle, result, "tracking_error")
    _draw_saturation(below, result, saturated)
    return fig


def draw_with_limit(
    ax: Axes, result: Result, name: str, values: Floats | None = None, *, always: bool = True
) -> bool:
    """Draw each agent's values (K, N) of a quantity, their greatest and the limits; return whether there are any.

    Without ``always``, the greatest is written only if it is off the scale.
    """
    q, between = QUANTITIES[name], result.extreme(name)
    ax.set_ylabel(f"{q.name_in_words.replace(' ', chr(10))} [{q.display_unit}]")
    values = samples(result, name).values if values is None else values
    if not np.isfinite(values).any():
        st.mark_empty(ax, q.nothing)
        return False
    if between is not None:
        between = between._replace(value=q.scale * between.value, other=-1)
    panel = Panel(ax, result, values, q.display_unit, between)
    return panel.draw(distinct_limits(result.mission, q), always=always)


def _draw_saturation(ax: Axes, result: Result, saturated: Bools) -> None:
    """A bar for each vehicle while it is saturated."""
    from matplotlib.ticker import MaxNLocator

    n, t, q = result.n_agents, result.time, QUANTITIES["saturation"]
    if not saturated.any():
        st.mark_empty(ax, q.nothing)
        return
    for i, colour in enumerate(st.agent_colours(n)):
        last = np.append(t, t[-1])
        bars = [(t[a], last[b] - t[a]) for a, b in true_runs(saturated[:, i])]
        ax.broken_barh(bars, (i + 0.6, 0.8), color=colour, linewidth=0.4)
    ax.set_ylim(n + 0.6, 0.4)
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_ylabel("saturated\nagent")
    st.write_above(ax, f"limit {q.limit_of(result.mission):.3g} % of a phase")
