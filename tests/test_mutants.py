"""The mutants of `mutants.py`: what they are made of exists, flights fly with it, and faults are noticed."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import mutants
import pytest

#: Of the functions that flights call as plain Python: some tests that call them, and a file in which they are.
SOME = {
    "guard": ("left_alone or share_a_push", "kernel/guard.py"),
    "monitor": ("greatest_forces or curves_in_body_axes", "kernel/monitor.py"),
}


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(Path(mutants.__file__)), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def drawn(file: str) -> list[mutants.Mutant]:
    equal = mutants.proved()
    return [x for x in mutants.draw(100, 0) if x.target.file == file and x.key not in equal]


def test_what_mutants_are_made_of_exists():
    """Files, tests, and of each proof the function with its statement."""
    trees = {x.file: ast.parse((mutants.PACKAGE / x.file).read_text()) for x in mutants.TARGETS}
    for target in mutants.TARGETS:
        assert all((mutants.ROOT / "tests" / name).is_file() for name in target.tests)
    for file, function, before, _ in mutants.proved():
        lines = ast.unparse(mutants.named(trees[file], function)).splitlines()
        assert before in [line.strip() for line in lines], (function, before)


@pytest.mark.parametrize("plain", SOME)
def test_without_a_fault_flights_fly_with_plain_python(plain, tmp_path):
    """All that is replaced is there, is called, and changes nothing: tests pass as they do with machine code."""
    tests, file = SOME[plain]
    only = str(drawn(file)[0].number)
    into = tmp_path / "results.jsonl"
    done = run("--as-is", "--only", only, "--tests", tests, "--into", str(into))
    assert done.returncode == 0, done.stderr
    reach = json.loads(into.with_suffix(f".{plain}.reach").read_text()).values()
    assert len(reach) >= 2
    assert all(of["passes"] for of in reach), done.stdout
    assert any(file == path for of in reach for path, _ in of["reaches"])


@pytest.mark.long
@pytest.mark.parametrize("plain", SOME)
def test_of_some_faults_one_is_noticed(plain, tmp_path):
    """Of those drawn in functions that two tests reach; and a fault that no test reaches is an error."""
    tests, file = SOME[plain]
    into = tmp_path / "results.jsonl"
    numbers = [str(x.number) for x in drawn(file)]
    done = run("--only", *numbers, "--tests", tests, "--into", str(into), "--most", "5")
    rows = [json.loads(line) for line in into.read_text().splitlines()]
    assert len(rows) == len(numbers)
    reached = [x for x in rows if "error" not in x]
    assert sum(x["killed"] and x["by"].startswith("tests/") for x in reached) >= 3
    assert all(x["tests"] > 0 for x in reached)
    assert len(reached) < len(rows)
    assert done.returncode == 1
    assert "no test that passes" in rows[[x in reached for x in rows].index(False)]["error"]
    assert "not tried" in done.stderr


def test_what_is_replaced_exists_and_takes_as_many_arguments():
    """A function that has another name by now, or takes others, is an error: flights would not call the new one."""

    class Owner:
        def one(self, a: int, *, last: bool) -> int:
            return a

    def other(self: Owner, b: int, *, last: bool) -> int:
        return b + 1

    mutants.replace(Owner, "one", other)
    assert Owner().one(2, last=True) == 3
    with pytest.raises(AttributeError):
        mutants.replace(Owner, "two", other)
    with pytest.raises(TypeError, match="one"):
        mutants.replace(Owner, "one", lambda self, b: b)
