"""Metrics of a sweep: their list, and their values from a verdict."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rigidfleet._common.facts import display_unit
from rigidfleet._common.quantities import QUANTITIES
from rigidfleet.math import proximity
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


#: Units as files of arrays have them.
_NOTATION = {
    "m/s": "m s-1", "m/s^2": "m s-2", "m/s^3": "m s-3", "deg/s": "deg s-1", "%": "1", "": "1",
}  # fmt: skip

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
    "tracking_rms": Metric("m", "root mean square over time of the largest of these distances"),
    "constraint_end": Metric("m", "largest constraint error |c| = |L - d| at the end"),
    "handed": Metric("1", "1: right-handed at the end of every phase; 0: mirrored"),
    "flip": Metric("deg", "largest angle of a plane or line from its intended direction"),
    "waypoint_position": Metric("m", "largest position error at a waypoint or stay"),
    "waypoint_velocity": Metric("m s-1", "largest velocity error at a waypoint or stay"),
    "waypoint_attitude": Metric("deg", "largest attitude error at a waypoint or stay"),
    "waypoint_rates": Metric("deg s-1", "largest error of body rates at a waypoint or stay"),
    **{
        q.name: Metric(_NOTATION.get(q.unit, q.unit), q.text)
        for q in QUANTITIES.values()
        if q.checked
    },
    "rotor_share": Metric(
        "1", "rotor force closest to its limit, as a share of it; only of vehicles with rotors"
    ),
    "flown": Metric("s", "mission time at the end"),
    "steps": Metric("1", "steps of the integrator"),
    "evaluations": Metric("1", "evaluations of the right-hand side"),
}


def readable_unit(unit: str) -> str:
    """A unit for display: m/s² for m s-2."""
    words = {code: unit for unit, code in _NOTATION.items()} | {"1": "-"}
    return display_unit(words.get(unit, unit))


def measure_metrics(result: Result, verdict: Verdict) -> dict[str, float]:
    """Value of every metric of a flight; NaN if it does not apply."""
    phases = verdict.phases
    shapes = [p.shape for p in phases if p.shape is not None]
    hands = [float(p.handedness) for p in phases if p.handedness is not None]
    values = {
        "shape_end": shapes[-1] if shapes else math.nan,
        "shape": _greatest_known(shapes),
        "constraint_end": _greatest_known(p.constraint for p in phases[-1:]),
        "handed": min(hands, default=math.nan),
        "flip": _greatest_known(p.flip for p in phases),
        "flown": float(result.time[-1]),
        "steps": float(result.statistics["steps"]),
        "evaluations": float(result.statistics["evaluations"]),
    }
    values |= _shape_and_tracking_errors(result)
    for name in ("position", "velocity", "attitude", "rates"):
        misses = (getattr(w, name) for p in phases for w in (p.waypoint, p.stay) if w)
        values[f"waypoint_{name}"] = _greatest_known(misses)
    checks = verdict.by_name
    worst = {name: f.worst for name, f in checks.items() if f.worst is not None}
    if (rotor := checks.get("rotor_force")) is not None:
        worst["rotor_share"] = (rotor.worst or 0.0) / (rotor.limit or math.inf)
    if "saturation" in worst:
        worst["saturation"] /= 100.0
    # Of clearances, those of vehicles that stand on an obstacle count, too.
    worst |= {name: e.value for name, e in verdict.worst.items() if name != "thrust"}
    worst |= values
    return {name: float(worst.get(name, math.nan)) for name in METRICS}


def _greatest_known(values: Iterable[float | None]) -> float:
    return max((v for v in values if v is not None), default=math.nan)


def _shape_and_tracking_errors(result: Result) -> dict[str, float]:
    """Errors of shape and of tracking at all samples, lost vehicles left out."""
    off = np.ascontiguousarray((_flying_positions(result) - result.slot_position).T)
    apart, shape = _column_maxima(proximity.root_of_squares(off)), shape_errors(result)
    tracked = np.isfinite(apart)
    errors = {
        ("shape_flight", "shape_rms"): shape,
        ("shape_tracked", "shape_tracked_rms"): shape[tracked],
        ("shape_forces", ""): shape[~tracked],
        ("tracking_error", "tracking_rms"): apart,
    }
    values = {}
    for (name, mean), error in errors.items():
        there = error[np.isfinite(error)]
        values[name] = float(there.max()) if len(there) else math.nan
        values[mean] = float(np.sqrt(np.mean(there**2))) if len(there) else math.nan
    return values


def shape_errors(result: Result) -> Floats:
    """Largest error (K,) [m] of a distance at each sample: of all pairs, where slots are tracked, against their slots.

    Elsewhere, and with many agents, it is that of the edges against their references. NaN if there are none.
    """
    error = _column_maxima(np.abs(np.ascontiguousarray(result.constraint.T)))
    n = result.position.shape[1]
    if n < 2 or n > _PAIRED:
        return error
    pairs = proximity.all_pairs(n).T
    flown, due = (
        proximity.pair_distances(x, pairs)
        for x in (_flying_positions(result), result.slot_position)
    )
    flown -= due
    return np.fmax(error, _column_maxima(np.abs(flown, out=flown)))


def _flying_positions(result: Result) -> Floats:
    """Positions (K, N, 3) [m]; NaN of agents that are lost."""
    left = result.left
    return result.position if left.all() else np.where(left[..., None], result.position, np.nan)


def _column_maxima(values: Floats) -> Floats:
    """Greatest finite value (K,) of each column of values (M, K); NaN if there is none."""
    return np.fmax.reduce(values, axis=0, initial=np.nan)
