"""A log against its plan: how far vehicles are off their slots and when, and the figure of it."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rigidfleet._common.facts import value
from rigidfleet.plotting import style as st
from rigidfleet.result import Result
from rigidfleet.typing import Bools, Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Vehicles that are drawn at most.
_SHOWN = 12
#: What is off a slot at least, where the mission has no limit [m]; then twice what is usual counts, too.
_OFF = 0.01
#: Time within which a vehicle that is off its slot again is still off it [s].
_SOON = 1.0


class Drift(NamedTuple):
    """A time in which a vehicle, counted from 0, is surely off its slot [s]; how far at most [m], and when [s]."""

    who: int
    start: float
    end: float
    worst: float
    at: float


class OffPlan(NamedTuple):
    """Distances of vehicles from their slots.

    Attributes
    ----------
    far, doubt : (K, N) distance [m], NaN of those that do not fly; and how far a place is in doubt [m]
    limit : of the mission, or what would be unusual in this flight [m]
    """

    far: Floats
    doubt: Floats
    limit: float

    @property
    def distance_interval(self) -> Floats:
        """From what to what (2, K, N) [m] the distances are."""
        return np.stack([np.maximum(self.far - self.doubt, 0.0), self.far + self.doubt])

    def drift_spans(self, time: Floats) -> list[Drift]:
        """Each time in which a vehicle is off, those of one after the other."""
        drifts = []
        for i, off in enumerate((self.distance_interval[0] > self.limit).T):
            k = np.flatnonzero(off)
            again = (np.diff(k) > 1) & (np.diff(time[k]) >= _SOON)
            for part in np.split(k, np.flatnonzero(again) + 1)[: len(k)]:
                a, b = part[[0, -1]]
                worst = a + np.nanargmax(self.far[a : b + 1, i])
                numbers = time[a], time[b], self.far[worst, i], time[worst]
                drifts.append(Drift(i, *map(float, numbers)))
        return drifts


def true_runs(mask: Bools) -> list[tuple[int, int]]:
    """Where a mask (K,) is true: the first sample of each run, and the one after its last."""
    ends = np.flatnonzero(np.diff(np.pad(mask, 1).astype(int))).tolist()
    return list(pairwise(ends))[::2]


def off_plan(result: Result) -> OffPlan | None:
    """How far the vehicles of a log are off their plan; None of a flight that is no log, or has no plan."""
    facts = result.statistics
    vehicles = facts.get("doubt", {}).get("vehicles")
    if vehicles is None:
        return None
    off = np.linalg.norm(result.position - result.slot_position, axis=2)
    bands = facts.get("bands", {"time": result.time[:1], "place": np.zeros((1, result.n_agents))})
    places = np.array(bands["place"]).T
    doubt = np.stack([np.interp(result.time, bands["time"], place) for place in places], axis=1)
    usual = float(np.median([each["mean_off_m"] for each in vehicles]))
    limit = result.mission.limits.tracking_error or max(_OFF, 2.0 * usual)
    return OffPlan(np.where(result.left, off, np.nan), doubt, limit)


@st.styled_figure(lambda result: "bands" in result.statistics, "no log against a plan")
def plan_and_flight(result: Result) -> Figure:
    """The plan (dashed) and the flight from above, and how far vehicles are from their slots, with what is in doubt."""
    fig = st.blank_figure(st.FIGURE_WIDTH, 3.9, "constrained")
    above, below = fig.subplots(1, 2, width_ratios=(0.8, 1.2))
    st.draw_flight_heading(fig, result, "The flight against its plan")
    off = off_plan(result)
    assert off is not None  # there are bands
    n, time, slots = result.n_agents, result.time, result.slot_position
    st.draw_time_axis(below, result)
    colours, names = st.agent_colours(n), [st.clean_name(x) for x in result.statistics["names"]]
    # Of many vehicles, those that are off the most.
    shown = np.sort(np.argsort(-np.fmax.reduce(off.far, axis=0))[:_SHOWN]).tolist()
    low, high = 1e3 * off.distance_interval
    for i in shown:
        look: dict[str, Any] = {"color": colours[i]}
        above.plot(*result.position[:, i, :2].T, **look, linewidth=1.4)
        above.plot(*slots[:, i, :2].T, **st.REFERENCE, zorder=3)
        below.fill_between(time, low[:, i], high[:, i], **look, alpha=0.25, linewidth=0)
        below.plot(time, 1e3 * off.far[:, i], **look)
        mine = [drift for drift in off.drift_spans(time) if drift.who == i]
        for drift in mine:  # where and when it is off, in bold
            k = slice(*np.searchsorted(time, [drift.start, drift.end]))
            bold = {"color": colours[i], "linewidth": 3.5, "alpha": 0.6, "gid": "drift"}
            above.plot(*result.position[k, i, :2].T, **bold)
            below.plot(time[k], 1e3 * off.far[k, i], **bold)
        if mine:
            worst = max(mine, key=lambda drift: drift.worst)
            names[i] += f": {value(1e3 * worst.worst, 'mm')} at {worst.at:.2f} s"
    below.set_ylim(0.0, 1.25 * float(np.fmax.reduce(high, axis=None, initial=1e-3)))
    words = "unusual from" if result.mission.limits.tracking_error is None else "limit"
    st.draw_limit(below, 1e3 * off.limit, f"{words} {value(1e3 * off.limit, 'mm')}")
    above.set(xlabel="x, east [m]", ylabel="y, north [m]")
    above.set_aspect("equal", adjustable="datalim")
    below.set(xlabel="time [s]", ylabel="distance from the slot [mm]")
    look = {"loc": "outside lower center", "ncols": min(n + 1, 4)}
    entries = [st.legend_entry(names[i], color=colours[i]) for i in shown]
    fig.legend(handles=[*entries, st.legend_entry("plan", **st.REFERENCE)], **look)
    return fig
