"""What a search for a budget found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from taciturn.model.estimate import Estimate
from taciturn.problem import Problem
from taciturn.study.clock import Cycle
from taciturn.study.evaluate import Evaluation
from taciturn.study.lines import text_of, tuned_lines

if TYPE_CHECKING:
    from taciturn.study.search import Goal


@dataclass(frozen=True)
class Parameter:
    """A parameter and how well it is known.

    Args:
        name: key of ``[policy]``.
        value: a number; of time-triggered control perhaps a cycle of intervals.
        standard_error: None where the budget does not depend on it here.
    """

    name: str
    value: float | Cycle
    standard_error: float | None

    def __str__(self) -> str:
        """Return its value, with its standard error where it has one."""
        if isinstance(self.value, tuple):
            return "[" + ", ".join(map(str, self.value)) + "]"
        return str(Estimate(self.value, self.standard_error or 0.0, "simulation"))

    def beside(self, other: Parameter | None) -> str:
        """Return its value with as many digits as tell it from another's, if there is one."""
        if isinstance(self.value, tuple):
            return str(self)
        alike = other is not None and not isinstance(other.value, tuple) and f"{other.value:.6g}" == f"{self.value:.6g}"
        return f"{self.value:.{17 if alike else 6}g}"


@dataclass(frozen=True, eq=False)
class Tuned:
    """The policy that meets a budget.

    Args:
        goal: the budget.
        parameter: that was sought.
        problem: with this parameter.
        evaluation: of it.
        beyond: where rate and cost jump across the budget, the policy on the other side of the jump.
        slope: change of the cost with the rate at the budget, along the parameter; None at a jump.
    """

    goal: Goal
    parameter: Parameter
    problem: Problem
    evaluation: Evaluation
    beyond: Tuned | None
    slope: float | None

    @property
    def confidence(self) -> float:
        """With which the budget is kept, by the errors of the evaluation: 1 where it is computed exactly."""
        return self.goal.confidence(self.evaluation)

    def __str__(self) -> str:
        """Return what ``taciturn tune`` prints."""
        return text_of(tuned_lines(self))

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
