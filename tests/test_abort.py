"""Aborts: from every second of a flight there is a way home that is proved, or it is said why not."""

from __future__ import annotations

import itertools
import json
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rigidfleet as rf
from rigidfleet.cli.app import main
from rigidfleet.mission import Mission, load_mission
from rigidfleet.planning.abort import Aborts
from rigidfleet.planning.homing import WaysHome
from rigidfleet.planning.levels import altitude_levels
from rigidfleet.planning.plan_path import plan_path
from rigidfleet.planning.steps import Steps, tracking_allowance
from rigidfleet.planning.timing import complete_times, legs_up_to
from rigidfleet.preflight.aborts import check_aborts
from rigidfleet.simulation.together import simulate_together


def show(**abort: Any) -> Mission:
    """A shipped show, with [abort]."""
    data = load_mission("change-of-picture").to_dict()
    return complete_times(Mission.from_dict(data | {"abort": abort}))


def aborts_of(mission: Mission) -> Aborts:
    """Its aborts."""
    return Aborts(mission, legs_up_to(mission, len(mission.phases)))


def random_mission(seed: int, *, rotors: bool = False) -> tuple[Mission, int]:
    """Vehicles that take off, fly shapes, turn and land, in wind; one of them, from 0, is lost on the way.

    Some have quadrotors; all, if they are to have ``rotors``.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 9))
    side = int(np.ceil(np.sqrt(n)))
    pads = [[2.0 * (k % side), 2.0 * (k // side), 0.2] for k in range(n)]
    forms: dict[str, Any] = {}
    for name in ("first", "second"):
        points: list[Any] = []
        while len(points) < n:
            x = rng.uniform(-3.0, 3.0, 3)
            if all(np.linalg.norm(x - y) > 1.9 for y in points):
                points.append(x)
        forms[name] = {"slots": np.round(points, 3).tolist(), "edges": []}
    quads = rng.random() < 0.15 or rotors
    phases = [
        {"kind": "takeoff", "height": 8.0, "duration": 5.0},
        {"kind": "establish", "formation": "first", "blend": 5.0, "duration": 5.0},
        rng.choice([
            {"kind": "turn", "yaw_deg": float(rng.integers(-170, 170)), "duration": 6.0},
            {"kind": "fly", "position": [5.0, float(rng.integers(-5, 5)), 9.0], "duration": 6.0},
            {"kind": "orbit", "centre": [4.0, 1.0, 8.2], "radius": 3.0, "rate_deg_s": 30.0, "duration": 7.0},
        ]),
        {"kind": "reshape", "formation": "second", "blend": 5.0, "duration": 6.0},
        {"kind": "land", "duration": 9.0, "agents": list(range(1, n + 1))},
    ]  # fmt: skip
    lost, length = int(rng.integers(1, n + 1)), 5.0 + 5.0 + 6.0 + 6.0
    data = {
        "schema_version": 1, "name": f"random-{seed}", "assignment": "each", "gravity": 9.81,
        "smoothness": str(rng.choice(["jerk", "lqr"])),
        "agents": {"position": pads, "radius": 0.15} | ({"vehicle": "q"} if quads else {"mass": 1.0}),
        "formations": forms, "obstacles": [{"kind": "ground"}], "phases": phases,
        "limits": {"separation": 0.3, "separation_altitude": 0.5},
        "abort": {"at": round(float(rng.uniform(0.0, length)), 2), "to": str(rng.choice(["any", "own"]))},
        "disturbances": {
            "wind": np.round([*rng.uniform(-4.0, 4.0, 2), 0.0], 2).tolist(),
            "lost": [{"agent": lost, "time": round(float(rng.uniform(1.0, length)), 2)}],
        },
    }  # fmt: skip
    if quads:
        data |= {"vehicles": {"q": {"model": "paper"}}, "smoothness": "jerk"}
    return Mission.from_dict(data), lost - 1


def flown_apart(seed: int, *, rotors: bool = False) -> float:
    """How much farther than promised the vehicles of a random mission stay apart in flight, after an abort [m].

    Infinite where no way is promised, since the plan itself leads two within the limit of separation, as flown, or one
    would come too near to where the lost one falls. Who goes home hits no lost one.
    """
    mission, lost = random_mission(seed, rotors=rotors)
    begins, at = mission.abandons_at, mission.aborting.at
    assert at is not None
    gone = mission.lost_at <= begins
    complete = complete_times(mission)
    legs = legs_up_to(complete, len(complete.phases))
    abort = Aborts(complete, legs, gone if gone.any() else None).abort_at(at)
    left = [i for i in range(mission.n_agents) if i != lost]
    i, j = np.array(list(itertools.combinations(left, 2))).T

    def apart(mission: Mission, since: float) -> float:
        result = rf.simulate(mission)
        assert result.complete
        assert since == 0.0 or result.time[-1] == pytest.approx(abort.rest_time, abs=1e-6)
        r = result.position[result.time >= since]
        if gone.any() and since > 0.0:
            assert np.linalg.norm(r[:, left] - r[:, [lost]], axis=2).min() > 0.3
        return float(np.linalg.norm(r[:, i] - r[:, j], axis=2).min()) - 0.3

    if not abort.home.way:
        if "'lost agent" in abort.home.reason:
            return np.inf
        assert "the plan itself" in abort.home.reason
        data = mission.to_dict()
        assert apart(Mission.from_dict(data | {"abort": {}, "disturbances": {}}), 0.0) < 0.3
        return np.inf
    return apart(mission, begins) - abort.certificate.separation


#: A shipped mission, to where, and when: whose steps back once broke a limit of acceleration, who are pushed or lag.
HARD = [
    ("bridge-inspection", "own", 21.43), ("change-of-picture", "own", 14.28), ("market-square", "any", 30.77),
    ("windy-passage", "any", 20.22), ("passage-quadrotors", "own", 42.02),
    # Quadrotors that turn with the body when the order comes.
    ("cube-passage-quadrotors", "any", 79.0),
    # Ten microseconds before the plan has landed.
    ("change-of-picture", "own", 30.21199),
]  # fmt: skip


@pytest.mark.parametrize(("name", "to", "T"), HARD)
def test_shipped_missions_pass_after_an_abort_and_keep_its_promise(
    name: str, to: str, T: float
) -> None:
    """The verdict passes, and compares the least distance, that of samples, with the one that the abort promises."""
    data = load_mission(name).to_dict()
    mission = Mission.from_dict(data | {"abort": {"at": T, "to": to}})
    promised = aborts_of(complete_times(mission)).abort_at(T).certificate.separation
    result = rf.simulate(mission)
    verdict = rf.assess(result)
    assert verdict.passed, verdict.summary
    check = verdict.by_name["way_home"]
    assert check.limit == pytest.approx(promised, abs=1e-12)
    i, j = np.array(list(itertools.combinations(range(mission.n_agents), 2))).T
    r, radius = result.position[result.time >= T + 0.5], mission.fleet.radius
    least = (np.linalg.norm(r[:, i] - r[:, j], axis=2) - radius[i] - radius[j]).min()
    assert check.worst == pytest.approx(least, abs=1e-3)
    assert check.worst is not None
    assert promised - 1e-12 <= check.worst <= least + 1e-9


def test_a_broken_promise_fails_the_verdict() -> None:
    """Vehicles whose messages are lost do not keep the promised distance, which is one line of the verdict."""
    data = load_mission("lossy-passage").to_dict() | {"abort": {"at": 35.71, "to": "own"}}
    verdict = rf.assess(rf.simulate(Mission.from_dict(data)))
    check = verdict.by_name["way_home"]
    assert not check.passed
    assert f"- {check.message}" in verdict.summary
    assert "promised 0.812 m" in check.message


def progress(begins: float, time: float, t: np.ndarray) -> np.ndarray:
    """Time along the plan at times t [s], by quadrature of a rate that falls from 1 to 0 as a quintic blend."""
    fine = np.linspace(begins, begins + time, 20_001)
    x = (fine - begins) / time
    rate = 1.0 - (10.0 * x**3 - 15.0 * x**4 + 6.0 * x**5)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(fine))])
    return begins + np.interp(t, fine, way)


@pytest.mark.parametrize("seed", range(6))
def test_aborts_keep_their_promise_in_flight(seed: int) -> None:
    """In wind, with one vehicle lost, the others stay as far apart as promised, by samples of their flight."""
    assert flown_apart(seed) > -1e-9


@pytest.mark.long
@pytest.mark.parametrize(("rotors", "none"), [(False, 17), (True, 24)])
def test_two_hundred_aborts_keep_their_promise_in_flight(rotors: bool, none: int) -> None:
    """Of 200 random missions in wind, with one vehicle lost, no abort is below its promise as flown.

    From 1 no way leads home since the plan leads two too near, and from the others for where the lost one falls.
    """
    margins = np.array([flown_apart(seed, rotors=rotors) for seed in range(200)])
    assert margins.min() > -1e-9
    assert np.isinf(margins).sum() == none


@pytest.mark.parametrize("apart", [1.5, 3.0, 6.0])
def test_vehicles_that_drag_holds_back_get_a_wider_grid_to_land_on(apart: float) -> None:
    """From a start in the air, ways home keep the separation in flight however far apart vehicles begin."""
    start = np.array([[0.0, 0, 5], [apart, 0, 5], [0, apart, 5]])
    mission = Mission.from_dict(
        {
            "schema_version": 1, "name": "grid", "smoothness": "jerk", "vehicles": {"q": {"model": "paper"}},
            "agents": {"vehicle": "q", "position": start.tolist(), "radius": 0.25}, "limits": {"separation": 0.5},
            "obstacles": [{"kind": "ground", "name": "ground"}], "formations": {"f": {"slots": start.tolist()}},
            "phases": [
                {"kind": "establish", "formation": "f", "duration": 4},
                {"kind": "go", "position": [10, 0, 5], "duration": 15},
            ],
        }
    )  # fmt: skip
    abort = aborts_of(mission).abort_at(10.0)
    assert abort.home.way == "to any place", abort.home.reason
    verdict = rf.assess(rf.simulate(Mission.from_dict(mission.to_dict() | {"abort": {"at": 10.0}})))
    assert verdict.by_name["way_home"].passed, verdict.summary
    assert verdict.by_name["separation"].passed, verdict.summary


def test_drag_that_grows_with_the_square_of_the_speed_holds_vehicles_back_too() -> None:
    """On ways of different lengths, vehicles without rotor drag are off theirs by the drag of their bodies."""
    start = np.array([[0.0, 0, 15], [6, 0, 15], [0, 6, 15]])
    q = {"model": "paper", "rotor_drag": 0.0, "rotor_inflow": 0.0, "body_drag": [0.05] * 3}
    mission = Mission.from_dict(
        {
            "schema_version": 1, "name": "bodies", "smoothness": "jerk", "vehicles": {"q": q},
            "agents": {"vehicle": "q", "position": start.tolist(), "radius": 0.25},
            "obstacles": [{"kind": "ground", "name": "ground"}], "formations": {"f": {"slots": start.tolist()}},
            "phases": [{"kind": "establish", "formation": "f", "duration": 4}, {"kind": "hold", "duration": 9}],
        }
    )  # fmt: skip
    assert not mission.drag.any()
    aborts = aborts_of(mission)
    over, down = aborts.abort_at(8.0).home.steps
    assert down.off == pytest.approx(
        tracking_allowance(aborts.mission), abs=1e-12
    )  # as far down for all
    assert over.off > tracking_allowance(aborts.mission) + 0.01


@pytest.mark.parametrize("to", ["any", "own"])
def test_every_second_has_a_way_home_and_no_two_come_nearer(to: str) -> None:
    """Samples of every second's abort come as near as proved, to a millimetre, and no nearer; all stand on places."""
    aborts = aborts_of(show(to=to))
    start = aborts.mission.fleet.position
    i, j = np.triu_indices(len(start), 1)
    for abort in aborts.all_aborts():
        assert abort.home.way, abort.home.reason
        r = abort.positions_at(np.linspace(abort.begins, abort.rest_time, 1500))
        least = float(np.linalg.norm(r[:, i] - r[:, j], axis=2).min()) - 2.0 * 0.15
        proved = abort.certificate.separation
        assert least >= proved - 1e-9
        own = min(x.least.separation for x in abort.steps[1:]) if abort.steps[1:] else proved
        if own == proved:  # not from the plan, whose other seconds count, too
            assert least == pytest.approx(proved, abs=2e-3)
        last = abort.steps[-1].end
        order = np.linalg.norm(last[:, None, :2] - start[:, :2], axis=2).argmin(axis=1)
        assert sorted(order) == list(range(len(start)))
        planned = abort.home.way == "lands as planned"
        assert to == "any" or planned or (order == np.arange(len(start))).all()
        assert np.allclose(last[:, :2], start[order, :2], atol=0.01)


