"""Ground is whatever is below: a ground, terrain or a roof, level or sloped, turned or not."""

from typing import Any

import numpy as np
import pytest
from sample_missions import three_quadrotors

import rigidfleet as rf
from rigidfleet._common.toml import to_toml
from rigidfleet.errors import MissionError
from rigidfleet.solids.distance import local_point, signed_distance

#: The same level ground at 1 m: everywhere, as terrain, as a roof, and as a roof that is turned.
LEVEL = {
    "ground": {"kind": "ground", "height": 1.0},
    "terrain": {"kind": "heights", "corner": [-40, -40], "spacing": 8.0, "heights": np.full((11, 11), 1.0).tolist()},
    "roof": {"kind": "box", "min": [-40, -40, -3], "max": [40, 40, 1]},
    "turned": {"kind": "box", "min": [-60, -60, -3], "max": [60, 60, 1], "yaw_deg": 30.0},
}  # fmt: skip
#: A slope, as a roof that is pitched about its middle, 4 m below the origin; and as terrain that is the same plane.
PITCH = 8.0
PITCHED = {"kind": "box", "min": [-60, -60, -9], "max": [60, 60, 1], "pitch_deg": PITCH}
HIGH = -4.0 + 5.0 / np.cos(np.deg2rad(PITCH))
X = np.arange(-40.0, 41.0, 8.0)
SLOPED = {"kind": "heights", "corner": [-40, -40], "spacing": 8.0,
          "heights": np.tile(HIGH - np.tan(np.deg2rad(PITCH)) * X[:, None], (1, 11)).tolist()}  # fmt: skip


def mission(*obstacles, **tables):
    """Three quadrotors, or points, that form a triangle above something."""
    hold = {"kind": "hold", "until": 5.0}
    data: dict[str, Any] = three_quadrotors(hold) | {"obstacles": list(obstacles)} | tables
    if data["vehicles"] is None:
        del data["vehicles"], data["tracking"]
        data["agents"] = {"mass": 1.0, "radius": 0.2, "position": data["agents"]["position"]}
    return rf.Mission.from_dict(data)


def distance(obstacle, x, y, z):
    """Signed distance [m] from an obstacle to points."""
    solid = mission(obstacle).obstacles[0].solid
    return signed_distance(*local_point(x, y, z, 0, solid), 0, solid)


