"""Fly a mission many times with variations: `sweep`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from rigidfleet._common.reading import READING, Gaps, Interpolation
from rigidfleet.cli import console
from rigidfleet.cli.arguments import MissionName, Workers, to_whole_number
from rigidfleet.cli.codes import BAD_INPUT, INTERRUPTED, PASSED
from rigidfleet.cli.run import DRAWN, Format, show_progress
from rigidfleet.errors import RigidfleetError

if TYPE_CHECKING:
    from rigidfleet.mission import Mission
    from rigidfleet.sweep import Sweep


def sweep(
    mission: MissionName,
    /,
    *,
    vary: list[str] | None = None,
    drill: bool = False,
    separation: float | None = None,
    radius: float | None = None,
    interpolation: Interpolation | None = None,
    gaps: Gaps | None = None,
    units: str | None = None,
    axes: str | None = None,
    topic: list[str] | None = None,
    runs: Annotated[int | None, Parameter(converter=to_whole_number)] = None,
    seed: Annotated[int | None, Parameter(converter=to_whole_number)] = None,
    out: Path | None = None,
    force: bool = False,
    final_states: bool = False,
    random_numbers: Literal["shared", "own"] | None = None,
    controller: str | None = None,
    rate: float | None = None,
    agent: str | None = None,
    workers: Workers = None,
    cluster: str | None = None,
    shard: str = "",
    merge: bool = False,
    summary: bool = False,
    map_: Annotated[tuple[str, str] | None, Parameter(name="--map")] = None,
    metric: str = "",
    no_figures: bool = False,
    format: list[Format] | None = None,
    no_titles: bool = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Fly a mission many times with variations: find the success rate and the causes of failure.

    If the sweep is stopped, even by kill -9, the same command resumes it.

    Parameters
    ----------
    mission : str
        A mission, a sweep file, or the folder of a sweep to resume, to merge or to summarise. With --drill also
        trajectories that another program made.
    vary : str
        A variation "PATH = KIND(NUMBERS)"; += adds to the value in the mission, *= scales it; may be
        repeated. KIND is normal, uniform, log-uniform, choice, grid, linspace or geomspace.
    drill : bool
        Rehearse the faults of the day instead: late starts, wrong files, a show that is set up askew, wind, losses.
        [drill] in a sweep file has their magnitudes.
    separation : float
        Least distance [m] between two vehicles of others' trajectories, less their radii.
    radius : float
        Radius [m] of their vehicles. Default: 0, distances are centre to centre.
    interpolation : str
        Between their samples: cubic or linear. Default: cubic.
    gaps : str
        Times without samples, longer than ten usual steps of a vehicle: refuse, or bridge (by the curve). Default:
        refuse.
    units : str
        Units of a table's columns that do not name theirs: of time, length and angle, such as ms,mm,deg. Default:
        s,m,rad.
    axes : str
        Where x, y and z of a table point: enu, ned, or three others of e, n, u, w, s and d. Default: enu.
    topic : list
        Topic or message of a log that has positions; may be repeated. Default: chosen.
    runs : int
        Number of runs; more can be added later. Default: one per point of the grid.
    seed : int
        Seed of the random numbers. Default: 0.
    out : Path
        Folder for sweep.db, summary.json and figures/. Default: sweeps/NAME.
    force : bool
        Overwrite another sweep in this folder. Without it, the command stops before any flight.
    final_states : bool
        Evaluate only the final states of phases: thousands of runs per second, for open-loop missions with varied
        start states.
    random_numbers : str
        Of noise, gusts and links: shared: every run has the seeds of the mission; own: each run has a seed of its own.
        Default: shared.
    controller : str
        Controller of your own, MODULE:NAME: a function of an observation, or a class, of which each run has a new
        object.
    rate : float
        Calls of the controller per second [Hz]. Default: 50.
    agent : str
        Law of each vehicle's own, MODULE:NAME, for missions with [network].
    workers : int
        Number of processes on this machine. Default: number of cores.
    cluster : str
        Address of a Dask scheduler, whose workers fly the runs.
    shard : str
        K/N: fly only part K, from 1, of N, into a store of its own below the folder. For job arrays.
    merge : bool
        Fly nothing; make one sweep of all shards in a folder.
    summary : bool
        Fly nothing; summarise and draw the sweep in a folder again.
    map_ : str
        The two paths on the axes of the map.
    metric : str
        Quantity that the map shows: success or a metric.
    no_figures : bool
        Draw no figures.
    format : list
        Format of the figures; may be repeated: --format pdf --format png. Default: png.
    no_titles : bool
        Draw figures without titles, for papers with captions.
    json : bool
        Print the summary as JSON.
    quiet : bool
        Print only errors, and JSON with --json.
    """
    if merge + summary + bool(shard) > 1:
        raise RigidfleetError("--shard, --merge and --summary exclude each other: use one of them.")
    if out is not None and (merge or summary):
        words = "Give the folder of the sweep in place of the mission, and no --out"
        raise RigidfleetError(f"--merge and --summary read a sweep where it is. {words}.")
    from rigidfleet._common.files import write_file
    from rigidfleet.sweep import figures, fly, shards, store
    from rigidfleet.sweep.record import UNJUDGED, reason_in_words
    from rigidfleet.sweep.summary import summarise

    folder = Path(mission)
    if summary or merge:
        table = store.read(folder) if summary else shards.merge(folder, replace=force)
    else:
        keys = {
            "seed": seed, "evaluate": "final" if final_states else None, "random_numbers": random_numbers,
            "controller": controller, "rate": rate, "agent": agent, "drill": {} if drill else None,
        }  # fmt: skip
        others: dict[str, Any] = {
            "separation": separation, "radius": radius, "interpolation": interpolation, "gaps": gaps, "units": units,
            "axes": axes, "topic": topic,
        }  # fmt: skip
        others = {key: value for key, value in others.items() if value is not None}
        definition, whole = _sweep_and_folder(mission, vary or [], runs, out, shard, keys, others)
        folder = shards.shard_folder(whole, shard)
        if (map_ or metric) and definition.drill:
            raise RigidfleetError("--map and --metric: a drill has no map. Remove them.")
        numbers = [column.name for column in definition.columns if column.has_order]
        figures.check_map(numbers, map_ or (), metric or "success")
        try:
            with show_progress(None if quiet else console.SweepWatch()) as progress:
                table = fly(
                    definition, whole, workers=workers, cluster=cluster, shard=shard, replace=force, progress=progress,
                )  # fmt: skip
        except KeyboardInterrupt:
            done = len(store.read(folder).run) if store.is_store(folder) else 0
            runs = shards.runs_of_shard(shard, definition.runs).sum()
            words = f"Interrupted: {done} of {runs} runs are saved in {folder}"
            again = f"To resume: rigidfleet sweep {whole}{shard and f' --shard {shard}'}"
            console.err().print(f"{words}\n{again}", style="yellow", soft_wrap=True)
            return INTERRUPTED
    outcome = summarise(table)
    write_file(folder / "summary.json", (outcome.json() + "\n").encode())
    if json:
        console.print_exactly(outcome.json() + "\n")
    elif not quiet:
        console.out().print(outcome.facts())
    drawn = [] if no_figures or shard else figures.plot(
        table, folder / "figures", formats=format or DRAWN, over=map_ or (), metric=metric,
        titles=not no_titles,
    )  # fmt: skip
    if not (json or quiet):
        console.out().print(f"\nRuns     {folder / store.FILE}", soft_wrap=True)
        console.out().print(f"Summary  {folder / 'summary.json'}", soft_wrap=True)
        if drawn:
            text = f"Figures  {drawn[0].parent}{os.sep} ({console.count_text(len(drawn), 'file')})"
            console.out().print(text, soft_wrap=True)
    if outcome.reasons and set(table.reason) <= {*UNJUDGED}:
        reason, example = next(iter(outcome.examples.items()))
        console.print_error(
            f"{folder}: no run has a verdict. Run {example.run}: {reason_in_words(reason)}: {example.detail}\n"
            "    correct the mission, what varies, or the controller; --force overwrites this sweep"
        )
        return BAD_INPUT
    return PASSED


