"""What the documents say is so: tables, code, commands, links, functions and tests they name."""

import ast
import builtins
import fnmatch
import importlib
import importlib.util
import itertools
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from rigidfleet.assessment import assess
from rigidfleet.errors import MissionError
from rigidfleet.mission import Mission, load_mission, mission_names, mission_text
from rigidfleet.plotting import figure_names
from rigidfleet.preflight.check import check
from rigidfleet.simulation.flight import simulate

ROOT = Path(__file__).parents[1]
PAGES = [
    *(ROOT / f"{name}.md" for name in ("README", "CHANGELOG", "CONTRIBUTING", "SECURITY")),
    *sorted((ROOT / "docs").glob("*.md")),
]


def page(name: str) -> str:
    """Text of a page below docs."""
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def blocks(text: str, language: str) -> list[str]:
    """Code blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def anchors(text: str) -> set[str]:
    """Places that a link may lead to: headings, as GitHub names them, and named ones."""
    prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    heads = re.findall(r"^#+ (.*)$", prose, re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads)
    return {*plain, *re.findall(r'<a id="([^"]+)">', text)}


# -- missions.md -------------------------------------------------------------------------------------


def script(name: str) -> ModuleType:
    """A script below docs, as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_tables_are_up_to_date():
    """The keys of the format, the variables of a result and the metrics of a sweep are those of the code.

    If this fails: python docs/tables.py
    """
    tables = script("tables")
    for path in tables.PAGES:
        assert page(path.name) == tables.render(page(path.name))


def test_every_kind_of_phase_has_its_section():
    """No kind of phase is without a section; the section of `brake`, taken away, is missed."""
    tables, missions = script("tables"), page("missions.md")
    assert not tables.kinds_without_section(missions)
    assert tables.kinds_without_section(missions.replace("of kind `brake`", "of brakes")) == {
        "brake"
    }


def test_every_key_of_a_phase_has_a_row():
    """Each key of a kind of phase stands in a table of a section that names the kind, or in that of every kind."""
    from rigidfleet.mission.kinds import KINDS

    sections = page("missions.md").split("\n### `[[phases]]`")[1:]
    heads = [section.partition("\n")[0] for section in sections]
    for kind, model in KINDS.items():
        own = [f"`{kind}`" in head or "every kind" in head for head in heads]
        text = "".join(itertools.compress(sections, own))
        rows = set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE))
        assert set(model.model_fields) - {"kind"} <= rows, kind


@pytest.mark.long
def test_flown_tables_are_up_to_date():
    """Tables that are flown have the numbers of today's flights: to a digit or 3 %, errors 1e-N to a factor 3."""
    flown = script("flown")
    number = re.compile(r"\d+\.\d+|\d+e-\d+|\b\d+\b")
    for path in flown.PAGES:
        old, new = page(path.name), flown.render(page(path.name))
        assert number.sub("", old) == number.sub("", new)
        for was, now in zip(number.findall(old), number.findall(new), strict=True):
            if "e" in was:  # an error of a method, which other processors round otherwise
                assert 1 / 3 < float(now) / float(was) < 3
            else:
                digit = 10.0 ** -len(was.partition(".")[2])
                assert float(now) == pytest.approx(float(was), rel=0.03, abs=1.01 * digit)


def test_measured_tables_come_from_measurements():
    """Every table of speeds is one that the script writes from the benchmarks' files, and has been written."""
    performance = script("performance")
    places = [
        place
        for path in performance.PAGES
        for place in re.findall(
            r"<!-- measured: ([\w-]+) -->\n(.+?)\n<!-- end -->", path.read_text("utf-8"), re.DOTALL
        )
    ]
    assert {name for name, _ in places} == set(performance.TABLES)
    assert all("Not measured" not in text for _, text in places)


def test_first_mission_flies():
    """The mission written out in full is right, and passes its verdict."""
    (text,) = re.findall(r"<!-- mission -->\n```toml\n(.*?)```", page("missions.md"), re.DOTALL)
    verdict = assess(simulate(Mission.from_toml(text)))
    assert verdict.passed, verdict.summary


