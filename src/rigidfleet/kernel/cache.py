"""Where compiled code is kept, and which of it is run: none that another user can have written.

Machine code and Numba's pickles do whatever whoever wrote them likes. They are kept, and read again, only in a folder
of this user (or of root) into which nobody else can put anything, not even by putting another folder in place of one
above it.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shlex
import stat
import sys
import tempfile
import threading
import warnings
from collections.abc import Generator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import IO

#: Whether rights are owners and modes. Windows has lists instead, which keep a user's own folders from others.
_OWNERS = hasattr(os, "geteuid")
#: As many links as Linux follows before it takes them for a loop.
_LINKS = 40
_ACL = "system.posix_acl_access"
#: Whether this process, or the one that began it, has warned.
told = threading.Event()


def cache_directory() -> Path:
    """Return the folder of the compiled kernel, made if need be: one per state of its sources, Numba and Python.

    It is in ``NUMBA_CACHE_DIR`` if that is set, else in ``XDG_CACHE_HOME`` or ``~/.cache``.

    Raises
    ------
    OSError
        It cannot be made, or others could put something there; ``strerror`` says where, and what to do.
    """
    return _private(_named())


def _named() -> Path:
    """The folder, as the environment names it."""
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(os.path.expanduser(base), "rigidfleet", f"kernel-{_digest()}")


@cache
def _digest() -> str:
    digest = hashlib.sha256(f"{version('numba')} {sys.version}".encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


@contextmanager
def opened(file: str | Path) -> Generator[IO[bytes]]:
    """A file of the cache, to be read: the very one that was looked at, wherever its name leads meanwhile.

    Raises
    ------
    OSError
        It is not there, or others could have written it.
    """

    def descriptor(path: str, flags: int) -> int:
        more = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
        return os.open(path, flags | more)

    with open(file, "rb", opener=descriptor) as stream:
        found = os.fstat(stream.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise PermissionError(errno.EACCES, f"{file} is no file")
        _refuse_foreign(file, found)
        _refuse_written_by_others(file, found)
        yield stream


@contextmanager
def replacing(file: str | Path) -> Generator[IO[bytes]]:
    """A new file for this user alone, which takes the place of the old one as soon as it is whole."""
    descriptor, part = tempfile.mkstemp(dir=Path(file).parent, prefix=".", suffix=".part")
    try:
        with open(descriptor, "wb") as stream:
            yield stream
        os.replace(part, file)
    except BaseException:
        with suppress(OSError):
            os.unlink(part)
        raise


def not_kept(error: OSError) -> None:
    """Warn that what is compiled cannot be kept; once, whatever the functions and reasons."""
    if not told.is_set():
        told.set()
        warnings.warn(
            f"the compiled flight kernel cannot be kept in {_named()}: {error.strerror or error}. Every process"
            " compiles it again, which takes about 15 s, until NUMBA_CACHE_DIR names a folder that you alone can write",
            RuntimeWarning,
            stacklevel=3,
        )


# -- who can write ------------------------------------------------------------------------------------


def _private(folder: Path) -> Path:
    """Return the real path of a folder into which nobody else can put anything; what is missing of it is made.

    Links are followed by hand, from the root down. Each folder on the way belongs to this user or root, and either
    nobody else can write to it, or its sticky bit keeps others from renaming what is not theirs; the next step is such
    a folder or link again. So nobody else can change where the way leads, neither before it is used nor after. To the
    last folder nobody else can write at all: a sticky bit would let them add to it.

    Raises
    ------
    OSError
    """
    if not folder.is_absolute():
        why = "the path is not absolute" if folder.parts[0] != "~" else "there is no home folder"
        raise FileNotFoundError(errno.ENOENT, why)
    if not _OWNERS:
        folder.mkdir(parents=True, exist_ok=True)
        return folder
    at, rest, links = Path("/"), list(folder.parts[:0:-1]), 0
    while True:
        found = os.lstat(at)
        if not stat.S_ISDIR(found.st_mode):
            raise NotADirectoryError(errno.ENOTDIR, f"{at} is no folder")
        _refuse_foreign(at, found)
        if not (rest and found.st_mode & stat.S_ISVTX):
            _refuse_written_by_others(at, found)
        if not rest:
            return at
        if (step := rest.pop()) == "..":
            at = at.parent
            continue
        there = at / step
        try:
            found = os.lstat(there)
        except FileNotFoundError:
            with suppress(FileExistsError):  # made by another process at this moment
                os.mkdir(there, 0o700)
            found = os.lstat(there)
        if stat.S_ISLNK(found.st_mode):
            _refuse_foreign(there, found)
            if (links := links + 1) > _LINKS:
                raise OSError(errno.ELOOP, f"{there} is a link that leads in a circle")
            target = Path(os.readlink(there))
            at = Path("/") if target.is_absolute() else at
            rest += reversed(target.parts[target.is_absolute() :])
        else:
            at = there


def _refuse_foreign(path: str | Path, found: os.stat_result) -> None:
    """Refuse what belongs to neither this user nor root."""
    if _OWNERS and found.st_uid not in (0, os.geteuid()):
        raise PermissionError(errno.EACCES, f"{path} belongs to another user")


def _refuse_written_by_others(path: str | Path, found: os.stat_result) -> None:
    """Refuse what others can write, if only those of a group."""
    mode = found.st_mode
    if _OWNERS and (mode & stat.S_IWOTH or (mode & stat.S_IWGRP and not _own_group(path, found))):
        why = f"others can write to {path}, which `chmod go-w {shlex.quote(str(path))}` ends"
        raise PermissionError(errno.EACCES, why)


def _own_group(path: str | Path, found: os.stat_result) -> bool:
    """Whether the group of a file has its owner alone.

    On systems that give each user a group of the same name, whatever a user makes may be writable for that group.
    """
    import grp
    import pwd

    with suppress(OSError, AttributeError):
        if _ACL in os.listxattr(
            path
        ):  # then the rights of the group are the most that anyone on the list has
            return False
    try:
        owner, group = pwd.getpwuid(found.st_uid), grp.getgrgid(found.st_gid)
    except KeyError:
        return False
    same = owner.pw_gid == group.gr_gid and owner.pw_name == group.gr_name
    return same and {owner.pw_name}.issuperset(group.gr_mem)
