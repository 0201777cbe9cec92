"""Slots fitted to formations as flown: errors of shape, mirror images, directions, order."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from itertools import repeat
from typing import NamedTuple

import numpy as np

from rigidfleet.formation import distance_geometry
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


class Fit(NamedTuple):
    """A formation as flown at one sample, compared with its slots.

    Attributes
    ----------
    dimension, axis : of the slots: dimension; direction of a line or normal of a plane, in their axes
    limit : the greatest error that the formation allows [m]
    error, pair, flown, intended : the greatest error of a distance [m], of which agents, and the two distances [m]
    is_mirrored : whether a spatial shape is the mirror image of its slots
    points : where the best-fitting rotation turns the axis in the world: a unit vector (3,)
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
    p: Floats, slots: Floats, who: Ints, error_limit: Callable[[float], float]
) -> Iterator[Fit]:
    """Compare a formation as flown at G samples with its slots (N, 3): agents ``who`` (N,) at p (G, N, 3).

    ``error_limit``: the one that is allowed [m], of the shortest distance of two slots [m].
    """
    dimension, axis, order, shortest = _shape_properties(slots)
    own, centred = p - p.mean(axis=1, keepdims=True), rigid_body.centred(slots)
    # The decompositions of the sums of p slot^T over the agents.
    u, s, vt = np.linalg.svd(own.swapaxes(1, 2) @ centred)
    turn, proper = rigid_body.best_rotation(u, s, vt)
    if len(slots) <= _FEW:
        worst = _worst_pair_errors(p, slots)
    else:
        worst = map(_worst_error, p, repeat(slots), norms(own - centred @ (u @ vt).swapaxes(1, 2)))
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


def _shape_properties(slots: Floats) -> tuple[int, Floats, list[int], float]:
    """Of slots (N, 3): dimension, axis of `Fit`, order on a line, shortest distance [m]."""
    centred = rigid_body.centred(slots)
    dimension = distance_geometry.dimension(centred, THIN)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    axis = axes[0] if dimension == 1 else axes[2]
    order = (centred @ axis).argsort().tolist() if dimension == 1 else []
    return dimension, axis, order, float(proximity.nearest(slots).min())


#: Error of a distance [m], of which two, the distances flown and intended [m].
_Worst = tuple[float, int, int, float, float]


def _worst_pair_errors(p: Floats, slots: Floats) -> Iterator[_Worst]:
    """Worst errors of a distance at samples p (G, N, 3), among all pairs; of equal errors the first."""
    i, j = proximity.all_pairs(len(slots))
    flown, intended = (norms(x.take(i, axis=-2) - x.take(j, axis=-2)) for x in (p, slots))
    error = np.abs(flown - intended)
    least = error.max(axis=1, keepdims=True) - _ROUNDING * intended.max()
    k, at = (error >= least).argmax(axis=1), np.arange(len(p))
    columns = error[at, k], i[k], j[k], flown[at, k], intended[k]
    return zip(*(x.tolist() for x in columns), strict=True)


def _worst_error(p: Floats, slots: Floats, off: Floats) -> _Worst:
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


def degrees_between(a: Sequence[float], b: Sequence[float]) -> float:
    """Angle [deg] between two vectors."""
    (x, y, z), (u, v, w) = a, b
    across = math.hypot(y * w - z * v, z * u - x * w, x * v - y * u)
    return math.degrees(math.atan2(across, x * u + y * v + z * w))
