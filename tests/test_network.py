"""Vehicles that know each other by messages alone: what arrives, what each computes from it, and where that leads."""

from copy import deepcopy
from typing import Any

import numpy as np
import pytest

import rigidfleet as rf
from rigidfleet import plotting
from rigidfleet._common.toml import to_toml
from rigidfleet.errors import MissionError
from rigidfleet.kernel import fleet
from rigidfleet.kernel.engine import native, sampled
from rigidfleet.kernel.mail import LOST, write_edges_of_links
from rigidfleet.kernel.problem import ITERATED, workspace
from rigidfleet.kernel.records import FINISHED
from rigidfleet.planning.legs import leg_of
from rigidfleet.planning.plan import plan_phase
from rigidfleet.planning.reference import PhaseState
from rigidfleet.planning.vehicles import TickTables, YawTurn, network_of, sampled_flight
from rigidfleet.plotting.messages import oldest_message_ages
from rigidfleet.typing import Floats
from rigidfleet.web.live.session import Session
from rigidfleet.web.replay.scene import page_samples

CUBE = np.array(
    [[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0], [0, 0, 4], [4, 0, 4], [4, 4, 4], [0, 4, 4.0]]
)
#: Its edges in establish-cube.
EDGES = [
    [1, 2], [1, 4], [1, 5], [1, 6], [2, 3], [2, 4], [2, 6], [2, 7], [3, 4], [3, 7], [3, 8], [4, 5], [4, 8], [5, 6],
    [5, 8], [6, 7], [6, 8], [7, 8],
]  # fmt: skip


#: Vehicles that keep the yaw that they start with.
TURN = YawTurn(0.0, np.zeros((2, 8)), np.zeros((2, 8)))


def mission(
    network: dict[str, Any] | None, *, rate: float = 50.0, time: float = 10.0, **tables: Any
) -> rf.Mission:
    """A cube of points of 1 kg at 50 Hz that hold their slots, each some .3 m off at the start."""
    off = np.random.default_rng(3).normal(0, 0.3, CUBE.shape)
    data = {
        "schema_version": 1,
        "name": "cube",
        "agents": {"position": (CUBE + off + [0, 0, 20]).tolist(), "vehicle": "p"},
        "vehicles": {"p": {"model": "point", "mass": 1.0, "thrust_limit": 100.0, "drag": 0.0}},
        "autopilot": {"rate": rate, "formation_rate": rate},
        "formations": {"cube": {"slots": CUBE.tolist(), "edges": EDGES}},
        "phases": [
            {"kind": "establish", "formation": "cube", "duration": time, "control": "tracking"}
        ],
    }
    return rf.Mission.from_dict(data | ({} if network is None else {"network": network}) | tables)


def laid_out(m: rf.Mission, r: Floats | None = None, *, h: float | None = None) -> tuple[Any, ...]:
    """Problem, workspace, flight and state of the first phase, with vehicles at r (N, 3), and steps of h [s]."""
    now = PhaseState(0.0, np.array(m.agents.position), np.zeros((m.n_agents, 3)))
    plan = plan_phase(m, leg_of(m, m.phases[0], now))
    flight = sampled_flight(m)
    if h is not None:
        flight = flight._replace(h=h)
    work = workspace(m.n_agents, len(plan.edges), solver=plan.problem.law.solver)
    S = fleet.hover_states(flight.vehicles, now.r if r is None else r, now.v)
    law = plan.problem.law
    state = fleet.initial_state(
        flight, S, work, iterations=law.iterations if law.solver == ITERATED else 1
    )
    write_edges_of_links(flight.network, state.mail, plan.edges, state.integral)
    return plan.problem, work, flight, state


def fly(problem: Any, work: Any, flight: Any, state: Any, ticks: int) -> None:
    """Fly some ticks."""
    t_end = state.clock[fleet.TIME] + ticks * flight.steps * flight.h
    call = fleet.sampled_segment(len(state.S), len(work.c), t_end)
    assert sampled.fly_ticks(problem, work, flight, state, call) == FINISHED


NETWORKS = [
    {"delay": 0.04, "loss": 0.3, "jitter": 0.04},
    {"delay": 0.02, "loss": 0.6, "burst": 5.0, "range": 5.7},
    {"delay": 0.02, "clocks": {"late": 0.3, "drift": 5e3, "consensus": 2.0, "wait": 1.0}},
]


