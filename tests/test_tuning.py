"""Tuning: which gains are tried, what refuses them, studies that go on, the result and its mission file."""

import copy
import json
import math
import re
import tomllib
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sample_flights import swarm

import rigidfleet as rf
from rigidfleet.cli import app as cli
from rigidfleet.cli import codes
from rigidfleet.errors import ResultError, RigidfleetError, SweepError
from rigidfleet.mission.files import digest_lines, notes_on_files
from rigidfleet.sweep import Sweep, metrics, read
from rigidfleet.tuning.gains import RANGES, GainSpace, Screen, own_gains, with_gains
from rigidfleet.tuning.outcome import Flown
from rigidfleet.tuning.study import OBJECTIVES, _seed_paths, _Study, objective_cost

TEXT = """# a pair of quadrotors
schema_version = 1
name = "pair"
smoothness = "jerk"

[vehicles.quad]
model = "paper"

[agents]
vehicle = "quad"
position = [[0.0, 0.0, 5.0], [3.0, 0.0, 5.0]]

[constraint]                      # chosen
alpha = 3.0                       # [1/s]
# the rest is by default

[formations.pair]
shape = "line"
size = 4.0

[disturbances.noise]
position = 0.01
velocity = 0.02
delay = 0.02

[[phases]]
kind = "establish"
formation = "pair"
reference = "distances"
control = "open"
blend = 1.5
until = 2.0

[[phases]]
kind = "fly"
position = [2.5, 0.0, 5.5]
until = 4.0
"""
WITHOUT = TEXT.replace("[constraint]", "[allocation]").replace("alpha = 3.0", "")
PAIR = rf.Mission.from_toml(TEXT)
SMALL: dict[str, Any] = {"budget": 30, "seeds": 2, "validation": 2, "workers": 1}


def small(mission: Any, folder: Path, **options: Any) -> rf.Tuned:
    """A small study."""
    return rf.tune(mission, folder, **(SMALL | options))


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A small study, its folder and what it reported."""
    folder, told = tmp_path_factory.mktemp("study"), []
    return small(PAIR, folder, progress=told.append), folder, told


# -- sweeps ------------------------------------------------------------------------------------------


def test_grids_of_a_group_go_together():
    """Values of one group are paired, and every pair is combined with other grids, of which the last is fastest."""

    def grid(path, values, group=""):
        return {"path": path, "kind": "grid", "values": values, "group": group}

    vary = [
        grid("constraint.alpha", [2.0, 3.0, 4.0], "gains"),
        grid("tracking.R", [7.0, 8.0]),
        grid("constraint.beta", [5.0, 6.0, 7.0], "gains"),
    ]
    sweep = Sweep.of(PAIR, vary)
    pairs = [[a, R, b] for a, b in ((2.0, 5.0), (3.0, 6.0), (4.0, 7.0)) for R in (7.0, 8.0)]
    assert [sweep.values(k) for k in range(sweep.runs)] == pairs
    assert Sweep.from_json(sweep.json()).values(3) == pairs[3]
    with pytest.raises(SweepError, match=r"group = 'gains': has a grid of 2 values here"):
        Sweep.of(PAIR, [vary[0], grid("constraint.beta", [1.0, 2.0], "gains")])


def test_shape_error_in_flight():
    """At every sample the worst pair of tracked slots or the worst edge, by a loop over both."""
    result = swarm(7, 1.0)
    found = metrics.shape_errors(result)
    for k in (0, 11, len(result.time) - 1):
        r, slots = result.position[k], result.slot_position[k]
        pairs = [
            math.dist(r[i], r[j]) - math.dist(slots[i], slots[j])
            for i, j in combinations(range(7), 2)
        ]
        assert found[k] == pytest.approx(max(map(abs, [*pairs, *result.constraint[k]])), rel=1e-12)
    untracked = swarm(7, 1.0, slot_position=np.full_like(result.slot_position, np.nan))
    alone = np.abs(result.constraint).max(axis=1)
    np.testing.assert_array_equal(metrics.shape_errors(untracked), alone)
    assert (found > alone).any()


# -- gains -------------------------------------------------------------------------------------------


def test_gains_that_act_are_tuned():
    """Gains of laws that do not act, and gains that are 0, are left alone."""
    every = {"constraint.alpha", "constraint.beta", "constraint.gamma", "tracking.Q.1", "tracking.Q.2"}  # fmt: skip
    assert own_gains(PAIR).keys() == every
    changed = PAIR.to_dict()
    changed["constraint"] = {"gamma": 0.0}
    changed["tracking"] = {"integral": 0.5}
    found = own_gains(rf.Mission.from_dict(changed))
    assert found.keys() == every - {"constraint.gamma"} | {"tracking.integral"}
    changed["phases"] = changed["phases"][:1]
    assert own_gains(rf.Mission.from_dict(changed)).keys() == {"constraint.alpha", "constraint.beta"}  # fmt: skip
    assert own_gains(rf.load_mission("establish-triangle")).keys() <= every


def test_space_holds_the_own_gains():
    """The start is the mission's own gains; the ends are as far as the box reaches."""
    space = GainSpace({"constraint.alpha": 3.0, "tracking.Q.1": 4.0})
    assert space.gains_at(space.mission_point) == space.own
    odd = GainSpace({"constraint.beta": math.sqrt(12)})
    assert odd.gains_at(odd.mission_point) == odd.own
    assert space.gains_at([0.0, 0.0]) == {"constraint.alpha": 0.75, "tracking.Q.1": 0.25}
    assert space.gains_at([1.0, 1.0]) == {"constraint.alpha": 12.0, "tracking.Q.1": 64.0}


