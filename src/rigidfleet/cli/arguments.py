"""Convert arguments of the command to numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter, validators


def to_whole_number(_type: Any, tokens: Sequence[Any]) -> int:
    """Converter of cyclopts for a whole number, without rounding."""
    return parse_whole(tokens[0].value)


#: A whole number.
Whole = Annotated[int, Parameter(converter=to_whole_number)]
#: A number of processes.
Workers = Annotated[
    int | None, Parameter(converter=to_whole_number, validator=validators.Number(gte=1))
]


# Not `mission_names`, whose package takes long to load.
_SHIPPED = sorted(path.stem for path in Path(__file__).parents[1].glob("missions/*.toml"))
#: A file, or the name of a shipped mission, which a shell completes.
MissionName = Annotated[Literal[tuple(_SHIPPED)] | str, Parameter(show_choices=False)]  # ty: ignore[invalid-type-form]


def parse_number(text: str, what: str = "") -> float:
    """Convert text to a number; messages begin with ``what``.

    Raises
    ------
    ValueError
        The text is not a number.
    """
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{what}'{text}' is not a number.") from None


def parse_whole(text: str, what: str = "") -> int:
    """Convert text to a whole number, without rounding; messages begin with ``what``.

    Raises
    ------
    ValueError
        The text is not a whole number.
    """
    try:
        return int(text)  # keeps every digit of a large number
    except ValueError:
        number = parse_number(text, what)
    if not (math.isfinite(number) and number == round(number)):
        raise ValueError(f"{what}'{text}' is not a whole number.")
    return int(number)
