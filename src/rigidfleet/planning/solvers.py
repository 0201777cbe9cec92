"""Choose the method that solves for a formation's constraint force, and prepare it before a flight.

Small systems are solved densely. Under the exact law, if each agent is joined to three before it, two passes over the
agents suffice (`rigidfleet.kernel.elimination`). Other large systems are solved on the vertex graph
(`rigidfleet.kernel.block_cholesky`). Nothing here integrates or compiles.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from rigidfleet.typing import Floats, Ints

Method = Literal["dense", "elimination", "sparse"]

#: Least numbers of equations for which the vertex graph, and elimination, are faster than a dense factor.
FROM_SPARSE, FROM_ELIMINATION = 180, 60
#: Greatest number of equations of a dense solve; beyond it, one evaluation takes seconds.
MOST_DENSE = 2000
#: Name of each method in reports.
METHOD_WORDS: dict[Method, str] = {
    "dense": "dense factor",
    "elimination": "elimination by 3x3 solves",
    "sparse": "conjugate gradients on the vertex graph, with a kept factor",
}


def system_size(n: int, m: int, solver: str) -> int:
    """Size of the dense system of ``m`` edges between ``n`` agents under a law."""
    return min(m, 3 * n) if solver == "iterated" else m


def choose_method(n: int, edges: Ints, solver: str) -> Method:
    """The method for ``n`` agents, edges (m, 2) and a law (`Constraint.solver`).

    Laws that need eigenvalues ("spectral", "pinv") are solved densely at any size.
    """
    size = system_size(n, len(edges), solver)
    if solver == "exact" and size >= FROM_ELIMINATION and henneberg_steps(n, edges) is not None:
        return "elimination"
    return "sparse" if solver in ("iterated", "exact") and size >= FROM_SPARSE else "dense"


def henneberg_steps(n: int, edges: Ints) -> Ints | None:
    """An order (n, 4) in which each agent is joined to three before it: agent, its edges (-1: none).

    The first three agents have none, one and two. None if there is no such order. Agents with three remaining edges
    are removed one after the other; in whatever order, this finds a sequence if there is one.
    """
    if n < 3 or len(edges) != 3 * n - 6:
        return None
    later = edges.max(axis=1)
    if (np.bincount(later, minlength=n) == np.minimum(np.arange(n), 3)).all():
        # In the agents' own order, so that neighbours in the sequence are neighbours in memory.
        steps = np.full((n, 4), -1)
        steps[:, 0] = np.arange(n)
        mine = np.argsort(later, kind="stable")
        steps[1, 1], steps[2, 1:3], steps[3:, 1:] = mine[0], mine[1:3], mine[3:].reshape(-1, 3)
        return steps
    ends = np.concatenate([edges[:, 0], edges[:, 1]])
    by_agent = np.argsort(ends, kind="stable") % len(edges)
    start = np.searchsorted(np.sort(ends), np.arange(n + 1)).tolist()
    meets, pairs = by_agent.tolist(), edges.tolist()
    degree = np.bincount(ends, minlength=n).tolist()
    gone = [False] * len(edges)
    steps = np.full((n, 4), -1)
    ready = [i for i in range(n) if degree[i] <= 3]
    at, taken = n, [False] * n
    while ready:
        # In waves, and by number within each wave, so that near agents stay near in memory.
        wave, ready = sorted(ready, reverse=True), []
        for i in wave:
            if degree[i] > 3 or taken[i]:
                continue
            mine = [k for k in meets[start[i] : start[i + 1]] if not gone[k]]
            if len(mine) != min(3, at - 1):
                return None
            at -= 1
            taken[i] = True
            steps[at, 0], steps[at, 1 : 1 + len(mine)] = i, mine
            for k in mine:
                gone[k] = True
                j = pairs[k][1] if pairs[k][0] == i else pairs[k][0]
                degree[j] -= 1
                if degree[j] == 3 or (degree[j] < 3 and not taken[j]):
                    ready.append(j)
    return steps if at == 0 else None


def agent_dissection_order(points: Floats, edges: Ints, leaf: int = 16) -> Ints:
    """Order (N,) to eliminate agents in: geometric nested dissection (George, 1973) of points (N, 3).

    Recursively: both halves across the longest extent, then the agents that separate them. Parts of ``leaf`` or fewer
    agents are not divided.
    """
    n = len(points)
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    start = np.searchsorted(both[:, 0], np.arange(n + 1))
    other = both[:, 1]
    beyond = np.zeros(n, dtype=bool)
    order: list[Ints] = []  # from the last agent eliminated to the first
    todo = [np.arange(n)]
    while todo:
        some = todo.pop()
        x = points[some]
        axis = int(np.ptp(x, axis=0).argmax()) if len(some) else 0
        far = x[:, axis] > np.median(x[:, axis]) if len(some) > leaf else np.zeros(0, bool)
        if not far.any():
            order.append(some[::-1])
            continue
        near, far_half = some[~far], some[far]
        beyond[far_half] = True
        counts = start[near + 1] - start[near]
        of = np.repeat(np.arange(len(near)), counts)
        at = np.arange(len(of)) - np.repeat(np.cumsum(counts) - counts, counts) + start[near][of]
        parting = np.zeros(len(near), dtype=bool)
        parting[of[beyond[other[at]]]] = True
        beyond[far_half] = False
        order.append(near[parting][::-1])
        todo += [near[~parting], far_half]
    return np.concatenate(order)[::-1].copy() if order else np.zeros(0, np.int64)
