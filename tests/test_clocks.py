"""Vehicles that fly by clocks of their own: how these part, find together, and wait for one that is stuck."""

from typing import Any

import numpy as np
import pytest
from test_network import CUBE, EDGES, fly, laid_out, mission

import rigidfleet as rf
from rigidfleet.errors import MissionError
from rigidfleet.kernel.clock_records import OFF, PACE, RATE
from rigidfleet.sweep import Sweep
from rigidfleet.typing import Floats

PHASES: list[dict[str, Any]] = [
    {"kind": "establish", "formation": "cube", "duration": 5.0, "control": "tracking"},
    {"kind": "fly", "position": [10.0, 2.0, 22.0], "duration": 10.0, "control": "tracking"},
    {"kind": "hold", "duration": 5.0, "control": "tracking"},
]
IN_SHAPE: dict[str, Any] = {"agents": {"position": (CUBE + [0, 0, 20]).tolist(), "vehicle": "p"}}
ALONE: dict[str, Any] = {"formations": {"cube": {"slots": CUBE.tolist(), "edges": []}}}


def clocks(m: rf.Mission, ticks: int) -> Floats:
    """What clocks differ by from the time (K, N) [s], at each tick of the first phase."""
    problem, work, flight, state = laid_out(m)
    off = []
    for _ in range(ticks):
        fly(problem, work, flight, state, 1)
        off.append(state.tau[:, OFF].copy())
    return np.array(off)


def shape_error(r: rf.Result) -> Floats:
    """Greatest error (K,) [m] of all distances of the cube."""
    i, j = np.triu_indices(8, 1)
    d = np.linalg.norm(r.position[:, i] - r.position[:, j], axis=2)
    return np.abs(d - np.linalg.norm(CUBE[i] - CUBE[j], axis=1)).max(axis=1)


@pytest.mark.parametrize("network", [{}, {"delay": 0.08, "rate": 25.0}])
def test_clocks_meet_at_the_rate_of_the_graph(network):
    """Small differences fall as exp(-g L t) does, with the Laplacian L of the edges, also if messages are late."""
    g, late = 0.5, [0.0, 0.02, 0.04, 0.0, 0.06, 0.0, 0.02, 0.0]
    m = mission({**network, "clocks": {"late": late, "consensus": g}})
    off = clocks(m, 200)
    i, j = np.array(EDGES).T - 1
    L = np.zeros((8, 8))
    np.add.at(L, (i, i), 1.0)
    np.add.at(L, (j, j), 1.0)
    np.add.at(L, (i, j), -1.0)
    np.add.at(L, (j, i), -1.0)
    values, vectors = np.linalg.eigh(L)
    begin = 10  # after all have started and heard of each other
    spread = off - off.mean(axis=1, keepdims=True)
    modes = spread @ vectors[:, 1:]
    time = np.arange(200)[:, None] / 50.0
    expected = modes[begin] * np.exp(-g * values[1:] * (time - time[begin]))
    size = np.linalg.norm(modes[begin])
    # Between two messages, a neighbour is not where it is presumed to be: 8 % of the difference at 25 Hz and 80 ms
    allowed = 0.02 if not network else 0.25
    assert np.linalg.norm(modes - expected, axis=1)[begin:].max() <= allowed * size
    assert np.linalg.norm(modes[-1]) <= 0.02 * size
    assert np.linalg.norm(spread[begin]) > 0.02


def test_a_drifting_clock_leaves_its_slot_behind():
    """Without edges, vehicles part as their slots do at their clocks: by drift times speed times time."""
    drift = [0.0] * 7 + [2e4]
    v = 2.0
    phases = [
        {"kind": "establish", "formation": "cube", "duration": 5.0, "control": "tracking"},
        {
            "kind": "fly", "position": [100.0, 2.0, 22.0], "velocity": [v, 0.0, 0.0], "duration": 60.0,
            "control": "tracking",
        },
    ]  # fmt: skip
    m = mission({"clocks": {"drift": drift}}, phases=phases, **IN_SHAPE, **ALONE)
    one = mission({}, phases=phases, **IN_SHAPE, **ALONE)
    r, right = rf.simulate(m), rf.simulate(one)
    clock = r.vehicle_clock
    assert clock is not None
    assert right.vehicle_clock is None
    # The other seven are on time but for the shift of the phases by the mean of all clocks, a tick at most
    np.testing.assert_allclose(clock[:, 7] - clock[:, 0], 2e-2 * r.time, atol=1e-9)
    at = np.searchsorted(r.time, [20.0, 35.0, 50.0])
    for k in at:
        apart = r.position[k, 7] - r.position[k, 0] - (CUBE[7] - CUBE[0])
        # Where the slot of the plan is at the two times
        moved = [np.interp(c, right.time, right.slot_position[:, 7, 0]) for c in clock[k, [7, 0]]]
        assert apart[0] == pytest.approx(moved[0] - moved[1], rel=0.02)
        assert apart[0] > 0.3
    assert shape_error(right)[at].max() < 0.01


