"""Collect the findings of a check, and translate the errors of pydantic into findings."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from pydantic import ValidationError

from rigidfleet._common.renamed import rename_hint
from rigidfleet._common.toml import toml_key
from rigidfleet.errors import Finding
from rigidfleet.formation.shapes import POLYGONS, SHAPES
from rigidfleet.mission.values import Part

Keys = tuple[str | int, ...]
P = TypeVar("P", bound=Part)

#: Maximum number of findings of one kind that are listed; the others are counted.
_MOST_OF_A_KIND = 8
_UNKNOWN = "unknown key"
_NONE: dict[str, Any] = {}
#: Stands for any index of a list.
_ANY = -1
#: Values for required keys with errors, so that the rest of their table can still be checked.
_STAND_IN: dict[str, Any] = {
    "mass": 1.0, "position": (0.0, 0.0, 0.0), "formation": "", "schema_version": 1, "name": "draft",
}  # fmt: skip


class FindingCollector:
    """Findings about one mission, each at a path of keys in its data.

    A path counts from 0, a message from 1: ("phases", 1) is reported as `phases[2]`.
    """

    def __init__(self, data: Mapping[str, Any], origin: str) -> None:
        self.data = data
        self.origin = origin
        self._findings: dict[tuple[str, str], Finding] = {}
        self._counts: Counter[Keys] = Counter()
        self._wrong: set[Keys] = set()

    @property
    def findings(self) -> list[Finding]:
        """All findings without repetition: of many of one kind, the first ones and the number of the others."""
        findings = [*self._findings.values()]
        for kind, n in self._counts.items():
            if n > _MOST_OF_A_KIND:
                problem = f"{n - _MOST_OF_A_KIND:,} more of this kind"
                remedy = "correct all of them"
                findings.append(Finding(self.origin, _key_path(kind), None, problem, remedy))
        return findings

    def add(self, path: Keys, problem: str, remedy: str, *value: object) -> None:
        """Record a finding. Unless a value is given, it is the one that the user wrote at the path."""
        self._wrong |= {path[:k] for k in range(1, len(path) + 1)}
        key = _key_path(path)
        if (key, problem) in self._findings:
            return
        kind = _finding_count_key(path, problem)
        if problem == _UNKNOWN or _ANY in kind:
            self._counts[kind] += 1
            if self._counts[kind] > _MOST_OF_A_KIND:
                return
        shown = value[0] if value else look_up(self.data, path)
        self._findings[key, problem] = Finding(self.origin, key, shown, problem, remedy)

    def add_unknown_key(self, path: Keys, known: Iterable[str]) -> None:
        """Record an unknown key of a table. Only the first ones get a suggestion, as finding one takes long."""
        guess = self._counts[_finding_count_key(path, _UNKNOWN)] < _MOST_OF_A_KIND
        self.add(path, *(unknown_key_in_words(path[-1], known) if guess else (_UNKNOWN, "")))

    def is_valid(self, path: Keys, *keys: str) -> bool:
        """Whether there is no finding so far at or below these keys of a table."""
        return not self._wrong or not any((*path, key) in self._wrong for key in keys)

    def tables(self, key: str) -> Sequence[Any]:
        """Return an array of tables; empty, with a finding, if it is something else."""
        tables = self.data.get(key, [])
        if isinstance(tables, list):
            return tables
        self.add((key,), "must be an array of tables", f"write [[{key}]] above each table")
        return []

    def model_class_of_kind(self, data: Any, path: Keys, kinds: Mapping[str, type[Any]]) -> Any:
        """Return the model for the ``kind`` of a table, or None with a finding."""
        choice = f"use one of {', '.join(kinds)}"
        if not isinstance(data, dict):
            self.add(path, "must be a table", f"write [[{path[0]}]] above it")
        elif "kind" not in data:
            self.add((*path, "kind"), "is missing", choice)
        elif not isinstance(data["kind"], str) or data["kind"] not in kinds:
            self.add((*path, "kind"), "unknown kind", suggest(data["kind"], kinds) or choice)
        else:
            return kinds[data["kind"]]
        return None

    def validate(
        self, kind: type[P], data: Any, path: Keys, defaults: Mapping[str, Any] = _NONE
    ) -> P | None:
        """Validate a table, with defaults of its own, and return its model; record a finding for each error.

        Keys with errors are left out, so that later checks can use the others. None if that leaves no valid model.
        """
        if not isinstance(data, dict):
            self.add(path, "must be a table", f"write [{_key_path(path)}] with its keys below it")
            return None
        data = {**defaults, **data} if defaults else data
        try:
            return kind.model_validate(data)
        except ValidationError as error:
            errors = error.errors(include_url=False)
        for error in errors:
            self._add_structural_error(error, kind, path)
        wrong = {error["loc"][0] for error in errors}
        rest = {key: value for key, value in data.items() if key not in wrong}
        needed = {key for key, field in kind.model_fields.items() if field.is_required()}
        stand_in = {key: _STAND_IN[key] for key in needed & _STAND_IN.keys()}
        try:
            return kind.model_validate(stand_in | rest)
        except ValidationError:
            return None

    def _place_of_error(
        self, error: Any, kind: type[Part], prefix: Keys
    ) -> tuple[Keys, Any, type[Part]]:
        """Path of one of pydantic's errors, the value there, and the model that has the key."""
        here, path, owner, inner = look_up(self.data, prefix, {}), prefix, kind, kind
        for step in error["loc"]:
            if isinstance(here, dict) and (step in here or error["type"] == "missing"):
                owner, here = inner, here.get(step)
                field = owner.model_fields.get(str(step))
                inner = (model_of(field.annotation) if field else None) or owner
            elif isinstance(here, list) and isinstance(step, int):
                here = here[step]
            else:
                continue  # pydantic's name of a union member, or an index into a number that stands for all agents
            path = (*path, step)
        return path, here, owner

    def _add_structural_error(self, error: Any, kind: type[Part], prefix: Keys) -> None:
        """Record one of pydantic's errors."""
        path, here, owner = self._place_of_error(error, kind, prefix)
        if error["type"] == "too_short" and len(here) > error["ctx"]["actual_length"]:
            return  # pydantic does not count entries with errors of their own
        if path == ("lqr", "attitude") and error["loc"] != path[1:]:
            return  # inherited from lqr, where it is reported
        if error["type"] == "extra_forbidden":
            self.add_unknown_key(path, owner.model_fields)
        else:
            self.add(path, *_problem_and_remedy(error, path, owner))


