"""The checks of a flight."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from operator import itemgetter
from typing import Any

import numpy as np

from rigidfleet._common.text import agent_names
from rigidfleet._common.waypoints import UNITS, WAYPOINT_TOLERANCE
from rigidfleet.assessment.avoidance import guarantee_checks
from rigidfleet.assessment.fits import is_rigid
from rigidfleet.assessment.measure import Measurements
from rigidfleet.assessment.outcome import (
    FLIPPED,
    SLACK,
    TOUCH_DOWN,
    CheckResult,
    Extreme,
    PhaseVerdict,
    bounded,
    value,
)
from rigidfleet.assessment.vehicles import tracking_check, vehicle_checks
from rigidfleet.assessment.verdict import Verdict
from rigidfleet.result import DIRECTIONS, PAD, Result
from rigidfleet.typing import Floats

# Greatest overlap of a vehicle that stands on an obstacle [m]; more is a collision.
_CONTACT = 1e-6
#: Greatest jump of a velocity that counts as rounding [m/s].
_CORNER = 0.01
#: Greatest distance from the nearest sample at which a moment is still judged [s]: at 10 m/s, a vehicle then
#: flies the tolerance of a waypoint.
_UNSEEN = 0.01


def all_checks(measured: Measurements, verdict: Verdict) -> Iterator[CheckResult]:
    """All checks of a flight.

    A check made in several phases yields every failure, or the pass nearest to the limit if there is none.
    """
    yield _complete(measured.result)
    yield from _record(measured)
    yield from _unseen(measured)
    candidates = [
        *_settled(verdict.phases),
        *_shapes(measured, verdict.phases),
        *_waypoints(verdict.phases),
        *_touch_downs(measured, verdict.phases),
    ]
    yield from _failures_or_worst(candidates)
    worst, limits = verdict.worst, measured.mission.limits
    if "separation" in worst:
        yield _separation(measured, worst["separation"])
        if limits.separation is not None and limits.separation_altitude is not None:
            yield _flying(measured, limits.separation, limits.separation_altitude)
        yield from _failures_or_worst(_as_planned(measured, verdict.phases))
    elif limits.separation is not None and measured.result.interpolation is not None:
        yield _alone(limits.separation, measured.result.n_agents)
    if "clearance" in worst:
        yield from _clearances(measured)
    if not measured.left.all() and measured.mission.first_loss < math.inf:
        yield _lost(measured)
    yield from abandoned(measured)
    if limits.separation_below is not None:
        yield _downwash(measured, limits.separation_below)
    if limits.geofence is not None:
        yield _geofence(measured, np.array(limits.geofence.min), np.array(limits.geofence.max))
    yield bounded("speed", worst.get("speed"), "m/s", limits.speed)
    acceleration = worst.get("acceleration")
    if acceleration is not None or limits.acceleration is not None:
        yield _moving("acceleration", acceleration, "m/s^2", limits.acceleration)
    for name in DIRECTIONS:
        if (limit := getattr(limits, name)) is not None:
            unit = "m/s" if name.endswith("speed") else "m/s^2"
            yield _moving(name, measured.directed(name), unit, limit)
    yield from _corners(measured)
    yield from _thrust(measured, worst.get("thrust"))
    yield from vehicle_checks(measured)
    yield from tracking_check(measured)
    yield from guarantee_checks(measured)
    units = {"constraint": "m", "constraint_force": "N", "tension": "N", "singular_value": ""}
    yield from (bounded(name, worst[name], units[name], None) for name in units if name in worst)


def _failures_or_worst(candidates: Iterable[CheckResult]) -> Iterator[CheckResult]:
    """All failures of each check, or its finding nearest to the limit if none failed."""
    by_check: dict[str, list[CheckResult]] = {}
    for finding in candidates:
        by_check.setdefault(finding.check, []).append(finding)
    for found in by_check.values():
        failed = [finding for finding in found if not finding.passed]
        yield from failed or [max(found, key=lambda f: (f.worst or 0.0) / (f.limit or 1.0))]


def _beyond_or_greatest(every: list[tuple[Any, ...]], limit: float) -> list[tuple[Any, ...]]:
    """Those whose first number is beyond a limit, or else the one whose first number is greatest.

    Words are written for these alone: a flight has many waypoints and phases, and few fail.
    """
    greatest = max(every, key=itemgetter(0), default=(-math.inf,))
    return [x for x in every if x[0] > limit] if greatest[0] > limit else [greatest][: len(every)]


def _complete(result: Result) -> CheckResult:
    end = float(result.time[-1])
    finite = np.isfinite(result.position)
    if not finite.all():
        lost = ~finite.all(axis=2)
        bad = float(result.time[int(np.argmax(np.any(lost, axis=1)))])
        who = agent_names(np.flatnonzero(np.any(lost, axis=0)))
        words = f"the position of {who} is not finite, first at {bad:.2f} s"
        return CheckResult("complete", False, words, when=bad, who=who)
    if result.complete:
        return CheckResult("complete", True, f"the flight reached its end at {end:.2f} s", when=end)
    words = (
        f"the flight is incomplete; it ended at {end:.2f} s: {result.ending or 'it was stopped'}"
    )
    return CheckResult("complete", False, words, when=end, phase=result.phases[-1].name)


def _record(measured: Measurements) -> Iterator[CheckResult]:
    """Fail a record that contradicts itself: it has been altered and proves nothing."""
    found = list(measured.contradictions())
    if found:
        words, when = found[0]
        more = f", and {len(found) - 1} more like that" if len(found) > 1 else ""
        words = f"the record contradicts itself: {words}{more}. Fly the mission again"
        yield CheckResult("record", False, words, when=when)


def _unseen(measured: Measurements) -> Iterator[CheckResult]:
    """Fail waypoints and ends of shaping phases that no sample is near: they cannot be judged."""
    from rigidfleet.mission import KINDS  # takes long to load, and the flight has loaded it

    result = measured.result
    last = len(result.phases) - 1
    for i, p in enumerate(result.phases):
        if p.abandoned or (not result.complete and i == last):
            continue
        target = p.target or {}
        moments = {"waypoint": target.get("time")}
        for k, point in enumerate(target.get("through", ()), start=1):
            moments[f"point {k} on the way"] = point["time"]
        if KINDS[p.kind].shapes or i == last or p.stay is not None:
            moments["end"] = p.t_end
        for what, t in moments.items():
            if t is None:
                continue
            away, nearest = math.inf, "the phase has no sample"
            if i in measured.flown:
                due = min(t, p.t_end)
                away = abs(float(result.time[measured.nearest(due, i)]) - due)
                nearest = f"the nearest sample is {away:.2g} s away"
            if away > _UNSEEN:
                words = f"the {what} of phase '{p.name}' ({t:.2f} s) is not judged: {nearest}. Record this time"
                yield CheckResult("samples", False, words, away, _UNSEEN, "s", when=t, phase=p.name)


def _settled(phases: list[PhaseVerdict]) -> Iterator[CheckResult]:
    for p in phases:
        if p.settled is not None:
            how = "settled after" if p.settled else "did not settle within"
            words = f"phase '{p.name}' {how} {p.t_end - p.t_start:.2f} s"
            yield CheckResult("settled", p.settled, words, when=p.t_end, phase=p.name)


def _shapes(measured: Measurements, phases: list[PhaseVerdict]) -> Iterator[CheckResult]:
    """Check each formation at the end of the phases that shape it, and at the end of the flight."""
    from rigidfleet.mission import KINDS  # takes long to load, and the flight has loaded it

    for i, p in enumerate(phases):
        shaping = KINDS[p.kind].shapes or i == len(phases) - 1
        if not (shaping and p.finished) or p.formation is None:
            continue
        last = measured.samples[i].stop - 1
        edges, _ = measured.edges(p.formation, last)
        held = False
        if p.distances is not None:
            shortest = float(measured.formation(p.formation)[2].min())
            limit = measured.mission.formations[p.formation].greatest_error(shortest)
            held = p.distances <= limit
            words = f"{value(p.distances, 'm')} off (limit {value(limit, 'm')})"
            words = f"the worst of the {len(edges)} edges of '{p.formation}' is {words}"
            yield _at_end(p, "distances", held, words, p.distances, limit, "m")
        if i not in measured.fits:
            continue
        fit = measured.fits[i]
        passed = fit.error <= fit.limit
        who = agent_names(fit.pair)
        words = (
            f"{who} are {value(fit.flown, 'm')} apart instead of {value(fit.intended, 'm')}"
            f" (limit {value(fit.limit, 'm')} off)"
        )
        if held and not passed:
            left = measured.left[last]
            form = measured.mission.formations[p.formation].shape
            wanted = f"no {form}" if form else f"not the shape of '{p.formation}'"
            place = np.cumsum(left) - 1  # of each agent among those left
            rigid = is_rigid(measured.result.position[last][left], place[edges])
            state = "rigid, but" if rigid else "held by its edges, but"
            words = f"'{p.formation}' is {state} {wanted}: all {len(edges)} edges hold, yet {words}"
        elif not passed:
            words = f"'{p.formation}' is not reached: {words}"
        else:
            words = f"'{p.formation}' is reached: {words}"
        yield _at_end(p, "shape", passed, words, fit.error, fit.limit, "m", who=who)
        if fit.in_order is not None:
            words = f"the agents of '{p.formation}' are {'' if fit.in_order else 'not '}in order"
            yield _at_end(p, "order", fit.in_order, words)
        if not passed:
            continue  # handedness and side mean nothing for a wrong shape
        if p.handedness is not None:
            words = (
                "is the mirror image of its slots"
                if fit.mirrored
                else "has the intended handedness"
            )
            yield _at_end(p, "handedness", p.handedness, f"'{p.formation}' {words}")
        if p.flip is not None:
            what = "normal" if fit.dimension == 2 else "direction"
            flipped = "has flipped" if p.flip > FLIPPED else "has not flipped"
            words = f"{what} is {value(p.flip, 'deg')} from where it should point"
            words = f"'{p.formation}' {flipped}: its {words}"
            yield _at_end(p, "flip", p.flip <= FLIPPED, words, p.flip, FLIPPED, "deg")


def _at_end(
    p: PhaseVerdict,
    check: str,
    passed: bool,
    words: str,
    worst: float | None = None,
    limit: float | None = None,
    unit: str = "",
    who: str = "",
) -> CheckResult:
    """A finding about the end of a phase."""
    words = f"at the end of phase '{p.name}' ({p.t_end:.2f} s) {words}"
    return CheckResult(
        check, passed, words, worst, limit, unit, when=p.t_end, who=who, phase=p.name
    )


def _waypoints(phases: list[PhaseVerdict]) -> Iterator[CheckResult]:
    """How well every waypoint is met, in each quantity."""
    points = [
        (p, what, at)
        for p in phases
        for what, at in (
            *((f"point {k} on the way", at) for k, at in enumerate(p.through, start=1)),
            ("the waypoint", p.waypoint),
            ("the place at the end", p.stay),
        )
        if at is not None
    ]
    for name, limit in WAYPOINT_TOLERANCE.items():
        unit = UNITS[name]
        misses = [(m, *point) for point in points if (m := getattr(point[2], name)) is not None]
        for miss, p, what, at in _beyond_or_greatest(misses, limit):
            passed = miss <= limit
            words = f"{'met' if passed else 'missed'}, {value(miss, unit)} off in {name}"
            words = f"{what} of phase '{p.name}' is {words} (limit {limit:g} {unit})"
            yield CheckResult(
                f"waypoint_{name}", passed, words, miss, limit, unit, when=at.time, phase=p.name
            )


def _touch_downs(measured: Measurements, phases: list[PhaseVerdict]) -> Iterator[CheckResult]:
    """Check how fast vehicles come down at the end of each landing."""
    from rigidfleet.mission import KINDS  # takes long to load, and the flight has loaded it

    for i, p in enumerate(phases):
        if not (p.finished and KINDS[p.kind].lands):
            continue
        k = measured.samples[i].stop - 1
        down = -measured.result.velocity[k, :, 2]
        who = np.flatnonzero(measured.left[k] & (measured.close.each[k] <= PAD))
        who = who[measured.standing(np.full(len(who), k), who).any(axis=0)]
        if not len(who):
            yield _at_end(p, "touch_down", False, "no vehicle is on the ground")
            continue
        worst = int(who[down[who].argmax()])
        speed = max(0.0, float(down[worst]))
        words = (
            f"agent {worst + 1} touches down at {value(speed, 'm/s')} (limit {TOUCH_DOWN:g} m/s)"
        )
        if (off := int(np.isfinite(measured.result.motors_off).sum())) > 0:
            words += f"; {off} vehicle{'s' if off > 1 else ''} may switch off"
        passed = speed <= TOUCH_DOWN
        yield _at_end(
            p, "touch_down", passed, words, speed, TOUCH_DOWN, "m/s", who=f"agent {worst + 1}"
        )


def _moving(check: str, e: Extreme | None, unit: str, limit: float | None) -> CheckResult:
    """As `bounded`; a limit of what a trajectory does not have fails."""
    if e is not None or limit is None:
        return bounded(check, e, unit, limit)
    words = (
        f"{check.replace('_', ' ')} cannot be judged (limit {limit:g} {unit}): straight lines between samples have"
        " none. Assume cubics, or give velocities"
    )
    return CheckResult(check, False, words, None, limit, unit)


def _corners(measured: Measurements) -> Iterator[CheckResult]:
    """Fail limits of acceleration where a curve that others made turns at a corner: none is great enough there."""
    result, limits = measured.result, measured.mission.limits
    if result.interpolation is None or not np.isfinite(result.acceleration).any():
        return  # of straight lines, accelerations are not judged at all
    first = np.flatnonzero(np.nextafter(result.time[:-1], np.inf) >= result.time[1:])
    by = np.linalg.norm(result.velocity[first + 1] - result.velocity[first], axis=2)
    by *= result.left[first] & result.left[first + 1]
    if not by.size or by.max() <= _CORNER:
        return
    k, i = np.unravel_index(int(by.argmax()), by.shape)
    e = Extreme(float(by[k, i]), float(result.time[first[k]]), f"agent {i + 1}", "")
    words = f"{e.who} turns at a corner at {e.when:.2f} s: its velocity jumps by {value(e.value, 'm/s')}"
    judged = any(getattr(limits, f"{way}acceleration") for way in ("", "horizontal_", "vertical_"))
    if judged:
        words += f" (limit {_CORNER:g} m/s where accelerations are limited)"
    yield bounded("corner", e, "m/s", _CORNER if judged else None, words, passed=not judged)


def _separation(measured: Measurements, e: Extreme) -> CheckResult:
    limit = measured.mission.limits.separation_always or 0.0
    passed = e.value > 0 and e.value >= limit - SLACK
    words = f"{e.who} come within {value(e.value, 'm')} of each other at {e.when:.2f} s"
    words += f" (limit {limit:g} m)"
    if (first := measured.first_contact("separation", e)) is not None:
        words = f"{first.who} collide, first at {first.when:.2f} s; {e.who} overlap the most,"
        words += f" by {value(abs(e.value), 'm')} at {e.when:.2f} s"
    return bounded("separation", e, "m", limit, words, passed=passed, at_least=True, first=first)


def _flying(measured: Measurements, limit: float, altitude: float) -> CheckResult:
    """Check the separation of agents of which one is at the altitude from which on it holds."""
    e, words = measured.worst("separation_flying", None, lambda x: -x), "no two agents come as near"
    if e is not None:
        words = f"{e.who} come within {value(e.value, 'm')} of each other at {e.when:.2f} s"
    words += f" with one at z = {altitude:g} m or above (limit {limit:g} m)"
    passed = e is None or e.value >= limit - SLACK
    return bounded("separation_flying", e, "m", limit, words, passed=passed, at_least=True)


def _alone(limit: float, n: int) -> CheckResult:
    """Fail a separation that was asked for where there is no second vehicle."""
    words = "is one vehicle alone" if n == 1 else "are never two vehicles at one time"
    words = (
        f"separation cannot be judged (limit {limit:g} m): there {words}. Give the other vehicles, name the column that"
        " tells which vehicle a row is of, or ask for no separation"
    )
    return CheckResult("separation", False, words, None, limit, "m")


def _as_planned(measured: Measurements, phases: list[PhaseVerdict]) -> Iterator[CheckResult]:
    """How much nearer agents come in each phase than its plan's certificate says."""
    allowed = measured.mission.limits.separation_allowance
    every = [
        (record.planned["separation"] - phase.worst["separation"].value, record, phase)
        for record, phase in zip(measured.result.phases, phases, strict=True)
        if record.planned is not None and "separation" in phase.worst
    ]
    for off, record, phase in _beyond_or_greatest(every, allowed):
        e, planned = phase.worst["separation"], (record.planned or {})["separation"]
        words = (
            f"in phase '{phase.name}' {e.who} come within {value(e.value, 'm')} of each other at {e.when:.2f} s;"
            f" the plan proves {value(planned, 'm')}, of which {allowed:g} m are allowed for tracking"
        )
        e = replace(e, value=off)
        yield bounded("separation_as_planned", e, "m", allowed, words)


