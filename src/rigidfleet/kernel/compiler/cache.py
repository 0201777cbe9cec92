"""The cache of compiled code, which never runs code that another user may have written.

Machine code and Numba's pickles can do whatever their author likes. They are stored and read only in a folder that this
user alone can write. Code that came with the package (`objects.shipped_object_path`) needs none.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shlex
import stat
import sys
import threading
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import IO

#: Whether this process has warned already.
warned = threading.Event()


def cache_directory() -> Path:
    """Return the folder of the compiled kernel, created if needed: one per version of its sources, Numba and Python.

    The folder is in ``NUMBA_CACHE_DIR`` if that is set, otherwise where this system keeps a user's caches.

    Raises
    ------
    OSError
        The folder cannot be created, or others could write into it; ``strerror`` says where, and what to do.
    """
    folder = _kernel_cache_folder()
    if not folder.is_absolute():
        why = "the path is not absolute" if folder.parts[0] != "~" else "there is no home folder"
        raise FileNotFoundError(errno.ENOENT, why)
    folder.parent.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    # Nobody else can write the outer folder, and so nobody can put another one in place of the inner.
    for own in folder.parent, folder:
        own.mkdir(mode=0o700, exist_ok=True)
        _refuse_unsafe(own, os.lstat(own))
    return folder


def _kernel_cache_folder() -> Path:
    """The folder named by the environment."""
    bases = (os.environ.get(x) for x in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "LOCALAPPDATA"))
    base = next(filter(None, bases), "~/.cache")
    return Path(os.path.expanduser(base), "rigidfleet", f"kernel-{_cache_digest()}")


@cache
def sources_digest() -> str:
    """Digest of the sources that are compiled."""
    digest = hashlib.sha256()
    kernel = Path(__file__).parents[1]
    for folder in kernel, kernel.parent / "solids":
        for source in sorted(folder.rglob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


@cache
def _cache_digest() -> str:
    made_by = f"{sources_digest()} {version('numba')} {sys.version}"
    return hashlib.sha256(made_by.encode()).hexdigest()[:16]


@contextmanager
def open_for_reading(file: str | Path) -> Generator[IO[bytes]]:
    """Open a file of the cache for reading: exactly the file that was checked, even if its name is changed meanwhile.

    Raises
    ------
    OSError
        It is not there, or others could have written it.
    """

    def open_descriptor(path: str, flags: int) -> int:
        more = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
        return os.open(path, flags | more)

    with open(file, "rb", opener=open_descriptor) as stream:
        state = os.fstat(stream.fileno())
        if not stat.S_ISREG(state.st_mode):
            raise PermissionError(errno.EACCES, f"{file} is not a file")
        _refuse_unsafe(file, state)
        yield stream


def warn_not_cached(error: OSError) -> None:
    """Warn once that compiled code cannot be cached, whatever the function and reason."""
    if not warned.is_set():
        warned.set()
        warnings.warn(
            f"compiled code cannot be cached in {_kernel_cache_folder()}: {error.strerror or error}. Every process"
            " compiles again what rigidfleet was not installed with. Set NUMBA_CACHE_DIR to a folder that only you can"
            " write",
            RuntimeWarning,
            stacklevel=3,
        )


def _refuse_unsafe(path: str | Path, state: os.stat_result) -> None:
    """Refuse a link, and what belongs to another user, or what others can write.

    Windows has access lists instead of owners and modes; they protect a user's own folders.

    Raises
    ------
    PermissionError
    """
    if stat.S_ISLNK(state.st_mode):
        raise PermissionError(errno.EACCES, f"{path} is a link")
    if not hasattr(os, "geteuid"):
        return
    if state.st_uid != os.geteuid():
        raise PermissionError(errno.EACCES, f"{path} belongs to another user")
    if state.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        remedy = f"`chmod go-w {shlex.quote(str(path))}`"
        raise PermissionError(errno.EACCES, f"others can write to {path}; forbid it with {remedy}")