#: Values that users write where the format has "none".
_OFF = ("off", "no", "never", "disabled", False)


def look_up(data: Any, path: Keys, default: Any = None) -> Any:
    """Return the value at a path of keys, or the default."""
    for step in path:
        try:
            data = data[step]
        except (KeyError, IndexError, TypeError):
            return default
    return data


def suggest(word: object, known: Iterable[str]) -> str:
    """Return 'did you mean ...?' if a known word is similar, else ''."""
    import difflib

    words = {k.lower(): k for k in known}
    match = difflib.get_close_matches(str(word).lower(), words, n=1, cutoff=0.55)
    return f"did you mean '{words[match[0]]}'?" if match else ""


def suggest_shape(word: object) -> str:
    """Suggest a named shape for an unknown name, or list all of them."""
    match = suggest(word, [*SHAPES, *POLYGONS])
    meant = next((name for name in POLYGONS if f"'{name}'" in match), None)
    if meant is not None:
        return f"did you mean 'polygon' with {POLYGONS[meant]} agents?"
    return match or f"known shapes: {', '.join(SHAPES)}"


def unknown_key_in_words(key: object, known: Iterable[str]) -> tuple[str, str]:
    """Problem and remedy of an unknown key."""
    names = list(known)
    suggestion = rename_hint(key) or suggest(key, names)
    return _UNKNOWN, suggestion or f"remove it; known keys: {', '.join(names)}"


def _key_path(path: Keys) -> str:
    def step(at: str | int) -> str:
        if isinstance(at, int):
            return "[*]" if at == _ANY else f"[{at + 1}]"
        return f".{toml_key(at)}"

    return "".join(map(step, path)).removeprefix(".")


def _finding_count_key(path: Keys, problem: str) -> Keys:
    """Key by which findings are counted: their path with any index, and one key for all unknown keys of a table."""
    path = path[:-1] if problem == _UNKNOWN else path
    return tuple(_ANY if isinstance(step, int) else step for step in path)


def model_of(annotation: Any) -> type[Part] | None:
    """First model in an annotation such as `Settle | None`; None if there is none."""
    return next(_models_in_annotation(annotation), None)


def _models_in_annotation(annotation: Any) -> Iterator[type[Part]]:
    """Iterate over the models in an annotation such as `Settle | None` or `tuple[Lost, ...]`."""
    if get_origin(annotation) in (Union, UnionType, Annotated, tuple):
        for choice in get_args(annotation):
            yield from _models_in_annotation(choice)
    elif isinstance(annotation, type) and issubclass(annotation, Part):
        yield annotation


def _problem_and_remedy(error: Any, path: Keys, owner: type[Part]) -> tuple[str, str]:
    """Problem and remedy of an error of pydantic."""
    kind, context = error["type"], error.get("ctx", {})
    name = next((step for step in reversed(path) if isinstance(step, str)), "")
    field = owner.model_fields.get(name)
    meaning = f"{name}: {field.description}" if field and field.description else ""
    match kind:
        case "missing":
            return "is missing", f"add {meaning or name}"
        case "literal_error":
            words = re.findall(r"'([^']*)'", context["expected"]) or [context["expected"]]
            suggestion = rename_hint(name, error["input"]) or suggest(error["input"], words)
            usual = "none" if error["input"] in _OFF and "none" in words else words[0]
            number = "numeric, or " * (error["loc"][-1] == "word")  # a word in place of a value
            remedy = suggestion or (meaning if number else f"use {usual}")
            return f"must be {number}{context['expected']}", remedy
        case "greater_than_equal" if 0 < context["ge"] < 1 and not error["input"] > 0:
            return "must be > 0", meaning
        case "too_short" if context["min_length"] == 1:
            return "is empty", meaning
        case "too_short" | "too_long":
            count = context.get("min_length", context.get("max_length"))
            return f"must have {count} numbers, not {context['actual_length']}", meaning
    problem = _PROBLEMS.get(kind, error["msg"][:1].lower() + error["msg"][1:])
    return problem.format_map(context), meaning


_PROBLEMS = {
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "bool_type": "must be true or false",
    "string_type": "must be a string",
    "tuple_type": "must be a list",
    "model_type": "must be a table",
    "finite_number": "must be finite",
    "greater_than": "must be > {gt:g}",
    "greater_than_equal": "must be >= {ge:g}",
    "less_than": "must be < {lt:g}",
    "less_than_equal": "must be <= {le:g}",
    "string_pattern_mismatch": "has characters that are not allowed",
}
