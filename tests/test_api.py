"""What a script finds in the package itself, and what a notebook shows of it."""

import ast
import html
import inspect
import pydoc
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sample_flights import swarm
from test_policy import HOSTILE
from test_policy import flight as hostile_flight

import rigidfleet as rf
from rigidfleet.result import Result

untyped: Any = rf  # what no type checker looks at

TAKES_MISSION: dict[str, Callable[[Any], Any]] = {
    "simulate": rf.simulate,
    "check": rf.check,
    "live": rf.live,
    "establish": lambda given: rf.establish(given, [[[0.0, 0.0, 0.0]]]),
}
TAKES_FLIGHT: dict[str, Callable[[Any], Any]] = {
    "assess": rf.assess,
    "plot": rf.plot,
    "replay": rf.replay,
    "report": lambda given: rf.report(given, "never.html"),
}


@pytest.fixture(scope="module")
def flight() -> Result:
    return swarm(4, 10.0)


# -- names -------------------------------------------------------------------------------------------


def test_names_are_those_listed():
    """`dir` lists what `__all__` does, in both, and each of them is there."""
    assert dir(rf) == sorted(rf.__all__)
    assert set(rf.__all__) == {*rf._HOME, "__version__"}
    assert all(getattr(rf, name) is not None for name in rf.__all__)


