"""The compiled kernel, called without the compiler.

`rigidfleet.kernel.engine.build` compiles the integrator, the recorder and the monitor once to machine code. The code is
stored in a cache and loaded from there, because importing Numba alone takes longer than flying most missions. It reads
and writes through addresses of named tuples, laid out as `rigidfleet.kernel.compiler.pointers` says.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import struct
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding as llvm
import numpy as np

from rigidfleet.kernel.compiler.cache import cache_directory, not_kept, opened, replacing, told
from rigidfleet.kernel.problem import (
    CONSTANT,
    ITERATED,
    OPEN,
    RIGID,
    ConstraintLaw,
    Control,
    Feedback,
    Motion,
    Problem,
    Reference,
    Vehicles,
    Workspace,
    graph,
    no_disturbance,
)
from rigidfleet.kernel.problem import workspace as kernel_workspace
from rigidfleet.kernel.records import (
    IntegratorState,
    Monitor,
    Record,
    Segment,
    integrator,
    monitor,
    recorder,
)
from rigidfleet.typing import Floats, Ints

#: Names of the machine code's functions. Their arguments are addresses: int64(problem, workspace, integrator, segment),
#: int64(problem, workspace, segment, record) and int64(problem, workspace, integrator, monitor). Each function is in
#: its own object.
ENTRIES = "rigidfleet_integrate", "rigidfleet_record", "rigidfleet_watch"


def integrate(
    problem: Problem,
    workspace: Workspace,
    state: IntegratorState,
    t_end: float,
    fresh: bool,
    times: Floats,
    samples: Floats,
    max_steps: int,
) -> int:
    """Integrate to ``t_end`` [s], see `rigidfleet.kernel.dopri5.integrate`."""
    segment = _pack(Segment(t_end, fresh, max_steps, times, samples, _NOTHING))
    return _call(_code().integrate, _packed(problem), _packed(workspace), _packed(state), segment)


def record(problem: Problem, workspace: Workspace, times: Floats, samples: Floats) -> Record:
    """Forces and references at states ``samples`` (K, n) at ``times`` (K,) [s]."""
    n, m = len(problem.vehicles.m), len(problem.graph.edges)
    out = recorder(len(times), n, m)
    segment = Segment(0.0, False, 0, times, samples, np.empty(samples.shape[1]))
    _call(_code().record, _packed(problem), _packed(workspace), _pack(segment), _pack(out))
    return out


class Watch:
    """A callable that finds the extremes of the steps in trails, see `rigidfleet.kernel.monitor.watch`."""

    def __init__(self, monitor: Monitor) -> None:
        # The recorder evaluates the law, at the monitor's own time and state.
        n = monitor.states.shape[1]
        segment = Segment(0.0, False, 0, monitor.time, monitor.states, np.empty(n))
        self._kept = _pack(segment), _pack(_UNRECORDED)
        self.monitor = monitor._replace(
            recorder=_code().recorder, segment=self._kept[0].address, record=self._kept[1].address
        )
        self._packed = _pack(self.monitor)

    def __call__(self, problem: Problem, workspace: Workspace, state: IntegratorState) -> int:
        """Monitor the steps; return what `rigidfleet.kernel.monitor.watch` returns."""
        packed = _packed(problem), _packed(workspace), _packed(state)
        return _call(_code().watch, *packed, self._packed)


def closed_loop(t: float, y: Floats, dy: Floats, problem: Problem, workspace: Workspace) -> None:
    """Right-hand side dy (n,) at time t [s] and state y (n,), see `rigidfleet.kernel.dynamics.closed_loop`."""
    segment = Segment(0.0, False, 0, np.array([t]), y.reshape(1, -1), dy)
    packed = _packed(problem), _packed(workspace), _pack(segment), _packed(_UNRECORDED)
    _call(_code().record, *packed)


def _call(function: Any, *packed: _Packed) -> int:
    return function(*(p.address for p in packed))


# -- named tuples as words ---------------------------------------------------------------------------


class _Packed(NamedTuple):
    """A named tuple as words, and the tuple itself, which keeps its arrays alive."""

    of: Any
    words: Ints
    address: int


class _Layout(NamedTuple):
    """Memory layout of a type of named tuple."""

    code: struct.Struct
    arrays: tuple[tuple[str, int], ...]  # kind of number and dimensions of each


def _flatten(x: Any, code: list[str], words: list[Any], arrays: list[tuple[str, int]]) -> None:
    """Append the words of a named tuple, their kinds, and those of its arrays."""
    for value in x:
        if isinstance(value, np.ndarray):
            if not value.flags.c_contiguous:
                raise TypeError("the kernel takes only C-contiguous arrays")
            code.append("q" * (1 + value.ndim))
            words += (value.__array_interface__["data"][0], *value.shape)
            arrays.append((value.dtype.char, value.ndim))
        elif isinstance(value, tuple):
            _flatten(value, code, words, arrays)
        elif isinstance(value, float):
            code.append("d")
            words.append(value)
        else:
            code.append("q")
            words.append(int(value))


def _pack(x: Any) -> _Packed:
    """Convert a named tuple to words.

    Raises
    ------
    TypeError
        Numbers or arrays are not of the types that the kernel is compiled for.
    """
    code: list[str] = []
    values: list[Any] = []
    arrays: list[tuple[str, int]] = []
    _flatten(x, code, values, arrays)
    layout = _layout(type(x))
    if tuple(arrays) != layout.arrays or "".join(code) != layout.code.format[1:]:
        raise TypeError(
            f"this {type(x).__name__} has arrays or numbers of types that the kernel does not take"
        )
    words = np.frombuffer(layout.code.pack(*values), dtype=np.int64)
    return _Packed(x, words, words.__array_interface__["data"][0])


class _Last(threading.local):
    """The last tuple of each type packed by a thread: flights call the kernel with the same ones repeatedly."""

    def __init__(self) -> None:
        self.packed: dict[type, _Packed] = {}


_last = _Last()


def _packed(x: Any) -> _Packed:
    found = _last.packed.get(type(x))
    if found is None or found.of is not x:
        found = _last.packed[type(x)] = _pack(x)
    return found


@cache
def _layout(kind: type) -> _Layout:
    code: list[str] = []
    arrays: list[tuple[str, int]] = []
    _flatten(next(x for x in examples() if isinstance(x, kind)), code, [], arrays)
    return _Layout(struct.Struct("=" + "".join(code)), tuple(arrays))


@cache
def examples() -> tuple[Problem, Workspace, IntegratorState, Segment, Record, Monitor]:
    """One minimal example of each named tuple; its fields have the types that all have."""
    one, none, places, frame = np.ones(1), np.zeros(0), np.zeros((1, 3)), np.eye(3)
    problem = Problem(
        body_formulation=False,
        has_frame=False,
        vehicles=Vehicles(one, one, 1.0, 1.0, one, False, 0.0),
        graph=graph(np.zeros((0, 2), dtype=np.int64), one),
        law=ConstraintLaw(0.0, 0.0, 0.0, ITERATED, 0.0, 0, 0.0, 0.0, 0.0),
        reference=Reference(CONSTANT, 0.0, 0.0, none, none, places, places, np.zeros(3)),
        motion=Motion(np.zeros(2), np.zeros((1, 6, 6)), frame),
        feedback=Feedback(
            none, np.zeros((0, 4)), np.zeros((0, 4)), 0.0, *np.zeros((2, 3)), frame, np.zeros(3), np.zeros(4)
        ),
        control=Control(OPEN, places, 0.0, 0.0, RIGID),
        external=0,
        disturbance=no_disturbance(one),
    )  # fmt: skip
    state = integrator(np.zeros(6), 0.0, rtol=0.0, atol=np.ones(6))
    segment = Segment(0.0, False, 0, none, np.zeros((0, 6)), none)
    nowhere = np.zeros((0, 6))
    watching = monitor(one, nowhere, nowhere, 6, 3)
    return problem, kernel_workspace(1, 0), state, segment, _UNRECORDED, watching


_NOTHING = np.zeros(0)
_UNRECORDED = recorder(0, 0, 0)


# -- machine code ------------------------------------------------------------------------------------


class _Code(NamedTuple):
    integrate: Any
    record: Any
    watch: Any
    recorder: int  # address of record
    engine: Any  # keeps the code alive
    unkept: list[bytes] | None  # objects that could not be stored in the cache


_loading = threading.Lock()
_loaded: list[_Code] = []


def _code() -> _Code:
    """The kernel's machine code: from the cache, or compiled."""
    if not _loaded:
        with _loading:
            if not _loaded:
                _loaded.append(_load())
    return _loaded[0]


