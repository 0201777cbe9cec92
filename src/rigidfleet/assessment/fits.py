"""Slots fitted to formations as flown: errors of shape, mirror images, directions, order."""

from __future__ import annotations

import math
from bisect import bisect_left
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from rigidfleet.assessment.outcome import SHAPE_TOLERANCE
from rigidfleet.formation import distance_geometry
from rigidfleet.math import proximity, rigid_body
from rigidfleet.math.constraint_jacobian import jacobian
from rigidfleet.typing import Bools, Floats, Ints

#: Slots thinner than this, relative to their length, count as planar or straight. Distances of seven digits
#: give a flat shape a thickness of 3e-4.
THIN = 1e-3


#: Greatest size of slots, in bytes, whose shape is cached for the next phase or flight.
_KEPT = 100_000


#: Number of agents up to which all distances of a shape are computed at once.
_FEW = 16


#: Errors of distances that differ by less than this share of the shape's size are equal.
_ROUNDING = 1e-12


#: Greatest number of agents for which a wrong shape is tested for rigidity.
_JUDGED = 200


class Laid(NamedTuple):
    """Slots fitted to the agents of one formation, or of many (...)."""

    p: Floats  # (..., N, 3) agents, about their centre
    slots: Floats  # (..., N, 3) slots, about their centre
    off: Floats  # (..., N) distance of each agent from its slot, mirrored if that fits better
    mirrored: Bools  # (...) whether mirrored slots fit better
    turn: Floats  # (..., 3, 3) the best-fitting rotation, without a reflection
    along: Floats  # (..., 3) the direction in which the agents extend most
    size: Floats  # (...) the greatest coordinate of the slots, about their centre
    #: The pair with the worst distance (..., 5): error [m], both, flown, of slots [m]; of many agents (..., 0)
    worst: Floats

    @classmethod
    def of(cls, p: Floats, slots: Floats) -> Laid:
        """Fit slots (..., N, 3) to agents p (..., N, 3)."""
        few = 1 < p.shape[-2] <= _FEW
        worst = _worst_of_few(p, slots) if few else np.empty((*p.shape[:-2], 0))
        p, slots = p - p.mean(axis=-2, keepdims=True), slots - slots.mean(axis=-2, keepdims=True)
        across, of_agents = p.swapaxes(-1, -2) @ np.stack([slots, p])
        U, s, Vt = np.linalg.svd(across)
        off = length(p - slots @ (U @ Vt).swapaxes(-1, -2))
        size = np.abs(slots).max(axis=(-2, -1))
        turn, proper = rigid_body.best_rotation(U, s, Vt)
        along = np.linalg.eigh(of_agents)[1][..., -1]
        return cls(p, slots, off, ~proper, turn, along, size, worst)


class Fit:
    """A formation as flown at one sample, p (N, 3), compared with its slots (N, 3)."""

    def __init__(
        self, p: Floats, slots: Floats, who: Ints | None = None, laid: Laid | None = None
    ) -> None:
        laid = Laid.of(p, slots) if laid is None else laid
        known = (
            _shape(slots.tobytes()) if slots.nbytes < _KEPT else _shape.__wrapped__(slots.tobytes())
        )
        #: Dimension of the slots; direction of a line or normal of a plane, in their axes; shortest distance [m].
        self.dimension, self.axis, self.shortest = known
        self.error, pair, self.flown, self.intended = _all_pairs(p, slots, laid)
        #: The pair with the greatest error, as agent numbers from ``who`` (N,).
        self.pair = pair if who is None else (int(who[pair[0]]), int(who[pair[1]]))
        self.mirrored = self.dimension == 3 and bool(laid.mirrored)
        #: Where the axis points in the world.
        self.points: Floats = laid.turn @ self.axis
        self.in_order: bool | None = None
        if self.dimension == 1 and len(p) > 2:
            asked = np.argsort(laid.slots @ self.axis).tolist()
            flown = np.argsort(laid.p @ laid.along).tolist()
            self.in_order = flown in (asked, asked[::-1])

    @property
    def limit(self) -> float:
        """Greatest error of a pair [m]."""
        return SHAPE_TOLERANCE * self.shortest

    def angle_from(self, T: Floats) -> float:
        """Angle [deg] of the axis from its direction in an attitude T (3, 3); NaN without an attitude."""
        return angle_between(self.points, T.T @ self.axis)


