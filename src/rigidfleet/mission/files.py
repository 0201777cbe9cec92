"""Numbers that a mission takes from files: points of slots and agents, heights of obstacles.

The numbers stand in the text of the mission before it is checked. A result holds this text, and so repeats without
the files.
"""

from __future__ import annotations

import copy
import csv
import hashlib
import io
import json
import re
import tomllib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidfleet._common.toml import to_toml
from rigidfleet.errors import Finding, MissionError
from rigidfleet.formation.point_files import parse_points, read_bytes
from rigidfleet.formation.trajectory_files import curve_to_rows, parse_trajectories
from rigidfleet.mission import bounds

#: What stands before the digest of a file.
_DIGEST = "SHA-256 "
#: What a text has that may name a file.
_MAY_NAME = re.compile(r"(file|slots|position)[\"']?\s*=\s*[\"']")
#: What is said where a file cannot be found, because a mission is not from a file itself.
NOT_A_FILE = "is read only with a mission file, as its path is relative to that"


class _Named(NamedTuple):
    """A file that a mission names: the table and key that do, the key of its numbers, and who reads them.

    It may be a ``folder`` of files, one a vehicle.
    """

    table: dict[str, Any]
    key: str
    becomes: str
    where: str
    read: Callable[[list[tuple[str, bytes]]], Content]
    folder: bool = False


class Content(NamedTuple):
    """What a file gives: rows of numbers (of trajectories: of each vehicle), and colours of points if it has them."""

    rows: list[Any]
    colours: tuple[str, ...] | None = None


def completed(text: str, path: Path) -> str:
    """Text of a mission as `with_files` gives it; itself if it names no files.

    Raises
    ------
    MissionError
        As `with_files` does.
    """
    if _MAY_NAME.search(text) is None or bounds.excess(text):
        return text  # which need not, or must not, be parsed
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError):
        return text  # whose errors the check tells
    return with_files(text, data, path)


def with_files(text: str, data: dict[str, Any], path: Path) -> str:
    """Text of a mission in which numbers stand instead of the names of files, with the SHA-256 digest of each.

    Parameters
    ----------
    text, data : the mission's text, and what it says
    path : the mission file; names of files are relative to its folder, and do not leave it

    Raises
    ------
    MissionError
        A file is outside the folder, cannot be read, or has not the numbers asked for.
    """
    data, digests = copy.deepcopy(data), []
    for named in list(_named(data)):
        name = named.table[named.key]
        contents = [
            (str(path.parent / x), read_bytes(_inside(path, named.where, x)))
            for x in _names(path, named)
        ]
        rows, colours = named.read(contents)
        digest = hashlib.sha256(b"".join(data for _, data in contents)).hexdigest()
        told = f"{named.becomes} of {name!r}, {_DIGEST}{digest}"
        digests.append(f"# {named.where}: {told}\n")
        del named.table[named.key]
        named.table[named.becomes] = rows
        written = "".join(f"  {row!r},\n" for row in rows)
        line = re.compile(rf"^([ \t]*){named.key}\s*=\s*([\"']){re.escape(name)}\2", re.MULTILINE)
        put = f"# {told}\n{named.becomes} = [\n{written}]"
        if colours is not None and named.becomes == "slots" and "colour" not in named.table:
            named.table["colour"] = [*colours]
            put += f"\ncolour = {json.dumps(colours)}"
        text = line.sub(lambda m, put=put: m[1] + put, text, count=1)
    try:
        if tomllib.loads(text) == data:
            return text
    except tomllib.TOMLDecodeError:
        pass
    return "".join(digests) + to_toml(data)  # where a file is named within a line


def digests(text: str) -> str:
    """The lines of a mission's text that tell the digests of files, for a text that is written anew from its data."""
    found = re.findall(rf"^# .*{_DIGEST}[0-9a-f]{{64}}$", text, re.MULTILINE)
    return "".join(f"{line}\n" for line in dict.fromkeys(found))


