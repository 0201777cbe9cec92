"""Vehicles whose ways meet: quadrotors with the lags of attitude and motors keep apart, and what check says of braking.

The oracle of distances is a cubic spline through the record; of hulls, a quadratic programme solved by SciPy.
"""

import math

import numpy as np
import pytest
from scipy.optimize import nnls

import rigidfleet as rf
from rigidfleet.kernel.segments import hull_gap

MODELS = ("paper", "px4-sih", "hummingbird", "crazyflie", "x500")


@pytest.fixture(scope="module")
def encounters(benchmark_named):
    """The benchmark of encounters."""
    return benchmark_named("encounters")


def swap(starts, goals, *, blend=10.0, model="paper", **tables):
    """Quadrotors of radius 0.25 m that go straight from starts to goals [m], and are to keep 0.3 m between them."""
    s, g = np.array(starts, dtype=float), np.array(goals, dtype=float)
    return rf.Mission.from_dict({
        "schema_version": 1, "name": "meeting", "smoothness": "jerk", "output_step": 0.02,
        "vehicles": {"q": {"model": model}},
        "agents": {"vehicle": "q", "radius": 0.25, "position": (s + [0, 0, 5]).tolist()},
        "avoidance": {"separation": 0.3},
        "formations": {
            "first": {"slots": s.tolist(), "edges": []}, "swapped": {"slots": g.tolist(), "edges": []},
        },
        "phases": [
            {"kind": "establish", "formation": "first", "duration": 5.0},
            {"kind": "reshape", "formation": "swapped", "alignment": "none", "blend": blend, "duration": blend + 15.0},
        ],
    } | tables)  # fmt: skip


LEVEL = {
    "a pair": ([[-5, 0, 0], [5, 0, 0]], [[5, 0, 0], [-5, 0, 0]]),
    "along y": ([[0, -5, 0], [0, 5, 0]], [[0, 5, 0], [0, -5, 0]]),
    "aslant": ([[-4, -3, 0], [4, 3, 0]], [[4, 3, 0], [-4, -3, 0]]),
    "two pairs": (
        [[-5, 0, 0], [5, 0, 0], [-5, 6, 0], [5, 6, 0]],
        [[5, 0, 0], [-5, 0, 0], [5, 6, 0], [-5, 6, 0]],
    ),
}


@pytest.mark.parametrize("name", LEVEL)
def test_quadrotors_that_meet_at_one_height_keep_apart(name, encounters):
    """Head-on in a level plane, 10 m in 10 s: the separation is kept to 5 mm, and the guarantee is held."""
    result = rf.simulate(swap(*LEVEL[name]))
    assert encounters.splined(result) >= 0.3 - 5e-3
    checks = {check.check: check for check in rf.assess(result).checks}
    assert checks["separation"].passed
    assert checks["guarantee"].passed


@pytest.mark.parametrize("model", MODELS)
def test_every_quadrotor_brakes_as_its_lags_need(model, encounters):
    """8 m in 10 s at four bearings, one of them tilted: every model keeps apart, and all could brake at every tick."""
    rng = np.random.default_rng(len(model))
    for tilt in (0.0, 0.0, 0.0, 0.05):
        angle = rng.uniform(0.0, 2.0 * math.pi)
        half = np.array([4.0 * math.cos(angle), 4.0 * math.sin(angle), tilt])
        result = rf.simulate(swap([-half, half], [half, -half], model=model))
        assert encounters.splined(result) >= 0.3 - 5e-3
        found = {check.check: check for check in rf.assess(result).checks}["guarantee"]
        assert found.passed, found.message


def judged(encounters, numbers, seed, **given):
    """Flights of encounters: none overlaps, and the separation is kept to 5 mm in 99 % of them."""
    flown = [encounters.fly(k, seed, **given) for k in numbers]
    least = np.array([min(e.least, e.splined) for e in flown])
    assert least.min() > 0.0
    assert (least >= encounters.APART - encounters.ALLOWED).mean() >= 0.99
    return flown


def test_encounters_of_every_kind_keep_apart(encounters):
    """One encounter of each kind, with vehicles of all models: none overlaps, nor is nearer than 5 mm below."""
    flown = judged(encounters, range(0, 42, 5), 11)
    assert len({e.model for e in flown}) == 6
    assert len({e.kind for e in flown}) == 7


