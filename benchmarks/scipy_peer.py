"""The same flights as users of NumPy and SciPy would program them: the peers to beat.

`Literal` writes the paper's equations as they stand, with J and M as matrices. `Peer` is tuned by
hand: with the incidence matrix B (+1 and -1 in each row) all edges are B r, the paper's
J M^-1 J^T is (B M^-1 B^T) * (u u^T), and J^T lambda is B^T (lambda u). Neither loops in Python.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]
#: Desired distances d (m,) [m] at a time [s], and their first two derivatives.
Reference = Callable[[float], tuple[Array, Array, Array]]


@dataclass
class Peer:
    """A flight by constraint forces and a constant input."""

    r0: Array  # (N, 3) start [m], at rest
    m: Array  # (N,) masses [kg]
    B: Array  # (edges, N) incidence matrix
    gains: tuple[float, float, float]  # alpha, beta, gamma
    reference: Reference
    f: Array  # (N, 3) input and gravity [N]
    mu: float  # damping of the iterated solve; 0: the paper's plain inverse
    iterations: int
    k_def: float  # deformation damping [1/s]

    def __post_init__(self) -> None:
        self.weights = (self.m / self.m.sum())[:, None]
        self.mass_column = self.m[:, None]
        self.G = (self.B / self.m) @ self.B.T  # B M^-1 B^T
        self.mbar = self.m.mean()
        self.eye = np.eye(len(self.B))
        self.start = np.concatenate([self.r0.ravel(), np.zeros(self.r0.size + len(self.B))])

    def __call__(self, t: float, y: Array) -> Array:
        """Right-hand side of the closed loop."""
        n = self.r0.size
        r, v, integral = y[:n].reshape(-1, 3), y[n : 2 * n].reshape(-1, 3), y[2 * n :]
        f = self.f
        if self.k_def:
            f = f - self.k_def * self.mass_column * self._deforming(r, v)
        edge, dv = self.B @ r, self.B @ v
        L = np.sqrt((edge * edge).sum(axis=1))
        u = edge / L[:, None]
        along = (u * dv).sum(axis=1)
        d, d_dot, d_ddot = self.reference(t)
        c = L - d
        alpha, beta, gamma = self.gains
        b = (
            d_ddot
            - ((dv * dv).sum(axis=1) - along * along) / L
            - (u * (self.B @ (f / self.mass_column))).sum(axis=1)
            - 2 * alpha * (along - d_dot)
            - beta**2 * c
            - gamma * integral
        )
        A = self.G * (u @ u.T)
        multiplier = self._iterated(A, b) if self.mu else np.linalg.solve(A, b)
        a = (f + self.B.T @ (multiplier[:, None] * u)) / self.mass_column
        return np.concatenate([v.ravel(), a.ravel(), c])

    def _iterated(self, A: Array, b: Array) -> Array:
        """k solves of (mbar A + mu) x_new = mbar b + mu x, by one inverse as m is small."""
        inverse = np.linalg.inv(self.mbar * A + self.mu * self.eye)
        x = b = self.mbar * (inverse @ b)
        for _ in range(self.iterations - 1):
            x = b + self.mu * (inverse @ x)
        return x

    def _deforming(self, r: Array, v: Array) -> Array:
        """Velocities (N, 3) beyond those of a rigid body."""
        x, y = r - (self.weights * r).sum(axis=0), v - (self.weights * v).sum(axis=0)
        mx = self.mass_column * x
        S = mx.T @ x
        h = np.cross(mx, y).sum(axis=0)
        omega = np.linalg.solve(np.trace(S) * np.eye(3) - S, h)
        return y - np.cross(omega, x)

    def fly(self, times: Array, rtol: float, atol: float | None = None) -> Array:
        """States (K, n) at ``times`` (K,) [s]; ``atol`` is ``rtol`` unless given."""
        atol = rtol if atol is None else atol
        flight = solve_ivp(self, (0.0, times[-1]), self.start, "RK45", times, rtol=rtol, atol=atol)
        return flight.y.T


@dataclass
class Literal(Peer):
    """The paper's equations as they stand: J (m, 3N), M^-1 (3N, 3N), A = J M^-1 J^T."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.i, self.j = self.B.argmax(axis=1), self.B.argmin(axis=1)
        self.M_inv = np.diag(np.repeat(1.0 / self.m, 3))

    def __call__(self, t: float, y: Array) -> Array:
        """Right-hand side of the closed loop."""
        N, edges = len(self.m), np.arange(len(self.i))
        r, v = y[: 3 * N].reshape(N, 3), y[3 * N : 6 * N].reshape(N, 3)
        integral = y[6 * N :]
        f_E = self.f
        if self.k_def:
            f_E = f_E - self.k_def * self.m[:, None] * self._deforming(r, v)
        difference, rate = r[self.i] - r[self.j], v[self.i] - v[self.j]
        L = np.linalg.norm(difference, axis=1)
        u = difference / L[:, None]
        J = np.zeros((len(edges), N, 3))
        J[edges, self.i], J[edges, self.j] = u, -u
        J = J.reshape(len(edges), 3 * N)
        d, d_dot, d_ddot = self.reference(t)
        c, c_dot = L - d, J @ v.ravel() - d_dot
        J_dot_v = (np.sum(rate**2, axis=1) - np.sum(u * rate, axis=1) ** 2) / L
        alpha, beta, gamma = self.gains
        stabilisation = 2 * alpha * c_dot + beta**2 * c + gamma * integral
        b = d_ddot - J_dot_v - J @ self.M_inv @ f_E.ravel() - stabilisation
        A = J @ self.M_inv @ J.T
        multiplier = self._iterated(A, b) if self.mu else np.linalg.solve(A, b)
        f_C = J.T @ multiplier
        a = self.M_inv @ (f_E.ravel() + f_C)
        return np.concatenate([v.ravel(), a, c])


def constant(d: Array) -> Reference:
    """A step to distances d (m,) [m]."""
    zero = np.zeros_like(d)
    return lambda t: (d, zero, zero)


def squared(d0: Array, d1: Array, T_b: float) -> Reference:
    """Squared distances that blend from d0 to d1 (m,) [m] in T_b [s]."""
    before, rise = d0**2, d1**2 - d0**2

    def reference(t: float) -> tuple[Array, Array, Array]:
        s, s_dot, s_ddot = septic(t, T_b)
        d = np.sqrt(before + rise * s)
        d_dot = 0.5 * rise * s_dot / d
        return d, d_dot, (0.5 * rise * s_ddot - d_dot * d_dot) / d

    return reference


def septic(t: float, T_b: float) -> tuple[float, float, float]:
    """Blend from 0 to 1 over [0, T_b] [s] with three vanishing derivatives at either end."""
    if t >= T_b:
        return 1.0, 0.0, 0.0
    x = t / T_b
    y = 1.0 - x
    s = x**4 * (35.0 - x * (84.0 - x * (70.0 - 20.0 * x)))
    return s, 140.0 * (x * y) ** 3 / T_b, 420.0 * (x * y) ** 2 * (y - x) / T_b**2
