"""MAVLink: a log of offboard setpoints (.tlog) for PX4 and ArduPilot.

Sources: MAVLink's `common.xml` (messages 48, 76 and 84, command 400), and its packet format of version 1 with the
checksum CRC-16/MCRF4XX. Local axes are north, east, down: (N, E, D) = (y, x, -z), and yaw is clockwise from north.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from rigidfleet.foreign.curves import curve_through_states
from rigidfleet.interchange.curves import ExportedMotion
from rigidfleet.math.geodesy import turn_to_enu
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.setpoints import setpoints_at
from rigidfleet.typing import Ints

#: SET_POSITION_TARGET_LOCAL_NED: number, extra byte of the checksum, and fields in the order of the wire.
_TARGET, _TARGET_EXTRA = 84, 143
_FIELDS = np.dtype(
    [("time_boot_ms", "<u4"), ("state", "<f4", (3, 3)), ("yaw", "<f4"), ("yaw_rate", "<f4"), ("type_mask", "<u2"),
     ("target_system", "u1"), ("target_component", "u1"), ("coordinate_frame", "u1")]
)  # fmt: skip
#: A record of a log: microseconds, then the packet: its head, and behind its fields the checksum.
_HEAD = [("time", ">u8"), ("mark", "u1"), ("length", "u1"), ("sequence", "u1"), ("system", "u1"), ("component", "u1"),
         ("message", "u1")]  # fmt: skip
_CHECKSUM = [("checksum", "<u2")]
#: COMMAND_LONG: number, extra byte and fields; the command that arms (1) or disarms (0).
_COMMAND, _COMMAND_EXTRA, _ARM_DISARM = 76, 152, 400
_COMMAND_FIELDS = np.dtype("7<f4, <u2, u1, u1, u1")
#: SET_GPS_GLOBAL_ORIGIN: number, extra byte and fields.
_ORIGIN, _ORIGIN_EXTRA = 48, 41
_ORIGIN_FIELDS = np.dtype("<i4, <i4, <i4, u1")
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
        fields: Any = np.zeros(len(milliseconds), dtype=_FIELDS)
        fields["time_boot_ms"] = milliseconds
        fields["state"] = turn_to_enu(setpoints.state[flies, :3, 0], "ned")
        fields["yaw"] = (np.pi / 2 - setpoints.yaw[flies, 0] + np.pi) % (2.0 * np.pi) - np.pi
        fields["yaw_rate"] = -setpoints.yaw_rate[flies, 0]
        fields["target_system"], fields["target_component"] = system, _AUTOPILOT
        fields["coordinate_frame"] = _LOCAL_NED
        count = np.arange(len(fields)) + 1
        flown = _records(milliseconds, _TARGET, fields, _TARGET_EXTRA, count % 256)
        disarmed = b"" if off > every[-1] else _disarm_record(milliseconds[-1:], system)
        yield _origin_record(motion, system) + flown + disarmed


def read_tlog(data: bytes) -> list[Piecewise]:
    """The way in a log: cubics through its positions and velocities."""
    first = 8 + 8 + data[9]
    if data[13] == _ORIGIN:
        data = data[first:]
    kind = np.dtype([*_HEAD, ("fields", _FIELDS), *_CHECKSUM])
    records: Any = np.frombuffer(data, kind, len(data) // kind.itemsize)
    fields = records["fields"]
    state = turn_to_enu(fields["state"], "ned").swapaxes(0, 1)
    north, rate = fields["yaw"].astype(float), fields["yaw_rate"].astype(float)
    yaw = np.stack([np.unwrap(np.pi / 2 - north), -rate])
    return [curve_through_states(fields["time_boot_ms"] / 1e3, state[:2], yaw)]


def _origin_record(motion: ExportedMotion, system: int) -> bytes:
    if (origin := motion.result.mission.geodetic_origin) is None:
        return b""
    place = round(1e7 * origin.latitude_deg), round(1e7 * origin.longitude_deg)
    fields = np.array([(*place, round(1e3 * origin.altitude), system)], _ORIGIN_FIELDS)
    return _records(0, _ORIGIN, fields, _ORIGIN_EXTRA)


def _disarm_record(milliseconds: Ints, system: int) -> bytes:
    fields = np.array([((0.0,) * 7, _ARM_DISARM, system, _AUTOPILOT, 0)], _COMMAND_FIELDS)
    return _records(milliseconds, _COMMAND, fields, _COMMAND_EXTRA)


def _records(
    milliseconds: Any, message: int, fields: np.ndarray, extra: int, sequence: Any = 0
) -> bytes:
    """Records of one kind of message, of fields (K,) at times [ms]."""
    records: Any = np.zeros(len(fields), [*_HEAD, ("fields", fields.dtype), *_CHECKSUM])
    records["time"], records["sequence"], records["fields"] = 1000 * milliseconds, sequence, fields
    records["mark"], records["length"] = _MARK, fields.itemsize
    records["system"], records["message"] = _STATION, message
    covered = records.view(np.uint8).reshape(len(records), -1)[:, 9:-2]
    records["checksum"] = _checksum(covered, extra)
    return records.tobytes()


def _checksum(data: np.ndarray, extra: int) -> np.ndarray:
    """CRC-16/MCRF4XX (K,) of rows of bytes (K, n), each followed by an extra byte."""
    crc = np.full(len(data), 0xFFFF, dtype=np.uint16)
    for byte in [*data.T.astype(np.uint16), np.uint16(extra)]:
        low = (byte ^ crc) & 0xFF
        low ^= (low << 4) & 0xFF
        crc = (crc >> 8) ^ (low << 8) ^ (low << 3) ^ (low >> 4)
    return crc
