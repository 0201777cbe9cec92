"""Transfers of labelled vehicles through a crowd: bent ways found together, and proved.

Where vehicles are dense, neither straight ways nor layers fit. Here all ways are uniform cubic B-splines of one
duration, from rest to rest. Their control points lie in the box and minimise penalties of what is broken: the distance
of pairs at samples, speed and acceleration; then the ways are proved. Speed and acceleration of a B-spline are bounded
by differences of its control points, so that limits per axis and the box hold between samples, too. The distance of
pairs is bounded in continuous time by conservative advancement on the ways themselves
(`rigidfleet.planning.certificate.prove_ways`).

The penalty methods are those of trajectory optimisation with B-splines, e.g. Zhou et al., Robust and efficient
quadrotor trajectory generation for fast autonomous flight, IEEE RA-L 4(4), 2019.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.formation.assignment import closest_approach
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.planning.certificate import Certificate, prove_ways
from rigidfleet.typing import Floats

#: Spans of a way between its knots; samples of each span at which distances are penalised, or so many that the longest
#: way has this many in the distance to keep, on average.
_SPANS, _SAMPLES, _PASSED = 16, 3, 2.0
#: Share of the way at each control point: the first and last three are equal, for rest at the ends.
_SHARE = np.clip((np.arange(_SPANS + 3) - 2) / (_SPANS - 2), 0.0, 1.0)[:, None, None]
#: Durations tried, as multiples of the slowest single vehicle's, and random starts of each, before one roundabout.
_SLOWER, _STARTS = (1.5, 1.8, 2.1, 2.4), 2
#: Weights of distances, and of speed and acceleration; of smoothness. Distances are wanted this much larger.
_WEIGHTS, _SMOOTH, _SPARE = (20.0, 2.0), 1e-3, 1.04
#: Greatest random displacement of a control point at the start, as a multiple of the distance to keep.
_NOISE = 1.0
#: Duration [s] where nobody has to move.
_SHORTEST = 1e-3
#: Iterations of a search.
_ITERATIONS = 300


class Transfer(NamedTuple):
    """Ways of all vehicles: uniform cubic B-splines.

    Attributes
    ----------
    control : (M + 3, N, 3) control points [m]
    duration : of the M spans together [s]
    certificate : least distance of two centres, in the metric in which it was asked; its time is from the start
    """

    control: Floats
    duration: float
    certificate: Certificate


def least_duration(
    start: ArrayLike, goal: ArrayLike, speed: ArrayLike, acceleration: ArrayLike
) -> float:
    """Least time [s] in which the slowest vehicle alone goes from rest to rest, with limits on each axis."""
    way = np.abs(np.subtract(goal, start))
    v, a = np.asarray(speed), np.asarray(acceleration)
    fast = way / v + v / a
    return float(np.where(way > v**2 / a, fast, 2.0 * np.sqrt(way / a)).max())


def plan_transfer(
    start: ArrayLike,
    goal: ArrayLike,
    *,
    distance: float,
    speed: ArrayLike,
    acceleration: ArrayLike,
    box: tuple[ArrayLike, ArrayLike],
    downwash: float = 1.0,
    seed: int = 0,
) -> Transfer | None:
    """Ways of vehicles from ``start`` to ``goal`` (N, 3) [m], from rest to rest, in which no two come too near.

    Parameters
    ----------
    distance : least distance of two centres [m], in a metric whose z is divided by ``downwash``
    speed, acceleration : greatest on each axis, (3,) or a number [m/s, m/s^2]
    box : lowest and highest corner [m], which no centre leaves
    seed : of the random starts of the search

    Returns
    -------
    The first ways found that are proved, by increasing duration; None if none are.

    Raises
    ------
    ValueError
        Vehicles are nearer to each other than ``distance`` at the start or at the goal.
    """
    s, g = (np.asarray(x, dtype=np.float64) for x in (start, goal))
    metric = np.array([1.0, 1.0, 1.0 / downwash])
    for name, x in (("start", s), ("goal", g)):
        least, (i, j), _ = closest_approach(x * metric, x * metric)
        if least < distance:
            raise ValueError(
                f"vehicles {i + 1} and {j + 1} are {least:.3g} m apart at the {name}, nearer than the distance of"
                f" {distance:g} m to keep: move one of them"
            )
    limits = _Limits(
        distance, np.broadcast_to(speed, 3), np.broadcast_to(acceleration, 3),
        np.array(box[0], dtype=np.float64), np.array(box[1], dtype=np.float64), metric,
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    least_time = max(least_duration(s, g, limits.speed, limits.acceleration), _SHORTEST)
    for duration in (slower * least_time for slower in _SLOWER):
        for start_number in range(_STARTS + 2):
            control = (1 - _SHARE) * s + _SHARE * g  # straight ways
            if start_number > _STARTS:  # as in a roundabout, for crowds that all meet at one place
                control = _descend(_half_ellipse_control_points(s, g), duration, limits, rng)
            elif start_number:  # straight ways will not do
                control = _descend(control, duration, limits, rng)
            if not _keeps_limits(control, duration, limits):
                continue
            knots, pieces = Piecewise.b_spline(control, duration)
            certificate = prove_ways(knots, pieces * metric[:, None])
            if certificate.separation >= distance:
                return Transfer(control, duration, certificate)
    return None


class _Limits(NamedTuple):
    """Distance to keep, limits of each axis, box, and the factors of the metric."""

    distance: float
    speed: Floats
    acceleration: Floats
    low: Floats
    high: Floats
    metric: Floats


def _half_ellipse_control_points(start: Floats, goal: Floats) -> Floats:
    """Control points (M + 3, N, 3) of ways that all keep to the right, seen from above on half an ellipse.

    Where each vehicle goes to the opposite place of a circle, this is half a turn of them all.
    """
    way = goal - start
    right = 0.5 * np.stack([way[:, 1], -way[:, 0], 0.0 * way[:, 0]], axis=1)
    return start + 0.5 * (1.0 - np.cos(np.pi * _SHARE)) * way + np.sin(np.pi * _SHARE) * right


def _descend(control: Floats, duration: float, limits: _Limits, rng: np.random.Generator) -> Floats:
    """Control points (M + 3, N, 3) with little penalty, from those of other ways; their ends stay."""
    from scipy.optimize import Bounds, minimize

    n, h = control.shape[1], duration / _SPANS
    control = control.copy()
    longest = float(np.linalg.norm(control[-1] - control[0], axis=1).max())
    each = max(_SAMPLES, math.ceil(_PASSED * longest / (_SPANS * limits.distance)))
    # Weights of the control points: each one's own spline.
    B = Piecewise.b_spline(np.eye(_SPANS + 3), 1.0).at(np.linspace(0.0, 1.0, _SPANS * each + 1))
    free = slice(3, _SPANS)
    share = np.linspace(0.0, 1.0, _SPANS - 1)[1:-1, None, None]
    noise = rng.uniform(-1, 1, (1, n, 3)) * (_NOISE * limits.distance / limits.metric)
    control[free] += 4.0 * share * (1 - share) * noise
    shape = control[free].shape
    near = (_SPARE * limits.distance) ** 2
    w_near, w_fast = _WEIGHTS
    itself = np.arange(n)

    def penalty(y: Floats) -> tuple[float, Floats]:
        """Weighted squares of what the ways lack or exceed, and their gradient by the free control points."""
        control[free] = y.reshape(shape)
        slope = np.zeros_like(control)
        x = np.tensordot(B, control, axes=1) * limits.metric
        square = (x * x).sum(axis=2)
        miss = near - (square[:, :, None] + square[:, None] - 2.0 * x @ x.swapaxes(1, 2))
        miss[:, itself, itself] = 0.0
        np.maximum(miss, 0.0, out=miss)
        cost = 0.5 * w_near / near**2 * float((miss * miss).sum())
        push = x * miss.sum(axis=2)[:, :, None] - miss @ x
        slope -= np.tensordot(B.T, (4.0 * w_near / near**2) * push * limits.metric, axes=1)
        for order, most, smooth in (
            (1, limits.speed * h, 0.0),
            (2, limits.acceleration * h * h, _SMOOTH),
        ):
            d = np.diff(control, order, axis=0) / most
            over = np.sign(d) * np.maximum(np.abs(d) - 0.99, 0.0)
            cost += float((w_fast * over * over + smooth * d * d).sum())
            rise = 2.0 * (w_fast * over + smooth * d) / most
            # The transpose of differences are those of what ends in zeros, of odd order with the other sign.
            ends = (order, order), (0, 0), (0, 0)
            slope += (-1.0) ** order * np.diff(np.pad(rise, ends), order, axis=0)
        return cost, slope[free].ravel()

    # No place within the bounds is out of the box.
    bounds = Bounds(*(np.tile(corner, shape[0] * n) for corner in (limits.low, limits.high)))
    optimum = minimize(
        penalty, control[free].ravel(), jac=True, method="L-BFGS-B", bounds=bounds,
        options={"maxiter": _ITERATIONS, "maxcor": 20},
    )  # fmt: skip
    control[free] = optimum.x.reshape(shape)
    return control


def _keeps_limits(control: Floats, duration: float, limits: _Limits) -> bool:
    """Whether ways keep the box, and the limits of speed and acceleration on each axis."""
    h = duration / (len(control) - 3)
    speed = np.abs(np.diff(control, 1, axis=0)) / h
    acceleration = np.abs(np.diff(control, 2, axis=0)) / h**2
    inside = (control >= limits.low - 1e-9) & (control <= limits.high + 1e-9)
    slow = (speed <= limits.speed * (1 + 1e-9)).all()
    return bool(inside.all() and slow and (acceleration <= limits.acceleration * (1 + 1e-9)).all())
