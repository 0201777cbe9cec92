"""Extremes in continuous time, against the same steps and continuous extension sampled finely."""

import ctypes
import math
import threading
import time
from typing import Any

import numpy as np
import pytest

from rigidfleet.assessment import assess
from rigidfleet.errors import FlightError
from rigidfleet.kernel.engine import native
from rigidfleet.kernel.records import FIRST_ROW, STAYED, TRAILED, bernstein_basis
from rigidfleet.math import attitude as att
from rigidfleet.math import proximity
from rigidfleet.math.proximity import headroom, obstacle_clearances
from rigidfleet.mission import Mission, load_mission
from rigidfleet.result import Extremum, Result
from rigidfleet.simulation import extremes as watching
from rigidfleet.simulation.flight import Flight, FlightInterrupted, simulate

CLOSE = 1e-6


class Steps:
    """Every step of a flight, written down as the integrator leaves it; evaluated by interpolation."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.rows: list[tuple[float, float, np.ndarray]] = []
        take = watching.Extremes.search_trail_for_extremes

        def spy(extremes: Any, problem: Any, work: Any, state: Any, *, last: bool) -> None:
            seen = int(extremes.monitor.monitor.count[STAYED])
            for step in range(seen, int(state.count[TRAILED])):
                row = (state.count[FIRST_ROW] + step) % len(state.trail.clock)
                t, h = state.trail.clock[row]
                self.rows.append((t, h, state.trail.points[row].copy()))
            take(extremes, problem, work, state, last=last)

        monkeypatch.setattr(watching.Extremes, "search_trail_for_extremes", spy)

    def positions(self, n: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        """Times (K,) and positions (K, N, 3) of agents in all steps; of the inertial formulation."""
        times, places = [], []
        for t, h, points in self.rows:
            x = np.linspace(0.0, 1.0, max(2, math.ceil(h / spacing) + 1))
            basis = np.stack([math.comb(4, k) * x**k * (1 - x) ** (4 - k) for k in range(5)], 1)
            times.append(t + h * x)
            places.append((basis @ points[:, : 3 * n]).reshape(len(x), n, 3))
        return np.concatenate(times), np.concatenate(places)


def a_flight(rng: np.random.Generator) -> dict[str, Any]:
    """Vehicles that fly through each other, past each other, into walls and to the ground, or nearly."""
    n, speed = int(rng.integers(2, 5)), 10.0 ** rng.uniform(-0.5, 1.5)
    target = rng.uniform(-3, 3, (n, 3)) * 10.0 ** rng.uniform(-2, 0) + [0, 0, 10]
    direction = rng.standard_normal((n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    meet = rng.uniform(0.1, 0.7)
    velocity = speed * direction
    force = rng.uniform(-4, 4, 3)
    if rng.random() < 0.3:
        force = np.zeros(3)
    position = target - meet * velocity - 0.5 * meet**2 * force
    low = rng.uniform(-2, 1, 3) + [0, 0, 10]
    return {
        "schema_version": 1,
        "name": "random",
        "agents": {
            "mass": 1.0,
            "radius": float(rng.uniform(0.05, 0.4)),
            "position": position.tolist(),
            "velocity": velocity.tolist(),
        },
        "obstacles": [
            {"kind": "box", "name": "wall", "min": low.tolist(), "max": (low + rng.uniform(0.05, 2, 3)).tolist()},
            {"kind": "ground", "height": float(rng.uniform(4, 8))},
        ],
        "limits": {
            "geofence": {"min": [-20.0, -20.0, 0.0], "max": [20.0, 20.0, 20.0]},
            "separation_below": 0.1,
        },
        "phases": [{"kind": "hold", "control": "open", "until": 0.8, "input_force": force.tolist()}],
        "integrator": {"rtol": float(10.0 ** rng.uniform(-9, -3))},
        "output_step": float(rng.choice([0.05, 0.5])),
    }  # fmt: skip


def sampled(mission: Mission, r: np.ndarray) -> dict[str, np.ndarray]:
    """Each distance (K,) at positions (K, N, 3), as `Extremum.value` counts them."""
    radius = np.array(mission.agents.radius)
    i, j = np.triu_indices(len(radius), 1)
    apart = np.linalg.norm(r[:, i] - r[:, j], axis=2) - radius[i] - radius[j]
    fence = mission.limits.geofence
    assert fence is not None
    beyond = np.maximum(np.array(fence.min) - r, r - np.array(fence.max))
    return {
        "separation": apart.min(axis=1),
        "clearance": obstacle_clearances(r, radius, mission.obstacles)[0].min(axis=1),
        "separation_below": headroom(r, radius)[0],
        "geofence": -beyond.max(axis=(1, 2)),
        "lowest": r[..., 2].min(axis=1),
        "highest": -r[..., 2].max(axis=1),
    }


def agrees(mission: Mission, result: Result, steps: Steps, spacing: float) -> int:
    """Assert that extremes are those of finely sampled steps; how many flights of these two touch something."""
    times, r = steps.positions(result.n_agents, spacing)
    (phase,) = result.phases
    samples = sampled(mission, r)
    for name, values in samples.items():
        k = int(values.argmin())
        sign = -1.0 if name in ("geofence", "highest") else 1.0
        if not np.isfinite(values[k]):
            # Nobody is below another at any sample: at most for less than a sample.
            assert name == "separation_below"
            continue
        x = phase.extremes[name]
        least = sign * x.value
        # No sample is worse; and what is said to be reached is reached close to where it is said to be.
        assert least <= values[k] + CLOSE, (name, x, values[k], times[k])
        if name == "separation_below":
            continue  # it jumps where an overlap begins: judged by the others of this test
        near = np.abs(times - x.time) <= 2.0 * spacing
        rate = np.abs(np.diff(values)).max() if len(values) > 1 else 0.0
        assert least >= values[near].min() - rate - CLOSE, (name, x, values[near].min())
    verdict = assess(result)
    failed = {f.check for f in verdict.checks if not f.passed}
    touched = 0
    for name in ("separation", "clearance"):
        least = samples[name].min()
        if abs(least) > CLOSE:
            assert (name in failed) == (least < 0), (name, least, verdict.summary)
            touched += least < 0
    return touched


def touches(monkeypatch: pytest.MonkeyPatch, seed: int, count: int, spacing: float) -> int:
    """How many things are touched in random flights, each of which agrees with its fine samples."""
    rng, touched = np.random.default_rng(seed), 0
    for _ in range(count):
        mission = Mission.from_dict(a_flight(rng))
        with monkeypatch.context() as patch:
            steps = Steps(patch)
            result = simulate(mission)
        touched += agrees(mission, result, steps, spacing)
    return touched


def test_random_flights_are_judged_by_what_happens_between_samples(monkeypatch):
    """Of random flights that touch or graze, none passes that touches, and none fails that does not."""
    assert 20 < touches(monkeypatch, 1, 60, 1e-4) < 100


@pytest.mark.long
def test_two_thousand_random_flights_are_judged_by_what_happens_between_samples(monkeypatch):
    """As above, 2,000 of them, against samples every 1e-5 s."""
    assert 700 < touches(monkeypatch, 2, 2000, 1e-5) < 3500


# -- forces, large fleets, formulations


def forces(result: Result) -> dict[str, float]:
    """Greatest forces, speeds and constraint errors at samples."""
    length = np.linalg.norm
    return {
        "thrust": result.thrust.max(),
        "speed": length(result.velocity, axis=2).max(),
        "acceleration": length(result.acceleration, axis=2).max(),
        "constraint_force": length(result.constraint_force, axis=2).max(),
        "tension": np.nanmax(np.abs(result.multiplier)),
        "constraint": np.nanmax(np.abs(result.constraint)),
    }


def greatest(result: Result, name: str) -> float:
    return max(abs(p.extremes[name].value) for p in result.phases if name in p.extremes)


def changed(name: str, **changes: Any) -> Mission:
    data = load_mission(name).to_dict()
    for key, value in changes.items():
        data[key] = data.get(key, {}) | value if isinstance(value, dict) else value
    return Mission.from_dict(data)


def test_forces_between_samples_are_found():
    """What gusts and noise make of forces is told to 1e-5 of it, whatever is recorded."""
    mission = changed("windy-passage", output_step=0.5)
    result, fine = simulate(mission), forces(simulate(changed("windy-passage", output_step=0.002)))
    assert forces(result)["thrust"] < 0.99 * fine["thrust"]
    for name, value in fine.items():
        every = [p.extremes[name] for p in result.phases if name in p.extremes]
        x = max(every, key=lambda x: abs(x.value))
        assert abs(x.value) >= value * (1.0 - 1e-9)
        near = simulate(mission, times=x.time + np.linspace(-5e-3, 5e-3, 2001))
        assert forces(near)[name] == pytest.approx(abs(x.value), rel=1e-5)


def test_constraint_forces_next_to_nothing_are_not_searched(monkeypatch):
    """Where a formation keeps its distances, few calls of the law tell them to 1e-9 of the thrust and 1e-9 m."""
    calls: list[int] = []
    word, record = ctypes.c_int64, native.library().record

    def counted(*words: int) -> int:
        calls.append(1)
        return record(*words)

    entry = ctypes.CFUNCTYPE(word, *(word,) * 4)(counted)
    address = ctypes.cast(entry, ctypes.c_void_p).value
    monkeypatch.setattr(native, "recorder_address", lambda: address)
    result = simulate(changed("narrow-passage", output_step=0.002))
    assert len(calls) < 5 * len(result.phases)
    quiet = 0
    for phase in result.phases:
        inside = (result.time > phase.t_start) & (result.time < phase.t_end)
        fine = {
            "constraint_force": np.linalg.norm(result.constraint_force[inside], axis=2).max(),
            "tension": np.abs(result.multiplier[inside]).max(),
            "constraint": np.abs(result.constraint[inside]).max(),
        }
        thrust = phase.extremes["thrust"].value
        for name, value in fine.items():
            slack = 1e-5 * value + (1e-9 if name == "constraint" else 1e-9 * thrust)
            assert abs(phase.extremes[name].value) >= value - slack
        quiet += fine["tension"] < 1e-7
    assert quiet > 8


def test_small_forces_on_long_steps_are_found():
    """Where a long step's parabola promises less than the force rises, its peak is still told to 1e-9 of the thrust."""
    phases = [
        {
            "kind": "establish",
            "formation": "pair",
            "until": 0.54,
            "blend": 0.216,
            "control": "tracking",
        }
    ]
    mission = Mission.from_dict(
        {
            "schema_version": 1,
            "name": "pair",
            "agents": {
                "mass": [0.56, 0.88],
                "position": [[1.36, -1.4, 11.83], [-4.33, 2.43, 12.8]],
            },
            "formations": {"pair": {"slots": [[-2.44, 1.89, 3.72], [1.11, 0.91, 2.45]]}},
            "phases": phases,
            "constraint": {"deformation_damping": 0.0},
        }
    )
    extremes = simulate(mission).phases[0].extremes
    fine = np.abs(simulate(mission, times=np.linspace(0.0, 0.54, 5000)[:-1]).multiplier).max()
    assert fine < 1e-5
    assert abs(extremes["tension"].value) >= fine - 1e-9 * extremes["thrust"].value


