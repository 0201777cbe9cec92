"""The compiled kernel, called without the compiler.

Importing Numba alone takes longer than flying most missions. So the wheel has machine code of the integrator, the
recorder and the monitor, made of the same sources: a shared object for each level of x86-64. Where there is none,
`rigidfleet.kernel.engine.build` compiles them once, into a cache. The code reads and writes through addresses of named
tuples, laid out as `rigidfleet.kernel.compiler.pointers` says.
"""

from __future__ import annotations

import ctypes
import hashlib
import threading
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from rigidfleet._common.files import replace_atomically
from rigidfleet.errors import RigidfleetError
from rigidfleet.kernel.compiler.cache import (
    cache_directory,
    open_for_reading,
    sources_digest,
    warn_not_cached,
)
from rigidfleet.kernel.compiler.levels import (
    HOST,
    runnable_instruction_level,
    target_instruction_level,
)
from rigidfleet.kernel.engine.objects import (
    ENTRIES,
    compile_objects,
    pack_object_codes,
    shipped_object_path,
    split_object_codes,
    symbol_name,
    target_machine,
)
from rigidfleet.kernel.engine.packing import (
    NOTHING,
    OF_LARGE,
    UNRECORDED,
    Packed,
    pack,
    pack_uncached,
)
from rigidfleet.kernel.measured import Measured
from rigidfleet.kernel.problem import Problem, Workspace
from rigidfleet.kernel.records import (
    IntegratorState,
    Monitor,
    Record,
    Recursion,
    Segment,
    new_record,
)
from rigidfleet.solids.records import Solids
from rigidfleet.typing import Floats


class Integration:
    """An integration to ``t_end`` [s] in parts: a callable that does some steps; see `rigidfleet.kernel.dopri5`."""

    def __init__(
        self,
        problem: Problem,
        workspace: Workspace,
        state: IntegratorState,
        t_end: float,
        times: Floats,
        samples: Floats,
    ) -> None:
        self._segment = pack_uncached(Segment(t_end, False, 0, times, samples, NOTHING))
        self._kept = pack(problem), pack(workspace), pack(state), self._segment
        self._addresses = [x.address for x in self._kept]
        self._integrate = library().integrate

    def __call__(self, fresh: bool, max_steps: int) -> int:
        """Do at most so many steps; ``fresh`` as in `Segment`. Returns what `dopri5.integrate` returns."""
        self._segment.words[1], self._segment.words[2] = int(fresh), max_steps
        return self._integrate(*self._addresses)


def record(problem: Problem, workspace: Workspace, times: Floats, samples: Floats) -> Record:
    """Forces and references at states ``samples`` (K, n) at ``times`` (K,) [s]."""
    out = new_record(len(times), len(problem.vehicles.m), len(problem.graph.edges))
    record_into(pack_uncached(out), 0, pack(problem), workspace, times, samples)
    return out


def record_into(
    out: Packed, first: int, problem: Packed, workspace: Workspace, times: Floats, samples: Floats
) -> None:
    """`record` into a `Record` from row ``first`` on; it and the problem are packed."""
    segment = Segment(0.0, False, 0, times, samples, np.empty(samples.shape[1]), first)
    _call_packed(library().record, problem, pack(workspace), pack_uncached(segment), out)


class Watch:
    """Finds the extremes of the steps in trails, see `rigidfleet.kernel.monitor`."""

    def __init__(self, monitor: Monitor) -> None:
        # The recorder evaluates the law, at the monitor's own time and state.
        n = monitor.states.shape[1]
        segment = Segment(0.0, False, 0, monitor.time, monitor.states, np.empty(n))
        self._kept = pack_uncached(segment), pack(UNRECORDED)
        self.monitor = monitor._replace(
            recorder=recorder_address(), segment=self._kept[0].address, record=self._kept[1].address
        )
        self._packed = pack_uncached(self.monitor)
        self.address = self._packed.address

    def write_first_step_change_bounds(self, problem: Problem, state: IntegratorState) -> None:
        """Bound how far distances change over the first step, into ``monitor.moves``."""
        library().write_first_step_change_bounds(
            pack(problem).address, pack(state).address, self.address
        )

    def search_distances(
        self, problem: Problem, state: IntegratorState, first: int, end: int
    ) -> None:
        """Search the steps from ``first`` to before ``end`` for extremes of distances and speeds."""
        of = pack(problem).address, pack(state).address, self.address
        library().watch_trail_distances(first, end, *of)

    def search_clearances(
        self, problem: Problem, state: IntegratorState, first: int, end: int, solids: Solids
    ) -> None:
        """Search the same steps for clearances to all ``solids``, see `rigidfleet.kernel.obstacles`."""
        of = pack(problem).address, pack(state).address, self.address
        library("solids").watch_trail_clearances(first, end, *of, pack(solids).address)

    def search_forces(
        self, problem: Problem, workspace: Workspace, state: IntegratorState, *, last: bool
    ) -> None:
        """Search all steps for extremes of forces; ``last``: no further step of the segment follows."""
        of = [pack(x).address for x in (problem, workspace, state)]
        library().watch_forces(int(last), *of, self.address)


def closed_loop(t: float, y: Floats, dy: Floats, problem: Problem, workspace: Workspace) -> None:
    """Right-hand side dy (n,) at time t [s] and state y (n,), see `rigidfleet.kernel.dynamics.closed_loop`."""
    segment = pack_uncached(Segment(0.0, False, 0, np.array([t]), np.array([y]), dy))
    _call_packed(library().record, pack(problem), pack(workspace), segment, pack(UNRECORDED))


