"""The verdict on a flight: its checks, the numbers of each phase and notes, in words and as JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

from rigidfleet._common.facts import (
    Fact,
    FactTable,
    Level,
    Line,
    Row,
    Sheet,
    Shown,
    table_of,
    table_of_worst_values,
    value,
)
from rigidfleet._common.plain import to_json_data
from rigidfleet._common.quantities import QUANTITIES, Quantity, quantity
from rigidfleet._common.text import all_hold_in_words
from rigidfleet._common.waypoints import LEEWAY, SHAPE_TOLERANCE, UNITS, WAYPOINT_TOLERANCE

#: Greatest speed downwards at touch-down [m/s]: the default of ArduPilot's LAND_SPEED.
TOUCH_DOWN = 0.5
#: Angle beyond which a plane's normal, or a line's direction, counts as flipped [deg].
FLIPPED = 90.0
#: Depth below z = 0 from which an agent is noted if the mission has no ground there [m].
DIP = 0.01
#: Levels of words for a verdict.
_LEVELS: dict[str, Level] = {"passed": "ok", "failed": "fails", "undecided": "undecided"}
#: What a passed verdict says about the worst value of a check that is of no quantity as a whole.
_PRAISE = {
    "shape": "shapes are within {worst}",
    "waypoint_position": "waypoints are met within {worst}",
    "clearance_start": "agents start {worst} above an obstacle",
    "clearance_end": "agents land {worst} above an obstacle",
    "abandoned": "phases abandoned after {who}: {worst}",
    "way_home": "{worst} apart on the way home, of {limit} promised",
    "thrust_peak": "thrust peaks at {worst} ({who})",
}


@dataclass(frozen=True, slots=True)
class Extreme:
    """Worst value of a quantity: how much, when [s], who, and in which phase; whether it is known at samples alone."""

    value: float
    when: float
    who: str
    phase: str
    at_samples: bool = False


@dataclass(frozen=True, slots=True)
class CheckResult:
    """One check.

    Attributes
    ----------
    check : what was checked, in snake_case
    passed : whether the check holds; always True for a quantity without a limit
    message : the result in words
    worst, limit : in `unit`; None where there is none
    at_least : whether the limit is the least value allowed, not the greatest
    when : mission time of the worst [s]
    who : agents, edge or obstacle; of abandoned phases, what they were left for
    phase : name of the phase
    judged : whether the check could fail; False for a value that is only reported
    at_samples : whether the worst is that of the samples, because nothing is known between them
    first : of things that touch, the first contact, where it is known
    interval : of what was measured, from what to what [`unit`] the true value is
    undecided : whether the interval has the limit inside; then it has not passed, nor failed
    """

    check: str
    passed: bool
    message: str
    worst: float | None = None
    limit: float | None = None
    unit: str = ""
    at_least: bool = False
    when: float | None = None
    who: str = ""
    phase: str = ""
    judged: bool = True
    at_samples: bool = False
    first: Extreme | None = None
    interval: tuple[float, float] | None = None
    undecided: bool = False

    @property
    def name(self) -> str:
        """What was checked, in words, marked if it is known at samples alone."""
        return self.check.replace("_", " ") + (", at samples" if self.at_samples else "")

    @property
    def fact(self) -> Fact:
        """The check to show; of things that touch, with the first contact, which is what the reader needs."""
        when, who = self.when, self.who or self.phase
        if self.first is not None:
            when, who = self.first.when, f"first {self.first.who}"
        level = "fails" if not self.passed else "ok" if self.judged else ""
        level = "undecided" if self.undecided else level
        return Fact(
            self.name,
            self.worst,
            self.unit,
            self.limit,
            self.at_least,
            when,
            who,
            level,
            self.interval,
        )

    def fill(self, words: str) -> str:
        """Words with {worst}, {limit} and {who} put in."""
        worst, limit = ("" if x is None else value(x, self.unit) for x in (self.worst, self.limit))
        return words.format(worst=worst, limit=limit, who=self.who)


@dataclass(frozen=True, slots=True)
class Waypoint:
    """Miss of a waypoint at its time [s]: [m], [m/s], [deg], [deg/s]; None for what it does not specify."""

    time: float
    position: float | None
    velocity: float | None
    attitude: float | None
    rates: float | None


@dataclass(frozen=True, slots=True)
class PhaseVerdict:
    """Numbers of one phase; None where they do not apply.

    Attributes
    ----------
    finished : whether the flight reached the end of the phase
    constraint : greatest |c| of an edge at the end [m]
    distances : greatest error of an edge against the formation's distance at the end [m]
    shape : greatest error of all pairs against the formation's slots at the end [m]
    handedness : False if a spatial shape is mirrored
    flip : angle of a plane's normal, or of a line's direction, from its intended direction [deg]
    order : False if the agents of a line are out of order
    waypoint : the miss of a waypoint
    stay : how far a phase that promises to stay is off its place at its end
    through : the misses of the points to pass on the way, in position, and in velocity where one is commanded
    worst : extremes by name: constraint |c| [m], separation [m], clearance [m], thrust [N],
        speed [m/s], acceleration [m/s^2], constraint_force [N], tension [N] (negative: a push),
        singular_value
    """

    name: str
    kind: str
    control: str
    formation: str | None
    t_start: float
    t_end: float
    settled: bool | None
    finished: bool
    constraint: float | None
    distances: float | None
    shape: float | None
    handedness: bool | None
    flip: float | None
    order: bool | None
    waypoint: Waypoint | None
    through: tuple[Waypoint, ...]
    stay: Waypoint | None
    worst: dict[str, Extreme]

    @property
    def points(self) -> list[tuple[str, Waypoint]]:
        """Points to pass on the way, the waypoint and the place to stay, as far as there are any, each in words."""
        points = [(f"point {k} on the way", w) for k, w in enumerate(self.through, start=1)]
        ends = ("the waypoint", self.waypoint), ("the place at the end", self.stay)
        return points + [(what, w) for what, w in ends if w is not None]


def keeps_limit(q: Quantity, worst: float, limit: float) -> bool:
    """Whether a worst value keeps its limit."""
    if q.at_least:
        return worst >= limit - LEEWAY and worst > 0
    return worst <= limit + LEEWAY * max(1.0, abs(limit))


def limit_check(
    q: Quantity,
    e: Extreme | None,
    limit: float | None,
    words: str = "",
    *,
    passed: bool | None = None,
    first: Extreme | None = None,
) -> CheckResult:
    """Compare a worst value with its limit, if it has one; ``first`` is the first contact."""
    at_least = q.at_least and limit is not None
    if e is None:
        words = words or q.nothing or f"the flight has no {q.name_in_words} to judge"
        return CheckResult(
            q.name, True, words, None, limit, q.unit, at_least, judged=limit is not None
        )
    words = words or q.in_words(value(e.value, q.unit), e.who, e.when, limit)
    if e.at_samples:
        words += ", at samples"
    if passed is None and limit is not None:
        passed = keeps_limit(q, e.value, limit)
    passed = passed is None or bool(passed)
    return CheckResult(
        q.name, passed, words, e.value, limit, q.unit, at_least, e.when, e.who, e.phase,
        limit is not None, e.at_samples, first,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Verdict(Shown):
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
    doubt : of a log that was judged with doubt: its noise, clock, set-up and vehicles

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
    doubt: dict[str, Any] | None = None

    @property
    def passed(self) -> bool:
        """Whether every check holds, for sure."""
        return all(check.passed for check in self.checks)

    @property
    def failures(self) -> list[CheckResult]:
        """Checks that do not hold, for sure."""
        return [check for check in self.checks if not (check.passed or check.undecided)]

    @property
    def undecided_checks(self) -> list[CheckResult]:
        """Checks of what was measured that may hold or not."""
        return [check for check in self.checks if check.undecided]

    @property
    def word(self) -> str:
        """Passed, failed or undecided."""
        return "failed" if self.failures else "undecided" if self.undecided_checks else "passed"

    @property
    def by_name(self) -> dict[str, CheckResult]:
        """Each check by its name; of those that several phases fail, the one with the worst value."""
        by_name: dict[str, CheckResult] = {}
        for check in self.checks:
            known = by_name.setdefault(check.check, check)
            if known is not check and None not in (check.worst, known.worst):
                rank = quantity(check.check).rank
                by_name[check.check] = max(known, check, key=lambda c, rank=rank: rank(c.worst))
        return by_name

    @property
    def worst(self) -> dict[str, Extreme]:
        """Extremes of the whole flight, named as in `PhaseVerdict.worst`."""
        worst: dict[str, Extreme] = {}
        for name, q in QUANTITIES.items():
            if every := [phase.worst[name] for phase in self.phases if name in phase.worst]:
                worst[name] = max(every, key=lambda e, q=q: q.rank(e.value))
        return worst

    @property
    def unkept_checks(self) -> list[CheckResult]:
        """Checks that do not hold: the failures, then those that are undecided."""
        return [*self.failures, *self.undecided_checks]

    @property
    def head(self) -> str:
        """How many checks fail or else are undecided, or that all hold, in words."""
        judged = sum(check.judged for check in self.checks)
        count = len(self.failures or self.undecided_checks)
        return f"{count} of {judged} checks" if count else all_hold_in_words(judged)

    @property
    def praise(self) -> str:
        """The worst values of a flight that passed, in words; "" for another."""
        if self.unkept_checks:
            return ""
        by_check = {f.check: f for f in self.checks if f.worst is not None}
        praise = {name: _PRAISE.get(name, quantity(name).praise) for name in by_check}
        if "thrust_peak" in by_check:
            praise["thrust"] = "{who} comes nearest to its limit, at {worst} of {limit}"
        return ", ".join(by_check[name].fill(words) for name, words in praise.items() if words)

    @property
    def summary(self) -> str:
        """The verdict in words: the worst values of a flight that passed, or a line for each check that does not hold.

        Then the phases in which a user's controller was not called.
        """
        praise = f"; {self.praise}" if self.praise else ""
        covers = "" if self.unkept_checks else self.covers
        lines = [f"{self.word.capitalize()}: {self.head}{praise}.{covers}"]
        lines += [f"- {check.message}" for check in self.unkept_checks]
        if self.uncalled:
            lines.append(f"{self.uncalled[0].upper()}{self.uncalled[1:]}.")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """The verdict as plain data that JSON can hold; None for what does not apply."""
        data = {
            "mission": self.mission,
            "title": self.title,
            "passed": self.passed,
            "summary": self.summary,
            "tolerances": {
                "shape": SHAPE_TOLERANCE,
                "waypoint": WAYPOINT_TOLERANCE,
                "flip": FLIPPED,
            },
            "checks": self.checks,
            "notes": self.notes,
            "read": self.read,
            "worst": self.worst,
            "phases": self.phases,
        }
        doubt = {} if self.doubt is None else {"verdict": self.word, "doubt": self.doubt}
        return to_json_data(data | doubt)

    def json(self) -> str:
        """The verdict as JSON text."""
        return json.dumps(self.to_dict(), ensure_ascii=False, allow_nan=False, indent=2)

    def __repr__(self) -> str:
        judged = sum(check.judged for check in self.checks)
        words = {"failed": f"failed {self.head}", "undecided": f"undecided in {self.head}"}
        return f"<Verdict {self.mission}: {words.get(self.word, f'passed all {judged} checks')}>"

    def facts(self) -> Sheet:
        """The tables of phases, waypoints and checks, the notes, and the verdict in words."""
        checks = [
            check.fact
            for check in self.checks
            if check.worst is not None or check.when is not None or not check.passed
        ]
        meaning = (
            "|c|: how far an edge's length is off the commanded one; the greatest of all edges."
        )
        parts = [
            _phase_table(self.phases),
            *([Line(meaning)] if "constraint" in self.worst else []),
            _waypoint_table(self.phases),
            table_of_worst_values("check", checks),
            *(Line(f"Note: {note}.", "note") for note in self.notes),
            Line(self.summary, _LEVELS[self.word]),
        ]
        return Sheet(self.mission, self.title, parts)


def _phase_table(phases: list[PhaseVerdict]) -> FactTable:
    """Worst values of each phase."""
    worst = ("constraint", "shape", "separation", "clearance", "speed", "thrust")
    rows = []
    for p in phases:
        values = {name: e.value for name, e in p.worst.items()} | {"shape": p.shape}
        rows.append(Row((p.name, f"{p.t_end:.2f}", p.constraint, *map(values.get, worst))))
    heads = ("phase", "end [s]", "|c| at end [m]", "worst |c| [m]", "shape off [m]", "apart [m]",
             "clear [m]", "speed [m/s]", "thrust [N]")  # fmt: skip
    return FactTable(heads, rows)


def _waypoint_table(phases: list[PhaseVerdict]) -> FactTable:
    """Miss of each waypoint and place to stay, in position, velocity, attitude and rates."""
    rows = []
    for p in phases:
        for what, w in p.points:
            name = p.name if w is p.waypoint else f"{p.name}, {what}"
            misses = {f"{what} [{unit}]": getattr(w, what) for what, unit in UNITS.items()}
            rows.append({"waypoint, missed by": name, "at [s]": f"{w.time:.2f}"} | misses)
    return table_of(rows)
