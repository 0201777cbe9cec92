"""Where each kind of phase leads: goal and trajectory of the virtual body, and ways of the slots about it.

This is all that planning knows about kinds. A kind of phase that does not stay has a function in `_COURSES`, and if it
does not fly by the regulators of [lqr] either, a class of trajectories in `rigidfleet.planning.body_trajectories`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rigidfleet.errors import Finding, MissionError
from rigidfleet.kernel.problem import NO_KNOTS, NO_WAYS, Motion
from rigidfleet.math import attitude as att
from rigidfleet.math import series
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.mission import Fly, Mission, Phase
from rigidfleet.mission.kinds import (
    Brake,
    Follow,
    Orbit,
    Reshape,
    Steering,
    Turn,
    Vertical,
    seconds,
)
from rigidfleet.mission.schema import Lqr
from rigidfleet.planning.body_trajectories import (
    as_motion,
    orbit_motion,
    pose_turn_from,
    regulated_motion,
    smooth_motion,
    stopping_motion,
)
from rigidfleet.planning.reference import PhaseState, Pose, copy_with, pose_at
from rigidfleet.typing import Floats

#: Time in which a phase that ends by settling, without a target, brings the body to rest [s].
_REST_WITHIN = 10.0
#: Height above the ground at which a landing ends [m]: the vehicles' lags and noise shall not lead them into it; and
#: the speed downwards there [m/s]. Both are well within what the verdict takes as standing on the ground.
ABOVE, LANDING_SPEED = 0.05, 0.2
#: How far the first point of given ways may be off [m, m/s, rad], and the time in which the difference fades [s].
_START_TOLERANCES, _FADED = (0.1, 0.1, math.radians(5.0)), 1.0
#: Ways of vehicles straight up or down that differ by less count as one [m].
_LEVEL = 1e-9


class Lift(NamedTuple):
    """Ways of the slots (N, 3) about the CM, body axes [m], and the time they take [s]; if they are bent, how.

    ``knots`` and ``ways`` are those of `Reference`; ``keeps`` says whether the phase's formation is reached by them.
    """

    dp: Floats
    time: float
    knots: Floats = NO_KNOTS
    ways: Floats = NO_WAYS
    keeps: bool = False


class Course(NamedTuple):
    """Goal and trajectory of the virtual body in a phase, and ways of its slots."""

    goal: Pose | None  # pose to reach; None if no frame is attached yet
    arrival: float  # time to reach it [s]
    motion: Callable[[], Motion] | None  # to it; None if there is none
    # What is added to the slots; None if they keep the shape, or blend to another.
    lift: Lift | None = None


def course(mission: Mission, phase: Phase, now: PhaseState, t_end: float) -> Course:
    """Course of the virtual body in a phase that ends at ``t_end`` [s], from a state with the frame attached."""
    return _COURSES.get(phase.kind, _course_to_rest)(mission, phase, now, t_end)


def _course_to_rest(mission: Mission, phase: Phase, now: PhaseState, t_end: float) -> Course:
    """Come to rest at the previous goal, or the phase's own place; by the end, if known, as no time is given."""
    arrival = t_end if phase.settle is None else min(t_end, now.t + _REST_WITHIN)
    if now.goal is None:
        return Course(None, t_end, None)
    r = now.goal.r if phase.rest_position is None else np.array(phase.rest_position)
    goal = copy_with(now.goal, r=r, v=np.zeros(3), omega=np.zeros(3))
    return _course_to(mission, phase, now, goal, arrival, t_end)


def _reshape_course(mission: Mission, phase: Reshape, now: PhaseState, t_end: float) -> Course:
    """Stay, or go to the phase's own place; slots may go on bent ways."""
    rest = _course_to_rest(mission, phase, now, t_end)
    if not phase.has_bent_ways:
        return rest
    control, blend = np.array(phase.control_points), seconds(phase.blend)
    knots, ways = Piecewise.b_spline(control, blend)
    return rest._replace(lift=Lift(control[-1] - control[0], blend, now.t + knots, ways, keeps=True))  # fmt: skip


