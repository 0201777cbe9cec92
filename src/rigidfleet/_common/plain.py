"""Any data as plain JSON data."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def to_json_data(value: Any) -> Any:
    """Convert a value to plain JSON data: arrays to lists, NumPy scalars to numbers, non-finite numbers to None."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): to_json_data(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [to_json_data(item) for item in value]
    return value


def to_json_text(value: Any) -> str:
    """Return a value as JSON text (`to_json_data`)."""
    return json.dumps(to_json_data(value), ensure_ascii=False, allow_nan=False)
