"""Named tuples in words of eight bytes, as machine code reads them; see `rigidfleet.kernel.compiler.pointers`."""

from __future__ import annotations

import struct
import threading
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from rigidfleet.kernel import fleet
from rigidfleet.kernel.avoidance import Avoidance, avoidance
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
from rigidfleet.typing import Ints


class Packed(NamedTuple):
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


def pack(x: Any) -> Packed:
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
    return Packed(x, words, words.__array_interface__["data"][0])


class _Last(threading.local):
    """The last tuple of each type packed by a thread: flights call the kernel with the same ones repeatedly."""

    def __init__(self) -> None:
        self.packed: dict[type, Packed] = {}


_last = _Last()


def packed(x: Any) -> Packed:
    """`pack`, unless the last named tuple of this type that the thread packed is the same one."""
    found = _last.packed.get(type(x))
    if found is None or found.of is not x:
        found = _last.packed[type(x)] = pack(x)
    return found


@cache
def _layout(kind: type) -> _Layout:
    code: list[str] = []
    arrays: list[tuple[str, int]] = []
    _flatten(next(x for x in examples() if isinstance(x, kind)), code, [], arrays)
    return _Layout(struct.Struct("=" + "".join(code)), tuple(arrays))


@cache
def examples() -> tuple[
    Problem,
    Workspace,
    IntegratorState,
    Segment,
    Record,
    Monitor,
    fleet.Flight,
    fleet.SampledState,
    fleet.SampledSegment,
    fleet.Evaluation,
    Avoidance,
]:
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
    work = kernel_workspace(1, 0)
    vehicles = fleet.quadrotors([fleet.Vehicle(1.0, point=True)])
    flight = fleet.flight(vehicles, start=0.0, h=0.0, steps=1)
    S = np.zeros((1, fleet.STATES))
    rotors = np.zeros((1, 4))
    return (
        problem, work, state, segment, UNRECORDED, watching, flight, fleet.begin(flight, S, work),
        fleet.segment(1, 0, 0.0), fleet.Evaluation(S, rotors, places, places, frame, S),
        avoidance(period=1.0, b=one, lift=one, mass=one, g=0.0, radius=one),
    )  # fmt: skip


NOTHING = np.zeros(0)


UNRECORDED = recorder(0, 0, 0)
