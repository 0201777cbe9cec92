"""The compiled kernel, called without the compiler.

`rigidfleet.kernel.engine.build` compiles the integrator, the recorder and the monitor once to machine code. The code is
stored in a cache and loaded from there, because importing Numba alone takes longer than flying most missions. It reads
and writes through addresses of named tuples, laid out as `rigidfleet.kernel.compiler.pointers` says.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding as llvm
import numpy as np

from rigidfleet._common.files import replacing
from rigidfleet.kernel.compiler.cache import cache_directory, not_kept, opened, told
from rigidfleet.kernel.engine.objects import (
    AVOIDANCE_ENTRY,
    ELSEWHERE,
    ENTRIES,
    SAMPLED_ENTRIES,
    build_process,
    concatenated,
    separated,
    target_machine,
)
from rigidfleet.kernel.engine.packing import NOTHING, UNRECORDED, Packed, pack, packed, use
from rigidfleet.kernel.measured import Measured, nearest_of, spectrum_of
from rigidfleet.kernel.problem import (
    Problem,
    Workspace,
)
from rigidfleet.kernel.records import (
    IntegratorState,
    Monitor,
    Record,
    Recursion,
    Segment,
    recorder,
)
from rigidfleet.solids import distance
from rigidfleet.typing import Floats, Ints


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
    segment = pack(Segment(t_end, fresh, max_steps, times, samples, NOTHING))
    return _call(
        _integrator(problem, workspace), packed(problem), packed(workspace), packed(state), segment
    )


class Integration:
    """An integration to ``t_end`` [s] in parts: a callable that integrates at most some steps."""

    def __init__(
        self,
        problem: Problem,
        workspace: Workspace,
        state: IntegratorState,
        t_end: float,
        times: Floats,
        samples: Floats,
    ) -> None:
        self._segment = pack(Segment(t_end, False, 0, times, samples, NOTHING))
        self._kept = packed(problem), packed(workspace), packed(state), self._segment
        self._addresses = [x.address for x in self._kept]
        self._integrate = _integrator(problem, workspace)

    def __call__(self, fresh: bool, max_steps: int) -> int:
        """Go on; ``fresh`` as in `Segment`. Returns what `rigidfleet.kernel.dopri5.integrate` returns."""
        self._segment.words[1], self._segment.words[2] = int(fresh), max_steps
        return self._integrate(*self._addresses)


def _integrator(problem: Problem, workspace: Workspace) -> Any:
    code, graph = _code(), problem.graph
    sizes = len(problem.vehicles.m), len(graph.edges), len(graph.pairs), len(workspace.A)
    return code.integrate_three if sizes == (3, 3, 3, 3) else code.integrate


def record(problem: Problem, workspace: Workspace, times: Floats, samples: Floats) -> Record:
    """Forces and references at states ``samples`` (K, n) at ``times`` (K,) [s]."""
    out = recorder(len(times), len(problem.vehicles.m), len(problem.graph.edges))
    record_into(pack(out), 0, packed(problem), workspace, times, samples)
    return out


def record_into(
    out: Packed, first: int, problem: Packed, workspace: Workspace, times: Floats, samples: Floats
) -> None:
    """`record` into a `Record` from row ``first`` on; it and the problem are packed."""
    segment = Segment(0.0, False, 0, times, samples, np.empty(samples.shape[1]), first)
    _call(_code().record, problem, packed(workspace), pack(segment), out)


class Watch:
    """Finds the extremes of the steps in trails, see `rigidfleet.kernel.monitor`."""

    def __init__(self, monitor: Monitor) -> None:
        # The recorder evaluates the law, at the monitor's own time and state.
        n = monitor.states.shape[1]
        segment = Segment(0.0, False, 0, monitor.time, monitor.states, np.empty(n))
        self._kept = pack(segment), pack(UNRECORDED)
        self.monitor = monitor._replace(
            recorder=_code().recorder, segment=self._kept[0].address, record=self._kept[1].address
        )
        self._packed = pack(self.monitor)

    def bound_moves(self, problem: Problem, state: IntegratorState) -> None:
        """Bound how far distances change over the first step, into ``monitor.moves``."""
        _call(_code().bound_moves, packed(problem), packed(state), self._packed)

    def distances(self, problem: Problem, state: IntegratorState, first: int, end: int) -> None:
        """Search the steps from ``first`` to before ``end`` for extremes of distances and speeds."""
        of = packed(problem).address, packed(state).address, self._packed.address
        _code().watch_distances(first, end, *of)

    def forces(
        self, problem: Problem, workspace: Workspace, state: IntegratorState, *, last: bool
    ) -> None:
        """Search all steps for extremes of forces; ``last``: no further step of the segment follows."""
        of = [packed(x).address for x in (problem, workspace, state)]
        _code().watch_forces(int(last), *of, self._packed.address)


def closed_loop(t: float, y: Floats, dy: Floats, problem: Problem, workspace: Workspace) -> None:
    """Right-hand side dy (n,) at time t [s] and state y (n,), see `rigidfleet.kernel.dynamics.closed_loop`."""
    found = _own.segment
    if found is None or len(found.of.dy) != len(y):
        found = pack(Segment(0.0, False, 0, np.empty(1), np.empty((1, len(y))), np.empty(len(y))))
        _own.segment = found
    segment: Segment = found.of
    segment.times[0], segment.samples[0] = t, y
    _call(_code().record, packed(problem), packed(workspace), found, packed(UNRECORDED))
    dy[:] = segment.dy


class _Own(threading.local):
    """The segment of one state with which a thread has called `closed_loop` last."""

    segment: Packed | None = None


_own = _Own()


def _call(function: Any, *arguments: Packed) -> int:
    return function(*[a.address for a in arguments])


def measure(found: Measured) -> None:
    """Measure the samples of a flight, see `rigidfleet.kernel.measurement.measure`."""
    _call(_code().measure, pack(found))


def least_singular_values(r: Floats, edges: Ints) -> Floats:
    """Smallest non-zero singular value (K,) of J at r (K, N, 3), see `rigidfleet.kernel.measurement.spectrum`."""
    found = spectrum_of(r, edges)
    _call(_code().spectrum, pack(found))
    return found.found


def nearest_boxes(r: Floats, radius: Floats, boxes: Floats) -> tuple[Floats, Ints]:
    """Least distances to boxes, and these boxes (N, K), see `rigidfleet.kernel.nearest.nearest_boxes`."""
    found = nearest_of(r, radius, boxes)
    _call(_code().nearest, pack(found))
    return found.least, found.nearest


def follow(x: Floats, a: Floats, *, backward: bool = False) -> None:
    """x_k += a_k x_(k-1) in rows x (K, M), with a (K,), or backward, see `rigidfleet.kernel.recursion.follow`."""
    _call(_code().follow, pack(Recursion(x, a, backward)))


def follow_multiples(y: Floats, first: int, b: Floats, x: Floats, a: Floats) -> None:
    """x_k = b_k y_k + a_k x_(k-1) in rows x (K, M), from the M columns of y (K, C) that begin with ``first``."""
    _call(_code().follow, pack(Recursion(x, a, False, y, first, b)))


class _Code(NamedTuple):
    integrate: Any
    record: Any
    bound_moves: Any
    watch_distances: Any
    watch_forces: Any
    measure: Any
    spectrum: Any
    nearest: Any
    follow: Any
    integrate_three: Any  # integrate, for three agents with three edges
    recorder: int  # address of record
    engine: Any  # keeps the code alive
    unkept: list[bytes] | None  # objects that could not be stored in the cache


class Sampled(NamedTuple):
    """The second library: sampled flights. Flights of points do not load it."""

    fly_ticks: Any
    evaluate: Any
    recorder: int  # address of record
    engine: Any
    unkept: list[bytes] | None


class Avoiding(NamedTuple):
    """The third library: avoidance in flight, loaded by missions with [avoidance] alone."""

    avoid: Any
    address: int
    engine: Any
    unkept: list[bytes] | None


_loading = threading.RLock()
#: The libraries that are loaded, by part.
_loaded: dict[str, Any] = {}


def _code() -> _Code:
    """The kernel's machine code: from the cache, or compiled."""
    return _library("flight")


