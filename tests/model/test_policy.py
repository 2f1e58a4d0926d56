"""Policies are data, and data that do not fit together are refused when the policy is made."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from taciturn import Cost, Estimate, Guarantee, Plant, Policy, ProblemError, Trigger, average, close, load
from taciturn.model.steps import Acknowledged, Assign, Decide, Draw, Evaluate, Location, Received, Send, Step
from taciturn.model.theory import ClosedForm, Theory
from taciturn.model.trigger import Form, Scheduled

PLANT = Plant([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], 0.01 * np.eye(2))
L = np.array([[-1.0, -1.5]])
ONE = np.eye(1)
COMMAND = Assign("controller", "command", {"y": L})
TRIGGER = Trigger({"silent": Form(("command",), ONE), "send": Form(constant=1.0)})
DECIDE = Decide("controller", "send", TRIGGER)
SEND = Send("controller", "actuator", ("command",), "send")
INPUT = Assign("actuator", "input", ({"input": ONE}, {"command": ONE}), Received("actuator"))
STEPS: tuple[Step, ...] = (COMMAND, DECIDE, SEND, INPUT)


def make(steps: tuple[Step, ...] = STEPS, **more: Any) -> Policy:
    """Return a policy that sends the command when it is large."""
    return Policy("large", steps, PLANT, **more)


def refusal(action: Callable[[], object]) -> str:
    """Return the sentence with which an action is refused."""
    with pytest.raises(ProblemError) as found:
        action()
    return str(found.value)


def test_a_policy_knows_its_signals_and_decisions() -> None:
    """Sizes follow from the matrices, outcomes from the triggers."""
    policy = make()
    assert policy.sizes == {"one": 1, "y": 2, "command": 1, "input": 1}
    assert policy.decisions == {"send": TRIGGER}
    assert (policy.outcomes("send"), policy.outcomes(Received("actuator")), TRIGGER.reads) == (2, 2, ("command",))


TRANSPOSED = Assign("controller", "command", {"y": L.T})
AT_TWO = Assign("controller", "command", {"y": Scheduled("clock", [L, L])})
CLOCK = Location("clock", np.array([1, 0]))
WRONG: list[tuple[tuple[Step, ...], dict[str, Any], str]] = [
    (
        (TRANSPOSED, *STEPS[1:]),
        {},
        "the weight of y in command has shape (2, 1); expected 2 columns, one for each entry of y. Did you",
    ),
    (
        (Assign("controller", "command", {"y": ONE}), *STEPS[1:]),
        {},
        "the weight of y in command has shape (1, 1); expected 2",
    ),
    ((DECIDE, SEND, INPUT), {}, "the signal 'command' is never assigned; expected one of the signals ['input'"),
    (
        (COMMAND, SEND, INPUT),
        {},
        "the condition 'send' is used before it is decided; expected one of the earlier decisions []",
    ),
    (
        (COMMAND, SEND, DECIDE, INPUT),
        {},
        "the condition 'send' is used before it is decided; expected one of the earlier decisions []",
    ),
    (
        (COMMAND, Assign("controller", "held", ({"held": ONE},) * 3, "send"), DECIDE),
        {},
        "the condition 'send' is used before",
    ),
    (
        (COMMAND, DECIDE, Assign("controller", "held", ({"held": ONE},) * 3, "send")),
        {},
        "the step that computes held has 3 branches; expected 2 branches, one for each outcome of send",
    ),
    (
        (*STEPS, Evaluate("controller", "memory", (Form(constant=1.0),) * 3, Received("actuator"))),
        {},
        "the step that computes memory has 3 branches; expected 2 branches, one for each outcome of Received(",
    ),
    (
        STEPS[:3],
        {},
        "the signal input is never assigned; expected a signal with 1 entry that is assigned at the node",
    ),
    (
        (Assign("actuator", "input", {"y": np.eye(2)}),),
        {},
        "the signal input has 2 entries; expected a signal with 1 entry that is assigned at the node",
    ),
    (
        (COMMAND, Assign("controller", "command", {"y": np.eye(2)}), *STEPS[1:]),
        {},
        "the signal command has 1 entry in one step and 2 in another; expected equal sizes",
    ),
    (
        (COMMAND, Decide("controller", "send", Trigger({"a": Form(("y",), ONE), "b": Form()})), SEND, INPUT),
        {},
        "the matrix Psi for the signals ('y',) has shape (1, 1); expected the shape (2, 2)",
    ),
    (
        (*STEPS, Evaluate("controller", "sum", (Form(plus={"y": 1.0}),))),
        {},
        "the signal y has 2 entries; expected a scalar signal",
    ),
    (
        (COMMAND, DECIDE, Send("controller", "actuator", ("comand",), "send"), INPUT),
        {},
        "the signal 'comand' is never assigned; expected one of the signals ['command', 'input', 'one', 'y']",
    ),
    (
        (COMMAND, DECIDE, Send("controller", "actuator", ("command",), "send", ("sent",)), INPUT),
        {},
        "the packet of the actuator link is sent for the label 'sent'; expected a label of its decision (send)",
    ),
    (
        (COMMAND, Send("controller", "actuator", ("command",), None, ("send",)), INPUT),
        {},
        "the packet of the actuator link is sent for the label 'send'; expected a label of its decision (None)",
    ),
    (
        (COMMAND, DECIDE, SEND, Send("controller", "actuator", ("command",)), INPUT),
        {},
        "a step sends 2 packets over the actuator link; expected a single Send with the signals and labels of all "
        "these packets",
    ),
    (
        (AT_TWO, *STEPS[1:]),
        {},
        "a table has 2 entries selected by the location 'clock', but the policy has only []; expected one entry per "
        "state",
    ),
    (
        (AT_TWO, *STEPS[1:]),
        {"locations": (Location("clock", np.array([1, 2, 0])),)},
        "a table has 2 entries selected by the location 'clock', but it has 3 states; expected one entry per state",
    ),
    (
        STEPS,
        {"locations": (Location("mode", np.zeros((2, 3)), "controller", "send"),)},
        "the table of the location mode has 3 columns; expected 2 columns, one for each outcome of send",
    ),
    (
        STEPS,
        {"locations": (Location("mode", np.zeros((2, 2)), "controller", "query"),)},
        "the condition 'query' is not a decision; expected one of the decisions ['send']",
    ),
    (STEPS, {"initial": {"nothing": [1.0]}}, "the signal 'nothing' is never assigned; expected one of"),
    (STEPS, {"initial": {"input": [1.0, 2.0]}}, "initial input has shape (2,); expected the shape (1,)"),
    (STEPS, {"tick": 0.0}, "tick is 0; expected 0 < tick"),
    (STEPS, {"tick": np.nan}, "tick is nan; expected a finite number"),
    (
        STEPS,
        {"theory": Theory(cost_all_time=np.nan)},
        "the cost of sending every sample of the policy large is nan; expected a finite number: scale the problem",
    ),
    (
        STEPS,
        {"theory": Theory(guarantee=Guarantee(np.inf, "J ≤ ∞", "none"))},
        "the guaranteed cost of the policy large is inf; expected a finite",
    ),
    (
        STEPS,
        {"theory": Theory(closed_form=ClosedForm(np.inf, {}))},
        "the cost of the policy large is inf; expected a finite number",
    ),
]


@pytest.mark.parametrize(("steps", "more", "sentence"), WRONG, ids=lambda value: str(value)[:30])
def test_a_policy_that_does_not_fit_together_is_refused(
    steps: tuple[Step, ...], more: dict[str, Any], sentence: str
) -> None:
    """Signals, conditions, labels, tables and costs are checked against one another."""
    told = refusal(lambda: make(steps, **more))
    assert told.startswith(sentence)
    assert ("transpose" in told) == ("Did you" in sentence)


def test_a_scheduled_gain_is_read_by_a_location_of_its_size() -> None:
    """The legal counterpart of the refusals above."""
    assert make((AT_TWO, *STEPS[1:]), locations=(CLOCK,)).locations == (CLOCK,)


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        (
            lambda: Assign("controller", "u", ()),
            "the step that computes u has 0 branches and the condition None; expected one branch without a condition",
        ),
        (
            lambda: Assign("controller", "u", ({"y": L}, {"y": L})),
            "the step that computes u has 2 branches and the condition None; expected one branch without a",
        ),
        (
            lambda: Assign("controller", "u", {"y": L}, Received("sensor")),
            "the step that computes u has 1 branch and the condition Received(link='sensor'); expected one branch",
        ),
        (
            lambda: Assign("controller", "u", {"y": L, "x": np.eye(2)}),
            "the matrices that compute u have [1, 2] rows; expected equal",
        ),
        (
            lambda: Assign("controller", "u", {"y": [1.0]}),
            "the weight of y in u has shape (1,); expected the shape (any, any)",
        ),
        (
            lambda: Assign("controller", "u", {"y": [[np.inf]]}),
            "the weight of y in u contains the number inf at index (0, 0)",
        ),
        (
            lambda: Assign("controller", "u", {"y": Scheduled("clock", [1.0, 2.0])}),
            "the weight of y in u is a table of numbers; expected a table of matrices",
        ),
        (
            lambda: Evaluate("controller", "s", (Form(), Form())),
            "the step that computes s has 2 forms and the condition None; expected one form without a",
        ),
        (
            lambda: Evaluate("controller", "s", (Form(),), "send"),
            "the step that computes s has 1 form and the condition send; expected one form without a",
        ),
        (lambda: Trigger({}), "a trigger has the options []; expected at least two"),
        (lambda: Trigger({"send": Form()}), "a trigger has the options ['send']; expected at least two"),
        (
            lambda: Form(("y",)),
            "a quadratic form has signals ('y',) without Psi; expected Psi and signals, or neither of them",
        ),
        (
            lambda: Form(Psi=ONE),
            "a quadratic form has Psi without signals; expected Psi and signals, or neither of them",
        ),
        (
            lambda: Form(("y",), [[1, 2], [3, 4]]),
            "the matrix Psi for the signals ('y',) is not symmetric; expected a symmetric matrix",
        ),
        (
            lambda: Form(("y",), [[1, 2]]),
            "the matrix Psi for the signals ('y',) is not symmetric; expected a symmetric matrix",
        ),
        (
            lambda: Form(("y",), [[np.nan]]),
            "Psi contains the number nan at index (0, 0); expected an array of finite numbers",
        ),
        (
            lambda: Form(("y",), Scheduled("clock", [[[1, 2], [3, 4]]])),
            "the matrix Psi for the signals ('y',) is not symmetric; expected a symmetric matrix",
        ),
        (lambda: Form(("y",), Scheduled("clock", [1.0])), "Psi is a table of numbers; expected a table of matrices"),
        (lambda: Form(constant=np.nan), "the constant of a form is nan; expected a finite number"),
        (
            lambda: Form(constant=Scheduled("clock", [ONE])),
            "the constant indexed by 'clock' is a table of matrices; expected a",
        ),
        (lambda: Form(plus={"s": np.inf}), "the weight of s is inf; expected a finite number"),
        (
            lambda: Scheduled("clock", []),
            "the table indexed by 'clock' has shape (0,); expected the shape (locations,) or (locations, rows",
        ),
        (
            lambda: Scheduled("clock", [[1.0]]),
            "the table indexed by 'clock' has shape (1, 1); expected the shape (locations,) or",
        ),
        (
            lambda: Scheduled("clock", [1.0, np.nan]),
            "the table indexed by 'clock' contains the number nan at index (1,); expected an array of finite",
        ),
        (lambda: Scheduled("clock", [[1.0], [1.0, 2.0]]), "the table indexed by 'clock' is not an array of numbers ("),
        (
            lambda: Location("clock", np.array([1, 2])),
            "the table of location clock has entries from 1 to 2; expected integers that",
        ),
        (
            lambda: Location("clock", np.array([-1, 0])),
            "the table of location clock has entries from -1 to 0; expected integers",
        ),
        (
            lambda: Location("clock", np.array([0.5, 0])),
            "the table of location clock has entries from 0 to 0.5; expected integers",
        ),
        (
            lambda: Location("clock", np.array([])),
            "the table of location clock has no entries; expected integers that are at least 0 and below 0",
        ),
        (
            lambda: Location("clock", np.zeros((2, 2))),
            "the table of location clock has shape (2, 2); expected the shape (any,)",
        ),
        (
            lambda: Location("mode", np.zeros(2), "controller", "send"),
            "the table of location mode has shape (2,); expected the shape (any, any) = (locations, outcomes)",
        ),
        (
            lambda: Location("clock", np.array([0]), initial=1),
            "location clock starts at 1; expected an integer that is at least 0 and below 1",
        ),
        (
            lambda: Location("mode", np.zeros((2, 2)), on="send"),
            "location mode depends on send but has no node; expected the node at which the location changes",
        ),
    ],
    ids=lambda value: value[:50] if isinstance(value, str) else "",
)
def test_a_part_of_a_policy_that_does_not_fit_is_refused(action: Callable[[], object], sentence: str) -> None:
    """Steps, triggers, forms, tables and locations are checked when they are made."""
    assert refusal(action).startswith(sentence)


def test_what_a_policy_holds_is_frozen_and_its_own() -> None:
    """Matrices, tables and first values can be neither written to nor changed from outside."""
    gain, Psi, table, start = np.array(L), np.eye(1), np.array([1, 0]), np.ones(1)
    step = Assign("controller", "command", {"y": gain})
    policy = make((step, *STEPS[1:]), initial={"input": start})
    kept = (
        (step.branches[0]["y"], gain),
        (Form(("u",), Psi).Psi, Psi),
        (Location("clock", table).table, table),
        (Scheduled("clock", start).values, start),
        (policy.initial["input"], start),
    )
    for held, given in kept:
        assert isinstance(held, np.ndarray)
        assert not np.shares_memory(held, given)
        with pytest.raises(ValueError, match="read-only"):
            held[...] = 7


def test_a_form_is_symmetrised_and_says_what_it_reads() -> None:
    """Rounding in Psi is taken out; scalar signals that are added count as read."""
    form = Form(("y",), [[1.0, 0.5], [0.5 + 1e-12, 1.0]], plus={"memory": -1.0})
    assert isinstance(form.Psi, np.ndarray)
    np.testing.assert_array_equal(form.Psi, form.Psi.T)
    assert form.reads == ("y", "memory")


def test_sites_gather_nodes() -> None:
    """A node without neighbours is alone at its site."""
    policy = make(sites=(frozenset({"sensor", "controller"}),))
    assert policy.site("sensor") == policy.site("controller") == {"sensor", "controller"}
    assert policy.site("actuator") == {"actuator"}


def test_a_guarantee_depends_on_the_rate_where_it_says_so() -> None:
    """J ≤ base + per_silence·(1 − rate), or nothing."""
    assert Guarantee(2.0, "J", "x").at_rate(0.5) is None
    assert Guarantee(2.0, "J", "x", base=1.0, per_silence=0.8).at_rate(0.25) == pytest.approx(1.6)


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.7441234, 0.0, "0.744123"),
        (0.7441234, 0.00034, "0.74412 ± 0.00034"),
        (12345.6, 7.0, "12345.6 ± 7.0"),
        (12345.6, 120.0, "12346 ± 120"),
        (7.3e99, 1.4e96, "7.3000e+99 ± 1.4e+96"),
        (7.3e-101, 1.4e-104, "7.3000e-101 ± 1.4e-104"),
    ],
)
def test_an_estimate_is_shown_with_the_digits_its_error_supports(value: float, error: float, text: str) -> None:
    """Never a hundred digits."""
    assert str(Estimate(value, error, "simulation")) == text


def test_the_conditions_are_values() -> None:
    """Two conditions on one link are the same condition; a draw is a scalar signal."""
    assert Received("sensor") == Received("sensor") != Acknowledged("sensor")
    assert make((*STEPS, Draw("controller", "draw"))).sizes["draw"] == 1


def test_the_weight_of_silence_has_its_former_name() -> None:
    """``Reset.square``, which policies of one's own may read."""
    reset = load("two-mass").design().theory.reset
    assert reset is not None
    assert reset.square is reset.weight


