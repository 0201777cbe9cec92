"""Rules that a plan finds broken: each by a mission, and says which phase, what the problem is, and the remedy."""

import ast
import sys
from pathlib import Path
from typing import Any

import pytest

from rigidfleet import errors
from rigidfleet.errors import MissionError
from rigidfleet.mission import Mission
from rigidfleet.planning import preview, timing, ways

STANDING = [[-1.5, -1.5, 5.0], [1.5, -1.5, 5.0], [1.5, 1.5, 5.0], [-1.5, 1.5, 5.0]]
AGENTS = {"mass": 1.0, "radius": 0.25, "position": STANDING}
SQUARE: list[Any] = [[-1.5, -1.5, 0], [1.5, -1.5, 0], [1.5, 1.5, 0], [-1.5, 1.5, 0]]
FORMS: dict[str, Any] = {
    "square": {"slots": SQUARE},
    "opposite": {"slots": SQUARE[2:] + SQUARE[:2]},
    "column": {"slots": [[0, 0, 3], [0, 0, 1], [0, 0, -1], [0, 0, -3]]},
    "near": {"slots": [[-3, 0, 0], [-2.9, 0, 0.3], [1, 0, 0], [3, 0, 0]]},
    "chain": {"edges": [[1, 2], [2, 3], [3, 4]], "distances": [3.0, 3.0, 3.0]},
}
LIMITS = {"speed": 3.0, "acceleration": 2.0}
TAKE = {"kind": "establish", "formation": "square", "duration": 4.0}
OPEN = TAKE | {"formation": "chain", "control": "open", "reference": "distances"}
FLY = {"kind": "fly", "position": [12.0, 0, 5], "duration": "auto"}
CLIMB = {"kind": "takeoff", "height": 5.0, "duration": 8.0}
GO = {"kind": "go", "position": [12.0, 0, 5], "duration": 20.0}
#: A wall with a gap that is too narrow, and one with a ball that fills it later.
GAP = [
    {"kind": "box", "name": "left", "min": [5, 0.1, -90], "max": [6, 99, 99]},
    {"kind": "box", "name": "right", "min": [5, -99, -90], "max": [6, -0.1, 99]},
]
BALL = {"kind": "sphere", "name": "ball", "radius": 2.0, "centre": [6, 0, 5], "velocity": [0.1, 0, 0]}  # fmt: skip


def swap(**keys: Any) -> dict[str, Any]:
    """A change of formation by bent ways, or as the keys say."""
    kind = {"kind": "reshape", "formation": "opposite", "transition": "ways"}
    return kind | {"duration": 12.0} | keys


def land(duration: float, **keys: Any) -> dict[str, Any]:
    """A landing."""
    return {"kind": "land", "duration": duration} | keys


def follow(*starts: list[float], push: float = 0.0) -> dict[str, Any]:
    """Ways of 4 s from rest: the first with an acceleration along x [m/s^2], the others stay."""
    rows = [[[4.0, x, 0.0, 0.0, y, 0.0, 0.0, z, *[0.0] * 5]] for x, y, z in starts]
    rows[0][0][3] = 0.5 * push
    return {"kind": "follow", "trajectories": rows}


GROUNDED: dict[str, Any] = {"obstacles": [{"kind": "ground"}]}
PARKED = GROUNDED | {"agents": AGENTS | {"position": [[x, y, 0.25] for x, y, _ in STANDING]}}
FAR_HILLS = {"kind": "heights", "corner": [20, 20], "spacing": 1.0, "heights": [[0, 0], [0, 0]]}
TIGHT = {"separation": 2.3, "geofence": {"min": [-1.8, -1.8, 4.7], "max": [1.8, 1.8, 5.3]}}

