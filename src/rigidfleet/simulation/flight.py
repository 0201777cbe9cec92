"""Fly a mission: run its phases, restart the integrator at every switch, report progress."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigidfleet.errors import FlightError
from rigidfleet.kernel import problem as k
from rigidfleet.kernel import records
from rigidfleet.kernel.engine import native
from rigidfleet.math import attitude as att
from rigidfleet.mission import Establish, Fly, Mission, Phase, Reshape, Settle, Turn, as_mission
from rigidfleet.planning import solvers
from rigidfleet.planning.disturbances import disturbance, without
from rigidfleet.planning.plan import PhasePlan, plan_phase
from rigidfleet.planning.reference import Pose, Situation, about_cm
from rigidfleet.planning.tolerances import absolute_tolerances, most_steps, tolerance_of_velocity
from rigidfleet.result import PhaseRecord, Result
from rigidfleet.simulation.callbacks import ExternalForce, Force, asked
from rigidfleet.simulation.diagnosis import diagnose
from rigidfleet.simulation.extremes import Extremes
from rigidfleet.simulation.recording import Piece, assemble

if TYPE_CHECKING:
    from rigidfleet.kernel.large import solver as large
    from rigidfleet.kernel.problem import Array

#: The integrator returns to Python after so many steps, or fewer: as many as take this long [s of
#: wall time], often enough for Ctrl-C and progress whatever the size of the formation.
_STEPS, _PAUSE = 2000, 0.05
#: So many at the start of a phase, whose steps may take a thousand times as long as those of the one before.
_FIRST_STEPS = 10
#: Residual of an iterative solve, as a share of the integrator's tolerance; the relative one within bounds.
_RESIDUAL, _LEAST, _MOST_RESIDUAL = 1e-3, 1e-13, 1e-8
#: Below this share of a velocity's tolerance, the error of an acceleration, times a second, is nothing.
_FLOOR = 3e-2
#: Where a phase ends by settling, whether it has is asked this often [s].
_CHECK = 0.1
#: Progress is reported this often [s of wall time].
_REPORT = 0.1
#: A frame further than this from the slots it is attached to has left them [rad].
_FLIPPED = math.pi / 2


@dataclass(frozen=True)
class Progress:
    """How far a flight is."""

    t: float  # mission time reached [s]
    t_end: float  # mission time at the end, settling phases at their longest [s]
    phase: str
    wall: float  # time taken so far [s]
    planning: bool = False  # the phase has not begun to be flown


@dataclass(frozen=True)
class Observation:
    """What a controller sees at a control step; arrays (N, 3) world axes, copies.

    Positions and velocities are as measured, masses as believed.
    """

    t: float  # [s]
    phase: str
    position: Array  # [m]
    velocity: Array  # [m/s]
    reference_position: Array  # desired [m]
    reference_velocity: Array  # [m/s]
    reference_acceleration: Array  # [m/s^2]
    masses: Array  # (N,) [kg]
    gravity: float  # [m/s^2]


Controller = Callable[[Observation], ArrayLike]


class FlightInterrupted(KeyboardInterrupt):
    """Ctrl-C during a flight; ``result`` holds what was flown."""

    def __init__(self, result: Result) -> None:
        super().__init__(result.ending)
        self.result = result


def simulate(
    mission: Mission | str | Path,
    *,
    controller: Controller | None = None,
    rate: float = 50.0,
    force: Force | None = None,
    times: ArrayLike | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Result:
    """Fly a mission and return its record.

    Parameters
    ----------
    mission : a shipped name, a path or a `Mission`
    controller : in place of the input law wherever slots are tracked: a function of an
        `Observation` that returns the input force (N, 3) [N] of every agent, weight included. It
        is called ``rate`` times a second, its force held in between, as on a vehicle.
    rate : control rate [Hz]
    force : an external force f(t, r, v) -> (N, 3) [N], world axes, continuous in time, besides
        gravity. A Numba ``cfunc`` of void(double t, double* r, double* v, double* f, ssize_t n)
        is called without Python.
    times : samples [s] to record instead of a multiple of the mission's ``output_step``
    progress : called some times a second

    Returns
    -------
    Result
        A flight that fails on its way (a singular constraint, a phase that does not settle) comes
        back incomplete, with the diagnosis in ``ending``.

    Raises
    ------
    FlightInterrupted
        On Ctrl-C, with the incomplete result; before anything has flown, a plain
        KeyboardInterrupt.
    FlightError
        The controller or the force raised an exception, which is its cause, or returned something
        that is no force; its ``result`` is what had flown, incomplete, or None.
    MissionError
        There is no such mission, or it has errors.
    ValueError
        A time to record lies outside of the mission, or the control rate is not positive.
    """
    run = Flight(as_mission(mission), controller, rate, force, times, progress)
    try:
        run.fly()
    except KeyboardInterrupt:
        if not run.pieces:
            raise
        run.ending = f"interrupted at t = {run.now.t:.2f} s"
        raise FlightInterrupted(run.result()) from None
    except FlightError as error:
        if run.pieces:
            run.ending = f"{error}, in phase '{run.phases[-1].name}'"
            error.result = run.result()
        raise
    if not run.pieces:
        raise FlightError(run.ending or "the flight ended before the first time to record")
    return run.result()


class StoppedError(Exception):
    """The flight cannot go on; the message is the diagnosis."""


@dataclass
class Leg:
    """A phase under way."""

    index: int
    phase: Phase
    plan: PhasePlan
    workspace: k.Workspace
    state: records.Integrator
    t_end: float  # [s] at the latest
    asked: int = 0  # how often the user's controller has been
    held: k.Program | None = None  # with its force
    flown: k.Program | None = None  # what the steps in the trail were flown by
    solver: large.LargeSolver | None = (
        None  # of the multipliers, where that is not the kernel itself
    )

    @property
    def t(self) -> float:
        """Mission time reached [s]."""
        return float(self.state.clock[0])


class Flight:
    """One flight under way; `simulate` flies one of a mission's phases, others may fly on."""

    def __init__(
        self,
        mission: Mission,
        controller: Controller | None,
        rate: float,
        force: Force | None,
        times: ArrayLike | None,
        progress: Callable[[Progress], None] | None,
    ) -> None:
        self.mission = mission
        self.masses = np.array(mission.agents.mass)
        self.controller, self.rate = controller, rate
        self.disturbance = disturbance(mission)
        self.lost = np.zeros(mission.n_agents, dtype=np.bool_)
        self.external = ExternalForce(force, mission.n_agents) if force is not None else None
        self.times = None if times is None else _times(times, mission.latest_end)
        if not (isinstance(rate, int | float | np.number) and rate > 0.0):
            raise ValueError(f"the control rate must be positive [Hz], not {rate!r}")
        self.progress = progress
        frame = None
        if mission.body_frame is not None:
            b = mission.body_frame
            frame = att.dcm_from_euler(np.deg2rad([b.roll_deg, b.pitch_deg, b.yaw_deg]))
        self.now = Situation(
            0.0, np.array(mission.agents.position), np.array(mission.agents.velocity), frame=frame
        )
        self.pieces: list[Piece] = []
        self.extremes = Extremes(mission)
        self.phases: list[PhaseRecord] = []
        self.ending = ""
        self.started = self.reported = clock.perf_counter()
        self.count = np.zeros(3, dtype=np.int64)
        self.steps = _FIRST_STEPS  # at a time; more as soon as it is known how long they take
        self.solves: dict[solvers.Method, large.Counts] = {}

    def fly(self) -> None:
        """Run all phases, or as many as can be flown."""
        try:
            for index, phase in enumerate(self.mission.phases):
                self._phase(index, phase)
        except StoppedError as stop:
            self.ending = str(stop)

    # -- one phase --------------------------------------------------------------------------------

    def _phase(self, index: int, phase: Phase) -> None:
        if index:
            self._report(self.now.t, phase, planning=True)
        self.steps = _FIRST_STEPS
        leg = self._begin(index, phase)
        record = PhaseRecord(
            phase.name, phase.kind, phase.control, leg.plan.formation, leg.t, leg.t,
            settled=None if phase.settle is None else False,
            target=_target(self.mission, phase, leg.plan),
        )  # fmt: skip
        self.phases.append(record)
        try:
            if phase.settle is not None:
                record.settled = self._settle(leg, phase.settle)
            else:
                self._fly_to(leg, leg.t_end)
        finally:
            self._watch(leg, last=True)
            record.extremes = self.extremes.phase()
            self._count(leg)
            if leg.state.count[0] or leg.t > self.now.t:
                self._arrive(leg)
            record.t_end = self.now.t
        if phase.settle is not None and not record.settled:
            raise StoppedError(
                f"phase '{phase.name}' did not settle within {phase.settle.timeout:g} s: at t ="
                f" {self.now.t:.2f} s its error was above {phase.settle.tolerance:g} m. Give it a"
                " longer timeout or a larger tolerance, or see the constraint error to learn why"
            )

    def _begin(self, index: int, phase: Phase) -> Leg:
        t_end = _end(phase, self.now.t)
        _check_size(self.mission, phase)
        plan = plan_phase(self.mission, phase, self.now, t_end)
        self._check_frame(index, plan)
        external = 0 if self.external is None else self.external.address
        plan.program = plan.program._replace(external=external, disturbance=self.disturbance)
        if self.lost.any():
            self._release(plan)
        work, solver = self._equip(plan)
        y = self._pack(plan)
        state = self._integrator(plan, y, self.now.t)
        if solver is not None:
            scale = self._tolerances(plan, len(y)) + state.rtol * np.abs(y)
            state.clock[1] = _first_step(plan.program, work, state, scale, t_end - self.now.t)
        return Leg(index, phase, plan, work, state, t_end, solver=solver)

    def _equip(self, plan: PhasePlan) -> tuple[k.Workspace, large.LargeSolver | None]:
        """Workspace of a plan, and what solves for its multipliers where that is not the kernel itself."""
        program, dense = plan.program, plan.method == "dense"
        work = k.workspace(
            len(self.masses),
            len(plan.edges),
            with_h=program.control.allocation != k.RIGID,
            solver=program.law.solver,
            large=not dense,
        )
        if dense:
            return work, None
        solver = self._large(plan, work)
        plan.program = program._replace(graph=program.graph._replace(solver=solver.address))
        return work, solver

    def _large(self, plan: PhasePlan, work: k.Workspace) -> large.LargeSolver:
        """What solves for the multipliers of a large formation, in one phase."""
        from rigidfleet.kernel.large import solver as large

        edges = plan.edges
        points = self.now.r if plan.slots is None else plan.slots
        steps = solvers.sweep_steps(len(points), edges) if plan.method == "sweep" else None
        given = self.mission.integrator
        residual = min(max(_RESIDUAL * given.rtol, _LEAST), _MOST_RESIDUAL)
        floor = _FLOOR * float(self._atol_velocity(plan).min())  # of a step of a second
        order = partial(solvers.dissection, points, edges)
        p = plan.program
        return large.LargeSolver(
            p.vehicles, p.graph.edges, p.law, work, steps, order, residual, floor
        )

    def _tolerances(self, plan: PhasePlan, size: int) -> Array:
        """Absolute tolerances (size,) of the states."""
        given, large = self.mission.integrator, plan.method != "dense"
        return absolute_tolerances(
            given, size, self._atol_velocity(plan), plan.distances, large=large
        )

    def _atol_velocity(self, plan: PhasePlan) -> Array:
        """Absolute tolerance (N,) of velocities [m/s]."""
        given, beta = self.mission.integrator, plan.program.law.beta
        large = plan.method != "dense"
        return tolerance_of_velocity(given, self.now.r, self.masses, beta, large=large)

    def _integrator(self, plan: PhasePlan, y: Array, t: float) -> records.Integrator:
        rtol, trail = self.mission.integrator.rtol, self.extremes.begin(len(y), len(plan.edges))
        atol = self._tolerances(plan, len(y))
        return records.integrator(y, t, rtol=rtol, atol=atol, trail=trail)

    def _count(self, leg: Leg) -> None:
        """Add up what a leg, or its part up to a loss, has taken."""
        self.count += leg.state.count[:3]
        if leg.solver is not None:
            counts = leg.solver.counts
            self.solves.setdefault(leg.plan.method, type(counts)()).add(counts)

    def _fly_to(self, leg: Leg, t_end: float) -> None:
        """Integrate to ``t_end`` [s] under the phase's input law, or the user's controller."""
        if self.controller is None or leg.phase.control != "slots":
            self._integrate(leg, leg.plan.program, t_end)
            return
        start = self.now.t
        while leg.t < t_end:
            # Control instants count from the phase's start, wherever a stretch of it ends.
            if leg.held is None or leg.t >= start + leg.asked / self.rate:
                leg.held = self._controlled(leg, self.controller)
                leg.asked += 1
            self._integrate(leg, leg.held, min(start + leg.asked / self.rate, t_end))

    def _controlled(self, leg: Leg, controller: Controller) -> k.Program:
        """Ask the user's controller; return the phase's program with its force held."""
        plan, w, y = leg.plan, leg.workspace, leg.state.y
        native.closed_loop(leg.t, y, np.empty_like(y), plan.program, w)
        noisy = len(self.disturbance.noise_r) > 0
        r, v = (w.r_seen, w.v_seen) if noisy else (w.r, w.v)
        seen = Observation(
            leg.t, leg.phase.name, r.copy(), v.copy(), w.r_ref.copy(), w.v_ref.copy(),
            w.a_ref.copy(), self.masses.copy(), self.mission.gravity,
        )  # fmt: skip
        f = asked("the controller", leg.t, self.mission.n_agents, controller, seen)
        return plan.program._replace(control=plan.program.control._replace(kind=k.OPEN, force=f))

    def _integrate(self, leg: Leg, program: k.Program, t_end: float) -> None:
        """Integrate to ``t_end`` [s] through the times at which vehicles are lost.

        ``program`` may hold a user's force in place of the phase's own input law.
        """
        while leg.t < t_end:
            coming = np.where(self.lost, math.inf, self.mission.lost_at)
            if coming.min() <= leg.t:
                program = self._lose(leg, program, coming <= leg.t)
            else:
                self._stretch(leg, program, min(t_end, float(coming.min())))

    def _lose(self, leg: Leg, program: k.Program, now: NDArray[np.bool_]) -> k.Program:
        """Go on without the vehicles that are lost ``now`` (N,); returns what is flown of a program."""
        self._watch(leg, last=True)
        self.lost = self.lost | now
        self.now.lost = self.lost
        self.extremes.lose(self.lost)
        y, own, n = leg.state.y, program is leg.plan.program, len(self.masses)
        self._count(leg)
        kept = self._release(leg.plan)
        integral = y[6 * n : 6 * n + len(kept)][kept]
        y = np.concatenate([y[: 6 * n], integral])
        leg.state = self._integrator(leg.plan, y, leg.t)
        leg.workspace, leg.solver = self._equip(leg.plan)
        if own:
            return leg.plan.program
        mu = leg.plan.program.law.mu
        held = without(program, kept, self.lost, mu, large=leg.plan.method != "dense")
        leg.held = held._replace(graph=leg.plan.program.graph)
        return leg.held

    def _release(self, plan: PhasePlan) -> NDArray[np.bool_]:
        """Take a plan's edges to lost vehicles away; returns which are kept."""
        kept = ~np.any(self.lost[plan.edges], axis=1)
        plan.edges, plan.distances = plan.edges[kept], plan.distances[kept]
        plan.method = solvers.choose(len(self.masses), plan.edges, self.mission.constraint.solver)
        mu = self.mission.damping(plan.held, self.lost)
        plan.program = without(plan.program, kept, self.lost, mu, large=plan.method != "dense")
        return kept

    def _stretch(self, leg: Leg, program: k.Program, t_end: float) -> None:
        """Integrate to ``t_end`` [s] and record the samples on the way."""
        state = leg.state
        fresh = state.count[0] == 0 or program is not leg.plan.program
        if fresh:
            self._watch(leg, last=True)
        leg.flown = program
        times = self._samples(leg, t_end)
        samples = np.empty((len(times), len(state.y)))
        state.count[3] = 0
        first = np.nextafter(leg.t, math.inf)
        status = records.PAUSED
        try:
            while status == records.PAUSED:
                begun = clock.perf_counter()
                status = native.integrate(
                    program, leg.workspace, state, t_end, fresh, times, samples, self.steps
                )
                took = max(clock.perf_counter() - begun, 1e-6)
                if status == records.PAUSED:
                    self.steps = min(_STEPS, max(1, int(self.steps * min(_PAUSE / took, 10.0))))
                fresh = False
                if self.external is not None:
                    self.external.check()
                if leg.solver is not None:
                    leg.solver.check()
                self._watch(leg, last=False)
                self._report(leg.t, leg.phase)
                if status == records.PAUSED and self._stalled(leg):
                    break
        finally:
            done = int(state.count[3])
            if state.count[0] and not state.count[1] and len(times) and times[0] <= first:
                samples[0], done = state.y, 1  # no step was possible: the start is all there is
            if done:
                self._record(leg, program, times[:done], samples[:done])
        if status != records.FINISHED:
            collapsed = status == records.COLLAPSED
            own_force = self.external is not None
            raise StoppedError(
                diagnose(self.mission, leg, own_force=own_force, collapsed=collapsed)
            )

    def _samples(self, leg: Leg, t_end: float) -> Array:
        """Times to record in (t, t_end]: multiples of the output step, the phase's two ends, its arrival.

        The start of a phase is recorded one representable number after the switch, and so is what
        follows a loss.
        """
        t, first = leg.t, leg.state.count[0] == 0
        if self.times is not None:
            before = -math.inf if first and t == 0.0 else t
            return self.times[(self.times > before) & (self.times <= t_end)]
        step = self.mission.output_step
        low, high = math.floor(t / step + 1e-9) + 1, math.floor(t_end / step + 1e-9) + 1
        grid = np.minimum(np.arange(low, high) * step, t_end)
        # The two ends of a phase count, its arrival, and losses.
        lost = self.mission.lost_at
        for exact in (leg.plan.arrival, leg.t_end, *lost[np.isfinite(lost)]):
            if t < exact <= t_end:
                grid = np.sort(np.append(grid[abs(grid - exact) > 1e-9 * step], exact))
        start = [t if t == 0.0 else np.nextafter(t, math.inf)] if first else []
        return np.concatenate([start, grid])

    def _watch(self, leg: Leg, *, last: bool) -> None:
        """Look for extremes in the steps flown; the ``last`` ones under a program are not followed by others."""
        if leg.state.count[4] and leg.flown is not None:
            self.extremes.take(leg.flown, leg.workspace, leg.state, last=last)

    def _settle(self, leg: Leg, settle: Settle) -> bool:
        """Integrate in short stretches until the phase has settled; False if its time was over."""
        start = self.now.t
        step = self.mission.output_step
        step *= max(1.0, round(_CHECK / step))  # stretches end at samples
        least = start + leg.plan.program.reference.T_b
        since = math.inf
        while leg.t < leg.t_end:
            t = (math.floor(leg.t / step + 1e-9) + 1) * step
            self._fly_to(leg, min(t, leg.t_end))
            quiet = leg.t >= least and self._error(leg) <= settle.tolerance
            since = min(since, leg.t) if quiet else math.inf
            if leg.t - since >= settle.dwell - 1e-9:
                return True
        return False

    def _error(self, leg: Leg) -> float:
        """Largest error [m] of a constraint, a slot or the goal at the integrator's state.

        The goal's attitude counts by how far it takes a slot.
        """
        plan, w = leg.plan, leg.workspace
        native.closed_loop(leg.t, leg.state.y, np.empty_like(leg.state.y), plan.program, w)
        errors = [np.abs(w.c).max(initial=0.0)]
        local = plan.program.control.kind == k.LOCAL
        if local:
            errors.append(np.linalg.norm(w.r - w.r_ref, axis=1)[~self.lost].max())
        tracks = plan.program.control.kind != k.OPEN
        if tracks and plan.goal is not None and plan.slots is not None:
            goal, since = plan.goal, leg.t - plan.arrival  # it moves on
            left = np.where(self.lost, 0.0, self.masses)
            cm = left @ w.r / left.sum()
            if self.lost.any():  # the virtual body's, as those left show it
                cm += w.body[0] - left @ w.r_ref / left.sum()
            errors.append(np.linalg.norm(cm - goal.r - goal.v * since))
            turned = (w.T_ref if local else w.T) - (
                att.dcm_from_rotation_vector(goal.omega * since) @ goal.T
            )
            errors.append(np.linalg.norm(plan.slots @ turned, axis=1).max())
        return float(max(errors))

    # -- states -----------------------------------------------------------------------------------

    def _pack(self, plan: PhasePlan) -> Array:
        """The kernel's state vector at the switch."""
        now, masses = self.now, self.masses
        integral = now.integral.of(plan.edges, 0.0)
        if plan.frame is None:
            return np.concatenate([now.r.ravel(), now.v.ravel(), integral])
        q = att.quaternion_from_dcm(plan.frame)
        if not plan.program.body_formulation:
            return np.concatenate([now.r.ravel(), now.v.ravel(), integral, q])
        x, y = about_cm(now.r, masses) @ plan.frame.T, about_cm(now.v, masses) @ plan.frame.T
        cm = (masses @ now.r / masses.sum(), masses @ now.v / masses.sum())
        return np.concatenate([x.ravel(), y.ravel(), integral, q, *cm])

    def _arrive(self, leg: Leg) -> None:
        """Make the state the integrator has reached the situation of the next phase."""
        plan, state, w = leg.plan, leg.state, leg.workspace
        native.closed_loop(leg.t, state.y, np.empty_like(state.y), plan.program, w)
        n, m = len(self.masses), len(plan.edges)
        frame = self.now.frame
        if plan.frame is not None:
            q = state.y[6 * n + m : 6 * n + m + 4]
            frame = att.dcm_from_quaternion(q / np.linalg.norm(q))
        pose = None
        if plan.program.control.kind == k.LOCAL:
            pose = Pose(w.body[0].copy(), w.body[1].copy(), w.T_ref.copy(), w.body[3].copy())
        self.now = replace(
            self.now,
            t=leg.t,
            r=w.r.copy(),
            v=w.v.copy(),
            integral=self.now.integral.updated(plan.edges, state.y[6 * n : 6 * n + m]),
            reference=self.now.reference.updated(plan.edges, plan.distances),
            frame=frame,
            formation=plan.formation,
            slots=plan.slots,
            pose=pose,
            goal=plan.goal,
        )

    # -- diagnosis --------------------------------------------------------------------------------

    def _check_frame(self, index: int, plan: PhasePlan) -> None:
        """Stop where the formation has flipped: its slots no longer lie as the frame says."""
        both = {phase.control for phase in self.mission.phases[max(index - 1, 0) : index + 1]}
        if both != {"body"} or self.now.frame is None or plan.frame is None:
            return
        angle = att.angle_between(
            att.quaternion_from_dcm(self.now.frame), att.quaternion_from_dcm(plan.frame)
        )
        if angle > _FLIPPED:
            raise StoppedError(
                f"the formation '{self.now.formation}' has flipped at t = {self.now.t:.2f} s: its slots lie"
                f" {math.degrees(angle):.0f} deg from the body frame that was integrated. Out of a line,"
                " distances alone do not say to which side a shape unfolds. Track slots through that"
                ' phase: control = "slots"'
            )

    def _stalled(self, leg: Leg) -> bool:
        """Whether a phase takes far more steps than its length in time explains."""
        steps = int(leg.state.count[1] + leg.state.count[2])
        flown = leg.t - self.now.t
        return steps > most_steps(flown)

    def _report(self, t: float, phase: Phase, *, planning: bool = False) -> None:
        wall = clock.perf_counter()
        at_once = planning or len(self.pieces) == 0
        if self.progress is not None and (at_once or wall - self.reported > _REPORT):
            self.reported = wall
            t_end = self.mission.latest_end
            self.progress(Progress(t, t_end, phase.name, wall - self.started, planning))

    # -- the record -------------------------------------------------------------------------------

    def _record(self, leg: Leg, program: k.Program, times: Array, samples: Array) -> None:
        """Evaluate forces and references at the samples and keep them."""
        plan, w = leg.plan, leg.workspace
        n, m = len(self.masses), len(plan.edges)
        out = native.record(program, w, times, samples)
        if program is not plan.program:  # flown by a user's controller: the phase's references
            asked = native.record(plan.program, w, times, samples)
            out = out._replace(
                r_ref=asked.r_ref,
                p=asked.p,
                motion=asked.motion,
                rates=asked.rates,
                T_ref=asked.T_ref,
                wrench=asked.wrench,
            )
        frame = np.full((len(times), 4), np.nan)
        if plan.frame is not None:
            q = samples[:, 6 * n + m : 6 * n + m + 4]
            frame = q / np.linalg.norm(q, axis=1, keepdims=True)
        # A frame is attached from the first establishment on, or wherever something is tracked.
        attached = self.now.slots is not None or plan.program.control.kind != k.OPEN
        integral = samples[:, 6 * n : 6 * n + m]
        self.pieces.append(Piece(leg.index, times, out, integral, frame, plan.edges, attached))

    def result(self) -> Result:
        """The record of what has been flown."""
        wall = clock.perf_counter() - self.started
        self.extremes.flight(self.phases)
        evaluations, steps, rejected = (int(c) for c in self.count)
        statistics = {
            "evaluations": evaluations, "steps": steps, "rejected": rejected,
            "wall_s": wall, "simulated_s": self.now.t,
            "rtol": self.mission.integrator.rtol, "atol": self.mission.integrator.atol,
            "solvers": {method: vars(counts) for method, counts in self.solves.items()},
        }  # fmt: skip
        result = assemble(
            self.mission, self.phases, self.pieces, ending=self.ending, statistics=statistics,
        )  # fmt: skip
        result.mission = self.mission  # with what it has made already: slots assigned, edges
        return result