def length(x: Floats) -> Floats:
    """Lengths (...) of vectors (..., 3)."""
    squares = x * x
    return np.sqrt(squares[..., 0] + squares[..., 1] + squares[..., 2])


@lru_cache(64)
def _shape(slots: bytes) -> tuple[int, Floats, float]:
    """Dimension of slots (N, 3), the direction of a line or the normal of a plane, and the shortest distance [m]."""
    points = np.frombuffer(slots).reshape(-1, 3)
    centred = rigid_body.centred(points)
    dimension = distance_geometry.dimension(centred, THIN)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    return dimension, axes[0] if dimension == 1 else axes[2], float(proximity.nearest(points).min())


def _worst_of_few(p: Floats, slots: Floats) -> Floats:
    """Worst error of a distance of few agents (..., N, 3), see `Laid.worst`; of equal errors the first pair's."""
    both = np.stack([p, slots])
    flown, intended = length(both[..., :, None, :] - both[..., None, :, :]).reshape(
        2, *p.shape[:-2], -1
    )
    n, error = p.shape[-2], np.abs(flown - intended)
    error[..., :: n + 1] = -1.0  # an agent and itself
    most = error.max(axis=-1, keepdims=True)
    at = (error >= most - _ROUNDING * intended.max(axis=-1, keepdims=True)).argmax(axis=-1)
    there = at[..., None]
    off, flown, intended = (
        np.take_along_axis(x, there, axis=-1)[..., 0] for x in (error, flown, intended)
    )
    return np.stack([off, *np.divmod(at, n), flown, intended], axis=-1)


def _all_pairs(p: Floats, slots: Floats, laid: Laid) -> tuple[float, tuple[int, int], float, float]:
    """Worst error of a distance among all pairs: error, pair, flown, intended [m].

    Of many agents, few pairs have to be computed: the error of a pair is at most the sum of both agents' distances from
    their slots, for any fit of the slots, mirrored or not. Improvements below rounding are ignored.
    """
    if len(laid.worst):
        error, i, j, flown, intended = laid.worst.tolist()
        return error, (int(i), int(j)), flown, intended
    off, both = laid.off.tolist(), np.array([p, slots])
    order = sorted(range(len(off)), key=lambda i: -off[i])
    ranked, rounding = [-off[i] for i in order], _ROUNDING * float(laid.size)
    worst = (-1.0, (0, 0), 0.0, 0.0)
    for k, i in enumerate(order[:-1]):
        last = bisect_left(ranked, off[i] - worst[0] - rounding)
        if last <= k + 1:
            break
        others = sorted(order[k + 1 : last])
        flown, intended = length(both[:, others] - both[:, i, None]).tolist()
        error = [abs(a - b) for a, b in zip(flown, intended, strict=True)]
        if (most := max(error)) > worst[0]:
            j = error.index(most)
            worst = (most, (min(i, others[j]), max(i, others[j])), flown[j], intended[j])
    return worst


def is_rigid(p: Floats, edges: Ints) -> bool:
    """Whether edges (m, 2) at positions (N, 3) are infinitesimally rigid in space: rank J = 3N - 6.

    False for more than `_JUDGED` agents: the rank would take longer than the rest of the verdict.
    """
    if len(p) > _JUDGED:
        return False
    J = jacobian(p, edges)
    return bool(np.isfinite(J).all()) and np.linalg.matrix_rank(J, rtol=1e-6) == 3 * len(p) - 6


def angle_between(a: Floats, b: Floats) -> float:
    """Angle [deg] between two vectors."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    across = math.hypot(y * w - z * v, z * u - x * w, x * v - y * u)
    return math.degrees(math.atan2(across, x * u + y * v + z * w))
