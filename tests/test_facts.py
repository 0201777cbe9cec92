"""Facts to show: the same on a console, in a notebook, on a page and as JSON, and whole at any width."""

import html
import io
import json
import os
import re
import xml.etree.ElementTree as ET
from collections import Counter
from functools import cache
from typing import Any

import pytest
from rich.console import Console
from sample_flights import quadrotors, swarm
from test_report import Page
from test_sweep import everything

import rigidfleet as rf
from rigidfleet import plotting
from rigidfleet._common.facts import Fact, FactTable, Line, Row, Sheet, table_of_worst_values, value
from rigidfleet._common.quantities import QUANTITIES
from rigidfleet._common.text import all_hold_in_words
from rigidfleet._common.waypoints import UNITS
from rigidfleet.cli import app, console
from rigidfleet.math.margins import Margins
from rigidfleet.mission import mission_names
from rigidfleet.preflight.check import check
from rigidfleet.reporting import report_page
from rigidfleet.reporting.contents import page_contents
from rigidfleet.sweep.metrics import readable_unit
from rigidfleet.sweep.record import reason_in_words
from rigidfleet.sweep.summary import summarise
from rigidfleet.tuning.outcome import Flown, Tuned

SHOW = """
schema_version = 1
name = "lights"
assignment = "each"
[agents]
mass = 0.3
radius = 0.15
thrust_limit = 6.5
position = {shape = "grid", size = 2, count = 16, centre = [0, 0, 0.2]}
[limits]
separation = 0.5
speed = 6.0
vertical_speed = 3.0
[formations.pads]
shape = "grid"
size = 2.0
edges = []
[formations.ball]
shape = "sphere"
size = 2.5
edges = []
colour = "#ffb000"
[[obstacles]]
kind = "ground"
[[phases]]
kind = "takeoff"
height = 10.0
duration = 8.0
[[phases]]
kind = "establish"
formation = "ball"
duration = 10.0
[[phases]]
kind = "reshape"
formation = "pads"
duration = 9.0
[[phases]]
kind = "land"
duration = 8.0
"""


@pytest.fixture(scope="module")
def flights() -> list[rf.Result]:
    """A flight of points with edges that breaks limits, and one of quadrotors."""
    return [swarm(4, 10.0), quadrotors(3, 20.0)]


@pytest.fixture
def quick(monkeypatch):
    """Figures of a page in no time."""
    monkeypatch.setattr(plotting, "render_figure", lambda *_: {"svg": b"<svg/>"})


@cache
def checked(name: str) -> Any:
    """The check of a shipped mission, or of the show."""
    return check(rf.Mission.from_toml(SHOW) if name == "show" else name)


def printed(thing: Any, width: int = 400) -> str:
    """What a console of some width shows."""
    out = io.StringIO()
    Console(width=width, file=out).print(thing)
    return out.getvalue()


def plain(text: str) -> str:
    """Text with its blanks alike."""
    return " ".join(text.split())


def rows_of(text: str) -> list[str]:
    """Each row of the tables of some HTML, as text."""
    root = ET.fromstring(f"<all>{text.replace('<br>', '<br/>')}</all>")
    rows = [" ".join("".join(cell.itertext()) for cell in row) for row in root.iter("tr")]
    return [plain(row) for row in rows]


def tuned() -> Tuned:
    """A study that halved an error."""
    before, after = (
        Flown({"tracking.Q": q}, 2, 0, 2, {"tracking_error": [e, e]}) for q, e in ((1.0, 0.2), (4.0, 0.1))
    )  # fmt: skip
    margins = {"tracking": Margins(True, (0.1, 9.0), 1.0, 0.2)}
    return Tuned("pair", "tracking", "tracking_error", before, after, (margins, margins), 4, 2, 0)