@pytest.mark.parametrize("step", [0.05, 1.0])
def test_a_thrust_limit_is_held_between_samples(step):
    """A limit between the greatest thrust and that of the samples is passed."""
    mission = changed("windy-passage", output_step=step, agents={"thrust_limit": 11.8})
    result = simulate(mission)
    assert result.thrust.max() < 11.8
    verdict = assess(result)
    assert {f.check for f in verdict.checks if not f.passed} == {"thrust"}
    assert verdict.worst["thrust"].value == pytest.approx(11.92, abs=0.01)


def a_crowd(formulation: str) -> Mission:
    """Vehicles that cross each other's ways, with nothing that holds them together; and a turn."""
    rng = np.random.default_rng(5)
    n = 60
    start = rng.uniform(-6, 6, (n, 3)) + [0, 0, 30]
    slots = rng.permutation(
        np.stack(np.meshgrid([0, 2, 4, 6], [0, 2, 4], range(0, 10, 2)), -1).reshape(-1, 3)
    )
    return Mission.from_dict(
        {
            "schema_version": 1,
            "name": "crowd",
            "formulation": formulation,
            "agents": {"mass": 1.0, "radius": 0.05, "position": start.tolist()},
            "formations": {"grid": {"slots": slots.tolist(), "edges": []}},
            "obstacles": [{"kind": "box", "min": [8, -1, 20], "max": [9, 1, 40]}],
            "limits": {"separation_below": 0.2},
            "phases": [
                {"kind": "establish", "formation": "grid", "duration": 4.0, "control": "tracking"},
                {"kind": "turn", "roll_deg": 40.0, "pitch_deg": 20.0, "yaw_deg": 90.0, "duration": 3.0},
            ],
            "output_step": 0.5,
        }
    )  # fmt: skip