def test_slowing_down_is_the_plan_at_another_clock() -> None:
    """Vehicles that slow down are where the flight without an abort was, at the time along it by quadrature."""
    mission = show()
    plain = rf.simulate(mission, times=np.linspace(0.0, 24.0, 4801))
    result = rf.simulate(show(at=19.0))
    begins = 19.5
    step = aborts_of(mission).abort_at(19.0).steps[0]
    during = (result.time >= begins) & (result.time <= begins + step.duration)
    at = progress(begins, step.duration, result.time[during])
    k = np.searchsorted(plain.time, at)
    assert np.abs(plain.velocity[k]).max() > 0.5
    share = (at - plain.time[k - 1]) / (plain.time[k] - plain.time[k - 1])
    between = plain.position[k - 1] + share[:, None, None] * (
        plain.position[k] - plain.position[k - 1]
    )
    assert np.abs(result.position[during] - between).max() < 1e-4


@pytest.mark.parametrize(("to", "T"), [("any", 4.0), ("own", 16.0), ("own", 27.0)])
def test_files_of_vehicles_are_what_is_flown(tmp_path: Path, to: str, T: float) -> None:
    """A vehicle that knows its trajectory and its file flies as `run --abort-at` does, which passes its verdict."""
    check_aborts(show(to=to, step=T)).write(tmp_path)
    result = rf.simulate(show(to=to, at=T))
    verdict = rf.assess(result)
    assert verdict.passed
    assert "phases abandoned after the order" in verdict.summary
    plain = rf.simulate(show(to=to))
    for i in (0, 7):
        table = json.loads((tmp_path / f"vehicle-{i + 1:04d}.json").read_text())
        abort = next(x for x in table["aborts"] if x["ordered_s"] == T)
        begins, stops = abort["begins_s"], abort["stops_s"]
        at = progress(begins, stops - begins, np.array([stops]))
        place = np.array([np.interp(at, plain.time, plain.position[:, i, q])[0] for q in range(3)])
        t = stops
        for way in table["ways"][str(abort["ways"])]:
            x = np.clip((result.time - t) / way["duration_s"], 0.0, 1.0)
            during = (result.time >= t) & (result.time <= t + way["duration_s"])
            s = 35 * x**4 - 84 * x**5 + 70 * x**6 - 20 * x**7
            r = place + s[:, None] * (np.array(way["to_m"]) - place)
            assert np.abs(result.position[during, i] - r[during]).max() < 5e-3
            place, t = np.array(way["to_m"]), t + way["duration_s"]
        assert t == pytest.approx(result.time[-1], abs=1e-6)


