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
from contextlib import suppress
from typing import Any

import numpy as np

from rigidfleet._common.tables import ContentError, fault
from rigidfleet.foreign.curves import Trajectories, with_headings
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.typing import Floats

#: What is between the points of a show.
BEZIER = "the Bezier curves of the show"
#: Greatest size of an archive's content and of one entry [bytes], and greatest number of points between the ends of a
#: segment.
_BYTES, _ENTRY, _INNER = 512 << 20, 64 << 20, 6
#: Memory [bytes] of the objects of CPython for which a character of JSON may stand (a list, a dictionary, a key, a
#: number, half a text), and the greatest sum for an entry; the greatest number of coefficients of all curves.
_BECOMES, _MEMORY = {b"[": 88, b"{": 64, b":": 120, b",": 32, b'"': 33}, 320 << 20
_COEFFICIENTS = 1 << 25
_AGAIN = "Export the show again"


class _Archive(zipfile.ZipFile):
    """The archive of a show, of whose entries `room` bytes are read, however often drones refer to them."""

    room = _BYTES


def read_show(data: bytes) -> Trajectories:
    """The drones of a show, in the show's time and axes.

    Raises
    ------
    ContentError
        The archive is damaged, too large or refers to files outside of it, or an entry is missing or not a number.
    """
    try:
        with _Archive(io.BytesIO(data)) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            if size > _BYTES:
                more = f"unpacks to {size >> 20:,} MiB, more than {_BYTES >> 20}"
                raise fault(more, "It is not a show")
            return _read_drones(archive)
    except RecursionError:
        raise fault("show.json is nested too deeply", _AGAIN) from None
    except (zipfile.BadZipFile, EOFError, RuntimeError, NotImplementedError, OSError) as error:
        raise fault(f"is not a complete zip archive ({error})", _AGAIN) from None


def _read_drones(archive: _Archive) -> Trajectories:
    """Name and curve of each drone of a show; drones that share a trajectory share its curve.

    Raises
    ------
    ContentError
        Something is missing or has another type, or all curves together are too large.
    """
    show = _read_json(archive, "show.json")
    drones = _value_at(show, "swarm.drones", list, "show.json")
    if not drones:
        raise fault("show.json: has no drones")
    names: list[str] = []
    curves: list[Piecewise] = []
    known: dict[str, Piecewise] = {}
    room = _COEFFICIENTS
    for k, drone in enumerate(drones, 1):
        where = f"show.json: drone {k}"
        settings = _value_at(drone, "settings", dict, where)
        who = settings.get("name")
        is_name = isinstance(who, str) and who.strip() and who.isprintable()
        names.append(who if is_name else f"drone {k}")
        trajectory, yaw = settings.get("trajectory"), settings.get("yawControl")
        shared = isinstance(trajectory, dict) and "$ref" in trajectory
        key = repr((trajectory, yaw)) if shared else str(k)
        if key not in known:
            way = _dereference(archive, trajectory, f"{where}: trajectory")
            turned = None if yaw is None else _dereference(archive, yaw, f"{where}: yawControl")
            known[key] = _curve_of_drone(way, turned, names[-1])
        curves.append(known[key])
        room -= curves[-1].pieces.size
        if room < 0:
            raise fault(f"{where}: is too much beside those before", "Give fewer points")
    if len(set(names)) < len(names):
        names = [f"{who} ({k})" for k, who in enumerate(names, 1)]
    return Trajectories(tuple(names), tuple(curves), BEZIER)


def _read_json(archive: _Archive, entry: str) -> Any:
    try:
        size = archive.getinfo(entry).file_size
    except KeyError:
        raise fault(f"has no {entry}", "Is it a show of Skybrush? Save tables as CSV") from None
    archive.room -= size
    if archive.room < 0:
        raise fault(f"{entry}: drones refer to it too often", "Give each an entry of its own")
    try:
        data = archive.read(entry) if size <= _ENTRY else b""
        memory = sum(data.count(x) * each for x, each in _BECOMES.items())
        if size <= _ENTRY and memory <= _MEMORY:
            return json.loads(data, parse_constant=_refuse_json_constant)
    except (ValueError, zlib.error) as error:
        raise fault(f"{entry}: is damaged ({error})", _AGAIN) from None
    more = f"{entry}: has {size >> 20:,} MiB, more than a show needs"
    raise fault(more, "Give each drone an entry of its own")


def _refuse_json_constant(constant: str) -> float:
    raise ValueError(f"has {constant}, not a finite number")


def _value_at(value: Any, path: str, kind: type, where: str) -> Any:
    for key in path.split("."):
        value = value.get(key) if isinstance(value, dict) else None
    if not isinstance(value, kind):
        word = "list" if kind is list else "object"
        raise fault(f"{where}: has no {word} {path!r}", _AGAIN)
    return value


