"""rigidfleet's flight alone: what others are measured against, since their building is not timed either."""

from __future__ import annotations

import numpy as np
from run import compiled_flight

from rigidfleet import __version__
from rigidfleet.simulation.flight import simulate

from .case import DURATION, TOLERANCES, Array, Case, Flight, Peer, timed

#: Agents up to which constraint forces are solved for in the kernel itself.
DENSE = 20


def peer() -> Peer:
    """Adaptive steps, at a tolerance."""
    return Peer(
        "rigidfleet",
        __version__,
        "adaptive steps; the flight alone, planned before the clock starts",
        True,
        TOLERANCES,
        "tolerance",
        flight,
    )


def flight(case: Case, tolerance: float) -> Flight:
    """The compiled kernel; or where it is not alone in solving, `simulate` by its own clock."""
    if case.n <= DENSE:
        fly = compiled_flight(case.mission, tolerance)

        def end() -> Array:
            return fly()[-1, : 3 * case.n].reshape(-1, 3).copy()

        return timed(end)
    mission = case.within(tolerance)

    def whole() -> tuple[float, Array]:
        result = simulate(mission, times=np.array([0.0, DURATION]))
        return result.statistics["wall_s"], result.position[-1]

    return whole
