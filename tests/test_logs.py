"""Logs of autopilots and of ROS 2: read as others wrote them, compared with what their libraries read."""

import lzma
import os
import re
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rigidfleet as rf
from rigidfleet.cli.app import main
from rigidfleet.errors import ResultError, TrajectoryError
from rigidfleet.foreign.files import read_trajectories
from rigidfleet.math.geodesy import enu_of
from rigidfleet.simulation.as_logged import Doubts, judge_log
from rigidfleet.simulation.trajectories import result_of_trajectories

LOGS = Path(__file__).parent / "data" / "logs"
#: A folder with further public logs, such as pyulog's tests, which are too large to be kept.
MORE = os.environ.get("RIGIDFLEET_LOGS", "")


@pytest.fixture
def log(tmp_path):
    """A kept log, unpacked."""

    def unpack(name: str) -> Path:
        path = tmp_path / name
        if path.suffix in (".mcap", ".db3"):
            pytest.importorskip("mcap")
            return record(path)
        pytest.importorskip("pymavlink")
        path.write_bytes(lzma.decompress((LOGS / f"{name}.xz").read_bytes()))
        return path

    return unpack


def at_samples(read, i=0):
    """Times and places of a vehicle's samples."""
    curve = read.curves[i]
    return curve.time, curve.at(curve.time)[:, :3]


def measured(read, i=0) -> SimpleNamespace:
    """Velocities and deviations of a vehicle."""
    velocity, deviation = (np.asarray(x, dtype=float) for x in read.measured[i][:2])
    return SimpleNamespace(velocity=velocity, deviation=deviation)


def said(read, words: str) -> bool:
    return any(words in note for note in read.notes)


def flat(latitude, longitude, height, origin):
    """East, north, up near an origin, by the radii of curvature of WGS 84 there."""
    a, e2, lat = 6378137.0, 0.00669437999014, np.radians(origin[0])
    w = np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    north = np.radians(np.asarray(latitude) - origin[0]) * (a * (1 - e2) / w**3 + origin[2])
    east = np.radians(np.asarray(longitude) - origin[1]) * (a / w + origin[2]) * np.cos(lat)
    return np.stack([east, north, np.asarray(height) - origin[2]], axis=1)


def test_places_on_the_earth_are_those_of_its_curvature():
    """Within 100 m, east, north and up follow from the radii of curvature, to a millimetre; a mile up is up."""
    origin = (-35.36, 149.16, 580.0)
    lat, lon = origin[0] + np.array([0, 9e-4, -5e-4]), origin[1] + np.array([9e-4, 0, 7e-4])
    height = origin[2] + np.array([0.0, 30.0, -20.0])
    made = enu_of(np.stack([lat, lon, height], 1), origin)
    np.testing.assert_allclose(made, flat(lat, lon, height, origin), atol=2e-3)
    above = enu_of(np.array([[*origin[:2], origin[2] + 1609.0]]), origin)
    np.testing.assert_allclose(above, [[0, 0, 1609]], atol=1e-6)


# -- ArduPilot ---------------------------------------------------------------------------------------


def rows_of(path: Path, kind: str, *names: str, **only) -> np.ndarray:
    """Fields of messages as pymavlink reads them."""
    reader = pytest.importorskip("pymavlink.DFReader").DFReader_binary(str(path))
    rows = []
    while (m := reader.recv_match(type=[kind])) is not None:
        if all(getattr(m, key) == value for key, value in only.items()):
            rows.append([getattr(m, name) for name in names])
    reader.close()
    return np.array(rows, dtype=float)


def has_place(path: Path, core: int) -> np.ndarray:
    """Whether each place of a core counts: a message before it says that one over ground is known, and a height."""
    status = rows_of(path, "XKF4", "SS", C=core)[:, 0].astype(int)
    return (status & 0b11000 > 0) & (status & 0b100000 > 0)


def test_the_primary_core_of_ardupilot_is_read(log):
    """Of three cores the primary one: north, east, down in metres become east, north, up, as are velocities."""
    path = log("cores.bin")
    own = rows_of(path, "XKF1", "PN", "PE", "PD", "VN", "VE", "VD", "Yaw", "_timestamp", C=0)
    own = own[has_place(path, 0)]
    assert len(own) == 445
    read = read_trajectories(path)
    assert said(read, "58 samples without a valid position are left out")
    time, place = at_samples(read)
    np.testing.assert_allclose(place, own[:, [1, 0, 2]] * [1, 1, -1], atol=1e-12)
    np.testing.assert_allclose(measured(read).velocity, own[:, [4, 3, 5]] * [1, 1, -1])
    np.testing.assert_allclose(time + read.since, own[:, 7], atol=1e-6)
    yaw = read.curves[0].at(read.curves[0].time)[:, 3]
    np.testing.assert_allclose(np.cos(yaw), np.sin(np.radians(own[:, 6])), atol=1e-12)
    assert said(read, "positions are those of XKF1; --topic may name")
    assert read.read[0]["origin"] == pytest.approx([38.3149933, 26.6360348, 66.63])
    other = read_trajectories(path, topic="XKF1:2")
    own = rows_of(path, "XKF1", "PE", C=2)[has_place(path, 2)]
    np.testing.assert_allclose(at_samples(other)[1][:, 0], own[:, 0], atol=1e-12)


def test_variances_of_a_filter_are_those_of_its_position(log):
    """States 7 to 9 of ArduPilot's filter are north, east, down: their roots are deviations at that time."""
    path = log("cores.bin")
    own = rows_of(path, "XKV1", "V07", "V08", "V09", "_timestamp")
    read = read_trajectories(path)
    own = own[own[:, 3] >= read.since + read.curves[0].time[0]]
    at = [np.interp(own[:, 3] - read.since, read.curves[0].time, x)
          for x in measured(read).deviation.T]  # fmt: skip
    np.testing.assert_allclose(np.stack(at, 1), np.sqrt(own[:, [1, 0, 2]]), rtol=0.05)


def test_local_and_geodetic_positions_of_a_flight_agree(log):
    """A filter's metres from its origin and the latitudes in the log are one place, to 5 cm, and 20 cm up."""
    path = log("cores.bin")
    origin = (38.3149933, 26.6360348, 66.63)
    (t, local), (u, geodetic) = (
        at_samples(read_trajectories(path, topic=topic, origin=origin)) for topic in ("XKF1", "POS")
    )
    north = rows_of(path, "POS", "Lat", "Lng", "Alt")
    np.testing.assert_allclose(geodetic, flat(*north.T, origin), atol=1e-3)
    u, geodetic = u[-len(t) :] - u[-1], geodetic[-len(t) :]  # the filter knows its place later
    np.testing.assert_allclose(t - t[-1], u, atol=0.01)
    np.testing.assert_allclose(local[:, :2], geodetic[:, :2], atol=0.05)
    np.testing.assert_allclose(local[:, 2], geodetic[:, 2], atol=0.2)


def test_an_origin_moves_local_positions(log):
    """Metres from an estimator's origin are moved to the one that is stated, as a mission's is."""
    path = log("plane.bin")
    here, there = (-35.3626381, 149.1653685, 585.6), (-35.3636381, 149.1643685, 580.0)
    (_, about), (_, moved) = (at_samples(read_trajectories(path, origin=x)) for x in (None, there))
    shift = flat(*np.array([here]).T, there)
    np.testing.assert_allclose(moved - about, np.repeat(shift, len(about), 0), atol=5e-3)
    with pytest.raises(TrajectoryError, match=r"is no place on the Earth\. Give latitude"):
        read_trajectories(path, origin=(149.0, -35.0, 0.0))


