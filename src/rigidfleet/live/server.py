"""A session on this machine's own address: a page, a stream of events, commands.

Only this machine reaches it. Its address holds a secret, and requests that name another host are
refused, so that other pages in the same browser can neither see nor fly it.
"""

from __future__ import annotations

import json
import queue
import secrets
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from types import TracebackType
from typing import Self

from rigidfleet.errors import FlightError
from rigidfleet.live.session import Session

_HOST = "127.0.0.1"
_LARGEST = 10_000  # bytes of a command
_SILENCE = 1.0  # after which a word is sent to learn whether anybody listens [s]


class Server:
    """Serves a session while its context lasts.

    Raises
    ------
    FlightError
        The port cannot be used.
    """

    def __init__(self, session: Session, port: int = 0) -> None:
        class Handler(_Handler):
            pass

        Handler.session, Handler.base = session, f"/{secrets.token_urlsafe(12)}/"
        try:
            self.http = ThreadingHTTPServer((_HOST, port), Handler)
        except (OSError, OverflowError) as error:
            why = getattr(error, "strerror", None) or error
            raise FlightError(
                f"port {port} cannot be used ({why}). Name another, or none to have a free one chosen"
            ) from error
        self.http.daemon_threads = True
        Handler.port = self.http.server_port
        self.url = f"http://{_HOST}:{Handler.port}{Handler.base}"
        self.thread = Thread(target=self.http.serve_forever, args=(0.1,), daemon=True)

    def __enter__(self) -> Self:
        self.thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.http.shutdown()
        self.http.server_close()
        self.thread.join()


class _Handler(BaseHTTPRequestHandler):
    session: Session
    base: str
    port: int

    def do_GET(self) -> None:
        """Send the page, or its stream."""
        if not self._ours():
            return
        if self.path == self.base:
            self._answer(HTTPStatus.OK, self.session.html(), "text/html; charset=utf-8")
        elif self.path == f"{self.base}stream":
            self._stream()
        else:
            self._answer(HTTPStatus.NOT_FOUND, "there is nothing here")

    def do_POST(self) -> None:
        """Do what a page asks."""
        if not self._ours():
            return
        if self.path != f"{self.base}command":
            self._answer(HTTPStatus.NOT_FOUND, "there is nothing here")
            return
        try:
            length = int(self.headers.get("Content-Length", ""))
            if not 0 < length <= _LARGEST:
                raise ValueError("a command is shorter")
            asked = json.loads(self.rfile.read(length))
            if not isinstance(asked, dict):
                raise ValueError("a command is an object")
            self.session.command(asked)
        except ValueError as error:
            self._answer(HTTPStatus.BAD_REQUEST, str(error))
        else:
            self._answer(HTTPStatus.NO_CONTENT, "")

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing: the terminal is the user's."""

    def _ours(self) -> bool:
        """Is it our page that asks? Everything else is refused."""
        hosts = {f"{name}:{self.port}" for name in (_HOST, "localhost")}
        origin = self.headers.get("Origin")
        ours = self.headers.get("Host") in hosts and self.path.startswith(self.base)
        if ours and (origin is None or origin.removeprefix("http://") in hosts):
            return True
        self._answer(HTTPStatus.FORBIDDEN, "open the address that the program has printed")
        return False

    def _answer(self, status: HTTPStatus, text: str, kind: str = "text/plain") -> None:
        data = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self._send(data)

    def _send(self, data: bytes) -> bool:
        """Send; False if nobody listens any more."""
        try:
            self.wfile.write(data)
            self.wfile.flush()
        except OSError:
            return False
        return True

    def _stream(self) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        messages = self.session.join()
        try:
            while True:
                try:
                    message = messages.get(timeout=_SILENCE)
                except queue.Empty:
                    message = b": still here\n\n"
                if message is None:
                    self._send(b"event: end\ndata: \n\n")
                    return
                if not self._send(message):
                    return
        finally:
            self.session.leave(messages)
