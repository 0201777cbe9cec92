"""Fly runs of a sweep: one after the other, whole flights; or where they end alone, eight to a vector."""

from __future__ import annotations

import math
from collections.abc import Sequence
from time import perf_counter

from rigidfleet.errors import MissionError
from rigidfleet.sweep.definition import Sweep
from rigidfleet.sweep.metrics import METRICS, measure
from rigidfleet.sweep.record import BROKEN, RunRecord, refusal

#: Runs are flown in groups of so many consecutive ones, the first of which is a multiple of it.
GROUP = 8


def fly_runs(sweep: Sweep, runs: Sequence[int]) -> list[RunRecord]:
    """Fly whole groups of runs (only the sweep's last may be a part of one) and measure them.

    A row depends on the sweep and the run's number alone, but for `wall`. A run that cannot be flown is a
    row with its reason.
    """
    if sweep.evaluate == "final":
        from rigidfleet.sweep.final_states import fly_final_states

        return fly_final_states(sweep, runs)
    return [_fly(sweep, run) for run in runs]


def _fly(sweep: Sweep, run: int) -> RunRecord:
    from rigidfleet.assessment import assess
    from rigidfleet.mission import Mission
    from rigidfleet.simulation.flight import simulate

    begun = perf_counter()
    values = sweep.values(run)
    codes = tuple(c.variation.code(v) for c, v in zip(sweep.columns, values, strict=True))
    metrics = dict.fromkeys(METRICS, math.nan)
    try:
        result = simulate(Mission.from_dict(sweep.varied(run), f"run {run}"))
        verdict = assess(result)
        metrics = measure(result, verdict)
        failed = [f for f in verdict.findings if not f.passed]
        reason = ", ".join(dict.fromkeys(f.check for f in failed))
        detail = failed[0].message if failed else ""
    except MissionError as error:
        reason, detail = refusal(error)
    except Exception as error:  # one run that breaks must not end a hundred thousand others
        if isinstance(error.__context__ or error.__cause__, KeyboardInterrupt):
            raise  # Ctrl-C, as the compiler gives it back
        reason, detail = BROKEN, f"{type(error).__name__}: {error}"
    wall = perf_counter() - begun
    return RunRecord(run, not reason, reason, " ".join(detail.split()), codes, metrics, wall)
