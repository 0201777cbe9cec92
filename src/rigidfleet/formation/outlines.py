"""Points on outlines: drawings (SVG) and words in a font, and points evenly spread over them."""

from __future__ import annotations

import math
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from rigidfleet.errors import RigidfleetError
from rigidfleet.formation.graphs import farthest_points
from rigidfleet.formation.point_files import read_bytes
from rigidfleet.math import proximity
from rigidfleet.typing import Floats, Ints

#: Points of an outline among which is chosen, as a multiple of those asked for, and rounds of improvement.
_DENSE, _ROUNDS = 20, 30
#: Typical distance of neighbours beyond which two points are too near to scale all by them, as a multiple of theirs.
_UNEVEN = 10.0
#: Greatest number of points of an outline.
_MOST = 5000


def svg_outlines(path: str | Path, notes: list[str] | None = None) -> list[Floats]:
    """Outlines (K, 2) of the shapes of an SVG drawing as polygons, y up; a closed one ends where it begins.

    Shapes are those that a browser draws. Strokes are drawn by their middle lines, fills by their edges; ``notes``
    takes what is not drawn.

    Raises
    ------
    ValueError
        The file is no SVG drawing, or has no outline.
    RigidfleetError
        svgelements is not installed, or (MissionError) the file cannot be read.
    """
    if find_spec("svgelements") is None:
        raise RigidfleetError("Drawings need svgelements. Install it: pip install svgelements.")
    from rigidfleet.formation.drawings import Drawing

    data = read_bytes(path)
    try:
        drawing = Drawing(data)
    except Exception as error:  # its parsers raise errors of many kinds
        raise ValueError(f"is no SVG drawing: {' '.join(str(error).split())}") from None
    said = [f"{what} ({n}x)" if n > 1 else what for what, n in drawing.notes.items()]
    if not drawing.outlines:
        raise ValueError("; ".join(["has no outline", *said]))
    if notes is not None:
        notes += said
    return _drop_degenerate_outlines([x * (1.0, -1.0) for x in drawing.outlines])


def text_outlines(words: str, font: str = "DejaVu Sans") -> list[Floats]:
    """Outlines (K, 2) of words in a font, of height about 1, as polygons.

    Raises
    ------
    ValueError
        There is no such font, or the words have no outline.
    """
    from matplotlib.font_manager import FontProperties, findfont
    from matplotlib.textpath import TextPath

    try:
        findfont(font, fallback_to_default=False)
    except ValueError:
        raise ValueError(f"there is no font {font!r}; matplotlib lists those it finds") from None
    if not words.strip():
        raise ValueError("has no outline")
    path = TextPath((0.0, 0.0), words, size=1.0, prop=FontProperties(family=font))
    return _drop_degenerate_outlines([np.array(x) for x in path.to_polygons(closed_only=False)])


def stroke_outlines(words: str, font: str = "futural") -> list[Floats]:
    """Lines (K, 2) of words in a font of single strokes (Hershey, 1967), of height about 1, as polygons.

    Raises
    ------
    ValueError
        There is no such font, a letter is not in it, or the words have no outline.
    RigidfleetError
        Hershey-Fonts is not installed.
    """
    if find_spec("HersheyFonts") is None:
        needed = "Words of strokes need Hershey-Fonts. Install it: pip install Hershey-Fonts."
        raise RigidfleetError(needed)
    from HersheyFonts import HersheyFonts

    letters = HersheyFonts()
    letters.load_default_font(font)
    letters.normalize_rendering(1.0)
    if missing := "".join(x for x in words if x not in letters.all_glyphs):
        raise ValueError(f"has letters that {font!r} lacks: {missing}")
    strokes = map(list, letters.strokes_for_text(words))
    return _drop_degenerate_outlines([np.array(x, dtype=np.float64) for x in strokes])


def _drop_degenerate_outlines(outlines: list[Floats]) -> list[Floats]:
    finite = (x for x in outlines if len(x) > 1 and np.isfinite(x).all())
    if not (extended := [x for x in finite if np.ptp(x, axis=0).any()]):
        raise ValueError("has no outline")
    return extended


def slots_on_outlines(outlines: list[Floats], count: int, spacing: float) -> Floats:
    """Slots (count, 3) [m] evenly spread over outlines, the nearest two ``spacing`` apart; upright: x east, z up.

    Raises
    ------
    ValueError
        The count or the spacing is not possible.
    """
    if not 2 <= count <= _MOST:
        raise ValueError(f"an outline takes 2 to {_MOST:,} agents, not {count:,}")
    dense = _points_along(outlines, _DENSE * count)
    flat = dense[most_even_points(dense, count)]
    return scale_to_spacing(np.column_stack([flat[:, 0], 0.0 * flat[:, 0], flat[:, 1]]), spacing)


