"""What a plant reports of its costs: a mean with its error where it ran for long enough."""

from __future__ import annotations

import numpy as np
import pytest

import taciturn
from taciturn import Cost, Estimate, Plant, close, design
from taciturn.model.disturbance import follow
from taciturn.model.signals import RandomSteps, Timetable
from taciturn.simulation.statistics import batch_means
from taciturn_udp.averages import (
    cost_of_ticks,
    least_steps,
    measured,
    plant_cost,
    rate_of_ticks,
    remark_on_rates,
    settled,
)
from taciturn_udp.result import NetworkRun
from taciturn_udp.run import _datagrams, _unheard

PROBLEM = taciturn.load("two-mass-lqg")
LOOP = PROBLEM.close(PROBLEM.design())


@pytest.mark.parametrize(
    ("ending", "words"), [({"horizon": 5}, "finite-horizon run"), ({"discount": 0.9}, "run with discounted costs")]
)
def test_the_cost_of_one_run_says_what_kind_of_total_it_is(ending: dict[str, float], words: str) -> None:
    """A discounted problem has no horizon."""
    plant, cost = Plant([[0.9]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]], **ending)  # type: ignore[arg-type]
    loop = close(plant, design.excess(plant, cost, delta=0.1))
    total, notes = cost_of_ticks(loop, np.ones(5), 0.0)
    assert total is not None
    assert total.value == pytest.approx(np.sum(ending.get("discount", 1.0) ** np.arange(5)))
    assert notes == (f"one {words}: its cost is one realisation, not a mean",)


def test_a_long_run_has_a_mean_with_its_error() -> None:
    """Over all loops, without the steps in which the loop settles."""
    skipped = settled(LOOP)
    costs = np.random.default_rng(1).exponential(size=(2, skipped + least_steps(LOOP)))
    costs[:, :skipped] = 1e6
    found = plant_cost(PROBLEM, LOOP, costs.tolist(), 0.0)
    expected = batch_means(costs[:, skipped:].mean(axis=0))
    assert found["cost"]["value"] == pytest.approx(expected.value)
    assert found["cost"]["standard_error"] == pytest.approx(expected.standard_error)
    assert found["unit"] == "step"
    assert found["notes"] == [f"means omit the first {skipped} steps, in which the loop settles"]


def test_where_nothing_arrives_there_is_no_average() -> None:
    """Of a plant that drifts; one that comes to rest needs no input."""
    nothing, little = ({"sent": 600, "delivered": some, "lost": 600 - some} for some in (0, 1))
    (told,) = _unheard(LOOP, {"actuator": nothing})
    assert told.startswith("no packet arrived on the actuator link")
    assert _unheard(LOOP, {"actuator": little}) == ()
    plant, cost = Plant([[0.5]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]])
    assert _unheard(close(plant, design.lqg(plant, cost, theta=1.0)), {"actuator": nothing}) == ()


def test_a_cost_that_a_few_ticks_decide_is_told() -> None:
    """One step in a thousand costs a million times as much."""
    costs = np.ones((1, settled(LOOP) + least_steps(LOOP)))
    costs[0, -1] = 1e6
    assert "its mean square may not exist" in plant_cost(PROBLEM, LOOP, costs.tolist(), 0.0)["notes"][-1]


def test_a_short_run_has_a_mean_alone() -> None:
    """Over all its steps, and it says how many an error takes; a run of no step has none."""
    found = plant_cost(PROBLEM, LOOP, [[1.0, 2.0, 6.0]], 0.0)
    assert found["cost"] == {"value": 3.0, "standard_error": None, "method": "simulation"}
    assert found["notes"][0].startswith("a run of 3 steps is too short for a mean cost with its error")
    assert plant_cost(PROBLEM, LOOP, [[], []], 0.0)["cost"] is None


def test_a_rate_has_an_error_only_by_batch_means() -> None:
    """Not in a finite-horizon run or in a short one, whose correlated sends give no valid error; a note says so."""
    mission, short = taciturn.load("rover"), settled(LOOP) + 50
    runs = np.repeat(np.random.default_rng(1).random(1000) < 0.3, 10)  # sends come ten at a time
    for loop, steps in ((mission.close(mission.design()), 1000), (LOOP, short)):
        rate = rate_of_ticks(loop, runs[:steps])
        assert measured(rate) == {"value": runs[:steps].mean(), "standard_error": None, "method": "simulation"}
        assert remark_on_rates(loop, [rate], steps) == (
            f"the rates are those of this run of {steps} steps, without standard errors",
        )
    rate = rate_of_ticks(LOOP, runs)
    independent = np.sqrt(0.3 * 0.7 / len(runs))
    assert rate.standard_error == pytest.approx(np.sqrt(10) * independent, rel=0.5)
    assert rate.standard_error > 1.5 * independent
    assert remark_on_rates(LOOP, [rate], len(runs)) == ()
    discounted = PROBLEM.changed({"cost.discount": 0.9, "policy.kind": "excess"})
    (remark,) = remark_on_rates(discounted.close(discounted.design()), [Estimate(0.3, 0.0, "exact")], 100)
    assert remark.endswith("without standard errors, and later sends are not discounted")


