"""The page of a run in a headless Chromium: what it shows moves, and what people do with it reaches the run."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from counts import few
from twin.browser import await_ticks, await_true, missing
from twin.feeds import OMNI, PRICE, ROVER, every_sample, picture, rows

from taciturn_twins.page import Page
from taciturn_web import events

WIDE, PHONE = {"width": 1280, "height": 800}, {"width": 360, "height": 740}
ROWS = rows(ROVER, 40)


@pytest.fixture
def page() -> Iterator[Page]:
    """Return a page on which a round of the rover has begun."""
    with Page(("127.0.0.1", 0)) as page:
        page.begin(ROVER)
        yield page


class Tabs:
    """Opens pages and keeps what their consoles complain of."""

    def __init__(self, browser: Any) -> None:
        """None is open."""
        self._browser, self._open, self.errors = browser, list[Any](), list[str]()

    def open(self, url: str, size: dict[str, int] = WIDE) -> Any:
        """Open one and wait until it listens."""
        tab = self._browser.new_page(viewport=size)
        self._open.append(tab)
        tab.set_default_timeout(8000)
        tab.on("console", lambda message: message.type in ("error", "warning") and self.errors.append(message.text))
        tab.on("pageerror", lambda error: self.errors.append(str(error)))
        tab.goto(url, wait_until="commit")
        if url != "about:blank":
            tab.wait_for_selector("#status:not([data-state=lost])")
        return tab

    def close(self) -> None:
        """Close all."""
        for tab in self._open:
            tab.close()


@pytest.fixture
def tabs(browser: Any) -> Iterator[Tabs]:
    """Return an opener of pages; their consoles must have stayed silent."""
    tabs = Tabs(browser)
    yield tabs
    tabs.close()
    assert tabs.errors == []


def await_asked(page: Page, count: int = 1) -> list[tuple[str, float]]:
    """Return what is asked, once so much has come."""
    found: list[tuple[str, float]] = []
    end = time.monotonic() + 8
    while len(found) < count and time.monotonic() < end:
        found += page.asked()
        time.sleep(0.01)
    return found


def drawn(tab: Any, panel: str) -> str:
    """Return what is drawn in a panel, as text."""
    return tab.evaluate(f"document.querySelector('#{panel} canvas').toDataURL()")


@pytest.mark.evidence
@pytest.mark.parametrize("about", few([ROVER, OMNI], 1), ids=lambda about: about.robot)
def test_what_a_run_does_is_shown_while_it_does_it(tabs: Tabs, page: Page, about: Any) -> None:
    """Every panel is drawn anew, the numbers are those of the latest row, and the next round starts anew."""
    if about is OMNI:
        page.begin(OMNI)
    tab, told = tabs.open(page.url), rows(about, 40)
    panels = ("path", "input", "trigger", "raster", "cost", "packets")
    for row in told[:2]:
        page.put(row)
    await_ticks(tab, 2)
    before = {panel: drawn(tab, panel) for panel in panels}
    for row in told[2:]:
        page.put(row)
    for row in every_sample(about, 40):
        page.compare(row)
    await_ticks(tab, 40)
    assert [panel for panel in panels if drawn(tab, panel) == before[panel]] == []
    now = [float(cell) for cell in tab.locator("#now tbody tr").first.locator("td").all_text_contents()]
    assert now == pytest.approx([told[39]["state"][0], told[39]["estimate"][0]], rel=5e-4)
    assert float(tab.locator("#cost .legend").inner_text().split()[1]) == pytest.approx(told[39]["cost"], rel=5e-4)
    assert ("guaranteed" in tab.inner_text("#cost")) == (about.bound is not None)
    assert f"40 of {about.ticks} steps" in tab.inner_text("#progress")
    assert tab.inner_text("#compared") == "after 40 steps"
    compared = [row.locator("td").all_text_contents() for row in tab.locator("#compare tbody tr").all()]
    assert [cells[2] for cells in compared] == ["125 %", "35 %", "13 %"]  # 1/0.8, 14/40, 5/40
    assert float(compared[0][1]) == pytest.approx(0.8 * told[39]["cost"], rel=5e-4)
    page.begin(replace(about, round=9))
    page.put(told[0])
    await_true(tab, "document.body.dataset.rows === '1'")
    assert "round 9, 1 of" in tab.inner_text("#progress")


@pytest.mark.evidence
def test_charts_appear_with_the_first_step_and_show_it(tabs: Tabs, page: Page) -> None:
    """Before, the page shows what the run prepares; a new round replaces the charts of the last one by its own."""
    page.wait("round 1: starting the processes")
    tab = tabs.open(page.url)
    await_true(tab, "document.getElementById('waiting').textContent.startsWith('round 1: starting')")
    assert not tab.is_visible("main")
    page.begin(ROVER)
    page.compare(every_sample(ROVER, 1)[0])
    tab.wait_for_selector("#push:enabled")
    assert not tab.is_visible("main")
    page.put(ROWS[0])
    await_ticks(tab, 1)
    assert tab.is_visible("main")
    assert not tab.is_visible("#waiting")
    coloured = """panel => { const canvas = document.querySelector(`#${panel} canvas`);
        const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
        let found = 0;
        for (let i = 0; i < data.length; i += 4)
          found += Math.abs(data[i] - data[i + 2]) > 60 && data[i + 3] > 100; // neither ink nor the grid
        return found; }"""
    assert [
        panel for panel in ("path", "input", "trigger", "cost", "packets") if not tab.evaluate(coloured, panel)
    ] == []
    page.put(ROWS[1])
    await_ticks(tab, 2)
    page.wait("round 2: starting the processes")
    page.begin(replace(ROVER, round=2))
    await_true(tab, "document.getElementById('progress').textContent === 'round 2'")
    assert tab.evaluate("document.body.dataset.rows") == "2"  # the charts of round 1 remain until round 2 has a step
    page.put(ROWS[0])
    await_true(tab, "document.body.dataset.rows === '1'")


@pytest.mark.evidence
def test_designed_drops_are_one_sentence_and_the_parameter_is_explained(tabs: Tabs, page: Page) -> None:
    """The events list the unusual alone, at their steps; the meaning of the slider is next to it and read with it."""
    for row in ROWS:
        page.put(row)
    page.note("the picture shows no marker", 7)
    tab = tabs.open(page.url)
    await_ticks(tab, 40)
    tab.wait_for_selector("#events li")
    drops = sum(row["sent"]["sensor"] - row["arrived"]["sensor"] for row in ROWS)
    sentence = f"{drops} of 14 packets dropped on the sensor link, as designed (p = 0.2)"
    assert tab.inner_text("#drops") == sentence  # the actuator link of this round drops nothing
    assert tab.locator("#events li").all_text_contents() == ["step 7the picture shows no marker"]
    assert tab.inner_text("#meaning") == PRICE
    assert tab.get_attribute("#parameter", "aria-describedby") == "meaning"


@pytest.mark.evidence
def test_a_tab_that_joins_late_shows_the_same(tabs: Tabs, page: Page) -> None:
    """The whole round, the picture and the notes."""
    for row in ROWS:
        page.put(row)
    page.show(picture(ROVER, ROWS[-1]))
    page.note("camera: <b>no marker</b> seen")
    both = [tabs.open(page.url), tabs.open(page.url)]
    for tab in both:
        await_ticks(tab, 40)
        await_true(tab, "document.getElementById('picture').naturalWidth === 320")
        assert tab.is_visible("#picture")
        assert "camera: <b>no marker</b> seen" in tab.inner_text("#events")  # as text
    assert both[0].inner_text("#now") == both[1].inner_text("#now")


@pytest.mark.evidence
def test_the_picture_is_the_newest(tabs: Tabs, page: Page) -> None:
    """However fast they come, the last one is shown."""
    page.put(ROWS[0])
    tab = tabs.open(page.url)
    await_ticks(tab, 1)
    assert tab.is_visible("#blind")
    for k in range(30):
        page.show(picture(ROVER, ROWS[0], (64 + k, 48)))
    await_true(tab, "document.getElementById('picture').naturalWidth === 93")
    assert not tab.is_visible("#blind")


@pytest.mark.evidence
def test_the_slider_acts_when_it_is_released(tabs: Tabs, page: Page) -> None:
    """Its ends are the least (here 0) and the largest value; while it is held nothing is asked."""
    tab = tabs.open(page.url)
    tab.wait_for_selector("#parameter:enabled")
    assert tab.inner_text("#parameter-value") == "0.01"
    for key, value in (("End", 0.1), ("Home", 0.0)):
        tab.focus("#parameter")
        tab.keyboard.press(key)
        assert await_asked(page) == [("value", value)]
    box = tab.locator("#parameter").bounding_box()
    tab.mouse.move(box["x"] + 9, box["y"] + box["height"] / 2)
    tab.mouse.down()
    tab.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, steps=5)
    await_true(tab, "!document.getElementById('parameter-value').textContent.endsWith('→ 0')")
    assert page.asked() == []
    tab.mouse.up()
    [(what, value)] = await_asked(page)
    assert what == "value"
    assert 0.0008 < value < 0.00125  # half way up four decades: 0.001, by a pixel
    page.begin(replace(ROVER, value=0.05))
    await_true(tab, "document.getElementById('parameter-value').textContent === '0.05'")
    page.begin(replace(OMNI, value=0.1))  # above 0 the middle is the geometric mean: 0.1² = 0.001 · 10
    await_true(tab, "document.getElementById('parameter-name').textContent === 'theta'")
    assert tab.input_value("#parameter") == "500"


@pytest.mark.evidence
def test_pause_and_push_reach_the_run_and_the_other_tabs(tabs: Tabs, page: Page) -> None:
    """A pause on one page is one on all, and any page ends it."""
    first, second = tabs.open(page.url), tabs.open(page.url)
    for tab in (first, second):
        tab.wait_for_selector("#push:enabled")
    first.click("#push")
    assert await_asked(page) == [("push", 1.0)]
    first.click("#pause")
    assert await_asked(page) == [("pause", 1.0)]
    second.wait_for_selector("#status[data-state=paused]")
    assert second.inner_text("#pause") == "Resume"
    second.click("#pause")
    assert await_asked(page) == [("pause", 0.0)]
    first.wait_for_selector("#status[data-state=connected]")


@pytest.mark.evidence
def test_a_page_with_a_token_shows_and_acts(tabs: Tabs) -> None:
    """By the address that the run prints."""
    with Page(("0.0.0.0", 0), token="a+b/c&d") as page:
        page.begin(ROVER)
        page.put(ROWS[0])
        page.show(picture(ROVER, ROWS[0]))
        tab = tabs.open(page.url)
        await_ticks(tab, 1)
        await_true(tab, "document.getElementById('picture').naturalWidth === 320")
        tab.click("#push")
        assert await_asked(page) == [("push", 1.0)]


@pytest.mark.evidence
def test_a_run_that_ends_and_comes_back_is_found_again(tabs: Tabs) -> None:
    """The page says that it has ended, and shows the next run with the same address and token without being touched."""
    with Page(("127.0.0.1", 0), "kept") as page:
        page.begin(ROVER)
        page.put(ROWS[0])
        tab = tabs.open(page.url)
        await_ticks(tab, 1)
    tab.wait_for_selector("#status[data-state=ended]")
    assert tab.is_disabled("#push")
    with Page(page.address, "kept") as again:
        again.begin(OMNI)
        for row in rows(OMNI, 5):
            again.put(row)
        await_ticks(tab, 5)
        tab.wait_for_selector("#status[data-state=connected]")
        assert "omni, lossy-lqg" in tab.inner_text("header")
        tab.close()
    assert [text for text in tabs.errors if "ERR_CONNECTION_REFUSED" not in text] == []
    tabs.errors.clear()  # what the browser itself says of a server that is gone


@pytest.mark.evidence
def test_triggers_over_decades_are_logarithmic(tabs: Tabs, page: Page) -> None:
    """Zeros are put at the bottom; values below zero, or of like size, are drawn as they are."""
    tab = tabs.open(page.url)
    scaled = "async lists => (await import('./curves.js')).scaled(lists)"
    log, [values, threshold] = tab.evaluate(scaled, [[0.0, 1e-6, 0.1], [None, 0.05, 0.05]])
    assert log
    assert 0 < values[0] < 1e-6
    assert values[1:] + threshold == [1e-6, 0.1, None, 0.05, 0.05]
    for plain in ([-1.0, 1e-6, 0.1], [0.0, 0.0, 0.0], [None, None, None], [1.0, 2.0, 0.0]):
        assert tab.evaluate(scaled, [plain, plain]) == [False, [plain, plain]]
    for k, (value, title) in enumerate([(1e-6, "trigger (log scale; 0 at the bottom)"), (0.01, "trigger")], 10):
        page.begin(replace(ROVER, round=k))
        page.put({**ROWS[0], "trigger": value, "threshold": 0.05})
        await_true(tab, f"document.getElementById('progress').textContent.includes('round {k}, 1 of')")
        assert tab.inner_text("#trigger h2") == title


@pytest.mark.evidence
def test_a_run_that_falls_silent_is_called_again(tabs: Tabs, page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no word comes, and no end of the connection either, the page listens anew after some seconds."""
    monkeypatch.setattr(events, "PULSE", 60.0)
    page.put(ROWS[0])
    page.note("hello")
    tab = tabs.open("about:blank")
    tab.clock.install()
    tab.goto(page.url, wait_until="commit")
    tab.wait_for_selector("#status[data-state=connected]")
    with tab.expect_request("**/events?*"):
        tab.clock.fast_forward(8000)
    tab.wait_for_selector("#status[data-state=connected]")
    tab.wait_for_selector("#events li")
    assert tab.inner_text("#events ol").count("hello") == 1  # what is told again is not written twice