def test_type_checkers_see_all_names():
    """Every public name is imported, from its own module, where type checkers look."""
    tree = ast.parse(Path(rf.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    seen = {
        name.asname: (node.module or "").removeprefix("rigidfleet.")
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    }
    assert seen == rf._HOME | {"__version__": "_version"}


def test_no_function_hides_a_module():
    """A name means the same before and after a module is imported: no module stands in its place."""
    root = Path(rf.__file__).parent
    modules = {p.stem for p in root.glob("*.py")} | {
        p.parent.name for p in root.glob("*/__init__.py")
    }
    assert not modules & set(rf.__all__)


def test_every_name_says_what_it_is():
    """A class or function begins with a sentence, which is not made up by dataclasses."""
    for name in rf.__all__:
        if name != "__version__":
            first = (inspect.getdoc(getattr(rf, name)) or "").split("\n\n")[0]
            assert first.endswith((".", ":")), name
            assert not first.startswith(f"{name}("), name


def test_help_opens_with_sense():
    """`help` of a result says first what it is, how it is kept and read, and not its forty arrays."""
    text = pydoc.plain(pydoc.render_doc(rf.Result))
    head = text.split("\n", 3)[3].splitlines()
    assert head[0] == " |  Result(**fields)"
    assert "Record of a flight" in head[2]
    opening = "\n".join(head[:14])
    assert all(words in opening for words in ("simulate(", ".save(", "Result.load("))
    assert max(map(len, text.splitlines())) < 160


# -- what functions take -----------------------------------------------------------------------------


def test_a_mission_by_name_path_or_itself(tmp_path):
    """A shipped name, a path as text or `Path`, and a `Mission` are the same flight."""
    mission = rf.load_mission("two-agents")
    path = tmp_path / "mine.toml"
    path.write_text(mission.text, encoding="utf-8")
    ends = {
        rf.simulate(given).position[-1].tobytes()
        for given in ("two-agents", mission, path, str(path))
    }
    assert len(ends) == 1
    assert rf.check("two-agents").data() == rf.check(path).data() == rf.check(mission).data()


def test_check_is_what_the_command_does(capsys):
    """`rf.check` finds what `rigidfleet check` prints."""
    import json

    from rigidfleet.cli.app import main

    assert main(["check", "cube-passage", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    found = rf.check("cube-passage")
    assert found.passed
    assert isinstance(found, rf.Preflight)
    remarks = [vars(remark) for remark in found.remarks]
    assert printed["remarks"] == remarks
    assert printed["passed"]


def test_a_flight_by_path_or_itself(tmp_path, flight):
    """A flight and the file of it are judged, drawn, replayed and reported alike."""
    path = tmp_path / "flight.nc"
    flight.save(path)
    for given in (path, str(path)):
        assert rf.assess(given).json() == rf.assess(flight).json()
        assert rf.replay(given).html == rf.replay(flight).html
    assert [p.name for p in rf.plot(path, tmp_path, names=["cm"], formats=["svg"])] == ["cm.svg"]
    rf.report([path, flight], tmp_path / "both.html")
    rf.report(str(path), tmp_path / "one.html")
    assert (tmp_path / "one.html").exists()


@pytest.mark.parametrize("given", [42, None, b"square", ["square"], {"name": "square"}], ids=repr)
@pytest.mark.parametrize("name", TAKES_MISSION)
def test_what_is_no_mission(name, given):
    """What is no mission is refused in one sentence: what is expected, and what was given."""
    with pytest.raises(TypeError) as caught:
        TAKES_MISSION[name](given)
    text = str(caught.value)
    assert "shipped name, a path or a Mission" in text
    assert repr(given) in text
    assert f"({type(given).__name__})" in text
    assert "\n" not in text


@pytest.mark.parametrize("given", [42, None, b"a.nc", {"time": 0}], ids=repr)
@pytest.mark.parametrize("name", TAKES_FLIGHT)
def test_what_is_no_flight(name, given):
    """What is no flight is refused in one sentence; so is a mission, which is to be flown first."""
    for wrong in (given, rf.load_mission("square")):
        with pytest.raises(TypeError) as caught:
            TAKES_FLIGHT[name](wrong)
        text = str(caught.value)
        assert "Result" in text
        assert "path of one" in text
        assert "\n" not in text
        assert len(text) < 200


@pytest.mark.parametrize("name", TAKES_FLIGHT)
def test_no_such_file(name):
    """A path where there is no flight is an error of the user's, that says so."""
    with pytest.raises(rf.ResultError, match="no such file"):
        TAKES_FLIGHT[name]("nowhere.nc")


# -- what is shown -----------------------------------------------------------------------------------


def test_short_in_words(flight):
    """Mission, verdict, result, check and replay are one short line at the prompt."""
    mission = rf.load_mission("narrow-passage")
    assert repr(mission) == "<Mission narrow-passage: 3 agents, 2 formations, 12 phases, 90 s>"
    assert str(mission) == repr(mission)
    assert repr(mission) in (inspect.getdoc(rf.Mission) or "")
    settling = repr(rf.load_mission("line-singular"))
    assert settling.startswith("<Mission line-singular: 3 agents, ")
    assert repr(rf.check(mission)) == "<Preflight: no problems found, 0 notes>"
    verdict = rf.assess(flight)
    judged = [finding for finding in verdict.checks if finding.judged]
    failed = [finding for finding in judged if not finding.passed]
    assert repr(verdict) == f"<Verdict swarm: failed {len(failed)} of {len(judged)} checks>"
    for shown in (flight, verdict, rf.replay(flight)):
        assert len(repr(shown)) < 120
        assert "\n" not in repr(shown)


def elements(text: str) -> tuple[list[str], str]:
    """Names of the elements of a table as shown, and its words."""
    root = ET.fromstring(text.replace("<br>", "<br/>"))
    return [element.tag for element in root.iter()], "".join(root.itertext())


def test_tables_in_notebooks(flight):
    """Mission, verdict, result and check show small tables of well-formed HTML."""
    mission = rf.load_mission("narrow-passage")
    verdict = rf.assess(flight)
    for shown, words in (
        (mission, ["WP6: through the passage", "at 90 s", "12 phases"]),
        (verdict, ["separation", "FAILED", verdict.summary.splitlines()[-1]]),
        (flight, ["4 vehicles, one sheet", "complete"]),
        (rf.check("cube-passage"), ["gains", "separation"]),
    ):
        text = shown._repr_html_()
        assert len(text) < 20_000
        _, read = elements(text)
        assert all(word in read for word in words), read


@pytest.mark.parametrize("hostile", HOSTILE)
def test_words_stay_words(hostile):
    """Whatever users write, a table has the same elements as with calm words, and shows what was written."""
    for show in (lambda result: result.mission, lambda result: result, rf.assess):
        calm, _ = elements(show(hostile_flight(str))._repr_html_())
        tags, read = elements(show(hostile_flight(lambda word: f"{word} {hostile}"))._repr_html_())
        assert (
            set(tags)
            == set(calm)
            <= {"div", "p", "strong", "table", "thead", "tbody", "tr", "th", "td", "br"}
        )
        assert f"title {hostile}" in read


def test_a_result_whose_mission_cannot_be_read():
    """Such a result shows itself all the same."""
    text = swarm(2, 5.0, mission_text="nonsense")._repr_html_()
    assert "cannot be read" in text


def png(figure: Any) -> tuple[bytes, dict[str, int]]:
    """What a notebook shows of a figure."""
    return figure._repr_png_()


def test_figures_are_pictures(flight):
    """A figure is a PNG of twice the dots that it is shown at, whatever the backend; several are a list."""
    figures = rf.plot(flight, names=["trajectory", "cm"])
    assert len(figures) == 2
    for figure in figures:
        data, size = png(figure)
        assert data.startswith(b"\x89PNG")
        wide = int.from_bytes(data[16:20], "big")
        assert 1.3 * size["width"] < wide < 2.1 * size["width"]
        assert size["width"] < 1200
    import pickle

    assert pickle.loads(pickle.dumps(figures[0])).axes


def test_replay_in_a_cell(flight, tmp_path):
    """Without a path the replay is a frame that holds the page, sandboxed; with one it is the file."""
    shown = rf.replay(flight)
    text = shown._repr_html_()
    assert re.findall(r'sandbox="([^"]*)"', text) == ["allow-scripts"]
    (held,) = re.findall(r'srcdoc="([^"]*)"', text)
    assert html.unescape(held) == shown.html
    assert rf.replay(flight, tmp_path / "page.html") is None
    assert (tmp_path / "page.html").read_text(encoding="utf-8") == shown.html


def test_showing_needs_no_notebook():
    """What a notebook asks for loads no part of one; only a list of figures does, which a notebook shows."""
    code = """
import sys, rigidfleet as rf
rf.load_mission("square")._repr_html_()
rf.check("square")._repr_html_()
print(*sorted({"IPython", "numba", "matplotlib"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("given", [3, None, b"flight.nc", ["flight.nc"]], ids=repr)
def test_what_is_no_path(flight, given):
    """A number is no open file: each function that reads or writes asks for a path in one sentence."""
    for use in (
        rf.load_mission, rf.Result.load, rf.Sweep.load, flight.save, flight.to_csv,
        lambda path: rf.report(flight, path),
    ):  # fmt: skip
        with pytest.raises(TypeError, match=r"^expected a path \(a string or a Path\), got"):
            use(given)
    with pytest.raises(rf.ResultError, match="is a folder"):
        flight.save("/")


@pytest.mark.parametrize(
    ("words", "use"),
    [
        ("a function for controller", lambda: untyped.Flight("square", controller=3)),
        ("a function for force", lambda: untyped.Flight("square", force=3)),
        ("a function for progress", lambda: untyped.Flight("square", progress=3)),
        ("an array of numbers for times", lambda: untyped.Flight("square", times="soon")),
        ("an array of numbers for slots", lambda: untyped.design("cube")),
        ("a number of extra edges", lambda: untyped.design([[0, 0, 0], [1, 0, 0]], extra="all")),
        (
            "an array of numbers for position",
            lambda: untyped.establish("establish-triangle", "here"),
        ),
        ("the text of a mission file", lambda: untyped.Mission.from_toml(3)),
        ("a dict with the keys of a mission", lambda: untyped.Mission.from_dict([1])),
        ("a shipped name, a path or a Mission", lambda: untyped.Sweep.of(3, [])),
        (
            "a list of variations",
            lambda: untyped.Sweep.of("square", "agents.mass.* *= normal(1, 0.1)"),
        ),
    ],
)
def test_what_is_no_argument(words, use):
    """Wrong types are refused at once, in one sentence."""
    with pytest.raises(TypeError) as caught:
        use()
    assert words in str(caught.value)
    assert str(caught.value).startswith("expected ")
    assert ", got " in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_mission_is_not_made_by_its_class():
    """Keys alone would not be checked as a whole; one sentence says what makes a mission."""
    for wrong in ({}, {"schema_version": 1, "name": "x"}):
        with pytest.raises(
            TypeError, match=r"^a mission is not made by Mission\(\.\.\.\): use load_mission"
        ):
            rf.Mission(**wrong)
    with pytest.raises(TypeError, match="not made by Mission"):
        rf.Mission("narrow-passage")


@pytest.mark.parametrize(
    "wrong", [{"port": "x"}, {"port": True}, {"port": 80.0}, {"ready": "x"}, {"landed": 3}]
)
def test_wrong_arguments_of_live(wrong):
    """One sentence each, before anything is served."""
    (name,) = wrong
    with pytest.raises(TypeError, match=f"^expected a (number|function) for {name}.*, got "):
        rf.live("square", browser=False, **wrong)
