"""Shipped scenes: each passes, and fails without the key that it shows; every kind of phase and obstacle is shown."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

import rigidfleet as rf
from rigidfleet import plotting
from rigidfleet.mission import json_schema, mission_names
from rigidfleet.mission.text import FIRST, GROUPS

Data = dict[str, Any]


def without(kind: str) -> Callable[[Data], None]:
    """A change that leaves out the phases of a kind."""

    def change(data: Data) -> None:
        data["phases"] = [phase for phase in data["phases"] if phase["kind"] != kind]

    return change


def without_key(*path: Any) -> Callable[[Data], None]:
    """A change that leaves out a key, which then has its default."""

    def change(data: Data) -> None:
        table: Any = data
        for step in path[:-1]:
            table = table[step]
        del table[path[-1]]

    return change


def boxed(kind: str) -> Callable[[Data], None]:
    """A change that puts a box of the same extents in the place of each obstacle of a kind, of terrain its hills."""

    def change(data: Data) -> None:
        for k, thing in enumerate(data["obstacles"]):
            if thing["kind"] == kind:
                low, high = extents(thing)
                data["obstacles"][k] = {"kind": "box", "min": low.tolist(), "max": high.tolist()}
        if kind == "heights":
            data["obstacles"].append({"kind": "ground"})

    return change


def extents(thing: Data) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and the highest corner (3,) [m] of an upright cylinder, of a hull, of hills of 10 m and more."""
    if thing["kind"] == "cylinder":
        points, aside = np.array(thing["ends"]), [thing["radius"], thing["radius"], 0.0]
    elif thing["kind"] == "hull":
        points, aside = np.array(thing["points"]), [0.0, 0.0, 0.0]
    else:
        heights = np.array(thing["heights"])
        high = np.argwhere(heights >= 10.0)
        places = thing["corner"] + thing["spacing"] * high
        points, aside = np.column_stack([places, heights[tuple(high.T)]]), [0.0, 0.0, 0.0]
    return points.min(axis=0) - aside, points.max(axis=0) + aside


def held(data: Data) -> None:
    """Hold where the formation would brake."""
    for phase in data["phases"]:
        phase["kind"] = "hold" if phase["kind"] == "brake" else phase["kind"]


def timed_by_default(data: Data) -> None:
    """Take 4 s, the default of a blend, where the least time that the limits allow would be found."""
    for phase in data["phases"]:
        phase.update({key: 4.0 for key, value in phase.items() if value == "auto"})


def without_edges(data: Data) -> None:
    """Let nothing but the slots hold the shape."""
    data["formations"]["cube"]["edges"] = []


def without_on_loss(data: Data) -> None:
    """Fly on after a loss, which is the default."""
    del data["disturbances"]["on_loss"], data["disturbances"]["landing_formation"]


#: Scene, what it shows, the change that takes this away, and a check of the verdict that then fails.
SHOWN: list[tuple[str, str, Callable[[Data], None], str]] = [
    ("bridge-inspection", "follow", without("follow"), "clearance"),
    ("bridge-inspection", "brake", held, "acceleration"),
    ("bridge-inspection", "cylinder", boxed("cylinder"), "clearance"),
    ("statue", "orbit", without("orbit"), "clearance"),
    ("statue", "hull", boxed("hull"), "clearance"),
    ("hill-search", "through", without_key("phases", 2, "through"), "clearance"),
    ("hill-search", "heights", boxed("heights"), "clearance"),
    ("change-of-picture", "transition", without_key("phases", 2, "transition"), "separation"),
    ("change-of-picture", "auto", timed_by_default, "acceleration"),
    ("falling-light", "on_loss", without_on_loss, "lost"),
    ("ferris-wheel", "[yaw]", without_key("yaw"), "saturation"),
    ("cube-by-neighbours", "edges", without_edges, "shape"),
]  # fmt: skip
SCENES = list(dict.fromkeys(name for name, *_ in SHOWN))


@cache
def flown(name: str) -> rf.Verdict:
    """The verdict of a scene as it is shipped."""
    return rf.assess(rf.simulate(name))


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_passes(name):
    """A scene has 3 to 12 vehicles and passes its verdict; that its check finds nothing is in test_preflight.py."""
    assert 3 <= rf.load_mission(name).n_agents <= 12
    assert flown(name).passed, flown(name)


@pytest.mark.parametrize(
    ("name", "key", "change", "check"), SHOWN, ids=[f"{n}-{k}" for n, k, *_ in SHOWN]
)
def test_a_scene_fails_without_what_it_shows(name, key, change, check):
    """Without the key, or with its default, the same mission fails the check that the table names."""
    data = rf.load_mission(name).to_dict()
    change(data)
    verdict = rf.assess(rf.simulate(rf.Mission.from_dict(data)))
    assert check in {each.check for each in verdict.checks if not each.passed}, verdict
    assert check not in {each.check for each in flown(name).checks if not each.passed}


def test_every_kind_is_in_a_shipped_mission():
    """Each kind of phase and of obstacle that the format has is in a mission that ships."""
    parts = [part.get("properties", {}).get("kind", {}) for part in json_schema()["$defs"].values()]
    kinds = {part["const"] for part in parts if "const" in part}
    missions = [rf.load_mission(name) for name in mission_names()]
    seen = {each.kind for m in missions for each in (*m.phases, *m.obstacles)}
    assert {"follow", "hull"} <= kinds
    assert kinds - seen == set()


def test_groups_hold_every_mission_once():
    """The groups of shipped missions have every mission once, and none is empty."""
    assert all(GROUPS.values())
    assert sorted(name for names in GROUPS.values() for name in names) == mission_names()
    assert set(FIRST) <= set(mission_names())


def test_waypoints_above_each_other_have_one_label():
    """Five vehicles that land one by one move the formation's middle straight down in five parts, with one label."""
    space, *_ = plotting.trajectory(rf.simulate("hill-search")).axes
    assert [text.get_text().strip() for text in space.texts].count("land 4") == 1
