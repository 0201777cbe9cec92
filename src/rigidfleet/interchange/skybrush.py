"""Skybrush show files (.skyc): a zip archive of JSON with cubic Bezier curves.

Source: the types of Skybrush's show format (`ShowSpecification`, `Trajectory`, `YawControl`), and, for the location,
`ShowLocation` of Skybrush Studio: [latitude, longitude] in 1e-7 deg, altitude in mm, and the direction of the show's
x axis from north to east [deg], here east. Yaw is in degrees clockwise from the show's x axis, and begins within a turn
from zero (`sbstudio/model/yaw.py` of Skybrush Studio).
"""

from __future__ import annotations

import base64
import io
import json
import zipfile
from collections.abc import Iterator
from typing import Any

import numpy as np

from rigidfleet.errors import ResultError
from rigidfleet.foreign.shows import read_show
from rigidfleet.interchange.curves import ExportedMotion, cubic_curves, yaw_knots
from rigidfleet.interchange.lights import light_program
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.result.lights import light_fades

#: Greatest number of vehicles of a show.
_MOST = 5000
#: Direction of the mission's x axis, east, from north [deg].
_EAST = 90.0
#: A constant date of the archive's entries, the earliest that zip has: the same show gives the same bytes.
_DATE = (1980, 1, 1, 0, 0, 0)


def write_skyc(motion: ExportedMotion, tolerance: float) -> Iterator[bytes]:
    """One show: for each drone its home, a way of cubic curves, its yaw and its light.

    Raises
    ------
    ResultError
        There are more than `_MOST` vehicles.
    """
    if motion.n_agents > _MOST:
        raise ResultError(f"a show has at most {_MOST} drones, and this flight {motion.n_agents}.")
    mission = motion.result.mission
    changes = light_fades(motion.result)
    drones, files = [], {}
    for agent, curve in enumerate(cubic_curves(motion, tolerance)):
        name = f"agent {agent + 1}"
        folder = f"drones/{name.replace(' ', '-')}"
        points = _bezier_segments(curve)
        off = round(float(motion.result.motors_off[agent]) - motion.start, 6)
        span = {"takeoffTime": 0, "landingTime": min(off, points[-1][0])}
        times, yaws = yaw_knots(curve)
        clockwise = -np.degrees(yaws)
        clockwise -= 360.0 * np.floor(clockwise[0] / 360.0)
        setpoints = np.column_stack([times.round(6), clockwise.round(4)]).tolist()
        program = bytes(light_program(changes, agent, motion.start, motion.end))
        settings = {"name": name, "home": points[0][1], "landAt": points[-1][1]}
        for key, file, content in (
            ("trajectory", "trajectory", {"points": points, **span}),
            ("yawControl", "yaw", {"setpoints": setpoints}),
            ("lights", "lights", {"data": base64.b64encode(program).decode()}),
        ):
            files[f"{folder}/{file}.json"] = {"version": 1, **content}
            settings[key] = {"$ref": f"./{folder}/{file}.json#"}
        drones.append({"type": "generic", "settings": settings})
    cues = [
        {"name": phase.name, "time": round(phase.t_start - motion.start, 6)}
        for phase in motion.result.phases
        if motion.start <= phase.t_start < motion.end
    ]
    environment: dict[str, Any] = {"type": "outdoor"}
    if (origin := mission.geodetic_origin) is not None:
        place = [round(1e7 * origin.latitude_deg), round(1e7 * origin.longitude_deg)]
        place.append(round(1e3 * origin.altitude))
        environment["location"] = {"origin": place, "orientation": _EAST}
    show = {
        "version": 1,
        "environment": environment,
        "meta": {"title": mission.title or mission.name},
        "settings": {"cues": {"version": 1, "items": cues}},
        "swarm": {"drones": drones},
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for path, content in {"show.json": show, **files}.items():
            entry = zipfile.ZipInfo(path, _DATE)
            archive.writestr(entry, json.dumps(content), zipfile.ZIP_DEFLATED)
    yield buffer.getvalue()


def read_skyc(data: bytes) -> list[Piecewise]:
    """The ways in a show, from its time zero on. Yaw is on lines between its setpoints."""
    return list(read_show(data).curves)


def _bezier_segments(curve: Piecewise) -> list[list[Any]]:
    """Time, end point and inner control points of each cubic piece, and of the start; numbers to a micrometre."""
    points = np.round(Piecewise(curve.time, curve.pieces[:, :3]).control_points(), 6)
    times = np.round(curve.time, 6)
    segments: list[list[Any]] = [[times[0], points[0, :, 0].tolist(), []]]
    for t, piece in zip(times[1:].tolist(), points, strict=True):
        start, *inner, end = piece.T.tolist()
        segments.append([t, end, [] if start == end == inner[0] == inner[1] else inner])
    return segments
