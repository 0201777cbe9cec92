"""Points: their motion is integrated with steps of variable length."""

from __future__ import annotations

import math
import time as clock
from typing import NamedTuple

import numpy as np

from rigidfleet.errors import FlightError, StoppedError
from rigidfleet.kernel import records
from rigidfleet.kernel.engine import native
from rigidfleet.kernel.problem import Problem
from rigidfleet.planning.tolerances import step_limit
from rigidfleet.simulation.callbacks import Command, article_and_kind
from rigidfleet.simulation.diagnosis import diagnose
from rigidfleet.simulation.plan_integration import PlanIntegration
from rigidfleet.simulation.recording import Unevaluated
from rigidfleet.simulation.solver_setup import first_step, problem_with_solver
from rigidfleet.typing import Floats

#: Greatest number of steps, and greatest wall time [s], after which the integrator returns to Python. For any
#: size of formation, this is often enough for Ctrl-C and progress.
_STEPS, _PAUSE = 2000, 0.05
#: Least number of steps at the start of a phase: they may take a thousand times as long as those of the phase before.
#: Without a user's force, steps of this many numbers in all take less than a tenth of `_PAUSE`.
_FIRST_STEPS, _FIRST_NUMBERS = 10, 3000


class Stretch(NamedTuple):
    """What is integrated at a time: a problem, the times (K,) [s] to record, and the states (K, n) there."""

    problem: Problem
    times: Floats
    samples: Floats
    fresh: bool  # whether the derivative at the start is not known


