"""Goal and trajectory of the virtual body for each kind of phase: all that planning knows about kinds.

A kind of phase that neither stays nor flies by the regulators of [lqr] has a function in `_COURSES`, and a flight of
its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from rigidfleet._common.kept import kept
from rigidfleet.kernel.problem import NO_KNOTS, NO_WAYS, Motion, septic_polynomial
from rigidfleet.math import attitude as att
from rigidfleet.math import lqr, series, splines
from rigidfleet.mission import Fly, Mission, Phase
from rigidfleet.mission.kinds import (
    Brake,
    Follow,
    Land,
    Orbit,
    Reshape,
    Steering,
    Takeoff,
    Through,
    Vertical,
    seconds,
)
from rigidfleet.planning.reference import PhaseState, Pose, pose_at
from rigidfleet.typing import Floats

#: Time in which a phase that ends by settling, without a target, brings the body to rest [s].
_REST_WITHIN = 10.0
#: Height above the ground at which a landing ends [m]: the vehicles' lags and noise shall not lead them into it; and
#: the speed downwards there [m/s]. Both are well within what the verdict takes as standing on the ground.
ABOVE, TOUCH_DOWN = 0.05, 0.2
#: How far the first point of given ways may be off [m, m/s, rad], and the time in which the difference fades [s].
_LED, _FADED = (0.1, 0.1, math.radians(5.0)), 1.0
#: Ways of vehicles straight up or down that differ by less count as one [m].
_LEVEL = 1e-9


class Flight(Protocol):
    """Trajectory of the virtual body through a phase: its CM and its attitude."""

    def motion(self) -> Motion:
        """The reference motion of the phase, for the kernel."""
        ...


class Course(NamedTuple):
    """Goal and trajectory of the virtual body in a phase."""

    goal: Pose | None  # pose to reach; None if no frame is attached yet
    arrival: float  # time to reach it [s]
    flight: Flight | None  # trajectory to it; None if there is none


def course(mission: Mission, phase: Phase, now: PhaseState, t_end: float) -> Course:
    """Course of the virtual body in a phase that ends at ``t_end`` [s], from a state with the frame attached."""
    return _COURSES.get(phase.kind, _stay)(mission, phase, now, t_end)


def _stay(mission: Mission, phase: Phase, now: PhaseState, t_end: float) -> Course:
    """Come to rest at the previous goal; by the end, if that is known, because no time is given."""
    arrival = t_end if phase.settle is None else min(t_end, now.t + _REST_WITHIN)
    if now.goal is None:
        return Course(None, t_end, None)
    goal = replace(now.goal, v=np.zeros(3), omega=np.zeros(3))
    return _led(mission, phase, now, goal, arrival, t_end)


def _steer(mission: Mission, phase: Steering, now: PhaseState, t_end: float) -> Course:
    """Go to a waypoint or an attitude, within ``travel`` or by the end."""
    assert now.goal is not None  # a steering phase has a goal
    arrival = t_end if phase.travel is None else now.t + seconds(phase.travel)
    angles = phase.attitude_deg
    T = now.goal.T if angles is None else att.dcm_from_euler(np.deg2rad(angles))
    named = now.goal.named or angles is not None
    r, v = now.goal.r, np.zeros(3)
    if isinstance(phase, Fly):
        r, v = np.array(phase.position), np.array(phase.velocity)
    goal = Pose(r, v, T, np.deg2rad(phase.rates_deg_s), named)
    return _led(mission, phase, now, goal, arrival, t_end)


def _orbit(mission: Mission, phase: Orbit, now: PhaseState, t_end: float) -> Course:
    """Fly a circle, and continue with its velocity. An attitude that turns along is not an explicitly specified one."""
    assert now.pose is not None  # slots are tracked
    assert now.goal is not None
    flight = orbit(phase, now.pose, now.goal.T, now.t, t_end, smooth=mission.smooth)
    x, rate, *_ = (y[0] for y in flight.at(np.array([t_end - now.t])))
    T = att.dcm_from_rotation_vector(x[3:]) @ flight.T1
    goal = Pose(x[:3], rate[:3], T, rate[3:], named=now.goal.named and not phase.turns_away)
    return Course(goal, t_end, flight)


def _brake(mission: Mission, phase: Brake, now: PhaseState, t_end: float) -> Course:
    """Come to rest within ``travel`` or by the end, from the reference as it moves now."""
    assert now.pose is not None  # slots are tracked
    assert now.goal is not None
    arrival = t_end if phase.travel is None else min(t_end, now.t + phase.travel)
    flight = StoppingFlight(now.pose, now.t, arrival)
    end = pose_at(flight.motion(), arrival)
    turned = now.pose.omega.any() or not np.allclose(now.pose.T, now.goal.T, rtol=0, atol=1e-9)
    goal = Pose(
        end.r, np.zeros(3), end.T if turned else now.goal.T, np.zeros(3), now.goal.named and not turned
    )  # fmt: skip
    return Course(goal, arrival, flight)


def _vertical(mission: Mission, phase: Vertical, now: PhaseState, t_end: float) -> Course:
    """Go straight up or down by the mean of what the vehicles do, within ``travel`` or by the end."""
    assert now.pose is not None
    assert now.goal is not None
    arrival = t_end if phase.travel is None else min(t_end, now.t + phase.travel)
    up, v = np.zeros(3), np.zeros(3)
    if phase.each:
        up[2] = mission.fleet.mass @ rises(mission, phase, now) / mission.fleet.mass.sum()
    else:
        up[2] = -max(0.0, height(mission, now))
        v[2] = -min(TOUCH_DOWN, -up[2] / (arrival - now.t))
    goal = replace(now.goal, r=now.goal.r + up, v=v, omega=np.zeros(3))
    return Course(goal, arrival, SmoothFlight(now.pose, goal, now.t, arrival, ()))


def _follow(mission: Mission, phase: Follow, now: PhaseState, t_end: float) -> Course:
    """Follow the trajectories of the virtual body, or the mean of the vehicles' own."""
    assert now.goal is not None
    flight, _ = _followed(mission, phase, now, t_end)
    end = pose_at(flight.found, t_end)
    named = now.goal.named and not phase.turns_away
    arrival = float(min(t_end, flight.found.knots[-1]))
    return Course(replace(end, named=named), arrival, flight)


