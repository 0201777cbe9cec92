"""Logs of autopilots: ULog of PX4, MAVLink's telemetry logs, and ArduPilot's binary ones.

Sources: PX4's messages (`msg/versioned/VehicleLocalPosition.msg` and its neighbours; `eph` is the root of the sum of
two variances, `get_ekf_lpos_accuracy` in its EKF2), MAVLink's `common.xml`, and ArduPilot's `LogStructure.h` (of
AP_NavEKF3, AP_AHRS and AP_GPS; states 7 to 9 of a filter are the position). All of them are north, east, down, and yaw
is clockwise from north. Of MAVLink's ODOMETRY, `MAV_FRAME` says the frame; of PX4's odometry, ``pose_frame``, or
``local_frame`` before version 1.14.
"""

from __future__ import annotations

import io
import math
import re
import struct
from array import array
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, redirect_stderr, redirect_stdout
from fnmatch import fnmatchcase
from importlib.util import find_spec
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidfleet._common.tables import ContentError, fault
from rigidfleet._common.text import first_few
from rigidfleet.foreign.columns import doubt_about_heights
from rigidfleet.foreign.curves import ASSUMED, LoggedStates, Trajectories, curve_through_samples
from rigidfleet.math.geodesy import Geodetic, enu_of, turn_to_enu
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.typing import Floats, Ints

#: Nanoseconds since 1970 from which on a stamp is a date; by how much a stamp goes back if a clock begins anew.
_DATES, _ANEW = 10**15, 10**9
#: A step of a position that its velocities do not explain: the least [m], and in usual ones.
_JUMP, _UNUSUAL = 0.1, 20.0
#: Distance of two topics that are places of one vehicle [m], and times at which they are compared.
_TWINS, _TIMES = 0.05, 200
#: Bytes after the last message of a log of ArduPilot that are the rest of its pages.
_PAGES = 528
#: A message counts by itself if at least one of so many of its samples is valid and in order.
_USABLE = 10
#: A message that came earlier than is usual by more than this has a wrong time [ns].
_EARLY = 10 * 10**9
#: Greatest number of things that a note lists; what no position reaches [m].
_LISTED, FAR = 3, 1e9
#: How files begin; notes on what is damaged, and on whose clock dates are of.
ULOG, BIN = b"ULog\x01\x12\x35", b"\xa3\x95"
#: Bytes before the first message of a ULog, and the kinds of its messages (PX4's guide: ULog file format).
_ULOG_HEAD, _ULOG_KINDS = 16, frozenset(b"BFIMPQARDLCSO")
DAMAGED = "the log is damaged in part: what could be read is judged"
CUT = "the log ends in the middle of a message: it is judged up to there"
_ELLIPSOID = "heights are above the ellipsoid, that of the origin is above mean sea level: up to 100 m beside it"
GNSS = "that of the receiver of GNSS, true to its delay of some tenths of a second"


class _Fields(NamedTuple):
    """What a message says of a place.

    Attributes
    ----------
    frame : "ned", "enu", or "geodetic" (latitude, longitude, height; other vectors are north, east, down)
    place, velocity, yaw : names of fields; of those of yaw one is there
    spread : fields of variances along the axes, or of PX4's standard deviations
    units : of the three fields of the place, of velocities and of yaw, in m or deg, m/s and rad
    """

    frame: str
    place: str
    velocity: str = ""
    yaw: str = ""
    spread: str = ""
    units: tuple[float, float, float, float, float] = (1.0, 1.0, 1.0, 1.0, 1.0)


