"""Fly runs of a sweep, eight per vector: whole flights, which are judged, or final states alone."""

from __future__ import annotations

import errno
import math
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.errors import FlightError, MissionError, RigidfleetError
from rigidfleet.mission import Mission
from rigidfleet.sweep import faults
from rigidfleet.sweep.definition import Sweep
from rigidfleet.sweep.metrics import METRICS, measure_metrics
from rigidfleet.sweep.record import BROKEN, RAISED, REFUSED, RunRecord
from rigidfleet.typing import Ints

if TYPE_CHECKING:
    from rigidfleet.result import Result

#: Number of consecutive runs in a group. The first run of a group is a multiple of it.
GROUP = 8
#: What a machine lacks where it answers with one of these: memory, files that may be open, room on a disk. Of other
#: errors of the system, such as a file of a controller that is not there, the run is to blame.
_LACKS = {
    errno.ENOMEM,
    errno.EAGAIN,
    errno.EMFILE,
    errno.ENFILE,
    errno.ENOSPC,
    errno.EIO,
}


def fly_runs(sweep: Sweep, runs: Sequence[int]) -> list[RunRecord]:
    """Fly complete groups of runs and measure them. Only the last group of a sweep may be incomplete.

    Except for `wall`, a record depends only on the sweep and the number of the run. A run that cannot be flown has a
    record with the reason.

    Raises
    ------
    RigidfleetError
        This machine cannot fly them, or the show of a drill cannot be drilled.
    """
    if sweep.evaluate == "final":
        from rigidfleet.sweep.final_states import final_state_outcomes

        begun, values = perf_counter(), [sweep.values(run) for run in runs]
        outcomes = final_state_outcomes(sweep, runs, values)
        shared = (perf_counter() - begun) / len(runs)
        return [
            _run_row(sweep, *each, perf_counter() - shared)
            for each in zip(runs, values, outcomes, strict=True)
        ]
    rows: list[RunRecord] = []
    groups: dict[int, list[int]] = {}
    for run in runs:
        if sweep.drill and sweep.values(run)[0] not in faults.IN_FLIGHT:
            rows.append(_judge_fault(sweep, run))
        else:
            groups.setdefault(run // GROUP, []).append(run)
    return rows + [row for group in groups.values() for row in _fly_group(sweep, group)]


def _judge_fault(sweep: Sweep, run: int) -> RunRecord:
    """Judge a geometric fault of a drill."""
    show, fault = _drilled_show_and_fault(sweep, run)
    begun = perf_counter()
    outcome = _value_or_error(lambda: show.measure_fault(fault))
    return _run_row(sweep, run, sweep.values(run), outcome, begun)


def _drilled_show_and_fault(sweep: Sweep, run: int) -> tuple[faults.Show, faults.GeometricFault]:
    """The show of a drill, and the geometric fault of a run."""
    show, (kind, size, count) = faults.show_of(sweep.mission.text, sweep.drill), sweep.values(run)
    who = faults.vehicles_of(sweep.seed, show.n, count, run // math.prod(sweep.grid_sizes.values()))
    return show, faults.GeometricFault(kind, size, who, faults.random_stream(sweep.seed, run, 2))


def flight_with_fault(sweep: Sweep, run: int) -> tuple[Result, Ints]:
    """The flight of a run of a drill again, and which vehicles (M,) it has."""
    from rigidfleet.simulation.flight import simulate

    if sweep.values(run)[0] in faults.IN_FLIGHT:
        return simulate(sweep.mission_of(run)), np.arange(sweep.mission.n_agents)
    show, fault = _drilled_show_and_fault(sweep, run)
    return show.flight_of_vehicles_near_fault(fault)


def _fly_group(sweep: Sweep, runs: Sequence[int]) -> list[RunRecord]:
    """Fly a group of runs side by side; one by one, if anything unforeseen happens to any of them."""
    from rigidfleet.simulation.flight import simulate
    from rigidfleet.simulation.together import MOST_VEHICLES, simulate_together

    law, header = sweep.law[0], sweep.header

    def fly_mission(mission: Mission) -> Result:
        if header.agent:
            return simulate(mission, agent=law)
        own = law() if isinstance(law, type) else law
        return simulate(mission, controller=own, rate=header.rate)

    begun = perf_counter()
    values = {run: sweep.values(run) for run in runs}
    flown: dict[int, Any] = {
        run: _value_or_error(lambda run=run: sweep.mission_of(run, values[run])) for run in runs
    }
    valid = [run for run, mission in flown.items() if not isinstance(mission, Exception)]
    if law is None and sweep.mission.n_agents <= MOST_VEHICLES:
        together = _value_or_error(lambda: simulate_together([flown[run] for run in valid]))
        if not isinstance(together, Exception):
            flown |= zip(valid, together, strict=True)
        del together
    shared, rows = (perf_counter() - begun) / len(runs), []
    for run in runs:
        # Each flight is let go of when it is judged: the next one's record takes its memory over.
        begun, flight = perf_counter() - shared, flown.pop(run)
        if isinstance(flight, Mission):
            flight = _value_or_error(lambda mission=flight: fly_mission(mission))
        rows.append(_run_row(sweep, run, values[run], flight, begun))
        del flight
    return rows


def _value_or_error(job: Callable[[], Any]) -> Any:
    """What a function returns, or its exception: one failed run must not end the sweep.

    Raises
    ------
    RigidfleetError
        This machine lacks memory, threads, files or code that it can run: another may fly the run.
    """
    try:
        return job()
    except Exception as error:
        before = error.__context__ or error.__cause__
        if isinstance(before, KeyboardInterrupt) or type(error) is RigidfleetError:
            raise  # Ctrl-C, turned into another exception by the compiler; or a sentence that names the machine's fault
        out = (isinstance(x, MemoryError) or "start new thread" in str(x) for x in (error, before))
        if (isinstance(error, OSError) and error.errno in _LACKS) or any(out):
            raise RigidfleetError(f"{type(error).__name__}: {error}") from error
        return error


def _run_row(sweep: Sweep, run: int, values: Sequence[Any], flown: Any, begun: float) -> RunRecord:
    """Judge and measure a flight, unless it is the outcome; ``begun``: when, by `perf_counter` [s]."""
    codes = tuple(c.variation.encode(v) for c, v in zip(sweep.columns, values, strict=True))
    metrics = dict.fromkeys(METRICS, math.nan)
    done = isinstance(flown, Exception | tuple)
    outcome = flown if done else _value_or_error(lambda: _metrics_and_failure(flown))
    match outcome:
        case MissionError():
            first = outcome.findings[0]
            reason, detail = REFUSED, f"{first.key} = {first.value!r}: {first.problem}"
        case FlightError() if sweep.header.law_key_and_name[1]:
            reason, detail = RAISED, str(outcome)
        case Exception():
            reason, detail = BROKEN, f"{type(outcome).__name__}: {outcome}"
        case _:
            known, reason, detail = outcome
            metrics |= {name: math.nan if x is None else x for name, x in known.items()}
    wall = perf_counter() - begun
    return RunRecord(run, not reason, reason, " ".join(detail.split()), codes, metrics, wall)


def _metrics_and_failure(result: Result) -> tuple[dict[str, float], str, str]:
    """Metrics of a flight, and why it has failed."""
    from rigidfleet.assessment import assess

    verdict = assess(result)
    failed = verdict.failures
    reason = ", ".join(dict.fromkeys(f.check for f in failed))
    return measure_metrics(result, verdict), reason, failed[0].message if failed else ""
