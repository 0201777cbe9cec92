"""Make what a sampled flight reads, from a mission's vehicles, autopilot and measurements.

Random numbers are drawn in blocks, each from a generator of its own. The same mission therefore gives the same flight,
bit for bit, however the flight is divided.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rigidfleet.kernel import fleet
from rigidfleet.kernel.clock_records import FASTEST, OFF, RATE, VehicleClocks, shared_clock
from rigidfleet.kernel.mail import Links, no_network
from rigidfleet.kernel.problem import Motion, Problem, Reference
from rigidfleet.math import series
from rigidfleet.math.margins import Lag, LoopGains, tracking_lag_time
from rigidfleet.math.quadrotor import ROTORS
from rigidfleet.mission import Mission
from rigidfleet.mission.schema import VehicleYaw
from rigidfleet.mission.vehicles import VehicleModel
from rigidfleet.planning.derivatives import (
    blend_taylor,
    body_taylor,
    slot_derivatives,
    slot_taylor,
    yaw_along,
    yaw_derivatives,
    yaw_derivatives_but_along,
)
from rigidfleet.planning.disturbances import mission_disturbance
from rigidfleet.planning.virtual_clock import postpone
from rigidfleet.typing import Floats, Ints

#: Rows of random numbers in a block.
_BLOCK = 1024
#: Kinds of random numbers.
_NOISE, _DROPPED, _LATE, _DRIFT = range(2, 6)
#: Density of the air at sea level, ICAO standard atmosphere [kg/m^3].
DENSITY = 1.225
#: Longest step with a user's force [s]: with the velocity of the step's start, drag is met to .1 % of its effect.
_FORCED = 0.001
#: Speed below which the direction of quadratic drag is rounded off [m/s].
_STILL = 0.1
#: Share of the drag that its feedforward leaves in fast descents, where rotors turn slower than at the thrust desired.
_LEFT = 0.2
#: Time in which a vehicle turns from its yaw at a switch, and its rate, to those asked for [s].
_TURN_TIME = 3.0
#: Difference of two rates of yaw that counts as none [rad/s].
_SAME_RATE = 1e-3
#: Time constant with which vehicles in a network estimate the acceleration by what they do not know [s].
_ESTIMATE = 0.15
#: Probability with which all messages that a vehicle owes its neighbours within the time of silence are lost.
_ALL_LOST = 1e-3


def sampled_flight(mission: Mission, max_step: float = math.inf) -> fleet.SampledFlight:
    """Vehicles, air, sensing and rates of a mission with vehicles, where a user's force lasts two ``max_step`` [s]."""
    models = mission.vehicle_models
    assert models is not None
    n, autopilot, d = len(models), mission.autopilot, mission.all_disturbances
    made = [kernel_vehicle(model, m) for model, m in zip(models, mission.true_mass, strict=True)]
    # A force is held over each step: twenty of them meet a smooth pulse to 1 %
    longest = min(autopilot.step, _FORCED if max_step < math.inf else math.inf, max_step / 10.0)
    steps = max(1, math.ceil(1.0 / autopilot.rate / longest - 1e-9))
    flight = fleet.new_ideal_flight(
        fleet.quadrotor_arrays(made, mission.gravity),
        start=0.0,
        h=1.0 / (autopilot.rate * steps),
        steps=steps,
        every=max(1, round(autopilot.rate / autopilot.formation_rate)),
    )
    guidance = fleet.Guidance(
        np.full(n, float(mission.tracking.drag_feedforward)),
        np.full((n, 3), mission.tracking.integral),
    )
    around = mission_disturbance(mission)
    same = ("wind", "gust_step", "gust", "floor", "radius", "roofs")
    air = flight.air._replace(
        **{name: getattr(around, name) for name in same},
        downwash=d.downwash,
        ground_effect=d.ground_effect,
        density=DENSITY,
        ground=mission.ground,
    )
    return flight._replace(
        air=air, guidance=guidance, sensing=_sensing_in_ticks(mission), network=network_of(mission),
        clocks=clocks_of(mission),
    )  # fmt: skip


