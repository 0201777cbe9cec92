"""What others rely on keeps its name: functions, keys, options, variables, and results of an earlier state."""

import importlib
import inspect
import json
import lzma
import re
import warnings
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import pytest

import rigidfleet as rf
from rigidfleet.cli import codes
from rigidfleet.cli.app import main
from rigidfleet.mission import json_schema
from rigidfleet.result import VARIABLES
from rigidfleet.sweep.metrics import METRICS

DATA = Path(__file__).parent / "data"
#: Names of an earlier state of the development (6ae505d): `rf.__all__`, what docs/api lists, mathematics and physics.
PUBLIC: dict[str, Any] = json.loads((DATA / "public_names.json").read_text())
#: Members that are gone, with the reason why no alias gives what they gave.
GONE = {
    "rigidfleet.interchange.Format.extra": "an extra of rigidfleet; what pip installs is another name, `distribution`",
    "rigidfleet.mission.kinds.Attitude.angles": "only phases are made, and `angles` of each works with a warning",
    "rigidfleet.kernel.engine.codegen.UnrolledProblem": "a layout in memory that the machine code no longer reads",
    "rigidfleet.kernel.engine.codegen.Tables": "as above",
    "rigidfleet.kernel.engine.codegen.interleaved": "as above",
    "rigidfleet.kernel.problem.cleared": "a workspace is made anew, of parts that `cleared` did not know",
    "rigidfleet.mission.schema.Links": "a mission with the table has a `Network`, which stands beside disturbances",
    "rigidfleet.mission.schema.Disturbances.links": "as above; the table itself works with a warning",
}


def there(name: str) -> Any:
    """The object of a dotted name."""
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        try:
            thing = importlib.import_module(".".join(parts[:k]))
        except ImportError:
            continue
        for part in parts[k:]:
            thing = getattr(thing, part)
        return thing
    raise ImportError(name)


def members(kind: type) -> set[str]:
    return {
        name
        for base in kind.__mro__
        for name in (*vars(base), *inspect.get_annotations(base))
        if not name.startswith("_")
    }


@pytest.mark.parametrize("name", sorted(PUBLIC["names"].keys() - GONE.keys()))
def test_public_names_stay(name):
    """Every public name is where it was, with all its members."""
    thing, fields = there(name), PUBLIC["names"][name]
    if fields is not None:
        missing = {f"{name}.{x}" for x in set(fields) - members(thing)}
        assert missing <= GONE.keys()


@pytest.mark.parametrize("name", sorted(PUBLIC["members of classes"].keys() - GONE.keys()))
def test_members_of_classes_stay(name):
    """A value or a function that a class has without an object is there; by an earlier name, with a warning here."""
    kind = there(name)
    for member in PUBLIC["members of classes"][name]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            value = getattr(kind, member)
        assert not isinstance(value, property | cached_property), f"{name}.{member}"
        if isinstance(inspect.getattr_static(kind, member), property):  # an earlier name
            (warning,) = caught
            new = re.fullmatch(rf"{member} is now (\w+)", str(warning.message))
            assert new, f"{name}.{member}"
            assert value == getattr(kind, new[1])
            assert warning.filename == __file__


def test_variables_metrics_and_exit_codes_stay():
    """Variables of a result, metrics of a sweep's store and exit codes are those of before, and more."""
    assert set(PUBLIC["result variables"]) <= VARIABLES.keys()
    assert set(PUBLIC["metrics"]) <= METRICS.keys()
    assert all(getattr(codes, name) == code for name, code in PUBLIC["exit codes"].items())


def test_keys_of_missions_stay():
    """Every key of every table of a mission is in the schema."""
    schema = json_schema()

    def keys(part: dict[str, Any], name: str) -> Iterator[str]:
        yield from (f"{name}.{key}" for key in part.get("properties", ()))
        for inner, definition in part.get("$defs", {}).items():
            yield from keys(definition, inner)

    gone = {key for key in PUBLIC["mission keys"] if key.startswith("Links.")}
    gone |= {
        "Disturbances.links"
    }  # not in the schema, which editors complete; test_network.py has it work
    assert set(PUBLIC["mission keys"]) - gone <= set(keys(schema, "Mission"))


@pytest.mark.parametrize("verb", PUBLIC["options"])
def test_options_stay(verb, capsys):
    """Every option of every verb stands in its help."""
    main([verb, "--help"])
    shown = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", capsys.readouterr().out))
    assert set(PUBLIC["options"][verb]) <= shown


def test_keys_of_json_stay(tmp_path, capsys):
    """`--json` of run, check and assess has every key that it had."""

    def paths(data: Any, at: str = "") -> Iterator[str]:
        if isinstance(data, dict):
            for key, value in data.items():
                yield f"{at}.{key}"
                yield from paths(value, f"{at}.{key}")
        elif isinstance(data, list):
            for value in data:
                yield from paths(value, f"{at}[]")

    keys: dict[str, set[str]] = {"run": set(), "check": set(), "assess": set()}
    for name in ("narrow-passage", "windy-passage", "passage-quadrotors"):
        folder = str(tmp_path / name)
        for words in (
            ["run", name, "--no-figures", "--out", folder],
            ["check", name],
            ["assess", f"{folder}/{name}.nc"],
        ):
            main([*words, "--json"])
            keys[words[0]] |= set(paths(json.loads(capsys.readouterr().out)))
    for verb, before in PUBLIC["json"].items():
        assert set(before) <= keys[verb], verb


def test_an_earlier_result_is_judged_alike(tmp_path):
    """A result that an earlier state wrote loads, and has the same verdict, number by number."""
    file = tmp_path / "earlier.nc"
    file.write_bytes(lzma.decompress((DATA / "earlier_result.nc.xz").read_bytes()))
    verdict = rf.assess(file).to_dict()
    earlier = json.loads((DATA / "earlier_verdict.json").read_text())
    assert verdict["passed"] == earlier["passed"]
    now = {(c["check"], c["phase"], c["who"]): c for c in verdict["checks"]}
    for check in earlier["checks"]:
        same = now[check["check"], check["phase"], check["who"]]
        for key, value in check.items():
            number = isinstance(value, float)
            assert same[key] == (pytest.approx(value, rel=1e-12) if number else value), key
