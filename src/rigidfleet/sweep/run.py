"""Fly runs of a sweep: whole flights one by one, or final states alone, eight per vector."""

from __future__ import annotations

import math
from collections.abc import Sequence
from time import perf_counter

from rigidfleet.errors import MissionError
from rigidfleet.sweep.definition import Sweep
from rigidfleet.sweep.metrics import METRICS, measure
from rigidfleet.sweep.record import BROKEN, RunRecord, refusal

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
    return [_fly(sweep, run) for run in runs]


def _fly(sweep: Sweep, run: int) -> RunRecord:
    from rigidfleet.assessment import assess
    from rigidfleet.simulation.flight import simulate

    begun = perf_counter()
    values = sweep.values(run)
    codes = tuple(c.variation.code(v) for c, v in zip(sweep.columns, values, strict=True))
    metrics = dict.fromkeys(METRICS, math.nan)
    try:
        result = simulate(sweep.mission_of(run))
        verdict = assess(result)
        metrics = measure(result, verdict)
        failed = [f for f in verdict.checks if not f.passed]
        reason = ", ".join(dict.fromkeys(f.check for f in failed))
        detail = failed[0].message if failed else ""
    except MissionError as error:
        reason, detail = refusal(error)
    except Exception as error:  # one failed run must not end the sweep
        if isinstance(error.__context__ or error.__cause__, KeyboardInterrupt):
            raise  # Ctrl-C, turned into another exception by the compiler
        reason, detail = BROKEN, f"{type(error).__name__}: {error}"
    wall = perf_counter() - begun
    return RunRecord(run, not reason, reason, " ".join(detail.split()), codes, metrics, wall)
