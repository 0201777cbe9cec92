"""Fly missions: all at once by `simulate`, or step by step by `Flight`."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet._common.arrays import make_read_only
from rigidfleet._common.renamed import with_earlier_members
from rigidfleet.errors import FlightError, MissionError, StoppedError, wrong_type
from rigidfleet.kernel.avoidance import avoidance_among
from rigidfleet.kernel.problem import External, Motion, workspace
from rigidfleet.math import attitude as att
from rigidfleet.math import lqr
from rigidfleet.mission import Mission, Obstacle, Phase, as_mission
from rigidfleet.mission.model import part_of_mission
from rigidfleet.planning.disturbances import mission_disturbance
from rigidfleet.planning.legs import Leg, state_at_start
from rigidfleet.planning.losses import Answer, answer_to_loss
from rigidfleet.planning.plan import PhasePlan, plan_phase
from rigidfleet.planning.reference import PhaseState, Pose, copy_with
from rigidfleet.planning.timing import complete_times, legs_from, timed_leg
from rigidfleet.result import Extremum, PhaseRecord, Result
from rigidfleet.simulation.active_phase import ActivePhase
from rigidfleet.simulation.as_flown import check_phase_can_begin, mission_as_flown, phase_of_table
from rigidfleet.simulation.callbacks import (
    AttitudeCommand,
    Controller,
    ExternalForce,
    Force,
    Observation,
    RotorCommand,
)
from rigidfleet.simulation.extremes import Extremes
from rigidfleet.simulation.leading import layers
from rigidfleet.simulation.own_laws import Law
from rigidfleet.simulation.plan_integration import PlanIntegration, Sampler
from rigidfleet.simulation.point_propagator import PointPropagator
from rigidfleet.simulation.recording import Piece, assemble_result
from rigidfleet.simulation.sampled_propagator import FleetState, SampledPropagator
from rigidfleet.simulation.sampling import requested_times, times_between
from rigidfleet.solids.records import join_solids
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from rigidfleet.kernel.large.solver import Counts
    from rigidfleet.kernel.mail import Links, Mail

__all__ = [
    "AttitudeCommand", "Controller", "Flight", "FlightInterrupted", "Observation", "Progress", "RotorCommand",
    "simulate",
]  # fmt: skip

#: Interval between progress reports [s of wall time].
_REPORT = 0.1
#: Longest step of a flight with a user's force, unless another one is asked for, and the least that may be [s].
MAX_STEP, _LEAST_STEP = 0.05, 0.001
#: Angle beyond which the frame no longer agrees with the slots it is attached to [rad].
_FLIPPED = math.pi / 2
_FINISHED = "the flight is finished: make another Flight to fly on"


@dataclass(frozen=True)
class Progress:
    """How far a flight has come.

    Attributes
    ----------
    t : mission time reached [s]
    t_end : mission time at the end, settling phases counted up to their timeouts [s]
    phase : name of the phase
    wall : wall time so far [s]
    planning : whether the phase is still being planned
    """

    t: float
    t_end: float
    phase: str
    wall: float
    planning: bool = False


class FlightInterrupted(KeyboardInterrupt):
    """Ctrl-C during a flight; ``result`` holds what had flown."""

    def __init__(self, result: Result) -> None:
        super().__init__(result.ending)
        self.result = result


def simulate(
    mission: Mission | str | Path,
    *,
    controller: Controller | None = None,
    rate: float = 50.0,
    agent: Law | type | None = None,
    force: Force | None = None,
    max_step: float = MAX_STEP,
    times: ArrayLike | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Result:
    """Fly a mission and return its record.

    Parameters
    ----------
    mission : a shipped name, a path or a `Mission`
    controller : replaces the input law wherever slots are tracked: a function of an `Observation` that
        returns the input force (N, 3) [N] of every agent, weight included. It is called ``rate`` times a
        second; its force is held between calls, as on a vehicle. For vehicles it may return an `AttitudeCommand` or
        a `RotorCommand` instead, which no constraint force joins. The verdict names phases in which it was not called.
    rate : control rate [Hz]
    agent : a law of each vehicle's own, in place of all built-in ones, for missions with [network]: a function of a
        `View` that returns the force (3,) [N] of its vehicle, weight included, and a message to its neighbours; or a
        class, of which each vehicle has an object. It is called at each tick of ``autopilot.formation_rate``
    force : an external force f(t, r, v) -> (N, 3) [N] in addition to gravity, world axes, continuous in
        time. A Numba ``cfunc`` of void(double t, double* r, double* v, double* f, ssize_t n) is called
        without Python.
    max_step : longest step [s] while there is a force. A force that lasts at least two steps is felt to 1 %, or to
        the integrator's tolerances if these are wider. Give half of the shortest time for which yours acts
    times : times [s] to record, instead of multiples of the mission's ``output_step``
    progress : a function that is called a few times a second

    Returns
    -------
    Result
        A flight that cannot go on (a singular constraint, a phase that does not settle) is returned
        incomplete, with the diagnosis in ``ending``.

    Raises
    ------
    FlightInterrupted
        On Ctrl-C, with the incomplete result. Before anything has flown, it is a plain
        KeyboardInterrupt.
    FlightError
        The controller, the force or a vehicle's law raised an exception, which is the error's cause, or did not return
        forces. The error's ``result`` is the incomplete flight, or None. Or no phase tracks slots, so that the
        controller would never be called; or the mission has no network for laws of vehicles.
    MissionError
        The mission does not exist, or has errors.
    TypeError
        ``mission`` is no mission.
    ValueError
        A time to record lies outside the mission, the control rate is not positive, or ``max_step`` is not from 0.001 s
        to the duration of the mission; or there are both a controller and an agent.
    """
    flight = Flight(
        mission, controller=controller, rate=rate, agent=agent, force=force, max_step=max_step, times=times,
        progress=progress,
    )  # fmt: skip
    controls = {phase.name: phase.control for phase in flight.mission.phases}
    if controller is not None and not any(phase.tracks_slots for phase in flight.mission.phases):
        raise FlightError(
            f"the controller would never be called, as no phase of the mission tracks slots: control is {controls};"
            " use control = 'tracking' in the phases that it is to fly, or leave the controller out"
        )
    try:
        while flight.begin():
            flight.advance()
    except KeyboardInterrupt:
        if not flight.pieces:
            raise
        ending = f"interrupted at t = {flight.t:.2f} s"
        raise FlightInterrupted(flight.finish(ending)) from None
    except FlightError as error:
        if flight.pieces:
            error.result = flight.finish(f"{error}, in phase '{flight.phases[-1].name}'")
        raise
    return flight.finish()


def _with_times(mission: Mission) -> Mission | None:
    """The mission with its times known; None if it is that already, so that none holds itself."""
    timed = complete_times(mission)
    return None if timed is mission else timed


def _first_plan(mission: Mission, anywhere: bool) -> PhasePlan:
    """The plan of a mission's first phase, if no user's force acts: made once for all flights, and read-only.

    By it, the shortest flights that are repeated save a seventh.
    """
    leg = timed_leg(mission, mission.phases[0], state_at_start(mission), 0, anywhere=anywhere)
    disturbance = None if mission.vehicle_models else mission_disturbance(mission)
    plan = plan_phase(mission, leg, disturbance=disturbance)
    make_read_only([plan])
    # What only losses need holds the mission, which then would not be freed as soon as nobody uses it.
    return plan if plan.loses else copy_with(plan, damping=None)


@with_earlier_members(
    arrive="end_phase_if_over", among="replace_obstacles", contact="deepest_contact"
)
class Flight:
    """A mission flown step by step.

    `begin` a phase, `advance` it and read its state; `finish` returns the record::

        flight = rf.Flight("narrow-passage")
        while flight.begin():  # the next phase of the mission
            while flight.advance(0.5):  # half a second, or to the end of the phase
                print(flight.t, flight.observe().position)
        result = flight.finish()

    Any phase may begin at any time, instead of the mission's next one. ``flight.begin({"kind": "fly", "position":
    [0, 0, 20], "duration": 8})`` ends the phase under way and flies from there to another target. Each stop ends a
    step of the integrator: a flight with stops agrees with one without stops to the integrator's tolerances, not to
    the last bit.

    Parameters are those of `simulate`.

    Attributes
    ----------
    mission : the mission given
    phases : records of the phases begun so far
    ending : why the flight cannot go on; "" while it can
    pieces : samples recorded so far
    """

    def __init__(
        self,
        mission: Mission | str | Path,
        *,
        controller: Controller | None = None,
        rate: float = 50.0,
        agent: Law | type | None = None,
        force: Force | None = None,
        max_step: float = MAX_STEP,
        times: ArrayLike | None = None,
        progress: Callable[[Progress], None] | None = None,
        sampler: Sampler | None = None,
        flips: bool = False,
    ) -> None:
        """Take a mission; ``sampler`` and ``flips`` are for flights by hand (see `rigidfleet.web.live`).

        ``sampler`` chooses the times to record (`rigidfleet.simulation.sampling`); ``flips`` allows a formation to
        flip over.
        """
        mission = as_mission(mission)
        # To find ways takes longer than to fly them.
        self.mission = mission = part_of_mission(mission, _with_times) or mission
        if not (isinstance(rate, int | float | np.number) and rate > 0.0):
            raise ValueError(f"the control rate must be positive [Hz], not {rate!r}")
        for name, function in (
            ("controller", controller),
            ("agent", agent),
            ("progress", progress),
        ):
            if not (function is None or callable(function)):
                raise wrong_type(f"a function for {name}", function)
        if agent is not None and controller is not None:
            raise ValueError(
                "vehicles follow a controller, or laws of their own: give one of controller and agent"
            )
        if agent is not None and mission.network is None:
            raise FlightError(
                "laws of vehicles need a network: add [network] to the mission, or leave the agent out"
            )
        if not (force is None or callable(force) or hasattr(force, "address")):
            raise wrong_type("a function for force", force)
        most = max(MAX_STEP, mission.latest_end)
        if not (isinstance(max_step, int | float | np.number) and _LEAST_STEP <= max_step <= most):
            raise ValueError(
                f"max_step must be from 0.001 to {most:g} s, not {max_step!r}: give half the time that a force lasts"
            )
        self.controller, self.rate, self.progress = controller, rate, progress
        self._built_in = controller is None and agent is None  # whether the mission's own laws fly
        self.external = ExternalForce(force, mission.n_agents) if force is not None else None
        self._push = External(self.external.address, float(max_step)) if self.external else External()  # fmt: skip
        step = mission.output_step
        wanted = step if times is None else requested_times(times, mission.latest_end)
        self.sampler = sampler or partial(times_between, wanted)
        self.flips = flips
        self._reached = state_at_start(mission)
        self._vehicles = (
            FleetState(mission, self._push.max_step, agent) if mission.vehicle_models else None
        )
        # Vehicles meet their disturbances in their own equations of motion.
        self._disturbance = mission_disturbance(mission) if self._vehicles is None else None
        self._extremes = Extremes(mission)
        self._workspaces = cache(workspace)  # phases of one size fly in the same memory
        self._active: ActivePhase | None = None
        self._ended: ActivePhase | None = (
            None  # the phase before, if its last state is not known yet
        )
        self._phases_begun: list[Phase] = []  # each phase as it was begun
        self._cut: set[int] = set()  # phases left before their end
        self._finished = False
        self._route = list(mission.phases)  # phases to fly; after a loss, those that it asks for
        self._reacted = False  # to the loss or order that ends the plan
        self._following = 0  # index of the route's next phase
        self._answer = Answer([])  # what follows from it
        #: Of the phases begun, if the flight may have to leave them.
        self._plans: list[PhasePlan] = []
        self._started = self._reported = clock.perf_counter()
        self._count = np.zeros(3, dtype=np.int64)
        self._solves: dict[str, Counts] = {}
        self.pieces: list[Piece] = []
        self.phases: list[PhaseRecord] = []
        self.ending = ""

    # -- what can be seen -------------------------------------------------------------------------

    @property
    def t(self) -> float:
        """Mission time reached [s]."""
        if self._active is None:
            return self.phases[-1].t_end if self.phases else 0.0
        return self._active.t

    @property
    def plan(self) -> PhasePlan:
        """Plan of the phase under way: its formation, slots, goal and problem."""
        return self.under_way().plan

    def observe(self) -> Observation:
        """Measured and desired states of the vehicles now; to observe changes nothing of the flight.

        Raises
        ------
        FlightError
            No phase is under way.
        """
        return self.under_way().observe()

    def pose(self) -> Pose:
        """Pose of the virtual body: its reference if slots are tracked, otherwise the agents' own frame."""
        active = self.under_way()
        active.evaluate_law_now()
        w, plan = active.integration.workspace, active.plan
        if plan.problem.control.tracks_slots:
            return Pose(w.body[0].copy(), w.body[1].copy(), w.T_ref.copy(), w.body[3].copy())
        return Pose(w.cm[0].copy(), w.cm[1].copy(), w.T.copy(), np.zeros(3))

    # -- flying -----------------------------------------------------------------------------------

    def begin(self, phase: Phase | Mapping[str, Any] | None = None) -> bool:
        """Begin a phase at the current state: the mission's next one, or another one.

        Parameters
        ----------
        phase : a table as in a mission file, or a phase of `rigidfleet.mission`

        Returns
        -------
        bool
            Whether there is a phase to fly: False at the end of the mission, or if the flight cannot go on (then
            `ending` says why).

        Raises
        ------
        MissionError
            The phase has errors.
        FlightError
            The flight has been finished, nothing of the phase before has been flown, or a user's function failed.
        TypeError
            It is no phase.
        """
        if self._finished:
            raise FlightError(_FINISHED)
        if self.ending:
            return False
        by_hand = phase is not None
        if phase is None:
            if self._active is not None and not self._active.has_flown:
                raise FlightError(
                    f"nothing of phase '{self.phases[-1].name}' has been flown: call advance before the next begin"
                )
            if not self._reacted and self.t >= self.mission.abandons_at:
                self._leave_phase(changed=True)
                self._react_to_loss()
            if self._following >= len(self._route):
                if why := self._answer.problem:
                    self.ending = f"no way home is proved from where the flight was aborted: {why}"
                return False
            phase = self._route[self._following]
            self._following += 1
        elif isinstance(phase, Mapping):  # no phase yet
            # Checked first: a phase under way goes on where it has errors.
            flown = len(self.phases) - (self._active is not None and not self._active.has_flown)
            phase = phase_of_table(
                self.mission, self._phases_begun[:flown], self.phases[:flown], phase
            )
        else:
            check_phase_can_begin(self.mission, phase)
        self._leave_phase(changed=True)
        if self.mission.on_loss == "continue" or not self._is_from_route(phase):
            self._reached = copy_with(self._next_start_state, blend=None)
        if self._phases_begun:
            self._report_progress(phase, planning=True)
        try:
            # Avoidance leads the body beside its plan, from where a follow leads back; never the slots about it.
            evades = phase.follows_curves and not by_hand and layers(self.mission) is not None
            if by_hand or self._phases_begun or self.external is not None:
                where = self._next_start_state, len(self._phases_begun)
                leg = timed_leg(self.mission, phase, *where, anywhere=evades)
                own = {"disturbance": self._disturbance, "external": self._push}
                plan = plan_phase(self.mission, leg, **own)
            else:
                plan = part_of_mission(self.mission, _first_plan, evades)
                plan = copy_with(plan, through=deepcopy(plan.through))
            phase = plan.phase
            self._stop_if_flipped(plan)
            at = PlanIntegration(
                len(self.phases), plan, self._extremes, self.external, self.sampler, self.pieces,
                partial(self._report_progress, phase), self._workspaces,
            )  # fmt: skip
            fleet = self._vehicles
            propagator = PointPropagator(at) if fleet is None else SampledPropagator(at, fleet)
            self._active = ActivePhase(propagator)
        except MissionError as error:
            # Only where a flight leaves it open can a phase of the mission be impossible: the rest are errors.
            if by_hand or not (phase.auto_keys or phase.follows_curves):
                raise
            self.ending = "; ".join(f"phase '{phase.name}' {f.problem}" for f in error.findings)
            return False
        except StoppedError as stop:
            self.ending = str(stop)
            return False
        self._phases_begun.append(phase)
        if self.mission.abandons_at < math.inf:
            self._plans.append(plan)
        # Nobody asks a controller of the user's to follow the plan.
        record = PhaseRecord(
            phase.name, phase.kind, phase.control, plan.formation, plan.start, plan.start,
            settled=None if phase.settle is None else False, target=plan.target_record,
            planned=plan.certificate._asdict() if self._built_in and plan.certificate else None,
        )  # fmt: skip
        self.phases.append(record)
        return True

    def advance(self, duration: float | None = None) -> bool:
        """Fly on for a duration [s], or to the end of the phase.

        Returns
        -------
        bool
            Whether the phase goes on: False at its end, at a loss that the mission answers, or if the flight cannot go
            on (then `ending` says why).

        Raises
        ------
        FlightError
            No phase is under way, or a user's function failed.
        ValueError
            The duration is not positive.
        """
        active = self.under_way()
        if duration is not None and not isinstance(duration, int | float | np.number):
            raise wrong_type("a duration [s]", duration)
        if duration is not None and not duration > 0.0:
            raise ValueError(f"the duration must be positive [s], not {duration!r}")
        plan = active.plan
        stop = min(math.inf if duration is None else active.t + duration, self._aborts_at())
        active.integration.stop = stop
        t_end, settle = min(stop, plan.t_end), plan.phase.settle
        try:
            if settle is None:
                active.fly_to(t_end, self.controller, self.rate)
            else:
                step = self.mission.output_step
                active.settle_by(t_end, settle, self.controller, self.rate, step)
        except StoppedError as stopped:
            self.ending = str(stopped)
            self._leave_phase()
            return False
        except BaseException:
            self._leave_phase()
            raise
        return self.end_phase_if_over()

    def end_phase_if_over(self) -> bool:
        """End the phase under way if it is over; return whether it goes on, as `advance` does."""
        active = self.under_way()
        plan, settle, loss = active.plan, active.plan.phase.settle, self._aborts_at()
        self.phases[-1].t_end = active.t
        if active.has_settled or active.is_at_latest_end:
            settled = active.has_settled
            self._leave_phase()
            if settle is not None and not settled:
                self.ending = (
                    f"phase '{plan.phase.name}' did not settle within {settle.timeout:g} s: at t ="
                    f" {self.t:.2f} s its error was above {settle.tolerance:g} m. Give it a"
                    " longer timeout or a larger tolerance, or look for the cause in the constraint error"
                )
            return False
        if active.t >= loss:
            self._leave_phase(abandoned=True)
            return False
        return True

    def steer(
        self,
        h: float,
        start: Pose,
        end: tuple[Floats, Floats, Floats],
        turn: tuple[Floats, Floats, Floats],
        *,
        a: Floats,
        alpha: Floats,
        force: bool = True,
    ) -> None:
        """Replace the reference of the virtual body over the next ``h`` [s].

        Parameters
        ----------
        start : the reference now, with its acceleration ``a`` [m/s^2] and angular acceleration ``alpha`` [rad/s^2]
        end : displacement (3,) [m] over ``h``, velocity and acceleration at its end
        turn : rotation vector (3,) [rad] over ``h``, body rates and their derivative at its end
        force : whether the user's force acts during ``h``
        """
        active = self.under_way()
        t, problem = active.t, active.plan.problem
        external = self._push if force else External()
        if active.plan.phase.leads_body:
            feedback = problem.feedback._replace(
                arrival=t, r=start.r, v=start.v, T1=np.ascontiguousarray(start.T), omega=start.omega
            )
            active.propagator.take_up(problem._replace(feedback=feedback, external=external))
            return
        (r, v, a_end), (phi, omega, alpha_end) = end, turn
        zero = np.zeros(3)
        rate = att.rotation_vector_rate(phi, omega)
        x = np.array([[*start.r, *zero], [*(start.r + r), *phi]])
        x_dot = np.array([[*start.v, *start.omega], [*v, *rate]])
        x_ddot = np.array([[*a, *alpha], [*a_end, *(alpha_end + 0.5 * np.cross(phi, alpha_end))]])
        times = np.array([t, t + h])
        pieces = np.ascontiguousarray(lqr.quintic_pieces(times, x, x_dot, x_ddot))
        motion = Motion(times, pieces, np.ascontiguousarray(start.T))
        active.propagator.take_up(problem._replace(motion=motion, external=external))

    def finish(self, ending: str = "") -> Result:
        """End the flight; return its record.

        If the phases flown are not the mission's, the record's mission has the phases flown. A phase that was left
        early ends there and keeps its goal, which the flight did not reach and which is not judged.

        Parameters
        ----------
        ending : why the flight ends before its mission does; by default `Flight.ending`

        Raises
        ------
        FlightError
            Nothing has been flown.
        """
        self._leave_phase()
        self.ending = ending or self.ending
        if not self.pieces:
            raise FlightError(self.ending or "the flight ended before the first time to record")
        route = tuple(self._route)
        last = len(self._phases_begun) - 1
        own = tuple(self._phases_begun) == route[: last + 1] and self._cut <= {last}
        whole = own and last + 1 == len(route) and not self._cut
        if own and not whole and not self.ending:
            self.ending = f"ended at t = {self.t:.2f} s, before the mission's end"
        self._finished = True
        if self._ended is not None:  # no phase follows
            self._ended.free_memory()
            self._ended = None
        return self.record(self.pieces, None if own else self._phases_begun)

    @property
    def network(self) -> tuple[Links, Mail] | None:
        """The network of the vehicles, and what was sent on it; None without one."""
        return None if self._vehicles is None else self._vehicles.network

    def lose_messages(self, loss: float) -> None:
        """Let links lose a share of the messages from now on, if there are any."""
        if self._vehicles is not None:
            self._vehicles.lose_messages(loss)

    def record(
        self,
        pieces: list[Piece],
        flown: list[Phase] | None = None,
        *,
        step: float | None = None,
        ending: str | None = None,
    ) -> Result:
        """The record of samples, of the mission's own phases or of the phases ``flown`` instead."""
        active = self._active
        if active is not None:  # the flight can go on
            active.search_extremes()
            self.phases[-1].extremes = self._extremes.extremes_so_far()
        mission, phases = self.mission, self.phases
        if flown is not None:
            last = max(piece.phase for piece in pieces) + 1
            step = step or mission.output_step
            mission, phases = mission_as_flown(mission, flown[:last], phases[:last], step)
        self._extremes.add_extremes_to_phases(phases)
        evaluations, steps, rejected = self._count.tolist()
        statistics = {
            "evaluations": evaluations, "steps": steps, "rejected": rejected,
            "wall_s": clock.perf_counter() - self._started, "simulated_s": self.t,
            "rtol": mission.integrator.rtol, "atol": mission.integrator.atol,
            "solvers": {method: vars(counts) for method, counts in self._solves.items()},
        }  # fmt: skip
        if self._vehicles is not None and self._vehicles.laws is not None:
            statistics["message_numbers"] = self._vehicles.laws.numbers
        if mission.avoidance is not None and self.external is not None:
            statistics["pushed"] = True  # by a force that avoidance does not know
        if self._answer.promise is not None:
            statistics["promised"] = [self._answer.legs[0].start, self._answer.promise]
        ending = self.ending if ending is None else ending
        result = assemble_result(
            mission, phases, pieces, ending=ending, statistics=statistics, network=self.network
        )
        result.mission = mission  # keeps the slots assigned and edges that it has computed
        return result

    def replace_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Fly on among these obstacles: the first are those before, others may be new or move in other ways.

        `mission` has them from now on, its text has not.
        """
        if self._active is not None:
            self._active.search_extremes()
        self.mission = self.mission.model_copy(update={"obstacles": tuple(obstacles)})
        self._extremes.replace_obstacles(obstacles)
        vehicles = self._vehicles
        if vehicles is not None and vehicles.avoidance is not None:
            solids = join_solids([thing.solid for thing in obstacles])
            vehicles.avoidance = avoidance_among(vehicles.avoidance, solids)

    def deepest_contact(self) -> Extremum | None:
        """The deepest contact of a vehicle in flight with an obstacle so far, with vehicle and obstacle, or None."""
        if self._active is not None:
            self._active.search_extremes()
        return self._extremes.deepest_contact()

    # -- inside -----------------------------------------------------------------------------------

    @property
    def _next_start_state(self) -> PhaseState:
        """The state from which the next phase starts, evaluated when it is asked for: none follows the last."""
        if self._ended is not None:
            self._reached = self._ended.end()
            self._ended.free_memory()
            self._ended = None
        return self._reached

    def under_way(self) -> ActivePhase:
        """The phase under way.

        Raises
        ------
        FlightError
            None is.
        """
        if self._finished:
            raise FlightError(_FINISHED)
        if self._active is None:
            why = self.ending or "call begin first"
            raise FlightError(f"no phase is under way: {why}")
        return self._active

    def _aborts_at(self) -> float:
        """Time [s] of the loss that ends the phase under way; infinity if none does.

        Phases begun by hand go on: who began them decides.
        """
        routed = self._is_from_route(self._phases_begun[-1])
        return self.mission.abandons_at if routed and not self._reacted else math.inf

    def _is_from_route(self, phase: Phase) -> bool:
        """Whether the route gives a phase that has begun last, or is about to."""
        return self._following > 0 and phase is self._route[self._following - 1]

    def _react_to_loss(self) -> None:
        """Replace the rest of the route by what the mission asks for after a loss."""
        self._reacted = True
        lost = self.mission.lost_at <= self._next_start_state.t
        if lost.any():
            self._extremes.remove_lost(lost)
            self._reached = copy_with(self._next_start_state, lost=lost)
        self._answer = answer_to_loss(
            self.mission, self._next_start_state, self._legs_begun_and_ahead
        )
        legs = self._answer.legs
        if legs:
            self._reached = legs[0].before
        self._route = [*self._phases_begun, *(leg.phase for leg in legs)]
        self._following = len(self._phases_begun)

    def _legs_begun_and_ahead(self) -> list[Leg]:
        """The legs of the phases begun, and of those of the route that were to follow."""
        plan: list[Leg] = []
        for leg, record in zip(self._plans, self.phases, strict=True):
            end = max(leg.end, record.t_end) if record.abandoned else record.t_end
            plan.append(copy_with(leg, end=end))
        k = self._following
        return plan + legs_from(self.mission, plan[-1].state_at(plan[-1].end), self._route[k:], k)

    def _leave_phase(self, *, changed: bool = False, abandoned: bool = False) -> None:
        """End the phase under way.

        A target that was ``changed`` in flight, or ``abandoned`` because of a loss, is not judged as a waypoint. Points
        on the way are, if the flight came to them before the loss.
        """
        active = self._active
        if active is None:
            return
        self._active = None
        if (
            not active.has_flown
        ):  # as if it had never begun: if it is the mission's, it is still to come
            self._following -= self._is_from_route(self._phases_begun[-1])
            del self.phases[-1], self._phases_begun[-1], self._plans[-1:]
            return
        if not (active.has_settled or active.is_at_latest_end or abandoned):
            self._cut.add(len(self.phases) - 1)
        active.search_extremes()
        at, record = active.integration, self.phases[-1]
        record.extremes = self._extremes.end_phase()
        record.abandoned = abandoned
        record.controller = (
            None if self._built_in else self.controller is None or active.control_calls > 0
        )
        if self._vehicles is not None:  # which may have waited, so that it came later
            record.target = active.plan.target_record
        record.settled = None if abandoned else active.has_settled
        at.count_work()
        self._count += at.counted
        for method, counts in at.solves:
            self._solves.setdefault(method, type(counts)()).add(counts)
        self._ended = active
        record.t_end = active.t
        at.raise_errors()  # those of a solver, at once
        if abandoned:
            points = () if record.target is None else record.target.get("through", ())
            came = [point for point in points if point["time"] <= record.t_end]
            record.target = {"time": came[-1]["time"], "through": came} if came else None
        if changed and record.target is not None and record.target["time"] > record.t_end:
            record.target = None
        if not abandoned and (
            active.has_settled or active.is_at_latest_end or active.t >= active.plan.arrival
        ):
            record.stay = active.plan.end_state_record(active.t)

    def _stop_if_flipped(self, plan: PhasePlan) -> None:
        """Stop if the formation has flipped: its slots no longer agree with the body frame."""
        both = {plan.phase.leads_body, *(phase.leads_body for phase in self._phases_begun[-1:])}
        now = self._next_start_state
        if self.flips or not all(both) or now.frame is None or plan.frame is None:
            return
        angle = att.angle_between(
            att.quaternion_from_dcm(now.frame), att.quaternion_from_dcm(plan.frame)
        )
        if angle > _FLIPPED:
            raise StoppedError(
                f"the formation '{now.formation}' has flipped at t = {now.t:.2f} s: its slots are"
                f" {math.degrees(angle):.0f} deg from the integrated body frame. When a shape unfolds from"
                " a line, distances alone do not say to which side. Track slots in that phase:"
                ' control = "tracking"'
            )

    def _report_progress(self, phase: Phase, *, planning: bool = False) -> None:
        wall = clock.perf_counter()
        at_once = planning or not self.pieces
        if self.progress is not None and (at_once or wall - self._reported > _REPORT):
            self._reported = wall
            t_end = self.mission.latest_end
            self.progress(Progress(self.t, t_end, phase.name, wall - self._started, planning))
