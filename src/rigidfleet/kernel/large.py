"""The multiplier solve of large formations: which step of it when, and what to do where one fails.

The kernel calls a `LargeSolver` through a C function (`Graph.solver`), as it does a user's force: that costs some
20 us, and formations this large take much longer. Memory and work grow with the number of edges.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rigidfleet.kernel import sparse, tree
from rigidfleet.kernel.program import ITERATED, Array, Law, Vehicles, Workspace

Ints = NDArray[np.int64]
Edges = NDArray[np.uint32]

#: A kept factor is renewed when the iterations beyond those of a new one have taken as long as making one; or when a
#: single solve needs more than this many, and, without fill, so many times as many as at first.
_RENEW, _STALE = 12, 1.5
#: Iterations at most: beyond, the evaluation fails, and the integrator tries a shorter step.
_MOST = 1000
#: Fill of the factor, in blocks an agent, at most. Shells and sheets stay below, thick lattices do not.
_FILL = 80.0
#: Damping with which the exact law is solved on the vertex graph, twice over: it deviates by (mu/w)^2.
_EXACT_MU = 1e-8


@dataclass
class Counts:
    """What the solves of a flight took."""

    evaluations: int = 0
    solves: int = 0  # systems solved on the vertex graph
    iterations: int = 0  # of conjugate gradients, in all
    factors: int = 0
    fallbacks: int = 0  # evaluations in which the sweep lost a pivot
    failures: int = 0  # evaluations without a solution

    def add(self, other: Counts) -> None:
        """Add those of another phase."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)


