"""Figures drawn side by side, by processes that load matplotlib while the flight is still computed.

They draw while the flight is saved and judged, or a sweep summarised; this process then writes the files. The first
process is a fork of this one before it has computed anything; the others are forks of the first, which has loaded
matplotlib and what is drawn. Where there are no forks (Windows), or one processor, or a very large result, figures are
drawn in this process; so is a figure whose process fails, as where the system ends it for its memory.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import signal
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from threading import Thread

from rigidfleet._common.processes import cores
from rigidfleet.errors import RigidfleetError

#: Contents of a figure's files by format, from its name and its formats; to be sent to other processes.
Draw = Callable[[str, Sequence[str]], dict[str, bytes]]
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
    return cores()


def check_width(width: float | None) -> None:
    """Raise an error if figures cannot have this width [mm]."""
    from rigidfleet.plotting import WIDTHS

    if width is not None and not WIDTHS[0] <= width <= WIDTHS[1]:
        raise RigidfleetError("--width must be {:g} to {:g} [mm], not {:g}.".format(*WIDTHS, width))


def prepare(*modules: str) -> None:
    """Fork the first drawing process, which loads matplotlib beside whatever this process does next.

    Both processes need the ``modules``, which are loaded before.

    To be called before this process computes anything: its threads and the kernel are not for forks.
    """
    forget()
    if at_once() == 1:
        return
    for name in ("rigidfleet.mission", "rigidfleet.plotting", *modules):
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
    """Figures: other processes begin to draw them at once; iteration gives each when it is drawn.

    Where no process is prepared, iteration draws them. Leaving the context ends what still draws.

    Parameters
    ----------
    figures : files without their suffix, and formats of each
    draw : draws one of them
    alone : whether this process draws all, as each drawing process holds a copy of what is drawn
    """

    def __init__(
        self, figures: Mapping[Path, Sequence[str]], draw: Draw, *, alone: bool = False
    ) -> None:
        self.figures, self._draw = figures, draw
        self._asked = deque(sorted(figures, key=lambda path: (*_SLOW, path.name).index(path.name)))
        #: A figure and its files by format; None when a process draws no more.
        self._drawn: SimpleQueue[tuple[Path, dict[str, bytes]] | None] = SimpleQueue()
        self._processes: list[int] = []
        self._drawing = 0  # number of threads, each of which has a process
        if len(figures) >= _FEW and not alone and _prepared:
            sent = pickle.dumps(draw)
            pipes = _prepared[: len(figures)]
            _prepared[: len(pipes)] = []
            self._drawing = len(pipes)
            for n, pipe in enumerate(pipes):
                given = None if n else (len(pipes), sent)
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

    def __iter__(self) -> Iterator[tuple[Path, dict[str, bytes]]]:
        """Paths of the figures without their suffix, and the contents of their files by format."""
        left = dict(self.figures)
        while self._drawing:
            if (found := self._drawn.get()) is None:
                self._drawing -= 1
                continue
            del left[found[0]]
            yield found
        for path, formats in left.items():
            yield path, self._draw(path.name, formats)


def _serve(pipes: Sequence[tuple[Connection, Connection]]) -> None:
    """Load matplotlib; once there is something to draw, draw its figures, here and in forks of this process.

    Any error ends the process, without a word: what is wrong with a figure is told where it is drawn again.
    """
    with suppress(Exception):
        gc.disable()  # to collect takes a tenth of the time, and these processes end after some figures
        for here, _ in pipes:
            here.close()
        import_module("rigidfleet.cli.drawing_server")
        count, sent = pipes[0][1].recv()
        draw = pickle.loads(sent)
        mine = next((n for n in range(1, count) if os.fork() == 0), 0)
        for n, (_, there) in enumerate(pipes):
            if n != mine:
                there.close()
        _answer(pipes[mine][1], draw)


def _answer(asked: Connection, draw: Draw) -> None:
    """Send this process' number, then the files of figures as their names and formats arrive."""
    asked.send(os.getpid())
    while True:
        asked.send(draw(*asked.recv()))
