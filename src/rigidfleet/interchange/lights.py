"""Light programs of Skybrush shows: commands to set a colour and to fade to one.

Source: the commands of light programs in libskybrush (`src/lights/commands.h`): a byte for the command, a byte each for
red, green and blue, and a duration in frames of 20 ms, seven bits to a byte, the lowest first.
"""

from __future__ import annotations

from collections.abc import Iterator

from rigidfleet.result.lights import Fade

#: Commands, and the length of a frame [s].
_END, _SET, _FADE, _FRAME = 0x00, 0x04, 0x08, 0.02


def light_program(changes: list[Fade], agent: int, start: float, end: float) -> Iterator[int]:
    """Bytes of the light program of one vehicle, from a time to another [s]."""
    last = round((end - start) / _FRAME)
    frames = [(round((c.begin - start) / _FRAME), round((c.end - start) / _FRAME)) for c in changes]
    first = max((k for k, (_, until) in enumerate(frames) if until <= 0), default=0)
    kept = [k for k in range(first, len(changes)) if k == first or frames[k][0] < last]
    begins = [max(frames[k][0], 0) for k in kept]
    for k, begin, until in zip(kept, begins, [*begins[1:], last], strict=True):
        rgb, end_ = bytes.fromhex(changes[k].colours[agent][1:]), max(frames[k][1], begin)
        if end_ > begin:
            yield from (_FADE, *rgb, *_varint(end_ - begin))
        if until > end_ or end_ == begin:
            yield from (_SET, *rgb, *_varint(max(0, until - end_)))
    yield _END


def _varint(number: int) -> Iterator[int]:
    """A whole number from 0, seven bits to a byte, the lowest first; the eighth bit says that more follow."""
    while number > 0x7F:
        yield number & 0x7F | 0x80
        number >>= 7
    yield number