def _load() -> _Code:
    if (parts := _read()) is not None:
        return _linked(parts)
    parts = _compile()
    return _linked(parts, None if _write(parts) else parts)


def _linked(parts: Sequence[bytes], unkept: list[bytes] | None = None) -> _Code:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target_machine())
    for part in parts:
        engine.add_object_file(llvm.ObjectFileRef.from_data(part))
    engine.finalize_object()
    kind = ctypes.CFUNCTYPE(ctypes.c_int64, *(ctypes.c_int64,) * 4)
    addresses = [engine.get_function_address(name) for name in ENTRIES]
    return _Code(*map(kind, addresses), addresses[1], engine, unkept)


class Inheritance(NamedTuple):
    """Code that a child process need not compile again, and warnings that it need not repeat."""

    code: list[bytes] | None
    told: bool


def bequeath() -> Inheritance:
    """Code of this process that its child processes cannot find in the cache; to be sent only to them."""
    return Inheritance(_loaded[0].unkept if _loaded else None, told.is_set())


def inherit(given: Inheritance) -> None:
    """Take over the code and warnings of the parent process."""
    if given.told:
        told.set()
    if given.code is not None:
        _loaded.append(_linked(given.code, given.code))


def _compile() -> list[bytes]:
    """Compile the kernel, in a separate process if possible.

    In that process Numba only translates. Otherwise it would optimise each function before all are optimised
    together, and take twice as long.
    """
    # Suppress Numba's coloured messages about the versions that it tries.
    quiet = {"NUMBA_OPT": "0", "NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}
    if sys.executable:
        with suppress(OSError):
            done = subprocess.run(
                build_process(), env=os.environ | quiet, cwd=ELSEWHERE, capture_output=True, check=False
            )  # fmt: skip
            if done.returncode == 0 and (parts := _separated(done.stdout)) is not None:
                return parts
    from rigidfleet.kernel.engine.build import machine_code

    return machine_code()


#: Working folder of the compiling processes, as Numba reads settings from a file in its working folder.
ELSEWHERE = os.path.abspath(os.sep)
_BUILD = "import sys; sys.path[:] = sys.argv[1:]; from rigidfleet.kernel.engine import build; build.main(half={})"
_FLAGS = {"isolated": "-I", "ignore_environment": "-E", "no_user_site": "-s", "no_site": "-S"}


def build_process(*, half: bool = False) -> list[str]:
    """Command of a compiling process, which has the import path of this one without the current folder.

    An interactive Python, or one started with ``-c``, has the current folder on its path as ``""``. This entry is
    removed; all other folders are kept, because the user chose them. The folder of this package comes last.
    """
    flags = [flag for name, flag in _FLAGS.items() if getattr(sys.flags, name)]
    path = [os.path.abspath(folder) for folder in sys.path if isinstance(folder, str) and folder]
    home = str(Path(__file__).resolve().parents[3])
    return [sys.executable, *flags, "-P", "-c", _BUILD.format(half), *path, home]


def target_machine() -> Any:
    """The target of the machine code: this machine."""
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=3, jit=True
    )  # fmt: skip


