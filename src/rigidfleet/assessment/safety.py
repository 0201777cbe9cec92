"""The safety table of a flight: worst distances, speeds, altitudes and thrusts, each with its limit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigidfleet._common.facts import Fact
from rigidfleet._common.quantities import QUANTITIES
from rigidfleet.assessment.measure import Measurements
from rigidfleet.assessment.verdict import Extreme, Verdict, limit_check
from rigidfleet.result import Result


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
    undecided : whether it may be kept or not, as far as was measured
    interval : of what was measured, from what to what the true value is
    """

    quantity: str
    text: str
    unit: str
    at_least: bool
    limit: float | None
    worst: Extreme | None
    passed: bool
    undecided: bool = False
    interval: tuple[float, float] | None = None

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
        bound = self.limit, self.at_least
        return Fact(self.quantity, worst, self.unit, *bound, interval=self.interval)

    @property
    def used(self) -> float | None:
        """Worst value as a share of the limit, 1 at the limit; None if the limit is a least value."""
        if self.at_least or not self.limit or self.worst is None:
            return None
        return self.worst.value / self.limit


def safety(result: Result, verdict: Verdict) -> list[Safety]:
    """Worst value of each quantity of a judged flight, with its limit if there is one.

    Limits are those of the verdict; those of the altitude are the geofence's. What the flight does not have, such as a
    vehicle below another one, has no row, limited or not.
    """
    measured, checks = Measurements(result), verdict.by_name
    rows = []
    for q in QUANTITIES.values():
        check = checks.get(q.name)
        if check is None and q.monitored and not q.way:
            check = limit_check(q, measured.worst(q.name), q.limit_of(result.mission), q.text)
        if not (q.key or q.limit) or check is None or (check.worst is None and check.passed):
            continue
        limit, worst = check.limit, None
        if check.worst is not None and check.when is not None:
            worst = Extreme(check.worst, check.when, check.who, check.phase, check.at_samples)
        bound = q.display_unit, q.at_least, limit if np.isfinite(limit or 0.0) else None
        judged = worst, check.passed, check.undecided, check.interval
        rows.append(Safety(q.name_in_words, q.text, *bound, *judged))
    return rows
