"""Linear algebra on the vertex graph: K = mbar J^T J + mu M, in 3x3 blocks, without a dense matrix.

K (3N, 3N) has a block for each agent and one for each edge. It is factored as L L^T in blocks, in the positions
of a `Pattern`, with all fill or without. This factor, rotated with the formation, preconditions conjugate
gradients for many later evaluations.
"""

import math

from rigidfleet.kernel.compiler.jit import jit, jit_inline


@jit
def elimination_tree(first, left, parent, ancestor):
    """Parent (N,) of each column: the first row below its diagonal in L; -1 at a root (Liu, 1986)."""
    for k in range(parent.shape[0]):
        for q in range(first[k], first[k + 1]):
            j = left[q]
            while j != -1 and j < k:
                above = ancestor[j]
                ancestor[j] = k
                if above == -1:
                    parent[j] = k
                j = above


@jit
def add_block_counts(first, left, parent, mark, count, most):
    """Add the blocks below the diagonal to each column's count (N,); return False for more than ``most`` in all."""
    total = 0
    for k in range(parent.shape[0]):
        mark[k] = k
        for q in range(first[k], first[k + 1]):
            j = left[q]
            while j != -1 and mark[j] != k:
                mark[j] = k
                count[j] += 1
                total += 1
                j = parent[j]
        if total > most:
            return False
    return True


@jit
def list_factor_blocks(first, left, parent, mark, free, out):
    """Write the rows and columns of the blocks counted by `add_block_counts`."""
    at = 0
    for k in range(parent.shape[0]):
        mark[k] = k
        out.row[free[k]] = k
        free[k] += 1
        out.first[k] = at
        for q in range(first[k], first[k + 1]):
            j = left[q]
            while j != -1 and mark[j] != k:
                mark[j] = k
                out.row[free[j]] = k
                out.left[at], out.block[at] = j, free[j]
                free[j] += 1
                at += 1
                j = parent[j]
    out.first[parent.shape[0]] = at


@jit
def assemble(u, edges, m, mbar, mu, place, column, of_edge, L):
    """K = mbar J^T J + mu M into the blocks L (B, 9)."""
    L[:] = 0.0
    for i in range(m.shape[0]):
        for s in range(3):
            L[column[place[i]], 4 * s] = mu * m[i]
    for k in range(edges.shape[0]):
        p, q = column[place[edges[k, 0]]], column[place[edges[k, 1]]]
        o = of_edge[k]
        for s in range(3):
            for t in range(3):
                x = mbar * u[k, s] * u[k, t]
                L[p, 3 * s + t] += x
                L[q, 3 * s + t] += x
                L[o, 3 * s + t] -= x


@jit
def factor(column, row, first, left, block, L, at):
    """Factor by blocks in place, column by column; return False if the matrix is not positive definite.

    The diagonal blocks store the inverses of their pivots. Updates outside the pattern
    are dropped; with all fill there are none.
    """
    for k in range(at.shape[0]):
        at[k] = -1
    for k in range(column.shape[0] - 1):
        start, end = column[k], column[k + 1]
        # ``at`` leads from a row to its block in this column: an update finds its place without a search.
        for q in range(start, end):
            at[row[q]] = q
        # Left-looking: each column j to the left with a block in row k takes its product from this column. The nine
        # numbers of that block stay in registers.
        for s in range(first[k], first[k + 1]):
            o, j = block[s], left[s]
            b0, b1, b2, b3, b4, b5, b6, b7, b8 = (
                L[o, 0], L[o, 1], L[o, 2], L[o, 3], L[o, 4], L[o, 5], L[o, 6], L[o, 7], L[o, 8],
            )  # fmt: skip
            for q in range(o, column[j + 1]):
                z = at[row[q]]
                if z < start:  # of a column before
                    continue
                for c in range(0, 9, 3):
                    x, y, w = L[q, c], L[q, c + 1], L[q, c + 2]
                    L[z, c] -= x * b0 + y * b1 + w * b2
                    L[z, c + 1] -= x * b3 + y * b4 + w * b5
                    L[z, c + 2] -= x * b6 + y * b7 + w * b8
        # The diagonal block by itself: a Cholesky factor of three rows, with the inverses of its pivots.
        d0 = L[start, 0]
        if not d0 > 0.0:
            return False
        i0 = 1.0 / math.sqrt(d0)
        l3, l6 = L[start, 3] * i0, L[start, 6] * i0
        d1 = L[start, 4] - l3 * l3
        if not d1 > 0.0:
            return False
        i4 = 1.0 / math.sqrt(d1)
        l7 = (L[start, 7] - l6 * l3) * i4
        d2 = L[start, 8] - l6 * l6 - l7 * l7
        if not d2 > 0.0:
            return False
        i8 = 1.0 / math.sqrt(d2)
        L[start, 0], L[start, 3], L[start, 4] = i0, l3, i4
        L[start, 6], L[start, 7], L[start, 8] = l6, l7, i8
        # The blocks below: each row solved with that factor.
        for q in range(start + 1, end):
            for c in range(0, 9, 3):
                x = L[q, c] * i0
                y = (L[q, c + 1] - x * l3) * i4
                L[q, c], L[q, c + 1] = x, y
                L[q, c + 2] = (L[q, c + 2] - x * l6 - y * l7) * i8
    return True


