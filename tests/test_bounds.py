import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rigidfleet.cli import app as cli
from rigidfleet.cli import codes, console
from rigidfleet.errors import MissionError
from rigidfleet.mission import Mission, json_schema, mission_names, mission_text
from rigidfleet.mission import bounds as limits
from rigidfleet.mission.bounds import toml_oversize_in_words
from rigidfleet.mission.formations import coincident_pairs
from rigidfleet.planning import filters
from rigidfleet.preflight.check import check

HEAD = 'schema_version = 1\nname = "a"\n'
HOLD = "[[phases]]\nkind = 'hold'\nduration = 10.0\n"
ESTABLISH = "[[phases]]\nkind = 'establish'\nformation = 'f'\nduration = 10.0\n"
GUSTS = "[disturbances.gusts]\nmodel = 'dryden'\nintensity = 1.0\n"


def agents(n: int, more: str = "") -> str:
    return f"{more}[agents]\nmass = 1.0\nposition = {{shape = 'grid', size = 2.0, count = {n}}}\n"


def listed(n: int) -> str:
    places = ", ".join(f"[{k}, 0, 0]" for k in range(n))
    return f"[agents]\nmass = 1.0\nposition = [{places}]\n"


def boxes(n: int, apart: float = 2.0) -> str:
    return "".join(
        f"[[obstacles]]\nkind = 'box'\nmin = [{apart * k}, 1, 1]\nmax = [{apart * k + 1}, 2, 2]\n"
        for k in range(n)
    )


def formations(n: int, shape: str = "grid") -> str:
    return "".join(f"[formations.f{k}]\nshape = '{shape}'\nsize = {k + 1}\n" for k in range(n))


def formation(shape: str, size: Any, edges: str = "'complete'", more: str = "") -> str:
    return f"[formations.f]\nshape = '{shape}'\nsize = {size}\nedges = {edges}\n{more}"


def refused(text: str) -> list[Any]:
    """Findings about a mission, which are made within a minute of processor time."""
    begun = time.process_time()
    with pytest.raises(MissionError) as caught:
        Mission.from_toml(text)
    assert time.process_time() - begun < 60.0
    return list(caught.value.findings)


# -- what is refused ---------------------------------------------------------------------------------