def _fly_course(mission: Mission, phase: Fly, now: PhaseState, t_end: float) -> Course:
    """Go to a waypoint, and perhaps an attitude."""
    velocity = np.zeros(3) if phase.has_free_velocity else np.array(phase.velocity)
    return _steer_course(mission, phase, now, t_end, np.array(phase.position), velocity)


def _turn_course(mission: Mission, phase: Turn, now: PhaseState, t_end: float) -> Course:
    """Turn to an attitude on the spot."""
    return _steer_course(mission, phase, now, t_end, now.pose_goal_and_slots[1].r, np.zeros(3))


def _steer_course(
    mission: Mission, phase: Steering, now: PhaseState, t_end: float, r_goal: Floats, v_goal: Floats
) -> Course:
    """Go to a place (3,) with a velocity there and an attitude, within ``travel`` or by the end."""
    _, before, _ = now.pose_goal_and_slots
    arrival = t_end if phase.travel is None else now.t + seconds(phase.travel)
    angles = phase.attitude_deg
    T = before.T if angles is None else att.dcm_from_euler(np.deg2rad(angles))
    named = before.named or angles is not None
    goal = Pose(r_goal, v_goal, T, np.deg2rad(phase.rates_deg_s), named)
    return _course_to(mission, phase, now, goal, arrival, t_end)


def _orbit_course(mission: Mission, phase: Orbit, now: PhaseState, t_end: float) -> Course:
    """Fly a circle, and continue with its velocity. An attitude that turns along is not an explicitly specified one."""
    pose, goal, _ = now.pose_goal_and_slots
    motion = orbit_motion(phase, pose, goal.T, now.t, t_end, smooth=mission.smooth)
    named = goal.named and not phase.turns_away
    return Course(copy_with(pose_at(motion, t_end), named=named), t_end, lambda: motion)


def _brake_course(mission: Mission, phase: Brake, now: PhaseState, t_end: float) -> Course:
    """Come to rest within ``travel`` or by the end, from the reference as it moves now."""
    pose, before, _ = now.pose_goal_and_slots
    arrival = t_end if phase.travel is None else min(t_end, now.t + phase.travel)
    motion = stopping_motion(pose, now.t, arrival)
    end = pose_at(motion, arrival)
    turned = pose.omega.any() or not np.allclose(pose.T, before.T, rtol=0, atol=1e-9)
    T = end.T if turned else before.T
    goal = Pose(end.r, np.zeros(3), T, np.zeros(3), before.named and not turned)
    return Course(goal, arrival, lambda: motion)


def _vertical_course(mission: Mission, phase: Vertical, now: PhaseState, t_end: float) -> Course:
    """Go straight up or down by the mean of what the vehicles do, within ``travel`` or by the end.

    Where each vehicle has a way of its own, the slots follow the same septic from rest to rest: together, each goes
    straight up or down by its own way, and one that stays, stays.
    """
    pose, before, _ = now.pose_goal_and_slots
    arrival = t_end if phase.travel is None else min(t_end, now.t + phase.travel)
    up, v, lift = np.zeros(3), np.zeros(3), None
    if phase.has_way_per_vehicle:
        rise, masses = climb_distances(mission, phase, now), mission.fleet.mass
        up[2] = masses @ rise / masses.sum()
        if np.ptp(rise) >= _LEVEL:
            travel = min(phase.travel or math.inf, t_end - now.t)
            lift = Lift(np.outer(rise - up[2], before.T[:, 2]), travel)
    else:
        up[2] = -max(0.0, height_above_landing(mission, phase, now))
        v[2] = -min(LANDING_SPEED, -up[2] / (arrival - now.t))
    goal = copy_with(before, r=before.r + up, v=v, omega=np.zeros(3))
    return Course(goal, arrival, partial(smooth_motion, pose, goal, now.t, arrival), lift)


