"""A phase under way: integrates its plan, monitors and records it. It knows nothing of the mission."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rigidfleet.errors import FlightError, StoppedError
from rigidfleet.kernel import records
from rigidfleet.kernel.engine import native, packing
from rigidfleet.kernel.problem import OPEN, TRACKING, Problem
from rigidfleet.kernel.records import Record
from rigidfleet.math import attitude as att
from rigidfleet.mission import Settle
from rigidfleet.planning.disturbances import without
from rigidfleet.planning.plan import PhasePlan
from rigidfleet.planning.reference import PhaseState
from rigidfleet.planning.tolerances import most_steps
from rigidfleet.simulation.callbacks import (
    Command,
    Controller,
    ExternalForce,
    Observation,
    called,
    checked_force,
    named,
)
from rigidfleet.simulation.diagnosis import Place, diagnose
from rigidfleet.simulation.extremes import Extremes
from rigidfleet.simulation.recording import LayerSamples, Led, Piece, Unevaluated, VehicleSamples
from rigidfleet.simulation.solver_setup import (
    equip,
    first_step,
    give_back,
    solved_by,
)
from rigidfleet.typing import Bools, Floats

if TYPE_CHECKING:
    from rigidfleet.kernel.large.solver import Counts  # imports the compiler

#: Greatest number of steps, and greatest wall time [s], after which the integrator returns to Python. For any
#: size of formation, this is often enough for Ctrl-C and progress.
_STEPS, _PAUSE = 2000, 0.05
#: Least number of steps at the start of a phase: they may take a thousand times as long as those of the phase before.
#: Without a user's force, steps of this many numbers in all take less than a tenth of `_PAUSE`.
_FIRST_STEPS, _FIRST_NUMBERS = 10, 3000
#: Interval between checks whether a phase has settled, if it ends by settling [s].
_CHECK = 0.1


class Stretch(NamedTuple):
    """What is integrated at a time: a problem, the times (K,) [s] to record, and the states (K, n) there."""

    problem: Problem
    times: Floats
    samples: Floats
    fresh: bool  # whether the derivative at the start is not known
    first: float  # the first time after the start [s]


#: Function that gives the times in (t, t_end] to record: sampling(plan, t, t_end, first=..., stop=...).
Sampler = Callable[..., Floats]


class ActivePhase:
    """A phase under way.

    Attributes
    ----------
    plan : the plan that is flown
    pieces : samples recorded so far
    """

    def __init__(
        self,
        index: int,
        plan: PhasePlan,
        *,
        extremes: Extremes,
        external: ExternalForce | None,
        sampler: Sampler,
        pieces: list[Piece],
        pause: Callable[[float], None],
    ) -> None:
        self.index, self.plan = index, plan
        self.extremes, self.external, self.sampler = extremes, external, sampler
        self.pieces, self.pause = pieces, pause
        self.lost = np.zeros(len(plan.masses), dtype=np.bool_)
        if plan.before.lost is not None:
            self.lost = plan.before.lost
        self.parted = plan.links_lost[1] <= plan.start  # (L,) links that are lost
        self.next_loss = self._loss_ahead()  # of a vehicle or a link [s]
        self.asked = 0  # number of calls of the user's controller
        self.held: Problem | None = None  # with the controller's force
        self.flown: Problem | None = None  # the problem of the steps in the trail
        self.counted = np.zeros(
            3, dtype=np.int64
        )  # evaluations, steps and rejections before a loss
        self.solves: list[tuple[str, Counts]] = []  # by method, before a loss
        self.quiet_since = math.inf  # since when the phase has been settled [s]
        self.stop = math.inf  # time at which the caller wants a sample [s]
        self.begun = False  # whether samples exist since the start or the last loss
        self._start(plan.state(), plan.start)
        #: Steps per call of the integrator; more once their duration is known.
        self.steps = _FIRST_STEPS
        if external is None:
            self.steps = max(_FIRST_STEPS, _FIRST_NUMBERS // len(self.state.y))
        if self.solver is not None:
            self.state.clock[records.NEXT_STEP] = first_step(plan, self.workspace, self.state)

    def _start(self, y: Floats, t: float) -> None:
        """Start to integrate the plan at a state (n,) and time [s]."""
        plan = self.plan
        #: Whether another thread searches the steps for extremes. It must not ask the user's force.
        self.aside = plan.large and self.external is None
        self.state = self.extremes.begin(
            y, t, len(plan.edges), rtol=plan.integrator.rtol, atol=plan.tolerances, aside=self.aside
        )
        self.workspace, self.solver = equip(plan)

    @property
    def t(self) -> float:
        """Mission time reached [s]."""
        return float(self.state.clock[records.TIME])

    @property
    def over(self) -> bool:
        """Whether the phase has reached its latest end."""
        return self.t >= self.plan.t_end

    @property
    def flew(self) -> bool:
        """Whether anything of the phase was flown, or was to be when the flight stopped."""
        return self.begun or self.t > self.plan.start

    @property
    def place(self) -> Place:
        """The current state of the phase, for a diagnosis."""
        return Place(self.plan, self.t, self.state, self.workspace, self.solver)

    @property
    def settled(self) -> bool | None:
        """Whether the phase has settled; None if it does not end by settling."""
        settle = self.plan.phase.settle
        return None if settle is None else self.t - self.quiet_since >= settle.dwell - 1e-9

    #: Time by which the events of the phase come later than planned [s].
    delay = 0.0
    #: Whether a controller's calls are counted from the start of the flight, as ticks are, and not of the phase.
    by_ticks = False

    # -- flying -----------------------------------------------------------------------------------

    def fly_to(self, t_end: float, controller: Controller | None, rate: float) -> None:
        """Integrate to ``t_end`` [s] under the phase's input law, or the user's controller, called at ``rate`` [Hz].

        Raises
        ------
        StoppedError
            The flight cannot go on.
        """
        if controller is None or self.plan.phase.control != "tracking":
            self._integrate(self.plan.problem, t_end)
            return
        start = 0.0 if self.by_ticks else self.plan.start
        while self.t < t_end:
            # Control instants are the start of the phase and multiples since, not the ends of its segments.
            if self.held is None or self.t >= start + self.asked / rate:
                self.held = self._under(controller)
                # Instants that differ by a rounding error, far less than a millionth of a period, are one.
                self.asked = max(self.asked, math.floor((self.t - start) * rate + 1e-6)) + 1
            self._integrate(self.held, min(start + self.asked / rate, t_end))

    def _under(self, controller: Controller) -> Problem:
        """The problem with the force that a user's controller asks for now."""
        given = called("the controller", self.t, controller, self.observe())
        if isinstance(given, Command):
            return self._commanded(given)
        force = checked_force(given, len(self.lost), "the controller", self.t)
        control = self.plan.problem.control._replace(kind=OPEN, force=force)
        return self.plan.problem._replace(control=control)

    def _commanded(self, given: Command) -> Problem:
        """The problem under a command of vehicles, which point masses do not take."""
        raise FlightError(
            f"the controller returned {named(given)} at t = {self.t:.3f} s, which point masses do not"
            " take; return forces [N], or give the agents a vehicle"
        )

    def settle_by(
        self, t_end: float, settle: Settle, controller: Controller | None, rate: float, step: float
    ) -> None:
        """Integrate until the phase has settled, or to ``t_end`` [s]; check at multiples of ``step`` [s]."""
        step *= max(1.0, round(_CHECK / step))  # segments end at samples
        least = self.plan.start + self.plan.problem.reference.T_b
        while self.t < t_end and not self.settled:
            t = (math.floor(self.t / step + 1e-9) + 1) * step
            self.fly_to(min(t, t_end), controller, rate)
            if self.t < min(t, self.plan.t_end):
                return  # between two checks
            quiet = self.t >= least and self._error() <= settle.tolerance
            self.quiet_since = min(self.quiet_since, self.t) if quiet else math.inf

    def lead(self, problem: Problem) -> None:
        """Continue with another problem of the same size, such as one with a different reference."""
        self.plan.problem = problem
        self.counted[records.EVALUATIONS] += self.state.count[records.EVALUATIONS]
        # A different law: its derivative is not known yet.
        self.state.count[records.EVALUATIONS] = 0

    def evaluate(self) -> None:
        """Evaluate the law at the current state; forces and references are then in the workspace."""
        y = self.state.y
        native.closed_loop(self.t, y, np.empty_like(y), self.plan.problem, self.workspace)

    def observe(self) -> Observation:
        """What a controller sees at the current state."""
        self.evaluate()
        w, vehicles = self.workspace, self.plan.problem.vehicles
        noisy = len(self.plan.problem.disturbance.noise_r) > 0
        r, v = (w.r_seen, w.v_seen) if noisy else (w.r, w.v)
        tracked = self.plan.problem.control.kind == TRACKING  # elsewhere, there are no slots
        r_ref, v_ref, a_ref = (np.where(tracked, x, np.nan) for x in (w.r_ref, w.v_ref, w.a_ref))
        return Observation(
            self.t, self.plan.phase.name, r.copy(), v.copy(), r_ref, v_ref, a_ref, self.plan.masses.copy(), vehicles.g
        )  # fmt: skip

    def watch(self, *, last: bool) -> None:
        """Search the steps flown for extremes; ``last``: no further steps of this problem follow.

        In a large formation, the search takes as long as the flight: another thread does it meanwhile. The user's
        force, which may not be ready for two threads, is asked by one.
        """
        self.extremes.wait()
        if not self.state.count[records.TRAILED] or self.flown is None:
            return
        work = self.workspace if self.solver is None else self.solver.aside.workspace
        if last or not self.aside:
            self.extremes.take(self.flown, work, self.state, last=last)
        else:
            self.extremes.hand_over(self.flown, work, self.state)

    def end(self) -> PhaseState:
        """End the phase at its current state; return the state that the next phase starts from."""
        self.check()
        if not (self.state.count[records.EVALUATIONS] or self.t > self.plan.start):
            return self.plan.before
        self.evaluate()
        return self.plan.reached(self.t, self.state.y, self.workspace)

    def check(self) -> None:
        """Raise errors of the multipliers' solver, or of the monitor's solver."""
        if self.solver is not None:
            self.solver.check()
            self.solver.aside.check()

    def release(self) -> None:
        """Give the workspace back, after the end: nothing more is asked of this phase."""
        give_back(self.plan.problem, self.workspace)
        if self.solver is not None:
            packing.forget()

    # -- inside -----------------------------------------------------------------------------------

    def _integrate(self, problem: Problem, t_end: float) -> None:
        """Integrate to ``t_end`` [s], and remove vehicles and links at the times at which they are lost.

        ``problem`` may hold a user's force instead of the phase's own input law.
        """
        while self.t < t_end:
            if self.next_loss <= self.t:
                problem = self._lose(problem, ~self.lost & (self.plan.lost_at <= self.t))
            else:
                self._segment(problem, min(t_end, self.next_loss))

    def _lose(self, problem: Problem, now: Bools) -> Problem:
        """Continue without the vehicles that are lost ``now`` (N,) and without the links lost by now.

        Returns the remaining problem.
        """
        self.watch(last=True)
        self.check()
        plan, y, own = self.plan, self.state.y, problem is self.plan.problem
        self.parted = plan.links_lost[1] <= self.t
        if now.any():
            self.lost = self.lost | now
            plan.before.lost = self.lost
            self.extremes.lose(self.lost)
        self.next_loss = self._loss_ahead()
        n = len(self.lost)
        self.count()
        kept = plan.release(self.lost, self.parted)
        integral = y[6 * n : 6 * n + len(kept)][kept]
        rest = y[6 * n + len(kept) :]
        y = np.concatenate([y[: 6 * n], integral, rest])
        self.begun = False
        self._start(y, self.t)
        if own:
            return plan.problem
        mu = plan.problem.law.mu
        held = without(problem, kept, self.lost, mu, large=plan.large)
        self.held = held._replace(graph=plan.problem.graph)
        return self.held

    def _loss_ahead(self) -> float:
        """Time [s] at which the next vehicle or link is lost; infinity if none is."""
        if not self.plan.loses:
            return math.inf
        agents, links = self.plan.lost_at[~self.lost], self.plan.links_lost[1][~self.parted]
        return min([*agents.tolist(), *links.tolist()], default=math.inf)

    def count(self) -> None:
        """Add up the evaluations, steps and solves of the phase, or of its part up to a loss."""
        self.counted += self.state.count[: records.REJECTED + 1]
        if self.solver is not None:
            self.solves.append((self.plan.method, self.solver.counts))

    def _segment(self, problem: Problem, t_end: float) -> None:
        """Integrate to ``t_end`` [s] and record the samples on the way."""
        stretch = self.prepare(problem, self.times(t_end))
        state, fresh = self.state, stretch.fresh
        status = records.PAUSED
        go_on = native.Integration(
            problem, self.workspace, state, t_end, stretch.times, stretch.samples
        )
        try:
            while status == records.PAUSED:
                begun = clock.perf_counter()
                most = self.extremes.room(state) if self.aside else self.steps
                status = go_on(fresh, min(self.steps, most))
                took = max(clock.perf_counter() - begun, 1e-6)
                if status == records.PAUSED:
                    self.steps = min(_STEPS, max(1, int(self.steps * min(_PAUSE / took, 10.0))))
                fresh = False
                if self.external is not None:
                    self.external.check()
                self.check()
                full = state.count[records.TRAILED] == len(state.trail.clock)
                if self.aside:
                    full = self.extremes.room(state) < 1
                if status == records.PAUSED or full:
                    self.watch(last=False)
                self.pause(self.t)
                if status == records.PAUSED and self.stalled():
                    break
        finally:
            self.record(stretch)
        if status != records.FINISHED:
            collapsed = status == records.COLLAPSED
            own_force = self.external is not None
            raise StoppedError(diagnose(self.place, own_force=own_force, collapsed=collapsed))

    def times(self, t_end: float) -> Floats:
        """Times (K,) [s] to record from now to ``t_end`` [s]."""
        return self.sampler(self.plan, self.t, t_end, first=not self.begun, stop=self.stop)

    def prepare(self, problem: Problem, times: Floats) -> Stretch:
        """Prepare to integrate a problem from now on, and to record the states at some times (K,) [s]."""
        evaluations = self.state.count[records.EVALUATIONS]
        fresh = evaluations == 0 or problem is not self.plan.problem
        if fresh:
            self.watch(last=True)
            self.flown = problem
            if self.solver is not None:  # a solver keeps state: the monitor has its own
                self.flown = solved_by(self.solver.aside, problem)
        self.begun = True
        samples = np.empty((len(times), len(self.state.y)))
        self.state.count[records.SAMPLES] = 0
        return Stretch(problem, times, samples, fresh, math.nextafter(self.t, math.inf))

    def record(self, stretch: Stretch) -> None:
        """Store the samples of what was integrated since `prepare`."""
        state, (problem, times, samples, _, first) = self.state, stretch
        done = int(state.count[records.SAMPLES])
        tried = state.count[records.EVALUATIONS] > 0 and state.count[records.ACCEPTED] == 0
        if tried and len(times) and times[0] <= first:
            samples[0], done = state.y, 1  # no step was possible: record the start alone
        if done:
            self._record(problem, times[:done], samples[:done])

    def stalled(self) -> bool:
        """Whether the phase takes far more steps than its duration explains."""
        steps = int(self.state.count[records.ACCEPTED] + self.state.count[records.REJECTED])
        return steps > most_steps(self.t - self.plan.start)

    def _error(self) -> float:
        """Largest error [m] of a constraint, a slot or the goal at the integrator's state.

        An attitude error counts as the distance by which it moves a slot.
        """
        plan, w = self.plan, self.workspace
        self.evaluate()
        errors = [np.abs(w.c).max(initial=0.0)]
        local = plan.problem.control.kind == TRACKING
        if local:
            errors.append(np.linalg.norm(w.r - w.r_ref, axis=1)[~self.lost].max())
        tracks = plan.problem.control.kind != OPEN
        if tracks and plan.goal is not None and plan.slots is not None:
            goal, since = plan.goal, self.t - plan.arrival  # the goal moves on after arrival
            left = np.where(self.lost, 0.0, plan.masses)
            cm = left @ w.r / left.sum()
            if self.lost.any():  # of the virtual body, from the agents still flying
                cm += w.body[0] - left @ w.r_ref / left.sum()
            errors.append(np.linalg.norm(cm - goal.r - goal.v * since))
            turned = (w.T_ref if local else w.T) - (
                att.dcm_from_rotation_vector(goal.omega * since) @ goal.T
            )
            errors.append(np.linalg.norm(plan.slots @ turned, axis=1).max())
        return float(max(errors))

    def _record(self, problem: Problem, times: Floats, samples: Floats) -> None:
        """Store the samples; forces and references at them are evaluated when they are asked for."""
        plan = self.plan
        n, m = len(plan.masses), len(plan.edges)
        setup = None if self.solver is None else self.solver.setup
        given = Unevaluated(problem, plan.problem, samples, setup)
        if self.external is not None:  # a user's function is asked while it is at hand
            given = given.evaluated(times, self.workspace)
        frame = np.full((len(times), 4), np.nan)
        if plan.frame is not None:
            q = samples[:, 6 * n + m : 6 * n + m + 4]
            frame = q / np.linalg.norm(q, axis=1, keepdims=True)
        self.keep(times, given, samples[:, 6 * n : 6 * n + m], frame)

    def keep(
        self,
        times: Floats,
        given: Record | Unevaluated,
        integral: Floats,
        frame: Floats,
        vehicles: VehicleSamples | None = None,
        layers: LayerSamples | None = None,
    ) -> None:
        """Store a piece of the phase."""
        edges, attached = self.plan.edges, self.plan.attached
        led = self._led(times)
        self.pieces.append(
            Piece(self.index, times, given, integral, frame, edges, attached, led, vehicles, layers)
        )

    def _led(self, times: Floats) -> Led:
        """What the slots follow at the samples, if they are tracked."""
        plan = self.plan
        if plan.problem.control.kind != TRACKING or not len(times):
            return ()
        return ((times[0], plan.problem.reference, plan.problem.motion, None),)
