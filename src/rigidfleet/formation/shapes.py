"""Shapes, edges and the distances between them: what a formation is before it flies.

Agents count from 0 here; a shape is an (N, 3) array of *slots* [m] in the body frame, one per
agent, with its geometric centre at the origin. Distances alone determine neither handedness nor attitude;
slots do.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rigidfleet.math.proximity import nearest
from rigidfleet.math.rigid_body import centred
from rigidfleet.typing import Floats


def _line(spacing: Floats, n: int) -> Floats:
    x = spacing[0] * np.arange(n)
    return np.column_stack([x, 0 * x, 0 * x])


def _triangle(size: Floats, n: int) -> Floats:
    # The paper's attachment: x towards agent 3, y along r1 - r2.
    a, h = size[0], size[0] * np.sqrt(3) / 2
    return np.array([[0, a / 2, 0], [0, -a / 2, 0], [h, 0, 0]])


def _polygon(size: Floats, n: int) -> Floats:
    return _rings((n, size[0] / (2 * np.sin(np.pi / n)), 0, 0))


def _cuboid(size: Floats, n: int) -> Floats:
    base = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    return np.vstack([base, base + [0, 0, 1]]) * size


def _square(size: Floats, n: int) -> Floats:
    return _cuboid(size, 8)[:4]


def _pyramid(size: Floats, n: int) -> Floats:
    base = _polygon(size, n - 1) if n != 5 else _square(size, 4) - size * [0.5, 0.5, 0]
    height = np.sqrt(size[0] ** 2 - base[0] @ base[0])
    return np.vstack([base, [0, 0, height]])


def _v(size: Floats, n: int) -> Floats:
    # Wings at 45 degrees: 0, then left, right, left, ... in ranks behind the leader.
    rank, side = (np.arange(n) + 1) // 2, np.where(np.arange(n) % 2, 1.0, -1.0)
    step = size[0] / np.sqrt(2) * rank
    return np.column_stack([-step, side * step, 0 * step])


def _grid(spacing: Floats, n: int) -> Floats:
    row, column = np.divmod(np.arange(n), int(np.ceil(np.sqrt(n))))
    return spacing[0] * np.column_stack([column, row, 0 * row])


def _sphere(spacing: Floats, n: int) -> Floats:
    # Fibonacci's spiral: equal areas in height, the golden angle around.
    z = (2 * np.arange(n) + 1) / n - 1
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    across = np.sqrt(1 - z**2)
    p = np.column_stack([across * np.cos(angle), across * np.sin(angle), z])
    return p * spacing[0] / nearest(p).min()


def _two_spheres(spacing: Floats, n: int) -> Floats:
    """Two concentric spheres, the outer one first; their distance is that of neighbours on each sphere."""

    def sphere_radius(count: int) -> float:
        return float(np.linalg.norm(_sphere(spacing, count)[0]))

    def gap_between_shells(outer_count: int) -> float:
        return sphere_radius(outer_count) - sphere_radius(n - outer_count)

    numbers = range(n // 2 + 1, n - 3)  # of agents of the outer sphere
    outer = n // 2 + 1 + bisect_left(numbers, spacing[0], key=gap_between_shells)
    if outer not in numbers:
        raise ValueError(f"{n} agents are too few for a sphere inside a sphere")
    return np.concatenate([_sphere(spacing, outer), _sphere(spacing, n - outer)])


def _helix(size: Floats, n: int) -> Floats:
    radius, rise, spacing = size

    def helix_chord(angle: float) -> float:
        return float(np.hypot(2 * radius * np.sin(angle / 2), rise * angle / (2 * np.pi)))

    low, high = 0.0, np.pi
    if spacing > helix_chord(high):
        raise ValueError(
            f"a helix of radius {radius:g} m that rises {rise:g} m per turn allows a distance between neighbours of "
            f"at most {helix_chord(high):.4g} m (half a turn), not {spacing:g}"
        )
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if helix_chord(middle) < spacing else (low, middle)
    angle = high * np.arange(n)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    return np.column_stack([x, y, rise * angle / 2 / np.pi])


def _rings(*rings: tuple[int, float, float, float]) -> Floats:
    """Rings (count, radius, height, angle of the first), each counter-clockwise, one after the other."""
    points = []
    for count, radius, height, first in rings:
        angle = first + 2 * np.pi * np.arange(count) / count
        points += [radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)]
    return np.column_stack([np.concatenate(points[axis::3]) for axis in range(3)])


def _octahedron(size: Floats, n: int) -> Floats:
    r = size[0] / np.sqrt(2)
    return _rings((1, 0, -r, 0), (4, r, 0, 0), (1, 0, r, 0))


def _icosahedron(size: Floats, n: int) -> Floats:
    # Circumradius R; two rings of five at heights -+ R / sqrt 5, the upper one rotated by half a step.
    R = size[0] * np.sqrt((5 + np.sqrt(5)) / 8)
    ring, height = 2 * R / np.sqrt(5), R / np.sqrt(5)
    return _rings((1, 0, -R, 0), (5, ring, -height, 0), (5, ring, height, np.pi / 5), (1, 0, R, 0))


def _dodecahedron(size: Floats, n: int) -> Floats:
    golden = (1 + np.sqrt(5)) / 2
    outer = size[0] / (2 * np.sin(np.pi / 5))
    # Face at the top and bottom; between them two rings, golden times as wide.
    top = size[0] / 2 * np.sqrt((25 + 11 * np.sqrt(5)) / 10)
    low = top - size[0] * np.sqrt(1 - (outer * (golden - 1) / size[0]) ** 2)
    wide, half = golden * outer, np.pi / 5
    return _rings(
        (5, outer, -top, 0), (5, wide, -low, 0), (5, wide, low, half), (5, outer, top, half)
    )


class Shape(NamedTuple):
    """A named shape: its numbers of agents, its number of sizes, and its description."""

    agents: range
    sizes: int
    make: Callable[[Floats, int], Floats]
    text: str


_ANY = 1 << 30
SHAPES: dict[str, Shape] = {
    "line": Shape(range(1, _ANY), 1, _line, "along x, `size` apart, in the order of the agents"),
    "triangle": Shape(range(3, 4), 1, _triangle, "equilateral; x towards agent 3, y along r1 - r2"),
    "square": Shape(range(4, 5), 1, _square, "1-4 counter-clockwise from (-, -)"),
    "polygon": Shape(range(3, _ANY), 1, _polygon, "regular, counter-clockwise, agent 1 on x"),
    "hexagon": Shape(range(6, 7), 1, _polygon, "regular, counter-clockwise, agent 1 on x"),
    "pyramid": Shape(
        range(4, 7), 1, _pyramid, "all edges equal; the base counter-clockwise, the apex last"
    ),
    "cube": Shape(
        range(8, 9), 1, _cuboid, "1-4 counter-clockwise from (-, -, -) below, 5-8 above them"
    ),
    "cuboid": Shape(range(8, 9), 3, _cuboid, "as the cube, with three edge lengths [x, y, z]"),
    "v": Shape(
        range(3, _ANY), 1, _v, "flying along x, wings at 45°: agent 1 leads, then left, right, ..."
    ),
    "grid": Shape(
        range(4, _ANY), 1, _grid, "rows along x, as near to square as can be, then rows along y"
    ),
    "sphere": Shape(
        range(4, _ANY), 1, _sphere, "Fibonacci spiral from below; `size` is the least distance"
    ),
    "shells": Shape(
        range(40, _ANY),
        1,
        _two_spheres,
        "a sphere and, `size` below it, a second one within; each as `sphere`, the outer first",
    ),
    "helix": Shape(
        range(3, _ANY),
        3,
        _helix,
        "round z, rising; sizes [radius, rise per turn, neighbours' distance]",
    ),
    "tetrahedron": Shape(range(4, 5), 1, _pyramid, "1-3 counter-clockwise below, 4 above"),
    "octahedron": Shape(
        range(6, 7), 1, _octahedron, "1 below, 2-5 counter-clockwise from x, 6 above"
    ),
    "icosahedron": Shape(
        range(12, 13), 1, _icosahedron, "1 below, rings 2-6 and 7-11 counter-clockwise, 12 above"
    ),
    "dodecahedron": Shape(
        range(20, 21), 1, _dodecahedron, "rings 1-5, 6-10, 11-15, 16-20 upwards, counter-clockwise"
    ),
}


#: Polygons by name, with their numbers of agents.
POLYGONS = {
    "pentagon": 5, "heptagon": 7, "octagon": 8, "nonagon": 9, "decagon": 10, "hendecagon": 11, "dodecagon": 12,
}  # fmt: skip


def slots(shape: str, size: float | Sequence[float], n: int) -> Floats:
    """Slots of a named shape of `n` agents, geometric centre at 0.

    Parameters
    ----------
    shape : a key of `SHAPES`
    size : edge length [m]; three of them for a cuboid, or the helix's radius, rise per turn and distance
    n : number of agents

    Returns
    -------
    (n, 3) slots [m]

    Raises
    ------
    ValueError
        The shape is unknown, takes another number of agents or sizes, or a size is not positive.
    """
    if shape not in SHAPES:
        raise ValueError(f"unknown shape {shape!r}; known: {', '.join(SHAPES)}")
    form = SHAPES[shape]
    sizes = np.atleast_1d(np.asarray(size, dtype=np.float64))
    if n not in form.agents:
        raise ValueError(f"shape {shape!r} takes {agents_taken(shape)}, not {n}")
    if sizes.shape != (form.sizes,):
        names = "[radius, rise per turn, distance]" if shape == "helix" else "[x, y, z]"
        wanted = "one size, its edge length" if form.sizes == 1 else f"{form.sizes} sizes {names}"
        raise ValueError(f"shape {shape!r} takes {wanted}")
    if not (np.isfinite(sizes).all() and (sizes > 0).all()):
        raise ValueError(f"shape {shape!r} needs sizes > 0 m, not {size}")
    return centred(form.make(sizes, n))


def agents_taken(shape: str) -> str:
    """The number of agents of a named shape, in words."""
    taken = SHAPES[shape].agents
    if len(taken) == 1:
        return f"{taken.start} agents"
    if taken.stop == _ANY:
        return f"{taken.start} or more agents"
    return f"{taken.start} to {taken.stop - 1} agents"
