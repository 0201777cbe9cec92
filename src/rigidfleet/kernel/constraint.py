"""The constraint force: Baumgarte-stabilised Lagrange multipliers (paper, section III).

Eq. (12) of the paper, with the moving reference fed forward, reads

    f_C = J^T lambda,   (J M^-1 J^T) lambda = b,
    b = d_ddot - J_dot r_dot - J M^-1 f_E - 2 alpha c_dot - beta^2 c - gamma int c dt.

Row k of J holds the unit vector u_k of edge (i, j) at i and -u_k at j. The matrix
A = J M^-1 J^T is singular if a formation lies on a line or in a plane, or has redundant edges.
The named solvers differ only in how they treat this case.
"""

import math

from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.linalg import cholesky, cholesky_solve, jacobi_eigen
from rigidfleet.kernel.outside import call_solver
from rigidfleet.kernel.problem import EXACT, ITERATED, PINV, SPECTRAL
from rigidfleet.kernel.references import distance_references


@jit_inline
def constraint_force(t, y, dy, p, w):
    """f_C (N, 3) [N], Eq. (12), at time t [s] for w.r, w.v, the forces w.f_E and w.f_u; and dy of the integral of c."""
    vehicles, graph = p.vehicles, p.graph
    n, m = vehicles.m.shape[0], graph.edges.shape[0]
    distance_references(t, p.reference, graph.edges, w.p, w.p_dot, w.p_ddot, w.d, w.d_dot, w.d_ddot)
    for i in range(n):
        for s in range(3):
            w.a[i, s] = vehicles.inverse[i] * (w.f_E[i, s] + w.f_u[i, s])
    right_side(w.r, w.v, y[6 * n : 6 * n + m], w.a, graph.edges, p.law, w)
    solve_multipliers(vehicles, graph, p.law, w)
    if graph.multipliers == 0:
        apply_multipliers(w.u, graph.edges, w.multiplier, w.f_C)
    for k in range(m):
        dy[6 * n + k] = w.c[k]


@jit_inline
def right_side(r, v, integral, a, edges, law, w):
    """Edges at positions r and velocities v (N, 3), and the bracket of Eq. (12).

    Fills w.u (m, 3) with unit vectors and w.L (m,) [m] with lengths, w.c with the
    constraints, Eq. (3), and w.b [m/s^2] with the right side. J v of an edge, Eq. (5), is u . dv;
    Jdot v, Eq. (6), is (|dv|^2 - (u . dv)^2) / L; ``a`` (N, 3) [m/s^2] is M^-1 f_E, the
    acceleration by every force but f_C.
    """
    for k in range(edges.shape[0]):
        i, j = edges[k, 0], edges[k, 1]
        x, y, z = r[i, 0] - r[j, 0], r[i, 1] - r[j, 1], r[i, 2] - r[j, 2]
        X, Y, Z = v[i, 0] - v[j, 0], v[i, 1] - v[j, 1], v[i, 2] - v[j, 2]
        L = math.sqrt(x * x + y * y + z * z)
        inverse = 1.0 / L
        x, y, z = x * inverse, y * inverse, z * inverse
        along = x * X + y * Y + z * Z
        pull = x * (a[i, 0] - a[j, 0]) + y * (a[i, 1] - a[j, 1]) + z * (a[i, 2] - a[j, 2])
        w.L[k], w.c[k] = L, L - w.d[k]
        w.u[k, 0], w.u[k, 1], w.u[k, 2] = x, y, z
        w.b[k] = (
            w.d_ddot[k]
            - (X * X + Y * Y + Z * Z - along * along) * inverse
            - pull
            - 2.0 * law.alpha * (along - w.d_dot[k])
            - law.beta * law.beta * w.c[k]
            - law.gamma * integral[k]
        )


@jit
def assemble(u, graph, scale, shift, A):
    """Lower triangle of A = scale J M^-1 J^T + shift 1 (m, m), the matrix of Eqs. (11), (12)."""
    pairs, weight = graph.pairs, graph.weight
    n = A.shape[0]
    all_meet = 2 * pairs.shape[0] == n * (n - 1)
    for k in range(n):
        if not all_meet:
            for l in range(k):
                A[k, l] = 0.0
        A[k, k] = scale * graph.diagonal[k] + shift
    for p in range(pairs.shape[0]):
        k, l = pairs[p, 0], pairs[p, 1]
        dot = u[k, 0] * u[l, 0] + u[k, 1] * u[l, 1] + u[k, 2] * u[l, 2]
        A[k, l] = scale * weight[p] * dot


