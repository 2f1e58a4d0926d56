"""The page without a server: a saved page, and a cell of a notebook, show the answers that the library gives."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any

import pytest
from twin.browser import browse, missing

import taciturn
from taciturn.errors import ProblemError
from taciturn_explore.bundle import bundle
from taciturn_explore.saved import save_page
from taciturn_explore.setting import Setting, setting_of

# where the handle stands, on the axes of the plane
PLACE = """() => {
  const place = document.querySelector('.handle').getAttribute('transform').match(/[\\d.]+/g).map(Number);
  const ticks = (end, at) => [...document.querySelectorAll(`.plane .axis text[text-anchor=${end}]`)]
    .filter((one) => /%/.test(one.textContent)).map((one) => [parseFloat(one.textContent.replace('−', '-')), at(one)]);
  const along = ([[a, from], ...rest], here) => a + (here - from) * (rest.at(-1)[0] - a) / (rest.at(-1)[1] - from);
  return [along(ticks('middle', (one) => +one.getAttribute('x')), place[0]),
          along(ticks('end', (one) => +one.getAttribute('y') - 4), place[1])];
}"""

# whether two names in the plane overlap
OVERLAP = """() => {
  const boxes = [...document.querySelectorAll('.plane .label')].map((one) => one.getBoundingClientRect());
  return boxes.length < 3 || boxes.some((a, i) => boxes.slice(i + 1).some((b) =>
    a.left < b.right && b.left < a.right && a.top + 2 < b.bottom && b.top + 2 < a.bottom));
}"""

# a page that shows the plane of the saved one in a frame; its title is the height that the frame is to have
AROUND = """<!doctype html><title>0</title><iframe src="page.html?plane" width="700"></iframe>
<script>addEventListener("message", ({ data }) => { document.title = data.height; });</script>"""


@pytest.mark.evidence
def test_a_saved_page_needs_nothing_but_its_file(tmp_path: Path) -> None:
    """Opened from its folder, its point moves to settings that the library has computed."""
    if lacks := missing():
        pytest.skip(f"NOT SHOWN: the saved page in a browser; {lacks}")
    file = tmp_path / "page.html"
    many = save_page(Setting(name="two-mass", compare=("lqg", "excess")), None, file)
    text = file.read_text(encoding="utf-8")
    assert many > 15
    assert not re.search(r"\b(src|href)=", re.sub(r"<script.*</script>", "", text, flags=re.DOTALL))
    asked, errors = list[str](), list[str]()
    with browse() as browser:
        tab = browser.new_page()
        tab.on("request", lambda request: asked.append(request.url))
        tab.on("pageerror", lambda error: errors.append(str(error)))
        tab.goto(file.as_uri())
        tab.wait_for_selector(".explore[data-refined=true]")
        share, above = tab.evaluate(PLACE)
        told = re.match(r"([\d.]+) % of the packets, ([\d.]+) % more cost", tab.locator(".verdict").inner_text())
        assert told is not None
        opened = taciturn.evaluate(taciturn.load("two-mass"), after_step=False)
        assert tab.locator(".numbers tr.policy td").first.inner_text() == str(opened.cost)
        assert (share, above) == (pytest.approx(float(told[1]), abs=0.1), pytest.approx(float(told[2]), abs=0.02))
        tab.get_by_role("button", name="Take away").click()
        with tab.expect_download() as download:
            tab.get_by_role("button", name="plane, CSV").click()
        rows = Path(download.value.path()).read_text(encoding="utf-8").splitlines()
        tab.keyboard.press("Escape")
        field = tab.get_by_label("theta, number")
        field.fill("-1")
        field.press("Enter")
        tab.wait_for_selector(".refusal:has-text('policy.theta is -1; expected a number above 0')")
        handle = tab.locator(".handle")
        handle.focus()
        for _ in range(12):
            handle.press("ArrowLeft")
        tab.wait_for_selector(".explore[data-setting*=theta]")
        tab.wait_for_timeout(100)
        assert not tab.evaluate(OVERLAP)
        setting = tab.get_attribute(".explore", "data-setting")
        cost = tab.locator(".numbers tr.policy td").first.inner_text()
        (around := tmp_path / "around.html").write_text(AROUND, encoding="utf-8")
        framed = browser.new_page()
        framed.goto(around.as_uri())
        framed.wait_for_function("document.title > 300")
        inner = framed.frame_locator("iframe").locator("section:visible")
        assert inner.evaluate_all("all => all.map((one) => one.ariaLabel)") == ["Controls", "Plane"]
    theta = float(dict(setting_of(setting).changes)["policy.theta"])
    problem = taciturn.load("two-mass").changed({"theta": theta})
    expected = taciturn.evaluate(problem, standard_error=0.00073, after_step=False)
    assert theta > 0.1
    assert cost == str(expected.cost)
    assert len(rows) > 40
    assert len({one.partition(",")[2] for one in rows}) == len(rows)  # no point of a curve is there twice
    assert asked == [file.as_uri()]
    assert errors == []


def test_the_bundle_has_every_export_that_its_modules_import() -> None:
    """The joined scripts are one module without imports."""
    for entry in ("precomputed", "widget"):
        text = bundle(entry)
        assert not re.search(r"^(import|export)\b", text, re.MULTILINE)
        for names, module in re.findall(r"^const \{ (.*) \} = (\w+_module);", text, re.MULTILINE):
            exports = re.search(rf"const {module} = .*?^return \{{ (.*?) \}};", text, re.MULTILINE | re.DOTALL)
            assert exports is not None
            assert set(names.split(", ")) <= set(exports[1].split(", ")), (module, names)


@pytest.mark.evidence
def test_a_widget_answers_the_messages_of_its_page() -> None:
    """Its trait is the setting, and a request of the page is answered by messages with its number."""
    widget, told = taciturn.explore("two-mass"), list[dict[str, Any]]()
    widget._tell = told.append
    widget._hear(widget, {"id": "1", "request": {"text": widget.setting, "changes": {"policy.theta": 0.1}}}, [])
    deadline = time.monotonic() + 60
    while not any(one.get("answer", {}).get("answer") == "network" for one in told):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    widget._hear(widget, {"id": "1", "end": True}, [])
    assert [one["answer"]["answer"] for one in told[:4]] == ["setting", "point", "response", "network"]
    assert {one["id"] for one in told} == {"1"}
    expected = taciturn.evaluate(taciturn.load("two-mass").changed({"theta": 0.1}), steps=400_000)
    assert told[1]["answer"]["cost"]["text"] == str(expected.cost)
    widget.setting = told[0]["answer"]["setting"]
    assert widget.problem.parameters["theta"] == 0.1


def test_a_widget_takes_a_problem_that_was_read_from_a_file_only() -> None:
    """Other problems have no keys that could change."""
    problem = taciturn.load("two-mass").changed({"theta": 0.2})
    assert taciturn.explore(problem).problem.parameters == problem.parameters
    other = taciturn.Problem(problem.plant, problem.cost, problem.network, "lqg", {"theta": 0.1})
    with pytest.raises(ProblemError, match="was not read from a file"):
        taciturn.explore(other)
