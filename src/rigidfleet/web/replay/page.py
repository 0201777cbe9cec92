"""Assemble the parts of a page into one self-contained HTML file."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator
from importlib import resources
from typing import Any

from rigidfleet._common.plain import to_json_text
from rigidfleet._common.templates import templates
from rigidfleet.web.policy import content_policy

_IMPORT = re.compile(r'^import \{[^}]*\} from "([^"]+)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async function|function|class|const) )", re.MULTILINE)


def page(
    info: dict[str, Any], *, start: str, data: str = "", style: str = "", connect: str = "'none'"
) -> str:
    """A page that shows what ``info`` describes.

    Parameters
    ----------
    info : plain data and arrays; see ``describe`` and recording.js
    start : module that starts the player, see `bundle_module`
    data : packed samples, as ``start`` reads them
    style : CSS in addition to that of every page
    connect : hosts that the page may connect to; see `content_policy`
    """
    style = asset_text("replay/page.css") + style
    script = bundle_module(start)
    template = templates("rigidfleet.web.replay", "").get_template("page.html")
    return template.render(
        policy=content_policy(style=style, script=script, connect=connect),
        title=f"{info['name']} – rigidfleet",
        style=style,
        # No markup inside: a user's text must not end the script.
        info=to_json_text(info).replace("<", "\\u003c"),
        data=data,
        script=script,
    )


def bundle_module(start: str) -> str:
    """One module of a JavaScript module and all that it imports: a page that is a file can import nothing.

    Modules import names from each other by relative paths, and share one scope here: what is declared at the top of
    one has a name of its own.
    """
    seen: set[str] = set()

    def module_texts(name: str) -> Iterator[str]:
        if name not in seen:
            seen.add(name)
            text = asset_text(name)
            for target in _IMPORT.findall(text):
                yield from module_texts(
                    posixpath.normpath(posixpath.join(posixpath.dirname(name), target))
                )
            yield _EXPORT.sub("", _IMPORT.sub("", text))

    return "\n".join(module_texts(start))


def asset_text(name: str) -> str:
    """Text of a file below the package of the pages."""
    return (resources.files("rigidfleet.web") / name).read_text(encoding="utf-8")
