"""Balls that a person pushes into a flight by hand: where each is, where it was, and what it is in the record."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rigidfleet.mission import obstacles
from rigidfleet.typing import Floats

#: Greatest number of balls at the same time, and in a flight.
AT_ONCE, IN_A_FLIGHT = 8, 100
#: Least and greatest radius [m], greatest speed [m/s], and least distance from every vehicle where a ball appears [m].
SMALLEST, LARGEST, QUICKEST, ROOM = 0.1, 5.0, 5.0, 1.0
#: A ball that is drawn comes to its goal within about this time [s], and stops nearer than this [m].
_DRAWN, _THERE = 0.2, 1e-3


@dataclass
class Ball:
    """A ball in the flight: at rest, flying straight, or drawn to a goal.

    Attributes
    ----------
    slot : its number on the page, from 0, which another may have later
    turns : times and places at which its velocity changed
    """

    number: int  # from 1, through the whole flight
    slot: int
    radius: float  # [m]
    place: Floats  # (3,) [m]
    velocity: Floats  # (3,) [m/s]
    since: float  # [s]
    until: float | None = None  # [s]
    goal: Floats | None = None  # (3,) [m]
    turns: list[tuple[float, Floats]] = field(default_factory=list)
    changed: bool = True  # whether the flight does not know its velocity yet

    @property
    def name(self) -> str:
        """Its name in messages and in the record."""
        return f"ball {self.number}"

    def steer_to_goal(self) -> None:
        """Choose the velocity of the next tick; a ball that is drawn follows its goal."""
        if self.goal is None:
            return
        away = self.goal - self.place
        far = float(np.linalg.norm(away))
        speed = min(far / _DRAWN, QUICKEST)
        self.set_velocity(away / far * speed if far > _THERE else np.zeros(3))

    def set_velocity(self, velocity: Floats) -> None:
        """Fly on with another velocity (3,) [m/s]."""
        if not np.array_equal(velocity, self.velocity):
            self.velocity, self.changed = velocity, True

    def note_way_corner(self, t: float) -> None:
        """Note where its velocity changes, at t [s]."""
        self.turns.append((t, self.place.copy()))
        self.changed = False

    def move(self, h: float) -> None:
        """Move on for h [s]."""
        self.place = self.place + h * self.velocity

    def sphere_flying_on(self, t: float) -> obstacles.Sphere:
        """The obstacle from t [s] on, if nobody pushes it."""
        return self._sphere_on_way([(t, self.place), (t + 1e3, self.place + 1e3 * self.velocity)])

    def flown_sphere(self, t: float) -> obstacles.Sphere:
        """The obstacle as it was up to t [s], for the record."""
        end = t if self.until is None else self.until
        ways = [*self.turns, (end, self.place)] if end > self.turns[-1][0] + 1e-6 else self.turns
        return self._sphere_on_way(ways)

    def _sphere_on_way(self, ways: list[tuple[float, Floats]]) -> obstacles.Sphere:
        if len(ways) == 1:
            ways = [*ways, (ways[0][0] + 1.0, ways[0][1])]
        vanishing: dict[str, Any] = {} if self.until is None else {"vanishes": self.until}
        return obstacles.Sphere(
            kind="sphere",
            name=self.name,
            radius=self.radius,
            waypoints=tuple(tuple(place.tolist()) for _, place in ways),
            times=tuple(float(t) for t, _ in ways),
            appears=self.since,
            **vanishing,
        )
