"""Missions and results that nobody would write: they are taken, fail with a verdict, or are refused with a reason.

Hypothesis writes them: sound missions of every kind, and the same with some of their values exchanged
for huge, tiny, negative, missing or senseless ones. Nothing may end in a traceback, hang, or come back
with numbers that are not finite and a verdict that is content.

Beside them `input_fuzzer.py` changes shipped missions and a result's file in structure, values, types, sizes and bytes,
and gives them to the command, each within a limit of time and memory.
"""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import input_fuzzer
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rigidfleet.assessment import assess
from rigidfleet.errors import FlightError, MissionError
from rigidfleet.mission import Mission
from rigidfleet.planning import tolerances
from rigidfleet.simulation.flight import simulate

Data = dict[str, Any]

#: A case that takes longer hangs [s of processor time]; 3,000 steps of solver "pinv" take 10 s, on a slow
#: machine thrice that.
PATIENCE = 60.0

COMPLETE_WHERE_FLOWN = (
    "time", "position", "velocity", "acceleration", "input_force", "constraint_force",
    "external_force", "thrust", "cm", "cm_velocity", "distance", "wrench_achieved",
)  # fmt: skip


# -- what hypothesis writes ------------------------------------------------------------------------

ODD = [
    "a", "", " ", "a b", "../x", "é", "🛸", '"', "'", "\\", "a.b", "[x]", "x" * 300, "\n", "\0", "nan",
    "true", "None", "%s", "{}", "-", "#", "[bold]", "1",
]  # fmt: skip
NAMES = st.one_of(st.sampled_from(ODD), st.text(max_size=8))
WILD_NUMBERS = st.sampled_from([
    0, 0.0, -0.0, 1, -1, 5e-324, 1e-300, 1e-15, 1e-9, 1e-3, 0.5, 4.0, 12.5, 1e3, 1e6, 1e9, 1e15, -1e15,
    1e16, 1e300, -1e300, float("inf"), float("-inf"), float("nan"), 2**70, -(2**31), 3, 8,
])  # fmt: skip
WILD = st.one_of(
    WILD_NUMBERS,
    WILD_NUMBERS,
    NAMES,
    st.booleans(),
    st.lists(WILD_NUMBERS, max_size=4),
    st.lists(st.lists(WILD_NUMBERS, min_size=3, max_size=3), max_size=4),
    st.just({}),
    st.builds(dict, kind=st.sampled_from(["hold", "box", "ground", "fly", "nothing"])),
)
SIZES = st.sampled_from([1e-6, 1e-3, 0.1, 1.0, 4.0, 4.0, 4.0, 50.0, 1e4, 1e8])
#: What is allowed where a number has to be positive.
POSITIVE = st.sampled_from(
    [1e-300, 1e-15, 1e-9, 1e-6, 1e-3, 0.1, 1.0, 10.0, 1e2, 1e3, 1e4, 1e6, 1e15]
)
UNITS = st.floats(-1, 1, allow_subnormal=False)
SHAPES = {1: ["line"], 2: ["line"], 3: ["line", "triangle", "polygon"], 4: ["square", "pyramid"]}


def vectors(scale: float) -> st.SearchStrategy[list[float]]:
    """A vector of a size, on a grid or off it: points on lines, in planes, in one another's way."""
    grid = st.sampled_from([-1.0, -0.5, 0.0, 0.5, 1.0])
    return st.one_of(
        st.lists(grid.map(lambda x: x * scale), min_size=3, max_size=3),
        st.lists(UNITS.map(lambda x: x * scale), min_size=3, max_size=3),
    )


def points(n: int, scale: float) -> st.SearchStrategy[list[list[float]]]:
    """So many of them, seldom two at one place."""
    apart = st.lists(vectors(scale), min_size=n, max_size=n, unique_by=tuple)
    alike = st.lists(vectors(scale), min_size=n, max_size=n)
    return st.one_of(apart, apart, apart, alike)


@st.composite
def formations(draw: Callable[..., Any], n: int) -> Data:
    """A formation of n agents."""
    size = draw(SIZES)
    form: Data
    if draw(st.booleans()):
        shape = draw(st.sampled_from(SHAPES.get(n, ["line", "polygon", "pyramid"])))
        form = {"shape": shape, "size": size}
    else:
        form = {"slots": draw(points(n, size))}
    if n > 1 and draw(st.booleans()):
        pairs = [[i, j] for i in range(1, n + 1) for j in range(i + 1, n + 1)]
        form["edges"] = draw(st.lists(st.sampled_from(pairs), unique_by=tuple, max_size=len(pairs)))
        if not draw(st.integers(0, 4)):
            count = len(form["edges"])
            lengths = st.sampled_from([size, size, size * 2**0.5, size / 2, 3 * size])
            form["distances"] = draw(st.lists(lengths, min_size=count, max_size=count))
    return form


