"""First-order rigidity: the Jacobian of the distances, its rank, stresses and free motions.

A framework is points joined by bars: slots and edges. Row k of its Jacobian J holds the unit vector u of edge
k = (i, j) at i and -u at j, as in the constraint force (theory, section 1); J v are the rates of the lengths.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rigidfleet.formation.distance_geometry import distances
from rigidfleet.math.constraint_jacobian import jacobian
from rigidfleet.math.rigid_body import rigid_motions
from rigidfleet.typing import Floats, Ints

#: Singular values below this times the largest are zero: points rounded to seven digits count as flat.
ZERO = 1e-7

#: Speed below which an agent counts as at rest in a flex whose fastest agent has speed 1.
_STILL = 1e-5
#: Relative difference below which two lengths or strengths are the same: rounding must not choose between them.
_ALIKE = 1e-6


class Flex(NamedTuple):
    """A motion that changes no distance of an edge to first order, up to a rigid motion of all agents."""

    agents: tuple[int, ...]
    """Agents that move; the others are at rest."""
    motion: Floats
    """Velocities (N, 3), the fastest of 1 m/s."""


class Framework:
    """Points p (N, d) joined by edges (m, 2), with the singular value decomposition of J.

    Attributes
    ----------
    span : (m, rank) orthonormal basis of the range of J; self-stresses are orthogonal to it
    s : (rank,) non-zero singular values of J, descending
    null : (N d, .) orthonormal basis of all motions that change no distance, including rigid ones
    """

    def __init__(self, p: Floats, edges: Ints) -> None:
        self.p, self.edges = p, edges
        J = jacobian(p, edges)
        tall = len(edges) > p.size
        u, s, vt = np.linalg.svd(np.linalg.qr(J, mode="r") if tall else J)
        rank = int(np.count_nonzero(s > ZERO * s.max(initial=0.0)))
        self.s, self.null = s[:rank], vt[rank:].T
        self.span = (J @ vt[:rank].T) / self.s if tall else u[:, :rank]

    @property
    def rank(self) -> int:
        """Rank of J."""
        return len(self.s)

    @property
    def stress_dimension(self) -> int:
        """Dimension of the space of self-stresses, which is the number of surplus edges."""
        return len(self.edges) - self.rank

    @cached_property
    def lengths(self) -> Floats:
        """Lengths (m,) of the edges [m]."""
        return distances(self.p, self.edges)

    @cached_property
    def rigid_basis(self) -> Floats:
        """Rigid motions (N d, t), orthonormal."""
        return rigid_motions(self.p)

    @cached_property
    def flexes(self) -> Floats:
        """Motions (N d, k), orthonormal, that change no distance and have no rigid part."""
        k = self.null.shape[1] - self.rigid_basis.shape[1]
        if k <= 0:
            return np.zeros((self.p.size, 0))
        u = np.linalg.svd(self.null.T @ self.rigid_basis)[0]
        return self.null @ u[:, -k:]

    def redundant_edges(self) -> Ints:
        """Edges of which any single one could be removed without loss of rank: those that some self-stress loads."""
        return np.flatnonzero(1 - (self.span**2).sum(axis=1) > ZERO)

    def jointly_removable_edges(self) -> Ints:
        """Edges that could all be removed at once without loss of rank, long ones first."""
        if self.stress_dimension == 0:
            return np.zeros(0, dtype=np.int64)
        # Pivoted Cholesky of the rows' Gram matrix, without SciPy, for which a check would wait: the row with the
        # largest remainder comes next. Weights make short edges come first, and the chosen rows still span the range.
        rows, kept = self.span * (self.lengths.min() / self.lengths)[:, None], list[int]()
        L, rest = np.zeros_like(rows), (rows * rows).sum(axis=1)
        for n in range(self.rank):
            kept.append(int(rest.argmax()))
            L[:, n] = rows @ rows[kept[n]] - L[:, :n] @ L[kept[n], :n]
            L[:, n] /= np.sqrt(rest[kept[n]])
            rest -= L[:, n] ** 2
            rest[kept] = 0.0
        return np.setdiff1d(np.arange(len(rest)), kept)


def localised_flexes(frame: Framework) -> list[tuple[tuple[int, ...], Floats]]:
    """A basis of the flexes, each moving few agents: [(agents, motion (N, d))], fewest first.

    A flex plus any rigid motion is the same flex, so which agents are at rest is a choice. Candidates are the motions
    of single agents that their edges leave free and, for each agent, the motion with the least sum of speeds in which
    it moves (by iteratively reweighted least squares; this sum favours motions of few agents). The greedy choice among
    all candidates, fewest agents first, is the basis with the least total number of moving agents.
    """
    F = frame.flexes
    chosen: list[Floats] = []
    parts = np.zeros((F.shape[1], 0))  # of the chosen motions in the flexes, orthonormal
    for motion in _candidate_flexes(frame) if F.size else ():
        part = F.T @ motion.ravel()
        rest = part - parts @ (parts.T @ part)
        rest -= parts @ (parts.T @ rest)
        if np.linalg.norm(rest) > 1e-4 * np.linalg.norm(motion):
            parts = np.column_stack([parts, rest / np.linalg.norm(rest)])
            chosen.append(motion / np.linalg.norm(motion, axis=1).max())
        if len(chosen) == F.shape[1]:
            break
    return _subtract_smaller_motions(chosen)


def _candidate_flexes(frame: Framework) -> Iterator[Floats]:
    """Flexes (N, d) among which there is a basis, those that move few agents first."""
    yield from _motions_of_single_agents(frame)
    few = few_agent_flexes(frame.flexes, frame.rigid_basis, len(frame.p))
    yield from sorted(few, key=_number_of_movers)
    yield from frame.flexes.T.reshape(-1, *frame.p.shape)


def _number_of_movers(motion: Floats) -> int:
    return int(np.count_nonzero(motion.any(axis=1)))


def _subtract_smaller_motions(motions: list[Floats]) -> list[tuple[tuple[int, ...], Floats]]:
    """Motions (N, d) with their moving agents, fewest first, without parts that fewer agents already have."""
    out: list[tuple[tuple[int, ...], Floats]] = []
    for motion in sorted(motions, key=_number_of_movers):
        f, moves = motion.copy(), set(np.flatnonzero(np.any(motion, axis=1)).tolist())
        for who, g in out:
            if moves.issuperset(who):
                f -= (f * g).sum() * g
        f[np.abs(f) <= ZERO * np.abs(motion).max()] = 0.0
        out.append((tuple(np.flatnonzero(f.any(axis=1)).tolist()), f / np.linalg.norm(f)))
    return sorted(out, key=lambda flex: (len(flex[0]), flex[0]))


def _motions_of_single_agents(frame: Framework) -> Iterator[Floats]:
    """Motions of one agent that all its edges leave free; agents with few edges come first."""
    n, d = frame.p.shape
    J = jacobian(frame.p, frame.edges).reshape(-1, n, d)
    degree = np.bincount(frame.edges.ravel(), minlength=n)
    for i in np.argsort(degree, kind="stable"):
        _, s, vt = np.linalg.svd(J[(frame.edges == i).any(axis=1), i], full_matrices=True)
        for direction in vt[np.count_nonzero(s > ZERO) :]:
            motion = np.zeros((n, d))
            motion[i] = direction
            yield motion


def few_agent_flexes(flexes: Floats, rigid: Floats, n: int, most: int = 1 << 30) -> list[Floats]:
    """Flexes (N, d) that move few agents: for each agent, the one with the least sum of speeds in which it moves.

    It moves in the direction in which flexes can move it most; if there are several, in each of them.

    Parameters
    ----------
    flexes, rigid : (N d, .) orthonormal; any rigid motion may be added to a flex
    most : greatest number of agents considered
    """
    V = np.column_stack([flexes, rigid])
    blocks = V.reshape(n, len(V) // n, -1)
    part, strength, _ = np.linalg.svd(blocks[:, :, : flexes.shape[1]], full_matrices=False)
    # Reweighting costs N d k^2 per step; with many agents and flexes, some are skipped to stay below a second.
    most = min(most, max(8, int(1.5e9 / (20.0 * V.shape[0] * V.shape[1] ** 2))))
    seeds = np.flatnonzero(strength[:, 0] > _STILL)
    motions = []
    for i in seeds[:: max(1, -(-len(seeds) // most))]:
        for way in _basis_near_axes(part[i][:, strength[i] > (1.0 - _ALIKE) * strength[i, 0]]):
            motions.append(_stop_slow_agents(_motion_of_least_speed_sum(way @ blocks[i], V, n), V))
    return motions


def _motion_of_least_speed_sum(normaliser: Floats, V: Floats, n: int) -> Floats:
    """Motion V a (n, d) with ``normaliser`` a = 1 of the least sum of speeds: iteratively reweighted least squares."""
    speed = np.ones(n)
    for sharp in np.logspace(0, -7, 20):
        weight = np.repeat(1 / (speed + sharp), len(V) // n)
        a = np.linalg.solve(V.T @ (weight[:, None] * V), normaliser)
        motion = (V @ (a / (normaliser @ a))).reshape(n, -1)
        speed = np.linalg.norm(motion, axis=1)
    return motion


def _basis_near_axes(U: Floats) -> list[Floats]:
    """A basis of the span of U (d, k), orthonormal, as near to the axes as it can be: the same on any machine."""
    rest, basis = U @ U.T, []
    for _ in range(U.shape[1]):
        length = np.linalg.norm(rest, axis=1)
        first = int(np.argmax(length > (1.0 - _ALIKE) * length.max()))  # of equal ones
        way = rest[first]
        basis.append(way / np.linalg.norm(way))
        rest = rest - np.outer(rest @ basis[-1], basis[-1])
    return basis


def _stop_slow_agents(motion: Floats, V: Floats) -> Floats:
    """The nearest motion in the span of V in which nearly resting agents are at rest."""
    n = len(motion)
    speed = np.linalg.norm(motion, axis=1)
    still = speed <= _STILL * speed.max()
    _, s, vt = np.linalg.svd(V.reshape(n, -1, V.shape[1])[still].reshape(-1, V.shape[1]))
    free = vt[np.count_nonzero(s > ZERO) :].T
    if not free.size:
        return motion
    near = (V @ (free @ (free.T @ (V.T @ motion.ravel())))).reshape(motion.shape)
    return np.where(still[:, None], 0.0, near)
