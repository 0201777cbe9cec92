"""Assignment by exchange, and the proof of separation that a plan carries."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from rigidfleet import MissionError, assess, check, simulate
from rigidfleet.formation import assignment, shapes
from rigidfleet.mission import Mission, load_mission
from rigidfleet.planning.preview import preview_phases
from rigidfleet.result import Result


def shape(name: str, *size: float, n: int) -> np.ndarray:
    points = shapes.slots(name, size if len(size) > 1 else size[0], n)
    return points - points.mean(axis=0)


def tour(n: int) -> list[np.ndarray]:
    """Grid, sphere, helix, logo (random pixels), grid, all with a spacing of 2 m."""
    pixels = np.stack(np.meshgrid(*[2.0 * np.arange(int(np.sqrt(2 * n)) + 1)] * 2), -1).reshape(
        -1, 2
    )
    logo = np.zeros((n, 3))
    logo[:, ::2] = pixels[np.random.default_rng(1).permutation(len(pixels))[:n]]
    grid = shape("grid", 2.0, n=n)
    sphere, helix = shape("sphere", 2.0, n=n), shape("helix", 20.0, 3.0, 2.0, n=n)
    return [grid, sphere, helix, logo - logo.mean(axis=0), grid]


def products(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """x . y of all pairs, as a matrix."""
    near = p @ q.T
    own = near.diagonal()
    return own[:, None] + own - near - near.T


@pytest.mark.parametrize("n", [7, 40, 300, 301, 1000])
def test_up_to_a_thousand_the_sum_of_squares_is_the_least(n):
    """SciPy, asked for the optimum without any help, finds no better order."""
    for p, q in zip(tour(n), tour(n)[1:], strict=False):
        order = assignment.assign_slots(p, q, turn=np.eye(3)).order
        assert sorted(order) == list(range(n))
        best = linear_sum_assignment(-(p @ q.T))[1]
        cost, least = (((p - q[k]) ** 2).sum() for k in (order, best))
        assert cost == pytest.approx(least, rel=1e-12)


@pytest.mark.parametrize("n", [1025, 2500])
def test_no_exchange_of_two_slots_is_better(n):
    """Beyond, x . y >= 0 for every pair, so that the distance of two never falls below the bound."""
    for p, q in zip(tour(n), tour(n)[1:], strict=False):
        order = assignment.assign_slots(p, q, turn=np.eye(3)).order
        assert sorted(order) == list(range(n))
        assert products(p, q[order]).min() >= -1e-9 * (p**2).sum(axis=1).max()
        a, b = pdist(p).min(), pdist(q).min()
        assert assignment.closest_approach(p, q[order])[0] >= a * b / np.hypot(a, b) * (1 - 1e-9)


@pytest.mark.parametrize("n", [40, 1025])
def test_the_bound_holds_where_heights_count_less(n):
    """In a downwash metric along any axis the order is the optimum, or no exchange is better, and the bound holds."""
    up = np.array([0.0, 0.6, 0.8])
    metric = assignment.downwash_metric(up, 3.0)
    np.testing.assert_allclose(metric @ up, up / 3.0, atol=1e-15)
    np.testing.assert_allclose(metric @ [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], atol=1e-15)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    for p, q in zip(tour(n), tour(n)[1:], strict=False):
        order = assignment.assign_slots(p, q, turn=turn, metric=metric).order
        x, y = p @ metric, q @ turn.T @ metric
        assert products(x, y[order]).min() >= -1e-9 * (x**2).sum(axis=1).max()
        if n < 1000:
            best = linear_sum_assignment(-(x @ y.T))[1]
            assert (x * y[order]).sum() == pytest.approx((x * y[best]).sum(), rel=1e-12)
        a, b = pdist(x).min(), pdist(y).min()
        assert assignment.closest_approach(x, y[order])[0] >= a * b / np.hypot(a, b) * (1 - 1e-9)
    with pytest.raises(ValueError, match="prescribed turn"):
        assignment.assign_slots(p, q, metric=metric)


def test_missions_assign_where_heights_count_less():
    """Two vehicles that would pass above each other, and do not if heights count less; on a tilted body, too."""
    slots = [[0.0, 0.0, 0.0], [1.0, 0.0, 2.2], [3.0, 0.0, 1.0]]
    start = [[0.0, 0.0, 2.0], [1.1, 0.0, 0.0], [3.0, 0.0, 1.0]]

    def orders(**keys):
        return Mission.from_dict(
            {
                "schema_version": 1, "name": "above", "assignment": "each",
                "agents": {"mass": 1.0, "position": (np.array(start) + [0, 0, 9]).tolist()},
                "formations": {"f": {"slots": slots, "edges": []}},
                "phases": [{"kind": "establish", "formation": "f", "control": "tracking", "duration": 5.0}],
            } | keys
        ).assigned_slots["f"].tolist()  # fmt: skip

    assert orders() == [1, 0, 2]
    assert orders(assignment_downwash=4.0) == [0, 1, 2]
    with pytest.raises(MissionError, match="no effect with assignment 'shortest'"):
        orders(assignment="shortest", assignment_downwash=4.0)


def test_exchanges_end_at_any_points():
    """Between random points, and where several points coincide."""
    rng = np.random.default_rng(0)
    p, q = rng.normal(size=(2, 600, 3))
    for start, slots in ((p, q), (np.round(p), q), (np.round(p), np.round(q))):
        order = assignment.order_by_exchanges(start, slots)
        assert sorted(order) == list(range(600))
        assert products(start, slots[order]).min() >= -1e-9


def show(n: int = 30, **keys: Any) -> Mission:
    """A tour that returns to its grid from the third formation."""
    phases: list[dict[str, Any]] = [
        {"kind": "fly", "position": [0, 0, 30.0], "duration": 8.0},
        {"kind": "establish", "formation": "ball", "blend": 6.0, "duration": 7.0},
        {"kind": "reshape", "formation": "coil", "blend": 6.0, "duration": 7.0},
        {"kind": "reshape", "formation": "grid", "blend": 6.0, "duration": 7.0},
        {"kind": "reshape", "formation": "ball", "blend": 6.0, "duration": 7.0},
    ]
    forms = {
        "ball": {"shape": "sphere", "size": 2.0, "edges": []},
        "coil": {"shape": "helix", "size": [4.0, 2.0, 2.0], "edges": []},
        "grid": {"shape": "grid", "size": 2.0, "edges": []},
    }
    agents = {"mass": 1.0, "radius": 0.1, "position": {"shape": "grid", "size": 2.0, "count": n}}
    return Mission.from_dict(
        {"schema_version": 1, "name": "tour", "assignment": "each", "agents": agents}
        | {"formations": forms, "phases": phases} | keys
    )  # fmt: skip


def test_a_certificate_is_the_least_separation_of_ten_thousand_samples():
    """Of each phase of a tour: the value, the pair and the time."""
    for planned in preview_phases(show())[0]:
        proof = planned.leg.certificate
        assert proof is not None
        assert proof.how == "closed form"
        apart = np.array([pdist(r).min() for r in planned.position]) - 0.2
        assert proof.separation <= apart.min() + 1e-9
        assert proof.separation == pytest.approx(apart.min(), abs=2e-3)
        k = int(np.abs(planned.time - proof.time).argmin())
        i, j = proof.agents
        there = np.linalg.norm(planned.position[k, i] - planned.position[k, j]) - 0.2
        assert there == pytest.approx(proof.separation, abs=2e-2)


def test_check_prints_the_certificate():
    """The least one in words, each as data, and which phases have none."""
    ahead = check(show())
    text = dict(ahead.describe())["separation, proved"]
    least = min(c.separation for c in ahead.certificates.values())
    assert f"worst {least:.3g} m" in text
    assert "closed form" in text
    assert [c["phase"] for c in ahead.data()["paths"]["certificates"]] == list(ahead.certificates)
    assert not check("establish-triangle").certificates  # distances alone guide it


def test_a_flight_records_its_certificates_and_keeps_them(tmp_path):
    """As flown, no phase is nearer than its certificate by more than a millimetre; the file says the same."""
    result = simulate(show())
    result.save(tmp_path / "tour.nc")
    result = Result.load(tmp_path / "tour.nc")
    for k, phase in enumerate(result.phases):
        assert phase.planned is not None
        assert result.separation[result.samples(k)].min() >= phase.planned["separation"] - 1e-3
    (found,) = [c for c in assess(result).checks if c.check == "separation_as_planned"]
    assert found.passed
    assert found.worst is not None
    assert found.worst <= 1e-3


def test_a_flight_nearer_than_planned_fails():
    """By more than the allowance; each such phase is named."""
    result = simulate("single-waypoint")
    planned = result.phases[1].planned
    assert planned is not None
    for more, passed in ((0.09, True), (0.11, False)):
        told = dict(planned, separation=planned["separation"] + more)
        result.phases[1] = replace(result.phases[1], planned=told)
        found = [c for c in assess(result).checks if c.check == "separation_as_planned"]
        assert [c.passed for c in found] == [passed]
        assert found[0].phase == "fly 2"


def test_the_allowance_is_the_missions():
    """The shipped mission in which downwash pushes vehicles states its own."""
    mission = load_mission("downwash-cube")
    assert mission.limits.separation_allowance == 0.2
    assert assess(simulate(mission)).passed


def test_a_formation_taken_again_keeps_its_name_where_its_slots_serve():
    """On the way back, and from where it was taken before; from elsewhere it gets another name."""
    data = show().to_dict()
    names = ["ball", "coil", "ball", "coil", "grid", "coil", "ball", "grid", "ball"]
    data["phases"] = [
        {"kind": "establish" if k == 0 else "reshape", "formation": name, "duration": 5.0}
        for k, name in enumerate(names)
    ]
    told = [phase.leads_to for phase in Mission.from_dict(data).phases]
    assert told == ["ball", "coil", "ball", "coil", "grid", "coil", "ball", "grid (2)", "ball"]
