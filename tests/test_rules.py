"""Rules of a mission: each is broken by an input, and says where, what the problem is, and the remedy."""

import ast
import sys
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from rigidfleet.errors import MissionError
from rigidfleet.mission import KINDS, check, findings, rules


class Case(NamedTuple):
    """A finding in words, and a mission that leads to it."""

    key: str
    problem: str
    remedy: str
    mission: dict[str, Any]


def many_knots() -> list[Any]:
    """Trajectories of 400 vehicles, each with 70 pieces whose knots are those of no other."""
    return [[[1.0 + k * 1e-5, *[0.0] * 4]] * 70 for k in range(400)]


RULES = (
    Path(__file__).with_name("rules.toml").read_text("utf-8").replace("{KINDS}", ", ".join(KINDS))
)
CASES = [
    Case(**rule | {"mission": tomllib.loads(rule["mission"])})
    for rule in tomllib.loads(RULES)["rule"]
]
# Those that only large missions break.
CASES += [
    Case(
        "formations", "has 201 entries; the maximum is 200", "split them into several missions",
        {"formations": {f"f{k}": {} for k in range(201)}},
    ),
    Case(
        "formations", "51 formations of 100,000 agents have 5,100,000 slots; the maximum is 5,000,000",
        "use fewer formations, or fewer agents",
        {"agents": {"position": {"count": 100_000}}, "formations": {f"f{k}": {} for k in range(51)}},
    ),
    Case(
        "obstacles[1].heights", "has 40,200 heights; the maximum is 40,000", "use a coarser grid",
        {"obstacles": [{"kind": "heights", "spacing": 1.0, "heights": [[0.0] * 201] * 200}]},
    ),
    Case(
        "phases[1].trajectories", "400 trajectories with 28,001 times in all are more than 10,000,000 coefficients",
        "give all vehicles the same times, or fewer",
        {"phases": [{"kind": "follow", "trajectories": many_knots()}]},
    ),
]  # fmt: skip

Place = tuple[str, int]


def places_of_rules() -> dict[Place, Place]:
    """Each line of each place in the code that makes a finding, by file and line, and the first line of the place."""
    places = {}
    for file in Path(rules.__file__).parent.glob("*.py"):
        for call in ast.walk(ast.parse(file.read_text("utf-8"))):
            if (
                isinstance(call, ast.Call)
                and ast.unparse(call.func) in ("Breach", "m.add", "self.add")
                and file.name != "rules.py"
            ):
                lines = range(call.lineno, (call.end_lineno or call.lineno) + 1)
                places |= {(file.name, line): (file.name, call.lineno) for line in lines}
    return places


@pytest.fixture(scope="module")
def checked() -> tuple[list[list[tuple[str, str, str]]], set[Place]]:
    """Findings of each case, and the lines that made one."""
    lines: set[Place] = set()

    def note() -> None:
        frame = sys._getframe(2)
        lines.add((Path(frame.f_code.co_filename).name, frame.f_lineno))

    new, add = rules.Breach.__new__, findings.FindingCollector.add

    def noted_new(cls: Any, *args: Any) -> Any:
        note()
        return new(cls, *args)

    def noted_add(self: Any, *args: Any) -> None:
        note()
        add(self, *args)

    results = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rules.Breach, "__new__", noted_new)
        patch.setattr(findings.FindingCollector, "add", noted_add)
        for case in CASES:
            with pytest.raises(MissionError) as error:
                check.check_parts(case.mission, "a mission")
            results.append([(f.key, f.problem, f.remedy) for f in error.value.findings])
    return results, lines


@pytest.mark.parametrize(
    "number", range(len(CASES)), ids=lambda k: f"{CASES[k].key}-{CASES[k].problem[:30]}"
)
def test_a_broken_rule_is_a_finding(number, checked):
    """It stands at its key, with its problem and its remedy, word for word."""
    case = CASES[number]
    assert (case.key, case.problem, case.remedy) in checked[0][number]


def test_every_rule_has_an_input(checked):
    """Each place in the code that makes a finding is reached by a case of this module."""
    places = places_of_rules()
    assert len(set(places.values())) > 190
    idle = set(places.values()) - {places[line] for line in checked[1] if line in places}
    assert not idle, f"add a mission to rules.toml for the rules at {sorted(idle)}"


def test_a_rule_takes_few_lines():
    """The functions that have the rules take at most 6.5 lines for each."""
    lines, number = 0, 0
    for file in Path(rules.__file__).parent.glob("*.py"):
        own = {line for name, line in places_of_rules() if name == file.name}
        number += len({first for name, first in places_of_rules().values() if name == file.name})
        nodes = ast.walk(ast.parse(file.read_text("utf-8")))
        spans = [range(f.lineno, (f.end_lineno or 0) + 1) for f in nodes if isinstance(f, ast.FunctionDef)]  # fmt: skip
        lines += len(set().union(*(span for span in spans if own.intersection(span))))
    assert lines <= 6.5 * number, f"{lines} lines for {number} rules"
