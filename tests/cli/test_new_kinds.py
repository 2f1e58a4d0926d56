"""``taciturn new``: every policy kind, and PID controllers that are kept."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli.conftest import Ask

import taciturn
from taciturn.design.catalogue import CATALOGUE

STEP = ("discrete", "0.5", "1.1", "1", "all", "0", "0.3", "lqg", "0.7", "1", "none")  # a scalar, up to the policy
ORDINARY = ("periodic", "remote-lqg", "consistent", "mixed", "downsampled", "stochastic")  # one of each sort


def test_a_pid_controller_in_place_of_weights_is_kept(ask: Ask) -> None:
    """With weights by its loop, and only the kinds that keep a controller."""
    plant = ("d", "0.1", "[1 0.1; 0 0.9]", "[0; 0.1]", "1", "0.03", "inputs 0.2", "pid")
    told = ask((*plant, "1.2 0.15 1 0.5", "none", "1", "0.1"))
    assert told.code == 0
    assert "lqg" not in told.out.partition("What is the goal")[0].rpartition("excess")[2]
    problem = taciturn.load("new.toml")
    assert (problem.kind, problem.controller) == ("excess", taciturn.PID(1.2, 0.15, 1.0, 0.5))
    assert problem.designed().cost_all_time == pytest.approx(2.0)  # one for each variance
    Path("new.toml").unlink()
    told = ask((*plant, "1.2 0.15 1"))
    assert (told.code, "the controller has 3 numbers; expected kp, or kp ki" in told.err) == (2, True)


@pytest.mark.parametrize(
    "kind",
    [
        kind if kind in ORDINARY else pytest.param(kind, marks=pytest.mark.evidence)
        for kind in sorted(set(CATALOGUE) - {"integral"})  # whose fixed point takes seconds
    ],
)
def test_every_kind_can_be_asked_for(ask: Ask, kind: str) -> None:
    """``new`` asks for every required parameter, and designs the policy before it writes the file."""
    continuous = kind == "consistent"
    plant = ("c", "0", "1", "all", "0", "1", "lqg", "1", "1", "none") if continuous else STEP
    plant = (*STEP[:-1], "nodes", "0", "1") if kind == "distributed" else plant
    answers = {"mixed": ("", "0.3"), "downsampled": ("", "", "0.3")}  # the others: numbers without a usual value
    answers |= dict.fromkeys(("absolute", "send-on-delta", "variance"), ("0.3",))
    answers |= dict.fromkeys(("event-pid", "event-pid-saturated", "symmetric-send-on-delta"), ("0.3", "0.5 0.05"))
    more = answers.get(kind, ("",) * 4)
    told = ask((*plant, *more), "--kind", kind)
    assert (told.code, told.err) == (0, "")
    problem = taciturn.load("new.toml")
    assert problem.kind == kind
    assert "What matters" not in told.out
    assert problem.designed().kind == kind
