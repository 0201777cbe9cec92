"""Tables of places over time: which vehicles they have, where these are and when, and what was taken for what."""

from __future__ import annotations

import re
from datetime import datetime
from decimal import Decimal
from typing import Any, NamedTuple

import numpy as np

from rigidfleet._common.names import AXES, DIRECTIONS, quantity_of, understood, unit_of
from rigidfleet._common.tables import SEPARATORS, TableError, is_number, parse
from rigidfleet.errors import TrajectoryError
from rigidfleet.typing import Floats, Ints

#: Columns of a trajectory without names, as TUM's tools for trajectories of cameras write it.
_TUM = ["timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw"]
_DEFAULT = {"time": "s", "length": "m", "angle": "rad"}
#: Seconds since 1970 of stamps that are dates: 2001 to 2096; and units in which they are counted without saying so.
_DATES, _TICKS = (10**9, 4 * 10**9), ("s", "ms", "us", "ns")
_ISO = re.compile(r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d:\d\d)(?:[.,](\d+))?\s*(Z|[-+]\d\d:?\d\d)?")
_CLOCK = re.compile(r"(\d+):([0-5]\d):([0-5]\d(?:[.,]\d+)?)")
#: Greatest speed of a flight that is doubted if steps are long, and if numbers are whole: from, to [m/s].
_SLOW, _FAST, _FASTEST = 0.1, 20.0, 100.0
#: Step of times without a unit from which they are doubted, and from which they are refused [s].
_LONG, _LONGEST = 1.0, 1000.0
#: Rows are of several vehicles if their ways are so much shorter than that of one: a share.
_SHORTER = 0.5
#: Words for places that are wanted, not those of a vehicle; for what a row may say of itself; for units in a line.
_ROLES = {
    "ref",
    "reference",
    "setpoint",
    "sp",
    "target",
    "desired",
    "des",
    "cmd",
    "command",
    "goal",
}
_FLAGS = re.compile(
    r"valid|status|flag|ok|quality|lost|track|visible|occluded|fix|health", re.IGNORECASE
)
_UNSAID = re.compile(
    r"\b(units?|mm|cm|ft|feet|inch(es)?|ms|us|ns|deg(rees)?|ned|down)\b", re.IGNORECASE
)


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
    """Columns of a vehicle: its place, by the directions of the axes, its velocity, yaw and quaternion."""

    place: list[int]
    axes: str
    velocity: list[int]
    yaw: list[int]
    quaternion: list[int]


def units_of(units: str | None, axes: str | None) -> Units:
    """The words of a user: units such as ``"ms,mm,deg"``, in any order, and axes such as ``"ned"``.

    Raises
    ------
    TrajectoryError
        A unit is unknown, or two are of one quantity; or axes are no three directions.
    """
    words: dict[str, str] = {}
    for word in re.split(r"[,\s]+", units.strip()) if units else ():
        dimension = (unit_of(word) or ("",))[0]
        if dimension not in _DEFAULT or dimension in words:
            raise TrajectoryError(
                f"units: {word!r}: give one unit each of time, length and angle, such as ms,mm,deg."
            )
        words[dimension] = word
    axes = (axes or "").lower()
    if axes and not _are_axes(axes):
        raise TrajectoryError(
            f"axes: {axes!r}: say where x, y and z point, such as enu (east, north, up) or ned."
        )
    return Units(words, axes)


def _are_axes(axes: str) -> bool:
    return sorted(AXES.get(letter, (9,))[0] for letter in axes) == [0, 1, 2]


