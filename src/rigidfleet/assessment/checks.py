"""The checks of a flight."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from rigidfleet._common.quantities import MOTIONS, PLACES, QUANTITIES, Quantity, quantity
from rigidfleet._common.text import agent_names, percent_text
from rigidfleet._common.waypoints import LEEWAY, UNITS, WAYPOINT_TOLERANCE
from rigidfleet.assessment.avoidance import guarantee_checks
from rigidfleet.assessment.fits import is_rigid
from rigidfleet.assessment.measure import Measurements
from rigidfleet.assessment.verdict import (
    FLIPPED,
    TOUCH_DOWN,
    CheckResult,
    Extreme,
    PhaseVerdict,
    limit_check,
    value,
)
from rigidfleet.result import LABELS, Result
from rigidfleet.result.quantities import Samples

# Greatest overlap of a vehicle that stands on an obstacle [m]; more is a collision.
_CONTACT = 1e-6
#: Greatest jump of a velocity that counts as rounding [m/s].
_CORNER = 0.01
#: Why a motion of a curve is not judged.
_NO_MOTION = "straight lines between samples have none. Assume cubics, or give velocities"
#: Greatest distance from the nearest sample at which a moment is still judged [s]: at 10 m/s, a vehicle then
#: flies the tolerance of a waypoint.
_UNSEEN = 0.01


def all_checks(measured: Measurements, phases: list[PhaseVerdict]) -> Iterator[CheckResult]:
    """All checks of a flight: whether it is complete and its record true, its ends of phases, its quantities."""
    yield _completeness_check(measured.result)
    yield from _record_consistency_check(measured)
    yield from _missing_sample_checks(measured)
    yield from _failures_or_nearest(
        [
            *_settling_checks(phases),
            *_shape_checks(measured, phases),
            *_waypoint_checks(phases),
            *_touch_down_checks(measured, phases),
        ]
    )
    for q in QUANTITIES.values():
        yield from _CHECKS.get(q.name, _quantity_check)(measured, q)
    yield from _velocity_jump_check(measured)
    yield from _abort_separation_check(measured)


def _failures_or_nearest(candidates: Iterable[CheckResult]) -> Iterator[CheckResult]:
    """All failures of each check, or what comes nearest to its limit if none failed."""
    by_check: dict[str, list[CheckResult]] = {}
    for candidate in candidates:
        by_check.setdefault(candidate.check, []).append(candidate)
    for every in by_check.values():
        failed = [candidate for candidate in every if not candidate.passed]
        yield from failed or [max(every, key=lambda c: (c.worst or 0.0) / (c.limit or 1.0))]


def _quantity_check(measured: Measurements, q: Quantity) -> Iterator[CheckResult]:
    """Compare a quantity with its limit; without a limit, report what a verdict has of each phase."""
    limit = q.limit_of(measured.mission) if q.key else None
    if limit is None and not q.by_phase:
        return
    e = measured.worst(q.name)
    if e is None and limit is not None and q.who != "pair" and measured.result.interpolation:
        words = f"{q.name_in_words} cannot be judged (limit {limit:g} {q.display_unit}): "
        words += _NO_MOTION if q in MOTIONS else "positions over time do not show it"
        yield CheckResult(q.name, False, words, None, limit, q.unit, at_least=q.at_least)
    elif e is not None or limit is not None:
        yield limit_check(q, e, limit)


def _completeness_check(result: Result) -> CheckResult:
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


def _record_consistency_check(measured: Measurements) -> Iterator[CheckResult]:
    """Fail a record that contradicts itself: it has been altered and proves nothing."""
    contradictions = list(measured.self_contradictions_and_times())
    if contradictions:
        words, when = contradictions[0]
        more = f", and {len(contradictions) - 1} more like that" if len(contradictions) > 1 else ""
        words = f"the record contradicts itself: {words}{more}. Fly the mission again"
        yield CheckResult("record", False, words, when=when)


def _missing_sample_checks(measured: Measurements) -> Iterator[CheckResult]:
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
            away, due = math.inf, min(t, p.t_end)
            if i in measured.flown:
                away = abs(result.time.item(measured.nearest_sample(due, i)) - due)
            if away > _UNSEEN:
                nearest = f"the nearest sample is {away:.2g} s away"
                nearest = nearest if i in measured.flown else "the phase has no sample"
                words = f"the {what} of phase '{p.name}' ({t:.2f} s) is not judged: {nearest}. Record this time"
                yield CheckResult("samples", False, words, away, _UNSEEN, "s", when=t, phase=p.name)


def _settling_checks(phases: list[PhaseVerdict]) -> Iterator[CheckResult]:
    for p in phases:
        if p.settled is not None:
            how = "settled after" if p.settled else "did not settle within"
            words = f"phase '{p.name}' {how} {p.t_end - p.t_start:.2f} s"
            yield CheckResult("settled", p.settled, words, when=p.t_end, phase=p.name)


def _shape_checks(measured: Measurements, phases: list[PhaseVerdict]) -> Iterator[CheckResult]:
    """Check each formation at the end of the phases that shape it, and at the end of the flight."""
    from rigidfleet.mission import KINDS  # takes long to load, and the flight has loaded it

    for i, p in enumerate(phases):
        shaping = KINDS[p.kind].shapes or i == len(phases) - 1
        if not (shaping and p.finished) or p.formation is None:
            continue
        last = measured.parts[i].stop - 1
        edges, _ = measured.edges_and_errors_at_end[i]
        held = False
        if p.distances is not None:
            form = measured.mission.formations[p.formation]
            limit = form.greatest_error(measured.mission.formation_distances(p.formation).min())
            held = p.distances <= limit
            words = f"{value(p.distances, 'm')} off (limit {value(limit, 'm')})"
            words = f"the worst of the {len(edges)} edges of '{p.formation}' is {words}"
            yield _result_at_end(p, "distances", held, words, p.distances, limit, "m")
        if i not in measured.fits_at_end:
            continue
        fit = measured.fits_at_end[i]
        passed = fit.error <= fit.limit
        who = agent_names(fit.pair)
        words = (
            f"{who} are {value(fit.flown, 'm')} apart instead of {value(fit.intended, 'm')}"
            f" (limit {value(fit.limit, 'm')} off)"
        )
        if held and not passed:
            left = measured.left[last]
            shape = form.shape
            wanted = f"no {shape}" if shape else f"not the shape of '{p.formation}'"
            place = np.cumsum(left) - 1  # of each agent among those left
            rigid = is_rigid(measured.result.position[last][left], place[edges])
            state = "rigid, but" if rigid else "held by its edges, but"
            words = f"'{p.formation}' is {state} {wanted}: all {len(edges)} edges hold, yet {words}"
        else:
            words = f"'{p.formation}' is {'' if passed else 'not '}reached: {words}"
        yield _result_at_end(p, "shape", passed, words, fit.error, fit.limit, "m", who=who)
        if fit.in_order is not None:
            words = f"the agents of '{p.formation}' are {'' if fit.in_order else 'not '}in order"
            yield _result_at_end(p, "order", fit.in_order, words)
        if not passed:
            continue  # handedness and side mean nothing for a wrong shape
        if p.handedness is not None:
            words = (
                "is the mirror image of its slots"
                if fit.is_mirrored
                else "has the intended handedness"
            )
            yield _result_at_end(p, "handedness", p.handedness, f"'{p.formation}' {words}")
        if p.flip is not None:
            what = "normal" if fit.dimension == 2 else "direction"
            flipped = "has flipped" if p.flip > FLIPPED else "has not flipped"
            words = f"{what} is {value(p.flip, 'deg')} from where it should point"
            words = f"'{p.formation}' {flipped}: its {words}"
            yield _result_at_end(p, "flip", p.flip <= FLIPPED, words, p.flip, FLIPPED, "deg")


def _result_at_end(
    p: PhaseVerdict, check: str, passed: bool, message: str, *judged: Any, who: str = ""
) -> CheckResult:
    """The result of a check at the end of a phase; ``judged``: the worst value, its limit and their unit."""
    message = f"at the end of phase '{p.name}' ({p.t_end:.2f} s) {message}"
    return CheckResult(check, passed, message, *judged, when=p.t_end, who=who, phase=p.name)


def _waypoint_checks(phases: list[PhaseVerdict]) -> Iterator[CheckResult]:
    """How far each waypoint is missed, in each quantity, or the one missed the most if all are met."""
    points = [(p, what, at) for p in phases for what, at in p.points]
    for name, limit in WAYPOINT_TOLERANCE.items():
        every = [(x, p, what, at) for p, what, at in points if (x := getattr(at, name)) is not None]
        failed = [miss for miss in every if not miss[0] <= limit]
        for miss, p, what, at in failed or sorted(every, key=lambda miss: -miss[0])[:1]:
            unit, passed = UNITS[name], miss <= limit
            words = f"{'met' if passed else 'missed'}, {value(miss, unit)} off in {name}"
            words = f"{what} of phase '{p.name}' is {words} (limit {limit:g} {unit})"
            yield CheckResult(
                f"waypoint_{name}", passed, words, miss, limit, unit, when=at.time, phase=p.name
            )


def _touch_down_checks(measured: Measurements, phases: list[PhaseVerdict]) -> Iterator[CheckResult]:
    """Check how fast vehicles come down at the end of each landing."""
    from rigidfleet.mission import KINDS  # takes long to load, and the flight has loaded it

    for i, p in enumerate(phases):
        if not (p.finished and KINDS[p.kind].lands):
            continue
        k = measured.parts[i].stop - 1
        down = -measured.result.velocity[k, :, 2]
        (at, who), below = measured.near_and_below
        low = who[(at == k) & below.any(axis=0)]
        if not len(low):
            yield _result_at_end(p, "touch_down", False, "no vehicle is on the ground")
            continue
        worst = int(low[down[low].argmax()])
        agent, speed = f"agent {worst + 1}", max(0.0, float(down[worst]))
        words = f"{agent} touches down at {value(speed, 'm/s')} (limit {TOUCH_DOWN:g} m/s)"
        if (off := int(np.isfinite(measured.result.motors_off).sum())) > 0:
            words += f"; {off} vehicle{'s' if off > 1 else ''} may switch off"
        judged = speed <= TOUCH_DOWN, words, speed, TOUCH_DOWN, "m/s"
        yield _result_at_end(p, "touch_down", *judged, who=agent)


def _velocity_jump_check(measured: Measurements) -> Iterator[CheckResult]:
    """Fail limits of acceleration where a curve that others made turns at a corner: none is great enough there."""
    result = measured.result
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
    judged = any(x.limit_of(measured.mission) for x in MOTIONS if x.order == 2)
    if judged:
        words += f" (limit {_CORNER:g} m/s where accelerations are limited)"
    yield limit_check(
        Quantity("corner", "m/s"), e, _CORNER if judged else None, words, passed=not judged
    )


def _separation_check(measured: Measurements, q: Quantity) -> Iterator[CheckResult]:
    e, limit = measured.worst(q.name), measured.mission.limits.separation
    if e is not None:
        words, first = "", measured.first_contact(q.name, e)
        if first is not None:
            words = f"{first.who} collide, first at {first.when:.2f} s; {e.who} overlap the most,"
            words += f" by {value(abs(e.value), 'm')} at {e.when:.2f} s"
        yield limit_check(q, e, q.limit_of(measured.mission), words, first=first)
    elif limit is not None and measured.result.interpolation is not None:
        one = measured.result.n_agents == 1
        words = (
            f"separation cannot be judged (limit {limit:g} m): there"
            f" {'is one vehicle alone' if one else 'are never two vehicles at one time'}. Give the other vehicles, name"
            " the column that tells which vehicle a row is of, or ask for no separation"
        )
        yield CheckResult(q.name, False, words, None, limit, q.unit, at_least=q.at_least)


def _flying_separation_check(measured: Measurements, q: Quantity) -> Iterator[CheckResult]:
    """Check the separation of agents of which one is at the altitude from which on it holds."""
    limit, altitude = q.limit_of(measured.mission), measured.mission.limits.separation_altitude
    if limit is not None and measured.worst("separation") is not None:
        e = measured.worst(q.name)
        words = "no two agents come as near" if e is None else _separation_in_words(e)
        words += f" with one at z = {altitude:g} m or above (limit {limit:g} m)"
        yield limit_check(q, e, limit, words)


def _certificate_shortfall_check(measured: Measurements, q: Quantity) -> Iterator[CheckResult]:
    """How much nearer agents come in each phase than its plan's certificate says."""
    allowed, checks = q.limit_of(measured.mission), []
    for record, worst in zip(measured.result.phases, measured.worst_by_phase, strict=True):
        if record.planned is not None and (e := worst.get("separation")) is not None:
            planned = record.planned["separation"]
            words = (
                f"in phase '{record.name}' {_separation_in_words(e)};"
                f" the plan proves {value(planned, 'm')}, of which {allowed:g} m are allowed for tracking"
            )
            checks.append(limit_check(q, replace(e, value=planned - e.value), allowed, words))
    yield from _failures_or_nearest(checks)


