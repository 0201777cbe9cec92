"""Which moments of a flight are recorded."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet._common.arguments import as_numbers
from rigidfleet.planning.plan import PhasePlan
from rigidfleet.typing import Floats


def times_between(
    wanted: Floats | float, plan: PhasePlan, t: float, t_end: float, *, first: bool, stop: float
) -> Floats:
    """Times in (t, t_end] [s] of a phase to record: those of the user, or multiples of a step [s] and exact moments.

    Exact moments are ends of phases, arrivals, points to pass, losses, and ``stop``, where the caller stops. The start
    of a phase, which is ``first`` after a switch, is recorded one representable number later; so is the state after a
    loss.
    """
    if isinstance(wanted, np.ndarray):
        begin = 0 if first and t == 0.0 else wanted.searchsorted(t, "right")
        return wanted[begin : wanted.searchsorted(t_end, "right")]
    step, same = wanted, 1e-9 * wanted  # but for rounding
    low, high = math.floor(t / step + 1e-9) + 1, math.floor(t_end / step + 1e-9) + 1
    grid = np.minimum(np.arange(low, high) * step, t_end)
    losses = (*plan.lost_at.tolist(), *plan.links_lost[1].tolist()) if plan.loses else ()
    passed = (at["time"] for at in plan.through)
    for exact in dict.fromkeys((plan.arrival, plan.t_end, stop, *passed, *losses)):
        if t < exact <= t_end:
            # In the place of those that differ from it by rounding alone.
            a, b = grid.searchsorted(exact - same), grid.searchsorted(exact + same, "right")
            grid = np.concatenate([grid[:a], (exact,), grid[b:]])
    if not first:
        return grid
    start = t if t == 0.0 else math.nextafter(t, math.inf)
    return np.concatenate([(start,), grid[grid.searchsorted(start, "right") :]])


def requested_times(times: ArrayLike, end: float) -> Floats:
    """Times [s] to record, sorted; those that rounding puts after the end are moved to the end.

    Raises
    ------
    ValueError
        A time lies outside the mission.
    """
    t = np.unique(as_numbers("times to record [s]", times))
    if not (len(t) and t[0] >= 0.0 and t[-1] <= end * (1.0 + 1e-12)):
        raise ValueError(f"times to record must lie between 0 and the mission's end, {end:g} s")
    return t if t[-1] <= end else np.unique(np.minimum(t, end))
