"""What several packages ask of arrays."""

from __future__ import annotations

import numpy as np


def arrays_equal(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two small arrays of one kind have the same numbers."""
    return a is b or (a.shape == b.shape and a.tobytes() == b.tobytes())
