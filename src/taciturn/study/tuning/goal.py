"""Budgets to meet: upper limits on rates, on the traffic, on the cost, or on the violation of limits of the states."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from taciturn._display import Displayed
from taciturn._text import per_unit
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate
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
        """Return the rate of the link.

        Raises:
            ProblemError: the policy does not decide on it, or decides on several links and the budget names none.
        """
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
        """Return the traffic.

        Raises:
            ProblemError: the policy decides on no link.
        """
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
        """Return the largest ratio of a rate to its limit.

        Raises:
            ProblemError: the policy does not decide on one of the links, or a limit is above the largest rate.
        """
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
    """A limit on the cost.

    Args:
        budget: the limit.
        link: link whose rate is the use of the network; default: the traffic on all links.
    """

    name: ClassVar[str] = "cost"
    limits_cost: ClassVar[bool] = True

    link: str | None = None

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
        """Return the probability per step that any limit is violated.

        Raises:
            ProblemError: there is none, for the reason that the last note of the evaluation gives.
        """
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