def _follow_course(mission: Mission, phase: Follow, now: PhaseState, t_end: float) -> Course:
    """Follow the trajectory of the virtual body, or the mean of the vehicles' own, about which the slots then move.

    What the first point of a file differs from the place where the vehicles are fades over `_FADED`; more, as avoidance
    may leave, over longer, so that its acceleration stays.
    """
    pose, before, slots = now.pose_goal_and_slots
    way = phase.pieces
    length = t_end - now.t if phase.travel is None else phase.travel
    scale = length / way.time[-1]
    knots, pieces = way.time * scale, way.pieces * scale ** -np.arange(float(way.pieces.shape[-1]))
    T1 = np.eye(3) if phase.turns_away else pose.T
    begin = np.concatenate(
        [np.stack([pose.r, pose.v, pose.a, pose.jerk]), pose_turn_from(pose, T1)], 1
    )
    place = pose.r + (slots @ pose.T if pieces.shape[1] > 1 else 0.0)
    off = float(np.linalg.norm(pieces[0, :, :3, 0] - place, axis=1).max()) / _START_TOLERANCES[0]
    lift, fade = None, min(_FADED * math.sqrt(max(off, 1.0)), float(knots[-1]))
    body = np.zeros((len(pieces), 6, pieces.shape[-1]))
    if pieces.shape[1] == 1:
        body[:, :3] = pieces[:, 0, :3]
        if phase.turns_away:
            body[:, 5] = pieces[:, 0, 3]
            # By whole turns, to be nearest to the yaw before.
            body[:, 5, 0] += 2.0 * math.pi * round((begin[0, 5] - body[0, 5, 0]) / (2.0 * math.pi))
    else:
        masses = mission.fleet.mass
        body[:, :3] = np.einsum("i,kiqp->kqp", masses / masses.sum(), pieces[:, :, :3])
        ways = np.einsum("ab,kibp->kiap", pose.T, pieces[:, :, :3] - body[:, None, :3])
        start = np.zeros((4, *slots.shape))
        start[0] = slots
        if now.rates is not None:
            start[1:] = now.rates
        if begin[1:, 3:].any():
            # The slots take over the turn of the body: files that go on so are flown as they are.
            turn = series.series_by_derivatives(np.stack([pose.omega, pose.alpha, pose.alpha_dot]))
            turn = series.rotation_series_from_rates(np.eye(3), turn).swapaxes(1, 2)
            start = series.product(series.series_by_derivatives(start), turn, np.matmul)
            start, begin[1:, 3:] = series.taylor_derivatives(start), 0.0
        own = Piecewise(knots, ways).start_from(start, fade)
        end = own.at(own.time[-1:])[0]
        lift = Lift(end - slots, length, now.t + own.time, np.ascontiguousarray(own.pieces))
    cm = Piecewise(knots, body).start_from(begin, fade)
    motion = as_motion(now.t + cm.time, cm.pieces, T1)
    arrival = float(min(t_end, motion.knots[-1]))
    goal = copy_with(pose_at(motion, arrival), named=before.named and not phase.turns_away)
    return Course(goal, arrival, lambda: motion, lift)


def moving_slots_conflict_text(phase: Any, now: PhaseState) -> str:
    """What keeps a phase from going on with the motion of slots, where files have ended in it; "" if nothing."""
    goes_on = phase.control == "open" or (phase.follows_curves and phase.pieces[1].shape[1] > 1)
    if now.rates is None or goes_on:
        return ""
    speed = np.linalg.norm(now.rates[0], axis=1)
    if (most := float(speed.max())) <= _START_TOLERANCES[1]:
        return ""
    return f"begins while agent {speed.argmax() + 1} goes on at {most:.2f} m/s beside the others"


def way_conflict_text(phase: Any, now: PhaseState) -> str:
    """What keeps a phase from following the ways that are given for it, from the state at its start; "" if nothing."""
    if phase.has_bent_ways:
        first = np.array(phase.control_points)[0]
        if now.slots is None or not np.abs(first - now.slots).max() < _START_TOLERANCES[0]:
            return "begins in other slots than the phase before has led to"
    return _trajectory_conflict_text(phase, now) if phase.follows_curves else ""


