"""A live flight and its pages: real time, commands in, pictures out."""

from __future__ import annotations

import base64
import json
import math
import queue
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from rigidfleet._common.plain import to_json_data
from rigidfleet.math import attitude as att
from rigidfleet.mission import Mission
from rigidfleet.result import Result
from rigidfleet.web.live.balls import AT_ONCE, LARGEST, QUICKEST, SMALLEST
from rigidfleet.web.live.guarding import with_avoidance_or_reason
from rigidfleet.web.live.pilot import TICK, Pilot
from rigidfleet.web.replay.page import asset_text, page
from rigidfleet.web.replay.scene import (
    EDGES,
    describe_phases,
    describe_scene,
    mean_weight,
    page_samples,
    scene_points,
)

SPEEDS = (0.25, 0.5, 1.0, 2.0, 4.0)
#: Full colour of an edge, as a share of a vehicle's weight.
_TENSION = 0.2
_AROUND = 20.0  # least range around the start that the overview shows, with nearby obstacles [m]
_LATE = 0.3  # greatest delay that is made up for [s]
#: Time after the last page is closed in which another may be opened [s].
_PATIENCE = 4.0
_FAREWELL = 1.0  # time for pages to receive the end [s]
_FASTEST, _TURNING, _STRONGEST = 50.0, 3.0, 20.0  # greatest values of commands [m/s, rad/s, N/kg]
_FARTHEST = 1e5  # greatest coordinate of a ball [m]
_WAITING = 64  # greatest number of messages queued for a slow page; further ones are dropped