SEEN = Plant([[0.9]], [[1.0]], [[0.1]], [[1.0]], [[0.1]])
RARE = follow(SEEN, changes=RandomSteps(0.001, [[4.0]]))
REPEATED = follow(SEEN, changes=Timetable([0, 300, 700, 1000], [[1.0], [3.0], [2.0], [1.0]]))


@pytest.mark.parametrize(
    ("plant", "why"), [(RARE, "3 changes of set-points"), (REPEATED, "3 repetitions of the timetable")]
)
def test_a_few_rare_changes_give_no_error_however_many_steps_there_are(plant: Plant, why: str) -> None:
    """Three changes of set-points are three pieces; batch means of short runs have a much too small error."""
    cost = Cost([[1.0]], [[1.0]])
    loop = close(plant, design.excess(plant, cost, delta=0.1))
    steps = 3000 + settled(loop)
    costs = np.random.default_rng(2).exponential(size=steps)
    found, notes = cost_of_ticks(loop, costs, 0.0)
    assert found == Estimate(float(costs[settled(loop) :].mean()), 0.0, "exact")
    assert f"expected at least {32_000 + settled(loop)}: the cost is that of this run, with about {why}" in notes[0]
    assert measured(rate_of_ticks(loop, costs > 1))["standard_error"] is None
    long = np.random.default_rng(2).exponential(size=33_000)
    found, _ = cost_of_ticks(loop, long, 0.0)
    assert found is not None
    assert found.standard_error > 0
    usual = close(SEEN, design.excess(SEEN, cost, delta=0.1))
    found, _ = cost_of_ticks(usual, costs, 0.0)
    assert found is not None
    assert found.standard_error > 0


def test_the_error_of_a_slow_loop_is_its_spread_over_many_records() -> None:
    """A square that decays by 0.98 per step: 64 records of the least length with an error; shorter ones have none."""
    plant, cost = Plant([[0.99]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1e6]])
    loop = close(plant, design.excess(plant, cost, delta=0.1))
    assert loop.policy.theory.settling == pytest.approx(100, rel=0.01)
    rng, steps = np.random.default_rng(5), settled(loop) + least_steps(loop)
    x, costs = rng.standard_normal(64) / np.sqrt(1 - 0.99**2), np.empty((steps, 64))
    for k in range(steps):
        costs[k], x = x**2, 0.99 * x + rng.standard_normal(64)
    found = [cost_of_ticks(loop, record, 0.0)[0] for record in costs.T]
    spread = np.std([one.value for one in found if one is not None], ddof=1)
    claimed = np.sqrt(np.mean([one.standard_error**2 for one in found if one is not None]))
    assert 0.7 < claimed / spread < 1.3  # the spread of 64 records is known to 9 %
    short, notes = cost_of_ticks(loop, costs[:3000, 0], 0.0)
    assert short == Estimate(float(costs[settled(loop) : 3000, 0].mean()), 0.0, "exact")
    assert f"expected at least {steps}: the cost is that of this run, with about 25 time constants" in notes[0]


@pytest.mark.parametrize("relay", [True, False])
def test_the_text_of_a_run_shows_degraded_nodes_and_packets_that_were_sent_again(relay: bool) -> None:
    """If there are any; with a relay, and where the kernel drops packets."""
    text: dict[int, str] = {}
    for again in (0, 3):
        counters = {"sent data actuator": 5, "sent mark actuator": 2, "sent again data actuator": again}
        reports = {
            "controller": {"counters": counters, "arrived": {}, "degraded": {}},
            "actuator": {"counters": {}, "arrived": {"actuator": 4}, "degraded": {"late": 2} if again else {}},
        }
        link = {"counters": {"delivered": 4, "lost": 1}, "pending": 0}
        reports |= {"relay actuator": link} if relay else {}
        sent = {"actuator": _datagrams("actuator", reports)}
        run = NetworkRun(LOOP, "step", None, {}, sent, reports, np.ones(5), {}, {}, 0, True, 0.1, ())
        text[again] = " ".join(str(run).split())
    assert "sent delivered dropped marks sent again actuator 5 4 1 2 3 policy" in text[3]
    assert "degraded by events that no theory covers: actuator (2)" in text[3]
    assert "degraded actuator: 2 late" in text[3]
    assert "degraded" not in text[0]
    assert "again" not in text[0]
