"""Establish a formation from many starts at once: a hundred thousand flights in a few seconds.

This is for gain studies and Monte Carlo studies of the constraint law itself. Only the starts vary, and only the
states at the ends of phases are returned. `rigidfleet.sweep` uses this if only final states are evaluated; otherwise
it varies any key of any mission and judges whole flights.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigidfleet._common.arguments import as_numbers
from rigidfleet.kernel.compiler.simd import WIDTH
from rigidfleet.kernel.engine import batch
from rigidfleet.mission import Mission, Phase, as_mission
from rigidfleet.planning.legs import leg_of
from rigidfleet.planning.plan import PhasePlan, plan_phase
from rigidfleet.planning.reference import PhaseState
from rigidfleet.planning.solvers import choose_method
from rigidfleet.planning.timing import complete_times
from rigidfleet.planning.tolerances import absolute_tolerances, step_limit, tolerance_of_velocity
from rigidfleet.typing import Bools, Floats, Ints


@dataclass(frozen=True)
class Ensemble:
    """Final states of B flights.

    Attributes
    ----------
    position, velocity : (B, N, 3) at the end, world axes [m, m/s]
    error : (B,) greatest error of a distance of the last formation [m]
    finished : (B,) whether a flight has reached the end; if not, the other arrays hold its last valid state
    evaluations : (B,) number of evaluations of the right-hand side
    ends : position (B, N, 3) at the end of each phase [m]; the last valid one if a flight has not finished
    vectors : whether eight flights shared a SIMD vector
    """

    position: Floats
    velocity: Floats
    error: Floats
    finished: Bools
    evaluations: Ints
    ends: tuple[Floats, ...]
    vectors: bool


def establish(
    mission: Mission | str | Path,
    position: ArrayLike,
    velocity: ArrayLike | None = None,
    *,
    vectors: bool | None = None,
    threads: int | None = None,
) -> Ensemble:
    """Fly a mission of open-loop phases from many starts.

    Parameters
    ----------
    mission : a shipped name, a path or a `Mission`. All of its phases must have ``control = "open"``, end at a given
        time, and blend squared distances or step, like those of Table 1 (``reference``; "distances" counts if it
        blends squares from any start: without slots, or with three agents). Tolerances, gains and masses are the
        mission's. A damping of "auto" is 0.03 throughout, because some flights of a phase may be in their formation
        and others not
    position, velocity : (B, N, 3) at the start, world axes [m, m/s]; at rest if there is no velocity
    vectors : whether eight flights share a SIMD vector and the step size, in code generated for the mission's graph:
        seven times as fast, after a compilation of some seconds. By default this is used in each phase that
        `rigidfleet.kernel.engine.batch.fits`; True requires it in all phases
    threads : number of threads, by default one per core; results do not depend on it, bit for bit

    Raises
    ------
    ValueError
        The mission has other phases, axes or assignments, disturbances, or too many edges for the dense solve; or the
        starts have the wrong shape or are not finite.
    MissionError
        The mission does not exist, or has errors.
    TypeError
        ``mission`` is no mission.
    """
    mission = complete_times(as_mission(mission))
    r = _starts("position", position, mission.n_agents)
    v = np.zeros_like(r) if velocity is None else _starts("velocity", velocity, mission.n_agents)
    if v.shape != r.shape:
        raise ValueError(f"velocity {v.shape} and position {r.shape} must have the same shape")
    if (why := why_unfit_for_establish(mission)) is not None:
        raise ValueError(f"{why}; vary such missions with `rigidfleet.sweep`")
    flights = _Flights(mission, r, v)
    ends = []
    for phase in mission.phases:
        if flights.finished.any():
            flights.fly(phase, vectors, threads or os.cpu_count() or 1)
        ends.append(flights.r)
    return Ensemble(
        flights.r,
        flights.v,
        max_edge_error(flights.r, flights.plan.edges, flights.plan.distances),
        flights.finished,
        flights.evaluations,
        tuple(ends),
        flights.vectors,
    )


def why_unfit_for_establish(mission: Mission) -> str | None:
    """Why a mission cannot be flown by `establish`; None if it can."""
    for index, phase in enumerate(mission.phases):
        if phase.control != "open" or phase.settle or not _serves_all_starts(mission, phase):
            return (
                f"phase {index + 1} '{phase.name}' cannot be flown in an ensemble, which flies only open-loop phases"
                " that blend squares or step and end at a given time"
            )
        if (shaping := phase.shaping) is not None:
            edges = mission.formation_edges(shaping.formation)
            if choose_method(mission.n_agents, edges, mission.constraint.solver) != "dense":
                return (
                    f"an ensemble solves densely, and '{shaping.formation}' has too many edges for that"
                    f" ({len(edges)})"
                )
    if mission.formulation != "inertial":
        return f'an ensemble flies in world axes, but the mission has formulation = "{mission.formulation}"'
    if mission.assignment != "given":
        return f'in an ensemble agents take the slots as given, but the mission has assignment = "{mission.assignment}"'
    if mission.disturbances is not None:
        return "an ensemble flies in calm air, but the mission has [disturbances]"
    return None


class _Flights:
    """States of all flights, and what one phase hands on to the next."""

    def __init__(self, mission: Mission, r: Floats, v: Floats) -> None:
        self.mission, self.r, self.v = mission, r, v
        count = len(r)
        # One plan serves all flights: without slots, they differ only in the distances they start from.
        self.now = PhaseState(0.0, r[0], v[0])
        self.integral: dict[tuple[int, int], Floats] = {}
        self.finished = np.ones(count, dtype=bool)
        self.evaluations = np.zeros(count, dtype=np.int64)
        self.plan: PhasePlan  # that flew last
        self.vectors = True

    def fly(self, phase: Phase, vectors: bool | None, threads: int) -> None:
        """Fly one phase and store its final states."""
        now, (count, n) = self.now, self.r.shape[:2]
        plan = plan_phase(self.mission, leg_of(self.mission, phase, now))
        law = plan.problem.law._replace(mu=self.mission.damping(None))
        problem = plan.problem._replace(law=law)
        edges = [(int(i), int(j)) for i, j in plan.edges]
        before = now.reference.values_of(plan.edges, lambda: _edge_lengths(self.r, plan.edges))
        sums = [self.integral.get(edge, np.zeros(count)) for edge in edges]
        y = np.column_stack([self.r.reshape(count, -1), self.v.reshape(count, -1), *sums])
        places, options = _flights_with_substitutes(self.finished), self.mission.integrator
        velocity = tolerance_of_velocity(options, now.r, problem.vehicles.m, law.beta, large=False)
        shared = batch.can_unroll(problem) if vectors is None else vectors
        ends = batch.fly_all(
            problem,
            y[places],
            np.broadcast_to(before, (count, len(edges)))[places],
            (now.t, plan.t_end),
            rtol=options.rtol,
            atol=absolute_tolerances(options, y.shape[1], velocity, plan.distances, large=False),
            max_steps=step_limit(plan.t_end - now.t),
            vectors=shared,
            threads=threads,
        )
        self.vectors &= shared
        y[self.finished] = ends.y[self.finished]
        self.evaluations[self.finished] += ends.evaluations[self.finished]
        self.finished &= ends.finished
        self.r, self.v = (x.reshape(count, n, 3) for x in np.split(y[:, : 6 * n], 2, axis=1))
        self.integral |= dict(zip(edges, y[:, 6 * n :].T, strict=True))
        known = now.reference.with_values(plan.edges, plan.distances)
        self.now = replace(
            now, t=plan.t_end, reference=known, formation=plan.formation, slots=plan.slots
        )
        self.plan = plan


def _serves_all_starts(mission: Mission, phase: Phase) -> bool:
    """Whether a phase blends squares or steps from any start, so that one plan serves all flights."""
    if (shaping := phase.shaping) is None:
        return True
    bare = mission.n_agents <= 3 or not mission.formations[shaping.formation].knows_slots
    return shaping.reference in ("squares", "step") or (shaping.reference == "distances" and bare)


def _starts(name: str, values: ArrayLike, agents: int) -> Floats:
    starts = as_numbers(name, values).copy()
    if starts.ndim != 3 or starts.shape[1:] != (agents, 3) or not len(starts):
        raise ValueError(f"{name} must be (B, {agents}, 3) for {agents} agents, not {starts.shape}")
    if not np.isfinite(starts).all():
        raise ValueError(
            f"{name} of flight {np.argwhere(~np.isfinite(starts))[0][0]} is not finite"
        )
    return starts


def _flights_with_substitutes(finished: Bools) -> Ints:
    """Flight in each place; a flight that is out leaves its place to a neighbour, so that all others keep theirs."""
    places = np.arange(len(finished))
    for k in np.flatnonzero(~finished):
        first = k - k % WIDTH
        near = np.flatnonzero(finished[first : first + WIDTH])
        places[k] = first + near[0] if len(near) else np.flatnonzero(finished)[0]
    return places


def max_edge_error(r: Floats, edges: NDArray[np.integer], distances: Floats) -> Floats:
    """Greatest error (B,) [m] of edges (m, 2) against the lengths ``distances`` (m,) [m], at positions (B, N, 3)."""
    return np.abs(_edge_lengths(r, edges) - distances).max(axis=1, initial=0.0)


def _edge_lengths(r: Floats, edges: NDArray[np.integer]) -> Floats:
    """Lengths (B, m) of edges [m]."""
    way = r.take(edges[:, 0], axis=1)
    way -= r.take(edges[:, 1], axis=1)
    return np.sqrt(np.einsum("bka,bka->bk", way, way))
