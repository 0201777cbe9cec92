"""Other shapes with the same distances, in which a formation may end with every error at zero."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet._common.renamed import with_earlier_members
from rigidfleet.rigidity.analysis import (
    RigidityClass,
    as_framework,
    class_reason_stress_and_shape,
    flatten_points,
)
from rigidfleet.rigidity.framework import Framework
from rigidfleet.rigidity.order import STRIDES, align_points, can_deform_into, descend_to_lengths
from rigidfleet.typing import Floats, Ints

#: Shapes whose all-pairs distances differ by less than this share of their size count as equal.
_ALIKE = 1e-3

#: Error within which lengths count as reached, as a share of the shape's size.
_REACHED = 1e-9


class Kind(StrEnum):
    """How a realisation differs from the intended shape."""

    SAME = "same"
    MIRRORED = "mirror image"
    FOLDED = "folded"
    COINCIDENT = "coincident"


@with_earlier_members(found="starts")
@dataclass(frozen=True)
class Realisation:
    """A shape with the given distances.

    Attributes
    ----------
    kind : same; mirror image; folded (other all-pairs distances); coincident (folded, two agents at the same place)
    slots : (N, 3) [m], rotated to fit the intended shape
    starts : number of starts that led to this shape
    deviation : greatest difference of an all-pairs distance from the intended [m]
    closest : least distance between two agents [m]
    rigid : whether it is infinitesimally rigid
    bends : whether it stands for a family of shapes, into which a finite motion bends it that keeps all distances
    """

    kind: Kind
    slots: Floats
    starts: int
    deviation: float
    closest: float
    rigid: bool
    bends: bool = False

    def data(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "kind": str(self.kind),
            "found": self.starts,
            "deviation": self.deviation,
            "closest": self.closest,
            "rigid": self.rigid,
            "bends": self.bends,
            "slots": self.slots.tolist(),
        }


@with_earlier_members(found="shapes")
@dataclass(frozen=True)
class Realisations:
    """Result of a search from many starts.

    Attributes
    ----------
    shapes : the shapes, the intended one and its mirror image first, then the most frequent first
    starts, converged : number of starts, and number of them that met all distances
    leads_to : index into `shapes` of the shape to which the given start leads; None if there is none
    """

    shapes: tuple[Realisation, ...]
    starts: int
    converged: int
    leads_to: int | None = None

    @property
    def unique(self) -> bool:
        """Whether the search found only the intended shape and its mirror image."""
        return all(r.kind in (Kind.SAME, Kind.MIRRORED) for r in self.shapes)

    def data(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "starts": self.starts,
            "converged": self.converged,
            "unique": self.unique,
            "leads_to": self.leads_to,
            "found": [r.data() for r in self.shapes],
        }


def realisations(
    slots: ArrayLike,
    edges: ArrayLike,
    *,
    starts: int = 200,
    seed: int = 0,
    start: ArrayLike | None = None,
    iterations: int = 150,
    dimension: int = 3,
) -> Realisations:
    """Search for all shapes whose edges are as long as those of the slots.

    Levenberg-Marquardt runs on (L^2 - d^2)/(2 d) from random positions of the size of the shape, all starts at
    once. Equal shapes are recognised by all-pairs distances. A mirror image counts as another shape only if it is that
    of the intended one. Shapes that bend into each other count as one, the first found, or the intended one. The search
    is no proof of completeness: the share of starts that led to each shape shows how thorough it was.

    Parameters
    ----------
    slots : (N, 3) [m], the intended shape
    edges : (m, 2), agents from 0
    starts, seed, iterations : budget and seed of the search; 200 starts of 8 agents take a second
    start : (N, 3) [m] positions from which the distances are established; `leads_to` gives the result. The squared
        lengths are led from those at the start to the desired ones, as `reference = "squares"` does
    dimension : of the space in which the agents move, 1 to 3; in a plane, a flat shape cannot be turned over, and has
        a mirror image

    Raises
    ------
    ValueError
        As `analyse`; or the start is not (N, 3).
    """
    p, e = as_framework(slots, edges)
    drawn = p - p.mean(axis=0)
    p, axes = (drawn, np.eye(3)) if dimension == 3 else flatten_points(p, dimension)
    n, length = len(p), np.linalg.norm(p[e[:, 0]] - p[e[:, 1]], axis=1)
    size = float(np.linalg.norm(p, axis=1).max(initial=0.0))
    if n < 2 or not len(e):
        return Realisations((_realisation(p, p, e, 1, size, axes),), starts, starts)
    rng = np.random.default_rng(seed)
    spread = np.sqrt((p**2).sum() / (dimension * n))
    at = rng.normal(scale=spread, size=(starts, n, dimension))
    groups = _Groups(p, _ALIKE * size)
    groups.add(p, 0)
    converged = 0
    share = max(1, int(1e7 / (len(e) * 3 * n)))  # starts whose Jacobians fit into 80 MB
    for first in range(0, starts, share):
        some = at[first : first + share]
        ends, reached = descend_to_lengths(some, e, length, _REACHED * size, iterations)
        converged += int(reached.sum())
        for end in ends[reached]:
            groups.add(end, 1)
    end = None
    if start is not None:
        at = np.asarray(start, dtype=np.float64)
        if at.shape != (n, 3) or not np.isfinite(at).all():
            raise ValueError(f"start must be ({n}, 3) finite positions [m], not {at.shape}")
        begin = align_points(at, drawn) @ axes[:dimension].T
        end = deform_to_lengths(begin, e, length, _REACHED * size)
    last = None if end is None else groups.add(end, 0)
    first = groups.bending_family_of_each_shape(e)
    counts = np.bincount(first, groups.counts).astype(int).tolist()
    shapes = {k: _realisation(groups.shapes[k], p, e, counts[k], size, axes) for k in set(first)}
    rank = {Kind.SAME: 0, Kind.MIRRORED: 1}
    order = sorted(shapes, key=lambda k: (rank.get(shapes[k].kind, 2), -shapes[k].starts, k))
    leads_to = None if last is None else order.index(first[last])
    return Realisations(tuple(shapes[k] for k in order), starts, converged, leads_to)


class _Groups:
    """Shapes distinguished by all-pairs distances, and the intended one, which comes first, by handedness."""

    def __init__(self, intended: Floats, tol: float) -> None:
        self._intended, self._tol = intended, tol
        self._pairs: list[Floats] = []
        self.shapes: list[Floats] = []
        self.counts: list[int] = []

    def add(self, p: Floats, count: int) -> int:
        """Count a shape; return its number."""
        pairs = _distances_of_pairs(p)
        alike = [np.abs(known - pairs).max() <= self._tol for known in self._pairs]
        for k, q in enumerate(self.shapes):
            if alike[k] and (not alike[0] or self._is_same_shape(p, q)):
                self.counts[k] += count
                return k
        self._pairs.append(pairs)
        self.shapes.append(align_points(p, self._intended))
        self.counts.append(count)
        return len(self.shapes) - 1

    def bending_family_of_each_shape(self, edges: Ints) -> list[int]:
        """Of each shape, the first one into which it bends while the edges (m, 2) keep their lengths; or itself."""
        frames = [Framework(q, edges) for q in self.shapes]
        bend = [k for k, frame in enumerate(frames) if frame.flexes.size]
        first = list(range(len(frames)))
        for strides in STRIDES:
            for k in (k for k in bend if first[k] == k):
                nearest: dict[int, int] = {}  # shape of each family
                for j in sorted(bend, key=lambda j: np.abs(self._pairs[j] - self._pairs[k]).max()):
                    nearest.setdefault(first[j], j)
                for family, j in nearest.items():
                    if family < k and can_deform_into(frames[k], frames[j].p, strides):
                        first = [family if i == k else i for i in first]
                        break
        return first

    def _is_same_shape(self, p: Floats, q: Floats) -> bool:
        # Distance errors e make a flat shape sqrt(e) thick, so a wide gap must distinguish a mirror image.
        return bool(np.linalg.norm(align_points(p, q) - q, axis=1).max() <= 30 * self._tol)


def _realisation(
    q: Floats, p: Floats, e: Ints, starts: int, size: float, axes: Floats
) -> Realisation:
    deviation = float(np.abs(_distances_of_pairs(q) - _distances_of_pairs(p)).max(initial=0.0))
    closest = float(_distances_of_pairs(q).min(initial=np.inf))
    if deviation <= _ALIKE * size:
        same = np.linalg.norm(align_points(q, p) - p, axis=1).max(initial=0.0) <= 30 * _ALIKE * size
        kind = Kind.SAME if same else Kind.MIRRORED
    else:
        kind = Kind.COINCIDENT if closest <= _ALIKE * size else Kind.FOLDED
    frame = Framework(q, e)
    rigid = frame.flexes.shape[1] == 0
    bends = not rigid and class_reason_stress_and_shape(frame)[0] is RigidityClass.FLEXIBLE
    return Realisation(kind, q @ axes[: q.shape[1]], starts, deviation, closest, rigid, bends)


def _distances_of_pairs(p: Floats) -> Floats:
    i, j = np.triu_indices(len(p), 1)
    return np.linalg.norm(p[i] - p[j], axis=1)


def deform_to_lengths(
    start: Floats, e: Ints, length: Floats, tol: float, slots: Floats | None = None
) -> Floats | None:
    """Positions (N, d) to which lengths (m,) lead that go from those at the start to the desired ones in small steps.

    Squared lengths are blended, or, given slots (N, d), the positions. None if the desired ones are not met within
    tol [m].
    """
    at = start[None]
    now = ((start[e[:, 0]] - start[e[:, 1]]) ** 2).sum(axis=1)
    goal = None if slots is None else align_points(slots, start)
    steps = 50
    for k in range(1, steps + 1):
        squares = now + (length**2 - now) * (k / steps)
        if goal is not None and k < steps:
            between = start + (goal - start) * (k / steps)
            squares = ((between[e[:, 0]] - between[e[:, 1]]) ** 2).sum(axis=1)
        wanted = np.sqrt(np.maximum(squares, (1e-3 * length) ** 2))
        at, reached = descend_to_lengths(at, e, wanted, tol, 8 if k < steps else 300)
    return at[0] if reached[0] else None
