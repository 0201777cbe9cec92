"""Facts to show, said once: tables of values with units and levels, and their renderers.

An object that is shown has `facts`, a `Sheet`. Consoles, notebooks and pages render the same sheet; its JSON is the
data (`to_dict`) from which the sheet is made.
"""

from __future__ import annotations

import html
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType, RenderResult

#: How a fact is judged: not at all, as kept, as worth a note, as broken, or as neither kept nor broken for sure.
Level = Literal["", "ok", "note", "fails", "undecided"]
#: Words and colours of levels. A row that is not judged has no mark.
MARKS: dict[Level, str] = {
    "": "", "ok": "ok", "note": "note", "fails": "FAILED", "undecided": "undecided",
}  # fmt: skip
_STYLES: dict[Level, str] = {
    "": "", "ok": "green", "note": "yellow", "fails": "bold red", "undecided": "bold yellow",
}  # fmt: skip
#: Number of columns from which they stand close on a console, to fit 80 characters.
_MANY = 7
#: Notebooks set cells to the right, which suits no words.
_LOOK = ' style="text-align:left;vertical-align:top;padding:2px 14px 2px 0"'


def display_unit(unit: str) -> str:
    """A unit as consoles, pages and figures show it: m/s² for m/s^2, as data and missions write it."""
    return unit.replace("^2", "²").replace("^3", "³")


def value(x: float, unit: str = "") -> str:
    """A number to three digits, with its unit."""
    whole = 999.5 <= abs(x) < 1e5
    number = f"{x:.0f}" if whole else f"{x:.3g}" if x == 0 or 1e-3 <= abs(x) < 1e5 else f"{x:.1e}"
    return f"{number} {display_unit(unit)}".rstrip()


class Cell(NamedTuple):
    """A text with small print, and on pages the colour of whom it is about, or a bar of its share of a limit."""

    text: str
    small: str = ""
    share: float | None = None
    colour: str = ""
    level: Level = ""

    def __str__(self) -> str:
        return f"{self.text} {self.small}".rstrip()

    def html(self) -> str:
        """The cell on a page, whose policy allows no style attribute."""
        box = '<svg class="{}" aria-hidden="true"><rect width="{:.0f}%" height="100%"{}/></svg>'
        swatch = box.format("swatch", 100, f' fill="{self.colour}"') if self.colour else ""
        small = f" <small>{html.escape(self.small)}</small>" if self.small else ""
        bar = "" if self.share is None else box.format("bar", 100 * min(max(self.share, 0), 1), "")
        return f"{swatch}{html.escape(self.text)}{small}{bar}"


class Row(NamedTuple):
    """One row: values, of which None is shown as nothing, and how it is judged."""

    cells: Sequence[Any]
    level: Level = ""


class Line(NamedTuple):
    """A sentence, and how it is judged."""

    text: str
    level: Level = ""

    def html(self, _kind: str = "") -> str:
        """The sentence in a notebook, or on a page beside tables of any kind."""
        return f"<p>{'<br>'.join(map(html.escape, self.text.splitlines()))}</p>"

    def __rich__(self) -> RenderableType:
        from rich.text import Text

        return Text(self.text, _STYLES[self.level])