def lags_by_vehicle(mission: Mission) -> list[Lag]:
    """Lag and delay of each vehicle; empty for points that give any force at once."""
    models = mission.vehicle_models
    if models is None:
        return []
    noise, autopilot = mission.all_disturbances.noise, mission.autopilot
    delay, rate = 0.0, autopilot.formation_rate
    if noise is not None:
        # Delays are whole ticks; a law that is quicker than its measurements acts at their rate.
        delay = round(noise.delay * autopilot.rate) / autopilot.rate
        rate = min(rate, noise.rate)
    return [
        Lag(delay=delay, rate=rate, point=True)
        if model.point
        else Lag(*model.attitude_gains, tau=max(model.motor_time), delay=delay, rate=rate)
        for model in models
    ]


def tracking_lag_times(mission: Mission) -> Floats:
    """Times T (N,) [s] by which a vehicle leaves its reference at most (`margins.tracking_lag_time`); 0 for points.

    Its acceleration differs by up to T times the reference's greatest jerk, its velocity by up to T times the greatest
    acceleration.
    """
    times = np.zeros(mission.n_agents)
    c, tracking, lags = mission.constraint, mission.tracking, lags_by_vehicle(mission)
    law = LoopGains(c.alpha, c.beta, c.gamma, *mission.tracking_gains, tracking.integral)
    for i, model in enumerate(mission.vehicle_models or ()):
        if not model.point:
            left = _LEFT * max(model.linear_drag)
            drag = left if tracking.drag_feedforward else model.linear_drag[0]
            times[i] = tracking_lag_time(lags[i], law, drag / model.mass)
    return times


def drag_and_lift(mission: Mission, u: Floats, who: Ints | slice = slice(None)) -> Floats:
    """Drag and lift (..., N, 3) [N] of air that moves at u (..., N, 3) [m/s] past vehicles, level near hover."""
    models = mission.vehicle_models
    if models is None:
        return mission.drag[who, None] * u
    linear, body, lift = (
        np.array([getattr(model, name) for model in models])[who]
        for name in ("linear_drag", "body_drag", "rotor_lift")
    )
    force = (linear + body * np.linalg.norm(u, axis=-1, keepdims=True)) * u
    force[..., 2] += 4.0 * lift * (u[..., :2] ** 2).sum(axis=-1)
    return force


def pair_jet_speeds(mission: Mission, r: Floats) -> Floats:
    """Speed [m/s] of the air downwards at each vehicle due to each other one above, (K, N, N) at r (K, N, 3) [m]."""
    below = r[:, None] - r[:, :, None]
    flow, s, beside = np.zeros(below.shape[:3]), below[..., 2], (below[..., :2] ** 2).sum(axis=-1)
    for j, model in enumerate(mission.vehicle_models or ()):
        if not model.point:
            hover = model.mass * mission.gravity, DENSITY, model.rotor_radius, 2.0 * model.arm
            speed = fleet.downwash_speed(*hover, np.maximum(s[..., j], 0.0), beside[..., j])
            flow[..., j] = np.where(s[..., j] > 0.0, speed, 0.0)
    return flow


def kernel_vehicle(model: VehicleModel, mass: float) -> fleet.VehicleDynamics:
    """The kernel's form of a vehicle with a true mass [kg]."""
    if model.point:
        return fleet.VehicleDynamics(
            m=mass, drag=(model.drag,) * 3, point=True, limit=model.thrust_limit
        )
    up, down = model.motor_time
    k_R, k_omega = model.attitude_gains
    return fleet.VehicleDynamics(
        m=mass,
        inertia=model.inertia,
        rotors=np.column_stack([model.arm * ROTORS[:, :2], np.zeros(4)]),
        spin=ROTORS[:, 2],
        thrust=(0.0, 0.0, model.thrust_coefficient),
        torque=(0.0, 0.0, model.torque_coefficient),
        rotor_drag=(model.rotor_drag, model.rotor_inflow),
        lift=model.rotor_lift,
        c=model.body_drag,
        motor=(1.0 / up, 0.0, 1.0 / down, 0.0),
        speed=model.rotor_speed,
        k_R=(k_R,) * 3,
        k_omega=(k_omega,) * 3,
        tilt=math.radians(model.tilt_limit_deg),
        radius=model.rotor_radius,
    )


