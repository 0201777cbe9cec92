"""Truncated Taylor series in time: exact derivatives of products, rotations and angles.

A series of order n at a time t is the array of x(t), x'(t), x''(t)/2, ..., x^(n)(t)/n!: axis 0 counts the powers, and
all other axes are those of x. Sums of series are sums of arrays; the functions here do the rest. The method is
automatic differentiation by Taylor arithmetic (Griewank, Walther, Evaluating Derivatives, 2nd ed., chapter 13).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from rigidfleet.math import attitude as att
from rigidfleet.typing import Floats

#: Up to this squared angle, Stumpff functions are summed as series, with this number of terms: exact to rounding.
_SERIES, _TERMS = 16.0, 16
#: 1/k!
_RECIPROCALS = np.array([1.0 / math.factorial(k) for k in range(64)])
#: k!
_FACTORIALS = np.array([float(math.factorial(k)) for k in range(64)])


def taylor_derivatives(x: Floats) -> Floats:
    """Derivatives 0 to n (n + 1, ...) of a series; factorials are multiplied in."""
    return x * _factorial_column(x)


def series_by_derivatives(x: Floats) -> Floats:
    """The series of which `taylor_derivatives` are ``x`` (n + 1, ...)."""
    return x / _factorial_column(x)


def _factorial_column(x: Floats) -> Floats:
    return _FACTORIALS[: len(x)].reshape(-1, *(1,) * (x.ndim - 1))


def rate_series(x: Floats) -> Floats:
    """The series of x', one order shorter."""
    return x[1:] * np.arange(1.0, len(x)).reshape(-1, *(1,) * (x.ndim - 1))


def polynomial_series(coefficients: Floats, x: Floats, orders: int) -> Floats:
    """Series (orders, K, ...) of polynomials with coefficients (K, ..., P), ascending, at x (K,).

    In memory, x is the last axis: arithmetic on long rows is fast.
    """
    coefficients = np.asarray(coefficients, dtype=float)
    inner = range(1, coefficients.ndim - 1)
    c = list(np.ascontiguousarray(coefficients.transpose(-1, *inner, 0)))
    powers = len(c)
    for order in range(min(orders, powers)):  # repeated synthetic division by (t - x)
        for k in range(powers - 2, order - 1, -1):
            c[k] = c[k] + x * c[k + 1]
    full = np.zeros((orders, *np.broadcast_shapes(x.shape, c[0].shape)))
    for order, values in enumerate(c[:orders]):
        full[order] = values
    return full.transpose(0, -1, *inner)


def product(
    a: Floats, b: Floats, multiply: Callable[[Floats, Floats], Floats] = np.multiply
) -> Floats:
    """Series of the product of two series of the same order, by any bilinear ``multiply``, such as `numpy.matmul`."""
    n = min(len(a), len(b))
    total = multiply(a[0], b[:n])
    for i in range(1, n):
        total[i:] += multiply(a[i], b[: n - i])
    return total


def rotation_series(phi: Floats, orders: int | None = None) -> Floats:
    """Series (n, ..., 3, 3) of R = Exp(phi), body to world, of rotation vectors phi (n, ..., 3) [rad].

    With fewer ``orders``, the others are left out, and the numbers are the same.

    R = c_0(u) + c_1(u) [phi x] + c_2(u) phi phi^T with u = |phi|^2 and the Stumpff functions c_k, which are analytic in
    u, so that no angle is special. Times are the last axis in memory: arithmetic on long rows is fast.
    """
    count = 2 * len(phi) + 1  # of functions; two fewer with each order
    x = np.ascontiguousarray(phi[:orders].transpose(0, -1, *range(1, phi.ndim - 1)))
    c0, c1, c2 = _stumpff_of_taylor_series(product(x, x).sum(axis=1), count)
    S = product(c1[:, None], x)
    P = product(product(c2[:, None], x)[:, [0, 1, 2, 0, 0, 1]], x[:, [0, 1, 2, 1, 2, 2]])
    P[:, :3] += c0[:, None]
    R = np.empty((len(x), 3, 3, *x.shape[2:]))
    for k in range(3):
        R[:, k, k] = P[:, k]
    for k, (i, j, sign) in enumerate(((0, 1, -1.0), (0, 2, 1.0), (1, 2, -1.0))):
        R[:, i, j] = P[:, 3 + k] + sign * S[:, 2 - k]
        R[:, j, i] = P[:, 3 + k] - sign * S[:, 2 - k]
    return R.transpose(0, *range(3, R.ndim), 1, 2)


def rotation_vector_taylor(R: Floats) -> Floats:
    """Series (n, ..., 3) of rotation vectors phi [rad], R = Exp(phi), of rotations (n, ..., 3, 3); |phi| < pi.

    The inverse of `rotation_series`, order by order: coefficient k of R contains that of phi as R [J_r(phi) phi_k x],
    and otherwise coefficients below k.
    """
    phi = np.zeros(R.shape[:-1])
    phi[0] = att.rotation_vector_from_dcm(np.swapaxes(R[0], -1, -2))
    for k in range(1, len(R) if R[1:].any() else 1):  # most bodies do not turn
        lacking = R[k] - rotation_series(phi[: k + 1])[k] if k > 1 else R[k]  # nothing moves yet
        phi[k] = att.rotation_vector_rate(phi[0], _vee_vectors(np.swapaxes(R[0], -1, -2) @ lacking))
    return phi


