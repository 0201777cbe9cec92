"""Figure of a flight whose vehicles know each other by messages."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rigidfleet.plotting import style as st
from rigidfleet.plotting.peaks import Panel
from rigidfleet.result import Result
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Ratio of the greatest push to the usual one from which an axis is logarithmic.
_DIVERGES = 1e4


@st.styled_figure(
    lambda result: result.message_age is not None and result.message_age.size,
    "no network: one law knows all states",
)
def messages(result: Result) -> Figure:
    """Age of the oldest message that each vehicle goes by, and the force by which the group pushes itself."""
    fig, (above, below) = st.time_figure(result, "Messages of neighbours", 2)
    above.set_ylabel("oldest message [s]")
    below.set_ylabel("sum of all\nconstraint forces [N]")
    net = result.mission.network
    assert net is not None
    age = oldest_message_ages(result)
    Panel(above, result, age, "s").draw()
    st.draw_agents_legend(above, result.n_agents)
    if net.silence < 2.0 * np.nanmax(age, initial=0.0):
        st.draw_limit(above, net.silence, f"an edge is let go: {net.silence:g} s")
    push = np.linalg.norm(np.nansum(result.constraint_force, axis=1), axis=1)
    below.plot(result.time, push, color=st.FLOWN)
    if push.max() > _DIVERGES * np.median(push) > 0.0:
        below.set_yscale("log")
    else:
        below.set_ylim(bottom=0.0)
    return fig


def oldest_message_ages(result: Result) -> Floats:
    """Age (K, N) of the oldest of the newest messages that each agent has of its neighbours [s]; NaN without any."""
    assert result.message_age is not None
    age = np.full((result.n_agents, len(result.time)), np.nan)
    for way in range(2):
        np.fmax.at(age, result.edges[:, way], result.message_age[:, :, way].T)
    return age.T
