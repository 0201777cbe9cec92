"""Positions in recordings of ROS 2 (MCAP, and rosbag2's SQLite), whoever wrote them.

Sources: the definitions of `geometry_msgs`, `nav_msgs`, `sensor_msgs` and `tf2_msgs` (ROS 2's common_interfaces and
geometry2), `NamedPoseArray` of motion_capture_tracking_interfaces; CDR: after 4 bytes that say the order of bytes, each
field is aligned to its size; rosbag2's tables (`rosbag2_storage_sqlite3`); and REP 103: frames are east, north, up, and
one whose name ends with the word ``ned`` is north, east, down. Messages of `px4_msgs` are those of PX4's own logs.
Their fields differ from version to version: the definition in the recording says where each is.
"""

from __future__ import annotations

import math
import re
import sqlite3
import struct
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from functools import lru_cache
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any, Literal, NamedTuple
from urllib.parse import quote

import numpy as np

from rigidfleet._common.names import WANTED
from rigidfleet._common.tables import ContentError, fault
from rigidfleet.foreign.columns import yaws_of
from rigidfleet.foreign.logs import (
    DAMAGED,
    FAR,
    FORMS,
    Channel,
    Log,
    channel_of_px4,
    choose_channels,
)

#: How recordings begin, and what Zstandard packed.
MCAP, SQLITE, ZSTANDARD = b"\x89MCAP0\r\n", b"SQLite format 3\0", b"\x28\xb5\x2f\xfd"
_BILLION = 1_000_000_000
#: Orders of bytes of plain CDR, by its first bytes; and a field of a message that has numbers alone, all of one size.
_Order = Literal["<", ">"]
_ORDERS: dict[bytes, _Order] = {b"\0\0": ">", b"\0\1": "<"}
_FIELD = re.compile(r"\s*(bool|byte|u?int\d+|float\d+)(?:\[(\d+)\])?\s+(\w+)(?:\s.*)?")
#: Frames of REP 105 in which robots move, perhaps each in its own; that of odometry moves in the map itself. And words
#: for places that a robot is to reach.
_NO_VEHICLE = re.compile(rf":(.*[/_])?(map|odom)$|(?<![a-z])({'|'.join(sorted(WANTED))})(?![a-z])")
#: Before a capital within a word.
_CAPITAL = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")
#: Greatest size of a chunk of a recording when it is unpacked, and of a message [bytes].
_CHUNK, _MESSAGE = 32 << 20, 1 << 20
#: Numbers of a message after its names: a position and a quaternion (7), the covariance of a pose (36, by rows), and a
#: velocity in the vehicle's axes (3); or latitude, longitude [deg] and height [m] (3). And the package that it is of:
#: others may have messages of these names, with other fields.
_NUMBERS = {
    "PoseStamped": (7, "geometry_msgs"), "PoseWithCovarianceStamped": (43, "geometry_msgs"),
    "Odometry": (46, "nav_msgs"), "TransformStamped": (7, "geometry_msgs"), "TFMessage": (7, "tf2_msgs"),
    "NamedPoseArray": (7, "motion_capture_tracking_interfaces"), "NavSatFix": (3, "sensor_msgs"),
}  # fmt: skip


#: Topic and body, how their `_Rows` begin, stamp and time of recording [ns], and numbers of a position.
_Place = tuple[str, Any, int, int, Sequence[float]]
#: What is no log of places, and what to give instead.
_PATH = "is a path that is planned, not a log: give poses, odometry or transforms of what flew"
_UNDEFINED = (
    "is of PX4, and the recording does not define it: record as MCAP, or give PX4's own log (.ulg)"
)


class _Rows(NamedTuple):
    """Kind, layout if it is PX4's, and frame of the first message of a vehicle; times and numbers of all.

    ``stamps`` are 0 where a message has none; ``received``: when it was recorded [ns].
    """

    message: str
    layout: np.dtype[Any] | None
    frame: str
    stamps: array[int]
    received: array[int]
    numbers: array[float]


