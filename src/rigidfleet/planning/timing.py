"""Least times of the phases of a smooth mission, and the mission with its automatic times replaced by them.

The least time of a phase is the shortest in which its reference keeps every limit of the mission
(`rigidfleet.planning.limits`), from the planned state at its start.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rigidfleet._common.progress import report_step
from rigidfleet.mission import Mission, Phase
from rigidfleet.mission.findings import Keys
from rigidfleet.mission.values import AUTO
from rigidfleet.planning import ways
from rigidfleet.planning.body_trajectories import points_passed
from rigidfleet.planning.courses import moving_slots_conflict_text, way_conflict_text
from rigidfleet.planning.legs import Departure, Leg, depart, leg_from, state_at_start
from rigidfleet.planning.limits import Limit, Reached, limits_of, use_of_limits
from rigidfleet.planning.reference import PhaseState
from rigidfleet.planning.transitions import expand_phases
from rigidfleet.planning.vehicles import tracking_lag_times

#: Shortest and longest time tried [s], and the number of times tried.
_SHORTEST, _LONGEST, _TRIES = 0.1, 1e5, 60
#: Ratio of a time that is long enough to one that is not, at which the search ends; greatest ratio of two times tried
#: one after the other; a guess lies so far beyond the solution that it is long enough, and so far within the bounds.
_CLOSE, _STEP, _NEARLY, _NEAR = 1.006, 4.0, 1.002, 1.005
#: A time that is more than twice as long has to lower the greatest share of a limit at least to this part of it.
_STALLED = 0.98
#: What automatic times have in reserve, and the unit to which they are rounded up [s].
_MARGIN, _UNIT = 1.005, 1e-3
#: Excess over a limit that is ignored.
SLACK = 1e-3
#: What no transition, way or time of a plan depends on: it matters in flight alone.
_IN_FLIGHT = (
    ("integrator",), *(("disturbances", key) for key in ("wind", "drag", "mass_error", "gusts")),
)  # fmt: skip
#: The same of points, unless a phase ends by settling: for vehicles, gains and delays set a reserve of limits.
_IN_FLIGHT_OF_POINTS = ("constraint",), ("disturbances", "noise")


def expand_mission(mission: Mission) -> Mission:
    """The mission with phases for its transitions (`transitions.expand_phases`) and ways (`ways.find_ways`).

    A mission with neither is returned as it is. The result's text is that of these phases; automatic times stay so.

    Raises
    ------
    MissionError
        No transition keeps the separation, or no way is found.
    """
    return _expanded_mission_and_legs(mission)[0]


def _expanded_mission_and_legs(mission: Mission) -> tuple[Mission, list[Leg]]:
    """`expand_mission`, and the legs by which that is planned: of its first phases."""
    return ways.find_ways(*expand_phases(mission, legs_up_to), legs_up_to)


def can_affect_plan(mission: Mission, keys: Keys) -> bool:
    """Whether `expand_mission` may depend on a key of a mission."""
    phases, free = mission.phases, _IN_FLIGHT
    if any(p.vertical is not None and not p.flown_as_written for p in phases):
        free = free[:1]  # ways to own places keep room for what air and noise do
    elif mission.vehicle_models is None and all(p.settle is None for p in phases):
        free += _IN_FLIGHT_OF_POINTS
        # By tracking, the body of a mission that is not smooth comes to rest if it arrives before its phase ends.
        if mission.smooth or all(p.time_key != "travel" for p in phases):
            free += (("tracking",),)
    return not any(keys[: len(x)] == x for x in free)


def complete_times(mission: Mission) -> Mission:
    """Return a mission whose transitions and ways are phases of their own (`expand_mission`), with its times known.

    Automatic times are replaced by the least ones. A mission with neither, or whose times are known, is returned as it
    is.

    Times follow from the planned state at the start of each phase; a phase before that ends by settling is assumed to
    have arrived. The text is that of `expand_mission`, so that a result repeats from it.

    Raises
    ------
    MissionError
        No transition keeps the separation, no time of a phase keeps the limits, its start is not known before the
        flight, a phase ends too early for the times before it, or vehicles end in motion that the next does not go on.
    """
    return timed_mission_and_legs(mission)[0]


def timed_mission_and_legs(mission: Mission) -> tuple[Mission, list[Leg]]:
    """`complete_times`, and the legs from which the times follow: of its first phases."""
    mission, legs = _expanded_mission_and_legs(mission)
    last = max(
        (k for k, phase in enumerate(mission.phases) if phase.auto_keys or phase.follows_curves),
        default=-1,
    )
    changes: dict[int, dict[str, Any]] = {}
    now = state_at_start(mission)
    for k, phase in enumerate(mission.phases[: last + 2]):
        if problem := moving_slots_conflict_text(phase, now):
            remedy = "let the trajectories before end at rest, or let those of each vehicle go on"
            raise ways.error_of_key(mission, k, "kind", None, problem, remedy)
        if k > last:
            break
        if k == len(legs):
            report_step(f"timing '{phase.name}'")
            legs.append(timed_leg(mission, phase, now, k))
        leg = legs[k]
        if phase.auto_keys:
            times = leg.phase.model_dump(mode="json", include={*phase.auto_keys, "through"})
            changes[k] = {key: x for key, x in times.items() if x or key != "through"}
        if not leg.has_known_ways:
            problem = "depends on distances alone, so that the starts of later phases are known only in flight"
            name = None if phase.shaping is None else phase.shaping.formation
            remedy = (
                f"give the formation a shape or slots, or give '{mission.phases[last].name}' a time"
            )
            raise ways.error_of_key(mission, k, "formation", name, problem, remedy)
        now = leg.planned_end_state
    if changes:  # its times may be known already, while its text has the automatic ones
        tables = mission.to_dict()["phases"]
        timed = [x | changes.get(k, {}) for k, x in enumerate(tables)]
        mission = mission.with_phases(timed, as_written=True)
    return mission, legs


def legs_up_to(mission: Mission, end: int, legs: Sequence[Leg] = ()) -> list[Leg]:
    """The legs of a mission's first phases up to a number, as far as known, of which some are planned already."""
    now = legs[-1].planned_end_state if legs else state_at_start(mission)
    return [*legs, *legs_from(mission, now, mission.phases[len(legs) : end], len(legs))]


