"""Check the losses of a mission: vehicles, links, and what the others then do."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from rigidfleet._common.text import agent_names
from rigidfleet.mission.findings import FindingCollector, near
from rigidfleet.mission.formations import sound
from rigidfleet.mission.kinds import AnyPhase, seconds
from rigidfleet.mission.schema import Agents, Disturbances, Formation
from rigidfleet.typing import Floats

_TABLE = "disturbances"
#: Keys that say more about `on_loss`, and the value that each belongs to.
ON_LOSS = {"hold_until": "hold", "landing_formation": "land"}
#: Greatest difference in height of vehicles that land together [m]: all are then within what the verdict takes as
#: standing on the ground.
LEVEL = 0.05


def check(
    collector: FindingCollector,
    found: Disturbances | None,
    parts: Mapping[str, Any],
    n: int | None,
    end: float | None,
) -> None:
    """Find the errors of lost vehicles and links, of what follows, and of landings."""
    phases: Sequence[AnyPhase] = parts["phases"]
    grounded = any(thing.kind in ("ground", "heights", "box") for thing in parts["obstacles"])
    no_ground = "needs a ground, and the mission has none"
    remedy = "add [[obstacles]] with kind = 'ground'"
    for k, p in enumerate(phases):
        if p.grounded and not grounded and collector.right((), "obstacles"):
            collector.add(("phases", k, "kind"), no_ground, remedy)
    if found is None:
        return
    _vehicles(collector, found, parts, n, end)
    _links(collector, found, parts, n, end)
    for key, needed in ON_LOSS.items():
        if getattr(found, key) is not None and found.on_loss != needed:
            problem = f"has no effect with on_loss '{found.on_loss}'"
            collector.add((_TABLE, key), problem, f"remove it or use on_loss = '{needed}'")
    times = [lost.time for lost in (*found.lost, *(found.links.lost if found.links else ()))]
    if found.on_loss == "continue" or not times or n is None or collector.findings:
        return
    first = min(times)
    if found.hold_until is not None and found.hold_until <= first:
        problem = f"is not after the first loss at {first:g} s"
        collector.add((_TABLE, "hold_until"), problem, "give a later time or remove it")
    for k, p in _under_way(phases, first):
        if p.control != "tracking":
            problem = (
                f"may be under way at the loss at {first:g} s, but only tracked slots can brake"
            )
            remedy = "use control = 'tracking', or on_loss = 'continue'"
            collector.add(("phases", k, "control"), problem, remedy, p.control)
    if found.on_loss == "land":
        if not grounded:
            collector.add((_TABLE, "on_loss"), no_ground, remedy)
        _landings(collector, found, parts, n, first)


def _vehicles(
    collector: FindingCollector,
    found: Disturbances,
    parts: Mapping[str, Any],
    n: int | None,
    end: float | None,
) -> None:
    seen: set[int] = set()
    for k, lost in enumerate(found.lost):
        path = (_TABLE, "lost", k)
        known = _known(collector, (*path, "agent"), (lost.agent,), n)
        if known and lost.agent in seen:
            collector.add((*path, "agent"), "is lost twice", "remove one of the two")
        _in_time(collector, lost.time, end, path)
        seen.add(lost.agent)
    if n is not None and len(seen) >= n:
        collector.add((_TABLE, "lost"), "all vehicles are lost", "keep at least one")
    for key, possible in (("architecture", "local"), ("formulation", "inertial")):
        if found.lost and parts.get(key) == "body":
            problem = (
                f"{key} = 'body' does not support lost vehicles: its state describes a body of all agents"
                if key == "formulation"
                else "architecture = 'body' does not support lost vehicles: its wrench is that of a body of all agents"
            )
            collector.add((_TABLE, "lost"), problem, f"use {key} = '{possible}'")


def _links(
    collector: FindingCollector,
    found: Disturbances,
    parts: Mapping[str, Any],
    n: int | None,
    end: float | None,
) -> None:
    links = () if found.links is None else found.links.lost
    seen: set[tuple[int, ...]] = set()
    for k, lost in enumerate(links):
        path, pair = (_TABLE, "links", "lost", k), tuple(sorted(lost.between))
        where = (*path, "between")
        if _known(collector, where, pair, n):
            if pair[0] == pair[1]:
                collector.add(where, "joins an agent to itself", "give two agents")
            elif pair in seen:
                collector.add(where, "is lost twice", "remove one of the two")
        _in_time(collector, lost.time, end, path)
        seen.add(pair)
    if not links:
        return
    first = min(lost.time for lost in links)
    for k, p in _under_way(parts["phases"], first, ever_after=True):
        if p.control != "tracking":
            problem = (
                f"may be under way after the link lost at {first:g} s: vehicles without a link know each other"
                " by their slots alone, so the slots must be tracked"
            )
            collector.add(("phases", k, "control"), problem, "use control = 'tracking'", p.control)


def _known(
    collector: FindingCollector, where: tuple[str | int, ...], agents: Sequence[int], n: int | None
) -> bool:
    """Whether the mission has these agents; a finding if not."""
    if n is None or all(1 <= agent <= n for agent in agents):
        return True
    collector.add(where, "there is no such agent", f"agents are numbered from 1 to {n}")
    return False


def _in_time(
    collector: FindingCollector, time: float, end: float | None, path: tuple[str | int, ...]
) -> None:
    if end is not None and time >= end:
        problem = f"is not before the end of the mission at {end:g} s"
        collector.add((*path, "time"), problem, "give an earlier time or remove the entry")


def _under_way(
    phases: Sequence[AnyPhase], t: float, *, ever_after: bool = False
) -> Iterator[tuple[int, AnyPhase]]:
    """Phases that may be under way at a time [s], or also later: one that settles may do so early or late."""
    first = last = 0.0
    for k, p in enumerate(phases):
        begin = first
        if p.until is not None:
            first = last = p.until
        elif p.settle is not None:
            first, last = first + p.settle.dwell, last + p.settle.timeout
        else:
            length = seconds(p.duration or 0.0)
            known = math.isfinite(length)
            first, last = first + (length if known else 0.0), last + (length if known else math.inf)
        if last >= t and (begin <= t or ever_after):
            yield k, p


def _landings(
    collector: FindingCollector,
    found: Disturbances,
    parts: Mapping[str, Any],
    n: int,
    first: float,
) -> None:
    """Find formations whose vehicles would not reach the ground together."""
    forms: Mapping[str, Formation] = parts["formations"]
    agents: Agents = parts["agents"]
    name = found.landing_formation
    if name is not None:
        if name not in forms:
            remedy = near(name, forms) or f"formations: {', '.join(forms)}"
            collector.add((_TABLE, "landing_formation"), "there is no such formation", remedy)
            return
        slots = forms[name].slot_array(n) if sound(collector, name) else None
        words = "it has no slots to track" if slots is None else _uneven(slots, agents.radius)
        if words:
            remedy = "name a level formation, such as a line or a square"
            collector.add((_TABLE, "landing_formation"), f"cannot land: {words}", remedy)
        return
    phases: Sequence[AnyPhase] = parts["phases"]
    held: dict[str | None, None] = {}
    for k, _ in _under_way(phases, first):
        taken = [p.shaping.formation for p in phases[: k + 1] if p.shaping is not None]
        held[taken[-1] if taken else None] = None
    for one in held:
        points = np.array(agents.position) if one is None else forms[one].slot_array(n)
        if points is None:
            continue  # distances alone cannot be tracked, which is another finding
        if words := _uneven(points, agents.radius):
            what = "the start" if one is None else f"'{one}'"
            problem = f"{what} cannot land as it is: {words}"
            remedy = "give landing_formation, a level formation that is taken before the descent"
            collector.add((_TABLE, "on_loss"), problem, remedy)


def _uneven(points: Floats, radius: Sequence[float]) -> str:
    """Why vehicles at these places (N, 3) do not reach the ground together; "" if they do."""
    points, size = np.asarray(points), np.array(radius)
    bottom = points[:, 2] - size
    spread = float(np.ptp(bottom))
    if spread <= LEVEL:
        return ""
    words = f"its vehicles differ by {spread:.3g} m in height"
    low = int(bottom.argmin())
    across = np.hypot(*(points[:, :2] - points[low, :2]).T)
    over = np.flatnonzero((across < size + size[low]) & (bottom > bottom[low] + LEVEL))
    return (
        f"{words}, and {agent_names(sorted((low, over[0])))} stand one above the other"
        if len(over)
        else words
    )
