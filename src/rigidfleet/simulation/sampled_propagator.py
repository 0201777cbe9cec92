"""Vehicles with sampled control: their motion is integrated between the ticks of their autopilots."""

from __future__ import annotations

import math

import numpy as np

from rigidfleet._common.text import agent_names
from rigidfleet.errors import FlightError, StoppedError
from rigidfleet.kernel import avoidance, fleet, records
from rigidfleet.kernel.clock_records import OFF, PACE, RATE, WORST
from rigidfleet.kernel.engine import native
from rigidfleet.kernel.engine.sampled import fly_ticks
from rigidfleet.kernel.mail import CLOCK, Links, Mail, write_edges_of_links
from rigidfleet.kernel.problem import ITERATED, Problem
from rigidfleet.kernel.records import Record
from rigidfleet.math import attitude as att
from rigidfleet.mission import Mission
from rigidfleet.planning.avoidance import avoidance_in_flight
from rigidfleet.planning.derivatives import slots_by_own_clocks
from rigidfleet.planning.vehicles import (
    TickTables,
    gilbert_transitions,
    initial_yaw_and_rate,
    sampled_flight,
    yaw_turn_from,
)
from rigidfleet.planning.virtual_clock import postpone
from rigidfleet.result import Extremum
from rigidfleet.simulation.callbacks import (
    AttitudeCommand,
    Command,
    article_and_kind,
    check_command,
)
from rigidfleet.simulation.diagnosis import diagnose
from rigidfleet.simulation.leading import Leader, layers
from rigidfleet.simulation.own_laws import Law, OwnLaws, View
from rigidfleet.simulation.plan_integration import PlanIntegration
from rigidfleet.simulation.recording import LayerSamples, VehicleSamples
from rigidfleet.typing import Floats, Ints

#: Greatest number of ticks in a table, and of steps between two returns to Python.
_TICKS, _STEPS = 1024, 4000
#: Time for which vehicles with clocks of their own fly before the plan's events are put off [s].
_STRETCH = 0.1
#: Pace of a clock below which it waits.
_SLOWED = 0.99
#: Distance [m] and speed [m/s] that no vehicle reaches in flight.
_FAR = 1e9


class FleetState:
    """The vehicles of a flight, from phase to phase: what they are, where they are, and their yaw."""

    def __init__(self, mission: Mission, max_step: float, agent: Law | type | None = None) -> None:
        self.flight = sampled_flight(mission, max_step)
        self.laws = None if agent is None else OwnLaws(agent, self.flight)
        if self.laws is not None and self.flight.clocks.own:
            raise FlightError(
                "a law of one's own is asked at the ticks of one clock: remove [network.clocks] and disturbances.stuck,"
                " or leave agent out"
            )
        if self.laws is not None:
            commands = self.flight.commands._replace(kind=fleet.OWN)
            self.flight = self.flight._replace(commands=commands)
        self.tables = TickTables(mission, self.flight)
        self.avoidance = avoidance_in_flight(mission, self.flight)
        start = mission.fleet
        self.yaw = initial_yaw_and_rate(mission)  # asked at the last switch, and its rate
        yaw = float(self.yaw[0, 0])
        self.start = fleet.hover_states(self.flight.vehicles, start.position, start.velocity, yaw)
        self.state: fleet.SampledState | None = None  # now, or at the end of the phase before
        self.layers = layers(mission)  # settings of the clock and the body layer, if they may act
        self.output_step = mission.output_step
        self.burst = None if mission.network is None else mission.network.burst
        self.scale = np.array([1.0, 0.0, 0.0])  # of the slots at the last switch, two derivatives
        self.waited = 0.0  # time by which phases came to their ends later than planned [s]

    @property
    def network(self) -> tuple[Links, Mail] | None:
        """The network, and what was sent on it; None without one, or before the flight."""
        links = self.flight.network
        return (links, self.state.mail) if links.every and self.state is not None else None

    def lose_messages(self, loss: float) -> None:
        """Let links lose a share of the messages from now on."""
        worsens, recovers = gilbert_transitions(loss, self.burst)
        network = self.flight.network._replace(worsens=worsens, recovers=recovers)
        self.flight = self.flight._replace(network=network)


