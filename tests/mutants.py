"""Faults put into the code that carries the guarantee and the verdict, and whether the tests notice them.

`python tests/mutants.py --into FILE` draws 100 mutants by a seed, over guard, barriers, monitor and checks in
proportion to their lines of code, and tests each. It writes a line of JSON for each into the file, goes on there if it
was stopped, tests survivors again, and lists those that are left. Each calls for a test, or for an entry in
`mutants.toml` with the proof that nothing changes. `--count`, `--seed` and `--jobs` are as they say, a mutant on which
the tests have spent `--most` seconds survives, `--only 3 7` takes some of those drawn, `--tests` some of the tests, as
pytest's `-k` does, `--list` runs none, and `--as-is` tells which tests pass without a fault, and how long they take.

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

How it is done: a process collects the tests that concern a file, and runs each once to learn which of its functions it
calls. For a mutant, it forks, puts the code of the changed function in the place of the old one, and runs the tests
that call it, the quickest first, until one fails. Nothing is compiled: flights are flown by the machine code of the
code without faults, and call the functions under test as plain Python, on their own arrays (`fly_with`). Tests that
fail or take too long in this way without a fault are left out. Time is that of the processor.

What says nothing of the tests is an error, and the command ends with 1: a mutant that no test reaches, or that cannot
be tried; more than a tenth of the tests that fail without a fault; what `fly_with` replaces and is not there.
"""

from __future__ import annotations

import argparse
import ast
import copy
import ctypes
import hashlib
import importlib
import inspect
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "rigidfleet"
#: Processor time from which on a test is left out [s].
LONGEST = 3.0
#: Processor time after which a test with a fault counts as one that does not end: so many times its own, and more [s].
TIMES, MORE = 4.0, 3.0
#: Share of the tests of a file that may fail without a fault: some few need the compiler.
FAILING = 0.1
#: Examples that property tests try.
EXAMPLES = 20
#: Variable with what a process that tests mutants is to do.
_TASK = "RIGIDFLEET_MUTANTS"


class Target(NamedTuple):
    """A file to mutate, the tests that concern it, and which functions flights call as plain Python."""

    file: str
    tests: tuple[str, ...]
    plain: str


_GUARD = ("test_guard.py", "test_avoidance.py", "test_moving.py")
_MONITOR = ("test_monitor.py", "test_between.py", "test_trajectories.py")
TARGETS = (
    Target("kernel/guard.py", _GUARD, "guard"),
    Target("kernel/barriers.py", _GUARD, "guard"),
    Target("kernel/monitor.py", _MONITOR, "monitor"),
    Target(
        "assessment/checks.py",
        (
            "test_assess.py",
            "test_assess_files.py",
            "test_losses.py",
            "test_quantities.py",
            "test_spans.py",
            "test_vertical.py",
            *_MONITOR[1:],
        ),
        "",
    ),
)

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


def mutated(function: ast.FunctionDef, original: ast.AST, site: Site) -> ast.FunctionDef:
    """A copy of a function with a fault at one of its nodes, ``original``."""
    copies: dict[int, Any] = {}
    function = copy.deepcopy(function, copies)
    node: Any = copies[id(original)]
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
            function = _Dropped(node).visit(function)
    return ast.fix_missing_locations(function)


