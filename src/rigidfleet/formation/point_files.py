"""Points, and their colours, from files: text (CSV), NPY and PLY."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from itertools import chain, repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidfleet._common.names import meaning_of
from rigidfleet._common.tables import ContentError, Fault, TextTable, fault, notes_on_units
from rigidfleet._common.text import first_few
from rigidfleet.errors import Finding, MissionError
from rigidfleet.math.geodesy import turn_to_enu
from rigidfleet.typing import Floats, Ints

#: Greatest size of a file of points [bytes], and number of wrong lines that are named one by one.
_BYTES, _NAMED = 64 << 20, 10
#: Numbers of a PLY file: its names of types, in its older and its newer words, and NumPy's.
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_AXES, _HUES = ["x", "y", "z"], ["red", "green", "blue"]
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_ENDS: dict[str, Any] = {"<": "little", ">": "big"}
#: What is not read, by its suffix, and what to give instead.
_OTHERS = {
    ".pcd": ("is a point cloud of PCL", "save it as PLY, or its points as text"),
    ".obj": ("is a mesh of Wavefront", "save its vertices as PLY, or as text"),
    ".dxf": ("is a drawing of CAD", "save it as SVG, or its points as text"),
}
Colours = tuple[str, ...] | None
Notes = tuple[str, ...]


class Points(NamedTuple):
    """Points of a file.

    Attributes
    ----------
    slots : (N, 3) [m]
    colours : "#rrggbb" of each; None if the file has no colours
    notes : what else to know, in sentences without a full stop
    """

    slots: Floats
    colours: tuple[str, ...] | None
    notes: tuple[str, ...] = ()


def read_points(path: str | Path, *, repeated: bool = False) -> Points:
    """Points from a file, one agent per row: x, y and z (or x and y, for z = 0) [m], and a colour where it has colours.

    - NPY (`.npy`): an array (N, 3) or (N, 2); (N, 6) with red, green and blue from 0 to 255.
    - PLY (`.ply`): x, y and z of the vertices, and red, green and blue, or diffuse_red and so on; text or binary.
    - Text (any other name): a table as `assess` reads it, with columns x, y and z in any order and unit (`x_mm`), and
      red, green and blue, or colour (`#rrggbb`). Without names: two or three numbers, or six with red, green and blue.

    Parameters
    ----------
    repeated : whether points may repeat others, as vertices of meshes do: they are left out, and a note says so

    Raises
    ------
    MissionError
        The file cannot be read or has no points; with a finding for each of the first invalid lines.
    """
    return parse_points(read_bytes(path), str(path), repeated=repeated)


def parse_points(data: bytes, name: str, *, repeated: bool = False) -> Points:
    """As `read_points`, from the content of a file; its name tells the format.

    Raises
    ------
    MissionError
        As `read_points` does.
    """
    suffix, place = Path(name).suffix.lower(), "point"
    if suffix in _OTHERS:
        problem, remedy = _OTHERS[suffix]
        raise MissionError([Finding(name, "", None, problem, f"{remedy}: x, y, z [m]")])
    try:
        if suffix in (".npy", ".ply"):
            points, colours, notes = _read_npy(data) if suffix == ".npy" else _read_ply(data)
            lines = np.arange(1, len(points) + 1)
        else:
            lines, points, colours, notes = _read_point_table(data)
            place = "line"
    except ContentError as error:
        raise MissionError(_findings_of_faults(error.faults, name)) from None
    except ValueError as error:
        remedy = "write it again, with one agent per row: x, y, z [m]"
        raise MissionError([Finding(name, "", None, str(error), remedy)]) from None
    keys = [tuple(point) for point in np.round(points, 9).tolist()]
    first = {key: k for k, key in reversed(list(enumerate(keys)))}
    if repeated and len(first) < len(keys):
        again = f"{len(keys) - len(first):,} of {len(keys):,} points"
        notes = (*notes, f"{again} repeat others and are left out")
        kept = sorted(first.values())
        points, colours = points[kept], colours and tuple(colours[k] for k in kept)
    else:
        faults = []
        for k, key in enumerate(keys):
            if not np.isfinite(points[k]).all():
                problem, remedy = "is not finite", "write x, y, z [m] as finite numbers"
            elif first[key] < k:
                of = "the point of line" if place == "line" else "point"
                problem, remedy = f"repeats {of} {lines[first[key]]}", "keep the slots apart"
            else:
                continue
            faults.append(Fault(int(lines[k]), f"{points[k].tolist()}", problem, remedy))
        if faults or not keys:
            faults = faults or [Fault(0, "", "has no points", "write one agent per row: x, y, z")]
            raise MissionError(_findings_of_faults(faults, name, place))
    return Points(points, colours, notes)


def csv_of_points(slots: Floats, colours: Sequence[str] | None) -> str:
    """A text of points that `read_points` reads."""
    rows = [",".join(map(repr, row)) for row in (slots + 0.0).tolist()]
    if colours is None:
        return "\n".join(["x,y,z", *rows, ""])
    lights = (",".join(map(str, bytes.fromhex(colour[1:]))) for colour in colours)
    coloured = (f"{row},{light}" for row, light in zip(rows, lights, strict=True))
    return "\n".join(["x,y,z,red,green,blue", *coloured, ""])


def _findings_of_faults(faults: Sequence[Fault], name: str, place: str = "line") -> list[Finding]:
    """Faults as findings, and how many more there are."""
    findings = [
        Finding(name, f"{place} {line}" if line else "", text or None, problem, remedy)
        for line, text, problem, remedy in faults[:_NAMED]
    ]
    if (more := len(faults) - _NAMED) > 0:
        findings.append(Finding(name, "", None, f"has {more:,} more errors like these", ""))
    return findings


def _hex_colours(colours: Floats, *, real: bool) -> tuple[str, ...]:
    """Colours of rows (N, 3) from 0 to 255; of shares from 0 to 1, if they are real numbers and none is larger.

    Raises
    ------
    ValueError
        They are no colours.
    """
    shares = real and colours.max(initial=0.0) <= 1.0
    colours = np.round(255.0 * colours) if shares else colours
    bad = ~((colours >= 0) & (colours <= 255) & (colours == np.round(colours))).all(axis=1)
    if bad.any():
        k = int(bad.argmax())
        first = f"first {colours[k].tolist()} of point {k + 1}"
        raise ValueError(f"has colours that are no whole numbers from 0 to 255, {first}")
    return tuple(f"#{row.tobytes().hex()}" for row in colours.astype(np.uint8))


def _read_point_table(data: bytes) -> tuple[Ints, Floats, Colours, Notes]:
    """Lines (N,), points (N, 3), colours and notes of a table.

    Raises
    ------
    ValueError
        A column is not understood or there twice, or (ContentError) a row has no numbers.
    """
    unnamed = {2: _AXES[:2], 3: _AXES, 6: [*_AXES, *_HUES]}
    if re.search(rb"#[0-9a-fA-F]{6}\s", data):
        unnamed[4] = [*_AXES, "colour"]
    table, notes = TextTable(data, unnamed), []
    if not table.columns:
        return table.lines, np.zeros((0, 3)), None, ()
    bare = not table.named and table.separator == ","
    if bare and re.search(rb"(^|,)\s*-?0\d", data, re.MULTILINE):
        remedy = "if commas are decimal marks, separate numbers by semicolons"
        raise fault("has numbers such as 00", remedy)
    columns, axes = table.position_columns_and_axes()
    if not (columns := columns or table.find_columns("x", "y")):
        raise table.missing_columns_error("x", "y")
    if (time := table.find_columns("time")) and len(table.codes(time[0])[1]) > 1:
        remedy = "keep the rows of one, or fly it as a trajectory"
        raise fault("has points of several times", remedy)
    written, n = table.find_columns("colour"), len(columns)
    hues = table.find_columns(*_HUES) if not written else []
    values = table.numbers_of_columns(columns + hues)
    if table.decimal == "," and not table.named:
        notes.append("commas are read as decimal marks")
    points, colours = turn_to_enu(np.pad(values[:, :n], ((0, 0), (0, 3 - n))), axes), None
    known = {*columns, *hues, *written, *time}
    unread = [repr(name) for k, name in enumerate(table.names) if name and k not in known
              and table.kinds[k].kind not in ("agent", "thing")]  # fmt: skip
    notes += [f"the columns {first_few(unread)} are not read"] * bool(unread)
    notes += table.unread
    if written:
        colours = tuple(f"#{x.lstrip('#').lower()}" for x in table.columns[written[0]].tolist())
        if odd := next((x for x in colours if not re.fullmatch(r"#[0-9a-f]{6}", x)), None):
            raise fault(f"has the colour {odd[1:]!r}", "write colours as #rrggbb")
    elif hues:
        lights, real = values[:, n:], any("." in x for k in hues for x in table.columns[k].tolist())
        if not real and lights.any() and lights.max() <= 1.0:
            remedy = "write shares from 0 to 1 with a point (1.0)"
            notes.append(f"colours are at most 1 of 255; {remedy}")
        notes += ["six numbers are read as x, y, z, red, green, blue"] * (not table.named)
        colours = _hex_colours(lights, real=real)
    return table.lines, points, colours, tuple(notes)


def _read_npy(data: bytes) -> tuple[Floats, Colours, Notes]:
    """Points (N, 3), colours and notes of an NPY file."""
    try:
        array = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError, OSError, MemoryError) as error:
        raise ValueError(f"is no whole NPY file: {error}") from None
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "iuf":
        raise ValueError("is no array of numbers")
    if array.ndim != 2 or array.shape[1] not in (2, 3, 6):
        raise ValueError(f"has an array {array.shape}, not (N, 3), (N, 2) or (N, 6)")
    points = np.zeros((len(array), 3))
    points[:, : array.shape[1]] = array[:, :3]
    if array.shape[1] < 6:
        return points, None, ()
    return points, _hex_colours(array[:, 3:].astype(np.float64), real=array.dtype.kind == "f"), ()


def _read_ply(data: bytes) -> tuple[Floats, Colours, Notes]:
    """Points (N, 3), colours and notes: vertices of a PLY file (Turk, The PLY polygon file format, 1994)."""
    head, *body = re.split(rb"end_header(?:\r\n|\n|\r)", data, maxsplit=1)
    lines = [line.split() for line in head.decode("ascii", errors="replace").splitlines()]
    if not body or not lines or lines[0] != ["ply"]:
        raise ValueError("has no whole header of a PLY file")
    order, elements = None, []
    for words in lines[1:]:
        if words[:1] == ["format"] and len(words) == 3:
            order = _ORDERS.get(words[1])
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements and len(words) > 2:
            elements[-1][2].append(words[1:])
    before = [name for name, *_ in elements]
    k = before.index("vertex") if "vertex" in before else 0
    _, count, properties = elements[k] if elements else ("", 0, [])
    columns = {words[-1]: _TYPES.get(words[0]) for words in properties}
    if None in columns.values():
        odd = next(words for words in properties if words[0] not in _TYPES)
        raise ValueError(f"has vertices with a property that is no number: {' '.join(odd)}")
    if order is None or "vertex" not in before or not {*_AXES} <= columns.keys():
        raise ValueError("has no vertices with x, y and z, or another format than 1.0")
    hues = {meaning_of(name).kind: name for name in columns}
    names = [*_AXES, *(hues[hue] for hue in _HUES if {*_HUES} <= hues.keys())]
    short = ValueError(f"ends before the last of its {count:,} vertices")
    if order:
        kind = np.dtype([(name, order + str(number)) for name, number in columns.items()])
        start = _bytes_before_vertices(body[0], order, elements[:k])
        if len(body[0]) < start + count * kind.itemsize:
            raise short
        rows: Any = np.frombuffer(body[0], kind, count, start)
        values = np.stack([rows[name].astype(np.float64) for name in names], axis=1)
    else:
        start = sum(number for _, number, _ in elements[:k])
        text = [x for x in body[0].decode("ascii", errors="replace").splitlines() if x.strip()]
        cells = [line.split() for line in text[start : start + count]]
        if len(cells) < count or any(len(row) < len(columns) for row in cells):
            raise short
        places = [[*columns].index(name) for name in names]
        values = np.array([[float(row[i]) for i in places] for row in cells])
        values = values.reshape(count, len(names))
    remarks = (" ".join(words) for words in lines if words[:1] in (["comment"], ["obj_info"]))
    notes = tuple(notes_on_units(remarks))
    if len(names) == 3:
        return values, None, notes
    types = {columns[name] for name in names[3:]}
    colours = values[:, 3:] / (65535.0 if types == {"u2"} else 1.0)
    colours = colours if colours.max(initial=0.0) <= 1.0 else np.round(colours)
    return values[:, :3].copy(), _hex_colours(colours, real=types <= {"u2", "f4", "f8"}), notes


def _bytes_before_vertices(
    body: bytes, order: str, elements: list[tuple[str, int, list[list[str]]]]
) -> int:
    """Number of bytes of the elements before the vertices."""
    start = 0
    for _, count, properties in elements:
        for words in chain.from_iterable(repeat(properties, count if properties else 0)):
            size = np.dtype(_TYPES[words[-2]]).itemsize
            if words[0] == "list":
                number = np.dtype(order + _TYPES[words[1]])
                length = int.from_bytes(body[start : start + number.itemsize], _ENDS[order])
                size = number.itemsize + size * length
            start += size
            if len(body) < start:
                raise ValueError("ends before its vertices")
    return start


def read_bytes(path: str | Path) -> bytes:
    """The content of a file.

    Raises
    ------
    MissionError
        It cannot be read, or is too large.
    """
    problem = f"is larger than {_BYTES >> 20} MiB"
    try:
        with open(path, "rb") as file:
            data = file.read(_BYTES + 1)
        if len(data) <= _BYTES:
            return data
    except OSError as error:
        problem = f"cannot be read: {(error.strerror or str(error)).lower()}"
    raise MissionError([Finding(str(path), "", None, problem, "give a file of numbers")])
