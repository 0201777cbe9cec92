"""Named tuples in words of eight bytes, as machine code reads them; see `rigidfleet.kernel.compiler.pointers`."""

from __future__ import annotations

import ctypes
import struct
import threading
from collections import namedtuple
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple, TypeVar

import numpy as np

from rigidfleet.kernel import fleet
from rigidfleet.kernel.avoidance import avoidance_arrays
from rigidfleet.kernel.measured import measurement_arrays
from rigidfleet.kernel.problem import (
    CONSTANT,
    ITERATED,
    NO_FEEDBACK,
    OPEN,
    REST,
    RIGID,
    ConstraintLaw,
    Control,
    Problem,
    Reference,
    Vehicles,
    graph,
    no_disturbance,
)
from rigidfleet.kernel.problem import workspace as kernel_workspace
from rigidfleet.kernel.records import (
    Order,
    Pattern,
    Recursion,
    Segment,
    integrator,
    new_monitor,
    new_record,
)
from rigidfleet.solids.records import half_space, one_solid

T = TypeVar("T")


class Packed(NamedTuple):
    """A named tuple as words, and the tuple itself, which keeps its arrays alive."""

    of: Any
    words: ctypes.Array[ctypes.c_int64]
    address: int

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy has words of its own: the arrays of the tuple lie elsewhere."""
        return pack_uncached, (self.of,)


#: By it, an array's address is read five times as fast as by `__array_interface__`: packing is a part of every flight.
_buffer = (ctypes.c_char * 0).from_buffer


def _kinds_and_words(x: Any) -> tuple[Any, list[Any], list[Any]]:
    """A named tuple, the kinds of its numbers and arrays, and its words."""
    kinds: list[Any] = []
    words: list[Any] = []
    for value in x:
        if isinstance(value, np.ndarray):
            try:
                words.append(ctypes.addressof(_buffer(value)))
            except TypeError:  # it is read-only, or not contiguous
                if not value.flags.c_contiguous:
                    raise TypeError("the kernel takes only C-contiguous arrays") from None
                words.append(value.__array_interface__["data"][0])
            words += value.shape
            kinds += value.dtype.char, value.ndim
        elif isinstance(value, float):
            words.append(value)
            kinds.append(float)
        elif isinstance(value, tuple):
            _, own, inside = _memoise_last(_kinds_and_words, value)
            kinds += own
            words += inside
        else:
            words.append(int(value))
            kinds.append(int)
    return x, kinds, words


def pack_uncached(x: Any) -> Packed:
    """Convert a named tuple to words.

    Raises
    ------
    TypeError
        Numbers or arrays are not of the types that the kernel is compiled for.
    """
    _, kinds, values = _kinds_and_words(x)
    expected, code = _word_layout(type(x))
    if kinds != expected:
        raise TypeError(
            f"this {type(x).__name__} has arrays or numbers of types that the kernel does not take"
        )
    words = (ctypes.c_int64 * len(values)).from_buffer_copy(code.pack(*values))
    return Packed(x, words, ctypes.addressof(words))


class _Last(threading.local):
    """The tuples that a thread used last, by identity: flights call the kernel with the same ones repeatedly."""

    def __init__(self) -> None:
        self.packed: dict[tuple[Any, int], Any] = {}


_last = _Last()
#: How many of them are kept: those of eight flights side by side, and the tuples in them.
_KEPT = 128


def _memoise_last(make: Callable[[Any], Any], x: Any) -> Any:
    """What ``make`` makes of a named tuple, unless it is among the last ones that the thread has used.

    Without it, flights of narrow-passage and moving-obstacles take 1.4 times the processor time, cube-by-neighbours 1.2
    times, passage-quadrotors 1.1 times. It also keeps words alive while machine code reads them by their address.
    """
    kept, key = _last.packed, (make, id(x))
    last = kept.pop(key, None)
    if last is None or last[0] is not x:
        last = make(x)
        if len(kept) >= _KEPT:
            del kept[next(iter(kept))]
    kept[key] = last
    return last


def pack(x: Any) -> Packed:
    """`pack_uncached`, unless the named tuple is among the last ones that the thread has used."""
    return _memoise_last(pack_uncached, x)


def forget_last_packed() -> None:
    """Let go of the tuples that this thread has used last; those of a large formation hold much memory."""
    _last.packed.clear()


@cache
def _word_layout(kind: type) -> tuple[list[Any], struct.Struct]:
    """Kinds of the numbers and arrays of a type of named tuple, and how its words are stored."""
    _, kinds, words = _kinds_and_words(example_of(kind))
    return kinds, struct.Struct("=" + "".join("d" if type(x) is float else "q" for x in words))


def example_of(kind: type[T]) -> T:
    """The example of a type of named tuple; its fields have the types that all have."""
    return next(x for x in (*_examples(), *_large_solver_examples()) if isinstance(x, kind))


@cache
def _examples() -> tuple[Any, ...]:
    """One minimal example of each named tuple that machine code takes."""
    one, none, places = np.ones(1), np.zeros(0), np.zeros((1, 3))
    problem = Problem(
        body_formulation=False,
        has_frame=False,
        vehicles=Vehicles(one, one, 1.0, 1.0, one, False, 0.0),
        graph=graph(np.zeros((0, 2), dtype=np.int64), one),
        law=ConstraintLaw(0.0, 0.0, 0.0, ITERATED, 0.0, 0, 0.0, 0.0, 0.0),
        reference=Reference(CONSTANT, 0.0, 0.0, none, none, places, places, np.zeros(3)),
        motion=REST,
        feedback=NO_FEEDBACK,
        control=Control(OPEN, False, False, places, 0.0, 0.0, RIGID),
        disturbance=no_disturbance(one),
    )  # fmt: skip
    state = integrator(np.zeros(6), 0.0, rtol=0.0, atol=np.ones(6))
    segment = Segment(0.0, False, 0, none, np.zeros((0, 6)), none)
    nowhere = np.zeros((0, 6))
    watching = new_monitor(one, nowhere, nowhere, 6, 3)
    work = kernel_workspace(1, 0)
    vehicles = fleet.quadrotor_arrays([fleet.VehicleDynamics(1.0, point=True)])
    flight = fleet.new_ideal_flight(vehicles, start=0.0, h=0.0, steps=1)
    S = np.zeros((1, fleet.STATES))
    rows = np.zeros((0, 1, 3))
    return (
        problem, work, state, segment, UNRECORDED, watching, flight, fleet.initial_state(flight, S, work),
        fleet.sampled_segment(1, 0, 0.0),
        avoidance_arrays(period=1.0, b=one, lift=one, mass=one, g=0.0, radius=one),
        measurement_arrays(1, 0, 0, time=none, start=np.zeros(1, dtype=np.int64), attached=np.zeros(0, dtype=np.bool_),
                 framed=False, mass=one, lost_at=one, limit=one, edges=np.zeros((0, 2), dtype=np.int64),
                 r=rows, v=rows, f_u=rows, f_C=rows, p=rows, T_ref=np.zeros((0, 3, 3))),
        Recursion(np.zeros((0, 1)), none, False), one_solid(half_space(0.0)),
    )  # fmt: skip


@cache
def _large_solver_examples() -> tuple[Any, ...]:
    """Examples of the arguments of each function of the solver of large formations, as named tuples."""
    k, a, b, frame = np.zeros(1, dtype=np.int64), np.zeros((1, 3)), np.zeros(1), np.eye(3)
    edges = np.zeros((1, 2), dtype=np.uint32)
    order = Order(
        edges[:, 0].copy(), *np.zeros((2, 1, 3), dtype=np.uint32), np.zeros((1, 3), dtype=np.int8)
    )
    matrix = {"u": a, "edges": edges, "m": b, "mbar": 1.0, "mu": 1.0}
    blocks, many = np.zeros((1, 9)), np.zeros((1, 1, 3))
    tree = {"first": k, "left": k, "parent": k, "mark": k}
    gradients = {
        **matrix, "turned": frame, "place": k, "column": k, "row": k, "L": blocks, "g": a, "x": a, "within": 1.0,
        "most": 1, "work": many,
    }  # fmt: skip
    rows = {"column": k, "row": k, "first": k, "left": k, "block": k}
    arguments: dict[str, dict[str, Any]] = {
        "solve": {"u": a, "b": b, "r": a, "m": b, "M": 1.0, "order": order, "known": False, "cm": b, "I": frame,
                  "I_inv": frame, "a": a, "f_C": a},
        "multipliers": {"u": a, "order": order, "f": a, "multiplier": b},
        "elimination_tree": tree,
        "add_block_counts": tree | {"count": k, "most": 1},
        "list_factor_blocks": tree | {"free": k, "out": Pattern(*(k,) * 7)},
        "assemble": matrix | {"place": k, "column": k, "of_edge": k, "L": blocks},
        "factor": rows | {"L": blocks, "at": k},
        "add_J_product": {"u": a, "edges": edges, "a": a, "scale": 1.0, "out": b},
        "add_Jt_product": {"u": a, "edges": edges, "b": b, "scale": 1.0, "out": a},
        "inner": {"a": a, "b": a},
        "project_on_past_solutions": matrix | {"g": a, "past": many, "gram": frame, "x": a},
        "conjugate_gradients": gradients,
        "conjugate_gradients_single": gradients | {"L": blocks.astype(np.float32)},
    }  # fmt: skip
    return tuple(namedtuple(name, fields)(**fields) for name, fields in arguments.items())


#: The types of these named tuples, by the function's name.
OF_LARGE = {type(x).__name__: type(x) for x in _large_solver_examples()}

NOTHING = np.zeros(0)


UNRECORDED = new_record(0, 0, 0)
