"""Faults put into the code that carries the guarantee and the verdict, and whether the tests notice them.

`python tests/mutants.py` draws 100 mutants by a seed, over guard, barriers, monitor and checks in proportion to their
lines of code. Each is put into a copy of the package, and the tests that concern it run until one fails. It writes a
line of JSON for each, and lists the survivors at the end; each calls for a test, or for the proof that nothing
changes. Two processes take about half an hour. `--count`, `--seed` and `--jobs` are as they say, `--only 3 7` takes
some of those drawn, `--list` runs none.

The operators:

- compare: `<` becomes `<=`, `<=` becomes `<`, and so on; `==` becomes `!=`;
- turn: `<` becomes `>=`, and so on;
- sign: `+` becomes `-` and the reverse, or a minus goes;
- factor: `*` becomes `/` and the reverse;
- off by one: a whole number becomes the next one;
- constant: another number becomes twice as large, and 0.0 becomes 1.0;
- extreme: `min` becomes `max` and the reverse;
- logic: `and` becomes `or` and the reverse, `True` becomes `False` and the reverse;
- refuse: a condition of `if` or `while` is negated;
- drop: a statement that changes something goes: a call, `+=` and the like, `continue`, an assignment to an element.

Mutants of the kernel are not compiled. Flights are flown by the machine code of the code without faults, and call the
mutated functions as plain Python, on their own arrays (`use_plain_functions`).
"""

from __future__ import annotations

import argparse
import ast
import copy
import ctypes
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "rigidfleet"
#: Time after which a test run counts as one that fails [s]: a mutant that does not end is noticed.
LIMIT = 240.0
#: Variable that says which code plain functions fly with.
_PLAIN = "RIGIDFLEET_PLAIN_FUNCTIONS"


class Target(NamedTuple):
    """A file to mutate, the tests that concern it, and whether they fly with its functions as plain Python."""

    file: str
    tests: tuple[str, ...]
    plain: bool


_GUARD = ("tests/test_avoidance.py", "tests/test_moving.py")
_MONITOR = ("tests/test_extremes.py", "tests/test_between.py")
TARGETS = (
    Target("kernel/guard.py", _GUARD, True),
    Target("kernel/barriers.py", _GUARD, True),
    Target("kernel/monitor.py", _MONITOR, True),
    Target("assessment/checks.py", ("tests/test_assess.py", *_MONITOR[1:]), False),
)
#: Tests that start processes of their own, which would compile the mutant, or that take too long uncompiled.
NOT_PLAIN = "not large and not side_by_side and not ball and not one_obstacle and not brake_in_time and not same_seed"
#: Tests that come last, since they take longest, and examples that property tests then try.
_LAST, _EXAMPLES = "nobody_collides", 20

_EDGE = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
}
_OTHER_WAY = {
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Is: ast.IsNot,
    ast.In: ast.NotIn,
}
_SIGN, _FACTOR = {ast.Add: ast.Sub, ast.Sub: ast.Add}, {ast.Mult: ast.Div, ast.Div: ast.Mult}
_EXTREME = {"min": "max", "max": "min"}


class Site(NamedTuple):
    """A place for a fault: the node by its number in the walk over the tree, the operator, and the line."""

    node: int
    operator: str
    line: int


class Mutant(NamedTuple):
    """A fault in a file."""

    target: Target
    site: Site


# -- faults ------------------------------------------------------------------------------------------


