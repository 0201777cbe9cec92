"""Logs judged with doubt. The oracles are flights of which the truth is known, with noise that the test makes."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles import FULL
from scipy.signal import butter, lfilter

import rigidfleet as rf
from rigidfleet.assessment.alignment import fit_alignment
from rigidfleet.cli.app import main
from rigidfleet.errors import TrajectoryError
from rigidfleet.foreign.curves import ASSUMED, LoggedStates, Trajectories, curve_through_samples
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.math.smoothing import (
    PositionNoise,
    Positions,
    b_spline_curve,
    fit_noise,
    knots_over,
    smooth,
)
from rigidfleet.setpoints import ways_of
from rigidfleet.simulation.as_logged import Doubts, judge_log

SIGMA, RATE, END = 0.003, 100.0, 12.0
KINDS = ["white", "ar 0.05", "ar 0.2", "ar 1", "filtered", "quantised", "dropouts"]


def places(t: np.ndarray, gap: float = 0.4) -> np.ndarray:
    """Two vehicles (K, 2, 3) that pass each other at a gap [m]."""
    one = np.stack([0.5 * (t - 6.0), 0.1 * np.sin(t), 2.0 + 0.2 * np.cos(0.8 * t)], axis=1)
    other = np.stack([-0.4 * (t - 6.0), gap + 0.1 * np.sin(t), 2.0 + 0.2 * np.cos(0.8 * t)], axis=1)
    return np.stack([one, other], axis=1)


def correlated(random: Any, shape: tuple[int, ...], tau: float) -> np.ndarray:
    """PositionNoise of a correlation time [s] at `RATE`, by its recursion."""
    e = SIGMA * random.standard_normal(shape)
    if tau > 0.0:
        share = np.exp(-1.0 / (RATE * tau))
        for k in range(1, len(e)):
            e[k] = share * e[k - 1] + np.sqrt(1.0 - share**2) * e[k]
    return e


def noisy(
    kind: str, random: Any, truth: Any = places, end: float = END, **more: Any
) -> Trajectories:
    """A log of a flight with noise of a kind."""
    stamps = np.arange(0.0, end + 1e-9, 1.0 / RATE)
    t = stamps
    if kind == "quantised":
        t = np.sort(stamps + random.uniform(-0.004, 0.004, len(stamps)))
        t[[0, -1]] = 0.0, end
        t = t[np.append(True, np.diff(np.round(t, 3)) > 0.0)]
        stamps = np.round(t, 3)
    x = truth(t, **more)
    if kind == "filtered":
        e = lfilter(
            *butter(2, 2.0 / (0.5 * RATE)),
            random.standard_normal((len(t) + 500, *x.shape[1:])),
            axis=0,
        )
        e = SIGMA * e[500:] / e[500:].std()
    else:
        e = correlated(random, x.shape, float(kind.split()[1]) if " " in kind else 0.0)
    kept = np.ones(x.shape[:2], dtype=bool)
    if kind == "dropouts":
        kept = random.random(kept.shape) > 0.3
        kept[[0, -1]] = True
    return logged(
        [stamps[kept[:, i]] for i in range(x.shape[1])],
        [(x + e)[kept[:, i], i] for i in range(x.shape[1])],
    )


def logged(times: list[np.ndarray], positions: list[np.ndarray]) -> Trajectories:
    curves = (
        curve_through_samples(t, x, None, "cubic", str)
        for t, x in zip(times, positions, strict=True)
    )
    names = tuple(f"v{i + 1}" for i in range(len(times)))
    return Trajectories(names, tuple(curves), ASSUMED["cubic"], away=True)


many = pytest.mark.parametrize(
    "count", [3, pytest.param(500 if FULL else 12, marks=pytest.mark.long)]
)


@many
@pytest.mark.parametrize("kind", KINDS)
def test_intervals_hold(kind: str, count: int) -> None:
    """Of a stated size of noise, intervals of the least separation and the speed hold in nine of ten flights."""
    random, fine = np.random.default_rng(3), np.linspace(0.0, END, 20_001)
    true = places(fine)
    least = np.linalg.norm(true[:, 0] - true[:, 1], axis=1).min()
    fastest = np.linalg.norm(np.gradient(true, fine, axis=0), axis=2).max()
    held = np.zeros(2)
    for _ in range(count):
        _, verdict = judge_log(noisy(kind, random), None, Doubts(SIGMA), separation=0.3)
        assert verdict.passed
        for k, (name, value) in enumerate((("separation", least), ("speed", fastest))):
            low, high = verdict.by_name[name].interval or (np.inf, np.inf)
            held[k] += low <= value <= high
    assert (held >= 0.9 * count - 0.4).all(), held / count


@many
@pytest.mark.parametrize("kind", KINDS[:4])
def test_intervals_of_positions_hold(kind: str, count: int) -> None:
    """A place is within 1.96 standard deviations of the ways drawn in nine of ten cases."""
    random, t = np.random.default_rng(4), np.linspace(0.5, END - 0.5, 45)
    tau = float(kind.split()[1]) if " " in kind else 0.0
    held = []
    for _ in range(count):
        curve = noisy(kind, random).curves[0]
        log = Positions(curve.time, curve.at(curve.time)[:, :3], np.ones(len(curve.time)))
        likely = smooth(log, PositionNoise(SIGMA, tau), knots_over(log.time, 0.025))
        ways = b_spline_curve(likely.knots, likely.draw(40, random)).at(t)
        drawn = np.std(ways, axis=2)
        held.append(np.abs(likely.way.at(t) - places(t)[:, 0]) < 1.96 * drawn)
    assert np.mean(held) > 0.9


def test_a_gap_is_in_doubt() -> None:
    """Without samples for 2 s about the least separation, its interval is wide, and holds."""
    random, held, wide = np.random.default_rng(16), [], []
    for _ in range(4):
        log = noisy("white", random)
        for kept in (slice(None), np.abs(log.curves[0].time - 6.0) > 1.0):
            places_of = [c.at(c.time)[kept, :3] for c in log.curves]
            some = logged([c.time[kept] for c in log.curves], places_of)
            _, verdict = judge_log(some, None, Doubts(SIGMA, 0.0))
            low, high = verdict.by_name["separation"].interval or (np.inf, np.inf)
            held.append(low <= 0.4 <= high)
            wide.append(high - low)
    assert np.mean(held) >= 0.9
    assert np.mean(wide[1::2]) > 5.0 * np.mean(wide[::2])


def test_a_slow_log_beside_a_fast_one_hides_no_motion() -> None:
    """A vehicle that is logged once a second takes nothing from another's 100 samples: intervals hold its motion."""
    random, pulse = np.random.default_rng(18), np.pi
    t, slow = np.linspace(0.0, 10.0, 1001), np.arange(11.0)
    for amplitude, word in ((0.4, "passed"), (0.6, "failed")):
        fast = np.stack([amplitude * np.sin(pulse * t), 0 * t, 5.0 + 0 * t], axis=1)
        still = np.tile([0.0, 2.0, 5.0], (11, 1))
        ways = [x + SIGMA * random.standard_normal(x.shape) for x in (fast, still)]
        log = logged([t, slow], ways)
        _, verdict = judge_log(log, None, Doubts(SIGMA, 0.0), limits={"speed": 1.65})
        for name, true in (("speed", amplitude * pulse), ("acceleration", amplitude * pulse**2)):
            low, high = verdict.by_name[name].interval or (np.inf, np.inf)
            assert low <= true <= high
        assert verdict.word == word


