"""Fly the virtual body by hand, in the browser, while it is simulated in real time."""

from __future__ import annotations

import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rigidfleet.errors import wrong_type
from rigidfleet.mission import as_mission
from rigidfleet.web.live.server import Server
from rigidfleet.web.live.session import Session

if TYPE_CHECKING:
    from rigidfleet.mission import Mission
    from rigidfleet.result import Result

__all__ = ["live"]


def live(
    mission: Mission | str | Path,
    *,
    port: int = 0,
    browser: bool = True,
    ready: Callable[[str], object] | None = None,
    landed: Callable[[Result], str] | None = None,
) -> Result | None:
    """Fly a mission's vehicles by hand, until the page is closed or Ctrl-C is pressed.

    The vehicles first establish the mission's first formation. Then the page moves and turns the target of the
    virtual body, changes formations and sends gusts, while the mission's control laws fly the vehicles.

    Parameters
    ----------
    mission : a shipped name, a path or a `Mission`
    port : local port of the page, which only this machine can reach; 0 for any free one
    browser : open the page in the user's browser
    ready : called with the page's address once it is served
    landed : called with each flight when it ends, for example to save it; a new flight ends the one before. The
        text that it returns is shown on the page

    Returns
    -------
    Result
        The last flight, with its phases as flown; None if the page was never opened.

    Raises
    ------
    FlightError
        No formation of the mission has slots, or the port cannot be used.
    TypeError
        The mission, the port or a function is none.
    """
    if not isinstance(port, int) or isinstance(port, bool):
        raise wrong_type("a number for port (0 for any free one)", port)
    for name, function in (("ready", ready), ("landed", landed)):
        if not (function is None or callable(function)):
            raise wrong_type(f"a function for {name}", function)
    session = Session(as_mission(mission), landed)
    with Server(session, port) as server:
        try:
            if ready is not None:
                ready(server.url)
            if browser:
                webbrowser.open(server.url)
            session.run()
        except KeyboardInterrupt:
            pass
    return session.flown
