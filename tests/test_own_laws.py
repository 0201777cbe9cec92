"""Laws of vehicles' own: what each vehicle knows, what reaches it and when, and errors that name vehicle and tick."""

from typing import Any

import numpy as np
import pytest

import rigidfleet as rf
from rigidfleet.errors import FlightError
from rigidfleet.simulation.own_laws import View, immutable_copy

TRIANGLE = [[0.0, 0.0, 20.0], [4.0, 0.0, 20.0], [2.0, 3.5, 20.0]]
SLOTS = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [2.0, 3.5, 0.0]]


def mission(network: dict[str, Any] | None, *, time: float = 2.0, **tables: Any) -> rf.Mission:
    """Three points of 1, 2 and 3 kg in a triangle whose vehicle 3 has no edge with the first; they hold their slots."""
    masses = {
        f"v{k}": {"model": "point", "mass": float(k), "thrust_limit": 200.0} for k in (1, 2, 3)
    }
    data = {
        "schema_version": 1,
        "name": "own",
        "agents": {"position": TRIANGLE, "vehicle": list(masses)},
        "vehicles": masses,
        "autopilot": {"rate": 100.0, "formation_rate": 50.0},
        "formations": {"triangle": {"slots": SLOTS, "edges": [[1, 2], [2, 3]]}},
        "phases": [
            {
                "kind": "establish",
                "name": "form",
                "formation": "triangle",
                "duration": time,
                "blend": 0.1,
            }
        ],
    }
    return rf.Mission.from_dict(data | ({} if network is None else {"network": network}) | tables)


def hover(me: View) -> np.ndarray:
    """Force that follows the slot by the gains of the built-in law of default weights."""
    a = me.reference_acceleration - 2.0 * (me.position - me.reference_position)
    a = a - np.sqrt(8.0) * (me.velocity - me.reference_velocity) + [0.0, 0.0, me.gravity]
    return me.mass * a


def watch(m: rf.Mission, say: Any = lambda me: me.t) -> tuple[list[View], rf.Result]:
    """All that vehicles knew in a flight in which they hold their slots, and its record."""
    views = []

    def law(me: View) -> tuple[np.ndarray, Any]:
        views.append(me)
        return hover(me), say(me)

    return views, rf.simulate(m, agent=law)


# -- what a vehicle knows ------------------------------------------------------------------------------


def test_a_law_is_called_for_each_vehicle_at_each_tick():
    """Fifty times a second for each vehicle, with its own mass, the state of now and the slot of the record."""
    views, result = watch(mission({}))
    assert [(v.agent, round(v.t * 50, 9)) for v in views] == [
        (i, k) for k in range(100) for i in range(3)
    ]
    record = rf.simulate(
        mission({}), agent=lambda me: (hover(me), None), times=np.arange(1, 100) / 50
    )
    for i in range(3):
        own = [v for v in views if v.agent == i][1:]
        assert {(v.mass, v.dt, v.phase, v.attitude) for v in own} == {(i + 1.0, 0.02, "form", None)}
        for name, recorded in (
            ("position", record.position), ("velocity", record.velocity), ("reference_position", record.slot_position),
        ):  # fmt: skip
            seen = np.array([getattr(v, name) for v in own])
            np.testing.assert_allclose(seen, recorded[:, i], rtol=0, atol=1e-9, err_msg=name)
    assert views[-1].distance == pytest.approx({1: np.hypot(2.0, 3.5)})
    assert result.complete


def test_a_vehicle_has_no_way_to_another_ones_state():
    """Whatever it reaches from its view, and writes to, is its own: no other vehicle feels it, and no tick after."""

    def spoil(x: Any) -> None:
        if isinstance(x, np.ndarray) and x.flags.writeable:
            whole = x if x.base is None else x.base
            assert whole.size <= 15  # its own rows alone lie there
            whole[...] = np.nan
        elif isinstance(x, dict):
            x.clear()

    def vandal(me: View) -> tuple[np.ndarray, np.ndarray]:
        force, said = hover(me), me.position.copy()
        if me.agent == 0:
            for name in View.__slots__:
                spoil(getattr(me, name))
        return force, said

    m = mission({"delay": 0.02})
    honest = rf.simulate(m, agent=lambda me: (hover(me), me.position))
    spoilt = rf.simulate(m, agent=vandal)
    assert honest.position.tobytes() == spoilt.position.tobytes()


