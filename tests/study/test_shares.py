"""The shares of several links: budgets on traffic, on several rates and on the cost, and the cheapest within them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from counts import few

import taciturn
from taciturn.errors import ProblemError
from taciturn.lqg.discrete import discretise
from taciturn.lqg.periodic import MultirateControl, Timing
from taciturn.model.estimate import Estimate
from taciturn.model.link import LinkLaw
from taciturn.model.network import Network, NodeRole
from taciturn.problem import Problem
from taciturn.study.evaluation import Evaluation
from taciturn.study.record import fingerprint
from taciturn_studies import search, shares
from taciturn_studies.periodic_links import LinkClocks, clocks_of_links, clocks_or_reason
from taciturn_studies.tune import Tuned

PRICES = {"level": 4.0, "valve": 1.0}
EFFORT = 200_000


def two_links(**policy: Any) -> Problem:
    """Return an unstable plant with one wireless sensor, of which a packet is dearer, and one valve."""
    nodes = {"level": NodeRole(measures=True), "plc": NodeRole(controls=True), "valve": NodeRole(applies=True)}
    plant = taciturn.Plant([[1.05, 0.2], [0.0, 0.8]], [[0.3], [1.0]], np.diag([0.1, 0.2]), C=[[1.0, 0.0]], V=[[0.1]])
    network = Network(nodes=nodes, links={link: LinkLaw(price=price) for link, price in PRICES.items()})
    given = {"prediction": "model", "actuation": "model", "theta": 0.3} | policy
    return Problem(plant, taciturn.Cost(np.eye(2), [[0.1]]), network, "distributed", given)


def at_cost(problem: Problem, most: float, level: float) -> float:
    """Return the traffic at a cost, with a share of the level's link and 1 of the valve's, on a fine grid of θ."""
    points: list[tuple[float, float]] = []
    for theta in np.geomspace(0.05, 3.0, 15):
        changed = problem.changed({"theta": float(theta), "shares": {"level": level, "valve": 1.0}})
        found = taciturn.evaluate(changed, seed=1, steps=EFFORT)
        assert found.traffic is not None
        points.append((found.cost.value, math.log(found.traffic.value)))
    return math.exp(np.interp(most, *np.array(points).T))


@pytest.fixture(scope="module")
def cheapest() -> Tuned:
    """Return the policy of the least traffic at 10 % more cost."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shares, "EFFORT", EFFORT)
        return taciturn.tune(two_links(), cost="+10%", seed=1, standard_error=1e-3)


@pytest.mark.evidence
def test_the_traffic_at_a_cost_is_the_least_of_all_shares(cheapest: Tuned) -> None:
    """Against a grid of shares: within two percent of its least traffic, and better than equal shares."""
    found = cheapest.evaluation
    assert cheapest.confidence > 0.9
    assert found.cost.value == pytest.approx(1.1 * found.cost_all_time, rel=3e-3)
    grid = {level: at_cost(two_links(), found.cost.value, level) for level in (0.3, 1.0, 2.0, 4.0, 8.0)}
    assert found.traffic.value < 1.02 * min(grid.values()) < 0.98 * grid[1.0]
    assert cheapest.shares["level"] > cheapest.shares["valve"] > 0
    assert sum(cheapest.shares.values()) == pytest.approx(2.0, abs=0.01)


@pytest.mark.evidence
def test_the_cost_at_a_traffic_is_the_least_of_all_shares(cheapest: Tuned, monkeypatch: pytest.MonkeyPatch) -> None:
    """The budget of the traffic that was found gives back the cost, within two errors and a percent of the excess."""
    monkeypatch.setattr(shares, "EFFORT", EFFORT)
    found = taciturn.tune(two_links(), traffic=cheapest.evaluation.traffic.value, seed=1, standard_error=1e-3)
    extra = cheapest.evaluation.cost.value - found.evaluation.cost_all_time
    assert found.evaluation.cost.value - found.evaluation.cost_all_time == pytest.approx(extra, rel=0.03)
    assert found.confidence > 0.9
    document = found.document()
    assert document["budget"]["of"] == "traffic"
    assert set(document["shares"]) == set(PRICES)
    assert "shares" in str(found)