@dataclass(frozen=True)
class FactTable:
    """Things in rows, their quantities in columns; what applies to no row is not shown.

    Attributes
    ----------
    heads : name of each column, with the unit of its numbers behind it, "end [s]"
    rows : numbers are shown to three digits
    words : names of the columns of words besides the first: they stand left, and may be wrapped
    bare : whether there are facts in words behind their headings, without names of columns and marks
    """

    heads: Sequence[str]
    rows: Sequence[Row]
    words: Collection[str] = ()
    bare: bool = False

    @property
    def names_units_words(self) -> list[tuple[str, str, bool]]:
        """Name and unit of each column that is shown, and whether it holds words; the last one is of marks, if any."""
        names = [self.heads[k].partition(" [") for k in self._shown_column_indices]
        words = [k == 0 or name in self.words for k, (name, *_) in enumerate(names)]
        shown = [(name, unit[:-1], w) for (name, _, unit), w in zip(names, words, strict=True)]
        return shown + [("", "", True)] * self._has_mark_column

    @property
    def cells(self) -> list[list[Cell]]:
        """What stands in each row that is shown."""
        shown, marks = self._shown_column_indices, self._has_mark_column
        return [
            [_cell(row.cells[k]) for k in shown] + [Cell(MARKS[row.level])] * marks
            for row in self.rows
        ]

    @property
    def cell_texts(self) -> list[list[str]]:
        """Cells of each row as text."""
        return [[str(cell) for cell in cells] for cells in self.cells]

    @property
    def _shown_column_indices(self) -> list[int]:
        every = range(len(self.heads))
        return [k for k in every if k == 0 or any(str(_cell(r.cells[k])) for r in self.rows)]

    @property
    def _has_mark_column(self) -> bool:
        return any(row.level for row in self.rows) and not self.bare

    def html(self, kind: str = "") -> str:
        """The table in a notebook, or as a table of this kind on a page, which has a style for it."""

        def cell_attribute(words: bool, level: str = "") -> str:
            names = f"{'words' * words} {level}".strip()
            return _LOOK if not kind else f' class="{names}"' if names else ""

        columns = self.names_units_words
        heads = "".join(
            f"<th{cell_attribute(words)}>{html.escape(f'{name} [{unit}]' if unit else name)}</th>"
            for name, unit, words in columns
        )
        body = f"<thead><tr>{heads}</tr></thead>" * (not self.bare)
        for row, cells in zip(self.rows, self.cells, strict=True):
            line = "".join(
                f"<td{cell_attribute(words, cell.level)}>{cell.html()}</td>"
                for cell, (*_, words) in zip(cells, columns, strict=True)
            )
            body += f"<tr{cell_attribute(False, row.level) if kind else ''}>{line}</tr>"
        return f"<table{f' class={kind!r}' if kind else ''}>{body}</table>"

    def __rich_console__(self, _console: Console, options: ConsoleOptions) -> RenderResult:
        """The table without borders; in a narrow console words are wrapped, or else columns stand below others."""
        from rich.table import Table as Grid
        from rich.text import Text

        space = 2 if len(columns := self.names_units_words) < _MANY else 1
        below = "\n" if sum(bool(unit) for _, unit, _ in columns) > 1 else " "
        heads = [f"{x}{below}{f'[{unit}]' * bool(unit)}".rstrip(" ") for x, unit, _ in columns]
        widths = self._column_widths(heads, options.max_width - space * (len(columns) - 1))
        if widths is None:
            half = len(self.heads) // 2 + 1
            for some in (range(half), (0, *range(half, len(self.heads)))):
                rows = [Row([row.cells[k] for k in some], row.level) for row in self.rows]
                yield replace(self, heads=[self.heads[k] for k in some], rows=rows)
            return
        grid = Grid(box=None, show_header=not self.bare, pad_edge=False, padding=(0, space, 0, 0))
        for head, width, (*_, words) in zip(heads, widths, columns, strict=True):
            side = "left" if words else "right"
            grid.add_column(Text(head, "bold"), justify=side, width=width, overflow="fold")
        heading = ""
        for row, (first, *cells) in zip(self.rows, self.cell_texts, strict=True):
            style, mark = _STYLES[row.level], MARKS[row.level]
            # Behind headings in words, a repeated one is printed once.
            name = Text(first * (first != heading), f"bold {style}") if self.bare else Text(first)
            grid.add_row(name, *(Text(x, style * (x == mark)) for x in cells))
            heading = first
        yield grid

    def _column_widths(self, heads: list[str], room: int) -> list[int] | None:
        """Width of each column, the widest words wrapped first; None if words would be torn apart."""
        from rich.cells import cell_len

        rows = [*self.cell_texts] if self.bare else [heads, *self.cell_texts]
        lines = [[x for row in rows for x in row[k].split("\n")] for k in range(len(heads))]
        widths = [max(map(cell_len, column), default=0) for column in lines]
        least = []
        for column, width, (*_, words) in zip(lines, widths, self.names_units_words, strict=True):
            # An indentation belongs to the first word.
            parts = (cell_len(x) for s in column for x in re.findall(r"^ *\S+|\S+", s))
            least.append(max(parts, default=0) if words else width)
        while sum(widths) > room:
            k = max(range(len(widths)), key=lambda k: (widths[k] > least[k], widths[k]))
            if widths[k] <= least[k] and len(heads) > 3:
                return None
            widths[k] -= 1
        return widths


