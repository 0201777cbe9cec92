"""The planned trajectory of a mission, before any flight."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rigidfleet.kernel.problem import SHAPE, Motion, Reference
from rigidfleet.math import rigid_body
from rigidfleet.math.rigid_body import about_cm
from rigidfleet.mission import Mission, Phase
from rigidfleet.mission.kinds import seconds
from rigidfleet.planning.certificate import Certificate, certified
from rigidfleet.planning.courses import course, lifted
from rigidfleet.planning.derivatives import slot_derivatives
from rigidfleet.planning.reference import (
    PhaseState,
    align_slots,
    attach,
    changed,
    pose_at,
    reference_kind,
    slots_before,
)
from rigidfleet.typing import Floats

#: Samples of a planned phase: their number, or the time between them [s], within bounds.
_SAMPLES = 201


_STEP = 0.05


_MOST = 2001


#: Least number of samples of a phase.
FEWEST_SAMPLES = 11
#: Number of agents beyond which a tree finds those near each other (`proximity.separation`).
MANY = 200
#: Greatest number of positions that a preview computes; counted, not timed, so that it is the same on any machine.
_PLACES = 4_000_000


@dataclass(frozen=True)
class PlannedPhase:
    """The planned paths of all agents through one phase.

    Attributes
    ----------
    time : (K,) [s] of the mission
    position, velocity, acceleration : (K, N, 3) [m, m/s, m/s^2]
    exact : whether the agents follow the plan, up to control errors; False if it is an estimate
    leg : the reference from which the paths are computed
    path_ends : if the shape changes, the agents' positions (N, 3) [m] before and after it, about the centre, in a frame
        that turns with them; in this frame all agents move straight and in step
    shapes : names of the formations before (None if there is none) and after
    """

    phase: str
    time: Floats
    position: Floats
    velocity: Floats
    acceleration: Floats
    exact: bool
    leg: Leg
    radius: Floats
    path_ends: tuple[Floats, Floats] | None = None
    shapes: tuple[str | None, str | None] = (None, None)

    @cached_property
    def certificate(self) -> Certificate | None:
        """The least separation of the planned paths, proved; None if agents track no slots."""
        return certified(self.leg.phase, self.leg.reference, self.radius)


class Leg(NamedTuple):
    """The reference of a planned phase from ``begin`` to ``end`` [s], and the state at its end.

    ``arrival`` is the time [s] at which the body is to reach its goal, that of ``after``.
    """

    phase: Phase
    begin: float
    end: float
    reference: Reference
    motion: Motion
    before: PhaseState
    after: PhaseState
    exact: bool
    arrival: float


def preview(mission: Mission, phases: int | None = None) -> tuple[list[PlannedPhase], bool]:
    """One `PlannedPhase` for each phase, or for the first ``phases``, and whether the plan is known to its end."""
    planned: list[PlannedPhase] = []
    most = samples_per_phase(mission)
    # If even the fewest samples of all phases are too many, only the first phases.
    possible = (
        len(mission.phases)
        if most >= FEWEST_SAMPLES
        else most * len(mission.phases) // FEWEST_SAMPLES
    )
    most = max(most, FEWEST_SAMPLES)
    wanted = mission.phases[:phases]
    now = at_start(mission)
    for phase in wanted[:possible]:
        found = leg(mission, phase, now)
        if found is None:
            return planned, False
        now = found.after
        planned.append(planned_phase(found, most, mission.fleet.radius))
    return planned, len(planned) == len(wanted)


def planned_phase(found: Leg, most: int, radius: Floats) -> PlannedPhase:
    """At most ``most`` samples of a leg."""
    begin, end, reference = found.begin, found.end, found.reference
    count = min(max(_SAMPLES, int((end - begin) / _STEP) + 1), _MOST, most)
    time = np.linspace(begin, end, count)
    states = slot_derivatives(reference, found.motion, time, 3).swapaxes(0, 1)
    shaping = found.phase.shaping
    straight = shaping is not None and not len(reference.knots)
    ways = (reference.p0, reference.p0 + reference.dp) if straight else None
    shapes = found.before.formation, found.after.formation
    name, exact = found.phase.name, found.exact
    return PlannedPhase(name, time, *states, exact, found, radius, ways, shapes)


def at_start(mission: Mission) -> PhaseState:
    """The state in which a mission starts."""
    frame = None if mission.body_frame is None else mission.drawn_attitude
    return PhaseState(0.0, mission.fleet.position, mission.fleet.velocity, frame=frame)


def leg(mission: Mission, phase: Phase, now: PhaseState) -> Leg | None:
    """The planned leg of a phase from the state at its start; None if it depends on distances alone."""
    masses, shaping = mission.fleet.mass, phase.shaping
    name = shaping.formation if shaping is not None else now.formation
    target = mission.slots_about_cm(name)
    if shaping is not None and target is None:
        return None
    before = now
    t0, t_end = now.t, ending(mission, phase, now.t)
    slots = now.slots if now.slots is not None else now.r
    exact = (
        shaping is None
        or phase.control == "tracking"
        # A shape held by constraint forces alone may lag behind its slots.
        or (phase.control == "open" and reference_kind(mission, shaping, slots, target) == "shape")
    )
    frame, now, turned = attach(mission, phase, now, masses, target)
    arrival = t_end
    blend, turn = (0.0 if shaping is None else seconds(shaping.blend)), np.zeros(3)
    if phase.control == "open":
        x = about_cm(now.r, masses)
        dp = np.zeros_like(x)
        if shaping is not None and target is not None:
            # Turned by the blend, and then by the attitude of the agents.
            fit = rigid_body.kabsch(x, slots_before(mission, now, masses), masses)
            dp = target @ turned.T @ fit.T - x
        motion = _thrown(mission, phase, now, t_end)
        reference = Reference(SHAPE, t0, blend, _NONE, _NONE, x, dp, turn)
        slots = target if shaping is not None else now.slots
        after = changed(now, slots=slots, pose=None, frame=frame)
    else:
        assert now.slots is not None  # attached above
        goal, arrival, trajectory = course(mission, phase, now, t_end)
        assert trajectory is not None
        motion, dp, slots = trajectory.motion(), 0.0 * now.slots, now.slots
        if shaping is not None and target is not None:
            dp, turn = align_slots(now.slots, target, masses, turned)
            slots = target
        if (lift := lifted(mission, phase, now, t_end)) is not None:
            dp, blend, slots = lift.dp, lift.time, now.slots + lift.dp
            name = name if lift.keeps else None
        bent = () if lift is None else (lift.knots, lift.ways)
        reference = Reference(SHAPE, t0, blend, _NONE, _NONE, now.slots, dp, turn, *bent)
        pose = pose_at(motion, t_end)
        tracked = pose if phase.control == "tracking" else None
        frame = pose.T if frame is not None else None
        after = changed(now, slots=slots, pose=tracked, goal=goal, frame=frame)
    if shaping is None and now.blend is not None:
        reference = now.blend
    r, v = slot_derivatives(reference, motion, np.array([t_end]), 2)[0]
    after = changed(after, t=t_end, r=r, v=v, formation=name)
    return Leg(phase, t0, t_end, reference, motion, before, after, exact, arrival)


_NONE = np.zeros(0)


def _thrown(mission: Mission, phase: Phase, now: PhaseState, t_end: float) -> Motion:
    """Motion of the CM under the input forces of an open phase."""
    masses = mission.fleet.mass
    pieces = np.zeros((1, 6, 3))
    pieces[0, :3, 0] = masses @ now.r / masses.sum()
    pieces[0, :3, 1] = masses @ now.v / masses.sum()
    pieces[0, :3, 2] = 0.5 * np.array(phase.input_force) * len(masses) / masses.sum()
    return Motion(np.array([now.t, t_end]), pieces, np.eye(3))


def samples_per_phase(mission: Mission) -> int:
    """Number of samples of each planned phase; below `MANY` agents, every pair is checked."""
    n = mission.n_agents
    each = n * max(1.0, n / 25) if n <= MANY else n
    return int(_PLACES / each) // len(mission.phases)


def phase_spans(mission: Mission) -> list[tuple[float, float]]:
    """Start and end [s] of each phase (`ending`)."""
    spans = []
    for phase in mission.phases:
        begin = spans[-1][1] if spans else 0.0
        spans.append((begin, ending(mission, phase, begin)))
    return spans


def ending(mission: Mission, phase: Phase, begin: float) -> float:
    """End [s] of a phase; one that ends by settling is assumed to settle soon, before its timeout."""
    t = begin
    if phase.until is not None:
        t = phase.until
    elif phase.duration is not None:
        t = begin + seconds(phase.duration)
    elif phase.settle is not None:
        settling = mission.constraint.settling_time or 0.0
        least = phase.least_time + settling + phase.settle.dwell
        t = begin + min(phase.settle.timeout, least)
    return max(t, begin + 1e-6)
