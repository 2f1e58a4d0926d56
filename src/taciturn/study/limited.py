"""A loop whose inputs have limits and the loop without limits: how often a limit binds, and cost and bound."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn._progress import Progress
from taciturn.loop import Loop
from taciturn.model.estimate import Estimate
from taciturn.model.policy import Policy
from taciturn.model.saturation import Saturation
from taciturn.problem import Problem
from taciturn.problem.bare import BareKind
from taciturn.program.engine import prepare
from taciturn.program.lower import APPLIED, first_input
from taciturn.program.names import Entry
from taciturn.simulation.reliability import escapes, wanders
from taciturn.study.measure import Request, measure

PATHS, TICKS = 512, 512  # over which the share of steps at a limit is counted, after the transient
FEWEST, NUMBERS = 64, 20_000_000  # paths at least, and most inputs that are recorded with more
CONSTANTS, LONGEST = 12, 4096  # length of the transient in time constants, and its most steps
NEAR = 1e-9  # relative distance at which an input is at its limit: the rounding of set-points


@dataclass(frozen=True, repr=False)
class WithoutLimits(Displayed):
    """The loop without limits of its inputs, compared with the loop that has them.

    Args:
        share: share of the steps in which a limit binds, in the loop with limits; None if it has no average.
        cost: cost of the loop without limits; None for a policy that is given without its problem.
        cost_bound: proven upper bound on this cost, or None.
        rates: sends per step or per second without limits, by scheduled link.
    """

    share: Estimate | None
    cost: Estimate | None
    cost_bound: float | None
    rates: Mapping[str, Estimate] = field(hash=False)

    def document(self) -> dict[str, Any]:
        """Return the parts of the JSON document of ``taciturn evaluate --json``."""
        rates = {link: rate.document("value", "standard_error") for link, rate in self.rates.items()}
        cost = None if self.cost is None else self.cost.document("value", "standard_error")
        free = {"cost": cost, "cost_bound": self.cost_bound, "rates": rates}
        share = None if self.share is None else self.share.document("value", "standard_error")
        return {"share_at_limit": share, "without_limits": free}

    def text(self, unit: str) -> str:
        """Return the comparison as one sentence."""
        bind = "the share of the steps in which a limit binds has no average"
        if self.share is not None:
            bind = f"a limit binds in {self.share.scaled(100)} % of the steps"
        bound = "" if self.cost_bound is None else f", guarantee {self.cost_bound:.6g}"
        if self.cost is None:
            return bind + bound.replace(", ", "; without limits: ", 1)
        rates = ", ".join(f"{rate} sends {unit}" for rate in self.rates.values())
        return f"{bind}; without limits: cost {self.cost}{bound}, {rates}"


def compare_without_limits(
    problem: Problem, loop: Loop, request: Request, pace: float, progress: Progress | None
) -> WithoutLimits | None:
    """Return the comparison of a loop with the same loop without limits, or None if no input has a limit.

    Args:
        problem: the problem.
        loop: its loop.
        request: accuracy of the cost.
        pace: unit of the rates, in steps.
        progress: callback that receives the fraction done.

    Raises:
        OutOfTime: the time limit passed before any answer was available.
    """
    limits = loop.problem.plant.saturation
    if limits is None:
        return None
    # it would be that of the first steps, before the noise or the disturbances have come near the limits
    share = None if escapes(loop) or wanders(loop) else share_at_limits(loop, limits, request.seed)
    if isinstance(problem.own, BareKind):
        bound = loop.policy.guarantee
        return WithoutLimits(share, None, None if bound is None else bound.cost, {})
    actual = None if problem.actual is None else problem.actual.unlimited
    free = replace(problem, plant=problem.plant.unlimited, actual=actual)
    policy = free.designed()
    assert isinstance(policy, Policy)  # the others refuse limits
    other = replace(free.close(policy), precision=loop.precision)
    found, proved = measure(other, request, progress).averages, policy.guarantee if other.nominal else None
    rates = {link: rate.scaled(pace) for link, rate in found.rates.items()}
    return WithoutLimits(share, found.cost, None if proved is None else proved.cost, rates)


def share_at_limits(loop: Loop, limits: Saturation, seed: int) -> Estimate:
    """Return the share of the steps of a loop in which an input, or its change, is at a limit.

    The paths begin at random steps of a timetable, which may last longer than they do, and end with a cycle of the
    policy.
    """
    inputs, horizon, cycle = loop.problem.plant.inputs, loop.horizon, loop.policy.cycle
    burn = 0 if horizon is not None else min(int(CONSTANTS * loop.policy.theory.settling) + 1, LONGEST)
    program = loop.program().keep(outputs={Entry(APPLIED, i) for i in range(inputs)})
    ticks = burn + -(-TICKS // cycle) * cycle if horizon is None else horizon
    paths = max(FEWEST, min(PATHS, NUMBERS // (ticks * inputs)))
    start = loop.start(program, paths, seed, stationary=horizon is None)
    outputs = prepare(program)(start, ticks, None).outputs
    applied = np.stack([outputs[Entry(APPLIED, i)] for i in range(inputs)], axis=-1)
    first = np.broadcast_to(first_input(loop.policy, loop.problem.plant), (1, *applied.shape[1:]))
    at = _at_limits(limits, applied, np.concatenate([first, applied[:-1]]))[burn:].mean(axis=0)
    return Estimate(float(at.mean()), float(at.std(ddof=1) / np.sqrt(paths)), "simulation")


def _at_limits(limits: Saturation, applied: Array, before: Array) -> Array:
    """Return whether an input is at a limit, by step and path, given inputs (steps, paths, inputs)."""
    with np.errstate(invalid="ignore"):
        found = (applied <= limits.low + NEAR * np.abs(limits.low)) | (
            applied >= limits.high - NEAR * np.abs(limits.high)
        )
    if limits.rate is not None:
        found |= np.abs(applied - before) >= limits.rate * (1 - NEAR)
    return np.asarray(found.any(axis=-1), dtype=np.float64)
