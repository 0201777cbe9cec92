"""Where vehicles wait that a formation has no slots for."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.math import proximity
from rigidfleet.typing import Floats

#: Distance of the waiting vehicles from the formation, in distances of its nearest slots.
_AWAY = 2.0


def rest_places_beside(slots: ArrayLike, count: int) -> Floats:
    """Places (count, 3) [m] in two blocks left and right of slots (K, 3), along x, as far apart as the nearest slots.

    Each place on the right has one on the left, mirrored at the middle of the slots, so that the middle stays where it
    is; of an odd number, one is left over. A block is as deep and as high as the slots, and grows away from them.

    Raises
    ------
    ValueError
        There are fewer than two slots.
    """
    p = np.asarray(slots, dtype=np.float64)
    if len(p) < 2:
        raise ValueError("a single slot has no spacing")
    middle = p.mean(axis=0)
    off, step = p - middle, float(proximity.nearest(p).min())
    pairs = (count + 1) // 2
    rows = [_symmetric_places(off[:, axis], step) for axis in (1, 2)]
    y, z = (x.ravel() for x in np.meshgrid(*rows, indexing="ij"))
    columns = -(-pairs // len(y))
    x = np.abs(off[:, 0]).max() + step * (_AWAY + np.arange(columns))
    right = np.stack([np.repeat(x, len(y)), np.tile(y, columns), np.tile(z, columns)], axis=1)
    # The nearest first: inner columns, and in these the places nearest to the middle.
    near = np.lexsort((np.round(np.hypot(right[:, 1], right[:, 2]), 9), right[:, 0]))
    right = right[near[:pairs]]
    return middle + np.stack([right, -right], axis=1).reshape(-1, 3)[:count]


def _symmetric_places(along: Floats, step: float) -> Floats:
    """Places a step apart over the extent of points, about zero, of which each is mirrored by one."""
    half = np.floor(np.ptp(along) / (2.0 * step) + 1e-9)
    return step * np.arange(-half, half + 1)
