"""First picture and pictures per second of replays, in Chromium without a window, drawn in software.

    python benchmarks/replay.py                        # show-1000, flown first (20 s)
    python benchmarks/replay.py flight.nc page.html    # flights and pages that exist
    python benchmarks/replay.py --agents 20000         # a made-up show of so many, which nobody simulates

The first picture counts from the start of navigation (`performance.now()`) to the frame after the one in which the
page first drew the flight, so the picture is on the screen. Pictures per second are counted over some seconds of
playing, in the whole flight's view and in the one that follows the formation.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "browser"))  # the browser of the tests

#: Notes when the page has shown its first picture.
_WATCH = """
    const look = () => {
      if (window.replay?.pictures > 0) window.firstPicture = performance.now();
      else requestAnimationFrame(look);
    };
    requestAnimationFrame(look);
"""
_GOAL_FIRST, _GOAL_RATE = 1.0, 30.0


def measure(browser: object, page: Path, seconds: float, rounds: int) -> dict[str, float]:
    """First picture [s] and pictures per second of a page; medians of rounds."""
    found: dict[str, list[float]] = {"first": [], "overview": [], "follow": []}
    for _ in range(rounds):
        browser.open(page.as_uri() + "#", ready="window.firstPicture")
        found["first"].append(browser.run("return window.firstPicture") / 1000)
        for camera in ("overview", "follow"):
            browser.run(
                "replay.look(arguments[0]); replay.seek(replay.recording.start"
                " + 0.4 * (replay.recording.end - replay.recording.start)); replay.play(true)",
                camera,
            )
            time.sleep(2.0)  # the resolution adapts
            before = browser.run("return [replay.pictures, performance.now()]")
            time.sleep(seconds)
            after = browser.run("return [replay.pictures, performance.now()]")
            found[camera].append(1000 * (after[0] - before[0]) / (after[1] - before[1]))
    return {name: float(np.median(values)) for name, values in found.items()}


def made_up(n: int, seconds: float) -> object:
    """A flight of n vehicles that spiral up, as if simulated."""
    sys.path.insert(0, str(ROOT / "tests"))
    from sample_flights import swarm

    return swarm(n, seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", type=Path, help="saved flights, or pages")
    parser.add_argument("--agents", type=int, nargs="*", default=[], help="made-up flights")
    parser.add_argument("--seconds", type=float, default=5.0, help="time of playing [s]")
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    from chromium import started

    import rigidfleet as rf

    flights: list[tuple[str, object]] = [(path.stem, path) for path in asked.files]
    flights += [(f"{n:,} made up", n) for n in asked.agents]
    flights = flights or [("show-1000", "show-1000")]
    with tempfile.TemporaryDirectory() as folder:
        browser = started(Path(folder) / "profile")
        browser.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": _WATCH})
        print(
            "replay | page [MB] | written in [s] | first picture [s] | pictures/s, whole | following"
        )
        for name, what in flights:
            page, took = what, 0.0
            if not (isinstance(what, Path) and what.suffix == ".html"):
                if isinstance(what, int):
                    result = made_up(what, 60.0)
                else:
                    result = rf.simulate(what) if isinstance(what, str) else rf.Result.load(what)
                page, begun = Path(folder) / "page.html", time.perf_counter()
                rf.replay(result, page)
                took = time.perf_counter() - begun
                del result
            m = measure(browser, page, asked.seconds, asked.rounds)
            good = m["first"] <= _GOAL_FIRST and min(m["overview"], m["follow"]) >= _GOAL_RATE
            print(
                f"{name} | {page.stat().st_size / 1e6:.1f} | {took:.1f} | {m['first']:.2f} |"
                f" {m['overview']:.1f} | {m['follow']:.1f} | {'reached' if good else 'not reached'}",
                flush=True,
            )
        browser.driver.quit()


if __name__ == "__main__":
    main()
