"""Access control of web pages: every request must contain the page's secret token.

Any web page that is open in a browser of this machine can send requests to a server here, also under a name of its own
(DNS rebinding). A request passes three checks:

* Its header Host is a name of this machine.
* Its header Origin, if there is one, is that of the page itself.
* It contains the token: in its URL if it reads, or in the header ``Authorization: Bearer TOKEN``, which another page
  cannot send. Scripts and styles are public.

A connection whose request has passed is admitted (``connections``). Every answer forbids scripts and styles from
elsewhere or inside a document, and ends its connection.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import re
import secrets
import socket
from collections.abc import Collection, Sequence
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any
from urllib.parse import quote

from starlette.applications import Starlette
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute, Route
from starlette.types import ASGIApp, Lifespan, Message, Receive, Scope, Send

from taciturn.errors import ProblemError
from taciturn.nodes.keys import is_loopback
from taciturn_web.connections import Connection

EVERY = "0.0.0.0"  # address that stands for all addresses of this machine
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",  # the address contains the token
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Connection": "close",  # so that each request has its own limits of time
}
_TYPES = {"css": "text/css", "html": "text/html", "js": "text/javascript", "svg": "image/svg+xml"}
_HOST = re.compile(r"(?:\[([\da-f:]+)\]|([\w.-]+))(?::\d+)?", re.IGNORECASE)  # an address or a name, and a port


def new_token() -> str:
    """Return a random token."""
    return secrets.token_urlsafe(24)


def hosts_of(bind: tuple[str, int]) -> frozenset[str]:
    """Return the host names under which a browser may open a page that is served at an address."""
    host = bind[0] or EVERY
    name = socket.gethostname().lower()
    elsewhere = () if is_loopback(host) else (name, f"{name}.local", name.partition(".")[0])
    return frozenset(("localhost", "127.0.0.1", "::1", host, *elsewhere))


def guarded(
    routes: Sequence[BaseRoute],
    *,
    token: str,
    hosts: Collection[str],
    assets: Traversable,
    lifespan: Lifespan[Starlette] | None = None,
) -> Starlette:
    """Return a web application that serves routes and the files of a folder to users with the token.

    ``index.html`` is the page itself, at ``/``; the other files, and those of ``taciturn_web/assets``, are public. The
    names in ``hosts`` are those of this machine; with 0.0.0.0, every address is one of them. A ``ProblemError`` becomes
    an answer with status 400. The application runs under ``Served``.
    """
    if not (token and token.isascii() and token.isprintable() and " " not in token):
        raise ProblemError(f"token is {token!r}; expected printable ASCII characters without spaces")
    public = _read_files(files("taciturn_web") / "assets") | _read_files(assets)
    app = Starlette(
        routes=[Route("/", public.pop("/index.html"), methods=["GET"]), *routes],
        middleware=[Middleware(_Guard, token, frozenset(hosts), public)],
        exception_handlers={ProblemError: _say},
        lifespan=lifespan,
    )
    app.state.query = f"?token={quote(token, safe='')}"
    return app


async def read_json(request: Request, largest: int) -> Any:
    """Return the JSON body of a request; reject a body that is not JSON or is larger than ``largest`` bytes."""
    if request.headers.get("Content-Type", "").partition(";")[0].strip().lower() != "application/json":
        raise HTTPException(415, "the request is not application/json")
    body = bytearray()
    async for part in request.stream():
        body += part
        if len(body) > largest:
            raise HTTPException(413, f"the request has more than {largest} bytes; expected at most so many")
    try:
        return json.loads(body)
    except (ValueError, RecursionError):
        raise HTTPException(400, "the request is not JSON") from None


class _Guard:
    """The access control of an application, to whose requests ``Served`` adds their connection."""

    def __init__(self, app: ASGIApp, token: str, hosts: frozenset[str], public: dict[str, Response]) -> None:
        self._app, self._token, self._hosts, self._public = app, token, hosts, public

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        connection: Connection = scope["state"]["connection"]

        async def hear() -> Message:
            message = await receive()
            if not message.get("more_body", False):
                connection.wait(False)
            return message

        async def say(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)  # which returns at once if there is room, or if the client is gone
            await asyncio.sleep(0.0)

        answer = self._check(Request(scope), connection) or self._app
        try:
            await answer(scope, hear, say)
        except ClientDisconnect:
            pass
        finally:
            connection.wait(True)

    def _check(self, request: Request, connection: Connection) -> Response | None:
        """Return the answer to a request, or None if it passes to the application."""
        headers, path, reads = request.headers, request.scope["path"], request.method in ("GET", "HEAD")
        host = headers.get("Host", "")
        if not self._is_own(host) or any(origin != f"http://{host}" for origin in headers.getlist("Origin")):
            return PlainTextResponse("the request comes from another page, or names another machine", 403)
        if reads and path in self._public:
            return self._public[path]
        given = [text.removeprefix("Bearer ") for text in headers.getlist("Authorization")]
        given = given or (request.query_params.getlist("token") if reads else [])
        if not self._fits(given):
            which = "another token than that of this page" if any(given) else "no token"
            return PlainTextResponse(f"the request has {which}; expected the address that was printed: open it", 403)
        if not connection.admit():
            return PlainTextResponse("too many of these pages are open; close one, and open this page again", 503)
        if "Content-Length" not in headers and "Transfer-Encoding" not in headers:
            connection.wait(False)
        return None

    def _is_own(self, host: str) -> bool:
        """Return whether the header Host is a name of this machine or an address; no other page can have it."""
        found = _HOST.fullmatch(host)
        if found is None:
            return False
        name, digits = (found[1] or found[2]).lower(), (found[2] or "0").replace(".", "")
        return name in self._hosts or (EVERY in self._hosts and digits.isdigit())

    def _fits(self, given: list[str]) -> bool:
        return len(given) == 1 and hmac.compare_digest(given[0].encode("utf-8", "replace"), self._token.encode())


def _read_files(folder: Traversable) -> dict[str, Response]:
    """Return every file of a folder by path; a request can only select one of these paths."""
    kinds = {one: _TYPES.get(one.name.rpartition(".")[2], "text/plain") for one in folder.iterdir()}
    return {f"/{one.name}": Response(one.read_bytes(), media_type=kind) for one, kind in kinds.items()}


async def _say(_: Request, error: Exception) -> Response:
    return PlainTextResponse(str(error), 400)
