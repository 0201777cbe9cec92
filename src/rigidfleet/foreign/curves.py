"""Ways of vehicles with the channels x, y, z [m] and yaw [rad]: what files of others are read as, and written from.

Yaw is NaN where a format does not have it. Between samples, a curve through them is assumed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.math.piecewise import Piecewise, pad
from rigidfleet.typing import Floats, Ints

#: Names of the channels of a curve.
CHANNEL_NAMES = ("x", "y", "z", "yaw")
CHANNELS = len(CHANNEL_NAMES)

#: What is assumed between samples, in words.
ASSUMED = {
    "linear": "straight lines between samples",
    "cubic": "cubic splines through the positions",
}

#: Correlation of third differences, one after the other, below which they are those of noise (of white noise -3/4, of a
#: random walk -2/3, of smooth motion near 1), and the least such noise [m].
_OF_NOISE, _SHOWN = -0.6, 2e-4
#: Fewest samples by which noise is seen.
_SAMPLES = 50


class LoggedStates(NamedTuple):
    """What a log says beside positions, at the knots of its curve; None or NaN where it does not.

    Attributes
    ----------
    velocity : (K, 3) [m/s]
    deviation : (K, 3) standard deviations of the positions, by the estimator that wrote them [m]
    resets : (R,) knots at which its position is set anew: no vehicle flew there from the knot before
    """

    velocity: Floats | None
    deviation: Floats | None
    resets: Ints


class Trajectories(NamedTuple):
    """Trajectories of N vehicles as piecewise polynomials.

    Attributes
    ----------
    names : of the vehicles, in order
    curves : of each vehicle, its knots [s] and coefficients of x, y, z [m] and yaw [rad]; yaw is NaN if it is unknown
    assumed : the curve that was assumed between the points of the file, in words
    notes : what a reader of the verdict should know, in sentences without a full stop
    read : what was taken for what, of files that are alike: their number, vehicles, rows, span, columns, units, axes
    away : whether a vehicle is not there before its curve begins and after it ends; else it stands at the curve's ends
    since : seconds since 1970 from which times count; 0 if they are no dates
    measured : of each vehicle what its log says beside positions; empty if these are all
    own_clocks : whether times of different files count from different zeros, which nobody knows
    """

    names: tuple[str, ...]
    curves: tuple[Piecewise, ...]
    assumed: str
    notes: tuple[str, ...] = ()
    read: tuple[dict[str, Any], ...] = ({},)
    away: bool = False
    since: float = 0.0
    measured: tuple[LoggedStates, ...] = ()
    own_clocks: bool = False


def curve_through_states(time: Floats, states: Floats, yaw: Floats | None = None) -> Piecewise:
    """The way through states (m, K, 3) at times (K,) [s]: m derivatives of position are met, 4, 2, or 1 (lines).

    Yaw (2, K) [rad, rad/s] or (1, K) is met in the same way; without it, yaw is NaN. A single state stays for a second.
    """
    angle = np.full((1, len(time)), np.nan) if yaw is None else yaw
    if len(time) == 1:
        time, states = np.append(time, time + 1.0), np.repeat(states, 2, axis=1)
        states[1:] = 0.0
        angle = np.repeat(angle, 2, axis=1) * [[1.0], [0.0]][: len(angle)]
    position, turned = (Piecewise.hermite(time, x) for x in (states, angle[..., None]))
    return position.stack(turned)


def with_headings(curve: Piecewise, times: Floats, yaws: Floats) -> Piecewise:
    """The same way with yaw on lines between yaws (K,) [rad] at times (K,) [s]; it jumps where two have one time."""
    moved = curve.insert_knots(times)
    quarter = np.diff(moved.time) / 4  # inside of a piece, where a jump at its end is not seen
    begin = np.interp(moved.time[:-1] + quarter, times, yaws)
    end = np.interp(moved.time[1:] - quarter, times, yaws)
    slope = (end - begin) / (2 * quarter)
    yaw = Piecewise(moved.time, np.stack([begin - slope * quarter, slope], axis=-1)[:, None])
    return Piecewise(moved.time, moved.pieces[:, :3]).stack(yaw)


def rows_to_curve(rows: ArrayLike) -> Piecewise:
    """The curve of rows of one length: a duration [s], and the coefficients of x, y, z and yaw."""
    table = np.array(rows, dtype=np.float64)
    time = np.concatenate([[0.0], np.cumsum(table[:, 0])])
    pieces = table[:, 1:].reshape(len(table), CHANNELS, -1)
    return Piecewise(time, pad(pieces, max(2, pieces.shape[-1])))  # one that stays has a slope, too


def curve_to_rows(curve: Piecewise) -> list[list[float]]:
    """Rows as `rows_to_curve` takes them."""
    flat = curve.pieces.reshape(len(curve.pieces), -1)
    return np.column_stack([np.diff(curve.time), flat]).tolist()


def greatest_jumps_and_times(curve: Piecewise) -> tuple[Floats, Floats]:
    """Greatest jumps (3,) of position, velocity and acceleration at inner knots [m, m/s, m/s^2], and when (3,) [s]."""
    far = np.linalg.norm(curve.jumps(3)[..., :3], axis=-1)
    if not far.size:
        return np.zeros(3), np.zeros(3)
    return far.max(axis=1), curve.time[1 + far.argmax(axis=1)]


def least_jerk_curve(curve: Piecewise) -> Piecewise:
    """The natural quintic spline through the knots of a curve: of all curves through them the one with the least jerk.

    Its fourth derivative is continuous. Full turns of yaw between two knots do not count.
    """
    from scipy.interpolate import make_interp_spline

    time, x = curve.time, curve.at(curve.time)
    x[:, 3] = np.unwrap(x[:, 3])
    known = CHANNELS if np.isfinite(x[:, 3]).all() else 3
    natural = [(3, np.zeros(known)), (4, np.zeros(known))]
    spline = make_interp_spline(time, x[:, :known], k=5, bc_type=(natural, natural))
    pieces = np.full((len(time) - 1, CHANNELS, 6), np.nan)
    for k in range(6):
        pieces[:, :known, k] = spline(time[:-1], nu=k) / math.factorial(k)
    return Piecewise(time, pieces)


def looks_measured(curves: Sequence[Piecewise], assumed: str) -> bool:
    """Whether samples of a vehicle have noise, as they were measured; ``assumed``: what is between them."""
    if assumed not in ASSUMED.values():
        return False
    for curve in curves:
        third = np.diff(curve.at(curve.time)[:, :3], 3, axis=0)
        if len(third) < _SAMPLES:
            continue
        square = (third**2).mean(axis=0)
        both = (third[1:] * third[:-1]).mean(axis=0)
        # 20 is the factor of white noise.
        if ((square > 20.0 * _SHOWN**2) & (both < _OF_NOISE * square)).any():
            return True
    return False


def curve_through_samples(
    time: Floats,
    position: Floats,
    yaw: Floats | None,
    kind: str,
    place: Callable[[int], str],
) -> Piecewise:
    """The curve through positions (K, 3) [m] and yaws (K,) [rad] at times (K,) [s].

    ``cubic`` is the spline with continuous acceleration (not-a-knot at its ends); yaw is on lines without full turns.
    A single sample stays for a second.

    Raises
    ------
    ContentError
        A time does not increase; ``place`` tells where in the file it is.
    """
    behind = np.flatnonzero(~(np.diff(time) > 0.0))
    if len(behind):
        k = int(behind[0]) + 1
        how = "repeats" if time[k] == time[k - 1] else "goes back behind"
        from rigidfleet._common.tables import fault  # missions do without

        why = f"{place(k)}: the time {time[k]:.9g} s {how} {time[k - 1]:.9g} s"
        raise fault(why, "Give increasing times")
    turned = None if yaw is None else np.unwrap(yaw)[None]
    lines = curve_through_states(time, position[None], turned)
    if kind == "linear" or len(time) < 3:
        return lines
    return Piecewise.cubic_spline(time, position).stack(Piecewise(time, lines.pieces[:, 3:]))
