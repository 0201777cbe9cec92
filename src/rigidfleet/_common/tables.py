"""Tables of text that others wrote: comments, lines before the names, separators, decimal marks, rows and units."""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np

from rigidfleet._common.names import AXES, DIRECTIONS, count_column_names, meanings_of, unit_of
from rigidfleet.typing import Floats, Ints

#: Separators in the order in which they are tried, with their names.
SEPARATORS = {";": "semicolon", "\t": "tab", ",": "comma", " ": "blanks"}
#: Units without a word of the file or the user.
DEFAULT = {"time": "s", "length": "m", "angle": "rad"}
#: Characters that no table has, and that a terminal would obey when a message shows them.
_CONTROL = re.compile(r"[^\t\n\r\x20-\x7e\xa0-\U0010ffff]")
#: What follows a row, and is none of its colours.
_REMARK = re.compile(r"\s+#(?![0-9a-fA-F]{6}\b).*")
_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}[.,]\d{3}")
#: Units of which there may be thousands.
_SMALL = {1e-3, 1e-6, 1e-9}
_HUNDREDS = re.compile(r"[-+]?[1-9]\d{0,2}")
_TEXT = np.dtypes.StringDType()
#: Words for units and axes in lines that are not read, and for numbers that are not there.
_UNSAID = re.compile(
    r"(?i)\b(units?|scale|[kmc]m|ft|feet|yards?|inch(es)?|[mun]s(ecs?)?|in (frames|minutes)|fps|deg(rees)?|n[ew][ud]"
    r"|frd|down\w*|north|left[- ]hand\w*|[xy][- _]?up|up[- _]axis|(kilo|milli|centi|micro|nano)(met|sec)\w+)\b"
)
_BLANK = re.compile(r"(?i)(-?nan(\(ind\))?|#?n/?a|<na>|nat|null|none|--?|\?)?")
#: Lines among which names are sought, and by which a separator is chosen; rows read together; characters of a line.
_HEAD, _SAMPLE, _TOGETHER, _LONGEST = 200, 20, 1 << 14, 100_000


class Fault(NamedTuple):
    """One error in a file: the line (from 1; 0: the whole file), its text, what is wrong, and the remedy."""

    line: int
    text: str
    problem: str
    remedy: str


class ContentError(ValueError):
    """The content of a file cannot be read; it has at least one fault."""

    def __init__(self, *faults: Fault) -> None:
        self.faults = faults
        line, _, problem, remedy = faults[0]
        place = f"line {line}: " if line else ""
        words = f"{place}{problem}. {remedy}".rstrip(". ")
        super().__init__((words if words.endswith("?") else f"{words}.").replace("?. ", "? "))


def fault(problem: str, remedy: str = "", line: int = 0) -> ContentError:
    """The error of a single fault."""
    return ContentError(Fault(line, "", problem, remedy))


