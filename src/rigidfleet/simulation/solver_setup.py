"""Prepare the integration of a plan: workspace, and solver of large systems."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from rigidfleet.kernel.problem import RIGID, Problem, Workspace, workspace
from rigidfleet.planning import solvers
from rigidfleet.planning.plan import PhasePlan

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
        steps = solvers.elimination_steps(len(points), edges)
        order = None if steps is None else ordering.pivot_order(steps, plan.problem.graph.edges)
    axes = plan.problem.has_frame or plan.problem.law.k_def > 0.0
    dissect = partial(solvers.dissection_order, points, edges)
    solver = large_solver(plan.problem, Setup(order, dissect, *plan.residual_tolerances(), axes))
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
