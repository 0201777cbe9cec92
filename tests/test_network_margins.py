"""What check says that a formation by neighbours bears: delays and losses, beside flights of the product."""

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
from oracles import FULL
from test_network import CUBE, EDGES, fly, laid_out, mission

import rigidfleet as rf
from rigidfleet._common.facts import FactTable
from rigidfleet.kernel import fleet
from rigidfleet.kernel.mail import LOST, SENT
from rigidfleet.math import pid
from rigidfleet.math.margins import GROWTH
from rigidfleet.planning.preview import preview_phases
from rigidfleet.planning.vehicles import lags_by_vehicle
from rigidfleet.preflight.linear_flight import LinearFlight
from rigidfleet.preflight.network import (
    greatest_stable_loss,
    growth_rate_at_delay,
    last_stable_delay,
    linear_flights,
    rms_growth,
)
from rigidfleet.typing import Bools, Floats

#: Deviations at the start [m]: the flight is then linear to as many digits.
SMALL = 1e-6


def still(
    network: dict[str, Any], r: Floats = CUBE, edges: list[list[int]] = EDGES, **tables: Any
) -> rf.Mission:
    """Points that begin in their slots r (N, 3) and hold them."""
    formations = {"cube": {"slots": r.tolist(), "edges": edges}}
    agents = {"position": (r + [0, 0, 50]).tolist(), "vehicle": "p"}
    tables = {"agents": agents, "formations": formations} | tables
    return mission(network, time=600.0, **tables)


def linear_flight(m: rf.Mission) -> LinearFlight:
    """The linear flight of its formation."""
    ((_, flight, _),) = linear_flights(m, preview_phases(m)[0], lags_by_vehicle(m))
    return flight


def disturbed(m: rf.Mission, seed: int = 0, **changes: Any) -> tuple[Any, ...]:
    """The product's flight with every edge held, SMALL off its slots at random; ``changes`` of its network."""
    problem, work, flight, state = laid_out(m)
    loss_free = flight._replace(network=flight.network._replace(worsens=0.0))
    fly(problem, work, loss_free, state, 2 * (flight.network.delay + flight.network.silence) + 60)
    assert (state.mail.grip == 1.0).all()
    changes = {"silence": 10**9} | changes
    flight = flight._replace(network=flight.network._replace(**changes))
    state.S[:, :3] += SMALL * np.random.default_rng(seed).normal(size=(len(state.S), 3))
    return problem, work, flight, state


def off(state: Any, m: rf.Mission) -> Floats:
    """Places (N, 3) off the slots [m]."""
    return state.S[:, :3] - np.array(m.agents.position)


def errors(state: Any, m: rf.Mission) -> Floats:
    """Errors of edges to first order [m]."""
    x, r, edges = off(state, m), np.array(m.agents.position), m.formation_edges("cube")
    d = r[edges[:, 0]] - r[edges[:, 1]]
    return ((x[edges[:, 0]] - x[edges[:, 1]]) * d).sum(axis=1) / np.linalg.norm(d, axis=1)


def kick(flight: LinearFlight, x0: Floats, depth: int) -> tuple[Floats, Floats]:
    """State of a linear flight x0 (N, 3) [m] off, and the messages of `depth` ticks before."""
    x = np.zeros((flight.size, 1))
    x[: x0.size, 0] = x0.ravel()
    return x, np.zeros((depth, *flight.shape, 1))


UNEQUAL = {
    "agents": {
        "position": (CUBE + [0, 0, 50]).tolist(),
        "vehicle": [f"v{i % 3}" for i in range(8)],
    },
    "vehicles": {
        f"v{k}": {"model": "point", "mass": 0.5 + k, "thrust_limit": 100.0, "drag": 0.2 * k}
        for k in range(3)
    },
}


