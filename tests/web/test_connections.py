"""Connections that wait, send slowly or never read do not keep the owner out of a page."""

from __future__ import annotations

import signal
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from urllib.parse import urlsplit

import pytest
from web.readers import Reader, Site, Small, call, post, with_token

from taciturn_web import connections, events, serving
from taciturn_web.connections import PER_ADDRESS, STRANGERS

SAID = b"GET / HTTP/1.1\r\nHost: "


@pytest.fixture
def page() -> Iterator[Small]:
    """Return a page on the loopback."""
    with Small() as page:
        yield page


@contextmanager
def strangers(page: Site, counts: dict[str, int]) -> Iterator[list[socket.socket]]:
    """Connect so many times from each address, and send the beginning of a request."""
    with ExitStack() as stack:
        found: list[socket.socket] = []
        for address, count in counts.items():
            for _ in range(count):
                client = socket.create_connection(page.address, 10, source_address=(address, 0))
                found.append(stack.enter_context(client))
                client.sendall(SAID)
        yield found


def are_open(clients: list[socket.socket]) -> int:
    """Return how many connections the server has left open."""
    time.sleep(0.05)

    def is_open(client: socket.socket) -> bool:
        client.settimeout(0.001)
        try:
            return client.recv(1) != b""
        except TimeoutError:
            return True
        except OSError:
            return False

    return sum(map(is_open, clients))


