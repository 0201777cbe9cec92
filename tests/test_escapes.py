"""The criterion by which scenes of moving obstacles count as feasible: `benchmarks/moving.py`."""

import numpy as np
import pytest


@pytest.fixture(scope="module")
def moving(benchmark_named):
    """The benchmark of things that move."""
    return benchmark_named("moving")


@pytest.mark.parametrize("n", [1, 8])
def test_an_escape_needs_no_more_thrust_than_there_is_and_no_foresight(moving, n):
    """Its accelerations stay within their share, it begins when a ball can be known, and keeps clear of both."""
    given = moving.scene(n, 5.0, 6.0, 3)
    clear, shift = moving.escapes(given)
    fly, t = np.array([5.0, 0.0, 0.0]), moving.LOOK * np.arange(shift.shape[1])
    a = np.diff(shift, 2, axis=1) / moving.LOOK**2
    assert np.linalg.norm(a, axis=2).max() <= moving.SHARE * moving.THRUST * (1 + 1e-9)
    seen = []
    for place, w in zip(given.place, given.velocity, strict=True):
        x = given.slots[:, None] + t[:, None] * (fly - w) - place
        seen.append(np.linalg.norm(x, axis=2).min(axis=0) <= moving.RANGE + moving.BALL)
    first = t[np.argmax(np.any(seen, axis=0))]
    assert np.any(seen)
    assert np.abs(shift[:, t <= first + moving.SETTLE - 1e-9]).max() == 0.0
    assert np.abs(shift).max() > 1.0
    assert 0 < clear.sum() < clear.size
    for k, i in np.argwhere(clear)[:: max(1, clear.sum() // 20)]:
        for place, w in zip(given.place, given.velocity, strict=True):
            x = given.slots[i] + t[:, None] * (fly - w) + shift[k] - place
            assert np.linalg.norm(x, axis=1).min() > moving.BALL + moving.RADIUS + moving.SPARE


def test_a_ball_too_fast_to_be_evaded_is_infeasible(moving):
    """Straight ahead, the way aside takes sqrt(2 d / a), for which the ball's way to the vehicle has to suffice."""
    given = moving.scene(1, 2.0, 2.0, 0)
    aside = moving.RADIUS + moving.BALL + moving.SPARE
    time = np.sqrt(2 * aside / (moving.SHARE * moving.THRUST)) + moving.SETTLE
    fastest = (moving.RANGE + moving.BALL) / time
    for closing, fits in (
        (0.85 * fastest, True),
        (1.05 * fastest, False),
    ):  # no direction is straight aside
        place, w = np.array([[3.0 * closing, 0, 0]]), np.array([[2.0 - closing, 0, 0]])
        assert moving.feasible(given._replace(place=place, velocity=w)) is fits


def test_balls_that_could_be_evaded_alone_may_be_infeasible_together(moving):
    """A scene of the benchmark in which each ball alone leaves an escape, and both leave none."""
    given = moving.scene(1, 5.0, 6.0, 971)
    for o in range(2):
        alone = given._replace(place=given.place[o : o + 1], velocity=given.velocity[o : o + 1])
        assert moving.feasible(alone)
    assert not moving.feasible(given)