def test_the_built_in_tracking_as_own_laws_flies_the_same_way():
    """Without edges, the law of slots written down for each vehicle flies as the built-in one."""
    m = mission(None, formations={"triangle": {"slots": SLOTS, "edges": []}})
    built_in = rf.simulate(m)
    own = rf.simulate(mission({}), agent=lambda me: (hover(me), None))
    np.testing.assert_allclose(own.position, built_in.position, rtol=0, atol=1e-10)
    assert own.mission.network is not None
    assert np.abs(own.constraint_force).max() == 0.0


def test_vehicles_with_rotors_follow_their_laws_too():
    """Their forces enter where those of the built-in law do: the same flight; attitude and rotors are known."""
    rotors: dict[str, Any] = {
        "vehicles": {"v": {"model": "paper"}},
        "agents": {"vehicle": "v", "position": TRIANGLE},
    }
    flat: dict[str, Any] = {"tracking": {"drag_feedforward": False}} | rotors
    m = mission(None, **flat, formations={"triangle": {"slots": SLOTS, "edges": []}})
    views, own = watch(mission({}, **flat))
    np.testing.assert_allclose(own.position, rf.simulate(m).position, rtol=0, atol=1e-9)
    assert [
        np.array(x).shape for x in (views[0].attitude, views[0].rates, views[0].rotor_speed)
    ] == [
        (4,),
        (3,),
        (4,),
    ]
    assert own.vehicle_attitude is not None
    assert views[0].attitude is not None
    np.testing.assert_allclose(views[0].attitude, own.vehicle_attitude[0, 0], atol=1e-12)


def test_memories_are_each_vehicles_own():
    """A function's memory and a class's object are kept from tick to tick, one a vehicle."""
    counts: dict[int, list[int]] = {0: [], 1: [], 2: []}

    def law(me: View) -> tuple[np.ndarray, None]:
        me.memory["calls"] = me.memory.get("calls", 0) + me.agent
        counts[me.agent].append(me.memory["calls"])
        return hover(me), None

    rf.simulate(mission({}, time=0.2), agent=law)
    assert {i: calls[-1] for i, calls in counts.items()} == {0: 0, 1: 10, 2: 20}
    objects = []

    class Counting:
        def __init__(self) -> None:
            self.calls = 0
            objects.append(self)

        def __call__(self, me: View) -> tuple[np.ndarray, None]:
            self.calls += 1
            return hover(me), None

    rf.simulate(mission({}, time=0.2), agent=Counting)
    assert [o.calls for o in objects] == [10, 10, 10]


# -- what it hears ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("delay", "least"), [(0.0, 0.02), (0.05, 0.06), (0.1, 0.1)])
def test_messages_arrive_as_late_as_the_network_says(delay, least):
    """Ages are whole ticks of the delay, and say when the message was written; only neighbours are heard."""
    views, _ = watch(mission({"delay": delay, "rate": 50.0}), lambda me: (me.agent, me.t))
    for v in views:
        assert set(v.inbox) <= {0: {1}, 1: {0, 2}, 2: {1}}[v.agent]
        assert len(v.inbox) == (
            0 if v.t < least - 1e-9 else len({0: [1], 1: [0, 2], 2: [1]}[v.agent])
        )
        for j, (said, age) in v.inbox.items():
            assert said == (j, pytest.approx(v.t - age))
            assert age == pytest.approx(least)


