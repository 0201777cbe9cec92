"""Drills: faults of the day are found where they are, and nowhere else."""

import itertools
from typing import NamedTuple

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import rigidfleet as rf
from rigidfleet.sweep.faults import Drill, Show

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
            _, reason, words = drilled.outcome(fault, size, who, Known(angles, sign))
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