@pytest.mark.parametrize(
    ("tables", "loss", "changes"),
    [
        ({}, 0.4, {}),
        ({"tracking": {"integral": 0.3}}, 0.4, {}),
        ({"constraint": {"solver": "exact"}}, 0.4, {}),
        (UNEQUAL, 0.4, {}),
        ({"disturbances": {"noise": {"delay": 0.02, "rate": 50.0}}}, 0.4, {}),
        ({}, 0.7, {"silence": 5}),
        (UNEQUAL | {"constraint": {"solver": "exact"}}, 0.7, {"silence": 5}),
    ],
    ids=["default", "integral", "exact", "unequal", "late", "slipping", "slipping-exact"],
)
def test_the_linear_flight_is_the_flight(tables, loss, changes):
    """Of places 1e-6 m off, both keep five digits over 4 s, with the same messages lost and the same edges let go."""
    m = still({"delay": 0.06, "loss": loss}, **tables)
    problem, work, flight, state = disturbed(m, **changes)
    linear, delay = linear_flight(m), flight.network.delay
    x, sent = kick(linear, off(state, m), delay)
    most, least_grip = 0.0, 1.0
    for _ in range(200):
        fly(problem, work, flight, state, 1)
        # Messages of the next tick are under way, since delays are at least one tick.
        k, due = state.count[fleet.TICKS], state.mail.due
        arriving, grip = due[:, k % due.shape[1]] == k - delay, state.mail.grip[:, None]
        least_grip = min(least_grip, grip.min())
        _, x = linear.squares_and_end(
            x, sent, 1, delay, lambda _, news, now=arriving: now[:, None] * news(0), grip
        )
        sent = np.roll(sent, -1, axis=0)
        most = max(most, np.abs(off(state, m)).max())
        here = linear.parts(x).orders[0].reshape(-1, 3)
        np.testing.assert_allclose(here, off(state, m), rtol=0, atol=1e-5 * most)
    lost = state.mail.count[LOST].sum() / state.mail.count[SENT].sum()
    assert 0.2 < lost < loss + 0.1
    assert (least_grip == 0.0) == bool(changes)


def random_formation(seed: int) -> dict[str, Any]:
    """Three to seven points of unequal mass at least 1.5 m apart, with at least the edges of a chain, and their law."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 8))
    r = np.zeros((0, 3))
    while len(r) < n:
        r = rng.uniform(0, 6, (n, 3))
        apart = np.linalg.norm(r[:, None] - r, axis=2)[np.triu_indices(n, 1)]
        r = r if apart.min() > 1.5 else r[:0]
    pairs = [[i, j] for j in range(2, n + 1) for i in range(1, j)]
    edges = [pair for pair in pairs if pair[1] == pair[0] + 1 or rng.random() < 0.8]
    mass = rng.uniform(0.5, 2.0, n)
    return {
        "r": r,
        "edges": edges,
        "rate": float(rng.choice([25.0, 50.0])),
        "constraint": dict(
            zip(("alpha", "beta", "gamma"), pid.triple_pole(rng.uniform(1.0, 4.0)), strict=True)
        ),
        "agents": {"position": (r + [0, 0, 50]).tolist(), "vehicle": [f"v{i}" for i in range(n)]},
        "vehicles": {
            f"v{i}": {"model": "point", "mass": float(x), "thrust_limit": 1e3}
            for i, x in enumerate(mass)
        },
    }


def grows(tables: dict[str, Any], delay: int, seconds: float) -> bool:
    """Whether what is SMALL at the start grows 100 times within a time [s] in the product's flight."""
    m = still({"delay": delay / tables["rate"], "silence": 5.0}, **tables)
    problem, work, flight, state = disturbed(m)
    for _ in range(round(seconds / 10.0)):
        fly(problem, work, flight, state, round(10.0 * tables["rate"]))
        if np.abs(off(state, m)).max() > 100.0 * SMALL:
            return True
    return False


def wrong_delays(count: int, least: float, seconds: float) -> list[tuple[int, int]]:
    """Seeds of random formations whose last stable or first unstable delay flies otherwise, and the delay in ticks.

    Beyond the limit they are to grow by a share of at least ``least`` a second. What grows may have a twentieth of the
    deviation at the start.
    """
    wrong, seed, seen = [], 0, 0
    while seen < count:
        seed += 1
        tables = random_formation(seed)
        linear = linear_flight(still({}, **tables))
        last = last_stable_delay(linear)
        if (growth := growth_rate_at_delay(linear, last + 1)) < least:
            continue
        seen += 1
        wrong += [(seed, last)] if last and grows(tables, last, seconds) else []
        beyond = max(seconds, float(np.log(20.0 * 100.0)) / growth)
        wrong += [] if grows(tables, last + 1, beyond) else [(seed, last + 1)]
    return wrong


