"""The multiplier solve of large formations: which step of it when, and what to do where one fails.

The kernel calls a `LargeSolver` through a C function (`Graph.solver`), as it does a user's force: that costs some
20 us, and formations this large take much longer. Memory and work grow with the number of edges.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from rigidfleet.kernel.large import block_cholesky, elimination
from rigidfleet.kernel.problem import ITERATED, ConstraintLaw, Vehicles, Workspace
from rigidfleet.typing import Edges, Floats, Ints

#: A kept factor is renewed when the iterations beyond those of a new one have taken as long as making one; or when a
#: single solve needs more than this many, and, without fill, so many times as many as at first.
_RENEW, _STALE = 12, 1.5
#: Iterations at most: beyond, the evaluation fails, and the integrator tries a shorter step.
_MOST = 1000
#: Fill of the factor, in blocks an agent, at most. Shells and sheets stay below, thick lattices do not.
_FILL = 80.0
#: Each solve starts from the best combination of the solutions of so many evaluations before.
_PAST = 4
#: Damping with which the exact law is solved on the vertex graph, twice over: it deviates by (mu/w)^2.
_EXACT_MU = 1e-8


@dataclass
class Counts:
    """What the solves of a flight took."""

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


@dataclass
class LargeSolver:
    """Multipliers of one phase, Eq. (12), into its workspace.

    ``steps`` (N, 4) are those of elimination, None where there are none; ``order`` asks for the order (N,) in which
    the sparse factor takes agents, where it is needed; ``tolerance`` is the relative residual of conjugate
    gradients, and ``floor`` the error of an acceleration [m/s^2] below which none is asked of the damped law.
    """

    vehicles: Vehicles
    edges: Edges
    law: ConstraintLaw
    workspace: Workspace
    steps: Ints | None
    order: Callable[[], Ints]
    tolerance: float
    floor: float = 0.0
    counts: Counts = field(default_factory=Counts)
    error: BaseException | None = None

    def __post_init__(self) -> None:
        vehicles, law = self.vehicles, self.law
        n = len(vehicles.m)
        self.mbar = vehicles.mean
        iterated = law.solver == ITERATED
        self.mu, self.iterations = (law.mu, law.iterations) if iterated else (_EXACT_MU, 2)
        self.a, self.rest = np.zeros((n, 3)), np.zeros(len(self.edges))
        self.least = self.mu * self.mbar * self.floor * math.sqrt(n)
        self.elimination = None if self.steps is None else elimination.order(self.steps, self.edges)
        self.pattern: block_cholesky.Pattern | None = (
            None  # where elimination does, it is never needed
        )
        # An exception cannot pass through compiled code; the multipliers become NaN instead.
        self._call = ctypes.CFUNCTYPE(None)(self._solve)
        self.address = int(ctypes.cast(self._call, ctypes.c_void_p).value or 0)

    def _solve(self) -> None:
        self.workspace.multiplier[:] = math.nan
        try:
            if self.error is None:
                self.counts.evaluations += 1
                self.solve()
        except BaseException as error:
            self.error = error

    @cached_property
    def aside(self) -> LargeSolver:
        """Another one of the same equations, in the same workspace: what it is asked, this one does not remember."""
        return replace(self, counts=Counts(), error=None)

    def check(self) -> None:
        """Raise what has come up within the kernel."""
        error, self.error = self.error, None
        if error is not None:
            raise error

    def solve(self) -> None:
        """Multipliers for ``workspace.b``; NaN where there is no solution."""
        w, vehicles = self.workspace, self.vehicles
        if self.elimination is not None:
            # Where deformation is damped, the kernel knows the mean axes already.
            known = self.law.k_def > 0.0
            pivot = elimination.solve(
                w.u, w.b, w.r, vehicles.m, vehicles.M, self.elimination, known, w.cm[0], w.I, w.I_inv, self.a,
                w.multiplier,
            )  # fmt: skip
            if pivot > elimination.LOST:
                return
            self.counts.fallbacks += 1
        if not np.isfinite(w.b).all() or not self._on_vertex_graph():
            self.counts.failures += 1
            w.multiplier[:] = math.nan

    def _on_vertex_graph(self) -> bool:
        """Iterated Tikhonov in the agents' coordinates, see `constraint.solve_at_agents`.

        The exact law is that with next to no damping. Its multipliers would be differences of large
        numbers; they are found from J^T lambda = M a in the same way.
        """
        w, edges, m = self.workspace, self.edges, self.vehicles.m
        if self.pattern is None:
            self._prepare()
        self._turn()
        self.rest[:] = w.b
        y, a = w.multiplier, self.a
        y[:], a[:] = 0.0, 0.0
        iterated = self.law.solver == ITERATED
        for k in range(self.iterations):
            self.g[:] = 0.0
            block_cholesky.apply_Jt(w.u, edges, self.rest, self.mbar, self.g)
            x = self._system(k)
            if x is None:
                return False
            block_cholesky.apply_J(w.u, edges, x, -1.0, self.rest)
            if iterated:
                y += (self.mbar / self.mu) * self.rest
            else:
                a += x
        for k in range(0 if iterated else self.iterations):
            self.g[:] = m[:, None] * a
            block_cholesky.apply_Jt(w.u, edges, y, -1.0, self.g)
            x = self._system(self.iterations + k)
            if x is None:
                return False
            block_cholesky.apply_J(w.u, edges, x, self.mbar, y)
        return True

    def _prepare(self) -> None:
        n, edges = len(self.a), self.edges
        self.pattern = block_cholesky.pattern(n, edges, self.order(), _FILL)
        self.L, self.place = np.zeros((len(self.pattern.row), 9)), np.empty(n, dtype=np.int64)
        # To precondition, seven digits do, unless next to nothing is added to the rigid motions.
        self.kept = self.L.astype(np.float32) if self.mu > _EXACT_MU else self.L
        systems = self.iterations * (1 if self.law.solver == ITERATED else 2)
        self.past, self.taken = np.zeros((systems, _PAST, n, 3)), np.zeros(systems, dtype=int)
        self.x, self.g, self.work = np.zeros((n, 3)), np.zeros((n, 3)), np.empty((5, n, 3))
        self.gram = np.empty((_PAST, _PAST + 2))
        self.marks = _far_apart(self.workspace.r)
        # A factor takes as long as so many iterations.
        count = np.diff(self.pattern.column).astype(float)
        self.worth = 0.75 * float((count**2).sum() / count.sum())
        self.fresh, self.wasted = 0, 0.0  # iterations that a new factor needs, and those beyond
        self.axes: Floats | None = None  # of the marks when the factor was made; None: no factor

    def _system(self, number: int) -> Floats | None:
        """The solution x (N, 3) of K x = g, that system of an evaluation; None where there is none.

        By the kept factor, or by a new one if that has become stale, from past solutions of that system on.
        """
        w, x, past = self.workspace, self.x, self.past[number]
        # A residual r is an error r/mu of the force.
        within = max(self.tolerance * math.sqrt(block_cholesky.inner(self.g, self.g)), self.least)
        self.counts.solves += 1
        block_cholesky.project(
            w.u, self.edges, self.vehicles.m, self.mbar, self.mu, self.g, past, self.gram, x
        )
        while True:
            new = self.axes is None or self.wasted > self.worth
            if new:
                self._renew()
            most = _MOST if new else 4 * max(_RENEW, self.fresh)
            taken = self._gradients(x, within, most)
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

    def _gradients(self, x: Floats, within: float, most: int) -> int:
        w, p, m = self.workspace, self.pattern, self.vehicles.m
        assert p is not None
        taken = block_cholesky.conjugate_gradients(
            w.u, self.edges, m, self.mbar, self.mu, self.turned, p.place, p.column, p.row,
            self.kept, self.g, x, within, most, self.work,
        )  # fmt: skip
        self.counts.iterations += min(taken, most)
        return taken

    def _turn(self) -> None:
        """Find out how the formation has turned since the factor was made."""
        self.now = _axes(*self.workspace.r[self.marks].tolist())
        self.turned = np.eye(3) if self.axes is None else self.now.T @ self.axes

    def _renew(self) -> None:
        """Factor K at the current shape, with more damping where a factor without fill needs it."""
        w, p, m = self.workspace, self.pattern, self.vehicles.m
        assert p is not None
        self.counts.factors += 1
        self.axes, self.turned = self.now, np.eye(3)
        mu = self.mu
        for _ in range(12):
            block_cholesky.assemble(
                w.u,
                self.edges,
                m,
                self.mbar,
                mu,
                p.place,
                p.column,
                p.of_edge,
                self.L,
            )
            if block_cholesky.factor(p.column, p.row, p.first, p.left, p.block, self.L, self.place):
                self.kept[:] = self.L
                return
            mu = max(10.0 * mu, 1e-3)


def _far_apart(r: Floats) -> Ints:
    """Three agents (3,) far from each other and from one line: they tell how the formation has turned."""
    i = int(((r - r.mean(axis=0)) ** 2).sum(axis=1).argmax())
    j = int(((r - r[i]) ** 2).sum(axis=1).argmax())
    k = int((np.cross(r - r[i], r[j] - r[i]) ** 2).sum(axis=1).argmax())
    return np.array([i, j, k])


def _axes(a: list[float], b: list[float], c: list[float]) -> Floats:
    """Rows of a rotation (3, 3) that goes with three points; the identity on a line."""
    x = [q - p for p, q in zip(a, b, strict=True)]
    z = _cross(x, [q - p for p, q in zip(a, c, strict=True)])
    size, area = math.hypot(*x), math.hypot(*z)
    if not area > 1e-9 * size * size:
        return np.eye(3)
    x, z = [q / size for q in x], [q / area for q in z]
    return np.array([x, _cross(z, x), z])


def _cross(a: list[float], b: list[float]) -> list[float]:
    """a x b, in a twentieth of the time that NumPy takes for three numbers."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
