"""Connections that wait or send slowly do not keep the owner out of a live page."""

from __future__ import annotations

import http.client
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
from twin.feeds import ROVER, rows
from twin.readers import Reader, call

from taciturn_twins import connections, server
from taciturn_twins.connections import PER_ADDRESS, STRANGERS, Connections, Timed
from taciturn_twins.page import Page

SAID = b"GET / HTTP/1.1\r\nHost: "


@contextmanager
def strangers(page: Page, counts: dict[str, int]) -> Iterator[list[socket.socket]]:
    """Connect so many times from each address, and send the beginning of a request."""
    with ExitStack() as stack:
        found: list[socket.socket] = []
        for address, count in counts.items():
            for _ in range(count):
                client = socket.create_connection(page.address, 10, source_address=(address, 0))
                found.append(stack.enter_context(client))
                client.sendall(SAID)
        yield found


def is_open(client: socket.socket) -> bool:
    """Return whether the server has left a connection open."""
    client.settimeout(0.005)
    try:
        return client.recv(1) != b""
    except TimeoutError:
        return True
    except OSError:
        return False


@pytest.mark.evidence
@pytest.mark.parametrize(
    "counts",
    [{"127.0.0.1": 128}, {f"127.0.0.{k}": 16 for k in range(2, 10)}, {f"127.0.1.{k}": 1 for k in range(1, 129)}],
    ids=["the owner's address", "eight addresses", "128 addresses"],
)
def test_128_slow_connections_do_not_lock_the_owner_out(counts: dict[str, int]) -> None:
    """Not from the owner's address either; and a page that is open stays open."""
    with Page(("127.0.0.1", 0), "s3cret") as page:
        page.begin(ROVER)
        reader = Reader(page)
        assert reader.next()[0] == "begin"
        with strangers(page, counts) as found:
            assert call(page, "GET", "/?token=s3cret")[0] == 200
            assert call(page, "GET", "/page.js")[0] == 200
            later = Reader(page)
            assert later.next()[0] == "begin"
            with strangers(page, counts):
                page.put(rows(ROVER, 1)[0])
                for one in (reader, later):
                    while (kind := one.next()[0]) != "tick":
                        assert kind == "alive"
            assert sum(map(is_open, found)) <= STRANGERS
            assert call(page, "GET", "/?token=wrong")[0] == 403


def test_a_request_has_one_deadline(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that sends a byte now and then is closed when it is over, in the header and in the body."""
    monkeypatch.setattr(server, "PATIENCE", 0.3)
    post = b"POST /ask HTTP/1.0\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 200\r\n\r\n"
    for said in (b"GET / HTTP/1.0\r\nX: ", post):
        began = time.monotonic()
        with socket.create_connection(page.address, 10) as client:
            client.sendall(said)
            while is_open(client):
                assert time.monotonic() < began + 5.0, "a byte at a time keeps the connection open"
                client.sendall(b" ")
    assert call(page, "GET", "/")[0] == 200


def test_a_request_has_a_largest_size(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    """Many long lines of a header do not fill the memory."""
    monkeypatch.setattr(connections, "LARGEST", 2000)
    with pytest.raises((http.client.RemoteDisconnected, ConnectionResetError, BrokenPipeError)):
        call(page, "GET", "/", headers={f"X{k}": "x" * 100 for k in range(50)})
    assert call(page, "GET", "/")[0] == 200


def test_the_oldest_of_the_heaviest_address_makes_room() -> None:
    """An address with few connections keeps them while another one opens many."""
    with ExitStack() as stack:
        pairs = [socket.socketpair() for _ in range(STRANGERS + 2 * PER_ADDRESS + 4)]
        for end in (end for pair in pairs for end in pair):
            stack.enter_context(end)
        open_ones, free = Connections(), iter(pairs)
        owner = next(free)
        open_ones.enter(owner[0], "owner")
        same = [next(free) for _ in range(PER_ADDRESS + 1)]
        for one in same:
            open_ones.enter(one[0], "a")
        assert [is_open(one[1]) for one in (owner, *same)] == [True, False] + [True] * PER_ADDRESS
        for k in range(STRANGERS - PER_ADDRESS):
            open_ones.enter(next(free)[0], f"b{k}")
        assert [is_open(one[1]) for one in (owner, *same[1:])] == [True, False] + [True] * (PER_ADDRESS - 1)
        assert not open_ones.admit(same[1][0])  # it was closed
        assert open_ones.admit(owner[0])
        open_ones.leave(owner[0])
        assert not open_ones.admit(owner[0])


def test_a_deadline_that_is_over_reads_nothing() -> None:
    """Even if bytes are there."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        theirs.sendall(b"GET")
        with pytest.raises(TimeoutError):
            Timed(ours, 0.0).read(3)
