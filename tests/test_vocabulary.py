"""The words of the code: each means one thing, functions are named by things or acts, and codes have names."""

import ast
import pkgutil
import re
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
TREES = {
    path.relative_to(ROOT / "src"): ast.parse(path.read_text())
    for path in sorted((ROOT / "src" / "rigidfleet").rglob("*.py"))
}
#: A dialect: reported, requested, input and result are what others say.
DIALECT = {"found", "told", "given", "asked", "led"}
PARTICIPLE = re.compile(r"_*[a-z]+(ed|led|told|found|given|shown|drawn|known|kept|sent|made|taken)")


def test_words_of_the_code_are_in_the_code():
    """Every word of the glossary stands there once, with a name that exists."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    table = text.partition("## Words of the code")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| ([\w, ]+) \| .+ \| `([\w.]+)` \|$", table, re.MULTILINE)
    words = [word for row, _ in rows for word in row.split(", ")]
    assert len(words) == len(set(words)) > 20
    for _, name in rows:
        pkgutil.resolve_name(f"rigidfleet.{name}")


def test_one_class_a_name():
    """No two classes of the package have one name."""
    places = defaultdict(list)
    for path, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(str(path))
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_nothing_has_a_name_of_the_dialect():
    """No variable or field is called found, told, given, asked or led."""
    names = [
        f"{path}:{node.lineno} {node.id}"
        for path, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in DIALECT
    ]
    assert names == []


def test_functions_are_things_or_acts():
    """At most ten functions are named by a bare participle."""
    names = [
        f"{path}:{node.lineno} {node.name}"
        for path, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        if "_" not in node.name.strip("_") and PARTICIPLE.fullmatch(node.name)
    ]
    assert len(names) <= 10, names


def test_codes_have_names():
    """Nothing is read from flags, counters or times by a bare number."""
    numbered = re.compile(r"\b(?:flags|count|clock)\[-?\d")
    assert [str(path) for path in TREES if numbered.search((ROOT / "src" / path).read_text())] == []
