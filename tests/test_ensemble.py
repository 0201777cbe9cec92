"""Many flights at once: `rigidfleet.simulation.ensemble` and `rigidfleet.kernel.engine.batch`."""

import numpy as np
import pytest

from rigidfleet.mission import Mission, load_mission
from rigidfleet.simulation.ensemble import establish
from rigidfleet.simulation.flight import simulate


def table_1(end: float = 10.0) -> Mission:
    """The paper's Table 1 to a time within its second phase."""
    data = load_mission("establish-triangle").to_dict()
    data["phases"] = data["phases"][:2]
    data["phases"][1]["until"] = end
    return Mission.from_dict(data)


def starts(mission: Mission, count: int, spread: float = 0.3) -> np.ndarray:
    """Positions about the mission's own."""
    r = np.array(mission.agents.position)
    return r + np.random.default_rng(5).uniform(-spread, spread, (count, *r.shape))


@pytest.mark.parametrize("vectors", [False, True])
def test_each_flight_is_that_of_a_mission_with_its_start(vectors: bool):
    """Positions, velocities and errors are those of `simulate`, from each start, within tolerance."""
    mission = table_1()
    position = starts(mission, 11)
    velocity = 0.1 * starts(mission, 11)[::-1]
    found = establish(mission, position, velocity, vectors=vectors)
    assert found.finished.all()
    assert found.vectors is vectors
    data = mission.to_dict()
    for k in (0, 7, 8, 10):
        data["agents"] |= {"position": position[k].tolist(), "velocity": velocity[k].tolist()}
        one = simulate(Mission.from_dict(data))
        np.testing.assert_allclose(found.position[k], one.position[-1], rtol=0, atol=1e-7)
        np.testing.assert_allclose(found.velocity[k], one.velocity[-1], rtol=0, atol=1e-7)
        lengths = [
            np.linalg.norm(found.position[k, i] - found.position[k, j]) for i, j in one.edges
        ]
        wanted = mission.formation_distances("line")
        assert found.error[k] == pytest.approx(np.abs(lengths - wanted).max(), abs=1e-12)


@pytest.mark.parametrize("vectors", [False, True])
def test_threads_and_neighbours_in_other_vectors_change_no_bit(vectors: bool):
    """One thread or three, 19 flights or the first 16 of them: flight k is the same, bit for bit."""
    mission = table_1()
    position = starts(mission, 19)
    whole = establish(mission, position, vectors=vectors, threads=1)
    shared = establish(mission, position, vectors=vectors, threads=3)
    first = establish(mission, position[:16], vectors=vectors, threads=2)
    np.testing.assert_array_equal(whole.position, shared.position)
    np.testing.assert_array_equal(whole.velocity, shared.velocity)
    np.testing.assert_array_equal(whole.position[:16], first.position)


def test_a_flight_that_fails_takes_nobody_along():
    """Of eight flights in a vector one begins with two agents at one place: the others are flown again alone."""
    mission = table_1()
    position = starts(mission, 16)
    position[3, 1] = position[3, 0]
    found = establish(mission, position, vectors=True)
    assert found.finished.tolist() == [k != 3 for k in range(16)]
    others = [k for k in range(16) if k != 3]
    alone = establish(mission, position, vectors=False)
    np.testing.assert_allclose(found.position[others], alone.position[others], rtol=0, atol=1e-7)
    without = establish(mission, position[8:], vectors=True)
    np.testing.assert_array_equal(found.position[8:], without.position)


def test_what_fits_no_vector_flies_alone():
    """Sixteen agents, all joined, have too many equations for straight-line code; three have not."""
    mission = table_1()
    assert establish(mission, starts(mission, 3)).vectors
    data = mission.to_dict()
    x, y = np.divmod(np.arange(16), 4)
    slots = 4.0 * np.stack([x, y, 0.3 * (x + y) ** 2], axis=1)
    data |= {
        "agents": {"mass": 1.0, "position": slots.tolist()},
        "formations": {"sheet": {"slots": slots.tolist(), "edges": "complete"}},
        "phases": [
            data["phases"][0]
            | {"formation": "sheet", "reference": "squares", "until": 0.1, "blend": 0.05}
        ],
    }
    many = Mission.from_dict(data)
    assert not establish(many, starts(many, 2)).vectors
    with pytest.raises(ValueError, match="cannot share vectors"):
        establish(many, starts(many, 2), vectors=True)


@pytest.mark.parametrize("vectors", [False, True])
def test_one_agent_has_no_distances(vectors: bool):
    """It falls through none: pushed for a second, it is where the force has taken it."""
    data = table_1().to_dict()
    data |= {
        "agents": {"mass": 2.0, "position": [[0.0, 0.0, 5.0]]},
        "formations": {"alone": {"slots": [[0.0, 0.0, 0.0]], "edges": []}},
        "phases": [data["phases"][0] | {"formation": "alone", "until": 1.0, "blend": 0.5}],
    }
    data["phases"][0]["input_force"] = [1.0, 0.0, 0.0]
    found = establish(Mission.from_dict(data), [[[0.0, 0.0, 5.0]]], vectors=vectors)
    np.testing.assert_allclose(found.position, [[[0.25, 0.0, 5.0]]], atol=1e-9)
    assert found.error.tolist() == [0.0]


def test_what_it_cannot_fly_is_refused():
    """Other phases than open-loop ones, disturbances, and starts of another shape are told apart."""
    passage = load_mission("narrow-passage")
    with pytest.raises(ValueError, match=r"phase 2 .* open-loop"):
        establish(passage, starts(passage, 2))
    mission = table_1()
    with pytest.raises(ValueError, match=r"position must be \(B, 3, 3\)"):
        establish(mission, np.zeros((2, 4, 3)))
    with pytest.raises(ValueError, match="the same shape"):
        establish(mission, starts(mission, 2), starts(mission, 3))
    windy = Mission.from_dict(mission.to_dict() | {"disturbances": {"wind": [1.0, 0.0, 0.0]}})
    with pytest.raises(ValueError, match="calm air"):
        establish(windy, starts(windy, 2))
    for change, why in (
        ({"formulation": "body"}, "world axes"),
        ({"assignment": "shortest"}, "slots as given"),
    ):
        other = Mission.from_dict(mission.to_dict() | change)
        with pytest.raises(ValueError, match=why):
            establish(other, starts(other, 2))
    broken = starts(mission, 4)
    broken[2, 1, 0] = np.nan
    with pytest.raises(ValueError, match="flight 2 is not finite"):
        establish(mission, broken)
