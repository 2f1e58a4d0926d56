"""A budget is met: exactly where it can be had, within its standard error elsewhere, refused where it cannot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from counts import few

import taciturn
from taciturn import Cost, Network, Plant, Problem, ProblemError, tune
from taciturn.design.catalogue import CATALOGUE
from taciturn.errors import UnstableError
from taciturn.model.estimate import Estimate
from taciturn.problem.parameters import check_parameters
from taciturn.study.evaluation import Evaluation
from taciturn_studies import search
from taciturn_studies.goal import CostGoal, RateGoal, budget_of
from taciturn_studies.search import Search
from taciturn_studies.tune import Parameter, Tuned

MASSES, JUMPS = taciturn.load("two-mass-lqg"), taciturn.load("double-integrator")
INTEGRATOR = taciturn.load("wiener-double-integrator")
SETTINGS: dict[str, dict[str, Any]] = {
    "lqg": {"theta": 3.0},
    "absolute": {"threshold": 40.0},
    "relative": {"sigma": 0.1},
    "mixed": {"sigma": 0.2, "threshold": 1e-4},
    "dynamic": {"sigma": 0.1, "rho": 0.8, "gain": 2.0},
    "stochastic": {},
    "self-triggered": {"beta": 1.0, "max_interval": 10},
    "downsampled": {"fast": 1, "slow": 2, "threshold": 1.0},
    "send-on-delta": {"delta": 1.0},
    "variance": {"threshold": 1.0},
}


def with_policy(kind: str, problem: Problem = MASSES, **settings: Any) -> Problem:
    """Return the problem with another policy, without the parameters of the old one."""
    old = {name: None for name in problem.parameters if name not in settings and name != "period"}
    return problem.changed({**old, "kind": kind, **settings})


@pytest.mark.parametrize("kind", few(SETTINGS, quick=1))
def test_a_rate_is_met_wherever_the_search_starts(kind: str) -> None:
    """At least two standard errors within the rate, exactly without simulation; its error follows from the rate's."""
    problem = with_policy(kind, **SETTINGS[kind])
    found = tune(problem, rate=0.4, standard_error=3e-3)
    rate = next(iter(found.evaluation.rates.values()))
    assert 2 * rate.standard_error - 1e-8 <= 0.4 - rate.value <= 8 * rate.standard_error + 1e-8
    assert found.confidence == (1 if rate.standard_error == 0 else pytest.approx(0.99, abs=0.013))
    assert found.evaluation.reached
    assert found.beyond is None
    assert found.parameter.name == CATALOGUE[kind].tuning[0].name
    again = taciturn.evaluate(found.problem, standard_error=3e-3, seed=7)
    other = next(iter(again.rates.values()))
    assert abs(other.value - 0.4) <= 5 * np.hypot(rate.standard_error, other.standard_error) + 1e-8


@pytest.mark.evidence
def test_the_standard_error_of_the_parameter_is_its_spread() -> None:
    """Sixteen seeds: their parameters spread as they say, within the range of a chi-square at 1e-4."""
    found = [tune(MASSES, rate=0.3, standard_error=1e-3, seed=seed).parameter for seed in range(16)]
    claimed = np.sqrt(np.mean([parameter.standard_error**2 for parameter in found]))
    spread = np.std([parameter.value for parameter in found], ddof=1)
    assert 0.4 < spread / claimed < 1.8


@pytest.mark.evidence
def test_a_controller_may_cost_less_than_with_every_sample() -> None:
    """So a budget may be below that cost."""
    found = tune(taciturn.load("pid-tank"), cost="-5%", standard_error=3e-5)
    assert found.evaluation.cost.value < 0.965 * found.evaluation.cost_all_time


def test_a_cost_is_met() -> None:
    """And the policy that meets it has the rate that leads back to it."""
    by_cost = tune(MASSES, cost=0.8, standard_error=2e-4)
    cost = by_cost.evaluation.cost
    assert 2 * cost.standard_error <= 0.8 - cost.value <= 8 * cost.standard_error
    assert 0.977 < by_cost.confidence < 1
    back = tune(MASSES, rate=by_cost.evaluation.rates["actuator"].value, standard_error=2e-4).parameter
    assert by_cost.parameter.standard_error is not None
    assert back.standard_error is not None
    assert abs(back.value - by_cost.parameter.value) <= 5 * np.hypot(
        back.standard_error, by_cost.parameter.standard_error
    )