def read_recording(paths: Sequence[Path], topics: Sequence[str]) -> Log:
    """The vehicles of the parts of a recording: topics with positions, or each body in such a topic.

    Without names of topics, those of one kind of message count, the one that is preferred of those that are there.

    Raises
    ------
    ContentError
        The package `mcap` is missing, or the recording has no positions.
    """
    rows: dict[str, _Rows] = {}
    unread: dict[str, str] = {}
    notes: list[str] = []
    try:
        for each in chain.from_iterable(_read_positions(path, unread) for path in paths):
            topic, first, stamp, received, numbers = each
            own = rows.setdefault(topic, _Rows(*first, array("q"), array("q"), array("d")))
            if first[2] and not own.frame:
                unread |= {f"{topic} in ''": f"is in {first[2]!r} later"} if any(own.stamps) else {}
                own = rows[topic] = _Rows(*first, array("q"), array("q"), array("d"))
            if first != own[:3]:
                unread[f"{topic} in {first[2]!r}"] = f"is {own.message} in {own.frame!r} first"
                continue
            own.stamps.append(stamp)
            own.received.append(received)
            own.numbers.extend(numbers)
    except ContentError:
        raise
    except ImportError as error:
        raise fault(f"is compressed, and a package is missing ({error})") from None
    except Exception as error:  # a damaged recording leads its packages to any
        if not rows:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise fault(f"the recording is damaged ({reason})", "Record again") from None
        notes.append(DAMAGED)  # as one is that ended with the power
    if unread and not rows:
        topic, why = next(iter(unread.items()))
        raise fault(f"{topic}: {why}")
    channels = [_channel_of_rows(topic, own) for topic, own in rows.items()]
    chosen = choose_channels(channels, topics)
    undated = [c for c in chosen if not (rows[c.topic].layout or any(rows[c.topic].stamps))]
    if len(undated) < len(chosen):  # they have another clock, or nothing was sent yet
        unread |= {c.topic: "has no stamps, as others have" for c in undated}
        chosen = [c for c in chosen if c not in undated]
    if not topics:
        # What moves in a body is a part of it; what a robot moves in, or is to reach, is no robot.
        names = {c.topic: _CAPITAL.sub("_", c.topic).lower() for c in chosen}
        moving = [c for c in chosen if not _NO_VEHICLE.search(names[c.topic])] or chosen
        chosen = [c for c in moving if c.message == moving[0].message]
        bodies = {c.topic.partition(":")[2] for c in chosen if c.message == "TFMessage"}
        chosen = [c for c in chosen if c.frame not in bodies] or chosen
        if others := sorted({c.topic for c in channels} - {c.topic for c in chosen})[:5]:
            notes.append(f"topics that are not read: {', '.join(others)}; --topic may name them")
    clock = "that of the stamps in messages"
    if any("received" in c.columns for c in chosen):
        clock = "that of who recorded, less the shortest delay"
    notes += [f"{topic} is not read: it {why}" for topic, why in unread.items()]
    return Log({c.topic: [c] for c in chosen}, clock, None, tuple(notes))


