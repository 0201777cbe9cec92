"""Samples of a flight as compressed text inside a page: a tenth of their size, and fast to read.

Each column is rounded to a step too small to see. Then its second differences along time are taken,
bytes of equal significance are put side by side, and the result is deflated. ``unpack`` in recording.js
reverses this.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from rigidfleet.typing import Floats

#: Stands for NaN; one less than the least valid number.
_MISSING = -(2**31)


class PackedColumn(NamedTuple):
    """A quantity over time and the step it is rounded to, both in its unit."""

    values: Floats  # (K,) or (K, ...); NaN if there is no value
    step: float


def pack_columns(columns: Mapping[str, PackedColumn]) -> tuple[list[dict[str, Any]], str]:
    """Description of each column, in order, and all of them as one text (base64)."""
    described, planes = [], []
    for name, (values, step) in columns.items():
        flat = values.reshape(len(values), -1)
        described.append({"name": name, "width": flat.shape[1], "step": step})
        planes.append(_second_difference_bytes(flat.T / step))
    data = zlib.compress(b"".join(planes), 6)
    return described, base64.b64encode(data).decode("ascii")


def _second_difference_bytes(rows: Floats) -> bytes:
    """Second differences of rounded rows, lowest bytes first; sums of 32 bits wrap around."""
    whole = np.clip(np.round(rows), _MISSING + 1, -_MISSING - 1)
    steps = np.where(np.isnan(rows), _MISSING, whole).astype(np.int64)
    twice = np.diff(np.diff(steps, axis=1, prepend=0), axis=1, prepend=0)
    return twice.astype("<u4", casting="unsafe").reshape(-1, 1).view(np.uint8).T.tobytes()
