"""Samples of a flight by hand, at even steps and in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rigidfleet.simulation.recording import Piece
from rigidfleet.typing import Bools, Floats

#: Greatest number of values kept in records, 8 bytes each: 10 minutes of 50 vehicles with 144 edges at 0.05 s. Beyond
#: it, every second sample is dropped, and the step doubles.
_MOST = 3.0e7
_JOINED = 256  # ticks joined into one piece: few large arrays instead of many small ones


class Archive:
    """Samples of a flight that advances tick by tick.

    Attributes
    ----------
    step : between the samples kept [s]; at first that of the mission
    """

    def __init__(self, step: float, most: float = _MOST) -> None:
        self.step, self.most = step, most
        # By phase and number of edges: its samples, and its end, which is kept at any step
        self.phases: dict[tuple[int, int], list[Piece]] = {}
        self.ends: dict[tuple[int, int], Piece] = {}
        self.size = 0

    def add_tick(self, pieces: Sequence[Piece]) -> None:
        """Store the samples of a tick."""
        for piece in pieces:
            key = piece.phase, len(piece.edges)
            kept, keep = self.phases.setdefault(key, []), self._is_multiple(piece.time)
            keep[0] |= key not in self.ends  # the start
            self.ends[key] = take_samples(piece, [-1])
            if keep.any():
                kept.append(take_samples(piece, keep))
                self.size += _count_values(kept[-1])
            if len(kept) >= _JOINED and len(kept[-1].time) < _JOINED:
                kept[:] = [_join_pieces(kept)]
        while self.size > self.most:
            self._drop_every_second()

    def pieces(self) -> list[Piece]:
        """All stored samples, in order of time and without duplicates."""
        pieces = []
        for key, kept in self.phases.items():
            every = _join_pieces([*kept, self.ends[key]])
            pieces.append(take_samples(every, np.unique(every.time, return_index=True)[1].tolist()))
        return pieces

    def _is_multiple(self, time: Floats) -> Bools:
        """Which times are multiples of the step."""
        away = time / self.step
        return np.abs(away - np.round(away)) * self.step < 1e-6

    def _drop_every_second(self) -> None:
        """Double the step: drop every second sample."""
        self.step *= 2.0
        for kept in self.phases.values():
            whole = _join_pieces(kept)
            keep = self._is_multiple(whole.time)
            keep[0] = True  # the start
            kept[:] = [take_samples(whole, keep)]
        self.size = sum(_count_values(kept[0]) for kept in self.phases.values())
        self.most = max(self.most, 2.0 * self.size if self.size > 0.5 * self.most else 0.0)


def _count_values(piece: Piece) -> int:
    """Number of values in the record of a piece."""
    return sum(x.size for x in piece.record)


def take_samples(piece: Piece, which: Bools | list[int]) -> Piece:
    """Some samples of a piece."""
    return _combine_arrays([piece], lambda x: x[0][which])


def _join_pieces(pieces: list[Piece]) -> Piece:
    """Pieces of one phase as one."""
    return _combine_arrays(pieces, np.concatenate)


def _combine_arrays(pieces: Sequence[Piece], array: Callable[[Sequence[Any]], Any]) -> Piece:
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
