"""A flight by hand: the user moves the target of the virtual body, and pushes balls in, during the flight.

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
from rigidfleet.math import proximity
from rigidfleet.mission import Mission, Phase
from rigidfleet.mission.kinds import Establish, Hold, Reshape
from rigidfleet.planning.plan import PhasePlan
from rigidfleet.planning.reference import Pose
from rigidfleet.result import Result
from rigidfleet.simulation.flight import Flight
from rigidfleet.simulation.recording import assemble_result
from rigidfleet.simulation.sampling import times_between
from rigidfleet.typing import Floats, Ints
from rigidfleet.web.live import balls
from rigidfleet.web.live.archive import Archive, take_samples
from rigidfleet.web.live.balls import Ball

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
_LOOK = 0.1  # greatest way of the target between two looks at obstacles [m]


@dataclass
class PilotTarget:
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

    def has_passed(self, t: float, r: Floats) -> bool:
        """Whether it passed all vehicles at r (N, 3) [m] a second before t [s]."""
        far = float((r @ self.direction).max()) - self.origin
        return t >= self.start + self.length + far / self.speed + 1.0


class Pilot:
    """A flight that advances tick by tick under the user's commands.

    Attributes
    ----------
    flight : the flight
    target : the target pose of the body
    formations : names of those that can be flown
    waiting : the next formation; None if there is none
    balls : all that were pushed in, also those that are gone
    held_off : the obstacle that the target does not enter; "" if it is where it was moved

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
        self.flight = Flight(
            mission, force=self._wind_force, sampler=self._sample_times, flips=True
        )
        self.gusts: list[Gust] = []
        self.gusted = False  # whether there was any
        self.balls: list[Ball] = []
        self.moved = False  # whether the flight does not know all balls as they are
        self.held_off = ""
        self.at_rest = [thing for thing in mission.obstacles if not thing.solid.moves]
        self.waiting: str | None = None
        self.by_body = mission.architecture == "body"
        self.fastest = 0.7 * mission.limits.speed if mission.limits.speed else math.inf
        self.commanded: list[Phase] = []  # each phase as it was begun
        self.ticks = 0
        shaped = [p.shaping.formation for p in mission.phases if p.shaping is not None]
        first = next((name for name in shaped if name in self.formations), self.formations[0])
        self._begin_formation(first, establish=True)
        self.pose = self._first_pose()
        self.a, self.alpha = np.zeros(3), np.zeros(3)
        x, y, z = self.pose.r
        size = np.linalg.norm(self._slots, axis=1).max() + max(mission.agents.radius)
        clear = float(mission.height_below(x, y, z)) + size + 0.5  # to rotate above the ground
        heading = att.euler_from_dcm(self.pose.T) * [0, 0, 1]
        self.target = PilotTarget(np.array([x, y, max(z, clear)]), heading)
        self.last: Result | None = None

    @property
    def t(self) -> float:
        """Mission time [s]."""
        return self.flight.t

    @property
    def formation(self) -> str:
        """The current formation, or the one being formed."""
        return self.flight.phases[-1].formation or ""

    @property
    def is_changing(self) -> bool:
        """Whether the formation is changing."""
        phase = self.commanded[-1]
        settle = _STEADY if phase.control == "open" else 0.0
        blend = phase.shaping.least_time if phase.shaping is not None else 0.0
        return self.t < self.flight.phases[-1].t_start + blend + settle - 1e-9

    # -- commands --------------------------------------------------------------------------------

    def steer(self, move: Floats, turn: Floats) -> None:
        """Move and turn the target at these rates (3,) [m/s, rad/s] until the next command; zero stops it."""
        speed = float(np.linalg.norm(move))
        self.target.move = move * min(1.0, self.fastest / speed) if speed > 0.0 else move
        self.target.turn, self.target.held = turn, self.t

    def change_formation(self, formation: str) -> None:
        """Change to another formation as soon as the current change is complete.

        Raises
        ------
        ValueError
            It has no room where the target is.
        """
        slots, before = self.mission.formation_slots(formation), self._slots
        assert slots is not None  # of all formations flown
        far = float(np.linalg.norm(slots - before, axis=1).max())
        share = np.linspace(0.0, 1.0, math.ceil(far / _LOOK) + 2)[1:, None, None]
        way = before + share * (slots - before)  # straight and in step
        room, agent, which = self._obstacle_clearance(
            way, self.target.r[None, None], self.target.attitude
        )
        k = int(room.argmin())
        if formation != self.formation and room[k] < 0.0:
            name = self.at_rest[which[k]].name
            raise ValueError(
                f"'{formation}' has no room here: agent {agent[k] + 1} would meet '{name}'. Move the target away"
            )
        self.waiting = formation if formation != self.formation else None

    def send_gust(self, direction: Floats, strength: float) -> None:
        """Send a gust along ``direction`` (3,), at most ``strength`` [N/kg]."""
        if self.flight.ending:
            return
        d = direction / np.linalg.norm(direction)
        self.gusted = True
        self.gusts.append(Gust(self.t, float((self._positions() @ d).min()), d, strength))

    def add_ball(self, place: Floats, radius: float, velocity: Floats) -> Ball:
        """Add a ball at ``place`` (3,) [m] that flies with a constant velocity (3,) [m/s].

        Raises
        ------
        ValueError
            The ball is too small, large, fast, or near a vehicle, or there are too many.
        """
        taken = {ball.slot for ball in self.flying_balls}
        speed = float(np.linalg.norm(velocity))
        if len(taken) >= balls.AT_ONCE:
            raise ValueError(f"there are {balls.AT_ONCE} balls already: remove one first")
        if len(self.balls) >= balls.IN_A_FLIGHT:
            raise ValueError(f"a flight takes {balls.IN_A_FLIGHT} balls: begin a new one")
        if not balls.SMALLEST <= radius <= balls.LARGEST:
            raise ValueError(
                f"the radius of a ball is {balls.SMALLEST:g} to {balls.LARGEST:g} m, not {radius:g} m"
            )
        if speed > balls.QUICKEST:
            raise ValueError(f"a ball flies at up to {balls.QUICKEST:g} m/s, not {speed:.3g} m/s")
        away = (
            np.linalg.norm(self._positions() - place, axis=1) - self.mission.fleet.radius - radius
        )
        i = int(away.argmin())
        if away[i] < balls.ROOM:
            raise ValueError(
                f"the ball would be {max(away[i], 0.0):.2g} m from agent {i + 1}: put it at least {balls.ROOM:g} m away"
            )
        slot = min(set(range(balls.AT_ONCE)) - taken)
        ball = Ball(len(self.balls) + 1, slot, radius, place.copy(), velocity.copy(), self.t)
        self.balls.append(ball)
        return ball

    @property
    def flying_balls(self) -> list[Ball]:
        """The balls that are there."""
        return [ball for ball in self.balls if ball.until is None]

    def ball_at_slot(self, page_slot: int) -> Ball:
        """The ball that has a slot of the page.

        Raises
        ------
        ValueError
            There is none.
        """
        for ball in self.flying_balls:
            if ball.slot == page_slot:
                return ball
        raise ValueError("this ball is gone")

    def pull_ball(self, page_slot: int, goal: Floats | None) -> None:
        """Draw a ball to a goal (3,) [m], or let go of it: it stays where it is."""
        ball = self.ball_at_slot(page_slot)
        ball.goal = goal
        if goal is None:
            ball.set_velocity(np.zeros(3))

    def remove_ball(self, page_slot: int) -> None:
        """Remove a ball."""
        ball = self.ball_at_slot(page_slot)
        self.moved = True
        if ball.turns:
            ball.until = self.t
        else:  # nobody has met it
            self.balls.remove(ball)

    def fly_tick(self) -> Result:
        """Fly one tick; return the record of its end alone.

        A flight that cannot go on says why in ``flight.ending``, and stops.
        """
        flight = self.flight
        flight.pieces.clear()
        self.ticks += 1
        if not self.is_changing:
            if self.waiting is not None:
                self._begin_formation(self.waiting)
                self.waiting = None
            elif self.commanded[-1].control == "open":
                self._begin_phase(
                    Hold(kind="hold", name="by hand", duration=_ENDLESS, control="body")
                )
                if not flight.ending:
                    self.pose = flight.pose()
                    self.a, self.alpha = np.zeros(3), np.zeros(3)
        if not flight.ending:
            self._follow_target(TICK)
            self._update_obstacles()
            t = self.t
            flight.advance(self.ticks * TICK - t)
            for ball in self.flying_balls:
                ball.move(self.t - t)
            if not flight.ending and (met := flight.deepest_contact()) is not None:
                name = flight.mission.obstacles[met.other].name
                flight.ending = f"agent {met.who + 1} met '{name}' at {met.time:.2f} s"
        if flight.pieces or self.last is None:
            end = [take_samples(flight.pieces[-1], [-1])] if flight.pieces else []
            # A record of one moment has no extremes
            phases = [replace(p, extremes={}) for p in self.flight.phases]
            now: dict[str, Any] = {"ending": "", "statistics": {}, "network": flight.network}
            self.last = assemble_result(flight.mission, phases, end, **now)
            self.last.mission = flight.mission  # with the balls, and not parsed again
            self.archive.add_tick(flight.pieces)
        return self.last

    def result(self) -> Result:
        """The record of the whole flight, at the mission's output step, or a coarser one for a long flight.

        Its mission has the phases as they were flown.
        """
        ending = self.flight.ending
        if not ending and self.is_changing:
            ending = f"ended by hand on the way to '{self.formation}'"
        flight, now = self.flight, self.flight.mission
        flown = [ball.flown_sphere(self.t) for ball in self.balls if ball.turns]
        every = {"obstacles": (*self.mission.obstacles, *flown)}
        flight.mission = now.model_copy(update=every)
        pieces, step = self.archive.pieces(), self.archive.step
        result = flight.record(pieces, self.commanded, step=step, ending=ending)
        flight.mission = now
        if not self.gusted:
            result.statistics.pop("pushed", None)
        result.statistics["simulated_s"] = float(result.time[-1])
        return result

    # -- phases -----------------------------------------------------------------------------------

    def _begin_formation(self, formation: str, *, establish: bool = False) -> None:
        """Establish a formation, or change to it."""
        common: dict[str, Any] = {"formation": formation, "blend": _BLEND, "duration": _ENDLESS}
        law = "open" if establish else "body"
        common["control"] = law if self.by_body else "tracking"
        if establish:
            self._begin_phase(Establish(kind="establish", name=f"establish {formation}", **common))
        else:
            self._begin_phase(Reshape(kind="reshape", name=f"change to {formation}", **common))

    def _begin_phase(self, phase: Phase) -> None:
        if self.flight.begin(phase):
            self.commanded.append(phase)

    def _sample_times(self, plan: PhasePlan, t: float, t_end: float, **_: Any) -> Floats:
        """Multiples of the archive's step in (t, t_end], the end, and the start of a phase."""
        begun = any(key[0] == len(self.flight.phases) - 1 for key in self.archive.phases)
        return times_between(self.archive.step, plan, t, t_end, first=not begun, stop=t_end)

    def _positions(self) -> Floats:
        """Positions (N, 3) [m] of the vehicles."""
        return self.flight.observe().position

    # -- the reference ----------------------------------------------------------------------------

    def _first_pose(self) -> Pose:
        """The pose that the first phase begins with."""
        flight, frame = self.flight, self.flight.plan.frame
        pose = flight.pose()
        if flight.plan.phase.tracks_slots:
            return pose
        seen = flight.observe()
        total = self.masses.sum()
        cm, v = self.masses @ seen.position / total, self.masses @ seen.velocity / total
        return Pose(cm, v, frame if frame is not None else np.eye(3), np.zeros(3))

    def _follow_target(self, h: float) -> None:
        """Move the target as commanded, and the reference after it, over the next tick."""
        target, pose = self.target, self.pose
        if self.t - target.held <= _GRIP:
            self._move_target(h)
        away = att.rotation_vector_from_dcm(target.attitude @ pose.T.T)  # body axes
        r, v, a = _displacement_towards(target.r - pose.r, pose.v, self.a, h, _ACCELERATION)
        phi, omega, alpha = _displacement_towards(away, pose.omega, self.alpha, h, _TURN)
        if self.commanded[-1].control != "open":
            places = self._positions() if self.gusts else np.zeros((0, 3))
            self.gusts = [gust for gust in self.gusts if not gust.has_passed(self.t, places)]
            force = bool(self.gusts)
            ends = (r, v, a), (phi, omega, alpha)
            self.flight.steer(h, pose, *ends, a=self.a, alpha=self.alpha, force=force)
            T = att.dcm_from_rotation_vector(phi) @ pose.T
            self.pose = Pose(pose.r + r, v, T, omega)
            self.a, self.alpha = a, alpha

    def _move_target(self, h: float) -> None:
        """Move and turn the target as commanded, but no slot deeper into an obstacle or the ground."""
        target, slots = self.target, self._slots
        room, _, _ = self._obstacle_clearance(slots, target.r[None, None], target.attitude)
        least = min(float(room[0]), 0.0)

        def blocking_obstacle_name(path: Floats, attitude: Floats) -> str:
            """What a slot would be deeper in somewhere on a path (K, 3), "" for nothing."""
            after, _, which = self._obstacle_clearance(slots, path[:, None], attitude)
            return "" if (after >= least).all() else self.at_rest[which[int(after.argmin())]].name

        turned = target.euler + h * target.turn
        turned[1] = np.clip(turned[1], -1.2, 1.2)  # clear of the poles
        held_off = blocking_obstacle_name(target.r[None], att.dcm_from_euler(turned))
        if not held_off:
            target.euler = turned
        way = h * target.move
        parts = [way] if np.count_nonzero(way) < 2 else [way, *(way * row for row in np.eye(3))]
        for part in parts:  # along what stands in the way
            looks = math.ceil(float(np.linalg.norm(part)) / _LOOK)
            if not looks:
                continue
            path = target.r + np.linspace(0.0, 1.0, looks + 1)[1:, None] * part
            if name := blocking_obstacle_name(path, target.attitude):
                held_off = name
                continue
            target.r = target.r + part
            if part is way:
                break
        self.held_off = held_off

    @property
    def _slots(self) -> Floats:
        """Slots (N, 3) [m] of the formation, body axes."""
        slots = self.flight.plan.slots
        assert slots is not None  # every formation flown has slots
        return slots

    def _obstacle_clearance(self, slots: Floats, r: Floats, T: Floats) -> tuple[Floats, Ints, Ints]:
        """Least room (K,) [m] of slots (N, 3) or (K, N, 3) beside obstacles at rest, agent and obstacle (K,).

        The body is at r (K or 1, 1, 3), in an attitude T (3, 3).
        """
        return proximity.clearance(r + slots @ T, self.mission.fleet.radius, self.at_rest)

    # -- obstacles --------------------------------------------------------------------------------

    def _update_obstacles(self) -> None:
        """Tell the flight of balls that are new, gone, or fly another way."""
        for ball in self.flying_balls:
            ball.steer_to_goal()
            if ball.changed:
                ball.note_way_corner(self.t)
                self.moved = True
        if self.moved:
            self.moved = False
            seen = [
                ball.sphere_flying_on(self.t) if ball.until is None else ball.flown_sphere(self.t)
                for ball in self.balls
            ]
            self.flight.replace_obstacles((*self.mission.obstacles, *seen))

    # -- wind -------------------------------------------------------------------------------------

    def _wind_force(self, t: float, r: Floats, _v: Floats) -> Floats:
        return sum((gust.force(t, r, self.masses) for gust in self.gusts), np.zeros_like(r))


def _displacement_towards(
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
