"""Our docstrings as the site's reader wants them: what stands behind "name :" is a meaning, not a type."""

from __future__ import annotations

import re
from typing import Any

import griffe

_NAMED = ("Parameters", "Attributes", "Other Parameters")


class Sections(griffe.Extension):
    """Puts each meaning below its name; types come from the signature."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite a docstring before it is parsed."""
        if obj.docstring is not None:
            obj.docstring.value = rewritten(obj.docstring.value)


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