_DEGREE = math.radians(1.0)
_INTEGERS = (1e-7, 1e-7, 1e-3, 1e-2, 1e-2 * _DEGREE)
_EPH, _SHARES, _VARIANCES = "eph eph epv", np.sqrt([0.5, 0.5, 1.0]), "V07 V08 V09"
_LOCAL = _Fields("ned", "x y z", "vx vy vz", "heading yaw", _EPH)
_GLOBAL = _Fields("geodetic", "lat lon alt", spread=_EPH)
_GPS = _Fields("geodetic", "latitude_deg longitude_deg altitude_msl_m", spread=_EPH)
_ODOMETRY = _Fields("ned", "position[0] position[1] position[2]")
_ODOMETRY = _ODOMETRY._replace(spread=_ODOMETRY.place.replace("position", "position_variance"))
_COVARIANCES = "pose_covariance[0] pose_covariance[6] pose_covariance[11]"
_FRAMED = _Fields("ned", "x y z", spread=_COVARIANCES)
_FILTER = _Fields("ned", "PN PE PD", "VN VE VD", "Yaw", _VARIANCES, (1.0, 1.0, 1.0, 1.0, _DEGREE))
_POSE = _Fields("enu", "x y z", "vx vy vz", "yaw", "var_x var_y var_z")
#: What messages with places may have, those that are preferred first.
FORMS: dict[str, list[_Fields]] = {name: forms for *forms, names in (
    (_LOCAL, "vehicle_local_position"), (_ODOMETRY, _FRAMED, "vehicle_odometry"), (_GLOBAL, "vehicle_global_position"),
    (_GPS, _GLOBAL._replace(units=_INTEGERS), "vehicle_gps_position sensor_gps"),
    (_ODOMETRY, "vehicle_mocap_odometry vehicle_visual_odometry estimator_odometry"),
    (_LOCAL, "estimator_local_position"), (_GLOBAL, "estimator_global_position"),
    (_LOCAL, "vehicle_local_position_groundtruth"), (_GLOBAL, "vehicle_global_position_groundtruth"),
    (_Fields("ned", "x y z", "vx vy vz"), "LOCAL_POSITION_NED"),
    (_Fields("geodetic", "lat lon alt", "vx vy vz", "hdg", "", _INTEGERS), "GLOBAL_POSITION_INT"),
    (_FRAMED, "ODOMETRY"), (_Fields("ned", "x y z"), "ATT_POS_MOCAP"),
    (_Fields("geodetic", "lat lon alt", units=_INTEGERS), "GPS_RAW_INT"),
    (_FILTER, "XKF1 NKF1 EKF1"), (_Fields("geodetic", "Lat Lng Alt"), "POS GPS SIM"),
    (_POSE, "PoseStamped NamedPoseArray Odometry PoseWithCovarianceStamped TransformStamped TFMessage"),
    (_GLOBAL._replace(spread=""), "NavSatFix"),
) for name in names.split()}  # fmt: skip
#: What else of logs of ArduPilot and MAVLink is read, by message, and fields by which a vehicle is armed.
_BESIDE = {
    "ORGN": "Lat Lng Alt Type", "XKV1": _VARIANCES, "NKV1": _VARIANCES, "ARM": "ArmState",
    "XKF4": "PI SS", "NKF4": "PI SS", "GPS_GLOBAL_ORIGIN": "latitude longitude altitude",
    "HEARTBEAT": "base_mode autopilot", "BAD_DATA": "",
}  # fmt: skip
#: What fields are at least where a place is valid (a fix of GNSS in three dimensions is 3), and those that count how
#: often an estimator set it anew.
_VALID = dict.fromkeys(("xy_valid", "z_valid", "lat_lon_valid", "alt_valid", "is_ned"), 1)
_VALID |= {"fix_type": 3, "Status": 3, "has_place": 1}
_RESETS = [f"{name}reset_counter" for name in ("xy_", "z_", "lat_lon_", "alt_", "")]
#: Bits of the status of ArduPilot's filter (`AP_Nav_Common.h`): its place is known from its start, or on the Earth; its
#: height is. Without them it writes where it was, or what a receiver says.
_HORIZONTAL, _VERTICAL = 0b11000, 0b100000
#: What MAVLink writes for a heading that is not known [0.01 deg], and who is no autopilot.
_UNKNOWN, _NO_AUTOPILOT = 65535, 8
#: Frames of the Earth of MAVLink's `MAV_FRAME`: local ones that are turned anyhow are not read.
_FRAMES = {1: "local_ned", 4: "local_enu"}