@pytest.mark.parametrize("formulation", ["inertial", "body"])
def test_pairs_of_a_large_fleet_that_are_not_listed_are_not_the_nearest(formulation, monkeypatch):
    """Watching the pairs near each other finds what watching all of them does, and what fine samples show."""
    mission = a_crowd(formulation)
    some = simulate(mission)
    monkeypatch.setattr(watching, "_FEW", 1000)
    every = simulate(Mission.from_dict(mission.to_dict()))  # another mission, prepared anew
    fine = simulate(Mission.from_dict(mission.to_dict() | {"output_step": 0.002}))
    for a, b in zip(some.phases, every.phases, strict=True):
        assert a.extremes.keys() == b.extremes.keys()
        for name, x in a.extremes.items():
            assert x.value == pytest.approx(b.extremes[name].value, abs=1e-8), name
    worst = assess(fine).worst
    for name in ("separation", "clearance", "speed"):
        found = assess(some).worst[name]
        assert found.value == pytest.approx(worst[name].value, abs=1e-8)
        assert found.when == pytest.approx(worst[name].when, abs=2e-3)
    below = proximity.headroom(fine.position, mission.agents.radius)[0].min()
    stacks = [p.extremes.get("separation_below") for p in some.phases]
    least = min(x.value for x in stacks if x is not None)
    assert below - 0.02 < least < below + CLOSE


@pytest.mark.parametrize("formulation", ["inertial", "body"])
def test_agents_that_are_passed_over_are_neither_highest_nor_lowest_nor_fastest(formulation):
    """Where nothing else needs the way of each agent, few are looked at; the extremes are those of fine samples."""
    data = a_crowd(formulation).to_dict()
    del data["obstacles"], data["limits"]
    found = simulate(Mission.from_dict(data)).phases
    fine = simulate(Mission.from_dict(data | {"output_step": 0.002}))
    for k, phase in enumerate(found):
        here = fine.phase == k
        r, v = fine.position[here], fine.velocity[here]
        values = r[..., 2].min(), r[..., 2].max(), np.linalg.norm(v, axis=2).max()
        for name, value in zip(("lowest", "highest", "speed"), values, strict=True):
            assert phase.extremes[name].value == pytest.approx(value, abs=2e-5), name


