"""Exports read by others' programs: rosbags and mcap-ros2 (MCAP), pymavlink (.tlog), Rerun, pygltflib.

`make .venv/.interchange` installs them; a test whose reader is missing is skipped.
"""

import math

import numpy as np
import pytest

import rigidfleet as rf
from rigidfleet.interchange import export

RATE, N = 20.0, 3
ORIGIN = {"latitude_deg": -33.9, "longitude_deg": 18.4, "altitude": 30.0}


def reader(name):
    """The package of a reader; without it the test is skipped."""
    return pytest.importorskip(
        name, reason=f"{name} is missing: make .venv/.interchange installs it"
    )


@pytest.fixture(scope="module")
def flight():
    """A smooth flight of three vehicles that turn, with a place on the Earth."""
    data = rf.load_mission("narrow-passage").to_dict() | {
        "smoothness": "jerk", "geodetic_origin": ORIGIN
    }  # fmt: skip
    return rf.simulate(rf.Mission.from_dict(data))


@pytest.fixture(scope="module")
def wanted(flight):
    """The setpoints that the files should have: tracked ones only, at the rate."""
    due = flight.setpoints(RATE)
    tracked = np.isfinite(due.yaw).all(axis=1)
    assert 6.0 <= due.time[tracked][0] <= 6.0 + 1 / RATE
    return type(due)(*(x[tracked] for x in due))


def yaw_by_kind(x, y, z, w):
    """Yaw [rad] of a rotation about the vertical."""
    assert (x, y) == (0.0, 0.0)
    return 2.0 * math.atan2(z, w)


def same_angles(a, b, tolerance):
    assert abs(np.angle(np.exp(1j * (np.array(a) - b)))).max() < tolerance


def test_rosbags_reads_mcap(flight, wanted, tmp_path):
    """rosbags, with its own definitions of the messages, reads every pose and twist."""
    highlevel, typesys = reader("rosbags.highlevel"), reader("rosbags.typesys")
    path = tmp_path / "flight.mcap"
    reader("mcap.writer")
    export(flight, path, "mcap", rate=RATE)
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    rows = {}
    with highlevel.AnyReader([path], default_typestore=store) as bag:
        assert {c.topic for c in bag.connections} == {
            f"/agent_{i + 1}/{kind}" for i in range(N) for kind in ("pose", "twist")
        }
        for connection, stamp, raw in bag.messages():
            message = store.deserialize_cdr(raw, connection.msgtype)
            header = message.header
            assert header.frame_id == "map"
            assert header.stamp.sec * 10**9 + header.stamp.nanosec == stamp
            if connection.topic.endswith("pose"):
                p, q = message.pose.position, message.pose.orientation
                row = [stamp / 1e9, p.x, p.y, p.z, yaw_by_kind(q.x, q.y, q.z, q.w)]
            else:
                v, w = message.twist.linear, message.twist.angular
                assert (w.x, w.y) == (0.0, 0.0)
                row = [stamp / 1e9, v.x, v.y, v.z, w.z]
            rows.setdefault(connection.topic, []).append(row)
    for i in range(N):
        pose, twist = (np.array(rows[f"/agent_{i + 1}/{kind}"]) for kind in ("pose", "twist"))
        assert pose[:, 0] == pytest.approx(wanted.time, abs=1e-9)
        assert pose[:, 1:4] == pytest.approx(wanted.state[:, 0, i], abs=1e-12)
        assert twist[:, 1:4] == pytest.approx(wanted.state[:, 1, i], abs=1e-12)
        same_angles(pose[:, 4], wanted.yaw[:, i], 1e-12)
        assert twist[:, 4] == pytest.approx(wanted.yaw_rate[:, i], abs=1e-12)


def test_mcap_ros2_reads_the_definitions(flight, wanted, tmp_path):
    """mcap-ros2 reads the same positions by the definitions that the file itself has."""
    ros2 = reader("mcap_ros2.reader")
    path = tmp_path / "flight.mcap"
    export(flight, path, "mcap", rate=RATE)
    found = [
        [m.ros_msg.pose.position.x, m.ros_msg.pose.position.y, m.ros_msg.pose.position.z]
        for m in ros2.read_ros2_messages(str(path), topics=["/agent_2/pose"])
    ]
    assert np.array(found) == pytest.approx(wanted.state[:, 0, 1], abs=1e-12)


