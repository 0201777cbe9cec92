"""A flight by hand: the user moves the target of the virtual body during the flight.

In each tick the reference follows the target smoothly along one piece of a quintic. The control laws
are the mission's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rigidfleet.errors import FlightError
from rigidfleet.math import attitude as att
from rigidfleet.mission import Establish, Hold, Mission, Phase, Reshape
from rigidfleet.planning.plan import PhasePlan
from rigidfleet.planning.reference import Pose
from rigidfleet.result import PhaseRecord, Result
from rigidfleet.simulation.flight import Flight
from rigidfleet.simulation.recording import assemble
from rigidfleet.typing import Floats
from rigidfleet.web.live.archive import Archive, rows

TICK = 0.05  # time between readings of the user's commands [s]
_BLEND = 4.0  # duration of a change of formation [s]
_ENDLESS = 1e6  # duration of a phase that the user ends [s]
_STEADY = 2.0  # time to settle after establishment by constraint forces alone [s]
#: The reference follows the target like a critically damped oscillator with this frequency [rad/s] ...
_FOLLOW = 1.3
#: ... and its acceleration changes over this time [s].
_RISE = 0.15
_ACCELERATION, _TURN = 3.0, 1.5  # greatest accelerations of the reference [m/s^2, rad/s^2]
_FINEST = 1e-3  # least time between stored samples [s]
#: Time without a command after which the controls count as released [s of mission time].
_GRIP = 0.6


@dataclass
class Target:
    """The target pose of the body, and its commanded rates."""

    r: Floats  # (3,) [m]
    euler: Floats  # (3,) roll, pitch, yaw [rad]
    move: Floats = field(default_factory=lambda: np.zeros(3))  # [m/s]
    turn: Floats = field(default_factory=lambda: np.zeros(3))  # rates of roll, pitch, yaw [rad/s]
    held: float = -math.inf  # time of the last command [s]

    @property
    def attitude(self) -> Floats:
        """Attitude (3, 3), world to body."""
        return att.dcm_from_euler(self.euler)


@dataclass(frozen=True)
class Gust:
    """A gust front that passes over the formation.

    Each vehicle feels one smooth pulse of force, 1 - cos, while the front passes it.
    """

    start: float  # [s]
    origin: float  # position of the front at the start, along its direction [m]
    direction: Floats  # (3,) unit vector
    strength: float  # greatest force [N/kg]
    speed: float = 8.0  # of the front [m/s]
    length: float = 1.6  # of the pulse [s]

    def force(self, t: float, r: Floats, masses: Floats) -> Floats:
        """Force (N, 3) [N] on vehicles at r (N, 3) [m]."""
        x = (t - self.start - (r @ self.direction - self.origin) / self.speed) / self.length
        pulse = np.where((x > 0.0) & (x < 1.0), 0.5 - 0.5 * np.cos(2 * math.pi * x), 0.0)
        return (self.strength * pulse * masses)[:, None] * self.direction


class Pilot:
    """A flight that advances tick by tick under the user's commands.

    Attributes
    ----------
    flight : the flight
    target : the target pose of the body
    formations : names of those that can be flown
    waiting : the next formation; None if there is none

    Raises
    ------
    FlightError
        No formation of the mission has slots.
    """

    def __init__(self, mission: Mission) -> None:
        self.formations = [n for n in mission.formations if mission.formation_slots(n) is not None]
        if not self.formations:
            raise FlightError(
                f"{mission.name}: the mission cannot be flown by hand, because no formation has slots."
                " Give one a shape or slots in the mission"
            )
        self.mission = mission
        self.masses = mission.fleet.mass
        self.archive = Archive(max(mission.output_step, _FINEST))
        self.flight = Flight(mission, force=self._wind, sampler=self._samples, flips=True)
        self.gusts: list[Gust] = []
        self.waiting: str | None = None
        self.by_body = mission.architecture == "body"
        self.fastest = 0.7 * mission.limits.speed if mission.limits.speed else math.inf
        self.asked: list[Phase] = []  # each phase as it was begun
        self.ticks = 0
        self._take(self._first(), establish=True)
        self.pose = self._reference()
        self.a, self.alpha = np.zeros(3), np.zeros(3)
        self.target = Target(self._up(self.pose.r), att.euler_from_dcm(self.pose.T) * [0, 0, 1])
        self.last: Result | None = None

    @property
    def t(self) -> float:
        """Mission time [s]."""
        return self.flight.t

    @property
    def phases(self) -> list[PhaseRecord]:
        """Records of the phases begun."""
        return self.flight.phases

    @property
    def ending(self) -> str:
        """Why the flight cannot go on, "" while it can."""
        return self.flight.ending

    @property
    def formation(self) -> str:
        """The current formation, or the one being formed."""
        return self.phases[-1].formation or ""

    @property
    def busy(self) -> bool:
        """Whether the formation is changing."""
        phase, settle = self.asked[-1], 0.0
        if phase.control == "open":
            settle = _STEADY
        blend = phase.shaping.least_time if phase.shaping is not None else 0.0
        return self.t < self.phases[-1].t_start + blend + settle - 1e-9

    # -- commands --------------------------------------------------------------------------------

    def steer(self, move: Floats, turn: Floats) -> None:
        """Move and turn the target at these rates (3,) [m/s, rad/s] until the next command; zero stops it."""
        speed = float(np.linalg.norm(move))
        self.target.move = move * min(1.0, self.fastest / speed) if speed > 0.0 else move
        self.target.turn, self.target.held = turn, self.t

    def change(self, formation: str) -> None:
        """Change to another formation as soon as the current change is complete."""
        self.waiting = formation if formation != self.formation else None

    def gust(self, direction: Floats, strength: float) -> None:
        """Send a gust along ``direction`` (3,), at most ``strength`` [N/kg]."""
        if self.ending:
            return
        d = direction / np.linalg.norm(direction)
        self.gusts.append(Gust(self.t, float((self._places() @ d).min()), d, strength))

    def step(self) -> Result:
        """Fly one tick; return the record of its end alone.

        A flight that cannot go on sets ``ending`` and stops.
        """
        flight = self.flight
        flight.pieces.clear()
        self.ticks += 1
        if not self.busy:
            if self.waiting is not None:
                self._take(self.waiting)
                self.waiting = None
            elif self.asked[-1].control == "open":
                self._hold()
        if not flight.ending:
            self._follow(TICK)
            flight.advance(self.ticks * TICK - self.t)
        if flight.pieces or self.last is None:
            end = [rows(flight.pieces[-1], [-1])] if flight.pieces else []
            # A record of one moment has no extremes
            phases = [replace(p, extremes={}) for p in self.phases]
            result = assemble(self.mission, phases, end, ending="", statistics={})
            result.mission = self.mission  # so that it is not parsed again
            self.last = result
            self.archive.add(flight.pieces, result)
        return self.last

    def result(self) -> Result:
        """The record of the whole flight, at the mission's output step, or a coarser one for a long flight.

        Its mission has the phases as they were flown.
        """
        ending = self.ending
        if not ending and self.busy:
            ending = f"ended by hand on the way to '{self.formation}'"
        result = self.flight.record(
            self.archive.pieces(), self.asked, step=self.archive.step, ending=ending
        )
        result.statistics["simulated_s"] = float(result.time[-1])
        return result

    # -- phases -----------------------------------------------------------------------------------

    def _first(self) -> str:
        names = [p.shaping.formation for p in self.mission.phases if p.shaping is not None]
        return next((n for n in names if n in self.formations), self.formations[0])

    def _take(self, formation: str, *, establish: bool = False) -> None:
        """Establish a formation, or change to it."""
        common: dict[str, Any] = {"formation": formation, "blend": _BLEND, "duration": _ENDLESS}
        if establish:
            common["control"] = "open" if self.by_body else "tracking"
            self._begin(Establish(kind="establish", name=f"establish {formation}", **common))
        else:
            common["control"] = "body" if self.by_body else "tracking"
            self._begin(Reshape(kind="reshape", name=f"change to {formation}", **common))

    def _hold(self) -> None:
        self._begin(Hold(kind="hold", name="by hand", duration=_ENDLESS, control="body"))
        if not self.ending:
            self.pose = self.flight.pose()
            self.a, self.alpha = np.zeros(3), np.zeros(3)

    def _begin(self, phase: Phase) -> None:
        if self.flight.begin(phase):
            self.asked.append(phase)

    def _samples(self, _plan: PhasePlan, t: float, t_end: float, **_: Any) -> Floats:
        """Multiples of the archive's step in (t, t_end], the end, and the start of a phase."""
        step = self.archive.step
        low, high = math.floor(t / step + 1e-9) + 1, math.floor(t_end / step + 1e-9) + 1
        grid = np.arange(low, high) * step
        begun = self.archive.begun(len(self.phases) - 1)
        start = [] if begun else [t and np.nextafter(t, math.inf)]
        return np.concatenate([start, grid[grid < t_end - 1e-9], [t_end]])

    def _places(self) -> Floats:
        """Positions (N, 3) [m] of the vehicles."""
        return self.flight.observe().position

    # -- the reference ----------------------------------------------------------------------------

    def _reference(self) -> Pose:
        """The pose that the first phase begins with."""
        flight, frame = self.flight, self.flight.plan.frame
        pose = flight.pose()
        if flight.plan.phase.control == "tracking":
            return pose
        seen = flight.observe()
        total = self.masses.sum()
        cm, v = self.masses @ seen.position / total, self.masses @ seen.velocity / total
        return Pose(cm, v, frame if frame is not None else np.eye(3), np.zeros(3))

    def _up(self, r: Floats) -> Floats:
        """A point (3,) [m] at or above ``r``, high enough for the first formation to rotate about it."""
        slots = self.flight.plan.slots
        assert slots is not None  # every formation flown has slots
        size = np.linalg.norm(slots, axis=1).max() + max(self.mission.agents.radius)
        ground = max(
            (o.height for o in self.mission.obstacles if o.kind == "ground"), default=-np.inf
        )
        return np.array([r[0], r[1], max(r[2], ground + size + 0.5)])

    def _follow(self, h: float) -> None:
        """Move the target as commanded, and the reference after it, over the next tick."""
        target, pose = self.target, self.pose
        if self.t - target.held <= _GRIP:
            target.r += h * target.move
            target.euler += h * target.turn
            target.euler[1] = np.clip(target.euler[1], -1.2, 1.2)  # clear of the poles
        away = att.rotation_vector_from_dcm(target.attitude @ pose.T.T)  # body axes
        r, v, a = _pulled(target.r - pose.r, pose.v, self.a, h, _ACCELERATION)
        phi, omega, alpha = _pulled(away, pose.omega, self.alpha, h, _TURN)
        if self.asked[-1].control != "open":
            self.flight.steer(
                h,
                pose,
                (r, v, a),
                (phi, omega, alpha),
                a=self.a,
                alpha=self.alpha,
                force=self._windy(),
            )
            T = att.dcm_from_rotation_vector(phi) @ pose.T
            self.pose = Pose(pose.r + r, v, T, omega)
            self.a, self.alpha = a, alpha

    # -- wind -------------------------------------------------------------------------------------

    def _windy(self) -> bool:
        """Remove gusts that have passed; return whether one remains."""
        if not self.gusts:
            return False
        r, t = self._places(), self.t
        self.gusts = [
            g
            for g in self.gusts
            if t < g.start + g.length + (float((r @ g.direction).max()) - g.origin) / g.speed + 1.0
        ]
        return bool(self.gusts)

    def _wind(self, t: float, r: Floats, _v: Floats) -> Floats:
        force = np.zeros_like(r)
        for gust in self.gusts:
            force += gust.force(t, r, self.masses)
        return force


def _pulled(
    away: Floats, v: Floats, a: Floats, h: float, most: float
) -> tuple[Floats, Floats, Floats]:
    """Displacement over h [s], and final velocity and acceleration, of a reference drawn to a point ``away``.

    It moves like a critically damped oscillator, with a continuous acceleration of at most ``most``.
    """
    wanted = _FOLLOW**2 * away - 2 * _FOLLOW * v
    size = float(np.linalg.norm(wanted))
    if size > most:
        wanted = wanted * (most / size)
    after = a + (wanted - a) * min(1.0, h / _RISE)
    return h * v + h**2 * (2 * a + after) / 6, v + h * (a + after) / 2, after
