"""Ways of vehicles as polynomials: what files of other programs are read as, and written from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rigidfleet.math import series, splines
from rigidfleet.typing import Floats

#: Names of the channels of a curve.
NAMES = ("x", "y", "z", "yaw")


class Curve(NamedTuple):
    """The way of one vehicle, piece by piece.

    Attributes
    ----------
    time : (n + 1,) ends of the pieces [s]
    pieces : (n, 4, P) coefficients of x, y, z [m] and yaw [rad] in ascending powers of the time since the beginning of
        a piece; yaw is NaN where a format does not have it
    """

    time: Floats
    pieces: Floats

    def at(self, t: Floats) -> Floats:
        """Position [m] and yaw [rad] (K, 4) at times (K,) [s]; the first and last piece go on beyond the ends."""
        k = np.clip(np.searchsorted(self.time, t, side="right") - 1, 0, len(self.pieces) - 1)
        return values(self.pieces[k], t - self.time[k])

    def later(self, start: float) -> Curve:
        """The same way, begun later [s]."""
        return Curve(self.time + start, self.pieces)

    def cut(self, start: float, end: float) -> Curve:
        """The part of the way from a start to an end [s] within it."""
        first = int(np.searchsorted(self.time, start, side="right")) - 1
        last = int(np.searchsorted(self.time, end, side="left"))
        time = np.concatenate([[start], self.time[first + 1 : last], [end]])
        pieces = self.pieces[first:last].copy()
        moved = series.of_polynomials(
            pieces[:1], np.array([start - self.time[first]]), pieces.shape[2]
        )
        pieces[:1] = np.moveaxis(moved, 0, -1)
        return Curve(time, pieces)


def values(pieces: Floats, after: Floats) -> Floats:
    """Values (K, 4) of pieces (K or 1, 4, P) at times (K,) [s] since they began."""
    found = np.zeros((len(after), pieces.shape[1]))
    for k in range(pieces.shape[2] - 1, -1, -1):  # Horner
        found = found * after[:, None] + pieces[:, :, k]
    return found


def through(time: Floats, states: Floats, yaw: Floats | None = None) -> Curve:
    """The way through states (m, K, 3) at times (K,) [s]: m derivatives of position are met, 4, 2, or 1 (lines).

    Yaw (2, K) [rad, rad/s] or (1, K) is met in the same way; without it, yaw is NaN.
    """
    if len(time) == 1:
        time, states = np.append(time, time + 1.0), np.repeat(states, 2, axis=1)
        states[1:] = 0.0
        yaw = None if yaw is None else np.repeat(yaw, 2, axis=1) * [[1.0], [0.0]][: len(yaw)]

    def between(x: Floats) -> Floats:
        h = np.diff(time)
        if len(x) == 1:
            slope = np.diff(x[0], axis=0) / h[:, None]
            return np.stack([x[0][:-1], slope], axis=-1)
        return splines.hermite(h, x[:, :-1], x[:, 1:])

    angle = np.full((len(time) - 1, 1, 1), np.nan) if yaw is None else between(yaw[..., None])
    return Curve(time, with_yaw(between(states), angle))


def with_yaw(position: Floats, yaw: Floats) -> Floats:
    """Pieces (n, 4, P) of positions (n, 3, Q) and yaws (n, 1, R)."""
    powers = max(position.shape[2], yaw.shape[2])
    parts = [np.pad(x, ((0, 0), (0, 0), (0, powers - x.shape[2]))) for x in (position, yaw)]
    return np.concatenate(parts, axis=1)


def with_headings(curve: Curve, times: Floats, yaws: Floats) -> Curve:
    """The same way with yaw on lines between yaws (K,) [rad] at times (K,) [s]; it jumps where two have one time."""
    time = np.unique(
        np.concatenate([curve.time, times[(times > curve.time[0]) & (times < curve.time[-1])]])
    )
    k = np.clip(np.searchsorted(curve.time, time[:-1], side="right") - 1, 0, len(curve.pieces) - 1)
    moved = series.of_polynomials(
        curve.pieces[k], time[:-1] - curve.time[k], curve.pieces.shape[-1]
    )
    pieces = np.moveaxis(moved, 0, -1)
    quarter = np.diff(time) / 4  # inside of a piece, where a jump at its end is not seen
    early, late = (np.interp(t, times, yaws) for t in (time[:-1] + quarter, time[1:] - quarter))
    pieces[:, 3] = 0.0
    pieces[:, 3, 1] = (late - early) / (2 * quarter)
    pieces[:, 3, 0] = early - pieces[:, 3, 1] * quarter
    return Curve(time, pieces)
