"""Filters that make gusts and sensor noise of white samples: shaping filters, and splines through samples.

Shaping filters are discretised exactly: from the first sample on, samples have the covariances of the continuous
process for any step. The input is white standard-normal samples, so that the caller controls the seeds.
"""

from __future__ import annotations

import math

import numpy as np

from rigidfleet.typing import Floats

#: Limit of the pivots of `spline_coefficients`, and the number of them that differ from it.
_PIVOT, _EARLY = 2.0 - math.sqrt(3.0), 16


def gauss_markov(white: Floats, step: float, tau: float) -> Floats:
    """Gauss-Markov process (K, ...) of unit variance and autocorrelation exp(-|t| / tau).

    x_{k+1} = a x_k + sqrt(1 - a^2) e_k with a = exp(-step / tau), stationary from the start (Uhlenbeck and
    Ornstein, 1930). Parameters: white samples e (K, ...); their step and tau [s].
    """
    x = white * math.sqrt(-math.expm1(-2.0 * step / tau))
    x[0] = white[0]
    return _recursion_in_place(x, math.exp(-step / tau))


def dryden_gust(white: Floats, step: float, tau: float) -> Floats:
    """Dryden's transverse process (K, ...), unit variance, autocorrelation exp(-s) (1 - s / 2), s = |t| / tau.

    Its spectrum is that of (1 + sqrt(3) tau s) / (1 + tau s)^2, the lateral and vertical filter of MIL-F-8785C. In
    partial fractions it is y = sqrt(3) z1 + (1 - sqrt(3)) z2 with tau dz1/dt = -z1 + e, tau dz2/dt = -z2 + z1,
    whose transition matrix exp(-s) [[1, 0], [s, 1]] and covariances are known in closed form.

    Parameters: white samples (K, 2, ...), two for each sample; their step and tau [s].
    """
    s = step / tau
    a = math.exp(-s)
    root, low, rest = _noise_covariance_root(s)
    first, second = white[:, 0], white[:, 1]
    z1, z2 = root * first, low * first
    z2 += rest * second
    z1[0], z2[0] = first[0], 0.5 * (first[0] + second[0])
    z1 = _recursion_in_place(z1, a)
    z2[1:] += a * s * z1[:-1]
    z2 = _recursion_in_place(z2, a)
    z1 *= math.sqrt(3.0)
    z2 *= 1.0 - math.sqrt(3.0)
    z1 += z2
    z1 /= math.sqrt(2.0)
    return z1


def _noise_covariance_root(s: float) -> tuple[float, float, float]:
    """Shares of the first white sample in z1 and z2, and of the second one in z2: the lower root of P - A P A^T.

    The stationary covariances are P = [[1, 1/2], [1/2, 1/2]]. The entries are incomplete gamma functions: for a short
    step, differences would cancel.
    """
    q11, q12, q22 = (w * _incomplete_gamma(n, 2.0 * s) for n, w in ((1, 1.0), (2, 0.5), (3, 0.5)))
    root = math.sqrt(q11)
    low = q12 / root
    return root, low, math.sqrt(q22 - low**2)


def _incomplete_gamma(n: int, x: float) -> float:
    """The regularised lower incomplete gamma function P(n, x) = exp(-x) sum_{k >= n} x^k / k! of a whole number n."""
    head, tail, term = 0.0, 0.0, math.exp(-x)
    for k in range(n):
        head, term = head + term, term * x / (k + 1)
    if x > n:
        return 1.0 - head
    while term > 1e-17 * tail:
        n += 1
        tail, term = tail + term, term * x / n
    return tail


def _recursion_in_place(x: Floats, a: float) -> Floats:
    """Solve z_{k+1} = a z_k + x_{k+1} from z_0 = x_0; x and z (K, ...)."""
    from rigidfleet.kernel.engine import native  # loads the compiled kernel

    z = np.ascontiguousarray(x)
    native.run_linear_recursion(z.reshape(len(z), -1), np.full(len(z), a))
    return z


def spline_coefficients(samples: Floats, scale: float = 1.0, part: int | None = None) -> Floats:
    """Coefficients (K + 2, ...) of the natural cubic B-spline through samples (K, ...), K >= 2, on even knots.

    The samples are multiplied by a ``scale``; if a ``part`` is given, they are samples[:, part]. Coefficients c solve
    the tridiagonal system c_{k-1} + 4 c_k + c_{k+1} = 6 y_k; both ends are samples.
    """
    from rigidfleet.kernel.engine import native

    y = samples if part is None else samples[:, part]
    n, shape = len(y), y.shape[1:]
    table = np.empty((n + 2, math.prod(shape)))
    c, (factors, shares) = table[1:-1], _tridiagonal_factors(n)
    np.multiply((scale * shares)[:, None], y.reshape(n, -1), out=c)
    native.run_linear_recursion(c, factors)
    native.run_linear_recursion(c, factors, backward=True)
    table[0], table[-1] = 2.0 * c[0] - c[1], 2.0 * c[-1] - c[-2]
    return table.reshape(n + 2, *shape)


def _tridiagonal_factors(n: int) -> tuple[Floats, Floats]:
    """Factors (n,) of the row before in either sweep of the elimination, and shares (n,) of the samples.

    Both ends are known: their factors are zero, and their shares one.
    """
    factors, shares = np.zeros(n), np.ones(n)
    factors[1:-1] = -_PIVOT
    pivot = 0.0
    for k in range(1, min(1 + _EARLY, n - 1)):
        pivot = 1.0 / (4.0 - pivot)
        factors[k] = -pivot
    shares[1:-1] = -6.0 * factors[1:-1]
    return factors, shares
