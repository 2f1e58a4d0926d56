"""The page in a headless Chromium: what is dragged is what the library computes, digit by digit."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest

from taciturn_explore.server import open_page
from taciturn_explore.setting import setting_for
from taciturn_web.serving import Served

REFINED = ".explore[data-refined=true]:not([data-setting='{}'])"
PATIENCE = 60_000  # milliseconds


@pytest.fixture(scope="module")
def page() -> Iterator[Served]:
    """Serve the page of a built-in problem."""
    begin, trusted = setting_for("two-mass")
    with open_page(begin, trusted, ("127.0.0.1", 0)) as served:
        yield served


def opened(browser: Any, url: str, size: tuple[int, int] = (1440, 900)) -> tuple[Any, list[str]]:
    """Return a page that shows a refined point, and the errors of its console."""
    tab, errors = browser.new_page(viewport={"width": size[0], "height": size[1]}, accept_downloads=True), list[str]()
    tab.set_default_timeout(PATIENCE)
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("console", lambda said: said.type == "error" and errors.append(said.text))
    tab.goto(url)
    tab.wait_for_selector(REFINED.format(""))
    return tab, errors


def row(tab: Any, look: str) -> list[str]:
    """Return the cells of a row of the table of numbers."""
    return [cell.strip() for cell in tab.locator(f".numbers tr.{look} > td").all_inner_texts()]


def evaluated(folder: Path, command: str) -> dict[str, Any]:
    """Run the command that the page shows, and return its document."""
    arguments = command.split()[1:]
    ran = subprocess.run(
        [sys.executable, "-m", "taciturn", *arguments, "--json", "--confidence", "0"],
        cwd=folder, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return json.loads(ran.stdout)


@pytest.mark.evidence
def test_the_dragged_point_has_the_digits_of_evaluate(browser: Any, page: Served, tmp_path: Path) -> None:
    """The point is dragged, a weight is changed, and the file is saved: the command prints the same numbers."""
    tab, errors = opened(browser, page.url)
    before = tab.get_attribute(".explore", "data-setting")
    box = tab.locator(".handle .dot").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    tab.mouse.move(x, y)
    tab.mouse.down()
    for i in range(1, 9):
        tab.mouse.move(x - 6 * i, y - 5 * i)
    tab.mouse.up()
    tab.wait_for_selector(REFINED.format(before))
    setting = tab.get_attribute(".explore", "data-setting")
    assert setting.startswith("problem=two-mass&policy.theta=")
    assert float(setting.rpartition("=")[2]) > 0.06
    field = tab.get_by_label("Q ×, number")
    field.fill("2")
    field.press("Enter")
    tab.wait_for_selector(REFINED.format(setting))
    tab.get_by_role("button", name="Take away").click()
    with tab.expect_download() as download:
        tab.get_by_role("button", name="problem file").click()
    download.value.save_as(tmp_path / "saved.toml")
    command = tab.locator(".takeaway pre").first.inner_text()
    found = evaluated(tmp_path, command)
    tab.keyboard.press("Escape")
    cost, _, traffic = row(tab, "policy")
    (rate,) = found["rates"].values()
    assert cost == written(found["cost"])
    assert traffic == written(rate)
    assert float(row(tab, "periodic")[0].split()[0]) == pytest.approx(found["cost_periodic_same_rate"], rel=1e-4)
    assert errors == []
    tab.close()


def written(number: dict[str, Any]) -> str:
    """Return a number of a document as the library writes it."""
    from taciturn.model.estimate import Estimate

    return str(Estimate(number["value"], number["standard_error"], "simulation"))


@pytest.mark.evidence
def test_moves_of_the_keyboard_end_in_their_own_answer(browser: Any, page: Served) -> None:
    """Every shown number belongs to the setting that the page names: at no time is there one of an earlier move."""
    tab, errors = opened(browser, page.url)
    tab.evaluate(
        """() => {
          window.mixed = [];
          const host = document.querySelector('.explore');
          new MutationObserver(() => {
            const theta = host.dataset.setting.match(/theta=([^&]*)/)?.[1] ?? '0.052';
            const shown = document.querySelector('.handle').getAttribute('aria-valuetext');
            if (!shown.startsWith(`theta ${Number(Number(theta).toPrecision(4))}:`)) window.mixed.push([theta, shown]);
          }).observe(document.querySelector('.verdict'), {childList: true});
        }"""
    )
    handle = tab.locator(".handle")
    handle.focus()
    for key in ["ArrowLeft"] * 12 + ["ArrowRight"] * 4:
        handle.press(key)
    theta = 0.052
    for more in [1] * 12 + [-1] * 4:
        theta = float(f"{theta * 1.08**more:.3g}")
    setting = f"problem=two-mass&policy.theta={theta:g}"
    tab.wait_for_selector(f".explore[data-refined=true][data-setting='{setting}']")
    assert float(handle.get_attribute("aria-valuenow")) == theta
    assert unquote(tab.evaluate("location.hash")) == f"#{setting}"
    assert tab.evaluate("window.mixed") == []
    assert tab.evaluate("document.activeElement === document.querySelector('.handle')")
    assert errors == []
    tab.close()


@pytest.mark.evidence
def test_the_address_restores_everything(browser: Any, page: Served) -> None:
    """Setting, events, pinned setting and compared kinds are in the address."""
    tab, errors = opened(browser, page.url)
    tab.get_by_role("button", name="Pin").click()
    tab.locator(".tools button").filter(has_text="load").click()
    tab.locator(".tools button").filter(has_text="drop").click()
    tab.wait_for_selector(".events button:nth-child(2)")
    slider = tab.get_by_label("theta", exact=True)
    slider.focus()
    slider.press("ArrowRight")
    tab.wait_for_selector(".explore[data-refined=true][data-setting*=theta]")
    tab.wait_for_selector(".numbers tr.difference:has-text('±')")
    address, numbers, events = tab.evaluate("location.href"), row(tab, "policy"), tab.locator(".events").inner_text()
    pinned, difference = row(tab, "pinned"), row(tab, "difference")
    assert pinned != numbers
    assert difference[0].count("±") == 1
    again, more = opened(browser, address)
    again.wait_for_selector(".numbers tr.difference:has-text('±')")
    assert row(again, "policy") == numbers
    assert again.locator(".events").inner_text() == events
    assert (row(again, "pinned"), row(again, "difference")) == (pinned, difference)
    assert errors + more == []
    tab.close()
    again.close()


@pytest.mark.evidence
def test_bad_input_is_refused_at_its_control_and_changes_nothing(browser: Any, page: Served) -> None:
    """The sentence is that of the library, the last setting goes on, and the next one takes the sentence away."""
    tab, errors = opened(browser, page.url)
    before = row(tab, "policy")
    for label, given, sentence in (
        ("seed", "12345678901234567890", "seed is 12345678901234567890; expected a whole number from 0"),
        ("seed", "-5", "seed is -5; expected"),
        ("steps", "1.5", "steps is 1.5; expected a whole number from 20 to 4000"),
        ("theta, number", "-1", "policy.theta is -1; expected 0 ≤ theta"),
        ("theta, number", "much", "policy.theta is 'much'; expected a number"),
    ):
        field = tab.get_by_label(label, exact=True)
        field.fill(given)
        field.press("Tab")  # the field has no focus when the answer arrives
        tab.wait_for_selector(f".refusal:has-text({json.dumps(sentence, ensure_ascii=False)})")
        assert field.get_attribute("aria-invalid") == "true"
        assert tab.locator(f"#{field.get_attribute('aria-describedby')}").inner_text().count(sentence) == 1
        assert unquote(tab.evaluate("location.hash")) == "#problem=two-mass"
        assert row(tab, "policy") == before
        assert field.input_value() == given.replace("-", "−" if "theta" in label else "-")
    field.fill("0.1")
    field.press("Enter")
    tab.wait_for_selector(REFINED.format("problem=two-mass"))
    assert tab.locator(".refusal, [aria-invalid]").count() == 0
    assert tab.get_by_label("seed", exact=True).input_value() == "0"
    assert errors == []
    tab.close()


@pytest.mark.evidence
@pytest.mark.parametrize(
    ("address", "sentence"),
    [
        ("problem=two-mass&seed=12345678901234567890", "expected a whole number from 0"),
        ("problem=two-mass&policy.theta=-1", "expected 0 ≤ theta"),
        ("problem=two-mass-continuous&policy.period=1000", "expected a shorter period"),
    ],
    ids=["no setting", "a parameter out of range", "no design"],
)
def test_an_address_that_cannot_be_shown_leads_back_to_the_file(
    browser: Any, page: Served, address: str, sentence: str
) -> None:
    """It shows the sentence and no number, and a button opens what the command line has named."""
    tab = browser.new_page()
    tab.set_default_timeout(PATIENCE)
    tab.goto(f"{page.url}#{address}")
    tab.wait_for_selector(".sentence:visible")
    assert sentence in tab.locator(".sentence").inner_text()
    assert tab.locator(".verdict").inner_text() == ""
    assert tab.locator(".numbers tr, .link, .plane .handle:visible, svg.response *").count() == 0
    tab.get_by_role("button", name="Open the file as it was given").click()
    tab.wait_for_selector(".explore[data-refined=true][data-setting='problem=two-mass']")
    assert tab.locator(".sentence:visible").count() == 0
    assert row(tab, "policy")[1].startswith("+1.0")
    tab.close()


@pytest.mark.evidence
def test_a_setting_without_a_design_has_no_numbers_of_another_one(browser: Any, page: Served) -> None:
    """All of them go, and a button leads back to the last setting."""
    tab = browser.new_page()
    tab.set_default_timeout(PATIENCE)
    tab.goto(f"{page.url}#problem=two-mass-continuous")
    tab.wait_for_selector(".link")
    field = tab.get_by_label("period, number", exact=True)
    field.fill("1000")
    field.press("Enter")
    tab.wait_for_selector(".sentence:visible")
    assert "expected a shorter period" in tab.locator(".sentence").inner_text()
    assert tab.locator(".verdict, .effort").all_inner_texts() == ["", ""]
    assert tab.locator(".numbers tr, .link, .plane .handle:visible, svg.response *").count() == 0
    assert tab.get_by_role("button", name="Take away").is_disabled()
    tab.get_by_role("button", name="Back to the last setting").click()
    tab.wait_for_selector(".explore[data-refined][data-setting='problem=two-mass-continuous']")
    assert tab.locator(".verdict").inner_text().count("of the packets") == 1
    tab.close()


@pytest.mark.evidence
def test_the_difference_belongs_to_the_shown_setting(browser: Any, page: Served) -> None:
    """From a move until its own difference arrives, it is blank."""
    tab, errors = opened(browser, page.url)
    tab.get_by_role("button", name="Pin").click()
    tab.get_by_label("theta", exact=True).press("ArrowRight")
    tab.wait_for_selector(".numbers tr.difference:has-text('±')")
    tab.evaluate(
        """() => {
          window.stale = [];
          const host = document.querySelector('.explore');
          const shown = () => host.querySelector('tr.difference').textContent;
          const old = [host.dataset.setting, shown()];
          new MutationObserver(() => {
            if (host.dataset.setting !== old[0] && shown() === old[1]) window.stale.push(host.dataset.setting);
          }).observe(host.querySelector('.numbers'), {childList: true});
        }"""
    )
    before = tab.get_attribute(".explore", "data-setting")
    tab.get_by_label("theta", exact=True).press("ArrowRight")
    tab.wait_for_selector(REFINED.format(before))
    tab.wait_for_selector(".numbers tr.difference:has-text('±')")
    assert tab.evaluate("window.stale") == []
    assert errors == []
    tab.close()


@pytest.mark.evidence
def test_events_move_nothing_and_the_link_opens_in_another_browser(browser: Any, page: Served) -> None:
    """The figure keeps its size, a load added again has the size of the first, and the link has the token."""
    tab, errors = opened(browser, page.url)
    tab.context.grant_permissions(["clipboard-read", "clipboard-write"])
    size = tab.locator("svg.response").bounding_box()
    for many in (1, 2, 3):
        tab.get_by_role("button", name="load on force").click()
        tab.wait_for_selector(f".events button:nth-child({many})")
        assert tab.locator("svg.response").bounding_box() == size
    assert len(set(tab.locator(".events button").all_inner_texts())) == 1
    tab.get_by_role("button", name="Take away").click()
    tab.get_by_role("button", name="link").click()
    tab.wait_for_selector(".told:has-text('on this machine')")
    link = tab.evaluate("navigator.clipboard.readText()")
    other, more = opened(browser, link)
    assert other.locator(".events button").count() == 3
    assert errors + more == []
    tab.close()
    other.close()


@pytest.mark.evidence
def test_a_rival_far_away_is_named_at_the_edge_of_the_axis(browser: Any, page: Served) -> None:
    """The axis holds what is near the policy; an arrow leads to the pinned setting, with the excess of the table."""
    tab, errors = opened(browser, f"{page.url}#problem=two-mass&pin=problem%3Dtwo-mass%26policy.theta%3D50")
    tab.wait_for_selector(".plane .edge")
    above = row(tab, "pinned")[1]
    assert float(above.removesuffix(" %")) > 500
    assert tab.locator(".plane .edge").text_content() == f"↑ pinned {above}"
    ticks = tab.locator(".plane .axis text[text-anchor=end]").all_text_contents()
    assert all(float(tick.replace("−", "-").removesuffix(" %")) < 20 for tick in ticks)
    assert errors == []
    tab.close()


@pytest.mark.evidence
def test_a_page_whose_program_has_ended_says_so(browser: Any) -> None:
    """In a sentence with the remedy, not in the words of the browser."""
    with open_page(*setting_for("two-mass"), ("127.0.0.1", 0)) as served:
        tab, _ = opened(browser, served.url)
    tab.get_by_label("theta", exact=True).press("ArrowRight")
    tab.wait_for_selector(".sentence:has-text('has ended; start taciturn explore again')")
    tab.close()


@pytest.mark.evidence
def test_a_phone_shows_the_page_without_scrolling_sideways(browser: Any, page: Served) -> None:
    """Everything that can be operated has a name, and the point is in reach of the keyboard."""
    tab, errors = opened(browser, page.url, (320, 844))
    tab.wait_for_selector(".compare button")
    assert tab.evaluate("document.documentElement.scrollWidth") <= 320
    nameless = tab.evaluate(
        """() => [...document.querySelectorAll('button, select, input, [role=slider]')]
          .filter((one) => !(one.labels?.length || one.getAttribute('aria-label') || one.textContent.trim()))
          .map((one) => one.outerHTML)"""
    )
    assert nameless == []
    for _ in range(12):
        tab.keyboard.press("Tab")
        if tab.evaluate("document.activeElement.getAttribute('role')") == "slider":
            break
    assert tab.evaluate("document.activeElement.getAttribute('aria-valuetext')").startswith("theta 0.052: 26.")
    assert errors == []
    tab.close()