class SampledPropagator:
    """Vehicles with sampled control in flight: a `Propagator` by steps of one length between the ticks of autopilots.

    The law of the plan is evaluated at measured states, at ticks. Whenever the kernel returns, ``state.y`` of the
    integration holds the true state, in the layout of the continuous flight.
    """

    control_start = 0.0  # as that of ticks

    def __init__(self, integration: PlanIntegration, vehicles: FleetState) -> None:
        plan = integration.plan
        self.integration, self.vehicles, self.flight = integration, vehicles, vehicles.flight
        self.tabled: Problem | None = None  # the plan's problem for which the tables are
        if vehicles.avoidance is not None:
            vehicles.avoidance = avoidance.for_next_phase(vehicles.avoidance)
        self.steered = False  # whether it is given by hand
        self.decided_until = -math.inf  # end of what the leader has decided [s]
        self.flown: Problem | None = None  # the problem of the steps in the trail
        self.unjudged = False  # whether steps were flown since the extremes of vehicles were taken
        self.first_tick: int | None = None
        self.leader: Leader | None = None
        if vehicles.layers is not None and plan.problem.control.tracks_slots:
            period = self.flight.every * self.flight.steps * self.flight.h
            self.leader = Leader(vehicles.layers, plan, period)
            self.leader.deviation.scale = vehicles.scale
        #: How vehicles turn about the vertical.
        self.turn = yaw_turn_from(plan.problem, plan.start, vehicles.tables.yaw, vehicles.yaw)
        #: When own clocks were last looked at, and by how much they were late then [s].
        self.late = plan.start, 0.0
        self.slowed: tuple[float, int] | None = None  # when they first waited [s], and for whom

    def begin(self, y: Floats, t: float) -> None:
        """Begin to fly at a state (n,) and time [s]; vehicles go on from the states that they have."""
        at, plan, fleet_state = self.integration, self.integration.plan, self.vehicles
        n, m = len(plan.masses), len(plan.edges)
        at.begin(y, t, 6 * n, records.VEHICLES_TRAIL)
        lost = self.flight.vehicles._replace(lost=plan.before.lost.copy())
        self.flight = self.flight._replace(vehicles=lost)
        frame = y[6 * n + m : 6 * n + m + 4] if plan.frame is not None else None
        integral, before = y[6 * n : 6 * n + m], fleet_state.state
        law = plan.problem.law
        begun = fleet.initial_state(
            self.flight, fleet_state.start if before is None else before.S, at.workspace, frame=frame,
            iterations=law.iterations if law.solver == ITERATED else 1,
        )  # fmt: skip
        if before is None:
            begun.integral[:] = integral
        else:
            renewed = fleet.state_under_problem(before, at.workspace, integral, frame=frame)
            if self.first_tick is None:  # extremes are those of the phase, also after a loss in it
                fresh = ("peak", "peak_time", "worst", "worst_time", "saturations")
                renewed = renewed._replace(**{name: getattr(begun, name) for name in fresh})
            begun = renewed
        # Edges that end within a phase are those of what is lost.
        lose = self.first_tick is not None
        write_edges_of_links(self.flight.network, begun.mail, plan.edges, integral, lose=lose)
        trail = at.state.trail
        self.sampled = fleet_state.state = begun._replace(
            trail=trail._replace(gauge=trail.gauge[:, :0])
        )
        if fleet_state.avoidance is not None:
            fleet_state.avoidance = avoidance.with_edges(fleet_state.avoidance, m)
        if self.first_tick is None:
            self.first_tick = int(begun.count[fleet.TICKS])
            self.gone = plan.before.lost.copy()  # (N,) vehicles that do not fly in this phase
            begun.peak_time[:] = begun.worst_time[:] = t
        self.tabled = None
        self.steps_before = int(begun.count[fleet.STEPS])  # those of the flight before

    # -- flying -----------------------------------------------------------------------------------

    def _lead_reference(self) -> float:
        """Let the layers above the barriers lead the plan's reference, if there are any; until when that holds [s]."""
        leader, arrays, t = self.leader, self.vehicles.avoidance, self.integration.t
        if leader is None or arrays is None or self.steered:
            return math.inf
        end = leader.end_of_period(t, self.vehicles.output_step)
        if t >= self.decided_until:
            self.decided_until = end
            if (problem := leader.lead(t, end, arrays)) is not None:
                self._continue_with(problem)
        return self.decided_until

    @property
    def lateness(self) -> float:
        """Time by which the plan's references are behind now, in the mean of the clocks of vehicles that fly [s]."""
        if not self.flight.clocks.own:
            return 0.0
        tau, ticks = self.sampled.tau[~self.flight.vehicles.lost], self.sampled.count[fleet.TICKS]
        # Clocks run on between ticks
        since = self.integration.t - max(ticks - 1, 0) * self._tick_duration
        return float(-(tau[:, OFF] + since * (tau[:, RATE] - 1.0)).mean())

    @property
    def _tick_duration(self) -> float:
        return self.flight.steps * self.flight.h

    def _postpone_plan_events(self) -> None:
        """Move the events of the plan that have not come yet by what own clocks are late."""
        plan, t, (t_before, before) = self.integration.plan, self.integration.t, self.late
        late = max(0, round(self.lateness / self._tick_duration)) * self._tick_duration
        self.late = t, late

        def postponed_time(time: float) -> float:
            """When clocks come to what they were to come to at a time, if they had stayed as late as before."""
            due, passed, now = time - before, t_before - before, t - late
            if due <= passed:
                return time
            return due + float(np.interp(due, [passed, max(now, passed + 1e-9)], [before, late]))

        plan.postpone_arrival(postponed_time)
        if self.slowed is None and (self.sampled.tau[:, PACE] < _SLOWED).any():
            self.slowed = t, int(self.sampled.tau[:, WORST].argmax())

    def take_up(self, problem: Problem) -> None:
        """Make a problem that was made by hand the plan's: the layers above the barriers then rest."""
        self.steered = True
        if self.leader is not None:
            self.leader.now = None
        self._continue_with(problem)

    def _continue_with(self, problem: Problem) -> None:
        """Make another problem the plan's; vehicles that turn along their way do so from the yaw they have now."""
        tables, plan, t = self.vehicles.tables, self.integration.plan, self.integration.t
        if tables.yaw.kind == "along":
            now = tables.yaw_at(plan.problem, t, self.turn)
            self.turn = yaw_turn_from(problem, t, tables.yaw, now)
        plan.problem = problem

    def states_seen(self) -> dict[str, Floats]:
        """States of now or, with noise, as the law knows them at a tick and until the next."""
        S = self.sampled.S
        seen = S[:, :6]
        if self.vehicles.tables.noise is not None:
            self._measure_if_due()
            tables, tick = self.flight.tables, self.sampled.count[fleet.STEPS] // self.flight.steps
            # About the path of that tick, if there are any
            seen = self.sampled.seen + tables.path[max(tick - tables.first, 0) :][:1].sum(axis=0)
        parts = seen[:, :3], seen[:, 3:], S[:, 6:10], S[:, 10:13], S[:, 13:]
        names = "position", "velocity", "attitude", "rates", "rotor_speed"
        return {name: x.copy() for name, x in zip(names, parts, strict=True)}

    def _measure_if_due(self) -> None:
        """Measure what the law will know if a tick is due."""
        self._supply_tick_tables()
        at, n = self.integration, len(self.sampled.S)
        now = fleet.sampled_segment(n, len(at.plan.edges), at.t, max_steps=0)
        fly_ticks(at.plan.problem, at.workspace, self.flight, self.sampled, now)

    def views_of_laws(self) -> list[View | None]:
        """What each vehicle with a law of its own will know if a tick of the laws is due; None for those lost."""
        self._measure_if_due()
        at, laws = self.integration, self.vehicles.laws
        assert laws is not None
        return laws.views(
            at.plan.phase.name, at.plan.problem, at.workspace, self.flight, self.sampled
        )

    def hold_command(self, command: Command | None) -> None:
        """Hold the thrust and attitude, or the speeds of rotors, that a controller commands; None: no longer."""
        n, t = len(self.sampled.S), self.integration.t
        commands = fleet.no_commands(n)
        self.flight = self.flight._replace(commands=commands)
        if command is None:
            return
        arrays = check_command(command, n, t)
        why = ""
        if self.flight.vehicles.point.any():
            why = "but some agents are points; return forces [N]"
        elif self.vehicles.avoidance is not None:
            why = "which [avoidance] cannot change; return forces [N], or remove [avoidance]"
        if why:
            what = article_and_kind(command)
            raise FlightError(f"the controller returned {what} at t = {t:.3f} s, {why}")
        if isinstance(command, AttitudeCommand):
            commands = commands._replace(kind=fleet.ATTITUDE, **arrays)
        else:
            commands = commands._replace(kind=fleet.ROTOR_SPEEDS, speeds=arrays["speed"])
        self.flight = self.flight._replace(commands=commands)

    def search_extremes(self, *, last: bool) -> None:
        """Search the steps flown for extremes."""
        at, extremes = self.integration, self.integration.extremes
        extremes.avoidance = self.vehicles.avoidance
        if self.leader is not None:
            extremes.of_layers = self.leader.layer_extremes(at.t)
        if self.slowed is not None:
            extremes.of_layers = {"clock": Extremum(self.late[1], *self.slowed, -1)}
        if rows := int(self.sampled.count[fleet.TRAILED]):
            assert self.flown is not None
            # A motion that grows beyond all bounds has extremes up to there.
            points = at.state.trail.points[:rows]
            if not -_FAR < points.min() <= points.max() < _FAR:  # NaN is not, either
                rows = int((abs(points) < _FAR).all(axis=(1, 2)).argmin())
            at.state.count[records.TRAILED] = rows
            extremes.monitor_paths(self.flown, at.state)
            self.sampled.count[fleet.TRAILED] = at.state.count[records.TRAILED] = 0
            self.unjudged = True
        if last and self.unjudged:  # the rest is kept by the flight itself
            assert self.first_tick is not None  # it has begun
            ticks = int(self.sampled.count[fleet.TICKS]) - self.first_tick
            extremes.take_vehicle_extremes(self.sampled, self.flight.vehicles, self.gone, ticks)
            self.unjudged = False

    def fly(self, problem: Problem, t_end: float) -> None:
        """Fly to ``t_end`` [s], the end of the plan or of what is decided, and record the samples on the way."""
        at, plan, sampled = self.integration, self.integration.plan, self.sampled
        if self.flight.clocks.own:
            t_end = min(t_end, (math.floor(at.t / _STRETCH + 1e-6) + 1.0) * _STRETCH)
        elif problem is plan.problem:
            t_end = min(t_end, self._lead_reference())
            problem = plan.problem
        t_end = min(t_end, plan.t_end)  # the leader may have put it off
        n, m = len(plan.masses), len(plan.edges)
        self.flown = problem
        times = at.sample_times(t_end)
        at.begun, arrays = True, self.vehicles.avoidance
        network, laws = self.vehicles.flight.network, self.vehicles.laws
        if network is not self.flight.network:
            self.flight = self.flight._replace(network=network)
        call = fleet.sampled_segment(n, m, t_end, times, _STEPS, links=len(network.links))
        sampled.count[fleet.SAMPLES] = 0
        looked = laws is not None and laws.has_current_views(problem, sampled)
        status = records.ASKS if looked else records.PAUSED
        try:
            while status in (records.PAUSED, records.ASKS):
                if status == records.PAUSED:
                    self._supply_tick_tables()
                elif laws is not None:
                    laws.call_laws(plan.phase.name, problem, at.workspace, self.flight, sampled)
                status = fly_ticks(problem, at.workspace, self.flight, sampled, call, arrays)
                self._update_integrator_state()
                if status == records.ASKS:
                    continue
                if status == records.FINISHED:  # to a rounding error of the grid of steps
                    at.state.clock[records.TIME] = t_end
                if at.external is not None:
                    at.external.raise_user_error()
                at.raise_errors()
                self.search_extremes(last=False)
                at.pause()
        finally:
            done = int(sampled.count[fleet.SAMPLES])
            finite = np.isfinite(call.S[:done]).all(axis=(1, 2)) & np.isfinite(call.dS[:done]).all(
                axis=(1, 2)
            )
            done = done if finite.all() else int(finite.argmin())
            if done:
                rows = {name: x[:done] for name, x in call._asdict().items() if np.ndim(x)}
                self._store_flown_samples(problem, call._replace(**rows))
        if self.flight.clocks.own:
            self._postpone_plan_events()
        if not np.isfinite(sampled.S).all():
            who = agent_names(np.flatnonzero(~np.isfinite(sampled.S).all(axis=1)))
            raise StoppedError(
                f"the motion of {who} grows beyond all bounds by t = {at.t:.2f} s: the control is unstable. Lower"
                " the gains, or raise the rates in [autopilot]"
            )
        if arrays is not None and arrays.count[avoidance.FULL]:
            raise StoppedError(
                f"avoidance cannot go on at t = {at.t:.2f} s: too many vehicles are near each other for their"
                " speeds. Fly slower, or farther apart"
            )
        if status != records.FINISHED:
            raise StoppedError(diagnose(at, collapsed=True))

    def _supply_tick_tables(self) -> None:
        """Make tables for the next ticks, if those that there are end here or belong to another reference."""
        tables, tick = self.flight.tables, int(self.sampled.count[fleet.TICKS])
        plan, source = self.integration.plan, self.vehicles.tables
        planned = plan.problem
        if planned is self.tabled and tables.first <= tick < tables.last:
            return
        before, tau = None, self.sampled.tau if self.flight.clocks.own else None
        if planned is not self.tabled and source.compensated:
            before = source.switch_path(planned, tick, tables, tau)
        # A piece of a reference that is led holds until the next stop
        until = plan.t_end
        if self.steered:
            until = min(until, self.integration.stop)
        elif self.leader is not None and self.leader.now is not None:
            until = min(until, self.decided_until)
        last = min(tick + _TICKS, math.ceil(until * source.rate) + 1)
        made = source.tables_for(tick, max(last, tick + 1), planned, self.turn, tau)
        if before is not None:  # states that were measured about another path
            s, moved = self.sampled, before - made.path[0]
            for known in (s.seen, s.history):
                np.add(known, moved, out=known)
        self.flight, self.tabled = self.flight._replace(tables=made), planned

    def _update_integrator_state(self) -> None:
        """Take over the true state, and what it cost."""
        plan, state, sampled = self.integration.plan, self.integration.state, self.sampled
        n, m, y = len(plan.masses), len(plan.edges), state.y
        y[: 3 * n], y[3 * n : 6 * n] = sampled.S[:, :3].ravel(), sampled.S[:, 3:6].ravel()
        y[6 * n : 6 * n + m] = sampled.integral
        if plan.frame is not None:
            y[6 * n + m : 6 * n + m + 4] = sampled.frame[0]
        state.clock[records.TIME] = sampled.clock[fleet.TIME]
        steps = int(sampled.count[fleet.STEPS]) - self.steps_before
        state.count[records.EVALUATIONS] = 4 * steps
        state.count[records.ACCEPTED] = steps

    def hand_over(self) -> None:
        """Leave the vehicles' states to the next phase, and so the workspace, to which these may refer."""
        plan, t = self.integration.plan, self.integration.t
        self.vehicles.yaw = self.vehicles.tables.yaw_at(plan.problem, t - self.lateness, self.turn)
        if self.flight.clocks.own:
            # The next phase is planned from now on: its times are later by as much, for all clocks alike.
            late = round(self.lateness / self._tick_duration) * self._tick_duration
            mail = self.sampled.mail
            for off in (self.sampled.tau[:, OFF], mail.heard[:, CLOCK], mail.post[..., CLOCK]):
                np.add(off, late, out=off)  # also in messages
            self.vehicles.waited += late
            self.vehicles.tables.delay_path(late)
            plan.problem = postpone(plan.problem, late)
            plan.reference = plan.reference._replace(t0=plan.reference.t0 + late)
        if self.leader is not None:
            self.vehicles.scale = self.leader.deviation.scale

    # -- recording --------------------------------------------------------------------------------

    def _store_flown_samples(self, problem: Problem, call: fleet.SampledSegment) -> None:
        """Store samples: states and forces as flown, references and constraints of the plan."""
        at, plan, times, S = self.integration, self.integration.plan, call.times, call.S
        done = len(times)
        parts = [S[..., :3].reshape(done, -1), S[..., 3:6].reshape(done, -1), call.integral]
        frame = np.full((done, 4), np.nan)
        if plan.frame is not None:
            frame = call.frame
            parts.append(frame)
        tau, y = call.tau, np.concatenate(parts, axis=1)
        if self.flight.clocks.own:
            planned = self._record_by_own_clocks(times, y, tau)
            plan_time = (times - self.vehicles.waited)[:, None, None] + tau[..., :1]
            tau = np.concatenate([tau, plan_time], axis=2)
        else:
            planned = native.record(plan.problem, at.workspace, times, y)
            tau = tau[..., :0]
        out, kept = self._flown_record(planned, call, problem, tau)
        acting = self._avoidance_samples(times, call.layers)
        at.store_piece(times, out, call.integral, frame, self.turn, kept, acting)

    def _record_by_own_clocks(self, times: Floats, y: Floats, tau: Floats) -> Record:
        """A record at the mean of own clocks ``tau`` (K, N, 3), with forces of now, and the slot by each clock."""
        problem, work = self.integration.plan.problem, self.integration.workspace
        off, rate = tau[:, ~self.flight.vehicles.lost, :2].mean(axis=1).T
        f_E = native.record(problem, work, times, y).f_E
        planned = native.record(problem, work, times + off, y)._replace(f_E=f_E)
        if problem.control.tracks_slots:
            r_ref = slots_by_own_clocks(problem.reference, problem.motion, times, tau)[:, 0]
            planned = planned._replace(r_ref=r_ref)
        for x in (planned.motion[:, 3:], planned.rates, planned.d_dot):
            np.multiply(x, rate[:, None], out=x)
        return planned

    def _avoidance_samples(self, times: Floats, acting: Ints) -> LayerSamples | None:
        """Samples of what avoidance did at times (K,) [s], where these layers (K, N) acted."""
        if self.vehicles.avoidance is None:
            return None
        if self.leader is None:
            return LayerSamples(np.ones(len(times)), np.zeros((len(times), 3)), acting)
        return LayerSamples(self.leader.clock_rate(times), self.leader.displacement(times), acting)

    def _flown_record(
        self, planned: Record, call: fleet.SampledSegment, problem: Problem, tau: Floats
    ) -> tuple[Record, VehicleSamples]:
        """A record of references with the forces of vehicles, and the samples of the vehicles themselves."""
        flight, S, a = self.flight, call.S, call.dS[:, :, 3:6]
        vehicles = flight.vehicles
        curves = vehicles.thrust.T[..., None]
        rotor = np.where(vehicles.point[:, None], 0.0, fleet.thrust_of(S[..., 13:], *curves))
        T = att.dcm_from_quaternion(np.where(vehicles.point[:, None], [1.0, 0, 0, 0], S[..., 6:10]))
        thrust = rotor.sum(axis=2)[..., None] * T[..., 2, :]
        thrust = np.where(vehicles.point[:, None], call.command[:, :, :3], thrust)
        rest = vehicles.m[:, None] * a - thrust
        air = rest + (vehicles.m * vehicles.g)[:, None] * np.array([0.0, 0.0, 1.0])
        if problem.external.address:
            air = air - (planned.f_E + (problem.vehicles.m * vehicles.g)[:, None] * [0.0, 0.0, 1.0])
        out = planned._replace(
            a=a, f_E=rest, f_D=air, f_u=call.f_u, f_C=call.f_C, r_seen=call.seen[..., :3], v_seen=call.seen[..., 3:]
        )  # fmt: skip
        sent = np.where(call.stamp < 0, np.nan, flight.start + call.stamp * flight.steps * flight.h)
        kept = VehicleSamples(
            S[..., 6:10], S[..., 10:13], rotor, np.linalg.norm(thrust, axis=2), call.saturated,
            call.times[:, None] - sent, tau,
        )  # fmt: skip
        return out, kept
