"""Numbers that a mission takes from files: points of slots and agents, heights of obstacles.

The numbers stand in the text of the mission before it is checked. A result holds this text, and so repeats without
the files.
"""

from __future__ import annotations

import csv
import hashlib
import io
import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidfleet._common.toml import to_toml
from rigidfleet.errors import Finding, MissionError, TrajectoryError
from rigidfleet.mission.geojson import read_geojson
from rigidfleet.mission.text import text_error

#: What stands before the digest of a file.
_DIGEST = "SHA-256 "
#: What stands before the notes on a file.
_DOUBTS = ". Note: "
#: What is said where a file cannot be found, because a mission is not from a file itself.
NOT_A_FILE = "is read only with a mission file, as its path is relative to that"


#: What a file gives: rows of numbers (of trajectories: of each vehicle), notes, and colours of points if it has any.
_Content = tuple[list[Any], *tuple[Sequence[str], ...]]


class _Named(NamedTuple):
    """A file that a mission names: the table and key that do, the key of its numbers, and who reads them."""

    table: dict[str, Any]
    key: str
    becomes: str
    where: str
    read: Callable[[bytes, str], _Content]


def inline_files(data: dict[str, Any], text: str, path: Path) -> tuple[dict[str, Any], str]:
    """A mission in which numbers stand instead of the names of files, with the SHA-256 digest of each in its text.

    That text is written anew, without comments.

    Parameters
    ----------
    data, text : what the mission's text says, which is changed, and the text
    path : the mission file; names of files are relative to its folder, and do not leave it

    Raises
    ------
    MissionError
        A file is outside the folder, cannot be read, or has not the numbers asked for.
    """
    digests = []
    for named in list(_entries_with_files(data)):
        from rigidfleet.formation.point_files import read_bytes

        name = named.table[named.key]
        content = b"".join(
            read_bytes(_path_in_folder(path, named.where, x)) for x in _names_of_files(path, named)
        )
        rows, notes, *colours = named.read(content, str(path.parent / name))
        origin = f"{named.becomes} of {name!r}, {_DIGEST}{hashlib.sha256(content).hexdigest()}"
        if notes:
            origin += f"{_DOUBTS}{' '.join('; '.join(notes).split())}"
        digests.append(f"# {named.where}: {origin}\n")
        del named.table[named.key]
        if named.becomes == "trajectories":
            named.table.pop("units", None), named.table.pop("axes", None)
        named.table[named.becomes] = rows
        if colours and named.becomes == "slots":
            named.table.setdefault("colour", colours)
    return data, "".join(digests) + to_toml(data) if digests else text


def digest_lines(text: str) -> str:
    """The lines of a mission's text that tell the digests of files, for a text that is written anew from its data."""
    digest = rf"# .*{_DIGEST}[0-9a-f]{{64}}(?:{_DOUBTS}.*)?"
    lines = (line for line in text.splitlines() if re.fullmatch(digest, line))
    return "".join(f"{line}\n" for line in dict.fromkeys(lines))


def notes_on_files(text: str) -> list[str]:
    """What is said of the files of a mission's text, each with what was read of it."""
    noted = rf"^[ \t]*# (.*), {_DIGEST}[0-9a-f]{{64}}{_DOUBTS}(.*)$"
    lines = re.findall(noted, "\n".join(text.splitlines()), re.MULTILINE)
    return [f"{what}: {notes}" for what, notes in dict.fromkeys(lines)]


def _names_of_files(path: Path, named: _Named) -> list[str]:
    """Names of the files of a name: itself, or those in a folder of trajectories, one a vehicle.

    Raises
    ------
    MissionError
        The folder has no files, or is outside the mission's.
    """
    name = named.table[named.key]
    place = _path_in_folder(path, named.where, name)
    if named.becomes != "trajectories" or not place.is_dir():
        return [name]
    from rigidfleet.foreign.files import groups_of_files

    try:
        inside = [file for group in groups_of_files(place) for file in group]
    except TrajectoryError as error:
        raise _file_error(str(path), named.where, error) from None
    return [str(Path(name) / file.relative_to(place)) for file in inside]


def _file_error(name: str, where: str, error: TrajectoryError) -> MissionError:
    problem = str(error).removeprefix(f"{name}: ").rstrip(".")
    return MissionError([Finding(name, where, None, problem, "")])


def _entries_with_files(data: dict[str, Any]) -> Iterator[_Named]:
    forms, agents, things, phases = (
        data.get(key) for key in ("formations", "agents", "obstacles", "phases")
    )
    for k, phase in _tables_with_file(phases, "follow", "trajectories"):
        said = {key: phase[key] for key in ("units", "axes") if isinstance(phase.get(key), str)}
        read = partial(_read_trajectories, yaw=phase.get("yaw") == "file", said=said)
        yield _Named(phase, "file", "trajectories", f"phases[{k}].file", read)
    for name, form in forms.items() if isinstance(forms, dict) else ():
        if isinstance(form, dict) and isinstance(form.get("slots"), str):
            yield _Named(form, "slots", "slots", f"formations.{name}.slots", _read_points)
    if isinstance(agents, dict) and isinstance(agents.get("position"), str):
        yield _Named(agents, "position", "position", "agents.position", _read_points)
    for k, thing in _tables_with_file(things, "heights", "heights"):
        yield _Named(thing, "file", "heights", f"obstacles[{k}].file", _read_heights)
    for key in ("fences", "people"):
        for k, area in _tables_with_file(data.get(key), None, "coordinates"):
            yield _Named(area, "file", "coordinates", f"{key}[{k}].file", read_geojson)


