"""Tables of what is measured: printed as they come, and put into pages of the documents."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table as Markdown, numbers to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def splice(page: Path, tables: Mapping[str, str]) -> None:
    """Put tables into a page, each between ``<!-- NAME -->`` and ``<!-- end -->``."""
    text = page.read_text(encoding="utf-8")
    for name, table in tables.items():
        begin, mark, rest = text.partition(f"<!-- {name} -->\n")
        _, end, after = rest.partition("<!-- end -->")
        if not (mark and end):
            raise ValueError(f"{page}: has no place for a table: <!-- {name} -->, <!-- end -->")
        text = f"{begin}{mark}{table.rstrip()}\n{end}{after}"
    page.write_text(text, encoding="utf-8")


class Page:
    """Tables of what is measured, as Markdown, and how many goals are missed."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.missed = 0

    def title(self, words: str, *head: str) -> None:
        """Begin a table."""
        self.lines += ["", words, "", f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
        print("\n".join(self.lines[-4:]), flush=True)

    def row(self, *cells: str, kept: bool) -> None:
        """Add a row; a goal that is missed stands out."""
        self.missed += not kept
        self.lines.append(f"| {' | '.join(cells)} |" + ("" if kept else " **missed**"))
        print(self.lines[-1], flush=True)
