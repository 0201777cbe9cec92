"""Values over time in an axes: peaks in words, limits of axes that a breakdown does not spoil, values from zero."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet._common.quantities import Quantity
from rigidfleet.plotting import style as st
from rigidfleet.result import Extremum, Result
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rigidfleet.mission import Mission

#: Force [N] or displacement [m] below which there is only rounding.
IDLE = 1e-6
#: A value of a limit with its label and colour.
Limit = tuple[float, str, str]


def peak_before_breakdown(result: Result, values: Floats) -> float:
    """Greatest value; if the flight broke down, the greatest one before the final peak."""
    size = np.abs(values[np.isfinite(values)])
    if not len(size):
        return 0.0
    usual = float(np.quantile(size, 0.99))
    peak = float(size.max())
    return peak if result.complete or peak < 10 * usual else 2 * usual


def distinct_limits(mission: Mission, q: Quantity) -> list[Limit]:
    """Each distinct limit that a mission sets with a label and a colour; the agent's if only one has it."""
    limit, unit = q.limit_of(mission), q.display_unit
    values = np.full(mission.n_agents, np.nan if limit is None else limit, dtype=float)
    colours = st.agent_colours(len(values))
    lines = []
    for value in np.unique(values[np.isfinite(values)]).tolist():
        of = np.flatnonzero(values == value)
        colour = colours[of[0]] if len(of) == 1 < len(values) else st.ALERT
        who = "" if len(of) == len(values) else " of " + ", ".join(str(i + 1) for i in of[:6])
        lines.append((value, f"limit{who} {value:g} {unit}", colour))
    return lines


def _agent_name(i: int) -> str:
    return f"agent {i + 1}"


@dataclass(frozen=True)
class Panel:
    """An axes with values of agents, or of edges.

    Attributes
    ----------
    values : (K, n), of a ``unit``
    between : the greatest one between samples, where it is known
    name : of what has number i, from 0
    """

    ax: Axes
    result: Result
    values: Floats
    unit: str
    between: Extremum | None = None
    name: Callable[[int], str] = _agent_name

    def write_peak(self, *, always: bool = True) -> None:
        """Write the greatest value into the axes, and mark values off the scale at top and bottom.

        Without ``always``, only values off the scale are written.
        """
        ax, values, between, time = self.ax, self.values, self.between, self.result.time
        low, high = ax.get_ylim()
        for sign, edge, marker in ((1.0, high, "^"), (-1.0, low, "v")):
            size = np.where(np.isfinite(values), sign * values, -np.inf)
            k, i = np.unravel_index(int(size.argmax()), size.shape)
            cut = size[k, i] > sign * edge
            if not np.isfinite(size[k, i]) or not (cut or (always and sign > 0)):
                continue
            peak, when, whose = float(values[k, i]), float(time[k]), self.name(int(i))
            if between is not None and sign > 0 and between.value > peak:
                peak, when, whose = between.value, between.time, _agent_name(between.who)
                if between.other >= 0:
                    whose = f"edge {between.who + 1}-{between.other + 1}"
            caption = f"peak {peak:.3g} {self.unit}: {whose} at {when:.2f} s"
            if cut:
                t = time[int((size > sign * edge).any(axis=1).argmax())]
                look: dict[str, Any] = {"color": st.ALERT, "markersize": 5, "clip_on": False}
                ax.plot(t, edge, marker, **look, zorder=6, gid="cut")
                st.write_above(ax, f"off scale: {caption}", st.ALERT)
                continue
            if high <= peak < 1.5 * high:
                ax.set_ylim(low, peak + 0.05 * (peak - low))
            if peak > values[k, i]:
                ring: dict[str, Any] = {"markerfacecolor": "none", "markeredgecolor": st.INK}
                ax.plot(when, peak, "o", markersize=4, **ring)
            st.write_above(ax, caption)

    def note_if_rounding(self) -> bool:
        """If values are only rounding errors, say so in the axes; return whether they are."""
        size = np.where(np.isfinite(self.values), np.abs(self.values), -np.inf)
        k, i = np.unravel_index(int(size.argmax()), size.shape) if size.size else (0, 0)
        if not size.size or not np.isfinite(size[k, i]) or size[k, i] > IDLE:
            return False
        where = f"{self.name(int(i))} at {self.result.time[k]:.2f} s"
        words = f"only rounding errors: at most {size[k, i]:.3g} {self.unit}, {where}"
        st.mark_empty(self.ax, words if size[k, i] else f"0 {self.unit} throughout")
        return True

    def crop_final_peak(self) -> None:
        """Choose limits that leave out the final peak of a flight that broke down."""
        top = peak_before_breakdown(self.result, self.values)
        if top < np.nanmax(np.abs(self.values), initial=0.0):
            low = max(float(np.nanmin(self.values)), -top)
            self.ax.set_ylim(low - 0.05 * (top - low), top)

    def draw(self, limits: Sequence[Limit] = (), *, always: bool = True) -> bool:
        """Draw each agent's values from zero, with their limits; return whether there was anything to draw.

        The greatest is written; see `write_peak`.
        """
        if self.note_if_rounding():
            return False
        st.draw_agent_lines(self.ax, self.result, self.values)
        for limit in limits:
            st.draw_limit(self.ax, *limit)
        peak = peak_before_breakdown(self.result, self.values)
        top = max([peak, *(value for value, *_ in limits)])
        if top > 0.0:
            self.ax.set_ylim(-0.04 * top, 1.12 * top)
        self.write_peak(always=always)
        return True
