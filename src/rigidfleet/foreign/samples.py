"""Curves through the samples of others: what is assumed between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rigidfleet._common.tables import fault
from rigidfleet.foreign.curves import curve_through_states
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.typing import Floats

#: What is assumed between samples, in words.
ASSUMED = {
    "linear": "straight lines between samples",
    "cubic": "cubic splines through the positions",
}

#: Correlation of third differences, one after the other, below which they are those of noise (of white noise -3/4, of a
#: random walk -2/3, of smooth motion near 1), and the least such noise [m].
_OF_NOISE, _SHOWN = -0.6, 2e-4
#: Fewest samples by which noise is seen.
_SAMPLES = 50


def looks_measured(curves: Sequence[Piecewise], assumed: str) -> bool:
    """Whether samples of a vehicle have noise, as they were measured; ``assumed``: what is between them."""
    if assumed not in ASSUMED.values():
        return False
    for curve in curves:
        third = np.diff(curve.at(curve.time)[:, :3], 3, axis=0)
        if len(third) < _SAMPLES:
            continue
        square = (third**2).mean(axis=0)
        both = (third[1:] * third[:-1]).mean(axis=0)
        # 20 is the factor of white noise.
        if ((square > 20.0 * _SHOWN**2) & (both < _OF_NOISE * square)).any():
            return True
    return False


def curve_through_samples(
    time: Floats,
    position: Floats,
    yaw: Floats | None,
    kind: str,
    place: Callable[[int], str],
) -> Piecewise:
    """The curve through positions (K, 3) [m] and yaws (K,) [rad] at times (K,) [s].

    ``cubic`` is the spline with continuous acceleration (not-a-knot at its ends); yaw is on lines without full turns.
    A single sample stays for a second.

    Raises
    ------
    ContentError
        A time does not increase; ``place`` tells where in the file it is.
    """
    behind = np.flatnonzero(~(np.diff(time) > 0.0))
    if len(behind):
        k = int(behind[0]) + 1
        how = "repeats" if time[k] == time[k - 1] else "goes back behind"
        why = f"{place(k)}: the time {time[k]:.9g} s {how} {time[k - 1]:.9g} s"
        raise fault(why, "Give increasing times")
    turned = None if yaw is None else np.unwrap(yaw)[None]
    lines = curve_through_states(time, position[None], turned)
    if kind == "linear" or len(time) < 3:
        return lines
    return Piecewise.cubic_spline(time, position).stack(Piecewise(time, lines.pieces[:, 3:]))
