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


#: Size of slots, in bytes, from which on only the last shape is cached for the next phase or flight, not some tens.
_KEPT = 100_000


#: Number of agents up to which all distances of a shape are computed at once.
_FEW = 16


#: Errors of distances that differ by less than this share of the shape's size are equal.
_ROUNDING = 1e-12


#: Share of their length below which agents have no width: they are on a line.
_FLAT = 1e-9


#: Greatest number of agents for which a wrong shape is tested for rigidity.
_JUDGED = 200


class Alignments:
    """Slots fitted to the agents of G formations of equally many agents; what is asked for is found for all at once."""

    def __init__(self, p: Floats, slots: Floats) -> None:
        """Take agents and slots (G, N, 3)."""
        self.p, self.slots = (x - x.sum(axis=1, keepdims=True) / x.shape[1] for x in (p, slots))
        few = 1 < p.shape[1] <= _FEW
        #: The pair with the worst distance (G, 5): error [m], both, flown, of slots [m]; None of many agents.
        self.worst = _worst_pairs_of_few(p, slots).tolist() if few else None

    @cached_property
    def across(self) -> Floats:
        """The sums of p slot^T (G, 3, 3) over the agents."""
        return self.p.swapaxes(1, 2) @ self.slots

    @cached_property
    def distances_off(self) -> Floats:
        """Distance (G, N) of each agent from its slot, mirrored if that fits better."""
        U, _, Vt = np.linalg.svd(self.across)
        return length(self.p - self.slots @ (U @ Vt).swapaxes(1, 2))

    @cached_property
    def size(self) -> Floats:
        """Greatest coordinate (G,) of the slots, about their centre."""
        return np.abs(self.slots).max(axis=(1, 2))

    @cached_property
    def are_mirrored(self) -> list[bool]:
        """Whether the slots fit better if they are mirrored (G,)."""
        return (~(np.linalg.det(self.across) > 0.0)).tolist()

    @cached_property
    def rotation(self) -> Floats:
        """The best-fitting rotation (G, 3, 3), without a reflection."""
        return rigid_body.best_rotation(*np.linalg.svd(self.across))[0]

    @cached_property
    def order(self) -> list[list[int]]:
        """The agents in the order in which they follow each other where they extend most."""
        along = np.linalg.eigh(self.p.swapaxes(1, 2) @ self.p)[1][..., -1:]
        return (self.p @ along)[..., 0].argsort(axis=1).tolist()


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

    def __init__(
        self,
        p: Floats,
        slots: Floats,
        who: Ints | None = None,
        group: Alignments | None = None,
        k: int = 0,
    ) -> None:
        """Compare agents p (N, 3) with slots (N, 3), the k-th of ``group``; ``who`` (N,) are their numbers."""
        self._group, self._k = Alignments(p[None], slots[None]) if group is None else group, k
        shape = _shape if slots.nbytes < _KEPT else _shape_of_many
        self.dimension, self.axis, self._plane, self._order, self.shortest = shape(slots.tobytes())
        self.error, pair, self.flown, self.intended = _worst_pair(p, slots, self._group, k)
        self.pair = pair if who is None else (int(who[pair[0]]), int(who[pair[1]]))

    @property
    def is_mirrored(self) -> bool:
        """Whether a spatial shape is the mirror image of its slots."""
        return self.dimension == 3 and self._group.are_mirrored[self._k]

    @cached_property
    def points(self) -> list[float]:
        """Where the best-fitting rotation turns the axis in the world: a vector (3,) of any length."""
        across = self._group.across[self._k]
        if self.dimension == 1:
            axis = (across @ self.axis).tolist()
            unique = any(axis)
        else:
            (x, y, z), (u, v, w) = (self._plane @ across.T).tolist()
            axis = [y * w - z * v, z * u - x * w, x * v - y * u]
            unique = math.hypot(*axis) > _FLAT * (x * x + y * y + z * z + u * u + v * v + w * w)
        # Of agents on a line, or at a point, many rotations fit equally well.
        return axis if unique else (self._group.rotation[self._k] @ self.axis).tolist()

    @property
    def in_order(self) -> bool | None:
        """Whether the agents of a line are in order; None for other shapes, and for two agents."""
        if self.dimension != 1 or len(self._order) < 3:
            return None
        return self._group.order[self._k] in (self._order, self._order[::-1])


@lru_cache(64)
def _shape(slots: bytes) -> tuple[int, Floats, Floats, list[int], float]:
    """Of slots (N, 3): dimension, axis of `Fit`, two directions across it, order on a line, shortest distance [m]."""
    points = np.frombuffer(slots).reshape(-1, 3)
    centred = rigid_body.centred(points)
    dimension = distance_geometry.dimension(centred, THIN)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    axis = axes[0] if dimension == 1 else axes[2]
    order = (centred @ axis).argsort().tolist() if dimension == 1 else []
    plane = np.array([axes[0], np.cross(axis, axes[0])])
    return dimension, axis, plane, order, float(proximity.nearest(points).min())


_shape_of_many = lru_cache(1)(_shape.__wrapped__)


def _worst_pairs_of_few(p: Floats, slots: Floats) -> Floats:
    """Worst error of a distance of few agents (G, N, 3), see `Alignments.worst`; of equal errors the first pair's."""
    i, j = proximity.all_pairs(p.shape[1])
    flown, intended = (length(x.take(i, axis=1) - x.take(j, axis=1)) for x in (p, slots))
    error = np.abs(flown - intended)
    least = error.max(axis=1) - _ROUNDING * intended.max(axis=1)
    at = (error >= least[:, None]).argmax(axis=1)
    k = np.arange(len(p))
    return np.stack([error[k, at], i[at], j[at], flown[k, at], intended[k, at]], axis=1)


def _worst_pair(
    p: Floats, slots: Floats, group: Alignments, k: int
) -> tuple[float, tuple[int, int], float, float]:
    """Worst error of a distance among all pairs: error, pair, flown, intended [m].

    Of many agents, few pairs have to be computed: the error of a pair is at most the sum of both agents' distances from
    their slots, for any fit of the slots, mirrored or not. Improvements below rounding are ignored.
    """
    if group.worst is not None:
        error, i, j, flown, intended = group.worst[k]
        return error, (int(i), int(j)), flown, intended
    off, both = group.distances_off[k], np.array([p, slots])
    order = np.argsort(-off, kind="stable")
    ranked, rounding = -off[order], _ROUNDING * float(group.size[k])
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
