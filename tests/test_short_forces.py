"""A user's force that begins when all is at rest, and references that move after a rest: no step misses them."""

import math
from functools import cache

import numba
import numpy as np
import pytest
from numba import types
from scipy.integrate import solve_ivp

import rigidfleet as rf

STRENGTH = 0.4  # [N] on 1 kg
SHAPES = {
    "1 - cos": lambda x: 0.5 - 0.5 * math.cos(2.0 * math.pi * x),
    "rectangle": lambda x: 1.0,
    "half sine": lambda x: math.sin(math.pi * x),
    "triangle": lambda x: 1.0 - abs(2.0 * x - 1.0),
    "bell": lambda x: math.exp(-18.0 * (x - 0.5) ** 2),
}
K1, K2 = 2.0, math.sqrt(8.0)  # [1/s^2], [1/s] gains of slots, as docs/theory.md gives them
CUBE = [[x, y, z] for x in (0.0, 4.0) for y in (0.0, 4.0) for z in (10.0, 14.0)]
PAIR = [[0.0, 0.0, 10.0], [4.0, 0.0, 10.0]]


def mission(*phases, position=PAIR, **keys):
    """Agents of 1 kg; samples every 0.05 s meet the top of a swing to 0.1 %."""
    data = {"schema_version": 1, "name": "pushed", "agents": {"mass": 1.0, "position": position}}
    return rf.Mission.from_dict(data | {"phases": list(phases)} | keys)


def hold(duration):
    return {"kind": "hold", "duration": duration}


def pulse(begin, width, shape="1 - cos", who=0):
    """A force along x that lasts ``width`` [s]."""

    def force(t, r, v):
        f = np.zeros_like(v)
        if begin < t < begin + width:
            f[who, 0] = STRENGTH * SHAPES[shape]((t - begin) / width)
        return f

    return force


@cache
def swing(width, shape="1 - cos"):
    """Greatest displacement [m] of an agent that is led back by x'' = f - K1 x - K2 x', by SciPy."""
    wave, ends = SHAPES[shape], [0.0, 0.0]
    most = 0.0
    for a, b in ((0.0, width), (width, width + 10.0)):
        within = b == width
        found = solve_ivp(
            lambda t, y, on=within: [y[1], on * STRENGTH * wave(t / width) - K1 * y[0] - K2 * y[1]],
            (a, b), ends, rtol=1e-9, atol=1e-13, max_step=(b - a) / 50, dense_output=True,
        )  # fmt: skip
        ends = found.y[:, -1]
        most = max(most, np.abs(found.sol(np.linspace(a, b, 4001))[0]).max())
    return most


def moved(result, who=0):
    """Greatest displacement [m] of an agent along x."""
    x = result.position[:, who, 0]
    return float(np.abs(x - x[0]).max())


def begins(low, high, count=20):
    """Seeded times [s]."""
    return np.random.default_rng(7).uniform(low, high, count).tolist()


# -- points ----------------------------------------------------------------------------------------


def test_the_gust_of_the_report_is_felt():
    """0.4 N as 1 - cos from 33.3 s on, in a hover of 60 s: displacements by an integration of our own."""
    for width, right in (5.0, 0.1541), (0.5, 0.0258), (0.1, 0.0052):
        result = rf.simulate(mission(hold(60.0)), force=pulse(33.3, width))
        assert moved(result) == pytest.approx(right, abs=6e-5)


@pytest.mark.parametrize("width", [0.1, 2.0])
def test_a_force_of_two_steps_is_felt_in_a_hover(width):
    """By default steps are of 0.05 s: a force of 0.1 s or more is felt to 1 %, whenever it begins."""
    for begin in begins(1.0, 20.0):
        result = rf.simulate(mission(hold(25.0)), force=pulse(begin, width))
        assert moved(result) == pytest.approx(swing(width), rel=0.01)


@pytest.mark.long
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("width", [0.1, 0.11, 0.37, 1.0, 5.0, 20.0])
def test_a_force_of_any_shape_and_width_is_felt_in_a_hover(width, shape):
    """Also forces that jump."""
    for begin in begins(1.0, 36.0):
        result = rf.simulate(mission(hold(60.0)), force=pulse(begin, width, shape))
        assert moved(result) == pytest.approx(swing(width, shape), rel=0.01)


@pytest.mark.parametrize("share", np.linspace(0.0, 0.95, 5).tolist())
def test_a_shorter_force_needs_a_shorter_step(share):
    """One of 8 ms is felt with a step of 4 ms, wherever in a step it begins."""
    result = rf.simulate(
        mission(hold(4.0)), force=pulse(1.0 + 0.004 * share, 0.008, "triangle"), max_step=0.004
    )
    assert moved(result) == pytest.approx(swing(0.008, "triangle"), rel=0.01)


