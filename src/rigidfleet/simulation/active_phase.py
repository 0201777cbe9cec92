"""A phase under way: integrates its plan, monitors and records it. It knows nothing of the mission."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.kernel import records
from rigidfleet.kernel.engine import native
from rigidfleet.kernel.problem import OPEN, Problem, Workspace
from rigidfleet.kernel.records import IntegratorState, Record
from rigidfleet.math import attitude as att
from rigidfleet.mission import Settle
from rigidfleet.planning.disturbances import without_lost
from rigidfleet.planning.plan import PhasePlan
from rigidfleet.planning.reference import PhaseState, copy_with
from rigidfleet.simulation.callbacks import (
    Command,
    Controller,
    ExternalForce,
    Observation,
    call_user_code,
    check_force,
)
from rigidfleet.simulation.extremes import Extremes
from rigidfleet.simulation.recording import (
    LayerSamples,
    Piece,
    Unevaluated,
    VehicleSamples,
)
from rigidfleet.simulation.solver_setup import workspace_and_solver
from rigidfleet.typing import Bools, Floats

if TYPE_CHECKING:
    from rigidfleet.kernel.large.solver import Counts

#: Interval between checks whether a phase has settled, if it ends by settling [s].
_CHECK = 0.1
#: Function that gives the times in (t, t_end] to record: sampling(plan, t, t_end, first=..., stop=...).
Sampler = Callable[..., Floats]


class ActivePhase:
    """A phase under way; `PointPhase` and `SampledPhase` say how points, and vehicles with sampled control, fly it.

    Attributes
    ----------
    plan : the plan that is flown
    pieces : samples recorded so far
    """

    #: Whether a controller's calls are counted from the start of the flight, as ticks are, and not of the phase.
    by_ticks = False
    #: Time by which the events of the phase come later than planned [s].
    event_delay = 0.0
    #: Time by which the plan's references are behind now, in the mean of the vehicles' own clocks [s].
    lateness = 0.0
    #: How vehicles turn about the vertical, a `YawTurn`; None of points.
    turn: Any = None

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
        workspaces: Callable[..., Workspace],
    ) -> None:
        self.index, self.plan = index, plan
        self.extremes, self.external, self.sampler = extremes, external, sampler
        self.pieces, self.pause, self.workspaces = pieces, pause, workspaces
        self.lost = plan.before.lost
        self.parted = plan.links_lost[1] <= plan.start  # (L,) links that are lost
        self.next_loss = self._loss_time()  # of a vehicle or a link [s]
        self.control_calls = 0  # number of calls of the user's controller
        self.held: Problem | None = None  # with the controller's force
        # Evaluations, steps and rejections before a loss.
        self.counted = np.zeros(3, dtype=np.int64)
        self.solves: list[tuple[str, Counts]] = []  # by method, before a loss
        self.quiet_since = math.inf  # since when the phase has been settled [s]
        self.stop = math.inf  # time at which the caller wants a sample [s]
        self.begun = False  # whether samples exist since the start or the last loss
        self.flown: Problem | None = None  # the problem of the steps in the trail
        self.state: IntegratorState
        self.begin(plan.initial_state(), plan.start)

    # -- what differs between points and vehicles ---------------------------------------------------

    def begin(self, y: Floats, t: float) -> None:
        """Begin the ``state`` of the integration at a state (n,) and time [s]: at the start, and after a loss."""
        self.workspace, self.solver = workspace_and_solver(self.plan, self.workspaces)

    def fly(self, problem: Problem, t_end: float) -> None:
        """Fly to ``t_end`` [s] and record the samples on the way."""
        raise NotImplementedError

    def search_extremes(self, *, last: bool) -> None:
        """Search the steps flown for extremes; ``last``: no further steps of this problem follow."""
        raise NotImplementedError

    def problem_under(self, command: Command) -> Problem:
        """The problem under a command of vehicles.

        Raises
        ------
        FlightError
            They do not take it.
        """
        raise NotImplementedError

    def lead_reference(self, *, by_law: bool) -> float:
        """Decide how to fly on, ``by_law`` or under a controller; returns until when that holds [s]."""
        return math.inf

    def drop_command(self) -> None:
        """Drop the last command of vehicles."""

    def free_memory(self) -> None:
        """Give back what the phase holds, after the end: nothing more is asked of it."""

    # -- where it is ----------------------------------------------------------------------------------

    @property
    def t(self) -> float:
        """Mission time reached [s]."""
        return float(self.state.clock[records.TIME])

    @property
    def is_over(self) -> bool:
        """Whether the phase has reached its latest end."""
        return self.t >= self.plan.t_end

    @property
    def has_flown(self) -> bool:
        """Whether anything of the phase was flown, or was to be when the flight stopped."""
        return self.begun or self.t > self.plan.start

    @property
    def has_settled(self) -> bool | None:
        """Whether the phase has settled; None if it does not end by settling."""
        settle = self.plan.phase.settle
        return None if settle is None else self.t - self.quiet_since >= settle.dwell - 1e-9

    # -- flying -----------------------------------------------------------------------------------

    def fly_to(self, t_end: float, controller: Controller | None, rate: float) -> None:
        """Fly to ``t_end`` [s], or to the end of the phase, which comes later if the formation waits.

        It flies under the phase's input law, or the user's controller, called at ``rate`` [Hz].

        Raises
        ------
        StoppedError
            The flight cannot go on.
        """
        whole = t_end >= self.plan.t_end
        while self.t < (self.plan.t_end if whole else t_end):
            decided = self.lead_reference(by_law=controller is None)
            end = min(decided, self.plan.t_end if whole else t_end)
            if controller is None or not self.plan.phase.tracks_slots:
                self._integrate(self.plan.problem, end)
            else:
                self._fly_under(controller, rate, end)

    def _fly_under(self, controller: Controller, rate: float, t_end: float) -> None:
        """Fly to ``t_end`` [s] under the user's controller."""
        start = 0.0 if self.by_ticks else self.plan.start
        while self.t < t_end:
            # Control instants are the start of the phase and multiples since, not the ends of its segments.
            if self.held is None or self.t >= start + self.control_calls / rate:
                self.held = self._call_controller(controller)
                # Instants that differ by a rounding error, far less than a millionth of a period, are one.
                self.control_calls = (
                    max(self.control_calls, math.floor((self.t - start) * rate + 1e-6)) + 1
                )
            self._integrate(self.held, min(start + self.control_calls / rate, t_end))

    def _call_controller(self, controller: Controller) -> Problem:
        """The problem with what a user's controller asks for now: forces, or a command of vehicles."""
        self.drop_command()
        when = f"at t = {self.t:.3f} s"
        answer = call_user_code("the controller", when, controller, self.observe())
        if isinstance(answer, Command):
            return self.problem_under(answer)
        force = check_force(answer, len(self.lost), "the controller", self.t)
        law = self.plan.problem.control
        control = law._replace(kind=OPEN, tracks_slots=False, leads_body=False, force=force)
        return self.plan.problem._replace(control=control)

    def settle_by(
        self, t_end: float, settle: Settle, controller: Controller | None, rate: float, step: float
    ) -> None:
        """Integrate until the phase has settled, or to ``t_end`` [s]; check at multiples of ``step`` [s]."""
        step *= max(1.0, round(_CHECK / step))  # segments end at samples
        least = self.plan.start + self.plan.problem.reference.T_b
        while self.t < t_end and not self.has_settled:
            t = (math.floor(self.t / step + 1e-9) + 1) * step
            self.fly_to(min(t, t_end), controller, rate)
            if self.t < min(t, self.plan.t_end):
                return  # between two checks
            quiet = self.t - self.lateness >= least and self._settling_error() <= settle.tolerance
            self.quiet_since = min(self.quiet_since, self.t) if quiet else math.inf

    def switch_problem_by_hand(self, problem: Problem) -> None:
        """Continue with another problem of the same size, such as one with a different reference, by hand."""
        self.plan.problem = problem
        self.counted[records.EVALUATIONS] += self.state.count[records.EVALUATIONS]
        # A different law: its derivative is not known yet.
        self.state.count[records.EVALUATIONS] = 0

    def evaluate_law_now(self) -> None:
        """Evaluate the law at the current state; forces and references are then in the workspace."""
        y, t = self.state.y, self.t - self.lateness
        native.closed_loop(t, y, np.empty_like(y), self.plan.problem, self.workspace)

    def observe(self) -> Observation:
        """What a controller sees at the current state."""
        self.evaluate_law_now()
        w, vehicles = self.workspace, self.plan.problem.vehicles
        noisy = len(self.plan.problem.disturbance.noise_r) > 0
        r, v = (w.r_seen, w.v_seen) if noisy else (w.r, w.v)
        tracked = self.plan.problem.control.tracks_slots  # elsewhere, there are no slots
        r_ref, v_ref, a_ref = (np.where(tracked, x, np.nan) for x in (w.r_ref, w.v_ref, w.a_ref))
        return Observation(
            self.t, self.plan.phase.name, r.copy(), v.copy(), r_ref, v_ref, a_ref, self.plan.masses.copy(), vehicles.g
        )  # fmt: skip

    def end(self) -> PhaseState:
        """End the phase at its current state; return the state that the next phase starts from."""
        self.raise_errors()
        if not (self.state.count[records.EVALUATIONS] or self.t > self.plan.start):
            return self.plan.before
        self.evaluate_law_now()
        return self.plan.state_at_end(self.t, self.state.y, self.workspace)

    def raise_errors(self) -> None:
        """Raise errors of the multipliers' solver, or of the monitor's solver."""
        if self.solver is not None:
            self.solver.raise_pending_error()
            self.solver.thread_solver.raise_pending_error()

    # -- inside -----------------------------------------------------------------------------------

    def _integrate(self, problem: Problem, t_end: float) -> None:
        """Integrate to ``t_end`` [s], and remove vehicles and links at the times at which they are lost.

        ``problem`` may hold a user's force instead of the phase's own input law.
        """
        while self.t < t_end:
            if self.next_loss <= self.t:
                problem = self._remove_lost(problem, ~self.lost & (self.plan.lost_at <= self.t))
            else:
                self.fly(problem, min(t_end, self.next_loss))

    def _remove_lost(self, problem: Problem, now: Bools) -> Problem:
        """Continue without the vehicles that are lost ``now`` (N,) and without the links lost by now.

        Returns the remaining problem.
        """
        self.search_extremes(last=True)
        self.raise_errors()
        plan, y, own = self.plan, self.state.y, problem is self.plan.problem
        self.parted = plan.links_lost[1] <= self.t
        if now.any():
            self.lost = self.lost | now
            plan.before = copy_with(plan.before, lost=self.lost)
            self.extremes.remove_lost(self.lost)
        self.next_loss = self._loss_time()
        n = len(self.lost)
        self.count_work()
        kept = plan.remove_lost_edges(self.lost, self.parted)
        integral = y[6 * n : 6 * n + len(kept)][kept]
        rest = y[6 * n + len(kept) :]
        y = np.concatenate([y[: 6 * n], integral, rest])
        self.begun = False
        self.begin(y, self.t)
        if own:
            return plan.problem
        mu = plan.problem.law.mu
        held = without_lost(problem, kept, self.lost, mu, large=plan.is_large)
        self.held = held._replace(graph=plan.problem.graph)
        return self.held

    def _loss_time(self) -> float:
        """Time [s] at which the next vehicle or link is lost; infinity if none is."""
        if not self.plan.loses:
            return math.inf
        agents, links = self.plan.lost_at[~self.lost], self.plan.links_lost[1][~self.parted]
        return min([*agents.tolist(), *links.tolist()], default=math.inf)

    def count_work(self) -> None:
        """Add up the evaluations, steps and solves of the phase, or of its part up to a loss."""
        self.counted += self.state.count[: records.REJECTED + 1]
        if self.solver is not None:
            self.solves.append((self.plan.method, self.solver.counts))

    def sample_times(self, t_end: float) -> Floats:
        """Times (K,) [s] to record from now to ``t_end`` [s]."""
        return self.sampler(self.plan, self.t, t_end, first=not self.begun, stop=self.stop)

    def _settling_error(self) -> float:
        """Largest error [m] of a constraint, a slot or the goal at the integrator's state.

        An attitude error counts as the distance by which it moves a slot.
        """
        plan, w = self.plan, self.workspace
        self.evaluate_law_now()
        errors = [np.abs(w.c).max(initial=0.0)]
        law = plan.problem.control
        if law.tracks_slots:
            errors.append(np.linalg.norm(w.r - w.r_ref, axis=1)[~self.lost].max())
        if law.kind != OPEN and plan.goal is not None and plan.slots is not None:
            goal, since = plan.goal, self.t - plan.arrival  # the goal moves on after arrival
            left = np.where(self.lost, 0.0, plan.masses)
            cm = left @ w.r / left.sum()
            if self.lost.any():  # of the virtual body, from the agents still flying
                cm += w.body[0] - left @ w.r_ref / left.sum()
            errors.append(np.linalg.norm(cm - goal.r - goal.v * since))
            turned = (w.T_ref if law.tracks_slots else w.T) - (
                att.dcm_from_rotation_vector(goal.omega * since) @ goal.T
            )
            errors.append(np.linalg.norm(plan.slots @ turned, axis=1).max())
        return float(max(errors))

    def store_piece(
        self,
        times: Floats,
        source: Record | Unevaluated,
        integral: Floats,
        frame: Floats,
        vehicles: VehicleSamples | None = None,
        layers: LayerSamples | None = None,
    ) -> None:
        """Store a piece of the phase, with what the slots follow if they are tracked."""
        plan, followed = self.plan, ()
        problem, turn = plan.problem, self.turn
        if problem.control.tracks_slots and len(times):
            followed = ((times[0], problem.reference, problem.motion, turn),)
        samples = times, source, integral, frame
        self.pieces.append(
            Piece(self.index, *samples, plan.edges, plan.attached, followed, vehicles, layers)
        )