class Understood:
    """A table whose columns are understood: where each quantity is, in which unit, and what was taken for what.

    Attributes
    ----------
    table, quantities : the table, and what the names of its columns say
    places : number of the column of each quantity, by kind and vehicle
    units : of each dimension the word, and where it is from: "" if it is assumed
    notes : doubts, in sentences without a full stop

    Raises
    ------
    TrajectoryError
        The file is no table, has no names that are understood, or has an unknown unit or two columns for a quantity.
    """

    def __init__(self, data: bytes, name: str, words: Units = Units({}, "")) -> None:  # noqa: B008
        self.name, self.words, self.notes, self.units = name, words, [], {}
        self.places: dict[tuple[str, str], int] = {}
        self.factors: dict[int, float] = {}
        try:
            self.table = parse(data, understood)
        except TableError as error:
            raise self.refusal(error) from None
        if not self.table.columns:
            raise self.error("is empty. Give a table with a line of names")
        if not self.table.names:
            if len(self.table.columns) != len(_TUM) or self.table.separator != " ":
                raise self.error(
                    "has no names of columns that are understood. Begin with a line such as time_s,x_m,y_m,z_m",
                    self.table.line,
                )
            self.table = self.table._replace(names=_TUM, units=[""] * len(_TUM))
            self.notes.append(
                f"8 numbers between blanks without names are read as TUM's: {' '.join(_TUM)}"
            )
        if not len(self.table.lines) and not self.table.faults:
            raise self.error("has names of columns, but no rows")
        self.quantities = [quantity_of(written) for written in self.table.names]
        for k, quantity in enumerate(self.quantities):
            if quantity.kind not in ("", "agent", "thing"):
                self._put(k)
        before = [
            line.strip() for line in self.table.texts[: self.table.line - 1] if _UNSAID.search(line)
        ]
        if before and words == ({}, ""):
            self.notes.append(
                f"the line {before[0][:60]!r} is not read: does it say units or axes? Say --units or --axes"
            )

    def _put(self, k: int) -> None:
        """Take a column as a quantity, and find its unit."""
        (kind, said, who), below, written = (
            self.quantities[k],
            self.table.units[k],
            self.table.names[k],
        )
        first, dimension = self.places.setdefault((kind, who), k), self.quantities[k].dimension
        if first != k:
            if (
                self.table.names[first] != written
                or (self.table.columns[first] != self.table.columns[k]).any()
            ):
                raise self.error(
                    f"has two columns for {kind}: {self.table.names[first]!r}, {written!r}. Keep one"
                )
            return
        option = self.words.words.get(dimension)
        word = said or below or option or _DEFAULT.get(dimension, "")
        known = unit_of(word) if word and dimension else (dimension, 1.0)
        if known is None or known[0] != dimension:
            raise self.error(
                f"the column {written!r} has the unknown unit {word!r}. Use s, m and rad"
            )
        for other in (below, option):
            if other and unit_of(other) != known:
                raise self.error(
                    f"the column {written!r} is in {word!r}, but also in {other!r}. Remove one"
                )
        if dimension and kind != "duration":
            self.units.setdefault(
                dimension, (word, "the file" if said or below else "the option" if option else "")
            )
        self.factors[k] = known[1]

    def error(self, problem: str, line: int = 0) -> TrajectoryError:
        """An error in the file."""
        place = f"line {line}: " if line else ""
        return TrajectoryError(f"{self.name}: {place}{problem}{'' if problem[-1] == '?' else '.'}")

    def refusal(self, error: TableError) -> TrajectoryError:
        """The first fault of a table as an error."""
        line, _, problem, remedy = error.faults[0]
        return self.error(f"{problem}. {remedy}", line)

    def numbers(self, columns: list[int]) -> Floats:
        """Numbers (K, M) of columns, in s, m and rad.

        Raises
        ------
        TrajectoryError
            A field is no finite number, or a row has another number of fields.
        """
        try:
            return self.table.numbers(columns) * [self.factors.get(k, 1.0) for k in columns]
        except TableError as error:
            raise self.refusal(error) from None

    def place(self, *kinds: str, who: str = "") -> list[int]:
        """Columns of some quantities; empty unless all are there."""
        columns = [self.places.get((kind, who), -1) for kind in kinds]
        return [] if -1 in columns else columns

    def missing(self, *kinds: str) -> TrajectoryError:
        """The error of a table without some quantities."""
        if self.place("latitude"):
            return self.error(
                "has latitude and longitude. Give metres east, north and up of an origin: x_m, y_m, z_m"
            )
        missing = ", ".join(kind for kind in kinds if not self.place(kind))
        names = ", ".join(self.table.names)[:80]
        return self.error(
            f"has no column for {missing} among {names}. Name columns time_s, x_m, y_m and z_m"
        )

    def times(self) -> tuple[Floats, int | None]:
        """Times (K,) [s], and the nanoseconds since 1970 from which they count; None if they are no dates.

        Raises
        ------
        TrajectoryError
            There are none, or one is neither a number nor a date.
        """
        (column,) = self.place("time") or [-1]
        if column < 0:
            raise self.missing("time")
        fields = self.table.columns[column].tolist()
        number = is_number(fields[0])
        if number and abs(float(fields[0].replace(",", "."))) < _DATES[0]:
            return self.numbers([column])[:, 0], None
        ticks = []
        for line, field in zip(self.table.lines.tolist(), fields, strict=True):
            if (tick := _tick(field)) is None:
                what = f"{self.table.names[column]} is {field[:40] or 'empty'}, neither a finite number nor a date"
                raise self.error(f"{what} such as 2026-05-01T12:00:00.5Z. Write one", line)
            ticks.append(tick)
        unit, source = self.units["time"]
        if not number:
            self.units["time"], unit = ("dates" if "-" in fields[0] else "h:min:s", "the file"), "s"
        elif not source:
            for power, likely in enumerate(_TICKS):
                if _DATES[0] <= ticks[0] / 1000**power < _DATES[1]:
                    unit, self.units["time"] = likely, (likely, "its size")
                    self.notes += [f"times such as {fields[0]} are read as {unit} since 1970"] * (
                        power > 0
                    )
        factor = Decimal(str((unit_of(unit) or ("", 1.0))[1]))
        since = ticks[0] * factor
        time = np.array([float((tick - ticks[0]) * factor) for tick in ticks])
        return (
            (time, int(since * 10**9))
            if _DATES[0] <= since < _DATES[1]
            else (time + float(since), None)
        )


