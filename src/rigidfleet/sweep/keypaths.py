"""Paths of keys in a mission, written as in its messages: `agents.mass.2`, `phases[3].until`.

Indices count from 1; `*` stands for every index or name, but for no table that the mission lacks. A key that the
mission does not have takes its default. One number for all agents can be addressed as a list with an entry per agent.
"""

from __future__ import annotations

import copy
import difflib
import re
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from typing import Any, get_args

from pydantic.fields import FieldInfo

from rigidfleet._common.toml import toml_key
from rigidfleet.mission import Mission
from rigidfleet.mission.findings import Keys, look_up, model_of
from rigidfleet.mission.values import Part, PerAgent, PerAgentError, PerAxis
from rigidfleet.sweep.variation import NotationError

#: Stands for any index or name.
ANY = "*"
_STEP = re.compile(r'"([^"]*)"|\[(\d+|\*)\]|([^.\[\]"]+)')
_PATH = re.compile(r'(\.?("[^"]*"|[^.\[\]"]+)|\.?\[(\d+|\*)\])+')
#: Types of keys that take one number or a list, and the length of the list; 0: the number of agents.
_LISTS = ((get_args(PerAgentError)[0], 0), (PerAgent | None, 0), (PerAxis | None, 3))


class Absent(dict[str, Any]):
    """Defaults of a table that a mission does not have."""


def path_of_keys(keys: Keys) -> str:
    """Keys as a path: (`agents`, `mass`, 1) becomes `agents.mass.2`."""
    return ".".join(str(k + 1) if isinstance(k, int) else toml_key(k) for k in keys)


def expand_path(whole: Mapping[str, Any], path: str) -> list[Keys]:
    """Keys of all places that match a path in a document with all defaults.

    Raises
    ------
    NotationError
        No place matches.
    """
    if not _PATH.fullmatch("." + path):
        remedy = "write agents.mass.2, or agents.position.*.3 for every agent"
        raise NotationError("is not a valid path", remedy)
    steps = [quoted or index or word for quoted, index, word in _STEP.findall(path)]
    places, depth = _best_matches(whole, steps)
    if depth < len(steps):
        problem = f"there is no '{steps[depth]}' in {'.'.join(steps[:depth]) or 'the mission'}"
        raise NotationError(problem, _path_remedy(whole, places[0][1], steps, depth))
    return [keys for keys, _ in places]


def whole_document(mission: Mission) -> dict[str, Any]:
    """A mission as plain data with all defaults; None for optional keys without a value."""
    return _plain_document(mission, mission.n_agents)


def replace_value(
    document: dict[str, Any], whole: Mapping[str, Any], keys: Keys, by: Callable[[Any], Any]
) -> None:
    """Replace a value in a document by a function of it, in place. A missing value is taken from ``whole``."""
    at: Any = document
    for depth, (k, following) in enumerate(pairwise(keys), start=1):
        table = isinstance(following, str)
        if not isinstance(look_up(at, (k,)), dict if table else list):
            # A table may lack keys; a list needs all its entries.
            at[k] = {} if table else copy.deepcopy(look_up(whole, keys[:depth]))
        at = at[k]
    at[keys[-1]] = by(look_up(at, keys[-1:], look_up(whole, keys)))


def is_in_absent_table(whole: Mapping[str, Any], keys: Keys) -> bool:
    """Whether a place is in a table that the mission does not have."""
    return any(isinstance(look_up(whole, keys[:k]), Absent) for k in range(1, len(keys)))


def flatten_lists(value: Any) -> list[Any]:
    """Entries of nested lists, in order."""
    return [x for v in value for x in flatten_lists(v)] if isinstance(value, list) else [value]


def map_nested_lists(value: Any, apply: Callable[[Any], Any]) -> Any:
    """Apply a function to all entries of nested lists."""
    return [map_nested_lists(v, apply) for v in value] if isinstance(value, list) else apply(value)


def description_of(mission: Mission, keys: Keys) -> str:
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


def _plain_document(value: Any, n: int, field: FieldInfo | None = None) -> Any:
    """Plain data of a value with all defaults, of a key with a type, in a mission of n agents."""
    kind = None if field is None else field.annotation
    if value is None and (model := model_of(kind)):
        fields = model.model_fields.items()
        return Absent(
            (
                k,
                _plain_document(
                    None if f.is_required() else f.get_default(call_default_factory=True), n, f
                ),
            )
            for k, f in fields
        )
    if kind is not None and isinstance(value, float):
        return next(([value] * (count or n) for listed, count in _LISTS if listed == kind), value)
    if isinstance(value, Part):
        return {
            k: _plain_document(getattr(value, k), n, f) for k, f in type(value).model_fields.items()
        }
    if isinstance(value, Mapping):
        return {key: _plain_document(inner, n) for key, inner in value.items()}
    return [_plain_document(v, n) for v in value] if isinstance(value, tuple | list) else value


def _best_matches(whole: Mapping[str, Any], steps: list[str]) -> tuple[list[tuple[Keys, Any]], int]:
    """Places, with what is there, that match as many of the first steps as any place does, and how many these are."""
    places: list[tuple[Keys, Any]] = [((), whole)]
    for depth, step in enumerate(steps):
        further = [(keys + (k,), inner) for keys, at in places for k, inner in _children(at, step)]
        if not further:
            return places, depth
        places = further
    return places, len(steps)


def _children(at: Any, step: str) -> Iterator[tuple[str | int, Any]]:
    """Keys and values of a table or a list that a step leads to; of a list with their indices from 1 as names."""
    for name, inner in at.items() if isinstance(at, dict) else ():
        if step == name or (step == ANY and not isinstance(inner, Absent)):
            yield name, inner
    for k, inner in enumerate(at) if isinstance(at, list) else ():
        if step in (ANY, f"{k + 1}"):
            yield k, inner


def _path_remedy(whole: Mapping[str, Any], at: Any, steps: list[str], depth: int) -> str:
    """Suggest a similar path that exists, or list what exists at this depth."""
    for guess in _guess_paths(whole, at, steps, depth):
        places, reached = _best_matches(whole, guess)
        if reached == len(guess) and not any(isinstance(x, dict) for _, x in places):
            words = (word if word == ANY else toml_key(word) for word in guess)
            return f"did you mean '{'.'.join(words)}'?"
    if isinstance(at, dict | list) and not at:
        return "nothing is there: write it in the mission, or remove this variation"
    if isinstance(at, dict):
        return f"keys there: {', '.join(map(str, at))}"
    if isinstance(at, list):
        return f"use an index from 1 to {len(at)}, or * for all"
    return "the path ends there; remove the rest"


def _guess_paths(
    whole: Mapping[str, Any], at: Any, steps: list[str], depth: int
) -> Iterator[list[str]]:
    """Paths that may be meant, the likeliest first."""
    before, (first, *rest) = steps[:depth], steps[depth:]
    if first.isdecimal() or first == ANY:
        yield [*before, *rest, first]  # agents.2.mass instead of agents.mass.2
    if isinstance(at, dict):
        for name, table in whole.items() if depth < 2 else ():  # a key of another table
            if isinstance(table, dict):
                yield from ([name, *way, first, *rest] for way in ((), *((k,) for k in table)))
        yield from (
            [*before, k, *rest]
            for k in difflib.get_close_matches(first, map(str, at), n=1, cutoff=0.55)
        )
