"""Check what delay and loss of messages a formation by neighbours bears.

Delay: the linear flight (`linear_flight`) with messages that all arrive has a spectral radius, found by Arnoldi's
method. Loss: where messages are lost independently, the second moment P of the state moves by

    P -> A P A^T + q (1 - q) sum_l B_l P B_l^T,

A the tick in which each link l has the share q of its change B_l. P is carried by a few states x, each with its own
share of noise: what link l would have changed in *another* of them, with a random sign. This keeps to the map without
any bound or closure; what is left is the sampling error of its growth, some hundredths a second. Flights of which each
loses its own messages would need thousands, since few that grow make the moment. Bursts, jitter and edges that are let
go of are flown so, a few flights of the mission's own network.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from rigidfleet.kernel.mail import Links
from rigidfleet.math.margins import GROWTH, Lag
from rigidfleet.mission import Mission
from rigidfleet.planning.preview import PlannedPhase
from rigidfleet.planning.vehicles import network_of
from rigidfleet.preflight.findings import FormationNetwork, Preflight, Remark
from rigidfleet.preflight.linear_flight import Arrivals, LinearFlight, Radio
from rigidfleet.preflight.margins import phase_gains
from rigidfleet.typing import Floats

#: Number of links beyond which a formation is not checked: that would take minutes.
_LARGEST = 6_000
#: Delays beyond this are not looked at [s].
_LATEST = 2.0
#: Time between two vectors of Arnoldi's method [s], and their number.
_PERIOD, _VECTORS = 0.4, 20
#: Relative accuracy of the radius, and the growth [1/s] from which a motion then surely grows. Stresses that neither
#: grow nor decay are nearly defective: their growth is wrong by the root of the accuracy, so that a rough search only
#: says which delays are far from stable.
_ROUGH, _FINE = (1e-3, 0.1), (1e-8, GROWTH)
#: Time for which second moments move [s].
_TIME = 12.0
#: Growth [1/s] from which they count as unstable: more than the error of sampling.
_GROWS = 0.02
#: States that carry a moment: least and greatest number, and that of their links together; flights with the own
#: network.
_STATES, _FLIGHTS = (2, 64, 384), 16


def check_network(
    mission: Mission, way: Sequence[PlannedPhase], lags: Sequence[Lag]
) -> dict[str, FormationNetwork]:
    """What each formation bears, by its name; empty without a network.

    Parameters
    ----------
    way : the planned phases
    lags : of each vehicle
    """
    checks: dict[str, FormationNetwork] = {}
    if (own := mission.network) is None:
        return checks
    net, every = network_of(mission), _ticks_per_law(mission)
    for name, flight, unheard in linear_flights(mission, way, lags):
        radio, latest = flight.radio, math.ceil((net.delay + net.jitter) / every)
        delay, growing = last_stable_delay(flight), None
        loss = greatest_stable_loss(flight) if radio.delay <= delay else None
        if latest > min(radio.delay, delay) or own.burst is not None or own.loss > (loss or 0.0):
            growing = float((growth_rates_of_trials(flight, net, every) > _GROWS).mean())
        check = FormationNetwork(
            flight.n / (radio.every * radio.tick), radio.tick, delay, latest, loss, own.loss, growing, unheard
        )  # fmt: skip
        each = (check, checks.get(name, check))
        checks[name] = min(each, key=lambda f: (f.bears_own_network, f.delay_ticks, f.loss or 0.0))
    return checks


def linear_flights(
    mission: Mission, way: Sequence[PlannedPhase], lags: Sequence[Lag]
) -> Iterator[tuple[str, LinearFlight, int]]:
    """Each formation under each law with which it is flown, and how many of its edges nobody hears along."""
    assert mission.vehicle_models is not None  # checked: [network] needs vehicles
    net, every = network_of(mission), _ticks_per_law(mission)
    radio = Radio(
        max(1, round(net.every / every)), math.ceil(net.delay / every), net.lag, every / mission.autopilot.rate
    )  # fmt: skip
    drag = np.array([model.linear_drag for model in mission.vehicle_models])
    drag /= mission.fleet.mass[:, None]
    pairs = zip(mission.phases, way, strict=False)
    laws = {(x.leg.formation, phase_gains(mission, p, x.leg.formation)) for p, x in pairs}
    for name, law in sorted(laws, key=str):
        slots = None if name is None else mission.formation_slots(name)
        if name is None or slots is None:
            continue
        edges = mission.formation_edges(name)
        near = np.linalg.norm(slots[edges[:, 0]] - slots[edges[:, 1]], axis=1) <= net.range
        if 0 < 2 * near.sum() <= _LARGEST:
            flight = LinearFlight(slots, edges[near], mission.fleet.mass, law, radio, lags, drag)
            yield name, flight, int((~near).sum())


def _ticks_per_law(mission: Mission) -> int:
    """Attitude ticks from one evaluation of the law to the next."""
    return max(1, round(mission.autopilot.rate / mission.autopilot.formation_rate))


def growth_rate_at_delay(flight: LinearFlight, delay: int, accuracy: float = _FINE[0]) -> float:
    """Greatest growth [1/s] of a motion if all messages arrive after ``delay`` ticks; about 0 at least.

    Free motions of the whole formation, and integrals of stresses that no vehicle feels, neither grow nor decay.
    """
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

    every, tick = flight.radio.every, flight.radio.tick
    ticks = max(1, round(_PERIOD / tick / every)) * every
    messages = (delay, *flight.shape)
    size = flight.size + math.prod(messages)
    drift = np.zeros((size, 0))

    def arriving_updates(tick_index: int, news: Callable[[int], Floats]) -> Floats | float:
        return news(0) if (tick_index - delay) % every == 0 else 0.0

    def later(z: Floats, ticks: int, grip: Floats | None = None) -> Floats:
        sent = z[flight.size :].reshape(*messages, -1).copy()
        _, x = flight.squares_and_end(z[: flight.size], sent, ticks, delay, arriving_updates, grip)
        sent = np.roll(sent, -(ticks % delay), axis=0)
        return np.concatenate([x, sent.reshape(-1, x.shape[1])])

    def state_after_period(z: Floats) -> Floats:
        z = later(z.reshape(-1, 1), ticks)[:, 0]
        return z - drift @ (drift.T @ z)  # motions of the whole formation are projected out

    if flight.is_free:
        # No vehicle feels them once all it holds is of them: until then, nobody pulls.
        start = np.concatenate([x := flight.rigid_states(), np.zeros((size - len(x), x.shape[1]))])
        known = math.ceil((delay + every + flight.waits) / every) * every
        drift = np.linalg.qr(later(start, known, np.zeros((len(flight.links), x.shape[1]))))[0]
    # No class of its own: what scipy declares of this one is not how it is made.
    operator: Any = LinearOperator((size, size), matvec=state_after_period, dtype=np.float64)  # ty: ignore[missing-argument, unknown-argument, parameter-already-assigned]
    try:
        values = eigs(
            operator, 1, ncv=min(_VECTORS, size - 1), tol=accuracy, return_eigenvectors=False,
            v0=np.random.default_rng(0).normal(size=size),
        )  # fmt: skip
    except ArpackNoConvergence as stopped:  # several motions grow alike
        values = stopped.eigenvalues if len(stopped.eigenvalues) else np.ones(1)
    return math.log(max(np.abs(values).max(), 1e-300)) / (ticks * tick)


def last_stable_delay(flight: LinearFlight) -> int:
    """Last delay in ticks at which no motion grows; 0 if there is none, or the last one that is looked at."""
    most = max(1, math.ceil(_LATEST / flight.radio.tick))
    roughly = _last_delay(flight, min(flight.radio.delay, most), most, *_ROUGH)
    return _last_delay(flight, roughly, roughly, *_FINE) if roughly else 0


def _last_delay(flight: LinearFlight, trial: int, most: int, accuracy: float, growth: float) -> int:
    """Last delay in ticks up to ``most`` at which motions grow by less, looked for from ``trial`` on."""
    low, high = 0, trial
    while growth_rate_at_delay(flight, high, accuracy) < growth:
        if high == most:
            return most
        low, high = high, min(2 * high, most)
    while high - low > 1:
        middle = (low + high) // 2
        stable = growth_rate_at_delay(flight, middle, accuracy) < growth
        low, high = (middle, high) if stable else (low, middle)
    return low


def rms_growth(flight: LinearFlight, losses: Floats, *, states: int, time: float = _TIME) -> Floats:
    """Growth [1/s] of the root mean square of errors of edges, for each share of messages lost."""
    rng = np.random.default_rng(0)
    delay, every = flight.radio.delay, flight.radio.every
    kept = np.repeat(1.0 - losses, states)
    spread = np.sqrt(kept * (1.0 - kept))
    block = np.arange(len(flight.links) * len(losses)).reshape(-1, len(losses), 1) * states

    def arriving_updates(tick_index: int, news: Callable[[int], Floats]) -> Floats | float:
        if (tick_index - delay) % every:
            return 0.0
        change = news(0)
        # Of which other state each link has its noise: a rotation of those with the same loss. One rotation for all
        # links would draw the states together.
        turn = (np.arange(states) + rng.integers(0, states, (len(flight.links), 1, 1))) % states
        other = np.take(change.reshape(len(change), -1), (block + turn).ravel(), axis=1)
        sign = rng.integers(0, 2, (len(turn), len(kept))) * 2.0 - 1.0
        return kept * change + spread * sign * other.reshape(change.shape)

    return _simulated_growth(flight, delay, (len(losses), states), time, arriving_updates)


def _simulated_growth(
    flight: LinearFlight,
    depth: int,
    shape: tuple[int, int],
    time: float,
    arrivals: Arrivals,
    grip: Floats | None = None,
) -> Floats:
    """Growth [1/s] of root mean squares of errors of edges, from the second to the last quarter of a time [s].

    Groups (B,) of flights of a ``shape`` (B, states) begin at random places; ``depth`` ticks of messages are kept.
    """
    columns = math.prod(shape)
    x, places = np.zeros((flight.size, columns)), 3 * flight.n
    x[:places] = np.random.default_rng(1).normal(size=(places, columns))
    sent, ticks = np.zeros((depth, *flight.shape, columns)), round(time / flight.radio.tick)
    squares, _ = flight.squares_and_end(x, sent, ticks, flight.radio.delay, arrivals, grip)
    squares = squares.reshape(ticks, *shape).mean(axis=2)
    quarter = ticks // 4
    before, after = squares[quarter : 2 * quarter], squares[-quarter:]
    return 0.5 * np.log(after.mean(axis=0) / before.mean(axis=0)) / (0.5 * time)


def greatest_stable_loss(flight: LinearFlight) -> float:
    """Share of messages lost up to which the formation is stable in mean square at its own delay."""
    few, many, links = _STATES
    states = min(max(links // len(flight.links), few), many)

    stable = 0
    for step in (10, 1):  # in hundredths
        tried = np.arange(stable + step, stable + 10 * step, step)
        grows = rms_growth(flight, tried / 100, states=states) > _GROWS
        stable += step * int(np.append(grows, True).argmax())
    return stable / 100


def growth_rates_of_trials(flight: LinearFlight, net: Links, every: int) -> Floats:
    """Growth [1/s] of the errors of edges in some flights (B,) with the losses, jitter and time-outs of a network."""
    rng, delay, L = np.random.default_rng(0), flight.radio.delay, len(flight.links)
    late = math.ceil((net.delay + net.jitter) / every) - delay
    fading, grip = np.zeros((L, _FLIGHTS), dtype=np.bool_), np.ones((L, _FLIGHTS))
    due, newest = np.full((late + 1, L, _FLIGHTS), -1), np.zeros((L, _FLIGHTS), dtype=np.int64)

    def arriving_updates(tick_index: int, news: Callable[[int], Floats]) -> Floats | float:
        # The message sent at tick k - delay is due in some ticks from now, or never.
        total: Floats | float = 0.0
        due[(tick_index - delay) % len(due)] = -1
        if (tick_index - delay) % flight.radio.every == 0:
            draw, wait = rng.random((2, L, _FLIGHTS))
            fading[:] = np.where(fading, draw >= net.recovers, draw < net.worsens)
            wait = (wait * (late + 1)).astype(np.int64)
            due[(tick_index - delay) % len(due)] = np.where(fading, -1, tick_index + wait)
        for waited in range(late + 1):  # the newest of those that arrive together
            sent = tick_index - delay - waited
            now = (due[sent % len(due)] == tick_index) & (sent > newest)
            if now.any():
                newest[now] = sent
                total = total + now * news(waited)
        change = np.where(tick_index - newest > net.silence / every, -every, every) / net.silence
        np.clip(grip + change, 0.0, 1.0, out=grip)
        return total

    return _simulated_growth(flight, delay + late, (_FLIGHTS, 1), _TIME, arriving_updates, grip)


def network_remarks(preflight: Preflight) -> Iterator[Remark]:
    """Remarks on formations whose network is beyond what they bear, or was not checked."""
    mission, planned = preflight.mission, preflight.flown_phases
    for name in dict.fromkeys(name for p in planned if (name := p.leg.formation) is not None):
        unchecked = mission.network is not None and name not in preflight.network
        if unchecked and len(mission.formation_edges(name)):
            text = f"'{name}': not checked over its network: it has no slots, no edge in range, or too many edges"
            yield Remark("note", "network", text)
    for name, f in preflight.network.items():
        if far := f.unheard_edges:
            text = f"'{name}': {far} edges are longer than the range of the network: nobody hears along them"
            yield Remark("note", "network", text)
        if f.bears_own_network:
            continue
        share, what = f.growing or 0.0, f"{100 * f.own_loss:.0f} % of its messages are lost"
        why, remedy = what, "lower network.loss, raise network.rate, or slow the constraint law"
        if f.own_delay_ticks > f.delay_ticks:
            why = f"its messages are up to {f.own_delay_ticks} ticks late, and it bears {f.delay_ticks}"
            remedy = "shorten network.delay, or slow the constraint law"
        grows = f"errors grow in {100 * share:.0f} % of linear flights"
        text = f"'{name}': unstable over its network: {why}; {grows}; {remedy}"
        yield Remark("fails" if share > 0.5 else "note", "network", text)
