"""Who takes which slot, and in which attitude a formation is established: as planned and as flown."""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np
import pytest
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from rigidfleet.assessment import assess
from rigidfleet.errors import MissionError
from rigidfleet.formation import assignment, shapes
from rigidfleet.mission import Mission, mission_text
from rigidfleet.planning.preview import preview_phases
from rigidfleet.preflight.check import check
from rigidfleet.simulation.flight import simulate

#: What the flown may be nearer than the planned [m]: tracking is exact but for the integrator's error, 1e-8 of
#: some ten meters.
TRACKING = 1e-6


def fly(formations: dict[str, Any], position: Any, phases: list[Any], **more: Any) -> Mission:
    """A mission of formations by their slots, or as tables, held by tracking alone."""
    agents = {"mass": 1.0, "position": position, "radius": 0.1} | more.pop("agents", {})
    tables = {
        name: form if isinstance(form, dict) else {"slots": form, "edges": []}
        for name, form in formations.items()
    }
    data = {"schema_version": 1, "name": "route", "agents": agents, "formations": tables}
    return Mission.from_dict(data | {"phases": phases} | more)


def establish(formation: str, **more: Any) -> dict[str, Any]:
    return {"kind": "establish", "formation": formation, "duration": 5.0} | more


def reshape(formation: str, **more: Any) -> dict[str, Any]:
    return {"kind": "reshape", "formation": formation, "duration": 5.0} | more


def about_centre(points: Any) -> np.ndarray:
    p = np.asarray(points, dtype=float)
    return p - p.mean(axis=0)


