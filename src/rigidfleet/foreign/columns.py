"""Tables of numbers with a line of names: columns in any order, and errors that name the line."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from rigidfleet.errors import TrajectoryError
from rigidfleet.typing import Floats, Ints

#: Units of a column, as a factor to s, m, rad and their quotients; "" is a column without a unit.
_UNITS = {
    "": 1.0, "s": 1.0, "sec": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "ns": 1e-9, "m": 1.0, "mm": 1e-3, "cm": 1e-2,
    "rad": 1.0, "deg": math.radians(1.0), "m_s": 1.0, "m_s2": 1.0, "m_s3": 1.0, "rad_s": 1.0,
}  # fmt: skip
#: Other names of columns.
_ALIASES = {
    "t": "time", "timestamp": "time", "id": "agent", "drone": "agent", "vehicle": "agent", "name": "agent", "px": "x",
    "py": "y", "pz": "z",
}  # fmt: skip
#: Characters that no table has, and that a terminal would obey when a message shows them.
_CONTROL = re.compile(r"[^\t\n\r\x20-\x7e\xa0-\U0010ffff]")
#: Longest line that is read [characters].
_LONGEST = 100_000


class Columns(NamedTuple):
    """Columns of a table.

    Attributes
    ----------
    lines : (K,) number of the line of each row, from 1
    values : (K,) numbers of each column by its name, in s, m and rad
    who : (K,) texts of the column ``agent``; None without one
    """

    lines: Ints
    values: Mapping[str, Floats]
    who: np.ndarray | None


def read_lines(data: bytes, name: str) -> tuple[list[str], str, list[str], list[int]]:
    """The names of a table's columns, its separator, its rows as text, and the number of each row's line.

    Raises
    ------
    TrajectoryError
        The file is no text, has no rows, or a row has another number of fields than the names.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise TrajectoryError(
            f"{name}: is neither text in UTF-8 nor another known format. Save a table as UTF-8, or give .skyc or .mcap."
        ) from None
    every = text.replace('"', "").splitlines()
    if odd := _CONTROL.search(text):
        line = len(f"{text[: odd.start()]}.".splitlines())
        raise TrajectoryError(
            f"{name}: line {line}: has the control character U+{ord(odd[0]):04X}. Remove it."
        )
    kept = [k for k, line in enumerate(every, 1) if line and not line.isspace() and line[0] != "#"]
    if not kept:
        raise TrajectoryError(f"{name}: is empty. Give a table with a line of names.")
    head = every[kept[0] - 1]
    comma = next((c for c in ",;\t" if c in head), ",")
    names = [field.strip() for field in head.rstrip().rstrip(comma).split(comma)]
    if len(head) > _LONGEST or re.fullmatch(r"[-+.\deE]+", names[0]):
        raise TrajectoryError(
            f"{name}: line {kept[0]}: has no names of columns. Begin with a line such as time_s,x_m,y_m,z_m."
        )
    rows = [every[k - 1] for k in kept[1:]]
    for line, row in zip(kept[1:], rows, strict=True):
        count = row.count(comma) + 1
        if count != len(names) and not (count == len(names) + 1 and row.rstrip().endswith(comma)):
            raise TrajectoryError(
                f"{name}: line {line}: has {count} fields, and the names in line {kept[0]} are {len(names)}. Is the "
                "file cut off?"
            )
    if not rows:
        raise TrajectoryError(f"{name}: has names of columns, but no rows.")
    return names, comma, rows, kept[1:]


def numbers(
    rows: list[str],
    lines: list[int],
    comma: str,
    names: list[str],
    which: list[int],
    name: str,
    blank: Collection[int] = (),
) -> Floats:
    """The numbers (K, len(which)) of some columns, all finite; of the ``blank`` ones, empty fields are NaN.

    Raises
    ------
    TrajectoryError
        A field is not a finite number.
    """
    try:
        found = np.loadtxt(io.StringIO("\n".join(rows)), delimiter=comma, usecols=which, ndmin=2)
    except ValueError:
        found = None
    if found is not None and np.isfinite(found).all():
        return found
    for line, row in zip(lines, rows, strict=True):
        fields = row.split(comma)
        for k in which:
            told = fields[k].strip()
            if k in blank and told.lower() in ("", "nan"):
                continue
            try:
                # Python alone groups digits by "_".
                fine = math.isfinite(float(told)) and "_" not in told
            except ValueError:
                fine = False
            if not fine:
                remedy = "Leave out rows without a position."
                if re.fullmatch(r"[-+]?\d*,\d+", told):
                    remedy = "Write decimals with a point."
                raise TrajectoryError(
                    f"{name}: line {line}: {names[k]} is {told[:40] or 'empty'}, not a finite number. {remedy}"
                )
    fields = [row.split(comma) for row in rows]
    return np.array([[float(row[k].strip() or "nan") for k in which] for row in fields])


def read_columns(
    data: bytes, name: str, needed: Collection[str], wanted: Collection[str]
) -> Columns:
    """Columns by their names, in any order; names may have units (`x_m`, `x [mm]`), without one s, m or rad.

    Other columns are ignored.

    Raises
    ------
    TrajectoryError
        As `read_lines` and `numbers` do; or a needed column is missing, or is there twice, or has an unknown unit.
    """
    names, comma, rows, lines = read_lines(data, name)
    places: dict[str, int] = {}
    factor: dict[str, float] = {}
    for k, told in enumerate(names):
        quantity, unit = _quantity(told, {*needed, *wanted, "agent"})
        if quantity is None:
            continue
        if quantity in places:
            raise TrajectoryError(f"{name}: has two columns for {quantity}. Keep one.")
        if unit not in _UNITS:
            raise TrajectoryError(
                f"{name}: the column {told!r} has the unknown unit {unit!r}. Use s, m and rad."
            )
        places[quantity], factor[quantity] = k, _UNITS[unit]
    if missing := [q for q in needed if q not in places]:
        raise TrajectoryError(
            f"{name}: has no column for {', '.join(missing)} among {', '.join(names)[:80]}. Name columns time_s, x_m, "
            "y_m and z_m."
        )
    who = None
    if "agent" in places:
        k = places.pop("agent")
        who = np.array([row.split(comma, k + 1)[k].strip() for row in rows])
        if (nameless := np.flatnonzero(who == "")).size:
            line = lines[int(nameless[0])]
            raise TrajectoryError(f"{name}: line {line}: agent is empty. Name the vehicle.")
    blank = [k for q, k in places.items() if q in ("x", "y", "z")]
    values = numbers(rows, lines, comma, names, list(places.values()), name, blank)
    found = {q: values[:, i] * factor[q] for i, q in enumerate(places)}
    return Columns(np.array(lines), found, who)


def _quantity(told: str, known: set[str]) -> tuple[str | None, str]:
    """The quantity and the unit that the name of a column tells; None for an unknown one."""
    plain = told.lower()
    bracket = re.fullmatch(r"(.*?)\s*[\[(](.*)[\])]", plain)
    if bracket:
        plain = bracket[1].strip()
        unit = bracket[2].strip().replace("/", "_").replace("^", "")
        plain = _ALIASES.get(plain, plain)
        return (plain, unit) if plain in known else (None, "")
    for cut in range(plain.count("_") + 1):
        parts = plain.split("_")
        base, unit = "_".join(parts[: len(parts) - cut]), "_".join(parts[len(parts) - cut :])
        base = _ALIASES.get(base, base)
        if base in known and unit in _UNITS:
            return base, unit
    return None, ""