def ask(page: Site, path: str) -> socket.socket:
    """Send a request as a user, and read nothing of the answer."""
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.connect(page.address)
    client.sendall(f"GET {path}?{urlsplit(page.url).query} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
    return client


@pytest.mark.parametrize(
    "counts",
    [
        pytest.param({"127.0.0.1": 200}, id="the owner's address"),
        pytest.param({f"127.0.0.{k}": 25 for k in range(2, 10)}, id="eight addresses", marks=pytest.mark.evidence),
        pytest.param({f"127.0.1.{k}": 1 for k in range(1, 201)}, id="200 addresses"),
    ],
)
def test_200_connections_and_a_client_that_never_reads_do_not_lock_the_owner_out(
    page: Small, counts: dict[str, int]
) -> None:
    """Not from the owner's address either; and a page that is open stays open."""
    reader = Reader(page)
    assert reader.next()[0] == "wait"
    with ask(page, "/endless"), strangers(page, counts) as found:
        assert call(page, "GET", "/", None, with_token(page))[0] == 200
        assert call(page, "GET", "/page.js")[0] == 200
        later = Reader(page)
        assert later.next()[0] == "wait"
        with strangers(page, counts):
            page.log.tell("news", "1")
            for one in (reader, later):
                while (kind := one.next()[0]) != "news":
                    assert kind == "alive"
            assert post(page, "/echo", 1) == 200
        assert are_open(found) <= STRANGERS
        assert call(page, "GET", "/?token=wrong")[0] == 403


def test_the_oldest_of_the_heaviest_address_makes_room(page: Small) -> None:
    """An address with few connections keeps them while another one opens many."""
    with (
        strangers(page, {"127.0.0.2": 1}) as owner,
        strangers(page, {"127.0.0.3": PER_ADDRESS}) as same,
    ):
        assert (are_open(owner), are_open(same)) == (1, PER_ADDRESS)
        with strangers(page, {"127.0.0.3": 1}) as last:
            assert (are_open(owner), are_open(same[:1]), are_open(same[1:])) == (1, 0, PER_ADDRESS - 1)
            counts = {f"127.0.1.{k}": 1 for k in range(STRANGERS - PER_ADDRESS)}
            with strangers(page, counts) as others:
                assert (are_open(owner), are_open(others), are_open(last)) == (1, len(counts), 1)
                assert are_open(same[1:]) == PER_ADDRESS - 2


@pytest.mark.evidence
def test_a_request_has_one_deadline(page: Small, monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that sends a byte now and then is closed when it is over, in the header and in the body."""
    monkeypatch.setattr(connections, "PATIENCE", 0.3)
    fields = {"Host": "localhost", "Content-Type": "application/json", "Content-Length": "200", **with_token(page)}
    lines = "".join(f"{name}: {value}\r\n" for name, value in fields.items())
    for said in (b"GET / HTTP/1.1\r\nX: ", f"POST /echo HTTP/1.1\r\n{lines}\r\n".encode()):
        began = time.monotonic()
        with socket.create_connection(page.address, 10) as client:
            client.sendall(said)
            while are_open([client]):
                assert time.monotonic() < began + 5.0, "a byte at a time keeps the connection open"
                client.sendall(b" ")
    assert call(page, "GET", "/", None, with_token(page))[0] == 200


def test_a_client_that_never_reads_is_dropped(page: Small, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a long answer, and of a short one that fits into the buffer of the server; then its seat is free."""
    monkeypatch.setattr(connections, "SEATS", 2)
    monkeypatch.setattr(connections, "PATIENCE", 0.3)
    page.log.begin("large", f'"{"x" * 60_000}"')
    with ask(page, "/endless"), ask(page, "/events"):
        end = time.monotonic() + 5.0
        while call(page, "GET", "/", None, with_token(page))[0] == 200:
            assert time.monotonic() < end, "the clients have no seats"
        page.log.end()
        while call(page, "GET", "/", None, with_token(page))[0] == 503:
            assert time.monotonic() < end, "the clients keep their seats"


def test_the_header_of_a_request_has_a_largest_size(page: Small) -> None:
    """Lines without an end do not fill the memory."""
    with socket.create_connection(page.address, 10) as client:
        client.sendall(b"GET / HTTP/1.1\r\n" + (serving.LARGEST // 1000 + 1) * (b"X: " + b"x" * 1000 + b"\r\n"))
        assert client.makefile("rb").readline().split()[1] == b"400"


def test_seats_are_limited_and_become_free(page: Small, monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that finds all seats taken gets an answer that says so."""
    monkeypatch.setattr(connections, "SEATS", 2)
    monkeypatch.setattr(events, "PULSE", 0.05)
    readers = [Reader(page), Reader(page)]
    assert [reader.next()[0] for reader in readers] == ["wait", "wait"]
    status, text = call(page, "GET", "/", None, with_token(page))
    assert (status, b"too many of these pages are open; close one" in text) == (503, True)
    assert post(page, "/echo", 1) == 503
    readers[0].close()
    end = time.monotonic() + 5.0
    while call(page, "GET", "/", None, with_token(page))[0] == 503:
        assert time.monotonic() < end, "the seat is still taken"


@pytest.mark.evidence
def test_clients_that_go_away_or_break_the_rules_leave_no_trace(
    page: Small, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """In the middle of a stream, of a request, or before they say anything: no traceback, and the page goes on."""
    query, token = urlsplit(page.url).query, with_token(page)["Authorization"]
    echo = f"POST /echo HTTP/1.1\r\nHost: localhost\r\nAuthorization: {token}\r\nContent-Type: application/json\r\n"
    for said in (
        f"GET /events?{query} HTTP/1.0\r\nHost: localhost\r\n\r\n".encode(),
        f"GET /endless?{query} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode(),
        b"POST /echo HTTP/1.0\r\nContent-Le",
        f"{echo}Content-Length: 20\r\n\r\n1".encode(),
        f"{echo}Transfer-Encoding: chunked\r\n\r\nnonsense\r\n\r\n".encode(),
        b"POST /echo HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nnonsense\r\n\r\n",
        f"GET /?{query} HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n".encode(),
        2 * f"GET /?{query} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode(),
        b"",
        b"\xff\n\n",
    ):
        client = socket.create_connection(page.address, 10)
        client.sendall(said)
        time.sleep(0.05)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset, not a farewell
        client.close()
    assert post(page, "/echo", 1) == 200
    assert Reader(page).next()[0] == "wait"
    page.close()
    assert (capfd.readouterr(), caplog.records) == (("", ""), [])


@pytest.mark.evidence
def test_a_page_ends_in_time_though_clients_wait_or_never_read(
    page: Small, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """Those that read receive the end; and the signals of this process remain its own."""
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    reader = Reader(page)
    with ask(page, "/endless"), strangers(page, {"127.0.0.1": 3}):
        time.sleep(0.05)
        page.close()
        assert not page._served._thread.is_alive()
    assert list(reader)[-1] == ("end", None)
    page.close()
    with Small(page.address) as again:
        assert again.address == page.address
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert (capfd.readouterr(), caplog.records) == (("", ""), [])
