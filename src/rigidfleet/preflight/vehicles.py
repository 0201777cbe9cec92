"""Check what the planned paths ask of vehicles: lag and delay of their laws, rotor forces, tilt, jumps, jets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from rigidfleet.kernel.fleet import jet_speed
from rigidfleet.math.margins import Lag
from rigidfleet.math.quadrotor import Flat, flat, mixing
from rigidfleet.mission import Mission
from rigidfleet.mission.vehicles import VehicleModel
from rigidfleet.planning.derivatives import Yaw, slot_derivatives, yaw_derivatives
from rigidfleet.planning.preview import PlannedPhase
from rigidfleet.planning.vehicles import DENSITY
from rigidfleet.preflight.findings import Preflight, Remark, VehicleCheck
from rigidfleet.typing import Floats

#: Greatest number of samples times agents, and of agents of which all pairs are looked at for jets.
_PLACES, _STACKED = 200_000, 60


def vehicle_lags(mission: Mission) -> list[Lag]:
    """Lag and delay of each vehicle; empty for points that give any force at once."""
    models = mission.vehicle_models
    if models is None:
        return []
    d, autopilot = mission.disturbances, mission.autopilot
    noise = None if d is None else d.noise
    delay, rate = 0.0, autopilot.formation_rate
    if noise is not None:
        # Delays are whole ticks; a law that is quicker than its measurements acts at their rate.
        delay = round(noise.delay * autopilot.rate) / autopilot.rate
        rate = min(rate, noise.rate)
    return [
        Lag(delay=delay, rate=rate, point=True)
        if model.point
        else Lag(
            model.attitude_gains[0], model.attitude_gains[1], max(model.motor_time), delay, rate
        )
        for model in models
    ]


#: Samples of a phase, and the time between them [s], within bounds: where derivatives of the reference are evaluated.
_SAMPLES, _STEP, _MOST = 201, 0.02, 2001
#: Jump of the acceleration that is told [m/s^2].
_JUMP = 0.05
#: Force of a jet that is told, as a share of the weight of the vehicle in it.
_BLOW = 0.02


def check_vehicles(mission: Mission, way: Sequence[PlannedPhase]) -> VehicleCheck | None:
    """What the planned paths ask of rotors; None of points, and where no slots are tracked.

    Rotor forces follow from the reference by differential flatness (`rigidfleet.math.quadrotor`), with the drag of the
    vehicle near hover, in still air.
    """
    models = mission.vehicle_models
    tracked = [planned for planned in way if planned.leg.phase.control == "tracking"]
    if models is None or not tracked or all(model.point for model in models):
        return None
    force, tilt = None, (0.0, 0.0, "", "")
    for planned in tracked:
        leg, n = planned.leg, mission.n_agents
        count = min(max(_SAMPLES, int((leg.end - leg.begin) / _STEP) + 1), _MOST)
        time = np.linspace(leg.begin, leg.end, max(11, min(count, _PLACES // n)))
        x = slot_derivatives(leg.reference, leg.motion, time)
        yaw = yaw_derivatives(leg.reference, leg.motion, time, Yaw())
        for i, model in enumerate(models):
            if model.point:
                continue
            need = _needed(model, x[:, :, i], yaw[:, :, i], mission.gravity)
            rotor = need.rotor_forces(
                np.array(model.inertia),
                mixing(model.arm, model.torque_coefficient / model.thrust_coefficient),
            )
            k, j = (int(a) for a in np.unravel_index(int(rotor.argmax()), rotor.shape))
            share = float(rotor[k, j]) / model.rotor_limit
            if force is None or share > force[0] / force[3]:
                force = float(rotor[k, j]), float(time[k]), i, model.rotor_limit, planned.phase
            k = int(need.tilt.argmax())
            if (angle := float(np.degrees(need.tilt[k]))) > tilt[0]:
                tilt = angle, float(time[k]), f"agent {i + 1}", planned.phase
    assert force is not None
    value, t, i, limit, phase = force
    return VehicleCheck((value, t, f"agent {i + 1}", limit, phase), tilt, _jump(mission, tracked))


def _needed(model: VehicleModel, x: Floats, yaw: Floats, g: float) -> Flat:
    """What a path (K, 5, 3) asks of a vehicle: the force of m (a + g) and of drag, and its derivatives."""
    force = model.mass * x[:, 2:] + np.array(model.linear_drag) * x[:, 1:4]
    speed = np.linalg.norm(x[:, 1], axis=1)[:, None]
    force[:, 0] += np.array(model.body_drag) * speed * x[:, 1]
    force[:, 0, 2] += model.mass * g
    return flat(force, yaw)


def _jump(mission: Mission, way: Sequence[PlannedPhase]) -> tuple[float, float, float, str] | None:
    """The greatest jump of the reference's acceleration [m/s^2], of the tilt [deg], its time [s], and the phase."""
    worst = None
    for before, after in pairwise(way):
        if before.leg.end != after.leg.begin:
            continue
        t = np.array([after.leg.begin])
        a, b = (
            slot_derivatives(leg.reference, leg.motion, t, 3)[0, 2]
            for leg in (before.leg, after.leg)
        )
        jump = np.linalg.norm(b - a, axis=1)
        i = int(jump.argmax())
        up = np.array([0.0, 0.0, mission.gravity])
        u, v = (f[i] + up for f in (a, b))
        angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v))
        if worst is None or jump[i] > worst[0]:
            worst = float(jump[i]), float(angle), float(t[0]), after.phase
    return worst


