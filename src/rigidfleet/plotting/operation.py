"""The figure that an operator of a show reads: altitude, speeds and separation over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.plotting import style as st
from rigidfleet.plotting.curves import draw_least
from rigidfleet.result import Result
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def has_vertical_phase(result: Result) -> bool:
    """Whether vehicles take off or land in a phase of their own."""
    return any(phase.vertical is not None for phase in result.mission.phases)


@st.styled_figure(has_vertical_phase)
def operation(result: Result, agents: Sequence[int] = ()) -> Figure:
    """Altitude and speeds of all vehicles, their least separation, and their clearance to obstacles.

    Parameters
    ----------
    agents : numbers of vehicles, from 1, to draw alone, with a line each; by default all

    Raises
    ------
    ValueError
        There is no such vehicle.
    """
    n = result.n_agents
    if beyond := [i for i in agents if not 1 <= i <= n]:
        raise ValueError(f"there is no agent {beyond[0]}; agents are numbered from 1 to {n}")
    fig, (above, fast, climb, apart, clear) = st.time_figure(result, "Operation", 5, height=1.6)
    v = result.velocity
    limits = result.mission.limits
    for ax, words, values in (
        (above, "altitude [m]", result.position[..., 2]),
        (fast, "speed [m/s]", np.linalg.norm(v, axis=2)),
        (climb, "vertical [m/s]", v[..., 2]),
    ):
        ax.set_ylabel(words)
        handles = _draw_vehicle_lines(ax, result, np.where(result.left, values, np.nan), agents)
    # One legend for three panels; beside one of them it would push the others apart.
    fig.legend(handles=handles, loc="outside right center", labelspacing=0.3)
    if (fence := limits.geofence) is not None:
        st.draw_limit(above, fence.max[2], f"geofence {fence.max[2]:g} m")
    for ax, top in ((fast, limits.speed), (climb, limits.vertical_speed)):
        if top is not None:
            st.draw_limit(ax, top, f"limit {top:g} m/s")
    draw_least(apart, result, "separation")
    draw_least(clear, result, "clearance")
    return fig


def _draw_vehicle_lines(
    ax: Axes, result: Result, values: Floats, agents: Sequence[int]
) -> list[Any]:
    """Lines of some vehicles, or of all; return what the legend has of them."""
    if not agents:
        st.draw_agent_lines(ax, result, values)
        return st.agent_line_handles(result.n_agents)
    colours = st.agent_colours(len(agents))
    return [
        ax.plot(result.time, values[:, i - 1], color=colour, label=f"agent {i}")[0]
        for i, colour in zip(agents, colours, strict=True)
    ]
