"""Make a `Result` from the kernel's samples: attitude, rates, separation and clearance on one time axis."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from rigidfleet._common.arrays import arrays_equal
from rigidfleet.kernel.engine import native
from rigidfleet.kernel.measured import Measured, measurement_arrays
from rigidfleet.kernel.problem import workspace
from rigidfleet.kernel.records import Record, new_record
from rigidfleet.math import attitude as att
from rigidfleet.math import proximity
from rigidfleet.math.constraint_jacobian import smallest_singular_value
from rigidfleet.planning.derivatives import (
    slot_derivatives,
    slots_by_own_clocks,
    yaw_derivatives,
)
from rigidfleet.planning.vehicles import YawTurn, slot_taylor_and_yaw
from rigidfleet.result import CLOSE, LATER, RECORDED, SEEN, Extremum, PhaseRecord, Result
from rigidfleet.simulation.solver_setup import large_solver, problem_with_solver, workspace_of
from rigidfleet.typing import Bools, Floats, Ints

if TYPE_CHECKING:
    from rigidfleet.kernel.large.solver import Setup
    from rigidfleet.kernel.mail import Links, Mail
    from rigidfleet.kernel.problem import Motion, Problem, Reference, Workspace
    from rigidfleet.mission import Mission
    from rigidfleet.mission.schema import VehicleYaw

#: Greatest number of edges, or of coordinates, for which the smallest singular value of J is recorded.
_SINGULAR = 400
#: Greatest work for singular values in a phase, as (size of J)^3 times samples (some tenths of a second), and least
#: number of samples.
_WORK, _LEAST = 400_000_000, 9

#: Columns of a record that are those of the phase, also where a user's controller flies.
_REFERENCES = "r_ref", "p", "motion", "rates", "T_ref", "wrench"
#: Columns of a record that are those of edges.
_EDGEWISE = "c", "L", "d", "d_dot", "multiplier"

#: Fields of a result that a flight makes later, as a rule.
_UNMADE: dict[str, Any] = dict.fromkeys(
    (*RECORDED, *CLOSE, *LATER, "singular_value", "mission_text")
)

#: References that slots follow one after the other, each with the time [s] from which it counts, and how vehicles with
#: sampled control turn; none if not tracked.
FollowedReferences = tuple[tuple[float, "Reference", "Motion", "YawTurn | None"], ...]


class VehicleSamples(NamedTuple):
    """Samples of vehicles with sampled control; of points, attitude, rates and rotors are zero."""

    attitude: Floats  # (K, N, 4) world to body, scalar first
    rates: Floats  # (K, N, 3) body axes [rad/s]
    rotor_force: Floats  # (K, N, 4) [N]
    thrust: Floats  # (K, N) [N]
    saturated: Bools  # (K, N)
    age: Floats  # (K, L) of the newest message of each link [s]; NaN before the first
    # (K, N, 4) own clocks: three columns as in `slots_by_own_clocks`, time along the plan [s]; (K, N, 0) without
    tau: Floats


class LayerSamples(NamedTuple):
    """Samples of what the layers of avoidance in flight do."""

    rate: Floats  # (K,) of the virtual clock
    displacement: Floats  # (K, 3) of the body from its path [m]
    layers: Ints  # (K, N) that change what a vehicle is asked for


Samples = TypeVar("Samples", VehicleSamples, LayerSamples)


class Unevaluated(NamedTuple):
    """States of the integrator at samples, of which forces and references have not been asked for yet."""

    packed: native.Packed  # the problem as flown: it may hold the force of a user's controller
    planned: Problem  # of the phase, which has the references
    y: Floats  # (K, n)
    setup: Setup | None  # of a large formation

    @property
    def problem(self) -> Problem:
        """The problem as flown."""
        return self.packed.of

    @property
    def r_and_v(self) -> tuple[Floats, Floats]:
        """Positions and velocities (K, N, 3) of agents, world axes; they may be views of the states."""
        n, m = len(self.problem.vehicles.m), len(self.problem.graph.edges)
        both = self.y[:, : 6 * n].reshape(-1, 2, n, 3)
        r, v = both[:, 0], both[:, 1]
        if not self.problem.body_formulation:
            return r, v
        q, *cm = np.split(self.y[:, 6 * n + m :], [4, 7], axis=1)
        T = att.dcm_from_quaternion(q / np.linalg.norm(q, axis=1, keepdims=True))
        return _points_to_world(r, T, cm[0]), _points_to_world(v, T, cm[1])

    def evaluate(self, times: Floats, work: Workspace) -> Record:
        """Forces and references at the samples, times (K,) [s]."""
        out = new_record(len(times), len(self.problem.vehicles.m), len(self.problem.graph.edges))
        self.evaluate_into(native.pack_uncached(out), 0, times, work)
        return out

    def evaluate_into(self, out: native.Packed, first: int, times: Floats, work: Workspace) -> None:
        """Write them into a packed record from row ``first`` on."""
        native.record_into(out, first, self.packed, work, times, self.y)
        if self.problem is not self.planned:
            of_phase = native.record(self.planned, work, times, self.y)
            for name in _REFERENCES:
                getattr(out.of, name)[first : first + len(times)] = getattr(of_phase, name)


def _points_to_world(x: Floats, T: Floats, origin: Floats) -> Floats:
    """origin + T^T x of vectors x (K, N, 3) in body axes, world -> body T (K, 3, 3), and origin (K, 3)."""
    return origin[:, None] + x @ T


@dataclass
class Piece:
    """Samples of a phase, or of part of one."""

    phase: int
    time: Floats  # (K,) [s]
    source: Record | Unevaluated
    integral: Floats  # (K, m) [m s]
    frame: Floats  # (K, 4)
    edges: Ints  # (m, 2) of this phase
    attached: bool  # whether the slots carry the body frame
    followed: FollowedReferences  # what the slots follow, if they are tracked
    vehicles: VehicleSamples | None = None
    layers: LayerSamples | None = None

    @property
    def r_and_v(self) -> tuple[Floats, Floats]:
        """Positions and velocities (K, N, 3) of agents, world axes."""
        if isinstance(self.source, Unevaluated):
            return self.source.r_and_v
        return self.source.r, self.source.v

    @property
    def record(self) -> Record:
        """Forces and references, evaluated while it flew: for a user's force, and for vehicles."""
        assert not isinstance(self.source, Unevaluated)
        return self.source

    def record_into(
        self, out: native.Packed, first: int, make: Callable[..., Workspace] = workspace
    ) -> None:
        """Write forces and references, of the edges of this phase, into a packed record from row ``first`` on.

        ``make`` makes a workspace, or returns one that the piece before has used.
        """
        source = self.source
        if not isinstance(source, Unevaluated):
            for rows, values in zip(out.of, source, strict=True):
                if len(rows):
                    rows[first : first + len(values)] = values
        elif source.setup is not None:
            solver = large_solver(source.planned, source.setup)
            planned = problem_with_solver(solver, source.planned)
            own = source.problem is source.planned
            problem = planned if own else problem_with_solver(solver, source.problem)
            renewed = source._replace(packed=native.pack_uncached(problem), planned=planned)
            renewed.evaluate_into(out, first, self.time, solver.workspace)
            solver.raise_pending_error()
        else:
            source.evaluate_into(out, first, self.time, workspace_of(source.planned, make=make))


