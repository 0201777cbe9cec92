"""The plan that flies a phase: its leg, and the law, gains and weights for the kernel.

A phase becomes a `Problem`: time functions (blends, piecewise quintics), gain tables and weights, which the
kernel only evaluates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from rigidfleet.errors import StoppedError
from rigidfleet.formation import distance_geometry
from rigidfleet.kernel.problem import (
    LAWS,
    NO_FEEDBACK,
    REST,
    RIGID,
    SHAPE,
    SOLVERS,
    SPLITS,
    ConstraintLaw,
    Control,
    Disturbance,
    External,
    Feedback,
    Graph,
    Motion,
    Problem,
    Reference,
    Vehicles,
    Workspace,
    graph,
    no_disturbance,
)
from rigidfleet.math import attitude as att
from rigidfleet.math import lqr
from rigidfleet.math.proximity import all_pairs
from rigidfleet.math.rigid_body import about_cm
from rigidfleet.mission import Mission, Phase, Regulator, bounds
from rigidfleet.mission.model import part_of_mission
from rigidfleet.mission.schema import IntegratorOptions
from rigidfleet.planning import solvers
from rigidfleet.planning.body_trajectories import points_passed
from rigidfleet.planning.certificate import Certificate
from rigidfleet.planning.courses import regulators
from rigidfleet.planning.disturbances import with_fixed_agents, without_lost
from rigidfleet.planning.legs import Leg
from rigidfleet.planning.reference import PhaseState, Pose, copy_as, copy_with, pose_at
from rigidfleet.planning.tolerances import (
    absolute_tolerances,
    tolerance_of_velocity,
)
from rigidfleet.typing import Bools, Floats, Ints

#: Time from which on a phase's end is another moment than its arrival [s].
_LATER = 1e-6
#: Greatest error of any pair, as a share of the shortest distance, at which a formation counts as held.
_NEAR = 0.1
#: Difference of two lengths that is ignored [m].
_ROUNDED = 1e-8
#: Residual of an iterative solve, as a share of the integrator's tolerance; the relative residual has bounds.
_RESIDUAL, _LEAST_RESIDUAL, _MOST_RESIDUAL = 1e-3, 1e-13, 1e-8
#: Error of an acceleration that is ignored, as a share of the velocity's tolerance per second.
_FLOOR = 3e-2


@dataclass
class PhasePlan(Leg):
    """A leg, ready to fly. It holds all that a flight needs, so that no mission is required."""

    problem: Problem
    edges: Ints  # (m, 2), from 0
    distances: Floats  # (m,) at the end [m]
    attached: bool  # whether the slots carry the body frame
    lies: bool  # whether the mission prescribes the attitude of the established formation
    method: solvers.Method  # method that solves for the multipliers
    integrator: IntegratorOptions  # options of the integration
    damping: Callable[[Bools], float]  # damping mu, from which vehicles are lost (N,)
    lost_at: Floats  # (N,) times at which vehicles are lost [s]
    links_lost: tuple[Ints, Floats]  # pairs (L, 2) and times (L,) of links that are lost
    loses: bool  # whether vehicles or links are lost at any time of the mission, or it is aborted
    through: tuple[dict[str, Any], ...]  # points to pass on the way (`points_passed`)

    @cached_property
    def certificate(self) -> Certificate | None:
        """The least separation of the planned paths, proved; None if agents track no slots, or are too many."""
        # Beyond, it takes longer than their flight.
        return super().certificate if len(self.radius) <= bounds.ALL_PAIRS else None

    def postpone_arrival(self, postponed_time: Callable[[float], float]) -> None:
        """Move its end, the arrival and the points on its way to other times [s]."""
        self.t_end, self.arrival = postponed_time(self.t_end), postponed_time(self.arrival)
        self.through = tuple(at | {"time": postponed_time(at["time"])} for at in self.through)

    @property
    def is_large(self) -> bool:
        """Whether a method for large formations solves for the multipliers."""
        return self.method != "dense"

    @property
    def target_record(self) -> dict[str, Any] | None:
        """What the phase is to reach, or the attitude of a formation established, for the record."""
        goal, meets, lies = self.goal, self.phase.commanded_at_arrival, self.lies
        if goal is None or not (meets or lies):
            return None
        turns = lies or "attitude" in meets
        reference = self.problem.reference
        shaped = reference.t0 + reference.T_b
        return {
            "time": max(self.arrival, shaped) if lies else self.arrival,
            "position": goal.r.tolist() if "position" in meets else None,
            "velocity": goal.v.tolist() if "velocity" in meets else None,
            "attitude": att.quaternion_from_dcm(goal.T).tolist() if turns else None,
            "rates": goal.omega.tolist() if turns and not lies else None,
            **({"through": list(self.through)} if self.through else {}),
        }

    def end_state_record(self, t: float) -> dict[str, Any] | None:
        """What the phase promises of its end at t [s] beside its target; None for nothing.

        A phase that stays comes to rest, and keeps the attitude commanded before if it tracks slots. Another one goes
        on from its waypoint.
        """
        goal, since, phase = self.goal, t - self.arrival, self.phase
        if goal is None or phase.control == "open":
            return None
        meets, later = phase.commanded_at_arrival, since > _LATER
        stays, free = "position" not in meets, "velocity" not in meets
        kept = stays and goal.named and phase.tracks_slots and phase.establishing is None
        table: dict[str, Any] = {"time": t}
        if stays or (later and not free):
            table |= {"position": (goal.r + goal.v * since).tolist(), "velocity": goal.v.tolist()}
        if later if "attitude" in meets else kept:
            # Most stay without a turn, and whether they do is asked at the end of every phase.
            T = goal.T
            if goal.omega.any():
                T = att.dcm_from_rotation_vector(goal.omega * since) @ T
            table |= {"attitude": att.quaternion_from_dcm(T).tolist(), "rates": goal.omega.tolist()}
        return table if len(table) > 1 else None

    def initial_state(self) -> Floats:
        """The kernel's state vector (n,) at the start; `rigidfleet.kernel.dynamics` says what it holds."""
        now, masses = self.before, self.masses
        integral = now.integral.values_of(self.edges, lambda: 0.0)
        if self.frame is None:
            return np.concatenate([now.r.ravel(), now.v.ravel(), integral])
        q = att.quaternion_from_dcm(self.frame)
        if not self.problem.body_formulation:
            return np.concatenate([now.r.ravel(), now.v.ravel(), integral, q])
        x, y = about_cm(now.r, masses) @ self.frame.T, about_cm(now.v, masses) @ self.frame.T
        cm = (masses @ now.r / masses.sum(), masses @ now.v / masses.sum())
        return np.concatenate([x.ravel(), y.ravel(), integral, q, *cm])

    @cached_property
    def tolerances(self) -> Floats:
        """Absolute tolerances (n,) of the states."""
        n, m = len(self.masses), len(self.edges)
        size = 6 * n + m
        size += 0 if self.frame is None else 10 if self.problem.body_formulation else 4
        velocity = self.velocity_atol()
        return absolute_tolerances(
            self.integrator, size, velocity, self.distances, large=self.is_large
        )

    def velocity_atol(self) -> Floats:
        """Absolute tolerance (N,) of velocities [m/s]."""
        beta = self.problem.law.beta
        return tolerance_of_velocity(
            self.integrator, self.before.r, self.masses, beta, large=self.is_large
        )

    def residual_rtol_and_atol(self) -> tuple[float, float]:
        """Relative and absolute [m/s^2] residual of an iterative solve for the multipliers."""
        share = min(max(_RESIDUAL * self.integrator.rtol, _LEAST_RESIDUAL), _MOST_RESIDUAL)
        return share, _FLOOR * float(self.velocity_atol().min())  # over a step of 1 s

    def remove_lost_edges(self, lost: Bools, lost_links: Bools) -> Bools:
        """Remove the edges of vehicles ``lost`` (N,) and ``lost_links`` (L,); return which edges (m,) are kept."""
        n = len(lost)
        pairs = self.links_lost[0][lost_links]
        keys = self.edges[:, 0] * n + self.edges[:, 1]
        kept = ~np.any(lost[self.edges], axis=1) & ~np.isin(keys, pairs[:, 0] * n + pairs[:, 1])
        self.edges, self.distances = self.edges[kept], self.distances[kept]
        self.__dict__.pop("tolerances", None)
        self.method = solvers.choose_method(len(lost), self.edges, self.constraint.solver)
        self.problem = without_lost(
            self.problem, kept, lost, self.damping(lost), large=self.is_large
        )
        return kept

    def state_at_end(self, t: float, y: Floats, w: Workspace) -> PhaseState:
        """The state that the next phase starts from, after an evaluation at time t [s] and state y (n,) in ``w``."""
        n, m = len(self.before.r), len(self.edges)
        frame, pose = self.before.frame, None
        if self.frame is not None:
            q = y[6 * n + m : 6 * n + m + 4]
            frame = att.dcm_from_quaternion(q / np.linalg.norm(q))
        if self.problem.control.tracks_slots:
            pose = Pose(w.body[0].copy(), w.body[1].copy(), w.T_ref.copy(), w.body[3].copy())
            pose = pose_at(self.problem.motion, t) if self.smooth else pose
        return copy_with(
            self.next_start(t, w.r.copy(), w.v.copy(), frame, pose),
            integral=self.before.integral.with_values(self.edges, y[6 * n : 6 * n + m]),
            reference=self.before.reference.with_values(self.edges, self.distances),
        )