def rotation_series_from_rates(R: Floats, omega: Floats) -> Floats:
    """Series (n + 1, ..., 3, 3) of a rotation that is R (..., 3, 3), body to world, at body rates omega (n, ..., 3)."""
    W, terms = cross_matrix(omega), [R]
    for k in range(len(omega)):  # R' = R [omega x]
        terms.append(np.sum([terms[i] @ W[k - i] for i in range(k + 1)], axis=0) / (k + 1))
    return np.stack(terms)


def body_rates_series(R: Floats) -> Floats:
    """Series (n - 1, ..., 3) of the rates [rad/s] in body axes of rotations R (n, ..., 3, 3), body to world."""
    return _vee_vectors(product(np.swapaxes(R, -1, -2)[:-1], rate_series(R), np.matmul))


def angle_series(y: Floats, x: Floats) -> Floats:
    """Series of atan2(y, x) [rad]; derivatives where y and x vanish are zero."""
    angles = np.zeros_like(x)
    angles[0] = np.arctan2(y[0], x[0])
    size = x[0] ** 2 + y[0] ** 2
    safe = np.where(size > 0.0, size, np.inf)
    turned = product(x[:-1], rate_series(y)) - product(y[:-1], rate_series(x))
    square = product(x, x) + product(y, y)
    rates = np.zeros_like(turned)  # angle' (x^2 + y^2) = x y' - y x'
    for k in range(len(turned)):
        rates[k] = (turned[k] - sum(rates[i] * square[k - i] for i in range(k))) / safe
        angles[k + 1] = rates[k] / (k + 1)
    return angles


def cross_matrix(a: Floats) -> Floats:
    """Matrices (..., 3, 3) of the cross products a x b with vectors a (..., 3)."""
    W = np.zeros((*a.shape, 3))
    W[..., 2, 1], W[..., 0, 2], W[..., 1, 0] = a[..., 0], a[..., 1], a[..., 2]
    return W - np.swapaxes(W, -1, -2)


def _vee_vectors(W: Floats) -> Floats:
    """Vectors (..., 3) of the antisymmetric parts of matrices (..., 3, 3)."""
    return 0.5 * np.stack(
        [W[..., 2, 1] - W[..., 1, 2], W[..., 0, 2] - W[..., 2, 0], W[..., 1, 0] - W[..., 0, 1]],
        axis=-1,
    )


def _stumpff(u: Floats, count: int) -> Floats:
    """Stumpff functions c_0 to c_(count - 1) (count, ...) of u >= 0: c_k = sum_i (-u)^i / (2 i + k)!."""
    values = np.zeros((count, *u.shape))
    near = u < _SERIES
    small = np.where(near, u, 0.0)
    total, column = values[count - 2 :], (2, *(1,) * u.ndim)
    for i in range(_TERMS, -1, -1):  # Horner, of both
        np.multiply(total, small, out=total)
        first = 2 * i + count - 2
        np.subtract(_RECIPROCALS[first : first + 2].reshape(column), total, out=total)
    for k in range(count - 3, -1, -1):  # c_k = 1/k! - u c_(k + 2), downwards for small u
        values[k] = _RECIPROCALS[k] - small * values[k + 2]
    if near.all():
        return values
    large = np.where(near, _SERIES, u)
    root = np.sqrt(large)
    closed = [np.cos(root), np.sin(root) / root]
    for k in range(2, count):  # upwards for large u
        closed.append((_RECIPROCALS[k - 2] - closed[k - 2]) / large)
    return np.where(near, values, np.stack(closed))


def _stumpff_of_taylor_series(u: Floats, count: int) -> tuple[Floats, Floats, Floats]:
    """Series (n, ...) of c_0(u), c_1(u) and c_2(u) of a series u (n, ...), by so many Stumpff functions.

    c_k' = (k c_(k+2) - c_(k+1)) / 2 gives each order from the order before of the following functions.
    """
    n, slope = len(u), rate_series(u)
    orders = [_stumpff(u[0], count)]
    chain: list[Floats] = []  # derivatives by u
    for order in range(1, n):
        c = orders[-1]
        k = np.arange(len(c) - 2.0).reshape(-1, *(1,) * (c.ndim - 1))
        chain.append(0.5 * (k * c[2:] - c[1:-1]))
        total = slope[0] * chain[-1]
        for i in range(1, order):
            total += slope[i] * chain[order - 1 - i][: len(total)]
        orders.append(total / order)
    c0, c1, c2 = (np.array([c[k] for c in orders]) for k in range(3))
    return c0, c1, c2