@pytest.mark.parametrize("edges", ["neighbours", []])
def test_a_force_is_felt_at_rest_after_a_formation_and_across_two_holds(edges):
    """All agents of a cube are pushed alike, at rest, before and across the switch of two holds."""
    phases = {"kind": "establish", "formation": "cube", "duration": 5.0}, hold(15.0), hold(25.0)
    form = {"cube": {"shape": "cube", "size": 4.0, "edges": edges}}
    flown = mission(*phases, position=CUBE, formations=form)
    for begin, width in (
        (9.3, 0.1),
        (14.1, 3.0),
        (19.97, 0.1),
        (18.2, 5.0),
        (25.0, 0.1),
        (21.7, 10.0),
    ):
        result = rf.simulate(flown, force=pulse(begin, width, who=slice(None)))
        x = result.position[:, :, 0]
        at_rest = x[result.time < begin][-1]
        assert np.abs(x[result.time >= begin] - at_rest).max() == pytest.approx(
            swing(width), rel=0.01
        )


@pytest.mark.parametrize(
    "begin", [417.3, *(pytest.param(t, marks=pytest.mark.long) for t in begins(9, 580))]
)
@pytest.mark.parametrize("width", [0.1, 5.0])
def test_a_force_is_felt_in_a_long_hover(begin, width):
    """Ten minutes, of which seconds count."""
    flown = mission(hold(600.0))
    assert moved(rf.simulate(flown, force=pulse(begin, width))) == pytest.approx(
        swing(width), rel=0.01
    )


@pytest.mark.parametrize("stop", [0.13, 0.7, 11.0])
def test_a_force_is_felt_step_by_step(stop):
    """`Flight.advance` stops anywhere; the force between two stops is felt."""
    for begin, width in (17.3, 0.1), (21.9, 3.0):
        flight = rf.Flight(mission(hold(30.0)), force=pulse(begin, width))
        while flight.begin():
            while flight.advance(stop):
                pass
        assert moved(flight.finish()) == pytest.approx(swing(width), rel=0.01)


def test_a_compiled_force_is_felt():
    """Numba's cfunc, beside the same force in Python."""
    pointer = types.CPointer(types.float64)

    @numba.cfunc(types.void(types.float64, pointer, pointer, pointer, types.intp))
    def force(t, r, v, f, n):
        if 33.3 < t < 33.4:
            f[0] = 0.2 * (1.0 - math.cos(2.0 * math.pi * (t - 33.3) / 0.1))

    assert moved(rf.simulate(mission(hold(60.0)), force=force)) == pytest.approx(
        swing(0.1), rel=0.01
    )


@pytest.mark.long
def test_a_large_formation_feels_a_force():
    """Its steps, with a solver of their own, are bounded, too."""
    slots = [[2.0 * x, 2.0 * y, 2.0 * z + 10] for x in range(5) for y in range(5) for z in range(5)]
    form = {"lattice": {"slots": slots, "edges": "neighbours"}}
    phases = {"kind": "establish", "formation": "lattice", "duration": 5.0}, hold(20.0)
    flown = mission(*phases, position=slots, formations=form, output_step=0.1)
    result = rf.simulate(flown, force=pulse(13.37, 0.1, who=slice(None)))
    assert result.statistics["solvers"]
    assert moved(result) == pytest.approx(swing(0.1), rel=0.01)


@pytest.mark.parametrize(
    "wrong", [0, 0.0, -1.0, math.nan, math.inf, "0.1", None, 1e9, 10**400, 1e-9, [0.1]]
)
def test_a_step_that_none_can_be_is_an_error(wrong):
    """Zero, negative, no number, longer than the mission: one error that says what may be."""
    with pytest.raises(
        ValueError, match=r"max_step must be from 0\.001 to 10 s, not .*: give half"
    ):
        rf.simulate(mission(hold(10.0)), force=pulse(3.0, 1.0), max_step=wrong)


def test_without_a_force_the_step_changes_no_bit():
    """A longest step is that of a force."""
    flown = rf.load_mission("establish-triangle")
    a, b = rf.simulate(flown), rf.simulate(flown, max_step=0.001)
    np.testing.assert_array_equal(a.position, b.position)
    assert a.statistics["steps"] == b.statistics["steps"]


# -- vehicles --------------------------------------------------------------------------------------


