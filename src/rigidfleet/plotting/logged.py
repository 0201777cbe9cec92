"""The figure of a log against its plan."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.plotting import style as st
from rigidfleet.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@st.in_style
def plan_and_flight(result: Result) -> Figure:
    """The plan (dashed) and the flight from above, and how far vehicles are from their slots, with what is in doubt."""
    bands, slots, r, n = (
        result.statistics["bands"],
        result.slot_position,
        result.position,
        result.n_agents,
    )
    far = 1e3 * np.where(result.left, np.linalg.norm(r - slots, axis=2), np.nan)
    fig = st.blank_figure(st.WIDTH, 3.9, "constrained")
    above, off = fig.subplots(1, 2, width_ratios=(0.8, 1.2))
    st.draw_time_axis(off, result)
    colours, names = st.agent_colours(n), result.statistics["names"]
    for i, colour in enumerate(colours):
        above.plot(*r[:, i, :2].T, color=colour, linewidth=1.4)
        above.plot(*slots[:, i, :2].T, **st.REFERENCE, zorder=3)
        by = 1e3 * np.interp(result.time, bands["time"], np.array(bands["place"])[:, i])
        low, high = np.maximum(far[:, i] - by, 0.0), far[:, i] + by
        off.fill_between(result.time, low, high, color=colour, alpha=0.25, linewidth=0)
        st.draw_line(off, result.time, far[:, i], color=colour)
    for i, each in enumerate(result.statistics["doubt"].get("vehicles", ())):
        if each["off_its_slot"] or each["late"]:
            at, most = each["worst_at_s"], 1e3 * each["worst_off_m"]
            words = f"{st.clean_name(names[i])}: {most:.3g} mm at {at:.2f} s"
            st.annotate(off, words, st.places_around(at, most), color=colours[i])
    above.set(xlabel="x, east [m]", ylabel="y, north [m]")
    above.set_aspect("equal", adjustable="datalim")
    off.set(xlabel="time [s]", ylabel="distance from the slot [mm]")
    off.set_ylim(0.0, 1.25 * float(np.nanmax(far)) + 1e-3)
    look: dict[str, Any] = {"loc": "outside lower center", "ncols": min(n + 1, 8)}
    entries = [
        st.legend_entry(st.clean_name(x), color=c) for x, c in zip(names, colours, strict=True)
    ]
    fig.legend(handles=[*entries[:15], st.legend_entry("plan", **st.REFERENCE)], **look)
    st.draw_head(fig, result, "The flight against its plan")
    return fig
