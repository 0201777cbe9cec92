"""Missions and results with anything wrong in them, and what the command makes of each.

`python tests/input_fuzzer.py KIND SEED COUNT` tries so many cases, each by a seed of its own, in one process: within so
much memory, and each within so much time. A line of JSON says what came of each; what is none of a good end
(exit code 0, 1 or 2, or an error with a remedy) is its "fault". `attack` starts such processes and goes on
behind a case that hangs or dies.
"""

from __future__ import annotations

import contextlib
import faulthandler
import io
import json
import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

KINDS = ("check", "run", "result")
#: Time of a case [s] and memory of all [bytes]; the kernel's own code and its libraries take half a GB of it.
SECONDS, MEMORY = {"check": 60, "run": 60, "result": 60}, 3 << 30
#: By the clock so many times that.
_WAIT = 10
#: Longer flights are not flown: they end, but not soon.
LONGEST, MOST = 150.0, 60
SHIPPED = Path(__file__).parents[1] / "src" / "rigidfleet" / "missions"

NUMBERS = [
    0, -1, 1, 2, 3, 0.5, -0.0, 1e-308, 1e-200, 1e-12, 1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e8, 1e9, 1e15, -1e15, 1e200,
    1.7e308, math.inf, -math.inf, math.nan, 2**31, 2**63 - 1, -(2**31), 10**6, 10**7, 10**100,
]  # fmt: skip
TEXTS = [
    "", " ", "a", "é", "x" * 5000, "\\u0000", "../../x", "nan", "complete", "henneberg", "henneberg-multilevel",
    "neighbours", "slots", "open", "tracking", "body", "distances", "step", "squares", "line", "grid", "sphere",
    "helix", "shells", "exact", "pinv", "spectral", "infinite", "shortest", "safe", "each", "inertial",
    "dryden", "first-order", "[bold]", "<script>",
]  # fmt: skip
LITERALS = [
    "1979-05-27",
    "07:32:00",
    "true",
    "'''\n'''",
    "{}",
    "[]",
    "[[]]",
    "0x7fffffffffffffff",
    "1_0",
    "+1",
    ".5",
]