def sampled() -> Sampled:
    """The machine code of sampled flights: from the cache, or compiled."""
    return _library("sampled")


def avoiding() -> Avoiding:
    """The machine code of avoidance in flight: from the cache, or compiled."""
    return _library("avoidance")


def _library(part: str) -> Any:
    if part not in _loaded:
        with _loading:
            if part not in _loaded:
                _loaded[part] = _load(part)
    return _loaded[part]


def _load(part: str) -> Any:
    if (parts := _read(part)) is not None:
        return _LINKED[part](parts)
    parts = _compile(part)
    return _LINKED[part](parts, None if _write(parts, part) else parts)


def _linked(parts: Sequence[bytes], unkept: list[bytes] | None = None) -> _Code:
    engine = _engine(parts)
    *calls, gather, three = [_function(engine, *entry) for entry in ENTRIES.items()]
    use(gather, engine)
    distance.use(nearest_boxes)
    recorder = engine.get_function_address("rigidfleet_record")
    return _Code(*calls, three, recorder, engine, unkept)


def _linked_sampled(parts: Sequence[bytes], unkept: list[bytes] | None = None) -> Sampled:
    engine = _engine(parts)
    calls = [_function(engine, *entry) for entry in SAMPLED_ENTRIES.items()]
    return Sampled(*calls, _code().recorder, engine, unkept)


