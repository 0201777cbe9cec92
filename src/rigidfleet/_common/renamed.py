"""What was renamed before the first release: a message about an old key gives the new one, an old name in code works.

An old name of a member or a function works with a warning, for one release.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeVar

_C = TypeVar("_C", bound=type)

#: Old name to new name. Keys and options are given as text, values as (key, value).
RENAMED: dict[str | tuple[str, str], str] = {
    ("control", "slots"): "tracking",
    ("edges", "joined"): "henneberg",
    ("edges", "tree"): "henneberg-multilevel",
    ("evaluate", "ends"): "final",
    "judged": "evaluate",
    "--ends": "--final-states",
    "links": "[network]",
    "dropped": "loss",
}


def rename_hint(key: object, value: object = None) -> str:
    """Return a remedy that gives the new name of a key, an option or a value of a key; '' if it was not renamed."""
    new = RENAMED.get(str(key) if value is None else (str(key), str(value)))
    return f"it is now called '{new}'" if new is not None else ""


class _EarlierMember(property):
    """A member by its earlier name, of the class as of its objects."""

    def __get__(self, thing: Any, kind: type | None = None) -> Any:
        return super().__get__(kind if thing is None else thing)


def with_earlier_members(**new: str) -> Callable[[_C], _C]:
    """Give a class its members by earlier names, too: each with the name of now."""

    def add_properties(kind: _C) -> _C:
        for old in new:
            setattr(kind, old, _EarlierMember(partial(_current_member, new=new, old=old, level=3)))
        return kind

    return add_properties


def getattr_of_earlier_names(module: str, **new: str) -> Callable[[str], Any]:
    """The `__getattr__` of a module that has functions by earlier names, too: each with the name of now."""
    return partial(_current_member, sys.modules[module], new)


def _current_member(owner: Any, new: Mapping[str, str], old: str, level: int = 2) -> Any:
    """A member of an object, a class or a module by its earlier name, with a warning where it is used."""
    if old not in new:
        raise AttributeError(f"module {owner.__name__!r} has no attribute {old!r}")
    warnings.warn(f"{old} is now {new[old]}", DeprecationWarning, stacklevel=level)
    return getattr(owner, new[old])
