"""Flights that are known, files that say them in other ways or say something else, and what `assess` makes of each.

`python tests/door.py --seed 1 --count 2000` writes so many mutants of tables and folders, each by a seed of its own,
gives them to the command in this process, and prints a table by operator. `--show K` prints a mutant with its files.

The maker of a mutant knows what it means. A mutant *keeps* the meaning of its original: the verdict and the numbers are
the same. Or it *changes* it, or leaves it in doubt: then it is judged as changed, refused for the true cause, or a note
beside the verdict names the doubt. The worst is a flight that fails as its maker meant it, and that passes in silence.

Positions are integers of micrometres and times of microseconds until they are written, so that no unit rounds them.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import csv
import inspect
import io
import itertools
import json
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from rigidfleet.cli.app import main as command
from rigidfleet.cli.assess import assess

#: Greatest difference of a number that is the same, in m and m/s, and as a share of it.
SAME = 1e-6
#: Share of the mutants that keep the meaning and must be read as the original.
KEPT = 0.95
#: Number of originals.
ORIGINALS = 48
POSITION = ("x", "y", "z")


# -- flights ---------------------------------------------------------------------------------------


class Numbers(NamedTuple):
    """Least distance of two vehicles [m], and greatest speed [m/s]."""

    separation: float
    speed: float

    def near(self, other: Numbers) -> bool:
        """Whether the numbers are the same."""
        return bool(np.allclose(self, other, rtol=SAME, atol=SAME))


@dataclass
class Flight:
    """A flight as its samples [us, um, urad], how it is written, and what it is judged by."""

    kind: str
    names: list[str]
    times: list[np.ndarray]
    places: list[np.ndarray]
    meeting: float
    pair: tuple[int, int]
    yaws: list[np.ndarray] | None = None
    velocities: list[np.ndarray] | None = None
    folder: bool = False
    staggered: bool = False
    blocks: bool = False
    units: str = ""
    words: dict[str, str] = field(default_factory=dict)
    separation: float = 0.0
    speed: float = 0.0
    limited: bool = True
    numbers: Numbers = field(default_factory=lambda: Numbers(0.0, 0.0))

    @property
    def fails(self) -> bool:
        """Whether the flight fails, as its maker meant it."""
        return self.failing(self.numbers)

    def failing(self, numbers: Numbers, margin: float = 1.0) -> bool:
        """Whether these numbers fail, with a margin on the separation."""
        fast = self.limited and numbers.speed > self.speed
        return fast or numbers.separation < margin * self.separation

    @property
    def bounds(self) -> list[str]:
        """The bounds on the command line."""
        speed = ["--limits", f"speed={self.speed:g}"] if self.limited else []
        return ["--separation", f"{self.separation:g}", *speed]


def measure(
    times: Sequence[np.ndarray], places: Sequence[np.ndarray], *, stand: bool = False
) -> Numbers:
    """The numbers of cubic splines through samples [us, um], of each pair where both have data.

    A vehicle may `stand` at its first and last place before and after it has data.
    """
    splines = [CubicSpline(t / 1e6, r / 1e6) for t, r in zip(times, places, strict=True)]
    nearest, fastest = np.inf, 0.0

    def least(way: Callable[[Any], Any], knots: np.ndarray) -> float:
        t = np.unique(np.concatenate([np.linspace(a, b, 30) for a, b in itertools.pairwise(knots)]))
        d = way(t)
        low = np.flatnonzero((d[1:-1] <= d[:-2]) & (d[1:-1] <= d[2:])) + 1
        best = float(d.min())
        for k in low[np.argsort(d[low])][:4]:
            found = minimize_scalar(
                way, bounds=(t[k - 1], t[k + 1]), method="bounded", options={"xatol": 1e-11}
            )
            best = min(best, float(found.fun))
        return best

    for i, a in enumerate(splines):
        v = a.derivative()
        fastest = max(fastest, -least(lambda t, v=v: -np.linalg.norm(v(t), axis=-1), a.x))
        for b in splines[:i]:
            knots = np.union1d(a.x, b.x)
            if not stand:
                knots = knots[(knots >= max(a.x[0], b.x[0])) & (knots <= min(a.x[-1], b.x[-1]))]
            if len(knots) > 1:

                def apart(t: Any, a: Any = a, b: Any = b) -> Any:
                    r, s = (x(np.clip(t, x.x[0], x.x[-1])) for x in (a, b))
                    return np.linalg.norm(r - s, axis=-1)

                nearest = min(nearest, least(apart, knots))
    return Numbers(nearest, fastest)


def micro(x: np.ndarray) -> np.ndarray:
    return np.rint(np.asarray(x) * 1e6).astype(np.int64)


def fly(seed: Sequence[int], k: int) -> Flight:
    """The k-th original: vehicles that begin and end at rest and come nearest, and are fastest, on the way."""
    kind = ("safe", "collide", "fast", "collide")[k % 4]
    for attempt in range(100):
        flight = _drawn(np.random.default_rng([*seed, k, attempt]), kind, slow=k % 8 in (0, 5, 6))
        flight.folder, flight.staggered = k // 4 % 3 == 2, k // 4 % 2 == 1
        if flight.staggered:
            _expand_stagger(flight)
        flight.numbers = measure(flight.times, flight.places)
        inner = measure([t[3:-3] for t in flight.times], [r[3:-3] for r in flight.places])
        near = flight.numbers.separation
        if inner.near(flight.numbers) and (near < 0.3 if kind == "collide" else near > 0.8):
            flight.separation = round(0.5 if kind == "collide" else 0.7 * near, 3)
            flight.speed = round((0.7 if kind == "fast" else 1.2) * flight.numbers.speed, 4)
            return flight
    raise AssertionError("no such flight")


def _expand_stagger(flight: Flight) -> None:
    """Give vehicles stamps of their own, within a step of each other; the ways are those through the new samples."""
    for i in range(len(flight.names)):
        by = int(np.diff(flight.times[i])[0]) * i // len(flight.names)
        flight.times[i] = flight.times[i] + by


def _drawn(rng: np.random.Generator, kind: str, *, slow: bool) -> Flight:
    """Smooth ways of 2 to 5 vehicles, of which two meet where they collide."""
    n, step = int(rng.integers(2, 6)), float(rng.choice([0.1, 0.12, 0.2]))
    count = int(rng.integers(60, 100))
    end = step * count
    base = 5.0 * np.array([(i % 3, i // 3, 0.0) for i in range(n)]) + rng.uniform(-0.5, 0.5, (n, 3))
    drift, size = rng.uniform(-6, 6, 3) * [1, 1, 0.2], rng.uniform(0.2, 0.8, (n, 3))
    turns, phase = rng.uniform(0.5, 1.5, (n, 3)), rng.uniform(0, 6.28, (n, 3))
    i, j = (int(x) for x in rng.choice(n, 2, replace=False))
    meeting, wide = float(rng.uniform(0.3, 0.7)) * end, float(rng.uniform(0.7, 1.2))
    aside = rng.normal(size=3)
    aside *= rng.uniform(0, 0.08) / np.linalg.norm(aside)

    def way(who: int, t: np.ndarray) -> np.ndarray:
        u = t / end
        s = (u**3 * (10 - 15 * u + 6 * u * u))[:, None]
        wave = size[who] * np.sin(2 * np.pi * turns[who] * s + phase[who])
        return base[who] * (1.0 + 0.6 * (1 - 4 * s * (1 - s))) + drift * s + wave + [0, 0, 8]

    t, at = step * np.arange(count + 1), np.array([meeting])
    places = [way(who, t) for who in range(n)]
    if kind == "collide":
        bump = np.exp(-(((t - meeting) / wide) ** 2))
        places[j] += (way(i, at) - way(j, at) + aside) * bump[:, None]
    slower = 8 if slow else 1
    times, whole = [micro(t) * slower] * n, [micro(r) for r in places]
    flight = Flight(kind, [], times, whole, meeting * slower, (min(i, j), max(i, j)))
    flight.blocks = bool(rng.integers(2))
    flight.limited = kind == "fast" or bool(rng.integers(2))
    flight.units = ("", "_", "[]")[int(rng.integers(3))]
    style = int(rng.integers(3))
    flight.names = [(f"{i + 1}", "abcde"[i], f"cf{i + 1}")[style] for i in range(n)]
    flight.words = {
        "time": str(rng.choice(["time", "t", "timestamp"])),
        "who": str(rng.choice(["agent", "id", "drone", "vehicle", "name"])),
        "p": str(rng.choice(["", "p"])),
    }
    if rng.integers(2):
        flight.yaws = [micro(0.6 * t + rng.uniform(0, 1)) for _ in range(n)]
    if rng.integers(2):
        flight.velocities = [
            micro(CubicSpline(x / 1e6, r / 1e6)(x / 1e6, 1))
            for x, r in zip(times, whole, strict=True)
        ]
    return flight


# -- files -----------------------------------------------------------------------------------------


def decimal(value: Any, power: int = -6) -> str:
    """An integer times a power of ten, exactly."""
    return format(Decimal(int(value)).scaleb(power), "f")


@dataclass
class Sheet:
    """A table: the name of each column by its role, and rows of texts by role."""

    columns: dict[str, str]
    rows: list[dict[str, Any]]

    def add(self, role: str, name: str, values: Sequence[Any], place: int | None = None) -> None:
        """Add a column, by default behind the others."""
        roles = list(self.columns)
        roles.insert(len(roles) if place is None else place, role)
        self.columns = {key: self.columns.get(key, name) for key in roles}
        for row, value in zip(self.rows, values, strict=True):
            row[role] = str(value)

    def drop(self, *roles: str) -> None:
        for role in roles:
            self.columns.pop(role, None)

    def table(self) -> list[list[str]]:
        """The names and the rows, as texts."""
        return [
            list(self.columns.values()),
            *([row[role] for role in self.columns] for row in self.rows),
        ]

    def text(self, separator: str = ",", **how: Any) -> str:
        """The table as the standard writer of CSV writes it."""
        out = io.StringIO()
        csv.writer(out, delimiter=separator, lineterminator="\n", **how).writerows(self.table())
        return out.getvalue()


def unit_of(name: str, unit: str, style: str) -> str:
    """A name with its unit."""
    return {
        "": name,
        "_": f"{name}_{unit}",
        "[]": f"{name} [{unit}]",
        "()": f"{name} ({unit})",
        "/": f"{name}/{unit}",
    }[style]


class Scale(NamedTuple):
    """A power of ten from s, m or rad to the unit in which a quantity is written."""

    unit: str
    power: int


METRES, SECONDS = Scale("m", -6), Scale("s", -6)


def sheets(
    flight: Flight,
    *,
    length: Scale = METRES,
    clock: Scale = SECONDS,
    style: str | None = None,
    named: bool = True,
) -> dict[str, Sheet]:
    """The files of a flight."""
    style = flight.units if style is None else style
    words, p = flight.words, flight.words["p"]
    columns = {"time": unit_of(words["time"], clock.unit, style if named else "")}
    if not flight.folder:
        columns["who"] = words["who"]
    columns |= {axis: unit_of(p + axis, length.unit, style if named else "") for axis in POSITION}
    if flight.velocities is not None and length.unit == "m" and clock.unit == "s":
        columns |= {f"v{axis}": f"v{axis}" for axis in POSITION}
    if flight.yaws is not None:
        columns["yaw"] = unit_of("yaw", "rad", style)
    found = {}
    for i, name in enumerate(flight.names):
        rows = []
        for k, t in enumerate(flight.times[i]):
            row = {"time": decimal(t, clock.power), "who": name, "at": int(t)}
            for a, axis in enumerate(POSITION):
                row[axis] = decimal(flight.places[i][k, a], length.power)
                if flight.velocities is not None:
                    row[f"v{axis}"] = decimal(flight.velocities[i][k, a])
            if flight.yaws is not None:
                row["yaw"] = decimal(flight.yaws[i][k])
            rows.append(row)
        found[f"{name}.csv"] = Sheet(dict(columns), rows)
    if flight.folder:
        return found
    rows = [row for sheet in found.values() for row in sheet.rows]
    if not flight.blocks:
        rows.sort(key=lambda row: row["at"])
    return {"flight.csv": Sheet(dict(columns), rows)}


# -- what comes of them ----------------------------------------------------------------------------


class Outcome(NamedTuple):
    """What the command made of files: its code, verdict and errors."""

    code: int
    verdict: dict[str, Any]
    error: str

    @property
    def numbers(self) -> Numbers:
        worst = {check["check"]: check["worst"] for check in self.verdict.get("checks", [])}
        return Numbers(*(np.nan if worst.get(q) is None else worst[q] for q in Numbers._fields))

    @property
    def unjudged(self) -> str:
        """What the verdict says of a separation that it could not judge; "" if it could."""
        checks = self.verdict.get("checks", [])
        return " ".join(
            c["message"]
            for c in checks
            if c["check"] == "separation" and c["worst"] is None and not c["passed"]
        )


@dataclass
class Mutant:
    """Files, and what they mean."""

    variant: str
    files: dict[str, bytes]
    keeps: bool
    cause: str = ""
    #: What the files say, where it is not what the original says; NaN where only the verdict is known.
    means: Numbers | None = None
    #: What is judged beside a note.
    beside: Numbers | None = None
    #: Whether the files' maker meant a flight that fails.
    fails: bool = False
    #: Whether each reading of the files fails, so that no note excuses a pass.
    surely: bool = False
    #: Whether only a refusal or a note will do.
    doubtful: bool = False
    options: list[str] = field(default_factory=list)
    target: list[str] = field(default_factory=lambda: ["."])


def has_option(name: str) -> bool:
    """Whether `assess` has an option; older versions lack some."""
    return name in inspect.signature(assess).parameters


def judge(files: dict[str, bytes], target: Sequence[str], options: Sequence[str]) -> Outcome:
    """What `assess` makes of files in a folder."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "flight"
        folder.mkdir()
        for name, data in files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        out, err = io.TextIOWrapper(io.BytesIO(), encoding="utf-8"), io.StringIO()
        options = [str(folder / o[1:]) if o.startswith("@") else o for o in options]
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = command(["assess", *(str(folder / name) for name in target), *options, "--json"])
        out.flush()
        buffer = out.buffer
        assert isinstance(buffer, io.BytesIO)
        said = buffer.getvalue().decode()
        brace = said.find("{")
        return Outcome(
            code, json.loads(said[brace:]) if code < 2 else {}, err.getvalue().replace(made, "")
        )


