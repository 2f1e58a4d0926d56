"""Evaluate, trade off, reproduce and simulate, as a user calls them."""

from __future__ import annotations

import json

import numpy as np
import pytest

import taciturn
from taciturn import Network, Plant, ProblemError
from taciturn.design.catalogue import CATALOGUE
from taciturn.study.periodic import clock_of
from taciturn_studies.tradeoff import usual_values
from taciturn_thesis.reproduce import reproduce


def test_evaluate_takes_the_closed_form_where_there_is_one() -> None:
    """A periodic policy is exact, and its simulation agrees."""
    problem = taciturn.load("two-mass-lqg")
    periodic = taciturn.Problem(problem.plant, problem.cost, problem.network, "periodic", {"every": 3})
    exact = taciturn.evaluate(periodic)
    simulated = taciturn.evaluate(periodic, method="simulation", steps=20_000_000)
    assert (exact.cost.method, exact.cost.standard_error, exact.steps) == ("exact", 0.0, 0)
    assert simulated.cost.method == "simulation"
    assert abs(exact.cost.value - simulated.cost.value) <= 4 * simulated.cost.standard_error
    assert exact.rates["actuator"].value == pytest.approx(1 / 3)


def test_evaluate_reaches_the_default_precision() -> None:
    """The standard error is at most 1e-4 of the cost, and the document is valid JSON."""
    found = taciturn.evaluate(taciturn.load("two-mass-lqg"))
    assert found.reached
    assert found.cost.standard_error <= 1e-4 * found.cost.value
    document = json.loads(json.dumps(found.document(), allow_nan=False))
    assert document["cost"]["method"] == "simulation"
    assert document["proved"]
    highest = document["cost_all_time"] + document["cost_all_time_error"]
    assert 1.1 * highest <= document["cost_bound"] <= 1.1 * highest * (1 + 1e-9)  # with the rounding of the gains
    assert document["cost_all_time_error"] <= 1e-9 * document["cost_all_time"]


@pytest.mark.parametrize("theta", [0.05, 0.1, 0.2, 0.5])
def test_a_guarantee_is_printed_as_the_percentage_that_was_asked_for(theta: float) -> None:
    """The effect of rounding on a proved guarantee is far below the digits of a percentage."""
    plant, cost = taciturn.Plant([[1.2]], [[1.0]], [[0.01]]), taciturn.Cost([[1.0]], [[0.5]])
    shown = str(taciturn.evaluate(taciturn.design.excess(plant, cost, theta=theta, actuation="model")))
    assert f"  +{100 * theta:#.3g} %" in next(line for line in shown.splitlines() if line.startswith("guarantee  "))


def test_a_bound_at_a_measured_rate_is_rounded_once() -> None:
    """The digits that its standard error allows are those of the bound."""
    plant = taciturn.Plant([[1.2]], [[1.0]], [[0.01]], [[1.0]], [[0.01]])
    found = taciturn.evaluate(
        taciturn.design.excess(plant, taciturn.Cost([[1.0]], [[0.5]]), theta=0.1), method="simulation"
    )
    line = next(one for one in str(found).splitlines() if one.startswith("guarantee, this rate"))
    value, digits = found.cost_bound_at_rate, line.split()[3]
    assert value is not None
    assert value <= float(digits) <= value * (1 + 1e-5)
    assert abs(float(digits) - value) <= 10.0 ** -len(digits.split(".")[1])


def test_a_policy_without_noise_costs_nothing() -> None:
    """W = 0: the deterministic loop decays, and its average cost is 0."""
    plant = taciturn.Plant([[1.3, 0.2], [0.0, 0.7]], [[0.0], [1.0]], np.zeros((2, 2)), mean=[1.0, -1.0])
    problem = taciturn.Problem(plant, taciturn.Cost(np.eye(2), [[1.0]]), taciturn.Network(), "lqg", {"theta": 0.5})
    found = taciturn.evaluate(problem, steps=100_000)
    assert found.cost.value == pytest.approx(0.0, abs=1e-12)
    assert found.cost_all_time == 0.0


