"""Positions in recordings of ROS 2 (MCAP, and rosbag2's SQLite), whoever wrote them.

Sources: the definitions of `geometry_msgs`, `nav_msgs`, `sensor_msgs` and `tf2_msgs` (ROS 2's common_interfaces and
geometry2), `NamedPoseArray` of motion_capture_tracking_interfaces; CDR: after 4 bytes that say the order of bytes, each
field is aligned to its size; rosbag2's tables (`rosbag2_storage_sqlite3`); and REP 103: frames are east, north, up, and
one whose name ends in ``_ned`` is north, east, down.
"""

from __future__ import annotations

import math
import sqlite3
import struct
from array import array
from collections.abc import Iterator, Sequence
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np

from rigidfleet._common.tables import ContentError, fault
from rigidfleet.foreign.columns import yaws_of
from rigidfleet.foreign.logs import Channel, Log, choose
from rigidfleet.typing import Floats

MCAP, SQLITE = b"\x89MCAP0\r\n", b"SQLite format 3\0"
_BILLION = 1_000_000_000
#: Greatest size of a chunk of a recording when it is unpacked, and of a message [bytes].
_CHUNK, _MESSAGE = 32 << 20, 1 << 20
#: What no position [m] or quaternion reaches.
_FAR = 1e9
#: What reading a damaged recording raises, besides the errors of `mcap`.
_DAMAGED = (
    ValueError,
    OverflowError,
    EOFError,
    KeyError,
    struct.error,
    RuntimeError,
    MemoryError,
    sqlite3.Error,
)
#: Numbers of a message after its names: a position and a quaternion (7), the covariance of a pose (36, by rows), and a
#: velocity in the vehicle's axes (3); or latitude, longitude [deg] and height [m] (3).
_NUMBERS = {
    "PoseStamped": 7, "PoseWithCovarianceStamped": 43, "Odometry": 46, "TransformStamped": 7, "TFMessage": 7,
    "NamedPoseArray": 7, "NavSatFix": 3,
}  # fmt: skip


class _Rows(NamedTuple):
    """Kind and frame of the first message of a vehicle; stamps [ns] and numbers of all."""

    message: str
    frame: str
    stamps: array[int]
    numbers: array[float]


def read_recording(paths: Sequence[Path], topics: Sequence[str]) -> Log:
    """The vehicles of the parts of a recording: topics with positions, or each body in such a topic.

    Without names of topics, those of one kind of message count, the one that is preferred of those that are there.

    Raises
    ------
    ContentError
        The package `mcap` is missing, the recording is damaged, or has no positions.
    """
    rows: dict[str, _Rows] = {}
    try:
        for topic, kind, data, received in (each for path in paths for each in _messages(path)):
            try:
                for who, frame, stamp, numbers in _decode(kind, data):
                    own = rows.setdefault(
                        f"{topic}{who}", _Rows(kind, frame, array("q"), array("d"))
                    )
                    own.stamps.append(stamp or received)
                    own.numbers.extend(numbers)
            except struct.error:
                where = f"{topic}: message {len(rows[topic].stamps) + 1 if topic in rows else 1}"
                raise fault(f"{where}: is cut off", "Record again") from None
    except ContentError:
        raise
    except ImportError as error:
        raise fault(f"is compressed, and a package is missing ({error})") from None
    except Exception as error:
        if not isinstance(error, _DAMAGED) and type(error).__module__ != "mcap.exceptions":
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        raise fault(f"the recording is damaged ({reason})", "Record again") from None
    channels = [Channel(name, own.message, _columns(own), own.frame) for name, own in rows.items()]
    chosen, notes = choose(channels, topics), []
    if not topics:
        chosen = [c for c in chosen if c.message == chosen[0].message]
        parts = {c.topic.rpartition(":")[2] for c in chosen if c.message == "TFMessage"}
        chosen = [c for c in chosen if c.frame not in parts]  # what moves in a body is a part of it
        others = sorted({c.topic for c in channels} - {c.topic for c in chosen})[:5]
        notes = [f"topics that are not read: {', '.join(others)}; --topic may name them"] * bool(
            others
        )
    return Log({c.topic: [c] for c in chosen}, "that of the stamps in messages", None, tuple(notes))


