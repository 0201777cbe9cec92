"""rigidfleet itself: all of `simulate`, as a user calls it, result included."""

from __future__ import annotations

from rigidfleet import __version__
from rigidfleet.simulate import simulate

from .case import Array, Case, Flight, Peer, timed


def peer() -> Peer:
    """Adaptive steps, at a tolerance."""
    return Peer(
        "rigidfleet simulate()",
        __version__,
        "all that a user waits for: planning, flight, and a result of 200 samples",
        True,
        (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10),
        "tolerance",
        flight,
    )


def flight(case: Case, tolerance: float) -> Flight:
    """All of `simulate`."""
    mission = case.within(tolerance)

    def fly() -> Array:
        return simulate(mission).position[-1]

    return timed(fly)
