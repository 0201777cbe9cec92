"""What a verdict on files of others covers: spans, gaps, folders, clocks, and where separation holds."""

import itertools
import json
import subprocess
import sys
import zipfile

import numpy as np
import pytest

import rigidfleet as rf
from rigidfleet.cli.app import BAD_INPUT, FAILED, PASSED, main
from rigidfleet.errors import MissionError, TrajectoryError
from rigidfleet.foreign import shows
from rigidfleet.foreign.files import read_trajectories
from rigidfleet.mission import load_mission
from rigidfleet.mission.kinds import Follow
from rigidfleet.simulation.trajectories import result_of_trajectories
from rigidfleet.sweep.metrics import METRICS

HEAD = "time_s,agent,x_m,y_m,z_m"


def table(path, vehicles, head=HEAD):
    """A table of vehicles by name: times (K,), and a function of time that gives positions (K, 3)."""
    rows = [
        f"{t:.6f},{name},{x},{y},{z}"
        for name, (times, place) in vehicles.items()
        for t, (x, y, z) in zip(times, place(np.asarray(times)), strict=True)
    ]
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def line(start, velocity):
    """Motion at a constant velocity."""
    return lambda t: np.asarray(start, float) + np.multiply.outer(t, velocity)


def judged(path, spans="refuse", gaps="refuse", interpolation="cubic", **limits):
    read = read_trajectories(path, interpolation, spans=spans, gaps=gaps)
    result = result_of_trajectories(read, **limits)
    result.statistics["notes"] = list(read.notes)
    return rf.assess(result)


def separation(verdict, name="separation"):
    return next(check for check in verdict.checks if check.check == name)


def said(verdict, *words):
    """Whether one note has all these words."""
    return any(all(word in note for word in words) for note in verdict.notes)


EVERY = np.arange(0.0, 100.05, 0.1)
MEET = {
    "a": (EVERY, lambda t: np.stack([-2 + 0.1 * t, 0 * t, 5 + 0 * t], 1)),
    "b": (EVERY, lambda t: np.stack([2 - 0.1 * t, 0 * t, 5 + 0 * t], 1)),
}

# -- spans -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("late", ["begins", "ends", "coarse"])
def test_a_vehicle_without_data_cuts_no_other(late, tmp_path):
    """Two that meet at 20 s are never passed because a third has data for another time, whatever its gaps are."""
    times = {
        "begins": EVERY[EVERY > 29.95],
        "ends": EVERY[EVERY < 10.05],
        "coarse": np.array([30.0, 30.1, 30.2, 75.0, 100.0]),
    }[late]
    path = table(tmp_path / "t.csv", MEET | {"c": (times, line([0, 20, 5], [0, 0, 0]))})
    with pytest.raises(
        TrajectoryError, match=f"'c' has samples from {times[0]:g} to {times[-1]:g} s"
    ):
        judged(path, separation=0.5)
    for spans in ("stand", "away"):
        verdict = judged(path, spans, "bridge", separation=0.5)
        assert not verdict.passed
        check = separation(verdict)
        assert check.worst == pytest.approx(0.0, abs=1e-6)
        assert check.when == pytest.approx(20.0, abs=1e-3)


def test_a_coarse_table_does_not_end_a_finer_one(tmp_path):
    """One vehicle flies through the place of another, whose data ended 5 s before: refused, or it stands there."""
    folder = tmp_path / "show"
    folder.mkdir()
    for name, times, way in (
        ("a", [0.0, 20.0, 40.0], line([-35, 0, 0], [1, 0, 0])),
        ("b", np.arange(0, 30.1, 0.5), line([0, 0, 10], [0, 0, -1 / 3])),
    ):
        table(folder / f"{name}.csv", {name: (times, way)})
    with pytest.raises(
        TrajectoryError, match="'b' has samples from 0 to 30 s, and others from 0 to 40 s"
    ):
        judged(folder, separation=1.0)
    assert separation(judged(folder, "stand", separation=1.0)).worst == pytest.approx(0, abs=1e-6)
    verdict = judged(folder, "away", separation=1.0)
    assert separation(verdict).worst == pytest.approx(5.0, abs=1e-6)  # at 30 s, a is 5 m away
    assert said(verdict, "judged only where they have data", "'b' from 0 to 30 s")


