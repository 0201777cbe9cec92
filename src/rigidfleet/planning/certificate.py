"""Certificates: the least separation of planned paths, proved for all pairs and between samples, too."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from rigidfleet.formation.assignment import closest_approach
from rigidfleet.kernel.problem import SHAPE, Reference, septic_polynomial
from rigidfleet.math import proximity
from rigidfleet.math.piecewise import expand_about
from rigidfleet.mission import Phase
from rigidfleet.planning.derivatives import reference_of_agents
from rigidfleet.typing import Bools, Floats

#: What a certificate of bent ways gives away, so that its search ends [m].
PROOF_SLACK = 1e-6
#: Shares of a blend's duration, and of the paths flown by then.
_TAU = np.linspace(0.0, 1.0, 2001)
_FLOWN = septic_polynomial(_TAU)
#: Where a certificate is from: a closed form is exact; conservative advancement gives away `PROOF_SLACK`.
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


def certificate_of(
    phase: Phase, reference: Reference, radius: Floats, lost: Bools
) -> Certificate | None:
    """Certificate of a phase whose agents track slots; None if they do not, if slots jump, or for a single agent.

    Parameters: ``radius`` (N,) [m]; ``lost`` (N,) vehicles do not count.
    """
    if not phase.tracks_slots or (reference.T_b == 0.0 and reference.dp.any()):
        return None
    return _prove_flying(reference, radius, lost)


def prove_straight_ways(
    start: Floats, end: Floats, duration: float, radius: Floats, lost: Bools
) -> Certificate | None:
    """Certificate of straight septic blends (N, 3) [m] in step from 0 on [s]; the rest as `certificate_of`."""
    none, ways = np.zeros(0), end - start
    reference = Reference(SHAPE, 0.0, duration, none, none, start, ways, np.zeros(3))
    return _prove_flying(reference, radius, lost)


def _prove_flying(reference: Reference, radius: Floats, lost: Bools) -> Certificate | None:
    """Certificate of the slots of vehicles that are not ``lost`` (N,)."""
    if lost.any():
        left = np.flatnonzero(~lost)
        proved = _prove_flying(reference_of_agents(reference, left), radius[left], lost[left])
        return proved and proved._replace(agents=tuple(left[list(proved.agents)].tolist()))
    if len(lost) < 2:
        return None
    if len(reference.knots):
        return prove_ways(reference.knots, reference.ways, radius)
    return prove_blend(reference, radius)


def prove_blend(reference: Reference, radius: Floats) -> Certificate:
    """Certificate of slots of two agents or more that blend: relative to the virtual body, all move in step.

    How the virtual body moves and turns meanwhile does not matter to distances.
    """
    p, dp, time, share = reference.p0, reference.dp, reference.t0, 0.0
    if dp.any():
        separation, pair, share = closest_approach(p, p + dp, radius)
    else:
        (separation,), (pair,) = (x.tolist() for x in proximity.separation(p[None], radius))
    if share > 0.0:
        time += reference.T_b * float(np.interp(share, _FLOWN, _TAU))
    return Certificate(separation, time, tuple(pair), "closed form")


def prove_ways(
    knots: Floats, ways: Floats, radius: Floats | None = None, first: int | None = None
) -> Certificate:
    """Certificate of bent ways, polynomials (K, N, 3, P) between knots (K + 1,) [s], for radii (N,) [m] or points.

    With ``first``, of the pairs alone that have one of so many first vehicles.

    Let p(t) = sum_k c_k (t - m)^k be the way of one vehicle relative to another about the middle m of a span of length
    2 h, and n the direction of c_0. Then |p(t)| >= n . p(t) >= |c_0| - sum_k |n . c_k| h^k. Spans in which this bound
    is less than the least distance known, `PROOF_SLACK` set aside, are halved until there are none (conservative
    advancement, of second order where the distance is stationary).
    """
    n, powers = ways.shape[1], ways.shape[3]
    r = np.zeros(n) if radius is None else radius
    best: tuple[float, float, tuple[int, int]] = np.inf, float(knots[0]), (0, 0)
    for i in range(n - 1 if first is None else min(first, n - 1)):
        c = (ways[:, i + 1 :] - ways[:, i : i + 1]).reshape(-1, 3, powers)
        half = np.repeat(np.diff(knots) / 2, n - 1 - i)
        middle = np.repeat((knots[:-1] + knots[1:]) / 2, n - 1 - i)
        other = np.tile(np.arange(i + 1, n), len(knots) - 1)
        c = expand_about(c, half)
        while len(c):
            distance = np.linalg.norm(c[..., 0], axis=1)
            direction = c[..., 0] / np.where(distance > 0.0, distance, 1.0)[:, None]
            along = np.abs(np.einsum("lq,lqk->lk", direction, c[..., 1:]))
            fall = (along * half[:, None] ** np.arange(1, powers)).sum(axis=1)
            separation = distance - r[i] - r[other]
            k = int(separation.argmin())
            if separation[k] < best[0]:
                best = float(separation[k]), float(middle[k]), (i, int(other[k]))
            open_ = separation - fall < best[0] - PROOF_SLACK
            c, half, middle, other = c[open_], half[open_] / 2, middle[open_], other[open_]
            c = np.concatenate([expand_about(c, -half), expand_about(c, half)])
            middle = np.concatenate([middle - half, middle + half])
            half, other = np.tile(half, 2), np.tile(other, 2)
    return Certificate(best[0] - PROOF_SLACK, best[1], best[2], "conservative advancement")
