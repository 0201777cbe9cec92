"""From a mission and the state at a switch to what the kernel flies: everything known before.

A phase of a mission becomes a `Program`: time functions (blends, piecewise quintics), gain tables
and weights, which the kernel only evaluates. What the next phase inherits travels in a `Situation`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rigidfleet.formation import distance_geometry, graphs
from rigidfleet.kernel.problem import (
    BODY,
    CONSTANT,
    EXACT,
    ITERATED,
    LOCAL,
    OPEN,
    PINV,
    PINV_EQUAL,
    PINV_INERTIA,
    PINV_INERTIA_FORCE,
    RIGID,
    SLOTS,
    SPECTRAL,
    SQUARED,
    Control,
    Feedback,
    Graph,
    Law,
    Motion,
    Program,
    Reference,
    Vehicles,
    calm,
    graph,
)
from rigidfleet.math import lqr
from rigidfleet.mission import Establish, Fly, Mission, Phase, Regulator, Reshape, Turn
from rigidfleet.planning import solvers
from rigidfleet.planning.reference import (
    Pose,
    Situation,
    align_slots,
    attach,
    goal_of,
    led_by,
    legs,
    slots_about_cm,
    slots_before,
)
from rigidfleet.typing import Floats, Ints

_SOLVERS = {"iterated": ITERATED, "spectral": SPECTRAL, "exact": EXACT, "pinv": PINV}
_KINDS = {"shape": SLOTS, "squares": SQUARED, "step": CONSTANT}
#: A formation is held from where all pairs are right within this part of the shortest distance.
_NEAR = 0.1
_SPLITS = {"equal": PINV_EQUAL, "inertia": PINV_INERTIA, "inertia+force": PINV_INERTIA_FORCE}


@dataclass
class PhasePlan:
    """A phase, ready to fly."""

    program: Program
    edges: Ints  # (m, 2), from 0
    slots: Floats | None  # (N, 3) at the end, about the CM, body axes [m]
    formation: str | None
    distances: Floats  # (m,) at the end [m]
    goal: Pose | None
    arrival: float  # when the goal is to be reached [s]
    frame: Floats | None  # attitude (3, 3) of the mean-axis frame at the start
    method: solvers.Method  # how the multipliers are solved for
    held: str | None  # the formation, if the agents are in it at the start


def plan_phase(mission: Mission, phase: Phase, now: Situation, t_end: float) -> PhasePlan:
    """Prepare a phase that starts at ``now.t`` and ends at ``t_end`` [s] at the latest."""
    masses = np.array(mission.agents.mass)
    shaping = isinstance(phase, Establish | Reshape)
    name = phase.formation if shaping else now.formation
    edges = mission.formation_edges(name) if name else np.zeros((0, 2), dtype=np.int64)
    target = slots_about_cm(mission, name, masses)
    frame, now, turned = attach(mission, phase, now, masses, target)

    d1 = mission.formation_distances(name) if name else np.zeros(0)
    if not shaping:
        d1 = now.reference.of(edges, d1)
    d0 = now.reference.of(edges, distance_geometry.distances(now.r, edges))
    # Slots are blended wherever the shape leads; where distances lead, slots only follow if tracked.
    left = masses if now.lost is None else np.where(now.lost, 0.0, masses)
    before = slots_before(mission, now, left)
    after = target if shaping and target is not None else before
    kind, T_b = CONSTANT, 0.0
    if shaping:
        T_b = 0.0 if phase.reference == "step" else phase.blend
        kind = _KINDS[led_by(mission, phase, before, target)]
    elif phase.control == "slots" and np.allclose(
        d1, distance_geometry.distances(before, edges), rtol=1e-12
    ):
        kind = SLOTS
    dp, turn = np.zeros_like(before), np.zeros(3)
    if shaping:
        dp, turn = align_slots(before, after, left, turned)
    reference = Reference(kind, now.t, T_b, d0, d1, before, dp, turn)

    goal, arrival = goal_of(phase, now, t_end)
    motion, feedback = _REST, _NO_FEEDBACK
    if phase.control == "slots":
        assert now.pose is not None  # attached above
        assert goal is not None
        motion = _motion(mission, now.pose, goal, now.t, arrival, t_end)
    elif phase.control == "body":
        assert goal is not None
        moves = isinstance(phase, Fly | Turn)
        feedback = _feedback(mission, goal, now.t, arrival, moves=moves)
    method = solvers.choose(len(masses), edges, mission.constraint.solver)
    held = _held(mission, name, now) if method == "dense" else None
    program = Program(
        body_formulation=mission.formulation == "body",
        has_frame=frame is not None,
        vehicles=Vehicles(
            masses, 1.0 / masses, float(masses.sum()), float(masses.mean()),
            np.array(mission.agents.thrust_limit), mission.agents.saturate, mission.gravity,
        ),
        graph=_graph(edges.tobytes(), masses.tobytes(), large=method != "dense"),
        law=_law(
            mission,
            mission.damping(held, now.lost),
            damped=phase.control != "slots" and len(edges) > 0,
        ),
        reference=reference,
        motion=motion,
        feedback=feedback,
        control=_control(mission, phase, masses),
        external=0,
        disturbance=calm(masses),
    )  # fmt: skip
    slots = after if phase.control != "open" or kind == SLOTS else target if shaping else now.slots
    return PhasePlan(program, edges, slots, name, d1, goal, arrival, frame, method, held)


@lru_cache(64)
def _graph(edges: bytes, masses: bytes, *, large: bool) -> Graph:
    """The constraint graph, which the kernel only reads: most phases have the one before."""
    pairs = np.frombuffer(edges, dtype=np.int64).reshape(-1, 2).copy()
    return graph(pairs, np.frombuffer(masses), large=large)


def _held(mission: Mission, name: str | None, now: Situation) -> str | None:
    """The formation, if the agents left are in it: all pairs within a tenth of the shortest."""
    slots = mission.formation_slots(name) if name else None
    if slots is None:
        return None
    left = slice(None) if now.lost is None else ~now.lost
    slots, r = slots[left], now.r[left]
    if len(slots) < 2:
        return None
    pairs = graphs.complete_graph(len(slots))
    wanted = distance_geometry.distances(slots, pairs)
    near = np.abs(distance_geometry.distances(r, pairs) - wanted).max() <= _NEAR * wanted.min()
    return name if near else None


def _law(mission: Mission, mu: float, *, damped: bool) -> Law:
    c = mission.constraint
    pid = c.stabilisation == "pid"
    return Law(
        alpha=c.alpha if pid else 0.0,
        beta=c.beta if pid else 0.0,
        gamma=c.gamma if pid else 0.0,
        solver=_SOLVERS[c.solver],
        mu=mu,
        iterations=c.iterations,
        s0=c.threshold,
        cutoff=c.cutoff,
        k_def=c.deformation_damping if damped else 0.0,
    )


def _control(mission: Mission, phase: Phase, masses: Floats) -> Control:
    kind = {"open": OPEN, "slots": LOCAL, "body": BODY}[phase.control]
    force = np.tile(np.array(phase.input_force), (len(masses), 1))
    force[:, 2] += masses * mission.gravity
    k1, k2 = lqr.double_integrator_gains(mission.tracking.Q, mission.tracking.R)
    allocation = mission.allocation
    method = RIGID if allocation.method == "rigid" else _SPLITS[allocation.torque_split]
    return Control(kind, force, k1, k2, method)


_REST = Motion(np.zeros(2), np.zeros((1, 6, 6)), np.eye(3))
_NO_FEEDBACK = Feedback(
    np.zeros(0), np.zeros((0, 4)), np.zeros((0, 4)), 0.0, np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3),
    np.zeros(4),
)  # fmt: skip


def _motion(
    mission: Mission, start: Pose, goal: Pose, t0: float, arrival: float, t_end: float
) -> Motion:
    """LQR of the virtual body from one pose to another, as the trajectory it makes.

    From arrival to ``t_end`` the tracking gains take over, or what the finite horizon has left of
    the velocity's error would carry the body away.
    """
    T = arrival - t0
    flights = legs(mission, start, goal, T)
    times = np.unique(np.concatenate([_knots(law, T) for law in flights.regulators]))
    rest = t_end - arrival
    after = lqr.knots(rest, mission.tracking.Q, mission.tracking.R) if rest > 0.0 else np.zeros(1)
    pieces = []
    for i in range(2):
        x = flights.sample(i, times)
        piece = lqr.quintic_pieces(times, *x)
        if rest > 0.0:
            x = flights.sample_rest(mission, i, (x[0][-1], x[1][-1]), rest, after)
            piece = np.concatenate([piece, lqr.quintic_pieces(after, *x)])
        pieces.append(piece)
    knots = np.concatenate([t0 + times, arrival + after[1:]])
    coefficients = np.concatenate(pieces, axis=1)
    # Another layout of an array would be another type, and compile the kernel once more.
    return Motion(knots, np.ascontiguousarray(coefficients), np.ascontiguousarray(goal.T))


def _knots(law: Regulator, T: float) -> Floats:
    return lqr.knots(T, law.Q, law.R, law.S if law.horizon == "finite" else None)


def _feedback(mission: Mission, goal: Pose, t0: float, arrival: float, *, moves: bool) -> Feedback:
    """LQR on the virtual body itself: gain tables to a waypoint, tracking gains where it stays."""
    hold = lqr.double_integrator_gains(mission.tracking.Q, mission.tracking.R) * 2
    to_go, gain, slope = np.zeros(0), np.zeros((0, 4)), np.zeros((0, 4))
    if moves:
        # Gains grow like 1/tau near arrival, until S bounds them: on a geometric grid cubics keep
        # them to 1e-8.
        horizon = arrival - t0
        to_go = np.concatenate([[0.0], np.geomspace(min(1e-6, 1e-3 * horizon), horizon, 1000)])
        tables = [_gains(law, to_go) for law in (mission.lqr, mission.lqr.attitude)]
        gain, slope = (np.concatenate(columns, axis=1) for columns in zip(*tables, strict=True))
    return Feedback(
        to_go, np.ascontiguousarray(gain), np.ascontiguousarray(slope), arrival, goal.r, goal.v,
        np.ascontiguousarray(goal.T), goal.omega, np.array(hold),
    )  # fmt: skip


def _gains(law: Regulator, to_go: Floats) -> tuple[Floats, Floats]:
    """Gains (K, 2) of one axis over the time to go (K,) [s], and their slopes (Riccati equation)."""
    if law.horizon == "infinite":
        gain = np.tile(lqr.double_integrator_gains(law.Q, law.R), (len(to_go), 1))
        return gain, np.zeros_like(gain)
    A, B = [[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]
    P, K = lqr.finite_horizon(A, B, law.Q, np.atleast_2d(law.R), law.S, to_go)
    gain = K[:, 0]
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # weights without measure: the flight will say so
        slope = np.stack([P[:, 0, 0], 2 * P[:, 0, 1] + law.Q[1]], axis=1) / law.R
        return gain, slope - gain * gain[:, 1:]
