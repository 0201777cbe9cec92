"""What is measured of a flight at its samples: values of each quantity, and whose they are."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from rigidfleet._common.quantities import MOTIONS, PLACES, QUANTITIES, Quantity
from rigidfleet._common.text import agent_names
from rigidfleet.math import attitude as att
from rigidfleet.math import proximity
from rigidfleet.math.bernstein import SIZES
from rigidfleet.result import Result
from rigidfleet.typing import Floats

#: What has a value: by its sample, and its place there, the indices that its quantity needs to name it (from 0).
Owner = Callable[..., tuple[int, ...]]


class Samples:
    """Values (K, ...) of a quantity at samples, with their owners.

    Attributes
    ----------
    rank : of each value (K, places): greater is worse; -infinity if the value is not finite
    """

    def __init__(self, q: Quantity, values: Floats, owner: Owner = lambda _k, i: (i, -1)) -> None:
        self.quantity, self.values, self.owner = q, values, owner
        rank = q.rank(values)
        if not rank.max(initial=-np.inf) < np.inf:  # nor is NaN
            rank = np.where(np.isfinite(rank), rank, -np.inf)
        self.rank = rank.reshape(len(rank), -1)

    @property
    def worst(self) -> Floats:
        """Size (K,) of the worst value of each sample; NaN if none is finite."""
        rank = self.rank.max(axis=1, initial=-np.inf)
        return np.where(np.isfinite(rank), -rank if self.quantity.at_least else rank, np.nan)


def norms(x: Floats, addend: Floats | None = None) -> Floats:
    """Lengths (...) of vectors (..., 3), or of their sums with ``addend`` (..., 3)."""
    squares = (x if addend is None else x + addend) ** 2
    return np.sqrt(squares[..., 0] + squares[..., 1] + squares[..., 2])


def owner_name(result: Result, q: Quantity, who: int, other: int = -1) -> str:
    """Name of the owner of a value: an agent, two agents, an edge, or an agent and an obstacle (from 0)."""
    match q.who:
        case "pair":
            return agent_names(sorted((who, other)))
        case "edge":
            return f"edge {who + 1}-{other + 1}"
        case "obstacle" | "fence" | "people":
            return f"agent {who + 1}, {getattr(result.mission, PLACES[q.who])[other].name}"
    return f"agent {who + 1}" if q.who == "agent" else ""


def mask_lost(result: Result, values: Floats) -> Floats:
    """Values (K, N, ...), NaN for lost agents."""
    left = result.left.reshape(*result.left.shape, *[1] * (values.ndim - 2))
    return values if left.all() else np.where(left, values, np.nan)


def closeness(result: Result) -> proximity.Closeness:
    """Distances to each other and to obstacles at samples."""
    mission = result.mission
    return proximity.closeness(
        result.position, mission.agents.radius, mission.obstacles, result.time, result.left
    )


def samples(result: Result, name: str, close: proximity.Closeness | None = None) -> Samples:
    """Values of a quantity at samples, from positions and forces; ``close`` is `closeness`, if it is known."""
    if name in ("separation", "clearance"):
        near = closeness(result) if close is None else close
        if name == "separation":
            return Samples(QUANTITIES[name], near.separation, lambda k: near.pair[k].tolist())
        who, what = near.agent, near.obstacle
        return Samples(QUANTITIES[name], near.clearance, lambda k: (who.item(k), what.item(k)))
    return Samples(QUANTITIES[name], *SAMPLED[name](result))


def _motion_magnitudes(result: Result, q: Quantity) -> tuple[Floats, ...]:
    """Sizes (K, N) of velocity, acceleration or the jerk of slots, in all directions or one."""
    x = getattr(result, ("velocity", "acceleration", "slot_jerk")[q.order - 1])
    if x is None:
        return (np.full(result.left.shape, np.nan),)
    return (mask_lost(result, SIZES[q.way](x) if q.way else norms(x)),)


def _vertical_separation(result: Result) -> tuple[Floats, Owner]:
    """Least height (K,) [m] between two agents, one below the other."""
    least, pair = proximity.headroom(result.position, result.mission.agents.radius, result.left)
    return least, lambda k: pair[k]


def _distance_to_lost(result: Result) -> tuple[Floats, Owner]:
    """Least distance (K,) [m] between a lost agent and one still flying; NaN if no agent is lost."""
    r, radius = result.position, result.mission.fleet.radius
    least, who = np.full(len(r), np.nan), np.zeros((len(r), 2), dtype=np.int64)
    for i in np.flatnonzero(~result.left[-1]):
        separation = np.linalg.norm(r - r[:, [i]], axis=2) - radius - radius[i]
        separation = np.where(result.left & ~result.left[:, [i]], separation, np.inf)
        j = separation.argmin(axis=1)
        separation = np.where(result.left[:, i], np.nan, separation[np.arange(len(r)), j])
        closer = np.fmin(separation, least) != least
        closer &= np.isfinite(separation)
        least[closer] = separation[closer]
        who[closer] = np.column_stack([np.full(len(r), i), j])[closer]
    return least, lambda k: who[k]


def _measures_of_states(result: Result, q: Quantity) -> tuple[Floats, ...]:
    """Values (K, N) of what positions and velocities show by themselves."""
    assert q.measure is not None
    states = (mask_lost(result, x) for x in (result.position, result.velocity))
    return (q.measure(result.mission, *states),)


def _boundary_distances(result: Result, name: str) -> tuple[Any, ...]:
    """Distance (K, N) [m] beyond a fence, or of where a fall ends from people."""
    from rigidfleet.mission.boundaries import Boundaries, areas_judged_by  # takes long to load

    if not areas_judged_by(result.mission, name):
        return (np.full(result.left.shape, np.nan),)
    values, area = Boundaries(result.mission).worst_by_area(name, result.position, result.velocity)
    return mask_lost(result, values), lambda k, i: (i, int(area[k, i]))


def _tilt(result: Result) -> tuple[Floats, ...]:
    """Tilt (K, N) [deg] of each vehicle; of points, of the thrust that the slots they track need."""
    if result.vehicle_attitude is not None:
        up = att.dcm_from_quaternion(result.vehicle_attitude)[..., 2, 2]
    elif (wanted := result.slot_acceleration) is not None:
        force = wanted + np.array([0.0, 0.0, result.mission.gravity])
        up = force[..., 2] / np.maximum(norms(force), 1e-300)
    else:
        up = np.full(result.left.shape, np.nan)
    return (mask_lost(result, np.degrees(np.arccos(np.clip(up, -1.0, 1.0)))),)


def _thrust(result: Result) -> tuple[Floats, ...]:
    """Thrust (K, N) [N] of each agent, from forces, or as recorded where that is more."""
    thrust, agents = norms(result.input_force, result.constraint_force), result.mission.agents
    if agents.saturate:
        thrust = np.minimum(thrust, agents.thrust_limit)
    if result.rotor_force is not None:  # what was given, not what was asked
        thrust = result.rotor_force.sum(axis=2)
    return (mask_lost(result, np.maximum(thrust, result.thrust)),)


def _with_edge_owners(result: Result, values: Floats) -> tuple[Floats, Owner]:
    edges = result.edges
    return values, lambda _k, e: edges[e].tolist()


#: Values of quantities at samples, with their owners where these are no single agents.
SAMPLED: dict[str, Callable[[Result], tuple[Any, ...]]] = {
    **{q.name: partial(_motion_magnitudes, q=q) for q in MOTIONS},
    "separation_below": _vertical_separation,
    "lost": _distance_to_lost,
    **{q.name: partial(_measures_of_states, q=q) for q in QUANTITIES.values() if q.measure},
    **{name: partial(_boundary_distances, name=name) for name in ("fence", "soft_fence", "people")},
    "thrust": _thrust,
    "tilt": _tilt,
    "tracking_error": lambda r: (mask_lost(r, norms(r.position - r.slot_position)),),
    "constraint": lambda r: _with_edge_owners(r, np.abs(r.constraint)),
    "tension": lambda r: _with_edge_owners(r, -r.multiplier),
    "constraint_force": lambda r: (mask_lost(r, norms(r.constraint_force)),),
    "singular_value": lambda r: (r.singular_value, lambda _k: (0,)),
}
