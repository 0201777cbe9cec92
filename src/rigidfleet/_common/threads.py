"""Threads of BLAS."""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

_lock = threading.Lock()
#: How many threads of this process are within `single_blas_thread`, with the limit that the first one set.
_inside: list[Any] = []


@contextmanager
def single_blas_thread() -> Generator[None]:
    """Let BLAS, as far as it is loaded, take one thread; of several threads that ask, until the last one leaves.

    Its threads wait actively: where other processes run, a design of 30 takes up to six times the processor time.
    """
    from threadpoolctl import threadpool_limits  # takes long to load

    with _lock:
        _inside.append(_inside[0] if _inside else threadpool_limits(1, user_api="blas"))
    try:
        yield
    finally:
        with _lock:
            limit = _inside.pop()
            if not _inside:
                limit.restore_original_limits()
