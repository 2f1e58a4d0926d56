"""The numbers of printed results: percentages, errors of rates, verdicts, and notes on certified rates."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import taciturn
from taciturn import Estimate
from taciturn._text import ordinal, percent, wrapped_text
from taciturn.model.estimate import rounded
from taciturn.model.schedule import Schedule
from taciturn.model.theory import LowerBound
from taciturn.study.evaluate import contradicted
from taciturn.study.evaluation import (
    Evaluation,
    percent_above,
    queries_text,
)
from taciturn.study.periodic import Timed, fair_clock
from taciturn_events.policy import EventPolicy

SCALAR = taciturn.Plant(A=[[1.2]], B=[[1.0]], W=[[0.01]])
COST = taciturn.Cost(Q=[[1.0]], R=[[1.0]])
PROBLEM = taciturn.Problem(SCALAR, COST, taciturn.Network(), "excess", {"theta": 0.5, "actuation": "model"})


@cache
def simulated() -> Evaluation:
    """Return a short simulation, whose rate has a standard error."""
    return taciturn.evaluate(PROBLEM, steps=20_000)


def test_queries_before_the_repeating_part_are_counted() -> None:
    """A schedule that ends with a query at every step, after one without, has not one at every step."""
    once = {"value": np.zeros(3), "covariance": np.zeros((3, 1, 1)), "price": 0.0}
    assert queries_text(Schedule(np.array([True, True, True]), **once, start=2)) == "at every step"
    assert queries_text(Schedule(np.array([False, False, False]), **once, start=2)) == "never"
    told = queries_text(Schedule(np.array([True, False, True]), **once, start=2))
    assert told == "1 of the first 2 steps (0), then every step"


def verdict(found: Evaluation) -> str:
    """Return the printed verdict in one line."""
    return " ".join(str(found).partition("\nverdict")[2].partition("\nnote")[0].split())


def row(found: Evaluation, name: str) -> Estimate:
    """Return the cost in a row of the table."""
    (cost,) = (record["cost"] for record in found.records() if record["name"] == name)
    assert isinstance(cost, Estimate)
    return cost


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (percent(2.0), "200 %"),
        (percent(1.952, 0, up=1), "196 %"),
        (percent(0.07, 1, up=1), "7.0 %"),
        (percent(-1e-9, 2, signed=True), "0.00 %"),
        (percent(-1e-9, 0, up=1), "0 %"),
        (percent(1e-9, 2, up=1), "0.01 %"),
        (percent(-0.1234, 1, up=-1), "-12.4 %"),
        (percent(0.010036, error=7.8e-6), "1.00360 ± 0.00078 %"),
        (percent(-1e-9, error=1e-5), "0.0000 ± 0.0010 %"),
        (percent(0.999), "99.9 %"),
        (percent(0.55), "55 %"),
        (percent(123.4567, 0, signed=True), "+12346 %"),
        (percent(1830042475450.0, 2, signed=True), "+1.83004e+14 %"),
        (percent(1830042475450.0, 2, up=1), "1.83005e+14 %"),
        (percent(0.116844794277, 2, error=1e-15), "11.68 %"),
        (rounded(14_102_855.0, 6, 1), "1.41029e+07"),
        (rounded(14_102.4, 5, 1), "14103"),
        (rounded(14_102.4, 6, 1), "14103"),
        (rounded(14_102.4, 6, -1), "14102"),
        (percent_above(Estimate(1.0772, 0.0022, "simulation"), 1.0), "+7.7 %"),
        (percent(float("inf"), 2), "inf %"),
        (percent_above(Estimate(0.99999999, 0.0, "exact"), 1.0), "0.00 %"),
        (str(Estimate(-1e-9, 1e-4, "simulation")), "0.00000 ± 0.00010"),
    ],
)
def test_a_percentage_has_ordinary_digits_and_no_negative_zero(text: str, expected: str) -> None:
    """Bounds are rounded outward, and rounding errors of binary numbers do not count."""
    assert text == expected


@pytest.mark.parametrize("before", range(60, 80))
def test_a_number_stays_on_one_line_with_its_error_and_its_percent_sign(before: int) -> None:
    """Wherever the line ends; the text is otherwise unchanged."""
    text = f"{'x' * before} 1.0078 ± 0.0039 % above"
    lines = wrapped_text(text).splitlines()
    assert any("1.0078 ± 0.0039 %" in line for line in lines)
    assert " ".join(lines) == text


def test_the_error_of_the_rate_moves_the_bound_and_periodic_control() -> None:
    """By the slope of each at the measured rate; the JSON document and the data frame contain the errors."""
    found = simulated()
    (rate,) = found.rates.values()
    policy = PROBLEM.designed()
    clock = fair_clock(PROBLEM, policy)
    low, high = (clock.at(rate.value + sign * 1e-6) for sign in (-1, 1))
    assert low is not None
    assert high is not None
    periodic = row(found, "periodic, same rate")
    assert rate.standard_error > 0
    assert periodic.standard_error == pytest.approx((low.cost - high.cost) / 2e-6 * rate.standard_error, rel=1e-4)
    assert found.cost_bound_at_rate is not None
    slope = (policy.cost_all_time - found.cost_bound_at_rate) / (1 - rate.value)
    bound = row(found, "guarantee, this rate")
    assert bound.standard_error == pytest.approx(abs(slope) * rate.standard_error, rel=1e-9)
    assert bound.value >= found.cost_bound_at_rate
    assert (periodic, bound) == (found.periodic, found.guarantee_at_rate)
    assert str(periodic) in str(found)
    document = found.document()
    assert document["clock"]["standard_error"] == periodic.standard_error
    assert document["cost_bound_at_rate_standard_error"] == bound.standard_error
    frame: Any = found.to_pandas()
    errors = dict(zip(frame["name"], frame["cost_standard_error"], strict=True))
    assert errors["periodic, same rate"] == periodic.standard_error
    assert errors["guarantee, this rate"] == bound.standard_error


def test_periodic_control_that_fewer_packets_make_no_worse_has_the_rate_at_which_it_sends() -> None:
    """A controller discretised for every second step may cost less than with every sample; one packet per step is not
    what this costs.
    """
    plant = taciturn.Plant([[0.9]], [[0.1]], [[0.01]], [[1.0]], [[0.05]], 1.0)
    pid = taciturn.PID(0.5, 0.02, 1.0, 1.5, taciturn.Disturbance(deviation=0.0))
    cost, ideal = taciturn.Cost([[1.0]], [[0.1]]), taciturn.Network()
    problem = taciturn.Problem(plant, cost, ideal, "event-pid", {"delta": 0.0}, controller=pid)
    found = taciturn.evaluate(problem, steps=4096)
    assert found.clock is not None
    assert [point.cycle for point in found.clock.points] == [(2,)]
    rates = {str(record["name"]): record["rate_sensor"] for record in found.records()}
    assert rates["periodic, same rate"] == Estimate(0.5, 0.0, "exact")
    assert rates["this policy"] == found.rates["sensor"]
    assert "every [2] steps, the best found; more packets do not lower its cost" in " ".join(str(found).split())
    usual = {str(record["name"]): record["rate_actuator"] for record in simulated().records()}
    assert usual["periodic, same rate"] == usual["this policy"]
    assert "more packets" not in str(simulated())


def test_numbers_of_steps_are_ordinals() -> None:
    """In messages and guarantees, by one function."""
    assert [ordinal(number) for number in (1, 3, 10, 11, 13, 21, 22, 23, 111, 122)] == [
        "1st", "3rd", "10th", "11th", "13th", "21st", "22nd", "23rd", "111th", "122nd",
    ]  # fmt: skip
    slow = taciturn.Plant([[0.9]], [[1.0]], [[0.01]])
    kept = {"controller": np.array([[0.5]]), "delta": 0.1}
    statement = taciturn.design.excess(slow, COST, every=3, **kept).guarantee
    assert statement is not None
    assert "every 3rd step" in statement.statement
    with pytest.raises(taciturn.UnstableError, match="the loop that sends at every 22nd step is not stable"):
        taciturn.design.excess(SCALAR, COST, every=22, **kept)


def test_the_cost_of_a_real_period_has_the_error_of_its_curve() -> None:
    """The cost 1/r has the slope −1/r²; without a stable loop on one side, the other side is used."""
    found = Timed("hold", lambda period: period).at(2.0, 0.001)
    assert found is not None
    assert found.standard_error == pytest.approx(0.001 / 4, rel=1e-5)
    one_sided = Timed("hold", lambda period: period if period <= 0.5 else None).at(2.0, 0.001)
    assert one_sided is not None
    assert one_sided.standard_error == pytest.approx(0.001 / 4, rel=1e-3)


def test_the_bound_of_a_policy_without_steps_has_the_slope_of_its_interval() -> None:
    """A difference quotient of the bound."""
    plant = taciturn.ContinuousPlant([[0.0]], [[1.0]], jumps=taciturn.Jumps(2.0, np.array([[0.5]])))
    policy = taciturn.design.integral(plant, COST, slope=0.5, saturation=1.0, alpha=0.5)
    assert isinstance(policy, EventPolicy)
    interval = policy.trigger.saturation * 2
    ends = [policy.bound(interval + sign * 1e-5) for sign in (-1, 1)]
    assert None not in ends
    slope = abs(np.diff(np.array(ends, float))[0]) / 2e-5
    assert policy.bound_error(Estimate(interval, 0.01, "simulation")) == pytest.approx(0.01 * slope, rel=1e-6)
    assert policy.bound_error(Estimate(policy.trigger.saturation / 2, 0.01, "simulation")) == 0.0


def test_a_verdict_has_ordinary_digits_and_the_errors_of_its_numbers() -> None:
    """A bound of three times the cost is at most 200 % above it."""
    found = simulated()
    assert found.cost_all_time is not None
    text = verdict(replace(found, cost_bound_at_rate=3 * found.cost_all_time))
    assert "at most 200.0 % by the bound at this rate" in text
    assert text.startswith("sends ")
    assert text.count("±") == 2
    assert "e+" not in text


def test_an_exact_cost_and_its_bound_have_the_same_digits_in_verdict_and_table() -> None:
    """Two decimals; a bound of 17.003 % is rounded up once."""
    found = simulated()
    base = found.cost_all_time
    assert base is not None
    cost = Estimate(1.1168447 * base, 0.0, "exact")
    shown = replace(found, cost=cost, cost_bound=1.17003 * base, cost_bound_at_rate=None)
    assert "costs 11.68 % above sending every sample, at most 17.01 % by the guarantee" in verdict(shown)
    assert "+11.68 %" in str(shown)
    assert "+17.01 %" in str(shown)
    assert "costs 11.68 % above" in verdict(replace(shown, cost=replace(cost, standard_error=1e-15)))


def test_a_verdict_without_a_bound_above_the_cost_of_every_sample_says_so() -> None:
    """Not that no schedule costs less than 0.0000 % above; a tiny bound is printed with one digit."""
    found = simulated()
    base = found.cost_all_time
    assert base is not None
    none = verdict(replace(found, lower_bound=LowerBound(base, 0.999, 0.9, 0.0)))
    assert none.endswith("no bound above the cost of sending every sample is proved for this controller at this rate")
    tiny = verdict(replace(found, lower_bound=LowerBound(base * (1 + 3.4e-8), 0.999, 0.9, 0.0)))
    assert tiny.endswith("costs less than 0.000003 % above")
    cheap = verdict(replace(found, cost=Estimate(base * (1 - 1e-4), base * 1e-4, "simulation")))
    assert "costs 0.010 ± 0.010 % below sending every sample" in cheap


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"settled": False}, "none: the loop has not settled, so the simulated cost is not an average"),
        ({"trusted": False}, "none: the standard error of the cost cannot be trusted"),
        (
            {"cost_all_time": None},
            "none: the cost of sending every sample is known for the loop of the design, and not for this loop",
        ),
        ({"cost_all_time": 0.0}, "none: sending every sample costs nothing, so no cost is a percentage of it"),
    ],
)
def test_a_missing_verdict_has_a_reason(changes: dict[str, object], reason: str) -> None:
    """In one sentence."""
    assert verdict(replace(simulated(), **changes)) == reason  # type: ignore[arg-type]


def test_a_rate_within_three_standard_errors_of_its_certified_bounds_has_no_note() -> None:
    """Beyond them, the note shows the rate with its error, and bounds with as many digits."""
    rate = Estimate(0.26736, 0.00018, "simulation")
    assert contradicted(rate, (0.267403, 0.3), "step") == ()  # 0.24 standard errors
    (note,) = contradicted(rate, (0.2681, 0.3), "step")
    assert "0.26736 ± 0.00018 per step is 4.1 standard errors outside its certified bounds 0.26810 to 0.30000" in note
    (exact,) = contradicted(Estimate(1 / 3, 0.0, "simulation"), (0.33334, 0.4), "second")
    assert "rate 0.3333333 per second is outside its certified bounds 0.3333400 to 0.4000000" in exact
    assert contradicted(Estimate(1 / 3, 0.0, "simulation"), (1 / 3 + 1e-12, 0.4), "second") == ()
    assert contradicted(Estimate(0.1, 1e-6, "quadrature"), (0.2, 0.3), "second") == ()