def test_a_log_is_cut_or_damaged(log, tmp_path):
    """A log that ends in the middle of a message is read up to there; what is lost behind noise is told."""
    path = log("cores.bin")
    data = path.read_bytes()
    whole = read_trajectories(path)
    path.write_bytes(data[: len(data) * 2 // 3 + 5])
    part = read_trajectories(path)
    n = len(part.curves[0].time)
    assert 200 < n < len(whole.curves[0].time)
    np.testing.assert_allclose(at_samples(part)[1], at_samples(whole)[1][:n])
    assert said(part, CUT)
    path.write_bytes(data[:150_000] + b"\xff" * 3000 + data[150_000:])
    part = read_trajectories(path)
    n = len(part.curves[0].time)
    np.testing.assert_allclose(at_samples(part)[1], at_samples(whole)[1][:n])
    assert said(part, "the log is damaged in part")


CUT = "the log ends in the middle of a message"


@pytest.mark.parametrize("name", ["cores.bin", "copter.tlog", "cube.ulg", "sitl.ulg"])
def test_a_log_that_is_cut_short_is_told(log, name):
    """A log that ends within a message says so, at whatever byte of it; one that ends with a message does not."""
    if name.endswith("ulg"):
        pytest.importorskip("pyulog")
    path = log(name)
    data = path.read_bytes()
    assert not said(read_trajectories(path, gaps="bridge"), CUT)
    for cut in (1, 2, 3, 5, 8, 9):
        path.write_bytes(data[:-cut])
        read = read_trajectories(path, gaps="bridge")
        assert said(read, CUT)
        assert not said(read, "damaged")


# -- MAVLink -----------------------------------------------------------------------------------------


def mavlink(path: Path, kind: str, *names: str) -> np.ndarray:
    """Fields of messages as pymavlink reads them."""
    reader = pytest.importorskip("pymavlink.mavutil").mavlogfile(str(path))
    rows = []
    while (m := reader.recv_match(type=[kind])) is not None:
        rows.append([getattr(m, name) for name in names])
    reader.close()
    return np.array(rows, dtype=float)


def test_a_telemetry_log_has_the_clock_of_its_writer(log):
    """Stamps are the vehicle's, later by the least delay of its messages; a restart ends a part of the log."""
    path = log("copter.tlog")
    own = mavlink(
        path,
        "GLOBAL_POSITION_INT",
        "lat",
        "lon",
        "alt",
        "vx",
        "vy",
        "vz",
        "time_boot_ms",
        "_timestamp",
    )
    starts = np.flatnonzero(np.diff(own[:, 6]) < -1000) + 1
    parts = np.split(own, starts)
    assert len(parts) == 3
    own = max(parts, key=len)
    origin = (*own[0, :2] / 1e7, 0.0)
    read = read_trajectories(path, topic="GLOBAL_POSITION_INT", gaps="bridge", origin=origin)
    time, place = at_samples(read)
    np.testing.assert_allclose(place, flat(*(own[:, :3] / [1e7, 1e7, 1e3]).T, origin), atol=0.01)
    np.testing.assert_allclose(measured(read).velocity, own[:, [4, 3, 5]] / [100, 100, -100])
    late = own[:, 7] - (time + read.since)
    assert late.min() == pytest.approx(0.0, abs=1e-5)
    np.testing.assert_allclose(np.diff(time), np.diff(own[:, 6]) / 1e3, atol=1e-6)
    assert said(read, "the clock begins anew: the longest part counts")
    assert "armed" in read.read[0]


@pytest.mark.parametrize(("frame", "turned"), [(1, [1, 0, 2]), (4, [0, 1, 2])])
def test_odometry_of_mavlink_is_of_its_frame(tmp_path, frame, turned):
    """What pymavlink writes in north, east, down or east, north, up is read; a frame of the vehicle's start is not."""
    common = pytest.importorskip("pymavlink.dialects.v20.common")
    writer = common.MAVLink(None, 1, 1)
    place = np.array([[0.5 * k, 1.0 - 0.25 * k, -2.0 - 0.125 * k] for k in range(40)])

    def write(name, frame):
        variances = [
            0.25 if k == 0 else 0.0625 if k == 6 else 1.0 if k == 11 else 0.0 for k in range(21)
        ]
        packets = []
        for k, x in enumerate(place.tolist()):
            m = common.MAVLink_odometry_message(
                3_000_000 + 50_000 * k,
                frame,
                12,
                *x,
                [1, 0, 0, 0],
                *[0] * 6,
                variances,
                [0] * 21,
                2 * (k >= 30),
            )
            received = 1_700_000_000_000_000 + 50_000 * k + 10_000 * (k % 4)
            packets.append(struct.pack(">Q", received) + m.pack(writer))
        (tmp_path / name).write_bytes(b"".join(packets))
        return tmp_path / name

    path = write("one.tlog", frame)
    assert mavlink(path, "ODOMETRY", "frame_id", "y")[-1].tolist() == [frame, place[-1, 1]]
    read = read_trajectories(path)
    time, own = at_samples(read)
    up = -1.0 if frame == 1 else 1.0
    np.testing.assert_allclose(own, place[:, turned] * [1.0, 1.0, up])
    np.testing.assert_allclose(time + read.since, 1.7e9 + 0.05 * np.arange(40), atol=1e-6)
    np.testing.assert_allclose(measured(read).deviation, [np.array([0.5, 0.25, 1.0])[turned]] * 40)
    assert said(read, "the estimator moves its position by")
    with pytest.raises(TrajectoryError, match="ODOMETRY: positions are in a frame that is turned"):
        read_trajectories(write("start.tlog", 20))


def telemetry(path: Path, rows) -> Path:
    """A log that pymavlink packs: when each message came [us], from which system and component."""
    common = pytest.importorskip("pymavlink.dialects.v20.common")
    parts = []
    for received, system, component, name, values in rows:
        message = getattr(common, f"MAVLink_{name}_message")(*values)
        packed = message.pack(common.MAVLink(None, system, component))
        parts.append(struct.pack(">Q", received) + packed)
    path.write_bytes(b"".join(parts))
    return path


def test_a_system_is_its_autopilot(tmp_path):
    """A computer beside an autopilot has a clock and places of its own, and a camera is never armed."""
    rows = []
    for k in range(100):
        t = 1_700_000_000_000_000 + 100_000 * k
        rows += [(t, 1, 191, "local_position_ned", (900_000 + 100 * k, 50.0, 0.1 * k, -9.0, 0, 0, 0)),
                 (t, 1, 1, "local_position_ned", (5000 + 100 * k, 0.1 * k, 0.0, -1.0, 1, 0, 0)),
                 (t, 1, 154, "heartbeat", (30, 8, 0, 0, 4, 3)),
                 (t, 1, 1, "heartbeat", (2, 3, 129 if 20 <= k < 80 else 1, 0, 4, 3))]  # fmt: skip
    path = telemetry(tmp_path / "one.tlog", rows)
    read = read_trajectories(path)
    place = np.stack([np.zeros(100), 0.1 * np.arange(100), np.ones(100)], axis=1)
    np.testing.assert_allclose(at_samples(read)[1], place, atol=1e-6)
    assert read.read[0]["armed"] == ["2 to 8 s"]
    assert said(read, "--topic may name LOCAL_POSITION_NED:191")
    other = at_samples(read_trajectories(path, topic="LOCAL_POSITION_NED:191"))[1]
    np.testing.assert_allclose(other[:, 1:], [[50.0, 9.0]] * 100)


def test_vehicles_of_which_no_origin_is_known_are_compared_on_the_earth(tmp_path):
    """Systems at their own zeros do not collide: of several, places on the Earth count, in one log or in several."""
    rows, east = [], np.degrees(4.0 / (6_378_137.0 * np.cos(np.radians(47.4))))
    for k in range(50):
        for system in (10, 2):
            boot, longitude = 1000 * system + 100 * k, round(1e7 * (8.5 + east * (system == 10)))
            geodetic = 474_000_000 + 9 * k, longitude, 500_000
            rows += [(1_700_000_000_000_000 + 100_000 * k, system, 1, name, (boot, *values)) for name, values in (
                ("local_position_ned", (0.1 * k, 0, -1, 1, 0, 0)),
                ("global_position_int", (*geodetic, 0, 100, 0, 0, 65_535)))]  # fmt: skip
    parts = [telemetry(tmp_path / f"v{n}.tlog", [x for x in rows if x[1] == n]) for n in (2, 10)]
    for files, names in (
        (telemetry(tmp_path / "all.tlog", rows), ("system 2", "system 10")),
        (parts, ("v2", "v10")),
    ):
        read = read_trajectories(files)
        assert read.names == names
        apart = at_samples(read, 1)[1] - at_samples(read, 0)[1]
        np.testing.assert_allclose(apart, [[4.0, 0.0, 0.0]] * 50, atol=0.02)
    assert np.isnan(read.curves[0].at(np.zeros(1))[0, 3])  # a heading that is not known
    assert at_samples(read_trajectories(parts[0]))[1][-1, 1] == pytest.approx(4.9)  # alone


def test_places_on_the_earth_are_about_the_origin_of_the_mission(tmp_path, capsys, monkeypatch):
    """A vehicle beside its fence fails it, by its mission, by the result of that, and in a drill alike."""
    monkeypatch.chdir(tmp_path)
    rows = [
        (1_700_000_000_000_000 + 100_000 * k, 1, 1, "global_position_int",
         (100 * k, 470_000_000, 80_000_000 + 10 * k, 402_000, 0, 100, 0, 0, 65_535))
        for k in range(50)
    ]  # fmt: skip
    log = telemetry(Path("flight.tlog"), rows)
    plan = rf.Mission.from_dict({
        "schema_version": 1, "name": "plan",
        "geodetic_origin": {"latitude_deg": 47.0, "longitude_deg": 8.00002, "altitude": 400.0},
        "agents": {"mass": 1.0, "radius": 0.1, "position": [[0.0, 0.0, 2.0]]},
        "fences": [{"kind": "inclusion", "name": "yard", "polygon": [[-0.5, -9], [9, -9], [9, 9], [-0.5, 9]]}],
        "phases": [{"kind": "hold", "control": "open", "duration": 4.9}],
    })  # fmt: skip
    Path("plan.toml").write_text(plan.text)
    rf.simulate(plan).save("plan.nc")
    Path("drill.toml").write_text(f'mission = "plan.toml"\n[drill]\nfiles = ["{log}"]\n')
    words = "agent 1 crosses the fence 'yard' by 1.0"
    for judge in (
        ["plan.toml", str(log)],
        ["plan.nc", str(log)],
        [str(log), "--mission", "plan.toml"],
    ):
        assert main(["assess", *judge, *["--noise", "0.001"][: 2 * (len(judge) < 3)]]) == 1
        assert words in " ".join(capsys.readouterr().out.split()), judge
    assert main(["sweep", "drill.toml", "--quiet"]) == 2
    assert words in " ".join(capsys.readouterr().err.split())


def test_a_receiver_without_a_fix_tells_no_place(tmp_path):
    """Places count from a fix in three dimensions on, in MAVLink's messages and in PX4's."""
    fixes = [(1_700_000_000_000_000 + 200_000 * k, 1, 1, "gps_raw_int",
              (5_000_000 + 200_000 * k, 1 + (k >= 10) + (k >= 20), 474_000_000 + 90 * k, 85_000_000, 500_000, *[0] * 5))
             for k in range(50)]  # fmt: skip
    read = read_trajectories(telemetry(tmp_path / "a.tlog", fixes))
    assert len(read.curves[0].time) == 30
    assert said(read, "20 samples without a valid position are left out")
    rows = [
        (5_000_000 + 100_000 * k, 0, 474_000_000 + 90 * k, 85_500_000, 488_000, 3 * (k > 3))
        for k in range(20)
    ]
    topic = ("vehicle_gps_position", 0, [*GPS, ("uint8_t", "fix_type")], rows)
    assert len(read_trajectories(ulog(tmp_path / "a.ulg", [topic])).curves[0].time) == 16


def test_jumps_of_an_estimator_are_told(log, tmp_path):
    """Where a position moves against its velocity, when the estimator is set anew, a note says so."""
    path = log("cores.bin")
    assert not said(read_trajectories(path), "the estimator moves")
    reader = pytest.importorskip("pymavlink.DFReader").DFReader_binary(str(path))
    data, late = bytearray(path.read_bytes()), 0
    while (m := reader.recv_match(type=["XKF1"])) is not None:
        late += m.C == 0
        if m.C == 0 and late > 300:
            at = reader.offset - len(m.get_msgbuf())
            field = data.index(struct.pack("<f", m.PN), at)
            data[field : field + 4] = struct.pack("<f", m.PN + 1.5)
    reader.close()
    path.write_bytes(data)
    read = read_trajectories(path)
    (note,) = (x for x in read.notes if "the estimator moves" in x)
    assert re.search(r"by 1\.[4-7]\d* m at 24\.2", note), note


# -- PX4 ---------------------------------------------------------------------------------------------

LOCAL = [("uint64_t", "timestamp"), ("uint64_t", "timestamp_sample"), ("float", "x"), ("float", "y"), ("float", "z"),
         ("float", "vx"), ("float", "vy"), ("float", "vz"), ("float", "heading"), ("float", "eph"), ("float", "epv"),
         ("double", "ref_lat"), ("double", "ref_lon"), ("float", "ref_alt"), ("uint8_t", "xy_reset_counter"),
         ("bool", "xy_valid"), ("bool", "z_valid")]  # fmt: skip
GPS = [("uint64_t", "timestamp"), ("uint64_t", "time_utc_usec"), ("int32_t", "lat"), ("int32_t", "lon"),
       ("int32_t", "alt")]  # fmt: skip
CODES = {"uint64_t": "Q", "float": "f", "double": "d", "uint8_t": "B", "bool": "?", "int32_t": "i"}


def ulog(path: Path, topics, *, cut: int = 0, appended: bytes = b"") -> Path:
    """A log after PX4's description of ULog; topics: name, number, fields, rows.

    Before what is ``appended``, at an offset that the flags have, the last message may be cut.
    """
    message = lambda kind, body: struct.pack("<HB", len(body), ord(kind)) + body  # noqa: E731
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1000), message("B", bytes(40))]
    forms = {name: fields for name, _, fields, _ in topics}
    for name, fields in forms.items():
        text = f"{name}:" + "".join(f"{kind} {field};" for kind, field in fields)
        parts.append(message("F", text.encode()))
    for k, (name, number, _, _) in enumerate(topics):
        parts.append(message("A", struct.pack("<BH", number, k) + name.encode()))
    for k, (_, _, fields, rows) in enumerate(topics):
        code = "<H" + "".join(CODES[kind] for kind, _ in fields)
        parts += [message("D", struct.pack(code, k, *row)) for row in rows]
    data = b"".join(parts)
    data = data[: len(data) - cut]
    if appended:
        data = data[:27] + b"\1" + bytes(7) + struct.pack("<Q", len(data)) + data[43:] + appended
    path.write_bytes(data)
    return path


