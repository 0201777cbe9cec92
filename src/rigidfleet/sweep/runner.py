"""Fly a sweep: what is still missing, in chunks, by whoever is to fly it, into the store as it comes."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np

from rigidfleet._version import __version__
from rigidfleet.errors import RigidfleetError
from rigidfleet.sweep import workers as pools
from rigidfleet.sweep.definition import Sweep
from rigidfleet.sweep.record import RunRecord
from rigidfleet.sweep.run import GROUP, fly_runs
from rigidfleet.sweep.store import Store, Table, read

#: A chunk takes about so long [s]: what is lost by kill -9 for each worker, and how often a bar moves.
_CHUNK = 1.0
#: Processes take a second or two to start: less work than this is done in the one that is there [s].
_WORTH = 6.0
#: Chunks given to each worker: one that it flies, and one that waits for it.
_AHEAD = 2
#: New workers are noticed within [s].
_LOOK = 1.0
#: Workers that die so often, without any chunk in between, will go on doing so.
_DEATHS = 3


@dataclass(frozen=True)
class SweepProgress:
    """How far a sweep is."""

    done: int  # runs in the store
    runs: int  # of the sweep
    flown: int  # since it was last started
    failed: int  # of these
    wall: float  # time taken since then [s]
    workers: int  # that fly


def fly(
    sweep: Sweep,
    folder: str | Path,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    replace: bool = False,
    progress: Callable[[SweepProgress], None] | None = None,
) -> Table:
    """Fly a sweep into a folder, or what is missing there of it, and return all of its rows.

    Parameters
    ----------
    folder : made if it is not there; its file `sweep.db` keeps every chunk as soon as it is flown
    workers : processes on this machine; as many as it has cores when absent. Work of a few seconds is
        done without any. A script that starts processes needs `if __name__ == "__main__":`
    cluster : address of a Dask scheduler, whose workers fly instead
    replace : begin anew if the folder has a sweep
    progress : called after each chunk

    Raises
    ------
    ResultError
        The folder has another sweep, or cannot be written.
    RigidfleetError
        No cluster answers, or workers keep dying.
    KeyboardInterrupt
        On Ctrl-C; what has been flown is in the store, and the same call goes on from there.
    """
    folder = Path(folder)
    with Store(folder, sweep, replace=replace) as store:
        flight = _Sweeping(sweep, store, progress)
        if cluster is not None:
            with pools.cluster(cluster) as pool:
                flight.hand_out(pool)
        else:
            count = _cores() if workers is None else workers
            flight.alone(until_worth=count > 1)
            deaths = 0
            while flight.missing:
                before = flight.flown
                try:
                    with pools.processes(count) as pool:
                        flight.hand_out(pool)
                except BrokenExecutor as error:
                    deaths = 1 if flight.flown > before else deaths + 1
                    if deaths >= _DEATHS:
                        raise _dying() from error
    return read(folder)


class _Sweeping:
    """A sweep under way."""

    def __init__(
        self, sweep: Sweep, store: Store, progress: Callable[[SweepProgress], None] | None
    ) -> None:
        self.sweep, self.store, self.progress = sweep, store, progress
        self.there = store.there()
        # A group is flown as a whole, so that its rows do not depend on when the sweep was stopped.
        self.missing = deque(np.unique(np.flatnonzero(~self.there) // GROUP).tolist())
        self.flown, self.failed = 0, 0
        self.begun, self.workers = perf_counter(), 1
        self.pace = 0.0  # [s] a run
        self._report()

    def alone(self, *, until_worth: bool) -> None:
        """Fly in this process: all, or until what is left is worth others."""
        while self.missing:
            if until_worth and self.pace * GROUP * len(self.missing) > _WORTH:
                return
            self.keep(fly_runs(self.sweep, self.take(1)))

    def hand_out(self, pool: pools.Pool) -> None:
        """Fly all that is missing by a pool of workers; what it does not bring back is missing again."""
        executor, capacity = pool
        flying: dict[Future[list[RunRecord]], list[int]] = {}
        text = self.sweep.json()
        try:
            while self.missing or flying:
                self.workers = capacity()
                while self.missing and len(flying) < _AHEAD * self.workers:
                    runs = self.take(self.workers)
                    flying[executor.submit(pools.chunk, text, __version__, runs)] = runs
                for future in wait(flying, _LOOK, FIRST_COMPLETED).done:
                    self.keep(future.result())
                    del flying[future]
        finally:
            lost = {run // GROUP for runs in flying.values() for run in runs}
            self.missing.extendleft(sorted(lost, reverse=True))

    def take(self, workers: int) -> list[int]:
        """Runs of the next chunk: whole groups, for about as long as a chunk is to take."""
        fair = -(-len(self.missing) // (_AHEAD * workers))
        groups = 1 if self.pace == 0.0 else min(fair, int(_CHUNK / (self.pace * GROUP)))
        first = [self.missing.popleft() for _ in range(max(1, groups))]
        last = self.sweep.runs
        return [run for g in first for run in range(g * GROUP, min((g + 1) * GROUP, last))]

    def keep(self, rows: list[RunRecord]) -> None:
        """Put the rows of a chunk into the store."""
        self.store.add(rows)
        self.there[[row.run for row in rows]] = True
        self.flown += len(rows)
        self.failed += sum(not row.passed for row in rows)
        self.pace = max(median(row.wall for row in rows), 1e-9)
        self._report()

    def _report(self) -> None:
        if self.progress is not None:
            wall = perf_counter() - self.begun
            done = int(self.there.sum())
            self.progress(
                SweepProgress(done, self.sweep.runs, self.flown, self.failed, wall, self.workers)
            )


def _cores() -> int:
    """Cores that this process may use."""
    usable = getattr(os, "sched_getaffinity", None)
    return len(usable(0)) if usable is not None else os.cpu_count() or 1


def _dying() -> RigidfleetError:
    return RigidfleetError(
        "the workers die, one after the other. What they flew is kept. Look for too little memory (fly with"
        " fewer --workers), or, in a script, for a missing `if __name__ == '__main__':`"
    )
