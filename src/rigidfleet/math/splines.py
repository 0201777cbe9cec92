"""Pieces of degree 7: smooth ways between states, and minimum-snap ways through points.

A polynomial of degree 7 meets position, velocity, acceleration and jerk at both of its ends. Among all ways between
two such states in a given time, it has the least integral of snap^2 (the Euler-Lagrange equation x^(8) = 0; Mellinger
and Kumar, Minimum snap trajectory generation and control for quadrotors, ICRA 2011).
"""

from __future__ import annotations

import numpy as np

from rigidfleet.math.piecewise import Piecewise
from rigidfleet.typing import Floats

#: Number of coefficients of a piece.
POWERS = 8


def stopping_piece(T: float, begin: Floats) -> Floats:
    """The piece (1, ..., 8) that comes to rest within T [s], from derivatives 0 to 3 ``begin`` (4, ...).

    Velocity, acceleration and jerk vanish at its end, and where it ends is free. Of all such ways it has the least
    integral of snap^2: the transversality condition x^(7)(T) = 0 leaves a velocity of degree 5.
    """
    ends = np.stack([begin[1:], np.zeros_like(begin[1:])], axis=1)
    velocity = Piecewise.hermite(np.array([0.0, T]), ends)
    place = velocity.pieces / np.arange(1.0, 7.0)
    zero = np.zeros((1, *begin.shape[1:], 1))
    return np.concatenate([zero + begin[0][None, ..., None], place, zero], axis=-1)


def minimum_snap(times: Floats, x: Floats, begin: Floats, end: Floats, *v: Floats) -> Floats:
    """Pieces of degree 7 (n, ..., 8) through points x (n + 1, ...) at times (n + 1,) [s] with the least snap.

    Of all ways through the points, with velocity, acceleration and jerk ``begin`` and ``end`` (3, ...) at the ends,
    this one has the least integral of |snap|^2. It has six continuous derivatives: at the inner points, velocity,
    acceleration and jerk follow from the continuity of the next three derivatives. They may have a velocity ``v`` each
    (...), NaN where it is free; where one is met, the sixth derivative may jump. A velocity of NaN at the end is
    free: the transversality condition x^(6) = 0 there leaves the least snap.
    """
    if np.isnan(end[0]).any():
        ends = [np.stack([np.full_like(end[0], speed), *end[1:]]) for speed in (0.0, 1.0)]
        # Linear in the velocity.
        slow, fast = (minimum_snap(times, x, begin, one, *v) for one in ends)
        h = times[-1] - times[-2]
        least, most = (way[-1, ..., 6] + 7.0 * h * way[-1, ..., 7] for way in (slow, fast))
        return slow + (least / (least - most))[..., None] * (fast - slow)
    inner, shape = len(times) - 2, x.shape[1:]
    unit = float(np.diff(times).mean())  # a natural unit of time keeps the equations well scaled
    full = np.zeros((4, inner + 2, *shape))
    powers = unit ** np.arange(4.0).reshape(-1, *(1,) * x.ndim)
    full[0], full[1:, 0], full[1:, -1] = x, begin, end
    full *= powers
    t = times / unit
    if inner > 0:
        each = np.zeros((4, inner + 2, 3, inner))
        each[1:, 1:-1] = np.eye(3 * inner).reshape(3, inner, 3, inner)
        A = _jumps_of_derivatives_4_to_6(t, each)  # (inner, 3, 3, inner): by each unknown
        b = -_jumps_of_derivatives_4_to_6(t, full)
        for k, velocity in enumerate(v):
            if not np.isnan(velocity).any():
                A[k, 2], b[k, 2] = 0.0, unit * velocity
                A[k, 2, 0, k] = 1.0
        inside = np.linalg.solve(A.reshape(3 * inner, 3 * inner), b.reshape(3 * inner, -1))
        full[1:, 1:-1] = inside.reshape(3, inner, *shape)
    return Piecewise.hermite(t, full).pieces / unit ** np.arange(POWERS)


def _jumps_of_derivatives_4_to_6(times: Floats, x: Floats) -> Floats:
    """Jumps (n - 1, 3, ...) of derivatives 4, 5 and 6 at the inner times, of degree 7 through x (4, n + 1, ...)."""
    return np.moveaxis(Piecewise.hermite(times, x).jumps(7)[4:], 0, 1)


def snap_cost(pieces: Floats, knots: Floats) -> float:
    """Integral of |snap|^2 [m^2/s^7] over pieces (n, ..., 8) between knots (n + 1,) [s]."""
    k = np.arange(4, POWERS)
    factor = k * (k - 1.0) * (k - 2.0) * (k - 3.0)
    h = np.diff(knots).reshape(-1, *(1,) * (pieces.ndim - 1))
    c = pieces[..., 4:] * factor * h ** (k - 4.0)
    weights = 1.0 / (k[:, None] + k - 7.0)
    return float(
        np.einsum("...i,ij,...j->...", c, weights, c).reshape(len(h), -1).sum(1) @ h.ravel()
    )


def least_snap_knot_times(total: float, points: Floats, *state: Floats) -> Floats:
    """Times (n + 1,) [s] from 0 to ``total`` at points (n + 1, d) that make the snap of `minimum_snap` least.

    ``state`` are its arguments after the points. From times that grow with the square root of each distance, by a
    quasi-Newton search (Richter, Bry and Roy, 2013, search the times in the same way).
    """
    from scipy.optimize import minimize

    n = len(points) - 1
    if n == 1:
        return np.array([0.0, total])

    def times(log_shares: Floats) -> Floats:
        parts = np.exp(log_shares - log_shares.max())
        return np.concatenate([[0.0], np.cumsum(parts) * (total / parts.sum())])

    def cost(shares: Floats) -> float:
        t = times(shares)
        if np.diff(t).min() < 1e-3 * total / n:
            return 1e3 * first
        return float(np.log(snap_cost(minimum_snap(t, points, *state), t) + 1e-300))

    way = np.linalg.norm(np.diff(points, axis=0), axis=1)
    start = 0.5 * np.log(np.maximum(way, 1e-3 * max(float(way.max()), 1e-9)))
    first = 1.0
    first = abs(cost(start)) + 1.0
    best_shares = minimize(cost, start, method="BFGS", options={"gtol": 1e-6})
    best = best_shares.x if cost(best_shares.x) <= cost(start) else start
    return times(best)