BEYOND = [
    ("a" + ".a" * 5000 + " = 1", "", "dotted key is 5,001 at line 1"),
    ("\n[" + "a." * 100_000 + "a]", "", "dotted key is 100,001 at line 2"),
    ("'a'" + ' . "a"' * 8 + " = 1", "", "dotted key is 9 at"),
    ("a = " + "[" * 100_000, "", "depth of brackets is 9 at"),
    ("a = " + "{a = " * 9, "", "depth of brackets is 9 at"),
    ("".join(f"k{k} = 1\n" for k in range(60_000)), "", "60,000 keys"),
    ("a = [" + "1," * 11_000_000 + "]", "", "entries in lists"),
    (HEAD + agents(10_000_000) + HOLD, "agents.position.count", "must be <= 1e+06"),
    (HEAD + agents(4) + HOLD * 10_000, "phases", "10,000 entries; the maximum is 1,000"),
    (HEAD + agents(4) + boxes(10_000) + HOLD, "obstacles", "10,000 entries; the maximum is 1,000"),
    (HEAD + agents(4) + formations(1000) + HOLD, "formations", "1,000 entries; the maximum is 200"),
    (HEAD + agents(100_000) + formations(100) + HOLD, "formations", "10,000,000 slots"),
    (HEAD + agents(30_000, "assignment = 'each'\n") + HOLD, "assignment", "takes too long for 30,000 agents"),
    (HEAD + listed(100_000) + formation("line", 1.0) + ESTABLISH, "formations.f.edges", "4,999,950,000"),
    (
        HEAD + agents(10_000) + formation("grid", 1.0, "'neighbours'", "reach = 1e6\n") + ESTABLISH,
        "formations.f.reach", "joins 49,995,000 pairs",
    ),
    (HEAD + agents(4) + formation("square", "1e-200") + ESTABLISH, "formations.f.size", "must be >= 1e-06"),
    (HEAD + agents(4) + formation("square", "1e15") + ESTABLISH, "formations.f.size", "must be <= 1e+08"),
    (HEAD + agents(900) + formation("line", "1e6", "[]") + ESTABLISH, "formations.f.size", "extend to 4.5e+08 m"),
    (
        HEAD + listed(2) + "[formations.f]\ndistances = [1e-308]\n" + ESTABLISH,
        "formations.f.distances[1]", "must be >= 1e-06",
    ),
    (HEAD + listed(2).replace("[1,", "[1e15,") + HOLD, "agents.position[2][1]", "must be <= 1e+08"),
    (HEAD + listed(2).replace("1.0", "[1e-3, 1e8]") + HOLD, "agents.mass", "1e+09 times the smallest"),
    (HEAD + agents(4) + HOLD + GUSTS + "length = 9.0\nairspeed = 1e-9\n", "disturbances.gusts.airspeed", ">= 1e-06"),
    (HEAD + agents(20_000) + "radius = 1e8\n" + HOLD, "agents.radius", "199,990,000 pairs of agents touch"),
    (
        HEAD + "[agents]\nmass = 1\nposition = {shape = 'line', size = 1, count = 1}\n"
        + formation("line", 1.0, "'henneberg-multilevel'") + ESTABLISH, "formations.f.edges",
        "1 points cannot have three edges",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("text", "key", "words"), BEYOND, ids=lambda value: str(value)[:40])
def test_what_is_beyond_a_bound_is_one_error(text, key, words):
    """More, deeper, larger or nearer than a bound is refused at once, by one error with key and remedy."""
    (finding,) = refused(text)
    assert finding.key == key
    assert words in finding.problem
    assert finding.remedy


def test_distances_of_many_agents_ask_for_no_matrix():
    """Some distances among 100,000 agents are refused for what they leave open, without a number for each pair."""
    text = HEAD + "output_step = 5.0\n" + listed(100_000)
    text += "[formations.f]\nedges = [[1, 2]]\ndistances = [1.0]\n" + ESTABLISH
    assert {f.key for f in refused(text)} == {"phases[1].reference", "phases[1].control"}


def test_faults_of_one_kind_are_counted():
    """Of 30,000 entries with one fault the first eight are told and the others counted; so are unknown keys."""
    text = HEAD + listed(30_000).replace("0, 0]", "'a', 0]") + HOLD
    text += "".join(f"[obstacles.k{k}]\n" for k in range(3))
    text = "".join(f"k{k} = 1\n" for k in range(20_000)) + text
    found = refused(text)
    assert len(found) < 30
    told = {f.key: f.problem for f in found}
    assert told["agents.position[*][*]"] == "29,992 more of this kind"
    assert told[""] == "19,992 more of this kind"


def test_what_is_no_depth_is_passed_over():
    """Brackets and dots in strings, in comments and one after the other are not nested."""
    deep = "[" * 50 + ".a" * 50
    text = f'a = "{deep}" # {deep}\nb = \'{deep}\'\nc = """\n{deep}"\\"""" # """\nd = \'\'\'{deep}\'\'\'\n'
    text += "e = [" + "[1.5, 2.5]," * 50 + "]\n" + "[[f.g]]\n" * 50
    assert toml_oversize_in_words(text) == ""
    assert "depth of brackets is 9 at line 57" in toml_oversize_in_words(text + "[" * 9)
    for name in mission_names():
        assert toml_oversize_in_words(mission_text(name)) == ""


@pytest.mark.parametrize(
    "text", ["'", '"', '"\\"', "a", "a.", "a .", ".", '"a".', "#", "\\", '"""', "'''\"", '"\n', "[]", "[#\n", "'a' "]
)  # fmt: skip
def test_the_text_is_looked_at_in_one_pass(text):
    """Twice the text takes about twice as long, whatever it repeats: a megabyte in seconds, not minutes."""
    begun = time.process_time()
    toml_oversize_in_words(text * (1_000_000 // len(text)))
    assert time.process_time() - begun < 20.0


def test_every_number_of_the_format_has_bounds():
    """No number of a mission is free of a least and a greatest value, but the version, which is one."""
    free = []

    def walk(part: Any, path: str) -> None:
        if isinstance(part, dict):
            ends = [{"minimum", "exclusiveMinimum"}, {"maximum", "exclusiveMaximum"}]
            if part.get("type") in ("number", "integer") and not all(
                end & part.keys() for end in ends
            ):
                free.append(path)
            for key, value in part.items():
                walk(value, f"{path}.{key}")
        elif isinstance(part, list):
            for value in part:
                walk(value, path)

    walk(json_schema(), "")
    hidden = {
        "mass",
        "radius",
        "thrust_limit",
        ".properties.schema_version",
        "dimension",  # one of two numbers
        ".properties.dimension",
    }  # their models say what their schema leaves out
    assert {re.sub(r".*\.properties\.(\w+)\..*", r"\1", path) for path in free} <= hidden
    for key, least, most in (
        ("mass", 1e-7, 1e10),
        ("radius", -1.0, 1e9),
        ("thrust_limit", 1e-10, 1e13),
    ):
        for value in (least, most):
            data = {"mass": 1.0} | {key: value}
            text = HEAD + "[agents]\nposition = [[0, 0, 0]]\n"
            text += "".join(f"{k} = {v}\n" for k, v in data.items()) + HOLD
            assert [f.key for f in refused(text)] == [f"agents.{key}"]


def test_points_at_one_place_are_found():
    """Among random points those nearer than half a micrometre to an earlier one are found, as all pairs say."""
    rng = np.random.default_rng(3)
    for n in (2, 5, 60, 900):
        p = rng.uniform(-1e-5, 1e-5, (n, 3)) * [1.0, 1.0, float(rng.integers(2))]
        p[n // 2] = p[0] + [3e-7, 0, 0]
        apart = np.linalg.norm(p[:, None] - p, axis=2) + np.tri(n).T
        close = (apart < 5e-7).any()
        found = coincident_pairs(p)
        assert bool(found) == close
        assert all(i < j and np.linalg.norm(p[i] - p[j]) < 2e-6 for i, j in found)
    assert coincident_pairs(np.zeros((100_000, 3)))[-1] == (0, 99_999)


def test_short_steps_of_slow_gusts_stay_gusts():
    """Dryden's transverse gusts of step 1e-6 tau grow apart as their spectrum says: 2 - 2 rho(t) = 3 t / tau."""
    white = np.random.default_rng(0).standard_normal((100_001, 2))
    steps = np.diff(filters.dryden_gust(white, 1e-6, 1.0))
    assert np.mean(steps**2) / 3e-6 == pytest.approx(1.0, abs=0.03)
    assert np.isfinite(filters.dryden_gust(white[:10], 1e-12, 1.0)).all()


# -- what takes long ---------------------------------------------------------------------------------


def checked(text: str) -> tuple[set[str], str]:
    """Topics of notes about what was passed over, and all words, of a check within a minute of processor time."""
    begun = time.process_time()
    found = check(Mission.from_toml(text))
    words = "\n".join(text for _, text in found.describe())
    assert time.process_time() - begun < 60.0
    over = ("skipped", "would take too long")
    return {r.topic for r in found.remarks if any(text in r.text for text in over)}, words


def test_a_check_of_many_formations_says_what_it_passed_over():
    """Of 200 formations the first are judged, the flown ones before all, and the others are named as passed over."""
    text = HEAD + agents(8) + formations(200, "cube") + ESTABLISH.replace("'f'", "'f199'")
    topics, words = checked(text)
    assert topics == {"formation"}
    assert "skipped, rigidity not checked" in words
    assert re.search(r"random starts 40, this shape \d+", words)


def test_a_check_of_many_obstacles_tells_of_the_nearest():
    """Of 1,000 boxes beside the way the nearest 20 are told, and every one that is hit."""
    topics, words = checked(HEAD + agents(4) + boxes(1000) + HOLD)
    assert not topics
    assert len(re.findall(r"'box \d+'", words)) == 20
    fly = "[[phases]]\nkind = 'fly'\nposition = [200, 1.5, 1.5]\nduration = 60.0\n"
    one = "[agents]\nmass = 1.0\nposition = [[-3.0, 1.5, 1.5]]\n"
    found = check(Mission.from_toml(HEAD + one + boxes(100) + fly))
    hit = {int(k) for r in found.remarks for k in re.findall(r"hits 'box (\d+)'", r.text)}
    assert hit == set(range(1, 101))


def test_a_gap_is_between_the_nearest_two():
    """Of walls in a row the formation passes the gaps between neighbours, and no gap with a wall in it."""
    walls = "".join(
        f"[[obstacles]]\nkind = 'box'\nmin = [{x}, -9, -9]\nmax = [{x + 1}, 9, 9]\n"
        for x in (-9, 20, -4, 8)
    )
    found = check(Mission.from_toml(HEAD + agents(4) + walls + HOLD))
    assert [(between, wide) for between, wide, _, _ in found.gaps] == [
        ("'box 3' and 'box 4'", 11.0)
    ]


@pytest.mark.long
@pytest.mark.parametrize(
    ("text", "topics"),
    [
        (HEAD + agents(200, "output_step = 1.0\n") + HOLD * 1000, {"paths"}),
        (HEAD + agents(200) + boxes(1000, 0.1) + HOLD * 20, set()),
        (HEAD + agents(4) + HOLD * 1000, set()),
        (HEAD + agents(1000, "output_step = 5.0\n") + "".join(
            f"[formations.f{k}]\nshape = 'sphere'\nsize = {k + 1}\nedges = 'neighbours'\n" for k in range(50)
        ) + HOLD, {"formation"}),
        (HEAD + agents(1_000_000, "output_step = 5.0\n") + formation("grid", 3.0, "[]") + ESTABLISH, {"paths"}),
    ],
)  # fmt: skip
def test_a_check_at_the_bounds_ends(text, topics):
    """At the bounds of phases, obstacles, formations and agents a check takes 10 s, and notes what it left out."""
    assert checked(text)[0] == topics


def test_a_long_check_says_what_it_does(tmp_path: Path, monkeypatch, capsys):
    """A check that takes long says what it looks at on standard error; a short one says nothing."""
    (tmp_path / "a.toml").write_text(HEAD + agents(4) + formation("square", 3.0) + ESTABLISH)
    assert cli.main(["check", str(tmp_path / "a.toml")]) != codes.BAD_INPUT
    assert "Checking" not in capsys.readouterr().err
    monkeypatch.setattr(console, "_PATIENCE", 0.05)
    monkeypatch.setattr(
        "rigidfleet.preflight.check.check_pid_gains", lambda *_: time.sleep(0.5) or 1 // 0
    )
    cli.main(["check", str(tmp_path / "a.toml")])
    assert re.search(r"Checking .*a.toml: planned paths, \d+ s", capsys.readouterr().err)


def test_the_bounds_are_those_of_the_documents():
    """A million agents in a formation of three edges each may be asked for by count."""
    assert limits.AGENTS >= 1_000_000
    assert 3 * limits.AGENTS <= limits.EDGES_EACH * limits.AGENTS


@pytest.mark.parametrize("quotes", ['"""a""""', '"""a"""""', "'''a''''", '"""\\""""'])
@pytest.mark.parametrize("deep", ["[" * 5000 + "]" * 5000, "{" + ".".join("a" * 5000) + " = 1}"])
def test_a_string_that_ends_in_quotes_hides_nothing(quotes, deep):
    """TOML lets a string of several lines end in quotes of its own; what comes after it is looked at."""
    assert "depth" in toml_oversize_in_words(f"note = [{quotes}, {deep}]\n")
