"""The monitor on curves made by hand and on short flights, against the same curves and flights sampled densely."""

import ctypes
import math
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rigidfleet as rf
from rigidfleet.kernel import monitor, records
from rigidfleet.kernel.engine import native, packing
from rigidfleet.kernel.problem import Problem, graph, workspace
from rigidfleet.kernel.records import FROM_KNOTS, KNOTS, Trail, bernstein_basis
from rigidfleet.mission import Mission, load_mission

#: Times within a step at which curves are sampled.
FINE = np.linspace(0.0, 1.0, 2001)
BASIS = bernstein_basis(FINE)
#: A box, and a fence round everything.
BOX = np.array([[0.5, -0.4, -0.3, 1.4, 0.5, 0.6]])
FENCE = np.array([[-3.0, -3.1, -3.2, 3.3, 3.4, 3.5]])
ALTITUDE = 0.4


class Watched:
    """Curves of N agents over steps, by control points (S, 5, 3N) of places and of velocities, watched by the monitor.

    In body axes, quaternions (S, 5, 4), and centres with their velocities (S, 5, 6), are given, too.
    """

    def __init__(
        self, r: np.ndarray, v: np.ndarray, clock: np.ndarray, *, radius: Any, body: Any = None, boxes: Any = None,
        fence: Any = None, **changes: Any,
    ) -> None:  # fmt: skip
        self.n = r.shape[2] // 3
        self.radius = np.broadcast_to(np.asarray(radius, dtype=float), self.n).copy()
        extra = np.zeros((*r.shape[:2], 10)) if body is None else np.concatenate(body, axis=2)
        points = np.ascontiguousarray(np.concatenate([r, v, extra], axis=2))
        problem, state = packing.example_of(Problem), packing.example_of(records.IntegratorState)
        vehicles = problem.vehicles._replace(m=np.ones(self.n))
        self.problem = problem._replace(vehicles=vehicles, body_formulation=body is not None)
        trail = Trail(
            np.asarray(clock, dtype=float), points, np.zeros((len(points), 0)), np.zeros(0)
        )
        self.state = state._replace(trail=trail, count=np.zeros_like(state.count))
        pairs = np.array(list(combinations(range(self.n), 2)), dtype=np.int64).reshape(-1, 2)
        none = np.zeros((0, 6))
        every: dict[str, Any] = {
            "worst": np.full(records.EXTREMA, np.inf), "when": np.zeros(records.EXTREMA),
            "who": np.full((records.EXTREMA, 2), -1), "sign": np.zeros(1), "left": np.ones(self.n, dtype=np.bool_),
            "standing": np.zeros(self.n, dtype=np.int64), "low": np.full((self.n, 3), np.inf), "pad": 0.0,
            "altitude": math.inf, "pairs": pairs, "columns": pairs, "struck": np.zeros((0, 2), dtype=np.int64),
        } | changes  # fmt: skip
        self.watch = native.Watch(
            records.new_monitor(
                self.radius, none if boxes is None else boxes, none if fence is None else fence, points.shape[2], 0,
                **every,
            )
        )  # fmt: skip
        self.monitor = self.watch.monitor

    def take(self) -> "Watched":
        self.watch.search_distances(self.problem, self.state, 0, len(self.state.trail.clock))
        return self

    def worst(self, kind: int) -> tuple[float, float, list[int]]:
        m = self.monitor
        return float(m.worst[kind]), float(m.when[kind]), m.who[kind].tolist()


def least(values: np.ndarray, clock: np.ndarray) -> tuple[float, float, int]:
    """The least of samples (S, K, ...) within steps: the value, its time, and its place in what is left."""
    flat = values.reshape(*values.shape[:2], -1)
    s, k, who = np.unravel_index(int(flat.argmin()), flat.shape)
    return float(flat[s, k, who]), float(clock[s, 0] + FINE[k] * clock[s, 1]), int(who)


