"""Prepare the integration of a plan: workspace, solver of large systems, first step."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from rigidfleet.kernel import records
from rigidfleet.kernel.engine import native
from rigidfleet.kernel.problem import RIGID, Problem, Workspace, workspace
from rigidfleet.planning import solvers
from rigidfleet.planning.plan import PhasePlan
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from rigidfleet.kernel.large.solver import LargeSolver, Setup


def workspace_and_solver(
    plan: PhasePlan, make: Callable[..., Workspace]
) -> tuple[Workspace, LargeSolver | None]:
    """Workspace of a plan, and the solver for its multipliers if the kernel itself does not solve for them.

    ``make`` makes a workspace, or returns one that the phase before has used.
    """
    if not plan.is_large:
        work = workspace_of(plan.problem, make=make)
        work.T[:] = work.T_ref[:] = np.eye(3)
        return work, None
    from rigidfleet.kernel.large import ordering
    from rigidfleet.kernel.large.solver import Setup

    points, edges = plan.before.r if plan.slots is None else plan.slots, plan.edges
    order = None
    if plan.method == "elimination":
        steps = solvers.henneberg_steps(len(points), edges)
        order = None if steps is None else ordering.order_of_steps(steps, plan.problem.graph.edges)
    axes = plan.problem.has_frame or plan.problem.law.k_def > 0.0
    dissect = partial(solvers.agent_dissection_order, points, edges)
    solver = large_solver(plan.problem, Setup(order, dissect, *plan.residual_rtol_and_atol(), axes))
    plan.problem = problem_with_solver(solver, plan.problem)
    return solver.workspace, solver


def large_solver(problem: Problem, setup: Setup) -> LargeSolver:
    """A solver for the multipliers of a large formation, with a workspace."""
    from rigidfleet.kernel.large.solver import LargeSolver

    work = workspace_of(problem, large=True)
    return LargeSolver(problem.vehicles, problem.graph.edges, problem.law, work, setup)


def problem_with_solver(solver: LargeSolver, problem: Problem) -> Problem:
    """A problem whose multipliers this solver finds, as long as somebody keeps it."""
    graph = problem.graph._replace(solver=solver.address, multipliers=solver.multipliers)
    return problem._replace(graph=graph)


def workspace_of(
    problem: Problem, *, large: bool = False, make: Callable[..., Workspace] = workspace
) -> Workspace:
    """A workspace for a problem; that of a ``large`` formation has no room for a dense solve of its multipliers."""
    size, with_h = problem.graph.edges.shape[0], problem.control.allocation != RIGID
    return make(
        len(problem.vehicles.m), size, with_h=with_h, solver=problem.law.solver, large=large
    )


def first_step(plan: PhasePlan, work: Workspace, state: records.IntegratorState) -> float:
    """First step [s] to try in a large formation, from two evaluations.

    Hairer, Nørsett and Wanner, Solving Ordinary Differential Equations I, section II.4. Growing from a tiny
    step would cost a large formation more.
    """
    problem: Problem = plan.problem
    t, y = float(state.clock[records.TIME]), state.y
    scale = plan.tolerances + state.rtol * np.abs(y)

    def rms_in_tolerances(x: Floats) -> float:
        return float(np.sqrt(np.mean((x / scale) ** 2)))

    longest = plan.t_end - plan.start
    slope, later = np.empty_like(y), np.empty_like(y)
    native.closed_loop(t, y, slope, problem, work)
    first = rms_in_tolerances(slope)
    h = min(0.01 * rms_in_tolerances(y) / max(first, 1e-300), longest)
    native.closed_loop(t + h, y + h * slope, later, problem, work)
    steepest = max(first, rms_in_tolerances(later - slope) / h)
    if not 0.0 < steepest < math.inf:
        return float(state.clock[records.NEXT_STEP])
    return min(100.0 * h, (0.01 / steepest) ** 0.2, longest)
