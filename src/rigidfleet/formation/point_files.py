"""Points, and their colours, from files: text (CSV), NPY and PLY."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidfleet.errors import Finding, MissionError
from rigidfleet.typing import Floats

#: Greatest size of a file of points [bytes], and number of wrong lines that are named one by one.
_BYTES, _NAMED = 64 << 20, 10
#: Numbers of a PLY file: its names of types, in its older and its newer words, and NumPy's.
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
#: Properties of a PLY file that are a colour.
_COLOURS = ("red", "green", "blue")
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class Points(NamedTuple):
    """Points of a file.

    Attributes
    ----------
    slots : (N, 3) [m]
    colours : "#rrggbb" of each; None if the file has no colours
    """

    slots: Floats
    colours: tuple[str, ...] | None


def read_points(path: str | Path) -> Points:
    """Points from a file, one agent per row: x, y and z (or x and y, for z = 0) [m], and a colour where it has colours.

    - NPY (`.npy`): an array (N, 3) or (N, 2); (N, 6) with red, green and blue from 0 to 255.
    - PLY (`.ply`): x, y and z of the vertices, which come first, and red, green and blue (of 8 bits); text or binary.
    - Text (any other name): numbers separated by commas, semicolons or blanks; six with red, green and blue. Empty
      lines, text after `#` and a first line of names (`x,y,z`) are ignored.

    Raises
    ------
    MissionError
        The file cannot be read or has no points; with a finding for each of the first invalid lines.
    """
    return parse_points(read_bytes(path), str(path))


def parse_points(data: bytes, name: str) -> Points:
    """As `read_points`, from the content of a file; its name tells the format.

    Raises
    ------
    MissionError
        As `read_points` does.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in (".npy", ".ply"):
        return _coloured(_text(data, name))
    try:
        points = _npy(data) if suffix == ".npy" else _ply(data)
        if (why := _no_colours(points)) is not None:
            raise ValueError(why)
    except ValueError as error:
        remedy = "write it again, with one agent per row: x, y, z [m]"
        raise MissionError([Finding(name, "", None, str(error), remedy)]) from None
    keys = [tuple(point) for point in np.round(points[:, :3], 9).tolist()]
    first = {key: k for k, key in reversed(list(enumerate(keys)))}
    findings = []
    for k, key in enumerate(keys):
        if not np.isfinite(points[k]).all():
            problem, remedy = "is not finite", "write x, y, z [m] as finite numbers"
        elif first[key] < k:
            problem, remedy = f"repeats point {first[key] + 1}", "keep the slots apart"
        else:
            continue
        findings.append(Finding(name, f"point {k + 1}", points[k].tolist(), problem, remedy))
    if not len(points):
        findings = [Finding(name, "", None, "has no points", "write one agent per row: x, y, z")]
    if findings:
        raise MissionError(_first(findings, name))
    return _coloured(points)


def to_csv(slots: Floats, colours: Sequence[str] | None) -> str:
    """A text of points that `read_points` reads."""
    rows = [",".join(map(repr, row)) for row in (slots + 0.0).tolist()]
    if colours is None:
        return "\n".join(["x,y,z", *rows, ""])
    lights = (",".join(map(str, bytes.fromhex(colour[1:]))) for colour in colours)
    told = (f"{row},{light}" for row, light in zip(rows, lights, strict=True))
    return "\n".join(["x,y,z,red,green,blue", *told, ""])


def _coloured(points: Floats) -> Points:
    """Points from rows (N, 3), or (N, 6) with red, green and blue."""
    if points.shape[1] == 3:
        return Points(points, None)
    colours = points[:, 3:].astype(np.uint8)
    return Points(points[:, :3].copy(), tuple(f"#{row.tobytes().hex()}" for row in colours))


def _no_colours(points: Floats) -> str | None:
    """What is wrong with the colours of rows (N, 3) or (N, 6)."""
    colours = points[:, 3:]
    if ((colours >= 0) & (colours <= 255) & (colours == np.round(colours))).all():
        return None
    return "has colours that are no whole numbers from 0 to 255"


def _first(findings: list[Finding], name: str) -> list[Finding]:
    """The first findings, and how many more there are."""
    if len(findings) > _NAMED:
        more = f"has {len(findings) - _NAMED:,} more errors like these"
        findings = [*findings[:_NAMED], Finding(name, "", None, more, "")]
    return findings


