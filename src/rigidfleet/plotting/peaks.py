"""Parts of figures over time: peaks in words, limits of axes that a breakdown does not spoil, values from zero."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.plotting import style as st
from rigidfleet.result import Extremum, Result
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Force [N] or displacement [m] below which there is only rounding.
IDLE = 1e-6


def peak_before_breakdown(result: Result, values: Floats) -> float:
    """Greatest value; if the flight broke down, the greatest one before the final peak."""
    size = np.abs(values[np.isfinite(values)])
    if not len(size):
        return 0.0
    usual = float(np.quantile(size, 0.99))
    peak = float(size.max())
    return peak if result.complete or peak < 10 * usual else 2 * usual


def agent_name(i: int) -> str:
    """Name of an agent, counted from 0, in figures."""
    return f"agent {i + 1}"


def distinct_limits(values: Floats) -> list[tuple[float, str, str]]:
    """Each distinct limit of the agents' limits (N,) with a label and a colour; the agent's if only one has it."""
    colours = st.agent_colours(len(values))
    lines = []
    for value in np.unique(values[np.isfinite(values)]).tolist():
        of = np.flatnonzero(values == value)
        colour = colours[of[0]] if len(of) == 1 < len(values) else st.ALERT
        who = "" if len(of) == len(values) else " of " + ", ".join(str(i + 1) for i in of[:6])
        lines.append((value, f"limit{who} {value:.4g} N", colour))
    return lines


def _edge_name(x: Extremum) -> str:
    return f"edge {x.who + 1}-{x.other + 1}"


def mark_extremes(
    ax: Axes,
    result: Result,
    values: Floats,
    unit: str,
    who: Callable[[int], str],
    *,
    name: str = "",
    always: bool = True,
    between: Extremum | None = None,
) -> None:
    """Write the greatest of values (K, n) into the axes, and mark values off the scale at top and bottom.

    The greatest value ``between`` samples counts, too; by default the one that the record has by ``name``. Without
    ``always``, only values off the scale are written.
    """
    between = result.extreme(name) if between is None else between
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
            whose = _edge_name(between) if between.other >= 0 else agent_name(between.who)
        caption = f"peak {peak:.3g} {unit}: {whose} at {when:.2f} s"
        if not cut:
            if high <= peak < 1.5 * high:
                ax.set_ylim(low, peak + 0.05 * (peak - low))
            if peak > values[k, i]:
                ax.plot(
                    when, peak, "o", markersize=4, markerfacecolor="none", markeredgecolor=st.INK
                )
            st.annotate(ax, caption, st.corner_places())
            continue
        t = result.time[int((size > sign * edge).any(axis=1).argmax())]
        look: dict[str, Any] = {"color": st.ALERT, "markersize": 5, "clip_on": False, "zorder": 6}
        ax.plot(t, edge, marker, **look, gid="cut")
        st.annotate(
            ax,
            f"off scale: {caption}",
            [*st.places_around(t, edge), *st.corner_places()],
            color=st.ALERT,
        )


def note_if_idle(
    ax: Axes, result: Result, values: Floats, unit: str, who: Callable[[int], str]
) -> bool:
    """If values (K, n) are only rounding errors, say so in the axes; return whether they are."""
    size = np.where(np.isfinite(values), np.abs(values), -np.inf)
    k, i = np.unravel_index(int(size.argmax()), size.shape) if size.size else (0, 0)
    if not size.size or not np.isfinite(size[k, i]) or size[k, i] > IDLE:
        return False
    where = f", {who(int(i))} at {result.time[k]:.2f} s" if size[k, i] else ""
    st.write_note(ax, f"only rounding errors: at most {size[k, i]:.3g} {unit}{where}")
    return True


def leave_out_final_peak(ax: Axes, result: Result, values: Floats) -> None:
    """Choose limits that leave out the final peak of a flight that broke down."""
    top = peak_before_breakdown(result, values)
    if top < np.nanmax(np.abs(values), initial=0.0):
        finite = values[np.isfinite(values)]
        low = max(float(finite.min()), -top)
        ax.set_ylim(low - 0.05 * (top - low), top)


def draw_from_zero(
    ax: Axes,
    result: Result,
    values: Floats,
    unit: str,
    name: str = "",
    between: Extremum | None = None,
) -> bool:
    """Draw each agent's values (K, N) from zero, and write the greatest; return whether there was anything to draw."""
    if note_if_idle(ax, result, values, unit, agent_name):
        return False
    st.draw_agent_lines(ax, result, values)
    top = peak_before_breakdown(result, values)
    if top > 0.0:
        ax.set_ylim(-0.04 * top, 1.12 * top)
    mark_extremes(ax, result, values, unit, agent_name, name=name, between=between)
    return True
