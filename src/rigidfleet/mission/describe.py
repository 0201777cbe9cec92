"""Describe a mission in words: its size, the target of each phase and when it ends."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rigidfleet.mission.kinds import Phase
from rigidfleet.mission.phases import latest_end
from rigidfleet.mission.values import AUTO


def size_in_words(agents: int, formations: int, phases: Sequence[Phase]) -> str:
    """Size of a mission: 3 agents, 2 formations, 12 phases, 90 s."""
    parts = [(agents, "agent"), (formations, "formation"), (len(phases), "phase")]
    most = "at most " if any(phase.settle for phase in phases) else ""
    words = [f"{n} {thing}{'s' * (n != 1)}" for n, thing in parts]
    end = latest_end(phases)
    lasts = "as long as its limits ask" if math.isnan(end) else f"{most}{end:g} s"
    return ", ".join([*words, lasts])


def goal(phase: Phase) -> str:
    """Target of a phase: a formation, a waypoint, an attitude; "" for a hold."""
    return phase.leads_to


def ending(phase: Phase) -> str:
    """Ending of a phase: a time, a duration, or settling with its timeout."""
    if phase.settle is not None:
        return f"settled, within {phase.settle.timeout:g} s"
    if phase.duration == AUTO:
        return "as soon as the limits allow"
    return f"at {phase.until:g} s" if phase.until is not None else f"after {phase.duration:g} s"
