"""Check the planned paths: collisions, downwash, thrust, obstacles, limits."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from rigidfleet._common.quantities import QUANTITIES, Quantity
from rigidfleet._common.text import agent_names
from rigidfleet._common.waypoints import LEEWAY, UNITS, WAYPOINT_TOLERANCE
from rigidfleet.formation import distance_geometry
from rigidfleet.math import attitude as att
from rigidfleet.math import proximity
from rigidfleet.math.rigid_body import about_cm, mean_axis_rates
from rigidfleet.mission import Mission
from rigidfleet.mission.disturbances import gust_intensity
from rigidfleet.planning import timing
from rigidfleet.planning.certificate import prove_blend
from rigidfleet.planning.derivatives import slot_derivatives
from rigidfleet.planning.limits import limits_of
from rigidfleet.planning.preview import PlannedPhase
from rigidfleet.planning.reference import pose_at
from rigidfleet.planning.vehicles import drag_and_lift
from rigidfleet.preflight.avoidance import is_left_to_avoidance
from rigidfleet.preflight.findings import DENSE, WORST_SHOWN, Disturbed, Preflight, Remark
from rigidfleet.rigidity import jacobian
from rigidfleet.typing import Floats

#: Share by which a goal is planned to be missed by more than its tolerance, before it is said to be missed.
_CLEARLY = 0.02
#: Separation of two agents [m], when [s], and which, from 0.
_Nearest = tuple[float, float, tuple[int, ...]]


def separation_remarks(mission: Mission, preflight: Preflight) -> Iterator[Remark]:
    """Remarks on the minimum separation, and on each change of formation in which paths cross."""
    if mission.n_agents < 2:
        return
    radius, limit = mission.fleet.radius, mission.limits.separation or 0.0
    lowest = mission.limits.separation_altitude
    worst: dict[bool, tuple[_Nearest, str]] = {}
    least: _Nearest = np.inf, 0.0, (0, 0)
    for number, planned in enumerate(preflight.flown_phases):
        ends: list[_Nearest] = []
        positions = planned.position if planned.path_ends is None else np.array(planned.path_ends)
        # Where separation begins at an altitude, agents below it are left to the verdict.
        left = ~planned.leg.before.lost
        flying = (positions[..., 2] >= (-np.inf if lowest is None else lowest)) & left
        separations, pairs = proximity.separation_of_remaining(positions, radius, flying)
        all_fly = flying[:, left].all()
        for k in [int(separations.argmin())] if planned.path_ends is None else [0, -1]:
            ends.append((float(separations[k]), float(planned.time[k]), tuple(pairs[k].tolist())))
        bent = len(planned.leg.reference.knots) and planned.path_ends is None and all_fly
        if bent and (proved := planned.leg.certificate) is not None:
            ends = [proved[:3]]
        if planned.path_ends is not None:
            certificate = planned.leg.certificate or prove_blend(planned.leg.reference, radius)
            crossing, separation = certificate[:3], certificate.separation
            least = min(least, crossing)
            beyond = all_fly and (separation <= 0 or separation < limit - LEEWAY)
            if beyond and separation < min(ends)[0] - LEEWAY:
                yield _crossing_remark(mission, planned, crossing)
        for k, at in enumerate(ends):
            least = min(least, at)
            # The start positions are known even if the path from there is not.
            exact = planned.exact or (number == 0 and k == 0 and planned.path_ends is not None)
            if exact not in worst or at[0] < worst[exact][0][0]:
                worst[exact] = at, planned.phase
    if np.isfinite(least[0]):
        preflight.worst["separation"] = *least[:2], agent_names(least[2]), mission.limits.separation
    for exact, (at, phase) in worst.items():
        if at[0] <= 0 or at[0] < limit - LEEWAY:
            yield _collision_remark(mission, at, phase, exact=exact)


def _collision_remark(
    mission: Mission, at: _Nearest, phase: str, why: str = "", *, exact: bool
) -> Remark:
    """Remark on planned paths that come too close, which is a note where the guard of [avoidance] keeps the limit."""
    (separation, t, who), limit = at, mission.limits.separation or 0.0
    text = f"a separation of {separation:.2f} m at {t:.2f} s in '{phase}' (limit {limit:g} m)"
    text = f"{agent_names(who)} have {text}{why}"
    if separation <= 0:
        may = "" if exact else "may "
        text = f"{agent_names(who)} {may}collide at {t:.2f} s in '{phase}'{why}"
    if not exact:
        text += "; straight paths are assumed, as only distances guide the agents"
    elif is_left_to_avoidance(mission, "collision", limit):
        text, exact = f"{text}. So it is planned; [avoidance] has to keep them apart", False
    return Remark("fails" if exact else "note", "collision", text)


def _crossing_remark(mission: Mission, planned: PlannedPhase, at: _Nearest) -> Remark:
    """Remark on agents whose straight paths from one formation to the next come too close."""
    (separation, _, who), before, after = at, planned.leg.before.formation, planned.leg.formation
    radii = sum(mission.agents.radius[i] for i in who)
    needed = radii + (mission.limits.separation or 0.0)
    origin = "the start" if before is None else f"'{before}'"
    apart = f"{max(0.0, separation + radii):.2f} m from centre to centre"
    text = f": their paths from {origin} to '{after}' cross with {apart}. "
    assert after is not None  # the phase changes the formation
    assert planned.path_ends is not None
    least = min(float(proximity.nearest(places).min()) for places in planned.path_ends)
    spaced = f"place slots at least {math.sqrt(2) * needed:.2f} m apart (now {least:.2f} m)"
    if mission.assigned_turn(before, after) is not None:
        text += f"{spaced[0].upper()}{spaced[1:]}"
    else:
        text += 'Assign agents to near slots: assignment = "each"'
        text += f"; and {spaced}" * (least < math.sqrt(2) * needed)
    return _collision_remark(mission, at, planned.phase, text, exact=planned.exact)


def downwash_remarks(mission: Mission, preflight: Preflight) -> Iterator[Remark]:
    """Remarks on vehicles in the downwash of another one."""
    radius, limit = mission.fleet.radius, mission.limits.separation_below
    worst: dict[bool, tuple[float, float, tuple[int, ...], str]] = {}
    for planned in preflight.flown_phases:
        left = np.broadcast_to(~planned.leg.before.lost, planned.position.shape[:2])
        height, pair = proximity.headroom(planned.position, radius, left)
        k = int(height.argmin())
        if height[k] < worst.get(planned.exact, (np.inf,))[0]:
            low, high = sorted(pair[k].tolist(), key=lambda i: planned.position[k, i, 2])
            at = float(height[k]), float(planned.time[k])
            worst[planned.exact] = *at, (low, high), planned.phase
    for exact, (height, t, (low, high), phase) in worst.items():
        text = f"agent {low + 1} is {max(height, 0.0):.2f} m below agent {high + 1} at {t:.2f} s in '{phase}'"
        if limit is None:
            yield Remark("note", "downwash", text)
        elif height < limit - LEEWAY:
            text += f" (limit {limit:g} m)"
            yield Remark("fails" if exact else "note", "downwash", text)


def _nearest_to_limit(
    mission: Mission, q: Quantity, way: list[PlannedPhase], values: list[Floats], limits: Floats
) -> tuple[float, float, str, float]:
    """Of values (K, N) of each phase, the one nearest to its limit (N,), or the worst if there is none.

    Its value, time [s], agent and limit. Vehicles count until they are lost.
    """
    room = q.rank(limits) if np.isfinite(limits).any() else 0.0
    near = [
        np.where(planned.time[:, None] <= mission.lost_at, q.rank(x) - room, -np.inf)
        for planned, x in zip(way, values, strict=True)
    ]
    p = int(np.argmax([x.max() for x in near]))
    k, i = np.unravel_index(int(near[p].argmax()), near[p].shape)
    return float(values[p][k, i]), float(way[p].time[k]), f"agent {i + 1}", float(limits[i])


def _measured_peaks(
    mission: Mission, way: list[PlannedPhase]
) -> Iterator[tuple[Quantity, tuple[float, float, str, float]]]:
    """Of what has a limit and is measured of positions and velocities: what is nearest to it, at samples."""
    for q in (q for q in QUANTITIES.values() if q.checked and way):
        if (measure := q.measure) and (limit := q.limit_of(mission)) is not None:
            values = [measure(mission, x.position, x.velocity) for x in way]
            limits = np.full(mission.n_agents, limit)
            yield q, _nearest_to_limit(mission, q, way, values, limits)


def find_planned_peaks(mission: Mission, preflight: Preflight) -> None:
    """Find what of each motion is nearest to its limit, at samples; jerk and tilt are those of tracked slots."""
    for limit in limits_of(mission, kept_if_unlimited=WORST_SHOWN):
        q, way = limit.of, preflight.flown_phases
        if q.order == 3 or q.name == "tilt":
            way = [planned for planned in way if planned.leg.phase.tracks_slots]
        if way:
            states = (_planned_states_up_to_order(planned, q.order) for planned in way)
            values = [limit.values(x, np.arange(mission.n_agents)) for x in states]
            preflight.worst[q.name] = _nearest_to_limit(mission, q, way, values, limit.most)
    # Of the geofence, only what breaks it is said.
    peaks = _measured_peaks(mission, preflight.flown_phases)
    preflight.worst |= {q.name: worst for q, worst in peaks if not q.limit}


def _planned_states_up_to_order(planned: PlannedPhase, order: int) -> Floats:
    """Planned positions and their derivatives up to an order, at least the second (K, order + 1, N, 3)."""
    if order == 3:
        return slot_derivatives(*planned.leg.slots_and_motion, planned.time, 4)
    return np.stack([planned.position, planned.velocity, planned.acceleration], axis=1)


def disturbance_remarks(mission: Mission, preflight: Preflight) -> Iterator[Remark]:
    """Remarks on the effects of wind, gusts, noise and mass errors that follow from the planned paths."""
    d = mission.disturbances
    if d is None or not preflight.flown_phases:
        return
    believed, true, drag = mission.fleet.mass, mission.true_mass, mission.drag
    wind, up = np.array(d.wind), np.array([0.0, 0.0, 1.0])
    g, speed = mission.gravity, float(np.linalg.norm(d.wind))
    k1, k2 = mission.tracking_gains
    sigma = 0.0 if d.gusts is None else float(gust_intensity(d.gusts, speed).max())
    gusts = 3 * sigma * drag
    noise = np.zeros(len(believed))
    if d.noise is not None:
        noise = 3 * believed * math.hypot(k1 * d.noise.position, k2 * d.noise.velocity)
    needs = []
    for planned in preflight.flown_phases:
        force = true[:, None] * (planned.acceleration + g * up)
        force -= drag[:, None] * (wind - planned.velocity)
        needs.append(np.linalg.norm(force, axis=2) + gusts + noise)
    limits, thrust = mission.fleet.thrust_limit, QUANTITIES["thrust"]
    most = _nearest_to_limit(mission, thrust, preflight.flown_phases, needs, limits)
    steady = drag_and_lift(mission, np.tile(wind, (len(drag), 1)))
    steady -= ((true - believed) * g)[:, None] * up
    off = np.linalg.norm(steady, axis=1) / (k1 * believed)
    if mission.tracking.integral:
        off[:] = 0.0  # in the end
    far = int(off.argmax())
    lost = tuple((lost.agent - 1, lost.time) for lost in d.lost)
    preflight.disturbed = Disturbed(
        float((drag * speed).max()), float(gusts.max()), float((np.abs(true - believed) * g).max()),
        float(noise.max()), most, (float(off[far]), f"agent {far + 1}"), lost,
    )  # fmt: skip
    if most[0] > most[3]:
        text = f"with disturbances, {most[2]} may need {most[0]:.1f} N at {most[1]:.2f} s (limit {most[3]:g} N)"
        yield Remark("note", "thrust", text)
    if lost:
        text = f"paths are checked as if {agent_names(i for i, _ in lost)} flew on to the end"
        yield Remark("note", "disturbances", text)


def step_thrust_remarks(mission: Mission, preflight: Preflight) -> Iterator[Remark]:
    """Remarks on the forces at a step of the reference: J M^-1 J^T lambda = -beta^2 c."""
    c, masses = mission.constraint, mission.fleet.mass
    if c.stabilisation == "none":
        return
    limits = mission.fleet.thrust_limit
    ends = (planned.position[-1] for planned in preflight.flown_phases)
    starts = [mission.fleet.position, *ends]
    for phase, r in zip(mission.phases, starts, strict=False):
        shaping = phase.shaping
        if shaping is None or shaping.reference != "step":
            continue
        edges = mission.formation_edges(shaping.formation)
        if min(len(edges), 3 * mission.n_agents) > DENSE:
            continue
        lengths = mission.formation_distances(shaping.formation)
        error = distance_geometry.distances(r, edges) - lengths
        J = jacobian(r, edges)
        root = np.repeat(1 / np.sqrt(masses), 3)
        f = np.linalg.lstsq(J * root, -(c.beta**2) * error, rcond=1e-7)[0] / root
        f = f.reshape(-1, 3) + masses[:, None] * [0.0, 0.0, mission.gravity]
        need = np.linalg.norm(f, axis=1)
        i = int((need - np.where(np.isfinite(limits), limits, 0.0)).argmax())
        if need[i] > limits[i]:
            text = (
                f"the step to '{shaping.formation}' in '{phase.name}' needs {need[i]:.0f} N from agent {i + 1}"
                f" (limit {limits[i]:g} N). Use reference = 'shape' or 'distances'"
            )
            yield Remark("fails" if c.solver in ("exact", "pinv") else "note", "thrust", text)


def waypoint_miss_remarks(mission: Mission, preflight: Preflight) -> Iterator[Remark]:
    """Remarks on goals that the body misses even without errors of control: its regulator has too little time."""
    masses = mission.fleet.mass
    begun = True  # whether the phase begins when and where it is planned
    for planned in preflight.flown_phases:
        leg = planned.leg
        phase, goal, exact = leg.phase, leg.planned_end_state.goal, begun
        begun = begun and phase.settle is None
        if phase.control == "open" or goal is None or leg.arrival > leg.end:
            continue
        pose = pose_at(leg.motion, leg.arrival)
        stays = phase.tracks_slots and "position" not in phase.commanded_at_arrival
        ways = ("position", pose.r, goal.r), ("velocity", pose.v, goal.v)
        meets = {x: math.dist(a, b) for x, a, b in ways if stays or x in phase.commanded_at_arrival}
        if "attitude" in phase.commanded_at_arrival and mission.n_agents > 1:
            turn = att.rotation_vector_from_dcm(pose.T @ goal.T.T)
            # As flown: agents on a line do not show how it spins.
            state = slot_derivatives(leg.reference, leg.motion, np.array([leg.arrival]), 2)[0]
            x, y = (about_cm(part, masses)[None] for part in state)
            spin = pose.T @ mean_axis_rates(x, y, masses)[0] - goal.omega
            turns = ("attitude", turn), ("rates", spin)
            meets |= {what: math.degrees(np.linalg.norm(x)) for what, x in turns}
        for what, off in meets.items():
            unit, most = UNITS[what], WAYPOINT_TOLERANCE[what]
            if off <= (1.0 + _CLEARLY) * most:
                continue
            is_turn = what in ("attitude", "rates")
            law, table = (mission.lqr.attitude, "lqr.attitude") if is_turn else (mission.lqr, "lqr")
            remedy = f"greater weights {table}.S"
            if law.horizon == "infinite":
                remedy = f"greater weights {table}.Q, or horizon = 'finite'"
            # Of a body under feedback, the rotation is planned as one about a fixed axis.
            sure = exact and (phase.tracks_slots or not is_turn)
            how = f"{'is' if sure else 'may be'} missed, {off:.2g} {unit} off in {what}"
            text = f"the waypoint of '{planned.phase}' {how} at {leg.arrival:.2f} s"
            text += f" (limit {most:g} {unit}): give the phase more time, or {remedy}"
            yield Remark("fails" if sure else "note", "waypoint", text)


def limit_remarks(mission: Mission, preflight: Preflight) -> Iterator[Remark]:
    """Remarks on speed, acceleration, geofence and what else has a limit beyond it."""
    hopeless: set[str] = set()  # limits that no time keeps; each is told once
    for planned in preflight.flown_phases:
        phase = planned.leg.phase
        if (mission.smooth or phase.follows_curves) and phase.tracks_slots:
            # The limit that its reference breaks most, with the least time that keeps all.
            over = timing.broken_limits(mission, planned.leg)
            if over and (topic := over[0].limit.of.name_in_words) not in hopeless:
                key, t = timing.key_and_least_time(mission, planned.leg)
                if t is None:
                    hopeless.add(topic)
                    remedy = f"no {key} of this phase keeps all limits"
                else:
                    remedy = f"the least {key} of this phase is {math.ceil(100 * t) / 100:.2f} s"
                yield Remark("fails", topic, f"{timing.reached_in_words(over[0], phase)}; {remedy}")
        else:
            yield from _broken_limit_remarks(mission, planned)
        yield from measured_remarks(mission, planned)


def measured_remarks(mission: Mission, planned: PlannedPhase) -> Iterator[Remark]:
    """Remarks on what is measured of positions and velocities beyond its limit in a phase; of the geofence, too."""
    for q, (worst, when, who, limit) in _measured_peaks(mission, [planned]):
        if q.rank(worst) > q.rank(limit) + LEEWAY:
            text = q.in_words(f"{worst:.2f} {q.display_unit}", who, when, limit)
            level = "fails" if planned.exact else "note"
            yield Remark(level, q.name_in_words, f"{text} in '{planned.phase}'")


def _broken_limit_remarks(mission: Mission, planned: PlannedPhase) -> Iterator[Remark]:
    """Remarks on speed, acceleration and thrust of samples beyond their limits."""
    x = _planned_states_up_to_order(planned, 2)
    for limit in limits_of(mission, lost_by=planned.leg.start):
        q = limit.of
        if q.order > 2 or q.name == "tilt":
            continue
        size = limit.values(x, np.arange(mission.n_agents))
        of = f" of {q.name_in_words}" if q.way else ""
        k, i = np.unravel_index(int((size / limit.most).argmax()), size.shape)
        if size[k, i] > (most := limit.most[i]) * (1 + 1e-3):
            text = (
                f"agent {i + 1} reaches {size[k, i]:.3g} {q.display_unit}{of} at {planned.time[k]:.2f} s in"
                f" '{planned.phase}' (limit {most:g} {q.display_unit})"
            )
            yield Remark("fails" if planned.exact else "note", q.name_in_words, text)
