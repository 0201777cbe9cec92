"""Metrics of a sweep: their list, and their values from a verdict."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rigidfleet.assessment import Verdict
    from rigidfleet.result import Result


@dataclass(frozen=True)
class Metric:
    """Unit and meaning of a metric."""

    unit: str
    text: str


METRICS: dict[str, Metric] = {
    "shape_end": Metric("m", "shape error at the end: largest error of all pair distances"),
    "shape": Metric("m", "largest shape error at the end of a phase"),
    "constraint_end": Metric("m", "largest constraint error |c| = |L - d| at the end"),
    "constraint": Metric(
        "m", "largest constraint error |c| = |L - d|: edge length minus reference"
    ),
    "handed": Metric("1", "1: right-handed at the end of every phase; 0: mirrored"),
    "flip": Metric("deg", "largest angle of a plane or line from its intended direction"),
    "waypoint_position": Metric("m", "largest position error at a waypoint"),
    "waypoint_velocity": Metric("m s-1", "largest velocity error at a waypoint"),
    "waypoint_attitude": Metric("deg", "largest attitude error at a waypoint"),
    "waypoint_rates": Metric("deg s-1", "largest error of body rates at a waypoint"),
    "separation": Metric("m", "minimum separation of two agents: centre distance minus radii"),
    "separation_below": Metric("m", "minimum height above another agent minus radii"),
    "clearance": Metric("m", "minimum clearance to an obstacle: distance minus radius"),
    "geofence": Metric("m", "maximum distance outside the geofence; negative inside"),
    "thrust": Metric("N", "thrust closest to or farthest beyond its limit; peak if there is none"),
    "speed": Metric("m s-1", "maximum speed"),
    "acceleration": Metric("m s-2", "maximum acceleration"),
    "constraint_force": Metric("N", "maximum constraint force on an agent"),
    "tension": Metric("N", "tension of largest magnitude in an edge; negative: compression"),
    "singular_value": Metric("1", "smallest singular value of the constraint Jacobian"),
    "flown": Metric("s", "mission time at the end"),
    "steps": Metric("1", "steps of the integrator"),
    "evaluations": Metric("1", "evaluations of the right-hand side"),
}


def readable(unit: str) -> str:
    """A unit for display: m/s² for m s-2."""
    words = {"1": "-", "m s-1": "m/s", "m s-2": "m/s²", "deg s-1": "deg/s"}
    return words.get(unit, unit)


def measure(result: Result, verdict: Verdict) -> dict[str, float]:
    """Value of every metric of a flight; NaN if it does not apply."""
    phases = verdict.phases
    shapes = [p.shape for p in phases if p.shape is not None]
    hands = [float(p.handedness) for p in phases if p.handedness is not None]
    found = {
        "shape_end": shapes[-1] if shapes else math.nan,
        "shape": _greatest(shapes),
        "constraint_end": _greatest(p.constraint for p in phases[-1:]),
        "handed": min(hands, default=math.nan),
        "flip": _greatest(p.flip for p in phases),
        "flown": float(result.time[-1]),
        "steps": float(result.statistics["steps"]),
        "evaluations": float(result.statistics["evaluations"]),
    }
    for name in ("position", "velocity", "attitude", "rates"):
        misses = (getattr(p.waypoint, name) for p in phases if p.waypoint is not None)
        found[f"waypoint_{name}"] = _greatest(misses)
    checked = {f.check: f.worst for f in verdict.checks if f.worst is not None}
    worst = {name: extreme.value for name, extreme in verdict.worst.items()}
    worst |= {
        name: checked[name]
        for name in ("separation_below", "geofence", "thrust")
        if name in checked
    }
    return {name: float((worst | found).get(name, math.nan)) for name in METRICS}


def _greatest(values: Iterable[float | None]) -> float:
    return max((v for v in values if v is not None), default=math.nan)
