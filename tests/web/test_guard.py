"""Who may see a page and act on it, and who may not."""

from __future__ import annotations

import importlib
import json
import re
import socket
from collections.abc import Iterator
from urllib.parse import urlsplit

import pytest
from web.readers import JSON, Reader, Small, call, post, with_token

import taciturn_web
from taciturn import ProblemError


@pytest.fixture(scope="module")
def page() -> Iterator[Small]:
    """Return a page on the loopback."""
    with Small() as page:
        yield page


@pytest.mark.parametrize(
    ("headers", "passes"),
    [
        ({}, True),
        ({"Host": "localhost"}, True),
        ({"Host": "LOCALHOST:80", "Origin": "http://LOCALHOST:80"}, True),
        ({"Host": "[::1]:80", "Origin": "http://[::1]:80"}, True),
        ({"Host": "localhost:7", "Origin": "http://localhost:7"}, True),  # a tunnel of ssh
        ({"Host": "evil.example"}, False),  # DNS rebinding
        ({"Host": "localhost.evil.example"}, False),
        ({"Host": "127.0.0.1.evil.example:80"}, False),
        ({"Host": "evil.example@localhost"}, False),
        ({"Host": "192.0.2.1"}, False),
        ({"Host": ""}, False),
        ({"Origin": "http://evil.example"}, False),  # a page elsewhere
        ({"Origin": "http://localhost:1"}, False),  # another server of this machine
        ({"Origin": "null"}, False),
    ],
)
def test_a_request_from_elsewhere_is_refused_even_with_the_token(
    page: Small, headers: dict[str, str], passes: bool
) -> None:
    """By Host and Origin, which other pages cannot forge; also the public files are not for other pages."""
    own = {**with_token(page), **headers}
    assert call(page, "GET", "/", None, own)[0] == (200 if passes else 403)
    assert call(page, "GET", "/page.js", None, headers)[0] == (200 if passes else 403)
    assert post(page, "/echo", 1, headers) == (200 if passes else 403)


def test_two_hosts_are_none(page: Small) -> None:
    """A request that names this machine and another one is refused."""
    with socket.create_connection(page.address, 10) as connection:
        connection.sendall(b"GET / HTTP/1.0\r\nHost: localhost\r\nHost: evil.example\r\n\r\n")
        assert connection.makefile("rb").readline().split()[1] in (b"400", b"403")


def test_nobody_sees_or_acts_without_the_token() -> None:
    """Reading needs it in the address or in a header, acting in a header: the address alone does not permit to act."""
    with Small(("0.0.0.0", 0), "a+b/c&d") as page:
        query = f"?{urlsplit(page.url).query}"
        assert query == "?token=a%2Bb%2Fc%26d"
        for given, status in ((query, 200), ("", 403), ("?token=", 403), ("?token=a", 403), (query + "&token=a", 403)):
            assert call(page, "GET", f"/{given}")[0] == status, given
        for given, said in (("?token=wrong", "another token than"), ("", "no token"), ("?token=", "no token")):
            status, text = call(page, "GET", f"/events{given}")
            assert (status, said in text.decode()) == (403, True)
        assert Reader(page).next()[0] == "wait"
        for wrong in ({}, {"Authorization": "Bearer a"}, {"Authorization": "Bearer "}, {"Authorization": "Bearer ä"}):
            assert call(page, "POST", "/echo", "1", {**JSON, **wrong})[0] == 403
            assert call(page, "POST", "/echo" + query, "1", {**JSON, **wrong})[0] == 403
        assert page.echoed == []
        for host in ("10.1.2.3:80", "[fe80::1]", socket.gethostname()):  # as other machines see this one
            assert post(page, "/echo", 1, {"Host": host}) == 200
        assert post(page, "/echo", 1, {"Host": "robot.example"}) == 403
        assert page.echoed == [1, 1, 1]


def test_a_token_is_random_and_must_fit_into_a_header() -> None:
    """One that is not given has at least 128 bits."""
    with Small() as one, Small() as other:
        tokens = {with_token(page)["Authorization"] for page in (one, other)}
        assert len(tokens) == 2
        assert all(re.fullmatch(r"Bearer [\w-]{22,}", token) for token in tokens)
    for token in ("", "two words", "schlüssel", "a\nb"):
        with pytest.raises(ProblemError, match=f"token is {re.escape(repr(token))}; expected printable ASCII"):
            Small(token=token)


def test_a_missing_package_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    """It says what to install."""
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "uvicorn" else name)
    with pytest.raises(
        ProblemError, match=r"^the package uvicorn is not installed, .*: pip install 'taciturn\[explore\]'$"
    ):
        importlib.reload(taciturn_web)


def test_an_address_that_cannot_be_served_is_one_sentence(page: Small) -> None:
    """Of a port in use, and of an address of another machine."""
    port = page.address[1]
    with pytest.raises(
        ProblemError, match=rf"^the address 127.0.0.1:{port} cannot serve .* in use\); expected .* or 0 for any$"
    ):
        Small(("127.0.0.1", port))
    with pytest.raises(ProblemError, match=r"192.0.2.1:0 cannot serve the page \(.*\); expected a free port"):
        Small(("192.0.2.1", 0))


@pytest.mark.parametrize(
    ("body", "kind", "status", "says"),
    [
        ("[1]", "application/json; charset=utf-8", 200, "[1]"),
        ("[1]", "text/plain", 415, "not application/json"),  # what a form may send unasked
        ("[1]", "application/x-www-form-urlencoded", 415, "not application/json"),
        (b" " * 300, "application/json", 413, "more than 256 bytes"),
        ("[" * 250, "application/json", 400, "the request is not JSON"),
        (b"\xff\xfe", "application/json", 400, "the request is not JSON"),
        ("", "application/json", 400, "the request is not JSON"),
    ],
)
def test_a_request_that_makes_no_sense_is_refused(
    page: Small, body: str | bytes, kind: str, status: int, says: str
) -> None:
    """By its type and its size, before anything is done with it."""
    found, text = call(page, "POST", "/echo", body, {**with_token(page), "Content-Type": kind})
    assert (found, says in text.decode()) == (status, True), text


def test_a_body_without_a_length_is_limited_too(page: Small) -> None:
    """Its chunks are read up to the limit."""
    token = with_token(page)["Authorization"]
    head = f"POST /echo HTTP/1.1\r\nHost: localhost\r\nAuthorization: {token}\r\nContent-Type: application/json\r\n"
    with socket.create_connection(page.address, 10) as connection:
        connection.sendall(head.encode() + b"Transfer-Encoding: chunked\r\n\r\n" + b"64\r\n" + b" " * 100 + b"\r\n")
        connection.sendall(3 * (b"64\r\n" + b" " * 100 + b"\r\n"))
        assert connection.makefile("rb").readline().split()[1] == b"413"


@pytest.mark.parametrize(
    "path",
    [
        "/nothing",
        "/web/page.js",
        "/../page.py",
        "/%2e%2e/page.py",
        "//etc/passwd",
        "/page.js/../../guard.py",
        "/index.html",
        "/[",
    ],
)
def test_other_paths_are_not_there(page: Small, path: str) -> None:
    """Only the files of the page are served, by their names; and what is there has its methods."""
    own = with_token(page)
    assert call(page, "GET", path, None, own)[0] == 404
    assert call(page, "POST", path, "{}", {**JSON, **own})[0] == 404
    assert call(page, "PUT", "/echo", json.dumps(1), {**JSON, **own})[0] == 405
