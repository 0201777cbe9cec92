"""Fly the virtual body by hand, in the browser, while it is simulated in real time."""

from __future__ import annotations

import webbrowser
from collections.abc import Callable
from typing import TYPE_CHECKING

from rigidfleet.live.server import Server
from rigidfleet.live.session import Session

if TYPE_CHECKING:
    from rigidfleet.mission import Mission

__all__ = ["live"]


def live(
    mission: Mission,
    *,
    port: int = 0,
    browser: bool = True,
    ready: Callable[[str], object] | None = None,
) -> None:
    """Fly a mission's vehicles by hand, until the page is closed or Ctrl-C is pressed.

    The vehicles establish the mission's first formation; from then on the page moves and turns the
    target of the virtual body, changes formations and sends gusts, and the mission's laws fly it.

    Parameters
    ----------
    port : on which this machine, and it alone, serves the page; 0 for any that is free
    browser : open the page in the user's browser
    ready : called with the page's address once it is served

    Raises
    ------
    FlightError
        No formation of the mission has slots, or the port cannot be used.
    """
    session = Session(mission)
    with Server(session, port) as server:
        try:
            if ready is not None:
                ready(server.url)
            if browser:
                webbrowser.open(server.url)
            session.run()
        except KeyboardInterrupt:
            return