class Dice:
    """Choices from one seed."""

    def __init__(self, *seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def one(self, things: Any) -> Any:
        """Any of some things."""
        return things[int(self.rng.integers(len(things)))]

    def upto(self, n: int) -> int:
        """A whole number from 0 to n - 1."""
        return int(self.rng.integers(n))

    def value(self) -> Any:
        """A hostile value of any type."""
        match self.upto(10):
            case 0 | 1 | 2 | 3:
                return self.one(NUMBERS)
            case 4 | 5:
                return self.one(TEXTS)
            case 6:
                return bool(self.upto(2))
            case 7:
                return [self.one(NUMBERS) for _ in range(self.upto(5))]
            case 8:
                return [[self.one(NUMBERS) for _ in range(3)] for _ in range(self.upto(5))]
        return {self.one(TEXTS): self.one(NUMBERS)} if self.upto(2) else {}


# -- missions ----------------------------------------------------------------------------------------


def a_mission(dice: Dice) -> bytes:
    """A shipped mission, changed in structure, in values, in sizes or in bytes."""
    paths = sorted(SHIPPED.glob("*.toml"), key=lambda path: path.name)
    small = [path for path in paths if path.stem != "show-1000"]
    text = dice.one(small * 5 + [path for path in paths if path not in small]).read_text()
    how = dice.upto(14)
    if how >= 10:
        data = tomllib.loads(text)
        for _ in range(1 + dice.upto(4)):
            here, key = dice.one(list(numbers_in(data)))
            here[key] = dice.one([
                here[key] * dice.one([-1, 0, 0.01, 0.1, 0.5, 0.9, 1.1, 2, 5, 20, 1000]),
                dice.one([1e-15, 1e-6, 1e-3, 1.0, 50.0, 1e3, 1e4, 1e6, 1e7, 1e8, 1e12, 1e15]),
            ])  # fmt: skip
        text = written(data)
    elif how < 6:
        data = tomllib.loads(text)
        for _ in range(dice.one([1, 1, 2, 3])):
            changed(data, dice)
        text = written(data)
    elif how < 8:
        lines = text.splitlines()
        for _ in range(1 + dice.upto(3)):
            k = dice.upto(len(lines))
            match dice.upto(4):
                case 0:
                    del lines[k]
                case 1:
                    lines[k:k] = [lines[k]] * dice.one([1, 2, 10, 3000])
                case 2:
                    key, _, _ = lines[k].partition("=")
                    lines[k] = f"{key}= {dice.one([*LITERALS, *map(str, NUMBERS)])}"
                case _:
                    lines[k] = lines[k][: dice.upto(len(lines[k]) + 1)]
            lines = lines or [""]
        text = "\n".join(lines)
    elif how == 8:
        text += dice.one([
            "\n" + ".".join(["a"] * dice.one([3, 50, 5000, 100_000])) + " = 1\n",
            "\nx = " + "[" * dice.one([3, 50, 5000, 100_000]),
            "\n[[phases]]\nkind = 'hold'\nduration = 1.0\n" * dice.one([10, 300, 5000]),
            "\n[[obstacles]]\nkind = 'box'\nmin = [1, 1, 1]\nmax = [2, 2, 2]\n" * dice.one([10, 300, 5000]),
            "".join(f"\n[formations.f{k}]\nshape = 'line'\nsize = 1\n" for k in range(dice.one([10, 150, 2000]))),
            "\n" + "".join(f"k{k} = 1\n" for k in range(dice.one([10, 1000, 60_000]))),
        ])  # fmt: skip
    else:
        raw = bytearray(text.encode())
        for _ in range(1 + dice.upto(8)):
            raw[dice.upto(len(raw))] = dice.upto(256)
        return bytes(raw[: dice.upto(len(raw))]) if not dice.upto(4) else bytes(raw)
    return text.encode("utf-8", "replace")


def numbers_in(data: Any) -> Iterator[tuple[Any, Any]]:
    """Each number of plain data, as what holds it and its key there."""
    for key, value in data.items() if isinstance(data, dict) else enumerate(data):
        if isinstance(value, dict | list):
            yield from numbers_in(value)
        elif isinstance(value, float | int) and not isinstance(value, bool):
            yield data, key


def changed(data: Any, dice: Dice) -> None:
    """Change one thing at any depth of plain data."""
    here = data
    while True:
        keys = list(here) if isinstance(here, dict) else range(len(here))
        if not keys:
            return
        key = dice.one(keys)
        inner = here[key]
        if isinstance(inner, dict | list) and inner and dice.upto(8):
            here = inner
            continue
        break
    number = isinstance(inner, int | float) and not isinstance(inner, bool)
    if number and dice.upto(4):  # most stay possible
        here[key] = inner * dice.one([-1, 0, 1e-6, 1e-3, 0.1, 0.5, 0.99, 1.01, 2, 10, 1e3, 1e6])
        return
    match dice.upto(10):
        case 0:
            del here[key]
        case 1 if isinstance(here, dict):
            here[dice.one([*TEXTS, "count", "size", "edges", "mass", "settle", "blend"])] = (
                here.pop(key)
            )
        case 2 if isinstance(here, list):
            here *= dice.one([2, 3, 30, 1000])
        case 3 if isinstance(inner, str):
            here[key] = dice.one(TEXTS[8:])
        case 4 if here is data or isinstance(inner, dict):
            here[key] = dice.value()
        case 5 if key == "position" and isinstance(here, dict):
            count = dice.one([0, 1, 2, 3, 5, 40, 1000, 20_000, 10**6, 10**9])
            here[key] = {
                "shape": dice.one(TEXTS[18:24]),
                "size": dice.one([1.0, 2, 1e-9, 1e8]),
                "count": count,
            }
        case 6 if isinstance(here, dict):
            here[dice.one([*TEXTS[9:], *here])] = dice.value()
        case _:
            here[key] = dice.value()


def written(value: Any, path: tuple[str, ...] = ()) -> str:
    """Plain data as TOML, all in line below the first level."""
    if path:
        if isinstance(value, dict):
            return (
                "{"
                + ", ".join(f"{json.dumps(k)} = {written(v, (k,))}" for k, v in value.items())
                + "}"
            )
        if isinstance(value, list):
            return "[" + ", ".join(written(v, path) for v in value) + "]"
        if isinstance(value, float):
            return repr(value)
        return json.dumps(value)
    return "".join(f"{json.dumps(k)} = {written(v, (k,))}\n" for k, v in value.items())


# -- results -----------------------------------------------------------------------------------------

ATTRIBUTES = [
    "mission", "complete", "ending", "phases", "statistics", "versions", "platform", "created", "title",
    "rigidfleet_schema_version",
]  # fmt: skip


def a_result(whole: bytes, dice: Dice) -> bytes:
    """A result's file, changed in attributes, in arrays or in bytes."""
    import h5py

    if not dice.upto(5):
        raw = bytearray(whole)
        for _ in range(1 + dice.upto(4)):
            at, n = dice.upto(len(raw)), dice.one([1, 1, 4, 16, 4096])
            raw[at : at + n] = dice.rng.bytes(len(raw[at : at + n]))
        return bytes(raw[: dice.upto(len(raw))]) if not dice.upto(4) else bytes(raw)
    buffer = io.BytesIO(whole)
    with h5py.File(buffer, "r+") as file:
        for _ in range(1 + dice.upto(2)):
            if dice.upto(2):
                spoil_attribute(file, dice)
            else:
                spoil_array(file, dice)
    return buffer.getvalue()


def spoil_attribute(file: Any, dice: Dice) -> None:
    """Change an attribute."""
    name = dice.one(ATTRIBUTES)
    text = file.attrs.get(name)
    if isinstance(text, str) and dice.upto(2):
        if text[:1] in ("{", "[") and dice.upto(4):
            data = [json.loads(text)]
            for _ in range(1 + dice.upto(2)):
                changed(data, dice)
            file.attrs[name] = json.dumps(data[0] if data else None, default=str)
        elif name == "mission":
            file.attrs[name] = a_mission(dice).decode("utf-8", "replace").replace("\0", "")
        else:
            cut = dice.upto(len(text) + 1)
            file.attrs[name] = text[:cut] + dice.one(
                ["", "\udc80".encode("utf-8", "surrogatepass").decode("latin-1")]
            )
        return
    if name in file.attrs:
        del file.attrs[name]
    if not dice.upto(8):
        return
    file.attrs[name] = dice.one([
        0, 1, -1, 2, 1.5, math.nan, 10**6, np.arange(5), np.zeros((2, 2)), np.array(["a", "b"], dtype=object), "",
        "null", "[]", "{}", "1", '"a"', "[" * 3000, '{"steps": "a"}', "NaN", "1e999", np.bytes_(b"\xff\xfe"),
        np.complex128(1j), b"\xed\xb2\x80", "x" * 40_000, np.zeros(0), "[null]", "[{}]", "[1, [2]]",
    ])  # fmt: skip


def spoil_array(file: Any, dice: Dice) -> None:
    """Change an array: its values, its type, its shape, or leave it out."""
    import h5py

    names = [n for n, d in file.items() if isinstance(d, h5py.Dataset)]
    name = dice.one(names)
    value = file[name][...]
    if value.dtype.kind not in "iuf":
        del file[name]
        return
    match dice.upto(12):
        case 0:
            del file[name]
            return
        case 1:
            value = value.astype(dice.one(["f4", "f2", "i8", "u1", "c16", "S3", ">f8", "?"]))
        case 2:
            value = value[: dice.upto(len(value) + 1)] if value.ndim else value
        case 3:
            value = value[..., None] if dice.upto(2) else value.reshape(-1)
        case 4:
            value = np.concatenate([value, value]) if value.ndim else value
        case 5:
            shape = dice.one([(10**9,), (10**5, 10**4), (0,), (0, 3), (2, 10**5, 3), value.shape])
            del file[name]
            file.create_dataset(name, shape, "f8", chunks=True if math.prod(shape) else None)
            return
        case 6:
            value = np.full(
                value.shape, dice.one([math.nan, math.inf, 1e308, -1e308, 0.0, 5e-324])
            ).astype("f8" if value.dtype.kind == "f" else "i8", casting="unsafe")
        case 7:
            value = np.full(value.shape, dice.one([-(2**31), -2, -1, 10**6, 2**40]))
            value = value.astype("f8") if dice.upto(2) else value
        case 8:
            value = dice.rng.permuted(value) if value.ndim else value
        case 9:
            value = value.astype("f8") * dice.one([-1, 1e-300, 1e12, 1e150])
        case 10:
            other = file[dice.one(names)]
            value = other[...] if other.dtype.kind in "iuf" else value
        case _:
            flat = value.reshape(-1).astype("f8" if value.dtype.kind == "f" else "i8")
            for _ in range(1 + dice.upto(5)):
                if flat.size:
                    hostile = (
                        [-1, 0, 10**9]
                        if flat.dtype.kind == "i"
                        else [math.nan, math.inf, -math.inf, 1e308, 0]
                    )
                    flat[dice.upto(flat.size)] = dice.one(hostile)
            value = flat.reshape(value.shape)
    del file[name]
    file[name] = value


# -- what comes of it --------------------------------------------------------------------------------


def tried(kind: str, seed: int, folder: Path, whole: bytes) -> dict[str, Any]:
    """What the command makes of a case: how it ends, and what is wrong with that."""
    dice = Dice(KINDS.index(kind), seed)
    out, err = io.StringIO(), io.StringIO()
    path = folder / ("case.nc" if kind == "result" else "case.toml")
    path.write_bytes(a_result(whole, dice) if kind == "result" else a_mission(dice))
    if kind == "run" and long(path):
        return {"code": "long", "fault": ""}
    call = {
        "check": ["check", str(path)],
        "run": ["run", str(path), "--no-figures", "--force", "--out", str(folder / "out")],
        "result": dice.one(
            [[]] * 33 + [["replay", str(path), "--force"]] * 6 + [["report", str(path), "--force"]]
        ),
    }[kind]
    from rigidfleet.cli.app import main

    begun = time.process_time()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(call) if call else seen(path, dice)
    except BaseException as error:
        at = traceback.extract_tb(error.__traceback__)[-1]
        fault = f"{type(error).__name__}: {error} ({Path(at.filename).name}:{at.lineno})"[:300]
        return {"code": "raised", "fault": fault, "told": ""}
    took, told, fault = time.process_time() - begun, err.getvalue(), ""
    if code not in (0, 1, 2):
        fault = f"exit code {code}"
    elif "Traceback" in told or "fault of rigidfleet" in told:
        fault = told[-400:]
    elif code == 2 and "error: " not in told:
        fault = "exit code 2 without an error"
    elif took > SECONDS[kind]:
        fault = f"{took:.0f} s"
    return {"code": code, "fault": fault, "told": told[:200]}


def seen(path: Path, dice: Dice) -> int:
    """Judge a result and draw one of its figures, as `report` would all of them; the exit code that it would have."""
    from rigidfleet.assessment import assess
    from rigidfleet.errors import ResultError
    from rigidfleet.plotting import figure_names, plot
    from rigidfleet.result import Result

    try:
        result = Result.load(path)
        verdict = assess(result)
    except ResultError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    verdict.json()
    result.to_csv(path.with_suffix(".csv"))
    names = figure_names(result)
    plot(result, path.parent / "figures", names=[dice.one(names)], formats=["png"])
    return 0 if verdict.passed else 1


def long(path: Path) -> bool:
    """Whether a mission is right, and takes long to fly."""
    from rigidfleet.errors import MissionError
    from rigidfleet.mission import load_mission

    try:
        found = load_mission(path)
    except MissionError:
        return False
    return found.latest_end > LONGEST or found.n_agents > MOST


def a_flight(folder: Path) -> bytes:
    """A result that is right."""
    from rigidfleet.mission import Mission, mission_text
    from rigidfleet.simulation.flight import simulate

    data = tomllib.loads(mission_text("narrow-passage"))
    data["output_step"] = 1.0
    simulate(Mission.from_dict(data)).save(folder / "whole.nc")
    return (folder / "whole.nc").read_bytes()


def work(kind: str, first: int, count: int, whole: Path | None) -> None:
    """Try cases one after the other, a line for each."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    warnings.simplefilter("ignore")

    from rigidfleet.planning import tolerances

    # A phase may take only so many steps, that a case takes a second and no minute.
    vars(tolerances).update(_STALLED=3000, _STALLED_RATE=0.0)
    faulthandler.register(signal.SIGPROF, chain=True)  # says where it was, and ends it
    seconds = float(os.environ.get("MUTATIONS_SECONDS", SECONDS[kind]))
    lines = os.fdopen(os.dup(1), "w", buffering=1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        flight = b"" if whole is None else whole.read_bytes()
        for seed in range(first, first + count):
            lines.write(json.dumps({"seed": seed}) + "\n")
            # By the processor's time, as other programs may be at work; by the clock, as a case may wait for nothing.
            signal.setitimer(signal.ITIMER_PROF, seconds)
            faulthandler.dump_traceback_later(_WAIT * seconds, exit=True)
            found = tried(kind, seed, folder, flight)
            faulthandler.cancel_dump_traceback_later()
            signal.setitimer(signal.ITIMER_PROF, 0)
            lines.write(json.dumps({"seed": seed} | found) + "\n")


def attack(
    kind: str, first: int, count: int, whole: Path | None = None
) -> Iterator[dict[str, Any]]:
    """What came of each case; one that hangs or kills the process has the end of what it said as its fault."""
    seed = first
    while seed < first + count:
        command = [
            sys.executable,
            __file__,
            kind,
            str(seed),
            str(first + count - seed),
            str(whole or ""),
        ]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, errors="replace"
        )
        for line in done.stdout.splitlines():
            said = json.loads(line)
            seed = said["seed"]
            if "code" in said:
                yield said
                seed += 1
        if done.returncode:
            end = done.stderr.strip()[:1500]
            yield {
                "seed": seed,
                "code": done.returncode,
                "fault": f"died ({done.returncode}): {end}",
            }
            seed += 1


if __name__ == "__main__":
    asked, begin, cases, flown = sys.argv[1:5]
    work(asked, int(begin), int(cases), Path(flown) if flown else None)