@pytest.mark.parametrize("formulation", ["inertial", "body"])
def test_no_distance_changes_more_than_its_bound(formulation, monkeypatch):
    """In space and as seen from above, at nine points of each step; what turns as one body has small bounds."""
    call, found, mission = (
        watching.native.Watch.write_first_step_change_bounds,
        [],
        a_crowd(formulation),
    )
    n = mission.n_agents
    i, j = np.triu_indices(n, 1)
    basis = bernstein_basis(np.linspace(0.0, 1.0, 9))

    def spy(watch: Any, problem: Any, state: Any) -> None:
        call(watch, problem, state)
        y = basis @ state.trail.points[0]
        x = y[:, : 3 * n].reshape(9, n, 3)
        if formulation == "body":
            q = y[:, 6 * n : 6 * n + 4]
            x = x @ att.dcm_from_quaternion(q / np.linalg.norm(q, axis=1, keepdims=True))
        apart = x[:, i] - x[:, j]
        lengths = [np.linalg.norm(apart[..., :axes], axis=2) for axes in (3, 2)]
        changes = [np.abs(d - d[0]).max() for d in lengths]
        way = np.linalg.norm(x[-1] - x[0], axis=1).max()
        found.append((*changes, *watch.monitor.moves, way, state.trail.clock[0, 0]))

    monkeypatch.setattr(watching.native.Watch, "write_first_step_change_bounds", spy)
    simulate(mission)
    space, above, bound, bound_above, way, t = np.array(found).T
    assert (space <= bound + 1e-9).all()
    assert (above <= bound_above + 1e-9).all()
    turns = (t > 5.0) & (t < 6.0)
    assert (bound[turns] < 0.1 * way[turns]).all(), (bound[turns] / way[turns]).max()


@pytest.mark.parametrize("name", ["cube-waypoint", "narrow-passage"])
def test_both_formulations_come_to_the_same(name):
    """Positions as polynomials in world and in body axes have the same extremes."""
    a, b = (simulate(changed(name, formulation=f)) for f in ("inertial", "body"))
    for p, q in zip(a.phases, b.phases, strict=True):
        for key in ("separation", "clearance", "lowest", "highest", "speed", "thrust"):
            if key in p.extremes:
                assert p.extremes[key].value == pytest.approx(q.extremes[key].value, abs=1e-6), key


def test_extremes_do_not_depend_on_what_is_recorded():
    """Times to record and output steps change no extreme by a bit."""
    found = [
        [p.extremes for p in simulate(mission, times=times).phases]
        for mission, times in (
            (load_mission("cube-waypoint"), None),
            (changed("cube-waypoint", output_step=3.0), None),
            (load_mission("cube-waypoint"), [0.0, 1.0]),
        )
    ]
    assert found[0] == found[1] == found[2]


def two(**tables: Any) -> Mission:
    """The shortest flight that collides: two vehicles meet at 30 m/s, 0.1 m apart."""
    agents = {
        "mass": 1.0, "radius": 0.25, "position": [[-15.375, 0, 10], [15.375, 0.1, 10]],
        "velocity": [[15, 0, 0], [-15, 0, 0]],
    }  # fmt: skip
    agents |= tables.pop("agents", {})
    hold = {"kind": "hold", "control": "open", "until": 3.0}
    data = {"schema_version": 1, "name": "meet", "agents": agents, "phases": [hold]}
    return Mission.from_dict(data | tables)


def test_two_that_meet_between_samples_collide():
    """The closed form of two that fly straight past each other: 0.1 m between centres at 1.025 s."""
    result = simulate(two())
    x = result.phases[0].extremes["separation"]
    assert x.value == pytest.approx(-0.4, abs=1e-8)
    assert x.time == pytest.approx(15.375 / 15, abs=1e-5)
    assert result.separation.min() == x.value
    assert not assess(result).passed


def test_a_flight_that_is_interrupted_or_fails_is_watched_to_its_end():
    """What has flown before a flight ends is judged like any other."""

    def buzz(t: float, r: Any, v: Any) -> Any:
        return np.full_like(r, 1e-3 * math.sin(1e3 * t) if t < 1.5 else math.nan)

    def stop(t: float, r: Any, v: Any) -> Any:
        if t > 1.2:
            raise KeyboardInterrupt
        return buzz(t, r, v)

    mission = two(integrator={"rtol": 1e-12, "atol": 1e-14})
    with pytest.raises(FlightError) as failed:
        simulate(mission, force=buzz)
    assert failed.value.result is not None
    x = failed.value.result.phases[0].extremes["separation"]
    assert x.value == pytest.approx(-0.4, abs=1e-4)
    with pytest.raises(FlightInterrupted) as caught:
        simulate(mission, force=stop)
    assert caught.value.result.phases[0].extremes["separation"] == x
    singular = simulate(load_mission("line-singular"))
    assert not singular.complete
    assert greatest(singular, "tension") >= forces(singular)["tension"]