def test_the_first_twenty_keys():
    """The first mission has each of the twenty keys that its table lists, no other, and nothing to be mended."""
    (text,) = re.findall(r"<!-- mission -->\n```toml\n(.*?)```", page("missions.md"), re.DOTALL)
    table = page("missions.md").split("<!-- the first twenty keys -->")[1].split("\n\n")[0]
    listed = re.findall(r"^\| `([\w.]+)` \|", table, re.MULTILINE)
    assert len(listed) == 20
    data = tomllib.loads(text)
    used = {name for name, value in data.items() if not isinstance(value, dict | list)}
    used |= {f"{table}.{key}" for table in ("agents", "limits") for key in data[table]}
    used |= {
        f"{many}.{key}" for many in ("obstacles", "phases") for row in data[many] for key in row
    }
    used |= {f"formations.NAME.{key}" for form in data["formations"].values() for key in form}
    assert sorted(listed) == sorted(used)
    assert check(Mission.from_toml(text)).remarks == []


def test_the_example_of_an_orbit_flies():
    """The orbit of the page is accepted as it stands, and passes its verdict."""
    (text,) = (b for b in blocks(page("missions.md"), "toml") if 'kind = "orbit"' in b)
    data = {
        "schema_version": 1,
        "name": "orbit",
        "agents": {"mass": 1.0, "position": [[10, 5, 9], [12, 5, 10]]},
    } | tomllib.loads(text)
    verdict = assess(simulate(Mission.from_dict(data)))
    assert verdict.passed, verdict.summary


def test_formations_are_right():
    """The three forms of a formation are accepted as they stand."""
    forms = next(b for b in blocks(page("missions.md"), "toml") if "[formations.skein]" in b)
    data = {
        "schema_version": 1,
        "name": "forms",
        "agents": {"mass": 1.0, "position": [[0, 0, 0], [1, 0, 0], [0, 1, 1]]},
        "phases": [{"kind": "fly", "position": [0, 0, 9], "duration": 5.0}],
    } | tomllib.loads(forms)
    assert list(Mission.from_dict(data).formations) == ["triangle", "skein", "line"]


@pytest.mark.parametrize("ending", ["settle", "duration"])
def test_finite_horizons_need_an_arrival(ending):
    """A fly phase that ends by settling has to give its travel, as the page says."""
    phase = {"kind": "fly", "position": [0, 0, 9]}
    data = {
        "schema_version": 1,
        "name": "arrival",
        "agents": {"mass": 1.0, "position": [[0, 0, 0], [1, 0, 0]]},
        "phases": [phase | ({"settle": {}} if ending == "settle" else {"duration": 5.0})],
    }
    if ending == "duration":
        Mission.from_dict(data)
        return
    with pytest.raises(MissionError, match="travel"):
        Mission.from_dict(data)
    data["phases"][0]["travel"] = 5.0
    Mission.from_dict(data)


# -- first-flight.md, controller.md --------------------------------------------------------------------


def test_first_flight(tmp_path, monkeypatch, capsys):
    """The commands of the first flight do what the page says, up to the flight that hits the wall."""
    from rigidfleet.cli.app import main

    monkeypatch.chdir(tmp_path)
    text = page("first-flight.md")
    printed = mission_text("narrow-passage")
    (before,) = re.findall(r"^max = .*$", text, re.MULTILINE)
    (after,) = re.findall(r"to `(max = [^`]*)`", text)
    assert printed.count(before) == 1
    Path("mine.toml").write_text(printed.replace(before, after), encoding="utf-8")
    commands = [line.split() for line in text.splitlines() if line.startswith("rigidfleet ")]
    assert [command[1] for command in commands] == [
        "report",
        "missions",
        "run",
        "report",
        "new",
        "run",
    ]
    told = assess(simulate(Mission.from_toml(printed))).summary
    assert f"> {told.partition(';')[0]};" in text
    run, new = commands[2], commands[4]
    assert main([*run[1:], "--no-figures"]) == 1
    assert "west wall" in " ".join(capsys.readouterr().out.split())
    assert Path(commands[3][3]).exists()
    assert main(new[1:]) == 0
    assert main([*commands[5][1:], "--no-figures"]) == 0