class PointPropagator:
    """Points in flight: a `Propagator` by the integrator of the kernel, which chooses its steps."""

    lateness = 0.0

    def __init__(self, integration: PlanIntegration) -> None:
        self.integration = integration
        self.control_start = integration.plan.start
        self.flown: Problem | None = None  # the problem of the steps in the trail
        #: The plan's problem, if it is the one flown last: its derivative at the state is known.
        self.known: Problem | None = None
        #: Whether another thread searches the steps for extremes. It must not ask the user's force.
        self.aside = False
        #: Steps per call of the integrator; more once their duration is known.
        self.steps = 0

    def begin(self, y: Floats, t: float) -> None:
        """Begin to integrate at a state (n,) and time [s]."""
        at = self.integration
        at.begin(y, t, len(y), records.POINTS_TRAIL)
        self.known = None
        self.aside = at.plan.is_large and at.external is None
        if self.steps:  # after a loss
            return
        numbers = _FIRST_NUMBERS if at.external is None else 0
        self.steps = max(_FIRST_STEPS, numbers // len(y))
        if at.solver is not None:
            at.state.clock[records.NEXT_STEP] = first_step(at.plan, at.workspace, at.state)

    def fly(self, problem: Problem, t_end: float) -> None:
        """Integrate to ``t_end`` [s] or the end of the plan, and record the samples on the way."""
        at, t_end = self.integration, min(t_end, self.integration.plan.t_end)
        stretch = self.prepare_stretch(problem, at.sample_times(t_end))
        state, fresh = at.state, stretch.fresh
        status = records.PAUSED
        go_on = native.Integration(
            problem, at.workspace, state, t_end, stretch.times, stretch.samples
        )
        try:
            while status == records.PAUSED:
                begun = clock.perf_counter()
                most = at.extremes.steps_until_trail_full(state) if self.aside else self.steps
                status = go_on(fresh, min(self.steps, most))
                took = max(clock.perf_counter() - begun, 1e-6)
                if status == records.PAUSED:
                    self.steps = min(_STEPS, max(1, int(self.steps * min(_PAUSE / took, 10.0))))
                fresh = False
                if at.external is not None:
                    at.external.raise_user_error()
                at.raise_errors()
                full = state.count[records.TRAILED] == len(state.trail.clock)
                if self.aside:
                    full = at.extremes.steps_until_trail_full(state) < 1
                if status == records.PAUSED or full:
                    self.search_extremes(last=False)
                at.pause()
                if status == records.PAUSED and self.has_stalled():
                    break
        finally:
            self.record_samples(stretch)
        if status != records.FINISHED:
            raise StoppedError(diagnose(at, collapsed=status == records.COLLAPSED))

    def search_extremes(self, *, last: bool) -> None:
        """Search the steps flown for extremes.

        In a large formation, the search takes as long as the flight: another thread does it meanwhile. The user's
        force, which may not be ready for two threads, is asked by one.
        """
        at = self.integration
        at.extremes.wait_for_steps()
        if not at.state.count[records.TRAILED] or self.flown is None:
            return
        work = at.workspace if at.solver is None else at.solver.thread_solver.workspace
        if last or not self.aside:
            at.extremes.search_trail_for_extremes(self.flown, work, at.state, last=last)
        else:
            at.extremes.send_steps(self.flown, work, at.state)

    def prepare_stretch(self, problem: Problem, times: Floats) -> Stretch:
        """Prepare to integrate a problem from now on, and to record the states at some times (K,) [s]."""
        at, fresh = self.integration, problem is not self.known
        if fresh:
            self.search_extremes(last=True)
            self.flown = problem
            if at.solver is not None:  # a solver keeps state: the monitor has its own
                self.flown = problem_with_solver(at.solver.thread_solver, problem)
        self.known = problem if problem is at.plan.problem else None
        at.begun = True
        samples = np.empty((len(times), len(at.state.y)))
        at.state.count[records.SAMPLES] = 0
        return Stretch(problem, times, samples, fresh)

    def record_samples(self, stretch: Stretch) -> None:
        """Store the samples of what was integrated since `prepare_stretch`."""
        at, plan, state = self.integration, self.integration.plan, self.integration.state
        problem, times, samples, _ = stretch
        done = int(state.count[records.SAMPLES])
        tried = state.count[records.EVALUATIONS] > 0 and state.count[records.ACCEPTED] == 0
        if tried and len(times) and times[0] <= math.nextafter(at.t, math.inf):
            samples[0], done = state.y, 1  # no step was possible: record the start alone
        if not done:
            return
        times, samples = times[:done], samples[:done]
        n, m = len(plan.masses), len(plan.edges)
        setup = None if at.solver is None else at.solver.setup
        # Forces and references at the samples are evaluated when they are asked for.
        source = Unevaluated(native.pack(problem), plan.problem, samples, setup)
        if at.external is not None:  # a user's function is asked while it is at hand
            source = source.evaluate(times, at.workspace)
        frame = np.broadcast_to(np.nan, (len(times), 4))
        if plan.frame is not None:
            q = samples[:, 6 * n + m : 6 * n + m + 4]
            frame = q / np.linalg.norm(q, axis=1, keepdims=True)
        at.store_piece(times, source, samples[:, 6 * n : 6 * n + m], frame)

    def has_stalled(self) -> bool:
        """Whether the phase takes far more steps than its duration explains."""
        at, count = self.integration, self.integration.state.count
        steps = int(count[records.ACCEPTED] + count[records.REJECTED])
        return steps > step_limit(at.t - at.plan.start)

    def take_up(self, problem: Problem) -> None:
        """Make another problem of the same size the plan's."""
        self.integration.plan.problem = problem

    def hold_command(self, command: Command | None) -> None:
        """Refuse a command of vehicles: point masses take none."""
        if command is not None:
            raise FlightError(
                f"the controller returned {article_and_kind(command)} at t = {self.integration.t:.3f} s, which point"
                " masses do not take; return forces [N], or give the agents a vehicle"
            )

    def states_seen(self) -> dict[str, Floats]:
        """Positions and velocities (N, 3) as measured, after an evaluation of the law [m, m/s]."""
        w, noise = self.integration.workspace, self.integration.plan.problem.disturbance.noise_r
        r, v = (w.r_seen, w.v_seen) if len(noise) else (w.r, w.v)
        return {"position": r.copy(), "velocity": v.copy()}

    def hand_over(self) -> None:
        """Leave nothing: all of points is in the state."""
