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


def names_made(tree):
    """Line and name of all that code names: variables, fields, arguments, functions, classes, what it imports as."""
    for node in ast.walk(tree):
        match node:
            case (
                ast.Name(id=name, ctx=ast.Store())
                | ast.Attribute(attr=name, ctx=ast.Store())
                | ast.arg(arg=name)
                | ast.alias(asname=str(name))
                | ast.ExceptHandler(name=str(name))
                | ast.FunctionDef(name=name)
                | ast.AsyncFunctionDef(name=name)
                | ast.ClassDef(name=name)
            ):
                yield node.lineno, name


def words_and_places():
    """Rows of the glossary: words that mean the same, and names below the package that show what."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    table = text.partition("## Words of the code")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| ([\w, ]+) \| .+ \| (`[\w.`, ]+`) \|$", table, re.MULTILINE)
    return [(words.split(", "), re.findall(r"[\w.]+", names)) for words, names in rows]


def test_words_of_the_code_are_in_the_code():
    """Every word of the glossary stands there once, with names that exist."""
    rows = words_and_places()
    words = [word for some, _ in rows for word in some]
    assert len(words) == len(set(words)) > 20
    for _, names in rows:
        for name in names:
            pkgutil.resolve_name(f"rigidfleet.{name}")


def test_a_class_that_is_named_by_a_word_is_what_the_word_means():
    """A class whose name is a word of the glossary, alone, is one of those that the glossary names beside it."""
    places = {word: names for words, names in words_and_places() for word in words}
    classes = {
        ".".join([*path.with_suffix("").parts[1:], node.name])
        for path, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and node.name.strip("_").lower() in places
    }
    assert len(classes) > 15
    others = [
        name for name in sorted(classes) if name not in places[name.split(".")[-1].strip("_").lower()]
    ]  # fmt: skip
    assert others == []


def test_one_class_a_name():
    """No two classes of the package have one name."""
    places = defaultdict(list)
    for path, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(str(path))
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


#: Modules whose constants are always read with the module's name, by which they mean something else.
READ_BY_MODULE = ("mission/bounds.py",)
#: Constants with two meanings, and why.
TWO_MEANINGS = {
    "FORMATS": "of figures in rigidfleet.plotting, of files in rigidfleet.interchange: both are documented"
}


def constants(tree):
    """Public constants of a module and the text of their values; '' for places in an array, which are numbered."""
    for node in tree.body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        value = ast.unparse(node.value)
        numbered = re.fullmatch(r"range\(.+\)|\([\d, ]+\)", value)
        for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
            for part in ast.walk(target):
                if isinstance(part, ast.Name) and re.fullmatch(r"[A-Z][A-Z0-9_]+", part.id):
                    several = isinstance(target, ast.Tuple)
                    yield part.id, "" if several and numbered else value


def test_one_meaning_a_constant():
    """A public constant that two modules have under one name has one value.

    Places in arrays of the kernel have the names of what stands there, which several arrays hold, each elsewhere.
    Letters are those of the paper.
    """
    values = defaultdict(set)
    for path, tree in TREES.items():
        if path.relative_to("rigidfleet").as_posix() not in READ_BY_MODULE:
            for name, value in constants(tree):
                values[name].add(value)
    assert len(values) > 300
    assert {name for name, some in values.items() if len(some) > 1} == TWO_MEANINGS.keys()


def test_some_constants_are_read_with_their_module():
    """No module imports a constant of `READ_BY_MODULE` by its name alone."""
    modules = {
        f"rigidfleet.{path.removesuffix('.py').replace('/', '.')}" for path in READ_BY_MODULE
    }
    alone = [
        f"{path}:{node.lineno} {name.name}"
        for path, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module in modules
        for name in node.names
        if name.name.isupper()
    ]
    assert alone == []


def test_nothing_has_a_name_of_the_dialect():
    """Nothing is called found, told, given, asked or led: no constant, argument or attribute, however private."""
    names = [
        f"{path}:{line} {name}"
        for path, tree in TREES.items()
        for line, name in names_made(tree)
        if name.strip("_").lower() in DIALECT
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