@dataclass
class LargeSolver:
    """Multipliers of one phase, into its workspace.

    ``steps`` (N, 4) is the order of the sweep, None without one; ``order`` asks for that of elimination (N,), where it
    is needed; ``tolerance`` is the relative residual of conjugate gradients, and ``floor`` the error of an
    acceleration [m/s^2] below which none is asked of the damped law.
    """

    vehicles: Vehicles
    edges: Edges
    law: Law
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
        self.mbar = vehicles.M / n
        iterated = law.solver == ITERATED
        self.mu, self.iterations = (law.mu, law.iterations) if iterated else (_EXACT_MU, 2)
        self.a, self.f, self.small = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((10, 3))
        self.least = self.mu * self.mbar * self.floor * math.sqrt(n)
        self.rest = np.zeros(len(self.edges))
        self.pattern: sparse.Pattern | None = None  # where the sweep does, it is never needed
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

    def check(self) -> None:
        """Raise what has come up within the kernel."""
        error, self.error = self.error, None
        if error is not None:
            raise error

    def solve(self) -> None:
        """Multipliers for ``workspace.b``; NaN where there is no solution."""
        w, vehicles = self.workspace, self.vehicles
        edges = self.edges
        if self.steps is not None:
            pivot = tree.particular(w.u, w.b, edges, self.steps, self.a)
            if pivot > tree.LOST:
                tree.balance(w.r, vehicles.m, vehicles.M, self.a, self.small)
                tree.multipliers(w.u, edges, self.steps, vehicles.m, self.a, self.f, w.multiplier)
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
        self.rest[:] = w.b
        y, a = w.multiplier, self.a
        y[:], a[:] = 0.0, 0.0
        iterated = self.law.solver == ITERATED
        for k in range(self.iterations):
            self.g[:] = 0.0
            sparse.pull(w.u, edges, self.rest, self.mbar, self.g)
            if not self._system(self.x[k]):
                return False
            sparse.stretch(w.u, edges, self.x[k], -1.0, self.rest)
            if iterated:
                y += (self.mbar / self.mu) * self.rest
            else:
                a += self.x[k]
        if iterated:
            return True
        for k in range(self.iterations):
            self.g[:] = m[:, None] * a
            sparse.pull(w.u, edges, y, -1.0, self.g)
            if not self._system(self.x[self.iterations + k]):
                return False
            sparse.stretch(w.u, edges, self.x[self.iterations + k], self.mbar, y)
        return True

    def _prepare(self) -> None:
        n, edges = len(self.a), self.edges
        self.pattern = sparse.pattern(n, edges, self.order(), _FILL)
        self.L, self.place = np.zeros((len(self.pattern.row), 9)), np.empty(n, dtype=np.int64)
        # To precondition, seven digits do, unless next to nothing is added to the rigid motions.
        self.kept = self.L.astype(np.float32) if self.mu > _EXACT_MU else self.L
        # Solutions are kept: the next evaluation starts from them.
        self.x = np.zeros((self.iterations * (1 if self.law.solver == ITERATED else 2), n, 3))
        self.g, self.work = np.zeros((n, 3)), np.empty((5, n, 3))
        self.marks = _far_apart(self.workspace.r)
        # A factor takes as long as so many iterations.
        count = np.diff(self.pattern.column).astype(float)
        self.worth = 0.75 * float((count**2).sum() / count.sum())
        self.fresh, self.wasted = 0, 0.0  # iterations that a new factor needs, and those beyond
        self.axes: Array | None = None  # of the marks when the factor was made; None: no factor

    def _system(self, x: Array) -> bool:
        """Solve K x = g from x on, with the kept factor, or with a new one if that has become stale."""
        # A residual r is an error r/mu of the force.
        within = max(self.tolerance * math.sqrt(sparse.inner(self.g, self.g)), self.least)
        self.counts.solves += 1
        while True:
            new = self.axes is None or self.wasted > self.worth
            if new:
                self._renew()
            taken = self._gradients(x, within, _MOST if new else 4 * max(_RENEW, self.fresh))
            if new:
                self.fresh, self.wasted = max(taken, 1), 0.0
            elif taken > max(_RENEW, _STALE * self.fresh):
                self.wasted = math.inf
            else:
                self.wasted += taken - self.fresh
            if taken <= _MOST and np.isfinite(x).all():
                if new or taken <= 4 * max(_RENEW, self.fresh):
                    return True
            else:
                x[:] = 0.0
            if new:
                return False

    def _gradients(self, x: Array, within: float, most: int) -> int:
        w, p, m = self.workspace, self.pattern, self.vehicles.m
        assert p is not None
        assert self.axes is not None
        turned = _axes(self.workspace.r[self.marks]).T @ self.axes
        taken = sparse.conjugate_gradients(
            w.u, self.edges, m, self.mbar, self.mu, turned, p.place, p.column, p.row,
            self.kept, self.g, x, within, most, self.work,
        )  # fmt: skip
        self.counts.iterations += min(taken, most)
        return taken

    def _renew(self) -> None:
        """Factor K at the current shape, with more damping where a factor without fill needs it."""
        w, p, m = self.workspace, self.pattern, self.vehicles.m
        assert p is not None
        self.counts.factors += 1
        self.axes = _axes(self.workspace.r[self.marks])
        mu = self.mu
        for _ in range(12):
            sparse.assemble(
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
            if sparse.factor(p.column, p.row, p.first, p.left, p.block, self.L, self.place):
                self.kept[:] = self.L
                return
            mu = max(10.0 * mu, 1e-3)


def _far_apart(r: Array) -> Ints:
    """Three agents (3,) far from each other and from one line: they tell how the formation has turned."""
    i = int(((r - r.mean(axis=0)) ** 2).sum(axis=1).argmax())
    j = int(((r - r[i]) ** 2).sum(axis=1).argmax())
    k = int((np.cross(r - r[i], r[j] - r[i]) ** 2).sum(axis=1).argmax())
    return np.array([i, j, k])


def _axes(points: Array) -> Array:
    """Rows of a rotation (3, 3) that goes with three points (3, 3); the identity on a line."""
    x = points[1] - points[0]
    z = np.cross(x, points[2] - points[0])
    size, area = np.linalg.norm(x), np.linalg.norm(z)
    if not area > 1e-9 * size * size:
        return np.eye(3)
    x, z = x / size, z / area
    return np.ascontiguousarray([x, np.cross(z, x), z])
