"""Plain data as TOML, the one direction that the standard library lacks."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any


def to_toml(data: Mapping[str, Any]) -> str:
    """Plain data as TOML text; NumPy's arrays become lists, and keys whose value is None are left out.

    Raises
    ------
    TypeError
        A value has no TOML form.
    """
    return _table((), data).lstrip("\n")


def toml_key(key: str) -> str:
    """A key as TOML writes it: bare where it can be."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _value(key)


def _table(path: tuple[str, ...], table: Mapping[str, Any]) -> str:
    """Keys and values first, then tables and arrays of tables, each under its own header."""
    lines, below = [], []
    for name, value in table.items():
        inner = (*path, toml_key(str(name)))
        if isinstance(value, Mapping):
            below.append(f"\n[{'.'.join(inner)}]\n{_table(inner, value)}")
        elif not path and _is_tables(value):
            below += [f"\n[[{'.'.join(inner)}]]\n{_lines(v)}" for v in value]
        elif value is not None:
            lines.append(f"{inner[-1]} = {_value(value)}\n")
    return "".join([*lines, *below])


def _is_tables(value: Any) -> bool:
    return (
        isinstance(value, list | tuple)
        and bool(value)
        and all(isinstance(v, Mapping) for v in value)
    )


def _pairs(table: Mapping[str, Any]) -> list[str]:
    return [f"{toml_key(str(k))} = {_value(v)}" for k, v in table.items() if v is not None]


def _lines(table: Mapping[str, Any]) -> str:
    return "".join(f"{pair}\n" for pair in _pairs(table))


def _value(value: Any) -> str:
    if hasattr(value, "tolist"):  # NumPy's arrays and scalars
        value = value.tolist()
    match value:
        case bool():
            return "true" if value else "false"
        case int() | float():
            return repr(value)
        case str():
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case list() | tuple():
            return f"[{', '.join(map(_value, value))}]"
        case Mapping():
            return f"{{{', '.join(_pairs(value))}}}"
    raise TypeError(f"a {type(value).__name__} has no place in a mission: {value!r}")
