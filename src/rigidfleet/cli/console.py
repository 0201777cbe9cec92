"""Output of the command: results on standard output, progress and errors on standard error.

Colours and animation are for terminals only. A file or a pipe is as wide as COLUMNS says, or else 80 columns.
"""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from functools import cache
from io import TextIOWrapper
from time import perf_counter
from typing import IO, TYPE_CHECKING, Any, Self

from rigidfleet.errors import MissionError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from rigidfleet.assessment import Verdict
    from rigidfleet.simulation.flight import Progress as FlightProgress
    from rigidfleet.sweep import SweepProgress

#: Time between lines of progress if there is no terminal for a progress bar [s].
_SELDOM = 10.0
#: Least time between pictures of a progress bar that no thread draws [s].
_OFTEN = 0.5
#: Time between lines of progress of a check [s].
_PATIENCE = 5.0
#: A flight reports its progress several times a second. Without a report for this time, it is compiling [s].
_SILENCE = 1.0
#: The speed of a flight is the mean of the last _RECENT seconds, shown after _KNOWN seconds. Speeds of phases differ
#: by a factor of a thousand, and planning a phase takes time.
_RECENT, _KNOWN = 10.0, 1.0
COMPILING = "Compiling the simulator (first run only, about half a minute)"


def out() -> Console:
    """Console for results."""
    return console(stderr=False)


def err() -> Console:
    """Console for progress and errors."""
    return console(stderr=True)


@cache
def console(*, stderr: bool) -> Console:
    """Return the shared console for standard output or error."""
    from rich.console import Console

    class Polite(Console):
        def on_broken_pipe(self) -> None:
            # The reader has closed the pipe, as `head` does: go on without output, the exit code still counts.
            self.quiet = True
            discard_output(self.file)

    shared = Polite(stderr=stderr, markup=False, highlight=False, emoji=False)
    if not shared.is_terminal and os.environ.get("COLUMNS", "") in ("", "0"):
        shared.width = 80  # however wide a terminal is that this process has beside its pipe
    return shared


