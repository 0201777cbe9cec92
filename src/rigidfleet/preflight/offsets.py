"""How far steady disturbances hold vehicles off their slots, and the limits that are then not kept.

What no law knows of the forces - wind, jets of vehicles above, drag that is not fed forward, errors of mass - is taken
along the planned paths. The tracking answers to it as a linear system, and of the motions that edges hold, the
constraint law. Gusts and noise are left out: they have no mean.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from rigidfleet._common.waypoints import PAD, UNITS, WAYPOINT_TOLERANCE
from rigidfleet.math import attitude as att
from rigidfleet.math import proximity, rigid_body
from rigidfleet.math.margins import constraint_filter_matrix
from rigidfleet.math.pid import matrix_exponential
from rigidfleet.mission import Mission
from rigidfleet.planning.preview import PlannedPhase
from rigidfleet.planning.reference import copy_with
from rigidfleet.planning.vehicles import drag_and_lift, pair_jet_speeds
from rigidfleet.preflight.avoidance import is_left_to_avoidance
from rigidfleet.preflight.findings import DENSE, Preflight, Remark
from rigidfleet.preflight.margins import phase_gains
from rigidfleet.preflight.obstacles import area_remarks, obstacle_remarks
from rigidfleet.preflight.trajectory import downwash_remarks, measured_remarks, separation_remarks
from rigidfleet.preflight.vehicles import STACKED
from rigidfleet.typing import Floats

#: Share of an offset from which a limit that it breaks is sure to be.
_SURE = 0.9
#: Offsets that do not count [m], and those of an unstable law, from which no place can be told.
_LEAST, _UNBOUNDED = 1e-4, 1e3
#: Shapes of a phase at which it is computed what edges hold.
_SHAPES = 16
#: Share of the damping with which motions count as held: by its integral, the law holds in the end what it holds a bit.
_SMALL = 0.05
#: What a phase promises for its arrival and its end; one that is abandoned promises nothing.
_AT_END = ("waypoint", "attitude", "formation", "settle", "landing")


def sampled_tracking_offsets(mission: Mission, way: list[PlannedPhase]) -> list[Floats]:
    """Offsets (K, N, 3) [m] of the vehicles from their slots in each planned phase; zeros where none are tracked."""
    tracked = [planned.leg.phase.tracks_slots for planned in way]
    pushes = [
        _unmodelled_accelerations(mission, planned) if one else np.zeros_like(planned.position)
        for planned, one in zip(way, tracked, strict=True)
    ]
    if not any(pushed.any() for pushed in pushes):
        return pushes
    law = phase_gains(mission, None, None)
    laws = np.zeros((2, 4, 4))  # of the integral, the offset, its rate and a held force
    laws[:, 0, 1] = laws[:, 1, 2] = laws[:, 2, 3] = 1.0
    laws[0, 2, :3] = -law.ki, -law.k1, -law.k2
    laws[1, 2, :3] = -law.gamma, -(law.beta**2), -2.0 * law.alpha
    now, by_phase = np.zeros((2, 3, 3 * mission.n_agents)), []
    for planned, pushed, one in zip(way, pushes, tracked, strict=True):
        if not one:
            now = np.zeros_like(now)
            by_phase.append(pushed)
            continue
        flat = pushed.reshape(len(pushed), -1)
        steps = matrix_exponential(laws, np.diff(planned.time[:2]))
        answers = np.empty((len(flat), 2, flat.shape[1]))
        for k, push in enumerate(flat):
            answers[k] = now[:, 1]
            now = steps[:, :3, :3] @ now + steps[:, :3, 3:] * push
        by_phase.append(_offsets_of_both_laws(mission, planned, pushed, answers))
    return by_phase


def _unmodelled_accelerations(mission: Mission, planned: PlannedPhase) -> Floats:
    """Acceleration (K, N, 3) [m/s^2] by forces that no law knows."""
    d, v, mass = mission.all_disturbances, planned.velocity, mission.fleet.mass[:, None]
    up = np.array([0.0, 0.0, 1.0])
    air = np.array(d.wind)
    if d.downwash and mission.n_agents <= STACKED:
        jets = pair_jet_speeds(mission, planned.position)
        jets[np.broadcast_to((planned.time[:, None] > mission.lost_at)[:, None], jets.shape)] = 0.0
        air = air - jets.sum(axis=2)[..., None] * up
    force = drag_and_lift(mission, air - v)
    if mission.tracking.drag_feedforward:
        known = drag_and_lift(mission, -v)
        force -= known * [1.0, 1.0, 0.0] + drag_and_lift(mission, -v * up) * up
    force -= (mission.true_mass[:, None] - mass) * (planned.acceleration + mission.gravity * up)
    return force / mass


def _offsets_of_both_laws(
    mission: Mission, planned: PlannedPhase, pushed: Floats, answers: Floats
) -> Floats:
    """Offsets (K, N, 3) of the tracking (K, 0, 3N), but of the constraint law (K, 1, 3N) in what edges hold."""
    free = answers[:, 0].reshape(pushed.shape)
    name, masses = planned.leg.planned_end_state.formation, mission.fleet.mass
    if name is None or np.ptp(pushed, axis=1).max() < 1e-9:
        return free
    edges = mission.formation_edges(name)
    if max(len(edges), 3 * len(masses)) > DENSE:  # as a whole, at least
        return np.broadcast_to((masses @ free / masses.sum())[:, None], free.shape)
    law, root = phase_gains(mission, planned.leg.phase, name), np.repeat(np.sqrt(masses), 3)
    law = replace(law, damping=_SMALL * law.damping)
    for part in np.array_split(np.arange(len(free)), _SHAPES):
        S = constraint_filter_matrix(planned.position[part[len(part) // 2]], edges, masses, law)
        mixed = answers[part, 0] + (answers[part, 1] - answers[part, 0]) * root @ S / root
        free[part] = mixed.reshape(-1, *free.shape[1:])
    return free


def steady_offset_remarks(
    mission: Mission, preflight: Preflight, answer: Sequence[PlannedPhase] = ()
) -> Iterator[Remark]:
    """Remarks on limits that steady offsets break: the flight will fail if nine tenths of an offset do.

    Where all of it does, a note. Limits that the plan itself breaks are told elsewhere. Gusts of two standard
    deviations may make up for an offset. With the phases of the ``answer`` to a loss or an abort, on these alone.
    """
    remarks: dict[tuple[str, bool], Remark] = {}
    gusts = 0.0 if preflight.disturbed is None else preflight.disturbed.gusts
    gusts *= 2.0 / 3.0 / (mission.tracking_gains[0] * float(mission.fleet.mass.min()))
    before = [x for x in preflight.flown_phases if x.leg.start < mission.abandons_at]
    way, remedy, sure = [*before, *answer], "", True
    end = [x.leg.end for x in answer or preflight.planned_phases][-1:]
    if not mission.tracking.integral:
        remedy = f"; tracking has no integral: raise the first weight in tracking.Q (now {mission.tracking.Q[0]:g})"
        remedy += ", or set tracking.integral" if mission.vehicle_models is not None else ""
    judged = answer or before
    offsets = sampled_tracking_offsets(mission, way)[-len(judged) :]
    for phase, every in zip(judged, offsets, strict=True):
        drift = _drift(mission, phase) if phase.leg.phase.control == "open" else 0.0
        if drift > WAYPOINT_TOLERANCE["position"]:
            text = f"nothing holds '{phase.phase}' against steady disturbances, which carry it about {drift:.2g} m off"
            text += " its planned paths, as control = 'open': what follows begins there, and its start is not foreseen"
            yield Remark("note", "disturbances", text)
            sure = False
        planned, whole = _planned_for_those_left(mission, phase)
        off = np.where(planned.leg.before.lost[:, None], 0.0, every)
        far = float(np.linalg.norm(off, axis=2).max())
        if far < _LEAST:
            continue
        last = planned.leg.end in end
        broken = partial(_broken_limits_in_words, mission, preflight, planned, last)
        if not (now := broken(off)):
            continue
        own, surely = broken(0.0 * off), broken(max(0.0, _SURE - gusts / far) * off)
        abandoned = planned.leg.start < mission.abandons_at < planned.leg.t_end
        for topic in now:
            if topic in own or (abandoned and topic in _AT_END):
                continue
            evaded = is_left_to_avoidance(mission, topic, mission.limits.separation or 0.0)
            # Near the ground, rotors give more thrust than is known here.
            evaded |= planned.leg.phase.lands and mission.all_disturbances.ground_effect
            fails = sure and planned.exact and whole and topic in surely and not evaded
            text = f"steady disturbances push vehicles up to {far:.2g} m off their slots in '{planned.phase}'"
            remark = Remark("fails" if fails else "note", topic, f"{text}: {now[topic]}{remedy}")
            remarks.setdefault((topic, fails), remark)
        # One that does not settle ends the flight, or waits for what abandons it.
        sure = sure and "settle" not in now
    yield from remarks.values()


def _drift(mission: Mission, planned: PlannedPhase) -> float:
    """How far [m] steady forces have carried the centre of mass off its way at the end of a phase without feedback."""
    masses, step = mission.fleet.mass, float(planned.time[1] - planned.time[0])
    x, v = np.zeros((2, 3))
    for push in masses @ _unmodelled_accelerations(mission, planned) / masses.sum():
        v += step * (push - mission.drag.sum() / masses.sum() * v)
        x += step * v
    return float(np.linalg.norm(x))


def _planned_for_those_left(mission: Mission, planned: PlannedPhase) -> tuple[PlannedPhase, bool]:
    """A planned phase without those who are lost by its end, and whether none is lost on the way."""
    leg, lost = planned.leg, mission.lost_at < planned.leg.end
    if not lost.any():
        return planned, True
    leg = copy_with(leg, before=copy_with(leg.before, lost=lost))
    vars(leg).pop("certificate", None)  # that is of all vehicles
    return replace(planned, leg=leg), bool((mission.lost_at[lost] <= leg.start).all())


def _broken_limits_in_words(
    mission: Mission, preflight: Preflight, planned: PlannedPhase, last: bool, offsets: Floats
) -> dict[str, str]:
    """Topic and words of the limits that a planned phase, perhaps the last, breaks with offsets (K, N, 3) [m]."""
    leg, phase, limits = planned.leg, planned.leg.phase, mission.limits
    left, r, far = ~leg.before.lost, planned.position + offsets, np.linalg.norm(offsets, axis=2)
    masses = np.where(left, mission.fleet.mass, 0.0)
    moved = replace(planned, position=r, path_ends=None)
    there = Preflight(mission, preflight.formations, preflight.gains, [moved], [moved])
    remarks = [*separation_remarks(mission, there), *downwash_remarks(mission, there)]
    remarks += [*measured_remarks(mission, moved), *obstacle_remarks(mission, there)]
    if far.max() < _UNBOUNDED:
        remarks += area_remarks(mission, there)
    broken = {remark.topic: remark.text for remark in remarks if remark.level == "fails"}
    proved, least = leg.certificate, there.separation
    if proved is not None and least is not None:
        nearer = proved.separation - least[0]
        if nearer > limits.separation_allowance:
            broken["collision"] = f"{least[2]} come {nearer:.2f} m nearer than the plan proves"
    arrival = min(int(np.searchsorted(planned.time, leg.arrival)), len(r) - 1)
    held = [("tracking error", "", float(far.max()), limits.tracking_error)]
    # As `PhasePlan.target_record` and `PhasePlan.end_state_record` promise.
    stays, later = "position" not in phase.commanded_at_arrival, arrival < len(r) - 1
    places = [("waypoint", arrival)] * (not stays)
    places += [("its place at the end", -1)] * (stays or (later and not phase.has_free_velocity))
    way = masses @ planned.position / masses.sum()
    for n, at in enumerate(phase.points, start=1):
        places.append(
            (f"point {n} on the way", int(np.linalg.norm(way - at.position, axis=1).argmin()))
        )
    for place, k in places:
        by = float(np.linalg.norm(masses @ offsets[k]) / masses.sum())
        by = by if leg.planned_end_state.formation else max(by, float(far[k].max()))
        held.append(("waypoint", place, by, WAYPOINT_TOLERANCE["position"]))
    forms, turns = phase.establishing is not None, "attitude" in phase.commanded_at_arrival
    lies, goal = forms and not mission.leaves_attitude_free(phase), leg.planned_end_state.goal
    kept = stays and not forms and goal is not None and goal.named
    for k in [arrival] * (lies or turns) + [-1] * (later if turns else kept):
        turn = rigid_body.kabsch(r[k], planned.position[k], masses, near=np.eye(3))
        by = float(np.degrees(np.linalg.norm(att.rotation_vector_from_dcm(turn))))
        held.append(("attitude", "", by, WAYPOINT_TOLERANCE["attitude"]))
    name = leg.planned_end_state.formation
    if name and (phase.shaping is not None or last) and left.sum() > 1 and len(left) <= STACKED:
        # To first order: a turn of the whole changes no distance.
        i, j = np.flatnonzero(left)[proximity.all_pairs(int(left.sum()))]
        apart = planned.position[-1, i] - planned.position[-1, j]
        moved = offsets[-1, i] - offsets[-1, j]
        length = np.linalg.norm(apart, axis=1)
        by = float(np.abs((apart * moved).sum(axis=1) / length).max())
        held.append(("formation", "", by, mission.formations[name].greatest_error(length.min())))
    if phase.settle is not None and not mission.tracking.integral:  # which settles later
        held.append(("settle", "", float(far[-1].max()), phase.settle.tolerance))
    if phase.lands:
        high, _ = proximity.obstacle_clearances(r[-1], leg.radius, mission.obstacles, leg.end)
        by = float(high[left].min())
        held.append(("landing", "the lowest vehicle above the ground", by, PAD))
    for topic, what, by, most in held:
        if most is not None and by > most:
            unit = UNITS.get(topic, "m")
            broken[topic] = f"{what or topic}: {by:.2g} {unit} off (limit {most:g} {unit})"
    return broken
