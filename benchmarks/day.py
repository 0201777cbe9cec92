"""What the day costs, and whether its promises hold: each number with its goal, and with what it was compared.

    make day                                     all rows, into docs/day.md: six minutes on two cores
    python benchmarks/day.py --only pages        some rows, printed

Times are those of the commands as a user gives them: by the clock on two processes, and in brackets of the processors.
The oracles are those of the tests.
"""

from __future__ import annotations

import argparse
import json
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from pages import Page, splice

import rigidfleet as rf
from rigidfleet._common.toml import to_toml
from rigidfleet.mission import show_draft

TESTS = Path(__file__).parents[1] / "tests"
SHOW = "show-1000"


class Line(NamedTuple):
    """A row of the table: what, its goal, what was measured, what it was compared with, and whether the goal is met."""

    what: str
    goal: str
    measured: str
    oracle: str
    kept: bool = True


def ran(*command: str) -> tuple[str, float, float]:
    """What a rigidfleet command printed, its time by the clock and of the processors [s]."""

    def busy() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    clock, before = time.perf_counter(), busy()
    program = [sys.executable, "-m", "rigidfleet", *command]
    done = subprocess.run(program, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(command)}: exit code {done.returncode}")
    return done.stdout, time.perf_counter() - clock, busy() - before


def took(clock: float, busy: float) -> str:
    """Both times in words."""
    return f"{clock:.0f} s ({busy:.0f} s)"


def with_toml_suffix(folder: Path, name: str, **tables: Any) -> str:
    """A shipped mission with other tables, as a file."""
    path = folder / f"{name}.toml"
    path.write_text(to_toml(rf.load_mission(name).to_dict() | tables), encoding="utf-8")
    return str(path)


def areas(folder: Path) -> Iterator[Line]:
    """What fences, people and falls cost."""
    square = [[-90.0, -90.0], [90.0, -90.0], [90.0, 90.0], [-90.0, 90.0]]
    crowd = [[x, y - 200.0] for x, y in square]
    more = {
        "fences": [{"kind": "inclusion", "polygon": square}],
        "people": [{"polygon": crowd}],
        "disturbances": {"wind": [2.0, 1.0, 0.0]},
    }
    busy = []
    # The first may have to compile.
    for tables in (more, {"disturbances": more["disturbances"]}, more):
        file = with_toml_suffix(folder, SHOW, **tables)
        busy.append(ran("run", file, "--no-figures", "--force", "--out", str(folder / "areas"))[2])
    yield Line(
        f"fence, people and falls in flight and verdict of {SHOW}", "",
        f"{busy[2] - busy[1]:+.1f} s beside {busy[1]:.1f} s of the processors", "dense samples, SciPy's `solve_ivp`",
    )  # fmt: skip


def drills(folder: Path) -> Iterator[Line]:
    """Drills of a thousand vehicles."""
    faults = {
        "late": [0.5, 2.0],
        "another": [1],
        "bias": [0.5],
        "rotated": [3.0],
        "shifted": [2.0],
        "vehicles": [1, 5],
    }
    for words, drill, runs, most in (
        ("geometric drills", faults, 1000, 60.0),
        ("flown drills", {"wind": [2.0], "lost": [1]}, 20, 300.0),
    ):
        file, out = folder / "drill.toml", folder / words.partition(" ")[0]
        file.write_text(to_toml({"mission": SHOW, "runs": runs, "drill": drill}), encoding="utf-8")
        options = ("--workers", "2", "--no-figures", "--json", "--quiet", "--out", str(out))
        text, *times = ran("sweep", str(file), *options)
        passed = json.loads(text)["success"]["count"]
        yield Line(
            f"{runs:,} {words} of {SHOW}",
            f"{most:g} s",
            took(*times),
            f"{passed} harmless",
            times[0] <= most,
        )