def _names(path: Path, named: _Named) -> list[str]:
    """Names of the files of a name: itself, or those in a folder, in the order of the numbers in them.

    Raises
    ------
    MissionError
        The folder has no files, or is outside the mission's.
    """
    name = named.table[named.key]
    found = _inside(path, named.where, name)
    if not named.folder or not found.is_dir():
        return [name]
    inside = [x.name for x in found.iterdir() if x.suffix.lower() == ".csv"]
    if not inside:
        remedy = "give a folder with a .csv for each vehicle"
        raise MissionError([Finding(str(path), named.where, name, "has no .csv in it", remedy)])
    order = sorted(inside, key=lambda x: [(len(y), y) for y in re.split(r"(\d+)", x)])
    return [str(Path(name) / x) for x in order]


def _named(data: dict[str, Any]) -> Iterator[_Named]:
    forms, agents, things, phases = (
        data.get(key) for key in ("formations", "agents", "obstacles", "phases")
    )
    for k, phase in enumerate(phases if isinstance(phases, list) else (), start=1):
        if (
            isinstance(phase, dict)
            and phase.get("kind") == "follow"
            and isinstance(phase.get("file"), str)
            and "trajectories" not in phase
        ):
            read = partial(_trajectories, yaw=phase.get("yaw") == "file")
            yield _Named(phase, "file", "trajectories", f"phases[{k}].file", read, True)
    for name, form in forms.items() if isinstance(forms, dict) else ():
        if isinstance(form, dict) and isinstance(form.get("slots"), str):
            yield _Named(form, "slots", "slots", f"formations.{name}.slots", _points)
    if isinstance(agents, dict) and isinstance(agents.get("position"), str):
        yield _Named(agents, "position", "position", "agents.position", _points)
    for k, thing in enumerate(things if isinstance(things, list) else (), start=1):
        if (
            isinstance(thing, dict)
            and thing.get("kind") == "heights"
            and isinstance(thing.get("file"), str)
            and "heights" not in thing
        ):
            yield _Named(thing, "file", "heights", f"obstacles[{k}].file", _heights)


def _inside(path: Path, where: str, name: str) -> Path:
    """The file of a name, which may not leave the folder of the mission, not by a link either.

    Raises
    ------
    MissionError
        It does.
    """
    folder = path.parent.resolve()
    try:
        found = (folder / name).resolve()
        if not Path(name).is_absolute() and found.is_relative_to(folder):
            return found
        problem = "leaves the folder of the mission"
    except (OSError, RuntimeError, ValueError):
        problem = "is no name of a file"
    remedy = f"put the file into {folder} or below, and give its relative path"
    raise MissionError([Finding(str(path), where, name, problem, remedy)])


def _points(files: list[tuple[str, bytes]]) -> Content:
    (name, data) = files[0]
    found = parse_points(data, name)
    return Content(found.slots.tolist(), found.colours)


def _trajectories(files: list[tuple[str, bytes]], *, yaw: bool) -> Content:
    """Pieces of each vehicle; with a ``yaw`` if that is asked for."""
    curves, turns = parse_trajectories(files)
    if yaw and not turns:
        problem, remedy = "has no yaw", "remove yaw = 'file', or give a file with a column of yaw"
        raise MissionError([Finding(files[0][0], "", None, problem, remedy)])
    return Content([curve_to_rows(curve) for curve in curves])


def _heights(files: list[tuple[str, bytes]]) -> Content:
    """Numbers of a CSV or NPY file, row by row."""
    (name, data) = files[0]

    def refused(problem: str, remedy: str) -> MissionError:
        return MissionError([Finding(name, "", None, problem, remedy)])

    try:
        if name.lower().endswith(".npy"):
            found = np.load(io.BytesIO(data), allow_pickle=False)
        else:
            rows = list(csv.reader(data.decode("utf-8-sig").splitlines()))
            found = np.array([row for row in rows if any(x.strip() for x in row)], dtype=float)
        found = np.asarray(found, dtype=float)
    except (ValueError, EOFError, OSError):
        raise refused(
            "is not a table of numbers",
            "give rows of equal length, separated by commas, or an NPY array",
        ) from None
    if found.ndim != 2 or not found.size or not np.isfinite(found).all():
        raise refused("is not a table of finite numbers", "give two or more rows of heights [m]")
    if found.size > bounds.HEIGHTS:
        raise refused(
            f"has {found.size:,} heights; the maximum is {bounds.HEIGHTS:,}", "use a coarser grid"
        )
    return Content(found.tolist())
