"""Drills: faults of the day are found where they are, and nowhere else."""

import itertools
import json
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from test_logs import log as log_file

import rigidfleet as rf
from rigidfleet._common.facts import FactTable
from rigidfleet.cli.app import main
from rigidfleet.foreign import files
from rigidfleet.sweep import Sweep, faults, figures, fly, load
from rigidfleet.sweep.faults import Drill, GeometricFault, Show
from rigidfleet.sweep.run import fly_runs
from rigidfleet.sweep.summary import failure_rates, summarise

log = log_file  # the fixture
#: Least distance of the shows here, and radius of their vehicles [m].
SEPARATION, RADIUS = 0.6, 0.1


class Day(NamedTuple):
    """A show of others: a table of setpoints, what it is judged by, its fence (2, 3) [m], and its splines by SciPy."""

    file: str
    mission: rf.Mission
    fence: np.ndarray
    splines: list[CubicSpline]

    @property
    def n(self):
        return len(self.splines)

    def place(self, i, t):
        """Positions (K, 3) of vehicle i at times; it stands where it begins and ends."""
        x = self.splines[i].x
        return self.splines[i](np.clip(t, x[0], x[-1]))

    @property
    def speed(self):
        """At least the greatest speed of a vehicle [m/s]."""
        fastest = 0.0
        for s in self.splines:
            h = np.diff(s.x)[:, None]
            bound = 3 * abs(s.c[0]) * h**2 + 2 * abs(s.c[1]) * h + abs(s.c[2])
            fastest = max(fastest, float(np.linalg.norm(bound, axis=1).max()))
        return fastest


def day(folder, seed):
    """A show of a grid that rises, flies to and fro, and lands, while each vehicle dances about its place."""
    rng = np.random.default_rng(seed)
    side = 3 + seed % 2
    pads = np.array([[x, y, 0.0] for x in range(side) for y in range(side)]) * 1.3
    pads[:, :2] -= pads[:, :2].mean(axis=0)
    t = np.arange(0.0, 24.5, 0.5)

    def shared(begin, end):
        u = np.clip((t - begin) / (end - begin), 0, 1)
        return (u**2 * (3 - 2 * u))[:, None, None]

    flying, away = shared(1, 5) - shared(19, 23), shared(6, 11) - shared(13, 18)
    dance = np.sin(
        rng.uniform(0.3, 0.9, (len(pads), 3)) * t[:, None, None] + rng.uniform(0, 6, (len(pads), 3))
    )
    dance *= flying * rng.uniform(0.02, 0.12, (len(pads), 3))
    x = pads + flying * [0.0, 0.0, 6.0] + away * np.append(rng.uniform(-6, 6, 2), 0.0) + dance
    rows = [
        f"{time},{i + 1},{','.join(map(repr, place))}"
        for time, every in zip(t.tolist(), x.tolist(), strict=True)
        for i, place in enumerate(every)
    ]
    file = folder / f"show-{seed}.csv"
    file.write_text("\n".join(["time,agent,x,y,z", *rows]) + "\n")
    fence = np.stack([x.min(axis=(0, 1)) - 0.8, x.max(axis=(0, 1)) + 0.8])
    mission = rf.Mission.from_dict(
        {
            "schema_version": 1, "name": f"show-{seed}",
            "limits": {"separation": SEPARATION, "geofence": dict(zip(("min", "max"), fence.tolist(), strict=True))},
            "agents": {"mass": 1.0, "radius": RADIUS, "position": x[0].tolist()},
            "phases": [{"kind": "hold", "control": "open", "duration": 1.0}],
        }
    )  # fmt: skip
    return Day(str(file), mission, fence, [CubicSpline(t, x[:, i]) for i in range(len(pads))])


class Known(np.random.Generator):
    """Random numbers that a fault takes, which are known: bearings [rad], and a sign."""

    def __init__(self, angles, sign):
        super().__init__(np.random.PCG64(0))
        self.angles, self.sign = angles, sign

    def uniform(self, low=0.0, high=1.0, size=None):
        return self.angles[:size]

    def choice(self, a, *_, **__):
        assert self.sign in a
        return self.sign