def test_percent_are_of_sending_always() -> None:
    """The same answers as of the numbers, whatever a rate counts per; where the parameter is not yet given, too."""
    integrator = with_policy("consistent", taciturn.load("wiener-double-integrator"))
    for problem, percent, number in (
        (with_policy("periodic", every=2), {"rate": "25%"}, {"rate": 0.25}),
        (with_policy("periodic", every=2), {"cost": "+12.5 %"}, {"cost": 1.125 * MASSES.design().cost_all_time}),
    ):
        found, same = tune(problem, **percent), tune(problem, **number)
        assert found.parameter.value == pytest.approx(same.parameter.value, rel=1e-9)
    assert budget_of(integrator, CATALOGUE["consistent"].tuning[0], "rate", "30%") == pytest.approx(
        3.0
    )  # ten looks a second
    excess = with_policy("excess", integrator, delta=None)
    assert budget_of(excess, CATALOGUE["excess"].tuning[0], "rate", "50%") == pytest.approx(5.0)
    mission = taciturn.load("rover")
    assert budget_of(mission, CATALOGUE["remote-lqg"].tuning[0], "rate", "50%") == 0.5


@pytest.mark.parametrize(
    ("problem", "budget", "words"),
    [
        (MASSES, {"rate": "+5%"}, "rate is '+5%'; expected a number, or a percentage such as 50%"),
        (MASSES, {"cost": "5%"}, "cost is '5%'; expected a number, or a percentage such as +5%"),
        (MASSES, {"cost": "-5%"}, "the cost budget of 0.696804 per step is below the cost of sending every sample"),
        (MASSES, {"cost": "-100%"}, "cost is -1; expected -1 < cost"),
        (MASSES, {"rate": "0%"}, "rate is 0; expected 0 < rate"),
        (MASSES, {"rate": "0.3"}, "rate is '0.3'; expected a number"),
        (
            with_policy("periodic", taciturn.load("two-mass-continuous"), theta=None),
            {"rate": "50%"},
            "of sending every sample depends on the period, which is tuned; expected a number",
        ),
        (
            with_policy("integral", JUMPS, period=None, slope=5.0, alpha=0.9),
            {"rate": "5%"},
            "integral has no sampling steps",
        ),
    ],
)
def test_percent_of_what_is_not_known_are_refused(problem: Problem, budget: dict[str, Any], words: str) -> None:
    """With what is expected instead."""
    with pytest.raises(ProblemError) as caught:
        tune(problem, **budget)
    assert words in str(caught.value)
    assert "e-2" not in str(caught.value)  # the ends are values from which on the rate hardly changes


EXACT: dict[str, dict[str, Any]] = {"consistent": {}, "stochastic": {"actuation": "model"}, "periodic": {}}


@pytest.mark.parametrize("kind", few(EXACT, quick=1, start=1))
def test_exact_rates_are_met_exactly(kind: str) -> None:
    """A consistent policy by quadrature, a stochastic one by its closed form, periodic control by its period."""
    found = tune(with_policy(kind, INTEGRATOR, **EXACT[kind]), rate=2.0)
    assert found.evaluation.steps == 0
    assert next(iter(found.evaluation.rates.values())).value == pytest.approx(2.0, rel=2e-8)


@pytest.mark.evidence
def test_whole_numbers_keep_the_budget_and_name_the_other_side() -> None:
    """Every third step sends at most 0.4 of the time; every second one more."""
    problem = with_policy("periodic", every=7, actuation="model")
    by_rate = tune(problem, rate=0.4)
    assert by_rate.parameter.value == 3
    assert by_rate.beyond is not None
    assert by_rate.beyond.parameter.value == 2
    exactly = tune(problem, rate=0.25)
    assert exactly.parameter.value == 4
    assert exactly.beyond is None
    last = tune(with_policy("rollout", horizon=1, every=3), rate=0.5, standard_error=1e-2)
    assert last.parameter.value == 2  # at the end of its range
    by_cost = tune(problem, cost=0.76)
    assert by_cost.parameter.value == 3
    assert by_cost.evaluation.cost.value <= 0.76
    assert by_cost.beyond is not None
    assert by_cost.beyond.evaluation.cost.value > 0.76
    pattern = tune(with_policy("periodic-schedule", length=8, sends=6), rate=0.3)
    assert pattern.parameter.value == 2
    rolled = tune(with_policy("rollout", horizon=1, every=2), rate=0.3, standard_error=1e-2)
    assert rolled.parameter.value == 4
    assert rolled.evaluation.rates["actuator"].value == 0.25
    assert rolled.evaluation.rates["actuator"].standard_error == 0


