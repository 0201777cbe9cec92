"""The multiplier solve of large formations: its sequence of steps, and the fallback if a step fails.

The kernel calls a `LargeSolver` through C functions (`Graph.solver`), like a user's force. A call costs some 20 us,
and the solve of a formation this large takes much longer. Memory and work grow with the number of edges.
"""

from __future__ import annotations

import ctypes
import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from rigidfleet.kernel.engine.native import call_large
from rigidfleet.kernel.large.ordering import symbolic_factorisation
from rigidfleet.kernel.problem import ITERATED, ConstraintLaw, Vehicles, Workspace, workspace
from rigidfleet.kernel.records import LOST_PIVOT, Order, Pattern
from rigidfleet.typing import Edges, Floats, Ints

#: A stored factor is renewed when the iterations in excess of a new factor's have taken as long as making one. It is
#: also renewed when a single solve needs more than the first number of iterations and, without fill, more than the
#: second number times as many as at first.
_RENEW, _STALE = 12, 1.5
#: Greatest number of iterations; beyond it, the evaluation fails, and the integrator tries a shorter step.
_MOST = 1000
#: Greatest fill of the factor, in blocks per agent. Shells and sheets stay below it; thick lattices do not.
_FILL = 80.0
#: Number of past solutions whose best combination starts each solve.
_PAST = 4
#: Damping of the exact law on the vertex graph, with two iterations: the result deviates by (mu/w)^2.
_EXACT_MU = 1e-8