def _first_step(
    program: k.Program, work: k.Workspace, state: records.Integrator, scale: Array, longest: float
) -> float:
    """First step [s] to try in a large formation, from two evaluations; at most the ``longest``.

    Hairer, Nørsett and Wanner, Solving Ordinary Differential Equations I, section II.4; ``scale`` (n,) is the
    tolerance of each state. Steps that grow from a small one cost a large formation more.
    """

    def size(x: Array) -> float:
        return float(np.sqrt(np.mean((x / scale) ** 2)))

    t, y = float(state.clock[0]), state.y
    slope, later = np.empty_like(y), np.empty_like(y)
    native.closed_loop(t, y, slope, program, work)
    first = size(slope)
    h = min(0.01 * size(y) / max(first, 1e-300), longest)
    native.closed_loop(t + h, y + h * slope, later, program, work)
    steepest = max(first, size(later - slope) / h)
    if not 0.0 < steepest < math.inf:
        return float(state.clock[1])
    return min(100.0 * h, (0.01 / steepest) ** 0.2, longest)


def _check_size(mission: Mission, phase: Phase) -> None:
    """Stop before a flight that would take hours."""
    if not isinstance(phase, Establish | Reshape):
        return
    n, solver = mission.n_agents, mission.constraint.solver
    edges = mission.formation_edges(phase.formation)
    if solvers.choose(n, edges, solver) != "dense":
        return
    size = solvers.equations(n, len(edges), solver)
    if size > solvers.MOST_DENSE:
        raise StoppedError(
            f"phase '{phase.name}' takes '{phase.formation}', whose {len(edges):,} edges between"
            f' {n:,} agents make {size:,} equations for the constraint force, and solver "{solver}" needs'
            f" their eigenvalues; with more than {solvers.MOST_DENSE:,} a flight takes hours. Use solver ="
            ' "iterated" (or "exact"), give it fewer edges, or track slots with edges = []'
        )