def test_with_jitter_and_loss_the_newest_message_is_kept():
    """Whatever overtakes or is lost, what is known never becomes older; ages are those of the record of the kernel."""
    views, result = watch(mission({"delay": 0.02, "jitter": 0.1, "loss": 0.5, "seed": 3}, time=4.0))
    written = [v.inbox[1].content for v in views if v.agent == 0 and 1 in v.inbox]
    assert np.diff(written).min() == 0.0
    ages = np.array([v.inbox[1].age for v in views if v.agent == 0 and 1 in v.inbox])
    contents = np.array([v.t - v.inbox[1].content for v in views if v.agent == 0 and 1 in v.inbox])
    np.testing.assert_allclose(ages, contents, atol=1e-9)
    assert ages.max() > 0.1 > ages.min()
    assert result.oldest_message is not None
    assert result.oldest_message[0, 0] == pytest.approx(ages.max())
    assert result.messages is not None
    assert (result.messages[..., 0] == 200).all()
    assert result.statistics["message_numbers"] == 1


def test_who_says_none_is_silent():
    """None is not sent: neighbours keep what they heard before, and it grows old."""
    views, _ = watch(mission({"delay": 0.0}), lambda me: me.t if me.t < 1.0 else None)
    last = next(v.inbox[1] for v in reversed(views) if v.agent == 0)
    assert last.content == pytest.approx(0.98)
    assert last.age == pytest.approx(1.0)


def test_a_broadcast_says_what_was_said_last():
    """A network slower than the laws takes every fourth message; its age is that of what it says."""
    views, _ = watch(mission({"delay": 0.0, "rate": 12.5}))
    contents = {v.inbox[1].content for v in views if v.agent == 0 and 1 in v.inbox}
    np.testing.assert_allclose(sorted(contents), 0.08 * np.arange(25), atol=1e-9)


def test_a_lost_vehicle_is_known_by_its_silence_alone():
    """Its neighbours keep its last message and the length of their edge; its own law is called no more."""
    m = mission({"delay": 0.0}, disturbances={"lost": [{"agent": 3, "time": 1.0}]})
    views, _ = watch(m)
    assert max(v.t for v in views if v.agent == 2) == pytest.approx(0.98)
    last = next(v for v in reversed(views) if v.agent == 1)
    assert last.t > 1.9
    assert last.inbox[2].content == pytest.approx(0.98)
    assert set(last.distance) == {0, 2}


def test_messages_are_copies_that_nobody_can_change():
    """Numbers, arrays and what contains them arrive as they were when they were said; their numbers are counted."""
    array = np.arange(3.0)
    copy, size = immutable_copy({"a": array, "b": [1, 2.5, (True, np.float64(3.0))]})
    array[:] = 9.0
    assert size == 7
    assert copy["a"].tolist() == [0.0, 1.0, 2.0]
    assert copy["b"] == (1, 2.5, (True, 3.0))
    with pytest.raises(ValueError, match="read-only"):
        copy["a"][0] = 1.0
    with pytest.raises(TypeError):
        copy["a"] = 1.0


# -- errors ----------------------------------------------------------------------------------------------


def fails(answer: Any) -> Any:
    """A law that answers wrongly for vehicle 2 at t = 0.5 s."""

    def law(me: View) -> Any:
        wrong = me.agent == 1 and me.t > 0.499
        return answer(me) if wrong else (hover(me), None)

    return law


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (lambda me: 1 / 0, "raised ZeroDivisionError at tick 50, t = 0.500 s: division by zero"),
        (
            lambda me: None,
            "returned None at tick 50, t = 0.500 s: return a force (3,) [N] and a message",
        ),
        (lambda me: np.zeros(3), "returned array([0., 0., 0.]) at tick 50"),
        (lambda me: (np.zeros(4), 1.0), "returned as its force an array of shape (4,) at tick 50"),
        (lambda me: ("up", 1.0), "returned as its force 'up' at tick 50"),
        (lambda me: (np.zeros(3) * 1j, None), "returned as its force complex numbers at tick 50"),
        (
            lambda me: ([0.0, np.nan, 1.0], 1.0),
            "as its force [0.0, nan, 1.0], which is not finite at tick 50, t = 0.500 s: return a",
        ),
        (
            lambda me: (np.zeros(3), "hello"),
            "a message that cannot be sent at tick 50, t = 0.500 s: it contains a str",
        ),
        (lambda me: (np.zeros(3), [np.array(["x"])]), "it contains an array of <U1"),
    ],
)
def test_what_is_wrong_names_vehicle_and_tick(answer, words):
    """One sentence with the vehicle, the tick, the time and what to return; what was flown until then is kept."""
    with pytest.raises(FlightError) as failed:
        rf.simulate(mission({}), agent=fails(answer))
    assert str(failed.value).startswith("the law of agent 2 ")
    assert words in str(failed.value)
    assert failed.value.result is not None
    assert failed.value.result.time[-1] == pytest.approx(0.5, abs=0.11)
    assert failed.value.result.phases[-1].t_end == pytest.approx(0.5)


