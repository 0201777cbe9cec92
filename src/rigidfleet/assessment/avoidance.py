"""The guarantee of avoidance in flight: proved, held, or lost at some time, by whom."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rigidfleet._common.quantities import Quantity
from rigidfleet.assessment.measure import Measurements
from rigidfleet.assessment.verdict import CheckResult, Extreme, limit_check, value
from rigidfleet.result import Result

#: Rate below which the clock counts as slowed: it comes back to 1 by an exponential.
_SLOWED = 0.99


def guarantee_checks(measured: Measurements, q: Quantity) -> Iterator[CheckResult]:
    """Whether stop segments have kept their distances at every tick, if the mission has a guard."""
    avoidance = measured.mission.avoidance
    if avoidance is None or not avoidance.guard:
        return
    if lost := _least_guarantee_margins(measured, "_lost"):
        e = min(lost, key=lambda e: e.when)
        words = (
            f"the guarantee of [avoidance] is lost at {e.when:.2f} s, by {e.who}: braking at once would leave them"
            f" {value(-e.value, 'm')} too near"
        )
        yield limit_check(q, e, 0.0, words, passed=False)
        return
    state = "held" if _why_guarantee_is_unproved(measured) else "proved"
    e = min(_least_guarantee_margins(measured), key=lambda e: e.value, default=None)
    spare = "no vehicle has come near anything"
    if e is not None:
        spare = f"{value(e.value, 'm')} to spare at least"
        e = replace(e, value=max(e.value, 0.0))
    words = f"the guarantee of [avoidance] is {state}: {spare}"
    yield limit_check(q, e, 0.0, words, passed=True)


def avoidance_notes(measured: Measurements) -> Iterator[str]:
    """What the layers of avoidance did, and what the guarantee is worth."""
    if (avoidance := measured.mission.avoidance) is None:
        return
    if not avoidance.guard:
        yield "[avoidance] without its guard guarantees nothing"
    elif not _least_guarantee_margins(measured, "_lost"):
        words = "is proved: at every tick, all vehicles could brake in time"
        if doubt := _why_guarantee_is_unproved(measured):
            words = f"was held at every tick, but is not proved: {doubt}"
        yield f"the guarantee of [avoidance] {words}"
    yield from _avoidance_share_notes(measured.result)


def clock_notes(result: Result) -> Iterator[str]:
    """Whether the formation waited, and how far the vehicles' own clocks were apart."""
    waited = [p for p in result.phases if "clock" in p.extremes]
    if waited:
        longest = max(waited, key=lambda p: p.extremes["clock"].value)
        x = longest.extremes["clock"]
        yield (
            f"the formation waited on its path from {x.time:.2f} s on: phase '{longest.name}' ends"
            f" {value(x.value, 's')} later than planned"
        )
    if (clock := result.vehicle_clock) is not None:
        apart = np.ptp(clock, axis=1)
        yield (
            f"each vehicle has flown by its own clock: they differed by up to {value(float(apart.max()), 's')}, and by"
            f" {value(float(apart[-1]), 's')} at the end"
        )


def _avoidance_share_notes(result: Result) -> Iterator[str]:
    """The share of time by layer, and how far the body was beside its path."""
    rate, way, acts = result.clock_rate, result.body_displacement, result.avoidance_layers
    if rate is None or way is None or acts is None or len(result.time) < 2:
        return
    step = np.gradient(result.time)
    step /= step.sum()
    shares = {
        "the clock slowed": rate < _SLOWED,
        "the body deviated": way.any(axis=1),
        "barriers acted": (acts & 1 != 0).any(axis=1),
        "the guard acted": (acts & 2 != 0).any(axis=1),
    }
    parts = [f"{words} {100 * float(step @ on):.2g} %" for words, on in shares.items() if on.any()]
    if parts:
        far = float(np.linalg.norm(way, axis=1).max())
        aside = f"; the body was up to {value(far, 'm')} beside its path" if far > 0.0 else ""
        yield f"of the samples, by time: {', '.join(parts)}{aside}"


def _least_guarantee_margins(measured: Measurements, ending: str = "") -> list[Extreme]:
    """The least margins of each phase, between vehicles and to obstacles, or the first negative ones ("_lost")."""
    return [
        measured.extreme_of(name + ending, p.extremes[name + ending], p.name)
        for p in measured.result.phases
        for name in ("guarantee", "clearance_guarantee")
        if name + ending in p.extremes
    ]


def _why_guarantee_is_unproved(measured: Measurements) -> str:
    """Why the guarantee is not proved; empty if it is."""
    from rigidfleet.mission.avoidance import why_no_guarantee

    if measured.result.statistics.get("pushed"):
        return "a force from outside acted, which it does not know"
    mission, d = measured.mission, measured.mission.all_disturbances
    return why_no_guarantee(mission.vehicle_models or [], d, mission.obstacles)
