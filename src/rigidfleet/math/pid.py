"""Gains of the constraint's PID stabilisation (Baumgarte) in Eq. (12).

If the constraints are independent and their references constant, each error c [m] obeys

    c''' + 2 alpha c'' + beta^2 c' + gamma c = 0,      dI/dt = c,

with alpha, beta [1/s] and gamma [1/s^3]. The paper prints no gains.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigidfleet.typing import Floats


def is_stable(alpha: float, beta: float, gamma: float) -> bool:
    """Whether every error decays: alpha, beta > 0, gamma >= 0 and 2 alpha beta^2 > gamma (Hurwitz)."""
    return bool(alpha > 0 and beta > 0 and gamma >= 0 and 2 * alpha * beta**2 > gamma)


def triple_pole(p: float) -> tuple[float, float, float]:
    """Gains (alpha, beta, gamma) of Eq. (12) that put all three poles at -p [1/s], p > 0.

    From rest, c/c(0) = e^-x (1 + x - x^2) with x = p t: the fastest response without oscillation. It
    overshoots by 5 e^-3 = 24.9 %; overshoot is inevitable, because the integral of c must return to zero.
    """
    if not (math.isfinite(p) and p > 0):
        raise ValueError(f"the pole's rate p must be positive [1/s], not {p}")
    return 1.5 * p, math.sqrt(3.0) * p, p**3


def poles(alpha: float, beta: float, gamma: float) -> NDArray[np.complex128]:
    """Poles [1/s] of the error, by increasing real part: three, or two if gamma = 0.

    Poles so close that rounding of the gains could have split them are returned as one repeated pole.
    """
    polynomial = np.array([1.0, 2 * alpha, beta**2, gamma])
    if gamma == 0:
        polynomial = polynomial[:3]
    s = np.roots(polynomial).astype(complex)
    candidates = [np.full_like(s, s.mean().real)]
    if len(s) == 3:
        i = min(range(3), key=lambda i: abs(s[i - 1] - s[i - 2]))  # the odd one out
        double = 0.5 * (s[i - 1] + s[i - 2]).real
        candidates.append(np.array([s[i].real, double, double], dtype=complex))
    for merged in candidates:
        if np.allclose(np.poly(merged), polynomial, rtol=1e-14, atol=0.0):
            return np.sort_complex(merged)
    return np.sort_complex(s)


def error_response(
    alpha: float,
    beta: float,
    gamma: float,
    c0: ArrayLike,
    cdot0: ArrayLike,
    I0: ArrayLike,
    t: ArrayLike,
) -> tuple[Floats, Floats, Floats]:
    """Error c [m], its rate [m/s] and its integral I [m s] at times t [s] after c0, cdot0 and I0.

    This is the matrix exponential of the error's equation, exact for repeated poles, for gamma = 0 and for
    unstable gains. t has any shape; c0, cdot0 and I0 broadcast against each other (for example one entry
    per edge). The results have the shape of t followed by theirs.
    """
    c0, cdot0, I0 = np.broadcast_arrays(*(np.asarray(z, dtype=float) for z in (c0, cdot0, I0)))
    t = np.asarray(t, dtype=float)
    p, A = _companion(alpha, beta, gamma)
    z0 = np.stack([p * I0, c0, cdot0 / p])
    z = np.tensordot(matrix_exponential(A, p * t), z0, axes=1)
    integral, c, c_dot = np.moveaxis(z, t.ndim, 0)
    return c, p * c_dot, integral / p


def settling_time(alpha: float, beta: float, gamma: float, tolerance: float = 0.02) -> float:
    """Time [s] after which |c| stays below ``tolerance`` of an initial c(0) at rest with I = 0.

    Raises ValueError if the gains are unstable or oscillate for more than a thousand cycles, or the
    tolerance is not between 0 and 1.
    """
    if not 0.0 < tolerance < 1.0:
        raise ValueError(f"tolerance must lie between 0 and 1, not be {tolerance}")
    t = _time_grid(alpha, beta, gamma, tolerance)
    while True:
        c = error_response(alpha, beta, gamma, 1.0, 0.0, 0.0, t)[0]
        k = np.flatnonzero(np.abs(c) > tolerance)[-1]
        if t[k + 1] - t[k] <= 1e-13 * t[k + 1]:
            return float(t[k + 1])
        t = np.linspace(t[k], t[k + 1], 65)


def overshoot(alpha: float, beta: float, gamma: float) -> float:
    """Overshoot of c past zero, as a fraction of an initial c(0) at rest with I = 0; 0 if there is none.

    Raises ValueError as `settling_time` does.
    """
    t = _time_grid(alpha, beta, gamma, 1e-9)
    least = 0.0
    for _ in range(6):
        c = error_response(alpha, beta, gamma, 1.0, 0.0, 0.0, t)[0]
        k = int(np.argmin(c))
        least = min(least, float(c[k]))
        t = np.linspace(t[max(k - 1, 0)], t[min(k + 1, len(t) - 1)], 65)
    return -least


def _companion(alpha: float, beta: float, gamma: float) -> tuple[float, Floats]:
    """Rate p [1/s] and matrix A: d/d(pt) (p I, c, c'/p) = A (p I, c, c'/p), entries of order one."""
    p = max(abs(alpha), abs(beta), abs(gamma) ** (1 / 3)) or 1.0
    return p, np.array([[0, 1, 0], [0, 0, 1], [-gamma / p**3, -((beta / p) ** 2), -2 * alpha / p]])


def matrix_exponential(A: Floats, x: Floats) -> Floats:
    """e^(A x) (..., n, n) for A (..., n, n) and x (...): a Taylor series for |A x| <= 1/2, then repeated doubling.

    For many small matrices, much faster than `scipy.linalg.expm`, which takes long to load, too. The doubling uses
    e^(A x) - 1: squaring a matrix near 1 doubles its rounding error each time.
    """
    with np.errstate(divide="ignore"):
        doublings = np.log2(2.0 * np.linalg.norm(A, axis=(-2, -1)) * np.abs(x))
    doublings = np.ceil(doublings).clip(min=0.0)
    step = A * (x * 0.5**doublings)[..., None, None]
    D = term = step
    for k in range(2, 17):
        term = term @ step / k
        D = D + term
    for k in range(int(doublings.max(initial=0.0))):
        more = doublings > k
        d = D[more]
        D[more] = 2.0 * d + d @ d
    return np.eye(A.shape[-1]) + D


def _time_grid(alpha: float, beta: float, gamma: float, tolerance: float) -> Floats:
    """Times from 0 until |c| stays below tolerance, dense enough to resolve every oscillation."""
    if not is_stable(alpha, beta, gamma):
        raise ValueError(
            f"alpha = {alpha}, beta = {beta}, gamma = {gamma} are unstable: choose"
            " alpha, beta > 0 and 0 <= gamma < 2 alpha beta^2"
        )
    p, A = _companion(alpha, beta, gamma)
    first = 1 if gamma == 0 else 0  # without gamma, the integral does not enter the dynamics
    A = A[first:, first:]
    one = np.eye(len(A))
    z0 = one[1 - first]
    # V = z^T X z with A^T X + X A = -1 only decreases, and c^2 <= V / (smallest V at which c = 1).
    X = np.linalg.solve(np.kron(A.T, one) + np.kron(one, A.T), -one.ravel()).reshape(A.shape)
    bound = np.linalg.inv(X)[1 - first, 1 - first]
    x = 1.0
    while bound * (z := matrix_exponential(A, np.array(x)) @ z0) @ X @ z > tolerance**2:
        x *= 2.0
    s = poles(alpha, beta, gamma)
    swings = np.abs(s.imag).max() * x / p / math.pi
    if swings > 2000:
        raise ValueError(
            f"alpha = {alpha}, beta = {beta}, gamma = {gamma} oscillate for more than a thousand cycles:"
            " raise alpha, or lower gamma further below 2 alpha beta^2"
        )
    smooth = np.geomspace(1e-3 / np.abs(s).max(), x / p, 600)
    return np.union1d(smooth, np.linspace(0.0, x / p, 2 + math.ceil(16 * swings)))
