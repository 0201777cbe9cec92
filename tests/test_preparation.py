"""What flights share, and what compiled code is given, leaves no trace in a flight."""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import FrozenInstanceError, is_dataclass
from typing import Any

import numpy as np
import pytest

from rigidfleet import assess, simulate
from rigidfleet.kernel import records
from rigidfleet.kernel.engine import native, packing
from rigidfleet.kernel.problem import Problem, workspace
from rigidfleet.math import pid
from rigidfleet.mission import Mission, load_mission
from rigidfleet.planning.legs import phase_spans
from rigidfleet.result import VARIABLES, Result
from rigidfleet.result.result import LATER
from rigidfleet.simulation.flight import Flight

LOST = {"disturbances": {"lost": [{"agent": 2, "time": 3.0}]}}


def a_mission(**changes) -> Mission:
    """The triangle, flown for some seconds and turned."""
    data = load_mission("establish-triangle").to_dict()
    name = data["phases"][0]["formation"]
    data["phases"] = [
        {"kind": "establish", "formation": name, "duration": 4.0},
        {"kind": "fly", "position": [4.0, 2.0, 9.0], "duration": 5.0},
    ]
    return Mission.from_dict(data | changes)


def same(a: Result, b: Result) -> None:
    """All arrays have the same bits, and the phases the same extremes."""
    for name in VARIABLES:
        x, y = getattr(a, name), getattr(b, name)
        assert (x is None) == (y is None), name
        if x is not None:
            np.testing.assert_array_equal(x, y, name)
    assert [p.extremes for p in a.phases] == [p.extremes for p in b.phases]


@pytest.mark.parametrize("changes", [{}, LOST], ids=["whole", "lost"])
def test_flights_of_one_mission_repeat_bit_for_bit(changes):
    """A second and a third flight of a mission, which reuse what the first has prepared, are those of a new mission."""
    mission = a_mission(**changes)
    first = simulate(mission)
    simulate(a_mission(agents=mission.to_dict()["agents"] | {"mass": [1.0, 1.2, 1.1]}))
    for _ in range(2):
        same(simulate(mission), first)
    same(simulate(a_mission(**changes)), first)


def test_flights_of_one_mission_at_the_same_time_do_not_meet():
    """Flights in threads, and flights step by step in turns, are those flown alone."""
    mission = a_mission()
    alone = simulate(mission)
    with ThreadPoolExecutor(4) as pool:
        for result in pool.map(lambda _: simulate(mission), range(8)):
            same(result, alone)
    flights = [Flight(mission), Flight(mission)]
    while [flight.begin() for flight in flights] == [True, True]:
        for flight in flights:
            flight.advance()
    for flight in flights:
        same(flight.finish(), alone)


def test_a_force_changes_only_its_own_flight():
    """A plan that has been flown with a user's force is not that of a flight without one."""
    mission = a_mission()
    calm = simulate(mission)
    pushed = simulate(mission, force=lambda t, r, v: np.full(r.shape, 0.1))
    assert np.abs(pushed.position - calm.position).max() > 1e-3
    same(simulate(mission), calm)


def alter_all(x: Any) -> None:
    """Try to alter a thing and all that it holds: arrays, attributes, lists and tables."""
    if isinstance(x, np.ndarray) and x.flags.writeable:
        x[...] = 1
    elif isinstance(x, list | dict):
        for part in [*(x.values() if isinstance(x, dict) else x)]:
            alter_all(part)
        x.clear()
    elif isinstance(x, tuple):
        for part in x:
            alter_all(part)
    elif is_dataclass(x):
        for name, part in [*vars(x).items()]:
            alter_all(part)
            with suppress(FrozenInstanceError):
                setattr(x, name, None)


THROUGH = [{"position": [2.0, 1.0, 9.0], "time": 2.0}]
STARTS = {
    "shape": {},
    "waypoints": {"kind": "fly", "position": [4.0, 2.0, 9.0], "duration": 5.0, "through": THROUGH},
}


@pytest.mark.parametrize("start", STARTS)
def test_who_alters_the_plan_of_a_flight_alters_no_other_flight(start):
    """The plan of the first phase is made once; what a flight shows of it is its own, or cannot be altered."""

    def a_new_one() -> Mission:
        phases = a_mission().to_dict()["phases"]
        phases = [STARTS[start] or phases[0], phases[1]]
        return a_mission(phases=phases, smoothness="jerk", formulation="inertial")

    mission, other = a_new_one(), simulate(a_new_one())
    flight = Flight(mission)
    assert flight.begin()
    alter_all(flight.plan)
    assert flight.plan.problem is None
    result = simulate(mission)
    same(result, other)
    assert result.phases == other.phases