def assemble_result(
    mission: Mission,
    phases: Sequence[PhaseRecord],
    pieces: Sequence[Piece],
    *,
    ending: str,
    statistics: dict[str, Any],
    network: tuple[Links, Mail] | None = None,
) -> Result:
    """Join the pieces of a flight, of vehicles with a ``network`` and what was sent on it.

    All that follows from positions and velocities is computed when it is first asked for.
    """
    pieces = [p for p in pieces if len(p.time)]
    counts = [len(p.time) for p in pieces]
    time = np.concatenate([p.time for p in pieces])
    flown = _vehicle_samples(pieces)
    tau = flown.tau if flown is not None and flown.tau.size else None
    avoided = [piece.layers for piece in pieces if piece.layers is not None]
    layers = _concatenate_samples(avoided) if avoided else None
    noisy = mission.all_disturbances.noise is not None
    airy = flown is not None or (mission.disturbances is not None and bool(mission.drag.any()))
    worst = [phase.extremes for phase in phases]
    names = *RECORDED, *(("disturbance_force",) if airy else ()), *(SEEN if noisy else ())
    recorded = partial(_forces_and_references, mission, pieces, time, flown)
    r, v = zip(*(p.r_and_v for p in pieces), strict=True)
    later: list[tuple[tuple[str, ...], Callable[[], dict[str, Any]]]] = [
        (names, recorded),
        (CLOSE, partial(closeness_arrays, mission, worst, r, time)),
        (LATER, partial(_slot_references, mission, [(p.time, p.followed) for p in pieces], tau)),
        (("singular_value",), partial(_least_singular_value, r, [p.edges for p in pieces])),
        (("mission_text",), partial(mission_text_field, mission)),
    ]
    return Result(
        time=time,
        phase=np.array([p.phase for p in pieces]).repeat(counts),
        edges=mission.edges,
        vehicle_attitude=None if flown is None else flown.attitude,
        vehicle_rates=None if flown is None else flown.rates,
        rotor_force=None if flown is None else flown.rotor_force,
        saturated=None if flown is None else flown.saturated.astype(np.int64),
        vehicle_clock=None if tau is None else tau[..., 3],
        clock_rate=None if layers is None else layers.rate,
        body_displacement=None if layers is None else layers.displacement,
        avoidance_layers=None if layers is None else layers.layers,
        phases=list(phases),
        complete=not ending,
        ending=ending,
        statistics=statistics,
        later=later,
        position=np.concatenate(r),
        velocity=np.concatenate(v),
        **({} if flown is None or network is None else _message_data(mission, flown.age, *network)),
        **_UNMADE,
    )