def _clearances(measured: Measurements) -> Iterator[CheckResult]:
    """Check the clearance in flight, and separately that of vehicles that stand on an obstacle at start or end."""
    found = {name: e for name, e in measured.clearances().items() if e is not None}
    every = [*found.values(), measured.worst_clearance()]
    e = min((e for e in every if e is not None), key=lambda e: e.value)
    hit = e.value < -_CONTACT
    if not hit:
        e = found.pop("clearance_flight", None)
    if e is not None:
        agent, obstacle = e.who.split(", ", 1)
        words = f"{agent} comes within {value(e.value, 'm')} of '{obstacle}' at {e.when:.2f} s"
        if (first := measured.first_contact("clearance", e)) is not None:
            who, what = first.who.split(", ", 1)
            depth = f"by {value(abs(e.value), 'm')} at {e.when:.2f} s"
            words = f"{who} hits '{what}', first at {first.when:.2f} s; {agent} is deepest in '{obstacle}', {depth}"
        yield bounded("clearance", e, "m", 0.0, words, passed=not first, at_least=True, first=first)
    for name, when in (("clearance_start", "since the start"), ("clearance_end", "at the end")):
        if name in found and not hit:
            e = found[name]
            agent, obstacle = e.who.split(", ", 1)
            how = "in contact with" if e.value <= _CONTACT else f"{value(e.value, 'm')} above"
            words = f"{agent} stands {how} '{obstacle}' {when} ({e.when:.2f} s)"
            yield bounded(name, e, "m", 0.0, words, passed=True, at_least=True)


