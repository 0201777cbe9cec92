"""Any data as plain JSON data."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


def to_json_data(value: Any) -> Any:
    """Convert a value to plain JSON data: arrays to lists, NumPy scalars to numbers, non-finite numbers to None.

    An object with ``data`` becomes what that returns, another dataclass its fields by name.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    elif hasattr(value, "data"):
        value = value.data()
    elif is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
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
