"""What a search for a budget found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from taciturn.problem import Problem
from taciturn.study.evaluate import Evaluation
from taciturn.study.lines import text_of, tuned_lines


@dataclass(frozen=True)
class Parameter:
    """A parameter and how well it is known; ``standard_error`` is None where the budget does not depend on it here."""

    name: str
    value: float
    standard_error: float | None


@dataclass(frozen=True, eq=False)
class Tuned:
    """The policy that meets a budget.

    Args:
        parameter: that was sought.
        problem: with this parameter.
        evaluation: of it.
        beyond: where rate and cost jump across the budget, the policy on the other side of the jump.
        slope: change of the cost with the rate at the budget, along the parameter; None at a jump.
    """

    parameter: Parameter
    problem: Problem
    evaluation: Evaluation
    beyond: Tuned | None
    slope: float | None

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
        found = {"parameter": parameter} | self.evaluation.document()
        if self.beyond is not None:
            rates = {link: rate.value for link, rate in self.beyond.evaluation.rates.items()}
            jump = {"value": self.beyond.parameter.value, "cost": self.beyond.evaluation.cost.value, "rates": rates}
            found["beyond"] = jump
        return found
