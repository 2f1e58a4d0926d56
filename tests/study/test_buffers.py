"""The buffer with the least cost, against the evaluation of every possible delay, and refusals in one sentence."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from taciturn import Problem, ProblemError, UnstableError, evaluate, load
from taciturn_studies import buffers
from taciturn_studies.buffers import tune_buffer

STEPS = [0.2, 0.5, 0.25, 0.05]
PARTS = {"seconds": [0.0, 0.004, 0.013, 0.02, 0.047], "probability": [0.1, 0.3, 0.3, 0.2, 0.05]}  # periods are 0.02 s
GILBERT = {"to_bad": 0.05, "to_good": 0.5, "loss_good": 0.0, "loss_bad": 0.3}
BURSTS = {"actuator_burst": GILBERT, "actuator_delay": {"states": [[0.8, 0.2], [0.0, 0.3, 0.6]]}}


def pendulum(kind: str = "excess", protocol: str = "tcp", **network: Any) -> Problem:
    """Return the inverted pendulum with the given keys of [network]."""
    keys = {f"network.{name}": value for name, value in {"protocol": protocol, **network}.items()}
    return load("inverted-pendulum").changed({"kind": kind, **keys})


def masses() -> Problem:
    """Return the two masses with an input that is mostly late by a step."""
    late = {"network.protocol": "tcp", "network.actuator_delay": [0.3, 0.65, 0.05]}
    return load("two-mass-lqg").changed({**late, "kind": "excess", "theta": 0.2})


@pytest.mark.parametrize(
    ("problem", "waits"),
    [
        pytest.param(pendulum(actuator_delay=STEPS), [1, 2, 3], marks=pytest.mark.evidence),
        (pendulum(actuator_delay=PARTS, actuator_loss=0.05), [0.004, 0.013, 0.02, 0.047]),
        pytest.param(pendulum(**BURSTS), [1, 2], marks=pytest.mark.evidence),
    ],
    ids=["steps", "parts of a period", "bursts"],
)
def test_the_best_buffer_is_that_of_a_search_by_hand(problem: Problem, waits: list[float]) -> None:
    """Each possible delay is evaluated by itself; with losses that are acknowledged, the costs are exact."""
    found = tune_buffer(problem, "actuator")
    costs = list[float]()
    for wait, tried in zip(waits, found.tried, strict=True):
        stated = wait if isinstance(wait, int) else {"seconds": wait}
        one = evaluate(problem.changed({"network.actuator_buffer": stated}), steps=10_000)
        assert one.cost_every_sample is not None
        assert tried.cost is not None
        assert tried.cost.value == pytest.approx(one.cost_every_sample.value, rel=1e-9)
        assert (tried.buffer.seconds or tried.buffer.steps) == wait
        costs.append(one.cost_every_sample.value)
    best = waits[int(np.argmin(costs))]
    assert (found.buffer.seconds or found.buffer.steps) == best
    assert found.problem.network.links["actuator"].buffer == found.buffer
    assert all(one.cost is not None and one.cost.standard_error == 0.0 for one in found.tried)


def test_the_share_is_that_of_late_and_of_lost_packets() -> None:
    """By hand, from the law and the loss."""
    found = tune_buffer(pendulum(actuator_delay=PARTS, actuator_loss=0.05), "actuator")
    expected = [1 - 0.95 * share for share in (0.4, 0.7, 0.9, 0.95)]
    assert [one.late for one in found.tried] == pytest.approx(expected)


def test_a_buffer_between_two_possible_delays_is_worse_than_the_lower_one() -> None:
    """So only the possible delays are tried."""
    problem = pendulum(actuator_delay=PARTS)
    found = tune_buffer(problem, "actuator")
    costs = {one.buffer.seconds: one.cost.value for one in found.tried if one.cost is not None}
    for low, between in ((0.004, 0.008), (0.013, 0.016), (0.02, 0.03), (0.047, 0.05)):
        changed = problem.changed({"network.actuator_buffer": {"seconds": between}})
        assert changed.design().cost_all_time > costs[low]  # type: ignore[operator]


@pytest.mark.evidence
def test_simulated_costs_have_errors_and_the_same_random_numbers() -> None:
    """Without acknowledgements a limit of the input leaves no closed form; each cost is that of its own evaluation."""
    problem = pendulum(protocol="udp", actuator_delay=[0.5, 0.4, 0.05]).changed({"plant.input_limit": 3.0})
    found = tune_buffer(problem, "actuator", standard_error=4e-3)
    assert found.drawn
    for one in found.tried:
        assert one.cost is not None
        assert 0 < one.cost.standard_error <= 4e-3
        by_itself = evaluate(one.problem, standard_error=2e-3, seed=5).cost_every_sample
        assert by_itself is not None
        error = np.hypot(one.cost.standard_error, by_itself.standard_error)
        assert abs(one.cost.value - by_itself.value) < 5 * error


@pytest.mark.evidence
def test_many_delays_are_searched_from_afar(monkeypatch: pytest.MonkeyPatch) -> None:
    """A few candidates at a time find the same buffer as all of them; a note tells how many were tried."""
    waits = np.linspace(0.001, 0.05, 30)
    law = {
        "seconds": waits.tolist(),
        "probability": (0.99 * np.exp(-150 * waits) / np.exp(-150 * waits).sum()).tolist(),
    }
    problem = pendulum(actuator_delay=law)
    whole = tune_buffer(problem, "actuator") if buffers.MOST >= 30 else None
    monkeypatch.setattr(buffers, "MOST", 30)
    whole = tune_buffer(problem, "actuator")
    monkeypatch.setattr(buffers, "MOST", 6)
    few = tune_buffer(problem, "actuator")
    assert len(whole.tried) == 30
    assert len(few.tried) < 16
    assert few.buffer == whole.buffer
    assert 0.001 < few.buffer.seconds < 0.05
    assert not whole.notes
    assert f"{len(few.tried)} of 30 possible delays were tried" in few.notes[0]


@pytest.mark.evidence
def test_a_budget_tunes_the_policy_for_each_buffer() -> None:
    """At the same rate; the least cost is the best, and that of a tuned policy by itself."""
    found = tune_buffer(masses(), "actuator", rate="60%", standard_error=2e-2)
    assert [one.tuned is not None for one in found.tried] == [True, True]
    costs = [one.cost.value for one in found.tried if one.cost is not None]
    assert found.best.cost is not None
    assert found.best.cost.value == min(costs)
    for one in found.tried:
        assert one.tuned is not None
        rate = one.tuned.evaluation.rates["actuator"]
        assert abs(rate.value - 0.6) < 5 * rate.standard_error + 0.01
        assert one.cost == one.tuned.evaluation.cost
    document = json.loads(json.dumps(found.document()))
    assert document["budget"]["of"] == "rate"
    assert [row["buffer"] for row in document["buffers"]] == [1, 2]
    assert document["verdict"].startswith("network.actuator_buffer = ")


def test_buffers_that_drop_too_much_are_refused_and_told() -> None:
    """If all are, the reason is that of the largest one."""
    law = {"seconds": [0.001, 0.03], "probability": [0.05, 0.95]}
    found = tune_buffer(pendulum(actuator_delay=law), "actuator")
    assert found.tried[0].cost is None
    assert found.buffer.seconds == 0.03
    assert "1 ms: the mean square of the loop" in " ".join(str(found).split())
    with pytest.raises(UnstableError, match="expected a factor below 1"):
        tune_buffer(pendulum(actuator_delay=law, actuator_loss=0.9), "actuator")


@pytest.mark.parametrize(
    ("network", "link", "words"),
    [
        ({}, "actuator", "network.actuator_delay states no delay, so there is no buffer to tune"),
        ({"actuator_delay": 2}, "actuator", "network.actuator_delay states the delay 2 steps"),
        ({"actuator_delay": STEPS}, "radio", "buffer is 'radio', which is no link of the network; expected sensor or"),
    ],
)
def test_links_without_random_delays_are_refused(network: dict[str, Any], link: str, words: str) -> None:
    """In one sentence, which names the key."""
    with pytest.raises(ProblemError, match=words.replace("[", r"\[")):
        tune_buffer(pendulum(**network), link)


def test_a_cost_in_percent_is_refused() -> None:
    """The cost of sending every sample, to which it would refer, depends on the buffer."""
    with pytest.raises(ProblemError, match=r"cost is '\+5%', a percentage .* expected a number"):
        tune_buffer(pendulum(actuator_delay=STEPS), "actuator", cost="+5%")


@pytest.mark.evidence
def test_with_a_limit_of_the_cost_the_fewest_packets_win() -> None:
    """A buffer whose cost of every sample is above the limit is refused."""
    found = tune_buffer(masses(), "actuator", cost=0.9, standard_error=1e-2)
    uses = [one.use.value for one in found.tried if one.use is not None]
    assert len(uses) == 2
    assert found.best.use is not None
    assert found.best.use.value == min(uses)
    assert found.plot().axes
