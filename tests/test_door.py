"""A mission is text where it comes in and goes out; inside the program it is data."""

import tomllib
from typing import Any

import pytest
import tomli_w
from sample_missions import three_points

import rigidfleet as rf
from rigidfleet.cli.app import main
from rigidfleet.mission import load_mission
from rigidfleet.planning.timing import complete_times
from rigidfleet.sweep import Sweep
from rigidfleet.sweep.run import fly_runs

FLY = {"kind": "fly", "position": [4.0, 1.0, 5.0], "duration": "auto"}
LIMITS = {"limits": {"speed": 2.0, "acceleration": 1.0, "separation": 0.5}}
ESTABLISH = {"duration": 5.0}
GROUND = {"obstacles": [{"kind": "ground"}]}


@pytest.fixture
def texts(monkeypatch) -> dict[str, int]:
    """How many TOML texts have been read and written; single keys, as messages name them, do not count."""
    count = {"read": 0, "written": 0}
    read, write = tomllib.loads, tomli_w.dumps

    def loads(text: str, **options: Any) -> Any:
        count["read"] += 1
        return read(text, **options)

    def dumps(data: Any, **options: Any) -> str:
        count["written"] += list(data.values()) != [0]
        return write(data, **options)

    monkeypatch.setattr(tomllib, "loads", loads)
    monkeypatch.setattr(tomli_w, "dumps", dumps)
    return count


def mission_of(*phases: dict[str, Any], **tables: Any) -> rf.Mission:
    return rf.Mission.from_dict(three_points(ESTABLISH, *phases) | LIMITS | tables)


@pytest.mark.parametrize("name", ["narrow-passage", "narrow-passage-found"])
def test_check_reads_a_file_once(name, texts, capsys):
    """It reads the mission's text, and writes none, though a way is found and takes its place."""
    assert main(["check", name, "--no-realisations"]) == 0
    assert texts == {"read": 1, "written": 0}


def test_run_reads_a_file_once(texts, tmp_path, capsys):
    """It writes the text of the result alone, which is the file's: automatic times stay so, and follow again."""
    file = tmp_path / "short.toml"
    lost = {"disturbances": {"lost": [{"agent": 3, "time": 8.0}], "on_loss": "land"}}
    data = three_points(ESTABLISH, FLY) | LIMITS | GROUND | lost
    file.write_text(rf.Mission.from_dict(data).text)
    texts.update(read=0, written=0)
    assert main(["run", str(file), "--out", str(tmp_path / "flights")]) in (0, 1)
    assert texts == {"read": 1, "written": 0}


@pytest.mark.parametrize(
    "mission",
    [
        mission_of(FLY),
        mission_of({"kind": "go", "position": [4.0, 1.0, 5.0], "duration": "auto"}),
        mission_of({"kind": "reshape", "formation": "wide", "transition": "layers", "duration": "auto"}),
        mission_of({"kind": "land", "stagger": 4.0, "by": "vehicles", "duration": 12.0}, **GROUND),
    ],
    ids=["auto", "go", "transition", "staggered"],
)  # fmt: skip
def test_planning_reads_and_writes_no_text(mission, texts):
    """Times, ways and transitions take their places as data; the mission then has numbers, and writes as before."""
    planned = complete_times(mission)
    assert not any(phase.auto_keys for phase in planned.phases)
    assert all(phase.flown_as_written and not phase.replaced for phase in planned.phases)
    assert texts == {"read": 0, "written": 0}
    again = complete_times(rf.Mission.from_toml(planned.text))
    assert again.model_dump() == planned.model_dump()


def test_an_assignment_is_not_lost(texts):
    """A mission with another assignment keeps the times that were computed for it."""
    planned = complete_times(mission_of(FLY)).with_assignment("shortest")
    assert not any(phase.auto_keys for phase in planned.phases)
    assert texts == {"read": 0, "written": 0}


def test_a_run_of_a_sweep_reads_and_writes_no_text(texts):
    """The mission of a run is the data of the sweep's mission, changed."""
    sweep = Sweep.of(load_mission("square"), ["agents.mass.* *= normal(1, 0.05)"], runs=1)
    texts.update(read=0, written=0)
    list(fly_runs(sweep, range(1)))
    assert texts == {"read": 0, "written": 0}
