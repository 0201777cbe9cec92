"""Phases that are flown otherwise than written: transitions whose straight ways cross, staggered take-offs, landings.

Agents that exchange places at will cannot all go straight and in step. They go apart instead to levels one above the
other, across, and together again. Each of these is a straight blend in step, so that its least separation is known in
closed form. Agents whose ways across come near each other, as seen from above, get different levels: the levels are
colours of the graph of these conflicts (greedy colouring, the agents with most conflicts first).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any, cast

import numpy as np

from rigidfleet._common.progress import report_step
from rigidfleet.formation.assignment import closest_approach
from rigidfleet.math import rigid_body
from rigidfleet.mission import Mission
from rigidfleet.mission.kinds import Reshape, Vertical
from rigidfleet.mission.values import AUTO
from rigidfleet.planning.homing import WaysHome
from rigidfleet.planning.legs import Leg, state_at_start
from rigidfleet.planning.levels import layer_levels, neighbours_on_ways
from rigidfleet.planning.reference import PhaseState
from rigidfleet.planning.steps import Step, Steps, phases_of
from rigidfleet.planning.transfers import plan_transfer
from rigidfleet.planning.ways import LegsUpTo, error_of_key
from rigidfleet.typing import Floats

#: What the parts of a transition are called.
_PARTS = ("apart", "across", "together")
#: Vehicles whose y differs by less stand in one row [m].
_ROW = 1e-3
#: Room around the slots for bent ways, as a multiple of the height that vehicles keep above each other.
_ROOM = 2.0
#: Excess over a limit that is ignored [m].
_SLACK = 1e-9


def expand_phases(mission: Mission, legs_up_to: LegsUpTo) -> tuple[Mission, list[Leg]]:
    """Return the mission with each phase that is flown as several in their place; itself if it has none.

    A transition by layers becomes three phases, a staggered take-off or landing one for each group of vehicles; one by
    bent ways has their control points.

    The result is an ordinary mission: it can be written, read and flown by itself. Beside it are the legs of its first
    phases, up to the last one whose start has to be known; ``legs_up_to`` plans them (`timing.legs_up_to`).

    Raises
    ------
    MissionError
        The layers of a phase do not keep the separation, or there is no formation before it; or the groups of a
        staggered phase have no time, or would be under way together.
    """
    if all(phase.flown_as_written for phase in mission.phases):
        return mission, []
    data, tables, forms = mission.to_dict(), [], {}
    before: str | None = None
    legs: list[Leg] = []

    def state_after_tables() -> PhaseState | None:
        """The state after the phases so far; None where it is known only in flight."""
        nonlocal legs
        if not tables:
            return state_at_start(mission)
        so_far = {"phases": tables, "formations": data["formations"] | forms}
        legs = legs_up_to(mission.rewritten(data | so_far), len(tables), legs)
        return legs[-1].planned_end_state if len(legs) == len(tables) else None

    for k, phase in enumerate(mission.phases):
        table = data["phases"][k] | {"name": phase.name}
        table.pop("transition", None)
        parts = [table]
        if not phase.flown_as_written:
            expand = _expand_transition if phase.vertical is None else _expand_stagger
            parts, levels = expand(mission, k, table, cast(Any, phase), before, state_after_tables)
            forms |= levels
        tables += parts
        before = before if phase.shaping is None else phase.shaping.formation
    data |= {"phases": tables, "formations": data["formations"] | forms}
    return mission.rewritten(data), legs


#: The state at the start of a phase; None where it is known only in flight.
_State = Callable[[], PhaseState | None]
#: Tables of the phases that take the place of one, and the formations that they take on the way.
_Parts = tuple[list[dict[str, Any]], dict[str, Any]]


def _expand_transition(
    mission: Mission, number: int, table: dict[str, Any], phase: Reshape, before: str | None, state: _State
) -> _Parts:  # fmt: skip
    """The phase with its bent ways, or the phases of a transition by layers; as it is if straight ways will do.

    Beside the tables of the phases, the formations that they take on the way.
    """
    if phase.transition == "ways":
        report_step(f"looking for ways of the agents in '{phase.name}'")
        return [
            _bent_ways(mission, number, table, phase, before, _slot_limits(mission, state()))
        ], {}
    stops = _layer_stops(mission, number, phase, before)
    if stops is None:
        return [table], {}
    names = [f"{phase.name}: {part}" for part in _PARTS[:2]]
    levels = {name: {"slots": x, "edges": []} for name, x in zip(names, stops[1:3], strict=True)}
    return _layer_phases(table, phase, names, stops), levels


def _expand_stagger(
    mission: Mission, number: int, table: dict[str, Any], phase: Vertical, before: str | None, state: _State
) -> _Parts:  # fmt: skip
    """The phases of a staggered take-off or landing, one for each group, or of a landing on the own places.

    Raises
    ------
    MissionError
        The duration leaves no time for the last group, or so much that groups would be under way together.
    """
    if phase.stagger is None:
        return _phases_to_own_places(mission, number, table, phase, state()), {}
    assert isinstance(phase.duration, float)  # checked
    moving = phase.agents or tuple(range(1, mission.n_agents + 1))
    groups = [[i] for i in moving]
    if phase.by == "rows":
        slots = mission.formation_slots(before) if before is not None else None
        y = (mission.fleet.position if slots is None else slots)[:, 1]
        row = {i: round(float(y[i - 1]) / _ROW) for i in moving}
        groups = [[i for i in moving if row[i] == k] for k in sorted(set(row.values()))]
    travel = round(phase.duration - (len(groups) - 1) * phase.stagger, 6)
    if not 0.0 < travel <= phase.stagger + 1e-6:
        what = f"leaves {travel:g} s to each of" if travel > 0 else "is too short for"
        problem = f"{what} {len(groups)} groups, {phase.stagger:g} s apart"
        whole = len(groups) * phase.stagger
        remedy = f"groups go one after another: give a duration of {whole:g} s, or up to {phase.stagger:g} s less"
        raise error_of_key(mission, number, "duration", phase.duration, problem, remedy)
    common = {key: x for key, x in table.items() if key not in ("stagger", "by")}
    return [
        common
        | {"name": f"{phase.name}: {k} of {len(groups)}", "agents": group, "travel": travel}
        | {"duration": phase.stagger if k < len(groups) else travel}
        for k, group in enumerate(groups, start=1)
    ], {}


def _phases_to_own_places(
    mission: Mission, number: int, table: dict[str, Any], phase: Vertical, now: PhaseState | None
) -> list[dict[str, Any]]:
    """The phases in which each vehicle flies to where it stood at the start, and lands (`planning.homing`).

    Raises
    ------
    MissionError
        The vehicles did not stand on the ground, no way is proved, or there is too little time for it.
    """
    mistake = partial(error_of_key, mission, number)
    homes = WaysHome(Steps(mission, np.zeros(mission.n_agents, dtype=np.bool_)), to="own")
    problem = "needs vehicles that stand on the ground at the start, and known slots before"
    steps: tuple[Step, ...] = ()
    if now is not None and now.goal is not None and now.slots is not None and homes.stands:
        steps, _, problem, _ = homes.straight_ways_home(now.goal.r + now.slots @ now.goal.T, now.t)
    if not steps:
        raise mistake("places", "own", problem, "leave places out, to land below")
    least = sum(step.duration for step in steps)
    spare = phase.duration - least if isinstance(phase.duration, float) else 0.0
    if spare < -1e-6:
        problem = f"is too short for the ways to the own places; the least is {least:.3f} s"
        raise mistake("duration", phase.duration, problem, "give that, or more")
    parts = phases_of(mission, steps, f"{phase.name}: ")
    last = parts[-1].model_copy(update={"duration": steps[-1].duration + max(spare, 0.0)})
    keep = {key: x for key, x in table.items() if key in ("control", "input_force")}
    return [keep | x.model_dump(mode="json", exclude_unset=True) for x in (*parts[:-1], last)]


def _slot_limits(mission: Mission, now: PhaseState | None) -> Floats:
    """Corners (2, 3) [m], about the centre of mass in body axes, between which vehicles fly from a state on.

    These are heights above the ground and within the geofence if the formation is level then, and the geofence's sides
    if its axes are along the world's. Infinite where that, or the place of the formation, is not known.
    """
    box = np.array([[-np.inf] * 3, [np.inf] * 3])
    if now is None or (pose := now.goal) is None:
        return box
    radius, fence = float(mission.fleet.radius.max()), mission.limits.geofence
    low, high = np.array([-np.inf, -np.inf, mission.ground + radius]), np.full(3, np.inf)
    if fence is not None:
        low, high = np.maximum(low, np.array(fence.min) + radius), np.array(fence.max) - radius
    within = np.array([low, high]) - pose.r
    for q in range(3):  # axis q of the body along an axis of the world
        k = int(np.abs(pose.T[q]).argmax())
        if abs(pose.T[q, k]) > 1.0 - 1e-9:
            box[:, q] = np.sort(within[:, k] * np.sign(pose.T[q, k]))
    return box


def _bent_ways(
    mission: Mission,
    number: int,
    table: dict[str, Any],
    phase: Reshape,
    before: str | None,
    within: Floats,
) -> dict[str, Any]:
    """The phase with the control points of bent ways, found and proved between its slots in body axes.

    ``within`` (2, 3) [m] are corners about the centre of mass that the ways do not leave.

    Raises
    ------
    MissionError
        There are no limits of speed and acceleration, no ways are found, or the blend is too short for them.
    """
    mistake = partial(error_of_key, mission, number)
    p, q = _slots_at_ends(mission, number, phase, before)
    limits, radius = mission.limits, float(mission.fleet.radius.max())
    if limits.speed is None or limits.acceleration is None:
        problem = "is found within limits of speed and acceleration, and the mission lacks one"
        remedy = "give limits.speed and limits.acceleration"
        raise mistake("transition", phase.transition, problem, remedy)
    distance = 2.0 * radius + (limits.separation or 0.0) + limits.separation_allowance
    below = max(distance, 2.0 * radius + (limits.separation_below or 0.0))
    room = _ROOM * below
    low, high = np.minimum(p, q).min(axis=0), np.maximum(p, q).max(axis=0)
    # Slots that are outside already are for the plan's check to find.
    lowest = np.maximum(low - room, np.minimum(within[0], low))
    highest = np.minimum(high + room, np.maximum(within[1], high))
    each = 1.0 / np.sqrt(3.0)  # limits of each axis, which together keep those of the vector
    try:
        ways = plan_transfer(
            p, q, distance=distance, speed=each * limits.speed, acceleration=each * limits.acceleration,
            box=(lowest, highest), downwash=below / distance,
        )  # fmt: skip
    except ValueError as error:
        problem = f"between '{before}' and '{phase.formation}', {error}"
        remedy = "or lower limits.separation"
        raise mistake("transition", phase.transition, problem, remedy) from None
    if ways is None:
        problem = f"finds no ways to '{phase.formation}' that keep centres {distance:.3g} m apart"
        remedy = "use transition = 'layers', place slots farther apart, or lower limits.separation"
        raise mistake("transition", phase.transition, problem, remedy)
    least = math.ceil(ways.duration * 1e3) / 1e3
    if phase.blend != AUTO and "blend" in phase.model_fields_set and phase.blend < least:
        problem = f"is too short for the ways found; the least is {least:g} s"
        raise mistake("blend", phase.blend, problem, "give that, or leave it out")
    blend = phase.blend if "blend" in phase.model_fields_set and phase.blend != AUTO else least
    if isinstance(phase.duration, float) and phase.duration < blend:
        problem = f"is shorter than the ways found, which take {blend:g} s"
        raise mistake("duration", phase.duration, problem, "end the phase later")
    points = np.round(ways.control, 9)
    points[:3], points[-3:] = p, q  # to the last bit, so that nothing jumps
    keys = {"blend": blend, "alignment": "none", "control_points": points.tolist()}
    if phase.duration == AUTO:
        keys["duration"] = blend
    return table | keys


def _slots_at_ends(
    mission: Mission, number: int, phase: Reshape, before: str | None
) -> tuple[Floats, Floats]:
    """Slots (N, 3) [m] about the centre of mass before and after a phase, in body axes.

    Raises
    ------
    MissionError
        They are not known.
    """
    p, q = (mission.slots_about_cm(name) for name in (before, phase.formation))
    if p is None or q is None:
        problem, remedy = "starts from no formation with slots", "take a formation before"
        raise error_of_key(mission, number, "transition", phase.transition, problem, remedy)
    return p, q


def _layer_stops(
    mission: Mission, number: int, phase: Reshape, before: str | None
) -> list[Floats] | None:
    """Slots (N, 3) [m] before and after the three parts of a phase by layers; None if its straight ways will do."""
    p, q = _slots_at_ends(mission, number, phase, before)
    masses, radius, limits = mission.fleet.mass, mission.fleet.radius, mission.limits
    limit = limits.separation or 0.0
    if phase.transition == AUTO:
        turned = q @ rigid_body.kabsch(p, q, masses).T
        separation = closest_approach(p, turned, radius)[0]
        if separation >= limit - _SLACK and separation > 0.0:
            return None
    apart = 2.0 * float(radius.max()) + limit + limits.separation_allowance
    height = max(apart, 2.0 * float(radius.max()) + (limits.separation_below or 0.0))
    level = height * layer_levels(neighbours_on_ways(apart, p, q))
    one, two = (np.column_stack([x[:, :2], level]) for x in (p, q))
    stops = [p, one, two, q]
    for (a, b), part in zip(pairwise(stops), _PARTS, strict=True):
        separation, pair, _ = closest_approach(a, b, radius)
        if separation <= 0.0 or separation < limit - _SLACK:
            who = " and ".join(f"agent {i + 1}" for i in pair)
            problem = (
                f"finds no layers for '{phase.name}': {who} come within {max(separation, 0.0):.2f} m on the way"
                f" {part} (limit {limit:g} m)"
            )
            remedy = "place slots farther apart as seen from above, or lower limits.separation"
            raise error_of_key(mission, number, "transition", phase.transition, problem, remedy)
    return stops


def _layer_phases(
    table: dict[str, Any], phase: Reshape, names: list[str], stops: list[Floats]
) -> list[dict[str, Any]]:
    """The three phases; a blend is shared such that all have about the same peak acceleration."""
    blends: list[Any] = [AUTO] * 3
    if phase.blend != AUTO:
        lengths = [float(np.linalg.norm(b - a, axis=1).max()) for a, b in pairwise(stops)]
        shares = np.sqrt(np.maximum(lengths, 1e-3 * max(*lengths, 1e-6)))
        blends = [round(float(x), 6) for x in phase.blend * shares / shares.sum()]
    parts = []
    for name, blend in zip(names, blends, strict=False):
        kept = {key: x for key, x in table.items() if key not in ("until", "settle", "position")}
        own = {"name": name, "formation": name, "blend": blend, "duration": blend}
        parts.append(kept | own | {"alignment": "none"})
    last = table | {"name": f"{phase.name}: {_PARTS[2]}", "blend": blends[2], "alignment": "none"}
    if isinstance(phase.duration, float) and phase.blend != AUTO:
        last["duration"] = round(phase.duration - blends[0] - blends[1], 6)
    return [*parts, last]
