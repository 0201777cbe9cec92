"""Figures drawn side by side, in processes that load matplotlib while the flight is still computed.

They draw while the flight is saved and judged; this process then writes the files. A server process loads the plotting
packages once; every drawing process is a fork of it and begins at once. Where there is no such server (Windows), or one
processor, or a very large result, figures are drawn in this process; so is a figure whose process fails, as where the
system ends it for its memory.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import TYPE_CHECKING

from rigidfleet._common.processes import safe_path

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerProcess

    from rigidfleet.result import Result

#: Each drawing process holds a copy of the result: larger positions [bytes] are drawn in this process.
_LARGEST = 50_000_000
#: Fewer figures are not worth a process.
_FEW = 3
#: Figures by the time they take; the longest are drawn first, so that all processes end at about the same time.
_SLOW = (
    "summary", "cm", "attitude", "vehicles", "rotors", "clearance", "trajectory", "constraint_error",
    "constraint_force", "inputs",
)  # fmt: skip


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

    multiprocessing.set_forkserver_preload(["rigidfleet.cli.drawing_server"])
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
        self._asked = deque(sorted(figures, key=lambda path: (*_SLOW, path.name).index(path.name)))
        #: A figure and its files by format; None when a process draws no more.
        self._drawn: SimpleQueue[tuple[Path, dict[str, bytes]] | None] = SimpleQueue()
        self._processes: list[ForkServerProcess] = []
        self._drawing = 0  # number of threads, each of which has a process
        if len(figures) < _FEW or result.position.nbytes > _LARGEST or not prepare():
            return
        # The kernel, which evaluates the result, is loaded in this process alone.
        given = pickle.dumps(result.evaluate()), titles
        self._drawing = min(at_once(), len(figures))
        for _ in range(self._drawing):
            Thread(target=self._ask, args=given, daemon=True).start()

    def _ask(self, *given: object) -> None:
        """Let a process of its own draw figures until none is left, or until it fails."""
        try:
            context = multiprocessing.get_context("forkserver")
            here, there = context.Pipe()
            process = context.Process(target=_draw, args=(there, *given), daemon=True)
            process.start()
            there.close()
            self._processes.append(process)
            while self._asked:
                path = self._asked.popleft()
                here.send((path.name, self.figures[path]))
                self._drawn.put((path, here.recv()))
            here.close()
        except (OSError, EOFError, IndexError):
            pass  # no process, or one that has ended, or no figure left; the rest is drawn in this process
        finally:
            self._drawn.put(None)

    def __enter__(self) -> Drawings:
        return self

    def __exit__(self, *_: object) -> None:
        self._asked.clear()
        for process in self._processes:
            process.terminate()

    def __iter__(self) -> Iterator[Path]:
        """Paths of the figures without their suffix, each when its files are written.

        Raises
        ------
        ResultError
            A file cannot be written.
        """
        from rigidfleet.plotting import plot, write

        left = dict(self.figures)
        while self._drawing:
            if (found := self._drawn.get()) is None:
                self._drawing -= 1
                continue
            path, files = found
            for kind, data in files.items():
                write(path.with_name(f"{path.name}.{kind}"), data)
            del left[path]
            yield path
        for path, formats in left.items():
            plot(self._result, path.parent, names=[path.name], formats=formats, titles=self._titles)
            yield path


def _draw(asked: Connection, result: bytes, titles: bool) -> None:
    """Draw figures, in a process of its own, as their names and formats arrive; send their files.

    Any error ends the process, without a word: what is wrong with a figure is told where it is drawn again.
    """
    from rigidfleet.plotting import rendered

    with suppress(Exception):
        flown: Result = pickle.loads(result)
        while True:
            name, formats = asked.recv()
            asked.send(rendered(flown, name, formats, titles=titles))
