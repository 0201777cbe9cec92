"""What is measured of a flight, once: each quantity with its unit, its words and its limit.

Verdict, check, automatic times, sweep metrics, report, safety page and figures read this table. How a quantity is
measured is a derivative of the position and a direction, a function of positions and velocities, or one that the layer
that measures has by its name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import degrees, inf
from operator import attrgetter
from typing import Any, Literal

from rigidfleet._common.facts import display_unit

#: What has one value each: an agent, two agents, an edge, an agent beside one of the `PLACES`, the formation.
Who = Literal["agent", "pair", "edge", "obstacle", "fence", "people", "formation"]
#: Tables of a mission in which the things stand beside which an agent has a value.
PLACES = {"obstacle": "obstacles", "fence": "fences", "people": "people"}
#: Which value is the worst: the least, the greatest, or the one of the greatest size.
Sense = Literal["least", "greatest", "size"]


@dataclass(frozen=True, slots=True)
class Quantity:
    """A quantity of a flight.

    Attributes
    ----------
    name : of its check, its metric, its row on the safety page, and its worst value in a record
    unit : of values and limits that are shown
    text : what is measured, in words
    who, sense : whose values they are, and which is the worst
    key : of its limit, as in messages about a mission; "" without one
    limit : from a mission to the limit, or to those of the agents (N,); None: the value of the key
    measure : from a mission, positions and velocities (K, N, 3) [m, m/s], NaN of lost agents, to the agents' values
        (K, N) in `unit`; None: another layer measures it
    order, way : the derivative of the position that it is of (1: velocity), and what of it: its size in all directions
        (""), "horizontal" or "vertical", or a quantity of the force that it needs; order 0: it is no such quantity
    scale : factor from values in records to `unit`
    words : about the worst value; "" for "greatest speed 3 m/s, agent 1, at 2.00 s (limit 4 m/s)"
    praise : what a passed verdict says of {worst}, {who} and {limit}; "" for nothing
    axis : words on an axis of a figure; "" for its name
    nothing : words if there is nothing to judge; "" for "the flight has no speed to judge"
    source : what it is judged by where positions over time do not show it, such as "forces"; "" if they do
    monitored : whether the kernel's monitor finds it in continuous time
    by_phase : whether a verdict has its worst value for each phase
    checked : whether a verdict checks or reports it, and a sweep keeps it
    """

    name: str
    unit: str
    text: str = ""
    who: Who = "agent"
    sense: Sense = "greatest"
    key: str = ""
    limit: Callable[[Any], Any] | None = None
    measure: Callable[[Any, Any, Any], Any] | None = None
    order: int = 0
    way: str = ""
    scale: float = 1.0
    words: str = ""
    praise: str = ""
    axis: str = ""
    nothing: str = ""
    source: str = ""
    monitored: bool = False
    by_phase: bool = False
    checked: bool = True

    @property
    def name_in_words(self) -> str:
        """Its name in words."""
        return self.name.replace("_", " ")

    @property
    def at_least(self) -> bool:
        """Whether a limit is the least value allowed, not the greatest."""
        return self.sense == "least"

    @property
    def display_unit(self) -> str:
        """The unit as consoles, pages and figures show it."""
        return display_unit(self.unit)

    @property
    def of_edges(self) -> bool:
        """Whether it says nothing of a flight without edges."""
        return self.source.endswith("edges")

    def rank(self, values: Any) -> Any:
        """Numbers that are greater the worse values are."""
        if self.sense == "least":
            return -values
        return abs(values) if self.sense == "size" else values

    def in_words(self, worst: str, who: str, when: float, limit: float | None) -> str:
        """A worst value, with its unit, in words."""
        if self.words:
            return self.words.format(worst=worst, who=who, when=when, limit=limit)
        bound = "" if limit is None else f" (limit {limit:g} {self.display_unit})"
        sense = "least" if self.at_least else "greatest"
        return f"{sense} {self.name_in_words} {worst}, {who}, at {when:.2f} s{bound}"

    def limit_of(self, mission: Any) -> Any:
        """The limit that a mission sets, in `unit`, or those of the agents; None if it sets none."""
        limit = self.limit or (attrgetter(self.key) if self.key else None)
        return None if limit is None else limit(mission)


def _motion_quantity(order: int, way: str, what: str, unit: str) -> Quantity:
    """The size of a velocity, an acceleration or a jerk in a direction.

    Nobody measures the jerk of a vehicle: the one that is limited is that of the slots that are tracked.
    """
    name = f"{way}_{what}".lstrip("_")
    text = f"greatest {name.replace('_', ' ')} of a {'vehicle' if order < 3 else 'slot'}"
    nothing = "" if order < 3 else "no slots are tracked"
    return Quantity(
        name, unit, f"{text}, if it is limited" if way else text, key=f"limits.{name}", order=order, way=way,
        nothing=nothing, source="" if order < 3 else "the jerk of a plan", monitored=order < 3,
        by_phase=order < 3 and not way,
    )  # fmt: skip


def _distance_beyond_geofence(mission: Any, r: Any, _: Any) -> Any:
    """Greatest distance (K, N) [m] of an agent's centre outside the geofence; negative inside, NaN without one."""
    import numpy as np  # takes long to load, and most of the command does without

    fence = mission.limits.geofence
    low, high = (np.nan, np.nan) if fence is None else (fence.min, fence.max)
    beyond = np.maximum(low - r, r - high)
    return np.maximum(np.maximum(beyond[..., 0], beyond[..., 1]), beyond[..., 2])