def test_margins_are_those_of_check():
    """The screen computes what `check` prints for a mission with these gains, and refuses worse ones."""
    screen = Screen(PAIR, 1.0)
    others = own_gains(PAIR) | {"constraint.gamma": 2.0, "tracking.Q.2": 2.0}
    for gains in (own_gains(PAIR), others):
        found = rf.check(rf.Mission.from_toml(with_gains(TEXT, gains))).margins
        assert found is not None
        assert found.tracking is not None
        margins = screen.margins_by_law(gains)
        assert margins["tracking"].phase == pytest.approx(found.tracking.phase, rel=1e-6)
        every = [f.margins for f in found.formations.values()]
        law = margins["constraint law"]
        assert law.phase == pytest.approx(min(m.phase for m in every), rel=1e-6)
        assert law.delay == pytest.approx(min(m.delay for m in every), rel=1e-6)
        assert law.gain[1] == pytest.approx(min(m.gain[1] for m in every), rel=1e-6)
    own = own_gains(PAIR)
    assert screen.margin_slack(own) == pytest.approx(0.0, abs=1e-6)
    assert screen.margin_slack(own | {"constraint.beta": 2.9, "constraint.gamma": 2.0}) >= 0
    assert screen.margin_slack(own | {"constraint.gamma": 9.0}) < 0  # less phase
    assert screen.margin_slack(own | {"constraint.alpha": 12.0}) < 0  # less delay
    assert screen.margin_slack(own | {"tracking.Q.1": 16.0}) < 0
    assert Screen(PAIR, 0.5).margin_slack(own | {"tracking.Q.1": 16.0}) > 0
    assert Screen(PAIR, 0.0).margin_slack(own | {"constraint.gamma": 300.0}) == -1  # unstable


def test_margins_without_tracked_slots_are_those_of_check():
    """Where one law leads the virtual body, whose gains are not tuned, its integral counts as `check` counts it."""
    text = TEXT.replace('smoothness = "jerk"', 'architecture = "body"')
    mission = rf.Mission.from_toml(f"{text}\n[tracking]\nintegral = 3.0\n")
    assert own_gains(mission).keys() == {"constraint.alpha", "constraint.beta", "constraint.gamma"}
    found = rf.check(mission).margins
    assert found is not None
    low = max(f.margins.gain[0] for f in found.formations.values())
    assert Screen(mission, 1.0).own["constraint law"].gain[0] == pytest.approx(low, rel=1e-6)