class Session:
    """One flight by hand, and the pages that show it.

    `run` flies in real time while a page is open, until `stop`; other threads call `execute_command`, `add_page`
    and `remove_page`. Each flight that a page has shown is passed to ``landed`` when it ends, which returns the
    text that the pages then show.
    """

    def __init__(self, mission: Mission, landed: Callable[[Result], str] | None = None) -> None:
        self.mission, self.unguarded = with_avoidance_or_reason(mission)
        self.landed = landed
        self.flown: Result | None = None  # the last flight that ended
        self.farewell = ""
        self.shown = np.arange(min(len(mission.edges), EDGES))
        self.tension = _TENSION * mean_weight(mission)
        self.lock = threading.RLock()
        self.pages: set[queue.Queue[bytes | None]] = set()
        self.stopped = threading.Event()
        self.paused, self.speed, self.pace = False, 1.0, 1.0
        self.left = math.inf  # when the last page was closed
        self.flights = 0
        self.begin_flight()

    def begin_flight(self) -> None:
        """Begin a new flight."""
        self.pilot = Pilot(self.mission)
        self.flights += 1
        self.result = self.pilot.fly_tick()
        columns = page_samples(self.result, self.shown, self.tension)
        start = self.mission.fleet.position
        ends = start.min(axis=0) - _AROUND, start.max(axis=0) + _AROUND
        near = scene_points(self.mission, *ends)
        #: Columns are those of the beginning: pages read numbers one after the other.
        widths = {name: math.prod(c.values.shape[1:]) for name, c in columns.items()}
        widths |= {"target": 7, "balls": 4 * AT_ONCE}
        self.info: dict[str, Any] = describe_scene(self.result, self.shown, self.tension) | {
            "columns": [{"name": name, "width": width} for name, width in widths.items()],
            "count": 0,
            "start": 0.0,
            "step": TICK,
            "beyond": True,
            "note": "",
            "middle": (near.min(axis=0) + near.max(axis=0)) / 2,
            "extent": float(np.linalg.norm(np.ptp(near, axis=0))) / 2,
            "path": False,
            "forces": True,
            "camera": "follow",
            "sight": near,
            "azimuth": -1.1,
            "formations": self.pilot.formations,
            "unguarded": self.unguarded,
            "ball": {"radius": [SMALLEST, LARGEST], "speed": QUICKEST},
            "speeds": SPEEDS,
            "loss": None if self.mission.network is None else self.mission.network.loss,
        }

    def keep_flight_and_call_landed(self) -> None:
        """Keep the flight, and pass it to ``landed``."""
        if self.pilot.ticks > 1:
            self.flown = self.pilot.result()
            self.farewell = self.landed(self.flown) if self.landed is not None else ""

    # -- pages ------------------------------------------------------------------------------------

    def html(self) -> str:
        """The page."""
        with self.lock:
            info = self.info | self.page_state()
        return page(info, start="live/live.js", style=asset_text("live/live.css"), connect="'self'")

    def page_state(self) -> dict[str, Any]:
        """Information that changes only now and then."""
        pilot = self.pilot
        return {
            "phases": describe_phases(pilot.flight.phases),
            "ending": pilot.flight.ending,
            "formation": pilot.formation,
            "waiting": pilot.waiting,
            "busy": pilot.is_changing,
            "balls": [{"slot": b.slot, "name": b.name} for b in pilot.flying_balls],
            "held_off": pilot.held_off,
            "paused": self.paused,
            "speed": self.speed,
            "pace": self.pace,
            "flight": self.flights,
        }

    def add_page(self) -> queue.Queue[bytes | None]:
        """A page's messages: events of a stream, None at the end."""
        messages: queue.Queue[bytes | None] = queue.Queue(_WAITING)
        with self.lock:
            self.pages.add(messages)
            self.left = math.inf
            messages.put(_stream_event("story", json.dumps(to_json_data(self.page_state()))))
        return messages

    def remove_page(self, messages: queue.Queue[bytes | None]) -> None:
        """Remove a page that was closed."""
        with self.lock:
            self.pages.discard(messages)
            if not self.pages:
                self.left = time.monotonic()

    def _send_to_pages(self, message: bytes) -> None:
        with self.lock:
            for messages in self.pages:
                with suppress(queue.Full):
                    messages.put_nowait(message)

    def _sample_event(self) -> bytes:
        """The last sample as numbers: time and the columns of the page, one after the other."""
        target, balls = self.pilot.target, np.full((AT_ONCE, 4), np.nan)
        for ball in self.pilot.flying_balls:
            balls[ball.slot] = *ball.place, ball.radius
        pose = np.concatenate([target.r, att.quaternion_from_dcm(target.attitude)])
        samples = page_samples(self.result, self.shown, self.tension)
        values = {name: c.values.ravel() for name, c in samples.items()}
        values |= {"time": self.result.time[-1:], "target": pose, "balls": balls.ravel()}
        names = ["time", *(column["name"] for column in self.info["columns"])]
        numbers = np.concatenate([values[name] for name in names]).astype("<f4")
        return _stream_event("sample", base64.b64encode(numbers.tobytes()).decode("ascii"))

    # -- commands ---------------------------------------------------------------------------------

    def execute_command(self, order: Mapping[str, Any]) -> None:
        """Execute a command of a page.

        Raises
        ------
        ValueError
            The command is unknown or invalid.
        """
        with self.lock:
            match order:
                case {"move": move, "turn": turn}:
                    self.pilot.steer(_clamp_each(move, _FASTEST), _clamp_each(turn, _TURNING))
                case {"formation": str(name)} if name in self.pilot.formations:
                    self.pilot.change_formation(name)
                case {"gust": direction, "strength": strength}:
                    strength = _clamped_number(strength, _STRONGEST)
                    direction = _clamp_each(direction, 1.0)
                    if not np.linalg.norm(direction) > 0.0:  # the square of a tiny one is 0
                        raise ValueError("a gust needs a direction")
                    self.pilot.send_gust(direction, strength)
                case {"ball": place, "radius": radius, "velocity": velocity}:
                    place, velocity = _clamp_each(place, _FARTHEST), _clamp_each(velocity, _FASTEST)
                    self.pilot.add_ball(place, _clamped_number(radius, _FARTHEST), velocity)
                case {"pull": int(slot), "to": place}:
                    goal = None if place is None else _clamp_each(place, _FARTHEST)
                    self.pilot.pull_ball(slot, goal)
                case {"remove": int(slot)}:
                    self.pilot.remove_ball(slot)
                case {"loss": share}:
                    self.pilot.flight.lose_messages(min(abs(_clamped_number(share, 0.95)), 0.95))
                case {"pause": bool(paused)}:
                    self.paused = paused
                case {"speed": float(speed) | int(speed)} if speed in SPEEDS:
                    self.speed = float(speed)
                case {"again": True}:
                    self.keep_flight_and_call_landed()
                    self.begin_flight()
                case {"stop": True}:
                    self.stop()
                case _:
                    raise ValueError(f"unknown command: {json.dumps(order)[:100]}")

    def stop(self) -> None:
        """End the flight."""
        self.stopped.set()

    # -- real time --------------------------------------------------------------------------------

    def run(self) -> None:
        """Fly until stopped, or until the last page has been closed for a while."""
        try:
            self._fly_in_real_time()
        finally:
            self.stop()
            try:
                with self.lock:
                    self.keep_flight_and_call_landed()
            finally:
                self._close_pages()

    def _close_pages(self) -> None:
        with self.lock:
            for messages in self.pages:
                with messages.mutex:
                    messages.queue.clear()
                messages.put(None)
        end = time.monotonic() + _FAREWELL
        while self.pages and time.monotonic() < end:
            time.sleep(0.02)

    def _fly_in_real_time(self) -> None:
        """Fly tick by tick at the pace of the clock, and tell pages what is new, until stopped or nobody looks."""
        sent: dict[str, Any] = {}
        due = measured = time.monotonic()
        flown = 0
        while not self.stopped.is_set():
            now = time.monotonic()
            if now - self.left > _PATIENCE:
                return
            if now - measured > 1.0:
                self.pace = round(flown * TICK / (now - measured) / self.speed, 1)
                measured, flown = now, 0
            with self.lock:
                if self.pages and not (self.paused or self.pilot.flight.ending):
                    self.result = self.pilot.fly_tick()
                    flown += 1
                    self._send_to_pages(self._sample_event())
                else:
                    self.pace = 1.0
                story = self.page_state()
            # The end of the phase under way moves all the time; it alone is no reason to send an update.
            news = story | {"phases": len(story["phases"])}
            if news != sent:
                sent = news
                self._send_to_pages(_stream_event("story", json.dumps(to_json_data(story))))
            due = max(due + TICK / self.speed, now - _LATE)
            self.stopped.wait(max(0.0, due - time.monotonic()))


def _stream_event(name: str, data: str) -> bytes:
    return f"event: {name}\ndata: {data}\n\n".encode()


def _clamped_number(value: Any, most: float) -> float:
    # A whole number may exceed every float.
    if type(value) is not int and not (isinstance(value, float) and math.isfinite(value)):
        raise ValueError("the value must be a finite number")
    return float(min(max(value, -most), most))


def _clamp_each(value: Any, most: float) -> np.ndarray:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError("the value must be a list of three numbers")
    return np.array([_clamped_number(x, most) for x in value])