SHOWN = {
    "mission": lambda _: rf.load_mission("narrow-passage"),
    "check": lambda _: checked("narrow-passage"),
    "check of vehicles": lambda _: checked("crazyflies"),
    "check of a show": lambda _: checked("show"),
    "result": lambda flights: flights[0],
    "verdict": lambda flights: rf.assess(flights[0]),
    "verdict on quadrotors": lambda flights: rf.assess(flights[1]),
    "summary of a sweep": lambda _: summarise(everything()),
    "outcome of a study": lambda _: tuned(),
}


@pytest.mark.parametrize("what", SHOWN)
def test_consoles_notebooks_and_pages_show_the_same_rows(what, flights):
    """Each row of each table (name, values, units, level) is the same on a console, in a notebook and on a page."""
    thing = SHOWN[what](flights)
    sheet = thing.facts()
    tables = [part for part in sheet.shown_parts if isinstance(part, FactTable)]
    notebook = rows_of(thing._repr_html_())
    page = [row for table in tables for row in rows_of(table.html("kind"))]
    assert page == notebook
    lines = [plain(line) for line in printed(thing).splitlines()]
    for table in tables:
        rows = rows_of(table.html())
        # Names of columns may stand in two lines there, and a repeated heading is not repeated.
        body = rows if table.bare else rows[1:]
        assert len(body) == len(table.rows) > 0
        for row, cells in zip(body, table.cell_texts, strict=True):
            assert row in lines or plain(" ".join(cells[1:])) in lines, row
    sentences = [part.text for part in sheet.shown_parts if isinstance(part, Line)]
    words = plain(html.unescape(thing._repr_html_().replace("<br>", " ")))
    assert all(plain(text) in words for text in sentences)
    assert all(plain(text) in plain(" ".join(lines)) for text in sentences)


def near(text: str, number: float) -> bool:
    """Whether a shown number is a number, rounded to at least two digits."""
    return float(text) == pytest.approx(number, rel=0.05, abs=1e-12)


@pytest.mark.parametrize("which", [0, 1])
def test_a_verdict_shows_what_its_json_holds(flights, which):
    """Name, value, unit and level of each check in JSON stand in a row, and no other rows do."""
    verdict = rf.assess(flights[which])
    data = json.loads(verdict.json())
    head, *rows = rows_of(verdict.facts().shown_parts[-len(verdict.notes) - 2].html())
    assert head.startswith("check worst limit")
    checks = [c for c in data["checks"] if c["worst"] is not None or c["when"] is not None]
    for c, row in zip(checks, rows, strict=True):
        name = c["check"].replace("_", " ") + ", at samples" * c["at_samples"]
        level = "FAILED" if not c["passed"] else "ok" * c["judged"]
        words = row.removeprefix(f"{name} ").split()
        assert row.startswith(name)
        if c["worst"] is not None:
            assert near(words[0], c["worst"]), row
            assert words[1:2] == [c["unit"].replace("^2", "²")] or not c["unit"], row
        assert words[-1] == level if level else words[-1] not in ("ok", "FAILED"), row
    for phase, row in zip(
        data["phases"], rows_of(verdict.facts().shown_parts[0].html())[1:], strict=True
    ):
        numbers = row.removeprefix(phase["name"]).split()
        values = {k: e["value"] for k, e in phase["worst"].items()}
        wanted = [
            phase["t_end"], phase["constraint"], values.get("constraint"), phase["shape"],
            *(values.get(k) for k in ("separation", "clearance", "speed", "thrust")),
        ]  # fmt: skip
        wanted = [x for x in wanted if x is not None]
        assert all(near(x, y) for x, y in zip(numbers, wanted, strict=True)), row


