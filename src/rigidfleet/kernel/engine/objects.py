"""Objects of machine code: the processes that make them, this machine, and objects in one file."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rigidfleet.kernel.compiler.levels import HOST, KEY, target_instruction_level
from rigidfleet.kernel.engine.packing import OF_LARGE

#: The functions of each library of machine code, by name, with how many words they take: integers, or addresses of
#: named tuples. What they return is a word. Flights of points load the first library, those of vehicles the second,
#: too, those with avoidance the third, those with obstacles that move or are no plain boxes the fourth. Functions of
#: the solver of large formations take the address of their arguments, and return a double. Each is in its own object.
ENTRIES = {
    "flight": {
        "integrate": 4,  # problem, workspace, integrator, segment
        "record": 4,  # problem, workspace, segment, record
        "write_first_step_change_bounds": 3,  # problem, integrator, monitor
        "watch_trail_distances": 5,  # first, end, problem, integrator, monitor
        "watch_forces": 5,  # last, problem, workspace, integrator, monitor
        "measure": 1,
        "follow": 1,
    },
    "sampled": {"fly_ticks": 5},
    "avoidance": {"avoid": 4},  # flight, state, avoidance, 0
    "solids": {"watch_trail_clearances": 6},  # first, end, problem, integrator, monitor, solids
    "large": dict.fromkeys(OF_LARGE, 1),
}


def symbol_name(name: str) -> str:
    """Name of a function in machine code."""
    return f"rigidfleet_{name}"


#: Working folder of the compiling processes, as Numba reads settings from a file in its working folder.
ELSEWHERE = os.path.abspath(os.sep)


_BUILD = "import sys; sys.path[:] = sys.argv[1:]; from rigidfleet.kernel.engine import build; build.main({!r})"


_FLAGS = {"isolated": "-I", "ignore_environment": "-E", "no_user_site": "-s", "no_site": "-S"}


def build_command(part: str = "flight") -> list[str]:
    """Command of a process that compiles a part (see `build.main`), with the import path of this one.

    The current folder is left out.
    An interactive Python, or one started with ``-c``, has the current folder on its path as ``""``. This entry is
    removed; all other folders are kept, because the user chose them. The folder of this package comes last.
    """
    flags = [flag for name, flag in _FLAGS.items() if getattr(sys.flags, name)]
    path = [os.path.abspath(folder) for folder in sys.path if isinstance(folder, str) and folder]
    home = str(Path(__file__).resolve().parents[3])
    return [sys.executable, *flags, "-P", "-c", _BUILD.format(part), *path, home]


def shipped_object_path(cpu: str, digest: str) -> Path:
    """Where the package has the machine code of a level, made of sources with this digest."""
    return Path(__file__).with_name(f"{cpu}-{digest}.so")


def compile_objects(part: str, cpu: str) -> list[bytes] | None:
    """Objects of a part for a level, made by a process of its own; None if there can be no such process, or it fails.

    In that process Numba only translates. Otherwise it would optimise each function before all are optimised
    together, and take twice as long.
    """
    # Numba's coloured messages about the versions that it tries are suppressed.
    settings = {"NUMBA_OPT": "0", "NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}
    if cpu != HOST:
        settings[KEY] = cpu
    if sys.executable:
        with suppress(OSError):
            done = subprocess.run(
                build_command(part), env=os.environ | settings, cwd=ELSEWHERE, capture_output=True, check=False
            )  # fmt: skip
            if done.returncode == 0:
                return split_object_codes(done.stdout)
    return None


def target_machine() -> Any:
    """The target of the machine code: the level of this process, or this machine."""
    import llvmlite.binding as llvm  # loads the compiler

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    if (cpu := target_instruction_level()) != HOST:  # code that a linker takes, too
        return target.create_target_machine(cpu=cpu, opt=3, reloc="pic", codemodel="small")
    return target.create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=3, jit=True
    )  # fmt: skip


def pack_object_codes(parts: Sequence[bytes]) -> bytes:
    """Join objects, each after its length, with a digest, so that an incomplete file is never used."""
    code = b"".join(len(part).to_bytes(8, "little") + part for part in parts)
    return code + hashlib.sha256(code).digest()


def split_object_codes(data: bytes) -> list[bytes] | None:
    """Objects that `pack_object_codes` has packed; None if they are not whole."""
    code, digest = data[:-32], data[-32:]
    if not code or hashlib.sha256(code).digest() != digest:
        return None
    parts = []
    while code:
        end = 8 + int.from_bytes(code[:8], "little")
        parts.append(code[8:end])
        code = code[end:]
    return parts
