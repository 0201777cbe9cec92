"""Files written whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from rigidfleet.errors import ResultError


@contextmanager
def replacing(path: str | Path, *, private: bool = False) -> Generator[IO[bytes]]:
    """A new file that takes the place of the old one as soon as it is whole; ``private``: for this user alone.

    Raises
    ------
    OSError
        It cannot be written; the old file is as it was.
    """
    target = Path(os.path.realpath(path))  # through a symbolic link, not in place of it
    if target.is_dir():
        raise IsADirectoryError
    part = target.with_name(f".{target.name[:200]}.{secrets.token_hex(4)}.part")
    mode = 0o600 if private else 0o666
    try:
        with open(part, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, target)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def write_file(path: Path, data: bytes) -> None:
    """Write a file whole or not at all.

    Raises
    ------
    ResultError
        It cannot be written; the message says why and what to do.
    """
    try:
        with replacing(path) as file:
            file.write(data)
    except OSError as error:
        raise ResultError(f"{path}: {why_not(error, 'written', path)}") from error


def why_not(error: OSError, done: str, path: Path) -> str:
    """Why a file could not be ``done`` ("read", "written"), and what to do."""
    match error:
        case IsADirectoryError():
            return "is a folder. Name a file."
        case FileNotFoundError() | NotADirectoryError():
            return f"cannot be {done}: there is no folder {path.parent}. Make it first."
        case PermissionError():
            return f"may not be {done} by you. Choose another folder, or ask for permission."
    return f"cannot be {done}: {error.strerror or error}. Choose another place."
