"""Errors. Every message says what is wrong, where, which value was found, and how to correct it."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

#: Maximum number of characters of a value that a message shows.
_WIDTH = 60


class RigidfleetError(Exception):
    """Base class of all errors that rigidfleet raises for its users."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One error in a mission.

    Attributes
    ----------
    file : the mission file; "" if the mission did not come from a file
    key : dotted path of the entry, counted from 1 (``phases[2].until``); "" for the whole file
    value : the value of this entry, as the user wrote it
    problem : what is wrong, without a full stop
    remedy : how to correct it, without a full stop
    """

    file: str
    key: str
    value: object
    problem: str
    remedy: str

    def __str__(self) -> str:
        where = ": ".join(part for part in (self.file, self.key) if part)
        text = str(self.value).lower() if isinstance(self.value, bool) else repr(self.value)
        value = "" if self.value is None else f" = {_shorten_text(text)}"
        head = f"{where}{value}: {self.problem}" if where else self.problem
        return f"{head}\n    {self.remedy}" if self.remedy else head


class MissionError(RigidfleetError):
    """A mission has errors. The exception carries all of them, not only the first.

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
    """The definition of a sweep has errors. The findings refer to the sweep file or to the options."""


class ResultError(RigidfleetError):
    """A result cannot be read or written."""


class TrajectoryError(RigidfleetError):
    """Trajectories of another program cannot be read or judged. The message names the file and the place in it."""


class StoppedError(RigidfleetError):
    """A flight cannot continue. The message is the diagnosis; it is stored in the record of the flight."""


class FlightError(RigidfleetError):
    """A flight cannot start or cannot continue.

    Attributes
    ----------
    result : the `Result` up to the failure; None if nothing was flown
    """

    result: Any = None


def wrong_type(expected: str, value: object) -> TypeError:
    """Return a TypeError that names what was expected and what was given."""
    shown = _shorten_text(" ".join(repr(value).split()))
    return TypeError(f"expected {expected}, got {shown} ({type(value).__name__})")


def _shorten_text(text: str) -> str:
    return text if len(text) <= _WIDTH else text[: _WIDTH - 3] + "..."


def refuse_format(
    place: object, what: str, made: int, known: int, *, newer: str = "", older: str
) -> None:
    """Refuse a file of another format than the ``known`` one; ``newer`` and ``older`` are remedies.

    Raises
    ------
    ResultError
        The format is another one.
    """
    if made > known:
        reads = f"this version of rigidfleet reads format {known}. Use a newer version{newer}."
        raise ResultError(f"{place}: has {what} format {made}; {reads}")
    if made < known:
        by = f"an earlier version of rigidfleet ({what} format {made}); this version reads format {known}"
        raise ResultError(f"{place}: was written by {by}. {older}.")
