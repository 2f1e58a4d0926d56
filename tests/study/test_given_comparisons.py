"""Trade-offs, tuning and comparisons of a given controller whose nodes decide on several links."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from counts import few
from drawn import rows

import taciturn
from taciturn import cli
from taciturn.errors import ProblemError
from taciturn.model.controller import PID
from taciturn.model.disturbance import Disturbance
from taciturn.model.network import Network, NodeRole
from taciturn.problem import Problem
from taciturn_studies import search, shares
from taciturn_studies.compare import comparable
from taciturn_studies.periodic_links import LinkClocks, clocks_of_links, clocks_or_reason

FILE = """
plant.A = [[1.0, 0.1], [0.0, 0.9]]
plant.B = [[0.0], [0.1]]
plant.W = [[1e-4, 0.0], [0.0, 4e-4]]
plant.C = [[1.0, 0.0]]
plant.V = [[1e-3]]
plant.dt = 0.1
cost = {Q = [[1.0, 0.0], [0.0, 0.0]], R = [[0.05]]}
controller = {pid = {kp = 1.2, ki = 0.15, kd = 1.0, filter = 0.5}, disturbance = {deviation = 0.0}}
nodes = {level = {measures = [0]}, plc = {controls = true}, valve = {applies = [0]}}
"""
EQUAL = {"level": 1.0, "valve": 1.0}


@pytest.fixture(autouse=True)
def _short_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the searches take less time; their answers are measured as always."""
    monkeypatch.setattr(search, "EFFORT", 100_000)
    monkeypatch.setattr(shares, "EFFORT", 30_000)


def tank(kind: str = "distributed", **policy: Any) -> Problem:
    """Return a tank with a PID controller, whose level and valve have a link each."""
    plant = taciturn.Plant([[1, 0.1], [0, 0.9]], [[0], [0.1]], np.diag([1e-4, 4e-4]), [[1.0, 0]], [[1e-3]], dt=0.1)
    nodes = {"level": NodeRole(measures=(0,)), "plc": NodeRole(controls=True), "valve": NodeRole(applies=(0,))}
    pid = PID(kp=1.2, ki=0.15, kd=1.0, filter=0.5, disturbance=Disturbance(deviation=0.0))
    cost = taciturn.Cost(np.diag([1.0, 0]), [[0.05]])
    given = {"shares": EQUAL} | (policy or {"theta": 0.5})
    return Problem(plant, cost, Network(nodes=nodes), kind, given, controller=pid)


@pytest.mark.parametrize("rule", few(["bank", "threshold", "relative"], 1))
def test_a_tradeoff_shows_promise_certificate_and_cost(rule: str) -> None:
    """In text, JSON, columns and figure; at each point the certificate is between the cost and the promise."""
    name, values = ("kappa", [0.1, 0.2]) if rule == "relative" else ("theta", [0.5, 1.5])
    found = taciturn.tradeoff(tank(rule=rule, **{name: values[0]}), {name: values}, standard_error=4e-5)
    for point, document in zip(found.points, found.document()["points"], strict=True):
        one = point.evaluation
        assert one.certificate is not None
        assert document["certificate"]["value"] == one.certificate.value
        assert one.cost.value - 4 * one.cost.standard_error < one.certificate.value
        bound = one.cost_bound_at_rate or one.cost_bound
        # a bank that was full before the average begins may be spent within it
        assert one.certificate.value < bound * (1 + 2e-4) + 4 * (one.bound_error + one.certificate.standard_error)
    assert "certificate" in found.table().split()
    assert [one.value for one in found.columns()["certificate"]] == [
        point.evaluation.certificate.value for point in found.points
    ]
    for point in found.points:
        periodic, traffic = point.same_traffic, point.evaluation.traffic
        assert periodic is not None
        assert traffic is not None
        here = clocks_of_links(tank(rule=rule, **{name: values[0]}), traffic.value)
        assert periodic.value == pytest.approx(here.cost, rel=1e-12)
        assert 0 < periodic.standard_error < 0.01 * periodic.value
        assert periodic.value > point.evaluation.cost.value
    assert found.columns()["periodic_same_traffic"] == [point.same_traffic for point in found.points]
    axis = found.plot().axes[0]
    (line,) = (one for one in axis.get_lines() if one.get_label() == "certificate of the nodes")
    assert sorted(line.get_ydata()) == sorted(point.evaluation.certificate.value for point in found.points)
    assert axis.get_ylim()[1] > max(line.get_ydata())


@pytest.mark.evidence
def test_rules_in_one_tradeoff_state_both_theorems() -> None:
    """And the figure has the guarantees and the certificates of both, named once."""
    found = taciturn.tradeoff(
        tank(theta=0.5), {"rule": ["bank", "threshold"], "theta": [0.3, 0.5]}, standard_error=1e-4
    )
    assert found.guarantee is not None
    assert found.guarantee.count("√J ≤") == 2
    lines: list[Any] = found.plot().axes[0].get_lines()
    for name in ("guarantee", "certificate of the nodes"):
        (look,) = {(line.get_color(), line.get_marker()) for line in lines if line.get_label() == name}
        assert len([line for line in lines if (line.get_color(), line.get_marker()) == look]) == 2


@pytest.mark.evidence
def test_nodes_that_measure_nothing_have_no_certificate() -> None:
    """Neither a column nor a curve."""
    bands = taciturn.tradeoff(tank("send-on-delta", delta=0.05), {"delta": [0.03, 0.05]}, standard_error=1e-4)
    assert "certificate" not in bands.table()
    assert "certificate of the nodes" not in [one.get_label() for one in bands.plot().axes[0].get_lines()]


