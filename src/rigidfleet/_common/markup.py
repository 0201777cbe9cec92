"""HTML of what a notebook shows of an object: a head, a small table, a line of words. All text is escaped."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

#: Notebooks set cells to the right, which suits no words.
_CELL = 'style="text-align:left;vertical-align:top;padding:2px 14px 2px 0"'


def shown(
    name: str,
    title: str,
    heads: Sequence[str],
    rows: Iterable[Iterable[object]],
    words: str = "",
) -> str:
    """A name and a title, a table without the columns in which nothing stands, and words below.

    Parameters
    ----------
    heads : of the columns; none for a table without heads
    rows : cells, whose texts are shown as they are
    words : lines stay lines
    """
    cells = [["" if x is None else str(x) for x in row] for row in rows]
    width = max((len(row) for row in cells), default=0)
    kept = [k for k in range(width) if any(row[k] for row in cells)]
    head = f"<p><strong>{html.escape(name)}</strong> {html.escape(title)}".rstrip() + "</p>"
    top = "".join(f"<th {_CELL}>{html.escape(heads[k])}</th>" for k in kept) if heads else ""
    body = "".join(
        "<tr>" + "".join(f"<td {_CELL}>{html.escape(row[k])}</td>" for k in kept) + "</tr>"
        for row in cells
    )
    top = f"<thead><tr>{top}</tr></thead>" if top else ""
    table = f"<table>{top}<tbody>{body}</tbody></table>" if body else ""
    below = f"<p>{'<br>'.join(map(html.escape, words.splitlines()))}</p>" if words else ""
    return f"<div>{head}{table}{below}</div>"