def _message_data(mission: Mission, age: Floats, net: Links, mail: Mail) -> dict[str, Any]:
    """Ages of messages at samples, and of what was sent, heard, lost and used, of each edge both ways."""
    n, pairs = mission.n_agents, np.stack([mission.edges, mission.edges[:, ::-1]], axis=1)
    of = np.searchsorted(net.links @ [n, 1], pairs @ [n, 1])  # (E, 2)
    oldest = mail.oldest[of] / mission.autopilot.rate
    return {"message_age": age[:, of], "messages": mail.count.T[of], "oldest_message": oldest}


def _forces_and_references(
    mission: Mission, pieces: Sequence[Piece], time: Floats, flown: VehicleSamples | None
) -> dict[str, Any]:
    """Forces and references at all samples, and what is measured of them."""
    d = mission.disturbances
    disturbed = flown is not None or d is not None
    record = _join_records(pieces, mission.n_agents, mission.edges, disturbed=disturbed)
    measured = _measure(mission, pieces, time, record)
    thrust, motion, r_ref = measured.thrust, record.motion, record.r_ref
    if flown is not None:
        thrust = flown.thrust
        if mission.agents.saturate:  # the thrust flown, not the commanded one
            thrust = np.minimum(thrust, mission.agents.thrust_limit)
    if (left := _flying_mask(mission, time)) is not None:
        r_ref = np.where(left[:, :, None], r_ref, np.nan)
    constraint = record.c
    if d is not None and d.noise is not None:
        constraint = measured.distance - record.d
    return {
        "position": record.r,
        "velocity": record.v,
        "acceleration": record.a,
        "slot_position": r_ref,
        "input_force": record.f_u,
        "constraint_force": record.f_C,
        "external_force": record.f_E,
        "disturbance_force": record.f_D,
        "measured_position": record.r_seen,
        "measured_velocity": record.v_seen,
        "thrust": thrust,
        "cm": measured.cm,
        "cm_velocity": measured.cm_velocity,
        "cm_reference": motion[:, :3],
        "cm_velocity_reference": motion[:, 3:],
        "attitude": measured.attitude,
        "attitude_reference": measured.attitude_reference,
        "frame": measured.frame,
        "rates": measured.rates,
        "rates_reference": record.rates,
        "wrench_asked": np.where(np.isfinite(motion[:, :1]), record.wrench, measured.wrench),
        "wrench_achieved": measured.wrench,
        "distance": measured.distance,
        "distance_reference": record.d,
        "distance_rate_reference": record.d_dot,
        "constraint": constraint,
        "multiplier": record.multiplier,
        "integral": _integral_samples(pieces, mission.edges),
    }


def mission_text_field(mission: Mission) -> dict[str, str]:
    """The text of a mission, as a result has it."""
    return {"mission_text": mission.text}


def _flying_mask(mission: Mission, time: Floats) -> Bools | None:
    """Mask (K, N) of the agents that are not lost; None if none is."""
    lost_at = mission.lost_at
    return None if time[-1] <= lost_at.min() else time[:, None] <= lost_at


def closeness_arrays(
    mission: Mission,
    worst: Sequence[dict[str, Extremum]],
    places: Sequence[Floats],
    time: Floats,
    left: Bools | None = None,
) -> dict[str, Any]:
    """Distances at places (K, N, 3) of each piece; the one after an extreme of a phase, ``worst``, has the extreme.

    Vehicles count that are not lost, or those ``left`` (K, N).
    """
    left = _flying_mask(mission, time) if left is None else left
    if left is None:
        left = np.ones((len(time), mission.n_agents), dtype=np.bool_)
    r = np.concatenate(places)
    close = proximity.closeness(r, mission.agents.radius, mission.obstacles, time, left)
    _lower_closeness_to_extremes(worst, time, close)
    arrays = close.separation, close.pair, close.clearance, close.agent, close.obstacle
    return dict(zip(CLOSE, arrays, strict=True))


