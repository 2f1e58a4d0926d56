"""Result of the search for a parameter that meets a budget."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from taciturn._display import Displayed
from taciturn._text import Lines, pairs_text, percent
from taciturn.model.estimate import Estimate
from taciturn.model.table import Columns, Tabular, columns_of
from taciturn.problem import Problem
from taciturn.study.clock import Cycle
from taciturn.study.evaluation import Evaluation
from taciturn.study.lines import shares_text
from taciturn.study.tuning.goal import EXACT, Goal


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
        slope: derivative of the cost with respect to the rate (or the traffic) at the budget, along the parameter; None
            at a jump.
        shares: tuned shares of the links, by name of the parameter that contains them; None if they were not tuned.
    """

    goal: Goal
    parameter: Parameter
    problem: Problem
    evaluation: Evaluation
    beyond: Tuned | None
    slope: float | None
    shares: Mapping[str, float] | None = None

    @property
    def confidence(self) -> float | None:
        """Confidence with which the budget is met, by the errors of the evaluation; 1 if the evaluation is exact.

        It is None if the standard error cannot be trusted, as the notes of the evaluation state.
        """
        return self.goal.confidence(self.evaluation)

    def summary(self) -> Mapping[str, object]:
        """Return the parameter, the budget, and the cost and rates at this parameter by name."""
        found = self.evaluation
        values = {"policy": found.policy, "parameter": self.parameter, "shares": self.shares, "goal": self.goal}
        return {**values, "cost": found.cost, "rates": found.rates, "beyond": self.beyond, "slope": self.slope}

    def about(self) -> dict[str, object]:
        """Return the parameter, the budget and the description of the evaluation, by name."""
        shares = {} if self.shares is None else {"shares": shares_text(self.shares)}
        return {"parameter": self.parameter.short(), **shares, "budget": _budget_text(self), **self.evaluation.about()}

    def columns(self) -> Columns:
        """Return the rows of the evaluation at the tuned parameter."""
        return columns_of(self.evaluation.records())

    def __str__(self) -> str:
        """Return the text that ``taciturn tune`` prints."""
        parameter = self.parameter
        lines: Lines = [(parameter.name, str(parameter))]
        lines += [] if self.shares is None else [("shares", shares_text(self.shares))]
        lines.append(("budget", _budget_text(self)))
        if self.beyond is not None:
            other = self.beyond
            rates = ", ".join(f"rate, {link} {rate}" for link, rate in other.evaluation.rates.items())
            traffic = f", traffic {other.evaluation.traffic}" if self.goal.name == "traffic" else ""
            text = f"{other.parameter.beside(parameter)}: {rates}{traffic}, cost {other.evaluation.cost}"
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
        budget = {"of": self.goal.name, "at_most": self.goal.document, "confidence": self.confidence}
        found = {"parameter": parameter, "budget": budget} | self.evaluation.document()
        if self.shares is not None:
            found["shares"] = dict(self.shares)
        if self.beyond is not None:
            rates = {link: rate.value for link, rate in self.beyond.evaluation.rates.items()}
            jump = {"value": self.beyond.parameter.value, "cost": self.beyond.evaluation.cost.value, "rates": rates}
            traffic = self.beyond.evaluation.traffic
            found["beyond"] = jump | ({} if traffic is None else {"traffic": traffic.value})
        return found


def _budget_text(found: Tuned) -> str:
    """Return a text that states whether the budget is met, and with which confidence."""
    sure = found.confidence
    if sure is None:
        kept = "met in this simulation, whose standard error cannot be trusted"
    else:
        over = found.goal.of(found.evaluation).value > found.goal.budget
        exactly = f"met up to a rounding error of {EXACT:g} of it" if over else "met exactly"
        kept = exactly if sure == 1 else f"met with {percent(math.floor(1000 * sure) / 1000)} confidence"
    written = found.evaluation.as_written
    where = "" if written is None else ", for the plant with the disturbance that is added by default"
    if written is not None and found.goal.limits_cost:
        where += f"; on the plant as written, the cost is {written.cost}"
        where += "" if not written.cost_all_time else f", {written.extra()} relative to sending every sample"
    return f"{found.goal.text(found.evaluation)}, {kept}{where}"