def examples() -> list:
    """Named tuples of several sizes."""
    rng = np.random.default_rng(1)
    state = records.integrator(rng.normal(size=21), 1.5, rtol=1e-8, atol=np.ones(21))
    times = np.linspace(0.0, 1.0, 7)
    return [
        workspace(3, 3), state, records.new_record(7, 3, 3), packing.example_of(Problem),
        records.Segment(2.5, True, 9, times, np.ones((7, 21)), np.ones(21)),
    ]  # fmt: skip


def as_words(x: Any) -> list[int]:
    """Words of a named tuple: of arrays their places in memory and their shapes."""
    if isinstance(x, tuple):
        return [word for value in x for word in as_words(value)]
    if isinstance(x, np.ndarray):
        return [x.ctypes.data, *x.shape]
    return [int(np.array(x, float if isinstance(x, float) else np.int64).view(np.int64))]


@pytest.mark.parametrize("k", range(5))
def test_words_are_those_of_a_walk_through_the_tuple(k):
    """Compiled code finds the numbers, and the addresses and shapes of arrays, in the order of the fields."""
    x = examples()[k]
    assert list(packing.pack_uncached(x).words) == as_words(x)


@pytest.mark.parametrize(
    "wrong",
    [
        {"times": np.arange(7)},  # integers
        {"samples": np.ones((21, 7)).T},  # not C-contiguous
        {"samples": np.ones(21)},  # one dimension too few
        {"max_steps": 9.0},
        {"t_end": 2},
    ],
    ids=["type", "order", "dimensions", "float", "int"],
)
def test_arguments_of_other_types_are_refused(wrong):
    """Machine code gets nothing that it would misread."""
    native.library()
    segment = examples()[4]
    packing.pack_uncached(segment)
    with pytest.raises(TypeError):
        packing.pack_uncached(segment._replace(**wrong))


def test_singular_values_come_when_they_are_asked_for(tmp_path):
    """A flight does not compute them; its file has them, and they are those of J at the positions."""
    result = simulate(a_mission())
    assert "singular_value" not in vars(result)
    result.save(tmp_path / "flight.nc")
    loaded = Result.load(tmp_path / "flight.nc")
    k = len(result.time) // 2
    J = np.zeros((len(result.edges), 3, 3))
    for row, (i, j) in enumerate(result.edges):
        way = result.position[k, i] - result.position[k, j]
        J[row, i], J[row, j] = way / np.linalg.norm(way), -way / np.linalg.norm(way)
    expected = np.linalg.svd(J.reshape(len(J), -1), compute_uv=False)[-1]
    assert loaded.singular_value[k] == pytest.approx(expected, rel=1e-9)
    np.testing.assert_array_equal(result.singular_value, loaded.singular_value)


def asked_for(result: Result, names) -> dict[str, np.ndarray]:
    """Arrays of a result, asked for in this order."""
    found = {name: getattr(result, name) for name in names}
    return {name: x for name, x in found.items() if x is not None}


WINDY = {
    "disturbances": {
        "wind": [1.0, 0.0, 0.0], "drag": 0.3, "noise": {"position": 0.01, "velocity": 0.03, "rate": 50.0, "seed": 1},
    }
}  # fmt: skip


@pytest.mark.parametrize("given", [{}, WINDY], ids=["still", "windy"])
@pytest.mark.parametrize("controller", [None, lambda seen: 9.81 * seen.masses[:, None] * [0, 0, 1]])
def test_what_a_flight_makes_later_is_what_it_would_have_made_at_once(given, controller):
    """Bit for bit: in any order, after other flights, from a pickle, a copy, or two threads at once."""
    mission = Mission.from_dict(a_mission().to_dict() | given)
    names = [*VARIABLES]
    first, second, third = (simulate(mission, controller=controller) for _ in range(3))
    assert {"thrust", "attitude", "separation"}.isdisjoint(vars(first))
    whole = asked_for(first, names)
    assert simulate("establish-cube").thrust.any()
    pickled, copied = pickle.loads(pickle.dumps(second)), copy.copy(second)
    ready = vars(copy.copy(second).compute_lazy_values())
    assert whole.keys() | {"mission_text"} <= ready.keys()
    with ThreadPoolExecutor(2) as pool:
        both = [pool.submit(asked_for, third, order) for order in (names, names[::-1])]
        others = [asked_for(x, names[::-1]) for x in (second, pickled, copied)]
        others += [thread.result() for thread in both]
    others.append({name: ready[name] for name in whole})
    for other in others:
        assert other.keys() == whole.keys()
        for name, x in whole.items():
            np.testing.assert_array_equal(other[name], x, err_msg=name)


