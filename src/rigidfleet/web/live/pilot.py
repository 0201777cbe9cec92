"""A flight by hand: the target of the virtual body is moved while the flight goes on.

Each tick the reference follows the target smoothly, and one piece of a quintic takes it there: the
laws that fly it are the mission's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rigidfleet.errors import FlightError
from rigidfleet.kernel.engine import native
from rigidfleet.kernel.problem import LOCAL, Motion, Program
from rigidfleet.math import attitude as att
from rigidfleet.math import lqr
from rigidfleet.mission import Establish, Hold, Mission, Phase, Reshape
from rigidfleet.planning.reference import Pose
from rigidfleet.result import PhaseRecord, Result
from rigidfleet.simulation.flight import Flight, Leg, StoppedError
from rigidfleet.simulation.recording import assemble
from rigidfleet.typing import Floats
from rigidfleet.web.live.archive import Archive, as_flown, rows

TICK = 0.05  # between looks at what the hand asks for [s]
_BLEND = 4.0  # from one formation to another [s]
_STEADY = 2.0  # that an establishment by forces alone is left to settle [s]
#: The reference follows the target like a critically damped oscillator with this frequency [rad/s] ...
_FOLLOW = 1.3
#: ... whose acceleration grows within this time [s].
_RISE = 0.15
_ACCELERATION, _TURN = 3.0, 1.5  # of the reference at most [m/s^2, rad/s^2]
_FINEST = 1e-3  # between samples that are kept [s]
#: A hand that is not heard of for so long has let go [s of mission time].
_GRIP = 0.6


@dataclass
class Target:
    """Where the hand wants the body to be, and how it moves that."""

    r: Floats  # (3,) [m]
    euler: Floats  # (3,) roll, pitch, yaw [rad]
    move: Floats = field(default_factory=lambda: np.zeros(3))  # [m/s]
    turn: Floats = field(default_factory=lambda: np.zeros(3))  # rates of roll, pitch, yaw [rad/s]
    held: float = -math.inf  # when the hand was last heard of [s]

    @property
    def attitude(self) -> Floats:
        """Attitude (3, 3), world to body."""
        return att.dcm_from_euler(self.euler)


@dataclass(frozen=True)
class Gust:
    """A front of wind that passes over the formation.

    Each vehicle feels a force of one smooth pulse, 1 - cos, when the front is over it.
    """

    start: float  # [s]
    origin: float  # where the front is then, along its direction [m]
    direction: Floats  # (3,) unit vector
    strength: float  # of the force at most [N/kg]
    speed: float = 8.0  # of the front [m/s]
    length: float = 1.6  # of the pulse [s]

    def force(self, t: float, r: Floats, masses: Floats) -> Floats:
        """Force (N, 3) [N] on vehicles at r (N, 3) [m]."""
        x = (t - self.start - (r @ self.direction - self.origin) / self.speed) / self.length
        pulse = np.where((x > 0.0) & (x < 1.0), 0.5 - 0.5 * np.cos(2 * math.pi * x), 0.0)
        return (self.strength * pulse * masses)[:, None] * self.direction


class Pilot(Flight):
    """A flight that goes on tick by tick, as it is told.

    Attributes
    ----------
    target : where the hand wants the body
    formations : names of those that can be flown
    formation : the one taken last; ``waiting`` the one to be taken next, None for none
    ending : why the flight cannot go on, "" while it can

    Raises
    ------
    FlightError
        No formation of the mission has slots.
    """

    def __init__(self, mission: Mission) -> None:
        self.formations = [n for n in mission.formations if mission.formation_slots(n) is not None]
        if not self.formations:
            raise FlightError(
                f"{mission.name}: cannot be flown by hand, as no formation has slots."
                " Give one a shape or slots in the mission"
            )
        super().__init__(mission, None, 50.0, self._wind, None, None)
        self.gusts: list[Gust] = []
        self.waiting: str | None = None
        self.by_body = mission.architecture == "body"
        self.fastest = 0.7 * mission.limits.speed if mission.limits.speed else math.inf
        self.archive = Archive(max(mission.output_step, _FINEST))
        self.asked: list[Phase] = []  # what each phase was begun as
        self.ticks = 0
        self.leg = self._take(self._first(), establish=True)
        self.pose = self._reference()
        self.a, self.alpha = np.zeros(3), np.zeros(3)
        self.target = Target(self._up(self.pose.r), att.euler_from_dcm(self.pose.T) * [0, 0, 1])
        self.last: Result | None = None

    @property
    def t(self) -> float:
        """Mission time [s]."""
        return self.leg.t

    @property
    def formation(self) -> str:
        """The formation taken last."""
        return self.leg.plan.formation or ""

    @property
    def busy(self) -> bool:
        """Whether the formation is changing."""
        reference = self.leg.plan.program.reference
        settle = _STEADY if self.leg.phase.control == "open" else 0.0
        return self.t < reference.t0 + reference.T_b + settle - 1e-9

    # -- what it can be told ----------------------------------------------------------------------

    def steer(self, move: Floats, turn: Floats) -> None:
        """Move and turn the target at these rates (3,) [m/s, rad/s] until told otherwise, or not at all."""
        speed = float(np.linalg.norm(move))
        self.target.move = move * min(1.0, self.fastest / speed) if speed > 0.0 else move
        self.target.turn, self.target.held = turn, self.t

    def change(self, formation: str) -> None:
        """Take another formation as soon as the one before is taken."""
        self.waiting = formation if formation != self.formation else None

    def gust(self, direction: Floats, strength: float) -> None:
        """Send a gust along ``direction`` (3,), at most ``strength`` [N/kg]."""
        d = direction / np.linalg.norm(direction)
        self.gusts.append(Gust(self.t, float((self.leg.workspace.r @ d).min()), d, strength))

    def step(self) -> Result:
        """Fly one tick; return the record of its end alone.

        A flight that cannot go on sets ``ending``, and stays where it is.
        """
        self.pieces.clear()
        self.ticks += 1
        try:
            if not self.busy:
                if self.waiting is not None:
                    self.leg = self._take(self.waiting)
                    self.waiting = None
                elif self.leg.phase.control == "open":
                    self.leg = self._hold()
            self._follow(TICK)
            self._integrate(self.leg, self.leg.plan.program, self.ticks * TICK)
        except StoppedError as stop:
            self.ending = str(stop)
        self.phases[-1].t_end = self.t
        if self.pieces or self.last is None:
            end = [rows(self.pieces[-1], [-1])] if self.pieces else []
            phases = [replace(p, extremes={}) for p in self.phases]  # of one moment alone
            result = assemble(self.mission, phases, end, ending="", statistics={})
            result.mission = self.mission  # which need not be parsed again
            self.last = result
            self.archive.add(self.pieces, result)
        return self.last

    def result(self) -> Result:
        """The record of the whole flight, at the mission's output step or, of a long one, coarser.

        Its mission has the phases as they were flown.
        """
        self._watch(self.leg, last=True)
        self.phases[-1].extremes = self.extremes.so_far()
        kept = self.archive.pieces()
        flown = self.phases[: kept[-1].phase + 1]
        given, ending, shown = self.mission, self.ending, self.phases
        self.mission, self.phases = as_flown(
            given, self.asked[: len(flown)], flown, self.archive.step
        )
        self.pieces = kept
        if not ending and self.busy:
            self.ending = f"ended by hand on the way to '{self.formation}'"
        try:
            result = super().result()
        finally:
            self.mission, self.phases, self.ending, self.pieces = given, shown, ending, []
        result.statistics["simulated_s"] = float(result.time[-1])
        return result

    # -- legs -------------------------------------------------------------------------------------

    def _first(self) -> str:
        names = [p.formation for p in self.mission.phases if isinstance(p, Establish | Reshape)]
        return next((n for n in names if n in self.formations), self.formations[0])

    def _take(self, formation: str, *, establish: bool = False) -> Leg:
        """Establish a formation, or change to it."""
        if establish:
            control = "open" if self.by_body else "slots"
            return self._fly(
                Establish(
                    kind="establish", name=f"establish {formation}", formation=formation, blend=_BLEND,
                    duration=_BLEND + _STEADY, control=control,
                )
            )  # fmt: skip
        control = "body" if self.by_body else "slots"
        return self._fly(
            Reshape(
                kind="reshape", name=f"change to {formation}", formation=formation, blend=_BLEND,
                duration=_BLEND, control=control,
            )
        )  # fmt: skip

    def _hold(self) -> Leg:
        leg = self._fly(Hold(kind="hold", name="by hand", duration=_BLEND, control="body"))
        w = leg.workspace
        self.pose = Pose(w.cm[0].copy(), w.cm[1].copy(), w.T.copy(), np.zeros(3))
        self.a, self.alpha = np.zeros(3), np.zeros(3)
        return leg

    def _fly(self, phase: Phase) -> Leg:
        if self.phases:
            self._watch(self.leg, last=True)
            self.phases[-1].extremes = self.extremes.phase()
            self._count(self.leg)
            self._arrive(self.leg)
        leg = self._begin(len(self.phases), phase)
        native.closed_loop(leg.t, leg.state.y, leg.state.K[0], leg.plan.program, leg.workspace)
        self.asked.append(phase)
        control, name = phase.control, leg.plan.formation
        self.phases.append(PhaseRecord(phase.name, phase.kind, control, name, leg.t, leg.t))
        return leg

    def _check_frame(self, index: int, plan: Any) -> None:
        """A hand sees for itself whether a formation has flipped."""

    def _samples(self, leg: Leg, t_end: float) -> Floats:
        """Multiples of the archive's step in (t, t_end], the end, and the start of a phase."""
        step = self.archive.step
        low, high = math.floor(leg.t / step + 1e-9) + 1, math.floor(t_end / step + 1e-9) + 1
        grid = np.arange(low, high) * step
        start = [] if self.archive.begun(leg.index) else [leg.t and np.nextafter(leg.t, math.inf)]
        return np.concatenate([start, grid[grid < t_end - 1e-9], [t_end]])

    # -- the reference ----------------------------------------------------------------------------

    def _reference(self) -> Pose:
        """The pose that the first leg begins with."""
        w, plan = self.leg.workspace, self.leg.plan
        if plan.program.control.kind == LOCAL:
            return Pose(w.body[0].copy(), w.body[1].copy(), w.T_ref.copy(), w.body[3].copy())
        T = plan.frame if plan.frame is not None else np.eye(3)
        cm = self.masses @ w.r / self.masses.sum()
        return Pose(cm, self.masses @ w.v / self.masses.sum(), T, np.zeros(3))

    def _up(self, r: Floats) -> Floats:
        """A place (3,) [m] like ``r``, but high enough for the first formation to turn about it."""
        slots = self.leg.plan.slots
        assert slots is not None  # every formation that is flown has some
        size = np.linalg.norm(slots, axis=1).max() + max(self.mission.agents.radius)
        ground = max(
            (o.height for o in self.mission.obstacles if o.kind == "ground"), default=-np.inf
        )
        return np.array([r[0], r[1], max(r[2], ground + size + 0.5)])

    def _follow(self, h: float) -> None:
        """Move the target as the hand does, and the reference after it, over the next tick."""
        target, pose, leg = self.target, self.pose, self.leg
        if self.t - target.held <= _GRIP:
            target.r += h * target.move
            target.euler += h * target.turn
            target.euler[1] = np.clip(target.euler[1], -1.2, 1.2)  # clear of the poles
        away = att.rotation_vector_from_dcm(target.attitude @ pose.T.T)  # axes of the body
        r, v, a = _pulled(target.r - pose.r, pose.v, self.a, h, _ACCELERATION)
        phi, omega, alpha = _pulled(away, pose.omega, self.alpha, h, _TURN)
        if leg.phase.control != "open":
            leg.plan.program = self._program(leg, h, (r, v, a), (phi, omega, alpha))
            self.count[0] += leg.state.count[0]
            leg.state.count[0] = 0  # another law: its derivative is not known yet
            T = att.dcm_from_rotation_vector(phi) @ pose.T
            self.pose = Pose(pose.r + r, v, T, omega)
            self.a, self.alpha = a, alpha

    def _program(
        self,
        leg: Leg,
        h: float,
        move: tuple[Floats, Floats, Floats],
        turn: tuple[Floats, Floats, Floats],
    ) -> Program:
        """The leg's program with a reference that leads from the pose now to that after a tick."""
        pose, t, program = self.pose, leg.t, leg.plan.program
        wind = self._windy(t)
        external = self.external.address if wind and self.external is not None else 0
        if leg.phase.control == "body":
            feedback = program.feedback._replace(
                arrival=t, r=pose.r, v=pose.v, T1=np.ascontiguousarray(pose.T), omega=pose.omega
            )
            return program._replace(feedback=feedback, external=external)
        (r, v, a), (phi, omega, alpha) = move, turn
        zero = np.zeros(3)
        rate = att.rotation_vector_rate(phi, omega)
        x = np.array([[*pose.r, *zero], [*(pose.r + r), *phi]])
        x_dot = np.array([[*pose.v, *pose.omega], [*v, *rate]])
        x_ddot = np.array([[*self.a, *self.alpha], [*a, *(alpha + 0.5 * np.cross(phi, alpha))]])
        times = np.array([t, t + h])
        pieces = np.ascontiguousarray(lqr.quintic_pieces(times, x, x_dot, x_ddot))
        motion = Motion(times, pieces, np.ascontiguousarray(pose.T))
        return program._replace(motion=motion, external=external)

    # -- wind -------------------------------------------------------------------------------------

    def _windy(self, t: float) -> bool:
        """Forget gusts that have passed; whether there is one left."""
        r = self.leg.workspace.r
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
    """Way over h [s], and velocity and acceleration then, of what is drawn to a point ``away``.

    Like a critically damped oscillator; its acceleration is at most ``most`` and changes steadily.
    """
    wanted = _FOLLOW**2 * away - 2 * _FOLLOW * v
    size = float(np.linalg.norm(wanted))
    if size > most:
        wanted = wanted * (most / size)
    after = a + (wanted - a) * min(1.0, h / _RISE)
    return h * v + h**2 * (2 * a + after) / 6, v + h * (a + after) / 2, after
