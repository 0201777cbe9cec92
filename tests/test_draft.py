"""New missions: whatever is asked for flies and passes."""

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from rigidfleet.assessment import assess
from rigidfleet.cli.app import main
from rigidfleet.errors import MissionError
from rigidfleet.formation.shapes import SHAPES
from rigidfleet.mission import Mission, load_mission, show_draft
from rigidfleet.mission.draft import agents_for, draft, shape_for
from rigidfleet.preflight.check import check
from rigidfleet.simulation.flight import simulate


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_flies_and_passes(shape):
    """A new mission of any shape passes its verdict as it is."""
    mission = Mission.from_toml(draft("new", shape=shape))
    assert mission.n_agents == agents_for(shape)
    verdict = assess(simulate(mission))
    assert verdict.passed, verdict.summary


@pytest.mark.parametrize(
    "asked",
    [
        {"agents": 1},
        {"agents": 2, "size": [0.5]},
        {"shape": "cube", "size": [1.0]},
        {"shape": "cuboid", "size": [8.0, 2.0, 4.0]},
        {"shape": "pyramid", "agents": 6},
        {"shape": "line", "agents": 7, "size": [1.2], "mass": 0.3},
        {"agents": 50},
        {"waypoints": [(0.0, 0.0, 20.0), (-40.0, 30.0, 6.0)]},
    ],
    ids=str,
)
def test_other_numbers_fly_and_pass(asked):
    """So does one of few or many agents, small or long, light, or with several waypoints."""
    verdict = assess(simulate(Mission.from_toml(draft("new", **asked))))
    assert verdict.passed, verdict.summary


def checked(shape, agents):
    """What the check of a new mission says will fail, with the agents."""
    mission = Mission.from_toml(draft("new", shape=shape, agents=agents))
    remarks = check(mission, search=False).remarks
    return mission.n_agents, [r.text for r in remarks if r.level == "fails"]


#: Where something changes: tables of edges, starts on a grid, the least that shells take.
COUNTS = [*range(1, 26), 36, 39, 40, 41, 42, 64, 100, 121, 150, 200, 250, 299, 300]


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_passes_its_check(shape):
    """A new mission passes its own check at the fewest agents that its shape takes, some more, and three hundred."""
    taken = SHAPES[shape].agents
    some = {n for n in (taken.start, taken.start + 1, 20, 21, 41, 300) if n in taken}
    for n in sorted(some):
        assert checked(shape, n) == (n, [])


@pytest.mark.long
@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_passes_its_check_at_every_count(shape):
    """At every count of a ladder to 300, and at the most that it takes."""
    for n in [count for count in [*COUNTS, 1000, 2000] if count in SHAPES[shape].agents]:
        assert checked(shape, n) == (n, [])


@pytest.mark.parametrize(("shape", "agents"), [("sphere", 60), ("helix", 90), ("shells", 70)])
def test_many_in_space_fly_and_pass(shape, agents):
    """Shapes in space of many, which start on a grid, fly and pass as they are drafted."""
    verdict = assess(simulate(Mission.from_toml(draft("new", shape=shape, agents=agents))))
    assert verdict.passed, verdict.summary


@pytest.mark.parametrize(("word", "agents"), [("pentagon", 5), ("Octagon", 8), ("dodecagn", 12)])
def test_polygons_by_their_names(word, agents):
    """The name of a polygon leads to the shape, and to its number of agents."""
    with pytest.raises(ValueError, match=f"'polygon' with {agents} agents"):
        draft("new", shape=word)
    data = Mission.from_toml(draft("new")).to_dict()
    data["formations"]["triangle"]["shape"] = word
    with pytest.raises(MissionError, match=f"'polygon' with {agents} agents"):
        Mission.from_dict(data)


def test_what_is_asked_is_what_is_written():
    """Numbers given are those of the mission; times leave room for vehicles to keep up."""
    mission = Mission.from_toml(
        draft(
            "mine", shape="hexagon", size=[3.0], mass=0.8, thrust_limit=15.0, waypoints=[(1, 2, 9)]
        )
    )
    assert mission.name == "mine"
    assert mission.agents.mass == (0.8,) * 6
    assert mission.agents.thrust_limit == (15.0,) * 6
    assert mission.formations["hexagon"].size == 3.0
    result = simulate(mission)
    assert np.linalg.norm(result.cm_velocity, axis=1).max() < 4.1
    np.testing.assert_allclose(result.cm[-1], [1, 2, 9], atol=1e-2)


def test_comments_stand_in_one_column():
    """Comments beside keys begin in one column, and no line is wider than an editor's window."""
    lines = draft("a-name", shape="cuboid").splitlines()
    beside = [line for line in lines if "#" in line and not line.startswith("#")]
    assert len(beside) > 10
    assert {line.index("#") for line in beside} == {34}
    assert max(map(len, lines)) <= 120


