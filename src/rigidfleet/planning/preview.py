"""The planned trajectory of a mission, before any flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigidfleet.mission import Mission
from rigidfleet.planning.derivatives import slot_derivatives
from rigidfleet.planning.legs import Leg, leg_of, state_at_start
from rigidfleet.typing import Floats

#: Samples of a planned phase: their number, or the time between them [s], within bounds.
_SAMPLES = 201
_STEP = 0.05
_MOST = 2001
#: Least number of samples of a phase.
FEWEST_SAMPLES = 11
#: Number of agents beyond which a tree finds those near each other (`proximity.separation`).
_MANY = 200
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
    leg : from which the paths are computed
    path_ends : if the shape changes, the agents' positions (N, 3) [m] before and after it, about the centre, in a frame
        that turns with them; in this frame all agents move straight and in step
    """

    phase: str
    time: Floats
    position: Floats
    velocity: Floats
    acceleration: Floats
    exact: bool
    leg: Leg
    path_ends: tuple[Floats, Floats] | None = None


def preview_phases(mission: Mission, legs: Sequence[Leg] = ()) -> tuple[list[PlannedPhase], bool]:
    """One `PlannedPhase` for each phase, the first by their ``legs``, and whether the plan is known to its end."""
    planned: list[PlannedPhase] = []
    most = samples_per_phase(mission)
    # If even the fewest samples of all phases are too many, only the first phases.
    possible = len(mission.phases) * min(most, FEWEST_SAMPLES) // FEWEST_SAMPLES
    most = max(most, FEWEST_SAMPLES)
    now = state_at_start(mission)
    for k, phase in enumerate(mission.phases[:possible]):
        leg = legs[k] if k < len(legs) else leg_of(mission, phase, now)
        if not leg.has_known_ways:
            return planned, False
        now = leg.planned_end_state
        planned.append(sample_leg(leg, most))
    return planned, len(planned) == len(mission.phases)


def sample_leg(leg: Leg, most: int) -> PlannedPhase:
    """At most ``most`` samples of a leg."""
    reference, motion = leg.slots_and_motion
    count = min(max(_SAMPLES, int((leg.end - leg.start) / _STEP) + 1), _MOST, most)
    time = np.linspace(leg.start, leg.end, count)
    states = slot_derivatives(reference, motion, time, 3).swapaxes(0, 1)
    straight = leg.phase.shaping is not None and not len(reference.knots)
    ways = (reference.p0, reference.p0 + reference.dp) if straight else None
    return PlannedPhase(leg.phase.name, time, *states, leg.follows_exactly, leg, ways)


def samples_per_phase(mission: Mission) -> int:
    """Number of samples of each planned phase; below `_MANY` agents, every pair is checked."""
    n = mission.n_agents
    each = n * max(1.0, n / 25) if n <= _MANY else n
    return int(_PLACES / each) // len(mission.phases)
