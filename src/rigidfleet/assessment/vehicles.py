"""Checks of vehicles with rotors: forces of rotors, saturation, tilt and tracking error."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rigidfleet._common.text import percent
from rigidfleet.assessment.measure import Measurements
from rigidfleet.assessment.outcome import SLACK, CheckResult, Extreme, bounded, value
from rigidfleet.math import attitude as att
from rigidfleet.result import LABELS
from rigidfleet.typing import Floats


def vehicle_checks(measured: Measurements) -> Iterator[CheckResult]:
    """Checks of a flight by vehicles; none of a flight of point masses."""
    mission, result = measured.mission, measured.result
    models = mission.vehicle_models
    if models is None or result.rotor_force is None:
        return
    limits = mission.limits
    rotors = np.array([model.rotor_limit for model in models])
    if rotors.any():
        yield from _rotor_force(measured, rotors)
        share = measured.worst("saturation", None)
        if share is not None:
            yield _saturation(share, limits.saturation)
        tilt = _tilt(measured)
        if tilt is not None:
            yield bounded("tilt", tilt, "deg", limits.tilt_deg)


def tracking_check(measured: Measurements) -> Iterator[CheckResult]:
    """Check how far agents are off the slots that they track: of vehicles at every tick, of points at samples."""
    limit = measured.mission.limits.tracking_error
    error = None
    if measured.result.interpolation is None:  # the curves of others are their own slots
        error = measured.among("tracking_error", measured.off_slot)
    if error is not None or limit is not None:
        yield bounded("tracking_error", error, "m", limit, "" if error else "no slots are tracked")


def _rotor_force(measured: Measurements, limits: Floats) -> Iterator[CheckResult]:
    """The rotor nearest to its limit, from step to step and at samples."""
    result, names = measured.result, LABELS["rotor"]
    assert result.rotor_force is not None
    safe = np.where(limits > 0.0, limits, np.inf)
    found = [
        (x.value / safe[x.who], x.value, x.time, x.who, x.other, p.name)
        for p in result.phases
        if (x := p.extremes.get("rotor_force")) is not None
    ]
    force = np.where(measured.left[..., None], result.rotor_force, 0.0)
    k, i, j = np.unravel_index(int((force / safe[:, None]).argmax()), force.shape)
    name = result.phases[result.phase[k]].name
    worst = float(force[k, i, j])
    found.append((worst / safe[i], worst, float(result.time[k]), int(i), int(j), name))
    share, worst, when, i, j, phase = max(found)
    limit, e = float(limits[i]), Extreme(worst, when, f"agent {i + 1}", phase, len(found) == 1)
    words = (
        f"the {names[j]} rotor of {e.who} gives up to {value(worst, 'N')} at {when:.2f} s"
        f" (limit {value(limit, 'N')})"
    )
    yield bounded("rotor_force", e, "N", limit, words, passed=share <= 1.0 + SLACK)


def _saturation(e: Extreme, limit: float) -> CheckResult:
    """Share of a phase in which a vehicle cannot give what is asked of it."""
    words = (
        f"{e.who} cannot give what is asked of it for {percent(e.value)} of phase '{e.phase}'"
        f" (limit {percent(limit)})"
    )
    if e.value == 0.0:
        words = "no vehicle is asked for more than its rotors give"
        return CheckResult("saturation", True, words, 0.0, 100 * limit, "%")
    return bounded("saturation", replace(e, value=100 * e.value), "%", 100 * limit, words)


def _tilt(measured: Measurements) -> Extreme | None:
    """The greatest tilt [deg], from step to step and at samples."""
    result = measured.result
    assert result.vehicle_attitude is not None
    up = att.dcm_from_quaternion(result.vehicle_attitude)[..., 2, 2]
    angle = measured.of_left(np.arccos(np.clip(up, -1.0, 1.0)))
    e = measured.among("tilt", angle)
    return None if e is None else replace(e, value=math.degrees(e.value))
