"""A fleet of quadrotors and its sampled flight as arrays, read and written by `sampled_flight`.

N vehicles, m edges. World axes are x, y horizontal and z up; body axes are x forward, y left, z up. A quaternion has
its scalar first, and T(q) takes world axes to body axes, as in `rigidfleet.math.attitude`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.kernel.clock_records import VehicleClocks, clocks_at_start, shared_clock
from rigidfleet.kernel.mail import Links, Mail, empty_mail, no_network
from rigidfleet.kernel.problem import Workspace, padded, zeros
from rigidfleet.kernel.records import NO_TRAIL, Trail
from rigidfleet.solids.records import Solids, join_solids
from rigidfleet.typing import Bools, Floats, Ints

#: State of a vehicle: r (3) [m], v (3) [m/s], q (4), omega (3) [rad/s, body axes], speeds of the rotors (4) [rad/s].
STATES = 17
#: What commands the vehicles (`Commands.kind`): the desired forces of the formation law; thrust and attitude; rotors;
#: forces by laws of their own, which the flight asks for.
FORCE, ATTITUDE, ROTOR_SPEEDS, OWN = range(4)
#: Places in `SampledState.clock`: the time, and that of the last evaluation of the law [s].
TIME, LAW_TIME = range(2)
#: Places in `SampledState.count`: steps of the grid that are complete, attitude ticks done, law ticks done, samples
#: written, steps in the trail, ticks up to which own laws have answered.
STEPS, TICKS, LAW_TICKS, SAMPLES, TRAILED, ANSWERED = range(6)
#: Columns of `SampledState.worst`: least cosine of the tilt; greatest tracking error [m], acceleration [m/s^2], thrust
#: [N], constraint force [N], horizontal and vertical acceleration [m/s^2].
UPRIGHT, ERROR, ACCELERATION, LOAD, CONSTRAINT_FORCE, HORIZONTAL, VERTICAL = range(7)
#: A tick that no flight reaches (`TickInputs.last`).
ENDLESS = 1 << 62


def thrust_of(speed, k0, k1, k2):
    """Thrust [N] (or torque [N m]) of a rotor at a speed [rad/s], by a quadratic curve."""
    return k0 + speed * (k1 + k2 * speed)


def speed_of(thrust, k0, k1, k2):
    """Speed [rad/s] of a rotor with a thrust [N]: the greater root; that of the least thrust, if it is less."""
    return (np.sqrt(np.maximum(0.0, k1 * k1 + 4.0 * k2 * (thrust - k0))) - k1) / (2.0 * k2)


@dataclass(frozen=True)
class VehicleDynamics:
    """One quadrotor, or one ideal point.

    A rotor at speed w [rad/s] has the thrust ``thrust[0] + thrust[1] w + thrust[2] w^2`` [N] and the torque about its
    axis ``torque[0] + torque[1] w + torque[2] w^2`` [N m]. Its speed follows the command c by
    ``(c - w) (a + b (c + w))``, with (a, b) = ``motor[:2]`` if it rises and ``motor[2:]`` if it falls; a first-order
    lag is a = 1/tau, b = 0. A ``point`` delivers any force at once, up to ``limit``; then only m, drag and limit
    matter.

    Raises
    ------
    ValueError
        The rotors do not span thrust and three torques, or do not surround the centre of mass.
    """

    m: float  # [kg]
    inertia: ArrayLike = (1.0, 1.0, 1.0)  # (3,) about the body axes [kg m^2]
    rotors: ArrayLike = ((1, 1, 0), (1, -1, 0), (-1, -1, 0), (-1, 1, 0))  # (4, 3) [m]
    spin: ArrayLike = (1, -1, 1, -1)  # (4,) sign of the torque of each rotor on the body
    thrust: ArrayLike = (0.0, 0.0, 1.0)  # (3,) [N], [N s/rad], [N s^2/rad^2]
    torque: ArrayLike = (0.0, 0.0, 1.0)  # (3,) [N m], ...
    rotor_drag: ArrayLike = (
        0.0,
        0.0,
    )  # (2,) in and along the rotor's axis [N s^2/(m rad)]: k_d, k_z
    lift: float = 0.0  # translational lift of a rotor k_h [N s^2/m^2]
    c: ArrayLike = (0.0, 0.0, 0.0)  # (3,) parasitic drag, body axes [N s^2/m^2]
    drag: ArrayLike = (0.0, 0.0, 0.0)  # (3,) linear drag, body axes [N s/m]
    rotor_inertia: float = 0.0  # of a rotor and its motor about its axis [kg m^2]
    motor: ArrayLike = (1.0, 0.0, 1.0, 0.0)  # (4,) [1/s], [1/rad], up and down
    speed: ArrayLike = (0.0, 1.0)  # (2,) least and greatest speed of a rotor [rad/s]
    k_R: ArrayLike = (1.0, 1.0, 1.0)  # (3,) attitude gain per unit inertia [1/s^2]
    k_omega: ArrayLike = (1.0, 1.0, 1.0)  # (3,) rate gain per unit inertia [1/s]
    tilt: float = np.pi  # limit of the thrust vector's tilt [rad]; none from pi/2
    radius: float = 0.0  # of a rotor [m], for downwash and ground effect; 0: none
    point: bool = False
    limit: float = np.inf  # of a point's force [N]

    def rotor_thrust_at(self, speed: ArrayLike) -> Floats:
        """Thrust [N] of a rotor at a speed [rad/s]."""
        return thrust_of(np.asarray(speed, dtype=float), *np.asarray(self.thrust, dtype=float))

    def rotor_speed_at(self, thrust: ArrayLike) -> Floats:
        """Speed [rad/s] of a rotor with a thrust [N]."""
        return speed_of(np.asarray(thrust, dtype=float), *np.asarray(self.thrust, dtype=float))

    def wrench_to_rotors(self, g: float) -> Floats:
        """Matrix (4, 4) from thrust [N] and torque [N m] to the rotors' forces.

        The ratio of a rotor's torque to its thrust is that at hover; without gravity, that at half the greatest thrust.
        """
        if self.point:
            return np.zeros((4, 4))
        hover = self.rotor_speed_at(0.25 * self.m * g or 0.5 * self.rotor_thrust_at(self.speed)[1])
        torque = thrust_of(hover, *np.asarray(self.torque, dtype=float))
        ratio = torque / self.rotor_thrust_at(hover)
        rotors, spin = np.asarray(self.rotors, dtype=float), np.asarray(self.spin, dtype=float)
        mixing = np.stack([np.ones(4), rotors[:, 1], -rotors[:, 0], ratio * spin])
        if np.linalg.matrix_rank(mixing) < 4:
            raise ValueError(
                f"rotors at {rotors.tolist()} that turn by {spin.tolist()} do not span thrust and three torques; move"
                " one, or turn it the other way"
            )
        inverse = np.linalg.inv(mixing)
        if not (inverse[:, 0] > 0.0).all():
            raise ValueError(
                f"rotors at {rotors.tolist()} cannot hover: one of them would have to pull down; place them around the"
                " centre of mass"
            )
        return inverse


class Quadrotors(NamedTuple):
    """Vehicles as arrays; see `VehicleDynamics` for meanings and units."""

    m: Floats  # (N,) true mass
    inertia: Floats  # (N, 3)
    rotors: Floats  # (N, 4, 3)
    spin: Floats  # (N, 4)
    thrust: Floats  # (N, 3)
    torque: Floats  # (N, 3)
    rotor_drag: Floats  # (N, 2)
    lift: Floats  # (N,)
    c: Floats  # (N, 3)
    drag: Floats  # (N, 3)
    rotor_inertia: Floats  # (N,)
    motor: Floats  # (N, 4)
    speed: Floats  # (N, 2)
    force: Floats  # (N, 2) least and greatest thrust of a rotor [N]
    unmix: Floats  # (N, 4, 4)
    k_R: Floats  # (N, 3)
    k_omega: Floats  # (N, 3)
    tilt: Floats  # (N,)
    radius: Floats  # (N,)
    span: Floats  # (N, 2) distance of neighbouring and of opposite rotors [m]
    point: Bools  # (N,)
    limit: Floats  # (N,)
    lost: Bools  # (N,) without thrust
    g: float  # [m/s^2]


class Air(NamedTuple):
    """What surrounds the vehicles."""

    wind: Floats  # (3,) steady, world [m/s]
    gust_step: float  # between knots [s]
    gust: Floats  # (K, N, 3) coefficients of cubic B-splines over time [m/s]; see `disturbances.write_spline_value`
    downwash: bool  # see `aerodynamics.add_downwash_to_air`
    ground_effect: bool  # see `aerodynamics.ground_effect_factor`
    density: float  # [kg/m^3]
    ground: float  # height of the ground [m]
    floor: Floats  # (N,) height at which a lost vehicle comes to rest on it [m]
    radius: Floats  # (N,) by which this is above the ground [m]
    roofs: Solids  # boxes and height maps that are ground where they are below a vehicle


class Sensing(NamedTuple):
    """What the formation law knows; attitude, rates and rotor speeds are known to each vehicle at once."""

    every: int  # attitude ticks between measurements
    delay: Ints  # (N,) attitude ticks from a state to its measurement


class Guidance(NamedTuple):
    """What is added to the forces of the formation law, after it: the constraint law would cancel it.

    Both act in phases with tracking.
    """

    drag: Floats  # (N,) share of the drag at the reference velocity, in still air, that is fed forward
    k_i: Floats  # (N, 3) integral gain of the tracking error, world axes [1/s^3]


class TickInputs(NamedTuple):
    """Values for attitude ticks from ``first`` to before ``last``, where the flight pauses for the next ones.

    A table without rows stands for zeros, or for nothing dropped. K = last - first ticks. A measurement takes place
    at multiples of `Sensing.every`; its tables have a row for each.
    """

    first: int
    last: int
    path: Floats  # (K, N, 6) r, v about which states are measured; see `sampled_flight.measure_states`
    yaw: Floats  # (K, N, 3) yaw [rad], its rate and acceleration
    jerk: Floats  # (K, N, 3) of the reference [m/s^3]
    snap: Floats  # (K, N, 3) [m/s^4]
    noise_r: Floats  # (K', N, 3) of measurements [m]
    noise_v: Floats  # (K', N, 3) [m/s]
    dropped: Bools  # (K', N) measurements that fail
    #: with clocks of their own, path, yaw, jerk and snap (K'', N, 15) by the clocks' ticks from ``origin`` on, of which
    #: those of each tick are taken in flight
    by_clock: Floats = np.zeros((0, 0, 15))
    origin: int = 0


class Commands(NamedTuple):
    """Commands of a user's controller, held until it gives others; with ``kind`` FORCE, the formation law commands."""

    kind: int
    thrust: Floats  # (N,) along the body's z axis [N]
    attitude: Floats  # (N, 4) quaternion
    rates: Floats  # (N, 3) of that attitude, in its own body axes [rad/s]
    speeds: Floats  # (N, 4) of the rotors [rad/s]


