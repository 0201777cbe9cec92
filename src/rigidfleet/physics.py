"""The kernel's physics for a single call: checked arrays in, arrays out.

These functions are for notebooks, tests and studies; a flight calls the same compiled functions directly.
Arguments may be in world or body axes, as long as all use the same axes.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.kernel import constraint, references, rigid_body
from rigidfleet.kernel.problem import (
    RIGID,
    SHAPE,
    SOLVERS,
    SPLITS,
    SQUARED,
    ConstraintLaw,
    Reference,
    Vehicles,
    workspace,
)
from rigidfleet.kernel.problem import graph as kernel_graph
from rigidfleet.math.rigid_body import about_cm
from rigidfleet.planning.reference import shift_and_rotvec
from rigidfleet.typing import Floats, Ints


class ConstraintForce(NamedTuple):
    """Constraint force and constraint errors of a formation at one instant."""

    f_C: Floats  # (N, 3) force on each agent [N]
    multiplier: Floats  # (m,) lambda [N]; the tension of an edge is -lambda
    c: Floats  # (m,) constraint error L - d [m]
    c_dot: Floats  # (m,) [m/s]


def constraint_force(
    r: ArrayLike,
    v: ArrayLike,
    masses: ArrayLike,
    edges: ArrayLike,
    d: ArrayLike,
    *,
    d_dot: ArrayLike = 0.0,
    d_ddot: ArrayLike = 0.0,
    integral: ArrayLike = 0.0,
    f_E: ArrayLike = 0.0,
    alpha: float = 3.0,
    beta: float = 12.0**0.5,
    gamma: float = 8.0,
    solver: Literal["iterated", "spectral", "exact", "pinv"] = "iterated",
    damping: float = 0.03,
    iterations: int = 3,
    threshold: float = 0.1,
    cutoff: float = 1e-3,
) -> ConstraintForce:
    """Constraint force f_C = J^T lambda, Eq. (12) with references fed forward.

    Parameters
    ----------
    r, v : (N, 3) positions, velocities [m, m/s]
    masses : (N,) [kg]
    edges : (m, 2) agents from 0
    d, d_dot, d_ddot : (m,) desired distances and derivatives [m, m/s, m/s^2]
    integral : (m,) of c over time [m s]
    f_E : (N, 3) every other force on each agent, inputs included [N]
    alpha, beta, gamma : gains [1/s, 1/s, 1/s^3]
    solver, damping, iterations, threshold, cutoff : as in a mission's ``constraint`` table

    Raises
    ------
    ValueError
        Shapes do not fit, an edge has length zero, or the solver's name is unknown.
    """
    m, r = _check_masses_and_points(masses, r)
    n = len(m)
    graph = kernel_graph(_check_edges(edges, n), m)
    e = len(graph.edges)
    if solver not in SOLVERS:
        raise ValueError(f"unknown solver {solver!r}; choose one of {', '.join(SOLVERS)}")
    w = workspace(n, e)
    w.d[:], w.d_dot[:], w.d_ddot[:] = d, d_dot, d_ddot
    v, f = _broadcast(v, (n, 3), "v"), _broadcast(f_E, (n, 3), "f_E")
    law = ConstraintLaw(
        float(alpha), float(beta), float(gamma), SOLVERS[solver], float(damping), int(iterations),
        float(threshold), float(cutoff), 0.0,
    )  # fmt: skip
    a = np.ascontiguousarray(f / m[:, None])
    constraint.right_side(r, v, _broadcast(integral, (e,), "integral"), a, graph.edges, law, w)
    if e and not w.L.min() > 0.0:
        i, j = graph.edges[w.L.argmin()]
        raise ValueError(f"agents {i} and {j} coincide: their edge has no direction")
    total, limit = float(m.sum()), np.full(n, np.inf)
    vehicles = Vehicles(m, 1.0 / m, total, float(m.mean()), limit, False, 0.0)
    constraint.solve_multipliers(vehicles, graph, law, w)
    f_C = np.zeros((n, 3))
    constraint.apply_multipliers(w.u, graph.edges, w.multiplier, f_C)
    i, j = graph.edges.T
    c_dot = np.einsum("ka,ka->k", w.u, v[i] - v[j]) - w.d_dot
    return ConstraintForce(f_C, w.multiplier, w.c, c_dot)


def allocate(
    x: ArrayLike,
    masses: ArrayLike,
    F: ArrayLike,
    tau: ArrayLike,
    omega: ArrayLike = (0.0, 0.0, 0.0),
    *,
    method: Literal["rigid", "pinv"] = "rigid",
    torque_split: Literal["equal", "inertia", "inertia+force"] = "equal",
) -> Floats:
    """Input force (N, 3) [N] of every agent for a wrench on the virtual body (input decoupling).

    ``rigid`` is exact: f_i = m_i (F/M + alpha x x_i + omega x (omega x x_i)) with
    alpha = I^+ (tau - omega x I omega). ``pinv`` is the paper's H, Eqs. (24)-(27), with
    a pseudo-inverse, for H^T H is always singular; its wrench is not the one asked for, see
    `wrench`.

    Parameters: positions x (N, 3) [m] (taken about their CM), masses (N,) [kg], F (3,) [N], tau
    (3,) about the CM [N m], omega (3,) [rad/s] (``rigid`` only).
    """
    m, x = _check_masses_and_points(masses, x)
    x = np.ascontiguousarray(about_cm(x, m))
    if method not in {"rigid", "pinv"} or torque_split not in SPLITS:
        raise ValueError(
            f"unknown allocation {method!r} with {torque_split!r}; method must be 'rigid' or 'pinv',"
            f" torque_split one of {', '.join(SPLITS)}"
        )
    n = len(m)
    w = workspace(n, 0, with_h=method == "pinv")
    rigid_body.inertia(x, m, np.zeros(3), w.I)
    rigid_body.inertia_inverse(w.I, w.I_inv)
    f = np.zeros((n, 3))
    rigid_body.allocate(
        x, m, m.sum(), _broadcast(F, (3,), "F"), _broadcast(tau, (3,), "tau"), _broadcast(omega, (3,), "omega"),
        RIGID if method == "rigid" else SPLITS[torque_split], w.I, w.I_inv, f, w.H, w.H_V, w.H_w,
    )  # fmt: skip
    return f


def wrench(x: ArrayLike, masses: ArrayLike, f: ArrayLike) -> Floats:
    """Wrench (6,) of forces f (N, 3) [N] at x (N, 3) [m]: sum, Eq. (24), and torque about the CM, Eq. (25) [N, N m]."""
    m, x = _check_masses_and_points(masses, x)
    f = _broadcast(f, x.shape, "f")
    return np.concatenate([f.sum(axis=0), np.cross(about_cm(x, m), f).sum(axis=0)])


def shape_schedule(
    p0: ArrayLike,
    p1: ArrayLike,
    edges: ArrayLike,
    times: ArrayLike,
    *,
    start: float = 0.0,
    blend: float = 4.0,
    masses: ArrayLike | None = None,
    align: bool = False,
) -> tuple[Floats, Floats, Floats]:
    """Distances d (K, m) [m] of slots blended from p0 to p1 (N, 3), and two derivatives.

    p = p0 + (p1 - p0) s, s the septic over [start, start + blend] [s], and d_ij = |p_i - p_j|.
    ``align`` turns p1 onto p0 first (Kabsch, weighted by ``masses``), as missions do.
    """
    p0 = np.ascontiguousarray(p0, dtype=float)
    m = np.ones(len(p0)) if masses is None else masses
    m, p0 = _check_masses_and_points(m, p0)
    p1 = _broadcast(p1, p0.shape, "p1")
    dp = shift_and_rotvec(about_cm(p0, m), about_cm(p1, m), m)[0] if align else p1 - p0
    zero = np.zeros(0)
    ref = Reference(SHAPE, float(start), float(blend), zero, zero, p0, dp, np.zeros(3))
    return _distances_at(ref, _check_edges(edges, len(p0)), times)


def distance_schedule(
    d0: ArrayLike, d1: ArrayLike, times: ArrayLike, *, start: float = 0.0, blend: float = 4.0
) -> tuple[Floats, Floats, Floats]:
    """Distances d (K, m) [m] blended in d^2 from d0 to d1 (m,), and two derivatives.

    d = sqrt(d0^2 + (d1^2 - d0^2) s): realisable throughout for up to four agents.
    """
    d0 = np.atleast_1d(np.asarray(d0, dtype=float))
    d1 = _broadcast(d1, d0.shape, "d1")
    none = np.zeros((0, 3))
    ref = Reference(SQUARED, float(start), float(blend), d0, d1, none, none, np.zeros(3))
    return _distances_at(ref, np.zeros((len(d0), 2), dtype=np.int64), times)


def _distances_at(ref: Reference, edges: Ints, times: ArrayLike) -> tuple[Floats, Floats, Floats]:
    t = np.atleast_1d(np.asarray(times, dtype=float))
    p = np.zeros((3, *ref.p0.shape))
    out = np.zeros((3, len(t), len(edges)))
    for row, time in enumerate(t):
        if ref.kind == SHAPE:
            references.blend_slots(time, ref, *p)
        references.distance_references(time, ref, edges, *p, *out[:, row])
    return out[0], out[1], out[2]


def _check_masses_and_points(masses: ArrayLike, points: ArrayLike) -> tuple[Floats, Floats]:
    r = np.array(points, dtype=float, order="C")
    if r.ndim != 2 or r.shape[1] != 3:
        raise ValueError(f"positions must be (N, 3), not {r.shape}")
    m = _broadcast(masses, (len(r),), "masses")
    if not (m > 0).all():
        raise ValueError("masses must be positive [kg]")
    return m, r


def _broadcast(value: ArrayLike, shape: tuple[int, ...], name: str) -> Floats:
    try:
        # A copy: a read-only view has another type, and would compile the call again.
        return np.array(np.broadcast_to(np.asarray(value, dtype=float), shape), order="C")
    except ValueError:
        raise ValueError(f"{name} must be {shape}, not {np.shape(value)}") from None


def _check_edges(edges: ArrayLike, n: int) -> Ints:
    e = np.ascontiguousarray(edges, dtype=np.int64).reshape(-1, 2)
    if len(e) and (e.min() < 0 or e.max() >= n or (e[:, 0] == e[:, 1]).any()):
        raise ValueError(f"edges must join two different agents between 0 and {n - 1}")
    return e
