"""Who may see a page and act on its run, and who may not."""

from __future__ import annotations

import json
import socket

import pytest
from twin.feeds import ROVER, picture, rows
from twin.readers import JSON, Reader, ask, call

from taciturn.errors import ProblemError
from taciturn_twins.page import Page

ROWS = rows(ROVER, 1)


@pytest.mark.parametrize(
    ("headers", "sees", "acts"),
    [
        ({}, True, True),
        ({"Host": "localhost"}, True, True),
        ({"Host": "[::1]:80", "Origin": "http://[::1]:80"}, True, True),
        ({"Host": "localhost:7", "Origin": "http://localhost:7"}, True, True),  # a tunnel of ssh
        ({"Host": "evil.example"}, False, False),  # DNS rebinding
        ({"Host": "localhost.evil.example"}, False, False),
        ({"Host": "127.0.0.1.evil.example:80"}, False, False),
        ({"Host": ""}, False, False),
        ({"Origin": "http://evil.example"}, True, False),  # a page elsewhere
        ({"Origin": "http://localhost:1"}, True, False),  # another server of this machine
        ({"Origin": "null"}, True, False),
        ({"Content-Type": "text/plain"}, True, False),  # what a form may send unasked
        ({"Content-Type": "application/x-www-form-urlencoded"}, True, False),
    ],
)
def test_without_a_token_only_this_machine_sees_and_acts(
    page: Page, headers: dict[str, str], sees: bool, acts: bool
) -> None:
    """By Host, Origin and the type of the content, which other pages cannot forge."""
    page.show(picture(ROVER, ROWS[0]))
    assert [call(page, "GET", path, None, headers)[0] for path in ("/", "/picture")] == [200 if sees else 403] * 2
    assert sees or call(page, "GET", "/events", None, headers)[0] == 403
    assert ask(page, "push", 1, headers) == (200 if acts else 403)
    assert page.asked() == ([("push", 1.0)] if acts else [])


def test_two_hosts_are_none(page: Page) -> None:
    """A request that names this machine and another one is refused."""
    with socket.create_connection(page.address, 10) as connection:
        connection.sendall(b"GET / HTTP/1.0\r\nHost: localhost\r\nHost: evil.example\r\n\r\n")
        assert connection.makefile("rb").readline().split()[1] == b"403"


def test_with_a_token_nobody_sees_or_acts_without_it() -> None:
    """Reading needs it in the address, acting in a header; the address alone does not permit to act."""
    with Page(("0.0.0.0", 0), token="a+b/c&d") as page:
        page.begin(ROVER)
        page.show(picture(ROVER, ROWS[0]))
        query = f"?{page.url.partition('?')[2]}"
        assert query == "?token=a%2Bb%2Fc%26d"
        for path in ("/", "/picture"):
            for given, status in ((query, 200), ("", 403), ("?token=", 403), ("?token=a", 403), (2 * query, 403)):
                assert call(page, "GET", path + given)[0] == status, path + given
        assert call(page, "GET", "/events?token=wrong")[0] == 403
        assert Reader(page).next()[0] == "begin"
        for given in ({}, {"Authorization": "Bearer a"}, {"Authorization": "Bearer "}, {"Authorization": "Bearer ä"}):
            assert ask(page, "push", 1, given) == 403
        body = json.dumps({"ask": "push", "value": 1})
        assert call(page, "POST", "/ask" + query, body, JSON)[0] == 404
        own = {"Authorization": "Bearer a+b/c&d"}
        assert ask(page, "push", 1, {**own, "Content-Type": "text/plain"}) == 403
        assert page.asked() == []
        assert ask(page, "push", 1, {**own, "Host": "robot.example"}) == 200
        assert page.asked() == [("push", 1.0)]


@pytest.mark.parametrize(
    ("bind", "token", "says"),
    [
        (("0.0.0.0", 0), None, "would listen on 0.0.0.0 without a token; expected a loopback address"),
        (("", 0), None, "would listen on every address without a token"),
        (("192.0.2.1", 0), None, "would listen on 192.0.2.1 without a token"),
        (("192.0.2.1", 0), "secret", r"192.0.2.1:0 cannot serve the page \(.*\); expected a free port"),
        (("127.0.0.1", 0), "", "token is ''; expected printable ASCII"),
        (("127.0.0.1", 0), "two words", "token is 'two words'; expected"),
        (("127.0.0.1", 0), "schlüssel", "token is 'schlüssel'; expected"),
    ],
)
def test_a_page_that_everybody_could_reach_is_refused(bind: tuple[str, int], token: str | None, says: str) -> None:
    """Nobody outside reaches a page without a token, and a token must fit into a header."""
    with pytest.raises(ProblemError, match=says):
        Page(bind, token)


@pytest.mark.parametrize(
    "path",
    [
        "/ask",
        "/nothing",
        "/web/page.js",
        "/../page.py",
        "/%2e%2e/page.py",
        "//etc/passwd",
        "/page.js/../../access_control.py",
        "/[",
    ],
)
def test_other_paths_are_not_there(page: Page, path: str) -> None:
    """Only the files of the page are served, by their names."""
    assert call(page, "GET", path)[0] == 404
    assert call(page, "POST", path if path != "/ask" else "/", "{}", JSON)[0] == 404
    assert call(page, "PUT", path)[0] == 501
