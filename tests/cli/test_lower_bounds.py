"""Lower bounds, verdicts and the best schedule as a user of the command line meets them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from cli.conftest import COST, POLICY, Run, Write

import taciturn
from taciturn import ProblemError
from taciturn.model.theory import LowerBound
from taciturn_studies.tradeoff import Point, Tradeoff

EXCESS = '[policy]\nkind = "excess"\ntheta = 0.5\nactuation = "model"\n'
OPTIMAL = '[policy]\nkind = "optimal"\nprice = 0.1\n'
SHORT = ("--standard-error", "1e-4")


def wide(states: int) -> str:
    """Return the table of a plant of so many states."""
    A = (0.9 * np.eye(states) + 0.2 * np.eye(states, k=1)).tolist()
    return f"[plant]\nA = {A}\nB = {np.eye(states).tolist()}\nW = {np.eye(states).tolist()}\ndt = 1.0\n"


def weights(states: int) -> str:
    """Return the table of its cost."""
    return f"[cost]\nQ = {np.eye(states).tolist()}\nR = {np.eye(states).tolist()}\n"


def number_after(line: str, words: str) -> float:
    """Return the number that follows some words."""
    return float(line.partition(words)[2].split()[0])


@pytest.mark.evidence
def test_evaluate_prints_a_lower_bound_and_a_verdict(run: Run, write: Write) -> None:
    """What is sent, what it costs, and the proofs on both sides are those of the document."""
    file = write(policy=EXCESS)
    answer, document = run("evaluate", file), json.loads(run("evaluate", file, "--json").out)
    assert answer.code == 0
    lines = {line[:14].strip(): line[15:] for line in answer.unwrapped.splitlines()}
    assert lines["no schedule"].startswith("of this controller at this rate costs less than ")
    assert lines["no schedule"].endswith(" more (99.9 % sure)")
    (least,) = [line.split() for line in answer.out.splitlines() if line.startswith("lower bound, any schedule")][:1]
    assert float(least[4]) == pytest.approx(document["cost_lower_bound"], rel=1e-5)
    base, verdict = document["cost_all_time"], " ".join(answer.out.partition("\n\n")[0].split())
    assert verdict == document["verdict"]
    assert float(verdict.split()[0]) == pytest.approx(100 * document["rates"]["actuator"]["value"], rel=6e-3)
    above = 100 * (np.array([document["cost"]["value"], document["cost_lower_bound"]]) / base - 1)
    assert number_after(verdict, "packets, ") == pytest.approx(above[0], rel=6e-2)
    assert number_after(lines["no schedule"], "costs less than ") == pytest.approx(above[1], rel=6e-2)
    at_most = 100 * (document["cost_bound_at_rate"] / base - 1)
    assert number_after(verdict, "at most ") == pytest.approx(at_most, rel=6e-2)
    assert base < document["cost_lower_bound"] <= document["cost"]["value"] <= document["cost_bound_at_rate"]
    low, high = document["rate_bounds"]
    assert low < document["rates"]["actuator"]["value"] < high


@pytest.mark.evidence
def test_a_tradeoff_prints_and_draws_the_lower_bounds_that_exist() -> None:
    """Next to a point without one; the figure has none if the bounds belong to controllers that differ."""
    masses = taciturn.load("two-mass")
    pair = [taciturn.evaluate(masses.changed({"theta": theta}), steps=2000) for theta in (0.1, 1.0)]
    pair[0] = replace(pair[0], lower_bound=LowerBound(0.7345678, 0.999, 0.2, 0.01))
    found = Tradeoff(tuple(Point({"theta": k}, one) for k, one in enumerate(pair)), {}, "step", None)
    assert [row["no_schedule_below"] for row in found.records()] == [0.734567, None]
    text = str(found)
    assert "+0.14 %" in text  # 0.1486 %, rounded down
    assert "a figure shows" not in text
    sure = "no schedule of this controller (99.9 % confidence)"
    assert sure in [text.get_text() for text in found.plot().axes[0].texts]
    other = replace(pair[1], cost_all_time=0.5)
    mixed = replace(found, points=(found.points[0], Point({"theta": 1}, other)))
    assert "a figure shows no lower bounds" in str(mixed)
    assert sure not in [text.get_text() for text in mixed.plot().axes[0].texts]


@pytest.mark.evidence
def test_the_document_has_a_lower_bound_where_there_is_one(run: Run, write: Write) -> None:
    """By default of a policy that resets an error, with the confidence that is asked for, and never at 0."""
    file = write(policy=EXCESS)
    usual = json.loads(run("evaluate", file, "--json").out)
    assert usual["cost_lower_bound_confidence"] == 0.999
    asked = json.loads(run("evaluate", file, "--confidence", "0.9", "--json").out)
    assert asked["cost_lower_bound_confidence"] == 0.9
    none = run("evaluate", file, "--confidence", "0", "--json")
    assert none.code == 0
    assert not {"cost_lower_bound", "cost_lower_bound_confidence"} & set(json.loads(none.out))
    held = run("evaluate", write(policy=POLICY), *SHORT, "--json")
    assert held.code == 0
    assert "cost_lower_bound" not in json.loads(held.out)
    assert "no schedule" not in run("evaluate", file, "--confidence", "0").out


@pytest.mark.parametrize(
    ("policy", "arguments", "words"),
    [
        (
            POLICY,
            ["--confidence", "0.99"],
            "a lower bound requires that a send resets the error that determines the cost, but a send of lqg does not",
        ),
        (EXCESS, ["--confidence", "1"], "--confidence is 1; expected 0 < --confidence < 1"),
        (EXCESS, ["--confidence", "-0.5"], "confidence is -0.5"),
        (
            OPTIMAL,
            ["--method", "simulation"],
            "optimal' is computed numerically, not simulated; expected neither",
        ),
        (OPTIMAL, ["--steps", "100000"], "the policy 'optimal' is computed numerically, not simulated"),
        ('[policy]\nkind = "optimal"\nprice = 0.0\n', [], "price is 0"),
        ('[policy]\nkind = "near-optimal"\nprice = 1e6\n', [], "errors are sent less than once in 5000 checks"),
        ('[policy]\nkind = "excess"\n', [], "neither delta nor theta is given"),
        ('[policy]\nkind = "excess"\ndelta = 1.0\ntheta = 1.0\n', [], "delta (1) and theta (1) are both given"),
    ],
)
def test_what_has_no_bound_or_no_answer_is_one_sentence(
    run: Run, write: Write, policy: str, arguments: list[str], words: str
) -> None:
    """Exit code 2, nothing else printed."""
    stable = "[plant]\nA = [[0.5]]\nB = [[1.0]]\nW = [[0.01]]\ndt = 1.0\n"
    assert words in run("evaluate", write(plant=stable, policy=policy), *arguments).sentence


def test_the_best_schedule_is_solved_and_is_no_loop_of_nodes(run: Run, write: Write) -> None:
    """Evaluated by quadrature; a design for nodes, a certificate and a simulation name what to ask for instead."""
    file = write(policy=OPTIMAL)
    document = json.loads(run("evaluate", file, "--json").out)
    assert document["policy"] == "optimal"
    assert document["cost"]["method"] == "quadrature"
    assert document["steps"] == 0
    assert document["cost_all_time"] < document["cost_lower_bound"]
    assert document["cost_lower_bound"] <= document["cost"]["value"] + document["cost"]["error"]
    problem = taciturn.load(file)
    with pytest.raises(
        ProblemError, match="a boundary that nodes cannot evaluate, so it can only be analysed; expected near-opti"
    ):
        problem.design()
    with pytest.raises(ProblemError):
        problem.close(problem.designed())
    for command in (("certify", file), ("simulate", file), ("show", file, "--wire"), ("export", file, "--c", "out")):
        assert "expected near-optimal" in run(*command).sentence  # and no packets of another policy are described


def test_the_best_schedule_of_jumps_is_refused_by_its_design(run: Run, write: Write) -> None:
    """Every command says the same: none shows a design that cannot be solved."""
    jumps = "[plant]\nA = [[0]]\nB = [[1]]\n[plant.jumps]\nrate = 2\ncovariance = [[0.5]]\n"
    file = write(plant=jumps, policy=OPTIMAL + "period = 0.2\n")
    told = {run(command, file).sentence.partition(": ")[2] for command in ("show", "evaluate", "simulate")}
    assert told == {
        "the noise consists of jumps; expected Gaussian noise for the policy kind 'optimal', or the kind 'near-optimal'"
    }


@pytest.mark.evidence
def test_four_states_have_no_best_schedule_and_a_nearly_best_one(run: Run, write: Write) -> None:
    """Refused with the name of what serves any number, which answers."""
    answer = run("evaluate", write(plant=wide(4), cost=weights(4), policy='[policy]\nkind = "optimal"\nprice = 9.0\n'))
    assert "near-optimal" in answer.sentence
    nearly = write(plant=wide(4), cost=weights(4), policy='[policy]\nkind = "near-optimal"\nprice = 9.0\n')
    found = json.loads(run("evaluate", nearly, "--standard-error", "2e-2", "--json").out)
    assert found["cost_all_time"] < found["cost_lower_bound"]
    assert found["cost_lower_bound"] <= found["cost"]["value"] + 4 * found["cost"]["standard_error"]


def test_a_problem_of_its_own_cost_is_the_one_that_is_bounded(run: Run, write: Write) -> None:
    """Ten times the weights: ten times the bound."""
    once = json.loads(run("evaluate", write(policy=EXCESS), "--json").out)["cost_lower_bound"]
    tenfold = COST.replace("1.0", "10.0").replace("2.0", "20.0")
    more = json.loads(run("evaluate", write(cost=tenfold, policy=EXCESS), "--json").out)["cost_lower_bound"]
    assert more == pytest.approx(10 * once, rel=1e-6)
