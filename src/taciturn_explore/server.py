"""Web server of the page on this machine; access control and the underlying server come from ``taciturn_web``.

``GET /begin`` returns the text of the first setting, and the names of the built-in problems, or the record of a run,
which is all that its page needs. ``POST /answers`` accepts
a request (``session``), and streams the answers as lines of JSON; if the page closes the connection, their computation
ends. ``POST /file`` returns the problem file of a setting.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator, AsyncIterator, Mapping, Sequence
from contextlib import aclosing, asynccontextmanager
from importlib.resources import files
from typing import Any, cast

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import Lifespan

from taciturn.errors import ProblemError
from taciturn_explore.recording import Recording
from taciturn_explore.session import LARGEST_TEXT, Sessions
from taciturn_explore.setting import Setting, Trusted, built_in
from taciturn_explore.work import AT_ONCE, Pool
from taciturn_web.allowance import Allowance
from taciturn_web.guard import guarded, hosts_of, new_token, read_json
from taciturn_web.serving import Served

LARGEST = 3 * LARGEST_TEXT  # bytes of a request
SECONDS, SHARE = 600.0, 0.5  # computing time of a page, and the share of each second that returns to it


def open_page(begin: Setting, trusted: Trusted | None, bind: tuple[str, int], token: str | None = None) -> Served:
    """Start the server of the page and its worker processes; closing the server ends them."""
    first = [("point", (begin.text, False)), ("response", (begin.text,)), ("network", (begin.text,))]
    pool = Pool(trusted, first=first)
    sessions, allowance = Sessions(pool), Allowance(SECONDS, SHARE)

    async def started(_: Request) -> Response:
        return JSONResponse({"text": begin.text, "problems": built_in() if begin.name else []})

    async def answers(request: Request) -> Response:
        asked = _mapping(await read_json(request, LARGEST))
        client = str(asked.get("client", ""))
        allowance.check(client)
        return StreamingResponse(_lines(sessions, asked, allowance, client), media_type="application/x-ndjson")

    async def file(request: Request) -> Response:
        asked = _mapping(await read_json(request, LARGEST))
        job = pool.submit(str(asked.get("client", "")), "file", str(asked.get("text", "")), rank=AT_ONCE)
        return PlainTextResponse(await asyncio.wrap_future(job), media_type="application/toml")

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        yield
        await asyncio.to_thread(pool.close)

    routes = [
        Route("/begin", started),
        Route("/answers", answers, methods=["POST"]),
        Route("/file", file, methods=["POST"]),
    ]
    try:
        return _served(routes, bind, token, lifespan)
    except ProblemError:
        pool.close()
        raise


def open_recording(found: Recording, bind: tuple[str, int], token: str | None = None) -> Served:
    """Start the server of a page that shows a recorded run; it serves the page until it is closed."""
    shown = found.document()

    async def first(_: Request) -> Response:
        return JSONResponse({"recording": shown})

    return _served([Route("/begin", first)], bind, token, None)


def _served(
    routes: Sequence[Route], bind: tuple[str, int], token: str | None, lifespan: Lifespan[Starlette] | None
) -> Served:
    folder = files("taciturn_explore") / "web"
    given = token or new_token()
    return Served(guarded(routes, token=given, hosts=hosts_of(bind), assets=folder, lifespan=lifespan), bind)


async def _lines(
    sessions: Sessions, asked: Mapping[str, Any], allowance: Allowance, client: str
) -> AsyncIterator[bytes]:
    """Yield the answers to a request as lines; the response ends this when the client leaves."""
    before = sessions.pool.seconds[client]
    try:
        async with aclosing(sessions.answers(asked)) as found:
            async for answer in found:
                yield json.dumps(answer, separators=(",", ":")).encode() + b"\n"
                await asyncio.sleep(0)  # the loop hears that the client has left before more is written
    finally:
        allowance.use(client, sessions.pool.seconds[client] - before)


def _mapping(asked: object) -> Mapping[str, Any]:
    if not isinstance(asked, Mapping):
        raise ProblemError("the request is not a JSON object; expected a JSON object")
    return cast("Mapping[str, Any]", asked)
