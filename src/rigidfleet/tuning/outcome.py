"""Result of a study: gains, errors and margins, before and after."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rigidfleet._common.facts import FactTable, Line, Row, Sheet, Shown
from rigidfleet._common.plain import to_json_data
from rigidfleet._common.renamed import with_earlier_members
from rigidfleet.math.margins import Margins
from rigidfleet.sweep.record import reason_in_words
from rigidfleet.tuning.gains import Gains

_WORDS = {
    "shape_tracked": "largest shape error with slots",
    "shape_tracked_rms": "r.m.s. of it over time",
    "shape_forces": "largest shape error without slots",
    "tracking_error": "largest position error",
    "tracking_rms": "position error, r.m.s.",
}


@dataclass(frozen=True)
class Flown:
    """Flights with some gains.

    Attributes
    ----------
    gains : by path in the mission
    passed, ended, flights : numbers of flights that passed their verdict, of those that ended early, of all
    values : values of each metric [m], one for each flight; NaN if it does not apply
    reasons : number of flights that failed each check
    """

    gains: Gains
    passed: int
    ended: int
    flights: int
    values: dict[str, list[float]]
    reasons: dict[str, int] = field(default_factory=dict)

    def mean(self, metric: str) -> float:
        """Mean of a metric over the flights [m]; NaN if it does not apply."""
        return float(np.mean(self.values[metric]))

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "gains": self.gains, "flights": self.flights, "passed": self.passed, "ended_early": self.ended,
            "failed_checks": self.reasons,
            "mean_m": {name: self.mean(name) for name in self.values}, "values_m": self.values,
        }  # fmt: skip


@with_earlier_members(rows="table_rows")
@dataclass
class Tuned(Shown):
    """Result of a study; print it to see both sides.

    Attributes
    ----------
    mission : its name
    objective, metric : what was minimised, and its metric
    before, after : flights of the search with the mission's own gains, and with the best
    margins : of each law with these gains, before and after; empty for points
    flights, candidates, refused : numbers of flights of the search, of gains that were flown, and of gains that were
        refused for their margins
    validation : flights with the own and with the best gains on seeds that the search has not seen; None if nothing
        in the flight is random
    text : the mission with the best gains, TOML
    file : where it was written
    """

    mission: str
    objective: str
    metric: str
    before: Flown
    after: Flown
    margins: tuple[dict[str, Margins], dict[str, Margins]]
    flights: int
    candidates: int
    refused: int
    validation: tuple[Flown, Flown] | None = None
    text: str = field(default="", repr=False)
    file: Path | None = None

    @property
    def improvement(self) -> float:
        """Share by which the objective is smaller, on seeds that the search has not seen if there are any."""
        before, after = self.validation or (self.before, self.after)
        return 1.0 - after.mean(self.metric) / before.mean(self.metric)

    @property
    def is_worse(self) -> bool:
        """Whether the best gains of the search are no better on new seeds, so that the mission keeps its own."""
        if self.validation is None:
            return False
        before, after = self.validation
        return after.passed < before.passed or (
            after.passed == before.passed and not self.improvement > 0
        )

    @property
    def conclusion(self) -> str:
        """The result in a sentence."""
        words = f"{_WORDS[self.metric].capitalize()}"
        if self.after.gains == self.before.gains:
            return f"{words}: no better gains were found; the mission keeps its own."
        if not math.isfinite(self.improvement):
            return f"{words}: unknown, because some flights did not reach their end."
        where = "on new seeds" if self.validation else "in the flights of the search"
        side = "smaller" if self.improvement >= 0 else "larger"
        kept = "; the mission keeps its own gains" if self.is_worse else ""
        return f"{words}: {100 * abs(self.improvement):.0f} % {side} {where}{kept}."

    def to_dict(self) -> dict[str, Any]:
        """The result as plain data; quantities that are not finite are None."""
        seen, (before, after) = self.validation, self.margins
        data = {
            "result": {
                "mission": self.mission, "objective": self.objective, "improvement": self.improvement,
                "flights": self.flights, "candidates": self.candidates, "refused": self.refused,
                "before": self.before.to_dict(), "after": self.after.to_dict(),
                "validation": None if seen is None else {
                    "before": seen[0].to_dict(), "after": seen[1].to_dict()
                },
                "margins": {"before": before, "after": after},
                "file": None if self.file is None else str(self.file),
            }
        }  # fmt: skip
        return to_json_data(data)

    def __str__(self) -> str:
        from rich.console import Console

        console = Console(width=200, file=io.StringIO())
        with console.capture() as capture:
            console.print(self)
        return "\n".join(line.rstrip() for line in capture.get().splitlines())

    def facts(self) -> Sheet:
        """Gains, errors and margins on both sides, and the conclusion."""
        table = FactTable(("", "before", "after", "change"), [*map(Row, self.table_rows())])
        flights = f"{self.flights} flights of {self.candidates} choice{'s' * (self.candidates != 1)} of gains"
        title = f"{flights}; {self.refused} refused for their margins"
        return Sheet(self.mission, title, [table, Line(self.conclusion)])

    def table_rows(self) -> list[tuple[str, str, str, str]]:
        """Rows of the table: what, before, after, change."""
        rows = [
            (path, f"{gain:.4g}", f"{self.after.gains[path]:.4g}", "")
            for path, gain in self.before.gains.items()
        ]
        rows += self._flight_rows("tuning", self.before, self.after, [self.metric])
        if self.validation is not None:
            rows += self._flight_rows("new", *self.validation, list(_WORDS))
        for law, was in self.margins[0].items():
            now = self.margins[1][law]
            for what, read in _MARGINS.items():
                rows.append((f"{law}: {what}", read(was), read(now), ""))
        return rows

    def _flight_rows(
        self, which: str, before: Flown, after: Flown, metrics: list[str]
    ) -> list[tuple[str, str, str, str]]:
        """Rows of the flights on some seeds."""
        rows = []
        for name in metrics:
            a, b = before.mean(name), after.mean(name)
            if math.isfinite(a) and math.isfinite(b):
                change = f"{100 * (b / a - 1):+.0f} %" if a > 0 else ""
                rows.append((f"{_WORDS[name]} [m], {which} seeds", f"{a:.4f}", f"{b:.4f}", change))
        was, now = (f"{x.passed} of {x.flights}" for x in (before, after))
        rows.append((f"passed, {which} seeds", was, now, ""))
        for reason in {**before.reasons, **after.reasons}:
            was, now = (str(x.reasons.get(reason, 0)) for x in (before, after))
            rows.append((f"failed '{reason_in_words(reason)}', {which} seeds", was, now, ""))
        return rows


_MARGINS = {
    "phase margin [deg]": lambda m: f"{math.degrees(m.phase):.1f}" if m.stable else "unstable",
    "delay margin [ms]": lambda m: f"{1e3 * m.delay:.0f}" if m.stable else "unstable",
    "gains times": lambda m: f"{m.gain[0]:.2g} to {m.gain[1]:.3g}" if m.stable else "unstable",
}
