"""Recursions along tables, of which filters and the solution of tridiagonal systems are made."""

from rigidfleet.kernel.compiler.jit import jit


@jit
def run_linear_recursion(s):
    """x_k += a_k x_(k-1) from the first row to the last, or x_k += a_k x_(k+1) from the last to the first."""
    x, a = s.x, s.a
    rows, columns = x.shape
    for n in range(1, len(a)):
        k, before = n, n - 1
        if s.backward:
            k, before = rows - 1 - n, rows - n
        for j in range(columns):
            x[k, j] += a[k] * x[before, j]
