"""Setpoints of each vehicle over time, between samples and as CSV: what other programs are given to fly.

A `Setpoints` holds position, velocity, acceleration, jerk and yaw at some times. Between them, vehicles move on
polynomials that meet all of these (degree 7), so that any rate can be had from the samples of a result.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rigidfleet.math import lqr, series
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.typing import Floats, Ints

HEADER = (
    "time_s,agent,x_m,y_m,z_m,vx_m_s,vy_m_s,vz_m_s,ax_m_s2,ay_m_s2,az_m_s2,jx_m_s3,jy_m_s3,jz_m_s3,"
    "yaw_rad,yaw_rate_rad_s"
)
#: Ratio of the time before a sample to that after it, from which on it counts as clearly longer.
_LONGER = 2.0
#: Greatest number of setpoints [one agent at one time] of a table: a file of 3 GB.
MOST_SETPOINTS = 20_000_000


class Setpoints(NamedTuple):
    """States of N vehicles at K times; NaN where there is none.

    Attributes
    ----------
    time : (K,) [s]
    state : (K, 4, N, 3) position [m], velocity [m/s], acceleration [m/s^2], jerk [m/s^3]
    yaw, yaw_rate : (K, N) [rad, rad/s]
    """

    time: Floats
    state: Floats
    yaw: Floats
    yaw_rate: Floats


def states_with_jerk(
    position: Floats, velocity: Floats, acceleration: Floats, time: Floats
) -> Floats:
    """States (K, 4, N, 3) of a flown motion (K, N, 3) at times (K,) [s], with the jerk of quintics between them.

    At a sample it is that of the quintic after it, or of the one before where that is clearly longer, or the last:
    over a very short time, a jerk would show the rounding of the samples.
    """
    x = np.stack([position, velocity, acceleration, np.full_like(position, np.nan)], axis=1)
    if len(time) > 1:
        pieces, h = lqr.quintic_pieces(time, position, velocity, acceleration), np.diff(time)
        x[:-1, 3] = 6.0 * pieces[..., 3]
        before = np.append(np.flatnonzero(h[:-1] > _LONGER * h[1:]), len(h) - 1)
        ends = series.polynomial_series(pieces[before], h[before], 4)
        x[before + 1, 3] = 6.0 * ends[3]
    return x


def setpoints_at_rate(samples: Setpoints, rate: float | None) -> Setpoints:
    """Setpoints at a rate [Hz] from the first time on; without one, at their own times.

    Where two times are one representable number apart, as at a switch of phases, the later one counts.

    Raises
    ------
    ValueError
        The rate is not positive, or gives more than `MOST_SETPOINTS` setpoints, or a single one of a flight that lasts.
    """
    time = samples.time
    later = np.append(np.nextafter(time[:-1], np.inf) < time[1:], True)
    if rate is None:
        return Setpoints(*(x[later] for x in samples))
    if not (np.isfinite(rate) and rate > 0.0):
        raise ValueError(f"the rate must be positive [Hz], not {rate!r}")
    span = time[-1] - time[0]
    count = int(span * rate * (1.0 + 1e-12)) + 1
    n = samples.yaw.shape[1]
    if count < 2 and span > 0.0:
        raise ValueError(
            f"a rate of {rate:g} Hz gives one setpoint in {span:.4g} s; use {1.0 / span:.3g} Hz or more"
        )
    if count * n > MOST_SETPOINTS:
        fits = (MOST_SETPOINTS / n - 1) / span
        raise ValueError(
            f"a rate of {rate:g} Hz gives {count * n:,} setpoints; use {fits:.3g} Hz or less"
        )
    return setpoints_at(samples, np.minimum(time[0] + np.arange(count) / rate, time[-1]))


def setpoints_at(samples: Setpoints, wanted: Floats) -> Setpoints:
    """Setpoints at increasing times (n,) [s] within the given ones; of two states at a switch, the later one counts."""
    time, count, n = samples.time, len(wanted), samples.yaw.shape[1]
    if len(time) == 1:
        return samples
    x = np.empty((count, 4, n, 4))
    for i in range(n):
        x[:, :, [i]] = ways_of(samples, slice(i, i + 1)).states(wanted, 4).swapaxes(0, 1)
    return Setpoints(wanted, x[..., :3], x[:, 0, :, 3], x[:, 1, :, 3])


def ways_of(samples: Setpoints, agents: slice) -> Piecewise:
    """The ways of n agents: pieces (k, n, 4, 8) of x, y, z [m] and yaw [rad], of degree 7 (yaw: 3)."""
    first, knots = interval_starts_and_knots(samples.time)
    state = samples.state[:, :, agents].swapaxes(0, 1)
    yaw = np.stack([samples.yaw[:, agents], samples.yaw_rate[:, agents]])[..., None]
    position, turned = (
        Piecewise.of_end_states(knots, x[:, first], x[:, first + 1]) for x in (state, yaw)
    )
    return position.stack(turned)


def interval_starts_and_knots(time: Floats) -> tuple[Ints, Floats]:
    """Samples (k,) that begin an interval, which the next one ends, and the knots (k + 1,) [s] between intervals.

    Two samples that are one representable number apart, as at a switch of phases, are one knot with two states.
    """
    first = np.flatnonzero(np.nextafter(time[:-1], np.inf) < time[1:])
    return first, np.append(time[first[:1]], time[first + 1])


def csv_text(samples: Setpoints, first: int = 1) -> str:
    """The text of a table: a row for each time and agent, numbers to 9 digits, empty where there is none.

    Agents count from ``first``.
    """
    k, n = samples.yaw.shape
    states = samples.state.transpose(0, 2, 1, 3).reshape(k, n, 12)
    columns = np.concatenate([states, np.stack([samples.yaw, samples.yaw_rate], axis=2)], axis=2)
    lines = [HEADER]
    row = ",".join(["%.9g"] * columns.shape[2])
    for t, agents in zip(samples.time.tolist(), columns, strict=True):
        stamp = f"{t:.9g}"
        for i, values in enumerate(agents.tolist(), start=first):
            lines.append(f"{stamp},{i}," + row % tuple(values))
    return "\n".join(lines).replace("nan", "") + "\n"