def test_pymavlink_reads_tlog(flight, wanted, tmp_path):
    """pymavlink accepts every checksum, and reads the origin and all setpoints in north, east, down."""
    mavutil = reader("pymavlink.mavutil")
    export(flight, tmp_path / "logs", "tlog", rate=RATE)
    for i in range(N):
        log = mavutil.mavlink_connection(str(tmp_path / "logs" / f"agent-{i + 1}.tlog"))
        origin = log.recv_match()
        assert origin.get_type() == "SET_GPS_GLOBAL_ORIGIN"
        assert (origin.latitude, origin.longitude, origin.altitude) == (
            -339000000,
            184000000,
            30000,
        )
        rows = []
        while (m := log.recv_match()) is not None:
            assert m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"
            assert (m.target_system, m.coordinate_frame, m.type_mask) == (i + 1, 1, 0)
            assert m.time_boot_ms / 1e3 == pytest.approx(m._timestamp)
            rows.append(
                [
                    m.time_boot_ms,
                    m.y,
                    m.x,
                    -m.z,
                    m.vy,
                    m.vx,
                    -m.vz,
                    m.afy,
                    m.afx,
                    -m.afz,
                    m.yaw,
                    -m.yaw_rate,
                ]
            )
        log.close()
        found = np.array(rows)
        assert found[:, 0] / 1e3 + 6.0 == pytest.approx(wanted.time, abs=5.1e-4)
        due = wanted.state[:, :3, i].reshape(-1, 9)
        assert found[:, 1:10] == pytest.approx(due, rel=2e-7, abs=2e-6)
        same_angles(math.pi / 2 - found[:, 10], wanted.yaw[:, i], 1e-6)
        assert found[:, 11] == pytest.approx(wanted.yaw_rate[:, i], abs=1e-6)


def test_rerun_reads_rrd(flight, wanted, tmp_path):
    """Rerun's reader finds each vehicle's positions on the timeline "time", in single precision."""
    chunk = reader("rerun.chunk")
    path = tmp_path / "flight.rrd"
    export(flight, path, "rrd", rate=RATE)
    found = {}
    for part in chunk.RrdReader(str(path)).stream().to_chunks():
        if part.timeline_names:
            table = part.to_record_batch().to_pydict()
            seconds = [
                x.total_seconds() if hasattr(x, "total_seconds") else x / 1e9 for x in table["time"]
            ]
            rows = zip(
                seconds,
                table["Transform3D:translation"],
                table["Transform3D:quaternion"],
                strict=True,
            )
            found.setdefault(part.entity_path, []).extend((t, *p[0], *q[0]) for t, p, q in rows)
    assert set(found) == {f"/vehicles/{i + 1}" for i in range(N)}
    for i in range(N):
        rows = np.array(sorted(found[f"/vehicles/{i + 1}"]))
        assert rows[:, 0] == pytest.approx(wanted.time, abs=1e-6)
        assert rows[:, 1:4] == pytest.approx(wanted.state[:, 0, i], rel=1e-7, abs=1e-6)
        same_angles([yaw_by_kind(*q) for q in rows[:, 4:]], wanted.yaw[:, i], 1e-6)


def test_pygltflib_reads_gltf(flight, tmp_path):
    """pygltflib reads the scene: a node, a spline and a turn for each vehicle, and keys on the reference."""
    pygltflib = reader("pygltflib")
    path = tmp_path / "flight.glb"
    made = export(flight, path, "gltf")
    scene = pygltflib.GLTF2().load(str(path))
    assert [node.name for node in scene.nodes] == [f"agent {i + 1}" for i in range(N)]
    (animation,) = scene.animations
    binary = scene.binary_blob()

    def array(index):
        accessor = scene.accessors[index]
        view = scene.bufferViews[accessor.bufferView]
        return np.frombuffer(binary[view.byteOffset :][: view.byteLength], "<f4").reshape(
            accessor.count, -1
        )

    start = made.span[0]
    for channel in animation.channels:
        sampler = animation.samplers[channel.sampler]
        if channel.target.path != "translation":
            assert sampler.interpolation == "LINEAR"
            continue
        assert sampler.interpolation == "CUBICSPLINE"
        times, rows = array(sampler.input)[:, 0], array(sampler.output)
        keys = rows[1::3].astype(float)
        at = np.searchsorted(flight.time, times + start + 1e-4) - 1
        assert flight.time[at] == pytest.approx(times + start, abs=2e-5)
        due = flight.slot_position[at, channel.target.node]
        assert np.stack([keys[:, 0], -keys[:, 2], keys[:, 1]], axis=1) == pytest.approx(
            due, abs=2e-5
        )
