"""The report of a flight, and of several side by side."""

import hashlib
import html.parser
import json
import math
import re
import xml.etree.ElementTree as ET
from base64 import b64decode
from pathlib import Path

import numpy as np
import pytest
from sample_flights import quadrotors

from rigidfleet import plotting
from rigidfleet.assessment import Safety, assess, safety
from rigidfleet.assessment.verdict import Extreme
from rigidfleet.cli.app import main
from rigidfleet.errors import ResultError
from rigidfleet.mission import Mission
from rigidfleet.reporting import gains, overlay, report, report_page
from rigidfleet.reporting.contents import page_contents
from rigidfleet.result import Result
from rigidfleet.simulation.flight import simulate
from rigidfleet.simulation.trajectories import trajectories
from rigidfleet.sweep.store import read as load

TOML = """
schema_version = 1
name = "pair"
title = "Three <b>climb</b> & turn"
[agents]
mass = [1.0, 1.0, 2.0]
position = [[0, 0, 1], [4, 0, 1], [2, 3.4641016151377544, 1]]
thrust_limit = 30.0
[formations.triangle]
shape = "triangle"
size = 4.0
[[obstacles]]
kind = "ground"
[limits]
speed = 9.0
separation = 1.0
geofence = {min = [-5, -5, 0], max = [15, 15, 12]}
[[phases]]
kind = "establish"
formation = "triangle"
duration = 4.0
[[phases]]
kind = "fly"
position = [6, 3, 8]
duration = 8.0
"""


@pytest.fixture(scope="module")
def calm() -> Result:
    return simulate(Mission.from_toml(TOML))


@pytest.fixture(scope="module")
def hasty() -> Result:
    """The same in half the time, with other gains; it breaks two limits."""
    text = TOML.replace("duration = 8.0", "duration = 3.0").replace("speed = 9.0", "speed = 2.0")
    text += "[constraint]\nalpha = 2\nbeta = 3\ngamma = 0\n"
    return simulate(Mission.from_toml(text.replace("max = [15, 15, 12]", "max = [15, 15, 7]")))


@pytest.fixture
def quick(monkeypatch):
    """Figures of a flight in no time."""

    def draw(result, folder, *, formats, names):
        for name in names:
            Path(folder, f"{name}.svg").write_text(f"<svg>{name}</svg>", encoding="utf-8")

    monkeypatch.setattr(plotting, "plot", draw)


def worst(row: Safety) -> Extreme:
    """The worst of a quantity that was measured."""
    assert row.worst is not None
    return row.worst