def _followed(
    mission: Mission, phase: Follow, now: PhaseState, t_end: float
) -> tuple[GivenFlight, Lift | None]:
    """The way of the virtual body, and of the slots about it if each vehicle has a way of its own.

    What the first point of a file differs from the place where the vehicles are fades over `_FADED`.
    """
    assert now.pose is not None
    assert now.slots is not None
    pose, slots = now.pose, now.slots
    knots, pieces = phase.pieces
    length = t_end - now.t if phase.travel is None else phase.travel
    scale = length / knots[-1]
    knots, pieces = knots * scale, pieces * scale ** -np.arange(float(pieces.shape[-1]))
    T1 = np.eye(3) if phase.turns_away else pose.T
    begin = np.concatenate(
        [np.stack([pose.r, pose.v, pose.a, pose.jerk]), rotation_of(pose, T1)], 1
    )
    lift, fade = None, min(_FADED, float(knots[-1]))
    body = np.zeros((len(pieces), 6, pieces.shape[-1]))
    if pieces.shape[1] == 1:
        body[:, :3] = pieces[:, 0, :3]
        if phase.turns_away:
            body[:, 5] = pieces[:, 0, 3]
            body[:, 5, 0] += _whole_turns(body[0, 5, 0], begin[0, 5])
    else:
        masses = mission.fleet.mass
        body[:, :3] = np.einsum("i,kiqp->kqp", masses / masses.sum(), pieces[:, :, :3])
        ways = np.einsum("ab,kibp->kiap", pose.T, pieces[:, :, :3] - body[:, None, :3])
        start = np.zeros((4, *slots.shape))
        start[0] = slots
        at, ways = splines.begun_from(knots, ways, start, fade)
        end = series.of_polynomials(ways[-1:], np.diff(at)[-1:], 1)[0, 0]
        lift = Lift(end - slots, length, now.t + at, np.ascontiguousarray(ways))
    at, body = splines.begun_from(knots, body, begin, fade)
    return GivenFlight(as_motion(now.t + at, body, T1)), lift


