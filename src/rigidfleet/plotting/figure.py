"""A figure that a notebook shows as it is."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from matplotlib import figure


class Figure(figure.Figure):
    """A figure of matplotlib that is its own picture where it ends a cell, without any magic line.

    Attributes
    ----------
    settings : a context in which it is drawn
    """

    settings: Callable[[], AbstractContextManager[Any]] = nullcontext

    def _repr_png_(self) -> tuple[bytes, dict[str, Any]]:
        """The picture, and the size it is shown at: fine screens have dots to spare."""
        buffer = io.BytesIO()
        with self.settings():
            self.savefig(buffer, format="png")
        width, height = (int(x) for x in self.get_size_inches() * self.dpi)
        return buffer.getvalue(), {"width": width, "height": height}