class SampledFlight(NamedTuple):
    """All that a sampled flight reads, beside the `Problem` of its formation law."""

    vehicles: Quadrotors
    air: Air
    sensing: Sensing
    network: Links  # how vehicles know each other
    clocks: VehicleClocks  # and by which time they fly
    guidance: Guidance
    tables: TickInputs
    commands: Commands
    start: float  # time of tick 0 [s]
    h: float  # step of integration [s]
    steps: int  # steps between attitude ticks
    every: int  # attitude ticks between evaluations of the formation law


class SampledState(NamedTuple):
    """State of a sampled flight, which can pause at any step and go on to the same bits; all of it is written.

    ``work`` is overwritten by each step and need not be kept.
    """

    S: Floats  # (N, 17) true states
    clock: Floats  # (2,) see `TIME`
    count: Ints  # (6,) see `STEPS`
    integral: (
        Floats  # (m,) of the constraints [m s]; with a network, the mean of what both ends hold
    )
    frame: Floats  # (3, 4) mean-axis quaternion at the last evaluation, its rate, the one before
    error: Floats  # (N, 3) integral of the tracking error [m s]
    f_u: Floats  # (N, 3) input force of the law, held [N]
    f_C: Floats  # (N, 3) its constraint force [N]
    force: Floats  # (N, 3) desired force [N]
    push: Floats  # (N, 3) a user's external force [N]
    command: Floats  # (N, 4) rotor speeds [rad/s]; force of a point (3) [N], 0
    saturated: Bools  # (N,) at the last tick
    layers: Ints  # (N,) of avoidance that have acted at the last tick; see `avoidance.ACTS`
    seen: Floats  # (N, 6) measured r, v
    history: Floats  # (D, N, 6) true r, v of the last ticks
    mail: Mail
    tau: Floats  # (N, 18) each vehicle's own clock, see `clock_records.OFF`
    peak: Floats  # (N, 4) greatest thrust of each rotor [N]
    peak_time: Floats  # (N, 4) [s]
    worst: Floats  # (N, 7) see `UPRIGHT`
    worst_time: Floats  # (N, 7) [s]
    saturations: Ints  # (N,) number of ticks saturated
    trail: Trail  # of r and v, (S, 5, 6 N)
    work: "SampledWork"


