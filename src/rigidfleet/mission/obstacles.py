"""Obstacles of a mission: their keys, their solids, and checks that no single key decides."""

import math
from abc import abstractmethod
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from rigidfleet.math.attitude import dcm_from_euler
from rigidfleet.mission import bounds, values
from rigidfleet.mission.files import FILL, NOT_A_FILE, missing_cells_text
from rigidfleet.mission.findings import FindingCollector, Keys
from rigidfleet.mission.rules import Breach, Breaches
from rigidfleet.mission.values import Part, key, models_by_kind, required_key
from rigidfleet.solids import records
from rigidfleet.solids.records import Form, Solids

#: Time to which a constant velocity is continued [s].
_EVER = bounds.TIME.most


class Solid(Part):
    """An obstacle, which is a solid shape; distances to it are those of `rigidfleet.solids`."""

    name: str = key("name; default: the kind and a number", "")
    zone: values.Flag = key(
        "true: a no-fly zone; judged as an obstacle, and drawn as a zone", False
    )

    @property
    @abstractmethod
    def solid_at_rest(self) -> Form:
        """The shape, where its keys place it."""

    @property
    def box_bounds(self) -> tuple[float, ...] | None:
        """Lowest and highest corner (6,) [m] of a box along the world's axes at rest; None for all others."""
        return None

    @cached_property
    def solid(self) -> Solids:
        """The obstacle as arrays.

        Raises
        ------
        ValueError
            The points of a hull lie in a plane.
        """
        return records.one_solid(self.solid_at_rest)


class Moving(Solid):
    """An obstacle that may move, without turning."""

    velocity: values.Velocity | None = key("constant velocity [m/s], from the start of the mission")
    waypoints: tuple[values.Vector, ...] | None = key(
        "places of the obstacle's centre [x, y, z] [m] at `times`: straight between them at constant "
        "speed, at rest before the first and after the last"
    )
    times: tuple[values.Seconds, ...] | None = key("mission times of the waypoints [s], increasing")
    appears: values.Seconds | None = key(
        "mission time from which the obstacle is there [s]; default: from the start"
    )
    vanishes: values.Seconds | None = key(
        "mission time until which it is there [s]; default: to the end"
    )

    @property
    def moves_and_times(self) -> tuple[Any, Any]:
        """Displacements (W, 3) [m] and their times (W,) [s]; empty if the obstacle does not move."""
        if self.velocity is not None and any(self.velocity):
            return np.outer([0.0, _EVER], self.velocity), np.array([0.0, _EVER])
        if self.waypoints is None:
            still = np.isfinite(self.lifetime).any()  # one that appears counts as one that moves
            return (np.zeros((1, 3)), np.zeros(1)) if still else ((), ())
        return np.array(self.waypoints) - self.undisplaced_centre, np.array(self.times)

    @property
    def lifetime(self) -> tuple[float, float]:
        """Times from which and until which the obstacle is there [s]."""
        since, until = self.appears, self.vanishes
        return -math.inf if since is None else since, math.inf if until is None else until

    @cached_property
    def solid(self) -> Solids:
        """The obstacle as arrays, with its motion."""
        ways, times = self.moves_and_times
        return records.one_solid(self.solid_at_rest, times, ways, self.lifetime)

    @property
    def undisplaced_centre(self) -> Any:
        """The centre (3,) [m] that waypoints lead: where the other keys place the obstacle."""
        return self.solid_at_rest.origin


