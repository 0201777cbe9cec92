"""What a mission will meet, found before it flies: rigidity, gains, and what is on the way.

The way is the planned reference, sampled: slots that blend, moved by the LQR flights of the virtual body.
Nothing is integrated, so this takes a fraction of a second and no compiler. Where nothing but distances leads,
the agents are taken to go straight to their slots, which is a guess: such legs are not `exact`, and what is found
on them is a note.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rigidfleet import _markup
from rigidfleet.formation import shapes
from rigidfleet.math import attitude as att
from rigidfleet.math import lqr
from rigidfleet.math import pid as gains
from rigidfleet.math import proximity as geometry
from rigidfleet.mission import Box, Establish, Ground, Mission, Phase, Reshape, as_mission
from rigidfleet.mission.disturbances import intensity
from rigidfleet.planning import solvers
from rigidfleet.planning.reference import (
    Pose,
    Situation,
    about_cm,
    align_slots,
    attach,
    goal_of,
    led_by,
    legs,
    slots_about_cm,
    slots_before,
)
from rigidfleet.rigidity import (
    Kind,
    Realisations,
    Rigidity,
    Spectrum,
    Verdict,
    analyse,
    jacobian,
    realisations,
    spectrum,
)
from rigidfleet.rigidity.spectrum import MOST as LANCZOS

Array = NDArray[np.float64]

#: Formations of up to so many agents are searched for other shapes of the same distances.
SEARCHED = 12
#: So many random starts that search has: enough for what is common, in a tenth of a second.
STARTS = 40
#: Samples of a leg: so many, or one each so many seconds, within bounds.
_SAMPLES, _STEP, _MOST = 201, 0.05, 2001
#: So much of the shortest distance may be missed: the verdict's own tolerance of a shape.
_TOLERANCE = 0.01
#: Another assignment is worth a note if it saves this share of the way, and some centimetres [m].
_WORTH, _SHORT = 0.05, 0.1
#: What a check may take, as what takes about 4 s on a usual machine: places of agents looked at on the way, work on
#: formations [s], agents' places held against obstacles, legs against obstacles, places against gaps. Counted and not
#: timed, so that a check finds the same on any machine; what is left out is said.
_PLACES, _FORMING, _HELD, _MET, _PASSED = 4_000_000, 4.0, 40_000_000, 50_000, 100_000_000
#: A leg has so many samples at least; so many obstacles are told of, the nearest, and things in one note.
_FEWEST, _NEAREST, _TOLD = 11, 20, 6
#: Beyond so many agents those near each other are found by a tree (`geometry.separation`).
_MANY = 200
#: Equations up to which rigidity, and forces at a jump, are judged by a dense decomposition.
_DENSE = 600
#: Assignments of so many agents are compared, in a second or so.
_COMPARED = 200
#: Rounding on a limit is not beyond it.
_SLACK = 1e-9
#: A steady distance from the slots beyond this is worth a note [m]: the verdict's tolerance of a waypoint.
_OFFSET = 0.1

Level = Literal["fails", "note"]


@dataclass(frozen=True)
class Remark:
    """Something that will fail, or should be known.

    `topic` is formation, gains, collision, downwash, assignment, thrust, disturbances, obstacle, geofence, speed
    or acceleration.
    """

    level: Level
    topic: str
    text: str


@dataclass(frozen=True)
class Leg:
    """The planned way of all agents through one phase.

    Attributes
    ----------
    time : (K,) [s] of the mission
    position, acceleration : (K, N, 3) [m, m/s^2]
    exact : whether the reference is followed as planned, up to control; False: a guess
    ways : where the shape changes, the agents' places (N, 3) [m] before and after, from the centre, in a frame that
        turns with them: in it they go straight, and all in step
    shapes : names of the formations before (None: none) and after
    """

    phase: str
    time: Array
    position: Array
    acceleration: Array
    exact: bool
    ways: tuple[Array, Array] | None = None
    shapes: tuple[str | None, str | None] = (None, None)

    @property
    def velocity(self) -> Array:
        """(K, N, 3) [m/s]."""
        return _rate(self.position, self.time)


@dataclass(frozen=True)
class FormationCheck:
    """One formation: its rigidity, and other shapes that its distances allow, where looked for.

    `held_by` is "slots" if they are tracked in every phase that flies it, else "distances"; `method` how its
    constraint force is solved for. A large one has a `spectrum` in place of its rigidity; one of very many is
    `skipped`.
    """

    name: str
    rigidity: Rigidity | None
    held_by: Literal["slots", "distances", "nothing"]
    realisations: Realisations | None = None
    method: solvers.Method = "dense"
    spectrum: Spectrum | None = None
    skipped: bool = False


@dataclass(frozen=True)
class GainsCheck:
    """The answer to an error of length: stability, and what it costs.

    `margin` is 2 alpha beta^2 / gamma (above 1: stable), `settling_time` [s] to 2 %, `overshoot` a fraction, `force`
    [N] per metre of error of one distance, at most, by formation.
    """

    stabilised: bool
    margin: float
    settling_time: float | None
    overshoot: float | None
    force: dict[str, float]


@dataclass(frozen=True)
class Assignment:
    """How agents get to slots: total way [m], and least room between them meanwhile [m].

    `order[i]` is the slot that agent i takes, both from 0.
    """

    order: tuple[int, ...]
    way: float
    room: float


@dataclass(frozen=True)
class Disturbed:
    """What the mission's disturbances cost, beside the planned way.

    Attributes
    ----------
    air : greatest force of the steady wind on a vehicle at rest [N]
    gusts : three standard deviations of the gusts' force [N]
    weight : greatest weight that is not believed in [N]
    noise : three standard deviations of the thrust that noise asks for where slots are tracked [N]
    thrust : all of it on the planned way: [N], when [s], who, limit [N]
    offset : greatest steady distance from a tracked slot [m], and whose
    lost : who is lost, and when [s]
    """

    air: float
    gusts: float
    weight: float
    noise: float
    thrust: tuple[float, float, str, float]
    offset: tuple[float, str]
    lost: tuple[tuple[int, float], ...]


@dataclass
class Preflight:
    """What `check` has found of a mission before it flies; `remarks` say what of it matters.

    >>> import rigidfleet as rf
    >>> ahead = rf.check("narrow-passage")
    >>> ahead.passed
    True
    >>> for heading, fact in ahead.words():
    ...     print(heading, fact)
    """

    formations: list[FormationCheck]
    gains: GainsCheck
    legs: list[Leg]
    room: tuple[float, float, str] | None = None  # [m], when [s], who
    thrust: tuple[float, float, str, float] | None = None  # [N], when, who, limit
    clearance: list[tuple[str, float, float, str]] = field(default_factory=list)
    gaps: list[tuple[str, float, float, float]] = field(default_factory=list)
    assignments: dict[str, Assignment] = field(default_factory=dict)
    disturbed: Disturbed | None = None
    judged_to: float = math.inf
    remarks: list[Remark] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether nothing was found that will fail."""
        return all(remark.level != "fails" for remark in self.remarks)

    def __repr__(self) -> str:
        fails = sum(remark.level == "fails" for remark in self.remarks)
        notes = len(self.remarks) - fails
        verdict = f"{fails} will fail" if fails else "nothing found that will fail"
        return f"<Preflight: {verdict}, {notes} note{'s' * (notes != 1)}>"

    def _repr_html_(self) -> str:
        """What was found as a notebook shows it: facts, then remarks."""
        rows = [*self.words(), *((remark.level, remark.text) for remark in self.remarks)]
        verdict = "nothing found that will fail" if self.passed else "it will fail as it is"
        return _markup.shown("Check", verdict, ("about", "what was found"), rows)

    def words(self) -> Iterator[tuple[str, str]]:
        """All facts, each under a heading: formations, gains, the way. `remarks` come besides."""
        for f in self.formations:
            yield f.name, _formation_words(f)
        if self.formations:
            yield "gains", _gain_words(self.gains)
        if self.room is not None:
            yield (
                "separation",
                f"{self.room[0]:.2f} m at least, {self.room[2]} at {self.room[1]:.2f} s",
            )
        if self.thrust is not None:
            force, t, who, limit = self.thrust
            of = f" of {limit:g} N" if math.isfinite(limit) else ", of no limit,"
            yield "thrust", f"{force:.1f} N{of} planned for {who} at {t:.2f} s"
        if self.disturbed is not None:
            yield "disturbances", _disturbed_words(self.disturbed)
        for name, room, t, who in self.clearance:
            yield "clearance", f"{room:.2f} m to '{name}', {who} at {t:.2f} s"
        for between, wide, takes, t in self.gaps:
            text = f"{between}: {wide:.2f} m wide, the formation takes {takes:.2f} m at {t:.2f} s"
            yield "gap", text
        if len(self.assignments) > 1:
            told = [
                f"{name} {a.way:.1f} m, room {a.room:.2f} m" for name, a in self.assignments.items()
            ]
            yield "assignment", f"way in all and least room: {'; '.join(told)}"
        guessed = [leg.phase for leg in self.legs if not leg.exact]
        if guessed:
            names = ", ".join(f"'{name}'" for name in guessed)
            yield "guessed", f"straight ways in {names}, where nothing but distances leads"

    def data(self) -> dict[str, Any]:
        """Plain data for JSON, agents and slots counted from 1."""
        g = self.gains
        return {
            "passed": self.passed,
            "remarks": [vars(remark) for remark in self.remarks],
            "formations": {
                f.name: {
                    "held_by": f.held_by,
                    "rigidity": None if f.rigidity is None else f.rigidity.data(),
                    "realisations": None if f.realisations is None else f.realisations.data(),
                    "solve": f.method,
                    "spectrum": None if f.spectrum is None else _spectral_data(f.spectrum),
                }
                for f in self.formations
            },
            "gains": {
                "stabilised": g.stabilised,
                "margin": g.margin if math.isfinite(g.margin) else None,
                "settling_time_s": g.settling_time,
                "overshoot": g.overshoot,
                "force_per_error_n_m": g.force,
            },
            "disturbances": None
            if (d := self.disturbed) is None
            else {
                "air_n": d.air,
                "gusts_n": d.gusts,
                "weight_n": d.weight,
                "noise_n": d.noise,
                "thrust": _named(("thrust_n", "time_s", "who", "limit_n"), d.thrust),
                "offset": _named(("offset_m", "who"), d.offset),
                "lost": [_named(("agent", "time_s"), (i + 1, t)) for i, t in d.lost],
            },
            "way": {
                "judged_to_s": self.judged_to if math.isfinite(self.judged_to) else None,
                "guessed_phases": [leg.phase for leg in self.legs if not leg.exact],
                "separation": _named(("room_m", "time_s", "who"), self.room),
                "thrust": _named(("thrust_n", "time_s", "who", "limit_n"), self.thrust),
                "clearance": [
                    _named(("obstacle", "room_m", "time_s", "who"), c) for c in self.clearance
                ],
                "gaps": [_named(("between", "wide_m", "takes_m", "time_s"), g) for g in self.gaps],
                "assignments": {
                    name: {"order": [s + 1 for s in a.order], "way_m": a.way, "room_m": a.room}
                    for name, a in self.assignments.items()
                },
            },
        }


