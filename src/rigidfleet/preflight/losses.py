"""What follows from the losses of a mission: the planned way of those left, and the rigidity without lost links."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from rigidfleet.math import proximity
from rigidfleet.mission import Mission
from rigidfleet.planning.legs import Leg
from rigidfleet.planning.losses import Answer, answer_to_loss
from rigidfleet.planning.plan_path import plan_path
from rigidfleet.planning.preview import (
    FEWEST_SAMPLES,
    PlannedPhase,
    sample_leg,
    samples_per_phase,
)
from rigidfleet.planning.reference import copy_with
from rigidfleet.planning.wrecks import fall_uncertainty, wrecks_of
from rigidfleet.preflight.findings import DENSE, Preflight, Remark
from rigidfleet.preflight.obstacles import area_remarks, obstacle_remarks
from rigidfleet.preflight.offsets import steady_offset_remarks
from rigidfleet.preflight.trajectory import downwash_remarks, limit_remarks, separation_remarks
from rigidfleet.rigidity import analyse


def parts_before_and_after_loss(
    mission: Mission, planned: Sequence[PlannedPhase]
) -> tuple[list[PlannedPhase], list[PlannedPhase]]:
    """Planned phases up to when the flight leaves its plan, and those after it, which are not flown."""
    first = mission.abandons_at
    if mission.aborts and mission.aborting.agents:  # the others fly it to its end
        return list(planned), []
    flown = [x for x in planned if x.leg.end <= first]
    rest = [x for x in planned if x.leg.start >= first]
    if cut := [x for x in planned if x.leg.start < first < x.leg.end]:
        for part, k, ends in (flown, len(flown), {"end": first}), (rest, 0, {"start": first}):
            leg = copy(cut[0].leg)
            vars(leg).update(ends)  # its motion stays
            part.insert(k, replace(sample_leg(leg, len(cut[0].time)), path_ends=None))
    return flown, rest


def loss_remarks(
    mission: Mission, preflight: Preflight, rest: list[PlannedPhase]
) -> Iterator[Remark]:
    """Remarks on lost links, and on the way of those left after the first loss.

    The ``rest`` of the planned phases is not flown: notes say what would fail.
    """
    yield from _lost_link_remarks(mission)
    first = mission.abandons_at
    if not np.isfinite(first):
        return
    for remark in _path_remarks(mission, preflight, rest):
        if remark.level == "fails":
            text = f"{remark.text}. The flight leaves its plan before, at {first:g} s"
            yield Remark("note", remark.topic, text)
    legs = [phase.leg for phase in preflight.planned_phases]
    at = next((x for x in legs if x.start < first <= x.end), None)
    ordered = mission.aborts and mission.on_loss == "continue"
    if at is None:
        what = "the abort may begin" if ordered else f"{mission.first_lost} may be lost"
        text = f"{what} after the planned paths, at {first:g} s: what follows is not checked"
        yield Remark("note", "loss", text)
        return
    way, problem, _ = planned_answer_to_loss(mission, at, legs)
    does = "hold to" if mission.on_loss == "hold" or problem else "land by"
    what = "the order to abort" if ordered else f"the loss of {mission.first_lost}"
    if problem:
        yield Remark("fails", "loss", f"no way home is proved after {what}: {problem}")
    if not way:  # nobody leaves the plan
        return
    place = ", ".join(f"{x:.1f}" for x in way[0].planned_end_state.r.mean(axis=0))
    text = (
        f"after {what} at {first:g} s, in '{at.phase.name}', the others brake to rest about"
        f" ({place}) m by {way[0].end:.1f} s, and {does} {way[-1].end:.1f} s"
    )
    yield Remark("note", "loss", text)
    most = max(samples_per_phase(mission), FEWEST_SAMPLES)
    phases = [sample_leg(x, most) for x in way]
    yield from _path_remarks(mission, preflight, phases)
    # Where the loss comes after a phase that ends by settling, where it falls is an estimate.
    sure = all(x.phase.settle is None for x in legs if x.start < first)
    yield from _wreck_remarks(mission, legs, phases, sure=sure)
    for remark in steady_offset_remarks(mission, preflight, phases):
        yield remark if sure else replace(remark, level="note")


def _path_remarks(
    mission: Mission, preflight: Preflight, planned: list[PlannedPhase]
) -> Iterator[Remark]:
    """Remarks on the paths of phases that are planned beside those of the flight."""
    part = Preflight(mission, preflight.formations, preflight.gains, planned, planned)
    for judge in (
        separation_remarks, downwash_remarks, obstacle_remarks, area_remarks, limit_remarks,
    ):  # fmt: skip
        yield from judge(mission, part)


def _wreck_remarks(
    mission: Mission, legs: Sequence[Leg], way: Sequence[PlannedPhase], *, sure: bool
) -> Iterator[Remark]:
    """Remarks on those left who hit a lost vehicle that falls or lies, at samples of the way after the loss."""
    lost = mission.lost_at <= mission.abandons_at
    if not lost.any():
        return
    wrecks, left = wrecks_of(mission, plan_path(legs), lost), np.flatnonzero(~lost)
    radius = mission.fleet.radius[left] - fall_uncertainty(mission).max()
    for planned in way if wrecks else ():
        r, time = planned.position[:, left], planned.time
        room, near = proximity.obstacle_clearances(r, radius, wrecks, time)
        k, i = np.unravel_index(int(room.argmin()), room.shape)
        if room[k, i] < 0.0:
            hits, wreck = "hits" if sure else "may hit", wrecks[int(near[k, i])].name
            text = f"agent {left[i] + 1} {hits} '{wreck}' at {time[k]:.2f} s in '{planned.phase}'"
            yield Remark("fails" if sure else "note", "loss", text)


def planned_answer_to_loss(mission: Mission, at: Leg, legs: Sequence[Leg]) -> Answer:
    """What follows the first loss, or an order to abort, in the leg ``at`` of the planned ones."""
    when = mission.abandons_at
    lost = mission.lost_at <= when
    now = copy_with(at.state_at(when), lost=lost)
    return answer_to_loss(mission, now, lambda: legs)


def _lost_link_remarks(mission: Mission) -> Iterator[Remark]:
    """Remarks on the rigidity of each formation without the edges of lost links."""
    pairs, times = mission.links_lost
    if not len(pairs):
        return
    links = ", ".join(f"{i + 1}-{j + 1} at {t:g} s" for (i, j), t in zip(pairs, times, strict=True))
    used = {p.shaping.formation for p in mission.phases if p.shaping is not None}
    for name in mission.formations:
        slots, edges = mission.formation_slots(name), mission.formation_edges(name)
        kept = edges[mission.has_link(edges, np.inf)]
        head = f"without the lost links ({links}), '{name}'"
        if name not in used or slots is None:
            continue
        if len(kept) == len(edges):
            text = f"{head} keeps all of its edges"
        elif min(len(edges), 3 * mission.n_agents) > DENSE:
            text = f"{head} has {len(kept)} of {len(edges)} edges; it is too large to check its rigidity"
        elif not len(kept):
            text = f"{head} has no edges; slots alone hold it"
        else:
            before, after = (analyse(slots, x, masses=mission.agents.mass) for x in (edges, kept))
            text = (
                f"{head} has {len(kept)} of {len(edges)} edges: {before.rigidity_class.value} before,"
                f" {after.rigidity_class.value} after, with {after.rank} of {after.needed} independent distances"
            )
            text += "" if after.rigid else "; slots alone hold the rest"
        yield Remark("note", "loss", text)