@pytest.mark.parametrize("name", ["change-of-picture", "bridge-inspection"])
def test_files_of_vehicles_lead_home_from_every_second(tmp_path: Path, name: str) -> None:
    """Each abort's way in a vehicle's file takes as long as said and ends on a place; only a landing has none."""
    mission = load_mission(name)
    check = check_aborts(complete_times(Mission.from_dict(mission.to_dict() | {"abort": {}})))
    check.write(tmp_path)
    table = json.loads((tmp_path / "vehicle-0001.json").read_text())
    ends = {x["ordered_s"]: x for x in json.loads((tmp_path / "aborts.json").read_text())["aborts"]}
    assert len(table["aborts"]) == len(check.aborts)
    back = 0
    for abort, planned in zip(table["aborts"], check.aborts, strict=True):
        if abort["ways"] is None:
            assert planned.home.way == "lands as planned"
            continue
        steps = table["ways"][str(abort["ways"])]
        end = abort["stops_s"] + sum(x["duration_s"] for x in steps)
        assert end == pytest.approx(ends[abort["ordered_s"]]["ends_s"], abs=1e-9)
        assert steps[-1]["to_m"] == pytest.approx(
            planned.positions_at(np.array([end]))[0, 0], abs=1e-5
        )
        for step in (x for x in steps if "back_to_s" in x):  # where the plan was then
            back += 1
            was = aborts_of(check.mission).plan.at(np.array([step["back_to_s"]]))[0, 0]
            assert step["to_m"] == pytest.approx(was, abs=1e-5)
    assert (back > 0) == (name == "bridge-inspection")


