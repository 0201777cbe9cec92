"""A phase flown by vehicles with sampled control: integrates their motion between the ticks of their autopilots."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from rigidfleet._common.text import agent_names
from rigidfleet.errors import FlightError, StoppedError
from rigidfleet.kernel import avoidance, fleet, records
from rigidfleet.kernel.engine import native
from rigidfleet.kernel.engine.sampled import fly_ticks
from rigidfleet.kernel.problem import TRACKING, Problem
from rigidfleet.kernel.records import Record
from rigidfleet.math import attitude as att
from rigidfleet.mission import Mission
from rigidfleet.planning.avoidance import avoidance_in_flight
from rigidfleet.planning.reference import ByEdge
from rigidfleet.planning.vehicles import TickTables, first_yaw, sampled_flight, turn_from
from rigidfleet.simulation.active_phase import ActivePhase
from rigidfleet.simulation.callbacks import (
    AttitudeCommand,
    Command,
    Controller,
    Observation,
    checked_command,
    named,
)
from rigidfleet.simulation.diagnosis import diagnose
from rigidfleet.simulation.leading import Leader, layers
from rigidfleet.simulation.recording import LayerSamples, Led, VehicleSamples
from rigidfleet.simulation.solver_setup import equip
from rigidfleet.typing import Floats

#: Greatest number of ticks in a table, and of steps between two returns to Python.
_TICKS, _STEPS = 1024, 4000


#: Distance [m] and speed [m/s] that no vehicle reaches in flight.
_FAR = 1e9


class Vehicles:
    """The vehicles of a flight, from phase to phase: what they are, where they are, and their yaw."""

    def __init__(self, mission: Mission, max_step: float) -> None:
        self.flight = sampled_flight(mission, max_step)
        self.tables = TickTables(mission, self.flight)
        self.avoidance = avoidance_in_flight(mission, self.flight)
        start = mission.fleet
        self.yaw = first_yaw(mission)  # asked of each vehicle at the last switch
        yaw = float(self.yaw[0])
        self.S = fleet.hovering(self.flight.vehicles, start.position, start.velocity, yaw)
        self.state: fleet.SampledState | None = None  # of the phase before
        self.edges = np.zeros((0, 2), dtype=np.int64)  # of that state
        self.layers = layers(mission)  # settings of the clock and the body layer, if they may act
        self.output_step = mission.output_step
        self.scale = np.array([1.0, 0.0, 0.0])  # of the slots at the last switch, two derivatives


class SampledPhase(ActivePhase):
    """A phase of vehicles with sampled control, under way.

    The law of the plan is evaluated at measured states, at ticks. Whenever the kernel returns, ``state.y`` holds the
    true state, in the layout of the continuous flight.
    """

    by_ticks = True

    def __init__(self, *arguments: Any, vehicles: Vehicles, **options: Any) -> None:
        self.vehicles, self.flight = vehicles, vehicles.flight
        self.tabled: Problem | None = None  # the plan's problem for which the tables are
        if vehicles.avoidance is not None:
            vehicles.avoidance = avoidance.renewed(vehicles.avoidance)
        self.led = False  # whether the reference is given piece by piece
        self.steered = False  # whether it is given by hand
        self.led_until = -math.inf  # end of what the leader has decided [s]
        self.unjudged = False  # whether steps were flown since the extremes of vehicles were taken
        self.first_tick: int | None = None
        self.leader: Leader | None = None
        super().__init__(*arguments, **options)
        if vehicles.layers is not None and self.plan.problem.control.kind == TRACKING:
            period = self.flight.every * self.flight.steps * self.flight.h
            self.leader = Leader(vehicles.layers, self.plan, period)
            self.leader.deviation.scale = vehicles.scale
        yaw = vehicles.tables.yaw
        self.turn = turn_from(self.plan.problem, self.plan.start, yaw, vehicles.yaw)

    def _start(self, y: Floats, t: float) -> None:
        plan, given = self.plan, self.vehicles
        n, m = len(plan.masses), len(plan.edges)
        self.workspace, self.solver = equip(plan)
        rtol, atol = plan.integrator.rtol, plan.tolerances
        self.state = self.extremes.begin(y, t, m, rtol=rtol, atol=atol, states=6 * n)
        lost = self.flight.vehicles._replace(lost=self.lost.copy())
        self.flight = self.flight._replace(vehicles=lost)
        if self.parted.any():
            parted = np.ascontiguousarray(plan.links_lost[0][self.parted])
            sensing = self.flight.sensing._replace(parted=parted)
            self.flight = self.flight._replace(sensing=sensing)
            self.evaluate()  # the slots by which vehicles without a link presume each other
        frame = y[6 * n + m : 6 * n + m + 4] if plan.frame is not None else None
        integral, before = y[6 * n : 6 * n + m], given.state
        begun = fleet.begin(self.flight, given.S, self.workspace, frame=frame)
        if before is None:
            begun.integral[:] = integral
        else:
            renewed = fleet.renewed(before, self.workspace, integral, frame=frame)
            if self.parted.any():  # without a link, vehicles do not come to the same integrals
                own = [
                    ByEdge().updated(given.edges, x).of(plan.edges, integral)
                    for x in before.integral
                ]
                renewed.integral[:] = own
            if self.first_tick is None:  # extremes are those of the phase, also after a loss in it
                fresh = ("peak", "peak_time", "worst", "worst_time", "saturations")
                renewed = renewed._replace(**{name: getattr(begun, name) for name in fresh})
            begun = renewed
        trail = self.state.trail
        self.sampled = given.state = begun._replace(trail=trail._replace(gauge=trail.gauge[:, :0]))
        if given.avoidance is not None:
            given.avoidance = avoidance.holding(given.avoidance, m)
        given.edges = plan.edges
        if self.first_tick is None:
            self.first_tick = int(begun.count[fleet.TICKS])
            self.gone = self.lost.copy()  # (N,) vehicles that do not fly in this phase
            begun.peak_time[:] = begun.worst_time[:] = t
        self.tabled = None

    # -- flying -----------------------------------------------------------------------------------

    def fly_to(self, t_end: float, controller: Controller | None, rate: float) -> None:
        """Fly to ``t_end`` [s], or to the end of the phase, which comes later if the formation waits."""
        leader, given = self.leader, self.vehicles.avoidance
        if leader is None or given is None or controller is not None or self.steered:
            super().fly_to(t_end, controller, rate)
            return
        whole = t_end >= self.plan.t_end
        while self.t < (self.plan.t_end if whole else t_end):
            end = leader.next_end(self.t, self.vehicles.output_step)
            if self.t >= self.led_until:
                self.led_until = end
                if (problem := leader.lead(self.t, end, given)) is not None:
                    self._follow_leader(problem)
            end = min(self.led_until, self.plan.t_end if whole else t_end)
            super().fly_to(end, controller, rate)

    @property
    def delay(self) -> float:
        """Time by which the events of the phase come later than planned [s]."""
        return 0.0 if self.leader is None else self.leader.clock.delay

    def _follow_leader(self, problem: Problem) -> None:
        """Continue with a problem that the leader has made of the plan's."""
        self._renew(problem)
        self.led = self.leader is not None and self.leader.leads

    def lead(self, problem: Problem) -> None:
        """Continue with another problem that somebody else has made: the layers above the barriers then rest."""
        self.steered = True
        if self.leader is not None:
            self.leader.now = None
        self._renew(problem)

    def _renew(self, problem: Problem) -> None:
        """Continue with another problem; vehicles that turn along their way do so from the yaw they have now."""
        yaw = self.vehicles.tables.yaw
        if yaw.kind == "along":
            now = self.vehicles.tables.yaw_at(self.plan.problem, self.t, self.turn)
            self.turn = turn_from(problem, self.t, yaw, now)
        self.led = True
        ActivePhase.lead(self, problem)

    def observe(self) -> Observation:
        """What a controller sees: states of now or, with noise, as the law knows them at a tick and until the next."""
        found, S = super().observe(), self.sampled.S
        seen = S[:, :6]
        if self.vehicles.tables.noise is not None:
            self._supply()
            now = fleet.segment(len(S), len(self.plan.edges), self.t, max_steps=0)  # to measure
            fly_ticks(self.plan.problem, self.workspace, self.flight, self.sampled, now)
            tables, tick = self.flight.tables, self.sampled.count[fleet.STEPS] // self.flight.steps
            # About the path of that tick, if there are any
            seen = self.sampled.seen + tables.path[max(tick - tables.first, 0) :][:1].sum(axis=0)
        return replace(
            found, position=seen[:, :3].copy(), velocity=seen[:, 3:].copy(), attitude=S[:, 6:10].copy(),
            rates=S[:, 10:13].copy(), rotor_speed=S[:, 13:].copy(),
        )  # fmt: skip

    def _under(self, controller: Controller) -> Problem:
        """The problem with what a user's controller asks for now: forces, thrust and attitude, or speeds of rotors."""
        self.flight = self.flight._replace(commands=fleet.no_commands(len(self.lost)))
        return super()._under(controller)

    def _commanded(self, given: Command) -> Problem:
        """The plan's problem, beside the thrust and attitude, or the speeds of rotors, that a controller commands."""
        arrays = checked_command(given, len(self.lost), self.t)
        if self.flight.vehicles.point.any():
            raise FlightError(
                f"the controller returned {named(given)} at t = {self.t:.3f} s, but some agents are points;"
                " return forces [N]"
            )
        if self.vehicles.avoidance is not None:
            raise FlightError(
                f"the controller returned {named(given)} at t = {self.t:.3f} s, which [avoidance] cannot"
                " change; return forces [N], or remove [avoidance]"
            )
        if isinstance(given, AttitudeCommand):
            commands = self.flight.commands._replace(kind=fleet.ATTITUDE, **arrays)
        else:
            commands = self.flight.commands._replace(kind=fleet.ROTORS, speeds=arrays["speed"])
        self.flight = self.flight._replace(commands=commands)
        return self.plan.problem._replace()  # not the plan's own: a loss has to keep it held

    def watch(self, *, last: bool) -> None:
        """Search the steps flown for extremes."""
        self.extremes.avoidance = self.vehicles.avoidance
        if self.leader is not None:
            self.extremes.led = self.leader.extremes(self.t)
        if rows := int(self.sampled.count[fleet.TRAILED]):
            assert self.flown is not None
            # A motion that grows beyond all bounds has extremes up to there.
            within = (abs(self.state.trail.points[:rows]) < _FAR).all(axis=(1, 2))
            self.state.count[records.TRAILED] = rows if within.all() else int(within.argmin())
            self.extremes.take_path(self.flown, self.workspace, self.state)
            self.sampled.count[fleet.TRAILED] = self.state.count[records.TRAILED] = 0
            self.unjudged = True
        if last and self.unjudged:  # the rest is kept by the flight itself
            assert self.first_tick is not None  # it has begun
            ticks = int(self.sampled.count[fleet.TICKS]) - self.first_tick
            self.extremes.take_vehicles(
                self.sampled, self.flight.vehicles, self.gone, self.lost, ticks
            )
            self.unjudged = False

    def _segment(self, problem: Problem, t_end: float) -> None:
        """Fly to ``t_end`` [s] and record the samples on the way."""
        plan, sampled = self.plan, self.sampled
        n, m = len(plan.masses), len(plan.edges)
        self.flown = problem
        times = self.times(t_end)
        self.begun, given = True, self.vehicles.avoidance
        call = fleet.segment(n, m, t_end, times, _STEPS)
        sampled.count[fleet.SAMPLES] = 0
        status = records.PAUSED
        try:
            while status == records.PAUSED:
                self._supply()
                status = fly_ticks(problem, self.workspace, self.flight, sampled, call, given)
                self._follow()
                if status == records.FINISHED:  # to a rounding error of the grid of steps
                    self.state.clock[records.TIME] = t_end
                if self.external is not None:
                    self.external.check()
                self.check()
                self.watch(last=False)
                self.pause(self.t)
        finally:
            done = int(sampled.count[fleet.SAMPLES])
            finite = np.isfinite(call.S[:done]).all(axis=(1, 2)) & np.isfinite(call.dS[:done]).all(
                axis=(1, 2)
            )
            done = done if finite.all() else int(finite.argmin())
            if done:
                self._keep(problem, call, done)
        if not np.isfinite(sampled.S).all():
            who = agent_names(np.flatnonzero(~np.isfinite(sampled.S).all(axis=1)))
            raise StoppedError(
                f"the motion of {who} grows beyond all bounds by t = {self.t:.2f} s: the control is unstable. Lower"
                " the gains, or raise the rates in [autopilot]"
            )
        if given is not None and given.count[avoidance.FULL]:
            raise StoppedError(
                f"avoidance cannot go on at t = {self.t:.2f} s: too many vehicles are near each other for their"
                " speeds. Fly slower, or farther apart"
            )
        if status != records.FINISHED:
            own = self.external is not None
            raise StoppedError(diagnose(self.place, own_force=own, collapsed=True))

    def _supply(self) -> None:
        """Make tables for the next ticks, if those that there are end here or belong to another reference."""
        tables, tick = self.flight.tables, int(self.sampled.count[fleet.TICKS])
        planned, given = self.plan.problem, self.vehicles.tables
        if planned is self.tabled and tables.first <= tick < tables.last:
            return
        if planned is not self.tabled and given.compensated:
            moved = given.start_path(planned, tick)
            s = self.sampled
            for known in (s.seen, s.history, s.sent, s.heard):
                np.add(known, moved, out=known)
        # A piece of a reference that is led holds until the next stop
        until = self.plan.t_end
        if self.led:
            until = min(until, self.led_until if not self.steered else self.stop)
        last = min(tick + _TICKS, math.ceil(until * given.rate) + 1)
        made = given.made(tick, max(last, tick + 1), planned, self.turn)
        self.flight, self.tabled = self.flight._replace(tables=made), planned

    def _follow(self) -> None:
        """Take over the true state, and what it cost."""
        n, m = len(self.plan.masses), len(self.plan.edges)
        y, state, sampled = self.state.y, self.state, self.sampled
        y[: 3 * n], y[3 * n : 6 * n] = sampled.S[:, :3].ravel(), sampled.S[:, 3:6].ravel()
        y[6 * n : 6 * n + m] = sampled.integral[0]
        if self.plan.frame is not None:
            y[6 * n + m : 6 * n + m + 4] = sampled.frame[0]
        state.clock[records.TIME] = sampled.clock[fleet.TIME]
        state.count[records.EVALUATIONS] = 4 * sampled.count[fleet.STEPS]
        state.count[records.ACCEPTED] = sampled.count[fleet.STEPS]

    def _led(self, times: Floats) -> Led:
        """What the slots follow at the samples, if they are tracked, and how the vehicles turn."""
        return tuple((*span[:3], self.turn) for span in super()._led(times))

    def end(self) -> Any:
        """End the phase; the vehicles keep their states."""
        self.vehicles.yaw = self.vehicles.tables.yaw_at(self.plan.problem, self.t, self.turn)
        self.vehicles.S, self.vehicles.state = self.sampled.S, self.sampled
        if self.leader is not None:
            self.vehicles.scale = self.leader.deviation.scale
        return super().end()

    def release(self) -> None:
        """Keep the workspace: the state of the next phase may refer to it."""

    # -- recording --------------------------------------------------------------------------------

    def _keep(self, problem: Problem, call: fleet.SampledSegment, done: int) -> None:
        """Store samples: states and forces as flown, references and constraints of the plan."""
        plan = self.plan
        S, times = call.S[:done], call.times[:done]
        parts = [S[..., :3].reshape(done, -1), S[..., 3:6].reshape(done, -1), call.integral[:done]]
        frame = np.full((done, 4), np.nan)
        if plan.frame is not None:
            frame = call.frame[:done]
            parts.append(frame)
        planned = native.record(plan.problem, self.workspace, times, np.concatenate(parts, axis=1))
        out, kept = _as_flown(planned, call, done, self.flight.vehicles, problem)
        self.keep(times, out, call.integral[:done], frame, kept, self._layers(call, done))

    def _layers(self, call: fleet.SampledSegment, done: int) -> LayerSamples | None:
        """Samples of what avoidance did."""
        if self.vehicles.avoidance is None:
            return None
        times, acting = call.times[:done], call.layers[:done]
        if self.leader is None:
            return LayerSamples(np.ones(done), np.zeros((done, 3)), acting)
        return LayerSamples(self.leader.rate(times), self.leader.displacement(times), acting)


