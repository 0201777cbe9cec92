"""Figures drawn side by side, in processes that load matplotlib while the flight is still computed.

A server process loads the plotting packages once; every drawing process is a fork of it and begins at once. Where
there is no such server (Windows), or one processor, or a very large result, figures are drawn in this process.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import TYPE_CHECKING

from rigidfleet._common.processes import safe_path

if TYPE_CHECKING:
    from rigidfleet.result import Result

#: What the server loads: all that drawing a figure needs.
_LOADED = [
    "rigidfleet.plotting", "matplotlib.backends.backend_agg", "matplotlib.style", "mpl_toolkits.mplot3d.axes3d",
    "rigidfleet.plotting.figure",
]  # fmt: skip
#: Each drawing process holds a copy of the result: larger positions [bytes] are drawn in this process.
_LARGEST = 50_000_000
#: Fewer figures are not worth a process.
_FEW = 3


def at_once() -> int:
    """How many figures can be drawn at the same time."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def prepare() -> None:
    """Start the server, which loads matplotlib beside whatever this process does next."""
    if at_once() == 1:
        return
    from multiprocessing import forkserver

    multiprocessing.set_forkserver_preload(_LOADED)
    # Ctrl-C is for this process alone, which ends the others. They inherit that the signal waits.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with safe_path():
            forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def draw_all(
    result: Result, figures: Mapping[Path, Sequence[str]], *, titles: bool
) -> Iterator[Path]:
    """Draw figures, given as files without their suffix and formats of each; yield each when it is drawn.

    Raises
    ------
    ResultError
        A file cannot be written.
    """
    count = min(at_once(), len(figures))
    if count == 1 or len(figures) < _FEW or result.position.nbytes > _LARGEST:
        yield from _draw(result, figures.items(), titles)
        return
    prepare()
    pool = ProcessPoolExecutor(
        count,
        mp_context=multiprocessing.get_context("forkserver"),
        initializer=_begin,
        initargs=(result, titles),
    )
    drawn = False
    try:
        jobs = [pool.submit(_one, path, formats) for path, formats in figures.items()]
        for job in as_completed(jobs):
            yield job.result()
        drawn = True
    finally:
        if not drawn:
            for process in multiprocessing.active_children():
                process.terminate()
        pool.shutdown(wait=drawn, cancel_futures=True)


def _draw(
    result: Result, figures: Iterable[tuple[Path, Sequence[str]]], titles: bool
) -> Iterator[Path]:
    from rigidfleet.plotting import plot

    for path, formats in figures:
        plot(result, path.parent, names=[path.name], formats=formats, titles=titles)
        yield path


_drawn: list[tuple[Result, bool]] = []


def _begin(result: Result, titles: bool) -> None:
    """Keep, in a drawing process, what all its figures show."""
    _drawn[:] = [(result, titles)]


def _one(path: Path, formats: Sequence[str]) -> Path:
    """Draw one figure, in a drawing process."""
    result, titles = _drawn[0]
    return next(_draw(result, [(path, formats)], titles))
