"""Tables of places over time: which vehicles they have, where these are and when, and what was taken for what."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime
from decimal import Decimal
from typing import Any, NamedTuple

import numpy as np

from rigidfleet._common.names import (
    DIRECTIONS,
    ROLES,
    SOURCE_WORDS,
    meaning_of,
    unit_of,
)
from rigidfleet._common.tables import DEFAULT, SEPARATORS, TextTable, are_axes, fault, is_number
from rigidfleet.errors import TrajectoryError
from rigidfleet.math.geodesy import turn_to_enu
from rigidfleet.typing import Floats, Ints

#: Columns of a trajectory without names, as TUM's tools for trajectories of cameras write it.
_TUM = ["timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw"]
#: Seconds since 1970 of stamps that are dates: 2001 to 2096; and units in which they are counted without saying so.
_DATES, _TICKS = (10**9, 4 * 10**9), ("s", "ms", "us", "ns")
#: Greatest speed of a flight that is doubted, if steps are so long [m/s, s]; and one that is doubted anyway.
_SLOW, _LONG, _FAST = 0.1, 1.0, 100.0
#: Rows are of several vehicles if their ways are so much shorter than that of one: a share.
_SHORTER = 0.5
#: Rows of a part, on average, from which on its way is no shorter because it is a part (that of a heading, a battery);
#: and the greatest step in time and place from one part of a flight to the next, in those within parts.
_ROWS, _CONTINUES = 3, 5.0
#: Numbers of vehicles that may take turns, and rows by which this is seen.
_TURNS, _FIRST = range(2, 17), 1000
#: Words for what a row may say of itself.
_FLAGS = re.compile(r"(?i)valid|status|flag|ok|quality|lost|track|visible|occluded|fix|health")


class Doubt(str):
    """A note on a file whose numbers may mean something else: a verdict tells it, and it is not flown."""


class Units(NamedTuple):
    """What a user says of columns that do not say it: units by dimension, and the directions of x, y and z or ""."""

    words: dict[str, str]
    axes: str


class Track(NamedTuple):
    """Rows of one vehicle: its name, lines (K,), times (K,) [s], places and velocities (K, 3), yaws (K,) [rad]."""

    name: str
    lines: Ints
    time: Floats
    place: Floats
    velocity: Floats | None
    yaw: Floats | None


class _Places(NamedTuple):
    """Directions of a vehicle's axes, and the columns of its place, velocity, yaw and quaternion."""

    axes: str
    place: list[int]
    velocity: list[int]
    yaw: list[int]
    quaternion: list[int]


def parse_units(units: str | None, axes: str | None) -> Units:
    """The words of a user: units such as ``"ms,mm,deg"``, in any order, and axes such as ``"ned"``.

    Raises
    ------
    TrajectoryError
        A unit is unknown, or two are of one quantity; or axes are no three directions.
    """
    words: dict[str, str] = {}
    for word in re.split(r"[,\s]+", units.strip()) if units else ():
        dimension = (unit_of(word) or ("",))[0]
        if dimension not in DEFAULT or dimension in words:
            remedy = "give one unit each of time, length and angle, such as ms,mm,deg."
            raise TrajectoryError(f"units: {word!r}: {remedy}")
        words[dimension] = word
    axes = (axes or "").lower()
    if axes and not are_axes(axes):
        remedy = "say where x, y and z point, such as enu (east, north, up) or ned."
        raise TrajectoryError(f"axes: {axes!r}: {remedy}")
    return Units(words, axes)


def parse_table(data: bytes, words: Units) -> tuple[TextTable, list[str]]:
    """A table of trajectories or of polynomials, and doubts of its head.

    Raises
    ------
    ContentError
        It is none.
    """
    table, notes = TextTable(data, {len(_TUM): _TUM}, words.words), []
    if not table.columns:
        bare = any(line.strip() for line in table.texts)
        why = "has no names of columns that are understood" if bare else "is empty"
        raise fault(why, "Give a table with a line of names such as time_s,x_m,y_m,z_m")
    if not table.named:
        turned = table.numbers_of_columns(range(4, 8))
        unit = (np.abs(np.linalg.norm(turned, axis=1) - 1.0) < 0.01).all()
        if table.separator not in " \t" or not unit:
            why = "has no names of columns, and no 8 numbers between blanks as TUM's"
            raise fault(why, "Begin with a line such as time_s,x_m,y_m,z_m", 1)
        notes.append(f"8 numbers a line without names are read as TUM's: {' '.join(_TUM)}")
        if (np.linalg.norm(turned[:, :2], axis=1) > np.sqrt(0.5)).any():
            del table.places["qw", ""]
            notes.append("attitudes are upside down, and not read: is their order another one?")
    if words == ({}, ""):
        notes += [Doubt(f"{doubt} Say --units or --axes") for doubt in table.unread]
    return table, notes