def expected(r: np.ndarray, v: np.ndarray, radius: np.ndarray) -> dict[int, np.ndarray]:
    """Each quantity at samples (S, K, who) of places and velocities (S, K, N, 3)."""
    i, j = np.triu_indices(r.shape[2], 1)
    x, radii = r[:, :, i] - r[:, :, j], radius[i] + radius[j]
    apart, flat = np.linalg.norm(x, axis=3) - radii, np.linalg.norm(x[..., :2], axis=3)
    high = np.maximum(r[:, :, i, 2], r[:, :, j, 2]) >= ALTITUDE
    beyond = np.linalg.norm(np.maximum(np.maximum(BOX[0, :3] - r, r - BOX[0, 3:]), 0.0), axis=3)
    inside = np.minimum(r - BOX[0, :3], BOX[0, 3:] - r).min(axis=3)
    speed = np.linalg.norm(v, axis=3)
    return {
        records.SEPARATION: apart,
        records.SEPARATION_FLYING: np.where(high, apart, np.inf),
        records.SEPARATION_BELOW: np.where(flat <= radii, np.abs(x[..., 2]) - radii, np.inf),
        records.CLEARANCE: np.where(beyond > 0.0, beyond, -inside) - radius,
        records.GEOFENCE: np.concatenate([r - FENCE[0, :3], FENCE[0, 3:] - r], axis=3).min(axis=3),
        records.LOWEST: r[..., 2],
        records.HIGHEST: -r[..., 2],
        records.SPEED: -speed,
        records.HORIZONTAL_SPEED: -np.linalg.norm(v[..., :2], axis=3),
        records.VERTICAL_SPEED: -np.abs(v[..., 2]),
    }


PAIRWISE = {records.SEPARATION, records.SEPARATION_FLYING, records.SEPARATION_BELOW}
#: Quantities that jump where an overlap or an altitude begins: known to what is flown between samples, as is the
#: clearance where the nearest side changes.
JUMPS = {records.SEPARATION_FLYING, records.SEPARATION_BELOW}


def agrees(
    outcome: Watched,
    right: dict[int, np.ndarray],
    clock: np.ndarray,
    close: float,
    kinds: Any = None,
) -> None:
    """Assert that each worst value is that of the samples, with its time and whom it concerns."""
    pairs = list(combinations(range(outcome.n), 2))
    for kind in right if kinds is None else kinds:
        value, t, who = least(right[kind], clock)
        x, when, whom = outcome.worst(kind)
        if not np.isfinite(value):
            continue
        slack = 4e-3 if kind in JUMPS or kind == records.CLEARANCE else close
        assert x <= value + 1e-6, (kind, x, value)
        assert x >= value - slack, (kind, x, value)
        if kind in JUMPS and x < value - close:
            continue
        mine = pairs[who] if kind in PAIRWISE else (who, 0 if kind == records.CLEARANCE else -1)
        assert whom == list(mine), kind
        assert when == pytest.approx(t, abs=2e-2 * clock[0, 1])


