"""Axes whose ticks are drawn with the parts of a single one.

Matplotlib makes five artists for each tick and draws each by itself, which took a third of a figure's time. Here the
grid of an axis is one line, its marks are another, and one text is each of its words in turn. What needs more than one
tick is left to matplotlib: ticks that are changed one by one, minor ticks, ticks on a second side.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib import axes, axis
from matplotlib.ticker import NullLocator
from matplotlib.transforms import Bbox

if TYPE_CHECKING:
    from matplotlib.axis import Tick

#: A tick that is so far outside the limits, relative to their distance, is there by rounding.
_NEAR = 1e-10


class _Sparing(axis.Axis):
    """An axis with one tick, whose parts are moved."""

    _side = 0  # of the coordinates x and y, the one along this axis
    _autolabelpos: bool  # matplotlib's: whether it places the name of the axis

    def _marks(self) -> tuple[Tick, list[tuple[float, str]]] | None:
        """The tick that stands for all, with their places and words; None if matplotlib has to draw them."""
        places = np.asarray(self.get_majorticklocs(), dtype=float)
        words = self.get_major_formatter().format_ticks(places.tolist())
        tick = self.majorTicks[0]
        if (
            len(self.majorTicks) > 1
            or not isinstance(self.get_minor_locator(), NullLocator)
            or tick.tick2line.get_visible()
            or tick.label2.get_visible()
            or self.get_label_position() not in ("bottom", "left")
            or self.get_major_formatter().get_offset()
        ):
            return None
        low, high = sorted(self.get_view_interval())
        near = _NEAR * (high - low)
        every = zip(places.tolist(), words, strict=True)
        return tick, [(at, word) for at, word in every if low - near <= at <= high + near]

    def _update_ticks(self) -> list[Tick]:
        """What spines ask for the room that marks need."""
        marks, matplotlib = self._marks(), super()
        return cast("Any", matplotlib)._update_ticks() if marks is None else [marks[0]]

    def _boxes(self, tick: Tick, marks: list[tuple[float, str]], renderer: Any) -> list[Bbox]:
        """Extents [pixels] of the words of all ticks."""
        boxes = []
        for place, word in marks if tick.label1.get_visible() else ():
            tick.update_position(place)
            tick.label1.set_text(word)
            boxes.append(tick.label1.get_window_extent(renderer))
        return boxes

    def _place_label(self, tick: Tick, boxes: list[Bbox]) -> None:
        """Place the name of the axis beside the words of its ticks."""
        if self._autolabelpos:
            across, dot = 1 - self._side, self.axes.figure.dpi / 72
            mark = tick.get_tick_padding() * dot if tick.tick1line.get_visible() else 0.0
            edge = min([self.axes.bbox.min[across] - mark, *(box.min[across] for box in boxes)])
            x, y = self.label.get_position()
            edge -= self.labelpad * dot
            self.label.set_position((x, edge) if across else (edge, y))

    def get_tightbbox(self, renderer: Any = None, *, for_layout_only: bool = False) -> Bbox | None:
        """Extent [pixels] of the words; for a layout, the name of the axis has no length."""
        if not self.get_visible() or (for_layout_only and not self.get_in_layout()):
            return None
        if (found := self._marks()) is None:
            return super().get_tightbbox(renderer, for_layout_only=for_layout_only)
        tick, marks = found
        boxes = self._boxes(tick, marks, renderer)
        self._place_label(tick, boxes)
        if self.label.get_visible():
            ends = self.label.get_window_extent(renderer).get_points()
            if for_layout_only and np.ptp(ends[:, self._side]) > 0.0:
                ends[:, self._side] = ends[:, self._side].mean() + np.array([-0.5, 0.5])
            boxes.append(Bbox(ends))
        boxes = [box for box in boxes if np.isfinite(box.get_points()).all()]
        return Bbox.union(boxes) if boxes else None

    def draw(self, renderer: Any) -> None:
        """Draw grid, marks and words."""
        if not self.get_visible():
            return
        if (found := self._marks()) is None:
            super().draw(renderer)
            return
        tick, marks = found
        renderer.open_group("axis", gid=self.get_gid())
        boxes = self._boxes(tick, marks, renderer) if self.label.get_text() else []
        places = [place for place, _ in marks]
        lines = np.array([[place, place, np.nan] for place in places]).ravel()
        self._draw_line(tick.gridline, renderer, lines, [0.0, 1.0, np.nan] * len(places))
        self._draw_line(tick.tick1line, renderer, places, [0.0] * len(places))
        for place, word in marks if tick.label1.get_visible() else ():
            tick.update_position(place)
            tick.label1.set_text(word)
            tick.label1.draw(renderer)
        self._place_label(tick, boxes)
        self.label.draw(renderer)
        renderer.close_group("axis")
        self.stale = False

    def _draw_line(self, line: Any, renderer: Any, along: Any, across: Any) -> None:
        """Draw a part of all ticks at once."""
        before = line.get_data(orig=True)
        line.set_data((along, across) if self._side == 0 else (across, along))
        line.draw(renderer)
        line.set_data(before)


class _XAxis(_Sparing, axis.XAxis):
    _side = 0


class _YAxis(_Sparing, axis.YAxis):
    _side = 1


class Axes(axes.Axes):
    """Axes with such a horizontal and a vertical axis."""

    def _init_axis(self) -> None:  # the hook of matplotlib for axes of other kinds
        self.xaxis, self.yaxis = _XAxis(self, clear=False), _YAxis(self, clear=False)
        for side, along in (("bottom", 0), ("top", 0), ("left", 1), ("right", 1)):
            self.spines[side].register_axis((self.xaxis, self.yaxis)[along])