@pytest.mark.parametrize(("seed", "delay"), [(44, 2), (48, 7), (73, 2)])
def test_the_greatest_growth_is_that_of_the_whole_map(seed, delay):
    """Of formations with redundant edges, too, whose stresses neither grow nor decay: within 1e-4 a second."""
    linear = linear_flight(still({}, **random_formation(seed)))
    shape = (delay, *linear.shape)
    whole = linear.size + int(np.prod(shape))
    sent = np.eye(whole)[linear.size :].reshape(*shape, whole).copy()
    start = np.eye(whole)[: linear.size]
    _, x = linear.squares_and_end(start, sent, 1, delay, lambda k, news: news(0))
    tick = np.concatenate([x, np.roll(sent, -1, axis=0).reshape(-1, whole)])
    radius = np.abs(np.linalg.eigvals(tick)).max()
    assert growth_rate_at_delay(linear, delay) == pytest.approx(
        np.log(radius) / linear.radio.tick, abs=1e-4
    )


@pytest.mark.parametrize("late", [0.0, 0.05])
def test_motions_of_the_whole_formation_do_not_count(late):
    """Nobody feels that a formation without slots moves as a whole: what is left decays at small delays, by 1 a second.

    At seven ticks it grows.
    """
    hold = {"kind": "establish", "formation": "cube", "duration": 5.0, "control": "open"}
    noise: dict[str, Any] = (
        {"disturbances": {"noise": {"delay": late, "rate": 50.0}}} if late else {}
    )
    linear = linear_flight(still({"delay": 0.04}, phases=[hold], **noise))
    assert linear.is_free
    assert growth_rate_at_delay(linear, 1) < -1.0
    assert growth_rate_at_delay(linear, 7) > 1.0


@pytest.mark.parametrize("seed", [2, 48])
def test_the_last_stable_delay_is_the_last_one(seed):
    """Found roughly first, it is where the accurate growth begins: none at it, some at one tick more."""
    linear = linear_flight(still({}, **random_formation(seed)))
    last = last_stable_delay(linear)
    assert growth_rate_at_delay(linear, last) < GROWTH <= growth_rate_at_delay(linear, last + 1)


def test_the_last_stable_delay_flies():
    """Random formations fly stable for 100 s at the last stable delay and grow 100 times at one tick more."""
    assert wrong_delays(2, 0.1, 100.0) == []


@pytest.mark.long
def test_the_last_stable_delays_of_many_formations():
    """So do 99 % of 200 (a tenth of them in CI) whose growth beyond is as low as 1 % a second, over 500 s."""
    count = 200 if FULL else 20
    assert len(wrong_delays(count, 0.01, 500.0)) <= count // 100


def exact_growth(linear: LinearFlight, delay: int, loss: float, ticks: int) -> float:
    """Growth [1/s] of the root mean square of errors by the map of the second moment itself, written out."""
    size, shape = linear.size, (delay, *linear.shape)
    whole = size + int(np.prod(shape))

    def columns(keep: Any) -> Floats:
        sent = np.eye(whole)[size:].reshape(*shape, whole).copy()
        x = np.eye(whole)[:size].copy()
        _, x = linear.squares_and_end(x, sent, 1, delay, keep)
        return np.concatenate([x, np.roll(sent, -1, axis=0).reshape(-1, whole)])

    L, q = linear.shape[1], 1.0 - loss
    lost = columns(lambda k, change: 0.0)
    change = [
        columns(lambda k, change, l=l: (np.arange(L) == l)[:, None] * change(0)) - lost
        for l in range(L)
    ]
    A = lost + q * sum(change)
    # Each link changes some rows only.
    rows = [np.flatnonzero(np.abs(B).max(axis=1)) for B in change]
    parts = [B[own] for B, own in zip(change, rows, strict=True)]
    place = slice(0, 3 * linear.n)
    P, watch, squares = np.zeros((whole, whole)), np.zeros((len(linear.r), whole)), []
    P[place, place] = np.eye(place.stop - place.start)
    watch = linear.edges.toarray()
    for _ in range(ticks):
        new = A @ P @ A.T
        for own, B in zip(rows, parts, strict=True):
            new[np.ix_(own, own)] += q * loss * B @ P @ B.T
        P = new
        squares.append(np.trace(watch @ P[place, place] @ watch.T))
    half = ticks // 2
    return float(
        0.5 * np.log(squares[-1] / squares[half - 1]) / ((ticks - half) * linear.radio.tick)
    )


