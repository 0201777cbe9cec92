"""Skybrush's shows, read: curves of all drones, from an archive that is not trusted.

Sources: the types of Skybrush's show format, and its player (`show-format` in skybrush-io/skybrush.js,
`src/trajectory.ts` and `src/yaw-control.ts`): times of a trajectory count from its ``takeoffTime``, those of yaw from
the start of the show; yaw is constant before its first and after its last setpoint. It is in degrees clockwise from the
show's x axis (`sbstudio/model/yaw.py` in skybrush-io/studio-blender, `drone-flock.ts` in skybrush-io/viewer).
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from rigidfleet.errors import TrajectoryError
from rigidfleet.foreign.curves import with_headings
from rigidfleet.math.piecewise import Piecewise

#: What is between the points of a show.
BEZIER = "the Bezier curves of the show"
#: Greatest size of an archive's content and of one entry [bytes], and greatest number of points between the ends of a
#: segment.
_BYTES, _ENTRY, _INNER = 512 << 20, 64 << 20, 6
#: Memory [bytes] of the objects of CPython for which a character of JSON may stand (a list, a dictionary, a key, a
#: number, half a text), and the greatest sum for an entry; the greatest number of coefficients of all curves.
_BECOMES, _MEMORY = {b"[": 88, b"{": 64, b":": 120, b",": 32, b'"': 33}, 320 << 20
_COEFFICIENTS = 1 << 25


def read_show(data: bytes, name: str) -> tuple[tuple[str, ...], tuple[Piecewise, ...]]:
    """Names and curves of the drones of a show, in the show's time and axes.

    Raises
    ------
    TrajectoryError
        The archive is damaged, too large or refers to files outside of it, or an entry is missing or not a number.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            if size > _BYTES:
                raise TrajectoryError(
                    f"{name}: unpacks to {size >> 20:,} MiB, more than {_BYTES >> 20}. It is not a show."
                )
            return _curves_of_drones(archive, name)
    except RecursionError:
        raise TrajectoryError(
            f"{name}: show.json is nested too deeply. Export the show again."
        ) from None
    except (zipfile.BadZipFile, EOFError, RuntimeError, NotImplementedError, OSError) as error:
        raise TrajectoryError(
            f"{name}: is not a complete zip archive ({error}). Export the show again."
        ) from None


def _curves_of_drones(
    archive: zipfile.ZipFile, name: str
) -> tuple[tuple[str, ...], tuple[Piecewise, ...]]:
    show = _read_json(archive, "show.json", name)
    drones = _value_at(show, "swarm.drones", list, f"{name}: show.json")
    if not drones:
        raise TrajectoryError(f"{name}: show.json: has no drones.")
    names: list[str] = []
    curves: list[Piecewise] = []
    room = _COEFFICIENTS
    for k, drone in enumerate(drones, 1):
        where = f"{name}: show.json: drone {k}"
        settings = _value_at(drone, "settings", dict, where)
        who = settings.get("name")
        names.append(
            who if isinstance(who, str) and who.strip() and who.isprintable() else f"drone {k}"
        )
        trajectory = _dereference(archive, settings.get("trajectory"), name, f"{where}: trajectory")
        yaw = settings.get("yawControl")
        turned = None if yaw is None else _dereference(archive, yaw, name, f"{where}: yawControl")
        curves.append(_curve(trajectory, turned, f"{name}: {names[-1]}"))
        room -= curves[-1].pieces.size
        if room < 0:
            raise TrajectoryError(f"{where}: is too much beside those before. Give fewer points.")
    if len(set(names)) < len(names):
        names = [f"{who} ({k})" for k, who in enumerate(names, 1)]
    return tuple(names), tuple(curves)


def _read_json(archive: zipfile.ZipFile, entry: str, name: str) -> Any:
    try:
        size = archive.getinfo(entry).file_size
        data = archive.read(entry) if size <= _ENTRY else b""
        if size > _ENTRY or sum(data.count(x) * each for x, each in _BECOMES.items()) > _MEMORY:
            raise TrajectoryError(
                f"{name}: {entry}: has {size >> 20:,} MiB, more than a show needs. Give each drone an entry of its own."
            )
        return json.loads(data, parse_constant=_refuse_constant)
    except KeyError:
        raise TrajectoryError(f"{name}: has no {entry}. Is it a show of Skybrush?") from None
    except (ValueError, zlib.error) as error:
        raise TrajectoryError(
            f"{name}: {entry}: is damaged ({error}). Export the show again."
        ) from None


def _refuse_constant(constant: str) -> float:
    raise ValueError(f"has {constant}, not a finite number")