@pytest.mark.parametrize("name", ["bridge-inspection", "ferris-wheel", "hexagon", "market-square"])
def test_a_verdict_has_one_set_of_facts(name):
    """Name, value, unit and level of what has a value are the same in tables and JSON; misses are those of the checks.

    Of a flight without edges, neither has anything of edges.
    """
    verdict = rf.assess(rf.simulate(name))
    data = json.loads(verdict.json())
    tables = {x.heads[0]: x for x in verdict.facts().shown_parts if isinstance(x, FactTable)}
    shown = {(*map(str, row.cells[:2]), row.level) for row in tables["check"].rows if row.cells[1]}
    judged = {True: "ok", False: ""}
    held = {
        (
            c["check"].replace("_", " ") + ", at samples" * c["at_samples"], value(c["worst"], c["unit"]),
            judged[c["judged"]] if c["passed"] else "fails",
        )
        for c in data["checks"] if c["worst"] is not None
    }  # fmt: skip
    assert shown == held
    points = [
        (w["time"], *(w[x] for x in UNITS))
        for p in data["phases"]
        for w in (*p["through"], p["waypoint"], p["stay"])
        if w is not None
    ]
    table = tables.get("waypoint, missed by", FactTable(("", ""), []))
    assert [row.cells[1:] for row in table.rows] == [[f"{t:.2f}", *x] for t, *x in points]
    worst = {c["check"]: c["worst"] for c in data["checks"]}
    for k, what in enumerate(UNITS):
        misses = [point[1 + k] for point in points if point[1 + k] is not None]
        assert worst.get(f"waypoint_{what}") == max(misses, default=None)
    edges = {name for name, q in QUANTITIES.items() if q.of_edges}
    for keys in (worst, data["worst"], *(p["worst"] for p in data["phases"])):
        assert bool(edges & keys.keys()) == (name != "market-square")


@pytest.mark.parametrize("name", ["narrow-passage", "crazyflies", "market-square", "show"])
def test_a_check_shows_what_its_json_holds(name):
    """Worst values of the plan with unit, limit, time and who, and each remark with its level, are those of JSON."""
    ahead = checked(name)
    data = json.loads(json.dumps(ahead.data(), allow_nan=False))
    words = plain(printed(ahead))
    paths, vehicles = data["paths"], data["vehicles"] or {}
    proof = min(paths["certificates"], key=lambda c: c["separation_m"], default=None)
    worst: list[tuple[str, str, Any, str]] = [
        ("separation", "m", paths["separation"], "separation_m"),
        ("speed", "m/s", paths["speed"], "speed_m_s"),
        ("acceleration", "m/s²", paths.get("acceleration"), "acceleration_m_s2"),
        ("vertical speed", "m/s", paths["vertical_speed"], "speed_m_s"),
        ("thrust", "N", paths["thrust"], "thrust_n"),
        ("rotor force", "N", vehicles.get("rotor_force"), "force_n"),
        ("tilt", "deg", vehicles.get("tilt"), "tilt_deg"),
        ("separation, proved", "m", proof, "separation_m"),
        ("thrust, disturbed", "N", (data["disturbances"] or {}).get("thrust"), "thrust_n"),
        *(("width of a gap", "m", g, "wide_m") for g in paths["gaps"]),
        *(("clearance", "m", c, "clearance_m") for c in paths["clearance"]),
    ]  # fmt: skip
    tables = [part for part in ahead.facts().shown_parts if isinstance(part, FactTable)]
    every = rows_of(next(table for table in tables if table.heads[0] == "planned").html())
    rows = [row for row in every[1:] if not row.startswith(("spacing", "reserve", "force of"))]
    forces = [v for k, v in (data["disturbances"] or {}).items() if k.endswith("_n") and v > 0]
    alone = {"reserve of automatic times": [data["reserve_s"]], "force of": forces}
    for what, values in alone.items():
        shown = [row.removeprefix(what).split()[-2] for row in every if row.startswith(what)]
        assert all(near(x, y) for x, y in zip(shown, filter(None, values), strict=True)), what
    wanted = [x for x in worst if x[2] is not None]
    assert len(rows) == len(wanted)
    for row, (what, unit, entry, key) in zip(rows, wanted, strict=True):
        match = re.match(
            rf"{what} (\S+) {re.escape(unit)} (?:[<>]=? (\S+) {re.escape(unit)} )?(\S+) (.*)$", row
        )
        assert match, row
        assert near(match[1], entry[key])
        assert float(match[3]) == pytest.approx(entry["time_s"], abs=0.006)
        agents = " and ".join(map(str, entry.get("agents", ())))
        assert match[4].startswith(entry.get("who") or entry.get("between") or f"agents {agents},")
        limits = [x for key, x in entry.items() if key.startswith(("limit_", "takes_"))]
        if limits:  # of what has a limit in JSON, the row has the same, or both have none
            assert near(match[2], limits[0]) if limits[0] is not None else match[2] is None, row
    assert all(
        f"{r['level']} {plain(r['text'])}" in words or plain(r["text"]) in words
        for r in data["remarks"]
    )
    shown = numbers_shown(ahead)
    wanted = numbers_wanted(data, name in ("show", "market-square"))
    assert shown.keys() == wanted.keys()
    for key, values in wanted.items():
        assert all(near(x, y) for x, y in zip(shown[key], values, strict=True)), key