def test_intervals_that_lose_a_mode_are_passed_over() -> None:
    """Half a second and a second resonate with the spring: between 4 and 6 there is nothing."""
    found = tune(with_policy("periodic", every=2), rate=0.17)
    assert found.parameter.value == (15, 3, 3, 3)  # 7 % cheaper than every sixth step, which does not resonate either
    six = taciturn.evaluate(with_policy("periodic", every=6))
    assert found.evaluation.cost.value < 0.95 * six.cost.value
    assert found.evaluation.rates["actuator"].value == pytest.approx(six.rates["actuator"].value)
    assert found.beyond is not None
    assert 5 not in found.beyond.parameter.value  # type: ignore[operator]


def test_a_held_input_is_tuned_to_a_cycle_of_intervals() -> None:
    """Four and three steps in turn send 2/7 of the time and cost less than the chord between every third and fourth."""
    problem = with_policy("periodic", every=2)
    by_rate = tune(problem, rate=0.3)
    assert by_rate.parameter.value == (4, 3)
    assert by_rate.evaluation.cost.value < tune(problem, rate=0.25).evaluation.cost.value
    by_cost = tune(problem, cost=0.9)
    assert by_cost.parameter.value == (4, 3)
    assert by_cost.beyond is not None
    assert by_cost.evaluation.cost.value <= 0.9 < by_cost.beyond.evaluation.cost.value
    with pytest.raises(ProblemError, match="is below the cost of sending every sample"):
        tune(problem, cost=0.7)


@pytest.mark.evidence
def test_jumps_of_a_schedule_have_two_sides() -> None:
    """The variance of a random walk grows in steps: rates are 1/k."""
    walk = Problem(Plant([[1.0]], [[1.0]], [[1.0]]), Cost([[1.0]], [[1.0]]), Network(), "variance", {"threshold": 1.0})
    found = tune(walk, rate=0.4)
    assert found.beyond is not None
    assert found.evaluation.rates["sensor"].value == pytest.approx(1 / 3)
    assert found.beyond.evaluation.rates["sensor"].value == pytest.approx(1 / 2)
    assert found.parameter.value == pytest.approx(2, abs=1e-6)


@pytest.mark.evidence
def test_links_have_knobs_of_their_own() -> None:
    """The price of a query turns the sensor's rate, θ the actuator's; one of them must be named."""
    problem = taciturn.load("remote-scalar")
    assert tune(problem, rate=0.5, link="sensor", standard_error=1e-2).parameter.name == "zeta"
    assert tune(problem, rate=0.8, link="actuator", standard_error=1e-2).parameter.name == "theta"
    with pytest.raises(ProblemError, match="two links"):
        tune(problem, rate=0.5)
    alone = problem.changed({"controller": "sensor", "zeta": None})
    assert tune(alone, rate=0.8, standard_error=1e-2).parameter.name == "theta"


