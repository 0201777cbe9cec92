"""Errors whose message says what is wrong, where, which value it has, and what to do about it."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

#: Letters of a value that a message shows.
_WIDTH = 60


class RigidfleetError(Exception):
    """Base of every error that rigidfleet raises for its user to read."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing wrong in a mission.

    Attributes
    ----------
    file : the mission file, or "" if the mission came from elsewhere
    key : dotted path of the entry, counted from 1 (``phases[2].until``), or "" for the whole file
    value : the value found there, as the user wrote it
    problem : what is wrong, without a full stop
    remedy : what to do about it, without a full stop
    """

    file: str
    key: str
    value: object
    problem: str
    remedy: str

    def __str__(self) -> str:
        where = ": ".join(part for part in (self.file, self.key) if part)
        value = "" if self.value is None else f" = {_short(self.value)}"
        head = f"{where}{value}: {self.problem}" if where else self.problem
        return f"{head}\n    {self.remedy}" if self.remedy else head


class MissionError(RigidfleetError):
    """A mission that cannot be flown; carries everything wrong with it, not only the first thing.

    Attributes
    ----------
    findings : tuple of Finding, at least one
    """

    findings: tuple[Finding, ...]

    def __init__(self, findings: Iterable[Finding]) -> None:
        self.findings = tuple(findings)
        if not self.findings:
            raise ValueError("MissionError needs at least one finding")
        super().__init__(self.findings)

    def __str__(self) -> str:
        return "\n".join(map(str, self.findings))


class SweepError(MissionError):
    """A sweep whose definition is wrong; its findings are about the sweep file, or the options."""


class ResultError(RigidfleetError):
    """A result that cannot be read or written."""


class StoppedError(RigidfleetError):
    """A flight that cannot go on; the message is the diagnosis. It ends the flight, whose record tells it."""


class FlightError(RigidfleetError):
    """A flight that cannot go on, or cannot begin.

    Attributes
    ----------
    result : the `Result` of what had flown by then; None where nothing had
    """

    result: Any = None


def wrong_type(asked: str, given: object) -> TypeError:
    """A TypeError in one sentence: what is asked for, and what was given."""
    text = " ".join(repr(given).split())
    shown = text if len(text) <= _WIDTH else text[: _WIDTH - 3] + "..."
    return TypeError(f"{asked} is asked for, but {shown} ({type(given).__name__}) was given")


def _short(value: object, width: int = _WIDTH) -> str:
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= width else text[: width - 3] + "..."