def _tick(field: str) -> Decimal | None:
    """A number, or a date as seconds since 1970, or a time of a day as seconds."""
    if date := _ISO.fullmatch(field):
        try:
            moment = datetime.fromisoformat(
                f"{date[1]}T{date[2]}{(date[4] or 'Z').replace('Z', '+00:00')}"
            )
        except ValueError:
            return None
        return Decimal(int(moment.timestamp())) + Decimal(f"0.{date[3] or 0}")
    if clock := _CLOCK.fullmatch(field):
        return 3600 * int(clock[1]) + 60 * int(clock[2]) + Decimal(clock[3].replace(",", "."))
    plain = field.replace(",", ".")
    return Decimal(plain) if is_number(field) and Decimal(plain).is_finite() else None


def read_tracks(file: Understood, stem: str) -> tuple[list[Track], dict[str, Any]]:
    """Rows of each vehicle of a table, and what was taken for what; the file's notes have the doubts.

    Raises
    ------
    TrajectoryError
        The table cannot be read, or does not say whose rows they are.
    """
    sets, table = _sets(file), file.table
    time, since = file.times()
    columns = [
        k for own in sets.values() for k in (*own.place, *own.velocity, *own.yaw, *own.quaternion)
    ]
    values = dict(zip(columns, file.numbers(columns).T, strict=True))
    stack = lambda columns, rows: (
        np.column_stack([values[k][rows] for k in columns]) if columns else None
    )
    groups, identity = dict.fromkeys(sets, np.arange(len(time))), []
    if len(sets) == 1:
        (own,) = sets.values()
        groups, identity = _vehicles(
            file, time, np.column_stack([values[k] for k in own.place]), stem
        )
    elif any(
        q.kind in ("agent", "thing") and len(table.codes(k)[1]) > 1
        for k, q in enumerate(file.quantities)
    ):
        raise file.error(
            "has places of several vehicles in a row, and names of vehicles, too. Keep one of them"
        )
    tracks = []
    for who, rows in groups.items():
        own = sets.get(who) or next(iter(sets.values()))
        lines, turned = table.lines[rows], stack(own.quaternion, rows)
        yaw = (
            _yaw(file, values[own.yaw[0]][rows], lines)
            if own.yaw
            else None
            if turned is None
            else yaws(turned)
        )
        moved = _in_enu(own.axes, stack(own.place, rows), stack(own.velocity, rows), yaw)
        tracks.append(Track(who, lines, time[rows], *moved))
    axes = ", ".join({own.axes: 0 for own in sets.values()})
    said = (
        "the option"
        if file.words.axes
        else ""
        if file.place("x")
        else "the file"
        if axes != "enu"
        else ""
    )
    _doubt(file, tracks, said)
    used = {*columns, *file.place("time"), *identity}
    return tracks, {
        "rows": len(time), "separator": SEPARATORS[table.separator], "names_in_line": table.line,
        "columns": [name for k, name in enumerate(table.names) if k in used],
        "ignored": [name for k, name in enumerate(table.names) if k not in used],
        "vehicles_by": [table.names[k] for k in identity],
        "units": [f"{q}: {word} ({source or 'assumed'})" for q, (word, source) in file.units.items() if q in _DEFAULT],
        "axes": f"{axes} ({said or 'assumed'})", "since_1970_ns": since,
    }  # fmt: skip


