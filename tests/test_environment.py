"""The environment to learn laws in: PettingZoo's own tests, and that its flights are those of `simulate`."""

from typing import Any

import numpy as np
import pytest
from test_own_laws import SLOTS, TRIANGLE, mission

import rigidfleet as rf
from rigidfleet.errors import FlightError
from rigidfleet.simulation.environment import FormationEnv
from rigidfleet.simulation.own_laws import View

NETWORK = {"delay": 0.02, "loss": 0.3}
NOISE = {"noise": {"position": 0.01, "velocity": 0.02, "rate": 50.0}}


def test_it_is_a_parallel_environment():
    """PettingZoo's tests of the interface and of seeds pass, through whole flights and resets."""
    from pettingzoo.test import parallel_api_test, parallel_seed_test

    def environment() -> FormationEnv:
        m = mission(NETWORK, disturbances=NOISE | {"lost": [{"agent": 3, "time": 0.5}]})
        return FormationEnv(m, numbers=2, scatter=0.1)

    parallel_api_test(environment(), num_cycles=150)
    parallel_seed_test(environment, num_cycles=150)


def proportional(observation: np.ndarray) -> np.ndarray:
    """A policy that returns to the slot, and towards neighbours as they were heard."""
    heard = observation[6:].reshape(-1, 10)
    pull = (heard[:, 0] * heard[:, 1] * 0.01 + heard[:, 9] * 0.1)[:, None] * heard[:, 3:6]
    return np.append(-0.4 * observation[:3] - 0.6 * observation[3:6] + 0.1 * pull.sum(axis=0), 0.5)


def test_a_policy_flies_in_simulate_as_it_does_here():
    """What an episode comes to is the flight of the same seeds under the policy's law, over all of its phases."""
    phases = [
        {"kind": "establish", "formation": "triangle", "duration": 1.013, "blend": 0.1},
        {"kind": "fly", "position": [3.0, 1.0, 21.0], "duration": 2.0},
    ]
    m = mission(NETWORK, disturbances=NOISE, phases=phases)
    env = FormationEnv(m, numbers=1)
    observations, _ = env.reset(seed=5)
    flown, steps = env.flight.mission, 0
    while env.agents:
        observations, _, _, over, _ = env.step(
            {a: proportional(observations[a]) for a in env.agents}
        )
        steps += 1
    assert all(over.values())
    assert steps == 151  # 3.013 s
    last = []

    def law(view: View) -> Any:
        last.append(view)
        return env.law(proportional)(view)

    result = rf.simulate(flown, agent=law)
    # The last state observed is that of the end; beside it stands what the law saw at its last tick.
    assert result.complete
    end = (
        result.position[-1] - result.slot_position[-1] if result.slot_position is not None else None
    )
    off = np.array([observations[a][:3] for a in env.possible_agents])
    np.testing.assert_allclose(off, end, atol=0.06)  # noise of 1 cm
    again = FormationEnv(m, numbers=1)
    observations, _ = again.reset(seed=5)
    for view in last[: 3 * 60]:
        np.testing.assert_array_equal(
            observations[f"agent_{view.agent + 1}"], again.observation(view)
        )
        if view.agent == 2:
            observations, *_ = again.step({a: proportional(observations[a]) for a in again.agents})


def test_rewards_are_errors_of_edges_and_slots():
    """Minus the mean error of a vehicle's own edges, and a share of what it is off its slot, as they truly are."""
    env = FormationEnv(mission(NETWORK, disturbances=NOISE), scatter=0.3, place=0.25)
    env.reset(seed=1)
    rng = np.random.default_rng(1)
    for _ in range(20):
        _, rewards, *_ = env.step({a: rng.uniform(-1, 1, 3).astype(np.float32) for a in env.agents})
    vehicles: Any = env.flight.under_way().propagator
    r = vehicles.sampled.S[:, :3]
    slots = np.array(SLOTS) - np.average(SLOTS, axis=0, weights=[1, 2, 3])
    slots += np.average(np.array(env.flight.mission.agents.position), axis=0, weights=[1, 2, 3])

    def off(i: int, j: int) -> float:
        return abs(float(np.linalg.norm(r[i] - r[j]) - np.linalg.norm(slots[i] - slots[j])))

    errors = [off(0, 1), 0.5 * (off(0, 1) + off(1, 2)), off(1, 2)]
    expected = [-e - 0.25 * np.linalg.norm(r[i] - slots[i]) for i, e in enumerate(errors)]
    np.testing.assert_allclose([rewards[a] for a in env.possible_agents], expected, atol=2e-3)


def test_a_seed_gives_starts_gusts_noise_and_losses():
    """The same seed begins the same flight, another one another."""
    env = FormationEnv(mission(NETWORK, disturbances=NOISE), scatter=0.2)
    starts = []
    for seed in (1, 2, 1):
        env.reset(seed=seed)
        flown = env.flight.mission
        assert flown.network is not None
        assert flown.disturbances is not None
        assert flown.disturbances.noise is not None
        starts.append((flown.network.seed, flown.disturbances.noise.seed, flown.agents.position))
    assert starts[0] == starts[2] != starts[1]
    assert np.abs(np.array(starts[0][2]) - TRIANGLE).max() < 1.0


def test_it_needs_a_network():
    """As `simulate` says."""
    with pytest.raises(FlightError, match=r"add \[network\]"):
        FormationEnv(mission(None))
