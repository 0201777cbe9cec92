"""Sweeps: what varies, the same rows however they are flown, the store, the summary, the command."""

import errno
import io
import json
import logging
import math
import os
import random
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from sample_flights import quadrotors, swarm
from scipy import stats

from rigidfleet.assessment import assess
from rigidfleet.cli import app as cli
from rigidfleet.cli import codes, console
from rigidfleet.errors import MissionError, ResultError, RigidfleetError, SweepError
from rigidfleet.mission import Mission, load_mission
from rigidfleet.planning.timing import can_affect_plan, complete_times, expand_mission
from rigidfleet.result import Extremum
from rigidfleet.sweep import METRICS, Sweep, Table, fly, load, merge, read
from rigidfleet.sweep.figures import map_over_two, plot
from rigidfleet.sweep.final_states import start_states
from rigidfleet.sweep.metrics import measure_metrics
from rigidfleet.sweep.run import GROUP, fly_runs
from rigidfleet.sweep.runner import SweepProgress
from rigidfleet.sweep.shards import runs_of_shard
from rigidfleet.sweep.summary import Example, correlations_by_strength, pass_rate, summarise

EXAMPLE = Path(__file__).parents[1] / "examples" / "gain_study.toml"
PAIR: dict[str, Any] = {
    "schema_version": 1,
    "name": "pair",
    "agents": {"mass": 1.0, "position": [[0.0, 0.0, 5.0], [3.0, 1.0, 5.0]], "thrust_limit": 14.0},
    "formations": {"pair": {"shape": "line", "size": 4.0}},
    "phases": [{"kind": "establish", "formation": "pair", "blend": 1.0, "until": 2.0}],
}
MISSION = Mission.from_dict(PAIR)
SCATTER = ["agents.position.*.* += normal(0, 0.3)", "agents.mass.* *= uniform(0.8, 1.2)"]


def sweep(*vary: str, runs: int | None = 20, seed: int = 3, mission: Mission = MISSION) -> Sweep:
    return Sweep.of(mission, vary or SCATTER, runs=runs, seed=seed)


def numbers(table: Table) -> tuple[Any, ...]:
    """All of a sweep that has to be the same each time: bits, not values, so that NaN equals NaN."""
    metrics = {name: values.tobytes() for name, values in table.metrics.items()}
    words = table.reason.tolist(), table.detail.tolist()
    return table.run.tolist(), table.passed.tolist(), words, table.codes.tobytes(), metrics


def refused(*vary: Any, runs: int | None = 5, seed: int = 0) -> dict[str, tuple[str, str]]:
    """Problem and remedy of each finding, by its key."""
    with pytest.raises(SweepError) as caught:
        Sweep.of(MISSION, vary, runs=runs, seed=seed)
    return {f.key: (f.problem, f.remedy) for f in caught.value.findings}


# -- what varies -------------------------------------------------------------------------------------


def test_a_path_leads_to_what_the_document_has():
    """Whatever stands in a mission, or would by default, can be set, shifted and scaled; the rest stays."""
    found = sweep(
        "agents.position.2.3 = grid(7)",
        "agents.mass.1 *= grid(3)",
        "agents.velocity.*.1 += grid(0.5)",
        "constraint.alpha = grid(2)",
        "phases[1].until += grid(1)",
        "formations.pair.size *= grid(1.5)",
        "constraint.solver = grid(exact)",
        runs=None,
    )
    document = found.document_of_run(0)
    mission = Mission.from_dict(document)
    assert mission.agents.position == ((0.0, 0.0, 5.0), (3.0, 1.0, 7.0))
    assert mission.agents.mass == (3.0, 1.0)
    assert mission.agents.velocity == ((0.5, 0.0, 0.0), (0.5, 0.0, 0.0))
    assert (mission.constraint.alpha, mission.constraint.solver) == (2.0, "exact")
    assert mission.phases[0].until == 3.0
    assert mission.formations["pair"].size == 6.0
    assert document["formations"]["pair"].keys() == PAIR["formations"]["pair"].keys()
    assert found.mission.to_dict() == tomllib.loads(MISSION.text)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("windy-passage", "phases[3].until += uniform(-12, 20)"),
        ("moving-obstacles", "obstacles[2].radius = choice(0.1, 1.0, nought)"),
        ("crazyflies", "phases[2].duration = choice(3.0, 4.0, -1.0)"),
    ],
)
def test_a_run_is_the_mission_that_its_data_give(name, line):
    """A run's mission is the one that its data give, or has the same findings; the sweep's mission stays as read."""
    found = Sweep.of(name, ["agents.radius.* *= uniform(0.1, 1)", line], runs=40)
    refused, whole = [], json.dumps(found.mission.to_dict())

    def outcome(make: Callable[[], Mission]) -> tuple[str, Any]:
        try:
            return "", make().model_dump()
        except MissionError as error:
            return str(error), None

    for k in range(40):
        alone = json.loads(json.dumps(found.document_of_run(k)))
        run = outcome(lambda k=k: found.mission_of(k))
        assert run == outcome(lambda k=k, data=alone: Mission.from_plain(data, f"run {k}"))
        refused.append(bool(run[0]))
    assert json.dumps(found.mission.to_dict()) == whole
    assert any(refused)
    assert not all(refused)


def test_a_star_gives_each_its_own_and_no_star_all_the_same():
    """`agents.mass.*` draws a mass for each vehicle, `agents.mass` one for all."""
    own = sweep("agents.mass.* = uniform(1, 2)").document_of_run(0)["agents"]["mass"]
    assert own[0] != own[1]
    assert sweep("agents.mass = uniform(1, 2)").document_of_run(0)["agents"]["mass"] != 1.0
    shifted = sweep(
        "agents.position.*.3 += uniform(1, 2)", "agents.position.1 += grid(1)"
    ).document_of_run(0)
    assert shifted["agents"]["position"][0][:2] == [1.0, 1.0]


def test_whole_numbers_stay_whole():
    """A number that the mission counts with is rounded."""
    drawn = sweep("constraint.iterations = uniform(1, 9)", runs=40)
    found = {drawn.document_of_run(k)["constraint"]["iterations"] for k in range(40)}
    assert found == set(range(1, 10))


@pytest.mark.parametrize(
    ("kind", "distribution"),
    [
        ("normal(2, 0.5)", stats.norm(2, 0.5)),
        ("uniform(1, 4)", stats.uniform(1, 3)),
        ("log-uniform(0.1, 10)", stats.loguniform(0.1, 10)),
    ],
)
def test_distributions(kind, distribution):
    """Draws over the runs follow the distribution (Kolmogorov-Smirnov against SciPy's)."""
    drawn = sweep(f"agents.mass = {kind}", runs=2000)
    assert stats.kstest([drawn.values(k)[0] for k in range(2000)], distribution.cdf).pvalue > 0.01


def test_choices_are_as_likely():
    """Each of several words comes as often, and into the mission."""
    found = sweep("constraint.solver = choice(iterated, exact, pinv)", runs=900)
    words = [found.values(k)[0] for k in range(900)]
    assert stats.chisquare([words.count(w) for w in ("iterated", "exact", "pinv")]).pvalue > 0.01
    assert found.document_of_run(0)["constraint"]["solver"] == words[0]


def test_columns_and_runs_are_independent():
    """What one vehicle draws says nothing of another, nor one run of the next."""
    found = sweep(runs=1000)
    draws = np.array([found.values(k) for k in range(1000)])
    correlation = np.corrcoef(np.hstack([draws[1:], draws[:-1]]).T) - np.eye(2 * draws.shape[1])
    assert np.abs(correlation).max() < 4.5 / math.sqrt(1000)


def test_a_grid_is_gone_through_in_order():
    """Runs take the points of the product of all grids, the last fastest, and go round."""
    found = sweep("constraint.alpha = grid(1, 2)", "agents.mass = linspace(1, 3, 3)", runs=None)
    assert found.runs == 6
    points = [tuple(found.values(k)) for k in range(12)]
    assert points[:6] == [(a, m) for a in (1, 2) for m in (1.0, 2.0, 3.0)]
    assert points[6:] == points[:6]
    ratios = sweep("constraint.beta = geomspace(1, 8, 4)", runs=None)
    assert [ratios.values(k)[0] for k in range(4)] == pytest.approx([1, 2, 4, 8])


def test_a_run_depends_on_seed_and_number_alone():
    """More runs change none of the first; another seed changes all."""
    few, many, other = sweep(runs=3), sweep(runs=3000), sweep(seed=4)
    assert [few.values(k) for k in range(3)] == [many.values(k) for k in range(3)]
    assert not set(few.values(0)) & set(other.values(0))


def test_lines_and_tables_say_the_same():
    """A line is short for a table."""
    table = {"path": "agents.mass", "change": "scale", "kind": "normal", "mean": 1.0, "sd": 0.1}
    assert (
        sweep("agents.mass *= normal(1, 0.1)").json()
        == Sweep.of(MISSION, [table], runs=20, seed=3).json()
    )


# -- the check on entry ------------------------------------------------------------------------------


def test_all_errors_at_once():
    """Every error of a sweep has its key and what to do, with what may be meant."""
    found = refused(
        "agents.mas.* *= normal(1, -0.5)",
        "agents.2.mass = uniform(2, 1)",
        "phases.1.untl = uniform(1, 2)",
        "phases.4.until = uniform(1, 2)",
        "agents.mass = norml(1, 2)",
        "agents.mass = normal(1)",
        "mass is heavy",
        "constraint.solver = uniform(1, 2)",
        "agents = grid(1)",
        "phases.1.duration = uniform(1, 2)",
        "phases.1.duration += uniform(1, 2)",
        "constraint.solver += choice(exact)",
        {"path": "agents.mass", "kind": "normal", "mean": 1.0, "sdd": 0.1},
        seed=-1,
    )
    assert found["vary[1].sd"][0] == "must be > 0"
    assert found["vary[1].path"][1] == "did you mean 'agents.mass.*'?"
    assert "above low = 2" in found["vary[2].high"][0]
    assert found["vary[2].path"][1] == "did you mean 'agents.mass.2'?"
    assert found["vary[3].path"][1] == "did you mean 'phases.1.until'?"
    assert "from 1 to 1" in found["vary[4].path"][1]
    assert found["vary[5]"][1] == "did you mean 'normal'?"
    assert found["vary[6]"] == ("normal takes 2 numbers, not 1", "write normal(mean, sd)")
    assert found["vary[7]"][0] == "is not a valid variation"
    assert "not a number" in found["vary[8].path"][0]
    assert "is a table" in found["vary[9].path"][0]
    assert "two endings, until and duration" in found["vary[10].path"][0]
    assert "no value to add to" in found["vary[11].path"][0]
    assert "numbers to add" in found["vary[12].values"][0]
    assert found["vary[13].sdd"][1] == "did you mean 'sd'?"
    assert "vary[13].sd" in found
    assert found["seed"][0] == "must be >= 0"


def test_runs_are_needed_without_a_grid():
    """A distribution has no number of runs of its own, and something has to vary."""
    assert "runs" in refused("agents.mass = normal(1, 0.1)", runs=None)
    assert refused()["vary"][0] == "nothing varies"


def test_a_file_is_checked_like_a_mission(tmp_path):
    """Errors of a sweep file name the file; its mission may lie beside it."""
    file = tmp_path / "study.toml"
    (tmp_path / "pair.toml").write_text(MISSION.text)
    good = 'mission = "pair.toml"\nruns = 4\nvary = ["agents.mass = uniform(1, 2)"]\n'
    file.write_text(good)
    found = Sweep.load(file, more=["agents.radius = grid(0.1, 0.2)"], seed=5)
    assert (found.name, found.runs, found.seed, len(found.columns)) == ("study", 4, 5, 2)
    file.write_text(good + "sed = 3\n[[obstacles]]\n")
    with pytest.raises(SweepError) as caught:
        Sweep.load(file)
    assert [f.file for f in caught.value.findings] == [str(file)] * 2
    assert "did you mean 'seed'?" in str(caught.value)
    file.write_text(good.partition("\n")[2])
    with pytest.raises(SweepError) as caught:
        Sweep.load(file)
    assert [(f.key, f.problem) for f in caught.value.findings] == [("mission", "is missing")]


