"""Controllers and laws of users in sweeps: imported by name, so that every worker can."""

from __future__ import annotations

import hashlib
import sys
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any

#: Remedy if a controller cannot be imported.
REMEDY = (
    "write MODULE:NAME of a function, or of a class without arguments, in a module that is installed, in the current"
    " folder, or beside the sweep file"
)


def add_module_folder(folder: str | Path) -> None:
    """Search a folder for modules, after all others: it hides none."""
    if (place := str(Path(folder).resolve())) not in sys.path:
        sys.path.append(place)


def import_law_and_digest(name: str) -> tuple[Any, str]:
    """The function or class of a name MODULE:NAME, and a digest of the file of its module.

    Raises
    ------
    ImportError
        There is none, its module fails, or no controller can be made of the class. The message says why.
    """
    module, _, inside = name.partition(":")
    add_module_folder("")
    try:
        there = import_module(module)
        law = attrgetter(inside)(there)
        controller = law() if isinstance(law, type) else law
        code = Path(there.__file__ or "").read_bytes()
    except (Exception, SystemExit) as error:  # it runs a user's code
        raise ImportError(
            f"{name!r} cannot be imported: {type(error).__name__}: {error}"
        ) from error
    if not callable(controller):
        raise ImportError(f"{name!r} is {controller!r}, which cannot be called")
    return law, hashlib.sha256(code).hexdigest()
