"""Samples of a flight by hand, at even steps and in bounded memory, worst moments included."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rigidfleet.result import Result
from rigidfleet.simulation.recording import Piece
from rigidfleet.typing import Bools, Floats

#: Greatest number of values kept in records, 8 bytes each: 10 minutes of 50 vehicles with 144 edges at 0.05 s. Beyond
#: it, every second sample is dropped, and the step doubles.
_MOST = 3.0e7
_JOINED = 256  # ticks joined into one piece: few large arrays instead of many small ones


@dataclass
class ArchivedPhase:
    """Samples of a phase, up to the loss of a vehicle.

    Its start, its end and its worst moments (least distance, greatest force) are kept at any step.
    """

    pieces: list[Piece] = field(default_factory=list)
    #: The end, and the worst moments, with how bad each is.
    moments: dict[str, tuple[float, Piece]] = field(default_factory=dict)


class Archive:
    """Samples of a flight that advances tick by tick.

    Attributes
    ----------
    step : between the samples kept [s]; at first that of the mission
    """

    def __init__(self, step: float, most: float = _MOST) -> None:
        self.step, self.most = step, most
        self.phases: dict[tuple[int, int], ArchivedPhase] = {}  # by phase and number of edges
        self.size = 0

    def add(self, pieces: Sequence[Piece], record: Result) -> None:
        """Store the samples of a tick; ``record`` is that of its end."""
        for piece in pieces:
            archived = self.phases.setdefault((piece.phase, len(piece.edges)), ArchivedPhase())
            keep = self._is_multiple(piece.time)
            keep[0] |= not archived.moments  # the start
            archived.moments["end"] = np.inf, select_rows(piece, [-1])
            if keep.any():
                archived.pieces.append(select_rows(piece, keep))
                self.size += _size(archived.pieces[-1])
            if len(archived.pieces) >= _JOINED and len(archived.pieces[-1].time) < _JOINED:
                archived.pieces = [_join(archived.pieces)]
            if piece is pieces[-1]:
                _note_worst(archived.moments, record)
        while self.size > self.most:
            self._thin()

    def pieces(self) -> list[Piece]:
        """All stored samples, in order of time and without duplicates."""
        pieces = []
        for archived in self.phases.values():
            every = _join([*archived.pieces, *(piece for _, piece in archived.moments.values())])
            pieces.append(select_rows(every, np.unique(every.time, return_index=True)[1].tolist()))
        return pieces

    def has_phase(self, phase: int) -> bool:
        """Whether there is a sample of a phase."""
        return any(key[0] == phase for key in self.phases)

    def _is_multiple(self, time: Floats) -> Bools:
        """Which times are multiples of the step."""
        away = time / self.step
        return np.abs(away - np.round(away)) * self.step < 1e-6

    def _thin(self) -> None:
        """Double the step: drop every second sample."""
        self.step *= 2.0
        for archived in self.phases.values():
            whole = _join(archived.pieces)
            keep = self._is_multiple(whole.time)
            keep[0] = True  # the start
            archived.pieces = [select_rows(whole, keep)]
        self.size = sum(_size(archived.pieces[0]) for archived in self.phases.values())
        self.most = max(self.most, 2.0 * self.size if self.size > 0.5 * self.most else 0.0)


def _size(piece: Piece) -> int:
    """Number of values in the record of a piece."""
    return sum(x.size for x in piece.record)


def _note_worst(moments: dict[str, tuple[float, Piece]], record: Result) -> None:
    """Keep the end of a tick if it is a worst moment of its phase."""
    worst = {
        "separation": -float(record.separation[-1]),
        "clearance": -float(record.clearance[-1]),
        "thrust": float(np.max(record.thrust[-1])),
        "speed": float(np.linalg.norm(record.velocity[-1], axis=1).max()),
    }
    for name, value in worst.items():
        if value > moments.get(name, (-np.inf,))[0]:
            moments[name] = value, moments["end"][1]


def select_rows(piece: Piece, which: Bools | list[int]) -> Piece:
    """Some samples of a piece."""
    return _combine([piece], lambda x: x[0][which])


def _join(pieces: list[Piece]) -> Piece:
    """Pieces of one phase as one."""
    return _combine(pieces, np.concatenate)


def _combine(pieces: Sequence[Piece], array: Callable[[Sequence[Any]], Any]) -> Piece:
    """A piece of which each ``array`` is made of those of pieces of one phase, also in its named tuples."""

    def combine(each: Sequence[Any]) -> Any:
        if isinstance(each[0], tuple):
            return type(each[0])(*map(combine, zip(*each, strict=True)))
        return None if each[0] is None else array(each)

    names = "time", "integral", "frame", "vehicles", "layers"
    return replace(
        pieces[0],
        source=combine([p.record for p in pieces]),
        followed=tuple(step for p in pieces for step in p.followed),
        **{name: combine([getattr(p, name) for p in pieces]) for name in names},
    )