def _cell(content: Any) -> Cell:
    if isinstance(content, Cell):
        return content
    text = value(content) if isinstance(content, float) else str(content)
    return Cell("" if content is None else text)


class Fact(NamedTuple):
    """A worst value with its unit; its limit, when [s], who and interval, if there are any; and how it is judged."""

    name: str
    value: float | None
    unit: str = ""
    limit: float | None = None
    at_least: bool = False
    when: float | None = None
    who: str = ""
    level: Level = ""
    interval: tuple[float, float] | None = None

    @property
    def interval_text(self) -> str:
        """From what to what the true value is; "" if it is known."""
        return "" if self.interval is None else " to ".join(map(value, self.interval))

    @property
    def bound(self) -> str:
        """The limit with its sense: ">= 0.2 m"; "" if there is none."""
        if self.limit in (None, float("inf")):
            return ""
        sign = (">=" if self.limit else ">") if self.at_least else "<="
        return f"{sign} {value(self.limit, self.unit)}"

    @property
    def row(self) -> Row:
        """The fact as a row of a table."""
        worst = None if self.value is None else value(self.value, self.unit)
        when = None if self.when is None else f"{self.when:.2f}"
        return Row((self.name, worst, self.interval_text, self.bound, when, self.who), self.level)


def table_of(rows: Sequence[Mapping[str, Any]], words: Collection[str] = ()) -> FactTable:
    """Table of things by the names of their quantities, of which each has its own."""
    heads = [*dict.fromkeys(name for row in rows for name in row)]
    return FactTable(heads, [Row([row.get(name) for name in heads]) for row in rows], words)


def table_of_worst_values(what: str, facts: Iterable[Fact]) -> FactTable:
    """Table of worst values with their limits."""
    heads = (what, "worst", "true value", "limit", "at [s]", "who or where")
    return FactTable(heads, [fact.row for fact in facts], heads[5:])


@dataclass(frozen=True)
class Sheet:
    """What is shown of an object: its name and title, then tables and sentences."""

    name: str
    title: str
    parts: Sequence[FactTable | Line]

    @property
    def shown_parts(self) -> list[FactTable | Line]:
        """The parts, without tables in which nothing stands."""
        return [part for part in self.parts if isinstance(part, Line) or part.rows]

    def __rich__(self) -> RenderableType:
        """What is printed: the head, and the parts with blank lines around tables."""
        from rich.console import Group
        from rich.text import Text

        head = Text.assemble((self.name, "bold"), f": {self.title}" * bool(self.title))
        begin: list[Any] = [head] if self.name else []
        blocks = [*begin]
        for part, before in zip(self.shown_parts, [Line(""), *self.shown_parts], strict=False):
            apart = isinstance(part, FactTable) or isinstance(before, FactTable)
            blocks += ["", part] if apart and blocks != begin else [part]
        return Group(*blocks)

    def html(self) -> str:
        """Show the sheet in a notebook. All text is escaped."""
        head = f"<p><strong>{html.escape(self.name)}</strong> {html.escape(self.title)}".rstrip()
        parts = (part.html() for part in self.shown_parts)
        return f"<div>{head}</p>{''.join(parts)}</div>"


class Shown:
    """What has `facts`: rich prints it, and notebooks show it."""

    __slots__ = ()

    def facts(self) -> Sheet:
        """What consoles, notebooks and pages show."""
        raise NotImplementedError

    def __rich__(self) -> Sheet:
        return self.facts()

    def _repr_html_(self) -> str:
        """Show the facts in a notebook."""
        return self.facts().html()
