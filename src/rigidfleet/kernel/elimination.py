"""The exact law by two passes of 3x3 solves, O(N): for graphs that join each agent to three earlier ones.

Such a graph (a 3-tree, or any other made by Henneberg type-I steps) has 3N - 6 edges. If no pivot is lost, J has
full row rank, and its null space is the six rigid motions of the *current* shape. So any a_p with J a_p = b, plus the
rigid motion that restores the balance of momentum, is M^-1 f_C of the exact law. A = J M^-1 J^T is neither formed nor
factored: a forward pass finds a_p, and a backward pass the multipliers, if they are asked for.
"""

import math

from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.records import LOST_PIVOT
from rigidfleet.kernel.rigid_body import centre_of_mass, inertia, inertia_inverse


@jit
def solve(u, b, r, m, M, order, known, cm, I, I_inv, a, f_C):
    """Compute f_C (N, 3) of the exact law for b (m,) and return the smallest pivot; if lost, write nothing.

    The agents are at r (N, 3), with unit vectors u (m, 3). The centre of mass cm, the inertia I about it and its
    inverse are computed unless ``known``; a (N, 3) is scratch.
    """
    if not known:
        centre_of_mass(r, m, M, cm)
        inertia(r, m, cm, I)
        inertia_inverse(I, I_inv)
    pivot = solve_J_agent_by_agent(u, b, order, a)
    if pivot > LOST_PIVOT:
        write_balanced_forces(r, m, M, cm, I_inv, a, f_C)
    return pivot


@jit_inline
def solve_J_agent_by_agent(u, b, order, a):
    """Write into a (N, 3) a solution of J a = b, agent by agent; return the smallest pivot.

    An edge to agent j requires u . a_i = +-b + u . a_j. If an agent has fewer than three edges, the shortest
    solution is taken.
    """
    agent, edge, other, sign = order.agent, order.edge, order.other, order.sign
    smallest = 1.0
    for s in range(agent.shape[0]):
        i = agent[s]
        if s == 0:
            a[i, 0], a[i, 1], a[i, 2] = 0.0, 0.0, 0.0
            continue
        k, j = edge[s, 0], other[s, 0]
        n0, n1, n2 = u[k, 0], u[k, 1], u[k, 2]
        p = sign[s, 0] * b[k] + n0 * a[j, 0] + n1 * a[j, 1] + n2 * a[j, 2]
        if s == 1:
            a[i, 0], a[i, 1], a[i, 2] = p * n0, p * n1, p * n2
            continue
        k, j = edge[s, 1], other[s, 1]
        x0, x1, x2 = u[k, 0], u[k, 1], u[k, 2]
        q = sign[s, 1] * b[k] + x0 * a[j, 0] + x1 * a[j, 1] + x2 * a[j, 2]
        if s == 2:
            g = n0 * x0 + n1 * x1 + n2 * x2
            smallest = min(smallest, math.sqrt(max(0.0, 1.0 - g * g)))
            along, across = (p - g * q) / (1.0 - g * g), (q - g * p) / (1.0 - g * g)
            a[i, 0] = along * n0 + across * x0
            a[i, 1] = along * n1 + across * x1
            a[i, 2] = along * n2 + across * x2
            continue
        k, j = edge[s, 2], other[s, 2]
        y0, y1, y2 = u[k, 0], u[k, 1], u[k, 2]
        o = sign[s, 2] * b[k] + y0 * a[j, 0] + y1 * a[j, 1] + y2 * a[j, 2]
        c0, c1, c2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
        pivot = n0 * c0 + n1 * c1 + n2 * c2
        smallest = min(smallest, abs(pivot))
        scale = 1.0 / pivot
        p, q, o = p * scale, q * scale, o * scale
        a[i, 0] = p * c0 + q * (y1 * n2 - y2 * n1) + o * (n1 * x2 - n2 * x1)
        a[i, 1] = p * c1 + q * (y2 * n0 - y0 * n2) + o * (n2 * x0 - n0 * x2)
        a[i, 2] = p * c2 + q * (y0 * n1 - y1 * n0) + o * (n0 * x1 - n1 * x0)
    return smallest


