"""Certificates: the least separation of planned paths, proved for all pairs and between samples, too."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from rigidfleet.formation.assignment import closest_approach
from rigidfleet.kernel.problem import Reference, septic_polynomial
from rigidfleet.math import proximity
from rigidfleet.mission import Phase
from rigidfleet.typing import Bools, Floats

#: Where a certificate is from: a closed form, which is exact, or conservative advancement, which is a lower bound.
How = Literal["closed form", "conservative advancement"]


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
    left = np.arange(len(radius)) if lost is None else np.flatnonzero(~lost)
    if len(left) < 2:
        return None
    p, dp, r = reference.p0[left], reference.dp[left], radius[left]
    if dp.any():
        separation, pair, share = closest_approach(p, p + dp, r)
    else:
        least, pairs = proximity.separation(p[None], r)
        separation, pair, share = float(least[0]), pairs[0], 0.0
    i, j = (int(left[k]) for k in pair)
    time = reference.t0 + reference.T_b * _when(share)
    return Certificate(separation, time, (i, j), "closed form")


def _when(share: float) -> float:
    """Share of the blend's duration at which agents have flown this share of their paths."""
    tau = np.linspace(0.0, 1.0, 2001)
    return float(np.interp(share, septic_polynomial(tau), tau))
