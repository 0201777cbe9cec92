"""Trajectories that others made: from files to polynomials of each vehicle.

`read_trajectories` reads tables of setpoints, Crazyswarm2's tables of polynomials, Skybrush's shows, recordings of
ROS 2, logs of autopilots, and folders of any of these. Nothing in a file is believed but positions over time: where it
has samples, a curve through them is assumed and named; velocities that a table states are only compared with it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args

import numpy as np

from rigidfleet._common.files import os_error_in_words
from rigidfleet._common.reading import Gaps, Interpolation, Spans
from rigidfleet._common.tables import ContentError, fault
from rigidfleet._common.text import first_few
from rigidfleet.errors import TrajectoryError
from rigidfleet.foreign import logs, poses, shows, texts
from rigidfleet.foreign.columns import Units, parse_units
from rigidfleet.foreign.curves import ASSUMED, Trajectories
from rigidfleet.math.piecewise import Piecewise, concatenate_curves

__all__ = ["Gaps", "Interpolation", "Spans", "Trajectories", "read_trajectories"]

#: Greatest size of a file [bytes], number of files, and coordinate [m] or time [s] of a trajectory.
_BYTES, _FILES, FARTHEST = 256 << 20, 20_000, 1e6
#: Greatest number of notes on what was read.
_NOTES = 10
_ZIP = b"PK"
#: Exports of motion capture have several lines of names. Motive lets its user choose the axes, and writes them nowhere
#: ("Axis Convention" in its manual of CSV exports); Vicon's have frames, and markers or bodies as the user chose.
_CAPTURE = (
    "is an export of {}, with names of bodies above x, y and z: give one line of names such as time_s,cf1_x_mm,"
    "cf1_y_mm,cf1_z_mm,cf2_x_mm above the rows, and say --axes eus if y points up"
)
#: What is not read, by its first bytes (a line may end in any way), and what to do with it.
_REFUSED = {
    b"Format Version,": _CAPTURE.format("Motive"),
    **dict.fromkeys((b"Objects\n", b"Segments\n", b"Trajectories\n"), _CAPTURE.format("Vicon")),
    b"\x89HDF": "is HDF5. Give a result of `rigidfleet run` alone, and any other data as CSV",
    b"#ROSBAG": "is of ROS 1. Convert it: pip install rosbags; rosbags-convert --src {} --dst FOLDER",
    b"\x1f\x8b": "is compressed. Unpack it: gunzip {}",
    b"{": "is JSON, and no table. Give a table with a line of names such as time_s,x_m,y_m,z_m",
    poses.ZSTANDARD: "is compressed as a whole. Unpack it: zstd -d {}",
}
#: Suffixes of recordings and logs, which may be longer than what is read as a whole, and of all files of trajectories
#: in a folder. Files ``.bin`` are logs only by their content.
_RECORDINGS, _LOGS = (".mcap", ".db3", ".zstd"), (".ulg", ".tlog")
SUFFIXES = (".csv", ".skyc", *_RECORDINGS, *_LOGS)
#: A time between two samples that is noted, and one that is refused, in usual steps (medians) of the vehicle; repeated
#: positions that are noted.
_NOTED, _LONGEST, _REPEATED = 1.5, 10.0, 5
#: How many times as far as any other place one is that stands for no position.
_BEYOND = 5.0
#: Share of a number that is rounding, and the greatest number of things that a note lists.
_ROUNDING, _LISTED = 1e-6, 5


def read_trajectories(
    files: str | Path | Sequence[str | Path],
    interpolation: Interpolation = "cubic",
    *,
    spans: Spans = "refuse",
    gaps: Gaps = "refuse",
    units: str | None = None,
    axes: str | None = None,
    topic: str | Sequence[str] = (),
    origin: logs.Geodetic | None = None,
) -> Trajectories:
    """Read the trajectories of all vehicles of one or several files or folders.

    Parameters
    ----------
    files : a table of setpoints (CSV with a header, for one vehicle or with a column ``agent``), a table of polynomials
        (Crazyswarm2's CSV, one vehicle), a show, a recording of ROS 2, a log of an autopilot (`SUFFIXES`), or a folder:
        each CSV or log in it is a vehicle, each folder in it a vehicle whose CSVs, in the order of their numbers,
        follow each other; or a folder that rosbag2 wrote
    interpolation : between samples, ``cubic`` (the cubic spline through the positions, with continuous acceleration) or
        ``linear``; formats of polynomials say themselves what is between
    spans : what a vehicle does that has samples later than others, or no longer, by more than its usual step: it
        stands at its first or last place, or is ``away``. Within a step it is not judged where it has no samples.
        Curves of shows and polynomials stand unless they are to be ``away``
    gaps : whether a time between two samples of more than ten usual steps is an error, or is bridged by the curve
    units : of columns of a table that do not say theirs, of time, length and angle in any order: ``"ms,mm,deg"``
    axes : where x, y and z of a table point: three of e, n, u, w, s and d, such as ``"ned"``
    topic : of logs and recordings, the topic or topics with positions, such as ``"/cf*/pose"``; else they are chosen,
        and named in a note
    origin : latitude, longitude [deg] and height above mean sea level [m] of the origin of positions, for logs that
        know where they are on the Earth; else that of the first vehicle's estimator, or its first place

    Raises
    ------
    TrajectoryError
        A file cannot be read, or a part of it is not there; the message names the file and the line or entry.
    ValueError
        A word is unknown.
    """
    for word, known in ((interpolation, Interpolation), (spans, Spans), (gaps, Gaps)):
        if word not in get_args(known):
            raise ValueError(f"there is no {word!r}; use {' or '.join(get_args(known))}")
    if origin and not (abs(origin[0]) < 90.0 and abs(origin[1]) <= 180.0 and abs(origin[2]) < 2e4):
        remedy = "Give latitude, longitude [deg] and height [m]"
        raise _error("origin", f"{origin} is no place on the Earth", remedy)
    paths = [Path(files)] if isinstance(files, str | Path) else [Path(file) for file in files]
    if not paths:
        raise TrajectoryError("no file was given. Give at least one.")
    listed = [group for path in paths for group in groups_of_files(path)]
    if len(listed) > _FILES:
        raise TrajectoryError(f"{paths[0]}: {len(listed):,} files are more than {_FILES:,}.")
    left_out = [note for path in paths for note in _notes_on_unread_files(path, listed)]
    topics, words = (topic,) if isinstance(topic, str) else tuple(topic), parse_units(units, axes)
    sources, parts, several = [group[0] for group in listed], [], len(listed) > 1
    for group in listed:
        parts.append(_read_sequence(group, interpolation, words, topics, origin, several))
        origin = origin or parts[-1].read[0].get("origin")
    parts = _put_on_one_clock(parts, sources)
    assumed = parts[0].assumed
    for part, source in zip(parts, sources, strict=True):
        if part.assumed != assumed:
            remedy = "Give files of one kind for one flight"
            raise _error(source, f"is of another kind than {sources[0]}", remedy)
    names = _names_of_vehicles(parts, sources)
    curves = tuple(curve for part in parts for curve in part.curves)
    whose: dict[str, list[str]] = {}
    for part, source in zip(parts, sources, strict=True):
        for note in part.notes:
            who = source.stem if several and "clock" in part.read[0] else ""
            whose.setdefault(note, []).append(who)
    notes = [*logs.notes_with_names(whose)]
    if several and any(part.read[0].get("clock") == logs.GNSS for part in parts):
        notes.insert(0, f"the clock that vehicles have in common is {logs.GNSS}")
    every = (part.read[0] for part in parts if part.read)
    if words := logs.mixed_frames_in_words(
        {x["frame"] for x in every if "frame" in x and "origin" not in x}
    ):
        if not topics:
            raise _error(sources[0], words, logs.ONE_FRAME)
        notes.append(words)
    own_clocks = several and any(part.own_clocks for part in parts)
    if own_clocks:
        spans = "away"
        notes.insert(
            0, "each vehicle has a clock of its own: times of one say nothing of another's"
        )
    if len(notes) > _NOTES:
        notes[_NOTES:] = [f"of the files there are {len(notes) - _NOTES:,} more notes like these"]
    sampled = assumed in ASSUMED.values()
    away = spans == "away" or (sampled and spans == "refuse")
    since = min(part.read[0].get("since_1970_ns") or 0 for part in parts) / 1e9
    records = _merge_reading_records(parts)
    measured = tuple(own for part in parts for own in part.measured)
    measured = measured if len(measured) == len(curves) else ()
    read = Trajectories(names, curves, assumed, (), records, away, since, measured, own_clocks)
    if sampled:
        whence = [x for part, x in zip(parts, sources, strict=True) for _ in part.names]
        notes += _notes_on_gaps(read, whence, spans, gaps)
    return read._replace(notes=(*left_out, *notes, *_note_on_spans(read)))


def _error(where: object, why: str, remedy: str) -> TrajectoryError:
    return TrajectoryError(f"{where}: {why}. {remedy}.")


def _names_of_vehicles(parts: list[Trajectories], sources: list[Path]) -> tuple[str, ...]:
    """Names as files have them; if two are alike, those of files, or of their folders, say whose they are.

    Raises
    ------
    TrajectoryError
        Two are alike all the same.
    """
    names = [name for part in parts for name in part.names]
    if len(set(names)) < len(names):
        stems = [path.stem for path in sources]
        files = [x.stem if stems.count(x.stem) == 1 else x.resolve().parent.name for x in sources]
        own = [(file, part.names) for file, part in zip(files, parts, strict=True)]
        names = [f"{x}/{name}" if len(every) > 1 else x for x, every in own for name in every]
    for again in names if len(set(names)) < len(names) else ():
        if names.count(again) > 1:
            raise TrajectoryError(f"two vehicles are named {again!r}. Rename a file or a vehicle.")
    return tuple(names)


def _put_on_one_clock(parts: list[Trajectories], sources: list[Path]) -> list[Trajectories]:
    """The same parts, those that count their times from a date all from the first one.

    Raises
    ------
    TrajectoryError
        Some times are dates and others not.
    """
    dates = [part.read[0].get("since_1970_ns") for part in parts]
    dated = {date: source for date, source in zip(dates, sources, strict=True) if date is not None}
    if dated and None in dates:
        why = f"has times that are no dates, and {next(iter(dated.values()))} has dates"
        raise _error(sources[dates.index(None)], why, "Give all files one clock")
    since = [(date - min(dated)) / 1e9 if dated else 0.0 for date in dates]
    return [
        part._replace(curves=tuple(curve.shift_time(begin) for curve in part.curves))
        for part, begin in zip(parts, since, strict=True)
    ]


def _merge_reading_records(parts: list[Trajectories]) -> tuple[dict[str, Any], ...]:
    """What was taken for what, once for files that are alike."""
    alike: dict[str, list[Trajectories]] = {}
    for part in parts:
        record = {k: v for k, v in part.read[0].items() if k not in ("rows", "since_1970_ns")}
        alike.setdefault(repr(record), []).append(part._replace(read=(record, part.read[0])))
    records = []
    for same in alike.values():
        times = [curve.time for part in same for curve in part.curves]
        begins, ends = np.transpose([time[[0, -1]] for time in times])
        steps, seconds = sum(len(time) - 1 for time in times), float((ends - begins).sum())
        records.append({
            "files": len(same), "vehicles": len(times), "rows": sum(part.read[1].get("rows", 0) for part in same),
            "begin_s": float(begins.min()), "end_s": float(ends.max()), "rate_hz": round(steps / seconds, 6),
            **same[0].read[0],
        })  # fmt: skip
    return tuple(records)


def groups_of_files(path: Path) -> list[list[Path]]:
    """The files of a path, those of one vehicle that follow each other together.

    Raises
    ------
    TrajectoryError
        A folder has files of several kinds or none, or a piece of a sequence is missing.
    """
    if not path.is_dir():
        return [[path]]
    inside = _visible_files(path)
    parts = [p for p in inside if p.suffix.lower() in _RECORDINGS]
    if parts and (path / "metadata.yaml").is_file():
        return [parts]
    files = [p for p in inside if p.is_file() and _may_have_trajectories(p)]
    kinds = {p.suffix.lower() for p in files}
    if len(kinds) > 1:
        why = f"the folder has files {' and '.join(sorted(kinds))}"
        raise _error(path, why, "Give files of one kind for one flight")
    if files:
        return [[p] for p in files]
    folders = [p for p in inside if p.is_dir()]
    groups = {x: [p for p in _visible_files(x) if p.suffix.lower() == ".csv"] for x in folders}
    for folder, group in groups.items() or [(path, [])]:
        if not group:
            why = f"the folder has no {', '.join(SUFFIXES[:3])} or log"
            raise _error(folder, why, "Give a folder with one table a vehicle")
        numbers = zip(*(re.findall(r"\d+", p.stem) for p in group), strict=False)
        counts = [[int(x) for x in column] for column in numbers if len({*column}) > 1]
        whole = [[*range(first, first + len(group))] for first in (0, 1)]
        if len(group) > 1 and (len(counts) != 1 or counts[0] not in whole):
            remedy = "Number the tables that a vehicle flies one after the other from 0 or 1 on, and leave none out"
            raise _error(folder, f"{first_few([p.name for p in group])} are no sequence", remedy)
    return [*groups.values()]


def _notes_on_unread_files(path: Path, listed: list[list[Path]]) -> list[str]:
    """A note on the files that are not read, if the path is a folder with such.

    Raises
    ------
    TrajectoryError
        One of them may be a further vehicle.
    """
    read = {p for group in listed for p in group}
    inside = sorted(path.rglob("*"), key=logs.natural_sort_key)
    rest = [p for p in inside if p.is_file() and p not in read]
    for p in rest:
        hidden = _may_have_trajectories(p) and not _is_hidden(p)
        if not hidden:
            with suppress(TrajectoryError):
                hidden = bool(_read_file([p], "linear", parse_units(None, None), (), None, False))
        if hidden:
            why = f"may be a further vehicle, but is not read beside {listed[0][0].name}"
            raise _error(p, why, "Give its path as well, or move it out of the folder")
    names = first_few([p.relative_to(path) for p in rest])
    return [f"of '{path.name}', {names} is not read"] if rest else []


def _visible_files(folder: Path) -> list[Path]:
    """What is in a folder, in order, and not hidden."""
    return [p for p in sorted(folder.iterdir(), key=logs.natural_sort_key) if not _is_hidden(p)]


def _may_have_trajectories(path: Path) -> bool:
    """Whether a file may have trajectories, by its name; of one named ``.bin``, by its content."""
    suffix = path.suffix.lower()
    return suffix in SUFFIXES or (suffix == ".bin" and _first_bytes_of(path).startswith(logs.BIN))


def _first_bytes_of(path: Path) -> bytes:
    """The first bytes of a file.

    Raises
    ------
    TrajectoryError
        It cannot be read.
    """
    try:
        with path.open("rb") as file:
            return file.read(16)
    except OSError as error:
        raise TrajectoryError(f"{path}: {os_error_in_words(error, 'read', path)}") from error


def _is_hidden(path: Path) -> bool:
    """Whether a file or folder is no one's own, as what systems put beside others."""
    return path.name.startswith((".", "__MACOSX"))


def _read_sequence(group: list[Path], *options: Any) -> Trajectories:
    """What is in the file of a vehicle, in the parts of a recording, or in several files that follow each other."""
    if len(group) == 1 or group[0].suffix.lower() in _RECORDINGS:
        return _read_file(group, *options)
    parts = [_read_file([path], *options) for path in group]
    if {part.assumed for part in parts} != {texts.POLYNOMIALS}:
        why = "only tables of polynomials follow each other"
        raise _error(group[0], why, "Give a folder with one table a vehicle")
    curve = concatenate_curves([part.curves[0] for part in parts])
    return parts[0]._replace(names=(group[0].parent.name,), curves=(curve,))


def _read_file(
    parts: list[Path], interpolation: str, units: Units, topics: tuple[str, ...], origin: Any, several: bool
) -> Trajectories:  # fmt: skip
    """What is in one file of ``several``, or in the parts of a recording, by its content; see `read_trajectories`."""
    path = parts[0]
    head, suffix, log = _first_bytes_of(path), path.suffix.lower(), None
    for begin, why in _REFUSED.items():
        if head.replace(b"\r", b"\n").startswith(begin):
            raise TrajectoryError(f"{path}: {why.format(path.name)}.")
    try:
        if head.startswith((poses.MCAP, poses.SQLITE)) or suffix in _RECORDINGS:
            log = poses.read_recording(parts, topics)
        elif head.startswith((logs.ULOG, logs.BIN)) or suffix in _LOGS:
            log = logs.read_log(path, head)
        if log is not None:
            read = logs.trajectories_of(log, path.stem, interpolation, topics, origin, several)
        elif topics:
            raise fault("has no topics", "Remove --topic")
        elif head.startswith(_ZIP) or suffix == ".skyc":
            read = shows.read_show(_content_of(path))
        else:
            read = texts.read_text_table(_content_of(path), path.stem, interpolation, units)
        if (units.words or units.axes) and "units" not in read.read[0]:
            raise fault("says its units and axes itself", "Remove --units and --axes")
        for who, curve in zip(read.names, read.curves, strict=True):
            _refuse_huge_numbers(who, curve)
    except OSError as error:
        raise TrajectoryError(f"{path}: {os_error_in_words(error, 'read', path)}") from error
    except ContentError as error:
        raise TrajectoryError(f"{path}: {error}") from None
    return read


def _content_of(path: Path) -> bytes:
    """All of a file that is not too large."""
    size = path.stat().st_size
    if size > _BYTES:
        why = f"has {size >> 20} MiB, more than {_BYTES >> 20}"
        raise fault(why, "Split it, or give fewer samples")
    return path.read_bytes()


def _refuse_huge_numbers(who: str, curve: Piecewise) -> None:
    """Refuse numbers with which no distance can be computed.

    Raises
    ------
    ContentError
        A position or time is not finite or larger than `FARTHEST`.
    """
    begin, end = curve.time[[0, -1]]
    if not (abs(begin) <= FARTHEST and abs(end) <= FARTHEST):
        why = f"{who} flies from {begin:.9g} to {end:.9g} s; the most is {FARTHEST:g} s"
        raise fault(why, "Let times begin at 0, in seconds, or name their unit: time [ms]")
    with np.errstate(all="ignore"):
        powers = np.diff(curve.time)[:, None, None] ** np.arange(curve.pieces.shape[2])
        reach = np.abs(curve.pieces[:, :3] * powers).sum(axis=2).max(axis=1)
    bad = np.flatnonzero(~(reach <= FARTHEST))
    if len(bad):
        k = int(bad[0])
        where = f"from the origin in piece {k + 1}, which begins at {curve.time[k]:.3g} s"
        why = f"{who} reaches {reach[k]:.3g} m {where}; the most is {FARTHEST:g} m"
        raise fault(why, "Give metres and seconds, or name other units")


def _notes_on_gaps(read: Trajectories, sources: list[Path], spans: Spans, gaps: Gaps) -> list[str]:
    """Notes on where samples leave open what a vehicle does: gaps, and a standstill that may be one.

    Raises
    ------
    TrajectoryError
        A vehicle begins or ends by more than its usual step after or before others, or has a long gap, and ``spans``
        or ``gaps`` do not say what that is.
    """
    names, curves = read.names, read.curves
    begin, end = min(c.time[0] for c in curves), max(c.time[-1] for c in curves)
    holes: list[tuple[float, int, int]] = []
    frozen: list[str] = []
    for i, (name, curve, source) in enumerate(zip(names, curves, sources, strict=True)):
        steps, (first, last) = np.diff(curve.time), curve.time[[0, -1]]
        shares = steps / (np.median(steps) * (1.0 + _ROUNDING))
        if spans == "refuse" and max(first - begin, end - last) * shares[0] > steps[0]:
            why = f"{name!r} has samples from {first:g} to {last:g} s, and others from {begin:g} to {end:g} s"
            remedy = "Give all vehicles the same span of time (a recording in parts by its folder with metadata.yaml)"
            words = "or say what it does before and after: `assess --spans stand` or `--spans away`"
            raise _error(source, why, f"{remedy}, {words}")
        k = int(shares.argmax())
        if gaps == "refuse" and shares[k] > _LONGEST:
            why = f"{name!r} has no sample between {curve.time[k]:g} and {curve.time[k + 1]:g} s, {shares[k]:.0f} times"
            remedy = "Give its samples, or let the curve bridge the gap: `--gaps bridge`"
            raise _error(source, f"{why} its usual step", remedy)
        holes += [(float(shares[k]), i, k) for k in np.flatnonzero(shares > _NOTED).tolist()]
        moves = np.linalg.norm(np.diff(curve.pieces[:, :3, 0], axis=0), axis=1)
        moving = np.flatnonzero(moves > 1e-9)
        # A vehicle that stood begins to move by ever longer steps, or was slow before, too.
        sizes = np.append(moves[moving], np.inf)
        fast = sizes > 0.5 * np.median(sizes)
        odd = (fast[:-2] & fast[1:-1]) | (sizes[1:-1] > 1.5 * sizes[2:])
        # One number for x, y and z, such as 9999, stands for no position if nothing else is nearly as far; 0, -1 and
        # corners of a square may be places.
        place = np.abs(curve.pieces[:, :3, 0])
        number = np.where((place == place[:, :1]).all(axis=1), place[:, 0], np.nan)
        leaps = moves > _LONGEST * np.median(sizes)
        both = np.intersect1d(number[1:][leaps], number[:-1][leaps])
        if len(both) and both[-1] > _BEYOND * place[number != both[-1]].max(initial=0.1):
            why = f"{name!r} leaps to a place of which each coordinate is {both[-1]:g} m in size, and back"
            raise _error(source, f"{why}, as if it had none there", "Leave out such rows")
        leaps &= np.isin(number[:-1], [0.0, *both]) | np.isin(number[1:], [0.0, *both])
        frozen += [f"{name!r} at {curve.time[k + 1]:g} s" for k in np.flatnonzero(leaps)[:1]]
        for k in np.flatnonzero((np.diff(moving) > _REPEATED) & odd).tolist():
            start, stop = curve.time[[moving[k] + 1, moving[k + 1]]]
            frozen.append(f"{name!r} from {start:g} to {stop:g} s")
    notes = []
    for share, i, k in sorted(holes, reverse=True)[:_LISTED]:
        t = np.linspace(*curves[i].time[k : k + 2], 101)
        place, nearest = curves[i].at(t)[:, :3], (np.inf, 0.0, "")
        for name, other in zip(names, curves, strict=True):
            if other is not curves[i]:
                inside = np.clip(t, *other.time[[0, -1]])
                far = np.linalg.norm(other.at(inside)[:, :3] - place, axis=1)
                far[(inside != t) & read.away] = np.inf
                nearest = min(nearest, (float(far.min()), float(t[far.argmin()]), name))
        words = f"{names[i]!r} has no sample between {t[0]:g} and {t[-1]:g} s, {share:.3g} times its usual step: its"
        words += " curve is assumed there"
        if nearest[0] < np.inf:
            far, when, name = nearest
            words += f", {far:.3g} m from {name!r} at {when:.3g} s, centre to centre"
        notes.append(words)
    if len(holes) > _LISTED:
        notes.append(f"{len(holes) - _LISTED:,} shorter gaps between samples are bridged, too")
    if frozen:
        words = "positions repeat to the last digit between moves, or leap from or to 0 or one number for x, y and z"
        words += f", {first_few(frozen)}"
        notes.append(f"{words}: a hold, or a tracker that lost sight of it")
    return notes


def _note_on_spans(read: Trajectories) -> list[str]:
    """A note if vehicles begin or end at different times."""
    starts, ends = np.array([curve.time[[0, -1]] for curve in read.curves]).T
    begin, end = starts.min(), ends.max()
    every = zip(read.names, starts, ends, strict=True)
    short = [each for each in every if max(each[1] - begin, end - each[2]) > 1e-6]
    part = [f"{name!r} from {a:.9g} to {b:.9g} s" for name, a, b in short]
    if not part:
        return []
    if not read.away:
        return [f"{first_few(part)}: each stays at its first and last place outside of its time"]
    apart = len(starts) ** 2 - int(np.searchsorted(np.sort(starts), ends, side="right").sum())
    never = f"; {apart:,} pairs are never there at one time, and not judged" if apart else ""
    return [f"vehicles are judged only where they have data: {first_few(part)}{never}"]
