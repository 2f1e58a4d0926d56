"""Budgets in percent, relative to the rate or the cost of sending every sample."""

from __future__ import annotations

import re
from contextlib import suppress

from taciturn._arrays import number
from taciturn.design.kind import TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.model.policy import Policy
from taciturn.problem import Problem
from taciturn.renewal.policy import OptimalPolicy

SHARE = r"(\d+\.?\d*|\.\d+)\s*%"
FORMS = {"rate": SHARE, "traffic": SHARE, "cost": r"([+-]\s*(?:\d+\.?\d*|\.\d+))\s*%"}
EXAMPLES = {
    "rate": "50% of the rate of sending every sample",
    "traffic": "50% of the traffic of sending every sample",
    "cost": "+5% above the cost of sending every sample",
}


def parse_budget(name: str, text: str) -> float | str:
    """Return the number that a text contains, or the text itself if it is a percentage.

    Args:
        name: ``"rate"``, ``"traffic"`` or ``"cost"``.
        text: a text such as ``"0.3"``, ``"50%"`` for a rate, or ``"+5%"`` or ``"-5%"`` for a cost.

    Raises:
        ProblemError: the text is neither a number nor a percentage.
    """
    found = None
    with suppress(ValueError):
        found = float(text)
    if found is None:
        _share(name, text)
        return text
    if text.strip().startswith("+"):
        raise ProblemError(
            f"{name} is {text!r}, a number with a sign; expected {text.strip()[1:]} for a {name} of this size, or a "
            f"percentage such as {EXAMPLES[name]}"
        )
    return found


def budget_of(problem: Problem, tuning: TradeoffParameter, name: str, budget: object) -> float:
    """Return a budget as a number; percentages refer to the rate or cost of sending at every step.

    Args:
        problem: the problem whose policy is tuned.
        tuning: the tuning parameter.
        name: ``"rate"`` or ``"cost"``.
        budget: the budget, as in ``tune``.

    Raises:
        ProblemError: the budget is malformed, or it is a percentage of a value that is unknown or depends on the tuning
            parameter.
    """
    if not isinstance(budget, str):
        return number(name, budget, 0.0)
    share, given = _share(name, budget), problem.parameters
    if tuning.name == "period":
        sought = f"the {name} of sending every sample depends on the period, which is tuned"
        raise ProblemError(f"{name} is {budget!r}, but {sought}; expected a number")
    start = given.get(tuning.name, max(tuning.least, 1) if tuning.whole else tuning.least + 1.0)
    policy = problem.changed({tuning.name: start}).designed()
    nodes = policy.looked_at if isinstance(policy, OptimalPolicy) else policy
    loop = problem.close(nodes) if isinstance(nodes, Policy) else None
    if name != "cost":
        if loop is None:
            raise ProblemError(f"{name} is {budget!r}, but {policy.kind} has no sampling steps; expected a number")
        links = loop.network.links
        paid = 1.0 if name == "rate" else sum(links[link].price for link in loop.policy.scheduled)
        return share * paid * (1.0 if loop.horizon is not None else 1 / loop.policy.tick)
    if loop is not None and not loop.nominal:
        unknown = f"the cost of sending every sample is unknown, since {loop.violated_assumptions[0]}"
        raise ProblemError(f"cost is {budget!r}, but {unknown}; expected a number")
    return (1 + share) * policy.cost_all_time


def _share(name: str, text: str) -> float:
    """Return the value of a percentage as a fraction.

    Raises:
        ProblemError: the text is not a percentage of the expected form.
    """
    found = re.fullmatch(FORMS[name], text.strip())
    if found is None:
        raise ProblemError(f"{name} is {text!r}; expected a number, or a percentage such as {EXAMPLES[name]}")
    share = float(found[1].replace(" ", "")) / 100
    return number(name, share, -1.0 if name == "cost" else 0.0)
