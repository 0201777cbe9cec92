"""Tables of text that others wrote: comments, lines before the names, separators, decimal marks, rows.

What a column means is not known here: `names` understands its name.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np

from rigidfleet._common.names import unit_of
from rigidfleet.typing import Floats, Ints

#: Separators in the order in which they are tried, with their names.
SEPARATORS = {";": "semicolon", "\t": "tab", ",": "comma", " ": "blanks"}
#: Characters that no table has, and that a terminal would obey when a message shows them.
_CONTROL = re.compile(r"[^\t\n\r\x20-\x7e\xa0-\U0010ffff]")
#: What follows a row, and is none of its colours.
_REMARK = re.compile(r"\s+#(?![0-9a-fA-F]{6}\b).*")
_COMMA, _THOUSANDS = (
    re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?"),
    re.compile(r"[-+]?[1-9]\d{0,2},\d{3}"),
)
_TEXT = np.dtypes.StringDType()
#: Lines among which names are sought, and by which a separator is chosen; rows read together; characters of a line.
_HEAD, _SAMPLE, _TOGETHER, _LONGEST = 200, 20, 1 << 14, 100_000


class Fault(NamedTuple):
    """One error in a table: the line (from 1; 0: the whole file), its text, what is wrong, and the remedy."""

    line: int
    text: str
    problem: str
    remedy: str


class TableError(ValueError):
    """A table cannot be read; it has at least one fault."""

    def __init__(self, *faults: Fault) -> None:
        self.faults = faults
        super().__init__(*faults)


class Table(NamedTuple):
    """A table of text with K rows.

    Attributes
    ----------
    names : of the columns, as they are written; empty where the file has none
    units : of the columns, if a row below the names says them
    line : of the names, from 1; of the first row, where there are none
    separator : a key of `SEPARATORS`
    lines : (K,) of the rows, from 1
    columns : texts (K,) of each column
    texts : all lines of the file
    faults : rows that have another number of fields
    """

    names: list[str]
    units: list[str]
    line: int
    separator: str
    lines: Ints
    columns: list[np.ndarray]
    texts: list[str]
    faults: list[Fault]

    def numbers(self, which: Sequence[int]) -> Floats:
        """Numbers (K, M) of some columns, all finite.

        A comma is a decimal mark if no number has a point, and not all are such that it may separate thousands.

        Raises
        ------
        TableError
            A field is no finite number, or a row has another number of fields.
        """
        values = np.zeros((len(self.lines), len(which)))
        faults = {fault.line: fault for fault in self.faults}
        odd = [k for i, k in enumerate(which) if not _take(self.columns[k], values[:, i])]
        fields = {k: [_REMARK.sub("", x).strip() for x in self.columns[k].tolist()] for k in odd}
        every = [x for own in fields.values() for x in own]
        commas = [x for x in every if _COMMA.fullmatch(x)]
        points = any("." in x for x in every) or any(
            (np.strings.find(self.columns[k], ".") >= 0).any() for k in which
        )
        decimal = not points and not all(map(_THOUSANDS.fullmatch, commas))
        for k, own in fields.items():
            for row, field in enumerate(own):
                plain = field.replace(",", ".") if decimal else field
                if is_number(plain) and "," not in plain and math.isfinite(float(plain)):
                    values[row, which.index(k)] = float(plain)
                    continue
                line, name = (
                    int(self.lines[row]),
                    self.names[k] if self.names else f"number {k + 1}",
                )
                remedy = (
                    "Write decimals with a point"
                    if field in commas
                    else "Leave out rows without a position"
                )
                problem = f"{name} is {field[:40] or 'empty'}, not a finite number"
                faults.setdefault(line, Fault(line, self.texts[line - 1].strip(), problem, remedy))
        if faults:
            raise TableError(*(faults[line] for line in sorted(faults)))
        return values

    def codes(self, column: int) -> tuple[Ints, list[str]]:
        """Codes (K,) of a column's texts, and the texts, in the order of their first rows."""
        known: dict[str, int] = {}
        codes = [known.setdefault(x, len(known)) for x in self.columns[column].tolist()]
        return np.array(codes, dtype=np.int64), [*known]


