"""The cache of compiled code, which never runs code that another user may have written.

Machine code and Numba's pickles can do whatever their author likes. They are stored and read only in a folder of this
user (or of root) into which nobody else can put anything, not even by replacing a folder above it.
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
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import IO

#: Whether permissions are owners and modes. Windows has access lists instead, which protect a user's own folders.
_OWNERS = hasattr(os, "geteuid")
#: Greatest number of links followed, as in Linux; more count as a loop.
_LINKS = 40
_ACL = "system.posix_acl_access"
#: Whether this process or its parent has warned already.
warned = threading.Event()


def cache_directory() -> Path:
    """Return the folder of the compiled kernel, created if needed: one per version of its sources, Numba and Python.

    The folder is in ``NUMBA_CACHE_DIR`` if that is set, otherwise in ``XDG_CACHE_HOME`` or ``~/.cache``.

    Raises
    ------
    OSError
        The folder cannot be created, or others could write into it; ``strerror`` says where, and what to do.
    """
    return _private(_environment_folder())


def _environment_folder() -> Path:
    """The folder named by the environment."""
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(os.path.expanduser(base), "rigidfleet", f"kernel-{_digest()}")


@cache
def _digest() -> str:
    digest = hashlib.sha256(f"{version('numba')} {sys.version}".encode())
    kernel = Path(__file__).parents[1]
    for folder in kernel, kernel.parent / "solids":  # compiled, too
        for source in sorted(folder.rglob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


@contextmanager
def open_safely(file: str | Path) -> Generator[IO[bytes]]:
    """Open a file of the cache for reading: exactly the file that was checked, even if its name is changed meanwhile.

    Raises
    ------
    OSError
        It is not there, or others could have written it.
    """

    def descriptor(path: str, flags: int) -> int:
        more = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
        return os.open(path, flags | more)

    with open(file, "rb", opener=descriptor) as stream:
        state = os.fstat(stream.fileno())
        if not stat.S_ISREG(state.st_mode):
            raise PermissionError(errno.EACCES, f"{file} is not a file")
        _refuse(file, state)
        yield stream


def not_kept(error: OSError) -> None:
    """Warn once that compiled code cannot be cached, whatever the function and reason."""
    if not warned.is_set():
        warned.set()
        warnings.warn(
            f"the compiled flight kernel cannot be cached in {_environment_folder()}: {error.strerror or error}. Every"
            " process compiles it again, which takes about 20 s. Set NUMBA_CACHE_DIR to a folder that only you can"
            " write",
            RuntimeWarning,
            stacklevel=3,
        )


# -- who can write ------------------------------------------------------------------------------------


def _private(folder: Path) -> Path:
    """Return the real path of a folder into which nobody else can put anything; create it if it is missing.

    Links are followed by hand from the root, whose owner can do anything anyway. For each folder on the path, either
    nobody else can write to it, or its sticky bit keeps others from renaming what is not theirs. The next item, folder
    or link, belongs to this user or root. So nobody else can change where the path leads, neither before nor after it
    is used. Nobody else can write to the last folder at all; with a sticky bit, others could still add to it.

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
    while rest:
        here = os.lstat(at)
        shared = _others_write(at, here)
        if shared and not here.st_mode & stat.S_ISVTX:
            raise _open_to_others(at)
        if (step := rest.pop()) == "..":
            at = at.parent
            continue
        there = at / step
        try:
            state = os.lstat(there)
        except FileNotFoundError:
            with suppress(FileExistsError):  # made by another process at this moment
                os.mkdir(there, 0o700)
            state = os.lstat(there)
        if not (_own(state) or (state.st_uid == _overflow_user() and not shared)):
            raise _foreign(there)
        if stat.S_ISLNK(state.st_mode):
            if (links := links + 1) > _LINKS:
                raise OSError(errno.ELOOP, f"{there} is a circular link")
            target = Path(os.readlink(there))
            at = Path("/") if target.is_absolute() else at
            rest += reversed(target.parts[target.is_absolute() :])
        elif stat.S_ISDIR(state.st_mode):
            at = there
        else:
            raise NotADirectoryError(errno.ENOTDIR, f"{there} is not a folder")
    _refuse(at, os.lstat(at))
    return at


def _refuse(path: str | Path, state: os.stat_result) -> None:
    """Refuse a file, or the last folder, if others have written it or can write it.

    Raises
    ------
    PermissionError
    """
    if not _own(state):
        raise _foreign(path)
    if _others_write(path, state):
        raise _open_to_others(path)


def _foreign(path: str | Path) -> OSError:
    return PermissionError(errno.EACCES, f"{path} belongs to another user")


def _open_to_others(path: str | Path) -> OSError:
    remedy = f"`chmod go-w {shlex.quote(str(path))}`"
    return PermissionError(errno.EACCES, f"others can write to {path}; forbid it with {remedy}")


def _own(state: os.stat_result) -> bool:
    """Whether something belongs to this user or to root."""
    return not _OWNERS or state.st_uid in (0, os.geteuid())


@cache
def _overflow_user() -> int | None:
    """The user id that stands for all users without an id here, including the machine's root; None if all have one.

    This happens in containers of ordinary users, such as Apptainer's. On the path to the last folder, items of such an
    owner count as root's if they are in a folder that others cannot write. The last folder must be this user's.
    """
    try:
        first, _, count = Path("/proc/self/uid_map").read_text().split()[:3]
        nobody = int(Path("/proc/sys/kernel/overflowuid").read_text())
    except (OSError, ValueError):
        return None
    return None if (int(first), int(count)) == (0, 2**32 - 1) else nobody


def _others_write(path: str | Path, state: os.stat_result) -> bool:
    """Whether others can write an item, even if only members of a group."""
    if not _OWNERS:
        return False
    mode = state.st_mode
    return bool(mode & stat.S_IWOTH or (mode & stat.S_IWGRP and not _own_group(path, state)))


def _own_group(path: str | Path, state: os.stat_result) -> bool:
    """Whether the owner of a file is the only member of its group.

    On systems that give each user a group of the same name, a user's files may be writable for that group.
    """
    import grp
    import pwd

    with suppress(OSError, AttributeError):
        if _ACL in os.listxattr(
            path
        ):  # with an access list, the group's rights are the upper limit for everyone on it
            return False
    try:
        owner, group = pwd.getpwuid(state.st_uid), grp.getgrgid(state.st_gid)
    except KeyError:
        return False
    same = owner.pw_gid == group.gr_gid and owner.pw_name == group.gr_name
    return same and {owner.pw_name}.issuperset(group.gr_mem)
