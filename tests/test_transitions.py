"""Transitions of agents with slots of their own, whose straight ways cross."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from rigidfleet import assess, check, simulate
from rigidfleet.errors import MissionError
from rigidfleet.mission import Mission
from rigidfleet.planning.preview import preview_phases
from rigidfleet.planning.timing import complete_times


def permuted(side: int = 5, seed: int = 0, limit: float = 1.0, **reshape: Any) -> Mission:
    """A grid of 2 m whose agents exchange their places at random, aloft."""
    x, y = np.divmod(np.arange(side * side), side)
    grid = np.stack([2.0 * x, 2.0 * y, 0.0 * x], axis=1)
    order = np.random.default_rng(seed).permutation(len(grid))
    swap = {"kind": "reshape", "name": "swap", "formation": "b", "transition": "layers"}
    return Mission.from_dict(
        {
            "schema_version": 1,
            "name": "permuted",
            "agents": {"mass": 1.0, "radius": 0.1, "position": grid + [0, 0, 30]},
            "formations": {
                "a": {"slots": grid, "edges": []},
                "b": {"slots": grid[order], "edges": []},
            },
            "limits": {"separation": limit},
            "phases": [
                {"kind": "establish", "formation": "a", "blend": 1.0, "duration": 1.0},
                swap | {"blend": 20.0, "duration": 21.0} | reshape,
            ],
        }
    )


@pytest.mark.parametrize("seed", range(3))
def test_labelled_agents_exchange_their_places(seed):
    """Straight ways collide; by layers every pair keeps the limit, as proved, planned and flown, and all arrive."""
    mission = permuted(seed=seed)
    assert not check(Mission.from_dict(permuted(seed=seed, transition="straight").to_dict())).passed
    ahead = check(mission)
    assert ahead.passed
    assert list(ahead.certificates)[1:] == ["swap: apart", "swap: across", "swap: together"]
    assert min(c.separation for c in ahead.certificates.values()) >= 1.0
    result = simulate(mission)
    assert assess(result).passed
    assert min(pdist(r).min() for r in result.position) - 0.2 >= 1.0
    end = np.array(mission.formation_slots("b"))
    r = result.position[-1]
    np.testing.assert_allclose(r - r.mean(axis=0), end - end.mean(axis=0), atol=1e-3)
    assert result.time[-1] == pytest.approx(22.0)


def test_the_parts_are_ordinary_phases():
    """Written and read again, they are the same mission; the record of a flight holds them."""
    mission = complete_times(permuted(3))
    again = Mission.from_dict(mission.to_dict())
    assert [p.name for p in again.phases] == [p.name for p in mission.phases]
    assert complete_times(again) is again
    result = simulate(permuted(3))
    assert Mission.from_toml(result.mission_text).phases == mission.phases


def test_levels_are_told_by_conflicts_alone():
    """On the way across, agents of one level pass each other at the distance asked, seen from above."""
    mission = complete_times(permuted(6, seed=4))
    one, two = (np.array(mission.formation_slots(f"swap: {part}")) for part in ("apart", "across"))
    np.testing.assert_allclose(one[:, 2], two[:, 2])
    levels = np.unique(one[:, 2])
    assert 1 < len(levels) < 18
    np.testing.assert_allclose(np.diff(levels), 0.2 + 1.0 + 0.1)
    s = np.linspace(0.0, 1.0, 501)[:, None, None]
    for level in levels:
        same = one[:, 2] == level
        if same.sum() > 1:
            ways = (1 - s) * one[same] + s * two[same]
            assert min(pdist(w).min() for w in ways) >= 1.3 - 1e-3


def test_auto_goes_straight_where_it_can():
    """One place on, all move together: no layers are needed. Where they cross, there are."""
    data = permuted(transition="auto").to_dict()
    assert len(complete_times(Mission.from_dict(data)).phases) == 4
    data["formations"]["b"]["slots"] = [
        [x + 2.0, y, z] for x, y, z in data["formations"]["a"]["slots"]
    ]
    assert [p.name for p in complete_times(Mission.from_dict(data)).phases] == [
        "establish 1",
        "swap",
    ]


def test_automatic_times_are_shared_out():
    """Each part takes the least time that keeps the limits."""
    data = permuted(4).to_dict()
    data |= {"smoothness": "jerk"}
    data["phases"][1] |= {"blend": "auto", "duration": "auto"}
    data["limits"] |= {"speed": 2.0, "acceleration": 1.0}
    mission = complete_times(Mission.from_dict(data))
    for planned, phase in list(zip(preview_phases(mission)[0], mission.phases, strict=True))[1:]:
        assert isinstance(phase.least_time, float)
        speed = np.linalg.norm(planned.velocity, axis=2).max()
        acceleration = np.linalg.norm(planned.acceleration, axis=2).max()
        assert speed <= 2.0 * 1.001
        assert acceleration <= 1.0 * 1.001
        assert max(speed / 2.0, acceleration) >= 0.95
    for a, b in pairwise(preview_phases(mission)[0]):
        np.testing.assert_allclose(a.position[-1], b.position[0], atol=1e-9)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"limit": 2.0}, "come within"),
        ({"control": "open"}, "needs slots that are tracked"),
        ({"alignment": "none"}, "chooses the alignment itself"),
    ],
)
def test_what_cannot_be_is_refused(keys, words):
    """A separation that the slots themselves lack, and phases that track no slots."""
    with pytest.raises(MissionError, match=words):
        complete_times(permuted(**keys))


def test_assigned_agents_need_no_layers():
    """Where an assignment chooses the slots, layers are refused."""
    with pytest.raises(MissionError, match="assignment chooses their slots"):
        Mission.from_dict(permuted().to_dict() | {"assignment": "each"})


def test_a_way_without_alignment_is_straight_in_the_axes_of_the_body():
    """A square whose slots are turned by 90 degrees would only turn; without alignment agents go across."""
    square = np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    for alignment, least in (("fit", np.sqrt(2)), ("none", 1.0)):
        data = permuted(transition="straight", alignment=alignment).to_dict()
        data["agents"]["position"] = (square + [0, 0, 30]).tolist()
        data["formations"]["a"]["slots"] = square.tolist()
        data["formations"]["b"]["slots"] = np.roll(square, 1, axis=0).tolist()
        radii = np.linalg.norm(
            preview_phases(Mission.from_dict(data))[0][1].position[..., :2], axis=2
        )
        assert radii.min() == pytest.approx(least, abs=1e-6)
