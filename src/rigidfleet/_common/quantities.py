"""What is measured of a flight, once: each quantity with its unit, its words and its limit.

Verdict, check, automatic times, sweep metrics, report, safety page and figures read this table. How a quantity is
measured is a derivative of the position and a direction, or a function that the layer that measures has by its name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, Literal

#: What has one value each: an agent, two agents, an edge, an agent beside an obstacle, the formation.
Who = Literal["agent", "pair", "edge", "obstacle", "formation"]
#: Which value is the worst: the least, the greatest, or the one of the greatest size.
Sense = Literal["least", "greatest", "size"]


@dataclass(frozen=True, slots=True, kw_only=True)
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
    order, way : the derivative of the position that it is of (1: velocity), and what of it: its size in all directions
        (""), "horizontal" or "vertical", or a quantity of the force that it needs; order 0: it is no such quantity
    scale : factor from values in records to `unit`
    words : about the worst value; "" for "greatest speed 3 m/s, agent 1, at 2.00 s (limit 4 m/s)"
    nothing : words if there is nothing to judge; "" for "the flight has no speed to judge"
    monitored : whether the kernel's monitor finds it in continuous time
    by_phase : whether a verdict has its worst value for each phase
    metric, page : whether it is a metric of sweeps, and a row of the safety page
    """

    name: str
    unit: str
    text: str
    who: Who = "agent"
    sense: Sense = "greatest"
    key: str = ""
    limit: Callable[[Any], Any] | None = None
    order: int = 0
    way: str = ""
    scale: float = 1.0
    words: str = ""
    nothing: str = ""
    monitored: bool = True
    by_phase: bool = False
    metric: bool = True
    page: bool = True

    @property
    def called(self) -> str:
        """Its name in words."""
        return self.name.replace("_", " ")

    @property
    def at_least(self) -> bool:
        """Whether a limit is the least value allowed, not the greatest."""
        return self.sense == "least"

    def rank(self, values: Any) -> Any:
        """Numbers that are greater the worse values are."""
        return -values if self.at_least else abs(values) if self.sense == "size" else values

    def limit_of(self, mission: Any) -> Any:
        """The limit that a mission sets, in `unit`, or those of the agents; None if it sets none."""
        limit = self.limit or (attrgetter(self.key) if self.key else None)
        return None if limit is None else limit(mission)


def _motions() -> list[Quantity]:
    """Sizes of velocity, acceleration and jerk: in all directions, over the ground, and up and down.

    What a vehicle's jerk is nobody measures: the one that is limited is that of the slots it tracks.
    """
    found = []
    for order, (what, unit, of) in enumerate(
        (
            ("speed", "m/s", "a vehicle"),
            ("acceleration", "m/s^2", "a vehicle"),
            ("jerk", "m/s^3", "a slot that is tracked"),
        ),
        start=1,
    ):
        for way in ("", "horizontal", "vertical"):
            name = f"{way}_{what}".lstrip("_")
            found.append(
                Quantity(
                    name=name, unit=unit, order=order, way=way, key=f"limits.{name}", monitored=order < 3,
                    text=f"greatest {name.replace('_', ' ')} of {of}{', if it has a limit' if way else ''}",
                    by_phase=order < 3 and not way, nothing="no slots are tracked" if order == 3 else "",
                )
            )  # fmt: skip
    return sorted(found, key=lambda q: bool(q.way))


