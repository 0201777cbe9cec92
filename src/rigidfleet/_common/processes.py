"""Processes that are started by this one."""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager


def usable_core_count() -> int:
    """Number of cores that this process may use."""
    usable = getattr(os, "sched_getaffinity", None)
    return len(usable(0)) if usable is not None else os.cpu_count() or 1


@contextmanager
def set_python_safe_path() -> Generator[None]:
    """Keep the current folder off the module path of Python processes that are started in this context."""
    name = "PYTHONSAFEPATH"
    before = os.environ.get(name)
    os.environ[name] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
