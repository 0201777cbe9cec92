"""Fences, and places where people are: their keys, and their rules."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from rigidfleet.math.geodesy import enu_of
from rigidfleet.mission import bounds
from rigidfleet.mission.files import NOT_A_FILE
from rigidfleet.mission.findings import Keys
from rigidfleet.mission.rules import Breach, Breaches, Draft
from rigidfleet.mission.values import Coordinate, Flag, Longitude, Part, Place, key, required_key
from rigidfleet.solids.polygons import Region, edges_cross
from rigidfleet.typing import Floats

#: Farthest corner from the origin [m]: beyond, longitude and latitude are taken to be swapped, or the origin wrong.
_FAR = 100_000.0
#: Width of a ring that counts as none, its area over half of its length [m].
_NARROW = 1e-4
#: How far inside an area a corner of another one at least is [m], one that touches it is not; how many are looked at.
_INSIDE, _SOME = 1e-6, 8
#: Height up to which people reach [m].
_TALL = 2.0

_Ring = Annotated[tuple[Place, ...], Field(min_length=3)]
_Degrees = Annotated[tuple[Longitude, ...], Field(min_length=2, max_length=2)]
_RingInDegrees = Annotated[tuple[_Degrees, ...], Field(min_length=3)]
_Polygon = Annotated[tuple[_RingInDegrees, ...], Field(min_length=1)]


class Area(Part):
    """An area on the ground, given in metres, or in degrees as GeoJSON has it."""

    name: str = key("name; default: the kind and a number", "")
    polygon: _Ring | None = key(
        "corners [x, y] [m], in order, either way round; the last one is joined to the first"
    )
    holes: tuple[_Ring, ...] = key("polygons that are cut out, each with corners [x, y] [m]", ())
    coordinates: Annotated[tuple[_Polygon, ...], Field(min_length=1)] | None = key(
        "instead of polygon: coordinates of a GeoJSON MultiPolygon, [longitude, latitude] [deg], WGS 84: a list of "
        "polygons, each a list of rings: its border, then its holes; needs [geodetic_origin]"
    )
    file: str | None = key(
        "instead of polygon: a GeoJSON file, relative to the mission file; the result holds its coordinates"
    )
    floor: Coordinate | None = key("height of the underside [m]")
    ceiling: Coordinate | None = key("height of the upper side [m]")

    def polygons(self, origin: Any) -> list[list[Floats]]:
        """Polygons, each its border and its holes, as corners (m, 2) [m]; ``origin`` is the mission's geodetic one.

        Degrees are places on the plane that touches the Earth there.
        """
        if self.coordinates is None:
            return [[np.array(ring) for ring in (self.polygon or (), *self.holes)]]

        def ring_in_metres(ring: Any) -> Floats:
            longitude, latitude = np.array(ring).T
            longitude = np.where(longitude == -180.0, 180.0, longitude)  # one meridian
            level = np.full(len(ring), origin.altitude)
            return enu_of(np.column_stack([latitude, longitude, level]), origin.geodetic)[:, :2]

        return [[ring_in_metres(ring) for ring in rings] for rings in self.coordinates]

    def rings(self, origin: Any) -> list[Floats]:
        """Borders and holes of all polygons."""
        return [ring for polygon in self.polygons(origin) for ring in polygon]

    def region(self, origin: Any, ground: float) -> Region:
        """The area between its heights; ``ground`` [m] is where people stand."""
        return Region.of_rings(self.rings(origin), *self.height_span(ground))

    def height_span(self, ground: float) -> tuple[float, float]:
        """Floor and ceiling [m]."""
        floor = -math.inf if self.floor is None else self.floor
        return floor, math.inf if self.ceiling is None else self.ceiling


class Fence(Area):
    """A fence, which holds for the centres of vehicles, at all heights unless it has a floor or a ceiling."""

    kind: Literal["inclusion", "exclusion"] = required_key(
        "inclusion: vehicles stay inside; exclusion: they stay outside. Each fence holds by itself"
    )
    soft: Flag = key(
        "true: the inner fence, at which a pilot or an autopilot is to act: crossing it is told and fails nothing; "
        "false: the outer, hard one: crossing it fails the flight",
        False,
    )


class People(Area):
    """A place where people are: without heights, from the ground, or z = 0 without one, to two metres above it."""

    def height_span(self, ground: float) -> tuple[float, float]:
        """Floor and ceiling [m]."""
        floor = (ground if math.isfinite(ground) else 0.0) if self.floor is None else self.floor
        return floor, floor + _TALL if self.ceiling is None else self.ceiling


#: The tables, and what an entry without a name is called.
TABLES: dict[str, tuple[type[Area], str]] = {
    "fences": (Fence, "fence"),
    "people": (People, "people"),
}


def area_rules(m: Draft, area: Area, path: Keys) -> Breaches:
    """An area is given once, by corners that bound one, and has heights in order."""
    ways = [name for name in ("polygon", "coordinates", "file") if getattr(area, name) is not None]
    if area.file is not None:
        yield Breach("file", NOT_A_FILE, "load the mission from its file, or give coordinates")
    elif len(ways) != 1 and m.is_valid(path, "polygon", "coordinates"):
        problem = "is missing" if not ways else "is given together with coordinates"
        yield Breach("polygon", problem, "give one of polygon, coordinates and file", None)
    elif area.coordinates is not None and m.geodetic_origin is None:
        if m.is_valid((), "geodetic_origin"):
            remedy = "add [geodetic_origin] with latitude_deg and longitude_deg, or give metres"
            yield Breach("coordinates", "needs to know where the mission's origin is", remedy, None)
    elif ways:
        if area.holes and area.polygon is None:
            yield Breach("holes", "has no effect without polygon", "put holes into coordinates")
        if why := polygon_flaw(area.polygons(m.geodetic_origin)):
            yield Breach(ways[0], *why, None)
    terrain = any(x.kind == "heights" for x in m.obstacles)
    if isinstance(area, People) and area.floor is None and terrain:
        remedy = "give the floor and the ceiling of the terrain there, and two metres more"
        yield Breach("floor", "is missing: people stand on terrain", remedy, None)
    floor, ceiling = area.height_span(-math.inf)
    if floor > ceiling:
        yield Breach("ceiling", f"is below the floor, {floor:g} m", "give a greater height")


def polygon_flaw(polygons: Sequence[Sequence[Floats]]) -> tuple[str, str] | None:
    """What is wrong with polygons of rings (m, 2) [m], and the remedy; None if they bound an area."""
    rings = [ring for polygon in polygons for ring in polygon]
    corners = np.concatenate(rings)
    if len(corners) > bounds.CORNERS:
        return f"has {len(corners):,} corners; the maximum is {bounds.CORNERS:,}", "simplify it"
    if np.abs(corners).max() > _FAR:
        remedy = "give longitude before latitude, and check the origin"
        return f"is {np.abs(corners).max() / 1000.0:,.0f} km from the origin", remedy
    edges = Region.of_rings(rings).edges
    if (np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1) < bounds.LENGTH.least).any():
        return "has two corners in a row at one place", "give each corner once"
    if edges_cross(edges):
        return "has edges that cross", "give corners in order; join polygons that overlap or adjoin"

    if any(_mean_width(ring) < _NARROW for ring in rings):
        return "bounds no area: its corners lie on a line", "give corners around it"
    areas = [Region.of_rings([ring]) for ring in rings]
    some = [ring[:: max(1, len(ring) // _SOME)] for ring in rings]  # all are on the same side
    inside = np.array([[x.distance(r).min() < -_INSIDE for x in areas] for r in some])
    first = np.cumsum([0, *(len(polygon) for polygon in polygons)])
    # In a polygon, and not in its holes, an odd number of rings is around.
    odd = inside.sum(axis=1) % 2 == 1
    for border, after in pairwise(first.tolist()):
        if odd[border]:
            return "has a polygon inside another", "give it as a hole, or leave it out"
        if not (odd & inside[:, border])[border + 1 : after].all():
            return "has a hole outside of its polygon", "leave it out"
    return None


def _mean_width(ring: Floats) -> float:
    """The area of a ring (m, 2) over half of its length [m]."""
    (x, y), (x1, y1) = ring.T, np.roll(ring, -1, axis=0).T
    return float(abs((x * y1 - y * x1).sum()) / np.hypot(x1 - x, y1 - y).sum())