def test_a_policy_without_theory_is_run_and_claims_nothing() -> None:
    """Its cost of sending every sample is unknown, which text and loop accept, and a reader of the number is told."""
    policy = make(sites=(frozenset({"sensor", "controller"}),))
    assert (policy.cost, policy.guarantee, policy.theory.cost_all_time) == (None, None, None)
    assert str(policy).startswith("large\n")
    told = refusal(lambda: policy.cost_all_time)
    assert told.startswith(
        "the cost of sending every sample is unknown for the policy large; expected Theory(cost_all_time=…)"
    )
    found = average(close(PLANT, policy, cost=Cost(np.eye(2), ONE)), steps=20_000)
    assert 0 < found.rates["actuator"].value < 1


def test_the_links_on_which_a_decision_sends_follow_from_the_steps() -> None:
    """Without a decision, they are all links."""
    always = (COMMAND, Send("controller", "actuator", ("command",)), INPUT)
    assert make().scheduled == make(always).scheduled == ("actuator",)
    both = (Send("sensor", "sensor", ("y",)), *STEPS)
    assert make(both).scheduled == ("actuator",)


def test_a_memory_that_starts_at_minus_zero_starts_at_zero() -> None:
    """A program merges states that start equal, such as one at −0.0 with one at 0.0, and a node may not."""
    start = make(STEPS, initial={"input": [-0.0]}).initial["input"]
    assert not np.signbit(start).any()
    assert not start.flags.writeable
