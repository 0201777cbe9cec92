"""Trajectories that others made: from files to polynomials of each vehicle.

`read_trajectories` reads tables of setpoints, Crazyswarm2's tables of polynomials, Skybrush's shows, recordings of
ROS 2 (MCAP), and folders of any of these. Nothing in a file is believed but positions over time: where it has samples,
a curve through them is assumed and named; velocities that a table states are only compared with it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from rigidfleet._common.files import why_not
from rigidfleet._common.tables import TableError
from rigidfleet.errors import TrajectoryError
from rigidfleet.foreign import poses, shows, texts
from rigidfleet.foreign.columns import Units, units_of
from rigidfleet.foreign.samples import ASSUMED
from rigidfleet.math.piecewise import Piecewise

__all__ = ["Interpolation", "Trajectories", "read_trajectories"]

Interpolation = Literal["linear", "cubic"]
#: Greatest size of a file [bytes], number of files, and coordinate [m] or time [s] of a trajectory.
_BYTES, _FILES, FARTHEST = 256 << 20, 20_000, 1e6
#: Greatest number of notes on what was read.
_NOTES = 10
_ZIP, _MCAP, _HDF = b"PK", b"\x89MCAP0\r\n", b"\x89HDF"


class Trajectories(NamedTuple):
    """Trajectories of N vehicles as piecewise polynomials.

    Attributes
    ----------
    names : of the vehicles, in order
    curves : of each vehicle, its knots [s] and coefficients of x, y, z [m] and yaw [rad]; yaw is NaN if it is unknown.
        A vehicle stays where its curve begins or ends before and after it
    assumed : the curve that was assumed between the points of the file, in words
    notes : what a reader of the verdict should know, in sentences without a full stop
    read : what was taken for what, of files that are alike: their number, vehicles, rows, span, columns, units, axes
    """

    names: tuple[str, ...]
    curves: tuple[Piecewise, ...]
    assumed: str
    notes: tuple[str, ...] = ()
    read: tuple[dict[str, Any], ...] = ()


def read_trajectories(
    files: str | Path | Sequence[str | Path],
    interpolation: Interpolation = "cubic",
    *,
    units: str | None = None,
    axes: str | None = None,
) -> Trajectories:
    """Read the trajectories of all vehicles of one or several files or folders.

    Parameters
    ----------
    files : a table of setpoints (CSV with a header, for one vehicle or with a column ``agent``), a table of polynomials
        (Crazyswarm2's CSV, one vehicle), a show (``.skyc``), a recording of poses (``.mcap``), or a folder: each CSV in
        it is a vehicle, and each folder in it a vehicle whose CSVs, in the order of their numbers, follow each other
    interpolation : between samples, ``cubic`` (the cubic spline through the positions, with continuous acceleration) or
        ``linear``; formats of polynomials say themselves what is between
    units : of columns of a table that do not say theirs, of time, length and angle in any order: ``"ms,mm,deg"``
    axes : where x, y and z of a table point: three of e, n, u, w, s and d, such as ``"ned"``

    Raises
    ------
    TrajectoryError
        A file cannot be read; the message names the file and the line or entry.
    ValueError
        The interpolation is unknown.
    """
    if interpolation not in get_args(Interpolation):
        raise ValueError(f"there is no interpolation {interpolation!r}; use linear or cubic")
    paths = [Path(files)] if isinstance(files, str | Path) else [Path(file) for file in files]
    if not paths:
        raise TrajectoryError("no file was given. Give at least one.")
    listed = [found for path in paths for found in files_of(path)]
    if len(listed) > _FILES:
        raise TrajectoryError(f"{paths[0]}: {len(listed):,} files are more than {_FILES:,}.")
    words = units_of(units, axes)
    parts = _on_one_clock([_of_sequence(group, interpolation, words) for group in listed], listed)
    kinds = {part.assumed: group[0] for part, group in zip(parts, listed, strict=True)}
    if len(kinds) > 1:
        (_, first), (_, second), *_ = kinds.items()
        raise TrajectoryError(
            f"{second}: is of another kind than {first}. Give files of one kind for one flight."
        )
    names = [name for part in parts for name in part.names]
    if len(set(names)) < len(names):
        names = [f"{group[0].stem}" if len(part.names) == 1 else f"{group[0].stem}/{name}"
                 for part, group in zip(parts, listed, strict=True) for name in part.names]  # fmt: skip
    if len(set(names)) < len(names):
        again = next(name for name in names if names.count(name) > 1)
        raise TrajectoryError(f"two vehicles are named {again!r}. Rename a file or a vehicle.")
    curves = [curve for part in parts for curve in part.curves]
    notes = [note for part in parts for note in part.notes]
    exact = parts[0].assumed in (texts.POLYNOMIALS, shows.BEZIER)
    notes += _spans(names, curves, listed, exact=exact)
    if not exact:
        curves = _common_part(curves)
    notes = [*dict.fromkeys(notes)]
    if len(notes) > _NOTES:
        notes[_NOTES:] = [f"of the files there are {len(notes) - _NOTES:,} more notes like these"]
    return Trajectories(tuple(names), tuple(curves), parts[0].assumed, tuple(notes), _alike(parts))


def _on_one_clock(parts: list[Trajectories], listed: list[list[Path]]) -> list[Trajectories]:
    """The same parts, those that count their times from a date all from the first one.

    Raises
    ------
    TrajectoryError
        Some times are dates and others not.
    """
    since = [part.read[0].get("since_1970_ns") for part in parts]
    dated = [x for x in since if x is not None]
    if not dated:
        return parts
    if len(dated) < len(parts):
        i, j = since.index(None), next(k for k, x in enumerate(since) if x is not None)
        raise TrajectoryError(
            f"{listed[i][0]}: has times that are no dates, and {listed[j][0]} has dates. Give all files one clock."
        )
    begins = [(x - min(dated)) / 1e9 for x in dated]
    return [
        part._replace(curves=tuple(curve.later(begin) for curve in part.curves)) if begin else part
        for part, begin in zip(parts, begins, strict=True)
    ]


def _alike(parts: list[Trajectories]) -> tuple[dict[str, Any], ...]:
    """What was taken for what, once for files that are alike."""
    every: dict[str, dict[str, Any]] = {}
    for part in parts:
        record = {k: v for k, v in part.read[0].items() if k not in ("rows", "since_1970_ns")}
        nothing = {"files": 0, "vehicles": 0, "rows": 0, "begin_s": np.inf, "end_s": -np.inf}
        own = every.setdefault(repr(record), nothing | {"rate_hz": 0.0} | record)
        own["files"] += 1
        own["vehicles"] += len(part.names)
        own["rows"] += part.read[0].get("rows", 0)
        own["begin_s"] = min(own["begin_s"], *(float(curve.time[0]) for curve in part.curves))
        own["end_s"] = max(own["end_s"], *(float(curve.time[-1]) for curve in part.curves))
        seconds = own["vehicles"] * (own["end_s"] - own["begin_s"])
        own["rate_hz"] = round(own["rows"] / seconds, 6)
    return tuple(every.values())


def files_of(path: Path) -> list[list[Path]]:
    """The files of a path, those of one vehicle that follow each other together."""
    if not path.is_dir():
        return [[path]]
    inside = sorted((p for p in path.iterdir() if not p.name.startswith(".")), key=_order)
    recordings = [p for p in inside if p.suffix == ".mcap"]
    if recordings:
        return [[p] for p in recordings]
    tables = [p for p in inside if p.suffix.lower() == ".csv"]
    if tables:
        return [[p] for p in tables]
    folders = [p for p in inside if p.is_dir()]
    groups = [sorted(folder.glob("*.csv"), key=_order) for folder in folders]
    if not groups or not all(groups):
        bare = next((f for f, g in zip(folders, groups, strict=True) if not g), path)
        raise TrajectoryError(
            f"{bare}: the folder has no .csv and no .mcap. Give a folder with one table a vehicle."
        )
    return groups


def _order(path: Path) -> list[tuple[int, str]]:
    """Names in the order of the numbers in them: 2 before 10."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(x), "") if x.isdecimal() and len(x) < 19 else (-1, x) for x in parts]


def _of_sequence(group: list[Path], interpolation: Interpolation, units: Units) -> Trajectories:
    """What is in the file of a vehicle, or in several that it flies one after the other."""
    first, *others = (_of_file(path, interpolation, units) for path in group)
    if not others:
        return first
    if first.assumed != texts.POLYNOMIALS:
        raise TrajectoryError(
            f"{group[0]}: only tables of polynomials follow each other. Give a folder with one table a vehicle."
        )
    curve, *more = (part.curves[0] for part in (first, *others))
    for path, part in zip(group[1:], others, strict=True):
        if part.assumed != first.assumed:
            raise TrajectoryError(f"{path}: is of another kind than {group[0]}.")
    for after in more:
        time = np.concatenate([curve.time, after.time[1:] + curve.time[-1]])
        curve = Piecewise(time, np.concatenate([curve.pieces, after.pieces]))
    name = group[0].parent.name
    return Trajectories((name,), (curve,), first.assumed, first.notes, first.read)


def _of_file(path: Path, interpolation: Interpolation, units: Units) -> Trajectories:
    """What is in one file, by its content."""
    try:
        size = path.stat().st_size
        if size > _BYTES:
            raise TrajectoryError(
                f"{path}: has {size >> 20} MiB, more than {_BYTES >> 20}. Split it, or give fewer samples."
            )
        data = path.read_bytes()
    except OSError as error:
        raise TrajectoryError(f"{path}: {why_not(error, 'read', path)}") from error
    name = str(path)
    if data.startswith(_HDF):
        raise TrajectoryError(f"{name}: is a result of `rigidfleet run`. Use `rigidfleet report`.")
    record: dict[str, Any] = {}
    notes: Sequence[str] = ()
    if data.startswith(_ZIP) or path.suffix.lower() == ".skyc":
        names, curves = shows.read_show(data, name)
        assumed = shows.BEZIER
    elif data.startswith(_MCAP) or path.suffix.lower() == ".mcap":
        names, curves, record["since_1970_ns"] = poses.read_poses(data, name, interpolation)
        assumed = ASSUMED[interpolation]
    else:
        try:
            names, curves, assumed, notes, record = texts.read_text(
                data, path, interpolation, units
            )
        except TableError as error:
            line, _, problem, remedy = error.faults[0]
            place = f"line {line}: " if line else ""
            ends = "" if remedy.endswith("?") else "."
            told = f"{name}: {place}{problem}. {remedy}{ends}".replace("?. ", "? ")
            raise TrajectoryError(told) from None
    read = Trajectories(tuple(names), tuple(curves), assumed, tuple(notes), (record,))
    if (units.words or units.axes) and "units" not in record:
        raise TrajectoryError(f"{name}: says its units and axes itself. Remove --units and --axes.")
    for who, curve in zip(read.names, read.curves, strict=True):
        _check_size(name, who, curve)
    return read


def _check_size(name: str, who: str, curve: Piecewise) -> None:
    """Refuse numbers with which no distance can be computed.

    Raises
    ------
    TrajectoryError
        A position or time is not finite or larger than `FARTHEST`.
    """
    h = np.diff(curve.time)
    with np.errstate(all="ignore"):
        powers = h[:, None, None] ** np.arange(curve.pieces.shape[2])
        reach = np.abs(curve.pieces[:, :3] * powers).sum(axis=2).max(axis=1)
    if not (np.abs(curve.time[[0, -1]]) <= FARTHEST).all():
        raise TrajectoryError(
            f"{name}: {who} flies from {curve.time[0]:.9g} to {curve.time[-1]:.9g} s; the most is {FARTHEST:g} s. Let "
            "times begin at 0, in seconds, or name their unit: time [ms]."
        )
    bad = np.flatnonzero(~(reach <= FARTHEST))
    if len(bad):
        k = int(bad[0])
        raise TrajectoryError(
            f"{name}: {who} reaches {reach[k]:.3g} m from the origin in piece {k + 1}, which begins at "
            f"{curve.time[k]:.3g} s; the most is {FARTHEST:g} m. Give metres and seconds, or name other units."
        )


def _spans(
    names: Sequence[str], curves: Sequence[Piecewise], listed: list[list[Path]], *, exact: bool
) -> list[str]:
    """A note if vehicles begin or end at different times.

    Raises
    ------
    TrajectoryError
        Samples begin or end at times that differ by more than a sample.
    """
    starts = np.array([curve.time[0] for curve in curves])
    ends = np.array([curve.time[-1] for curve in curves])
    if exact:
        if np.ptp(ends) <= 1e-6 and np.ptp(starts) <= 1e-6:
            return []
        return [
            f"vehicles begin between {starts.min():g} and {starts.max():g} s and end between {ends.min():g} and "
            f"{ends.max():g} s; each stays at its first and last place outside of its time"
        ]
    step = max(float(np.diff(curve.time).max()) for curve in curves)
    for what, t, late in (("begins", starts, starts.max()), ("ends", ends, ends.min())):
        far = np.abs(t - late)
        if far.max() > step:
            i, j = int(far.argmax()), int(far.argmin())
            raise TrajectoryError(
                f"{listed[min(i, len(listed) - 1)][0]}: {names[i]!r} {what} at {t[i]:g} s, and {names[j]!r} at "
                f"{t[j]:g} s. Give all vehicles the same span of time."
            )
    return []


def _common_part(curves: list[Piecewise]) -> list[Piecewise]:
    """The part of all curves in which every vehicle has samples."""
    start, end = max(c.time[0] for c in curves), min(c.time[-1] for c in curves)
    return [
        c if c.time[0] == start and c.time[-1] == end else c.between(start, end) for c in curves
    ]
