"""Eight missions side by side: `rigidfleet.simulation.together`, and the code that serves their vectors."""

from typing import Any

import numba
import numpy as np
import pytest

from rigidfleet.assessment import assess
from rigidfleet.kernel.compiler.simd import empty_lanes, pack_lanes, unpack_lanes
from rigidfleet.kernel.engine import batch, codegen, lane_steps, native
from rigidfleet.kernel.engine.tracer import Code, FlightTrace, UnfitError, varying_numbers
from rigidfleet.kernel.gauge import write_watched_forces
from rigidfleet.kernel.problem import Problem, workspace
from rigidfleet.kernel.records import FIRST_ROW, TRAILED
from rigidfleet.mission import Mission, load_mission
from rigidfleet.result import Result
from rigidfleet.simulation.extremes import Extremes
from rigidfleet.simulation.flight import Flight, simulate
from rigidfleet.simulation.together import MOST_VEHICLES, simulate_together


def varied(name: str, change: Any, count: int = 8) -> list[Mission]:
    """Missions that differ in what ``change(data, k)`` does to the text of a shipped one."""
    made = []
    for k in range(count):
        data = load_mission(name).to_dict()
        change(data, k)
        made.append(Mission.from_dict(data))
    return made


def windy(data: dict[str, Any], k: int) -> None:
    """Other masses, gusts and noise; the first three phases."""
    data["agents"]["mass"] = [1.0 + 0.02 * k, 1.0 - 0.01 * k, 1.0 + 0.003 * k]
    for name in ("gusts", "noise"):
        data["disturbances"][name]["seed"] = 5 * k
    data["phases"] = data["phases"][:3]


def folding(data: dict[str, Any], k: int) -> None:
    """Another gain; to the end of the fold into a line."""
    data["constraint"] = data.get("constraint", {}) | {"alpha": 0.4 + 0.02 * k}
    data["phases"] = data["phases"][:8]


def off(a: Result, b: Result) -> float:
    """Greatest distance [m] of two flights."""
    np.testing.assert_array_equal(a.time, b.time)
    return float(np.linalg.norm(a.position - b.position, axis=2).max())


def alone(missions: list[Mission]) -> list[Result]:
    return [simulate(mission) for mission in missions]


@pytest.mark.parametrize(
    ("name", "change", "close", "force"),
    [("narrow-passage", folding, 2e-7, 1e-5), ("windy-passage", windy, 4e-6, 2e-3)],
)
def test_flights_side_by_side_are_those_flown_alone(
    name: str, change: Any, close: float, force: float
):
    """Places, forces, references and extremes agree to what the tolerances of both leave open."""
    missions = varied(name, change)
    for one, other in zip(simulate_together(missions), alone(missions), strict=True):
        assert off(one, other) < close
        for field in ("thrust", "constraint_force", "slot_position"):
            np.testing.assert_allclose(getattr(one, field), getattr(other, field), atol=force)
        found, expected = assess(one), assess(other)
        assert found.passed == expected.passed
        for quantity, worst in expected.worst.items():
            assert found.worst[quantity].value == pytest.approx(worst.value, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "change", "close"), [("narrow-passage", folding, 1e-7), ("windy-passage", windy, 3e-6)]
)
def test_they_are_near_the_true_flight(name: str, change: Any, close: float):
    """Of a flight at the tightest tolerances, at samples within steps, too."""

    def tight(data: dict[str, Any], k: int) -> None:
        change(data, k)
        data["integrator"] = {"rtol": 1e-12, "atol": 1e-12}

    found = simulate_together(varied(name, change))
    for k in (0, 7):
        assert off(found[k], simulate(varied(name, tight)[k])) < close


def test_a_group_that_is_not_full_flies_the_same():
    """Lanes that are left over change nothing of the others: they repeat the last flight."""
    missions = varied("narrow-passage", folding, 3)
    three, padded = simulate_together(missions), simulate_together(missions + missions[-1:] * 5)
    for one, other in zip(three, padded, strict=False):
        np.testing.assert_array_equal(one.position, other.position)


def settles(data: dict[str, Any], k: int) -> None:
    """The first phase ends when it has settled: at another time in each flight."""
    folding(data, k)
    data["phases"] = data["phases"][:1]
    del data["phases"][0]["until"]
    data["phases"][0]["settle"] = {"tolerance": 0.01, "dwell": 0.5, "timeout": 60.0}


def by_body(data: dict[str, Any], k: int) -> None:
    """The first phase by distances alone, the second ruled by the virtual body."""
    folding(data, k)
    data["phases"] = data["phases"][:2]
    data["architecture"] = "body"


