"""A phase under way: flown by its law or a controller, until it ends or settles, through losses of vehicles and links.

It knows nothing of the mission, and not how vehicles move: its `Propagator` does.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from rigidfleet.kernel import records
from rigidfleet.kernel.engine import native, packing
from rigidfleet.kernel.problem import OPEN, Problem
from rigidfleet.math import attitude as att
from rigidfleet.mission import Settle
from rigidfleet.planning.disturbances import without_lost
from rigidfleet.planning.reference import PhaseState, copy_with
from rigidfleet.simulation.callbacks import (
    Command,
    Controller,
    Observation,
    call_user_code,
    check_force,
)
from rigidfleet.simulation.plan_integration import PlanIntegration
from rigidfleet.typing import Floats

#: Interval between checks whether a phase has settled, if it ends by settling [s].
_CHECK = 0.1


class Propagator(Protocol):
    """What carries the state of a phase forward in time: `PointPropagator` or `SampledPropagator`.

    Attributes
    ----------
    integration : where it stands; the propagator alone changes its state
    control_start : time from which a controller's calls are counted [s]
    """

    integration: PlanIntegration
    control_start: float

    @property
    def lateness(self) -> float:
        """Time by which the plan's references are behind now [s]."""

    def begin(self, y: Floats, t: float) -> None:
        """Begin at a state (n,) and time [s], with the edges that the plan has: at the start, and after a loss."""

    def fly(self, problem: Problem, t_end: float) -> None:
        """Fly a problem and record the samples on the way: to ``t_end`` [s], the end of the plan, or a moment before.

        The problem is the plan's, or the plan's under a user's controller.

        Raises
        ------
        StoppedError
            The flight cannot go on.
        """

    def search_extremes(self, *, last: bool) -> None:
        """Search the steps flown for extremes; ``last``: no further steps of this problem follow."""

    def take_up(self, problem: Problem) -> None:
        """Fly on by hand: by another problem of the same size, which becomes the plan's."""

    def hold_command(self, command: Command | None) -> None:
        """Hold a command of vehicles from now on, or none, instead of the last one.

        Raises
        ------
        FlightError
            They do not take it.
        """

    def states_seen(self) -> dict[str, Floats]:
        """Copies of the states that an `Observation` shows, by its names, after an evaluation of the law."""

    def hand_over(self) -> None:
        """Leave to the next phase what is not in the state; nothing is flown from then on."""


