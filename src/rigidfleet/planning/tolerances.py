"""How exactly a phase is flown, and when it takes too many steps to go on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rigidfleet.math.rigid_body import about_cm
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from rigidfleet.mission.schema import IntegratorOptions


#: A phase has stalled that took more steps than these and those for each second of mission time, or
#: more than the last in all. A step of 1 ms is already that of gains above 1e3 /s.
_STALLED, _STALLED_RATE, _MOST_STEPS = 50_000, 2_000.0, 5_000_000


def most_steps(flown: float) -> int:
    """Steps that a phase may have taken after so long [s]: far more than its length in time explains."""
    return int(min(_STALLED + _STALLED_RATE * flown, _MOST_STEPS))


def absolute_tolerances(
    given: IntegratorOptions, size: int, velocity: Floats, distances: Floats, *, large: bool
) -> Floats:
    """Absolute tolerances (size,) of the states, class by class.

    The integral of c is in its law what a distance is, times a second; but it stays near zero, where
    a relative tolerance asks for nothing. In large formations it would set the step alone: there it is held
    to what its own distance is held to, and velocities to what places are.

    Parameters
    ----------
    size : number of states: places and velocities (3N each), integrals (m), and what follows them
    velocity : (N,) of the velocities [m/s], by `tolerance_of_velocity`
    distances : (m,) of the edges [m]
    large : whether the formation is
    """
    n, m = len(velocity), len(distances)
    atol = np.full(size, given.atol)
    atol[3 * n : 6 * n] = np.repeat(velocity, 3)
    if given.atol_integral is not None:
        atol[6 * n : 6 * n + m] = given.atol_integral
    elif large:
        atol[6 * n : 6 * n + m] = given.atol + given.rtol * distances
    if given.atol_attitude is not None:
        atol[6 * n + m : 6 * n + m + 4] = given.atol_attitude
    return atol


def tolerance_of_velocity(
    given: IntegratorOptions, r: Floats, masses: Floats, beta: float, *, large: bool
) -> Floats:
    """Absolute tolerance (N,) of velocities [m/s] of agents at r (N, 3) [m].

    The law takes errors back at the rate beta [1/s]: one of a velocity becomes one of a place 1/beta of it. In
    large formations, unless given, it is therefore beta times the tolerance of the agent's place about the CM.
    """
    if given.atol_velocity is not None or not large:
        return np.full(len(r), given.atol_velocity or given.atol)
    away = np.linalg.norm(about_cm(r, masses), axis=1)
    return np.maximum(given.atol, beta * (given.atol + given.rtol * away))