def places_of(show, t, fault, size, who, angles, sign):
    """Positions (K, N, 3) of all vehicles by a fault, from what its words say."""
    x = np.stack([show.place(i, t) for i in range(show.n)], axis=1)
    whole = len(who) == show.n
    for k, i in enumerate(who):
        own, pad = x[:, i].copy(), (np.zeros(2) if whole else show.place(i, np.zeros(1))[0, :2])
        off = own[:, :2] - pad
        if fault == "late":
            own = show.place(i, t - size)
        elif fault == "another":
            j = (i + int(size)) % show.n
            start = show.place(i, np.zeros(1)) - show.place(j, np.zeros(1))
            own = show.place(j, t) + start
        elif fault in ("bias", "shifted"):
            angle = angles[k] if fault == "bias" else angles[0]
            own[:, 0] += size * np.sin(angle)
            own[:, 1] += size * np.cos(angle)
        elif fault == "rotated":  # clockwise, or the other way
            c = off[:, 0] + 1j * off[:, 1]
            c *= np.exp(-1j * np.radians(size) * sign)
            own[:, :2] = pad + np.column_stack([c.real, c.imag])
        elif fault == "mirrored":
            a = np.radians(size)
            along = off[:, 0] * np.sin(a) + off[:, 1] * np.cos(a)
            across = off[:, 0] * np.cos(a) - off[:, 1] * np.sin(a)
            own[:, :2] = pad + np.column_stack(
                [along * np.sin(a) - across * np.cos(a), along * np.cos(a) + across * np.sin(a)]
            )
        x[:, i] = own
    return x


def brute_force(show, *fault):
    """Whether a fault breaks the separation, and the fence: sampled so densely that no speed allows a doubt."""
    end = show.splines[0].x[-1] + (fault[1] if fault[0] == "late" else 0.0)
    pairs = np.array(list(itertools.combinations(range(show.n), 2))).T
    count, verdicts = 400, {}
    while len(verdicts) < 2:
        assert count < 500_000, "a fault at the very limit"
        t = np.linspace(0.0, end, count)
        x = places_of(show, t, *fault)
        move = show.speed * (t[1] - t[0]) / 2
        least = (
            np.linalg.norm(x[:, pairs[0]] - x[:, pairs[1]], axis=2).min() - 2 * RADIUS - SEPARATION
        )
        inside = min((x - show.fence[0]).min(), (show.fence[1] - x).min())
        for name, margin, doubt in (("separation", least, 2 * move), ("geofence", inside, move)):
            if margin < 0 or margin > doubt:
                verdicts[name] = margin < 0
        count *= 3
    return {name for name, broken in verdicts.items() if broken}


def some_faults(show, rng, count):
    """Faults of known size, each kind in turn, small and large."""
    sizes = {
        "late": (0.05, 3.0), "another": (1, 3), "rotated": (0.5, 40.0), "shifted": (0.1, 1.5),
        "bias": (0.05, 0.8), "mirrored": (0.0, 90.0), "whole rotated": (1.0, 60.0), "whole shifted": (0.2, 3.0),
    }  # fmt: skip
    for k in range(count):
        name = list(sizes)[k % len(sizes)]
        low, high = sizes[name]
        size = float(rng.integers(1, 4)) if name == "another" else float(rng.uniform(low, high))
        if rng.random() < 0.4 and name not in ("another", "mirrored"):
            size = low
        several = name in ("late", "bias", "another") and rng.random() < 0.5
        n = show.n if name.startswith("whole") else 3 if several else 1
        who = np.sort(rng.permutation(show.n)[:n])
        angles, sign = rng.uniform(0, 2 * np.pi, show.n), float(rng.choice([-1, 1]))
        yield name.split()[-1], size, who, angles, sign


def compare(folder, seeds, count):
    """Numbers of faults that break something by brute force, and of those that do not; a drill agrees on each."""
    broken = 0
    for seed in seeds:
        show = day(folder, seed)
        drilled, rng = Show(show.mission, Drill(files=(show.file,))), np.random.default_rng(seed)
        for fault, size, who, angles, sign in some_faults(show, rng, count):
            truth = brute_force(show, fault, size, who, angles, sign)
            _, reason, words = drilled.measure_fault(
                GeometricFault(fault, size, who, Known(angles, sign))
            )
            assert set(filter(None, reason.split(", "))) == truth, (seed, fault, size, who, words)
            broken += bool(truth)
            if fault in ("rotated", "shifted", "mirrored") and len(who) == show.n:
                assert "separation" not in truth
    return broken, len(seeds) * count - broken


