"""Check what the planned paths ask of vehicles: lag and delay of their laws, rotor forces, tilt, jumps, jets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from rigidfleet._common.text import percent_text
from rigidfleet.math import series
from rigidfleet.math.quadrotor import Flat, flat, mixing
from rigidfleet.mission import Mission
from rigidfleet.mission.vehicles import VehicleModel
from rigidfleet.planning.derivatives import slot_derivatives
from rigidfleet.planning.preview import PlannedPhase
from rigidfleet.planning.vehicles import (
    drag_and_lift,
    initial_yaw_and_rate,
    pair_jet_speeds,
    slot_taylor_and_yaw,
    yaw_turn,
)
from rigidfleet.preflight.findings import Preflight, Remark, VehicleCheck
from rigidfleet.typing import Floats

#: Greatest number of samples times agents, and of agents of which all pairs are looked at for jets.
_PLACES, STACKED = 200_000, 60
#: Samples of a phase, and the time between them [s], within bounds: where derivatives of the reference are evaluated.
_SAMPLES, _STEP, _MOST = 201, 0.02, 2001
#: Jump of the acceleration that is told [m/s^2].
_JUMP = 0.05
#: Force of a jet that is told, as a share of the weight of the vehicle in it.
_BLOW = 0.02


def check_vehicles(mission: Mission, way: Sequence[PlannedPhase]) -> VehicleCheck | None:
    """What the planned paths ask of rotors; None of points, and where no slots are tracked.

    Rotor forces follow from the reference by differential flatness (`rigidfleet.math.quadrotor`), with the drag of the
    vehicle near hover, in still air, and with the yaw that the mission asks for.
    """
    models = mission.vehicle_models
    tracked = [planned for planned in way if planned.leg.phase.tracks_slots]
    if models is None or not tracked or all(model.point for model in models):
        return None
    setting, angle, needs = mission.yaw, initial_yaw_and_rate(mission), []
    for planned in tracked:
        leg, n = planned.leg, mission.n_agents
        count = min(max(_SAMPLES, int((leg.end - leg.start) / _STEP) + 1), _MOST)
        time = np.linspace(leg.start, leg.end, max(11, min(count, _PLACES // n)))
        turn = yaw_turn(leg.reference, leg.motion, leg.start, setting, angle)
        slots, turned, _ = slot_taylor_and_yaw(leg.reference, leg.motion, time, setting, turn)
        angle, yaw = turned[:2, :, -1], turned.transpose(2, 0, 1)
        x = series.taylor_derivatives(slots).transpose(3, 0, 2, 1)
        for i, model in enumerate(models):
            if not model.point:
                need = _vehicle_needs_on_path(model, x[:, :, i], yaw[:, :, i], mission.gravity)
                needs.append(_vehicle_check(model, need, time, f"agent {i + 1}", planned.phase))
    return VehicleCheck(
        rotor_force=max((x.rotor_force for x in needs), key=lambda force: force[0] / force[3]),
        tilt=max((x.tilt for x in needs), key=lambda tilt: tilt[0]),
        jump=_worst_accel_and_tilt_jump(mission, tracked),
        beyond=max((x.beyond for x in needs if x.beyond), key=lambda y: y[0], default=None),
    )


def _vehicle_check(
    model: VehicleModel, need: Flat, time: Floats, who: str, phase: str
) -> VehicleCheck:
    """What a phase asks of one vehicle."""
    mixed = mixing(model.arm, model.torque_coefficient / model.thrust_coefficient)
    rotor = need.rotor_forces(np.array(model.inertia), mixed)
    tilt = np.degrees(need.tilt)
    least, most = (model.thrust_coefficient * speed**2 for speed in model.rotor_speed)
    k, j = int(rotor.max(axis=1).argmax()), int(tilt.argmax())
    weak = ((rotor < least) | (rotor > most)).any(axis=1)
    limit = model.tilt_limit_deg
    aslant = (tilt > limit) & (limit < 90.0)  # the control knows no limit from there on
    needs = (
        f"{tilt[j]:.1f} deg of tilt (limit {limit:g} deg)"
        if aslant.sum() > weak.sum()
        else f"rotor forces of {rotor.min():.3g} to {rotor.max():.3g} N (rotors give {least:.3g} to {most:.3g} N)"
    )
    share = float((weak | aslant).mean())
    return VehicleCheck(
        rotor_force=(float(rotor[k].max()), float(time[k]), who, most, phase),
        tilt=(float(tilt[j]), float(time[j]), who, phase),
        beyond=(share, who, phase, needs) if share else None,
    )


def _vehicle_needs_on_path(model: VehicleModel, x: Floats, yaw: Floats, g: float) -> Flat:
    """What a path (K, 5, 3) asks of a vehicle: the force of m (a + g) and of drag, and its derivatives."""
    force = model.mass * x[:, 2:] + np.array(model.linear_drag) * x[:, 1:4]
    speed = np.linalg.norm(x[:, 1], axis=1)[:, None]
    force[:, 0] += np.array(model.body_drag) * speed * x[:, 1]
    force[:, 0, 2] += model.mass * g
    return flat(force, yaw)


def _worst_accel_and_tilt_jump(
    mission: Mission, way: Sequence[PlannedPhase]
) -> tuple[float, float, float, str] | None:
    """The greatest jump of the reference's acceleration [m/s^2], of the tilt [deg], its time [s], and the phase."""
    jumps: list[tuple[float, float, float, str]] = []
    for before, after in pairwise(way):
        if before.leg.end != after.leg.start:
            continue
        t = np.array([after.leg.start])
        legs = before.leg, after.leg
        a, b = (slot_derivatives(x.reference, x.motion, t, 3)[0, 2] for x in legs)
        jump = np.linalg.norm(b - a, axis=1)
        i = int(jump.argmax())
        up = np.array([0.0, 0.0, mission.gravity])
        u, v = (f[i] + up for f in (a, b))
        angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v))
        jumps.append((float(jump[i]), float(angle), float(t[0]), after.phase))
    return max(jumps, key=lambda jump: jump[0], default=None)


