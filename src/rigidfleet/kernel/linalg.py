"""Dense linear algebra without allocation, for the small matrices of one formation."""

import math

from rigidfleet.kernel.compiled import compiled


@compiled
def cholesky(A):
    """Factor the lower triangle of A (n, n) = L L^T in place; the diagonal keeps 1 / L_jj.

    Returns False, and leaves A half done, where A is not positive definite.
    """
    n = A.shape[0]
    for j in range(n):
        pivot = A[j, j]
        for k in range(j):
            pivot -= A[j, k] * A[j, k]
        if not pivot > 0.0:
            return False
        inverse = 1.0 / math.sqrt(pivot)
        A[j, j] = inverse
        for i in range(j + 1, n):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            A[i, j] = s * inverse
    return True


@compiled
def cholesky_solve(A, x):
    """Solve L L^T x = x in place, A as left by `cholesky`."""
    n = A.shape[0]
    for i in range(n):
        s = x[i]
        for k in range(i):
            s -= A[i, k] * x[k]
        x[i] = s * A[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i] * A[i, i]
        x[i] = s
        for k in range(i):
            x[k] -= A[i, k] * s


@compiled
def jacobi_eigen(A, V, w):
    """Eigenvalues ``w`` and eigenvectors ``V[:, i]`` of symmetric A by cyclic Jacobi rotations.

    Returns the largest eigenvalue.

    Reads the lower triangle; A is destroyed. Small eigenvalues come out accurate, and nothing is
    allocated.
    """
    n = A.shape[0]
    total = 0.0
    for i in range(n):
        for j in range(i):
            A[j, i] = A[i, j]
            V[i, j] = 0.0
            V[j, i] = 0.0
            total += 2.0 * A[i, j] * A[i, j]
        V[i, i] = 1.0
        total += A[i, i] * A[i, i]
    for _ in range(60):
        off = 0.0
        for i in range(n):
            for j in range(i):
                off += A[i, j] * A[i, j]
        if not off > 1e-32 * total:
            break
        for p in range(n - 1):
            for q in range(p + 1, n):
                a = A[p, q]
                if a == 0.0:
                    continue
                theta = (A[q, q] - A[p, p]) / (2.0 * a)
                t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for k in range(n):
                    x, y = A[p, k], A[q, k]
                    A[p, k] = c * x - s * y
                    A[q, k] = s * x + c * y
                for k in range(n):
                    x, y = A[k, p], A[k, q]
                    A[k, p] = c * x - s * y
                    A[k, q] = s * x + c * y
                    x, y = V[k, p], V[k, q]
                    V[k, p] = c * x - s * y
                    V[k, q] = s * x + c * y
    largest = A[0, 0]
    for i in range(n):
        w[i] = A[i, i]
        largest = max(largest, w[i])
    return largest