@dataclass
class Counts:
    """Counts of the solves of a flight."""

    evaluations: int = 0
    solves: int = 0  # systems solved on the vertex graph
    iterations: int = 0  # of conjugate gradients, in all
    factors: int = 0
    fallbacks: int = 0  # evaluations in which elimination lost a pivot
    failures: int = 0  # evaluations without a solution

    def add(self, other: Counts) -> None:
        """Add those of another phase."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)


class Setup(NamedTuple):
    """How a `LargeSolver` solves: what all solvers of the same equations share."""

    elimination: Order | None
    #: Asked for the order (N,) in which the sparse factor eliminates agents, if it is needed.
    order: Callable[[], Ints]
    tolerance: float  # relative residual of conjugate gradients
    floor: float = 0.0  # error of an acceleration that the damped law may always have [m/s^2]
    axes: bool = False  # whether the kernel has computed the mean axes when it asks for a solution


@dataclass
class LargeSolver:
    """Multipliers of one phase, Eq. (12), into its workspace.

    Elimination finds the constraint force first, and the multipliers when they are asked for (`Graph.multipliers`).
    """

    vehicles: Vehicles
    edges: Edges
    law: ConstraintLaw
    workspace: Workspace
    setup: Setup
    counts: Counts = field(default_factory=Counts)
    error: BaseException | None = None

    def __post_init__(self) -> None:
        vehicles, law = self.vehicles, self.law
        n = len(vehicles.m)
        self.mbar = vehicles.mean
        iterated = law.solver == ITERATED
        self.mu, self.iterations = (law.mu, law.iterations) if iterated else (_EXACT_MU, 2)
        self.a, self.rest = np.zeros((n, 3)), np.zeros(len(self.edges))
        self.least = self.mu * self.mbar * self.setup.floor * math.sqrt(n)
        # Not needed as long as elimination succeeds
        self.pattern: Pattern | None = None
        self.pulled = True  # whether the workspace has the multipliers of the last evaluation
        computed = LargeSolver.solve, LargeSolver.find_multipliers
        self._calls = [_c_callback(self, compute) for compute in computed]
        self.address, self.multipliers = (
            int(ctypes.cast(call, ctypes.c_void_p).value or 0) for call in self._calls
        )
        if self.setup.elimination is None:
            self.multipliers = 0

    def try_to(self, compute: Callable[[LargeSolver], None]) -> None:
        """Compute for the kernel: an exception cannot pass through compiled code, so the forces become NaN."""
        try:
            if self.error is None:
                compute(self)
                return
        except BaseException as error:
            self.error = error
        self._fill_results_with_nan()

    def _fill_results_with_nan(self) -> None:
        self.workspace.multiplier[:] = self.workspace.f_C[:] = math.nan
        self.pulled = True

    @cached_property
    def thread_solver(self) -> LargeSolver:
        """Another solver of the same equations, in a workspace of its own, for another thread."""
        with_h = self.workspace.H.size > 0
        own = workspace(len(self.a), len(self.edges), with_h=with_h, large=True)
        return replace(self, workspace=own, counts=Counts(), error=None)

    def raise_pending_error(self) -> None:
        """Raise an error that occurred in a call from the kernel."""
        error, self.error = self.error, None
        if error is not None:
            raise error

    def solve(self) -> None:
        """Solve for the forces or multipliers of ``workspace.b``; NaN if there is no solution."""
        w, vehicles, order = self.workspace, self.vehicles, self.setup.elimination
        self.counts.evaluations += 1
        if order is not None:
            pivot = call_large(
                "solve", w.u, w.b, w.r, vehicles.m, vehicles.M, order, self.setup.axes, w.cm[0], w.I, w.I_inv, self.a,
                w.f_C,
            )  # fmt: skip
            self.pulled = not pivot > LOST_PIVOT
            if not self.pulled:
                return
            self.counts.fallbacks += 1
        if not np.isfinite(w.b).all() or not self._iterate_at_agents():
            self.counts.failures += 1
            self._fill_results_with_nan()
        elif order is not None:
            w.f_C[:] = 0.0
            call_large("add_Jt_product", w.u, self.edges, w.multiplier, 1.0, w.f_C)

    def find_multipliers(self) -> None:
        """Find the multipliers of the last evaluation, if elimination has not found them yet."""
        if not self.pulled:
            self.pulled = True
            w, order = self.workspace, self.setup.elimination
            self.a[:] = w.f_C
            call_large("multipliers", w.u, order, self.a, w.multiplier)

    def _iterate_at_agents(self) -> bool:
        """Iterated Tikhonov in the agents' coordinates, see `constraint.solve_at_agents`.

        The exact law uses the same solve with almost no damping. Its multipliers would be differences of large
        numbers, so they are found from J^T lambda = M a in the same way.
        """
        w, edges, m = self.workspace, self.edges, self.vehicles.m
        if self.pattern is None:
            self._prepare_factor()
        # The rotation of the formation since the factor was made.
        self.now = _axes_of_triangle(self.workspace.r[self.marks])
        self.turned = np.eye(3) if self.axes is None else self.now.T @ self.axes
        self.rest[:] = w.b
        y, a = w.multiplier, self.a
        y[:], a[:] = 0.0, 0.0
        iterated = self.law.solver == ITERATED
        for k in range(self.iterations):
            self.g[:] = 0.0
            call_large("add_Jt_product", w.u, edges, self.rest, self.mbar, self.g)
            x = self._solve_system(k)
            if x is None:
                return False
            call_large("add_J_product", w.u, edges, x, -1.0, self.rest)
            if iterated:
                y += (self.mbar / self.mu) * self.rest
            else:
                a += x
        for k in range(0 if iterated else self.iterations):
            self.g[:] = m[:, None] * a
            call_large("add_Jt_product", w.u, edges, y, -1.0, self.g)
            x = self._solve_system(self.iterations + k)
            if x is None:
                return False
            call_large("add_J_product", w.u, edges, x, self.mbar, y)
        return True

    def _prepare_factor(self) -> None:
        n, edges = len(self.a), self.edges
        self.pattern = symbolic_factorisation(n, edges, self.setup.order(), _FILL)
        self.L, self.place = np.zeros((len(self.pattern.row), 9)), np.empty(n, dtype=np.int64)
        # Seven digits are enough for preconditioning, unless the damping of the rigid motions is tiny.
        self.kept = self.L.astype(np.float32) if self.mu > _EXACT_MU else self.L
        systems = self.iterations * (1 if self.law.solver == ITERATED else 2)
        self.past, self.taken = np.zeros((systems, _PAST, n, 3)), np.zeros(systems, dtype=int)
        self.x, self.g, self.work = np.zeros((n, 3)), np.zeros((n, 3)), np.empty((5, n, 3))
        self.gram = np.empty((_PAST, _PAST + 2))
        self.marks = _three_far_agents(self.workspace.r)
        # Cost of a factor in iterations.
        count = np.diff(self.pattern.column).astype(float)
        self.worth = 0.75 * float((count**2).sum() / count.sum())
        self.fresh, self.wasted = 0, 0.0  # iterations with a new factor, and the excess since
        # Axes of the marker agents when the factor was made; None: no factor
        self.axes: Floats | None = None

    def _solve_system(self, number: int) -> Floats | None:
        """The solution x (N, 3) of K x = g for the given system of an evaluation; None if there is none.

        Uses the stored factor, or a new one if it has become stale, and starts from past solutions of this system.
        """
        w, x, past = self.workspace, self.x, self.past[number]
        # A residual r causes an error r/mu of the force.
        within = max(
            self.setup.tolerance * math.sqrt(call_large("inner", self.g, self.g)), self.least
        )
        self.counts.solves += 1
        m, mbar, mu = self.vehicles.m, self.mbar, self.mu
        call_large(
            "project_on_past_solutions", w.u, self.edges, m, mbar, mu, self.g, past, self.gram, x
        )
        while True:
            new = self.axes is None or self.wasted > self.worth
            if new:
                self._renew_factor()
            most = _MOST if new else 4 * max(_RENEW, self.fresh)
            taken = self._conjugate_gradients(x, within, most)
            if new:
                self.fresh, self.wasted = max(taken, 1), 0.0
            elif taken > max(_RENEW, _STALE * self.fresh):
                self.wasted = math.inf
            else:
                self.wasted += taken - self.fresh
            if taken <= most and np.isfinite(x).all():
                past[self.taken[number] % _PAST] = x
                self.taken[number] += 1
                return x
            if new:
                past[:] = 0.0
                return None
            if taken > _MOST or not np.isfinite(x).all():
                x[:] = 0.0

    def _conjugate_gradients(self, x: Floats, within: float, most: int) -> int:
        w, p, m = self.workspace, self.pattern, self.vehicles.m
        assert p is not None
        digits = "" if self.kept is self.L else "_single"
        taken = call_large(
            f"conjugate_gradients{digits}", w.u, self.edges, m, self.mbar, self.mu, self.turned, p.place, p.column,
            p.row, self.kept, self.g, x, within, most, self.work,
        )  # fmt: skip
        self.counts.iterations += min(int(taken), most)
        return int(taken)

    def _renew_factor(self) -> None:
        """Factor K at the current shape, with more damping if a factor without fill needs it."""
        w, p, m = self.workspace, self.pattern, self.vehicles.m
        assert p is not None
        self.counts.factors += 1
        self.axes, self.turned = self.now, np.eye(3)
        mu = self.mu
        for _ in range(12):
            call_large(
                "assemble", w.u, self.edges, m, self.mbar, mu, p.place, p.column, p.of_edge, self.L
            )
            if call_large("factor", p.column, p.row, p.first, p.left, p.block, self.L, self.place):
                self.kept[:] = self.L
                return
            mu = max(10.0 * mu, 1e-3)


def _c_callback(solver: LargeSolver, compute: Callable[[LargeSolver], None]) -> Any:
    """A C function that has a solver compute. It does not keep it alive, so that nothing but its users does."""
    reference = weakref.ref(solver)

    def call() -> None:
        if (alive := reference()) is not None:
            alive.try_to(compute)

    return ctypes.CFUNCTYPE(None)(call)


def _three_far_agents(r: Floats) -> Ints:
    """Three agents (3,) far from each other and from a common line; they show how the formation has rotated."""
    i = int(((r - r.mean(axis=0)) ** 2).sum(axis=1).argmax())
    j = int(((r - r[i]) ** 2).sum(axis=1).argmax())
    k = int((np.cross(r - r[i], r[j] - r[i]) ** 2).sum(axis=1).argmax())
    return np.array([i, j, k])


def _axes_of_triangle(r: Floats) -> Floats:
    """Rows of a rotation (3, 3) attached to three points r (3, 3); the identity if they are on a line."""
    x = r[1] - r[0]
    z = np.cross(x, r[2] - r[0])
    size, area = math.hypot(*x), math.hypot(*z)
    if not area > 1e-9 * size * size:
        return np.eye(3)
    x, z = x / size, z / area
    return np.array([x, np.cross(z, x), z])