class Box(Moving):
    """A box, parallel to the world axes or turned."""

    kind: Literal["box"] = required_key("a box, parallel to the world axes unless turned")
    min: values.Vector = required_key("lowest corner [x, y, z] [m], before turning")
    max: values.Vector = required_key("highest corner [x, y, z] [m], before turning")
    roll_deg: values.Angle = key("roll [deg] about the box's centre, 3-2-1 Euler angles", 0.0)
    pitch_deg: values.Angle = key("pitch [deg]", 0.0)
    yaw_deg: values.Angle = key("yaw [deg]", 0.0)

    @property
    def box_bounds(self) -> tuple[float, ...] | None:
        """Lowest and highest corner (6,) [m]; None if the box is turned or moves."""
        if self.is_turned or self.solid.moves:
            return None
        return (*self.min, *self.max)

    @property
    def is_turned(self) -> bool:
        """Whether the box is not parallel to the world axes."""
        return bool(self.roll_deg or self.pitch_deg or self.yaw_deg)

    @property
    def solid_at_rest(self) -> Form:
        """The box, turned by its angles if it `is_turned`."""
        angles = np.deg2rad([self.roll_deg, self.pitch_deg, self.yaw_deg])
        return records.box(self.min, self.max, dcm_from_euler(angles) if self.is_turned else None)

    @property
    def undisplaced_centre(self) -> Any:
        """The box's centre (3,) [m], which is no origin of axes unless the box is turned."""
        return (np.array(self.min) + np.array(self.max)) / 2


class Sphere(Moving):
    """A sphere."""

    kind: Literal["sphere"] = required_key("a sphere")
    centre: values.Vector = key("centre [x, y, z] [m]", (0.0, 0.0, 0.0))
    radius: values.Length = required_key("radius [m]")

    @property
    def solid_at_rest(self) -> Form:
        """The ball."""
        return records.ball(self.centre, self.radius)


class Cylinder(Moving):
    """A cylinder along any axis."""

    kind: Literal["cylinder"] = required_key("a cylinder along any axis, with flat ends")
    ends: Annotated[tuple[values.Vector, ...], Field(min_length=2, max_length=2)] = required_key(
        "centres of the two ends, [[x, y, z], [x, y, z]] [m]"
    )
    radius: values.Length = required_key("radius [m]")

    @property
    def solid_at_rest(self) -> Form:
        """The cylinder."""
        return records.cylinder(self.ends, self.radius)


class Hull(Moving):
    """The convex hull of points."""

    kind: Literal["hull"] = required_key("the convex hull of points; its centre is their mean")
    points: Annotated[tuple[values.Vector, ...], Field(min_length=4, max_length=bounds.HULL)] = (
        required_key("points [x, y, z] [m], four or more, not all in a plane")
    )

    @property
    def solid_at_rest(self) -> Form:
        """The hull."""
        return records.hull(self.points)


class Heights(Solid):
    """A height map: terrain over a rectangle."""

    kind: Literal["heights"] = required_key(
        "everything between a surface of given heights and a base, over a rectangle"
    )
    corner: values.Place = key("place [x, y] [m] of the first height", (0.0, 0.0))
    spacing: values.Length = required_key("distance between neighbouring heights along x and y [m]")
    heights: tuple[tuple[values.Coordinate, ...], ...] | None = key(
        "heights [m]: a list for each x, in which y increases; each square between four heights is two "
        "triangles, divided from its lowest x and y to its highest"
    )
    file: str | None = key(
        "instead of heights: a CSV or NPY file with them, relative to the mission file; the result holds "
        "the heights themselves"
    )
    base: values.Coordinate | None = key(
        "height of the underside [m]; default: as far below the lowest height as the map is wide"
    )

    @property
    def solid_at_rest(self) -> Form:
        """The height map."""
        heights, step = np.array(self.heights), np.full(2, self.spacing)
        wide = self.spacing * (max(heights.shape) - 1)
        base = float(heights.min()) - wide if self.base is None else self.base
        return records.height_map(self.corner, step, heights, base)


class Ground(Part):
    """Everything below a height."""

    #: A ground is no zone.
    zone: ClassVar[bool] = False

    kind: Literal["ground"] = required_key("everything below a height")
    name: str = key("name; default: 'ground'", "")
    height: values.Coordinate = key("height of the ground [m]", 0.0)

    @property
    def box_bounds(self) -> tuple[float, ...] | None:
        """Lowest and highest corner (6,) [m] of a box that is infinite except at the top."""
        return (*(-math.inf,) * 3, math.inf, math.inf, self.height)

    @cached_property
    def solid(self) -> Solids:
        """The ground as arrays."""
        return records.one_solid(records.half_space(self.height))


