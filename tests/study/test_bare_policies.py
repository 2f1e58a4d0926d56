"""Studies of a policy without a problem, and of a function that returns the policy for its parameters."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import taciturn
from taciturn import Cost, Network, Plant, Policy, Problem, ProblemError, design
from taciturn.problem.without_file import as_problem
from taciturn.study.record import fingerprint

MOTOR = Plant([[1.0, 0.1], [0.0, 0.9]], [[0.005], [0.1]], np.diag([0.0, 0.01]))
COST = Cost(np.diag([1.0, 0.1]), [[0.1]])


def rule(theta: float) -> Policy:
    """Return the policy of a parameter."""
    return design.lqg(MOTOR, COST, theta=theta)


def named(**parameters: float) -> Problem:
    """Return the same as a problem."""
    return Problem(MOTOR, COST, Network(), "lqg", parameters)


@pytest.mark.evidence
def test_a_policy_gives_the_numbers_of_its_problem() -> None:
    """Evaluation, certificates, a trajectory and the code are those of the problem with this policy."""
    policy, problem = rule(0.5), named(theta=0.5)
    found, known = (taciturn.evaluate(one, steps=20_000).document() for one in (policy, problem))
    assert {**found, "seconds": 0} == {**known, "seconds": 0}
    assert str(taciturn.certify(policy)) == str(taciturn.certify(problem))
    loop = problem.close(problem.design())
    assert (taciturn.simulate(policy, 30).state == taciturn.simulate(loop, 30).state).all()


@pytest.mark.evidence
def test_a_function_gives_the_numbers_of_its_problem() -> None:
    """Tuning starts at the default of its parameter; percentages, sweeps and trade-offs are the same."""
    for budget in ({"rate": 0.3}, {"rate": "30%"}, {"cost": "+20%"}):
        found, known = (taciturn.tune(one, standard_error=0.01, **budget) for one in (rule, named(theta=1.0)))
        assert found.parameter == known.parameter, budget
    over = {"theta": [0.5, 1.0]}
    found, known = (taciturn.sweep(one, over, steps=2000) for one in (rule, named(theta=1.0)))
    assert (found.cost == known.cost).all()
    found, known = (taciturn.tradeoff(one, over, standard_error=0.01) for one in (rule, named(theta=1.0)))
    assert [point.evaluation.cost for point in found.points] == [point.evaluation.cost for point in known.points]


@pytest.mark.evidence
def test_a_function_is_compared_with_a_kind() -> None:
    """At the same rate."""
    clock = Problem(MOTOR, COST, Network(), "periodic", {"every": 3})
    found = taciturn.compare({"mine": rule, "clock": clock}, rate=1 / 3, standard_error=0.01)
    assert {one.name for one in found.ranking} == {"mine", "clock"}


def test_a_policy_is_exported(tmp_path: Path) -> None:
    """As C, equal to that of the problem."""
    for name, one in (("bare", rule(0.5)), ("named", named(theta=0.5))):
        taciturn.export_c(one, tmp_path / name)
    for path in (tmp_path / "named").glob("*.c"):
        assert path.read_bytes() == (tmp_path / "bare" / path.name).read_bytes()


def test_results_of_different_policies_have_different_digests() -> None:
    """The digest covers the steps of a policy."""
    assert len({fingerprint(as_problem("problem", rule(theta))) for theta in (0.1, 0.2)}) == 2


def nothing(theta: float) -> float:
    """Return no policy."""
    return theta


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (
            lambda _: taciturn.evaluate(rule),
            "policy.theta is missing; expected this parameter, which the policy kind lqg requires",
        ),
        (lambda _: taciturn.evaluate(nothing), "problem is a function that returns 1; expected"),  # type: ignore
        (lambda _: taciturn.evaluate("two-mass"), r"expected a Problem \(taciturn.load reads one"),  # type: ignore
        (lambda _: taciturn.evaluate(taciturn.load("double-integrator").design()), "cost refers to a continuous plant"),
        (lambda _: taciturn.tune(rule(1.0), rate=0.3), "expected a function that returns the policy for a parameter"),
        (lambda path: taciturn.sweep(rule, {"theta": [1.0]}, store=path), "the policy comes from Python code"),
        (lambda _: taciturn.sweep(rule, {"plant.dt": [1.0]}), "plant.dt cannot be changed"),
    ],
)
def test_what_cannot_be_had_is_refused(ask: Callable[[Path], object], words: str, tmp_path: Path) -> None:
    """In one sentence."""
    with pytest.raises(ProblemError, match=words):
        ask(tmp_path)