def plan_phase(
    mission: Mission,
    leg: Leg,
    *,
    disturbance: Disturbance | None = None,
    external: External | None = None,
) -> PhasePlan:
    """Add to a leg what flies it: the law and its gains, the graph of edges, and what disturbs them.

    Parameters
    ----------
    disturbance : disturbances of the flight, which no law knows; none by default
    external : a user's force; none by default

    Raises
    ------
    StoppedError
        The phase has no time left, or would take hours to simulate.
    """
    phase, shaping, now, name = leg.phase, leg.phase.shaping, leg.departure.now, leg.formation
    masses, edges = mission.fleet.mass.copy(), _edges(mission, name)
    method = solvers.choose_method(len(masses), edges, mission.constraint.solver)
    _refuse_late_or_huge_phase(mission, phase, leg.start, edges if method == "dense" else edges[:0])
    d1 = mission.formation_distances(name) if name else np.zeros(0)
    if shaping is None:
        d1 = now.reference.values_of(edges, lambda: d1)
    reference = leg.reference
    if shaping is not None or now.blend is None:
        d0 = now.reference.values_of(edges, lambda: distance_geometry.distances(now.r, edges))
        # Distances are those of the slots where these have the lengths commanded.
        agree = shaping is None and phase.tracks_slots and _agree(d1, reference.p0, edges)
        reference = reference._replace(kind=SHAPE if agree else reference.kind, d0=d0, d1=d1)
    motion, feedback = leg.motion if phase.tracks_slots else REST, NO_FEEDBACK
    if phase.leads_body:
        assert leg.goal is not None
        feedback = _feedback(mission, phase, leg.goal, leg.start, leg.arrival)
    held = _name_if_in_formation(mission, name, now) if method == "dense" else None
    law = LAWS[phase.control], phase.tracks_slots, phase.leads_body
    problem = Problem(
        body_formulation=mission.formulation == "body",
        has_frame=leg.frame is not None,
        vehicles=part_of_mission(mission, _vehicles),
        graph=part_of_mission(mission, _constraint_graph, name, method != "dense"),
        law=_constraint_law(
            mission,
            mission.damping(held, now.lost),
            damped=not phase.tracks_slots and len(edges) > 0,
        ),
        reference=reference,
        motion=motion,
        feedback=feedback,
        control=part_of_mission(mission, _control, law, tuple(phase.input_force)),
        disturbance=no_disturbance(masses) if disturbance is None else disturbance,
        external=_limit_integrator_step(external or External(), motion, reference),
    )  # fmt: skip
    if mission.agents.fixed:
        problem = with_fixed_agents(problem, np.array(mission.agents.fixed) - 1)
    plan = copy_as(
        PhasePlan, leg, reference=reference, masses=masses, problem=problem, edges=edges, distances=d1,
        attached=leg.before.slots is not None or phase.control != "open",
        lies=phase.establishing is not None and not mission.leaves_attitude_free(phase), method=method,
        integrator=mission.integrator,
        damping=partial(mission.damping, held), lost_at=mission.lost_at, links_lost=mission.links_lost,
        loses=min(mission.first_loss, mission.abandons_at) < math.inf,
        through=points_passed(phase.points, motion),
    )  # fmt: skip
    parted = plan.links_lost[1] <= now.t
    if now.lost.any() or parted.any():
        plan.remove_lost_edges(now.lost, parted)
    return plan