def curves(
    rng: np.random.Generator, steps: int, n: int, size: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Control points (S, 5, 3N) of random places and velocities, and a clock (S, 2)."""
    clock = np.stack([np.arange(steps) * 0.5 + 2.0, np.full(steps, 0.5)], axis=1)
    shape = steps, 5, 3 * n
    return rng.normal(size=shape), rng.normal(size=shape), clock


def sampled(points: np.ndarray) -> np.ndarray:
    """Samples (S, K, N, 3) of curves with control points (S, 5, 3N)."""
    return (BASIS @ points).reshape(len(points), len(FINE), -1, 3)


@pytest.mark.parametrize("seed", range(6))
def test_extremes_of_curves_are_those_of_dense_samples(seed):
    """Distances, heights, speeds of random quartics: values, times and whom they concern."""
    rng = np.random.default_rng(seed)
    n, steps = 4, 2
    r, v, clock = curves(rng, steps, n)
    radius = rng.uniform(0.05, 0.3, n)
    outcome = Watched(r, v, clock, radius=radius, boxes=BOX, fence=FENCE, altitude=ALTITUDE).take()
    agrees(outcome, expected(sampled(r), sampled(v), radius), clock, 2e-4)


@pytest.mark.parametrize("seed", range(3))
def test_of_many_agents_the_one_that_comes_nearest_to_a_box_is_not_passed_over(seed):
    """Most of sixty are farther away from a box than others have been, and not looked at: never the nearest one."""
    rng = np.random.default_rng(seed)
    n = 60
    centre = rng.normal(size=(n, 3))
    centre *= rng.uniform(1.5, 3.0, (n, 1)) / np.linalg.norm(centre, axis=1, keepdims=True)
    r = (0.6 * rng.normal(size=(1, 5, n, 3)) + centre).reshape(1, 5, 3 * n)
    clock = np.array([[0.0, 0.5]])
    none = np.zeros((0, 2), dtype=np.int64)
    outcome = Watched(r, 0 * r, clock, radius=0.1, boxes=BOX, pairs=none, columns=none).take()
    x = sampled(r)
    beyond = np.linalg.norm(np.maximum(np.maximum(BOX[0, :3] - x, x - BOX[0, 3:]), 0.0), axis=3)
    inside = np.minimum(x - BOX[0, :3], BOX[0, 3:] - x).min(axis=3)
    clearance = np.where(beyond > 0.0, beyond, -inside) - 0.1
    agrees(outcome, {records.CLEARANCE: clearance}, clock, 1e-4)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("axis", range(3))
def test_one_that_hurries_away_from_a_box_is_not_passed_over(axis, side):
    """It is nearest at the beginning of a step whose middle is far away: 0.3 m from a face, where others were 0.5."""
    face = np.where(side > 0.0, BOX[0, 3:], BOX[0, :3])
    middle = 0.5 * (BOX[0, :3] + BOX[0, 3:])
    ways = np.array([np.full(5, 0.5), 0.3 + 0.6 * np.arange(5.0)])
    r = np.tile(middle, (2, 5, 1))
    r[:, :, axis] = face[axis] + side * ways
    clock = np.array([[0.0, 0.5], [0.5, 0.5]])
    outcome = Watched(r, 0 * r, clock, radius=0.1, boxes=BOX).take()
    assert outcome.worst(records.CLEARANCE) == (pytest.approx(0.2), 0.5, [0, 0])


def test_speeds_by_direction_are_not_searched_for_where_they_have_no_limit():
    """Minus infinity as the worst value so far says so."""
    r, v, clock = curves(np.random.default_rng(0), 1, 2)
    worst = np.full(records.EXTREMA, np.inf)
    worst[[records.HORIZONTAL_SPEED, records.VERTICAL_SPEED]] = -np.inf
    outcome = Watched(r, v, clock, radius=0.1, worst=worst.copy()).take()
    assert np.array_equal(outcome.monitor.worst == -np.inf, worst == -np.inf)
    assert outcome.worst(records.SPEED)[0] < 0.0


def test_agents_that_are_lost_are_watched_no_more_but_where_they_strike():
    """Of four, one is lost: heights, speeds and pairs are those of the others, and what it may strike is told apart."""
    rng = np.random.default_rng(5)
    r, v, clock = curves(rng, 2, 4)
    left = np.array([True, False, True, True])
    pairs = np.array([(0, 2), (0, 3), (2, 3)])
    struck = np.array([(1, 0), (1, 2), (1, 3)])
    outcome = Watched(
        r, v, clock, radius=0.1, left=left, pairs=pairs, columns=pairs, struck=struck
    ).take()
    x, u = sampled(r), sampled(v)
    right = expected(x, u, outcome.radius)
    for kind in (records.LOWEST, records.HIGHEST, records.SPEED):
        value, t, who = least(right[kind][:, :, left], clock)
        assert outcome.worst(kind)[0] == pytest.approx(value, abs=1e-5)
        assert outcome.worst(kind)[2] == [int(np.flatnonzero(left)[who]), -1]
    for kind, among in ((records.SEPARATION, pairs), (records.LOST, struck)):
        apart = np.linalg.norm(x[:, :, among[:, 0]] - x[:, :, among[:, 1]], axis=3) - 0.2
        value, t, who = least(apart, clock)
        assert outcome.worst(kind)[0] == pytest.approx(value, abs=1e-5)
        assert outcome.worst(kind)[1] == pytest.approx(t, abs=1e-3)
        assert outcome.worst(kind)[2] == among[who].tolist()


def turning(rng: np.random.Generator, steps: int, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Control points of quaternions (S, 5, 4) of axes that turn, and samples of the matrices (S, K, 3, 3) to them."""
    axis, begun = rng.normal(size=3), Rotation.from_rotvec(rng.normal(size=3))
    axis /= np.linalg.norm(axis)
    times = np.arange(steps)[:, None] * 0.5 + 0.5 * KNOTS
    q = (begun * Rotation.from_rotvec(rate * times.reshape(-1, 1) * axis)).as_quat(
        scalar_first=True
    )
    q *= np.sign(q @ q[0])[:, None]
    points = FROM_KNOTS @ q.reshape(steps, 5, 4)
    matrices = Rotation.from_quat((BASIS @ points).reshape(-1, 4)[:, [1, 2, 3, 0]]).as_matrix()
    return points, matrices.reshape(steps, len(FINE), 3, 3)


@pytest.mark.parametrize("obstacles", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_extremes_of_curves_in_body_axes_are_those_of_the_world(seed, obstacles):
    """Places and velocities in axes that turn and travel: extremes of where they are in the world.

    Without obstacles and fences, few agents are looked at; those passed over are neither fastest, lowest nor highest.
    """
    rng = np.random.default_rng(seed)
    n, steps = 5, 2
    r, v, clock = curves(rng, steps, n)
    # Agents that move little about places of their own, as in a formation
    r = 0.05 * r + np.tile(rng.normal(size=3 * n), (steps, 5, 1))
    v = 0.3 * v + np.tile(rng.normal(size=3 * n), (steps, 5, 1))
    q, T = turning(rng, steps, 1.5)
    centre = 0.3 * rng.normal(size=(steps, 5, 6))
    some = (
        {"boxes": BOX, "fence": FENCE, "altitude": ALTITUDE}
        if obstacles
        else {"columns": np.zeros((0, 2), int)}
    )
    outcome = Watched(r, v, clock, radius=0.1, body=(q, centre), **some).take()
    c = BASIS @ centre
    x, u = (
        sampled(r) @ T.swapaxes(2, 3) + c[:, :, None, :3],
        sampled(v) @ T.swapaxes(2, 3) + c[:, :, None, 3:],
    )
    alone = {records.SEPARATION, records.LOWEST, records.HIGHEST, records.SPEED}
    agrees(outcome, expected(x, u, outcome.radius), clock, 1e-4, None if obstacles else alone)


@pytest.mark.parametrize("axis", range(3))
def test_of_many_agents_in_body_axes_the_extreme_ones_are_looked_at(axis):
    """Of twenty in axes that turn, the centre travelling, the last is the fastest, and reaches farthest, along an axis.

    It is outcome although all others have been looked at before.
    """
    rng = np.random.default_rng(3)
    n, steps = 20, 2
    place, speed = rng.normal(size=(n, 3)), rng.normal(size=(n, 3)) * rng.uniform(0.0, 1.0, (n, 1))
    place[-1], speed[-1] = 0.0, 0.0
    place[-1, axis], speed[-1, axis] = 4.0, 5.0
    r, v = (np.tile(x.reshape(-1), (steps, 5, 1)) for x in (place, speed))
    q, T = turning(rng, steps, 2.0)
    centre = 0.5 * rng.normal(size=(steps, 5, 6))
    clock = np.stack([np.arange(steps) * 0.5, np.full(steps, 0.5)], axis=1)
    none = np.zeros((0, 2), dtype=np.int64)
    outcome = Watched(r, v, clock, radius=0.1, body=(q, centre), pairs=none, columns=none).take()
    c = BASIS @ centre
    x = place @ T.swapaxes(2, 3) + c[:, :, None, :3]
    u = speed @ T.swapaxes(2, 3) + c[:, :, None, 3:]
    right = {
        records.LOWEST: x[..., 2],
        records.HIGHEST: -x[..., 2],
        records.SPEED: -np.linalg.norm(u, axis=3),
    }
    agrees(outcome, right, clock, 1e-4)


# -- bounds of how far distances change ----------------------------------------------------------------


@pytest.mark.parametrize("body", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_no_distance_changes_by_more_than_its_bound(seed, body):
    """In space and as seen from above, for random curves, one agent lost; and what turns as one has small bounds."""
    rng = np.random.default_rng(seed)
    n = 5
    place, drift, w = rng.normal(size=(n, 3)), rng.normal(size=3), 0.05 * rng.normal(size=3)
    turned = Rotation.from_rotvec(KNOTS[:, None] * w)
    at_knots = np.stack([t.apply(place) for t in turned]) + KNOTS[:, None, None] * drift
    loose = 0.3 * rng.normal(size=(5, 3 * n)) if seed % 2 else 0.0
    left = np.array([True] * 4 + [False])
    r = (FROM_KNOTS @ at_knots.reshape(5, -1))[None] + loose
    r[0, :, 12:] += 50.0 * rng.normal(size=(5, 3))  # the one that is lost
    none = np.zeros((0, 2), dtype=np.int64)
    axes = None
    T = np.tile(np.eye(3), (1, len(FINE), 1, 1))
    if body:
        q, T = turning(rng, 1, 0.1)
        axes = q, np.zeros((1, 5, 6))
    outcome = Watched(
        r, 0 * r, np.array([[0.0, 0.5]]), radius=0.1, left=left, body=axes, pairs=none, columns=none
    )
    outcome.watch.write_first_step_change_bounds(outcome.problem, outcome.state)
    space, above = outcome.monitor.moves
    x = (sampled(r) @ T.swapaxes(2, 3))[0, :, :4]
    i, j = np.triu_indices(4, 1)
    for bound, axes_seen in ((space, 3), (above, 2)):
        lengths = np.linalg.norm((x[:, i] - x[:, j])[..., :axes_seen], axis=2)
        assert np.abs(lengths - lengths[0]).max() <= bound + 1e-9
    if seed % 2 == 0:
        far, turn = (
            np.linalg.norm(place[:4] - place[:4].mean(axis=0), axis=1).max(),
            np.linalg.norm(w),
        )
        assert space < 0.2 * turn * far
        # Seen from above, what tilts; in axes that turn by .05 rad, of which nobody knows where up is, by all of it.
        tilt = 0.05 / 0.9 + turn if body else math.hypot(w[0], w[1])
        assert above - space == pytest.approx(2.0 * tilt * far, rel=0.05)


@pytest.mark.parametrize("axis", range(3))
def test_one_that_moves_alone_changes_its_distances_by_its_way(axis):
    """Three stay together and one leaves them by a metre: the bound is at least that, and at most twice as much."""
    place = 0.3 * np.random.default_rng(axis).normal(size=(4, 3))
    place[3, axis] += 6.0
    r = np.tile(place.reshape(-1), (1, 5, 1))
    r[0, :, 9 + axis] += KNOTS
    none = np.zeros((0, 2), dtype=np.int64)
    outcome = Watched(r, 0 * r, np.array([[0.0, 0.5]]), radius=0.1, pairs=none, columns=none)
    outcome.watch.write_first_step_change_bounds(outcome.problem, outcome.state)
    assert 0.95 <= outcome.monitor.moves[0] <= 2.0


# -- forces --------------------------------------------------------------------------------------------


class Pushed:
    """Two agents whose thrust, acceleration and constraint force are curves of time, watched over steps.

    ``curves`` takes times (K,) to values (6, K), in the order of a gauge. A recorder of its own gives them.
    """

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        curves: Any,
        clock: np.ndarray,
        rows: int | None = None,
    ) -> None:
        self.clock, self.curves, self.evaluated = clock, curves, []
        problem, state = packing.example_of(Problem), packing.example_of(records.IntegratorState)
        mass, rows = np.ones(2), rows or len(clock)
        vehicles = problem.vehicles._replace(m=mass, thrust_limit=np.full(2, np.inf))
        none = graph(np.zeros((0, 2), dtype=np.int64), mass)
        self.problem, self.work = problem._replace(vehicles=vehicles, graph=none), workspace(2, 0)
        self.trail = Trail(
            np.zeros((rows, 2)), np.zeros((rows, 5, 12)), np.zeros((rows, 6)), np.zeros(6)
        )
        self.state = state._replace(trail=self.trail, count=np.zeros_like(state.count))
        word = ctypes.c_int64
        self.entry = ctypes.CFUNCTYPE(word, *(word,) * 4)(self.record)
        address = ctypes.cast(self.entry, ctypes.c_void_p).value
        monkeypatch.setattr(native, "recorder_address", lambda: address)
        boxes = np.zeros((0, 6))
        self.watch = native.Watch(records.new_monitor(np.ones(2), boxes, boxes, 12, 6))

    def at(self, t: float) -> np.ndarray:
        return self.curves(np.array([t]))[:, 0]

    def record(self, *_: int) -> int:
        t = float(self.watch.monitor.time[0])
        self.evaluated.append(t)
        thrust, a, f = self.at(t).reshape(3, 2)
        for values, of in ((self.work.f_C, f), (self.work.a, a)):
            values[:] = 0.0
            values[:, 1] = of
        self.work.f_u[:] = -self.work.f_C
        self.work.f_u[:, 0] += thrust
        return 0

    def take(self, *cuts: int) -> dict[int, list[float]]:
        """Watch all steps, of which so many come at a time; values, times and agents of the extremes."""
        count, done = self.state.count, 0
        self.trail.start[:] = self.at(self.clock[0, 0])
        for cut in [*cuts, len(self.clock) - sum(cuts)]:
            for k in range(done, done + cut):
                row = (count[records.FIRST_ROW] + count[records.TRAILED]) % len(self.trail.clock)
                self.trail.clock[row], self.trail.gauge[row] = (
                    self.clock[k],
                    self.at(self.clock[k].sum()),
                )
                count[records.TRAILED] += 1
            done += cut
            last = done == len(self.clock)
            self.watch.search_forces(self.problem, self.work, self.state, last=last)
        m = self.watch.monitor
        assert m.count[records.STAYED] == count[records.TRAILED] == 0
        return {kind: [-m.worst[kind], m.when[kind], *m.who[kind].tolist()] for kind in PUSHES}


PUSHES = records.THRUST, records.ACCELERATION, records.CONSTRAINT_FORCE


def hills(at: Any, width: float) -> Any:
    """Curves (6, K) with a hill each, at times ``at`` (6,), the one of an agent higher than that of the other."""
    tops = np.array([5.0, 4.0, 2.0, 3.0, 7.0, 6.0])

    def curves(t: np.ndarray) -> np.ndarray:
        x = (t - np.reshape(at, (-1, 1))) / width
        return tops[:, None] * (0.5 + 0.5 * np.exp(-x * x))

    return curves


@pytest.mark.parametrize("steps", [1, 2, 5])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.5, 0.7, 0.98])
def test_the_greatest_forces_are_found_in_whichever_step_they_are(monkeypatch, steps, share):
    """In the first and the last step as well, which have no neighbour, and wherever the trail is cut.

    Each sort of force has a hill in a step of its own. At the very start or end, a hill shows in the step beside it.
    """
    lengths = 0.1 + 0.02 * np.arange(steps)
    ends = 3.0 + np.cumsum(lengths)
    clock = np.stack([ends - lengths, lengths], axis=1)
    inside = np.arange(share < 0.3, steps - (share > 0.7))
    for first in inside:
        step = inside[(first + np.array([0, 0, 1, 1, 2, 2])) % len(inside)]
        at = clock[step, 0] + share * clock[step, 1]
        whole = Pushed(monkeypatch, hills(at, 0.12), clock)
        outcome = whole.take()
        for k, (kind, most, who) in enumerate(zip(PUSHES, (5.0, 3.0, 7.0), (0, 1, 0), strict=True)):
            value, when, *whom = outcome[kind]
            assert value == pytest.approx(most, rel=1e-5)
            assert when == pytest.approx(at[2 * k], abs=1e-2 * lengths[0])
            assert whom == [who, -1]
        for cuts in [(1,) * (steps - 1), *((k,) for k in range(1, steps))]:
            again = Pushed(monkeypatch, hills(at, 0.12), clock, rows=steps if len(cuts) == 1 else 3)
            assert again.take(*cuts) == outcome
            assert again.evaluated == whole.evaluated