def operators_of(node: ast.AST) -> Iterator[str]:
    """The operators that apply to a node of a function."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        kind = type(node.ops[0])
        yield from ["compare"] * (kind in _EDGE) + ["turn"] * (kind in _OTHER_WAY)
    elif isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in _SIGN:
        yield "sign"
    elif isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in _FACTOR:
        yield "factor"
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield "sign"
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield "logic"
    elif isinstance(node, ast.Constant) and isinstance(node.value, int):
        yield "off by one"
    elif isinstance(node, ast.Constant) and isinstance(node.value, float):
        yield "constant"
    elif isinstance(node, ast.Name) and node.id in _EXTREME:
        yield "extreme"
    elif isinstance(node, ast.BoolOp):
        yield "logic"
    elif isinstance(node, ast.If | ast.While):
        yield "refuse"
    if changes_something(node):
        yield "drop"


def changes_something(node: ast.AST) -> bool:
    """Whether a statement without which the code is still valid changes something."""
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Call | ast.YieldFrom)
    if isinstance(node, ast.Assign):
        targets = node.targets[0]
        ends = targets.elts if isinstance(targets, ast.Tuple) else [targets]
        return all(isinstance(end, ast.Subscript) for end in ends)
    return isinstance(node, ast.AugAssign | ast.Continue)


def sites_of(tree: ast.Module) -> list[Site]:
    """All places in the functions of a module for a fault."""
    within = {
        id(inner)
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef)
        for statement in function.body
        for inner in ast.walk(statement)
    }
    return [
        Site(number, operator, getattr(node, "lineno", 0))
        for number, node in enumerate(ast.walk(tree))
        if id(node) in within
        for operator in operators_of(node)
    ]


class _Dropped(ast.NodeTransformer):
    """Puts `pass` in the place of a statement."""

    def __init__(self, statement: ast.AST) -> None:
        self.statement = statement

    def generic_visit(self, node: ast.AST) -> ast.AST:
        return ast.Pass() if node is self.statement else super().generic_visit(node)


def mutated(tree: ast.Module, site: Site) -> ast.Module:
    """A copy of a module with a fault."""
    tree = copy.deepcopy(tree)
    node: Any = list(ast.walk(tree))[site.node]
    match site.operator:
        case "compare":
            node.ops = [_EDGE[type(node.ops[0])]()]
        case "turn":
            node.ops = [_OTHER_WAY[type(node.ops[0])]()]
        case "sign" if isinstance(node, ast.UnaryOp):
            node.op = ast.UAdd()
        case "sign":
            node.op = _SIGN[type(node.op)]()
        case "factor":
            node.op = _FACTOR[type(node.op)]()
        case "off by one":
            node.value += 1
        case "constant":
            node.value = 2.0 * node.value or 1.0
        case "extreme":
            node.id = _EXTREME[node.id]
        case "logic" if isinstance(node, ast.Constant):
            node.value = not node.value
        case "logic":
            node.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        case "refuse":
            node.test = ast.UnaryOp(ast.Not(), node.test)
        case "drop":
            tree = _Dropped(node).visit(tree)
    return ast.fix_missing_locations(tree)


def code_lines(tree: ast.Module) -> int:
    """Lines on which code of functions stands."""
    return len({site.line for site in sites_of(tree)})


def draw(count: int, seed: int) -> list[Mutant]:
    """Mutants drawn by a seed, in proportion to the lines of code of each file; no place and operator twice."""
    rng = np.random.default_rng(seed)
    trees = [ast.parse((PACKAGE / target.file).read_text()) for target in TARGETS]
    lines = np.array([code_lines(tree) for tree in trees])
    bounds = np.round(np.concatenate([[0], np.cumsum(lines)]) / lines.sum() * count).astype(int)
    mutants = []
    for target, tree, number in zip(TARGETS, trees, np.diff(bounds), strict=True):
        sites = sites_of(tree)
        mutants += [Mutant(target, sites[k]) for k in rng.permutation(len(sites))[:number]]
    return mutants


def change(mutant: Mutant) -> tuple[str, str]:
    """The statement of a fault, without and with it."""
    tree = ast.parse((PACKAGE / mutant.target.file).read_text())
    lines = [ast.unparse(x).splitlines() for x in (tree, mutated(tree, mutant.site))]
    pairs = [(a.strip(), b.strip()) for a, b in zip(*lines, strict=False) if a != b]
    return pairs[0] if pairs else ("", "")


# -- a mutant among the tests ------------------------------------------------------------------------


def copy_to(folder: Path) -> None:
    """A copy of the package with its tests."""
    for name in ("src", "tests", "benchmarks", "examples"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)


def test(mutant: Mutant | None, target: Target, folder: Path) -> dict[str, Any]:
    """Run the tests that concern a mutant in a copy of the package; without a mutant, those of the code as it is."""
    file = folder / "src" / "rigidfleet" / target.file
    source = (PACKAGE / target.file).read_text()
    if mutant is not None:
        file.write_text(ast.unparse(mutated(ast.parse(source), mutant.site)))
    path = os.pathsep.join([str(folder / "src"), str(folder / "tests")])
    env = os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    options = ["-q", "-x", "-p", "no:cacheprovider", *target.tests]
    if target.plain:
        env |= {"NUMBA_DISABLE_JIT": "1", _PLAIN: digest()}
        options += ["-p", "mutants", "-k", NOT_PLAIN]
    begun = time.monotonic()
    try:
        done = subprocess.run(
            [sys.executable, "-m", "pytest", *options],
            cwd=folder, env=env, capture_output=True, text=True, timeout=LIMIT, check=False,
        )  # fmt: skip
        code, words = done.returncode, done.stdout.splitlines()
    except subprocess.TimeoutExpired:
        code, words = -1, []
    finally:
        file.write_text(source)
    failed = [line for line in words if line.startswith(("FAILED", "ERROR"))] or words[-1:]
    return {
        "killed": code != 0,
        "by": failed[0] if failed else "",
        "s": round(time.monotonic() - begun),
    }


def run(mutants: list[tuple[int, Mutant]], jobs: int) -> list[tuple[int, Mutant]]:
    """Test mutants, so many at a time; write what came of each, and return the survivors."""
    folders: SimpleQueue[Path] = SimpleQueue()
    survivors = []
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(jobs) as pool:
        for job in range(jobs):
            copy_to(Path(name, str(job)))
            folders.put(Path(name, str(job)))

        def one(numbered: tuple[int, Mutant]) -> None:
            number, mutant = numbered
            folder = folders.get()
            try:
                outcome = test(mutant, mutant.target, folder)
            finally:
                folders.put(folder)
            print(json.dumps(described(number, mutant) | outcome), flush=True)
            if not outcome["killed"]:
                survivors.append(numbered)

        list(pool.map(one, mutants))
    return sorted(survivors, key=lambda numbered: numbered[0])


def described(number: int, mutant: Mutant) -> dict[str, Any]:
    """A mutant, to read."""
    before, after = change(mutant)
    place = f"{mutant.target.file}:{mutant.site.line}"
    return {
        "number": number,
        "at": place,
        "operator": mutant.site.operator,
        "from": before,
        "to": after,
    }


# -- functions as plain Python -----------------------------------------------------------------------


def digest() -> str:
    """That of the kernel's sources as they are, by which its machine code is kept."""
    from rigidfleet.kernel.compiler import cache
    from rigidfleet.kernel.engine import native

    native.sampled_library()  # it and what it needs is in the cache from now on
    return cache._digest()


