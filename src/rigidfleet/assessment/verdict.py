"""The verdict on a flight: its checks, the numbers of each phase and notes, in words and as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from rigidfleet._common.plain import plain
from rigidfleet._common.quantities import QUANTITIES, quantity
from rigidfleet._common.text import all_hold
from rigidfleet._common.waypoints import SHAPE_TOLERANCE, WAYPOINT_TOLERANCE

if TYPE_CHECKING:
    from rich.console import RenderableType
from rigidfleet.assessment.outcome import (
    FLIPPED,
    CheckResult,
    Extreme,
    PhaseVerdict,
)

#: What a passed verdict says about a check's worst value.
_PRAISE = {
    "shape": "shapes are within {worst}",
    "waypoint_position": "waypoints are met within {worst}",
    "separation": "agents stay {worst} apart",
    "separation_flying": "{worst} in flight",
    "clearance": "obstacles stay {worst} away in flight",
    "clearance_start": "agents start {worst} above an obstacle",
    "clearance_end": "agents land {worst} above an obstacle",
    "lost": "lost vehicles stay {worst} away from the others",
    "abandoned": "phases abandoned after a loss: {worst}",
    "thrust_peak": "thrust peaks at {worst} ({who})",
    "thrust": "thrust peaks at {worst}",
    "rotor_force": "rotors peak at {worst} of {limit}",
    "tracking_error": "vehicles stay within {worst} of their slots",
}


@dataclass(frozen=True, slots=True)
class Verdict:
    """What `assess` finds: all checks, the numbers of each phase, and notes, which fail nothing.

    Attributes
    ----------
    mission, title : name and title of the mission
    checks : each check with its worst value, its limit, when and who
    phases : the numbers of each phase, in order of flight
    notes : what else to know of the flight
    uncalled : in which phases a user's controller was not called, so that the verdict is on another law; "" if in none
    covers : of a flight that others made, whom and what time "passed" covers; "" for a flight of our own
    read : of a flight that others made, what was read: vehicles, span, columns used and ignored, units and axes

    >>> import rigidfleet as rf
    >>> verdict = rf.assess(rf.simulate("square"))
    >>> verdict.passed
    True
    >>> print(verdict.summary)
    """

    mission: str
    title: str
    checks: list[CheckResult]
    phases: list[PhaseVerdict]
    notes: list[str]
    uncalled: str = ""
    covers: str = ""
    read: list[dict[str, Any]] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether every check holds."""
        return all(check.passed for check in self.checks)

    @property
    def by_name(self) -> dict[str, CheckResult]:
        """Each check by its name; of those that several phases fail, the one with the worst value."""
        found: dict[str, CheckResult] = {}
        for check in self.checks:
            rank, known = quantity(check.check).rank, found.setdefault(check.check, check)
            if check.worst is not None and known.worst is not None:
                found[check.check] = max(known, check, key=lambda c: rank(c.worst))
        return found

    @property
    def worst(self) -> dict[str, Extreme]:
        """Extremes of the whole flight, named as in `PhaseVerdict.worst`."""
        by_name: dict[str, list[Extreme]] = {}
        for phase in self.phases:
            for name, e in phase.worst.items():
                by_name.setdefault(name, []).append(e)
        return {
            name: max(by_name[name], key=lambda e: q.rank(e.value))
            for name, q in QUANTITIES.items()
            if name in by_name
        }

    @property
    def summary(self) -> str:
        """The verdict in words: the worst values of a flight that passed, or a line for each failed check.

        Then the phases in which a user's controller was not called.
        """
        told = f"\n{self.uncalled[0].upper()}{self.uncalled[1:]}." if self.uncalled else ""
        return self._judgement() + told

    def _judgement(self) -> str:
        judged = [check for check in self.checks if check.judged]
        failed = [check for check in judged if not check.passed]
        if failed:
            head = f"Failed: {len(failed)} of {len(judged)} checks."
            return "\n".join([head, *(f"- {check.message}" for check in failed)])
        found = {f.check: f for f in self.checks if f.worst is not None}
        praise = dict(_PRAISE)
        if "thrust_peak" in found:
            praise["thrust"] = "{who} comes nearest to its limit, at {worst} of {limit}"
        told = [found[name].fill(words) for name, words in praise.items() if name in found]
        head = f"Passed: {all_hold(len(judged))}"
        return (f"{head}; {', '.join(told)}." if told else f"{head}.") + self.covers

    def to_dict(self) -> dict[str, Any]:
        """The verdict as plain data that JSON can hold; None for what does not apply."""
        return plain(
            {
                "mission": self.mission,
                "title": self.title,
                "passed": self.passed,
                "summary": self.summary,
                "tolerances": {
                    "shape": SHAPE_TOLERANCE,
                    "waypoint": WAYPOINT_TOLERANCE,
                    "flip": FLIPPED,
                },
                "checks": [asdict(check) for check in self.checks],
                "notes": self.notes,
                "read": self.read,
                "worst": {name: asdict(extreme) for name, extreme in self.worst.items()},
                "phases": [asdict(phase) for phase in self.phases],
            }
        )

    def json(self) -> str:
        """The verdict as JSON text."""
        return json.dumps(self.to_dict(), ensure_ascii=False, allow_nan=False, indent=2)

    def __repr__(self) -> str:
        judged = [check for check in self.checks if check.judged]
        failed = sum(not check.passed for check in judged)
        ending = f"failed {failed} of {len(judged)}" if failed else f"passed all {len(judged)}"
        return f"<Verdict {self.mission}: {ending} checks>"

    def _repr_html_(self) -> str:
        """The verdict as a notebook shows it: the judged checks, then the summary and notes."""
        from rigidfleet._common import markup
        from rigidfleet.assessment.table import check_row

        rows = [map(str, check_row(check)) for check in self.checks if check.judged]
        words = "\n".join([self.summary, *(f"Note: {note}." for note in self.notes)])
        heads = ("check", "worst", "limit", "at [s]", "who or where", "")
        return markup.shown(self.mission, self.title, heads, rows, words)

    def __rich__(self) -> RenderableType:
        from rich.text import Text

        from rigidfleet.assessment.table import rendered

        head = Text.assemble((self.mission, "bold"), f"  {self.title}")
        notes = [Text(f"Note: {note}.", "yellow") for note in self.notes]
        summary = Text(self.summary, "bold green" if self.passed else "bold red")
        return rendered(head, self.phases, self.checks, [*notes, summary])