@pytest.mark.parametrize("network", NETWORKS)
def test_no_vehicle_reads_another_ones_state(network):
    """What a vehicle does is to the bit the same if all that is not its own, nor in its inbox, is no number."""
    problem, work, flight, state = laid_out(mission(network))
    fly(problem, work, flight, state, 40)
    net = flight.network
    expected = deepcopy(state)
    fly(problem, work, flight, expected, 1)
    assert np.linalg.norm(expected.f_C, axis=1).min() > 1e-4
    for i in range(8):
        alone = deepcopy(state)
        others, foreign = np.arange(8) != i, net.links[:, 0] != i
        for name in ("S", "seen", "error", "f_u", "f_C", "force", "tau"):
            getattr(alone, name)[others] = np.nan
        alone.history[:, others] = np.nan
        mail = alone.mail
        for name in ("heard", "own", "theirs", "ours", "multiplier"):
            getattr(mail, name)[foreign] = np.nan
        mail.stamp[foreign] = -1
        for name in ("estimate", "commanded", "pull"):
            getattr(mail, name)[others] = np.nan
        # Of what is under way, i is to hear only what is due
        arriving = {
            (k, int(net.links[l, 1]))
            for l in np.flatnonzero(~foreign)
            for k in mail.due[l]
            if k >= 0
        }
        for k in range(len(mail.post)):
            for j in np.flatnonzero(others):
                if not any(
                    stamp % len(mail.post) == k and j == sender for stamp, sender in arriving
                ):
                    mail.post[k, j] = np.nan
        call = fleet.sampled_segment(
            8, len(work.c), state.clock[fleet.TIME] + flight.h * flight.steps
        )
        sampled.fly_ticks(
            problem, work, flight, alone, call
        )  # ends at once: the others have no force
        assert alone.f_C[i].tobytes() == expected.f_C[i].tobytes()
        assert alone.force[i].tobytes() == expected.force[i].tobytes()


def test_vehicles_go_by_what_they_measured():
    """Where measurements are a tick old, forces are to the bit the same wherever the vehicles truly are by now."""
    late = {"noise": {"delay": 0.02, "rate": 50.0, "position": 0.01, "velocity": 0.02, "seed": 1}}
    problem, work, flight, state = laid_out(mission({"delay": 0.04}, disturbances=late))
    flight = flight._replace(
        tables=TickTables(mission({}, disturbances=late), flight).tables_for(0, 100, problem, TURN)
    )
    fly(problem, work, flight, state, 40)
    moved = deepcopy(state)
    moved.S[:, :6] += np.random.default_rng(2).normal(0.0, 1.0, (8, 6))
    for each in (state, moved):
        fly(problem, work, flight, each, 1)
    assert np.linalg.norm(state.f_C, axis=1).min() > 1e-4
    assert moved.force.tobytes() == state.force.tobytes()
    fly(problem, work, flight, state, 1)
    fly(problem, work, flight, moved, 1)
    assert moved.force.tobytes() != state.force.tobytes()


def central_force(problem: Any, work: Any, state: Any, t: float) -> Floats:
    """Constraint forces (N, 3) of the law that knows all states."""
    S = state.S
    y = np.concatenate([S[:, :3].ravel(), S[:, 3:6].ravel(), state.integral])[None]
    return native.record(problem, work, np.array([t]), y).f_C[0]


def hold_still(m: rf.Mission, r: Floats, ticks: int) -> tuple[Floats, Floats]:
    """Forces by neighbours after some ticks in which nothing moves, and those of the law of all edges."""
    off = np.random.default_rng(1).normal(0, 0.1, r.shape)
    problem, work, flight, state = laid_out(m, r + off, h=1e-12)
    fly(problem, work, flight, state, ticks)
    return state.f_C, central_force(problem, work, state, state.clock[fleet.LAW_TIME])