def test_the_tradeoff_holds_points_curve_and_guarantee() -> None:
    """A grid of two keys: six points, two periodic curves, a picture, a document."""
    problem = taciturn.load("two-mass-lqg")
    found = taciturn.tradeoff(problem, {"theta": [0.01, 0.1, 1], "actuation": ["hold", "model"]}, standard_error=5e-4)
    assert [dict(point.values) for point in found.points[:2]] == [
        {"theta": 0.01, "actuation": "hold"},
        {"theta": 0.01, "actuation": "model"},
    ]
    assert set(found.periodic) == {"hold", "model"}
    assert found.guarantee is not None
    for point in found.points:
        assert point.evaluation.cost_bound is not None
        assert point.evaluation.cost.value < point.evaluation.cost_bound
    json.dumps(found.document(), allow_nan=False)
    labels = [text.get_text() for text in found.plot().axes[0].get_legend().get_texts()]
    assert {"lqg, hold", "lqg, model", "periodic control, hold", "periodic control, model"} <= set(labels)


def test_a_tradeoff_without_values_varies_the_parameter_of_the_policy_around_its_value() -> None:
    """By factors of two, up to eight on either side; values for which no policy can be designed are left out."""
    masses = taciturn.load("two-mass")
    assert usual_values(masses) == {"theta": [0.0065, 0.013, 0.026, 0.052, 0.104, 0.208, 0.416]}
    clock = masses.changed({"kind": "periodic", "theta": None, "every": 3})
    assert usual_values(clock) == {"every": [1, 2, 3, 6, 12, 24]}
    pattern = masses.changed({"kind": "periodic-schedule", "theta": None, "actuation": None, "length": 4, "sends": 2})
    assert usual_values(pattern) == {"sends": [1, 2, 4]}  # of the longest pattern
    assert list(usual_values(taciturn.load("remote-scalar"))) == ["theta"]  # the first of two
    always = masses.changed({"kind": "all-time", "theta": None, "actuation": None})
    with pytest.raises(ProblemError, match="all-time has no parameter that changes its rate; expected a key to vary"):
        taciturn.tradeoff(always)
    found = taciturn.tradeoff(clock)
    assert [point.values["every"] for point in found.points] == [1, 2, 3, 6, 12, 24]


@pytest.mark.evidence
def test_a_continuous_tradeoff_counts_per_second() -> None:
    """Rates and costs per second; the curve of the clock starts at the base rate, where it is all-time control."""
    found = taciturn.tradeoff(taciturn.load("two-mass-continuous"), {"theta": [0.1, 0.5]}, standard_error=5e-4)
    assert (found.unit, found.points[0].evaluation.base_rate) == ("second", 10.0)
    first = found.periodic["hold"][0]
    assert first.rate == pytest.approx(10.0)
    assert first.cost == pytest.approx(found.points[0].evaluation.cost_all_time)


@pytest.mark.parametrize(
    ("plant", "actual", "network"),
    [
        (Plant([[1.2]], [[1.0]], [[0.05]], input_limit=[1.0]), None, Network()),
        (Plant([[1.2]], [[1.0]], [[0.05]]), Plant([[1.1]], [[1.0]], [[0.05]]), Network()),
        (Plant([[1.2]], [[1.0]], [[0.05]], function=lambda x, u, w: 1.2 * np.sin(x) + u + w), None, Network()),
        (Plant([[1.2]], [[1.0]], [[0.05]]), None, Network(payload="float32")),
    ],
    ids=["clipped", "another plant", "not linear", "rounded"],
)
def test_a_loop_that_is_not_the_one_of_its_design_is_compared_with_no_clock(
    plant: Plant, actual: Plant | None, network: Network
) -> None:
    """The cost of periodic control is exact in the loop of its design; what is simulated is another."""
    problem = taciturn.Problem(plant, taciturn.Cost([[1.0]], [[2.0]]), network, "lqg", {}, actual)
    found = taciturn.tradeoff(problem, {"theta": [0.1, 0.2]}, standard_error=0.1)
    assert [point.cost_periodic_same_rate for point in found.points] == [None, None]
    assert found.periodic == {}


