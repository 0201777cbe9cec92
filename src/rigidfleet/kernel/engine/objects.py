"""Objects of machine code: the processes that make them, this machine, and objects in one file."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm

#: What the machine code is called, its arguments being addresses: int64(problem, workspace, integrator, segment),
#: int64(problem, workspace, segment, record) and int64(problem, workspace, integrator, monitor). Each comes in an
#: object of its own.
ENTRIES = "rigidfleet_integrate", "rigidfleet_record", "rigidfleet_watch"


#: Where the processes that compile are: Numba takes settings from a file that it finds where it is.
ELSEWHERE = os.path.abspath(os.sep)


_BUILD = "import sys; sys.path[:] = sys.argv[1:]; from rigidfleet.kernel.engine import build; build.main(half={})"


_FLAGS = {"isolated": "-I", "ignore_environment": "-E", "no_user_site": "-s", "no_site": "-S"}


def build_process(*, half: bool = False) -> list[str]:
    """Command of a process that compiles: it imports what this one would, but nothing from the current folder.

    An interactive Python, or one given its code by ``-c``, has the current folder on its path as ``""``. That goes;
    any other folder on the path has been asked for. Last comes the one that this package is from.
    """
    flags = [flag for name, flag in _FLAGS.items() if getattr(sys.flags, name)]
    path = [os.path.abspath(folder) for folder in sys.path if isinstance(folder, str) and folder]
    home = str(Path(__file__).resolve().parents[3])
    return [sys.executable, *flags, "-P", "-c", _BUILD.format(half), *path, home]


def target_machine() -> Any:
    """What machine code is made for: this machine."""
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=3, jit=True
    )  # fmt: skip


def concatenated(parts: Sequence[bytes]) -> bytes:
    """Objects in one, each after its length, and their digest, so that half of them is never called."""
    code = b"".join(len(part).to_bytes(8, "little") + part for part in parts)
    return code + hashlib.sha256(code).digest()


def separated(data: bytes) -> list[bytes] | None:
    """Objects that were `concatenated`; None if they are not whole."""
    code, digest = data[:-32], data[-32:]
    if not code or hashlib.sha256(code).digest() != digest:
        return None
    parts = []
    while code:
        end = 8 + int.from_bytes(code[:8], "little")
        parts.append(code[8:end])
        code = code[end:]
    return parts