Obstacle = Annotated[Box | Ground | Sphere | Cylinder | Hull | Heights, Field(discriminator="kind")]
OBSTACLE_KINDS: dict[str, type[Part]] = models_by_kind(Obstacle)


def is_ground(thing: Obstacle) -> bool:
    """Whether an obstacle counts as ground: a ground, and terrain and boxes that are no zones and at rest."""
    firm = isinstance(thing, Heights | Box) and not thing.zone and not thing.solid.moves
    return firm or isinstance(thing, Ground)


def obstacle_rules(m: FindingCollector, thing: Any, path: Keys) -> Breaches:
    """What an obstacle at a path needs besides its keys."""
    if isinstance(thing, Heights):
        yield from _height_map_rules(m, thing, path)
    elif isinstance(thing, Moving):
        yield from _motion_rules(m, thing, path)
    if isinstance(thing, Cylinder) and math.dist(*thing.ends) < bounds.LENGTH.least:
        yield Breach("ends", "has both ends at the same place", "give the centres of its two ends")
    if isinstance(thing, Hull) and m.is_valid(path, "points", "waypoints", "times"):
        try:
            thing.solid  # noqa: B018
        except ValueError as error:
            remedy = "add points beside the plane, or use a thin box"
            yield Breach("points", str(error), remedy, None)


def _motion_rules(m: FindingCollector, thing: Moving, path: Keys) -> Breaches:
    """An obstacle appears before it vanishes, and has a time for each waypoint."""
    ways, times = thing.waypoints, thing.times
    if not thing.lifetime[0] < thing.lifetime[1]:
        problem = f"is not after {thing.lifetime[0]:g} s, when the obstacle appears"
        yield Breach("vanishes", problem, "let it vanish after it has appeared")
    elif thing.velocity is not None and ways is not None:
        yield Breach("velocity", "has no effect with waypoints", "remove one of them")
    elif ways is None or times is None:
        for one, other in ("waypoints", "times"), ("times", "waypoints"):
            if getattr(thing, one) is not None and m.is_valid(path, other):
                yield Breach(other, f"is missing: {one} need it", f"add {other}")
    elif len(ways) != len(times) or len(ways) < 2:
        problem = f"has {len(times)} entries for {len(ways)} waypoints"
        yield Breach("times", problem, "give one time for each waypoint, two or more", None)
    elif min(b - a for a, b in pairwise(times)) < bounds.TIME.least:
        yield Breach("times", "must increase", "order the waypoints by time")


def _height_map_rules(m: FindingCollector, thing: Heights, path: Keys) -> Breaches:
    """A height map has heights, on a grid, above its base."""
    if thing.file is not None:
        yield Breach("file", NOT_A_FILE, "load the mission from its file, or give heights")
        return
    if thing.heights is None:
        yield Breach("heights", "is missing", "add heights, or a file with them")
        return
    rows = {len(row) for row in thing.heights}
    count = len(thing.heights) * max(rows, default=0)
    if len(rows) > 1 or len(thing.heights) < 2 or min(rows) < 2:
        problem = f"has rows of {min(rows, default=0)} to {max(rows, default=0)} heights, {len(thing.heights)} of them"
        remedy = "give two rows or more, all of the same length, two or more"
        yield Breach("heights", problem, remedy, None)
    elif why := missing_cells_text(thing.heights):
        yield Breach("heights", why, FILL, None)
    elif count > bounds.HEIGHTS:
        problem = f"has {count:,} heights; the maximum is {bounds.HEIGHTS:,}"
        yield Breach("heights", problem, "use a coarser grid", None)
    elif thing.base is not None and thing.base > (lowest := min(map(min, thing.heights))):
        problem = f"lies above the lowest height, {lowest:g} m"
        yield Breach("base", problem, "give a base at or below all heights")
