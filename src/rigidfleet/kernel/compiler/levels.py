"""Levels of x86-64: sets of instructions that many machines share, for each of which machine code is made.

Bits of a flight belong to a level: sums are grouped by the width of vectors, and products fused where a level can.
"""

from __future__ import annotations

import os
import platform
import sys
from functools import cache
from itertools import takewhile
from pathlib import Path

from rigidfleet.errors import RigidfleetError

#: What a processor must have for each level, beside what the lower one needs, in the words of Linux.
_NEEDS = {
    "x86-64-v3": {"abm", "avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe", "xsave"},
    "x86-64-v4": {"avx512bw", "avx512cd", "avx512dq", "avx512f", "avx512vl"},
}
#: The levels for which the wheel has code; processors without the first are from before 2013, or the cheapest.
LEVELS = tuple(_NEEDS)
#: In place of a level where none is known: this very machine, whatever it has.
HOST = "host"
#: The variable of the environment that fixes the level.
KEY = "RIGIDFLEET_LEVEL"
#: What keeps OpenBLAS and NumPy to a level below the machine's highest, if set before they are loaded: they choose
#: code by processor, too. NumPy passes over names that only other
#: versions of it know, with a warning.
LIBRARY_SETTINGS = {
    "x86-64-v3": {
        "OPENBLAS_CORETYPE": "Haswell",
        "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512F AVX512_SKX AVX512_ICL AVX512_SPR",
    }
}


@cache
def machine_instruction_levels() -> tuple[str, ...]:
    """The levels that this machine runs, the lowest first; none where there are no levels."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return ()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # a container without /proc
        return ()
    has = next((set(line.split()) for line in lines if line.startswith("flags")), set[str]())
    return tuple(takewhile(lambda name: _NEEDS[name] <= has, _NEEDS))


def target_instruction_level() -> str:
    """The level to compile for: that which the environment fixes, or the highest that the machine runs, or `HOST`."""
    return os.environ.get(KEY) or (HOST, *machine_instruction_levels())[-1]


def runnable_instruction_level() -> str:
    """`target_instruction_level`, to run code of it.

    Raises
    ------
    RigidfleetError
        The environment fixes a level that is unknown, or that this machine cannot run.
    """
    runs = machine_instruction_levels() or (HOST,)
    if (chosen := target_instruction_level()) not in runs:
        raise RigidfleetError(
            f"{KEY}: this machine cannot run {chosen!r}. Choose {' or '.join(runs)}, or unset it."
        )
    return chosen
