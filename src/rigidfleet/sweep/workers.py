"""Workers of a sweep: processes on this machine or a Dask cluster."""

from __future__ import annotations

import gc
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import connection
from typing import Any

from rigidfleet._common.processes import set_python_safe_path
from rigidfleet._common.threads import single_blas_thread
from rigidfleet.errors import RigidfleetError
from rigidfleet.kernel.compiler.levels import runnable_instruction_level
from rigidfleet.sweep.definition import sweep_of_json
from rigidfleet.sweep.record import RunRecord
from rigidfleet.sweep.run import fly_runs

#: Maximum time to wait for a scheduler [s].
_CONNECT = 20.0
#: Number of workers of a cluster that try to fly a chunk.
_TRIES = 5
#: Time between looks whether one that was passed on is flown [s].
_LOOK = 0.1


def fly_chunk(sweep: str, version: str, runs: Sequence[int]) -> list[RunRecord]:
    """Fly a chunk of a sweep, given as JSON, for another process.

    Raises
    ------
    RigidfleetError
        The other process has another version of rigidfleet, or of the user's controller; or this machine cannot fly.
    """
    flown = sweep_of_json(sweep)
    if version != flown.version:
        words = "Install the same version on all machines"
        raise RigidfleetError(f"it has {flown.version}, and the sweep {version}. {words}.")
    runnable_instruction_level()
    with single_blas_thread():  # there is a process for each core
        return fly_runs(flown, runs)


def fly_chunk_in_cluster(
    sweep: str, version: str, runs: Sequence[int], tried: tuple[str, ...] = ()
) -> list[RunRecord]:
    """Fly a chunk on a worker of Dask. One that cannot passes it on to others, until ``tried`` are `_TRIES` addresses.

    Raises
    ------
    RigidfleetError
        None of them can, for the reason of the last one.
    """
    from distributed import get_worker, worker_client

    try:
        return fly_chunk(sweep, version, runs)
    except RigidfleetError:
        tried = (*tried, get_worker().address)
        if len(tried) == _TRIES:
            raise
        with worker_client() as client:
            if not (others := [x for x in client.nthreads() if x not in tried]):
                raise
            chunk = sweep, version, runs, tried
            future = client.submit(fly_chunk_in_cluster, *chunk, workers=others, pure=False)
            while not future.done():
                if client.nthreads().keys().isdisjoint(others):  # it would wait for them for ever
                    raise
                time.sleep(_LOOK)
            return future.result()


@contextmanager
def start_processes(count: int) -> Generator[Executor]:
    """Start persistent processes on this machine. They end with this process, even if it is killed.

    They are forks of this process where that is safe, as they then begin with all that it has loaded. Elsewhere, each
    starts on its own.

    Raises
    ------
    RigidfleetError
        The machine allows no further process.
    """
    before = set(multiprocessing.active_children())
    forked = _is_fork_safe()
    context = multiprocessing.get_context("fork" if forked else "spawn")
    # Before a spawned process receives the module path of its parent, it would search the current folder first, even
    # for modules of the standard library; so would multiprocessing's resource tracker.
    with set_python_safe_path():
        pool = ProcessPoolExecutor(count, context, _begin_worker)
        try:
            if forked:  # all forks begin at once, and Ctrl-C waits from their start
                before_fork = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
                try:
                    pool.submit(int)
                except OSError as error:
                    words = "Use fewer --workers, or --workers 1"
                    raise RigidfleetError(
                        f"no process can be started: {error}. {words}."
                    ) from error
                finally:
                    signal.pthread_sigmask(signal.SIG_SETMASK, before_fork)
            yield pool
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in set(multiprocessing.active_children()) - before:
                process.terminate()


def _is_fork_safe() -> bool:
    """Whether a fork of this process is whole: another thread would be missing, and a lock that it holds never free.

    Linux tells; other systems do not, and on some of them libraries forbid forks.
    """
    try:
        return len(os.listdir("/proc/self/task")) == 1
    except OSError:
        return False


def _begin_worker() -> None:
    """Prepare a worker: ignore Ctrl-C, and end with the parent process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # A run makes thousands of arrays and leaves hardly any cycle: to search for them takes a twentieth of its time.
    gc.freeze()
    gc.set_threshold(100_000)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)


@contextmanager
def open_cluster(address: str) -> Generator[tuple[Executor, Callable[[], int]]]:
    """Use the workers of a Dask cluster: an executor, and a function that returns how many there are at the moment.

    Raises
    ------
    RigidfleetError
        Dask is not installed, or no scheduler answers at the address.
    """
    try:
        from distributed import Client
    except ImportError:
        raise RigidfleetError(
            "--cluster needs the package distributed. Install it: pip install distributed"
        ) from None
    try:
        client: Any = Client(address, timeout=_CONNECT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        why = str(error) or type(error).__name__
        raise RigidfleetError(
            f"--cluster {address}: no scheduler answers ({why}). Start one by `dask scheduler` and give the address"
            " that it prints, for example tcp://HOST:8786."
        ) from None
    executor = client.get_executor(pure=False)
    try:
        yield executor, lambda: sum(client.nthreads().values())
    finally:
        log = logging.getLogger("distributed.client")
        before = log.level
        log.setLevel(logging.CRITICAL + 1)  # as it closes without a scheduler, it logs a traceback
        executor.shutdown(wait=False)
        client.close()
        log.setLevel(before)


def why_failed(error: Exception, who: str, *, in_cluster: bool = False) -> str:
    """Why work that was handed to an executor did not come back, and what to do; ``who`` failed, if nobody died."""
    if in_cluster and isinstance(error, CancelledError | OSError):
        return "the scheduler of the cluster ended, or the connection to it."
    if isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker":  # Dask's
        return "workers died. If memory is short, use fewer of them; a script needs `if __name__ == '__main__':`."
    name = "" if isinstance(error, RigidfleetError) else f"{type(error).__name__}: "
    return f"{who}: {name}{str(error).removesuffix('.')}."
