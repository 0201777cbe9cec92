"""What the command is given, as values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any


def exact(_type: Any, tokens: Sequence[Any]) -> int:
    """A whole number as it is written: none is rounded."""
    return parse_whole(tokens[0].value)


def parse_number(text: str) -> float:
    """A number as it is written; ValueError with a sentence if it is none."""
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"'{text}' is no number.") from None


def parse_whole(text: str) -> int:
    """A whole number as it is written: none is rounded; ValueError with a sentence if it is none."""
    try:
        return int(text)  # every digit of a large one counts
    except ValueError:
        number = parse_number(text)
    if not (math.isfinite(number) and number == round(number)):
        raise ValueError(f"'{text}' is no whole number.")
    return int(number)
