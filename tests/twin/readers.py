"""Readers of a page without a browser."""

from __future__ import annotations

import http.client
import json
from typing import Any

from taciturn_twins.page import Page

JSON = {"Content-Type": "application/json"}


class Reader:
    """Follows the events of a page."""

    def __init__(self, page: Page, last: str = "") -> None:
        """Ask for the events that follow the last one."""
        self._connection = http.client.HTTPConnection(*page.address, timeout=10)
        _, mark, query = page.url.partition("?")
        headers = {"Last-Event-ID": last} if last else {}
        self._connection.request("GET", f"/events{mark}{query}", headers=headers)
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

    def close(self) -> None:
        """Go away."""
        self._answer.close()
        self._connection.close()


def call(
    page: Page, method: str, path: str, body: bytes | str | None = None, headers: dict[str, str] | None = None
) -> tuple[int, bytes]:
    """Return status and body of an answer; every answer must have the headers that protect the page."""
    connection = http.client.HTTPConnection(*page.address, timeout=10)
    try:
        connection.request(method, path, body, headers or {})
        answer = connection.getresponse()
        assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert answer.headers["Access-Control-Allow-Origin"] is None
        return answer.status, answer.read()
    finally:
        connection.close()


def ask(page: Page, what: str, value: object, headers: dict[str, str] | None = None) -> int:
    """Ask the run for something; return the status."""
    return call(page, "POST", "/ask", json.dumps({"ask": what, "value": value}), {**JSON, **(headers or {})})[0]
