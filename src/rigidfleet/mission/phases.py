"""Rules of phases: their order, their durations, and whether each can follow the one before."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Any

import numpy as np

from rigidfleet._common.text import agent_names
from rigidfleet._common.toml import toml_key
from rigidfleet.foreign.curves import CHANNELS, greatest_jumps_and_times
from rigidfleet.formation import distance_geometry
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.mission import bounds
from rigidfleet.mission.files import NOT_A_FILE
from rigidfleet.mission.findings import Keys, suggest
from rigidfleet.mission.kinds import (
    ANGLES,
    KINDS,
    TIMES,
    AnyPhase,
    Establish,
    Follow,
    Go,
    Orbit,
    Phase,
    Reshape,
    Shaping,
    Turn,
    seconds,
)
from rigidfleet.mission.rules import Breach, Breaches, Draft, unused_key_rules
from rigidfleet.mission.schema import Formation
from rigidfleet.mission.values import AUTO

_ENDINGS = ("until", "duration", "settle")
#: Maximum number of samples of a result.
_MOST_SAMPLES = 1_000_000
#: Maximum number of turns of an orbit: with more, the samples of the planned path would miss the circle.
_MOST_TURNS = 100
#: Maximum number of values in a result: 4 GB.
_MOST_NUMBERS = 5e8
#: The phases as written, with None for each that is not valid.
Written = Sequence[Any]


def phase_rules(m: Draft) -> Breaches:
    """All phases, by themselves and together; they are parts of the mission, including those with findings."""
    phases = yield from _validate_phases(m)
    m.parts["phases"] = tuple(p for p in phases if p is not None)
    durations = [math.nan] * len(phases)
    m.record_breaches(("phases",), _phase_name_rules(phases))
    m.record_breaches((), _phase_ending_rules(m, phases, durations))
    for k, p in enumerate(phases):
        if p is not None:
            path = ("phases", k)
            m.record_breaches(path, _motion_time_rules(m, p, k, durations[k]))
            if m.is_valid(path, "control"):
                m.record_breaches(path, _control_rules(m, p))
                if own := _OWN.get(p.kind):
                    m.record_breaches(path, own(m, p, k, durations[k]))
    m.record_breaches((), _formation_use_rules(m, phases))
    for k, p in enumerate(phases):
        if p is not None:
            for rules in (
                _arrival_time_rules(m, p),
                _smoothness_rules(m, p, k),
                _automatic_time_rules(m, p, k),
            ):
                m.record_breaches(("phases", k), rules)
    if m.is_valid((), "phases"):
        # With automatic durations it is not known; the mission is checked again when they are.
        m.end = latest_end_of_phases(m.phases)


def latest_end_of_phases(phases: Sequence[AnyPhase]) -> float:
    """Latest mission time [s] at which the last phase ends: each phase that settles takes its full timeout.

    It is nan if it depends on a duration that is automatic.
    """
    t = 0.0
    for p in phases:
        length = p.settle.timeout if p.settle is not None else seconds(p.duration or 0.0)
        t = p.until if p.until is not None else t + length
    return t


def _validate_phases(m: Draft) -> Generator[Breach, None, list[Any]]:
    """Each phase with defaults for name and control; None for a phase that is not valid."""
    body = m.data.get("architecture") == "body"
    phases: list[Any] = []
    for k, data in enumerate(m.tables("phases")):
        if (model := m.model_class_of_kind(data, ("phases", k), KINDS)) is None:
            phases.append(None)
            continue
        control = model.body_control if body else "tracking"
        defaults = {"name": f"{data['kind']} {k + 1}", "control": control}
        phases.append(m.validate(model, data, ("phases", k), defaults))
    if not phases and m.is_valid((), "phases"):
        remedy = "add [[phases]], one for each step of the flight"
        yield Breach("phases", "there is no phase", remedy, None)
    return phases


def _phase_name_rules(phases: Written) -> Breaches:
    """Names are unique."""
    seen: dict[str, int] = {}
    for k, p in enumerate(phases):
        first = seen.setdefault(p.name, k) if p is not None else k
        if first != k:
            problem = f"is also the name of phase {first + 1}"
            yield Breach((k, "name"), problem, "give each phase its own name", p.name)


def _phase_ending_rules(m: Draft, phases: Written, durations: list[float]) -> Breaches:
    """Each phase has one ending, and ends increase; notes the greatest ``durations`` of phases."""
    first = last = 0.0  # earliest and latest start of the phase; nan if unknown
    for k, p in enumerate(phases):
        path = ("phases", k)
        valid = p is not None and m.is_valid(path, *_ENDINGS)
        endings = [e for e in _ENDINGS if getattr(p, e) is not None] if valid else []
        if len(endings) != 1:
            if valid:
                problem = (
                    f"has two endings, {' and '.join(endings)}" if endings else "has no ending"
                )
                remedy = f"give exactly one of {', '.join(_ENDINGS)} (until is a mission time)"
                yield Breach(path, problem, remedy, p.name)
            first = last = math.nan
            continue
        if p.until is not None:
            durations[k] = p.until - first
            if p.until <= first:
                problem = f"the phase would end before it starts at {first:g} s"
                remedy = "until is a mission time that increases from phase to phase; duration is a length of time"
                yield Breach((*path, "until"), problem, remedy)
            elif p.until <= last:
                problem = f"the phase may start as late as {last:g} s, when an earlier phase takes long to settle"
                remedy = "end it by duration, or reduce the timeout of the earlier phase"
                yield Breach((*path, "until"), problem, remedy)
            first = last = p.until
            continue
        shortest = longest = seconds(p.duration or 0.0)
        if p.settle is not None:
            shortest, longest = p.settle.dwell, p.settle.timeout
            if longest <= shortest:
                problem = "times out before dwell has passed"
                yield Breach((*path, "settle"), problem, "give a timeout longer than dwell")
        durations[k] = longest
        first, last = first + shortest, last + longest
    yield from _sample_count_rules(m, last)


def _motion_time_rules(m: Draft, p: Phase, k: int, duration: float) -> Breaches:
    """The travel or blend of a phase is not longer than the phase."""
    lasts = p.least_time
    if not m.is_valid(("phases", k), "reference", *_ENDINGS):
        return
    if p.shaping is not None and p.shaping.reference == "step":
        yield from unused_key_rules(p, "blend", "reference", "shape")
    elif p.follows_curves or not lasts > duration * (1 + 1e-9):
        return
    elif p.time_key == "blend":
        problem = f"is longer than the phase, which lasts {duration:g} s"
        yield Breach("blend", problem, f"use blend <= {duration:g} or end the phase later", lasts)
    else:
        problem = f"is longer than the phase, which ends after {duration:g} s"
        yield Breach("travel", problem, "reduce travel or end the phase later", lasts)


def _estimate_numbers_per_sample(m: Draft, n: int) -> int:
    """About how many numbers a sample of n agents has in a result."""
    about = {"complete": n**2 // 2, "neighbours": 9 * n}
    edges = sum(
        about.get(form.edges, 3 * n) if isinstance(form.edges, str) else len(form.edges)
        for form in m.formations.values()
    )
    return 30 * n + 8 * edges + 50


def _sample_count_rules(m: Draft, end: float) -> Breaches:
    """A result has samples, and not too many."""
    step, n = m.output_step, m.n or 0
    if not end > 0.0 or not m.is_valid((), "output_step", "formations"):
        return
    switches = 2 * len(m.tables("phases"))  # one sample per step, and two at each change of phase
    samples = end / step + switches
    numbers = _estimate_numbers_per_sample(m, n)
    if step > end:
        problem, remedy = f"is longer than the mission, which ends at {end:g} s", "reduce it"
    elif end / step > _MOST_SAMPLES:
        problem = (
            f"the result would have {end / step:.2g} samples; the maximum is {_MOST_SAMPLES:,}"
        )
        remedy = f"use {end / _MOST_SAMPLES:.2g} s or more"
    elif samples * numbers > _MOST_NUMBERS:
        problem = f"the result would have {samples * numbers * 8e-9:.2g} GB; the maximum is {_MOST_NUMBERS * 8e-9:g} GB"
        least = _MOST_NUMBERS / numbers - switches
        remedy = "use fewer agents, edges or phases"
        if least > 0:
            remedy = f"use {end / least:.2g} s or more, or fewer edges"
    else:
        return
    yield Breach("output_step", problem, remedy, step)


def _control_rules(m: Draft, p: Phase) -> Breaches:
    """The mission has the control of a phase, and the phase what that control needs."""
    if p.leads_body and m.data.get("architecture", "local") == "local":
        remedy = "use control = 'tracking', or architecture = 'body' for the mission"
        yield Breach("control", "requires architecture = 'body'", remedy)
    if p.control == "open" and p.moves:
        others = " or 'body'" if p.body_control == "body" else ""
        remedy = f"use control = 'tracking'{others}"
        yield Breach("control", f"kind '{p.kind}' needs feedback control", remedy)
    if p.control != "open" and any(p.input_force):
        problem = f"has no effect with control '{p.control}'"
        yield Breach("input_force", problem, "remove it or use control = 'open'")
    if not p.tracks_slots and p.shaping is not None and p.shaping.position is not None:
        yield Breach("position", "needs tracked slots", "use control = 'tracking'")


# -- rules of single kinds ---------------------------------------------------------------------------
# Arguments: the mission, the phase, its number from 0, its greatest duration [s], nan if unknown.


def _turn_rules(m: Draft, p: Turn, k: int, _: float) -> Breaches:
    """A turn has a target angle."""
    if p.attitude_deg is None and m.is_valid(("phases", k), *ANGLES):
        remedy = f"give at least one of {', '.join(reversed(ANGLES))}"
        yield Breach((), "has no target angle", remedy, p.name)


def _establish_rules(m: Draft, p: Establish, k: int, _: float) -> Breaches:
    """A commanded attitude has an effect."""
    if not m.is_valid(("phases", k), "attitude", *ANGLES):
        return
    written = m.data["phases"][k]
    angles = [key for key in ANGLES if key in written]
    if p.attitude == "free" and angles:
        yield Breach(angles[0], "has no effect with attitude = 'free'", "remove one of them")
    elif not p.tracks_slots and (angles or written.get("attitude") == "drawn"):
        problem = f"has no effect with control '{p.control}', which leaves the attitude free"
        remedy = (
            "use control = 'tracking', or remove this key and turn the formation in a later phase"
        )
        yield Breach([*angles, "attitude"][0], problem, remedy)


def _orbit_rules(m: Draft, p: Orbit, k: int, duration: float) -> Breaches:
    """An orbit has tracked slots, a rate within bounds, and an end."""
    yield from _tracked_way_rules(m, p, k, duration)
    if not m.is_valid(("phases", k), "radius"):
        return
    rate = abs(np.deg2rad(p.rate_deg_s))
    turns = rate * duration / (2 * np.pi)
    if rate == 0.0:
        yield Breach("rate_deg_s", "must not be 0", "give a rate, or use kind = 'fly' or 'hold'")
    elif p.radius * rate > bounds.SPEED.most or p.radius * rate**2 > bounds.ACCELERATION.most:
        problem = f"requires {p.radius * rate:.2g} m/s and {p.radius * rate**2:.2g} m/s^2, beyond the bounds"
        yield Breach("rate_deg_s", problem, "use a lower rate or a smaller radius")
    elif turns > _MOST_TURNS:
        problem = f"gives {turns:.4g} turns in {duration:g} s; the maximum is {_MOST_TURNS}"
        yield Breach("rate_deg_s", problem, "use a lower rate or several phases")


def _tracked_way_rules(m: Draft, p: Phase, k: int, _: float) -> Breaches:
    """A phase with a way of its own has tracked slots and a time of arrival."""
    if p.leads_body:
        problem = f"kind '{p.kind}' cannot be flown by a wrench on the virtual body"
        yield Breach("control", problem, "use control = 'tracking'")
    if p.settle is not None:
        problem = f"kind '{p.kind}' needs a time at which it ends"
        yield Breach("settle", problem, "end it by duration or until", None)


def _vertical_rules(m: Draft, p: Any, k: int, duration: float) -> Breaches:
    """A take-off or a landing has what its groups need, and agents that exist."""
    yield from _tracked_way_rules(m, p, k, duration)
    if p.lands and p.places == "own" and (p.agents or p.stagger or p.travel or p.until):
        problem = "leads all vehicles together, without agents, stagger, travel and until"
        yield Breach("places", problem, "remove these, and end the phase by its duration")
    if p.stagger is None:
        if "by" in p.model_fields_set:
            yield Breach("by", "has no effect without stagger", "remove it")
    elif p.travel is not None:
        problem = "has no effect with stagger: a group takes what the others leave of the phase"
        yield Breach("travel", problem, "remove it")
    elif p.until is not None or p.duration == AUTO:
        where = "until" if p.until is not None else "duration"
        problem = "does not say how long a staggered phase lasts"
        yield Breach(where, problem, "give its duration in seconds")
    yield from named_agent_rules(m, p.agents, "agents")


def _go_rules(m: Draft, p: Go, k: int, duration: float) -> Breaches:
    """A way can be found and flown: tracked slots, an end, and formations that exist."""
    yield from _tracked_way_rules(m, p, k, duration)
    for name in p.formations or ():
        yield from _formation_existence_rules(m, name, "formations")


#: Greatest jumps of position [m] and velocity [m/s] within a trajectory: those of numbers rounded in a file.
_JUMPS = ((0.01, "m"), (0.1, "m/s"))


def _follow_rules(m: Draft, p: Follow, k: int, duration: float) -> Breaches:
    """There are trajectories, without jumps, one for the virtual body or one for each vehicle, and an end."""
    yield from _tracked_way_rules(m, p, k, duration)
    if p.trajectories is None:
        problem, remedy = "is missing", "give the name of a file with trajectories"
        if p.file is not None:
            problem, remedy = NOT_A_FILE, "load the mission from its file"
        if m.is_valid(("phases", k), "file", "trajectories"):
            yield Breach("file", problem, remedy)
        return
    count = len(p.trajectories)
    if m.n is not None and count not in (1, m.n):
        problem = f"has {count} trajectories for {m.n} agents"
        remedy = "give one for the virtual body, or one for each agent"
        yield Breach("trajectories", problem, remedy, None)
    elif m.n is not None and count > 1 and p.yaw == "file":
        problem = "has no effect with a trajectory for each vehicle, whose yaw follows [yaw]"
        yield Breach("yaw", problem, "remove it")
    for key in ("file", "units", "axes"):
        if getattr(p, key) is not None:
            problem = (
                "is given beside its numbers" if key == "file" else "is for files, not for numbers"
            )
            yield Breach(key, problem, "remove one of the two")
            return
    for i, rows in enumerate(p.trajectories):
        lengths = {len(row) for row in rows}
        if len(lengths) > 1 or (min(lengths) - 1) % CHANNELS or min(row[0] for row in rows) <= 0.0:
            problem = "has pieces of another form than a duration > 0 and as many coefficients of x, y, z and yaw"
            remedy = "make all rows of one length: 1 + 4 P numbers"
            yield Breach(("trajectories", i), problem, remedy, None)
            return
    try:
        way = p.pieces
    except ValueError as error:
        remedy = "give all vehicles the same times, or fewer"
        yield Breach("trajectories", str(error), remedy, None)
        return
    for i in range(count):  # one that ends before the others stays where it ends
        by, when = greatest_jumps_and_times(Piecewise(way.time, way.pieces[:, i]))
        for far, t, (most, unit) in zip(by.tolist(), when.tolist(), _JUMPS, strict=False):
            if far > most:
                problem = f"jumps by {far:.3g} {unit} at {t:.6g} s"
                remedy = f"correct it: at most {most:g} {unit} is taken for rounding"
                yield Breach(("trajectories", i), problem, remedy, None)
                return
    if p.travel and p.settle is None and duration > p.travel * (1 + 1e-9):
        # Beyond the file the body goes on as it ends, and the vehicles rest beside each other.
        v = way.states(way.time[-1:], 2)[1, 0, :, :3] * (way.time[-1] / p.travel)
        mass = () if m.agents is None else m.agents.mass
        body = np.average(v, axis=0, weights=mass if len(mass) == len(v) else None)
        speed = np.linalg.norm(v - body, axis=1)
        if (most := speed.max()) > _JUMPS[1][0]:
            who = f"agent {speed.argmax() + 1} goes on at {most:.2f} m/s beside the others"
            remedy = "let the trajectories end at rest, or the phase with them"
            yield Breach("travel", f"ends before the phase, while {who}", remedy, p.travel)


def _reshape_rules(m: Draft, p: Reshape, k: int, _: float) -> Breaches:
    """Ways other than straight ones can be found and flown, or are given, and nothing else bends them."""
    rows, n = p.control_points, m.n
    if rows is not None and n is not None:
        if len(rows) < 4 or any(len(row) != n for row in rows):
            problem = "is no list of four or more rows of slots"
            yield Breach("control_points", problem, f"give {n} points in each row", None)
        elif p.transition != "straight" or p.alignment != "none" or not p.tracks_slots:
            problem = "needs tracked slots, alignment = 'none' and no transition"
            remedy = "correct these keys, or use transition = 'ways'"
            yield Breach("control_points", problem, remedy, None)
    if p.transition == "straight":
        return
    if not p.tracks_slots or p.reference != "shape":
        remedy = "use control = 'tracking' and reference = 'shape'"
        yield Breach("transition", "needs slots that are tracked", remedy)
    elif m.data.get("assignment", "given") != "given":
        problem = "is for agents with slots of their own, but assignment chooses their slots"
        yield Breach("transition", problem, "use assignment = 'given', or remove this key")
    elif p.alignment == "none":
        yield Breach("transition", "chooses the alignment itself", "remove alignment")
    elif p.blend == AUTO != p.duration:
        problem = "takes a time that is not known yet"
        yield Breach("transition", problem, "use duration = 'auto', too")


_OWN: dict[str, Callable[[Draft, Any, int, float], Breaches]] = {
    "brake": _tracked_way_rules,
    "establish": _establish_rules,
    "follow": _follow_rules,
    "land": _vertical_rules,
    "go": _go_rules,
    "orbit": _orbit_rules,
    "reshape": _reshape_rules,
    "takeoff": _vertical_rules,
    "turn": _turn_rules,
}


def named_agent_rules(m: Draft, agents: Sequence[int], *where: str) -> Breaches:
    """Agents, such as those that take off or land, exist, and are named once."""
    beyond = [i for i in agents if m.n is not None and i > m.n]
    if beyond:
        yield Breach(where, "there is no such agent", f"use 1 to {m.n}", beyond[0])
    if len(set(agents)) < len(agents):
        yield Breach(where, "names an agent twice", "name each once", None)


# -- rules of formations, smoothness and times -------------------------------------------------------


def _formation_use_rules(m: Draft, phases: Written) -> Breaches:
    """Formations exist and can be blended to, tracked and reached."""
    forms: Mapping[str, Formation] = m.formations
    n, sound = m.n or 0, {name: x for name, x in forms.items() if m.is_valid(("formations",), name)}
    held: str | None = ""  # name of the formation held; "": initial positions; None: unknown
    slotted: set[str] = set()  # names of formations that have slots to track
    for k, p in enumerate(phases):
        path = ("phases", k)
        if p is None or not m.is_valid(path, "formation", "reference"):
            held = None if p is None or p.shaping is not None else held
            continue
        if (shaping := p.shaping) is not None:
            yield from _formation_existence_rules(m, shaping.formation, *path, "formation")
            form = forms.get(shaping.formation)
            if p.establishing is None and held == "":
                problem = "no formation has been established yet"
                remedy = "use kind = 'establish' for the first formation"
                yield Breach((*path, "kind"), problem, remedy)
            drawn = m.data["phases"][k].get("attitude") == "drawn" and m.is_valid(path, "attitude")
            if drawn and form is not None and not form.knows_slots:
                problem = f"formation '{shaping.formation}' is given by distances alone, which have no axes"
                remedy = "remove it, give the formation slots, or command an attitude by yaw_deg"
                yield Breach((*path, "attitude"), problem, remedy)
            if n and shaping.formation in sound:
                yield from _slot_blend_rules(shaping, sound[shaping.formation], n, path)
            held = shaping.formation
        form = sound.get(held) if held else None
        tracked = p.tracks_slots and held not in slotted and m.is_valid(path, "control")
        if not tracked or not n or form is None or not held:
            continue
        if form.distances is not None and form.slot_array(n) is None:
            problem = f"formation '{held}' has no slots to track"
            remedy = f"give formations.{toml_key(held)} a shape or slots, or change control"
            yield Breach((*path, "control"), problem, remedy, p.control)
        else:
            slotted.add(held)


def _formation_existence_rules(m: Draft, name: str, *where: str | int) -> Breaches:
    """A formation exists."""
    known = m.data.get("formations", {})
    if isinstance(known, dict) and name not in known:
        names = f"formations: {', '.join(known)}" if known else "add a table [formations.NAME]"
        yield Breach(where, "there is no such formation", suggest(name, known) or names, name)


def _slot_blend_rules(p: Shaping, form: Formation, n: int, path: Keys) -> Breaches:
    """A formation can be reached by blending slots: it has slots, and distances that agree with them."""
    if p.reference != "shape" or form.distances is None:  # without distances, it has slots
        return
    slots = form.slot_array(n)
    if slots is None:
        problem = f"formation '{p.formation}' has no slots to blend"
        remedy = "give it a shape or slots, or use reference = 'distances'"
        yield Breach((*path, "reference"), problem, remedy, p.reference)
    else:
        edges = form.edge_array(n)
        between = distance_geometry.distances(slots, edges)
        for i in np.flatnonzero(np.abs(between - form.distances) > 1e-3 * between):
            problem = f"the slots of {agent_names(edges[i])} are {between[i]:.7g} m apart"
            remedy = f"correct it, or use reference = 'distances' in phase {p.name}"
            yield Breach(("formations", p.formation, "distances", int(i)), problem, remedy)


def _smoothness_rules(m: Draft, p: Phase, k: int) -> Breaches:
    """A smooth mission can be smooth, and others use nothing that only smooth ones have."""
    if not m.is_valid((), "smoothness"):
        return
    through = p.points
    if not m.are_ways_smooth:
        for key in [*p.auto_keys, *(["through"] if through else [])]:
            problem = "needs a smooth mission" + (" to have a least time" if key in TIMES else "")
            yield Breach(key, problem, "add smoothness = 'jerk' at the top of the mission")
        return
    if p.leads_body:
        problem = "has regulators of its own, which jump at a switch; smoothness = 'jerk' needs control = 'tracking'"
        remedy = "use control = 'tracking', or remove smoothness"
        yield Breach("control", problem, remedy, p.control)
    shaping = p.shaping
    if shaping is not None and shaping.reference == "step" and p.tracks_slots:
        problem = "jumps, but the mission has smoothness = 'jerk'"
        yield Breach("reference", problem, "use reference = 'shape' or 'distances'")
    times = [at.time for at in through if at.time is not None]
    if not times or not m.is_valid(("phases", k), "through"):
        return
    arrival = (p.steering.travel if p.steering is not None else None) or p.duration
    if len(times) < len(through):
        problem = "has points with a time and points without one"
        yield Breach("through", problem, "give all times or none", None)
    elif any(b <= a for a, b in itertools.pairwise(times)):
        yield Breach("through", "times must increase from point to point", "order them", None)
    elif p.auto_keys:
        problem = "has times, but the arrival is automatic"
        yield Breach("through", problem, "remove the times", None)
    elif isinstance(arrival, float) and times[-1] >= arrival:
        problem = f"passes its last point at {times[-1]:g} s, but arrives at {arrival:g} s"
        yield Breach("through", problem, "pass it earlier or arrive later", None)


def _automatic_time_rules(m: Draft, p: Phase, k: int) -> Breaches:
    """Times that follow from the limits have limits to follow from."""
    keys = [key for key in p.auto_keys if m.is_valid(("phases", k), key)]
    if not keys or not m.are_ways_smooth:
        return
    if not p.tracks_slots:
        problem = f"needs tracked slots to have a least time, not control '{p.control}'"
        yield Breach(keys[0], problem, "use control = 'tracking', or give a time")
    if p.duration == AUTO and not p.has_least_time:
        problem = f"a phase of kind '{p.kind}' has no least duration"
        yield Breach("duration", problem, "give a duration")
    if p.duration == AUTO and p.time_key == "travel":
        problem = "has no effect with duration = 'auto', which ends the phase at the arrival"
        yield Breach("travel", problem, "remove one of them")
    limits = m.limits
    bounded = [limits.speed, limits.acceleration, limits.jerk, limits.tilt_deg]
    limited = m.agents is None or all(math.isfinite(f) for f in m.agents.thrust_limit)
    if not limited and all(limit is None for limit in bounded) and m.is_valid((), "limits"):
        problem = "needs a limit that bounds it, and the mission has none"
        remedy = "give limits.speed, acceleration, jerk or tilt_deg, or agents.thrust_limit"
        yield Breach(keys[0], problem, remedy)


def _arrival_time_rules(m: Draft, p: Phase) -> Breaches:
    """A leg with a finite horizon has a time of arrival."""
    steering = p.steering
    if steering is None or steering.settle is None or steering.travel is not None:
        return
    if m.are_ways_smooth and p.tracks_slots:
        remedy = "give travel, or end by until or duration"
        yield Breach("settle", "a smooth way needs a time of arrival", remedy, None)
    elif m.is_valid((), "lqr"):
        for key, weights, used in (
            ("lqr", m.lqr, "position" in steering.commanded_at_arrival),
            ("lqr.attitude", m.lqr.attitude, steering.attitude_deg is not None),
        ):
            if used and weights.horizon == "finite":
                problem = f"the finite horizon of {key} needs a time of arrival"
                remedy = f"give travel, end by until or duration, or use {key}.horizon = 'infinite'"
                yield Breach("settle", problem, remedy, None)
