"""The guarantee of avoidance in flight: proved, held, or lost at some time, by whom."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rigidfleet._common.text import agent_names
from rigidfleet.assessment.measure import Measurements
from rigidfleet.assessment.outcome import CheckResult, Extreme, bounded, value
from rigidfleet.result import Extremum, Result

#: The two margins: between vehicles, and between vehicles and obstacles.
_MARGINS = ("guarantee", "clearance_guarantee")
#: Rate below which the clock counts as slowed: it comes back to 1 by an exponential.
_SLOWED = 0.99


def guarantee_checks(measured: Measurements) -> Iterator[CheckResult]:
    """Whether stop segments have kept their distances at every tick, if the mission has a guard."""
    given = measured.mission.avoidance
    if given is None or not given.guard:
        return
    if (lost := _lost(measured)) is not None:
        name, x, phase = lost
        e = Extreme(x.value, x.time, _who(measured, name, x), phase)
        words = (
            f"the guarantee of [avoidance] is lost at {x.time:.2f} s, by {e.who}: braking at once would leave them"
            f" {value(-x.value, 'm')} too near"
        )
        yield bounded("guarantee", e, "m", 0.0, words, passed=False, at_least=True)
        return
    state = "held" if _doubt(measured) else "proved"
    least = _least(measured)
    if least is None:
        words = f"the guarantee of [avoidance] is {state}: no vehicle has come near anything"
        yield CheckResult("guarantee", True, words, limit=0.0, unit="m", at_least=True)
        return
    name, x, phase = least
    e = Extreme(max(x.value, 0.0), x.time, _who(measured, name, x), phase)
    words = f"the guarantee of [avoidance] is {state}, with {value(x.value, 'm')} to spare at least"
    yield bounded("guarantee", e, "m", 0.0, words, passed=True, at_least=True)


def avoidance_notes(measured: Measurements) -> Iterator[str]:
    """What the layers of avoidance did, and what the guarantee is worth."""
    given, result = measured.mission.avoidance, measured.result
    if given is None:
        return
    if not given.guard:
        yield "[avoidance] without its guard guarantees nothing"
    elif _lost(measured) is None:
        doubt = _doubt(measured)
        yield (
            f"the guarantee of [avoidance] was held at every tick, but is not proved: {doubt}"
            if doubt
            else "the guarantee of [avoidance] is proved: at every tick, all vehicles could brake in time"
        )
    yield from _first_layers(result)
    for name, words in (("barrier", "barriers changed"), ("guard", "the guard replaced")):
        every = [p.extremes[name] for p in result.phases if name in p.extremes]
        if every:
            most = max(every, key=lambda x: x.value)
            first = min(x.time for x in every)
            yield (
                f"{words} what vehicles were asked for, first at {first:.2f} s, most of agent {most.who + 1}: at"
                f" {100 * most.value:.2g} % of the ticks of a phase"
            )


def _first_layers(result: Result) -> Iterator[str]:
    """What the virtual clock and the body layer did, and the share of time by layer."""
    waited = [p for p in result.phases if "clock" in p.extremes]
    if waited:
        longest = max(waited, key=lambda p: p.extremes["clock"].value)
        x = longest.extremes["clock"]
        yield (
            f"the formation waited on its path from {x.time:.2f} s on: phase '{longest.name}' ends"
            f" {value(x.value, 's')} later than planned"
        )
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
    told = [f"{words} {100 * float(step @ on):.2g} %" for words, on in shares.items() if on.any()]
    if told:
        far = float(np.linalg.norm(way, axis=1).max())
        aside = f"; the body was up to {value(far, 'm')} beside its path" if far > 0.0 else ""
        yield f"of the samples, by time: {', '.join(told)}{aside}"


def _lost(measured: Measurements) -> tuple[str, Extremum, str] | None:
    """The first time at which a margin was negative."""
    found = [
        (name, p.extremes[f"{name}_lost"], p.name)
        for p in measured.result.phases
        for name in _MARGINS
        if f"{name}_lost" in p.extremes
    ]
    return min(found, key=lambda each: each[1].time, default=None)


def _least(measured: Measurements) -> tuple[str, Extremum, str] | None:
    found = [
        (name, p.extremes[name], p.name)
        for p in measured.result.phases
        for name in _MARGINS
        if name in p.extremes
    ]
    return min(found, key=lambda each: each[1].value, default=None)


def _who(measured: Measurements, name: str, x: Extremum) -> str:
    if name == "guarantee":
        return agent_names(sorted((x.who, x.other)))
    return measured.beside(x.who, x.other)


def _doubt(measured: Measurements) -> str:
    """Why the guarantee is not proved; empty if it is."""
    from rigidfleet.mission.avoidance import unproved

    if measured.result.statistics.get("pushed"):
        return "a force from outside acted, which it does not know"
    mission = measured.mission
    return unproved(mission.vehicle_models or [], mission.disturbances, mission.obstacles)