def _limit_integrator_step(external: External, motion: Motion, reference: Reference) -> External:
    """A user's force, if any, with steps of at most half the time for which any coordinate of a reference accelerates.

    Only after a rest or a uniform motion, where steps grow without bound: they could miss what comes between two.
    """
    most = longest = 2.0 * external.max_step
    for knots, pieces in ((motion.knots, motion.coefficients), (reference.knots, reference.ways)):
        if len(knots) < 3:
            continue  # a single piece follows nothing
        span = np.diff(knots)[:, None] ** np.arange(2, pieces.shape[-1])
        steady = np.einsum("k...p,kp->...k", np.abs(pieces[..., 2:]), span) < _ROUNDED
        for *c, k in np.argwhere(steady[..., :-1] & ~steady[..., 1:]):
            again = np.append(steady[(*c, slice(k + 1, None))], True).argmax()
            longest = min(longest, float(knots[k + 1 + again] - knots[k + 1]))
    return external if longest == most else external._replace(max_step=0.5 * longest)


def _refuse_late_or_huge_phase(mission: Mission, phase: Phase, start: float, edges: Ints) -> None:
    """Refuse a phase that is to end before it starts [s], or that would take hours to simulate, for its dense edges."""
    if phase.until is not None and phase.until <= start:
        raise StoppedError(
            f"phase '{phase.name}' is to end at {phase.until:g} s, but the phases before it end at"
            f" {start:.2f} s. Give it a duration instead of until"
        )
    if phase.shaping is None:
        return
    n, solver = mission.n_agents, mission.constraint.solver
    if (size := solvers.system_size(n, len(edges), solver)) > solvers.MOST_DENSE:
        raise StoppedError(
            f"phase '{phase.name}' takes '{phase.shaping.formation}', whose {len(edges):,} edges between"
            f' {n:,} agents give {size:,} equations for the constraint force; solver "{solver}" needs'
            f" their eigenvalues; with more than {solvers.MOST_DENSE:,} a flight takes hours. Use solver ="
            ' "iterated" (or "exact"), give it fewer edges, or track slots with edges = []'
        )