@pytest.mark.parametrize("loss", [0.6, 0.95])
def test_the_second_moment_moves_by_its_map(loss):
    """Carried by some states, it grows as P -> E[A P A^T] of two vehicles, written out in full, within .03 a second."""
    linear = linear_flight(still({"delay": 0.04}, CUBE[:2], [[1, 2]]))
    expected = exact_growth(linear, linear.radio.delay, loss, 500)
    assert (expected > 0.0) == (loss == 0.95)
    (growth,) = rms_growth(linear, np.array([loss]), states=64)
    assert growth == pytest.approx(expected, abs=0.03)


TRIANGLE = np.array([[0, 0, 0], [4, 0, 0], [2, 2 * 3**0.5, 0]])
PAIRS = [[1, 2], [1, 3], [2, 3]]


def squares_flown(m: rf.Mission, flights: int, seconds: float, ticks: int = 10) -> Floats:
    """Squares of errors of edges (flights, rows) each few ticks, in flights of the product with losses of their own."""
    problem, work, flight, state = disturbed(m)
    rows = round(seconds * m.autopilot.rate / ticks)
    squares = np.zeros((flights, rows))
    for seed in range(flights):
        now, net = deepcopy(state), flight.network._replace(seed=np.array([seed, 1]))
        now.S[:, :3] += SMALL * np.random.default_rng(seed).normal(size=(len(now.S), 3))
        for k in range(rows):
            fly(problem, work, flight._replace(network=net), now, ticks)
            squares[seed, k] = (errors(now, m) ** 2).sum()
    return squares


def growth_flown(squares: Floats, seconds: float) -> Floats:
    """Growth [1/s] of the root of squares (rows, ...) from the second to the last quarter of a time [s]."""
    q = len(squares) // 4
    return np.log(squares[-q:].mean(axis=0) / squares[q : 2 * q].mean(axis=0)) / seconds


def growths(r: Floats, edges: list[list[int]], loss: float, flights: int) -> tuple[float, float]:
    """Growth [1/s] of the root mean square over flights of the product, and as it is predicted."""
    m = still({"delay": 0.04, "loss": loss}, r, edges)
    flown = growth_flown(squares_flown(m, flights, 8.0).mean(axis=0), 8.0)
    predicted = rms_growth(linear_flight(m), np.array([loss]), states=64, time=8.0)
    return float(flown), float(predicted[0])


def test_the_second_moment_grows_in_flight():
    """Over 100 flights that each lose 95 % of their messages, it grows as predicted within a fifth."""
    flown, predicted = growths(TRIANGLE, PAIRS, 0.95, 100)
    assert flown == pytest.approx(predicted, rel=0.2)


@pytest.mark.long
@pytest.mark.parametrize(("shape", "loss"), [("triangle", 0.95), ("cube", 0.95), ("cube", 0.4)])
def test_the_second_moment_grows_over_2000_flights(shape, loss):
    """Over 2,000 flights it grows, or decays, as predicted within 10 % of the exponent."""
    flown, predicted = growths(
        *((CUBE, EDGES) if shape == "cube" else (TRIANGLE, PAIRS)), loss, 2000
    )
    assert flown == pytest.approx(predicted, rel=0.1)