class ActivePhase:
    """A phase under way.

    Attributes
    ----------
    propagator : what flies it
    integration, plan : those of the propagator
    control_calls : number of calls of the user's controller
    """

    def __init__(self, propagator: Propagator) -> None:
        self.propagator, self.integration = propagator, propagator.integration
        self.plan = plan = self.integration.plan
        self.parted = plan.links_lost[1] <= plan.start  # (L,) links that are lost
        self.next_loss = self._loss_time()  # of a vehicle or a link [s]
        self.control_calls = 0
        self.held: Problem | None = None  # the plan's under what the controller last returned
        self.quiet_since = math.inf  # since when the phase has been settled [s]
        propagator.begin(plan.initial_state(), plan.start)

    # -- where it is ----------------------------------------------------------------------------------

    @property
    def t(self) -> float:
        """Mission time reached [s]."""
        return self.integration.t

    @property
    def is_at_latest_end(self) -> bool:
        """Whether the phase has reached its latest end."""
        return self.t >= self.plan.t_end

    @property
    def has_flown(self) -> bool:
        """Whether anything of the phase was flown, or was to be when the flight stopped."""
        return self.integration.begun or self.t > self.plan.start

    @property
    def has_settled(self) -> bool | None:
        """Whether the phase has settled; None if it does not end by settling."""
        settle = self.plan.phase.settle
        return None if settle is None else self.t - self.quiet_since >= settle.dwell - 1e-9

    def evaluate_law_now(self) -> None:
        """Evaluate the law at the current state; forces and references are then in the workspace."""
        at = self.integration
        y, t = at.state.y, at.t - self.propagator.lateness
        native.closed_loop(t, y, np.empty_like(y), self.plan.problem, at.workspace)

    def observe(self) -> Observation:
        """What a controller sees at the current state."""
        self.evaluate_law_now()
        w, plan = self.integration.workspace, self.plan
        tracked = plan.problem.control.tracks_slots  # elsewhere, there are no slots
        r_ref, v_ref, a_ref = (np.where(tracked, x, np.nan) for x in (w.r_ref, w.v_ref, w.a_ref))
        return Observation(
            t=self.t, phase=plan.phase.name, masses=plan.masses.copy(), gravity=plan.problem.vehicles.g,
            reference_position=r_ref, reference_velocity=v_ref, reference_acceleration=a_ref,
            **self.propagator.states_seen(),
        )  # fmt: skip

    # -- flying -----------------------------------------------------------------------------------

    def fly_to(self, t_end: float, controller: Controller | None, rate: float) -> None:
        """Fly to ``t_end`` [s], or to the end of the phase, which comes later if the formation waits.

        It flies under the phase's input law, or the user's controller, called at ``rate`` [Hz]. Vehicles and links are
        removed at the times at which they are lost.

        Raises
        ------
        StoppedError
            The flight cannot go on.
        """
        plan, start = self.plan, self.propagator.control_start
        t_end = math.inf if t_end >= plan.t_end else t_end
        while self.t < min(t_end, plan.t_end):
            problem, until = plan.problem, min(t_end, self.next_loss)
            if controller is not None and plan.phase.tracks_slots:
                # Control instants are the start of the phase and multiples since, not the ends of its segments.
                if self.held is None or self.t >= start + self.control_calls / rate:
                    self.held = self._call_controller(controller)
                    # Instants that differ by a rounding error, far less than a millionth of a period, are one.
                    self.control_calls = (
                        max(self.control_calls, math.floor((self.t - start) * rate + 1e-6)) + 1
                    )
                problem, until = self.held, min(until, start + self.control_calls / rate)
            if self.next_loss <= self.t:
                self._remove_lost()
            else:
                self.propagator.fly(problem, until)

    def _call_controller(self, controller: Controller) -> Problem:
        """The plan's problem with what a user's controller asks for now: forces, or a command of vehicles."""
        when = f"at t = {self.t:.3f} s"
        answer = call_user_code("the controller", when, controller, self.observe())
        command = answer if isinstance(answer, Command) else None
        self.propagator.hold_command(command)
        problem = self.plan.problem
        if command is not None:
            return problem._replace()  # not the plan's own
        force = check_force(answer, len(self.plan.masses), "the controller", self.t)
        control = problem.control._replace(
            kind=OPEN, tracks_slots=False, leads_body=False, force=force
        )
        return problem._replace(control=control)

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
            due = self.t - self.propagator.lateness >= least
            quiet = due and self._settling_error() <= settle.tolerance
            self.quiet_since = min(self.quiet_since, self.t) if quiet else math.inf

    def search_extremes(self) -> None:
        """Search all steps flown so far for extremes."""
        self.propagator.search_extremes(last=True)

    def end(self) -> PhaseState:
        """End the phase at its current state; return the state that the next phase starts from."""
        at = self.integration
        self.propagator.hand_over()
        at.raise_errors()
        if not (at.state.count[records.EVALUATIONS] or at.t > self.plan.start):
            return self.plan.before
        self.evaluate_law_now()
        return self.plan.state_at_end(at.t, at.state.y, at.workspace)

    def free_memory(self) -> None:
        """Let go of what a large formation has packed, after the end: nothing more is asked of the phase."""
        if self.integration.solver is not None:
            packing.forget_last_packed()

    # -- inside -----------------------------------------------------------------------------------

    def _remove_lost(self) -> None:
        """Continue without the vehicles and the links that are lost by now."""
        plan, at = self.plan, self.integration
        self.search_extremes()
        at.raise_errors()
        at.count_work()
        self.parted = plan.links_lost[1] <= at.t
        now = ~plan.before.lost & (plan.lost_at <= at.t)
        if now.any():
            plan.before = copy_with(plan.before, lost=plan.before.lost | now)
            at.extremes.remove_lost(plan.before.lost)
        self.next_loss = self._loss_time()
        lost, y = plan.before.lost, at.state.y
        n, m = len(lost), len(plan.edges)
        kept = plan.remove_lost_edges(lost, self.parted)
        y = np.concatenate([y[: 6 * n], y[6 * n : 6 * n + m][kept], y[6 * n + m :]])
        self.propagator.begin(y, at.t)
        if self.held is not None:
            mu, graph = plan.problem.law.mu, plan.problem.graph
            held = without_lost(self.held, kept, lost, mu, large=plan.is_large)
            self.held = held._replace(graph=graph)

    def _loss_time(self) -> float:
        """Time [s] at which the next vehicle or link is lost; infinity if none is."""
        plan = self.plan
        if not plan.loses:
            return math.inf
        agents, links = plan.lost_at[~plan.before.lost], plan.links_lost[1][~self.parted]
        return min([*agents.tolist(), *links.tolist()], default=math.inf)

    def _settling_error(self) -> float:
        """Largest error [m] of a constraint, a slot or the goal at the integrator's state.

        An attitude error counts as the distance by which it moves a slot.
        """
        plan, w, lost = self.plan, self.integration.workspace, self.plan.before.lost
        self.evaluate_law_now()
        errors = [np.abs(w.c).max(initial=0.0)]
        law = plan.problem.control
        if law.tracks_slots:
            errors.append(np.linalg.norm(w.r - w.r_ref, axis=1)[~lost].max())
        if law.kind != OPEN and plan.goal is not None and plan.slots is not None:
            goal, since = plan.goal, self.t - plan.arrival  # the goal moves on after arrival
            left = np.where(lost, 0.0, plan.masses)
            cm = left @ w.r / left.sum()
            if lost.any():  # of the virtual body, from the agents still flying
                cm += w.body[0] - left @ w.r_ref / left.sum()
            errors.append(np.linalg.norm(cm - goal.r - goal.v * since))
            turned = (w.T_ref if law.tracks_slots else w.T) - (
                att.dcm_from_rotation_vector(goal.omega * since) @ goal.T
            )
            errors.append(np.linalg.norm(plan.slots @ turned, axis=1).max())
        return float(max(errors))
