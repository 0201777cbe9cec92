"""Rules of losses: vehicles, links, and what the others then do."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from rigidfleet._common.text import agent_names
from rigidfleet.mission.findings import Keys, suggest
from rigidfleet.mission.kinds import AnyPhase, seconds
from rigidfleet.mission.obstacles import is_ground
from rigidfleet.mission.phases import named_agent_rules
from rigidfleet.mission.rules import Breach, Breaches, Draft, unused_key_rules
from rigidfleet.mission.schema import Aborting, Disturbances
from rigidfleet.typing import Floats

_TABLE = "disturbances"
#: Keys that say more about `on_loss`, and the value that each belongs to.
ON_LOSS = {"hold_until": "hold", "landing_formation": "land"}
#: Greatest difference in height of vehicles that land together [m]: all are then within what the verdict takes as
#: standing on the ground.
LEVEL = 0.05
#: Problem and remedy of what needs a ground.
_NO_GROUND = (
    "needs a ground, and the mission has none",
    "add [[obstacles]] with kind = 'ground'",
)


def loss_rules(m: Draft) -> Breaches:
    """Vehicles and links that can be lost, what can follow, and a ground for landings."""
    d = m.disturbances or Disturbances.model_construct()
    yield from _abort_rules(m)
    grounded = not m.is_valid((), "obstacles") or any(map(is_ground, m.obstacles))
    for k, p in enumerate(m.phases):
        if p.grounded and not grounded:
            yield Breach(("phases", k, "kind"), *_NO_GROUND)
    links = m.network.lost if m.network else ()
    yield from _lost_vehicle_rules(m, d)
    for k, one in enumerate(d.stuck):
        path = (_TABLE, "stuck", k)
        yield from agent_number_rules(m, (*path, "agent"), (one.agent,))
        yield from loss_time_rules(m, one.time, path)
    if d.stuck and m.network is None and m.is_valid((), "network"):
        problem = "needs vehicles that fly by themselves: without [network], one law commands all"
        yield Breach((_TABLE, "stuck"), problem, "add [network], or remove it", None)
    for key, needed in ON_LOSS.items():
        m.record_breaches((_TABLE,), unused_key_rules(d, key, "on_loss", needed))
    times = [lost.time for lost in (*d.lost, *links)]
    if d.on_loss == "continue" or not times or m.n is None or m.findings:
        return
    first = min(times)
    if d.hold_until is not None and d.hold_until <= first:
        problem = f"is not after the first loss at {first:g} s"
        yield Breach((_TABLE, "hold_until"), problem, "give a later time or remove it")
    yield from _required_tracking_rules(m, first, "loss", "brake", "on_loss = 'continue'")
    if d.on_loss == "land":
        if not grounded:
            yield Breach((_TABLE, "on_loss"), *_NO_GROUND)
        yield from _level_formation_rules(m, d, m.n, first)


def _abort_rules(m: Draft) -> Breaches:
    """An abort is ordered in time, while slots are tracked."""
    options = m.abort or Aborting.model_construct()
    yield from named_agent_rules(m, options.agents, "abort", "agents")
    if options.at is None or math.isnan(m.end) or m.findings:
        return
    begins = options.at + options.reaction
    if not 0.0 < begins < m.end:  # nothing has been flown at the start
        within = f"after the start and before the end of the mission at {m.end:g} s"
        problem = f"and the reaction of {options.reaction:g} s are not {within}"
        yield Breach(("abort", "at"), problem, "give another time or remove it")
    yield from _required_tracking_rules(m, begins, "abort", "slow down", "abort at another time")


def _required_tracking_rules(m: Draft, when: float, what: str, does: str, other: str) -> Breaches:
    """Slots are tracked in what may be under way at a loss or abort at a time [s]; words of it, and another remedy."""
    for k, p in phases_under_way(m.phases, when):
        if not p.tracks_slots:
            problem = (
                f"may be under way at the {what} at {when:g} s, but only tracked slots can {does}"
            )
            remedy = f"use control = 'tracking', or {other}"
            yield Breach(("phases", k, "control"), problem, remedy, p.control)


def _lost_vehicle_rules(m: Draft, d: Disturbances) -> Breaches:
    """Vehicles exist, are lost once and in time, and some are left, in equations that can do without them."""
    lost = [one.agent for one in d.lost]
    for k, one in enumerate(d.lost):
        path = (_TABLE, "lost", k)
        again = "is lost twice" if one.agent in lost[:k] else ""
        yield from agent_number_rules(m, (*path, "agent"), (one.agent,), again)
        yield from loss_time_rules(m, one.time, path)
    if m.n is not None and len(set(lost)) >= m.n:
        yield Breach((_TABLE, "lost"), "all vehicles are lost", "keep at least one")
    for key, possible, whose in (
        ("architecture", "local", "wrench is that of"),
        ("formulation", "inertial", "state describes"),
    ):
        if lost and getattr(m, key) == "body":
            problem = (
                f"{key} = 'body' does not support lost vehicles: its {whose} a body of all agents"
            )
            yield Breach((_TABLE, "lost"), problem, f"use {key} = '{possible}'")


def agent_number_rules(m: Draft, where: Keys, agents: Sequence[int], again: str = "") -> Breaches:
    """Agents exist, and are not lost ``again``, in words."""
    if m.n is not None and not all(1 <= agent <= m.n for agent in agents):
        yield Breach(where, "there is no such agent", f"agents are numbered from 1 to {m.n}")
    elif again:
        yield Breach(where, again, "remove one of the two")


def loss_time_rules(m: Draft, time: float, path: Keys) -> Breaches:
    """A loss is before the end of the mission."""
    if time >= m.end:
        problem = f"is not before the end of the mission at {m.end:g} s"
        yield Breach((*path, "time"), problem, "give an earlier time or remove the entry")


def phases_under_way(phases: Sequence[AnyPhase], t: float) -> Iterator[tuple[int, AnyPhase]]:
    """Phases that may be under way at a time [s]: one that settles may do so early or late."""
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
        if begin <= t <= last:
            yield k, p


def _possible_formations(phases: Sequence[AnyPhase], t: float) -> list[str | None]:
    """Formations that may be held at a time [s], each once; None: the places of the start."""
    held: dict[str | None, None] = {}
    for k, _ in phases_under_way(phases, t):
        taken = [p.shaping.formation for p in phases[: k + 1] if p.shaping is not None]
        held[taken[-1] if taken else None] = None
    return list(held)


def _level_formation_rules(m: Draft, d: Disturbances, n: int, first: float) -> Breaches:
    """Vehicles of a formation that lands reach the ground together."""
    forms, radius, name = m.formations, m.agents.radius, d.landing_formation
    if name is not None:
        where = (_TABLE, "landing_formation")
        if name not in forms:
            remedy = suggest(name, forms) or f"formations: {', '.join(forms)}"
            yield Breach(where, "there is no such formation", remedy)
            return
        slots = forms[name].slot_array(n) if m.is_valid(("formations",), name) else None
        words = "it has no slots to track" if slots is None else _height_spread_text(slots, radius)
        if words:
            remedy = "name a level formation, such as a line or a square"
            yield Breach(where, f"cannot land: {words}", remedy)
        return
    for one in _possible_formations(m.phases, first):
        points = np.array(m.agents.position) if one is None else forms[one].slot_array(n)
        if points is None:
            continue  # distances alone cannot be tracked, which is another finding
        if words := _height_spread_text(points, radius):
            what = "the start" if one is None else f"'{one}'"
            problem = f"{what} cannot land as it is: {words}"
            remedy = "give landing_formation, a level formation that is taken before the descent"
            yield Breach((_TABLE, "on_loss"), problem, remedy)


def _height_spread_text(points: Floats, radius: Sequence[float]) -> str:
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
    if not len(over):
        return words
    return f"{words}, and {agent_names(sorted((low, over[0])))} stand one above the other"
