"""Compute the answers for a setting, and stream them to the page in the order in which the page needs them.

First the setting with its controls, the coarse point, the response and the network: the live answers. Then, if no other
setting has followed meanwhile, the curve of the policy, periodic control, the refined point, the difference to a pinned
setting, the curves of other kinds, periodic control at the traffic of several links, and the lower bound. Each answer
contains the text of its setting. A new request of a client ends the former one, whose jobs are dropped. A refusal of a
setting states whether its loop is unstable; otherwise its input is bad.

A request has a ``client``, the name of a page; ``text``, a setting; ``changes``, new values of keys, and ``parts``,
other changes of the setting; ``pinned``, the text of another setting, or an empty text; and ``only``, which is
``"point"`` if nothing else is wanted.

Curves do not depend on the value of the trade-off parameter, and are kept by their texts.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import AsyncGenerator, AsyncIterator, Hashable, Mapping
from contextlib import aclosing
from typing import Any, cast

from taciturn.errors import ProblemError, TaciturnError, UnstableError
from taciturn.extend import quoted
from taciturn_explore.curves import values_of_curve
from taciturn_explore.work import AT_ONCE, LATER, SHOWN, EndedError, Job, Pool, Stopped

REST = 0.25  # seconds without a new setting after which the answers are refined
KEPT = 4096  # answers that do not change while a point moves
BATCH = 4  # points of a curve between two answers
MOST_CLIENTS = 64
LARGEST_TEXT = 2**19  # letters of a setting


class Sessions:
    """The requests of all pages."""

    def __init__(self, pool: Pool) -> None:
        """Start without clients."""
        self.pool = pool
        self._present: dict[str, _Request] = {}
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()

    async def answers(self, request: Mapping[str, Any]) -> AsyncGenerator[dict[str, Any]]:
        """Yield the answers to one request of the page."""
        client, text = str(request.get("client", ""))[:64], str(request.get("text", ""))
        if len(text) > LARGEST_TEXT:
            yield {"answer": "refused", "setting": "", "sentence": "the address is too long; expected a shorter one"}
            return
        former = self._present.get(client)
        if former is not None:
            former.end()
        if len(self._present) >= MOST_CLIENTS and former is None:
            yield {
                "answer": "refused",
                "setting": text,
                "sentence": "too many pages are open; expected fewer: close one",
            }
            return
        present = self._present[client] = _Request(self, client)
        try:
            async with aclosing(present.answers(text, request)) as found:
                async for one in found:
                    yield one
        except Stopped:
            return
        finally:
            present.end()
            if self._present.get(client) is present:
                del self._present[client]

    def known(self, key: Hashable) -> Any:
        """Return an answer from the cache; None if the cache does not contain it."""
        if key in self._kept:
            self._kept.move_to_end(key)
        return self._kept.get(key)

    def keep(self, key: Hashable, found: Any) -> None:
        """Keep an answer."""
        self._kept[key] = found
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)


class _Request:
    """The answers to one setting of one client."""

    def __init__(self, sessions: Sessions, client: str) -> None:
        self._sessions, self._client = sessions, client
        self._jobs: set[Job] = set()
        self._ended = False

    def end(self) -> None:
        """Drop all jobs."""
        self._ended = True
        for job in self._jobs:
            job.drop()

    async def answers(self, text: str, request: Mapping[str, Any]) -> AsyncGenerator[dict[str, Any]]:
        """Yield the answers."""
        try:
            changes, parts = _table(request, "changes"), _table(request, "parts")
            settled = await self._ask("settle", text, changes, parts, rank=AT_ONCE)
        except TaciturnError as error:
            yield {"answer": "refused", "setting": text, "sentence": str(error)}
            return
        yield {"answer": "setting", "setting": settled["text"], **settled}
        text = settled["text"]

        def told(name: str, found: Mapping[str, Any]) -> dict[str, Any]:
            return {"answer": name, "setting": text, **found}

        try:
            point = await self._ask("point", text, False, rank=AT_ONCE)
            yield told("point", {"refined": False, **point})
            if request.get("only") == "point":
                yield told("point", {"refined": True, **await self._ask("point", text, True)})
                return
            yield told("response", await self._ask("response", text, point["rates"], rank=SHOWN))
            yield told("network", await self._ask("network", text, rank=SHOWN))
        except TaciturnError as error:
            yield told("refused", {"sentence": str(error), "unstable": isinstance(error, UnstableError)})
            return
        await asyncio.sleep(REST)
        if self._ended:
            raise Stopped
        async with aclosing(self._refined(text, settled, str(request.get("pinned") or ""))) as found:
            async for name, one in found:
                yield told(name, one)
        yield told("done", {})

    async def _refined(
        self, text: str, settled: Mapping[str, Any], pinned: str
    ) -> AsyncGenerator[tuple[str, dict[str, Any]]]:
        """Yield names and contents of the answers that follow while nothing moves."""
        on = settled["curve"]
        async for curve in self._curve(text, ""):
            yield "curve", {"on": on, "own": True, **curve}
        fair = await self._known("fair", on, text)
        yield "fair", {"on": on, **fair}
        point = await self._softly("point", text, True)
        if "reason" not in point:
            yield "point", {"refined": True, **point}
        if pinned:
            yield "difference", {"pinned": pinned, **await self._softly("difference", text, pinned)}
        kinds = await self._known("kinds", on, text)
        yield "kinds", {"on": on, **kinds}
        chosen = settled["compare"]
        for kind in kinds.get("compare", []) if chosen is None else chosen:
            if kind != settled["kind"]["name"]:
                async for curve in self._curve(text, kind):
                    yield "curve", {"on": on, "own": False, **curve}
        if fair.get("shares"):
            yield "beside", await self._softly("beside", text)
        yield "bound", {"on": on, **await self._softly("bound", text)}
        points = list[dict[str, Any]]()
        for share in fair.get("shares", []):
            found = await self._known("timed", (on, share), text, share)
            if "reason" in found:
                return
            points = sorted([*points, found], key=lambda one: one["traffic"])
            yield "fair", {"on": on, "points": points}

    async def _curve(self, text: str, kind: str) -> AsyncIterator[dict[str, Any]]:
        """Yield a curve with more and more points, in the order of the traffic."""
        try:
            along = await self._ask("along", text, kind)
        except TaciturnError:
            return
        if along is None:
            return
        points, shared = list[dict[str, Any]](), {"kind": kind, "key": along["key"]}
        values, told = values_of_curve(along), None
        while True:
            try:
                value = values.send(told)
            except StopIteration:
                break
            told = await self._at(along, value)
            if told is not None:
                points = sorted([*points, told], key=lambda one: one["traffic"])
                if len(points) % BATCH == 0:
                    yield {**shared, "points": points, "whole": False}
        yield {**shared, "points": points, "whole": True}

    async def _at(self, along: Mapping[str, Any], value: float) -> dict[str, Any] | None:
        """Return the point of a curve at a value of its parameter; None if there is none."""
        key = along["text"], along["key"], value
        found = await self._known("curve_point", key, *key)
        return found if found.get("share") is not None else None

    async def _known(self, name: str, key: Hashable, *arguments: Any) -> dict[str, Any]:
        """Return an answer that is kept, or a new one; a refusal is an answer with a reason."""
        known = self._sessions.known((name, key))
        if known is None:
            try:
                known = await self._ask(name, *arguments)
            except EndedError as error:
                return {"reason": str(error)}
            except TaciturnError as error:
                known = {"reason": str(error)}
            self._sessions.keep((name, key), known)
        return known

    async def _softly(self, name: str, *arguments: Any) -> dict[str, Any]:
        """Return an answer, or the reason why there is none."""
        try:
            return await self._ask(name, *arguments)
        except TaciturnError as error:
            return {"reason": str(error)}

    async def _ask(self, name: str, *arguments: Any, rank: int = LATER) -> Any:
        """Return an answer of a worker."""
        if self._ended:
            raise Stopped
        job = self._sessions.pool.submit(self._client, name, *arguments, rank=rank)
        self._jobs.add(job)
        try:
            return await asyncio.wrap_future(job)
        except asyncio.CancelledError:
            job.drop()
            if self._ended:
                raise Stopped from None
            raise
        finally:
            self._jobs.discard(job)


def _table(request: Mapping[str, Any], name: str) -> dict[str, Any]:
    found: object = request.get(name) or {}
    if not isinstance(found, Mapping):
        raise ProblemError(f"the entry {name!r} of the request is {quoted(found)}; expected a JSON object")
    return dict(cast("Mapping[str, Any]", found))