def scale_to_spacing(points: ArrayLike, spacing: float) -> Floats:
    """Points (N, 3) about their centre, enlarged or reduced until the nearest two are ``spacing`` [m] apart.

    Raises
    ------
    ValueError
        The spacing is not a positive number, or there are fewer than two points.
    """
    p = np.asarray(points, dtype=np.float64)
    if not 0.0 < spacing < math.inf:
        raise ValueError(f"a spacing must be a positive length [m], not {spacing:g}")
    if len(p) < 2:
        raise ValueError("a single point has no spacing")
    if not (least := float(proximity.nearest(p).min())) > 0.0:
        raise ValueError("two points are the same: nothing scales them apart")
    return (p - p.mean(axis=0)) * (spacing / least)


def scale_in_words(points: Floats, scaled: Floats) -> list[str]:
    """By how much points (N, 3) [m] are scaled, and why; none if by 1.

    Raises
    ------
    ValueError
        They become larger than points with such a spacing would have to be: a few of them lie too near to each other.
    """
    nearest, whom = (x[:, 1] for x in KDTree(points).query(points, 2))
    one, typical = int(nearest.argmin()), float(np.median(nearest))
    least, before, after = nearest[one], np.ptp(points, axis=0).max(), np.ptp(scaled, axis=0).max()
    if abs(after - before) <= 1e-9 * before:
        return []
    spacing = least * after / before
    pair = " and ".join(f"({', '.join(f'{x:.6g}' for x in points[k])})" for k in (one, whom[one]))
    words = (
        f"scaled by {after / before:.3g}, from {before:,.4g} m to {after:,.4g} m across: the points {pair} are"
        f" {least:.3g} m apart, to become {spacing:.3g} m"
    )
    if typical > _UNEVEN * least or after > 2.0 * len(points) * spacing:
        raise ValueError(
            f"would be {words}, while points typically stand {typical:.3g} m apart; remove one of the two, or ask for"
            " fewer agents, for which the points that spread most evenly are kept"
        )
    return [words]


def most_even_points(points: Floats, count: int) -> Ints:
    """Indices (count,) of points (M, d) that are spread evenly: their least distance is as large as was found.

    Two starts, every M/count-th point and the farthest from all chosen before, are improved in turns: each chosen point
    goes to the middle of the points that are nearest to it (Lloyd), and from there to the nearest point.

    Raises
    ------
    ValueError
        There are fewer points.
    """
    if len(points) < count:
        raise ValueError(f"{len(points):,} points cannot place {count:,} agents; use fewer agents")
    tree = KDTree(points)
    best, most = np.arange(count), -1.0
    for start in (np.arange(count) * len(points) // count, farthest_points(points, count)):
        chosen = start
        for _ in range(_ROUNDS):
            least = float(proximity.nearest(points[chosen]).min()) if count > 1 else 0.0
            if least > most:
                best, most = chosen, least
            owner = KDTree(points[chosen]).query(points)[1]
            size = np.bincount(owner, minlength=count)
            middle = np.stack([np.bincount(owner, x, count) for x in points.T], axis=1)
            moved = np.unique(tree.query(middle / np.maximum(size, 1)[:, None])[1])
            if len(moved) < count or (moved == np.sort(chosen)).all():
                break
            chosen = moved
    return np.sort(best)


def _points_along(outlines: list[Floats], count: int) -> Floats:
    """About ``count`` points (M, 2) at equal steps along polygons (K, 2)."""
    lengths = [np.linalg.norm(np.diff(x, axis=0), axis=1) for x in outlines]
    step = sum(map(np.sum, lengths)) / count
    parts_of_all = []
    for x, length in zip(outlines, lengths, strict=True):
        closed = np.allclose(x[0], x[-1], atol=1e-9 * float(np.ptp(x, axis=0).max()))
        at = np.concatenate([[0.0], np.cumsum(length)])
        parts = max(1, round(float(at[-1]) / step))
        s = np.linspace(0.0, at[-1], parts + 1)[: -1 if closed and parts > 1 else None]
        parts_of_all.append(np.column_stack([np.interp(s, at, column) for column in x.T]))
    return np.concatenate(parts_of_all)
