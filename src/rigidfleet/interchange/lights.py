"""Light programs of Skybrush shows: commands to set a colour and to fade to one.

Source: the commands of light programs in libskybrush (`src/lights/commands.h`): a byte for the command, a byte each for
red, green and blue, and a duration in frames of 20 ms, seven bits to a byte, the lowest first.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from rigidfleet.result import Result

#: Commands, and the length of a frame [s].
_END, _SET, _FADE, FRAME = 0x00, 0x04, 0x08, 0.02
#: Light of vehicles before the first formation that has a colour.
_FIRST = "#ffffff"


class Fade(NamedTuple):
    """A change of light: its begin and end, in frames since the start of the show, and the colour of each vehicle."""

    begin: int
    end: int
    colours: tuple[str, ...]


def fades(result: Result, start: float, end: float) -> list[Fade]:
    """Changes of light from a time to another [s]: vehicles fade to the colours of a formation as they take it.

    The first is the light at the start, at once. A formation without a colour keeps the light before.
    """
    mission = result.mission
    planned = {p.name: p for p in mission.phases}
    changes = [Fade(0, 0, (_FIRST,) * result.n_agents)]
    before: str | None = None
    for phase in result.phases:
        taken, before = phase.formation != before, phase.formation
        if before is None or not taken or (colours := mission.formation_colours(before)) is None:
            continue
        known = planned.get(phase.name)
        shaping = known.shaping if known is not None else None
        length = phase.t_end - phase.t_start
        if shaping is not None:
            length = min(length, shaping.least_time)
        first, last = (round((t - start) / FRAME) for t in (phase.t_start, phase.t_start + length))
        if last <= 0:  # the part that is exported begins later
            changes = [Fade(0, 0, colours)]
        elif first < (end - start) / FRAME:
            first = max(first, changes[-1].end)
            changes.append(Fade(first, max(first, last), colours))
    return changes


def program(changes: list[Fade], agent: int, end: int) -> Iterator[int]:
    """Bytes of the light program of one vehicle, that lasts until a frame."""
    for change, until in zip(changes, [*(c.begin for c in changes[1:]), end], strict=True):
        rgb = bytes.fromhex(change.colours[agent][1:])
        if change.end > change.begin:
            yield from (_FADE, *rgb, *_varint(change.end - change.begin))
        if until > change.end or change.end == change.begin:
            yield from (_SET, *rgb, *_varint(max(0, until - change.end)))
    yield _END


def _varint(number: int) -> bytes:
    """A whole number from 0, seven bits to a byte, the lowest first; the eighth bit says that more follow."""
    found = bytearray()
    while number > 0x7F:
        found.append(number & 0x7F | 0x80)
        number >>= 7
    found.append(number)
    return bytes(found)
