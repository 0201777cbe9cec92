"""Samples of a flight by hand, at even steps and in bounded memory, worst moments included."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rigidfleet.result import Result
from rigidfleet.simulation.recording import Piece
from rigidfleet.typing import Bools, Floats

#: Greatest number of values kept, 8 bytes each: 10 minutes of 50 vehicles with 144 edges at 0.05 s. Beyond it,
#: every second sample is dropped, and the step doubles.
_MOST = 3.0e7
_JOINED = 256  # ticks joined into one piece: few large arrays instead of many small ones


@dataclass
class ArchivedPhase:
    """Samples of a phase, up to the loss of a vehicle.

    Its start, its end and its worst moments (least distance, greatest force) are kept at any step.
    """

    pieces: list[Piece] = field(default_factory=list)
    last: Piece | None = None
    worst: dict[str, tuple[float, Piece]] = field(default_factory=dict)


class Archive:
    """Samples of a flight that advances tick by tick.

    Attributes
    ----------
    step : between the samples kept [s]; at first that of the mission
    """

    def __init__(self, step: float, most: float = _MOST) -> None:
        self.step, self.most = step, most
        self.phases: dict[tuple[int, int], ArchivedPhase] = {}  # by phase and number of edges
        self.size = 0.0

    def add(self, pieces: Sequence[Piece], record: Result) -> None:
        """Store the samples of a tick; ``record`` is that of its end."""
        for piece in pieces:
            key = (piece.phase, len(piece.edges))
            fresh, archived = key not in self.phases, self.phases.setdefault(key, ArchivedPhase())
            archived.last = rows(piece, [-1])
            keep = self._even(piece.time)
            keep[0] |= fresh
            if keep.any():
                archived.pieces.append(rows(piece, keep))
                self.size += _count_numbers(archived.pieces[-1])
            if len(archived.pieces) >= _JOINED and len(archived.pieces[-1].time) < _JOINED:
                archived.pieces = _as_one(archived.pieces)
        if pieces:
            self._note(self.phases[pieces[-1].phase, len(pieces[-1].edges)], record)
        while self.size > self.most:
            self._thin()

    def pieces(self) -> list[Piece]:
        """All stored samples, in order of time."""
        pieces_by_phase = []
        for archived in self.phases.values():
            extra = [archived.last, *(piece for _, piece in archived.worst.values())]
            pieces = [*archived.pieces, *(piece for piece in extra if piece is not None)]
            pieces_by_phase.append(_in_order(_join(pieces)))
        return pieces_by_phase

    def begun(self, phase: int) -> bool:
        """Whether there is a sample of a phase."""
        return any(key[0] == phase for key in self.phases)

    def _note(self, archived: ArchivedPhase, record: Result) -> None:
        """Keep the moment of a tick's end if it is a worst one of its phase."""
        assert archived.last is not None
        worst = {
            "separation": -float(record.separation[-1]),
            "clearance": -float(record.clearance[-1]),
            "thrust": float(np.max(record.thrust[-1])),
            "speed": float(np.linalg.norm(record.velocity[-1], axis=1).max()),
        }
        for name, value in worst.items():
            if value > archived.worst.get(name, (-np.inf, None))[0]:
                archived.worst[name] = (value, archived.last)

    def _even(self, time: Floats) -> Bools:
        """Which times are multiples of the step."""
        away = time / self.step
        return np.abs(away - np.round(away)) * self.step < 1e-6

    def _thin(self) -> None:
        """Double the step: drop every second sample."""
        self.step *= 2.0
        self.size = 0.0
        for archived in self.phases.values():
            pieces = _as_one(archived.pieces)
            keep = self._even(pieces[0].time)
            keep[0] = True  # the start
            archived.pieces = [rows(pieces[0], keep)]
            self.size += _count_numbers(archived.pieces[0])
        self.most = max(self.most, 2.0 * self.size if self.size > 0.5 * self.most else 0.0)


def _count_numbers(piece: Piece) -> float:
    arrays = (
        *piece.record,
        piece.integral,
        piece.frame,
        *(piece.vehicles or ()),
        *(piece.layers or ()),
    )
    return float(sum(x.size for x in arrays))


def rows(piece: Piece, which: Bools | list[int]) -> Piece:
    """Some samples of a piece."""
    return _combine([piece], lambda x: x[0][which])


def _as_one(pieces: list[Piece]) -> list[Piece]:
    return [_join(pieces)] if len(pieces) > 1 else pieces


def _join(pieces: list[Piece]) -> Piece:
    """Pieces of one phase as one."""
    return _combine(pieces, np.concatenate)


def _combine(pieces: Sequence[Piece], array: Callable[[Sequence[Any]], Any]) -> Piece:
    """A piece of which each ``array`` is made of those of pieces of one phase, also in its named tuples."""

    def combine(each: Sequence[Any]) -> Any:
        if isinstance(each[0], tuple):
            return type(each[0])(*map(combine, zip(*each, strict=True)))
        return None if each[0] is None else array(each)

    names = ("time", "record", "integral", "frame", "vehicles", "layers")
    time, record, integral, frame, vehicles, layers = (
        combine([getattr(p, name) for p in pieces]) for name in names
    )
    first, leading = pieces[0], tuple(step for p in pieces for step in p.followed)
    return Piece(
        first.phase, time, record, integral, frame, first.edges, first.attached, leading, vehicles, layers
    )  # fmt: skip


def _in_order(piece: Piece) -> Piece:
    """The piece with its samples sorted by time, without duplicates."""
    _, first = np.unique(piece.time, return_index=True)
    return rows(piece, first.tolist())