def test_a_controller_and_saturation_are_watched():
    """Steps between the instants of a user's controller count, and thrust as it is cut off."""
    mission = changed("single-waypoint", agents={"thrust_limit": 10.2, "saturate": True})
    result = simulate(
        mission, controller=lambda o: 1.1 * o.masses[:, None] * [0.0, 0.0, o.gravity], rate=5.0
    )
    assert greatest(result, "thrust") == pytest.approx(10.2, abs=1e-9)
    assert greatest(result, "speed") >= forces(result)["speed"] - 1e-9


# -- formations whose multipliers are iterated


def a_sphere(solver: str = "iterated", **tables: Any) -> Mission:
    """A grid of 150 becomes a sphere held by distances of neighbours, and turns."""
    position = {"shape": "grid", "size": 2.0, "count": 150, "centre": [0.0, 0.0, 30.0]}
    return Mission.from_dict(
        {
            "schema_version": 1,
            "name": "sphere",
            "agents": {"mass": 0.3, "radius": 0.1, "position": position},
            "assignment": "each",
            "integrator": {"rtol": 1e-6, "atol": 1e-6},
            "constraint": {"solver": solver},
            "formations": {"sphere": {"shape": "sphere", "size": 2.0, "edges": "neighbours"}},
            "phases": [
                {"kind": "establish", "formation": "sphere", "blend": 3.0, "duration": 3.5},
                {"kind": "turn", "yaw_deg": 60.0, "duration": 1.0},
            ],
            "output_step": 0.5,
        }
        | tables
    )


@pytest.mark.parametrize("solver", ["iterated", "exact"])
def test_forces_of_a_large_formation_are_found_between_steps(solver):
    """As fine samples about each greatest force tell it, to 1e-5, or 1e-6 of the thrust."""
    mission = a_sphere(solver)
    result = simulate(mission)
    (method,) = result.statistics["solvers"]
    assert method == "sparse"
    first = result.phases[0].extremes
    for name in ("thrust", "acceleration", "constraint_force", "tension"):
        x, wide = first[name], np.linspace(-0.1, 0.1, 101)
        fine = forces(simulate(mission, times=x.time + wide * 1e-2))[name]
        around = forces(simulate(mission, times=x.time + wide))[name]
        slack = 1e-5 * fine + 1e-6 * first["thrust"].value
        assert abs(x.value) == pytest.approx(fine, abs=slack), name
        assert abs(x.value) >= around - slack, name


@pytest.mark.parametrize("form", ["inertial", "body"])
def test_to_watch_a_large_formation_does_not_change_its_flight(form, monkeypatch):
    """Positions and forces at samples are bit for bit those of a flight that nobody watches."""
    mission = a_sphere(formulation=form)
    watched = simulate(mission)
    assert watched.phases[0].extremes

    def pass_over(extremes: Any, problem: Any, work: Any, state: Any, *, last: bool) -> None:
        state.count[TRAILED] = 0

    monkeypatch.setattr(watching.Extremes, "search_trail_for_extremes", pass_over)
    alone = simulate(mission)
    assert not alone.phases[0].extremes
    assert (watched.position == alone.position).all()
    assert (watched.thrust == alone.thrust).all()
    assert watched.statistics["solvers"] == alone.statistics["solvers"]


def test_extremes_of_a_large_formation_depend_on_no_pause_and_no_sample(monkeypatch):
    """Whether the integrator pauses after each step or hardly ever, and whatever is recorded: the same to the bit."""
    every = [simulate(a_sphere()), simulate(a_sphere(), times=[0.0, 1.0])]
    for name in ("_FIRST_STEPS", "_FIRST_NUMBERS", "_STEPS"):
        monkeypatch.setattr(f"rigidfleet.simulation.point_propagator.{name}", 1)
    every.append(simulate(a_sphere()))
    found = [[p.extremes for p in result.phases] for result in every]
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize("solver", ["iterated", "exact"])
def test_who_watches_a_large_formation_does_not_change_what_is_found(solver, monkeypatch):
    """Another thread, while the flight goes on, or this one, while it waits: the same to the bit."""
    mission = a_sphere(solver)
    threads, take = set(), watching.Extremes.search_trail_for_extremes

    def spy(*given: Any, **options: Any) -> None:
        threads.add(threading.get_ident())
        take(*given, **options)

    def flown() -> Result:
        """With looks at what was found so far, after which the same trail goes on."""
        flight = Flight(mission)
        while flight.begin():
            while flight.advance(0.7):
                flight.deepest_contact()
        return flight.finish()

    monkeypatch.setattr(watching.Extremes, "search_trail_for_extremes", spy)
    aside, looked = simulate(mission), flown()
    assert len(threads) > 1, "each phase's last steps are taken here"

    def take_here(extremes: Any, problem: Any, work: Any, state: Any) -> None:
        extremes.search_trail_for_extremes(problem, work, state, last=False)

    monkeypatch.setattr(watching.Extremes, "send_steps", take_here)
    for one, other in ((aside, simulate(mission)), (looked, flown())):
        assert [p.extremes for p in one.phases] == [p.extremes for p in other.phases]
        assert (one.position == other.position).all()


