"""Formations: whether they are rigid, and whether their distances make another shape."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np

from rigidfleet.formation import distance_geometry
from rigidfleet.mission import Mission
from rigidfleet.planning import solvers
from rigidfleet.planning.reference import reference_kind
from rigidfleet.preflight.findings import DENSE, TOLERANCE, FormationCheck, Remark, agents, some
from rigidfleet.rigidity import (
    Kind,
    RigidityClass,
    analyse,
    realisations,
    spectrum,
)
from rigidfleet.rigidity.spectrum import MOST as LANCZOS
from rigidfleet.typing import Floats

#: Formations of up to so many agents are searched for other shapes of the same distances.
SEARCHED = 12


#: So many random starts that search has: enough for what is common, in a tenth of a second.
STARTS = 40


#: Work on formations [s]. Limits of a check are counted, not timed: it finds the same on any machine.
_FORMING = 4.0


def check_formations(
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
    if min(m, 3 * n) > DENSE:
        return 5e-4 * n if n <= LANCZOS else 0.0
    return 0.1 * search + 5e-10 * min(m, 3 * n) ** 2 * max(m, 3 * n) + 2e-3


def _formation(
    mission: Mission, name: str, held: Literal["slots", "distances", "nothing"], *, search: bool
) -> FormationCheck:
    slots, edges = mission.formation_slots(name), mission.formation_edges(name)
    method = solvers.choose(mission.n_agents, edges, mission.constraint.solver)
    if slots is None or not len(edges):
        return FormationCheck(name, None, held, method=method)
    if min(len(edges), 3 * mission.n_agents) > DENSE:
        ends = spectrum(slots, edges, mission.agents.mass) if len(slots) <= LANCZOS else None
        return FormationCheck(name, None, held, method=method, spectrum=ends)
    rigidity = analyse(slots, edges, masses=mission.agents.mass)
    endless = rigidity.verdict is RigidityClass.FLEXIBLE  # a continuum of other shapes
    if not search or endless or contradiction(mission, name) is not None:
        return FormationCheck(name, rigidity, held, method=method)
    start = mission.agents.position
    others = realisations(slots, edges, starts=STARTS, start=start)
    return FormationCheck(name, rigidity, held, others, method)


def _held_by(mission: Mission, name: str) -> Literal["slots", "distances", "nothing"]:
    """By what a formation is held in the phases that fly it."""
    now, controls = None, set()
    for phase in mission.phases:
        now = phase.shaping.formation if phase.shaping is not None else now
        controls |= {phase.control} if now == name else set()
    if not controls:
        return "nothing"
    return "slots" if controls == {"tracking"} else "distances"


def contradiction(mission: Mission, name: str) -> tuple[int, float] | None:
    """Edge whose given distance is farthest from that of the slots, and by how much [m], if by much."""
    slots, edges = mission.formation_slots(name), mission.formation_edges(name)
    if slots is None or not len(edges):
        return None
    given = mission.formation_distances(name)
    error = np.abs(distance_geometry.distances(slots, edges) - given)
    worst = int(error.argmax())
    return (worst, float(error[worst])) if error[worst] > TOLERANCE * given.min() else None


def formation_remarks(mission: Mission, formations: list[FormationCheck]) -> Iterator[Remark]:
    """Formations that are not rigid, contradict themselves, or share their distances with other shapes."""
    exact = mission.constraint.solver == "exact"
    if skipped := [f.name for f in formations if f.skipped]:
        text = f"so many formations take too long to judge: {some(skipped)} passed over"
        yield Remark("note", "formation", text)
    if idle := [f.name for f in formations if f.held_by == "nothing"]:
        yield Remark("note", "formation", f"{some(idle)} flown in no phase")
    for f in formations:
        if f.held_by == "nothing":
            continue
        alone = f.held_by == "distances"
        if (off := contradiction(mission, f.name)) is not None:
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
        if r.verdict is RigidityClass.FLEXIBLE:
            who = "; ".join(agents(flex.agents) for flex in r.flexes[:4])
            more = f" and {len(r.flexes) - 4} more" if len(r.flexes) > 4 else ""
            text = f"'{f.name}' is flexible: {r.rank} independent distances, {r.needed} hold it; free: {who}{more}"
            held = ". Add edges (rigidfleet design), or track slots" if alone else "; slots hold it"
            yield Remark("fails" if alone else "note", "formation", text + held)
        elif r.verdict is RigidityClass.UNDECIDED and alone:
            yield Remark("note", "formation", f"'{f.name}' is undecided: {r.reason}")
        elif r.verdict is RigidityClass.PRESTRESS_STABLE and alone:
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
    start, slots = mission.fleet.position, mission.formation_slots(f.name)
    first, by = mission.phases[0].establishing, None
    if first is not None and first.formation == f.name:
        by = reference_kind(mission, first, start, slots)
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


def _flattens(start: Floats, slots: Floats) -> bool:
    """Whether four agents are all in one plane on the way from a start to slots in space (4, 3)."""
    if len(slots) != 4 or distance_geometry.dimension(slots) < 3:
        return False
    return bool(np.linalg.det((start[1:] - start[0]).T @ (slots[1:] - slots[0])) < 0)
