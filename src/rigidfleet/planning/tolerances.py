"""Integration tolerances of a phase, and the number of steps beyond which it is stopped."""

from __future__ import annotations

import numpy as np

from rigidfleet.math.rigid_body import about_cm
from rigidfleet.mission.schema import IntegratorOptions
from rigidfleet.typing import Floats

#: A phase has stalled if it takes more steps than the first number plus the second per second of mission
#: time, or more than the third in all. Steps of 1 ms already mean gains above 1e3 /s.
_STALLED, _STALLED_RATE, _MOST_STEPS = 50_000, 2_000.0, 5_000_000


def step_limit(flown: float) -> int:
    """Greatest number of steps of a phase after ``flown`` [s]: far more than this duration explains."""
    return int(min(_STALLED + _STALLED_RATE * flown, _MOST_STEPS))


def absolute_tolerances(
    options: IntegratorOptions, size: int, velocity: Floats, distances: Floats, *, large: bool
) -> Floats:
    """Absolute tolerances (size,) of the states, class by class.

    The integral of c enters the law like a distance times 1 s. It stays near zero, where a relative tolerance has
    no effect, so in large formations it alone would limit the step. There its tolerance is that of its own
    distance, and the tolerance of a velocity follows from that of the position.

    Parameters
    ----------
    size : number of states: positions and velocities (3N each), integrals (m), and the states after them
    velocity : (N,) of the velocities [m/s], by `tolerance_of_velocity`
    distances : (m,) of the edges [m]
    large : whether the formation is solved for as a large one
    """
    n, m = len(velocity), len(distances)
    atol = np.full(size, options.atol)
    atol[3 * n : 6 * n].reshape(n, 3)[:] = velocity[:, None]
    if options.atol_integral is not None:
        atol[6 * n : 6 * n + m] = options.atol_integral
    elif large:
        atol[6 * n : 6 * n + m] = options.atol + options.rtol * distances
    if options.atol_attitude is not None:
        atol[6 * n + m : 6 * n + m + 4] = options.atol_attitude
    return atol


def tolerance_of_velocity(
    options: IntegratorOptions, r: Floats, masses: Floats, beta: float, *, large: bool
) -> Floats:
    """Absolute tolerance (N,) of velocities [m/s] of agents at r (N, 3) [m].

    The law corrects errors at the rate beta [1/s], so that a velocity error causes a position error of 1/beta times
    its size. In large formations, unless given, the tolerance is therefore beta times that of the agent's position
    about the CM.
    """
    if options.atol_velocity is not None or not large:
        return np.full(len(r), options.atol_velocity or options.atol)
    away = np.linalg.norm(about_cm(r, masses), axis=1)
    return np.maximum(options.atol, beta * (options.atol + options.rtol * away))