def test_every_source_of_random_numbers_has_a_seed_in_the_search():
    """Noise, gusts, links and the sensing of obstacles are flown with several seeds where they act, and only there."""
    assert _seed_paths(PAIR) == ["disturbances.noise.seed"]
    document = rf.load_mission("moving-obstacles").to_dict()
    document["avoidance"]["sensing_noise"] = 0.0
    assert "avoidance.seed" not in _seed_paths(rf.Mission.from_dict(document))
    document["avoidance"]["sensing_noise"] = 0.05
    assert "avoidance.seed" in _seed_paths(rf.Mission.from_dict(document))


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        (TEXT, True),
        (TEXT.replace("[constraint]", "[ constraint ]"), True),
        (TEXT + "\n[tracking]\nQ = [4.0,  # stiff\n  4.0]\nR = 1.0\n", False),
        (TEXT.replace("alpha = 3.0 ", "beta = 2 "), True),
        (TEXT.replace("alpha = 3.0 ", "cutoff = 1e-3\nalpha = 3.0 "), True),
        ("constraint = {alpha = 2.0}\n" + WITHOUT, False),
        ("constraint.alpha = 2.0\n" + WITHOUT, False),
    ],
)  # fmt: skip
def test_gains_in_a_file(text, kept):
    """However a file writes its gains, only they change; comments stay wherever lines can be replaced."""
    gains = {"constraint.alpha": 2.5, "constraint.gamma": 1.25, "tracking.Q.2": 9.0}
    new = with_gains(text, gains)
    wanted = tomllib.loads(text)
    wanted.setdefault("constraint", {}).update(alpha=2.5, gamma=1.25)
    wanted.setdefault("tracking", {})["Q"] = [4.0, 9.0]
    assert tomllib.loads(new) == wanted
    assert ("# a pair of quadrotors" in new) == kept
    assert not kept or ("# [1/s]" in new and "# the rest" in new)
    rf.Mission.from_toml(new)


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize(
    "text", [TEXT, TEXT + "\n[tracking]\nR = 1.0  # own", TEXT.replace("alpha = 3.0 ", "  beta = 2\n  alpha = 3 "),
             WITHOUT, WITHOUT.rstrip(), "constraint = {alpha = 2.0}\n" + WITHOUT],
)  # fmt: skip
def test_lines_of_a_file_stay_as_they_are(text, end):
    """Whatever ends the lines of a file, new keys stand below those of their table, a new table below an empty line."""
    gains = {"constraint.alpha": 2.5, "constraint.gamma": 1.25, "tracking.Q.2": 9.0}
    new = with_gains(text.replace("\n", end), gains)
    assert new.endswith(end)
    assert new.count("\n") == new.count(end)
    assert new.count("\r") == new.count("\r\n")
    lines, before = new.split(end), text.split("\n")
    assert new == with_gains(text, gains).replace("\n", end)
    if before[0].startswith("#"):  # else it is written anew
        kept = [x for x in before if "alpha" not in x]
        assert [x for x in lines if x in kept][: len(kept)] == kept
        assert (
            lines[lines.index("gamma = 1.25") - 1].lstrip().startswith(("alpha = 2.5", "R = 1.0"))
        )
        k = lines.index("Q = [4.0, 9.0]")
        assert lines[k - 2 : k] == ["", "[tracking]"] or lines[k - 1] == "R = 1.0  # own"


def test_a_study_of_a_file_with_other_line_ends_goes_on(tmp_path):
    """A tuned mission whose lines end as those of Windows is known again as what the study wrote."""
    mission = rf.Mission.from_toml(TEXT.replace("\n", "\r\n"))
    first = small(mission, tmp_path / "study", validation=0)
    data = (tmp_path / "study" / "pair-tuned.toml").read_bytes()
    assert data == first.text.encode()
    assert data.count(b"\n") == data.count(b"\r\n")
    assert small(mission, tmp_path / "study", validation=0).text == first.text


def test_digests_of_files_are_read_however_lines_end():
    """What a mission's text tells of files that were read stays where it is written anew, and its notes are told."""
    one, other = (f"# slots of 'a{k}.csv', SHA-256 {64 * str(k)}" for k in (1, 2))
    text = f"{one}\n{other}. Note: no unit is said\nname = 1\n"
    for own in (text, text.replace("\n", "\r\n")):
        assert digest_lines(own) == text.removesuffix("name = 1\n")
        assert notes_on_files(own) == ["slots of 'a2.csv': no unit is said"]


# -- studies -----------------------------------------------------------------------------------------


def test_failures_are_worse_than_errors():
    """A flight that fails costs more than any error of flights that pass, one that ends early more than any failure."""
    flown = [
        Flown({}, 2, 0, 2, {"e": [0.9, 50.0]}),
        Flown({}, 1, 0, 2, {"e": [0.0, 0.1]}),
        Flown({}, 0, 0, 2, {"e": [0.0, 0.0]}),
        Flown({}, 1, 1, 2, {"e": [0.0, math.nan]}),
    ]
    costs = [objective_cost(f, "e") for f in flown]
    assert all(a < b for a, b in pairwise(costs))
    assert costs[0] == pytest.approx(25.45)


