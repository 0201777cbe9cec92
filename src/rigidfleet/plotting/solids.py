"""Obstacles in figures: from the side, from above, and where they move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.plotting import style as st
from rigidfleet.solids.outline import Outline, displacements_at, outline_of_solid
from rigidfleet.solids.records import HEIGHTS
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.path import Path
    from mpl_toolkits.mplot3d import Axes3D

    from rigidfleet.mission import Mission

#: Colour of obstacles.
COLOUR = "#9A9184"
#: Number of places at which a moving obstacle is drawn, and the opacity of the first, as a share of the last.
_PLACES, _FIRST = 5, 0.3
#: Where the light comes from: clockwise from the north, and above the ground [deg].
_FROM, _ABOVE = 215.0, 50.0
#: Number of points of the way of a moving obstacle.
_WAY = 200


@dataclass(frozen=True)
class DrawnObstacle:
    """An obstacle to draw."""

    name: str
    zone: bool
    plain: bool  # whether it is a box along the axes, which is seen through
    surface: Outline  # without motion
    at: Floats  # (M, 3) displacements at which it is drawn, in order of time [m]
    way: Floats  # (W, 3) displacements over the flight [m]
    grid: tuple[Floats, Floats, Floats] | None  # x, y and heights of a height map

    @property
    def extent(self) -> Floats:
        """Lowest and highest corner (2, 3) [m] of all places at which it is drawn."""
        points = self.surface.triangles.reshape(-1, 3)
        return np.array([f(points, axis=0) + f(self.at, axis=0) for f in (np.min, np.max)])


def drawn_obstacles(
    mission: Mission, begin: float, end: float, low: Floats, high: Floats
) -> list[DrawnObstacle]:
    """Obstacles over a time [s], as far as they come near the space from low to high (3,), where boxes are cut."""
    near_obstacles = []
    for thing in mission.solids:
        solid, surface = thing.solid, outline_of_solid(thing.solid)
        if plain := thing.box_bounds is not None and not thing.zone:
            surface = Outline(*(np.clip(x, low, high) for x in surface))
        at = way = np.zeros((1, 3))
        if solid.moves:
            since, until = np.clip(solid.there[0], begin, end)
            if solid.there[0, 0] > end or solid.there[0, 1] < begin:
                continue
            first, last = np.clip(solid.times[[0, -1]], since, until)
            at = displacements_at(solid, np.linspace(first, last, _PLACES))
            way = displacements_at(solid, np.linspace(since, until, _WAY))
        grid = None
        if solid.kind[0] == HEIGHTS:
            (a, b), (wide, deep), (n, m) = solid.origin[0, :2], solid.size[0, 3:5], solid.grid[0]
            x, y = a + np.linspace(0.0, wide, n), b + np.linspace(0.0, deep, m)
            grid = x, y, solid.heights.reshape(n, m)
        shape = DrawnObstacle(thing.name, thing.zone, plain, surface, at, way, grid)
        if ((shape.extent[1] > low) & (shape.extent[0] < high)).all():
            near_obstacles.append(shape)
    return near_obstacles


def _place_opacities(shape: DrawnObstacle) -> Floats:
    """Opacity of a shape at each of its places, as a share of the last one's."""
    n = len(shape.at)
    return np.linspace(_FIRST, 1.0, n) if n > 1 else np.ones(1)


