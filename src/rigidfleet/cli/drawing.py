"""Figures drawn side by side, by processes that load matplotlib while the flight is still computed.

They draw while the flight is saved and judged; this process then writes the files. The first process is a fork of this
one before it has computed anything; the others are forks of the first, which has loaded matplotlib and the flight.
Where there are no forks (Windows), or one processor, or a very large result, figures are drawn in this process; so is a
figure whose process fails, as where the system ends it for its memory.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import signal
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rigidfleet.result import Result

#: Each drawing process holds a copy of the result: larger positions [bytes] are drawn in this process.
_LARGEST = 50_000_000
#: Fewer figures are not worth a process, and more processes than this not their start.
_FEW, _MOST = 3, 8
#: Figures by the time they take; the longest are drawn first, so that all processes end at about the same time.
_SLOW = (
    "summary", "trajectory", "attitude", "cm", "vehicles", "rotors", "clearance", "constraint_error",
    "constraint_force", "inputs",
)  # fmt: skip
#: Ends of pipes to the drawing processes that are prepared; none if they are taken.
_prepared: list[Connection] = []


def at_once() -> int:
    """How many figures can be drawn at the same time."""
    if "fork" not in multiprocessing.get_all_start_methods():
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def prepare() -> None:
    """Fork the first drawing process, which loads matplotlib beside whatever this process does next.

    To be called before this process computes anything: its threads and the kernel are not for forks.
    """
    forget()
    if at_once() == 1:
        return
    for name in ("rigidfleet.mission", "rigidfleet.plotting"):  # both processes need them
        import_module(name)
    # Ctrl-C is for this process alone, which ends the others. They inherit that the signal waits.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        context = multiprocessing.get_context("fork")
        pipes = [context.Pipe() for _ in range(min(at_once(), _MOST))]
        context.Process(target=_serve, args=(pipes,), daemon=True).start()
        for here, there in pipes:
            there.close()
            _prepared.append(here)
    except OSError:  # too many processes or open files
        return
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def forget() -> None:
    """Let drawing processes end that nobody has taken."""
    while _prepared:
        _prepared.pop().close()


class Drawings:
    """Figures of a flight: other processes begin to draw them at once; iteration writes each file when it is drawn.

    Where no process is prepared, iteration draws them. Leaving the context ends what still draws.

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
        self._processes: list[int] = []
        self._drawing = 0  # number of threads, each of which has a process
        if len(figures) >= _FEW and result.position.nbytes <= _LARGEST and _prepared:
            # The kernel, which evaluates the result, is loaded in this process alone.
            flight = pickle.dumps(result.evaluate())
            pipes = _prepared[: len(figures)]
            _prepared[: len(pipes)] = []
            self._drawing = len(pipes)
            for n, pipe in enumerate(pipes):
                given = None if n else (len(pipes), flight, titles)
                Thread(target=self._ask, args=(pipe, given), daemon=True).start()
        forget()

    def _ask(self, pipe: Connection, given: object) -> None:
        """Let a process of its own draw figures until none is left, or until it fails; give something to the first."""
        try:
            with pipe:
                if given is not None:
                    pipe.send(given)
                self._processes.append(pipe.recv())
                while self._asked:
                    path = self._asked.popleft()
                    pipe.send((path.name, self.figures[path]))
                    self._drawn.put((path, pipe.recv()))
        except (OSError, EOFError, IndexError):
            pass  # a process that has ended, or no figure left; the rest is drawn in this process
        finally:
            self._drawn.put(None)

    def __enter__(self) -> Drawings:
        return self

    def __exit__(self, *_: object) -> None:
        self._asked.clear()
        for process in self._processes if self._drawing else ():
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGTERM)

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


def _serve(pipes: Sequence[tuple[Connection, Connection]]) -> None:
    """Load matplotlib; once there is a flight, draw its figures, here and in forks of this process.

    Any error ends the process, without a word: what is wrong with a figure is told where it is drawn again.
    """
    with suppress(Exception):
        gc.disable()  # to collect takes a tenth of the time, and these processes end after some figures
        for here, _ in pipes:
            here.close()
        import_module("rigidfleet.cli.drawing_server")
        count, flight, titles = pipes[0][1].recv()
        flown = pickle.loads(flight)
        mine = next((n for n in range(1, count) if os.fork() == 0), 0)
        for n, (_, there) in enumerate(pipes):
            if n != mine:
                there.close()
        _draw(pipes[mine][1], flown, titles)


def _draw(asked: Connection, flown: Result, titles: bool) -> None:
    """Send this process' number, then the files of figures of a flight as their names and formats arrive."""
    from rigidfleet.plotting import rendered

    asked.send(os.getpid())
    while True:
        name, formats = asked.recv()
        asked.send(rendered(flown, name, formats, titles=titles))