class SampledWork(NamedTuple):
    """Work arrays of a sampled flight."""

    y: Floats  # (7, 17 N padded to eights) start, trial, four derivatives, end
    air: Floats  # (3, N, 3) velocity of the air: start, middle and end of a step [m/s]
    T: Floats  # (3, 3)
    desired: Floats  # (5, 3) desired attitude (3, 3), its rates and accelerations
    x: Floats  # (4, 4)
    law_time: Floats  # (1,)
    law_state: Floats  # (1, 6 N + m + 4) as `dynamics.closed_loop` reads it
    law_rate: Floats  # (6 N + m + 4,)


class SampledSegment(NamedTuple):
    """End of a flight, and the samples to write on the way; K rows."""

    t_end: float  # [s]
    max_steps: int  # after which to pause
    recorder: int  # address of the recorder, with its arguments
    segment: int
    record: int
    guard: int  # address of avoidance in flight, and of its record; 0 for none
    avoidance: int
    times: Floats  # (K,) [s], increasing
    S: Floats  # (K, N, 17)
    dS: Floats  # (K, N, 17) derivative
    command: Floats  # (K, N, 4)
    f_u: Floats  # (K, N, 3)
    f_C: Floats  # (K, N, 3)
    seen: Floats  # (K, N, 6)
    saturated: Bools  # (K, N)
    layers: Ints  # (K, N)
    tau: Floats  # (K, N, 3) clocks: tau - t [s], dtau/dt, ds/dt [1/s]
    integral: Floats  # (K, m) of the constraints
    frame: Floats  # (K, 4)
    stamp: Ints  # (K, L) tick at which the newest message of each link was sent


