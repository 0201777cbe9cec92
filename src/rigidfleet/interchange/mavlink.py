"""MAVLink: a log of offboard setpoints (.tlog) for PX4 and ArduPilot.

Sources: MAVLink's `common.xml` (messages 48, 76 and 84, command 400), and its packet format of version 1 with the
checksum CRC-16/MCRF4XX. Local axes are north, east, down: (N, E, D) = (y, x, -z), and yaw is clockwise from north.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from rigidfleet.foreign.curves import curve_through_states
from rigidfleet.interchange.curves import ExportedMotion
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.setpoints import setpoints_at
from rigidfleet.typing import Floats

#: SET_POSITION_TARGET_LOCAL_NED: number, extra byte of the checksum, and fields in the order of the wire.
_TARGET, _TARGET_EXTRA = 84, 143
_FIELDS = np.dtype(
    [("time_boot_ms", "<u4"), ("state", "<f4", (3, 3)), ("yaw", "<f4"), ("yaw_rate", "<f4"), ("type_mask", "<u2"),
     ("target_system", "u1"), ("target_component", "u1"), ("coordinate_frame", "u1")]
)  # fmt: skip
#: A record of a log: microseconds, then the packet: its head, fields and checksum.
_RECORD = np.dtype(
    [("time", ">u8"), ("mark", "u1"), ("length", "u1"), ("sequence", "u1"), ("system", "u1"), ("component", "u1"),
     ("message", "u1"), ("fields", _FIELDS), ("checksum", "<u2")]
)  # fmt: skip
#: Time and head of the record of another message.
_HEAD = struct.Struct(">QBBBBBB")
#: COMMAND_LONG: number, extra byte and fields; the command that arms (1) or disarms (0).
_COMMAND, _COMMAND_EXTRA, _ARM_DISARM = 76, 152, 400
_COMMAND_FIELDS = struct.Struct("<7fHBBB")
#: SET_GPS_GLOBAL_ORIGIN: number, extra byte and fields.
_ORIGIN, _ORIGIN_EXTRA = 48, 41
_ORIGIN_FIELDS = struct.Struct("<iiiB")
_MARK, _STATION, _SYSTEMS = 0xFE, 255, 255
_LOCAL_NED, _AUTOPILOT = 1, 1


def write_tlog_of_each_vehicle(motion: ExportedMotion, rate: float | None) -> Iterator[bytes]:
    """A log for each vehicle: at each time a message that asks for position, velocity, acceleration, yaw and yaw rate.

    Vehicle i is system i (from 256 on, again from 1). Times are whole milliseconds since the start; states are those
    of these times. If the mission has a geodetic origin, the first message sets it. A vehicle that has landed for good
    is disarmed, and gets no more setpoints.
    """
    for agent in range(motion.n_agents):
        alone = motion.of_vehicle(agent)
        wanted = np.unique(np.round((alone.at_rate(rate).time - motion.start) * 1e3))
        setpoints = setpoints_at(alone.samples, np.minimum(wanted / 1e3 + motion.start, motion.end))
        every = np.round((setpoints.time - motion.start) * 1e3).astype(np.int64)
        off = 1e3 * (float(motion.result.motors_off[agent]) - motion.start)
        flies, system = every <= off, agent % _SYSTEMS + 1
        milliseconds = every[flies]
        records: Any = np.zeros(len(milliseconds), dtype=_RECORD)
        records["time"] = 1000 * milliseconds
        records["mark"], records["length"], records["system"] = _MARK, _FIELDS.itemsize, _STATION
        records["sequence"] = (np.arange(len(records)) + 1) % 256
        records["message"] = _TARGET
        fields = records["fields"]
        fields["time_boot_ms"] = milliseconds
        fields["state"] = _swap_enu_and_ned(setpoints.state[flies, :3, 0])
        fields["yaw"] = (np.pi / 2 - setpoints.yaw[flies, 0] + np.pi) % (2.0 * np.pi) - np.pi
        fields["yaw_rate"] = -setpoints.yaw_rate[flies, 0]
        fields["target_system"], fields["target_component"] = system, _AUTOPILOT
        fields["coordinate_frame"] = _LOCAL_NED
        covered = records.view(np.uint8).reshape(len(records), -1)[:, 9:-2]
        records["checksum"] = _checksum(covered, _TARGET_EXTRA)
        disarmed = b"" if off > every[-1] else _disarm_record(int(milliseconds[-1]), system)
        yield _origin_record(motion, system) + records.tobytes() + disarmed


def read_tlog(data: bytes) -> list[Piecewise]:
    """The way in a log: cubics through its positions and velocities."""
    first = 8 + 8 + data[9]
    if data[13] == _ORIGIN:
        data = data[first:]
    records: Any = np.frombuffer(data, dtype=_RECORD, count=len(data) // _RECORD.itemsize)
    fields = records["fields"]
    state = _swap_enu_and_ned(fields["state"].astype(float)).swapaxes(0, 1)
    north, rate = fields["yaw"].astype(float), fields["yaw_rate"].astype(float)
    yaw = np.stack([np.unwrap(np.pi / 2 - north), -rate])
    return [curve_through_states(fields["time_boot_ms"] / 1e3, state[:2], yaw)]


def _swap_enu_and_ned(x: Floats) -> Floats:
    """Vectors (..., 3) in north, east, down from east, north, up, or back."""
    return np.stack([x[..., 1], x[..., 0], -x[..., 2]], axis=-1)


def _origin_record(motion: ExportedMotion, system: int) -> bytes:
    if (origin := motion.result.mission.geodetic_origin) is None:
        return b""
    place = round(1e7 * origin.latitude_deg), round(1e7 * origin.longitude_deg)
    fields = _ORIGIN_FIELDS.pack(*place, round(1e3 * origin.altitude), system)
    return _mavlink_record(0, _ORIGIN, fields, _ORIGIN_EXTRA)


def _disarm_record(milliseconds: int, system: int) -> bytes:
    fields = _COMMAND_FIELDS.pack(*(0.0,) * 7, _ARM_DISARM, system, _AUTOPILOT, 0)
    return _mavlink_record(milliseconds, _COMMAND, fields, _COMMAND_EXTRA)


def _mavlink_record(milliseconds: int, message: int, fields: bytes, extra: int) -> bytes:
    record = _HEAD.pack(1000 * milliseconds, _MARK, len(fields), 0, _STATION, 0, message) + fields
    covered = np.frombuffer(record[9:], dtype=np.uint8)[None]
    return record + _checksum(covered, extra).astype("<u2").tobytes()


def _checksum(data: np.ndarray, extra: int) -> np.ndarray:
    """CRC-16/MCRF4XX (K,) of rows of bytes (K, n), each followed by an extra byte."""
    crc = np.full(len(data), 0xFFFF, dtype=np.uint16)
    for byte in [*data.T.astype(np.uint16), np.uint16(extra)]:
        low = (byte ^ crc) & 0xFF
        low ^= (low << 4) & 0xFF
        crc = (crc >> 8) ^ (low << 8) ^ (low << 3) ^ (low >> 4)
    return crc