def grown(count: int, flights: int, seconds: float) -> Bools:
    """At the greatest loss that random formations are said to bear, which flights grow 100 times in a time [s]."""
    flown = []
    for seed in range(1, count + 1):
        tables = random_formation(seed)
        linear = linear_flight(still({}, **tables))
        if last_stable_delay(linear):
            loss = greatest_stable_loss(linear)
            squares = squares_flown(still({"loss": loss}, **tables), flights, seconds, 50)
            flown.append(squares.max(axis=1) > (100.0 * SMALL) ** 2)
    return np.concatenate(flown)


def test_what_is_stable_in_mean_square_flies_stable():
    """None of 20 flights of each of two random formations grows."""
    assert not grown(2, 20, 50.0).any()


@pytest.mark.long
def test_what_is_stable_in_mean_square_flies_stable_in_many_flights():
    """So do 99 % of 100 flights each of twenty random formations (of a quarter of them in CI)."""
    assert grown(20 if FULL else 5, 100 if FULL else 50, 200.0).mean() <= 0.01


def checked(network: dict[str, Any], **tables: Any) -> rf.Preflight:
    """The check of the cube with a network."""
    return rf.check(still(network, **tables), search=False)


def test_check_says_what_the_network_is_beside_what_is_borne():
    """Broadcasts a second, last stable delay, loss in mean square, and the mission's own; also as data."""
    cube = checked({"delay": 0.06, "loss": 0.3})
    (table,) = (
        x for x in cube.facts().shown_parts if isinstance(x, FactTable) and x.heads[0] == "network"
    )
    (row,) = (dict(zip(table.heads, texts, strict=False)) for texts in table.cell_texts)
    assert (row["network"], row["broadcasts [/s]"]) == ("cube", "400")
    assert (row["has [ms]"], row["has [%]"]) == ("60", "30")
    data = cube.data()["network"]["cube"]
    assert data["delay_ticks"] == last_stable_delay(linear_flight(cube.mission))
    assert data["own_delay_ticks"] == 3
    assert 0.3 < data["loss"] < 0.95
    assert cube.passed
    assert "network" not in {remark.topic for remark in cube.remarks}


@pytest.mark.parametrize(
    ("network", "words"),
    [
        ({"delay": 0.3}, "messages are up to 15 ticks late"),
        ({"delay": 0.06, "loss": 0.95, "silence": 5.0}, "95 % of its messages are lost"),
    ],
)
def test_check_refuses_a_network_that_is_not_borne(network, words):
    """It fails with the reason; and what it refuses grows when it is flown."""
    cube = checked(network)
    (remark,) = (remark for remark in cube.remarks if remark.topic == "network")
    assert remark.level == "fails"
    assert words in remark.text
    flown = squares_flown(still(network), 8, 20.0)
    assert (growth_flown(flown.T, 20.0) > 0.0).mean() > 0.5


def test_lossy_passage_is_refused_and_fails():
    """Its check names the losses; flown, its vehicles leave their slots. With 30 % lost, both pass."""
    data = rf.load_mission("lossy-passage").to_dict()
    before = rf.check("lossy-passage", search=False)
    fails = [remark for remark in before.remarks if remark.level == "fails"]
    assert {remark.topic for remark in fails} == {"network"}
    assert all("94 % of its messages are lost" in remark.text for remark in fails)
    verdict = rf.assess(rf.simulate("lossy-passage"))
    assert "tracking_error" in {each.check for each in verdict.checks if not each.passed}
    data["network"]["loss"] = 0.3
    m = rf.Mission.from_dict(data)
    assert rf.check(m, search=False).passed
    assert rf.assess(rf.simulate(m)).passed


def test_edges_beyond_the_range_are_named():
    """Diagonals of the cube are longer than a range of 5 m, and the rest is checked without them."""
    cube = checked({"range": 5.0})
    assert cube.network["cube"].unheard_edges == 6
    assert any("6 edges are longer than the range" in remark.text for remark in cube.remarks)


def test_without_a_network_nothing_is_said():
    """Neither a row nor data."""
    cube = rf.check(mission(None), search=False)
    assert cube.network == {}
    assert "broadcasts" not in str([*cube.describe()])
