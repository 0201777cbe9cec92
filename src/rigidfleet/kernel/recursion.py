"""Recursions along tables, of which filters and the solution of tridiagonal systems are made."""

from rigidfleet.kernel.compiler.jit import jit


@jit
def run_linear_recursion(s):
    """x_k += a_k x_(k-1) from the first row to the last, or x_k += a_k x_(k+1) from the last to the first.

    If there are rows y, of which M columns count, the first row is b_0 y_0, and x_k = b_k y_k + a_k x_(k-1).
    """
    x, a = s.x, s.a
    rows, columns = x.shape
    if len(s.y) > 0:
        for j in range(columns):
            x[0, j] = s.b[0] * s.y[0, s.first + j]
        for k in range(1, rows):
            for j in range(columns):
                x[k, j] = s.b[k] * s.y[k, s.first + j] + a[k] * x[k - 1, j]
        return
    for n in range(1, len(a)):
        k, before = n, n - 1
        if s.backward:
            k, before = rows - 1 - n, rows - n
        for j in range(columns):
            x[k, j] += a[k] * x[before, j]
