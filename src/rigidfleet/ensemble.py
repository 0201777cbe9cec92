"""Establish a formation from many starts at once: a hundred thousand flights in some seconds.

For a gain study or a Monte Carlo study of the constraint law itself. What varies here are the starts alone, what
comes out is where the agents end; `rigidfleet.sweep` varies anything in any mission, and judges every flight.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigidfleet.kernel import ensemble
from rigidfleet.kernel.lanes import WIDTH
from rigidfleet.mission import Mission
from rigidfleet.plan import plan_phase
from rigidfleet.route import Situation

if TYPE_CHECKING:
    from rigidfleet.kernel.program import Array

#: Flying alone takes about this long for an evaluation [s]: so much for any, so much for each edge pair.
_CALL, _PAIR = 4e-7, 4e-9
#: Evaluations in a second of mission time, about.
_RATE = 40.0
#: Work alone [s] from which on vectors are worth the compiler's minute, which is due once on a machine.
_WORTH = 15.0


@dataclass(frozen=True)
class Ensemble:
    """Where B flights have ended.

    Attributes
    ----------
    position, velocity : (B, N, 3) at the end, world axes [m, m/s]
    error : (B,) the largest error of a distance that the last formation asks for [m]
    finished : (B,) whether a flight has reached the end; the rest holds its last good state
    evaluations : (B,) of the right-hand side
    vectors : whether eight flights shared a vector
    """

    position: Array
    velocity: Array
    error: Array
    finished: NDArray[np.bool_]
    evaluations: NDArray[np.int64]
    vectors: bool


def establish(
    mission: Mission,
    position: ArrayLike,
    velocity: ArrayLike | None = None,
    *,
    vectors: bool | None = None,
    threads: int | None = None,
) -> Ensemble:
    """Fly a mission of open-loop phases from many starts.

    Parameters
    ----------
    mission : all of its phases are flown under distances or steps (``reference``), with ``control = "open"``, and
        end at a time, like those of Table 1; tolerances, gains and masses are the mission's. A damping of
        "auto" is 0.03 throughout, as flights of one phase are not all in their formation, or none
    position, velocity : (B, N, 3) at the start, world axes [m, m/s]; at rest without velocities
    vectors : whether eight flights share a vector of the machine, and their steps: five times as fast, once the
        compiler has had its minute. By default where flying alone would take longer than that; this
        depends on the mission and on B only.
    threads : by default one for each core. Results do not depend on it, bit for bit.

    Raises
    ------
    ValueError
        The mission has other phases, or disturbances, or the shapes of the starts do not fit it.
    """
    r = _starts("position", position, mission.n_agents)
    v = np.zeros_like(r) if velocity is None else _starts("velocity", velocity, mission.n_agents)
    if v.shape != r.shape:
        raise ValueError(f"velocity {v.shape} and position {r.shape} must have one shape")
    for index, phase in enumerate(mission.phases):
        if (
            phase.control != "open"
            or phase.settle
            or getattr(phase, "reference", "step") == "shape"
        ):
            raise ValueError(
                f"phase {index + 1} '{phase.name}' is not flown open-loop under distances to a given time, which is all"
                " that an ensemble flies; vary other missions by `rigidfleet.sweep`"
            )
    if mission.disturbances is not None:
        raise ValueError(
            "an ensemble flies in calm air; vary missions with [disturbances] by `rigidfleet.sweep`"
        )
    count, n = r.shape[:2]
    threads = threads or os.cpu_count() or 1
    if vectors is None:
        vectors = _alone(mission, count) > _WORTH
    now = Situation(0.0, r[0], v[0])
    integral: dict[tuple[int, int], Array] = {}
    finished = np.ones(count, dtype=bool)
    evaluations = np.zeros(count, dtype=np.int64)
    error = np.zeros(count)
    for phase in mission.phases:
        if not finished.any():
            break
        places = _places(finished)
        t_end = now.t + (phase.duration or 0.0) if phase.until is None else phase.until
        # One plan for all: without slots, only the distances it starts from are a flight's own.
        plan = plan_phase(mission, phase, now, t_end)
        if plan.method != "dense":
            raise ValueError(
                f"an ensemble solves densely, and '{plan.formation}' has too many edges for that"
                f" ({len(plan.edges)}); vary such missions by `rigidfleet.sweep`"
            )
        law = plan.program.law._replace(mu=mission.damping(None))
        edges = [(int(i), int(j)) for i, j in plan.edges]
        before = np.stack(
            [np.full(count, now.reference[e]) if e in now.reference else _distance(r, e) for e in edges], axis=1
        )  # fmt: skip
        sums = [integral.get(e, np.zeros(count)) for e in edges]
        y = np.column_stack([r.reshape(count, -1), v.reshape(count, -1), *sums])
        tolerances = mission.integrator
        ends = ensemble.fly_all(
            plan.program._replace(law=law),
            y[places],
            before[places],
            (now.t, t_end),
            rtol=tolerances.rtol,
            atol=np.full(y.shape[1], tolerances.atol),
            vectors=vectors,
            threads=threads,
        )
        y[finished] = ends.y[finished]
        evaluations[finished] += ends.evaluations[finished]
        finished &= ends.finished
        r, v = (x.reshape(count, n, 3) for x in np.split(y[:, : 6 * n], 2, axis=1))
        integral |= dict(zip(edges, y[:, 6 * n :].T, strict=True))
        known = now.reference | dict(zip(edges, plan.distances.tolist(), strict=True))
        now = replace(now, t=t_end, reference=known, formation=plan.formation, slots=plan.slots)
        lengths = np.stack([_distance(r, e) for e in edges], axis=1)
        error = np.abs(lengths - plan.distances).max(axis=1)
    return Ensemble(r, v, error, finished, evaluations, vectors)


def _starts(name: str, values: ArrayLike, agents: int) -> Array:
    starts = np.array(values, dtype=float)
    if starts.ndim != 3 or starts.shape[1:] != (agents, 3) or not len(starts):
        raise ValueError(f"{name} must be (B, {agents}, 3) for {agents} agents, not {starts.shape}")
    if not np.isfinite(starts).all():
        raise ValueError(
            f"{name} of flight {np.argwhere(~np.isfinite(starts))[0][0]} is not finite"
        )
    return starts


def _places(finished: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Which flight takes each place: whoever is out lends it to a neighbour, so that the others keep theirs."""
    places = np.arange(len(finished))
    for k in np.flatnonzero(~finished):
        first = k - k % WIDTH
        near = np.flatnonzero(finished[first : first + WIDTH])
        places[k] = first + near[0] if len(near) else np.flatnonzero(finished)[0]
    return places


def _distance(r: Array, edge: tuple[int, int]) -> Array:
    return np.linalg.norm(r[:, edge[0]] - r[:, edge[1]], axis=1)


def _alone(mission: Mission, count: int) -> float:
    """About how long flying alone would take [s]: a function of the mission, not of the machine."""
    edges = max(len(mission.formation_edges(name)) for name in mission.formations)
    return count * mission.latest_end * _RATE * (_CALL + _PAIR * edges**2)