def test_slowing_down_into_a_phase_without_slots_is_proved_too() -> None:
    """Who slows down while distances alone close up comes no nearer than proved, at samples, and as near."""
    forms = {name: {"shape": "triangle", "size": x} for name, x in (("wide", 3.0), ("close", 0.6))}
    phases = [
        {"kind": "takeoff", "height": 6.0, "duration": 6.0},
        {"kind": "establish", "formation": "wide", "blend": 4.0, "duration": 5.0},
        {"kind": "fly", "position": [8.0, 0.0, 6.0], "velocity": [2.0, 0.0, 0.0], "duration": 5.0},
        {"kind": "reshape", "formation": "close", "blend": 3.0, "control": "open", "duration": 6.0},
    ]
    data = {
        "schema_version": 1, "name": "closing", "smoothness": "jerk", "formations": forms, "phases": phases,
        "agents": {"position": [[0, 0, 0.2], [3, 0, 0.2], [1.5, 2.5, 0.2]], "mass": 1.0, "radius": 0.2},
        "obstacles": [{"kind": "ground"}],
    }  # fmt: skip
    step = aborts_of(complete_times(Mission.from_dict(data))).abort_at(15.49).steps[0]
    r = step.way.at(np.linspace(0.0, step.duration, 2000))
    i, j = np.triu_indices(3, 1)
    least = np.linalg.norm(r[:, i] - r[:, j], axis=2).min() - 0.4
    assert least < 2.5
    assert step.least.separation == pytest.approx(least, abs=1e-3)
    assert step.least.separation <= least


def test_what_follows_if_one_does_not_hear() -> None:
    """The nearest of a vehicle that flies on is that of a search of all vehicles, at fine samples."""
    aborts = aborts_of(show())
    plain = rf.simulate(aborts.mission, times=np.linspace(0.0, 24.0, 4801))
    abort = aborts.abort_at(7.0)
    each = aborts.nearness_if_unheard(abort)
    told = min(each)
    t = plain.time[(plain.time > abort.begins) & (plain.time < min(abort.rest_time, 24.0))]
    r, on = abort.positions_at(t), plain.position[np.searchsorted(plain.time, t)]
    n = aborts.mission.n_agents
    best = np.full(n, np.inf)
    for i in range(n):
        far = np.linalg.norm(r - on[:, i, None], axis=2) - 0.3
        best[i] = np.delete(far, i, axis=1).min()
    assert told.time <= 24.0
    assert told.value == pytest.approx(best.min(), abs=0.02)
    assert told.who == best.argmin()
    assert np.allclose([x.value for x in each], best, atol=0.05)
    assert [x.who for x in each] == list(range(n))


def test_levels_keep_who_is_above() -> None:
    """Of two ways that cross as seen from above, levels differ; who is above at first has the higher level."""
    rng = np.random.default_rng(4)
    p, q = rng.uniform(0.0, 6.0, (30, 3)), rng.uniform(0.0, 12.0, (30, 3))
    level = altitude_levels(1.0, p, q)
    s = np.linspace(0.0, 1.0, 2001)[:, None]
    crossing = 0
    for i, j in itertools.combinations(range(30), 2):
        far = np.linalg.norm(((1 - s) * (p[i] - p[j]) + s * (q[i] - q[j]))[:, :2], axis=1)
        if far.min() < 0.999:
            crossing += 1
            assert level[i] != level[j]
        if far[0] < 0.999:
            assert (level[i] > level[j]) == (p[i, 2] > p[j, 2])
    assert crossing > 20


def test_a_loss_may_send_the_others_home() -> None:
    """With on_loss = "abort" those left land where vehicles stood, and nothing of the lost one counts."""
    data = load_mission("change-of-picture").to_dict()
    data["disturbances"] = {"lost": [{"agent": 5, "time": 9.0}], "on_loss": "abort"}
    result = rf.simulate(Mission.from_dict(data))
    assert rf.assess(result).passed
    assert next(p.name for p in result.phases if "abort" in p.name) == "abort: slow down"
    left = np.arange(12) != 4
    end, start = result.position[-1][left], result.position[0]
    order = np.linalg.norm(end[:, None, :2] - start[:, :2], axis=2).argmin(axis=1)
    assert len(set(order)) == 11
    assert np.abs(end - start[order]).max() < 0.01


def test_nobody_lands_on_a_wreck() -> None:
    """A quadrotor falls onto the place of another, which lands elsewhere."""
    data = load_mission("crazyflies").to_dict()
    data["disturbances"] |= {"lost": [{"agent": 2, "time": 12.0}], "on_loss": "abort"}
    result = rf.simulate(Mission.from_dict(data))
    pads = result.mission.fleet.position[:, :2]
    wreck = result.position[-1, 1, :2]
    assert np.linalg.norm(pads[2] - wreck) < 0.05
    others = result.position[result.time >= 12.5][:, [0, 2, 3, 4, 5]]
    fallen = result.position[result.time >= 12.5][:, [1]]
    assert np.linalg.norm(others - fallen, axis=2).min() > 0.3
    assert rf.assess(result).passed