@pytest.mark.parametrize("seed", range(4))
def test_the_exact_law_is_that_of_all_edges(seed):
    """On independent edges, with unequal masses, one message a tick comes to Eq. (12) within 1e-9 of the forces."""
    rng = np.random.default_rng(seed)
    masses = np.exp(rng.uniform(-0.7, 0.7, 8))
    kinds = {
        f"v{k}": {"model": "point", "mass": m, "thrust_limit": 100.0}
        for k, m in enumerate(masses.tolist())
    }
    slots = CUBE + rng.normal(0, 0.3, CUBE.shape)
    m = mission(
        {},
        agents={"position": (slots + [0, 0, 20]).tolist(), "vehicle": list(kinds)},
        vehicles=kinds,
        formations={"cube": {"slots": slots.tolist(), "edges": EDGES}},
        constraint={"solver": "exact"},
    )
    by_neighbours, central = hold_still(m, np.array(m.agents.position), 3_000)
    np.testing.assert_allclose(by_neighbours, central, rtol=0, atol=1e-9 * np.abs(central).max())


@pytest.mark.parametrize("shape", ["cube", "complete", "line", "plane"])
def test_the_default_law_is_that_of_all_edges(shape):
    """Also with ten redundant edges, and on a line and in a plane, where the exact law has no force."""
    slots, edges = CUBE, EDGES
    if shape != "cube":
        slots = {"line": np.arange(4.0)[:, None] * [3.0, 0, 0], "plane": CUBE[:4]}.get(shape, CUBE)
        edges = [[i, j] for j in range(2, len(slots) + 1) for i in range(1, j)]
    off = np.random.default_rng(5).normal(0, 0.05, slots.shape)
    m = mission(
        {},
        agents={"position": (slots + off + [0, 0, 20]).tolist(), "vehicle": "p"},
        formations={"cube": {"slots": slots.tolist(), "edges": edges}},
    )
    by_neighbours, central = hold_still(m, np.array(m.agents.position), 3_000)
    np.testing.assert_allclose(by_neighbours, central, rtol=0, atol=1e-9 * np.abs(central).max())


def test_messages_arrive_as_sent():
    """None is earlier than its delay or later than its jitter, none replaces a newer one, and all are counted."""
    problem, work, flight, state = laid_out(
        mission({"delay": 0.06, "jitter": 0.08, "loss": 0.2, "rate": 25.0})
    )
    net, before, late = flight.network, state.mail.stamp.copy(), []
    assert (net.every, net.delay, net.jitter) == (2, 3, 4)
    for k in range(400):
        fly(problem, work, flight, state, 1)
        stamp = state.mail.stamp
        new = stamp != before
        assert (stamp >= before).all()
        assert (stamp[new] % net.every == 0).all()
        late += (k - stamp[new]).tolist()
        before = stamp.copy()
    assert min(late) == net.delay
    assert max(late) == net.delay + net.jitter
    sent, heard, lost = state.mail.count
    assert (sent == 200).all()
    under_way = sent - heard - lost
    assert under_way.min() >= 0
    assert under_way.max() <= (net.delay + net.jitter) // net.every + 1


def test_nobody_hears_beyond_the_range():
    """All that is sent along the diagonals of the faces (5.7 m) is lost, along the sides (4 m) nothing."""
    problem, work, flight, state = laid_out(mission({"range": 4.9}), CUBE + [0, 0, 20])
    fly(problem, work, flight, state, 20)
    i, j = flight.network.links.T
    sent, _, lost = state.mail.count
    share = np.where(np.linalg.norm(CUBE[i] - CUBE[j], axis=1) > 4.9, 1.0, 0.0)
    np.testing.assert_array_equal(lost, share * sent)
    assert 0.0 < share.mean() < 1.0


def test_losses_come_as_often_and_in_bursts_as_long_as_they_say():
    """Shares and mean lengths of bursts are those of the key within what 36 links of 2,000 messages leave in doubt."""
    for loss, burst in ((0.3, None), (0.3, 4.0), (0.7, 10.0)):
        keys = {"loss": loss} | ({} if burst is None else {"burst": burst})
        problem, work, flight, state = laid_out(mission(keys))
        lost = [state.mail.count[LOST].copy()]
        for _ in range(2000):
            fly(problem, work, flight, state, 1)
            lost.append(state.mail.count[LOST].copy())
        gone = np.diff(lost, axis=0) > 0  # (ticks, links)
        begun = (gone[1:] & ~gone[:-1]).sum()
        length = gone.sum() / begun
        assert gone.mean() == pytest.approx(loss, abs=0.02)
        assert length == pytest.approx(burst or 1.0 / (1.0 - loss), rel=0.07)


