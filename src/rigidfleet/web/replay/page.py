"""Assemble the parts of a page into one self-contained HTML file."""

from __future__ import annotations

import html
import json
import re
from importlib import resources
from typing import Any

from rigidfleet.result import plain
from rigidfleet.web.policy import content_policy

_SCRIPTS = ("gl.js", "recording.js", "scene.js", "player.js")


def page(
    info: dict[str, Any], *, start: str, data: str = "", style: str = "", connect: str = "'none'"
) -> str:
    """A page that shows what ``info`` describes.

    Parameters
    ----------
    info : plain data and arrays; see ``describe`` and recording.js
    start : script that starts the player
    data : packed samples, as ``start`` reads them
    style : CSS in addition to that of every page
    connect : hosts that the page may connect to; see `content_policy`
    """
    style = read("page.css") + style
    script = "\n".join([*map(read, _SCRIPTS), start])
    fill = {
        "policy": content_policy(style=style, script=script, connect=connect),
        "title": html.escape(f"{info['name']} – rigidfleet"),
        "style": style,
        # No markup inside: a user's text must not end the script.
        "info": json.dumps(plain(info), ensure_ascii=False).replace("<", "\\u003c"),
        "data": data,
        "script": script,
    }
    return re.sub(r"\{(\w+)\}", lambda match: fill[match[1]], read("page.html"))


def read(name: str, package: str = "rigidfleet.web.replay") -> str:
    """Text of a file in a package."""
    return (resources.files(package) / name).read_text(encoding="utf-8")
