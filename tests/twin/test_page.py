"""The page of a run without a browser: what readers are told, and what people ask."""

from __future__ import annotations

import hashlib
import re
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from twin.feeds import OMNI, ROVER, every_sample, picture, rows
from twin.readers import JSON, Reader, ask, call

from taciturn.errors import ProblemError
from taciturn_twins import connections, feed, server
from taciturn_twins.page import Page

ROOT = Path(__file__).parents[2]
ROWS = rows(ROVER, 30)


def test_a_reader_is_told_the_round_row_by_row(page: Page) -> None:
    """What is said of the round, a row as it was put, arrays as lists, and a note."""
    reader = Reader(page)
    kind, about = reader.next()
    assert (kind, about["robot"], about["parameter"]) == ("begin", "rover", ["price", 0.0, 0.1])
    page.put(ROWS[0])
    assert reader.next() == ("tick", ROWS[0])
    page.put({**ROWS[1], "state": np.array([0.5]), "cost": np.float32(0.25), "tick": np.int64(1)})
    kind, row = reader.next()
    assert (row["state"], row["cost"], row["tick"]) == ([0.5], 0.25, 1)
    page.compare(every_sample(ROVER, 1)[0])
    assert reader.next() == ("compared", every_sample(ROVER, 1)[0])
    page.note("no marker in the picture", 1)
    assert reader.next() == ("note", {"text": "no marker in the picture", "step": 1})
    page.wait("round 2: starting the processes")
    assert reader.next() == ("wait", "round 2: starting the processes")


def test_a_page_that_joins_late_is_told_the_whole_round(page: Page) -> None:
    """All of this round, nothing of the one before; before any round it is told to wait."""
    for row in ROWS:
        page.put(row)
    page.begin(replace(ROVER, round=2))
    for row in ROWS[:7]:
        page.put(row)
    told = Reader(page).take(8)
    assert told[0][1]["round"] == 2
    assert [row for _, row in told[1:]] == ROWS[:7]
    with Page(("127.0.0.1", 0)) as early:
        assert Reader(early).next() == ("wait", None)


def test_a_reader_that_comes_back_is_told_what_it_missed(page: Page) -> None:
    """By the number of its last event; one of another run, of an older round or made up gets the round as a whole."""
    reader = Reader(page)
    page.put(ROWS[0])
    reader.take(2)
    reader.close()
    page.put(ROWS[1])
    assert Reader(page, reader.last).next() == ("tick", ROWS[1])
    run, _, number = reader.last.rpartition(".")
    for strange in (f"other.{number}", f"{run}.999", f"{run}.-1", f"{run}.{'9' * 30}", "nonsense"):
        assert Reader(page, strange).next()[0] == "begin"
    page.begin(replace(ROVER, round=2))
    assert Reader(page, reader.last).next()[1]["round"] == 2