#: Kinds of shapes in JSON, in the order of their columns.
KINDS = ("same", "mirror image", "folded", "coincident")


@pytest.mark.parametrize(
    "name", ["narrow-passage", "cube-passage", "hexagon", "pyramid", "square", "drift"]
)
def test_words_on_a_graph_are_those_of_json(name):
    """Redundant edges and free motions, how many and the first of them, and the solver are those of JSON."""
    ahead = check(name)
    data = json.loads(json.dumps(ahead.data()))["formations"]
    table = next(
        x for x in ahead.facts().shown_parts if isinstance(x, FactTable) and x.heads[0] == "graph"
    )
    names = [column for column, *_ in table.names_units_words]
    rows = {row[0]: dict(zip(names, row, strict=True)) for row in table.cell_texts}
    for form, judged in data.items():
        r, row = judged["rigidity"], rows.get(form, {})
        edges, flexes = (
            re.match(r"(\d+) \((.*)\)", row.get(x) or "0 ()")
            for x in ("redundant edges", "free motions")
        )
        assert edges
        assert flexes
        assert [int(edges[1]), int(flexes[1])] == [len(r["redundant"]), len(r["flexes"])]
        shown = re.findall(r"(\d+)-(\d+)", edges[2])
        assert [[int(i), int(j)] for i, j in shown] == r["redundant"][:6]
        who = [part.partition(" in ") for part in flexes[2].split("; ")]
        agents = Counter(tuple(flex["agents"]) for flex in r["flexes"])
        for (words, _, ways), (each, count) in zip(who[:2], agents.items(), strict=False):
            assert tuple(int(x) for x in re.findall(r"\d+", words)) == each
            assert ways == (f"{count} directions" if count > 1 else "")
        assert bool(who[0][0]) == bool(agents)
        assert bool(row.get("solved by")) == (judged["solve"] != "dense")


def numbers_shown(ahead: Any) -> dict[tuple[str, str], list[str]]:
    """Numbers in the tables of a check but for worst values: by table and row, in the order of the columns."""
    shown = {}
    for table in ahead.facts().shown_parts[1:]:
        if isinstance(table, FactTable) and not table.bare and table.heads[0] != "planned":
            graph = table.heads[0] == "graph"  # of whose words there is a test
            for row, *cells in table.cell_texts:
                rest = zip(cells, table.names_units_words[1:], strict=True)
                text = " ".join(cell for cell, (*_, words) in rest if not (graph and words))
                numbers = re.findall(r"(?<![\w.])[-\d.][\d.e+-]*", text)
                shown[table.heads[0], row] = numbers
    return shown