def _abort_separation_check(measured: Measurements) -> Iterator[CheckResult]:
    """Compare the separation on the way home, after an abort, with the one that was proved before the flight."""
    since, promised = measured.result.statistics.get("promised", (math.inf, 0.0))
    pairs = zip(measured.result.phases, measured.worst_by_phase, strict=True)
    every = [x["separation"] for p, x in pairs if p.t_start >= since and "separation" in x]
    if every:
        e = min(every, key=lambda x: x.value)
        words = f"on the way home {_separation_in_words(e)} (promised {value(promised, 'm')})"
        yield limit_check(replace(QUANTITIES["separation"], name="way_home"), e, promised, words)


def _separation_in_words(e: Extreme) -> str:
    return f"{e.who} come within {value(e.value, 'm')} of each other at {e.when:.2f} s"


def _clearance_checks(measured: Measurements, q: Quantity) -> Iterator[CheckResult]:
    """Check the clearance in flight, and separately that of vehicles that stand on an obstacle at start or end."""
    if (least := measured.worst(q.name)) is None:
        return
    apart = {name: e for name, e in measured.least_clearances_by_stage().items() if e is not None}
    e = min([least, *apart.values()], key=lambda e: e.value)
    touch = max(_CONTACT, measured.result.statistics.get("touch", 0.0))  # of a log: its noise
    hit = e.value < -touch
    if not hit:
        e = apart.pop("clearance_flight", None)
    if e is not None:
        agent, obstacle = e.who.split(", ", 1)
        words = f"{agent} comes within {value(e.value, 'm')} of '{obstacle}' at {e.when:.2f} s"
        if (first := measured.first_contact(q.name, e)) is not None:
            who, what = first.who.split(", ", 1)
            depth = f"by {value(abs(e.value), 'm')} at {e.when:.2f} s"
            words = f"{who} hits '{what}', first at {first.when:.2f} s; {agent} is deepest in '{obstacle}', {depth}"
        yield limit_check(q, e, q.limit_of(measured.mission), words, passed=not first, first=first)
    for name, when in (("clearance_start", "since the start"), ("clearance_end", "at the end")):
        if name in apart and not hit:
            e = apart[name]
            agent, obstacle = e.who.split(", ", 1)
            how = "in contact with" if e.value <= touch else f"{value(e.value, 'm')} above"
            words = f"{agent} stands {how} '{obstacle}' {when} ({e.when:.2f} s)"
            yield limit_check(quantity(name), e, q.limit_of(measured.mission), words, passed=True)