def _value_at(value: Any, path: str, kind: type, where: str) -> Any:
    for key in path.split("."):
        value = value.get(key) if isinstance(value, dict) else None
    if not isinstance(value, kind):
        word = "list" if kind is list else "object"
        raise TrajectoryError(f"{where}: has no {word} {path!r}. Export the show again.")
    return value


def _dereference(archive: zipfile.ZipFile, value: Any, name: str, where: str) -> dict[str, Any]:
    """An object of a show, or the one in the entry that it refers to."""
    if not isinstance(value, dict):
        raise TrajectoryError(f"{where}: is missing. Export the show again.")
    reference = value.get("$ref")
    if reference is None:
        return value
    entry = str(reference).removeprefix("./").removesuffix("#")
    if entry.startswith(("/", "\\")) or ".." in entry.replace("\\", "/").split("/") or ":" in entry:
        raise TrajectoryError(
            f"{where}: refers to {entry[:80]!r}, outside of the show, which is not read."
        )
    entered = _read_json(archive, entry, name)
    if not isinstance(entered, dict):
        raise TrajectoryError(f"{name}: {entry}: is no object. Export the show again.")
    return entered


def _curve(trajectory: dict[str, Any], yaw: dict[str, Any] | None, where: str) -> Piecewise:
    points = _value_at(trajectory, "points", list, where)
    if not points:
        raise TrajectoryError(f"{where}: its trajectory has no points.")

    def place_of(k: int) -> str:
        return f"{where}: point {k + 1}"

    start = _floats(trajectory.get("takeoffTime", 0), (), lambda: f"{where}: takeoffTime")
    for k, point in enumerate(points):
        if not isinstance(point, list) or len(point) < 2:
            raise TrajectoryError(f"{place_of(k)}: is not [time, [x, y, z], [control points]].")
    time = np.array([_floats(p[0], (), lambda k=k: place_of(k)) for k, p in enumerate(points)])
    ends = [_floats(p[1], (3,), lambda k=k: place_of(k)) for k, p in enumerate(points)]
    if len(points) == 1:
        points, time, ends = [*points, [0, ends[0], []]], np.append(time, time + 1.0), ends * 2
    late = np.flatnonzero(~(np.diff(time) > 0.0))
    if len(late):
        k = int(late[0])
        raise TrajectoryError(
            f"{place_of(k + 1)}: its time {time[k + 1]:g} s is not after {time[k]:g} s. Give increasing times."
        )
    inner = [p[2] if len(p) > 2 and p[2] is not None else [] for p in points[1:]]
    powers = 2 + max((len(c) if isinstance(c, list) else 0 for c in inner), default=0)
    if powers > _INNER + 2:
        raise TrajectoryError(
            f"{where}: has {powers - 2} control points in a segment, more than {_INNER}."
        )
    pieces = np.zeros((len(inner), 4, max(powers, 2)))
    for k, ((begin, end), between) in enumerate(zip(pairwise(ends), inner, strict=True)):
        middle = _floats(between or np.zeros((0, 3)), (None, 3), lambda k=k: place_of(k + 1))
        control = np.vstack([begin, middle, end])
        piece = Piecewise.of_bernstein(time[k : k + 2], control.T[None])
        pieces[k, :3, : len(control)] = piece.pieces[0]
    curve = Piecewise(time + start, pieces)
    # With automatic yaw, the vehicle turns by itself; no player of Skybrush says how.
    if yaw is None or yaw.get("autoYaw"):
        pieces[:, 3] = np.nan
        return curve
    setpoints = _floats(
        _value_at(yaw, "setpoints", list, where), (None, 2), lambda: f"{where}: yaw setpoints"
    )
    if (np.diff(setpoints[:, 0]) < 0.0).any():
        raise TrajectoryError(f"{where}: yaw setpoints: times go back. Give increasing times.")
    if not len(setpoints):
        pieces[:, 3] = np.nan
        return curve
    return with_headings(curve, setpoints[:, 0], -np.radians(setpoints[:, 1]))


def _floats(value: Any, shape: tuple[int | None, ...], where: Callable[[], str]) -> Any:
    """Finite numbers of a shape, in which None is any length."""
    try:
        numbers = np.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        numbers = np.array(np.nan)
    fits = numbers.ndim == len(shape) and all(
        n in (None, m) for n, m in zip(shape, numbers.shape, strict=True)
    )
    if not fits or not np.isfinite(numbers).all() or isinstance(value, str | bool):
        words = "numbers" if shape else "a number"
        raise TrajectoryError(f"{where()}: has {str(value)[:60]!r} where {words} must be.")
    return numbers if shape else float(numbers)