@jit_inline
def solve_multipliers(vehicles, graph, law, w):
    """Multipliers w.multiplier (m,) [N] of Eqs. (11), (12) for w.b; NaN if A is singular and the law exact.

    On the eigenvalues w of mbar A (mbar is the mean mass of the agents still flying), each law is mbar phi(w) b with
    exact      1/w, the paper's;
    iterated   (1 - (mu/(w + mu))^k)/w, Tikhonov regularisation iterated k times;
    spectral   1/(w + nu), nu = (s0/4)(1 - w/s0)^2 for w < s0, else 0;
    pinv       1/w, and below W = cutoff w_max (3 - 2 w/W) w/W^2, which continues smoothly to 0, because
               a jump would make the force jump.
    """
    if graph.solver != 0:
        call_solver(graph.solver)
        return
    m = vehicles.m
    n = graph.edges.shape[0]
    b, y = w.b, w.multiplier
    mbar = vehicles.mean
    if w.A.shape[0] < n:
        solve_at_agents(m, mbar, graph.edges, law, w)
        return
    mu, iterations = (law.mu, law.iterations) if law.solver == ITERATED else (0.0, 1)
    # Spectral damping equals the exact law if all w >= s0, that is, if mbar A - s0 is definite. The pseudo-inverse
    # equals it if all w are above its cut-off; the trace is an upper bound of w_max.
    trials, least = 1, law.s0
    if law.solver == SPECTRAL:
        trials = 2
    elif law.solver == PINV:
        trials, least = 2, 0.0
        for k in range(n):
            least += law.cutoff * mbar * graph.diagonal[k]
    definite = False
    for trial in range(trials, 0, -1):
        assemble(w.u, graph, mbar, mu if trial == 1 else -least, w.A)
        definite = cholesky(w.A)
        if not definite:
            break
    if definite:
        for i in range(iterations):  # (mbar A + mu) y_new = mbar b + mu y, from y = 0
            for k in range(n):
                y[k] = mbar * b[k] + (mu * y[k] if i > 0 else 0.0)
            cholesky_solve(w.A, y)
        return
    if law.solver in (ITERATED, EXACT):
        y[:] = math.nan
        return
    solve_by_eigenvalues(graph, mbar, law, w)


@jit_inline
def solve_by_eigenvalues(graph, mbar, law, w):
    """The laws pinv and spectral, as functions of the eigenvalues, if a factor does not exist."""
    n = graph.edges.shape[0]
    b, y = w.b, w.multiplier
    assemble(w.u, graph, mbar, 0.0, w.A)
    largest = jacobi_eigen(w.A, w.V, w.w)
    y[:] = 0.0
    for q in range(n):
        value = w.w[q]
        if law.solver == PINV:
            low = law.cutoff * largest
            x = value / low
            phi = 1.0 / value if x >= 1.0 else (3.0 - 2.0 * x) * x / low
        else:
            short = max(0.0, 1.0 - value / law.s0)
            phi = 1.0 / (value + 0.25 * law.s0 * short * short)
        s = 0.0
        for k in range(n):
            s += w.V[k, q] * b[k]
        for k in range(n):
            y[k] += mbar * phi * s * w.V[k, q]


@jit
def solve_at_agents(m, mbar, edges, law, w):
    """The iterated solve in the agents' coordinates, which is the smaller system if there are many edges.

    With K = mbar J^T J + mu M (3N, 3N), each iteration is a += mbar K^-1 J^T (b - J a), and the
    multipliers are lambda = (mbar/mu) sum of the residuals b - J a: f_C = J^T lambda = M a.
    """
    K, u, b, y = w.A, w.u, w.b, w.multiplier
    n = m.shape[0]
    x, a = w.w, w.f_C
    for p in range(3 * n):
        for q in range(p):
            K[p, q] = 0.0
        K[p, p] = law.mu * m[p // 3]
    for k in range(edges.shape[0]):
        i, j = edges[k, 0], edges[k, 1]
        high, low = 3 * max(i, j), 3 * min(i, j)
        for p in range(3):
            for q in range(3):
                block = mbar * u[k, p] * u[k, q]
                K[high + p, low + q] -= block
                if q <= p:
                    K[high + p, high + q] += block
                    K[low + p, low + q] += block
    cholesky(K)
    a[:] = 0.0
    y[:] = 0.0
    for it in range(law.iterations + 1):
        x[: 3 * n] = 0.0
        for k in range(edges.shape[0]):
            i, j = edges[k, 0], edges[k, 1]
            rest = b[k]
            for p in range(3):
                rest -= u[k, p] * (a[i, p] - a[j, p])
            if it > 0:
                y[k] += mbar / law.mu * rest
            for p in range(3):
                x[3 * i + p] += mbar * rest * u[k, p]
                x[3 * j + p] -= mbar * rest * u[k, p]
        if it == law.iterations:
            return
        cholesky_solve(K, x[: 3 * n])
        for i in range(n):
            for p in range(3):
                a[i, p] += x[3 * i + p]


@jit
def find_multipliers(graph):
    """Have w.multiplier (m,) [N] of the last evaluation computed, by a solver that finds f_C without.

    Few evaluations of a large formation are asked for them, those of samples and at the ends of steps.
    """
    if graph.multipliers != 0:
        call_solver(graph.multipliers)


@jit
def apply_multipliers(u, edges, multiplier, f_C):
    """f_C = J^T lambda, Eq. (10), into f_C (N, 3) [N]: no net force, no net torque."""
    f_C[:] = 0.0
    for k in range(edges.shape[0]):
        i, j = edges[k, 0], edges[k, 1]
        for q in range(3):
            pull = multiplier[k] * u[k, q]
            f_C[i, q] += pull
            f_C[j, q] -= pull
