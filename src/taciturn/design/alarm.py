"""An alarm on the innovations of a filter, which are larger than its model allows if the plant differs from it.

The policy averages the normalised squares ν'S⁻¹ν of the innovations with exponential forgetting. While the average
exceeds its 1 − 10⁻⁹ quantile for the model's white noise, the alarm is on, and the decision ``watch`` is "surprised".
The signal ``alarms`` counts these steps.
"""

from __future__ import annotations

import numpy as np

from taciturn import _scipy
from taciturn._arrays import Array, symmetrised
from taciturn.model.policy import Decide, Evaluate, Step
from taciturn.model.trigger import Form, Matrix, Scheduled, Trigger, shape_of

WATCH = "watch"  # the decision with the outcomes expected and surprised
FORGOTTEN = 0.02  # weight of the newest innovation: the average extends over about 50 steps
FALSE_ALARMS = 1e-9  # probability that a step without any fault is surprised


def watch_innovations(signal: str, covariance: Matrix, at: str) -> tuple[Step, ...]:
    """Return the policy steps that decide whether the innovations are as expected; they follow the filter's.

    Args:
        signal: name of the innovations.
        covariance: their covariance, (p, p), or a table of covariances.
        at: the node that decides.
    """
    entries = shape_of(covariance)[0]
    freedom = entries * (2 - FORGOTTEN) / FORGOTTEN  # of the chi-square distribution with the average's first moments
    limit = 2 * _scipy.gamma_quantile(freedom / 2, 1 - FALSE_ALARMS) * entries / freedom
    averaged = Form((signal,), _weight(covariance), plus={"surprise": 1 - FORGOTTEN})
    same, more = Form(plus={"alarms": 1.0}), Form(constant=1.0, plus={"alarms": 1.0})
    return (
        Evaluate(at, "surprise", (averaged,)),
        Decide(at, WATCH, Trigger({"expected": Form(plus={"surprise": 1.0}), "surprised": Form(constant=limit)})),
        Evaluate(at, "alarms", (same, more), WATCH),
    )


def _weight(covariance: Matrix) -> Matrix:
    if isinstance(covariance, Scheduled):
        return Scheduled(covariance.by, _inverse(covariance.values))
    return _inverse(covariance)


def _inverse(covariance: Array) -> Array:
    return symmetrised(FORGOTTEN * np.asarray(np.linalg.pinv(covariance, hermitian=True), dtype=np.float64))
