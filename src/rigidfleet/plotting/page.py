"""A summary of a flight on one page: paths, distances, attitude, thrust, clearance."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.plotting import curves, space
from rigidfleet.plotting import style as st
from rigidfleet.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def _legend_above(ax: Axes, handles: list[Any]) -> None:
    ax.legend(
        handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.06), ncols=len(handles),
        columnspacing=1.2,
    )  # fmt: skip


def _draw_attitude_or_constraint(ax: Axes, result: Result) -> None:
    """Three Euler angles in one axes, dark to light; without an attitude, the constraint error."""
    flown, wanted, _ = curves.flown_and_wanted_euler(result)
    if not np.isfinite(flown).any():
        if entries := curves.draw_constraint_error(ax, result):
            _legend_above(ax, entries)
        return
    ax.set_ylabel("attitude [deg]")
    handles = []
    for i, (name, width) in enumerate((("roll", 1.2), ("pitch", 1.8), ("yaw", 2.4))):
        look: dict[str, Any] = {"color": st.TONES[i], "linewidth": width, "zorder": 2.3 - 0.1 * i}
        ax.plot(result.time, flown[:, i], **look)
        st.draw_reference(ax, result.time, wanted[:, i])
        handles.append(st.legend_entry(name, **look))
    _legend_above(ax, handles)
    curves.fit_to_variation(ax, np.concatenate([flown, wanted]), "deg")


# Of trajectories that others made, most panels would be empty.
@st.styled_figure(lambda x: curves.has_edges(x) or curves.has_thrust(x) or curves.has_attitude(x))
def summary(result: Result) -> Figure:
    """Summary of the flight on one page.

    It has the trajectory, the view from above, distances (without edges: separation), attitude, thrust and clearance.
    """
    fig = st.blank_figure(11.4, 7.0)
    st.draw_flight_heading(fig, result, st.clean_name(result.mission.title, 80) or "Flight")
    view = space.trajectory_scene(result)
    space.draw_trajectory_in_space(fig, result, view, (0.0, 0.49, 0.41, 0.47))
    space.draw_trajectory_from_above(fig.add_axes((0.475, 0.575, 0.195, 0.345)), result, view)
    lengths = fig.add_axes((0.73, 0.575, 0.257, 0.315))
    angles, thrust, apart = (fig.add_axes((x, 0.165, 0.257, 0.275)) for x in (0.06, 0.395, 0.73))
    over_time = (lengths, angles, thrust, apart)
    for ax in over_time:
        st.draw_time_axis(ax, result)
        ax.set_xlabel("time [s]")
    key = textwrap.fill(st.number_phases(over_time, result), 150, max_lines=3, placeholder=" …")
    if curves.has_edges(result):
        curves.draw_edge_lengths(lengths, result)
    elif result.mission.obstacles and result.n_agents > 1:
        curves.draw_least(lengths, result, "separation")
    else:
        curves.draw_constraint_error(lengths, result)
    if 0 < len(result.edges) <= curves.SINGLE:
        _legend_above(lengths, curves.edge_handles(result))
    _draw_attitude_or_constraint(angles, result)
    curves.draw_thrust_or_distance(thrust, result)
    curves.draw_least(apart, result, "clearance" if result.mission.obstacles else "separation")
    entries = space.trajectory_legend_entries(result, view)
    fig.legend(
        handles=entries, loc="lower center", ncols=math.ceil(len(entries) / (1 if len(entries) <= 10 else 2)),
        bbox_to_anchor=(0.5, 0.058), labelspacing=0.2,
    )  # fmt: skip
    fig.text(
        0.5, 0.05, key, ha="center", va="top", fontsize=7.5, color=st.GREY,
        parse_math=False,
    )  # fmt: skip
    return fig