@pytest.mark.parametrize(("to", "home"), [("any", True), ("own", False)])
def test_a_wreck_on_the_own_place_is_said_to_stand_in_the_way(to: str, home: bool) -> None:
    """Above the place of the second vehicle the first is lost: the second lands on the first one's place, or not."""
    phases = [
        {"kind": "takeoff", "height": 6.0, "duration": 6.0},
        {"kind": "fly", "position": [4.5, 0.0, 6.0], "duration": 8.0},
        {"kind": "hold", "duration": 9.0},
    ]
    data = {
        "schema_version": 1, "name": "pair", "smoothness": "jerk", "gravity": 9.81, "phases": phases,
        "agents": {"position": [[0.0, 0.0, 0.2], [3.0, 0.0, 0.2]], "mass": 1.0, "radius": 0.2},
        "obstacles": [{"kind": "ground"}], "limits": {"separation": 0.5}, "abort": {"to": to},
        "disturbances": {"lost": [{"agent": 1, "time": 16.0}], "on_loss": "abort"},
    }  # fmt: skip
    mission = Mission.from_dict(data)
    result = rf.simulate(mission)
    assert np.abs(result.position[-1, 0, :2] - [3.0, 0.0]).max() < 1e-3
    assert result.complete == home
    assert rf.assess(result).passed == home
    if home:
        assert np.abs(result.position[-1, 1, :2]).max() < 1e-3
    else:
        assert "'lost agent 1' stands in the way of agent 2 on the way down" in result.ending
        assert "lost agent 1' stands in the way" in str([x.text for x in rf.check(mission).remarks])


@pytest.mark.parametrize(("agents", "T"), [([3], 19.0), ([8, 9], 5.0)])
def test_some_leave_and_the_others_fly_on(agents: list[int], T: float) -> None:
    """Those that leave come down where the plan leads them; the others fly as without them; none come too near."""
    mission = show(agents=agents, at=T)
    plain, result = rf.simulate(show()), rf.simulate(mission)
    assert rf.assess(result).passed
    others = [i for i in range(12) if i + 1 not in agents]
    last = plain.time[-1]
    t = np.linspace(T, last - 1.5, 60)
    for i in others:
        for q in range(3):
            a, b = (np.interp(t, x.time, x.position[:, i, q]) for x in (plain, result))
            assert np.abs(a - b).max() < 1e-2
    assert np.abs(result.position[-1] - plain.position[-1]).max() < 0.02
    # What those who fly on meet fails the check, as it would without the order.
    late = plain.time[-1] - 4.0
    i, k = others[0], int(np.searchsorted(plain.time, late))
    ball = {
        "kind": "sphere",
        "name": "ball",
        "centre": plain.position[k, i].tolist(),
        "radius": 0.2,
    }
    data = mission.to_dict()
    ahead = rf.check(Mission.from_dict(data | {"obstacles": [*data["obstacles"], ball]}))
    assert "hits 'ball'" in str([x.text for x in ahead.remarks if x.level == "fails"])
    abort = aborts_of(mission).abort_at(T)
    i, j = np.triu_indices(12, 1)
    r = abort.positions_at(np.linspace(abort.begins, abort.rest_time, 3000))
    assert (
        np.linalg.norm(r[:, i] - r[:, j], axis=2).min() - 0.3 >= abort.certificate.separation - 1e-9
    )
    away = abort.positions_at(np.array([abort.begins + abort.waits + abort.slows]))[0] - r[0]
    assert all(np.abs(away[k - 1]).max() > 0.01 for k in agents) or T < 10.0


def test_who_stays_in_a_plan_that_ends_in_motion_flies_it_to_its_end() -> None:
    """The last second of an orbit is the plan's, and so is its separation, which the way home promises."""
    formation = {"slots": [[0, 0, 0], [3, 0, 0], [3, 3, 0], [0, 3, 0]]}
    phases = [
        {"kind": "takeoff", "height": 8.0, "duration": 8.0},
        {"kind": "establish", "formation": "square", "duration": 8.0},
        {"kind": "orbit", "centre": [0, 0, 8], "radius": 8.0, "rate_deg_s": 9.0, "duration": 20.0, "yaw": "along"},
    ]  # fmt: skip
    data = {
        "schema_version": 1, "name": "orbit", "smoothness": "jerk", "phases": phases, "limits": {"separation": 1.0},
        "agents": {"mass": 1.0, "radius": 0.2, "position": [[0, 0, 0.2], [3, 0, 0.2], [3, 3, 0.2], [0, 3, 0.2]]},
        "formations": {"square": formation}, "obstacles": [{"kind": "ground"}],
    }  # fmt: skip
    plain, result = (
        rf.simulate(Mission.from_dict(data | more))
        for more in ({}, {"abort": {"at": 20.0, "agents": [3]}})
    )
    assert rf.assess(result).passed, rf.assess(result).summary
    others = [0, 1, 3]
    assert np.linalg.norm(plain.velocity[-1, others], axis=1).min() > 0.5
    t = np.linspace(plain.time[-1] - 1.0, plain.time[-1], 50)
    for i, q in itertools.product(others, range(3)):
        a, b = (np.interp(t, x.time, x.velocity[:, i, q]) for x in (plain, result))
        assert np.abs(a - b).max() < 1e-3


