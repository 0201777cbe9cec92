"""Metrics of a sweep: their list, and their values from a verdict."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rigidfleet.math import proximity
from rigidfleet.result import DIRECTIONS
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from rigidfleet.assessment import Verdict
    from rigidfleet.result import Result


#: Greatest number of agents whose pairs are all compared with those of their slots; beyond, edges alone are.
_PAIRED = 100


@dataclass(frozen=True)
class Metric:
    """Unit and meaning of a metric."""

    unit: str
    text: str


METRICS: dict[str, Metric] = {
    "shape_end": Metric("m", "shape error at the end: largest error of all pair distances"),
    "shape": Metric("m", "largest shape error at the end of a phase"),
    "shape_flight": Metric(
        "m",
        "largest shape error in flight, at samples: of all pairs of tracked slots, else of the edges against their"
        " references",
    ),
    "shape_rms": Metric("m", "root mean square over time of the largest of these errors"),
    "shape_tracked": Metric("m", "largest shape error with slots in flight, at samples"),
    "shape_tracked_rms": Metric("m", "root mean square of these errors over time"),
    "shape_forces": Metric("m", "largest shape error by constraint forces alone, at samples"),
    "tracking_error": Metric("m", "largest distance of a vehicle from its slot, at samples"),
    "tracking_rms": Metric("m", "root mean square over time of the largest of these distances"),
    "constraint_end": Metric("m", "largest constraint error |c| = |L - d| at the end"),
    "constraint": Metric(
        "m", "largest constraint error |c| = |L - d|: edge length minus reference"
    ),
    "handed": Metric("1", "1: right-handed at the end of every phase; 0: mirrored"),
    "flip": Metric("deg", "largest angle of a plane or line from its intended direction"),
    "waypoint_position": Metric("m", "largest position error at a waypoint or stay"),
    "waypoint_velocity": Metric("m s-1", "largest velocity error at a waypoint or stay"),
    "waypoint_attitude": Metric("deg", "largest attitude error at a waypoint or stay"),
    "waypoint_rates": Metric("deg s-1", "largest error of body rates at a waypoint or stay"),
    "separation": Metric("m", "minimum separation of two agents: centre distance minus radii"),
    "separation_below": Metric("m", "minimum height above another agent minus radii"),
    "separation_flying": Metric("m", "minimum separation from limits.separation_altitude on"),
    "clearance": Metric("m", "minimum clearance to an obstacle: distance minus radius"),
    "geofence": Metric("m", "maximum distance outside the geofence; negative inside"),
    "thrust": Metric("N", "thrust closest to or farthest beyond its limit; peak if there is none"),
    "rotor_share": Metric(
        "1", "rotor force closest to its limit, as a share of it; only of vehicles with rotors"
    ),
    "saturation": Metric(
        "1", "largest share of a phase in which a vehicle is asked for more than its rotors give"
    ),
    "tilt": Metric("deg", "maximum tilt of a vehicle with rotors"),
    "speed": Metric("m s-1", "maximum speed"),
    "acceleration": Metric("m s-2", "maximum acceleration"),
    "horizontal_speed": Metric("m s-1", "maximum speed over the ground, if it has a limit"),
    "vertical_speed": Metric("m s-1", "maximum speed up and down, if it has a limit"),
    "horizontal_acceleration": Metric("m s-2", "maximum horizontal acceleration, if limited"),
    "vertical_acceleration": Metric("m s-2", "maximum acceleration up and down, if limited"),
    "constraint_force": Metric("N", "maximum constraint force on an agent"),
    "tension": Metric("N", "tension of largest magnitude in an edge; negative: compression"),
    "singular_value": Metric("1", "smallest singular value of the constraint Jacobian"),
    "flown": Metric("s", "mission time at the end"),
    "steps": Metric("1", "steps of the integrator"),
    "evaluations": Metric("1", "evaluations of the right-hand side"),
}


#: Metrics that are the worst values of checks.
_OF_CHECKS = "separation_below", "separation_flying", "geofence", "thrust", "tilt", *DIRECTIONS


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
    found |= _in_flight(result)
    for name in ("position", "velocity", "attitude", "rates"):
        misses = (getattr(w, name) for p in phases for w in (p.waypoint, p.stay) if w)
        found[f"waypoint_{name}"] = _greatest(misses)
    worst = {name: extreme.value for name, extreme in verdict.worst.items()}
    for f in verdict.checks:
        if f.worst is None:
            continue
        if f.check in _OF_CHECKS:
            worst[f.check] = f.worst
        elif f.check == "rotor_force" and f.limit is not None:
            worst["rotor_share"] = f.worst / f.limit
        elif f.check == "saturation":
            worst["saturation"] = f.worst / 100.0
    return {name: float((worst | found).get(name, math.nan)) for name in METRICS}


def _greatest(values: Iterable[float | None]) -> float:
    return max((v for v in values if v is not None), default=math.nan)


def _in_flight(result: Result) -> dict[str, float]:
    """Errors of shape and of tracking at all samples, lost vehicles left out."""
    off = np.ascontiguousarray((_left(result) - result.slot_position).T)
    apart, shape = _most(proximity.root_of_squares(off)), shape_errors(result)
    tracked = np.isfinite(apart)
    errors = {
        ("shape_flight", "shape_rms"): shape,
        ("shape_tracked", "shape_tracked_rms"): shape[tracked],
        ("shape_forces", ""): shape[~tracked],
        ("tracking_error", "tracking_rms"): apart,
    }
    found = {}
    for (name, mean), error in errors.items():
        there = error[np.isfinite(error)]
        found[name] = float(there.max()) if len(there) else math.nan
        found[mean] = float(np.sqrt(np.mean(there**2))) if len(there) else math.nan
    return found


def shape_errors(result: Result) -> Floats:
    """Largest error (K,) [m] of a distance at each sample: of all pairs, where slots are tracked, against their slots.

    Elsewhere, and with many agents, it is that of the edges against their references. NaN if there are none.
    """
    error = _most(np.abs(np.ascontiguousarray(result.constraint.T)))
    n = result.position.shape[1]
    if n < 2 or n > _PAIRED:
        return error
    pairs = proximity.all_pairs(n).T
    flown, asked = (proximity.lengths(x, pairs) for x in (_left(result), result.slot_position))
    flown -= asked
    return np.fmax(error, _most(np.abs(flown, out=flown)))


def _left(result: Result) -> Floats:
    """Positions (K, N, 3) [m]; NaN of agents that are lost."""
    left = result.left
    return result.position if left.all() else np.where(left[..., None], result.position, np.nan)


def _most(values: Floats) -> Floats:
    """Greatest finite value (K,) of each column of values (M, K); NaN if there is none."""
    return np.fmax.reduce(values, axis=0, initial=np.nan)
