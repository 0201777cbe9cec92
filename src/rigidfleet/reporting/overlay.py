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

#: Quantities that are drawn over time.
_PANELS = "separation", "clearance", "thrust", "speed", "tracking_error", "constraint"
#: Of these, those whose axis is logarithmic, and shows no zero.
_LOGARITHMIC = "tracking_error", "constraint"
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
    """Distances, thrust, speed and errors over time, as far as any flight has them, as an SVG."""
    every = {name: [samples(flight, name).worst for flight in flights] for name in _PANELS}
    known = {name: np.concatenate(x) for name, x in every.items()}
    shown = [
        name
        for name, x in known.items()
        if (np.isfinite(x) & ((x != 0.0) | (name not in _LOGARITHMIC))).any()
    ] or ["speed"]
    with st.apply_style():
        rows = (len(shown) + 1) // 2
        fig = st.blank_figure(st.FIGURE_WIDTH, 0.6 + 1.9 * rows, "constrained")
        axes = fig.subplots(rows, 2, sharex=True, squeeze=False).ravel()
        for ax, name in zip(axes, shown, strict=False):
            for flight, worst, look in zip(flights, every[name], _line_looks(flights), strict=True):
                ax.plot(flight.time, worst, **look)
            q = QUANTITIES[name]
            for limit in dict.fromkeys(x for f in flights for x in distinct_limits(f.mission, q)):
                st.draw_limit(ax, *limit)
            sense = "least" if q.at_least else "greatest"
            ax.set_title(f"{sense} {q.name_in_words} [{q.display_unit}]", loc="left")
            if name in _LOGARITHMIC:
                ax.set_yscale("log", nonpositive="clip")
                ax.set_ylim(bottom=max(ax.get_ylim()[0], 1e-12))
            elif ax.get_ylim()[0] > 0:
                ax.set_ylim(bottom=0)
        for ax in axes[len(shown) :]:
            ax.set_visible(False)
        for ax in axes[max(len(shown) - 2, 0) : len(shown)]:
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