def _take(fields: np.ndarray, values: Floats) -> bool:
    """Whether all fields are plain finite numbers, which are put into ``values``."""
    try:
        values[:] = fields.astype(np.float64)
    except ValueError:
        return False
    # Python alone groups digits by "_".
    return bool(np.isfinite(values).all()) and not (np.strings.find(fields, "_") >= 0).any()


def is_number(field: str) -> bool:
    """Whether a field is a number, with a decimal point or comma; "nan" and "inf" are."""
    try:
        float(field)
    except ValueError:
        return _COMMA.fullmatch(field.strip()) is not None
    return "_" not in field


def split(line: str, separator: str) -> list[str]:
    """Fields of a line, without blanks around them; blanks before a unit in brackets separate nothing."""
    if separator == " ":
        line = re.sub(r"\s+(?=[\[(])", "\xa0", line).replace("\t", " ").strip()
    try:
        fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:
        return [line]
    plain = [field.replace("\xa0", " ").strip() for field in fields]
    return plain[:-1] if len(plain) > 1 and not plain[-1] else plain


def parse(data: bytes, understood: Callable[[Sequence[str]], int]) -> Table:
    """A table from a file's content.

    Parameters
    ----------
    understood : how many of a line's fields are names of columns; 0 if they are none of a table

    Raises
    ------
    TableError
        The file is no text, or has a line that cannot be one of a table.
    """
    wide = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    try:
        text = data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError:
        why = "is neither text in UTF-8 nor another known format"
        raise TableError(Fault(0, "", why, "Save a table as UTF-8")) from None
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if odd := _CONTROL.search(text):
        problem = f"has the control character U+{ord(odd[0]):04X}"
        raise TableError(Fault(text.count("\n", 0, odd.start()) + 1, "", problem, "Remove it"))
    texts = text.split("\n")
    head = [k for k, line in enumerate(texts[:_HEAD]) if line.strip()]
    if long := next((k + 1 for k in head if len(texts[k]) > _LONGEST), 0):
        raise TableError(
            Fault(long, "", "has no names of columns that are understood", "Give shorter lines")
        )
    most = lambda line: max(sum(map(is_number, split(line, s))) for s in SEPARATORS)  # noqa: E731
    first = next((k for k in head if texts[k][0] != "#" and most(texts[k]) > 1), None)
    start, names, own = _names(
        texts, [k for k in head if first is None or k < first], first, understood
    )
    if not names:
        # Before rows without names, a line that begins with # may be one of them.
        start = next((k for k in head if most(texts[k].lstrip("#")) > 1), len(texts))
    below = [x for x in texts[start : start + _HEAD] if x.strip()]
    below = ([x for x in below if x[0] != "#"] or below)[:_SAMPLE]
    fits = {s: _fitting(below, len(names), s) for s in SEPARATORS}
    separator = max(SEPARATORS, key=lambda s: (fits[s][0], s == own))
    width = len(names) or fits[separator][1]
    units, row = (
        [""] * width,
        [x.strip("[]()") for x in split(below[0], separator)] if below else [],
    )
    if names and len(row) == width and sum(unit_of(x) is not None for x in row) > 1:
        units, start = [x if unit_of(x) else "" for x in row], texts.index(below[0], start) + 1
    if not names and (above := next((k for k in head if k < start and texts[k][0] != "#" and
                                     len(split(texts[k], separator)) == width), None)) is not None:  # fmt: skip
        why = f"has no names of columns that are understood: {texts[above].strip()[:60]}"
        raise TableError(Fault(above + 1, "", why, "Name x, y and z, and for trajectories time"))
    line = start if names else start + 1
    return Table(
        names, units, line, separator, *_rows(texts, start, width, separator, named=bool(names))
    )


