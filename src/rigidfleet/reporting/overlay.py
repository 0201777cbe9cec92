"""Figures that overlay several flights, one colour each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet._common.quantities import QUANTITIES
from rigidfleet.plotting import encode_figure
from rigidfleet.plotting import style as st
from rigidfleet.plotting.peaks import distinct_limits
from rigidfleet.result.quantities import samples

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rigidfleet.result import Result

_WIDTHS = (2.6, 0.9)  # of lines, first flight to last: each remains visible under the next


def svg_of_paths(flights: Sequence[Result], labels: Sequence[str]) -> bytes:
    """Path of the centre of mass from above, and its height over time, as an SVG."""
    with st.apply_style():
        fig = st.blank_figure(st.FIGURE_WIDTH, 3.6, "constrained")
        above, height = fig.subplots(1, 2)
        for flight, look in zip(flights, _line_looks(flights), strict=True):
            above.plot(flight.cm[:, 0], flight.cm[:, 1], **look)
            height.plot(flight.time, flight.cm[:, 2], **look)
        above.set(xlabel="x, east [m]", ylabel="y, north [m]", title="centre of mass from above")
        above.set_aspect("equal", adjustable="datalim")
        above.margins(0.05)
        height.set(xlabel="time [s]", ylabel="z [m]", title="height of the centre of mass")
        _add_flights_legend(fig, flights, labels)
        return encode_figure(fig, ["svg"])["svg"]


def svg_of_time_curves(flights: Sequence[Result], labels: Sequence[str]) -> bytes:
    """Distances, thrust, speed and errors over time, as an SVG."""
    panels = ["separation", "thrust", "speed", "tracking_error", "constraint"]
    if any(flight.mission.obstacles for flight in flights):
        panels.insert(1, "clearance")
    with st.apply_style():
        rows = (len(panels) + 1) // 2
        fig = st.blank_figure(st.FIGURE_WIDTH, 0.6 + 1.9 * rows, "constrained")
        axes = fig.subplots(rows, 2, sharex=True, squeeze=False).ravel()
        for ax, name in zip(axes, panels, strict=False):
            known = False
            for flight, look in zip(flights, _line_looks(flights), strict=True):
                values = samples(flight, name).worst
                ax.plot(flight.time, values, **look)
                known |= bool(np.isfinite(values).any())
            q, logarithmic = QUANTITIES[name], name in ("tracking_error", "constraint")
            for limit in dict.fromkeys(x for f in flights for x in distinct_limits(f.mission, q)):
                st.draw_limit(ax, *limit)
            worst = "least" if q.at_least else "greatest"
            ax.set_title(f"{worst} {q.name_in_words} [{q.display_unit}]", loc="left")
            if not known:
                st.mark_empty(ax, "nothing to show")
            elif logarithmic:
                ax.set_yscale("log", nonpositive="clip")
                ax.set_ylim(bottom=max(ax.get_ylim()[0], 1e-12))
            elif ax.get_ylim()[0] > 0:
                ax.set_ylim(bottom=0)
        for ax in axes[len(panels) :]:
            ax.set_visible(False)
        for ax in axes[len(panels) - 2 : len(panels)]:
            ax.set_xlabel("time [s]")
            ax.tick_params(labelbottom=True)
        _add_flights_legend(fig, flights, labels)
        return encode_figure(fig, ["svg"])["svg"]


def _line_looks(flights: Sequence[Result]) -> list[dict[str, Any]]:
    """Colour and width of each flight's lines."""
    widths = np.linspace(*_WIDTHS, len(flights)) if len(flights) > 1 else [1.6]
    colours = st.agent_colours(len(flights))
    return [{"color": c, "linewidth": float(w)} for c, w in zip(colours, widths, strict=True)]


def _add_flights_legend(fig: Figure, flights: Sequence[Result], labels: Sequence[str]) -> None:
    looks = zip(labels, _line_looks(flights), strict=True)
    handles = [st.legend_entry(st.clean_name(label, 60), **look) for label, look in looks]
    fig.legend(handles=handles, loc="outside lower center", ncols=st.legend_columns(handles))