def _sets(file: Understood) -> dict[str, _Places]:
    """Columns of each vehicle that has its own; those of "" if all share them.

    Raises
    ------
    TrajectoryError
        A place is missing, or some columns may be those of another vehicle; or names of axes contradict the option.
    """
    sets: dict[str, _Places] = {}
    for who in dict.fromkeys(who for _, who in file.places):
        place, axes, velocity = (
            file.place(*"xyz", who=who),
            file.words.axes or "enu",
            file.place("vx", "vy", "vz", who=who),
        )
        if not place:
            ways = [kind for kind, own in file.places if kind in DIRECTIONS and own == who]
            axes, velocity = "".join(DIRECTIONS[way] for way in ways), []
            place = file.place(*ways, who=who) if _are_axes(axes) else []
            if place and sorted(file.words.axes or axes) != sorted(axes):
                raise file.error(
                    f"has columns {', '.join(ways)}, but the axes are {file.words.axes}. Remove one"
                )
        if place:
            turns = file.place("yaw", who=who), file.place("qx", "qy", "qz", "qw", who=who)
            sets[who] = _Places(place, axes, velocity, *turns)
    own = (
        {"": sets[""]} if "" in sets else {w: x for w, x in sets.items() if w not in _ROLES} or sets
    )
    if not own:
        raise file.missing(*"xyz")
    main = next(iter(own.values()))
    for who in sets.keys() - own.keys():
        names = ", ".join(file.table.names[k] for k in sets[who].place)
        if who not in _ROLES and re.search(r"\d", who):
            if not np.array_equal(file.numbers(main.place), file.numbers(sets[who].place)):
                raise file.error(
                    f"{names} may be places of another vehicle. Name all alike (x1, x2), or give each rows"
                )
        else:
            file.notes.append(
                f"the columns {names} are not read: if they are of another vehicle, it is not judged"
            )
    return own