def _names(
    texts: list[str], head: list[int], first: int | None, understood: Callable[[Sequence[str]], int]
) -> tuple[int, list[str], str]:
    """Line, from 1, names and separator: of all lines, the one that is understood best."""
    counts = {len(split(texts[first], s)) for s in SEPARATORS} if first is not None else set()
    best, names = (False, 0.0), (0, [], "")
    for k in head:
        for separator in reversed(SEPARATORS):
            fields = split(texts[k].lstrip("#% \t"), separator)
            score = len(fields) in counts, understood(fields) / max(1, len(fields))
            if score[1] > 0.0 and score >= best:
                best, names = score, (k + 1, fields, separator)
    return names


def _fitting(lines: list[str], width: int, separator: str) -> tuple[int, int]:
    """How many lines are rows by a separator, and their width: without names, those of numbers and colours alone."""
    rows = [split(_REMARK.sub("", line), separator) for line in lines]
    colour = re.compile(r"#[0-9a-fA-F]{6}")
    fine = [
        len(row) for row in rows
        if len(row) == width or (not width and len(row) > 1 and all(is_number(x) or colour.fullmatch(x) for x in row))
    ]  # fmt: skip
    return len(fine), Counter(fine).most_common(1)[0][0] if fine else 0


def _rows(
    texts: list[str], start: int, width: int, separator: str, *, named: bool
) -> tuple[Ints, list[np.ndarray], list[str], list[Fault]]:
    """Lines of the rows, texts of the columns, all lines, and faults; read in blocks, as text takes much memory."""
    lines = islice(texts, start, None)
    if separator == " ":
        lines = (line.replace("\t", " ").strip() for line in lines)
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    numbers, blocks, faults, line = [], [], [], start
    try:
        while block := list(islice(reader, _TOGETHER)):
            line += len(block)
            if line != start + reader.line_num:
                raise csv.Error("a quotation mark is not closed")
            own = range(line - len(block) + 1, line + 1)
            if not all(len(row) == width and row[0] and row[0][0] != "#" for row in block):
                odd = [
                    (k, _row(texts[k - 1].strip(), row, width, separator))
                    for k, row in zip(own, block, strict=True)
                ]
                faults += [
                    _miscounted(k, texts[k - 1], len(row), width, start * named)
                    for k, row in odd
                    if row and len(row) != width
                ]
                own, block = (
                    [k for k, row in odd if row and len(row) == width],
                    [row for _, row in odd if row and len(row) == width],
                )
            numbers.append(np.array(own, dtype=np.int64))
            blocks.append([np.array(x, _TEXT) for x in zip(*block, strict=True)])
    except csv.Error as error:
        raise TableError(
            Fault(start + reader.line_num, "", f"cannot be read: {error}", "Write it again")
        ) from None
    columns = [
        np.strings.strip(np.concatenate(parts)) for parts in zip(*filter(None, blocks), strict=True)
    ]
    return (
        np.concatenate([*numbers, np.zeros(0, np.int64)]),
        columns or [np.array([], _TEXT)] * width,
        texts,
        faults,
    )


def _miscounted(line: int, text: str, count: int, width: int, names: int) -> Fault:
    """The fault of a row with another number of fields than the names in a line (0 without), or than the other rows."""
    what = (
        f"fields, and the names in line {names} are {width}"
        if names
        else f"numbers, unlike the lines before with {width}"
    )
    return Fault(line, text.strip(), f"has {count} {what}", "Is the file cut off?")


def _row(text: str, fields: list[str], width: int, separator: str) -> list[str] | None:
    """The fields of a row that is not like the others; None for an empty line and a comment.

    A line that begins with # is a row if it has as many fields as one, or numbers alone behind its first field.
    """
    if not any(field.strip() for field in fields):
        return None
    if len(fields) == width + 1 and not fields[-1].strip():
        fields = fields[:-1]
    if len(fields) != width:
        fields = split(_REMARK.sub("", text), separator)
    is_row = len(fields) == width or (len(fields) > 2 and all(map(is_number, fields[1:])))
    return fields if text[0] != "#" or is_row else None
