"""The first layers of avoidance in flight: the virtual clock and the body layer, which lead the reference of a phase.

They look ahead at multiples of `_PERIOD` of the flight, and act by another reference for the next one: the planned path
at the time of the virtual clock, moved by the deviation of the body. Where neither acts, the plan itself is flown.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rigidfleet.kernel.avoidance import KNOWN, AvoidanceArrays, needed_gap_acceleration
from rigidfleet.kernel.problem import SHAPE, SQUARED, Motion, Problem
from rigidfleet.math import lqr, series
from rigidfleet.mission import Mission
from rigidfleet.mission.schema import Avoidance as Settings
from rigidfleet.planning.body_layer import (
    NEAR,
    Detour,
    greatest_point_acceleration,
    motion_and_growth_rows,
    nearest_accelerations,
    rows_bounding_scale,
)
from rigidfleet.planning.derivatives import body_taylor, slot_derivatives, slot_taylor
from rigidfleet.planning.plan import PhasePlan
from rigidfleet.planning.virtual_clock import STEEPEST, VirtualClock, postpone, time_derivatives
from rigidfleet.result import Extremum
from rigidfleet.solids.distance import local_point, outward_normal, signed_distance
from rigidfleet.typing import Floats, Ints

#: Time for which a decision holds [s].
_PERIOD = 0.1
#: How far the clock looks ahead [s], at how many times, and the rates that it compares.
_HORIZON, _LOOKS, _RATES = 4.0, 24, (1.0, 0.7, 0.4, 0.0)
#: Bandwidth of the clock, times the time in which vehicles react: they are to follow what it does.
_FOLLOWED = 0.3
#: Clearance of a path beyond what is to be kept with which it counts as free, and to go faster again [m].
_FREE, _AGAIN = 0.2, 0.4
#: Share of the least braking for slowing the path, and for steering the body.
_SLOWING, _STEERING = 0.4, 0.5
#: Share of the barriers' rate at which the body approaches its barriers: it gives way before single vehicles do.
_EARLIER = 0.5
#: Rate at which velocities leave collision cones [1/s], and room beside an obstacle that the body adds [m].
_CONE, _ASIDE = 1.5, 0.5
#: Least tangent, over the radius of the ball: inside it there is none.
_TANGENT = 0.1
#: Time by which a reference is valid before and after its period [s].
_OVERLAP = 1e-3
#: How far beside a jump it is evaluated [s].
_BESIDE = 1e-9


def layers(mission: Mission) -> Settings | None:
    """The settings of [avoidance], if its clock or its body layer can act.

    They can if obstacles move, no vehicle is lost, and no abort leaves the plan, of which all that follows is proved.
    """
    settings, lost = mission.avoidance, mission.all_disturbances.lost
    if settings is None or not (settings.clock or settings.body):
        return None
    leaves = lost or mission.abandons_at < np.inf
    return None if leaves or not any(o.solid.moves for o in mission.obstacles) else settings


class LeaderState(NamedTuple):
    """A period that is led: when it begins [s], and clock and deviation there."""

    begun: float
    clock: VirtualClock
    deviation: Detour


def _quintics(times: Floats, ends: Floats) -> Floats:
    """Quintics (K, ..., 6) between times (K + 1,) [s], by values and two derivatives (3, 2 K, ...) at their ends."""
    pairs = ends.reshape(3, -1, 2, *ends.shape[2:])
    parts = [lqr.quintic_pieces(times[k : k + 2], *pairs[:, k]) for k in range(len(times) - 1)]
    return np.ascontiguousarray(np.concatenate(parts))


@dataclass
class Leader:
    """Leads the reference of one phase.

    Attributes
    ----------
    problem : what the plan asks for, as planned
    plan : whose times of events are moved by what the clock falls behind
    waited, steered : when [s] the clock first slowed, and the body was first steered; None if never
    steering : time for which the body deviated [s]
    """

    settings: Settings
    plan: PhasePlan
    period: float
    deviation: Detour = field(default_factory=Detour)
    clock: VirtualClock = field(default_factory=VirtualClock)
    waited: float | None = None
    steered: float | None = None
    steering: float = 0.0
    who: int = 0

    def __post_init__(self) -> None:
        self.problem = self.plan.problem
        #: Where the reference flown is another than the plan's.
        self.now: LeaderState | None = None
        self.calm = True  # whether no barrier asks for more than the deviation's own decay
        n = max(1, round(_PERIOD / self.period))
        self.period *= n

    def end_of_period(self, t: float, step: float) -> float:
        """End [s] of the period that t [s] lies in; exactly a multiple of ``step`` [s] if it is one to rounding."""
        end = (np.floor(t / self.period + 1e-6) + 1.0) * self.period
        sample = round(end / step) * step
        return float(sample if abs(sample - end) < 1e-9 * max(1.0, end) else end)

    def lead(self, t: float, end: float, a: AvoidanceArrays) -> Problem | None:
        """Decide at t [s] until ``end`` [s]; returns the problem to fly, or None if it is the one flown already."""
        h = end - t
        acts = self._can_lead(t + h)
        self.clock.set_aim(
            *(self._rate_and_bandwidth(t, a) if acts and self.settings.clock else (1.0, np.inf))
        )
        accelerations = (
            self._deviation_accels(t, a)
            if acts and self.settings.body
            else self.deviation.decay_accelerations()
        )
        if self.clock.has_unit_rate and self.deviation.is_zero and not accelerations.any():
            before, self.now = self.now, None
            return None if before is None else postpone(self.problem, self.clock.delay)
        self.now = LeaderState(t, copy.copy(self.clock), self.deviation)
        problem = self._detour_problem(t, h, accelerations)
        lost = self.clock.advance_and_count_delay(h)
        if lost > 0.0:
            self.waited = t if self.waited is None else self.waited
            self._delay_events(end, lost)
        self.deviation = self.deviation.state_after(h, accelerations, h)
        self.deviation.end_if_small_and_still(still=self.calm)
        if not self.deviation.is_zero:
            self.steering += h
            self.steered = t if self.steered is None else self.steered
        return problem

    def clock_rate(self, time: Floats) -> Floats:
        """Rate of the clock at times (K,) [s] of the period flown last."""
        if self.now is None:
            return np.ones(len(time))
        return self.now.clock.progress_in(time - self.now.begun)[1]

    def displacement(self, time: Floats) -> Floats:
        """Displacement (K, 3) [m] of the body from its path at times (K,) [s] of the period flown last."""
        if self.now is None:
            return np.zeros((len(time), 3))
        since, (x, v, _) = (time - self.now.begun)[:, None], self.now.deviation.x
        return x + since * v

    def layer_extremes(self, t: float) -> dict[str, Extremum]:
        """What the layers did by t [s]: delay [s], and share of the time in which the body deviated."""
        extremes = {}
        if self.waited is not None:
            extremes["clock"] = Extremum(self.clock.delay, self.waited, self.who, -1)
        if self.steered is not None:
            share = self.steering / max(t - self.plan.start, self.steering)
            extremes["body"] = Extremum(share, self.steered, self.who, -1)
        return extremes

    # -- the clock ----------------------------------------------------------------------------------------

    def _can_lead(self, t: float) -> bool:
        """Whether a reference can be led at t [s]: blends of squared distances are those of no slots."""
        reference = self.problem.reference
        return reference.kind != SQUARED or t - self.clock.delay >= reference.t0 + reference.T_b

    def _rate_and_bandwidth(self, t: float, a: AvoidanceArrays) -> tuple[float, float]:
        """The rate to aim at, and the bandwidth of the clock.

        The greatest one at which the slots keep away from all that moves, as far as it is known, over the horizon; if
        none does, that of the least harm, unless it helps little.
        """
        seen = np.flatnonzero((a.sight.moves == 1) & (a.sight.known == KNOWN))
        if not len(seen) or self.clock.delay >= self.settings.patience:
            return 1.0, np.inf
        ahead = np.linspace(0.0, _HORIZON, _LOOKS + 1)
        problem, tau = self.problem, t - self.clock.delay + ahead
        r = slot_derivatives(problem.reference, problem.motion, tau, 1)[:, 0] + self.deviation.x[0]
        step = ahead[1]
        fastest = float(np.linalg.norm(np.diff(r, axis=0), axis=2).max()) / step
        if fastest < 1e-6:
            return 1.0, np.inf  # a formation at rest does not wait
        room = [self._room(r, ahead, a, seen)]
        again = self.clock.target < 1.0
        if room[0] < (_AGAIN if again else _FREE):
            for rate in _RATES[1:]:
                at = np.clip(self.clock.progress_in(ahead, rate)[0] / step, 0.0, _LOOKS - 1e-9)
                low = at.astype(int)
                share = (at - low)[:, None, None]
                room.append(self._room((1.0 - share) * r[low] + share * r[low + 1], ahead, a, seen))
        free = [
            k
            for k, x in enumerate(room)
            if x >= (_AGAIN if again and _RATES[k] > self.clock.target else _FREE)
        ]
        best = free[0] if free else int(np.argmax(room))
        if not free and room[best] < room[0] + _FREE:
            best = 0
        bandwidth = _SLOWING * float(a.b.min()) / (STEEPEST * fastest)
        return _RATES[best], min(bandwidth, _FOLLOWED / max(float(a.lag.max()), 1e-9))

    def _room(self, r: Floats, times: Floats, a: AvoidanceArrays, seen: Ints) -> float:
        """Least distance [m] of places r (K, N, 3) at times (K,) [s] ahead from what moves, beyond what is kept."""
        least = np.inf
        for o in seen:
            x, bound = a.sight.track[o], a.sight.bound[o]
            away = r - (x[:3] + times[:, None] * x[3:])[:, None]
            room = signed_distance(*local_point(*away.transpose(2, 0, 1), o, a.solids), o, a.solids)
            room = room - (a.reach + a.spare) - (bound[0] + bound[1] / 3.0 * times)[:, None]
            if (worst := float(room.min())) < least:
                least, self.who = worst, int(np.unravel_index(room.argmin(), room.shape)[1])
        return least

    def _delay_events(self, end: float, lost: float) -> None:
        """Move the events of the plan that have not come yet by what the clock has fallen behind by ``end`` [s]."""
        assert self.now is not None
        begun, clock = self.now.begun, self.now.clock

        def postponed_time(time: float) -> float:
            progress = time - begun
            if progress <= 0.0:
                return time
            if progress <= end - begun - lost:
                return begun + clock.time_until_progress(progress, end - begun)
            return time + lost

        plan = self.plan
        plan.postpone_arrival(postponed_time)
        if begun < (blend := plan.reference).t0 + blend.T_b:
            plan.reference = blend._replace(t0=blend.t0 + lost)

    def _detour_problem(self, t: float, h: float, accelerations: Floats) -> Problem:
        """The problem from t for h [s]: the path at the clock's time, moved by the deviation, as polynomials.

        They have the values and two derivatives of both at either end, and at the end of the path, where its
        acceleration may jump.
        """
        problem = self.problem
        reference, motion = problem.reference, problem.motion
        dt = [-_OVERLAP, h + _OVERLAP]
        left = motion.knots[-1] - (t - self.clock.delay)
        if 0.0 < left < self.clock.progress_in(h)[0]:
            dt.insert(1, self.clock.time_until_progress(left, h))
        times, dt = t + np.array(dt), np.repeat(dt, 2)[1:-1]  # both ends of each polynomial
        dt[1:-1:2] -= _BESIDE
        dt[2:-1:2] += _BESIDE
        progress, s, slope, _ = self.clock.progress_in(dt)
        tau, rates = t - self.clock.delay + progress, np.stack([s, slope])
        cm, axes = body_taylor(motion, tau, 3)
        axes = np.broadcast_to(axes, (3, 3, 3, len(tau)))  # also of a body that does not turn
        still = np.zeros_like(axes)
        still[0] = np.eye(3)[..., None]
        p = time_derivatives(
            series.taylor_derivatives(slot_taylor(reference, (np.zeros_like(cm), still), tau)),
            rates,
        )
        x = time_derivatives(series.taylor_derivatives(cm), rates)
        B = series.series_by_derivatives(time_derivatives(series.taylor_derivatives(axes), rates))
        ends = [self.deviation.state_after(each, accelerations, h) for each in dt]
        moves, turns, grows = (
            np.stack(each, axis=-1)
            for each in zip(*(e.similarity_series() for e in ends), strict=True)
        )
        x += series.taylor_derivatives(moves)
        grown = series.product(series.series_by_derivatives(p), grows[:, None, None])
        p = series.taylor_derivatives(grown)
        B = series.product(np.moveaxis(turns, -1, 1), np.moveaxis(B, -1, 1), np.matmul)
        phi = series.taylor_derivatives(series.rotation_vector_taylor(B[0, 0].T @ B))
        channels = np.concatenate([x.transpose(0, 2, 1), phi], axis=2)  # (3, ends, 6)
        polynomials = Motion(times, _quintics(times, channels), np.ascontiguousarray(B[0, 0].T))
        late, scaled = postpone(problem, self.clock.delay).reference, self._is_any_scaled(ends)
        if not (p[1:].any() or scaled):
            return problem._replace(motion=polynomials, reference=late)
        ways = _quintics(times, p.transpose(0, 3, 2, 1))
        kind = SHAPE if scaled else reference.kind
        return problem._replace(
            motion=polynomials, reference=late._replace(kind=kind, knots=times, ways=ways)
        )

    @staticmethod
    def _is_any_scaled(ends: list[Detour]) -> bool:
        return any(np.any(e.scale != [1.0, 0.0, 0.0]) for e in ends)

    # -- the body -----------------------------------------------------------------------------------------

    def _deviation_accels(self, t: float, a: AvoidanceArrays) -> Floats:
        """Second derivatives (7,) of the deviation to take: those of its decay, changed as barriers need."""
        accelerations, self.calm = self.deviation.decay_accelerations(), True
        sight = a.sight
        moving = np.flatnonzero((sight.moves == 1) & (sight.known == KNOWN))
        if not len(moving) and self.deviation.is_zero:
            return accelerations
        r, v, rise, arms = self._slot_states_and_arms(t)
        z = self.deviation.scale[0]
        limit = _STEERING * float(a.b.min())
        cones = (self._moving_obstacle_barriers(o, r, v, rise, a) for o in moving)
        rows, needed, who = self._barrier_rows(cones, arms, limit)
        if len(rows):
            accelerations = self.deviation.decay_accelerations(NEAR)
        short = needed - rows @ accelerations
        if not (len(short) and short.max() > 0.0) and self.deviation.is_zero:
            return accelerations
        self.calm = not (len(short) and short.max() > 0.0)
        if not self.calm:
            self.who = int(who[short.argmax()])
        # Off the planned path, what stands still counts, too
        barriers = (
            self._still_barriers(o, r, v, rise, a) for o in np.flatnonzero(sight.moves == 0)
        )
        more, least, _ = self._barrier_rows(barriers, arms, limit)
        rows, needed = np.vstack([rows, more]), np.append(needed, least)
        if self._is_any_scaled([self.deviation]) or self._can_scale_slots:
            more, least = rows_bounding_scale(self.deviation)
            rows, needed = np.vstack([rows, more]), np.append(needed, least)
        else:
            rows[:, 6] = 0.0
        if not (needed > rows @ accelerations).any():
            return accelerations
        wanted = nearest_accelerations(accelerations, rows, needed, a.weight, arms, z)
        if wanted is None:  # no motion of the body helps: single vehicles have to give way
            return accelerations
        change = wanted - accelerations
        greatest = greatest_point_acceleration(change, arms, z)
        return accelerations + min(1.0, limit / max(greatest, 1e-12)) * change

    @cached_property
    def _can_scale_slots(self) -> bool:
        """Whether slots may be scaled: their distances are those of the edges."""
        plan = self.plan
        if plan.slots is None:
            return False
        i, j = plan.edges.T
        d = np.linalg.norm(plan.slots[i] - plan.slots[j], axis=1)
        return np.allclose(d, plan.distances, rtol=0.0, atol=1e-6)

    def _slot_states_and_arms(self, t: float) -> tuple[Floats, Floats, Floats, Floats]:
        """Slots (N, 3), velocities, accelerations without those of the deviation, and arms from the body's origin."""
        tau = np.array([t - self.clock.delay])
        cm, axes = body_taylor(self.problem.motion, tau, 3)
        slots = slot_taylor(self.problem.reference, (cm, axes), tau)
        rates = np.array(self.clock.rate[:2])[:, None]
        c = time_derivatives(series.taylor_derivatives(cm), rates)[..., 0]
        arm = (
            time_derivatives(series.taylor_derivatives(slots), rates)[..., 0].transpose(0, 2, 1)
            - c[:, None]
        )
        Q = series.taylor_derivatives(self.deviation.similarity_series()[1])
        z, z1, _ = self.deviation.scale
        x = self.deviation.x
        # Without the second derivatives that are asked for
        spin = np.cross(self.deviation.omega[0], np.eye(3)).T
        Q = Q[0], Q[1], spin @ spin @ Q[0]
        d = z * arm[0], z1 * arm[0] + z * arm[1], 2.0 * z1 * arm[1] + z * arm[2]
        turned = [y @ Q[0].T for y in d]
        r = c[0] + x[0] + turned[0]
        v = c[1] + x[1] + d[0] @ Q[1].T + turned[1]
        a = c[2] + d[0] @ Q[2].T + 2.0 * d[1] @ Q[1].T + turned[2]
        return r, v, a, turned[0]

    def _barrier_rows(
        self, barriers: Iterable[tuple[Floats, Floats]], arms: Floats, limit: float
    ) -> tuple[Floats, Floats, Ints]:
        """Rows (R, 7) of the barriers that may act, what they need (R,), and the vehicles (R,)."""
        parts = [(np.zeros((0, 7)), np.zeros(0), np.zeros(0, dtype=int))]
        for normal, needed in barriers:
            some = np.flatnonzero(needed > -limit)
            rows = motion_and_growth_rows(normal[some], arms[some], self.deviation.scale[0])
            parts.append((rows, needed[some], some))
        rows, needed, who = (np.concatenate(each) for each in zip(*parts, strict=True))
        return rows, needed, who

    def _moving_obstacle_barriers(
        self, o: int, r: Floats, v: Floats, accels: Floats, a: AvoidanceArrays
    ) -> tuple[Floats, Floats]:
        """Normals (N, 3) of barriers of slots against obstacle o, which moves, and what they need (N,) along these.

        With x the place of a slot relative to the middle of a ball round the obstacle, w its relative velocity and s
        the length of a tangent from it to the ball, h = x . w + |w| s is not negative if w points past the ball: a
        barrier by the collision cone of Chakravarthy and Ghose (*Obstacle avoidance in a dynamic environment*, IEEE
        Transactions on Systems, Man, and Cybernetics A 28, 1998). It steers aside, where one on the distance brakes.
        """
        sight = a.sight
        track, bound = sight.track[o], sight.bound[o]
        x, w = r - sight.centre[o] - track[:3], v - track[3:]
        size = sight.ball[o] + a.reach + a.spare + bound[0] + _ASIDE
        along, speed = (x * w).sum(axis=1), np.maximum(np.linalg.norm(w, axis=1), 1e-6)
        s = np.sqrt(np.maximum((x * x).sum(axis=1) - size**2, (_TANGENT * size) ** 2))
        normal = x + (s / speed)[:, None] * w
        length = np.maximum(np.linalg.norm(normal, axis=1), 1e-9)
        h = along + speed * s
        needed = -_CONE * h - speed**2 - speed * along / s
        needed = (needed - (normal * accels).sum(axis=1)) / length
        nears = (along < 0.0) & (-along < _HORIZON * speed**2)
        return normal / length[:, None], np.where(nears, needed, -np.inf)

    def _still_barriers(
        self, o: int, r: Floats, v: Floats, accels: Floats, a: AvoidanceArrays
    ) -> tuple[Floats, Floats]:
        """Barriers of slots against obstacle o, which stands still; see `_moving_obstacle_barriers`."""
        solids = a.solids
        at = local_point(*r.T, o, solids)
        away = signed_distance(*at, o, solids)
        normal = np.stack(np.broadcast_arrays(*outward_normal(*at, o, solids)), axis=1)
        if solids.turned[o]:
            normal = normal @ solids.turn[o]
        rate = (normal * v).sum(axis=1)
        gap = away - a.reach - a.spare - np.maximum(0.0, -rate) * (self.period + a.lag)
        strength = _STEERING * a.share * a.b
        needed = needed_gap_acceleration(gap, rate, 0.0, strength, _EARLIER * a.rate)
        return normal, needed - (normal * accels).sum(axis=1)
