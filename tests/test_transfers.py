"""Bent ways of labelled vehicles through a crowd, and their proof."""

from typing import Any

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.spatial.distance import pdist

from rigidfleet.math.piecewise import Piecewise
from rigidfleet.planning.certificate import PROOF_SLACK, prove_ways
from rigidfleet.planning.transfers import Transfer, least_duration, plan_transfer

BOX = ((-1.5, -1.5, 0.2), (1.5, 1.5, 2.2))
LIMITS: dict[str, Any] = {
    "distance": 0.3,
    "speed": (1.0, 1.0, 1.0),
    "acceleration": (2.0, 2.0, 1.0),
    "box": BOX,
}


def scattered(rng: np.random.Generator, n: int, downwash: float) -> np.ndarray:
    """Random places in the box, half a metre apart in the metric."""
    found = np.zeros((0, 3))
    while len(found) < n:
        x = rng.uniform(*BOX)
        if (np.linalg.norm((found - x) * [1, 1, 1 / downwash], axis=1) > 0.5).all():
            found = np.vstack([found, x])
    return found


@pytest.mark.parametrize(("n", "downwash"), [(2, 1.0), (8, 1.0), (15, 2.0)])
def test_all_arrive_within_all_limits(n, downwash):
    """Judged by ten thousand samples of SciPy's B-splines: places, rest, speed, acceleration, box and distance."""
    rng = np.random.default_rng((3, n))
    start, goal = scattered(rng, n, downwash), scattered(rng, n, downwash)
    found = plan_transfer(start, goal, downwash=downwash, **LIMITS)
    assert found is not None
    spans = len(found.control) - 3
    spline = BSpline(np.arange(-3, spans + 4) * found.duration / spans, found.control, 3)
    time = np.linspace(0.0, found.duration, 10_001)
    ways = Piecewise.b_spline(found.control, found.duration)
    np.testing.assert_allclose(ways.at(time), spline(time), atol=1e-12)
    np.testing.assert_allclose(spline(time[[0, -1]]), [start, goal], atol=1e-12)
    for order in (1, 2):
        np.testing.assert_allclose(spline(time[[0, -1]], order), 0.0, atol=1e-9)
    assert (np.abs(spline(time, 1)) <= 1.0 + 1e-9).all()
    assert (np.abs(spline(time, 2)) <= np.array([2.0, 2.0, 1.0]) * (1 + 1e-9)).all()
    assert (spline(time) >= np.array(BOX[0]) - 1e-9).all()
    assert (spline(time) <= np.array(BOX[1]) + 1e-9).all()
    least = min(pdist(r * [1, 1, 1 / downwash]).min() for r in spline(time))
    assert 0.3 <= found.certificate.separation <= least
    assert found.duration <= 2.5 * least_duration(start, goal, 1.0, (2.0, 2.0, 1.0))


def test_vehicles_change_sides_of_a_ring():
    """All straight ways meet in one point; none of those found does."""
    angle = np.arange(8) * np.pi / 4
    start = np.stack([1.2 * np.cos(angle), 1.2 * np.sin(angle), 1.2 + 0.0 * angle], axis=1)
    found = plan_transfer(start, np.roll(start, 4, axis=0), **LIMITS)
    assert found is not None
    assert found.certificate.separation >= 0.3


def test_a_certificate_of_bent_ways_is_a_tight_lower_bound():
    """Against dense samples of random quintics of five vehicles: never above, and below by no more than promised."""
    rng = np.random.default_rng(3)
    knots = np.array([0.0, 0.7, 2.0, 3.1])
    ways = rng.normal(size=(3, 5, 3, 6)) * [3.0, 2.0, 1.0, 0.5, 0.2, 0.1]
    proof = prove_ways(knots, ways, np.full(5, 0.1))
    least = np.inf
    for k, h in enumerate(np.diff(knots)):
        x = np.einsum("nqp,tp->tnq", ways[k], np.linspace(0, h, 40_001)[:, None] ** np.arange(6))
        for i in range(5):
            for j in range(i):
                least = min(least, float(np.linalg.norm(x[:, i] - x[:, j], axis=1).min()))
    assert proof.separation <= least - 0.2
    assert proof.separation >= least - 0.2 - PROOF_SLACK - 1e-6
    k = np.searchsorted(knots, proof.time, side="right") - 1
    x = ways[k] @ (proof.time - knots[k]) ** np.arange(6)
    i, j = proof.agents
    np.testing.assert_allclose(
        np.linalg.norm(x[i] - x[j]) - 0.2, proof.separation, atol=2 * PROOF_SLACK
    )


