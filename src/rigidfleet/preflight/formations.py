"""Check formations: whether they are rigid, and whether other shapes have the same distances."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np

from rigidfleet._common.text import agent_names
from rigidfleet.formation import distance_geometry
from rigidfleet.mission import Mission
from rigidfleet.planning import solvers
from rigidfleet.planning.reference import reference_kind
from rigidfleet.preflight.findings import DENSE, TOLERANCE, FormationCheck, Remark, some
from rigidfleet.rigidity import (
    Kind,
    RigidityClass,
    analyse,
    realisations,
    spectrum,
)
from rigidfleet.rigidity.spectrum import MOST as LANCZOS
from rigidfleet.typing import Floats

#: Maximum number of agents for which other shapes with the same distances are searched by default.
SEARCHED = 12


#: Number of random starts of this search: enough to find common shapes in a tenth of a second.
STARTS = 40


#: Maximum work on formations, as an estimated time [s]. The estimate makes a check the same on every machine.
_FORMING = 4.0


def check_formations(
    mission: Mission, *, search: bool, progress: Callable[[str], None]
) -> list[FormationCheck]:
    """Check all formations and return them in their order. Those that are flown have priority if work is limited."""
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
    """Estimated time to check a formation [s]."""
    n, m = mission.n_agents, len(mission.formation_edges(name))
    if min(m, 3 * n) > DENSE:
        return 5e-4 * n if n <= LANCZOS else 0.0
    return 0.1 * search + 5e-10 * min(m, 3 * n) ** 2 * max(m, 3 * n) + 2e-3


def _formation(
    mission: Mission, name: str, held: Literal["tracking", "distances", "nothing"], *, search: bool
) -> FormationCheck:
    slots, edges = mission.formation_slots(name), mission.formation_edges(name)
    method = solvers.choose(mission.n_agents, edges, mission.constraint.solver)
    if slots is None or not len(edges):
        return FormationCheck(name, None, held, method=method)
    if min(len(edges), 3 * mission.n_agents) > DENSE:
        ends = spectrum(slots, edges, mission.agents.mass) if len(slots) <= LANCZOS else None
        return FormationCheck(name, None, held, method=method, spectrum=ends)
    rigidity = analyse(slots, edges, masses=mission.agents.mass)
    endless = rigidity.rigidity_class is RigidityClass.FLEXIBLE  # a continuum of other shapes
    if not search or endless or contradiction(mission, name) is not None:
        return FormationCheck(name, rigidity, held, method=method)
    start = mission.agents.position
    others = realisations(slots, edges, starts=STARTS, start=start)
    return FormationCheck(name, rigidity, held, others, method)


def _held_by(mission: Mission, name: str) -> Literal["tracking", "distances", "nothing"]:
    """What holds a formation in the phases that have it."""
    now, controls = None, set()
    for phase in mission.phases:
        now = phase.shaping.formation if phase.shaping is not None else now
        controls |= {phase.control} if now == name else set()
    if not controls:
        return "nothing"
    return "tracking" if controls == {"tracking"} else "distances"


def contradiction(mission: Mission, name: str) -> tuple[int, float] | None:
    """Edge whose given distance differs most from that of the slots, and this error [m]; None within tolerance."""
    slots, edges = mission.formation_slots(name), mission.formation_edges(name)
    if slots is None or not len(edges):
        return None
    given = mission.formation_distances(name)
    error = np.abs(distance_geometry.distances(slots, edges) - given)
    worst = int(error.argmax())
    return (worst, float(error[worst])) if error[worst] > TOLERANCE * given.min() else None


def formation_remarks(mission: Mission, formations: list[FormationCheck]) -> Iterator[Remark]:
    """Remarks on formations that are not rigid, contradict themselves, or share their distances with other shapes."""
    exact = mission.constraint.solver == "exact"
    if skipped := [f.name for f in formations if f.skipped]:
        text = f"to limit the time of the check, {some(skipped)} skipped"
        yield Remark("note", "formation", text)
    if idle := [f.name for f in formations if f.held_by == "nothing"]:
        yield Remark("note", "formation", f"{some(idle)} not used in any phase")
    for f in formations:
        if f.held_by == "nothing":
            continue
        alone = f.held_by == "distances"
        if (off := contradiction(mission, f.name)) is not None:
            i, j = mission.formation_edges(f.name)[off[0]] + 1
            given = mission.formation_distances(f.name)[off[0]]
            text = (
                f"'{f.name}' will have another shape than its slots: agents {i} and {j} are given {given:.4g} m,"
                f" which differs from that of their slots by {off[1]:.3g} m"
            )
            yield Remark("fails", "formation", text)
        r = f.rigidity
        if f.spectrum is not None:
            if f.spectrum.free:
                text = f"'{f.name}' is flexible to first order: at least {f.spectrum.free} motions are free"
                held = ". Add edges, or track slots" if alone else "; slots hold it"
                yield Remark("fails" if alone else "note", "formation", text + held)
            continue
        if r is None and mission.formation_slots(f.name) is not None:
            continue  # too large to check
        if r is None:
            if len(mission.formation_edges(f.name)):
                text = f"the distances of '{f.name}' do not determine positions: its rigidity is not checked"
                yield Remark("note", "formation", text)
            continue
        if r.rigidity_class is RigidityClass.FLEXIBLE:
            who = "; ".join(agent_names(flex.agents) for flex in r.flexes[:4])
            more = f" and {len(r.flexes) - 4} more" if len(r.flexes) > 4 else ""
            text = f"'{f.name}' is flexible: {r.rank} of {r.needed} independent distances; free: {who}{more}"
            held = ". Add edges (rigidfleet design), or track slots" if alone else "; slots hold it"
            yield Remark("fails" if alone else "note", "formation", text + held)
        elif r.rigidity_class is RigidityClass.UNDECIDED and alone:
            yield Remark("note", "formation", f"'{f.name}' is undecided: {r.reason}")
        elif r.rigidity_class is RigidityClass.PRESTRESS_STABLE and alone:
            where = "line" if r.dimension == 1 else "plane"
            across = f" across its {where}" if r.dimension < 3 else ""
            text = f"'{f.name}' is only prestress stable{across}; tracked slots hold it firmly"
            yield Remark("note", "formation", text)
        if exact and alone and len(r.edges) > r.rank:
            text = (
                f"solver 'exact' has no solution at '{f.name}': only {r.rank} of its {len(r.edges)} distances are"
                " independent. Use solver = 'iterated'"
            )
            yield Remark("fails", "formation", text)
        yield from _other_shapes(mission, f, alone=alone)


def _other_shapes(mission: Mission, f: FormationCheck, *, alone: bool) -> Iterator[Remark]:
    """Remarks on other shapes with the same distances, if distances alone guide the agents."""
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
            f"the agents start with the handedness of the mirror image of '{f.name}' and must pass through a plane,"
            " where distances alone may return them to the mirror image. Swap two slots or track slots"
        )
        yield Remark("note", "formation", text)
    elif by in ("squares", "step") and end not in (None, Kind.SAME):
        text = (
            f"from the start positions, the distances of '{f.name}' lead to another shape ({end})"
        )
        yield Remark("note", "formation", text)
    elif not others.unique:
        n = sum(r.kind not in (Kind.SAME, Kind.MIRRORED) for r in others.found)
        share = sum(r.found for r in others.found if r.kind not in (Kind.SAME, Kind.MIRRORED))
        what = "1 other shape has" if n == 1 else f"{n} other shapes have"
        text = (
            f"{what} the distances of '{f.name}'; {share} of {others.starts} random starts reach"
            f" {'it' if n == 1 else 'them'}. Redundant edges or tracked slots prevent this"
        )
        yield Remark("note", "formation", text)


def _flattens(start: Floats, slots: Floats) -> bool:
    """Whether straight paths of four agents from a start to spatial slots (4, 3) pass through a plane."""
    if len(slots) != 4 or distance_geometry.dimension(slots) < 3:
        return False
    return bool(np.linalg.det((start[1:] - start[0]).T @ (slots[1:] - slots[0])) < 0)