def _times_and_epoch(table: TextTable, notes: list[str]) -> tuple[Floats, int | None]:
    """Times (K,) [s], and the nanoseconds since 1970 from which they count; None if they are no dates."""
    if not (columns := table.find_columns("time")):
        raise table.missing_columns_error("time")
    fields = table.columns[columns[0]].tolist() or [""]
    number = is_number(fields[0])
    if not table.lines.size or (number and abs(float(fields[0].replace(",", "."))) < _DATES[0]):
        return table.numbers_of_columns(columns)[:, 0], None
    if number:
        table.factor(columns[0])  # its unit is noted
    ticks = []
    for line, field in zip(table.lines.tolist(), fields, strict=True):
        if (tick := _parse_number_or_date(field)) is None:
            why = f"the time {table.names[columns[0]]} is {field[:40] or 'empty'}, neither a finite number nor a date"
            raise fault(why, "Write one, such as 2026-05-01T12:00:00.5Z", line)
        ticks.append(tick)
    if not number:
        table.units["time"] = "dates", "the file"
    unit, source = table.units["time"]
    if not source:
        power = next((k for k in range(4) if _DATES[0] <= ticks[0] / 1000**k < _DATES[1]), 0)
        unit = _TICKS[power]
        table.units["time"] = unit, "its size"
        notes += [f"times such as {fields[0]} are read as {unit} since 1970"] * (power > 0)
    factor = Decimal(str((unit_of(unit) or ("", 1.0))[1]))
    since = ticks[0] * factor
    time = np.array([float((tick - ticks[0]) * factor) for tick in ticks])
    if _DATES[0] <= since < _DATES[1]:
        return time, int(since * 10**9)
    return time + float(since), None


def _parse_number_or_date(field: str) -> Decimal | None:
    """A number, or a date as seconds since 1970."""
    if is_number(field):
        plain = Decimal(field.replace(",", "."))
        return plain if plain.is_finite() else None
    try:
        moment = datetime.fromisoformat(field)
    except ValueError:
        return None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return Decimal(round(1e6 * moment.timestamp())).scaleb(-6)


def read_tracks(
    table: TextTable, stem: str, axes: str, notes: list[str]
) -> tuple[list[Track], dict[str, Any]]:
    """Rows of each vehicle of a table, and what was taken for what; doubts go into the notes.

    Raises
    ------
    ContentError
        The table cannot be read, or does not say whose rows they are.
    """
    sets = _columns_of_vehicles(table, axes, notes)
    time, since = _times_and_epoch(table, notes)
    columns = [k for own in sets.values() for part in own[1:] for k in part]
    blank = {k for own in sets.values() for k in own.place}
    values = dict(zip(columns, table.numbers_of_columns(columns, blank).T, strict=True))
    if not len(time):
        raise fault("has names of columns, but no rows", "Is the file cut off?")
    stack = lambda part, rows: np.column_stack([values[k][rows] for k in part])  # noqa: E731
    groups, identity = dict.fromkeys(sets, np.arange(len(time))), []
    main = next(iter(sets.values()))
    if len(sets) == 1:
        known, every = np.isfinite([values[k] for k in main.place]).all(axis=0), table.columns
        if not known.any():
            raise fault(f"{stem!r} has no position", "Leave it out")
        if not known.all():
            notes.append(f"{np.count_nonzero(~known):,} rows without a position are left out")
            table.lines, table.columns = table.lines[known], [x[known] for x in every]
            time, values = time[known], {k: x[known] for k, x in values.items()}
        place = stack(main.place, slice(None))
        groups, identity = _rows_and_name_columns(table, time, place, columns, stem, notes)
        lost = [x for k in identity for x in {*every[k].tolist()} - {*table.columns[k].tolist()}]
        if lost:
            raise fault(f"{min(lost)!r} has no position", "Leave it out")
    elif any(q.kind == "agent" and len(table.codes(k)[1]) > 1 for k, q in enumerate(table.kinds)):
        why = "has places of several vehicles in a row, and names of vehicles, too"
        raise fault(why, "Keep one of them")
    tracks = []
    for who, every in groups.items():
        own = sets.get(who, main)
        rows = every[np.isfinite(stack(own.place, every)).all(axis=1)]
        if not len(rows):
            raise fault(f"{who!r} has no position", "Leave it out")
        velocity = turn_to_enu(stack(own.velocity, rows), own.axes) if own.velocity else None
        yaw = None
        if own.yaw:
            yaw = _yaw_of_clear_unit(table, values[own.yaw[0]][rows], time[rows], rows, notes)
        elif own.quaternion:
            yaw = yaws_of(stack(own.quaternion, rows))
        if yaw is not None and own.axes != "enu":  # whose whole turns count
            yaw = _yaw_in_enu(yaw, own.axes)
        place = turn_to_enu(stack(own.place, rows), own.axes)
        tracks.append(Track(who, table.lines[rows], time[rows], place, velocity, yaw))
    named = table.kinds[main.place[0]].kind in DIRECTIONS
    said = "the option" if axes else "the file" if named else ""
    notes += _doubts_about_units(table, tracks, axes=bool(said))
    used = {*columns, *table.find_columns("time"), *identity}
    return tracks, {
        "rows": len(time), "names_in_line": table.line, "separator": SEPARATORS[table.separator],
        "decimal_mark": table.decimal or ".",
        "columns": [name for k, name in enumerate(table.names) if k in used],
        "ignored": [name for k, name in enumerate(table.names) if k not in used],
        "vehicles_by": [table.names[k] for k in identity],
        "units": [f"{q} {word} ({source or 'assumed'})" for q, (word, source) in table.units.items() if q in DEFAULT],
        "axes": f"{main.axes} ({said or 'assumed'})", "since_1970_ns": since,
    }  # fmt: skip


