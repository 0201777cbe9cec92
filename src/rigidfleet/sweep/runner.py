"""Fly the missing runs of a sweep in chunks, by any kind of workers, and store each chunk when it is finished."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np

from rigidfleet._common.processes import cores
from rigidfleet.errors import RigidfleetError
from rigidfleet.sweep import workers as pools
from rigidfleet.sweep.definition import Sweep
from rigidfleet.sweep.record import RunRecord
from rigidfleet.sweep.run import GROUP, fly_runs
from rigidfleet.sweep.store import Store, Table, read

#: Approximate duration of a chunk [s]: the work that kill -9 loses per worker, and the interval of progress.
_CHUNK = 1.0
#: Work below which no further processes are started, as starting them may take one or two seconds [s].
_WORTH = 6.0
#: Number of chunks per worker: one in work and one waiting.
_AHEAD = 2
#: Maximum time until new workers are noticed [s].
_LOOK = 1.0
#: Number of deaths of workers, without a finished chunk in between, after which the sweep stops.
_DEATHS = 3


@dataclass(frozen=True)
class SweepProgress:
    """Progress of a sweep.

    Attributes
    ----------
    done : number of runs in the store
    runs : number of runs of the sweep
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


def fly(
    sweep: Sweep,
    folder: str | Path,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    replace: bool = False,
    progress: Callable[[SweepProgress], None] | None = None,
    pool: Callable[[], pools.Pool] | None = None,
) -> Table:
    """Fly the runs of a sweep that are missing in a folder, and return all of its rows.

    Parameters
    ----------
    folder : created if it does not exist; its file `sweep.db` stores every chunk when it is finished
    workers : number of processes on this machine; default: number of cores. Work of a few seconds is done in this
        process. A script that starts processes needs `if __name__ == "__main__":`
    cluster : address of a Dask scheduler, whose workers fly the runs
    replace : overwrite a sweep that is in the folder
    progress : called after each chunk, and each second at least
    pool : instead of workers: returns processes that are kept for several sweeps, called if there is anything to fly

    Raises
    ------
    ResultError
        The folder contains another sweep or cannot be written.
    RigidfleetError
        The cluster does not answer, workers keep dying, or the controller cannot be imported.
    KeyboardInterrupt
        On Ctrl-C. Finished runs are in the store, and the same call resumes the sweep.
    """
    folder = Path(folder)
    with Store(folder, sweep, replace=replace) as store:
        flight = _Sweeping(sweep, store, progress)
        if cluster is not None:
            with pools.cluster(cluster) as there:
                flight.hand_out(there)
        elif pool is not None:
            if flight.missing:
                flight.hand_out(pool())
        else:
            count = cores() if workers is None else workers
            flight.alone(until_worth=count > 1)
            deaths = 0
            while flight.missing:
                before = flight.flown
                flight.report(count)
                try:
                    with pools.processes(count) as there:
                        flight.hand_out(there)
                except BrokenExecutor as error:
                    deaths = 1 if flight.flown > before else deaths + 1
                    if deaths >= _DEATHS:
                        raise RigidfleetError(
                            "the workers keep dying. Finished runs are saved. If memory is short, use fewer --workers;"
                            " in a script, check for a missing `if __name__ == '__main__':`."
                        ) from error
    return read(folder)


class _Sweeping:
    """State of a sweep that is running."""

    def __init__(
        self, sweep: Sweep, store: Store, progress: Callable[[SweepProgress], None] | None
    ) -> None:
        self.sweep, self.store, self.progress = sweep, store, progress
        self.finished_runs = store.finished_runs()
        # A group is flown as a whole, so that its records do not depend on when the sweep was stopped.
        self.missing = deque(np.unique(np.flatnonzero(~self.finished_runs) // GROUP).tolist())
        self.flown, self.failed = 0, 0
        self.begun = perf_counter()
        self.pace = 0.0  # [s] a run
        self.report(1)

    def alone(self, *, until_worth: bool) -> None:
        """Fly in this process: all runs, or until the remaining work justifies more processes."""
        while self.missing:
            if until_worth and self.pace * GROUP * len(self.missing) > _WORTH:
                return
            self.keep(fly_runs(self.sweep, self.take(1)))
            self.report(1)

    def hand_out(self, pool: pools.Pool) -> None:
        """Fly all missing runs by a pool of workers. Runs that do not come back are missing again."""
        executor, capacity = pool
        flying: dict[Future[list[RunRecord]], list[int]] = {}
        sweep = self.sweep.json(), self.sweep.version
        try:
            while self.missing or flying:
                workers = capacity()
                while self.missing and len(flying) < _AHEAD * workers:
                    runs = self.take(workers)
                    flying[executor.submit(pools.fly_chunk, *sweep, runs)] = runs
                for future in wait(flying, _LOOK, FIRST_COMPLETED).done:
                    self.keep(future.result())
                    del flying[future]
                self.report(workers)
        finally:
            lost = {run // GROUP for runs in flying.values() for run in runs}
            self.missing.extendleft(sorted(lost, reverse=True))

    def take(self, workers: int) -> list[int]:
        """Runs of the next chunk: complete groups for the duration of a chunk."""
        fair = -(-len(self.missing) // (_AHEAD * workers))
        groups = 1 if self.pace == 0.0 else min(fair, int(_CHUNK / (self.pace * GROUP)))
        first = [self.missing.popleft() for _ in range(max(1, groups))]
        last = self.sweep.runs
        return [run for g in first for run in range(g * GROUP, min((g + 1) * GROUP, last))]

    def keep(self, rows: list[RunRecord]) -> None:
        """Store the records of a chunk."""
        self.store.add(rows)
        self.finished_runs[[row.run for row in rows]] = True
        self.flown += len(rows)
        self.failed += sum(not row.passed for row in rows)
        self.pace = max(median(row.wall for row in rows), 1e-9)

    def report(self, workers: int) -> None:
        """Tell the progress."""
        if self.progress is not None:
            done, wall = int(self.finished_runs.sum()), perf_counter() - self.begun
            now = SweepProgress(done, self.sweep.runs, self.flown, self.failed, wall, workers)
            self.progress(now)
