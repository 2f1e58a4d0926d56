"""Cost and send rate of policies with continuous-time events, by simulation of the cycles between sends."""

from __future__ import annotations

import numpy as np

from taciturn._progress import OutOfTime, Progress, Stages
from taciturn.model.estimate import Estimate
from taciturn.renewal.cycles import CycleEstimate, estimate_cycles
from taciturn.renewal.policy import EventPolicy
from taciturn.simulation.average import check_effort
from taciturn.simulation.sampling import USUAL_RELATIVE_ERROR, Averages

FIRST = 200_000  # cycles
RELATIVE_INTERVAL = 3e-4  # relative standard error of the mean interval
MOST_SIMULATED_CYCLES = 2_000_000_000


def average_events(
    policy: EventPolicy,
    *,
    seed: int = 0,
    standard_error: float | None = None,
    steps: int | None = None,
    progress: Progress | None = None,
) -> Averages:
    """Estimate cost and send rate per second of a continuous-time policy, for a plant with Poisson jumps.

    Args:
        policy: a policy from ``taciturn.design.integral``.
        seed: seed of the random draws.
        standard_error: absolute standard error of the cost; default: 1e-4 of the cost.
        steps: approximate number of time segments to simulate over all paths, instead of a standard error.
        progress: callback that receives the fraction done.

    Returns:
        Cost and rate per second; ``steps`` counts time segments.

    Raises:
        ProblemError: the budget or the standard error is not positive.
        UnstableError: an interval does not end.
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
        if missing <= 1 or cycles >= MOST_SIMULATED_CYCLES:
            return _averages(policy, found, steps is not None or missing <= 1)
        told.at = max(told.at, 1 / missing)
        cycles = int(min(cycles * min(1.1 * missing, 64.0), MOST_SIMULATED_CYCLES))


def _missing(policy: EventPolicy, found: CycleEstimate, standard_error: float | None) -> float:
    """Return the factor by which the number of cycles must grow."""
    cost = policy.cost_all_time + found.cost.value
    wanted = USUAL_RELATIVE_ERROR * abs(cost) if standard_error is None else standard_error
    uneven = found.interval.standard_error / found.interval.value
    return max(found.cost.standard_error / wanted, uneven / RELATIVE_INTERVAL) ** 2


def _averages(policy: EventPolicy, found: CycleEstimate, reached: bool) -> Averages:
    trigger, cost = policy.trigger, found.cost.scaled(1.0, policy.cost_all_time)
    if trigger.h_min == 0 and np.isinf(trigger.h_max) and np.isinf(trigger.saturation):  # every interval costs cθ
        cost = Estimate(policy.cost_all_time + trigger.c, 0.0, "exact")
    return Averages(cost, {"sensor": found.interval.inverse()}, found.ticks, 0, reached)
