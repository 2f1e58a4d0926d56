"""Cost and rate of policies whose events have no ticks, by cycles from send to send."""

from __future__ import annotations

import numpy as np

from taciturn._progress import OutOfTime, Progress, Stages
from taciturn.model.estimate import Estimate
from taciturn.renewal.cycles import CycleEstimate, estimate_cycles
from taciturn.renewal.policy import EventPolicy
from taciturn.simulation.average import check_effort
from taciturn.simulation.sampling import RELATIVE_ERROR, Averages

FIRST = 200_000  # cycles
RELATIVE_INTERVAL = 3e-4  # standard error of the mean interval, where no draw decides the cost
MOST_CYCLES = 2_000_000_000


def average_events(
    policy: EventPolicy,
    *,
    seed: int = 0,
    standard_error: float | None = None,
    steps: int | None = None,
    progress: Progress | None = None,
) -> Averages:
    """Estimate cost and rate per second of a policy between the jumps of its plant.

    Args:
        policy: from ``taciturn.design.integral``.
        seed: of the draws.
        standard_error: absolute, of the cost; omitted: 1e-4 of the cost.
        steps: look at about so many pieces of time of all paths together instead.
        progress: called with the fraction done.

    Returns:
        Cost and rate per second; ``steps`` are pieces of time.

    Raises:
        ProblemError: a budget or precision that is not positive.
        UnstableError: an interval that does not end.
    """
    check_effort(seed, standard_error, steps)
    cycles, told, found = FIRST if steps is None else 1000, Stages(progress), None
    while True:
        try:
            found = estimate_cycles(policy.process, policy.trigger, cycles=cycles, seed=seed, alive=told.tick)
        except OutOfTime:
            if found is None:
                raise
            return _averages(policy, found, False)
        missing = _missing(policy, found, standard_error) if steps is None else steps / found.ticks
        if missing <= 1 or cycles >= MOST_CYCLES:
            return _averages(policy, found, steps is not None or missing <= 1)
        told.at = max(told.at, 1 / missing)
        cycles = int(min(cycles * min(1.1 * missing, 64.0), MOST_CYCLES))


def _missing(policy: EventPolicy, found: CycleEstimate, standard_error: float | None) -> float:
    """Return how many times as many cycles are needed."""
    cost = policy.cost_all_time + found.cost.value
    wanted = RELATIVE_ERROR * abs(cost) if standard_error is None else standard_error
    uneven = found.interval.standard_error / found.interval.value
    return max(found.cost.standard_error / wanted, uneven / RELATIVE_INTERVAL) ** 2


def _averages(policy: EventPolicy, found: CycleEstimate, reached: bool) -> Averages:
    trigger, cost = policy.trigger, found.cost.scaled(1.0, policy.cost_all_time)
    if trigger.h_min == 0 and np.isinf(trigger.h_max) and np.isinf(trigger.saturation):  # every interval costs cθ
        cost = Estimate(policy.cost_all_time + trigger.c, 0.0, "exact")
    return Averages(cost, {"sensor": found.interval.inverse()}, found.ticks, 0, reached)
