"""Surfaces of solids, to draw them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rigidfleet.solids import records
from rigidfleet.solids.distance import solid_displacement
from rigidfleet.solids.records import CYLINDER, HEIGHTS, HULL, Solids, triangles_of_squares
from rigidfleet.typing import Floats

#: Number of sides of a circle.
_SIDES = 32
#: Cosine of the least angle between two faces whose common edge is drawn.
_FLAT = 0.9998


class Outline(NamedTuple):
    """The surface of a solid as triangles, and the lines that show its shape."""

    triangles: Floats  # (T, 3, 3) [m], corners anticlockwise from outside
    lines: Floats  # (L, 2, 3) [m]


def outline_of_solid(solid: Solids) -> Outline:
    """The surface of a finite solid, alone in its record, without its motion; world axes."""
    size, kind = solid.size[0], solid.kind[0]
    if kind == HEIGHTS:
        own = _height_map_outline(solid)
    elif kind == HULL:
        own = Outline(solid.triangles, _creases(solid.triangles))
    elif kind == CYLINDER:
        own = _revolve(
            np.array([[0, -size[1]], [size[0], -size[1]], [size[0], size[1]], [0, size[1]]])
        )
    elif solid.rounding[0] > 0.0:
        angle = np.linspace(-np.pi / 2, np.pi / 2, _SIDES // 2 + 1)
        own = _revolve(solid.rounding[0] * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    else:
        own = _box_outline(size)
    T, o = solid.turn[0], solid.origin[0]
    return Outline(own.triangles @ T + o, own.lines @ T + o)


def displacements_at(solid: Solids, times: Floats) -> Floats:
    """Displacements (K, 3) [m] of a solid, alone in its record, at times (K,) [s]."""
    return np.stack(solid_displacement(times, 0, solid), axis=-1)


def _box_outline(size: Floats) -> Outline:
    corner = records.box_corners(size[:3], size[3:])
    faces = [(1, 5, 7, 3), (0, 2, 6, 4), (0, 4, 5, 1), (2, 3, 7, 6), (4, 6, 7, 5), (0, 1, 3, 2)]
    triangles = triangles_of_squares(*corner[np.transpose(faces)])
    edges = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]
    return Outline(triangles, corner[edges])


def _revolve(profile: Floats) -> Outline:
    """Surface of revolution about z of a profile (P, 2) of radii and heights, from below to above."""
    angle = np.linspace(0.0, 2 * np.pi, _SIDES + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = np.empty((len(profile), _SIDES + 1, 3))
    rings[..., :2], rings[..., 2] = profile[:, None, :1] * circle, profile[:, 1:]
    triangles = triangles_of_squares(rings[:-1, :-1], rings[:-1, 1:], rings[1:, 1:], rings[1:, :-1])
    size = np.linalg.norm(records.double_area_normals(triangles), axis=1)
    triangles = triangles[size > 1e-12 * max(float(size.max()), 1e-300)]
    if len(profile) == 4:  # a cylinder: its rims, and a few lines along it
        kept = rings[1:3]
        lines = np.stack([kept[:, :-1], kept[:, 1:]], axis=2).reshape(-1, 2, 3)
        along = np.stack([kept[0, :: _SIDES // 4][:4], kept[1, :: _SIDES // 4][:4]], axis=1)
        return Outline(triangles, np.concatenate([lines, along]))
    middle = rings[len(profile) // 2]  # a sphere: three great circles
    circles = [middle, middle[:, [0, 2, 1]], middle[:, [2, 0, 1]]]
    return Outline(triangles, np.concatenate([np.stack([x[:-1], x[1:]], axis=1) for x in circles]))


def _creases(triangles: Floats) -> Floats:
    """Edges (L, 2, 3) between faces that do not lie in one plane."""
    normal = records.double_area_normals(triangles)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    sides: dict[tuple[tuple[float, ...], ...], list[int]] = {}
    for t, points in enumerate(triangles.tolist()):
        for a, b in ((0, 1), (1, 2), (2, 0)):
            sides.setdefault(tuple(sorted((tuple(points[a]), tuple(points[b])))), []).append(t)
    kept = [e for e, t in sides.items() if len(t) != 2 or normal[t[0]] @ normal[t[1]] < _FLAT]
    return np.array(kept).reshape(-1, 2, 3)


def _height_map_outline(solid: Solids) -> Outline:
    """A height map's surface, its sides down to the lowest height, and some of the lines of its grid."""
    z, size = solid.heights.reshape(solid.grid[0]), solid.size[0]
    x, y = (np.linspace(0.0, size[3 + k], n) for k, n in enumerate(z.shape))
    top = np.stack([*np.meshgrid(x, y, indexing="ij"), z], axis=-1)
    faces = solid.triangles[records.double_area_normals(solid.triangles)[:, 2] >= 0.0]  # no bottom
    faces[..., 2] = np.maximum(faces[..., 2], z.min())
    pick = [np.unique(np.linspace(0, n - 1, min(n, 13)).round().astype(int)) for n in z.shape]
    rows = [*top[pick[0]], *top[:, pick[1]].swapaxes(0, 1)]
    lines = np.concatenate([np.stack([row[:-1], row[1:]], axis=1) for row in rows])
    return Outline(faces, lines)