def _vehicles(
    file: Understood, time: Floats, place: Floats, stem: str
) -> tuple[dict[str, Ints], list[int]]:
    """Rows of each vehicle, and the columns that tell them apart: by their names, or by the rows themselves.

    Raises
    ------
    TrajectoryError
        A name is empty, or a time has two places, or two columns may be the names.
    """
    names, lines, part = file.table.names, file.table.lines, np.zeros(len(time), np.int64)
    alone = _increases(time, part)
    coded = {
        k: (*file.table.codes(k), q.kind)
        for k, q in enumerate(file.quantities)
        if q.kind in ("agent", "thing", "")
    }
    for k, (code, labels, kind) in coded.items():
        if "" in labels and kind == "agent":
            line = int(lines[np.flatnonzero(code == labels.index(""))[0]])
            raise file.error(f"{names[k]} is empty. Name the vehicle", line)
        if kind == "" and len(labels) > 1 and _FLAGS.search(names[k]):
            file.notes.append(f"the column {names[k]!r} is not read: rows count whatever it says")
    # What numbers the rows, or words for parts of a flight, are no names of vehicles.
    named = [
        k for k, (code, labels, kind) in sorted(coded.items(), key=lambda x: x[1][2])
        if kind and not (alone and (_counts(labels, len(time)) or (kind == "thing" and _follow(code))))
    ]  # fmt: skip
    chosen = next(([k] for k in named if _increases(time, coded[k][0])), named)
    part = _both(part, *(coded[k][0] for k in chosen))
    others = {
        k: _both(part, code)
        for k, (code, labels, kind) in coded.items()
        if not kind and 1 < len(labels) <= len(time) / 2
    }
    if _increases(time, part):
        whole = _SHORTER * _length(place, part)
        apart = {k: both for k, both in others.items() if _length(place, both) < whole}
    else:
        single = np.ptp(time) == 0.0
        apart = {
            k: both
            for k, both in others.items()
            if _increases(time, both) and (single or np.bincount(both).min() > 1)
        }
        if any((both != next(iter(apart.values()))).any() for both in apart.values()):
            told = ", ".join(names[k] for k in apart)
            raise file.error(f"the columns {told} may name vehicles. Name one of them agent")
    if apart:
        k, part = next(iter(apart.items()))
        chosen = [*chosen, k]
        file.notes.append(
            f"the column {names[k]!r} is taken for the names of vehicles, as its rows lie apart"
        )
    file.notes += [
        f"the column {names[k]!r} may name vehicles, too, and is not read"
        for k in named if _both(part, coded[k][0]).max() > part.max()
    ]  # fmt: skip
    groups = {}
    for rows in np.split(np.argsort(part, kind="stable"), np.cumsum(np.bincount(part))[:-1]):
        again = (np.diff(time[rows]) == 0.0) & (np.diff(place[rows], axis=0) != 0.0).any(axis=1)
        if again.any():
            k = rows[int(again.argmax()) + 1]
            raise file.error(
                f"the time {time[k]:.9g} s has two places: whose? Name vehicles in a column agent",
                int(lines[k]),
            )
        groups["/".join(coded[k][1][coded[k][0][rows[0]]] for k in chosen) or stem] = rows
    return groups, chosen


def _both(*codes: Ints) -> Ints:
    """Codes of the combinations of codes, in the order of their first rows."""
    whole = codes[0]
    for code in codes[1:]:
        whole = whole * (int(code.max(initial=0)) + 1) + code
    _, first, inverse = np.unique(whole, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse]


def _increases(time: Floats, part: Ints) -> bool:
    """Whether times increase within each part of the rows."""
    order = np.argsort(part, kind="stable")
    return bool((np.diff(time[order]) > 0.0)[np.diff(part[order]) == 0].all())


def _length(place: Floats, part: Ints) -> float:
    """Length of the ways of all parts of the rows [m]."""
    order = np.argsort(part, kind="stable")
    with np.errstate(all="ignore"):
        step = np.linalg.norm(np.diff(place[order], axis=0), axis=1)
    return float(step[np.diff(part[order]) == 0].sum())


def _counts(labels: list[str], rows: int) -> bool:
    """Whether labels only number the rows."""
    whole = [int(label) for label in labels if re.fullmatch(r"-?\d{1,15}", label)]
    return rows > 1 and len(whole) == rows and np.ptp(np.diff(whole)) == 0


def _follow(code: Ints) -> bool:
    """Whether what is coded follows each other, as words for parts of a flight do."""
    return bool((np.diff(code) != 0).sum() == code.max())