@pytest.mark.parametrize("rival", few(["bands", "relative", "threshold"], 1))
def test_rules_and_rivals_are_compared_at_equal_traffic_with_the_same_controller(rival: str) -> None:
    """All cost less than the timetable of the same controller, of which the text and the document tell."""
    rivals = {
        "bands": tank("send-on-delta", delta=0.034),
        "relative": tank(kappa=0.25),
        "threshold": tank(rule="threshold", theta=2.8),
    }
    found = taciturn.compare({"bank": tank(theta=0.7), rival: rivals[rival]}, traffic=1.0, standard_error=3e-5)
    assert isinstance(found.clocks, LinkClocks)
    assert {each.period for one in found.clocks.timings for each in one.values()} == {
        2
    }  # test_timed_links has its cost
    assert all(one.cost.value + 4 * one.cost.standard_error < found.clocks.cost for one in found.ranking)
    assert "the same controller" in str(found)
    assert found.document()["clocks"]["gains"] == "given"


def test_two_keys_of_one_rule_are_not_compared() -> None:
    """But a bank with an income of its own and a relative one are two policies."""
    with pytest.raises(ProblemError, match="have the same policy, distributed, at the same traffic"):
        taciturn.compare({"one": tank(theta=0.5), "other": tank(delta=1e-4)}, traffic=1.0)
    given = {"one": tank(theta=0.5), "other": tank(kappa=0.2)}
    assert comparable(given, None, "traffic") == given


@pytest.mark.parametrize("kind", ["symmetric-send-on-delta", "event-pid", "event-pid-saturated"])
def test_kinds_of_one_decider_are_refused_by_name(kind: str) -> None:
    """In one sentence that names the kinds for several deciding nodes."""
    with pytest.raises(
        ProblemError, match=f"of the policy kind {kind} is at the controller's site.* distributed or send-on-delta"
    ):
        tank("send-on-delta", delta=0.05).changed({"kind": kind, "shares": None}).designed()


def test_rules_that_compute_with_functions_leave_the_timetable_to_the_others() -> None:
    """On one link; where no rule has linear steps, the reason is given."""
    nodes = {
        "level": NodeRole(measures=(0,)),
        "plc": NodeRole(controls=True),
        "valve": NodeRole(applies=(0,), site="plc"),
    }
    given = tank()

    def one_link(kind: str, **policy: float) -> Problem:
        return Problem(given.plant, given.cost, Network(nodes=nodes), kind, policy, controller=given.controller)

    symmetric, event = one_link("symmetric-send-on-delta", delta=0.026), one_link("event-pid", delta=0.028, longest=5.0)
    bank = one_link("distributed", theta=0.35)
    beside = clocks_or_reason([symmetric, event, bank], 0.55)
    assert isinstance(beside, LinkClocks)
    assert beside.cost == pytest.approx(clocks_of_links(bank, 0.55).cost, rel=1e-12)
    assert "symmetric-send-on-delta computes with Python functions" in str(clocks_or_reason([symmetric, event], 0.55))


@pytest.mark.parametrize("effort", few([30_000, 4096], 1))
def test_shares_of_a_loop_without_an_identity_are_not_equal_by_chance(
    effort: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Equal shares have the draws of all trials, which are longer if the loop does not settle in a short one."""
    monkeypatch.setattr(shares, "EFFORT", effort)
    monkeypatch.setattr(shares, "LAST", 0.5)  # two steps of the search
    free = tank(rule="threshold", theta=2.5).changed({"shares": None})
    assert taciturn.evaluate(free, steps=effort).settled == (effort > 4096)
    found = taciturn.tune(free, traffic=1.0, standard_error=4e-5)
    assert found.shares is not None
    assert found.shares["level"] > 1.1 > 0.9 > found.shares["valve"]


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    rows(
        [
            ("distributed", "kappa", 0.35),
            ("distributed", "theta", 1.1),
            ("distributed", "delta", 6e-4),
            ("send-on-delta", "delta", 0.05),
        ],
        1,
    ),
)
def test_a_cost_is_met_by_each_parameter(kind: str, name: str, value: float) -> None:
    """With given shares."""
    problem = tank(kind, **{name: value})
    found = taciturn.tune(problem, cost="+5%", standard_error=3e-5)
    cost = found.evaluation.cost
    assert found.parameter.name == name
    assert abs(cost.value - 1.05 * found.evaluation.cost_all_time) < 8 * cost.standard_error
    assert found.confidence is not None
    assert found.confidence > 0.9


@pytest.mark.parametrize(
    "command",
    few(
        [
            "tradeoff bank.toml --over theta=0.5,1.5 --plot c.svg",
            "tune bank.toml --cost +5%",
            "compare bank.toml bands.toml --traffic 1.0",
        ],
        1,
    ),
)
def test_the_commands_take_a_file(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the words of the result, and a figure."""
    given = {"bank": 'kind = "distributed", theta = 0.5', "bands": 'kind = "send-on-delta", delta = 0.05'}
    for name, policy in given.items():
        (tmp_path / f"{name}.toml").write_text(f"{FILE}policy = {{{policy}, shares = {{level = 1.0}}}}")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["taciturn", *command.split(), "--standard-error", "3e-5"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 0
    words = {
        "tradeoff": "certificate",
        "tune": "cost at most 0.00286341 per step, met with",
        "compare": "the least found with the same controller",
    }
    assert words[command.split()[0]] in " ".join(capsys.readouterr().out.split())
    assert ("--plot" in command) == (tmp_path / "c.svg").exists()