@pytest.mark.evidence
def test_links_without_a_given_rate_send_every_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rates of links by name are met, each for itself."""
    monkeypatch.setattr(shares, "EFFORT", EFFORT)
    found = taciturn.tune(two_links(), rate={"level": "30%"}, seed=1, standard_error=2e-3)
    rates = found.evaluation.rates
    assert rates["level"].value == pytest.approx(0.3, abs=4e-3)
    assert rates["valve"].value == pytest.approx(1.0, abs=1e-5)
    assert found.shares["valve"] == 0.0
    both = taciturn.tune(two_links(), rate={"level": 0.3, "valve": 0.4}, seed=1, standard_error=2e-3)
    assert [both.evaluation.rates[link].value for link in PRICES] == pytest.approx([0.3, 0.4], abs=8e-3)
    assert both.document()["budget"]["at_most"] == {"level": 0.3, "valve": 0.4}


@pytest.mark.evidence
def test_given_shares_are_kept() -> None:
    """A budget on the traffic then changes θ alone."""
    given = {"level": 2.0, "valve": 1.0}
    found = taciturn.tune(two_links(shares=given), traffic=2.0, standard_error=2e-3)
    assert found.shares is None
    assert found.problem.parameters["shares"] == given
    assert found.evaluation.traffic.value == pytest.approx(2.0, abs=0.02)


@pytest.mark.parametrize(
    ("budget", "sentence"),
    [
        ({}, "none of rate, cost, traffic and violation is given"),
        ({"rate": 0.3, "traffic": 1.0}, "rate and traffic are given"),
        ({"rate": {"level": 0.3}, "link": "level"}, "expected a rate for each link, without the option 'link'"),
        (
            {"rate": {"pump": 0.3}},
            "link is 'pump', but the policy distributed makes no send decisions on this link; expected the link level",
        ),
        ({"traffic": "-5%"}, "expected a number, or a percentage such as 50% of the traffic"),
        (
            {"traffic": 50.0},
            "the traffic budget of 50 per step is above the traffic of sending every sample; expected at most 5",
        ),
        ({"rate": {"level": 1.5}}, "the rate 1.5 of the link level is above the rate of sending every sample"),
        ({"cost": 0.01}, "is below the cost of sending every sample"),
        ({"rate": 0.3}, "makes send decisions on 2 links, but a rate is given without a link"),
    ],
)
def test_budgets_that_cannot_be_met_are_refused(budget: Mapping[str, Any], sentence: str) -> None:
    """In a sentence that names what is expected."""
    with pytest.raises(ProblemError, match=sentence):
        taciturn.tune(two_links(), **budget)


def test_rates_of_several_links_need_shares() -> None:
    """A kind with one parameter, and a problem that states its shares, are refused."""
    with pytest.raises(ProblemError, match="lqg has one parameter for all links"):
        taciturn.tune(taciturn.load("two-mass-lqg"), rate={"sensor": 0.3, "actuator": 0.3})
    with pytest.raises(ProblemError, match="shares is given too"):
        taciturn.tune(two_links(shares={"level": 2.0}), rate={"level": 0.3, "valve": 0.3})


@pytest.mark.evidence
def test_policies_are_compared_at_equal_traffic(monkeypatch: pytest.MonkeyPatch) -> None:
    """A model at both ends costs less than to hold, and best shares less than equal ones."""
    monkeypatch.setattr(shares, "EFFORT", EFFORT)
    hold = {"prediction": "hold", "actuation": "hold"}
    rivals = {"model": two_links(), "hold": two_links(**hold), "equal": two_links(shares={"level": 1.0})}
    found = taciturn.compare(rivals, traffic=2.0, standard_error=3e-3)
    assert found.of == "traffic"
    assert found.ranking[0].name == "model"
    assert found.document()["ranking"][0]["link"] is None
    assert "traffic" in str(found)
    assert isinstance(found.clocks, LinkClocks)
    assert found.ranking[0].cost.value < found.clocks.cost
    assert found.document()["clocks"]["kind"] == "model"
    with pytest.raises(ProblemError, match="expected either a rate, with or without a link, or a traffic"):
        taciturn.compare(rivals, 0.3, traffic=2.0)


def test_a_traffic_that_no_dead_band_reaches_is_refused_with_the_range(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in a comparison, which has the same search as tune: here both rates fall from 0.9 to 0.2."""
    old = dict.fromkeys(("theta", "prediction", "actuation"))
    bands = two_links().changed({**old, "kind": "send-on-delta", "delta": 10.0})
    found = taciturn.evaluate(bands, steps=2048)

    def look_at(problem: Problem, *given: Any) -> Evaluation:
        rate = Estimate(0.2 + 0.7 / (1 + problem.parameters["delta"]), 0.0, "simulation")  # type: ignore[operator]
        return replace(found, rates=dict.fromkeys(PRICES, rate), reached=True)

    monkeypatch.setattr(search, "look_at", look_at)
    rivals = {"bands": bands, "given": bands.changed({"shares": {"level": 2.0}})}
    words = r"bands: no delta gives send-on-delta the traffic 0.5: the traffic ranges from 1 \(delta = "
    with pytest.raises(ProblemError, match=words):
        taciturn.compare(rivals, traffic=0.5, standard_error=1e-2)
    words = r"no delta gives send-on-delta the rate of level 0.1: the rate of level ranges from 0.2 "
    with pytest.raises(ProblemError, match=words):
        taciturn.tune(bands, rate={"level": 0.1, "valve": 0.5})
    assert taciturn.tune(bands, traffic=2.0).evaluation.traffic.value == pytest.approx(2.0, rel=1e-8)


@pytest.mark.parametrize("traffic", few([1.0, 0.7, 1.4], 1))
def test_the_clocks_of_the_links_are_the_best_of_all_periods(traffic: float) -> None:
    """Of all periods up to 8 of both links in phase, none with at most this traffic costs less."""
    problem = two_links()
    found = clocks_of_links(problem, traffic)
    control = MultirateControl(discretise(problem.plant, problem.cost, None), problem.network, plans=True)
    costs = [
        control.cost({"level": Timing(one), "valve": Timing(other)})
        for one, other in itertools.product(range(1, 9), repeat=2)
        if 4 / one + 1 / other <= traffic
    ]
    assert found.cost <= min(costs) * (1 + 1e-9)
    assert sum(found.shares) == pytest.approx(1.0)
    lossy = Network(nodes=problem.network.nodes, links={"level": LinkLaw(loss=0.1, acknowledged=True)})
    other = Problem(problem.plant, problem.cost, lossy, problem.kind, problem.parameters)
    assert "deliver every packet" in str(clocks_or_reason([other], traffic))


def test_prices_and_energies_belong_to_the_digest_of_a_problem() -> None:
    """A stored result of other prices is not taken for that of a problem."""
    masses = taciturn.load("two-mass")
    changes: list[dict[str, object]] = [{}, {"links.actuator.price": 2.0}, {"network.actuator_energy": 1e-3}]
    assert len({fingerprint(masses.changed(changed)) for changed in changes}) == 3