def test_an_outage_lets_go_of_an_edge_and_takes_hold_again():
    """The share with which both ends pull falls to nothing over the time of silence, and comes back as smoothly."""
    cut = {"between": [1, 2], "start": 2.0, "end": 4.0}
    problem, work, flight, state = laid_out(mission({"silence": 0.5, "outages": [cut]}))
    net = flight.network
    both = [l for l, pair in enumerate(net.links.tolist()) if sorted(pair) == [0, 1]]
    grip = []
    for _ in range(300):
        fly(problem, work, flight, state, 1)
        grip.append(state.mail.grip[both].copy())
    grip = np.array(grip)
    time = np.arange(300) / 50.0
    assert (grip[time < 0.4] < 1.0).all()  # also at the start
    assert (grip[(time > 0.7) & (time < 2.5)] == 1.0).all()
    assert (grip[(time > 3.2) & (time < 4.0)] == 0.0).all()
    assert (grip[time > 4.7] == 1.0).all()
    assert np.abs(np.diff(grip, axis=0)).max() == pytest.approx(1.0 / 25.0)
    rest = np.setdiff1d(np.arange(len(net.links)), both)
    assert (state.mail.grip[rest] == 1.0).all()


def test_what_a_link_loses_depends_on_nothing_else():
    """The same link loses the same messages beside other vehicles and edges; another seed loses others."""

    def lost(m: rf.Mission) -> dict[tuple[int, int], int]:
        problem, work, flight, state = laid_out(m)
        fly(problem, work, flight, state, 300)
        return {
            tuple(pair): n
            for pair, n in zip(flight.network.links.tolist(), state.mail.count[LOST], strict=True)
        }

    whole = lost(mission({"loss": 0.4}))
    slots, edges = CUBE[:4], [edge for edge in EDGES if max(edge) <= 4] + [[1, 3]]
    tables: dict[str, Any] = {
        "agents": {"position": (slots + [0, 0, 20]).tolist(), "vehicle": "p"},
        "formations": {"cube": {"slots": slots.tolist(), "edges": edges}},
    }
    part = lost(mission({"loss": 0.4}, **tables))
    both = whole.keys() & part.keys()
    assert len(both) == 10
    assert {pair: whole[pair] for pair in both} == {pair: part[pair] for pair in both}
    assert lost(mission({"loss": 0.4, "seed": 7}, **tables)) != part


def test_a_budget_is_shared():
    """Broadcasts of all vehicles together are no more than the medium carries."""
    assert network_of(mission({"rate": 50.0, "budget": 80.0})).every == 5
    assert network_of(mission({"rate": 50.0, "budget": 4000.0})).every == 1


@pytest.mark.parametrize(
    ("network", "tables", "key", "words"),
    [
        ({"burst": 3.0}, {}, "network.burst", "without loss"),
        ({"budget": 4.0}, {}, "network.budget", "less than one broadcast"),
        (
            {"outages": [{"between": [1, 9], "start": 1.0, "end": 2.0}]},
            {},
            "network.outages[1].between",
            "no such",
        ),
        (
            {"outages": [{"start": 2.0, "end": 2.0}]},
            {},
            "network.outages[1].end",
            "not after start",
        ),
        ({"lost": [{"between": [2, 2], "time": 1.0}]}, {}, "network.lost[1].between", "to itself"),
        ({}, {"constraint": {"solver": "pinv"}}, "network", "eigenvalues"),
        ({}, {"avoidance": {}}, "avoidance", "all vehicles at once"),
    ],
)
def test_what_a_network_cannot_be_is_refused(network, tables, key, words):
    """Each in one sentence with its remedy."""
    with pytest.raises(MissionError) as refused:
        mission(network, **tables)
    (finding,) = refused.value.findings
    assert finding.key == key
    assert words in finding.problem
    assert finding.remedy


