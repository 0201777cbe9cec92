"""The planned trajectory of a mission, before any flight."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigidfleet.kernel.problem import septic_polynomial
from rigidfleet.math import attitude as att
from rigidfleet.math import pid, rigid_body
from rigidfleet.math.rigid_body import about_cm
from rigidfleet.mission import Mission, Phase
from rigidfleet.planning.courses import course
from rigidfleet.planning.reference import (
    PhaseState,
    Pose,
    align_slots,
    attach,
    reference_kind,
    slots_about_cm,
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
    position, acceleration : (K, N, 3) [m, m/s^2]
    exact : whether the agents follow the plan, up to control errors; False if it is an estimate
    path_ends : if the shape changes, the agents' positions (N, 3) [m] before and after it, about the centre, in a frame
        that turns with them; in this frame all agents move straight and in step
    shapes : names of the formations before (None if there is none) and after
    """

    phase: str
    time: Floats
    position: Floats
    acceleration: Floats
    exact: bool
    path_ends: tuple[Floats, Floats] | None = None
    shapes: tuple[str | None, str | None] = (None, None)

    @property
    def velocity(self) -> Floats:
        """(K, N, 3) [m/s]."""
        return _rate(self.position, self.time)


def preview(mission: Mission, phases: int | None = None) -> tuple[list[PlannedPhase], bool]:
    """One `PlannedPhase` for each phase, or for the first ``phases``, and whether the plan is known to its end."""
    masses = mission.fleet.mass
    frame = None if mission.body_frame is None else mission.drawn_attitude
    now = PhaseState(0.0, mission.fleet.position, mission.fleet.velocity, frame=frame)
    planned: list[PlannedPhase] = []
    most = samples_per_phase(mission)
    # If even the fewest samples of all phases are too many, only the first phases.
    possible = (
        len(mission.phases)
        if most >= FEWEST_SAMPLES
        else most * len(mission.phases) // FEWEST_SAMPLES
    )
    most = max(most, FEWEST_SAMPLES)
    for phase, (begin, end) in list(zip(mission.phases, phase_spans(mission), strict=True))[
        :phases
    ]:
        if len(planned) == possible:
            return planned, False
        shaping = phase.shaping
        name = shaping.formation if shaping is not None else now.formation
        target = slots_about_cm(mission, name, masses)
        if shaping is not None and target is None:
            return planned, False
        now = replace(now, t=begin)
        before = now.slots if now.slots is not None else now.r
        count = min(max(_SAMPLES, int((end - begin) / _STEP) + 1), _MOST, most)
        time = np.linspace(begin, end, count)
        names = now.formation, name
        position, path_ends, now = _leg(mission, phase, now, masses, target, time)
        guess = (
            shaping is not None
            and phase.control != "tracking"
            # A shape held by constraint forces alone may lag behind its slots.
            and (
                phase.control == "body"
                or reference_kind(mission, shaping, before, target) != "shape"
            )
        )
        acceleration = _rate(_rate(position, time), time)
        planned.append(
            PlannedPhase(phase.name, time, position, acceleration, not guess, path_ends, names)
        )
    return planned, True


def samples_per_phase(mission: Mission) -> int:
    """Number of samples of each planned phase; below `MANY` agents, every pair is checked."""
    n = mission.n_agents
    each = n * max(1.0, n / 25) if n <= MANY else n
    return int(_PLACES / each) // len(mission.phases)


def _leg(
    mission: Mission,
    phase: Phase,
    now: PhaseState,
    masses: Floats,
    target: Floats | None,
    time: Floats,
) -> tuple[Floats, tuple[Floats, Floats] | None, PhaseState]:
    """Positions (K, N, 3) of all agents over a phase, their `PlannedPhase.path_ends`, and the situation at its end."""
    t0, t_end = time[0], time[-1]
    shaping = phase.shaping
    frame, now, turned = attach(mission, phase, now, masses, target)
    s = np.zeros(len(time)) if shaping is None else septic((time - t0) / shaping.blend)
    if phase.control == "open":
        x = about_cm(now.r, masses)
        after = x
        if shaping is not None and target is not None:
            # Turned by the blend, and then by the attitude of the agents.
            slots = slots_before(mission, now, masses)
            after = target @ turned.T @ rigid_body.kabsch(x, slots, masses).T
        cm, v = masses @ now.r / masses.sum(), masses @ now.v / masses.sum()
        a = np.array(phase.input_force) * len(masses) / masses.sum()
        tau = (time - t0)[:, None]
        path_ends = x, after
        shape = x + s[:, None, None] * (after - x)
        position = shape + (cm + tau * v + 0.5 * tau**2 * a)[:, None]
        v_end = np.tile(v + a * (t_end - t0), (len(masses), 1))
        slots = target if shaping is not None else now.slots
        now = replace(now, r=position[-1], v=v_end, slots=slots, pose=None, frame=frame)
    else:
        assert now.slots is not None  # attached above
        goal, _, flight = course(mission, phase, now, t_end)
        assert flight is not None
        r, phi, v_cm, omega = flight.sample(
            time
        )  # where phi is small at the end, its rate is omega
        T = att.dcm_from_rotation_vector(phi) @ flight.T1
        before = now.slots
        after = target if shaping is not None and target is not None else before
        dp, turn = 0.0 * before, np.zeros(3)
        if shaping is not None:
            dp, turn = align_slots(before, after, masses, turned)
        path_ends = before, before + dp
        p = before + s[:, None, None] * dp
        p = p @ att.dcm_from_rotation_vector(s[:, None] * turn)
        position = r[:, None] + p @ T
        pose = Pose(r[-1], v_cm, T[-1], omega)
        velocity = v_cm + np.cross(omega, after) @ T[-1]
        tracked = pose if phase.control == "tracking" else None
        frame = T[-1] if frame is not None else None
        now = replace(
            now, r=position[-1], v=velocity, slots=after, pose=tracked, goal=goal, frame=frame
        )
    if shaping is None:
        return position, None, replace(now, t=t_end)
    return position, path_ends, replace(now, t=t_end, formation=shaping.formation)


def phase_spans(mission: Mission) -> list[tuple[float, float]]:
    """Start and end [s] of each phase; a phase that ends by settling is assumed to settle soon, before its timeout."""
    t, spans = 0.0, []
    settling = _settling(mission)
    for phase in mission.phases:
        begin = t
        if phase.until is not None:
            t = phase.until
        elif phase.duration is not None:
            t = begin + phase.duration
        elif phase.settle is not None:
            t = begin + min(phase.settle.timeout, phase.least_time + settling + phase.settle.dwell)
        spans.append((begin, max(t, begin + 1e-6)))
        t = spans[-1][1]
    return spans


def _settling(mission: Mission) -> float:
    c = mission.constraint
    if c.stabilisation == "none":
        return 0.0
    try:
        return pid.settling_time(c.alpha, c.beta, c.gamma)
    except ValueError:
        return 0.0


def _rate(x: Floats, time: Floats) -> Floats:
    return np.gradient(x, time, axis=0, edge_order=2)


def septic(x: Floats) -> Floats:
    """Blend of slots from 0 to 1 over x = (t - t0) / T_b, 0 before and 1 after."""
    return septic_polynomial(np.clip(x, 0.0, 1.0))
