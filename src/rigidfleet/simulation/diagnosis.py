"""Why a flight cannot go on: when, where, and what to try."""

from __future__ import annotations

import math

import numpy as np

from rigidfleet.kernel.engine import native
from rigidfleet.kernel.records import ACCEPTED, NEXT_STEP, REJECTED
from rigidfleet.math.constraint_jacobian import jacobian
from rigidfleet.planning import solvers
from rigidfleet.planning.plan import PhasePlan
from rigidfleet.simulation.plan_integration import PlanIntegration
from rigidfleet.typing import Floats

#: What to do about distance errors that no feedback corrects.
_FEEDBACK = '; without feedback, errors grow: stabilisation = "pid" corrects them'


def diagnose(at: PlanIntegration, *, collapsed: bool) -> str:
    """Say when, where and why the integrator could not go on, and what to try.

    ``collapsed``: whether the step size has collapsed (otherwise there were too many steps).
    """
    count, h = at.state.count, float(at.state.clock[NEXT_STEP])
    if collapsed:
        what = f"the step size has fallen to {h:.1g} s"
    else:
        what = f"{count[ACCEPTED] + count[REJECTED]} steps have been taken, the last of {h:.1g} s"
    head = f"the flight cannot go on at t = {at.t:.3f} s, in phase '{at.plan.phase.name}': {what}"
    if not len(at.plan.edges):
        return f"{head}. {_remedy(at, collapsed=collapsed)}"
    if at.solver is not None:
        lost, failed = at.solver.counts.fallbacks, at.solver.counts.failures
        return (
            f"{head}; the multipliers are solved by {solvers.METHOD_WORDS[at.plan.method]}, which lost a pivot"
            f" {lost} times and found no solution {failed} times. {_remedy(at, collapsed=collapsed)}"
        )
    J, closest, length = _jacobian_and_shortest_edge(at)
    edge = "-".join(str(int(a) + 1) for a in at.plan.edges[closest])
    if not np.isfinite(J).all():
        return (
            f"{head}, because agents {edge.replace('-', ' and ')} are at the same place: the edge"
            f" {edge} between them is {length:.2g} m long, so its force has no direction, and the"
            " constraint Jacobian J has no defined singular values. Keep their paths from crossing:"
            " exchange their slots, or start them elsewhere"
        )
    values = np.linalg.svd(J, compute_uv=False)
    where = (
        f"the smallest of the {len(values)} singular values of the constraint Jacobian J is"
        f" {values[-1]:.2g} (the largest is {values[0]:.2g}; the shortest edge, {edge}, is"
        f" {length:.3g} m)"
    )
    solver = at.plan.constraint.solver
    if solver in ("exact", "pinv"):
        bound = "no bound" if solver == "exact" else "no bound except its cut-off"
        return (
            f'{head}, and {where}. The force of solver "{solver}" has {bound} where a singular value'
            f' vanishes. Use solver = "iterated" (or "spectral"){_unbounded_law_advice(at.plan)}'
        )
    return f"{head}, and {where}. {_remedy(at, collapsed=collapsed)}"


def _unbounded_law_advice(plan: PhasePlan) -> str:
    """What else helps a law without bound: a smooth reference, feedback; "" if it has both."""
    words = ""
    shaping = plan.phase.shaping
    if shaping is not None and shaping.reference == "step":
        smooth = "shape" if plan.knows_slots else "distances"
        words += f', and a smooth reference: reference = "{smooth}"'
    if plan.constraint.stabilisation == "none":
        words += _FEEDBACK
    return words


def _remedy(at: PlanIntegration, *, collapsed: bool) -> str:
    """What to try if J is not the cause."""
    beyond = at.t + 1e-9 * max(1.0, at.t)  # a jump at at.t shows only after it
    native.closed_loop(beyond, at.state.y, np.empty_like(at.state.y), at.plan.problem, at.workspace)
    w = at.workspace
    names = {"input force": w.f_u, "constraint force": w.f_C, "external force": w.f_E}
    lost = [name for name, f in names.items() if not np.isfinite(f).all()]
    if "external force" in lost and at.external is not None:
        bad = np.flatnonzero(~np.isfinite(w.f_E).all(axis=1))
        return f"Your own force is not finite on agent {bad[0] + 1}: correct its function"
    if lost:
        return f"The {lost[0]} is not finite. Look for a gain, a distance or a mass that is far too large"
    if at.plan.constraint.stabilisation == "none" and np.abs(w.c).max(initial=0.0) > 1e-3:
        k = int(np.abs(w.c).argmax())
        i, j = at.plan.edges[k] + 1
        return f"The distance {i}-{j} is {w.c[k]:+.3g} m off{_FEEDBACK}"
    name, f = max(names.items(), key=lambda item: float(np.abs(item[1]).max()))
    agent = int(np.abs(f).max(axis=1).argmax())
    size = math.hypot(*f[agent])  # no square of it overflows
    if collapsed:
        return (
            f"The greatest force is the {name} on agent {agent + 1}, {size:.3g} N. Look for a cause of"
            " jumps: your own force, or a mass, gain or distance that is far too large or too small."
            " Look also for tolerances near 1e-15"
        )
    return (
        f"The greatest force is the {name} on agent {agent + 1}, {size:.3g} N. Steps this short"
        " come from gains (constraint, tracking, lqr) far above 1e3 /s, from a damping far below"
        " 1e-6, or from tolerances that are too tight (integrator.rtol, atol): relax them."
        " Otherwise the phase is too long"
    )


def _jacobian_and_shortest_edge(at: PlanIntegration) -> tuple[Floats, int, float]:
    """J (m, 3N) at the integrator's state, the shortest edge and its length [m]."""
    edges = at.plan.edges
    native.closed_loop(at.t, at.state.y, np.empty_like(at.state.y), at.plan.problem, at.workspace)
    r = at.workspace.r
    lengths = np.linalg.norm(r[edges[:, 0]] - r[edges[:, 1]], axis=1)
    closest = int(lengths.argmin())
    return jacobian(r, edges), closest, float(lengths[closest])
