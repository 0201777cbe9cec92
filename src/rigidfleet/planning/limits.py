"""How near the reference of a phase comes to the limits of speed, acceleration, jerk, tilt and thrust.

Limits hold for each slot, with the turn and the change of shape included. The greatest share of each limit is searched
in continuous time: on a grid of at least 128 samples of the phase, 128 of the blend and 16 of each piece, and then, in
the neighbourhood of the four highest peaks of the grid, on ever finer ones. Values are found to 1e-3 of the limit; the
tests compare them with dense samples.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import NamedTuple

import numpy as np

from rigidfleet._common.quantities import MOTIONS, QUANTITIES, Quantity
from rigidfleet.kernel.problem import Motion, Reference
from rigidfleet.math.bernstein import SIZES
from rigidfleet.mission import Mission
from rigidfleet.mission.schema import Limits
from rigidfleet.planning.derivatives import reference_of_agents, slot_derivatives
from rigidfleet.planning.vehicles import drag_and_lift
from rigidfleet.typing import Floats, Ints

#: Samples of a phase and of a blend, of a piece, and of a phase of many pieces in all.
_PHASE, _PIECE, _MOST = 129, 16, 2048
#: Peaks of the grid that are refined, and how high they are at least, as a share of the highest one; samples of a
#: refined peak, and how often it is refined.
_PEAKS, _HIGH, _FINE, _TIMES = 4, 0.97, 17, 3
#: Greatest number of positions computed at once.
_BLOCK = 500_000


class Limit(NamedTuple):
    """A limit of each agent: what is limited, its greatest value (N,), and how it follows from slots, as (K, N)."""

    of: Quantity
    most: Floats
    values: Callable[[Floats, Ints], Floats]


class Reached(NamedTuple):
    """The greatest share of a limit that a reference reaches."""

    limit: Limit
    value: float
    time: float  # [s]
    agent: int  # from 0

    @property
    def share(self) -> float:
        """Value over limit."""
        return self.value / float(self.limit.most[self.agent])


def limits_of(
    mission: Mission,
    limits: Limits | None = None,
    reserve: Floats | None = None,
    kept_if_unlimited: Collection[str] = (),
    lost_by: float = -np.inf,
) -> list[Limit]:
    """The limits that a mission sets to its references, or other ``limits`` in place of its own.

    Quantities ``kept_if_unlimited`` by name are there without a limit, too: it is then infinite.
    With ``reserve`` (N,) [s], quantities are the greatest that vehicles reach (`planning.vehicles.tracking_lag_times`).
    Vehicles that are ``lost_by`` a time [s] have none.
    """
    limits, lost = limits or mission.limits, mission.lost_at <= lost_by
    mass, up = mission.fleet.mass, np.array([0.0, 0.0, mission.gravity])

    def lag_overshoot(derivative: int, states: Floats, who: Ints) -> Floats | float:
        if reserve is None or derivative + 1 >= states.shape[1]:
            return 0.0  # the jerk that counts is that of the slots
        return reserve[who] * np.linalg.norm(states[:, derivative + 1], axis=-1).max(axis=0)

    def motion_with_overshoot(q: Quantity, x: Floats, who: Ints) -> Floats:
        return SIZES[q.way](x[:, q.order]) + lag_overshoot(q.order, x, who)

    def force_per_mass(x: Floats, who: Ints) -> Floats:
        """What a thrust gives per mass [m/s^2], against drag if vehicles leave a reserve."""
        air = 0.0 if reserve is None else drag_and_lift(mission, -x[:, 1], who) / mass[who, None]
        return x[:, 2] + up - air

    def tilt_with_overshoot(_: Quantity, x: Floats, who: Ints) -> Floats:
        f, off = force_per_mass(x, who), lag_overshoot(2, x, who)
        return np.rad2deg(np.arctan2(SIZES["horizontal"](f) + off, f[..., 2] - off))

    def thrust_with_overshoot(_: Quantity, x: Floats, who: Ints) -> Floats:
        return mass[who] * (SIZES[""](force_per_mass(x, who)) + lag_overshoot(2, x, who))

    ways, finite = {"tilt": tilt_with_overshoot, "thrust": thrust_with_overshoot}, []
    for q in (*MOTIONS, QUANTITIES["tilt"], QUANTITIES["thrust"]):
        table, _, key = q.key.partition(".")
        most = mission.fleet.thrust_limit if table == "agents" else getattr(limits, key)
        most = np.where(lost, np.inf, np.inf if most is None else most)
        if q.name in kept_if_unlimited or np.isfinite(most).any():
            finite.append(Limit(q, most, partial(ways.get(q.way, motion_with_overshoot), q)))
    return finite


def use_of_limits(
    limits: list[Limit],
    reference: Reference,
    motion: Motion,
    begin: float,
    end: float,
    *,
    fine: bool = True,
) -> list[Reached]:
    """What a reference reaches of each limit between two times [s]; on the grid alone unless ``fine``."""
    time = _grid_times(reference, motion, begin, end)
    n = len(reference.p0)
    step = max(1, _BLOCK // len(time))
    best: dict[int, Reached] = {}
    for first in range(0, n, step):
        who = np.arange(first, min(first + step, n))
        x = slot_derivatives(reference_of_agents(reference, who), motion, time, 4)
        for k, limit in enumerate(limits):
            limited = np.isfinite(limit.most[who])
            if not limited.any():
                continue
            own, some = (x, who) if limited.all() else (x[:, :, limited], who[limited])
            highest = _greatest_share(limit, reference, motion, time, own, some, fine=fine)
            if k not in best or highest.share > best[k].share:
                best[k] = highest
    return [best[k] for k in sorted(best)]


def _grid_times(reference: Reference, motion: Motion, begin: float, end: float) -> Floats:
    knots = np.union1d(motion.knots, reference.knots)
    knots = knots[(knots >= begin) & (knots <= end)]
    each = max(2, min(_PIECE, _MOST // max(len(knots), 1)))
    shares = np.linspace(0.0, 1.0, each, endpoint=False)
    inside = (knots[:-1, None] + shares * np.diff(knots)[:, None]).ravel()
    blend = np.linspace(reference.t0, reference.t0 + reference.T_b, _PHASE)
    blend = blend[(blend >= begin) & (blend <= end)]
    return np.unique(np.concatenate([np.linspace(begin, end, _PHASE), inside, knots, blend]))


def _greatest_share(
    limit: Limit,
    reference: Reference,
    motion: Motion,
    time: Floats,
    x: Floats,
    who: Ints,
    *,
    fine: bool,
) -> Reached:
    """The greatest share of a limit, refined about the highest samples x (K, 4, N, 3) at times (K,)."""
    shares = limit.values(x, who) / limit.most[who]
    agents = shares.argmax(axis=1)
    top = shares[np.arange(len(time)), agents]
    k = int(top.argmax())
    best = top[k], time[k], int(who[agents[k]])
    around = np.concatenate([[-np.inf], top, [-np.inf]])
    high = top >= _HIGH * top[k]
    peaks = np.flatnonzero(high & (top >= around[:-2]) & (top >= around[2:]))
    for k in peaks[np.argsort(-top[peaks], kind="stable")][: _PEAKS if fine else 0]:
        agent = who[agents[k] : agents[k] + 1]
        low, high = time[max(k - 1, 0)], time[min(k + 1, len(time) - 1)]
        for _ in range(_TIMES):
            near = np.linspace(low, high, _FINE)
            y = slot_derivatives(reference_of_agents(reference, agent), motion, near, 4)
            values = (limit.values(y, agent) / limit.most[agent])[:, 0]
            j = int(values.argmax())
            best = max(best, (values[j], near[j], int(agent[0])))
            low, high = near[max(j - 1, 0)], near[min(j + 1, _FINE - 1)]
    share, t, agent = best
    return Reached(limit, float(share * limit.most[agent]), float(t), agent)