def test_vehicles_that_keep_their_distance_need_no_search():
    """A rigid turn: the distance is stationary everywhere, and the certificate is exact to its promise."""
    time = np.linspace(0.0, 2 * np.pi, 200)
    x = np.stack(
        [np.stack([np.cos(time + a), np.sin(time + a), 0 * time], 1) for a in (0.0, np.pi)], 1
    )
    v = np.stack(
        [np.stack([-np.sin(time + a), np.cos(time + a), 0 * time], 1) for a in (0.0, np.pi)], 1
    )
    proof = prove_ways(*Piecewise.hermite(time, np.stack([x, v, -x, -v])))
    assert 2.0 - 2 * PROOF_SLACK <= proof.separation <= 2.0


def test_the_slowest_vehicle_alone():
    """From rest to rest: short ways at full acceleration, long ones at full speed as well."""
    zero = np.zeros((1, 3))
    assert least_duration(zero, [[1.0, 0, 0]], 10.0, 4.0) == pytest.approx(1.0)
    assert least_duration(zero, [[10.0, 0, 0]], 2.0, 4.0) == pytest.approx(5.5)
    assert least_duration(zero, [[1.0, 0, 4.0]], np.inf, (4.0, 4.0, 1.0)) == pytest.approx(4.0)
    assert least_duration(zero, zero, 1.0, 1.0) == 0.0


def test_no_way_is_none():
    """Two cannot pass each other in a corridor that is as wide as one."""
    start = np.array([[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    within: dict[str, Any] = LIMITS | {"box": ((-1.5, 0.0, 1.0), (1.5, 0.0, 1.0))}
    assert plan_transfer(start, start[::-1], **within) is None


def test_vehicles_that_begin_too_near_are_named():
    """Nothing is searched for."""
    start = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 1.0], [0.6, 0.0, 1.0]])
    with pytest.raises(ValueError, match=r"vehicles 2 and 3 are 0\.1 m apart at the start"):
        plan_transfer(start, start + [0, 1, 0], **LIMITS)


def test_the_same_seed_finds_the_same_ways():
    """To the last bit; and where nobody has to move, nobody does."""
    rng = np.random.default_rng(0)
    start = scattered(rng, 5, 1.0)
    one, two = (plan_transfer(start, start[::-1], seed=4, **LIMITS) for _ in range(2))
    assert isinstance(one, Transfer)
    assert isinstance(two, Transfer)
    np.testing.assert_array_equal(one.control, two.control)
    still = plan_transfer(start, start, **LIMITS)
    assert still is not None
    assert np.ptp(still.control, axis=0).max() < 1e-6


def test_opposite_places():
    """Vehicles on a circle that all go to the opposite place, and so would all meet in its middle, have proved ways."""
    angle = 2.0 * np.pi * np.arange(16) / 16
    s = 4.0 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    found = plan_transfer(
        s, -s, distance=0.5, speed=1.7, acceleration=2.9, box=([-6.0] * 3, [6.0] * 3)
    )
    assert found is not None
    assert found.certificate.separation >= 0.5
    ways = Piecewise.b_spline(found.control, found.duration)
    places = ways.at(np.linspace(0.0, found.duration, 2001))
    np.testing.assert_allclose(places[[0, -1]], [s, -s], atol=1e-12)
    assert min(pdist(r).min() for r in places) >= found.certificate.separation - 1e-9