def local_rows(n=100, start=5_000_000, valid=20):
    """Rows of `vehicle_local_position`: the first ones are not valid; an estimator is reset once."""
    for k in range(n):
        t = start + 20_000 * k
        jump = 0.5 * (k >= 60)
        yield (t, t - 800, 0.02 * k + jump, 1.0, -3.0 - 0.01 * k, 1.0, 0.0, -0.5, 0.3, 0.2, 0.1, 47.4, 8.55, 488.0,
               int(k >= 60), k >= valid, True)  # fmt: skip


def test_local_positions_of_px4_are_turned_and_timed(tmp_path):
    """North, east, down at the time of the sample become east, north, up; invalid samples are left out."""
    pyulog = pytest.importorskip("pyulog")
    rows = list(local_rows())
    path = ulog(tmp_path / "one.ulg", [("vehicle_local_position", 0, LOCAL, rows),
                                       ("vehicle_local_position", 1, LOCAL, rows[50:])])  # fmt: skip
    theirs = pyulog.ULog(str(path)).get_dataset("vehicle_local_position").data
    read = read_trajectories(path)
    time, place = at_samples(read)
    kept = slice(20, None)
    np.testing.assert_allclose(place.T, [theirs["y"][kept], theirs["x"][kept], -theirs["z"][kept]])
    np.testing.assert_allclose(time, theirs["timestamp_sample"][kept] / 1e6, atol=1e-9)
    np.testing.assert_allclose(measured(read).velocity, [[0.0, 1.0, 0.5]] * 80)
    # eph is the root of the sum of two variances.
    np.testing.assert_allclose(
        measured(read).deviation, [[0.2 / 2**0.5] * 2 + [0.1]] * 80, rtol=1e-6
    )
    assert read.curves[0].at(time)[0, 3] == pytest.approx(np.pi / 2 - 0.3)
    assert said(read, "20 samples without a valid position are left out")
    assert said(read, "the estimator moves its position by 0.52 m at 0.8 s")
    assert said(read, "--topic may name vehicle_local_position:1")
    assert read.read[0]["origin"] == pytest.approx([47.4, 8.55, 488.0])


def test_a_vehicle_is_armed_until_it_is_not(tmp_path):
    """The last message of arming holds to the end of the log."""
    pytest.importorskip("pyulog")
    fields = [("uint64_t", "timestamp"), ("bool", "armed")]
    topics = [("vehicle_local_position", 0, LOCAL, list(local_rows())),
              ("actuator_armed", 0, fields, [(5_000_000, False), (5_400_000, True)])]  # fmt: skip
    read = read_trajectories(ulog(tmp_path / "one.ulg", topics))
    assert read.read[0]["armed"] == ["5.4 to 6.9792 s"]


def test_a_reset_is_no_flight(tmp_path):
    """A step that the estimator counts as its own fails no limit: it is undecided; the same step of a vehicle fails."""
    pytest.importorskip("pyulog")
    judged = []
    for counts in (True, False):
        rows = [row if counts else (*row[:14], 0, *row[15:]) for row in local_rows(valid=0)]
        read = read_trajectories(
            ulog(tmp_path / "one.ulg", [("vehicle_local_position", 0, LOCAL, rows)])
        )
        _, verdict = judge_log(read, None, Doubts(0.01, 0.0), limits={"speed": 3.0})
        judged.append(verdict)
    assert [verdict.word for verdict in judged] == ["undecided", "failed"]
    assert (judged[0].doubt or {})["resets_s"] == [pytest.approx(6.1992)]
    assert "as an estimator moves its position at 6.20 s" in judged[0].by_name["speed"].message


def test_what_is_not_valid_is_not_read(tmp_path):
    """Without a valid local position another topic is read, and said; without any there is one error."""
    pytest.importorskip("pyulog")
    rows = list(local_rows(valid=1000))
    fixes = [
        (5_000_000 + 100_000 * k, 0, 474_000_000 + 90 * k, 85_500_000, 488_000) for k in range(20)
    ]
    topics = [("vehicle_local_position", 0, LOCAL, rows), ("vehicle_gps_position", 0, GPS, fixes)]
    read = read_trajectories(ulog(tmp_path / "a.ulg", topics))
    assert said(read, "vehicle_local_position: no position is valid")
    assert said(read, "positions are those of vehicle_gps_position")
    assert at_samples(read)[1][-1, 1] == pytest.approx(90 * 19 * 1e-7 * 111_200, rel=1e-3)
    path = ulog(tmp_path / "b.ulg", topics[:1])
    with pytest.raises(
        TrajectoryError, match=r"b\.ulg: vehicle_local_position: no position is valid\. Name"
    ):
        read_trajectories(path)
    with pytest.raises(
        TrajectoryError,
        match=r"has no topic nothing with positions\. Topics with positions are: ve",
    ):
        read_trajectories(path, topic="nothing")


def test_logs_share_a_clock_by_gnss_or_have_none(tmp_path):
    """Two logs that count from their starts are joined by the time of GNSS; without it they are not judged together."""
    pytest.importorskip("pyulog")

    def logs(folder, utc):
        folder.mkdir()
        for k, boot in enumerate((5_000_000, 90_000_000)):
            fixes = [(boot, utc and utc + 1_000_000 * k, 474_000_000, 85_500_000, 488_000)]
            topics = [("vehicle_local_position", 0, LOCAL, list(local_rows(start=boot, valid=0))),
                      ("vehicle_gps_position", 0, GPS, fixes)]  # fmt: skip
            ulog(folder / f"v{k}.ulg", topics)
        return read_trajectories(folder, spans="away")

    read = logs(tmp_path / "dated", 1_700_000_000_000_000)
    assert [curve.time[0] for curve in read.curves] == pytest.approx([0.0, 1.0])
    assert not read.own_clocks
    assert said(read, "the clock that vehicles have in common is that of the receiver of GNSS")
    bare = logs(tmp_path / "bare", 0)
    assert bare.own_clocks
    assert said(bare, "each vehicle has a clock of its own")
    with pytest.raises(ResultError, match="v0, v1: each has a clock of its own"):
        result_of_trajectories(bare)


def test_origins_of_several_logs_are_one(tmp_path):
    """Without a stated origin, all vehicles are about that of the first one's estimator."""
    pytest.importorskip("pyulog")
    rows = list(local_rows(valid=0))
    north = [(*row[:11], 47.401, *row[12:]) for row in rows]
    fix = [(5_000_000, 1_700_000_000_000_000, 474_000_000, 85_500_000, 488_000)]
    for name, own in (("a", rows), ("b", north)):
        ulog(tmp_path / f"{name}.ulg", [("vehicle_local_position", 0, LOCAL, own),
                                        ("vehicle_gps_position", 0, GPS, fix)])  # fmt: skip
    read = read_trajectories(tmp_path)
    apart = at_samples(read, 1)[1] - at_samples(read, 0)[1]
    np.testing.assert_allclose(
        apart, flat([47.401], [8.55], [488.0], (47.4, 8.55, 488.0)).repeat(100, 0), atol=5e-3
    )


#: Where an origin is moved to by `moved_rows`, and how far north of the first one that is [m].
ORIGINS = ((47.4, 8.55, 488.0), (47.401, 8.55, 488.0))
NORTH = float(flat(*np.array(ORIGINS[1:]).T, ORIGINS[0])[0, 1])


def moved_rows(n=100):
    """Microseconds, north, east, down [m] and origin of a vehicle that flies north while its origin moves, at 50."""
    for k in range(n):
        yield 5_000_000 + 20_000 * k, 0.02 * k - NORTH * (k >= 50), 1.0, -3.0, ORIGINS[k >= 50]


def at_first_origin(path: Path):
    return at_samples(read_trajectories(path, origin=ORIGINS[0]))[1]


FLOWN = np.stack([np.ones(100), 0.02 * np.arange(100), np.full(100, 3.0)], 1)