def prepare_streams() -> None:
    """Open closed standard streams, and replace characters that a terminal lacks."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed by `>&-`
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
        elif isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # a character that the terminal lacks becomes "?"


def discard_output(stream: IO[str]) -> None:
    """Discard further output to a stream."""
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())


def print_exactly(text: str) -> None:
    """Print text for other programs: as UTF-8, without wrapping."""
    try:
        sys.stdout.flush()
        sys.stdout.buffer.write(text.encode())
        sys.stdout.buffer.flush()
    except BrokenPipeError:
        discard_output(sys.stdout)


def print_json(data: object) -> None:
    """Print data as JSON."""
    import json

    print_exactly(json.dumps(data, ensure_ascii=False, indent=2, default=str) + "\n")


def show_verdict(verdict: Verdict, *, json: bool = False, quiet: bool = False) -> None:
    """Print a verdict, as JSON or in words."""
    if json:
        print_json(verdict.to_dict())
    elif not quiet:
        out().print(verdict)


def print_error(error: object) -> None:
    """Print an error, or each finding of an error about a mission."""
    from rich.text import Text

    for finding in error.findings if isinstance(error, MissionError) else [error]:
        err().print(Text.assemble(("error: ", "bold red"), str(finding)), soft_wrap=True)


def warn(message: object, *_where: object) -> None:
    """Print a warning as one line, without its place in the source."""
    err().print(f"warning: {message}", style="yellow", soft_wrap=True, highlight=False)


class _Screen:
    """Progress display: animated on a terminal, otherwise a line from time to time."""

    animated = True  # by a thread of rich's

    def __init__(self) -> None:
        self.console = err()
        self.progress: Progress | None = None
        self.begun = self.shown_at = perf_counter()
        self.cold = False

    def __enter__(self) -> Self:
        if self.console.is_interactive:
            from rich import progress
            from rich.table import Column

            # The words change while nothing is heard, too: they are asked for whenever the screen is drawn.
            columns = (
                progress.SpinnerColumn(),
                progress.BarColumn(bar_width=30),
                progress.TaskProgressColumn(),
                progress.TextColumn("{task.fields[screen]}", markup=False, table_column=Column()),
            )
            look: dict[str, Any] = {"transient": True, "auto_refresh": self.animated}
            self.progress = progress.Progress(*columns, console=self.console, **look)
            self.task = self.progress.add_task("", total=None, screen=self)
            self.progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.progress is not None:
            self.progress.stop()

    def announce_compilation(self) -> None:
        """Announce that the simulator will be compiled, in several parts during the flight."""
        self.cold, self.begun = True, perf_counter()
        if self.progress is None:
            self.console.print(COMPILING)

    def __str__(self) -> str:
        """Text on a terminal: progress, or what is waited for before there is any."""
        text = COMPILING if self.cold else "Starting"
        return self._progress_text() or f"{text}: {perf_counter() - self.begun:.0f} s"

    def show_progress(self, total: float, done: float, now: float) -> None:
        """Show the progress; without animation as a line, if the last line was long ago."""
        if self.progress is not None:
            self.progress.update(self.task, total=total, completed=done)
            if not self.animated and now - self.shown_at > _OFTEN:
                self.shown_at = now
                self.progress.refresh()
        elif now - self.shown_at > _SELDOM:
            self.shown_at = now
            self.console.print(self._progress_text())

    def _progress_text(self) -> str:
        """Progress; nothing while it is waited for."""
        return ""


class CheckWatch:
    """Print the current step of a long check every few seconds; nothing for a short one."""

    def __init__(self, what: str) -> None:
        self.what, self.stage, self.begun = what, "reading", perf_counter()

    def __enter__(self) -> Self:
        self.done = threading.Event()
        self.thread = threading.Thread(target=self._announce_steps_until_done, daemon=True)
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.done.set()
        self.thread.join()

    def update(self, stage: str) -> None:
        """Set the current step."""
        self.stage = stage

    def _announce_steps_until_done(self) -> None:
        while not self.done.wait(_PATIENCE):
            text = f"Checking {self.what}: {self.stage}, {perf_counter() - self.begun:.0f} s"
            err().print(text, soft_wrap=True)


class FlightWatch(_Screen):
    """Progress display of a flight."""

    def __init__(self) -> None:
        super().__init__()
        self.heard = self.begun
        self.recent: deque[FlightProgress] = deque()

    def update(self, progress: FlightProgress) -> None:
        """Receive the progress of the flight."""
        now = perf_counter()
        if self.cold and now - self.heard > _SILENCE:
            self.recent.clear()  # measure the speed without the time of compiling
        self.recent.append(progress)
        self.heard = now
        self.show_progress(progress.t_end, progress.t, now)

    def _progress_text(self) -> str:
        """Mission time, speed relative to real time, time left, phase."""
        silence = perf_counter() - self.heard
        if not self.recent or (self.cold and silence > _SILENCE):
            return ""
        last = self.recent[-1]
        wall = last.wall + silence
        while len(self.recent) > 1 and self.recent[1].wall <= wall - _RECENT:
            self.recent.popleft()
        words = [f"{last.t:.1f} of {last.t_end:g} s"]
        took, flown = wall - self.recent[0].wall, last.t - self.recent[0].t
        if took >= _KNOWN and flown > 0.0 and last.t < last.t_end:
            speed = flown / took
            digits = ".0f" if speed >= 9.95 else ".1f" if speed >= 0.1 else ".1g"
            words += [f"x{speed:{digits}}", _time_left_text((last.t_end - last.t) / speed)]
        return "  ".join([*words, last.phase, *(["(planning)"] if last.planning else [])])


class SweepWatch(_Screen):
    """Progress display of a sweep, drawn as it goes on: workers may be forks, which want no thread."""

    animated = False

    def __init__(self) -> None:
        super().__init__()
        self.base: SweepProgress | None = None
        self.last: SweepProgress | None = None

    def update(self, progress: SweepProgress) -> None:
        """Receive the progress of the sweep."""
        before = 0 if self.last is None else self.last.flown
        if progress.flown > before and (self.base is None or self.base.workers != progress.workers):
            self.base = progress  # measure the rate of these workers without their start-up
        self.last = progress
        if self.base is not None:
            self.show_progress(progress.runs, progress.done, perf_counter())

    def _progress_text(self) -> str:
        """Finished runs, rate, time left, failures, workers."""
        if self.base is None or self.last is None:
            return ""
        p = self.last
        words = [f"{p.done} of {p.runs} runs"]
        if (wall := p.wall - self.base.wall) > 0 and (flown := p.flown - self.base.flown) > 0:
            rate = flown / wall
            words += [f"{rate:.3g} runs/s", _time_left_text((p.runs - p.done) / rate)]
        words += [f"{p.failed} failed"] if p.failed else []
        words += [f"{count_text(p.workers, 'worker')}"] if p.workers > 1 else []
        return "  ".join(words)


def _time_left_text(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02} left"


def count_text(n: int, noun: str) -> str:
    """Number and noun, in the plural unless the number is 1."""
    return f"{n} {noun}{'' if n == 1 else 's'}"