@pytest.mark.parametrize(
    ("agents", "shape"), [(None, "triangle"), (3, "triangle"), (8, "cube"), (5, "polygon")]
)
def test_shape_for_agents(agents, shape):
    """Without a shape, agents make the one that suits their number."""
    assert shape_for(agents) == shape


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"shape": "trangle"}, "did you mean 'triangle'"),
        ({"shape": "cube", "agents": 3}, "takes 8 agents, not 3"),
        ({"agents": 0}, "not 0"),
        ({"agents": 10**7}, "at most 2000"),
        ({"size": [1.0, 2.0]}, "takes one size"),
        ({"size": [0.0]}, "sizes > 0"),
        ({"waypoints": [(float("nan"), 0.0, 0.0)]}, "finite"),
        ({"waypoints": [(float("inf"), 0.0, 0.0)]}, "finite"),
    ],
    ids=str,
)
def test_what_cannot_be(asked, words):
    """What cannot be drafted is refused, and it is said why."""
    with pytest.raises(ValueError, match=words):
        draft("new", **asked)


# -- shows --------------------------------------------------------------------------------------------


def a_show(shape, agents, spacing=2.0):
    """A show of one named shape."""
    one = show_draft.shape_scene(shape, agents, spacing)
    return Mission.from_toml(
        show_draft.show_mission_text("new", [one], agents=agents, spacing=spacing)
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_is_shown(shape):
    """A show of any shape passes its check at the fewest agents that it takes, and at a hundred; the plan is proved."""
    taken = SHAPES[shape].agents
    for n in sorted({n for n in (max(2, taken.start), 7, 100) if n in taken}):
        mission = a_show(shape, n)
        ahead = check(mission, search=False)
        assert [r.text for r in ahead.remarks if r.level == "fails"] == []
        limit = mission.limits.separation
        assert limit is not None
        assert min(c.separation for c in ahead.certificates.values()) >= limit


def test_a_show_flies_and_lands_on_the_pads():
    """It takes off, goes through its formations and back, and passes; each pad has one vehicle again."""
    scenes = [show_draft.shape_scene(shape, 30, 2.0) for shape in ("sphere", "helix", "sphere")]
    mission = Mission.from_toml(show_draft.show_mission_text("new", scenes, agents=30, spacing=2.0))
    assert [p.kind for p in mission.phases] == [
        "takeoff", "establish", "reshape", "reshape", "reshape", "land",
    ]  # fmt: skip
    result = simulate(mission)
    verdict = assess(result)
    assert verdict.passed, verdict.summary
    pads = np.array(mission.agents.position)
    end = result.position[-1]
    away = np.linalg.norm(end[:, None] - pads[None], axis=2)
    assert sorted(away.argmin(axis=1)) == list(range(30))
    assert away.min(axis=1).max() < 1e-3


def test_new_writes_a_show_of_files_and_words(tmp_path, monkeypatch):
    """Points that fit stay in their file; others are scaled, and stand in the mission as numbers."""
    monkeypatch.chdir(tmp_path)
    fits = np.stack([3.0 * np.arange(12), 0.0 * np.arange(12), (np.arange(12.0) % 2)], axis=1)
    np.savetxt("fits.csv", fits, delimiter=",")
    np.savetxt("small.csv", 0.1 * fits, delimiter=",")
    asked = ["new", "mine", "--show", "--formations", "fits.csv,small.csv,text:I", "--spacing", "2"]
    assert main([*asked, "--quiet"]) == 0
    text = (tmp_path / "mine.toml").read_text()
    assert 'slots = "fits.csv"' in text
    assert "small.csv" in text
    mission = load_mission("mine.toml")
    assert mission.n_agents == 12
    for name, spacing in (("fits", 10.0**0.5), ("small", 2.0), ("I", 2.0)):
        slots = np.array(mission.formations[name].slots)
        assert pdist(slots).min() == pytest.approx(spacing, abs=1e-5)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (["--show", "--agents", "10000"], "2 to 2000 agents"),
        (["--show", "--agents", "1"], "agents"),
        (["--show", "--formations", "cube", "--agents", "9"], "takes 8 agents, not 9"),
        (["--show", "--formations", "no.csv"], "no.csv: no such file"),
        (["--formations", "no.csv"], "no.csv: no such file"),
        (["--shape", "sub/no.npy"], "sub/no.npy: no such file"),
        (["--spacing", "3"], "add --show"),
        (["--shape", "two.csv", "--size", "3"], "--size: no effect"),
        (["--show", "--formations", ","], "needs formations"),
        (["--show", "--spacing", "0"], "positive"),
        (["--show", "--spacing", "nan"], "positive"),
        (["--show", "--shape", "cube"], "no effect on a show"),
        (["--formations", "cube"], "add --show"),
        (["--show", "--formations", "one.csv", "--agents", "5"], "a single point has no spacing"),
        (["--show", "--formations", "nan.csv"], "not a finite number"),
    ],
    ids=str,
)
def test_shows_that_cannot_be(tmp_path, monkeypatch, capsys, asked, words):
    """One clear error, and no file."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "two.csv").write_text("0,0,0\n3,0,0\n")
    (tmp_path / "one.csv").write_text("0,0,0\n")
    (tmp_path / "nan.csv").write_text("0,0,0\n3,0,nan\n")
    assert main(["new", "bad", *asked, "--quiet"]) != 0
    assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "bad.toml").exists()