#: Notes that each flight of others has.
USUAL = (
    r"^(others made this flight|the least distance centre to centre|agents? (from 1 on are|1 is)|the velocities of the"
    r" table).*"
    r"|A table may name other units.*"
)
#: What doubts a unit or an axis, in notes that an original without units has, too.
DOUBT = (
    r"no unit|without (a |any )?unit|may be|not name|unnamed|taken (as|for|to be)|are these|assum|doubt|say so|if not|"
    r"|--units|--axes"
)


#: What says that vehicles have data at other times.
SPAN = r"\bspan|\bbegins?\b|\bends?\b|later|earlier|until|no data|without data|have data|stands?\b|stays|away"


def plain(note: str) -> str:
    return re.sub(r"[-+]?[\d.]+(e[-+]?\d+)?", "0", note)


def grade(mutant: Mutant, original: Outcome, outcome: Outcome) -> str:
    """same, changed, refused or noted; or what is wrong: crash, cause, numbers, silent."""
    cause = re.compile(mutant.cause, re.IGNORECASE)
    if outcome.code >= 2:
        if "this is a bug" in outcome.error or "Traceback" in outcome.error:
            return "crash"
        return "refused" if mutant.cause and cause.search(outcome.error) else "cause"
    if mutant.surely and outcome.code == 0:
        return "silent"
    # Where times are in doubt, a note with other times is another note.
    told = str if mutant.cause.startswith(SPAN) else plain
    known = {told(note) for note in original.verdict["notes"]}
    notes = [
        said
        for note in outcome.verdict["notes"]
        if (said := re.sub(USUAL, "", note))
        and (told(note) not in known or re.search(DOUBT, note, re.IGNORECASE))
    ]
    noted = bool(mutant.cause) and any(cause.search(note) for note in notes)
    if not mutant.doubtful:
        if (
            mutant.means is None
            and outcome.code == original.code
            and outcome.numbers.near(original.numbers)
        ):
            return "same"
        if (
            mutant.means is not None
            and outcome.code == (mutant.surely or mutant.fails)
            and (np.isnan(mutant.means.separation) or outcome.numbers.near(mutant.means))
        ):
            return "changed"
    right = mutant.beside is None or (
        outcome.code == mutant.surely and outcome.numbers.near(mutant.beside)
    )
    if noted and right:
        return "noted"
    if mutant.cause and outcome.unjudged and cause.search(outcome.unjudged):
        return "refused"
    return "silent" if outcome.code == 0 and mutant.fails else "numbers"