class TextTable:
    """A table of text with K rows, whose columns are understood by their names.

    Attributes
    ----------
    names, kinds : of the columns: as they are written, and the `names.ColumnMeaning` of each
    line : of the names, from 1; of the first row, where there are none
    separator, decimal : a key of `SEPARATORS`, and the decimal mark of numbers; "" until one is no plain number
    named : whether the file has names
    lines : (K,) of the rows, from 1
    columns : texts (K,) of each column
    texts : all lines of the file
    places : number of the column of each quantity, by kind and vehicle
    units : of each dimension of columns that were read the word, and where it is from: "" if it is assumed
    unread : a note on a line beside names and rows that speaks of units or axes, if there is one

    Parameters
    ----------
    words : units of columns that do not say theirs, by dimension
    unnamed : names of the columns where the file has none, by their number

    Raises
    ------
    ContentError
        The file is no table, has names that are not understood, an unknown unit, or two columns for a quantity.
    """

    def __init__(
        self, data: bytes, unnamed: Mapping[int, list[str]], words: Mapping[str, str] | None = None
    ) -> None:
        self.texts, self.words = _lines(data), words or {}
        self.line, start, self.names, below, self.separator, width = _find_header(self.texts)
        rows = _read_columns_as_text(self.texts, start, width, self.separator, self.line)
        self.lines, self.columns, self._faults = rows
        self.named, self.decimal = bool(self.names), ""
        if not self.named and width:
            if width not in unnamed:
                why = f"has no names of columns that are understood, and {width} numbers"
                raise fault(why, "Begin with a line such as time_s,x_m,y_m,z_m", self.line)
            self.names, below = unnamed[width], [""] * width
        self.kinds = meanings_of(self.names)
        self.places: dict[tuple[str, str], int] = {}
        self.units: dict[str, tuple[str, str]] = {}
        self._below = below
        for k, (kind, _, who) in enumerate(self.kinds):
            if kind in ("", "agent", "thing"):
                continue
            first = self.places.setdefault((kind, who), k)
            if self.names[first] != self.names[k] or (self.columns[first] != self.columns[k]).any():
                why = f"has two columns for {kind}: {self.names[first]!r}, {self.names[k]!r}"
                several = ", or name those of several vehicles x1, y1, z1 and x2, y2, z2"
                raise fault(why, "Keep one" + several * (kind in "xyz"))
        rows = self.lines[[0, -1]].tolist() if len(self.lines) else [0, len(self.texts)]
        beside = [*self.texts[: max(0, rows[0] - 1)], *self.texts[rows[1] :]]
        if self.named:
            del beside[self.line - 1 : None if any(below) else self.line]
        self.unread = notes_on_units(beside)

    def factor(self, k: int) -> float:
        """The factor of the unit of a column, which a row below the names may say.

        Raises
        ------
        ContentError
            The unit is unknown, said twice in other ways, or said for some columns of a dimension only.
        """
        name, said, below = self.names[k], self.kinds[k].unit, self._below[k]
        dimension = self.kinds[k].dimension
        option = self.words.get(dimension, "")
        words = [word for word in (said, below, option, DEFAULT.get(dimension, "")) if word]
        if not dimension or not words:
            return 1.0
        known = [unit_of(word) for word in words[:-1] or words]
        column = f"the column {name!r}"
        if known[0] is None or known[0][0] != dimension:
            raise fault(f"{column} has the unknown unit {words[0]!r}", "Use s, m and rad")
        if any(unit != known[0] for unit in known):
            raise fault(f"{column} is in {words[0]!r}, but also in {words[1]!r}", "Remove one")
        source = "the file" if said or below else "the option" if option else ""
        first_source = self.units.setdefault(dimension, (words[0], source))[1]
        if bool(source) != bool(first_source):
            raise fault(f"has units for some columns of {dimension} only: {name!r}", "Give all")
        return known[0][1]

    def find_columns(self, *kinds: str, who: str = "") -> list[int]:
        """Columns of some quantities; empty unless all are there."""
        columns = [self.places.get((kind, who), -1) for kind in kinds]
        return [] if -1 in columns else columns

    def position_columns_and_axes(self, axes: str = "", who: str = "") -> tuple[list[int], str]:
        """Columns of a position, x, y and z or named by directions, and where they point: ``axes``, or ``"enu"``.

        Raises
        ------
        ContentError
            Names of directions contradict the axes.
        """
        if place := self.find_columns(*"xyz", who=who):
            return place, axes or "enu"
        ways = [kind for kind, own in self.places if kind in DIRECTIONS and own == who]
        named = "".join(DIRECTIONS[way] for way in ways)
        if not are_axes(named):
            return [], axes or "enu"
        if sorted(axes or named) != sorted(named):
            raise fault(f"has columns {', '.join(ways)}, but the axes are {axes}", "Remove one")
        return self.find_columns(*ways, who=who), named

    def missing_columns_error(self, *required_kinds: str) -> ContentError:
        """The error of a table without some quantities."""
        if self.find_columns("latitude"):
            return fault("has latitude and longitude", "Give metres from an origin: x_m, y_m, z_m")
        missing = ", ".join(kind for kind in required_kinds if not self.find_columns(kind))
        why = f"has no column for {missing} among {', '.join(self.names)[:80]}"
        return fault(why, "Name columns x_m, y_m and z_m, and time_s for trajectories")

    def codes(self, column: int) -> tuple[Ints, list[str]]:
        """Codes (K,) of a column's texts, and the texts, in the order of their first rows."""
        known: dict[str, int] = {}
        codes = [known.setdefault(x, len(known)) for x in self.columns[column].tolist()]
        return np.array(codes, dtype=np.int64), [*known]

    def numbers_of_columns(self, which: Sequence[int], blank: Collection[int] = ()) -> Floats:
        """Numbers (K, M) of some columns, all finite, in s, m and rad; of ``blank`` ones, empty fields and nan are NaN.

        A comma is a decimal mark if no number has a point, and not all are such that it may separate thousands.

        Raises
        ------
        ContentError
            A field is no finite number, or a row has another number of fields.
        """
        factors, values = [self.factor(k) for k in which], np.zeros((len(self.lines), len(which)))
        faults = {fault.line: fault for fault in self._faults}
        odd = [i for i, k in enumerate(which) if not _parse_numbers(self.columns[k], values[:, i])]
        for k in (k for k, factor in zip(which, factors, strict=True) if factor in _SMALL):
            fields = [
                x for x in self.columns[k].tolist() if is_number(x) and not _BLANK.fullmatch(x)
            ]
            marked = [x for x in fields if "." in x or "," in x]
            whole = any(map(_HUNDREDS.fullmatch, fields))
            thousands = marked and whole and all(map(_THOUSANDS.fullmatch, marked))
            # Decimals that end in 0 would not be beside whole numbers.
            trailing = any(x.endswith("0") for x in marked)
            if thousands and (trailing or _leap(fields, "") <= _leap(fields, ".")):
                why = f"{self.names[k]} is {min(marked)}, and others have no decimals: are these thousands?"
                raise fault(why, "Write no marks between thousands, or decimals everywhere")
        if odd and not self.decimal:
            columns = [self.columns[k].tolist() for k in self.places.values()]
            every = [_REMARK.sub("", x) for column in columns for x in column]
            comma = not all(_THOUSANDS.fullmatch(x) for x in every if _COMMA.fullmatch(x))
            point = any("." in x and is_number(x) for x in every)
            self.decimal = "," if comma and not point else "."
        for i in odd:
            for row, written in enumerate(self.columns[which[i]].tolist()):
                field = _REMARK.sub("", written)
                plain = field.replace(self.decimal, ".")
                if is_number(plain) and "," not in plain and math.isfinite(float(plain)):
                    values[row, i] = float(plain)
                    continue
                if which[i] in blank and _BLANK.fullmatch(field.strip()):
                    values[row, i] = np.nan
                    continue
                line, name = int(self.lines[row]), self.names[which[i]]
                why = f"{name} is {field[:40] or 'empty'}, not a finite number"
                grouped = re.fullmatch(r"[-+]?[\d.,][-+\d.,' eE]*", field)
                remedy = "Write decimals with a point, and no marks between thousands"
                remedy = remedy if grouped else "Write numbers alone, or leave out the row"
                faults.setdefault(line, Fault(line, self.texts[line - 1].strip(), why, remedy))
        if faults:
            raise ContentError(*(faults[line] for line in sorted(faults)))
        return values * factors