def _lost(measured: Measurements) -> CheckResult:
    """Check that the vehicles that the mission loses do not hit those still flying."""
    who = np.flatnonzero(~measured.left[-1])
    when = measured.mission.lost_at[who]
    told = ", ".join(f"agent {i + 1} at {t:.2f} s" for i, t in zip(who, when, strict=True))
    e = measured.fallen_on()
    if e is None:
        return bounded("lost", e, "m", 0.0, f"lost: {told}", at_least=True)
    words = f"lost: {told}; after that, {e.who} come within {value(e.value, 'm')} of each other"
    words += f" at {e.when:.2f} s"
    if (first := measured.first_contact("lost", e)) is not None:
        words = f"lost: {told}; after that, {first.who} collide, first at {first.when:.2f} s"
    return bounded("lost", e, "m", 0.0, words, passed=e.value > 0, at_least=True, first=first)


def abandoned(measured: Measurements) -> Iterator[CheckResult]:
    """Report the phases that the flight left, or never began, because a vehicle or link was lost."""
    mission, flown = measured.mission, measured.result.phases
    when = mission.first_loss
    if mission.on_loss == "continue" or not when < measured.result.time[-1]:
        return
    begun = sum(p.t_start < when for p in flown)
    left = [p.name for p in flown if p.abandoned]
    never = [phase.name for phase in mission.phases[begun:]]
    if not left + never:
        return
    parts = [f"'{name}' was left and is not judged" for name in left]
    if never:
        parts.append(
            f"{', '.join(map(repr, never))} {'was' if len(never) == 1 else 'were'} not flown"
        )
    words = f"after the loss of {mission.first_lost} at {when:.2f} s, {'; '.join(parts)}"
    yield CheckResult(
        "abandoned", True, words, float(len(left + never)), None, "", when=when, judged=False
    )


