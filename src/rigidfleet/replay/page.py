"""The page's parts, put together: one file of HTML that needs nothing else."""

from __future__ import annotations

import html
import json
import re
from importlib import resources
from typing import Any

from rigidfleet.result import plain

_SCRIPTS = ("gl.js", "recording.js", "scene.js", "player.js")
#: What a page may load: nothing but itself.
_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"


def page(
    info: dict[str, Any], *, start: str, data: str = "", style: str = "", policy: str = ""
) -> str:
    """A page that shows what ``info`` describes.

    Parameters
    ----------
    info : plain data and arrays; see ``describe`` and recording.js
    start : script that starts the player
    data : packed samples, as ``start`` reads them
    style, policy : added to what every page has
    """
    fill = {
        "policy": _POLICY + policy,
        "title": html.escape(f"{info['name']} – rigidfleet"),
        "style": read("page.css") + style,
        # No mark-up inside: a user's words must not end the script.
        "info": json.dumps(plain(info), ensure_ascii=False).replace("<", "\\u003c"),
        "data": data,
        "script": "\n".join([*map(read, _SCRIPTS), start]),
    }
    return re.sub(r"\{(\w+)\}", lambda match: fill[match[1]], read("page.html"))


def read(name: str, package: str = "rigidfleet.replay") -> str:
    """Text of a file that lies in a package."""
    return (resources.files(package) / name).read_text(encoding="utf-8")