def _as_flown(
    planned: Record,
    call: fleet.SampledSegment,
    done: int,
    vehicles: fleet.Quadrotors,
    problem: Problem,
) -> tuple[Record, VehicleSamples]:
    """A record of references with the forces of vehicles, and the samples of the vehicles themselves."""
    S, a = call.S[:done], call.dS[:done, :, 3:6]
    curves = vehicles.thrust.T[..., None]
    rotor = np.where(vehicles.point[:, None], 0.0, fleet.thrust_of(S[..., 13:], *curves))
    T = att.dcm_from_quaternion(np.where(vehicles.point[:, None], [1.0, 0, 0, 0], S[..., 6:10]))
    thrust = rotor.sum(axis=2)[..., None] * T[..., 2, :]
    thrust = np.where(vehicles.point[:, None], call.command[:done, :, :3], thrust)
    rest = vehicles.m[:, None] * a - thrust
    air = rest + (vehicles.m * vehicles.g)[:, None] * np.array([0.0, 0.0, 1.0])
    if problem.external.address:
        air = air - (planned.f_E + (problem.vehicles.m * vehicles.g)[:, None] * [0.0, 0.0, 1.0])
    seen = call.seen[:done]
    out = planned._replace(
        a=a, f_E=rest, f_D=air, f_u=call.f_u[:done], f_C=call.f_C[:done],
        r_seen=seen[..., :3], v_seen=seen[..., 3:],
    )  # fmt: skip
    kept = VehicleSamples(
        S[..., 6:10], S[..., 10:13], rotor, np.linalg.norm(thrust, axis=2), call.saturated[:done]
    )
    return out, kept
