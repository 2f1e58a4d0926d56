"""A small web server for the live page of a run.

``GET /`` returns the page; its scripts and styles have further paths. ``GET /events`` returns server-sent events, and
``GET /picture`` the newest picture as JPEG. ``POST /ask`` accepts a request as JSON, e.g.
``{"ask": "value", "value": 0.01}``. Each connection has a separate thread. A request must arrive within a time limit as
a whole, and every answer has a time limit.
"""

from __future__ import annotations

import io
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
from taciturn_twins.access_control import AccessControl
from taciturn_twins.connections import Connections, Timed
from taciturn_twins.feed import Feed
from taciturn_udp.endpoint import Address

PULSE = 2.0  # seconds between keep-alive events while there are no other events
PATIENCE = 10.0  # seconds in which a client must send a whole request, and in which it must read an answer
FAREWELL = 1.0  # seconds for which the server waits until all readers have received the end of the run
LARGEST = 256  # largest body of a request in bytes
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
    "Referrer-Policy": "no-referrer",  # the address may contain a token
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Server(ThreadingHTTPServer):
    """A web server that serves a feed in separate threads until it is closed.

    Args:
        bind: address to listen on; with port 0, the system chooses a free port.
        feed: feed to serve.
        access: access control for every request.

    Raises:
        ProblemError: the address is in use, or belongs to another machine.
    """

    request_queue_size = 256

    def __init__(self, bind: Address, feed: Feed, access: AccessControl) -> None:
        """Bind the socket, and start to serve."""
        self._feed, self._answering, self._connections = feed, list[threading.Thread](), Connections()
        try:
            super().__init__(bind, partial(_Handler, feed, access, self._connections, _read_files()))
        except OSError as error:
            raise ProblemError(
                f"{bind[0]}:{bind[1]} cannot serve the page ({error.strerror}); expected a free port of this machine: "
                "choose another one, or 0 for any"
            ) from None
        self._thread = threading.Thread(target=self.serve_forever, args=(0.03,), daemon=True)
        self._thread.start()

    @property
    def address(self) -> Address:
        """The address that the server listens on."""
        host, port = self.server_address[:2]
        return str(host), int(port)

    def close(self) -> None:
        """Send the end of the run to all readers, and free the port."""
        self._feed.end()
        self.shutdown()
        self._thread.join()
        self.server_close()
        self._connections.dismiss()
        end = time.monotonic() + FAREWELL
        for thread in self._answering:  # if the process ended now, the last events would be cut off
            thread.join(max(0.0, end - time.monotonic()))

    def server_bind(self) -> None:
        """Bind without looking up the name of this machine, which may take seconds."""
        TCPServer.server_bind(self)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a request in a separate thread, after access control."""
        self._answering = [thread for thread in self._answering if thread.is_alive()]
        self._connections.enter(request, client_address[0])
        thread = threading.Thread(target=self.process_request_thread, args=(request, client_address), daemon=True)
        self._answering.append(thread)
        thread.start()

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        self._connections.leave(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore clients that disconnect."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    disable_nagle_algorithm = True
    server_version, sys_version = "taciturn", ""

    def __init__(
        self,
        feed: Feed,
        access: AccessControl,
        connections: Connections,
        kept: dict[str, tuple[str, bytes]],
        *connection: Any,
    ) -> None:
        self._feed, self._access, self._connections, self._files = feed, access, connections, kept
        super().__init__(*connection)  # answers the request

    def setup(self) -> None:
        super().setup()
        self.rfile = io.BufferedReader(Timed(self.request, PATIENCE))  # one deadline for the request as a whole

    def do_GET(self) -> None:
        path, _, query = self.path.partition("?")
        if path in self._files and path != "/":  # public files, without access control
            self._answer(200, *self._files[path])
        elif path not in ("/", "/events", "/picture"):
            self._refuse(404, "there is no such page")
        elif not self._access.admits(self.headers, query):
            self._refuse(403, "open this page at the address that the run printed, with this machine's name or a token")
        elif not self._connections.admit(self.request):
            self._refuse(503, "too many pages of this run are open; close one, and open this page again")
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
        body = self.rfile.read(min(max(length, 0), 1 << 16))  # with an unread body the answer may be cut off
        if self.path != "/ask":
            self._refuse(404, "there is no such page")
        elif not self._access.obeys(self.headers):
            self._refuse(403, "the request has no token, comes from another page, or is not application/json")
        elif not self._connections.admit(self.request):
            self._refuse(503, "too many pages of this run are open; close one, and try again")
        elif length < 0:
            self._refuse(411, "the request lacks its Content-Length")
        elif length > LARGEST:
            self._refuse(413, f"the request has {length} bytes; expected at most {LARGEST}")
        else:
            self._ask(body)

    def send_response(self, code: int, message: str | None = None) -> None:
        self.request.settimeout(PATIENCE)  # from now on for what is written
        super().send_response(code, message)

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
    """Return the type and content of every file of the page by path; a request can only select one of these paths."""
    found: dict[str, tuple[str, bytes]] = {}
    for file in (files("taciturn_twins") / "web").iterdir():
        kind = _TYPES["." + file.name.rpartition(".")[2]]
        found["/" if file.name == "index.html" else f"/{file.name}"] = (f"{kind}; charset=utf-8", file.read_bytes())
    return found