# -- flying ------------------------------------------------------------------------------------------


def test_metrics_of_vehicles_with_rotors():
    """Rotors as a share of their limit, saturation as a share of a phase, and tilt, as the verdict has them."""
    counts = {"steps": 1, "evaluations": 4}
    result, points = (replace(f(3, 10.0), statistics=counts) for f in (quadrotors, swarm))
    found = measure_metrics(result, assess(result))
    assert found["rotor_share"] == pytest.approx(1.0)
    assert found["tilt"] == pytest.approx(20.0)
    result.phases[0].extremes["saturation"] = Extremum(0.25, 5.0, 1, -1)
    assert measure_metrics(result, assess(result))["saturation"] == pytest.approx(0.25)
    of_points = measure_metrics(points, assess(points))
    assert all(math.isnan(of_points[name]) for name in ("rotor_share", "saturation", "tilt"))
    off = np.linalg.norm(result.position - result.slot_position, axis=2)
    assert found["tracking_error"] == of_points["tracking_error"] == off.max()


def test_metrics_are_those_of_the_verdict(tmp_path):
    """A row has what assess says of the varied mission, flown beside the others of its group."""
    from rigidfleet.simulation.together import simulate_together

    found = sweep(runs=3)
    row = fly_runs(found, range(3))[2]
    result = simulate_together([Mission.from_dict(found.document_of_run(run)) for run in range(3)])[
        2
    ]
    verdict = assess(result)
    assert list(row.metrics) == list(METRICS)
    assert row.passed == verdict.passed
    assert row.metrics["thrust"] == verdict.worst["thrust"].value >= result.thrust.max()
    assert row.metrics["separation"] == result.separation.min()
    assert row.metrics["constraint"] == abs(verdict.worst["constraint"].value)
    assert row.metrics["shape_end"] == verdict.phases[-1].shape
    assert row.metrics["steps"] == result.statistics["steps"]
    assert math.isnan(row.metrics["clearance"])


FOUND = "narrow-passage-found"  # searches its way through a gap


@pytest.mark.parametrize(
    ("line", "searches"),
    [
        ("constraint.alpha = grid(0.4, 0.6)", 1),
        ("tracking.Q.1 = grid(3, 9)", 1),
        ("agents.mass.1 = grid(1, 1.2)", 2),
        ("obstacles.3.min.1 += grid(0, 0.4)", 2),
    ],
)
def test_a_way_is_searched_once_where_nothing_that_varies_matters_to_it(
    monkeypatch, line, searches
):
    """A gain leaves the way, a wall may move it: rows are those of missions that search for themselves, to the bit."""
    from rigidfleet.planning import ways
    from rigidfleet.simulation.together import simulate_together

    count, search = [0], ways._Search.mission_with_way_and_legs

    def counted(self: Any) -> Any:
        count[0] += 1
        return search(self)

    monkeypatch.setattr(ways._Search, "mission_with_way_and_legs", counted)
    varied = Sweep.of(FOUND, [line])
    rows = fly_runs(varied, range(2))
    assert count[0] == searches
    alone = simulate_together([Mission.from_dict(varied.document_of_run(k)) for k in range(2)])
    assert count[0] == searches + 2
    for row, result in zip(rows, alone, strict=True):
        own = measure_metrics(result, assess(result))
        assert row.passed
        assert np.array_equal([*row.metrics.values()], [*own.values()], equal_nan=True)


def test_what_matters_in_flight_alone_changes_no_way():
    """Phases that are found are the same for other tolerances, air, noise and gains; all else counts as a change."""
    written = load_mission(FOUND)
    noise = {"position": 0.02, "velocity": 0.05, "rate": 20.0, "seed": 3}
    gusts = {"model": "dryden", "altitude": 20.0, "correlation_length": 20.0, "seed": 1}
    air = {"wind": [3.0, 1.0, 0.0], "drag": 0.4, "mass_error": 0.1, "gusts": gusts, "noise": noise}
    other = {
        "integrator": {"rtol": 1e-5},
        "constraint": {"alpha": 0.6},
        "tracking": {"Q": [9.0, 5.0]},
        "disturbances": air,
    }
    for keys in [
        ("integrator", "rtol"),
        ("constraint", "alpha"),
        ("tracking", "Q", 0),
        *(("disturbances", k) for k in air),
    ]:
        assert not can_affect_plan(written, keys)
    assert written.to_dict().keys().isdisjoint(other)
    changed = Mission.from_dict(written.to_dict() | other)
    phases = [expand_mission(mission).to_dict()["phases"] for mission in (written, changed)]
    assert phases[0] == phases[1]
    assert len(phases[0]) > len(written.phases)
    for path in (
        "agents.position.1",
        "agents.mass",
        "obstacles.2",
        "lqr.S",
        "disturbances.lost",
    ):
        assert can_affect_plan(written, tuple(path.split(".")))
    settling = [{**PAIR["phases"][0], "settle": {}}]
    del settling[0]["until"]
    assert can_affect_plan(Mission.from_dict(PAIR | {"phases": settling}), ("constraint", "alpha"))
    assert can_affect_plan(load_mission("passage-quadrotors"), ("constraint", "alpha"))


def test_tracking_matters_where_a_body_arrives_before_its_phase_ends():
    """It then comes to rest by tracking, and only from rest a way begins: slow gains leave it in motion."""
    tables = load_mission(FOUND).to_dict()
    tables["phases"][-3]["travel"] = 6.0
    tables["lqr"]["S"] = [1e3, 0.0]  # the velocity on arrival is free
    written = Mission.from_dict(tables | {"tracking": {"Q": [40.0, 40.0]}})
    assert can_affect_plan(written, ("tracking", "Q"))
    assert len(expand_mission(written).phases) > len(written.phases)
    with pytest.raises(MissionError, match="a way begins at rest"):
        expand_mission(Mission.from_dict(tables | {"tracking": {"Q": [0.1, 0.1]}}))


def test_air_and_noise_move_ways_to_own_places():
    """Ways home keep room for what drag does, which tracking answers to; only tolerances leave them."""
    tables = load_mission("change-of-picture").to_dict()
    tables["phases"][-1]["places"] = "own"
    home = Mission.from_dict(tables)
    for path in ("disturbances.wind", "disturbances.noise", "tracking.Q", "constraint.alpha"):
        assert can_affect_plan(home, tuple(path.split(".")))
    assert not can_affect_plan(home, ("integrator", "rtol"))
    assert len(expand_mission(home).phases) > len(home.phases)
    air = {"drag": 0.3, "wind": [6.0, 0.0, 0.0]}
    with pytest.raises(MissionError, match="straight to their own"):
        expand_mission(Mission.from_dict(tables | {"disturbances": air}))


def test_a_sweep_without_a_way_says_so_in_each_row():
    """Where no way is found, each run is refused, with the reason that its mission alone has."""
    tables = load_mission(FOUND).to_dict()
    tables["phases"][-2]["position"] = [38.0, 70.0, 10.0]  # inside a wall
    blocked = Sweep.of(Mission.from_dict(tables), ["constraint.alpha = grid(0.4, 0.6)"])
    rows = fly_runs(blocked, range(2))
    with pytest.raises(MissionError, match="its goal leaves agent") as caught:
        complete_times(blocked.mission)
    assert [row.reason for row in rows] == ["mission"] * 2
    assert all(caught.value.findings[0].problem in row.detail for row in rows)


def test_a_failed_run_is_a_row_with_its_reason(tmp_path):
    """A mission that cannot be, and one that does not pass, end no sweep."""
    table = fly(sweep("agents.mass = grid(1, -1, 2)", runs=None), tmp_path, workers=1)
    assert table.reason.tolist() == ["", "mission", "thrust"]
    assert table.passed.tolist() == [True, False, False]
    assert "agents.mass" in table.detail[1]
    assert "thrust" in table.detail[2]
    assert np.isnan(table.metrics["speed"][1])
    assert table.metrics["thrust"][2] > 14.0


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> Table:
    """A sweep of twenty runs, flown in one go by one process."""
    return fly(sweep(), tmp_path_factory.mktemp("flown"), workers=1)


def test_rows_are_the_same_for_any_number_of_workers(flown, tmp_path, monkeypatch):
    """Processes give the rows of one process, bit for bit."""
    monkeypatch.setattr("rigidfleet.sweep.runner.WORTH", 0.0)
    seen: list[SweepProgress] = []
    table = fly(sweep(), tmp_path, workers=2, progress=seen.append)
    assert numbers(table) == numbers(flown)
    assert seen[-1].workers == 2
    assert (seen[0].done, seen[-1].done, seen[-1].flown) == (0, 20, 20)


def test_a_sweep_goes_on_where_it_was_stopped(flown, tmp_path):
    """Ctrl-C after any chunk leaves whole groups; the same call adds the rest, and flies nothing twice."""

    def stop(progress: SweepProgress) -> None:
        if progress.flown:
            raise KeyboardInterrupt

    for there in (8, 16):
        with pytest.raises(KeyboardInterrupt):
            fly(sweep(), tmp_path, workers=1, progress=stop)
        assert len(read(tmp_path).run) == there
        assert not read(tmp_path).complete
    seen: list[SweepProgress] = []
    assert numbers(fly(sweep(), tmp_path, workers=1, progress=seen.append)) == numbers(flown)
    assert seen[-1].flown == 4


def test_more_runs_may_be_added(flown, tmp_path):
    """Six runs that become twenty are those of twenty, and fewer than there are is refused."""
    fly(sweep(runs=6), tmp_path, workers=1)
    assert numbers(fly(sweep(), tmp_path, workers=1)) == numbers(flown)
    with pytest.raises(ResultError, match="with 20 runs, more than 6"):
        fly(sweep(runs=6), tmp_path, workers=1)


def test_another_sweep_is_refused(tmp_path):
    """A folder keeps its sweep, unless it is to be replaced."""
    fly(sweep(runs=3), tmp_path, workers=1)
    with pytest.raises(ResultError, match=r"another sweep.*seed.*--force"):
        fly(sweep(runs=3, seed=9), tmp_path, workers=1)
    assert read(tmp_path).sweep.seed == 3
    assert fly(sweep(runs=2, seed=9), tmp_path, workers=1, replace=True).run.tolist() == [0, 1]


def test_two_do_not_write_the_same_sweep(tmp_path):
    """While one process flies a sweep another is told so; reading goes on."""

    def second(progress: SweepProgress) -> None:
        with pytest.raises(ResultError, match="another sweep is writing"):
            fly(sweep(runs=3), tmp_path, workers=1)
        assert len(read(tmp_path).run) == progress.done

    fly(sweep(runs=3), tmp_path, workers=1, progress=second)


def test_what_is_no_store(tmp_path):
    """A folder without a sweep, and a file that is none, are named, not overwritten."""
    with pytest.raises(ResultError, match="contains no sweep"):
        read(tmp_path)
    (tmp_path / "sweep.db").write_bytes(b"not a database at all" * 100)
    with pytest.raises(ResultError, match="is damaged or not the store"):
        fly(sweep(runs=3), tmp_path, workers=1)
    assert (tmp_path / "sweep.db").read_bytes().startswith(b"not a database")