@pytest.mark.parametrize(
    "obstacle",
    [
        *LEVEL.values(),
        PITCHED,
        SLOPED,
        {"kind": "box", "min": [-9, -7, 0], "max": [9, 7, 3], "roll_deg": 20, "pitch_deg": 35, "yaw_deg": 50},
        {"kind": "heights", "corner": [-9, -7], "spacing": 3.0, "heights": [[0, 1, 4], [2, 1, 0], [5, 3, 1]]},
    ],
    ids=lambda x: x["kind"],
)  # fmt: skip
def test_heights_are_those_of_surfaces(obstacle):
    """A height lies on the surface by the exact distance, with nothing above it; there is none beside a solid."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-12.0, 12.0, (2, 300))
    z = mission(obstacle).height_below(x, y)
    on = np.isfinite(z)
    assert on.any()
    np.testing.assert_allclose(distance(obstacle, x[on], y[on], z[on]), 0.0, atol=1e-9)
    for up in (0.01, 0.5, 3.0, 20.0):
        assert (distance(obstacle, x[on], y[on], z[on] + up) > 0.0).all()
    column = np.linspace(-30.0, 30.0, 601)
    for a, b in zip(x[~on], y[~on], strict=True):
        assert (distance(obstacle, np.full(601, a), np.full(601, b), column) > -1e-9).all()


def test_the_highest_below_counts():
    """Of several, the highest counts, and of a lintel only what is below; zones, and what moves or goes, never do."""
    box = {"kind": "box", "min": [0, 0, 2], "max": [2, 2, 3]}
    others = [
        box | {"zone": True, "max": [9, 9, 9]},
        box | {"velocity": [1, 0, 0], "max": [9, 9, 9]},
        box | {"vanishes": 2.0, "max": [9, 9, 9]},
        {"kind": "sphere", "centre": [0, 0, 0], "radius": 9.0},
    ]
    over = mission({"kind": "ground", "height": -1.0}, SLOPED, box, *others)
    assert over.height_below(1.0, 1.0) == 3.0
    assert over.height_below(1.0, 1.0, 1.5) == pytest.approx(HIGH - np.tan(np.deg2rad(PITCH)))
    np.testing.assert_array_equal(over.height_below([1.0, 90.0], 1.0), [3.0, -1.0])
    assert mission(*others).height_below(1.0, 1.0) == -np.inf
    assert over.height_below(np.zeros((4, 1)), np.zeros(3)).shape == (4, 3)


def flights(obstacles, **tables):
    """Flights of the same mission above each of several obstacles."""
    return [rf.simulate(mission(o, **tables)) for o in obstacles]


#: Low enough for the effect of the ground.
LOW = {"agents": {"vehicle": "drone", "position": [[1, 6, 1.4], [5, 4, 1.4], [4, 7, 1.4]]}}


@pytest.mark.parametrize(
    "obstacles", [[*LEVEL.values()], [SLOPED, PITCHED]], ids=["level", "sloped"]
)
@pytest.mark.parametrize(
    "tables",
    [
        {"disturbances": {"ground_effect": True}} | LOW,
        {"disturbances": {"lost": [{"agent": 2, "time": 1.0}]}},
        {"disturbances": {"lost": [{"agent": 2, "time": 1.0}], "wind": [2.0, 1.0, 0.0]}, "vehicles": None},
    ],
    ids=["ground effect", "lost", "lost point"],
)  # fmt: skip
def test_the_same_ground_gives_the_same_flight(obstacles, tables):
    """Ground effect and losses are to rounding the same over a ground, terrain and roofs of one height."""
    found = flights(obstacles, **tables)
    for other in found[1:]:
        np.testing.assert_allclose(other.position, found[0].position, atol=1e-7)
    without = rf.simulate(mission(**(tables | {"disturbances": dict(tables["disturbances"])})))
    assert np.abs(without.position - found[0].position).max() > 1e-4  # it does act
    if "lost" in tables["disturbances"]:
        x, _, z = found[0].position[-1, 1]
        radius = found[0].mission.fleet.radius[1]
        expected = HIGH - np.tan(np.deg2rad(PITCH)) * x if obstacles[0] is SLOPED else 1.0
        assert z == pytest.approx(expected + radius, abs=2e-3)
        assert any("hits the ground" in note for note in rf.assess(found[0]).notes)


@pytest.mark.parametrize("obstacle", LEVEL)
def test_take_off_and_landing(obstacle):
    """Vehicles take off from, and land on, whatever is below, and stand there."""
    agents = {"vehicle": "drone", "position": [[1, 6, 1.3], [5, 4, 1.3], [4, 7, 1.3]]}
    phases = [
        {"kind": "takeoff", "height": 3.0, "duration": 5.0},
        {"kind": "establish", "formation": "triangle", "blend": 4.0, "duration": 5.0},
        {"kind": "land", "duration": 6.0},
    ]
    result = rf.simulate(mission(LEVEL[obstacle], agents=agents, phases=phases))
    verdict = rf.assess(result)
    assert verdict.passed, verdict.summary
    assert result.position[100, :, 2].max() <= 4.05
    np.testing.assert_allclose(
        result.position[np.searchsorted(result.time, 5.0), :, 2], 4.0, atol=0.02
    )
    np.testing.assert_allclose(
        result.position[-1, :, 2], 1.0 + result.mission.fleet.radius, atol=0.06
    )
    assert np.isfinite(result.motors_off).all()


def test_take_off_and_landing_on_a_slope():
    """Terrain and a roof of one slope lead to the same flight, up to a level height and down to the slope."""
    x, y = np.array([1.0, 5.0, 4.0]), np.array([6.0, 4.0, 7.0])
    stands = mission(SLOPED).height_below(x, y) + 0.3
    agents = {"vehicle": "drone", "position": np.column_stack([x, y, stands]).tolist()}
    phases = [
        {"kind": "takeoff", "height": 3.0, "duration": 5.0},
        {"kind": "establish", "formation": "triangle", "blend": 4.0, "duration": 5.0},
        {"kind": "land", "stagger": 6.0, "by": "vehicles", "duration": 18.0},
    ]
    terrain, roof = flights([SLOPED, PITCHED], agents=agents, phases=phases)
    np.testing.assert_allclose(roof.position, terrain.position, atol=1e-7)
    end = terrain.position[-1]
    above = end[:, 2] - mission(SLOPED).height_below(*end[:, :2].T) - terrain.mission.fleet.radius
    np.testing.assert_allclose(above, 0.0, atol=0.06)


@pytest.mark.parametrize(
    "change", [{"zone": True}, {"velocity": [1.0, 0.0, 0.0]}, {"vanishes": 9.0}]
)
def test_what_is_no_ground_is_none_to_land_on(change):
    """A zone, and a box that moves or goes, are refused before the flight, as no ground is."""
    phases = [
        {"kind": "establish", "formation": "triangle", "blend": 2.5, "until": 3.0},
        {"kind": "land", "duration": 6.0},
    ]
    with pytest.raises(MissionError, match="needs a ground, and the mission has none"):
        mission(LEVEL["roof"] | change, phases=phases)


def test_nothing_below_is_refused():
    """A landing beside the terrain is an error that names the vehicle and the place."""
    phases = [
        {"kind": "establish", "formation": "triangle", "blend": 2.5, "until": 3.0},
        {"kind": "fly", "position": [90.0, 0.0, 3.0], "until": 40.0},
        {"kind": "land", "duration": 6.0},
    ]
    with pytest.raises(MissionError, match=r"none is below agent 1 at \(\d+\.\d, "):
        rf.simulate(mission(LEVEL["terrain"], phases=phases))


@pytest.mark.parametrize(
    "mark", [np.nan, -9999.0, -32768.0, -99999.0, -3.4028234663852886e38, 65535.0, -999.0]
)
@pytest.mark.parametrize("form", ["inline", "map.npy", "map.csv"])
def test_cells_without_data_are_refused(mark, form, tmp_path):
    """A mark of missing data in a height map is no pit: the first such cell is named by row and column."""
    z = np.full((4, 5), 12.5)
    z[2, 3] = mark
    heights = {"kind": "heights", "spacing": 2.0}
    file = tmp_path / "m.toml"
    if form == "inline":
        heights["heights"] = z.tolist()
    else:
        heights["file"] = form
        np.save(tmp_path / form, z) if form.endswith("npy") else np.savetxt(
            tmp_path / form, z, delimiter=","
        )
    file.write_text(to_toml(mission().to_dict() | {"obstacles": [heights]}))
    with pytest.raises(MissionError) as error:
        rf.load_mission(file)
    assert "row 3, column 4" in str(error.value) or "[3][4]" in str(error.value)