def loses(data: dict[str, Any], k: int) -> None:
    """A vehicle is lost on the way."""
    folding(data, k)
    data["phases"] = data["phases"][:2]
    data["losses"] = [{"agent": 2, "time": 8.0}]


def test_phases_that_fit_no_vector_are_flown_alone():
    """Those that settle, or are ruled by the body: bit for bit as alone, the others of the flight side by side."""
    missions = varied("narrow-passage", settles)
    for one, other in zip(simulate_together(missions), alone(missions), strict=True):
        np.testing.assert_array_equal(one.position, other.position)
    missions = varied("narrow-passage", by_body)
    for one, other in zip(simulate_together(missions), alone(missions), strict=True):
        assert one.complete
        assert 0.0 < off(one, other) < 1e-6


def test_missions_of_other_kinds_are_flown_as_alone():
    """Quadrotors, and missions of different lengths, graphs or sampling."""
    short = load_mission("narrow-passage").to_dict()
    short["phases"] = short["phases"][:1]
    coarse = short | {"output_step": 0.1}
    for one, other in zip(
        simulate_together([Mission.from_dict(short), Mission.from_dict(coarse)]),
        alone([Mission.from_dict(short), Mission.from_dict(coarse)]),
        strict=True,
    ):
        np.testing.assert_array_equal(one.position, other.position)
    different = [load_mission("two-agents"), load_mission("square")]
    for one, other in zip(simulate_together(different), alone(different), strict=True):
        np.testing.assert_array_equal(one.position, other.position)


def test_many_vehicles_are_flown_one_by_one(monkeypatch):
    """No code is generated for more vehicles than it is worth, and each flies bit for bit as alone."""
    n = MOST_VEHICLES + 1
    data = {
        "schema_version": 1, "name": "row", "output_step": 0.5,
        "agents": {"mass": 1.0, "position": [[2.0 * i, 0.0, 1.0] for i in range(n)]},
        "formations": {"row": {"slots": [[2.0 * i, 0.0, 0.0] for i in range(n)], "edges": []}},
        "phases": [{"kind": "establish", "formation": "row", "control": "tracking", "blend": 1.0, "duration": 2.0}],
    }  # fmt: skip
    missions = [
        Mission.from_dict(data | {"disturbances": {"wind": [by, 0.0, 0.0]}}) for by in (0.0, 1.0)
    ]
    monkeypatch.setattr(batch, "Vector", lambda _: pytest.fail("code is generated"))
    for one, other in zip(simulate_together(missions), alone(missions), strict=True):
        np.testing.assert_array_equal(one.position, other.position)


def test_a_flight_that_fails_takes_nobody_along():
    """Where the law is singular for one, all are flown alone, bit for bit."""
    missions = [load_mission("line-singular")] + [
        Mission.from_dict(
            load_mission("line-singular").to_dict()
            | {"constraint": {"solver": "exact", "alpha": 0.5 + 0.01 * k}}
        )
        for k in range(3)
    ]
    found, expected = simulate_together(missions), alone(missions)
    assert not expected[0].complete
    for one, other in zip(found, expected, strict=True):
        assert one.ending == other.ending
        np.testing.assert_array_equal(one.position, other.position)


# -- the code ----------------------------------------------------------------------------------------


@numba.njit(error_model="numpy")
def call(p, y, dy, t):
    """dy/dt and forces by straight-line code, of eight states."""
    codegen._closed_loop(t, y, dy, p, None)