def test_a_store_without_its_table_is_as_absent(tmp_path):
    """What a store killed as it began leaves, a file that is empty or a head alone, is no sweep; the call fills it."""
    for name in ("empty", "shards/2-of-2"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "sweep.db").touch()
    (tmp_path / "head").mkdir()
    with closing(sqlite3.connect(tmp_path / "head" / "sweep.db")) as db:
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA user_version = 1")
    assert (tmp_path / "head" / "sweep.db").stat().st_size
    for name in ("empty", "head"):
        with pytest.raises(ResultError, match=f"{name}: contains no sweep"):
            read(tmp_path / name)
        assert fly(sweep(runs=3), tmp_path / name, workers=1).complete
    with pytest.raises(ResultError, match="shards: contains no sweep"):
        merge(tmp_path)
    parts(tmp_path, "1/2")
    with pytest.raises(ResultError, match="missing or partly flown: 2\\. Fly"):
        merge(tmp_path)
    parts(tmp_path, "2/2")
    assert merge(tmp_path).complete


def test_a_group_is_never_split():
    """Chunks are whole groups of eight consecutive runs, whatever is missing."""
    from rigidfleet.sweep.runner import _Sweeping

    class Gaps:
        path = Path("gaps/sweep.db")

        def finished_runs(self):
            there = np.ones(100, dtype=bool)
            there[[3, 4, 40, 97]] = False
            return there

    under_way = _Sweeping(sweep(runs=100), Gaps(), None, np.ones(100, bool))  # ty: ignore[invalid-argument-type]
    under_way.pace = 1e-6
    taken = [under_way.take_chunk(1) for _ in range(2)]
    assert taken == [[*range(8), *range(40, 48)], [96, 97, 98, 99]]
    assert GROUP == 8


# -- evaluated by final states -------------------------------------------------------------------------

TETRAHEDRON: dict[str, Any] = {
    "schema_version": 1,
    "name": "tetrahedron",
    "output_step": 0.1,
    "agents": {"mass": 1.0, "position": [[0, 0, 5], [3, 1, 5], [1, 3, 5], [1, 1, 7]], "radius": 1e-3},
    "constraint": {"damping": 0.03},
    "formations": {"tetrahedron": {"slots": [[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2]]}},
    "phases": [
        {
            "kind": "establish", "formation": "tetrahedron", "reference": "squares", "control": "open",
            "blend": 1.0, "until": 8.0,
        },
        {"kind": "hold", "control": "open", "duration": 1.0},
    ],
}  # fmt: skip
STARTS = ["agents.position.*.* += normal(0, 1.5)", "agents.velocity.1 = uniform(-0.1, 0.1)"]


def by_final_states(
    *vary: str, mission: dict[str, Any] = TETRAHEDRON, runs: int | None = 20
) -> Sweep:
    return Sweep.of(Mission.from_dict(mission), vary or STARTS, runs=runs, seed=3, evaluate="final")


@pytest.fixture(scope="module")
def ends(tmp_path_factory) -> Table:
    return fly(by_final_states(), tmp_path_factory.mktemp("ends"), workers=1)


def test_ends_are_those_of_whole_flights(ends):
    """Starts bit for bit, what fails, and the shape to the integrator's tolerance are those of whole flights."""
    whole = Sweep.of(Mission.from_dict(TETRAHEDRON), STARTS, runs=20, seed=3)
    values = [whole.values(run) for run in range(20)]
    for k, (r, v) in enumerate(zip(*start_states(whole, values), strict=True)):
        agents = Mission.from_dict(whole.document_of_run(k)).agents
        assert (np.array(agents.position) == r).all()
        assert (np.array(agents.velocity) == v).all()
    rows = fly_runs(whole, range(20))
    assert ends.codes.tolist() == [list(row.codes) for row in rows]
    assert ends.reason.tolist() == [row.reason for row in rows]
    assert 0 < ends.passed.sum() < 20  # some are their own mirror images
    assert set(ends.reason) == {"", "handedness"}
    for name in ("shape_end", "shape", "constraint_end", "handed", "flown"):
        of_rows = [row.metrics[name] for row in rows]
        np.testing.assert_allclose(ends.metrics[name], of_rows, rtol=0, atol=1e-7)
    assert np.isnan(ends.metrics["thrust"]).all()
    bare = {"tetrahedron": TETRAHEDRON["formations"]["tetrahedron"] | {"edges": []}}
    (row,) = fly_runs(by_final_states(mission=TETRAHEDRON | {"formations": bare}, runs=1), [0])
    assert (row.reason, math.isnan(row.metrics["constraint_end"])) == ("shape", True)


def test_ends_are_the_same_however_they_are_flown(ends, tmp_path, monkeypatch):
    """Bit for bit: after interruptions, with runs added, and by processes."""
    fly(by_final_states(runs=6), tmp_path / "a", workers=1)
    assert numbers(fly(by_final_states(), tmp_path / "a", workers=1)) == numbers(ends)
    monkeypatch.setattr("rigidfleet.sweep.runner.WORTH", 0.0)
    assert numbers(fly(by_final_states(), tmp_path / "b", workers=2)) == numbers(ends)
    with pytest.raises(ResultError, match="it differs in: what is evaluated"):
        fly(Sweep.of(Mission.from_dict(TETRAHEDRON), STARTS, runs=20, seed=3), tmp_path / "a")


def test_starts_that_cannot_be_are_rows(ends, tmp_path):
    """Agents at one place, or beyond all bounds, or too fast to go on: rows with the reason; others fly as ever."""
    found = by_final_states(
        "agents.position.2.1 = grid(0, 3)",
        "agents.position.2.2 = grid(0)",
        "agents.position.1.3 *= grid(1, 1e300)",
        "agents.velocity.3.1 = grid(0, 1e5)",
        runs=None,
    )
    table = fly(found, tmp_path, workers=1)
    assert table.reason.tolist()[:4] == ["mission", "mission", "mission", "mission"]
    assert table.reason.tolist()[4:] == ["", "complete", "mission", "mission"]
    assert np.isnan(table.metrics["shape_end"][1])
    assert table.metrics["shape_end"][4] < 1e-3


def test_starts_that_are_no_mission_are_told_as_whole_flights_are(tmp_path):
    """Starts next to one plane or point, or far from all others: flown or refused as their missions are."""
    vary = (
        "agents.position.*.3 = grid(5, 6)",
        "agents.position.4.3 += grid(0, 1e-10, 1e-4, 1e8)",
        "agents.position.2.1 = grid(3, 1e-8)",
    )
    found = by_final_states(*vary, runs=None)
    rows = fly(found, tmp_path, workers=1)
    whole = fly_runs(Sweep.of(Mission.from_dict(TETRAHEDRON), vary), range(found.runs))
    refused = [row.reason == "mission" for row in whole]
    assert 0 < sum(refused) < found.runs
    assert (rows.reason == "mission").tolist() == refused
    assert rows.detail[refused].tolist() == [row.detail for row in whole if row.reason == "mission"]


@pytest.mark.parametrize("name", ["atol_velocity", "atol_integral"])
def test_ends_are_flown_to_the_tolerances_of_the_mission(name, tmp_path):
    """Those of a class of states, too: what they ask for is what the flights take in evaluations."""
    given = {"rtol": 1e-6, "atol": 1e-4}
    loose, tight = (TETRAHEDRON | {"integrator": given | more} for more in ({}, {name: 1e-12}))
    few, many = (
        fly(by_final_states(mission=m, runs=8), tmp_path / str(k), workers=1).metrics["evaluations"]
        for k, m in enumerate((loose, tight))
    )
    assert (many > 2 * few).all()


def test_what_final_states_cannot_evaluate_is_refused(tmp_path):
    """Other missions and other variations are named, with the way out."""
    with pytest.raises(SweepError) as caught:
        by_final_states("agents.mass.* *= normal(1, 0.1)", "agents.position.1.1 = choice(0, 1)")
    assert [f.key for f in caught.value.findings] == ["vary[1].path"]
    assert "no --final-states" in caught.value.findings[0].remedy
    tracked = TETRAHEDRON | {
        "phases": [{"kind": "establish", "formation": "tetrahedron", "until": 9.0}]
    }
    windy = TETRAHEDRON | {"disturbances": {"wind": [1, 0, 0]}}
    for mission, why in ((tracked, "only open-loop phases"), (windy, "calm air")):
        with pytest.raises(SweepError, match=why):
            by_final_states(mission=mission)
    file = tmp_path / "s.toml"
    file.write_text(
        'mission = "establish-triangle"\nruns = 3\nevaluate = "end"\nvary = ["agents.position.*.* += normal(0, 1)"]'
    )
    with pytest.raises(SweepError, match="evaluate"):
        Sweep.load(file)
    file.write_text(file.read_text().replace('"end"', '"final"'))
    assert Sweep.load(file).evaluate == "final"
    assert Sweep.from_json(Sweep.load(file).json()).evaluate == "final"


def test_the_command_evaluates_final_states(capsys, tmp_path, monkeypatch):
    """`--final-states` flies starts, says so in the store, and cannot be put on a sweep that is there."""
    monkeypatch.chdir(tmp_path)
    vary = ["--vary", "agents.position.*.* += normal(0, 0.3)", "--runs", "16", "--no-figures"]
    assert cli.main(["sweep", "establish-triangle", *vary, "--final-states"]) == 0
    assert "16 of 16 runs passed" in capsys.readouterr().out
    assert read(tmp_path / "sweeps" / "establish-triangle").sweep.evaluate == "final"
    assert cli.main(["sweep", "sweeps/establish-triangle", "--final-states"]) == 2
    assert "definition cannot change" in capsys.readouterr().err


# -- shards ------------------------------------------------------------------------------------------


def parts(folder: Path, *shards: str, asked: Sweep | None = None) -> None:
    """Fly shards. One that has no group of eight says so, and how many have; no other says anything."""
    flown = asked or sweep()
    useful = math.ceil(flown.runs / 8)
    for shard in shards:
        words = f"--shard {shard}: nothing to fly; {flown.runs} runs, .* N up to {useful}\\."
        idle = int(shard.partition("/")[0]) > useful
        with pytest.warns(UserWarning, match=words) if idle else nullcontext():
            fly(flown, folder, workers=1, shard=shard)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_shards_are_merged_to_the_rows_of_one_run(flown, tmp_path, count):
    """Bit for bit, in any order, with shards that have nothing to fly; merged again, and with more runs later."""
    parts(tmp_path, *[f"{k}/{count}" for k in range(count, 0, -1)], asked=sweep(runs=12))
    first = merge(tmp_path)
    assert first.complete
    assert numbers(first) == numbers(fly(sweep(runs=12), tmp_path / "whole", workers=1))
    parts(tmp_path, *[f"{k}/{count}" for k in range(1, count + 1)])
    assert numbers(merge(tmp_path)) == numbers(merge(tmp_path)) == numbers(flown)