def test_no_step_is_overwritten_before_it_has_been_watched(monkeypatch):
    """Where the other thread is slow and the flight stops often, to the bit what is found while the flight waits."""
    mission, take = a_sphere(), watching.Extremes.search_trail_for_extremes
    here = threading.get_ident()

    def flown() -> list[Any]:
        flight = Flight(mission)
        while flight.begin():
            while flight.advance(0.03):
                pass
        return [phase.extremes for phase in flight.finish().phases]

    def take_slowly(*given: Any, **options: Any) -> None:
        if threading.get_ident() != here:
            time.sleep(0.02)
        take(*given, **options)

    def take_here(extremes: Any, problem: Any, work: Any, state: Any) -> None:
        extremes.search_trail_for_extremes(problem, work, state, last=False)

    monkeypatch.setattr(watching.Extremes, "search_trail_for_extremes", take_slowly)
    aside = flown()
    monkeypatch.setattr(watching.Extremes, "send_steps", take_here)
    assert aside == flown()


def test_what_goes_wrong_in_the_thread_that_watches_is_raised(monkeypatch):
    """An error ends the flight; Ctrl-C while it is waited for ends it with what was flown and found."""
    mission, take = a_sphere(), watching.Extremes.search_trail_for_extremes
    here = threading.get_ident()

    def fail(*given: Any, **options: Any) -> None:
        if threading.get_ident() != here:
            raise MemoryError("no more of it")
        take(*given, **options)

    with monkeypatch.context() as patch:
        patch.setattr(watching.Extremes, "search_trail_for_extremes", fail)
        with pytest.raises(MemoryError, match="no more of it"):
            simulate(mission)
    done, wait = [], watching.Extremes.wait_for_steps

    def interrupt(extremes: Any) -> None:
        if extremes._taking is not None and len(done) < 2:
            done.append(extremes)
            if len(done) == 2:
                raise KeyboardInterrupt
        wait(extremes)

    monkeypatch.setattr(watching.Extremes, "wait_for_steps", interrupt)
    with pytest.raises(FlightInterrupted) as stopped:
        simulate(mission)
    result = stopped.value.result
    assert 0.0 < result.phases[-1].t_end < mission.latest_end
    assert result.phases[-1].extremes["thrust"].time <= result.phases[-1].t_end


# -- what the verdict makes of them


def test_the_peak_of_unequal_limits_is_told_with_what_comes_nearest_to_one():
    """22 N of 30 N are the greatest thrust, 10.8 N of 11 N the nearest to a limit; both are said."""
    agents = {
        "mass": [2.2, 1.1], "thrust_limit": [30.0, 11.0], "velocity": [[0, 0, 0], [0, 0, 0]]
    }  # fmt: skip
    verdict = assess(simulate(two(agents=agents)))
    found = {f.check: f for f in verdict.checks}
    assert (found["thrust_peak"].worst, found["thrust_peak"].who) == (2.2 * 9.81, "agent 1")
    assert (found["thrust"].worst, found["thrust"].limit) == (pytest.approx(1.1 * 9.81), 11.0)
    assert verdict.worst["thrust"].value == 2.2 * 9.81
    assert (
        "thrust peaks at 21.6 N (agent 1), agent 2 comes nearest to its limit, at 10.8 N of 11 N"
        in verdict.summary
    )


def above_ground(path: list[float], **tables: Any) -> Any:
    """Verdict on one vehicle that is carried through heights [m] above the ground, a second each."""
    phases = [
        {"kind": "fly", "position": [0, 0, z + 0.25], "duration": 4.0} for z in path[1:]
    ]  # fmt: skip
    one = {"mass": 1.0, "radius": 0.25, "position": [[0, 0, path[0] + 0.25]]}
    data = {"schema_version": 1, "name": "hop", "agents": one, "phases": phases}
    ground = [{"kind": "ground", "height": 0.0}]
    return assess(simulate(Mission.from_dict(data | {"obstacles": ground} | tables)))


def test_what_a_flight_starts_and_lands_on_is_told_apart():
    """A vehicle that starts 5 cm above the ground and lands 3 cm above it was 1 m away in between."""
    verdict = above_ground([0.05, 2.0, 1.0, 2.0, 0.03])
    assert verdict.passed
    found = {f.check: f.worst for f in verdict.checks}
    assert found["clearance_start"] == pytest.approx(0.05, abs=1e-9)
    assert found["clearance_end"] == pytest.approx(0.03, abs=1e-3)
    assert 0.09 < found["clearance"] < 0.2  # where it comes off, and before it has landed
    assert "agents start 0.05 m above an obstacle" in verdict.summary


def test_contact_at_the_start_is_no_collision():
    """A vehicle that stands on the ground passes, not one that touches it on its way, nor one that ends below it."""
    assert above_ground([0.0, 2.0]).passed
    assert not above_ground([1.0, -0.05, 1.0]).passed
    assert not above_ground([1.0, -0.05]).passed
    assert not above_ground([-0.05, 1.0]).passed


