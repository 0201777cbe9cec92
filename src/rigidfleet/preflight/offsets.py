"""How far steady disturbances hold vehicles off their slots, and the limits that are then not kept.

What no law knows of the forces - wind, jets of vehicles above, drag that is not fed forward, errors of mass - is taken
along the planned paths. The tracking answers to it as a linear system, and of the motions that edges hold, the
constraint law. Gusts and noise are left out: they have no mean.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.linalg import expm

from rigidfleet._common.waypoints import WAYPOINT_TOLERANCE
from rigidfleet.math import attitude as att
from rigidfleet.math import proximity, rigid_body
from rigidfleet.math.margins import shares
from rigidfleet.mission import Mission
from rigidfleet.mission.kinds import Fly
from rigidfleet.planning.preview import PlannedPhase
from rigidfleet.planning.vehicles import air_force, jets
from rigidfleet.preflight.findings import DENSE, Preflight, Remark
from rigidfleet.preflight.margins import feedback
from rigidfleet.preflight.obstacles import obstacle_remarks
from rigidfleet.preflight.trajectory import downwash_remarks, geofence_remarks, separation_remarks
from rigidfleet.preflight.vehicles import STACKED
from rigidfleet.typing import Floats

#: Share of an offset from which a limit that it breaks is sure to be, and multiple up to which one is near.
_SURE, _NEAR = 0.9, 1.25
#: Offsets that do not count [m].
_LEAST = 1e-4
#: Shapes of a phase at which it is computed what edges hold.
_SHAPES = 16
#: Share of the damping with which motions count as held: by its integral, the law holds in the end what it holds a bit.
_SMALL = 0.05


def offsets(mission: Mission, way: list[PlannedPhase]) -> list[Floats]:
    """Offsets (K, N, 3) [m] of the vehicles from their slots in each planned phase; zeros where none are tracked."""
    (k1, k2), c = mission.tracking_gains, mission.constraint
    on = float(c.stabilisation == "pid")
    laws = np.zeros((2, 4, 4))  # of the integral, the offset, its rate and a held force
    laws[:, 0, 1] = laws[:, 1, 2] = laws[:, 2, 3] = 1.0
    laws[0, 2, :3] = -mission.tracking.integral, -k1, -k2
    laws[1, 2, :3] = -on * c.gamma, -on * c.beta**2, -on * 2.0 * c.alpha
    now, found = np.zeros((2, 3, 3 * mission.n_agents)), []
    for planned in way:
        if planned.leg.phase.control != "tracking":
            now = np.zeros_like(now)
            found.append(np.zeros_like(planned.position))
            continue
        pushed = _pushed(mission, planned)
        flat, steps = pushed.reshape(len(pushed), -1), expm(laws * np.diff(planned.time[:2])[0])
        answers = np.empty((len(flat), 2, flat.shape[1]))
        for k, push in enumerate(flat):
            answers[k] = now[:, 1]
            now = steps[:, :3, :3] @ now + steps[:, :3, 3:] * push
        found.append(_held(mission, planned, pushed, answers))
    return found


def _pushed(mission: Mission, planned: PlannedPhase) -> Floats:
    """Acceleration (K, N, 3) [m/s^2] by forces that no law knows."""
    d, v, mass = mission.disturbances, planned.velocity, mission.fleet.mass[:, None]
    air, up = np.zeros(3), np.array([0.0, 0.0, 1.0])
    if d is not None:
        air = air + np.array(d.wind)
        if d.downwash and mission.n_agents <= STACKED:
            air = air - jets(mission, planned.position).sum(axis=2)[..., None] * up
    force = air_force(mission, air - v)
    if mission.tracking.drag_feedforward:
        known = air_force(mission, -v)
        force -= known * [1.0, 1.0, 0.0] + air_force(mission, -v * up) * up
    force -= (mission.true_mass[:, None] - mass) * (planned.acceleration + mission.gravity * up)
    return force / mass


def _held(mission: Mission, planned: PlannedPhase, pushed: Floats, answers: Floats) -> Floats:
    """Offsets (K, N, 3) of the tracking (K, 0, 3N), but of the constraint law (K, 1, 3N) in what edges hold."""
    free = answers[:, 0].reshape(pushed.shape)
    name, masses = planned.leg.after.formation, mission.fleet.mass
    edges = mission.formation_edges(name) if name else np.zeros((0, 2), dtype=np.int64)
    if not len(edges) or np.ptp(pushed, axis=1).max() < 1e-9:
        return free
    if max(len(edges), 3 * len(masses)) > DENSE:  # as a whole, at least
        return np.broadcast_to((masses @ free / masses.sum())[:, None], free.shape)
    law, root = feedback(mission, planned.leg.phase, name), np.repeat(np.sqrt(masses), 3)
    law = replace(law, damping=_SMALL * law.damping)
    for part in np.array_split(np.arange(len(free)), _SHAPES):
        S = shares(planned.position[part[len(part) // 2]], edges, masses, law)
        mixed = answers[part, 0] + (answers[part, 1] - answers[part, 0]) * root @ S / root
        free[part] = mixed.reshape(-1, *free.shape[1:])
    return free


def offset_remarks(mission: Mission, found: Preflight) -> Iterator[Remark]:
    """Remarks on limits that steady offsets break: the flight will fail if nine tenths of an offset do.

    Where a quarter more would break one, a note. Limits that the plan itself breaks are told elsewhere. Gusts of two
    standard deviations may make up for an offset.
    """
    told: dict[str, Remark] = {}
    gusts = 0.0 if found.disturbed is None else found.disturbed.gusts
    gusts *= 2.0 / 3.0 / (mission.tracking_gains[0] * float(mission.fleet.mass.min()))
    way = found.planned_phases
    for planned, off in zip(way, offsets(mission, way), strict=True):
        far = float(np.linalg.norm(off, axis=2).max())
        if planned.leg.end > mission.first_loss or far < _LEAST:
            continue
        broken = partial(_broken, mission, found, planned, last=planned is way[-1])
        if not (near := dict(broken(_NEAR * off))):
            continue
        own, now = dict(broken(0.0 * off)), dict(broken(off))
        surely = dict(broken(max(0.0, _SURE - gusts / far) * off))
        for topic in (topic for topic in near if topic not in own):
            evaded = mission.avoidance is not None and topic in ("collision", "obstacle")
            fails = planned.exact and topic in surely and not evaded
            text = f"steady disturbances push vehicles up to {far:.2g} m off their slots in '{planned.phase}': "
            text += now.get(topic) or f"a quarter more, and {near[topic]}"
            if topic not in told or (fails and told[topic].level != "fails"):
                told[topic] = Remark("fails" if fails else "note", topic, text)
    yield from told.values()


def _broken(
    mission: Mission, found: Preflight, planned: PlannedPhase, off: Floats, *, last: bool
) -> Iterator[tuple[str, str]]:
    """Topic and words of the limits that a planned phase breaks with offsets (K, N, 3) [m]."""
    leg, phase, limits = planned.leg, planned.leg.phase, mission.limits
    masses, tolerance = mission.fleet.mass, WAYPOINT_TOLERANCE
    r = planned.position + off
    there = Preflight(found.formations, found.gains, [replace(planned, position=r, path_ends=None)])
    remarks = [*separation_remarks(mission, there), *downwash_remarks(mission, there)]
    remarks += geofence_remarks(mission, there.planned_phases[0])
    if not phase.lands:  # that ends where vehicles stand
        remarks += obstacle_remarks(mission, there)
    yield from ((remark.topic, remark.text) for remark in remarks if remark.level == "fails")
    proved, least = planned.certificate, there.separation
    if proved is not None and least is not None:
        nearer = proved.separation - least[0]
        if nearer > limits.separation_allowance:
            yield "collision", f"{least[2]} come {nearer:.2f} m nearer than the plan proves"
    far = np.linalg.norm(off, axis=2)
    arrival = min(int(np.searchsorted(planned.time, leg.arrival)), len(r) - 1)
    # As `Plan.target` and `Plan.stay` promise.
    stays, later = "position" not in phase.meets, arrival < len(r) - 1
    places = [("its waypoint", arrival)] * (not stays)
    places += [("its place at the end", -1)] * (stays or (later and not phase.free))
    way = masses @ planned.position / masses.sum()
    for n, at in enumerate(phase.through if isinstance(phase, Fly) else (), start=1):
        nearest = np.linalg.norm(way - at.position, axis=1).argmin()
        places.append((f"point {n} on the way", int(nearest)))
    for place, k in places:
        by = float(np.linalg.norm(masses @ off[k]) / masses.sum())
        by = by if leg.after.formation else max(by, far[k].max())
        if by > tolerance["position"]:
            yield (
                "waypoint",
                f"{place} is missed by {by:.2f} m (limit {tolerance['position']} m)",
            )
    forms, turns = phase.establishing is not None, "attitude" in phase.meets
    lies, goal = forms and not mission.free_attitude(phase), leg.after.goal
    kept = stays and not forms and goal is not None and goal.named
    for k in [arrival] * (lies or turns) + [-1] * (later if turns else kept):
        turn = rigid_body.kabsch(r[k], planned.position[k], masses, near=np.eye(3))
        by = float(np.degrees(np.linalg.norm(att.rotation_vector_from_dcm(turn))))
        if by > tolerance["attitude"]:
            limit = f"limit {tolerance['attitude']} deg"
            yield "attitude", f"its attitude is missed by {by:.1f} deg ({limit})"
    if limits.tracking_error is not None and far.max() > limits.tracking_error:
        yield (
            "tracking error",
            f"the tracking error is {far.max():.2g} m (limit {limits.tracking_error:g} m)",
        )
    form = mission.formations.get(leg.after.formation or "")
    if form and (phase.shaping is not None or last) and 1 < len(masses) <= STACKED:
        # To first order: a turn of the whole changes no distance.
        i, j = proximity.all_pairs(len(masses))
        apart, moved = planned.position[-1, i] - planned.position[-1, j], off[-1, i] - off[-1, j]
        length = np.linalg.norm(apart, axis=1)
        by = np.abs((apart * moved).sum(axis=1) / length).max()
        limit = form.greatest_error(length.min())
        if by > limit:
            yield "formation", f"the shape is {by:.2g} m off at its end (limit {limit:.2g} m)"
    settle = None if mission.tracking.integral else phase.settle  # an integral settles later
    if settle is not None and far[-1].max() > settle.tolerance:
        yield "settle", f"it does not settle to {settle.tolerance:g} m"