def test_edges_hold_a_shape_against_clocks_that_drift():
    """The same clocks: constraint forces leave a tenth of the error, and consensus a hundredth."""
    drift = [0.0] * 7 + [2e4]
    fast = {"kind": "fly", "position": [60.0, 2.0, 22.0], "duration": 30.0, "control": "tracking"}
    phases = [PHASES[0], fast]

    def worst(edges: dict[str, Any], **keys: Any) -> float:
        m = mission({"clocks": {"drift": drift, **keys}}, phases=phases, **IN_SHAPE, **edges)
        return float(shape_error(rf.simulate(m)).max())

    without = worst(ALONE)
    assert without > 0.5
    assert worst({}) < 0.1 * without
    assert worst({}, consensus=2.0) < 0.01 * without


def test_references_follow_the_chain_rule():
    """Recorded slots are those of the plan at each clock; their velocities are the derivatives over real time."""
    m = mission(
        {"clocks": {"late": 0.4, "drift": 1e4, "consensus": 1.0, "wait": 0.5}},
        disturbances={"stuck": [{"agent": 3, "time": 9.0, "duration": 2.0}]},
        phases=PHASES,
        output_step=0.02,
        **IN_SHAPE,
    )
    plan = rf.simulate(mission({}, phases=PHASES, output_step=0.02, **IN_SHAPE))
    r = rf.simulate(m)
    clock = r.vehicle_clock
    assert clock is not None
    assert r.slot_velocity is not None
    inside = np.all(clock < 19.9, axis=1)
    for i in range(8):
        for q in range(3):
            expected = np.interp(clock[inside, i], plan.time, plan.slot_position[:, i, q])
            np.testing.assert_allclose(r.slot_position[inside, i, q], expected, atol=5e-3)
    # Differences of second order between samples of one phase
    step = np.diff(r.time)
    even = (np.abs(step[1:] - 0.02) < 1e-9) & (np.abs(step[:-1] - 0.02) < 1e-9)
    even &= (r.phase[2:] == r.phase[:-2]) & inside[1:-1]
    rate = (r.slot_position[2:] - r.slot_position[:-2])[even] / 0.04
    assert np.abs(rate - r.slot_velocity[1:-1][even]).max() < 0.1
    assert np.abs(rate).max() > 1.0


def test_all_wait_for_one_that_is_stuck():
    """All clocks stop and the shape is held within .05 m; the flight goes on after, arrives, and lasts longer."""
    stuck = {"agent": 2, "time": 9.0, "duration": 5.0}
    tables: dict[str, Any] = {
        "phases": PHASES,
        "limits": {"separation": 2.5, "separation_allowance": 0.5},
    }
    m = mission(
        {"clocks": {"consensus": 1.0, "wait": 0.3}}, disturbances={"stuck": [stuck]}, **tables, **IN_SHAPE
    )  # fmt: skip
    r = rf.simulate(m)
    clock, t = r.vehicle_clock, r.time
    assert clock is not None
    pace = np.gradient(clock, t, axis=0)
    wait = (t > 11.0) & (t < 13.9)
    assert pace[wait].max() < 0.01
    assert (pace[t < 8.9] > 0.99).all()
    still = (t > 13.0) & (t < 13.9)
    assert shape_error(r)[still].max() <= 0.05
    # It holds its place
    place = r.position[np.searchsorted(t, 9.0), 1]
    assert np.linalg.norm(r.position[still][:, 1] - place, axis=1).max() < 0.05
    later = r.phases[1].t_end - 15.0
    assert 4.0 < later < 8.0
    assert r.phases[2].t_end == pytest.approx(20.0 + later, abs=0.1)
    assert np.ptp(clock[-1]) < 1e-3
    verdict = rf.assess(r)
    assert verdict.passed, [c.message for c in verdict.checks if not c.passed]
    assert any("waited on its path from 9." in note for note in verdict.notes)
    assert r.phases[1].extremes["clock"].value == pytest.approx(later, abs=0.03)
    # Nobody waits without the key: then the stuck vehicle is far from its slot
    alone = rf.simulate(mission({}, disturbances={"stuck": [stuck]}, **tables, **IN_SHAPE))
    assert alone.time[-1] == pytest.approx(20.0, abs=0.05)
    assert shape_error(alone).max() > 3.0 * shape_error(r).max()
    assert not rf.assess(alone).passed


