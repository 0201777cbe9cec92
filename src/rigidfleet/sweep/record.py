"""Record of a run."""

from __future__ import annotations

from dataclasses import dataclass, field

from rigidfleet.kernel.compiler import levels

#: Reasons other than failed checks, of runs without a verdict: the varied mission has errors; the program failed; the
#: user's controller failed.
REFUSED, BROKEN, RAISED = UNJUDGED = "mission", "error", "controller"
_CALLED = {REFUSED: "mission refused", BROKEN: "program error"}


@dataclass(frozen=True)
class RunRecord:
    """Record of one run.

    Attributes
    ----------
    run : number of the run, from 0
    passed : whether the run passed its verdict
    reason : failed checks, separated by commas; one of `UNJUDGED` if the run has no verdict; "" if it passed
    detail : message of the first failure
    codes : value of every column of the sweep, encoded by `Variation.encode`
    metrics : value of each of `METRICS`; NaN if it does not apply
    wall : wall time of the run [s]
    level : level of the machine code that flew it; between levels the last bits of a row differ
    """

    run: int
    passed: bool
    reason: str
    detail: str
    codes: tuple[float, ...]
    metrics: dict[str, float]
    wall: float
    level: str = field(default_factory=levels.target_instruction_level)


def reason_in_words(reason: str) -> str:
    """Name of a reason in tables and figures."""
    return _CALLED.get(reason, reason.replace("_", " "))