def _sensing_in_ticks(mission: Mission) -> fleet.Sensing:
    """Rate and delay of measurements, in whole ticks of the attitude control."""
    n, rate, noise = mission.n_agents, mission.autopilot.rate, mission.all_disturbances.noise
    if noise is None:
        return fleet.exact_sensing(n)
    return fleet.Sensing(max(1, round(rate / noise.rate)), np.full(n, round(noise.delay * rate)))


def network_of(mission: Mission) -> Links:
    """The network of a mission in whole ticks of the attitude control; one that nobody uses if it has none."""
    net, n, rate = mission.network, mission.n_agents, mission.autopilot.rate
    if net is None:
        return no_network(n)
    links, reverse = links_and_reverses(mission.edges)
    worsens, recovers = gilbert_transitions(net.loss, net.burst)
    every, jitter = max(1, round(rate / net.broadcast_rate(n))), round(net.jitter * rate)
    delay, silence = max(1, round(net.delay * rate)), max(1, round(net.silence * rate))
    # As many messages within the time of silence as are all lost once in a thousand times, and two at least.
    tries = math.ceil(math.log(_ALL_LOST) / math.log(1.0 - recovers)) if recovers < 1.0 else 1
    longest = (silence - delay - jitter) // max(tries, 2)
    seed = net.seed & 0xFFFFFFFF, net.seed >> 32 & 0xFFFFFFFF
    out = [
        [*(sorted(x - 1 for x in one.between) or (-1, -1)), one.start * rate, one.end * rate]
        for one in net.outages
    ] + [[*(x - 1 for x in one.between), one.time * rate, np.inf] for one in net.lost]
    return Links(
        every=every,
        delay=delay,
        jitter=jitter,
        worsens=worsens,
        recovers=recovers,
        range=net.range if net.range is not None else np.inf,
        silence=silence,
        seed=np.array(seed, dtype=np.int64),
        links=links,
        first=np.searchsorted(links[:, 0], np.arange(n + 1)).astype(np.int64),
        reverse=reverse,
        outages=np.array(out, dtype=np.float64).reshape(-1, 4),
        event=net.event or 0.0,
        longest=max(longest // every * every, 1),
        lag=_ESTIMATE,
    )


def links_and_reverses(edges: Ints) -> tuple[Ints, Ints]:
    """Links (L, 2) both ways along edges (m, 2), sorted, and of each (L,) the one that leads back."""
    links = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0).astype(np.int64)
    return links, np.lexsort(links.T)


def gilbert_transitions(loss: float, burst: float | None) -> tuple[float, float]:
    """Probabilities with which a link begins and ends to lose messages, by the share lost and the mean burst.

    In a chain of two states, bursts of mean length L end with 1/L, and the share of the bad state is the loss.
    """
    recovers = 1.0 - loss if burst is None else 1.0 / burst
    return loss * recovers / (1.0 - loss), recovers


def clocks_of(mission: Mission) -> VehicleClocks:
    """The clocks by which vehicles fly; one for all if the mission has neither [network.clocks] nor stuck vehicles."""
    net, stuck, n = mission.network, mission.all_disturbances.stuck, mission.n_agents
    clocks = None if net is None else net.clocks
    if net is None or not (clocks or stuck):
        return shared_clock(n)
    rate = mission.autopilot.rate
    rows = [[x.agent - 1, round(x.time * rate), round((x.time + x.duration) * rate)] for x in stuck]
    made = shared_clock(n)._replace(own=True, stuck=np.array(rows, dtype=np.int64).reshape(-1, 3))
    if clocks is None:
        return made

    def random_values(value: float | tuple[float, ...], stream: int, least_share: float) -> Floats:
        if isinstance(value, tuple):
            return np.array(value, dtype=np.float64)
        return value * np.random.default_rng((stream, net.seed)).uniform(least_share, 1.0, n)

    return made._replace(
        late=(random_values(clocks.late, _LATE, 0.0) * rate).round().astype(np.int64),
        drift=1e-6 * random_values(clocks.drift, _DRIFT, -1.0),
        gain=clocks.consensus,
        wait=math.inf if clocks.wait is None else clocks.wait,
    )