def _lost_vehicle_checks(measured: Measurements, q: Quantity) -> Iterator[CheckResult]:
    """Check that the vehicles that the mission loses do not hit those still flying; report phases not flown."""
    if not measured.left.all() and measured.mission.first_loss < math.inf:
        who = np.flatnonzero(~measured.left[-1])
        when = measured.mission.lost_at[who]
        losses = (f"agent {i + 1} at {t:.2f} s" for i, t in zip(who, when, strict=True))
        words, first = f"lost: {', '.join(losses)}", None
        if (e := measured.worst(q.name)) is not None:
            if (first := measured.first_contact(q.name, e)) is not None:
                words += f"; after that, {first.who} collide, first at {first.when:.2f} s"
            else:
                words += f"; after that, {_separation_in_words(e)}"
        yield limit_check(q, e, q.limit_of(measured.mission), words, first=first)
    yield from abandonment_check(measured)


def abandonment_check(measured: Measurements) -> Iterator[CheckResult]:
    """Report the phases that the flight left, or never began, after a loss or an order to abort."""
    mission, flown = measured.mission, measured.result.phases
    when = mission.abandons_at
    if not when < measured.result.time[-1]:
        return
    who, what, at = "a loss", f"loss of {mission.first_lost}", mission.first_loss
    if mission.on_loss == "continue" or at > when:
        who, what, at = "the order", "order to abort", when - mission.aborting.reaction
    begun = sum(p.t_start < when for p in flown)
    left = [p.name for p in flown if p.abandoned]
    never = [phase.name for phase in mission.phases[begun:]]
    if not left + never:
        return
    parts = [f"'{name}' was left and is not judged" for name in left]
    if never:
        were = "was" if len(never) == 1 else "were"
        parts.append(f"{', '.join(map(repr, never))} {were} not flown")
    words = f"after the {what} at {at:.2f} s, {'; '.join(parts)}"
    yield CheckResult(
        "abandoned", True, words, float(len(left + never)), when=when, who=who, judged=False
    )


