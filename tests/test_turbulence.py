"""Random processes against their definitions: closed forms, SciPy's discretisation, statistics of long samples."""

import numpy as np
import pytest
from scipy import signal, special
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_continuous_lyapunov

from rigidfleet.kernel.engine import native
from rigidfleet.math import turbulence as tb
from rigidfleet.planning import filters

TAU, STEP = 0.7, 0.1


def white(shape, seed=1):
    return np.random.default_rng(seed).standard_normal(shape)


def second(e, step, tau):
    return filters.dryden_gust(e, step, tau)


def first(e, step, tau):
    return filters.gauss_markov(e[:, 0], step, tau)


PROCESSES = {
    "first": (first, lambda s: np.exp(-s)),
    "second": (second, lambda s: np.exp(-s) * (1 - s / 2)),
}


@pytest.mark.parametrize("name", PROCESSES)
@pytest.mark.parametrize("step", [0.02, 0.1, 1.5])
def test_covariances_are_those_of_the_process(name, step):
    """Of the linear map from white samples, the covariances of all samples are sigma^2 rho(t), from the first on."""
    make, rho = PROCESSES[name]
    n = 12
    # Each unit of white noise alone: the columns of the map.
    x = make(np.eye(2 * n).reshape(n, 2, 2 * n), step, TAU)
    C = x @ x.T
    t = step * np.arange(n)
    np.testing.assert_allclose(C, rho(np.abs(t[:, None] - t) / TAU), rtol=0, atol=1e-12)


def test_variance_and_correlation_time_of_samples():
    """Of 2,000 independent samples of 200 steps, variance and correlation are the stated ones, within 4 sigma."""
    for make, rho in PROCESSES.values():
        x = make(white((200, 2, 2000)), STEP, TAU)
        assert np.mean(x**2) == pytest.approx(
            1.0, abs=4 * np.sqrt(2 * 2 * TAU / (200 * STEP * 2000))
        )
        k = 7
        assert np.mean(x[:-k] * x[k:]) == pytest.approx(rho(k * STEP / TAU), abs=0.02)


def test_the_second_process_has_drydens_spectrum():
    """Its filter (1 + sqrt(3) tau s) / (1 + tau s)^2 has MIL-F-8785C's transverse spectrum, of unit variance."""
    w = np.geomspace(0.01, 100, 50)
    _, H = signal.freqs([np.sqrt(3) * TAU, 1], [TAU**2, 2 * TAU, 1], w)
    # Phi(w) = sigma^2 L / (pi V) (1 + 3 (L w / V)^2) / (1 + (L w / V)^2)^2, over w > 0, with tau = L / V.
    phi = TAU / np.pi * (1 + 3 * (TAU * w) ** 2) / (1 + (TAU * w) ** 2) ** 2
    np.testing.assert_allclose(TAU / np.pi * np.abs(H) ** 2, phi, rtol=1e-12)
    # The same state space as in `second_order` has the stationary covariance used there.
    A, B = np.array([[-1, 0], [1, -1]]) / TAU, np.array([[1.0], [0.0]]) / TAU
    P = solve_continuous_lyapunov(A, -B @ B.T * 2 * TAU)
    np.testing.assert_allclose(P, [[1, 0.5], [0.5, 0.5]], rtol=1e-12)


def test_low_altitude_values_of_the_specification():
    """At 200 ft in a wind of 30 kn: L_w = 200 ft, L_u = 200 / 0.3416^1.2 ft; sigma_w = 3 kn, sigma_u 1.54 times it."""
    knot, foot = 0.514444, 0.3048
    sigma, length = tb.low_altitude_gusts(200 * foot, 30 * knot)
    np.testing.assert_allclose(sigma[2], 3 * knot)
    np.testing.assert_allclose(sigma[:2], 3 * knot / 0.3416**0.4)
    np.testing.assert_allclose(length, np.array([200 / 0.3416**1.2] * 2 + [200]) * foot)
    # Where the layer ends, at 1000 ft, the lengths are alike.
    np.testing.assert_allclose(tb.low_altitude_gusts(1000 * foot, 1.0)[1], 1000 * foot, rtol=1e-9)


@pytest.mark.parametrize("correlation", [0.0, 0.3, 1.0])
def test_even_correlation(correlation):
    """Each agent's variance stays one, and any two have the stated correlation: exactly, as a map of white noise."""
    x = tb.correlate_agents(np.eye(5)[:, :, None], correlation)[:, :, 0]
    expected = np.full((4, 4), correlation)
    np.fill_diagonal(expected, 1.0)
    np.testing.assert_allclose(x.T @ x, expected, atol=1e-12)


def test_correlation_falls_with_distance():
    """Two agents at distance d have the correlation exp(-d / length), and coincident ones nearly one."""
    p = np.array([[0, 0, 0], [3, 4, 0], [0, 0, 2], [0, 0, 2 + 1e-9]])
    x = tb.correlate_by_distance(np.eye(4)[:, :, None], p, 5.0)[:, :, 0]
    apart = np.linalg.norm(p[:, None] - p, axis=2)
    np.testing.assert_allclose(x.T @ x, np.exp(-apart / 5.0), atol=1e-11)


@pytest.mark.parametrize("n", [2, 3, 50])
def test_splines_are_scipys(n):
    """The coefficients are those of the natural cubic spline through the samples, SciPy's."""
    y = white((n, 3, 2))
    c = filters.spline_coefficients(y)
    assert c.shape == (n + 2, 3, 2)
    reference = CubicSpline(np.arange(n), y, bc_type="natural")
    np.testing.assert_allclose((c[:-2] + 4 * c[1:-1] + c[2:]) / 6, y, atol=1e-12)
    np.testing.assert_allclose((c[2:] - c[:-2]) / 2, reference(np.arange(n), 1), atol=1e-12)


@pytest.mark.parametrize("backward", [False, True])
def test_recursions_are_followed_along_rows(backward):
    """The compiled recursion solves the bidiagonal system of its rows, forwards and backwards."""
    x, a = white((7, 4)), white(7, seed=2)
    L = np.eye(7) - np.diag(a[:-1] if backward else a[1:], 1 if backward else -1)
    expected = np.linalg.solve(L, x)
    native.run_linear_recursion(x, a, backward=backward)
    np.testing.assert_allclose(x, expected, rtol=1e-12, atol=1e-12)


def test_covariances_of_short_steps_are_scipys():
    """Incomplete gamma functions of whole numbers, which covariances are made of, are SciPy's to rounding."""
    for n in (1, 2, 3):
        x = np.geomspace(1e-12, 100.0, 300)
        found = [filters._incomplete_gamma(n, value) for value in x.tolist()]
        np.testing.assert_allclose(found, special.gammainc(n, x), rtol=1e-13)