# -- the cache ---------------------------------------------------------------------------------------


def _file() -> Path:
    """The cache file of the machine code for this kind of machine.

    Raises
    ------
    OSError
        As `cache_directory` does.
    """
    machine = f"{llvm.get_process_triple()} {llvm.get_host_cpu_name()} {llvm.get_host_cpu_features().flatten()}"
    return cache_directory() / f"flight-{hashlib.sha256(machine.encode()).hexdigest()[:16]}.o"


def concatenated(parts: Sequence[bytes]) -> bytes:
    """Join objects, each after its length, with a digest, so that an incomplete file is never used."""
    code = b"".join(len(part).to_bytes(8, "little") + part for part in parts)
    return code + hashlib.sha256(code).digest()


def _separated(data: bytes) -> list[bytes] | None:
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


def _read() -> list[bytes] | None:
    """Machine code from the cache, if there is any that is safe to run."""
    try:
        with opened(_file()) as stream:
            return _separated(stream.read())
    except OSError:
        return None


def _write(parts: Sequence[bytes]) -> bool:
    """Store machine code in the cache, or warn that it will be compiled again."""
    try:
        with replacing(_file()) as stream:
            stream.write(concatenated(parts))
    except OSError as error:
        not_kept(error)
        return False
    return True


def is_compiled() -> bool:
    """Return whether the machine code is in the cache, so that nothing has to be compiled."""
    try:
        with opened(_file()):
            return True
    except OSError:
        return False