# Turbulent jet below a hovering quadrotor: decay and spread of its far field, and its virtual origin in distances of
# opposite motors (Bauersfeld et al. 2024, arXiv:2403.13321, the ninth equation).
_DECAY, _SPREAD, _ORIGIN = 10.11, 0.07668, -5.817


def downwash_speed(weight, density, radius, span, s, rr):
    """Speed [m/s] of the air below a hovering quadrotor, along its z axis.

    At a distance s [m] below the vehicle along that axis and r beside it, with l the distance of opposite motors and
    x = s/l + 5.817 (Bauersfeld et al. 2024, arXiv:2403.13321),

        U = 10.11 U_H / (x (1 + (sqrt(2) - 1) (r / (0.07668 l x))^2)^2),  U_H^2 = m g / (8 pi density radius^2).

    The fit holds from s = 2.5 l on and for hover; nearer, it is an extrapolation.

    Parameters
    ----------
    weight : m g [N]
    density : of the air [kg/m^3]
    radius : of a rotor [m]
    span : distance of opposite motors l [m]
    s, rr : distance below [m], squared distance beside the axis [m^2]
    """
    far = s / span - _ORIGIN
    width = _SPREAD * span * far
    profile = 1.0 + (math.sqrt(2.0) - 1.0) * rr / (width * width)
    hover = math.sqrt(weight / (8.0 * math.pi * density * radius * radius))
    return hover * _DECAY / (far * profile * profile)