def test_study(study):
    """The tuned file flies as told, on seeds of its own; margins are no worse and no choice costs less."""
    tuned, folder, told = study
    assert tuned.flights <= SMALL["budget"]
    assert tuned.candidates >= 10
    assert told[-1].done == tuned.flights + 2 * SMALL["validation"]
    rows = [read(f) for f in sorted((folder / "rounds").iterdir())]
    assert sum(len(table.run) for table in rows) == tuned.flights
    flown = [t.sweep.document_of_run(k) for t in rows for k in range(t.sweep.runs)]
    assert {document["disturbances"]["noise"]["seed"] for document in flown} == {0, 1}
    errors = [t.metrics["shape_tracked"].reshape(-1, 2).mean(axis=1).min() for t in rows]
    passed = [t.passed.reshape(-1, 2).sum(axis=1).max() for t in rows]
    assert tuned.after.passed == max(passed)
    assert tuned.after.mean("shape_tracked") >= min(errors)
    assert tuned.validation is not None
    mission = rf.load_mission(folder / "pair-tuned.toml").to_dict()
    for k, error in enumerate(tuned.validation[0 if tuned.is_worse else 1].values["shape_tracked"]):
        mission["disturbances"]["noise"]["seed"] = 2 + k
        result = rf.simulate(rf.Mission.from_dict(mission))
        tracked = np.isfinite(result.slot_position).all(axis=(1, 2))
        assert np.nanmax(metrics.shape_errors(result)[tracked]) == error
    before, after = tuned.margins
    for law, was in before.items():
        assert after[law].phase >= was.phase * (1 - 1e-9)
        assert after[law].delay >= was.delay * (1 - 1e-9)
    assert "chosen" in tuned.text
    assert tuned.conclusion in str(tuned)
    for what, *cells in tuned.rows():
        line = next(line for line in str(tuned).splitlines() if line.startswith(f"{what}  "))
        assert line.removeprefix(what).split() == " ".join(cells).split()
    assert "<td" in tuned._repr_html_()
    assert "noise" in tuned.text


def test_study_resumes(study, tmp_path):
    """Stopped and begun again, a study is the same as at one go, and flies nothing twice; then it goes on."""
    whole, _, _ = study

    def stop(now):
        if now.flown >= 13:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        small(PAIR, tmp_path, progress=stop)
    kept = sum(len(read(f).run) for f in (tmp_path / "rounds").iterdir())
    assert 13 <= kept < whole.flights
    told = []
    again = small(PAIR, tmp_path, progress=told.append)
    assert told[-1].flown == told[-1].done - kept
    assert again.to_dict()["result"] | {"file": ""} == whole.to_dict()["result"] | {"file": ""}
    assert again.text == whole.text
    more = small(PAIR, tmp_path, progress=told.append, budget=50)
    assert whole.flights < more.flights <= 50
    assert told[-1].flown <= more.flights - whole.flights + 2 * SMALL["validation"]
    assert objective_cost(more.after, more.metric) <= objective_cost(whole.after, more.metric)


def test_what_is_there_is_kept(study, tmp_path):
    """Another study, or a tuned file that was edited, is overwritten only if that is asked for."""
    _, folder, _ = study
    for change in ({"seeds": 3}, {"objective": "tracking"}, {"assume": {"gravity": 9.8}}):
        with pytest.raises(ResultError, match="contains another study; it differs in"):
            small(PAIR, folder, **change)
    edited = tmp_path / "pair-tuned.toml"
    edited.write_text("mine", "utf-8")
    with pytest.raises(ResultError, match="is not what a study wrote"):
        small(PAIR, tmp_path)
    assert edited.read_text("utf-8") == "mine"
    tuned = small(PAIR, tmp_path, replace=True)
    assert edited.read_text("utf-8") == tuned.text


def changed(**tables: Any) -> rf.Mission:
    return rf.Mission.from_dict(copy.deepcopy(PAIR.to_dict()) | tables)