def test_controller_page(capsys):
    """The code of the page on controllers flies: it passes in calm air, and in wind misses by what the page says."""
    names: dict[str, object] = {}
    for code in blocks(page("controller.md"), "python"):
        exec(compile(code, "controller.md", "exec"), names)
    calm, windy = capsys.readouterr().out.split("Failed")
    assert "Passed" in calm
    misses = re.findall(r"missed, (\S+) m off", windy)
    assert [float(miss) for miss in misses] == pytest.approx([1 / 3, 1 / 3], abs=0.05)


def test_own_laws_page(capsys):
    """The law of the page fails, as it says; what it lists is all that a law knows; the environment steps."""
    from rigidfleet.simulation.own_laws import View

    text = page("own_laws.md")
    names: dict[str, Any] = {}
    for code in blocks(text, "python"):
        exec(compile(code, "own_laws.md", "exec"), names)
    assert capsys.readouterr().out.startswith("Failed")
    listed = re.findall(
        r"`(\w+)(?:\[j\])?`", " ".join(re.findall(r"^\| (`.*?) \|", text, re.MULTILINE))
    )
    assert sorted(listed) == sorted(View.__slots__)
    assert set(names["rewards"]) == set(names["env"].agents)
    assert names["result"].complete


@pytest.mark.long
def test_day_page(tmp_path, monkeypatch):
    """The commands of the page on the day run, its drills in 20 runs, and the report has what they have shown."""
    from rigidfleet.cli.app import main
    from rigidfleet.interchange import export

    monkeypatch.chdir(tmp_path)
    export(simulate(load_mission("market-square")), Path("show.skyc"), "skyc")
    commands = [
        line.split() for block in blocks(page("day.md"), "sh") for line in block.splitlines()
    ]
    assert {command[1] for command in commands} == {"run", "sweep", "check", "report"}
    for command in commands:
        few = ["--runs", "20", "--workers", "1"] if command[1] == "sweep" else []
        assert main([*command[1:], *few]) == 0, command
    text = Path("flights/market-square/report.html").read_text(encoding="utf-8")
    assert "of 20 faults are harmless" in text
    assert "A way home is proved from" in text


# -- sweep.md ----------------------------------------------------------------------------------------


