"""What a check finds, and how it is put in words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from rigidfleet import _markup
from rigidfleet._text import agent_names
from rigidfleet.planning import solvers
from rigidfleet.planning.preview import PlannedPhase
from rigidfleet.rigidity import (
    Realisations,
    Rigidity,
    Spectrum,
)

#: So many things are named in one note.
_TOLD = 6


#: So much of the shortest distance may be missed: the verdict's own tolerance of a shape.
TOLERANCE = 0.01
#: Equations up to which rigidity, and forces at a jump, are judged by a dense decomposition.
DENSE = 600
#: Rounding on a limit is not beyond it.
SLACK = 1e-9

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
    """How agents get to slots: length of all paths [m], and least clearance between agents on them [m].

    `order[i]` is the slot that agent i takes, both from 0.
    """

    order: tuple[int, ...]
    path_length: float
    min_clearance: float


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
    >>> for heading, fact in ahead.describe():
    ...     print(heading, fact)
    """

    formations: list[FormationCheck]
    gains: GainsCheck
    planned_phases: list[PlannedPhase]
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
        verdict = f"{fails} will fail" if fails else "no problems found"
        return f"<Preflight: {verdict}, {notes} note{'s' * (notes != 1)}>"

    def _repr_html_(self) -> str:
        """What was found as a notebook shows it: facts, then remarks."""
        rows = [*self.describe(), *((remark.level, remark.text) for remark in self.remarks)]
        verdict = "no problems found" if self.passed else "it will fail as it is"
        return _markup.shown("Check", verdict, ("about", "what was found"), rows)

    def describe(self) -> Iterator[tuple[str, str]]:
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
                f"{name} {a.path_length:.1f} m, {a.min_clearance:.2f} m"
                for name, a in self.assignments.items()
            ]
            yield (
                "assignment",
                f"length of all paths, and least clearance on them: {'; '.join(told)}",
            )
        guessed = [planned.phase for planned in self.planned_phases if not planned.exact]
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
                "guessed_phases": [
                    planned.phase for planned in self.planned_phases if not planned.exact
                ],
                "separation": _named(("room_m", "time_s", "who"), self.room),
                "thrust": _named(("thrust_n", "time_s", "who", "limit_n"), self.thrust),
                "clearance": [
                    _named(("obstacle", "room_m", "time_s", "who"), c) for c in self.clearance
                ],
                "gaps": [_named(("between", "wide_m", "takes_m", "time_s"), g) for g in self.gaps],
                "assignments": {
                    name: {
                        "order": [s + 1 for s in a.order],
                        "path_length_m": a.path_length,
                        "min_clearance_m": a.min_clearance,
                    }
                    for name, a in self.assignments.items()
                },
            },
        }


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
        free = "; ".join(agent_names(flex.agents) for flex in r.flexes[:3])
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


def some(names: Sequence[str]) -> str:
    """The first of some names, how many there are besides, and whether they "is" or "are"."""
    text = ", ".join(f"'{name}'" for name in names[:_TOLD])
    more = f" and {len(names) - _TOLD:,} more" if len(names) > _TOLD else ""
    return f"{text}{more} {'is' if len(names) == 1 else 'are'}"


def _named(names: tuple[str, ...], values: tuple[Any, ...] | None) -> dict[str, Any] | None:
    if values is None:
        return None
    plain = [None if isinstance(v, float) and not math.isfinite(v) else v for v in values]
    return dict(zip(names, plain, strict=True))