@pytest.mark.parametrize("top", [0.35, 0.2002, 0.1999, 0.2, 0.1])
@pytest.mark.parametrize("middle", [0.2, 0.5])
def test_a_parabola_is_searched_at_its_top_and_not_beside_its_middle(top, middle):
    """The law is evaluated at the top; nearer to the middle than 0.001 of all, there, on the side that has more room.

    What is expected is the rise above the worst value, with that above the middle twice.
    """
    start, end, highest, worst = 3.0, 4.0, 8.0, 7.9
    top, middle = start + top + (middle - 0.2), start + middle
    a, b, v = (highest - 2.0 * (t - top) ** 2 for t in (start, middle, end))
    vehicles, graph_of = (
        SimpleNamespace(m=np.ones(2)),
        SimpleNamespace(edges=np.zeros((1, 2)), solver=0),
    )
    p = SimpleNamespace(vehicles=vehicles, graph=graph_of)
    excess = getattr(monitor.parabola_excess_and_time, "py_func", monitor.parabola_excess_and_time)
    more, at = excess(0, worst, a, b, v, start, middle, end, p, SimpleNamespace(worst=np.zeros(21)))
    assert more == pytest.approx((2.0 * highest - b - worst) / worst, abs=1e-6)
    aside = 1e-3 if end - middle > middle - start else -1e-3
    assert at == pytest.approx(top if abs(top - middle) >= 1e-3 else middle + aside, abs=1e-9)


