"""Tune a mission: an optimiser proposes gains, sweeps over seeds fly them, and other seeds judge the best.

The optimiser is SciPy's differential evolution (Storn and Price 1997, doi:10.1023/A:1008202821328). It compares costs
and uses nothing else of them, so failed flights can count as worse than all others. It handles margins as constraints:
gains that violate one are refused before they fly (Lampinen 2002, doi:10.1109/CEC.2002.1004459).

The optimiser starts from a seed, and every generation is a sweep with a folder of its own. A study that is begun again
therefore proposes the same gains, and finds those that were flown.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, suppress
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from rigidfleet._common.arguments import as_path
from rigidfleet._common.files import make_folder, write_file
from rigidfleet._common.processes import usable_core_count
from rigidfleet._version import __version__
from rigidfleet.errors import ResultError, RigidfleetError
from rigidfleet.mission import Mission
from rigidfleet.mission.loading import as_mission
from rigidfleet.sweep import Sweep, SweepProgress, Table, fly
from rigidfleet.sweep.record import BROKEN, REFUSED
from rigidfleet.sweep.runner import WORTH
from rigidfleet.sweep.summary import failure_counts
from rigidfleet.sweep.workers import start_processes
from rigidfleet.tuning.gains import Gains, GainSpace, Screen, feasible_points, own_gains, with_gains
from rigidfleet.tuning.outcome import Flown, Tuned
from rigidfleet.typing import Floats

#: What is minimised, and the metric of a sweep that measures it.
OBJECTIVES = {
    "shape": "shape_tracked",
    "shape-rms": "shape_tracked_rms",
    "shape-forces": "shape_forces",
    "tracking": "tracking_error",
    "tracking-rms": "tracking_rms",
}
STUDY = "study.json"
_ROUNDS, _VALIDATION = "rounds", "validation"
#: Size of the population of the optimiser. It does not depend on the budget, which may grow.
_POPULATION = 10
#: Number of generations after which a study ends if margins refuse nearly all gains.
_GENERATIONS = 500
#: Cost of a flight that fails its verdict, and of one that ends early, beyond any error [m].
_FAILED, _ENDED = 1e3, 1e6
#: Reasons of a run without a whole flight.
_NOT_FLOWN = {"complete", REFUSED, BROKEN}


def tune(
    mission: Mission | str | Path,
    folder: str | Path,
    *,
    objective: str = "shape",
    budget: int = 300,
    seeds: int = 3,
    validation: int = 8,
    seed: int = 0,
    margin_share: float = 1.0,
    assume: Mapping[str, Any] | None = None,
    workers: int | None = None,
    replace: bool = False,
    progress: Callable[[SweepProgress], None] | None = None,
) -> Tuned:
    """Choose gains of the constraint law and the tracking by flying the mission with its vehicles, delays and noise.

    The cost of gains is the mean of the objective over flights with several seeds of noise and gusts. Gains with fewer
    failed flights are better, whatever the objective. Gains with smaller margins than the mission's own are refused
    before they fly. A gain that is 0 stays 0: the mission says which terms its laws have.

    Parameters
    ----------
    mission : a shipped name, a path or a `Mission`
    folder : where flights and results are kept; a study that was stopped goes on there, and nothing is flown twice
    objective : "shape", the largest shape error while slots are tracked; "shape-forces", that where constraint forces
        alone act; "tracking", the largest distance from a slot; "shape-rms" and "tracking-rms", root mean squares over
        time while slots are tracked. "shape" of a mission that tracks none is "shape-forces"
    budget : greatest number of flights of the search. A finished study goes on with a greater one
    seeds, validation : numbers of seeds in the search, and of further ones on which the best gains are judged
    seed : first of these seeds, and seed of the optimiser
    margin_share : share of the mission's own margins that has to remain: 1 for no smaller ones, 0 for stability alone
    assume : tables of a mission that replace keys of this one for the study, such as its disturbances
    workers : number of processes; default: number of cores. A script needs `if __name__ == "__main__":`
    replace : delete another study in this folder
    progress : called as flights are finished

    Raises
    ------
    MissionError
        The mission cannot be read or has errors.
    ResultError
        The folder holds another study or a changed file, or cannot be written.
    RigidfleetError
        An option is wrong, or there is nothing to tune.
    TypeError
        ``mission`` is no mission.
    KeyboardInterrupt
        On Ctrl-C. What was flown is kept, and the same call goes on.
    """
    own_mission = as_mission(mission)
    flown = own_mission.rewritten(_merge_keys(own_mission.to_dict(), assume or {}))
    paths = _seed_paths(flown)
    seeds, validation = (seeds, validation) if paths else (1, 0)
    if objective == "shape" and not any(phase.tracks_slots for phase in flown.phases):
        objective = "shape-forces"
    options = {
        "objective": objective, "seeds": seeds, "validation": validation, "seed": seed,
        "margin_share": margin_share,
    }  # fmt: skip
    if problem := next(_option_problems(flown, budget, options), ""):
        raise RigidfleetError(problem)
    folder = as_path(folder)
    claim = _Claim(
        folder, {"version": __version__, "mission": flown.text, **options}, own_mission.name
    )
    claim.begin_study(replace=replace)
    count = usable_core_count() if workers is None else workers
    study = _Study(flown, folder, options, paths, budget, count, progress)
    with study.stack:
        tuned = study.search(range(seed, seed + seeds))
        study.validate(tuned, range(seed + seeds, seed + seeds + validation))
        chosen = tuned.before if tuned.is_worse else tuned.after
        tuned.text = with_gains(own_mission.text, chosen.gains)
    claim.write(tuned)
    return tuned


def _option_problems(mission: Mission, budget: int, options: Mapping[str, Any]) -> Iterator[str]:
    """What is wrong with options, or with a mission in which there is nothing to tune."""
    name, objective = mission.name, options["objective"]
    if objective not in OBJECTIVES:
        yield f"objective = {objective!r}: use one of {', '.join(OBJECTIVES)}."
    for key, least in (("seeds", 1), ("validation", 0), ("seed", 0)):
        if options[key] < least:
            yield f"{key} = {options[key]}: must be at least {least}."
    if not 0 <= (share := options["margin_share"]) <= 1:
        yield f"margin share = {share}: must be from 0 (stable) to 1 (no smaller margins)."
    seeds, least = options["seeds"], _POPULATION * options["seeds"]
    if budget < least:
        on = f"{_POPULATION} candidates on {seeds} seed{'s' * (seeds != 1)}"
        yield f"budget = {budget}: must be at least {least}, for {on}. Use fewer seeds or a larger budget."
    if not own_gains(mission):
        yield f"{name}: has no gains to tune: no phase tracks slots, and no edges are stabilised."
    slots = objective != "shape-forces"
    if slots not in {phase.tracks_slots for phase in mission.phases}:
        which, other = ("no", "shape-forces") if slots else ("every", "shape")
        yield f"objective = {objective!r}: {which} phase of {name} tracks slots. Use {other}."
    if mission.vehicle_models is None and mission.disturbances is None:
        why = "higher gains are always better for points without disturbances"
        yield f"{name}: {why}. Add [vehicles] or [disturbances], or assume them for the study."


def _merge_keys(document: dict[str, Any], assume: Mapping[str, Any]) -> dict[str, Any]:
    """A document with some of its keys replaced; tables are merged."""
    merged = dict(document)
    for key, value in assume.items():
        there = merged.get(key)
        both = isinstance(there, dict) and isinstance(value, Mapping)
        merged[key] = _merge_keys(there, value) if both else value
    return merged


def _seed_paths(mission: Mission) -> list[str]:
    """Paths of the seeds of the random numbers that act on a mission's flight: noise, gusts, links and sensing."""
    noise, gusts = mission.all_disturbances.noise, mission.all_disturbances.gusts
    net, avoidance = mission.network, mission.avoidance
    acting = {
        "disturbances.noise": noise and (noise.position or noise.velocity or noise.dropped),
        "disturbances.gusts": gusts,
        "network": net and (net.loss or net.jitter),
        "avoidance": avoidance and avoidance.sensing_noise,
    }
    return [f"{name}.seed" for name, acts in acting.items() if acts]