def _columns_of_vehicles(table: TextTable, axes: str, notes: list[str]) -> dict[str, _Places]:
    """Columns of each vehicle that has its own; those of one if all share them.

    Raises
    ------
    ContentError
        A place is missing, or some columns may be those of another vehicle; or names of axes contradict the option.
    """
    sets: dict[str, _Places] = {}
    loose: dict[str, dict[str, int]] = {}
    for who in dict.fromkeys(who for _, who in table.places):
        place, turned = table.position_columns_and_axes(axes, who)
        kinds = ("vx", "vy", "vz"), ("yaw",), ("qx", "qy", "qz", "qw")
        if place:
            parts = (table.find_columns(*kind, who=who) for kind in kinds)
            sets[who] = _Places(turned, place, *parts)
        if own := {kind: k for (kind, x), k in table.places.items() if x == who and kind in "xyz"}:
            loose[who] = own
    flown = {who: own for who, own in sets.items() if who not in ROLES} or sets
    flown = {"": sets[""]} if "" in sets else flown
    if not flown:
        raise table.missing_columns_error(*"xyz")
    if len(flown) > 1 and flown.keys() <= SOURCE_WORDS:
        raise fault(f"has several places of one vehicle: {', '.join(flown)}", "Keep one of them")
    main = next(iter(flown))
    for who in loose.keys() - flown.keys():
        names = ", ".join(table.names[k] for k in loose[who].values())
        pairs = [(table.places.get((kind, main), -1), k) for kind, k in loose[who].items()]
        if len(pairs) < 3 and all((table.columns[i] == table.columns[k]).all() for i, k in pairs):
            continue
        if who not in ROLES and (re.search(r"\d", who) or "" not in sets):
            remedy = "Give each vehicle its rows, or columns such as x1, y1, z1, x2, y2, z2"
            raise fault(f"{names} may be places of another vehicle", remedy)
        notes.append(f"the columns {names} are not read: if a vehicle is there, it is not judged")
    for who, own in flown.items():
        places = [(kind, k) for (kind, x), k in table.places.items() if x == who]
        more = [table.names[k] for kind, k in places if kind in DIRECTIONS and k not in own.place]
        if len(more) > 1:
            notes.append(f"the columns {', '.join(more)} are not read: x, y and z count")
        lone = len(flown) == 1 and who[1:].isalpha() and who not in SOURCE_WORDS | ROLES
        if who and (lone or meaning_of(table.names[own.place[0]]).who != who.lower()):
            columns = ", ".join(table.names[k] for k in own.place)
            notes.append(f"the columns {columns} are read as places of a vehicle {who!r}")
    return flown