def _leap(fields: Sequence[str], mark: str) -> float:
    """The greatest change from one number to the next, over all changes, where a mark stands for a point or a comma."""
    change = np.abs(np.diff([float(re.sub("[.,]", mark, x)) for x in fields]))
    return float(change.max(initial=0.0) / max(change.sum(), 1e-300))


def notes_on_units(lines: Iterable[str]) -> list[str]:
    """A note on the first of some lines that speaks of units or axes; none without one."""
    said = (line.strip()[:60] for line in lines if _UNSAID.search(line))
    return [f"{line!r} is not read: does it say units or axes?" for line in islice(said, 1)]


def _parse_numbers(fields: np.ndarray, values: Floats) -> bool:
    """Whether all fields are plain finite numbers, which are put into ``values``."""
    try:
        values[:] = fields.astype(np.float64)
    except ValueError:
        return False
    # Python alone groups digits by "_".
    return bool(np.isfinite(values).all()) and not (np.strings.find(fields, "_") >= 0).any()


def are_axes(axes: str) -> bool:
    """Whether three letters are directions of axes."""
    return sorted(AXES.get(letter, (9,))[0] for letter in axes) == [0, 1, 2]


def is_number(text: str) -> bool:
    """Whether a text is a number, with a decimal point or comma; "nan" and "inf" are."""
    try:
        float(text)
    except ValueError:
        return _COMMA.fullmatch(text.strip()) is not None
    return "_" not in text