def _trajectory_conflict_text(phase: Follow, now: PhaseState) -> str:
    """What keeps the virtual body, or each vehicle, from following its trajectory."""
    pose, _, slots = now.pose_goal_and_slots
    knots, pieces = phase.pieces
    first = pieces[0, :, :3, :2]
    alone = pieces.shape[1] == 1
    place = pose.r[None] if alone else pose.r + slots @ pose.T
    speed = pose.v[None] + (0.0 if alone else np.cross(pose.omega, slots) @ pose.T)
    if now.rates is not None and not alone:
        speed = speed + now.rates[0] @ pose.T
    known = phase.travel or phase.duration or (phase.until or 0.0) - now.t
    length = knots[-1] if phase.auto_keys else known
    missed = first[..., 0] - place, first[..., 1] * (knots[-1] / length) - speed
    off = np.linalg.norm(missed, axis=2)
    for far, most, unit in zip(off, _START_TOLERANCES, ("m", "m/s"), strict=False):
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
        if angle > _START_TOLERANCES[2]:
            return f"its first attitude, yaw {math.degrees(pieces[0, 0, 3, 0]):.1f}°, is {math.degrees(angle):.1f}° off"
    return ""


def climb_distances(mission: Mission, phase: Vertical, now: PhaseState) -> Floats:
    """How far [m] each vehicle (N,) goes up from the pose to hold: to a height, or (down) to just above the ground."""
    (_, goal, slots), n = now.pose_goal_and_slots, mission.n_agents
    place, ground = goal.r[2] + slots @ goal.T[:, 2], _heights_below_goal(mission, phase, now)
    if phase.arrival_height is None:
        up = np.minimum(ground + (ABOVE + mission.fleet.radius) - place, 0.0)
    else:
        up = ground.max() + phase.arrival_height - place
    goes = np.isin(np.arange(n), phase.movers(n))
    return np.where(goes & ~now.lost, up, 0.0)


def _heights_below_goal(mission: Mission, phase: Vertical, now: PhaseState) -> Floats:
    """Height (N,) [m] of what is below each vehicle at the pose to hold; of a lost one, the least of the others'.

    Raises
    ------
    MissionError
        There is nothing below a vehicle.
    """
    _, goal, slots = now.pose_goal_and_slots
    r = goal.r + slots @ goal.T
    heights = mission.height_below(*r.T)
    if len(off := np.flatnonzero(~now.lost & ~np.isfinite(heights))):
        x, y, _ = r[off[0]]
        problem = f"needs a ground, and none is below agent {off[0] + 1} at ({x:.1f}, {y:.1f}) m"
        remedy = "add [[obstacles]] with kind = 'ground', or more terrain"
        names = [p.name for p in mission.phases]  # a landing after a loss has no number there
        number = f"[{names.index(phase.name) + 1}]" if phase.name in names else ""
        where = f"phases{number}.kind"
        raise MissionError([Finding(mission.origin, where, None, problem, remedy)])
    return np.where(now.lost, heights[~now.lost].min(), heights)


def height_above_landing(mission: Mission, phase: Vertical, now: PhaseState) -> float:
    """How far [m] the lowest vehicle is above the height at which a landing ends, at the pose to hold."""
    _, goal, slots = now.pose_goal_and_slots
    below = goal.r[2] + slots @ goal.T[:, 2] - mission.fleet.radius
    return float(below[~now.lost].min() - _heights_below_goal(mission, phase, now).min()) - ABOVE


def _course_to(
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
        laws, tracking = regulators(mission, phase), mission.tracking
        way = partial(regulated_motion, laws, tracking, now.pose, goal, now.t, arrival, t_end)
        return Course(goal, arrival, way)
    end = copy_with(goal, v=np.full(3, np.nan)) if phase.has_free_velocity else goal
    motion = smooth_motion(now.pose, end, now.t, arrival, phase.points)
    if phase.has_free_velocity:
        goal = copy_with(goal, v=pose_at(motion, arrival).v)
    return Course(goal, arrival, lambda: motion)


def regulators(mission: Mission, phase: Phase | Steering) -> Lqr:
    """The regulators of the virtual body; those to a free velocity do not weigh it at the arrival."""
    laws = mission.lqr
    return laws.model_copy(update={"S": (laws.S[0], 0.0)}) if phase.has_free_velocity else laws


#: Function of each kind of phase that leads somewhere; in all others, the virtual body comes to rest.
_COURSES: dict[str, Callable[[Mission, Any, PhaseState, float], Course]] = {
    "brake": _brake_course,
    "fly": _fly_course,
    "follow": _follow_course,
    "land": _vertical_course,
    "orbit": _orbit_course,
    "reshape": _reshape_course,
    "takeoff": _vertical_course,
    "turn": _turn_course,
}
