"""Rules of disturbances, and what gusts are made of."""

from __future__ import annotations

import math

import numpy as np

from rigidfleet.mission.rules import Breach, Breaches, Draft, unused_key_rules
from rigidfleet.mission.schema import Disturbances, Gusts
from rigidfleet.mission.vehicles import NOT_SAMPLED
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


def knot_spacing(gusts: Gusts, wind: float) -> float:
    """Time between the knots of gusts [s], in a steady wind of a given speed [m/s]."""
    shortest = gusts.time_scale
    if shortest is None:
        length = gusts.length if gusts.length is not None else gusts.altitude or 1.0
        shortest = min(length if isinstance(length, tuple) else (length,)) / (
            gusts.airspeed or wind
        )
    return min(shortest / _KNOTS, _STEP)


def gust_intensity(gusts: Gusts, wind: float) -> Floats:
    """Standard deviations (3,) of gusts [m/s]: along a steady wind of a given speed [m/s], across it, and vertical."""
    if gusts.intensity is None:
        from rigidfleet.math.turbulence import low_altitude_gusts

        return low_altitude_gusts(gusts.altitude or 0.0, wind)[0]
    return np.broadcast_to(np.array(gusts.intensity, dtype=np.float64), 3)


def disturbance_rules(m: Draft) -> Breaches:
    """Disturbances have one entry per agent, and an effect."""
    d = m.disturbances or Disturbances.model_construct()
    for key in ("drag", "mass_error"):
        yield from m.one_per_agent_rules(d, key, alone=", or a single number")
    drag = d.drag if isinstance(d.drag, tuple) else (d.drag,)
    if (any(d.wind) or d.gusts is not None) and not any(c is None or c > 0 for c in drag):
        problem = "without drag, wind and gusts have no effect"
        yield Breach("drag", problem, "give a drag > 0 [N s/m] or omit it")
    if d.gusts is not None and m.is_valid(_GUSTS, "model"):
        m.record_breaches(_GUSTS, _gust_rules(m, d.gusts, any(d.wind)))
    noise, keys = d.noise, ("position", "velocity", "delay", "dropped")
    silent = noise is not None and not any(getattr(noise, key) for key in keys)
    if silent and m.is_valid((_TABLE, "noise"), *keys):
        yield Breach("noise", "is zero", "give position [m] or velocity [m/s] > 0")
    if m.flies_vehicles:
        return
    for key in ("downwash", "ground_effect"):
        if getattr(d, key):
            yield Breach(key, "acts on vehicles with rotors alone", "name a vehicle")
    for key in ("delay", "dropped"):
        if noise is not None and getattr(noise, key):
            yield Breach(("noise", key), *NOT_SAMPLED)


def _gust_rules(m: Draft, gusts: Gusts, wind: bool) -> Breaches:
    """Gusts have the keys of their model, and no others."""
    spread = "add the standard deviation of the gusts [m/s]"
    yield from unused_key_rules(gusts, "time_scale", "model", "first-order")
    if gusts.model == "first-order":
        if gusts.time_scale is None:
            yield Breach("time_scale", "is missing", "add the correlation time of the gusts [s]")
        for key in ("length", "altitude", "airspeed"):
            yield from unused_key_rules(gusts, key, "model", "dryden")
        if gusts.intensity is None:
            yield Breach("intensity", "is missing", spread)
    else:
        if gusts.length is not None and gusts.altitude is not None:
            yield Breach("length", "is given together with altitude", "give one of them")
        if gusts.length is gusts.altitude is None:
            remedy = "add length [m], or altitude [m] to derive it"
            yield Breach("length", "is missing", remedy)
        if gusts.airspeed is None and not wind and m.is_valid((_TABLE,), "wind"):
            problem = "is missing, and there is no wind to replace it"
            yield Breach("airspeed", problem, "add airspeed [m/s] or wind")
        if gusts.intensity is None and (gusts.altitude is None or not wind):
            problem = "is missing; it can be derived only from altitude and wind together"
            yield Breach("intensity", problem, spread)
    if gusts.correlation is not None and gusts.correlation_length is not None:
        yield Breach("correlation", "is given together with correlation_length", "give one of them")
    if gusts.correlation_length is not None and m.n is not None and m.n > _MOST_BY_DISTANCE:
        problem = f"needs a matrix of all pairs, which is too large for {m.n} agents"
        remedy = f"for more than {_MOST_BY_DISTANCE} agents use correlation"
        yield Breach("correlation_length", problem, remedy)


def disturbance_storage_rules(m: Draft) -> Breaches:
    """Tables of gusts and noise fit into memory."""
    d = m.disturbances or Disturbances.model_construct()
    if m.n is None or m.findings:
        return
    longest = _MOST_NUMBERS / (6 * m.n)  # of a table with one sample a second
    problem = f"would need too much memory for {m.n} agents over {m.end:g} s"
    step = math.inf if d.gusts is None else knot_spacing(d.gusts, math.hypot(*d.wind))
    if m.end / step > longest:
        remedy = "increase the scales (time_scale, length) or shorten the flight"
        yield Breach("gusts", problem, remedy, f"{step:.3g} s between samples")
    if d.noise is not None and m.end * d.noise.rate > longest:
        remedy = "lower the rate or shorten the flight"
        yield Breach(("noise", "rate"), problem, remedy, d.noise.rate)