def test_jumps_behind_a_filter_are_compared_with_a_clock() -> None:
    """Whose cost is exact: of second moments, which jumps share with Gaussian noise."""
    W = [[0.0, 0.0], [0.0, 1.0]]
    A, B, C, V = [[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.01]]
    cost = taciturn.Cost([[1.0, 0.0], [0.0, 1.0]], [[1.0]])
    jumping = taciturn.ContinuousPlant(A, B, None, taciturn.Jumps(1.0, W), C, V)
    plants = (jumping, taciturn.ContinuousPlant(A, B, W, None, C, V))
    problems = [taciturn.Problem(plant, cost, Network(), "lqg", {"period": 0.5, "theta": 0.1}) for plant in plants]
    clocks = [clock_of(problem, problem.designed()) for problem in problems]
    costs = [clock.at(rate).cost for clock in clocks if clock is not None for rate in (2.0, 0.7)]
    assert len(costs) == 4
    assert costs[:2] == pytest.approx(costs[2:])


def test_a_mistake_in_the_last_cell_is_told_before_the_first_runs() -> None:
    """Nothing is simulated for a grid with a wrong value."""
    with pytest.raises(taciturn.ProblemError, match="theta is -1"):
        taciturn.tradeoff(taciturn.load("two-mass-lqg"), {"theta": [10.0, -1.0]}, progress=pytest.fail)


def test_a_trajectory_keeps_everything() -> None:
    """Sends happen exactly when the trigger exceeds its threshold; input changes only then; the estimate is close."""
    problem = taciturn.load("two-mass-lqg")
    loop = problem.close(problem.design())
    path = taciturn.simulate(loop, 400, seed=2)
    sent = path.sends["actuator"]
    assert path.time[-1] == pytest.approx(39.9)
    assert (sent == (path.trigger_value > path.threshold)).all()
    changes = np.any(np.diff(path.input, axis=0) != 0, axis=1)
    assert (changes <= sent[1:]).all()
    assert 0.4 < sent.mean() < 0.8
    assert np.abs(path.state - path.estimate).mean() < 0.2
    assert (taciturn.simulate(loop, 400, seed=2).state == path.state).all()


DECIDED = {
    "rollout": {"horizon": 4, "every": 2},
    "self-triggered": {"beta": 1.5, "max_interval": 5},
    "dynamic": {"sigma": 0.5, "rho": 0.5, "gain": 2.0},
    "stochastic": {"scale": 0.5},
}


@pytest.mark.parametrize("kind", DECIDED)
def test_the_trigger_of_a_trajectory_is_the_one_that_decides(kind: str) -> None:
    """Whatever else a policy decides, its packets are sent exactly when the value exceeds the threshold."""
    plant = taciturn.Plant([[1.1]], [[1.0]], [[1.0]], [[1.0]], [[1.0]])
    policy = CATALOGUE[kind].design(plant, taciturn.Cost([[1.0]], [[1.0]]), **DECIDED[kind])
    assert isinstance(policy, taciturn.Policy)
    path = taciturn.simulate(taciturn.close(plant, policy), 200, seed=3)
    (sent,) = path.sends.values()
    assert 10 < sent.sum() < 190
    assert (sent == (path.trigger_value > path.threshold)).all()


@pytest.mark.evidence
def test_a_trajectory_can_be_drawn_and_tabulated() -> None:
    """Four panels; one row per step."""
    problem = taciturn.load("two-mass-lqg").changed({"actuation": "model"})
    path = taciturn.simulate(problem.close(problem.design()), 50)
    assert [axis.get_ylabel() for axis in path.plot().axes] == ["outputs", "force", "", "trigger / threshold"]
    table = path.to_pandas()
    assert table.shape == (50, 4 + 4 + 1 + 2 + 2 + 2)
    assert table.index.name == "time"
    assert (table[["y1", "y2"]] == path.measurement).all(axis=None)


@pytest.mark.parametrize("name", ["two-mass-lqg", "double-integrator"])
def test_what_was_measured_brings_nodes_to_the_same_decisions(name: str) -> None:
    """The nodes are given nothing but the path's measurements; noise stands in these."""
    problem = taciturn.load(name)
    loop = problem.close(problem.design())
    path, nodes = taciturn.simulate(loop, 200, seed=2), taciturn.Nodes(loop.policy)
    given = path.estimate if path.predicts else path.input
    for y, u, sent in zip(path.measurement, given, *path.sends.values(), strict=True):
        assert np.allclose(nodes.step(y), u, rtol=0, atol=1e-12)
        assert list(nodes.sent.values()) == [sent]
    assert 0 < sum(map(np.sum, path.sends.values())) < 200