@pytest.mark.parametrize(
    ("mission", "options", "words"),
    [
        (PAIR, {"budget": 19}, "budget = 19: must be at least 20"),
        (PAIR, {"seeds": 0}, "seeds = 0: must be at least 1"),
        (PAIR, {"margin_share": 1.5}, "margin share = 1.5: must be from 0"),
        (PAIR, {"objective": "speed"}, "objective = 'speed': use one of shape"),
        (
            changed(phases=PAIR.to_dict()["phases"][:1]),
            {"objective": "tracking"},
            "no phase of pair",
        ),
        ("narrow-passage", {}, "higher gains are always better for points"),
        (
            changed(constraint={"stabilisation": "none"}, phases=PAIR.to_dict()["phases"][:1]),
            {},
            "has no gains to tune",
        ),
    ],
)
def test_refused(tmp_path, mission, options, words):
    """What cannot be tuned is said before anything flies."""
    with pytest.raises(RigidfleetError, match=words):
        small(mission, tmp_path / "study", **options)
    assert not (tmp_path / "study").exists()


def test_flights_without_random_numbers(tmp_path):
    """Without noise and gusts all flights are alike: one is enough, and there is nothing to judge on."""
    calm = changed(disturbances={"noise": {"delay": 0.02}})
    tuned = small(calm, tmp_path, budget=10)
    assert tuned.validation is None
    assert (tuned.before.flights, tuned.candidates) == (1, tuned.flights)


def test_points_with_noise(tmp_path):
    """Points bear any gain, but noise makes high ones bad: they are tuned without margins."""
    points = changed(
        vehicles={}, agents={"mass": 1.0, "position": PAIR.to_dict()["agents"]["position"]},
        disturbances={"noise": {"position": 0.01, "velocity": 0.02}},
    )  # fmt: skip
    tuned = small(points, tmp_path, budget=20)
    assert tuned.margins == ({}, {})
    assert tuned.candidates == 10


# -- the command -------------------------------------------------------------------------------------


def test_command(tmp_path, monkeypatch, capsys):
    """Both sides are printed; a second call flies nothing; Ctrl-C and wrong options have their exit codes."""
    monkeypatch.chdir(tmp_path)
    Path("pair.toml").write_text(TEXT.replace("position = 0.01\nvelocity = 0.02\n", ""), "utf-8")
    noise = "disturbances.noise = {position = 0.01, velocity = 0.02}"
    line = ["tune", "pair.toml", "--assume", noise, "--budget", "10", "--seeds", "1", "--validation", "1"]  # fmt: skip
    assert cli.main([*line, "--quiet"]) == codes.PASSED
    assert capsys.readouterr().out == ""
    assert cli.main(line) == codes.PASSED
    out = capsys.readouterr().out
    for words in ("before", "constraint.alpha", "phase margin", "new seeds", "tunes/pair/pair-tuned.toml"):  # fmt: skip
        assert words in out
    assert "position = 0.01" not in Path("tunes/pair/pair-tuned.toml").read_text("utf-8")
    assert cli.main([*line, "--json"]) == codes.PASSED
    found = json.loads(capsys.readouterr().out)
    stored = json.loads(Path("tunes/pair/study.json").read_text("utf-8"))
    assert found == stored["result"]
    assert cli.main([*line, "--seed", "4"]) == codes.BAD_INPUT
    assert "another study; it differs in: seed" in capsys.readouterr().err
    assert cli.main(["tune", "pair.toml", "--assume", "noise"]) == codes.BAD_INPUT
    assert "is not TOML" in capsys.readouterr().err

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("rigidfleet.tuning.study.fly", interrupt)
    assert cli.main([*line, "--force"]) == codes.INTERRUPTED
    assert "finished flights are saved in tunes/pair" in capsys.readouterr().err