@jit_inline
def precondition(R, place, column, row, L, r, w, z):
    """z = R (L L^T)^-1 R^T r for (N, 3) arrays, where R (3, 3) is the rotation since the factor was made."""
    for i in range(r.shape[0]):
        k = place[i]
        for s in range(3):
            w[k, s] = R[0, s] * r[i, 0] + R[1, s] * r[i, 1] + R[2, s] * r[i, 2]
    # Forward, column by column: what is known of a column goes at once to the rows below.
    for k in range(r.shape[0]):
        q = column[k]
        a = w[k, 0] * L[q, 0]
        b = (w[k, 1] - L[q, 3] * a) * L[q, 4]
        c = (w[k, 2] - L[q, 6] * a - L[q, 7] * b) * L[q, 8]
        w[k, 0], w[k, 1], w[k, 2] = a, b, c
        for q in range(column[k] + 1, column[k + 1]):
            i = row[q]
            w[i, 0] -= L[q, 0] * a + L[q, 1] * b + L[q, 2] * c
            w[i, 1] -= L[q, 3] * a + L[q, 4] * b + L[q, 5] * c
            w[i, 2] -= L[q, 6] * a + L[q, 7] * b + L[q, 8] * c
    # Backward, with the transposed blocks.
    for k in range(r.shape[0] - 1, -1, -1):
        a, b, c = w[k, 0], w[k, 1], w[k, 2]
        for q in range(column[k] + 1, column[k + 1]):
            i = row[q]
            x, y, d = w[i, 0], w[i, 1], w[i, 2]
            a -= L[q, 0] * x + L[q, 3] * y + L[q, 6] * d
            b -= L[q, 1] * x + L[q, 4] * y + L[q, 7] * d
            c -= L[q, 2] * x + L[q, 5] * y + L[q, 8] * d
        q = column[k]
        c *= L[q, 8]
        b = (b - L[q, 7] * c) * L[q, 4]
        w[k, 0], w[k, 1], w[k, 2] = (a - L[q, 3] * b - L[q, 6] * c) * L[q, 0], b, c
    for i in range(r.shape[0]):
        k = place[i]
        for s in range(3):
            z[i, s] = R[s, 0] * w[k, 0] + R[s, 1] * w[k, 1] + R[s, 2] * w[k, 2]


@jit
def add_J_product(u, edges, a, scale, out):
    """out (m,) += scale J a, for a (N, 3)."""
    for k in range(edges.shape[0]):
        i, j = edges[k, 0], edges[k, 1]
        out[k] += scale * (
            u[k, 0] * (a[i, 0] - a[j, 0])
            + u[k, 1] * (a[i, 1] - a[j, 1])
            + u[k, 2] * (a[i, 2] - a[j, 2])
        )


@jit
def add_Jt_product(u, edges, b, scale, out):
    """out (N, 3) += scale J^T b, for b (m,)."""
    for k in range(edges.shape[0]):
        i, j = edges[k, 0], edges[k, 1]
        s = scale * b[k]
        for q in range(3):
            out[i, q] += s * u[k, q]
            out[j, q] -= s * u[k, q]


@jit_inline
def multiply_by_agent_K(u, edges, m, mbar, mu, a, out):
    """out = K a for (N, 3) arrays."""
    for i in range(m.shape[0]):
        s = mu * m[i]
        out[i, 0], out[i, 1], out[i, 2] = s * a[i, 0], s * a[i, 1], s * a[i, 2]
    for k in range(edges.shape[0]):
        i, j = edges[k, 0], edges[k, 1]
        x, y, z = u[k, 0], u[k, 1], u[k, 2]
        s = mbar * (x * (a[i, 0] - a[j, 0]) + y * (a[i, 1] - a[j, 1]) + z * (a[i, 2] - a[j, 2]))
        out[i, 0], out[i, 1], out[i, 2] = out[i, 0] + s * x, out[i, 1] + s * y, out[i, 2] + s * z
        out[j, 0], out[j, 1], out[j, 2] = out[j, 0] - s * x, out[j, 1] - s * y, out[j, 2] - s * z