def _downwash(measured: Measurements, limit: float) -> CheckResult:
    e = measured.below()
    if e is None:
        words = "no agent flies below another"
        return bounded("separation_below", e, "m", limit, words, at_least=True)
    passed = e.value >= limit - SLACK
    words = f"{e.who} fly one below the other, {value(e.value, 'm')} apart"
    words += f" at {e.when:.2f} s (limit {limit:g} m)"
    return bounded("separation_below", e, "m", limit, words, passed=passed, at_least=True)


def _geofence(measured: Measurements, low: Floats, high: Floats) -> CheckResult:
    e = measured.outside(low, high)
    assert e is not None
    words = f"{e.who} comes within {value(-e.value, 'm')} of the geofence at {e.when:.2f} s"
    if e.value > 0:
        words = f"{e.who} leaves the geofence by {value(e.value, 'm')} at {e.when:.2f} s"
    return bounded("geofence", e, "m", 0.0, words)


def _thrust(measured: Measurements, e: Extreme | None) -> Iterator[CheckResult]:
    """Check the vehicle nearest to its own thrust limit; report the greatest thrust if another vehicle has it."""
    beyond = measured.nearest_to_limit()
    if e is None:
        return  # nobody knows what a trajectory from elsewhere needs
    if beyond is None:
        yield bounded("thrust", e, "N", None)
        return
    limits = measured.mission.agents.thrust_limit

    def limit(who: str) -> float:
        return float(limits[int(who.removeprefix("agent ")) - 1])

    if e.value - limit(e.who) < beyond.value:
        yield bounded("thrust_peak", e, "N", None)
        most = limit(beyond.who)
        e = replace(beyond, value=beyond.value + most)
    yield bounded("thrust", e, "N", limit(e.who))