def _rows_and_name_columns(
    table: TextTable, time: Floats, place: Floats, used: list[int], stem: str, notes: list[str]
) -> tuple[dict[str, Ints], list[int]]:
    """Rows of each vehicle, and the columns that tell them apart: by their names, or by the rows themselves.

    Raises
    ------
    ContentError
        A name is empty, or a time has two places, or two columns may be the names.
    """
    names, kinds, n = table.names, [q.kind for q in table.kinds], len(time)
    part, coded = np.zeros(n, np.int64), {}
    alone = _time_increases(time, part)
    for k, q in enumerate(table.kinds):
        if k not in used and (not q.dimension or q.kind in DIRECTIONS):
            coded[k] = table.codes(k)
    named = []
    for k in sorted(coded, key=lambda k: kinds[k] != "agent"):
        (code, labels), thing = coded[k], kinds[k] == "thing"
        # What numbers the rows, or words for parts of a flight, are no names of vehicles.
        counts = np.ptp(time) > 0.0 and are_row_numbers(labels, n)
        unnamed = counts or (thing and alone and _are_parts_of_one_way(code, time, place))
        if kinds[k] in ("agent", "thing") and not unnamed:
            named.append(k)
            if "" in labels:
                line = table.lines[np.flatnonzero(code == labels.index(""))[0]]
                raise fault(f"{names[k]} is empty", "Name the vehicle", int(line))
        elif len(labels) > 1 and (kinds[k] == "agent" or _FLAGS.search(names[k])):
            notes.append(f"the column {names[k]!r} is not read: rows count whatever it says")
    chosen = next(([k] for k in named if _time_increases(time, coded[k][0])), named)
    part = _combined_codes(part, *(coded[k][0] for k in chosen))
    few = [k for k in coded if k not in named and 1 < len(coded[k][1]) <= n / 2]
    others = {k: _combined_codes(part, coded[k][0]) for k in few}
    others = {k: both for k, both in others.items() if _ROWS * (both.max() + 1) <= n}
    if unclear := not _time_increases(time, part):
        apart = {k: both for k, both in others.items() if _time_increases(time, both)}
    else:
        whole = _SHORTER * _length_of_ways(place, part)
        apart = {k: both for k, both in others.items() if _length_of_ways(place, both) < whole}
        first, row = place[:_FIRST], np.arange(min(n, _FIRST))
        whole = _SHORTER * _length_of_ways(first, 0 * row)
        turns = [p for p in _TURNS if n > 2 * p and _length_of_ways(first, row % p) < whole]
        if turns and not chosen and not apart:
            why = f"rows lie apart as if {turns[0]} vehicles took turns"
            raise fault(why, "Name vehicles in a column agent")
    if unclear and any((both != next(iter(apart.values()))).any() for both in apart.values()):
        several = ", ".join(names[k] for k in apart)
        raise fault(f"the columns {several} may name vehicles", "Name one of them agent")
    for k in [*apart][:1]:
        chosen, part = [*chosen, k], apart[k]
        notes.append(f"the column {names[k]!r} is taken for names of vehicles: its rows lie apart")
    for k in named:
        if _combined_codes(part, coded[k][0]).max() > part.max():
            notes.append(f"the column {names[k]!r} may name vehicles, too, and is not read")
    groups = {}
    for rows in np.split(np.argsort(part, kind="stable"), np.cumsum(np.bincount(part))[:-1]):
        again = (np.diff(time[rows]) == 0.0) & (np.diff(place[rows], axis=0) != 0.0).any(axis=1)
        if again.any():
            k = rows[int(again.argmax()) + 1]
            why = f"the time {time[k]:.9g} s has two places: whose?"
            raise fault(why, "Name vehicles in a column agent", int(table.lines[k]))
        groups["/".join(coded[k][1][coded[k][0][rows[0]]] for k in chosen) or stem] = rows
    if all(map(str.isdecimal, groups)):  # whoever has the first row
        groups = dict(sorted(groups.items(), key=lambda each: int(each[0])))
    return groups, chosen


def _combined_codes(*codes: Ints) -> Ints:
    """Codes of the combinations of codes, in the order of their first rows."""
    whole = codes[0]
    for code in codes[1:]:
        whole = whole * (int(code.max(initial=0)) + 1) + code
    _, first, inverse = np.unique(whole, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse]


def _time_increases(time: Floats, part_of_row: Ints) -> bool:
    """Whether times increase within each part of the rows."""
    order = np.argsort(part_of_row, kind="stable")
    return bool((np.diff(time[order]) > 0.0)[np.diff(part_of_row[order]) == 0].all())


def _length_of_ways(place: Floats, part: Ints) -> float:
    """Length of the ways of all parts of the rows [m]."""
    order = np.argsort(part, kind="stable")
    with np.errstate(all="ignore"):
        step = np.linalg.norm(np.diff(place[order], axis=0), axis=1)
    return float(step[np.diff(part[order]) == 0].sum())


