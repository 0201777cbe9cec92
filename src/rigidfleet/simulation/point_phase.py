"""A phase of points, flown by an integrator with steps of variable length."""

from __future__ import annotations

import math
import time as clock
from typing import NamedTuple

import numpy as np

from rigidfleet.errors import FlightError, StoppedError
from rigidfleet.kernel import records
from rigidfleet.kernel.engine import native, packing
from rigidfleet.kernel.problem import Problem
from rigidfleet.planning.tolerances import step_limit
from rigidfleet.simulation.active_phase import ActivePhase
from rigidfleet.simulation.callbacks import Command, article_and_kind
from rigidfleet.simulation.diagnosis import diagnose
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
    first: float  # the first time after the start [s]


class PointPhase(ActivePhase):
    """A phase under way that points fly."""

    #: Whether another thread searches the steps for extremes. It must not ask the user's force.
    aside = False
    #: Steps per call of the integrator; more once their duration is known.
    steps = 0

    def begin(self, y: Floats, t: float) -> None:
        """Begin to integrate at a state (n,) and time [s]."""
        super().begin(y, t)
        plan = self.plan
        self.aside = plan.is_large and self.external is None
        self.state = self.extremes.begin_monitoring(
            y, t, len(plan.edges), rtol=plan.integrator.rtol, atol=plan.tolerances
        )
        if self.steps:  # after a loss
            return
        self.steps = _FIRST_STEPS
        if self.external is None:
            self.steps = max(_FIRST_STEPS, _FIRST_NUMBERS // len(y))
        if self.solver is not None:
            self.state.clock[records.NEXT_STEP] = first_step(plan, self.workspace, self.state)

    def fly(self, problem: Problem, t_end: float) -> None:
        """Integrate to ``t_end`` [s] and record the samples on the way."""
        stretch = self.prepare_stretch(problem, self.sample_times(t_end))
        state, fresh = self.state, stretch.fresh
        status = records.PAUSED
        go_on = native.Integration(
            problem, self.workspace, state, t_end, stretch.times, stretch.samples
        )
        try:
            while status == records.PAUSED:
                begun = clock.perf_counter()
                most = self.extremes.steps_until_trail_full(state) if self.aside else self.steps
                status = go_on(fresh, min(self.steps, most))
                took = max(clock.perf_counter() - begun, 1e-6)
                if status == records.PAUSED:
                    self.steps = min(_STEPS, max(1, int(self.steps * min(_PAUSE / took, 10.0))))
                fresh = False
                if self.external is not None:
                    self.external.raise_user_error()
                self.raise_errors()
                full = state.count[records.TRAILED] == len(state.trail.clock)
                if self.aside:
                    full = self.extremes.steps_until_trail_full(state) < 1
                if status == records.PAUSED or full:
                    self.search_extremes(last=False)
                self.pause(self.t)
                if status == records.PAUSED and self.has_stalled():
                    break
        finally:
            self.record_samples(stretch)
        if status != records.FINISHED:
            collapsed = status == records.COLLAPSED
            own_force = self.external is not None
            raise StoppedError(diagnose(self, own_force=own_force, collapsed=collapsed))

    def search_extremes(self, *, last: bool) -> None:
        """Search the steps flown for extremes.

        In a large formation, the search takes as long as the flight: another thread does it meanwhile. The user's
        force, which may not be ready for two threads, is asked by one.
        """
        self.extremes.wait_for_steps()
        if not self.state.count[records.TRAILED] or self.flown is None:
            return
        work = self.workspace if self.solver is None else self.solver.thread_solver.workspace
        if last or not self.aside:
            self.extremes.monitor_steps(self.flown, work, self.state, last=last)
        else:
            self.extremes.send_steps(self.flown, work, self.state)

    def prepare_stretch(self, problem: Problem, times: Floats) -> Stretch:
        """Prepare to integrate a problem from now on, and to record the states at some times (K,) [s]."""
        evaluations = self.state.count[records.EVALUATIONS]
        fresh = evaluations == 0 or problem is not self.plan.problem
        if fresh:
            self.search_extremes(last=True)
            self.flown = problem
            if self.solver is not None:  # a solver keeps state: the monitor has its own
                self.flown = problem_with_solver(self.solver.thread_solver, problem)
        self.begun = True
        samples = np.empty((len(times), len(self.state.y)))
        self.state.count[records.SAMPLES] = 0
        return Stretch(problem, times, samples, fresh, math.nextafter(self.t, math.inf))

    def record_samples(self, stretch: Stretch) -> None:
        """Store the samples of what was integrated since `prepare_stretch`."""
        state, (problem, times, samples, _, first) = self.state, stretch
        done = int(state.count[records.SAMPLES])
        tried = state.count[records.EVALUATIONS] > 0 and state.count[records.ACCEPTED] == 0
        if tried and len(times) and times[0] <= first:
            samples[0], done = state.y, 1  # no step was possible: record the start alone
        if done:
            self._store_samples(problem, times[:done], samples[:done])

    def has_stalled(self) -> bool:
        """Whether the phase takes far more steps than its duration explains."""
        state, since = self.state, self.t - self.plan.start
        steps = int(state.count[records.ACCEPTED] + state.count[records.REJECTED])
        return steps > step_limit(since)

    def problem_under(self, command: Command) -> Problem:
        """Point masses take no command of vehicles."""
        raise FlightError(
            f"the controller returned {article_and_kind(command)} at t = {self.t:.3f} s, which point masses do"
            " not take; return forces [N], or give the agents a vehicle"
        )

    def free_memory(self) -> None:
        """Let go of what a large formation has packed."""
        if self.solver is not None:
            packing.forget_last_packed()

    def _store_samples(self, problem: Problem, times: Floats, samples: Floats) -> None:
        """Store the samples; forces and references at them are evaluated when they are asked for."""
        plan = self.plan
        n, m = len(plan.masses), len(plan.edges)
        setup = None if self.solver is None else self.solver.setup
        source = Unevaluated(native.pack(problem), plan.problem, samples, setup)
        if self.external is not None:  # a user's function is asked while it is at hand
            source = source.evaluate(times, self.workspace)
        frame = np.broadcast_to(np.nan, (len(times), 4))
        if plan.frame is not None:
            q = samples[:, 6 * n + m : 6 * n + m + 4]
            frame = q / np.linalg.norm(q, axis=1, keepdims=True)
        self.store_piece(times, source, samples[:, 6 * n : 6 * n + m], frame)
