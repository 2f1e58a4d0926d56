"""Budgets that a tuned policy is to meet: limits on rates, on the traffic, on the cost, or on violations of limits.

A goal names the estimate of an evaluation that is limited, its least and its largest value among all policies, and the
use of the network that the cost is traded for. An answer meets its budget with a confidence, the probability for
normally distributed errors; a value that exceeds the budget only by rounding meets it.

Budgets may be given in percent (``budget_of``): 50% of the rate or of the traffic of sending every sample, or +5% above
the cost of sending every sample.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import ClassVar

from taciturn.design.kind import TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.extend import Displayed, number, per_unit
from taciturn.model.estimate import Estimate
from taciturn.problem import Problem
from taciturn.renewal.without_steps import nodes_of
from taciturn.study.evaluation import Evaluation

EXACT = 1e-9  # relative tolerance of the budget, for the rounding errors of costs and rates


@dataclass(frozen=True, repr=False)
class Goal(Displayed, ABC):
    """An upper limit that the answer of a search meets."""

    name: ClassVar[str]
    limits_cost: ClassVar[bool] = False
    """Whether the limited quantity falls with more packets, as a cost does."""
    close: ClassVar[float] = 0.25
    """Largest error of a root, in standard errors of a trial."""
    span: ClassVar[float] = 0.02
    """Half-width in log(value) of the parameter for slopes."""

    budget: float

    def short(self) -> str:
        """Return the budget as text."""
        return f"{self.name} at most {self.budget:.6g}"

    def text(self, evaluation: Evaluation) -> str:
        """Return the budget as text, with its unit."""
        return f"{self.short()} {per_unit(evaluation.rate_unit)}"

    @property
    def document(self) -> object:
        """The limit as a value that JSON can represent."""
        return self.budget

    @abstractmethod
    def of(self, evaluation: Evaluation) -> Estimate:
        """Return the estimate that the budget limits."""

    def above(self, evaluation: Evaluation) -> tuple[float, float]:
        """Return the excess over the budget and its error, in the units of the search."""
        found = self.of(evaluation)
        return found.value - self.budget, found.standard_error + found.error

    def use(self, evaluation: Evaluation) -> Estimate:
        """Return the use of the network that cost is traded for: the limited one, unless the budget limits the cost."""
        return self.of(evaluation)

    def least(self, evaluation: Evaluation) -> float | None:
        """Return the least value that any policy reaches, or None if it is unknown."""
        return None

    def most(self, evaluation: Evaluation) -> float | None:
        """Return the largest value that any policy reaches, or None if it is unknown or infinite."""
        return None

    def confidence(self, evaluation: Evaluation) -> float | None:
        """Return the probability that the answer meets the budget, for normally distributed errors.

        A value that exceeds the budget by at most ``EXACT`` of it meets the budget. The probability is 1 for a rate
        that no policy exceeds, and None if the standard error cannot be trusted.
        """
        found, most = self.of(evaluation), self.most(evaluation)
        if most is not None and self.budget >= most:
            return 1.0
        if not evaluation.trusted:
            return None
        below = self.budget * (1 + EXACT) - found.value - found.error
        if found.standard_error > 0:
            return 0.5 * math.erfc(-below / found.standard_error / math.sqrt(2))
        return float(below >= 0)


@dataclass(frozen=True, repr=False)
class RateGoal(Goal):
    """A limit on the rate of a link, by name or the only one on which the policy decides."""

    name: ClassVar[str] = "rate"

    link: str | None = None

    def of(self, evaluation: Evaluation) -> Estimate:
        """Return the rate of the link."""
        rates = evaluation.rates
        if self.link is None and len(rates) > 1:
            raise ProblemError(
                f"{evaluation.policy} decides on {len(rates)} links, and a rate is given without a link; expected the "
                f"link, one of {', '.join(rates)}"
            )
        return _rate(evaluation, next(iter(rates)) if self.link is None else self.link)

    def most(self, evaluation: Evaluation) -> float | None:
        """Return the rate of sending every sample."""
        return evaluation.base_rate


@dataclass(frozen=True, repr=False)
class TrafficGoal(Goal):
    """A limit on the traffic: the rates of all links on which the policy decides, each times the price of a packet."""

    name: ClassVar[str] = "traffic"

    def of(self, evaluation: Evaluation) -> Estimate:
        """Return the traffic."""
        if evaluation.traffic is None:
            raise ProblemError(f"{evaluation.policy} decides on no link, so it has no traffic; expected a rate")
        return evaluation.traffic

    def most(self, evaluation: Evaluation) -> float | None:
        """Return the traffic of sending every sample on the links on which the policy decides."""
        return None if evaluation.base_rate is None else evaluation.base_rate * sum(evaluation.prices.values())


@dataclass(frozen=True, repr=False)
class RatesGoal(Goal):
    """Limits on the rates of several links: the largest share of a limit that is used is at most 1."""

    name: ClassVar[str] = "rates"

    budget: float = 1.0
    limits: Mapping[str, float] = field(hash=False, default_factory=lambda: {})

    def short(self) -> str:
        """Return the limits as text."""
        return ", ".join(f"rate of {link} at most {limit:.6g}" for link, limit in self.limits.items())

    @property
    def document(self) -> object:
        """The limits by link."""
        return dict(self.limits)

    def of(self, evaluation: Evaluation) -> Estimate:
        """Return the largest ratio of a rate to its limit."""
        most = evaluation.base_rate
        for link, limit in self.limits.items():
            _rate(evaluation, link)
            if most is not None and limit > most * (1 + EXACT):
                raise ProblemError(
                    f"the rate {limit:g} of {link} is above the rate of sending at every step; expected at most "
                    f"{most:g}"
                )
        shares = [_rate(evaluation, link).scaled(1 / limit) for link, limit in self.limits.items()]
        return max(shares, key=lambda share: share.value)


@dataclass(frozen=True, repr=False)
class CostGoal(Goal):
    """A limit on the cost."""

    name: ClassVar[str] = "cost"
    limits_cost: ClassVar[bool] = True

    link: str | None = None  # link whose rate is the use of the network; default: the traffic on all links

    def text(self, evaluation: Evaluation) -> str:
        """Return the budget as text, with the unit of the cost."""
        return f"{self.short()} {per_unit(evaluation.unit)}"

    def of(self, evaluation: Evaluation) -> Estimate:
        """Return the cost."""
        return evaluation.cost

    def least(self, evaluation: Evaluation) -> float | None:
        """Return the cost of sending at every step."""
        return evaluation.cost_all_time

    def use(self, evaluation: Evaluation) -> Estimate:
        """Return the rate of the link, or the traffic on all links."""
        if self.link is not None:
            return _rate(evaluation, self.link)
        only = list(evaluation.rates.values())
        return only[0] if len(only) == 1 else TrafficGoal(0.0).of(evaluation)


@dataclass(frozen=True, repr=False)
class ViolationGoal(CostGoal):
    """A limit on the share of the steps in which limits of the states are violated, searched on a logarithmic scale.

    Its evaluations contain the probabilities of violation.
    """

    name: ClassVar[str] = "violation"
    close: ClassVar[float] = 1.0
    span: ClassVar[float] = 0.2

    def text(self, evaluation: Evaluation) -> str:
        """Return the budget as text."""
        return f"{self.short()} of the steps"

    def of(self, evaluation: Evaluation) -> Estimate:
        """Return the probability per step that any limit is violated."""
        if evaluation.violations is None:
            raise ProblemError(evaluation.notes[-1])
        return evaluation.violations.total.per_step

    def above(self, evaluation: Evaluation) -> tuple[float, float]:
        """Return the logarithm of the ratio to the budget, and its error."""
        found = self.of(evaluation)
        seen = max(found.value, found.standard_error)
        return math.log(seen / self.budget), found.standard_error / seen

    def least(self, evaluation: Evaluation) -> float | None:
        """Return None: no policy has a known least probability."""
        return None


def _rate(evaluation: Evaluation, link: str) -> Estimate:
    if link not in evaluation.rates:
        raise ProblemError(
            f"link is {link!r}, on which {evaluation.policy} does not decide; expected {' or '.join(evaluation.rates)}"
        )
    return evaluation.rates[link]


SHARE = r"(\d+\.?\d*|\.\d+)\s*%"
FORMS = {"rate": SHARE, "traffic": SHARE, "cost": r"([+-]\s*(?:\d+\.?\d*|\.\d+))\s*%"}
EXAMPLES = {
    "rate": "50% of the rate of sending every sample",
    "traffic": "50% of the traffic of sending every sample",
    "cost": "+5% above the cost of sending every sample",
}


def parse_budget(name: str, text: str) -> float | str:
    """Return the number that a text contains, or the text itself if it is a percentage."""
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
    """Return a budget as a number; percentages refer to the rate or cost of sending at every step."""
    if not isinstance(budget, str):
        return number(name, budget, 0.0)
    share, given = _share(name, budget), problem.parameters
    if tuning.name == "period":
        sought = f"the {name} of sending every sample depends on the period, which is tuned"
        raise ProblemError(f"{name} is {budget!r}, but {sought}; expected a number")
    start = given.get(tuning.name, max(tuning.least, 1) if tuning.whole else tuning.least + 1.0)
    policy = problem.changed({tuning.name: start}).designed()
    nodes = nodes_of(policy)
    loop = None if nodes is None else problem.close(nodes)
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
    """Return the value of a percentage as a fraction."""
    found = re.fullmatch(FORMS[name], text.strip())
    if found is None:
        raise ProblemError(f"{name} is {text!r}; expected a number, or a percentage such as {EXAMPLES[name]}")
    share = float(found[1].replace(" ", "")) / 100
    return number(name, share, -1.0 if name == "cost" else 0.0)
