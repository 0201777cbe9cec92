"""Plain data as TOML, the one direction that the standard library lacks."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from datetime import date, time
from typing import Any

import tomli_w

#: A list of numbers as tomli-w writes it, one a line. A raw line break stands in no string that it writes.
_NUMBERS = re.compile(r"\[\n((?: *[\w.+-]+,\n)+) *\]")


def to_toml(data: Mapping[str, Any]) -> str:
    """Plain data as TOML text; NumPy's arrays become lists, and keys whose value is None are left out.

    A point stands on one line.

    Raises
    ------
    TypeError
        A value has no TOML form.
    """
    text = tomli_w.dumps(to_toml_data(data))
    return _NUMBERS.sub(lambda match: f"[{' '.join(match[1].split())[:-1]}]", text)


def toml_equals_data(text: str, data: Mapping[str, Any]) -> bool:
    """Whether a text is TOML, and says what data say."""
    try:
        return tomllib.loads(text) == data
    except tomllib.TOMLDecodeError:
        return False


def toml_key(key: str) -> str:
    """A key as TOML writes it: bare where it can be."""
    return tomli_w.dumps({key: 0}).removesuffix(" = 0\n")


def to_toml_data(value: Any) -> Any:
    """A copy of data as TOML has it: lists instead of NumPy's arrays and tuples, and no keys whose value is None.

    Raises
    ------
    TypeError
        A value has no TOML form.
    """
    if hasattr(value, "tolist"):  # NumPy's arrays and scalars
        value = value.tolist()
    match value:
        case bool() | int() | float() | str() | date() | time():
            return value
        case list() | tuple():
            return [to_toml_data(item) for item in value]
        case Mapping():
            return {str(key): to_toml_data(item) for key, item in value.items() if item is not None}
    raise TypeError(f"a {type(value).__name__} has no place in a mission: {value!r}")
