"""Notes of a verdict: facts that fail no check but that a reader should know."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rigidfleet._common.text import agent_names, first_few
from rigidfleet.assessment.avoidance import avoidance_notes, clock_notes
from rigidfleet.assessment.checks import abandonment_check
from rigidfleet.assessment.fits import degrees_between_vectors
from rigidfleet.assessment.measure import Measurements
from rigidfleet.assessment.verdict import DIP, FLIPPED, PhaseVerdict, value
from rigidfleet.result.quantities import Samples

#: A speed [m/s] and an extent [m] from which units are doubted.
_FAST, _WIDE = 100.0, 20_000.0
#: Clearance from which on a vehicle stands on nothing, whatever its size [m].
_AWAY = 1.0
#: Greatest number of vehicles whose names are listed.
_NAMED = 20


def verdict_notes(measured: Measurements, phases: list[PhaseVerdict]) -> Iterator[str]:
    """Facts that fail no check but that a reader should know."""
    yield from _abandoned_phase_notes(measured)
    yield from _negative_height_notes(measured)
    yield from _formation_flip_notes(measured, phases)
    yield from _lost_vehicle_fall_notes(measured)
    pairs, times = measured.mission.links_lost
    for (i, j), t in zip(pairs + 1, times, strict=True):
        if t < measured.result.time[-1]:
            yield f"the link {i}-{j} is lost at {t:.2f} s: after that, no edge joins agents {i} and {j}"
    yield from _network_notes(measured)
    agents = measured.mission.agents
    if agents.saturate:
        full = measured.samples_of("thrust").values >= np.array(agents.thrust_limit) * (1 - 1e-6)
        if full.any():
            who = agent_names(np.flatnonzero(full.any(axis=0)))
            since = measured.first_time(full.max(axis=1))
            yield f"the thrust of {who} saturates at its limit, first at {since:.2f} s"
    # A vehicle stands on nothing that is farther away; those that are lost are not measured.
    result = measured.result
    near = ~(measured.closeness.each[-1] > _AWAY) | ~measured.left[-1]
    if near.any() and (words := result.mission.landing_swaps_in_words(result.position[-1])):
        yield words
    yield from clock_notes(measured.result)
    yield from avoidance_notes(measured)
    if "doubt" in measured.result.statistics:
        yield "a log is judged here as if it were exact; `assess MISSION LOG...` judges it with doubt"
    yield from _samples_alone_note(measured)
    yield from _foreign_flight_notes(measured)


def _network_notes(measured: Measurements) -> Iterator[str]:
    """What the network carried, how old what was used became, and which edges were let go."""
    result, net = measured.result, measured.mission.network
    if net is None or result.oldest_message is None or not result.oldest_message.size:
        return
    assert result.messages is not None
    sent, _, lost = result.messages.sum(axis=(0, 1))
    edge, way = np.unravel_index(np.argmax(result.oldest_message), result.oldest_message.shape)
    one, other = (result.edges[edge] + 1)[:: 1 if way == 0 else -1]
    yield (
        f"{sent:,} messages were sent, {lost / max(sent, 1):.0%} of them lost; the oldest that was used was "
        f"{result.oldest_message[edge, way]:.2f} s old, agent {one}'s of agent {other}"
    )
    age = result.message_age
    silent = np.zeros((1, len(result.edges))) if age is None else (age > net.silence).any(axis=2)
    if silent.any():
        edges = [result.edge_labels[k] for k in np.flatnonzero(silent.any(axis=0))]
        since = measured.first_time(silent.max(axis=1))
        yield f"edges that let go for want of messages, first at {since:.2f} s: {first_few(edges, _NAMED)}"


def _foreign_flight_notes(measured: Measurements) -> Iterator[str]:
    """What is judged of a flight that others made, how near its centres come, what is odd, and who is who."""
    result = measured.result
    if (how := result.interpolation) is None:
        return
    yield (
        f"others made this flight: what is judged is its curve, {how}, also between samples; forces, thrust and "
        "attitudes are not known"
    )
    if zero := result.statistics.get("clock"):
        yield f"times count from {zero:.9g} s, the first of the file"
    if any(thing.solid.moves for thing in measured.mission.obstacles):
        yield f"obstacles that move are where they are at the times of the file, from {result.time[0]:.6g} s on"
    radius, e = measured.mission.fleet.radius, measured.worst("separation")
    if e is not None and np.ptp(radius) == 0.0:
        far = value(e.value + 2.0 * float(radius[0]), "m")
        yield f"the least distance centre to centre is {far}, {e.who} at {e.when:.2f} s"
    fast, wide = measured.worst("speed"), float(np.abs(result.position).max())
    if wide > _WIDE or (fast is not None and fast.value > _FAST):
        speeds = "" if fast is None else f"speeds reach {fast.value:,.0f} m/s and "
        yield (
            f"{speeds}positions {wide:,.0f} m: are these metres and seconds? A table may name other units in its "
            "columns: x [mm], time [ms]"
        )
    yield from result.statistics.get("notes", [])
    names = result.statistics.get("names", [])
    if [name.removeprefix("agent ") for name in names] != [f"{k + 1}" for k in range(len(names))]:
        who = "agent 1 is" if len(names) == 1 else "agents from 1 on are"
        yield f"{who} {first_few(names, _NAMED)}"


def _abandoned_phase_notes(measured: Measurements) -> Iterator[str]:
    """Note each phase that was left for another one before it arrived."""
    result = measured.result
    yield from (check.message for check in abandonment_check(measured))
    if result.mission.abandons_at < np.inf:
        return  # no phase of such a mission was begun by hand
    for phase, record in zip(result.mission.phases, result.phases, strict=False):
        if phase.commanded_at_arrival and record.target is None and record.settled is None:
            yield f"'{record.name}' was left at {record.t_end:.2f} s, before its arrival, which is not judged"


def _samples_alone_note(measured: Measurements) -> Iterator[str]:
    """Note a record that does not say what happens between its samples."""
    if any(not measured.result.phases[k].extremes for k in measured.flown):
        step = float(np.diff(measured.result.time).max(initial=0.0))
        yield (
            f"only samples are judged, up to {step:.3g} s apart: the record does not say what happens"
            " between them"
        )


def _lost_vehicle_fall_notes(measured: Measurements) -> Iterator[str]:
    """Note where each lost vehicle falls."""
    radius = measured.mission.agents.radius
    for i in np.flatnonzero(~measured.left[-1] & (measured.mission.lost_at < np.inf)):
        r = measured.result.position[:, i]
        words = f"agent {i + 1}, lost at {measured.mission.lost_at[i]:.2f} s,"
        down = ~measured.left[:, i] & (r[:, 2] <= measured.mission.height_below(*r.T) + radius[i])
        if down.any():
            x, y, _ = r[-1]
            yield f"{words} hits the ground at {measured.first_time(down):.2f} s and lies at ({x:z.1f}, {y:z.1f}) m"
        else:
            yield f"{words} is still falling at z = {r[-1, 2]:.1f} m when the flight ends"


def _negative_height_notes(measured: Measurements) -> Iterator[str]:
    """Note agents below z = 0 that have nothing to stand on below them, if the mission has no geofence."""
    mission, e = measured.mission, measured.worst("lowest")
    if mission.limits.geofence is not None or e is None or e.value >= -DIP:
        return
    sampled, r = measured.samples_of("lowest"), np.moveaxis(measured.result.position, 2, 0)
    if (over := np.isfinite(mission.height_below(*r))).any():  # what is worst may be over ground
        sampled = Samples(sampled.quantity, np.where(over, np.nan, sampled.values))
        e = measured.worst_sample(sampled)
    if e is not None and e.value < -DIP:
        low = np.flatnonzero((sampled.values < -DIP).any(axis=0))
        others = f" ({agent_names(low)} are below 0 at times)" if len(low) > 1 else ""
        yield f"{e.who} dips to z = {e.value:.2f} m at {e.when:.2f} s{others}; the mission has no ground there"


def _formation_flip_notes(measured: Measurements, phases: list[PhaseVerdict]) -> Iterator[str]:
    """Note planar formations that turn over between phases while no attitude is commanded."""
    seen: dict[str, tuple[list[float], float]] = {}
    for i, p in enumerate(phases):
        fit = measured.fits_at_end.get(i)
        if fit is None or p.formation is None or fit.dimension != 2 or p.flip is not None:
            continue
        if not p.finished or fit.error > fit.limit:
            continue
        normal, since = seen.setdefault(p.formation, (fit.turned_axis, p.t_end))
        if degrees_between_vectors(normal, fit.turned_axis) > FLIPPED:
            yield (
                f"'{p.formation}' turns over between {since:.2f} s and {p.t_end:.2f} s;"
                " no attitude is commanded"
            )