class Channel(NamedTuple):
    """Samples of one topic.

    Attributes
    ----------
    topic, message : its name, and that of its messages
    columns : (K,) by field: ``time`` [ns], and where messages came later ``received`` [ns], too
    frame : the one of its positions, if the log names it
    reference : (K, 3) where on the Earth the origin of local positions is at each sample, if the log tells it
    """

    topic: str
    message: str
    columns: dict[str, Any]
    frame: str = ""
    reference: Floats | None = None


class Log(NamedTuple):
    """Channels of each vehicle ("" if it is the only one), whose clock they have, when it was armed, and notes.

    ``clock`` is empty if it is the vehicle's own, which counts from its start. ``armed`` has times [ns] and whether.
    """

    vehicles: dict[str, list[Channel]]
    clock: str
    armed: tuple[Ints, Any] | None = None
    notes: tuple[str, ...] = ()


def read_log(path: Path, head: bytes) -> Log:
    """The log of an autopilot, by how it begins.

    Raises
    ------
    ContentError
        A package is missing, or the log is damaged.
    """
    readers = {ULOG: _read_ulog, BIN: _read_bin}
    read = next((own for begin, own in readers.items() if head.startswith(begin)), _read_tlog)
    package = "pyulog" if read is _read_ulog else "pymavlink"
    if find_spec(package) is None:
        raise fault(f"needs the package {package!r}", "Run: pip install rigidfleet[logs]")
    complaints = _PrintCounter()
    try:
        with redirect_stdout(complaints), redirect_stderr(complaints):
            log = read(path)
    except Exception as error:  # a damaged log leads the packages to any
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise fault(f"the log is damaged ({reason})", "Copy it again") from None
    damaged = complaints.count and DAMAGED not in log.notes
    return log._replace(notes=(*log.notes, DAMAGED)) if damaged else log


class _PrintCounter(io.TextIOBase):
    """What a package prints of a damaged log: that it does, since it may be a line for each byte."""

    count = 0

    def write(self, text: str, /) -> int:
        """Count a text."""
        self.count += 1
        return len(text)


def choose_channels(channels: Sequence[Channel], topics: Sequence[str]) -> list[Channel]:
    """The channels whose topics are named, or all, in the order in which they are preferred.

    Raises
    ------
    ContentError
        There is none.
    """
    chosen = [c for c in channels if not topics or any(fnmatchcase(c.topic, t) for t in topics)]
    if not chosen:
        words = f" {' or '.join(topics)}" if topics else ""
        every = ", ".join(sorted(c.topic for c in channels)[:20]) or "none"
        raise fault(f"has no topic{words} with positions", f"Topics with positions are: {every}")
    return sorted(chosen, key=lambda c: [*FORMS].index(c.message))


def natural_sort_key(name: object) -> list[tuple[int, str]]:
    """Names in the order of the numbers in them: 2 before 10."""
    parts = re.split(r"(\d+)", str(name))
    return [(int(x), "") if x.isdecimal() and len(x) < 19 else (-1, x) for x in parts]


#: What to do if vehicles are in several frames.
ONE_FRAME = "Name topics of one frame: --topic"


def mixed_frames_in_words(frames: Collection[str]) -> str:
    """That vehicles are in several frames; "" if all are in one."""
    several = (
        f"positions are in frames {first_few(sorted(frames))}: where one is in another is not known"
    )
    return several if len(frames) > 1 else ""