def _tables_with_file(
    tables: Any, kind: str | None, numbers: str
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Numbers, from 1, and tables of a kind, if any, that name a file instead of giving its numbers."""
    for k, table in enumerate(tables if isinstance(tables, list) else (), start=1):
        own = table if isinstance(table, dict) and kind in (None, table.get("kind")) else {}
        if numbers not in own and isinstance(own.get("file"), str):
            yield k, own


def _path_in_folder(path: Path, where: str, name: str) -> Path:
    """The file of a name, which may not leave the folder of the mission, not by a link either.

    Raises
    ------
    MissionError
        It does.
    """
    folder = path.parent.resolve()
    try:
        file = (folder / name).resolve()
        if not Path(name).is_absolute() and file.is_relative_to(folder):
            return file
        problem = "leaves the folder of the mission"
    except (OSError, RuntimeError, ValueError):
        problem = "is no name of a file"
    remedy = f"put the file into {folder} or below, and give its relative path"
    raise MissionError([Finding(str(path), where, name, problem, remedy)])


def _read_points(data: bytes, name: str) -> _Content:
    from rigidfleet.formation.point_files import parse_points

    points = parse_points(data, name)
    return points.slots.tolist(), points.notes, *(points.colours or ())


def _read_trajectories(_: bytes, name: str, *, yaw: bool, said: dict[str, str]) -> _Content:
    """Pieces of each vehicle; with a ``yaw`` if that is asked for. What the file leaves in doubt is not flown.

    Where a file has samples, they are joined by the spline with the least jerk (C4): it is not only judged but flown.
    """
    from rigidfleet.foreign.columns import Doubt
    from rigidfleet.foreign.curves import ASSUMED, curve_to_rows, least_jerk_curve
    from rigidfleet.foreign.files import read_trajectories

    try:
        read = read_trajectories(name, units=said.get("units"), axes=said.get("axes"))
    except TrajectoryError as error:
        raise _file_error(name, "", error) from None
    for doubt in read.notes:
        if isinstance(doubt, Doubt):
            raise text_error(
                name, doubt, "say units or axes beside the file: units = 'ms', axes = 'ned'"
            )
    curves, notes = [*read.curves], [*read.notes]
    begin, end = max(c.time[0] for c in curves), min(c.time[-1] for c in curves)
    if read.assumed in ASSUMED.values():
        if any((c.time[[0, -1]] != (begin, end)).any() for c in curves):
            notes.append(f"only the time of which all have data is flown, {begin:g} to {end:g} s")
        curves = [least_jerk_curve(c.between(begin, end)) for c in curves]
    else:
        begin = min(c.time[0] for c in curves)
        curves = [c.with_knots(np.union1d(begin, c.time), stays=True) for c in curves]
    if yaw and any(np.isnan(curve.pieces[:, 3]).any() for curve in curves):
        why = next((note for note in read.notes if "yaw" in note), "has no yaw")
        raise text_error(name, why, "remove yaw = 'file', or give a file with a yaw and its unit")
    rows = [curve_to_rows(c._replace(pieces=np.nan_to_num(c.pieces))) for c in curves]
    return rows, notes


#: A height that no terrain has [m], and one by which files mark cells without data besides such heights.
_NOWHERE, _MARK = 9000.0, -999.0
#: The remedy for these.
FILL = "fill the cells, for example from their neighbours, or cut the map"


def missing_cells_text(heights: Any) -> str:
    """Where heights (I, J) [m] have cells without data, as elevation models mark them (NaN, -9999, -32768, ...)."""
    z = np.asarray(heights, dtype=float)
    cells = np.argwhere(~(np.abs(z) < _NOWHERE) | (z == _MARK))
    if not len(cells):
        return ""
    i, j = cells[0]
    return f"has {len(cells):,} cells without data, the first in row {i + 1}, column {j + 1}: {z[i, j]:g}"


def _read_heights(data: bytes, name: str) -> _Content:
    """Numbers of a CSV or NPY file, row by row."""
    try:
        if name.lower().endswith(".npy"):
            heights = np.load(io.BytesIO(data), allow_pickle=False)
        else:
            rows = list(csv.reader(data.decode("utf-8-sig").splitlines()))
            heights = np.array([row for row in rows if any(x.strip() for x in row)], dtype=float)
        heights = np.asarray(heights, dtype=float)
    except (ValueError, EOFError, OSError):
        remedy = "give rows of equal length, separated by commas, or an NPY array"
        raise text_error(name, "is not a table of numbers", remedy) from None
    if heights.ndim != 2 or not heights.size:
        raise text_error(name, "is not a table of numbers", "give two or more rows of heights [m]")
    places = len(heights), len(np.unique(heights[:, :2], axis=0))
    grid = np.prod([len(np.unique(x)) for x in heights.T[:2]])
    if heights.shape[1] == 3 and places == (grid, grid) and grid > 3:
        remedy = "give a row of heights for each x, and origin and spacing in the mission"
        raise text_error(name, "is a list of places x, y and z", remedy)
    if why := missing_cells_text(heights):
        raise text_error(name, why, FILL)
    return heights.tolist(), ()
