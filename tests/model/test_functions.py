"""Steps of a policy that are functions: what may be one, who may know what, and which theory is left."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import taciturn
from taciturn import Cost, Guarantee, Network, Plant, Policy, ProblemError, Trigger, close
from taciturn.analyse.renewal import bound_rate, solve_renewal
from taciturn.analyse.switched import switched
from taciturn.errors import InformationError
from taciturn.model.packets import fingerprint
from taciturn.model.steps import Apply, Assign, Decide, Received, Send, Step
from taciturn.model.theory import Theory
from taciturn.model.trigger import Form
from taciturn_limits.bounds import bound_below

PLANT = Plant([[0.9, 0.1], [0.0, 0.8]], [[0.0], [1.0]], np.eye(2))
COST = Cost(np.eye(2), [[1.0]])
SITES = (frozenset[str]({"sensor", "controller"}),)


def bent(y: Any) -> Any:
    """Return a command."""
    return -np.tanh(y[:1])


BEND = Apply("controller", {"command": 1}, bent, ("y",))
DECIDE = Decide("controller", "send", Trigger({"silent": Form(("command",), np.eye(1)), "send": Form(constant=0.1)}))
SEND = Send("controller", "actuator", ("command",), "send")
INPUT = Assign("actuator", "input", ({"input": np.eye(1)}, {"command": np.eye(1)}), Received("actuator"))


NOTHING = Theory()


def make(*steps: Step, theory: Theory = NOTHING) -> Policy:
    """Return a policy of these steps."""
    return Policy("hand-made", steps, PLANT, theory, SITES)


def test_a_function_is_simulated_traced_and_run() -> None:
    """Average and trajectory of a loop whose command is bent."""
    loop = close(PLANT, make(BEND, DECIDE, SEND, INPUT), None, COST)
    path = taciturn.simulate(loop, steps=50, seed=3)
    sent = path.sends["actuator"]
    assert 0 < sent.sum() < 50
    np.testing.assert_allclose(path.input[sent, 0], -np.tanh(path.state[sent, 0]), rtol=1e-15)
    assert taciturn.average(loop, steps=20_000).cost.value > 0


@pytest.mark.parametrize(("make_step", "message"), [
    (lambda: Apply("controller", {}, bent, ("y",)), "a function at the node controller has no results; expected the"),
    (lambda: Apply("controller", {"f": 0}, bent, ("y",)), "the number of entries of f is 0; expected a whole number"),
    (lambda: Apply("controller", {"f": 1}, 3.0, ("y",)), "the function that computes f is 3.0; expected a Python"),
    (lambda: Apply("controller", {"f": 1}, bent, ()), r"the function that computes f reads \(\); expected a tuple"),
    (lambda: Apply("controller", {"f": 1}, bent, "y"), "the function that computes f reads 'y'; expected a tuple"),
])  # fmt: skip
def test_what_is_no_function_is_refused(make_step: Callable[[], object], message: str) -> None:
    """Nothing to compute, nothing to compute it with, or nothing to compute it of."""
    with pytest.raises(ProblemError, match=message):
        make_step()


@pytest.mark.parametrize(("steps", "message"), [
    ((Apply("controller", {"command": 1}, bent, ("z",)), INPUT), "the signal 'z' is never assigned"),
    ((BEND, Apply("controller", {"command": 2}, bent, ("y",)), INPUT), "command has 1 entry in one step and 2 in"),
    ((Apply("controller", {"one": 1}, bent, ("y",)), INPUT), "a policy step assigns 'one', but this name denotes the"),
    ((Apply("actuator", {"input": 2}, bent, ("input",)),), "input has 2 entries; expected a signal with 1 entry"),
])  # fmt: skip
def test_a_function_that_does_not_fit_is_refused(steps: tuple[Step, ...], message: str) -> None:
    """As a linear step is."""
    with pytest.raises(ProblemError, match=message):
        make(*steps)


def test_a_node_gives_a_function_what_it_holds() -> None:
    """Not the signals of another place, and not those that another place assigns."""
    with pytest.raises(
        InformationError, match="the node actuator reads the signal 'command', which is not available there"
    ):
        close(PLANT, make(BEND, Apply("actuator", {"input": 1}, bent, ("command",))), None, COST)
    twice = Apply("actuator", {"command": 1}, bent, ("input",))
    with pytest.raises(
        InformationError,
        match="the signal command is assigned at the node actuator and at another site; expected only one site",
    ):
        close(PLANT, make(BEND, DECIDE, SEND, INPUT, twice), None, COST)


def test_a_function_that_cannot_be_traced_is_refused_when_the_loop_runs() -> None:
    """With its name."""

    def chooses(y: Any) -> Any:
        return y[:1] if y[0] > 0 else -y[:1]

    policy = make(Apply("controller", {"command": 1}, chooses, ("y",)), DECIDE, SEND, INPUT)
    with pytest.raises(ProblemError, match=r"chooses needs the truth value of a condition .*expected np\.where"):
        taciturn.average(close(PLANT, policy, None, COST), steps=1000)


def test_theory_of_linear_steps_is_not_claimed_of_a_function() -> None:
    """Neither a guarantee nor a certificate."""
    with pytest.raises(
        ProblemError, match="computes command with a Python function, but its theory states guarantee, which holds for"
    ):
        make(BEND, DECIDE, SEND, INPUT, theory=Theory(COST, guarantee=Guarantee(1.0, "a claim", "gommans2017")))
    loop = close(PLANT, make(BEND, DECIDE, SEND, INPUT), None, COST)
    with pytest.raises(ProblemError, match="hand-made computes command by a function, which certificates do not"):
        switched(loop)
    for ask in (solve_renewal, lambda given: bound_below(given, 0.2)):
        with pytest.raises(ProblemError, match="expected"):
            ask(loop)
    assert bound_rate(loop) is None


def test_a_fingerprint_knows_a_function_by_what_it_returns() -> None:
    """However it is written, and not by where it stands in memory."""

    def alike(y: Any) -> Any:
        return np.array([-np.sinh(y[0]) / np.cosh(y[0])])

    def other(y: Any) -> Any:
        return -np.tanh(1.001 * y[:1])

    found = [
        fingerprint(make(Apply("controller", {"command": 1}, function, ("y",)), DECIDE, SEND, INPUT), Network())
        for function in (bent, alike, other)
    ]
    assert found[0] == found[1] != found[2]