@jit_inline
def inner(a, b):
    """Sum of a b over (N, 3) arrays."""
    s = 0.0
    for i in range(a.shape[0]):
        s += a[i, 0] * b[i, 0] + a[i, 1] * b[i, 1] + a[i, 2] * b[i, 2]
    return s


@jit
def project_on_past_solutions(u, edges, m, mbar, mu, g, past, G, x):
    """x (N, 3) = the combination of past solutions (P, N, 3) that is nearest to the solution of K x = g.

    Nearest in the norm of K, so that its residual is orthogonal to all of them (Fischer, 1998). Solutions that depend
    on earlier ones are skipped. G (P, P + 2) is scratch.
    """
    # G becomes the matrix of inner products y_p^T K y_q, whose Cholesky factor gives the weights c. Sums over edges and
    # agents are taken once for all products, so that ``past`` is read once.
    count = past.shape[0]
    c, scale = G[:, count], G[:, count + 1]
    G[:] = 0.0
    for k in range(edges.shape[0]):
        i, j = edges[k, 0], edges[k, 1]
        for p in range(count):
            along = 0.0
            for s in range(3):
                along += u[k, s] * (past[p, i, s] - past[p, j, s])
            scale[p] = along
            for q in range(p + 1):
                G[p, q] += mbar * along * scale[q]
    for i in range(m.shape[0]):
        for p in range(count):
            y0, y1, y2 = past[p, i, 0], past[p, i, 1], past[p, i, 2]
            c[p] += y0 * g[i, 0] + y1 * g[i, 1] + y2 * g[i, 2]
            y0, y1, y2 = mu * m[i] * y0, mu * m[i] * y1, mu * m[i] * y2
            for q in range(p + 1):
                G[p, q] += y0 * past[q, i, 0] + y1 * past[q, i, 1] + y2 * past[q, i, 2]
    for p in range(count):
        for q in range(p):
            for l in range(q):
                G[p, q] -= G[p, l] * G[q, l]
            G[p, q] *= scale[q]
        rest = G[p, p]
        for q in range(p):
            rest -= G[p, q] * G[p, q]
            c[p] -= G[p, q] * c[q]
        # One that is nearly a combination of others would divide by rounding.
        scale[p] = 1.0 / math.sqrt(rest) if rest > 1e-12 * G[p, p] else 0.0
        c[p] *= scale[p]
    for p in range(count - 1, -1, -1):
        for q in range(p + 1, count):
            c[p] -= G[q, p] * c[q]
        c[p] *= scale[p]
    for i in range(m.shape[0]):
        for s in range(3):
            x[i, s] = 0.0
            for p in range(count):
                x[i, s] += c[p] * past[p, i, s]


@jit
def conjugate_gradients(u, edges, m, mbar, mu, R, place, column, row, L, g, x, within, most, work):
    """Solve K x = g, starting from x, until |g - K x| <= within, all (N, 3); return the number of iterations.

    More than ``most`` iterations mean that it has not converged. ``work`` (5, N, 3) is scratch.
    """
    r, z, q, Kq, w = work[0], work[1], work[2], work[3], work[4]
    n = m.shape[0]
    multiply_by_agent_K(u, edges, m, mbar, mu, x, Kq)
    for i in range(n):
        for s in range(3):
            r[i, s] = g[i, s] - Kq[i, s]
            q[i, s] = 0.0
    last, rest = 1.0, inner(r, r)
    for iteration in range(most + 1):
        if rest <= within * within:
            return iteration
        precondition(R, place, column, row, L, r, w, z)
        rz = inner(r, z)
        for i in range(n):
            for s in range(3):
                q[i, s] = z[i, s] + (rz / last) * q[i, s]
        last = rz
        multiply_by_agent_K(u, edges, m, mbar, mu, q, Kq)
        step = rz / inner(q, Kq)
        rest = 0.0
        for i in range(n):
            for s in range(3):
                x[i, s] += step * q[i, s]
                r[i, s] -= step * Kq[i, s]
                rest += r[i, s] * r[i, s]
    return most + 1