@jit_inline
def write_balanced_forces(r, m, M, cm, I_inv, accels, out):
    """Forces (N, 3) of accelerations (N, 3) into ``out``, without the rigid motion that carries their momentum.

    The forces then have zero sum, and zero torque about cm, the centre of mass of agents r (N, 3).
    """
    p0 = p1 = p2 = h0 = h1 = h2 = 0.0
    for i in range(r.shape[0]):
        x, y, z = r[i, 0] - cm[0], r[i, 1] - cm[1], r[i, 2] - cm[2]
        a0, a1, a2 = m[i] * accels[i, 0], m[i] * accels[i, 1], m[i] * accels[i, 2]
        p0, p1, p2 = p0 + a0, p1 + a1, p2 + a2
        h0 += y * a2 - z * a1
        h1 += z * a0 - x * a2
        h2 += x * a1 - y * a0
    p0, p1, p2 = p0 / M, p1 / M, p2 / M
    w0 = I_inv[0, 0] * h0 + I_inv[0, 1] * h1 + I_inv[0, 2] * h2
    w1 = I_inv[1, 0] * h0 + I_inv[1, 1] * h1 + I_inv[1, 2] * h2
    w2 = I_inv[2, 0] * h0 + I_inv[2, 1] * h1 + I_inv[2, 2] * h2
    for i in range(r.shape[0]):
        x, y, z = r[i, 0] - cm[0], r[i, 1] - cm[1], r[i, 2] - cm[2]
        out[i, 0] = m[i] * (accels[i, 0] - p0 - (w1 * z - w2 * y))
        out[i, 1] = m[i] * (accels[i, 1] - p1 - (w2 * x - w0 * z))
        out[i, 2] = m[i] * (accels[i, 2] - p2 - (w0 * y - w1 * x))


@jit
def multipliers(u, order, f, multiplier):
    """Multipliers (m,) with J^T lambda = f for balanced forces f (N, 3), last agent first; f is overwritten.

    Each agent's three edges carry its force, and pass the reactions to the agents before.
    """
    agent, edge, other, sign = order.agent, order.edge, order.other, order.sign
    for s in range(agent.shape[0] - 1, 0, -1):
        i, k, l, o = agent[s], edge[s, 0], edge[s, 1], edge[s, 2]
        n0, n1, n2 = u[k, 0], u[k, 1], u[k, 2]
        f0, f1, f2 = f[i, 0], f[i, 1], f[i, 2]
        if s == 1:
            multiplier[k] = sign[s, 0] * (n0 * f0 + n1 * f1 + n2 * f2)
            continue
        x0, x1, x2 = u[l, 0], u[l, 1], u[l, 2]
        if s == 2:
            g = n0 * x0 + n1 * x1 + n2 * x2
            p, q = n0 * f0 + n1 * f1 + n2 * f2, x0 * f0 + x1 * f1 + x2 * f2
            p, q = (p - g * q) / (1.0 - g * g), (q - g * p) / (1.0 - g * g)
        else:
            y0, y1, y2 = u[o, 0], u[o, 1], u[o, 2]
            c0, c1, c2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
            scale = 1.0 / (n0 * c0 + n1 * c1 + n2 * c2)
            f0, f1, f2 = scale * f0, scale * f1, scale * f2
            # Triple products: f (x x y), f (y x n), f (n x x).
            p = f0 * c0 + f1 * c1 + f2 * c2
            d0, d1, d2 = n1 * f2 - n2 * f1, n2 * f0 - n0 * f2, n0 * f1 - n1 * f0
            q = d0 * y0 + d1 * y1 + d2 * y2
            w = -(d0 * x0 + d1 * x1 + d2 * x2)
            j = other[s, 2]
            multiplier[o] = sign[s, 2] * w
            f[j, 0], f[j, 1], f[j, 2] = f[j, 0] + w * y0, f[j, 1] + w * y1, f[j, 2] + w * y2
        j = other[s, 1]
        multiplier[l] = sign[s, 1] * q
        f[j, 0], f[j, 1], f[j, 2] = f[j, 0] + q * x0, f[j, 1] + q * x1, f[j, 2] + q * x2
        j = other[s, 0]
        multiplier[k] = sign[s, 0] * p
        f[j, 0], f[j, 1], f[j, 2] = f[j, 0] + p * n0, f[j, 1] + p * n1, f[j, 2] + p * n2
