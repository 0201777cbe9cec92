"""What of the distance between a flight and its plan a clock and a set-up explain: offsets, a turn, a shift, a scale.

A place p of the plan at its time t is at scale Rz(turn) p + shift in the log, at t + offset. All are fitted at once by
least squares. Errors come from leaving out one part of the flight after the other (the jackknife of blocks: Kunsch,
Ann. Statist. 17, 1989), as what a controller leaves is not independent from sample to sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rigidfleet.math.piecewise import Piecewise
from rigidfleet.typing import Bools, Floats

#: Planned ways of vehicles, of x, y, z [m].
Plan = Sequence[Piecewise]
#: Times (K,) [s] and smoothed positions (K, 3) [m] of each vehicle.
Logs = Sequence[tuple[Floats, Floats]]
#: Parts of a flight that count as independent, and by how much Student's distribution of so few is wider (97.5 %).
_PARTS, _WIDER = 4, 1.62
#: Turns of the fit; step of the search for a clock far off [s], and samples of a vehicle for it, and for the fit.
_TURNS, _STEP, _FEW, _MANY = 12, 0.25, 150, 2000
#: Parameters: offset [s], turn [rad], logarithm of the scale, shift [m]. What moves places less than this tells none
#: of the first three [m/s, m, m]; errors from which on they are not told, and least errors, as what a controller leaves
#: looks like a little of each.
_MOVES, _UNTOLD = (0.02, 0.05, 0.05), np.array([0.1, 0.1, 0.1, np.inf, np.inf, np.inf])
_FLOOR = np.array([1e-3, 5e-4, 2e-4, 1e-3, 1e-3, 1e-3])
#: Least scale of a set-up, and greatest step of each parameter in one turn.
_SMALLEST = 1e-3
_FARTHEST = np.array([0.5, np.pi, 1.0, np.inf, np.inf, np.inf])
#: Errors from which on a vehicle's offset differs from that of others, and the least that does [s].
_SURE, _LATE = 4.0, 0.01


class Alignment(NamedTuple):
    """What of a log is explained by clock and set-up; values with their standard errors, NaN if they cannot be told.

    Attributes
    ----------
    fit : (2, 6) offset by which stamps of the log are later than the plan [s], turn about the vertical [rad], logarithm
        of the scale, shift x, y, z [m]
    own : (2, N) offset of each vehicle [s]
    as_logged, explained : root mean square distance from the plan [m], with clock and set-up, and without
    """

    fit: Floats
    own: Floats
    as_logged: float
    explained: float

    @property
    def has_own_clock_offset(self) -> Bools:
        """Vehicles (N,) whose own offset differs from that of all."""
        value, error = self.own
        usual = np.median(value[np.isfinite(value)]) if np.isfinite(value).any() else np.nan
        return np.abs(value - usual) > np.maximum(_SURE * error, _LATE)

    def to_dict(self) -> dict[str, Any]:
        """As plain data: pairs of a value and its standard error."""
        shown = self.fit.copy()
        shown[:, 1], shown[0, 2] = np.degrees(shown[:, 1]), np.exp(shown[0, 2])
        pairs = [x.tolist() if np.isfinite(x[1]) else None for x in shown.T]
        facts = dict(zip(("offset_s", "turn_deg", "scale"), pairs, strict=False))
        return facts | {
            "shift_m": pairs[3:], "rms_as_logged_m": self.as_logged, "rms_explained_m": self.explained,
        }  # fmt: skip


def fit_alignment(logs: Logs, plan: Plan, clock_mode: str) -> Alignment:
    """The clock and the set-up of logs against a plan.

    ``clock_mode``: "recorded", near that of the plan; "offset", anywhere; or "own", each log anywhere for itself
    """
    logs = [(t[:: -(-len(t) // _MANY)], x[:: -(-len(t) // _MANY)]) for t, x in logs]
    start, apart = np.zeros(6), np.zeros(len(logs))
    if clock_mode == "own":
        apart[:] = [_best_clock_offset([log], [way]) for log, way in zip(logs, plan, strict=True)]
        logs = [(t - by, x) for (t, x), by in zip(logs, apart, strict=True)]
    start[0] = _best_clock_offset(logs, plan) if clock_mode == "offset" else 0.0
    every = np.ones(6, dtype=np.bool_)
    guess = _mse_and_setup(logs, plan, start[0])[1]
    whole, errors, left = _fit_and_standard_errors(logs, plan, start, every, guess)
    own = np.empty((2, len(logs)))
    for i, (log, way) in enumerate(zip(logs, plan, strict=True)):
        alone, error, _ = _fit_and_standard_errors([log], [way], whole, every)
        own[:, i] = np.where(np.isfinite(error[0]), [alone[0], error[0]], np.nan)
    own[0] += apart
    errors[0] = errors[0] if np.ptp(apart) == 0.0 else np.nan  # all have none in common
    whole[0] += apart[0]
    fit = np.where(np.isfinite(errors), [whole, errors], np.nan)
    return Alignment(fit, own, _fit_and_standard_errors(logs, plan, start, ~every)[2], left)


def _residual_slopes_and_times(logs: Logs, plan: Plan, q: Floats) -> tuple[Floats, Floats, Floats]:
    """Off (M, 3), its derivatives (M, 3, 6) by the parameters q, and times (M,) of the plan."""
    rows = []
    c, s = np.cos(q[1]), np.sin(q[1])
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) * np.exp(q[2])
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    for (t, x), way in zip(logs, plan, strict=True):
        inside = (t - q[0] >= way.time[0]) & (t - q[0] <= way.time[-1])
        time = t[inside] - q[0]
        p, v = way.states(time, 2) @ turn.T
        shifts = np.broadcast_to(np.eye(3), (len(p), 3, 3))
        slope = np.concatenate([np.stack([-v, p @ quarter.T, p], axis=2), shifts], axis=2)
        rows.append((x[inside] - p - q[3:], slope, time))
    off, slopes, times = zip(*rows, strict=True)
    return np.concatenate(off), np.concatenate(slopes), np.concatenate(times)


def _fit_and_standard_errors(
    logs: Logs, plan: Plan, start: Floats, free: Bools, guess: Floats | None = None
) -> tuple[Floats, Floats, float]:
    """The ``free`` parameters (6,) that a flight tells, from a guess; their errors; the distance that is left.

    The others are those of the start.
    """
    q, free, errors = (start if guess is None else guess).copy(), free.copy(), np.full(6, np.nan)
    for _ in range(_TURNS):
        off, slope, time = _residual_slopes_and_times(logs, plan, q)
        if not (len(off) and free.any()):
            break
        for j in np.flatnonzero(free[:3]):  # what the others do not explain of it
            others = slope[..., free & (np.arange(6) != j)].reshape(3 * len(off), -1)
            column = slope[..., j].ravel()
            alone = column - others @ np.linalg.lstsq(others, column, rcond=None)[0]
            if np.sqrt(3.0 * (alone**2).mean()) < _MOVES[j]:
                free[j], q[j] = False, start[j]
        A = slope[..., free]
        step = np.linalg.lstsq(A.reshape(3 * len(off), -1), off.ravel(), rcond=None)[0]
        step = np.clip(step, -_FARTHEST[free], _FARTHEST[free])
        q[free] += step
        errors[:] = np.nan
        errors[free] = np.hypot(_standard_errors(A, off - A @ step, time), _FLOOR[free])
        if np.abs(step).max() < 1e-7:
            break
    errors[errors > _UNTOLD] = np.nan
    return q, errors, float(np.sqrt((off**2).sum(axis=1).mean())) if len(off) else np.nan


def _standard_errors(A: Floats, left: Floats, time: Floats) -> Floats:
    """Standard errors of a fit of rows A (M, 3, P) that leaves (M, 3): how it changes without one part of the flight.

    Each part has a like share of time and motion together.
    """
    order = np.argsort(time, kind="stable")
    motion = (A[..., 0] ** 2).sum(axis=1)
    share = np.cumsum(motion[order] / max(motion.mean(), 1e-12) + 1.0)
    part = np.empty(len(time), dtype=np.int64)
    part[order] = np.minimum(_PARTS * share / share[-1], _PARTS - 1)
    squares, moments = np.zeros((_PARTS, A.shape[2], A.shape[2])), np.zeros((_PARTS, A.shape[2]))
    np.add.at(squares, part, np.einsum("kij,kil->kjl", A, A))
    np.add.at(moments, part, np.einsum("kij,ki->kj", A, left))
    without = np.linalg.pinv(squares.sum(axis=0) - squares)
    changes = np.einsum("gij,gj->gi", without, moments)
    spread = ((changes - changes.mean(axis=0)) ** 2).sum(axis=0)
    return _WIDER * np.sqrt(spread * (_PARTS - 1) / _PARTS)


def _best_clock_offset(logs: Logs, plan: Plan) -> float:
    """The offset on a grid at which shapes of ways agree best, whatever the set-up."""
    few = [(t[:: -(-len(t) // _FEW)], x[:: -(-len(t) // _FEW)]) for t, x in logs]
    begin, end = min(t[0] for t, _ in few), max(t[-1] for t, _ in few)
    span = plan[0].time[[0, -1]]
    least = 0.5 * min(end - begin, span[1] - span[0])
    best = np.inf, 0.0
    for offset in np.arange(begin - span[1] + least, end - span[0] - least + _STEP, _STEP).tolist():
        best = min(best, (_mse_and_setup(few, plan, offset)[0], offset), key=lambda x: x[0])
    return best[1]


def _mse_and_setup(logs: Logs, plan: Plan, offset: float) -> tuple[float, Floats]:
    """The set-up that agrees best at an offset: the mean square that is left [m^2], infinite if too little is, and all.

    A turn of any angle with a scale is linear in what it makes of x and y; heights have a scale of their own here.
    """
    q = np.array([offset, *np.zeros(5)])
    off, slope, _ = _residual_slopes_and_times(logs, plan, q)
    if len(off) <= 5:
        return np.inf, q
    level = slope[..., 2:3] * np.array([[1.0], [1.0], [0.0]])
    A, b = np.concatenate([slope[..., 1:], level], axis=2).reshape(-1, 6), off.ravel()
    turned, scaled, *q[3:], more = x = np.linalg.lstsq(A, b, rcond=None)[0]
    z = complex(1.0 + scaled + more, turned)
    q[1:3] = np.angle(z), np.log(max(abs(z), _SMALLEST))
    return float(((b - A @ x) ** 2).mean()), q
