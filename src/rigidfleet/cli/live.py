"""Fly a mission by hand: `live`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rigidfleet.cli import console
from rigidfleet.cli.arguments import MissionName, Whole
from rigidfleet.cli.outputs import Files

if TYPE_CHECKING:
    from rigidfleet.result import Result
from rigidfleet.cli.codes import PASSED


def live(
    mission: MissionName,
    /,
    *,
    out: Path | None = None,
    port: Whole = 0,
    no_browser: bool = False,
) -> int:
    """Fly the vehicles of a mission by hand in the browser, in real time. Each flight is saved when it ends.

    Parameters
    ----------
    mission : str
        A shipped mission or a mission file. Its vehicles, formations, gains and obstacles are used.
    out : Path
        Folder for NAME-live.nc and verdict.json. Default: flights/NAME-live. If the folder exists, a number is
        added to its name.
    port : int
        Port on this machine; other machines cannot connect. Default: any free port.
    no_browser : bool
        Print the address without opening a browser.
    """
    from rigidfleet.kernel.engine.native import has_machine_code
    from rigidfleet.mission import load_mission

    flown = load_mission(mission)
    if not has_machine_code():
        console.err().print(console.COMPILING)
    from rigidfleet.web.live import live as fly

    place = Files(out or Path("flights", f"{flown.name.removesuffix('-live')}-live"), "")
    place.check_folder_writable()

    def save_flight(result: Result) -> str:
        files = Files(place.folder, result.mission.name).make_unique_folder()
        console.show_verdict(files.save_result_and_verdict(result))
        files.print_paths()
        return f"Saved in {files.result}."

    def announce_url(url: str) -> None:
        console.out().print(f"Flying {flown.name} at {url}", soft_wrap=True)
        console.err().print("To end the flight, press Ctrl-C or close its page")

    fly(flown, port=port, browser=not no_browser, ready=announce_url, landed=save_flight)
    return PASSED
