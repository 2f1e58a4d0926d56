"""Clients of a page without a browser, and the smallest page."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from importlib.resources import files
from typing import Any, Protocol
from urllib.parse import parse_qs, urlsplit

from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from taciturn_web.events import Log
from taciturn_web.guard import guarded, hosts_of, new_token, read_json
from taciturn_web.serving import Served

JSON = {"Content-Type": "application/json"}


class Site(Protocol):
    """What is served at an address; its URL has the token."""

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        ...

    @property
    def url(self) -> str:
        """With the token."""
        ...


class Small:
    """A page with a log at ``/events``, an echo of JSON at ``/echo``, and an answer without an end at ``/endless``."""

    def __init__(self, bind: tuple[str, int] = ("127.0.0.1", 0), token: str | None = None) -> None:
        """Serve it, with the files of the robots' page."""
        self.log, self.echoed = Log("wait"), list[Any]()
        routes = [
            Route("/events", self.log.answer),
            Route("/echo", self._echo, methods=["POST"]),
            Route("/endless", self._go_on),
        ]
        given, folder = new_token() if token is None else token, files("taciturn_twins") / "web"
        self._served = Served(guarded(routes, token=given, hosts=hosts_of(bind), assets=folder), bind)
        self.address, self.url = self._served.address, self._served.url

    async def _echo(self, request: Request) -> Response:
        self.echoed.append(await read_json(request, 256))
        return JSONResponse(self.echoed[-1])

    async def _go_on(self, _: Request) -> Response:
        async def chunks() -> Any:
            while True:
                yield b"x" * 10_000

        return StreamingResponse(chunks())

    def close(self) -> None:
        """End it."""
        self.log.end()
        self._served.close()

    def __enter__(self) -> Small:
        """Begin."""
        return self

    def __exit__(self, *_: object) -> None:
        """End."""
        self.close()


class Reader:
    """Follows the events of a page."""

    def __init__(self, site: Site, last: str = "") -> None:
        """Ask for the events that follow the last one."""
        self._connection = http.client.HTTPConnection(*site.address, timeout=10)
        headers = {"Last-Event-ID": last} if last else {}
        self._connection.request("GET", f"/events?{urlsplit(site.url).query}", headers=headers)
        self._answer = self._connection.getresponse()
        assert self._answer.headers["Content-Type"] == "text/event-stream; charset=utf-8"
        self.last = ""

    def next(self) -> tuple[str, Any]:
        """Return kind and data of the next event; ("", None) where the stream has ended."""
        fields: dict[str, str] = {}
        while (line := self._answer.readline().decode().rstrip("\n")) or "event" not in fields:
            if not line and self._answer.isclosed():
                return "", None
            name, _, value = line.partition(": ")
            fields[name] = value
        self.last = fields.get("id", self.last)
        return fields["event"], json.loads(fields["data"])

    def take(self, count: int) -> list[tuple[str, Any]]:
        """Return so many events."""
        return [self.next() for _ in range(count)]

    def __iter__(self) -> Iterator[tuple[str, Any]]:
        """Return the events until the end."""
        return iter(self.next, ("", None))

    def close(self) -> None:
        """Go away."""
        self._answer.close()
        self._connection.close()


def call(
    site: Site, method: str, path: str, body: bytes | str | None = None, headers: dict[str, str] | None = None
) -> tuple[int, bytes]:
    """Return status and body of an answer; every answer must have the headers that protect the page."""
    connection = http.client.HTTPConnection(*site.address, timeout=10)
    try:
        connection.request(method, path, body, headers or {})
        answer = connection.getresponse()
        assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert answer.headers["Access-Control-Allow-Origin"] is None
        return answer.status, answer.read()
    finally:
        connection.close()


def with_token(site: Site) -> dict[str, str]:
    """Return the header of a user of a page."""
    return {"Authorization": f"Bearer {parse_qs(urlsplit(site.url).query)['token'][0]}"}


def post(site: Site, path: str, value: object, headers: dict[str, str] | None = None) -> int:
    """Send JSON as a user of the page; return the status."""
    return call(site, "POST", path, json.dumps(value), {**JSON, **with_token(site), **(headers or {})})[0]
