"""Check the planned paths against obstacles, fences and people, in continuous time, and gaps between boxes."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from rigidfleet._common.quantities import PLACES, QUANTITIES
from rigidfleet._common.waypoints import LEEWAY
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.mission import Mission, Obstacle
from rigidfleet.mission.boundaries import BoundaryWatch, Worst, boundary_in_words
from rigidfleet.mission.obstacles import Box, Ground
from rigidfleet.planning.clearance import CLEARANCE_ACCURACY, clearance_to, speed_bounds
from rigidfleet.preflight.avoidance import is_left_to_avoidance
from rigidfleet.preflight.findings import Preflight, Remark, names_with_verb
from rigidfleet.solids.records import swept_extent
from rigidfleet.typing import Floats

#: Maximum number of comparisons of agent positions with obstacles; one of a phase with an obstacle counts as so many.
_COMPARED, _EACH = 40_000_000, 800
#: Maximum number of comparisons of samples with boxes, to find gaps.
_PASSED = 100_000_000
#: Maximum number of obstacles whose clearance is reported; the nearest ones.
_NEAREST = 20


def obstacle_remarks(mission: Mission, preflight: Preflight) -> Iterator[Remark]:
    """Remarks on hit obstacles. Clearances of many obstacles are computed for the near ones only."""
    radius, way = mission.fleet.radius, preflight.flown_phases
    if not (mission.obstacles and way):
        return
    # Bounding box of each phase, and a lower bound (L, B) of its distance to each obstacle.
    within = np.array(
        [[planned.position.min(axis=(0, 1)), planned.position.max(axis=(0, 1))] for planned in way]
    )
    apart = [_least_distance_bound(within, thing) for thing in mission.obstacles]
    far = np.stack(apart, axis=1) - radius.max()
    compared, skipped = 0, []
    unproved: dict[int, float] = {}
    paces = [speed_bounds(planned) for planned in way]
    near = np.argsort(far.min(axis=0), kind="stable")
    shown: dict[int, dict[bool, tuple[float, float, int, str]]] = {}
    for rank, b in enumerate(near.tolist()):
        thing = mission.obstacles[b]
        if rank >= _NEAREST and far[:, b].min() > 0:
            break
        worst = dict[bool, tuple[float, float, int, str]]()
        for k in np.argsort(far[:, b], kind="stable").tolist():
            planned = way[k]
            if far[k, b] >= worst.get(planned.exact, (np.inf,))[0]:
                continue
            compared += planned.position[:, :, 0].size + _EACH
            if compared > _COMPARED:
                break
            lost = planned.leg.before.lost
            clearance, agent, time, proved = clearance_to(planned, thing, radius, paces[k], lost)
            if clearance - proved > max(unproved.get(b, 0.0), 1.5 * CLEARANCE_ACCURACY):
                unproved[b] = clearance - proved
            # Among equal minima, take the first one: ignore rounding and the last millimetre of a rest.
            if clearance < worst.get(planned.exact, (np.inf,))[0] - CLEARANCE_ACCURACY:
                worst[planned.exact] = (clearance, time, agent, planned.phase)
        if compared > _COMPARED:
            skipped = near[rank:][far[:, near[rank:]].min(axis=0) <= 0].tolist()
            break
        if worst:  # it is there during the flight
            shown[b] = worst
    for b in sorted(shown):
        thing, (clearance, t, i, _) = mission.obstacles[b], min(shown[b].values())
        preflight.clearance.append((thing.name, clearance, t, f"agent {i + 1}"))
        for exact, (clearance, t, i, phase) in shown[b].items():
            if clearance >= -1e-6:  # a vehicle that stands is in contact
                continue
            verb = "hits" if exact else "may hit"
            text = f"agent {i + 1} {verb} '{thing.name}' at {t:.2f} s in '{phase}'"
            if isinstance(thing, Ground):
                text += _too_low_in_words(mission, preflight, phase, thing.height)
            evaded = thing.solid.moves and is_left_to_avoidance(mission, "obstacle")
            if evaded:
                text += " as planned; [avoidance] has to evade it"
            yield Remark("fails" if exact and not evaded else "note", "obstacle", text)
    if unproved:
        names = [mission.obstacles[b].name for b in sorted(unproved)]
        text = (
            f"to limit the time of the check, the clearance told of {names_with_verb(names)} proved to"
            f" {max(unproved.values()):.2g} m only"
        )
        yield Remark("note", "obstacle", text)
    if skipped:
        names = [mission.obstacles[b].name for b in sorted(skipped)]
        text = f"to limit the time of the check, {names_with_verb(names)} skipped"
        yield Remark("note", "obstacle", text)
    yield from _box_gap_remarks(mission, preflight, radius)


def area_remarks(mission: Mission, preflight: Preflight) -> Iterator[Remark]:
    """Remarks on planned paths that cross a fence, and on places where vehicles would fall that are too near people.

    Between samples of a plan, its paths are quintics through positions, velocities and accelerations.
    """
    watch, worst = BoundaryWatch(mission), dict[tuple[str, bool], tuple[Worst, str]]()
    for planned in preflight.flown_phases if watch.every else ():
        states = np.stack([planned.position, planned.velocity, planned.acceleration])
        watch.add_way(Piecewise.hermite(planned.time, states), ~planned.leg.before.lost)
        for name, x in watch.search().items():
            at, rank = (name, planned.exact), QUANTITIES[name].rank
            if at not in worst or rank(x.value) > rank(worst[at][0].value):
                worst[at] = x, planned.phase
        watch.worst.clear()
    for (name, exact), (x, phase) in worst.items():
        q, place = QUANTITIES[name], getattr(mission, PLACES[QUANTITIES[name].who])[x.other].name
        limit = q.limit_of(mission)
        if q.rank(x.value) > q.rank(limit or 0.0) + LEEWAY:
            text = f"{boundary_in_words(name, f'agent {x.who + 1}', place, x.value, x.time)} in '{phase}'"
            text += f" (limit {limit:g} m)" if q.key else ""
            yield Remark("fails" if exact and limit is not None else "note", q.who, text)


def _least_distance_bound(within: Floats, thing: Obstacle) -> Floats:
    """Lower bound (L,) [m] of the distance of boxes (L, 2, 3), given by lowest and highest corner, to an obstacle.

    Minus infinity where a box overlaps the obstacle's extent: how deep it reaches into the obstacle is not known.
    """
    low, high = swept_extent(thing.solid)
    apart = np.maximum(np.maximum(within[:, 0] - high, low - within[:, 1]), 0.0)
    return np.where(apart.any(axis=1), np.linalg.norm(apart, axis=1), -np.inf)


def _too_low_in_words(mission: Mission, preflight: Preflight, phase: str, ground: float) -> str:
    """Why a vehicle touches the ground [m] in a phase, and the altitude that its formation needs."""
    planned = next(planned for planned in preflight.flown_phases if planned.phase == phase)
    masses, radius = mission.fleet.mass, mission.fleet.radius
    z = planned.position[..., 2]
    cm = z @ masses / masses.sum()
    low = np.where(planned.leg.before.lost, np.inf, z - radius)
    k, i = np.unravel_index(int(low.argmin()), z.shape)
    deep, below = ground + radius[i] - z[k, i], cm[k] - z[k, i]
    high = float((ground + radius + cm[:, None] - z)[k].max())
    return (
        f": its centre is at z = {z[k, i]:.2f} m with a radius of {radius[i]:g} m, {deep:.2f} m too low, because its"
        f" slot is {below:.2f} m below the centre of mass at z = {cm[k]:.2f} m. Keep it at or above z ="
        f" {math.ceil(100 * high + 1e-6) / 100:.2f} m, or turn the formation so that this slot is higher"
    )


def _box_gap_remarks(mission: Mission, preflight: Preflight, radius: Floats) -> Iterator[Remark]:
    """Remarks on gaps between two boxes along the axes, at rest, through which the centre of mass passes.

    A gap lies between the nearest boxes on both sides of the centre of mass along an axis.
    """
    masses = mission.fleet.mass
    boxes = [t for t in mission.obstacles if isinstance(t, Box) and t.box_bounds is not None]
    if len(boxes) < 2:
        return
    low, high = np.array([box.min for box in boxes]), np.array([box.max for box in boxes])
    least: dict[tuple[int, int, int], tuple[float, float, str]] = {}
    looked, to = 0, math.inf
    for planned in preflight.flown_phases:
        looked += len(planned.time) * len(boxes)
        if looked > _PASSED:
            to = float(planned.time[0])
            break
        cm = np.einsum("i,kia->ka", masses, planned.position) / masses.sum()
        between = (cm[:, None] > low) & (cm[:, None] < high)
        for axis in range(3):
            beside = np.delete(between, axis, axis=2).all(axis=2)
            at = cm[:, axis, None]
            below = np.where(beside & (high[:, axis] < at), high[:, axis], -np.inf)
            above = np.where(beside & (low[:, axis] > at), low[:, axis], np.inf)
            sides = np.column_stack([below.argmax(axis=1), above.argmin(axis=1)])
            inside = np.isfinite(below.max(axis=1)) & np.isfinite(above.min(axis=1))
            for one, two in np.unique(sides[inside], axis=0).tolist():
                when = inside & (sides == [one, two]).all(axis=1)
                along = planned.position[when][:, :, axis]
                takes = (along + radius).max(axis=1) - (along - radius).min(axis=1)
                k, key = int(takes.argmax()), (one, two, axis)
                if key not in least or takes[k] > least[key][0]:
                    least[key] = float(takes[k]), float(planned.time[when][k]), planned.phase
    for (one, two, axis), (takes, t, phase) in sorted(least.items()):
        between = f"'{boxes[one].name}' and '{boxes[two].name}'"
        wide = float(low[two, axis] - high[one, axis])
        preflight.gaps.append((between, wide, takes, t))
        if takes > wide:
            text = (
                f"the gap between {between} is {wide:.2f} m wide, but the formation needs {takes:.2f} m"
                f" in its attitude at {t:.2f} s in '{phase}': turn or reshape it before"
            )
            yield Remark("fails", "obstacle", text)
    if math.isfinite(to):
        text = f"gaps between obstacles are checked only up to {to:g} s: more would take too long"
        yield Remark("note", "obstacle", text)