class Page(html.parser.HTMLParser):
    """What a page consists of: its words, its links, whether each element is closed."""

    VOID = frozenset({"meta", "img", "link", "br"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.sources: list[str] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.sources += [v for k, v in attrs if k in ("src", "href") and v]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "title"):
            self.words.append(data)


def test_page_is_whole(calm, tmp_path):
    """The page is well-formed, holds all its figures as SVG, and asks nothing of a network."""
    path = tmp_path / "report.html"
    report(calm, path)
    page = Page(path.read_text(encoding="utf-8"))
    # and the sketch of the first page
    assert len(page.sources) == len(plotting.figure_names(calm)) + 1
    for source in page.sources:
        head, _, data = source.partition(",")
        assert head == "data:image/svg+xml;base64"
        assert ET.fromstring(b64decode(data)).tag.endswith("svg")
    assert "default-src 'none'" in path.read_text(encoding="utf-8")


def test_verdict_comes_first(calm, hasty, quick):
    """The verdict stands before all else, in words that are those of the verdict."""
    assert "Passed" in Page(report_page(calm)).text.split("Safety")[0]
    first = Page(report_page(hasty)).text.split("Safety")[0]
    assert "Failed" in first
    failed = [f.message for f in assess(hasty).checks if not f.passed]
    assert len(failed) == 2
    assert all(message in first for message in failed)


def test_words_of_users_are_words(calm, quick):
    """What a user writes into a title stays text, whatever it looks like."""
    assert "<b>climb" not in report_page(calm)
    assert "Three <b>climb</b> & turn" in Page(report_page(calm)).text


def test_safety(calm):
    """Every quantity has its worst value, its limit and what is left, as measured on the result."""
    rows = {row.quantity: row for row in safety(calm, assess(calm))}
    assert list(rows) == [
        "separation", "separation as planned", "clearance", "geofence", "lowest", "highest", "speed", "acceleration",
        "thrust", "tracking error",
    ]  # fmt: skip
    z, r = calm.position[..., 2], calm.position
    assert worst(rows["highest"]).value == z.max()
    assert rows["highest"].margin == pytest.approx(12 - z.max())
    assert worst(rows["lowest"]).value == z.min()
    assert rows["lowest"].margin == pytest.approx(z.min())
    outside = np.maximum([-5, -5, 0] - r, r - [15, 15, 12]).max()
    assert worst(rows["geofence"]).value == pytest.approx(outside)
    assert rows["geofence"].passed
    assert rows["thrust"].used == pytest.approx(calm.thrust.max() / 30)
    assert rows["speed"].limit == 9.0
    assert rows["acceleration"].limit is None
    assert rows["acceleration"].margin is None
    assert rows["separation"].margin == pytest.approx(np.min(calm.separation) - 1.0)


def test_safety_of_a_flight_that_breaks_limits(hasty):
    """What is beyond its limit is so in the verdict and on the safety page alike, ceiling included."""
    verdict = assess(hasty)
    broken = {row.quantity for row in safety(hasty, verdict) if not row.passed}
    assert {f.check for f in verdict.checks if not f.passed} == {"geofence", "speed"}
    assert broken == {"geofence", "speed", "highest"}
    assert all((row.margin or 0.0) < 0 for row in safety(hasty, verdict) if not row.passed)


def test_downwash_is_measured_without_a_limit():
    """One vehicle above another is noticed even where the mission sets no limit to it."""
    text = TOML.replace("[4, 0, 1]", "[0.1, 0, 3]").replace("establish", "hold")
    text = text.replace('formation = "triangle"\nduration = 4.0', "duration = 1.0")
    result = simulate(Mission.from_toml(text))
    (row,) = (row for row in safety(result, assess(result)) if row.quantity == "separation below")
    assert row.limit is None
    assert worst(row).value == pytest.approx(1.5)
    assert worst(row).who == "agents 1 and 2"


def test_vehicles_with_rotors(calm, quick):
    """A flight by quadrotors tells models, rotors, tilt, tracking and saturation; beside points, these have none."""
    result = quadrotors(3, 20.0)
    rows = {row.quantity: row for row in safety(result, assess(result))}
    assert list(rows)[-3:] == ["rotor force", "tilt", "tracking error"]
    assert worst(rows["rotor force"]).who == "agent 2"
    assert rows["rotor force"].used == pytest.approx(1.0)
    assert worst(rows["tilt"]).value == pytest.approx(20.0)
    text = Page(report_page(result)).text
    assert "3 × px4-sih" in text
    assert "share of rotor limit" in text
    both = Page(report_page([calm, result])).text
    assert "flown by points" in both
    assert "force of the rotor that comes nearest to its limit" in both
    assert "rotor" not in Page(report_page(calm)).text


def test_words_for_nothing_may_wrap():
    """A sentence that stands for a worst value is in a column of words: it leaves the others their width."""
    alone = trajectories([0.0, 1.0], np.zeros((2, 1, 3)), separation=1.0)
    table = page_contents([alone], None, None)["safety"]
    (row,) = (cells for cells in table.cell_texts if cells[0].startswith("separation"))
    (column,) = (k for k, cell in enumerate(row) if cell == "only one agent")
    assert table.names_units_words[column][2]


def test_safety_has_no_row_of_what_does_not_apply():
    """A limit that nothing can break, as nobody flies below another, has a row beside a flight that has the value."""
    text = TOML.replace("separation = 1.0", "separation = 1.0\nseparation_below = 1.0")
    apart = simulate(Mission.from_toml(text))
    stacked = trajectories(
        [0.0, 1.0], np.zeros((2, 2, 3)) + [[0, 0, 1], [0, 0, 9]], radius=0.2, limits={"separation_below": 1.0}
    )  # fmt: skip
    for flights, words in (([apart], None), ([apart, stacked], "no agent flies below another")):
        table = page_contents(flights, None, None)["safety"]
        rows = [cells for cells in table.cell_texts if cells[0].startswith("separation below")]
        assert [row[1] for row in rows] == [words] * (words is not None)


def test_legends_of_several_flights_are_whole(calm, hasty):
    """Names of flights are not cut, and long ones stand below each other within the page."""
    labels = [f"flights/with a name of its own and more/{k}" for k in range(2)]
    for draw in (overlay.svg_of_paths, overlay.svg_of_time_curves):
        root = ET.fromstring(draw([calm, hasty], labels))
        rows = [str(e.get("transform")) for e in root.iter() if e.text in labels]
        assert len(rows) == 2
        assert len({row.split("(")[1].split(" ")[0] for row in rows}) == 1, rows


def test_flights_side_by_side_have_no_empty_panel():
    """What no flight has, as a lone trajectory has neither a separation nor a thrust, has no axes."""
    way = np.linspace([[0.0, 0.0, 1.0]], [[3.0, 0.0, 1.0]], 4)
    alone = trajectories(np.arange(4.0), way, cubic=True)
    root = ET.fromstring(overlay.svg_of_time_curves([alone, alone], ["one", "other"]))
    words = " ".join(e.text for e in root.iter() if e.text)
    assert "greatest speed [m/s]" in words
    assert not re.search(r"separation|thrust|clearance|constraint", words)


def test_side_by_side(calm, hasty, quick):
    """Of several flights the page tells what differs: numbers, keys of the missions, overlaid figures."""
    page = page_contents([calm, hasty], ["calm", "hasty"], None)
    assert {row.cells[0] for row in page["keys"].rows} == {
        "constraint.alpha", "constraint.beta", "constraint.gamma", "limits.geofence.max",
        "limits.speed", "phases[2].duration",
    }  # fmt: skip
    numbers = {name: cells for name, *cells in (row.cells for row in page["numbers"].rows)}
    assert [cell.text for cell in numbers["length of the flight [s]"]] == ["12", "7"]
    assert numbers["greatest speed of a vehicle [m/s]"][1].small.startswith(("+", "×"))
    one, other = numbers["least distance between two vehicles' surfaces [m]"]
    assert one == other
    assert len(page["overlays"]) == 2
    text = Page(report_page([calm, hasty], labels=["calm", "hasty"])).text
    for words in ("2 flights side by side", "Differences", "calm", "hasty", "Passed", "Failed"):
        assert words in text


def test_flights_of_one_mission_are_numbered(calm, quick):
    """Two flights of one mission are told apart, and their missions found to be the same."""
    page = page_contents([calm, calm], None, None)
    assert [flight["label"] for flight in page["flights"]] == ["pair (1)", "pair (2)"]
    assert page["keys"].rows == []
    assert all(one == other for _, one, other in (row.cells for row in page["numbers"].rows))


def test_gains_mean_what_they_do():
    """The triple pole overshoots by 24.9 %, may have nine times its gamma, and tracking is what it is."""
    lines = {line[0]: line for line in gains.gain_lines(Mission.from_toml(TOML))}
    assert lines["poles of the error"][1] == "-2, -2, -2 /s"
    assert lines["stability margin"][1] == "9"
    assert lines["overshoot"][1] == "24.9 %"
    assert lines["tracking"][1] == "k₁ = 2 /s², k₂ = 2.83 /s"
    assert f"damping ratio {math.sqrt(8) / (2 * math.sqrt(2)):.2f}" in lines["tracking"][2]
    assert "finite horizon" in " ".join(lines)


@pytest.mark.parametrize(
    ("tables", "present", "absent"),
    [
        ("[constraint]\nstabilisation = 'none'\n", "constraint force", "overshoot"),
        ("[constraint]\ngamma = 0\n", "overshoot", "stability margin"),
        ("[lqr]\nhorizon = 'infinite'\nQ = [1, 4]\n", "attitude, infinite horizon", "x"),
    ],
)
def test_gains_of_other_missions(tables, present, absent):
    """Gains that are not there are not explained."""
    whats = [line[0] for line in gains.gain_lines(Mission.from_toml(TOML + tables))]
    assert present in whats
    assert absent not in whats


def test_slowest_of_overdamped_gains():
    """Gains that creep are said to take as long as their slow pole does."""
    mission = Mission.from_toml(TOML + "[tracking]\nQ = [1, 100]\n")
    (line,) = (line for line in gains.gain_lines(mission) if line[0] == "tracking")
    slow = min(abs(np.roots([1, math.sqrt(102), 1])))
    assert f"in about {4 / slow:.2g} s" in line[2]


def test_flight_that_broke_off(tmp_path, quick):
    """A flight that could not be flown to its end has a report, which says so."""
    text = TOML.replace("duration = 8.0", "settle = {tolerance = 1e-15, timeout = 2}\ntravel = 1.0")
    result = simulate(Mission.from_toml(text))
    report(result, tmp_path / "report.html")
    words = Page((tmp_path / "report.html").read_text(encoding="utf-8")).text
    assert "Failed" in words
    assert "incomplete" in words


def test_one_agent_alone(tmp_path, quick):
    """A flight of one vehicle, without edges, obstacles or limits, has a report too, alone and beside others."""
    text = re.sub(r"\[formations.*?(?=\[\[phases\]\])", "", TOML, flags=re.DOTALL)
    text = re.sub(r"position = \[\[0.*", "position = [[0, 0, 1]]", text).replace(
        "mass = [1.0, 1.0, 2.0]", "mass = 1"
    )
    text = text.replace('kind = "establish"\nformation = "triangle"', 'kind = "hold"')
    alone = simulate(Mission.from_toml(text))
    for flights in (alone, [alone, alone]):
        report(flights, tmp_path / "report.html")
        Page((tmp_path / "report.html").read_text(encoding="utf-8"))


def test_many_vehicles(quick):
    """Of more vehicles than a page takes, those with the most thrust have a row."""
    n = 40
    text = f"""
schema_version = 1
name = "many"
agents = {{mass = {[1 + 0.01 * i for i in range(n)]}, position = {[[3 * i, 0, 1] for i in range(n)]}}}
phases = [{{kind = "hold", duration = 1}}]
"""
    page = page_contents([simulate(Mission.from_toml(text))], None, None)
    (flight,) = page["flights"]
    shown = [row.cells[0].text for row in flight["vehicles"].rows]
    assert shown == [str(i) for i in range(17, 41)]
    assert flight["vehicles_left_out"] == 16


def test_what_cannot_be_reported(calm, tmp_path, quick):
    """No flight, labels that do not fit, and a folder that is not there are errors that say so."""
    with pytest.raises(ValueError, match="needs a result"):
        report_page([])
    with pytest.raises(ValueError, match="as many labels"):
        report_page([calm], labels=["a", "b"])
    with pytest.raises(ResultError, match="no folder"):
        report(calm, tmp_path / "none" / "report.html")


def first_page(path):
    """The words before the safety table."""
    return Page(path.read_text(encoding="utf-8")).text.split("Safety")[0]


def test_the_first_page_says_what_drill_and_aborts_have_shown(calm, tmp_path, capsys):
    """Counts, magnitudes and the first failure are those of the rows; times and distances those of the file."""
    calm.save(tmp_path / "pair.nc")
    mission = tmp_path / "pair.toml"
    mission.write_text(calm.mission_text)
    (tmp_path / "day.toml").write_text(
        'mission = "pair.toml"\n[drill]\nshifted = [0.1, 20.0]\nrotated = [0.5]\nvehicles = [1]\ntrials = 2\n'
    )
    drill, home, page = tmp_path / "drill", tmp_path / "home", tmp_path / "report.html"
    more = ["--out", str(drill), "--no-figures", "--quiet", "--workers", "1"]
    assert main(["sweep", str(tmp_path / "day.toml"), *more]) == 0
    assert main(["check", str(mission), "--abort", "--out", str(home)]) == 0
    data = json.loads((home / "aborts.json").read_text())
    flight = ["report", str(tmp_path / "pair.nc"), "--no-figures", "--quiet", "--force"]
    assert main([*flight, "--drill", str(drill), "--abort", str(home)]) == 0
    text, table = first_page(page), load(drill)
    assert f"{int(table.passed.sum())} of {len(table.run)} faults are harmless." in text
    assert "Shifted: none fails by 0.1; 4 of 4 fail by 20 m:" in text
    rows = [k for k in range(len(table.run)) if table.sweep.values(k)[:2] == ["shifted", 20.0]]
    assert any(str(table.detail[k]) in text for k in rows)
    ways = [x for x in data["aborts"] if x["way"]]
    assert f"proved from {len(ways)} of {len(data['aborts'])} times, 1 s apart" in text
    assert f"come nearer than {min(x['separation']['least_m'] for x in ways):.2f} m;" in text
    assert (
        f"; going home takes {max(x['ends_s'] - x['ordered_s'] for x in ways):.1f} s at most."
        in text
    )
    assert data["sentences"]
    assert all(sentence in text for sentence in data["sentences"])
    for file in (drill / "sweep.db", home / "aborts.json"):
        assert f"{file.name}, SHA-256 {hashlib.sha256(file.read_bytes()).hexdigest()}" in text
    mission.write_text(calm.mission_text.replace("speed = 9.0", "speed = 9.5"))
    more[1] = str(tmp_path / "other")
    assert main(["sweep", str(tmp_path / "day.toml"), *more]) == 0
    assert main(["check", str(mission), "--abort", "--out", str(home), "--force"]) == 0
    digest = hashlib.sha256(calm.mission_text.encode()).hexdigest()[:16]
    capsys.readouterr()
    for option, folder in (
        ("--drill", tmp_path / "other"),
        ("--abort", home),
        ("--abort", drill),
        ("--drill", home),
    ):
        assert main([*flight, option, str(folder)]) == 2
        words = " ".join(capsys.readouterr().err.split())
        same = (option == "--drill") == folder.name.startswith(("drill", "other"))
        assert (
            ("is of another mission" in words and digest in words) if same else str(folder) in words
        )
    assert main([*flight, str(tmp_path / "pair.nc"), "--drill", str(drill)]) == 2
    assert "of one flight" in capsys.readouterr().err
