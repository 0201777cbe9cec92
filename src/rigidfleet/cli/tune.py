"""Choose the gains of a mission by flying it: `tune`."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, Literal

from rigidfleet.cli import console
from rigidfleet.cli.arguments import MissionName, Whole, Workers
from rigidfleet.cli.codes import INTERRUPTED, PASSED
from rigidfleet.cli.run import show_progress
from rigidfleet.errors import RigidfleetError


def tune(
    mission: MissionName,
    /,
    *,
    objective: Literal["shape", "shape-rms", "shape-forces", "tracking", "tracking-rms"] = "shape",
    budget: Whole = 300,
    seeds: Whole = 3,
    validation: Whole = 8,
    seed: Whole = 0,
    margin_share: float = 1.0,
    assume: list[str] | None = None,
    workers: Workers = None,
    out: Path | None = None,
    force: bool = False,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Choose the gains of the constraint law and the tracking by flying a mission many times.

    Gains whose margins are smaller than the mission's own are not flown. If the study is stopped, the same command
    resumes it; with a larger --budget, it goes on.

    Parameters
    ----------
    mission : str
        A shipped mission or a mission file, with its vehicles, delays and noise.
    objective : str
        What is minimised: shape, the largest shape error while slots are tracked; shape-forces, that where constraint
        forces alone act; tracking, the largest distance from a slot; shape-rms or tracking-rms, root mean squares.
    budget : int
        Maximum number of flights of the search. Default: 300.
    seeds : int
        Number of seeds of noise and gusts on which each choice of gains is flown. Default: 3.
    validation : int
        Number of further seeds on which the best gains are compared with the mission's own. Default: 8.
    seed : int
        First seed, and seed of the search. Default: 0.
    margin_share : float
        Share of the mission's own margins that has to remain: 1, the default, for no smaller ones; 0 for stability.
    assume : str
        Keys of the mission that are replaced for the study, as a line of TOML; may be repeated:
        --assume "disturbances.noise = {position = 0.01, delay = 0.02}".
    workers : int
        Number of processes. Default: number of cores.
    out : Path
        Folder for study.json, the tuned mission and all flights. Default: tunes/NAME.
    force : bool
        Overwrite another study in this folder. Without it, the command stops before any flight.
    json : bool
        Print the result as JSON.
    quiet : bool
        Print only errors, and JSON with --json.
    """
    from rigidfleet.mission import load_mission
    from rigidfleet.tuning import tune as study

    loaded = load_mission(mission)
    folder = out or Path("tunes", loaded.name)
    try:
        with show_progress(None if quiet else console.SweepWatch()) as progress:
            tuned = study(
                loaded, folder, objective=objective, budget=budget, seeds=seeds, validation=validation,
                seed=seed, margin_share=margin_share, assume=_parse_key_lines(assume or []),
                workers=workers, replace=force, progress=progress,
            )  # fmt: skip
    except KeyboardInterrupt:
        words = f"Interrupted: finished flights are saved in {folder}"
        console.err().print(f"{words}\nTo resume: the same command", style="yellow", soft_wrap=True)
        return INTERRUPTED
    if json:
        console.print_json(tuned.to_dict()["result"])
    elif not quiet:
        console.out().print(tuned.facts())
        console.out().print(f"\nMission  {tuned.file}", soft_wrap=True)
        console.out().print(f"Study    {folder / 'study.json'}", soft_wrap=True)
    return PASSED


def _parse_key_lines(lines: list[str]) -> dict[str, Any]:
    """Keys of a mission, given as lines of TOML."""
    try:
        return tomllib.loads("\n".join(lines))
    except tomllib.TOMLDecodeError as error:
        raise RigidfleetError(
            f"--assume {'; '.join(lines)}: is not TOML ({error}). Write PATH = VALUE, as in"
            ' --assume "disturbances.noise.delay = 0.02".'
        ) from None
