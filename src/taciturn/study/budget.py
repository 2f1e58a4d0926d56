"""Budgets that are said in percent: of the rate, or above the cost, of sending always."""

from __future__ import annotations

import re

from taciturn._arrays import number
from taciturn.design.catalogue import Knob
from taciturn.errors import ProblemError
from taciturn.model.policy import Policy
from taciturn.problem import Problem
from taciturn.renewal.policy import OptimalPolicy

FORMS = {"rate": r"(\d+\.?\d*|\.\d+)\s*%", "cost": r"\+\s*(\d+\.?\d*|\.\d+)\s*%"}
EXAMPLES = {"rate": "50%, of the rate of sending always", "cost": "+5%, above the cost of sending always"}


def parse_budget(name: str, text: str) -> float | str:
    """Return a number as such, and percent as they are.

    Args:
        name: ``"rate"`` or ``"cost"``.
        text: such as ``"0.3"``, ``"50%"`` of a rate, ``"+5%"`` of a cost.

    Raises:
        ProblemError: neither.
    """
    try:
        return float(text)
    except ValueError:
        _share(name, text)
        return text


def budget_of(problem: Problem, knob: Knob, name: str, budget: object) -> float:
    """Return a budget as a number; percent are of what the problem's policy has when it sends at every tick.

    Args:
        problem: whose policy is tuned.
        knob: what is turned.
        name: ``"rate"`` or ``"cost"``.
        budget: as in ``tune``.

    Raises:
        ProblemError: no such budget, or percent of what is not known or moves with what is turned.
    """
    if not isinstance(budget, str):
        return number(name, budget, 0.0)
    share, given = _share(name, budget), problem.parameters
    if knob.name == "period":
        sought = "sending always has another one at every period, which is sought"
        raise ProblemError(f"{name} is {budget!r}, and {sought}; expected a number")
    start = given.get(knob.name, max(knob.least, 1) if knob.whole else knob.least + 1.0)
    policy = problem.changed({knob.name: start}).designed()
    nodes = policy.looked_at if isinstance(policy, OptimalPolicy) else policy
    loop = problem.close(nodes) if isinstance(nodes, Policy) else None
    if name == "rate":
        if loop is None:
            raise ProblemError(f"rate is {budget!r}, and {policy.kind} has no ticks; expected a number")
        return share * (1.0 if loop.horizon is not None else 1 / loop.policy.tick)
    if loop is not None and not loop.nominal:
        unknown = f"the cost of sending always is not known, as {loop.departures[0]}"
        raise ProblemError(f"cost is {budget!r}, and {unknown}; expected a number")
    return (1 + share) * policy.cost_all_time


def _share(name: str, text: str) -> float:
    """Return the share that percent say.

    Raises:
        ProblemError: another text.
    """
    found = re.fullmatch(FORMS[name], text.strip())
    if found is None:
        raise ProblemError(f"{name} is {text!r}; expected a number, or percent as {EXAMPLES[name]}")
    return number(name, float(found[1]) / 100, 0.0)