def vehicle_remarks(mission: Mission, preflight: Preflight) -> Iterator[Remark]:
    """Remarks on rotors that the plan asks too much of, on jumps, and on vehicles in the jets of others."""
    if preflight.vehicles is None:
        return
    preflight.worst["rotor_force"] = preflight.vehicles.rotor_force[:4]
    preflight.worst["tilt"] = *preflight.vehicles.tilt[:3], mission.limits.tilt_deg
    exact = {planned.phase for planned in preflight.flown_phases if planned.exact}
    if preflight.vehicles.beyond is not None:
        share, who, phase, need = preflight.vehicles.beyond
        fails = share > mission.limits.saturation and phase in exact
        text = (
            f"{who} cannot give what the plan asks of it for {percent_text(share)} of phase '{phase}', which needs"
            f" {need}; give the phase more time, the vehicle less mass, or another yaw"
        )
        yield Remark("fails" if fails else "note", "rotors", text)
    jump = preflight.vehicles.jump
    if jump is not None and jump[0] > _JUMP:
        text = (
            f"the reference's acceleration jumps by {jump[0]:.2f} m/s² ({jump[1]:.1f} deg of tilt) at {jump[2]:.2f} s,"
            f" where '{jump[3]}' begins; no vehicle follows a jump. Use smoothness = 'jerk'"
        )
        yield Remark("note", "jumps", text)
    yield from _jet_remarks(mission, preflight.flown_phases)


def _jet_remarks(mission: Mission, way: Sequence[PlannedPhase]) -> Iterator[Remark]:
    """Remark on the vehicle that another one's jet pushes down the most, as a share of its weight."""
    worst, text = 0.0, ""
    for planned in way if mission.n_agents <= STACKED else ():
        flow = pair_jet_speeds(mission, planned.position)
        down = np.zeros((*flow.shape, 3))
        down[..., 2] = flow
        push = drag_and_lift(mission, down.swapaxes(1, 2)).swapaxes(1, 2)[..., 2]
        share = push / (mission.fleet.mass * mission.gravity)[:, None]
        k, i, j = np.unravel_index(int(share.argmax()), share.shape)
        if share[k, i, j] > worst:
            r, worst = planned.position[k], share[k, i, j]
            text = (
                f"agent {i + 1} is {r[j, 2] - r[i, 2]:.2f} m below agent {j + 1} at {planned.time[k]:.2f} s in"
                f" '{planned.phase}': its jet of {flow[k, i, j]:.1f} m/s pushes with {push[k, i, j]:.2g} N,"
                f" {100 * worst:.0f} % of the weight"
            )
    if worst >= _BLOW:
        rest = "; set disturbances.downwash to fly with it"
        yield Remark("note", "downwash", text + rest * (not mission.all_disturbances.downwash))
