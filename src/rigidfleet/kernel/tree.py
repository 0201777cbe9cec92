"""The exact law by two sweeps of 3x3 solves, O(N): for graphs that join each agent to three earlier ones.

Such a graph (a 3-tree or any other made by Henneberg's first step) has 3N - 6 edges, and where no pivot is
lost J has full row rank: its null space is the six rigid motions of the *current* shape. So any a_p with
J a_p = b, plus the rigid motion that restores the balance of momentum, is M^-1 f_C of the exact law;
A = J M^-1 J^T is neither formed nor factored. A sweep forwards finds a_p, one backwards the multipliers.
"""

import math

from rigidfleet.kernel.body import centre_of_mass, inertia, inertia_inverse, multiply
from rigidfleet.kernel.compiled import compiled

# The triple product of three unit vectors that counts as a lost pivot.
LOST = 1e-6


@compiled
def particular(u, b, edges, steps, a):
    """Write into a (N, 3) a solution of J a = b, agent by agent; return the smallest pivot.

    ``steps`` (N, 4): agent, and its edges to agents before it: none, one, two, then three each (-1: none).
    Where there are fewer than three, the shortest solution is taken.
    """
    smallest = 1.0
    for s in range(steps.shape[0]):
        i = steps[s, 0]
        a[i, 0], a[i, 1], a[i, 2] = 0.0, 0.0, 0.0
        if s == 0:
            continue
        # n . a_i = b + n . a_j, with n the edge's unit vector towards agent i.
        n0, n1, n2, p = _towards(u, b, edges, a, steps[s, 1], i)
        if s == 1:
            a[i, 0], a[i, 1], a[i, 2] = p * n0, p * n1, p * n2
            continue
        x0, x1, x2, q = _towards(u, b, edges, a, steps[s, 2], i)
        if s == 2:
            g = n0 * x0 + n1 * x1 + n2 * x2
            smallest = min(smallest, math.sqrt(max(0.0, 1.0 - g * g)))
            along, across = (p - g * q) / (1.0 - g * g), (q - g * p) / (1.0 - g * g)
            a[i, 0] = along * n0 + across * x0
            a[i, 1] = along * n1 + across * x1
            a[i, 2] = along * n2 + across * x2
            continue
        y0, y1, y2, o = _towards(u, b, edges, a, steps[s, 3], i)
        c0, c1, c2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
        pivot = n0 * c0 + n1 * c1 + n2 * c2
        smallest = min(smallest, abs(pivot))
        p, q, o = p / pivot, q / pivot, o / pivot
        a[i, 0] = p * c0 + q * (y1 * n2 - y2 * n1) + o * (n1 * x2 - n2 * x1)
        a[i, 1] = p * c1 + q * (y2 * n0 - y0 * n2) + o * (n2 * x0 - n0 * x2)
        a[i, 2] = p * c2 + q * (y0 * n1 - y1 * n0) + o * (n0 * x1 - n1 * x0)
    return smallest


@compiled
def _towards(u, b, edges, a, k, i):
    """Unit vector of edge k towards its agent i, and the right side b_k + n . a_j."""
    sign, j = (1.0, edges[k, 1]) if edges[k, 0] == i else (-1.0, edges[k, 0])
    n0, n1, n2 = sign * u[k, 0], sign * u[k, 1], sign * u[k, 2]
    return n0, n1, n2, b[k] + n0 * a[j, 0] + n1 * a[j, 1] + n2 * a[j, 2]


@compiled
def balance(r, m, M, a, work):
    """Take from a (N, 3) the rigid motion that carries momentum: sum m a = 0, sum m x cross a = 0.

    ``work`` (10, 3) is scratch.
    """
    cm, mean, h, turn = work[0], work[1], work[2], work[3]
    I, I_inv = work[4:7], work[7:10]
    centre_of_mass(r, m, M, cm)
    centre_of_mass(a, m, M, mean)
    inertia(r, m, cm, I)
    inertia_inverse(I, I_inv)
    h[0], h[1], h[2] = 0.0, 0.0, 0.0
    for i in range(r.shape[0]):
        x, y, z = r[i, 0] - cm[0], r[i, 1] - cm[1], r[i, 2] - cm[2]
        h[0] += m[i] * (y * a[i, 2] - z * a[i, 1])
        h[1] += m[i] * (z * a[i, 0] - x * a[i, 2])
        h[2] += m[i] * (x * a[i, 1] - y * a[i, 0])
    multiply(I_inv, h, turn)
    for i in range(r.shape[0]):
        x, y, z = r[i, 0] - cm[0], r[i, 1] - cm[1], r[i, 2] - cm[2]
        a[i, 0] -= mean[0] + turn[1] * z - turn[2] * y
        a[i, 1] -= mean[1] + turn[2] * x - turn[0] * z
        a[i, 2] -= mean[2] + turn[0] * y - turn[1] * x


@compiled
def multipliers(u, edges, steps, m, a, f, multiplier):
    """Multipliers (m,) with J^T lambda = M a, last agent first; f (N, 3) is scratch."""
    for i in range(a.shape[0]):
        for q in range(3):
            f[i, q] = m[i] * a[i, q]
    for s in range(steps.shape[0] - 1, 0, -1):
        i, k = steps[s, 0], steps[s, 1]
        n0, n1, n2 = u[k, 0], u[k, 1], u[k, 2]
        if s == 1:
            multiplier[k] = _sign(edges, k, i) * (n0 * f[i, 0] + n1 * f[i, 1] + n2 * f[i, 2])
            continue
        l = steps[s, 2]
        x0, x1, x2 = u[l, 0], u[l, 1], u[l, 2]
        if s == 2:
            g = n0 * x0 + n1 * x1 + n2 * x2
            p = n0 * f[i, 0] + n1 * f[i, 1] + n2 * f[i, 2]
            q = x0 * f[i, 0] + x1 * f[i, 1] + x2 * f[i, 2]
            _pull(u, edges, k, i, (p - g * q) / (1.0 - g * g), f, multiplier)
            _pull(u, edges, l, i, (q - g * p) / (1.0 - g * g), f, multiplier)
            continue
        o = steps[s, 3]
        y0, y1, y2 = u[o, 0], u[o, 1], u[o, 2]
        c0, c1, c2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
        scale = 1.0 / (n0 * c0 + n1 * c1 + n2 * c2)
        f0, f1, f2 = scale * f[i, 0], scale * f[i, 1], scale * f[i, 2]
        d0, d1, d2 = y1 * n2 - y2 * n1, y2 * n0 - y0 * n2, y0 * n1 - y1 * n0
        e0, e1, e2 = n1 * x2 - n2 * x1, n2 * x0 - n0 * x2, n0 * x1 - n1 * x0
        _pull(u, edges, k, i, f0 * c0 + f1 * c1 + f2 * c2, f, multiplier)
        _pull(u, edges, l, i, f0 * d0 + f1 * d1 + f2 * d2, f, multiplier)
        _pull(u, edges, o, i, f0 * e0 + f1 * e1 + f2 * e2, f, multiplier)


@compiled
def _sign(edges, k, i):
    return 1.0 if edges[k, 0] == i else -1.0


@compiled
def _pull(u, edges, k, i, along, f, multiplier):
    """Let edge k pull agent i by ``along`` its u, and leave the reaction to its other end."""
    j = edges[k, 1] if edges[k, 0] == i else edges[k, 0]
    multiplier[k] = _sign(edges, k, i) * along
    for q in range(3):
        f[j, q] += along * u[k, q]
