"""The greatest values of polynomials in continuous time, by their control points."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import comb
from typing import NamedTuple

import numpy as np

from rigidfleet.typing import Floats, Ints

#: Sizes (...) of vectors (..., 3), by the direction in which they count; all are convex.
SIZES: dict[str, Callable[[Floats], Floats]] = {
    "": lambda x: np.linalg.norm(x, axis=-1),
    "horizontal": lambda x: np.hypot(x[..., 0], x[..., 1]),
    "vertical": lambda x: np.abs(x[..., 2]),
}
#: Relative accuracy of a greatest value, and the most halvings of a piece.
_CLOSE, _HALVINGS = 1e-10, 50


@cache
def _halving_matrices(powers: int) -> Floats:
    """Matrices (2, P, P) from the control points of a piece to those of its first and of its second half."""
    first = np.array([[comb(i, k) / 2.0**i for k in range(powers)] for i in range(powers)])
    return np.stack([first, first[::-1, ::-1]])


class Greatest(NamedTuple):
    """A greatest value, the curve that has it, and where on that curve, from 0 to 1."""

    value: float
    curve: int
    place: float


#: A value (M,) that each of some curves reaches, where, from 0 to 1, and an upper bound (M,) of what it reaches. They
#: follow from control points (M, C, P) and the curves' numbers (M,).
Measured = tuple[Floats, Floats, Floats]
Measure = Callable[[Floats, Ints], Measured]


def greatest_convex_value(points: Floats, size: Callable[[Floats], Floats]) -> Greatest:
    """Greatest value of a convex function over curves with control points (M, 3, P), to 1e-10 of the value.

    ``size`` maps (..., 3) to (...). A curve lies within the hull of its control points, where a convex function is
    greatest at one of them.
    """

    def measure_size(points: Floats, _: Ints) -> Measured:
        sizes = size(np.moveaxis(points, -1, 1))  # (M, P)
        ends = sizes[:, [0, -1]]
        return ends.max(axis=1), ends.argmax(axis=1).astype(float), sizes.max(axis=1)

    return greatest_curve_measure(points, measure_size, lambda best: _CLOSE * max(abs(best), 1e-3))


def greatest_curve_measure(
    points: Floats, measure: Measure, close: Callable[[float], float], least: float = -np.inf
) -> Greatest:
    """Greatest value that curves with control points (M, C, P) reach by a measure.

    Curves that may reach it are halved until their bounds are no more than ``close`` (of the best value so far) above
    it. What is not above ``least`` is not searched: then there is no curve, -1.
    """
    who, start, width = np.arange(len(points)), np.zeros(len(points)), 1.0
    best = Greatest(least, -1, 0.0)
    halving = _halving_matrices(points.shape[-1])
    for _ in range(_HALVINGS):
        if not len(who):
            break
        values, places, bound = measure(points, who)
        k = int(values.argmax())
        if values[k] > best.value:
            best = Greatest(float(values[k]), int(who[k]), float(start[k] + places[k] * width))
        open_ = bound > best.value + close(best.value)
        points = np.einsum("hij,maj->hmai", halving, points[open_]).reshape(-1, *points.shape[1:])
        width *= 0.5
        who = np.tile(who[open_], 2)
        start = np.concatenate([start[open_], start[open_] + width])
    return best