#: Quantities in the order in which verdicts and pages have them.
QUANTITIES: dict[str, Quantity] = {
    q.name: q
    for q in (
        Quantity(
            name="separation", unit="m", who="pair", sense="least", key="limits.separation", by_phase=True,
            limit=lambda mission: mission.limits.separation_always or 0.0,
            text="least distance between two vehicles' surfaces",
            words="{who} come within {worst} of each other at {when:.2f} s (limit {limit:g} m)",
        ),
        Quantity(
            name="separation_flying", unit="m", who="pair", sense="least", key="limits.separation",
            limit=lambda m: None if m.limits.separation_altitude is None else m.limits.separation,
            text="the same, one at limits.separation_altitude or above",
        ),
        Quantity(
            name="separation_as_planned", unit="m", who="pair", key="limits.separation_allowance", monitored=False,
            text="greatest distance by which two vehicles come nearer than the plan of the phase proves",
        ),
        Quantity(
            name="clearance", unit="m", who="obstacle", sense="least", by_phase=True,
            limit=lambda mission: 0.0 if mission.obstacles else None,
            text="least distance of a vehicle's surface to an obstacle or the ground",
        ),
        Quantity(
            name="lost", unit="m", who="pair", sense="least", limit=lambda _: 0.0, metric=False, page=False,
            text="least distance of a lost vehicle to one that still flies",
        ),
        Quantity(
            name="separation_below", unit="m", who="pair", sense="least", key="limits.separation_below",
            text="least height between surfaces of two vehicles, one below the other",
            words="{who} fly one below the other, {worst} apart at {when:.2f} s (limit {limit:g} m)",
            nothing="no agent flies below another",
        ),
        Quantity(
            name="geofence", unit="m", key="limits.geofence",
            limit=lambda mission: None if mission.limits.geofence is None else 0.0,
            text="greatest distance of a vehicle's centre outside the geofence; negative inside",
        ),
        Quantity(
            name="lowest", unit="m", sense="least", metric=False, text="least altitude of a vehicle's centre",
            limit=lambda m: None if m.limits.geofence is None else m.limits.geofence.min[2],
        ),
        Quantity(
            name="highest", unit="m", metric=False, text="greatest altitude of a vehicle's centre",
            limit=lambda m: None if m.limits.geofence is None else m.limits.geofence.max[2],
        ),
        *_motions(),
        Quantity(
            name="corner", unit="m/s", monitored=False, metric=False, page=False,
            text="greatest jump of a velocity where a curve that others made turns at once",
        ),
        Quantity(
            name="thrust", unit="N", key="agents.thrust_limit", order=2, way="thrust", by_phase=True,
            text="thrust of the vehicle that comes nearest to its limit; the greatest if none has one",
        ),
        Quantity(
            name="thrust_margin", unit="N", metric=False, page=False, text="greatest thrust minus its limit",
        ),
        Quantity(
            name="rotor_force", unit="N", metric=False, monitored=False,
            text="force of the rotor that comes nearest to its limit",
            limit=lambda m: [v.rotor_limit for v in m.vehicle_models or ()], nothing="flown by points",
        ),
        Quantity(
            name="saturation", unit="%", key="limits.saturation", scale=100.0, monitored=False,
            limit=lambda mission: 100.0 * mission.limits.saturation,
            text="greatest share of a phase in which a vehicle is asked for more than its rotors give",
            nothing="no vehicle is asked for more than its rotors give",
        ),
        Quantity(
            name="tilt", unit="deg", key="limits.tilt_deg", order=2, way="tilt", monitored=False,
            scale=57.29577951308232, text="greatest tilt of a vehicle", nothing="no slots are tracked",
        ),
        Quantity(
            name="tracking_error", unit="m", key="limits.tracking_error", monitored=False,
            text="greatest distance of a vehicle from its slot", nothing="no slots are tracked",
        ),
        Quantity(
            name="guarantee", unit="m", who="pair", sense="least", limit=lambda _: 0.0, monitored=False,
            metric=False, page=False, text="least distance that is left if vehicles brake at once",
        ),
        Quantity(
            name="clearance_guarantee", unit="m", who="obstacle", sense="least", limit=lambda _: 0.0, monitored=False,
            metric=False, page=False, text="least distance to an obstacle that is left if a vehicle brakes at once",
        ),
        Quantity(
            name="constraint", unit="m", who="edge", by_phase=True, page=False, sense="size",
            text="greatest constraint error |c| = |L - d|: edge length minus reference",
        ),
        Quantity(
            name="constraint_force", unit="N", by_phase=True, page=False,
            text="greatest constraint force on a vehicle",
        ),
        Quantity(
            name="tension", unit="N", who="edge", sense="size", by_phase=True, page=False,
            text="tension of greatest size in an edge; negative: compression",
        ),
        Quantity(
            name="singular_value", unit="", who="formation", sense="least", by_phase=True, page=False,
            monitored=False, text="least singular value of the constraint Jacobian",
            words="smallest singular value of J {worst} at {when:.2f} s",
        ),
    )
}  # fmt: skip
#: Those of velocity, acceleration and jerk.
MOTIONS = tuple(
    q for q in QUANTITIES.values() if q.way in ("", "horizontal", "vertical") and q.order
)


def shown(unit: str) -> str:
    """A unit as pages and figures show it: m/s² for m/s^2."""
    return unit.replace("^2", "²").replace("^3", "³")


def quantity(name: str) -> Quantity:
    """The quantity of a worst value in a record: "clearance_first" is a clearance.

    What only records name, such as the share of time in which a guard acted, is a number of an agent.
    """
    if name in QUANTITIES:
        return QUANTITIES[name]
    whole = QUANTITIES.get(name.rpartition("_")[0], Quantity(name=name, unit="", text=""))
    return replace(whole, name=name)
