"""The numbers of printed results: percentages, errors of rates, verdicts, and notes on certified rates."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import taciturn
from taciturn import Estimate
from taciturn._text import PLAIN, number_of, ordinal, percent, wrapped_text
from taciturn.model.estimate import rounded
from taciturn.model.schedule import Schedule
from taciturn.model.theory import LowerBound
from taciturn.study.evaluate import contradicted
from taciturn.study.evaluation import Evaluation
from taciturn.study.periodic import Timed, fair_clock
from taciturn.study.record import decode, encode
from taciturn.study.sentences import percent_above, queries_text
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
    return " ".join(str(found).partition("\n\n")[0].split())


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
        (percent_above(Estimate(1.0999999, 0.0, "exact"), 1.0, 1), "+10.0 %"),
        (percent_above(Estimate(3.04391, 0.0, "exact"), 1.0, 1), "+205 %"),
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


def test_a_number_has_its_noun_in_the_singular_or_plural() -> None:
    """Also a number as text; a path of one step, and the packets of two links in each step."""
    told = [number_of(one, "step") for one in (0, 1, "1", "1.5")]
    assert told == ["0 steps", "1 step", "1 step", "1.5 steps"]
    walk = taciturn.Plant([[1.0]], [[1.0]], [[1.0]])
    policy = taciturn.design.excess(walk, COST, theta=0.5)
    assert taciturn.simulate(policy, 1).verdict[0].startswith("0 packets in 1 step, ")
    problem = taciturn.load("quadruple-tank")
    several = problem.changed({"theta": None, "delta": 0.0})
    one_each = taciturn.tradeoff(several, {"delta": [0.0]}, standard_error=1.0)
    assert " at 2 sends per second on 4 links" in " ".join(str(one_each).split())


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
    with pytest.raises(taciturn.UnstableError, match="the loop that sends only at every 22nd step is not stable"):
        taciturn.design.excess(SCALAR, COST, every=22, **kept)


def test_the_cost_of_a_real_period_has_the_error_of_its_curve() -> None:
    """The cost 1/r has the slope −1/r²; without a stable loop on one side, the other side is used."""
    found = Timed("hold", lambda period: period).at(2.0, 0.001)
    assert found is not None
    assert found.standard_error == pytest.approx(0.001 / 4, rel=1e-5)
    one_sided = Timed("hold", lambda period: period if period <= 0.5 else None).at(2.0, 0.001)
    assert one_sided is not None
    assert one_sided.standard_error == pytest.approx(0.001 / 4, rel=1e-3)


@pytest.mark.evidence
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


def test_a_verdict_has_the_digits_that_the_errors_of_its_numbers_allow() -> None:
    """Three digits, or fewer; an error is shown where it is more than a tenth. Three times the cost is 200 % more."""
    found = simulated()
    base, (rate,) = found.cost_all_time, found.rates.values()
    assert base is not None
    text = verdict(replace(found, cost_bound_at_rate=3 * base))
    assert 0.001 < rate.standard_error < 0.01
    assert text.startswith(f"{100 * rate.value:.1f} % of the packets, ")
    assert text.endswith(", at most 200 % proven")
    assert "e+" not in text
    cheap = verdict(replace(found, cost=Estimate(base * (1 - 1e-4), base * 1e-4, "simulation")))
    assert ", 0.010 ± 0.010 % less cost than every sample, " in cheap
    assert cheap.endswith(" more proven")
    less = verdict(replace(found, cost=Estimate(base * (1 - 0.0588), base * 1e-5, "simulation")))
    assert ", 5.88 % less cost than every sample, " in less
    alike = verdict(replace(found, cost=Estimate(base * (1 - 1e-8), base * 0.0031, "simulation")))
    assert ", as much cost as every sample (± 0.31 %), " in alike
    assert ", as much cost as every sample, " in verdict(replace(found, cost=Estimate(base, 0.0, "exact")))
    rough = verdict(replace(found, cost=Estimate(base * 1.0772, base * 0.002, "simulation")))
    assert ", 7.7 % more cost than every sample, " in rough


def test_an_exact_cost_and_its_bound_have_the_same_digits_in_verdict_and_table() -> None:
    """Two decimals below ten percent, and one above; a bound of 17.003 % is rounded up once."""
    found = simulated()
    base = found.cost_all_time
    assert base is not None
    cost = Estimate(1.0168447 * base, 0.0, "exact")
    shown = replace(found, cost=cost, cost_bound=1.17003 * base, cost_bound_at_rate=None)
    assert "1.68 % more cost than every sample, at most 17.1 % proven" in verdict(shown)
    assert "+1.68 %" in str(shown)
    assert "+17.1 %" in str(shown)
    assert "1.68 % more" in verdict(replace(shown, cost=replace(cost, standard_error=1e-15)))


def test_no_schedule_is_said_to_cost_more_than_every_sample_without_a_bound_above_it() -> None:
    """Not that no schedule costs less than 0.0000 % more; a tiny bound is printed with one digit."""
    found = simulated()
    base = found.cost_all_time
    assert base is not None

    def told(bound: float) -> str:
        (line,) = [text for name, text in replace(found, lower_bound=LowerBound(bound, 0.999, 0.9, 0.0)).lines()
                   if name == "no schedule"]  # fmt: skip
        return line

    assert told(base) == "of this controller is proved to cost more than every sample at this rate"
    assert told(base * (1 + 3.4e-8)).endswith("costs less than 0.000003 % more (99.9 % sure)")


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"settled": False}, "no verdict: the loop has not settled, so the simulated cost is not an average"),
        ({"trusted": False}, "% of the packets; no verdict on the cost, whose standard error cannot be trusted"),
        ({"cost_all_time": 0.0}, " per step, where every sample costs nothing, at most "),
        (
            {"cost_all_time": None, "withdrawn": ("it is another plant",), "cost_bound": None, "bound_error": 0.0},
            " per step no guarantee holds, and the cost of every sample is unknown: it is another plant",
        ),
        ({"cost_bound": None, "cost_bound_at_rate": None, "bound_error": 0.0}, " than every sample, no guarantee"),
        ({"base_rate": None}, " packets per step, "),
    ],
)
def test_a_verdict_states_what_it_lacks(changes: dict[str, object], told: str) -> None:
    """In the first lines, and in the document."""
    found = replace(simulated(), **changes)  # type: ignore[arg-type]
    assert told in verdict(found)
    assert found.document()["verdict"] == "; ".join(found.verdict)


def test_a_table_has_a_row_for_each_link_and_fits() -> None:
    """Rate, share of the packets, price, power and battery, and the share of the guarantee; then all links."""
    found = replace(taciturn.evaluate(taciturn.load("quadruple-tank"), steps=20_000), notes=())
    costs, links = found.table_texts()
    assert max(map(len, [*costs.splitlines(), *links.splitlines()])) <= PLAIN
    assert "level-1" not in costs
    rows = {line.split()[0]: line for line in links.splitlines()[2:]}
    assert [*rows] == [*found.rates, "all"]
    share = found.share
    assert share is not None
    assert share.value == pytest.approx(sum(rate.value for rate in found.rates.values()) / (4 * 0.5))
    for link, days in found.battery_days.items():
        assert str(found.rates[link]) in rows[link]
        assert f" {days.rounded()} " in rows[link]
        assert rows[link].endswith(" 25.0 %")
    assert sum(found.guarantee_shares.values()) == pytest.approx(1)
    assert decode(encode(found)).verdict == found.verdict


def test_methods_are_printed_on_request_and_last() -> None:
    """With the seed and the time; ``print`` has none of them."""
    found = simulated()
    told, more = str(found), found.text(verbose=True)
    assert more.startswith(told)
    assert [line.split()[0] for line in more[len(told) :].strip().splitlines() if line[0] != " "] == [
        "method",
        "seed",
        "time",
    ]


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