@pytest.mark.long
@pytest.mark.parametrize("fast", [False, True])
def test_random_encounters_keep_apart(encounters, fast):
    """Hundreds, also of 4 to 20 m in 4 to 10 s: no overlap; a lost guarantee is rare, and its flight never passes."""
    flown = judged(encounters, range(336), 3, fast=fast)
    assert sum(e.lost for e in flown) <= 0.03 * len(flown)
    assert not any(e.lost and e.passed for e in flown)


def test_the_distance_of_hulls_is_that_of_a_quadratic_programme():
    """Of two hulls of five points, the least distance by non-negative least squares: never more, and to 0.05 m."""
    rng = np.random.default_rng(2)
    for _ in range(300):
        p, q = rng.normal(size=(5, 3)), rng.normal(size=(5, 3)) + rng.normal(0.0, 3.0, 3)
        x = (p[:, None] - q[None]).reshape(-1, 3)
        weight = nnls(np.vstack([x.T, np.full(len(x), 1e3)]), np.array([0.0, 0.0, 0.0, 1e3]))[0]
        exact = float(np.linalg.norm(weight @ x / weight.sum()))
        found = hull_gap(
            np.ascontiguousarray(p[:3]), 2, np.ascontiguousarray(p[3:]),
            np.ascontiguousarray(q[:3]), 2, np.ascontiguousarray(q[3:]), math.nan, np.zeros(3),
        )  # fmt: skip
        assert found <= exact + 1e-6
        assert found == pytest.approx(exact, abs=0.05)


def remarks(mission):
    """What check says of [avoidance]."""
    return [x for x in rf.check(mission).remarks if x.topic == "avoidance"]


@pytest.mark.parametrize("model", MODELS)
def test_check_refuses_a_start_that_cannot_be_braked(model):
    """Towards each other with 4 m/s from 2 m apart: refused, by whom, and lost in flight; from 20 m apart it is not."""
    agents = {"vehicle": "q", "radius": 0.25, "velocity": [[4, 0, 0], [-4, 0, 0]]}
    for half, refused in ((1.0, True), (10.0, False)):
        at = [[-half, 0, 5], [half, 0, 5]]
        ends = [[-half, 0, 0], [half, 0, 0]]
        mission = swap(ends, ends, model=model, agents=agents | {"position": at})
        said = remarks(mission)
        assert [x.level for x in said] == (["fails"] if refused else [])
        assert not said or "agents 1 and 2 cannot brake in time" in said[0].text
        found = {x.check: x for x in rf.assess(rf.simulate(mission)).checks}["guarantee"]
        assert (found.when == 0.0 and not found.passed) == refused


def test_check_refuses_a_start_towards_a_wall():
    """A vehicle 1 m from a wall, with 6 m/s towards it: refused, with the wall's name; at rest it is not."""
    wall = {"kind": "box", "name": "wall", "min": [2, -5, 0], "max": [3, 5, 9]}
    for speed, names in ((6.0, ["wall"]), (0.0, [])):
        agents = {
            "vehicle": "q", "radius": 0.25, "position": [[0.75, 0, 5], [-9, 0, 5]],
            "velocity": [[speed, 0, 0], [0, 0, 0]],
        }  # fmt: skip
        ends = [[0.75, 0, 0], [-9, 0, 0]]
        said = remarks(swap(ends, ends, agents=agents, obstacles=[wall]))
        assert ["wall" for x in said if "'wall'" in x.text] == names


@pytest.mark.parametrize(
    ("tables", "level"),
    [
        ({}, "note"),
        ({"avoidance": {"separation": 0.3, "guard": False}}, "fails"),
        ({"avoidance": {"separation": 0.3}, "limits": {"separation": 0.4}}, "fails"),
        ({"avoidance": {}, "limits": {"separation": 0.3}}, "note"),
    ],
)  # fmt: skip
def test_check_leaves_ways_that_meet_to_the_guard(tables, level):
    """Planned paths that meet are no failure where the guard keeps all that the limit needs, and are one elsewhere."""
    found = rf.check(swap(*LEVEL["a pair"], **tables))
    assert {remark.level for remark in found.remarks if remark.topic == "collision"} == {level}