def legs_from(
    mission: Mission, now: PhaseState, phases: Sequence[Phase], number: int = 0
) -> list[Leg]:
    """The legs of phases in a row, of which the first has a number, from the state at its start, as far as known."""
    legs: list[Leg] = []
    for k, phase in enumerate(phases, start=number):
        if phase.replaced or not (leg := timed_leg(mission, phase, now, k)).has_known_ways:
            break
        legs.append(leg)
        now = leg.planned_end_state
    return legs


def timed_leg(
    mission: Mission, phase: Phase, now: PhaseState, number: int, *, anywhere: bool = False
) -> Leg:
    """The leg of a phase from a state at its start, with the least times in place of its automatic ones.

    With ``anywhere``, ways that are given may begin elsewhere than the vehicles are.

    Raises
    ------
    MissionError
        No time keeps the limits, or the phase follows given ways that begin elsewhere.
    """
    departure = depart(mission, phase, now)

    def refuse_conflicts(phase: Phase) -> None:
        if not anywhere and (problem := way_conflict_text(phase, departure.now)):
            key = "file" if phase.follows_curves else "formation"
            remedy = "lead the vehicles there before, by phases such as 'fly', 'turn' and 'reshape'"
            raise ways.error_of_key(mission, number, key, None, problem, remedy)

    refuse_conflicts(phase)
    if not phase.auto_keys:
        return leg_from(mission, phase, departure)
    phase = _with_point_times(mission, phase, departure)
    shortest, vary = _SHORTEST, partial(_with_travel_time, phase)
    if phase.duration == AUTO and phase.shaping is not None and phase.shaping.blend != AUTO:
        shortest = phase.shaping.least_time
        vary = lambda t: phase.model_copy(update={"duration": t})  # noqa: E731
    time, worst = _min_time(mission, vary, departure, shortest)
    if time is None:
        problem = f"no time keeps the limits of the mission: {reached_in_words(worst, phase)}"
        remedy = f"raise {worst.limit.of.key}, or change the way"
        raise ways.error_of_key(mission, number, phase.auto_keys[0], AUTO, problem, remedy)
    if time > shortest:
        time = math.ceil(time * _MARGIN / _UNIT - 1e-9) * _UNIT
    timed = vary(round(time, 6))
    refuse_conflicts(timed)  # it may begin faster than its file
    return leg_from(mission, timed, departure)


def key_and_least_time(mission: Mission, leg: Leg) -> tuple[str, float | None]:
    """The key of a phase that sets the time of its motion, and its least value [s]; None if no time is enough.

    The least time keeps all limits of the mission, and is found to within 1 %.
    """
    length = {"until": None, "settle": None, "duration": leg.end - leg.start}
    phase = _with_point_times(mission, leg.phase.model_copy(update=length), leg.departure)
    time, _ = _min_time(mission, partial(_with_travel_time, phase), leg.departure, _SHORTEST)
    return phase.time_key, time


