"""What is kept of a run."""

from __future__ import annotations

from dataclasses import dataclass

from rigidfleet.errors import MissionError

#: Reasons that are no checks: what varies makes the mission wrong; the program itself failed.
REFUSED, BROKEN = "mission", "error"
_CALLED = {REFUSED: "mission refused", BROKEN: "program error"}


@dataclass(frozen=True)
class RunRecord:
    """What is kept of one run.

    Attributes
    ----------
    run : its number, from 0
    passed : whether it passed its verdict
    reason : the checks that failed, with commas; `REFUSED` or `BROKEN` for one that was not flown; else ""
    detail : the first failure in words
    codes : value of every column of the sweep, as `Variation.code` has it
    metrics : value of each of `METRICS`, NaN where it does not apply
    wall : how long it took [s]
    """

    run: int
    passed: bool
    reason: str
    detail: str
    codes: tuple[float, ...]
    metrics: dict[str, float]
    wall: float


def refusal(error: MissionError) -> tuple[str, str]:
    """Reason and detail of a run whose mission cannot be."""
    first = error.findings[0]
    words = f"{first.key} = {first.value!r}: {first.problem}"
    return REFUSED, " ".join(words.split())


def called(reason: str) -> str:
    """What a reason is called in tables and figures."""
    return _CALLED.get(reason, reason.replace("_", " "))