@pytest.mark.parametrize("solver", ["iterated", "exact"])
@pytest.mark.parametrize("formulation", ["inertial", "body"])
def test_what_a_large_flight_makes_later_is_what_moved_its_vehicles(solver, formulation):
    """Also from a pickle: forces over masses are the change of the velocities that were flown."""
    position = {"shape": "grid", "size": 2.0, "count": 150, "centre": [0.0, 0.0, 30.0]}
    mission = Mission.from_dict(
        {
            "schema_version": 1, "name": "sphere", "agents": {"mass": 0.3, "position": position},
            "assignment": "each", "constraint": {"solver": solver}, "formulation": formulation,
            "formations": {"sphere": {"shape": "sphere", "size": 2.0, "edges": "neighbours"}},
            "phases": [{"kind": "establish", "formation": "sphere", "blend": 2.0, "duration": 2.5}],
            "integrator": {"rtol": 1e-9, "atol": 1e-9},
        }
    )  # fmt: skip
    h, at = 1e-3, [0.5, 1.0, 1.5, 2.2]
    flown = simulate(mission, times=np.ravel([[t - h, t, t + h] for t in at]))
    assert {*flown.statistics["solvers"]} == {"sparse"}
    assert "thrust" not in vars(flown)
    again = pickle.loads(pickle.dumps(flown))
    for name, x in asked_for(flown, [*VARIABLES]).items():
        np.testing.assert_array_equal(getattr(again, name), x, err_msg=name)
    before, after = flown.velocity[::3], flown.velocity[2::3]
    force = (flown.input_force + flown.constraint_force)[1::3]
    assert np.abs(force).max() > 0.3 * mission.gravity
    np.testing.assert_allclose(
        force / 0.3 - [0.0, 0.0, mission.gravity], (after - before) / (2.0 * h), atol=1e-4
    )
    np.testing.assert_allclose(flown.thrust[1::3], np.linalg.norm(force, axis=2), rtol=1e-12)


def test_what_is_made_later_is_listed():
    """Consoles and notebooks complete every field of a result, made or not."""
    result = simulate(a_mission())
    assert "thrust" not in vars(result)
    assert {*VARIABLES, "mission_text"} <= {*dir(result)}
    assert "thrust" not in vars(result), "listing makes nothing"


def test_a_verdict_makes_no_derivatives_of_references():
    """A flight without a limit of jerk is judged without the derivatives of its slots, which take longer to make."""
    result = simulate(a_mission())
    assert assess(result).checks
    assert not {*LATER} & {*vars(result)}


def test_only_a_phase_that_settles_needs_the_time_to_settle(monkeypatch):
    """A flight whose phases end at given times never computes in which time errors settle."""

    def settling_time(*_):
        raise AssertionError("computed")

    monkeypatch.setattr(pid, "settling_time", settling_time)
    assert simulate(a_mission()).complete
    phases = [*a_mission().to_dict()["phases"], {"kind": "hold", "settle": {}}]
    with pytest.raises(AssertionError, match="computed"):
        phase_spans(a_mission(phases=phases))


def test_what_somebody_sets_is_not_made_later():
    """A field that is set stays when others are made; positions changed in place change nothing else."""
    changed, plain = simulate(a_mission()), simulate(a_mission())
    changed.thrust = np.zeros_like(plain.thrust)
    changed.position[:] += 100.0
    np.testing.assert_array_equal(changed.cm, plain.cm)
    np.testing.assert_array_equal(changed.separation, plain.separation)
    assert not changed.thrust.any()
    np.testing.assert_array_equal(changed.position, plain.position + 100.0)


def test_the_verdict_finds_what_was_altered_after_the_flight():
    """An altered position is judged anew: it contradicts what the flight has recorded."""
    result = simulate(a_mission())
    assert not [c for c in assess(result).checks if c.check == "record"]
    before = result.position.copy()
    result.position[50, 0] += 0.5
    wrong = [c for c in assess(result).checks if c.check == "record"]
    assert "contradicts itself" in wrong[0].message
    result.position[:] = before
    assert not [c for c in assess(result).checks if c.check == "record"]


def test_a_copy_of_what_is_packed_has_the_addresses_of_its_own_arrays():
    """A deep copy of a flight that has not been evaluated keeps nothing of the original."""
    times = np.linspace(0.0, 2.5, 7)
    given = packing.pack_uncached(
        records.Segment(2.5, True, 9, times, np.ones((7, 21)), np.ones(21))
    )
    for other in (copy.deepcopy(given), pickle.loads(pickle.dumps(given))):
        assert other.of.times is not times
        assert bytes(other.words) == bytes(packing.pack_uncached(other.of).words)
    result = simulate(load_mission("square"))
    other = copy.deepcopy(result)
    np.testing.assert_array_equal(
        other.compute_lazy_values().constraint_force, result.compute_lazy_values().constraint_force
    )


@pytest.mark.parametrize("name", ["crazyflies", "cube-by-neighbours", "narrow-passage-found"])
def test_a_mission_whose_flight_has_begun_can_be_pickled(name):
    """What a flight has made of it stays behind: its legs hold functions, which no pickle takes."""
    mission = load_mission(name)
    flight = Flight(mission)
    assert flight.begin()
    for flown in (mission, flight.mission):
        copied = pickle.loads(pickle.dumps(flown))
        assert copied.to_dict() == flown.to_dict()
        assert Flight(copied).begin()