def _slot_references(
    mission: Mission, pieces: Sequence[tuple[Floats, FollowedReferences]], clocks: Floats | None
) -> dict[str, Floats]:
    """Derivatives of the slots and the yaw of each vehicle, of pieces of a flight; NaN where no slots are tracked.

    Yaw "along" continues from piece to piece. Where vehicles have clocks of their own, ``clocks`` says how these stand;
    the yaw is that by their mean, from which they differ by far less than a vehicle needs to turn.
    """
    turned, n = mission.yaw, mission.n_agents
    states, angles = [], []
    last, until, end = None, 0.0, 0
    for times, followed in pieces:
        begin, end = end, end + len(times)
        if followed and clocks is not None:
            ((_, reference, motion, turn),), own = followed, clocks[begin:end]
            states.append(slots_by_own_clocks(reference, motion, times, own)[:, 1:])
            off, rate = own[..., :2].mean(axis=1).T
            assert turn is not None  # vehicles fly
            angles.append(
                _yaw_and_rate(reference, motion, np.maximum(times + off, turn.begun), turned, turn)
            )
            angles[-1][:, 1] *= rate[:, None]
            continue
        if not followed:
            last = None
            states.append(np.full((len(times), 3, n, 3), np.nan))
            angles.append(np.full((len(times), 2, n), np.nan))
            continue
        spans = sorted(followed, key=lambda span: span[0])
        first = np.searchsorted(times, [begin for begin, *_ in spans[1:]])
        for time, (_, reference, motion, turn) in zip(np.split(times, first), spans, strict=True):
            if not len(time):
                continue
            states.append(slot_derivatives(reference, motion, time, 4)[:, 1:])
            if turn is not None:
                angles.append(_yaw_and_rate(reference, motion, time, turned, turn))
                continue
            # From the sample before, which may be one of an earlier piece.
            begin = np.clip(until, motion.knots[0], time[0]) if last is not None else time[0]
            since = time if begin == time[0] else np.append(begin, time)
            yaws = yaw_derivatives(reference, motion, since, turned, last)[-len(time) :, :2]
            angles.append(yaws)
            last, until = yaws[-1, 0], time[-1]
    state, angle = np.concatenate(states), np.concatenate(angles)
    left = _flying_mask(mission, np.concatenate([times for times, _ in pieces]))
    if left is not None:
        state[~left[:, None].repeat(3, axis=1)] = np.nan
        angle[~left[:, None].repeat(2, axis=1)] = np.nan
    known = np.isfinite(angle[:, 0]).any(axis=1)
    angle[known, 0] = np.unwrap(angle[known, 0], axis=0)  # one turn, not one for each piece
    values = (*state.swapaxes(0, 1), *angle.swapaxes(0, 1))
    return dict(zip(LATER, values, strict=True))


def _yaw_and_rate(
    reference: Reference, motion: Motion, time: Floats, yaw: VehicleYaw, turn: YawTurn
) -> Floats:
    """Yaw and its rate (K, 2, N) asked of vehicles that turn into it from the yaw they had."""
    since = np.concatenate([[turn.begun], time])
    return slot_taylor_and_yaw(reference, motion, since, yaw, turn)[1][:2, :, 1:].transpose(2, 0, 1)


def _vehicle_samples(pieces: Sequence[Piece]) -> VehicleSamples | None:
    """The samples of all pieces; None if point masses flew."""
    samples = [piece.vehicles for piece in pieces if piece.vehicles is not None]
    if not samples:
        return None
    joined = _concatenate_samples(samples)
    attitude = att.unwrap_quaternion(joined.attitude.swapaxes(0, 1)).swapaxes(0, 1)
    return joined._replace(attitude=np.ascontiguousarray(attitude))


def _concatenate_samples(pieces: Sequence[Samples]) -> Samples:
    """Samples of pieces, one after the other."""
    return type(pieces[0])(*(np.concatenate(parts) for parts in zip(*pieces, strict=True)))


def _lower_closeness_to_extremes(
    worst: Sequence[dict[str, Extremum]], time: Floats, close: proximity.Closeness
) -> None:
    """Enter extremes between samples at the sample after each."""
    for name, values in (("separation", close.separation), ("clearance", close.clearance)):
        every = [extremes[name] for extremes in worst if name in extremes]
        after = np.searchsorted(time, [x.time for x in every]).clip(max=len(time) - 1)
        for x, k in zip(every, after.tolist(), strict=True):
            if x.value < values[k]:
                values[k] = x.value
                if name == "separation":
                    close.pair[k] = x.who, x.other
                else:
                    close.agent[k], close.obstacle[k] = x.who, x.other