@pytest.mark.parametrize(
    ("what", "words"),
    [
        (lambda r: r.separation.__setitem__(slice(None), 9.0), "separation"),
        (lambda r: r.distance.__iadd__(0.1), "distance"),
        (lambda r: r.thrust.__imul__(0.5), "thrust"),
        (lambda r: r.phases[0].extremes.update(speed=Extremum(0.0, 1.0, 0, -1)), "speed"),
        (lambda r: r.phases[0].extremes.update(separation=Extremum(9.0, 1.0, 0, 1)), "separation"),
    ],
)
def test_a_record_that_contradicts_its_own_samples_fails(what, words):
    """Whoever writes better values into a record than its positions and forces have does not pass."""
    result = simulate(load_mission("establish-triangle"))
    assert assess(result).passed
    what(result)
    verdict = assess(result)
    failed = [f for f in verdict.checks if not f.passed]
    assert [f.check for f in failed] == ["record"]
    assert words in failed[0].message


def test_positions_count_and_not_what_is_stored_beside_them():
    """Vehicles moved into each other collide, whatever separation the record states."""
    result = simulate(load_mission("establish-triangle"))
    result.position[50, 1] = result.position[50, 0]
    failed = {f.check for f in assess(result).checks if not f.passed}
    assert {"separation", "record"} <= failed


def test_extremes_are_kept_in_the_file(tmp_path):
    """A result that is saved and loaded has the same extremes, to the bit."""
    result = simulate(load_mission("establish-triangle"))
    result.save(tmp_path / "a.nc")
    again = Result.load(tmp_path / "a.nc")
    assert [p.extremes for p in again.phases] == [p.extremes for p in result.phases]
    assert again.phases[0].extremes


def test_a_record_without_extremes_says_so():
    """What is judged at samples alone is noted, with how far they are apart."""
    result = simulate(load_mission("establish-triangle"))
    assert assess(result).notes == []
    result.phases[1].extremes = {}
    (note,) = assess(result).notes
    assert "only samples are judged, up to 0.01 s apart" in note


# -- what was found wrong once


def held(agents: dict[str, Any], until: float, **tables: Any) -> Mission:
    """Vehicles that nothing holds together."""
    hold = [{"kind": "hold", "control": "open", "until": until}]
    data = {"schema_version": 1, "name": "held", "agents": agents, "phases": hold}
    return Mission.from_dict(data | tables)


@pytest.mark.parametrize("seed", range(4))
def test_a_large_fleet_that_converges_is_watched(seed):
    """Of vehicles that fly straight through one point, or nearly, the closed form is the least separation."""
    n, until = 45, 5.0
    rng = np.random.default_rng(seed)
    g = rng.normal(size=(n, 3))
    g *= 10 * rng.uniform(0.5, 1, (n, 1)) / np.linalg.norm(g, axis=1)[:, None]
    w = (0.5 * rng.normal(size=(n, 3)) - g) / (0.5 * until)
    i, j = np.triu_indices(n, 1)
    x, v = (g[i] - g[j]), (w[i] - w[j])
    t = np.clip(-(x * v).sum(axis=1) / (v * v).sum(axis=1), 0.0, until)
    least = np.linalg.norm(x + t[:, None] * v, axis=1)
    agents = {"mass": 1.0, "position": (g + [0, 0, 20]).tolist(), "velocity": w.tolist()}
    agents["radius"] = 0.0
    result = simulate(held(agents, until))
    k = int(least.argmin())
    found = result.extreme("separation")
    assert found is not None
    assert found.value == pytest.approx(least[k], abs=CLOSE)
    assert (found.who, found.other) == (i[k], j[k])
    assert found.time == pytest.approx(t[k], abs=1e-3)


def test_vehicles_at_one_place_cost_no_eternity():
    """Pairs a millionth of a metre apart do not cut a flight into millions of pieces; one left is alone."""
    rng = np.random.default_rng(0)
    pairs = np.repeat(rng.uniform(0, 10, (30, 3)), 2, axis=0) + [0, 0, 20]
    pairs[1::2, 0] += 2e-6
    velocity = np.repeat(rng.normal(size=(30, 3)), 2, axis=0)
    agents = {"mass": 1.0, "position": pairs.tolist(), "velocity": velocity.tolist()}
    agents["radius"] = 0.0
    lost = [{"agent": i + 1, "time": 1.0} for i in range(59)]
    result = simulate(held(agents, 2.0, disturbances={"lost": lost}))
    found = result.extreme("separation")
    assert found is not None
    assert found.value == pytest.approx(2e-6, abs=1e-8)


@pytest.mark.parametrize(("speed", "until", "off"), [(100.0, 100.0, 1e-3), (1000.0, 1000.0, 0.1)])
def test_long_fast_steps_know_a_short_distance(speed, until, off):
    """Two that come from a thousand kilometres away pass each other as near as the closed form says."""
    t = 0.6137 * until
    agents = {
        "mass": 1.0, "radius": 0.4 * off, "position": [[-speed * t, 0, 10], [speed * t, off, 10]],
        "velocity": [[speed, 0, 0], [-speed, 0, 0]],
    }  # fmt: skip
    result = simulate(held(agents, until, output_step=until / 7))
    found = result.extreme("separation")
    assert found is not None
    assert found.value == pytest.approx(0.2 * off, abs=CLOSE)
    assert not any(f.check == "record" for f in assess(result).checks)