def test_a_great_error_spreads_and_is_forgotten():
    """Along a chain of eight, the last one waits for the first; when that one is free, all go on within the silence."""
    slots = np.arange(8.0)[:, None] * [3.0, 0.0, 0.0]
    edges = [[i, i + 1] for i in range(1, 8)]
    m = mission(
        {"silence": 0.5, "clocks": {"wait": 0.5}},
        agents={"position": (slots + [0, 0, 20]).tolist(), "vehicle": "p"},
        formations={"cube": {"slots": slots.tolist(), "edges": edges}},
    )
    problem, work, flight, state = laid_out(m)
    fly(problem, work, flight, state, 50)
    assert (state.tau[:, PACE] == 1.0).all()
    state.S[0, 2] += 3.0
    fly(problem, work, flight, state, 60)
    assert (state.tau[:, RATE] < 0.2).all()
    state.S[0, :3], state.S[0, 3:6] = slots[0] + [0, 0, 20], 0.0
    state.S[1:, :3], state.S[1:, 3:6] = slots[1:] + [0, 0, 20], 0.0
    fly(problem, work, flight, state, 110)
    assert (state.tau[:, RATE] > 0.8).all()


@pytest.mark.parametrize("kind", ["late", "drift"])
def test_numbers_are_drawn_by_the_seed(kind):
    """A number is the greatest; the same seed draws the same shares, another one others."""
    from rigidfleet.planning.vehicles import clocks_of

    def drawn(seed: int) -> Floats:
        return getattr(clocks_of(mission({"seed": seed, "clocks": {kind: 5.0}})), kind)

    values = drawn(1) / (5.0 * 50.0 if kind == "late" else 5e-6)
    assert np.unique(values).size > 6
    assert (np.abs(values) <= 1.0).all()
    assert (values < 0.0).any() == (kind == "drift")
    assert (drawn(1) == drawn(1)).all()
    assert (drawn(1) != drawn(2)).any()


@pytest.mark.parametrize(
    ("key", "value"),
    [(f"network.{key}", value) for key, value in {
        "rate": 25.0, "delay": 0.03, "jitter": 0.01, "loss": 0.2, "burst": 4.0, "range": 9.0, "budget": 300.0,
        "silence": 0.4, "event": 0.01, "seed": 7, "outages[1].start": 1.5, "outages[1].end": 2.5, "lost[1].time": 6.0,
    }.items()],
)  # fmt: skip
def test_sweeps_vary_numbers_of_the_network(key, value):
    """Each number of [network] can be varied."""
    m = mission(
        {
            "loss": 0.1, "burst": 2.0, "range": 20.0, "budget": 400.0, "event": 0.001,
            "outages": [{"start": 1.0, "end": 2.0}], "lost": [{"between": [1, 2], "time": 5.0}],
        }
    )  # fmt: skip
    varied = Sweep.of(m, [f"{key} = grid({value})"]).mission_of(0).to_dict()
    name, _, rest = key.removeprefix("network.").partition("[1].")
    here = varied["network"][name]
    assert (here[0][rest] if rest else here) == value
    assert varied != m.to_dict()


def test_sweeps_vary_numbers_of_clocks():
    """Each number of [network.clocks] and of a stuck vehicle can be varied."""
    stuck = [{"agent": 2, "time": 1.0, "duration": 1.0}]
    keys = [f"network.clocks.{key}" for key in ("late", "drift", "consensus", "wait")]
    keys += ["disturbances.stuck[1].time", "disturbances.stuck[1].duration"]
    m = mission({"clocks": {"wait": 1.0}}, disturbances={"stuck": stuck})
    sweep = Sweep.of(m, [f"{key} = grid(0.25, 0.5)" for key in keys])
    assert sweep.runs == 2**6
    last = sweep.mission_of(63)
    assert last.network is not None
    assert last.disturbances is not None
    (one,), clocks = last.disturbances.stuck, last.network.clocks
    assert clocks is not None
    values = clocks.late, clocks.drift, clocks.consensus, clocks.wait, one.time, one.duration
    assert values == (0.5,) * 6


@pytest.mark.parametrize(
    ("tables", "key", "words"),
    [
        ({"network": {"clocks": {"late": [0.1]}}}, "network.clocks.late", "1 entries for 8"),
        ({"network": {"clocks": {"drift": [1.0] * 9}}}, "network.clocks.drift", "9 entries for 8"),
        (
            {
                "disturbances": {"stuck": [{"agent": 9, "time": 1.0, "duration": 1.0}]},
                "network": {},
            },
            "disturbances.stuck[1].agent",
            "no such agent",
        ),
        (
            {
                "disturbances": {"stuck": [{"agent": 1, "time": 11.0, "duration": 1.0}]},
                "network": {},
            },
            "disturbances.stuck[1].time",
            "before the end",
        ),
        (
            {"disturbances": {"stuck": [{"agent": 1, "time": 1.0, "duration": 1.0}]}},
            "disturbances.stuck",
            "without [network]",
        ),
    ],
)
def test_what_clocks_cannot_be_is_refused(tables, key, words):
    """Each in one sentence with its remedy."""
    with pytest.raises(MissionError) as refused:
        mission(tables.get("network"), **{k: x for k, x in tables.items() if k != "network"})
    (finding,) = refused.value.findings
    assert finding.key == key
    assert words in finding.problem
    assert finding.remedy