def test_files_of_those_who_stay_lead_on(tmp_path: Path) -> None:
    """Who leaves has ways home in its file; the others have none, and fly their own trajectories to the end."""
    check_aborts(show(agents=[3], step=5.0)).write(tmp_path)
    stays, leaves = (json.loads((tmp_path / f"vehicle-{k:04d}.json").read_text()) for k in (1, 3))
    assert len(stays["aborts"]) == len(leaves["aborts"]) > 3
    assert not stays["ways"]
    assert all(x["ways"] is None for x in stays["aborts"])
    assert all(str(x["ways"]) in leaves["ways"] for x in leaves["aborts"])


def test_check_says_that_no_one_can_leave_the_plan() -> None:
    """Where one is to leave and a roof is over the places, that fails, and no way of others is made up for it."""
    data = show(agents=[3], at=10.0).to_dict()
    data["obstacles"].append({"kind": "box", "min": [-99, -99, 2.5], "max": [99, 99, 3], "zone": True})  # fmt: skip
    data["phases"] = [p for p in data["phases"] if p["kind"] not in ("takeoff", "land")]
    data["agents"]["position"] = [[x, y, 12.0] for x, y, _ in data["agents"]["position"]]
    failed = [x.text for x in rf.check(Mission.from_dict(data)).remarks if x.topic == "loss"]
    assert len(failed) == 1
    assert "no way home is proved" in failed[0]


def test_an_abort_begins_where_the_vehicles_are_led() -> None:
    """Beside obstacles that move, too, the reference goes on from the plan to the abort without a jump."""
    data = load_mission("moving-obstacles").to_dict()
    data["obstacles"].append({"kind": "ground"})
    data["avoidance"]["clearance"] = 0.0  # vehicles land
    result = rf.simulate(Mission.from_dict(data | {"abort": {"at": 15.0}}))
    assert result.complete
    slots, begins = result.slot_position, np.flatnonzero(np.diff(result.phase))
    assert slots is not None
    fastest = np.linalg.norm(result.velocity, axis=2).max() * result.mission.output_step
    assert np.linalg.norm(slots[begins + 1] - slots[begins], axis=2).max() < 1.5 * fastest


@pytest.mark.parametrize(("beside", "home"), [(0.02, False), (0.12, True)])
def test_ways_home_leave_vehicles_room_beside_fences(beside: float, home: bool) -> None:
    """Vehicles are off their ways by half of the allowance each, 0.05 m: a fence that is nearer stands in the way."""
    wedge = [[5.0, -beside], [4.0, -4.0], [6.0, -4.0]]
    mission = Mission.from_dict({
        "schema_version": 1, "name": "beside", "smoothness": "jerk", "obstacles": [{"kind": "ground"}],
        "vehicles": {"quad": {"model": "paper"}},
        "agents": {"vehicle": "quad", "radius": 0.15, "position": [[0, 0, 0.2], [0, 3, 0.2]]},
        "formations": {"line": {"slots": [[0, -1.5, 0], [0, 1.5, 0]], "edges": []}},
        "limits": {"separation": 0.3}, "fences": [{"kind": "exclusion", "polygon": wedge}],
        "phases": [
            {"kind": "takeoff", "height": 6.0, "duration": 5.0},
            {"kind": "establish", "formation": "line", "blend": 2.0, "duration": 3.0},
            {"kind": "fly", "position": [10.0, 1.5, 6.0], "duration": 8.0},
            {"kind": "land", "duration": 8.0},
        ],
    })  # fmt: skip
    homes, when = WaysHome(Steps(mission, np.zeros(2, dtype=np.bool_))), np.array([16.0])
    places = plan_path(legs_up_to(mission, len(mission.phases))).at(when)[0]
    assert bool(homes.straight_ways_home(places, 16.0).way) == home


def test_what_stands_in_the_way_is_named() -> None:
    """Without a ground, or with a roof over the places and none to go back to, there is no way, and it is said why."""
    data = load_mission("change-of-picture").to_dict()
    legs = {"obstacles": []}
    data["phases"] = [p for p in data["phases"] if p["kind"] not in ("takeoff", "land")]
    data["agents"]["position"] = [[x, y, 12.0] for x, y, _ in data["agents"]["position"]]
    aborts = aborts_of(complete_times(Mission.from_dict(data | legs)))
    abort = aborts.abort_at(2.0)
    assert not abort.home.way
    assert "there is no ground to land on" in abort.home.reason
    roof = {
        "name": "roof",
        "kind": "box",
        "min": [-99, -99, 2.5],
        "max": [99, 99, 3.0],
        "zone": True,
    }
    mission = complete_times(Mission.from_dict(data | {"obstacles": [{"kind": "ground"}, roof]}))
    abort = aborts_of(mission).abort_at(2.0)
    assert not abort.home.way
    assert "'roof' stands in the way" in abort.home.reason
    often = check_aborts(Mission.from_dict(mission.to_dict() | {"abort": {"step": 15.0}}))
    *_, none = often.sentences()
    last = often.aborts[-1].ordered
    assert none.startswith(f"From 0 to {last:g} s, none: to any place: 'roof' stands in the way of")
    result = rf.simulate(Mission.from_dict(mission.to_dict() | {"abort": {"at": 2.0}}))
    assert not result.complete
    assert "'roof' stands in the way" in result.ending
    assert "no way home is proved" in str([x.text for x in rf.check(result.mission).remarks])


