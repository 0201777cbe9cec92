"""Who takes which slot."""

from __future__ import annotations

from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.math.rigid_body import centred, kabsch
from rigidfleet.typing import Floats, Ints

#: Up to so many points distances are compared all with all, and up to so many orders of slots tried, which takes
#: less time than to import what does it better.
_TRIED = 6


class Assigned(NamedTuple):
    """Who takes which slot, and how the slots lie before those that the agents come from while they blend."""

    order: Ints  # (N,) slot of each agent, from 0
    turn: Floats  # (3, 3) rotation of the slots; they are blended as it turns them, and by no other


def nearest_way(
    start: ArrayLike, end: ArrayLike, radius: ArrayLike | None = None
) -> tuple[float, tuple[int, int], float]:
    """Least room between agents that go straight from start to end (N, 3) [m], all in step.

    Exact, in closed form, over all pairs and the whole way; memory grows with N alone.

    Returns
    -------
    room : between two surfaces [m] (between centres without radii (N,)); infinite for one agent
    pair : the two agents, from 0
    share : of the way at which they are nearest, in [0, 1]
    """
    p, q = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    n = len(p)
    r = np.zeros(n) if radius is None else np.asarray(radius, dtype=np.float64)
    best = np.inf, (0, 0), 0.0
    rows = max(1, _PAIRS // n)
    for first in range(0, n - 1, rows):
        i = np.arange(first, min(first + rows, n - 1))
        x = p[i, None] - p[first + 1 :]
        y = q[i, None] - q[first + 1 :] - x
        # Nearest on the way: a line from x to x + y past zero.
        xy, yy = (x * y).sum(axis=2), (y * y).sum(axis=2)
        s = np.clip(-xy / np.maximum(yy, 1e-300), 0.0, 1.0)
        room = np.linalg.norm(x + s[..., None] * y, axis=2) - r[i, None] - r[first + 1 :]
        room[np.tri(*room.shape, -1, dtype=np.bool_)] = np.inf  # each pair once
        k, j = np.unravel_index(int(room.argmin()), room.shape)
        if room[k, j] < best[0]:
            best = float(room[k, j]), (int(i[k]), first + 1 + int(j)), float(s[k, j])
    return best


def assigned(
    start: ArrayLike,
    slots: ArrayLike,
    *,
    turn: ArrayLike | None = None,
    radius: ArrayLike | None = None,
) -> Assigned:
    """Slots (N, 3) that agents at start (N, 3) [m] are to take, and how these are turned meanwhile.

    The turn is chosen first and the order last, by the least sum of squared ways to slots that are turned already:
    then two agents come no nearer than D / sqrt(2) on straight ways in step with each other, D the least distance
    of both shapes, as long as the turn flown is the one returned. For if i and j took each other's slots, the
    squares would grow or stay, which says x . y >= 0 for x = p_i - p_j and y = q_i - q_j, the slots as turned. So
    |(1 - s) x + s y|^2 >= (1 - s)^2 |x|^2 + s^2 |y|^2 >= D^2 / 2. Agents count alike here, whatever their masses:
    squares weighted by mass prove nothing. Nor do the centres matter, since x and y know none.

    Parameters
    ----------
    turn : (3, 3) the rotation of the slots in which they are to be reached; any will do where it is not given
    radius : (N,) [m] asks for the safest in place of the shortest

    The shortest has the least squares for the turn given; or else among some, found from several attitudes in turn
    by assigning the slots and turning them to the agents (Kabsch) until nothing changes. The safest has the most room
    between surfaces among the shortest, others of that kind, whose turn differs from the one given, and the order
    given; among all but equal ones the shorter is taken, and never less room than the shortest has. The order given is
    kept where nothing is better. Many agents try fewer attitudes: two assignments in all from some 1,000 on.
    """
    p, q = centred(start), centred(slots)
    n = len(p)
    given, scale = np.arange(n), float((p**2).sum() + (q**2).sum())
    fits = Assigned(given, kabsch(p, q))
    options = [fits]
    if turn is not None:
        fixed = np.asarray(turn, dtype=np.float64)
        short = Assigned(_nearest_slots(p, q @ fixed.T), fixed)
        options = [short, Assigned(given, fixed)] + ([] if radius is None else [fits])
    if turn is None or radius is not None:
        left = max(1, int(_WORK / n**3))
        for attitude in [fits.turn, *_attitudes()]:
            if left > 0:
                option, used = _settled(p, q, attitude, min(left, _ROUNDS))
                options.append(option)
                left -= used

    def worth(option: Assigned) -> tuple[float, bool, float]:
        to, swing = option.turn, 0.0
        if turn is not None:
            to, swing = fixed, float(np.linalg.norm(option.turn - fixed))
        squares = float(((q[option.order] @ to.T - p) ** 2).sum()) / max(scale, 1e-300)
        return round(squares, 12), bool((option.order != given).any()), swing

    straight = [o for o in options if turn is None or o.turn is fixed]
    shortest = min(straight, key=worth)
    if radius is None:
        return shortest
    room = {id(o): nearest_way(p, q[o.order] @ o.turn.T, radius)[0] for o in options}
    safe = [o for o in options if room[id(o)] >= room[id(shortest)]]
    return min(safe, key=lambda o: (-round(room[id(o)], 2), *worth(o)))


#: Pairs of agents that are looked at together; work on assignments, N^3 each, in some seconds.
_PAIRS, _WORK = 200_000, 2e9


#: From one attitude so many assignments at most.
_ROUNDS = 20


def _nearest_slots(p: Floats, q: Floats) -> Ints:
    """Of slots q (N, 3) those (N,) that make the sum of squared ways from p least."""
    near = p @ q.T  # |p|^2 + |q|^2 is the same for every order
    n = len(p)
    if n <= _TRIED:
        orders = np.array(list(permutations(range(n))), dtype=np.int64)
        return orders[near[np.arange(n), orders].sum(axis=1).argmax()]
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment(-near)[1]


def _settled(p: Floats, q: Floats, turn: Floats, most: int) -> tuple[Assigned, int]:
    """Slots q (N, 3) assigned to agents p and turned onto them in turns, until nothing changes.

    Each lessens the same sum of squares; the last is an assignment. Also how many there were, ``most`` at most.
    """
    order = _nearest_slots(p, q @ turn.T)
    for used in range(1, most):
        turned = kabsch(p, q[order])
        new = _nearest_slots(p, q @ turned.T)
        if (new == order).all():
            return Assigned(order, turned), used + 1
        order, turn = new, turned
    return Assigned(order, turn), most


def _attitudes() -> list[Floats]:
    """The 24 rotations of a cube: attitudes to start from."""
    turns = []
    for axes in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.eye(3)[list(axes)] * np.array(signs)[:, None]
            if np.linalg.det(R) > 0:
                turns.append(R)
    return turns
