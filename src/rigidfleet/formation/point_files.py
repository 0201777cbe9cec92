"""Points from files: text (CSV), NPY and PLY."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

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
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_points(path: str | Path) -> Floats:
    """Slots (N, 3) [m] from a file, one agent per row: x, y and z (or x and y, for z = 0).

    - NPY (`.npy`): an array (N, 3) or (N, 2).
    - PLY (`.ply`): x, y and z of the vertices, which come first; text or binary.
    - Text (any other name): numbers separated by commas, semicolons or blanks. Empty lines, text after `#` and a first
      line of names (`x,y,z`) are ignored.

    Raises
    ------
    MissionError
        The file cannot be read or has no points; with a finding for each of the first invalid lines.
    """
    return parse_points(read_bytes(path), str(path))


def parse_points(data: bytes, name: str) -> Floats:
    """As `read_points`, from the content of a file; its name tells the format.

    Raises
    ------
    MissionError
        As `read_points` does.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in (".npy", ".ply"):
        return _text(data, name)
    try:
        points = _npy(data) if suffix == ".npy" else _ply(data)
    except ValueError as error:
        remedy = "write it again, with one agent per row: x, y, z [m]"
        raise MissionError([Finding(name, "", None, str(error), remedy)]) from None
    keys = [tuple(point) for point in np.round(points, 9).tolist()]
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
    return points


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
        if point and len(point) not in (2, 3):
            problem = f"has {len(point)} numbers"
            remedy = "write x, y, z (or x, y); decimal points, not commas"
        elif not np.isfinite(point).all():
            problem, remedy = "is not finite", "write x, y, z [m] as finite numbers"
        if not problem:
            at = first.setdefault(tuple(round(x, 9) for x in (*point, 0.0)[:3]), number)
            if at != number:
                problem, remedy = f"repeats the point of line {at}", "keep the slots apart"
        if problem:
            findings.append(Finding(name, f"line {number}", line.strip(), problem, remedy))
        else:
            points.append((*point, 0.0)[:3])
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
    if found.ndim != 2 or found.shape[1] not in (2, 3):
        raise ValueError(f"has an array {found.shape}, not (N, 3) or (N, 2)")
    points = np.zeros((len(found), 3))
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
    if order:
        kind = np.dtype([(name, order + number) for name, number in columns.items()])
        if len(body) < count * kind.itemsize:
            raise ValueError(f"ends before the last of its {count:,} vertices")
        rows: Any = np.frombuffer(body, kind, count)
        return np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1)
    text = body.decode("ascii", errors="replace").splitlines()[:count]
    places = [list(columns).index(axis) for axis in "xyz"]
    cells = [line.split() for line in text]
    if len(cells) < count or any(len(row) < len(columns) for row in cells):
        raise ValueError(f"ends before the last of its {count:,} vertices")
    return np.array([[float(row[k]) for k in places] for row in cells]).reshape(-1, 3)


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
