"""A mission in words: how much of everything it has; what a phase leads to, and when it ends."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rigidfleet.mission.schema import Phase

if TYPE_CHECKING:
    from rigidfleet.mission.model import Mission


def counted(mission: Mission) -> str:
    """How much of everything a mission has: 3 agents, 2 formations, 12 phases, 90 s."""
    parts = [
        (mission.n_agents, "agent"),
        (len(mission.formations), "formation"),
        (len(mission.phases), "phase"),
    ]
    most = "at most " if any(phase.settle for phase in mission.phases) else ""
    words = [f"{n} {thing}{'s' * (n != 1)}" for n, thing in parts]
    return ", ".join([*words, f"{most}{mission.latest_end:g} s"])


def goal(phase: Phase) -> str:
    """What a phase leads to; "" for a hold."""
    return phase.leads_to


def ending(phase: Phase) -> str:
    """When a phase ends."""
    if phase.settle is not None:
        return f"settled, within {phase.settle.timeout:g} s"
    return f"at {phase.until:g} s" if phase.until is not None else f"after {phase.duration:g} s"
