"""Paths of keys in a mission, written as in its messages: `agents.mass.2`, `phases[3].until`.

Indices count from 1; `*` stands for every index or name. A key that the mission does not have takes its default. One
number for all agents can be addressed as a list with an entry per agent.
"""

from __future__ import annotations

import copy
import difflib
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from rigidfleet._common.toml import toml_key
from rigidfleet.mission import Mission
from rigidfleet.mission.findings import Keys, model_of
from rigidfleet.mission.values import Part

#: Stands for any index or name.
ANY = "*"
_STEP = re.compile(r'"([^"]*)"|\[(\d+|\*)\]|([^.\[\]"]+)')


class PathError(ValueError):
    """A path that does not exist, with problem and remedy."""

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(problem, remedy)
        self.problem, self.remedy = problem, remedy


def name_of(keys: Keys) -> str:
    """Keys as a path: (`agents`, `mass`, 1) becomes `agents.mass.2`."""
    return ".".join(str(k + 1) if isinstance(k, int) else toml_key(k) for k in keys)


def expand(whole: Mapping[str, Any], path: str) -> list[Keys]:
    """Keys of all places that match a path in a document with all defaults.

    Raises
    ------
    PathError
        No place matches.
    """
    steps = [quoted or index or word for quoted, index, word in _STEP.findall(path)]
    if not steps or _STEP.sub("", path).strip(".[]"):
        raise PathError(
            "is not a valid path", "write agents.mass.2, or agents.position.*.3 for every agent"
        )
    found: list[tuple[Keys, Any]] = [((), whole)]
    for depth, step in enumerate(steps):
        further = [(keys + (k,), inner) for keys, at in found for k, inner in _below(at, step)]
        if not further:
            there = ".".join(steps[:depth]) or "the mission"
            problem = f"there is no '{step}' in {there}"
            raise PathError(problem, _remedy(whole, found[0][1], steps, depth))
        found = further
    return [keys for keys, _ in found]


def whole_document(mission: Mission) -> dict[str, Any]:
    """A mission as plain data with all defaults; None for optional keys without a value."""
    return _filled(mission)


def look_up(data: Any, keys: Keys) -> Any:
    """Value at a place; None if there is none."""
    for k in keys:
        try:
            data = data[k]
        except (KeyError, IndexError, TypeError):
            return None
    return data


def change(
    document: dict[str, Any], whole: Mapping[str, Any], keys: Keys, by: Callable[[Any], Any]
) -> None:
    """Replace a value in a document by a function of it, in place. A missing value is taken from ``whole``."""
    at: Any = document
    for depth, (k, following) in enumerate(zip(keys, (*keys[1:], None), strict=True), start=1):
        if following is None:
            there = k in at if isinstance(at, dict) else True
            at[k] = by(at[k] if there else copy.deepcopy(look_up(whole, keys)))
            return
        table = isinstance(following, str)
        if not isinstance(look_up(at, (k,)), dict if table else list):
            # A table may lack keys; a list needs all its entries.
            at[k] = {} if table else copy.deepcopy(look_up(whole, keys[:depth]))
        at = at[k]


def numbers(value: Any) -> list[Any]:
    """Entries of nested lists, in order."""
    return [x for v in value for x in numbers(v)] if isinstance(value, list) else [value]


def mapped(value: Any, function: Callable[[Any], Any]) -> Any:
    """Apply a function to all entries of nested lists."""
    return [mapped(v, function) for v in value] if isinstance(value, list) else function(value)


def meaning(mission: Mission, keys: Keys) -> str:
    """Description of a key in the mission format, with its unit in brackets."""
    at: Any = mission
    text = ""
    for k in keys:
        owner = at if isinstance(at, type) else type(at)
        field = owner.model_fields.get(str(k)) if issubclass(owner, Part) else None
        if field is None:
            at = look_up(at, (k,))
            continue
        text = field.description or text
        inner = None if isinstance(at, type) else getattr(at, str(k))
        at = model_of(field.annotation) if inner is None else inner
    return text


def _filled(value: Any) -> Any:
    if isinstance(value, Part):
        filled = {}
        for name, field in type(value).model_fields.items():
            inner = getattr(value, name)
            absent = model_of(field.annotation) if inner is None else None
            filled[name] = _defaults(absent) if absent else _filled(inner)
        return filled
    if isinstance(value, Mapping):
        return {key: _filled(inner) for key, inner in value.items()}
    return [_filled(v) for v in value] if isinstance(value, tuple | list) else value


def _defaults(kind: type[Part]) -> dict[str, Any]:
    """Defaults of a table that a mission does not have."""
    fields = kind.model_fields.items()
    return {
        name: None if f.is_required() else _filled(f.get_default(call_default_factory=True))
        for name, f in fields
    }


def _below(at: Any, step: str) -> Iterator[tuple[str | int, Any]]:
    if isinstance(at, dict):
        yield from at.items() if step == ANY else [(step, at[step])] if step in at else []
    elif isinstance(at, list) and step == ANY:
        yield from enumerate(at)
    elif isinstance(at, list) and step.isdecimal() and 1 <= int(step) <= len(at):
        yield int(step) - 1, at[int(step) - 1]


def _remedy(whole: Mapping[str, Any], at: Any, steps: list[str], depth: int) -> str:
    """Suggest a similar path, or list what exists at this depth."""
    rest = steps[depth + 1 :]
    if isinstance(at, dict):
        close = difflib.get_close_matches(steps[depth], [str(k) for k in at], n=1, cutoff=0.55)
        if close:
            return f"did you mean '{'.'.join([*steps[:depth], close[0], *rest])}'?"
    elif isinstance(at, list) and not steps[depth].isdecimal() and rest == []:
        return f"use an index from 1 to {len(at)}, or * for all"
    # agents.2.mass instead of agents.mass.2
    turned = [*steps[:depth], *rest, steps[depth]]
    if rest and (steps[depth].isdecimal() or steps[depth] == ANY):
        try:
            expand(whole, ".".join(turned))
        except PathError:
            pass
        else:
            return f"did you mean '{'.'.join(turned)}'?"
    if isinstance(at, dict):
        return f"keys there: {', '.join(map(str, at))}"
    if isinstance(at, list):
        return f"use an index from 1 to {len(at)}, or * for all"
    return "the path ends there; remove the rest"