def test_shards_share_all_runs():
    """Each run is in one shard, with the others of its group of eight, however many shards there are."""
    for count in (1, 3, 40):
        masks = np.array([runs_of_shard(f"{k}/{count}", 1003) for k in range(1, count + 1)])
        assert (masks.sum(axis=0) == 1).all()
        assert all(len({*np.flatnonzero(x[:1000]) // 8}) * 8 == x[:1000].sum() for x in masks)
        assert np.ptp(masks.sum(axis=1)) <= 8


def test_a_shard_that_is_missing_or_partly_flown_is_named(tmp_path):
    """Merging says which, how far, and the command that flies it, and writes nothing; a shard goes on where it was."""

    def stop(progress: SweepProgress) -> None:
        assert not Path(
            tmp_path, "shards/1-of-3/sweep.db-wal"
        ).exists()  # a network's disk has none
        if progress.flown:
            raise KeyboardInterrupt

    with pytest.raises(ResultError, match="shards: contains no sweep"):
        merge(tmp_path)
    asked = sweep(runs=60)
    with pytest.raises(KeyboardInterrupt):
        fly(asked, tmp_path, workers=1, shard="1/3", progress=stop)
    parts(tmp_path, "2/3", asked=asked)
    with pytest.raises(ResultError) as caught:
        merge(tmp_path)
    words = str(caught.value)
    assert "of 3 shards, these are missing or partly flown: 1 (has 8 of 24 runs), 3." in words
    assert f"`rigidfleet sweep {tmp_path} --shard 1/3 --runs 60`" in words
    assert not (tmp_path / "sweep.db").exists()
    seen: list[SweepProgress] = []
    fly(asked, tmp_path, workers=1, shard="1/3", progress=seen.append)
    assert (seen[0].done, seen[-1].done, seen[-1].runs, seen[-1].flown) == (8, 24, 24, 16)
    parts(tmp_path, "3/3", asked=asked)
    assert merge(tmp_path).complete


def change(folder: Path, words: str) -> None:
    with closing(sqlite3.connect(folder / "sweep.db")) as db, db:
        db.execute(words)


def test_shards_that_do_not_fit_are_refused(tmp_path, monkeypatch):
    """What differs is named: seed, number of shards, mission, version."""
    odd = Mission.from_dict(PAIR | {"output_step": 0.05})
    for k, (shard, asked, words) in enumerate(
        (
            ("2/2", sweep(seed=4), "seed"),
            ("2/3", sweep(), "number of shards"),
            ("2/2", sweep(mission=odd), "mission"),
            ("2/2", sweep(), "version"),
        )
    ):
        here = tmp_path / str(k)
        parts(here, "1/2")
        with monkeypatch.context() as other:
            if words == "version":
                other.setattr("rigidfleet.sweep.definition.__version__", "0.0.0")
            parts(here, shard, asked=asked)
        with pytest.raises(
            ResultError, match=rf"does not fit .*1-of-2; it differs in: {words}\. Move"
        ):
            merge(here)


def test_a_shard_may_come_twice(flown, tmp_path):
    """The same rows are taken once, whenever and wherever they were flown; rows that differ are named and refused."""
    parts(tmp_path, "1/2", "2/2")
    again = tmp_path / "shards" / "from another machine"
    shutil.copytree(tmp_path / "shards" / "2-of-2", again)
    change(again, "UPDATE runs SET wall = wall + 1, level = 'another'")
    assert numbers(merge(tmp_path)) == numbers(flown)
    change(again, "UPDATE runs SET thrust = thrust * (1 + 1e-15) WHERE run = 9")
    words = r"from another machine: run 9 is not as in .*2-of-2\. If only last digits differ"
    with pytest.raises(ResultError, match=words):
        merge(tmp_path)


def test_levels_of_machine_code_are_kept(tmp_path):
    """Rows say which level flew them; a sweep of two levels is merged, and its summary says so."""
    parts(tmp_path, "1/2", "2/2")
    (level,) = merge(tmp_path).levels
    assert "Levels" not in shown(read(tmp_path), 200)
    change(tmp_path / "shards" / "2-of-2", "UPDATE runs SET level = 'another'")
    assert merge(tmp_path).levels == {level: 12, "another": 8}
    assert f"last bits differ: 12 by {level}, 8 by another" in shown(read(tmp_path), 200)
    change(tmp_path, "UPDATE runs SET level = NULL")  # as an earlier version wrote it
    assert read(tmp_path).levels == {}


# -- executors ---------------------------------------------------------------------------------------


class Dying(ThreadPoolExecutor):
    """An executor that breaks when it has taken two chunks."""

    def submit(self, *job: Any, **more: Any) -> Any:
        self.count = getattr(self, "count", 0) + 1
        if self.count > 2:
            raise BrokenProcessPool("a process died")
        return super().submit(*job, **more)


def test_any_executor_flies_a_sweep(tmp_path):
    """Threads that take turns all the time give the rows of one process, bit for bit, and are left open."""
    asked = Sweep.of("narrow-passage", ["agents.mass.* *= normal(1, 0.05)"], runs=48)
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(3) as pool:
            table = fly(asked, tmp_path / "pool", pool=pool, workers=3)
            assert pool.submit(int, "3").result() == 3
    finally:
        sys.setswitchinterval(before)
    assert table.passed.all()
    with pytest.raises(TypeError, match="an Executor of concurrent"):
        fly(asked, tmp_path, pool=lambda: ThreadPoolExecutor(1))  # ty: ignore[invalid-argument-type]
    assert numbers(table) == numbers(fly(asked, tmp_path / "alone", workers=1))


def test_an_executor_that_dies_is_a_sentence(flown, tmp_path, monkeypatch, capsys, caplog):
    """What happened, what is saved and how to go on; a program that does not listen hears nothing else."""
    asked = sweep()
    listening = caplog.at_level(logging.INFO, "rigidfleet.sweep")
    with listening, Dying(1) as pool, pytest.raises(RigidfleetError) as caught:
        fly(asked, tmp_path, pool=pool, workers=1)
    done = len(read(tmp_path).run)
    assert str(caught.value) == (
        "workers died. If memory is short, use fewer of them; a script needs `if __name__ == '__main__':`."
        f" {tmp_path}: {done} of 20 runs are saved; the same command goes on."
    )
    warned = [r.message for r in caplog.records if r.levelno == logging.WARNING]
    assert 0 < len(warned) <= 2
    assert all("lost in flight: 8, from" in words for words in warned)
    caplog.clear()
    monkeypatch.setattr(logging.root, "handlers", [])
    with ThreadPoolExecutor(1) as pool:
        assert numbers(fly(asked, tmp_path, pool=pool, workers=1)) == numbers(flown)
    with Dying(1) as pool, pytest.raises(RigidfleetError):
        fly(asked, tmp_path / "again", pool=pool, workers=1)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    "fault",
    [
        MemoryError("no room"),
        OSError(errno.EMFILE, "too many open files"),
        RuntimeError("can't start new thread"),
        RigidfleetError("RIGIDFLEET_LEVEL: no"),
    ],
)
def test_a_fault_of_the_machine_is_no_row(flown, fault, tmp_path, monkeypatch):
    """It ends the chunk, in this process and in a worker, in flight and in the verdict; elsewhere the sweep goes on."""

    def fail(*_: Any) -> Any:
        raise fault

    for place in ("simulation.together.simulate_together", "assessment.assess"):
        with monkeypatch.context() as short, ThreadPoolExecutor(1) as pool:
            short.setattr(f"rigidfleet.{place}", fail)
            with pytest.raises(RigidfleetError, match=re.escape(str(fault))):
                fly(sweep(), tmp_path, workers=1)
            words = rf"a worker failed: .*{re.escape(str(fault))}\. .*: 0 of 20 runs are saved; the same command"
            with pytest.raises(RigidfleetError, match=words):
                fly(sweep(), tmp_path, pool=pool, workers=1)
    assert not len(read(tmp_path).run)
    assert numbers(fly(sweep(), tmp_path, workers=1)) == numbers(flown)


def test_a_file_that_a_run_lacks_fails_that_run(tmp_path, monkeypatch):
    """An error of the system that is no lack of the machine is the outcome of its run: all rows are there."""

    def fail(*_: Any) -> Any:
        raise FileNotFoundError(errno.ENOENT, "no gains", "gains.csv")

    monkeypatch.setattr("rigidfleet.assessment.assess", fail)
    table = fly(sweep(), tmp_path, workers=1)
    assert len(table.run) == 20
    assert set(table.reason) == {"error"}


def test_a_worker_that_cannot_run_the_level_says_so(tmp_path, monkeypatch):
    """A worker's machine is asked before it flies, so that no row is false."""
    monkeypatch.setenv("RIGIDFLEET_LEVEL", "x86-64-v9")
    words = r"a worker failed: RIGIDFLEET_LEVEL: this machine cannot run 'x86-64-v9'.*0 of 20 runs"
    with ThreadPoolExecutor(1) as pool, pytest.raises(RigidfleetError, match=words):
        fly(sweep(), tmp_path, pool=pool, workers=1)


@pytest.mark.parametrize(
    ("keys", "error", "words"),
    [
        ({"workers": 0}, TypeError, "a whole number of workers, 1 or more, got 0"),
        ({"workers": -2}, TypeError, "got -2"),
        ({"workers": 1.5}, TypeError, "got 1.5"),
        ({"workers": "2"}, TypeError, "got '2'"),
        ({"pool": 0, "workers": 0}, TypeError, "got 0"),
        ({"pool": 0, "cluster": "tcp://127.0.0.1:9"}, RigidfleetError, "exclude each other"),
        ({"pool": 0}, RigidfleetError, "takes no work: RuntimeError: .* after shutdown.* 0 of 20"),
    ],
)
def test_workers_that_cannot_be_are_one_error(keys, error, words, tmp_path):
    """Numbers of workers that are none, an executor beside a cluster, and one that is shut down."""
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    with pytest.raises(error, match=words):
        fly(sweep(), tmp_path, **keys | ({"pool": pool} if "pool" in keys else {}))


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux forks")
def test_a_machine_without_room_for_a_process_says_so(tmp_path, monkeypatch):
    """Neither a fork nor an executor that starts a process in vain is taken for a cluster that ended."""

    def refuse(*_: Any) -> Any:
        raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr("rigidfleet.sweep.runner.WORTH", 0.0)
    monkeypatch.setattr("rigidfleet.sweep.workers._is_fork_safe", lambda: True)
    monkeypatch.setattr("multiprocessing.process.BaseProcess.start", refuse)
    with pytest.raises(
        RigidfleetError, match=r"no process can be started: .*unavailable\. Use fewer"
    ):
        fly(sweep(runs=60), tmp_path, workers=2)
    monkeypatch.setattr(ThreadPoolExecutor, "submit", refuse)
    words = r"takes no work: BlockingIOError: .*unavailable\. .*: 8 of 60 runs are saved"
    with ThreadPoolExecutor(1) as pool, pytest.raises(RigidfleetError, match=words):
        fly(sweep(runs=60), tmp_path, pool=pool, workers=1)


def test_a_pool_that_breaks_as_it_is_given_work_loses_none(tmp_path, monkeypatch, caplog):
    """The chunk that a broken pool does not take is flown by the next one; the log says what progress says."""
    from contextlib import contextmanager

    @contextmanager
    def processes(count: int) -> Generator[Any]:
        with kinds.pop(0)(count) as pool:
            yield pool

    kinds = [Dying, ThreadPoolExecutor]

    monkeypatch.setattr("rigidfleet.sweep.runner.WORTH", 0.0)
    monkeypatch.setattr("rigidfleet.sweep.workers.start_processes", processes)
    monkeypatch.setattr("rigidfleet.sweep.runner._CHUNK", 0.0)
    asked = sweep(runs=60)
    with caplog.at_level(logging.INFO, "rigidfleet.sweep"):
        table = fly(asked, tmp_path, workers=2)
    assert numbers(table) == numbers(fly(asked, tmp_path / "alone", workers=1))
    said = [record.message for record in caplog.records]
    failed = 60 - int(table.passed.sum())
    assert said[0] == f"{tmp_path}: 0 of 60 runs; begun"
    assert said[-2:] == [
        f"{tmp_path}: 60 of 60 runs, {failed} of 60 flown failed",
        f"{tmp_path}: 60 of 60 runs; done",
    ]


@pytest.mark.long
def test_loky_flies_a_sweep(flown, tmp_path):
    """Processes of loky give the rows of one process, and one that is killed is a sentence."""
    loky = pytest.importorskip("loky")

    def kill(progress: SweepProgress) -> None:
        if progress.flown:
            os.kill(pids.pop(), signal.SIGKILL)

    with loky.ProcessPoolExecutor(2) as pool:
        assert numbers(fly(sweep(), tmp_path / "whole", pool=pool, workers=2)) == numbers(flown)
        pids = {pool.submit(os.getpid).result() for _ in range(20)}
        with pytest.raises(RigidfleetError, match=r"workers died.* of 4000 runs are saved"):
            fly(sweep(runs=4000), tmp_path / "killed", pool=pool, workers=2, progress=kill)


# -- killed ------------------------------------------------------------------------------------------


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "rigidfleet", *map(str, arguments)]


def until(ready: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
    """Wait for something that a process does, or for its end."""
    while process.poll() is None and not ready():
        time.sleep(0.01)


def count(folder: Path) -> int:
    try:
        with closing(sqlite3.connect(folder / "sweep.db")) as db:
            return db.execute("SELECT count(*) FROM runs").fetchone()[0]
    except sqlite3.Error:
        return 0


@pytest.mark.long
@pytest.mark.parametrize("workers", [1, 2])
def test_killed_at_any_moment(workers, tmp_path):
    """After kill -9 at random moments the same command ends with the rows of an uninterrupted sweep."""
    runs = 64 if workers == 1 else 1500
    (tmp_path / "pair.toml").write_text(MISSION.text)
    asked = ["sweep", tmp_path / "pair.toml", "--runs", runs, "--workers", workers, "--no-figures"]
    asked += [option for line in SCATTER for option in ("--vary", line)]
    asked += ["--out", tmp_path / "killed", "--quiet"]
    moments, kills = random.Random(1), 0
    for share in (0.1, 0.5, 0.8):
        process = subprocess.Popen(command(*asked), stderr=subprocess.PIPE)
        until(lambda share=share: count(tmp_path / "killed") > share * runs, process)
        time.sleep(0.2 * moments.random())
        kills += process.poll() is None
        process.kill()
        assert b"Traceback" not in process.communicate()[1]
    assert kills >= 1
    assert subprocess.run(command(*asked), check=False).returncode == codes.PASSED
    whole = fly(Sweep.of(MISSION, SCATTER, runs=runs), tmp_path / "whole", workers=1)
    assert numbers(read(tmp_path / "killed")) == numbers(whole)


@pytest.mark.long
def test_workers_end_with_what_started_them(tmp_path):
    """After kill -9 of the command none of its processes is left."""
    asked = ["sweep", "narrow-passage", "--runs", 5000, "--workers", 2, "--vary", SCATTER[1]]
    process = subprocess.Popen(command(*asked, "--out", tmp_path, "--quiet"))
    until(lambda: count(tmp_path) > 30, process)
    listed = subprocess.run(
        ["ps", "--ppid", str(process.pid), "-o", "pid="], check=True, capture_output=True, text=True
    )
    children = [int(pid) for pid in listed.stdout.split()]
    assert len(children) >= 2
    process.kill()
    process.wait()
    deadline = time.monotonic() + 20
    while any(Path(f"/proc/{pid}").exists() for pid in children) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(Path(f"/proc/{pid}").exists() for pid in children)


STARTED = """
import os, sys, threading
from rigidfleet.sweep import workers

mark = "here"

def of_a_fork() -> bool:
    return mark == "changed"

if __name__ == "__main__":
    mark = "changed"
    if sys.argv[1] == "threads":
        threading.Thread(target=threading.Event().wait, daemon=True).start()
    with workers.start_processes(2) as pool:
        print(pool.submit(of_a_fork).result())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells the threads of a process")
@pytest.mark.parametrize(("threads", "forked"), [("none", "True"), ("threads", "False")])
def test_workers_are_forks_of_a_process_without_threads(tmp_path, threads: str, forked: str):
    """Workers have what the process has computed where a fork is safe, and start on their own where it is not."""
    (tmp_path / "script.py").write_text(STARTED)
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, tmp_path / "script.py", threads], env=environment, capture_output=True, text=True, check=True
    )  # fmt: skip
    assert done.stdout.strip() == forked


@pytest.mark.long
def test_a_killed_worker_is_replaced(flown, tmp_path, monkeypatch):
    """A worker process killed in mid-run costs its chunk some time, and nothing else."""
    import multiprocessing

    monkeypatch.setattr("rigidfleet.sweep.runner.WORTH", 0.0)
    killed: list[int] = []

    def kill(progress: SweepProgress) -> None:
        children = multiprocessing.active_children()  # none once all chunks are flown
        if progress.workers == 2 and children and not killed:
            child = children[0]
            assert child.pid is not None
            killed.append(child.pid)
            os.kill(child.pid, signal.SIGKILL)

    table = fly(sweep(runs=400), tmp_path, workers=2, progress=kill)
    assert killed
    assert numbers(table) == numbers(fly(sweep(runs=400), tmp_path / "whole", workers=1))


def started(arguments: list[str]) -> subprocess.Popen[bytes]:
    """A Dask process."""
    tool = str(Path(sys.executable).with_name("dask"))
    quiet = subprocess.DEVNULL
    return subprocess.Popen([tool, *arguments, "--no-dashboard"], stdout=quiet, stderr=quiet)


@pytest.fixture
def dask(tmp_path, request) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and workers as the manual starts them, each a process: address, and all of these.

    There are two workers, without nannies, unless options of each are the parameter.
    """
    Client = pytest.importorskip("distributed").Client
    place = tmp_path / "scheduler.json"
    here = ["scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(place)]
    processes = [started(here)]
    try:
        until(lambda: place.exists() and place.stat().st_size > 0, processes[0])
        address = json.loads(place.read_text())["address"]
        for k, more in enumerate(getattr(request, "param", [["--no-nanny"]] * 2)):
            local = ["--local-directory", str(tmp_path / f"worker-{k}")]
            processes.append(started(["worker", address, "--nthreads", "1", *more, *local]))
        if len(processes) > 1:  # on a busy machine one might fly all before the other is there
            with Client(address) as client:
                client.wait_for_workers(len(processes) - 1, timeout=120)
        yield address, processes
    finally:
        for process in reversed(processes):
            process.terminate()  # a nanny ends its worker
            process.wait()


@pytest.mark.long
@pytest.mark.parametrize("dask", [[["--no-nanny"]] * 2, [["--nanny"]] * 2], indirect=True)
def test_a_cluster_loses_a_worker(dask, tmp_path):
    """Of two Dask workers one, or its nanny, is killed in mid-run: all rows come, the same bit for bit."""
    address, (_, *workers) = dask
    mission = "single-waypoint"
    asked = Sweep.of(mission, SCATTER, runs=200, seed=2)
    alone = fly(asked, tmp_path / "alone", workers=1)
    killed = []

    def kill(progress: SweepProgress) -> None:
        if progress.workers == 2 and progress.flown >= 32 and not killed:
            killed.append(progress.done)
            workers[0].kill()

    table = fly(asked, tmp_path / "cluster", cluster=address, progress=kill)
    assert killed
    assert killed[0] < 200
    assert numbers(table) == numbers(alone)


@pytest.mark.long
def test_a_worker_of_a_cluster_that_cannot_fly_passes_its_chunks_on(dask, tmp_path, monkeypatch):
    """One of three Dask workers stays and cannot run the level: all rows come; where none can, one sentence says so."""
    from distributed import Client

    address, processes = dask
    monkeypatch.setenv("RIGIDFLEET_LEVEL", "x86-64-v9")
    processes.append(
        started(
            [
                "worker",
                address,
                "--nthreads",
                "1",
                "--no-nanny",
                "--local-directory",
                str(tmp_path / "bad"),
            ]
        )
    )
    monkeypatch.delenv("RIGIDFLEET_LEVEL")
    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(3)
    asked = Sweep.of("single-waypoint", SCATTER, runs=200, seed=2)
    table = fly(asked, tmp_path / "cluster", cluster=address)
    assert numbers(table) == numbers(fly(asked, tmp_path / "alone", workers=1))
    for process in processes[1:3]:
        process.kill()
    words = r"a worker failed: RIGIDFLEET_LEVEL: this machine cannot run .* 0 of 200 runs are saved"
    with pytest.raises(RigidfleetError, match=words):
        fly(asked, tmp_path / "none", cluster=address)


@pytest.mark.long
def test_a_cluster_loses_its_scheduler(dask, tmp_path, capfd):
    """One sentence says what is saved, and nothing else is printed; the sweep then goes on without a cluster."""
    address, (scheduler, *_) = dask
    asked = Sweep.of("single-waypoint", SCATTER, runs=400, seed=2)

    def kill(progress: SweepProgress) -> None:
        if progress.flown >= 32:
            scheduler.kill()

    with pytest.raises(RigidfleetError) as caught:
        fly(asked, tmp_path / "cluster", cluster=address, progress=kill)
    done = len(read(tmp_path / "cluster").run)
    assert 32 <= done < 400
    assert str(caught.value) == (
        "the scheduler of the cluster ended, or the connection to it."
        f" {tmp_path / 'cluster'}: {done} of 400 runs are saved; the same command goes on."
    )
    assert capfd.readouterr() == ("", "")
    whole = fly(asked, tmp_path / "whole", workers=1)
    assert numbers(fly(asked, tmp_path / "cluster", workers=1)) == numbers(whole)


@pytest.fixture
def deadly(tmp_path, monkeypatch) -> None:
    """A module with a controller that ends the process, where processes that start later find it."""
    (tmp_path / "deadly.py").write_text("import os\ndef law(seen):\n    os._exit(1)\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))


@pytest.mark.long
@pytest.mark.parametrize("dask", [[["--nanny"]]], indirect=True)
def test_a_chunk_that_kills_its_workers(deadly, dask, tmp_path):
    """More deaths than Dask allows are one sentence."""
    address, _ = dask
    asked = Sweep.of(MISSION, SCATTER, runs=8, controller="deadly:law")
    with pytest.raises(RigidfleetError, match=r"workers died.* 0 of 8 runs are saved"):
        fly(asked, tmp_path / "cluster", cluster=address)


@pytest.mark.long
@pytest.mark.parametrize("dask", [[]], indirect=True)
def test_a_cluster_without_workers(dask, tmp_path, monkeypatch):
    """A scheduler that no worker joins in time is one sentence."""
    monkeypatch.setattr("rigidfleet.sweep.runner._ALONE", 2.0)
    with pytest.raises(RigidfleetError, match=r"no worker came for 2 s.* 0 of 20 runs are saved"):
        fly(sweep(), tmp_path / "cluster", cluster=dask[0])


@pytest.mark.long
def test_no_cluster_answers(tmp_path, monkeypatch):
    """An address without a scheduler is one clear error."""
    monkeypatch.setattr("rigidfleet.sweep.workers._CONNECT", 0.5)
    with pytest.raises(RigidfleetError, match="no scheduler answers"):
        fly(sweep(), tmp_path, cluster="tcp://127.0.0.1:9")


# -- analysis ----------------------------------------------------------------------------------------


def made(n: int = 400, runs: int | None = None) -> Table:
    """A table of known law: heavier vehicles need more thrust, and fail beyond 14 N."""
    found = sweep(
        "agents.mass = uniform(0.8, 2)", "agents.radius = uniform(0.1, 0.5)", runs=runs or n
    )
    codes = np.array([found.values(k) for k in range(n)])
    thrust = 9.81 * codes[:, 0]
    metrics = {name: np.full(n, math.nan) for name in METRICS}
    metrics |= {"thrust": thrust, "separation": 3.0 - 2.0 * codes[:, 1] + 0.1 * codes[:, 0]}
    passed = thrust <= 14.0
    reason = np.where(passed, "", "thrust, speed").astype(object)
    return Table(
        found, np.arange(n), passed, reason, reason.copy(), codes, metrics, np.full(n, 0.1)
    )


def test_wilsons_interval():
    """The interval of a rate solves Wilson's equation |p - k/n| = z sqrt(p (1 - p) / n)."""
    found = pass_rate(np.arange(50) < 41)
    assert found.rate == 0.82
    z = stats.norm.ppf(0.975)
    for p in (found.low, found.high):
        assert abs(p - found.rate) == pytest.approx(z * math.sqrt(p * (1 - p) / 50))
    assert pass_rate(np.array([], dtype=bool)).high == 1.0


def test_summary_finds_what_drives_failure():
    """Rates, percentiles and reasons are those of the rows; the driver comes first, by Spearman's formula."""
    table = made()
    found = summarise(table)
    mass = table.codes[:, 0]
    assert found.success.count == int((mass <= 14.0 / 9.81).sum())
    assert found.reasons == {
        "thrust": 400 - found.success.count,
        "speed": 400 - found.success.count,
    }
    assert found.percentiles["thrust"][3] == np.median(9.81 * mass)
    assert "clearance" not in found.percentiles
    assert (found.drivers[0].varied, found.drivers[0].outcome) == ("agents.mass", "thrust")
    assert found.drivers[0].correlation == pytest.approx(1.0)
    radius = next(
        d
        for d in correlations_by_strength(table)
        if (d.varied, d.outcome) == ("agents.radius", "separation")
    )
    ranks = stats.rankdata(table.codes[:, 1]) - stats.rankdata(table.metrics["separation"])
    assert radius.correlation == pytest.approx(1 - 6 * (ranks**2).sum() / (400 * (400**2 - 1)))
    failing = next(d for d in found.drivers if d.outcome == "success")
    assert failing.varied == "agents.mass"
    assert failing.correlation < -0.7
    assert json.loads(found.json())["percentiles"]["thrust"]["50"] == found.percentiles["thrust"][3]


def test_words_have_a_rate_each(tmp_path):
    """What varies by words has no rank: each of its values has its rate."""
    vary = ["constraint.solver = grid(exact, pinv)", "agents.mass = grid(1, 2)"]
    table = fly(sweep(*vary, runs=None), tmp_path, workers=1)
    found = summarise(table)
    assert {k: (r.count, r.of) for k, r in found.by_value["constraint.solver"].items()} == {
        "exact": (1, 2),
        "pinv": (1, 2),
    }
    assert {d.varied for d in found.drivers} == {"agents.mass"}
    assert load(tmp_path)["constraint.solver"].values.tolist() == ["exact", "exact", "pinv", "pinv"]


def shown(table: Table, width: int) -> str:
    """The summary as a terminal of some columns shows it."""
    text = io.StringIO()
    Console(width=width, file=text).print(summarise(table))
    return text.getvalue()


def cells(text: str) -> dict[str, list[str]]:
    """Numbers beside each metric, which stand in two tables where one would be too wide."""
    shown: dict[str, list[str]] = {}
    for line in text.split("failed check", maxsplit=1)[0].splitlines():
        name, *words = line.split() or [""]
        if name in METRICS:
            shown.setdefault(name, []).extend(x for x in words if x[-1] in "0123456789")
    return shown


def everything() -> Table:
    """A table with every metric, numbers of all sizes and signs, and runs that fail for every kind of reason."""
    table, n = made(), 400
    table.detail[:] = [reason and f"{reason}: too much" for reason in table.reason]
    scale = 10.0 ** np.linspace(-9, 7, n)
    for k, name in enumerate(METRICS):
        table.metrics[name] = np.roll(scale, 17 * k) * (-1.0) ** k * 1.2345
    table.reason[3], table.detail[3] = "mission", "agents.mass = -1.0: must be positive"
    table.reason[4], table.detail[4] = "error", "ZeroDivisionError: division by zero"
    return table


@pytest.mark.parametrize("width", [60, 80, 100, 1000])
def test_no_number_is_cut(width):
    """However narrow the screen, all percentiles are shown, each number whole: with two digits, or three."""
    table = everything()
    found, text = summarise(table), shown(table, width)
    assert all(len(line) <= width for line in text.splitlines())
    assert "…" not in text
    assert set(cells(text)) == set(METRICS)
    for name, numbers in cells(text).items():
        percentiles = found.percentiles[name]
        np.testing.assert_allclose([float(x) for x in numbers], percentiles, rtol=0.05)


def test_all_percentiles_fit_eighty_columns():
    """On the usual eighty columns all percentiles are shown, of whatever metrics there are."""
    table = made()
    for name in METRICS:
        table.metrics[name] = np.linspace(1.234e-8, 6.543, 400)
    assert {len(numbers) for numbers in cells(shown(table, 80)).values()} == {7}


def test_reasons_are_explained():
    """Each reason of failure comes with a run that failed by it first, in words, or with its number alone."""
    table = everything()
    found = summarise(table)
    fails = int(np.flatnonzero(table.reason == "thrust, speed")[0])
    assert found.examples == {
        "mission": Example(3, "agents.mass = -1.0: must be positive"),
        "error": Example(4, "ZeroDivisionError: division by zero"),
        "thrust": Example(fails, "thrust, speed: too much"),
        "speed": Example(fails, ""),
    }
    text = shown(table, 1000)
    assert "mission refused" in text
    assert "run 3: agents.mass = -1.0: must be positive" in text
    assert "program error" in text
    assert "--force flies all" in text
    assert "--force" not in shown(made(), 1000)
    assert json.loads(found.json())["examples"]["mission"]["run"] == 3


def test_dataset(flown, tmp_path):
    """One xarray dataset along the runs, with units and meanings."""
    data = load(fly_into(tmp_path))
    assert dict(data.sizes) == {"run": 20}
    assert data["thrust"].values.tolist() == flown.metrics["thrust"].tolist()
    assert data["agents.position.2.3"].attrs["units"] == "m"
    assert data["agents.mass.1"].attrs["units"] == "1"
    assert data["agents.mass.1"].attrs["long_name"].startswith("factor of: mass [kg]")
    assert all(data[name].attrs["units"] == METRICS[name].unit for name in METRICS)
    assert data.attrs["complete"] == 1
    assert Mission.from_toml(data.attrs["mission"]).name == "pair"


def fly_into(folder: Path) -> Path:
    fly(sweep(), folder, workers=1)
    return folder


def test_rank_correlations_are_those_of_scipy():
    """Correlations and their chances are SciPy's, where values are equal or missing, too."""
    noise = np.random.default_rng(1)
    table = made()
    thrust = np.round(table.metrics["thrust"] + noise.normal(0, 5, len(table.run)), 0)
    thrust[::7] = np.nan
    table = replace(table, metrics=table.metrics | {"thrust": thrust})
    found = [d for d in correlations_by_strength(table) if d.outcome == "thrust"]
    there = np.isfinite(thrust)
    assert len(found) == len(table.sweep.columns)
    for d in found:
        k = [column.name for column in table.sweep.columns].index(d.varied)
        known = stats.spearmanr(table.codes[there, k], thrust[there])
        assert d.correlation == pytest.approx(known.statistic, rel=1e-12)
        assert d.chance == pytest.approx(known.pvalue, rel=1e-9)


def test_figures(tmp_path):
    """Every figure is drawn, with the limit, and a unit on every axis."""
    files = plot(made(), tmp_path, formats=["png", "svg"])
    names = {path.name for path in files}
    assert names == {
        f"{name}.{kind}"
        for name in ("outcome", "histograms", "envelopes", "drivers", "map")
        for kind in ("png", "svg")
    }
    text = (tmp_path / "histograms.svg").read_text()
    assert "thrust [N]" in text
    assert "separation [m]" in text
    assert "limit" in text
    assert "agents.mass [kg]" in (tmp_path / "envelopes.svg").read_text()


def test_a_map_shows_rates_where_the_runs_are():
    """Cells of the map hold the success rate of the runs in them, and a metric's median."""
    found = made()
    heavy = map_over_two(found, ["agents.mass", "agents.radius"], "thrust")
    assert heavy is not None
    mesh = heavy.axes[0].collections[0].get_array()
    assert mesh is not None
    columns = np.nanmean(np.asarray(mesh), axis=0)
    edges = np.linspace(found.codes[:, 0].min(), found.codes[:, 0].max(), 11)
    assert columns == pytest.approx(9.81 * (edges[1:] + edges[:-1]) / 2, rel=0.03)
    with pytest.raises(RigidfleetError, match=r"agents\.mas' cannot be drawn"):
        map_over_two(found, ["agents.mas", "agents.radius"])


def test_figures_without_titles(tmp_path):
    """Without titles a sweep's figures name neither themselves nor the sweep, and PDF is one of their formats."""
    files = plot(made(), tmp_path, formats=["svg", "pdf"], titles=False)
    assert {p.suffix for p in files} == {".svg", ".pdf"}
    for path in files:
        if path.suffix == ".pdf":
            assert path.read_bytes().startswith(b"%PDF-")
            continue
        words = path.read_text(encoding="utf-8")
        assert not any(
            title in words for title in ("Outcome", "Metrics of all runs", " runs</text>")
        )


def test_little_is_drawn_as_well(tmp_path):
    """A sweep without failures, of a single run, or stopped early, draws what there is."""
    for table in (made(1), made(3), made(5, runs=50)):
        assert "outcome.png" in {p.name for p in plot(table, tmp_path, formats=["png"])}


# -- the command -------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    console.console.cache_clear()
    Path("pair.toml").write_text(MISSION.text)
    return tmp_path


def test_command(folder, capsys):
    """A line flies a sweep; its folder alone goes on with more runs, and is summed up again."""
    line = ["sweep", "pair.toml", "--vary", SCATTER[1], "--workers", "1"]
    assert cli.main([*line, "--runs", "4"]) == codes.PASSED
    out = capsys.readouterr().out
    assert "4 of 4 runs passed" in out
    assert Path("sweeps/pair/figures/outcome.png").exists()
    assert cli.main([*line[:2], "--vary", SCATTER[0], "--runs", "4"]) == codes.BAD_INPUT
    assert "differs in: variations" in capsys.readouterr().err
    assert (
        cli.main(["sweep", "sweeps/pair", "--runs", "6", "--no-figures", "--json"]) == codes.PASSED
    )
    assert json.loads(capsys.readouterr().out)["success"]["of"] == 6
    before = Path("sweeps/pair/sweep.db").read_bytes()
    again = [
        "sweep",
        "sweeps/pair",
        "--summary",
        "--quiet",
        "--format",
        "svg",
        "--map",
        "agents.mass.1",
        "agents.mass.2",
    ]
    assert cli.main([*again, "--metric", "thrust"]) == codes.PASSED
    assert capsys.readouterr() == ("", "")
    assert Path("sweeps/pair/sweep.db").read_bytes() == before
    assert "Median: thrust" in Path("sweeps/pair/figures/map.svg").read_text()
    for wrong in ["--map", "agents.mass.1", "agents.mass.9"], ["--metric", "weight"]:
        assert cli.main([*line, "--out", "before", "--runs", "4", *wrong]) == codes.BAD_INPUT
        assert f"'{wrong[-1]}' cannot be drawn" in " ".join(capsys.readouterr().err.split())
        assert not Path("before").exists()  # told before a run
    assert cli.main(["sweep", "pair.toml", "--summary"]) == codes.BAD_INPUT
    assert "contains no sweep" in capsys.readouterr().err
    assert cli.main(["sweep", "sweeps/pair", "--seed", "3"]) == codes.BAD_INPUT
    assert cli.main(["sweep", "pair.toml", "--runs", "4"]) == codes.BAD_INPUT
    assert cli.main([*line, "--workers", "0"]) == codes.BAD_INPUT


def test_the_command_flies_shards(folder, capsys):
    """Shards by the line of the sweep or by its folder; merged, they are a sweep like any other."""
    line = ["sweep", "pair.toml", "--vary", SCATTER[1], "--runs", "20", "--seed", "3", "--quiet"]
    whole = fly(sweep(SCATTER[1]), folder / "whole", workers=1)
    assert cli.main([*line, "--shard", "2/2"]) == codes.PASSED
    assert not Path("sweeps/pair/shards/2-of-2/figures").exists()
    wrong = {
        "--shard 0/2": ["sweep", "sweeps/pair", "--shard", "0/2"],
        "with K from 1 to N, such as 3/40": ["sweep", "sweeps/pair", "--shard", "2"],
        "partly flown: 1. Fly each": ["sweep", "sweeps/pair", "--merge"],
        "exclude each other": ["sweep", "sweeps/pair", "--merge", "--shard", "1/2"],
        "Go on by `rigidfleet sweep sweeps/pair --shard 2/2`": [
            "sweep",
            "sweeps/pair/shards/2-of-2",
        ],
    }
    for words, tokens in wrong.items():
        assert cli.main(tokens) == codes.BAD_INPUT
        assert words in capsys.readouterr().err
    with pytest.warns(
        UserWarning, match="nothing to fly; 20 runs, .* up to 3"
    ):  # a job array goes on
        assert cli.main([*line, "--shard", "4/5", "--out", "idle"]) == codes.PASSED
    assert cli.main(["sweep", "sweeps/pair", "--shard", "1/2", "--quiet"]) == codes.PASSED
    assert cli.main(["sweep", "sweeps/pair", "--merge", "--json"]) == codes.PASSED
    assert json.loads(capsys.readouterr().out)["success"]["of"] == 20
    assert numbers(read("sweeps/pair")) == numbers(whole)
    assert Path("sweeps/pair/figures/outcome.png").exists()


@pytest.mark.parametrize("grown", [[1, 2, 4], [1]])
def test_the_repair_that_merging_names_makes_one_sweep(folder, capsys, grown):
    """A shorter sweep lies in the folder, or shorter shards: what merging names is flown, one after the other."""
    line = ["sweep", "pair.toml", "--vary", SCATTER[0], "--seed", "3", "--quiet", "--runs"]
    assert cli.main([*line, "12"]) == codes.PASSED
    for k in (1, 2, 4):
        runs, idle = ("61", False) if k in grown else ("12", k > 2)
        with pytest.warns(UserWarning, match="nothing to fly") if idle else nullcontext():
            assert cli.main([*line, runs, "--shard", f"{k}/4"]) == codes.PASSED
    repairs = []
    while cli.main(["sweep", "sweeps/pair", "--merge", "--quiet"]):
        named = re.search("`rigidfleet ([^`]*)`", capsys.readouterr().err)
        assert named is not None
        repairs.append(named[1])
        assert cli.main([*named[1].split(), "--quiet"]) == codes.PASSED
    missing = [k for k in range(1, 5) if k not in grown]
    assert repairs == [f"sweep sweeps/pair --shard {k}/4 --runs 61" for k in missing]
    whole = fly(sweep(SCATTER[0], runs=61), folder / "whole", workers=1)
    assert numbers(read("sweeps/pair")) == numbers(whole)
    assert cli.main(["sweep", "sweeps/pair", "--shard", "2/4", "--quiet"]) == codes.PASSED
    assert read("sweeps/pair/shards/2-of-4").sweep.runs == 61


def test_progress_words():
    """Progress says the runs flown, their rate without starts, the time left and the failures."""
    watch = console.SweepWatch()
    assert watch._progress_text() == ""
    watch.update(SweepProgress(0, 5000, 0, 0, 0.0, 1))
    watch.update(SweepProgress(8, 5000, 8, 0, 20.0, 1))
    assert watch._progress_text() == "8 of 5000 runs"
    watch.update(SweepProgress(508, 5000, 508, 0, 30.0, 1))
    assert watch._progress_text() == "508 of 5000 runs  50 runs/s  1:30 left"
    watch.update(SweepProgress(1000, 5000, 1000, 0, 40.0, 2))
    watch.update(SweepProgress(2000, 5000, 2000, 30, 50.0, 2))
    assert (
        watch._progress_text() == "2000 of 5000 runs  100 runs/s  0:30 left  30 failed  2 workers"
    )


def test_interrupted(folder):
    """Ctrl-C ends with 130, keeps what is flown, and says how to go on."""
    asked = ["sweep", "pair.toml", "--runs", 5000, "--workers", 1, "--vary", SCATTER[0]]
    process = subprocess.Popen(command(*asked), stderr=subprocess.PIPE, text=True)
    until(lambda: count(folder / "sweeps" / "pair") > 0, process)  # ty: ignore[invalid-argument-type]
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == codes.INTERRUPTED
    kept = len(read(folder / "sweeps" / "pair").run)
    assert f"{kept} of 5000 runs are saved" in err
    assert "rigidfleet sweep sweeps/pair" in err


def test_a_shard_that_is_interrupted_counts_its_own_runs(folder, capsys, monkeypatch):
    """Of 20 runs in groups of eight, the first of two shards has the first and the last group: 12 runs."""

    def stop(progress):
        if progress.done:
            raise KeyboardInterrupt

    def fly_a_group(*args, progress, **keys):
        return fly(*args, progress=stop, **keys)

    monkeypatch.setattr("rigidfleet.sweep.fly", fly_a_group)
    line = ["sweep", "pair.toml", "--vary", SCATTER[0], "--runs", "20", "--workers", "1"]
    assert cli.main([*line, "--shard", "1/2"]) == codes.INTERRUPTED
    err = capsys.readouterr().err
    assert "Interrupted: 8 of 12 runs are saved in sweeps/pair/shards/1-of-2" in err
    assert "To resume: rigidfleet sweep sweeps/pair --shard 1/2" in err


def test_the_example_flies(folder, capsys):
    """The sweep file among the examples flies; only unstable gains are refused."""
    assert (
        cli.main(["sweep", str(EXAMPLE), "--runs", "12", "--workers", "1", "--no-figures"])
        == codes.PASSED
    )
    table = read("sweeps/gain_study")
    alpha, gamma = table.codes[:, 0], table.codes[:, 1]
    unstable = gamma >= 2 * alpha * table.sweep.mission.constraint.beta**2
    assert 0 < unstable.sum() < 12
    assert (table.reason == "mission").tolist() == unstable.tolist()


# -- paths and files of all kinds --------------------------------------------------------------------


BARE = "narrow-passage"  # without [disturbances]


def first(*vary: str, mission: Any = BARE) -> Any:
    """The mission of the first run."""
    return Sweep.of(mission, vary, runs=1).mission_of(0)


def complaint(line: str, mission: Any = BARE) -> tuple[str, str]:
    """The only finding of a variation: problem and remedy."""
    with pytest.raises(SweepError) as caught:
        Sweep.of(mission, [line], runs=2)
    (finding,) = caught.value.findings
    return finding.problem, finding.remedy


@pytest.mark.parametrize(
    "path",
    [
        "agents.mass.1.1.1", "agents.mass.1.1.1.1.1", "agents.position.1.1.1.*", "1.1.1.1", "agents.*.1.*.1",
        "agents..mass", ".agents", "agents.", "agents[].mass", "agents[[1]]", "agents.mass.0", "agents.mass.-1",
        "agents.mass." + "9" * 5000, "agents.mass.²", "constraint.solver.1.1", "phases.1.kind.x.1", "obstacles.1.1.1",
        "agents.vehicle.*", '"', "[", "", "agents.mass.1 .1", "formations.triangle.size.1.2.3", "__class__.x.1.1.1",
    ],
)  # fmt: skip
def test_a_wrong_path_is_one_clear_error(path):
    """However deep, empty, large or odd a path is, it is refused with a problem and a remedy, not by an exception."""
    problem, remedy = complaint(f"{path} = normal(1, 0.1)")
    assert problem
    assert remedy


@pytest.mark.parametrize(
    ("path", "meant"),
    [
        ("gusts.seed", "disturbances.gusts.seed"),
        ("mass_error.*", "disturbances.mass_error.*"),
        ("agents.mass_error.2", "disturbances.mass_error.2"),
        ("agents.3.mass", "agents.mass.3"),
        ("agents.mas.*", "agents.mass.*"),
        ("mass.1", "agents.mass.1"),
        ("agents.mass.1.1.1", "agents.mass.1"),
        ("phases.2.untl", "phases.2.until"),
        ("formations.trangle.size", "formations.triangle.size"),
    ],
)
def test_following_a_remedy_about_a_path_works(path, meant):
    """The path that a message suggests exists, and varies what was meant."""
    _, remedy = complaint(f"{path} *= uniform(1, 2)", "windy-passage")
    if remedy != "the path ends there; remove the rest":
        assert remedy == f"did you mean '{meant}'?"
    assert Sweep.of("windy-passage", [f"{meant} *= uniform(1, 2)"], runs=2).columns


def test_a_key_of_a_table_that_is_missing_is_completed_step_by_step():
    """The key that a message asks for, written with the mission or varied, is all that is missing."""
    line = "disturbances.gusts.intensity = uniform(0.1, 0.2)"
    problem, remedy = complaint(line)
    assert "disturbances.gusts.model is missing" in problem
    assert remedy.startswith("in the mission, add model: first-order")
    rest = [
        "disturbances.gusts.model = grid(first-order)",
        "disturbances.gusts.time_scale = grid(2)",
    ]
    gusts = first(line, *rest).disturbances.gusts
    assert (gusts.model, gusts.time_scale) == ("first-order", 2.0)
    assert 0.1 < gusts.intensity < 0.2
    problem, remedy = complaint("constraint.solver = uniform(0, 1)")
    example = remedy.split("as ")[1]
    assert first(f"constraint.solver = {example}").constraint.solver == "iterated"


def test_one_number_for_all_agents_is_varied_for_each():
    """`disturbances.mass_error.*` and `drag.*` draw for each vehicle, whether the mission has one number or none."""
    errors = first("disturbances.mass_error.* = normal(0, 0.05)").disturbances.mass_error
    assert len(set(errors)) == 3
    windy = first("disturbances.drag.2 *= grid(2)", mission="windy-passage")
    assert windy.disturbances.drag == (0.3, 0.6, 0.3)
    assert "there is no" in complaint("disturbances.*.seed = grid(1)")[0]


@pytest.mark.parametrize(
    "values",
    ["NaN", "Infinity", "1, 1e999", "null", "9" * 400, "9" * 5000, '{"a": null}', "1, [2, NaN]"],
)
def test_values_that_are_none(values):
    """Numbers that are not finite, and values that TOML does not have, are refused."""
    assert complaint(f"agents.mass = grid({values})")[0].startswith("must be finite numbers, words")


@pytest.mark.parametrize(
    "text",
    [
        "vary = 3", "vary = [3]", "vary = [[]]", "vary = [{}]", "vary = ['']", "vary = [{path = 3, kind = 'grid'}]",
        "vary = [{path = 'agents.mass', kind = 'grid', values = [2020-01-01]}]", "vary = [{kind = ['grid']}]",
        "vary = [{path = 'agents.mass', kind = 'grid', values = {a = 1}}]", "runs = 1.5", "runs = 0", "runs = 'x'",
        "runs = 100000000000", "seed = 1.5", "seed = []", "seed = -1", "evaluate = 3", "random_numbers = true",
        "random_numbers = 'common'", "controller = 3", "controller = ''\nrate = 1", "rate = 50", "controller = ':'",
        "controller = 'json'", "controller = 'json:'", "controller = 'json:x.y'", "controller = '.x:y'",
        "controller = 'nowhere:law'", "controller = 'os:sep'", "controller = 'fractions:Fraction.x'",
        "controller = 'shutil:copy'\nrate = -1", "controller = 'shutil:copy'\nrate = inf", "wrong = 1",
        "vary = ['agents.mass = linspace(1, 2, 1000000)', 'agents.radius = linspace(1, 2, 1000)']",
    ],
)  # fmt: skip
def test_a_wrong_sweep_file_is_one_error(folder, capsys, text):
    """Whatever stands in a sweep file, the command says what is wrong and exits with 2, and never flies."""
    vary = "" if "vary" in text else "\nvary = ['agents.mass = grid(1, 2)']"
    Path("study.toml").write_text(f"mission = 'pair.toml'\n{text}{vary}\n")
    assert cli.main(["sweep", "study.toml", "--quiet", "--no-figures"]) == codes.BAD_INPUT
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert "bug" not in err
    assert not Path("sweeps").exists()


# -- random numbers, and what they drive -----------------------------------------------------------------

NOISY = PAIR | {
    "disturbances": {
        "noise": {"position": 0.01, "seed": 4},
        "gusts": {"model": "first-order", "intensity": 0.1, "time_scale": 1.0},
    }
}


def test_runs_share_random_numbers_or_have_their_own(tmp_path):
    """Shared: the mission's seeds in all runs; own: another in each, whatever else varies, unless a seed is varied."""
    mission = Mission.from_dict(NOISY)

    def seeds(*vary: str, **keys: Any) -> list[tuple[int, int]]:
        found = Sweep.of(mission, ["agents.mass *= grid(1, 1, 1, 1)", *vary], seed=5, **keys)
        tables = [found.document_of_run(k)["disturbances"] for k in range(4)]
        assert found.mission.disturbances is not None
        assert Sweep.from_json(found.json()).identity == found.identity
        return [(t["noise"]["seed"], t["gusts"].get("seed", 0)) for t in tables]

    assert seeds() == [(4, 0)] * 4
    own = seeds(random_numbers="own")
    assert len(set(own)) == 4
    assert all(a == b for a, b in own)
    more = seeds("agents.radius.* = uniform(0.1, 0.2)", random_numbers="own")
    assert more == own
    varied = seeds("disturbances.noise.seed = grid(9)", random_numbers="own")
    assert varied == [(9, b) for _, b in own]
    assert "random_numbers" not in json.loads(Sweep.of(mission, SCATTER, runs=2).json())
    calm = Sweep.of(MISSION, SCATTER, runs=2, random_numbers="own")
    assert "disturbances" not in calm.document_of_run(0)
    for keys, word in (({}, "shared"), ({"random_numbers": "own"}, "own")):
        table = fly(Sweep.of(mission, ["agents.mass *= grid(1, 1)"], **keys), tmp_path / word)
        assert summarise(table).random_numbers == word
        same = table.metrics["tracking_error"][0] == table.metrics["tracking_error"][1]
        assert same == (word == "shared")
        assert {"shared": "the same in all runs", "own": "of each run its own"}[word] in shown(
            table, 200
        )
    assert summarise(made()).random_numbers == "none"


def test_a_seed_is_neither_an_axis_nor_a_driver(tmp_path):
    """Seeds are numbers without an order: no map has one on an axis, and nothing is driven by one."""
    found = Sweep.of(
        Mission.from_dict(NOISY),
        [
            "disturbances.noise.seed = grid(1, 2, 3, 4)",
            "disturbances.*.seed += uniform(0, 9)",
            SCATTER[1],
        ],
        runs=8,
    )
    table = fly(found, tmp_path)
    assert {d.varied for d in correlations_by_strength(table)} == {"agents.mass.1", "agents.mass.2"}
    assert summarise(table).random_numbers == "varied"
    with pytest.raises(RigidfleetError, match="a seed has no order"):
        map_over_two(table, ["disturbances.noise.seed", "agents.mass.1"])


def test_drivers_are_corrected_for_their_number():
    """Adjusted p-values are SciPy's; of pure chance, nothing is shown, though some pairs have p < 0.01."""
    noise = np.random.default_rng(2)
    table = made(60)
    metrics = {name: noise.normal(size=60) for name in METRICS}
    table = replace(
        table, metrics=metrics, codes=noise.normal(size=(60, 2)), passed=noise.random(60) < 0.5
    )
    found = correlations_by_strength(table)
    chances = [d.chance for d in found]
    np.testing.assert_allclose(
        [d.adjusted for d in found], stats.false_discovery_control(chances), rtol=1e-12
    )
    assert min(chances) < 0.05
    text = shown(table, 200)
    assert "rank correlation" not in text
    assert f"0 of {len(found)} pairs" in text
    assert json.loads(summarise(table).json())["pairs_tested"] == len(found)
    few = correlations_by_strength(made(4))
    assert abs(few[0].correlation) == 1.0
    assert few[0].chance == pytest.approx(
        2 / 24
    )  # of the 24 orders of four runs, two correlate as much


# -- a controller of the user ----------------------------------------------------------------------------

LAW = """
class Own:
    def __init__(self):
        self.last = -1.0
    def __call__(self, seen):
        assert seen.t > self.last
        self.last = seen.t
        return follow(seen)

def follow(seen):
    a = seen.reference_acceleration - 2.0 * (seen.position - seen.reference_position)
    a = a - 2.8 * (seen.velocity - seen.reference_velocity)
    a[:, 2] += seen.gravity
    return seen.masses[:, None] * a

def fails(seen):
    raise ValueError("no law")
"""


def test_a_sweep_flies_a_controller_by_name(folder, capsys, monkeypatch):
    """Rows are those of `simulate` with the controller, by one process and by workers; each run has a new object."""
    from rigidfleet.simulation.flight import simulate

    monkeypatch.setattr("rigidfleet.sweep.runner.WORTH", 0.0)
    Path("a_law.py").write_text(LAW)
    line = ["sweep", "pair.toml", "--vary", SCATTER[1], "--runs", "9", "--no-figures", "--quiet"]
    own = [*line, "--controller", "a_law:Own", "--rate", "100"]
    for count in ("1", "2"):
        assert cli.main([*own, "--workers", count, "--out", count]) == codes.PASSED
    table = read("1")
    assert numbers(read("2")) == numbers(table)
    assert (table.sweep.header.controller, table.sweep.header.rate) == ("a_law:Own", 100.0)
    law: Any = sys.modules["a_law"]
    for k in (0, 8):
        flown = simulate(table.sweep.mission_of(k), controller=law.follow, rate=100.0)
        assert measure_metrics(flown, assess(flown))["thrust"] == table.metrics["thrust"][k]
    assert cli.main([*line, "--out", "1"]) == codes.BAD_INPUT
    assert "differs in: file of the controller, controller, rate" in capsys.readouterr().err


@pytest.mark.long
def test_a_sweep_goes_on_only_with_the_same_controller(folder):
    """The command continues a sweep with the file that it began with, and refuses a changed or missing one."""
    Path("b_law.py").write_text(LAW)
    line = [
        "sweep",
        "pair.toml",
        "--vary",
        SCATTER[1],
        "--controller",
        "b_law:follow",
        "--out",
        "s",
    ]

    def again(*words: str) -> tuple[int, str]:
        done = subprocess.run(
            command(*words, "--no-figures", "--quiet"), check=False, capture_output=True, text=True
        )
        return done.returncode, done.stderr

    assert again(*line, "--runs", "2") == (codes.PASSED, "")
    assert again("sweep", "s", "--runs", "3") == (codes.PASSED, "")
    Path("b_law.py").write_text(LAW + "# changed")
    code, err = again("sweep", "s", "--runs", "4")
    assert (code, "differs in: file of the controller" in err) == (codes.BAD_INPUT, True)
    Path("b_law.py").unlink()
    code, err = again("sweep", "s", "--runs", "4")
    assert (code, "No module named 'b_law'" in err) == (codes.BAD_INPUT, True)
    assert again("sweep", "s", "--summary")[0] == codes.PASSED  # imports nothing


def test_a_worker_with_another_controller_is_refused(folder):
    """A worker compares the file of the controller, not its name alone."""
    from rigidfleet.sweep.workers import fly_chunk

    Path("c_law.py").write_text(LAW)
    found = Sweep.of(MISSION, SCATTER, runs=2, controller="c_law:follow")
    with pytest.raises(RigidfleetError, match=r"it has rigidfleet .* with c_law:follow"):
        fly_chunk(found.json(), found.version.replace("c_law:follow ", "c_law:follow x"), [0])


# -- no verdict, no room, no time ------------------------------------------------------------------------


def test_a_sweep_without_a_single_verdict_exits_with_2(folder, capsys):
    """All missions refused, or a controller that always fails: an error with an example; one verdict is enough."""
    Path("d_law.py").write_text(LAW)
    line = ["sweep", "pair.toml", "--no-figures", "--quiet", "--force", "--vary"]
    assert cli.main([*line, "agents.mass = grid(-1, -2)"]) == codes.BAD_INPUT
    err = capsys.readouterr().err
    assert "no run has a verdict" in err
    assert "mission refused: agents.mass" in err
    assert (
        cli.main(["sweep", "sweeps/pair", "--summary", "--no-figures", "--quiet"])
        == codes.BAD_INPUT
    )
    fails = ["agents.mass = grid(1, 2)", "--controller", "d_law:fails"]
    assert cli.main([*line, *fails]) == codes.BAD_INPUT
    assert "the controller raised ValueError" in capsys.readouterr().err
    assert cli.main([*line, "agents.mass = grid(-1, 2)"]) == codes.PASSED  # flown, and failed


def test_a_full_disk_is_named_and_the_sweep_goes_on(flown, tmp_path, monkeypatch):
    """Where SQLite finds the disk full in mid-sweep, one error says so; with room, the sweep ends as ever."""
    from rigidfleet.sweep.store import Store

    opened = Store._open_database

    def small(self: Store, asked: Sweep) -> None:
        opened(self, asked)
        pages = self.db.execute("PRAGMA page_count").fetchone()[0]
        self.db.execute(f"PRAGMA max_page_count = {pages}")

    with monkeypatch.context() as full:
        full.setattr(Store, "_open_database", small)
        with pytest.raises(ResultError, match=r"the disk is full\. Make room"):
            fly(sweep(), tmp_path, workers=1)
    assert numbers(fly(sweep(), tmp_path, workers=1)) == numbers(flown)


@pytest.mark.parametrize("shard", [[], ["--shard", "2/2"]])
def test_a_sweep_that_was_stopped_before_its_first_run_goes_on_by_its_definition(
    folder, capsys, monkeypatch, shard
):
    """Where the disk is full at the start, the folder has a lock and perhaps an empty file: it says how to go on."""
    from rigidfleet.sweep.store import Store

    def full(self: Store, asked: Sweep) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    line = ["sweep", "pair.toml", "--vary", SCATTER[1], "--runs", "20", "--quiet", *shard]
    with monkeypatch.context() as no_room:
        no_room.setattr(Store, "_open_database", full)
        assert cli.main(line) == codes.BAD_INPUT
    assert "the disk is full" in capsys.readouterr().err
    again = ["sweep", "sweeps/pair", *shard]
    for file in Path("sweeps").rglob("sweep.db"):
        assert not file.stat().st_size
        assert cli.main(again) == codes.BAD_INPUT
        assert "Go on by the command that defines it" in capsys.readouterr().err
        file.unlink()
    assert cli.main(again) == codes.BAD_INPUT
    err = capsys.readouterr().err
    assert "sweeps/pair: the sweep in it was stopped before its first run. Go on by" in err
    assert cli.main(line) == codes.PASSED


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is sent as a signal")
@pytest.mark.parametrize("verb", ["run", "sweep", "check", "missions"])
def test_ctrl_c_while_loading_is_quiet(tmp_path, verb):
    """While the command's modules are loaded, Ctrl-C ends it with 130 and without a word, wherever it comes."""
    script = """
import builtins, os, signal, sys
plain, left = builtins.__import__, int(sys.argv.pop(1))
def slow(name, *rest, **more):
    global left
    if name.startswith(("rigidfleet.cli", "cyclopts", "rich", "rigidfleet.mission")):
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGINT)
    return plain(name, *rest, **more)
builtins.__import__ = slow
from rigidfleet.__main__ import main
sys.exit(main())
"""
    for moment in (1, 2, 8, 60):
        words = [sys.executable, "-c", script, str(moment), verb, "single-waypoint"]
        done = subprocess.run(words, check=False, capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == codes.INTERRUPTED, done.stderr
        assert "Traceback" not in done.stderr
        assert "bug" not in done.stderr


@pytest.mark.long
def test_errors_of_mass_that_the_laws_know_and_do_not(tmp_path):
    """The numbers of the manual: of 200 narrow passages, all pass with known masses, 27 and 1 % with unknown ones."""
    lines = {
        "agents.mass.* *= normal(1, 0.05)": 200,
        "disturbances.mass_error = normal(0, 0.05)": 54,
        "disturbances.mass_error.* = normal(0, 0.05)": 2,
    }
    for k, (line, passed) in enumerate(lines.items()):
        table = fly(Sweep.of(BARE, [line], runs=200), tmp_path / str(k))
        assert int(table.passed.sum()) == passed
