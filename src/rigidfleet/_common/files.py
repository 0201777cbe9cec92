"""Write files without ever leaving a partial one."""

from __future__ import annotations

import os
import re
import secrets
import shutil
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from rigidfleet.errors import ResultError


@contextmanager
def replace_atomically(path: str | Path, *, private: bool = False) -> Generator[IO[bytes]]:
    """Open a new file that replaces the old one once all data are written.

    Parameters
    ----------
    path : path of the file
    private : whether only this user can read it: a file of a cache, which need not outlive a power failure, and
        replaces even a pipe

    Raises
    ------
    OSError
        The file cannot be written. An old file is unchanged.
    """
    target = Path(os.path.realpath(path))  # replaces the target of a symbolic link, not the link
    if target.is_dir():
        raise IsADirectoryError
    if not private and os.path.exists(path) and not os.path.isfile(path):
        raise OSError("it is a device or a pipe")  # which a new file would remove
    part = target.with_name(f".{target.name[:200]}.{secrets.token_hex(4)}.part")
    mode = 0o600 if private else 0o666
    try:
        with open(part, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            yield file
            file.flush()
            if not private:
                os.fsync(file.fileno())
        os.replace(part, target)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


@contextmanager
def replace_folder_atomically(path: Path, ours: re.Pattern[str]) -> Generator[Path]:
    """Make a new folder that replaces the old one once all its files are written.

    Parameters
    ----------
    path : path of the folder
    ours : names of the files that an old folder may hold; one that holds others is not replaced

    Raises
    ------
    ResultError
        The folder cannot be written, or holds other files. It is unchanged.
    """
    target = Path(os.path.realpath(path))
    token = secrets.token_hex(4)
    part, old = (target.with_name(f".{target.name[:200]}.{token}.{end}") for end in ("part", "old"))
    try:
        if target.exists():
            if not target.is_dir():
                raise ResultError(f"{path}: is a file. Give the path of a folder.")
            if foreign := [x.name for x in target.iterdir() if not ours.fullmatch(x.name)]:
                why = f"holds other files ({min(foreign)}), which are kept"
                raise ResultError(f"{path}: {why}. Choose a new folder.")
        target.parent.mkdir(parents=True, exist_ok=True)
        part.mkdir()
        yield part
        if target.exists():
            target.rename(old)
        part.rename(target)
    except OSError as error:
        raise ResultError(f"{path}: {os_error_in_words(error, 'written', path)}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
        if old.exists() and not target.exists():
            old.rename(target)
        shutil.rmtree(old, ignore_errors=True)


def write_file(path: Path, data: bytes, *, parents: bool = False) -> None:
    """Write a file without ever leaving a partial one, if wanted with the folders above it.

    Raises
    ------
    ResultError
        The file cannot be written. The message has the cause and the remedy.
    """
    try:
        if parents:
            path.parent.mkdir(parents=True, exist_ok=True)
        with replace_atomically(path) as file:
            file.write(data)
    except OSError as error:
        raise ResultError(f"{path}: {os_error_in_words(error, 'written', path)}") from error


def make_folder(folder: Path) -> None:
    """Create a folder, and those above it, if it does not exist.

    Raises
    ------
    ResultError
        The folder cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable_error(folder, error) from error


def unwritable_error(path: Path, error: OSError) -> ResultError:
    """Error about a folder that cannot be written."""
    why = (error.strerror or str(error)).lower()
    return ResultError(f"{path}: cannot be written ({why}). Choose another folder by --out.")


def os_error_in_words(error: OSError, done: str, path: Path) -> str:
    """Cause and remedy of a file that cannot be ``done`` ("read", "written")."""
    match error:
        case IsADirectoryError():
            return "is a folder. Give the path of a file."
        case FileNotFoundError() | NotADirectoryError() if done == "read":
            return "no such file. Check the path."
        case FileNotFoundError() | NotADirectoryError():
            return f"cannot be {done}: there is no folder {path.parent}. Create it first."
        case PermissionError():
            return f"cannot be {done}: permission denied. Choose another folder or change the permissions."
    return f"cannot be {done}: {error.strerror or error}. Choose another place."