def _geofence_check(measured: Measurements, q: Quantity) -> Iterator[CheckResult]:
    if (limit := q.limit_of(measured.mission)) is None or (e := measured.worst(q.name)) is None:
        return
    words = f"{e.who} comes within {value(-e.value, 'm')} of the geofence at {e.when:.2f} s"
    yield limit_check(q, e, limit, "" if e.value > 0 else words)


def _boundary_check(measured: Measurements, q: Quantity) -> Iterator[CheckResult]:
    """The fence that a vehicle comes nearest to or crosses farthest, and the fall that ends nearest to people."""
    there = getattr(measured.mission, PLACES[q.who])
    if there and (e := measured.worst(q.name)) is not None:
        from rigidfleet.mission.boundaries import boundary_in_words  # takes long to load

        limit, (agent, place) = q.limit_of(measured.mission), e.who.split(", ", 1)
        words = boundary_in_words(q.name, agent, place, e.value, e.when)
        words += f" (limit {limit:g} m)" if q.key else ""
        passed = limit is None or q.rank(e.value) <= q.rank(limit) + LEEWAY
        yield limit_check(q, e, limit, words, passed=passed)


def _thrust_checks(measured: Measurements, q: Quantity) -> Iterator[CheckResult]:
    """Check the vehicle nearest to its own thrust limit; report the greatest thrust if another vehicle has it."""
    if (e := measured.worst(q.name)) is None:
        return  # nobody knows what a trajectory from elsewhere needs
    limits, margin = measured.mission.fleet.thrust_limit, QUANTITIES["thrust_margin"]
    beyond = measured.worst_among(
        margin.name, Samples(margin, measured.samples_of("thrust").values - limits)
    )
    if beyond is None:
        yield limit_check(q, e, None)
        return
    own = {f"agent {i + 1}": most for i, most in enumerate(limits.tolist())}
    if e.value - own[e.who] < beyond.value:
        yield limit_check(quantity("thrust_peak"), e, None)
        e = replace(beyond, value=beyond.value + own[beyond.who])
    yield limit_check(q, e, own[e.who])


