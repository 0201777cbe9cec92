"""Smoothing of measured positions: the likely way of a vehicle, ways drawn from what is left in doubt, and the noise.

A way is a quartic spline with even knots, whose third derivative wanders (penalised splines: Eilers and Marx,
Statistical Science 11, 1996; the limit of dense knots is an integrated Wiener process of third order). The noise of a
measurement has a standard deviation and, if it is not white, a correlation time (a process AR(1), which is whitened).
All matrices are banded, so that the cost is linear in samples and knots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rigidfleet.math.piecewise import Piecewise
from rigidfleet.typing import Floats

#: Weights (5, 5) of five control points, and powers of the share of a span, of a uniform quartic B-spline.
QUARTIC = np.array(
    [[1, -4, 6, -4, 1], [11, -12, -6, 12, -4], [11, 12, -6, -12, 6], [1, 4, 6, 4, -4], [0, 0, 0, 0, 1]]
) / 24.0  # fmt: skip
#: Control points of a span, and spans by which two samples whose noise is correlated may be apart.
_POINTS, _APART = 5, 3
_WINDOW = _POINTS + _APART
#: Third differences of control points, and the search for their variance in that of the noise (natural logarithm; from,
#: at first, to, close enough). The least smooths over 40 knots: beyond it, matrices are not positive definite any more.
_THIRD = np.array([-1.0, 3.0, -3.0, 1.0])
_SMALLEST, _FIRST, _LARGEST, _CLOSE = -22.0, -6.0, 25.0, 0.1
#: Turns in which third differences get sizes of their own, ways drawn in each, and degrees of freedom of the sizes.
_TURNS, _DRAWN, _FREEDOM = 8, 8, 0.3
#: Vehicles and samples of each by which noise is judged; correlation times that are tried, and the longest [s].
_SOME, _ENOUGH, _TAUS, _SLOWEST = 4, 10_000, 12, 10.0
#: Longest correlation time that samples themselves can show beside motion [s].
_SHOWN = 0.4
#: Difference of -2 log of a likelihood from which on one noise is clearly likelier than another.
_CLEAR = 12.0
#: Lags at which what remains is correlated if it is not white, and the greatest such correlation.
_LAGS, _WHITE = 5, 0.1


class PositionNoise(NamedTuple):
    """Noise of positions: standard deviation [m] of a coordinate, and its correlation time [s]; 0: white."""

    sigma: float
    tau: float = 0.0


class Positions(NamedTuple):
    """Measured positions of a vehicle.

    Attributes
    ----------
    time : (K,) [s], increasing
    position : (K, 3) [m]
    scale : (K,) standard deviation of each, in that of the noise
    """

    time: Floats
    position: Floats
    scale: Floats


@dataclass(frozen=True)
class Smoothed:
    """The likely way of a vehicle and what is left in doubt, as control points of a spline.

    Attributes
    ----------
    knots : (M + 1,) even [s]
    points : (M + 4, 3) [m], the likely ones
    factor : (8, M + 4) Cholesky factor of their precision, the same for all axes: lower, banded
    calm : (M + 1,) inverse variances of third differences of control points, in those where the vehicle is calm
    noise : of the samples
    deviance : -2 log of the likelihood of noise and size
    residual : (K, 3) whitened: independent, of variance near one, if the noise is what it is taken for
    """

    knots: Floats
    points: Floats
    factor: Floats
    calm: Floats
    noise: PositionNoise
    deviance: float
    residual: Floats

    @property
    def way(self) -> Piecewise:
        """The likely way: pieces (M, 3, 5)."""
        return b_spline_curve(self.knots, self.points)

    def draw(self, count: int, random: np.random.Generator) -> Floats:
        """Control points (M + 4, 3, count) of ways as likely as the true one, given the samples."""
        normal = random.standard_normal((len(self.points), 3 * count))
        return self.points[..., None] + _precision_draws(self.factor, normal).reshape(-1, 3, count)


def b_spline_curve(knots: Floats, points: Floats) -> Piecewise:
    """The spline with control points (M + 4, ...) on even knots (M + 1,) [s]: pieces (M, ..., 5)."""
    h, spans = knots[1] - knots[0], len(knots) - 1
    windows = np.stack([points[k : k + spans] for k in range(_POINTS)], axis=-1)
    return Piecewise(knots, windows @ QUARTIC / h ** np.arange(5.0))


def knots_over(time: Floats, step: float) -> Floats:
    """Even knots at multiples of a step [s] that cover times (K,), and a step before and after them."""
    first, last = np.floor(time[0] / step), np.ceil(time[-1] / step)
    return step * np.arange(first - 1.0, max(last, first + 1.0) + 2.0)


def _whiten(samples: Positions, noise: PositionNoise, knots: Floats) -> tuple[Any, Floats, float]:
    """A matrix (K, C), sparse, and values (K, 3): the matrix times control points (C, 3), with independent noise.

    The noise has variance 1; last comes -2 log of the determinant of what whitens all axes.
    """
    from scipy.sparse import csr_array, diags_array

    h, spans, count = knots[1] - knots[0], len(knots) - 1, len(samples.time)
    span = np.clip(((samples.time - knots[0]) / h).astype(np.int64), 0, spans - 1)
    share = (samples.time - knots[0]) / h - span
    sigma = noise.sigma * samples.scale
    basis = (share[:, None] ** np.arange(5.0)) @ QUARTIC.T / sigma[:, None]
    columns, ends = span[:, None] + np.arange(_POINTS), _POINTS * np.arange(count + 1)
    matrix = csr_array((basis.ravel(), columns.ravel(), ends), (count, spans + _POINTS - 1))
    value, deviance = samples.position / sigma[:, None], 6.0 * float(np.log(sigma).sum())
    if noise.tau > 0.0:
        # Over a longer gap, the noise counts as new: a little is left out of what is known of it.
        near = np.diff(span) <= _APART
        share = np.where(near, np.exp(-np.diff(samples.time) / noise.tau), 0.0)
        left = np.append(1.0, 1.0 / np.sqrt(-np.expm1(2.0 * np.log(np.maximum(share, 1e-300)))))
        whitening = diags_array([left, -share * left[1:]], offsets=[0, -1])
        matrix, value = (whitening @ matrix).tocsr(), whitening @ value
        deviance -= 6.0 * float(np.log(left).sum())
    return matrix, value, deviance


def smooth(
    samples: Positions, noise: PositionNoise, knots: Floats, calm: Floats | None = None
) -> Smoothed:
    """The likely way of a vehicle on even knots (M + 1,) [s].

    First, all third differences have one size, the likeliest; if the noise has no standard deviation (NaN), it is the
    likeliest, too. Then, differences get sizes of their own, of Student's distribution, as vehicles are calm for long
    and at times are not (variational Bayes: Tipping and Lawrence, Neurocomputing 69, 2005); or they keep to how
    ``calm`` (M + 1,) the vehicle is.
    """
    from scipy.linalg import cho_solve_banded, cholesky_banded
    from scipy.optimize import minimize_scalar

    free = np.isnan(noise.sigma)
    unit = PositionNoise(1.0, noise.tau) if free else noise
    (matrix, value, whitening), count = _whiten(samples, unit, knots), len(knots) + _POINTS - 2
    normal, right = matrix.T @ matrix, matrix.T @ value
    band = np.stack([np.pad(normal.diagonal(-k), (0, k)) for k in range(_WINDOW)])
    whole, turns = count - 3, _TURNS if calm is None else 0
    calm = np.ones(whole) if calm is None else calm
    numbers, about = 3 * max(len(samples.time) - 3, 1), np.zeros((count, 3))
    third = np.zeros((whole, 3))  # differences of ``about``

    def points_right_side_and_factor(weight: Floats) -> tuple[Floats, Floats, Floats]:
        """Control points from ``about`` on (C, 3), what they were solved of, and the factor."""
        full, of = band.copy(), right.copy()
        for i in range(4):
            of[i : i + whole] -= _THIRD[i] * weight[:, None] * third
            for j in range(i, 4):
                full[j - i, i : i + whole] += _THIRD[i] * _THIRD[j] * weight
        factor = cholesky_banded(full, lower=True, check_finite=False)
        return cho_solve_banded((factor, True), of, check_finite=False), of, factor

    def evaluate(log_variance: float) -> tuple[float, float]:
        weight = calm * np.exp(-log_variance)
        points, of, factor = points_right_side_and_factor(weight)
        quadratic = squares + float((weight @ third**2).sum())
        quadratic = max(quadratic - float((points * of).sum()), 1e-12 * squares)
        of_points = 2.0 * float(np.log(factor[0]).sum()) + whole * log_variance
        variance = quadratic / numbers if free else 1.0
        of_samples = whitening + numbers * np.log(variance) + quadratic / variance
        return of_samples + 3.0 * of_points, variance

    zero = 0.0 if free else 2.0 * np.log(noise.sigma)  # in units of the noise, where it is known
    bounds = _SMALLEST + zero, _LARGEST + zero
    # Only what a first way leaves is fitted: of far positions, the quadratic would be all rounding.
    about = points_right_side_and_factor(calm * np.exp(-_FIRST - zero))[0]
    third = np.diff(about, 3, axis=0)
    value = value - matrix @ about
    squares, right = float((value**2).sum()), matrix.T @ value
    near = {"xatol": _CLOSE}
    best = minimize_scalar(lambda x: evaluate(x)[0], bounds=bounds, method="bounded", options=near)
    deviance, variance = evaluate(best.x)
    weight = calm * np.exp(-best.x)
    random = np.random.default_rng(0)
    for _ in range(turns):
        points, _, factor = points_right_side_and_factor(weight)
        drawn = _precision_draws(factor, random.standard_normal((count, _DRAWN)))
        size = (np.diff(about + points, 3, axis=0) ** 2).sum(axis=1)
        size = size / variance + 3.0 * (np.diff(drawn, 3, axis=0) ** 2).mean(axis=1)
        weight = (_FREEDOM + 3.0) / (_FREEDOM / weight.mean() + size)
        weight = np.minimum(weight, np.exp(-bounds[0]))
    points, _, factor = points_right_side_and_factor(weight)
    sigma = float(np.sqrt(variance))
    residual = (value - matrix @ points) / sigma
    known = PositionNoise(sigma * unit.sigma, noise.tau)
    calm = np.minimum(weight / np.median(weight), 1.0)
    return Smoothed(knots, about + points, factor / sigma, calm, known, deviance, residual)


def _precision_draws(factor: Floats, normal: Floats) -> Floats:
    """Normal numbers (C, ...) with the precision of a banded Cholesky factor."""
    from scipy.linalg import get_lapack_funcs

    (solve,) = get_lapack_funcs(("tbtrs",), (factor, normal))
    return solve(factor, normal, uplo="L", trans="T")[0]


class NoiseEstimate(NamedTuple):
    """What the noise is taken for, and whether what remains of samples contradicts it; None: it cannot be known."""

    noise: PositionNoise | None
    source: str
    words: str


def fit_noise(vehicles: Sequence[Positions], sigma: float | None, step: float) -> NoiseEstimate:
    """The noise of some vehicles alike: of a stated standard deviation [m], or else of one that they show themselves.

    Knots are a ``step`` [s] apart, or as rare as samples. The correlation time is the likeliest. Without a stated size
    it must stand out from white noise, and from noise so slow that it cannot be told from motion; and what remains must
    be white.
    """
    some = []
    for own in sorted(vehicles, key=lambda own: -len(own.time))[:_SOME]:
        first = max(0, (len(own.time) - _ENOUGH) // 2)  # the middle of the samples
        some.append(Positions(*(x[first : first + _ENOUGH] for x in own)))
    steps = [float(np.median(np.diff(own.time))) for own in some]
    both = zip(some, steps, strict=True)
    knots = [knots_over(own.time, max(step, each)) for own, each in both]
    usual = float(np.median(steps))
    size = np.nan if sigma is None else sigma
    calm = [smooth(own, PositionNoise(size), k).calm for own, k in zip(some, knots, strict=True)]

    def fit_at_correlation(tau: float) -> tuple[float, list[Smoothed]]:
        parts = zip(some, knots, calm, strict=True)
        every = [smooth(own, PositionNoise(size, tau), k, each) for own, k, each in parts]
        return sum(each.deviance for each in every), every

    taus = [0.0, *np.geomspace(0.5 * usual, _SLOWEST, _TAUS).tolist()]
    fits = [fit_at_correlation(tau) for tau in taus]
    deviances = [deviance for deviance, _ in fits]
    k = int(np.argmin(deviances))
    if deviances[0] < deviances[k] + _CLEAR:
        k = 0
    every, tau = fits[k][1], taus[k]
    if 0 < k < len(taus) - 1:
        # The least of a parabola through the three nearest.
        before, here, after = deviances[k - 1 : k + 2]
        by = 0.5 * (before - after) / (before - 2.0 * here + after) if before > here else 0.0
        ratio = taus[-1] / taus[-2]
        tau = tau * ratio ** float(np.clip(by, -0.5, 0.5))
        every = fit_at_correlation(tau)[1]
    size = float(np.median([each.noise.sigma for each in every]))
    residual = np.concatenate([each.residual for each in every])
    lags = [abs((residual[j:] * residual[:-j]).mean()) for j in range(1, _LAGS + 1)]
    white = max(lags) / residual.var() < _WHITE + 3.0 / np.sqrt(residual.size)
    clear = k == 0 or (tau < _SHOWN and min(deviances[-1], deviances[0]) > deviances[k] + _CLEAR)
    if sigma is None and not (white and clear):
        words = "what remains of the samples is not white, nor noise of one correlation time"
        return NoiseEstimate(None, "data", words)
    words = "" if white else "what remains is not white"
    return NoiseEstimate(PositionNoise(size, tau), "data" if sigma is None else "stated", words)
