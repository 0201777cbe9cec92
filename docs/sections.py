"""Our docstrings as the site's reader wants them: what stands behind "name :" is a meaning, not a type."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from typing import Any

import griffe

_NAMED = ("Parameters", "Attributes", "Other Parameters")


class Sections(griffe.Extension):
    """Puts each meaning below its name; types come from the signature. Comments behind fields are their meanings."""

    def on_instance(
        self, *, node: ast.AST | griffe.ObjectNode, obj: griffe.Object, **_: Any
    ) -> None:
        """Rewrite a docstring before it is parsed."""
        if obj.docstring is not None:
            text = obj.docstring.value
            if isinstance(node, ast.ClassDef) and "Attributes\n---" not in text:
                told = list(fields(node, obj.filepath.read_text("utf-8").splitlines()))
                text += "\n\nAttributes\n----------\n" + "\n".join(told) if told else ""
            obj.docstring.value = rewritten(text)


def fields(node: ast.ClassDef, source: list[str]) -> Iterator[str]:
    """The fields of a class that a comment explains, as "name : meaning"."""
    for field in node.body:
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            meaning = source[(field.end_lineno or field.lineno) - 1].partition("  # ")[2]
            if meaning:
                yield f"{field.target.id} : {meaning}"


def rewritten(text: str) -> str:
    """A docstring with each "name : meaning" on two lines."""
    lines: list[str] = []
    section = ""
    source = text.splitlines()
    for k, line in enumerate(source):
        follows = source[k + 1] if k + 1 < len(source) else ""
        if re.fullmatch(r"-{3,}", follows.strip()) and line.strip():
            section = line.strip()
        named = re.match(r"^(\*{0,2}\w[\w, ]*?) : (.*)$", line)
        if section in _NAMED and named:
            lines += [named[1], f"    {named[2]}"]
        elif section in _NAMED and line[:1].strip() and not source[k - 1] and "---" not in follows:
            # What follows the names, after a blank line, is text again.
            section = "Notes"
            lines += ["Notes", "-----", line]
        else:
            lines.append(line)
    # "[x, y, z] [m]" is no link.
    return re.sub(r"\] \[(?=[\w/^]+\])", r"] \\[", "\n".join(lines))
