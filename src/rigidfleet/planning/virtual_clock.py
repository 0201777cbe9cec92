"""The virtual clock: a path is flown at the time tau, with 0 <= dtau/dt <= 1, so that a formation can wait on it.

The path is the one planned, and the time along it is chosen in flight: the decomposition of Kant and Zucker (*Toward
efficient trajectory planning: the path-velocity decomposition*, International Journal of Robotics Research 5, 1986).
The rate s = dtau/dt follows a target u in [0, 1] through three equal lags,

    (d/dt / omega + 1)^3 s = u.

They weight past targets by a positive kernel of integral 1, so that s stays between 0 and 1 whatever the targets. Its
first two derivatives are continuous and the third is bounded, as snap of the path needs. By the chain rule, the path
r(tau) is flown with the velocity r' s and the acceleration r'' s^2 + r' ds/dt; the greatest |ds/dt| after a step is
2 omega / e^2.
"""

from __future__ import annotations

import math

import numpy as np

from rigidfleet.kernel.problem import Problem
from rigidfleet.typing import Floats

#: Greatest |ds/dt| after a step of the target, over omega.
STEEPEST = 2.0 * math.exp(-2.0)
#: Least and greatest omega [1/s]: the clock stops within 3 / omega seconds of path.
_SLOWEST, _FASTEST = 0.5, 4.0
#: Difference of the rate from its target, and its derivatives over powers of omega, that count as none.
_STEADY = 1e-6


class VirtualClock:
    """A clock that falls behind: its delay t - tau [s], its rate and two derivatives, and what leads it."""

    def __init__(self) -> None:
        self.delay = 0.0  # [s] in this phase
        self.rate = (1.0, 0.0, 0.0)  # s, its derivatives [1/s, 1/s^2]
        self.omega = _FASTEST
        self.target = 1.0

    @property
    def is_steady(self) -> bool:
        """Whether the rate is its target, to rounding."""
        s, first, second = self.rate
        off = max(abs(s - self.target), abs(first) / self.omega, abs(second) / self.omega**2)
        return off <= _STEADY

    @property
    def has_unit_rate(self) -> bool:
        """Whether it runs as real time does."""
        return self.target == 1.0 and self.rate == (1.0, 0.0, 0.0)

    def set_aim(self, target: float, omega: float) -> None:
        """Set the target, and while the clock is steady also the bandwidth omega [1/s]."""
        if self.is_steady:
            self.rate = self.target, 0.0, 0.0
            self.omega = min(max(omega, _SLOWEST), _FASTEST)
        self.target = target

    def progress_in(self, dt: Floats | float, target: float | None = None) -> Floats:
        """Progress of tau [s], s and two derivatives (4, ...) after times dt [s], with a target held from now.

        For three equal lags, s - u = exp(-omega t) (A + B t + C t^2 / 2).
        """
        u, k = self.target if target is None else target, self.omega
        t = np.asarray(dt, dtype=float)
        s, first, second = self.rate
        A = s - u
        B = first + k * A
        C = second + 2.0 * k * B - k * k * A
        E = np.exp(-k * t)
        p, slope = A + B * t + 0.5 * C * t * t, B + C * t
        whole = A / k + B / k**2 + C / k**3 - E * (p / k + slope / k**2 + C / k**3)
        return np.array(
            [
                u * t + whole, u + E * p, E * (slope - k * p), E * (C - 2.0 * k * slope + k * k * p)
            ]
        )  # fmt: skip

    def advance_and_count_delay(self, dt: float) -> float:
        """Run for dt [s]; returns by how much the delay has grown [s]."""
        if self.has_unit_rate:
            return 0.0
        progress, s, first, second = self.progress_in(dt).tolist()
        self.rate = min(max(s, 0.0), 1.0), first, second
        if self.is_steady:
            self.rate = self.target, 0.0, 0.0
        lost = max(dt - progress, 0.0)
        self.delay += lost
        return lost

    def time_until_progress(self, progress: float, most: float) -> float:
        """Time [s], at most ``most``, after which tau will have made a progress [s]."""
        low, high = 0.0, most
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.progress_in(middle)[0] < progress else (low, middle)
        return high


def postpone(problem: Problem, delay: float) -> Problem:
    """A problem whose references come later by a delay [s]."""
    reference, motion = problem.reference, problem.motion
    return problem._replace(
        motion=motion._replace(knots=motion.knots + delay),
        reference=reference._replace(t0=reference.t0 + delay, knots=reference.knots + delay),
    )


def time_derivatives(x: Floats, rate: Floats) -> Floats:
    """Value and two derivatives over t (3, ..., K), of those over tau (3, ..., K), for s and its derivative (2, K)."""
    s, first = rate
    return np.array([x[0], s * x[1], s * s * x[2] + first * x[1]])
