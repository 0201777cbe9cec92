"""Assignment of agents to slots."""

from __future__ import annotations

from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.math.rigid_body import centred, kabsch
from rigidfleet.typing import Floats, Ints

#: Greatest number of points whose distances are all compared, and of orders of slots that are all tried. This is
#: faster than importing a better algorithm.
_TRIED = 6


class Assigned(NamedTuple):
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
    p, q = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    n = len(p)
    r = np.zeros(n) if radius is None else np.asarray(radius, dtype=np.float64)
    best = np.inf, (0, 0), 0.0
    rows = max(1, _PAIRS // n)
    for first in range(0, n - 1, rows):
        i = np.arange(first, min(first + rows, n - 1))
        x = p[i, None] - p[first + 1 :]
        y = q[i, None] - q[first + 1 :] - x
        # Nearest point to zero of the segment from x to x + y.
        xy, yy = (x * y).sum(axis=2), (y * y).sum(axis=2)
        s = np.clip(-xy / np.maximum(yy, 1e-300), 0.0, 1.0)
        separation = np.linalg.norm(x + s[..., None] * y, axis=2) - r[i, None] - r[first + 1 :]
        separation[np.tri(*separation.shape, -1, dtype=np.bool_)] = np.inf  # each pair once
        k, j = np.unravel_index(int(separation.argmin()), separation.shape)
        if separation[k, j] < best[0]:
            best = float(separation[k, j]), (int(i[k]), first + 1 + int(j)), float(s[k, j])
    return best


def assigned(
    start: ArrayLike,
    slots: ArrayLike,
    *,
    turn: ArrayLike | None = None,
    radius: ArrayLike | None = None,
) -> Assigned:
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

    The shortest assignment has the least sum of squares for the given rotation. Without one, several attitudes are
    tried: slots are assigned and rotated to the agents (Kabsch) in turns, until nothing changes. The safest assignment
    has the greatest distance between surfaces among the shortest one, similar ones whose rotation differs from the
    given one, and the given order. Among nearly equal ones the shorter is taken, and it never has less distance than
    the shortest. The given order is kept if none is better. For many agents fewer attitudes are tried: two assignments
    in all from some 1,000 agents on.
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
    separation = {id(o): closest_approach(p, q[o.order] @ o.turn.T, radius)[0] for o in options}
    safe = [o for o in options if separation[id(o)] >= separation[id(shortest)]]
    return min(safe, key=lambda o: (-round(separation[id(o)], 2), *worth(o)))


#: Number of pairs processed together; work on assignments, N^3 each, of some seconds.
_PAIRS, _WORK = 200_000, 2e9


#: Greatest number of assignments from one attitude.
_ROUNDS = 20


def _nearest_slots(p: Floats, q: Floats) -> Ints:
    """Order (N,) of slots q (N, 3) with the least sum of squared distances from p."""
    near = p @ q.T  # |p|^2 + |q|^2 is the same for every order
    n = len(p)
    if n <= _TRIED:
        orders = np.array(list(permutations(range(n))), dtype=np.int64)
        return orders[near[np.arange(n), orders].sum(axis=1).argmax()]
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment(-near)[1]


def _settled(p: Floats, q: Floats, turn: Floats, most: int) -> tuple[Assigned, int]:
    """Assign slots q (N, 3) to agents p and rotate them onto the agents, in turns, until nothing changes.

    Each step reduces the same sum of squares; the last is an assignment. Also return their number, at most ``most``.
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
    """The 24 rotations of a cube, as attitudes to start from."""
    turns = []
    for axes in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.eye(3)[list(axes)] * np.array(signs)[:, None]
            if np.linalg.det(R) > 0:
                turns.append(R)
    return turns