def test_an_origin_that_moves_counts_from_then_on(tmp_path):
    """Local positions of PX4, MAVLink and ArduPilot are about the origin that was stated last."""
    pytest.importorskip("pyulog")
    rows = [
        (t, t, x, y, z, 0, 0, 0, 0, 0.1, 0.1, *at, 0, True, True) for t, x, y, z, at in moved_rows()
    ]
    path = ulog(tmp_path / "one.ulg", [("vehicle_local_position", 0, LOCAL, rows)])
    np.testing.assert_allclose(at_first_origin(path), FLOWN, atol=5e-3)
    messages = []
    for k, (t, x, y, z, (lat, lon, height)) in enumerate(moved_rows()):
        if k in (0, 50):
            place = round(1e7 * lat), round(1e7 * lon), round(1e3 * height)
            messages.append((1_700_000_000_000_000 + t, 1, 1, "gps_global_origin", place))
        messages.append(
            (1_700_000_000_000_000 + t, 1, 1, "local_position_ned", (t // 1000, x, y, z, 0, 0, 0))
        )
    path = telemetry(tmp_path / "one.tlog", messages)
    np.testing.assert_allclose(at_first_origin(path), FLOWN, atol=5e-3)
    parts = []
    for k, (t, x, y, z, (lat, lon, height)) in enumerate(moved_rows()):
        if k in (0, 50):
            parts.append(("ORGN", (t, 0, round(1e7 * lat), round(1e7 * lon), round(1e2 * height))))
        parts.append(("XKF1", (t, 0, 0.0, 0.0, 0.0, x, y, z, 0)))
    path = dataflash(tmp_path / "one.bin", parts)
    np.testing.assert_allclose(at_first_origin(path), FLOWN, atol=5e-3)
    assert rows_of(path, "ORGN", "Lat").tolist() == [[47.4], [47.401]]


def test_an_origin_that_moves_counts_though_a_clock_begins_anew(tmp_path):
    """After a vehicle or a station begins its clock anew, the origin is still the one that was stated last."""
    pytest.importorskip("mcap")
    local, _ = px4_rows(100)
    for k, (_, fields) in enumerate(local):
        begins = 500_000_000 * (k < 20)
        fields["timestamp"] += begins
        fields["timestamp_sample"] += begins
        lat, lon, height = ORIGINS[k >= 60]
        fields |= {"x": 0.02 * k - NORTH * (k >= 60), "y": 1.0, "z": -3.0, "xy_valid": True}
        fields |= {"ref_lat": lat, "ref_lon": lon, "ref_alt": height}
    path = px4_bag(tmp_path / "bag", "MCAP", 9, {("/p", "VehicleLocalPosition"): local})
    read = read_trajectories(path, origin=ORIGINS[0])
    assert said(read, "the clock begins anew")
    np.testing.assert_allclose(at_samples(read)[1], FLOWN[20:], atol=5e-3)
    messages = []
    for k, (t, x, y, z, (lat, lon, height)) in enumerate(moved_rows()):
        received = 1_700_000_000_000_000 + t - 20_000_000 * (k >= 20)
        if k in (0, 50):
            place = round(1e7 * lat), round(1e7 * lon), round(1e3 * height)
            messages.append((received, 1, 1, "gps_global_origin", place))
        row = (t // 1000, x, y, z, 0, 0, 0)
        messages.append((received, 1, 1, "local_position_ned", row))
    path = telemetry(tmp_path / "one.tlog", messages)
    np.testing.assert_allclose(at_first_origin(path), FLOWN, atol=5e-3)


#: Messages of ArduPilot: number, format and fields, after `LogStructure.h`; and how Python packs the format.
DATAFLASH = {
    "XKF1": (10, "QBffffffc", "TimeUS,C,VN,VE,VD,PN,PE,PD,Yaw"), "ORGN": (11, "QBLLe", "TimeUS,Type,Lat,Lng,Alt"),
    "XKF4": (12, "QBHB", "TimeUS,C,SS,PI"),
}  # fmt: skip
PACKS = {"Q": "Q", "B": "B", "H": "H", "f": "f", "c": "h", "L": "i", "e": "i"}


def dataflash(path: Path, messages) -> Path:
    """A log of ArduPilot, of messages with their values."""
    codes = {name: "<" + "".join(PACKS[kind] for kind in own[1]) for name, own in DATAFLASH.items()}
    form = lambda *x: b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", *x)  # noqa: E731
    parts = [form(128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")]
    for name, (number, kinds, fields) in DATAFLASH.items():
        size = 3 + struct.calcsize(codes[name])
        parts.append(form(number, size, name.encode(), kinds.encode(), fields.encode()))
    for name, values in messages:
        parts.append(b"\xa3\x95" + bytes([DATAFLASH[name][0]]) + struct.pack(codes[name], *values))
    path.write_bytes(b"".join(parts))
    return path


def test_a_core_that_was_not_trusted_is_told(tmp_path):
    """Positions are of the core that the estimator trusted most; for how long it trusted another one is noted."""
    pytest.importorskip("pymavlink")
    parts = []
    for k in range(100):
        t = 1_000_000 + 20_000 * k
        parts += [("XKF1", (t, core, 0, 0, 0, 0.02 * k, 1.0 + core, -3.0, 0)) for core in (0, 1)]
        parts.append(("XKF4", (t, 0, 0b111111, int(k >= 80))))
    read = read_trajectories(dataflash(tmp_path / "one.bin", parts))
    np.testing.assert_allclose(at_samples(read)[1], FLOWN, atol=1e-6)
    assert said(read, "in 20 % of the log, the estimator trusted another core than XKF1:0")


def test_a_filter_that_knows_no_place_tells_none(tmp_path):
    """What ArduPilot's filter writes while it says that it knows no place, or no height, is left out, core by core."""
    pytest.importorskip("pymavlink")
    parts = []
    for k in range(100):
        t = 1_000_000 + 20_000 * k
        for core in (0, 1):
            status = (
                0b10000111 if k < 10 else 0b11111 if k < 20 else 0b110111 if k % 2 else 0b101111
            )
            parts.append(("XKF4", (t, core, 0b10000111 if core else status, 0)))
            parts.append(("XKF1", (t, core, 0, 0, 0, 0.02 * k if k >= 20 else 0, 1.0, -3.0, 0)))
    path = dataflash(tmp_path / "one.bin", parts)
    read = read_trajectories(path)
    np.testing.assert_allclose(at_samples(read)[1], FLOWN[20:], atol=1e-6)
    assert said(read, "20 samples without a valid position are left out")
    with pytest.raises(TrajectoryError, match="XKF1:1: no position is valid"):
        read_trajectories(path, topic="XKF1:1")


def test_a_message_of_which_little_is_valid_gives_way_to_another(tmp_path):
    """Of two messages the one counts that has samples; a clock that stands still has none; a name is a choice."""
    pytest.importorskip("pyulog")
    few = list(local_rows(valid=97))
    earth = [("uint64_t", "timestamp"), ("double", "lat"), ("double", "lon"), ("float", "alt")]
    rows = [(5_000_000 + 20_000 * k, 47.4 + 1e-7 * k, 8.55, 488.0) for k in range(100)]
    topics = [
        ("vehicle_local_position", 0, LOCAL, few),
        ("vehicle_global_position", 0, earth, rows),
    ]
    path = ulog(tmp_path / "one.ulg", topics)
    read = read_trajectories(path)
    assert said(read, "positions are those of vehicle_global_position")
    assert said(read, "vehicle_local_position: of its samples, only 3 are valid and in order")
    named = read_trajectories(path, topic="vehicle_local_position")
    assert len(named.curves[0].time) == 3
    still = [(t, 4_000_000, *more) for t, _, *more in local_rows(valid=0)]
    path = ulog(tmp_path / "one.ulg", [("vehicle_local_position", 0, LOCAL, still)])
    with pytest.raises(TrajectoryError, match="of its samples, only 1 are valid and in order"):
        read_trajectories(path)


def test_a_position_that_nothing_reaches_is_none(tmp_path):
    """What damage makes of a number is left out, as nan is."""
    pytest.importorskip("pyulog")
    rows = [
        (*row[:2], 1e30 if k == 50 else row[2], *row[3:])
        for k, row in enumerate(local_rows(valid=0))
    ]
    read = read_trajectories(
        ulog(tmp_path / "one.ulg", [("vehicle_local_position", 0, LOCAL, rows)])
    )
    assert len(read.curves[0].time) == 99
    assert said(read, "1 samples without a valid position are left out")


def test_one_wrong_time_of_receipt_moves_no_clock(tmp_path):
    """The delay of the quickest message counts, but for one that would have come long before it was sent."""
    rows = [
        (1_700_000_000_000_000 + 20_000 * k - 10**12 * (k == 40), 1, 1, "local_position_ned",
         (1000 + 20 * k, 0.02 * k, 1, -3, 0, 0, 0)) for k in range(100)
    ]  # fmt: skip
    read = read_trajectories(telemetry(tmp_path / "one.tlog", rows))
    time, place = at_samples(read)
    np.testing.assert_allclose(place, FLOWN, atol=1e-6)
    np.testing.assert_allclose(time + read.since, 1.7e9 + 0.02 * np.arange(100), atol=1e-6)


def test_what_is_lost_behind_damage_of_a_ulog_is_told(tmp_path):
    """Bytes that are inserted or lost within a log are noted, also where its library ends there in silence."""
    pytest.importorskip("pyulog")
    data = ulog(
        tmp_path / "one.ulg", [("vehicle_local_position", 0, LOCAL, list(local_rows(valid=0)))]
    ).read_bytes()
    assert not said(read_trajectories(tmp_path / "one.ulg"), "damaged")
    random, lost = np.random.default_rng(8), 0
    for k in range(30):
        at = len(data) // 3 + 61 * k
        noise = random.integers(0, 256, 200).astype(np.uint8).tobytes()
        bad = data[:at] + noise + data[at:] if k % 2 else data[:at] + data[at + 150 :]
        (tmp_path / "one.ulg").write_bytes(bad)
        with suppress(TrajectoryError):
            read = read_trajectories(tmp_path / "one.ulg", gaps="bridge")
            short = len(read.curves[0].time) < 95
            lost += short
            assert not short or said(read, "damaged")
    assert lost > 3


def test_a_ulog_is_cut(tmp_path):
    """A log whose end is missing is read up to there; one without its head is one error."""
    pytest.importorskip("pyulog")
    topics = [("vehicle_local_position", 0, LOCAL, list(local_rows(valid=0)))]
    read = read_trajectories(ulog(tmp_path / "cut.ulg", topics, cut=30))
    assert len(read.curves[0].time) == 99
    assert said(read, CUT)
    (tmp_path / "head.ulg").write_bytes(b"ULog\x01\x12\x35\x01")
    with pytest.raises(TrajectoryError, match=r"head\.ulg: (the log is damaged|has no topic)"):
        read_trajectories(tmp_path / "head.ulg")
    (tmp_path / "text.tlog").write_text("this is no log\n" * 50)
    with pytest.raises(TrajectoryError, match=r"text\.tlog: has no topic with positions"):
        read_trajectories(tmp_path / "text.tlog")


def test_what_is_appended_to_a_ulog_is_no_damage(tmp_path):
    """A report of a crash begins where the flags say, though the message before was cut; damage is seen behind, too."""
    pytest.importorskip("pyulog")
    topics = [("vehicle_local_position", 0, LOCAL, list(local_rows(valid=0)))]
    text = b"\x12char[4] hard_fault" + b"dump"
    report = struct.pack("<HBB", 1 + len(text), ord("M"), 0) + text
    for cut in (0, 1, 30, 45):
        read = read_trajectories(ulog(tmp_path / "one.ulg", topics, cut=cut, appended=3 * report))
        assert len(read.curves[0].time) == 100 - (cut > 0)
        assert said(read, CUT) == (cut > 0)
        assert not said(read, "damaged")
        path = ulog(tmp_path / "one.ulg", topics, cut=cut, appended=report + b"\0\0\0" + report)
        assert said(read_trajectories(path), "damaged")
        path = ulog(tmp_path / "one.ulg", topics, cut=cut, appended=report[:-1])
        assert said(read_trajectories(path), CUT)


def test_a_package_that_is_missing_is_named(tmp_path, monkeypatch):
    """Without the extra there is one error with the command that installs it."""
    path = ulog(tmp_path / "one.ulg", [("vehicle_local_position", 0, LOCAL, list(local_rows()))])
    monkeypatch.setattr("rigidfleet.foreign.logs.find_spec", lambda _: None)
    with pytest.raises(
        TrajectoryError, match=r"needs the package 'pyulog'\. Run: pip install rigidfleet\[logs\]"
    ):
        read_trajectories(path)


# -- ROS 2 -------------------------------------------------------------------------------------------


def record(path: Path) -> Path:
    """A recording that `rosbags` writes: a robot that circles and climbs, as odometry, poses, transforms and fixes."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.rosbag2.enums import StoragePlugin
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    of = {name.rpartition("/")[2]: kind for name, kind in store.types.items()}
    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    with rosbag2.Writer(path.with_suffix(""), version=9, storage_plugin=plugin) as writer:
        topics = {"/odom": "Odometry", "/amcl_pose": "PoseWithCovarianceStamped", "/tf": "TFMessage",
                  "/tf_static": "TFMessage", "/fix": "NavSatFix"}  # fmt: skip
        kinds = {topic: of[kind].__msgtype__ for topic, kind in topics.items()}
        to = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, kind in kinds.items()
        }
        for k in range(200):
            t, a = 1_700_000_000_000_000_000 + 50_000_000 * k, 0.02 * k
            header = lambda frame, t=t: of["Header"](of["Time"](t // 10**9, t % 10**9), frame)  # noqa: E731
            x, y, z = 2.0 * np.sin(a), 2.0 - 2.0 * np.cos(a), 0.01 * k
            turned = of["Quaternion"](*Rotation.from_euler("z", a).as_quat())
            covariance = np.diag([0.01 + 1e-4 * k, 0.02, 0.0, 1.0, 1.0, 1.0]).ravel()
            pose = of["PoseWithCovariance"](of["Pose"](of["Point"](x, y, z), turned), covariance)
            v = of["Twist"](of["Vector3"](0.8, 0.0, 0.2), of["Vector3"](0.0, 0.0, 0.4))
            twist = of["TwistWithCovariance"](v, covariance)
            moved = of["Transform"](of["Vector3"](x, y, z), turned)
            status = of["NavSatStatus"](0 if k else -1, 1, *[0] * 9)
            messages = {
                "/odom": of["Odometry"](header("odom"), "base_footprint", pose, twist),
                "/amcl_pose": of["PoseWithCovarianceStamped"](header("map"), pose),
                "/tf": of["TFMessage"](
                    [of["TransformStamped"](header("odom"), "base_footprint", moved)]
                ),
                "/tf_static": of["TFMessage"](
                    [of["TransformStamped"](header("base_footprint"), "lidar", moved)]
                ),
                "/fix": of["NavSatFix"](
                    header("gps"), status, 47.4 + 1e-7 * k, 8.5, 500.0 + z, np.zeros(9), 0
                ),
            }
            for topic, message in messages.items():
                writer.write(to[topic], t + 3_000_000, store.serialize_cdr(message, kinds[topic]))
    (made,) = path.with_suffix("").glob(f"*{path.suffix}")
    return made.rename(path)


def messages_of(path: Path, topic: str) -> list:
    """Messages as rosbags reads them."""
    reader = pytest.importorskip("rosbags.highlevel").AnyReader([path])
    with reader:
        own = [c for c in reader.connections if c.topic == topic]
        return [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(own)]


def seconds(message) -> float:
    return message.header.stamp.sec + message.header.stamp.nanosec / 1e9


def test_odometry_is_read_with_its_velocity_and_covariance(log):
    """Velocities in a robot's axes are turned into the frame of its positions; topics that are not read are named."""
    path = log("odometry.mcap")
    read = read_trajectories(path, gaps="bridge")
    assert read.names == ("/odom",)
    time, place = at_samples(read)
    own = messages_of(path, "/odom")
    np.testing.assert_allclose(time + read.since, [seconds(m) for m in own], atol=1e-6)
    point = [m.pose.pose.position for m in own]
    np.testing.assert_allclose(place, [[p.x, p.y, p.z] for p in point])
    q = [m.pose.pose.orientation for m in own]
    turn = Rotation.from_quat([[x.x, x.y, x.z, x.w] for x in q])
    v = [m.twist.twist.linear for m in own]
    np.testing.assert_allclose(
        measured(read).velocity, turn.apply([[x.x, x.y, x.z] for x in v]), atol=1e-12
    )
    assert said(read, "topics that are not read: /amcl_pose, /fix, /tf:base_footprint")
    pose = messages_of(path, "/amcl_pose")
    read = read_trajectories(path, gaps="bridge", topic="/amcl*")
    deviation = [[m.pose.covariance[0] ** 0.5, m.pose.covariance[7] ** 0.5] for m in pose]
    np.testing.assert_allclose(measured(read).deviation[:, :2], deviation)
    assert np.isnan(measured(read).deviation[:, 2]).all()  # zero: not known


def test_rosbag2_is_read(log, tmp_path):
    """A folder that rosbag2 wrote, or its base of SQLite: bodies of a topic of transforms."""
    path = log("transforms.db3")
    own = [m.transforms[0] for m in messages_of(path, "/tf")]
    (folder := tmp_path / "bag").mkdir()
    (folder / "transforms.db3").write_bytes(path.read_bytes())
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    read, alone = (read_trajectories(x, topic="/tf:*") for x in (folder, path))
    assert read.names == alone.names == ("/tf:base_footprint",)
    time, place = at_samples(read)
    moved = [m.transform.translation for m in own]
    np.testing.assert_allclose(place, [[x.x, x.y, x.z] for x in moved])
    np.testing.assert_allclose(time, [seconds(m) - seconds(own[0]) for m in own], atol=1e-6)
    assert read.read[0]["frame"] == "enu odom"
    path.write_bytes(path.read_bytes()[:50_000])
    with pytest.raises(TrajectoryError, match="the recording is damaged"):
        read_trajectories(path)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_robot_that_others_recorded(tmp_path, storage):
    """Odometry of a TurtleBot3, recorded by others in ROS 1 and moved to rosbag2, is what rosbags reads in ROS 1."""
    converter = pytest.importorskip("rosbags.convert.converter")
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    path, folder = tmp_path / "waffle.bag", tmp_path / "bag"
    path.write_bytes(lzma.decompress((LOGS / "waffle.bag.xz").read_bytes()))
    old, new = (get_typestore(x) for x in (Stores.ROS1_NOETIC, Stores.ROS2_HUMBLE))
    converter.convert([path], folder, storage, 9, None, "file", old, new, [], [], [], [])
    with AnyReader([path], default_typestore=old) as reader:
        to = [c for c in reader.connections if c.topic == "/odom"]
        own = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(to)]
    read = read_trajectories(folder)
    time, place = at_samples(read)
    point, q = [m.pose.pose.position for m in own], [m.pose.pose.orientation for m in own]
    assert len(time) == 137
    np.testing.assert_array_equal(place, [[p.x, p.y, p.z] for p in point])
    np.testing.assert_allclose(time + read.since, [seconds(m) for m in own], atol=1e-6)
    turn = Rotation.from_quat([[x.x, x.y, x.z, x.w] for x in q])
    np.testing.assert_allclose(read.curves[0].at(time)[:, 3], turn.as_euler("xyz")[:, 2])
    v = [m.twist.twist.linear for m in own]
    np.testing.assert_allclose(
        measured(read).velocity, turn.apply([[x.x, x.y, x.z] for x in v]), atol=1e-15
    )


def poses_bag(
    folder: Path, rows: list[tuple[Any, ...]], packed: str = "", plugin: str = "MCAP"
) -> Path:  # fmt: skip
    """A recording that `rosbags` writes, of poses: topic, when it was recorded and stamped [ns], place [m], frame."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    pytest.importorskip("mcap")
    from rosbags.rosbag2.enums import CompressionFormat, CompressionMode, StoragePlugin
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    of = {name.rpartition("/")[2]: kind for name, kind in store.types.items()}
    kind, to = of["PoseStamped"].__msgtype__, {}
    writer = rosbag2.Writer(folder, version=9, storage_plugin=StoragePlugin[plugin])
    if packed:
        writer.set_compression(CompressionMode[packed], CompressionFormat.ZSTD)
    with writer:
        for topic, received, stamp, place, *frame in rows:
            if topic not in to:
                to[topic] = writer.add_connection(topic, kind, typestore=store)
            header = of["Header"](of["Time"](stamp // 10**9, stamp % 10**9), *(frame or ["map"]))
            pose = of["Pose"](of["Point"](*place), of["Quaternion"](0.0, 0.0, 0.0, 1.0))
            data = store.serialize_cdr(of["PoseStamped"](header, pose), kind)
            writer.write(to[topic], received, data)
    (path,) = (x for x in folder.iterdir() if x.suffix != ".yaml")
    return path


#: Poses of vehicles 10, 2 and 1, in this order.
OF_THREE = [
    (f"/cf{n}/pose", t, t, [float(n), 1e-9 * (t - 1_700_000_000 * 10**9), 1.0])
    for t in range(1_700_000_000 * 10**9, 1_700_000_001 * 10**9, 20_000_000)
    for n in (10, 2, 1)
]


@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
@pytest.mark.parametrize("packed", ["", "MESSAGE", "FILE", "STORAGE"])
def test_recordings_are_packed_in_several_ways(tmp_path, packed, plugin):
    """Messages and chunks are unpacked, a whole file is refused with a remedy; vehicles are in their numbers' order."""
    if (packed, plugin) == ("STORAGE", "SQLITE3"):
        pytest.skip("only MCAP packs chunks")
    path = poses_bag(tmp_path / "bag", OF_THREE, packed, plugin)
    if packed == "FILE":
        for given in (path, path.parent):
            with pytest.raises(
                TrajectoryError, match=r"compressed as a whole\. Unpack it: zstd -d"
            ):
                read_trajectories(given)
        return
    for given in (path, path.parent):
        read = read_trajectories(given)
        assert read.names == ("/cf1/pose", "/cf2/pose", "/cf10/pose")
        place = [[10.0, 0.02 * k, 1.0] for k in range(50)]
        np.testing.assert_allclose(at_samples(read, 2)[1], place, atol=1e-9)
        assert read.read[0]["rate_hz"] == pytest.approx(50.0)


def transforms_bag(folder: Path, rows: Callable[[int], list[tuple[str, str, float]]]) -> Path:
    """A recording that `rosbags` writes, of 50 messages of transforms: frame, body, and x [m] of each."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    of = {name.rpartition("/")[2]: kind for name, kind in store.types.items()}
    kind = of["TFMessage"].__msgtype__
    with rosbag2.Writer(folder, version=9) as writer:
        to = writer.add_connection("/tf", kind, typestore=store)
        for k in range(50):
            moved = []
            for frame, body, x in rows(k):
                header = of["Header"](of["Time"](1_700_000_000, 20_000_000 * k), frame)
                transform = of["Transform"](
                    of["Vector3"](x, 0.0, 0.0), of["Quaternion"](0.0, 0.0, 0.0, 1.0)
                )
                moved.append(of["TransformStamped"](header, body, transform))
            writer.write(to, 20_000_000 * k, store.serialize_cdr(of["TFMessage"](moved), kind))
    return folder


def test_a_frame_is_no_robot(tmp_path):
    """Of a map, odometry in it, a robot in that and its wheel (REP 105), the robot is what moves."""
    transforms_bag(
        tmp_path / "bag",
        lambda k: [
            ("map", "odom", 0.01),
            ("odom", "base_link", 0.1 * k),
            ("base_link", "wheel", 0.2),
        ],
    )
    read = read_trajectories(tmp_path / "bag")
    assert read.names == ("/tf:base_link",)
    np.testing.assert_allclose(at_samples(read)[1][:, 0], 0.1 * np.arange(50))
    assert read_trajectories(tmp_path / "bag", topic="/tf:odom").names == ("/tf:odom",)


def test_robots_in_frames_of_their_own_are_not_compared(tmp_path):
    """Frames of odometry that have a robot's name are no robots, and where one is in another is not known."""
    path = transforms_bag(
        tmp_path / "bag",
        lambda k: [
            (frame, body, x)
            for who, at in (("cf1", 0.0), ("cf2", 7.0))
            for frame, body, x in (
                ("map", f"{who}/odom", at),
                (f"{who}/odom", f"{who}/base", 0.1 * k),
            )
        ],
    )
    with pytest.raises(
        TrajectoryError, match=r"in frames enu cf1/odom, enu cf2/odom: where .* --topic"
    ):
        read_trajectories(path)
    read = read_trajectories(path, topic="/tf:cf?/base")
    assert read.names == ("/tf:cf1/base", "/tf:cf2/base")
    assert said(read, "positions are in frames enu cf1/odom, enu cf2/odom")
    np.testing.assert_allclose(at_samples(read, 1)[1][:, 0], 0.1 * np.arange(50))


def test_parts_of_a_recording_are_read_by_their_folder(log, tmp_path):
    """Two parts alone are no vehicles of one flight, and the refusal says what is; with it they are the whole."""
    whole, parts = log("transforms.db3"), []
    with closing(sqlite3.connect(whole)) as base:
        times = [t for (t,) in base.execute("SELECT timestamp FROM messages ORDER BY timestamp")]
    for k, later in enumerate("><"):
        parts.append(tmp_path / f"part_{k}.db3")
        parts[k].write_bytes(whole.read_bytes())
        with closing(sqlite3.connect(parts[k])) as base, base:
            base.execute(
                f"DELETE FROM messages WHERE timestamp {later}= ?", (times[len(times) // 2],)
            )
    with pytest.raises(TrajectoryError, match=r"by its folder with metadata\.yaml"):
        read_trajectories(parts)
    folder = tmp_path / "recording"
    folder.mkdir()
    for part in parts:
        part.rename(folder / part.name)
    (folder / "metadata.yaml").touch()
    read = read_trajectories(folder, gaps="bridge")
    assert read.names == read_trajectories(whole, gaps="bridge").names
    assert len(read.curves[0].time) > 2


def test_frames_that_move_in_each_other_are_refused(tmp_path):
    path = transforms_bag(tmp_path / "bag", lambda k: [("a", "b", 0.1 * k), ("b", "a", -0.1 * k)])
    with pytest.raises(TrajectoryError, match="in frames enu a, enu b"):
        read_trajectories(path)


def test_odometry_of_one_robot_is_no_robot(tmp_path):
    path = transforms_bag(
        tmp_path / "bag", lambda k: [("map", "cf1_odom", 1.0), ("cf1_odom", "cf1", 0.1 * k)]
    )
    assert read_trajectories(path).names == ("/tf:cf1",)


def test_a_body_in_two_frames_is_in_the_first(tmp_path):
    """Of a body that is tracked from the world and from a camera, places in the world count, and a note says so."""
    path = transforms_bag(
        tmp_path / "bag", lambda k: [("world", "cf1", 0.1 * k), ("camera", "cf1", 5.0 + 0.1 * k)]
    )
    read = read_trajectories(path)
    np.testing.assert_allclose(at_samples(read)[1][:, 0], 0.1 * np.arange(50))
    assert said(read, "/tf:cf1 in 'camera' is not read: it is TFMessage in 'world' first")


def test_where_vehicles_are_to_be_is_no_vehicle(tmp_path):
    """Setpoints and goals are not judged as vehicles beside those that fly to them, unless they are named."""
    at = [(1_700_000_000 * 10**9 + 20_000_000 * k, 0.01 * k) for k in range(50)]
    topics = {
        "/cf1/pose": 0.0,
        "/cf1/setpoint": 0.2,
        "/goal_pose": 0.3,
        "/targets/cf2": 3.0,
        "/cf1/goalPose": 0.4,
    }
    rows = [(topic, t, t, [x + by, 0.0, 1.0]) for t, x in at for topic, by in topics.items()]
    path = poses_bag(tmp_path / "bag", rows)
    read = read_trajectories(path)
    assert read.names == ("/cf1/pose", "/targets/cf2")
    assert said(read, "topics that are not read: /cf1/goalPose, /cf1/setpoint, /goal_pose")
    assert read_trajectories(path, topic="/goal_pose").names == ("/goal_pose",)


@pytest.mark.parametrize(
    "path", [x for kind in ("*.mcap", "*.db3") for x in sorted(Path(MORE).glob(kind) if MORE else ())]
)  # fmt: skip
def test_public_recordings_of_ros2(path):
    """What ROS 2 itself recorded: places and times of each topic are those that `rosbags` decodes."""
    highlevel = pytest.importorskip("rosbags.highlevel")
    from rosbags.typesys import Stores, get_typestore

    rows: dict[str, list[list[float]]] = {}
    with highlevel.AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for to, _, raw in reader.messages():
            if to.topic != "/tf_static" and to.msgtype.endswith(
                ("/Odometry", "Stamped", "/TFMessage")
            ):
                message = reader.deserialize(raw, to.msgtype)
                for each in getattr(message, "transforms", [message]):
                    body = f":{each.child_frame_id}" if hasattr(each, "transform") else ""
                    pose = getattr(each, "pose", None)
                    pose = getattr(pose, "pose", pose)
                    x = pose.position if pose else each.transform.translation
                    rows.setdefault(to.topic + body, []).append([seconds(each), x.x, x.y, x.z])
    assert rows
    for topic, own in rows.items():
        time, place = at_samples(read := read_trajectories(path, topic=topic, gaps="bridge"))
        np.testing.assert_array_equal(place, np.array(own)[:, 1:])
        np.testing.assert_allclose(time + read.since, np.array(own)[:, 0], atol=1e-6)


def test_messages_without_a_stamp_are_no_places(tmp_path):
    """Before its first place a node may send empty messages; a topic without stamps has another clock than others."""
    begin, now = 1_500_000_000 * 10**9, 1_700_000_000 * 10**9
    at = [20_000_000 * k for k in range(50)]
    place = [[0.01 * k, 0.0, 1.0] for k in range(50)]
    late = [("/a", now + t, begin + t if k >= 5 else 0, place[k]) for k, t in enumerate(at)]
    none = [("/b", now + t, 0, [9.0, 0.0, 1.0]) for t in at]
    read = read_trajectories(poses_bag(tmp_path / "both", late + none))
    assert read.names == ("/a",)
    np.testing.assert_allclose(at_samples(read)[1], place[5:], atol=1e-12)
    assert read.since == begin / 1e9 + 0.1
    assert said(read, "5 samples without a valid position are left out")
    assert said(read, "/b is not read: it has no stamps, as others have")
    read = read_trajectories(poses_bag(tmp_path / "alone", none))  # when it was recorded counts
    assert read.since == now / 1e9
    simulated = [("/a", now + t, t, place[k]) for k, t in enumerate(at)]  # a clock that begins at 0
    np.testing.assert_allclose(
        at_samples(read_trajectories(poses_bag(tmp_path / "simulated", simulated)))[1],
        place,
        atol=1e-12,
    )
    leaps = [("/a", now + t, begin + t if k else 0, place[k]) for k, t in enumerate(at)]
    read = read_trajectories(poses_bag(tmp_path / "leaps", leaps))
    np.testing.assert_allclose(at_samples(read)[1], place[1:], atol=1e-12)


def test_one_vehicle_is_not_two(tmp_path):
    """An estimate and the truth of one vehicle are no two that collide: topics at one place are to be named."""
    at = [(1_700_000_000 * 10**9 + 20_000_000 * k, 0.01 * k) for k in range(50)]
    rows = [
        (topic, t, t, [x + by, 0.0, 1.0])
        for t, x in at
        for topic, by in (("/a", 0.0), ("/b", 0.01))
    ]
    path = poses_bag(tmp_path / "bag", rows)
    with pytest.raises(TrajectoryError, match=r"/a and /b are 0.01 m apart most .* --topic"):
        read_trajectories(path)
    assert read_trajectories(path, topic="/b").names == ("/b",)
    assert read_trajectories(path, topic="/?").names == ("/a", "/b")
    pad = [
        (topic, t + by, t + by, [1.0, 0.0, 0.0])
        for t, _ in at
        for topic, by in (("/a", 0), ("/b", 10**10))
    ]
    read = read_trajectories(poses_bag(tmp_path / "pad", pad), spans="away")
    assert read.names == ("/a", "/b")  # one after the other


def test_a_recording_that_ends_with_the_power(log):
    """An MCAP without its end is read up to there, as its own library reads it, with a note."""
    path = log("odometry.mcap")
    whole = at_samples(read_trajectories(path))[1]
    path.write_bytes(path.read_bytes()[:-100])
    read = read_trajectories(path)
    np.testing.assert_array_equal(at_samples(read)[1], whole)
    assert said(read, "the log is damaged in part")
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(TrajectoryError, match="the recording is damaged"):
        read_trajectories(path)


def test_bytes_that_changed_in_an_mcap_are_noticed(tmp_path):
    """Checksums of chunks and of all data are compared, as the format's own writer sets them."""
    writer = pytest.importorskip("mcap.writer")
    for compression in ("NONE", "ZSTD"):
        path = tmp_path / f"{compression}.mcap"
        with path.open("wb") as file:
            own = writer.Writer(
                file, compression=writer.CompressionType[compression], chunk_size=2000
            )
            own.start(profile="ros2")
            schema = own.register_schema("geometry_msgs/msg/PoseStamped", "ros2msg", b"")
            to = own.register_channel("/a", "cdr", schema)
            for k in range(200):
                t = 10**18 + 20_000_000 * k
                head = struct.pack("<4siII4s", b"\0\1\0\0", t // 10**9, t % 10**9, 4, b"map\0")
                own.add_message(to, t, head + struct.pack("<7d", k, 1.0, 2.0, 0, 0, 0, 1), t)
            own.finish()
        data = path.read_bytes()
        read = read_trajectories(path)
        assert len(read.curves[0].time) == 200
        assert not said(read, "damaged")
        begin = data.index(b"map\0") if compression == "NONE" else len(data) // 3
        for k in range(40):
            at = begin + 7 * k + len(data) // 4 * (k % 2)
            path.write_bytes(data[:at] + bytes([data[at] ^ 0x40]) + data[at + 1 :])
            try:
                read = read_trajectories(path, gaps="bridge")
            except TrajectoryError as error:
                assert "damaged" in str(error)  # noqa: PT017
                continue
            x = at_samples(read)[1][:, 0]
            assert said(read, "damaged") or np.array_equal(x, np.arange(200))
            np.testing.assert_array_equal(x, np.arange(len(x)))


def test_messages_of_other_packages_are_not_those_of_ros(tmp_path):
    """A message with a known name and other fields is refused by its name, not read as what it is not."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "acme_msgs/msg/PoseStamped"
    store.register(get_types_from_msg("std_msgs/Header header\nfloat32[40] x", kind))
    header, time = (store.types[x] for x in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time"))
    with rosbag2.Writer(tmp_path / "bag", version=9) as writer:
        to = writer.add_connection("/pose", kind, typestore=store)
        for k in range(20):
            stamp = header(time(10, 20_000_000 * k), "map")
            message = store.types[kind](stamp, np.arange(40, dtype=np.float32))
            writer.write(to, 10**10 + 20_000_000 * k, store.serialize_cdr(message, kind))
    with pytest.raises(TrajectoryError, match=f"/pose: has messages of {kind}, whose fields are"):
        read_trajectories(tmp_path / "bag")


#: How `px4_msgs` defines the first fields of two messages, and the last ones that matter here.
PX4 = {
    "VehicleLocalPosition": """
        uint32 MESSAGE_VERSION = 1
        # Fused local position in NED.
        uint64 timestamp\t\t\t# time since system start (microseconds)
        uint64 timestamp_sample                 # the timestamp of the raw data (microseconds)
        bool xy_valid\t\t\t\t# true if x and y are valid
        bool z_valid
        float32 x
        float32 y
        float32 z
        float32[2] delta_xy
        uint8 xy_reset_counter
        float32 delta_z
        uint8 z_reset_counter
        float32 vx
        float32 vy
        float32 vz
        float32 heading
        uint8 heading_reset_counter
        float64 ref_lat
        float64 ref_lon
        float32 ref_alt
        float32 eph
        float32 epv""",
    "VehicleOdometry": """
        uint64 timestamp
        uint64 timestamp_sample
        uint8 POSE_FRAME_NED     = 1 # NED earth-fixed frame
        uint8 pose_frame
        float32[3] position
        float32[4] q
        float32[3] position_variance
        uint8 reset_counter""",
}


def px4_bag(folder: Path, plugin: str, version: int, messages: dict) -> Path:
    """A recording that `rosbags` writes, with messages of PX4 that it is taught: their fields, by topic and kind."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.rosbag2.enums import StoragePlugin
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for kind, text in PX4.items():
        store.register(get_types_from_msg(text, f"px4_msgs/msg/{kind}"))
    with rosbag2.Writer(folder, version=version, storage_plugin=StoragePlugin[plugin]) as writer:
        for (topic, kind), rows in messages.items():
            name = f"px4_msgs/msg/{kind}"
            to = writer.add_connection(topic, name, typestore=store)
            for received, fields in rows:
                data = store.serialize_cdr(store.types[name](**fields), name)
                writer.write(to, received, data)
    return folder


def px4_rows(n=50):
    """Fields of PX4's two messages at times of its own clock, and when they were recorded [ns]."""
    single = lambda *x: np.array(x, np.float32)  # noqa: E731
    local, odometry = [], []
    for k in range(n):
        t, received = 5_000_000 + 20_000 * k, 1_700_000_000_000_000_000 + 20_000_000 * k
        stamps = {"timestamp": t + 900, "timestamp_sample": t}
        place = 0.25 * k, 1.0 - 0.5 * k, -3.0 - 0.125 * k
        local.append((received + 1_000_000 * (k % 3), stamps | {
            "xy_valid": k >= 5, "z_valid": True, "x": place[0], "y": place[1], "z": place[2],
            "delta_xy": single(9.0, 9.0), "xy_reset_counter": 7, "delta_z": 9.0, "z_reset_counter": 7, "vx": 12.5,
            "vy": -25.0, "vz": -6.25, "heading": 0.5, "heading_reset_counter": 3, "ref_lat": 47.4, "ref_lon": 8.55,
            "ref_alt": 488.0, "eph": 0.5, "epv": 0.25,
        }))  # fmt: skip
        odometry.append((received, stamps | {
            "pose_frame": 1, "position": single(*place), "q": single(1, 0, 0, 0),
            "position_variance": single(0.25, 0.0625, 1.0), "reset_counter": 0,
        }))  # fmt: skip
    return local, odometry


@pytest.mark.parametrize(("plugin", "version"), [("MCAP", 9), ("SQLITE3", 9)])
def test_messages_of_px4_are_read_from_recordings(tmp_path, plugin, version):
    """North, east, down in the fields that the recording defines become east, north, up, a topic a vehicle."""
    pytest.importorskip("mcap")
    local, odometry = px4_rows()
    kinds = ("VehicleLocalPosition", "VehicleOdometry")
    topics = ("/px4_1/fmu/out/vehicle_local_position", "/px4_1/fmu/out/vehicle_odometry")
    path = px4_bag(tmp_path / "bag", plugin, version,
                   dict(zip(zip(topics, kinds, strict=True), (local, odometry), strict=True)))  # fmt: skip
    read = read_trajectories(path)
    assert read.names == topics[:1]
    time, place = at_samples(read)
    wanted = np.array([[f["y"], f["x"], -f["z"]] for _, f in local])
    np.testing.assert_allclose(place, wanted[5:], atol=1e-6)
    np.testing.assert_allclose(time + read.since, 1.7e9 + 0.02 * np.arange(5, 50), atol=1e-6)
    np.testing.assert_allclose(measured(read).velocity, [[-25.0, 12.5, 6.25]] * 45)
    np.testing.assert_allclose(measured(read).deviation[0], [0.5**1.5, 0.5**1.5, 0.25])
    assert read.read[0]["origin"] == pytest.approx([47.4, 8.55, 488.0])
    read = read_trajectories(path, topic="*/vehicle_odometry")
    np.testing.assert_allclose(at_samples(read)[1], wanted, atol=1e-6)
    np.testing.assert_allclose(measured(read).deviation, [[0.25, 0.5, 1.0]] * 50)


@pytest.mark.parametrize(
    ("change", "right"),
    [
        (lambda text: text.replace("\n", "\r\n"), True),
        (lambda text: text.replace("float32 x\n", "float32 x 0.0  # north\n\n# = [m]\n"), True),
        (lambda text: "uint32 A=1\n" + text, True),
        (lambda text: text.replace("float32 vx", "px4_msgs/Other vx"), False),
        (lambda text: text.replace("float32 x", "float32[<=3] x"), False),
        (lambda text: text.replace("bool xy_valid", "string[] xy_valid"), False),
        (lambda text: "module px4_msgs {\n" + text, False),
    ],
)
def test_a_definition_is_read_whole_or_not(tmp_path, change, right):
    """Fields are where the recording says, however its lines end; with one that is not known, none is guessed."""
    topic = "/fmu/out/vehicle_local_position"
    local, _ = px4_rows()
    path = px4_bag(tmp_path / "bag", "SQLITE3", 9, {(topic, "VehicleLocalPosition"): local})
    with closing(sqlite3.connect(next(path.glob("*.db3")))) as base:
        text = change(PX4["VehicleLocalPosition"].replace("        ", ""))
        base.execute("UPDATE message_definitions SET encoded_message_definition = ?", [text])
        base.commit()
    if right:
        wanted = np.array([[f["y"], f["x"], -f["z"]] for _, f in local])
        np.testing.assert_allclose(at_samples(read_trajectories(path))[1], wanted[5:], atol=1e-6)
    else:
        with pytest.raises(TrajectoryError, match=r"px4_msgs.* definition is not understood"):
            read_trajectories(path)


def test_another_kind_of_cdr_is_refused(tmp_path):
    """Numbers of the second version of CDR, which are aligned in another way, are not read as those of the first."""
    path = poses_bag(tmp_path / "bag", OF_THREE, plugin="SQLITE3")
    assert len(read_trajectories(path).names) == 3
    with closing(sqlite3.connect(path)) as base:
        base.execute("UPDATE messages SET data = CAST(X'00070000' || substr(data, 5) AS BLOB)")
        base.commit()
    with pytest.raises(TrajectoryError, match="is encoded in CDR 0007, not in plain CDR"):
        read_trajectories(path)


@pytest.mark.parametrize("length", [0, 1, 3, 9])
def test_a_message_that_is_cut_off_is_refused(tmp_path, length):
    """Be it within its header of four bytes, or behind it."""
    path = poses_bag(tmp_path / "bag", OF_THREE, plugin="SQLITE3")
    with closing(sqlite3.connect(path)) as base:
        base.execute(f"UPDATE messages SET data = substr(data, 1, {length})")
        base.commit()
    with pytest.raises(TrajectoryError, match="is cut off"):
        read_trajectories(path)


@pytest.mark.parametrize(
    ("frame", "turned"),
    [("map_ned", True), ("ned", True), ("/uav1/NED", True), ("localNED", True), ("world-ned", True),
     ("map", False), ("enu", False), ("map_ENU", False), ("aligned", False), ("", False)],
)  # fmt: skip
def test_a_frame_is_named_by_its_last_word(tmp_path, frame, turned):
    """A frame whose last word is ned is north, east, down; of heights that nobody explains there is a doubt."""
    begin = 1_700_000_000 * 10**9
    rows = [("/a", begin + t, begin + t, [1e-9 * t, 1.0, -3.0], frame)
            for t in range(0, 10**9, 20_000_000)]  # fmt: skip
    read = read_trajectories(poses_bag(tmp_path / "bag", rows))
    k = np.arange(50) * 0.02
    wanted = [1.0 + 0 * k, k, 3.0 + 0 * k] if turned else [k, 1.0 + 0 * k, -3.0 + 0 * k]
    np.testing.assert_allclose(at_samples(read)[1], np.stack(wanted, 1), atol=1e-9)
    assert said(read, "does z point down?") == (not turned and not frame.lower().endswith("enu"))


def test_places_before_their_frame_is_named_are_told(tmp_path):
    """Places of a topic in a frame without a name, before others in one with a name, do not vanish unsaid."""
    begin = 1_700_000_000 * 10**9
    rows = [("/a", begin + t, begin + t, [1e-9 * t, 1.0, 3.0], "map" if t >= 4e8 else "")
            for t in range(0, 10**9, 20_000_000)]  # fmt: skip
    read = read_trajectories(poses_bag(tmp_path / "bag", rows))
    assert len(read.curves[0].time) == 30
    assert said(read, "/a in '' is not read: it is in 'map' later")


def test_what_is_no_log_is_refused_by_name(tmp_path):
    """A path that is planned, PX4's messages without their definition, and frames that are turned anyhow."""
    _, odometry = px4_rows()
    topic = "/fmu/out/vehicle_odometry"
    path = px4_bag(tmp_path / "old", "SQLITE3", 8, {(topic, "VehicleOdometry"): odometry})
    base = sqlite3.connect(next(path.glob("*.db3")))
    base.execute("DROP TABLE IF EXISTS message_definitions")  # as before ROS 2 Iron
    base.commit()
    base.close()
    with pytest.raises(TrajectoryError, match=r"_odometry: is of PX4, and .* define it: record as"):
        read_trajectories(path)
    turned = [(at, fields | {"pose_frame": 2}) for at, fields in odometry]
    path = px4_bag(tmp_path / "frd", "SQLITE3", 9, {(topic, "VehicleOdometry"): turned})
    with pytest.raises(TrajectoryError, match="positions are in a frame that is turned anyhow"):
        read_trajectories(path)
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind, header, time = (store.types[x] for x in ("nav_msgs/msg/Path", "std_msgs/msg/Header",
                                                   "builtin_interfaces/msg/Time"))  # fmt: skip
    with rosbag2.Writer(tmp_path / "plan", version=9) as writer:
        to = writer.add_connection("/plan", kind.__msgtype__, typestore=store)
        message = kind(header(time(1, 0), "map"), [])
        writer.write(to, 10**9, store.serialize_cdr(message, kind.__msgtype__))
    with pytest.raises(TrajectoryError, match="/plan: is a path that is planned, not a log: give"):
        read_trajectories(tmp_path / "plan")


def test_fixes_of_ros_are_places_on_the_earth(log):
    """Latitudes and longitudes of NavSatFix in degrees become east, north, up; without a fix, there is no place."""
    path = log("fixes.mcap")
    read = read_trajectories(path, topic="/fix", origin=(47.4, 8.5, 500.0))
    place = at_samples(read)[1]
    k = np.arange(1, 200)
    np.testing.assert_allclose(
        place, flat(47.4 + 1e-7 * k, 8.5 + 0.0 * k, 500.0 + 0.01 * k, (47.4, 8.5, 500.0)), atol=2e-3
    )
    assert said(read, "1 samples without a valid position are left out")
    assert said(read, "heights are above the ellipsoid, that of the origin is above mean sea level")
    own = read_trajectories(path, topic="/fix")
    np.testing.assert_allclose(
        np.diff(at_samples(own)[1], axis=0), np.diff(place, axis=0), atol=1e-6
    )
    assert not said(own, "ellipsoid")


def test_damaged_logs_are_one_error(log, tmp_path, capfd):
    """Whatever bytes a log has, it is read or refused by one kind of error, without a word of its library."""
    random = np.random.default_rng(5)
    for name in ("copter.tlog", "odometry.mcap", "transforms.db3"):
        path = log(name)
        data = np.frombuffer(path.read_bytes(), np.uint8)
        for k in range(8):
            bad = data.copy()
            bad[random.integers(0, len(bad), 10 ** (k % 3))] = random.integers(
                0, 256, 10 ** (k % 3)
            )
            path.write_bytes(bad[: len(bad) - (k % 2) * random.integers(len(bad))].tobytes())
            with suppress(TrajectoryError):
                read_trajectories(path, gaps="bridge")
    assert capfd.readouterr() == ("", "")


# -- Crazyflie ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "step"), [("cfclient", 1e-6), ("cfclient_compressed", 1e-3)])
def test_tables_that_cfclient_wrote(log, name, step):
    """Its writer was handed a circle with the yaw of its tangent, or whole millimetres of it, from 12.345 s on."""
    read = read_trajectories(log(f"{name}.csv"))
    time, place = at_samples(read)
    t = 0.01 * np.arange(250)
    np.testing.assert_allclose(time, 12.345 + t, atol=1e-9)
    circle = [np.cos(0.8 * t), np.sin(0.8 * t), 1 + 0.3 * np.sin(0.5 * t)]
    np.testing.assert_allclose(place, np.transpose(circle), atol=step)
    if name == "cfclient":
        np.testing.assert_allclose(read.curves[0].at(time)[:, 3], 0.8 * t, atol=1e-6)


def test_logs_of_cfclient_are_in_milliseconds_and_degrees(tmp_path):
    """Columns that cfclient names after variables have their units: ms, m or mm, m/s, deg."""
    variables = (
        "Timestamp,stateEstimate.x,stateEstimate.y,stateEstimate.z,stateEstimate.yaw,kalman.varPX\n"
    )
    rows = "".join(f"{81_000 + 10 * k},{0.01 * k},0.5,1.0,{90 + k},0.1\n" for k in range(20))
    (tmp_path / "metres.csv").write_text(variables + rows)
    read = read_trajectories(tmp_path / "metres.csv")
    time, place = at_samples(read)
    np.testing.assert_allclose(time, 81.0 + 0.01 * np.arange(20))
    np.testing.assert_allclose(place[:, 0], 0.01 * np.arange(20))
    np.testing.assert_allclose(read.curves[0].at(time)[:, 3], np.radians(90 + np.arange(20)))
    compressed = variables.replace("stateEstimate", "stateEstimateZ").replace(
        ",stateEstimateZ.yaw", ""
    )
    rows = "".join(f"{81_000 + 10 * k},{10 * k},500,1000,0.1\n" for k in range(20))
    (tmp_path / "millimetres.csv").write_text(compressed + rows)
    np.testing.assert_allclose(
        at_samples(read_trajectories(tmp_path / "millimetres.csv"))[1], place, atol=1e-12
    )
    assert read_trajectories(tmp_path).own_clocks
    own = variables.replace("Timestamp", "time")
    rows = "".join(f"{0.01 * k},{0.01 * k},0.5,1.0,{90 + k},0.1\n" for k in range(20))
    (tmp_path / "own.csv").write_text(own + rows)
    time = at_samples(read_trajectories(tmp_path / "own.csv"))[0]
    np.testing.assert_allclose(time, 0.01 * np.arange(20), err_msg="a time of the user's own")


def test_records_of_crazyswarm2_are_in_seconds(tmp_path):
    """Its simulator writes a table a vehicle, in seconds and metres, quaternions with the scalar first."""
    for name, y in (("cf1", 0.0), ("cf2", 1.0)):
        rows = "".join(f"{0.3 * k},{0.1 * k},{y},1.0,0.5,0,0,0.8660254\n" for k in range(10))
        (tmp_path / f"{name}.csv").write_text(f"timestamp,x,y,z,qw,qx,qy,qz\n{rows}")
    read = read_trajectories(tmp_path)
    assert (read.names, read.own_clocks) == (("cf1", "cf2"), False)
    time, place = at_samples(read, 1)
    np.testing.assert_allclose(place[:, :2], [[0.1 * k, 1.0] for k in range(10)], atol=1e-12)
    np.testing.assert_allclose(read.curves[1].at(time)[:, 3], 2 * np.pi / 3, atol=1e-7)


# -- command -----------------------------------------------------------------------------------------


def test_the_command_says_what_it_took(log, capsys):
    """`assess --explain` names topic, frame, clock, origin and arming; an origin of what has none is refused."""
    code = main(["assess", str(log("cores.bin")), "--explain", "--limits", "speed=5"])
    out = " ".join(capsys.readouterr().out.split())
    assert code == 0
    for words in ("topics: XKF1", "frame: ned", "clock: that of the receiver of GNSS", "armed: never",
                  "origin: 38.3149933, 26.6360348, 66.63", "positions are those of XKF1"):  # fmt: skip
        assert words in out
    path = str(log("transforms.db3"))
    assert main(["assess", path, "--origin", "47.4", "8.5", "0"]) == 2
    assert "--origin: no file says where on the Earth it is" in capsys.readouterr().err


def test_the_commands_of_the_page_judge_a_kept_log(log, tmp_path, capsys):
    """The commands of docs/logs.md on PX4's log, against a plan made of what `pyulog` reads in it: nothing is off."""
    path, plan = log("sitl.ulg"), tmp_path / "plan.nc"
    every = pytest.importorskip("pyulog").ULog(str(path)).data_list
    (own,) = (x.data for x in every if (x.name, x.multi_id) == ("vehicle_local_position", 0))
    known = (own["xy_valid"] != 0) & (own["z_valid"] != 0)
    time = own["timestamp_sample"][known].astype(float) / 1e6
    place = np.stack([own["y"], own["x"], -own["z"]], axis=1)[known].astype(float)
    rf.trajectories(time - time[0], place[:, None], cubic=True).save(plan)
    page = (Path(__file__).parents[1] / "docs" / "logs.md").read_text()
    commands = re.findall(r"(?m)^rigidfleet (assess [^#\n]+)", page)
    assert len(commands) == 4
    for line in commands:
        line = line.replace("flight.ulg", str(path)).replace("LOG...", str(path))  # noqa: PLW2901
        line = line.replace("MISSION", str(plan)).replace("flights/", f"{tmp_path}/")  # noqa: PLW2901
        code, out = main(line.split()), " ".join(capsys.readouterr().out.split())
        assert code == ("--separation" in line), out  # of one vehicle alone it cannot be judged
        if str(plan) in line:
            late = re.findall(r"the log is (\S+) \+- \S+ s (?:late|early)", out)
            assert float(late[0]) < 0.005
            assert "off its slot" not in out
    assert {"trajectories.nc", "verdict.json", "report.html", "replay.html"} <= {
        x.name for x in (tmp_path / "first").iterdir()
    }


@pytest.mark.parametrize(
    "path", [*sorted(LOGS.glob("*.ulg.xz")), *sorted(Path(MORE).glob("*.ulg") if MORE else ())], ids=lambda p: p.name
)  # fmt: skip
def test_public_logs_of_px4(path, log):
    """Logs of several versions of PX4: what is read is what `pyulog` reads, where it is valid, or one error."""
    path = log(path.stem) if path.suffix == ".xz" else path
    data = {
        x.name: x.data
        for x in pytest.importorskip("pyulog").ULog(str(path)).data_list
        if x.multi_id == 0
    }
    own = data["vehicle_local_position"]
    known = (own["xy_valid"] != 0) & (own["z_valid"] != 0)
    if not known.any():
        with pytest.raises(TrajectoryError, match="vehicle_local_position: no position is valid"):
            read_trajectories(path, topic="vehicle_local_position", gaps="bridge")
        return
    read = read_trajectories(path, topic="vehicle_local_position", gaps="bridge")
    time, place = at_samples(read)
    np.testing.assert_allclose(
        place.T, [own["y"][known], own["x"][known], -own["z"][known]], atol=1e-6
    )
    stamp = own["timestamp_sample"][known].astype(float) / 1e6
    np.testing.assert_allclose(time - time[0], stamp - stamp[0], atol=1e-6)
    heard = data.get("vehicle_global_position")
    if heard is not None:
        origin = read.read[0]["origin"]
        globally = flat(heard["lat"], heard["lon"], heard["alt"], origin)
        now = heard["timestamp_sample"].astype(float) / 1e6 - stamp[0]
        inside = (now > 0.0) & (now < time[-1] - time[0])
        local = read.curves[0].at(now[inside] + time[0])[:, :3]
        np.testing.assert_allclose(local, globally[inside], atol=0.3)


def test_a_log_of_px4_without_a_valid_estimate_has_its_receivers_places(log):
    """PX4's estimator had no position yet: those of the receiver of GNSS count, and a note says which topic did."""
    data = {
        x.name: x.data for x in pytest.importorskip("pyulog").ULog(str(log("cube.ulg"))).data_list
    }
    gps, read = data["vehicle_gps_position"], read_trajectories(log("cube.ulg"), gaps="bridge")
    origin = read.read[0]["origin"]
    place = flat(gps["lat"] / 1e7, gps["lon"] / 1e7, gps["alt"] / 1e3, origin)
    np.testing.assert_allclose(at_samples(read)[1], place, atol=2e-3)
    assert said(read, "vehicle_gps_position")
