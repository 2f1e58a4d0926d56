"""Budgets that a tuned policy must meet: limits on rates, on traffic, on cost, or on violations of state limits.

A goal names the estimate of an evaluation that is limited, its least and its largest value among all policies, and the
use of the network that the cost is traded for. An answer meets its budget with a confidence, the probability for
normally distributed errors; a value that exceeds the budget only by rounding meets it.

Budgets may be given in percent (``budget_of``): 50% of the rate or of the traffic of sending every sample, or +5% above
the cost of sending every sample (``cost_goal``). Where no theorem gives this cost, such as with limits or losses, the
goal is the ratio of both costs, which each trial simulates on the same random numbers.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import ClassVar

from taciturn.design.kind import AnyPolicy, TradeoffParameter
from taciturn.errors import ProblemError
from taciturn.extend import Displayed, number, number_of, per_unit, percent
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.problem import Problem
from taciturn.renewal.without_steps import nodes_of
from taciturn.study.baseline import baseline_of
from taciturn.study.evaluation import Evaluation

EXACT = 1e-9  # relative tolerance of the budget, for the rounding errors of costs and rates


@dataclass(frozen=True, repr=False)
class Goal(Displayed, ABC):
    """Upper limit on a quantity, such as a rate; a search tunes the policy so that it meets this limit."""

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
        """Return a text that states the budget with its unit."""
        return f"{self.short()} {per_unit(evaluation.rate_unit)}"

    def axis(self, evaluation: Evaluation) -> str:
        """Return the axis label that names the limited quantity and its unit."""
        return f"{'sends' if self.name == 'rate' else self.name} {per_unit(evaluation.rate_unit)}"

    @property
    def document(self) -> object:
        """The limit as it appears in the JSON document."""
        return self.budget

    @abstractmethod
    def of(self, evaluation: Evaluation) -> Estimate:
        """Return the limited quantity of an evaluated policy, with its error."""

    def above(self, evaluation: Evaluation) -> tuple[float, float]:
        """Return by how much the limited quantity exceeds its budget, and the error of this difference."""
        found = self.of(evaluation)
        return found.value - self.budget, found.standard_error + found.error

    def use(self, evaluation: Evaluation) -> Estimate:
        """Return the rate or the traffic of an evaluated policy."""
        return self.of(evaluation)

    def base(self, evaluation: Evaluation) -> float | None:
        """Return the cost of every sample, in the unit of a limited cost; None if it is unknown."""
        return evaluation.base

    def least(self, evaluation: Evaluation) -> float | None:
        """Return the least value of the limited quantity that any policy can reach; None if that value is unknown."""
        return None

    def most(self, evaluation: Evaluation) -> float | None:
        """Return the largest value of the limited quantity that any policy can reach; None if unknown or infinite."""
        return None

    def confidence(self, evaluation: Evaluation) -> float | None:
        """Return the probability that the policy meets the budget, for normally distributed estimation errors.

        A value that exceeds the budget by at most the fraction ``EXACT`` of the budget counts as meeting it. The
        probability is 1 for a rate that no policy exceeds, and None if the standard error cannot be trusted.
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
    """Limit on the send rate of one link: a named link, or the only link on which the policy decides."""

    name: ClassVar[str] = "rate"

    link: str | None = None

    def of(self, evaluation: Evaluation) -> Estimate:
        """Return the send rate of the link."""
        rates = evaluation.rates
        if self.link is None and len(rates) > 1:
            raise ProblemError(
                f"the policy {evaluation.policy} makes send decisions on {number_of(len(rates), 'link')}, but a rate "
                f"is given without a link; expected one of the links {', '.join(rates)}"
            )
        return _rate(evaluation, next(iter(rates)) if self.link is None else self.link)

    def most(self, evaluation: Evaluation) -> float | None:
        """Return the rate of sending every sample, because no policy has a larger rate."""
        return evaluation.base_rate