def _whole_turns(yaw: float, near: float) -> float:
    """What to add to a yaw [rad] so that it is the one nearest to another."""
    return 2.0 * math.pi * round((near - yaw) / (2.0 * math.pi))


def misled(mission: Mission, phase: Phase, now: PhaseState) -> str:
    """What keeps a phase from following the ways that are given for it, from the state at its start; "" if nothing."""
    if isinstance(phase, Reshape) and phase.control_points is not None:
        first = np.array(phase.control_points[0])
        far = np.inf if now.slots is None else float(np.abs(first - now.slots).max())
        return "" if far < _LED[0] else "begins in other slots than the phase before has led to"
    if not isinstance(phase, Follow) or now.pose is None or now.slots is None:
        return ""
    pose = now.pose
    _, pieces = phase.pieces
    first = pieces[0, :, :3, :2]
    alone = pieces.shape[1] == 1
    place = pose.r[None] if alone else pose.r + now.slots @ pose.T
    speed = pose.v[None] + (0.0 if alone else np.cross(pose.omega, now.slots) @ pose.T)
    knots = phase.pieces[0]
    length = phase.travel or (phase.duration if isinstance(phase.duration, float) else knots[-1])
    off = (
        np.linalg.norm(first[..., 0] - place, axis=1),
        np.linalg.norm(first[..., 1] * (knots[-1] / length) - speed, axis=1),
    )
    for far, most, unit in zip(off, _LED, ("m", "m/s"), strict=False):
        i = int(far.argmax())
        if far[i] > most:
            who = "the virtual body" if alone else f"agent {i + 1}"
            point, here = (", ".join(f"{x:z.2f}" for x in y[i]) for y in (first[..., 0], place))
            return (
                f"its first point ({point}) m is {far[i]:.2f} {unit} from where {who} is then, ({here}) m"
                if unit == "m"
                else f"begins with a velocity {far[i]:.2f} {unit} off that of {who} (at most {most:g} {unit})"
            )
    if phase.turns_away:
        T1 = att.dcm_from_euler(np.array([0.0, 0.0, pieces[0, 0, 3, 0]]))
        angle = float(np.linalg.norm(att.rotation_vector_from_dcm(pose.T @ T1.T)))
        if angle > _LED[2]:
            return f"its first attitude, yaw {math.degrees(pieces[0, 0, 3, 0]):.1f}°, is {math.degrees(angle):.1f}° off"
    return ""


def lifted(mission: Mission, phase: Phase, now: PhaseState, t_end: float) -> Lift | None:
    """What a phase adds to the slots that leads vehicles each on a way of its own; None if it keeps the shape.

    Bent ways are given by the phase. Where a phase leads vehicles straight up or down, the virtual body goes by the
    mean (`_vertical`), from rest to rest on the same septic: together, each vehicle goes straight up or down by its own
    way, and one that stays, stays.
    """
    if isinstance(phase, Follow):
        return _followed(mission, phase, now, t_end)[1]
    if isinstance(phase, Reshape) and phase.control_points is not None:
        control = np.array(phase.control_points)
        knots, ways = splines.b_spline_pieces(control, seconds(phase.blend))
        return Lift(control[-1] - control[0], seconds(phase.blend), now.t + knots, ways, keeps=True)
    vertical = phase.vertical
    if vertical is None or not vertical.each:
        return None
    assert now.goal is not None
    up, masses = rises(mission, vertical, now), mission.fleet.mass
    if np.ptp(up) < _LEVEL:
        return None
    travel = t_end - now.t if vertical.travel is None else min(vertical.travel, t_end - now.t)
    return Lift(np.outer(up - masses @ up / masses.sum(), now.goal.T[:, 2]), travel)


