"""Piecewise polynomials: ways that are planned, read, fitted, judged and exported are of this one type."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from math import comb, perm
from typing import Literal, NamedTuple

import numpy as np

from rigidfleet.math import series
from rigidfleet.typing import Floats, Ints

#: Times of several curves that differ by less are one knot [s].
SAME = 1e-9
#: Weights (4, 4) of four control points, and powers of the share x of a span, of a uniform cubic B-spline.
CUBIC = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6.0


class Piecewise(NamedTuple):
    """Polynomials between knots; the first and the last one go on beyond the ends.

    Attributes
    ----------
    time : (K + 1,) increasing knots [s]
    pieces : (K, ..., P) coefficients in ascending powers of the time since the beginning of a piece
    """

    time: Floats
    pieces: Floats

    @classmethod
    def hermite(cls, time: Floats, states: Floats) -> Piecewise:
        """Through states (m, K + 1, ...) at knots (K + 1,) [s]: m derivatives, 1 to 4, are met by degree 2 m - 1."""
        return cls.of_end_states(time, states[:, :-1], states[:, 1:])

    @classmethod
    def of_end_states(cls, time: Floats, begin: Floats, end: Floats) -> Piecewise:
        """The same, from m derivatives (m, K, ...) at the beginning and at the end of each piece."""
        return cls(time, hermite_pieces(np.diff(time), begin, end))

    @classmethod
    def of_bernstein(cls, time: Floats, points: Floats) -> Piecewise:
        """From control points (K, ..., P) between knots (K + 1,) [s]."""
        powers = points.shape[-1]
        scaled = np.linalg.solve(_bernstein_matrix(powers), points[..., None])[..., 0]
        return cls(time, scaled / _piece_widths(time, points) ** np.arange(powers))

    @classmethod
    def cubic_spline(cls, time: Floats, x: Floats) -> Piecewise:
        """Through values (K + 1, ...) at knots (K + 1,) [s], with continuous acceleration (not-a-knot at the ends)."""
        from scipy.interpolate import CubicSpline

        return cls(time, np.moveaxis(np.asarray(CubicSpline(time, x).c)[::-1], 0, -1))

    @classmethod
    def b_spline(cls, control: Floats, duration: float) -> Piecewise:
        """The uniform cubic B-spline with control points (K + 3, ...) from 0 to a duration [s]."""
        spans = len(control) - 3
        windows = np.stack([control[k : k + spans] for k in range(4)], axis=-1)
        pieces = windows @ CUBIC * (spans / duration) ** np.arange(4.0)
        return cls(np.linspace(0.0, duration, spans + 1), pieces)

    def taylor_coefficients(self, t: Floats, orders: int) -> Floats:
        """Taylor coefficients (orders, T, ...) at times (T,) [s]."""
        k = piece_index(self.time, t)
        return series.polynomial_series(self.pieces[k], t - self.time[k], orders)

    def at(self, t: Floats) -> Floats:
        """Values (T, ...) at times (T,) [s]."""
        return self.taylor_coefficients(t, 1)[0]

    def states(self, t: Floats, orders: int) -> Floats:
        """Value and derivatives (orders, T, ...) at times (T,) [s]."""
        return series.taylor_derivatives(self.taylor_coefficients(t, orders))

    def piece_end_states(self, orders: int) -> tuple[Floats, Floats]:
        """Value and derivatives (orders, K, ...) at the beginning and at the end of each piece."""
        times = np.zeros(len(self.pieces)), np.diff(self.time)
        begin, end = (series.polynomial_series(self.pieces, t, orders) for t in times)
        return series.taylor_derivatives(begin), series.taylor_derivatives(end)

    def at_shares(self, shares: Floats) -> Floats:
        """Values (K, S, ...) of each piece at shares (S,) of its time."""
        after = np.diff(self.time)[:, None] * shares
        each = np.repeat(self.pieces, len(shares), axis=0)
        values = series.polynomial_series(each, after.ravel(), 1)[0]
        return values.reshape(*after.shape, *values.shape[1:])

    def derivative_curve(self) -> Piecewise:
        """Its derivative; of constants, no power is left."""
        return Piecewise(self.time, self.pieces[..., 1:] * np.arange(1.0, self.pieces.shape[-1]))

    def jumps(self, orders: int) -> Floats:
        """Jumps (orders, K - 1, ...) of value and derivatives at the inner knots."""
        end = series.polynomial_series(self.pieces[:-1], np.diff(self.time)[:-1], orders)
        begin = series.polynomial_series(self.pieces[1:], np.zeros(len(self.pieces) - 1), orders)
        return series.taylor_derivatives(begin - end)

    def shift_time(self, delay: float) -> Piecewise:
        """The same, begun later [s]."""
        return Piecewise(self.time + delay, self.pieces)

    def with_knots(self, knots: Floats, *, stays: bool = False) -> Piecewise:
        """The same on other knots (K' + 1,) [s], no interval of which contains one of its own.

        Beyond its ends the curve goes on, or ``stays`` where it begins and ends.
        """
        if np.array_equal(knots, self.time):
            return self
        middle = 0.5 * (knots[:-1] + knots[1:])
        begin = np.clip(knots[:-1], self.time[0], self.time[-1]) if stays else knots[:-1]
        k = piece_index(self.time, middle)
        pieces = expand_about(self.pieces[k], begin - self.time[k])
        if stays:
            pieces[(middle < self.time[0]) | (middle > self.time[-1]), ..., 1:] = 0.0
        return Piecewise(knots, pieces)

    def insert_knots(self, times: Floats) -> Piecewise:
        """The same with further knots at times that lie inside."""
        return self.with_knots(refine_knots(self.time, times))

    def slice_pieces(self, first: int, last: int) -> Piecewise:
        """The pieces from a first one to before a last one."""
        pieces = self.pieces[first:last]
        return Piecewise(self.time[first : first + len(pieces) + 1], pieces)

    def between(self, start: float, end: float) -> Piecewise:
        """The part from a start to an end [s] within it."""
        inside = self.time[(self.time > start) & (self.time < end)]
        return self.with_knots(np.concatenate([[start], inside, [end]]))

    def start_from(self, state: Floats, fade: float) -> Piecewise:
        """The same from another state, derivatives (4, ...), at its first knot.

        What these differ fades within a time [s] along a polynomial of degree 7, so that three derivatives stay as
        continuous as they are.
        """
        off = state - self.states(self.time[:1], 4)[:, 0]
        if not off.any():
            return self
        ends = np.stack([off, np.zeros_like(off)], axis=1)
        extra = Piecewise.hermite(self.time[0] + np.array([0.0, fade]), ends)
        moved = self.insert_knots(extra.time)
        pieces = pad(moved.pieces, extra.pieces.shape[-1])
        early = moved.time[:-1] < extra.time[1]
        pieces[early] += pad(extra.with_knots(moved.time).pieces[early], pieces.shape[-1])
        return Piecewise(moved.time, pieces)

    def stack(self, other: Piecewise) -> Piecewise:
        """The channels (..., Q, P) of two curves on the same knots as those of one."""
        powers = max(self.pieces.shape[-1], other.pieces.shape[-1])
        both = [pad(curve.pieces, powers) for curve in (self, other)]
        return Piecewise(self.time, np.concatenate(both, axis=-2))

    def control_points(self) -> Floats:
        """Control points (K, ..., P), in whose hull each piece lies."""
        powers = self.pieces.shape[-1]
        scaled = self.pieces * _piece_widths(self.time, self.pieces) ** np.arange(powers)
        return scaled @ _bernstein_matrix(powers).T


def hermite_pieces(h: Floats, begin: Floats, end: Floats) -> Floats:
    """Pieces (K, ..., 2 m) of lengths (K,) [s] from m derivatives (m, K, ...) at their beginnings and at their ends."""
    m = len(begin)
    h = h.reshape(-1, *(1,) * (begin.ndim - 2))
    scale = np.stack([h**k for k in range(2 * m)])
    start = series.series_by_derivatives(begin) * scale[:m]  # coefficients in u = (t - t0) / h
    reached = [sum(start[k] * float(perm(k, j)) for k in range(j, m)) for j in range(m)]
    rest = np.tensordot(_hermite_end_matrix(m), end * scale[:m] - np.stack(reached), 1)
    return np.moveaxis(np.concatenate([start, rest]) / scale, 0, -1)


def piece_index(knots: Floats, t: Floats, side: Literal["left", "right"] = "right") -> Ints:
    """Interval (T,) between knots (K + 1,) in which times (T,) are; beyond the ends, the first and the last.

    At a knot, it is the one after it ("right") or before it ("left").
    """
    after = np.searchsorted(knots, t, side=side) - 1
    return np.minimum(np.maximum(after, 0), len(knots) - 2)  # `clip` takes far longer


def refine_knots(knots: Floats, times: Floats, apart: float = 0.0) -> Floats:
    """Knots with further ones at times that lie inside, further ``apart`` [s] from any of them."""
    inside = times[(times > knots[0]) & (times < knots[-1])]
    k = piece_index(knots, inside)
    far = np.minimum(inside - knots[k], knots[k + 1] - inside)
    return np.union1d(knots, inside[far > apart])


def common_knots(curves: Sequence[Piecewise]) -> Floats:
    """Knots (K + 1,) [s] of several curves together; those nearer to each other than `SAME` are one."""
    times = np.unique(np.concatenate([curve.time for curve in curves]))
    knots = times[np.append(True, np.diff(times) > SAME)]
    knots[-1] = times[-1]
    return knots


def stack_ways(curves: Sequence[Piecewise], most: float = np.inf) -> Piecewise:
    """N curves as one (K, N, ..., P) on their `common_knots`; each stays where it begins and ends.

    Raises
    ------
    ValueError
        There are more than ``most`` coefficients.
    """
    knots = common_knots(curves)
    powers = max(curve.pieces.shape[-1] for curve in curves)
    if len(knots) * sum(curve.pieces[0, ..., 0].size for curve in curves) * powers > most:
        raise ValueError(
            f"{len(curves):,} trajectories with {len(knots):,} times in all are more than {most:,} coefficients"
        )
    inner = curves[0].pieces.shape[1:-1]
    # Coefficients of one power lie side by side in memory: arithmetic on long rows is fast.
    rows = np.zeros((powers, len(knots) - 1, len(curves), *inner))
    for i, curve in enumerate(curves):
        pieces = curve.with_knots(knots, stays=True).pieces
        rows[: pieces.shape[-1], :, i] = np.moveaxis(pieces, -1, 0)
    return Piecewise(knots, np.moveaxis(rows, 0, -1))


def concatenate_curves(curves: Sequence[Piecewise]) -> Piecewise:
    """Curves that begin at 0 [s], one after the other."""
    ends = np.cumsum([0.0, *(float(curve.time[-1]) for curve in curves)])
    times = [curve.time[1:] + t for curve, t in zip(curves, ends, strict=False)]
    powers = max(curve.pieces.shape[-1] for curve in curves)
    pieces = [pad(curve.pieces, powers) for curve in curves]
    return Piecewise(np.concatenate([[0.0], *times]), np.concatenate(pieces))


def pad(pieces: Floats, powers: int) -> Floats:
    """Pieces (..., P) with zeros up to so many powers."""
    lacking = powers - pieces.shape[-1]
    if lacking <= 0:
        return pieces.copy(order="K")
    return np.pad(pieces, [(0, 0)] * (pieces.ndim - 1) + [(0, lacking)])


def expand_about(pieces: Floats, x: Floats) -> Floats:
    """Coefficients (K, ..., P) of the same polynomials in powers of the time since x (K,) [s]."""
    return np.moveaxis(series.polynomial_series(pieces, x, pieces.shape[-1]), 0, -1)


def _piece_widths(time: Floats, pieces: Floats) -> Floats:
    return np.diff(time).reshape(-1, *(1,) * (pieces.ndim - 1))


@cache
def _hermite_end_matrix(m: int) -> Floats:
    """From the m derivatives that lack at the end of a piece of unit length to its m highest coefficients.

    It is the inverse of the rows k! / (k - j)! of u^k at u = 1, whose entries are whole sixths for m up to 4.
    """
    rows = [[perm(k, j) for k in range(m, 2 * m)] for j in range(m)]
    return np.round(6.0 * np.linalg.inv(np.array(rows, dtype=float))) / 6.0


@cache
def _bernstein_matrix(powers: int) -> Floats:
    """The matrix of control points b_i = sum_k C(i, k) / C(P - 1, k) a_k of a piece on [0, 1]."""
    return np.array(
        [[comb(i, k) / comb(powers - 1, k) for k in range(powers)] for i in range(powers)]
    )