#: Quantities in the order in which verdicts and pages have them.
QUANTITIES: dict[str, Quantity] = {
    q.name: q
    for q in (
        Quantity(
            "separation", "m", "least distance between two vehicles' surfaces", "pair", "least", "limits.separation",
            lambda mission: mission.limits.separation_at_all_heights or 0.0, monitored=True, by_phase=True,
            words="{who} come within {worst} of each other at {when:.2f} s (limit {limit:g} m)",
            praise="agents stay {worst} apart", axis="between agents", nothing="only one agent",
        ),
        Quantity(
            "separation_flying", "m", "the same, one at limits.separation_altitude or above", "pair", "least",
            "limits.separation", lambda m: None if m.limits.separation_altitude is None else m.limits.separation,
            monitored=True, praise="{worst} in flight",
        ),
        Quantity(
            "separation_as_planned", "m", "greatest distance by which vehicles come nearer than a phase's plan proves",
            "pair", key="limits.separation_allowance", source="a plan",
        ),
        Quantity(
            "clearance", "m", "least distance of a vehicle's surface to an obstacle or the ground", "obstacle",
            "least", limit=lambda mission: 0.0 if mission.obstacles else None, monitored=True, by_phase=True,
            praise="obstacles stay {worst} away in flight", axis="to obstacles", nothing="no obstacles",
        ),
        Quantity(
            "lost", "m", "least distance of a lost vehicle to one that still flies", "pair", "least",
            limit=lambda mission: None if mission.first_loss == inf else 0.0, monitored=True,
            praise="lost vehicles stay {worst} away from the others",
        ),
        Quantity(
            "separation_below", "m", "least height between surfaces of two vehicles, one below the other", "pair",
            "least", "limits.separation_below", nothing="no agent flies below another", monitored=True,
            words="{who} fly one below the other, {worst} apart at {when:.2f} s (limit {limit:g} m)",
            axis="straight below",
        ),
        Quantity(
            "geofence", "m", "greatest distance of a vehicle's centre outside the geofence; negative inside",
            key="limits.geofence", limit=lambda m: m.limits.geofence and 0.0, measure=_distance_beyond_geofence,
            words="{who} leaves the geofence by {worst} at {when:.2f} s", monitored=True,
        ),
        *(
            Quantity(
                name, "m", f"greatest distance of a vehicle's centre beyond {words} fence; negative on the right side",
                "fence", limit=lambda m, soft=soft: None if soft or all(x.soft for x in m.fences) else 0.0,
            )
            for name, words, soft in (("fence", "a hard", False), ("soft_fence", "a soft", True))
        ),
        Quantity(
            "people", "m", "least distance from people, seen from above, at which a vehicle that fails at once falls",
            "people", "least", "limits.people", lambda m: m.limits.people if m.people else None,
            axis="falls, to people", nothing="no people",
        ),
        Quantity(
            "lowest", "m", "least altitude of a vehicle's centre", sense="least", monitored=True, checked=False,
            measure=lambda _, r, __: r[..., 2], limit=lambda m: m.limits.geofence and m.limits.geofence.min[2],
        ),
        Quantity(
            "highest", "m", "greatest altitude of a vehicle's centre", monitored=True, checked=False,
            measure=lambda _, r, __: r[..., 2], limit=lambda m: m.limits.geofence and m.limits.geofence.max[2],
        ),
        *(
            _motion_quantity(order, way, what, unit)
            for ways in (("",), ("horizontal", "vertical"))
            for order, what, unit in ((1, "speed", "m/s"), (2, "acceleration", "m/s^2"), (3, "jerk", "m/s^3"))
            for way in ways
        ),
        Quantity(
            "thrust", "N", "thrust of the vehicle that comes nearest to its limit; the greatest if none has one",
            key="agents.thrust_limit", order=2, way="thrust", source="forces", monitored=True, by_phase=True,
            praise="thrust peaks at {worst}",
        ),
        Quantity("thrust_margin", "N", "greatest thrust minus its limit", monitored=True, checked=False),
        Quantity(
            "rotor_force", "N", "force of the rotor that comes nearest to its limit",
            limit=lambda m: [v.rotor_thrust_limit for v in m.vehicle_models or ()], nothing="flown by points",
            source="forces of rotors", praise="rotors peak at {worst} of {limit}",
        ),
        Quantity(
            "saturation", "%", "greatest share of a phase in which a vehicle is asked for more than its rotors give",
            key="limits.saturation", limit=lambda m: 100.0 * m.limits.saturation, scale=100.0,
            source="forces of rotors", nothing="no vehicle is asked for more than its rotors give",
        ),
        Quantity(
            "tilt", "deg", "greatest tilt of a vehicle; of points, of the thrust that their slots need",
            key="limits.tilt_deg", order=2, way="tilt", scale=degrees(1.0), nothing="no slots are tracked",
            source="a plan or attitudes",
        ),
        Quantity(
            "tracking_error", "m", "greatest distance of a vehicle from its slot", key="limits.tracking_error",
            nothing="no slots are tracked", source="a plan", praise="vehicles stay within {worst} of their slots",
        ),
        Quantity(
            "guarantee", "m", "least distance to others or obstacles that is left if vehicles brake at once", "pair",
            "least", source="avoidance in flight",
        ),
        Quantity("clearance_guarantee", "m", "", "obstacle", "least", checked=False),
        Quantity(
            "constraint", "m", "greatest constraint error |c| = |L - d|: edge length minus reference", "edge", "size",
            source="edges", monitored=True, by_phase=True,
        ),
        Quantity(
            "constraint_force", "N", "greatest constraint force on a vehicle", source="forces of edges",
            monitored=True, by_phase=True,
        ),
        Quantity(
            "tension", "N", "tension of greatest size in an edge; negative: compression", "edge", "size",
            source="forces of edges", monitored=True, by_phase=True,
        ),
        Quantity(
            "singular_value", "", "least singular value of the constraint Jacobian", "formation", "least",
            words="smallest singular value of J {worst} at {when:.2f} s", source="a Jacobian of edges",
            by_phase=True,
        ),
    )
}  # fmt: skip
#: Those of velocity, acceleration and jerk.
MOTIONS = tuple(
    q for q in QUANTITIES.values() if q.way in ("", "horizontal", "vertical") and q.order
)
#: Keys of limits that are numbers and that curves are judged by.
LIMITS_OF_CURVES = [
    name
    for name, q in QUANTITIES.items()
    if not q.source and q.key == f"limits.{name}" and not q.limit
]
#: What limits are judged by, by their keys, that positions over time do not show.
SOURCES = {q.key.removeprefix("limits."): q.source for q in QUANTITIES.values() if q.source}


def quantity(name: str) -> Quantity:
    """The quantity of a worst value in a record: "clearance_first" is a clearance.

    What only records name, such as the share of time in which a guard acted, is a number of an agent.
    """
    if name in QUANTITIES:
        return QUANTITIES[name]
    whole = QUANTITIES.get(name.rpartition("_")[0], Quantity(name, ""))
    return replace(whole, name=name)
