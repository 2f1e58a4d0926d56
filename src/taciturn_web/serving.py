"""Web server of a page: uvicorn on a thread of this process, while the main thread handles signals."""

from __future__ import annotations

import asyncio
import os
import socket
import threading
import time
from contextlib import AbstractContextManager

import uvicorn
from starlette.applications import Starlette

from taciturn.errors import ProblemError
from taciturn_web.connections import Connection
from taciturn_web.guard import EVERY

FAREWELL = 0.6  # seconds for which the server waits until all answers have been read
LARGEST = 1 << 14  # largest number of bytes of a header that has not arrived as a whole


class Served(AbstractContextManager["Served"]):
    """Web server of an application from ``guarded``; it runs until it is closed or the ``with`` block ends.

    ``url`` is the address of the page for browsers on this machine, with the token; on other machines, the host name
    differs.
    """

    def __init__(self, app: Starlette, bind: tuple[str, int] = ("127.0.0.1", 0)) -> None:
        """Listen on an address, where port 0 is a free one, and serve."""
        try:
            listening = socket.create_server(bind)
        except OSError as error:
            raise ProblemError(
                f"the address {bind[0]}:{bind[1]} cannot serve the page ({os.strerror(error.errno or 0)}); expected a "
                "free port of this machine: choose another one, or 0 for any"
            ) from None
        host, port = listening.getsockname()[:2]
        self.address: tuple[str, int] = (str(host), int(port))
        self.url = f"http://{'127.0.0.1' if host == EVERY else host}:{port}/{app.state.query}"
        self._server = _Server(app)
        self._thread = threading.Thread(target=self._serve, args=(listening,), name="page", daemon=True)
        self._thread.start()
        while not self._server.started:
            if not self._thread.is_alive():
                raise RuntimeError("the server of the page stopped while it was starting")
            time.sleep(0.002)

    def close(self) -> None:
        """Let clients finish reading answers that have begun, and free the port."""
        self._server.should_exit = True
        self._thread.join(2.0)

    def __exit__(self, *_: object) -> None:
        """Close the server."""
        self.close()

    def _serve(self, listening: socket.socket) -> None:
        asyncio.run(self._server.serve(sockets=[listening]))


class _Server(uvicorn.Server):
    """A server that closes the connections that remain open when it ends."""

    def __init__(self, app: Starlette) -> None:
        super().__init__(
            uvicorn.Config(
                app,
                http=Connection,
                ws="none",
                lifespan="on",
                log_config=None,
                log_level="error",
                proxy_headers=False,  # an address that a header claims is not that of the client
                backlog=128,  # connections that are accepted at once
                timeout_graceful_shutdown=1,
                h11_max_incomplete_event_size=LARGEST,
            )
        )

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        for one in self.server_state.connections:
            asyncio.get_running_loop().call_later(FAREWELL, one.transport.abort)
        await super().shutdown(sockets)