def test_sweep_page(tmp_path, monkeypatch, capsys):
    """The lines, the file and the code of the page on sweeps are right, and fly."""
    from rigidfleet.cli.app import main
    from rigidfleet.sweep import Sweep

    monkeypatch.chdir(tmp_path)
    text = page("sweep.md")
    (listed,) = blocks(text, "text")
    lines = re.findall(r"^(\S+ \S?= .*?\))(?:  .*)?$", listed, re.MULTILINE)
    assert len(lines) == 7
    Sweep.of("narrow-passage", lines, runs=1)
    (file,) = blocks(text, "toml")
    Path("study.toml").write_text(file, encoding="utf-8")
    assert main(["sweep", "study.toml", "--runs", "4", "--workers", "1", "--no-figures"]) == 0
    names: dict[str, object] = {}
    for code in blocks(text, "python"):
        exec(compile(code, "sweep.md", "exec"), names)
    assert "\nN " in capsys.readouterr().out
    kinds = re.findall(r"`([\w-]+)\((?:mean|low|a)", text)
    from rigidfleet.sweep.variation import VARIATIONS

    assert set(kinds) == set(VARIATIONS)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_job_arrays_of_the_pages_have_work(path):
    """Each shard of a job array has a group of runs for each of its cores; the page has such an array if it has any."""
    from rigidfleet.sweep import Sweep
    from rigidfleet.sweep.run import GROUP
    from rigidfleet.sweep.shards import runs_of_shard

    text = path.read_text(encoding="utf-8")
    arrays = re.findall(
        r"--array=1-(\d+) --cpus-per-task=(\d+) .*?sweep (\S+) (?:--runs (\d+) )?--shard \S+/(\d+)'",
        text,
        re.DOTALL,
    )
    assert len(arrays) == text.count("sbatch ")
    for machines, cores, file, runs, shards in arrays:
        assert machines == shards
        count = Sweep.load(ROOT / file, runs=int(runs) if runs else None).runs
        for k in range(1, int(shards) + 1):
            groups = np.unique(np.flatnonzero(runs_of_shard(f"{k}/{shards}", count)) // GROUP)
            assert len(groups) >= int(cores)
    again = re.findall(r"sweep sweeps/\S+ --shard \d+/(\d+)", text)
    assert set(again) <= {shards for *_, shards in arrays}


# -- paper.md ----------------------------------------------------------------------------------------


def rows(section: str) -> Iterator[list[str]]:
    """Cells of the table in a section of paper.md."""
    text = page("paper.md").split(f"\n## {section}\n")[1].split("\n## ")[0]
    for line in re.findall(r"^\|(.*)\|$", text, re.MULTILINE):
        yield [cell.strip() for cell in line.split("|")]


@pytest.mark.parametrize(("section", "count"), [("Equations", 27), ("Tables", 5), ("Figures", 27)])
def test_nothing_of_the_paper_is_left_out(section, count):
    """Every equation, table and figure that carries a number has its row, in order."""
    numbers = [row[0] for row in rows(section) if row[0].isdigit()]
    assert numbers == [str(n + 1) for n in range(count)]


EQUATION = re.compile(r"Eq(?:\. \(\d+\)|s\. \(\d+\)(?:(?:-|, | and )\(\d+\))+)")


def equations(text: str) -> set[int]:
    """Numbers of the equations that a text names: Eq. (1), Eqs. (2)-(4), Eqs. (5), (7) and (9)."""
    numbers = set()
    for named in EQUATION.findall(text):
        for first, last in re.findall(r"\((\d+)\)(?:-\((\d+)\))?", named):
            numbers |= set(range(int(first), int(last or first) + 1))
    return numbers


def docstrings() -> Iterator[tuple[str, str]]:
    """Dotted name and docstring of every module, class and function of the package."""
    source = ROOT / "src" / "rigidfleet"
    for path in sorted(source.rglob("*.py")):
        name = ".".join(path.relative_to(source).with_suffix("").parts)
        yield from docstrings_in(ast.parse(path.read_text(encoding="utf-8")), name)


def docstrings_in(
    node: ast.Module | ast.ClassDef | ast.FunctionDef, name: str
) -> Iterator[tuple[str, str]]:
    """Dotted name and docstring of a part of the package, and of what it defines."""
    yield name, ast.get_docstring(node) or ""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef | ast.FunctionDef):
            yield from docstrings_in(child, f"{name}.{child.name}")


def test_equations_name_their_functions_and_functions_their_equations():
    """Each row of the equations names functions whose docstrings name it; what else names one is in its row."""
    listed = {
        int(r[0]): set(re.findall(r"`(\w+\.[\w.]+)`", r[3]))
        for r in rows("Equations")
        if r[0].isdigit()
    }
    said = {name: equations(text) for name, text in docstrings()}
    for number, functions in listed.items():
        assert functions or number in {7, 8, 9}, f"no function for Eq. ({number})"
        for name in functions:
            assert number in said[name], f"the docstring of {name} says no Eq. ({number})"
    for name, numbers in said.items():
        for number in numbers:
            # A module may say what one of its functions implements.
            assert any(f"{f}.".startswith(f"{name}.") for f in listed[number]), (
                f"{name} says Eq. ({number}), whose row does not name it"
            )


@pytest.mark.parametrize("folder", ["src", "docs", "tests", "examples"])
def test_equations_are_spelt_alike(folder):
    """An equation is Eq. (1), several are Eqs. (1)-(3) or Eqs. (1), (2)."""
    paths = [p for p in (ROOT / folder).rglob("*") if p.suffix in {".py", ".md", ".toml"}]
    for path in paths:
        text = path.read_text(encoding="utf-8")
        other = re.findall(r"\b[Ee]q(?:uation)?s?\.? ?\(?\d.*", EQUATION.sub("", text))
        assert other == [], path
    assert paths


def test_missions_and_figures_exist():
    """Missions and figures that paper.md names are shipped and drawn; no mission of the paper is left out."""
    known = set(mission_names())
    figures = [row for row in rows("Figures") if row[0].isdigit()]
    named = {name for row in figures for name in re.findall(r"`([\w-]+)`", row[2])}
    drawn = {name for row in figures for name in re.findall(r"`(\w+)`", row[3])}
    assert named
    assert named <= known
    assert drawn
    assert drawn <= set(figure_names())
    of_the_paper = {name for name in known if "source" in tomllib.loads(mission_text(name))}
    assert len(of_the_paper) > 15
    assert all(f"`{name}`" in page("paper.md") for name in of_the_paper)


