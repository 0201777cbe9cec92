"""Old words of missions, sweep files and the command are refused, each with its successor."""

import sqlite3
from contextlib import closing

import pytest

from rigidfleet._common.renamed import RENAMED, rename_hint
from rigidfleet.cli import app as cli
from rigidfleet.cli import codes
from rigidfleet.errors import MissionError, ResultError, SweepError
from rigidfleet.math import lqr
from rigidfleet.mission import Mission, draft, load_mission
from rigidfleet.mission.kinds import Fly, Follow
from rigidfleet.result import Result
from rigidfleet.rigidity import Realisation
from rigidfleet.sweep import Sweep, store
from rigidfleet.sweep.runner import fly

VARY = ["agents.position.*.* += normal(0, 0.1)"]
SWEEP = f'mission = "establish-triangle"\nruns = 2\nvary = {VARY}\n'


def refused(key, value):
    """Findings about a mission in which a key has a value."""
    data = load_mission("establish-triangle").to_dict()
    if key == "control":
        data["phases"][0][key] = value
    else:
        next(iter(data["formations"].values()))[key] = value
    with pytest.raises(MissionError) as caught:
        Mission.from_dict(data)
    return caught.value.findings


@pytest.mark.parametrize(
    ("key", "value"), [key for key in RENAMED if isinstance(key, tuple) and key[0] != "evaluate"]
)
def test_old_values_of_missions(key, value):
    """The finding is at the key, has the value, and names the new one."""
    (finding,) = (f for f in refused(key, value) if f.key.endswith(key))
    assert finding.value == value
    assert finding.problem.startswith("must be ")
    assert f"'{RENAMED[key, value]}'" in finding.remedy


@pytest.mark.parametrize(
    ("line", "key", "new"),
    [('judged = "flight"', "judged", "evaluate"), ('evaluate = "ends"', "evaluate", "final")],
)
def test_old_words_of_sweep_files(tmp_path, line, key, new):
    """Keys and values alike."""
    file = tmp_path / "s.toml"
    file.write_text(f"{line}\n{SWEEP}")
    with pytest.raises(SweepError) as caught:
        Sweep.load(file)
    (finding,) = caught.value.findings
    assert finding.key == key
    assert finding.remedy == f"it is now called '{new}'"


@pytest.mark.parametrize("kind", ["choice", "grid"])
@pytest.mark.parametrize(
    ("path", "key", "word"),
    [("phases.1.control", "control", "slots"), ("formations.triangle.edges", "edges", "tree")],
)
def test_old_words_of_variations(kind, path, key, word):
    """They are refused before anything flies, not run by run."""
    with pytest.raises(SweepError) as caught:
        Sweep.of("establish-triangle", [f"{path} = {kind}('complete', '{word}')"], runs=2)
    (finding,) = caught.value.findings
    assert finding.value == word
    assert finding.remedy == f"it is now called '{RENAMED[key, word]}'"


def test_old_options(capsys):
    """Of the command: not a guess at another option, but the new name."""
    assert cli.main(["sweep", "establish-triangle", "--vary", VARY[0], "--ends"]) == codes.BAD_INPUT
    told = " ".join(capsys.readouterr().err.split())
    assert "--ends; it is now called '--final-states'" in told
    assert "--runs" not in told
    assert cli.main(["design", "cube", "--edges", "tree"]) == codes.BAD_INPUT
    assert "now called 'henneberg-multilevel'" in " ".join(capsys.readouterr().err.split())


def test_words_that_are_not_old():
    """Other words have no successor, whatever they are."""
    assert (
        rename_hint("control", "open")
        == rename_hint("edges", [[1, 2]])
        == rename_hint("runs")
        == ""
    )
    assert not set(RENAMED.values()) & {key[1] for key in RENAMED if isinstance(key, tuple)}


@pytest.mark.parametrize(
    ("version", "words"),
    [(0, "an earlier version of rigidfleet (sweep format 1)"), (9, "Use a newer")],
)
def test_stores_of_other_formats(tmp_path, version, words):
    """Neither read nor flown on with; replaced if asked for."""
    sweep = Sweep.of("establish-triangle", VARY, runs=2, evaluate="final")
    fly(sweep, tmp_path, workers=1)
    with closing(sqlite3.connect(tmp_path / store.FILE)) as db:
        db.execute(f"PRAGMA user_version = {version}")
    for use in (lambda: store.read(tmp_path), lambda: fly(sweep, tmp_path, workers=1)):
        with pytest.raises(ResultError) as caught:
            use()
        assert words in str(caught.value)
    assert fly(sweep, tmp_path, workers=1, replace=True).complete


def test_earlier_names_of_members_and_functions_work_and_warn():
    """A phase, a mission and modules give by their earlier names what they give by those of now."""
    mission = load_mission("narrow-passage")
    phase = mission.phases[0]
    assert phase.shaping is not None
    for thing, old, new in (
        (phase, "led", phase.follows_curves),
        (phase, "spelled", phase.flown_as_written),
        (phase.shaping, "aligned", phase.shaping.fits_slots),
        (phase, "ended", phase.keys_if_ended),
        (mission, "linked", mission.has_link),
        (lqr, "led", lqr.trajectory_of_response),
        (draft, "aligned", draft.align_comments),
        (Fly, "led", False),
        (Follow, "led", True),
        (Result, "evaluate", Result.compute_lazy_values),
    ):
        with pytest.warns(DeprecationWarning, match=f"{old} is now") as warned:
            assert getattr(thing, old) == new
        assert warned[0].filename == __file__  # Python shows those of the user's own program alone
    assert not hasattr(lqr, "no_such_function")
    assert not hasattr(Realisation, "found")  # a field without a default, which only objects have