def trajectories_of(
    log: Log, stem: str, interpolation: str, topics: Sequence[str], origin: Geodetic | None, several: bool
) -> Trajectories:  # fmt: skip
    """Curves through the places of a log, in east, north, up about an origin; vehicles in the order of their names.

    Without one, places are about the origin of the first vehicle's estimator, or its first place. Of ``several``
    vehicles, places about an origin that the log does not tell come last: those of two have nothing in common.

    Raises
    ------
    ContentError
        A vehicle has no valid position.
    """
    tracks: dict[str, _Track] = {}
    notes, above = {note: [""] for note in log.notes}, origin is not None
    several |= len(log.vehicles) > 1
    for who in sorted(log.vehicles, key=natural_sort_key):
        reasons, read = list[str](), list[tuple[Channel, _Track]]()
        channels = choose_channels(log.vehicles[who], topics)
        unlike = lambda c: several and FORMS[c.message][0].frame == "ned" and c.reference is None  # noqa: E731
        for channel in sorted(channels, key=unlike):
            try:
                track = _track_of(channel, origin)
                read += [(channel, track)] * (len(track.time) > 1)
                if topics or len(track.time) * _USABLE >= len(channel.columns["time"]):
                    break
                reasons.append(
                    f"{channel.topic}: of its samples, only {len(track.time)} are valid and in order"
                )
            except ContentError as error:
                reasons.append(str(error).rstrip("."))
        else:
            if not read:
                raise fault("; ".join(reasons[:_LISTED]), "Name a topic that has valid positions")
            channel, track = read[0]
        words = f"positions are those of {channel.topic}"
        if others := [c.topic for c in channels if c is not channel and not topics][:_LISTED]:
            words += f"; --topic may name {', '.join(others)}"
        other = [_ELLIPSOID] * (above and channel.message == "NavSatFix")
        for note in (*[words] * (who != channel.topic), *reasons[:1], *track.notes, *other):
            notes.setdefault(note, []).append(who)
        tracks[who or stem], origin = track, origin or track.origin
    every = tracks.values()
    first, last = min(int(x.time[0]) for x in every), max(int(x.time[-1]) for x in every)
    zero = first if first > _DATES else 0
    seconds = lambda time: (time - first) / 1e9 + (first - zero) / 1e9  # noqa: E731  # whole numbers lose none
    samples = [(seconds(x.time), x.place, x.yaw) for x in every]
    curves = [curve_through_samples(*own, interpolation, str) for own in samples]
    frames = {track.frame if track.origin is None else "geodetic" for track in every}
    if words := mixed_frames_in_words(frames):
        if not topics:
            raise fault(words, ONE_FRAME)
        notes[words] = [""]
    if not topics and all(who == track.topic for who, track in tracks.items()):
        _refuse_coincident([*tracks], curves)
    record: dict[str, Any] = {
        "topics": [*dict.fromkeys(track.topic for track in every)][:20], "frame": next(iter(every)).frame,
        "clock": log.clock or "the vehicle's own, from its start", "since_1970_ns": zero or None,
        "rows": sum(len(track.time) for track in every),
    }  # fmt: skip
    if any(track.origin for track in every):
        record["origin"] = list(origin or ())
    if log.armed is not None:
        time, on = log.armed
        k = np.flatnonzero(np.diff(np.concatenate([[0], on != 0, [0]])))
        spans = seconds(np.append(time, max([last, *time[-1:]]))[k].reshape(-1, 2))
        record["armed"] = [f"{a:.6g} to {b:.6g} s" for a, b in spans[:_LISTED]] or "never"
    return Trajectories(
        tuple(tracks), tuple(curves), ASSUMED[interpolation], tuple(notes_with_names(notes)), (record,),
        measured=tuple(track.measured for track in every), own_clocks=not log.clock,
    )  # fmt: skip


def _refuse_coincident(names: list[str], curves: list[Piecewise]) -> None:
    """Refuse two topics that are at one place most of the time.

    Raises
    ------
    ContentError
        There are such.
    """
    begins, ends = np.transpose([curve.time[[0, -1]] for curve in curves])
    t = np.linspace(begins.max(), ends.min(), _TIMES)
    place = np.stack([curve.at(t)[:, :3] for curve in curves])
    for k in range(1, len(place)):
        apart = np.median(np.linalg.norm(place[:k] - place[k], axis=2), axis=1)
        i = int(apart.argmin())
        if apart[i] < _TWINS and t[0] < t[-1]:  # one after the other may be at one place
            words = f"{names[i]} and {names[k]} are {apart[i]:.2g} m apart most of the time"
            raise fault(f"{words}: is that one vehicle?", "Name the topics of vehicles: --topic")


def notes_with_names(notes: dict[str, list[str]]) -> Iterator[str]:
    """Notes with the names of those whom they are on, unless it is the only one ("")."""
    for note, names in notes.items():
        yield f"{first_few(names, _LISTED)}: {note}" if any(names) else note