def _messages(path: Path) -> Iterator[tuple[str, str, bytes, int]]:
    """Topic, kind, content and time of recording [ns] of each message with positions."""
    with path.open("rb") as stream:
        records = _records_of_sqlite if stream.read(16) == SQLITE else _records_of_mcap
    for topic, name, code, data, received in records(path):
        if (kind := name.rpartition("/")[2]) in _NUMBERS and topic != "/tf_static":
            if code != "cdr":
                raise fault(f"{topic}: is encoded as {code!r}, not as CDR")
            yield topic, kind, data, received


def _records_of_sqlite(path: Path) -> Iterator[tuple[str, str, str, bytes, int]]:
    query = (
        "SELECT name, type, serialization_format, data, timestamp FROM messages JOIN topics ON topics.id = topic_id "
        f"WHERE length(data) < {_MESSAGE} ORDER BY timestamp"
    )
    with closing(sqlite3.connect(f"file:{quote(str(path.resolve()))}?mode=ro", uri=True)) as base:
        yield from base.execute(query)


def _records_of_mcap(path: Path) -> Iterator[tuple[str, str, str, bytes, int]]:
    if find_spec("mcap") is None:
        raise fault("needs the package 'mcap'", "Run: pip install rigidfleet[logs]")
    from mcap.reader import make_reader
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    with path.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk) and record.uncompressed_size > _CHUNK:
                more = f"unpacks to {record.uncompressed_size >> 20} MiB"
                raise fault(f"a chunk of it {more}", "Record poses")
        stream.seek(0)
        for schema, channel, message in make_reader(stream).iter_messages():
            name = "" if schema is None else schema.name
            yield channel.topic, name, channel.message_encoding, message.data, message.log_time


def _decode(kind: str, data: bytes) -> Iterator[tuple[str, str, int, Sequence[float]]]:
    """Body ("" if the topic is of one), frame, stamp [ns] and numbers of each position in a message."""
    order, at = "<" if data[1:2] == b"\1" else ">", 4

    def read(form: str) -> tuple[Any, ...]:
        """Numbers of one size, from their place on."""
        nonlocal at
        size = struct.calcsize(f"={form[-1]}")
        at += -(at - 4) % size
        values = struct.unpack_from(order + form, data, at)
        at += size * len(values)
        return values

    def text() -> str:
        nonlocal at
        (length,) = read("I")
        at += length
        return bytes(data[at - length : at - 1]).decode(errors="replace")

    for _ in range(*read("I") if kind == "TFMessage" else (1,)):
        stamp, frame = read("i")[0] * _BILLION + read("I")[0], text()
        if kind == "NamedPoseArray":
            yield from ((f":{text()}", frame, stamp, read("7d")) for _ in range(*read("I")))
            return
        if kind == "NavSatFix":
            fixed = read("b")[0] >= 0 and read("H")
            yield "", frame, stamp, read("3d") if fixed else (math.nan,) * 3
            return
        who = f":{text()}" if kind in ("TransformStamped", "TFMessage", "Odometry") else ""
        yield who if kind != "Odometry" else "", frame, stamp, read(f"{_NUMBERS[kind]}d")


def _columns(rows: _Rows) -> dict[str, Floats]:
    """Columns as forms of messages name them; velocities are turned into the frame of positions."""
    table, time = np.frombuffer(rows.numbers).reshape(len(rows.stamps), -1), np.asarray(rows.stamps)
    if rows.message == "NavSatFix":
        return dict(zip(("time", "lat", "lon", "alt"), (time, *table.T), strict=True))
    known = np.asarray(np.abs(table[:, :7]).max(axis=1) < _FAR)
    columns: dict[str, Any] = {
        "time": time, "x": np.where(known, table[:, 0], np.nan),
        "y": table[:, 1], "z": table[:, 2], "yaw": yaws_of(np.where(known[:, None], table[:, 3:7], 0.0)),
    }  # fmt: skip
    if table.shape[1] > 7:
        columns |= {f"var_{axis}": table[:, 7 + 7 * k] for k, axis in enumerate("xyz")}
    if table.shape[1] > 43:
        vector, scalar, v = table[:, 3:6], table[:, 6:7], table[:, 43:46]
        v = v + 2.0 * np.cross(vector, np.cross(vector, v) + scalar * v)
        columns |= {f"v{axis}": v[:, k] for k, axis in enumerate("xyz")}
    return columns
