"""Results of a check, and their descriptions in words."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from rigidfleet._common.facts import (
    Cell,
    Fact,
    FactTable,
    Level,
    Line,
    Row,
    Sheet,
    Shown,
    table_of,
    table_of_worst_values,
)
from rigidfleet._common.plain import to_json_data
from rigidfleet._common.quantities import QUANTITIES
from rigidfleet._common.text import agent_names, first_few
from rigidfleet.math import proximity
from rigidfleet.math.margins import Margins
from rigidfleet.mission import Mission
from rigidfleet.planning import solvers
from rigidfleet.planning.certificate import Certificate
from rigidfleet.planning.preview import PlannedPhase
from rigidfleet.rigidity import (
    Kind,
    Realisations,
    Rigidity,
    Spectrum,
)

#: Maximum number of names in one remark.
_MOST_NAMES = 6
#: Maximum number of equations for which rigidity, and forces at a step, are computed by a dense decomposition.
DENSE = 600
#: Number of agents beyond which tracked slots are those of a show, whose edges are not explained.
_MANY = 12

#: Quantities whose worst planned values are shown without a limit, too.
WORST_SHOWN = ("separation", "speed", "vertical_speed", "thrust")
#: Forces of disturbances in words.
_FORCES = {
    "air": "steady wind", "gusts": "gusts (3 sigma)", "weight": "weight error", "noise": "noise (3 sigma)",
}  # fmt: skip

#: What holds a formation in the phases that have it.
HeldBy = Literal["tracking", "distances", "nothing"]


@dataclass(frozen=True)
class Remark:
    """A problem that will make the flight fail, or a note.

    Attributes
    ----------
    level : "fails" or "note"
    topic : files, formation, gains, margins, network, collision, avoidance, downwash, assignment, thrust, disturbances,
        obstacle, fence, people, geofence, speed, acceleration, waypoint, attitude, tracking error, settle, landing,
        loss or paths (not checked, or estimated)
    text : the problem or note in words
    """

    level: Level
    topic: str
    text: str


@dataclass(frozen=True)
class FormationCheck:
    """Check of one formation.

    Attributes
    ----------
    name : name of the formation
    rigidity : None if it was not computed
    held_by : "tracking" if slots are tracked in every phase with this formation, "distances" if not, "nothing" if no
        phase has it
    realisations : other shapes with the same distances; None if they were not searched
    solve : how the constraint force is solved
    spectrum : of a large formation, instead of its rigidity
    spacing_m : least distance between two slots, centre to centre [m]; infinite if there are no slots
    colours : number of colours of its lights; 0 if it keeps the lights before
    skipped : whether the formation was not checked because there are too many
    """

    name: str
    rigidity: Rigidity | None
    held_by: HeldBy
    realisations: Realisations | None = None
    solve: solvers.Method = "dense"
    spectrum: Spectrum | None = None
    skipped: bool = False
    spacing_m: float = math.inf
    colours: int = 0


@dataclass(frozen=True)
class GainsCheck:
    """Response of the constraint law to an error of a distance.

    Attributes
    ----------
    stabilised : whether there is feedback
    margin : 2 alpha beta^2 / gamma; above 1 the law is stable
    settling_time_s : time to settle to 2 % [s]; None if unknown
    overshoot : as a fraction; None if unknown
    force_per_error_n_m : by formation, maximum force per error of one distance [N/m]
    """

    stabilised: bool
    margin: float
    settling_time_s: float | None
    overshoot: float | None
    force_per_error_n_m: dict[str, float]

    @property
    def table(self) -> FactTable:
        """Stability, and what a step of 1 cm in the error of an edge causes."""
        if not self.stabilised:
            return table_of([{"gains": "no feedback: stabilisation = 'none'"}])
        forces = self.force_per_error_n_m
        name, force = max(forces.items(), key=lambda item: item[1], default=("", None))
        row = {
            "gains": "stable", "margin": self.margin, "settles in [s]": self.settling_time_s,
            "overshoot [%]": self.overshoot and 100 * self.overshoot, "force of 1 cm [N]": force and force / 100,
            "in": name,
        }  # fmt: skip
        return table_of([row], ("in",))


class FormationMargins(NamedTuple):
    """Margins of all loops of a formation, or of a way between two: the smallest over its shapes and attitudes.

    Attributes
    ----------
    margins : with the gains of the mission
    largest_pole : rate p [1/s] up to which a triple pole of the constraint law is stable; infinite for no bound
    """

    margins: Margins
    largest_pole: float

    def data(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return self.margins.data() | {"largest_p": self.largest_pole}


@dataclass(frozen=True)
class MarginsCheck:
    """What lag and delay the laws bear.

    Attributes
    ----------
    tracking : margins of the vehicles that track their slots, without the constraint law; None if none does. The
        upper gain margin is the greatest factor on the gains of the tracking
    formations : by formation, or way between two
    skipped : whether shapes were left out because there is too much to compute
    """

    tracking: Margins | None
    formations: dict[str, FormationMargins]
    skipped: bool = False

    @property
    def table(self) -> FactTable:
        """What the tracking bears, then each formation and way."""
        rows = [] if self.tracking is None else [_margin_row("tracking", self.tracking)]
        for where, f in self.formations.items():
            rows.append(_margin_row(where, f.margins) | {"p up to [/s]": f.largest_pole})
        return table_of(rows, ("", "margins"))


@dataclass(frozen=True)
class FormationNetwork:
    """What delay and loss of messages a formation by neighbours bears, beside its own network.

    Attributes
    ----------
    broadcasts_hz : of all vehicles a second [Hz]
    tick_s : time between two evaluations of the law [s]
    delay_ticks, own_delay_ticks : last stable delay, and the greatest one of the mission; 0 if not even 1 is stable
    loss, own_loss : share of independent losses up to which it is stable in mean square at its own delay, and the
        mission's; None if it is not even without losses
    growing : share of sampled linear flights, with the mission's own bursts, jitter and time-outs, in which errors
        grow; None if there was no need for them
    unheard_edges : number of edges that are longer than the range
    """

    broadcasts_hz: float
    tick_s: float
    delay_ticks: int
    own_delay_ticks: int
    loss: float | None
    own_loss: float
    growing: float | None = None
    unheard_edges: int = 0

    @property
    def bears_own_network(self) -> bool:
        """Whether the mission's own network is within what the formation bears."""
        share = -1.0 if self.loss is None else self.loss
        within = self.own_loss <= share and self.own_delay_ticks <= self.delay_ticks
        return within and (self.growing or 0.0) <= 0.5

    @property
    def table_row(self) -> dict[str, Any]:
        """What it bears and what it has, by the names of columns; losses are stable in mean square."""
        ms, bears = 1e3 * self.tick_s, None if self.loss is None else 100 * self.loss
        return {
            "broadcasts [/s]": self.broadcasts_hz, "bears delay [ms]": ms * self.delay_ticks,
            "has [ms]": ms * self.own_delay_ticks, "bears loss [%]": bears,
            "has [%]": None if bears is None else 100 * self.own_loss,
            "flights that grow [%]": None if self.growing is None else 100 * self.growing,
        }  # fmt: skip