# -- making them -------------------------------------------------------------------------------------


def quadrotor_arrays(vehicles: Sequence[VehicleDynamics], g: float = 9.81) -> Quadrotors:
    """Put vehicles into arrays."""

    def parameter_rows(name: str) -> Floats:
        return np.ascontiguousarray([getattr(v, name) for v in vehicles], dtype=float)

    names = set(Quadrotors._fields) - {"force", "unmix", "span", "point", "lost", "g"}
    gaps = [
        np.linalg.norm(np.asarray(v.rotors, dtype=float)[1:] - np.asarray(v.rotors)[0], axis=1)
        for v in vehicles
    ]
    return Quadrotors(
        **{name: parameter_rows(name) for name in names},
        force=np.array([v.rotor_thrust_at(v.speed) for v in vehicles]),
        unmix=np.array([v.wrench_to_rotors(g) for v in vehicles]),
        span=np.array([[gap.min(), gap.max()] for gap in gaps]),
        point=np.array([v.point for v in vehicles]),
        lost=np.zeros(len(vehicles), dtype=np.bool_),
        g=g,
    )


def still_air(n: int) -> Air:
    """Air at rest, without downwash and ground effect."""
    nothing = np.full(n, -np.inf), np.zeros(n), join_solids([])
    return Air(np.zeros(3), 1.0, np.zeros((0, n, 3)), False, False, 1.225, 0.0, *nothing)


def exact_sensing(n: int) -> Sensing:
    """States that are known exactly and at once."""
    return Sensing(1, np.zeros(n, dtype=np.int64))


def empty_inputs(n: int) -> TickInputs:
    """No feedforward, yaw 0, no noise, nothing dropped."""
    none = np.zeros((0, n, 3))
    return TickInputs(
        0, ENDLESS, np.zeros((0, n, 6)), none, none, none, none, none, np.zeros((0, n), dtype=np.bool_),
    )  # fmt: skip


def no_commands(n: int) -> Commands:
    """The formation law commands the vehicles."""
    return Commands(
        FORCE, np.zeros(n), np.tile([1.0, 0, 0, 0], (n, 1)), np.zeros((n, 3)), np.zeros((n, 4))
    )


def new_ideal_flight(
    vehicles: Quadrotors, *, start: float, h: float, steps: int, every: int = 1
) -> SampledFlight:
    """A flight in still air with exact sensing; see `SampledFlight`. Replace parts of it by ``_replace``."""
    n = len(vehicles.m)
    return SampledFlight(
        vehicles, still_air(n), exact_sensing(n), no_network(n), shared_clock(n),
        Guidance(np.zeros(n), np.zeros((n, 3))), empty_inputs(n), no_commands(n), start, h, steps, every,
    )  # fmt: skip


def hover_states(vehicles: Quadrotors, r: ArrayLike, v: ArrayLike, yaw: ArrayLike = 0.0) -> Floats:
    """States (N, 17) at positions and velocities (N, 3), level, with thrust equal to weight.

    ``yaw`` (N,) or one for all [rad].
    """
    n = len(vehicles.m)
    S = zeros(n, STATES)
    S[:, :3], S[:, 3:6] = r, v
    S[:, 6], S[:, 9] = np.cos(0.5 * np.asarray(yaw)), np.sin(0.5 * np.asarray(yaw))
    speed = np.clip(speed_of(0.25 * vehicles.m * vehicles.g, *vehicles.thrust.T), *vehicles.speed.T)
    S[:, 13:] = np.where(vehicles.point, 0.0, speed)[:, None]
    return S


