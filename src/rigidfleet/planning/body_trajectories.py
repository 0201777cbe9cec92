"""Trajectories of the virtual body: regulated, stopping, smooth, given by others, along an orbit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from rigidfleet._common.kept import kept
from rigidfleet.kernel.problem import Motion, septic_polynomial
from rigidfleet.math import attitude as att
from rigidfleet.math import lqr, series, splines
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.mission.kinds import Orbit, Through, seconds
from rigidfleet.mission.schema import Lqr, Tracking
from rigidfleet.planning.reference import Pose, changed
from rigidfleet.typing import Floats

#: Angle of an orbit [rad], and share of its run-in, spanned by one quintic; exact to 2e-11 of the radius.
_ARC, _SHARE = 0.1, 1 / 64
#: Greatest initial rate of an orbit, as a multiple of its final rate.
_FASTEST = 10.0


class BodyTrajectory(Protocol):
    """Trajectory of the virtual body through a phase: its CM and its attitude."""

    def motion(self) -> Motion:
        """The reference motion of the phase, for the kernel."""
        ...


@dataclass
class RegulatedTrajectory:
    """LQR of the virtual body from one pose to another, and the tracking gains from arrival to the phase's end.

    Without tracking gains, the velocity error that the finite horizon leaves would carry the body away. The attitude
    is regulated as the rotation vector phi from the goal to the body. This gives three more double integrators with
    input phi'', which is exact for a rotation about one axis.
    """

    lqr: Lqr
    tracking: Tracking
    start: Pose
    goal: Pose
    t0: float  # [s]
    arrival: float  # [s]
    t_end: float  # [s]

    def motion(self) -> Motion:
        """Quintics between knots that are dense enough for the regulators.

        They are linear in the errors at the start, and in the goal, which goes on with its velocity.
        """
        start, goal = self.start, self.goal
        phi = att.vector_of(start.T @ goal.T.T)  # start = goal Exp(phi)
        length, rest = self.arrival - self.t0, self.t_end - self.arrival
        times, responses = _responses(self.lqr, self.tracking, length, rest)
        x = *start.r.tolist(), *phi
        v = *start.v.tolist(), *att.vector_rate(*phi, *start.omega.tolist())
        x1, v1 = (*goal.r.tolist(), 0.0, 0.0, 0.0), (*goal.v.tolist(), *goal.omega.tolist())
        each = zip(x, v, x1, v1, strict=True)
        ends = [part for a, b, c, d in each for part in (a - c + length * d, b - d, c, d)]
        pieces = np.array(ends).reshape(2, 3, 4) @ responses
        pieces = pieces.reshape(6, len(times) - 1, 6).swapaxes(0, 1)
        return as_motion(self.t0 + times, pieces, goal.T)


@kept
def _responses(laws: Lqr, tracking: Tracking, length: float, rest: float) -> tuple[Floats, Floats]:
    """Knots (n + 1,) [s] of a way and of the rest after it, and quintics (2, 4, n * 6) between them.

    For either regulator, and then the tracking gains, they are those from an error in position of 1 at the start, from
    one in velocity, and those of a goal at 1, and of one with a velocity of 1 that is at 0 on arrival.
    """
    regulators = [
        (law.Q, law.R, law.S if law.horizon == "finite" else None) for law in (laws, laws.attitude)
    ]
    hold = tracking.Q, tracking.R
    times = np.unique(np.concatenate([lqr.knots(length, *law) for law in regulators]))
    after = lqr.knots(rest, *hold) if rest > 0.0 else np.zeros(1)
    zero, found = np.zeros((2, 2)), []
    for law in regulators:
        response = lqr.double_integrator_response(times, length, *law)
        x = lqr.led(response, times, np.eye(2), zero, length)
        pieces = [lqr.quintic_pieces(times, *x)]
        if rest > 0.0:
            response = lqr.double_integrator_response(after, rest, *hold, None)
            x = lqr.led(response, after, (x[0][-1], x[1][-1]), zero, rest)
            pieces.append(lqr.quintic_pieces(after, *x))
        found.append(np.concatenate(pieces))
    knots = np.concatenate([times, length + after[1:]])
    quintics = np.zeros((2, 4, len(knots) - 1, 6))
    quintics[:, :2] = np.stack(found).swapaxes(1, 2)
    quintics[:, 2, :, 0] = quintics[:, 3, :, 1] = 1.0
    quintics[:, 3, :, 0] = knots[:-1] - length
    return knots, quintics.reshape(2, 4, -1)


@dataclass
class StoppingTrajectory:
    """From a pose to rest with continuous acceleration and jerk; where it stops follows from the pose."""

    start: Pose
    t0: float  # [s]
    arrival: float  # [s]

    def motion(self) -> Motion:
        """One piece, of degree 6."""
        start = self.start
        cm = np.stack([start.r, start.v, start.a, start.jerk])
        begin = np.concatenate([cm, rotation_of(start, start.T)], axis=1)
        piece = splines.stopping_piece(self.arrival - self.t0, begin)
        return as_motion(np.array([self.t0, self.arrival]), piece, start.T)


@dataclass
class SmoothTrajectory:
    """From one pose to another with continuous acceleration and jerk, through points if there are any.

    Between two states, CM and phi are polynomials of degree 7; through points, the CM has the least snap. It begins
    with velocity, acceleration and jerk of its start, and arrives with the velocity of its goal, unaccelerated. A
    velocity of NaN is free: the one with the least snap. After the arrival it continues with this velocity.
    """

    start: Pose
    goal: Pose
    t0: float  # [s]
    arrival: float  # [s]
    through: Sequence[Through]

    def motion(self) -> Motion:
        """Pieces of degree 7: one, or one to each point."""
        start, goal = self.start, self.goal
        zero, times = np.zeros(3), self.times()
        cm = splines.minimum_snap(times, *self._to_meet)
        phi = np.stack([rotation_of(start, goal.T), np.stack([zero, goal.omega, zero, zero])], 1)
        turn = Piecewise.hermite(times[[0, -1]], phi).on(times).pieces
        return as_motion(self.t0 + times, np.concatenate([cm, turn], axis=1), goal.T)

    def times(self) -> Floats:
        """Times (n + 1,) [s] from the start at which the trajectory passes its points, and arrives."""
        total = self.arrival - self.t0
        given = [at.time for at in self.through if at.time is not None]
        if len(given) == len(self.through):
            return np.array([0.0, *given, total])
        return splines.best_times(total, *self._to_meet)

    @property
    def _to_meet(self) -> tuple[Floats, ...]:
        """Points, states at the ends and velocities between them, as `splines.minimum_snap` takes them."""
        start, goal, zero = self.start, self.goal, np.zeros(3)
        points = np.array([start.r, *(at.position for at in self.through), goal.r])
        begin, end = np.stack([start.v, start.a, start.jerk]), np.stack([goal.v, zero, zero])
        return points, begin, end, *(np.array(at.velocity or zero * np.nan) for at in self.through)


@dataclass
class GivenTrajectory:
    """A way that is given."""

    found: Motion

    def motion(self) -> Motion:
        """The way itself."""
        return self.found


def passed(trajectory: BodyTrajectory | None) -> tuple[dict[str, Any], ...]:
    """The points that a trajectory passes, as a result records them (`result.phases.Passed`)."""
    if not isinstance(trajectory, SmoothTrajectory):
        return ()
    times = trajectory.t0 + trajectory.times()[1:-1]
    points = [at.model_dump(mode="json", exclude_none=True) for at in trajectory.through]
    return tuple(at | {"time": t} for at, t in zip(points, times.tolist(), strict=True))


def rotation_of(start: Pose, T1: Floats) -> Floats:
    """Rotation vector phi [rad] from an attitude T1 (3, 3) to that of a pose, and three derivatives (4, 3).

    Exp(phi) = T1 T^T, differentiated by the pose's body rates.
    """
    omega = series.from_derivatives(np.stack([start.omega, start.alpha, start.alpha_dot]))
    R = series.from_rates(start.T.T, omega)
    return series.derivatives(series.rotation_vector(T1 @ R))


@dataclass
class OrbitTrajectory:
    """A run-in from a pose onto a level circle, and the circle at a steady rate.

    Over the run-in the septic blend s leads radius and height, and the rate of the angle, to those of the circle. The
    polar motion begins with as much of the body's velocity as it can take without a large rate near the centre. The
    rest of the velocity adds a displacement by h = t (1 - s), which begins with rate 1 and fades. Position and velocity
    are continuous, and after the run-in the circle is exact. In the same way, phi (relative to the attitude to keep)
    goes from its initial value to zero, or to the rotation that follows the orbit. In a smooth mission, displacements
    by t^2 (1 - s) / 2 and t^3 (1 - s) / 6 add the rest of acceleration and jerk, which are then continuous, too.
    """

    centre: Floats  # (3,) [m]
    start: tuple[float, float, float]  # radius [m], angle [rad] and height over the centre [m]
    radius: float  # [m]
    rates: tuple[float, float]  # at the start and on the circle [rad/s]
    carried: Floats  # (1 or 3, 6) initial velocity, acceleration and jerk of CM and phi that the polar motion lacks
    phi: Floats  # (3,) at the start [rad]
    axis: Floats  # (3,) axis about which the body turns with the orbit, in axes of T1; zero if it does not
    T1: Floats
    blend: float  # [s]
    t0: float  # [s]
    t_end: float  # [s]

    def motion(self) -> Motion:
        """Polynomials through the run-in, and through equal arcs of the circle; in a smooth mission of degree 7."""
        length, fastest = self.t_end - self.t0, max(map(abs, self.rates))
        run_in = min(self.blend, length)
        parts = max(1 / _SHARE, fastest * run_in / _ARC)
        times = np.linspace(0.0, run_in, int(np.ceil(parts)) + 1)
        if length > run_in:
            arcs = max(1, int(np.ceil(abs(self.rates[1]) * (length - run_in) / _ARC)))
            times = np.concatenate([times, np.linspace(run_in, length, arcs + 1)[1:]])
        x = self.at(times)
        smooth = len(self.carried) > 1
        pieces = (
            Piecewise.hermite(times, np.stack(x)).pieces
            if smooth
            else lqr.quintic_pieces(times, *x[:3])
        )
        return as_motion(self.t0 + times, pieces, self.T1)

    def at(self, tau: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """CM and phi (K, 6) at times (K,) [s] from the start, and three derivatives."""
        T = self.blend
        x = np.clip(tau / T, 0.0, 1.0)
        s, swept = septic_polynomial(x), x**5 * (7.0 - x * (14.0 - x * (10.0 - 2.5 * x)))
        ds, dds = 140.0 * (x * (1 - x)) ** 3 / T, 420.0 * (x * (1 - x)) ** 2 * (1 - 2 * x) / T**2
        ddds = 840.0 * x * (1 - x) * (1 - 5 * x * (1 - x)) / T**3
        # The angle from the start, by the integral of s.
        first, change = self.rates[0], self.rates[1] - self.rates[0]
        turned = first * tau + change * (T * swept + np.maximum(tau - T, 0.0))
        w, dw, ddw = first + change * s, change * ds, change * dds
        rho0, angle, z = self.start
        rho, drho, ddrho, dddrho = (
            rho0 + (self.radius - rho0) * s,
            *((self.radius - rho0) * np.array([ds, dds, ddds])),
        )
        out = np.exp(1j * (angle + turned))
        # Radial and transverse acceleration, and their rates.
        a, b = ddrho - rho * w**2, 2.0 * drho * w + rho * dw
        da = dddrho - drho * w**2 - 2.0 * rho * w * dw
        db = 2.0 * ddrho * w + 3.0 * drho * dw + rho * ddw
        plane = [
            rho * out,
            (drho + 1j * rho * w) * out,
            (a + 1j * b) * out,
            (da - w * b + 1j * (db + w * a)) * out,
        ]
        found = []
        for k, (left, spin) in enumerate([(1.0 - s, turned), (-ds, w), (-dds, dw), (-ddds, ddw)]):
            xy = plane[k]
            cm = np.stack([xy.real, xy.imag, z * left], axis=1)
            cm = cm + self.centre if k == 0 else cm
            phi = np.outer(left, self.phi) + np.outer(spin, self.axis)
            found.append(np.concatenate([cm, phi], axis=1))
        fades = [1.0 - s, -ds, -dds, -ddds]
        for order, rest in enumerate(self.carried, start=1):  # tau^order (1 - s) / order!
            for k in range(4):  # by Leibniz' rule
                h = sum(
                    math.comb(k, j) * tau ** (order - j) / math.factorial(order - j) * fades[k - j]
                    for j in range(min(k, order) + 1)
                )
                found[k] = found[k] + np.outer(h, rest)
        place, rate, second, third = found
        return place, rate, second, third


def orbit(
    phase: Orbit, start: Pose, attitude: Floats, t0: float, t_end: float, *, smooth: bool = False
) -> OrbitTrajectory:
    """The trajectory of an orbit from a pose at ``t0`` [s], in an ``attitude`` (3, 3) or turning from it."""
    centre, rate = np.array(phase.centre), float(np.deg2rad(phase.rate_deg_s))
    x, y, z = (start.r - centre).tolist()
    rho = float(np.hypot(x, y))
    # v_t / rho outside the circle, and less inside it, since v_t / rho has no bound there.
    first = float(x * start.v[1] - y * start.v[0]) / max(rho, phase.radius) ** 2
    first = float(np.clip(first, -_FASTEST * abs(rate), _FASTEST * abs(rate)))
    phi = att.rotation_vector_from_dcm(start.T @ attitude.T)
    axis = attitude[:, 2] * phase.turns_away
    carried = np.concatenate([start.v, att.rotation_vector_rate(phi, start.omega) - first * axis])
    carried[:2] -= first * np.array([-y, x])
    trajectory = OrbitTrajectory(
        centre, (rho, float(np.arctan2(y, x)), z), phase.radius, (first, rate), carried[None], phi, axis,
        attitude, seconds(phase.blend), t0, t_end,
    )  # fmt: skip
    if smooth:
        polar = changed(trajectory, carried=np.zeros((0, 6))).at(np.zeros(1))
        cm = np.stack([start.v, start.a, start.jerk])
        full = np.concatenate([cm, rotation_of(start, attitude)[1:]], axis=1)
        trajectory.carried = full - np.stack(polar[1:])[:, 0]
    return trajectory


def as_motion(knots: Floats, coefficients: Floats, T1: Floats) -> Motion:
    """Polynomials (n, 6, P) between mission times (n + 1,) [s], for the kernel.

    An array of another memory layout has another type, and would compile the kernel again.
    """
    return Motion(knots, np.ascontiguousarray(coefficients), np.ascontiguousarray(T1))
