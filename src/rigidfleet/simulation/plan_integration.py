"""The integration of a plan, which a phase under way shares with its propagator. It knows nothing of the mission."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from rigidfleet.kernel import records
from rigidfleet.kernel.problem import Workspace
from rigidfleet.kernel.records import IntegratorState, Record
from rigidfleet.planning.plan import PhasePlan
from rigidfleet.planning.vehicles import YawTurn
from rigidfleet.simulation.callbacks import ExternalForce
from rigidfleet.simulation.extremes import Extremes
from rigidfleet.simulation.recording import LayerSamples, Piece, Unevaluated, VehicleSamples
from rigidfleet.simulation.solver_setup import workspace_and_solver
from rigidfleet.typing import Floats, Ints

if TYPE_CHECKING:
    from rigidfleet.kernel.large.solver import Counts, LargeSolver

#: Function that gives the times in (t, t_end] to record: sampling(plan, t, t_end, first=..., stop=...).
Sampler = Callable[..., Floats]


@dataclass
class PlanIntegration:
    """The integration of a plan: where it stands, in which memory, who watches its steps, and where its samples go.

    Attributes
    ----------
    index : of the phase, from 0
    external : the user's force, if there is one
    pieces : samples recorded so far
    pause : is called whenever the kernel has returned
    workspaces : makes a workspace, or returns one that the phase before has used
    workspace, solver : where the law is evaluated, and what solves for its multipliers in a large formation
    state : of the integrator; `rigidfleet.kernel.dynamics` says how ``state.y`` is laid out
    stop : time at which the caller wants a sample [s]
    begun : whether samples exist since the start or the last loss
    counted, solves : evaluations, steps and rejections (3,), and solves by method, up to `count_work`
    """

    index: int
    plan: PhasePlan
    extremes: Extremes
    external: ExternalForce | None
    sampler: Sampler
    pieces: list[Piece]
    pause: Callable[[], None]
    workspaces: Callable[..., Workspace]
    workspace: Workspace = field(init=False)
    solver: LargeSolver | None = field(init=False)
    state: IntegratorState = field(init=False)
    stop: float = math.inf
    begun: bool = False
    counted: Ints = field(default_factory=lambda: np.zeros(3, dtype=np.int64))
    solves: list[tuple[str, Counts]] = field(default_factory=list)

    def begin(self, y: Floats, t: float, states: int, room: int) -> None:
        """Begin at a state (n,) and time [s]: at the start, and after a loss.

        The watch follows the first ``states``, in a trail with ``room`` for so many steps.
        """
        plan = self.plan
        self.workspace, self.solver = workspace_and_solver(plan, self.workspaces)
        trail = self.extremes.begin_monitoring(states, len(plan.edges), room)
        rtol, atol = plan.integrator.rtol, plan.tolerances
        self.state = records.integrator(y, t, rtol=rtol, atol=atol, trail=trail)
        self.begun = False

    @property
    def t(self) -> float:
        """Mission time reached [s]."""
        return float(self.state.clock[records.TIME])

    def sample_times(self, t_end: float) -> Floats:
        """Times (K,) [s] to record from now to ``t_end`` [s]."""
        return self.sampler(self.plan, self.t, t_end, first=not self.begun, stop=self.stop)

    def store_piece(
        self,
        times: Floats,
        source: Record | Unevaluated,
        integral: Floats,
        frame: Floats,
        turn: YawTurn | None = None,
        vehicles: VehicleSamples | None = None,
        layers: LayerSamples | None = None,
    ) -> None:
        """Store a piece of the phase, with what the slots follow if they are tracked."""
        plan, problem = self.plan, self.plan.problem
        tracked = problem.control.tracks_slots and len(times)
        followed = ((times[0], problem.reference, problem.motion, turn),) if tracked else ()
        samples = times, source, integral, frame, plan.edges, plan.attached, followed
        self.pieces.append(Piece(self.index, *samples, vehicles, layers))

    def raise_errors(self) -> None:
        """Raise errors of the multipliers' solver, or of the monitor's solver."""
        if self.solver is not None:
            self.solver.raise_pending_error()
            self.solver.thread_solver.raise_pending_error()

    def count_work(self) -> None:
        """Add up the evaluations, steps and solves of the phase, or of its part up to a loss."""
        self.counted += self.state.count[: records.REJECTED + 1]
        if self.solver is not None:
            self.solves.append((self.plan.method, self.solver.counts))