def test_what_cannot_be_is_refused():
    """No network, two who command, and what cannot be called."""
    law = fails(None)
    with pytest.raises(FlightError, match=r"add \[network\]"):
        rf.simulate(mission(None), agent=law)
    with pytest.raises(ValueError, match="one of controller and agent"):
        rf.simulate(mission({}), agent=law, controller=lambda o: o.position)
    untyped: Any = 3
    with pytest.raises(TypeError, match="a function for agent"):
        rf.simulate(mission({}), agent=untyped)


def test_the_verdict_is_on_the_own_law():
    """Checks are those of the mission, which such a law fails that lets the formation fall; no plan is promised."""
    m = mission({}, limits={"speed": 5.0})
    passed = rf.assess(rf.simulate(m, agent=lambda me: (hover(me), None)))
    failed = rf.assess(rf.simulate(m, agent=lambda me: (0.0 * hover(me), None)))
    assert passed.passed, passed.summary
    assert not failed.by_name["speed"].passed
    assert passed.uncalled == ""


# -- in sweeps -------------------------------------------------------------------------------------------

LAW = """
class Own:
    def __init__(self):
        self.agent = None

    def __call__(self, me):
        assert self.agent in (None, me.agent)  # an object a vehicle
        self.agent = me.agent
        return follow(me)


def follow(me):
    a = me.reference_acceleration - 2.0 * (me.position - me.reference_position) - 2.8 * me.velocity
    a[2] += me.gravity
    return me.mass * a, me.position
"""


def test_a_sweep_flies_own_laws_by_name(tmp_path, monkeypatch):
    """Rows are those of `simulate` with the law, over runs that vary what links lose."""
    from rigidfleet.assessment import assess
    from rigidfleet.sweep import Sweep, fly
    from rigidfleet.sweep.metrics import measure_metrics

    (tmp_path / "a_law_of_each.py").write_text(LAW)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    m = mission({"delay": 0.02})
    sweep = Sweep.of(m, ["network.loss = grid(0.0, 0.5)"], agent="a_law_of_each:Own")
    table = fly(sweep, "swept", workers=1)
    for k in range(2):
        flown = rf.simulate(sweep.mission_of(k), agent=sweep.law[0])
        assert measure_metrics(flown, assess(flown))["thrust"] == table.metrics["thrust"][k]
    assert Sweep.from_json(sweep.json()).version == sweep.version
    assert "a_law_of_each:Own" in sweep.version


@pytest.mark.parametrize(
    ("network", "keys", "key", "words"),
    [
        (None, {}, "agent", "needs a network"),
        ({}, {"controller": "a_law_of_each:follow"}, "agent", "does not go with a controller"),
        ({}, {"agent": "a_law_of_each:no"}, "agent", "cannot be imported"),
        ({}, {"rate": 20.0}, "rate", "is that of a controller"),
        ({}, {"evaluate": "final"}, "agent", "does not act on final states"),
    ],
)
def test_what_a_sweep_of_own_laws_cannot_be_is_refused(
    tmp_path, monkeypatch, network, keys, key, words
):
    """Each in a finding of its key."""
    from rigidfleet.errors import SweepError
    from rigidfleet.sweep import Sweep

    (tmp_path / "a_law_of_each.py").write_text(LAW)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SweepError) as refused:
        Sweep.of(
            mission(network),
            ["agents.mass.1 = uniform(1, 2)"],
            runs=2,
            **({"agent": "a_law_of_each:follow"} | keys),
        )
    assert any(
        finding.key == key and words in finding.problem for finding in refused.value.findings
    )
