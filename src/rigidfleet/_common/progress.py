"""What a long computation is doing, for whoever shows it."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from contextvars import ContextVar

_watcher: ContextVar[Callable[[str], None] | None] = ContextVar("watcher", default=None)


@contextmanager
def report_steps_to(update: Callable[[str], None]) -> Generator[None]:
    """Let ``update`` hear of each step that is reported in this context."""
    before = _watcher.set(update)
    try:
        yield
    finally:
        _watcher.reset(before)


def report_step(step: str) -> None:
    """Say what is done next, in words."""
    if (update := _watcher.get()) is not None:
        update(step)