class _Track(NamedTuple):
    """Times (K,) [ns], places (K, 3) in east, north, up, and yaws (K,) of a vehicle, and what its log says beside."""

    topic: str
    frame: str
    time: Ints
    place: Floats
    yaw: Floats | None
    measured: LoggedStates
    origin: Geodetic | None
    notes: list[str]


def _track_of(channel: Channel, origin: Geodetic | None) -> _Track:
    """What a channel says of places.

    Raises
    ------
    ContentError
        It has no valid one.
    """
    columns, notes, reference = channel.columns, [], channel.reference
    form = next((f for f in FORMS[channel.message] if {*f.place.split()} <= columns.keys()), None)
    if form is None:
        raise fault(f"{channel.topic}: its messages are of a form that is not known")
    # The last word of the name of a frame says its axes, those of places on the Earth but where their receiver is.
    words = re.split(r"[^A-Za-z]+|(?<=[a-z])(?=[A-Z])", channel.frame)
    named = next(filter(None, reversed(words)), "").lower()
    assumed = form.frame == "geodetic" or named not in ("ned", "enu")
    frame = form.frame if assumed else named
    place = _stack_columns(columns, form.place) * form.units[:3]
    known = np.asarray(np.abs(place) < FAR).all(axis=1)
    known &= (place[:, :2] != 0.0).any(axis=1) | (frame != "geodetic")
    for name in _VALID.keys() & columns.keys():
        known &= columns[name] >= _VALID[name]
    if not known.any():
        why = "no position is valid"
        if not columns.get("is_ned", known | True).any():
            why = "positions are in a frame that is turned anyhow to north"
        raise fault(f"{channel.topic}: {why}")
    if not known.all():
        notes.append(f"{np.sum(~known):,} samples without a valid position are left out")
    rows = _increasing_rows(columns["time"], np.flatnonzero(known), notes)
    own = {name: column[rows] for name, column in columns.items()}
    time, place, velocity, deviation, yaw = own["time"], place[rows], None, None, None
    if "received" in own:  # as if the quickest message came at once
        late = own["received"] - time
        time = time + late[late > np.median(late) - _EARLY].min()
    axes = "enu" if frame == "enu" else "ned"
    if frame == "geodetic":
        if origin is None:
            notes.append("positions are about the first one: no origin is stated")
        origin = origin or (*place[0].tolist(),)
        place = enu_of(place, origin)
    else:
        if frame == "enu" and assumed and (words := doubt_about_heights(place[:, 2])):
            notes.append(f"{words} The last word of its frame, {channel.frame!r}, would be ned")
        place = turn_to_enu(place, axes)
        if reference is not None:
            origin = origin or (*reference[-1].tolist(),)
            place = place + enu_of(reference[rows], origin)
        elif frame == "ned":
            notes.append("positions are about a place that the log does not tell")
    if form.velocity and {*form.velocity.split()} <= own.keys():
        velocity = turn_to_enu(_stack_columns(own, form.velocity) * form.units[3], axes)
    if form.spread and {*form.spread.split()} <= own.keys():
        spread = np.maximum(_stack_columns(own, form.spread), 0.0)
        spread = spread * _SHARES if form.spread == _EPH else np.sqrt(spread)
        deviation = np.abs(turn_to_enu(np.where(spread > 0.0, spread, np.nan), axes))
    for name in {*form.yaw.split()} & own.keys():
        yaw = own[name].astype(np.float64) * form.units[4]
        yaw = yaw if frame == "enu" else 0.5 * np.pi - yaw
        yaw = yaw if np.isfinite(yaw).all() and (own[name] != _UNKNOWN).all() else None
    resets = _resets(own, time / 1e9, place, velocity)
    if len(resets):
        far = np.linalg.norm(place[resets] - place[resets - 1], axis=1)
        steps = zip(far[:_LISTED], (time[resets] - time[0]) / 1e9, strict=False)
        words = ", ".join(f"{x:.3g} m at {t:.6g} s" for x, t in steps)
        words += f" from its first sample ({len(resets):,} times in all): no vehicle flew that"
        notes.append(f"the estimator moves its position by {words}")
    origin = None if frame != "geodetic" and reference is None else origin
    frame = f"{frame} {channel.frame}".strip()
    count = max(len(time), 2), 3  # a single sample stays for a second
    beside = (None if x is None else np.resize(x, count) for x in (velocity, deviation))
    states = LoggedStates(*beside, resets)
    return _Track(channel.topic, frame, time, place, yaw, states, origin, notes)


