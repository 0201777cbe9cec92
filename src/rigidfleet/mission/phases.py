"""Check the phases of a mission: their order, their durations, and whether each can follow the one before."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from rigidfleet._common.text import agent_names
from rigidfleet._common.toml import toml_key
from rigidfleet.foreign.curves import CHANNELS, greatest_jumps, rows_to_curve
from rigidfleet.formation import distance_geometry
from rigidfleet.mission import bounds
from rigidfleet.mission.files import NOT_A_FILE
from rigidfleet.mission.findings import FindingCollector, Keys, near
from rigidfleet.mission.formations import sound
from rigidfleet.mission.kinds import (
    ANGLES,
    KINDS,
    TIMES,
    AnyPhase,
    Establish,
    Follow,
    Go,
    Orbit,
    Reshape,
    Shaping,
    Turn,
    Vertical,
    seconds,
)
from rigidfleet.mission.schema import Agents, Formation, Limits, Lqr
from rigidfleet.mission.values import AUTO

_ENDINGS = ("until", "duration", "settle")
#: Maximum number of samples of a result.
_MOST_SAMPLES = 1_000_000
#: Maximum number of turns of an orbit: with more, the samples of the planned path would miss the circle.
_MOST_TURNS = 100
#: Maximum number of values in a result: 4 GB.
_MOST_NUMBERS = 5e8


def check(
    collector: FindingCollector, parts: Mapping[str, Any], n: int | None
) -> tuple[AnyPhase, ...]:
    """Check the phases and return them, including those with findings.

    They are not checked again if those of the last mission that shares tables had no findings, and nothing differs on
    which that depends.
    """
    found = _phases(collector)
    given = _depends_on(collector, parts, n)
    if collector.findings or collector.shared.sound != given:
        _check(collector, found, parts, n)
        collector.shared.sound = None if collector.findings else given
    return tuple(p for p in found if p is not None)


def _depends_on(
    collector: FindingCollector, parts: Mapping[str, Any], n: int | None
) -> tuple[Any, ...]:
    """All that the findings of phases depend on."""
    agents: Agents | None = parts.get("agents")
    limits = None if agents is None else agents.thrust_limit
    keys = ("phases", "formations", "architecture", "assignment")
    read = ("lqr", "limits", "smoothness", "output_step")
    return n, limits, *map(collector.data.get, keys), *map(parts.get, read)


def _check(
    collector: FindingCollector,
    found: Sequence[AnyPhase | None],
    parts: Mapping[str, Any],
    n: int | None,
) -> None:
    """Check phases together."""
    _names(collector, found)
    end, lengths = _times(collector, found)
    _samples(collector, parts, end, n)
    _controls(collector, found, lengths)
    _formations(collector, found, parts, n)
    _arrivals(collector, found, parts.get("lqr", Lqr()), smooth=_smooth(parts))
    for k, p in enumerate(found):
        if p is not None:
            _smoothness(collector, p, ("phases", k), smooth=_smooth(parts))
            _automatic(collector, p, ("phases", k), parts)
            if n is not None and p.vertical is not None:
                members(collector, p.vertical.agents, n, ("phases", k, "agents"))
            if n is not None and isinstance(p, Follow):
                _followers(collector, p, n, ("phases", k))
            if n is not None and isinstance(p, Reshape) and p.control_points is not None:
                _bent(collector, p, p.control_points, n, ("phases", k))


def latest_end(phases: Sequence[AnyPhase]) -> float:
    """Latest mission time [s] at which the last phase ends: each phase that settles takes its full timeout.

    It is nan if it depends on a duration that is automatic.
    """
    t = 0.0
    for p in phases:
        length = p.settle.timeout if p.settle is not None else seconds(p.duration or 0.0)
        t = p.until if p.until is not None else t + length
    return t


def tables(collector: FindingCollector, key: str) -> Sequence[Any]:
    """Return an array of tables of the mission; empty, with a finding, if it is something else."""
    found = collector.data.get(key, [])
    if isinstance(found, list):
        return found
    collector.add((key,), "must be an array of tables", f"write [[{key}]] above each table")
    return []


def kind(collector: FindingCollector, data: Any, path: Keys, kinds: Mapping[str, type[Any]]) -> Any:
    """Return the model for the `kind` of a table, or None with a finding."""
    choice = f"use one of {', '.join(kinds)}"
    if not isinstance(data, dict):
        collector.add(path, "must be a table", f"write [[{path[0]}]] above it")
    elif "kind" not in data:
        collector.add((*path, "kind"), "is missing", choice)
    elif not isinstance(data["kind"], str) or data["kind"] not in kinds:
        collector.add((*path, "kind"), "unknown kind", near(data["kind"], kinds) or choice)
    else:
        return kinds[data["kind"]]
    return None


def _phases(collector: FindingCollector) -> list[AnyPhase | None]:
    """Each phase with defaults for name and control; None for a phase that is not valid."""
    body = collector.data.get("architecture") == "body"
    found: list[AnyPhase | None] = []
    for k, data in enumerate(tables(collector, "phases")):
        if (model := kind(collector, data, ("phases", k), KINDS)) is None:
            found.append(None)
            continue
        control = model.body_control if body else "tracking"
        defaults = {"name": f"{data['kind']} {k + 1}", "control": control}
        found.append(collector.validate(model, data, ("phases", k), defaults))
    if not found and collector.right((), "phases"):
        remedy = "add [[phases]], one for each step of the flight"
        collector.add(("phases",), "there is no phase", remedy, None)
    return found


def _names(collector: FindingCollector, found: Sequence[AnyPhase | None]) -> None:
    seen: dict[str, int] = {}
    for k, p in enumerate(found):
        first = seen.setdefault(p.name, k) if p is not None else k
        if p is not None and first != k:
            problem = f"is also the name of phase {first + 1}"
            collector.add(("phases", k, "name"), problem, "give each phase its own name", p.name)


def _times(
    collector: FindingCollector, found: Sequence[AnyPhase | None]
) -> tuple[float | None, list[float | None]]:
    """Check that each phase has one ending and that ends increase.

    Returns the latest end and the maximum duration of each phase [s]; None if unknown.
    """
    lengths: list[float | None] = [None] * len(found)
    first: float | None = 0.0  # earliest and latest start of the phase; None if unknown
    last: float | None = 0.0
    for k, p in enumerate(found):
        path = ("phases", k)
        if p is None or not collector.right(path, *_ENDINGS):
            first = last = None
            continue
        endings = [e for e in _ENDINGS if getattr(p, e) is not None]
        if len(endings) != 1:
            problem = f"has two endings, {' and '.join(endings)}" if endings else "has no ending"
            collector.add(
                path,
                problem,
                f"give exactly one of {', '.join(_ENDINGS)} (until is a mission time)",
                p.name,
            )
            first = last = None
            continue
        longest: Any = p.duration
        if p.until is not None:
            if first is not None and last is not None:
                _in_order(collector, p.until, first, last, path)
                longest = p.until - first
            first = last = p.until
        else:
            if p.settle is not None:
                longest = p.settle.timeout
                if p.settle.timeout <= p.settle.dwell:
                    problem = "times out before dwell has passed"
                    collector.add((*path, "settle"), problem, "give a timeout longer than dwell")
            if longest == AUTO:
                first = last = longest = None
            shortest = p.settle.dwell if p.settle is not None else longest
            first = first + (shortest or 0.0) if first is not None else None
            last = last + (longest or 0.0) if last is not None else None
        lengths[k] = longest
        _motion(collector, p, longest, path)
    return last, lengths


def _in_order(
    collector: FindingCollector, until: float, first: float, last: float, path: Keys
) -> None:
    if until <= first:
        problem = f"the phase would end before it starts at {first:g} s"
        remedy = "until is a mission time that increases from phase to phase; duration is a length of time"
        collector.add((*path, "until"), problem, remedy)
    elif until <= last:
        problem = (
            f"the phase may start as late as {last:g} s, when an earlier phase takes long to settle"
        )
        remedy = "end it by duration, or reduce the timeout of the earlier phase"
        collector.add((*path, "until"), problem, remedy)


def _motion(collector: FindingCollector, p: AnyPhase, longest: float | None, path: Keys) -> None:
    """Check that the travel or blend of a phase is not longer than the phase."""
    lasts = p.least_time
    if not collector.right(path, "reference", "blend", *_ENDINGS):
        return
    if p.shaping is not None and p.shaping.reference == "step":
        if "blend" in p.model_fields_set:
            remedy = "remove it, or use reference = 'shape' or 'distances'"
            collector.add((*path, "blend"), "has no effect with reference 'step'", remedy)
    elif longest is None or isinstance(p, Follow) or not lasts > longest * (1 + 1e-9):
        return
    elif hasattr(p, "blend"):
        problem = f"is longer than the phase, which lasts {longest:g} s"
        remedy = f"use blend <= {longest:g} or end the phase later"
        collector.add((*path, "blend"), problem, remedy, lasts)
    else:
        problem = f"is longer than the phase, which ends after {longest:g} s"
        collector.add((*path, "travel"), problem, "reduce travel or end the phase later", lasts)


def _samples(
    collector: FindingCollector, parts: Mapping[str, Any], end: float | None, n: int | None
) -> None:
    step = parts.get("output_step")
    if not step or not end or not collector.right((), "output_step", "formations"):
        return
    forms = parts["formations"].values()
    # One per step, and two at each change of phase.
    switches = 2 * len(tables(collector, "phases"))
    samples = end / step + switches
    about = {"complete": (n or 0) ** 2 // 2, "neighbours": 9 * (n or 0)}
    edges = sum(
        about.get(form.edges, 3 * (n or 0)) if isinstance(form.edges, str) else len(form.edges)
        for form in forms
    )
    numbers = 30 * (n or 0) + 8 * edges + 50
    if step > end:
        problem = f"is longer than the mission, which ends at {end:g} s"
        collector.add(("output_step",), problem, "reduce it", step)
    elif end / step > _MOST_SAMPLES:
        problem = (
            f"the result would have {end / step:.2g} samples; the maximum is {_MOST_SAMPLES:,}"
        )
        collector.add(("output_step",), problem, f"use {end / _MOST_SAMPLES:.2g} s or more", step)
    elif samples * numbers > _MOST_NUMBERS:
        problem = f"the result would have {samples * numbers * 8e-9:.2g} GB; the maximum is {_MOST_NUMBERS * 8e-9:g} GB"
        least = _MOST_NUMBERS / numbers - switches
        remedy = (
            f"use {end / least:.2g} s or more, or fewer edges"
            if least > 0
            else "use fewer agents, edges or phases"
        )
        collector.add(("output_step",), problem, remedy, step)


def _controls(
    collector: FindingCollector,
    found: Sequence[AnyPhase | None],
    lengths: Sequence[float | None],
) -> None:
    """Check the control of each phase, and the conditions of its kind."""
    local = collector.data.get("architecture", "local") == "local"
    for k, p in enumerate(found):
        path = ("phases", k)
        if p is None or not collector.right(path, "control"):
            continue
        if p.control == "body" and local:
            remedy = "use control = 'tracking', or architecture = 'body' for the mission"
            collector.add((*path, "control"), "requires architecture = 'body'", remedy)
        if p.control == "open" and p.moves:
            kind_name = collector.data["phases"][k]["kind"]
            problem = f"kind '{kind_name}' needs feedback control"
            others = " or 'body'" if p.body_control == "body" else ""
            collector.add((*path, "control"), problem, f"use control = 'tracking'{others}")
        if p.control != "open" and any(p.input_force):
            problem = f"has no effect with control '{p.control}'"
            collector.add((*path, "input_force"), problem, "remove it or use control = 'open'")
        if p.control != "tracking" and p.shaping is not None and p.shaping.position is not None:
            collector.add((*path, "position"), "needs tracked slots", "use control = 'tracking'")
        if own := _OWN.get(collector.data["phases"][k]["kind"]):
            own(collector, p, path, lengths[k])


def _turn(collector: FindingCollector, p: Turn, path: Keys, _: float | None) -> None:
    """Check that a turn has a target angle."""
    if p.attitude_deg is None and collector.right(path, *ANGLES):
        remedy = f"give at least one of {', '.join(reversed(ANGLES))}"
        collector.add(path, "has no target angle", remedy, p.name)


def _establish(collector: FindingCollector, p: Establish, path: Keys, _: float | None) -> None:
    """Check that a commanded attitude has an effect."""
    if not collector.right(path, "attitude", *ANGLES):
        return
    given = collector.data["phases"][path[1]]
    angles = [key for key in ANGLES if key in given]
    if p.attitude == "free" and angles:
        problem = "has no effect with attitude = 'free'"
        collector.add((*path, angles[0]), problem, "remove one of them")
    elif p.control != "tracking" and (angles or given.get("attitude") == "drawn"):
        problem = f"has no effect with control '{p.control}', which leaves the attitude free"
        remedy = (
            "use control = 'tracking', or remove this key and turn the formation in a later phase"
        )
        collector.add((*path, *(angles or ["attitude"])[:1]), problem, remedy)


def _orbit(collector: FindingCollector, p: Orbit, path: Keys, longest: float | None) -> None:
    """Check that an orbit has tracked slots, a rate within bounds, and an end."""
    if p.control == "body" and collector.right(path, "control"):
        problem = "an orbit cannot be flown by a wrench on the virtual body"
        collector.add((*path, "control"), problem, "use control = 'tracking'")
    if p.settle is not None and collector.right(path, *_ENDINGS):
        collector.add((*path, "settle"), "an orbit never settles", "end it by duration or until")
    if not collector.right(path, "rate_deg_s", "radius"):
        return
    rate, where = abs(np.deg2rad(p.rate_deg_s)), (*path, "rate_deg_s")
    turns = rate * (longest or 0.0) / (2 * np.pi)
    if rate == 0.0:
        collector.add(where, "must not be 0", "give a rate, or use kind = 'fly' or 'hold'")
    elif p.radius * rate > bounds.SPEED.most or p.radius * rate**2 > bounds.ACCELERATION.most:
        problem = f"requires {p.radius * rate:.2g} m/s and {p.radius * rate**2:.2g} m/s^2, beyond the bounds"
        collector.add(where, problem, "use a lower rate or a smaller radius")
    elif turns > _MOST_TURNS:
        problem = f"gives {turns:.4g} turns in {longest:g} s; the maximum is {_MOST_TURNS}"
        collector.add(where, problem, "use a lower rate or several phases")


def _ended(collector: FindingCollector, p: AnyPhase, path: Keys, _: float | None) -> None:
    """Check that a phase with a way of its own has tracked slots and a time of arrival."""
    kind_name = collector.data["phases"][path[1]]["kind"]
    if p.control == "body" and collector.right(path, "control"):
        problem = f"kind '{kind_name}' cannot be flown by a wrench on the virtual body"
        collector.add((*path, "control"), problem, "use control = 'tracking'")
    if p.settle is not None and collector.right(path, *_ENDINGS):
        problem = f"kind '{kind_name}' needs a time of arrival"
        collector.add((*path, "settle"), problem, "end it by duration or until", None)


def _vertical(collector: FindingCollector, p: Vertical, path: Keys, longest: float | None) -> None:
    """Check how a take-off or a landing is staggered, besides what `_ended` checks."""
    _ended(collector, p, path, longest)
    if p.stagger is None:
        if "by" in p.model_fields_set:
            collector.add((*path, "by"), "has no effect without stagger", "remove it")
    elif p.travel is not None:
        problem = "has no effect with stagger: a group takes what the others leave of the phase"
        collector.add((*path, "travel"), problem, "remove it")
    elif p.until is not None or p.duration == AUTO:
        where = (*path, "until" if p.until is not None else "duration")
        problem = "does not say how long a staggered phase lasts"
        collector.add(where, problem, "give its duration in seconds")


def _go(collector: FindingCollector, p: Go, path: Keys, longest: float | None) -> None:
    """Check that a way can be found and flown: tracked slots, an end, and formations that exist."""
    _ended(collector, p, path, longest)
    for name in p.formations or ():
        _exists(collector, name, path, "formations")


#: Greatest jumps of position [m] and velocity [m/s] within a trajectory: those of numbers rounded in a file.
_JUMPS = ((0.01, "m"), (0.1, "m/s"))


def _follow(collector: FindingCollector, p: Follow, path: Keys, longest: float | None) -> None:
    """Check that there are trajectories, without jumps, and an end."""
    _ended(collector, p, path, longest)
    where = (*path, "trajectories")
    if p.trajectories is None:
        problem, remedy = "is missing", "give the name of a file with trajectories"
        if p.file is not None:
            problem, remedy = NOT_A_FILE, "load the mission from its file"
        if collector.right(path, "file", "trajectories"):
            collector.add((*path, "file"), problem, remedy)
        return
    for key in ("file", "units", "axes"):
        if getattr(p, key) is not None:
            problem = (
                "is given beside its numbers" if key == "file" else "is for files, not for numbers"
            )
            collector.add((*path, key), problem, "remove one of the two")
            return
    for i, rows in enumerate(p.trajectories):
        lengths = {len(row) for row in rows}
        if len(lengths) > 1 or (min(lengths) - 1) % CHANNELS or min(row[0] for row in rows) <= 0.0:
            problem = "has pieces of another form than a duration > 0 and as many coefficients of x, y, z and yaw"
            collector.add(
                (*where, i), problem, "make all rows of one length: 1 + 4 P numbers", None
            )
            return
        by, when = greatest_jumps(rows_to_curve(rows))
        for far, t, (most, unit) in zip(by.tolist(), when.tolist(), _JUMPS, strict=False):
            if far > most:
                problem = f"jumps by {far:.3g} {unit} at {t:.6g} s"
                remedy = f"correct it: at most {most:g} {unit} is taken for rounding"
                collector.add((*where, i), problem, remedy, None)
                return
    try:
        _ = p.pieces
    except ValueError as error:
        collector.add(where, str(error), "give all vehicles the same times, or fewer", None)


def _followers(collector: FindingCollector, p: Follow, n: int, path: Keys) -> None:
    """Check that there is one trajectory for the virtual body, or one for each vehicle."""
    given = len(p.trajectories or ())
    if given not in (0, 1, n):
        problem = f"has {given} trajectories for {n} agents"
        remedy = "give one for the virtual body, or one for each agent"
        collector.add((*path, "trajectories"), problem, remedy, None)
    elif given > 1 and p.yaw == "file":
        problem = "has no effect with a trajectory for each vehicle, whose yaw follows [yaw]"
        collector.add((*path, "yaw"), problem, "remove it")


def _bent(
    collector: FindingCollector, p: Reshape, rows: Sequence[Sequence[Any]], n: int, path: Keys
) -> None:
    """Check the form of bent ways, and that nothing else bends them."""
    where, problem, remedy = (*path, "control_points"), "", ""
    if len(rows) < 4 or any(len(row) != n for row in rows):
        problem, remedy = "is no list of four or more rows of slots", f"give {n} points in each row"
    elif p.transition != "straight" or p.alignment != "none" or p.control != "tracking":
        problem = "needs tracked slots, alignment = 'none' and no transition"
        remedy = "correct these keys, or use transition = 'ways'"
    if problem:
        collector.add(where, problem, remedy, None)


#: Checks of single kinds. Arguments: the findings, the phase, its path, its maximum duration [s] or None.
def _reshape(collector: FindingCollector, p: Reshape, path: Keys, _: float | None) -> None:
    """Check that ways other than straight ones can be found and flown."""
    if p.transition == "straight" or not collector.right(path, "transition"):
        return
    problem = remedy = ""
    if p.control != "tracking" or p.reference != "shape":
        problem = "needs slots that are tracked"
        remedy = "use control = 'tracking' and reference = 'shape'"
    elif collector.data.get("assignment", "given") != "given":
        problem = "is for agents with slots of their own, but assignment chooses their slots"
        remedy = "use assignment = 'given', or remove this key"
    elif p.alignment == "none":
        problem, remedy = "chooses the alignment itself", "remove alignment"
    elif p.blend == AUTO != p.duration:
        problem, remedy = "takes a time that is not known yet", "use duration = 'auto', too"
    if problem:
        collector.add((*path, "transition"), problem, remedy)


_OWN: dict[str, Callable[[FindingCollector, Any, Keys, float | None], None]] = {
    "brake": _ended,
    "establish": _establish,
    "follow": _follow,
    "land": _vertical,
    "go": _go,
    "orbit": _orbit,
    "reshape": _reshape,
    "takeoff": _vertical,
    "turn": _turn,
}


def members(collector: FindingCollector, agents: Sequence[int], n: int, path: Keys) -> None:
    """Check that agents, such as those that take off or land, exist, and are named once."""
    beyond = [i for i in agents if i > n]
    if beyond:
        collector.add(path, "there is no such agent", f"use 1 to {n}", beyond[0])
    if len(set(agents)) < len(agents):
        collector.add(path, "names an agent twice", "name each once", None)


def _formations(
    collector: FindingCollector,
    found: Sequence[AnyPhase | None],
    parts: Mapping[str, Any],
    n: int | None,
) -> None:
    """Check that formations exist and can be blended to, tracked and reached."""
    forms: Mapping[str, Formation] = parts["formations"]
    held: str | None = ""  # name of the formation held; "": initial positions; None: unknown
    slotted: set[str] = set()  # names of formations that have slots to track
    for k, p in enumerate(found):
        path = ("phases", k)
        if p is None or not collector.right(path, "formation", "reference"):
            held = None if p is None or p.shaping is not None else held
            continue
        if (shaping := p.shaping) is not None:
            _exists(collector, shaping.formation, path)
            form = forms.get(shaping.formation)
            if p.establishing is None and held == "":
                problem = "no formation has been established yet"
                remedy = "use kind = 'establish' for the first formation"
                collector.add((*path, "kind"), problem, remedy)
            drawn = collector.data["phases"][k].get("attitude") == "drawn"
            if (
                drawn
                and form is not None
                and not form.knows_slots
                and collector.right(path, "attitude")
            ):
                problem = f"formation '{shaping.formation}' is given by distances alone, which have no axes"
                remedy = "remove it, give the formation slots, or command an attitude by yaw_deg"
                collector.add((*path, "attitude"), problem, remedy)
            if n is not None and form is not None and sound(collector, shaping.formation):
                _blendable(collector, shaping, form, n, path)
            held = shaping.formation
        form = forms.get(held) if held else None
        tracked = p.control == "tracking" and collector.right(path, "control")
        if not tracked or n is None or form is None or not held or not sound(collector, held):
            continue
        if held in slotted:
            continue
        if form.slot_array(n) is None:
            problem = f"formation '{held}' has no slots to track"
            remedy = f"give formations.{toml_key(held)} a shape or slots, or change control"
            collector.add((*path, "control"), problem, remedy, p.control)
        else:
            slotted.add(held)


def _exists(collector: FindingCollector, name: str, path: Keys, key: str = "formation") -> None:
    known = collector.data.get("formations", {})
    if isinstance(known, dict) and name not in known:
        names = f"formations: {', '.join(known)}" if known else "add a table [formations.NAME]"
        collector.add((*path, key), "there is no such formation", near(name, known) or names, name)


def _blendable(
    collector: FindingCollector, p: Shaping, form: Formation, n: int, path: Keys
) -> None:
    """Check that a formation can be reached by blending slots: it has slots, and distances that agree with them."""
    if p.reference != "shape":
        return
    slots = form.slot_array(n)
    if slots is None:
        problem = f"formation '{p.formation}' has no slots to blend"
        remedy = "give it a shape or slots, or use reference = 'distances'"
        collector.add((*path, "reference"), problem, remedy, p.reference)
    elif form.distances is not None:
        edges = form.edge_array(n)
        between = distance_geometry.distances(slots, edges)
        for k in np.flatnonzero(np.abs(between - form.distances) > 1e-3 * between):
            problem = f"the slots of {agent_names(edges[k])} are {between[k]:.7g} m apart"
            remedy = f"correct it, or use reference = 'distances' in phase {p.name}"
            collector.add(("formations", p.formation, "distances", int(k)), problem, remedy)


def _smooth(parts: Mapping[str, Any]) -> bool:
    return parts.get("smoothness") == "jerk"


def _smoothness(collector: FindingCollector, p: AnyPhase, path: Keys, *, smooth: bool) -> None:
    """Check that a smooth mission can be smooth, and that others use nothing that only smooth ones have."""
    if not collector.right((), "smoothness"):
        return
    if not smooth:
        for key in [*p.automatic, *(["through"] if getattr(p, "through", ()) else [])]:
            problem = "needs a smooth mission" + (" to have a least time" if key in TIMES else "")
            collector.add(
                (*path, key), problem, "add smoothness = 'jerk' at the top of the mission"
            )
        return
    if p.control == "body" and collector.right(path, "control"):
        problem = "has regulators of its own, which jump at a switch; smoothness = 'jerk' needs control = 'tracking'"
        remedy = "use control = 'tracking', or remove smoothness"
        collector.add((*path, "control"), problem, remedy, p.control)
    shaping = p.shaping
    if shaping is not None and shaping.reference == "step" and p.control == "tracking":
        problem = "jumps, but the mission has smoothness = 'jerk'"
        collector.add((*path, "reference"), problem, "use reference = 'shape' or 'distances'")
    through = [at.time for at in getattr(p, "through", ())]
    given = [time for time in through if time is not None]
    if given and collector.right(path, "through"):
        _through(collector, p, path, len(through), given)


def _through(
    collector: FindingCollector, p: AnyPhase, path: Keys, points: int, given: Sequence[float]
) -> None:
    """Check the times of points to pass."""
    where = (*path, "through")
    steering = p.steering
    arrival = (steering.travel if steering is not None else None) or p.duration
    if len(given) < points:
        collector.add(
            where, "has points with a time and points without one", "give all times or none", None
        )
    elif any(b <= a for a, b in itertools.pairwise(given)):
        collector.add(where, "times must increase from point to point", "order them", None)
    elif p.automatic:
        collector.add(where, "has times, but the arrival is automatic", "remove the times", None)
    elif isinstance(arrival, float) and given[-1] >= arrival:
        problem = f"passes its last point at {given[-1]:g} s, but arrives at {arrival:g} s"
        collector.add(where, problem, "pass it earlier or arrive later", None)


def _automatic(
    collector: FindingCollector, p: AnyPhase, path: Keys, parts: Mapping[str, Any]
) -> None:
    """Check that times that follow from the limits have limits to follow from."""
    keys = [key for key in p.automatic if collector.right(path, key)]
    if not keys or not _smooth(parts):
        return
    where = (*path, keys[0])
    if p.control != "tracking":
        problem = f"needs tracked slots to have a least time, not control '{p.control}'"
        collector.add(where, problem, "use control = 'tracking', or give a time")
    if p.duration == AUTO and not (
        p.steering or p.shaping or p.vertical or p.led or isinstance(p, Go)
    ):
        problem = (
            f"a phase of kind '{collector.data['phases'][path[1]]['kind']}' has no least duration"
        )
        collector.add((*path, "duration"), problem, "give a duration")
    steers = p.steering or p.vertical or (p if isinstance(p, Follow) else None)
    if p.duration == AUTO and steers is not None and steers.travel is not None:
        problem = "has no effect with duration = 'auto', which ends the phase at the arrival"
        collector.add((*path, "travel"), problem, "remove one of them")
    limits, agents = parts.get("limits", Limits()), parts.get("agents")
    bounded = [limits.speed, limits.acceleration, limits.jerk, limits.tilt_deg]
    limited = agents is None or all(math.isfinite(f) for f in agents.thrust_limit)
    if not limited and all(limit is None for limit in bounded) and collector.right((), "limits"):
        problem = "needs a limit that bounds it, and the mission has none"
        remedy = "give limits.speed, acceleration, jerk or tilt_deg, or agents.thrust_limit"
        collector.add(where, problem, remedy)


def _arrivals(
    collector: FindingCollector, found: Sequence[AnyPhase | None], lqr: Lqr, *, smooth: bool
) -> None:
    """Check that a leg with a finite horizon has a time of arrival."""
    for k, p in enumerate(found):
        steering = p.steering if p is not None else None
        if steering is None or steering.settle is None or steering.travel is not None:
            continue
        if smooth and p is not None and p.control == "tracking":
            problem = "a smooth way needs a time of arrival"
            collector.add(
                ("phases", k, "settle"), problem, "give travel, or end by until or duration", None
            )
            continue
        if not collector.right((), "lqr"):
            continue
        for key, weights, used in (
            ("lqr", lqr, "position" in steering.meets),
            ("lqr.attitude", lqr.attitude, steering.attitude_deg is not None),
        ):
            if used and weights.horizon == "finite":
                problem = f"the finite horizon of {key} needs a time of arrival"
                remedy = f"give travel, end by until or duration, or use {key}.horizon = 'infinite'"
                collector.add(("phases", k, "settle"), problem, remedy, None)