class TickTables:
    """Tables of a flight for ranges of ticks: references of the attitude control, noise, dropped measurements."""

    def __init__(self, mission: Mission, flight: fleet.SampledFlight) -> None:
        self.flight, self.n = flight, mission.n_agents
        self.rate = mission.autopilot.rate
        self.noise = mission.all_disturbances.noise
        self.yaw = mission.yaw
        self.linear_drag = np.array([model.linear_drag for model in mission.vehicle_models or ()])
        self.compensated = mission.autopilot.delay_compensation
        #: What states were last measured about: the problem of the path, or a point to stay at.
        self._source: Problem | None = None
        self._anchor = np.zeros((self.n, 6))
        #: Where the yaw "along" of a turn is known from, to continue from table to table: time [s], yaw (N,).
        self._known: tuple[YawTurn, float, Floats] | None = None

    def switch_path(
        self, problem: Problem, tick: int, tables: fleet.TickInputs, tau: Floats | None = None
    ) -> Floats:
        """Begin to measure states about another path; return where the one before is (N, 6), by its ``tables``.

        While slots are tracked, the path is that of the reference. Otherwise it stays where it is. Of own clocks,
        ``tau`` says how they stand (`kernel.clock_records`).
        """
        k = tick - tables.first
        before = tables.path[k] if 0 <= k < len(tables.path) else self._path_by_clocks(tick, tau)
        if problem.control.tracks_slots:
            self._source = problem
        else:
            self._source, self._anchor = None, before
        return before

    def delay_path(self, late: float) -> None:
        """Take the path that states were last measured about as later by some time [s]."""
        if self._source is not None:
            self._source = postpone(self._source, late)

    def _path_by_clocks(self, tick: int, tau: Floats | None) -> Floats:
        """The path (N, 6) at a tick, of each vehicle by its own clock, if it has one."""
        if tau is None:
            return self._path(np.array([tick]))[0]
        path = self._path(tick + tau[:, OFF] * self.rate).diagonal(axis1=0, axis2=1).T.copy()
        path[:, 3:] *= tau[:, RATE, None]
        return path

    def _path(self, ticks: Floats | Ints) -> Floats:
        if self._source is None:
            return np.tile(self._anchor, (len(ticks), 1, 1))
        reference, motion = self._source.reference, self._source.motion
        states = slot_derivatives(reference, motion, ticks / self.rate, 2)
        return np.ascontiguousarray(np.concatenate([states[:, 0], states[:, 1]], axis=2))

    def tables_for(
        self, first: int, last: int, problem: Problem, turn: YawTurn, tau: Floats | None = None
    ) -> fleet.TickInputs:
        """Tables for ticks from ``first`` to before ``last``; ``turn`` is that of the phase.

        With clocks of their own, which stand at ``tau``, references are those of all ticks that a clock may come to.
        """
        sensing, ticks, origin = self.flight.sensing, np.arange(first, last), first
        if tau is not None:
            begun = math.ceil(turn.begun * self.rate - 1e-6)
            slow, fast = math.floor(tau[:, OFF].min() * self.rate), tau[:, OFF].max() * self.rate
            origin = max(begun, first + slow)
            end = last + math.ceil(fast + (FASTEST - 1.0) * (last - first)) + 2
            ticks = np.arange(origin, max(end, origin + 2))
        yaw = jerk = snap = np.zeros((0, self.n, 3))
        slots, path = np.zeros(0), np.zeros((0, self.n, 6))
        if not self.flight.vehicles.point.all() or self.yaw.kind == "along":
            # An ideal point has no attitude that goes ahead of its force.
            yaw, slots = self._yaw_and_slots(problem, ticks / self.rate, turn)
            if len(slots):
                jerk, snap = self._desired_jerk_and_snap(slots)
        if self.compensated:
            path = _by_tick(slots[:2].reshape(6, self.n, -1)) if len(slots) else self._path(ticks)
        noise_r = noise_v = np.zeros((0, self.n, 3))
        dropped = np.zeros((0, self.n), dtype=np.bool_)
        if self.noise is not None:
            # Which multiples of the ticks between measurements lie there.
            rows = range(-(-first // sensing.every), -(-last // sensing.every))
            if self.noise.position or self.noise.velocity:
                white = _random_rows(_NOISE, self.noise.seed, rows, (2, self.n, 3))
                noise_r = np.ascontiguousarray(self.noise.position * white[:, 0])
                noise_v = np.ascontiguousarray(self.noise.velocity * white[:, 1])
            if self.noise.dropped:
                uniform = _random_rows(_DROPPED, self.noise.seed, rows, (self.n,))
                dropped = uniform < self.noise.dropped
        made = fleet.TickInputs(first, last, path, yaw, jerk, snap, noise_r, noise_v, dropped)
        if tau is None:
            return made
        # Rows of single ticks are taken in flight from those of all
        parts = [x if len(x) else np.zeros((len(ticks), *x.shape[1:])) for x in made[2:6]]
        path, yaw, jerk, snap = (np.zeros((last - first, *x.shape[1:])) for x in parts)
        path[0] = self._path_by_clocks(first, tau) if self.compensated else 0.0
        return made._replace(
            path=path, yaw=yaw, jerk=jerk, snap=snap, by_clock=np.concatenate(parts, axis=2), origin=origin,
        )  # fmt: skip

    def yaw_at(self, problem: Problem, t: float, turn: YawTurn) -> Floats:
        """Yaw and its rate (2, N) [rad, rad/s] asked of each vehicle at a time [s] of a phase."""
        if t <= turn.begun:
            return turn.start
        return self._yaw_and_slots(problem, np.array([t]), turn)[0][0, :, :2].T

    def _yaw_and_slots(self, problem: Problem, t: Floats, turn: YawTurn) -> tuple[Floats, Floats]:
        """Yaw with two derivatives (K, N, 3) of each vehicle at times (K,) [s], and derivatives (5, 3, N, K) of slots.

        A vehicle turns with the formation, or from its yaw at the start of the phase into the one asked for.
        """
        if not problem.control.tracks_slots:
            still = np.zeros((len(t), self.n, 3))
            still[..., 0] = turn.start[0]
            return still, np.zeros((0, 3, self.n, len(t)))
        reference, motion = problem.reference, problem.motion
        since, start = turn.begun, turn.start
        if self._known is not None and self._known[0] is turn and self._known[1] < t[0]:
            since, start = self._known[1], self._known[2][None]
        whole = np.concatenate([[since], t])
        slots, turned, known = slot_taylor_and_yaw(
            reference, motion, whole, self.yaw, turn._replace(start=start)
        )
        if known is not None:
            self._known = turn, *known
        return _by_tick(turned[..., 1:]), series.taylor_derivatives(slots[..., 1:])

    def _desired_jerk_and_snap(self, derivatives: Floats) -> tuple[Floats, Floats]:
        """Two derivatives (K, N, 3) of the desired force per mass, from those of the reference, (5, 3, N, K).

        Drag that is fed forward changes the force with the velocity; near level flight body axes are the world's.
        """
        _, v, a, j, s = derivatives
        vehicles = self.flight.vehicles
        share = self.flight.guidance.drag / vehicles.m
        D, c = (share[:, None] * drag.T[..., None] for drag in (self.linear_drag, vehicles.c))
        jerk, snap = j + D * a, s + D * j
        if c.any():
            speed = np.sqrt((v * v).sum(axis=0) + _STILL**2)
            faster = (v * a).sum(axis=0) / speed
            curve = ((a * a + v * j).sum(axis=0) - faster**2) / speed
            jerk += c * (speed * a + faster * v)
            snap += c * (speed * j + 2.0 * faster * a + curve * v)
        return _by_tick(jerk), _by_tick(snap)


def initial_yaw_and_rate(mission: Mission) -> Floats:
    """Yaw and its rate (2, N) [rad, rad/s] with which vehicles start."""
    start, frame = np.zeros((2, mission.n_agents)), mission.body_frame
    start[0] = 0.0 if frame is None else math.radians(frame.yaw_deg)
    return start


class YawTurn(NamedTuple):
    """How vehicles turn from their yaw at a time into the one asked for."""

    begun: float  # [s]
    start: Floats  # (2, N) yaw and its rate there [rad, rad/s]
    off: Floats  # (2, N) what these differ by from those asked for


def yaw_turn_from(problem: Problem, t: float, yaw: VehicleYaw, start: Floats) -> YawTurn:
    """The turn of vehicles with yaws and rates ``start`` (2, N) at a time [s] of a problem, at which its motion begins.

    Where no slots are tracked, they keep their yaw.
    """
    if not problem.control.tracks_slots:
        still = start * np.array([[1.0], [0.0]])
        return YawTurn(t, still, np.zeros_like(start))
    return yaw_turn(problem.reference, problem.motion, t, yaw, start)


def yaw_turn(
    reference: Reference, motion: Motion, t: float, yaw: VehicleYaw, start: Floats
) -> YawTurn:
    """`yaw_turn_from` while slots are tracked."""
    if yaw.kind == "along":
        return YawTurn(t, start, np.zeros_like(start))
    off = start - yaw_derivatives(reference, motion, np.array([t]), yaw)[0, :2]
    off[1, np.abs(off[1]) < _SAME_RATE] = 0.0
    if yaw.kind != "formation":
        off[0] = (off[0] + np.pi) % (2.0 * np.pi) - np.pi
    return YawTurn(t, start, off)


def slot_taylor_and_yaw(
    reference: Reference, motion: Motion, time: Floats, yaw: VehicleYaw, turn: YawTurn
) -> tuple[Floats, Floats, tuple[float, Floats] | None]:
    """Series of the slots (5, 3, N, K), and the yaw with two derivatives (3, N, K) that is asked of the vehicles.

    Yaw "along" continues from ``turn.start`` at ``time[0]``; it is known at the time returned beside (see `yaw_along`).
    A rate that differs at first, as that of a body that turns no more, fades as tau (1 - s), with the blend s.
    """
    body = body_taylor(motion, time)
    slots = slot_taylor(reference, body, time)
    if yaw.kind == "along":
        return slots, *yaw_along(reference, motion, time, slots, turn.start[0])
    turned = yaw_derivatives_but_along(body, slots, yaw)
    turned[0] += turn.off[0, :, None]
    done = blend_taylor(time, turn.begun, _TURN_TIME)[:3]
    if yaw.kind != "formation":
        turned -= series.taylor_derivatives(done)[:, None] * turn.off[0, :, None]
    if turn.off[1].any():
        tau = np.stack([time - turn.begun, np.ones_like(time), np.zeros_like(time)])
        fading = series.taylor_derivatives(tau - series.product(tau, done))
        turned += fading[:, None] * turn.off[1, :, None]
    return slots, turned, None


def _by_tick(x: Floats) -> Floats:
    """A table (K, N, Q) of values (Q, N, K)."""
    return np.ascontiguousarray(x.T)


def _random_rows(kind: int, seed: int, rows: range, shape: tuple[int, ...]) -> Floats:
    """Random numbers (K, *shape) of some rows: normal ones for noise, else uniform ones."""
    if not rows:
        return np.zeros((0, *shape))
    blocks = range(rows[0] // _BLOCK, rows[-1] // _BLOCK + 1)
    numbers = np.concatenate([_random_block(kind, seed, block, shape) for block in blocks])
    begin = rows[0] - blocks[0] * _BLOCK
    return numbers[begin : begin + len(rows)]


def _random_block(kind: int, seed: int, block: int, shape: tuple[int, ...]) -> Floats:
    random = np.random.default_rng((kind, seed, block))
    size = (_BLOCK, *shape)
    return random.standard_normal(size) if kind == _NOISE else random.random(size)