def numbers_wanted(data: Any, show: bool) -> dict[tuple[str, str], list[float]]:
    """The same numbers as JSON has them, in the units of the columns."""
    gains, wanted = data["gains"], {}
    for form, judged in {} if show else data["formations"].items():
        r = judged["rigidity"]
        wanted["formation", form] = [r[k] for k in ("edges", "rank", "needed", "index", "w")] + [
            1 / r["index"]
        ]
        numbers = [] if r["reachable"] == r["needed"] else [r["reachable"]]
        if (others := judged["realisations"]) is not None:
            kinds = [[x for x in others["found"] if x["kind"] == kind] for kind in KINDS]
            counts = [sum(x["found"] for x in shapes) for shapes in kinds]
            bent = sum(x["found"] for x in others["found"] if x["bends"])
            numbers += [others["starts"], counts[0], *filter(None, (*counts[1:], bent))]
        wanted |= {("graph", form): numbers} if numbers else {}
    if not show:
        force = max(gains["force_per_error_n_m"].values()) / 100
        numbers = [gains["margin"], gains["settling_time_s"], 100 * gains["overshoot"], force]
        wanted["gains", "stable"] = numbers
    # Of a show, margins are shown only where one is unstable.
    margins: dict[str, Any] = (not show and data["margins"]) or {"tracking": None, "formations": {}}
    own = {"tracking": margins["tracking"]} if margins["tracking"] else {}
    for where, m in (own | margins["formations"]).items():
        numbers = [1e3 * m["delay_s"], m["phase_deg"], *m["gain"], m.get("largest_p")]
        wanted["margins", where] = [x for x in numbers if x is not None]
    for name, way in data["paths"]["assignments"].items():
        wanted["assignment", name] = [way["path_length_m"], way["min_clearance_m"]]
    return wanted


def test_a_summary_of_a_sweep_shows_what_its_json_holds():
    """Percentiles with units, reasons of failure, strong correlations and the rate of success are those of JSON."""
    summary = summarise(everything())
    data, parts = json.loads(summary.json()), summary.facts().shown_parts
    tables = {x.heads[0]: x for x in parts if isinstance(x, FactTable)}
    assert tables["metric"].cell_texts == [
        [name, readable_unit(data["units"][name]), *map(value, by_percent.values())]
        for name, by_percent in data["percentiles"].items()
    ]
    assert [row[:2] for row in tables["failed check"].cell_texts] == [
        [reason_in_words(reason), f"{count}"] for reason, count in data["reasons"].items()
    ]
    sure = [d for d in data["drivers"] if d["adjusted"] < data["false_discovery_rate"]]
    wanted = [[d["varied"], d["outcome"], f"{d['correlation']:+.2f}"] for d in sure]
    assert tables["varied number"].cell_texts == wanted
    passed, last = data["success"], parts[-1]
    assert isinstance(last, Line)
    assert last.text.startswith(f"{passed['count']} of {passed['of']} runs passed")
    assert last.level == "note"


@pytest.mark.usefixtures("quick")
def test_the_page_has_the_tables_of_its_objects(flights):
    """The report of a flight has the phases of its mission and its verdict's tables, row by row, with their words."""
    page = report_page(flights[0])
    tables = re.findall(r"<table.*?</table>", page, flags=re.DOTALL)
    rows = [row for table in tables for row in rows_of(table)]
    for sheet in (flights[0].mission.facts(), rf.assess(flights[0]).facts()):
        for part in sheet.shown_parts:
            if isinstance(part, FactTable):
                assert all(row in rows for row in rows_of(part.html()))
    words = [x for x in sheet.shown_parts if isinstance(x, Line) and not x.level]
    assert words
    assert all(x.html() in page for x in words)
    assert page.count('<div class="table"><table') == len(tables), "each scrolls by itself"


SHOWS = ["show", "show-1000", "market-square"]


@pytest.mark.parametrize("name", SHOWS)
def test_a_show_is_checked_for_nothing_of_edges_and_laws(name):
    """Of shows that ship, as of one that is made up, spacing is shown, and no edges, solvers, gains and margins."""
    ahead = checked(name)
    assert ahead.is_show
    words = plain(printed(ahead))
    alien = r"gain|overshoot|rigid|edge|distances|margin|phase \[deg\]|delay|solve|gradients|factor"
    assert not re.search(alien, words), words
    assert f"spacing, centre to centre {value(ahead.formations[0].spacing_m)} m" in words
    assert words.endswith("no problems found")


