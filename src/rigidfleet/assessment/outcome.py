"""What checks, phases and waypoints come to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    pass

#: Greatest error of a distance, relative to the shortest one intended, at the end of a phase that shapes
#: and of the flight. A shape that is reached is within 1e-3 of it; one folded another way is off by tenths.
SHAPE_TOLERANCE = 0.01


#: Greatest miss of a waypoint's position [m], velocity [m/s], attitude [deg] and rates [deg/s]: what an
#: outdoor vehicle knows of its own state, and far above what a regulator leaves that has met its waypoint.
WAYPOINT_TOLERANCE = {"position": 0.1, "velocity": 0.1, "attitude": 1.0, "rates": 1.0}


#: A plane's normal, or a line's direction, is flipped further than this from where it should point [deg].
FLIPPED = 90.0


#: An agent lower than this below z = 0 is worth a note where the mission has no ground [m].
DIP = 0.01


#: What makes a value of each quantity worse.
SENSE: dict[str, Callable[..., Any]] = {
    "constraint": abs,
    "separation": lambda x: -x,
    "clearance": lambda x: -x,
    "thrust": abs,
    "speed": abs,
    "acceleration": abs,
    "constraint_force": abs,
    "tension": abs,
    "singular_value": lambda x: -x,
}


@dataclass(frozen=True, slots=True)
class Extreme:
    """Worst value of a quantity: how much, when [s], who, and in which phase."""

    value: float
    when: float
    who: str
    phase: str


@dataclass(frozen=True, slots=True)
class CheckResult:
    """One check.

    Attributes
    ----------
    check : what was checked, in snake_case
    passed : whether it holds; a quantity without a limit does
    message : the finding in words
    worst, limit : in `unit`; None where there is none
    at_least : whether the limit is the least value allowed, not the greatest
    when : mission time of the worst [s]
    who : agents, edge or obstacle
    phase : name of the phase
    judged : whether there was anything to hold or fail, not only a value to report
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

    def fill(self, words: str) -> str:
        """Words with {worst}, {limit} and {who} put in."""
        worst, limit = ("" if x is None else value(x, self.unit) for x in (self.worst, self.limit))
        return words.format(worst=worst, limit=limit, who=self.who)


@dataclass(frozen=True, slots=True)
class Waypoint:
    """Miss of a waypoint at its time [s]: [m], [m/s], [deg], [deg/s]; None where nothing was asked."""

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
    finished : whether the flight went on to the phase's end
    constraint : greatest |c| of an edge at the end [m]
    distances : greatest error of an edge against the formation's distance at the end [m]
    shape : greatest error of all pairs against the formation's slots at the end [m]
    handedness : spatial shapes: False if mirrored
    flip : angle of a plane's normal, or a line's direction, from where it should point [deg]
    order : lines: False if the agents are out of order
    waypoint : the miss of a waypoint
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
    worst: dict[str, Extreme]


def value(x: float, unit: str = "") -> str:
    """Three digits of a number, and its unit."""
    number = f"{x:.3g}" if x == 0 or 1e-3 <= abs(x) < 1e5 else f"{x:.1e}"
    return f"{number} {unit}".rstrip()
