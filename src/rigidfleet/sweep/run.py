"""Fly runs of a sweep, eight per vector: whole flights, which are judged, or final states alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import TYPE_CHECKING, Any

from rigidfleet.errors import FlightError, MissionError
from rigidfleet.sweep.definition import Sweep
from rigidfleet.sweep.metrics import METRICS, measure
from rigidfleet.sweep.record import BROKEN, RAISED, RunRecord, refusal

if TYPE_CHECKING:
    from rigidfleet.result import Result

#: Number of consecutive runs in a group. The first run of a group is a multiple of it.
GROUP = 8


def fly_runs(sweep: Sweep, runs: Sequence[int]) -> list[RunRecord]:
    """Fly complete groups of runs and measure them. Only the last group of a sweep may be incomplete.

    Except for `wall`, a record depends only on the sweep and the number of the run. A run that cannot be flown has a
    record with the reason.
    """
    if sweep.evaluate == "final":
        from rigidfleet.sweep.final_states import fly_final_states

        return fly_final_states(sweep, runs)
    groups: dict[int, list[int]] = {}
    for run in runs:
        groups.setdefault(run // GROUP, []).append(run)
    return [row for group in groups.values() for row in _fly(sweep, group)]


def _fly(sweep: Sweep, runs: Sequence[int]) -> list[RunRecord]:
    """Fly a group of runs side by side; one by one, if anything unforeseen happens to any of them."""
    from rigidfleet.simulation.flight import simulate
    from rigidfleet.simulation.together import simulate_together

    law, header = sweep.law[0], sweep.header

    def flight_of(run: int) -> Result:
        if header.agent:
            return simulate(flown[run], agent=law)
        own = law() if isinstance(law, type) else law
        return simulate(flown[run], controller=own, rate=header.rate)

    begun = perf_counter()
    values = {run: sweep.values(run) for run in runs}
    flown: dict[int, Any] = {
        run: _value_or_error(lambda run=run: sweep.mission_of(run, values[run])) for run in runs
    }
    valid = [run for run, mission in flown.items() if not isinstance(mission, Exception)]
    together = law or _value_or_error(lambda: simulate_together([flown[run] for run in valid]))
    if law is not None or isinstance(together, Exception):
        together = [_value_or_error(lambda run=run: flight_of(run)) for run in valid]
    flown |= zip(valid, together, strict=True)
    del together
    shared = (perf_counter() - begun) / len(runs)
    # Each flight is let go of when it is judged: the next one's record takes its memory over.
    return [_record(sweep, run, values[run], flown.pop(run), shared) for run in runs]


def _value_or_error(job: Callable[[], Any]) -> Any:
    """What a function returns, or its exception: one failed run must not end the sweep."""
    try:
        return job()
    except Exception as error:
        if isinstance(error.__context__ or error.__cause__, KeyboardInterrupt):
            raise  # Ctrl-C, turned into another exception by the compiler
        return error


def _record(
    sweep: Sweep, run: int, values: Sequence[Any], flown: Result | Exception, shared: float
) -> RunRecord:
    """Judge a flight and measure it; ``shared`` is its share of the time that its group has taken so far [s]."""
    begun = perf_counter()
    codes = tuple(c.variation.code(v) for c, v in zip(sweep.columns, values, strict=True))
    metrics = dict.fromkeys(METRICS, math.nan)
    outcome = flown if isinstance(flown, Exception) else _value_or_error(lambda: _judge(flown))
    match outcome:
        case MissionError():
            reason, detail = refusal(outcome)
        case FlightError() if sweep.header.own[1]:
            reason, detail = RAISED, str(outcome)
        case Exception():
            reason, detail = BROKEN, f"{type(outcome).__name__}: {outcome}"
        case _:
            metrics, reason, detail = outcome
    wall = shared + perf_counter() - begun
    return RunRecord(run, not reason, reason, " ".join(detail.split()), codes, metrics, wall)


def _judge(result: Result) -> tuple[dict[str, float], str, str]:
    """Metrics of a flight, and why it has failed."""
    from rigidfleet.assessment import assess

    verdict = assess(result)
    failed = [f for f in verdict.checks if not f.passed]
    reason = ", ".join(dict.fromkeys(f.check for f in failed))
    return measure(result, verdict), reason, failed[0].message if failed else ""