def test_a_show_whose_tracking_is_unstable_has_its_margins():
    """Where lag and delay make the tracking of a show unstable, its check shows the margins, and what to do."""
    data = rf.load_mission("market-square").to_dict()
    data["tracking"]["integral"] = 50.0
    ahead = check(rf.load_mission("market-square").rewritten(data))
    assert ahead.is_show
    assert not ahead.passed
    words = plain(printed(ahead))
    assert "margins tracking unstable" in words
    assert "lower tracking.Q" in words


def test_a_show_is_checked_for_what_concerns_it():
    """Spacing, start, speeds, proof and lights are told of tracked slots without edges."""
    ahead = checked("show")
    words = plain(printed(ahead))
    assert "spacing, centre to centre 2 m start" in words
    assert "spacing, centre to centre 2.5 m 'ball'" in words
    assert re.search(r"speed \S+ m/s <= 6 m/s", words)
    assert re.search(r"vertical speed \S+ m/s <= 3 m/s", words)
    assert "ball 1 colour of lights" in words
    assert re.search(r"separation, proved \S+ m >= 0.5 m \S+ agents \d+ and \d+, '\w", words)
    heights = [planned.velocity[..., 2] for planned in ahead.planned_phases]
    assert ahead.worst["vertical_speed"][0] == max(abs(v).max() for v in heights)


@pytest.mark.usefixtures("quick")
def test_the_report_of_a_show_has_nothing_of_edges():
    """A flight without edges has no gains of edges, no edges counted, and no row without a value."""
    result = rf.simulate(rf.Mission.from_toml(SHOW))
    page = page_contents([result], None, None)
    words = Page(report_page(result)).text
    assert not re.search(r"\(0 edges|no edges|overshoot|constraint f|tension|\|c\|", words), words
    checks = page["flights"][0]["checks"][-1]
    assert all(row[1] or row[3] for row in checks.cell_texts)
    assert "no edges" not in printed(rf.assess(result))


def test_what_applies_to_no_row_is_not_shown():
    """Columns without a value are left out, names of columns with them, and marks where nothing is judged."""
    facts = [Fact("speed", 3.0, "m/s"), Fact("height", 12345.0, "m")]
    assert table_of_worst_values("what", facts).cell_texts == [
        ["speed", "3 m/s"],
        ["height", "12345 m"],
    ]
    assert [name for name, *_ in table_of_worst_values("what", facts).names_units_words] == [
        "what",
        "worst",
    ]
    measured = table_of_worst_values(
        "what", [*facts, Fact("tilt", 9.0, "deg", interval=(8.5, 9.25))]
    )
    assert [name for name, *_ in measured.names_units_words] == ["what", "worst", "true value"]
    assert measured.cell_texts[2] == ["tilt", "9 deg", "8.5 to 9.25"]
    judged = table_of_worst_values("what", [*facts, Fact("tilt", 9.0, "deg", 5.0, level="fails")])
    assert judged.cell_texts[-1] == ["tilt", "9 deg", "<= 5 deg", "FAILED"]


@pytest.mark.parametrize(
    ("x", "text"),
    [(0.0, "0"), (0.00123, "0.00123"), (2.2e-5, "2.2e-05"), (999.4, "999"), (1234.4, "1234"), (123456.0, "1.2e+05")],
)  # fmt: skip
def test_numbers_have_three_digits(x, text):
    """Numbers have three digits; whole ones below 100,000 all of theirs; others a power of ten."""
    assert value(x) == text


@pytest.mark.parametrize(
    ("count", "words"),
    [(1, "the only check holds"), (2, "both checks hold"), (3, "all 3 checks hold")],
)
def test_checks_that_hold_are_counted_in_words(count, words):
    """One, two and more checks are told as one says them."""
    assert all_hold_in_words(count) == words


# -- width ---------------------------------------------------------------------------------------------