def check(
    mission: Mission | str | Path,
    *,
    search: bool | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Preflight:
    """Find what a mission will meet, before it flies; `rigidfleet check` prints it.

    Parameters
    ----------
    mission : a shipped name, a path or a `Mission`
    search : for other shapes with the same distances, `STARTS` random starts a formation; default: for up to
        `SEARCHED` agents
    progress : called with what is looked at next, in words
    """
    mission = as_mission(mission)
    search = mission.n_agents <= SEARCHED if search is None else search
    formations = _formations(mission, search=search, progress=progress)
    progress("the way")
    way, known = planned(mission)
    found = Preflight(formations, _gains(mission, formations), way)
    if not known:
        found.judged_to = float(way[-1].time[-1]) if way else 0.0
    progress("what is on the way")
    found.remarks = [
        *_formation_remarks(mission, formations),
        *_gain_remarks(mission, found),
        *_separation(mission, found),
        *_below(mission, found),
        *_assigned(mission, found),
        *_thrust(mission, found),
        *_disturbed(mission, found),
        *_obstacles(mission, found),
        *_limits(mission, found),
    ]
    if not known:
        why = "what follows is led by distances that fix no places before it flies"
        if len(way) < len(mission.phases) and _samples_of(mission) < _FEWEST:
            why = "so many agents in so many phases take too long to look at"
        text = f"the way is judged to {found.judged_to:g} s: {why}"
        found.remarks.append(Remark("note", "way", text))
    return found


# -- formations --------------------------------------------------------------------------------------


def _formations(
    mission: Mission, *, search: bool, progress: Callable[[str], None]
) -> list[FormationCheck]:
    """All formations in their order; those flown are judged first, as far as time goes."""
    held = {name: _held_by(mission, name) for name in mission.formations}
    left, found = _FORMING, {}
    for k, name in enumerate(sorted(held, key=lambda name: held[name] == "nothing"), start=1):
        progress(f"formation '{name}', {k} of {len(held)}")
        work = _work(mission, name, search=search)
        if k > 1 and work > left:
            edges = mission.formation_edges(name)
            method = solvers.choose(mission.n_agents, edges, mission.constraint.solver)
            found[name] = FormationCheck(name, None, held[name], method=method, skipped=True)
        else:
            left -= work
            found[name] = _formation(mission, name, held[name], search=search)
    return [found[name] for name in mission.formations]


def _work(mission: Mission, name: str, *, search: bool) -> float:
    """About how long it takes to judge a formation [s]."""
    n, m = mission.n_agents, len(mission.formation_edges(name))
    if min(m, 3 * n) > _DENSE:
        return 5e-4 * n if n <= LANCZOS else 0.0
    return 0.1 * search + 5e-10 * min(m, 3 * n) ** 2 * max(m, 3 * n) + 2e-3


def _formation(
    mission: Mission, name: str, held: Literal["slots", "distances", "nothing"], *, search: bool
) -> FormationCheck:
    slots, edges = mission.formation_slots(name), mission.formation_edges(name)
    method = solvers.choose(mission.n_agents, edges, mission.constraint.solver)
    if slots is None or not len(edges):
        return FormationCheck(name, None, held, method=method)
    if min(len(edges), 3 * mission.n_agents) > _DENSE:
        ends = spectrum(slots, edges, mission.agents.mass) if len(slots) <= LANCZOS else None
        return FormationCheck(name, None, held, method=method, spectrum=ends)
    rigidity = analyse(slots, edges, masses=mission.agents.mass)
    endless = rigidity.verdict is Verdict.FLEXIBLE  # a continuum of other shapes
    if not search or endless or _contradiction(mission, name) is not None:
        return FormationCheck(name, rigidity, held, method=method)
    start = mission.agents.position
    others = realisations(slots, edges, starts=STARTS, start=start)
    return FormationCheck(name, rigidity, held, others, method)


def _held_by(mission: Mission, name: str) -> Literal["slots", "distances", "nothing"]:
    """By what a formation is held in the phases that fly it."""
    now, controls = None, set()
    for phase in mission.phases:
        now = phase.formation if isinstance(phase, Establish | Reshape) else now
        controls |= {phase.control} if now == name else set()
    if not controls:
        return "nothing"
    return "slots" if controls == {"slots"} else "distances"


def _contradiction(mission: Mission, name: str) -> tuple[int, float] | None:
    """Edge whose given distance is farthest from that of the slots, and by how much [m], if by much."""
    slots, edges = mission.formation_slots(name), mission.formation_edges(name)
    if slots is None or not len(edges):
        return None
    given = mission.formation_distances(name)
    error = np.abs(shapes.distances(slots, edges) - given)
    worst = int(error.argmax())
    return (worst, float(error[worst])) if error[worst] > _TOLERANCE * given.min() else None


def _formation_remarks(mission: Mission, formations: list[FormationCheck]) -> Iterator[Remark]:
    exact = mission.constraint.solver == "exact"
    if skipped := [f.name for f in formations if f.skipped]:
        text = f"so many formations take too long to judge: {_some(skipped)} passed over"
        yield Remark("note", "formation", text)
    if idle := [f.name for f in formations if f.held_by == "nothing"]:
        yield Remark("note", "formation", f"{_some(idle)} flown in no phase")
    for f in formations:
        if f.held_by == "nothing":
            continue
        alone = f.held_by == "distances"
        if (off := _contradiction(mission, f.name)) is not None:
            i, j = mission.formation_edges(f.name)[off[0]] + 1
            given = mission.formation_distances(f.name)[off[0]]
            text = (
                f"'{f.name}' will be another shape than its slots: agents {i} and {j} are to be {given:.4g} m"
                f" apart, their slots are {off[1]:.3g} m off that"
            )
            yield Remark("fails", "formation", text)
        r = f.rigidity
        if f.spectrum is not None:
            if f.spectrum.free:
                text = f"'{f.name}' is flexible to first order: {f.spectrum.free} motions or more are free"
                held = ". Add edges, or track slots" if alone else "; slots hold it"
                yield Remark("fails" if alone else "note", "formation", text + held)
            continue
        if r is None and mission.formation_slots(f.name) is not None:
            continue  # too large to judge
        if r is None:
            if len(mission.formation_edges(f.name)):
                text = f"'{f.name}' has distances that fix no places: its rigidity is not judged"
                yield Remark("note", "formation", text)
            continue
        if r.verdict is Verdict.FLEXIBLE:
            who = "; ".join(_agents(flex.agents) for flex in r.flexes[:4])
            more = f" and {len(r.flexes) - 4} more" if len(r.flexes) > 4 else ""
            text = f"'{f.name}' is flexible: {r.rank} independent distances, {r.needed} hold it; free: {who}{more}"
            held = ". Add edges (rigidfleet design), or track slots" if alone else "; slots hold it"
            yield Remark("fails" if alone else "note", "formation", text + held)
        elif r.verdict is Verdict.UNDECIDED and alone:
            yield Remark("note", "formation", f"'{f.name}' is undecided: {r.reason}")
        elif r.verdict is Verdict.PRESTRESS_STABLE and alone:
            where = "line" if r.dimension == 1 else "plane"
            text = f"'{f.name}' is held softly"
            text += f" across its {where}" if r.dimension < 3 else ""
            yield Remark("note", "formation", f"{text}, by self-stress; slots would hold it firmly")
        if exact and alone and len(r.edges) > r.rank:
            text = (
                f"solver 'exact' has no solution at '{f.name}': {r.rank} of its {len(r.edges)} distances are"
                " independent there. Use solver = 'iterated'"
            )
            yield Remark("fails", "formation", text)
        yield from _other_shapes(mission, f, alone=alone)


def _other_shapes(mission: Mission, f: FormationCheck, *, alone: bool) -> Iterator[Remark]:
    """Shapes with the same distances, where distances alone lead to one."""
    others = f.realisations
    if others is None or not alone:
        return
    start, slots = np.array(mission.agents.position), mission.formation_slots(f.name)
    first, by = mission.phases[0], None
    if isinstance(first, Establish) and first.formation == f.name:
        by = led_by(mission, first, start, slots)
    end = None if others.leads_to is None else others.found[others.leads_to].kind
    if by == "shape" and slots is not None and _flattens(start, slots):
        text = (
            f"four agents start on the other side of the mirror of '{f.name}' and pass through one plane on their way,"
            " where distances alone may turn them back, to its mirror image. Exchange two slots, or track slots"
        )
        yield Remark("note", "formation", text)
    elif by in ("squares", "step") and end not in (None, Kind.SAME):
        text = (
            f"from the start, the distances of '{f.name}' lead to a shape that is {end}, not to it"
        )
        yield Remark("note", "formation", text)
    elif not others.unique:
        n = sum(r.kind not in (Kind.SAME, Kind.MIRRORED) for r in others.found)
        share = sum(r.found for r in others.found if r.kind not in (Kind.SAME, Kind.MIRRORED))
        what = "another shape has" if n == 1 else f"{n} other shapes have"
        text = (
            f"{what} the distances of '{f.name}'; {share} of {others.starts} random starts ended there."
            " Redundant edges or slots rule them out"
        )
        yield Remark("note", "formation", text)


def _flattens(start: Array, slots: Array) -> bool:
    """Whether four agents are all in one plane on the way from a start to slots in space (4, 3)."""
    if len(slots) != 4 or shapes.dimension(slots) < 3:
        return False
    return bool(np.linalg.det((start[1:] - start[0]).T @ (slots[1:] - slots[0])) < 0)


# -- gains -------------------------------------------------------------------------------------------


def _gains(mission: Mission, formations: list[FormationCheck]) -> GainsCheck:
    c = mission.constraint
    stabilised = c.stabilisation == "pid"
    alpha, beta, gamma = (c.alpha, c.beta, c.gamma) if stabilised else (0.0, 0.0, 0.0)
    settling = over = None
    if stabilised:
        try:
            settling = gains.settling_time(alpha, beta, gamma)
            over = gains.overshoot(alpha, beta, gamma)
        except ValueError:
            pass  # it rings for a thousand cycles: said in a remark
    mass = float(np.mean(mission.agents.mass))
    force = {
        f.name: f.rigidity.force(beta**2, mass)
        for f in formations
        if f.rigidity is not None and f.rigidity.rank
    }
    margin = 2 * alpha * beta**2 / gamma if gamma > 0 else math.inf
    return GainsCheck(stabilised, margin, settling, over, force)


def _gain_remarks(mission: Mission, found: Preflight) -> Iterator[Remark]:
    g, phases = found.gains, mission.phases
    if all(phase.control == "slots" for phase in phases) or not len(mission.edges):
        return
    if not g.stabilised:
        yield from _drift(mission)
    elif g.settling_time is None:
        yield Remark("note", "gains", "the gains ring for more than a thousand cycles: raise alpha")
    elif g.settling_time > max(b - a for a, b in _spans(mission)):
        text = (
            f"errors of length take {g.settling_time:.3g} s to settle, longer than any phase lasts"
        )
        yield Remark("note", "gains", text)


def _drift(mission: Mission) -> Iterator[Remark]:
    """Without feedback an error of length goes on at the rate that it has."""
    text = "no feedback (stabilisation = 'none'): errors of length stay, and grow at their rates"
    first = mission.phases[0]
    if not isinstance(first, Establish):
        yield Remark("note", "gains", text)
        return
    r, v = np.array(mission.agents.position), np.array(mission.agents.velocity)
    edges, d = (
        mission.formation_edges(first.formation),
        mission.formation_distances(first.formation),
    )
    i, j = edges.T
    x = r[i] - r[j]
    L = np.linalg.norm(x, axis=1)
    c_dot = ((v[i] - v[j]) * x).sum(axis=1) / L
    end = _spans(mission)[0][1]
    error = np.abs(L - d) if first.reference == "step" else np.abs(c_dot) * first.blend / 2
    error = np.abs(np.where(first.reference == "step", L - d + c_dot * end, error))
    fails = error.max() > _TOLERANCE * d.min()
    text += f"; by {end:g} s they reach {error.max():.2g} m"
    yield Remark("fails" if fails else "note", "gains", text)


# -- the way -----------------------------------------------------------------------------------------


def planned(mission: Mission, phases: int | None = None) -> tuple[list[Leg], bool]:
    """The way of all agents, a leg for each phase or so many, and whether it is known to its end."""
    masses = np.array(mission.agents.mass)
    frame = None if mission.body_frame is None else mission.drawn_attitude
    now = Situation(
        0.0, np.array(mission.agents.position), np.array(mission.agents.velocity), frame=frame
    )
    way: list[Leg] = []
    most = _samples_of(mission)
    # Of more than can be looked at with the fewest samples, the first ones.
    possible = len(mission.phases) if most >= _FEWEST else most * len(mission.phases) // _FEWEST
    most = max(most, _FEWEST)
    for phase, (begin, end) in list(zip(mission.phases, _spans(mission), strict=True))[:phases]:
        if len(way) == possible:
            return way, False
        name = phase.formation if isinstance(phase, Establish | Reshape) else now.formation
        target = slots_about_cm(mission, name, masses)
        if isinstance(phase, Establish | Reshape) and target is None:
            return way, False
        now = replace(now, t=begin)
        before = now.slots if now.slots is not None else now.r
        count = min(max(_SAMPLES, int((end - begin) / _STEP) + 1), _MOST, most)
        time = np.linspace(begin, end, count)
        names = now.formation, name
        position, ways, now = _leg(mission, phase, now, masses, target, time)
        guess = (
            isinstance(phase, Establish | Reshape)
            and phase.control != "slots"
            # A shape that forces alone hold may lag behind its slots.
            and (phase.control == "body" or led_by(mission, phase, before, target) != "shape")
        )
        acceleration = _rate(_rate(position, time), time)
        way.append(Leg(phase.name, time, position, acceleration, not guess, ways, names))
    return way, True


def _samples_of(mission: Mission) -> int:
    """Samples of each leg that can be looked at: below `_MANY` agents each is held against each."""
    n = mission.n_agents
    each = n * max(1.0, n / 25) if n <= _MANY else n
    return int(_PLACES / each) // len(mission.phases)


def _leg(
    mission: Mission,
    phase: Phase,
    now: Situation,
    masses: Array,
    target: Array | None,
    time: Array,
) -> tuple[Array, tuple[Array, Array] | None, Situation]:
    """Positions (K, N, 3) of all agents over a phase, their `Leg.ways`, and the situation at its end."""
    t0, t_end = time[0], time[-1]
    shaping = isinstance(phase, Establish | Reshape)
    frame, now, turned = attach(mission, phase, now, masses, target)
    s = _septic((time - t0) / phase.blend) if shaping else np.zeros(len(time))
    if phase.control == "open":
        x = about_cm(now.r, masses)
        after = x
        if shaping and target is not None:
            # Turned as the blend has it, and with that as the agents lie.
            slots = slots_before(mission, now, masses)
            after = target @ turned.T @ shapes.kabsch(x, slots, masses).T
        cm, v = masses @ now.r / masses.sum(), masses @ now.v / masses.sum()
        a = np.array(phase.input_force) * len(masses) / masses.sum()
        tau = (time - t0)[:, None]
        ways = x, after
        shape = x + s[:, None, None] * (after - x)
        position = shape + (cm + tau * v + 0.5 * tau**2 * a)[:, None]
        v_end = np.tile(v + a * (t_end - t0), (len(masses), 1))
        slots = target if shaping else now.slots
        now = replace(now, r=position[-1], v=v_end, slots=slots, pose=None, frame=frame)
    else:
        assert now.pose is not None  # attached above
        assert now.slots is not None
        goal, arrival = goal_of(phase, now, t_end)
        assert goal is not None
        r, T, v_cm, omega = _body(mission, now.pose, goal, arrival, time)
        before = now.slots
        after = target if shaping and target is not None else before
        dp, turn = 0.0 * before, np.zeros(3)
        if shaping:
            dp, turn = align_slots(before, after, masses, turned)
        ways = before, before + dp
        p = before + s[:, None, None] * dp
        p = p @ att.dcm_from_rotation_vector(s[:, None] * turn)
        position = r[:, None] + p @ T
        pose = Pose(r[-1], v_cm, T[-1], omega)
        velocity = v_cm + np.cross(omega, after) @ T[-1]
        tracked = pose if phase.control == "slots" else None
        frame = T[-1] if frame is not None else None
        now = replace(
            now, r=position[-1], v=velocity, slots=after, pose=tracked, goal=goal, frame=frame
        )
    name = phase.formation if isinstance(phase, Establish | Reshape) else now.formation
    return position, ways if shaping else None, replace(now, t=t_end, formation=name)


def _body(
    mission: Mission, start: Pose, goal: Pose, arrival: float, time: Array
) -> tuple[Array, Array, Array, Array]:
    """CM (K, 3) [m], attitude T (K, 3, 3) of the virtual body, and its velocities [m/s, rad/s] at the end."""
    t0, rest = time[0], time[-1] - arrival
    flights = legs(mission, start, goal, arrival - t0)
    under_way = time <= arrival
    found = []
    for i in range(2):
        x, rate, _ = flights.sample(i, np.append(time[under_way] - t0, arrival - t0))
        x_end = (x[-1], rate[-1])
        x = x[:-1]
        if rest > 0.0 and not under_way.all():
            after = flights.sample_rest(mission, i, x_end, rest, time[~under_way] - arrival)
            x, rate = np.concatenate([x, after[0]]), after[1]
        found.append((x, rate[-1]))
    (r, v), (phi, phi_dot) = found
    # Where phi is small at the end, its rate is the body's.
    return r, att.dcm_from_rotation_vector(phi) @ goal.T, v, phi_dot


def _spans(mission: Mission) -> list[tuple[float, float]]:
    """Start and end [s] of each phase; what ends by settling is taken to settle soon, at most at its timeout."""
    t, spans = 0.0, []
    settling = _settling(mission)
    for phase in mission.phases:
        begin = t
        if phase.until is not None:
            t = phase.until
        elif phase.duration is not None:
            t = begin + phase.duration
        elif phase.settle is not None:
            least = max(getattr(phase, "blend", 0.0), getattr(phase, "travel", None) or 0.0)
            t = begin + min(phase.settle.timeout, least + settling + phase.settle.dwell)
        spans.append((begin, max(t, begin + 1e-6)))
        t = spans[-1][1]
    return spans


def _settling(mission: Mission) -> float:
    c = mission.constraint
    if c.stabilisation == "none":
        return 0.0
    try:
        return gains.settling_time(c.alpha, c.beta, c.gamma)
    except ValueError:
        return 0.0


def _septic(x: Array) -> Array:
    """The blend of slots over x = (t - t0) / T_b, as the kernel's references have it."""
    x = np.clip(x, 0.0, 1.0)
    return x**4 * (35.0 - x * (84.0 - x * (70.0 - 20.0 * x)))


def _rate(x: Array, time: Array) -> Array:
    return np.gradient(x, time, axis=0, edge_order=2)


# -- on the way --------------------------------------------------------------------------------------


def _separation(mission: Mission, found: Preflight) -> Iterator[Remark]:
    """Room between vehicles: where it is least, and each change of formation on which ways cross."""
    if mission.n_agents < 2:
        return
    radius, limit = np.array(mission.agents.radius), mission.limits.separation or 0.0
    worst: dict[bool, tuple[float, float, tuple[int, ...], str]] = {}
    least = np.inf, 0.0, (0, 0)
    for number, leg in enumerate(found.legs):
        ends: list[tuple[float, float, tuple[int, ...]]] = []
        positions = leg.position if leg.ways is None else np.array(leg.ways)
        rooms, pairs = geometry.separation(positions, radius)
        for k in [int(rooms.argmin())] if leg.ways is None else [0, -1]:
            ends.append((float(rooms[k]), float(leg.time[k]), tuple(pairs[k].tolist())))
        if leg.ways is not None:
            room, who, share = shapes.nearest_way(*leg.ways, radius)
            crossing = room, _time_of(mission, leg, number, share), who
            least = min(least, crossing)
            beyond = room <= 0 or room < limit - _SLACK
            if beyond and room < min(ends)[0] - _SLACK:
                yield _crossing(mission, number, leg, crossing, limit)
        for k, at in enumerate(ends):
            least = min(least, at)
            # Where agents start is known, whatever leads them from there.
            exact = leg.exact or (number == 0 and k == 0 and leg.ways is not None)
            if exact not in worst or at[0] < worst[exact][0]:
                worst[exact] = *at, leg.phase
    if np.isfinite(least[0]):
        found.room = least[0], least[1], _agents(least[2])
    for exact, (room, t, who, phase) in worst.items():
        if room <= 0 or room < limit - _SLACK:
            text = _near(who, room, t, phase, limit, exact=exact)
            guess = "" if exact else "; distances lead there, and the way is a guess"
            yield Remark("fails" if exact else "note", "collision", text + guess)


def _near(
    who: tuple[int, ...], room: float, t: float, phase: str, limit: float, *, exact: bool
) -> str:
    if room <= 0:
        return f"{_agents(who)} {'' if exact else 'may '}collide at {t:.2f} s, in '{phase}'"
    return f"{_agents(who)} come within {room:.2f} m at {t:.2f} s, in '{phase}' (limit {limit:g} m)"


def _time_of(mission: Mission, leg: Leg, number: int, share: float) -> float:
    """When [s] agents have gone this share of their ways."""
    blend = getattr(mission.phases[number], "blend", 0.0)
    tau = np.linspace(0.0, 1.0, 2001)
    return float(leg.time[0] + blend * np.interp(share, _septic(tau), tau))


def _crossing(
    mission: Mission, number: int, leg: Leg, at: tuple[float, float, tuple[int, ...]], limit: float
) -> Remark:
    """Agents whose straight ways from one formation to the next bring them too near."""
    (room, t, who), (before, after) = at, leg.shapes
    needed = sum(mission.agents.radius[i] for i in who) + limit
    origin = "the start" if before is None else f"'{before}'"
    text = (
        f"{_near(who, room, t, leg.phase, limit, exact=leg.exact)}: their ways from {origin} to '{after}' cross,"
        f" {max(0.0, room + needed - limit):.2f} m from centre to centre. "
    )
    assert after is not None  # something is shaped
    assert leg.ways is not None
    apart = min(float(shapes.nearest(places).min()) for places in leg.ways)
    flown = [p.formation for p in mission.phases[:number] if isinstance(p, Establish | Reshape)]
    spaced = f"keep slots {math.sqrt(2) * needed:.2f} m apart or more (here {apart:.2f} m)"
    promised = mission.assigned_turn(before, after) is not None
    if promised:
        text += f"{spaced[0].upper()}{spaced[1:]}"
    elif mission.assignment == "each" and after in flown:
        text += (
            f"Its slots were assigned on another way: give '{after}' a second table [formations.NAME], to be assigned"
            " on this one"
        )
    else:
        text += 'Assign slots to those who are near: assignment = "each"'
    if not promised and apart < math.sqrt(2) * needed:
        text += f"; and {spaced}"
    guess = "" if leg.exact else ". Distances lead there, and the way is a guess"
    return Remark("fails" if leg.exact else "note", "collision", text + guess)


def _below(mission: Mission, found: Preflight) -> Iterator[Remark]:
    """One vehicle in the downwash of another."""
    radius, limit = np.array(mission.agents.radius), mission.limits.separation_below
    worst: dict[bool, tuple[float, float, tuple[int, ...], str]] = {}
    for leg in found.legs:
        room, pair = geometry.headroom(leg.position, radius)
        k = int(room.argmin())
        if room[k] < worst.get(leg.exact, (np.inf,))[0]:
            low, high = sorted(pair[k].tolist(), key=lambda i: leg.position[k, i, 2])
            worst[leg.exact] = float(room[k]), float(leg.time[k]), (low, high), leg.phase
    for exact, (room, t, (low, high), phase) in worst.items():
        text = f"agent {low + 1} is below agent {high + 1}, {max(room, 0.0):.2f} m from it at {t:.2f} s, in '{phase}'"
        if limit is None:
            yield Remark("note", "downwash", text)
        elif room < limit - _SLACK:
            text += f" (limit {limit:g} m)"
            yield Remark("fails" if exact else "note", "downwash", text)


def _thrust(mission: Mission, found: Preflight) -> Iterator[Remark]:
    masses, limits = np.array(mission.agents.mass), np.array(mission.agents.thrust_limit)
    weight = np.array([0.0, 0.0, mission.gravity])
    best: tuple[float, float, str, float, str, bool] | None = None
    for leg in found.legs:
        force = masses * np.linalg.norm(leg.acceleration + weight, axis=2)
        over = force - limits if np.isfinite(limits).any() else force
        k, i = np.unravel_index(int(over.argmax()), over.shape)
        share = force[k, i] - (limits[i] if math.isfinite(limits[i]) else 0.0)
        at = (float(force[k, i]), float(leg.time[k]), f"agent {i + 1}", float(limits[i]))
        if best is None or share > best[0] - (best[3] if math.isfinite(best[3]) else 0.0):
            best = (*at, leg.phase, leg.exact)
    if best is not None:
        found.thrust = best[:4]
        force, t, who, limit, phase, exact = best
        if force > limit * (1 + 1e-3):
            text = f"{who} needs {force:.1f} N at {t:.2f} s, in '{phase}', and has {limit:g} N"
            yield Remark("fails" if exact else "note", "thrust", text)
    yield from _step_thrust(mission, found)


def _disturbed(mission: Mission, found: Preflight) -> Iterator[Remark]:
    """What wind, gusts, noise and wrong masses ask for, as far as it follows from the planned way."""
    d = mission.disturbances
    if d is None or not found.legs:
        return
    believed, true, drag = np.array(mission.agents.mass), mission.true_mass, mission.drag
    wind, up = np.array(d.wind), np.array([0.0, 0.0, 1.0])
    g, speed = mission.gravity, float(np.linalg.norm(d.wind))
    k1, k2 = lqr.double_integrator_gains(mission.tracking.Q, mission.tracking.R)
    sigma = 0.0 if d.gusts is None else float(intensity(d.gusts, speed).max())
    gusts = 3 * sigma * drag
    noise = np.zeros(len(believed))
    if d.noise is not None:
        noise = 3 * believed * math.hypot(k1 * d.noise.position, k2 * d.noise.velocity)
    limits = np.array(mission.agents.thrust_limit)
    worst, most = -math.inf, (0.0, 0.0, "", math.inf)
    for leg in found.legs:
        force = true[:, None] * (leg.acceleration + g * up)
        force -= drag[:, None] * (wind - leg.velocity)
        need = np.linalg.norm(force, axis=2) + gusts + noise
        over = need - np.where(np.isfinite(limits), limits, 0.0)
        k, i = np.unravel_index(int(over.argmax()), over.shape)
        if over[k, i] > worst:
            worst = float(over[k, i])
            most = float(need[k, i]), float(leg.time[k]), f"agent {i + 1}", float(limits[i])
    steady = drag[:, None] * wind - ((true - believed) * g)[:, None] * up
    off = np.linalg.norm(steady, axis=1) / (k1 * believed)
    far = int(off.argmax())
    lost = tuple((lost.agent - 1, lost.time) for lost in d.lost)
    found.disturbed = Disturbed(
        float((drag * speed).max()), float(gusts.max()), float((np.abs(true - believed) * g).max()),
        float(noise.max()), most, (float(off[far]), f"agent {far + 1}"), lost,
    )  # fmt: skip
    if most[0] > most[3]:
        text = f"disturbed, {most[2]} may need {most[0]:.1f} N at {most[1]:.2f} s, and has {most[3]:g} N"
        yield Remark("note", "thrust", text)
    if off[far] > _OFFSET and any(phase.control == "slots" for phase in mission.phases):
        text = (
            f"what is steady in the disturbances holds agent {far + 1} {off[far]:.2f} m off its slot, as tracking"
            f" has no integral; a greater first weight in tracking.Q shortens it (now {mission.tracking.Q[0]:g})"
        )
        yield Remark("note", "disturbances", text)
    if lost:
        text = f"the way is judged as if {_agents(tuple(i for i, _ in lost))} flew on to its end"
        yield Remark("note", "disturbances", text)


def _disturbed_words(d: Disturbed) -> str:
    parts = [
        f"{what} up to {force:.2g} N"
        for what, force in (
            ("steady wind", d.air), ("gusts (3 sigma)", d.gusts), ("weight not believed in", d.weight),
            ("noise (3 sigma)", d.noise),
        )
        if force > 0
    ]  # fmt: skip
    force, t, who, limit = d.thrust
    of = f" of {limit:g} N" if math.isfinite(limit) else ""
    parts.append(f"with them {force:.1f} N of thrust{of} for {who} at {t:.2f} s")
    if d.offset[0] > 0:
        parts.append(f"steady offset from slots up to {d.offset[0]:.2g} m, {d.offset[1]}")
    parts += [f"agent {i + 1} is lost at {t:g} s" for i, t in d.lost]
    return "; ".join(parts)


def _step_thrust(mission: Mission, found: Preflight) -> Iterator[Remark]:
    """Forces that references ask for which jump: J M^-1 J^T lambda = -beta^2 c at the jump."""
    c, masses = mission.constraint, np.array(mission.agents.mass)
    if c.stabilisation == "none":
        return
    limits = np.array(mission.agents.thrust_limit)
    starts = [np.array(mission.agents.position), *(leg.position[-1] for leg in found.legs)]
    for phase, r in zip(mission.phases, starts, strict=False):
        if not (isinstance(phase, Establish | Reshape) and phase.reference == "step"):
            continue
        edges = mission.formation_edges(phase.formation)
        if min(len(edges), 3 * mission.n_agents) > _DENSE:
            continue
        error = shapes.distances(r, edges) - mission.formation_distances(phase.formation)
        J = jacobian(r, edges)
        root = np.repeat(1 / np.sqrt(masses), 3)
        f = np.linalg.lstsq(J * root, -(c.beta**2) * error, rcond=1e-7)[0] / root
        f = f.reshape(-1, 3) + masses[:, None] * [0.0, 0.0, mission.gravity]
        need = np.linalg.norm(f, axis=1)
        i = int((need - np.where(np.isfinite(limits), limits, 0.0)).argmax())
        if need[i] > limits[i]:
            text = (
                f"the step to '{phase.formation}' in '{phase.name}' asks agent {i + 1} for {need[i]:.0f} N, and it has"
                f" {limits[i]:g} N. Blend: reference = 'shape' or 'distances'"
            )
            yield Remark("fails" if c.solver in ("exact", "pinv") else "note", "thrust", text)


def _obstacles(mission: Mission, found: Preflight) -> Iterator[Remark]:
    """Room to each obstacle; of many, to all that may be touched and to the nearest."""
    radius, way = np.array(mission.agents.radius), found.legs
    if not (mission.obstacles and way):
        return
    # What a leg stays within, and how far that is from each obstacle (L, B): nobody is nearer.
    within = np.array(
        [[leg.position.min(axis=(0, 1)), leg.position.max(axis=(0, 1))] for leg in way]
    )
    far = np.stack([_beyond(within, thing) for thing in mission.obstacles], axis=1) - radius.max()
    held, met, skipped = 0, 0, []
    near = np.argsort(far.min(axis=0), kind="stable")
    shown: dict[int, tuple[float, float, int, str]] = {}
    remarks: dict[int, list[Remark]] = {}
    for rank, b in enumerate(near.tolist()):
        thing = mission.obstacles[b]
        if rank >= _NEAREST and far[:, b].min() > 0:
            break
        worst: dict[bool, tuple[float, float, int, str]] = {}
        for k in np.argsort(far[:, b], kind="stable").tolist():
            leg = way[k]
            if far[k, b] >= worst.get(leg.exact, (np.inf,))[0]:
                continue
            held, met = held + leg.position[:, :, 0].size, met + 1
            if held > _HELD or met > _MET:
                break
            room, agent, _ = geometry.clearance(leg.position, radius, [thing])
            at = int(room.argmin())
            # Of as near ones the first: rounding and a rest's last millimetre count for nothing.
            if room[at] < worst.get(leg.exact, (np.inf,))[0] - 1e-3:
                worst[leg.exact] = float(room[at]), float(leg.time[at]), int(agent[at]), leg.phase
        if held > _HELD or met > _MET:
            skipped = near[rank:][far[:, near[rank:]].min(axis=0) <= 0].tolist()
            break
        if worst:
            shown[b] = min(worst.values())
        for exact, (room, t, i, phase) in worst.items():
            if room <= 0:
                verb = "hits" if exact else "may hit"
                text = f"agent {i + 1} {verb} '{thing.name}' at {t:.2f} s, in '{phase}'"
                if not isinstance(thing, Box):
                    text += _too_low(mission, found, phase, thing.height)
                remark = Remark("fails" if exact else "note", "obstacle", text)
                remarks.setdefault(b, []).append(remark)
    for b in sorted(shown):
        room, t, i, _ = shown[b]
        found.clearance.append((mission.obstacles[b].name, room, t, f"agent {i + 1}"))
    for b in sorted(remarks):
        yield from remarks[b]
    if skipped:
        names = [mission.obstacles[b].name for b in sorted(skipped)]
        text = f"so many obstacles on the way take too long to look at: {_some(names)} passed over"
        yield Remark("note", "obstacle", text)
    yield from _gaps(mission, found, radius)


def _beyond(within: Array, thing: Box | Ground) -> Array:
    """How far (L,) [m] boxes (L, 2, 3), lowest and highest corners, are from an obstacle at least."""
    low, high = within[:, 0], within[:, 1]
    if isinstance(thing, Box):
        apart = np.maximum(np.maximum(low - thing.max, thing.min - high), 0.0)
        return np.linalg.norm(apart, axis=1)
    return np.maximum(low[:, 2] - thing.height, 0.0)


def _too_low(mission: Mission, found: Preflight, phase: str, ground: float) -> str:
    """Why a vehicle is at or below the ground [m] in a phase, and how high its formation is to fly."""
    leg = next(leg for leg in found.legs if leg.phase == phase)
    masses, radius = np.array(mission.agents.mass), np.array(mission.agents.radius)
    z = leg.position[..., 2]
    cm = z @ masses / masses.sum()
    k, i = np.unravel_index(int((z - radius).argmin()), z.shape)
    deep, below = ground + radius[i] - z[k, i], cm[k] - z[k, i]
    high = float((ground + radius + cm[:, None] - z)[k].max())
    return (
        f": its centre comes to z = {z[k, i]:.2f} m with a radius of {radius[i]:g} m, {deep:.2f} m too low, as its slot"
        f" is then {below:.2f} m below the centre of mass at z = {cm[k]:.2f} m. Keep the centre of mass at z ="
        f" {math.ceil(100 * high + 1e-6) / 100:.2f} m or more, or turn the formation so that its slots lie higher"
    )


def _gaps(mission: Mission, found: Preflight, radius: Array) -> Iterator[Remark]:
    """Gaps between two boxes that the formation's centre passes, and how much of each it takes.

    Of boxes on either side of the centre, seen along an axis, the nearest two make the gap.
    """
    masses = np.array(mission.agents.mass)
    boxes = [thing for thing in mission.obstacles if isinstance(thing, Box)]
    if len(boxes) < 2:
        return
    low, high = np.array([box.min for box in boxes]), np.array([box.max for box in boxes])
    least: dict[tuple[int, int, int], tuple[float, float, str]] = {}
    looked, to = 0, math.inf
    for leg in found.legs:
        looked += len(leg.time) * len(boxes)
        if looked > _PASSED:
            to = float(leg.time[0])
            break
        cm = np.einsum("i,kia->ka", masses, leg.position) / masses.sum()
        between = (cm[:, None] > low) & (cm[:, None] < high)
        for axis in range(3):
            rest = [k for k in range(3) if k != axis]
            beside = between[:, :, rest].all(axis=2)
            if not beside.any():
                continue
            at = cm[:, axis, None]
            below = np.where(beside & (high[:, axis] < at), high[:, axis], -np.inf)
            above = np.where(beside & (low[:, axis] > at), low[:, axis], np.inf)
            sides = np.column_stack([below.argmax(axis=1), above.argmin(axis=1)])
            inside = np.isfinite(below.max(axis=1)) & np.isfinite(above.min(axis=1))
            for one, two in np.unique(sides[inside], axis=0).tolist():
                when = inside & (sides == [one, two]).all(axis=1)
                along = leg.position[when][:, :, axis]
                takes = (along + radius).max(axis=1) - (along - radius).min(axis=1)
                k, key = int(takes.argmax()), (one, two, axis)
                if key not in least or takes[k] > least[key][0]:
                    least[key] = float(takes[k]), float(leg.time[when][k]), leg.phase
    for (one, two, axis), (takes, t, phase) in sorted(least.items()):
        between = f"'{boxes[one].name}' and '{boxes[two].name}'"
        wide = float(low[two, axis] - high[one, axis])
        found.gaps.append((between, wide, takes, t))
        if takes > wide:
            text = (
                f"the gap between {between} is {wide:.2f} m wide, and the formation takes {takes:.2f} m"
                f" in its attitude at {t:.2f} s, in '{phase}': turn or reshape it before"
            )
            yield Remark("fails", "obstacle", text)
    if math.isfinite(to):
        text = f"gaps between so many obstacles are looked at to {to:g} s: more would take too long"
        yield Remark("note", "obstacle", text)


def _limits(mission: Mission, found: Preflight) -> Iterator[Remark]:
    limits = mission.limits
    for leg in found.legs:
        for what, values, limit, unit in (
            ("speed", leg.velocity, limits.speed, "m/s"),
            ("acceleration", leg.acceleration, limits.acceleration, "m/s^2"),
        ):
            if limit is None:
                continue
            size = np.linalg.norm(values, axis=2)
            k, i = np.unravel_index(int(size.argmax()), size.shape)
            if size[k, i] > limit * (1 + 1e-3):
                text = (
                    f"agent {i + 1} reaches {size[k, i]:.3g} {unit} at {leg.time[k]:.2f} s, in '{leg.phase}'"
                    f" (limit {limit:g} {unit})"
                )
                yield Remark("fails" if leg.exact else "note", what, text)
        if limits.geofence is not None:
            low, high = np.array(limits.geofence.min), np.array(limits.geofence.max)
            out = np.maximum(low - leg.position, leg.position - high).max(axis=2)
            k, i = np.unravel_index(int(out.argmax()), out.shape)
            if out[k, i] > _SLACK:
                by, t = float(out[k, i]), float(leg.time[k])
                text = f"agent {i + 1} leaves the geofence by {by:.2f} m at {t:.2f} s, in '{leg.phase}'"
                yield Remark("fails" if leg.exact else "note", "geofence", text)


# -- assignment --------------------------------------------------------------------------------------


def _assigned(mission: Mission, found: Preflight) -> Iterator[Remark]:
    """Whether other agents in the slots of the first formation would be better off."""
    first = next((p for p in mission.phases if isinstance(p, Establish)), None)
    slots = mission.formation_slots(first.formation) if first is not None else None
    if first is None or slots is None or not 2 <= mission.n_agents <= _COMPARED:
        return
    index, masses = mission.phases.index(first), np.array(mission.agents.mass)
    if index >= len(found.legs):
        return
    for name in ("as it is", "shortest", "safe"):
        other, leg = mission, found.legs[index]
        if name not in ("as it is", mission.assignment):
            other = Mission.from_dict(mission.to_dict() | {"assignment": name}, mission.origin)
            leg = planned(other, index + 1)[0][index]
        assert leg.ways is not None  # it shapes
        x = leg.position - (masses @ leg.position)[:, None] / masses.sum()
        way = float(np.linalg.norm(np.diff(x, axis=0), axis=2).sum())
        room = shapes.nearest_way(*leg.ways, mission.agents.radius)[0]
        order = tuple(other.assigned_slots[first.formation].tolist())
        found.assignments[name] = Assignment(order, way, room)
    radius = np.array(mission.agents.radius)
    now, short, safe = found.assignments.values()
    if short.way < (1 - _WORTH) * now.way - _SHORT:
        text = (
            f"another assignment to slots is shorter: {short.way:.1f} m in all, not {now.way:.1f} m"
        )
        yield Remark("note", "assignment", text + ' (assignment = "shortest")')
    if safe.room > now.room + 0.05 and now.room < 2 * radius.max():
        text = f"another one is safer: {safe.room:.2f} m between agents on the way instead of {now.room:.2f} m"
        yield Remark("note", "assignment", text + ' (assignment = "safe")')


def _formation_words(f: FormationCheck) -> str:
    r = f.rigidity
    held = {"slots": "held by slots", "distances": "held by distances", "nothing": "not flown"}[
        f.held_by
    ]
    if f.spectrum is not None:
        text = f"{held}; solved by {solvers.WORDS[f.method]}"
        if f.spectrum.free:
            return f"{text}; flexible to first order, {f.spectrum.free} motions or more"
        return f"{text}; rigid, index {f.spectrum.index:.3g}, condition {f.spectrum.condition:.3g}"
    if f.skipped:
        return f"{held}; solved by {solvers.WORDS[f.method]}; passed over, not judged"
    if r is None and f.method != "dense":
        return f"{held}; solved by {solvers.WORDS[f.method]}; too large to judge its rigidity"
    if r is None:
        return f"{held}; its distances fix no places, so its rigidity is not judged"
    if f.method != "dense":
        held += f", solved by {solvers.WORDS[f.method]}"
    parts = [f"{r.verdict}, {held}: {len(r.edges)} edges, rank {r.rank} of {r.needed}"]
    if r.reachable < r.needed:
        where = "line" if r.dimension == 1 else "plane"
        parts[0] += f" ({r.reachable} reachable on a {where})"
    if len(r.redundant):
        names = ", ".join(f"{i}-{j}" for i, j in (r.edges[r.redundant][:6] + 1).tolist())
        more = ", ..." if len(r.redundant) > 6 else ""
        parts.append(f"{len(r.redundant)} edges of which any one is redundant ({names}{more})")
    if r.flexes:
        free = "; ".join(_agents(flex.agents) for flex in r.flexes[:3])
        more = f" and {len(r.flexes) - 3} more" if len(r.flexes) > 3 else ""
        parts.append(f"{len(r.flexes)} free to first order: {free}{more}")
    if r.rank:
        parts.append(
            f"index {r.index:.3g}, w {r.w:.3g}: behind 1 cm of error up to {r.offset(1.0):.3g} cm of displacement"
        )
    if f.realisations is not None:
        counts = [f"{x.kind} {x.found}" for x in f.realisations.found]
        most = f", and {len(counts) - 4} more" if len(counts) > 4 else ""
        parts.append(f"from {f.realisations.starts} random starts: {', '.join(counts[:4])}{most}")
    return "; ".join(parts)


def _spectral_data(s: Spectrum) -> dict[str, Any]:
    condition = s.condition if math.isfinite(s.condition) else None
    return {"w": s.w, "index": s.index, "condition": condition, "free": s.free}


def _gain_words(g: GainsCheck) -> str:
    if not g.stabilised:
        return "no feedback: stabilisation = 'none'"
    text = f"stable, margin {g.margin:.3g} (2 alpha beta^2 / gamma > 1)"
    if g.settling_time is not None and g.overshoot is not None:
        text += f"; settles to 2 % in {g.settling_time:.3g} s, overshoot {100 * g.overshoot:.0f} %"
    if g.force:
        name, force = max(g.force.items(), key=lambda item: item[1])
        text += f"; 1 cm of sudden error asks for up to {force / 100:.2g} N ('{name}')"
    return text


def _some(names: Sequence[str]) -> str:
    """The first of some names, how many there are besides, and whether they "is" or "are"."""
    text = ", ".join(f"'{name}'" for name in names[:_TOLD])
    more = f" and {len(names) - _TOLD:,} more" if len(names) > _TOLD else ""
    return f"{text}{more} {'is' if len(names) == 1 else 'are'}"


def _agents(who: tuple[int, ...]) -> str:
    """Agents counted from 1, in words."""
    names = [str(i + 1) for i in who]
    if len(names) == 1:
        return f"agent {names[0]}"
    return f"agents {', '.join(names[:-1])} and {names[-1]}"


def _named(names: tuple[str, ...], values: tuple[Any, ...] | None) -> dict[str, Any] | None:
    if values is None:
        return None
    plain = [None if isinstance(v, float) and not math.isfinite(v) else v for v in values]
    return dict(zip(names, plain, strict=True))
