"""Figures drawn side by side, in processes that load matplotlib while the flight is still computed.

They draw while the flight is saved and judged; this process then writes the files. A server process loads the plotting
packages once; every drawing process is a fork of it and begins at once. Where there is no such server (Windows), or one
processor, or a very large result, figures are drawn in this process; so is a figure whose process fails, as where the
system ends it for its memory.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import signal
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

from rigidfleet._common.processes import safe_path

if TYPE_CHECKING:
    from rigidfleet.result import Result

#: What the server loads: all that a drawing process needs, which would otherwise be loaded in each of them.
_LOADED = [
    "rigidfleet.plotting", "matplotlib.backends.backend_agg", "matplotlib.style", "mpl_toolkits.mplot3d.axes3d",
    "rigidfleet.plotting.figure", "rigidfleet.mission", __name__, "concurrent.futures.process",
    "matplotlib.patheffects",
]  # fmt: skip
#: Each drawing process holds a copy of the result: larger positions [bytes] are drawn in this process.
_LARGEST = 50_000_000
#: Fewer figures are not worth a process.
_FEW = 3
#: Figures that take longest; they are drawn first, so that all processes end at about the same time.
_SLOW = ("summary", "cm", "clearance", "attitude", "vehicles", "rotors")


def at_once() -> int:
    """How many figures can be drawn at the same time."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def prepare() -> bool:
    """Start the server, which loads matplotlib beside whatever this process does next; return whether there is one."""
    if at_once() == 1:
        return False
    from multiprocessing import forkserver

    multiprocessing.set_forkserver_preload(_LOADED)
    # Ctrl-C is for this process alone, which ends the others. They inherit that the signal waits.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with safe_path():
            forkserver.ensure_running()
        return True
    except OSError:  # a temporary folder whose path is too long for a socket, for example
        return False
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class Drawings:
    """Figures of a flight: other processes begin to draw them at once; iteration writes each file when it is drawn.

    Where there is one process, iteration draws them. Leaving the context ends what still draws.

    Parameters
    ----------
    figures : files without their suffix, and formats of each
    titles : as for `rigidfleet.plotting.plot`
    """

    def __init__(
        self, result: Result, figures: Mapping[Path, Sequence[str]], *, titles: bool
    ) -> None:
        self.figures, self._result, self._titles = figures, result, titles
        self._pool: ProcessPoolExecutor | None = None
        self._jobs: dict[Future[dict[str, bytes]], Path] = {}
        if len(figures) < _FEW or result.position.nbytes > _LARGEST or not prepare():
            return
        try:
            self._pool = ProcessPoolExecutor(
                min(at_once(), len(figures)), mp_context=multiprocessing.get_context("forkserver"), initializer=_begin,
                initargs=(pickle.dumps(result.evaluate()), titles),  # the kernel is loaded in this process alone
            )  # fmt: skip
        except (ImportError, OSError):  # no semaphores: no /dev/shm, for example
            return
        # In a thread, as it waits until the server has loaded everything
        self._asking = Thread(target=self._ask, args=(self._pool,), daemon=True)
        self._asking.start()

    def _ask(self, pool: ProcessPoolExecutor) -> None:
        """Ask for each figure, those that take longest first; a process that cannot be started is an error of each."""
        for path in sorted(self.figures, key=lambda path: path.name not in _SLOW):
            try:
                job = pool.submit(_one, path.name, self.figures[path])
            except (OSError, RuntimeError) as error:
                job = Future[dict[str, bytes]]()
                job.set_exception(error)
            self._jobs[job] = path

    def __enter__(self) -> Drawings:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._asking.join()
            drawn = all(job.done() for job in self._jobs)
            if not drawn:
                for process in multiprocessing.active_children():
                    process.terminate()
            self._pool.shutdown(wait=drawn, cancel_futures=True)

    def __iter__(self) -> Iterator[Path]:
        """Paths of the figures without their suffix, each when its files are written.

        Raises
        ------
        ResultError
            A file cannot be written.
        """
        from rigidfleet.plotting import write

        if self._pool is None:
            for path in self.figures:
                self._draw(path)
                yield path
            return
        self._asking.join()
        for job in as_completed(self._jobs):
            path = self._jobs[job]
            try:
                files = job.result()
            except (OSError, RuntimeError):
                # The process failed. What is wrong with the figure itself is wrong here, too.
                self._draw(path)
            else:
                for kind, data in files.items():
                    write(path.with_name(f"{path.name}.{kind}"), data)
            yield path

    def _draw(self, path: Path) -> None:
        """Draw a figure in this process, and write it."""
        from rigidfleet.plotting import plot

        formats = self.figures[path]
        plot(self._result, path.parent, names=[path.name], formats=formats, titles=self._titles)


_drawn: list[tuple[Result, bool]] = []


def _begin(result: bytes, titles: bool) -> None:
    """Keep, in a drawing process, what all its figures show."""
    gc.disable()  # of a process that ends after some figures; it takes a tenth of the time
    _drawn[:] = [(pickle.loads(result), titles)]


def _one(name: str, formats: Sequence[str]) -> dict[str, bytes]:
    """Files of one figure by format, from a drawing process."""
    from rigidfleet.plotting import rendered

    result, titles = _drawn[0]
    return rendered(result, name, formats, titles=titles)