def assert_whole(thing: Any, width: int) -> None:
    """No line is wider than the console, and no word is cut or torn: they are those of a wide console."""
    narrow, wide = printed(thing, width), printed(thing, 2000)
    assert max(map(len, narrow.splitlines())) <= width
    assert "…" not in narrow
    missing = Counter(wide.split()) - Counter(narrow.split())
    assert not missing, missing


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize("what", SHOWN)
def test_tables_fit_eighty_columns(what, width, flights):
    """On 80 columns, and on more, each word and number is whole."""
    assert_whole(SHOWN[what](flights), width)


@pytest.mark.long
@pytest.mark.parametrize("name", mission_names())
def test_checks_of_shipped_missions_fit_eighty_columns(name):
    """The check and the phases of every shipped mission are whole on 80 columns."""
    mission = rf.load_mission(name)
    findings = check(mission)
    for width in (80, 132):
        assert_whole(findings, width)
        assert_whole(mission, width)


@pytest.mark.long
@pytest.mark.parametrize("name", [n for n in mission_names() if n != "show-1000"])
def test_verdicts_on_shipped_missions_fit_eighty_columns(name):
    """The verdict on every shipped mission but the largest is whole on 80 columns."""
    verdict = rf.assess(rf.simulate(name))
    for width in (80, 132):
        assert_whole(verdict, width)


GRAPH = ["design", "shells", "--agents", "40", "--edges", "henneberg-multilevel"]


@pytest.mark.parametrize(
    "line", [["missions"], ["design", "cube"], pytest.param(GRAPH, marks=pytest.mark.long)]
)
def test_lists_of_the_command_fit_eighty_columns(line, capsys, monkeypatch):
    """Tables of other verbs are whole on a terminal of 80 columns: no word of a wide one is missing."""
    texts = []
    for width in ("80", "400"):
        console.console.cache_clear()
        monkeypatch.setenv("COLUMNS", width)
        monkeypatch.setenv("FORCE_COLOR", "1")
        monkeypatch.setenv("NO_COLOR", "1")
        assert app.main(line) == 0
        out, err = capsys.readouterr()
        texts.append(re.sub(r"\x1b\[[\d;]*m", "", out if line == ["missions"] else err))
    console.console.cache_clear()
    # A sentence is left to the terminal to wrap, so that it can be copied.
    rows = [row for row in texts[0].splitlines() if not row.startswith("Look first")]
    assert max(map(len, rows)) <= 80
    assert not Counter(texts[1].split()) - Counter(texts[0].split())


@pytest.mark.parametrize(("columns", "width"), [(None, 80), ("0", 80), ("110", 110)])
@pytest.mark.parametrize("line", [["missions"], ["check", "ferris-wheel"]])
def test_tables_in_a_pipe_fit_eighty_columns(line, columns, width, capsys, monkeypatch):
    """In a pipe, tables fit COLUMNS, or else 80 columns, however wide a terminal behind it is; no word is lost."""
    monkeypatch.setattr(os, "get_terminal_size", lambda *_: os.terminal_size((300, 50)))
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    texts = []
    for size in (columns, "400"):
        console.console.cache_clear()
        monkeypatch.delenv("COLUMNS", raising=False)
        if size is not None:
            monkeypatch.setenv("COLUMNS", size)
        assert app.main(line) == 0
        texts.append(capsys.readouterr().out)
    console.console.cache_clear()
    rows = [row for row in texts[0].splitlines() if not row.startswith("Look first")]
    assert width - 10 < max(map(len, rows)) <= width
    assert not Counter(texts[1].split()) - Counter(texts[0].split())


def test_too_many_columns_stand_in_two_tables():
    """A table whose numbers do not fit stands as two, each with the first column; nothing is lost."""
    heads = ["name", *(f"column{k} [m]" for k in range(12))]
    table = FactTable(heads, [Row(["first", *(1.5 + k for k in range(12))])])
    text = printed(Sheet("a", "b", [table]), 60)
    assert max(map(len, text.splitlines())) <= 60
    assert all(f"{1.5 + k:g}" in text.split() for k in range(12))
    assert text.split().count("first") >= 2