def _linked_avoiding(parts: Sequence[bytes], unkept: list[bytes] | None = None) -> Avoiding:
    engine = _engine(parts)
    address = engine.get_function_address(AVOIDANCE_ENTRY)
    return Avoiding(_function(engine, AVOIDANCE_ENTRY, 4), address, engine, unkept)


#: What makes a library of the objects of each part.
_LINKED = {"flight": _linked, "sampled": _linked_sampled, "avoidance": _linked_avoiding}


def _function(engine: Any, name: str, words: int) -> Any:
    """A function of machine code that takes this number of words and returns one."""
    word = ctypes.c_int64
    return ctypes.CFUNCTYPE(word, *(word,) * words)(engine.get_function_address(name))


def _engine(parts: Sequence[bytes]) -> Any:
    """Load objects of machine code."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target_machine())
    for part in parts:
        engine.add_object_file(llvm.ObjectFileRef.from_data(part))
    engine.finalize_object()
    return engine


class Inheritance(NamedTuple):
    """Code by part that a child process need not compile again, and whether it need not repeat a warning."""

    code: dict[str, list[bytes]]
    told: bool


def bequeath() -> Inheritance:
    """Code of this process that its child processes cannot find in the cache; to be sent only to them."""
    unkept = {part: library.unkept for part, library in _loaded.items()}
    return Inheritance({part: code for part, code in unkept.items() if code}, told.is_set())


def inherit(given: Inheritance) -> None:
    """Take over the code and warnings of the parent process."""
    if given.told:
        told.set()
    for part, code in given.code.items():
        _loaded[part] = _LINKED[part](code, code)


def _compile(part: str) -> list[bytes]:
    """Compile the kernel, or another library (``part``), in a separate process if possible.

    In that process Numba only translates. Otherwise it would optimise each function before all are optimised
    together, and take twice as long.
    """
    # Suppress Numba's coloured messages about the versions that it tries.
    quiet = {"NUMBA_OPT": "0", "NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}
    if sys.executable:
        with suppress(OSError):
            done = subprocess.run(
                build_process(part), env=os.environ | quiet, cwd=ELSEWHERE, capture_output=True, check=False
            )  # fmt: skip
            if done.returncode == 0 and (parts := separated(done.stdout)) is not None:
                return parts
    from rigidfleet.kernel.engine import build

    return build.LIBRARIES.get(part, build.machine_code)()


def _file(part: str) -> Path:
    """The cache file of a part of the machine code for this kind of machine.

    Raises
    ------
    OSError
        As `cache_directory` does.
    """
    machine = f"{llvm.get_process_triple()} {llvm.get_host_cpu_name()} {llvm.get_host_cpu_features().flatten()}"
    return cache_directory() / f"{part}-{hashlib.sha256(machine.encode()).hexdigest()[:16]}.o"


def _read(part: str) -> list[bytes] | None:
    """Machine code from the cache, if there is any that is safe to run."""
    try:
        with opened(_file(part)) as stream:
            return separated(stream.read())
    except OSError:
        return None


def _write(parts: Sequence[bytes], part: str) -> bool:
    """Store machine code in the cache, or warn that it will be compiled again."""
    try:
        with replacing(_file(part), private=True) as stream:
            stream.write(concatenated(parts))
    except OSError as error:
        not_kept(error)
        return False
    return True


def is_compiled() -> bool:
    """Return whether the machine code is in the cache, so that nothing has to be compiled."""
    try:
        with opened(_file("flight")):
            return True
    except OSError:
        return False