@pytest.mark.parametrize(
    ("problem", "budget", "words"),
    [
        pytest.param(MASSES, {"rate": 0.05}, "the rate ranges from 0.20", marks=pytest.mark.evidence),
        pytest.param(MASSES, {"cost": 10.0}, "expected a cost within this range", marks=pytest.mark.evidence),
        pytest.param(
            MASSES.changed({"trigger": "separate"}),
            {"rate": 0.3},
            "the rate ranges from 0.58",
            marks=pytest.mark.evidence,
        ),
        (MASSES, {}, "expected exactly one budget"),
        (MASSES, {"rate": 0.3, "cost": 1.0}, "expected exactly one budget"),
        (MASSES, {"rate": -0.3}, "rate is -0.3"),
        (MASSES, {"rate": 0.3, "link": "sensor"}, "link is 'sensor', but the policy lqg makes no send decisions"),
        (with_policy("all-time"), {"rate": 0.3}, "all-time has no parameter"),
        (
            taciturn.load("remote-scalar"),
            {"rate": {"zz": 0.3}},
            "but the policy kind remote-lqg has no parameter",
        ),
    ],
)
def test_what_cannot_be_met_is_one_sentence(problem: Problem, budget: dict[str, Any], words: str) -> None:
    """With what can be reached."""
    with pytest.raises(ProblemError) as caught:
        tune(problem, **budget)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("problem", "budget", "words"),
    [
        (
            MASSES,
            {"rate": 1.5},
            "the rate budget of 1.5 per step is above the rate of sending every sample; expected at most 1",
        ),
        (MASSES, {"rate": 1e308}, "expected at most 1"),
        (
            MASSES,
            {"cost": 0.5},
            "the cost budget of 0.5 per step is below the cost of sending every sample; expected at least 0.733",
        ),
        (INTEGRATOR, {"rate": 100.0}, "the rate budget of 100 per second is above the rate of sending every sample"),
        (INTEGRATOR, {"cost": 1.0}, "the cost budget of 1 per second is below the cost of sending every sample"),
        (taciturn.load("rover"), {"cost": 50.0, "link": "sensor"}, "the cost budget of 50 in total is below"),
    ],
)
def test_what_no_tick_is_left_for_is_refused_at_the_first_look(
    problem: Problem, budget: dict[str, Any], words: str
) -> None:
    """More sends than steps, or less cost than with all of them."""
    looks: list[float] = []
    with pytest.raises(ProblemError) as caught:
        tune(problem, **budget, progress=looks.append)
    assert words in str(caught.value)
    assert max(looks) == pytest.approx(1 - search.LEFT), "the end of the first trial"


def test_a_period_may_be_shorter_than_the_one_to_start_from() -> None:
    """Its steps are what is sought: neither their rate nor their cost is a limit."""
    clock = with_policy("periodic", INTEGRATOR, period=0.5, actuation="model")
    found = tune(clock, rate=8.0)
    assert found.parameter.value == pytest.approx(1 / 8)
    assert tune(clock, cost=found.evaluation.cost.value).parameter.value == pytest.approx(1 / 8)


def test_every_kind_has_a_knob_that_it_knows() -> None:
    """The tuning parameters of a kind are among its own parameters."""
    for kind in CATALOGUE.values():
        for tuning in kind.tuning:
            with pytest.raises(ProblemError) as caught:
                check_parameters(kind, {tuning.name: "word"})
            assert "not a parameter" not in str(caught.value)


def test_the_document_is_that_of_evaluate_with_the_parameter() -> None:
    """Names of the contract."""
    found = tune(with_policy("periodic", every=2, actuation="model"), rate=0.4).document()
    assert found["parameter"] == {"name": "every", "value": 3, "standard_error": 0.0}
    assert found["beyond"]["value"] == 2
    assert {"policy", "cost", "rates", "cost_all_time", "reached"} <= set(found)


def test_a_confidence_is_claimed_only_where_it_holds() -> None:
    """No rate exceeds that of every sample; an error that cannot be trusted gives no confidence."""
    found = taciturn.evaluate(taciturn.load("two-mass-lqg"), steps=20_000)
    above = RateGoal(1.0)
    assert above.confidence(found) == 1.0
    near = RateGoal(found.rates["actuator"].value)
    assert near.confidence(found) == pytest.approx(0.5)
    assert near.confidence(replace(found, trusted=False)) is None


@pytest.mark.parametrize(("excess", "confidence", "words"), [
    (0.0, 1.0, "met exactly"), (5e-11, 1.0, "met up to a rounding error of 1e-09 of it"), (2e-9, 0.0, "met with 0 %"),
])  # fmt: skip
def test_a_budget_is_met_up_to_rounding(excess: float, confidence: float, words: str) -> None:
    """Also if the standard error is smaller than the rounding error, as next to sending every sample."""
    found = taciturn.evaluate(MASSES, steps=20_000)
    found = replace(found, cost=Estimate(1.0 + excess, 1e-15, "simulation"), trusted=True)
    tuned = Tuned(CostGoal(1.0), Parameter("theta", 1.0, 0.0), MASSES, found, None, None)
    assert tuned.confidence == confidence
    assert words in " ".join(str(tuned).split())
    blurred = replace(tuned, evaluation=replace(found, cost=Estimate(0.9, 0.01, "simulation")))
    assert "met with 99.9 % confidence" in " ".join(str(blurred).split())


