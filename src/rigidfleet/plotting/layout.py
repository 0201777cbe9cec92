"""The layout of figures over time: rows and columns of axes, clear of the words around them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.layout_engine import LayoutEngine
from matplotlib.transforms import Bbox

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

    from rigidfleet.typing import Floats

    Cells = list[tuple[Axes, SubplotSpec]]


class Layout(LayoutEngine):
    """Places axes so that their words, their legends and the title do not overlap.

    Matplotlib's own layout for this measures everything twice, and each mark beside the words. Here the words are
    measured once; again only if ticks change with the size of the axes.

    Parameters
    ----------
    pad : room around the axes with their words [in]
    """

    _adjust_compatible = False
    _colorbar_gridspec = False

    def __init__(self, pad: float) -> None:
        super().__init__()
        self._pad = pad

    def execute(self, fig: Figure) -> None:
        """Place the axes that stand in a grid."""
        cells = [
            (ax, spec) for ax in fig.axes if (spec := ax.get_subplotspec()) and ax.get_in_layout()
        ]
        if cells:
            before = _ticks(cells)
            self._place(fig, cells)
            if _ticks(cells) != before:
                self._place(fig, cells)

    def _place(self, fig: Any, cells: Cells) -> None:
        """Place axes by the room [pixels] that their words need now."""
        pad = self._pad * fig.dpi
        right, top = fig.bbox.width, fig.bbox.height
        if (title := fig._suptitle) is not None:
            title.set_position((title.get_position()[0], 1.0 - pad / top))
            top -= title.get_window_extent().height + 2 * pad
        right -= sum(legend.get_window_extent().width + 2 * pad for legend in fig.legends)
        grid = cells[0][1].get_gridspec()
        # Room before and after each column and row; rows count from the top.
        across, down = np.full((2, grid.ncols), pad), np.full((2, grid.nrows), pad)
        for ax, spec in cells:
            inner, outer = ax.bbox, _extent(ax)
            rows, columns = spec.rowspan, spec.colspan
            for room, at, needed in (
                (across[0], columns.start, inner.x0 - outer.x0),
                (across[1], columns.stop - 1, outer.x1 - inner.x1),
                (down[0], rows.start, outer.y1 - inner.y1),
                (down[1], rows.stop - 1, inner.y0 - outer.y0),
            ):
                # Whole pixels, so that the layout changes nothing when it is computed again
                room[at] = max(room[at], round(needed + pad))
        x0, x1 = _shared(across, right, grid.get_width_ratios())
        y0, y1 = _shared(down, top, grid.get_height_ratios())
        if min(*(x1 - x0), *(y1 - y0)) <= 0.0:
            return  # there is no room for all words
        for ax, spec in cells:
            rows, columns = spec.rowspan, spec.colspan
            ends = [
                (x0[columns.start], top - y1[rows.stop - 1]),
                (x1[columns.stop - 1], top - y0[rows.start]),
            ]
            ax.set_position(Bbox(ends).transformed(fig.transFigure.inverted()))
            ax.set_in_layout(True)


def _shared(room: Floats, size: float, ratios: Any) -> tuple[Floats, Floats]:
    """Begin and end [pixels] of each part of a size, in the ratios, with the room before and after it (2, n)."""
    lengths = (size - room.sum()) * np.asarray(ratios, dtype=float) / np.sum(ratios)
    begin = np.cumsum(room[0]) + np.concatenate([[0.0], np.cumsum(room[1] + lengths)[:-1]])
    return begin, begin + lengths


def _ticks(cells: Cells) -> list[list[float]]:
    return [list(ax.yaxis.get_majorticklocs()) for ax, _ in cells]


def _extent(ax: Axes) -> Bbox:
    """Extent [pixels] of axes with their words and legend."""
    boxes: list[Any] = [ax.bbox, ax.spines["bottom"].get_window_extent()]  # with its marks
    boxes += [axis.get_tightbbox(for_layout_only=True) for axis in (ax.xaxis, ax.yaxis)]
    words = [ax.get_legend(), *ax.texts]
    boxes += [
        part.get_window_extent() for part in words if part is not None and part.get_in_layout()
    ]
    return Bbox.union([box for box in boxes if box is not None])
