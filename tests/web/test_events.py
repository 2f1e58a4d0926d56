"""Readers of a log of events: what each is told, also if it is slow, late or comes back."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator
from itertools import takewhile
from urllib.parse import urlsplit

import pytest
from web.readers import Reader, Small

from taciturn_web import connections, events


@pytest.fixture
def page() -> Iterator[Small]:
    """Return a page whose log has begun."""
    with Small() as page:
        page.log.begin("begin", "1")
        yield page


def test_a_reader_that_joins_late_is_told_everything_since_the_beginning(page: Small) -> None:
    """And of events that replace each other the newest."""
    for k in range(3):
        page.log.tell("row", str(k))
        page.log.replace("picture", str(k))
    early = Reader(page)
    assert early.take(5) == [("begin", 1), ("row", 0), ("row", 1), ("row", 2), ("picture", 2)]
    page.log.begin("begin", "2")
    page.log.tell("row", "7")
    told = [("begin", 2), ("row", 7)]
    assert early.take(2) == told
    assert Reader(page).take(3) == [*told, ("picture", 2)]


def test_a_reader_that_comes_back_is_told_what_it_missed(page: Small) -> None:
    """By the number of its last event; one of another log, from before the beginning or made up gets everything."""
    reader = Reader(page)
    page.log.tell("row", "0")
    reader.take(2)
    reader.close()
    page.log.tell("row", "1")
    assert Reader(page, reader.last).next() == ("row", 1)
    run, _, number = reader.last.rpartition(".")
    for strange in (f"other.{number}", f"{run}.999", f"{run}.-1", f"{run}.{'9' * 30}", "nonsense"):
        assert Reader(page, strange).next() == ("begin", 1)
    page.log.begin("begin", "2")
    assert Reader(page, reader.last).next() == ("begin", 2)


@pytest.mark.evidence
def test_a_slow_reader_holds_nothing_up(page: Small, monkeypatch: pytest.MonkeyPatch) -> None:
    """It reads nothing, another one gets every row meanwhile; the slow one is dropped when its time is up."""
    monkeypatch.setattr(connections, "PATIENCE", 1.0)
    slow = socket.socket()
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    slow.connect(page.address)
    slow.sendall(f"GET /events?{urlsplit(page.url).query} HTTP/1.0\r\nHost: localhost\r\n\r\n".encode())
    reader, size, padded = Reader(page), 6000, json.dumps("x" * 2000)
    got: list[int] = []
    follow = threading.Thread(target=lambda: got.extend(row[0] for _, row in reader.take(size + 1)[1:]))
    follow.start()
    for k in range(size):
        page.log.tell("row", f"[{k}, {padded}]")
        if k % 20 == 0:
            time.sleep(0.001)  # the other one reads in this process too, and must not become slow
    follow.join(20)
    assert got == list(range(size))
    slow.settimeout(10)
    read = 0
    try:
        time.sleep(1.1)
        while chunk := slow.recv(1 << 16):
            read += len(chunk)
    except ConnectionResetError:
        pass
    assert 0 < read < 2000 * size
    slow.close()


def test_what_is_kept_is_bounded(page: Small, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an endless log the latest events are kept; who joins late, or is far behind, gets its beginning and these."""
    monkeypatch.setattr(events, "HELD", 100)
    for k in range(1050):
        page.log.tell("row", str(k))
    page.log.end()
    assert len(page.log._events) < 200
    run = page.log._run
    for last in ("", f"{run}.5"):
        (kind, _), *rows, (end, _) = Reader(page, last)
        first = rows[0][1]
        assert (kind, end) == ("begin", "end")
        assert 1050 - 200 < first <= 1050 - 100
        assert rows == [("row", k) for k in range(first, 1050)]


def test_a_silent_log_is_heard_to_be_there(page: Small, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between events a pulse tells a run that waits from one that is gone."""
    monkeypatch.setattr(events, "PULSE", 0.05)
    assert [kind for kind, _ in Reader(page).take(3)] == ["begin", "alive", "alive"]


def test_readers_are_told_the_end_before_the_server_ends(page: Small) -> None:
    """Also those with much to read."""
    reader = Reader(page)
    for k in range(2000):
        page.log.tell("row", str(k))
    page.close()
    told = list(takewhile(lambda event: event[0] != "end", reader))
    assert told[1:] == [("row", k) for k in range(2000)]
