"""What all peers fly: masses, starts and edges of an establishment by constraint forces alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial import ConvexHull

from rigidfleet.formation import distance_geometry, shapes
from rigidfleet.mission import Mission, load_mission

Array = NDArray[np.float64]
DURATION = 20.0  # [s]
FORCE = (0.1, 0.1, 0.0)  # on every agent beyond its weight, as in the paper [N]
#: What programs with adaptive steps are flown at, and those with equal ones [s].
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)
STEPS = (0.08, 0.04, 0.02, 0.01, 0.005, 0.0025, 0.00125)
#: Flights are timed for so long at least [s].
AT_LEAST = 0.1


@dataclass(frozen=True)
class Case:
    """A step to the distances d under c'' + 2 alpha c' + beta^2 c + gamma int c = 0, undamped."""

    mission: Mission
    r: Array  # (N, 3) starts, at rest [m]
    m: Array  # (N,) masses [kg]
    edges: NDArray[np.int64]  # (m, 2) from 0
    d: Array  # (m,) desired distances [m]

    @property
    def n(self) -> int:
        """Agents."""
        return len(self.m)

    @property
    def gains(self) -> tuple[float, float, float]:
        """Alpha [1/s], beta [1/s], gamma [1/s^3]."""
        c = self.mission.constraint
        return c.alpha, c.beta, c.gamma

    @property
    def force(self) -> Array:
        """Input (N, 3) [N]."""
        return np.tile(FORCE, (len(self.m), 1))

    def within(self, tolerance: float) -> Mission:
        """The mission at a tolerance."""
        integrator = {"rtol": tolerance, "atol": tolerance}
        return Mission.from_dict(self.mission.to_dict() | {"integrator": integrator})

    def error(self, r: Array) -> float:
        """The largest error of a distance at positions r (N, 3) [m]."""
        return float(np.abs(distance_geometry.distances(r, self.edges) - self.d).max())

    def lengths(self, step: float) -> Array:
        """Lengths (K, m) [m] that the law gives the edges at 0, step, ...: the error's equation is linear."""
        alpha, beta, gamma = self.gains
        A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-gamma, -(beta**2), -2.0 * alpha]])
        E, x, phi = expm(A * step), np.array([1.0, 0.0, -(beta**2)]), []
        for _ in range(round(DURATION / step) + 1):
            phi.append(x[0])
            x = E @ x
        return self.d + np.outer(phi, distance_geometry.distances(self.r, self.edges) - self.d)


#: One flight: the seconds it took, and positions (N, 3) at the end [m].
Flight = Callable[[], tuple[float, Array]]


@dataclass(frozen=True)
class Peer:
    """Another program, and how it flies a case."""

    name: str
    version: str
    model: str  # in what its model or method differs, in words
    same_law: bool  # whether it integrates our law, so that positions converge to ours
    efforts: tuple[float, ...]  # tolerances or steps [s], the coarsest first
    unit: str  # of an effort: "tolerance" or "step [s]"
    flight: Callable[[Case, float], Flight]


class AbsentError(Exception):
    """A peer that this machine does not have; says what would bring it."""


def timed(fly: Callable[[], Array]) -> Flight:
    """A flight that is timed in this process; a short one again and again, and averaged."""

    def flight() -> tuple[float, Array]:
        start, calls = time.perf_counter(), 0
        while True:
            r = fly()
            calls += 1
            passed = time.perf_counter() - start
            if passed >= AT_LEAST:
                return passed / calls, r

    return flight


def cases() -> dict[int, Case]:
    """The triangle of Table 1, the cube, and a triangulated sphere: 3, 8 and 100 agents."""
    data = (_shipped("triangle"), _shipped("cube"), _sphere(100))
    return {case.n: case for case in map(_case, data)}


def _case(data: dict) -> Case:
    (name,) = data["formations"]
    data["phases"] = [
        {"kind": "establish", "formation": name, "reference": "step", "control": "open",
         "input_force": list(FORCE), "duration": DURATION},
    ]  # fmt: skip
    data["constraint"] = {"solver": "exact", "deformation_damping": 0.0}
    data["output_step"] = DURATION / 200
    mission = Mission.from_dict(data)
    agents = mission.agents
    return Case(
        mission,
        np.array(agents.position),
        np.array(agents.mass),
        mission.formation_edges(name),
        mission.formation_distances(name),
    )


def _shipped(name: str) -> dict:
    data = load_mission(f"establish-{name}").to_dict()
    formation = data["phases"][0]["formation"]
    return data | {"formations": {formation: data["formations"][formation]}}


def _sphere(n: int) -> dict:
    p = shapes.slots("sphere", 2.0, n)
    faces = ConvexHull(p).simplices
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [0, 2]]])
    edges = np.unique(np.sort(pairs, axis=1), axis=0) + 1
    start = p + np.random.default_rng(0).uniform(-0.04, 0.04, p.shape)
    return {
        "schema_version": 1,
        "name": "sphere",
        "agents": {"mass": 1.0, "position": start.tolist()},
        "formations": {"sphere": {"slots": p.tolist(), "edges": edges.tolist()}},
    }