def test_stamps_that_differ_by_less_than_a_step(tmp_path):
    """Vehicles are judged where they have data, nothing is made up between: a straight flight has no corner."""
    times = np.arange(0.0, 10.05, 0.1)
    path = table(
        tmp_path / "t.csv",
        {
            "a": (times, line([0, 0, 5], [1, 0, 0])),
            "b": (times[:-1] + 0.03, line([0, 1, 5], [1, 0, 0])),
        },
    )
    verdict = judged(path, separation=1.0, limits={"acceleration": 0.01})
    assert verdict.passed
    assert separation(verdict).worst == pytest.approx(1.0, abs=1e-6)
    assert said(verdict, "judged only where they have data", "'b' from 0.03 to 9.93 s")
    assert "It covers 2 vehicles from 0 to 10 s." in verdict.summary


def test_away_is_no_place(tmp_path):
    """Where a vehicle was last may be flown through once it is away, and by two that both are; not if it stands."""
    times = np.arange(0.0, 20.05, 0.1)
    path = table(
        tmp_path / "t.csv",
        {
            "goes": (times[times < 5.05], line([0, 0, 5], [0, 0, 0])),
            "passes": (times, line([-10, 0, 5], [1, 0, 0])),  # there at 10 s
            "comes": (times[times > 14.95], line([0, 0, 5], [0, 0, 0])),  # where the first was
        },
    )
    verdict = judged(path, "away", separation=0.5)
    assert verdict.passed
    assert separation(verdict).worst == pytest.approx(5.0, abs=1e-6)
    assert said(verdict, "1 pairs are never there at one time")
    assert not judged(path, "stand", separation=0.5).passed


@pytest.mark.parametrize("n", [5, 44])
def test_presence_against_dense_samples(n, tmp_path):
    """The least separation is that of the pairs of which both have data, as dense samples of the lines say."""
    rng = np.random.default_rng(n)
    ways, vehicles = [], {}
    for i in range(n):
        begin, end = np.sort(rng.choice(np.arange(0, 11), 2, replace=False)) if i else (0, 10)
        start, v = rng.uniform(-9, 9, 3), rng.uniform(-1, 1, 3)
        ways.append((begin, end, start, v))
        vehicles[f"v{i}"] = (np.arange(begin, end + 0.5), line(start, v))
    verdict = judged(table(tmp_path / "t.csv", vehicles), "away", separation=0.0)
    t = np.linspace(0.0, 10.0, 20_001)
    least = np.inf
    for (a, b, r, v), (c, d, s, w) in itertools.combinations(ways, 2):
        both = (t >= max(a, c)) & (t <= min(b, d))
        far = np.linalg.norm(line(r, v)(t) - line(s, w)(t), axis=1)[both]
        least = min(least, far.min(initial=np.inf))
    assert separation(verdict).worst == pytest.approx(least, abs=1e-3)
    assert separation(verdict).worst <= least + 1e-9


def test_a_result_keeps_who_was_there(tmp_path):
    """A saved result is judged as before."""
    path = table(
        tmp_path / "t.csv",
        {
            "a": (EVERY[:101], line([0, 0, 5], [1, 0, 0])),
            "b": (EVERY[:51], line([0, 2, 5], [1, 0, 0])),
        },
    )
    read = read_trajectories(path, spans="away")
    result = result_of_trajectories(read._replace(away=True), separation=1.0)
    result.save(tmp_path / "r.nc")
    again = rf.Result.load(tmp_path / "r.nc")
    assert again.left.sum(axis=0)[0] > again.left.sum(axis=0)[1]
    assert rf.assess(again).to_dict() == rf.assess(result).to_dict()


def test_a_separation_of_one_vehicle_is_not_passed(tmp_path):
    """A separation that was asked for and that nothing shows fails, also where vehicles never meet in time."""
    one = table(tmp_path / "one.csv", {"a": (EVERY, line([0, 0, 5], [1, 0, 0]))})
    assert judged(one).passed
    verdict = judged(one, separation=0.5)
    assert not verdict.passed
    assert "there is one vehicle alone" in verdict.summary
    two = table(
        tmp_path / "two.csv",
        {
            "a": (EVERY[:50], line([0, 0, 5], [1, 0, 0])),
            "b": (EVERY[60:], line([0, 0, 5], [1, 0, 0])),
        },
    )
    assert "never two vehicles at one time" in judged(two, "away", separation=0.5).summary