@pytest.mark.evidence
def test_chapter_2_is_reproduced() -> None:
    """Tables 2.1 and 2.2 and Figure 2.2, printed next to computed."""
    found = reproduce("chapter2")
    first, second, figure = found.tables
    assert (len(first.rows), len(second.rows), len(figure.rows)) == (6, 2, 8)
    for row in (*first.rows, *second.rows):
        for column, printed in row.printed.items():
            computed = row.computed[column]
            if column.startswith("cost"):
                assert 0.005 < printed - computed.value < 0.01, "the offset that the printed costs share"
            elif column.startswith("rate"):
                assert abs(printed - computed.value) <= 1.0
            else:
                assert computed.value == pytest.approx(printed, abs=5e-5)
    assert set(found.pictures) == {"chapter2"}


def test_averages_and_missions_are_not_traded_off_in_one_table() -> None:
    """Their costs count differently: per step, and in all."""
    problem = taciturn.load("remote-scalar")
    with pytest.raises(taciturn.ProblemError, match="mixes averages and finite-horizon runs"):
        taciturn.tradeoff(problem, {"cost.discount": [1.0, 0.9]})


@pytest.mark.evidence
def test_a_picture_of_several_links_has_their_traffic_and_the_share_of_each() -> None:
    """One panel: the points lie at the priced sum of the rates. The strip below has a region for each link."""
    found = taciturn.tradeoff(taciturn.load("remote-scalar"), {"zeta": [1.3, 8.0]}, standard_error=0.05)
    costs, shares = found.plot().axes
    traffic = sorted(one.evaluation.traffic.value for one in found.points if one.evaluation.traffic is not None)
    assert sorted(costs.containers[0].lines[0].get_xdata()) == pytest.approx(traffic)
    assert shares.get_xlabel() == "traffic per step: sends on all links"
    assert [text.get_text() for text in shares.texts if text.get_text()] == ["link actuator", "link sensor"]
    first = shares.collections[0].get_paths()[0].vertices
    point = min(
        (one.evaluation for one in found.points), key=lambda one: sum(rate.value for rate in one.rates.values())
    )
    assert any(y == pytest.approx(100 * point.rates["actuator"].value / traffic[0]) for y in first[:, 1])


def test_a_discounted_rate_weighs_each_send_as_its_cost() -> None:
    """(1−α)Σα^kσ_k, exactly from the schedule and by simulation: queries at the steps 2, 4, 6, …."""
    plant = taciturn.Plant([[2.0]], [[1.0]], [[0.01]], [[3.0]], [[0.02]], mean=[1.0])
    cost = taciturn.Cost([[1.0]], [[2.0]], discount=0.8)
    problem = taciturn.Problem(plant, cost, taciturn.Network(), "remote-lqg", {"theta": 0.2, "zeta": 1.6})
    found = taciturn.evaluate(problem, standard_error=0.01)
    assert found.schedule is not None
    assert found.schedule.ticks[:4] == [2, 4, 6, 8]
    assert found.rates["sensor"].value == pytest.approx(0.2 * 0.64 / (1 - 0.64), rel=1e-12)
    simulated = taciturn.average(problem.close(problem.design()), standard_error=0.01)
    assert simulated.rates["sensor"].value == pytest.approx(found.rates["sensor"].value, rel=1e-10)


def test_a_discount_too_near_to_1_for_its_paths_is_told() -> None:
    """Not run for ever: a path would be longer than all steps together."""
    problem = taciturn.load("remote-scalar").changed({"cost.discount": 0.99999999})
    with pytest.raises(taciturn.ProblemError, match="a discount further from 1"):
        taciturn.evaluate(problem)
    with pytest.raises(taciturn.ProblemError, match="expected more steps"):
        taciturn.evaluate(taciturn.load("remote-scalar").changed({"cost.discount": 0.999}), steps=10_000)


def test_a_problem_without_its_network_is_one_sentence() -> None:
    """It stands before the kind; a kind without parameters needs none."""
    plant, cost = taciturn.Plant([[0.9]], [[1.0]], [[1.0]]), taciturn.Cost([[1.0]], [[1.0]])
    with pytest.raises(taciturn.ProblemError, match="network is 'excess'; expected a Network"):
        taciturn.Problem(plant, cost, "excess", {"theta": 0.1})  # type: ignore[arg-type]
    assert taciturn.Problem(plant, cost, taciturn.Network(), "all-time").design().kind == "all-time"
