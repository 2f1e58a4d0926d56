"""Policies at the same rate: ranked, with honest differences."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from study.test_tune import MASSES, with_policy

import taciturn
from taciturn import Problem, ProblemError, compare
from taciturn.extend import percent
from taciturn_studies.compare import _at_rate as at_rate
from taciturn_studies.compare import _present as present

FEW: dict[str, Problem] = {
    "hold": MASSES,
    "model": MASSES.changed({"actuation": "model"}),
    "clock": with_policy("periodic", every=3),
    "drawn": with_policy("stochastic", actuation="model"),
}


@pytest.mark.evidence
def test_the_cheapest_is_first_and_differences_are_those_of_the_costs() -> None:
    """All at 0.3 sends per step; the exact ones without error."""
    found = compare(FEW, 0.3)
    costs = {one.name: one.cost for one in found.ranking}
    assert [one.name for one in found.ranking] == ["model", "drawn", "hold", "clock"]
    best = found.ranking[0]
    for one in found.ranking:
        apart = np.hypot(one.cost.standard_error, best.cost.standard_error)
        assert abs(one.above.value - (one.cost.value - best.cost.value)) <= 5 * apart + 1e-12
        assert one.above.standard_error <= apart + 1e-15
        assert one.reached
    assert costs["drawn"].standard_error == 0
    cycles = [(4, 3), (4, 3, 3, 3)]  # which beat sharing the time between every third step and every fourth
    slow, fast = (taciturn.evaluate(with_policy("periodic", every=cycle)).cost.value for cycle in cycles)
    share = (0.3 - 2 / 7) / (4 / 13 - 2 / 7)
    assert costs["clock"].value == pytest.approx(share * fast + (1 - share) * slow)
    assert found.cost_all_time == pytest.approx(0.733478, abs=1e-6)


@pytest.mark.evidence
def test_standard_errors_cover_the_truth() -> None:
    """Over sixteen seeds, the difference of hold and model from its mean: a chi-square within its range at 1e-4."""
    few = {name: FEW[name] for name in ("hold", "model")}
    rows = [compare(few, 0.3, seed=100 * seed, standard_error=1e-3).ranking[1].above for seed in range(16)]
    values, errors = np.array([r.value for r in rows]), np.array([r.standard_error for r in rows])
    weights = errors**-2
    chi = float((weights * (values - np.average(values, weights=weights)) ** 2).sum())
    assert chi < 44.3  # of 15 degrees of freedom
    assert (errors < 2e-3).all()


@pytest.mark.evidence
def test_common_draws_make_the_difference_of_neighbours_small() -> None:
    """Two triggers that differ little are told apart better than by their costs alone."""
    pair = [with_policy("absolute", threshold=1.0, weight=np.diag([1, 1, w, 1]), error="state") for w in (1.0, 1.1)]
    loops = [problem.close(problem.design()) for problem in pair]
    together = taciturn.difference(*loops, steps=2_000_000).cost.standard_error
    apart = [taciturn.average(loop, steps=1_000_000).cost.standard_error for loop in loops]
    assert together < 0.7 * np.hypot(*apart)
    found = compare(dict(zip("ab", pair, strict=True)), 0.5, standard_error=1e-3)
    assert found.ranking[1].above.value >= 0


@pytest.mark.evidence
def test_bounds_are_those_at_the_rate() -> None:
    """Sharper where the guarantee depends on the rate; of a shared time shared; a certificate; none if none holds."""
    found = {one.name: one for one in compare(
        {
            "absolute": with_policy("absolute", threshold=1.0),
            "rollout": with_policy("rollout", horizon=1, every=3),
            "delta": with_policy("send-on-delta", delta=0.4),
            "relative": with_policy("relative", sigma=0.5),
        },
        0.3,
        standard_error=1e-2,
    ).ranking}  # fmt: skip
    absolute, rollout = found["absolute"].tuned.evaluation, found["rollout"].tuned
    assert found["absolute"].cost_bound == absolute.cost_bound_at_rate
    assert rollout.beyond is not None
    bounds = (rollout.evaluation.cost_bound, rollout.beyond.evaluation.cost_bound)
    assert None not in bounds
    assert min(bounds) < found["rollout"].cost_bound < max(bounds)
    assert found["rollout"].cost.value < found["rollout"].cost_bound
    delta = found["delta"]
    assert delta.cost_bound == delta.tuned.evaluation.cost_bound
    assert delta.cost_bound is not None
    assert delta.cost.value < delta.cost_bound
    assert found["relative"].cost_bound is None


@pytest.mark.parametrize(
    ("problems", "words"),
    [
        ({"one": MASSES}, "the number of policies is 1; expected at least two"),
        ({"one": MASSES, "other": MASSES}, "the problems one and other have the same policy, lqg"),
        (
            {"one": MASSES, "other": MASSES.changed({"theta": 2.0})},
            "the problems one and other have the same policy, lqg",
        ),
        (
            {"one": MASSES, "other": MASSES.changed({"trigger": "joint"})},
            "the problems one and other have the same policy, lqg",
        ),
        ({"one": MASSES, "other": MASSES.changed({"cost.R": [[1.0]]})}, "differ in [cost]"),
        ({"one": MASSES, "other": MASSES.changed({"plant.V": [[1.0, 0.0], [0.0, 1.0]]})}, "differ in [plant]"),
        pytest.param(
            {"one": MASSES, "far": MASSES.changed({"trigger": "separate"})},
            "far: no theta gives lqg the rate 0.3",
            marks=pytest.mark.evidence,
        ),
        (
            {"one": MASSES, "foreseen": with_policy("consistent", period=0.5)},
            "foreseen: the changed problem: the plant is discrete in time",
        ),
    ],
)
def test_what_cannot_be_compared_is_one_sentence(problems: dict[str, Problem], words: str) -> None:
    """Naming the policy."""
    with pytest.raises(ProblemError) as caught:
        compare(problems, 0.3, standard_error=1e-2)
    assert words in str(caught.value)


@pytest.mark.evidence
def test_without_a_rate_policies_are_compared_at_the_rate_of_the_first_one() -> None:
    """Or at its traffic, if it decides on several links."""
    clocks = {"every third": with_policy("periodic", every=3), "drawn": with_policy("stochastic", actuation="model")}
    found = compare(clocks)
    assert (found.of, found.rate) == ("rate", 0.333)
    tanks = taciturn.load("quadruple-tank")
    whole = taciturn.evaluate(tanks)
    traffic, rate = whole.traffic, whole.rates["pump-1"]
    assert traffic is not None
    assert present(tanks, None, 0) == (None, pytest.approx(traffic.value, rel=5e-3))
    assert present(tanks, "pump-1", 0) == (pytest.approx(rate.value, rel=5e-3), None)


def test_policies_that_are_the_same_at_a_traffic_are_refused_with_this_word() -> None:
    """Not with the word rate."""
    with pytest.raises(ProblemError, match=r"have the same policy, lqg, at the same traffic; expected policies that"):
        compare({"one": MASSES, "other": MASSES}, traffic=0.3)


@pytest.mark.evidence
def test_a_cost_that_the_rate_does_not_fix_is_refused() -> None:
    """At the edge of what a policy keeps stable, the rate's standard error alone moves the cost by more than it is."""
    found = taciturn.tune(MASSES, rate=0.3, standard_error=1e-2)
    assert at_rate("hold", found, 0.3, "actuator").cost.value == pytest.approx(0.827, abs=0.02)
    with pytest.raises(ProblemError, match="the loop is nearly unstable there"):
        at_rate("hold", replace(found, slope=-1e4), 0.3, "actuator")


