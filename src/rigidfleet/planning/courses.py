"""Where each kind of phase leads the virtual body, and how it goes there: all that planning knows of kinds.

A kind of phase that neither stays nor flies by the regulators of [lqr] has a function in `_COURSES`, and a flight of
its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from rigidfleet.kernel.problem import Motion, septic_polynomial
from rigidfleet.math import attitude as att
from rigidfleet.math import lqr
from rigidfleet.mission import Fly, Mission, Phase, Regulator
from rigidfleet.mission.schema import Orbit, Steering
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


def _orbit(mission: Mission, phase: Orbit, now: PhaseState, t_end: float) -> Course:
    """Round a circle, and on with the velocity there. An attitude that turns along is none asked for by name."""
    assert now.pose is not None  # slots are tracked
    assert now.goal is not None
    flight = orbit(phase, now.pose, now.goal.T, now.t, t_end)
    x, rate = (y[0] for y in flight.at(np.array([t_end - now.t]))[:2])
    T = att.dcm_from_rotation_vector(x[3:]) @ flight.T1
    goal = Pose(x[:3], rate[:3], T, rate[3:], named=now.goal.named and not phase.turns_away)
    return Course(goal, t_end, flight)


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
    "orbit": _orbit,
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


#: Angle of an orbit [rad], and share of its run-in, that a quintic spans: it is right to 2e-11 of the radius.
_ARC, _SHARE = 0.1, 1 / 64
#: An orbit begins to turn at most so many times as fast as it will.
_FASTEST = 10.0


@dataclass
class OrbitFlight:
    """A run-in from a pose onto a level circle, and the circle at a steady rate.

    Over the run-in the septic blend s leads radius and height, and the rate of the angle, to those of the circle. The
    polar motion begins with as much of the body's velocity as it can take without a large rate near the centre. The
    rest of it carries the body off by h = t (1 - s), which begins with rate 1 and fades. Place, velocity and
    acceleration are continuous, and from the end of the run-in on the circle is exact. In the same way phi, from the
    attitude to keep, goes from what it is to nothing, or to the turn that goes with the orbit.
    """

    centre: Floats  # (3,) [m]
    start: tuple[float, float, float]  # radius [m], angle [rad] and height over the centre [m]
    radius: float  # [m]
    rates: tuple[float, float]  # at the start and on the circle [rad/s]
    carried: Floats  # (6,) velocity of CM and phi at the start that the polar motion lacks
    phi: Floats  # (3,) at the start [rad]
    axis: Floats  # (3,) about which the body turns along, in axes of T1; zero if it does not
    T1: Floats
    blend: float  # [s]
    t0: float  # [s]
    t_end: float  # [s]

    def motion(self) -> Motion:
        """Quintics through the run-in, and through equal arcs of the circle."""
        length, fastest = self.t_end - self.t0, max(map(abs, self.rates))
        run_in = min(self.blend, length)
        parts = max(1 / _SHARE, fastest * run_in / _ARC)
        times = np.linspace(0.0, run_in, int(np.ceil(parts)) + 1)
        if length > run_in:
            arcs = max(1, int(np.ceil(abs(self.rates[1]) * (length - run_in) / _ARC)))
            times = np.concatenate([times, np.linspace(run_in, length, arcs + 1)[1:]])
        return as_motion(self.t0 + times, lqr.quintic_pieces(times, *self.at(times)), self.T1)

    def sample(self, time: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """As `Flight.sample`."""
        x, rate, _ = self.at(time - self.t0)
        return x[:, :3], x[:, 3:], rate[-1, :3], rate[-1, 3:]

    def at(self, tau: Floats) -> tuple[Floats, Floats, Floats]:
        """CM and phi (K, 6) at times (K,) [s] from the start, and two derivatives."""
        T = self.blend
        x = np.clip(tau / T, 0.0, 1.0)
        s, swept = septic_polynomial(x), x**5 * (7.0 - x * (14.0 - x * (10.0 - 2.5 * x)))
        ds, dds = 140.0 * (x * (1 - x)) ** 3 / T, 420.0 * (x * (1 - x)) ** 2 * (1 - 2 * x) / T**2
        carried = [tau * (1.0 - s), 1.0 - s - tau * ds, -2.0 * ds - tau * dds]
        # The angle from the start, by the integral of s.
        first, change = self.rates[0], self.rates[1] - self.rates[0]
        turned = first * tau + change * (T * swept + np.maximum(tau - T, 0.0))
        w, dw = first + change * s, change * ds
        rho0, angle, z = self.start
        rho, drho, ddrho = (
            rho0 + (self.radius - rho0) * s,
            *((self.radius - rho0) * np.array([ds, dds])),
        )
        out = np.exp(1j * (angle + turned))
        plane = [
            rho * out,
            (drho + 1j * rho * w) * out,
            (ddrho - rho * w**2 + 1j * (2.0 * drho * w + rho * dw)) * out,
        ]
        found = []
        for k, (left, spin) in enumerate([(1.0 - s, turned), (-ds, w), (-dds, dw)]):
            xy = plane[k]
            cm = np.stack([xy.real, xy.imag, z * left], axis=1)
            cm = cm + self.centre if k == 0 else cm
            phi = np.outer(left, self.phi) + np.outer(spin, self.axis)
            found.append(np.concatenate([cm, phi], axis=1) + np.outer(carried[k], self.carried))
        place, rate, second = found
        return place, rate, second


def orbit(phase: Orbit, start: Pose, attitude: Floats, t0: float, t_end: float) -> OrbitFlight:
    """The flight of an orbit from a pose at ``t0`` [s], in an ``attitude`` (3, 3) or turning from it."""
    centre, rate = np.array(phase.centre), float(np.deg2rad(phase.rate_deg_s))
    x, y, z = (start.r - centre).tolist()
    rho = float(np.hypot(x, y))
    # v_t / rho outside of the circle, and less inside, where v_t / rho has no bound.
    first = float(x * start.v[1] - y * start.v[0]) / max(rho, phase.radius) ** 2
    first = float(np.clip(first, -_FASTEST * abs(rate), _FASTEST * abs(rate)))
    phi = att.rotation_vector_from_dcm(start.T @ attitude.T)
    axis = attitude[:, 2] * phase.turns_away
    carried = np.concatenate([start.v, att.rotation_vector_rate(phi, start.omega) - first * axis])
    carried[:2] -= first * np.array([-y, x])
    return OrbitFlight(
        centre, (rho, float(np.arctan2(y, x)), z), phase.radius, (first, rate), carried, phi, axis,
        attitude, phase.blend, t0, t_end,
    )  # fmt: skip


def as_motion(knots: Floats, coefficients: Floats, T1: Floats) -> Motion:
    """Quintics (n, 6, 6) between mission times (n + 1,) [s], for the kernel.

    Another layout of an array would be another type, and compile the kernel once more.
    """
    return Motion(knots, np.ascontiguousarray(coefficients), np.ascontiguousarray(T1))


def _knots(law: Regulator, T: float) -> Floats:
    return lqr.knots(T, law.Q, law.R, law.S if law.horizon == "finite" else None)