def _stack_columns(columns: dict[str, Any], names: str) -> Floats:
    return np.column_stack([columns[name] for name in names.split()]).astype(np.float64)


def _increasing_rows(time: Any, rows: Ints, notes: list[str]) -> Ints:
    """Of some rows those with increasing times, of the longest part between two starts of the clock."""
    parts = np.split(rows, np.flatnonzero(np.diff(time[rows]) < -_ANEW) + 1)
    if len(parts) > 1:
        every, rows = len(rows), max(parts, key=len)
        words = f"the longest part counts, {len(rows):,} of {every:,} samples"
        notes.append(f"the clock begins anew: {words}")
    later = np.append(True, time[rows][1:] > np.maximum.accumulate(time[rows])[:-1])
    if not later.all():
        notes.append(f"{np.sum(~later):,} samples whose times repeat or go back are left out")
    return rows[later]


def _resets(columns: dict[str, Any], time: Floats, place: Floats, velocity: Floats | None) -> Ints:
    """Samples at which the estimator set the position anew: as it counts that, or as its velocities show."""
    if names := [name for name in _RESETS if name in columns]:
        again = (np.diff(_stack_columns(columns, " ".join(names)), axis=0) != 0.0).any(axis=1)
        return np.flatnonzero(again) + 1
    if velocity is None or len(time) < 2:
        return np.zeros(0, dtype=np.int64)
    moved = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(time)[:, None]
    far = np.linalg.norm(np.diff(place, axis=0) - moved, axis=1)
    return np.flatnonzero(far > max(_JUMP, _UNUSUAL * float(np.median(far)))) + 1


def _origins_at(order: Any, stated: dict[str, Any], names: str, units: Any = 1.0) -> Floats | None:
    """Where the origin was by what was stated last (K, 3), at first by the first statement; None without any.

    ``order`` (K,) increases from message to message, as that of the statements does: clocks may begin anew.
    """
    if not {*names.split()} <= stated.keys():
        return None
    place = _stack_columns(stated, names) * units
    known = np.isfinite(place).all(axis=1) & (place[:, :2] != 0.0).any(axis=1)
    if not known.any():
        return None
    return _latest(order, stated["order"][known], place[known])


def _latest(order: Any, stated: Any, values: Any) -> Any:
    """Of values that were stated in order the last ones at some places in it; at first the first."""
    return values[np.maximum(np.searchsorted(stated, order, side="right") - 1, 0)]


def _read_ulog(path: Path) -> Log:
    from pyulog import ULog

    with path.open("rb") as file:
        log = ULog(file, ["actuator_armed", *FORMS])
    channels, armed, after = [], None, 0
    dated = 1000 * log.start_timestamp > _DATES
    for data in (x.data for x in log.data_list if "time_utc_usec" in x.data and not dated):
        if (known := data["time_utc_usec"] > 0).any():
            late = data["time_utc_usec"].astype(np.int64) - data["timestamp"].astype(np.int64)
            after = int(np.median((late - data.get("timestamp_time_relative", 0))[known]))
    for x in log.data_list:
        topic = f"{x.name}:{x.multi_id}" if x.multi_id else x.name
        channels.append(channel_of_px4(topic, x.name, x.data, after))
        if x.name == "actuator_armed":
            armed = channels.pop().columns["time"], x.data["armed"]
    unknown, cut = _unknown_and_cut_messages(path)
    notes = [DAMAGED] * (log.file_corruption or unknown) + [CUT] * cut
    if lost := [x.duration / 1e3 for x in log.dropouts]:
        words = f"{sum(lost):.3g} s in all, at most {max(lost):.3g} s"
        notes.append(f"the logger lost data {len(lost):,} times, {words}")
    clock = GNSS if after else "the dates that the vehicle had" if dated else ""
    return Log({"": channels}, clock, armed, tuple(notes))