# -- gaps --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("absent", ["no rows", "nan", "empty"])
def test_a_gap_is_refused_or_told(absent, tmp_path):
    """Rows that are not there and rows without a position are the same gap: refused, or bridged and told."""
    times = np.arange(0.0, 10.05, 0.1)
    rows = [HEAD]
    for t in times:
        rows.append(f"{t:.1f},A,0,0,2")
        if not 3.05 < t < 7.95:
            rows.append(f"{t:.1f},B,1,{0.02 * t:.4f},2")
        elif absent != "no rows":
            rows.append(f"{t:.1f},B" + 3 * (",NaN" if absent == "nan" else ","))
    path = tmp_path / "t.csv"
    path.write_text("\n".join(rows) + "\n")
    with pytest.raises(
        TrajectoryError,
        match=r"'B' has no sample between 3 and 8 s, 50 times .* the gap: `--gaps bridge`",
    ):
        judged(path)
    verdict = judged(path, gaps="bridge", separation=0.5)
    assert verdict.passed
    assert said(verdict, "'B' has no sample between 3 and 8 s", "m from 'A'")
    assert said(verdict, "49 rows without a position") == (absent != "no rows")


@pytest.mark.parametrize("lost", [1, 3, 8])
def test_short_gaps_are_bridged_and_told(lost, tmp_path):
    """A gap of ten usual steps or less is judged, and its note has the least distance there: 1 m."""
    times = np.delete(np.arange(0.0, 10.05, 0.1), np.arange(50, 50 + lost))
    path = table(
        tmp_path / "t.csv",
        {"A": (times, line([0, 0, 2], [1, 0, 0])), "B": (EVERY[:101], line([0, 1, 2], [1, 0, 0]))},
    )
    verdict = judged(path, separation=0.5)
    assert verdict.passed
    assert said(verdict, f"'A' has no sample between 4.9 and {5 + 0.1 * lost:g} s", "1 m from 'B'")
    assert not said(
        judged(table(tmp_path / "u.csv", {"A": (EVERY, line([0, 0, 2], [1, 0, 0]))})), "no sample"
    )