def _name_if_in_formation(mission: Mission, name: str | None, now: PhaseState) -> str | None:
    """The formation, if the remaining agents are in it: all pairs within a tenth of the shortest distance."""
    slots = mission.formation_slots(name) if name else None
    if slots is None:
        return None
    both = np.array([slots, now.r])[:, ~now.lost]
    if both.shape[1] < 2:
        return None
    wanted, lengths = distance_geometry.distances(both, all_pairs(both.shape[1]).T)
    return name if (np.abs(lengths - wanted) <= _NEAR * wanted.min()).all() else None


def _edges(mission: Mission, name: str | None) -> Ints:
    """Edges (m, 2) of a formation; none without one."""
    return mission.formation_edges(name) if name else np.zeros((0, 2), dtype=np.int64)


def _vehicles(mission: Mission) -> Vehicles:
    m, limit = mission.fleet.mass.copy(), mission.fleet.thrust_limit.copy()
    return Vehicles(
        m, 1.0 / m, float(m.sum()), float(m.mean()), limit, mission.agents.saturate, mission.gravity
    )


def _constraint_graph(mission: Mission, name: str | None, large: bool) -> Graph:
    return graph(_edges(mission, name), mission.fleet.mass, large=large)


def _agree(lengths: Floats, slots: Floats, edges: Ints) -> bool:
    """Whether the edges (m, 2) of slots have the lengths (m,) asked for, to rounding [m]."""
    own = distance_geometry.distances(slots, edges)
    return bool((np.abs(lengths - own) <= _ROUNDED + 1e-12 * own).all())