@st.composite
def phases(draw: Callable[..., Any], names: list[str], *, body: bool, first: bool) -> Data:
    """A phase, some seconds long."""
    kind = draw(st.sampled_from(["establish", "fly", "turn", "hold", *["reshape"] * (not first)]))
    phase: Data = {"kind": kind}
    length = draw(st.sampled_from([0.2, 1.0, 2.0, 5.0]))
    if draw(st.integers(0, 3)):
        phase["duration"] = length
    else:
        phase["settle"] = {"tolerance": draw(SIZES), "dwell": 0.1, "timeout": length}
    if kind in ("establish", "reshape"):
        phase["formation"] = draw(st.sampled_from(names))
        phase["reference"] = draw(
            st.sampled_from(["shape", "shape", "distances", "squares", "step"])
        )
        if phase["reference"] != "step":
            phase["blend"] = length * draw(st.sampled_from([1e-9, 0.1, 1.0]))
        if draw(st.booleans()):
            phase["control"] = "open"
    else:
        if kind in ("fly", "turn"):
            phase["travel"] = length * draw(st.sampled_from([1e-6, 0.5, 1.0]))
        if kind == "fly":
            phase["position"] = draw(vectors(draw(SIZES)))
            phase["velocity"] = draw(vectors(draw(st.sampled_from([0.0, 1.0, 100.0]))))
        if kind == "turn" or (kind == "fly" and draw(st.booleans())):
            phase["yaw_deg"] = draw(st.sampled_from([0.0, 90.0, 180.0, -180.0, 360.0, 1e6]))
            phase["pitch_deg"] = draw(st.sampled_from([0.0, 90.0, -45.0]))
        if kind == "hold" and draw(st.booleans()):
            phase["control"] = "body" if body else "open"
    return phase


@st.composite
def sound(draw: Callable[..., Any]) -> Data:
    """A mission that is right in its form, whatever it asks for."""
    n = draw(st.integers(1, 6))
    names = draw(st.lists(NAMES, min_size=1, max_size=2, unique=True))
    body = draw(st.booleans())
    first = draw(phases(names, body=body, first=True))
    shaped = first["kind"] == "establish"
    data: Data = {
        "schema_version": 1,
        "name": "fuzz",
        "architecture": "body" if body else "local",
        "formulation": draw(st.sampled_from(["inertial", "body"])),
        "output_step": 0.1,
        "agents": {
            "mass": draw(st.sampled_from([1.0, 1.0, 1e-6, 1e6, [10.0**k for k in range(n)]])),
            "position": draw(points(n, draw(SIZES))),
        },
        "constraint": {
            "solver": draw(st.sampled_from(["iterated", "iterated", "spectral", "exact", "pinv"]))
        },
        "formations": {name: draw(formations(n)) for name in names},
        "phases": [first, *draw(st.lists(phases(names, body=body, first=not shaped), max_size=2))],
    }
    if draw(st.booleans()):
        speed = draw(st.sampled_from([0.0, 1.0, 1e3]))
        data["agents"]["velocity"] = draw(st.lists(vectors(speed), min_size=n, max_size=n))
    if draw(st.booleans()):
        data["agents"]["thrust_limit"] = draw(st.sampled_from([1e-3, 23.6, 1e15]))
        data["agents"]["saturate"] = draw(st.booleans())
    if draw(st.booleans()):
        data["obstacles"] = [
            {"kind": "ground"},
            {"kind": "box", "min": [1, 1, 1], "max": [2, 2, 2]},
        ]
        data["limits"] = {"speed": 1.0, "separation": 1.0, "separation_below": 1.0}
    if draw(st.booleans()):
        data["allocation"] = {"method": "pinv", "torque_split": "inertia"}
    return data


@st.composite
def extreme(draw: Callable[..., Any]) -> Data:
    """A sound mission with weights, gains and tolerances far beyond reason."""
    data = draw(sound())
    for _ in range(draw(st.integers(1, 3))):
        table, key = draw(st.sampled_from(NUMBERS)).split(".")
        pair = [draw(POSITIVE), draw(POSITIVE)]
        data.setdefault(table, {})[key] = pair if key in "QS" else draw(POSITIVE)
    return data


@st.composite
def broken(draw: Callable[..., Any]) -> Data:
    """A sound mission with some values exchanged, left out or added."""
    data = draw(sound())
    for _ in range(draw(st.integers(1, 2))):
        here: Any = data
        while True:
            key = draw(st.sampled_from(list(here) if isinstance(here, dict) else range(len(here))))
            if isinstance(here[key], dict | list) and here[key] and draw(st.integers(0, 9)):
                here = here[key]
                continue
            what = draw(st.integers(0, 9))
            if what == 0:
                del here[key]
            elif what == 1 and isinstance(here, dict):
                here[draw(NAMES)] = draw(WILD)
            elif isinstance(here[key], float) and what < 8:
                here[key] = draw(WILD_NUMBERS)
            else:
                here[key] = draw(WILD)
            break
        if not data:
            break
    return data


