"""A figure that a notebook shows as it is."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from matplotlib import figure
from matplotlib.backends.backend_agg import FigureCanvasAgg

#: Pixels per inch of a notebook's screen.
_SHOWN = 100


class Figure(figure.Figure):
    """A matplotlib figure that a notebook shows at the end of a cell, without a magic command.

    Attributes
    ----------
    settings : a context in which it is drawn
    """

    settings: Callable[[], AbstractContextManager[Any]] = nullcontext

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        # This canvas keeps its renderer; without it, each measure of a text would make a new one.
        FigureCanvasAgg(self)

    def _repr_png_(self) -> tuple[bytes, dict[str, Any]]:
        """The picture, and the size it is shown at: fine screens have dots to spare."""
        buffer = io.BytesIO()
        with self.settings():
            self.savefig(buffer, format="png")
        width, height = (int(x) for x in self.get_size_inches() * _SHOWN)
        return buffer.getvalue(), {"width": width, "height": height}
