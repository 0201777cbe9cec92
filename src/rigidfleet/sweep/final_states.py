"""Evaluate only the final states of phases: eight runs per SIMD vector, thousands of runs per second.

This is for open-loop phases with varied start states; see `rigidfleet.simulation.ensemble`. Nothing between the ends
of phases is recorded or evaluated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.assessment.fits import fits_by_sample, shape_of_slots
from rigidfleet.errors import MissionError
from rigidfleet.mission import Mission, bounds
from rigidfleet.mission.formations import coincident_pairs
from rigidfleet.mission.kinds import seconds
from rigidfleet.simulation.ensemble import Ensemble, establish, max_edge_error
from rigidfleet.typing import Bools, Floats

if TYPE_CHECKING:
    from rigidfleet.sweep.definition import Sweep


#: Messages of failed checks, in the order of a verdict.
_WORDS = {
    "complete": "the flight stopped early; fly its mission alone to see when, where and why",
    "distances": "a distance of a formation is not reached at the end of its phase",
    "shape": "a formation is not reached at the end of its phase",
    "handedness": "a formation is reached as its mirror image",
}


def final_state_outcomes(
    sweep: Sweep, runs: Sequence[int], values: Sequence[Sequence[Any]]
) -> list[tuple[dict[str, float], str, str] | MissionError]:
    """Fly complete groups of runs by their values (B, D); metrics of each, the checks that it fails, and words.

    A run passes if it is flown to its end and reaches each formation: the checks "distances", "shape" and
    "handedness" are those of `rigidfleet.assess`. The metrics are those of the shape, and the number of evaluations,
    which the eight runs of a vector share. Instead of an invalid mission, that of the sweep is flown: such a run has
    its errors.
    """
    r, v = start_states(sweep, values)
    refused = _runs_of_invalid_missions(sweep, runs, r, v)
    out = [*refused]
    r[out], v[out] = sweep.mission.agents.position, sweep.mission.agents.velocity
    ensemble = establish(sweep.mission, r, v)
    wrong, metrics = _failures_and_metrics(sweep.mission, ensemble)
    failed = {"complete": ~ensemble.finished} | {k: ensemble.finished & x for k, x in wrong.items()}
    outcomes = []
    for k in range(len(runs)):
        reasons = [name for name, which in failed.items() if which[k]]
        known = {name: float(x[k]) for name, x in metrics.items()}
        detail = _WORDS[reasons[0]] if reasons else ""
        outcomes.append(refused.get(k) or (known, ", ".join(reasons), detail))
    return outcomes


def start_states(sweep: Sweep, values: Sequence[Sequence[Any]]) -> tuple[Floats, Floats]:
    """Start positions and velocities (B, N, 3) [m, m/s] of runs with given values of the columns (B, D)."""
    agents, count = sweep.mission.agents, len(values)
    own = {"position": agents.position, "velocity": agents.velocity}
    states = {name: np.tile(np.array(x, dtype=float), (count, 1, 1)) for name, x in own.items()}
    with np.errstate(over="ignore", invalid="ignore"):  # `_runs_of_invalid_missions` has them
        for column, drawn in zip(sweep.columns, np.array(values, dtype=float).T, strict=True):
            _, name, *inner = column.keys
            place = states[str(name)][(slice(None), *map(int, inner))]
            by = drawn.reshape(-1, *(1,) * (place.ndim - 1))
            place[:] = column.variation.changed_value(place, by)
    return states["position"], states["velocity"]


def _runs_of_invalid_missions(
    sweep: Sweep, runs: Sequence[int], r: Floats, v: Floats
) -> dict[int, MissionError]:
    """Errors of runs with an invalid mission, by index. Only doubtful missions are checked in full."""
    bounded = np.all((abs(r) <= bounds.LENGTH.most) & (abs(v) <= bounds.SPEED.most), axis=(1, 2))
    r, v = (np.where(bounded[:, None, None], x, 0.0) for x in (r, v))
    apart = [not any(coincident_pairs(points)) for points in r.tolist()]
    refusals = {}
    for k in np.flatnonzero(~(bounded & apart)):
        try:
            sweep.mission_of(runs[k])
        except MissionError as error:
            refusals[int(k)] = error
    return refusals


def _failures_and_metrics(
    mission: Mission, flown: Ensemble
) -> tuple[dict[str, Bools], dict[str, Floats]]:
    """Failed checks (B,) and metrics (B,), by name."""
    count = len(flown.finished)
    wrong = {name: np.zeros(count, dtype=bool) for name in ("distances", "shape", "handedness")}
    metrics = {"shape": np.full(count, np.nan), "handed": np.full(count, np.nan)}
    formation, t, last = None, 0.0, len(mission.phases) - 1
    for index, (phase, ends) in enumerate(zip(mission.phases, flown.ends, strict=True)):
        shaping = phase.shaping
        length = seconds(phase.duration or 0.0) if phase.until is None else phase.until - t
        t += length
        formation = shaping.formation if shaping is not None else formation
        if formation is None:
            continue
        judged = shaping is not None or index == last
        allowed = mission.formations[formation].greatest_error
        lengths = mission.formation_distances(formation)
        # A flight that did not finish may have ended nowhere; it has no metrics.
        r = np.where(np.isfinite(ends).all(axis=(1, 2), keepdims=True), ends, 0.0)
        wide = max_edge_error(r, mission.formation_edges(formation), lengths)
        blending = (
            shaping is not None and shaping.reference != "step" and shaping.least_time > length
        )
        if index == last and not blending and len(lengths):
            metrics["constraint_end"] = wide
        if judged:
            wrong["distances"] |= wide > allowed(lengths.min(initial=math.inf))
        slots = mission.formation_slots(formation)
        if slots is None or len(slots) < 2:
            continue
        fits = [*fits_by_sample(r, shape_of_slots(slots), np.arange(len(slots)), allowed)]
        metrics["shape_end"] = error = np.array([fit.error for fit in fits])
        metrics["shape"] = np.fmax(metrics["shape"], error)
        misshapen = error > fits[0].limit
        mirrored = np.array([fit.is_mirrored for fit in fits])
        if fits[0].dimension == 3:
            metrics["handed"] = np.fmin(metrics["handed"], 1.0 - mirrored)
        if judged:
            wrong["shape"] |= misshapen
            wrong["handedness"] |= mirrored & ~misshapen
    metrics["flown"] = np.full(count, mission.latest_end)
    metrics = {name: np.where(flown.finished, x, np.nan) for name, x in metrics.items()}
    return wrong, metrics | {"evaluations": flown.evaluations.astype(float)}
