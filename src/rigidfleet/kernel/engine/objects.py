"""Objects of machine code: the processes that make them, this machine, and objects in one file."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm

#: Names of the machine code's functions. Their arguments are addresses: int64(problem, workspace, integrator, segment),
#: int64(problem, workspace, segment, record) and int64(problem, workspace, integrator, monitor); int64(measured),
#: int64(spectrum), int64(nearest), int64(recursion) and int64(objects, count, asked, words). Each function is in its
#: own object. The last one is the first for three agents with three edges.
ENTRIES = (
    "rigidfleet_integrate", "rigidfleet_record", "rigidfleet_watch", "rigidfleet_measure", "rigidfleet_spectrum",
    "rigidfleet_nearest", "rigidfleet_follow", "rigidfleet_gather", "rigidfleet_integrate_three",
)  # fmt: skip
#: Those of the second library: int64(problem, workspace, flight, state, segment) and int64(flight, evaluation).
SAMPLED_ENTRIES = "rigidfleet_fly_ticks", "rigidfleet_evaluate"
#: That of the third library, avoidance in flight: int64(flight, state, avoidance, 0).
AVOIDANCE_ENTRY = "rigidfleet_avoid"


#: Working folder of the compiling processes, as Numba reads settings from a file in its working folder.
ELSEWHERE = os.path.abspath(os.sep)


_BUILD = "import sys; sys.path[:] = sys.argv[1:]; from rigidfleet.kernel.engine import build; build.main({!r})"


_FLAGS = {"isolated": "-I", "ignore_environment": "-E", "no_user_site": "-s", "no_site": "-S"}


def build_process(part: str = "flight") -> list[str]:
    """Command of a process that compiles a part (see `build.main`), with the import path of this one.

    The current folder is left out.
    An interactive Python, or one started with ``-c``, has the current folder on its path as ``""``. This entry is
    removed; all other folders are kept, because the user chose them. The folder of this package comes last.
    """
    flags = [flag for name, flag in _FLAGS.items() if getattr(sys.flags, name)]
    path = [os.path.abspath(folder) for folder in sys.path if isinstance(folder, str) and folder]
    home = str(Path(__file__).resolve().parents[3])
    return [sys.executable, *flags, "-P", "-c", _BUILD.format(part), *path, home]


def target_machine() -> Any:
    """The target of the machine code: this machine."""
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=3, jit=True
    )  # fmt: skip


def concatenated(parts: Sequence[bytes]) -> bytes:
    """Join objects, each after its length, with a digest, so that an incomplete file is never used."""
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