def test_poses_that_are_not_finite_are_gaps(tmp_path):
    """A recording whose poses are not finite for a second has a gap, as a table has."""
    pytest.importorskip("mcap")
    rosbags = pytest.importorskip("rosbags.typesys")
    from mcap.writer import Writer

    store = rosbags.get_typestore(rosbags.Stores.ROS2_JAZZY)
    kind = "geometry_msgs/msg/PoseStamped"
    made = {name.rsplit("/", 1)[1]: store.types[name] for name in (
        kind, "std_msgs/msg/Header", "builtin_interfaces/msg/Time", "geometry_msgs/msg/Pose",
        "geometry_msgs/msg/Point", "geometry_msgs/msg/Quaternion")}  # fmt: skip
    path = tmp_path / "p.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/a", "cdr", writer.register_schema(kind, "ros2msg", b""))
        for k in range(100):
            z = np.nan if 40 <= k < 60 else 2.0
            pose = made["Pose"](
                made["Point"](0.1 * k, 0.0, z), made["Quaternion"](0.0, 0.0, 0.0, 1.0)
            )
            stamp = made["Time"](k // 10, k % 10 * 10**8)
            message = made["PoseStamped"](made["Header"](stamp, ""), pose)
            writer.add_message(channel, k, bytes(store.serialize_cdr(message, kind)), k)
        writer.finish()
    with pytest.raises(TrajectoryError, match=r"'/a' has no sample between 3\.9 and 6 s"):
        judged(path)
    assert said(judged(path, gaps="bridge"), "'/a' has no sample between 3.9 and 6 s")


def test_positions_that_freeze_are_told(tmp_path):
    """A vehicle that stands to the last digit between fast moves may have been lost by its tracker; a hover is not."""
    x = np.where((EVERY > 3) & (EVERY < 7.95), 3.0, EVERY)
    place = lambda t: np.stack([x, 0 * t, 2 + 0 * t], 1)  # noqa: E731
    path = table(tmp_path / "t.csv", {"A": (EVERY, place)})
    assert said(judged(path), "repeat to the last digit", "'A' from 3 to 7.9 s")
    hover = table(tmp_path / "u.csv", {"A": (EVERY, line([0, 0, 2], [0, 0, 0]))})
    assert not said(judged(hover), "repeat to the last digit")


def test_leaps_to_the_origin_are_told(tmp_path):
    """A tracker that writes zeros for what it does not see; a flight through the origin is not doubted."""
    lost = np.where((EVERY > 3) & (EVERY < 3.25), 0.0, 1.0)
    for share, doubted in ((lost, True), (1.0, False)):
        place = lambda t, x=share: np.stack([x * (t - 50), 0 * t, 0 * t], 1)  # noqa: E731
        path = table(tmp_path / "t.csv", {"A": (EVERY, place)})
        assert said(judged(path), "one number for x, y and z, 'A' at 3.1 s") == doubted


def test_a_jump_after_a_standstill_is_told(tmp_path):
    """Lost while it was slow, and there again far away; one that starts by ever longer steps is not doubted."""
    fast = np.cumsum(np.clip(0.02 * (EVERY - 3), 0.001, 0.2))
    lost = np.where((EVERY > 3) & (EVERY < 7.95), fast[30], fast)
    for x, doubted in (
        (lost, True),
        (np.maximum(EVERY - 5, 0) ** 3 - np.maximum(3 - EVERY, 0) ** 3, False),
    ):
        place = lambda t, x=x: np.stack([x, 0 * t, 2 + 0 * t], 1)  # noqa: E731
        path = table(tmp_path / "t.csv", {"A": (EVERY, place)})
        assert said(judged(path), "repeat to the last digit", "'A' from 3 to 7.9 s") == doubted


def test_notes_stand_beside_passed(tmp_path, capsys):
    """In the terminal, in verdict.json and on the page of the report."""
    times = np.delete(EVERY, [50, 51, 52])
    path = table(tmp_path / "t.csv", {"A": (times, line([0, 0, 2], [1, 0, 0]))})
    assert main(["assess", str(path), "--out", str(tmp_path / "out")]) == PASSED
    (folder,) = (p.parent for p in (tmp_path / "out").rglob("verdict.json"))
    words = "'A' has no sample between 4.9 and 5.3 s"
    assert words in " ".join(capsys.readouterr().out.split())
    assert any(words in note for note in json.loads((folder / "verdict.json").read_text())["notes"])
    page = " ".join((folder / "report.html").read_text().replace("&#39;", "'").split())
    assert words in page
    assert "covers the only vehicle from 0 to 100 s" in page


# -- folders -----------------------------------------------------------------------------------------

STILL = [line([x, 0, 5], [0, 0, 0]) for x in (0.0, 20.0)]
THROUGH = line([10, 0, 5], [-2, 0, 0])  # is where the first one stands at 5 s
POLY = "duration," + ",".join(f"{a}^{k}" for a in ("x", "y", "z", "yaw") for k in range(8))


def folder_of(tmp_path, *names):
    """A folder of two vehicles that stand, and of others by name that fly through one of them."""
    folder = tmp_path / "mix"
    for name, way in (
        ("a.csv", STILL[0]),
        ("b.csv", STILL[1]),
        *((name, THROUGH) for name in names),
    ):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = (
            f"{t:.1f},{x},{y},{z}"
            for t, (x, y, z) in zip(EVERY[:101], way(EVERY[:101]), strict=True)
        )
        path.write_text("\n".join(["time_s,x_m,y_m,z_m", *rows]) + "\n")
    return folder


@pytest.mark.parametrize(
    "name", ["c/c.csv", "c.txt", "deep/er/c.CSV", "c", "c.log", ".c.csv/c.csv", "C.CSV"]
)
def test_no_vehicle_hides_in_a_folder(name, tmp_path, capsys):
    """A further vehicle in a sub-folder, or with another suffix, is judged, or the folder is refused by its name."""
    folder = folder_of(tmp_path, name)
    code = main(["assess", str(folder), "--separation", "0.5"])
    if name == "C.CSV":
        assert code == FAILED
    else:
        assert code == BAD_INPUT
        assert f"{folder / name}: may be a further vehicle" in capsys.readouterr().err
        assert main(["assess", str(folder_of(tmp_path / "two")), "--separation", "0.5"]) == PASSED


def test_vehicles_are_named_by_their_folders(tmp_path, capsys):
    """Tables of one name in folders of their own: two that meet fail by the names of the folders."""
    for name, stem in (("a", "way.csv"), ("b", "way.CSV")):
        (tmp_path / "all" / name).mkdir(parents=True)
        table(tmp_path / "all" / name / stem, {name: MEET[name]}, HEAD.replace("agent", "note"))
    (tmp_path / "all" / "__MACOSX").mkdir()
    (tmp_path / "all" / "__MACOSX" / "._way.csv").write_bytes(b"\0\5\x16\7Mac OS X")
    read = read_trajectories(tmp_path / "all")
    assert read.names == ("a", "b")
    assert not judged(tmp_path / "all", separation=0.5).passed


@pytest.mark.parametrize(
    "name", ["._a.csv", "Thumbs.db", "desktop.ini", ".~lock.a.csv#", ".DS_Store"]
)
def test_what_systems_put_beside_files_is_left_out(name, tmp_path):
    """It is named in a note, and hides no vehicle: a table under such a name is refused."""
    folder = folder_of(tmp_path)
    (folder / name).write_bytes(b"\0\5\x16\7\0Mac OS X")
    assert said(judged(folder, separation=0.5), f"of 'mix', {name} is not read")
    with pytest.raises(TrajectoryError, match="may be a further vehicle"):
        read_trajectories(folder_of(tmp_path, name))


@pytest.mark.parametrize("name", ["bag.mcap", "show.skyc", "bag.MCAP"])
def test_kinds_of_one_folder_are_not_mixed(name, tmp_path):
    """Tables beside a recording or a show are refused."""
    folder = folder_of(tmp_path)
    (folder / name).write_bytes(b"")
    with pytest.raises(
        TrajectoryError, match=r"the folder has files .* and .*\. Give files of one kind"
    ):
        read_trajectories(folder)


def test_what_is_no_vehicle_is_named(tmp_path):
    """Other files are left out, with a note."""
    folder = folder_of(tmp_path)
    (folder / "notes.txt").write_text("flown on a Monday\n")
    (folder / "photo.png").write_bytes(b"\x89PNG\0\0")
    assert said(judged(folder, separation=0.5), "of 'mix', notes.txt, photo.png is not read")


@pytest.mark.parametrize(
    ("names", "fine"),
    [
        (["1.csv", "2.csv", "3.CSV"], True),
        (["part_0.csv", "part_1.csv", "part_2.csv"], True),
        (["cf2_1.csv", "cf2_2.csv", "cf2_3.csv"], True),
        (["1.csv", "2.csv", "4.csv"], False),
        (["2.csv", "3.csv", "4.csv"], False),
        (["one.csv", "two.csv", "three.csv"], False),
        (["1.csv", "01.csv", "2.csv"], False),
    ],
)  # fmt: skip
def test_a_sequence_has_all_its_pieces(names, fine, tmp_path):
    """Tables that follow each other are numbered without a gap, in whatever case their suffix is."""
    folder = tmp_path / "all" / "cf1"
    folder.mkdir(parents=True)
    for name in names:
        (folder / name).write_text(f"{POLY}\n1,{','.join(['0'] * 32)}\n")
    if fine:
        assert read_trajectories(tmp_path / "all").curves[0].time[-1] == 3.0
    else:
        with pytest.raises(TrajectoryError, match="are no sequence"):
            read_trajectories(tmp_path / "all")


# -- clocks ------------------------------------------------------------------------------------------

BALL = """schema_version = 1
name = "ball"
[agents]
mass = 1.0
radius = 0.25
position = [[0, 0, 5]]
[[obstacles]]
kind = "sphere"
name = "ball"
radius = 0.5
waypoints = [[0, -10, 5], [0, 10, 5]]
times = [0, 5]
[[phases]]
kind = "hold"
duration = 10.0
"""


@pytest.mark.parametrize("begin", [0.0, 1.0])
def test_one_clock_for_files_and_obstacles(begin, tmp_path):
    """A vehicle that stands where a ball comes by at 2.5 s is .75 m inside it, whenever its file begins."""
    (tmp_path / "ball.toml").write_text(BALL)
    times = np.arange(begin, 8.05, 0.1)
    path = table(tmp_path / "t.csv", {"a": (times, line([0, 0, 5], [0, 0, 0]))})
    verdict = judged(path, mission=str(tmp_path / "ball.toml"))
    check = separation(verdict, "clearance")
    assert check.worst == pytest.approx(-0.75, abs=1e-6)
    assert check.when == pytest.approx(2.5, abs=1e-3)
    assert said(verdict, f"at the times of the file, from {begin:g} s on")


@pytest.mark.parametrize("begin", [-2.0, 200_000.0])
def test_another_zero_is_no_clock_of_obstacles(begin, tmp_path):
    """Times before zero and far from it are told from the first one; where obstacles move, they are refused."""
    (tmp_path / "ball.toml").write_text(BALL)
    path = table(
        tmp_path / "t.csv", {"a": (begin + EVERY, lambda t: line([0, 0, 5], [1, 0, 0])(t - begin))}
    )
    assert said(judged(path), f"times count from {begin:.9g} s")
    with pytest.raises(
        rf.RigidfleetError, match=f"begin at {begin:.9g} s, and obstacles move from 0 s on"
    ):
        judged(path, mission=str(tmp_path / "ball.toml"))


def test_dates_are_no_clock_of_obstacles(tmp_path, capsys):
    """Where obstacles move from 0 s on, nobody knows where they are at a date: refused."""
    (tmp_path / "ball.toml").write_text(BALL)
    for clock in ("{:.1f}", "2024-05-01T00:00:0{:.1f}Z"):
        begin = 0.0 if "T" in clock else 1.7e9
        rows = "".join(f"{clock.format(begin + t)},0,0,5\n" for t in range(9))
        (tmp_path / "t.csv").write_text("time,x_m,y_m,z_m\n" + rows)
        command = ["assess", str(tmp_path / "t.csv"), "--mission", str(tmp_path / "ball.toml")]
        assert main(command) == BAD_INPUT
        assert "and obstacles move from 0 s on" in " ".join(capsys.readouterr().err.split())


# -- what expands ------------------------------------------------------------------------------------


@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak of memory from /proc")
@pytest.mark.parametrize(
    "text",
    [
        "[],",
        *(
            pytest.param(x, marks=pytest.mark.long)
            for x in ('{"a":{}},', '"",', "0,", "[[0]],", '{"abcdefg":1},')
        ),
    ],
)
def test_a_show_is_bounded_by_what_it_becomes(text, tmp_path):
    """However JSON is filled, a small archive is one error, within half a gigabyte and some seconds."""
    path = tmp_path / "bomb.skyc"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        many = (60 << 20) // len(text)
        archive.writestr("show.json", '{"a":[' + text * many + "0]}")
    code = (
        "import re, sys\n"
        "from rigidfleet.foreign.files import read_trajectories\n"
        "try: read_trajectories(sys.argv[1])\n"
        "except Exception as error: print(type(error).__name__)\n"
        "print(int(re.search(r'VmHWM:\\s*(\\d+) kB', open('/proc/self/status').read())[1]) // 1024)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, path], capture_output=True, text=True, timeout=60, check=True
    )
    name, peak = done.stdout.split()
    assert name == "TrajectoryError"
    assert int(peak) < 500


def test_drones_that_share_a_large_entry_are_bounded(tmp_path, monkeypatch):
    """A show whose drones all refer to one entry becomes no larger than a show may."""
    path = tmp_path / "shared.skyc"
    points = [[k, [0, 0, 1], []] for k in range(201)]
    drones = [{"settings": {"trajectory": {"$ref": "./t.json#"}}}] * 20
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("t.json", json.dumps({"points": points}))
        archive.writestr("show.json", json.dumps({"swarm": {"drones": drones}}))
    assert len(read_trajectories(path).curves) == 20
    monkeypatch.setattr(
        shows, "_COEFFICIENTS", 10 * 1600
    )  # 200 pieces of 4 channels and 2 powers each
    with pytest.raises(TrajectoryError, match="drone 11: is too much beside those before"):
        read_trajectories(path)


def test_a_recording_is_bounded_by_what_it_becomes(tmp_path):
    """Chunks that unpack to gigabytes are one error, before they are unpacked."""
    writer = pytest.importorskip("mcap.writer")
    path = tmp_path / "bomb.mcap"
    with path.open("wb") as stream:
        made = writer.Writer(stream, chunk_size=100 << 20)
        made.start()
        schema = made.register_schema("geometry_msgs/msg/PoseStamped", "ros2msg", b"")
        channel = made.register_channel("/pose", "cdr", schema)
        made.add_message(channel, 0, b"\0" * (80 << 20), 0)
        made.finish()
    assert path.stat().st_size < 1 << 20
    with pytest.raises(TrajectoryError, match="unpacks to 80 MiB"):
        read_trajectories(path)


# -- separation in flight ----------------------------------------------------------------------------

_PADS = np.arange(0.0, 36.0, 5.0)
_UP = np.array([0, 0, 1, 2, 2, 1, 0, 0.0])


def test_parked_vehicles_may_be_nearer(tmp_path):
    """Splines are linear in their samples: 1 m on the pads, and 1 + z / 5 at the height z, so 1.5 m from 2.5 m on."""
    vehicles = {
        f"{k}": (_PADS, lambda t, k=k: np.stack([k * (1 + _UP), 0 * t, 5 * _UP], 1))
        for k in range(3)
    }
    path = table(tmp_path / "park.csv", vehicles)
    assert not judged(path, separation=1.5).passed
    verdict = judged(path, separation=1.5, limits={"separation_altitude": 2.5})
    assert verdict.passed
    assert separation(verdict, "separation_flying").worst == pytest.approx(1.5, abs=1e-6)
    assert "1.5 m in flight" in verdict.summary
    for altitude, passed in ((2.4, FAILED), (2.5, PASSED)):
        options = ["--separation", "1.5", "--separation-altitude", str(altitude)]
        assert main(["assess", str(path), *options]) == passed
    touching = judged(path, separation=1.5, radius=0.6, limits={"separation_altitude": 20.0})
    assert not touching.passed  # nobody flies, but bodies overlap on their pads


@pytest.mark.parametrize("n", [4, 44])
def test_separation_from_an_altitude_against_dense_samples(n, tmp_path):
    """The least separation of pairs of which one is at the altitude, as dense samples of the lines say."""
    rng = np.random.default_rng(n)
    starts, v = rng.uniform(-6, 6, (n, 3)), rng.uniform(-1, 1, (n, 3))
    vehicles = {f"v{i}": (np.arange(0.0, 10.5), line(starts[i], v[i])) for i in range(n)}
    path = table(tmp_path / "t.csv", vehicles)
    t = np.linspace(0.0, 10.0, 20_001)
    places = [line(starts[i], v[i])(t) for i in range(n)]
    for altitude in (-3.0, 0.0, 4.0) if n < 40 else (0.0,):
        least = np.inf
        for a, b in itertools.combinations(places, 2):
            far = np.linalg.norm(a - b, axis=1)[np.maximum(a[:, 2], b[:, 2]) >= altitude]
            least = min(least, far.min(initial=np.inf))
        for limit in (0.9 * least, 1.1 * least):
            verdict = judged(
                path, separation=limit, limits={"separation_altitude": altitude}, radius=1e-9
            )
            check = separation(verdict, "separation_flying")
            assert check.passed == (limit < least)
            if check.worst is not None or n < 40 or limit > least:
                assert check.worst == pytest.approx(least, abs=1e-3)


FLOWN = """schema_version = 1
name = "up"
[agents]
mass = 1.0
radius = 0.1
position = [[0.5, 0, 0], [-0.5, 0, 0]]
velocity = [[0.5, 0, 1], [-0.5, 0, 1]]
[limits]
separation = {limit}
separation_altitude = 2.0
[[phases]]
kind = "hold"
control = "open"
duration = 5.0
"""


def test_our_own_flights_may_park_nearer(tmp_path):
    """Two that part at 1 m/s while they climb at 1 m/s are 3 m apart at 2 m, in continuous time, less their radii."""
    path = tmp_path / "up.toml"
    for limit, passed in ((2.7, True), (2.9, False)):
        path.write_text(FLOWN.format(limit=limit))
        verdict = rf.assess(rf.simulate(path))
        check = separation(verdict, "separation_flying")
        assert check.passed is verdict.passed is passed
        assert check.worst == pytest.approx(2.8, abs=1e-6)
        assert check.when == pytest.approx(2.0, abs=1e-6)
        assert separation(verdict).worst == pytest.approx(0.8, abs=1e-6)
    parked = FLOWN.format(limit=1.5).replace("velocity", "# velocity")
    for altitude, foreseen in ((0.5, False), (-0.5, True)):
        path.write_text(parked.replace("altitude = 2.0", f"altitude = {altitude}"))
        assert rf.assess(rf.simulate(path)).passed is not foreseen
        assert any(remark.level == "fails" for remark in rf.check(path).remarks) is foreseen
    assert "separation_flying" in METRICS
    path.write_text(FLOWN.replace("separation = {limit}\n", ""))
    with pytest.raises(MissionError, match=r"separation_altitude.*no effect without separation"):
        load_mission(path)


# -- flown files -------------------------------------------------------------------------------------

FOLLOW = """schema_version = 1
name = "followed"
[agents]
mass = 1.0
radius = 0.1
position = [[0, 0, 5], [0, 3, 5]]
[[phases]]
kind = "follow"
file = "{file}"
"""


def test_gaps_and_spans_of_flown_files(tmp_path):
    """`follow` refuses what `assess` refuses, and `check` notes what it notes."""
    path = tmp_path / "m.toml"
    times = np.arange(0.0, 10.05, 0.1)
    own = {"a": (times, line([0, 0, 5], [0, 0, 0.05])), "b": (times, line([0, 3, 5], [0, 0, 0.05]))}
    for name, other, message in (
        ("gap.csv", np.delete(times, np.arange(40, 60)), "no sample between 3.9 and 6 s"),
        ("span.csv", times[:80], "has samples from 0 to 7.9 s"),
        ("short.csv", np.delete(times, [40, 41]), "no sample between 3.9 and 4.2 s"),
        (
            "stamps.csv",
            times[:-1] + 0.04,
            "only the time of which all have data is flown, 0.04 to 9.94 s",
        ),
    ):
        table(tmp_path / name, own | {"b": (other, own["b"][1])})
        path.write_text(FOLLOW.format(file=name))
        if name in ("gap.csv", "span.csv"):
            with pytest.raises(MissionError, match=message):
                load_mission(path)
        else:
            mission = load_mission(path)
            notes = [r.text for r in rf.check(mission).remarks if r.topic == "files"]
            assert any(message in note for note in notes)
            phase = mission.phases[0]
            assert isinstance(phase, Follow)
            assert phase.pieces.time[-1] == pytest.approx(10.0 if name == "short.csv" else 9.9)


def test_drones_of_a_show_keep_their_times_when_flown(tmp_path):
    """A drone that takes off 3 s later than another waits so long, in the followed ways as in the show."""
    entries = {
        f"{k}.json": {
            "points": [[0, [0, 3 * k, 5], []], [4, [0, 3 * k, 9], [[0, 3 * k, 5], [0, 3 * k, 9]]]],
            "takeoffTime": 3 * k,
        }
        for k in range(2)
    }
    drones = [
        {"settings": {"name": f"d{k}", "trajectory": {"$ref": f"./{k}.json#"}}} for k in range(2)
    ]
    with zipfile.ZipFile(tmp_path / "late.skyc", "w") as archive:
        for name, entry in (entries | {"show.json": {"swarm": {"drones": drones}}}).items():
            archive.writestr(name, json.dumps(entry))
    (tmp_path / "m.toml").write_text(FOLLOW.format(file="late.skyc"))
    phase = load_mission(tmp_path / "m.toml").phases[0]
    assert isinstance(phase, Follow)
    np.testing.assert_allclose(
        phase.pieces.at(np.array([2.0, 5.0, 7.0]))[:, :, 2], [[7, 5], [9, 7], [9, 9]]
    )


@pytest.mark.parametrize("number", [9999.0, -1.0, 77.0])
@pytest.mark.parametrize("unit", ["m", "mm"])
def test_a_number_that_stands_for_no_position_is_refused(tmp_path, number, unit):
    """One number for x, y and z, to which positions leap and from which they come back, is no place; nan is none."""
    header, scale = f"time_s,x_{unit},y_{unit},z_{unit}", {"m": 1.0, "mm": 1e3}[unit]
    lost = (EVERY > 3) & (EVERY < 3.25)
    place = scale * np.stack([0.2 * EVERY - 5.0, 2.0 + 0.0 * EVERY, 3.0 + 0.0 * EVERY], 1)
    for missing, axes in ((number, None), (number, "ned"), (np.nan, None)):
        rows = np.column_stack([EVERY, np.where(lost[:, None], missing, place)])
        np.savetxt(tmp_path / "t.csv", rows, delimiter=",", header=header, comments="")
        if not missing > 5.0 * np.abs(place).max():  # a place may be there, which is noted
            read = read_trajectories(tmp_path / "t.csv", axes=axes)
            assert np.isnan(missing) or "'t' at " in " ".join(read.notes)
            continue
        with pytest.raises(TrajectoryError, match=r"'t' leaps to a place .* as if it had none"):
            read_trajectories(tmp_path / "t.csv", axes=axes)
    # Who flies along the diagonal, ever faster, or stands there, is somewhere.
    there = np.repeat(np.cumsum(np.linspace(0.0, 1.0, len(EVERY)))[:, None], 3, axis=1)
    # So is who steps round a square, at its corners.
    corners = [[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1], [-1, -1, 1.0]]
    rise = np.linspace(0.0, 1.0, (len(EVERY) - 20) // 2)[:, None] * [-1.0, -1.0, 1.0]
    square = np.vstack([rise, np.repeat(corners, 4, axis=0), rise[::-1]])
    for at in (there, 0 * there + 77.0, square):
        rows = np.column_stack([EVERY[: len(at)], at])
        np.savetxt(tmp_path / "t.csv", rows, delimiter=",", header=header, comments="")
        read_trajectories(tmp_path / "t.csv")