# -- operators -------------------------------------------------------------------------------------

Maker = Callable[[np.random.Generator, Flight], Mutant]
#: Each with what it asks of an original.
OPERATORS: dict[str, tuple[Callable[[Flight], bool], Maker]] = {}


def operator(wish: Callable[[Flight], bool] = lambda _: True) -> Callable[[Any], Maker]:
    """Register an operator by its name."""

    def put(make: Any) -> Maker:
        OPERATORS[make.__name__] = wish, make
        return make

    return put


def pick(rng: np.random.Generator, among: Sequence[Any]) -> Any:
    return among[int(rng.integers(len(among)))]


def written(
    flight: Flight,
    variant: str,
    files: dict[str, Sheet] | dict[str, str] | dict[str, bytes],
    *,
    keeps: bool,
    **more: Any,
) -> Mutant:
    """A mutant of files as tables, texts or bytes."""
    data = {}
    for name, x in files.items():
        text = x.text() if isinstance(x, Sheet) else x
        data[name] = text.encode() if isinstance(text, str) else text
    if "target" not in more and not flight.folder and len(data) == 1:
        more["target"] = list(data)
    options = [*more.pop("options", flight.bounds)]
    more.setdefault("fails", flight.fails)
    return Mutant(variant, data, keeps, options=options, **more)


def alike(flight: Flight, variant: str, files: Any, **more: Any) -> Mutant:
    """A mutant that keeps the meaning."""
    return written(flight, variant, files, keeps=True, **more)


def unlike(flight: Flight, variant: str, files: Any, cause: str, **more: Any) -> Mutant:
    """A mutant that changes the meaning or leaves it in doubt, for a cause."""
    return written(flight, variant, files, keeps=False, cause=cause, **more)


def in_table(flight: Flight) -> bool:
    return not flight.folder


def in_folder(flight: Flight) -> bool:
    return flight.folder


IDENTITIES = [
    "uav", "UAV", "uav_id", "drone_id", "robot", "robot_id", "vehicle_id", "agent_id", "aircraft", "callsign", "body",
    "rigid_body", "tracker", "object", "object_id", "label", "node", "cf", "quad", "quadrotor", "platform", "entity",
    "Drone ID", "vehicle name", "member", "namespace", "child_frame_id", "tail", "icao24", "droneName", "marker",
    "sysid", "system_id", "track_id", "target", "ship", "kite", "who", "nom", "Kennung", "No", "number", "key", "tag"
]  # fmt: skip


@operator(in_table)
def rename(rng: np.random.Generator, flight: Flight) -> Mutant:
    """Other words for identity, time and place."""
    made = sheets(flight)
    sheet = made["flight.csv"]
    variant = pick(rng, ["identity", "identity", "time", "position", "all"])
    if variant in ("identity", "all"):
        sheet.columns["who"] = pick(rng, IDENTITIES)
    if variant in ("time", "all"):
        sheet.columns["time"] = pick(
            rng, ["Time", "stamp", "seconds", "time_sec", "t_s", "elapsed", "elapsed_s", "sim_time", "secs", "TIME (s)",
                  "header.stamp", "Time [s]"]
        )  # fmt: skip
    if variant in ("position", "all"):
        style = pick(
            rng, ["pos_{}", "position_{}", "position.{}", "pose.position.{}", "{}_pos", "{}_position", "p_{}", "pos {}",
                  "t{}", "loc_{}", "{}coord", "/pose/{}", "{}_world", "P{}", "{} "]
        )  # fmt: skip
        sheet.columns |= {axis: style.format(axis) for axis in POSITION}
    # A word that nobody knows is told by the data alone, where times go back or repeat.
    keeps = variant == "identity" and (flight.blocks or not flight.staggered)
    return written(
        flight,
        f"{variant} {sheet.columns['who']}" if variant == "identity" else variant,
        made,
        keeps=keeps,
        cause=r"column|identity|vehicle",
    )


@operator()
def permute(rng: np.random.Generator, flight: Flight) -> Mutant:
    """Columns and rows in other orders; vehicles beside each other instead of below."""
    made = sheets(flight)
    ways = ["columns", "vehicles", "rows", "reverse"]
    if not flight.folder and not flight.staggered:
        ways += ["wide"] * 3
    variant = pick(rng, ways)
    if variant == "wide":
        return _wide(rng, flight)
    for sheet in made.values():
        if variant == "columns":
            roles = list(sheet.columns)
            rng.shuffle(roles)
            sheet.columns = {role: sheet.columns[role] for role in roles}
        elif variant == "vehicles":
            order = {name: k for k, name in enumerate(rng.permutation(flight.names))}
            sheet.rows.sort(key=lambda row: order[row["who"]])
        elif variant == "rows":
            sheet.rows = [sheet.rows[k] for k in rng.permutation(len(sheet.rows))]
        else:
            sheet.rows.reverse()
    keeps = variant in ("columns", "vehicles")
    return written(flight, variant, made, keeps=keeps, cause=r"time|order|sort")


def _wide(rng: np.random.Generator, flight: Flight) -> Mutant:
    """The columns of each vehicle beside those of the others."""
    style = pick(
        rng, ["{axis}{i}", "{axis}_{i}", "{axis}.{k}", "{axis}_{name}", "{name}_{axis}", "{name}.{axis}", "{axis}"]
    )  # fmt: skip
    plainly = rng.integers(2)  # the first vehicle's have no number
    who = flight.names
    if rng.integers(3) == 0:
        who = rng.permutation(
            ["v", "w", "p", "q", "j", "r", "ref", "alpha", "cf12", "drone", "red", "s"]
        )
    names = [flight.words["time"]]
    for k, name in enumerate(who[: len(flight.names)]):
        own = "{axis}" if plainly and k == 0 else style
        names += [own.format(axis=axis, i=k + 1, k=k, name=name) for axis in POSITION]
    lines = [",".join(names)]
    for k, t in enumerate(flight.times[0]):
        values = [decimal(x) for place in flight.places for x in place[k]]
        lines.append(",".join([decimal(t), *values]))
    return unlike(
        flight,
        f"wide {style}" + (" plainly" if plainly else ""),
        {"flight.csv": "\n".join(lines) + "\n"},
        r"column|vehicle|two",
    )


@operator()
def drop(rng: np.random.Generator, flight: Flight) -> Mutant:
    """A column is missing, its name is, or all names are."""
    made = sheets(flight)
    ways = ["needed", "spare", "name", "names"] + (["identity"] * 3 + ["merged"]) * (
        not flight.folder
    )
    variant = pick(rng, ways)
    hit = list(made.values()) if rng.integers(2) else [pick(rng, list(made.values()))]
    if variant == "names":
        texts = {name: sheet.text() for name, sheet in made.items()}
        for name, sheet in made.items():
            if sheet in hit:
                texts[name] = texts[name].split("\n", 1)[1]
        return unlike(flight, variant, texts, r"names|header|column")
    if variant == "name":
        texts = {name: sheet.text() for name, sheet in made.items()}
        for name, sheet in made.items():
            if sheet in hit:
                head, rest = texts[name].split("\n", 1)
                texts[name] = ",".join(head.split(",")[:-1]) + "\n" + rest
        return unlike(flight, variant, texts, r"fields|names|column")
    if variant == "needed":
        role = pick(rng, ["time", *POSITION])
        for sheet in hit:
            sheet.drop(role)
        return unlike(
            flight,
            f"needed {role}",
            made,
            rf"no column.*\b{role}\b|column.*\b{role}\b",
            doubtful=True,
        )
    if variant == "merged":
        before = ""
        for row in made["flight.csv"].rows:
            row["who"], before = "" if row["who"] == before else row["who"], row["who"]
        return unlike(flight, variant, made, r"vehicle|identity|agent|empty|the time")
    if variant == "identity":
        made["flight.csv"].drop("who")
        return unlike(
            flight,
            "identity staggered" if flight.staggered and not flight.blocks else "identity",
            made,
            r"vehicle|identity|agent|the time .* (repeats|goes back)",
        )
    for sheet in hit:
        sheet.drop("yaw", *pick(rng, [["vx"], ["vx", "vy", "vz"], ["vz"]]))
    return alike(flight, variant, made)


