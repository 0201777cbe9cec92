"""Make tables over time, which the kernel reads, from a mission's disturbances.

All random numbers are drawn before the flight, from generators that the mission seeds. The same mission therefore
gives the same flight, bit for bit, and a longer one meets the same gusts and noise.
"""

from __future__ import annotations

import math

import numpy as np

from rigidfleet.kernel.problem import Disturbance, Problem, graph, no_disturbance
from rigidfleet.math import turbulence
from rigidfleet.mission import Gusts, Mission
from rigidfleet.mission.disturbances import gust_intensity, knot_spacing
from rigidfleet.mission.model import part_of_mission
from rigidfleet.planning import filters
from rigidfleet.typing import Bools, Floats, Ints

#: Mass of a lost vehicle in the control laws [kg]: too small to count, yet nothing is divided by zero.
LOST_MASS = 1e-20


def mission_disturbance(mission: Mission) -> Disturbance:
    """Disturbances of a mission from its start to its latest end, with no vehicle lost yet."""
    return part_of_mission(mission, _draw_disturbance)  # random numbers take long to draw


def _draw_disturbance(mission: Mission) -> Disturbance:
    """All that disturbs a flight of a mission, as tables drawn by its seeds; none if it has no disturbances."""
    d = mission.disturbances
    none = no_disturbance(mission.fleet.mass.copy())
    if d is None:
        return none
    wind = np.array(d.wind)
    out = none._replace(
        active=True,
        m=mission.true_mass,
        inverse=1.0 / mission.true_mass,
        drag=mission.drag,
        wind=wind,
        floor=mission.ground + mission.fleet.radius,
        radius=mission.fleet.radius,
        roofs=mission.roofs,
    )
    if d.gusts is not None:
        step = knot_spacing(d.gusts, float(np.linalg.norm(wind)))
        out = out._replace(
            gust_step=step, gust=filters.spline_coefficients(_gusts(mission, d.gusts, wind, step))
        )
    if d.noise is not None:
        step = 1.0 / d.noise.rate
        shape = (_count_knots(mission, step), 2, mission.n_agents, 3)
        white = np.random.default_rng((1, d.noise.seed)).standard_normal(shape)
        r, v = (
            filters.spline_coefficients(white, scale, part)
            for part, scale in enumerate((d.noise.position, d.noise.velocity))
        )
        out = out._replace(noise_step=step, noise_r=r, noise_v=v)
    return out


def _count_knots(mission: Mission, step: float) -> int:
    return math.ceil(mission.latest_end / step) + 2


def _gusts(mission: Mission, gusts: Gusts, wind: Floats, step: float) -> Floats:
    """Velocity of the air (K, N, 3) [m/s] at each agent, world axes, without the steady wind."""
    n, speed = mission.n_agents, float(np.linalg.norm(wind))
    rng = np.random.default_rng((0, gusts.seed))
    # The two numbers of a sample first, so that those of each filter lie together after the products.
    white = rng.standard_normal((_count_knots(mission, step), 2, n + 1, 3)).swapaxes(0, 1)
    if gusts.correlation_length is not None:
        white = turbulence.correlate_by_distance(
            white[..., :n, :], _relative_places(mission), gusts.correlation_length
        )
    else:
        white = turbulence.correlate_agents(white, gusts.correlation or 0.0)
    u, sigma = np.empty(white[0].shape), gust_intensity(gusts, speed)
    if gusts.model == "first-order":
        assert gusts.time_scale is not None  # checked on entry
        np.multiply(filters.gauss_markov(white[0], step, gusts.time_scale), sigma, out=u)
    else:
        if gusts.altitude is not None:
            _, length = turbulence.low_altitude_gusts(gusts.altitude, speed)
        else:
            length = np.broadcast_to(np.array(gusts.length, dtype=np.float64), 3)
        tau = length / (gusts.airspeed or speed)
        u[..., 0] = sigma[0] * filters.gauss_markov(white[0, ..., 0], step, tau[0])
        by_sample = white.swapaxes(0, 1)
        for axis in (1, 2):
            u[..., axis] = sigma[axis] * filters.dryden_gust(by_sample[..., axis], step, tau[axis])
    return (u.reshape(-1, 3) @ _wind_axes(wind)).reshape(u.shape)


def _wind_axes(wind: Floats) -> Floats:
    """Unit vectors (3, 3), a row each, along the wind over ground, across it to the left, and up."""
    along = math.hypot(wind[0], wind[1])
    c, s = (wind[0] / along, wind[1] / along) if along > 0.0 else (1.0, 0.0)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _relative_places(mission: Mission) -> Floats:
    """Relative positions (N, 3) [m] of the agents: in the first formation established, or else at the start."""
    names = (p.establishing.formation for p in mission.phases if p.establishing is not None)
    slots = next((s for s in map(mission.formation_slots, names) if s is not None), None)
    return mission.fleet.position.copy() if slots is None else slots


def with_fixed_agents(problem: Problem, fixed: Ints) -> Problem:
    """The problem in which agents (F,), from 0, never move: for the equations of motion their mass is infinite."""
    m, true = problem.vehicles.m.copy(), problem.disturbance.inverse.copy()
    m[fixed], true[fixed] = math.inf, 0.0
    return problem._replace(
        vehicles=problem.vehicles._replace(inverse=1.0 / m),
        disturbance=problem.disturbance._replace(inverse=true),
        graph=graph(problem.graph.edges, m),
    )


def without_lost(
    problem: Problem,
    kept: Bools,
    lost: Bools,
    mu: float,
    *,
    large: bool = False,
) -> Problem:
    """The problem of the remaining agents: only the edges ``kept`` (m,), and no thrust of the agents ``lost`` (N,).

    In the control laws, lost agents have the mass `LOST_MASS`. The mean mass, which scales the damping ``mu``, is that
    of the remaining agents. The equations of motion keep the lost agents and their masses.
    """
    m = np.where(lost, LOST_MASS, problem.vehicles.m)
    mean = float(m[~lost].mean()) if not lost.all() else 1.0
    reference, control = problem.reference, problem.control
    return problem._replace(
        vehicles=problem.vehicles._replace(m=m, inverse=1.0 / m, M=float(m.sum()), mean=mean),
        law=problem.law._replace(mu=mu),
        graph=graph(problem.graph.edges[kept], m, large=large),
        reference=reference._replace(d0=reference.d0[kept], d1=reference.d1[kept]),
        control=control._replace(force=np.where(lost[:, None], 0.0, control.force)),
        disturbance=problem.disturbance._replace(lost=lost.copy()),
    )