def test_who_is_lost_behind_a_wall_has_flown_through_it():
    """A vehicle that passes a thin wall and is lost just behind it has not landed there."""
    agents = {
        "mass": 1.0, "position": [[0, 30, 5.25], [-20.2, 0, 10]], "velocity": [[0, 0, 0], [20, 0, 0]],
        "radius": [0.25, 0.05],
    }  # fmt: skip
    wall = {"kind": "box", "name": "wall", "min": [-0.005, -5, 0], "max": [0.005, 5, 20]}
    lost = {"lost": [{"agent": 2, "time": 1.0135}]}
    mission = held(agents, 2.0, obstacles=[{"kind": "ground"}, wall], disturbances=lost)
    failed = {f.check for f in assess(simulate(mission)).checks if not f.passed}
    assert failed == {"clearance"}


def test_times_that_begin_after_take_off_make_no_collision():
    """Who stood on the ground before the first sample has not hit it."""
    one = {"mass": 1.0, "position": [[0, 0, 0.25]], "radius": 0.25}
    mission = held(one, 4.0, obstacles=[{"kind": "ground"}])
    mission = Mission.from_dict(
        mission.to_dict()
        | {"phases": [mission.to_dict()["phases"][0] | {"input_force": [0, 0, 1.0]}]}
    )
    assert assess(simulate(mission, times=[1.0, 2.0, 3.0, 4.0])).passed


def test_a_pulse_between_steps_is_no_contradiction():
    """A user's force that the steps have not seen is in the samples, and the record holds."""
    agents = {"mass": 1.0, "position": [[0, 0, 5], [5, 0, 5]]}

    def pulse(t: float, r: Any, v: Any) -> Any:
        return np.ones_like(r) * 4 * np.exp(-(((t - 5) / 0.02) ** 2))

    assert assess(simulate(held(agents, 10.0), force=pulse)).passed


def test_an_extreme_that_is_taken_away_is_missed():
    """A record that tells only part of what happened between its samples contradicts itself."""
    result = simulate(two())
    del result.phases[0].extremes["separation"]
    failed = {f.check for f in assess(result).checks if not f.passed}
    assert failed == {"record"}


def test_a_list_of_pairs_ends_with_its_phase():
    """Who came near in one phase does not hide who comes near in the next."""
    rng = np.random.default_rng(3)
    grid = np.array([[10.0 * (i % 8), 10.0 * (i // 8), 10.0] for i in range(48)])
    near = np.array([[0, 0, 50], [0.6, 0, 50], [40, 0, 50], [45.65, 0, 50], [0, 40, 70]])
    velocity = np.zeros((53, 3))
    velocity[49, 0], velocity[51, 0] = -0.02, -0.1
    velocity += 1e-3 * rng.normal(size=velocity.shape)
    agents = {
        "mass": 1.0, "radius": 0.25, "position": np.vstack([grid, near]).tolist(),
        "velocity": velocity.tolist(),
    }  # fmt: skip
    phases = [
        {"kind": "hold", "control": "open", "duration": 2.0, "name": name} for name in ("a", "b")
    ]
    data = {"schema_version": 1, "name": "two", "agents": agents, "phases": phases}
    verdict = assess(simulate(Mission.from_dict(data)))
    assert not any(f.check == "record" for f in verdict.checks)


def test_distances_of_a_thousand_kilometres_cost_no_eternity():
    """Among lengths known to a micrometre the search ends there; the flight itself fails, and says why."""
    far = 5e7
    mission = Mission.from_dict({
        "schema_version": 1, "name": "far", "architecture": "body", "formulation": "body",
        "agents": {"mass": 1.0, "position": [
            [-12.0, -474467.8, 0.0], [0.0, far, far], [far, -far, -far],
            [24589534.9, -56608243.2, 0.0], [0.0, -far, 1.0], [0.0, 70110346.2, 1.0],
        ]},
        "constraint": {"solver": "iterated"},
        "formations": {"a": {"slots": [
            [1.96, 0.07, 0.0], [0.0, 1.28, 0.0], [1.28, -3.47, 0.0],
            [-0.39, 0.0, 0.0], [4.0, -2.0, -2.0], [0.0, -4.0, -4.0],
        ]}, "b": {"slots": [
            [1.96, 0.07, 0.0], [0.0, 1.28, 0.0], [1.28, -3.47, 0.0],
            [-0.39, 0.0, 0.0], [4.0, -2.0, -2.0], [0.0, -4.0, -4.0],
        ]}},
        "phases": [
            {"kind": "turn", "travel": 2e-6, "yaw_deg": 1e6, "pitch_deg": 0.0,
             "settle": {"tolerance": 4.0, "dwell": 0.1, "timeout": 2.0}},
            {"kind": "hold", "duration": 2.0},
        ],
    })  # fmt: skip
    begun = time.process_time()
    assert "step size has fallen" in simulate(mission).ending
    assert time.process_time() - begun < 60.0