def _sweep_and_folder(
    what: str, vary: list[str], runs: int | None, out: Path | None, shard: str, keys: dict[str, Any],
    of_others: dict[str, Any],
) -> tuple[Sweep, Path]:  # fmt: skip
    """Sweep of the command line, and its folder; ``of_others``: limits and reading of others' trajectories."""
    from rigidfleet.mission import mission_names
    from rigidfleet.sweep import Sweep, faults, shards, store
    from rigidfleet.sweep.definition import is_sweep_file

    here = Path(what)
    stored = [*shards.readable_sweeps(here)] if shard else []
    if not stored and store.is_store(here):
        stored = [store.read_definition(here)]
    if stored:
        if vary or out is not None or of_others or any(x is not None for x in keys.values()):
            raise RigidfleetError(
                f"{what}: is the folder of a sweep, whose definition cannot change. Remove all options that define one:"
                " only --runs may grow."
            )
        definition = max(stored, key=lambda sweep: sweep.runs)
        definition.runs = definition.runs if runs is None else runs
        return definition, here
    named = what in mission_names()
    if not named and (shards.shard_folder(here, shard) / store.LOCK).exists():
        words = (
            "the sweep in it was stopped before its first run. Go on by the command that defines it"
        )
        raise RigidfleetError(f"{what}: {words}, by its mission and --vary.")
    others = keys["drill"] is not None and not named and here.suffix != ".toml" and here.exists()
    if of_others and not others and (named or here.exists()):
        raise RigidfleetError(
            f"--{next(iter(of_others))}: is of others' trajectories, by --drill; a mission has its own. Remove it."
        )
    if others:
        mission = _mission_of_trajectories(here, **of_others)
        read = {key: x for key, x in of_others.items() if key in READING}
        keys["drill"] = {"files": [str(here.resolve())], **read}
        definition = Sweep.of(mission, vary, runs=runs, origin="rigidfleet sweep", **keys)
    elif not named and is_sweep_file(what):
        definition = Sweep.load(what, more=vary, runs=runs, **keys)
        drill = definition.drill
        if drill and (drill.files or drill.stale):  # read once: processes that fly are forks
            for note in faults.show_of(definition.mission.text, drill).notes:
                console.warn(note)
    else:
        definition = Sweep.of(what, vary, runs=runs, origin="rigidfleet sweep", **keys)
    return definition, out or Path("sweeps", definition.name)


def _mission_of_trajectories(
    path: Path, separation: float | None = None, radius: float = 0.0, **how: Any
) -> Mission:
    """What others' trajectories are judged by, which are read as ``how`` says.

    Raises
    ------
    RigidfleetError
        They cannot be read, or nothing is asked of them.
    """
    from rigidfleet.cli.assess import flight_name
    from rigidfleet.foreign.files import read_trajectories
    from rigidfleet.simulation.trajectories import result_of_trajectories

    if path.suffix == ".nc":
        raise RigidfleetError(f"{path}: is the result of a flight. Drill its mission instead.")
    if separation is None:
        words = "is no mission, and has no limits. Give --separation, the least distance [m]."
        raise RigidfleetError(f"{path}: {words}")
    read = read_trajectories(path, spans="stand", **how)
    for note in read.notes:
        console.warn(f"{path}: {note}.")
    own = {"separation": separation, "radius": radius, "name": flight_name(path)}
    return result_of_trajectories(read, **own).mission