HOMES = "kernel|planning|simulation|formation|math|physics|rigidity|result|assessment|mission|plotting|errors"


@pytest.mark.parametrize("name", ["theory.md", "paper.md"])
def test_functions_exist(name):
    """Every module and function that a page names is there."""
    named = re.findall(rf"`(?:rigidfleet\.)?((?:{HOMES})\.\w[\w.]*)`", page(name))
    assert len(named) > 10
    for dotted in named:
        parts = dotted.split(".")
        for k in range(len(parts), 0, -1):
            try:
                found = importlib.import_module(".".join(["rigidfleet", *parts[:k]]))
            except ModuleNotFoundError:
                continue
            break
        for part in parts[k:]:
            found = getattr(found, part, None)
            assert found is not None, f"{name} names {dotted}"


@cache
def names_in(folder: Path) -> set[str]:
    """Names of a folder and the modules below it, and of what they define: functions, classes, constants, fields."""
    names = set()
    for path in folder.rglob("*.py"):
        names |= {*path.relative_to(folder.parent).with_suffix("").parts}
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(node.name)
            for part in node.body if isinstance(node, ast.Module | ast.ClassDef) else ():
                assigned = part.targets if isinstance(part, ast.Assign) else [part]
                targets = [getattr(x, "target", x) for x in assigned]
                names |= {x.id for t in targets for x in ast.walk(t) if isinstance(x, ast.Name)}
    return names


#: Names of the pages on the code that the package does not define: a mark of pytest, a variable of Python.
NOT_OURS = {"long", "PYTHONSAFEPATH"}


@pytest.mark.parametrize(
    "path", [ROOT / "CONTRIBUTING.md", ROOT / "docs" / "design.md"], ids=lambda path: path.stem
)
def test_names_of_the_code_exist(path):
    """Each name, dotted or not, and each file that the pages on the code name is there, in the package of its row."""
    text = re.sub(
        r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
    )
    source, spans = ROOT / "src" / "rigidfleet", re.compile(r"`([^`\n]+)`")
    of_tests = {name for name in names_in(ROOT / "tests") if name[0].isupper()}
    there = names_in(source) | of_tests  # tables and classes, which recipes name
    named = [x for x in spans.findall(text) if re.fullmatch(r"[\w*]+(\.\w+)*", x)]
    files = [x for x in spans.findall(text) if re.fullmatch(r"[\w./]+\.(py|toml|txt)", x)]
    assert len(named) > 20
    assert len(files) > 5
    for name in {*named} - {*files} - NOT_OURS:
        for part in name.split("."):
            word = f"*{part}" if part.startswith("_") else part  # `_deg` ends the names of keys
            assert fnmatch.filter(there, word), f"{path.name} names {name}"
    known = {f"/{x.relative_to(ROOT).as_posix()}" for x in ROOT.glob("*.*")}
    for folder in ("src", "tests", "docs", "examples", "benchmarks"):
        known |= {f"/{x.relative_to(ROOT).as_posix()}" for x in (ROOT / folder).rglob("*.*")}
    for file in files:
        assert any(x.endswith(f"/{file}") for x in known), f"{path.name} names {file}"
    for package, row in re.findall(r"^\| `(\w+)` \| ([^|]+) \|", text, re.MULTILINE):
        if (source / package).is_dir():
            own = {x for x in spans.findall(row) if re.fullmatch(r"\w+", x)}
            assert own <= names_in(source / package), package


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_code_of_the_pages_can_be_imported(path):
    """Whatever the Python of a page imports of the package is there."""
    for code in blocks(path.read_text(encoding="utf-8"), "python"):
        for line in ast.walk(ast.parse(code)):
            if isinstance(line, ast.ImportFrom) and (line.module or "").startswith("rigidfleet"):
                module = importlib.import_module(line.module or "")
                missing = [x.name for x in line.names if not hasattr(module, x.name)]
                # What is no name of the module is a module below it
                assert all(importlib.util.find_spec(f"{line.module}.{x}") for x in missing)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_code_of_the_pages_has_all_its_names(path):
    """What the Python of a page uses is made in it, or in a block above."""
    known = set(dir(builtins))
    for code in blocks(path.read_text(encoding="utf-8"), "python"):
        nodes = list(ast.walk(ast.parse(code)))
        names = [x for x in nodes if isinstance(x, ast.Name)]
        known |= {x.id for x in names if isinstance(x.ctx, ast.Store)}
        known |= {x.arg for x in nodes if isinstance(x, ast.arg)}
        known |= {x.name for x in nodes if isinstance(x, ast.FunctionDef | ast.ClassDef)}
        imported = [x for x in nodes if isinstance(x, ast.alias)]
        known |= {x.asname or x.name.partition(".")[0] for x in imported}
        assert {x.id for x in names if isinstance(x.ctx, ast.Load)} <= known, code


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_commands_of_the_pages_take_what_they_name(path):
    """Commands that read results are shown with results."""
    for code in blocks(path.read_text(encoding="utf-8"), "sh"):
        for name in re.findall(r"^rigidfleet (?:replay|report|export) (\S+)", code, re.MULTILINE):
            assert name.endswith(".nc"), name


