"""Notebooks kept as text, run and written down as pages.

Their cells are marked as jupytext and editors know them: `# %%` before code, `# %% [markdown]` before
words in comments.
"""

from __future__ import annotations

import ast
import io
import os
import re
import warnings
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any


@dataclass(frozen=True)
class Cell:
    """One cell of a notebook; the text of words is Markdown."""

    words: bool
    text: str


def cells(source: str) -> Iterator[Cell]:
    """The cells of a notebook."""
    for part in re.split(r"^(?=# %%)", source, flags=re.MULTILINE):
        head, _, text = part.partition("\n")
        if head.startswith("# %%") and text.strip():
            words = head.endswith("[markdown]")
            text = re.sub(r"^# ?", "", text, flags=re.MULTILINE) if words else text
            yield Cell(words, text.strip())


def page(path: Path, pictures: dict[str, bytes]) -> str:
    """A notebook, run, as Markdown; its pictures and replays, by file name, are added to `pictures`."""
    parts: list[str] = []
    names: dict[str, Any] = {"__name__": "__main__"}
    with TemporaryDirectory() as folder, chdir(folder), warnings.catch_warnings():
        warnings.simplefilter("error")
        for cell in cells(path.read_text(encoding="utf-8")):
            if cell.words:
                parts.append(cell.text)
                continue
            parts.append(f"```python\n{cell.text}\n```")
            printed, value = run(cell.text, names, str(path))
            shown: list[str] = []
            for figure in value if isinstance(value, list) else [value]:
                if hasattr(figure, "savefig"):
                    name = f"{path.stem}-{len(pictures) + 1}.svg"
                    pictures[name] = svg(figure)
                    shown.append(f"![What the cell draws]({name})")
            if hasattr(value, "html"):
                name = f"{path.stem}-{len(pictures) + 1}.html"
                pictures[name] = value.html.encode()
                shown.append(
                    f'<iframe class="replay" src="{name}" title="Replay" sandbox="allow-scripts"></iframe>'
                )
            elif hasattr(value, "_repr_html_"):
                shown.append(value._repr_html_())
            text = printed if shown or value is None else printed + repr(value)
            if text.strip():
                parts.append(f"```text\n{text.rstrip()}\n```")
            parts += shown
    return "\n\n".join(part for part in parts if part) + "\n"


def run(code: str, names: dict[str, Any], file: str) -> tuple[str, Any]:
    """What a cell prints, and the value of its last line."""
    tree = ast.parse(code, file)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    printed = io.StringIO()
    with redirect_stdout(printed):
        exec(compile(tree, file, "exec"), names)
        value = None
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), file, "eval"), names)
    return printed.getvalue(), value


def svg(figure: Any) -> bytes:
    """A figure of matplotlib as SVG, letters as outlines."""
    import matplotlib as mpl

    os.environ.setdefault("MPLBACKEND", "Agg")
    buffer = io.BytesIO()
    with mpl.rc_context({"svg.fonttype": "path", "svg.hashsalt": "rigidfleet"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()
