"""The greatest values of polynomials in continuous time, by their control points."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import comb
from typing import NamedTuple

import numpy as np

from rigidfleet.typing import Floats

#: Sizes (...) of vectors (..., 3), by the direction in which they count; all are convex.
SIZES: dict[str, Callable[[Floats], Floats]] = {
    "": lambda x: np.linalg.norm(x, axis=-1),
    "horizontal": lambda x: np.hypot(x[..., 0], x[..., 1]),
    "vertical": lambda x: np.abs(x[..., 2]),
}
#: Relative accuracy of a greatest value, and the most halvings of a piece.
_CLOSE, _HALVINGS = 1e-10, 50


@cache
def _halving(powers: int) -> Floats:
    """Matrices (2, P, P) from the control points of a piece to those of its first and of its second half."""
    first = np.array([[comb(i, k) / 2.0**i for k in range(powers)] for i in range(powers)])
    return np.stack([first, first[::-1, ::-1]])


class Greatest(NamedTuple):
    """A greatest value, the curve that has it, and where on that curve, from 0 to 1."""

    value: float
    curve: int
    place: float


def greatest(points: Floats, size: Callable[[Floats], Floats]) -> Greatest:
    """Greatest value of a convex function over curves with control points (M, 3, P), to 1e-10 of the value.

    ``size`` maps (..., 3) to (...). A curve lies within the hull of its control points, where a convex function is
    greatest at one of them. Curves that may have the greatest value are halved until their hulls promise no more.
    """
    who, start, width = np.arange(len(points)), np.zeros(len(points)), 1.0
    best = Greatest(-np.inf, -1, 0.0)
    halving = _halving(points.shape[-1])
    for _ in range(_HALVINGS):
        sizes = size(np.moveaxis(points, -1, 1))  # (M, P)
        ends = sizes[:, [0, -1]]
        if len(ends) and ends.max() > best.value:
            k, end = divmod(int(ends.argmax()), 2)
            best = Greatest(float(ends[k, end]), int(who[k]), float(start[k] + end * width))
        bound = sizes.max(axis=1) if len(sizes) else np.zeros(0)
        open_ = bound > best.value + _CLOSE * max(abs(best.value), 1e-3)
        if not open_.any():
            break
        points = np.einsum("hij,maj->hmai", halving, points[open_]).reshape(-1, *points.shape[1:])
        width *= 0.5
        who = np.tile(who[open_], 2)
        start = np.concatenate([start[open_], start[open_] + width])
    return best