def _outcomes_from_table(table: Table, candidates: Sequence[Gains], seeds: int) -> list[Flown]:
    """What was measured of each candidate; its flights are consecutive runs."""
    measurements = []
    for k, gains in enumerate(candidates):
        rows = slice(k * seeds, (k + 1) * seeds)
        ended = sum(not _NOT_FLOWN.isdisjoint(reason.split(", ")) for reason in table.reason[rows])
        failed = failure_counts(table.reason[rows])
        values = {name: table.metrics[name][rows].tolist() for name in OBJECTIVES.values()}
        measurements.append(
            Flown(gains, int(table.passed[rows].sum()), ended, seeds, values, failed)
        )
    return measurements


class _SpentError(Exception):
    """The budget does not suffice for another generation."""


class _Study:
    """A study that is running: sweeps, one after the other, by processes that end with the context ``stack``.

    Seeds are the same for noise, gusts and the network, at their ``paths``: each draws its own numbers from them.
    """

    def __init__(
        self, mission: Mission, folder: Path, options: Mapping[str, Any], paths: Sequence[str], budget: int,
        workers: int, progress: Callable[[SweepProgress], None] | None,
    ) -> None:  # fmt: skip
        self.mission, self.folder, self.paths, self.budget = mission, folder, paths, budget
        self.seed, self.objective = options["seed"], options["objective"]
        self.metric = OBJECTIVES[self.objective]
        self.screen = Screen(mission, options["margin_share"])
        self.space = GainSpace(self.screen.gains)
        #: Candidates that were flown, and slack of the margins of all that were proposed.
        self.flown: dict[tuple[float, ...], Flown] = {}
        self.slacks: dict[tuple[float, ...], float] = {}
        self.rounds = 0
        self.begun, self.total = perf_counter(), budget
        self.count, self.progress = workers, progress
        #: Numbers of runs that are done, flown and failed: of the sweeps before, and of the present one.
        self.before = self.now = np.zeros(3, dtype=np.int64)
        self.stack = ExitStack()
        self.pool: Executor | None = None

    def search(self, seeds: range) -> Tuned:
        """Search for the best gains on some seeds."""
        from scipy.optimize import NonlinearConstraint, differential_evolution

        before = self._fly_round([self.screen.gains], seeds)[0]
        rng = np.random.default_rng(self.seed)
        with suppress(_SpentError):
            differential_evolution(
                lambda x: math.nan,  # unused: `workers` flies a whole generation
                [(0.0, 1.0)] * len(self.space.own),
                init=feasible_points(self.space, self.margin_slack, _POPULATION, rng),
                constraints=NonlinearConstraint(
                    lambda x: self.margin_slack(self.space.gains_at(x)), 0.0, math.inf
                ),
                workers=lambda _, points: self._costs(points, seeds),
                updating="deferred",
                recombination=0.9,
                maxiter=_GENERATIONS,
                tol=0.0,
                polish=False,
                rng=rng,
            )
        best = min(self.flown.values(), key=lambda flown: objective_cost(flown, self.metric))
        margins = self.screen.own, self.screen.margins_by_law(best.gains)
        refused = sum(slack < 0 for slack in self.slacks.values())
        return Tuned(
            self.mission.name, self.objective, self.metric, before, best, margins,
            len(self.flown) * len(seeds), len(self.flown), refused,
        )  # fmt: skip

    def validate(self, tuned: Tuned, seeds: range) -> None:
        """Fly the mission's own gains and the best ones on seeds that the search has not seen."""
        if not seeds:
            return
        every, judged = list(self.flown), []
        pair = {_gain_values(f.gains): f.gains for f in (tuned.before, tuned.after)}
        self.total = int(self.before[0]) + len(pair) * len(seeds)
        for key, gains in pair.items():
            folder = self.folder / _VALIDATION / f"{every.index(key):04}"
            judged += self._fly_as_sweep([gains], seeds, folder)
        tuned.validation = judged[0], judged[-1]

    def margin_slack(self, gains: Gains) -> float:
        """Slack of the margins; computed once."""
        key = _gain_values(gains)
        if key not in self.slacks:
            self.slacks[key] = self.screen.margin_slack(gains)
        return self.slacks[key]

    def _costs(self, points: Iterable[Floats], seeds: range) -> list[float]:
        """Costs of a generation."""
        every = [self.space.gains_at(x) for x in points]
        new = {_gain_values(g): g for g in every if _gain_values(g) not in self.flown}
        if (len(self.flown) + len(new)) * len(seeds) > self.budget:
            raise _SpentError
        if new:
            self._fly_round(list(new.values()), seeds)
        return [objective_cost(self.flown[_gain_values(g)], self.metric) for g in every]

    def _fly_round(self, candidates: list[Gains], seeds: range) -> list[Flown]:
        """Fly new candidates as the next round."""
        flown = self._fly_as_sweep(candidates, seeds, self.folder / _ROUNDS / f"{self.rounds:03}")
        self.rounds += 1
        self.flown |= {_gain_values(f.gains): f for f in flown}
        return flown

    def _fly_as_sweep(self, candidates: Sequence[Gains], seeds: range, folder: Path) -> list[Flown]:
        """Fly every candidate on every seed, as a sweep in a folder, and return what was measured of each."""
        grids = [("gains", path, [c[path] for c in candidates]) for path in candidates[0]]
        grids += [("seeds", path, [*seeds]) for path in self.paths]
        vary = [{"path": p, "kind": "grid", "values": x, "group": group} for group, p, x in grids]
        sweep = Sweep.of(self.mission, vary, name=folder.name, origin="rigidfleet tune")
        # The first sweep is flown here: it compiles what the processes find, and tells how long a flight takes.
        if self.count > 1 and self.rounds and self.pool is None:
            self.pool = self.stack.enter_context(start_processes(self.count))
        workers = self.count if self.pool else 1
        table = fly(sweep, folder, workers=workers, progress=self._report_progress, pool=self.pool)
        self.before, self.now = self.before + self.now, self.now * 0
        if not self.rounds and np.median(table.wall) * self.total < WORTH:
            self.count = 1
        return _outcomes_from_table(table, candidates, len(seeds))

    def _report_progress(self, now: SweepProgress) -> None:
        self.now = np.array([now.done, now.flown, now.failed])
        if self.progress is not None:
            done, flown, failed = (self.before + self.now).tolist()
            wall = perf_counter() - self.begun
            self.progress(SweepProgress(done, self.total, flown, failed, wall, self.count))


