"""Ways of vehicles as polynomials: what an export is made from, is fitted to, and is read back as."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rigidfleet.errors import ResultError
from rigidfleet.math import series
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.result import Result
from rigidfleet.setpoints import Setpoints, at_rate, curve_of
from rigidfleet.typing import Floats

#: Tolerance of yaw [rad] of exported curves. Position does not depend on it.
YAW_TOLERANCE = np.radians(0.5)
#: Where in each interval a fit is checked, and an export is compared: shares of the interval.
_CHECKED = np.array([0.25, 0.5, 0.75, 1.0])
_COMPARED = np.array([0.02, 0.25, 0.5, 0.75, 0.98])


@dataclass(frozen=True)
class ExportedMotion:
    """What a file gets: the states of its vehicles at both ends of every interval between samples.

    Attributes
    ----------
    result : the flight
    samples : setpoints as recorded, both at a change of phase
    first : the first of the vehicles, from 0
    """

    result: Result
    samples: Setpoints
    first: int = 0

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
        """The motion of one of all vehicles alone."""
        time, state, yaw, yaw_rate = self.samples
        samples = Setpoints(time, state[:, :, [agent]], yaw[:, [agent]], yaw_rate[:, [agent]])
        return ExportedMotion(self.result, samples, agent)

    def at_rate(self, rate: float | None) -> Setpoints:
        """Setpoints at a rate [Hz]; without one, the samples."""
        return at_rate(self.samples, rate)

    def curve(self, agent: int = 0) -> Piecewise:
        """The way of one of the vehicles, from 0: degree 7 (yaw: 3) between samples."""
        return curve_of(self.samples, agent)


def fit_curve(
    source: Piecewise, tolerance: float, orders: int = 4, yaw_tolerance: float = YAW_TOLERANCE,
    longest: float = np.inf,
) -> Piecewise:  # fmt: skip
    """The fewest pieces that go from knot to knot of a way within a tolerance [m], and one of yaw [rad].

    Pieces meet 4 (degree 7) or 2 ``orders`` of derivatives (degree 3; yaw: always) at the knots they join. Each is as
    long as the tolerance allows, and not longer than ``longest`` [s].

    Raises
    ------
    ResultError
        Not even a piece between two samples is within the tolerance.
    """
    time, n = source.time, len(source.pieces)
    begin, end = source.ends(4)
    t = time[:-1, None] + np.diff(time)[:, None] * _CHECKED
    wanted = source.within(_CHECKED)

    def piece_over(i: int, j: int) -> tuple[Floats, float]:
        """The piece over intervals i to j - 1, and its error as a share of what is allowed."""
        ends = time[[i, j]]
        position, yaw = (
            Piecewise.of_ends(ends, begin[:m, i : i + 1, axes], end[:m, j - 1 : j, axes])
            for m, axes in ((orders, slice(3)), (2, slice(3, 4)))
        )
        piece = position.beside(yaw)
        off = piece.at(t[i:j].ravel()) - wanted[i:j].reshape(-1, 4)
        far = np.sqrt((off[:, :3] ** 2).sum(axis=1).max()) / tolerance
        far = max(far, (ends[1] - ends[0]) / longest)
        return piece.pieces, float(max(far, abs(off[:, 3]).max() / yaw_tolerance))

    ends, pieces, length = [0], [], 1
    while ends[-1] < n:
        i = ends[-1]
        good, bad = i, n + 1  # the longest piece known to fit, the shortest known not to
        j = min(i + length, n)
        while good < n and bad - good > 1:
            piece, error = piece_over(i, j)
            if error <= 1.0:
                good, best = j, piece
            elif j > i + 1:
                bad = j
            else:
                raise ResultError(
                    f"the tolerance of {1e3 * tolerance:g} mm cannot be met: a curve of degree {2 * orders - 1} "
                    f"between the samples at {time[i]:g} and {time[j]:g} s is {error:.2g} times as far "
                    f"off. Use --tolerance {1.2 * error * tolerance:.2g}, or fly with a shorter output_step."
                )
            j = min(2 * good - i, n) if bad > n else (good + bad) // 2
        ends.append(good)
        pieces.append(best)
        length = good - i
    return Piecewise(time[ends], np.concatenate(pieces))


def heading_lines(curve: Piecewise) -> tuple[Floats, Floats]:
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
    shares = [np.linspace(0.0, 1.0, count + 1) for count in counts]
    k = np.repeat(np.arange(len(step)), counts + 1)
    after = np.concatenate(shares) * step[k]
    times, yaws = curve.time[k] + after, series.of_polynomials(yaw[k], after, 1)[0]
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
    wanted = source.within(_COMPARED).reshape(len(t), -1)
    there = t <= written.time[-1]
    off = written.at(t[there]) - wanted[there]
    turned = (off[:, 3] + np.pi) % (2.0 * np.pi) - np.pi
    missing = max(0.0, float(min(source.time[-1], until) - written.time[-1]))
    far = float(np.sqrt((off[:, :3] ** 2).sum(axis=1).max(initial=0.0)))
    return Deviation(far, float(abs(turned).max(initial=0.0)), missing)


def exported_motion(result: Result, *, flown: bool) -> tuple[ExportedMotion, bool]:
    """What can be exported of a flight, and whether its beginning or end is left out: no slot is tracked there.

    Raises
    ------
    ResultError
        There is no reference at all, or it has gaps, or a value is not finite.
    """
    setpoints = result.motion(flown=flown)
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