def draw_obstacle_in_space(ax: Axes3D, shape: DrawnObstacle) -> None:
    """Draw an obstacle in three dimensions: lit faces, the lines of its shape, and its way."""
    from matplotlib.colors import LightSource, to_rgb, to_rgba
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    colour = st.ALERT if shape.zone else COLOUR
    dashes: Any = (0, (4, 2)) if shape.zone else "-"
    faces = shape.surface.triangles
    if shape.plain:  # its sides, as seams between translucent triangles would show
        faces = np.concatenate([faces[:6], faces[6:, 2:]], axis=1)
    for at, share in zip(shape.at, _place_opacities(shape), strict=True):
        opacity = 0.07 if shape.zone else 0.2 if shape.plain else 0.25
        opacity *= float(share)
        paint = to_rgba(colour, opacity)
        if not (shape.zone or shape.plain):
            # Opaque in a paler colour: seams between translucent faces would show.
            paint = tuple(1.0 - opacity * (1.0 - np.array(to_rgb(colour))))
        look: dict[str, Any] = {"linewidths": 0, "antialiaseds": shape.zone}
        look |= {"shade": True, "lightsource": LightSource(_FROM, _ABOVE)}
        zorder = 0.5 if shape.grid else 2
        sides = Poly3DCollection(faces + at, facecolors=[paint], **look, zorder=zorder)
        sides.set_gid("obstacle")
        ax.add_collection3d(sides)
        ax.add_collection3d(
            Line3DCollection(
                list(shape.surface.lines + at), colors=colour, linewidths=0.5, linestyles=dashes,
                alpha=0.9 * float(share), zorder=0.6 if shape.grid else 2.1,
            )
        )  # fmt: skip
    if len(shape.way) > 1:
        way = shape.way + shape.surface.triangles.reshape(-1, 3).mean(axis=0)
        ax.plot(*way.T, color=colour, linewidth=1.0, linestyle=(0, (1, 1.5)), zorder=2.2)


def area_from_above(triangles: Floats) -> Path:
    """The area that triangles (T, 3, 3) [m] cover as they are seen from above."""
    from matplotlib.path import Path

    a, b, c = (flat := triangles[..., :2]).swapaxes(0, 1)
    below = np.linalg.det(np.stack([b - a, c - a], axis=1)) < 0.0
    # All turn left, so that none cuts another out.
    flat = np.where(below[:, None, None], flat[:, ::-1], flat)
    codes = np.tile([Path.MOVETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY], len(flat))
    return Path(flat[:, [0, 1, 2, 0]].reshape(-1, 2), codes)


def draw_obstacle_from_above(ax: Axes, shape: DrawnObstacle) -> None:
    """Draw an obstacle from above: its outline at each place, its way, contours of a height map, and its name."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    colour = st.ALERT if shape.zone else COLOUR
    points = shape.surface.triangles.reshape(-1, 3)[:, :2]
    look: dict[str, Any] = {"facecolor": colour, "linewidth": 0, "zorder": 1}
    dashed: dict[str, Any] = {"colors": colour, "linestyles": [(0, (4, 2))], "linewidths": 0.8}
    if shape.grid:
        x, y, z = shape.grid
        low_to_high = LinearSegmentedColormap.from_list("terrain", ["#F4F1EA", COLOUR])
        ax.contourf(x, y, z.T, 8, cmap=low_to_high, alpha=0.5, zorder=0.8)
        ax.contour(x, y, z.T, 8, colors=colour, linewidths=0.4, alpha=0.8, zorder=0.9)
    # A corner shows how wide it is: to measure its area takes matplotlib a second for 29,000 triangles.
    low, high = points.min(axis=0), points.max(axis=0)
    corner = np.array([low, [high[0], low[1]], high])
    for at, share in zip(shape.at, _place_opacities(shape), strict=True):
        extent = ax.add_patch(PathPatch(Path(corner + at[:2]), visible=False))
        if not shape.grid:
            opacity = (0.1 if shape.zone else 0.3) * float(share)
            area = area_from_above(shape.surface.triangles + at)
            ax.add_artist(PathPatch(area, **look, alpha=opacity))
        if shape.zone:
            lines = list((shape.surface.lines + at)[..., :2])
            ax.add_collection(LineCollection(lines, **dashed, alpha=float(share), zorder=1.1))
    if len(shape.way) > 1:
        way = shape.way[:, :2] + points.mean(axis=0)
        ax.plot(*way.T, color=colour, linewidth=1.0, linestyle=(0, (1, 1.5)), zorder=1.2)
    x, y = (points[:, 0].min() + points[:, 0].max()) / 2, points[:, 1].min()
    st.name_box(ax, extent, x + shape.at[-1, 0], y + shape.at[-1, 1], shape.name)
