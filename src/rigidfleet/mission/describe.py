"""Describe a mission in words: its size, the target of each phase and when it ends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rigidfleet.mission.schema import Establish, Fly, Hold, Phase, Reshape, Steering

if TYPE_CHECKING:
    from rigidfleet.mission.model import Mission


def counted(mission: Mission) -> str:
    """Size of a mission: 3 agents, 2 formations, 12 phases, 90 s."""
    parts = [
        (mission.n_agents, "agent"),
        (len(mission.formations), "formation"),
        (len(mission.phases), "phase"),
    ]
    most = "at most " if any(phase.settle for phase in mission.phases) else ""
    words = [f"{n} {thing}{'s' * (n != 1)}" for n, thing in parts]
    return ", ".join([*words, f"{most}{mission.latest_end:g} s"])


def goal(phase: Phase) -> str:
    """Target of a phase: a formation, a waypoint, an attitude; "" for a hold."""
    if isinstance(phase, Hold):
        return ""
    if isinstance(phase, Reshape):
        return phase.formation
    parts = []
    if isinstance(phase, Establish):
        parts.append(phase.formation)
    if isinstance(phase, Fly):
        parts.append(_vector(phase.position, "m"))
        if any(phase.velocity):
            parts.append(_vector(phase.velocity, "m/s"))
    if phase.attitude_deg is not None:
        angles = zip(("roll", "pitch", "yaw"), phase.attitude_deg, strict=True)
        parts += [f"{name} {angle:g}°" for name, angle in angles if angle or name == "yaw"]
    if isinstance(phase, Steering) and any(phase.rates_deg_s):
        parts.append(_vector(phase.rates_deg_s, "°/s"))
    return ", ".join(parts)


def ending(phase: Phase) -> str:
    """Ending of a phase: a time, a duration, or settling with its timeout."""
    if phase.settle is not None:
        return f"settled, within {phase.settle.timeout:g} s"
    return f"at {phase.until:g} s" if phase.until is not None else f"after {phase.duration:g} s"


def _vector(values: Sequence[float], unit: str) -> str:
    return f"({', '.join(f'{value:g}' for value in values)}) {unit}"