@many
def test_a_near_limit_is_undecided(count: int) -> None:
    """A flight that keeps its limit is never failed, one that collides by more than the noise never passed."""
    random = np.random.default_rng(5)
    words = []
    for gap in (0.4, 0.39, 0.37):
        for _ in range(max(count // 3, 1)):
            log = noisy("white", random, gap=gap)
            _, verdict = judge_log(log, None, Doubts(SIGMA), separation=0.385)
            words.append((gap, verdict.word))
    assert {word for gap, word in words if gap == 0.4} == {"passed"}
    assert "failed" not in {word for gap, word in words if gap == 0.39}
    assert {word for gap, word in words if gap == 0.37} == {"failed"}


@pytest.mark.parametrize("quantity", ["separation", "speed"])
def test_what_would_decide_decides(monkeypatch: pytest.MonkeyPatch, quantity: str) -> None:
    """An undecided check names a noise, and a rate: logs of the same flight with them are decided."""
    fine = np.linspace(0.0, END, 20_001)
    fastest = np.linalg.norm(np.gradient(places(fine), fine, axis=0), axis=2).max()
    limits = {"separation": 0.1, "limits": {"speed": fastest + 0.01}}
    if quantity == "separation":
        limits = {"separation": 0.3985}

    def check(sigma: float, rate: float, seed: int) -> Any:
        monkeypatch.setattr("test_doubt.SIGMA", sigma)
        monkeypatch.setattr("test_doubt.RATE", rate)
        log = noisy("white", np.random.default_rng(seed))
        return judge_log(log, None, Doubts(sigma, 0.0), **limits)[1].by_name[quantity]

    first = check(0.003, 100.0, 1)
    assert first.undecided
    words = re.search(r"noise of (\S+) mm would decide it, .* white, (\d+) times", first.message)
    assert words is not None
    for sigma, rate in ((float(words[1]) / 1e3, 100.0), (0.003, 100.0 * int(words[2]))):
        assert [check(sigma, rate, seed).passed for seed in (1, 2)] == [True, True]


def test_one_vehicle_has_no_separation() -> None:
    """A separation that is asked of one vehicle alone cannot be judged, with noise as without."""
    log = noisy("white", np.random.default_rng(1))
    alone = log._replace(names=log.names[:1], curves=log.curves[:1])
    _, verdict = judge_log(alone, None, Doubts(SIGMA, 0.0), separation=0.3)
    assert "there is one vehicle alone" in verdict.by_name["separation"].message
    assert verdict.word == "failed"


@pytest.mark.parametrize(("kind", "tau"), [("white", 0.0), ("ar 0.05", 0.05)])
def test_noise_is_shown_by_samples(kind: str, tau: float) -> None:
    """White noise and noise of a short correlation time are estimated from the samples alone."""
    log = noisy(kind, np.random.default_rng(6), end=40.0)
    samples = [Positions(c.time, c.at(c.time)[:, :3], np.ones(len(c.time))) for c in log.curves]
    noise = fit_noise(samples, None, 0.05).noise
    assert noise is not None
    assert noise.sigma == pytest.approx(SIGMA, rel=0.1)
    assert noise.tau == pytest.approx(tau, rel=0.3)


def test_noise_far_from_the_origin_is_told() -> None:
    """White noise of a slow flight 20 m wide is white: rounding of far positions is not taken for more."""
    t = np.arange(0.0, 60.0, 1.0 / RATE)
    x = 20.0 * np.stack([np.sin(0.05 * t), np.cos(0.05 * t), 0.1 * np.sin(0.1 * t)], axis=1)
    noise = SIGMA * np.random.default_rng(0).standard_normal(x.shape)
    estimate = fit_noise([Positions(t, x + noise, np.ones(len(t)))], SIGMA, 0.025)
    assert estimate.noise == PositionNoise(SIGMA)
    assert not estimate.words


@pytest.mark.parametrize("kind", ["ar 1", "filtered"])
def test_noise_that_looks_like_motion_is_not_told(kind: str) -> None:
    """Slow noise, and that of an estimator, is not estimated: the verdict is undecided and asks for --noise."""
    _, verdict = judge_log(
        noisy(kind, np.random.default_rng(7)), None, Doubts("data"), separation=0.3
    )
    assert verdict.word == "undecided"
    assert "--noise" in verdict.summary


# -- against a plan -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plan() -> rf.Result:
    return rf.simulate("narrow-passage")


def flown(
    plan: rf.Result, random: Any, *, late: Any = 0.0, turn: float = 0.0, shift: Any = 0.0
) -> Trajectories:
    """A log of a flight of the plan: its clock late [s], its axes turned [deg], its vehicles shifted [m]."""
    motion = plan.setpoints_at_samples(flown=True)
    late, angle = np.broadcast_to(late, plan.n_agents), np.radians(turn)
    t = np.arange(plan.time[0], plan.time[-1], 1.0 / 25.0)
    c, s = np.cos(angle), np.sin(angle)
    x = np.stack(
        [
            [np.interp(t, motion.time, motion.state[:, 0, i, a]) for a in range(3)]
            for i in range(plan.n_agents)
        ]
    )
    x = x.transpose(2, 0, 1) + np.broadcast_to(shift, (plan.n_agents, 3))
    x = x @ np.array(
        [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    ).T + SIGMA * random.standard_normal(x.shape)
    return logged([t + by for by in late], list(x.swapaxes(0, 1)))


def test_an_offset_of_the_clock_is_recovered(plan: rf.Result) -> None:
    """An offset of .1 s and a turn of 7 degrees are estimated to 5 ms and .1 degrees, within their errors."""
    log = flown(plan, np.random.default_rng(8), late=0.1, turn=7.0)
    _, verdict = judge_log(log, plan, Doubts(SIGMA, 0.0, "offset"))
    assert verdict.doubt is not None
    found = verdict.doubt["alignment"]
    for key, true, least in (("offset_s", 0.1, 0.005), ("turn_deg", 7.0, 0.1)):
        value, error = found[key]
        assert abs(value - true) < min(least, 3.0 * error)
    assert verdict.failures  # a turned flight is judged as flown
    assert any("turned by 7.0" in note for note in verdict.notes)
    assert any("Positions alone do not tell a clock from a lag" in note for note in verdict.notes)


@pytest.mark.parametrize(("turn", "scale"), [(180.0, 1.0), (-100.0, 1000.0), (170.0, 0.9)])
def test_a_show_that_is_set_up_quite_wrong_is_told(turn: float, scale: float) -> None:
    """The other way round, or in millimetres: turn and scale are found from any start, and the clock with them."""
    t = np.linspace(0.0, 20.0, 201)
    x = np.stack([4.0 * np.sin(0.5 * t), 3.0 * np.sin(0.3 * t), 5.0 + np.sin(t)], axis=1)
    x = x[:, None] + np.array([[0.0, 0.0, 0.0], [6.0, 1.0, 0.0], [1.0, 5.0, 2.0]])
    ways = [
        Piecewise.hermite(t, np.stack([y, np.gradient(y, t, axis=0)])) for y in x.swapaxes(0, 1)
    ]
    z = np.exp(1j * np.radians(turn)) * (x[..., 0] + 1j * x[..., 1])
    flown = scale * np.stack([z.real, z.imag, x[..., 2]], axis=2) + [3.0, 4.0, 0.0]
    logs = [(t + 2.3, flown[:, i]) for i in range(3)]
    known = fit_alignment(logs, ways, "offset").to_dict()
    assert known["offset_s"][0] == pytest.approx(2.3, abs=0.01)
    assert (known["turn_deg"][0] - turn + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=0.1)
    assert known["scale"][0] == pytest.approx(scale, rel=1e-3)


def test_hovering_tells_no_clock() -> None:
    """Where nothing moves, the offset cannot be told."""
    random, t = np.random.default_rng(9), np.arange(0.0, 20.0, 0.05)
    still = Piecewise(np.array([0.0, 20.0]), np.ones((1, 3, 1)))
    logs = [(t, 1.0 + 1e-4 * random.standard_normal((len(t), 3)))]
    found = fit_alignment(logs, [still], "recorded").to_dict()
    assert found["offset_s"] is None
    assert found["turn_deg"] is None
    x = np.ones((len(t), 1, 3))
    log = logged([t], [x[:, 0] + 1e-3 * random.standard_normal((len(t), 3))])
    _, verdict = judge_log(log, rf.trajectories(t, x), Doubts(1e-3, 0.0))
    assert any("the clock cannot be told, as the plan hardly moves" in x for x in verdict.notes)
    with pytest.raises(TrajectoryError, match="the clock cannot be told: the plan hardly moves"):
        judge_log(log, rf.trajectories(t, x), Doubts(1e-3, 0.0, "offset"))


def test_a_set_up_is_recovered(plan: rf.Result) -> None:
    """A scale of 1.02 and a shift are estimated within their errors, judged as flown and told as the cause."""
    shift = np.array([0.3, -0.2, 0.1])
    log = flown(plan, np.random.default_rng(13), shift=shift)
    log = logged([c.time for c in log.curves], [1.02 * c.at(c.time)[:, :3] for c in log.curves])
    _, verdict = judge_log(log, plan, Doubts(SIGMA, 0.0))
    facts = verdict.doubt["alignment"] if verdict.doubt else {}
    pairs = zip([facts["scale"], *facts["shift_m"]], [1.02, *(1.02 * shift)], strict=True)
    for (value, error), true in pairs:
        assert abs(value - true) < min(0.01, 3.0 * error)
    assert facts["rms_explained_m"] < 0.1 < facts["rms_as_logged_m"]
    (note,) = (note for note in verdict.notes if "scaled by 1.02" in note)
    assert "shifted by (0.306, -0.204, 0.1" in note
    assert "judged as flown" in note


def test_a_log_says_its_own_noise() -> None:
    """Noise of each sample by the log's own estimator counts: intervals hold, and are wider where it says more."""
    random, held = np.random.default_rng(14), []
    t = np.arange(0.0, END, 1.0 / RATE)
    size = np.where(t < 6.0, SIGMA, 4.0 * SIGMA)[:, None]
    for _ in range(4):
        x = places(t) + size[:, None] * random.standard_normal((len(t), 2, 3))
        log = logged([t, t], [*x.swapaxes(0, 1)])
        own = LoggedStates(None, np.broadcast_to(size, (len(t), 3)), np.zeros(0, dtype=np.int64))
        log = log._replace(measured=(own, own))
        plan = rf.trajectories(t, places(t), cubic=True)
        result, verdict = judge_log(log, plan, Doubts("log"))
        assert verdict.doubt is not None
        assert verdict.doubt["noise_m"] == pytest.approx(SIGMA)
        bands = result.statistics["bands"]
        early = np.array(bands["time"]) < 5.5
        wide = np.array(bands["place"]).mean(axis=1)
        assert wide[~early][5:].mean() > 2.0 * wide[early].mean()
        off = np.linalg.norm(result.position - places(result.time), axis=2)
        rows = np.searchsorted(result.time, np.array(bands["time"]) - 1e-9)
        held.append(off[rows] <= np.array(bands["place"]))
    assert np.mean(held) > 0.9
    with pytest.raises(TrajectoryError, match=r"does not say its noise\. State it: --noise"):
        judge_log(noisy("white", random), None, Doubts("log"))


def test_a_late_vehicle_is_not_aligned_away(plan: rf.Result) -> None:
    """A vehicle's own offset is reported; its separation is judged as it flew, unless it has a clock of its own."""
    log = flown(plan, np.random.default_rng(10), late=[0.0, 0.0, 0.2])
    result, verdict = judge_log(log, plan, Doubts(SIGMA, 0.0))
    late = verdict.doubt["vehicles"][2] if verdict.doubt else {}
    assert late["late"]
    assert late["offset_s"][0] == pytest.approx(0.2, abs=0.005)
    apart = np.linalg.norm(result.position[:, 1] - result.position[:, 2], axis=1) - 0.5  # radii
    assert verdict.by_name["separation"].worst == pytest.approx(apart.min(), abs=0.01)
    assert verdict.word == "failed"
    _, verdict = judge_log(log, plan, Doubts(SIGMA, 0.0, "own"))
    assert "separation is not judged: vehicles have no common clock" in verdict.summary
    assert not any("by itself" in note for note in verdict.notes)  # one note has all clocks
    assert verdict.word == "undecided"
    _, same = judge_log(log._replace(own_clocks=True), plan, Doubts(SIGMA, 0.0))  # as files say
    assert same.summary == verdict.summary


def test_what_a_simulator_knows_is_not_said_of_a_log() -> None:
    """Messages, rotors and attitudes of the simulated plan are not those of the flight that a log is of."""
    plan = rf.simulate("lossy-passage")
    assert plan.messages is not None
    log = flown(plan, np.random.default_rng(15))
    result, verdict = judge_log(log, plan, Doubts(SIGMA, 0.0))
    assert any("messages were sent" in note for note in rf.assess(plan).notes)
    assert not any("messages were sent" in note for note in verdict.notes)
    assert result.messages is result.rotor_force is result.vehicle_attitude is None
    assert np.isnan(result.thrust).all()


def test_a_vehicle_off_its_slot_is_named(plan: rf.Result) -> None:
    """A vehicle 50 mm off its slot is named, with how far and where to; no other is."""
    shift = np.zeros((3, 3))
    shift[1, 0] = 0.05
    _, verdict = judge_log(
        flown(plan, np.random.default_rng(11), shift=shift), plan, Doubts(SIGMA, 0.0)
    )
    named = [note for note in verdict.notes if "off its slot" in note]
    assert len(named) == 1
    assert named[0].startswith("'v2'")
    off = float(named[0].split()[2])
    assert off == pytest.approx(50.0, abs=0.5)
    low, high = verdict.by_name["shape"].interval or (0.0, 0.0)
    assert low < 0.05 < high


def test_vehicles_in_another_order_are_told(plan: rf.Result) -> None:
    """A log whose vehicles are in another order than the plan's fails, and a note says whose places they are at."""
    log = flown(plan, np.random.default_rng(17))
    turned = log._replace(names=("b", "c", "a"), curves=(*log.curves[1:], log.curves[0]))
    notes = [judge_log(each, plan, Doubts(SIGMA, 0.0))[1].notes for each in (log, turned)]
    said = "b counts as agent 1, but is where agent 2 is to be, c counts as agent 2, but is where agent 3"
    assert [any(said in note for note in each) for each in notes] == [False, True]


def test_a_lost_vehicle_is_not_judged() -> None:
    """A planned loss is judged as in the flight itself: up to it, what falls has no great acceleration."""
    plan = rf.simulate("falling-light")
    log = flown(plan, np.random.default_rng(18))
    _, verdict = judge_log(log, plan, Doubts(SIGMA, 0.0))
    assert not verdict.failures
    for name, own in rf.assess(plan).by_name.items():
        if name in (
            "separation",
            "lost",
            "clearance",
            "speed",
            "acceleration",
            "waypoint_position",
        ):
            low, high = verdict.by_name[name].interval or (np.inf, np.inf)
            assert low <= (own.worst or 0.0) <= high, name
    assert verdict.by_name["acceleration"].passed


def test_a_log_whose_last_samples_are_lost_is_complete(plan: rf.Result) -> None:
    """A log with dropouts that ends some samples before the plan covers the flight; one that ends early does not."""
    log, random = flown(plan, np.random.default_rng(19)), np.random.default_rng(20)
    for last, complete in ((2, True), (25, False)):
        curves = []
        for curve in log.curves:
            kept = random.random(len(curve.time)) > 0.3
            kept[0], kept[-last:], kept[-last - 1] = True, False, True
            curves.append((curve.time[kept], curve.at(curve.time[kept])[:, :3]))
        _, verdict = judge_log(
            logged(*map(list, zip(*curves, strict=True))), plan, Doubts(SIGMA, 0.0)
        )
        assert verdict.by_name["complete"].passed == complete


def test_few_ways_drawn_reach_what_is_rare(
    plan: rf.Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of much noise, waypoints of a clean flight seem missed by more than any of some ways drawn: none is failed."""
    monkeypatch.setattr("test_doubt.SIGMA", 0.1)
    for seed in (0, 2, 14):
        log = flown(plan, np.random.default_rng(seed))
        assert not judge_log(log, plan, Doubts(0.1, 0.0))[1].failures


def test_what_would_decide_a_shape_decides() -> None:
    """Where all that seems to be missed may be noise, the noise that would decide is one with which it does."""
    plan = rf.simulate("hexagon")

    def check(sigma: float, seed: int) -> Any:
        t = np.arange(0.0, 15.0 + 1e-9, 0.05)
        way = ways_of(plan.setpoints_at_samples(flown=True), slice(None)).at(t)[..., :3]
        x = way + sigma * np.random.default_rng(seed).standard_normal(way.shape)
        log = logged([t] * plan.n_agents, list(x.swapaxes(0, 1)))
        return judge_log(log, plan, Doubts(sigma, 0.0))[1].by_name["shape"]

    for seed in range(3):
        first = check(0.05, seed)
        words = re.search(r"noise of (\S+) mm would decide it", first.message)
        assert words is not None
        assert [check(float(words[1]) / 1e3, 10 + k).passed for k in range(2)] == [True, True]


def test_the_command_says_undecided(
    plan: rf.Result, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command reads a plan and its log; undecided has an exit code of its own, and JSON has the intervals."""
    log = flown(plan, np.random.default_rng(12))
    rows = ["time_s,agent,x_m,y_m,z_m"]
    for i, curve in enumerate(log.curves, 1):
        x = curve.at(curve.time)
        rows += [
            f"{t:.4f},{i},{a:.6f},{b:.6f},{c:.6f}"
            for t, (a, b, c, _) in zip(curve.time, x, strict=True)
        ]
    table = tmp_path / "log.csv"
    table.write_text("\n".join(rows) + "\n")
    plan.save(tmp_path / "plan.nc")
    code = main(
        ["assess", str(tmp_path / "plan.nc"), str(table), "--noise", "0.003,0.02", "--json"]
    )
    data = json.loads(capsys.readouterr().out)
    assert code == {"passed": 0, "failed": 1, "undecided": 3}[data["verdict"]]
    assert all(
        c["interval"] for c in data["checks"] if c["check"] in ("separation", "speed", "shape")
    )
    assert main(["assess", str(table), "--separation", "3.162", "--noise", "0.003"]) == 3
    assert "undecided; noise of" in capsys.readouterr().out
    assert main(["assess", str(table), "--separation", "0.5"]) == 0
    assert "looks measured" in capsys.readouterr().out


def test_without_doubt_nothing_changes(capsys: pytest.CaptureFixture[str]) -> None:
    """A verdict on an exact trajectory has no words of doubt in its data."""
    t = np.linspace(0.0, END, 601)
    verdict = rf.assess(rf.trajectories(t, places(t), separation=0.3))
    data = verdict.to_dict()
    assert not {"doubt", "verdict"} & set(data)
    assert not any(check["interval"] or check["undecided"] for check in data["checks"])


def guarded(evening: Any, seed: int | None) -> rf.Mission:
    """A flight of `make evening` among fences, people, a ball and the ground."""
    data = evening.mission(seed).to_dict()
    square = lambda a, b: [[a, a], [b, a], [b, b], [a, b]]  # noqa: E731
    data["limits"] |= {"speed": 3.0, "geofence": {"min": [-5, -5, 1], "max": [12, 12, 12]}}
    data["fences"] = [
        {"name": "hard", "kind": "inclusion", "polygon": square(-3, 9)},
        {"name": "soft", "kind": "exclusion", "polygon": square(6, 8), "soft": True},
    ]
    data["people"] = [{"name": "crowd", "polygon": square(20, 30)}]
    ball = {"kind": "sphere", "centre": [2.5, 3.0, 5.0], "radius": 0.5}
    data["obstacles"] = [{"kind": "ground", "height": 0.0}, ball]
    return rf.Mission.from_dict(data)


@pytest.mark.parametrize("count", [2, pytest.param(20, marks=pytest.mark.long)])
def test_all_that_is_judged_has_an_interval(benchmark_named: Any, count: int) -> None:
    """What our own monitor sees of a flight lies in the intervals of its log: shapes, waypoints, fences, obstacles."""
    evening, held = benchmark_named("evening"), []
    plan, names = rf.simulate(guarded(evening, None)), set()
    for seed in range(count):
        true = rf.simulate(guarded(evening, seed))
        t = np.arange(0.0, float(true.time[-1]) + 1e-9, 0.02)
        x = ways_of(true.setpoints_at_samples(flown=True), slice(None)).at(t)[:, :, :3]
        x = x + evening.noise(np.random.default_rng(seed), x.shape, "white")
        _, verdict = judge_log(logged([t] * 3, [*x.swapaxes(0, 1)]), plan, Doubts(SIGMA))
        own = {(check.check, check.phase): check for check in verdict.checks}
        for check in rf.assess(true).checks:
            judged = own.get((check.check, check.phase))
            if judged is not None and judged.interval and check.worst is not None:
                names.add(check.check)
                low, high = judged.interval
                held.append(low - 1e-9 <= check.worst <= high + 1e-9)
                assert judged.passed or judged.undecided or not check.passed
    assert np.mean(held) >= 0.9
    assert names >= {"separation", "clearance", "fence", "soft_fence", "people", "geofence", "speed", "shape",
                     "distances", "waypoint_position"}  # fmt: skip


@pytest.mark.parametrize("kind", ["white", "white, from data", "of an estimator, from data"])
@pytest.mark.parametrize("count", [3, pytest.param(20, marks=pytest.mark.long)])
def test_the_flights_of_the_page_are_judged(benchmark_named: Any, kind: str, count: int) -> None:
    """Of flights of `make evening`, intervals hold in nine of ten; no clean one fails, none that collides passes."""
    evening = benchmark_named("evening")
    rows = [evening.judge(kind, seed) for seed in range(1, 1 + count)]
    told = [row for row in rows if row["noise told"]]
    assert len(told) == (0 if "estimator" in kind else count)  # its noise looks like motion
    shares = {key: np.mean([row[key] for row in told]) for key in evening.HELD if told}
    assert min(shares.values(), default=1.0) >= 0.9, shares
    assert bool(told) or not any(row["decided"] for row in rows)
    assert {row["clean flights failed"] for row in rows if row["clean flights failed"] >= 0} == {0}
    assert {row["collisions passed"] for row in rows if row["collisions passed"] >= 0} == {0}
    assert evening.rows_of(kind, rows).endswith("| 0 | 0 | yes |")


def test_too_few_samples_are_an_error(plan: rf.Result) -> None:
    log = flown(plan, np.random.default_rng(19))
    ends = [
        curve_through_samples(c.time[:2], c.at(c.time[:2])[:, :3], None, "cubic", str)
        for c in log.curves
    ]
    few = log._replace(curves=tuple(ends))
    with pytest.raises(TrajectoryError, match="too few samples"):
        judge_log(few, plan, Doubts(SIGMA, 0.0))