@pytest.mark.parametrize(
    ("avoidance", "lands"),
    [({"clearance": 0.04}, True), ({"clearance": 0.2}, False), ({"margin": 0.2}, False), ({"separation": 1.5}, True)],
)  # fmt: skip
def test_ways_home_are_those_that_avoidance_lets_vehicles_fly(
    avoidance: dict[str, Any], lands: bool
) -> None:
    """Where it keeps vehicles off the ground, none lands, and both checks say why; ways home keep its separation."""
    data = {
        "schema_version": 1, "name": "kept", "assignment": "each", "smoothness": "jerk", "limits": {"separation": 0.5},
        "agents": {"vehicle": "q", "radius": 0.1, "position": [[0, 0, 4.0], [2, 0, 4.0], [4, 0, 4.0]]},
        "vehicles": {"q": {"model": "point", "mass": 1.0, "thrust_limit": 20.0}}, "obstacles": [{"kind": "ground"}],
        "formations": {"row": {"slots": [[-3, 0, 0], [0, 0, 0], [3, 0, 0]], "edges": []}}, "avoidance": avoidance,
        "phases": [{"kind": "establish", "formation": "row", "blend": 4.0, "duration": 5.0}],
    }  # fmt: skip
    home = aborts_of(complete_times(Mission.from_dict(data))).abort_at(4.0).home
    assert ("keeps vehicles 0.2 m from the ground" in home.reason) is not lands
    verdict = rf.assess(rf.simulate(Mission.from_dict(data | {"abort": {"at": 4.0}})))
    assert verdict.passed is lands, str(verdict)
    data["phases"].append({"kind": "land", "duration": 8.0})
    words = [x.text for x in rf.check(Mission.from_dict(data)).remarks if x.topic == "avoidance"]
    assert any("from the ground" in x for x in words) is not lands


def test_what_flies_past_fast_is_seen_between_slow_samples() -> None:
    """A ball of 0.6 m at 30 m/s that crosses the way down of a vehicle leaves it no such way, if it hits it."""
    data = show().to_dict()
    abort = aborts_of(show()).abort_at(12.0)
    down = abort.rest_time - 0.5 * abort.steps[-1].duration
    x, y, z = abort.positions_at(np.array([down]))[0, 6].tolist()
    hits = set()
    for late in (0.0, 0.5, 2.0, 3.5):
        waypoints = [[x - 60.0, y, z], [x + 60.0, y, z]]
        times = [down + late - 2.0, down + late + 2.0]
        ball = {"kind": "sphere", "radius": 0.6, "waypoints": waypoints, "times": times}
        ball["name"], ball["appears"], ball["vanishes"] = "ball", times[0] + 1.5, times[0] + 2.5
        every = {"obstacles": [*data["obstacles"], ball]}
        planned = aborts_of(Mission.from_dict(data | every)).abort_at(12.0)
        t = np.linspace(times[0] + 1.5, times[0] + 2.5, 2001)
        r = abort.positions_at(t)
        centre = np.linspace(x - 15.0, x + 15.0, 2001)
        far = r - np.column_stack([centre, 0.0 * t + y, 0.0 * t + z])[:, None]
        hit = np.linalg.norm(far, axis=2).min() < 0.6 + 0.15
        hits.add(bool(hit))
        assert (planned.home.way == abort.home.way) == (not hit)
    assert hits == {True, False}


def test_flights_side_by_side_abort_like_one_alone() -> None:
    """Missions that a sweep flies together abort as each does alone."""
    missions = [show(at=t) for t in (8.0, 8.0)]
    both = simulate_together(missions)
    alone = rf.simulate(missions[0])
    assert alone.phases[-1].name == "abort: down"
    for result in both:
        assert [p.name for p in result.phases] == [p.name for p in alone.phases]
        assert np.abs(result.position[-1] - alone.position[-1]).max() < 1e-6


def test_ways_home_stay_within_fences() -> None:
    """Ways that lead through a closed area without its fence keep out of it with the fence, at dense samples."""
    data = load_mission("change-of-picture").to_dict()
    ring = [[3.0, -1.5], [6.0, -1.5], [6.0, 1.5], [3.0, 1.5]]
    fence = {"name": "tent", "kind": "exclusion", "polygon": ring, "ceiling": 6.0}
    entered = []
    for fences in ([], [fence]):
        more = {"fences": fences, "abort": {"to": "own"}}
        aborts = aborts_of(complete_times(Mission.from_dict(data | more)))
        entered.append(0)
        for t in (21.0, 24.0, 28.0):
            abort = aborts.abort_at(t)
            assert abort.home.way
            x, y, z = np.moveaxis(
                abort.positions_at(np.linspace(abort.begins, abort.rest_time, 3000)), 2, 0
            )
            entered[-1] += bool(((x > 3.0) & (x < 6.0) & (np.abs(y) < 1.5) & (z < 6.0)).any())
    assert entered[0] > 0
    assert entered[1] == 0


def test_equal_stopped_places_are_planned_once() -> None:
    """Orders while all hold share the number of their ways."""
    aborts = aborts_of(show())
    numbers = [aborts.abort_at(t).home.number for t in (8.0, 8.25, 8.5, 8.75, 9.0)]
    assert len(set(numbers)) < 5