def test_links_of_before_are_a_network(tmp_path):
    """[disturbances.links] gives the numbers of [network]: with one warning in a mission, and with none in a result.

    Beside [network] it is refused, as are its keys there.
    """
    m = mission({"delay": 0.02, "loss": 0.3, "seed": 5}, time=5.0)
    result = rf.simulate(m)
    data = m.to_dict()
    links = data.pop("network")
    links["dropped"] = links.pop("loss")
    data["disturbances"] = {"links": links}
    result.mission_text = to_toml(data)
    file = tmp_path / "earlier.nc"
    result.save(file)
    assert rf.Result.load(file).mission.network == m.network
    text = tmp_path / "earlier.toml"
    text.write_text(to_toml(data))
    for load in (lambda: rf.load_mission(text), lambda: rf.Mission.from_dict(data)):
        with pytest.warns(
            FutureWarning, match=r"\[disturbances.links\] is now \[network\]"
        ) as warned:
            now = load()
        assert len(warned) == 1
        assert now.to_dict() == m.to_dict() | {"disturbances": {}}
        assert rf.Mission.from_toml(now.text).network == now.network == m.network
    with pytest.raises(MissionError, match=r"it is now called '\[network\]'"):
        rf.Mission.from_dict(data | {"network": {}})
    data["network"] = data["disturbances"].pop("links")
    with pytest.raises(MissionError, match=r"network.dropped = 0.3: .*\n *it is now called 'loss'"):
        rf.Mission.from_dict(data)


def test_a_result_has_what_its_links_did():
    """Ages at samples are those of the messages heard; what is sent is heard, lost or under way; replay and notes."""
    m = mission({"delay": 0.04, "outages": [{"between": [1, 2], "start": 4.0, "end": 6.0}]})
    result = rf.simulate(m)
    age, edge = result.message_age, result.edge_labels.index("1-2")
    assert age is not None
    at = result.time > 0.2
    others = np.delete(age[at], edge, axis=1)
    assert others.min() >= 0.04 - 1e-9
    assert others.max() < 0.04 + 0.02 + 1e-9
    # The last message before the outage was sent at 3.98 s, the first after it arrives at 6.04 s.
    out = (result.time > 4.05) & (result.time < 6.03)
    np.testing.assert_allclose(
        age[out, edge], np.repeat(result.time[out, None] - 3.98, 2, axis=1), atol=1e-9
    )
    assert result.messages is not None
    sent, heard, lost = result.messages.sum(axis=(0, 1))
    assert sent == 2 * len(EDGES) * 500
    assert lost == 2 * 100
    assert 0 < sent - heard - lost <= 2 * len(EDGES) * 3  # under way at the end
    silent = page_samples(result, np.arange(len(EDGES)), 1.0)["silent"].values
    np.testing.assert_allclose(silent[out, edge], np.minimum((result.time[out] - 3.98) / 0.5, 1.0))
    words = " ".join(rf.assess(result).notes)
    assert "edges that let go for want of messages, first at 4.50 s: 1-2." in words + "."
    oldest = oldest_message_ages(result)
    assert oldest[out, 0].min() > oldest[out, 2].max()
    assert "messages" in plotting.figure_names(result)
    assert plotting.messages(result).axes[0].get_ylabel() == "oldest message [s]"


def test_live_flying_loses_messages():
    """The share of messages lost while somebody flies is that of the page's slider from then on."""
    session = Session(mission({}))
    for _ in range(20):
        session.pilot.fly_tick()
    session.execute_command({"loss": 0.9})
    before = session.pilot.result().messages
    for _ in range(200):
        session.pilot.fly_tick()
    messages = session.pilot.result().messages
    assert before is not None
    assert messages is not None
    sent, _, lost = (messages - before).sum(axis=(0, 1))
    assert before[..., LOST].sum() == 0
    assert 0.85 < lost / sent < 0.95


def test_a_lost_vehicle_is_noticed_by_silence_alone():
    """Neighbours hold on to what they last heard, let go after the silence, and no force jumps on the way."""
    m = mission(
        {},
        vehicles={"p": {"model": "point", "mass": 1.0, "thrust_limit": 100.0, "drag": 1e-3}},
        disturbances={
            "gusts": {"model": "first-order", "intensity": 1e3, "time_scale": 2.0, "seed": 3},
            "lost": [{"agent": 8, "time": 6.0}],
        },
        tracking={"Q": [1.0, 0.0], "R": 1.0},
        output_step=0.02,
    )
    result = rf.simulate(m)
    force, t = result.constraint_force[:, :7], result.time
    steps = np.linalg.norm(np.diff(force, axis=0), axis=2).max(axis=1)
    known = (t > 5.0) & (t < 6.0), (t > 6.0) & (t < 7.5)
    assert np.linalg.norm(force, axis=2)[known[1]].max() > 1.0
    assert steps[known[1][1:]].max() < 1.5 * steps[known[0][1:]].max()
    words = "for want of messages, first at 6.50 s: 3-8, 4-8, 5-8, 6-8, 7-8"
    assert any(words in note for note in rf.assess(result).notes)