def use_plain_functions(digest: str) -> None:
    """Fly with the machine code of the sources with this digest, but with guard and monitor as plain Python."""
    from rigidfleet.kernel import guard, monitor
    from rigidfleet.kernel.compiler import cache
    from rigidfleet.kernel.engine import native, packing, sampled

    sources: Any = cache
    sources._digest = lambda: digest

    def record(_: int, p: Any, w: Any, segment: int, out: int) -> None:
        of = packing.pack(p).address, packing.pack(w).address
        native._code().record(*of, segment, out)

    def bound_moves(watch: Any, problem: Any, state: Any) -> None:
        monitor.bound_moves(problem, state, watch.monitor)

    def distances(watch: Any, problem: Any, state: Any, first: int, end: int) -> None:
        monitor.watch_distances(first, end, problem, state, watch.monitor)

    def forces(watch: Any, problem: Any, work: Any, state: Any, *, last: bool) -> None:
        monitor.watch_forces(int(last), problem, work, state, watch.monitor)

    def avoid(*addresses: int) -> int:
        kept = (*sampled._last.packed, *packing._last.packed.values())
        of = {x.address: x.of for x in kept}
        flight, state, avoidance = (of[x] for x in addresses[:3])
        problem, work = (of[int(x)] for x in avoidance.law)
        with np.errstate(all="ignore"):
            return int(guard.avoid(problem, work, flight, state, avoidance))

    monitor.call_recorder = record
    for function in (bound_moves, distances, forces):
        setattr(native.Watch, function.__name__, function)
    word = ctypes.c_int64
    call = ctypes.CFUNCTYPE(word, *(word,) * 4)(avoid)
    address = ctypes.cast(call, ctypes.c_void_p).value
    library = native.Library(avoid=call, addresses={"avoid": address}, unkept=None)
    native._loaded["avoidance"] = library


@pytest.hookimpl(trylast=True)
def pytest_configure() -> None:
    """Have the tests of a mutant of the kernel fly with its functions; one example that fails is enough."""
    from hypothesis import Phase, settings

    if kept := os.environ.get(_PLAIN):
        use_plain_functions(kept)
        phases = Phase.explicit, Phase.generate
        settings.register_profile(
            "mutants", settings.default, max_examples=_EXAMPLES, phases=phases
        )
        settings.load_profile("mutants")


def pytest_collection_modifyitems(items: list[Any]) -> None:
    """Run the tests that take longest at the end: few mutants come so far."""
    items.sort(key=lambda item: _LAST in item.name)


def main() -> None:
    """Draw mutants, test them and list the survivors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", type=int, nargs="*")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--as-is", action="store_true", help="run the tests without a fault")
    given = parser.parse_args()
    if given.as_is:
        with tempfile.TemporaryDirectory() as name:
            copy_to(Path(name))
            for target in TARGETS:
                print(
                    json.dumps({"file": target.file} | test(None, target, Path(name))), flush=True
                )
        return
    mutants = [
        x for x in enumerate(draw(given.count, given.seed)) if not given.only or x[0] in given.only
    ]
    if given.list:
        for numbered in mutants:
            print(json.dumps(described(*numbered)))
        return
    survivors = run(mutants, given.jobs)
    print(f"{len(mutants) - len(survivors)} of {len(mutants)} killed; survivors:")
    for numbered in survivors:
        print(json.dumps(described(*numbered)))


if __name__ == "__main__":
    main()
