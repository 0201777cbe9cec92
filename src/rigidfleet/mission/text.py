"""Texts of missions: the shipped ones, and those in files."""

from __future__ import annotations

import tomllib
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from rigidfleet._common.arguments import as_path
from rigidfleet.errors import Finding, MissionError
from rigidfleet.mission import bounds
from rigidfleet.mission.findings import near

_SHIPPED = resources.files("rigidfleet") / "missions"

#: Folders of the shipped missions: their names, and what the missions in them are about.
GROUPS = {
    "paper": "The paper",
    "shapes": "Shapes and rigidity",
    "obstacles": "Obstacles and avoidance",
    "vehicles": "Vehicles",
    "shows": "Shows",
}
#: Shipped missions to look at first.
FIRST = ("narrow-passage", "bridge-inspection", "change-of-picture")


def mission_names(*groups: str) -> list[str]:
    """Names of the shipped missions of some groups (folders of `GROUPS`), of all by default, in alphabetical order."""
    return sorted(_files(*groups))


def _files(*groups: str) -> dict[str, Traversable]:
    """The files of shipped missions by name."""
    files = (file for group in groups or GROUPS for file in (_SHIPPED / group).iterdir())
    return {file.name.removesuffix(".toml"): file for file in files if file.name.endswith(".toml")}


def mission_text(name: str) -> str:
    """TOML text of a shipped mission.

    Raises
    ------
    MissionError
        There is no shipped mission of this name.
    """
    files = _files()
    if name not in files:
        raise MissionError([_not_found(name)])
    return files[name].read_text(encoding="utf-8")


def read_text(path: str | Path) -> str:
    """Text of a mission file or a sweep file.

    Raises
    ------
    MissionError
        The file cannot be read.
    """
    origin = str(path)
    as_path(path)  # a number would be an open file
    try:
        with open(path, "rb") as file:
            data = file.read(bounds.BYTES + 1)
    except FileNotFoundError:
        raise MissionError([_not_found(origin)]) from None
    except IsADirectoryError:
        raise unread(origin, "is a folder", "give the path of a mission file in it") from None
    except PermissionError:
        problem = "cannot be read: permission denied"
        raise unread(origin, problem, "change its permissions") from None
    except (OSError, ValueError) as error:
        problem = f"cannot be read ({error})"
        raise unread(origin, problem, "give the path of a mission file") from None
    remedy = "give the path of a mission file (TOML)"
    if len(data) > bounds.BYTES:
        raise unread(origin, f"is larger than {bounds.BYTES >> 20} MiB", remedy)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        remedy = remedy if b"\0" in data else "save it as UTF-8"
        raise unread(origin, f"is not UTF-8 text (byte {error.start + 1})", remedy) from None


def unread(origin: str, problem: str, remedy: str) -> MissionError:
    """The error of a text that cannot be read."""
    return MissionError([Finding(origin, "", None, problem, remedy)])


def _not_found(name: str) -> Finding:
    known = mission_names()
    remedy = near(Path(name).stem, known) or f"shipped missions: {', '.join(known)}"
    return Finding(name, "", None, "no such file and no shipped mission of this name", remedy)


def parse_toml(text: str, origin: str) -> dict[str, Any]:
    """Parse TOML text.

    Raises
    ------
    MissionError
        The text is not valid TOML or exceeds the bounds on the text of a mission.
    """
    if beyond := bounds.excess(text):
        raise unread(origin, beyond, "reduce it; docs/missions.md lists the bounds")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        problem = f"is not valid TOML: {error}"
        remedy = "correct the line; toml.io describes the format"
    except ValueError as error:  # a number of thousands of digits
        problem = f"cannot be read as TOML: {error}"
        remedy = "correct it; toml.io describes the format"
    except RecursionError:
        problem, remedy = "is nested too deeply", "use the keys of a mission"
    raise unread(origin, problem, remedy)
