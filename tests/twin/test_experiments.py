"""The experiments of chapters 6 and 7 with twins, in full: what they cost and send, faults, and real time."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest
from twin import browser
from twin.crews import crew

from taciturn_twins.faults import parse_fault
from taciturn_twins.live import watch_twin
from taciturn_twins.outcome import mean
from taciturn_twins.page import Page
from taciturn_twins.report import vision
from taciturn_twins.run import TwinRun, run_twin
from taciturn_twins.trial import Setup

pytestmark = pytest.mark.evidence
PRICES = (0.0, 0.001, 0.002, 0.01)


def sees_well(run: TwinRun) -> None:
    """Check that the camera is right to a millimetre, and within two."""
    for state, off in vision(run.trial.vision, run.prepared.robot).items():
        if state in ("x", "y"):
            assert abs(off["bias_mm"]) <= 1
            assert off["standard_deviation_mm"] <= 2


def test_twenty_missions_of_the_rover_ask_and_send_little_and_cost_hardly_more() -> None:
    """Eighty per cent fewer questions, 85 % fewer sends or more, within 15 % of all-time and within the guarantee."""
    run = run_twin(crew("rover"), Setup(runs=20))
    assert run.always is not None
    assert run.cost_bound is not None
    asked = run.trial.sent["sensor"].sum(axis=1)
    assert ((asked >= 9) & (asked <= 13)).all()  # 11 of 60 in the thesis, whose noise is a little other
    assert run.rates["actuator"].value + 2 * run.rates["actuator"].standard_error <= 0.15
    assert run.cost.value + 2 * run.cost.standard_error <= run.cost_bound
    above = mean(run.trial.totals / run.always.totals)
    assert above.value + 2 * above.standard_error <= 1.15
    for trial in (run.trial, run.always):
        assert trial.datagrams["unaccounted"] == trial.datagrams["dropped_by_full_buffers"] == 0
    sees_well(run)


@cache
def rounds(price: float) -> TwinRun:
    """Return five rounds at a price of a send."""
    return run_twin(crew("omni"), Setup(runs=5), parameters={"price": price}, compare=False)


def test_dearer_sends_are_rarer_and_cost_what_the_theorem_allows() -> None:
    """Figure 7.6: the order of its points, at least 85 % fewer sends at λ = 0.01, and J below J_all + Nλ there."""
    found = {price: rounds(price) for price in PRICES}
    rates = [found[price].rates["actuator"] for price in PRICES]
    costs = [found[price].trial.totals for price in PRICES]
    for rarer, more in zip(rates[1:], rates, strict=False):
        assert rarer.value + rarer.standard_error < more.value
    for dearer, cost in zip(costs[1:], costs, strict=False):  # the rounds have common draws
        more = mean(dearer - cost)
        assert more.value > -2 * more.standard_error
    assert mean(costs[-1] - costs[0]).value > 4 * mean(costs[-1] - costs[0]).standard_error
    last = found[0.01]
    assert last.rates["actuator"].value <= 0.15
    assert last.cost_bound is not None
    assert last.cost.value + 2 * last.cost.standard_error <= last.cost_bound
    for run in found.values():
        assert run.trial.datagrams["unaccounted"] == 0
        sees_well(run)
        assert np.sqrt((run.trial.off**2).mean()) < 0.1


@pytest.mark.parametrize(
    "fault", ["camera@6+2", "actuator@6+2", "kidnap@6=0.2", "cover@6+2", "light@0+25=0.4", "controller@6"]
)
def test_the_omni_comes_back_to_its_path_whatever_happens(fault: str) -> None:
    """Two seconds without eyes or hands, a kidnap, another light, a killed node: within 15 cm of it at the end."""
    run = run_twin(crew("omni"), Setup(seed=1, faults=(parse_fault(fault),)), compare=False)
    distance = run.trial.off[0]
    assert distance[-50:].max() < 0.15
    assert distance.max() < 0.35
    if fault.startswith("kidnap"):
        assert distance.max() > 0.1


@pytest.mark.parametrize(
    "fault", ["camera@1.2+2", "actuator@3+2", "kidnap@6=0.2", "cover@1.2+2", "light@0+18=0.4", "controller@3"]
)
def test_the_rover_comes_home_whatever_happens(fault: str) -> None:
    """As above, in 18 s: nearer to zero than a fifth of the way."""
    run = run_twin(crew("rover"), Setup(seed=1, faults=(parse_fault(fault),)), compare=False)
    distance = abs(run.trial.poses[0, :, 0])
    assert distance[-10:].mean() < 0.14


@pytest.mark.parametrize(("name", "tick"), [("rover", 0.1), ("omni", 0.1)])
def test_by_the_clock_it_goes_as_in_virtual_time(name: str, tick: float) -> None:
    """The rover's steps in a third of their time, the omni's in theirs: as many questions, and about the same path."""
    run = run_twin(crew(name), Setup(seed=1, tick=tick), compare=False)
    still = run_twin(crew(name), Setup(seed=1), compare=False)
    assert run.trial.sent["sensor"].sum() == still.trial.sent["sensor"].sum()
    assert run.trial.datagrams["sensor"]["delivered"] >= 0.9 * still.trial.datagrams["sensor"]["delivered"]
    last = abs(run.trial.poses[0, -1] - still.trial.poses[0, -1])
    assert last[: 2 if name == "omni" else 1].max() < 0.15


def test_rollers_and_capsules_tell_the_same() -> None:
    """Wheels with 48 rollers, or with friction that depends on the direction: costs within their spread."""
    rolling = run_twin(crew("omni"), Setup(runs=2, variant="rollers"), compare=False)
    usual = rounds(0.01)
    assert rolling.rates["actuator"].value <= 0.25
    spread = usual.trial.totals.std(ddof=1)
    assert abs(rolling.cost.value - usual.cost.value) < 4 * spread


@pytest.fixture
def tab() -> Iterator[Any]:
    """Give a tab of a browser."""
    if browser.missing():
        pytest.skip(f"NOT SHOWN: a twin in a browser; {browser.missing()}")
    with browser.browse() as chromium:
        yield chromium.new_page()


def test_a_twin_is_watched_paused_pushed_and_turned_in_a_browser(tab: Any) -> None:
    """Values move, the picture is there, a pause stops the steps, the slider ends the round and sets the next."""
    from threading import Event, Thread

    said: list[str] = []
    tab.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: said.append(str(error)))
    ended, prepared = Event(), crew("rover")
    with Page(("127.0.0.1", 0)) as page:
        running = Thread(
            target=watch_twin, args=(prepared, page, Setup()), kwargs={"speed": 4.0, "stopped": ended.is_set}
        )
        running.start()
        try:
            tab.goto(page.url)
            rows = "Number(document.body.dataset.rows ?? 0)"
            browser.await_ticks(tab, 6, 60.0)
            browser.await_true(tab, "document.querySelector('#picture').naturalWidth === 640", 30.0)
            tab.locator("#push").click()
            tab.get_by_text("push of both robots: 4 N for 0.3 s").wait_for(timeout=20_000)
            tab.locator("#pause").click()
            tab.wait_for_selector("#status[data-state=paused]")
            tab.wait_for_timeout(1000)
            still = tab.evaluate(rows)
            tab.wait_for_timeout(1500)
            assert tab.evaluate(rows) == still
            tab.locator("#pause").click()
            browser.await_ticks(tab, still + 1, 20.0)
            box = tab.locator("#parameter").bounding_box()
            tab.mouse.click(box["x"] + 0.3 * box["width"], box["y"] + box["height"] / 2)
            tab.get_by_text("round 1,").wait_for(timeout=60_000)
            value = float(tab.locator("#parameter-value").inner_text())
            assert 0 < value < 0.1  # which was 0.5
            browser.await_ticks(tab, 6, 60.0)
        finally:
            ended.set()
            running.join(60)
    assert not running.is_alive()
    assert said == []
