"""An environment to learn laws of vehicles' own in, by the parallel interface of PettingZoo.

What is learnt flies elsewhere: `FormationEnv.law` makes of a policy a law for `rigidfleet.simulate`, which judges it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from rigidfleet.errors import FlightError
from rigidfleet.mission import Mission, as_mission
from rigidfleet.planning.vehicles import network_of
from rigidfleet.simulation.active_phase import ActivePhase
from rigidfleet.simulation.flight import Flight
from rigidfleet.simulation.own_laws import View
from rigidfleet.simulation.sampled_propagator import SampledPropagator
from rigidfleet.typing import Floats

Vector = NDArray[np.float32]
#: Numbers of an observation for the vehicle itself, and for each neighbour.
_SELF, _NEIGHBOUR = 6, 9
#: Times that differ by less are the same [s].
_SAME = 1e-9


class FormationEnv(ParallelEnv[str, Vector, Vector]):
    """A mission as a parallel environment: an agent a vehicle, a step a tick of the laws, an episode a flight.

    *An action* is the acceleration [1] beyond that of the slot and gravity's, in units of ``acceleration``, and some
    ``numbers`` to say; all within -1 and 1. A vehicle's message is its position, its velocity and these numbers.

    *An observation* is what a vehicle is off its slot (3) [m], (3) [m/s], and of each neighbour, by number: 1 if it has
    been heard of, else nine zeros and no numbers; the age of its message [s], the length of their edge [m] (0: none),
    where (3) [m] and how fast (3) [m/s] it was relative to the vehicle of now, and its numbers.

    *A reward* is minus the mean error of the lengths of a vehicle's edges [m], and minus ``place`` times its distance
    from its slot [m], both as they truly are.

    A vehicle that is lost is terminated, and all are where the flight cannot go on; the end of the mission truncates.

    Parameters
    ----------
    mission : a shipped name, a path or a `Mission`, with [network]
    numbers : how many numbers each vehicle may say
    acceleration : that of an action of 1 [m/s^2]
    scatter : standard deviation of the start about that of the mission, in each coordinate [m]
    place : weight of the distance from the slot in the reward

    Raises
    ------
    MissionError
        The mission does not exist, or has errors.
    FlightError
        It has no network.
    """

    metadata: dict[str, Any] = {"name": "rigidfleet", "render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        mission: Mission | str | Path,
        *,
        numbers: int = 0,
        acceleration: float = 5.0,
        scatter: float = 0.0,
        place: float = 0.1,
    ) -> None:
        self.mission = as_mission(mission)
        self.numbers, self.acceleration, self.scatter, self.place = (
            numbers, acceleration, scatter, place,
        )  # fmt: skip
        self.possible_agents = [f"agent_{i + 1}" for i in range(self.mission.n_agents)]
        self.agents: list[str] = []
        Flight(self.mission, agent=self._act)  # or it says why not
        net, self.dt = network_of(self.mission), 1.0 / self.mission.autopilot.formation_rate
        #: Neighbours of each vehicle, in the order of an observation.
        self.neighbours = [x.tolist() for x in np.split(net.links[:, 1], net.first[1:-1])]
        self.width = _NEIGHBOUR + numbers
        self.size = _SELF + max(map(len, self.neighbours)) * self.width
        #: Spaces of an observation and of an action, those of all agents.
        self.seen = Box(-np.inf, np.inf, (self.size,), np.float32)
        self.acts = Box(-1.0, 1.0, (3 + numbers,), np.float32)
        self.silence = np.zeros(numbers)
        self.rng = np.random.default_rng()
        self._actions: dict[str, Vector] = {}

    def observation_space(self, agent: str) -> Space[Vector]:
        """The space of observations of an agent."""
        return self.seen

    def action_space(self, agent: str) -> Space[Vector]:
        """The space of actions of an agent."""
        return self.acts

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Vector], dict[str, dict[str, Any]]]:
        """Begin another flight, with gusts, noise, losses and starts of its own; the same ones for the same seed."""
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        document = self.mission.to_dict()
        around = document.get("disturbances", {})
        for table in (document["network"], around.get("gusts"), around.get("noise")):
            if table is not None:
                table["seed"] = int(self.rng.integers(1 << 31))
        if self.scatter:
            start = self.mission.fleet.position
            start = start + self.rng.normal(0.0, self.scatter, start.shape)
            document["agents"]["position"] = start.tolist()
        self.flight = Flight(
            Mission.from_dict(document), agent=self._act, sampler=lambda *_, **__: np.zeros(0)
        )
        self.ticks = 0
        if not self.flight.begin():
            raise FlightError(self.flight.ending)
        self.agents = list(self.possible_agents)
        return self._observations(self.flight.under_way()), {name: {} for name in self.agents}

    def step(self, actions: dict[str, Vector]) -> tuple[
        dict[str, Vector], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:  # fmt: skip
        """Fly on to the next tick of the laws: observations, rewards, terminations, truncations and infos."""
        flight, self._actions, self.ticks = self.flight, actions, self.ticks + 1
        active, until, goes_on = flight.under_way(), self.ticks * self.dt, True
        while goes_on and flight.t < until - _SAME:
            goes_on = flight.advance(until - flight.t) or flight.begin()
            active = flight.under_way() if goes_on else active
        observations, rewards = self._observations(active), self._rewards(active)
        failed = {name: bool(flight.ending) or name not in observations for name in self.agents}
        over = dict.fromkeys(self.agents, not goes_on and not flight.ending)
        last = self.agents
        self.agents = [name for name in last if goes_on and not failed[name]]
        none = np.zeros(self.size, dtype=np.float32)  # of one that is lost
        return (
            {name: observations.get(name, none) for name in last}, {name: rewards[name] for name in last},
            failed, over, {name: {} for name in last},
        )  # fmt: skip

    def law(self, policy: Callable[[Vector], Any]) -> Callable[[View], tuple[Floats, Floats]]:
        """A law for `rigidfleet.simulate` of a policy, which returns the action of an observation."""
        return lambda view: self.answer(view, policy(self.observation(view)))

    def observation(self, view: View) -> Vector:
        """The observation of what a vehicle knows."""
        out, r, v = np.zeros(self.size), view.position, view.velocity
        if not math.isnan(view.reference_position[0]):
            out[:3], out[3:_SELF] = r - view.reference_position, v - view.reference_velocity
        own, row = np.concatenate([r, v, self.silence]), _SELF
        for j in self.neighbours[view.agent]:
            if message := view.inbox.get(j):
                out[row : row + 3] = 1.0, message.age, view.distance.get(j, 0.0)
                out[row + 3 : row + self.width] = message.content - own
            row += self.width
        return out.astype(np.float32)

    def answer(self, view: View, action: Sequence[float] | Vector) -> tuple[Floats, Floats]:
        """Force [N] and message of a vehicle by an action."""
        clipped = np.minimum(np.maximum(np.asarray(action, dtype=float), -1.0), 1.0)
        a = self.acceleration * clipped[:3]
        if not math.isnan(view.reference_acceleration[0]):
            a += view.reference_acceleration
        a[2] += view.gravity
        return view.mass * a, np.concatenate([view.position, view.velocity, clipped[3:]])

    def _act(self, view: View) -> tuple[Floats, Floats]:
        return self.answer(view, self._actions[self.possible_agents[view.agent]])

    def _observations(self, active: ActivePhase) -> dict[str, Vector]:
        """Observations of all vehicles that fly."""
        assert isinstance(active.propagator, SampledPropagator)
        views = [view for view in active.propagator.views_of_laws() if view is not None]
        return {self.possible_agents[view.agent]: self.observation(view) for view in views}

    def _rewards(self, active: ActivePhase) -> dict[str, float]:
        """Rewards of all vehicles, at their true states."""
        w, n, flown = active.integration.workspace, len(self.possible_agents), active.propagator
        assert isinstance(flown, SampledPropagator)
        r, edge = flown.sampled.S[:, :3], flown.sampled.mail.edge
        held = edge >= 0
        i, j = flown.flight.network.links[held].T
        apart = r[i] - r[j]
        off = np.abs(np.sqrt((apart * apart).sum(axis=1)) - w.d[edge[held]])
        error = np.bincount(i, off, n) / np.maximum(np.bincount(i, minlength=n), 1)
        if active.plan.problem.control.tracks_slots:
            error += self.place * np.linalg.norm(r - w.r_ref, axis=1)
        return dict(zip(self.possible_agents, (-error).tolist(), strict=True))
