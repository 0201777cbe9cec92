"""Ways of vehicles as polynomials: what an export is made from, is fitted to, and is read back as."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rigidfleet.errors import ResultError
from rigidfleet.math import series
from rigidfleet.math.piecewise import Piecewise, hermite_pieces, pad
from rigidfleet.result import Result
from rigidfleet.setpoints import Setpoints, setpoints_at_rate, ways_of
from rigidfleet.typing import Floats, Ints

#: Tolerance of yaw [rad] of exported curves. Position does not depend on it.
YAW_TOLERANCE = np.radians(0.5)
#: Where in each interval a fit is checked, and an export is compared: shares of the interval.
_CHECKED = np.array([0.25, 0.5, 0.75, 1.0])
_COMPARED = np.array([0.02, 0.25, 0.5, 0.75, 0.98])
#: Number of coefficients of ways that are made at once, 8 MiB: arithmetic on more waits for memory.
_TOGETHER = 1 << 20


@dataclass(frozen=True)
class ExportedMotion:
    """What a file gets: the states of its vehicles at both ends of every interval between samples.

    Attributes
    ----------
    result : the flight
    samples : setpoints as recorded, both at a change of phase
    """

    result: Result
    samples: Setpoints

    @property
    def start(self) -> float:
        """Mission time of the first state [s]."""
        return float(self.samples.time[0])

    @property
    def end(self) -> float:
        """Mission time of the last state [s]."""
        return float(self.samples.time[-1])

    @property
    def n_agents(self) -> int:
        """Number of vehicles."""
        return self.samples.yaw.shape[1]

    def of_vehicle(self, agent: int) -> ExportedMotion:
        """The motion of one of the vehicles alone."""
        time, state, yaw, yaw_rate = self.samples
        samples = Setpoints(time, state[:, :, [agent]], yaw[:, [agent]], yaw_rate[:, [agent]])
        return ExportedMotion(self.result, samples)

    def at_rate(self, rate: float | None) -> Setpoints:
        """Setpoints at a rate [Hz]; without one, the samples."""
        return setpoints_at_rate(self.samples, rate)

    def curve_chunks(self) -> Iterator[Piecewise]:
        """The ways (K, n, 4, 8) of all vehicles in order, some at a time: degree 7 (yaw: 3) between samples."""
        n = 1 + _TOGETHER // (32 * len(self.samples.time))
        for first in range(0, self.n_agents, n):
            yield ways_of(self.samples, slice(first, first + n))

    def curves(self) -> Iterator[Piecewise]:
        """The way (K, 4, 8) of each vehicle."""
        for some in self.curve_chunks():
            for i in range(some.pieces.shape[1]):
                yield Piecewise(some.time, some.pieces[:, i])


def fit_curves(
    ways: Iterable[Piecewise], tolerance: float, orders: int = 4, yaw_tolerance: float = YAW_TOLERANCE,
    longest: float = np.inf,
) -> Iterator[Piecewise]:  # fmt: skip
    """For each vehicle the fewest pieces that go from knot to knot within a tolerance [m], and one of yaw [rad].

    Pieces meet 4 (degree 7) or 2 ``orders`` of derivatives (degree 3; yaw: always) at the knots they join. Each is as
    long as the tolerance allows, and not longer than ``longest`` [s]. ``ways`` are
    those of `ExportedMotion.curve_chunks`.

    Raises
    ------
    ResultError
        Not even a piece between two samples is within the tolerance.
    """
    for some in ways:
        yield from _fit_curves_in_rounds(some, tolerance, orders, yaw_tolerance, longest)


def _fit_curves_in_rounds(
    source: Piecewise, tolerance: float, orders: int, yaw_tolerance: float, longest: float
) -> Iterator[Piecewise]:
    """`fit_curves` of ways (K, N, 4, P): in each round, every vehicle tries a piece of its own length."""
    time, (n, vehicles) = source.time, source.pieces.shape[:2]
    begin, end = source.piece_end_states(orders)
    t = time[:-1] + np.diff(time) * _CHECKED[:, None]
    # Points are the last axis: arithmetic on long rows is fast.
    wanted = source.at_shares(_CHECKED).transpose(3, 1, 2, 0).reshape(4, len(_CHECKED), -1)

    def pieces_and_errors(who: Ints, first: Ints, last: Ints) -> tuple[Floats, Floats]:
        """Pieces (M, 4, P) of vehicles (M,) from a knot to another one, and errors as shares of what is allowed."""
        h = time[last] - time[first]
        position, yaw = (
            hermite_pieces(h, begin[:m, first, who, axes], end[:m, last - 1, who, axes])
            for m, axes in ((orders, slice(3)), (2, slice(3, 4)))
        )
        pieces = np.concatenate([position, pad(yaw, 2 * orders)], axis=1)
        ends = np.cumsum(last - first)
        starts = ends - (last - first)
        row = np.repeat(np.arange(len(who)), last - first)
        k = np.arange(ends[-1]) + (first - starts)[row]
        x, c = t[:, k] - time[first][row], pieces.T[:, :, None, row]
        off = c[-1] * x
        for power in c[-2:0:-1]:
            off += power
            off *= x
        off += c[0] - wanted[..., who[row] * n + k]
        far = np.sqrt((off[:3] ** 2).sum(axis=0).max(axis=0)) / tolerance
        worst = np.maximum(far, abs(off[3]).max(axis=0) / yaw_tolerance)
        return pieces, np.maximum(np.maximum.reduceat(worst, starts), h / longest)

    # Of each vehicle's piece: its begin, the longest end known to fit, the shortest known not to, and the next to try.
    i, good, bad = (np.full(vehicles, k) for k in (0, 0, n + 1))
    j, length, who = np.minimum(i + 1, n), np.ones(vehicles, dtype=int), np.arange(vehicles)
    best, fitted = np.zeros((vehicles, 4, 2 * orders)), []
    while len(who):
        pieces, errors = pieces_and_errors(who, i[who], j[who])
        fits = errors <= 1.0
        if (stuck := ~fits & (j[who] == i[who] + 1)).any():
            k, error = i[who][stuck][0], errors[stuck][0]
            raise ResultError(
                f"the tolerance of {1e3 * tolerance:g} mm cannot be met: a curve of degree {2 * orders - 1} "
                f"between the samples at {time[k]:g} and {time[k + 1]:g} s is {error:.2g} times as far "
                f"off. Use --tolerance {1.2 * error * tolerance:.2g}, or fly with a shorter output_step."
            )
        better, worse = who[fits], who[~fits]
        good[better], best[better], bad[worse] = j[better], pieces[fits], j[worse]
        over = who[(good[who] == n) | (bad[who] - good[who] <= 1)]
        fitted.append((over, good[over], best[over]))
        length[over], i[over], bad[over] = good[over] - i[over], good[over], n + 1
        further = np.minimum(good + np.where(good > i, good - i, length), n)
        j = np.where(bad > n, further, (good + bad) // 2)
        who = who[i[who] < n]
    who, ends, pieces = (np.concatenate(x) for x in zip(*fitted, strict=True))
    for vehicle in range(vehicles):
        own = who == vehicle
        yield Piecewise(time[np.append(0, ends[own])], pieces[own])


def cubic_curves(motion: ExportedMotion, tolerance: float) -> Iterator[Piecewise]:
    """For each vehicle its way in cubic pieces, from time zero on; see `yaw_knots`."""
    for curve in fit_curves(motion.curve_chunks(), tolerance, 2, YAW_TOLERANCE / 2):
        yield curve.shift_time(-motion.start)


def yaw_knots(curve: Piecewise) -> tuple[Floats, Floats]:
    """Times (K,) [s] and yaws (K,) [rad] with lines between them, within half of `YAW_TOLERANCE` of a way.

    Times increase: where yaw jumps, it turns within a millisecond. A line turns by 90 deg at most: from half a turn on,
    the shorter way to its end would be another one.
    """
    step, yaw = np.diff(curve.time), curve.pieces[:, 3]
    # At least the greatest rate and second derivative.
    _, a, b, c = abs(yaw[:, :4]).T
    rate, bend = a + 2.0 * b * step + 3.0 * c * step**2, 2.0 * b + 6.0 * c * step
    lines = step * np.maximum(np.sqrt(bend / (4.0 * YAW_TOLERANCE)), rate / (np.pi / 2))
    counts = np.maximum(1, np.ceil(lines)).astype(int)
    k = np.repeat(np.arange(len(step)), counts + 1)
    along = np.arange(len(k)) - (np.cumsum(counts + 1) - counts - 1)[k]
    after = along / counts[k] * step[k]
    times, yaws = curve.time[k] + after, series.polynomial_series(yaw[k], after, 1)[0]
    again = np.append(False, np.diff(times) < 1e-9)
    times[again] += 1e-3
    needed = ~again | np.append(False, abs(np.diff(yaws)) > 1e-9)
    times, yaws = times[needed], yaws[needed]
    flat = abs(np.diff(yaws)) < 1e-12
    level = np.append(flat, True) & np.append(True, flat)
    level[[0, -1]] = False
    return times[~level], yaws[~level]


class Deviation(NamedTuple):
    """How far an export is from what was exported: position [m], yaw [rad], and what lacks.

    ``missing`` is the time at the end that the export does not have [s].
    """

    position: float
    yaw: float
    missing: float


def deviation(source: Piecewise, written: Piecewise, until: float = np.inf) -> Deviation:
    """Greatest distance and difference of yaw between two ways, at five times in each interval of the source.

    After a time ``until`` [s] nothing is missing: the vehicle stands on the ground.
    """
    h = np.diff(source.time)[:, None]
    t = (source.time[:-1, None] + h * _COMPARED).ravel()
    wanted = source.at_shares(_COMPARED).reshape(len(t), -1)
    there = t <= written.time[-1]
    off = written.at(t[there]) - wanted[there]
    turned = (off[:, 3] + np.pi) % (2.0 * np.pi) - np.pi
    missing = max(0.0, float(min(source.time[-1], until) - written.time[-1]))
    far = float(np.sqrt((off[:, :3] ** 2).sum(axis=1).max(initial=0.0)))
    return Deviation(far, float(abs(turned).max(initial=0.0)), missing)


def motion_and_is_cut(result: Result, *, flown: bool) -> tuple[ExportedMotion, bool]:
    """What can be exported of a flight, and whether its beginning or end is left out: no slot is tracked there.

    Raises
    ------
    ResultError
        There is no reference at all, or it has gaps, or a value is not finite.
    """
    setpoints = result.setpoints_at_samples(flown=flown)
    yaw, yaw_rate = setpoints.yaw, setpoints.yaw_rate
    if flown:  # a flight without yaw of its own keeps pointing east
        yaw, yaw_rate = np.nan_to_num(yaw), np.nan_to_num(yaw_rate)
    known = np.isfinite(setpoints.state).all(axis=(1, 3)) & np.isfinite(yaw) & np.isfinite(yaw_rate)
    there = np.flatnonzero(known.any(axis=1))
    which = "motion flown" if flown else "reference"
    if not len(there):
        raise ResultError(
            f"the {which} of this flight has no numbers: nothing is tracked. Export what was flown: --flown."
        )
    first, last = int(there[0]), int(there[-1]) + 1
    kept = slice(first, last)
    if not known[kept].all():
        k, agent = np.argwhere(~known[kept])[0]
        at = setpoints.time[first + k]
        name = result.phases[result.phase[first + k]].name
        raise ResultError(
            f"the {which} of agent {agent + 1} has no number at {at:g} s (phase {name!r}). "
            + ("Fly the mission again." if flown else "Export what was flown: --flown.")
        )
    if last - first < 2:
        raise ResultError(f"the {which} has one sample only. Fly the mission further.")
    cut = Setpoints(setpoints.time[kept], setpoints.state[kept], yaw[kept], yaw_rate[kept])
    return ExportedMotion(result, cut), last - first < len(known)
