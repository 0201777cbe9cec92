"""Certificates: the least separation of planned paths, proved for all pairs and between samples, too."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from rigidfleet.formation.assignment import closest_approach
from rigidfleet.kernel.problem import Reference, septic_polynomial
from rigidfleet.math import proximity
from rigidfleet.mission import Phase
from rigidfleet.typing import Bools, Floats

#: Greatest size of slots, in bytes, whose least separation is cached.
_KEPT = 100_000
#: Where a certificate is from: a closed form is exact; polygons of samples less their sagitta are a lower bound.
How = Literal["closed form", "polygons less sagitta"]


class Certificate(NamedTuple):
    """The least separation of planned paths.

    Attributes
    ----------
    separation : least distance between the surfaces of two agents [m]; no pair comes nearer, at any time
    time : when, in mission time [s]
    agents : which two, from 0
    how : the method of the proof
    """

    separation: float
    time: float
    agents: tuple[int, int]
    how: How


def certified(
    phase: Phase, reference: Reference, radius: Floats, lost: Bools | None = None
) -> Certificate | None:
    """Certificate of a phase whose agents track slots; None if they do not, if slots jump, or for a single agent.

    Parameters: ``radius`` (N,) [m]; ``lost`` (N,) vehicles do not count.
    """
    if phase.control != "tracking" or (reference.T_b == 0.0 and reference.dp.any()):
        return None
    return straight(reference, radius, lost)


def straight(reference: Reference, radius: Floats, lost: Bools | None = None) -> Certificate | None:
    """Certificate of slots that blend: relative to the virtual body, all move straight and in step.

    How the virtual body moves and turns meanwhile does not matter to distances. None for a single agent.
    """
    p, dp, r = reference.p0, reference.dp, radius
    left = None if lost is None else np.flatnonzero(~lost)
    if left is not None:
        p, dp, r = p[left], dp[left], r[left]
    if len(p) < 2:
        return None
    least = _least if p.nbytes < _KEPT else _least.__wrapped__
    separation, pair, share = least(p.tobytes(), dp.tobytes(), r.tobytes())
    i, j = (int(k if left is None else left[k]) for k in pair)
    time = reference.t0
    if share > 0.0:
        time += reference.T_b * _when(share)
    return Certificate(separation, time, (i, j), "closed form")


@lru_cache(64)
def _least(p: bytes, dp: bytes, radius: bytes) -> tuple[float, tuple[int, int], float]:
    """`closest_approach` of slots that blend or stay, cached because most phases have the slots of the one before."""
    start, ways = (np.frombuffer(x).reshape(-1, 3) for x in (p, dp))
    r = np.frombuffer(radius)
    if ways.any():
        return closest_approach(start, start + ways, r)
    least, pairs = proximity.separation(start[None], r)
    return float(least[0]), (int(pairs[0, 0]), int(pairs[0, 1])), 0.0


def of_polygons(
    position: Floats, time: Floats, acceleration: float, radius: Floats | None = None
) -> Certificate:
    """Certificate of bent ways from samples (K, N, 3) [m] at times (K,) [s], and a bound on every |a| [m/s^2].

    Between two samples a pair moves straight in step, but for the sagitta of its relative motion: with |a_i - a_j|
    <= 2 |a|, it is 2 |a| h^2 / 8 at most (interpolation error of a linear interpolant). The closed form for the
    straight ways less that is a lower bound, whose gap falls with the square of the time h between samples.
    """
    best = np.inf, (0, 0), float(time[0])
    for k in range(max(1, len(time) - 1)):
        after = min(k + 1, len(time) - 1)
        separation, pair, share = closest_approach(position[k], position[after], radius)
        h = float(time[after] - time[k])
        separation -= acceleration * h * h / 4.0
        if separation < best[0]:
            best = separation, pair, float(time[k]) + share * h
    return Certificate(best[0], best[2], best[1], "polygons less sagitta")


def _when(share: float) -> float:
    """Share of the blend's duration at which agents have flown this share of their paths."""
    tau = np.linspace(0.0, 1.0, 2001)
    return float(np.interp(share, septic_polynomial(tau), tau))