#: The key of a finding, how its problem begins, phases and other tables of a mission that leads to it.
CASES: list[tuple[str, str, list[Any], dict[str, Any]]] = [
    # timing
    ("phases[2].kind", "begins while agent 1 goes on at 1.50 m/s", [follow(*STANDING, push=0.5), TAKE], {}),
    ("phases[1].formation", "depends on distances alone", [OPEN, TAKE | {"duration": "auto"}], {}),
    ("phases[1].file", "its first point", [follow([9.0, 0.0, 5.0])], {}),
    ("phases[2].duration", "no time keeps the limits", [TAKE, FLY | {"velocity": [4, 0, 0]}], {}),
    # courses
    ("phases[2].kind", "needs a ground, and none is below agent 1", [TAKE, land(9.0)], {"obstacles": [FAR_HILLS]}),
    # transitions
    ("phases[2].duration", "is too short for 2 groups", [TAKE, land(5.0, stagger=6.0)], GROUNDED),
    ("phases[2].places", "needs vehicles that stand on the ground", [TAKE, land(30.0, places="own")], GROUNDED),
    ("phases[2].duration", "is too short for the ways to the own places", [CLIMB, land(1.0, places="own")], PARKED),
    ("phases[2].transition", "is found within limits", [TAKE, swap()], {"limits": {"speed": 3.0}}),
    ("phases[2].transition", "between 'square' and 'near'", [TAKE, swap(formation="near")], {}),
    ("phases[2].transition", "finds no ways to", [TAKE, swap()], {"limits": LIMITS | TIGHT}),
    ("phases[2].blend", "is too short for the ways found", [TAKE, swap(blend=1.0)], {}),
    ("phases[2].duration", "is shorter than the ways found", [TAKE, swap(duration=4.5)], {}),
    ("phases[2].transition", "starts from no formation", [OPEN, swap(formation="square", transition="layers")], {}),
    ("phases[2].transition", "finds no layers", [TAKE, swap(formation="column", transition="layers")], {}),
    # ways
    ("phases[3].kind", "begins where distances alone have led", [OPEN, TAKE, GO], {}),
    ("phases[1].kind", "needs a formation", [GO], {}),
    ("phases[3].kind", "begins at 1 m/s", [TAKE, GO | {"kind": "fly", "velocity": [1, 0, 0]}, GO], {}),
    ("phases[2].position", "ways lead round obstacles at rest", [TAKE, GO], {"obstacles": [BALL]}),
    ("phases[2].position", "its goal leaves agent", [TAKE, GO | {"position": [7, 4, 5]}], {"obstacles": GAP}),
    ("phases[2].position", "no way is found", [TAKE, GO], {"obstacles": GAP}),
]  # fmt: skip
#: A case whose search has to be spoilt: it keeps less room than it is asked for, and tries once.
SPOILT = (
    "phases[2].clearance", "finds a way, but its proof lacks", [TAKE, GO | {"clearance": 0.5}],
    {"obstacles": [GAP[0] | {"min": [5, -1, 0], "max": [6, 1, 9]}]},
)  # fmt: skip

Place = tuple[str, int]


def finding(phases: list[Any], tables: dict[str, Any]) -> errors.Finding:
    """What is wrong with a plan, of a mission with which nothing is wrong as a file."""
    used = {p.get("formation") for p in phases}
    data = {
        "schema_version": 1, "name": "plan", "smoothness": "jerk", "limits": LIMITS, "agents": AGENTS,
        "formations": {name: form for name, form in FORMS.items() if name in used}, "phases": phases,
    }  # fmt: skip
    mission = Mission.from_dict(data | tables)
    with pytest.raises(MissionError) as error:
        preview.preview_phases(timing.complete_times(mission))
    (one,) = error.value.findings
    return one


@pytest.fixture(scope="module")
def planned() -> tuple[list[errors.Finding], set[Place]]:
    """The finding of each case, and the lines from which they are."""
    lines: set[Place] = set()
    make = MissionError.__init__

    def note(self: MissionError, *args: Any) -> None:
        frame = sys._getframe(1)
        if frame.f_code is ways.error_of_key.__code__ and frame.f_back is not None:
            frame = frame.f_back
        lines.add((Path(frame.f_code.co_filename).name, frame.f_lineno))
        make(self, *args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MissionError, "__init__", note)
        findings = [finding(phases, tables) for *_, phases, tables in CASES]
        patch.setattr(ways, "_KEPT", -0.3)
        patch.setattr(ways, "_TRIES", 1)
        findings.append(finding(*SPOILT[2:]))
    return findings, lines


@pytest.mark.parametrize("number", range(len(CASES) + 1))
def test_a_broken_rule_of_plans_is_a_finding(number, planned):
    """It stands at a key of the phase, and has a problem and a remedy."""
    key, words, *_ = [*CASES, SPOILT][number]
    one = planned[0][number]
    assert one.key.startswith(key)
    assert one.problem.startswith(words)
    assert one.remedy


def test_every_rule_of_plans_has_an_input(planned):
    """Each place in `planning` that makes a finding is reached by a case of this module."""
    makers = ("error_of_key", "ways.error_of_key", "mistake", "self.mistake", "MissionError")
    places = {
        (file.name, line): (file.name, call.lineno)
        for file in Path(ways.__file__).parent.glob("*.py")
        for call in ast.walk(ast.parse(file.read_text("utf-8")))
        if isinstance(call, ast.Call) and ast.unparse(call.func) in makers
        for line in range(call.lineno, (call.end_lineno or 0) + 1)
    }
    inside = ways.error_of_key.__code__.co_firstlineno  # of the last function there
    every = {x for x in places.values() if x[0] != "ways.py" or x[1] < inside}
    assert len(every) >= 22
    idle = every - {places[line] for line in planned[1] if line in places}
    assert not idle, f"add a mission to the cases of this module for the rules at {sorted(idle)}"
