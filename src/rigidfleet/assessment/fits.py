"""Slots fitted to formations as flown: errors of shape, mirror images, directions, order."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from itertools import repeat
from typing import Any, NamedTuple

import numpy as np

from rigidfleet.math import proximity, rigid_body
from rigidfleet.math.constraint_jacobian import jacobian
from rigidfleet.result.quantities import norms
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


#: Slots (N, 3), the same about their centre, dimension and axis of `Fit`, order on a line, distances (P,) of all pairs
#: of few agents, shortest distance [m].
SlotShape = tuple[Floats, Floats, int, Floats, list[int], Floats, float]


class Fit(NamedTuple):
    """A formation as flown at one sample, compared with its slots.

    Attributes
    ----------
    dimension, axis : of the slots: dimension; direction of a line or normal of a plane, in their axes
    limit : the greatest error that the formation allows [m]
    error, pair, flown, intended : the greatest error of a distance [m], of which agents, and the two distances [m]
    is_mirrored : whether a spatial shape is the mirror image of its slots
    turned_axis : where the best-fitting rotation turns the axis in the world: a unit vector (3,)
    in_order : whether the agents of a line are in order; None for other shapes, and for two agents
    """

    dimension: int
    axis: Floats
    limit: float
    error: float
    pair: tuple[int, int]
    flown: float
    intended: float
    is_mirrored: bool
    turned_axis: list[float]
    in_order: bool | None


def fits_by_sample(
    p: Floats, shape: SlotShape, who: Ints, error_limit: Callable[[float], float]
) -> Iterator[Fit]:
    """Compare a formation as flown at G samples with the shape of its slots: agents ``who`` (N,) at p (G, N, 3).

    ``error_limit``: the one that is allowed [m], of the shortest distance of two slots [m].
    """
    slots, centred, dimension, axis, order, distances, shortest = shape
    own = p - p.mean(axis=1, keepdims=True)
    # The decompositions of the sums of p slot^T over the agents.
    u, s, vt = np.linalg.svd(own.swapaxes(1, 2) @ centred)
    turn, proper = rigid_body.best_rotation(u, s, vt)
    if distances.size:
        worst = _worst_pair_errors(p, distances)
    else:
        worst = map(_worst_pair, p, repeat(slots), norms(own - centred @ (u @ vt).swapaxes(1, 2)))
    in_order: list[bool | None] = [None] * len(p)
    if len(order) > 2:
        # They follow each other where they extend most.
        along = np.linalg.eigh(own.swapaxes(1, 2) @ own)[1][..., -1:]
        flown = (own @ along)[..., 0].argsort(axis=1).tolist()
        in_order = [x in (order, order[::-1]) for x in flown]
    points, limit = (turn @ axis).tolist(), error_limit(shortest)
    for wrong, right, place, ordered in zip(worst, proper.tolist(), points, in_order, strict=True):
        error, i, j, apart, intended = wrong
        pair, mirrored = (who.item(i), who.item(j)), dimension == 3 and not right
        yield Fit(dimension, axis, limit, error, pair, apart, intended, mirrored, place, ordered)


def shape_of_slots(slots: Floats) -> SlotShape:
    """What a formation as flown is compared with, of slots (N, 3) of two agents or more."""
    centred, few = rigid_body.centred(slots), len(slots) <= _FEW
    _, extents, axes = np.linalg.svd(centred, full_matrices=False)
    dimension = int(np.count_nonzero(extents > THIN * extents[0]))
    axis = axes[0] if dimension == 1 else axes[2]
    order = (centred @ axis).argsort().tolist() if dimension == 1 else []
    pairs = proximity.all_pairs(len(slots) if few else 0).T
    apart = proximity.pair_distances(slots[None], pairs)[:, 0]
    shortest = float((apart if few else proximity.nearest(slots)).min())
    return slots, centred, dimension, axis, order, apart, shortest


def formation_shape(mission: Any, name: str, *who: int) -> SlotShape | None:
    """The shape of the slots of the agents ``who`` in a formation; None without slots, or of one agent alone."""
    slots = mission.formation_slots(name)
    return None if slots is None or len(who) < 2 else shape_of_slots(slots[list(who)])


#: Error of a distance [m], of which two, the distances flown and intended [m].
_Worst = tuple[float, int, int, float, float]


def _worst_pair_errors(p: Floats, intended: Floats) -> Iterator[_Worst]:
    """Worst errors of all pairs, ``intended`` (P,) apart, at samples p (G, N, 3); of equal errors the first."""
    i, j = pairs = proximity.all_pairs(p.shape[1])
    flown = proximity.pair_distances(p, pairs.T).T
    error = np.abs(flown - intended)
    least = error.max(axis=1, keepdims=True) - _ROUNDING * intended.max()
    k, at = (error >= least).argmax(axis=1), np.arange(len(p))
    columns = error[at, k], i[k], j[k], flown[at, k], intended[k]
    return zip(*(x.tolist() for x in columns), strict=True)


def _worst_pair(p: Floats, slots: Floats, off: Floats) -> _Worst:
    """Worst error of a distance of many agents p (N, 3), among all pairs.

    Few pairs have to be computed: the error of a pair is at most the sum of both agents' distances ``off`` (N,) from
    their slots, for any fit of the slots, mirrored or not. Improvements below rounding are ignored.
    """
    both = np.array([p, slots])
    order = np.argsort(-off, kind="stable")
    ranked, rounding = -off[order], _ROUNDING * float(np.ptp(slots, axis=0).max())
    worst = (-1.0, 0, 0, 0.0, 0.0)
    for first, i in enumerate(order[:-1].tolist(), start=1):
        last = bisect_left(ranked, off[i] - worst[0] - rounding)
        if last <= first:
            break
        others = np.sort(order[first:last])
        flown, intended = norms(both.take(others, axis=1) - both[:, i, None])
        error = np.abs(flown - intended)
        at = int(error.argmax())
        if (most := float(error[at])) > worst[0]:
            j = int(others[at])
            worst = (most, min(i, j), max(i, j), float(flown[at]), float(intended[at]))
    return worst


def is_rigid(p: Floats, edges: Ints) -> bool:
    """Whether edges (m, 2) at positions (N, 3) are infinitesimally rigid in space: rank J = 3N - 6.

    False for more than `_JUDGED` agents: the rank would take longer than the rest of the verdict.
    """
    if len(p) > _JUDGED:
        return False
    J = jacobian(p, edges)
    return bool(np.isfinite(J).all()) and np.linalg.matrix_rank(J, rtol=1e-6) == 3 * len(p) - 6


def degrees_between_vectors(a: Sequence[float], b: Sequence[float]) -> float:
    """Angle [deg] between two vectors."""
    (x, y, z), (u, v, w) = a, b
    across = math.hypot(y * w - z * v, z * u - x * w, x * v - y * u)
    return math.degrees(math.atan2(across, x * u + y * v + z * w))
