"""Obstacles in figures: from the side, from above, and where they move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidfleet.plotting import style as st
from rigidfleet.solids.outline import Outline, displacements_at, outline
from rigidfleet.solids.records import HEIGHTS
from rigidfleet.typing import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D

    from rigidfleet.mission import Mission

#: Colour of obstacles.
COLOUR = "#9A9184"
#: Number of places at which a moving obstacle is drawn, and the opacity of the first, as a share of the last.
_PLACES, _FIRST = 5, 0.3
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
    def terrain(self) -> bool:
        """Whether it is a height map."""
        return self.grid is not None

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
        solid, surface = thing.solid, outline(thing.solid)
        if plain := thing.corners is not None and not thing.zone:
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


def _opacities(shape: DrawnObstacle) -> Floats:
    """Opacity of a shape at each of its places, as a share of the last one's."""
    n = len(shape.at)
    return np.linspace(_FIRST, 1.0, n) if n > 1 else np.ones(1)


def draw_in_space(ax: Axes3D, shape: DrawnObstacle) -> None:
    """Draw an obstacle in three dimensions: lit faces, the lines of its shape, and its way."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    colour = st.ALERT if shape.zone else COLOUR
    dashes: Any = (0, (4, 2)) if shape.zone else "-"
    faces = shape.surface.triangles
    if shape.plain:  # its sides, as seams between translucent triangles would show
        faces = np.concatenate([faces[:6], faces[6:, 2:]], axis=1)
    for at, share in zip(shape.at, _opacities(shape), strict=True):
        opacity = 0.07 if shape.zone else 0.22 if shape.plain else 0.7 if shape.terrain else 0.6
        opacity *= float(share)
        colours, zorder = _face_colours(shape, faces, colour, opacity), 0.5 if shape.terrain else 2
        look: dict[str, Any] = {"edgecolors": "none", "linewidths": 0, "antialiaseds": shape.zone}
        sides = Poly3DCollection(list(faces + at), facecolors=colours, **look, zorder=zorder)
        sides.set_gid("obstacle")
        ax.add_collection3d(sides)
        ax.add_collection3d(
            Line3DCollection(
                list(shape.surface.lines + at), colors=colour, linewidths=0.5, linestyles=dashes,
                alpha=0.9 * float(share), zorder=0.6 if shape.terrain else 2.1,
            )
        )  # fmt: skip
    if len(shape.way) > 1:
        way = shape.way + shape.surface.triangles.reshape(-1, 3).mean(axis=0)
        ax.plot(*way.T, color=colour, linewidth=1.0, linestyle=(0, (1, 1.5)), zorder=2.2)


def _face_colours(shape: DrawnObstacle, faces: Floats, colour: str, opacity: float) -> Floats:
    """Colours (T, 4) of the faces (T, 3 or more, 3) of a shape, lighter towards the light."""
    from matplotlib.colors import to_rgb

    a, b, c = faces[:, :3].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    light = 0.5 + 0.5 * normal @ np.array([-0.36, -0.48, 0.8])
    dark = (1.0 - np.array(to_rgb(colour))) * (1.25 - 0.75 * light[:, None])
    if shape.zone or shape.plain:
        return np.column_stack([np.clip(1.0 - dark, 0.0, 1.0), np.full(len(dark), opacity)])
    # Opaque in a paler colour: seams between translucent faces would show.
    return np.column_stack([np.clip(1.0 - opacity * dark, 0.0, 1.0), np.ones(len(dark))])


def draw_from_above(ax: Axes, shape: DrawnObstacle) -> None:
    """Draw an obstacle from above: its outline at each place, its way, contours of a height map, and its name."""
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.patches import Polygon

    colour = st.ALERT if shape.zone else COLOUR
    rim = convex_rim(shape.surface.triangles.reshape(-1, 3)[:, :2])
    look: dict[str, Any] = {"facecolor": colour, "linewidth": 0, "zorder": 1}
    dashed: dict[str, Any] = {"fill": False, "edgecolor": colour, "linestyle": (0, (4, 2))}
    dashed |= {"linewidth": 0.8, "zorder": 1.1}
    if shape.grid is not None:
        x, y, z = shape.grid
        low_to_high = LinearSegmentedColormap.from_list("terrain", ["#F4F1EA", COLOUR])
        ax.contourf(x, y, z.T, 8, cmap=low_to_high, alpha=0.5, zorder=0.8)
        ax.contour(x, y, z.T, 8, colors=colour, linewidths=0.4, alpha=0.8, zorder=0.9)
    for at, share in zip(shape.at, _opacities(shape), strict=True):
        opacity = 0.0 if shape.terrain else 0.3 if not shape.zone else 0.1
        patch = ax.add_patch(Polygon(rim + at[:2], **look, alpha=opacity * float(share)))
        if shape.zone:
            ax.add_patch(Polygon(rim + at[:2], **dashed, alpha=float(share)))
    if len(shape.way) > 1:
        way = shape.way[:, :2] + rim.mean(axis=0)
        ax.plot(*way.T, color=colour, linewidth=1.0, linestyle=(0, (1, 1.5)), zorder=1.2)
    x, y = rim.mean(axis=0)[0], rim[:, 1].min()
    st.name_box(ax, patch, x + shape.at[-1, 0], y + shape.at[-1, 1], shape.name)


def convex_rim(points: Floats) -> Floats:
    """Corners (C, 2) of the convex hull of points (P, 2) [m], anticlockwise, by Andrew's chains.

    To load SciPy's takes a third of the time of the figures of `run`.
    """
    # Numbers x + iy, in order of x and y; upper and lower corners are the same but for rounding.
    places = np.unique((points @ [1.0, 1.0j]).round(9)).tolist()
    rim: list[complex] = []
    for chain in places, places[::-1]:
        part: list[complex] = []
        for z in chain:
            # No corner where the way turns right, or not at all
            while (
                len(part) > 1 and ((part[-1] - part[-2]).conjugate() * (z - part[-1])).imag < 1e-9
            ):
                part.pop()
            part.append(z)
        rim += part[:-1]  # its last corner begins the other chain
    return np.array(rim).view(np.float64).reshape(-1, 2)
