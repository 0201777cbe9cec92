"""Motions of the virtual body: regulated, stopping, smooth, along an orbit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from rigidfleet.kernel.problem import Motion
from rigidfleet.math import attitude as att
from rigidfleet.math import lqr, series, splines
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.mission.kinds import Orbit, Through, seconds
from rigidfleet.mission.schema import Lqr, Tracking
from rigidfleet.planning.derivatives import blend_taylor
from rigidfleet.planning.reference import Pose
from rigidfleet.typing import Floats

#: Angle of an orbit [rad], and share of its run-in, spanned by one quintic; exact to 2e-11 of the radius.
_ARC, _SHARE = 0.1, 1 / 64
#: Greatest initial rate of an orbit, as a multiple of its final rate.
_FASTEST = 10.0


def regulated_motion(
    laws: Lqr, tracking: Tracking, start: Pose, goal: Pose, t0: float, arrival: float, t_end: float
) -> Motion:
    """LQR of the virtual body from one pose to another, and the tracking gains from arrival to the phase's end.

    Without tracking gains, the velocity error that the finite horizon leaves would carry the body away. The attitude
    is regulated as the rotation vector phi from the goal to the body. This gives three more double integrators with
    input phi'', which is exact for a rotation about one axis.

    Quintics between knots that are dense enough for the regulators are linear in the errors at the start, and in the
    goal, which goes on with its velocity.
    """
    phi = att.single_rotation_vector(start.T @ goal.T.T)  # start = goal Exp(phi)
    length = arrival - t0
    times, responses = _lqr_pieces(laws, tracking, length, t_end - arrival)
    x = *start.r.tolist(), *phi
    v = *start.v.tolist(), *att.single_rotation_vector_rate(*phi, *start.omega.tolist())
    x1, v1 = (*goal.r.tolist(), 0.0, 0.0, 0.0), (*goal.v.tolist(), *goal.omega.tolist())
    each = zip(x, v, x1, v1, strict=True)
    ends = [part for a, b, c, d in each for part in (a - c + length * d, b - d, c, d)]
    pieces = np.array(ends).reshape(2, 3, 4) @ responses
    pieces = pieces.reshape(6, len(times) - 1, 6).swapaxes(0, 1)
    return as_motion(t0 + times, pieces, goal.T)


# The same in every run of a sweep: three fifths of a run of narrow-passage.
@lru_cache(256)
def _lqr_pieces(laws: Lqr, tracking: Tracking, length: float, rest: float) -> tuple[Floats, Floats]:
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
    zero, by_law = np.zeros((2, 2)), []
    for law in regulators:
        response = lqr.double_integrator_response(times, length, *law)
        x = lqr.trajectory_of_response(response, times, np.eye(2), zero, length)
        pieces = [lqr.quintic_pieces(times, *x)]
        if rest > 0.0:
            response = lqr.double_integrator_response(after, rest, *hold, None)
            x = lqr.trajectory_of_response(response, after, (x[0][-1], x[1][-1]), zero, rest)
            pieces.append(lqr.quintic_pieces(after, *x))
        by_law.append(np.concatenate(pieces))
    knots = np.concatenate([times, length + after[1:]])
    quintics = np.zeros((2, 4, len(knots) - 1, 6))
    quintics[:, :2] = np.stack(by_law).swapaxes(1, 2)
    quintics[:, 2, :, 0] = quintics[:, 3, :, 1] = 1.0
    quintics[:, 3, :, 0] = knots[:-1] - length
    return knots, quintics.reshape(2, 4, -1)


def stopping_motion(start: Pose, t0: float, arrival: float) -> Motion:
    """From a pose to rest with continuous acceleration and jerk, in one piece of degree 6; the pose decides where."""
    cm = np.stack([start.r, start.v, start.a, start.jerk])
    begin = np.concatenate([cm, pose_turn_from(start, start.T)], axis=1)
    piece = splines.stopping_piece(arrival - t0, begin)
    return as_motion(np.array([t0, arrival]), piece, start.T)


def smooth_motion(
    start: Pose, goal: Pose, t0: float, arrival: float, through: Sequence[Through] = ()
) -> Motion:
    """From one pose to another with continuous acceleration and jerk, through points if there are any.

    Between two states, CM and phi are polynomials of degree 7; through points, the CM has the least snap. It begins
    with velocity, acceleration and jerk of its start, and arrives with the velocity of its goal, unaccelerated. A
    velocity of NaN is free: the one with the least snap. After the arrival it continues with this velocity. Its knots
    are the times at which it passes the points; where they have none, those with the least snap.
    """
    total, zero = arrival - t0, np.zeros(3)
    points = np.array([start.r, *(at.position for at in through), goal.r])
    begin, end = np.stack([start.v, start.a, start.jerk]), np.stack([goal.v, zero, zero])
    meets = points, begin, end, *(np.array(at.velocity or zero * np.nan) for at in through)
    times = np.array([0.0, *(at.time or np.nan for at in through), total])
    if np.isnan(times).any():
        times = splines.least_snap_knot_times(total, *meets)
    phi = np.stack([pose_turn_from(start, goal.T), np.stack([zero, goal.omega, zero, zero])], 1)
    turn = Piecewise.hermite(times[[0, -1]], phi).with_knots(times).pieces
    cm = splines.minimum_snap(times, *meets)
    return as_motion(t0 + times, np.concatenate([cm, turn], axis=1), goal.T)


def points_passed(through: Sequence[Through], motion: Motion) -> tuple[dict[str, Any], ...]:
    """The points that a smooth motion passes, as a result records them (`result.phases.Passed`)."""
    times = motion.knots[1:-1].tolist() if through else []
    points = [at.model_dump(mode="json", exclude_none=True) for at in through]
    return tuple(at | {"time": t} for at, t in zip(points, times, strict=True))


def pose_turn_from(pose: Pose, T1: Floats) -> Floats:
    """Rotation vector phi [rad] from an attitude T1 (3, 3) to that of a pose, and three derivatives (4, 3).

    Exp(phi) = T1 T^T, differentiated by the pose's body rates.
    """
    omega = series.series_by_derivatives(np.stack([pose.omega, pose.alpha, pose.alpha_dot]))
    R = series.rotation_series_from_rates(pose.T.T, omega)
    return series.taylor_derivatives(series.rotation_vector_taylor(T1 @ R))


def orbit_motion(
    phase: Orbit, start: Pose, attitude: Floats, t0: float, t_end: float, *, smooth: bool = False
) -> Motion:
    """A run-in from a pose onto a level circle in an ``attitude`` (3, 3), or turning from it, and the circle.

    Over the run-in the septic blend s leads radius and height, and the rate of the angle, to those of the circle. The
    polar motion begins with as much of the body's velocity as it can take without a large rate near the centre. The
    rest of the velocity adds a displacement by h = t (1 - s), which begins with rate 1 and fades. Position and velocity
    are continuous, and after the run-in the circle is exact. In the same way, phi (relative to the attitude to keep)
    goes from its initial value to zero, or to the rotation that follows the orbit. In a smooth mission, displacements
    by t^2 (1 - s) / 2 and t^3 (1 - s) / 6 add the rest of acceleration and jerk, which are then continuous, too.

    Polynomials lead through the run-in, and through equal arcs of the circle; in a smooth mission of degree 7.
    """
    centre, rate = np.array(phase.centre), float(np.deg2rad(phase.rate_deg_s))
    x, y, z = (start.r - centre).tolist()
    rho0 = float(np.hypot(x, y))
    # v_t / rho outside the circle, and less inside it, since v_t / rho has no bound there.
    first = float(x * start.v[1] - y * start.v[0]) / max(rho0, phase.radius) ** 2
    first = float(np.clip(first, -_FASTEST * abs(rate), _FASTEST * abs(rate)))
    phi = att.rotation_vector_from_dcm(start.T @ attitude.T)
    axis = attitude[:, 2] * phase.turns_away
    blend, angle = seconds(phase.blend), float(np.arctan2(y, x))

    def states(tau: Floats, carried: Floats) -> Floats:
        """CM and phi (K, 6) at times (K,) [s] from the start, and three derivatives, with what is ``carried``."""
        s = blend_taylor(tau, 0.0, blend)[:4]
        left, rho, turned = -s, (phase.radius - rho0) * s, np.zeros_like(s)
        left[0] += 1.0
        rho[0] += rho0
        turned[1:] = (rate - first) * s[:3] / np.arange(1.0, 4.0)[:, None]
        turned[1] += first
        u = np.clip(tau / blend, 0.0, 1.0)
        swept = blend * u**5 * (7.0 - u * (14.0 - u * (10.0 - 2.5 * u))) + np.maximum(
            tau - blend, 0.0
        )
        turned[0] = first * tau + (rate - first) * swept
        out = [np.exp(1j * (angle + turned[0]))]
        for k in range(1, 4):  # exp(i angle)' = i angle' exp(i angle)
            out.append(1j * sum(j * turned[j] * out[k - j] for j in range(1, k + 1)) / k)
        plane = series.product(rho, np.stack(out))
        cm = np.stack([plane.real, plane.imag, z * left], axis=2)
        cm[0] += centre
        x = np.concatenate([cm, left[..., None] * phi + turned[..., None] * axis], axis=2)
        for order, rest in enumerate(carried, start=1):
            power = np.zeros_like(s)  # tau^order / order!
            for j in range(order + 1):
                power[j] = tau ** (order - j) / math.factorial(order - j) / math.factorial(j)
            x += series.product(power, left)[..., None] * rest
        return series.taylor_derivatives(x)

    carried = np.concatenate([start.v, att.rotation_vector_rate(phi, start.omega) - first * axis])
    carried[:2] -= first * np.array([-y, x])
    lacking = carried[None]
    if smooth:
        cm = np.stack([start.v, start.a, start.jerk])
        full = np.concatenate([cm, pose_turn_from(start, attitude)[1:]], axis=1)
        lacking = full - states(np.zeros(1), np.zeros((0, 6)))[1:, 0]
    length, fastest = t_end - t0, max(abs(first), abs(rate))
    run_in = min(blend, length)
    times = np.linspace(0.0, run_in, int(np.ceil(max(1 / _SHARE, fastest * run_in / _ARC))) + 1)
    if length > run_in:
        arcs = max(1, int(np.ceil(abs(rate) * (length - run_in) / _ARC)))
        times = np.concatenate([times, np.linspace(run_in, length, arcs + 1)[1:]])
    x_of_t = states(times, lacking)[: 4 if smooth else 3]
    return as_motion(t0 + times, Piecewise.hermite(times, x_of_t).pieces, attitude)


def as_motion(knots: Floats, coefficients: Floats, T1: Floats) -> Motion:
    """Polynomials (n, 6, P) between mission times (n + 1,) [s], for the kernel.

    An array of another memory layout has another type, and would compile the kernel again.
    """
    return Motion(knots, np.ascontiguousarray(coefficients), np.ascontiguousarray(T1))