def split_fields(line: str, separator: str) -> list[str]:
    """Fields of a line, without blanks around them; blanks before a unit in brackets separate nothing."""
    if separator == " ":
        line = re.sub(r"\s+(?=[\[(])", "\xa0", line).replace("\t", " ").strip()
    try:
        fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:
        return [line]
    plain = [field.replace("\xa0", " ").strip() for field in fields]
    return plain[:-1] if len(plain) > 1 and not plain[-1] else plain


def _lines(data: bytes) -> list[str]:
    """The lines of a file.

    Raises
    ------
    ContentError
        It is no text.
    """
    wide = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    try:
        text = data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError:
        why = "is neither text in UTF-8 nor another known format"
        raise fault(why, "Save a table as UTF-8") from None
    text = text.replace("\r\n", "\n").replace("\r", "\n").replace("\N{MINUS SIGN}", "-")
    if odd := _CONTROL.search(text):
        line = text.count("\n", 0, odd.start()) + 1
        raise fault(f"has the control character U+{ord(odd[0]):04X}", "Save a table as text", line)
    return text.split("\n")


def _find_header(texts: list[str]) -> tuple[int, int, list[str], list[str], str, int]:
    """Line of the names, number of lines before the rows, names, units in a row below them, separator, and width."""
    head = [k for k, line in enumerate(texts[:_HEAD]) if line.strip()]
    if long := next((k + 1 for k in head if len(texts[k]) > _LONGEST), 0):
        raise fault("has no names of columns that are understood", "Give shorter lines", long)
    split = {k: [split_fields(texts[k].lstrip("#"), s) for s in SEPARATORS] for k in head}
    most = {k: max((sum(map(is_number, x)), len(x)) for x in fields) for k, fields in split.items()}
    rows = {k: count for k, (count, _) in most.items() if count > 1}
    plain = [k for k in rows if texts[k][0] != "#"]
    start, names, own = _find_names(texts, [k for k in head if 2 * most[k][0] <= most[k][1]], plain)
    if not names:
        # Before rows without names, a line that begins with # may be one of them.
        start = min(rows, default=len(texts))
    below = [x for x in texts[start : start + _HEAD] if x.strip()]
    below = ([x for x in below if x[0] != "#"] or below)[:_SAMPLE]
    fits = {s: _count_rows_and_width(below, len(names), s) for s in SEPARATORS}
    separator = max(SEPARATORS, key=lambda s: (fits[s][0], s == own))
    width, line = len(names) or fits[separator][1], start + (not names)
    row = split_fields(re.sub(r"[\[\]()]", "", below[0]), separator) if below else []
    units = [""] * width
    if names and len(row) == width and sum(unit_of(x) is not None for x in row) > 1:
        units, start = [x if unit_of(x) else "" for x in row], texts.index(below[0], start) + 1
    above = [k for k in head if not names and k < start and texts[k][0] != "#"]
    if above := [k for k in above if width in (0, len(split_fields(texts[k], separator)))]:
        k = above[-1 if width else 0]
        why = f"has no names of columns that are understood: {texts[k][:60]}"
        raise fault(why, "Name columns such as time_s,x_m,y_m,z_m", k + 1)
    least = min((rows[k] for k in plain if k >= start), default=width)
    for k in plain if names else ():
        if k < line - 1 and rows[k] >= least and len(split_fields(texts[k], separator)) == width:
            raise fault(f"has a row before its names, which are in line {line}", "", k + 1)
    return line, start, names, units, separator, width