NUMBERS = [
    "constraint.alpha", "constraint.beta", "constraint.gamma", "constraint.damping",
    "constraint.threshold", "constraint.deformation_damping", "lqr.Q", "lqr.R", "lqr.S", "tracking.Q",
    "tracking.R", "integrator.rtol", "integrator.atol", "body_frame.yaw_deg", "agents.radius",
]  # fmt: skip


# -- what must hold --------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _shorten_text(monkeypatch: pytest.MonkeyPatch) -> None:
    """A phase may take only so many steps, that a case takes a second and no minute."""
    monkeypatch.setattr(tolerances, "_STALLED", 3000)
    monkeypatch.setattr(tolerances, "_STALLED_RATE", 0.0)


def outcome(data: Data) -> str:
    """What becomes of a mission: refused, failed, passed; anything else is an error."""
    begun = time.process_time()
    try:
        mission = Mission.from_dict(data)
    except MissionError as error:
        assert all(f.problem for f in error.findings)  # noqa: PT017
        return "refused"
    try:
        result = simulate(mission)
    except FlightError as error:
        assert len(str(error)) > 40  # noqa: PT017
        return "failed"
    verdict = assess(result)
    report = json.loads(verdict.json())
    assert report["passed"] == verdict.passed
    if result.complete:
        lost = [n for n in COMPLETE_WHERE_FLOWN if not np.isfinite(getattr(result, n)).all()]
        assert not lost, f"not finite and nobody said so: {lost}"
    else:
        assert len(result.ending) > 40
        assert not verdict.passed
    assert time.process_time() - begun < PATIENCE
    return "passed" if verdict.passed else "failed"


MISSIONS = st.one_of(sound(), extreme(), broken())
#: Examples are as large as a mission is, and take as long as it flies.
PATIENT = list(HealthCheck)


@given(MISSIONS)
@settings(max_examples=200, suppress_health_check=PATIENT)
def test_no_mission_ends_in_a_traceback(data: Data):
    """200 missions, sound and broken: each flies, fails with a verdict, or is refused with a reason."""
    outcome(data)


@pytest.mark.long
@given(MISSIONS)
@settings(max_examples=600, suppress_health_check=PATIENT)
def test_none_of_six_hundred_does(data: Data):
    """The same for 600 missions."""
    outcome(data)


# -- what the command makes of files ---------------------------------------------------------------


def faults(kind: str, count: int, folder: Path) -> list[str]:
    """What was no good end, of so many cases; a process that hangs, dies or fills its memory ends none well."""
    whole = None
    if kind == "result":
        input_fuzzer.a_flight(folder)
        whole = folder / "whole.nc"
    found = list(input_fuzzer.attack(kind, 0, count, whole))
    assert len(found) == count
    return [f"{kind} {case['seed']}: {case['fault']}" for case in found if case["fault"]]


@pytest.mark.parametrize(("kind", "count"), [("check", 30), ("run", 20), ("result", 12)])
def test_no_file_ends_in_a_traceback(tmp_path: Path, kind: str, count: int):
    """Each of some changed files ends in an exit code of 0, 1 or 2 and in words, within its time and memory."""
    assert not faults(kind, count, tmp_path)


@pytest.mark.long
@pytest.mark.parametrize(("kind", "count"), [("check", 200), ("run", 120), ("result", 80)])
def test_none_of_many_files_does(tmp_path: Path, kind: str, count: int):
    """The same of four hundred files."""
    assert not faults(kind, count, tmp_path)


def test_the_fuzzer_finds_what_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A traceback, a hang, a full memory and a wrong exit code in the command are each found as a fault."""
    for body, words in (
        ("raise IndexError('here')", "IndexError: here"),
        ("import time; time.sleep(99)", "Timeout"),
        ("while True: pass", "app.py"),
        ("import numpy; numpy.ones((1 << 20, 1 << 12))", "MemoryError"),
        ("return 7", "exit code 7"),
        ("return 2", "exit code 2 without an error"),
    ):
        for room in ("", "cli", "planning"):
            (tmp_path / "rigidfleet" / room).mkdir(exist_ok=True)
            (tmp_path / "rigidfleet" / room / "__init__.py").write_text("")
        (tmp_path / "rigidfleet" / "planning" / "tolerances.py").write_text("")
        (tmp_path / "rigidfleet" / "cli" / "app.py").write_text(f"def main(_):\n    {body}\n")
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))
        monkeypatch.setenv("MUTATIONS_SECONDS", "1")
        # Bodies of one length, written within one second, would share their compiled code.
        monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
        (case,) = input_fuzzer.attack("check", 0, 1)
        assert words in case["fault"]