def _times(times: ArrayLike, end: float) -> Array:
    """Times [s] to record, sorted; those that rounding has put behind the end are at the end."""
    t = np.unique(np.asarray(times, dtype=float))
    if not (len(t) and t[0] >= 0.0 and t[-1] <= end * (1.0 + 1e-12)):
        raise ValueError(f"times to record must lie between 0 and the mission's end, {end:g} s")
    return np.unique(np.minimum(t, end))


def _end(phase: Phase, start: float) -> float:
    """Time [s] at which a phase ends, at the latest."""
    if phase.until is not None:
        if phase.until <= start:
            raise StoppedError(
                f"phase '{phase.name}' is to end at {phase.until:g} s, but the phases before it took until"
                f" {start:.2f} s. Give it a duration in place of until"
            )
        return phase.until
    return start + (phase.duration or (phase.settle or Settle()).timeout)


def _target(mission: Mission, phase: Phase, plan: PhasePlan) -> dict[str, Any] | None:
    """What a fly or turn phase is to reach, or the attitude of a formation established, for the record."""
    lies = isinstance(phase, Establish) and not mission.free_attitude(phase)
    if not (isinstance(phase, Fly | Turn) or lies) or plan.goal is None:
        return None
    turns = lies or phase.attitude_deg is not None
    shaped = plan.program.reference.t0 + plan.program.reference.T_b
    return {
        "time": max(plan.arrival, shaped) if lies else plan.arrival,
        "position": plan.goal.r.tolist() if isinstance(phase, Fly) else None,
        "velocity": plan.goal.v.tolist() if isinstance(phase, Fly) else None,
        "attitude": att.quaternion_from_dcm(plan.goal.T).tolist() if turns else None,
        "rates": plan.goal.omega.tolist() if turns and not lies else None,
    }