def test_a_search_reports_progress_within_a_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    """A long trial moves the bar before it ends."""
    told: list[float] = []

    def look_at(*given: Any) -> None:
        given[-1](0.5)
        raise ProblemError("enough")

    monkeypatch.setattr(search, "look_at", look_at)
    looking = Search(MASSES, CATALOGUE["lqg"].tuning[0], RateGoal(0.3), 0, told.append)
    assert [looking.look(value) for value in (1.0, 2.0)] == [None, None]
    first, second = 1 - search.LEFT, 1 - search.LEFT**2
    assert told == pytest.approx([first / 2, first, (first + second) / 2, second])


def faked(
    monkeypatch: pytest.MonkeyPatch,
    rate_of: Callable[[float, bool], tuple[float, float]],
    cost_of: Callable[[float], float] = lambda theta: 1 + theta,
) -> None:
    """Replace the evaluations by a cost and a rate, with its error, that depend on θ and on the length of a trial."""
    found = taciturn.evaluate(MASSES, steps=10_000)

    def look_at(problem: Problem, seed: int, steps: int | None, *given: Any) -> Evaluation:
        rate, error = rate_of(problem.parameters["theta"], steps is None)  # type: ignore[arg-type]
        cost = Estimate(cost_of(problem.parameters["theta"]), 1e-4, "simulation")  # type: ignore[arg-type]
        return replace(found, cost=cost, rates={"actuator": Estimate(rate, error, "simulation")})

    for module in (search, search):
        monkeypatch.setattr(module, "look_at", look_at)


def test_a_jump_that_only_long_trials_show_has_two_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short trials have a rate of 0.3 somewhere, long ones 0.35 or 0.25: the text and the document name both."""
    faked(monkeypatch, lambda theta, long: (0.35 - 0.1 * (theta > 1.01), 1e-4) if long else (0.3 / theta, 2e-3))
    found = tune(MASSES, rate=0.3)
    assert found.beyond is not None
    sides = [one.evaluation.rates["actuator"].value for one in (found, found.beyond)]
    assert sides == pytest.approx([0.25, 0.35])
    assert found.beyond.parameter.value <= 1.01 < found.parameter.value < 1.0102
    assert "on the other side: theta = 1.0" in " ".join(str(found).split())
    assert found.document()["beyond"]["rates"] == {"actuator": 0.35}
    assert found.document()["beyond"]["traffic"] == 0.35


def test_a_steep_rate_is_met_within_its_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Long trials change forty times as fast as short ones, and elsewhere: the answer is still within the budget."""
    faked(monkeypatch, lambda theta, long: (0.3 * (theta / 1.03) ** -40, 1e-4) if long else (0.3 / theta, 2e-3))
    found = tune(MASSES, rate=0.3)
    assert found.beyond is None
    assert 2e-4 <= 0.3 - found.evaluation.rates["actuator"].value <= 8e-4


def test_values_that_fail_between_two_others_are_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """A loop that does not settle for θ between 0.3 and 20: rates on either side of this gap are found."""

    def rate_of(theta: float, long: bool) -> tuple[float, float]:
        if 0.3 < theta < 20:
            raise UnstableError("the loop does not settle")
        return 1 / (1 + theta), 0.0

    faked(monkeypatch, rate_of)
    for rate in (0.9, 0.8, 0.04):
        found = tune(MASSES, rate=rate)
        assert found.evaluation.rates["actuator"].value == pytest.approx(rate, rel=1e-6)
    with pytest.raises(ProblemError, match=r"such as 0\.04.* or 0\.7.*, the nearest found"):
        tune(MASSES, rate=0.4)


@pytest.mark.parametrize("start", [1e-3, 1.0, 4.0, 6.0, 9.0, 30.0, 1e3])
def test_a_cost_that_is_not_monotone_is_met_from_every_start(monkeypatch: pytest.MonkeyPatch, start: float) -> None:
    """It rises with θ, does not settle near its highest value, and falls: silence costs less than few sends."""

    def cost_of(theta: float) -> float:
        if 5 < theta < 8:
            raise UnstableError("the loop does not settle")
        return 1 + 0.2 * theta if theta < 5 else 0.9 + 1.1 * np.exp(8 - theta)

    faked(monkeypatch, lambda theta, _: (1 / (1 + theta), 1e-4), cost_of)
    found = tune(MASSES.changed({"theta": start}), cost=1.5)
    assert found.parameter.value == pytest.approx(2.5, abs=0.01)
    with pytest.raises(ProblemError, match=r"the cost ranges from 0\.9.* \(theta = "):
        tune(MASSES.changed({"theta": start}), cost=2.5)
