"""Texts of missions: the shipped ones, and those in files."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from rigidfleet._common.arguments import as_path
from rigidfleet.errors import Finding, MissionError
from rigidfleet.mission import bounds
from rigidfleet.mission.findings import suggest

_SHIPPED = Path(__file__).parents[1] / "missions"

#: What shipped missions are about, and their names.
GROUPS = {
    "The paper": (
        "cube-passage", "cube-waypoint", "establish-cube", "establish-triangle", "narrow-passage", "single-waypoint",
    ),
    "Shapes and rigidity": (
        "drift", "establish-cube-as-printed", "hexagon", "line-singular", "pyramid", "square", "two-agents",
    ),
    "Obstacles and avoidance": (
        "bridge-inspection", "hill-search", "moving-obstacles", "narrow-passage-found", "statue",
    ),
    "Vehicles": (
        "crazyflies", "cube-passage-quadrotors", "delayed", "downwash-cube", "passage-quadrotors", "windy-passage",
    ),
    "Networks": ("cube-by-neighbours", "lossy-passage"),
    "Shows": ("change-of-picture", "falling-light", "ferris-wheel", "market-square", "show-1000"),
}  # fmt: skip
#: Shipped missions to look at first.
FIRST = ("narrow-passage", "bridge-inspection", "change-of-picture")


def mission_names() -> list[str]:
    """Names of the shipped missions, in alphabetical order."""
    return sorted(path.stem for path in _SHIPPED.glob("*.toml"))


def mission_text(name: str) -> str:
    """TOML text of a shipped mission.

    Raises
    ------
    MissionError
        There is no shipped mission of this name.
    """
    if name not in mission_names():
        raise MissionError([_unknown_mission(name)])
    return (_SHIPPED / f"{name}.toml").read_text(encoding="utf-8")


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
        raise MissionError([_unknown_mission(origin)]) from None
    except IsADirectoryError:
        raise text_error(origin, "is a folder", "give the path of a mission file in it") from None
    except PermissionError:
        problem = "cannot be read: permission denied"
        raise text_error(origin, problem, "change its permissions") from None
    except (OSError, ValueError) as error:
        problem = f"cannot be read ({error})"
        raise text_error(origin, problem, "give the path of a mission file") from None
    remedy = "give the path of a mission file (TOML)"
    if len(data) > bounds.BYTES:
        raise text_error(origin, f"is larger than {bounds.BYTES >> 20} MiB", remedy)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        text = data[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" not in data  # marks of UTF-16
        remedy = "save it as UTF-8" if text else remedy
        raise text_error(origin, f"is not UTF-8 text (byte {error.start + 1})", remedy) from None


def text_error(origin: str, problem: str, remedy: str) -> MissionError:
    """The error of a text that cannot be read."""
    return MissionError([Finding(origin, "", None, problem, remedy)])


def _unknown_mission(name: str) -> Finding:
    known = mission_names()
    remedy = suggest(Path(name).stem, known) or f"shipped missions: {', '.join(known)}"
    return Finding(name, "", None, "no such file and no shipped mission of this name", remedy)


def parse_toml(text: str, origin: str) -> dict[str, Any]:
    """Parse TOML text.

    Raises
    ------
    MissionError
        The text is not valid TOML or exceeds the bounds on the text of a mission.
    """
    if beyond := bounds.toml_oversize_in_words(text):
        raise text_error(origin, beyond, "reduce it; docs/missions.md lists the bounds")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        problem = f"is not valid TOML: {error}"
        remedy = "correct the line; toml.io describes the format"
        if Path(origin).suffix not in ("", ".toml"):
            remedy = "name a mission; trajectories are judged by `rigidfleet assess`"
    except ValueError as error:  # a number of thousands of digits
        problem = f"cannot be read as TOML: {error}"
        remedy = "correct it; toml.io describes the format"
    raise text_error(origin, problem, remedy)