def vehicle_remarks(mission: Mission, found: Preflight) -> Iterator[Remark]:
    """Remarks on rotors that the plan asks too much of, on jumps, and on vehicles in the jets of others."""
    if found.vehicles is None:
        return
    force, t, who, limit, phase = found.vehicles.rotor_force
    exact = {planned.phase for planned in found.planned_phases if planned.exact}
    if force > limit:
        text = (
            f"a rotor of {who} needs {force:.3g} N at {t:.2f} s in '{phase}' (limit {limit:.3g} N);"
            " give the phase more time, or the vehicle less mass"
        )
        yield Remark("fails" if phase in exact else "note", "rotors", text)
    jump = found.vehicles.jump
    if jump is not None and jump[0] > _JUMP:
        text = (
            f"the reference's acceleration jumps by {jump[0]:.2f} m/s^2 ({jump[1]:.1f} deg of tilt) at {jump[2]:.2f} s,"
            f" where '{jump[3]}' begins; no vehicle follows a jump. Use smoothness = 'jerk'"
        )
        yield Remark("note", "jumps", text)
    yield from _jets(mission, found.planned_phases)


def _jets(mission: Mission, way: Sequence[PlannedPhase]) -> Iterator[Remark]:
    """Remark on the vehicle that another one's jet pushes down the most, as a share of its weight."""
    models = mission.vehicle_models
    assert models is not None
    worst = None
    for planned in way if mission.n_agents <= _STACKED else ():
        r = planned.position
        for j, above in enumerate(models):
            if above.point:
                continue
            weight, span = above.mass * mission.gravity, 2.0 * above.arm
            below = r[:, [j]] - r
            for i, model in enumerate(models):
                s = below[:, i, 2]
                if i == j or not (s > 0.0).any():
                    continue
                k = int(np.argmin(np.where(s > 0.0, np.hypot(*below[:, i, :2].T), np.inf)))
                if s[k] <= 0.0:
                    continue
                beside = float((below[k, i, :2] ** 2).sum())
                flow = jet_speed(weight, DENSITY, above.rotor_radius, span, float(s[k]), beside)
                push = model.linear_drag[2] * flow + model.body_drag[2] * flow**2
                share = push / (model.mass * mission.gravity)
                if worst is None or share > worst[0]:
                    worst = (
                        share,
                        push,
                        flow,
                        i,
                        j,
                        float(s[k]),
                        float(planned.time[k]),
                        planned.phase,
                    )
    if worst is None or worst[0] < _BLOW:
        return
    _, push, flow, i, j, s, t, phase = worst
    on = mission.disturbances is not None and mission.disturbances.downwash
    rest = "" if on else "; set disturbances.downwash to fly with it"
    text = (
        f"agent {i + 1} is {s:.2f} m below agent {j + 1} at {t:.2f} s in '{phase}': its jet of {flow:.1f} m/s pushes"
        f" with {push:.2g} N, {100 * worst[0]:.0f} % of the weight{rest}"
    )
    yield Remark("note", "downwash", text)