def initial_state(
    flight: SampledFlight,
    S: Floats,
    workspace: Workspace,
    *,
    frame: Floats | None = None,
    iterations: int = 1,
) -> SampledState:
    """State of a flight at its start, from states ``S`` (N, 17), without a trail.

    With a network, the constraint law has some ``iterations``.
    """
    n, m = len(S), len(workspace.c)
    depth = 1 + int(flight.sensing.delay.max())
    known = np.ascontiguousarray(S[:, :6])
    past = np.tile(known, (depth, 1, 1))
    attitude = _frame_at_rest(frame)
    curves = flight.vehicles.thrust.T[:, :, None]
    peak = np.where(flight.vehicles.point[:, None], 0.0, thrust_of(S[:, 13:], *curves))
    worst = np.zeros((n, VERTICAL + 1))
    worst[:, UPRIGHT] = 1.0 - 2.0 * (S[:, 7:9] ** 2).sum(axis=1)
    times = np.full(worst.shape, flight.start)
    mail = empty_mail(flight.network, iterations)
    mail.estimate[:, :3] = S[: len(mail.estimate), 3:6]
    return SampledState(
        S=S.copy(), clock=np.array([flight.start, flight.start]), count=np.zeros(ANSWERED + 1, dtype=np.int64),
        integral=np.zeros(m), frame=attitude, error=np.zeros((n, 3)),
        f_u=np.zeros((n, 3)), f_C=np.zeros((n, 3)), force=np.zeros((n, 3)), push=np.zeros((n, 3)),
        command=np.zeros((n, 4)), saturated=np.zeros(n, dtype=np.bool_),
        layers=np.zeros(n, dtype=np.int64), seen=known, history=past,
        mail=mail, tau=clocks_at_start(n), peak=peak, peak_time=times[:, :4].copy(),
        worst=worst, worst_time=times, saturations=np.zeros(n, dtype=np.int64), trail=NO_TRAIL,
        work=_new_work_arrays(n, m),
    )  # fmt: skip


def state_under_problem(
    state: SampledState, workspace: Workspace, integral: Floats, *, frame: Floats | None = None
) -> SampledState:
    """The same flight under another problem, such as that of the next phase, whose edges may be others.

    With ``integral`` (m,) of its constraints [m s] and its frame, a quaternion (4,). The old state shares arrays with
    the new one and must not be used further.
    """
    state.clock[LAW_TIME], state.count[LAW_TICKS] = state.clock[TIME], 0
    n = len(state.S)
    return state._replace(
        integral=np.array(integral, dtype=float), frame=_frame_at_rest(frame),
        work=_new_work_arrays(n, len(workspace.c)),
    )  # fmt: skip


def _frame_at_rest(q: Floats | None) -> Floats:
    """A frame at the start, which has no rates yet."""
    rows = np.zeros((3, 4))
    rows[0] = (1.0, 0.0, 0.0, 0.0) if q is None else q
    return rows


def _new_work_arrays(n: int, m: int) -> SampledWork:
    size = 6 * n + m + 4
    return SampledWork(
        zeros(7, padded(n * STATES)), zeros(3, n, 3), np.eye(3), np.zeros((5, 3)), np.zeros((4, 4)), np.zeros(1),
        np.zeros((1, size)), np.zeros(size),
    )  # fmt: skip


def sampled_segment(
    n: int, m: int, t_end: float, times: ArrayLike = (), max_steps: int = ENDLESS, links: int = 0
) -> SampledSegment:
    """A flight of n vehicles with m edges to ``t_end`` [s], sampled at ``times`` (K,) [s]."""
    at = np.ascontiguousarray(times, dtype=float)
    k = len(at)
    return SampledSegment(
        t_end, max_steps, 0, 0, 0, 0, 0, at, np.empty((k, n, STATES)), np.empty((k, n, STATES)), np.empty((k, n, 4)),
        np.empty((k, n, 3)), np.empty((k, n, 3)), np.empty((k, n, 6)), np.empty((k, n), dtype=np.bool_),
        np.empty((k, n), dtype=np.int64), np.empty((k, n, 3)), np.empty((k, m)),
        np.empty((k, 4)), np.empty((k, links), dtype=np.int64),
    )  # fmt: skip
