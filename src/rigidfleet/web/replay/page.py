"""The page's parts, put together: one file of HTML that needs nothing else."""

from __future__ import annotations

import json
from importlib import resources
from typing import Any

from rigidfleet.result import plain
from rigidfleet.web.policy import content_policy
from rigidfleet.web.template import templates

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
    style : added to what every page has
    connect : whom the page may talk to; see `content_policy`
    """
    style = read("page.css") + style
    script = "\n".join([*map(read, _SCRIPTS), start])
    template = templates("rigidfleet.web.replay", "").get_template("page.html")
    return template.render(
        policy=content_policy(style=style, script=script, connect=connect),
        title=f"{info['name']} – rigidfleet",
        style=style,
        # No mark-up inside: a user's words must not end the script.
        info=json.dumps(plain(info), ensure_ascii=False).replace("<", "\\u003c"),
        data=data,
        script=script,
    )


def read(name: str, package: str = "rigidfleet.web.replay") -> str:
    """Text of a file that lies in a package."""
    return (resources.files(package) / name).read_text(encoding="utf-8")