def quadrotors(duration, **autopilot):
    """Two quadrotors of 1 kg without drag."""
    still = {"rotor_drag": 0.0, "rotor_inflow": 0.0, "rotor_lift": 0.0}
    return mission(
        hold(duration), vehicles={"q": {"model": "paper", **still}}, autopilot=autopilot,
        agents={"vehicle": "q", "position": PAIR},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("width", "shape", "impulse"),
    [
        (0.1, "1 - cos", 0.5),
        (0.1, "half sine", 2 / math.pi),
        (0.1, "triangle", 0.5),
        (3.0, "1 - cos", 0.5),
    ],
)
@pytest.mark.parametrize("step", [0.001, 0.01])
def test_vehicles_under_commands_feel_a_force(width, shape, impulse, step):
    """Level under constant thrust, without drag: the impulse over the mass remains as velocity, to 1 %."""

    def level(seen):
        return rf.AttitudeCommand(9.81 * seen.masses, np.tile([1.0, 0, 0, 0], (2, 1)))

    flown = quadrotors(4.6, rate=100.0, formation_rate=10.0, step=step)
    for begin in begins(0.5, 1.5, 3):
        result = rf.simulate(flown, force=pulse(begin, width, shape), controller=level, rate=10.0)
        right = STRENGTH * impulse * width / flown.fleet.mass[0]
        assert result.velocity[-1, 0, 0] == pytest.approx(right, rel=0.01)
        assert abs(result.velocity[-1, 1, 0]) < 1e-9


def test_vehicles_feel_a_force_between_two_ticks_of_their_law():
    """A law of 4 Hz: a force of 0.1 s between two of its ticks has moved the vehicle at the next, as impulses do."""
    flown = quadrotors(4.0, rate=100.0, formation_rate=4.0)
    result = rf.simulate(flown, force=pulse(2.03, 0.1), times=[2.0, 2.24])
    assert result.velocity[-1, 0, 0] == pytest.approx(0.5 * STRENGTH * 0.1, rel=0.01)


# -- references ------------------------------------------------------------------------------------


def table(begin, width, height, total, speed=0.0, z=10.0):
    """Crazyswarm2's table: steady along x, with a bump of 64 h s^3 (1 - s)^3 on top, and steady again."""
    bump = 64.0 * height * np.array([0, 0, 0, 1, -3, 3, -1, 0]) / width ** np.arange(8.0)
    rows = ["duration," + ",".join(f"{a}^{k}" for a in ("x", "y", "z", "yaw") for k in range(8))]
    at = 0.0
    for duration, aside in (begin, 0 * bump), (width, bump), (total - begin - width, 0 * bump):
        x = aside + [speed * at, speed, *[0.0] * 6]
        rows.append(",".join(map(repr, [duration, *x.tolist(), *[0.0] * 8, z, *[0.0] * 15])))
        at += duration
    return "\n".join(rows) + "\n"


def follow(folder, position, speed, **ways):
    """A mission that follows tables by name."""
    (folder / "ways").mkdir()
    for name, text in ways.items():
        (folder / "ways" / f"{name}.csv").write_text(text)
    path = folder / "m.toml"
    path.write_text(f"""schema_version = 1
name = "followed"
output_step = 0.02
[agents]
mass = 1.0
position = {position}
velocity = {[[speed, 0.0, 0.0], [0.0, 0.0, 0.0]][: len(position)]}
[[phases]]
kind = "follow"
file = "{"ways" if len(ways) > 1 else "ways/a.csv"}"
""")
    return rf.simulate(path)


@pytest.mark.parametrize("width", [0.5, 3.0, pytest.param(10.0, marks=pytest.mark.long)])
@pytest.mark.parametrize("begin", begins(20.0, 90.0, 2))
@pytest.mark.parametrize("speed", [0.0, 0.3])
def test_a_reference_that_leaves_its_way_for_a_while_is_followed(tmp_path, begin, width, speed):
    """A file that rests, or flies straight on, moves aside and back, and goes on as before: its height is met."""
    way = table(begin, width, 0.1 * width, 120.0, speed)
    result = follow(tmp_path, [[0, 0, 10]], speed, a=way)
    aside = result.position[:, 0, 0] - speed * result.time
    assert np.abs(aside).max() == pytest.approx(0.1 * width, rel=0.01)


def test_each_vehicle_that_leaves_its_rest_is_followed(tmp_path):
    """One vehicle flies straight on all the time; the other rests, moves for 0.3 s, and rests."""
    ways = {"a": table(60.0, 1.0, 0.0, 120.0, 0.2), "b": table(33.09, 0.3, 0.03, 120.0, z=14.0)}
    result = follow(tmp_path, [[0, 0, 10], [0, 0, 14]], 0.2, **ways)
    assert moved(result, 1) == pytest.approx(0.03, rel=0.01)
    assert moved(result) == pytest.approx(24.0, rel=1e-6)