def _unknown_and_cut_messages(path: Path) -> tuple[bool, bool]:
    """Whether a ULog has a message of no known kind, where pyulog may stop as at the end of a log, and one that is cut.

    What was appended to a log begins where its flags say, whether or not the message before had ended.
    """
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        at, cut, appended = _ULOG_HEAD, False, ()
        if data[at + 2 : at + 12 : 9] == b"B\1":
            appended = struct.unpack_from("<3Q", data, at + 19)
        for end in (*filter(None, appended), len(data)):
            while at + 3 <= min(end, len(data)):
                if data[at + 2] not in _ULOG_KINDS:
                    return True, cut
                at += 3 + int.from_bytes(data[at : at + 2], "little")
            cut |= at != end
            at = end
    return False, cut


def channel_of_px4(topic: str, message: str, data: dict[str, Any], after: int = 0) -> Channel:
    """The samples of a message of PX4, whose times get ``after`` [us] added."""
    # Positions are of the time of the sample, which is a little before that of the message.
    stamp = data.get("timestamp_sample", data["timestamp"]).astype(np.int64)
    data["time"] = 1000 * (np.where(stamp > 0, stamp, data["timestamp"].astype(np.int64)) + after)
    for field, ned in (("pose_frame", 1), ("local_frame", 0)):
        if field in data:
            data["is_ned"] = data[field] == ned
    data["order"] = np.arange(len(stamp))
    origins = _origins_at(data["order"], data, "ref_lat ref_lon ref_alt")
    return Channel(topic, message, data, "", origins)


def _collect_columns(log: Any) -> dict[tuple[int, str, int], dict[str, Any]]:
    """Columns of the messages of a log that matter, by system, message and lane: a core, or a component of a system.

    ``time`` is that of the vehicle [ns], ``received`` when the message came to who wrote the log, ``order`` its number.
    """
    names = {name: own.split() for name, own in _BESIDE.items()}
    for name, ((_, *own, _), *_) in FORMS.items():
        names[name] = [*" ".join(own).split(), "frame_id", *_RESETS, *_VALID]
    rows: dict[tuple[int, str, int], array[float]] = defaultdict(lambda: array("d"))
    messages = iter(lambda: log.recv_match(type=[*names]), None)
    for number, message in enumerate(messages):
        kind, received = message.get_type(), message._timestamp
        who, lane = 0, getattr(message, "C", getattr(message, "I", 0))
        if hasattr(message, "get_srcSystem"):
            who, lane = message.get_srcSystem(), message.get_srcComponent()
        stamp = getattr(message, "time_usec", 0.0) / 1e6 or received
        stamp = getattr(message, "time_boot_ms", 1e3 * stamp) / 1e3
        own = (_number_of(message, *name.split("[")) for name in names[kind])
        laned = kind in FORMS or kind[1:] == "KF4"
        rows[who, kind, lane if laned else 0].extend((number, stamp, received, *own))
    table = {}
    for key, numbers in rows.items():
        own = np.frombuffer(numbers).reshape(-1, 3 + len(names[key[1]])).T
        columns = zip(names[key[1]], own[3:], strict=True)
        table[key] = {k: x for k, x in columns if np.isfinite(x).any()}
        with np.errstate(invalid="ignore"):  # what is no message has any time
            stamps = np.round(1e9 * own[1:3]).astype(np.int64)
        table[key] |= {"order": own[0], "time": stamps[0], "received": stamps[1]}
    return table


def _number_of(message: Any, field: str, index: str = "") -> float:
    """A field of a message, or the one with an index such as "0]" in it; NaN if there is none."""
    value: Any = getattr(message, field, math.nan)
    return value[int(index[:-1])] if index else value