def test_ways_are_made_again_and_not_kept() -> None:
    """Aborts keep less than a quarter of the size of their ways, which are the same each time, and end where said."""
    aborts = aborts_of(show(step=0.25))
    aborts.abort_at(3.0)  # what all share
    tracemalloc.start()
    every = list(aborts.all_aborts())
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    steps = [step for abort in every for step in abort.steps]
    assert kept < 0.25 * sum(step.way.pieces.nbytes for step in steps)
    for step in steps[::7]:
        way, again = step.way, step.way
        assert np.array_equal(way.pieces, again.pieces)
        assert way.time[-1] == step.duration
        assert np.array_equal(way.at(way.time[-1:])[0], step.end)


@pytest.mark.parametrize(
    ("reaction", "step", "count"), [(0.0, 7.3, 4), (0.5, 7.3, 5), (0.0, 40.0, 0), (40.0, 1.0, 0)]
)
def test_each_abort_that_is_planned_can_be_flown(reaction: float, step: float, count: int) -> None:
    """Of steps that do not divide the flight, and no others: at once, and later than all that is planned."""
    mission = show(reaction=reaction, step=step)
    checked = check_aborts(mission)
    assert len(checked.aborts) == count
    assert ("note" in str(checked.facts().parts[-1])) is (count == 0)
    data = mission.to_dict()
    for order in [x.ordered for x in checked.aborts]:
        Mission.from_dict(data | {"abort": data["abort"] | {"at": order}})  # no error


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`check --abort` says from how many times there is a way home; --out is refused without it."""
    assert main(["check", "change-of-picture", "--abort", "--out", str(tmp_path / "home")]) == 0
    out = capsys.readouterr().out
    assert "to any place" in out
    assert "flies on" in out
    table = json.loads((tmp_path / "home" / "aborts.json").read_text())
    assert all(x["way"] for x in table["aborts"])
    assert main(["check", "change-of-picture", "--out", str(tmp_path / "other")]) == 2
    assert "Add --abort" in capsys.readouterr().err


def test_vehicles_may_land_where_they_stood(tmp_path: Path) -> None:
    """With places = "own" each vehicle lands where it stood; without, check, verdict and export tell who does not."""
    plain = load_mission("change-of-picture")
    data = plain.to_dict()
    data["phases"][3]["yaw_deg"] = 90.0
    words = "vehicles land where another one stood"
    assert words in str([x.text for x in rf.check(plain).remarks])
    result = rf.simulate(plain)
    start, end = result.position[0], result.position[-1]
    off = np.linalg.norm(end[:, None, :2] - start[:, :2], axis=2)
    apart = np.linalg.norm(start[:, None] - start, axis=2) + 1e9 * np.eye(12)
    nearest, there = off.argmin(axis=1), off < 0.5 * apart.min(axis=0)
    where = [f"{i + 1} where {j + 1} did" for i, j in enumerate(nearest) if i != j and there[i, j]]
    others = len(where)
    assert others > 5
    said = f"{others} of 12 {words}: {', '.join(where[:5])} and {others - 5} more"
    assert said in str(rf.assess(result).notes)
    gone = where[0].split()[
        0
    ]  # one of them has no position at the end: the others are told all the same
    position = result.position.copy()
    position[-1, int(gone) - 1] = np.nan
    verdict = rf.assess(replace(result, position=position))
    assert f"{others - 1} of 12 {words}: {where[1]}" in str(verdict.notes)
    assert f"the position of agent {gone} is not finite" in verdict.summary
    result.save(tmp_path / "show.nc")
    assert main(["export", str(tmp_path / "show.nc"), "--format", "setpoints"]) == 0
    data["phases"][-1]["places"] = "own"
    own = Mission.from_dict(data)
    ahead, result = rf.check(own), rf.simulate(own)
    assert ahead.passed
    assert words not in str([x.text for x in ahead.remarks])
    verdict = rf.assess(result)
    assert verdict.passed
    assert words not in str(verdict.notes)
    assert np.abs(result.position[-1] - result.position[0])[:, :2].max() < 1e-6


def test_a_landing_far_from_all_places_is_nobodys() -> None:
    """Where vehicles come down beside the places that they left, none has landed where another one stood."""
    result = rf.simulate("falling-light")
    start, end = result.position[0, :, :2], result.position[-1, :, :2]
    assert np.linalg.norm(end[:, None] - start, axis=2).argmin(axis=1).tolist() != [
        *range(len(start))
    ]
    assert "where another one stood" not in str(rf.assess(result).notes)


def test_a_landing_on_own_places_needs_time() -> None:
    """Too short a duration is refused with the least one, which is then enough."""
    data = load_mission("change-of-picture").to_dict()
    data["phases"][-1] |= {"places": "own", "duration": 5.0}
    with pytest.raises(rf.MissionError, match=r"the least is ([\d.]+) s") as error:
        complete_times(Mission.from_dict(data))
    words = str(error.value).partition("the least is ")[2]
    data["phases"][-1]["duration"] = float(words.partition(" s")[0]) + 0.01
    assert complete_times(Mission.from_dict(data)).phases[-1].lands


@pytest.mark.long
@pytest.mark.parametrize("to", ["any", "own"])
def test_a_thousand_come_home_from_every_second(to: str) -> None:
    """Every second of show-1000 has a way home: to any place, and to the own ones."""
    mission = load_mission("show-1000")
    check = check_aborts(
        complete_times(Mission.from_dict(mission.to_dict() | {"abort": {"to": to}}))
    )
    assert len(check.aborts) == 81
    assert all(x.home.way for x in check.aborts)
    assert check.least_separation >= 0.8
