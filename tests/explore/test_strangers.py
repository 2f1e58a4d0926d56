"""The routes of the explorer's page are its owner's alone, and strangers do not keep the owner out."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from web.readers import JSON, call, post, with_token
from web.test_connections import are_open, ask, strangers

from taciturn_explore.server import open_page
from taciturn_explore.setting import setting_for
from taciturn_web.connections import STRANGERS
from taciturn_web.serving import Served

ASKED = {"client": "a", "text": "problem=two-mass", "changes": {}, "parts": {}, "pinned": "", "only": "point"}
ROUTES = {"/begin": "GET", "/answers": "POST", "/file": "POST", "/": "GET"}


@pytest.fixture(scope="module")
def page() -> Iterator[Served]:
    """Serve the page of a built-in problem."""
    begin, trusted = setting_for("two-mass")
    with open_page(begin, trusted, ("127.0.0.1", 0)) as served:
        yield served


@pytest.mark.parametrize(
    "headers",
    [{"Origin": "http://evil.example"}, {"Origin": "null"}, {"Host": "evil.example"}, {"Authorization": ""}],
    ids=["another page", "a page without an origin", "another name", "no token"],
)
@pytest.mark.parametrize("path", ROUTES)
def test_a_request_of_another_page_or_without_the_token_is_refused(
    page: Served, path: str, headers: dict[str, str]
) -> None:
    """Each route, whatever else the request has."""
    body = json.dumps(ASKED) if ROUTES[path] == "POST" else None
    assert call(page, ROUTES[path], path, body, {**JSON, **with_token(page), **headers})[0] == 403


@pytest.mark.evidence
def test_200_connections_and_a_client_that_never_reads_do_not_stop_the_answers(page: Served) -> None:
    """The answers to a move arrive while they are open, and the route of files answers."""
    with ask(page, "/begin"), asking(page), strangers(page, {"127.0.0.1": 200}) as found:
        answers = answers_of(page)
        assert [one["answer"] for one in answers[:2]] == ["setting", "point"]
        assert answers[1]["cost"]["text"]
        assert post(page, "/file", {"client": "a", "text": "problem=two-mass"}) == 200
        assert are_open(found) <= STRANGERS


@contextmanager
def asking(page: Served) -> Iterator[http.client.HTTPConnection]:
    """Ask for all answers, and read nothing of them."""
    connection = http.client.HTTPConnection(*page.address, timeout=30)
    body = json.dumps({**ASKED, "client": "never reads", "only": ""})
    connection.request("POST", "/answers", body, {**JSON, **with_token(page)})
    yield connection
    connection.close()


def answers_of(page: Served) -> list[dict[str, Any]]:
    """Return the answers to a request."""
    status, body = call(page, "POST", "/answers", json.dumps(ASKED), {**JSON, **with_token(page)})
    assert status == 200
    return [json.loads(text) for text in body.splitlines()]