@dataclass(frozen=True, repr=False)
class TrafficGoal(Goal):
    """Limit on the traffic: send rates times prices of packets, summed over all links on which the policy decides."""

    name: ClassVar[str] = "traffic"

    def of(self, evaluation: Evaluation) -> Estimate:
        """Return the traffic."""
        if evaluation.traffic is None:
            raise ProblemError(
                f"the policy {evaluation.policy} makes no send decisions on a link, so it has no traffic; expected a "
                "budget on the rate"
            )
        return evaluation.traffic

    def most(self, evaluation: Evaluation) -> float | None:
        """Return the traffic if every sample is sent on each link on which the policy decides."""
        return None if evaluation.base_rate is None else evaluation.base_rate * sum(evaluation.prices.values())


@dataclass(frozen=True, repr=False)
class RatesGoal(Goal):
    """Limits on the send rates of several links; the largest ratio of a rate to its limit must be at most 1."""

    name: ClassVar[str] = "rates"

    budget: float = 1.0
    limits: Mapping[str, float] = field(hash=False, default_factory=lambda: {})

    def short(self) -> str:
        """Return the limits as text."""
        return ", ".join(f"rate of {link} at most {limit:.6g}" for link, limit in self.limits.items())

    def axis(self, evaluation: Evaluation) -> str:
        """Return the axis label for the largest ratio of a link's rate to its limit."""
        return "largest share of a limit of the rates"

    @property
    def document(self) -> object:
        """The limits by link."""
        return dict(self.limits)

    def of(self, evaluation: Evaluation) -> Estimate:
        """Return the largest ratio of a link's rate to its limit."""
        most = evaluation.base_rate
        for link, limit in self.limits.items():
            _rate(evaluation, link)
            if most is not None and limit > most * (1 + EXACT):
                raise ProblemError(
                    f"the rate {limit:g} of the link {link} is above the rate of sending every sample; expected at "
                    f"most {most:g}"
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
        """Return a text that states the budget with the unit of the cost."""
        return f"{self.short()} {per_unit(evaluation.unit)}"

    def axis(self, evaluation: Evaluation) -> str:
        """Return the axis label for the cost, with its unit."""
        return f"cost {per_unit(evaluation.unit)}"

    def of(self, evaluation: Evaluation) -> Estimate:
        """Return the cost."""
        return evaluation.cost

    def least(self, evaluation: Evaluation) -> float | None:
        """Return the cost of sending every sample, because no policy has a lower cost."""
        return evaluation.cost_all_time

    def use(self, evaluation: Evaluation) -> Estimate:
        """Return the rate of the link or, for several links, the traffic."""
        if self.link is not None:
            return _rate(evaluation, self.link)
        only = list(evaluation.rates.values())
        return only[0] if len(only) == 1 else TrafficGoal(0.0).of(evaluation)


@dataclass(frozen=True, repr=False)
class RelativeCostGoal(CostGoal):
    """A limit on the cost, as a multiple of the measured cost of sending every sample."""

    name: ClassVar[str] = "cost relative to every sample"

    def short(self) -> str:
        """Return the budget as text."""
        return f"cost at most {percent(self.budget - 1)} above every sample"

    def text(self, evaluation: Evaluation) -> str:
        """Return the budget as text, which has no unit."""
        return self.short()

    def axis(self, evaluation: Evaluation) -> str:
        """Return the axis label for the ratio of the costs."""
        return "cost / cost of every sample"

    def of(self, evaluation: Evaluation) -> Estimate:
        """Return the ratio of the costs, with the error of the pair."""
        if evaluation.excess is None:
            raise ProblemError("the cost of sending every sample is unknown; expected a number for the cost")
        return evaluation.excess.scaled(1.0, 1.0)

    def least(self, evaluation: Evaluation) -> float | None:
        """Return None: with limits or losses, sending less may cost less."""
        return None

    def base(self, evaluation: Evaluation) -> float | None:
        """Return 1, the ratio of sending every sample."""
        return 1.0


@dataclass(frozen=True, repr=False)
class ViolationGoal(CostGoal):
    """Limit on the fraction of steps in which states violate their limits; the search uses a logarithmic scale.

    An evaluation for this goal contains the probabilities of violation.
    """

    name: ClassVar[str] = "violation"
    close: ClassVar[float] = 1.0
    span: ClassVar[float] = 0.2

    def text(self, evaluation: Evaluation) -> str:
        """Return the budget as text."""
        return f"{self.short()} of the steps"

    def axis(self, evaluation: Evaluation) -> str:
        """Return the axis label for the fraction of steps with a violation."""
        return "share of the steps with a violation"

    def of(self, evaluation: Evaluation) -> Estimate:
        """Return the probability that a step violates at least one limit."""
        if evaluation.violations is None:
            raise ProblemError(evaluation.notes[-1])
        return evaluation.violations.total.per_step

    def above(self, evaluation: Evaluation) -> tuple[float, float]:
        """Return the logarithm of the ratio of the limited quantity to its budget, with the error of this logarithm."""
        found = self.of(evaluation)
        seen = max(found.value, found.standard_error)
        return math.log(seen / self.budget), found.standard_error / seen

    def least(self, evaluation: Evaluation) -> float | None:
        """Return None, because the least probability that a policy can reach is unknown."""
        return None

    def base(self, evaluation: Evaluation) -> float | None:
        """Return None, because the probability with every sample is unknown."""
        return None


def _rate(evaluation: Evaluation, link: str) -> Estimate:
    if link not in evaluation.rates:
        raise ProblemError(
            f"link is {link!r}, but the policy {evaluation.policy} makes no send decisions on this link; expected the "
            f"link {' or '.join(evaluation.rates)}"
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
    """Convert a text to a number, but leave a percentage such as "5%" as it is."""
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
    """Convert a budget to a number; a percentage refers to the rate or the traffic of sending every sample."""
    if not isinstance(budget, str):
        return number(name, budget, 0.0)
    share = _share(name, budget)
    policy, loop = _tuned_loop(problem, tuning, name, budget)
    if loop is None:
        raise ProblemError(
            f"{name} is {budget!r}, but the policy {policy.kind} has no sampling steps; expected a number"
        )
    links = loop.network.links
    paid = 1.0 if name == "rate" else sum(links[link].price for link in loop.policy.scheduled)
    return share * paid * (1.0 if loop.horizon is not None else 1 / loop.policy.tick)


def cost_goal(problem: Problem, tuning: TradeoffParameter, budget: object, link: str | None) -> CostGoal:
    """Return the goal of a limit on the cost; a percentage refers to the cost of sending every sample."""
    if not isinstance(budget, str):
        return CostGoal(number("cost", budget, 0.0), link)
    most = 1 + _share("cost", budget)
    policy, loop = _tuned_loop(problem, tuning, "cost", budget)
    if loop is None:
        return CostGoal(most * policy.cost_all_time, link)
    base = baseline_of(problem, loop)
    if base.cost is not None:
        return CostGoal(most * base.cost.value, link)
    if base.loop is None:
        unknown = f"the cost of sending every sample is unknown ({base.why})"
        raise ProblemError(f"cost is {budget!r}, a percentage, but {unknown}; expected a number")
    return RelativeCostGoal(most, link)


def _tuned_loop(problem: Problem, tuning: TradeoffParameter, name: str, budget: str) -> tuple[AnyPolicy, Loop | None]:
    """Return the policy and the loop to which a percentage refers; no loop if a policy has no steps."""
    if tuning.name == "period":
        sought = f"the {name} of sending every sample depends on the period, which is tuned"
        raise ProblemError(f"{name} is {budget!r}, a percentage, but {sought}; expected a number")
    policy = problem.changed({tuning.name: tuning.value_in(problem.parameters)}).designed()
    nodes = nodes_of(policy)
    return policy, None if nodes is None else problem.close(nodes)


def _share(name: str, text: str) -> float:
    """Return the value of a percentage as a fraction."""
    found = re.fullmatch(FORMS[name], text.strip())
    if found is None:
        raise ProblemError(f"{name} is {text!r}; expected a number, or a percentage such as {EXAMPLES[name]}")
    share = float(found[1].replace(" ", "")) / 100
    return number(name, share, -1.0 if name == "cost" else 0.0)
