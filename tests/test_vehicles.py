"""Vehicles of a mission: their numbers, and what a mission may not say of them."""

import math

import numpy as np
import pytest

from rigidfleet.errors import MissionError
from rigidfleet.mission import Mission
from rigidfleet.mission.schema import Vehicle
from rigidfleet.mission.vehicles import MODELS, model_of_vehicle

PLACES = [[0.0, 0.0, 5.0], [4.0, 0.0, 5.0], [0.0, 4.0, 5.0]]


def mission(vehicles=None, **changes):
    """A mission of three vehicles that hold; ``changes`` are other tables, or keys of [agents] after "agents_"."""
    agents = {"vehicle": "drone", "position": PLACES}
    agents |= {key[7:]: value for key, value in changes.items() if key.startswith("agents_")}
    data = {
        "schema_version": 1, "name": "m", "agents": {k: v for k, v in agents.items() if v is not None},
        "vehicles": {"drone": {"model": "paper"}} if vehicles is None else vehicles,
        "phases": [{"kind": "hold", "duration": 1.0}],
    }  # fmt: skip
    data |= {key: value for key, value in changes.items() if not key.startswith("agents_")}
    return Mission.from_dict(data)


def refusal(*arguments, **changes) -> str:
    with pytest.raises(MissionError) as error:
        mission(*arguments, **changes)
    return str(error.value)


@pytest.mark.parametrize("position", [None, [], 3])
@pytest.mark.parametrize("names", ["drone", ["drone"]])
def test_positions_that_are_wrong_are_told_and_no_names_of_vehicles(position, names):
    """Where the number of agents is not known, the finding is about their positions, not about their vehicles."""
    with pytest.raises(MissionError) as error:
        mission(agents_position=position, agents_vehicle=names)
    assert [finding.key for finding in error.value.findings] == ["agents.position"]


@pytest.mark.parametrize("name", MODELS)
def test_models_can_fly(name):
    """Each model hovers well below its limit, has a source for each number, and a stable attitude control."""
    model = model_of_vehicle(Vehicle(model=name))
    assert 0.05 < model.mass * 9.81 / model.thrust_limit < 0.6
    assert all(source for _, source in MODELS[name].values())
    k_R, k_omega = model.attitude_gains
    poles = np.roots([max(model.motor_time), 1.0, k_omega, k_R])
    assert poles.real.max() < 0.0


def test_the_paper_gives_mass_and_thrust():
    """The paper's vehicle has a kilogram and four rotors of 5.9 N; what the paper leaves open is marked as chosen."""
    model = model_of_vehicle(Vehicle(model="paper"))
    assert (model.mass, model.rotor_thrust_limit) == (1.0, pytest.approx(5.9))
    chosen = {key for key, (_, source) in MODELS["paper"].items() if source.startswith("chosen")}
    assert chosen == set(MODELS["paper"]) - {"mass", "thrust_coefficient"}


def test_a_vehicle_gives_mass_limit_and_drag():
    """Mass and thrust limit of each agent are those of its vehicle; a number given replaces the model's."""
    heavy = {"model": "paper", "mass": 1.5}
    both = {"light": {"model": "hummingbird"}, "heavy": heavy}
    found = mission(both, agents_vehicle=["light", "heavy", "heavy"])
    np.testing.assert_allclose(found.fleet.mass, [0.5, 1.5, 1.5])
    np.testing.assert_allclose(found.fleet.thrust_limit, [4 * 5.57e-6 * 1500**2, 23.6, 23.6])
    models = found.vehicle_models
    assert models is not None
    hover = math.sqrt(0.5 * 9.81 / 4 / 5.57e-6)
    assert models[0].linear_drag[0] == pytest.approx(4 * 1.19e-4 * hover)
    np.testing.assert_allclose(found.drag, [m.linear_drag[0] for m in models])
    assert found.to_dict()["agents"]["vehicle"] == ["light", "heavy", "heavy"]