def _rotor_force_check(measured: Measurements, q: Quantity) -> Iterator[CheckResult]:
    """The rotor nearest to its limit, from step to step and at samples."""
    result, limits = measured.result, np.array(q.limit_of(measured.mission))
    if result.rotor_force is None or not limits.any():
        return
    safe = np.where(limits > 0.0, limits, np.inf)
    rotors = [
        (x.value / safe[x.who], x.value, x.time, x.who, x.other, p.name)
        for p in result.phases
        if (x := p.extremes.get(q.name)) is not None
    ]
    force = np.where(measured.left[..., None], result.rotor_force, 0.0)
    k, i, j = np.unravel_index(int((force / safe[:, None]).argmax()), force.shape)
    worst, name = float(force[k, i, j]), result.phases[result.phase[k]].name
    rotors.append((worst / safe[i], worst, float(result.time[k]), int(i), int(j), name))
    share, worst, when, i, j, phase = max(rotors)
    limit, e = float(limits[i]), Extreme(worst, when, f"agent {i + 1}", phase, len(rotors) == 1)
    words = (
        f"the {LABELS['rotor'][j]} rotor of {e.who} gives up to {value(worst, 'N')} at {when:.2f} s"
        f" (limit {value(limit, 'N')})"
    )
    yield limit_check(q, e, limit, words, passed=share <= 1.0 + LEEWAY)


