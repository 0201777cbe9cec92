"""Polygons with holes, from one height to another: signed distances, and what these are at most along a curve.

A point is inside where a ray from it crosses an odd number of edges, so that no winding of a ring matters. Corners may
be concave. All functions take arrays of points.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import NamedTuple

import numpy as np

from rigidfleet.typing import Bools, Floats

#: Points and edges that are compared at once.
_TOGETHER = 200_000
#: Least distance from an edge at which its direction is known [m].
_NEAR = 1e-12


class Region(NamedTuple):
    """All that is above or below an area, from one height to another.

    Attributes
    ----------
    edges : (E, 2, 2) both ends of each edge of the area [m]; an area lies within its edges, and not in its holes
    floor, ceiling : heights [m], which may be infinite
    """

    edges: Floats
    floor: float = -inf
    ceiling: float = inf

    @classmethod
    def of_rings(cls, rings: Sequence[Floats], floor: float = -inf, ceiling: float = inf) -> Region:
        """From rings (m, 2) [m], each closed by its first corner."""
        edges = [np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in rings]
        return cls(np.concatenate(edges), floor, ceiling)

    def distance(self, x: Floats) -> Floats:
        """Signed distance (M,) [m] of points (M, 2) from the area as seen from above: negative inside."""
        some = max(1, _TOGETHER // len(self.edges))
        parts = np.split(x, range(some, len(x), some))
        return np.concatenate([self._distance(self._edge_vectors(part), part) for part in parts])

    def curve_depths_and_bounds(self, points: Floats, *, outside: bool) -> tuple[Floats, Floats]:
        """By how much curves are inside (or ``outside``) at their middles (M,) [m], and an upper bound (M,) all along.

        A curve lies in the hull of its control points (M, 3, P). Where it stays on the one side, the nearest edge is at
        least as far as the tangents at the middle say, since the distance from an edge is convex; and on the other side
        no farther than its farthest control point.
        """
        c, low, high = bezier_curve_middles(points), self.floor, self.ceiling
        across, bound = np.empty(len(c)), np.empty(len(c))
        some = max(1, _TOGETHER // (len(self.edges) * points.shape[2]))
        for k in range(0, len(c), some):
            rows = slice(k, k + some)
            across[rows], bound[rows] = self._depth(points[rows, :2], c[rows, :2], outside=outside)
        z, least, greatest = c[:, 2], points[:, 2].min(axis=1), points[:, 2].max(axis=1)
        now = prism_distance(across if outside else -across, np.maximum(low - z, z - high))
        if outside:
            return now, prism_distance(bound, np.maximum(low - least, greatest - high))
        return -now, -prism_distance(-bound, np.maximum(low - greatest, least - high))

    def _depth(self, points: Floats, middles: Floats, *, outside: bool) -> tuple[Floats, Floats]:
        """`curve_depths_and_bounds` as seen from above, of control points (M, 2, P) with middles (M, 2)."""
        off = self._edge_vectors(middles)
        apart = np.linalg.norm(off, axis=2)
        now = self._distance(off, middles) * (1.0 if outside else -1.0)
        spread = points - middles[:, :, None]
        reach = np.linalg.norm(spread, axis=1).max(axis=1)
        bound = now + reach
        kept = np.flatnonzero((now < 0.0) & (reach < -now))  # stays on the side where it should be
        tangents = off[kept] / np.maximum(apart[kept], _NEAR)[..., None] @ spread[kept]
        bound[kept] = np.minimum(bound[kept], -(apart[kept] + tangents.min(axis=2)).min(axis=1))
        rest = np.flatnonzero((now >= 0.0) | (reach >= -now))
        ends = np.moveaxis(points[rest], 2, 1)
        far = np.linalg.norm(self._edge_vectors(ends.reshape(-1, 2)), axis=2)
        far = far.reshape(len(rest), ends.shape[1], len(self.edges)).max(axis=1).min(axis=1)
        bound[rest] = np.minimum(bound[rest], far)
        return now, bound

    def _edge_vectors(self, x: Floats) -> Floats:
        """Vectors (M, E, 2) to points (M, 2) from the nearest point of each edge."""
        begin, along = self.edges[:, 0], self.edges[:, 1] - self.edges[:, 0]
        off = x[:, None] - begin
        squares = np.maximum((along * along).sum(axis=1), _NEAR**2)
        share = np.clip((off * along).sum(axis=2) / squares, 0.0, 1.0)
        return off - share[..., None] * along

    def _distance(self, edge_vectors: Floats, x: Floats) -> Floats:
        least = np.sqrt((edge_vectors * edge_vectors).sum(axis=2).min(axis=1))
        return np.where(self.covers(x), -least, least)

    def covers(self, x: Floats) -> Bools:
        """Whether points (M, 2) are inside as seen from above."""
        (a, b), y = np.moveaxis(self.edges, 1, 0), x[:, None, 1]
        rise = np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])
        right = a[:, 0] + (y - a[:, 1]) / rise * (b[:, 0] - a[:, 0]) > x[:, None, 0]
        return (((a[:, 1] > y) != (b[:, 1] > y)) & right).sum(axis=1) % 2 == 1


def prism_distance(across: Floats, above: Floats) -> Floats:
    """Signed distance from what is within two distances at right angles."""
    outside = np.hypot(np.maximum(across, 0.0), np.maximum(above, 0.0))
    return outside + np.minimum(np.maximum(across, above), 0.0)


def bezier_curve_middles(points: Floats) -> Floats:
    """Places (M, C) in the middle of curves with control points (M, C, P)."""
    weights = np.ones(1)
    for _ in range(points.shape[2] - 1):
        weights = np.convolve(weights, [0.5, 0.5])
    return points @ weights


def edges_cross(edges: Floats) -> bool:
    """Whether two of the edges (E, 2, 2) cross, or overlap, at more than an end that they share."""
    a, b = edges[:, 0], edges[:, 1]

    def orientation(p: Floats, q: Floats, r: Floats) -> Floats:
        (u, v), (x, y) = np.moveaxis(q - p, -1, 0), np.moveaxis(r - p, -1, 0)
        return u * y - v * x

    for k in range(len(edges) - 1):
        p, q = a[k + 1 :], b[k + 1 :]
        one, other = orientation(a[k], b[k], p), orientation(a[k], b[k], q)
        here, there = orientation(p, q, a[k]), orientation(p, q, b[k])
        crossed = (one * other < 0.0) & (here * there < 0.0)
        along = b[k] - a[k]
        spans = np.sort(np.stack([(p - a[k]) @ along, (q - a[k]) @ along]), axis=0) / (
            along @ along
        )
        overlap = np.minimum(spans[1], 1.0) - np.maximum(spans[0], 0.0) > 1e-9
        crossed |= (one == 0.0) & (other == 0.0) & overlap
        if crossed.any():
            return True
    return False