def _read_bin(path: Path) -> Log:
    """Read a log of ArduPilot's: messages as channels, those of the main estimator first, and when it was armed."""
    from pymavlink.DFReader import DFReader_binary

    class Reader(DFReader_binary):
        """Reader with the index in Python, which gets over what is damaged, and whose messages can be caught."""

        def init_arrays_fast(self, progress_callback: Any = None) -> None:
            self.init_arrays(progress_callback)

    with closing(Reader(str(path))) as log:
        table = _collect_columns(log)
        last, kind = max((int(own[-1]), k) for k, own in enumerate(log.offsets) if len(own))
        notes = (DAMAGED,) if log.data_len - last > _PAGES else ()
        end = last + (log.formats[kind].len if kind in log.formats else _PAGES)
        rest = log.data_map[end : end + len(BIN)]
        if end > log.data_len or (rest and BIN.startswith(rest)):
            notes += (CUT,)
    beside = {kind: columns for (_, kind, _), columns in table.items() if kind in _BESIDE}
    channels, dated, origin = [], False, beside.get("ORGN", {})
    if origin:  # type 0 is the origin of the filter
        origin = {k: x[origin["Type"] == 0] for k, x in origin.items()}
    for (_, kind, lane), columns in table.items():
        if kind in _BESIDE:
            continue
        # What the same core says of itself; other messages have no such.
        dated, own = bool(columns["time"][0] > _DATES), table.get((0, f"{kind[0]}KF4", lane), {})
        del columns["received"]
        main = lane == (int(np.median(own["PI"])) if own else 0)
        if "SS" in own:
            status = _latest(columns["order"], own["order"], own["SS"]).astype(int)
            columns["has_place"] = (status & _HORIZONTAL > 0) & (status & _VERTICAL > 0)
        if main and own and (share := float(np.mean(own["PI"] != lane))):
            notes += (
                f"in {100 * share:.2g} % of the log, the estimator trusted another core than {kind}:{lane}",
            )
        if main and (own := beside.get(f"{kind[0]}KV1")):
            at = columns["time"], own["time"]
            columns |= {name: np.interp(*at, own[name]) for name in _VARIANCES.split()}
        place = _origins_at(columns["order"], origin, "Lat Lng Alt")
        made = Channel(f"{kind}:{lane}" if lane else kind, kind, columns, "", place)
        channels.insert(0 if main else len(channels), made)
    armed = (own["time"], own["ArmState"]) if (own := beside.get("ARM")) else None
    return Log({"": channels}, GNSS if dated else "", armed, notes)


def _read_tlog(path: Path) -> Log:
    """Read messages of MAVLink as a ground station stores them: channels of each system, and when it was armed.

    The time of a single autopilot's arming is known; of several systems it is not looked for.
    """
    from pymavlink.mavutil import mavlogfile

    with closing(mavlogfile(str(path))) as log:
        table = _collect_columns(log)
        cut = log.mav.buf_len() > 0
    vehicles: dict[int, list[Channel]] = defaultdict(list)
    for (who, kind, lane), columns in sorted(table.items(), key=lambda each: each[0][2]):
        if kind not in _BESIDE:
            kept, frame = "GPS_GLOBAL_ORIGIN", ""
            own = table.get((who, kept, 0), {})
            place = _origins_at(columns["order"], own, _BESIDE[kept], _INTEGERS[:3])
            if "frame_id" in columns:
                frame = _FRAMES.get(int(columns["frame_id"][0]), "")
                columns["is_ned"] = (columns["frame_id"] == columns["frame_id"][0]) & bool(frame)
            # An autopilot has the least number of those who tell of a system: a camera or a computer may, too.
            first = all(kind != other.message for other in vehicles[who])
            name = kind if first else f"{kind}:{lane}"
            vehicles[who].append(Channel(name, kind, columns, frame, place))
    armed, damaged = None, any(kind == "BAD_DATA" for _, kind, _ in table)
    notes = *[DAMAGED] * damaged, *[CUT] * cut
    named = {f"system {who}": channels for who, channels in vehicles.items()}
    if len(vehicles) < 2:
        ((who, channels),) = vehicles.items() or [(0, [])]
        if own := table.get((who, "HEARTBEAT", 0)):
            flies = own["autopilot"] != _NO_AUTOPILOT
            armed = own["received"][flies], own["base_mode"][flies].astype(int) & 128
        named = {"": channels}
    return Log(named, "that of who wrote the log, less the shortest delay", armed, notes)