def test_a_slow_reader_holds_nothing_up(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    """It reads nothing, another one gets every row meanwhile; the slow one is dropped when its time is up."""
    monkeypatch.setattr(server, "PATIENCE", 1.0)
    slow = socket.socket()
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    slow.connect(page.address)
    slow.sendall(b"GET /events HTTP/1.0\r\nHost: localhost\r\n\r\n")
    reader, size, padded = Reader(page), 6000, {**ROWS[0], "state": [0.1234567890123]}
    got: list[int] = []
    follow = threading.Thread(target=lambda: got.extend(row["tick"] for _, row in reader.take(size + 1)[1:]))
    follow.start()
    for k in range(size):
        page.put({**padded, "tick": k, "text": "x" * 2000})
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


def test_what_is_kept_is_bounded(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an endless round the latest rows are kept; who joins late, or is far behind, gets its beginning and these."""
    monkeypatch.setattr(feed, "HELD", 100)
    for k in range(1050):
        page.put({**ROWS[0], "tick": k})
    assert len(page._feed._events) < 200
    reader = Reader(page)
    assert reader.next()[0] == "begin"
    first = reader.next()[1]["tick"]
    assert 1050 - 200 < first <= 1050 - 100
    assert [row["tick"] for _, row in reader.take(1049 - first)] == list(range(first + 1, 1050))
    behind = page._feed.news(since=5, picture=0, patience=0.0).text.split(b"\n\n")
    assert b"event: begin" in behind[0]
    assert f'"tick":{first},'.encode() in behind[1]


def test_a_silent_run_is_heard_to_be_there(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between events a pulse tells a run that waits from one that is gone."""
    monkeypatch.setattr(server, "PULSE", 0.05)
    assert [kind for kind, _ in Reader(page).take(3)] == ["begin", "alive", "alive"]


def test_the_newest_picture_is_served(page: Page) -> None:
    """None at first; then the readers hear its number, and the page fetches the last one shown."""
    assert call(page, "GET", "/picture")[0] == 404
    reader = Reader(page)
    assert reader.next()[0] == "begin"
    pictures = [picture(ROVER, row) for row in (ROWS[0], ROWS[20])]
    page.show(pictures[0])
    assert reader.next() == ("picture", 1)
    page.show(pictures[1])
    assert reader.next() == ("picture", 2)
    assert call(page, "GET", "/picture?n=2") == (200, pictures[1])
    with pytest.raises(ProblemError, match="picture begins with b'GIF8'; expected a JPEG"):
        page.show(b"GIF89a")


def test_what_people_ask_reaches_the_run_and_all_pages(page: Page) -> None:
    """Once, in order; a pause outlives the round."""
    reader = Reader(page)
    assert reader.next()[0] == "begin"
    asked = [("pause", 1.0), ("value", 0.02), ("push", 1.0)]
    assert [ask(page, *one) for one in asked] == [200] * 3
    assert page.asked() == asked
    assert page.asked() == []
    assert reader.take(3) == [("asked", {"ask": what, "value": value}) for what, value in asked]
    page.begin(ROVER)
    assert reader.take(2)[1] == ("asked", {"ask": "pause", "value": 1.0})
    assert ask(page, "pause", 0) == 200
    assert reader.next() == ("asked", {"ask": "pause", "value": 0.0})
    page.begin(ROVER)  # a reader that is behind is told the new round alone
    page.put(ROWS[0])
    assert [kind for kind, _ in reader.take(2)] == ["begin", "tick"]


@pytest.mark.parametrize(
    ("body", "status", "says"),
    [
        ('{"ask": "value", "value": 0.2}', 400, "price is 0.2; expected 0 ≤ price ≤ 0.1"),
        ('{"ask": "value", "value": NaN}', 400, "price is nan; expected a finite number"),
        ('{"ask": "value", "value": "1"}', 400, "price is '1'; expected a finite number"),
        ('{"ask": "push", "value": 7}', 400, "value of 'push' is 7; expected 0 or 1"),
        ('{"ask": "stop", "value": 1}', 400, "ask is 'stop'; expected one of 'pause', 'value', 'push'"),
        ("[1]", 400, "expected JSON as"),
        ("[" * 250, 400, "expected JSON as"),
        (b"\xff\xfe", 400, "expected JSON as"),
        (b" " * 300, 413, "the request has 300 bytes; expected at most 256"),
    ],
)
def test_a_request_that_makes_no_sense_is_one_sentence(page: Page, body: str | bytes, status: int, says: str) -> None:
    """And the run hears nothing of it."""
    found, text = call(page, "POST", "/ask", body, JSON)
    assert (found, says in text.decode()) == (status, True), text
    assert page.asked() == []


def test_requests_wait_for_a_round_and_do_not_pile_up(page: Page) -> None:
    """Nothing is asked of a run that has not begun, and only so much of one that takes nothing."""
    with Page(("127.0.0.1", 0)) as early:
        assert ask(early, "push", 1) == 400
    assert [ask(page, "push", 1) for _ in range(feed.WAITING + 1)] == [200] * feed.WAITING + [400]
    assert len(page.asked()) == feed.WAITING
    assert ask(page, "push", 1) == 200


def test_a_port_in_use_is_one_sentence(page: Page) -> None:
    """It says which, and what to do; a port that is closed can be used again."""
    port = page.address[1]
    with pytest.raises(ProblemError, match=rf"^127.0.0.1:{port} cannot serve .* in use\); expected .* or 0 for any$"):
        Page(("127.0.0.1", port))
    reader = Reader(page)
    page.close()
    page.close()
    assert [kind for kind, _ in reader.take(3)] == ["begin", "end", ""]
    with Page(("127.0.0.1", port)) as again:
        assert again.url == f"http://127.0.0.1:{port}/"


def test_the_files_of_the_page_are_served_and_name_no_other_server(page: Page) -> None:
    """Everything that the page loads is there; only licences and the namespace of SVG have addresses."""
    document = call(page, "GET", "/")[1].decode()
    loaded = re.findall(r'(?:src|href)="([^"]+)"', document)
    assert {"page.js", "page.css", "uPlot.iife.min.js", "uPlot.min.css", "uPlot.LICENSE"} <= set(loaded)
    for name in (*loaded, "curves.js", "drawings.js"):
        status, body = call(page, "GET", f"/{name}")
        assert (status, len(body) > 100) == (200, True)
        found = re.findall(rb"https?://[\w./]+", body)
        assert set(found) <= {b"http://www.w3.org/2000/svg", b"https://github.com/leeoniya/uPlot"}, name
    assert not re.search(r"<script(?![^>]*src)|\son\w+=|style=", document)  # nothing that the policy would block


def test_what_is_vendored_is_what_the_list_says() -> None:
    """Every file by its digest, with version and licence."""
    text = (ROOT / "THIRD_PARTY.md").read_text(encoding="utf-8")
    listed = dict(re.findall(r"`((?:src|docs)/[^`]+)` \| `(\w{64})`", text))
    places = "src/taciturn_twins/web/uPlot*", "src/taciturn_export/fmi/*", "docs/_static/fonts/*"
    vendored = [path for place in places for path in ROOT.glob(place)]
    assert set(listed) == {str(path.relative_to(ROOT)) for path in vendored}
    for name, digest in listed.items():
        assert hashlib.sha256((ROOT / name).read_bytes()).hexdigest() == digest, name
    version = re.search(r"\(v([\d.]+)\)", (ROOT / "src/taciturn_twins/web/uPlot.iife.min.js").read_text("utf-8")[:300])
    assert version is not None
    assert f"uPlot {version[1]}" in text


def test_clients_that_go_away_leave_no_trace(page: Page, capfd: pytest.CaptureFixture[str]) -> None:
    """In the middle of a stream, of a request, or before they say anything: no traceback, and the run continues."""
    for said in (
        b"GET /events HTTP/1.0\r\nHost: localhost\r\n\r\n",
        b"POST /ask HTTP/1.0\r\nContent-Le",
        b"",
        b"\xff\n\n",
    ):
        client = socket.create_connection(page.address, 10)
        client.sendall(said)
        time.sleep(0.05)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset, not a farewell
        client.close()
    for row in ROWS:
        page.put(row)
    assert len(Reader(page).take(31)) == 31
    page.close()
    assert capfd.readouterr() == ("", "")


def test_seats_are_limited_and_become_free(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that finds all seats taken gets an answer that says so."""
    monkeypatch.setattr(connections, "SEATS", 2)
    monkeypatch.setattr(server, "PULSE", 0.05)
    readers = [Reader(page), Reader(page)]
    assert [reader.next()[0] for reader in readers] == ["begin", "begin"]
    status, text = call(page, "GET", "/")
    assert (status, b"too many pages of this run are open; close one" in text) == (503, True)
    assert ask(page, "push", 1) == 503
    readers[0].close()
    for _ in range(100):
        if call(page, "GET", "/")[0] == 200:
            break
        time.sleep(0.02)
    else:
        pytest.fail("the seat is still taken")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"state": [1.0, 2.0]}, r"state of the row of a step has 2 numbers; expected 1: x \[m\]"),
        ({"estimate": []}, "estimate of the row of a step has 0 numbers; expected 1"),
        ({"sent": {"sensor": 1}}, "the row of a step has no sent for the link 'actuator'"),
        ({"cost": float("nan")}, "the row of step 0 holds a number that is not finite; expected None"),
        ({"input": np.array([np.inf])}, "holds a number that is not finite"),
        ({"cost": 1j}, r"cannot be sent \(a value has the type complex\)"),
    ],
)
def test_a_row_that_could_not_be_drawn_is_refused(page: Page, change: dict[str, Any], says: str) -> None:
    """With one sentence, and no page hears of it."""
    with pytest.raises(ProblemError, match=says):
        page.put({**ROWS[0], **change})
    with pytest.raises(ProblemError, match="the row of a step lacks 'drops', 'degraded'; expected the keys tick, time"):
        page.put({key: value for key, value in ROWS[0].items() if key not in ("drops", "degraded")})
    with pytest.raises(
        ProblemError, match="the row of a step lacks 'state'; expected the keys tick, state, cost, packets"
    ):
        page.compare({"tick": 0, "cost": 0.0, "packets": {"sensor": 1, "actuator": 1}})
    page.put(ROWS[1])
    assert Reader(page).take(2)[1] == ("tick", ROWS[1])


@pytest.mark.parametrize(
    ("build", "says"),
    [
        (lambda: replace(ROVER, tick=0.0), "tick is 0; expected 0 < tick"),
        (lambda: replace(ROVER, ticks=0), "ticks is 0; expected a whole number, at least 1"),
        (lambda: replace(ROVER, value=0.2), "price is 0.2; expected 0 ≤ price ≤ 0.1"),
        (lambda: replace(ROVER, parameter=("price", -1.0, 1.0)), "the least price is -1; expected 0 ≤"),
        (lambda: replace(ROVER, parameter=("price", 1.0, 1.0)), "the largest price is 1; expected 1 <"),
        (lambda: replace(ROVER, losses=(0.1,)), "losses has 1 numbers; expected one for each of"),
        (lambda: replace(ROVER, losses=(0.1, 2.0)), "the loss of the actuator link is 2; expected 0 ≤"),
        (lambda: replace(ROVER, bound=float("inf")), "bound is inf; expected a finite number"),
        (lambda: replace(OMNI, states=("x [m]",)), "states has 1 names; expected at least 2 for the robot 'omni'"),
        (lambda: replace(OMNI, reference=((1.0,),)), "reference holds a state of 1 numbers; expected 2 to 3"),
    ],
)
def test_a_round_that_could_not_be_shown_is_refused(build: Callable[[], object], says: str) -> None:
    """Where it is told, before a page hears of it; and a row needs a round."""
    with pytest.raises(ProblemError, match=says):
        build()
    with (
        Page(("127.0.0.1", 0)) as page,
        pytest.raises(ProblemError, match="a step is shown before a round begins; expected"),
    ):
        page.put(ROWS[0])