def _constraint_law(mission: Mission, solver_damping: float, *, damped: bool) -> ConstraintLaw:
    c = mission.constraint
    pid = c.stabilisation == "pid"
    return ConstraintLaw(
        alpha=c.alpha if pid else 0.0,
        beta=c.beta if pid else 0.0,
        gamma=c.gamma if pid else 0.0,
        solver=SOLVERS[c.solver],
        mu=solver_damping,
        iterations=c.iterations,
        s0=c.threshold,
        cutoff=c.cutoff,
        k_def=c.deformation_damping if damped else 0.0,
    )


def _control(mission: Mission, law: tuple[int, bool, bool], extra: tuple[float, ...]) -> Control:
    force = np.tile(np.array(extra, dtype=float), (mission.n_agents, 1))
    force[:, 2] += mission.fleet.mass * mission.gravity
    allocation = mission.allocation
    method = RIGID if allocation.method == "rigid" else SPLITS[allocation.torque_split]
    return Control(*law, force, *mission.tracking_gains, method)


def _feedback(mission: Mission, phase: Phase, goal: Pose, t0: float, arrival: float) -> Feedback:
    """LQR of the virtual body itself: gain tables on the way to a waypoint, tracking gains at rest."""
    hold = mission.tracking_gains * 2
    to_go, gain, slope = np.zeros(0), np.zeros((0, 4)), np.zeros((0, 4))
    if phase.moves:
        # Gains grow like 1/tau near arrival, until S bounds them. Cubics on a geometric grid are
        # exact to 1e-8.
        horizon = arrival - t0
        to_go = np.concatenate([[0.0], np.geomspace(min(1e-6, 1e-3 * horizon), horizon, 1000)])
        laws = regulators(mission, phase)
        tables = [_gains_and_slopes(law, to_go) for law in (laws, laws.attitude)]
        gain, slope = (np.concatenate(columns, axis=1) for columns in zip(*tables, strict=True))
    return Feedback(
        to_go, np.ascontiguousarray(gain), np.ascontiguousarray(slope), arrival, goal.r, goal.v,
        np.ascontiguousarray(goal.T), goal.omega, np.array(hold),
    )  # fmt: skip


def _gains_and_slopes(law: Regulator, to_go: Floats) -> tuple[Floats, Floats]:
    """Gains (K, 2) of one axis over the time to go (K,) [s], and their slopes (Riccati equation)."""
    if law.horizon == "infinite":
        gain = np.tile(lqr.double_integrator_gains(law.Q, law.R), (len(to_go), 1))
        return gain, np.zeros_like(gain)
    A, B = [[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]
    P, K = lqr.finite_horizon(A, B, law.Q, np.atleast_2d(law.R), law.S, to_go)
    gain = K[:, 0]
    with np.errstate(over="ignore", invalid="ignore"):  # absurd weights: the flight reports them
        slope = np.stack([P[:, 0, 0], 2 * P[:, 0, 1] + law.Q[1]], axis=1) / law.R
        return gain, slope - gain * gain[:, 1:]
