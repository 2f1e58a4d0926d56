"""Result of the search for a parameter that meets a budget."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from taciturn._display import Displayed
from taciturn._text import Lines, pairs_text, per_unit, percent
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate
from taciturn.model.table import Columns, Tabular, columns_of
from taciturn.problem import Problem
from taciturn.study.clock import Cycle
from taciturn.study.evaluation import Evaluation

EXACT = 1e-9  # relative tolerance of the budget


@dataclass(frozen=True, repr=False)
class Goal(Displayed):
    """The budget to meet: an upper limit on the ``rate`` or the ``cost``."""

    name: str
    budget: float
    link: str | None

    def short(self) -> str:
        """Return the budget as text."""
        return f"{self.name} at most {self.budget:.6g}"

    def rate(self, evaluation: Evaluation) -> Estimate:
        """Return the rate of the link to which the budget refers; without a link, for a cost, that of all links.

        Raises:
            ProblemError: the policy does not decide on it, or decides on several links and the budget names none.
        """
        rates = list(evaluation.rates.values())
        if self.link is None and len(rates) > 1:
            if self.name == "rate":
                raise ProblemError(
                    f"{evaluation.policy} decides on {len(rates)} links; expected link to be one of "
                    f"{', '.join(evaluation.rates)}"
                )
            error = math.sqrt(sum(rate.standard_error**2 for rate in rates))
            return Estimate(sum(rate.value for rate in rates), error, rates[0].method)
        link = next(iter(evaluation.rates)) if self.link is None else self.link
        if link not in evaluation.rates:
            raise ProblemError(
                f"link is {link!r}, on which {evaluation.policy} does not decide; "
                f"expected {' or '.join(evaluation.rates)}"
            )
        return evaluation.rates[link]

    def of(self, evaluation: Evaluation) -> Estimate:
        """Return the estimate of the rate or cost that the budget limits."""
        return evaluation.cost if self.name == "cost" else self.rate(evaluation)

    def confidence(self, evaluation: Evaluation) -> float | None:
        """Return the probability that the answer meets the budget, for normally distributed errors.

        It is 1 for a rate that no policy exceeds, and None if the standard error cannot be trusted.
        """
        found = self.of(evaluation)
        if self.name == "rate" and evaluation.base_rate is not None and self.budget >= evaluation.base_rate:
            return 1.0
        if not evaluation.trusted:
            return None
        below = self.budget - found.value - found.error
        if found.standard_error > 0:
            return 0.5 * math.erfc(-below / found.standard_error / math.sqrt(2))
        return float(below >= -EXACT * self.budget)


@dataclass(frozen=True, repr=False)
class Parameter(Displayed):
    """A tuned parameter with its standard error.

    Args:
        name: key of ``[policy]``.
        value: a number, or for time-triggered control possibly a cycle of intervals.
        standard_error: standard error of the value, or None if the budget does not depend on the value here.
    """

    name: str
    value: float | Cycle
    standard_error: float | None

    def short(self) -> str:
        """Return the name and the value of the parameter as text."""
        return f"{self.name} = {self}"

    def __str__(self) -> str:
        """Return the value, with its standard error if there is one."""
        if isinstance(self.value, tuple):
            return "[" + ", ".join(map(str, self.value)) + "]"
        return str(Estimate(self.value, self.standard_error or 0.0, "simulation"))

    def beside(self, other: Parameter | None) -> str:
        """Return the value with enough digits to distinguish it from another value, if one is given."""
        if isinstance(self.value, tuple):
            return str(self)
        alike = other is not None and not isinstance(other.value, tuple) and f"{other.value:.6g}" == f"{self.value:.6g}"
        return f"{self.value:.{17 if alike else 6}g}"


@dataclass(frozen=True, eq=False, repr=False)
class Tuned(Tabular):
    """A policy that meets a budget.

    Args:
        goal: the budget.
        parameter: the tuned parameter.
        problem: the problem with this parameter.
        evaluation: the evaluation of this problem.
        beyond: the policy on the other side of the jump, if rate and cost jump across the budget.
        slope: derivative of the cost with respect to the rate at the budget, along the parameter; None at a jump.
    """

    goal: Goal
    parameter: Parameter
    problem: Problem
    evaluation: Evaluation
    beyond: Tuned | None
    slope: float | None

    @property
    def confidence(self) -> float | None:
        """Confidence with which the budget is met, by the errors of the evaluation; 1 if the evaluation is exact.

        It is None if the standard error cannot be trusted, as the notes of the evaluation state.
        """
        return self.goal.confidence(self.evaluation)

    def summary(self) -> Mapping[str, object]:
        """Return the parameter, the budget, and the cost and rates at this parameter by name."""
        found = self.evaluation
        values = {"policy": found.policy, "parameter": self.parameter, "goal": self.goal}
        return {**values, "cost": found.cost, "rates": found.rates, "beyond": self.beyond, "slope": self.slope}

    def about(self) -> dict[str, object]:
        """Return the parameter, the budget and the description of the evaluation, by name."""
        return {"parameter": self.parameter.short(), "budget": _budget_text(self), **self.evaluation.about()}

    def columns(self) -> Columns:
        """Return the rows of the evaluation at the tuned parameter."""
        return columns_of(self.evaluation.records())

    def __str__(self) -> str:
        """Return the text that ``taciturn tune`` prints."""
        parameter = self.parameter
        lines: Lines = [(parameter.name, str(parameter)), ("budget", _budget_text(self))]
        if self.beyond is not None:
            other = self.beyond
            rates = ", ".join(f"rate, {link} {rate}" for link, rate in other.evaluation.rates.items())
            text = f"{other.parameter.beside(parameter)}: {rates}, cost {other.evaluation.cost}"
            jump = f"the {self.goal.name} jumps across the budget; on the other side:"
            lines.append(("beyond", f"{jump} {parameter.name} = {text}"))
        return f"{pairs_text(lines)}\n{self.evaluation}"

    def document(self) -> dict[str, Any]:
        """Return the JSON document of ``taciturn tune --json``."""
        parameter = {
            "name": self.parameter.name,
            "value": self.parameter.value,
            "standard_error": self.parameter.standard_error,
        }
        budget = {"of": self.goal.name, "at_most": self.goal.budget, "confidence": self.confidence}
        found = {"parameter": parameter, "budget": budget} | self.evaluation.document()
        if self.beyond is not None:
            rates = {link: rate.value for link, rate in self.beyond.evaluation.rates.items()}
            jump = {"value": self.beyond.parameter.value, "cost": self.beyond.evaluation.cost.value, "rates": rates}
            found["beyond"] = jump
        return found


def _budget_text(found: Tuned) -> str:
    """Return a text that states whether the budget is met, and with which confidence."""
    goal, sure = found.goal, found.confidence
    unit = found.evaluation.rate_unit if goal.name == "rate" else found.evaluation.unit
    if sure is None:
        kept = "met in this simulation, whose standard error cannot be trusted"
    else:
        kept = "met exactly" if sure == 1 else f"met with {percent(math.floor(1000 * sure) / 1000)} confidence"
    return f"{goal.name} at most {goal.budget:.6g} {per_unit(unit)}, {kept}"