class Lift(NamedTuple):
    """Ways of the slots (N, 3) about the CM, body axes [m], and the time they take [s]; if they are bent, how.

    ``knots`` and ``ways`` are those of `Reference`; ``keeps`` says whether the phase's formation is reached by them.
    """

    dp: Floats
    time: float
    knots: Floats = NO_KNOTS
    ways: Floats = NO_WAYS
    keeps: bool = False


def rises(mission: Mission, phase: Vertical, now: PhaseState) -> Floats:
    """How far [m] each vehicle (N,) goes up from the pose to hold: to a height, or (down) to just above the ground."""
    assert now.goal is not None
    assert now.slots is not None
    n = mission.n_agents
    place = now.goal.r[2] + now.slots @ now.goal.T[:, 2]
    over = phase.height if isinstance(phase, Takeoff) else ABOVE + mission.fleet.radius
    up = _ground(mission) + over - place
    if isinstance(phase, Land):
        up = np.minimum(up, 0.0)
    goes = np.ones(n, dtype=np.bool_) if not phase.agents else np.zeros(n, dtype=np.bool_)
    goes[np.array(phase.agents, dtype=np.int64) - 1] = True
    return np.where(goes if now.lost is None else goes & ~now.lost, up, 0.0)


def _ground(mission: Mission) -> float:
    """Height of the highest ground [m]."""
    return max((o.height for o in mission.obstacles if o.kind == "ground"), default=-math.inf)


def height(mission: Mission, now: PhaseState) -> float:
    """How far [m] the lowest vehicle is above the height at which a landing ends, at the pose to hold."""
    assert now.goal is not None
    assert now.slots is not None
    left = np.ones(mission.n_agents, dtype=np.bool_) if now.lost is None else ~now.lost
    below = now.goal.r[2] + now.slots @ now.goal.T[:, 2] - mission.fleet.radius
    return float(below[left].min()) - _ground(mission) - ABOVE


def _led(
    mission: Mission,
    phase: Phase | Steering,
    now: PhaseState,
    goal: Pose,
    arrival: float,
    t_end: float,
) -> Course:
    if phase.control == "open" or now.pose is None:
        return Course(goal, arrival, None)
    if not mission.smooth:
        return Course(goal, arrival, regulated(mission, now.pose, goal, now.t, arrival, t_end))
    through = phase.through if isinstance(phase, Fly) else ()
    return Course(goal, arrival, SmoothFlight(now.pose, goal, now.t, arrival, through))


#: Function of each kind of phase that moves the virtual body; in all others, it comes to rest at the previous goal.
_COURSES: dict[str, Callable[[Mission, Any, PhaseState, float], Course]] = {
    "brake": _brake,
    "fly": _steer,
    "follow": _follow,
    "land": _vertical,
    "orbit": _orbit,
    "takeoff": _vertical,
    "turn": _steer,
}


#: A regulator's horizon, Q, R and S; those of the CM and of the attitude; Q and R of the tracking gains.
_Law = tuple[str, Any, float, Any]
#: Position, velocity, attitude (3, 3) and body rates.
_End = tuple[Floats, Floats, Floats, Floats]


