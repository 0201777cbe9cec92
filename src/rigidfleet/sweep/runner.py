"""Fly the missing runs of a sweep in chunks, by any kind of workers, and store each chunk when it is finished."""

from __future__ import annotations

import logging
import warnings
from collections import deque
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

from rigidfleet._common.processes import usable_core_count
from rigidfleet.errors import RigidfleetError, wrong_type
from rigidfleet.sweep import workers as pools
from rigidfleet.sweep.definition import Sweep
from rigidfleet.sweep.record import RunRecord
from rigidfleet.sweep.run import GROUP, fly_runs
from rigidfleet.sweep.shards import runs_of_shard, shard_folder
from rigidfleet.sweep.store import Store, Table, read
from rigidfleet.typing import Bools

#: Approximate duration of a chunk [s]: the work that kill -9 loses per worker, and the interval of progress.
_CHUNK = 1.0
#: Work below which no further processes are started, as starting them may take one or two seconds [s].
WORTH = 6.0
#: Number of chunks per worker: one in work and one waiting.
_AHEAD = 2
#: Maximum time until new workers are noticed [s].
_LOOK = 1.0
#: Number of deaths of workers, without a finished chunk in between, after which the sweep stops.
_DEATHS = 3
#: Maximum time without any worker of a cluster [s]: they may wait in a queue for their machines.
_ALONE = 300.0

#: Says what progress says, and warns of what was lost; silent unless the program that uses the library listens.
_log = logging.getLogger("rigidfleet.sweep")
_log.addHandler(logging.NullHandler())


@dataclass(frozen=True)
class SweepProgress:
    """Progress of a sweep.

    Attributes
    ----------
    done : number of runs in the store
    runs : number of runs of the sweep, or of its shard
    flown : number of runs flown since the sweep was started or resumed
    failed : number of these that failed
    wall : time since then [s]
    workers : number of workers
    """

    done: int
    runs: int
    flown: int
    failed: int
    wall: float
    workers: int


_Listener = Callable[[SweepProgress], None] | None
_Job = Callable[[str, str, list[int]], list[RunRecord]]


def fly(
    sweep: Sweep,
    folder: str | Path,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    shard: str = "",
    replace: bool = False,
    progress: _Listener = None,
    pool: Executor | None = None,
) -> Table:
    """Fly the runs of a sweep that are missing in a folder, and return all of its rows.

    Parameters
    ----------
    folder : created if it does not exist; its file `sweep.db` stores every chunk when it is finished
    workers : number of processes on this machine; default: number of cores. Work of a few seconds is done in this
        process. A script that starts processes needs `if __name__ == "__main__":`
    cluster : address of a Dask scheduler, whose workers fly the runs
    shard : "3/40": fly only the third of forty parts, into a store of its own in the folder; `merge` makes one store.
        Groups of eight runs stay together: a part without one is warned of
    replace : overwrite a sweep that is in the folder
    progress : called after each chunk, and each second at least
    pool : an executor of `concurrent.futures` whose workers, as many as ``workers`` says, fly the runs; it stays open

    Raises
    ------
    ResultError
        The folder contains another sweep or cannot be written.
    RigidfleetError
        The cluster does not answer or ends, a worker cannot fly, workers keep dying, the executor takes no work, the
        controller cannot be imported, or there is no such shard. Finished runs are in the store, and the same call
        resumes the sweep. Or there are both ``pool`` and ``cluster``.
    TypeError
        ``pool`` is no executor, or ``workers`` no number of workers.
    KeyboardInterrupt
        On Ctrl-C. Finished runs are in the store, and the same call resumes the sweep.
    """
    if not isinstance(pool, Executor | None):
        raise wrong_type("an Executor of concurrent.futures as pool", pool)
    if workers is not None and (not isinstance(workers, int | np.integer) or workers < 1):
        raise wrong_type("a whole number of workers, 1 or more", workers)
    if pool is not None and cluster is not None:
        raise RigidfleetError("pool and cluster exclude each other: use one of them.")
    own, folder = runs_of_shard(shard, sweep.runs), shard_folder(Path(folder), shard)
    if not own.any():
        words = f"{sweep.runs} runs, in groups of {GROUP}, are enough for K/N with N up to {-(-sweep.runs // GROUP)}"
        warnings.warn(f"--shard {shard}: nothing to fly; {words}.", stacklevel=2)
    count = usable_core_count() if workers is None else workers
    with Store(folder, sweep, shard, replace) as store:
        flight = _Sweeping(sweep, store, progress, own)
        if cluster is not None:
            with pools.open_cluster(cluster) as (executor, capacity):
                flight.fly_by_executor(executor, capacity, pools.fly_chunk_in_cluster)
        elif pool is not None:
            flight.fly_by_executor(pool, lambda: count, pools.fly_chunk)
        else:
            flight.fly_in_this_process(until_worth=count > 1)
            deaths = 0
            while flight.missing:
                before = flight.flown
                flight.report_progress(count)
                try:
                    with pools.start_processes(count) as executor:
                        flight.fly_by_executor(executor, lambda: count, pools.fly_chunk)
                except RigidfleetError as error:
                    deaths = 1 if flight.flown > before else deaths + 1
                    if deaths >= _DEATHS or not isinstance(error.__cause__, BrokenExecutor):
                        raise
        _log.info(f"{flight.saved_text()}; done")
    return read(folder)