def _measure(mission: Mission, pieces: Sequence[Piece], time: Floats, record: Record) -> Measured:
    """Attitude, rates, wrench, thrust and distances at all samples, by the kernel.

    Without slots, the attitude is that of the integrated frame, if the mission attaches one.
    """
    agents = mission.agents
    n = mission.n_agents
    measured = measurement_arrays(
        n, len(mission.edges), len(time), time=time,
        start=np.cumsum([0, *(len(p.time) for p in pieces)]),
        attached=np.array([p.attached for p in pieces]), framed=mission.body_frame is not None,
        mass=mission.fleet.mass, lost_at=mission.lost_at,
        limit=mission.fleet.thrust_limit if agents.saturate else np.full(n, np.inf), edges=mission.edges,
        r=record.r, v=record.v, f_u=record.f_u, f_C=record.f_C, p=record.p, T_ref=record.T_ref,
        frame=np.concatenate([p.frame for p in pieces]),
    )  # fmt: skip
    native.measure_samples(measured)
    return measured


def _join_records(pieces: Sequence[Piece], n: int, edges: Ints, *, disturbed: bool) -> Record:
    """Forces and references at all samples, of the pieces one after the other; NaN while an edge is not active."""
    count, end = sum(len(p.time) for p in pieces), 0
    out = new_record(count, n, len(edges), disturbed=disturbed)
    whole, make = native.pack_uncached(out), cache(workspace)
    for piece in pieces:
        begin, end = end, end + len(piece.time)
        places = _edge_columns(piece.edges, edges)
        if isinstance(places, slice):
            piece.record_into(whole, begin, make)
            continue
        size = count, len(piece.edges)
        own = out._replace(**{name: np.empty(size) for name in _EDGEWISE})
        piece.record_into(native.pack_uncached(own), begin, make)
        for name in _EDGEWISE:
            rows = getattr(out, name)[begin:end]
            rows.fill(np.nan)
            rows[:, places] = getattr(own, name)[begin:end]
    return out


def _integral_samples(pieces: Sequence[Piece], edges: Ints) -> Floats:
    """Integrals of the constraint errors (K, m); NaN while an edge is not active."""
    rows = []
    for piece in pieces:
        full = np.full((len(piece.time), len(edges)), np.nan)
        full[:, _edge_columns(piece.edges, edges)] = piece.integral
        rows.append(full)
    return np.concatenate(rows)


def _edge_columns(some: Ints, edges: Ints) -> Ints | slice:
    """Indices of some edges among all edges, (m, 2) both."""
    if arrays_equal(some, edges):
        return slice(None)
    key = edges.max(initial=0) + 1
    keys = edges[:, 0] * key + edges[:, 1]
    order = np.argsort(keys)
    return order[np.searchsorted(keys[order], some[:, 0] * key + some[:, 1])]


def _least_singular_value(places: Sequence[Floats], edges: Sequence[Ints]) -> dict[str, Floats]:
    """Smallest non-zero singular value of J (K,); NaN if the formation is too large to compute it.

    ``places`` (K, N, 3) and ``edges`` are those of each piece. In formations of some tens of agents it is computed at
    some samples of each piece, and linear in between.
    """
    # Pieces with the same edges at once, if that is not too much.
    size, count = min(len(edges[0]), 3 * places[0].shape[1]), sum(map(len, places))
    if all(arrays_equal(some, edges[0]) for some in edges) and count * size**3 <= _WORK:
        places = [np.concatenate(places)]
    values = [_smallest_singular_values(*each) for each in zip(places, edges, strict=False)]
    return {"singular_value": np.concatenate(values)}


def _smallest_singular_values(r: Floats, edges: Ints) -> Floats:
    """Smallest non-zero singular value of J (K,) at positions r (K, N, 3) of a piece of a flight."""
    size = min(len(edges), 3 * r.shape[1])
    if size > _SINGULAR or not len(edges):
        return np.full(len(r), np.nan)
    count = max(_LEAST, _WORK // size**3)
    if count >= len(r):
        return smallest_singular_value(r, edges)
    some = np.unique(np.linspace(0, len(r) - 1, count).round().astype(np.int64))
    return np.interp(np.arange(len(r)), some, smallest_singular_value(r[some], edges))
