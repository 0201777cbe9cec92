"""Assignment of agents to slots."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet._common.threads import single_blas_thread
from rigidfleet.math.rigid_body import centred, kabsch
from rigidfleet.typing import Floats, Ints

#: Greatest number of points whose distances are all compared, and of orders of slots that are all tried. This is
#: faster than importing a better algorithm.
_TRIED = 6


class AssignedSlots(NamedTuple):
    """The slot of each agent, and the rotation of the slots during the blend."""

    order: Ints  # (N,) slot of each agent, from 0
    turn: Floats  # (3, 3) rotation of the slots; the blend must use this rotation and no other


def closest_approach(
    start: ArrayLike, end: ArrayLike, radius: ArrayLike | None = None
) -> tuple[float, tuple[int, int], float]:
    """Least distance between agents that move straight from start to end (N, 3) [m], all in step.

    Exact, in closed form, over all pairs and the whole path; memory grows linearly with N.

    Returns
    -------
    separation : distance between surfaces [m] (between centres if no radii (N,) are given); infinite for one agent
    pair : the two agents, from 0
    share : share of the path at which they are nearest, in [0, 1]
    """
    best = np.inf, (0, 0), 0.0
    for i, separation, s in _approaches_to_later_agents(start, end, radius):
        k, j = np.unravel_index(int(separation.argmin()), separation.shape)
        if separation[k, j] < best[0]:
            best = float(separation[k, j]), (int(i[k]), int(i[0] + 1 + j)), float(s[k, j])
    return best


def pairs_nearer_than(distance: float, start: ArrayLike, end: ArrayLike) -> Ints:
    """Pairs (m, 2), i < j, of agents that come nearer than a distance [m] on straight ways in step (N, 3) [m]."""
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for i, separation, _ in _approaches_to_later_agents(start, end, None):
        k, j = np.nonzero(separation < distance)
        pairs.append(np.column_stack([i[k], i[0] + 1 + j]))
    return np.concatenate(pairs)


def _approaches_to_later_agents(
    start: ArrayLike, end: ArrayLike, radius: ArrayLike | None
) -> Iterator[tuple[Ints, Floats, Floats]]:
    """Of some agents (k,), in turn all: least separation from each later one (k, m), and the share of the way there.

    Column j belongs to agent i[0] + 1 + j. The separation of pairs that occur in another place is infinite.
    """
    p, q = (np.asarray(x, dtype=np.float64).T.copy() for x in (start, end))
    n, first = p.shape[1], 0
    r = np.zeros(n) if radius is None else np.asarray(radius, dtype=np.float64)
    while first < n - 1:
        i = np.arange(first, min(first + max(1, _CACHED // (n - first)), n - 1))
        x = p[:, i, None] - p[:, None, first + 1 :]
        y = q[:, i, None] - q[:, None, first + 1 :]
        y -= x
        # Nearest point to zero of the segment from x to x + y.
        s = (x * y).sum(axis=0)
        s /= -np.maximum((y * y).sum(axis=0), 1e-300)
        np.clip(s, 0.0, 1.0, out=s)
        y *= s
        y += x
        separation = np.sqrt((y * y).sum(axis=0))
        separation -= r[i, None] + r[first + 1 :]
        separation[np.tri(*separation.shape, -1, dtype=np.bool_)] = np.inf  # each pair once
        yield i, separation, s
        first = int(i[-1]) + 1


def assign_slots(
    start: ArrayLike,
    slots: ArrayLike,
    *,
    turn: ArrayLike | None = None,
    radius: ArrayLike | None = None,
    metric: ArrayLike | None = None,
) -> AssignedSlots:
    """Assign slots (N, 3) to agents at start (N, 3) [m], and choose the rotation of the slots during the blend.

    The rotation is chosen first; the order then has the least sum of squared distances to the rotated slots. On
    straight paths in step, two agents then come no nearer than D / sqrt(2), where D is the least distance of both
    shapes, if the blend uses the rotation returned. Proof: if i and j exchanged their slots, the sum of squares would
    not decrease, so x . y >= 0 for x = p_i - p_j and y = q_i - q_j (slots as rotated). Therefore
    |(1 - s) x + s y|^2 >= (1 - s)^2 |x|^2 + s^2 |y|^2 >= D^2 / 2. All agents have equal weight, whatever their masses,
    because the proof does not hold for squares weighted by mass. The centres do not matter, as x and y are differences.

    Parameters
    ----------
    turn : (3, 3) prescribed rotation of the slots; any rotation if it is not given
    radius : (N,) [m] asks for the safest assignment instead of the shortest
    metric : (3, 3) symmetric M with which distances are |M x|, with a prescribed turn only; see `downwash_metric`. The
        bound then holds in this metric: the proof is the same for M x and M y

    The shortest assignment has the least sum of squares for the given rotation. Without one, several attitudes are
    tried: slots are assigned and rotated to the agents (Kabsch) in turns, until nothing changes. The safest assignment
    has the greatest distance between surfaces among the shortest one, similar ones whose rotation differs from the
    given one, and the given order. Among nearly equal ones the shorter is taken, and it never has less distance than
    the shortest. The given order is kept if none is better. For many agents fewer attitudes are tried: two assignments
    in all from some 1,000 agents on.

    Raises
    ------
    ValueError
        There is a metric, but no turn, or a radius.
    """
    p, q = centred(start), centred(slots)
    n = len(p)
    if metric is not None:
        if turn is None or radius is not None:
            raise ValueError("a metric needs a prescribed turn, and no radius")
        fixed, M = (np.asarray(x, dtype=np.float64) for x in (turn, metric))
        return AssignedSlots(least_squares_assignment(p @ M, q @ fixed.T @ M), fixed)
    own_order, scale = np.arange(n), float((p**2).sum() + (q**2).sum())
    fits = AssignedSlots(own_order, kabsch(p, q))
    options = [fits]
    if turn is not None:
        fixed = np.asarray(turn, dtype=np.float64)
        short = AssignedSlots(least_squares_assignment(p, q @ fixed.T), fixed)
        options = [short, AssignedSlots(own_order, fixed)] + ([] if radius is None else [fits])
    if turn is None or radius is not None:
        left = max(1, int(_WORK / n**3))
        for attitude in [fits.turn, *_rotations_of_a_cube()]:
            if left > 0:
                option, used = _assign_and_turn(p, q, attitude, min(left, _ROUNDS))
                options.append(option)
                left -= used

    def rank_of_option(option: AssignedSlots) -> tuple[float, bool, float]:
        to, swing = option.turn, 0.0
        if turn is not None:
            to, swing = fixed, float(np.linalg.norm(option.turn - fixed))
        squares = float(((q[option.order] @ to.T - p) ** 2).sum()) / max(scale, 1e-300)
        return round(squares, 12), bool((option.order != own_order).any()), swing

    straight = [o for o in options if turn is None or o.turn is fixed]
    shortest = min(straight, key=rank_of_option)
    if radius is None:
        return shortest
    separation = {id(o): closest_approach(p, q[o.order] @ o.turn.T, radius)[0] for o in options}
    safe = [o for o in options if separation[id(o)] >= separation[id(shortest)]]
    return min(safe, key=lambda o: (-round(separation[id(o)], 2), *rank_of_option(o)))


def downwash_metric(up: ArrayLike, ratio: float) -> Floats:
    """Metric (3, 3) in which distances along ``up`` (3,), a unit vector, count divided by a ratio >= 1 (downwash)."""
    u = np.asarray(up, dtype=np.float64)
    return np.eye(3) - (1.0 - 1.0 / ratio) * np.outer(u, u)


#: Number of pairs processed together, which then stay in the processor's cache.
_CACHED = 20_000
#: Work on assignments, N^3 each, of some seconds.
_WORK = 2e9
#: Greatest number of assignments from one attitude.
_ROUNDS = 20
#: Greatest number of agents for which the least sum of squares of all orders is found.
_LEAST = 1024
#: Greatest number of agents for which nobody waits for it.
_FEW = 100


def least_squares_assignment(p: Floats, q: Floats) -> Ints:
    """Order (N,) of slots q (N, Q) in which no two agents p (N, Q) reduce the sum of squares by an exchange.

    For up to `_LEAST` agents the sum is the least of all orders.
    """
    n = len(p)
    if n <= _TRIED:
        near = p @ q.T  # |p|^2 + |q|^2 is the same for every order
        orders = np.array(list(permutations(range(n))), dtype=np.int64)
        return orders[near[np.arange(n), orders].sum(axis=1).argmax()]
    if n > _LEAST:
        with single_blas_thread():
            return order_by_exchanges(p, q)
    from scipy.optimize import linear_sum_assignment

    if n <= _FEW:
        return linear_sum_assignment(-(p @ q.T))[1]
    # Squares of distances between centred places, less the least of each slot and then of each agent, have the same
    # best order, which is found in a fifth of the time. Of orders that are equally good, it may be another one.
    p, q = p - p.mean(axis=0), q - q.mean(axis=0)
    squares = 0.5 * (p**2).sum(axis=1, keepdims=True) - p @ q.T
    squares -= squares.min(axis=0)
    squares -= squares.min(axis=1, keepdims=True)
    return linear_sum_assignment(squares)[1]


#: Number of agents whose exchanges with all others are found together.
_TOGETHER = 64
#: A sum of squares counts as reduced beyond this share of the greatest squares.
_ROUNDING = 1e-12


def order_by_exchanges(p: Floats, q: Floats) -> Ints:
    """Order (N,) of slots q (N, 3) from which no exchange of two slots brings agents p (N, 3) nearer.

    If i and j exchange their slots, the sum of squared distances falls by -2 x . y, x = p_i - p_j, y = q_i - q_j.
    Exchanges of pairs with x . y < 0 therefore end, and leave x . y >= 0 for all pairs, up to rounding. Agents and
    slots that are halved along their longest axis again and again give an order from which few exchanges are left.
    """
    n, order = len(p), _order_by_halves(p, q)
    slots = q[order]
    least = -_ROUNDING * float((p**2).sum(axis=1).max() + (q**2).sum(axis=1).max())
    improved = True
    while improved:
        improved = False
        for first in range(0, n, _TOGETHER):
            i = np.arange(first, min(first + _TOGETHER, n))
            while len(i):
                own = np.einsum("ia,ia->i", p, slots)
                crossed = np.hstack([p[i], slots[i]]) @ np.hstack([slots, p]).T
                xy = own[i, None] + own - crossed
                j = xy.argmin(axis=1)
                gain = xy[np.arange(len(i)), j]
                bad = np.flatnonzero(gain < least)
                if not len(bad):
                    break
                improved = True
                bad = bad[np.argsort(gain[bad], kind="stable")]
                i, j = _disjoint_pairs(i[bad], j[bad])
                order[i], order[j] = order[j], order[i]
                slots = q[order]
                i = np.union1d(i, j[(j >= first) & (j < first + _TOGETHER)])
    return order


def _disjoint_pairs(i: Ints, j: Ints) -> tuple[Ints, Ints]:
    """Those of the pairs (i, j), from the first on, that share no agent."""
    taken: set[int] = set()
    kept = []
    for pair in zip(i.tolist(), j.tolist(), strict=True):
        if taken.isdisjoint(pair):
            taken.update(pair)
            kept.append(pair)
    one, other = np.array(kept, dtype=np.int64).T
    return one, other


def _order_by_halves(p: Floats, q: Floats) -> Ints:
    """Order (N,) of slots q (N, 3) for agents p (N, 3): both are halved along the longest axis until one is left."""
    order = np.empty(len(p), dtype=np.int64)
    left = [(np.arange(len(p)), np.arange(len(p)))]
    while left:
        i, j = left.pop()
        if len(i) == 1:
            order[i] = j
            continue
        axis, half = int((np.ptp(p[i], axis=0) + np.ptp(q[j], axis=0)).argmax()), len(i) // 2
        i, j = (k[np.argpartition(x[k, axis], half)] for k, x in ((i, p), (j, q)))
        left += [(i[:half], j[:half]), (i[half:], j[half:])]
    return order


def _assign_and_turn(p: Floats, q: Floats, turn: Floats, most: int) -> tuple[AssignedSlots, int]:
    """Assign slots q (N, 3) to agents p and rotate them onto the agents, in turns, until nothing changes.

    Each step reduces the same sum of squares; the last is an assignment. Also return their number, at most ``most``.
    """
    order = least_squares_assignment(p, q @ turn.T)
    for used in range(1, most):
        turned = kabsch(p, q[order])
        new = least_squares_assignment(p, q @ turned.T)
        if (new == order).all():
            return AssignedSlots(order, turned), used + 1
        order, turn = new, turned
    return AssignedSlots(order, turn), most


def _rotations_of_a_cube() -> list[Floats]:
    """The 24 rotations that a cube does not show, as attitudes to start from."""
    signs = [np.array(x)[:, None] for x in product((1.0, -1.0), repeat=3)]
    turns = [np.eye(3)[list(axes)] * s for axes, s in product(permutations(range(3)), signs)]
    return [R for R in turns if np.linalg.det(R) > 0]
