"""Where each kind of phase leads the virtual body, and how it goes there: all that planning knows of kinds.

A kind of phase that neither stays nor flies by the regulators of [lqr] has a function in `_COURSES`, and a flight of
its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from rigidfleet.kernel.problem import Motion
from rigidfleet.math import attitude as att
from rigidfleet.math import lqr
from rigidfleet.mission import Fly, Mission, Phase, Regulator
from rigidfleet.mission.schema import Steering
from rigidfleet.planning.reference import PhaseState, Pose
from rigidfleet.typing import Floats

#: A phase that ends by settling and steers nowhere brings the body to rest within this time [s].
_REST_WITHIN = 10.0


class Flight(Protocol):
    """How the virtual body goes through a phase: its CM, and its attitude as a rotation vector phi from ``T1``.

    The attitude is T = Exp(phi)^T T1, as in `Motion`.
    """

    T1: Floats  # (3, 3), world to body

    def motion(self) -> Motion:
        """The reference motion of the phase, for the kernel."""
        ...

    def sample(self, time: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """CM and phi (K, 3) at mission times (K,) [s], and their rates (3,) at the last of them."""
        ...


class Course(NamedTuple):
    """Where a phase leads the virtual body."""

    goal: Pose | None  # where it is to be; None where nothing is attached yet
    arrival: float  # when [s]
    flight: Flight | None  # how it goes there; None where nothing leads it


def course(mission: Mission, phase: Phase, now: PhaseState, t_end: float) -> Course:
    """Where a phase leads the virtual body from a state to which it is attached, if it ends at ``t_end`` [s]."""
    return _COURSES.get(phase.kind, _stay)(mission, phase, now, t_end)


def _stay(mission: Mission, phase: Phase, now: PhaseState, t_end: float) -> Course:
    """To rest at the goal before; by the end, if that is known, as nothing says when."""
    arrival = t_end if phase.settle is None else min(t_end, now.t + _REST_WITHIN)
    if now.goal is None:
        return Course(None, t_end, None)
    goal = replace(now.goal, v=np.zeros(3), omega=np.zeros(3))
    return _regulated(mission, phase, now, goal, arrival, t_end)


def _steer(mission: Mission, phase: Steering, now: PhaseState, t_end: float) -> Course:
    """To a waypoint or an attitude, after ``travel`` or by the end."""
    assert now.goal is not None  # somebody steers
    arrival = t_end if phase.travel is None else now.t + phase.travel
    angles = phase.attitude_deg
    T = now.goal.T if angles is None else att.dcm_from_euler(np.deg2rad(angles))
    named = now.goal.named or angles is not None
    r, v = now.goal.r, np.zeros(3)
    if isinstance(phase, Fly):
        r, v = np.array(phase.position), np.array(phase.velocity)
    goal = Pose(r, v, T, np.deg2rad(phase.rates_deg_s), named)
    return _regulated(mission, phase, now, goal, arrival, t_end)


def _regulated(
    mission: Mission,
    phase: Phase | Steering,
    now: PhaseState,
    goal: Pose,
    arrival: float,
    t_end: float,
) -> Course:
    if phase.control == "open" or now.pose is None:
        return Course(goal, arrival, None)
    return Course(goal, arrival, regulated(mission, now.pose, goal, now.t, arrival, t_end))


#: What leads the virtual body in a phase of each kind; in all others it comes to rest at the goal before.
_COURSES: dict[str, Callable[[Mission, Any, PhaseState, float], Course]] = {
    "fly": _steer,
    "turn": _steer,
}


@dataclass
class RegulatedFlight:
    """LQR of the virtual body from one pose to another, and the tracking gains from arrival to the phase's end.

    Without those, what the finite horizon has left of the velocity's error would carry the body away. The attitude is
    regulated as the rotation vector phi from the goal to the body: three more double integrators, phi'' their input,
    exact for a turn about one axis.
    """

    regulators: tuple[Regulator, Regulator]
    tracking: tuple[Any, float]  # Q, R
    begin: tuple[tuple[Floats, Floats], tuple[Floats, Floats]]  # (r, v), (phi, phi_dot)
    end: tuple[tuple[Floats, Floats], tuple[Floats, Floats]]
    T1: Floats
    t0: float  # [s]
    arrival: float  # [s]
    t_end: float  # [s]

    def motion(self) -> Motion:
        """Quintics between knots that are close enough for the regulators."""
        T, rest = self.arrival - self.t0, self.t_end - self.arrival
        times = np.unique(np.concatenate([_knots(law, T) for law in self.regulators]))
        after = lqr.knots(rest, *self.tracking) if rest > 0.0 else np.zeros(1)
        pieces = []
        for k in range(2):
            x = self._under_way(k, times)
            piece = lqr.quintic_pieces(times, *x)
            if rest > 0.0:
                x = self._after(k, (x[0][-1], x[1][-1]), rest, after)
                piece = np.concatenate([piece, lqr.quintic_pieces(after, *x)])
            pieces.append(piece)
        knots = np.concatenate([self.t0 + times, self.arrival + after[1:]])
        return as_motion(knots, np.concatenate(pieces, axis=1), self.T1)

    def sample(self, time: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """As `Flight.sample`."""
        T, rest = self.arrival - self.t0, float(time[-1]) - self.arrival
        under_way = time <= self.arrival
        found = []
        for k in range(2):
            x, rate, _ = self._under_way(k, np.append(time[under_way] - self.t0, T))
            x_end = (x[-1], rate[-1])
            x = x[:-1]
            if rest > 0.0 and not under_way.all():
                after = self._after(k, x_end, rest, time[~under_way] - self.arrival)
                x, rate = np.concatenate([x, after[0]]), after[1]
            found.append((x, rate[-1]))
        (r, v), (phi, phi_dot) = found
        return r, phi, v, phi_dot

    def _under_way(self, k: int, times: Floats) -> tuple[Floats, Floats, Floats]:
        """Place, rate and second derivative (K, 3) of CM (0) or phi (1) at times (K,) [s] from the start."""
        law, T = self.regulators[k], self.arrival - self.t0
        begin, end = self.begin[k], self.end[k]
        if law.horizon == "finite":
            return lqr.finite_horizon_trajectory(times, begin, end, T, law.Q, law.R, law.S)
        return lqr.infinite_horizon_trajectory(times, begin, end, T, law.Q, law.R)

    def _after(
        self, k: int, state: tuple[Floats, Floats], rest: float, times: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """The same at times (K,) in [0, rest] after arrival in a state."""
        r, v = self.end[k]
        target = (r + v * rest, v)
        return lqr.infinite_horizon_trajectory(times, state, target, rest, *self.tracking)


def regulated(
    mission: Mission, start: Pose, goal: Pose, t0: float, arrival: float, t_end: float
) -> RegulatedFlight:
    """The regulators' flight from one pose at ``t0`` [s] to another, and on to the phase's end."""
    phi = att.rotation_vector_from_dcm(start.T @ goal.T.T)  # start = goal Exp(phi)
    phi_dot = att.rotation_vector_rate(phi, start.omega)
    return RegulatedFlight(
        (mission.lqr, mission.lqr.attitude),
        (mission.tracking.Q, mission.tracking.R),
        ((start.r, start.v), (phi, phi_dot)),
        ((goal.r, goal.v), (np.zeros(3), goal.omega)),
        goal.T,
        t0,
        arrival,
        t_end,
    )


def as_motion(knots: Floats, coefficients: Floats, T1: Floats) -> Motion:
    """Quintics (n, 6, 6) between mission times (n + 1,) [s], for the kernel.

    Another layout of an array would be another type, and compile the kernel once more.
    """
    return Motion(knots, np.ascontiguousarray(coefficients), np.ascontiguousarray(T1))


def _knots(law: Regulator, T: float) -> Floats:
    return lqr.knots(T, law.Q, law.R, law.S if law.horizon == "finite" else None)