@dataclass
class RegulatedFlight:
    """LQR of the virtual body from one pose to another, and the tracking gains from arrival to the phase's end.

    Without tracking gains, the velocity error that the finite horizon leaves would carry the body away. The attitude
    is regulated as the rotation vector phi from the goal to the body. This gives three more double integrators with
    input phi'', which is exact for a rotation about one axis.
    """

    regulators: tuple[_Law, _Law]
    tracking: tuple[Any, float]  # Q, R
    start: _End
    goal: _End
    t0: float  # [s]
    arrival: float  # [s]
    t_end: float  # [s]

    def motion(self) -> Motion:
        """Quintics between knots that are dense enough for the regulators."""
        return _regulated(
            self.regulators,
            self.tracking,
            self.start,
            self.goal,
            self.t0,
            self.arrival,
            self.t_end,
        )


@kept
def _regulated(
    regulators: tuple[_Law, _Law],
    tracking: tuple[Any, float],
    start: _End,
    goal: _End,
    t0: float,
    arrival: float,
    t_end: float,
) -> Motion:
    (r, v, T, omega), (r1, v1, T1, omega1) = start, goal
    phi = att.rotation_vector_from_dcm(T @ T1.T)  # start = goal Exp(phi)
    begin = np.concatenate([r, phi]), np.concatenate([v, att.rotation_vector_rate(phi, omega)])
    end = np.concatenate([r1, np.zeros(3)]), np.concatenate([v1, omega1])
    length, rest = arrival - t0, t_end - arrival
    times, after, (body, turn, *hold) = _responses(regulators, tracking, length, rest)
    parts = [
        lqr.led(response, times, [x[k : k + 3] for x in begin], [x[k : k + 3] for x in end], length)
        for k, response in ((0, body), (3, turn))
    ]
    x = [np.concatenate(both, axis=1) for both in zip(*parts, strict=True)]
    pieces, knots = [lqr.quintic_pieces(times, *x)], t0 + times
    if rest > 0.0:
        state, target = (x[0][-1], x[1][-1]), (end[0] + end[1] * rest, end[1])
        pieces.append(lqr.quintic_pieces(after, *lqr.led(hold[0], after, state, target, rest)))
        knots = np.concatenate([knots, arrival + after[1:]])
    return as_motion(knots, np.concatenate(pieces), T1.copy())


@kept
def _responses(
    regulators: tuple[_Law, _Law], tracking: tuple[Any, float], length: float, rest: float
) -> tuple[Floats, Floats, tuple[lqr.Response, ...]]:
    """Knots of the way and of the rest after it; the responses of both regulators and of the tracking gains there."""
    times = np.unique(np.concatenate([_knots(law, length) for law in regulators]))
    after = lqr.knots(rest, *tracking) if rest > 0.0 else np.zeros(1)
    found = [
        lqr.double_integrator_response(times, length, Q, R, S if horizon == "finite" else None)
        for horizon, Q, R, S in regulators
    ]
    if rest > 0.0:
        found.append(lqr.double_integrator_response(after, rest, *tracking, None))
    return times, after, tuple(found)


def regulated(
    mission: Mission, start: Pose, goal: Pose, t0: float, arrival: float, t_end: float
) -> RegulatedFlight:
    """The regulators' trajectory from one pose at ``t0`` [s] to another, and on to the end of the phase."""
    law, turn = ((x.horizon, x.Q, x.R, x.S) for x in (mission.lqr, mission.lqr.attitude))
    ends = [(pose.r, pose.v, pose.T, pose.omega) for pose in (start, goal)]
    tracking = (mission.tracking.Q, mission.tracking.R)
    return RegulatedFlight((law, turn), tracking, *ends, t0, arrival, t_end)


