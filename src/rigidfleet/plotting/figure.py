"""A figure that a notebook shows as it is."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from matplotlib import cbook, figure
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg

from rigidfleet.plotting.axes import Axes
from rigidfleet.plotting.words import Renderer

#: Pixels per inch of a notebook's screen.
_SHOWN = 100
_METRES_PER_INCH = 0.0254


class _Canvas(FigureCanvasAgg):
    """Matplotlib's canvas, which writes PNG in a third of the time.

    Pillow tries five filters on each row of pixels. The difference to the row above suits figures: most of it is zero.
    """

    def get_renderer(self) -> RendererAgg:
        """The renderer of this size, which is kept."""
        size = *self.get_width_height(physical=True), self.figure.dpi
        if self._lastKey != size:
            self.renderer, self._lastKey = Renderer(*size), size
        return self.renderer

    def print_png(
        self,
        filename_or_obj: Any,
        *,
        metadata: dict[str, Any] | None = None,
        pil_kwargs: dict[str, Any] | None = None,
        **_: Any,
    ) -> None:
        """Write the figure as PNG; with metadata or options of Pillow, as matplotlib does."""
        if metadata or pil_kwargs:
            super().print_png(filename_or_obj, metadata=metadata, pil_kwargs=pil_kwargs)
            return
        self.draw()
        with cbook.open_file_cm(filename_or_obj, "wb") as file:
            file.write(_png(np.asarray(self.buffer_rgba()), self.figure.dpi))


def _png(pixels: np.ndarray[Any, np.dtype[np.uint8]], dpi: float) -> bytes:
    """A PNG file (ISO/IEC 15948) of pixels (rows, columns, 4), red, green, blue and opacity."""
    opaque = pixels[..., 3].min() == 255
    height, width, channels = *pixels.shape[:2], 3 if opaque else 4
    # Filter 2 begins each row: the difference to the row above
    rows = np.empty((height, 1 + width * channels), np.uint8)
    rows[:, 0] = 2
    for k in range(channels):  # one at a time, which is twice as fast
        rows[0, 1 + k :: channels] = pixels[0, :, k]
        np.subtract(pixels[1:, :, k], pixels[:-1, :, k], out=rows[1:, 1 + k :: channels])
    per_metre = round(dpi / _METRES_PER_INCH)
    chunks = {
        b"IHDR": struct.pack(">2I5B", width, height, 8, 2 if opaque else 6, 0, 0, 0),
        b"pHYs": struct.pack(">2IB", per_metre, per_metre, 1),
        b"IDAT": zlib.compress(rows.data, 3),
        b"IEND": b"",
    }
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks.items()
    )


class Figure(figure.Figure):
    """A matplotlib figure that a notebook shows at the end of a cell, without a magic command.

    Attributes
    ----------
    settings : a context in which it is drawn
    """

    settings: Callable[[], AbstractContextManager[Any]] = nullcontext

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        _Canvas(self)  # which keeps its renderer; measuring a text would make a new one each time

    def add_subplot(self, *arguments: Any, **options: Any) -> Any:
        """Add axes of ours, unless a projection is asked for."""
        return super().add_subplot(*arguments, **_ours(options))

    def add_axes(self, *arguments: Any, **options: Any) -> Any:
        """Add axes of ours, unless a projection is asked for."""
        return super().add_axes(*arguments, **_ours(options))

    def _repr_png_(self) -> tuple[bytes, dict[str, Any]]:
        """The picture, and the size it is shown at: fine screens have dots to spare."""
        buffer = io.BytesIO()
        with self.settings():
            self.savefig(buffer, format="png")
        width, height = (int(x) for x in self.get_size_inches() * _SHOWN)
        return buffer.getvalue(), {"width": width, "height": height}


def _ours(options: dict[str, Any]) -> dict[str, Any]:
    """Options of new axes, which are ours unless they say otherwise."""
    other = {"axes_class", "projection", "polar"} & options.keys()
    return options if other else options | {"axes_class": Axes}