@pytest.mark.evidence
def test_the_ranking_is_drawn_and_written_down(tmp_path: Path) -> None:
    """A picture with a name for each policy; JSON without what JSON cannot say."""
    found = compare({"hold": MASSES, "clock": FEW["clock"]}, 0.3, standard_error=1e-2)
    (axis,) = found.plot().axes
    assert [label.get_text() for label in axis.get_yticklabels()] == ["clock", "hold"]
    assert axis.get_title().replace("\n", " ") == found.verdict[0].replace("hold", "“hold”", 1)
    above, base = found.ranking[1].above, found.cost_all_time
    assert base is not None
    more = percent(above.value / base, error=above.standard_error / base)
    assert {"least", f"least + {more}"} <= {text.get_text() for text in axis.texts}
    shown = [mark.get_color() for mark in axis.get_lines() if len(mark.get_xdata()) == 1 and mark.get_marker() in "os"]
    assert {"#0072b2", "#c27500"} <= {*shown}  # the clock is periodic control
    document: dict[str, Any] = json.loads(json.dumps(found.document(), allow_nan=False))
    assert [place["name"] for place in document["ranking"]] == ["hold", "clock"]
    assert document["ranking"][1]["parameter"]["value"] == [4, 3]
    slow, fast = (rate["value"] for rate in document["ranking"][1]["rates"])
    assert (slow, fast) == pytest.approx((2 / 7, 4 / 13))
    (measured,) = found.ranking[0].rates
    assert document["ranking"][0]["rates"] == [measured.document("value", "standard_error")]
    told = " ".join(str(found).split())
    assert f"measured at {measured} clock" in told
    assert "[4, 3] and [4, 3, 3, 3], measured at 0.285714 and 0.307692 " in told
    assert document["ranking"][1]["parameter"]["beyond"] == [4, 3, 3, 3]
    assert document["ranking"][1]["parameter"]["share"] == pytest.approx((4 / 13 - 0.3) / (4 / 13 - 2 / 7))


