"""The leg of a phase: its planned course from the state at its start. Nothing here integrates or compiles.

A leg is made once for each phase. The check before the flight, least times, transitions, ways round obstacles and what
follows from a loss read it; the plan of a flight (`rigidfleet.planning.plan`) is a leg and the law that flies it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from rigidfleet.kernel.problem import CONSTANT, SHAPE, SQUARED, Motion, Reference
from rigidfleet.math import rigid_body
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.math.rigid_body import about_cm, mean_axis_rates
from rigidfleet.mission import Mission, Phase, Settle
from rigidfleet.mission.kinds import seconds
from rigidfleet.mission.schema import Constraint
from rigidfleet.planning.certificate import Certificate, certificate_of
from rigidfleet.planning.courses import course
from rigidfleet.planning.derivatives import body_taylor, slot_derivatives
from rigidfleet.planning.reference import (
    PhaseState,
    Pose,
    copy_with,
    pose_at,
    reference_kind,
    shift_and_rotvec,
)
from rigidfleet.typing import Floats

_KINDS = {"shape": SHAPE, "squares": SQUARED, "step": CONSTANT}
_NONE = np.zeros(0)
#: Shortest phase [s], of one that is to end before it begins.
_SHORTEST = 1e-6
#: Speed of a slot about the CM above which it does not rest [m/s].
_MOVES = 1e-6
#: Number of times at which a phase that ends by settling is looked at.
_LOOKS = 201


class Departure(NamedTuple):
    """What a phase starts from and blends to, whatever its times."""

    before: PhaseState  # at the switch
    now: PhaseState  # with the body frame attached, if the phase needs one
    frame: Floats | None  # attitude (3, 3) of the mean-axis frame to integrate
    # Slots (N, 3) of the formation, if it has any, about the CM, body axes [m].
    target: Floats | None
    kind: int  # of the reference of distances
    p0: Floats  # slots (N, 3) that the phase begins with [m]
    dp: Floats  # what a blend adds to them (N, 3) [m]
    turn: Floats  # rotation vector (3,) by which it turns them meanwhile [rad]


@dataclass
class Leg:
    """The planned course of a phase from the state at its start.

    Attributes
    ----------
    before : the state that the phase starts from
    start, t_end : its beginning, and its latest end [s]
    departure : what does not depend on the times of the phase
    formation : name of the formation at the end, if there is one
    knows_slots : whether that has slots, not only distances
    slots : (N, 3) at the end, about the CM, body axes [m]
    goal, arrival : the pose that the body is to reach, and when [s]
    way : motion of the body, if there is a course for it
    reference : of the slots; the distances of edges are those of a flight, which knows them
    masses, radius : (N,) of all vehicles, lost ones included [kg, m]
    constraint : options of the law that holds distances
    smooth : whether the next phase begins with the acceleration and jerk of the reference
    """

    phase: Phase
    before: PhaseState
    start: float
    t_end: float
    departure: Departure
    frame: Floats | None
    formation: str | None
    knows_slots: bool
    slots: Floats | None
    goal: Pose | None
    arrival: float
    way: Callable[[], Motion] | None
    reference: Reference
    masses: Floats
    radius: Floats
    constraint: Constraint
    smooth: bool

    @property
    def has_known_ways(self) -> bool:
        """Whether the way of the agents is known before the flight: distances alone do not say where they lead."""
        return self.knows_slots or self.phase.shaping is None

    @property
    def follows_exactly(self) -> bool:
        """Whether the agents follow the plan up to control errors; if not, it is an estimate."""
        # A shape held by constraint forces alone may lag behind its slots.
        blended = self.phase.control == "open" and self.departure.kind == SHAPE
        return self.phase.shaping is None or self.phase.tracks_slots or blended

    @cached_property
    def motion(self) -> Motion:
        """Motion of the body; under the input forces alone, if it has no course."""
        if self.way is not None:
            return self.way()
        now, total = self.before, self.masses.sum()
        pieces = np.zeros((1, 6, 3))
        pieces[0, :3, 0] = self.masses @ now.r / total
        pieces[0, :3, 1] = self.masses @ now.v / total
        pieces[0, :3, 2] = 0.5 * np.array(self.phase.input_force) * len(self.masses) / total
        return Motion(np.array([self.start, self.t_end]), pieces, np.eye(3))

    @cached_property
    def slots_and_motion(self) -> tuple[Reference, Motion]:
        """Reference of the slots, and motion of the body, by which the agents are expected to fly.

        They are those of the leg if slots are tracked. Agents that distances alone lead turn the slots as they turn
        themselves: they blend straight in the axes of the world.
        """
        reference = self.reference
        if self.phase.control != "open":
            return reference, self.motion
        x, dp = about_cm(self.before.r, self.masses), np.zeros_like(self.before.r)
        if self.phase.shaping is not None:
            fit = rigid_body.kabsch(x, reference.p0, self.masses)
            dp = (reference.p0 + reference.dp) @ fit.T - x
        return reference._replace(p0=x, dp=dp, turn=np.zeros(3)), self.motion

    @cached_property
    def certificate(self) -> Certificate | None:
        """The least separation of the planned paths, proved; None if agents track no slots."""
        return certificate_of(self.phase, self.reference, self.radius, self.before.lost)

    @cached_property
    def end(self) -> float:
        """Time [s] at which the phase is expected to end: one that ends by settling, soon after it reaches its goal."""
        if self.phase.settle is None:
            return self.t_end
        return self.start + settle_phase_duration(self.phase, self.constraint, self._time_to_goal())

    def _time_to_goal(self) -> float:
        """Time [s] from the start from which on the body is planned to be as near its goal as the phase asks for."""
        goal, settle = self.goal, self.phase.settle
        if goal is None or settle is None or self.way is None:
            return 0.0
        time = np.linspace(self.start, self.t_end, _LOOKS)
        cm, axes = (x[0] for x in body_taylor(self.motion, time))
        off = np.linalg.norm(cm - goal.r[:, None], axis=0)
        turned = self.departure.p0 @ (axes - goal.T.T[..., None]).transpose(2, 1, 0)
        off += np.linalg.norm(turned, axis=2).max(axis=1, initial=0.0)
        beyond = np.flatnonzero(off > settle.tolerance)
        return float(time[beyond[-1]] - self.start) if len(beyond) else 0.0

    @cached_property
    def planned_end_state(self) -> PhaseState:
        """The planned state at the end, if it is known."""
        return self.state_at(self.end)

    def state_at(self, t: float) -> PhaseState:
        """The planned state at a time [s]."""
        reference, motion = self.slots_and_motion
        r, v = slot_derivatives(reference, motion, np.array([t]), 2)[0]
        pose: Pose | None = pose_at(motion, t)
        frame = self.frame
        if frame is not None and self.phase.control != "open":
            frame = pose.T
        if not self.phase.tracks_slots:
            pose = None
        elif not self.smooth:
            pose = Pose(pose.r, pose.v, pose.T, pose.omega)
        return self.next_start(t, r, v, frame, pose)

    def next_start(
        self, t: float, r: Floats, v: Floats, frame: Floats | None, pose: Pose | None
    ) -> PhaseState:
        """The state from which the next phase starts if this one ends at t [s], with the agents at r and v (N, 3)."""
        goal, blend, slots, rates = self.goal, self.reference, self.slots, None
        if self.phase.goal_moves and pose is not None and goal is not None and t < self.t_end:
            goal = copy_with(pose, T=pose.T if self.phase.turns_away else goal.T, named=goal.named)
        if self.phase.follows_curves and len(blend.knots) and t < blend.knots[-1] + _SHORTEST:
            # They may end in motion; beyond their files, slots rest.
            own = Piecewise(blend.knots, blend.ways).states(np.minimum([t], blend.knots[-1]), 4)
            if np.abs(own[1]).max() > _MOVES:
                slots, rates = own[0, 0], own[1:, 0]
        return copy_with(
            self.before, t=t, r=r, v=v, frame=frame, formation=self.formation, slots=slots, pose=pose, goal=goal,
            rates=rates, blend=blend if t < blend.t0 + blend.T_b else None,
        )  # fmt: skip


def state_at_start(mission: Mission) -> PhaseState:
    """The state in which a mission starts."""
    frame = None if mission.body_frame is None else mission.drawn_attitude
    return PhaseState(0.0, mission.fleet.position, mission.fleet.velocity, frame=frame)


def leg_of(mission: Mission, phase: Phase, now: PhaseState) -> Leg:
    """The leg of a phase from the state at its start."""
    return leg_from(mission, phase, depart(mission, phase, now))


def depart(mission: Mission, phase: Phase, now: PhaseState) -> Departure:
    """Attach the body frame to a state, and find what the phase blends from there."""
    left, shaping = np.where(now.lost, 0.0, mission.fleet.mass), phase.shaping
    target = mission.slots_about_cm(now.formation if shaping is None else shaping.formation)
    turn = None
    if shaping is not None:
        turn = mission.assigned_turn(now.formation, shaping.formation) if shaping.fits_slots else np.eye(3)  # fmt: skip
    frame, state, turn = _attach_frame(mission, phase, now, left, target, turn)
    # Without slots, the agents' positions in the formations' axes.
    p0 = about_cm(state.r, left) @ mission.drawn_attitude.T if state.slots is None else state.slots
    if shaping is None:
        return Departure(now, state, frame, target, CONSTANT, p0, np.zeros(p0.shape), np.zeros(3))
    kind = _KINDS[reference_kind(mission, shaping, p0, target)]
    after, turn = (p0, np.eye(3)) if target is None else (target, turn)
    return Departure(now, state, frame, target, kind, p0, *shift_and_rotvec(p0, after, left, turn))


def _attach_frame(
    mission: Mission, phase: Phase, now: PhaseState, masses: Floats, target: Floats | None, turn: Floats | None
) -> tuple[Floats | None, PhaseState, Floats | None]:  # fmt: skip
    """Attach the body frame if a phase needs one.

    Slots fitted to the agents (Kabsch) give the attitude, the matrix of Eq. (23). Before any formation is established,
    the agents' own positions are the slots, in the axes of the formations' definition. An established formation takes
    its own axes: those of its prescribed attitude, or, if its attitude is free, the nearest ones. Lost vehicles do not
    count in the fit; the virtual body keeps their slots.

    Parameters
    ----------
    masses : (N,) [kg], 0 for lost vehicles
    target : slots (N, 3) of the phase's formation [m]
    turn : (3, 3) rotation of the desired slots for which they were assigned, in the axes before

    Returns
    -------
    frame : the frame to integrate, if any
    now : the state, with the frame attached
    turn : (3, 3) rotation in the new axes; None for the one that brings desired slots nearest to those before
    """
    establishing, frame = phase.establishing, now.frame
    if phase.control == "open":
        if mission.formulation == "body" and frame is None:
            frame = np.eye(3)
        return frame, now, turn
    if phase.tracks_slots and now.pose is not None:
        pose = now.pose  # the reference continues without a jump
    else:
        x, fit = about_cm(now.r, masses), now.slots
        near = frame if frame is not None else now.pose.T if now.pose is not None else np.eye(3)
        if fit is not None:
            T = rigid_body.kabsch(x, fit, masses, near=near.T).T
        else:
            T = near if mission.body_frame is not None else mission.drawn_attitude
        pose = Pose(masses @ now.r / masses.sum(), masses @ now.v / masses.sum(), T, np.zeros(3))
        if now.v.any():
            omega = mean_axis_rates(x[None], about_cm(now.v, masses)[None], masses)[0]
            pose = copy_with(pose, omega=T @ omega)
        if now.lost.any() and fit is not None:
            centre = masses @ fit / masses.sum()  # of the remaining agents, from the body's origin
            v = pose.v - T.T @ np.cross(pose.omega, centre)
            pose = copy_with(pose, r=pose.r - T.T @ centre, v=v)
    slots = now.slots if now.slots is not None else about_cm(now.r, masses) @ pose.T.T
    goal = now.goal or copy_with(pose, v=np.zeros(3), omega=np.zeros(3))
    if establishing is not None and target is not None:
        # The new axes in the old ones: `axes` maps vectors from new to old.
        free = mission.leaves_attitude_free(phase)
        if free:
            axes = rigid_body.kabsch(slots, target, masses) if turn is None else turn
        else:
            attitude = mission.establish_attitude(establishing, goal.T if goal.named else None)
            steady = now.pose is not None and goal.named and np.array_equal(goal.T, attitude)
            axes = np.eye(3) if steady else pose.T @ attitude.T
        slots = slots @ axes
        pose = pose.in_axes(axes)
        goal = copy_with(goal, T=pose.T if free else attitude, named=not free)
        if free:  # in the axes that fit best, nothing is left to turn
            turn = np.eye(3)
        elif turn is not None:
            turn = axes.T @ turn
    if phase.leads_body or (mission.formulation == "body" and frame is None):
        frame = pose.T
    return frame, copy_with(now, pose=pose, slots=slots, goal=goal), turn


def leg_from(mission: Mission, phase: Phase, departure: Departure) -> Leg:
    """The leg of a phase from a departure: its own, or one of a phase that differs in nothing but its times."""
    before, now, frame, target, kind, p0, dp, turn = departure
    shaping, t_end = phase.shaping, latest_end(phase, now.t)
    goal, arrival, way, lift = course(mission, phase, now, t_end)
    name, slots, T_b = now.formation, p0, 0.0
    if shaping is not None:
        name = shaping.formation
        slots = p0 if target is None else target
        T_b = 0.0 if shaping.reference == "step" else seconds(shaping.blend)
    if phase.control == "open" and kind != SHAPE:
        slots = now.slots if shaping is None else target
    bent: Any = ()
    if lift is not None:
        kind, dp, T_b, bent = SHAPE, lift.dp, lift.time, (lift.knots, lift.ways)
        slots = p0 + dp
        if not lift.keeps:
            name = target = None  # no formation outlasts it
    reference = Reference(kind, now.t, T_b, _NONE, _NONE, p0, dp, turn, *bent)
    if shaping is None and lift is None and now.blend is not None:
        reference = now.blend
    return Leg(
        phase, before, now.t, t_end, departure, frame, name, target is not None, slots, goal, arrival, way,
        reference, mission.fleet.mass, mission.fleet.radius, mission.constraint,
        mission.smooth or mission.on_loss != "continue",
    )  # fmt: skip


def latest_end(phase: Phase, start: float) -> float:
    """Time [s] at which a phase ends, at the latest."""
    if phase.until is not None:
        return phase.until if phase.until > start else start + _SHORTEST
    return start + seconds(phase.duration or (phase.settle or Settle()).timeout)


def settle_phase_duration(phase: Phase, constraint: Constraint, reached: float = 0.0) -> float:
    """Expected duration [s] of a phase that ends by settling: soon after its motion.

    Errors of distances have to settle; the goal is ``reached`` so long after the start [s].
    """
    assert phase.settle is not None
    settling = constraint.settling_time or 0.0
    least = max(phase.least_time, reached) + settling + phase.settle.dwell
    return min(phase.settle.timeout, least)


def phase_spans(mission: Mission) -> list[tuple[float, float]]:
    """Start and expected end [s] of each phase."""
    spans, end = [], 0.0
    for phase in mission.phases:
        begin, end = end, latest_end(phase, end)
        if phase.settle is not None:
            end = begin + settle_phase_duration(phase, mission.constraint)
        spans.append((begin, end))
    return spans
