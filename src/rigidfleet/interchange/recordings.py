"""Recordings for viewers and for ROS 2: MCAP with ROS 2 messages, and Rerun's .rrd.

Sources: the definitions of `geometry_msgs` and `std_msgs` (ROS 2 common_interfaces), OMG's CDR as ROS 2 writes it
(little-endian, fields aligned to their size), and MCAP's profile "ros2".
"""

from __future__ import annotations

import io
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rigidfleet.foreign.columns import yaws_of
from rigidfleet.foreign.curves import curve_through_states
from rigidfleet.interchange.curves import ExportedMotion
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.typing import Floats

#: Fields of each type of message, in the order in which definitions name the types.
_FIELDS = {
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
}
#: Types of the parts of a pose and of a twist.
_PARTS = {"Pose": ("Point", "Quaternion"), "Twist": ("Vector3",)}
#: Both messages in CDR: mark of little-endian CDR, stamp, length and text of the frame's name, numbers.
_FRAME = b"map\0"
_START = struct.Struct("<4siII4s")
_CDR = b"\0\1\0\0"
_BILLION = 1_000_000_000


def write_mcap(motion: ExportedMotion, rate: float | None) -> Iterator[bytes]:
    """One file: topics /agent_i/pose (PoseStamped) and /agent_i/twist (TwistStamped), in world axes, frame "map"."""
    from mcap.writer import Writer

    setpoints = motion.at_rate(rate)
    n = motion.n_agents
    poses = np.concatenate([setpoints.state[:, 0], _yaw_quaternions(setpoints.yaw)], axis=2)
    turning = np.zeros((*setpoints.yaw.shape, 3))
    turning[..., 2] = setpoints.yaw_rate
    twists = np.concatenate([setpoints.state[:, 1], turning], axis=2)
    buffer = io.BytesIO()
    writer = Writer(buffer)
    writer.start(profile="ros2", library="rigidfleet")
    channels = []
    for kind in _PARTS:
        name, words = f"geometry_msgs/msg/{kind}Stamped", _ros_definition(kind)
        schema = writer.register_schema(name=name, encoding="ros2msg", data=words.encode())
        topics = [f"/agent_{i + 1}/{kind.lower()}" for i in range(n)]
        channels.append([writer.register_channel(topic, "cdr", schema) for topic in topics])
    for k, t in enumerate(setpoints.time.tolist()):
        at = round(t * _BILLION)
        start = _START.pack(_CDR, at // _BILLION, at % _BILLION, len(_FRAME), _FRAME)
        for ids, rows in zip(channels, (poses[k], twists[k]), strict=True):
            for channel, row in zip(ids, rows.astype("<f8"), strict=True):
                writer.add_message(channel, at, start + row.tobytes(), at, k)
    writer.finish()
    yield buffer.getvalue()


def _ros_definition(kind: str) -> str:
    """The definition of a stamped pose or twist, and of all types that it has, as ROS 2 writes it."""
    types = [f"geometry_msgs/{name}" for name in (kind, *_PARTS[kind])]
    fields = f"std_msgs/Header header\n{types[0]} {kind.lower()}"
    types += ["std_msgs/Header", "builtin_interfaces/Time"]
    return "".join([fields, *(f"\n{'=' * 80}\nMSG: {name}\n{_FIELDS[name]}" for name in types)])


def read_mcap(data: bytes) -> list[Piecewise]:
    """The ways in a file of `write_mcap`: cubics through its poses and twists."""
    from mcap.reader import make_reader

    rows_of: dict[str, list[Floats]] = {}
    for _, channel, message in make_reader(io.BytesIO(data)).iter_messages():
        sec, nanosec = struct.unpack_from("<iI", message.data, 4)
        numbers = np.frombuffer(message.data, "<f8", offset=_START.size)
        rows_of.setdefault(channel.topic, []).append(np.append(sec + nanosec / _BILLION, numbers))
    curves = []
    for i in range(1, len(rows_of) // 2 + 1):
        pose, twist = (np.array(rows_of[f"/agent_{i}/{kind}"]) for kind in ("pose", "twist"))
        states = np.stack([pose[:, 1:4], twist[:, 1:4]])
        yaw = np.stack([np.unwrap(yaws_of(pose[:, 4:])), twist[:, 6]])
        curves.append(curve_through_states(pose[:, 0], states, yaw))
    return curves


def write_rrd(motion: ExportedMotion, rate: float | None) -> Iterator[bytes]:
    """One recording: a frame that moves for each vehicle, with a ball of its radius, on the timeline "time"."""
    import rerun as rr

    setpoints = motion.at_rate(rate)
    recording = rr.RecordingStream("rigidfleet", recording_id=motion.result.mission.name)
    stream = recording.binary_stream()
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    times = rr.TimeColumn("time", duration=setpoints.time)
    quaternions = _yaw_quaternions(setpoints.yaw)
    for i, radius in enumerate(motion.result.mission.fleet.radius.tolist()):
        name = f"vehicles/{i + 1}"
        ball = rr.Points3D([[0.0, 0.0, 0.0]], radii=radius, labels=str(i + 1), show_labels=False)
        recording.log(name, ball, static=True)
        places, turns = setpoints.state[:, 0, i], quaternions[:, i]
        moved = rr.Transform3D.columns(translation=places, quaternion=turns)
        recording.send_columns(name, [times], moved)
    recording.flush()
    data = stream.read()
    recording.disconnect()
    yield data or b""


def read_rrd(data: bytes) -> list[Piecewise]:
    """The ways in a recording of `write_rrd`: straight lines through its positions."""
    from rerun.chunk import RrdReader

    curves = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "read.rrd")
        path.write_bytes(data)
        for chunk in RrdReader(str(path)).stream().to_chunks():
            batch = chunk.to_record_batch()
            if "Transform3D:translation" not in batch.schema.names:
                continue
            time = batch["time"].cast("int64").to_numpy() / _BILLION
            columns = [
                np.array(batch[f"Transform3D:{name}"].flatten().flatten()).reshape(len(time), -1)
                for name in ("translation", "quaternion")
            ]
            number = int(chunk.entity_path.rpartition("/")[2])
            curves.setdefault(number, []).append(np.column_stack([time, *columns]))
    ways = []
    for number in sorted(curves):
        rows = np.concatenate(curves[number])
        rows = rows[rows[:, 0].argsort()]
        yaw = np.unwrap(yaws_of(rows[:, 4:]))
        ways.append(curve_through_states(rows[:, 0], rows[None, :, 1:4], yaw[None]))
    return ways


def _yaw_quaternions(yaw: Floats) -> Floats:
    """Quaternions (..., 4), scalar last, body to world, of turns about the vertical."""
    zero = np.zeros_like(yaw)
    return np.stack([zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)], axis=-1)