def objective_cost(flown: Flown, metric: str) -> float:
    """Mean of a metric [m]; more failed flights are worse whatever it is, and early ends are worse still."""
    errors = np.nan_to_num(flown.values[metric], nan=_FAILED)
    failed = flown.flights - flown.passed
    return float(np.minimum(errors, _FAILED).mean()) + _FAILED * failed + _ENDED * flown.ended


def _gain_values(gains: Gains) -> tuple[float, ...]:
    return tuple(gains.values())


class _Claim:
    """The files of a study: they are never those of another one, and nothing that a user changed is overwritten."""

    def __init__(self, folder: Path, definition: dict[str, Any], name: str) -> None:
        self.folder, self.definition = folder, definition
        self.study, self.tuned = folder / STUDY, folder / f"{name}-tuned.toml"

    def begin_study(self, *, replace: bool) -> None:
        """Check before anything flies that the files can be written, and begin the study."""
        before = self._read_folder()
        if replace:
            for name in (_ROUNDS, _VALIDATION):
                shutil.rmtree(self.folder / name, ignore_errors=True)
        elif before and before.get("definition") != self.definition:
            old = before.get("definition", {})
            other = [key for key in self.definition if old.get(key) != self.definition[key]]
            raise ResultError(
                f"{self.folder}: contains another study; it differs in: {', '.join(other)}. Use --force to overwrite,"
                " or --out to choose another folder."
            )
        elif self.tuned.exists() and self.tuned.read_bytes() != before.get("text", "").encode():
            raise ResultError(
                f"{self.tuned}: is not what a study wrote; use --force to overwrite or --out to choose another place."
            )
        make_folder(self.folder)
        if replace or not before:
            self._write_study({"definition": self.definition})

    def write(self, tuned: Tuned) -> None:
        """Write the result of the study, and the tuned mission."""
        write_file(self.tuned, tuned.text.encode())
        tuned.file = self.tuned
        self._write_study({"definition": self.definition, **tuned.to_dict(), "text": tuned.text})

    def _read_folder(self) -> dict[str, Any]:
        """What is in the folder."""
        try:
            return json.loads(self.study.read_bytes())
        except FileNotFoundError:
            return {}
        except (OSError, ValueError) as error:
            raise ResultError(
                f"{self.study}: cannot be read as a study ({error}). Delete it, or choose another folder by --out."
            ) from error

    def _write_study(self, data: dict[str, Any]) -> None:
        text = json.dumps(data, ensure_ascii=False, allow_nan=False, indent=2) + "\n"
        write_file(self.study, text.encode())
