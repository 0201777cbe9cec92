"""The safety table of a flight: worst distances, speeds, altitudes and thrusts, each with its limit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigidfleet._common.facts import Fact
from rigidfleet.assessment.measure import Measurements
from rigidfleet.assessment.outcome import CheckResult, Extreme
from rigidfleet.assessment.verdict import Verdict
from rigidfleet.result import DIRECTIONS, Result


@dataclass(frozen=True, slots=True)
class Safety:
    """The worst value of one quantity.

    Attributes
    ----------
    quantity : its name
    text : what it measures
    unit : of the worst value and of its limit
    at_least : whether the limit is the least value allowed, not the greatest
    limit : None if the mission sets none
    worst : None if there is nothing to measure
    passed : whether the limit is kept; True if there is none
    """

    quantity: str
    text: str
    unit: str
    at_least: bool
    limit: float | None
    worst: Extreme | None
    passed: bool

    @property
    def margin(self) -> float | None:
        """Margin to the limit, in `unit`; negative beyond it."""
        if self.limit is None or self.worst is None:
            return None
        rest = self.limit - self.worst.value
        return -rest if self.at_least else rest

    @property
    def fact(self) -> Fact:
        """The quantity to show."""
        worst = None if self.worst is None else self.worst.value
        return Fact(self.quantity, worst, self.unit, self.limit, self.at_least)

    @property
    def used(self) -> float | None:
        """Worst value as a share of the limit, 1 at the limit; None if the limit is a least value."""
        if self.at_least or not self.limit or self.worst is None:
            return None
        return self.worst.value / self.limit


def safety(result: Result, verdict: Verdict) -> list[Safety]:
    """Worst value of each quantity of a judged flight, with its limit if there is one.

    Limits are those of the verdict; those of the altitude are the geofence's. Flights by vehicles with rotors have
    rows of their own at the end, and so has the distance from slots that are tracked.
    """
    measured = Measurements(result)
    found = {check.check: check for check in verdict.checks}
    rows = [
        _row(
            "proximity", "least distance between two vehicles' surfaces",
            found.get("separation"), "m", at_least=True,
        ),
        *(
            _row("proximity in flight", "the same, one at limits.separation_altitude or above", f, "m", at_least=True)
            for f in verdict.checks if f.check == "separation_flying"
        ),
        _row(
            "downwash", "least height between surfaces of two vehicles, one below the other",
            found.get("separation_below"), "m", at_least=True, worst=measured.below(),
        ),
        _row("speed", "greatest speed of a vehicle", found.get("speed"), "m/s"),
        _row("acceleration", "greatest acceleration of a vehicle", found.get("acceleration"), "m/s²"),
        *_directions(found),
        *_altitudes(measured),
        _row(
            "geofence", "least distance of a vehicle's centre to the geofence, from inside",
            _from_inside(found.get("geofence")), "m", at_least=True,
        ),
        _row("thrust", "greatest thrust of a vehicle", found.get("thrust"), "N"),
        _row(
            "clearance", "least distance of a vehicle's surface to an obstacle or the ground",
            found.get("clearance"), "m", at_least=True,
        ),
    ]  # fmt: skip
    return rows + [
        _row(name.replace("_", " "), text, found.get(name), unit)
        for name, text, unit in (
            ("rotor_force", "force of the rotor that comes nearest to its limit", "N"),
            ("saturation", "greatest share of a phase in which a vehicle is asked for more than its rotors give", "%"),
            ("tilt", "greatest tilt of a vehicle", "deg"),
            ("tracking_error", "greatest distance of a vehicle from its slot", "m"),
        )
        if name in found or "rotor_force" in found
    ]  # fmt: skip


def _directions(found: dict[str, CheckResult]) -> list[Safety]:
    """Rows of the speeds and accelerations over the ground, and up and down, that are limited."""
    rows = [(name.replace("_", " "), found[name]) for name in DIRECTIONS if name in found]
    return [
        _row(words, f"greatest {words} of a vehicle", f, f.unit.replace("^2", "²"))
        for words, f in rows
    ]


def _row(
    quantity: str,
    text: str,
    finding: CheckResult | None,
    unit: str,
    *,
    at_least: bool = False,
    worst: Extreme | None = None,
) -> Safety:
    if finding is None:
        return Safety(quantity, text, unit, at_least, None, worst, True)
    if finding.worst is not None and finding.when is not None:
        worst = Extreme(finding.worst, finding.when, finding.who, finding.phase, finding.at_samples)
    limit = finding.limit if finding.limit is not None and np.isfinite(finding.limit) else None
    return Safety(quantity, text, unit, at_least, limit, worst, finding.passed)


def _from_inside(finding: CheckResult | None) -> CheckResult | None:
    """The geofence's finding; its worst value becomes the distance inside the geofence, not outside."""
    if finding is None or finding.worst is None:
        return finding
    return replace(finding, worst=-finding.worst)


def _altitudes(measured: Measurements) -> list[Safety]:
    fence = measured.mission.limits.geofence
    lowest, highest = measured.height(lowest=True), measured.height(lowest=False)
    floor, ceiling = (None, None) if fence is None else (fence.min[2], fence.max[2])
    rows = [
        Safety("lowest", "least altitude of a vehicle's centre", "m", True, floor, lowest, True),
        Safety(
            "highest", "greatest altitude of a vehicle's centre", "m", False, ceiling, highest, True
        ),
    ]
    return [replace(row, passed=row.margin is None or row.margin >= -1e-9) for row in rows]