def _dereference(archive: _Archive, value: Any, where: str) -> dict[str, Any]:
    """An object of a show, or the one in the entry that it refers to."""
    if not isinstance(value, dict):
        raise fault(f"{where}: is missing", _AGAIN)
    reference = value.get("$ref")
    if reference is None:
        return value
    entry = str(reference).removeprefix("./").removesuffix("#")
    if entry.startswith(("/", "\\")) or ".." in entry.replace("\\", "/").split("/") or ":" in entry:
        outside = f"{entry[:80]!r}, outside of the show, which is not read"
        raise fault(f"{where}: refers to {outside}")
    entered = _read_json(archive, entry)
    if not isinstance(entered, dict):
        raise fault(f"{entry}: is no object", _AGAIN)
    return entered


def _curve_of_drone(trajectory: dict[str, Any], yaw: dict[str, Any] | None, who: str) -> Piecewise:
    """The curve of one drone, (K, 4, P) [m, rad] over the show's time [s]: Bezier segments as powers, nan for no yaw.

    Raises
    ------
    ContentError
        A point is no point, times do not increase, or a segment has too many control points.
    """
    points = _value_at(trajectory, "points", list, who)
    if not points:
        raise fault(f"{who}: its trajectory has no points")
    start = _to_floats(trajectory.get("takeoffTime", 0), (), f"{who}: takeoffTime")
    where = [f"{who}: point {k}" for k in range(1, len(points) + 1)]
    for place, point in zip(where, points, strict=True):
        if not isinstance(point, list) or len(point) < 2:
            raise fault(f"{place}: is not [time, [x, y, z], [control points]]")
    time = _parse_float_rows([p[0] for p in points], (), where)
    ends = _parse_float_rows([p[1] for p in points], (3,), where)
    if len(points) == 1:
        points, time = [*points, [0, ends[0], []]], np.append(time, time + 1.0)
        ends, where = np.repeat(ends, 2, axis=0), where * 2
    late = np.flatnonzero(~(np.diff(time) > 0.0))
    if len(late):
        k = int(late[0])
        why = f"{where[k + 1]}: its time {time[k + 1]:g} s is not after {time[k]:g} s"
        raise fault(why, "Give increasing times")
    inner = [p[2] if len(p) > 2 and p[2] else [] for p in points[1:]]
    counts = np.array([len(c) if isinstance(c, list) else 1 for c in inner])
    if (most := counts.max()) > _INNER:
        raise fault(f"{who}: has {most} control points in a segment, more than {_INNER}")
    pieces = np.zeros((len(inner), 4, most + 2))
    for count in np.unique(counts):
        k = np.flatnonzero(counts == count)
        middle = [inner[i] or np.zeros((0, 3)) for i in k]
        middle = _parse_float_rows(middle, (count, 3), [where[i + 1] for i in k])
        control = np.concatenate([ends[k, None], middle, ends[k + 1, None]], axis=1)
        unit = Piecewise.of_bernstein(np.arange(len(k) + 1.0), control.swapaxes(1, 2))
        h = np.diff(time)[k, None, None]
        pieces[k, :3, : count + 2] = unit.pieces / h ** np.arange(count + 2)
    curve = Piecewise(time + start, pieces)
    # With automatic yaw, the vehicle turns by itself; no player of Skybrush says how.
    if yaw is None or yaw.get("autoYaw"):
        pieces[:, 3] = np.nan
        return curve
    setpoints = _value_at(yaw, "setpoints", list, who)
    times, degrees = _to_floats(setpoints, (None, 2), f"{who}: yaw setpoints").T
    if (np.diff(times) < 0.0).any():
        raise fault(f"{who}: yaw setpoints: times go back", "Give increasing times")
    return with_headings(curve, times, -np.radians(degrees))


def _parse_float_rows(values: list[Any], shape: tuple[int, ...], where: list[str]) -> Floats:
    """Finite numbers (K, ...) of values of one shape, read at once; one by one where one of them is wrong."""
    if not any(isinstance(value, str | bool) for value in values):
        with suppress(ContentError):
            return _to_floats(values, (None, *shape), "")
    return np.array([_to_floats(value, shape, w) for value, w in zip(values, where, strict=True)])


def _to_floats(value: Any, shape: tuple[int | None, ...], where: str) -> Any:
    """Finite numbers of a shape, in which None is any length."""
    try:
        numbers = np.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        numbers = np.array(np.nan)
    fits = [n in (None, m) for n, m in zip(shape, numbers.shape, strict=False)]
    right = numbers.ndim == len(shape) and all(fits) and np.isfinite(numbers).all()
    if not right or isinstance(value, str | bool):
        words = "numbers" if shape else "a number"
        raise fault(f"{where}: has {str(value)[:60]!r} where {words} must be")
    return numbers if shape else float(numbers)
