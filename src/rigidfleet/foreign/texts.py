"""Tables that others wrote: setpoints of one or several vehicles, and polynomials of one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rigidfleet.errors import TrajectoryError
from rigidfleet.foreign.columns import numbers, read_columns, read_lines
from rigidfleet.foreign.curves import NAMES, rows_to_curve, through
from rigidfleet.foreign.samples import ASSUMED, sampled
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.math.splines import POWERS
from rigidfleet.typing import Floats

#: What is between the knots of a table of polynomials.
POLYNOMIALS = "the polynomials of the file"
#: Greatest difference of a stated velocity that is not noted, as a share of the greatest speed, and [m/s].
_SHARE, _LEAST = 0.05, 0.05


def read_text(
    data: bytes, path: Path, interpolation: str
) -> tuple[tuple[str, ...], tuple[Piecewise, ...], str, tuple[str, ...]]:
    """Names, curves, what is assumed between samples, and notes, of a table of setpoints or of polynomials.

    Raises
    ------
    TrajectoryError
        The table cannot be read.
    """
    head = data[:10_000].decode("utf-8", "replace").lower()
    if "duration" in head.partition("\n")[0]:
        return (path.stem,), (read_pieces(data, str(path)),), POLYNOMIALS, ()
    names, curves, notes = read_setpoints(data, path, interpolation)
    return names, curves, ASSUMED[interpolation], notes


def read_pieces(data: bytes, name: str) -> Piecewise:
    """The curve in Crazyswarm2's table: duration [s], 8 coefficients of x, y, z [m] and yaw [rad] a piece, any order.

    Raises
    ------
    TrajectoryError
        The table cannot be read, a column is missing, or a duration is not positive.
    """
    names, comma, rows, lines = read_lines(data, name)
    due = ["duration", *(f"{axis}^{k}" for axis in NAMES for k in range(POWERS))]
    plain = [told.lower().replace(" ", "") for told in names]
    if missing := [told for told in due if plain.count(told) != 1]:
        raise TrajectoryError(
            f"{name}: line 1: has no column, or two, for {missing[0]}. A table of polynomials has the columns "
            "duration, x^0 to x^7, y^0, z^0 and yaw^0 to yaw^7."
        )
    found = numbers(rows, lines, comma, names, [plain.index(told) for told in due], name)
    bad = np.flatnonzero(~(found[:, 0] > 0.0))
    if len(bad):
        k = int(bad[0])
        raise TrajectoryError(
            f"{name}: line {lines[k]}: the duration is {found[k, 0]:g} s. Give a positive one."
        )
    return rows_to_curve(found)


def read_setpoints(
    data: bytes, path: Path, interpolation: str
) -> tuple[tuple[str, ...], tuple[Piecewise, ...], tuple[str, ...]]:
    """Names, curves and notes of a table with time, x, y, z, and, if given, agent, yaw and velocity.

    Raises
    ------
    TrajectoryError
        The table cannot be read, or a time does not increase.
    """
    name = str(path)
    given = read_columns(data, name, ("time", "x", "y", "z"), ("yaw", "vx", "vy", "vz"))
    time, yaw = given.values["time"], given.values.get("yaw")
    position = np.column_stack([given.values[axis] for axis in "xyz"])
    if given.who is None:
        groups = {path.stem: np.arange(len(time))}
    else:
        who, first, inverse = np.unique(given.who, return_index=True, return_inverse=True)
        rows = np.split(np.argsort(inverse, kind="stable"), np.cumsum(np.bincount(inverse))[:-1])
        order = np.argsort(first)
        groups = {str(who[k]): rows[k] for k in order.tolist()}
    curves, off, fastest = [], 0.0, 0.0
    for k in groups.values():
        curve = sampled(
            time[k],
            position[k],
            None if yaw is None else yaw[k],
            interpolation,
            name,
            lambda i, k=k: f"line {given.lines[k[i]]}",
        )
        curves.append(curve)
        if all(f"v{axis}" in given.values for axis in "xyz"):
            stated = np.column_stack([given.values[f"v{axis}"][k] for axis in "xyz"])
            # At the inner samples, where lines have two velocities.
            between = curve.pieces[1:, :3, 1]
            if interpolation == "cubic" and len(between):
                off = max(off, float(np.linalg.norm(stated[1:-1] - between, axis=1).max()))
                fastest = max(fastest, float(np.linalg.norm(between, axis=1).max()))
    return tuple(groups), tuple(curves), _contradiction(off, fastest)


def _contradiction(off: float, fastest: float) -> tuple[str, ...]:
    """A note if a table states other velocities than its positions give."""
    if off <= _LEAST + _SHARE * fastest:
        return ()
    return (
        f"the velocities of the table are up to {off:.3g} m/s off those of its positions, which count",
    )


def read_polynomial(data: bytes) -> list[Piecewise]:
    """The curve in a table of `crazyflie.write_polynomial`, from time zero on."""
    return [read_pieces(data, "polynomial")]


def read_table(data: bytes) -> list[Piecewise]:
    """The curves in a table of `Result.to_csv`: polynomials of degree 7 (yaw: 3) that meet all that it says."""
    axes = [f"{kind}{axis}" for kind in ("", "v", "a", "j") for axis in "xyz"]
    due = ("time", *axes, "yaw", "yaw_rate")
    given = read_columns(data, "setpoints", due, ())
    every: Floats = np.column_stack([given.values[q] for q in due])
    assert given.who is not None
    curves = []
    for agent in sorted(set(given.who.tolist()), key=int):
        own = every[given.who == agent]
        states = own[:, 1:13].reshape(-1, 4, 3).swapaxes(0, 1)
        curves.append(through(own[:, 0], states, own[:, 13:15].T))
    return curves
