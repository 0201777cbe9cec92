"""Check the disturbances of a mission."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from rigidfleet.mission import losses
from rigidfleet.mission.findings import FindingCollector
from rigidfleet.mission.phases import latest_end
from rigidfleet.mission.schema import Disturbances, Gusts
from rigidfleet.mission.vehicles import NOT_SAMPLED, flies_vehicles
from rigidfleet.typing import Floats

_TABLE = "disturbances"
_GUSTS = (_TABLE, "gusts")
#: Maximum number of agents with gusts correlated by distance, which needs a matrix of all pairs.
_MOST_BY_DISTANCE = 2000
#: Maximum number of values in a table of gusts or noise: 2 GB.
_MOST_NUMBERS = 2.5e8
#: Gusts have at least _KNOTS knots in the shortest time scale, at most _STEP apart [s]. They resolve 99 % of the
#: variance of the roughest process, a first-order one.
_KNOTS, _STEP = 16, 0.1


def gust_step(gusts: Gusts, wind: float) -> float:
    """Time between the knots of gusts [s], in a steady wind of a given speed [m/s]."""
    shortest = gusts.time_scale
    if shortest is None:
        length = gusts.length if gusts.length is not None else gusts.altitude or 1.0
        shortest = min(length if isinstance(length, tuple) else (length,)) / (
            gusts.airspeed or wind
        )
    return min(shortest / _KNOTS, _STEP)


def intensity(gusts: Gusts, wind: float) -> Floats:
    """Standard deviations (3,) of gusts [m/s]: along a steady wind of a given speed [m/s], across it, and vertical."""
    if gusts.intensity is None:
        from rigidfleet.math.turbulence import low_altitude

        return low_altitude(gusts.altitude or 0.0, wind)[0]
    return np.broadcast_to(np.array(gusts.intensity, dtype=np.float64), 3)


def check(collector: FindingCollector, parts: Mapping[str, Any], n: int | None) -> None:
    """Find the errors in [disturbances]."""
    found: Disturbances | None = parts.get(_TABLE)
    end = latest_end(parts["phases"]) if collector.right((), "phases") else None
    if end is not None and math.isnan(
        end
    ):  # automatic durations; checked again when they are known
        end = None
    if found is None:
        losses.check(collector, found, parts, n, end)
        return
    wind = sum(w * w for w in found.wind) ** 0.5
    for key in ("drag", "mass_error"):
        given = getattr(found, key)
        if n is not None and isinstance(given, tuple) and len(given) != n:
            problem = f"has {len(given)} entries for {n} agents"
            collector.add(
                (_TABLE, key), problem, f"give one entry per agent, {n} in all, or a single number"
            )
    drag = found.drag if isinstance(found.drag, tuple) else (found.drag,)
    if (wind > 0 or found.gusts is not None) and not any(d is None or d > 0 for d in drag):
        problem = "without drag, wind and gusts have no effect"
        collector.add((_TABLE, "drag"), problem, "give a drag > 0 [N s/m] or omit it")
    if found.gusts is not None:
        _gusts(collector, found.gusts, wind, n)
    _noise(collector, found)
    losses.check(collector, found, parts, n, end)
    if end is not None and n is not None and not collector.findings:
        _size(collector, found, wind, n, end)


def _noise(collector: FindingCollector, found: Disturbances) -> None:
    """Check that noise has an effect, and that only sampled flights have delays."""
    noise, where = found.noise, (_TABLE, "noise")
    keys = ("position", "velocity", "delay", "dropped")
    silent = noise is not None and not any(getattr(noise, key) for key in keys)
    if silent and collector.right(where, *keys):
        collector.add(where, "is zero", "give position [m] or velocity [m/s] > 0")
    if flies_vehicles(collector):
        return
    for key in ("downwash", "ground_effect"):
        if getattr(found, key):
            collector.add((_TABLE, key), "acts on vehicles with rotors alone", "name a vehicle")
    for key in ("delay", "dropped"):
        if noise is not None and getattr(noise, key):
            collector.add((*where, key), *NOT_SAMPLED)
    if found.links is not None:
        collector.add((_TABLE, "links"), *NOT_SAMPLED, None)


def _gusts(collector: FindingCollector, gusts: Gusts, wind: float, n: int | None) -> None:
    def wrong(key: str, problem: str, remedy: str) -> None:
        if collector.right(_GUSTS, key):
            collector.add((*_GUSTS, key), problem, remedy)

    if not collector.right(_GUSTS, "model"):
        return
    spread = "add the standard deviation of the gusts [m/s]"
    if gusts.model == "first-order":
        if gusts.time_scale is None:
            wrong("time_scale", "is missing", "add the correlation time of the gusts [s]")
        for key in ("length", "altitude", "airspeed"):
            if getattr(gusts, key) is not None:
                remedy = "remove it or use model = 'dryden'"
                wrong(key, "has no effect with model 'first-order'", remedy)
        if gusts.intensity is None:
            wrong("intensity", "is missing", spread)
    else:
        if gusts.time_scale is not None:
            remedy = "give length or altitude instead, or use model = 'first-order'"
            wrong("time_scale", "has no effect with model 'dryden'", remedy)
        if gusts.length is not None and gusts.altitude is not None:
            wrong("length", "is given together with altitude", "give one of them")
        if gusts.length is gusts.altitude is None:
            wrong("length", "is missing", "add length [m], or altitude [m] to derive it")
        if gusts.airspeed is None and wind == 0 and collector.right((_TABLE,), "wind"):
            problem = "is missing, and there is no wind to replace it"
            wrong("airspeed", problem, "add airspeed [m/s] or wind")
        if gusts.intensity is None and (gusts.altitude is None or wind == 0):
            problem = "is missing; it can be derived only from altitude and wind together"
            wrong("intensity", problem, spread)
    if gusts.correlation is not None and gusts.correlation_length is not None:
        wrong("correlation", "is given together with correlation_length", "give one of them")
    if gusts.correlation_length is not None and n is not None and n > _MOST_BY_DISTANCE:
        problem = f"needs a matrix of all pairs, which is too large for {n} agents"
        remedy = f"for more than {_MOST_BY_DISTANCE} agents use correlation"
        wrong("correlation_length", problem, remedy)


def _size(
    collector: FindingCollector, found: Disturbances, wind: float, n: int, end: float
) -> None:
    """Find gusts and noise whose tables would not fit into memory."""
    longest = _MOST_NUMBERS / (6 * n)  # of a table with one sample a second
    problem = f"would need too much memory for {n} agents over {end:g} s"
    if found.gusts is not None and end / (step := gust_step(found.gusts, wind)) > longest:
        remedy = "increase the scales (time_scale, length) or shorten the flight"
        collector.add(_GUSTS, problem, remedy, f"{step:.3g} s between samples")
    if found.noise is not None and end * found.noise.rate > longest:
        remedy = "lower the rate or shorten the flight"
        collector.add((_TABLE, "noise", "rate"), problem, remedy, found.noise.rate)