def test_what_a_drill_finds_is_what_brute_force_finds(tmp_path):
    """Of 40 faults of a show, those that a drill calls dangerous are those that dense samples do, both ways."""
    broken, harmless = compare(tmp_path, [2], 40)
    assert broken > 8 < harmless


@pytest.mark.long
def test_four_hundred_faults_in_ten_shows(tmp_path):
    """Of 400 faults in ten shows, about half harmless, a drill finds those that brute force finds, both ways."""
    broken, harmless = compare(tmp_path, range(10), 40)
    assert 150 < broken < 250, (broken, harmless)


def test_a_show_that_is_turned_as_a_whole_is_judged_by_its_fence_alone(tmp_path):
    """Without a fence nothing of it can fail; with one, the geofence fails, and no separation is another one."""
    show, every = day(tmp_path, 3), np.arange(16)
    drilled = Show(show.mission, Drill(files=(show.file,)))
    stream = Known(np.zeros(16), 1.0)
    before = drilled.measure_fault(GeometricFault("rotated", 1e-9, every, stream))[0]["separation"]
    worst, reason, words = drilled.measure_fault(GeometricFault("rotated", 90.0, every, stream))
    assert reason == "geofence"
    assert "leaves the geofence" in words
    assert worst["separation"] == pytest.approx(before, abs=1e-9)
    data = show.mission.to_dict()
    del data["limits"]["geofence"]
    free = Show(rf.Mission.from_dict(data), Drill(files=(show.file,)))
    assert free.measure_fault(GeometricFault("rotated", 90.0, every, stream)) == ({}, "", "")


