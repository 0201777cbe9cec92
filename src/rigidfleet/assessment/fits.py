"""Slots fitted to formations as flown: errors of shape, mirror images, directions, order."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from functools import cached_property, lru_cache

import numpy as np

from rigidfleet.formation import distance_geometry
from rigidfleet.math import proximity, rigid_body
from rigidfleet.math.constraint_jacobian import jacobian
from rigidfleet.result.quantities import length
from rigidfleet.typing import Floats, Ints

#: Slots thinner than this, relative to their length, count as planar or straight. Distances of seven digits
#: give a flat shape a thickness of 3e-4.
THIN = 1e-3


#: Number of agents up to which all distances of a shape are computed at once.
_FEW = 16


#: Errors of distances that differ by less than this share of the shape's size are equal.
_ROUNDING = 1e-12


#: Greatest number of agents for which a wrong shape is tested for rigidity.
_JUDGED = 200


class Fit:
    """A formation as flown at one sample, compared with its slots.

    Attributes
    ----------
    dimension, axis, shortest : of the slots: dimension; direction of a line or normal of a plane, in their axes;
        shortest distance [m]
    error, pair, flown, intended : the greatest error of a distance [m], of which agents, and the two distances [m]
    limit : the greatest error that the formation allows [m]
    """

    limit: float

    def __init__(self, p: Floats, slots: Floats) -> None:
        """Compare agents p (N, 3) with slots (N, 3)."""
        self._p, centred = rigid_body.centred(p), rigid_body.centred(slots)
        self.dimension, self.axis, self._order, self.shortest = _shape(slots.tobytes())
        #: The decomposition of the sum of p slot^T over the agents.
        self._across = np.linalg.svd(self._p.T @ centred)
        off = length(self._p - centred @ (self._across[0] @ self._across[2]).T)
        self.error, self.pair, self.flown, self.intended = _worst_pair(p, slots, off)

    @property
    def is_mirrored(self) -> bool:
        """Whether a spatial shape is the mirror image of its slots."""
        u, _, vt = self._across
        return self.dimension == 3 and bool(np.linalg.det(u @ vt) < 0.0)

    @cached_property
    def points(self) -> list[float]:
        """Where the best-fitting rotation turns the axis in the world: a unit vector (3,)."""
        return (rigid_body.best_rotation(*self._across)[0] @ self.axis).tolist()

    @property
    def in_order(self) -> bool | None:
        """Whether the agents of a line are in order; None for other shapes, and for two agents."""
        if self.dimension != 1 or len(self._order) < 3:
            return None
        # They follow each other where they extend most.
        along = np.linalg.eigh(self._p.T @ self._p)[1][:, -1]
        return (self._p @ along).argsort().tolist() in (self._order, self._order[::-1])


@lru_cache(16)
def _shape(slots: bytes) -> tuple[int, Floats, list[int], float]:
    """Of slots (N, 3): dimension, axis of `Fit`, order on a line, shortest distance [m]."""
    points = np.frombuffer(slots).reshape(-1, 3)
    centred = rigid_body.centred(points)
    dimension = distance_geometry.dimension(centred, THIN)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    axis = axes[0] if dimension == 1 else axes[2]
    order = (centred @ axis).argsort().tolist() if dimension == 1 else []
    return dimension, axis, order, float(proximity.nearest(points).min())


def _worst_pair(
    p: Floats, slots: Floats, off: Floats
) -> tuple[float, tuple[int, int], float, float]:
    """Worst error of a distance among all pairs: error, pair, flown, intended [m]; of equal errors of few the first.

    Of many agents, few pairs have to be computed: the error of a pair is at most the sum of both agents' distances
    ``off`` (N,) from their slots, for any fit of the slots, mirrored or not. Improvements below rounding are ignored.
    """
    both = np.array([p, slots])
    if len(p) <= _FEW:
        i, j = proximity.all_pairs(len(p))
        flown, intended = length(both.take(i, axis=1) - both.take(j, axis=1))
        error = np.abs(flown - intended)
        k = int((error >= error.max() - _ROUNDING * intended.max()).argmax())
        return error.item(k), (i.item(k), j.item(k)), flown.item(k), intended.item(k)
    order = np.argsort(-off, kind="stable")
    ranked, rounding = -off[order], _ROUNDING * float(np.ptp(slots, axis=0).max())
    worst = (-1.0, (0, 0), 0.0, 0.0)
    for first, i in enumerate(order[:-1].tolist(), start=1):
        last = bisect_left(ranked, off[i] - worst[0] - rounding)
        if last <= first:
            break
        others = np.sort(order[first:last])
        flown, intended = length(both.take(others, axis=1) - both[:, i, None])
        error = np.abs(flown - intended)
        at = int(error.argmax())
        if (most := float(error[at])) > worst[0]:
            j = int(others[at])
            worst = (most, (min(i, j), max(i, j)), float(flown[at]), float(intended[at]))
    return worst


def is_rigid(p: Floats, edges: Ints) -> bool:
    """Whether edges (m, 2) at positions (N, 3) are infinitesimally rigid in space: rank J = 3N - 6.

    False for more than `_JUDGED` agents: the rank would take longer than the rest of the verdict.
    """
    if len(p) > _JUDGED:
        return False
    J = jacobian(p, edges)
    return bool(np.isfinite(J).all()) and np.linalg.matrix_rank(J, rtol=1e-6) == 3 * len(p) - 6


def angle_between(a: Sequence[float], b: Sequence[float]) -> float:
    """Angle [deg] between two vectors."""
    (x, y, z), (u, v, w) = a, b
    across = math.hypot(y * w - z * v, z * u - x * w, x * v - y * u)
    return math.degrees(math.atan2(across, x * u + y * v + z * w))
