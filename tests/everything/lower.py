"""Lower bounds: no schedule of a controller costs less than the bound at its rate, whichever the threshold is.

The bound of ``evaluate`` is a line, J ≥ J_all + g − λ·rate for every schedule, so it holds also for the same kind with
another threshold, whose rate is far away. It is true with a confidence, and costs and rates have errors: a disagreement
is repeated with another seed, more steps and a confidence that leaves no doubt.
"""

from __future__ import annotations

import math
from typing import Protocol

from everything.interpreters import SkippedError
from everything.routes import is_sentence

from taciturn.errors import ProblemError
from taciturn.model.theory import LowerBound
from taciturn.problem import Problem
from taciturn.study.evaluate import expect_bound
from taciturn.study.evaluation import Evaluation

CONFIDENCE, CERTAIN = 0.999, 1 - 1e-9
FACTORS = (1.0, 0.3, 3.0)  # by which the threshold is changed
THRESHOLDS = ("theta", "delta", "price", "threshold")
DOUBT, SURE, LONGER = 4.0, 5.0, 16


class Evaluate(Protocol):
    """``checks.evaluated``."""

    def __call__(self, problem: Problem, seed: int, longer: int = 1, confidence: float | None = None) -> Evaluation:
        """Return the answer of so many times the usual steps, with a lower bound if a confidence is given."""
        ...


def bounded_below(problem: Problem, seed: int, evaluate: Evaluate) -> str | None:
    """Check the lower bound of a problem that has one; return what does not hold."""
    try:
        expect_bound(problem)
    except ProblemError as error:
        if not is_sentence(str(error)):
            return f"no sentence: {error}"
        raise SkippedError("a problem without a lower bound") from None
    text = contradiction(problem, evaluate, seed, 1, CONFIDENCE, DOUBT)
    return text and contradiction(problem, evaluate, seed + 1, LONGER, CERTAIN, SURE)


def contradiction(
    problem: Problem, evaluate: Evaluate, seed: int, longer: int, confidence: float, errors: float
) -> str | None:
    """Return what contradicts the lower bound of a problem, beyond so many standard errors."""
    answer = evaluate(problem, seed, longer, confidence)
    lower, base = answer.lower_bound, answer.cost_all_time
    if lower is None:
        told = [note for note in answer.notes if note.startswith("no lower bound: ")]
        if len(told) != 1 or not is_sentence(told[0]):
            return f"a problem that has a lower bound has none, and the notes are {answer.notes}"
        raise SkippedError("no lower bound at its rate")
    if base is None or not math.isfinite(lower.cost) or lower.cost < base * (1 - 1e-9) or lower.price < 0:
        return f"the bound {lower} is below the cost of sending every sample, {base}"
    top = answer.cost_bound_at_rate
    if top is not None and lower.cost > top + errors * answer.bound_error + 1e-9 * abs(top):
        return f"the lower bound {lower.cost:.8g} is above the guarantee {top:.8g} at this rate"
    values = problem.source["policy"] if problem.source is not None else {}
    name = next((one for one in THRESHOLDS if isinstance(values.get(one), float)), None)
    for factor in FACTORS if name is not None else FACTORS[:1]:
        other = answer
        if factor != 1.0:
            assert name is not None
            if not values[name]:
                continue
            try:
                other = evaluate(problem.changed({name: factor * values[name]}), seed + 2, longer)
            except ProblemError:  # a loop that does not settle, or of which nothing can be said
                continue
        text = below(other, lower, answer.base_rate or 1.0, errors)
        if text is not None:
            return f"{name} times {factor:g}: {text}"
    return None


def below(answer: Evaluation, bound: LowerBound, pace: float, errors: float) -> str | None:
    """Return how far a cost is below the line at its rate, beyond so many standard errors."""
    (rate,) = answer.rates.values()
    cost, per_step = answer.cost, rate.value / pace
    if not answer.settled:
        return None
    spread = math.hypot(cost.standard_error + cost.error, bound.price * (rate.standard_error + rate.error) / pace)
    line = bound.at_rate(per_step)
    if line > cost.value + errors * spread + 1e-9 * abs(line):
        return f"cost {cost} at {per_step:.6g} sends per step, and no schedule costs less than {line:.8g}"
    return None
