"""Dense linear algebra without allocation, for the small matrices of one formation."""

import math

from rigidfleet.kernel.compiler.jit import jit


@jit
def copy(a, out):
    """Copy a into out, both two-dimensional."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i, j] = a[i, j]


@jit
def copy_vector(a, out):
    """Copy a into out, both one-dimensional."""
    for i in range(a.shape[0]):
        out[i] = a[i]


@jit
def where_positive(x, a, b):
    """Return a if x > 0, else b."""
    return a if x > 0.0 else b


@jit
def is_known_positive(x):
    """Whether x > 0; straight-line code cannot know and assumes that it is not (`tracer`)."""
    return x > 0.0


@jit
def cholesky(A):
    """Factor the lower triangle of A (n, n) = L D L^T in place; the diagonal keeps 1 / D_jj.

    Returns False, and leaves A unfinished, if A is not positive definite.
    """
    # In tiles of two rows and two columns: four sums share their loads, which saves a third of the time.
    n = A.shape[0]
    odd = n % 2
    if odd:
        if not A[0, 0] > 0.0:
            return False
        A[0, 0] = 1.0 / A[0, 0]
    for j in range(odd, n, 2):
        p, e, q = A[j, j], A[j + 1, j], A[j + 1, j + 1]
        for k in range(j):
            x, y = A[j, k] * A[k, k], A[j + 1, k] * A[k, k]
            p -= x * A[j, k]
            e -= x * A[j + 1, k]
            q -= y * A[j + 1, k]
            A[j, k], A[j + 1, k] = x, y
        inverse = 1.0 / p
        l = e * inverse
        q -= l * e
        if not (p > 0.0 and q > 0.0):
            return False
        A[j, j], A[j + 1, j], A[j + 1, j + 1] = inverse, l, 1.0 / q
        for i in range(j + 2, n, 2):  # L D; D is divided out when rows i, i + 1 are processed
            s, t, u, v = A[i, j], A[i, j + 1], A[i + 1, j], A[i + 1, j + 1]
            for k in range(j):
                s -= A[i, k] * A[j, k]
                t -= A[i, k] * A[j + 1, k]
                u -= A[i + 1, k] * A[j, k]
                v -= A[i + 1, k] * A[j + 1, k]
            A[i, j], A[i, j + 1] = s, t - s * l
            A[i + 1, j], A[i + 1, j + 1] = u, v - u * l
    return True


@jit
def cholesky_solve(factor, x):
    """Solve L D L^T x = x in place, ``factor`` as left by `cholesky`; two unknowns at a time."""
    n = factor.shape[0]
    odd = n % 2
    for i in range(odd, n, 2):
        s, t = x[i], x[i + 1]
        for k in range(i):
            s -= factor[i, k] * x[k]
            t -= factor[i + 1, k] * x[k]
        x[i], x[i + 1] = s, t - factor[i + 1, i] * s
    for i in range(n):
        x[i] *= factor[i, i]
    for i in range(n - 2, odd - 1, -2):
        t = x[i + 1]
        s = x[i] - factor[i + 1, i] * t
        x[i] = s
        for k in range(i):
            x[k] -= factor[i, k] * s + factor[i + 1, k] * t


@jit
def jacobi_eigen(A, V, w):
    """Eigenvalues ``w`` and eigenvectors ``V[:, i]`` of symmetric A by cyclic Jacobi rotations.

    Returns the largest eigenvalue.

    Reads the lower triangle; A is destroyed. Small eigenvalues are accurate, and nothing is
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
                # Zero but for rounding, which would keep `off` above its bound: all sweeps would be run.
                A[p, q] = 0.0
                A[q, p] = 0.0
    largest = A[0, 0]
    for i in range(n):
        w[i] = A[i, i]
        largest = max(largest, w[i])
    return largest
