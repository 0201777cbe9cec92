"""Rigidity of a formation: whether distances alone hold its shape, why, and which motions stay free."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet._common.plain import to_json_data
from rigidfleet._common.renamed import with_earlier_members
from rigidfleet.formation import distance_geometry
from rigidfleet.math.constraint_jacobian import jacobian
from rigidfleet.rigidity.framework import Flex, Framework, localised_flexes
from rigidfleet.rigidity.order import StressEnergy, blocking_stress, flexed_points_and_second_order
from rigidfleet.typing import Floats, Ints


class RigidityClass(StrEnum):
    """How rigid the distances make a shape."""

    INFINITESIMALLY_RIGID = "infinitesimally rigid"
    PRESTRESS_STABLE = "prestress-stable"
    FLEXIBLE = "flexible"
    UNDECIDED = "undecided"


#: Index below which a formation is rigid in name only: 1 mm of length error allows 1 m of displacement.
_BARELY = 1e-3

WHERE = ("point", "line", "plane", "space")


@with_earlier_members(force="constraint_force_bound")
@dataclass(frozen=True)
class Rigidity:
    """Rigidity of a shape under the distances of some edges, and the motions they leave free.

    Attributes
    ----------
    edges : (m, 2), agents from 0
    dimension : 0 a point, 1 a line, 2 a plane, 3 a spatial shape
    space : dimension of the space in which the agents may move
    rank : of J, the number of independent edges
    reachable : greatest rank of J for slots of this dimension: 3N - 6 in space, 2N - 3 in a plane, N - 1 on a line
    needed : rank of an infinitesimally rigid framework: 3N - 6 (N = 2: 1; N = 1: 0) where the space is 3-D
    redundant : edges of which any single one could be removed without loss of rank
    spare : m - rank edges that could be removed together, long ones first
    flexes : a basis of the motions that change no distance to first order, fewest agents first
    index : smallest non-zero singular value of J M^-1/2 sqrt(mbar), the rigidity index; NaN without edges
    rigidity_class, reason : the class, and its reason in words
    stress : (m,) blocking self-stress, scaled to a largest force of 1 N, if one was found
    deformed : (N, 3) another shape with the same distances, reached by a finite motion, if one was found
    within : rigidity of a flat shape in its own plane, or of a straight one on its own line
    """

    agents: int
    edges: Ints
    dimension: int
    space: int
    rank: int
    reachable: int
    needed: int
    redundant: Ints
    spare: Ints
    flexes: tuple[Flex, ...]
    index: float
    rigidity_class: RigidityClass
    reason: str
    stress: Floats | None = None
    deformed: Floats | None = None
    within: Rigidity | None = None

    @property
    def w(self) -> float:
        """Smallest non-zero eigenvalue of mbar J M^-1 J^T: the index squared."""
        return self.index**2

    @property
    def rigid(self) -> bool:
        """Whether the distances are known to hold the shape against every small motion."""
        held = RigidityClass.INFINITESIMALLY_RIGID, RigidityClass.PRESTRESS_STABLE
        return self.rigidity_class in held

    @property
    def own(self) -> Rigidity:
        """Where a flat or straight shape is flexible, its rigidity in its own plane or line."""
        flexible = self.rigidity_class is RigidityClass.FLEXIBLE
        return self.within if flexible and self.within is not None else self

    def constraint_force_bound(self, b: float, mass: float = 1.0) -> float:
        """Greatest norm of f_C (all agents) [N] under the exact law for a right side of norm `b` [m/s^2].

        |f_C| <= m |b| / index for equal masses: a shape of half the index may need twice the force.
        """
        return mass * b / self.index

    def offset(self, error: float) -> float:
        """Greatest displacement (norm over all agents) [m] for length errors of norm `error` [m]."""
        return error / self.index

    def data(self) -> dict[str, Any]:
        """Plain data for JSON, agents and edges counted from 1."""
        flexes = [{"agents": [i + 1 for i in x.agents], "motion": x.motion} for x in self.flexes]
        data = {field.name: getattr(self, field.name) for field in fields(self)} | {
            "edges": len(self.edges),
            "redundant": self.edges[self.redundant] + 1,
            "spare": self.edges[self.spare] + 1,
            "flexes": flexes,
            "w": self.w,
        }
        return to_json_data(data)


def analyse(
    slots: ArrayLike,
    edges: ArrayLike,
    *,
    dimension: int = 3,
    masses: ArrayLike | None = None,
    space: int | None = None,
) -> Rigidity:
    """Analyse a formation: rank, redundant edges, free motions, rigidity index and class.

    The class is determined in this order; each step is a proof up to rounding:

    1. no flex: infinitesimally rigid (so rigid);
    2. flexible already within the shape's own plane or line: flexible;
    3. J has the greatest rank that this graph has anywhere, and there is a flex: flexible (Asimow and Roth,
       1978: near such points the lengths' level sets are manifolds, larger than the rigid motions);
    4. a self-stress with positive energy on every flex: prestress-stable (so rigid);
    5. a finite motion followed numerically, with lengths equal to 1e-12: flexible;
    6. otherwise: undecided.

    Parameters
    ----------
    slots : (N, 3) [m], or (N, d) with d <= 3
    edges : (m, 2), agents from 0
    dimension : of the space in which the agents move, 1 to 3; below 3, they stay in the shape's plane or line
    masses : (N,) [kg], default equal
    space : the former name of `dimension`

    Raises
    ------
    ValueError
        An edge names an agent that does not exist, joins an agent to itself or two agents at the same place, or
        occurs twice; a slot is not finite; the shape does not fit into the space; or a mass is not positive.
    """
    p, e = as_framework(slots, edges)
    n, d = len(p), distance_geometry.dimension(p)
    space = dimension if space is None else space
    flat, axes = flatten_points(p, space)
    frame = Framework(flat, e)
    within = analyse(flat[:, :d], e, dimension=d, masses=masses) if 0 < d < space else None
    motions = localised_flexes(frame)
    to_world = axes[:space]
    flexes = tuple(Flex(agents, motion @ to_world) for agents, motion in motions)
    rigidity_class, reason, stress, bent = class_reason_stress_and_shape(frame, within)
    return Rigidity(
        agents=n,
        edges=e,
        dimension=d,
        space=space,
        rank=frame.rank,
        reachable=full_rank(n, d),
        needed=full_rank(n, space),
        redundant=frame.redundant_edges(),
        spare=frame.jointly_removable_edges(),
        flexes=flexes,
        index=_least_singular_value(frame, masses),
        rigidity_class=rigidity_class,
        reason=reason,
        stress=stress,
        deformed=None if bent is None else bent @ to_world + p.mean(axis=0),
        within=within,
    )


def full_rank(n: int, d: int) -> int:
    """Greatest number of independent distances of n points that span d dimensions: n d - d (d + 1) / 2 for n > d."""
    d = min(d, max(n - 1, 0))
    return n * d - d * (d + 1) // 2


def as_framework(slots: ArrayLike, edges: ArrayLike) -> tuple[Floats, Ints]:
    """Slots (N, 3) and edges (m, 2) as arrays; a ValueError if they are no framework."""
    p = np.asarray(slots, dtype=np.float64)
    if p.ndim != 2 or not len(p) or not 1 <= p.shape[1] <= 3:
        raise ValueError(f"slots must be (N, 3) [m] with N >= 1, not {p.shape}")
    if not np.isfinite(p).all():
        raise ValueError(f"slot {int(np.argwhere(~np.isfinite(p))[0, 0]) + 1} is not finite")
    p = np.pad(p, [(0, 0), (0, 3 - p.shape[1])])
    e = np.asarray(edges, dtype=np.int64).reshape(-1, 2)
    seen: dict[tuple[int, int], int] = {}
    for k, (i, j) in enumerate(e.tolist()):
        name = f"edge {k + 1}, agents {i + 1} and {j + 1},"
        if not (0 <= i < len(p) and 0 <= j < len(p)):
            raise ValueError(f"{name} names an agent that does not exist; there are {len(p)}")
        if i == j:
            raise ValueError(f"{name} joins an agent to itself")
        first = seen.setdefault((min(i, j), max(i, j)), k)
        if first != k:
            raise ValueError(f"{name} repeats edge {first + 1}")
    length = np.linalg.norm(p[e[:, 0]] - p[e[:, 1]], axis=1)
    short = np.flatnonzero(length <= 1e-9 * np.abs(p - p.mean(axis=0)).max())
    if len(short):
        i, j = e[short[0]] + 1
        raise ValueError(f"edge {short[0] + 1} joins agents {i} and {j}, whose slots coincide")
    return p, e


def flatten_points(p: Floats, space: int) -> tuple[Floats, Floats]:
    """Points (N, space) about their centre, exactly flat, in axes (3, 3) of which those of the shape come first.

    Raises
    ------
    ValueError
        The dimension is not 1, 2 or 3, or the shape does not fit into it.
    """
    if not isinstance(space, int | np.integer) or not 1 <= space <= 3:
        raise ValueError(f"dimension must be 1, 2 or 3, not {space!r}")
    d = distance_geometry.dimension(p)
    if d > space:
        raise ValueError(f"a shape of dimension {d} does not fit into a {WHERE[space]}")
    x = p - p.mean(axis=0)
    axes = np.eye(3) if d == 3 else np.linalg.svd(x, full_matrices=True)[2]
    return np.pad(x @ axes[:d].T, [(0, 0), (0, space - d)]), axes


def _least_singular_value(frame: Framework, masses: ArrayLike | None) -> float:
    if masses is None:
        return float(frame.s[-1]) if frame.rank else np.nan
    m = np.asarray(masses, dtype=np.float64)
    if m.shape != (len(frame.p),) or not (m > 0).all() or not np.isfinite(m).all():
        raise ValueError(f"masses must be {len(frame.p)} numbers > 0 [kg]")
    if not frame.rank or (m == m[0]).all():
        return _least_singular_value(frame, None)
    J = jacobian(frame.p, frame.edges)
    weighted = J * np.repeat(np.sqrt(m.mean() / m), frame.p.shape[1])
    return float(np.linalg.svd(weighted, compute_uv=False)[frame.rank - 1])


def class_reason_stress_and_shape(
    frame: Framework, within: Rigidity | None = None
) -> tuple[RigidityClass, str, Floats | None, Floats | None]:
    """Class, reason, blocking stress, deformed shape."""
    k = frame.flexes.shape[1]
    if k == 0:
        reason = "every motion changes a distance"
        if frame.rank and frame.s[-1] < _BARELY:
            reason += f", but one motion hardly does (index {frame.s[-1]:.1e}): expect large forces"
        return RigidityClass.INFINITESIMALLY_RIGID, reason, None, None
    if within is not None and within.rigidity_class is RigidityClass.FLEXIBLE:
        reason = f"flexible already within its own {WHERE[within.dimension]}: {within.reason}"
        return RigidityClass.FLEXIBLE, reason, None, None
    free = f"{k} motion{'s' * (k != 1)} free"
    if frame.rank == _generic_rank(frame):
        reason = (
            f"{free}, and {frame.rank} is the greatest rank that these edges have at any "
            "positions, so the motion is finite (Asimow and Roth)"
        )
        return RigidityClass.FLEXIBLE, reason, None, None
    energy = StressEnergy(frame)
    stress, open_flexes, none_exists = blocking_stress(energy)
    if stress is not None:
        reason = f"{free} to first order; a self-stress blocks all of them"
        return RigidityClass.PRESTRESS_STABLE, reason, stress, None
    bent, goes_on = flexed_points_and_second_order(StressEnergy(frame, frame.flexes @ open_flexes))
    if bent is not None:
        reason = "a finite motion that keeps all distances was found and followed"
        return RigidityClass.FLEXIBLE, reason, None, bent
    blocked = "no self-stress blocks all of them" if none_exists else "no blocking stress was found"
    extends = "one extends to second order, but could not be followed further"
    if not goes_on:
        extends = (
            "none was found that extends to second order, so the shape is probably rigid, but soft"
        )
    reason = f"{free} to first order; {blocked}; {extends}"
    return RigidityClass.UNDECIDED, reason, None, None


def _generic_rank(frame: Framework) -> int:
    """Greatest rank of J over all positions of the agents; random positions have it almost surely."""
    if frame.stress_dimension == 0:
        return frame.rank
    random = np.random.default_rng(1).normal(size=frame.p.shape)
    return Framework(random, frame.edges).rank