@dataclass(frozen=True)
class Assignment:
    """An assignment of agents to slots.

    Attributes
    ----------
    order : slot of each agent, from 1
    path_length_m : total length of all paths [m]
    min_clearance_m : minimum clearance between agents on them [m]
    """

    order: tuple[int, ...]
    path_length_m: float
    min_clearance_m: float


@dataclass(frozen=True)
class Disturbed:
    """Effects of the disturbances on the planned paths.

    Attributes
    ----------
    air : maximum force of the steady wind on a vehicle at rest [N]
    gusts : three standard deviations of the force of the gusts [N]
    weight : maximum difference between true weight and the weight in the control laws [N]
    noise : three standard deviations of the thrust due to measurement noise while slots are tracked [N]
    thrust : maximum thrust on the planned paths with all disturbances: thrust [N], time [s], agent, limit [N]
    offset : maximum steady distance from a tracked slot [m], and the agent
    lost : index of each lost vehicle, from 0, and time of the loss [s]
    """

    air: float
    gusts: float
    weight: float
    noise: float
    thrust: tuple[float, float, str, float]
    offset: tuple[float, str]
    lost: tuple[tuple[int, float], ...]

    def data(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            **{f"{name}_n": getattr(self, name) for name in _FORCES},
            "thrust": _worst_value_data("thrust", self.thrust),
            "offset": _values_by_name("offset_m who", self.offset),
            "lost": [_values_by_name("agent time_s", (i + 1, t)) for i, t in self.lost],
        }