@operator()
def duplicate(rng: np.random.Generator, flight: Flight) -> Mutant:
    """Columns, rows and files that are there twice."""
    made = sheets(flight)
    sheet = pick(rng, list(made.values()))
    ways = ["column", "other column", "clock", "reference", "rows", "other rows", "names"]
    ways += ["file"] if flight.folder else ["team", "team"]
    variant = pick(rng, ways)
    two = r"two|twice|double|again|duplicate|repeat|both|column"
    if variant == "column":
        role = pick(rng, ["time", *POSITION])
        sheet.add("again", sheet.columns[role], [row[role] for row in sheet.rows])
        return unlike(flight, variant, made, two)
    if variant == "other column":
        role = pick(rng, list(POSITION))
        further = [decimal(x) for x in micro(rng.uniform(-5, 5, len(sheet.rows)))]
        sheet.add("again", sheet.columns[role], further, int(rng.integers(len(sheet.columns))))
        return unlike(flight, variant, made, two)
    if variant == "clock":
        began, words = 1_714_564_800_000_000, ["timestamp", "time_ns", "stamp", "t"]
        name = pick(rng, [x for x in words if x != flight.words["time"]])
        for each in made.values():
            stamps = [decimal(began + row["at"], 3) for row in each.rows]
            each.add("again", name, stamps, int(rng.integers(2)))
        return unlike(flight, variant, made, two)
    if variant == "reference":
        style = pick(rng, ["{}_ref", "{}_des", "ref_{}", "{}_std", "d{}", "{}_raw"])
        for each in made.values():
            for axis in POSITION:
                further = [decimal(x) for x in micro(rng.uniform(-5, 5, len(each.rows)))]
                each.add(style.format(axis), style.format(axis), further)
        return alike(flight, f"reference {style}", made)
    if variant == "team":
        kept = made["flight.csv"]
        kept.columns["who"] = pick(rng, ["drone_id", "uav", "robot", "callsign", "body", "member"])
        value = pick(rng, ["1", "blue", "swarm"])
        kept.add("team", pick(rng, ["agent", "name", "vehicle"]), [value] * len(kept.rows), 1)
        return unlike(flight, variant, made, two + r"|vehicle|identity")
    if variant == "rows":
        hit = set(rng.choice(len(sheet.rows), 6, replace=False).tolist())
        sheet.rows = [r for k, r in enumerate(sheet.rows) for _ in range(1 + (k in hit))]
        return unlike(flight, variant, made, two)
    if variant == "other rows":
        k = int(rng.integers(len(sheet.rows)))
        sheet.rows.insert(k, sheet.rows[k] | {"x": decimal(rng.integers(10**7))})
        return unlike(flight, variant, made, two, doubtful=True)
    if variant == "names":
        k = int(rng.integers(1, len(sheet.rows)))
        sheet.rows.insert(k, dict(sheet.columns))
        return unlike(flight, variant, made, r"not a (finite )?number|names|header")
    name = pick(rng, list(made))
    copied = name.replace(".csv", pick(rng, [" (copy).csv", "_2.csv", "-copy.csv"]))
    means = Numbers(0.0, flight.numbers.speed)
    both = {**made, copied: made[name]}
    return unlike(flight, variant, both, two, means=means, fails=True, surely=True)


SCALES = {"mm": 3, "cm": 2, "km": -3, "um": 6, "dm": 1}
UNIT = r"unit|metre|millimet|\bmm\b|\bcm\b"


@operator()
def length(rng: np.random.Generator, flight: Flight) -> Mutant:
    """Other units of length, with their names and without."""
    variant = pick(rng, ["named", "named", "mixed", "bare", "bare", "feet", "option", "row"])
    unit = pick(rng, ["mm", "cm"] if variant in ("mixed", "option") else ["mm", "cm", "km"])
    style = pick(rng, ["_", "[]", "()"])
    scale = Scale(unit, -6 + SCALES[unit])
    if variant == "named":
        return alike(flight, f"named {style} {unit}", sheets(flight, length=scale, style=style))
    if variant == "mixed":
        made, other = sheets(flight, length=scale, style=style), sheets(flight, style=style)
        role = pick(rng, POSITION)
        for name, sheet in made.items():
            sheet.columns[role] = other[name].columns[role]
            for row, own in zip(sheet.rows, other[name].rows, strict=True):
                row[role] = own[role]
        return alike(flight, f"mixed {style} {unit}", made)
    if variant == "feet":
        named = rng.integers(2)
        foot = pick(rng, [("ft", 0.3048), ("in", 0.0254)])
        made = sheets(flight, length=Scale(foot[0], 0), style=style, named=bool(named))
        for sheet in made.values():
            for row in sheet.rows:
                row |= {axis: f"{int(row[axis]) / 1e6 / foot[1]:.12f}" for axis in POSITION}
        return unlike(
            flight,
            f"{'named' if named else 'bare'} {foot[0]}",
            made,
            UNIT + r"|\bft\b|\bin\b|no column",
            doubtful=not named,
        )
    made = sheets(flight, length=scale, named=False)
    if variant == "option" and has_option("units"):
        options = [*flight.bounds, "--units", unit]
        return alike(flight, f"option {unit}", made, options=options)
    if variant == "row":
        for sheet in made.values():
            units = {"time": "s", "who": "-", "yaw": "rad"} | dict.fromkeys(POSITION, unit)
            units |= {f"v{axis}": "m/s" for axis in POSITION}
            sheet.rows.insert(0, units)
        return unlike(flight, "row of units", made, UNIT + r"|not a (finite )?number|line 2")
    return unlike(flight, f"bare {unit}", made, UNIT, doubtful=True)


CLOCKS = {"ms": 3, "us": 6, "ns": 9}
TIME = r"unit|millisecond|second|1970|\bms\b|\bns\b|\bus\b"