def _saturation_check(measured: Measurements, q: Quantity) -> Iterator[CheckResult]:
    """Share of a phase in which a vehicle with rotors cannot give what is asked of it."""
    e, limit = measured.worst(q.name), q.limit_of(measured.mission)
    if e is None or not any(QUANTITIES["rotor_force"].limit_of(measured.mission)):
        return
    words = (
        f"{e.who} cannot give what is asked of it for {percent_text(e.value / 100)} of phase '{e.phase}'"
        f" (limit {percent_text(limit / 100)})"
    )
    if e.value == 0.0:
        yield CheckResult(q.name, True, q.nothing, 0.0, limit, q.unit)
    else:
        yield limit_check(q, e, limit, words)


def _tilt_check(measured: Measurements, q: Quantity) -> Iterator[CheckResult]:
    """Check the tilt: of vehicles with rotors always, of points where it is limited."""
    if not any(QUANTITIES["rotor_force"].limit_of(measured.mission)):
        yield from _quantity_check(measured, q)
    elif (e := measured.worst(q.name)) is not None:
        yield limit_check(q, e, q.limit_of(measured.mission))


def _tracking_check(measured: Measurements, q: Quantity) -> Iterator[CheckResult]:
    """Check how far agents are off the slots that they track: of vehicles at every tick, of points at samples."""
    limit = q.limit_of(measured.mission)
    own = measured.result.interpolation is None  # the curves of others are their own slots
    e = measured.worst(q.name) if own else None
    if e is not None or limit is not None:
        yield limit_check(q, e, limit)


#: Checks that are more than a comparison with a limit, by quantity.
_CHECKS: dict[str, Callable[[Measurements, Quantity], Iterator[CheckResult]]] = {
    "separation": _separation_check,
    "separation_flying": _flying_separation_check,
    "separation_as_planned": _certificate_shortfall_check,
    "clearance": _clearance_checks,
    "lost": _lost_vehicle_checks,
    "geofence": _geofence_check,
    **dict.fromkeys(("fence", "soft_fence", "people"), _boundary_check),
    "thrust": _thrust_checks,
    "rotor_force": _rotor_force_check,
    "saturation": _saturation_check,
    "tilt": _tilt_check,
    "tracking_error": _tracking_check,
    "guarantee": guarantee_checks,
}
