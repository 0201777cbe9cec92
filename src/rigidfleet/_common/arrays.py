"""What several packages ask of arrays."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np


def arrays_equal(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two small arrays of one kind have the same numbers."""
    return a is b or (a.shape == b.shape and a.tobytes() == b.tobytes())


def make_read_only(parts: Iterable[Any]) -> None:
    """Make arrays read-only, also those in tuples and dataclasses; in empty ones, there is nothing to change."""
    for part in parts:
        if isinstance(part, np.ndarray) and part.size:
            part.flags.writeable = False
        elif isinstance(part, tuple):
            make_read_only(part)
        elif hasattr(part, "__dataclass_fields__"):
            make_read_only(vars(part).values())