def _call_packed(function: Any, *arguments: Packed) -> int:
    return function(*[a.address for a in arguments])


def measure_samples(measured: Measured) -> None:
    """Measure the samples of a flight, see `rigidfleet.kernel.measurement.measure_samples`."""
    _call_packed(library().measure, pack_uncached(measured))


def run_linear_recursion(x: Floats, a: Floats, *, backward: bool = False) -> None:
    """x_k += a_k x_(k-1) in rows x (K, M), with a (K,), or backward; see `kernel.recursion.run_linear_recursion`."""
    _call_packed(library().follow, pack_uncached(Recursion(x, a, backward)))


def call_large(name: str, *arguments: Any) -> float:
    """Call a function of `rigidfleet.kernel.elimination` or `rigidfleet.kernel.block_cholesky` with its arguments."""
    return _call_packed(
        getattr(library("large"), name), pack_uncached(OF_LARGE[name]._make(arguments))
    )


class Library(SimpleNamespace):
    """Machine code that is loaded: its functions by name (`objects.ENTRIES`), and their ``addresses``.

    The ``engine`` keeps the code alive.
    """


_loading = threading.RLock()
#: The libraries that are loaded, by part.
_loaded: dict[str, Library] = {}


def recorder_address() -> int:
    """Address of the recorder, which other libraries and the monitor call."""
    return library().addresses["record"]


def library(part: str = "flight") -> Library:
    """The machine code of a part of the kernel: from the cache, or compiled."""
    if part not in _loaded:
        with _loading:
            if part not in _loaded:
                _loaded[part] = _load_library(part)
    return _loaded[part]


def _load_library(part: str) -> Library:
    for file in _shipped_code(sources_digest()):
        return _make_library(part, *_load_shared_object(file))
    if (parts := _read_cached_code(part)) is not None:
        return _make_library(part, *_link_objects(parts))
    if _shipped_code("*"):
        warnings.warn(
            "the kernel's sources were changed since its machine code was made: they are compiled again",
            RuntimeWarning,
            stacklevel=2,
        )
    parts = _compile_part(part)
    _cache_code(parts, part)
    return _make_library(part, *_link_objects(parts))


def _make_library(part: str, engine: Any, address_of: Callable[[str], int]) -> Library:
    """Make a library of the functions of a part, whose code the ``engine`` keeps alive."""
    word = ctypes.c_int64
    result = ctypes.c_double if part == "large" else word
    addresses = {name: address_of(symbol_name(name)) for name in ENTRIES[part]}
    calls = {
        name: ctypes.CFUNCTYPE(result, *(word,) * words)(addresses[name])
        for name, words in ENTRIES[part].items()
    }
    return Library(**calls, addresses=addresses, engine=engine)


def _load_shared_object(file: Path) -> tuple[Any, Callable[[str], int]]:
    """Load a shared object.

    Raises
    ------
    RigidfleetError
        The file is damaged, or lies where no code may run.
    """
    try:
        engine = ctypes.CDLL(str(file))
    except OSError as error:  # whose text begins with the file
        raise RigidfleetError(f"{error}. Install rigidfleet again.") from None
    return engine, lambda name: ctypes.cast(engine[name], ctypes.c_void_p).value or 0


def _link_objects(parts: Sequence[bytes]) -> tuple[Any, Callable[[str], int]]:
    """Load objects of machine code as a linker would, which not every machine has."""
    import llvmlite.binding as llvm

    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target_machine())
    for part in parts:
        engine.add_object_file(llvm.ObjectFileRef.from_data(part))
    engine.finalize_object()
    return engine, engine.get_function_address


def _compile_part(part: str) -> list[bytes]:
    """Compile the kernel, or another library (``part``), in a separate process if possible."""
    if (parts := compile_objects(part, target_instruction_level())) is not None:
        return parts
    from rigidfleet.kernel.engine import build

    return build.LIBRARIES.get(part, build.flight_object_code)()


def _shipped_code(digest: str) -> list[Path]:
    """Shared objects of this level that came with the package, made of sources with a digest, or of any ("*").

    Raises
    ------
    RigidfleetError
        The environment fixes a level that this machine cannot run.
    """
    file = shipped_object_path(runnable_instruction_level(), digest)
    return list(file.parent.glob(file.name))


def _cache_file(part: str) -> Path:
    """The cache file of a part of the machine code, for this level or this kind of machine.

    Raises
    ------
    OSError
        As `cache_directory` does.
    """
    if (machine := target_instruction_level()) == HOST:
        import llvmlite.binding as llvm

        host = f"{llvm.get_process_triple()} {llvm.get_host_cpu_name()} {llvm.get_host_cpu_features().flatten()}"
        machine = hashlib.sha256(host.encode()).hexdigest()[:16]
    return cache_directory() / f"{part}-{machine}.o"


def _read_cached_code(part: str) -> list[bytes] | None:
    """Machine code from the cache, if there is any that is safe to run."""
    try:
        with open_for_reading(_cache_file(part)) as stream:
            return split_object_codes(stream.read())
    except OSError:
        return None


def _cache_code(parts: Sequence[bytes], part: str) -> None:
    """Store machine code in the cache, or warn that it will be compiled again."""
    try:
        with replace_atomically(_cache_file(part), private=True) as stream:
            stream.write(pack_object_codes(parts))
    except OSError as error:
        warn_not_cached(error)


def has_machine_code() -> bool:
    """Return whether there is machine code, shipped or in the cache, so that nothing has to be compiled."""
    return bool(_shipped_code(sources_digest())) or _read_cached_code("flight") is not None