def test_the_code_of_a_crowd_runs(capsys):
    """Two vehicles that change places have ways, proved."""
    for code in blocks(page("avoidance.md"), "python"):
        exec(compile(code, "avoidance.md", "exec"), {})
    assert "separation" in capsys.readouterr().out


def test_tests_exist():
    """Every test that paper.md names is there; every row and every erratum has one."""
    text = page("paper.md")
    for file, name in re.findall(r"`(test_\w+\.py)::(test_\w+)`", text):
        source = (ROOT / "tests" / file).read_text(encoding="utf-8")
        assert f"\ndef {name}(" in source, f"paper.md names {file}::{name}"
    for section in ("Equations", "Tables", "Figures"):
        assert all("test_" in row[-1] for row in rows(section) if row[0].isdigit())
    errata = text.split("\n## Errata\n")[1].split("\nSlips of wording")[0]
    for paragraph in re.split(r"\n(?=<a id)", errata)[1:]:
        assert "test_errata.py::" in paragraph
    shown = set(re.findall(r"test_errata\.py::(test_\w+)", text))
    tree = ast.parse((ROOT / "tests" / "test_errata.py").read_text(encoding="utf-8"))
    tests = {n.name for n in tree.body if isinstance(n, ast.FunctionDef)}
    assert {name for name in tests if name.startswith("test_")} == shown


# -- all pages ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    """Every link within the repository leads to a file, and to a heading in it where it names one."""
    text = path.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, place = target.partition("#")
        there = path.parent / file if file else path
        assert there.exists(), f"{path.name}: {target}"
        if place:
            assert place in anchors(there.read_text(encoding="utf-8")), f"{path.name}: {target}"


def test_commands_are_documented(capsys):
    """Every command and option of `rigidfleet` stands in missions.md, and no other option."""
    from rigidfleet.cli.app import main

    text = page("missions.md").split("\n## Commands")[1].split("\n## ")[0]
    options = set()
    for command in (
        "run",
        "missions",
        "check",
        "design",
        "new",
        "assess",
        "report",
        "replay",
        "export",
        "live",
        "sweep",
        "tune",
    ):
        assert f"`rigidfleet {command}" in text
        main([command, "--help"])
        options |= set(re.findall(r"--[a-z][\w-]*", capsys.readouterr().out))
    documented = set(re.findall(r"--[a-z][\w-]*", text))
    assert documented - {"--help"} == options - {"--help", "--version"}


def test_readme_lists_every_command():
    """The README's table of commands has each command, once."""
    from rigidfleet.cli.app import app

    text = (ROOT / "README.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `rigidfleet ([\w-]+)", text, re.MULTILINE)
    assert sorted(listed) == sorted(name for name in app if not name.startswith("-"))