@dataclass(frozen=True)
class VehicleCheck:
    """What the planned paths ask of vehicles with rotors, in still air.

    Attributes
    ----------
    rotor_force : force of the rotor nearest to its limit [N], its time [s], the agent, the limit [N] and the phase
    tilt : maximum tilt [deg], its time [s], the agent and the phase
    jump : maximum jump of the acceleration [m/s^2], of the tilt there [deg], its time [s] and the phase that begins
        there; None if there is no switch between phases that track slots
    beyond : greatest share of a phase in which a vehicle cannot give what the plan asks, for its rotors or its limit of
        tilt; the agent, the phase, and in words what is needed; None if there is none
    """

    rotor_force: tuple[float, float, str, float, str]
    tilt: tuple[float, float, str, str]
    jump: tuple[float, float, float, str] | None = None
    beyond: tuple[float, str, str, str] | None = None

    def data(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "rotor_force": _worst_value_data("rotor_force", self.rotor_force),
            "tilt": _values_by_name("tilt time_s who phase", self.tilt),
            "jump": _values_by_name("acceleration tilt time_s phase", self.jump),
            "beyond": _values_by_name("share who phase needs", self.beyond),
        }


@dataclass
class Preflight(Shown):
    """Result of `check`; `remarks` has the problems and notes.

    Attributes
    ----------
    mission : with its times known
    formations, gains : checks of the formations and of the constraint law
    planned_phases : planned paths of each phase
    flown_phases : what of them is flown, up to a loss that is answered or an abort: what is judged
    worst : by quantity, the planned value nearest to its limit: the value, its time [s], whose it is, and the limit,
        which is None or infinite if there is none
    clearance : of each obstacle: its name, minimum clearance [m], time [s], agent
    gaps : of each gap: its obstacles, its width [m], the width that the formation needs [m], time [s]
    assignments : assignments to slots that were compared, by name
    disturbed : effects of the disturbances; None without disturbances
    margins : what lag and delay the laws bear; None if vehicles have none
    network : what delay and loss of messages each formation bears, by its name; empty without a network
    vehicles : what the planned paths ask of rotors; None if vehicles have none
    reserve : of the limits, what automatic times leave for lag and drag of vehicles [s] (`vehicles.tracking_lag_times`)
    judged_to : mission time [s] up to which paths were checked; infinite if they all were
    remarks : problems and notes

    >>> import rigidfleet as rf
    >>> ahead = rf.check("narrow-passage")
    >>> ahead.passed
    True
    >>> for heading, fact in ahead.describe():
    ...     print(heading, fact)
    """

    mission: Mission
    formations: list[FormationCheck]
    gains: GainsCheck
    planned_phases: list[PlannedPhase]
    flown_phases: list[PlannedPhase]
    worst: dict[str, Any] = field(default_factory=lambda: dict.fromkeys(WORST_SHOWN))
    clearance: list[tuple[str, float, float, str]] = field(default_factory=list)
    gaps: list[tuple[str, float, float, float]] = field(default_factory=list)
    assignments: dict[str, Assignment] = field(default_factory=dict)
    disturbed: Disturbed | None = None
    margins: MarginsCheck | None = None
    network: dict[str, FormationNetwork] = field(default_factory=dict)
    vehicles: VehicleCheck | None = None
    reserve: float = 0.0
    judged_to: float = math.inf
    remarks: list[Remark] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether no problem was found that will make the flight fail."""
        return all(remark.level != "fails" for remark in self.remarks)

    @property
    def is_show(self) -> bool:
        """Whether slots alone concern the user: all phases track them, of many agents, or without edges."""
        many = self.mission.n_agents > _MANY or not len(self.mission.edges)
        tracked = all(phase.tracks_slots for phase in self.mission.phases)
        return self.mission.n_agents > 1 and many and tracked

    def __repr__(self) -> str:
        fails = sum(remark.level == "fails" for remark in self.remarks)
        notes = len(self.remarks) - fails
        verdict = f"{fails} problem{'s' * (fails != 1)}" if fails else "no problems found"
        return f"<Preflight: {verdict}, {notes} note{'s' * (notes != 1)}>"

    def facts(self) -> Sheet:
        """The phases, the facts, and the remarks; of a show, nothing of edges, nor of laws that are stable."""
        name, heads = self.mission.name, ("about", "result")
        remarks = [Row((r.level, r.text), r.level) for r in self.remarks]
        verdict = "no problems found" if self.passed else "the flight will fail"
        parts = [
            self.mission.phase_table,
            *self._tables(),
            FactTable(heads, remarks, heads, bare=True),
            Line(f"{name}: {verdict}", "ok" if self.passed else "fails"),
        ]
        return Sheet(name, f"valid: {self.mission.size_in_words}", parts)

    def describe(self) -> Iterator[tuple[str, str]]:
        """Facts, each with its heading: formations, gains, planned paths. `remarks` are separate."""
        for table in self._tables():
            heads = [("", "") if table.bare else x[:2] for x in table.names_units_words[1:]]
            for heading, *texts in table.cell_texts:
                cells = zip(heads, texts, strict=True)
                yield heading, ", ".join(f"{x} {y} {unit}".strip() for (x, unit), y in cells if y)

    def _tables(self) -> list[FactTable]:
        """Formations and laws, what is said of them in words, and the planned paths."""
        unstable = any(r.topic == "margins" and r.level == "fails" for r in self.remarks)
        tables = [self.margins.table] if self.margins and (unstable or not self.is_show) else []
        if self.formations and not self.is_show:
            graphs = _graph_table(self.formations)
            tables = [_formation_table(self.formations), graphs, self.gains.table, *tables]
        words = "about", "result"
        ways = [
            {"assignment": name, "path length [m]": a.path_length_m, "least clearance [m]": a.min_clearance_m}
            for name, a in self.assignments.items()
        ]  # fmt: skip
        return [
            *tables,
            table_of([{"network": name} | f.table_row for name, f in self.network.items()]),
            FactTable(words, [*map(Row, self._headed_sentences())], words, bare=True),
            table_of(ways if len(ways) > 1 else []),
            table_of_worst_values("planned", self._worst_facts()),
        ]

    def _worst_facts(self) -> Iterator[Fact]:
        """Worst values of the planned paths, with their limits."""
        if self.is_show:
            places = {"start": float(proximity.nearest(self.mission.fleet.position).min())}
            places |= {f"'{f.name}'": f.spacing_m for f in self.formations}
            for where, apart in places.items():
                yield Fact("spacing, centre to centre", apart, "m", who=where)
        for name, q in QUANTITIES.items():
            if (worst := self.worst.get(name)) is not None:
                value, t, who, limit = worst
                yield Fact(q.name_in_words, value, q.unit, limit, q.at_least, t, who)
        if certificates := self.certificates:
            phase, least = min(certificates.items(), key=lambda item: item[1].separation)
            who = f"{agent_names(least.agents)}, '{phase}' ({least.how})"
            limit = self.mission.limits.separation
            yield Fact("separation, proved", least.separation, "m", limit, True, least.time, who)
        if (d := self.disturbed) is not None:
            for name, what in _FORCES.items():
                if (force := getattr(d, name)) > 0:
                    yield Fact(f"force of {what}", force, "N")
            force, t, who, limit = d.thrust
            yield Fact("thrust, disturbed", force, "N", limit, when=t, who=who)
            if d.offset[0] > 0:
                yield Fact("steady offset from a slot", d.offset[0], "m", who=d.offset[1])
            for i, t in d.lost:
                yield Fact("loss", None, when=t, who=f"agent {i + 1}")
        for between, wide, takes, t in self.gaps:
            yield Fact("width of a gap", wide, "m", takes, True, t, between)
        for name, least, t, who in self.clearance:
            yield Fact("clearance", least, "m", when=t, who=f"{who}, '{name}'")
        if self.reserve:
            yield Fact("reserve of automatic times", self.reserve, "s")

    @property
    def separation(self) -> tuple[float, float, str] | None:
        """Minimum planned separation [m], its time [s] and the agents."""
        return (worst := self.worst["separation"]) and worst[:3]

    @property
    def thrust(self) -> tuple[float, float, str, float] | None:
        """Planned thrust nearest to its limit [N], its time [s], the agent and its limit [N]."""
        return self.worst["thrust"]

    def _headed_sentences(self) -> Iterator[tuple[str, str]]:
        """What is said in words, each with its heading."""
        for f in self.formations if self.is_show else ():
            if f.colours:
                yield f.name, f"{f.colours} colour{'s' * (f.colours > 1)} of lights"
        lacking = [p.phase for p in self.planned_phases if p.leg.certificate is None]
        if lacking and self.certificates:
            yield "not proved", f"{names_with_verb(lacking)} flown without tracked slots"
        guessed = [planned.phase for planned in self.planned_phases if not planned.exact]
        if guessed:
            names = ", ".join(f"'{name}'" for name in guessed)
            text = f"straight paths are assumed in {names}, where only distances guide the agents"
            yield "guessed", text

    @property
    def certificates(self) -> dict[str, Certificate]:
        """Certificate of each planned phase that has one, by its name."""
        each = ((planned.phase, planned.leg.certificate) for planned in self.planned_phases)
        return {name: certificate for name, certificate in each if certificate is not None}

    def data(self) -> dict[str, Any]:
        """Plain data for JSON, agents and slots counted from 1."""
        proof = "phase separation time_s agents how"
        data = {
            "passed": self.passed,
            "remarks": self.remarks,
            "formations": {f.name: f for f in self.formations},
            "gains": self.gains,
            "margins": self.margins,
            "network": self.network,
            "vehicles": self.vehicles,
            "reserve_s": self.reserve,
            "disturbances": self.disturbed,
            "paths": {
                "judged_to_s": self.judged_to,
                "guessed_phases": [
                    planned.phase for planned in self.planned_phases if not planned.exact
                ],
                **{name: _worst_value_data(name, worst) for name, worst in self.worst.items()},
                "certificates": [
                    _values_by_name(proof, (phase, least, t, np.add(who, 1), how))
                    for phase, (least, t, who, how) in self.certificates.items()
                ],
                "clearance": [
                    _values_by_name("obstacle clearance time_s who", c) for c in self.clearance
                ],
                "gaps": [_values_by_name("between wide_m takes_m time_s", g) for g in self.gaps],
                "assignments": self.assignments,
            },
        }
        return to_json_data(data)


def _formation_table(formations: Sequence[FormationCheck]) -> FactTable:
    """How rigid each formation is. An error of all edges of 1 cm allows the positions an offset."""
    rows = []
    for f in formations:
        held = "not used in any phase" if f.held_by == "nothing" else f.held_by
        row: dict[str, Any] = {"formation": f.name, "rigidity": "", "held by": held}
        rows.append(row)
        if (r := f.rigidity) is not None:
            row |= {"rigidity": r.rigidity_class, "edges": len(r.edges)}
            row["rank"] = f"{r.rank} of {r.needed}"
            if r.rank:
                row |= {"index": r.index, "w": r.w, "offset by 1 cm [cm]": r.offset(1.0)}
        elif (ends := f.spectrum) is not None and not ends.free:
            row |= {"rigidity": "rigid", "index": ends.index, "condition": ends.condition}
        elif ends is not None:
            row["rigidity"] = f"flexible to first order, at least {ends.free} free motions"
        elif f.solve != "dense" or f.skipped:
            row["rigidity"] = f"{'skipped' if f.skipped else 'too large'}, rigidity not checked"
        else:
            row["rigidity"] = "not checked, since distances do not determine positions"
    return table_of(rows, ("rigidity", "held by"))


#: Columns of the kinds of shapes to which random starts lead.
_GOALS = {
    Kind.SAME: "this shape", Kind.MIRRORED: "mirror image", Kind.FOLDED: "folded", Kind.COINCIDENT: "coincident",
}  # fmt: skip


def _graph_table(formations: Sequence[FormationCheck]) -> FactTable:
    """Of each formation: its solve, edges any one of which is redundant, free motions, and where random starts lead."""
    rows = []
    for f in formations:
        row: dict[str, Any] = {"graph": f.name}
        if f.solve != "dense":
            row["solved by"] = solvers.METHOD_WORDS[f.solve]
        if (r := f.rigidity) is not None:
            if r.reachable < r.needed:
                row["reachable rank"] = r.reachable
            if len(r.redundant):
                names = [f"{i}-{j}" for i, j in (r.edges[r.redundant] + 1).tolist()]
                row["redundant edges"] = Cell(f"{len(names)}", f"({first_few(names, 6)})")
            if r.flexes:
                ways = Counter(agent_names(flex.agents) for flex in r.flexes)
                who = [f"{x} in {k} directions" if k > 1 else x for x, k in ways.items()]
                row["free motions"] = Cell(f"{len(r.flexes)}", f"({first_few(who, 3, '; ')})")
        if (others := f.realisations) is not None:
            row |= {"random starts": others.starts, "this shape": 0}
            for x in others.shapes:
                for column in (_GOALS[x.kind], *["bent"] * x.bends):
                    row[column] = row.get(column, 0) + x.starts
        rows += [row] if len(row) > 1 else []
    words = "solved by", "redundant edges", "free motions"
    heads = ("graph", *words, "reachable rank", "random starts", *_GOALS.values(), "bent")
    return FactTable(heads, [Row([row.get(name) for name in heads]) for row in rows], words)


def _margin_row(where: str, m: Margins) -> dict[str, Any]:
    row: dict[str, Any] = {"margins": where, "": "stable" if m.stable else "unstable"}
    if m.stable:
        row |= {"more delay [ms]": 1e3 * m.delay, "phase [deg]": math.degrees(m.phase)}
        row |= dict(zip(("gains from", "gains to"), m.gain, strict=True))
    return row


def names_with_verb(names: Sequence[str]) -> str:
    """First names, the number of the others, and "is" or "are"."""
    text = first_few([f"'{name}'" for name in names], _MOST_NAMES)
    return f"{text} {'is' if len(names) == 1 else 'are'}"


def _worst_value_data(name: str, worst: Sequence[Any] | None) -> dict[str, Any] | None:
    """Worst value of a quantity, its time, who has it, its limit and the phase, with units in the keys."""
    return _values_by_name(f"{name} time_s who {_key(name, 'limit')} phase", worst)


def _values_by_name(spaced_names: str, values: Sequence[Any] | None) -> dict[str, Any] | None:
    """Values by their names; those of quantities get their units."""
    names = (_key(name) if name in QUANTITIES else name for name in spaced_names.split())
    return None if values is None else dict(zip(names, values, strict=False))


def _key(name: str, what: str = "") -> str:
    """A value of a quantity in JSON: what it is, by default the last word of its name, and its unit."""
    unit = QUANTITIES[name].unit.lower().replace("/", "_").replace("^", "")
    return f"{what or name.rpartition('_')[2]}_{unit}"