class _Sweeping:
    """State of a sweep that is running."""

    def __init__(self, sweep: Sweep, store: Store, progress: _Listener, own: Bools) -> None:
        self.sweep, self.store, self.progress = sweep, store, progress
        self.finished_runs = store.finished_runs()
        self.runs = int(own.sum())
        # A group is flown as a whole, so that its records do not depend on when the sweep was stopped.
        self.missing = deque(np.unique(np.flatnonzero(own & ~self.finished_runs) // GROUP).tolist())
        self.flown, self.failed, self.workers = 0, 0, 1
        self.begun = self.changed = perf_counter()
        self.pace = 0.0  # [s] a run
        _log.info(f"{self.saved_text()}; begun")
        self.report_progress(1)

    def fly_in_this_process(self, *, until_worth: bool) -> None:
        """Fly in this process: all runs, or until the remaining work justifies more processes.

        Raises
        ------
        RigidfleetError
            This machine cannot fly them.
        """
        while self.missing:
            if until_worth and self.pace * GROUP * len(self.missing) > WORTH:
                return
            try:
                rows = fly_runs(self.sweep, self.take_chunk(1))
            except RigidfleetError as error:
                if error.__cause__ is None:  # nothing that was saved helps
                    raise
                raise self.failure(pools.why_failed(error, "this process failed")) from error
            self.store_records(rows)
            self.report_progress(1)

    def fly_by_executor(self, executor: Executor, capacity: Callable[[], int], job: _Job) -> None:
        """Fly all missing runs by an executor with a number of workers. Runs that do not come back are missing again.

        Raises
        ------
        RigidfleetError
            The executor failed, by the error that is the cause.
        """

        def call_or_fail(call: Callable[..., Any], *arguments: Any) -> Any:
            try:
                return call(*arguments)
            except Exception as error:
                who = "the executor takes no work" if call == executor.submit else "a worker failed"
                in_cluster = job is pools.fly_chunk_in_cluster
                raise self.failure(pools.why_failed(error, who, in_cluster=in_cluster)) from error

        flying: dict[Future[list[RunRecord]], list[int]] = {}
        taken: list[int] = []
        sweep = self.sweep.json(), self.sweep.version
        try:
            while self.missing or flying:
                workers = call_or_fail(capacity)
                while self.missing and len(flying) < _AHEAD * max(1, workers):
                    taken = self.take_chunk(max(1, workers))
                    flying[call_or_fail(executor.submit, job, *sweep, taken)] = taken
                    taken = []
                for future in wait(flying, _LOOK, FIRST_COMPLETED).done:
                    self.store_records(call_or_fail(future.result))
                    del flying[future]
                self.report_progress(workers)
        finally:
            for future, runs in flying.items():
                future.cancel()
                _log.warning(f"{self.saved_text()}; lost in flight: {len(runs)}, from {runs[0]} on")
            lost = {run // GROUP for runs in (*flying.values(), taken) for run in runs}
            self.missing.extendleft(sorted(lost, reverse=True))

    def take_chunk(self, workers: int) -> list[int]:
        """Runs of the next chunk: complete groups for the duration of a chunk."""
        fair = -(-len(self.missing) // (_AHEAD * workers))
        groups = 1 if self.pace == 0.0 else min(fair, int(_CHUNK / (self.pace * GROUP)))
        first = [GROUP * self.missing.popleft() for _ in range(max(1, groups))]
        return [run for k in first for run in range(k, min(k + GROUP, self.sweep.runs))]

    def store_records(self, rows: list[RunRecord]) -> None:
        """Store the records of a chunk."""
        self.store.add_records(rows)
        self.finished_runs[[row.run for row in rows]] = True
        self.flown += len(rows)
        self.failed += sum(not row.passed for row in rows)
        self.pace = max(median(row.wall for row in rows), 1e-9)
        _log.info(f"{self.saved_text()}, {self.failed} of {self.flown} flown failed")

    def failure(self, why: str) -> RigidfleetError:
        """An error by which the sweep ends before all runs are flown."""
        return RigidfleetError(f"{why} {self.saved_text()} are saved; the same command goes on.")

    def saved_text(self) -> str:
        """Runs that are saved, and where."""
        return f"{self.store.path.parent}: {self.finished_runs.sum()} of {self.runs} runs"

    def report_progress(self, workers: int) -> None:
        """Tell the progress."""
        if workers != self.workers:
            level = logging.WARNING if workers < self.workers else logging.INFO
            _log.log(level, f"{self.saved_text()}; workers: {workers}, before {self.workers}")
            self.workers, self.changed = workers, perf_counter()
        if not workers and perf_counter() - self.changed > _ALONE:
            raise self.failure(f"no worker came for {_ALONE:g} s. Start some by `dask worker`.")
        if self.progress is not None:
            done, wall = int(self.finished_runs.sum()), perf_counter() - self.begun
            now = SweepProgress(done, self.runs, self.flown, self.failed, wall, workers)
            self.progress(now)