def test_commands_for_whom(tmp_path, monkeypatch, capsys):
    """The commands that the README begins with are right, and the quick ones of them run."""
    import shlex

    from rigidfleet.cli.app import main
    from rigidfleet.mission import mission_names

    monkeypatch.chdir(tmp_path)
    text = (ROOT / "README.md").read_text("utf-8").split("\n## For whom")[1].split("\n## ")[0]
    sweep, show, home, own = (
        shlex.split(c) for c in re.findall(r"`([^`]+)` \|$", text, re.MULTILINE)
    )
    assert sweep[:2] == ["rigidfleet", "sweep"]
    fewer = [*sweep[1:-1], "2", "--workers", "1", "--no-figures"]
    assert main(fewer) == 0
    assert show[:2] == ["rigidfleet", "run"]
    assert show[2] in mission_names()
    assert main(home[1:]) == 0
    assert (ROOT / own[1]).exists()


def test_moving_picture():
    """The README's picture moves, is loaded in no time, and is of the first mission that is flown."""
    from PIL import Image

    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (name,) = re.findall(r"\((docs/images/[\w-]+\.gif)\)", text)
    path = ROOT / name
    assert path.stem in mission_names()
    assert path.stat().st_size < 1_000_000
    with Image.open(path) as picture:
        assert getattr(picture, "n_frames", 1) > 100


def test_five_lines_of_the_readme(tmp_path, monkeypatch):
    """The README's Python is five lines, and draws what it flew."""
    monkeypatch.chdir(tmp_path)
    code = next(b for b in blocks((ROOT / "README.md").read_text("utf-8"), "python"))
    assert len([line for line in code.splitlines() if line.strip()]) == 5
    exec(compile(code.replace("narrow-passage", "square"), "README.md", "exec"), {})
    assert list(tmp_path.rglob("*.png"))


FIRST_MET = ("establish", "blend", "certificate", "flip", "handedness", "open", "prestress")


@pytest.mark.parametrize("word", FIRST_MET)
def test_words_of_the_house_are_explained(word):
    """The glossary says in a few words what the program's own words mean."""
    assert re.search(rf"^\| {word} \| \S.{{20,}} \|$", page("glossary.md"), re.MULTILINE)


# -- pictures ----------------------------------------------------------------------------------------


def test_pictures_that_look_the_same_are_kept(tmp_path, monkeypatch):
    """A picture that differs in digits that nobody sees stays as it was to the byte; another replaces it."""
    import io

    import numpy as np
    from PIL import Image

    monkeypatch.syspath_prepend(ROOT / "docs")
    keep_or_write = script("picture").keep_or_write
    drawing = '<svg><path id="p{}" d="M {:.6f} 5.04 L 1e-05 -2"/>{}</svg>'
    path = tmp_path / "drawing.svg"
    for name, x, words, kept in (
        ("0123456789", 36.334414, "", False),
        ("abcdef0123", 36.334418, "", True),
        ("0123456789", 36.434418, "", False),
        ("0123456789", 36.434418, "<g/>", False),
    ):
        before = path.read_bytes() if path.exists() else b""
        new = drawing.format(name, x, words).encode()
        keep_or_write(path, new)
        assert path.read_bytes() == (before if kept else new)
    pixels = np.full((20, 30, 3), 200, dtype=np.uint8)
    path = tmp_path / "picture.png"
    for change, kept in ((0, False), (3, True), (60, False)):
        pixels[4, 4] = 200 - change
        buffer = io.BytesIO()
        Image.fromarray(pixels).save(buffer, "png")
        before = path.read_bytes() if path.exists() else b""
        keep_or_write(path, buffer.getvalue())
        assert path.read_bytes() == (before if kept else buffer.getvalue())


@pytest.mark.long
def test_drawings_are_those_that_are_kept(tmp_path, monkeypatch):
    """Drawn anew on this machine, no drawing of the documents changes."""
    import shutil

    monkeypatch.syspath_prepend(ROOT / "docs")
    picture = script("picture")
    monkeypatch.setattr(picture, "IMAGES", tmp_path)
    kept = {path.name: path.read_bytes() for path in (ROOT / "docs" / "images").glob("*.svg")}
    for name in kept:
        shutil.copy(ROOT / "docs" / "images" / name, tmp_path / name)
    picture.drawings()
    changed = [path.name for path in tmp_path.iterdir() if kept.get(path.name) != path.read_bytes()]
    assert changed == []


def test_every_figure_is_listed():
    """The page of figures lists all that a flight can have, in the order in which they are drawn."""
    assert re.findall(r"^\| `(\w+)` \|", page("figures.md"), re.MULTILINE) == figure_names()
