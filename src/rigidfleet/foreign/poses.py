"""Poses in recordings of ROS 2 (MCAP), whoever wrote them.

Sources: `geometry_msgs/msg/PoseStamped` (ROS 2 common_interfaces), and CDR: after 4 bytes that say the order of bytes,
each field is aligned to its size.
"""

from __future__ import annotations

import io
import struct
from importlib.util import find_spec

import numpy as np

from rigidfleet._common.tables import ContentError, fault
from rigidfleet.foreign.columns import yaws_of
from rigidfleet.foreign.curves import Trajectories
from rigidfleet.foreign.samples import ASSUMED, curve_through_samples

_POSE = "geometry_msgs/msg/PoseStamped"
_BILLION = 1_000_000_000
#: Greatest size of what a recording, and a chunk of it, unpack to [bytes].
_BYTES, _CHUNK = 512 << 20, 32 << 20
#: What reading a damaged recording raises, besides the errors of `mcap`.
_DAMAGED = (ValueError, EOFError, KeyError, struct.error, RuntimeError, MemoryError)


def read_poses(data: bytes, interpolation: str) -> Trajectories:
    """A curve for each topic with poses.

    If stamps are dates, times count from the first pose of the recording, otherwise from zero.

    Raises
    ------
    ContentError
        The package `mcap` is missing, the recording is damaged, has no poses, or its stamps do not increase.
    """
    if find_spec("mcap") is None:
        missing = "needs the package 'mcap', which is not installed"
        raise fault(missing, "Run: pip install mcap")
    topics = _poses_by_topic(data)
    if not topics:
        raise fault(f"has no {_POSE}", "Record the topics with the vehicles' poses")
    first = min(rows[0][0] for rows in topics.values())
    dated = first > 1_000_000 * _BILLION
    curves = []
    for topic, rows in topics.items():
        table = np.array([row[1:] for row in rows])
        nanoseconds = np.array([row[0] - first for row in rows])  # whole numbers lose none
        known = np.isfinite(table).all(axis=1)  # the others are gaps
        if not known.any():
            raise fault(f"{topic}: no pose is finite", "Leave it out")
        time = nanoseconds[known] / _BILLION + (0.0 if dated else first / _BILLION)
        place, yaw = table[known, :3], yaws_of(table[known, 3:])
        where = lambda k, topic=topic: f"{topic}: message {k + 1}"  # noqa: E731
        curves.append(curve_through_samples(time, place, yaw, interpolation, where))
    record = {"since_1970_ns": int(first) if dated else None}
    return Trajectories(tuple(topics), tuple(curves), ASSUMED[interpolation], (), (record,))


def _poses_by_topic(data: bytes) -> dict[str, list[tuple[float, ...]]]:
    """Stamp [ns], position and quaternion (scalar last) of each pose, by topic."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    topics: dict[str, list[tuple[float, ...]]] = {}
    try:
        records = StreamReader(io.BytesIO(data), emit_chunks=True).records
        sizes = [x.uncompressed_size for x in records if isinstance(x, Chunk)]
        if sum(sizes) > _BYTES or max(sizes, default=0) > _CHUNK:
            more = f"unpacks to {max(sizes) >> 20} MiB, all to {sum(sizes) >> 20}"
            raise fault(f"a chunk of it {more}", "Record poses")
        for schema, channel, message in make_reader(io.BytesIO(data)).iter_messages():
            if schema is None or schema.name not in (_POSE, "geometry_msgs/PoseStamped"):
                continue
            if channel.message_encoding != "cdr":
                other = f"is encoded as {channel.message_encoding!r}, not as CDR"
                raise fault(f"{channel.topic}: {other}")
            rows = topics.setdefault(channel.topic, [])
            try:
                rows.append(_pose(message.data))
            except struct.error:
                where = f"{channel.topic}: message {len(rows) + 1}"
                raise fault(f"{where}: is cut off", "Record again") from None
    except ContentError:
        raise
    except (McapError, *_DAMAGED) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise fault(f"the recording is damaged ({reason})", "Record again") from None
    except ImportError as error:
        raise fault(f"is compressed, and a package is missing ({error})") from None
    return topics


def _pose(data: bytes) -> tuple[float, ...]:
    """Stamp [ns], position and quaternion of a PoseStamped in CDR."""
    order = "<" if data[1:2] == b"\1" else ">"
    sec, nanosec, length = struct.unpack_from(f"{order}iII", data, 4)
    start = 16 + length
    start += -(start - 4) % 8
    return sec * _BILLION + nanosec, *struct.unpack_from(f"{order}7d", data, start)