def are_row_numbers(labels: list[str], rows: int) -> bool:
    """Whether labels only number the rows."""
    whole = [int(label) for label in labels if re.fullmatch(r"-?\d{1,15}", label)]
    return rows > 1 and len(whole) == rows and np.ptp(np.diff(whole)) == 0


def _are_parts_of_one_way(code: Ints, time: Floats, place: Floats) -> bool:
    """Whether what is coded follows each other on one way, as words for parts of a flight do."""
    change = np.diff(code) != 0
    steps = np.column_stack([np.diff(time), np.linalg.norm(np.diff(place, axis=0), axis=1)])
    usual = np.max(steps[~change], axis=0, initial=0.0)
    return bool(change.sum() == code.max() and (steps[change] <= _CONTINUES * usual).all())


def yaws_of(quaternions: Floats) -> Floats:
    """Yaws (K,) [rad] of quaternions (K, 4), scalar last, body to world; zero without an attitude."""
    x, y, z, w = quaternions.T
    return np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _yaw_in_enu(yaw: Floats, axes: str) -> Floats | None:
    """Yaws (K,) from east to north, of those from the first axis to the second; None if these do not lie flat."""
    x, y, up = turn_to_enu(np.stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw], axis=1), axes).T
    return None if up.any() else np.arctan2(y, x)


def _yaw_of_clear_unit(
    table: TextTable, yaw: Floats, time: Floats, rows: Ints, notes: list[str]
) -> Floats | None:
    """The yaws (K,) [rad], or None if they may be in another unit than assumed.

    Raises
    ------
    ContentError
        A yaw changes by more than half a turn from one row to the next, in yaws of more than a turn.
    """
    step, far = np.abs(np.diff(yaw)), float(np.abs(yaw).max())
    whole = far > np.pi and (yaw == np.round(yaw)).all()
    if not table.units["angle"][1] and (whole or far > 2.0001 * np.pi):
        span = f"{yaw.min():g} to {yaw.max():g}"
        remedy = "Name it yaw_deg or yaw_rad, or give the unit"
        notes.append(f"the yaw is not read: {span} may be degrees or radians. {remedy}")
        return None
    ordered = (np.diff(time) > 0.0).all()
    if ordered and np.ptp(yaw) > 2.0001 * np.pi and step.max() > 1.0001 * np.pi:
        k = int(step.argmax())
        why = f"the yaw changes by {np.degrees(step[k]):.4g} deg, more than half a turn: which way?"
        raise fault(why, "Give the right unit, or more rows", int(table.lines[rows[k + 1]]))
    return yaw


def doubt_about_heights(height: Floats) -> str:
    """That heights (K,) [m] of which nobody says whether they count upwards look as if they did not; else ""."""
    if height.max() > 0.1 or height.min() >= -0.5:
        return ""
    return f"all heights are at or below 0, down to {height.min():.4g} m: does z point down?"


def _doubts_about_units(table: TextTable, tracks: list[Track], *, axes: bool) -> Iterator[str]:
    """What is assumed of units, and what looks as if it had other units or axes."""
    place = np.concatenate([track.place for track in tracks])
    if not axes and (why := doubt_about_heights(place[:, 2])):
        yield Doubt(f"{why} Say --axes ned or enu")
    things = {"time": "times", "length": "places"}
    things |= {"angle": "yaws"} if any(track.yaw is not None for track in tracks) else {}
    assumed = [
        f"{things[q]} as {word}"
        for q, (word, source) in table.units.items()
        if q in things and not source
    ]
    if not assumed or not table.named:
        return
    note = f"no unit is said: {', '.join(assumed)}"
    with np.errstate(all="ignore"):
        ways = [np.linalg.norm(np.diff(track.place, axis=0), axis=1) for track in tracks]
    steps = np.concatenate([np.diff(track.time) for track in tracks])
    fastest = float((np.concatenate(ways) / np.where(steps > 0.0, steps, np.inf)).max(initial=0.0))
    moves = max(map(np.sum, ways)) > _SLOW and float(np.median(steps)) >= _LONG
    unsaid = not all(table.units[q][1] for q in ("time", "length"))
    if (unsaid and fastest > _FAST) or (moves and fastest < _SLOW and not table.units["time"][1]):
        remedy = "Name columns such as time_ms and x_mm, or say --units ms or s, mm or m"
        note = f"{note}, so that speeds reach {fastest:.3g} m/s"
        if fastest > _FAST:
            raise fault(note, remedy)
        note = Doubt(f"{note}. {remedy}")
    yield note