class Mutant(NamedTuple):
    """A fault in a file: its number among those drawn, the function, and its statement without and with the fault."""

    number: int
    target: Target
    site: Site
    function: str
    before: str
    after: str

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What it is, wherever it stands."""
        return self.target.file, self.function, self.before, self.after

    def to_dict(self) -> dict[str, Any]:
        """A mutant, to read."""
        file, function, before, after = self.key
        return {
            "number": self.number, "file": file, "line": self.site.line, "function": function,
            "operator": self.site.operator, "from": before, "to": after,
        }  # fmt: skip


def code_lines(tree: ast.Module) -> int:
    """Lines on which code of functions stands."""
    return len({site.line for site in sites_of(tree)})


@cache
def draw(count: int, seed: int) -> list[Mutant]:
    """Mutants drawn by a seed, in proportion to the lines of code of each file; no place and operator twice."""
    rng = np.random.default_rng(seed)
    trees = [ast.parse((PACKAGE / target.file).read_text()) for target in TARGETS]
    lines = np.array([code_lines(tree) for tree in trees])
    bounds = np.round(np.concatenate([[0], np.cumsum(lines)]) / lines.sum() * count).astype(int)
    mutants: list[Mutant] = []
    for target, tree, number in zip(TARGETS, trees, np.diff(bounds), strict=True):
        sites, nodes = sites_of(tree), list(ast.walk(tree))
        for k in rng.permutation(len(sites))[:number]:
            function = function_at(tree, sites[k].line)
            changed = mutated(function, nodes[sites[k].node], sites[k])
            texts = [ast.unparse(x).splitlines() for x in (function, changed)]
            pairs = [(a.strip(), b.strip()) for a, b in zip(*texts, strict=False) if a != b]
            mutants.append(
                Mutant(len(mutants), target, sites[k], function.name, *(pairs or [("", "")])[0])
            )
    return mutants


def function_at(tree: ast.Module, line: int) -> ast.FunctionDef:
    """The function of a module that a line is in."""
    return next(
        x
        for x in tree.body
        if isinstance(x, ast.FunctionDef) and x.lineno <= line <= (x.end_lineno or 0)
    )


def named(tree: ast.Module, name: str) -> ast.FunctionDef:
    """The function of a module with a name."""
    return next(x for x in tree.body if isinstance(x, ast.FunctionDef) and x.name == name)


def proved() -> dict[tuple[str, str, str, str], str]:
    """Mutants that change nothing, each with the reason."""
    table = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
    return {(x["file"], x["function"], x["from"], x["to"]): x["reason"] for x in table["equal"]}


def put_in(mutant: Mutant) -> None:
    """Put the code of a function with a fault in the place of its own."""
    path = PACKAGE / mutant.target.file
    tree = ast.parse(path.read_text())
    node = list(ast.walk(tree))[mutant.site.node]
    function = mutated(function_at(tree, mutant.site.line), node, mutant.site)
    every = compile(ast.Module([function], []), str(path), "exec").co_consts
    code = next(x for x in every if getattr(x, "co_name", None) == mutant.function)
    name = "rigidfleet." + mutant.target.file.removesuffix(".py").replace("/", ".")
    getattr(importlib.import_module(name), mutant.function).__code__ = code


# -- tests in processes of their own -----------------------------------------------------------------


def forked(tasks: list[Any], work: Callable[[Any, Path], None], jobs: int) -> Iterator[Any]:
    """Do work on each task in a process of its own; what it wrote of it (None: nothing), and its time [s]."""
    running: dict[int, tuple[Any, Path]] = {}
    waiting = list(tasks)
    with tempfile.TemporaryDirectory() as folder:
        while waiting or running:
            while waiting and len(running) < jobs:
                task, out = waiting.pop(0), Path(folder, str(len(waiting)))
                sys.stdout.flush()
                if (pid := os.fork()) == 0:
                    null = os.open(os.devnull, os.O_WRONLY)
                    for stream in (1, 2):
                        os.dup2(null, stream)
                    try:
                        work(task, out)
                    except BaseException as error:  # not of a test: pytest catches those
                        out.write_text(json.dumps({"error": repr(error)}))
                    finally:
                        os._exit(0)
                running[pid] = task, out
            pid, _, used = os.wait4(-1, 0)
            task, out = running.pop(pid)
            wrote = json.loads(out.read_text()) if out.exists() else None
            yield task, wrote, round(used.ru_utime + used.ru_stime, 2)


def passes(session: pytest.Session, item: pytest.Item) -> bool:
    """Whether a test passes; one that is skipped does."""
    failed = session.testsfailed
    item.config.hook.pytest_runtest_protocol(item=item, nextitem=None)
    return session.testsfailed == failed


def limit_time(seconds: float, out: Path, words: str) -> None:
    """End this process after so much of its time [s], with these words; machine code that hangs a little later."""

    def end(*_: Any) -> None:
        out.write_text(words)
        os._exit(0)

    signal.signal(signal.SIGPROF, end)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    used = resource.getrusage(resource.RUSAGE_SELF)
    most = int(used.ru_utime + used.ru_stime + seconds) + 5
    resource.setrlimit(resource.RLIMIT_CPU, (most, resource.getrlimit(resource.RLIMIT_CPU)[1]))


def reach_of(
    session: pytest.Session, files: list[str], jobs: int, kept: Path | None
) -> dict[str, Any]:
    """Of each test: whether it passes, how long it takes [s], and the functions of files that it calls."""
    read = *sorted(PACKAGE.rglob("*.py")), Path(__file__)
    sources = hashlib.sha256(b"".join(x.read_bytes() for x in read))

    def path_of_keys(item: pytest.Item) -> str:
        """Name of a test with the code that it was known for: that of the package, of this file and of its own."""
        digest = sources.copy()
        digest.update(item.path.read_bytes())
        return f"{digest.hexdigest()[:16]} {item.nodeid}"

    known = json.loads(kept.read_text()) if kept and kept.exists() else {}
    reach = {
        item.nodeid: known[path_of_keys(item)]
        for item in session.items
        if path_of_keys(item) in known
    }
    paths = {str(PACKAGE / file): file for file in files}

    def learn(item: pytest.Item, out: Path) -> None:
        functions: set[tuple[str, str]] = set()

        def trace(frame: Any, event: str, _: Any) -> None:
            if frame.f_code.co_filename in paths:
                functions.add((paths[frame.f_code.co_filename], frame.f_code.co_name))

        limit_time(LONGEST, out, json.dumps({"passes": False, "why": "too long"}))
        threading.settrace(trace)
        sys.settrace(trace)
        begun = time.process_time()
        done = passes(session, item)
        sys.settrace(None)
        wrote = {"passes": done, "why": "" if done else "fails", "reaches": sorted(functions)}
        out.write_text(json.dumps(wrote | {"s": time.process_time() - begun}))

    missing = [item for item in session.items if item.nodeid not in reach]
    for item, wrote, took in forked(missing, learn, jobs):
        reach[item.nodeid] = {"passes": False, "why": "died", "s": took, "reaches": []} | (
            wrote or {}
        )
        known[path_of_keys(item)] = reach[item.nodeid]
    if kept:
        kept.write_text(json.dumps(known))
    return reach


def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """Instead of running the tests once, run those that reach a mutant with it, for each mutant."""
    if _TASK not in os.environ:
        return None
    if session.testsfailed:
        raise session.Interrupted(f"{session.testsfailed} files of tests cannot be read")
    task = json.loads(os.environ[_TASK])
    targets = [TARGETS[k] for k in task["targets"]]
    into = Path(task["into"]) if task["into"] else None
    kept = into and into.with_suffix(f".{targets[0].plain or 'checks'}.reach")
    reach = reach_of(session, [x.file for x in targets], task["jobs"], kept)
    failing = [name for name, of in reach.items() if of["why"] in ("fails", "died")]
    if task["as_is"]:
        for name, of in reach.items():
            print(
                f"{'passes' if of['passes'] else of['why']:8} {of.get('s', 0.0):6.2f} s {name}",
                flush=True,
            )
    if len(failing) > FAILING * len(reach):
        raise session.Interrupted(
            f"{len(failing)} of {len(reach)} tests fail without a fault, as {failing[0]}"
        )
    if task["as_is"]:
        return True
    items = {item.nodeid: item for item in session.items}

    def test(mutant: Mutant, out: Path) -> None:
        here = [mutant.target.file, mutant.function]
        names = [
            name for name, of in reach.items() if of["passes"] and here in map(list, of["reaches"])
        ]
        put_in(mutant)
        if not names:
            raise LookupError(f"no test that passes without a fault reaches {mutant.function}")
        by, begun = "", time.process_time()
        for name in sorted(names, key=lambda x: reach[x]["s"]):
            if time.process_time() - begun > task["most"]:
                break
            words = json.dumps({"killed": True, "by": f"time: {name}", "tests": len(names)})
            limit_time(TIMES * reach[name]["s"] + MORE, out, words)
            if not passes(session, items[name]):
                by = name
                break
        out.write_text(json.dumps({"killed": by != "", "by": by, "tests": len(names)}))

    chosen = [x for x in draw(task["count"], task["seed"]) if x.number in task["numbers"]]
    for mutant, wrote, took in forked(chosen, test, task["jobs"]):
        words = wrote or {"killed": True, "by": "died"}
        outcome = {"killed": False, "by": "", "tests": 0} | words
        line = json.dumps(mutant.to_dict() | outcome | {"s": took})
        print(line, flush=True)
        if into:
            with into.open("a") as stream:
                stream.write(line + "\n")
    return True


# -- functions as plain Python -----------------------------------------------------------------------


def replace(owner: Any, name: str, function: Any) -> None:
    """Put a function in the place of one that exists and takes as many arguments, so that it is called.

    Raises
    ------
    AttributeError, TypeError
        There is no such function, or it takes others.
    """

    def parameters(of: Any) -> list[Any]:
        every = inspect.signature(of).parameters.values()
        return [(x.kind, x.default) for x in every if x.name != "_context"]  # the compiler's

    takes, instead = parameters(getattr(owner, name)), parameters(function)
    if takes != instead:
        raise TypeError(f"{name} of {owner.__name__} takes other arguments: {takes}, not {instead}")
    setattr(owner, name, function)


def fly_with(plain: str) -> None:
    """Fly with machine code, but with guard or monitor as plain Python."""
    from rigidfleet.kernel.compiler import jit

    def compiled_copy(function: Any, name: str, **instead: Any) -> Any:
        return jit._copy_function(function, name, instead)

    replace(jit, "compiled_copy", compiled_copy)
    from rigidfleet.kernel import guard, monitor, obstacles
    from rigidfleet.kernel.engine import native, packing

    word = ctypes.c_int64
    kind = ctypes.CFUNCTYPE(word, *(word,) * 4)

    def record(address: int, p: Any, w: Any, segment: int, out: int) -> None:
        kind(address)(packing.pack(p).address, packing.pack(w).address, segment, out)

    def write_first_step_change_bounds(watch: Any, problem: Any, state: Any) -> None:
        monitor.write_first_step_change_bounds(problem, state, watch.monitor)

    def search_distances(watch: Any, problem: Any, state: Any, first: int, end: int) -> None:
        monitor.watch_trail_distances(first, end, problem, state, watch.monitor)

    def search_clearances(
        watch: Any, problem: Any, state: Any, first: int, end: int, s: Any
    ) -> None:
        for step in range(first, end):
            row = monitor.trail_row_of(step, state)
            t, h = state.trail.clock[row]
            obstacles.watch_clearances(state.trail.points[row], t, h, problem, s, watch.monitor)

    def search_forces(watch: Any, problem: Any, work: Any, state: Any, *, last: bool) -> None:
        monitor.watch_forces(int(last), problem, work, state, watch.monitor)

    def avoid(*addresses: int) -> int:
        last = packing._last.packed.values()
        of = {x.address: x.of for x in last if isinstance(x, packing.Packed)}
        flight, state, avoidance = (of[x] for x in addresses[:3])
        problem, work = (of[int(x)] for x in avoidance.law)
        with np.errstate(all="ignore"):
            return int(guard.correct_forces(problem, work, flight, state, avoidance))

    replace(native.Watch, "search_clearances", search_clearances)
    if plain == "monitor":
        replace(monitor, "call_recorder", record)
        for function in (write_first_step_change_bounds, search_distances, search_forces):
            replace(native.Watch, function.__name__, function)
    else:
        call = kind(avoid)
        address = ctypes.cast(call, ctypes.c_void_p).value
        library = native.Library(avoid=call, addresses={"avoid": address})
        native._loaded["avoidance"] = library


@pytest.hookimpl(trylast=True)
def pytest_configure() -> None:
    """Have the tests of a mutant of the kernel fly with its functions; one example that fails is enough."""
    from hypothesis import Phase, settings

    if _TASK in os.environ:
        if plain := TARGETS[json.loads(os.environ[_TASK])["targets"][0]].plain:
            fly_with(plain)
        phases = Phase.explicit, Phase.generate
        settings.register_profile("mutants", settings.default, max_examples=EXAMPLES, phases=phases)
        settings.load_profile("mutants")


def test_in_processes(numbers: set[int], given: argparse.Namespace) -> bool:
    """Test the mutants with these numbers, and return whether that was possible; the same tests share a process."""
    possible = True
    for plain in dict.fromkeys(target.plain for target in TARGETS):
        targets = [k for k, target in enumerate(TARGETS) if target.plain == plain]
        of_them = {TARGETS[k].file for k in targets}
        mine = [
            x.number
            for x in draw(given.count, given.seed)
            if x.number in numbers and x.target.file in of_them
        ]
        if not mine:
            continue
        task = vars(given) | {"targets": targets, "numbers": mine}
        env = os.environ | {
            "PYTHONPATH": str(ROOT / "tests"), "OPENBLAS_NUM_THREADS": "1", _TASK: json.dumps(task),
        }  # fmt: skip
        if plain:
            # What flies must be in the cache already: this process cannot compile.
            build = "from rigidfleet.kernel.engine import native as n; n.library('sampled'); n.library('avoidance')"
            subprocess.run([sys.executable, "-c", build], check=True)
            env["NUMBA_DISABLE_JIT"] = "1"
        files = dict.fromkeys(f"tests/{name}" for k in targets for name in TARGETS[k].tests)
        options = ["-q", "-q", "-s", "-p", "mutants", "-p", "no:cacheprovider", "-p", "no:xdist"]
        options += ["-k", given.tests] if given.tests else []
        ran = subprocess.run(
            [sys.executable, "-m", "pytest", *options, *files], cwd=ROOT, env=env, check=False
        )
        possible &= ran.returncode == 0
    return possible


def main() -> int:
    """Draw mutants, test them and list the survivors; return 1 where that says nothing of the tests, else 0."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", type=int, nargs="*")
    parser.add_argument("--tests", default="", help="an expression, as pytest's -k takes it")
    parser.add_argument("--into", help="file of results, which are kept")
    parser.add_argument("--most", type=float, default=30.0, help="processor time of a mutant [s]")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--as-is", action="store_true", help="run the tests without a fault")
    given = parser.parse_args()
    mutants = [x for x in draw(given.count, given.seed) if not given.only or x.number in given.only]
    if given.list:
        for mutant in mutants:
            print(json.dumps(mutant.to_dict()))
        return 0
    into = Path(given.into or Path(tempfile.mkdtemp(), "mutants.jsonl")).resolve()
    given.into = str(into)
    equal = proved()
    rows = [json.loads(line) for line in into.read_text().splitlines()] if into.exists() else []
    done = {(x["number"], x["file"], x["function"], x["from"], x["to"]): x for x in rows}
    killed = {name for name, row in done.items() if row["killed"]}  # survivors are tested again
    left = {x.number for x in mutants if x.key not in equal and (x.number, *x.key) not in killed}
    possible = test_in_processes(left, given)
    if given.as_is:
        return int(not possible)
    rows = [json.loads(line) for line in into.read_text().splitlines()] if into.exists() else []
    done = {(x["number"], x["file"], x["function"], x["from"], x["to"]): x for x in rows}
    judged = [done[x.number, *x.key] for x in mutants if (x.number, *x.key) in done]
    untried = sorted(left - {x["number"] for x in judged if "error" not in x})
    same = sum(x.key in equal for x in mutants)
    killed = sum(x["killed"] for x in judged)
    slow = sum(x["by"].startswith("time") for x in judged)
    print(
        f"{killed} of {len(mutants) - same} killed ({slow} by time), {same} change nothing,"
        f" {sum(x['s'] for x in judged):.0f} s of processor time; survivors:"
    )
    for x in judged:
        if not x["killed"]:
            print(json.dumps(x))
    if untried or not possible:
        print(f"error: not tried: {untried}", file=sys.stderr)
    return int(not possible or bool(untried))


if __name__ == "__main__":
    sys.exit(main())
