"""A small web server for the pages of a run: their files, a stream of events, the newest picture, and requests.

``GET /``, its scripts and styles; ``GET /events``: server-sent events; ``GET /picture``: a JPEG; ``POST /ask``: JSON as
``{"ask": "value", "value": 0.01}``. Each connection has a thread of its own, and every read and write has a time limit.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from socketserver import TCPServer
from typing import Any

from taciturn.errors import ProblemError
from taciturn.runtime.udp import Address
from taciturn.twin.door import Door
from taciturn.twin.feed import Feed

SEATS = 128  # connections at a time
PULSE = 2.0  # seconds of silence after which a reader hears that the run is there
PATIENCE = 10.0  # seconds that a client may take to send a request, or to read an answer
FAREWELL = 1.0  # seconds for the readers to hear that the run has ended
LARGEST = 256  # bytes of a request's body
_TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
    ".LICENSE": "text/plain",
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",  # the address may hold a token
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Server(ThreadingHTTPServer):
    """Serves a feed in threads of its own until it is closed.

    Args:
        bind: where to listen; port 0: any free one.
        feed: what is served.
        door: who may see and act.

    Raises:
        ProblemError: the address is in use, or not of this machine.
    """

    request_queue_size = 64

    def __init__(self, bind: Address, feed: Feed, door: Door) -> None:
        """Bind and serve."""
        self._feed, self._answering = feed, list[threading.Thread]()
        try:
            super().__init__(bind, partial(_Handler, feed, door, _read_files()))
        except OSError as error:
            raise ProblemError(
                f"{bind[0]}:{bind[1]} cannot serve the page ({error.strerror}); expected a free port of this machine: "
                "choose another one, or 0 for any"
            ) from None
        self._thread = threading.Thread(target=self.serve_forever, args=(0.03,), daemon=True)
        self._thread.start()

    @property
    def address(self) -> Address:
        """Where it listens."""
        host, port = self.server_address[:2]
        return str(host), int(port)

    def close(self) -> None:
        """Tell the readers that the run has ended, and free the port."""
        self._feed.end()
        self.shutdown()
        self._thread.join()
        self.server_close()
        end = time.monotonic() + FAREWELL
        for thread in self._answering:  # so that a process that ends now does not cut their last words
            thread.join(max(0.0, end - time.monotonic()))

    def server_bind(self) -> None:
        """Bind without asking the network for a name of this machine, which may take seconds."""
        TCPServer.server_bind(self)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread, where a seat is free."""
        self._answering = [thread for thread in self._answering if thread.is_alive()]
        if len(self._answering) >= SEATS:
            self.shutdown_request(request)
            return
        thread = threading.Thread(target=self.process_request_thread, args=(request, client_address), daemon=True)
        self._answering.append(thread)
        thread.start()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of clients that go away."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    disable_nagle_algorithm = True
    server_version, sys_version = "taciturn", ""

    def __init__(self, feed: Feed, door: Door, kept: dict[str, tuple[str, bytes]], *connection: Any) -> None:
        self._feed, self._door, self._files = feed, door, kept
        super().__init__(*connection)  # which answers the request

    def setup(self) -> None:
        self.request.settimeout(PATIENCE)
        super().setup()

    def do_GET(self) -> None:
        path, _, query = self.path.partition("?")
        if path in self._files and path != "/":  # the same for everybody
            self._answer(200, *self._files[path])
        elif path not in ("/", "/events", "/picture"):
            self._refuse(404, "there is no such page")
        elif not self._door.admits(self.headers, query):
            self._refuse(403, "open this page by the address that the run printed, which names this machine or a token")
        elif path == "/events":
            self._stream()
        elif path == "/":
            self._answer(200, *self._files["/"])
        elif picture := self._feed.picture:
            self._answer(200, "image/jpeg", picture)
        else:
            self._refuse(404, "there is no picture yet")

    def do_POST(self) -> None:
        text = self.headers.get("Content-Length", "")
        length = int(text) if text.isdecimal() and len(text) < 20 else -1
        body = self.rfile.read(min(max(length, 0), 1 << 16))  # what is not read is an answer that may be lost
        if self.path != "/ask":
            self._refuse(404, "there is no such page")
        elif not self._door.obeys(self.headers):
            self._refuse(403, "this request carries no token, comes from elsewhere, or is no application/json")
        elif length < 0:
            self._refuse(411, "the length of the request is not given")
        elif length > LARGEST:
            self._refuse(413, f"the request has {length} bytes; expected at most {LARGEST}")
        else:
            self._ask(body)

    def end_headers(self) -> None:
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        pass

    def _ask(self, body: bytes) -> None:
        try:
            asked: Any = json.loads(body)
            self._feed.ask(str(asked["ask"]), asked["value"])
        except ProblemError as error:
            self._refuse(400, str(error))
        except (ValueError, TypeError, KeyError):
            self._refuse(400, 'expected JSON as {"ask": "value", "value": 0.01}')
        else:
            self._answer(200, "application/json", b"{}")

    def _stream(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream; charset=utf-8")
        self.end_headers()
        self.wfile.write(b"retry: 1000\n\n")
        since, picture, ended = self._feed.resume(self.headers.get("Last-Event-ID", "")), 0, False
        while not ended:
            text, since, picture, ended = self._feed.news(since, picture, PULSE)
            self.wfile.write(text or b"event: alive\ndata: null\n\n")

    def _answer(self, code: int, kind: str, body: bytes) -> None:
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _refuse(self, code: int, sentence: str) -> None:
        self._answer(code, "text/plain; charset=utf-8", sentence.encode())


def _read_files() -> dict[str, tuple[str, bytes]]:
    """Return type and content of every file of the page by its path: no path is ever made of a request."""
    found: dict[str, tuple[str, bytes]] = {}
    for file in (files("taciturn") / "twin" / "web").iterdir():
        kind = _TYPES["." + file.name.rpartition(".")[2]]
        found["/" if file.name == "index.html" else f"/{file.name}"] = (f"{kind}; charset=utf-8", file.read_bytes())
    return found
