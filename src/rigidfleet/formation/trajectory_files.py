"""Trajectories as lists of pieces: joined at common knots, and read from tables of setpoints and of polynomials."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rigidfleet.errors import Finding, MissionError
from rigidfleet.math import series, splines
from rigidfleet.typing import Floats

#: Channels of a curve: x, y, z [m] and yaw [rad].
CHANNELS = 4
#: Times that differ by less are one knot [s]; greatest number of coefficients of all trajectories joined.
_SAME, _MOST = 1e-9, 10_000_000
#: Columns of a table of setpoints, by their names without units: time, agent, and three derivatives of position.
_TIME, _AGENT, _YAW = ("time", "t"), ("agent", "vehicle", "drone", "id"), ("yaw",)
_DERIVATIVES = (("x", "y", "z"), ("vx", "vy", "vz"), ("ax", "ay", "az"), ("jx", "jy", "jz"))


class Curve(NamedTuple):
    """The way of one vehicle: ends of pieces (n + 1,) from 0 [s], and coefficients (n, 4, P) of x, y, z [m], yaw [rad].

    Powers ascend, of the time since the beginning of a piece.
    """

    time: Floats
    pieces: Floats


def rows_to_curve(rows: Sequence[Sequence[float]]) -> Curve:
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


def parse_trajectories(files: Sequence[tuple[str, bytes]]) -> tuple[list[Curve], bool]:
    """Curves of files, given by their names and contents, in this order; and whether they have a yaw.

    A table of polynomials (Crazyswarm2's CSV) begins with the word ``duration``; it is one vehicle. Any other table has
    setpoints: a column of times, positions x, y, z, and maybe numbers of agents, derivatives and yaw, named in its
    first line, in any order, with or without units. With velocity and acceleration (and jerk) they are met by
    polynomials; with positions alone, the quintic spline through them with the least jerk is assumed.

    Raises
    ------
    MissionError
        A table cannot be read.
    """
    found = [curves for name, data in files for curves in _table(name, data)]
    yaws = [curve for curve in found if np.isnan(curve.pieces[:, 3]).any()]
    clean = [Curve(c.time, np.nan_to_num(c.pieces, nan=0.0)) if yaws else c for c in found]
    return clean, not yaws


def _wrong(name: str, where: str, value: object, problem: str, remedy: str) -> MissionError:
    return MissionError([Finding(name, where, value, problem, remedy)])


def _table(name: str, data: bytes) -> list[Curve]:
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        remedy = "give a CSV of setpoints or of polynomials"
        raise _wrong(name, "", None, "is not text", remedy) from None
    told = [(k, x) for k, x in enumerate(lines, start=1) if x.strip() and x.strip()[0] != "#"]
    if len(told) < 2:
        remedy = "write a line of names, and a row for each time or piece"
        raise _wrong(name, "", None, "has no rows", remedy)
    names = [_plain(x) for x in told[0][1].split(",")]
    if names[0] == "duration":
        return [_polynomials(name, told[1:])]
    return _setpoints(name, names, _numbers(name, told[1:], len(names)), [k for k, _ in told[1:]])


def _plain(word: str) -> str:
    """A column's name without its unit: x of x_m, vx of vx_m_s, time of time [s]."""
    word = re.sub(r"[\[(].*", "", word.strip().strip('"').lower()).strip()
    return re.sub(r"_(m|s|rad|m_s\d?|m_s_s|rad_s)$", "", word)


def _numbers(name: str, rows: Sequence[tuple[int, str]], columns: int) -> Floats:
    """Rows of a table (K, columns); an empty field is NaN."""
    found = np.empty((len(rows), columns))
    for k, (number, line) in enumerate(rows):
        fields = line.rstrip().rstrip(",").split(",") if columns == 33 else line.split(",")
        if len(fields) != columns:
            problem = f"has {len(fields)} fields, not {columns}"
            remedy = "complete it; the file may be cut off"
            raise _wrong(name, f"line {number}", line.strip()[:60], problem, remedy)
        try:
            found[k] = [float(x) if x.strip() else np.nan for x in fields]
        except ValueError:
            remedy = "write numbers with decimal points"
            raise _wrong(
                name, f"line {number}", line.strip()[:60], "is no row of numbers", remedy
            ) from None
    return found


def _polynomials(name: str, rows: Sequence[tuple[int, str]]) -> Curve:
    """Crazyswarm2's table: duration, and 8 coefficients of x, y, z and yaw in a row (`uav_trajectory.py`)."""
    found = _numbers(name, rows, 1 + CHANNELS * splines.POWERS)
    for (number, _), row in zip(rows, found, strict=True):
        if not np.isfinite(row).all():
            raise _wrong(name, f"line {number}", None, "is not finite", "write finite numbers")
        if row[0] <= 0.0:
            remedy = "give each piece a positive duration [s]"
            raise _wrong(name, f"line {number}", row[0], "is no duration", remedy)
    return rows_to_curve(found.tolist())


def _setpoints(name: str, names: list[str], table: Floats, lines: list[int]) -> list[Curve]:
    def column(known: Sequence[str]) -> Floats | None:
        return next((table[:, names.index(word)] for word in known if word in names), None)

    time, agent, yaw = column(_TIME), column(_AGENT), column(_YAW)
    orders = [[column((axis,)) for axis in axes] for axes in _DERIVATIVES]
    if time is None or any(x is None for x in orders[0]):
        lacking = "time" if time is None else "x, y and z"
        remedy = (
            "name the columns in the first line: time_s, x_m, y_m, z_m, ..., or duration, x^0, ..."
        )
        raise _wrong(name, "line 1", ",".join(names)[:60], f"names no column {lacking}", remedy)
    states = np.full((4, len(table), 3), np.nan)
    for k, axes in enumerate(orders):
        if all(x is not None for x in axes):
            states[k] = np.stack([x for x in axes if x is not None], axis=1)
    needed = np.column_stack([time, states[0]] + ([] if agent is None else [agent]))
    if (bad := np.flatnonzero(~np.isfinite(needed).all(axis=1))).size:
        remedy = "write time and position as finite numbers"
        raise _wrong(
            name, f"line {lines[bad[0]]}", needed[bad[0]].tolist(), "is not finite", remedy
        )
    curves = []
    for who in [None] if agent is None else np.unique(agent):
        own = np.arange(len(time)) if who is None else np.flatnonzero(agent == who)
        t = time[own]
        back = np.flatnonzero(np.diff(t) <= 0.0)
        if back.size or len(t) < 2:
            line = lines[own[back[0] + 1]] if back.size else lines[own[0]]
            problem = (
                f"the time {t[back[0] + 1]:g} s does not follow {t[back[0]]:g} s"
                if back.size
                else "is alone"
            )
            remedy = "give times that increase, two or more for each vehicle"
            raise _wrong(name, f"line {line}", None, problem, remedy)
        angle = np.full(len(own), np.nan) if yaw is None else yaw[own]
        curves.append(_through(t - t[0], states[:, own], angle))
    return curves


def _through(time: Floats, x: Floats, yaw: Floats) -> Curve:
    """The curve through states (4, K, 3), of which the last ones may be NaN, and yaw (K,) at times (K,) [s] from 0."""
    known = 4
    while not np.isfinite(x[:known]).all():
        known -= 1
    pieces = _spline(
        time, x[0]
    )  # a curve that met velocities alone would have no continuous acceleration
    if known >= 3:
        pieces = splines.hermite(np.diff(time), x[:known, :-1], x[:known, 1:])
    turned = np.full((*pieces.shape[:1], 1, 1), np.nan)
    if np.isfinite(yaw).all():
        turned = _spline(time, np.unwrap(yaw)[:, None])
    full = np.zeros((len(pieces), CHANNELS, max(pieces.shape[-1], turned.shape[-1])))
    full[:, :3, : pieces.shape[-1]] = pieces
    full[:, 3:, : turned.shape[-1]] = turned
    return Curve(time, full)


def _spline(time: Floats, x: Floats) -> Floats:
    """Pieces (K - 1, d, 6) of the natural quintic spline through x (K, d): the curve with the least jerk (C4)."""
    from scipy.interpolate import make_interp_spline

    zero = np.zeros(x.shape[1])
    natural = [(3, zero), (4, zero)]
    found = make_interp_spline(time, x, k=5, bc_type=(natural, natural))
    return np.stack([found(time[:-1], nu=k) / math.factorial(k) for k in range(6)], axis=-1)
