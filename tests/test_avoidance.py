"""Avoidance in flight: the guard's theorem, barriers against an exact solver, what missions may ask, what is told."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

import rigidfleet as rf

G = 9.81


def crowd(position, *, limit=14.0, radius=0.25, period=0.02, until=3.0, velocity=None, **tables):
    """Points that hold where they are, or are commanded by a controller, under [avoidance]."""
    n = len(position)
    data = {
        "schema_version": 1,
        "name": "crowd",
        "vehicles": {"point": {"model": "point", "mass": 1.0, "thrust_limit": limit}},
        "agents": {"vehicle": "point", "position": np.asarray(position).tolist(), "radius": radius},
        "autopilot": {"rate": 1.0 / period, "formation_rate": 1.0 / period, "step": 0.01},
        "formations": {"own": {"slots": np.asarray(position).tolist(), "edges": [[1, 2]]}},
        "phases": [
            {"kind": "establish", "formation": "own", "control": "tracking", "until": until, "blend": 0.5}
        ],
        "output_step": 0.1,
        "avoidance": {},
    } | tables  # fmt: skip
    if velocity is not None:
        data["agents"]["velocity"] = np.asarray(velocity).tolist()
    assert n > 1
    return rf.Mission.from_dict(data)


def scattered(rng, n, least, size):
    """Positions (n, 3) [m] at least some distance apart."""
    found = [rng.uniform(-size, size, 3)]
    while len(found) < n:
        x = rng.uniform(-size, size, 3)
        if min(np.linalg.norm(x - y) for y in found) > least:
            found.append(x)
    return np.array(found)


class Wild:
    """Forces at random: often the greatest ones, straight at a neighbour, or held for some time."""

    def __init__(self, rng, limit):
        self.rng, self.limit, self.force = rng, limit, None

    def __call__(self, seen):
        rng, n = self.rng, len(seen.position)
        if self.force is None or rng.random() < 0.2:
            way = rng.normal(size=(n, 3))
            other = rng.permutation(n)
            aim = rng.random(n) < 0.7
            way[aim] = (seen.position[other] - seen.position + 1e-9)[aim]
            size = self.limit * rng.choice([0.3, 1.0, 3.0], (n, 1))
            self.force = way / np.linalg.norm(way, axis=1, keepdims=True) * size
            self.force[:, 2] += rng.choice([0.0, G])
        return self.force


OBSTACLES = [
    {"kind": "box", "min": [-0.4, -5.0, -5.0], "max": [0.1, 5.0, -0.6]},
    {"kind": "box", "min": [0.8, 0.5, -5.0], "max": [3.0, 2.0, 5.0]},
    {"kind": "ground", "height": -2.5},
]


# -- the theorem --------------------------------------------------------------------------------------


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 2**31), n=st.integers(2, 14), period=st.sampled_from([0.01, 0.02, 0.1]),
    walls=st.booleans(), drag=st.sampled_from([0.0, 0.4]), barrier=st.booleans(),
)  # fmt: skip
def test_whatever_is_commanded_nobody_collides(seed, n, period, walls, drag, barrier):
    """Random forces, mostly beyond the thrust there is: in continuous time, nobody comes nearer than the separation.

    The oracle is the monitor of extremes, which knows nothing of the guard.
    """
    rng = np.random.default_rng(seed)
    position = scattered(rng, 3 * n, 0.8, 1.0 + 0.7 * n ** (1 / 3))
    if walls:
        free = [x for x in position if clearance(x) > 0.35]
        position = np.array(free)[:n]
        if len(position) < 2:
            return
    position = position[:n]
    limit = float(rng.uniform(11.0, 30.0))
    mission = crowd(
        position, limit=limit, period=period, until=4.0, obstacles=OBSTACLES if walls else [],
        vehicles={"point": {"model": "point", "mass": 1.0, "thrust_limit": limit, "drag": drag}},
        avoidance={"separation": 0.1, "clearance": 0.05, "barrier": barrier},
    )  # fmt: skip
    result = rf.simulate(mission, controller=Wild(rng, limit), rate=1.0 / period)
    assert result.complete, result.ending
    least = result.extreme("separation")
    assert least.value >= 0.1 - 1e-8
    if walls:
        assert result.extreme("clearance").value >= 0.05 - 1e-8
    check = {c.check: c for c in rf.assess(result).checks}["guarantee"]
    assert check.passed
    assert "proved" in check.message


def clearance(x):
    """Distance [m] of a point from the obstacles."""
    found = []
    for thing in OBSTACLES:
        low = np.array(thing.get("min", [-np.inf] * 3))
        high = np.array(thing.get("max", [np.inf, np.inf, thing.get("height", 0.0)]))
        found.append(np.linalg.norm(np.maximum(np.maximum(low - x, x - high), 0.0)))
    return min(found)


def test_without_the_guard_the_same_commands_collide():
    """The property above is no accident: the same forces without a guard bring vehicles into each other."""
    rng = np.random.default_rng(5)
    position = scattered(rng, 10, 0.8, 2.0)
    mission = crowd(position, limit=20.0, until=4.0, avoidance={"guard": False})
    result = rf.simulate(mission, controller=Wild(rng, 20.0), rate=50.0)
    x = result.extreme("separation")
    assert x is not None
    assert x.value < -0.1
    assert any("guarantees nothing" in note for note in rf.assess(result).notes)
