"""Tables that others wrote: setpoints of one or several vehicles, and polynomials of one."""

from __future__ import annotations

import numpy as np

from rigidfleet._common.names import CRAZYFLIE
from rigidfleet._common.tables import TextTable, fault
from rigidfleet.foreign.columns import Units, are_row_numbers, parse_table, read_tracks
from rigidfleet.foreign.curves import (
    ASSUMED,
    CHANNEL_NAMES,
    Trajectories,
    curve_through_samples,
    curve_through_states,
    rows_to_curve,
)
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.math.splines import POWERS

#: What is between the knots of a table of polynomials.
POLYNOMIALS = "the polynomials of the file"
#: Greatest difference of a stated velocity that is not noted, as a share of the greatest speed, and [m/s].
_SHARE, _LEAST = 0.05, 0.05


def read_text_table(data: bytes, stem: str, interpolation: str, units: Units) -> Trajectories:
    """The vehicles of a table; the only one is named by the file's stem.

    Raises
    ------
    ContentError
        The table cannot be read, or a time does not increase.
    """
    table, notes = parse_table(data, units)
    if table.find_columns("duration", "x^0"):
        for k, q in enumerate(table.kinds):
            labels = table.codes(k)[1] if q.kind in ("agent", "thing") else []
            counts = q.kind == "thing" and are_row_numbers(labels, len(table.lines))
            if len(labels) > 1 and not counts:
                why = f"has polynomials of several vehicles in the column {table.names[k]!r}"
                raise fault(why, "Give each vehicle a table")
            if q.kind in ("time", "") and table.names[k]:
                notes.append(f"the column {table.names[k]!r} is not read: pieces join, from 0 s on")
        curve = _curve_of_coefficients(table)
        record = {"columns": table.names, "rows": len(curve.pieces)}
        return Trajectories((stem,), (curve,), POLYNOMIALS, tuple(notes), (record,))
    tracks, record = read_tracks(table, stem, units.axes, notes)
    curves, off, fastest = [], 0.0, 0.0
    for _, lines, time, place, velocity, yaw in tracks:
        where = lambda k, lines=lines: f"line {lines[k]}"  # noqa: E731
        curves.append(curve_through_samples(time, place, yaw, interpolation, where))
        # At the inner samples, where lines have two velocities.
        between = curves[-1].pieces[1:, :3, 1]
        if velocity is not None and interpolation == "cubic" and len(between):
            off = max(off, float(np.linalg.norm(velocity[1:-1] - between, axis=1).max()))
            fastest = max(fastest, float(np.linalg.norm(between, axis=1).max()))
    if off > _LEAST + _SHARE * fastest:
        words = f"up to {off:.3g} m/s off those of its positions, which count"
        notes.append(f"the velocities of the table are {words}")
    names = tuple(track.name for track in tracks)
    read = Trajectories(names, tuple(curves), ASSUMED[interpolation], tuple(notes), (record,))
    return read._replace(own_clocks=any(map(CRAZYFLIE.fullmatch, table.names)))


def _curve_of_coefficients(table: TextTable) -> Piecewise:
    """The curve in Crazyswarm2's table: duration [s], 8 coefficients of x, y, z [m] and yaw [rad] a piece, any order.

    Raises
    ------
    ContentError
        A column is missing, or a duration is not positive.
    """
    due = ["duration", *(f"{axis}^{k}" for axis in CHANNEL_NAMES for k in range(POWERS))]
    odd = [f"no column, or two, for {kind}" for kind in due if not table.find_columns(kind)]
    odd += [f"the column {x}" for x in table.names if "^" in x and x.lower() not in due]
    if odd:
        remedy = "A table of polynomials has the columns duration, x^0 to x^7, y^0, z^0 and yaw^0 to yaw^7"
        raise fault(f"has {odd[0]}", remedy, table.line)
    rows = table.numbers_of_columns(table.find_columns(*due))
    bad = np.flatnonzero(~(rows[:, 0] > 0.0))
    if len(bad):
        why = f"the duration is {rows[bad[0], 0]:g} s"
        raise fault(why, "Give a positive one", int(table.lines[bad[0]]))
    return rows_to_curve(rows)


def read_polynomial(data: bytes) -> list[Piecewise]:
    """The curve in a table of `crazyflie.write_polynomial`, from time zero on."""
    return [_curve_of_coefficients(TextTable(data, {}))]


def read_result_table(data: bytes) -> list[Piecewise]:
    """The curves in a table of `Result.to_csv`: polynomials of degree 7 (yaw: 3) that meet all that it says."""
    axes = [f"{kind}{axis}" for kind in ("", "v", "a", "j") for axis in "xyz"]
    table = TextTable(data, {})
    every = table.numbers_of_columns(table.find_columns("time", *axes, "yaw", "yaw_rate"))
    code, labels = table.codes(table.names.index("agent"))
    curves = []
    for agent in sorted(range(len(labels)), key=lambda k: int(labels[k])):
        own = every[code == agent]
        states = own[:, 1:13].reshape(-1, 4, 3).swapaxes(0, 1)
        curves.append(curve_through_states(own[:, 0], states, own[:, 13:15].T))
    return curves
