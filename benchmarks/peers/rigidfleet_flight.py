"""rigidfleet itself: all of `simulate`, as a user calls it, result included."""

from __future__ import annotations

from rigidfleet import __version__
from rigidfleet.simulation.flight import simulate

from .case import TOLERANCES, Array, Case, Flight, Peer, timed


def peer() -> Peer:
    """Adaptive steps, at a tolerance."""
    return Peer(
        "rigidfleet simulate()",
        __version__,
        "all that a user waits for: planning, flight, and a result of 200 samples",
        True,
        TOLERANCES,
        "tolerance",
        flight,
    )


def flight(case: Case, tolerance: float) -> Flight:
    """All of `simulate`."""
    mission = case.within(tolerance)

    def fly() -> Array:
        return simulate(mission).position[-1]

    return timed(fly)
