"""Check formations: whether they are rigid, and whether other shapes have the same distances."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from rigidfleet._common.text import agent_names, first_few
from rigidfleet.formation import distance_geometry
from rigidfleet.formation.graphs import complete_graph
from rigidfleet.math.proximity import nearest
from rigidfleet.math.rigid_body import centred
from rigidfleet.mission import Mission
from rigidfleet.planning import solvers
from rigidfleet.planning.reference import reference_kind
from rigidfleet.preflight.findings import DENSE, FormationCheck, HeldBy, Remark, names_with_verb
from rigidfleet.rigidity import (
    Kind,
    Rigidity,
    RigidityClass,
    analyse,
    realisations,
    spectrum,
)
from rigidfleet.rigidity.analysis import WHERE, flatten_points
from rigidfleet.rigidity.realisations import deform_to_lengths
from rigidfleet.rigidity.spectrum import MOST_FACTORED as LANCZOS
from rigidfleet.typing import Floats

#: Remarks on formations, by their text.
_note, _fails = partial(Remark, "note", "formation"), partial(Remark, "fails", "formation")
#: Maximum number of agents for which other shapes with the same distances are searched by default.
SEARCHED = 12
#: Number of random starts of this search: enough to find common shapes in a tenth of a second.
STARTS = 40
#: A shape is said to be missed if its forecast is off by more tolerances. Near it, forecasts are right to a tenth;
#: after a step of the reference, which throws the agents, to a factor of 3.
_SURELY = {"shape": 1.1, "distances": 1.1, "squares": 1.1, "step": 3.0}

#: Maximum work on formations, as an estimated time [s]. The estimate makes a check the same on every machine.
_FORMING = 4.0


def check_formations(
    mission: Mission, *, search: bool, progress: Callable[[str], None]
) -> list[FormationCheck]:
    """Check all formations and return them in their order. Those that are flown have priority if work is limited."""
    held = {name: _formation_control(mission, name) for name in mission.formations}
    left, checks = _FORMING, {}
    for k, name in enumerate(sorted(held, key=lambda name: held[name] == "nothing"), start=1):
        progress(f"formation '{name}', {k} of {len(held)}")
        work = _formation_check_time(mission, name, search=search)
        skipped = k > 1 and work > left
        left -= 0.0 if skipped else work
        checks[name] = _check_formation(mission, name, held[name], search=search, skipped=skipped)
    return [checks[name] for name in mission.formations]


def _formation_check_time(mission: Mission, name: str, *, search: bool) -> float:
    """Estimated time to check a formation [s]."""
    n, m = mission.n_agents, len(mission.formation_edges(name))
    if min(m, 3 * n) > DENSE:
        return 5e-4 * n if n <= LANCZOS else 0.0
    return 0.1 * search + 5e-10 * min(m, 3 * n) ** 2 * max(m, 3 * n) + 2e-3


def _check_formation(
    mission: Mission, name: str, held: HeldBy, *, search: bool, skipped: bool
) -> FormationCheck:
    """The rigidity, or the spectrum of a large formation, and other shapes if they are searched.

    Of a formation that is ``skipped``, what needs no decomposition: the solve, the spacing of the slots, the lights.
    """
    slots, edges = mission.formation_slots(name), mission.formation_edges(name)
    spacing = math.inf if slots is None or len(slots) < 2 else float(nearest(slots).min())
    check = FormationCheck(
        name, None, held,
        solve=solvers.choose_method(mission.n_agents, edges, mission.constraint.solver), skipped=skipped,
        spacing_m=spacing, colours=len({*(mission.formation_colours(name) or ())}),
    )  # fmt: skip
    if skipped or slots is None or not len(edges):
        return check
    masses, space = mission.agents.mass, mission.formations[name].dimension or mission.dimension
    if min(len(edges), 3 * mission.n_agents) > DENSE:
        start = _dimension_spanned(mission.fleet.position, centred(mission.fleet.velocity))
        if held == "distances" and max(start, _dimension_spanned(slots)) == 2:
            space = 2  # which they do not leave
        points = flatten_points(slots, space)[0]
        ends = spectrum(points, edges, masses) if len(slots) <= LANCZOS else None
        return replace(check, spectrum=ends)
    rigidity = analyse(slots, edges, masses=masses, dimension=space)
    check = replace(check, rigidity=rigidity)
    endless = rigidity.own.rigidity_class is RigidityClass.FLEXIBLE  # a continuum of other shapes
    if not search or endless or distance_mismatch_in_words(mission, name):
        return check
    start, space = mission.agents.position, rigidity.own.space
    others = realisations(slots, edges, starts=STARTS, start=start, dimension=space)
    return replace(check, realisations=others)


def _formation_control(mission: Mission, name: str) -> HeldBy:
    """What holds a formation in the phases that have it."""
    now, tracks = None, set()
    for phase in mission.phases:
        now = phase.shaping.formation if phase.shaping is not None else now
        tracks |= {phase.tracks_slots} if now == name else set()
    if not tracks:
        return "nothing"
    return "tracking" if all(tracks) else "distances"


def distance_mismatch_in_words(mission: Mission, name: str) -> str:
    """Whose given distance differs most from that of their slots, and by how much; "" within tolerance."""
    slots, edges = mission.formation_slots(name), mission.formation_edges(name)
    if slots is None or not len(edges):
        return ""
    lengths = mission.formation_distances(name)
    error = np.abs(distance_geometry.distances(slots, edges) - lengths)
    worst = int(error.argmax())
    if error[worst] <= mission.formations[name].greatest_error(lengths.min()):
        return ""
    i, j = edges[worst] + 1
    return (
        f"'{name}' will have another shape than its slots: agents {i} and {j} are given {lengths[worst]:.4g} m, which"
        f" differs from that of their slots by {error[worst]:.3g} m"
    )


def formation_remarks(mission: Mission, formations: list[FormationCheck]) -> Iterator[Remark]:
    """Remarks on formations that are not rigid, contradict themselves, or share their distances with other shapes."""
    exact = mission.constraint.solver == "exact"
    if skipped := [f.name for f in formations if f.skipped]:
        yield _note(f"to limit the time of the check, {names_with_verb(skipped)} skipped")
    if idle := [f.name for f in formations if f.held_by == "nothing"]:
        yield _note(f"{names_with_verb(idle)} not used in any phase")
    yield from _flat_start_remarks(mission)
    soft = {
        f.name
        for f in formations
        if f.rigidity is not None and f.held_by == "distances"
        and (f.rigidity.rigidity_class is RigidityClass.FLEXIBLE or f.rigidity.space < 3)
    }  # fmt: skip
    forecasts = _soft_formation_forecasts(mission, soft)
    for f in formations:
        if f.held_by == "nothing":
            continue
        alone = f.held_by == "distances"
        if words := distance_mismatch_in_words(mission, f.name):
            yield _fails(words)
        r = f.rigidity
        if f.spectrum is not None:
            if f.spectrum.free:
                text = f"'{f.name}' is flexible to first order: at least {f.spectrum.free} motions are free"
                held = ". Add edges, or track slots" if alone else "; slots hold it"
                yield (_fails if alone else _note)(text + held)
            continue
        if r is None:
            if alone and not len(mission.formation_edges(f.name)):
                yield _note(
                    f"'{f.name}' has no edges: only slots or a force of your own (simulate) form it"
                )
            elif mission.formation_slots(f.name) is None:  # else it has no edges, or is too large
                text = f"the distances of '{f.name}' do not determine positions: its rigidity is not checked"
                yield _note(text)
            continue
        if r.rigidity_class is RigidityClass.FLEXIBLE or f.name in soft:
            yield from _flex_remarks(f.name, r, forecasts.get(f.name))
        elif r.rigidity_class is RigidityClass.UNDECIDED and alone:
            yield _note(f"'{f.name}' is undecided: {r.reason}")
        elif r.rigidity_class is RigidityClass.PRESTRESS_STABLE and alone:
            where = "line" if r.dimension == 1 else "plane"
            across = f" across its {where}" if r.dimension < 3 else ""
            text = f"'{f.name}' is only prestress stable{across}; tracked slots hold it firmly"
            yield _note(text)
        if exact and alone and len(r.edges) > r.rank:
            yield _fails(
                f"solver 'exact' has no solution at '{f.name}': only {r.rank} of its {len(r.edges)} distances are"
                " independent. Use solver = 'iterated'"
            )
        yield from _realisation_remarks(mission, f, alone=alone)


def _dimension_spanned(points: Floats, *moves: Floats) -> int:
    """Dimension of the space that points and movements (N, 3) about their means keep to."""
    x = np.vstack([centred(points), *moves, *(-move for move in moves)])
    return distance_geometry.dimension(x)


def _flat_start_remarks(mission: Mission) -> Iterator[Remark]:
    """Remark on agents that start on a line or in a plane, which forces along their edges cannot move them off."""
    unequal, moves = len(set(mission.agents.mass)) > 1, [centred(mission.fleet.velocity)]
    formed = turned = False
    for phase in mission.phases:
        formed |= phase.shaping is not None
        if phase.control != "open":
            if formed:
                return  # slots lead anywhere
            turned |= "attitude" in phase.commanded_at_arrival
            continue
        # Equal forces accelerate unequal masses differently.
        moves.append(unequal * np.array([phase.input_force]))
        name = None if phase.shaping is None else phase.shaping.formation
        if name is not None and not len(mission.formation_edges(name)):
            return  # no forces between agents
        slots = mission.slots_about_cm(name)
        start = _dimension_spanned(mission.fleet.position, *moves)
        if slots is None or start >= _dimension_spanned(slots):
            continue
        # Where they share coordinates, not even rounding moves them off.
        shared = ~np.ptp([mission.fleet.position, moves[0]], axis=1).any(axis=0)
        sure = not turned and (shared & ~np.any(moves[1:], axis=(0, 1))).sum() >= 3 - start
        sure &= mission.disturbances is None and mission.vehicle_models is None
        text = f"all agents start on one {WHERE[start]}; forces between them cannot move them off it to '{name}'"
        text += f". Move one agent off the {WHERE[start]}, or use control = 'tracking' in '{phase.name}'"
        yield (_fails if sure else _note)(text)
        return


def _soft_formation_forecasts(mission: Mission, soft: set[str]) -> dict[str, tuple[int, float]]:
    """What becomes of some formations that distances alone hold, if only forces along their edges move the agents.

    By name: the greatest dimension of the space that the agents keep to, and the greatest error of a pair at the end of
    a phase, as a share of the one from which on the shape is sure to be missed.
    """
    out: dict[str, tuple[int, float]] = {}
    name, unequal = None, len(set(mission.agents.mass)) > 1
    r, v = mission.fleet.position, centred(mission.fleet.velocity)
    for phase in mission.phases:
        name = phase.shaping.formation if phase.shaping is not None else name
        slots = mission.slots_about_cm(name)
        if name is None or slots is None:
            continue
        if not phase.tracks_slots and name in soft:
            # The paper's matrix H shares weights equally among unequal masses, and tears the shape.
            torn = phase.leads_body and unequal and mission.allocation.method == "pinv"
            space = 3 if torn else _dimension_spanned(r, v, unequal * np.array([phase.input_force]))
            pairs = complete_graph(len(r))
            apart = distance_geometry.distances(slots, pairs)
            edges, lengths = mission.formation_edges(name), mission.formation_distances(name)
            end = None if torn else deform_to_lengths(r, edges, lengths, 1e-6 * apart.min(), slots)
            most = _SURELY["shape" if phase.shaping is None else phase.shaping.reference]
            most *= mission.formations[name].greatest_error(apart.min())
            off, before = np.inf, out.get(name, (0, 0.0))
            if end is not None:
                slots = end
                off = np.abs(distance_geometry.distances(end, pairs) - apart).max() / most
            out[name] = max(before[0], space), max(before[1], off)
        r, v = slots, 0 * v
    return out


def _flex_remarks(name: str, r: Rigidity, forecast: tuple[int, float] | None) -> Iterator[Remark]:
    """Remark on a formation that is flexible or in a plane; the forecast is None where slots hold it."""
    who = first_few([agent_names(flex.agents) for flex in r.flexes], 4, "; ")
    text = f"'{name}' is flexible: {r.rank} of {r.needed} independent distances; free: {who}"
    if not r.flexes:
        text = f"'{name}' has dimension = 2, but its agents leave their plane"
    level, held = "note", "; slots hold it"
    if forecast is not None:
        held = "; nothing but tracked slots resists gusts, unequal weights and lags"
        if r.own.rigid and forecast[0] <= r.own.space < 3:
            if r.space < 3:  # as the mission says
                return
            text += f". It is rigid in its {WHERE[r.own.space]}, which its forces do not leave"
        elif forecast[1] <= 1.0:
            text += ". Distances lead it to its shape"
        else:
            text += ". Distances lead it past its shape"
            level, held = "fails", ". Add edges (rigidfleet design), or track slots"
    yield Remark(level, "formation", text + held)


def _realisation_remarks(mission: Mission, f: FormationCheck, *, alone: bool) -> Iterator[Remark]:
    """Remarks on other shapes with the same distances, if distances alone guide the agents."""
    others = f.realisations
    if others is None or not alone:
        return
    start, slots = mission.fleet.position, mission.formation_slots(f.name)
    first, by = mission.phases[0].establishing, None
    if first is not None and first.formation == f.name:
        by = reference_kind(mission, first, start, slots)
    end = None if others.leads_to is None else others.shapes[others.leads_to].kind
    if by == "shape" and slots is not None and _become_coplanar(start, slots):
        yield _note(
            f"the agents start with the handedness of the mirror image of '{f.name}' and must pass through a plane,"
            " where distances alone may return them to the mirror image. Swap two slots or track slots"
        )
    elif by in ("squares", "step") and end not in (None, Kind.SAME):
        yield _note(
            f"from the start positions, the distances of '{f.name}' lead to another shape ({end})"
        )
    elif not others.unique:
        rest = [r for r in others.shapes if r.kind not in (Kind.SAME, Kind.MIRRORED)]
        n, share, bent = len(rest), sum(r.starts for r in rest), sum(r.bends for r in others.shapes)
        families = f", {bent} as a family that bends" * (bent > 0)
        what = "1 other shape has" if n == 1 else f"{n} other shapes have"
        yield _note(
            f"{what} the distances of '{f.name}'{families}; {share} of {others.starts} random starts reach"
            f" {'it' if n == 1 else 'them'}. Redundant edges or tracked slots prevent this"
        )


def _become_coplanar(start: Floats, slots: Floats) -> bool:
    """Whether straight paths of four agents from a start to spatial slots (4, 3) pass through a plane."""
    if len(slots) != 4 or distance_geometry.dimension(slots) < 3:
        return False
    return bool(np.linalg.det((start[1:] - start[0]).T @ (slots[1:] - slots[0])) < 0)