@dataclass
class StoppingFlight:
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
class SmoothFlight:
    """From one pose to another with continuous acceleration and jerk, through points if there are any.

    Between two states, CM and phi are polynomials of degree 7; through points, the CM has the least snap. The flight
    begins with velocity, acceleration and jerk of its start, and arrives with the velocity of its goal, unaccelerated.
    After the arrival it continues with this velocity.
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
        points = np.array([start.r, *(at.position for at in self.through), goal.r])
        end = np.stack([goal.v, zero, zero])
        cm = splines.minimum_snap(times, points, np.stack([start.v, start.a, start.jerk]), end)
        phi = np.stack([rotation_of(start, goal.T), np.stack([zero, goal.omega, zero, zero])], 1)
        turn = splines.septic_pieces(times[[0, -1]], phi)
        each = np.repeat(turn, len(times) - 1, axis=0)
        shifted = series.of_polynomials(each, times[:-1], splines.POWERS)
        turn = np.moveaxis(shifted, 0, -1)
        return as_motion(self.t0 + times, np.concatenate([cm, turn], axis=1), goal.T)

    def times(self) -> Floats:
        """Times (n + 1,) [s] from the start at which the flight passes its points, and arrives."""
        total = self.arrival - self.t0
        given = [at.time for at in self.through if at.time is not None]
        if len(given) == len(self.through):
            return np.array([0.0, *given, total])
        start = self.start
        points = np.array([start.r, *(at.position for at in self.through), self.goal.r])
        end = np.stack([self.goal.v, np.zeros(3), np.zeros(3)])
        return splines.allocated(points, total, np.stack([start.v, start.a, start.jerk]), end)


@dataclass
class GivenFlight:
    """A way that is given."""

    found: Motion

    def motion(self) -> Motion:
        """The way itself."""
        return self.found


def passed(flight: Flight | None) -> tuple[tuple[float, Floats], ...]:
    """Times [s] and positions (3,) [m] of the CM at the points that a trajectory passes."""
    if not isinstance(flight, SmoothFlight):
        return ()
    times = flight.t0 + flight.times()[1:-1]
    return tuple(zip(times.tolist(), (np.array(at.position) for at in flight.through), strict=True))


def rotation_of(start: Pose, T1: Floats) -> Floats:
    """Rotation vector phi [rad] from an attitude T1 (3, 3) to that of a pose, and three derivatives (4, 3).

    Exp(phi) = T1 T^T, differentiated by the pose's body rates.
    """
    omega = series.from_derivatives(np.stack([start.omega, start.alpha, start.alpha_dot]))
    R = series.from_rates(start.T.T, omega)
    return series.derivatives(series.rotation_vector(T1 @ R))


#: Angle of an orbit [rad], and share of its run-in, spanned by one quintic; exact to 2e-11 of the radius.
_ARC, _SHARE = 0.1, 1 / 64
#: Greatest initial rate of an orbit, as a multiple of its final rate.
_FASTEST = 10.0


@dataclass
class OrbitFlight:
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
            splines.septic_pieces(times, np.stack(x))
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
) -> OrbitFlight:
    """The flight of an orbit from a pose at ``t0`` [s], in an ``attitude`` (3, 3) or turning from it."""
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
    flight = OrbitFlight(
        centre, (rho, float(np.arctan2(y, x)), z), phase.radius, (first, rate), carried[None], phi, axis,
        attitude, seconds(phase.blend), t0, t_end,
    )  # fmt: skip
    if smooth:
        polar = replace(flight, carried=np.zeros((0, 6))).at(np.zeros(1))
        cm = np.stack([start.v, start.a, start.jerk])
        full = np.concatenate([cm, rotation_of(start, attitude)[1:]], axis=1)
        flight.carried = full - np.stack(polar[1:])[:, 0]
    return flight


def as_motion(knots: Floats, coefficients: Floats, T1: Floats) -> Motion:
    """Polynomials (n, 6, P) between mission times (n + 1,) [s], for the kernel.

    An array of another memory layout has another type, and would compile the kernel again.
    """
    return Motion(knots, np.ascontiguousarray(coefficients), np.ascontiguousarray(T1))


def _knots(law: _Law, T: float) -> Floats:
    horizon, Q, R, S = law
    return lqr.knots(T, Q, R, S if horizon == "finite" else None)