def faults(folder: Path) -> Iterator[Line]:
    """Faults of known size in shows of others."""
    from test_drill import compare

    broken, harmless = compare(folder, range(10), 40)  # which fails where they differ
    yield Line(
        "400 faults in ten shows that a drill and the oracle judge alike", "400", str(broken + harmless),
        f"dense samples: {broken} dangerous, {harmless} harmless",
    )  # fmt: skip


def aborts(folder: Path) -> Iterator[Line]:
    """Ways home of a thousand vehicles."""
    for to, words, most, share in (
        ("any", "any place", 60.0, 1.0),
        ("own", "own pads", 300.0, 0.9),
    ):
        file = with_toml_suffix(folder, SHOW, abort={"to": to})
        text, *times = ran("check", file, "--abort", "--json")
        every = json.loads(text)["aborts"]
        ways = [x for x in every if x["way"]]
        least = min(x["separation"]["least_m"] for x in ways)
        yield Line(
            f"ways home of {SHOW} to {words}: proved; time", f"{share:.0%} of the seconds; {most:g} s",
            f"{len(ways)} of {len(every)}, least {least:.2f} m; {took(*times)}", "samples of the ways",
            len(ways) >= share * len(every) and times[0] <= most,
        )  # fmt: skip


def missions(_: Path) -> Iterator[Line]:
    """Aborts as they are flown."""
    from test_abort import flown_apart

    beyond = [flown_apart(seed) for seed in range(200)]
    below = sum(x < -1e-9 for x in beyond)
    yield Line(
        "200 random missions in wind, one vehicle lost: aborts below their promise", "0", str(below),
        f"samples of the flights: {1e3 * min(beyond):.1f} mm above at least", not below,
    )  # fmt: skip


def pages(folder: Path) -> Iterator[Line]:
    """The report of sixty vehicles with drill and aborts, printed."""
    scenes = [show_draft.shape_scene(shape, 60, 2.0) for shape in ("sphere", "helix")]
    file, out, home, drill = (
        str(folder / name) for name in ("sixty.toml", "sixty", "home", "sixty-drill")
    )
    Path(file).write_text(
        show_draft.show_mission_text("sixty", scenes, agents=60, spacing=2.0), encoding="utf-8"
    )
    ran("run", file, "--no-figures", "--quiet", "--out", out)
    ran("check", file, "--abort", "--out", home)
    ran("sweep", file, "--drill", "--runs", "40", "--no-figures", "--quiet", "--out", drill)
    ran("report", f"{out}/sixty.nc", "--no-figures", "--quiet", "--drill", drill, "--abort", home)
    browser = next(
        filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
    )
    if browser is None:
        raise RuntimeError("pages are counted by Chromium, which is not there")
    printed = folder / "report.pdf"
    options = (
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--no-pdf-header-footer",
        f"--print-to-pdf={printed}",
    )
    subprocess.run(
        [browser, *options, f"file://{out}/report.html"], check=True, capture_output=True
    )
    count = len(re.findall(rb"/Type\s*/Page\b", printed.read_bytes()))
    yield Line(
        "pages of a report for 60 vehicles",
        "5",
        str(count),
        "printed by Chromium on A4",
        count <= 5,
    )


ROWS: dict[str, Callable[[Path], Iterator[Line]]] = {
    "areas": areas, "drills": drills, "faults": faults, "aborts": aborts, "missions": missions, "pages": pages,
}  # fmt: skip


def main() -> int:
    """Print the table; 1 if a goal is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", action="append", choices=ROWS, help="only these rows")
    parser.add_argument("--write", type=Path, help="put the table into a page (docs/day.md)")
    options, page = parser.parse_args(), Page()
    sys.path.insert(0, str(TESTS))
    page.title(
        "Times by the clock, and in brackets of the processors:",
        "what",
        "goal",
        "measured",
        "compared with",
    )
    for name in options.only or ROWS:
        with tempfile.TemporaryDirectory() as folder:
            for line in ROWS[name](Path(folder)):
                page.row(*line[:-1], kept=line.kept)
    if options.write:
        splice(options.write, {"measured: day": "\n".join(page.lines)})
    return int(page.missed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