def test_page(tmp_path, monkeypatch, capsys):
    """The code of the page flies, and the page names every objective and the range of every gain."""
    text = (Path(__file__).parents[1] / "docs" / "tune.md").read_text("utf-8")
    for name in OBJECTIVES:
        assert f"| `{name}` |" in text
    rows = dict(re.findall(r"^\| .*?`(\w+\.\w+)` \| 1/(\d+ .*?) times \|$", text, re.MULTILINE))
    found = {path: f"{1 / low:.0f} {high:.0f}" for path, (low, high) in RANGES.items()}
    told = {path: " ".join(re.findall(r"\d+", words)) for path, words in rows.items()}
    assert told == {path.removesuffix(".1"): x for path, x in found.items() if path[-1] != "2"}
    monkeypatch.chdir(tmp_path)
    Path("pair.toml").write_text(TEXT, "utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    exec(compile(code.replace('"passage-quadrotors"', '"pair.toml"'), "tune.md", "exec"), {})
    assert "constraint.alpha" in capsys.readouterr().out
    assert Path("tunes/short/pair-tuned.toml").exists()


@pytest.mark.long
def test_quadrotors_with_delay_and_noise(tmp_path):
    """With 20 ms of delay and 1 cm of noise, a quarter of the shape error by forces alone goes, on new seeds."""
    noise = {"position": 0.01, "velocity": 0.02, "delay": 0.02}
    tuned = rf.tune(
        "passage-quadrotors", tmp_path, objective="shape-forces", budget=105, validation=4,
        assume={"disturbances": {"noise": noise}}, workers=2,
    )  # fmt: skip
    assert tuned.improvement >= 0.25
    document = rf.load_mission(tmp_path / "passage-quadrotors-tuned.toml").to_dict()
    own = rf.load_mission("passage-quadrotors").to_dict()
    before, after = (
        rf.check(rf.Mission.from_dict(d | {"disturbances": {"noise": noise}})).margins
        for d in (own, document)
    )
    assert before is not None
    assert after is not None
    assert after.tracking is not None
    assert before.tracking is not None
    pairs = [(before.tracking, after.tracking)]
    pairs += [
        (f.margins, after.formations[where].margins) for where, f in before.formations.items()
    ]
    for was, now in pairs:
        assert now.phase >= was.phase * 0.9999
        assert now.delay >= was.delay * 0.9999
        assert now.gain[1] >= was.gain[1] * 0.9999
    gains = {"constraint": {}, "tracking": {}}
    assert document | gains == own | gains


def test_parts_of_a_flight_are_told_apart():
    """The shape error with slots is that of samples with slots, that without of the others; both are reported."""
    result = rf.simulate("narrow-passage")
    first = result.time < 6.0  # which establishes by forces alone
    slots, here = result.slot_position, result.position
    pairs = [(0, 1), (0, 2), (1, 2)]

    def off(a, b):
        return np.array([np.linalg.norm(a[:, i] - a[:, j], axis=1) for i, j in pairs]) - b

    wanted = np.array([np.linalg.norm(slots[:, i] - slots[:, j], axis=1) for i, j in pairs])
    with_slots = np.nanmax(np.abs(off(here, wanted)))
    by_forces = np.abs(off(here, result.distance_reference.T))[:, first].max()
    found = metrics.measure_metrics(result, rf.assess(result))
    assert found["shape_tracked"] == pytest.approx(with_slots, rel=1e-6)
    assert found["shape_forces"] == pytest.approx(by_forces, rel=1e-6)
    assert found["shape_flight"] == max(found["shape_tracked"], found["shape_forces"])
    assert {"shape_tracked", "shape_forces"} <= set(OBJECTIVES.values())


@pytest.mark.parametrize(
    ("control", "objective", "words"), [("open", "shape-rms", "no phase"), ("tracking", "shape-forces", "every phase")]
)  # fmt: skip
def test_a_part_that_is_not_flown_is_refused(tmp_path, control, objective, words):
    """An objective of a part that the mission does not have is refused with the one that it has."""
    tables = PAIR.to_dict()
    establish = {
        "kind": "establish",
        "formation": tables["phases"][0]["formation"],
        "duration": 5.0,
    }
    mission = rf.Mission.from_dict(tables | {"phases": [establish | {"control": control}]})
    with pytest.raises(rf.RigidfleetError, match=words):
        rf.tune(mission, tmp_path, objective=objective)


def test_gains_that_are_worse_on_new_seeds_are_not_taken(tmp_path, monkeypatch):
    """If the best gains of the search are no better on new seeds, the file keeps those of the mission, and says so."""

    def worsened(found, seeds):
        before = found.before
        after = found.after = replace(before, gains={k: 1.1 * g for k, g in before.gains.items()})
        rest = {k: [1.0] for k in before.values}
        found.validation = (
            replace(before, values=rest),
            replace(after, values={k: [2.0] for k in rest}),
        )

    monkeypatch.setattr(_Study, "validate", lambda self, found, seeds: worsened(found, seeds))
    tuned = small(PAIR, tmp_path, budget=20)
    assert tuned.after.gains != tuned.before.gains
    assert own_gains(rf.load_mission(tmp_path / "pair-tuned.toml")) == tuned.before.gains
    assert tuned.conclusion.endswith("100 % larger on new seeds; the mission keeps its own gains.")