def broken_limits(mission: Mission, leg: Leg) -> list[Reached]:
    """Limits that the reference of a planned leg breaks, the worst first."""
    if not leg.phase.tracks_slots:
        return []
    limits = limits_of(mission, lost_by=leg.start)
    over = use_of_limits(limits, leg.reference, leg.motion, leg.start, leg.end)
    return sorted((x for x in over if x.share > 1.0 + SLACK), key=lambda x: -x.share)


def reached_in_words(worst: Reached, phase: Phase) -> str:
    """What is reached of a limit, in words."""
    q, most = worst.limit.of, worst.limit.most[worst.agent]
    return (
        f"agent {worst.agent + 1} would need {worst.value:.3g} {q.display_unit} of {q.name_in_words} at"
        f" {worst.time:.2f} s in '{phase.name}' (limit {most:g} {q.display_unit})"
    )


def _min_time(
    mission: Mission,
    vary: Callable[[float], Phase],
    departure: Departure,
    shortest: float,
    limits: list[Limit] | None = None,
) -> tuple[float | None, Reached]:
    """The least time [s] from ``shortest`` on that keeps the limits; if there is none, what breaks them.

    Vehicles leave a reserve of their limits, unless no time does: of a circle near a limit, for example.
    """
    if limits is None and (reserve := tracking_lag_times(mission)).any():
        fastest = _min_time(mission, vary, departure, shortest, limits_of(mission, reserve=reserve))
        if fastest[0] is not None:
            return fastest
    limits = limits_of(mission) if limits is None else limits

    def use_for_time(time: float, *, fine: bool = False) -> list[Reached]:
        leg = leg_from(mission, vary(time), departure)
        return use_of_limits(limits, leg.reference, leg.motion, leg.start, leg.end, fine=fine)

    # At rest at both ends, every share falls with a power of the time: from a trial, the first guess is the solution.
    low, high, time = 0.0, math.inf, max(_TRIAL, shortest)
    before = math.inf
    for _ in range(_TRIES):
        # The greatest share of a limit, as a power that falls in proportion to the time of ways from rest to rest.
        over = max(x.share ** (1 / x.limit.of.order) for x in use_for_time(time))
        if time > _STEP / 2 * low > 0.0 and over > _STALLED * before:
            low = time  # a longer time does not help: the state at the start, or a circle, is beyond the limit
            break
        before = over
        low, high = (time, high) if over > 1.0 else (low, min(high, time))
        if high <= max(low * _CLOSE, shortest) or low > _LONGEST:
            break
        guess = time * min(max(over * _NEARLY, 1 / _STEP), _STEP)
        time = max(min(max(guess, low * _NEAR), high / _NEAR), shortest)
    if high == math.inf:
        return None, max(use_for_time(low), key=lambda x: x.share)
    while (worst := max(use_for_time(high, fine=True), key=lambda x: x.share)).share > 1.0 + SLACK:
        high *= 1.001  # between the samples of the grid
    return high, worst


def _with_travel_time(phase: Phase, time: float) -> Phase:
    """A phase whose motion takes a time [s]; it does not end before."""
    key = phase.time_key
    times: dict[str, Any] = {key: time}
    if key != "duration":
        if phase.duration == AUTO:
            times["duration"] = time
        elif isinstance(phase.duration, float):
            times["duration"] = max(phase.duration, time)
    if phase.points:
        before = _arrival_time(phase)
        times["through"] = tuple(
            at.model_copy(update={"time": (at.time or 0.0) * time / before}) for at in phase.points
        )
    return phase.model_copy(update=times)


#: Time of a way [s] for which the times of its points are allocated, before the least one is known.
_TRIAL = 10.0


def _arrival_time(phase: Phase) -> float:
    """Time [s] from the start to the arrival; a trial if it is automatic."""
    time = getattr(phase, phase.time_key)
    return time if isinstance(time, float) else _TRIAL


def _with_point_times(mission: Mission, phase: Phase, departure: Departure) -> Phase:
    """A phase whose points to pass have times, in shares of the whole that then stay."""
    if not phase.points:
        return phase
    arriving = phase.model_copy(update={phase.time_key: _arrival_time(phase)})
    points = points_passed(phase.points, leg_from(mission, arriving, departure).motion)
    start = departure.now.t
    through = tuple(
        at.model_copy(update={"time": round(point["time"] - start, 6)})
        for at, point in zip(phase.points, points, strict=True)
    )
    return phase.model_copy(update={"through": through})
