"""What a formation on its way may be and how it may lie: the layers of the search, and the changes between them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from rigidfleet.formation.assignment import closest_approach
from rigidfleet.math import attitude as att
from rigidfleet.math import proximity
from rigidfleet.mission import Mission, Obstacle
from rigidfleet.mission.changes import scaled_formation_name
from rigidfleet.mission.kinds import Go
from rigidfleet.planning.lattice import Change, Path
from rigidfleet.planning.reference import shift_and_rotvec
from rigidfleet.typing import Floats

#: Roll, pitch and yaw [deg].
Angles = tuple[float, float, float]

#: Number of agents up to which all pairs give directions in which a shape may be narrowest; angles tried beyond.
_PAIRS, _DIRECTIONS = 24, 72
#: Greatest turn in one change [rad]: beyond, its sense is not certain.
_HALF = 3.0
#: Greatest number of frames.
_FRAMES = 4
#: Excess over a limit that is ignored [m].
_SLACK = 1e-9


class CandidateShape(NamedTuple):
    """A formation that may be taken: its name, slots (N, 3) [m] about the centre of mass, and stage of the search."""

    name: str
    slots: Floats
    stage: int


def candidate_shapes(mission: Mission, phase: Go, own: str) -> Iterator[CandidateShape]:
    """The formation as it is, others, and smaller ones; others only if their agents keep the limits of separation."""
    limits, radius = mission.limits, mission.fleet.radius
    names = tuple(mission.formations) if phase.formations is None else phase.formations
    shrunk = {scaled_formation_name(n, x) for n in mission.formations for x in phase.scales}
    others = [n for n in names if n != own and n not in shrunk]
    stages = [(own, 0), *((n, 1) for n in others)]
    for scale in sorted(phase.scales, reverse=True):
        stages += [(scaled_formation_name(n, scale), 2) for n in (own, *others)]
    for name, stage in stages:
        slots = mission.slots_about_cm(name) if name in mission.formations else None
        if slots is None:
            continue
        apart = float(proximity.separation(slots[None], radius)[0][0])
        below = float(proximity.headroom(slots[None], radius)[0][0])
        kept = apart > 0.0 and apart >= (limits.separation or 0.0) - _SLACK
        if stage == 0 or (kept and below >= (limits.separation_below or 0.0) - _SLACK):
            yield CandidateShape(name, slots, stage)


def lattice_frames(obstacles: Sequence[Obstacle]) -> list[Floats]:
    """Axes (3, 3) of the lattices: the world's, and those of boxes that are turned about the vertical."""
    rotations = [np.eye(3)]
    for thing in obstacles:
        turn = thing.solid.turn[0]
        if not thing.solid.turned[0] or abs(abs(turn[2, 2]) - 1.0) > 1e-9:
            continue
        angle = math.atan2(turn[0, 1], turn[0, 0]) % (math.pi / 2)
        frame = att.dcm_from_euler(np.array([0.0, 0.0, angle]))
        if all(np.abs(frame - f).max() > 1e-6 for f in rotations) and len(rotations) < _FRAMES:
            rotations.append(frame)
    return rotations


def narrow_yaws(slots: Floats, start: Angles, axes: list[Floats]) -> set[float]:
    """Yaws [deg] at the start's roll and pitch in which slots are narrowest along an axis of one of the frames.

    Seen from above, a set of points is narrowest across the line through two of them.
    """
    roll, pitch, yaw_before = start
    p = (slots @ att.dcm_from_euler(np.deg2rad([roll, pitch, 0.0])))[:, :2]
    if len(p) > _PAIRS:
        angles = np.linspace(0.0, np.pi, _DIRECTIONS, endpoint=False)
    else:
        d = (p[:, None] - p).reshape(-1, 2)
        d = d[np.linalg.norm(d, axis=1) > 1e-6]
        angles = np.unique(np.round(np.arctan2(d[:, 1], d[:, 0]) % np.pi, 6))
    if not len(angles):
        return set()
    across = np.stack([-np.sin(angles), np.cos(angles)])
    best = float(angles[int(np.ptp(p @ across, axis=0).round(6).argmin())])
    yaws = set()
    for frame in axes:
        lies = math.degrees(math.atan2(frame[0, 1], frame[0, 0]) - best)
        # Of the two that are the same but for half a turn, the nearer one.
        for yaw in (lies, lies + 90.0):
            yaws.add(round(yaw_before + (yaw - yaw_before + 90.0) % 180.0 - 90.0, 4))
    return yaws


def changes_between_layers(
    mission: Mission, shapes: Sequence[CandidateShape], angles: Sequence[Angles]
) -> Iterator[Change]:
    """Turns and changes of shape, each between two layers; layers are all angles of the first shape, and so on."""
    count = len(angles)
    for s, shape in enumerate(shapes):
        for (i, a), (j, b) in combinations(enumerate(angles), 2):
            if angle_between_attitudes(a, b) < _HALF:
                yield Change(s * count + i, s * count + j, *_turn_path_and_ways(shape.slots, a, b))
    for (s, one), (t, two) in combinations(enumerate(shapes), 2):
        for i, a in enumerate(angles):
            if (folding := _shape_change_path_and_ways(mission, one, two, a)) is not None:
                yield Change(s * count + i, t * count + i, *folding)


def _turn_path_and_ways(slots: Floats, before: Angles, after: Angles) -> tuple[Path, Floats]:
    """Offsets of slots that turn on the spot from one attitude to another, and their ways (N,) [m]."""
    A, B = (att.dcm_from_euler(np.deg2rad(x)) for x in (before, after))
    phi = att.rotation_vector_from_dcm(A @ B.T)
    return (
        lambda share: slots @ att.dcm_from_rotation_vector((1.0 - share)[:, None] * phi) @ B,
        np.linalg.norm(phi) * np.linalg.norm(slots, axis=1),
    )


def _shape_change_path_and_ways(
    mission: Mission, one: CandidateShape, two: CandidateShape, angles: Angles
) -> tuple[Path, Floats] | None:
    """Offsets and ways of a change of shape, as references blend it; None if agents come too near each other."""
    p, q = one.slots, two.slots
    dp, turn = shift_and_rotvec(p, q, mission.fleet.mass, mission.assigned_turn(one.name, two.name))
    least = closest_approach(p, p + dp, mission.fleet.radius)[0]
    if least <= 0.0 or least < (mission.limits.separation or 0.0) - _SLACK:
        return None
    T = att.dcm_from_euler(np.deg2rad(angles))

    def path(share: Floats) -> Floats:
        turned = att.dcm_from_rotation_vector(share[:, None] * turn)
        return (p + share[:, None, None] * dp) @ turned @ T

    lever = np.maximum(np.linalg.norm(p, axis=1), np.linalg.norm(q, axis=1))
    return path, np.linalg.norm(dp, axis=1) + float(np.linalg.norm(turn)) * lever


def angle_between_attitudes(a: Angles, b: Angles) -> float:
    """Angle [rad] between two attitudes."""
    A, B = (att.dcm_from_euler(np.deg2rad(x)) for x in (a, b))
    return float(np.linalg.norm(att.rotation_vector_from_dcm(A @ B.T)))