def _text(data: bytes, name: str) -> Floats:
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        remedy = "give a text file with one agent per line"
        raise MissionError([Finding(name, "", None, "is not text", remedy)]) from None
    findings, points, first = [], [], {}
    for number, line in enumerate(lines, start=1):
        fields = [f for f in re.split(r"\s*[,;]\s*|\s+", line.partition("#")[0].strip()) if f]
        if not fields or (not points and not findings and _are_names(fields)):
            continue
        problem = remedy = ""
        try:
            point = [float(field) for field in fields]
        except ValueError:
            point = []
            problem, remedy = "is not a point", "write x, y, z as numbers, with decimal points"
        if "," in line and ";" in line:
            problem, remedy = (
                "has commas and semicolons",
                "separate by one of them; decimal points, not commas",
            )
        elif point and len(point) not in (2, 3, 6):
            problem = f"has {len(point)} numbers"
            remedy = (
                "write x, y, z (or x, y; or x, y, z, red, green, blue); decimal points, not commas"
            )
        elif not np.isfinite(point).all():
            problem, remedy = "is not finite", "write x, y, z [m] as finite numbers"
        elif points and (len(point) == 6) != (len(points[0]) == 6):
            problem, remedy = (
                "has a colour, or has none, unlike the lines before",
                "give all colours or none",
            )
        elif len(point) == 6 and (why := _no_colours(np.array([point]))) is not None:
            problem, remedy = why, "write red, green and blue as whole numbers from 0 to 255"
        if not problem:
            point = point if len(point) == 6 else [*point, 0.0][:3]
            at = first.setdefault(tuple(round(x, 9) for x in point[:3]), number)
            if at != number:
                problem, remedy = f"repeats the point of line {at}", "keep the slots apart"
        if problem:
            findings.append(Finding(name, f"line {number}", line.strip(), problem, remedy))
        else:
            points.append(point)
    if not points and not findings:
        remedy = "write one agent per line: x, y, z"
        findings.append(Finding(name, "", None, "has no points", remedy))
    if findings:
        raise MissionError(_first(findings, name))
    return np.array(points, dtype=np.float64)


def _are_names(fields: list[str]) -> bool:
    def number(field: str) -> bool:
        try:
            float(field)
        except ValueError:
            return False
        return True

    return not any(number(f) or f[0].isdigit() for f in fields)


def _npy(data: bytes) -> Floats:
    try:
        found = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise ValueError(f"is no whole NPY file: {error}") from None
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "iuf":
        raise ValueError("is no array of numbers")
    if found.ndim != 2 or found.shape[1] not in (2, 3, 6):
        raise ValueError(f"has an array {found.shape}, not (N, 3), (N, 2) or (N, 6)")
    points = np.zeros((len(found), max(3, found.shape[1])))
    points[:, : found.shape[1]] = found
    return points


def _ply(data: bytes) -> Floats:
    """Vertices of a PLY file (Turk, The PLY polygon file format, 1994)."""
    head, found, body = data.partition(b"end_header\n")
    if not found:
        head, found, body = data.partition(b"end_header\r\n")
    lines = [line.split() for line in head.decode("ascii", errors="replace").splitlines()]
    if not found or not lines or lines[0] != ["ply"]:
        raise ValueError("has no whole header of a PLY file")
    order, count, columns = None, None, {}
    element = 0
    for words in lines[1:]:
        if words[:1] == ["format"] and len(words) == 3:
            order = _ORDERS.get(words[1])
        elif words[:1] == ["element"]:
            element += 1
            if element == 1 and words[1:2] == ["vertex"] and words[2:] and words[2].isdigit():
                count = int(words[2])
        elif words[:1] == ["property"] and element == 1:
            if len(words) != 3 or words[1] not in _TYPES:
                raise ValueError(
                    f"has vertices with a property that is no number: {' '.join(words)}"
                )
            columns[words[2]] = _TYPES[words[1]]
    if order is None or count is None or not {"x", "y", "z"} <= columns.keys():
        raise ValueError("has no vertices with x, y and z, or another format than 1.0")
    axes = [*"xyz"]
    if all(columns.get(name) == "u1" for name in _COLOURS):
        axes += _COLOURS
    if order:
        kind = np.dtype([(name, order + number) for name, number in columns.items()])
        if len(body) < count * kind.itemsize:
            raise ValueError(f"ends before the last of its {count:,} vertices")
        rows: Any = np.frombuffer(body, kind, count)
        return np.stack([rows[axis].astype(np.float64) for axis in axes], axis=1)
    text = body.decode("ascii", errors="replace").splitlines()[:count]
    places = [list(columns).index(axis) for axis in axes]
    cells = [line.split() for line in text]
    if len(cells) < count or any(len(row) < len(columns) for row in cells):
        raise ValueError(f"ends before the last of its {count:,} vertices")
    return np.array([[float(row[k]) for k in places] for row in cells]).reshape(-1, len(axes))


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
