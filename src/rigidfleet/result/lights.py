"""Lights of a flight: which colour each vehicle shows when, and from where the formations that they draw are read."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rigidfleet.math.attitude import dcm_from_quaternion
from rigidfleet.result.result import Result
from rigidfleet.typing import Floats

#: Light of vehicles before the first formation that has a colour.
_FIRST = "#ffffff"
#: Where spectators stand: towards -y, from which letters are read; east of it, where a formation leaves the choice.
_FRONT = (1e-3, -1.0, 0.0)
#: Thickness of a flat formation, as a share of its width, and elevation from which an upright one is seen [rad].
_FLAT, _LOW = 0.25, 0.1


class Fade(NamedTuple):
    """A change of light: its begin and end [s], and the colour "#rrggbb" of each vehicle from then on."""

    begin: float
    end: float
    colours: tuple[str, ...]


def light_fades(result: Result) -> list[Fade]:
    """Changes of light: vehicles fade to the colours of a formation as they take it.

    The first is the light at the start, at once. A formation without a colour keeps the light before.
    """
    mission = result.mission
    planned = {p.name: p for p in mission.phases}
    start = float(result.time[0])
    changes = [Fade(start, start, (_FIRST,) * result.n_agents)]
    before: str | None = None
    for phase in result.phases:
        taken, before = phase.formation != before, phase.formation
        if before is None or not taken or (colours := mission.formation_colours(before)) is None:
            continue
        known = planned.get(phase.name)
        shaping = known.shaping if known is not None else None
        length = phase.t_end - phase.t_start
        if shaping is not None:
            length = min(length, shaping.least_time)
        begin = max(phase.t_start, changes[-1].end)
        changes.append(Fade(begin, max(begin, phase.t_start + length), colours))
    return changes


def has_lights(result: Result) -> bool:
    """Whether a formation that was flown has colours."""
    return len(light_fades(result)) > 1


def light_colours(result: Result, time: Floats) -> Floats:
    """Red, green and blue (K, N, 3), from 0 to 1, of each vehicle's light at times (K,) [s]."""
    changes = light_fades(result)
    shown = np.array([rgb(change.colours) for change in changes])
    begin, end = np.array([change[:2] for change in changes]).T
    k = np.clip(np.searchsorted(begin, time, side="right") - 1, 0, None)
    share = np.clip((time - begin[k]) / np.maximum(end - begin, 1e-9)[k], 0.0, 1.0)
    before = shown[np.maximum(k - 1, 0)]
    return before + share[:, None, None] * (shown[k] - before)


def rgb(colours: tuple[str, ...]) -> Floats:
    """Red, green and blue (N, 3), from 0 to 1, of colours "#rrggbb"."""
    return np.array([[*bytes.fromhex(colour[1:])] for colour in colours]) / 255.0


def angles_facing_formation(result: Result) -> tuple[float, float]:
    """Azimuth and elevation [rad] of a viewer, from the flight, who reads the flattest of the lit formations."""
    best, seen = np.inf, view_angles(np.zeros((1, 3)))
    for phase in range(len(result.phases)):
        formation, k = result.phases[phase].formation, result.samples(phase).stop - 1
        colours = None if formation is None else result.mission.formation_colours(formation)
        if colours is None:
            continue
        points = result.position[k][rgb(colours).any(axis=1)]
        if not (len(points) and np.isfinite(points).all()):
            continue
        _, wide, thick = _principal_extents_and_axes(points)[0]
        if (thin := thick / max(wide, 1e-9)) < best:
            q = result.attitude[k]
            turn = dcm_from_quaternion(q).T if np.isfinite(q).all() else np.eye(3)
            best, seen = thin, view_angles(points, turn @ _FRONT)
    return seen


def view_angles(points: Floats, front: Floats | tuple[float, ...] = _FRONT) -> tuple[float, float]:
    """Azimuth and elevation [rad] of a viewer who faces the plane of points (n, 3) [m], on the side of ``front`` (3,).

    Of the planes through a line it is the one that faces the front most, without any plane the front itself. A plane
    that lies flat is seen from above, y upwards.
    """
    ahead = np.asarray(front, dtype=float)
    extents, axes = _principal_extents_and_axes(points)
    normal = axes[2]
    if extents[1] <= 1e-3 * extents[0]:
        normal = ahead - ahead @ axes[0] * axes[0]
    elif extents[2] > _FLAT * extents[1]:
        normal = ahead
    if abs(normal[2]) > 0.7 * np.linalg.norm(normal):
        return -np.pi / 2, np.pi / 2
    x, y, _ = normal * np.copysign(1.0, normal @ ahead)
    return float(np.arctan2(y, x)), _LOW


def camera_axes(azimuth: float, elevation: float) -> Floats:
    """Unit vectors right, up and towards the viewer (rows) of a camera at these angles [rad]."""
    (cos, level), (sin, up) = (f([azimuth, elevation]) for f in (np.cos, np.sin))
    out, right = np.array([cos * level, sin * level, up]), np.array([-sin, cos, 0.0])
    return np.array([right, np.cross(out, right), out])


def _principal_extents_and_axes(points: Floats) -> tuple[Floats, Floats]:
    """Extents (3,) of points (n, 3) along their principal directions, the greatest first, and these (3, 3) as rows."""
    about = np.concatenate([points - points.mean(axis=0), np.zeros((3, 3))])
    return np.linalg.svd(about, full_matrices=False)[1:]
