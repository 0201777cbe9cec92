"""Trajectories as rows of numbers in a mission, and joined at common knots."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.foreign.curves import Curve
from rigidfleet.math import series
from rigidfleet.typing import Floats

#: Channels of a curve: x, y, z [m] and yaw [rad].
CHANNELS = 4
#: Times that differ by less are one knot [s]; greatest number of coefficients of all trajectories joined.
_SAME, _MOST = 1e-9, 10_000_000


def rows_to_curve(rows: ArrayLike) -> Curve:
    """The curve of rows of one length: a duration [s], and the coefficients of x, y, z and yaw."""
    found = np.array(rows, dtype=np.float64)
    time = np.concatenate([[0.0], np.cumsum(found[:, 0])])
    return Curve(time, found[:, 1:].reshape(len(found), CHANNELS, -1))


def curve_to_rows(curve: Curve) -> list[list[float]]:
    """Rows as `rows_to_curve` takes them."""
    flat = curve.pieces.reshape(len(curve.pieces), -1)
    return np.column_stack([np.diff(curve.time), flat]).tolist()


def joined(curves: Sequence[Curve]) -> tuple[Floats, Floats]:
    """Common knots (K + 1,) [s] of curves, and their pieces (K, N, 4, P) between them; a curve that ends stays there.

    Raises
    ------
    ValueError
        There would be too many pieces.
    """
    times = np.unique(np.concatenate([curve.time for curve in curves]))
    knots = times[np.append(True, np.diff(times) > _SAME * max(1.0, times[-1]))]
    powers = max(curve.pieces.shape[-1] for curve in curves)
    if len(knots) * len(curves) * CHANNELS * powers > _MOST:
        raise ValueError(
            f"{len(curves):,} trajectories with {len(knots):,} times in all are more than {_MOST:,} coefficients"
        )
    pieces = np.zeros((len(knots) - 1, len(curves), CHANNELS, powers))
    middle = (knots[:-1] + knots[1:]) / 2
    for i, (time, own) in enumerate(curves):
        k = np.clip(np.searchsorted(time, middle, side="right") - 1, 0, len(own) - 1)
        over = middle > time[-1]
        x = np.where(over, time[-1] - time[-2], knots[:-1] - time[k])
        found = np.moveaxis(series.of_polynomials(own[k], x, own.shape[-1]), 0, -1)
        found[over, :, 1:] = 0.0
        pieces[:, i, :, : own.shape[-1]] = found
    return knots, pieces


def jump(curve: Curve) -> tuple[Floats, Floats]:
    """Greatest jumps (3,) of position, velocity and acceleration at inner knots [m, m/s, m/s^2], and when (3,) [s]."""
    if len(curve.pieces) < 2:
        return np.zeros(3), np.zeros(3)
    position = curve.pieces[:, :3]
    ends = series.derivatives(series.of_polynomials(position, np.diff(curve.time), 3))
    starts = series.derivatives(series.of_polynomials(position, np.zeros(len(position)), 3))
    far = np.linalg.norm(starts[:, 1:] - ends[:, :-1], axis=-1)
    return far.max(axis=1), curve.time[1 + far.argmax(axis=1)]


def smoothed(curve: Curve) -> Curve:
    """The natural quintic spline through the knots of a curve: of all curves through them the one with the least jerk.

    Its fourth derivative is continuous. Full turns of yaw between two knots do not count.
    """
    from scipy.interpolate import make_interp_spline

    time, x = curve.time, curve.at(curve.time)
    x[:, 3] = np.unwrap(x[:, 3])
    zero = np.zeros(1)
    natural = [(3, zero), (4, zero)]
    pieces = np.full((len(time) - 1, CHANNELS, 6), np.nan)
    for q in range(CHANNELS if np.isfinite(x[:, 3]).all() else 3):
        found = make_interp_spline(time, x[:, q : q + 1], k=5, bc_type=(natural, natural))
        at = [found(time[:-1], nu=k)[:, 0] / math.factorial(k) for k in range(6)]
        pieces[:, q] = np.stack(at, axis=-1)
    return Curve(time, pieces)