def _read_positions(path: Path, unread: dict[str, str]) -> Iterator[_Place]:
    """Each position in a file.

    Topics that seem to have some and cannot be read get a reason in ``unread``.

    Raises
    ------
    ContentError
        A message is encoded in another way, or cut off.
    """
    count: Counter[str] = Counter()
    with path.open("rb") as stream:
        records = _records_of_sqlite if stream.read(16) == SQLITE else _records_of_mcap
    for topic, name, code, definition, data, received in records(path):
        package, kind = name.partition("/")[0], name.rpartition("/")[2]
        own = package == "px4_msgs"
        if own:
            kind = _CAPITAL.sub("_", kind).lower()  # as PX4's logs name it
        if name == "nav_msgs/msg/Path":
            unread[topic] = _PATH
        elif own and kind in FORMS and not definition:
            unread[topic] = _UNDEFINED
        elif kind in _NUMBERS and package != _NUMBERS[kind][1]:
            unread[topic] = f"has messages of {name}, whose fields are not known"
        elif kind in (FORMS if own else _NUMBERS) and topic != "/tf_static":
            if code != "cdr":
                raise fault(f"{topic}: is encoded as {code!r}, not as CDR")
            if data.startswith(ZSTANDARD):  # recorded with --compression-mode message
                from zstandard import ZstdDecompressor

                data = ZstdDecompressor().decompress(data, _MESSAGE)  # noqa: PLW2901
            order = _ORDERS.get(data[:2])
            if order is None and len(data) >= 2:
                unread[topic] = f"is encoded in CDR {data[:2].hex()}, not in plain CDR"
                continue
            order = order or "<"  # of one that is cut off, any
            layout = _message_layout(definition, order) if own else None
            if own and layout is None:
                unread[topic] = f"has messages of {name} whose definition is not understood"
                continue
            count[topic] += 1
            try:
                for who, frame, stamp, numbers in _stamped_positions(kind, layout, order, data):
                    yield f"{topic}{who}", (kind, layout, frame), stamp, received, numbers
            except struct.error:
                where = f"{topic}: message {count[topic]}"
                raise fault(f"{where}: is cut off", "Record again") from None


def _records_of_sqlite(path: Path) -> Iterator[tuple[str, str, str, str, bytes, int]]:
    """Topic, name and code of its messages, their definition, content and time of recording [ns]."""
    query = (
        "SELECT name, type, serialization_format, data, timestamp FROM messages JOIN topics ON topics.id = topic_id "
        f"WHERE length(data) < {_MESSAGE} ORDER BY timestamp"
    )
    with closing(sqlite3.connect(f"file:{quote(str(path.resolve()))}?mode=ro", uri=True)) as base:
        defined: dict[str, str] = {}
        with suppress(sqlite3.OperationalError):  # before ROS 2 Iron there is no such table
            columns = "topic_type, encoded_message_definition"
            defined.update(base.execute(f"SELECT {columns} FROM message_definitions"))
        for topic, name, code, data, received in base.execute(query):
            yield topic, name, code, defined.get(name, ""), data, received


def _records_of_mcap(path: Path) -> Iterator[tuple[str, str, str, str, bytes, int]]:
    """The same, of an MCAP."""
    if find_spec("mcap") is None:
        raise fault("needs the package 'mcap'", "Run: pip install rigidfleet[logs]")
    from mcap import records
    from mcap.stream_reader import StreamReader, breakup_chunk

    schemas, topics = {0: ("", "")}, {}
    with path.open("rb") as stream:
        for whole in StreamReader(stream, emit_chunks=True, validate_crcs=True).records:
            packed = isinstance(whole, records.Chunk)
            if packed and whole.uncompressed_size > _CHUNK:
                more = f"unpacks to {whole.uncompressed_size >> 20} MiB"
                raise fault(f"a chunk of it {more}", "Record poses")
            for record in breakup_chunk(whole, validate_crc=True) if packed else [whole]:
                if isinstance(record, records.Schema):
                    schemas[record.id] = record.name, record.data.decode(errors="replace")
                elif isinstance(record, records.Channel):
                    name, definition = schemas[record.schema_id]
                    topics[record.id] = record.topic, name, record.message_encoding, definition
                elif isinstance(record, records.Message):
                    yield *topics[record.channel_id], record.data, record.log_time


@lru_cache(100)
def _message_layout(definition: str, order: _Order) -> np.dtype[Any] | None:
    """Where the fields of a message are after its first 4 bytes; None unless each is understood, and has one size."""
    fields, at = dict[str, tuple[np.dtype[Any], int]](), 0
    for line in definition.partition("\n===")[0].splitlines():
        text = line.partition("#")[0]
        if not text.strip() or re.match(r"\s*\w+\s+\w+\s*=", text):  # no message has a constant
            continue
        if (field := _FIELD.fullmatch(text)) is None:
            return None
        kind, count, name = field.groups()
        own = np.dtype(kind).newbyteorder(order)
        at += -at % own.itemsize
        for k in range(int(count or 1)):
            fields[f"{name}[{k}]" if count else name] = own, at
            at += own.itemsize
    if not fields:
        return None
    forms, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": [*fields], "formats": forms, "offsets": offsets, "itemsize": at})