def kernel(p: Problem, y: np.ndarray, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Derivative and gauge by the compiled kernel of single flights."""
    n, m = len(p.vehicles.m), len(p.graph.edges)
    w, dy, values = workspace(n, m, solver=p.law.solver), np.empty_like(y), np.empty(5 * n + 2 * m)
    native.closed_loop(t, y, dy, p, w)
    write_watched_forces(p, w, values)
    return dy, values


@pytest.mark.parametrize(
    ("name", "phase"),
    [
        ("windy-passage", 0),
        ("windy-passage", 2),
        ("narrow-passage", 6),
        ("cube-passage", 2),
        ("cube-passage", 6),
    ],
)
def test_the_code_of_eight_problems_is_the_kernel(name: str, phase: int):
    """Derivatives and forces of random states: tracked slots that move, turn and blend, in noise, gusts and drag."""

    def change(data: dict[str, Any], k: int) -> None:
        random = np.random.default_rng(k)
        data["agents"]["mass"] = random.uniform(0.8, 1.2, len(data["agents"]["position"])).tolist()
        for kind in ("gusts", "noise"):
            if "disturbances" in data:
                data["disturbances"][kind]["seed"] = k

    plans = []
    for mission in varied(name, change):
        flight = Flight(mission)
        for _ in range(phase):
            flight.begin()
            flight.advance()
        flight.begin()
        plans.append((flight.plan, flight.plan.initial_state()))
    problems = [plan.problem for plan, _ in plans]
    assert batch.can_unroll_together(problems)
    begin, end = plans[0][0].start, plans[0][0].t_end
    ready = codegen.unrolled_together(
        problems, codegen.gust_and_noise_tables([p.disturbance for p in problems])
    )
    random = np.random.default_rng(0)
    middle = 0.7 * begin + 0.3 * end
    # The last stage of a step is at the moment of the one before.
    for t, stage in ((begin, 0), (middle, 0), (middle, lane_steps.STAGES - 1), (end, 0)):
        ready.stage[0] = stage
        y = np.array([state + 0.1 * random.normal(size=state.size) for _, state in plans])
        dy = pack_lanes(np.zeros_like(y.T))
        call(ready, pack_lanes(y.T), dy, t)
        n = len(problems[0].vehicles.m)
        for lane, p in enumerate(problems):
            expected, forces = kernel(p, y[lane], t)
            np.testing.assert_allclose(
                unpack_lanes(dy)[3 * n :, lane], expected[3 * n :], rtol=1e-9, atol=1e-9
            )
            np.testing.assert_allclose(
                unpack_lanes(ready.gauge)[:, lane], forces, rtol=1e-9, atol=1e-9
            )


def test_problems_that_branch_differently_share_no_code():
    """Deformation damping of some flights alone is a branch of the law."""
    missions = varied("narrow-passage", folding, 8)
    problems = []
    for k, mission in enumerate(missions):
        flight = Flight(mission)
        flight.begin()
        p = flight.plan.problem
        problems.append(p._replace(law=p.law._replace(k_def=0.0)) if k == 3 else p)
    assert batch.can_unroll_together(problems)
    with pytest.raises(UnfitError):
        codegen.unrolled_together(problems, {})


def test_arrays_of_eight_flights_become_lanes():
    """Lane k holds the numbers of array k."""
    parts = [np.arange(6.0).reshape(2, 3) + 10 * k for k in range(8)]
    made = codegen.packed(parts)
    for k, part in enumerate(parts):
        np.testing.assert_array_equal(unpack_lanes(made)[..., k], part)
    assert empty_lanes((3, 2)).ctypes.data % 64 == 0


def test_each_flight_side_by_side_has_its_own_trail(monkeypatch):
    """The steps of a trail join, and end where its flight is when it flies alone, in wind and noise."""
    missions = varied("windy-passage", windy)
    ends: dict[int, list[np.ndarray]] = {}
    take = Extremes.search_trail_for_extremes

    def kept(self: Extremes, problem: Any, work: Any, state: Any, *, last: bool) -> None:
        rows = (state.count[FIRST_ROW] + np.arange(state.count[TRAILED])) % len(state.trail.clock)
        clock, points = state.trail.clock[rows], state.trail.points[rows]
        if len(rows):
            np.testing.assert_allclose(clock[1:, 0], clock[:-1].sum(axis=1), atol=1e-12)
            np.testing.assert_array_equal(points[1:, 0], points[:-1, 4])
            here = np.column_stack([clock.sum(axis=1), points[:, 4, :9]])
            ends.setdefault(id(self), []).append(here)
        take(self, problem, work, state, last=last)

    monkeypatch.setattr(Extremes, "search_trail_for_extremes", kept)
    simulate_together(missions)
    monkeypatch.undo()
    assert len(ends) == 8
    for rows, mission in zip(ends.values(), missions, strict=True):
        whole = np.concatenate(rows)
        t, r = whole[:, 0], whole[:, 1:]
        flown = simulate(mission, times=np.unique(t))
        where = np.searchsorted(flown.time, t - 1e-12).clip(max=len(flown.time) - 1)
        assert len(t) > 500
        np.testing.assert_allclose(r, flown.position[where].reshape(-1, 9), atol=4e-6)


def test_components_that_do_not_move_are_left_out():
    """A flight straight on needs fewer operations than one that turns, and a shape at rest fewer than a reshaping."""
    flight = Flight(load_mission("windy-passage"))
    sizes = []
    for _ in range(9):
        flight.begin()
        p = flight.plan.problem
        values = varying_numbers([p])
        moves = np.abs(p.motion.coefficients).max(axis=(0, 2)) > 0.0
        sizes.append(len(Code(FlightTrace(p, values, moves.tolist())).moment))
        flight.advance()
    establish, straight, turning, *_ = sizes
    fold = sizes[6]
    assert straight < establish < fold
    assert straight < 0.6 * turning < 0.6 * fold
