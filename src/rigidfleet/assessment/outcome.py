"""The outcome of checks, phases and waypoints."""

from __future__ import annotations

from dataclasses import dataclass

from rigidfleet._common.facts import Fact, value
from rigidfleet._common.quantities import Quantity

#: Share of a limit, or of a unit if this is more, by which rounding may exceed it.
SLACK = 1e-9

#: Greatest speed downwards at touch-down [m/s]: the default of ArduPilot's LAND_SPEED.
TOUCH_DOWN = 0.5


#: Angle beyond which a plane's normal, or a line's direction, counts as flipped [deg].
FLIPPED = 90.0


#: Depth below z = 0 from which an agent is noted if the mission has no ground [m].
DIP = 0.01


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


def keeps_limit(q: Quantity, worst: float, limit: float) -> bool:
    """Whether a worst value keeps its limit."""
    if q.at_least:
        return worst >= limit - SLACK and worst > 0
    return worst <= limit + SLACK * max(1.0, abs(limit))


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
    if not words:
        bound = "" if limit is None else f" (limit {limit:g} {q.unit})"
        words = (
            q.words or f"greatest {q.name_in_words} {{worst}}, {{who}}, at {{when:.2f}} s{bound}"
        )
        worst = value(e.value, q.unit)
        words = words.format(worst=worst, who=e.who, when=e.when, limit=limit)
    if e.at_samples:
        words += ", at samples"
    if passed is None and limit is not None:
        passed = keeps_limit(q, e.value, limit)
    passed = passed is None or bool(passed)
    return CheckResult(
        q.name, passed, words, e.value, limit, q.unit, at_least, e.when, e.who, e.phase,
        limit is not None, e.at_samples, first,
    )  # fmt: skip