@operator()
def clock(rng: np.random.Generator, flight: Flight) -> Mutant:
    """Other units of time, dates, and seconds of another age."""
    variant = pick(
        rng, ["named", "named", "bare", "bare", "minutes", "pair", "date", "date", "epoch", "option", "hours"]
    )  # fmt: skip
    unit, style = pick(rng, list(CLOCKS)), pick(rng, ["_", "[]", "()"])
    scale, began = Scale(unit, -6 + CLOCKS[unit]), 1_714_564_800_000_000
    if variant == "named":
        since = pick(rng, [0, 0, began])
        made = sheets(flight, clock=scale, style=style)
        for sheet in made.values():
            for row in sheet.rows:
                row["time"] = decimal(row["at"] + since, scale.power)
        which = "epoch " if since else ""
        return alike(flight, f"named {which}{style} {unit}", made)
    if variant in ("bare", "option"):
        made = sheets(flight, clock=scale, named=False)
        if variant == "option" and has_option("units"):
            options = [*flight.bounds, "--units", unit]
            return alike(flight, f"option {unit}", made, options=options)
        return unlike(flight, f"bare {unit}", made, TIME, doubtful=True)
    made = sheets(flight, style="")
    for sheet in made.values():
        if variant == "minutes":
            sheet.columns["time"] = unit_of("time", "min", style)
        elif variant == "pair":
            sheet.columns["time"] = "sec"
            late = [decimal(row["at"] % 10**6, 3) for row in sheet.rows]
            sheet.add("nanosec", pick(rng, ["nanosec", "nsec", "nsecs"]), late, 1)
        for row in sheet.rows:
            t = int(row["at"])
            if variant == "minutes":
                row["time"] = f"{t / 6e7:.14f}"
            elif variant == "pair":
                row["time"] = str(t // 10**6)
            elif variant == "epoch":
                row["time"] = decimal(t + began)
            else:
                instant = np.datetime64(began + t, "us")
                row["time"] = str(instant)
    if variant == "date":
        how = pick(rng, ["{}", "{}Z", "{}+00:00", "blank"])
        for sheet in made.values():
            for row in sheet.rows:
                t = row["time"]
                row["time"] = t.replace("T", " ") if how == "blank" else how.format(t)
        return alike(flight, f"date {how}", made)
    if variant == "hours":
        for sheet in made.values():
            for row in sheet.rows:
                row["time"] = row["time"].split("T")[1]
        return unlike(flight, variant, made, TIME + "|time|not a (finite )?number")
    cause = TIME + (r"|no column for time|nanosec|nsec|repeat" if variant == "pair" else "")
    return written(flight, variant, made, keeps=variant == "epoch", cause=cause)


@operator()
def hashes(rng: np.random.Generator, flight: Flight) -> Mutant:
    """`#` in the names of vehicles, in colours, in names of columns, and behind rows."""
    ways = ["colours", "colours", "end of row", "number sign"] + ["names"] * 4 * in_table(flight)
    variant = pick(rng, ways)
    own = copy.deepcopy(flight)
    if variant == "names":
        style = pick(rng, ["#{}", "#{}", "cf#{}", "drone #{}", "{}#"])
        hit = range(len(own.names)) if rng.integers(2) else [int(rng.integers(len(own.names)))]
        for k in hit:
            own.names[k] = style.format(own.names[k])
        made = sheets(own)
        sheet = made["flight.csv"]
        if rng.integers(2):
            sheet.columns = {"who": sheet.columns["who"]} | sheet.columns
        return alike(flight, f"names {style}", made)
    made = sheets(own)
    if variant == "colours":
        where = pick(rng, [0, 1, None])
        for k, sheet in enumerate(made.values()):
            colours = [f"#{0xFF0000 >> 4 * k:06x}"] * len(sheet.rows)
            sheet.add("colour", pick(rng, ["color", "colour", "led"]), colours, where)
        return alike(flight, f"colours {where}", made)
    if variant == "number sign":
        for sheet in made.values():
            sheet.add("row", "#", range(1, len(sheet.rows) + 1), 0)
        return unlike(flight, variant, made, r"#|number|column|names")
    texts = {}
    for name, sheet in made.items():
        lines = sheet.text().splitlines()
        lines[5] += " # take-off"
        texts[name] = "\n".join(lines) + "\n"
    return unlike(flight, variant, texts, r"#|comment|not a (finite )?number")


@operator()
def comments(rng: np.random.Generator, flight: Flight) -> Mutant:
    """Lines before the names, between rows and behind them."""
    variant = pick(
        rng, ["before", "blank", "names", "names", "between", "preamble", "preamble", "marks", "pairs", "foot", "title"]
    )  # fmt: skip
    texts, keeps, cause = {}, variant in ("before", "blank", "names", "between"), ""
    words = pick(
        rng, ["# duration 12 s", "#written by a planner, version 2", "# time, then places", "#", "# a;b\tc"]
    )  # fmt: skip
    mark = pick(rng, ["%", "//", "!", ";", "--"])
    for name, sheet in sheets(flight).items():
        lines = sheet.text().splitlines()
        if variant == "before":
            lines = [words] * int(rng.integers(1, 4)) + lines
        elif variant == "blank":
            lines = [""] * int(rng.integers(1, 3)) + lines
            lines.insert(int(rng.integers(2, len(lines))), pick(rng, ["", "  "]))
        elif variant == "names":
            lines[0] = pick(rng, ["# ", "#"]) + lines[0]
            if rng.integers(2):
                lines = [words, *lines]
        elif variant == "between":
            lines.insert(int(rng.integers(2, len(lines))), words)
        elif variant == "preamble":
            lines = ["robot,one", "frame,cog"][: int(rng.integers(1, 3))] + lines
        elif variant == "marks":
            lines = [f"{mark} written by a planner", *lines]
        elif variant == "pairs":
            lines = ["date: 2024-05-01", "pilot: me", "", *lines]
        elif variant == "title":
            lines = ["Flight log of the evening", *lines]
        else:
            lines.append(pick(rng, ["end of log", "Total: 100", "EOF", '"sum",12']))
        texts[name] = "\n".join(lines) + "\n"
    cause = "" if keeps else r"line \d|names|column|fields|row|comment"
    return written(flight, variant, texts, keeps=keeps, cause=cause)


@operator()
def separators(rng: np.random.Generator, flight: Flight) -> Mutant:
    """Other characters between fields, around them, and at the ends of lines."""
    variant = pick(
        rng, [";", "\t", "blank", "blank", "padded", ", ", "quotes", "crlf", "bom", "trailing", "|", "utf-16", "cr"]
        + ["quoted comma"] * 2 * in_table(flight)
    )  # fmt: skip
    own = copy.deepcopy(flight)
    if variant in ("blank", "padded") and own.units == "[]":
        own.units = "_"  # a name has no blank then
    if variant == "quoted comma":
        own.names = [f"{name}, the {k + 1}th" for k, name in enumerate(own.names)]
    data: dict[str, bytes] = {}
    for name, sheet in sheets(own).items():
        text = sheet.text()
        if variant in (";", "\t", "|"):
            text = sheet.text(variant)
        elif variant == "blank":
            text = sheet.text(" ")
        elif variant == "padded":
            text = "".join("".join(f"{x:>14}" for x in row) + "\n" for row in sheet.table())
        elif variant == ", ":
            text = text.replace(",", ", ")
        elif variant == "quotes":
            text = sheet.text(quoting=csv.QUOTE_ALL)
        elif variant in ("crlf", "cr"):
            text = text.replace("\n", "\r\n" if variant == "crlf" else "\r")
        elif variant == "trailing":
            text = text.replace("\n", ",\n")
        elif variant == "bom":
            text = "\ufeff" + text
        data[name] = text.encode("utf-16" if variant == "utf-16" else "utf-8")
    keeps = variant not in ("|", "utf-16", "cr")
    cause = "" if keeps else r"utf-8|separat|column|control|names|text"
    return written(flight, repr(variant), data, keeps=keeps, cause=cause)


NUMBER = r"decimal|not a (finite )?number|neither a finite number|comma|point"


@operator()
def decimals(rng: np.random.Generator, flight: Flight) -> Mutant:
    """Other ways to write a number."""
    variant = pick(
        rng, ["comma;", "comma\t", "comma blank", "quoted comma", "quoted comma", "comma,comma", "exponent", "plus",
              "bare point", "long", "D", "thousands", "blanks", "underscore", "unit", "minus", "short"]
    )  # fmt: skip
    own = copy.deepcopy(flight)
    if variant == "comma blank" and own.units == "[]":
        own.units = "_"
    made, data = sheets(own), {}
    if variant == "thousands":
        made = sheets(own, length=Scale("mm", -3), style="_")
    for name, sheet in made.items():
        for row in sheet.rows:
            for role in sheet.columns:
                if role == "who":
                    continue
                x = row[role]
                if "comma" in variant:
                    x = x.replace(".", ",")
                elif variant == "exponent":
                    x = f"{float(x):.17e}"
                elif variant == "D":
                    x = f"{float(x):.17e}".replace("e", "D")
                elif variant == "plus":
                    x = x if x.startswith("-") else f"+{x}"
                elif variant == "bare point":
                    x = re.sub(r"^(-?)0\.", r"\1.", x)
                elif variant == "long":
                    x += "000000000000000"
                elif variant == "short":
                    x = x.rstrip("0").rstrip(".")
                elif variant in ("thousands", "blanks", "underscore"):
                    mark = {"thousands": ",", "blanks": " ", "underscore": "_"}[variant]
                    x = f"{Decimal(x):,f}".replace(",", mark)
                    if variant == "underscore" and "_" not in x:
                        x = re.sub(r"(\d)(\d)$", r"\1_\2", x)
                elif variant == "unit" and role in POSITION:
                    x += " m"
                elif variant == "minus":
                    x = x.replace("-", "\u2212")
                row[role] = x
        separator = {"comma;": ";", "comma\t": "\t", "comma blank": " "}.get(variant, ",")
        data[name] = sheet.text(separator)
        if variant == "comma,comma":
            data[name] = data[name].replace('"', "")
    keeps = variant in ("exponent", "plus", "bare point", "long", "short")
    cause = NUMBER + ("|fields" if variant == "comma,comma" else "")
    return written(flight, variant, data, keeps=keeps, cause=cause)


@operator(lambda flight: flight.kind != "fast")
def spans(rng: np.random.Generator, flight: Flight) -> Mutant:
    """One vehicle begins later than the others or ends earlier; it or another one may have few samples."""
    own = copy.deepcopy(flight)
    n = len(own.names)
    i = pick(rng, flight.pair) if flight.kind == "collide" else int(rng.integers(n))
    count = len(own.times[i])
    hides = flight.kind == "collide" and rng.integers(4)
    at = int(np.searchsorted(own.times[i], flight.meeting * 1e6))
    which = "begins" if 2 * at < count else "ends"
    steps = int(pick(rng, [2, 3, 6, 12]))
    if hides:
        steps = min(count - 8, (at if which == "begins" else count - at) + int(rng.integers(6, 12)))
    coarse = pick(rng, ["", "", " beside coarse", " beside coarse", " coarse"])
    if coarse == " beside coarse":
        others = [k for k in range(n) if k != i]
        spare = [k for k in others if k not in flight.pair] or others
        _thin(own, pick(rng, spare), steps + int(rng.integers(1, 5)))
    if coarse == " coarse":
        # Few samples of its own are no licence: it lacks more than one of them.
        stride = max(2, steps // 3)
        steps = steps // stride + 1
        _thin(own, i, stride)
        count = len(own.times[i])
        steps = min(steps, count - 4)
    _keep(own, i, np.arange(steps, count) if which == "begins" else np.arange(count - steps))
    word = pick(rng, ["", "", "stand", "away"]) if has_option("spans") else ""
    numbers = measure(own.times, own.places, stand=word == "stand")
    options = [*flight.bounds, *(["--spans", word] if word else [])]
    return unlike(
        own,
        f"{which}{coarse}{' hides' if hides else ''} {word}".rstrip(),
        sheets(own),
        SPAN,
        doubtful=True,
        beside=numbers if word else None,
        fails=flight.fails,
        surely=own.failing(numbers, 1.0 if word else 0.8),
        options=options,
    )


def _thin(flight: Flight, i: int, stride: int) -> None:
    """Keep a sample of a vehicle in so many, and the last one; which way it turns is not known then."""
    flight.yaws = None
    last = len(flight.times[i]) - 1
    _keep(flight, i, np.unique([*range(0, last - stride, stride), last]))


def _keep(flight: Flight, i: int, kept: np.ndarray) -> None:
    """Keep some samples of a vehicle."""
    for x in (flight.times, flight.places, flight.yaws, flight.velocities):
        if x is not None:
            x[i] = x[i][kept]


@operator(lambda flight: flight.kind != "fast")
def gaps(rng: np.random.Generator, flight: Flight) -> Mutant:
    """Samples are missing on the way, as rows or as numbers; of one vehicle or of all."""
    own = copy.deepcopy(flight)
    n = len(own.names)
    i = pick(rng, flight.pair) if flight.kind == "collide" else int(rng.integers(n))
    everyone = rng.integers(4) == 0
    variant = pick(rng, ["rows", "rows", "rows", "nan", "empty", "frozen"])
    long = bool(rng.integers(3))
    missing = int(rng.integers(13, 25)) if long else int(rng.integers(2, 7))
    middle = int(np.searchsorted(own.times[i], flight.meeting * 1e6))
    if flight.kind == "safe":
        middle = int(rng.integers(missing, len(own.times[i]) - missing))
    first = max(2, middle - missing // 2)
    hit = {k: set(range(first, first + missing)) for k in (range(n) if everyone else [i])}
    word = f"{variant} {'long' if long else 'short'}{' all' if everyone else ''}"
    cause = r"\bgaps?\b|without data|no data|no sample|bridge|missing|not a (finite )?number|empty"
    rest = copy.deepcopy(own)
    for k, out in hit.items():
        _keep(rest, k, np.array([m for m in range(len(own.times[k])) if m not in out]))
    numbers = measure(rest.times, rest.places)
    if variant == "frozen":
        for k, out in hit.items():
            own.places[k][sorted(out)] = own.places[k][first - 1]
        cause = r"frozen|repeat|same (place|position)|still|stands"
        numbers = measure(own.times, own.places)
        sure = own.failing(numbers)
        more = {
            "doubtful": long and not sure,
            "means": numbers,
            "fails": flight.fails if long else sure,
            "surely": sure,
        }
        return unlike(own, f"frozen {'long' if long else 'short'}", sheets(own), cause, **more)
    if variant != "rows":
        made = sheets(own)
        text = "nan" if variant == "nan" else ""
        stamps = {(own.names[k], int(own.times[k][m])) for k, out in hit.items() for m in out}
        for sheet in made.values():
            for row in sheet.rows:
                if (row["who"], row["at"]) in stamps:
                    row.update(dict.fromkeys(POSITION, text))
        sure = own.failing(numbers)
        return unlike(
            own, word, made, cause, doubtful=True, beside=numbers, fails=own.fails, surely=sure
        )
    bridge = long and has_option("gaps") and bool(rng.integers(2))
    return unlike(
        own,
        word + " bridge" * bridge,
        sheets(rest),
        cause,
        doubtful=long,
        means=None if long else numbers,
        beside=numbers if bridge else None,
        fails=flight.fails,
        surely=own.failing(numbers, 1.0 if bridge else 0.8),
        options=[*flight.bounds, *(["--gaps", "bridge"] if bridge else [])],
    )


LEFT = r"left out|not read|ignored|unread|folder|beside|no column|names of columns|no rows|empty|suffix"


def needed(rng: np.random.Generator, flight: Flight) -> int:
    """A vehicle without which the numbers are others."""
    if flight.kind == "collide":
        return pick(rng, flight.pair)
    for i in rng.permutation(len(flight.names)).tolist():
        rest = [k for k in range(len(flight.names)) if k != i]
        less = measure([flight.times[k] for k in rest], [flight.places[k] for k in rest])
        if not less.near(flight.numbers):
            return i
    raise AssertionError("two vehicles are nearest")


@operator(in_folder)
def folders(rng: np.random.Generator, flight: Flight) -> Mutant:
    """Tables in sub-folders, with other suffixes, empty, in pieces; other files beside them."""
    made = sheets(flight)
    name = list(made)[needed(rng, flight)]
    stem = name.removesuffix(".csv")
    texts = {key: sheet.text() for key, sheet in made.items()}
    variant = pick(
        rng, ["sub-folder", "sub-folder", "suffix", "suffix", "no rows", "empty", "beside", "files", "below",
              "each", "pieces", "further"]
    )  # fmt: skip
    if variant == "sub-folder":
        place = pick(rng, ["{0}/{0}.csv", "more/{0}.csv", "a/b/{0}.csv", "{0}.csv/{0}.csv"])
        texts[place.format(stem)] = texts.pop(name)
    elif variant == "suffix":
        place = pick(rng, [".txt", ".tsv", ".dat", ".csv.bak", ".csv~", ".log", ""])
        texts[stem + place] = texts.pop(name)
    elif variant == "no rows":
        texts[name] = texts[name].split("\n")[0] + "\n"
    elif variant == "empty":
        texts[name] = ""
    elif variant == "beside":
        texts[pick(rng, ["README.txt", "notes.md", "plot.png", ".DS_Store", "._a.csv"])] = (
            "flown in the evening\n"
        )
        return alike(flight, variant, texts, cause=LEFT)
    elif variant == "files":
        order = [str(x) for x in rng.permutation(list(texts))]
        return alike(flight, variant, texts, target=order)
    elif variant == "below":
        texts = {f"tables/{key}": text for key, text in texts.items()}
    elif variant == "each":
        texts = {f"{key[:-4]}/way.csv": text for key, text in texts.items()}
        return alike(flight, variant, texts)
    elif variant == "pieces":
        head, *rows = texts.pop(name).splitlines()
        half = len(rows) // 2
        parts = [rows[:half], rows[half:]]
        texts |= {f"{stem}_{k}.csv": "\n".join([head, *p]) + "\n" for k, p in enumerate(parts)}
        return unlike(flight, variant, texts, SPAN + "|" + LEFT, doubtful=True)
    else:
        texts["log.csv"] = "level,message\ninfo,start\ninfo,end\n"
    cause = LEFT + "|" + re.escape(stem if variant != "further" else "log.csv") + r"\b"
    return unlike(flight, variant, texts, cause)


@operator()
def cases(rng: np.random.Generator, flight: Flight) -> Mutant:
    """Capital and small letters, blanks and other characters in the names of columns, vehicles and files."""
    own = copy.deepcopy(flight)
    ways = ["columns", "strange", "alike", "padded"]
    if flight.folder:
        ways += ["suffix", "suffix", "sub-folder", "mixture", "mixture", "recording"]
    else:
        ways += ["split", "split"]
    variant = pick(rng, ways)
    change = pick(rng, [str.upper, str.title, str.capitalize])
    if variant == "strange":
        strange = ["Überflieger", "飛行機", "a b  c", "drone/1", "x", "time", "-", "1e3", "o'neil"]
        if flight.folder:
            strange.remove("drone/1")
        own.names = [str(x) for x in rng.choice(strange, len(own.names), replace=False)]
    elif variant == "alike":
        own.names = ["uav", "UAV", "Uav", "uAV", "uaV"][: len(own.names)]
    made = sheets(own)
    if variant in ("strange", "alike"):
        return alike(flight, variant, made)
    if variant in ("columns", "padded"):
        for sheet in made.values():
            for role, name in sheet.columns.items():
                sheet.columns[role] = f" {name} " if variant == "padded" else change(name)
                if variant == "padded":
                    for row in sheet.rows:
                        row[role] = f" {row[role]}  "
        return alike(flight, variant, made)
    if variant == "split":
        i = pick(rng, flight.pair)
        old, new = flight.names[i], f"UAV{i + 1}"
        for sheet in made.values():
            for row in sheet.rows:
                if row["who"] == old:
                    row["who"] = new if row["at"] < flight.meeting * 1e6 else new.lower()
        return unlike(flight, variant, made, SPAN + "|case|alike", doubtful=True)
    texts = {name: sheet.text() for name, sheet in made.items()}
    name = list(made)[needed(rng, flight)]
    stem = name.removesuffix(".csv")
    if variant == "suffix":
        hit = list(texts) if rng.integers(2) else [name]
        texts = {
            k[:-4] + pick(rng, [".CSV", ".Csv"]) if k in hit else k: x for k, x in texts.items()
        }
        return alike(flight, variant, texts)
    if variant == "recording":
        texts[f"{stem}.MCAP"] = texts.pop(name)
    elif variant == "sub-folder":
        texts = {f"{k[:-4]}/{'WAY.CSV' if k == name else 'way.csv'}": x for k, x in texts.items()}
    else:
        other = pick(rng, [k for k in texts if k != name])
        where = {k: f"{(other if k == name else k)[:-4]}/{k}" for k in texts}
        where[name] = where[name][:-4] + ".CSV"
        texts = {where[k]: x for k, x in texts.items()}
    cause = LEFT + r"|follow|polynomials|mcap|" + re.escape(stem) + r"\b"
    return unlike(flight, variant, texts, cause)


@operator()
def offsets(rng: np.random.Generator, flight: Flight) -> Mutant:
    """Clocks that begin early or late: of all vehicles, of one, or against obstacles that move."""
    own = copy.deepcopy(flight)
    early = -float(rng.uniform(0.1, 0.3)) * flight.meeting
    late = float(rng.uniform(1, 90))
    variant = pick(rng, ["all", "one"] + ["obstacle"] * 2 * (flight.kind == "safe"))
    if variant == "all":
        by = pick(rng, [early, late, -late, 1000 * late])
        own.times = [t + micro(by) for t in own.times]
        return alike(own, f"all {'early' if by < 0 else 'late'}", sheets(own))
    if variant == "one":
        i = pick(rng, flight.pair)
        usual = float(np.median(np.diff(own.times[i]))) / 1e6
        by = pick(rng, [late, -late, 5 * usual, -5 * usual, 3 * usual, 3600.0, 1.7e9])
        own.times[i] = own.times[i] + micro(by)
        numbers = measure(own.times, own.places) if abs(by) < 3000 else Numbers(np.inf, 0.0)
        return unlike(
            own,
            variant,
            sheets(own),
            SPAN + r"|at most|the most|one clock|dates",
            doubtful=True,
            fails=flight.fails,
            surely=own.failing(numbers, 0.8),
        )
    since = pick(rng, [early, early, late, 0.0, 1_714_564_800.0])
    own.times = [t + micro(since) for t in own.times]
    # A ball is where a vehicle is, at a time of the file's clock.
    i = int(rng.integers(len(own.names)))
    k = int(np.searchsorted(flight.times[i], flight.meeting * 1e6))
    at, place = float(flight.times[i][k]) / 1e6, flight.places[i][k] / 1e6
    if since < 1e9:
        at += since
    places = [(place + [0, 0, 30.0 * s]).tolist() for s in (1, 0, -1)]
    mission = "\n".join([
        'schema_version = 1\nname = "ball"\n[agents]\nmass = 1.0\nradius = 0.1',
        f"position = {[[3.0 * m, 0.0, 5.0] for m in range(len(own.names))]}",
        '[[obstacles]]\nkind = "sphere"\nname = "ball"\nradius = 0.5',
        f"waypoints = {places}\ntimes = {[at - 0.6 * at, at, at + 0.6 * at]}",
        '[[phases]]\nkind = "hold"\nduration = 10.0\n'
    ])  # fmt: skip
    texts = {name: sheet.text() for name, sheet in sheets(own).items()}
    target = ["."] if own.folder else list(texts)
    place_of = "ball.toml" if not own.folder else "../ball.toml"
    texts[place_of] = mission
    return unlike(
        own,
        f"obstacle {'epoch' if since > 1e9 else 'early' if since < 0 else 'late'}",
        texts,
        r"clock|times?\b|\bbegin",
        means=Numbers(np.nan, np.nan),
        fails=True,
        doubtful=since > 1e9,
        target=target,
        options=["--mission", "@" + place_of],
    )


AXES = r"\baxes\b|\baxis\b|down|\bNED\b|north|z points|below"


@operator()
def axes(rng: np.random.Generator, flight: Flight) -> Mutant:
    """North, east and down, with names that say so and without; heights under other names; degrees of the globe."""
    own, bounds = copy.deepcopy(flight), flight.bounds
    variant = pick(
        rng, ["bare", "bare", "bare", "free", "down", "up", "height", "globe", "option", "suffix"]
    )
    ground = [*bounds, "--ground", "0"]
    if variant in ("bare", "free", "down", "option", "suffix"):
        own.places = [r[:, [1, 0, 2]] * [1, 1, -1] for r in own.places]
        own.velocities = own.yaws = None
    made = sheets(own, style="")
    for sheet in made.values():
        if variant == "down":
            names = pick(
                rng, [("north", "east", "down"), ("n", "e", "d"), ("North", "East", "Down")]
            )
        elif variant == "up":
            names = pick(rng, [("east", "north", "up"), ("e", "n", "u")])
        elif variant == "height":
            names = ("x", "y", pick(rng, ["alt", "altitude", "height", "h", "z_up"]))
        elif variant == "suffix":
            names = pick(rng, [("x_ned", "y_ned", "z_ned"), ("ned_x", "ned_y", "ned_z")])
        elif variant == "globe":
            names = pick(rng, [("lat", "lon", "alt"), ("latitude", "longitude", "altitude")])
        else:
            break
        sheet.columns |= dict(zip(POSITION, names, strict=True))
    if variant == "option" and has_option("axes"):
        options = [*ground, "--axes", "ned"]
        return alike(flight, variant, made, options=options)
    if variant == "free":
        return alike(flight, variant, made)
    return unlike(
        flight,
        variant,
        made,
        AXES + ("" if variant in ("bare", "option") else r"|no column|lat"),
        doubtful=variant in ("bare", "option"),
        options=ground,
    )


ANGLE = r"yaw|angle|degree|radian|\bdeg\b|\brad\b"


@operator(lambda flight: flight.yaws is not None)
def angles(rng: np.random.Generator, flight: Flight) -> Mutant:
    """Yaw in degrees and radians, with the unit and without, on either side of a full turn."""
    made = sheets(flight)
    variant = pick(
        rng, ["bare", "bare", "bare", "named", "wrapped", "sign", "heading", "named wrapped"]
    )
    style = pick(rng, ["_", "[]", "()"])
    sparse = variant == "bare" and bool(rng.integers(2))
    for sheet in made.values():
        # A turn that is told from radians: over more than a turn of them, in steps that may be more than half of it.
        turn = np.linspace(0.0, rng.uniform(200, 700), len(sheet.rows))
        if sparse:
            turn = np.rint(turn / 30.0) * 30.0
        if not flight.folder:
            starts = np.array([row["at"] for row in sheet.rows], dtype=float)
            span = np.ptp(starts)
            turn = (starts - starts[0]) / span * turn.max()
        x = (turn + 180) % 360 - 180 if "wrapped" in variant else turn
        if variant == "wrapped":
            x = np.radians(x)
        for row, value in zip(sheet.rows, x, strict=True):
            row["yaw"] = f"{value:.6f}"
        unit = {"named": "deg", "named wrapped": "deg", "sign": "°", "heading": "deg"}.get(variant)
        name = "heading" if variant == "heading" else "yaw"
        sheet.columns["yaw"] = name if unit is None else unit_of(name, unit, style)
    bare = variant == "bare"
    keeps = not bare and variant not in ("sign", "heading")
    return written(flight, variant, made, keeps=keeps, doubtful=bare, cause=ANGLE)


@operator()
def further(rng: np.random.Generator, flight: Flight) -> Mutant:
    """Columns that no verdict needs: numbers of rows, states, texts, empty ones."""
    made = sheets(flight)
    variant = pick(
        rng, ["duration", "duration", "row", "row", "index", "id", "state", "empty", "nan", "text", "constant", "many"]
    )  # fmt: skip
    where = pick(rng, [0, 1, None])
    for sheet in made.values():
        n = len(sheet.rows)
        stage = [("take-off", "cruise", "landing")[3 * k // n] for k in range(n)]
        name, values = {
            "duration": ("duration", ["0.1"] * n),
            "row": (pick(rng, ["row", "seq", "index", "frame", "sample", "n", "count"]), range(n)),
            "index": ("", range(n)),
            "id": ("id", range(n)),
            "state": (pick(rng, ["state", "mode", "phase", "status"]), stage),
            "empty": ("remark", [""] * n),
            "nan": ("battery", ["nan"] * n),
            "text": ("message", ["all, is 'well'; \"so\"\t#1"] * n),
            "constant": (pick(rng, ["team", "frame_id", "source", "swarm"]), ["world"] * n),
            "many": ("q0", ["1"] * n),
        }[variant]
        if variant == "id" and sheet.columns.get("who") == "id":
            sheet.columns["who"] = "drone"
        sheet.add("further", name, values, where)
        if variant == "many":
            for k in range(60):
                sheet.add(f"further{k}", f"motor{k}", ["0.5"] * n)
    keeps = variant != "id"
    cause = "" if keeps else r"column|\bid\b|vehicle|identity"
    return written(flight, f"{variant} {where}", made, keeps=keeps, cause=cause)


# -- all of them -----------------------------------------------------------------------------------


class Case(NamedTuple):
    """A mutant, its original, and what came of both."""

    key: int
    operator: str
    mutant: Mutant
    original: Outcome
    outcome: Outcome
    grade: str

    @property
    def good(self) -> bool:
        """Whether the mutant is taken as it was meant, refused, or noted."""
        return self.grade in ("same", "changed", "refused", "noted")


@cache
def flights(seed: int) -> tuple[Flight, ...]:
    """The originals."""
    return tuple(fly((seed, 10**6), k) for k in range(ORIGINALS))


@cache
def read(seed: int, k: int) -> Outcome:
    """What `assess` makes of the k-th original."""
    flight = flights(seed)[k]
    mutant = alike(flight, "original", sheets(flight))
    return judge(mutant.files, mutant.target, mutant.options)


def misread(seed: int, count: int = ORIGINALS) -> list[int]:
    """Originals whose verdict or numbers are not those of the oracle."""
    return [
        k
        for k, flight in enumerate(flights(seed)[:count])
        if read(seed, k).code != flight.fails or not read(seed, k).numbers.near(flight.numbers)
    ]


def case(seed: int, key: int) -> Case:
    """Make a mutant and judge it."""
    rng = np.random.default_rng([seed, key])
    name = list(OPERATORS)[key % len(OPERATORS)]
    wish, make = OPERATORS[name]
    k = pick(rng, [k for k, flight in enumerate(flights(seed)) if wish(flight)])
    mutant, original = make(rng, flights(seed)[k]), read(seed, k)
    outcome = judge(mutant.files, mutant.target, mutant.options)
    return Case(key, name, mutant, original, outcome, grade(mutant, original, outcome))


def summary(cases: Sequence[Case]) -> dict[str, dict[str, int]]:
    """How many mutants of each operator were graded how."""
    found: dict[str, dict[str, int]] = {}
    for name in OPERATORS:
        own = [c for c in cases if c.operator == name]
        keeping = Counter(c.grade for c in own if c.mutant.keeps)
        changing = Counter(c.grade for c in own if not c.mutant.keeps)
        found[name] = {
            "all": len(own),
            "keep": keeping.total(),
            "kept": keeping["same"],
            "change": changing.total(),
            "judged": changing["same"] + changing["changed"],
            "refused": changing["refused"],
            "noted": changing["noted"],
            "cause": keeping["cause"] + changing["cause"],
            "numbers": keeping["numbers"] + changing["numbers"],
            "crash": keeping["crash"] + changing["crash"],
            "silent": keeping["silent"] + changing["silent"],
        }
    return found


def kept_share(cases: Sequence[Case]) -> float:
    """The share of the mutants that keep the meaning and are read as their original."""
    grades = [c.grade for c in cases if c.mutant.keeps]
    return grades.count("same") / max(len(grades), 1)


def faults(cases: Sequence[Case]) -> list[Case]:
    """Mutants that are neither taken as they were meant, nor refused for the cause, nor noted.

    One that keeps the meaning and is refused counts for `KEPT`.
    """
    return [c for c in cases if not c.good and not (c.mutant.keeps and c.grade == "cause")]


def _shown(found: Case) -> str:
    """A case with its files."""
    lines = [
        f"{found.key} {found.operator}: {found.mutant.variant}; keeps={found.mutant.keeps} "
        f"fails={found.mutant.fails} surely={found.mutant.surely} doubtful={found.mutant.doubtful}",
        f"options {' '.join(found.mutant.options)}",
        f"original {found.original.code} {found.original.numbers}",
        f"outcome  {found.outcome.code} {found.outcome.numbers} -> {found.grade}",
        found.outcome.error,
        *(f"note: {note}" for note in found.outcome.verdict.get("notes", [])),
    ]
    for name, data in found.mutant.files.items():
        lines += [f"== {name}", *data.decode("utf-8", "replace").splitlines()[:12]]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--json", type=Path, help="write each case")
    parser.add_argument("--show", type=int, help="print one case with its files")
    parser.add_argument("--only", nargs="*", default=list(OPERATORS), help="these operators")
    chosen = parser.parse_args()
    if chosen.show is not None:
        print(_shown(case(chosen.seed, chosen.show)))
        return 0
    began = time.perf_counter()
    names = list(OPERATORS)
    cases = [
        case(chosen.seed, key)
        for key in range(chosen.count)
        if names[key % len(names)] in chosen.only
    ]
    rows = summary(cases)
    heads = list(next(iter(rows.values())))
    print(f"{'operator':<12}" + "".join(f"{head:>9}" for head in heads))
    for name, row in rows.items():
        print(f"{name:<12}" + "".join(f"{row[head]:>9}" for head in heads))
    total = {head: sum(row[head] for row in rows.values()) for head in heads}
    print(f"{'all':<12}" + "".join(f"{total[head]:>9}" for head in heads))
    wrong, share = misread(chosen.seed), kept_share(cases)
    bad = faults(cases)
    print(f"originals misread: {len(wrong)} of {ORIGINALS}")
    print(f"kept: {share:.1%} of {total['keep']}; wrong: {len(bad)}; in silence: {total['silent']}")
    print(f"{time.perf_counter() - began:.0f} s")
    if chosen.json is not None:
        chosen.json.write_text(
            json.dumps(
                [
                    {
                        "key": c.key, "operator": c.operator, "variant": c.mutant.variant, "keeps": c.mutant.keeps,
                        "fails": c.mutant.fails, "grade": c.grade, "code": c.outcome.code, "error": c.outcome.error,
                        "notes": c.outcome.verdict.get("notes", []), "numbers": list(c.outcome.numbers),
                        "original": list(c.original.numbers)
                    }
                    for c in cases
                ],
                indent=1
            )
        )  # fmt: skip
    return int(bool(wrong or bad or share < KEPT))


if __name__ == "__main__":
    sys.exit(main())