@pytest.mark.evidence
def test_a_clock_beside_others_measures_as_often_as_they_do() -> None:
    """Of a continuous plant whose outputs are measured, a period alone would measure only when it sends."""
    problem = taciturn.load("two-mass-continuous")
    clock = replace(problem, kind="periodic", parameters={"period": 0.3})
    found = compare({"events": problem, "clock": clock}, 3.0, standard_error=5e-3)
    fair = next(one for one in found.ranking if one.name == "clock")
    assert fair.tuned.problem.parameters["period"] == problem.parameters["period"]
    weaker = taciturn.evaluate(clock.changed({"period": 1 / 3}))
    assert fair.cost.value < 0.999 * weaker.cost.value
    assert any("measures only when it sends" in note for note in weaker.notes)


@pytest.mark.evidence
def test_continuous_plants_are_compared_per_second() -> None:
    """Periodic control at any rate, consistent by quadrature: no simulation, no error."""
    integrator = taciturn.load("wiener-double-integrator")
    found = compare(
        {
            "clock": with_policy("periodic", integrator, actuation="model"),
            "events": with_policy("consistent", integrator),
        },
        5.0,
    )
    assert [one.name for one in found.ranking] == ["events", "clock"]
    assert found.unit == "second"
    assert all(one.cost.standard_error == 0 for one in found.ranking)


@pytest.mark.evidence
def test_what_missions_cost_is_a_total_and_what_they_send_a_share_of_their_steps() -> None:
    """Of the rover, whatever it asks of its camera."""
    rover = taciturn.load("rover")
    found = compare(
        {"often": rover, "seldom": rover.changed({"zeta": 0.008})}, 0.2, link="actuator", standard_error=2.0
    )
    assert (found.unit, found.rate_unit) == ("mission", "step")
    assert found.document()["unit"] == found.ranking[0].tuned.evaluation.unit
    (axis,) = found.plot().axes
    assert axis.get_title().replace("\n", " ") == found.verdict[0]
    assert axis.get_xlabel().endswith("in total")
