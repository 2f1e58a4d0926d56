"""The page of a run without a browser: what readers are told, and what people ask."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from twin.feeds import OMNI, ROVER, every_sample, picture, rows
from web.readers import JSON, Reader, call, post, with_token

from taciturn.errors import ProblemError
from taciturn_twins.page import LARGEST, WAITING, Page

ROOT = Path(__file__).parents[2]
ROWS = rows(ROVER, 30)


def ask(page: Page, what: str, value: object) -> int:
    """Ask the run for something; return the status."""
    return post(page, "/ask", {"ask": what, "value": value})


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


def test_the_newest_picture_is_served(page: Page) -> None:
    """None at first; then the readers hear its number, and the page fetches the last one shown."""
    own = with_token(page)
    assert call(page, "GET", "/picture", None, own)[0] == 404
    reader = Reader(page)
    assert reader.next()[0] == "begin"
    pictures = [picture(ROVER, row) for row in (ROWS[0], ROWS[20])]
    page.show(pictures[0])
    assert reader.next() == ("picture", 1)
    page.show(pictures[1])
    assert reader.next() == ("picture", 2)
    assert call(page, "GET", "/picture?n=2", None, own) == (200, pictures[1])
    with pytest.raises(ProblemError, match="'picture' begins with b'GIF8'; expected a JPEG"):
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
        ('{"ask": "stop", "value": 1}', 400, "ask is 'stop'; expected one of the words 'pause', 'value', 'push'"),
        ("[1]", 400, "expected JSON such as"),
        ('{"ask": "push"}', 400, "expected JSON such as"),
        ("{", 400, "the request is not JSON"),
        (b" " * 300, 413, f"the request has more than {LARGEST} bytes"),
    ],
)
def test_a_request_that_makes_no_sense_is_one_sentence(page: Page, body: str | bytes, status: int, says: str) -> None:
    """And the run hears nothing of it."""
    found, text = call(page, "POST", "/ask", body, {**JSON, **with_token(page)})
    assert (found, says in text.decode()) == (status, True), text
    assert page.asked() == []


def test_requests_wait_for_a_round_and_do_not_pile_up(page: Page) -> None:
    """Nothing is asked of a run that has not begun, and only so much of one that takes nothing."""
    with Page(("127.0.0.1", 0)) as early:
        assert ask(early, "push", 1) == 400
    assert [ask(page, "push", 1) for _ in range(WAITING + 1)] == [200] * WAITING + [400]
    assert len(page.asked()) == WAITING
    assert ask(page, "push", 1) == 200


def test_a_page_that_is_closed_has_told_its_end_and_freed_its_port(page: Page) -> None:
    """The end of the run is the last event."""
    reader = Reader(page)
    page.close()
    page.close()
    assert [kind for kind, _ in reader.take(3)] == ["begin", "end", ""]
    with Page(page.address, "token") as again:
        assert again.url == f"http://127.0.0.1:{page.address[1]}/?token=token"


def test_the_files_of_the_page_are_served_and_name_no_other_server(page: Page) -> None:
    """Everything that the page loads is there; only licences and the namespace of SVG have addresses."""
    document = call(page, "GET", "/", None, with_token(page))[1].decode()
    loaded = re.findall(r'(?:src|href)="([^"]+)"', document)
    assert {"page.js", "page.css", "theme.css", "uPlot.iife.min.js", "uPlot.min.css", "uPlot.LICENSE"} <= set(loaded)
    for name in (*loaded, "curves.js", "drawings.js", "requests.js"):
        status, body = call(page, "GET", f"/{name}")
        assert (status, len(body) > 100) == (200, True)
        found = re.findall(rb"https?://[\w./]+", body)
        assert set(found) <= {b"http://www.w3.org/2000/svg", b"https://github.com/leeoniya/uPlot"}, name
    assert not re.search(r"<script(?![^>]*src)|\son\w+=|style=", document)  # nothing that the policy would block


def test_what_is_vendored_is_what_the_list_says() -> None:
    """Every file by its digest, with version and licence."""
    text = (ROOT / "THIRD_PARTY.md").read_text(encoding="utf-8")
    listed = dict(re.findall(r"`((?:src|docs)/[^`]+)` \| `(\w{64})`", text))
    places = "src/taciturn_web/assets/uPlot*", "src/taciturn_export/fmi/*", "docs/_static/fonts/*"
    vendored = [path for place in places for path in ROOT.glob(place)]
    assert set(listed) == {str(path.relative_to(ROOT)) for path in vendored}
    for name, digest in listed.items():
        assert hashlib.sha256((ROOT / name).read_bytes()).hexdigest() == digest, name
    version = re.search(r"\(v([\d.]+)\)", (ROOT / "src/taciturn_web/assets/uPlot.iife.min.js").read_text("utf-8")[:300])
    assert version is not None
    assert f"uPlot {version[1]}" in text


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"state": [1.0, 2.0]}, r"the entry state of the row of a step has 2 numbers; expected 1 number: x \[m\]"),
        ({"estimate": []}, "estimate of the row of a step has 0 numbers; expected 1"),
        ({"sent": {"sensor": 1}}, "the row of a step has no sent for the link 'actuator'"),
        ({"cost": float("nan")}, "the row of step 0 contains a number that is not finite; expected None"),
        ({"input": np.array([np.inf])}, "contains a number that is not finite"),
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
        (lambda: replace(ROVER, ticks=0), "ticks is 0; expected a whole number of at least 1"),
        (lambda: replace(ROVER, value=0.2), "price is 0.2; expected 0 ≤ price ≤ 0.1"),
        (lambda: replace(ROVER, parameter=("price", -1.0, 1.0)), "the least price is -1; expected 0 ≤"),
        (lambda: replace(ROVER, parameter=("price", 1.0, 1.0)), "the largest price is 1; expected 1 <"),
        (lambda: replace(ROVER, losses=(0.1,)), "'losses' has 1 number; expected one number for each of"),
        (lambda: replace(ROVER, losses=(0.1, 2.0)), "the loss of the actuator link is 2; expected 0 ≤"),
        (lambda: replace(ROVER, bound=float("inf")), "bound is inf; expected a finite number"),
        (lambda: replace(OMNI, states=("x [m]",)), "'states' has 1 name; expected at least 2 for the robot 'omni'"),
        (lambda: replace(OMNI, reference=((1.0,),)), "'reference' contains a state of 1 number; expected 2 to 3"),
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