def test_points_without_vehicles_stay_as_they_are():
    """Without vehicles there are none, and mass is required as before."""
    found = mission({}, agents_vehicle=None, agents_mass=1.0)
    assert found.vehicle_models is None
    assert "agents.mass" in refusal({}, agents_vehicle=None)


@pytest.mark.parametrize(
    ("vehicles", "changes", "words"),
    [
        (None, {"agents_vehicle": "drne"}, ("there is no vehicle 'drne'", "'drone'")),
        (None, {"agents_vehicle": ["drone"]}, ("1 entries for 3 agents",)),
        (None, {"agents_vehicle": 3}, ("is not a name",)),
        (None, {"agents_mass": 1.0}, ("agents.mass", "given twice", "vehicles.NAME")),
        (None, {"agents_thrust_limit": 9.0}, ("agents.thrust_limit", "given twice")),
        (None, {"agents_saturate": True}, ("agents.saturate", "no effect")),
        (None, {"disturbances": {"drag": 0.1, "wind": [1.0, 0.0, 0.0]}}, ("disturbances.drag", "given twice")),
        (None, {"gravity": 0.0}, ("gravity", "must be >= 1")),
        (None, {"formulation": "body"}, ("formulation", "inertial")),
        (None, {"autopilot": {"formation_rate": 300.0}}, ("autopilot.formation_rate", "250 Hz")),
        (None, {"autopilot": {"rate": 100.0, "formation_rate": 400.0}}, ("100 Hz",)),
        (None, {"agents_vehicle": None, "agents_mass": 1.0}, ("no agent flies any", "vehicle = 'drone'")),
        ({"drone": {"model": "papre"}}, {}, ("vehicles.drone.model", "'papre'")),
        ({"drone": {"model": "paper", "masss": 1.0}}, {}, ("vehicles.drone.masss", "'mass'")),
        ({"drone": {"model": "paper", "mass": 3.0}}, {}, ("cannot hover", "23.6 N")),
        ({"drone": {"model": "paper", "drag": 0.1}}, {}, ("vehicles.drone.drag", "points alone")),
        ({"drone": {"model": "paper", "rotor_speed": [9.0, 1.0]}}, {}, ("rotor_speed", "swap")),
        ({"drone": {"model": "paper", "rotor_speed": [900.0, 1000.0]}}, {}, ("in hover",)),
        ({"drone": {"model": "paper", "attitude_gains": [544.0, 5.0]}}, {}, ("attitude_gains", "unstable")),
        ({"drone": {"model": "paper", "motor_time": [0.2, 0.2]}}, {}, ("[544.0, 46.64]", "quicker motors")),
        ({"drone": {"model": "point"}}, {}, ("needs a mass",)),
        ({"drone": {"model": "point", "mass": 1.0, "arm": 0.1}}, {}, ("arm", "no effect on a point")),
        ({"drone": {"model": "paper"}, "spare": {"model": "x500"}}, {}, ("vehicles.spare", "no agent flies it")),
    ],
)  # fmt: skip
def test_what_a_mission_may_not_say(vehicles, changes, words):
    """Each mistake is one sentence with the key, the value and the remedy."""
    told = refusal(vehicles, **changes)
    assert all(word in told for word in words), told


@pytest.mark.parametrize(
    ("table", "key"),
    [
        ({"tracking": {"integral": 0.1}}, "tracking.integral"),
        ({"tracking": {"drag_feedforward": True}}, "tracking.drag_feedforward"),
        ({"disturbances": {"noise": {"delay": 0.02}}}, "disturbances.noise.delay"),
        ({"disturbances": {"noise": {"position": 0.01, "dropped": 0.1}}}, "noise.dropped"),
        ({"network": {"delay": 0.05}}, "network"),
        ({"autopilot": {"rate": 100.0}}, "autopilot"),
    ],
)
def test_sampled_control_needs_vehicles(table, key):
    """What only sampled control knows is refused for points that give any force at once, and taken by vehicles."""
    told = refusal({}, agents_vehicle=None, agents_mass=1.0, **table)
    assert key in told
    if key != "autopilot":
        mission(None, **table)
