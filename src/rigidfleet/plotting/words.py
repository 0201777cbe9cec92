"""A renderer that measures and draws each text once: words recur, on axes, in phases and from figure to figure."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.font_manager import findfont, get_font

from rigidfleet.plotting.applied import applied

if TYPE_CHECKING:
    from matplotlib.font_manager import FontProperties

#: Texts that are kept: more than some figures have.
_KEPT = 2048
#: Room around the picture of a text [pixels]: parts of letters may stand out.
_ROOM = 2

Picture = tuple[np.ndarray[Any, np.dtype[np.uint8]], int, int]


class Renderer(RendererAgg):
    """Matplotlib's renderer with such texts; in other styles than ours, as it is."""

    def get_text_width_height_descent(self, s: str, prop: FontProperties, ismath: Any) -> Any:
        """Size and descent of a text [pixels]."""
        if ismath == "TeX" or not applied.get():
            return super().get_text_width_height_descent(s, prop, ismath)
        return _size(s, prop.copy(), ismath, self.dpi)

    def _get_font_height_metrics(self, prop: FontProperties) -> Any:
        """Ascent, descent and gap of a font's lines [pixels], for which matplotlib reads the font each time."""
        heights = _heights if applied.get() else _heights.__wrapped__
        return heights(prop.copy(), self.dpi)

    def draw_text(
        self, gc: Any, x: float, y: float, s: str, prop: FontProperties, angle: float, ismath: Any = False,
        mtext: Any = None,
    ) -> None:  # fmt: skip
        """Draw a text whose baseline begins at a point [pixels], at whole pixels."""
        if ismath == "TeX" or not gc.get_antialiased() or not applied.get():
            super().draw_text(gc, x, y, s, prop, angle, ismath, mtext)
            return
        picture, left, below = _picture(s, prop.copy(), angle, ismath, self.dpi)
        self._renderer.draw_text_image(picture, round(x) + left, round(y) + below, 0, gc)


@lru_cache(_KEPT)
def _size(s: str, prop: FontProperties, ismath: bool, dpi: float) -> tuple[float, float, float]:
    return RendererAgg(1, 1, dpi).get_text_width_height_descent(s, prop, ismath)


@lru_cache(_KEPT)
def _heights(
    prop: FontProperties, dpi: float
) -> tuple[float, float, float] | tuple[None, None, None]:
    font = get_font(findfont(prop))
    table, head = font.get_sfnt_table("OS/2"), font.get_sfnt_table("head")
    if table is None or head is None:
        return None, None, None
    unit = prop.get_size_in_points() * dpi / 72 / head["unitsPerEm"]
    up, down, gap = table["sTypoAscender"], table["sTypoDescender"], table["sTypoLineGap"]
    return up * unit, -down * unit, gap * unit


@lru_cache(_KEPT)
def _picture(s: str, prop: FontProperties, angle: float, ismath: bool, dpi: float) -> Picture:
    """Opacity of a text's pixels, and where they begin, left of and below its baseline."""
    width, height, descent = _size(s, prop, ismath, dpi)
    a = math.radians(angle)
    turn = np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    ends = np.array([(x, y) for x in (0.0, width) for y in (-descent, height - descent)]) @ turn.T
    low, high = np.floor(ends.min(axis=0)) - _ROOM, np.ceil(ends.max(axis=0)) + _ROOM
    left, bottom, right, top = (int(v) for v in (*low, *high))
    scratch = RendererAgg(right - left, top - bottom, dpi)
    scratch.draw_text(scratch.new_gc(), -left, top, s, prop, angle, ismath)
    return np.asarray(scratch.buffer_rgba())[..., 3].copy(), left, -bottom