@pytest.mark.evidence
def test_the_marks_of_the_raster_differ_in_shape(tabs: Tabs, page: Page) -> None:
    """Arrived, lost and silent are drawn by different strokes, whatever their colours."""
    shapes = tabs.open(page.url).evaluate(
        """async () => { const { drawRaster } = await import("./drawings.js");
        return [[1, 1], [1, 0], [0, 0]].map(([sent, arrived]) => {
          const marks = [], draw = (_, name) => (...numbers) => marks.push([name, ...numbers]);
          const row = { tick: 1, sent: { a: sent }, arrived: { a: arrived }, degraded: 0 };
          const pen = new Proxy({}, { set: () => true, get: draw });
          drawRaster(pen, 400, 100, { about: { links: ["a"] }, rows: [row] });
          return JSON.stringify(marks); }); }"""
    )
    assert len(set(shapes)) == 3


@pytest.mark.evidence
@pytest.mark.parametrize(
    "screen", few([(ROVER, WIDE), (OMNI, WIDE), (OMNI, PHONE)], 1, 2), ids=["screen", "other", "phone"]
)
def test_it_fits_a_screen_and_a_phone(tabs: Tabs, page: Page, screen: tuple[Any, dict[str, int]]) -> None:
    """At 1280 by 800 nothing needs scrolling; on a phone nothing is wider than it, and buttons fit a thumb."""
    about, size = screen
    page.begin(about)
    for row in rows(about, 40):
        page.put(row)
    tab = tabs.open(page.url, size)
    await_ticks(tab, 40)
    width, height = tab.evaluate("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]")
    assert width <= size["width"]
    assert size is PHONE or height <= size["height"]
    assert size is WIDE or tab.locator("#push").bounding_box()["height"] >= 44
    overlaps = tab.evaluate(
        """() => { const all = [...document.querySelectorAll("header, section")];
        const boxes = all.map((element) => element.getBoundingClientRect());
        return boxes.flatMap((a, i) => boxes.slice(i + 1).filter((b) => a.left < b.right - 1
          && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1)).length; }"""
    )
    assert overlaps == 0


def test_a_missing_browser_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The reason to skip says what to install."""
    monkeypatch.setenv("PATH", str(tmp_path))
    assert re.search(r"expected .*: (apt-get install chromium|pip install playwright)$", missing())