def _stamped_positions(
    kind: str, layout: np.dtype[Any] | None, order: _Order, message: bytes
) -> Iterator[tuple[str, str, int, Sequence[float]]]:
    """Body ("" if the topic is of one), frame, stamp [ns] or 0, and numbers of each position in a message."""
    if layout is not None:
        if len(message) < 4 + layout.itemsize:
            raise struct.error
        yield "", "", 0, np.frombuffer(message, layout, 1, 4).item()
        return
    at = 4

    def read(form: str) -> tuple[Any, ...]:
        """Numbers of one size, from their place on."""
        nonlocal at
        size = struct.calcsize(f"={form[-1]}")
        at += -(at - 4) % size
        values = struct.unpack_from(order + form, message, at)
        at += size * len(values)
        return values

    def next_text() -> str:
        nonlocal at
        (length,) = read("I")
        at += length
        return bytes(message[at - length : at - 1]).decode(errors="replace")

    for _ in range(*read("I") if kind == "TFMessage" else (1,)):
        stamp, frame = read("i")[0] * _BILLION + read("I")[0], next_text()
        if kind == "NamedPoseArray":
            yield from ((f":{next_text()}", frame, stamp, read("7d")) for _ in range(*read("I")))
            return
        if kind == "NavSatFix":
            fixed = read("b")[0] >= 0 and read("H")
            yield "", frame, stamp, read("3d") if fixed else (math.nan,) * 3
            return
        who = f":{next_text()}" if kind in ("TransformStamped", "TFMessage", "Odometry") else ""
        yield who if kind != "Odometry" else "", frame, stamp, read(f"{_NUMBERS[kind][0]}d")


def _channel_of_rows(topic: str, rows: _Rows) -> Channel:
    """Columns as forms of messages name them; velocities are turned into the frame of positions."""
    received, time = np.asarray(rows.received), np.asarray(rows.stamps)
    order = np.argsort(received, kind="stable")
    received, time = received[order], time[order]
    table = np.frombuffer(rows.numbers).reshape(len(time), -1)[order]
    if rows.layout is not None:
        columns = {"received": received} | dict(zip(rows.layout.names or (), table.T, strict=True))
        return channel_of_px4(topic, rows.message, columns)
    if not time.any():
        time = received
    lacking = time == 0
    if lacking.sum() == 1 and lacking[0]:  # a clock that begins at 0, unless it begins with a leap
        lacking[0] = len(time) > 2 and time[1] > 2 * np.median(np.diff(time[1:]))
    table[lacking] = np.nan  # what was sent before there was a time is no place
    if rows.message == "NavSatFix":
        columns = dict(zip(("time", "lat", "lon", "alt"), (time, *table.T), strict=True))
        return Channel(topic, rows.message, columns, rows.frame)
    known = np.asarray(np.abs(table[:, :7]).max(axis=1) < FAR)
    columns = {
        "time": time, "x": np.where(known, table[:, 0], np.nan),
        "y": table[:, 1], "z": table[:, 2], "yaw": yaws_of(np.where(known[:, None], table[:, 3:7], 0.0)),
    }  # fmt: skip
    if table.shape[1] > 7:
        columns |= {f"var_{axis}": table[:, 7 + 7 * k] for k, axis in enumerate("xyz")}
    if table.shape[1] > 43:
        vector, scalar, v = table[:, 3:6], table[:, 6:7], table[:, 43:46]
        v = v + 2.0 * np.cross(vector, np.cross(vector, v) + scalar * v)
        columns |= {f"v{axis}": v[:, k] for k, axis in enumerate("xyz")}
    return Channel(topic, rows.message, columns, rows.frame)