def test_in_turn_every_vehicle_has_a_fault():
    """In n / k trials, each of n vehicles is among the k of a fault exactly once, if k divides n."""
    for count in (1, 3, 4):
        some = [faults.vehicles_of(5, 12, count, trial) for trial in range(12 // count)]
        assert sorted(np.concatenate(some).tolist()) == list(range(12))
    again = [faults.vehicles_of(5, 12, 4, trial).tolist() for trial in range(6)]
    assert again[:3] != again[3:]
    assert all(len(set(who)) == 4 for who in again)


#: A sweep file of a drill of a show of others.
FILE = """
mission = "limits.toml"
[drill]
files = ["show-2.csv"]
late = [0.05, 2.0]
rotated = [1.0, 60.0]
vehicles = [2]
trials = 3
"""


@pytest.fixture(scope="module")
def drilled(tmp_path_factory):
    """The folder of a drill by a sweep file, and its table."""
    folder = tmp_path_factory.mktemp("drill")
    show = day(folder, 2)
    (folder / "limits.toml").write_text(show.mission.text)
    (folder / "day.toml").write_text(FILE)
    return folder, show, fly(Sweep.load(folder / "day.toml"), folder / "out", workers=1)


def test_a_drill_is_a_sweep_over_its_faults(drilled):
    """Each case comes once in a row of cases, as often as there are trials; the store has it and gives it back."""
    folder, _, table = drilled
    cases = [
        (fault, size, count)
        for fault, sizes in (("late", (0.05, 2.0)), ("rotated", (1.0, 60.0)))
        for size in sizes
        for count in ((2,) if fault == "late" else (1, 9))
    ]
    assert table.complete
    assert len(table.run) == 3 * len(cases)
    assert [tuple(table.sweep.values(k)) for k in range(18)] == 3 * cases
    sweep = Sweep.load(folder / "day.toml")
    assert Sweep.from_json(sweep.json()).identity == sweep.identity == table.sweep.identity
    (row,) = fly_runs(sweep, [17])
    assert (row.passed, row.reason, row.detail) == (
        table.passed[17],
        table.reason[17],
        table.detail[17],
    )
    assert (
        fly(sweep, folder / "out", workers=1).wall.tolist() == table.wall.tolist()
    )  # none flown again
    assert float(load(folder / "out")["drill.magnitude"][17]) == 60.0


def test_the_worst_run_of_each_fault_is_drawn(drilled):
    """Dots are where two vehicles come as near as the words of the run say, or one crosses a fence, at that time."""
    _, _, table = drilled
    figure = figures.worst_runs_from_above(table)
    assert figure is not None
    worst = {}
    for case in (case for case in failure_rates(table) if case.worst):
        known = worst.setdefault(case.fault, case)
        worst[case.fault] = min(known, case, key=lambda x: x.separation or 0.0)
    axes = [ax for ax in figure.axes if ax.lines]
    assert [ax.get_title(loc="left").split()[0] for ax in axes] == list(worst)
    for ax, case in zip(axes, worst.values(), strict=True):
        detail = case.worst.detail
        names, _, when = ax.get_xlabel().rpartition(", ")
        assert names in detail
        times = [float(x) for x in re.findall(r"at ([\d.]+) s", detail)]
        assert float(when[:-2]) == pytest.approx(times[-1], abs=0.05 + 1e-9)
        ends = [np.column_stack(x.get_data())[-1] for x in ax.lines if x.get_marker() == "o"]
        assert len(ends) == len(re.findall(r"\d+", names))
        if len(ends) == 2:  # as seen from above, no farther apart than in space
            assert np.linalg.norm(ends[0] - ends[1]) <= case.separation + 2 * RADIUS + 1e-6


def test_the_summary_has_the_share_of_each_fault(drilled):
    """Shares are counted, the worst run is a failed one of least separation, and the picture has the shares as bars."""
    _, _, table = drilled
    summary = summarise(table)
    data = json.loads(summary.json())["drill"]
    assert [(x["fault"], x["magnitude"], x["vehicles"]) for x in data] == sorted(
        {tuple(table.sweep.values(k)) for k in range(18)}
    )
    for case in data:
        rows = [
            k
            for k in range(18)
            if table.sweep.values(k) == [case["fault"], case["magnitude"], case["vehicles"]]
        ]
        failed = [k for k in rows if not table.passed[k]]
        assert case["failed"]["count"] == len(failed)
        assert case["failed"]["of"] == 3
        if failed:
            assert case["worst"]["run"] in failed
            assert case["worst"]["detail"] == table.detail[case["worst"]["run"]]
    assert {0, 3} & {case["failed"]["count"] for case in data}
    figure = figures.drill_failure_figure(table)
    assert figure is not None
    heights = [bar.get_height() for ax in figure.axes if ax.containers for bar in ax.containers[0]]
    assert heights == pytest.approx([100 * case["failed"]["rate"] for case in data])
    shown = summary.facts().parts[0]
    assert isinstance(shown, FactTable)
    assert [row.cells[3] for row in shown.rows] == [
        f"{case['failed']['count']} of 3" for case in data
    ]
    sentences = summary.drill_sentences()
    assert sentences[0] == f"{summary.success.count} of {len(table.run)} faults are harmless."
    assert [x.partition(":")[0] for x in sentences[1:]] == ["Late", "Rotated"]
    for case in (case for case in data if case["fault"] == "late"):
        size, failed = f"{case['magnitude']:g}", case["failed"]["count"]
        assert (f"{failed} of 3 fail by {size}" in sentences[1]) == bool(failed)
        assert failed or size in sentences[1].partition(";")[0].split("none fails by ")[1]
    worst = summary.facts().parts[1]
    assert isinstance(worst, FactTable)
    assert [row.cells[3:] for row in worst.rows] == [
        (case["worst"]["run"], case["worst"]["detail"]) for case in data if case["worst"]
    ]


def test_faults_that_are_flown_are_missions():
    """Wind is added to the forecast in any direction; losses are of different vehicles and links, within the flight."""
    data = rf.load_mission("change-of-picture").to_dict()
    data["disturbances"] = {"wind": [1.0, 2.0, 0.0], "lost": [{"agent": 3, "time": 5.0}]}
    with pytest.raises(rf.SweepError, match=r"without \[network\], one law knows all states"):
        Sweep.of(rf.Mission.from_dict(data), [], drill={"links": [5]})
    agents = data["agents"]
    vehicle = {"model": "point"} | {key: agents.pop(key) for key in ("mass", "thrust_limit")}
    data |= {"vehicles": {"p": vehicle}, "network": {}}
    agents["vehicle"] = "p"
    mission, n = rf.Mission.from_dict(data), 12
    sweep = Sweep.of(mission, [], drill={"wind": [4.0], "links": [5], "lost": [2]}, seed=3)
    assert sweep.runs == 3 * 20
    assert sweep.name == "change-of-picture-drill"
    winds = [
        np.array(sweep.document_of_run(k)["disturbances"]["wind"]) - [1, 2, 0]
        for k in range(0, 60, 3)
    ]
    assert np.allclose(np.linalg.norm(winds, axis=1), 4.0)
    assert all((np.array(winds)[:, axis] * sign).max() > 2 for axis in (0, 1) for sign in (1, -1))
    for k in range(1, 60, 3):
        links = sweep.document_of_run(k)["network"]["lost"]
        pairs = {tuple(sorted(each["between"])) for each in links}
        assert len(pairs) == 5
        assert all(1 <= i < j <= n for i, j in pairs)
        lost = sweep.document_of_run(k + 1)["disturbances"]["lost"]
        assert lost[0] == {"agent": 3, "time": 5.0}
        assert len({each["agent"] for each in lost}) == 3
        assert all(0 < each["time"] < 60 for each in (*links, *lost))
    assert sweep.document_of_run(4) == sweep.document_of_run(4) != sweep.document_of_run(7)


def test_a_fault_that_is_flown_has_the_verdict_of_its_mission():
    """A run with wind fails as the verdict on the mission with this wind does; one late by nothing passes."""
    sweep = Sweep.of("change-of-picture", [], drill={"wind": [6.0], "trials": 1})
    (row,) = fly_runs(sweep, [0])
    verdict = rf.assess(rf.simulate(rf.Mission.from_dict(sweep.document_of_run(0))))
    assert row.passed == verdict.passed
    assert row.reason.split(", ") == list(
        dict.fromkeys(c.check for c in verdict.checks if not c.passed)
    )


def test_a_late_light_is_caught_as_it_is_flown():
    """A light of the shipped change of picture that is late by 2 s comes as near as samples of the file show."""
    result = rf.simulate("change-of-picture")
    show = faults.show_of(rf.load_mission("change-of-picture").text, Drill(late=(2.0,)))
    worst, reason, words = show.measure_fault(
        GeometricFault("late", 2.0, np.array([4]), np.random.default_rng(0))
    )
    t = np.arange(0.0, 33.0, 0.001)
    x = result.time
    places = [CubicSpline(*samples(x, result.slot_position[:, i])) for i in range(12)]
    moved = places[4](np.clip(t - 2.0, 0, x[-1]))
    apart = [
        np.linalg.norm(places[i](np.clip(t, 0, x[-1])) - moved, axis=1).min() - 0.3
        for i in range(12)
        if i != 4
    ]
    assert worst["separation"] == pytest.approx(min(apart), abs=2e-3)
    assert reason.split(", ")[0] == "separation"
    near = 1 + [i for i in range(12) if i != 4][int(np.argmin(apart))]
    assert {"5", str(near)} & set(words.replace(";", "").replace(",", "").split())


def samples(t, x):
    """The last of samples at the same time."""
    later = np.append(np.diff(t) > 1e-9, True)
    return t[later], x[later]


def test_stale_files_are_flown(tmp_path):
    """An earlier version in which a vehicle crosses another's way is found; the same version is harmless."""
    show = day(tmp_path, 2)
    text = (tmp_path / "show-2.csv").read_text().splitlines()
    fields = [line.split(",") for line in text[1:]]
    pad = {i: next(f[2:4] for f in fields if f[1] == i) for i in ("1", "2")}
    moved = [
        [t, i, *(str(float(v) + (float(b) - float(a)) * (5 < float(t) < 19))
                 for v, a, b in zip(p[:2], pad["1"], pad["2"], strict=True)), p[2]] if i == "1" else [t, i, *p]
        for t, i, *p in fields
    ]  # fmt: skip
    stale = tmp_path / "stale.csv"
    stale.write_text("\n".join([text[0], *(",".join(f) for f in moved)]) + "\n")
    drilled = Show(show.mission, Drill(files=(show.file,), stale=(show.file, str(stale))))
    stream, first = np.random.default_rng(0), np.array([0])
    assert drilled.measure_fault(GeometricFault("stale", 1.0, first, stream))[1] == ""
    assert "separation" in drilled.measure_fault(GeometricFault("stale", 2.0, first, stream))[1]
    assert drilled.measure_fault(GeometricFault("stale", 2.0, np.array([5]), stream))[1] == ""


def test_the_command_tells_notes_on_files_of_a_sweep_file_once(tmp_path, capsys, monkeypatch):
    """What a file leaves open is told of files and earlier versions, with their names; missions have no notes."""
    monkeypatch.chdir(tmp_path)
    rows = [f"{t},{who},{x},0,{t + 1}" for who, x in (("a", 0), ("b", 5)) for t in range(3)]
    for name in ("now.csv", "before.csv"):
        Path(name).write_text("\n".join(["time,agent,x,y,z", *rows]) + "\n")
    drill = 'mission = "two-agents"\nruns = 3\n[drill]\n'
    Path("drill.toml").write_text(
        drill + 'files = ["now.csv"]\nstale = ["before.csv", "two-agents"]\n'
    )
    read, reader = [], files.read_trajectories
    monkeypatch.setattr(
        files, "read_trajectories", lambda x, **how: read.append(x) or reader(x, **how)
    )
    assert main(["sweep", "drill.toml", "--no-figures", "--quiet"]) == 0
    assert read == [(str(tmp_path / "now.csv"),), (str(tmp_path / "before.csv"),)]
    err = capsys.readouterr().err
    for name in ("now.csv", "before.csv"):
        words = f"warning: {tmp_path / name}: no unit is said: times as s, places as m."
        assert err.count(words) == 1
    assert err.count("warning: ") == 2
    assert main(["sweep", "sweeps/drill", "--no-figures", "--quiet"]) == 0
    assert not capsys.readouterr().err


def test_vehicles_of_files_keep_their_names(tmp_path):
    """An earlier version in another order of its vehicles is the same, and the worst two are named."""
    show, every = day(tmp_path, 2), np.arange(3)
    head, *rows = (tmp_path / "show-2.csv").read_text().splitlines()
    rows = [
        f"{t},drone {100 - int(who)},{rest}" for t, who, rest in (row.split(",", 2) for row in rows)
    ]
    files = tmp_path / "named.csv", tmp_path / "again.csv"
    for file, order in zip(files, (1, -1), strict=True):  # by time, each row of a time in an order
        rows.sort(
            key=lambda row, order=order: (
                float(row.split(",")[0]),
                order * int(row.split()[1].split(",")[0]),
            )
        )
        file.write_text("\n".join([head, *rows]) + "\n")
    drilled = Show(show.mission, Drill(files=(str(files[0]),), stale=(str(files[1]),)))
    stream = np.random.default_rng(0)
    assert drilled.measure_fault(GeometricFault("stale", 1.0, every, stream))[1] == ""
    failed = drilled.measure_fault(
        GeometricFault("shifted", 1.3, every[:1], Known(np.array([0.0]), 1))
    )
    assert re.search(r"agents? 1 \(drone \d+\)", failed[2])
    text = files[1].read_text()
    other = rows[0].split(",")[1]
    files[1].write_text(text.replace(f",{other},", ",drone 999,"))
    with pytest.raises(rf.RigidfleetError, match=r"has drone 999, and the show has not"):
        Show(show.mission, Drill(files=(str(files[0]),), stale=(str(files[1]),)))


@pytest.mark.parametrize("kind", ["folder", "skyc"])
def test_trajectories_of_others_are_drilled_by_the_command(kind, tmp_path, capsys, monkeypatch):
    """Folders of polynomials and shows are drilled by one command, which says of each fault what share fails."""
    monkeypatch.chdir(tmp_path)
    what = Path(__file__).parent / "data" / "sequence_trajectories"
    if kind == "skyc":
        rf.simulate("change-of-picture").save("flight.nc")
        assert main(["export", "flight.nc", "--format", "skyc", "--out", "show.skyc"]) == 0
        what = Path("show.skyc")
    assert (
        main(
            [
                "sweep",
                str(what),
                "--drill",
                "--separation",
                "0.1",
                "--runs",
                "34",
                "--json",
                "--no-figures",
            ]
        )
        == 0
    )
    out = json.loads(capsys.readouterr().out.partition("{")[2].join(["{", ""]))
    assert {case["fault"] for case in out["drill"]} == {
        "late",
        "another",
        "bias",
        "rotated",
        "shifted",
        "mirrored",
    }
    assert sum(case["failed"]["of"] for case in out["drill"]) == out["flown"] == 34


@pytest.mark.parametrize(
    "name", ["show-2.csv", "folder", "copter.tlog", "plane.bin", "odometry.mcap", "transforms.db3"]
)
def test_what_assess_reads_is_drilled_or_refused_with_the_reason(
    name, tmp_path, log, capsys, monkeypatch
):
    """What `assess` passes is drilled, what it does not read or pass is refused for the same reason; .nc: mission."""
    monkeypatch.chdir(tmp_path)
    day(tmp_path, 2)
    if name == "folder":
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.csv").write_text("time,x,y,z\n0,0,0,1\n1,0,0,2\n2,1,0,2\n")
        (tmp_path / name / "b.csv").write_text("time,x,y,z\n0,3,0,1\n1,3,0,2\n2,4,0,2\n")
    elif not Path(name).exists():
        log(name)
    passed = main(["assess", name, "--separation", "0.5"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    drill = [
        "sweep",
        name,
        "--drill",
        "--separation",
        "0.5",
        "--runs",
        "3",
        "--quiet",
        "--no-figures",
    ]
    code, error = main(drill), " ".join(capsys.readouterr().err.split())
    assert code == (0 if passed else 2), error
    if not passed:
        assert error.partition("any fault: ")[2].partition(". Mend")[0] in said


def test_a_drill_reads_files_as_assess_does(tmp_path, capsys, monkeypatch):
    """Units, axes, gaps and the curve between samples that `assess` is told: the drill is that of the plain table."""
    monkeypatch.chdir(tmp_path)
    t = np.concatenate([np.arange(0.0, 1.05, 0.1), np.arange(4.0, 5.05, 0.1)])
    places = {"a": (t, 0 * t, 2 + t), "b": (2 + t, 0.3 * t, 2 + t), "c": (4 + t, 0 * t, 2 - t)}
    plain, turned = ["time,agent,x,y,z"], ["time,agent,x,y,z"]
    for name, (x, y, z) in places.items():
        for row in np.column_stack([t, x, y, z]).tolist():
            plain.append(f"{row[0]},{name},{row[1]},{row[2]},{row[3]}")
            turned.append(f"{1e3 * row[0]},{name},{1e3 * row[2]},{1e3 * row[1]},{-1e3 * row[3]}")
    Path("plain.csv").write_text("\n".join(plain) + "\n")
    Path("turned.csv").write_text("\n".join(turned) + "\n")
    gaps, units = ("--gaps", "bridge", "--interpolation", "linear"), ("--units", "ms,mm")

    def drill(*more):
        line = ["sweep", *more, "--drill", "--separation", "1.9", "--runs", "24", "--no-figures"]
        return main([*line, "--json"]), capsys.readouterr()

    code, outcome = drill("plain.csv")
    assert code == 2
    assert "the gap: `--gaps bridge`" in outcome.err
    code, outcome = drill("plain.csv", *gaps)
    assert code == 0, outcome.err
    assert "warning: plain.csv: no unit is said: times as s, places as m." in outcome.err
    assert "warning: plain.csv: 'a' has no sample between 1 and 4 s" in outcome.err
    expected = json.loads(outcome.out)
    code, outcome = drill("turned.csv", *gaps, *units, "--axes", "ned")
    assert code == 0, outcome.err
    again = json.loads(outcome.out)
    assert expected["flown"] == again["flown"] == 24
    for one, other in zip(expected["drill"], again["drill"], strict=True):
        assert one["failed"] == other["failed"]
        assert one["worst"] == pytest.approx(other["worst"], abs=1e-6)
    assert any(case["failed"]["count"] for case in again["drill"])
    assert drill("sweeps/turned-drill", *units)[0] == 2  # as it was defined
    assert main(["sweep", "market-square", "--drill", *units]) == 2


def test_a_result_is_not_drilled(tmp_path, capsys, monkeypatch):
    """The result of a flight is refused: its mission is what can be drilled; so is a folder with nothing in it."""
    monkeypatch.chdir(tmp_path)
    Path("flight.nc").write_bytes(b"\x89HDF")
    Path("empty").mkdir()
    for what, words in (("flight.nc", "Drill its mission"), ("empty", "has no .csv")):
        assert main(["sweep", what, "--drill", "--separation", "1", "--quiet"]) == 2
        assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("stale", "words"),
    [("no.csv", "no such file"), ("two-agents", "has 2 agents, and the show 12")],
)
def test_an_earlier_version_that_is_none_is_refused(stale, words, tmp_path, capsys, monkeypatch):
    """An earlier version that is not there, or is of another show, is one error before anything is judged."""
    monkeypatch.chdir(tmp_path)
    Path("drill.toml").write_text(f'mission = "change-of-picture"\n[drill]\nstale = ["{stale}"]\n')
    assert main(["sweep", "drill.toml", "--quiet"]) == 2
    err = " ".join(capsys.readouterr().err.split())
    assert words in err
    assert err.count("error: ") == 1
    assert "no run has" not in err


WRONG = {
    "nothing": ({"late": []}, "has no magnitude"),
    "unknown": ({"later": [1.0]}, "later"),
    "negative": ({"late": [-1.0]}, "late"),
    "flown": ({"files": ["x.csv"], "wind": [1.0]}, "needs a mission that is flown"),
    "zero": ({"shifted": [0.0]}, "drill.shifted.*must be > 0"),
    "no number": ({"rotated": ["north"]}, "drill.rotated.*must be a number"),
    "no trial": ({"trials": 0}, "drill.trials.*must be >= 1"),
    "all lost": ({"lost": [12]}, "drill.lost.*too much for 12 vehicles"),
    "its own file": ({"another": [1, 12]}, "drill.another.*too much for 12 vehicles"),
    "nothing to read": ({"units": "mm"}, "drill.units.*no effect without files"),
    "missions only": (
        {"axes": "ned", "stale": ["change-of-picture"]},
        "drill.axes.*no effect without files",
    ),
    "too many": ({"late": [1.0], "vehicles": [13]}, "drill.vehicles.*too much for 12 vehicles"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_drilled_is_refused(name):
    """A drill without magnitudes, of unknown faults, or with wind on others' files is refused before it is flown."""
    table, words = WRONG[name]
    with pytest.raises(rf.SweepError, match=words) as error:
        Sweep.of("change-of-picture", [], drill=table)
    assert len(error.value.findings) == 1
    with pytest.raises(rf.SweepError, match="no effect on a drill"):
        Sweep.of("change-of-picture", ["agents.mass = grid(1.0, 2.0)"], drill={})


def test_a_flight_that_fails_anyway_is_not_drilled(tmp_path, capsys, monkeypatch):
    """A mission that fails without any fault is refused with its failure; limits of others' files need such files."""
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", "establish-cube-as-printed", "--drill", "--quiet"]) == 2
    assert "fails without any fault" in capsys.readouterr().err
    assert main(["sweep", "change-of-picture", "--drill", "--separation", "1"]) == 2
    assert "--separation" in capsys.readouterr().err
    assert main(["sweep", "none.skyc", "--drill", "--separation", "1"]) == 2
    assert "none.skyc: no such file" in capsys.readouterr().err


@pytest.fixture(scope="module")
def market_square(tmp_path_factory):
    """The shares of the shipped drill that fail: by fault, magnitude and number of vehicles."""
    file = Path(__file__).parents[1] / "examples" / "market_square.toml"
    table = fly(Sweep.load(file), tmp_path_factory.mktemp("market"), workers=2)
    return {(x.fault, x.magnitude, x.vehicles): x for x in summarise(table).drill}


@pytest.mark.long
@pytest.mark.parametrize("fault", sorted(faults.FAULTS.keys() - {"links"}))
def test_the_shipped_drill_has_a_danger_of_each_kind(fault, market_square):
    """Of each fault but lost links, which lights have not, a magnitude is harmless in all trials, another is not."""
    own = [x for x in market_square.values() if x.fault == fault]
    failed = {
        size: sum(x.failed.count for x in own if x.magnitude == size)
        for size in {x.magnitude for x in own}
    }
    assert len(failed) == 2
    assert min(failed.values()) == 0
    assert max(failed.values()) > 0


@pytest.mark.long
def test_the_shipped_show_as_a_whole_fails_by_its_fences(market_square):
    """A whole show that is turned, shifted or mirrored fails by a fence or people, and keeps its separation."""
    whole = [x for x in market_square.values() if x.fault in faults.SETUP and x.vehicles == 10]
    assert len({round(x.separation, 6) for x in whole}) == 1
    words = [x.worst.detail for x in whole if x.worst]
    assert len(words) == 3
    assert all("fence 'outer'" in each or "'crowd'" in each for each in words)


@pytest.mark.long
def test_lost_links_are_a_danger_to_those_who_fly_by_their_neighbours():
    """In the shipped cube by neighbours, any one link is lost without harm, and six that are lost end the cube."""
    sweep = Sweep.of("cube-by-neighbours", [], drill={"links": [1, 6], "trials": 4}, seed=2)
    rows = fly_runs(sweep, range(sweep.runs))
    assert [row.passed for row in rows] == [True, False] * 4
    assert all(row.reason in ("shape", "shape, handedness") for row in rows[1::2])