def world(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """Body to world (3, 3), of 3-2-1 Euler angles [deg], by SciPy."""
    return Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()


# -- who takes which slot ----------------------------------------------------------------------------


def scattered(rng: np.random.Generator, n: int) -> np.ndarray:
    """Points (n, 3) in a plane or in space, at random in order, place and attitude, some 1.6 m apart or more."""
    flat = rng.random() < 0.5
    side = int(np.ceil((2 * n) ** (1 / 2 if flat else 1 / 3)))
    cells = np.stack(np.meshgrid(*[np.arange(side)] * (2 if flat else 3)), -1)
    cells = cells.reshape(-1, cells.shape[-1])
    cells = np.pad(cells, ((0, 0), (0, 3 - cells.shape[1])))
    points = 2.0 * cells[rng.permutation(len(cells))[:n]] + rng.uniform(-0.2, 0.2, (n, 3))
    return points @ Rotation.random(random_state=rng).as_matrix()


def random_reshape(seed: int) -> Mission:
    """Two changes of 4 to 60 vehicles of unequal masses, slots assigned at each."""
    rng = np.random.default_rng((12, seed))
    n = int(rng.integers(4, 61))
    first, second, start = (scattered(rng, n) for _ in range(3))
    phases = [establish("one"), reshape("two")]
    masses = rng.uniform(0.5, 3.0, n).tolist() if rng.random() < 0.5 else 1.0
    agents = {"mass": masses, "radius": 0.0}
    return fly(
        {"one": first, "two": second}, start, phases, agents=agents, assignment="each",
        output_step=0.02,
    )  # fmt: skip


def least_and_promised(
    mission: Mission, planned_phases: list[np.ndarray]
) -> list[tuple[float, float]]:
    """For each change the least distance of all pairs at its samples, and D / sqrt(2)."""
    spacing = [pdist(np.array(mission.agents.position)).min()]
    spacing += [pdist(np.array(form.slots)).min() for form in mission.formations.values()]
    return [
        (min(pdist(p).min() for p in planned), min(spacing[k : k + 2]) / np.sqrt(2))
        for k, planned in enumerate(planned_phases)
    ]


def planned_paths(seed: int) -> list[tuple[float, float]]:
    mission = random_reshape(seed)
    return least_and_promised(mission, [planned.position for planned in preview_phases(mission)[0]])


def flown_paths(seed: int) -> list[tuple[float, float]]:
    mission = random_reshape(seed)
    result = simulate(mission)
    return least_and_promised(mission, [result.position[result.samples(k)] for k in range(2)])


@pytest.mark.parametrize("part", range(4))
def test_assigned_ways_keep_their_room_as_planned(part):
    """No two vehicles come nearer than D / sqrt(2) on any planned change, D the least distance of both shapes."""
    for seed in range(10 * part, 10 * part + 10):
        for least, promised in planned_paths(seed):
            assert least >= promised * (1 - 1e-12), seed


@pytest.mark.parametrize("seed", range(4))
def test_assigned_ways_keep_their_room_as_flown(seed):
    """Nor on any that is flown, to a micrometre."""
    for least, promised in flown_paths(seed):
        assert least >= promised - TRACKING


@pytest.mark.long
@pytest.mark.parametrize("part", range(10))
@pytest.mark.parametrize("paths", [planned_paths, flown_paths])
def test_assigned_paths_keep_their_separation_three_hundred_times(paths, part):
    """Both over 300 missions of two changes each."""
    for seed in range(30 * part, 30 * part + 30):
        for least, promised in paths(seed):
            assert least >= promised - TRACKING, seed


@pytest.mark.parametrize("assignment", ["shortest", "safe"])
@pytest.mark.parametrize("attitude", ["drawn", "free"])
def test_the_first_establishment_keeps_its_room(assignment, attitude):
    """So does the way to the first formation by the other two assignments, whatever its attitude is to be."""
    for seed in range(15):
        data = random_reshape(seed).to_dict() | {"assignment": assignment}
        data["phases"] = [establish("one", attitude=attitude)]
        if seed % 2 and attitude == "drawn":
            data |= {"body_frame": {"yaw_deg": 40.0, "pitch_deg": 25.0}}
            data["phases"][0]["roll_deg"] = 70.0 * seed
        del data["formations"]["two"]
        mission = Mission.from_dict(data)
        planned_phases = [planned.position for planned in preview_phases(mission)[0]]
        ((least, promised),) = least_and_promised(mission, planned_phases)
        assert least >= promised * (1 - 1e-12), seed


def test_ways_are_straight_and_shortest_where_the_attitude_is_known():
    """In an attitude that is told, agents go straight to slots of the least squares of all 720 orders, in the world."""
    rng = np.random.default_rng(4)
    slots, start = scattered(rng, 6), scattered(rng, 6)
    turned = world(20.0, -35.0, 110.0)
    phases = [establish("a", roll_deg=20.0, pitch_deg=-35.0, yaw_deg=110.0)]
    for rule in ("shortest", "each"):
        mission = fly({"a": slots}, start, phases, assignment=rule)
        position = preview_phases(mission)[0][0].position
        paths = position[-1] - position[0]
        there = about_centre(slots) @ turned.T
        least = min(
            np.sum((there[list(order)] - about_centre(start)) ** 2)
            for order in permutations(range(6))
        )
        assert np.sum(paths**2) == pytest.approx(least, rel=1e-9)
        share = np.einsum("kia,ia->ki", position - position[0], paths) / np.sum(paths**2, axis=1)
        np.testing.assert_allclose(position, position[0] + share[..., None] * paths, atol=1e-9)


def test_slots_are_assigned_for_the_masses_that_are_flown():
    """Squares of paths count agents alike: of two equal ones to exchange, a heavy one proves nothing.

    With squares weighted by mass the heavy agent would be sent across the light one's way.
    """
    start = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
    slots = np.array([[0.0, 0, 0], [0, 1, 0], [5, 1, 0]])
    for masses in ([1.0, 1, 1], [100.0, 1, 1], [1.0, 100, 1]):
        mission = fly(
            {"a": slots}, start, [establish("a")], assignment="each", agents={"mass": masses}
        )
        path_ends = preview_phases(mission)[0][0].path_ends
        assert path_ends is not None
        x, y = (np.asarray(p)[:, None] - np.asarray(p) for p in path_ends)
        assert (np.sum(x * y, axis=2) >= -1e-12).all()


def test_the_way_back_keeps_its_room():
    """From a formation back to the one before, the slots are those that were found on the way there."""
    rng = np.random.default_rng(9)
    a, b = scattered(rng, 20), scattered(rng, 20)
    phases = [establish("a"), reshape("b"), reshape("a", name="again")]
    mission = fly({"a": a, "b": b}, a, phases, assignment="each", agents={"radius": 0.0})
    planned_phases = preview_phases(mission)[0]
    promised = min(pdist(a).min(), pdist(b).min()) / np.sqrt(2)
    assert (
        min(pdist(p).min() for planned in planned_phases[1:] for p in planned.position) >= promised
    )


WALL = [[2.0 * (k % 5), 0.0, 2.0 * (k // 5)] for k in range(25)]
GRID = [[2.0 * (k % 5), 2.0 * (k // 5), 20.0] for k in range(25)]


@pytest.mark.parametrize("assignment", ["given", "shortest", "safe", "each"])
def test_a_grid_becomes_a_standing_wall(assignment):
    """A grid of 25 turns into a wall of 25 that stands, and nobody passes through anybody, by any assignment."""
    phases = [establish("grid"), reshape("wall"), {"kind": "hold", "duration": 1.0}]
    mission = fly({"grid": GRID, "wall": WALL}, GRID, phases, assignment=assignment)
    assert check(mission).passed
    result = simulate(mission)
    verdict = assess(result)
    assert verdict.passed, verdict.summary
    assert min(pdist(p).min() for p in result.position) >= 2.0 / np.sqrt(2) - TRACKING
    extent = np.ptp(result.position[-1], axis=0)
    np.testing.assert_allclose(extent, [8.0, 0.0, 8.0], atol=1e-5)


def test_a_safe_assignment_is_bounded(monkeypatch):
    """A thousand vehicles take four assignments at most to find the safest, of half a second each."""
    asked = []

    def count(p, q):
        asked.append(len(p))
        assert len(asked) <= 4, "a fifth assignment"
        return np.arange(len(p))

    monkeypatch.setattr(assignment, "least_squares_assignment", count)
    text = mission_text("show-1000").replace('"each"', '"safe"')
    mission = Mission.from_toml(text)
    assert len(mission.assigned_slots["helix"]) == 1000
    assert asked


@pytest.mark.parametrize("turn", [None, np.eye(3)], ids=["free", "told"])
def test_the_safest_has_as_much_room_as_the_shortest(turn):
    """Of random shapes, the assignment "safe" never has a smaller separation than "shortest", to the last digit."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        start, slots, radius = scattered(rng, 12), scattered(rng, 12), rng.uniform(0.0, 0.5, 12)
        separations = []
        for way in (None, radius):
            order, turned = assignment.assign_slots(start, slots, turn=turn, radius=way)
            x, y = about_centre(start), about_centre(slots)[order] @ turned.T
            s = np.linspace(0.0, 1.0, 2001)[:, None, None]
            between = [pdist(p) for p in (1 - s) * x + s * y]
            i, j = np.triu_indices(12, 1)
            separations.append((np.array(between) - radius[i] - radius[j]).min())
        assert separations[1] >= separations[0] - 1e-5  # of samples


def test_closest_approach():
    """The least separation on straight paths is that of ten thousand samples, with its pair and its moment."""
    rng = np.random.default_rng(8)
    for n in (2, 3, 40):
        p, q, radius = rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), rng.uniform(0, 0.2, n)
        separation, (i, j), share = assignment.closest_approach(p, q, radius)
        s = np.linspace(0.0, 1.0, 10_001)[:, None, None]
        x = (1 - s) * p + s * q
        k, m = np.triu_indices(n, 1)
        all_separations = np.linalg.norm(x[:, k] - x[:, m], axis=2) - radius[k] - radius[m]
        assert separation == pytest.approx(all_separations.min(), abs=1e-6)
        at = (1 - share) * (p[i] - p[j]) + share * (q[i] - q[j])
        assert np.linalg.norm(at) - radius[i] - radius[j] == pytest.approx(separation, abs=1e-12)
    assert assignment.closest_approach(p[:1], q[:1])[0] == np.inf


# -- what check says of paths that cross --------------------------------------------------------------

FIVE = [[0.0, 0, 0], [4, 0, 0], [8, 0, 0], [0, 4, 0], [4, 4, 0]]
SWAPPED = [FIVE[k] for k in (0, 2, 1, 3, 4)]
ALOFT = (np.array(FIVE) + [0, 0, 9]).tolist()


def collisions(mission: Mission) -> list[str]:
    return [r.text for r in check(mission).remarks if r.topic == "collision"]


def test_ways_that_cross_are_found():
    """Two that exchange their slots meet halfway: the change, both, when, how near and the cure are named."""
    phases = [establish("a"), reshape("b", name="swap", blend=4.0)]
    mission = fly({"a": FIVE, "b": SWAPPED}, ALOFT, phases)
    (text,) = collisions(mission)
    assert text.startswith("agents 2 and 3 collide at 7.00 s in 'swap'")
    assert "their paths from 'a' to 'b' cross with 0.0" in text
    assert 'assignment = "each"' in text
    assert not check(mission).passed
    cured = Mission.from_dict(mission.to_dict() | {"assignment": "each"})
    assert not collisions(cured)


def test_each_change_that_crosses_is_found():
    """Not the worst of them alone."""
    phases = [establish("a"), reshape("b", name="there"), reshape("a", name="back")]
    texts = collisions(fly({"a": FIVE, "b": SWAPPED}, ALOFT, phases))
    assert ["'there'" in text for text in texts] == [True, False]
    assert ["'back'" in text for text in texts] == [False, True]


def test_ways_nearer_than_the_limit_are_found():
    """Ways that leave less than limits.separation are, too, with what the slots would need."""
    square, turned = (
        scattered(np.random.default_rng(1), 30),
        scattered(np.random.default_rng(2), 30),
    )
    phases = [establish("a"), reshape("b")]
    start = square + [0, 0, 30]
    mission = fly(
        {"a": square, "b": turned}, start, phases, assignment="each", limits={"separation": 1.4}
    )
    texts = collisions(mission)
    path_ends = preview_phases(mission)[0][1].path_ends
    assert path_ends is not None
    s = np.linspace(0, 1, 2001)[:, None, None]
    separation = min(pdist(p).min() for p in (1 - s) * path_ends[0] + s * path_ends[1]) - 0.2
    (crossing,) = [text for text in texts if "cross" in text]
    assert f"have a separation of {separation:.2f} m" in crossing
    assert "limit 1.4 m" in crossing
    assert f"Place slots at least {np.sqrt(2) * 1.6:.2f} m apart" in crossing


def test_a_formation_flown_again_from_elsewhere():
    """It has slots of its own there, assigned on this way, under a second name."""
    rng = np.random.default_rng(0)
    a, b, c = (scattered(rng, 14) for _ in range(3))
    phases = [establish("a"), reshape("b"), reshape("c"), reshape("a", name="again")]
    mission = fly(
        {"a": a, "b": b, "c": c}, a + [0, 0, 40], phases, assignment="each", agents={"radius": 0.4}
    )
    assert not any("'again'" in text for text in collisions(mission))
    assert mission.phases[3].leads_to == "a (2)"
    planned = preview_phases(mission)[0][3]
    assert min(pdist(p).min() for p in planned.position) >= min(
        pdist(a).min(), pdist(c).min()
    ) / np.sqrt(2)
    first, again = (np.array(mission.formation_slots(name)) for name in ("a", "a (2)"))
    assert {tuple(x) for x in first.tolist()} == {tuple(x) for x in again.tolist()}


def test_a_vehicle_that_would_end_underground():
    """The message names its height, its slot below the centre of mass, and the height that cures it."""
    ground = [{"kind": "ground", "height": 0.0}]
    slots = [[0.0, 0, 0], [4, 0, 0], [0, 4, -1.5]]
    start = (np.array(slots) + [0, 0, 8]).tolist()

    def land(z: float) -> Mission:
        down = {"kind": "fly", "name": "land", "position": [0.0, 0, z], "duration": 9.0}
        return fly({"a": slots}, start, [establish("a"), down], obstacles=ground)

    (text,) = [r.text for r in check(land(0.2)).remarks if r.topic == "obstacle"]
    # The third slot is 1 m below the centre of mass, its radius 0.1 m.
    assert text.startswith(
        "agent 3 hits 'ground' at 14.00 s in 'land': its centre is at z = -0.80 m"
    )
    assert "0.90 m too low" in text
    assert "1.00 m below the centre of mass at z = 0.20 m" in text
    assert "above z = 1.10 m" in text or "above z = 1.11 m" in text
    assert check(land(1.12)).passed


# -- the attitude in which a formation is established ------------------------------------------------

SPATIAL = [[0.0, 0, 0], [4, 0, 0], [0, 3, 0], [0, 0, 5], [3, 3, 1]]


def off(result: Any, slots: Any, turned: np.ndarray) -> float:
    """How far the last sample is from slots drawn in the world and turned, centre on centre [m]."""
    wanted = about_centre(slots) @ turned.T
    return float(np.linalg.norm(about_centre(result.position[-1]) - wanted, axis=1).max())


def start_for(slots: Any, seed: int = 1) -> list[Any]:
    """A start near slots that are turned by more than a right angle."""
    rng = np.random.default_rng(seed)
    turned = about_centre(slots) @ world(100.0, 20.0, -70.0).T
    return (turned + rng.normal(scale=0.3, size=np.shape(slots)) + [5, -3, 20]).tolist()


@pytest.mark.parametrize(
    ("keys", "before", "turned"),
    [
        ({}, [], world()),
        ({"yaw_deg": 90.0}, [], world(yaw=90)),
        ({"roll_deg": 30.0, "pitch_deg": -20.0}, [], world(30, -20)),
        ({"body_frame": {"yaw_deg": 35.0, "roll_deg": 180.0}}, [], world(180, 0, 35)),
        ({}, [{"kind": "turn", "yaw_deg": 50.0, "duration": 6.0}], world(yaw=50)),
        ({"yaw_deg": 0.0}, [{"kind": "turn", "yaw_deg": 50.0, "duration": 6.0}], world()),
        ({}, [establish("a", attitude="free")], world()),
        ({}, [{"kind": "hold", "control": "open", "duration": 2.0}], world()),
        ({}, [establish("a", control="open")], world()),
    ],
    ids=["drawn", "yaw", "roll", "body frame", "asked before", "asked anew", "freely before", "hold", "open"],
)  # fmt: skip
@pytest.mark.parametrize("formulation", ["inertial", "body"])
def test_a_formation_is_established_as_it_is_drawn(keys, before, turned, formulation):
    """Tracked slots end along the world's axes or the body frame's, or at the angles asked for last."""
    more = {"body_frame": keys["body_frame"]} if "body_frame" in keys else {}
    angles = {key: value for key, value in keys.items() if key != "body_frame"}
    phases = [*before, establish("a", name="take it", **angles), {"kind": "hold", "duration": 8.0}]
    forms = {"a": {"slots": SPATIAL} if any("control" in p for p in before) else SPATIAL}
    mission = fly(forms, start_for(SPATIAL), phases, formulation=formulation, **more)
    result = simulate(mission)
    assert off(result, SPATIAL, turned) < 1e-3
    (target,) = [p.target for p in result.phases if p.name == "take it"]
    x, y, z, w = Rotation.from_matrix(turned).as_quat()
    # World to body, scalar first; of either sign.
    asked = np.array([w, x, y, z])
    assert target is not None
    assert abs(abs(np.array(target["attitude"]) @ asked) - 1.0) < 1e-9
    found = {f.check: f for f in assess(result).checks}
    assert found["waypoint_attitude"].passed
    assert planned_end_is_flown(mission, result)


def planned_end_is_flown(mission: Mission, result: Any) -> bool:
    planned_phases, known = preview_phases(mission)
    end = about_centre(planned_phases[-1].position[-1])
    return known and bool(np.abs(end - about_centre(result.position[-1])).max() < 1e-3)


@pytest.mark.parametrize(("shape", "yaw"), [("line", None), ("v", 30.0), ("grid", -120.0)])
def test_named_shapes_are_drawn_with_their_yaw(shape, yaw):
    """A named shape counts as slots: its x axis is east, or where the yaw asked for has it."""
    slots = shapes.slots(shape, 3.0, 5)
    angles = {} if yaw is None else {"yaw_deg": yaw}
    form = {"shape": shape, "size": 3.0, "edges": []}
    phases = [establish("a", **angles), {"kind": "hold", "duration": 4.0}]
    result = simulate(fly({"a": form}, start_for(slots), phases))
    assert off(result, slots, world(yaw=yaw or 0.0)) < 1e-3


def test_a_free_attitude_is_the_nearest():
    """Asked for by name, it is that in which the formation lies nearest to the agents, weighted by mass."""
    masses = [1.0, 2.0, 0.5, 1.5, 3.0]
    start = start_for(SPATIAL)
    phases = [establish("a", attitude="free"), {"kind": "hold", "duration": 4.0}]
    result = simulate(fly({"a": SPATIAL}, start, phases, agents={"mass": masses}))
    m = np.array(masses)
    x, y = (p - m @ p / m.sum() for p in (np.array(start), np.array(SPATIAL)))
    fit, _ = Rotation.align_vectors(x, y, weights=m)
    assert off(result, SPATIAL, fit.as_matrix()) < 1e-3
    assert result.phases[0].target is None


@pytest.mark.parametrize("control", ["open", "tracking"])
def test_distances_alone_have_a_free_attitude(control):
    """Nothing turns agents that track no slots, or slots without axes: a turned tetrahedron stays as it is turned."""
    slots = shapes.slots("tetrahedron", 4.0, 4)
    turned = world(40.0, 10.0, 75.0)
    start = slots @ turned.T + [0, 0, 20]
    form = {"slots": slots.tolist()} if control == "open" else {"distances": [4.0] * 6}
    mission = fly({"a": form}, start, [establish("a", control=control, reference="distances")])
    result = simulate(mission)
    assert off(result, slots, turned) < 1e-6
    assert result.phases[0].target is None


def test_a_tracked_reshape_keeps_the_attitude():
    """From yaw 50 to yaw 50, whatever lies between the axes of both shapes."""
    other = (np.array(SPATIAL) @ world(0, 0, 160).T + np.eye(5, 3)).tolist()
    turn = {"kind": "turn", "yaw_deg": 50.0, "duration": 8.0}
    phases = [establish("a"), turn, reshape("b"), {"kind": "hold", "duration": 6.0}]
    for rule in ("given", "each"):
        mission = fly({"a": SPATIAL, "b": other}, start_for(SPATIAL), phases, assignment=rule)
        result = simulate(mission)
        slots = np.array(other)[mission.assigned_slots["b"]]
        assert off(result, slots, world(yaw=50)) < 1e-3


def test_a_grid_is_established_level():
    """A grid taken from a rough start is level to a millimetre, and a phase down to the ground ends on it."""
    rng = np.random.default_rng(5)
    grid = shapes.slots("grid", 3.0, 9)
    start = (grid + rng.normal(scale=0.4, size=grid.shape) + [0, 0, 10]).tolist()
    down = {"kind": "fly", "position": [0.0, 0, 0.15], "duration": 8.0}
    form = {"shape": "grid", "size": 3.0, "edges": []}
    ground = [{"kind": "ground"}]
    mission = fly({"a": form}, start, [establish("a"), down], obstacles=ground)
    assert check(mission).passed
    result = simulate(mission)
    assert assess(result).passed
    assert np.ptp(result.position[-1, :, 2]) < 1e-3


@pytest.mark.parametrize(
    ("keys", "key", "words"),
    [
        ({"formation": "d", "attitude": "drawn"}, "attitude", "which have no axes"),
        ({"attitude": "free", "yaw_deg": 10.0}, "yaw_deg", "no effect with attitude = 'free'"),
        ({"control": "open", "yaw_deg": 10.0}, "yaw_deg", "no effect with control 'open'"),
        ({"control": "open", "attitude": "drawn"}, "attitude", "no effect with control 'open'"),
        ({"attitude": "nearest"}, "attitude", "must be 'drawn' or 'free'"),
    ],
)
def test_attitudes_that_cannot_be(keys, key, words):
    """An attitude that would not be flown is refused, with its key and the reason."""
    forms = {"a": {"slots": SPATIAL}, "d": {"distances": pdist(np.array(SPATIAL)).tolist()}}
    phase = {"kind": "establish", "duration": 5.0, "formation": "a"} | keys
    with pytest.raises(MissionError) as caught:
        fly(forms, start_for(SPATIAL), [phase])
    (finding,) = caught.value.findings
    assert finding.key == f"phases[1].{key}"
    assert words in f"{finding.problem}"