def yaws(quaternions: Floats) -> Floats:
    """Yaws (K,) [rad] of quaternions (K, 4), scalar last, body to world; zero without an attitude."""
    x, y, z, w = quaternions.T
    return np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _in_enu(
    axes: str, place: Any, velocity: Floats | None, yaw: Floats | None
) -> tuple[Floats, Floats | None, Floats | None]:
    """Places, velocities (K, 3) and yaws (K,) in east, north, up; yaw turns from the first axis to the second."""
    if axes == "enu":
        return place, velocity, yaw
    turn = np.zeros((3, 3))
    for k, letter in enumerate(axes):
        turn[AXES[letter][0], k] = AXES[letter][1]
    if yaw is not None:
        x, y, up = turn[:, :2] @ np.stack([np.cos(yaw), np.sin(yaw)])
        yaw = None if up.any() else np.arctan2(y, x)
    return place @ turn.T, None if velocity is None else velocity @ turn.T, yaw


def _yaw(file: Understood, yaw: Floats, lines: Ints) -> Floats | None:
    """The yaws (K,) [rad], or None if they may be in another unit than assumed.

    Raises
    ------
    TrajectoryError
        A yaw changes by more than half a turn from one row to the next, in yaws of more than a turn.
    """
    step, far = np.abs(np.diff(yaw)), float(np.abs(yaw).max())
    if not file.units["angle"][1] and (
        far > 2.0001 * np.pi or (far > np.pi and (yaw == np.round(yaw)).all())
    ):
        file.notes.append(
            f"the yaw is not read: {yaw.min():g} to {yaw.max():g} without a unit may be degrees or radians. Name it yaw_deg "
            "or yaw_rad, or give the unit"
        )
        return None
    if np.ptp(yaw) > 2.0001 * np.pi and step.max() > 1.0001 * np.pi:
        k = int(step.argmax())
        change = f"the yaw changes by {np.degrees(step[k]):.4g} deg from line {lines[k]}, more than half a turn"
        raise file.error(
            f"{change}: which way? Give the right unit, or more rows", int(lines[k + 1])
        )
    return yaw


def _doubt(file: Understood, tracks: list[Track], axes: str) -> None:
    """Note what looks as if it had other units or axes than it says.

    Raises
    ------
    TrajectoryError
        Times without a unit are too far apart for seconds.
    """
    heights = np.concatenate([track.place[:, 2] for track in tracks])
    if not axes and heights.max() <= 0.1 and heights.min() < -0.5:
        file.notes.append(
            f"all heights are at or below 0, down to {heights.min():.4g} m: does z point down? Say --axes ned, or --axes enu"
        )
    flown = [track for track in tracks if len(track.time) > 1]
    whole = lambda x: bool((x == np.round(x)).all())  # noqa: E731
    if not flown:
        return
    with np.errstate(all="ignore"):
        ways = [np.linalg.norm(np.diff(track.place, axis=0), axis=1) for track in flown]
        steps = [np.diff(track.time) for track in flown]
        fastest = max(float(np.nanmax(way / step)) for way, step in zip(ways, steps, strict=True))
    step = float(np.median(np.concatenate(steps)))
    doubt = (
        f"times without a unit step by {step:g}: as seconds, speeds reach {fastest:.3g} m/s, as milliseconds "
        f"{1e3 * fastest:.3g}. Name the column time_s or time_ms, or say --units s or ms"
    )
    if not file.units["time"][1] and step >= _LONGEST:
        raise file.error(doubt)
    slow = 10.0 * _SLOW if step >= 10.0 and all(whole(track.time) for track in flown) else _SLOW
    if (
        not file.units["time"][1]
        and step >= _LONG
        and 0.0 < fastest < slow
        and max(way.sum() for way in ways) > _SLOW
    ):
        file.notes.append(doubt)
    if (
        not file.units["length"][1]
        and _FAST < fastest <= _FASTEST
        and all(whole(track.place) for track in flown)
    ):
        file.notes.append(
            f"places without a unit are whole numbers, and speeds reach {fastest:.3g} m/s: are they millimetres or "
            "centimetres? Name the column x_m or x_mm, or say --units m or mm"
        )