def _find_names(texts: list[str], head: list[int], rows: list[int]) -> tuple[int, list[str], str]:
    """Line, from 1, names and separator: of the lines before the first row below names, the one understood best."""
    best, names = (False, 0.0), (0, [], "")
    for k in head:
        if names[0] and any(names[0] <= row <= k for row in rows):
            break
        first = next((row for row in rows if row > k), len(texts))
        counts = {len(split_fields(x, s)) for x in texts[first : first + 1] for s in SEPARATORS}
        for separator in reversed(SEPARATORS):
            line = texts[k].lstrip("#%!/ \t")
            fields, whole = split_fields(line, separator), split_fields(f"{line}.", separator)
            if len(whole) > len(fields) and len(whole) in counts:
                fields.append("")  # a last column without a name
            score = len(fields) in counts, count_column_names(fields) / max(1, len(fields))
            if score[1] > 0.0 and score >= best:
                best, names = score, (k + 1, fields, separator)
    return names


def _count_rows_and_width(lines: list[str], width: int, separator: str) -> tuple[int, int]:
    """How many lines are rows by a separator, and their width: without names, those of numbers and colours alone."""
    rows = [split_fields(_REMARK.sub("", line), separator) for line in lines]
    colour = re.compile(r"#[0-9a-fA-F]{6}")
    fine = [
        len(row) for row in rows
        if len(row) == width or (not width and len(row) > 1 and all(is_number(x) or colour.fullmatch(x) for x in row))
    ]  # fmt: skip
    return len(fine), Counter(fine).most_common(1)[0][0] if fine else 0


def _read_columns_as_text(
    texts: list[str], start: int, width: int, separator: str, names: int
) -> tuple[Ints, list[np.ndarray], list[Fault]]:
    """Lines of the rows, texts of the columns, and faults; read in blocks, as rows of texts take much memory."""
    lines = islice(texts, start, None)
    if separator == " ":
        lines = (line.replace("\t", " ").strip() for line in lines)
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    what = f"fields, and the names in line {names} are {width}"
    what = what if names <= start else f"numbers, unlike the lines before with {width}"
    numbers, blocks, faults, line = [], [], [], start
    try:
        while block := list(islice(reader, _TOGETHER)):
            first, line = line + 1, start + reader.line_num
            if line - first + 1 != len(block):
                raise csv.Error("a quotation mark is not closed")
            rows = []
            for k, fields in enumerate(block, first):
                plain = len(fields) == width and fields and fields[0] and fields[0][0] != "#"
                row = fields if plain else _odd_row_fields(texts[k - 1], fields, width, separator)
                if row and len(row) == width:
                    numbers.append(k)
                    rows.append(row)
                elif row:
                    why = f"has {len(row)} {what}"
                    faults.append(Fault(k, texts[k - 1].strip(), why, "Is the file cut off?"))
            blocks.append([np.array(x, _TEXT) for x in zip(*rows, strict=True)])
    except csv.Error as error:
        raise fault(f"cannot be read: {error}", "Write it again", start + reader.line_num) from None
    parts = [*zip(*filter(None, blocks), strict=True)] or [[np.array([], _TEXT)]] * width
    columns = [np.strings.strip(np.concatenate(part)) for part in parts]
    return np.array(numbers, dtype=np.int64), columns, faults


def _odd_row_fields(line: str, fields: list[str], width: int, separator: str) -> list[str]:
    """The fields of a row that is not like the others; none of an empty line and a comment.

    A line that begins with # is a row if it has as many fields as one, or numbers alone behind its first field.
    """
    text = line.strip()
    if not any(field.strip() for field in fields):
        return []
    if len(fields) == width + 1 and not fields[-1].strip():
        fields = fields[:-1]
    if len(fields) != width:
        fields = split_fields(_REMARK.sub("", text), separator)
    is_row = len(fields) == width or (len(fields) > 2 and all(map(is_number, fields[1:])))
    return fields if text[0] != "#" or is_row else []
