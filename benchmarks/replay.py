"""First picture and pictures per second of replays, in Chromium without a window, drawn in software.

    python benchmarks/replay.py                        # show-1000, flown first (20 s)
    python benchmarks/replay.py flight.nc page.html    # flights and pages that exist
    python benchmarks/replay.py --agents 20000         # a made-up flight of so many, which nobody simulates

The first picture counts from the start of navigation (`performance.now()`) to the frame after the one in which the
page first drew the flight, so the picture is on the screen. Pictures per second are counted over some seconds of
playing, in the whole flight's view and in the one that follows the formation. The processor time of a picture is that
of all processes of the browser; it depends less on what else the machine does.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import rigidfleet as rf

if TYPE_CHECKING:
    from chromium import Browser

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests" / "browser"), str(ROOT / "tests")]

_GOAL_FIRST, _GOAL_RATE = 1.0, 30.0  # [s, 1/s]
_ADAPTS = 2.0  # time in which a page finds its resolution [s]
_NOW = "return [replay.pictures, performance.now()]"
#: Notes when the page has shown its first picture.
_WATCH = """
    const look = () => {
      if (window.replay?.pictures > 0) window.firstPicture = performance.now();
      else requestAnimationFrame(look);
    };
    requestAnimationFrame(look);
"""
#: Plays from a camera's view, so slowly that the flight lasts.
_PLAY = """
    const { start, end } = replay.recording;
    replay.look(arguments[0]);
    replay.speed = Math.min(1, (end - start) / arguments[1]);
    replay.seek(start + 0.4 * (end - start));
    replay.play(true);
"""
_COLUMNS = (
    "replay", "page [MB]", "written in [s]", "first picture [s]", "pictures/s, whole", "following",
    "processor time of a picture [ms]",
)  # fmt: skip


def processor_time(process: int) -> float:
    """Processor time [s] of a process and all that it has started (Linux)."""
    total = 0.0
    with contextlib.suppress(OSError):  # one that ends meanwhile
        numbers = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        total = (int(numbers[11]) + int(numbers[12])) / os.sysconf("SC_CLK_TCK")
        for task in Path(f"/proc/{process}/task").iterdir():
            total += sum(map(processor_time, map(int, (task / "children").read_text().split())))
    return total


def measure(browser: Browser, page: Path, seconds: float, rounds: int) -> dict[str, float]:
    """First picture [s], pictures per second and processor time of a picture [ms]: medians of rounds."""
    found: dict[str, list[float]] = {"first": [], "overview": [], "follow": [], "processor": []}
    root = browser.driver.service.process.pid
    for _ in range(rounds):
        browser.open(f"{page.resolve().as_uri()}#", ready="window.firstPicture")
        found["first"].append(browser.run("return window.firstPicture") / 1000)
        for camera in ("overview", "follow"):
            browser.run(_PLAY, camera, 4.0 * (seconds + _ADAPTS))
            time.sleep(_ADAPTS)
            busy, before = processor_time(root), browser.run(_NOW)
            time.sleep(seconds)
            busy, after = processor_time(root) - busy, browser.run(_NOW)
            pictures = max(after[0] - before[0], 1)
            found[camera].append(1000 * pictures / (after[1] - before[1]))
            found["processor"].append(1000 * busy / pictures)
    return {name: float(np.median(values)) for name, values in found.items()}


def written(what: Any, page: Path) -> float:
    """Write the page of a mission by name, a saved flight, or so many made-up vehicles; returns the time [s]."""
    from sample_flights import swarm

    if isinstance(what, int):  # with as many samples as a page has at most
        what = swarm(what, min(60.0, 0.05 * 3e6 / what))
    elif isinstance(what, str):
        what = rf.simulate(what)
    begun = time.perf_counter()
    rf.replay(what, page)
    return time.perf_counter() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("files", nargs="*", type=Path, help="saved flights, or pages")
    parser.add_argument("--agents", type=int, nargs="*", default=[], help="made-up flights")
    parser.add_argument("--seconds", type=float, default=5.0, help="time of playing [s]")
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    from chromium import started

    flights: list[tuple[str, Any]] = [(path.name, path) for path in asked.files]
    flights += [(f"{n:,} made up", n) for n in asked.agents]
    print(" | ".join(_COLUMNS))
    with tempfile.TemporaryDirectory() as folder:
        browser = started(Path(folder) / "profile")
        browser.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": _WATCH})
        for name, what in flights or [("show-1000", "show-1000")]:
            page, took = Path(folder) / "page.html", 0.0
            if isinstance(what, Path) and what.suffix == ".html":
                page = what
            else:
                took = written(what, page)
            m = measure(browser, page, asked.seconds, asked.rounds)
            good = m["first"] <= _GOAL_FIRST and min(m["overview"], m["follow"]) >= _GOAL_RATE
            print(
                f"{name} | {page.stat().st_size / 1e6:.1f} | {took:.1f} | {m['first']:.2f} |"
                f" {m['overview']:.1f} | {m['follow']:.1f} | {m['processor']:.0f} |"
                f" {'reached' if good else 'not reached'}",
                flush=True,
            )
        browser.driver.quit()


if __name__ == "__main__":
    main()