def windy(**tables: Any) -> Mission:
    """Three agents in gusts and noise for a second: two phases, of which the second begins with a jump."""
    data = load_mission("windy-passage").to_dict()
    first = data["phases"][0] | {"name": "a", "blend": 0.4, "until": 0.5}
    first.pop("settle", None)
    hold = {
        "kind": "hold",
        "control": "open",
        "until": 0.8,
        "name": "b",
        "input_force": [0.0, 0.0, 0.5],
    }
    data |= {"phases": [first, hold], "output_step": 0.5}
    free = {"horizontal_speed": 99.0, "vertical_speed": 99.0, "horizontal_acceleration": 99.0,
            "vertical_acceleration": 99.0}  # fmt: skip
    data["limits"] = data.get("limits", {}) | free
    data["agents"] |= {"thrust_limit": [23.6, 14.0, 12.0]}
    return Mission.from_dict(data | tables)


def test_greatest_forces_of_a_flight_are_those_of_dense_samples():
    """Thrusts, accelerations, forces and tensions of edges: no sample is greater, and near each peak one is as great.

    Whom they concern, and when, as well.
    """
    mission = windy()
    result = rf.simulate(mission, times=np.linspace(0.0, 0.8, 1601))
    length = np.linalg.norm
    of_agents = {
        "thrust": result.thrust,
        "acceleration": length(result.acceleration, axis=2),
        "constraint_force": length(result.constraint_force, axis=2),
        "horizontal_acceleration": length(result.acceleration[..., :2], axis=2),
        "vertical_acceleration": np.abs(result.acceleration[..., 2]),
        "speed": length(result.velocity, axis=2),
    }
    of_edges = {"tension": result.multiplier, "constraint": result.constraint}
    for k, phase in enumerate(result.phases):
        here = result.phase == k
        at = np.flatnonzero(here)
        beyond = {"thrust_margin": (result.thrust - mission.agents.thrust_limit)[at]}
        sizes = {
            name: np.abs(values[at]) for name, values in (of_agents | of_edges).items()
        } | beyond
        for name, size in sizes.items():
            if name not in phase.extremes:
                assert not np.isfinite(size).any()
                continue
            x = phase.extremes[name]
            sample, column = np.unravel_index(int(np.nanargmax(size)), size.shape)
            most, outcome = float(size[sample, column]), x.value if name in beyond else abs(x.value)
            assert outcome >= most - 1e-5 * abs(most), (name, outcome, most)
            assert outcome <= most + 2e-3 * max(1.0, abs(most)), (name, outcome, most)
            if abs(outcome - most) < 1e-4 * abs(most):
                assert x.time == pytest.approx(result.time[at][sample], abs=2e-3), name
                whom = (column, -1) if name not in of_edges else tuple(result.edges[column])
                assert (x.who, x.other) == whom, name
            if name == "tension":
                assert (
                    x.value * result.multiplier[at][sample, column] < 0.0
                )  # tensions are positive
