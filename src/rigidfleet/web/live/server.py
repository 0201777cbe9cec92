"""Serve a live session on this machine's own address: a page, a stream of events, commands.

Only this machine can reach it. The address holds a secret, and requests that name another host or come
from another origin are refused. Other pages in the same browser can therefore neither see nor control
the flight, whatever name they use for this machine.
"""

from __future__ import annotations

import json
import queue
import secrets
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Self

from rigidfleet.errors import FlightError, RigidfleetError
from rigidfleet.web.live.session import Session

_HOST = "127.0.0.1"
_LARGEST = 10_000  # greatest size of a command [bytes]
_IDLE = 10.0  # time that a connection may take to send its request, or to take a message [s]
_SILENCE = 1.0  # silence after which a message tests whether the page still listens [s]
#: Headers of every answer. The page has its own policy, but only a header can forbid frames around it.
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",  # the address holds the secret
    "X-Content-Type-Options": "nosniff",
}


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
                f"port {port} cannot be used ({why}). Choose another, or give none to use any free port"
            ) from error
        self.http.daemon_threads = True
        Handler.port = self.http.server_port
        self.url = f"http://{_HOST}:{Handler.port}{Handler.base}"
        self.thread = Thread(target=self.http.serve_forever, args=(0.1,), daemon=True)

    def __enter__(self) -> Self:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.http.shutdown()
        self.http.server_close()
        self.thread.join()


class _Handler(BaseHTTPRequestHandler):
    session: Session
    base: str
    port: int
    server_version, sys_version = "rigidfleet", ""
    timeout = _IDLE  # [s] of the socket: who connects and sends nothing does not keep a thread

    def parse_request(self) -> bool:
        """Read a request; whatever its method, refuse it unless it comes from our page."""
        if not super().parse_request():
            return False
        if self._is_from_our_page():
            return True
        self._send_answer(HTTPStatus.FORBIDDEN, "open the address that the program printed")
        return False

    def do_GET(self) -> None:
        """Send the page, or its stream."""
        if self.path == self.base:
            self._send_answer(HTTPStatus.OK, self.session.html(), "text/html; charset=utf-8")
        elif self.path == f"{self.base}stream":
            self._send_stream()
        else:
            self._send_answer(HTTPStatus.NOT_FOUND, "there is nothing here")

    def do_POST(self) -> None:
        """Execute a command of a page."""
        if self.path != f"{self.base}command":
            self._send_answer(HTTPStatus.NOT_FOUND, "there is nothing here")
            return
        try:
            length = int(self.headers.get("Content-Length", ""))
            if not 0 < length <= _LARGEST:
                raise ValueError(f"a command has 1 to {_LARGEST} bytes")
            command = json.loads(self.rfile.read(length))
            if not isinstance(command, dict):
                raise ValueError("a command must be an object")
            self.session.execute_command(command)
        except RecursionError:
            self._send_answer(HTTPStatus.BAD_REQUEST, "the command is nested too deeply")
        except (ValueError, RigidfleetError) as error:
            self._send_answer(HTTPStatus.BAD_REQUEST, str(error))
        else:
            self._send_answer(HTTPStatus.NO_CONTENT, "")

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: the terminal belongs to the user."""

    def _is_from_our_page(self) -> bool:
        """Whether our page sends the request, to our own address; a command also names its origin."""
        hosts_named, origins = self.headers.get_all("Host", []), self.headers.get_all("Origin", [])
        hosts = {f"{name}:{self.port}" for name in (_HOST, "localhost")}
        host = hosts_named[0] if len(hosts_named) == 1 else ""
        if host not in hosts or not self.path.startswith(self.base):
            return False
        return origins == [f"http://{host}"] or (not origins and self.command == "GET")

    def _send_answer(self, status: HTTPStatus, text: str, kind: str = "text/plain") -> None:
        data = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self._send(data)

    def end_headers(self) -> None:
        """Send the headers: no caching, no frames, no guessing of the content type."""
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def _send(self, data: bytes) -> bool:
        """Send data; return False if the page no longer listens."""
        try:
            self.wfile.write(data)
            self.wfile.flush()
        except OSError:
            return False
        return True

    def _send_stream(self) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/event-stream")
        self.end_headers()
        messages = self.session.add_page()
        try:
            while True:
                try:
                    message = messages.get(timeout=_SILENCE)
                except queue.Empty:
                    message = b": still here\n\n"
                if message is None:
                    self._send(
                        f"event: end\ndata: {json.dumps(self.session.farewell)}\n\n".encode()
                    )
                    return
                if not self._send(message):
                    return
        finally:
            self.session.remove_page(messages)
