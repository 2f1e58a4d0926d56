"""Estimate cost and send rate of policies that send at any time, by simulating the intervals between sends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from taciturn.errors import ProblemError
from taciturn.extend import OutOfTime, Progress, Stages
from taciturn.model.cost import Cost
from taciturn.model.coverage import ENDING, JUMPS, LIMIT, LINEAR_PLANT, WEIGHTS, Coverage
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant
from taciturn.model.policy import Policy
from taciturn.renewal.without_steps import PolicyWithoutSteps
from taciturn.simulation.average import check_effort
from taciturn.simulation.sampling import USUAL_RELATIVE_ERROR, Averages
from taciturn.study.measure import Measured, Request
from taciturn_events.cycles import CycleEstimate, estimate_cycles
from taciturn_events.events import IntegralTrigger, JumpProcess

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
    """Estimate the cost and the send rate of a continuous-time policy, both per second, for a plant with Poisson jumps.

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


@dataclass(frozen=True, eq=False, repr=False)
class EventPolicy(PolicyWithoutSteps):
    """Policy in continuous time: sensor and actuator predict the state, and an integral trigger decides when to send.

    The sensor sends the state when the cost of the prediction error since the last send reaches the allowed value. The
    policy is analysed as a renewal process. To run it on nodes that exchange packets, give it a period.

    Args:
        kind: name in the catalogue.
        plant: the plant for which it was designed.
        cost: the cost for which it was designed.
        process: the error between sends.
        trigger: when the state is sent.
        cost_all_time: cost per second if the state is always known, tr(PλW).
        alpha: α, with c = αC; it has a standard error if it was estimated.
        statement: the theorem in one line, or None.
        source: key in ``docs/sources.bib``.
        notes: remarks that are shown with its results.

    Raises:
        ProblemError: the plant has data that only a simulation uses: limits of the input, or an initial state.
    """

    kind: str
    plant: ContinuousPlant
    cost: Cost
    process: JumpProcess
    trigger: IntegralTrigger
    cost_all_time: float
    alpha: Estimate
    statement: str | None
    source: str
    notes: tuple[str, ...] = ()
    instead: str = field(init=False, default="policy.period")
    looked_at: Policy | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        """Check the plant."""
        EVENTS.check(self.plant, self.cost)
        self.refuse_what_is_only_simulated(self.plant)

    def summary(self) -> Mapping[str, object]:
        """Return the policy's kind, its cost, its guarantee, its plant and its trigger, by name."""
        bound = self.bound()
        return {
            "kind": self.kind,
            "cost_all_time": self.cost_all_time,
            "guarantee": None if self.statement is None or bound is None else f"at most {bound:.6g}: {self.statement}",
            "plant": self.plant.short(),
            "alpha": self.alpha,
            "trigger": self.trigger,
            "notes": self.notes,
        }

    @property
    def sends_when(self) -> str:
        """Clause that says when the policy sends a packet."""
        trigger, limits = self.trigger, list[str]()
        limits += [f"at the earliest {trigger.h_min:.3g} s"] if trigger.h_min > 0 else []
        limits += [f"at the latest {trigger.h_max:.3g} s"] if np.isfinite(trigger.h_max) else []
        for_how_long = f", of which {trigger.saturation:.3g} s count" if np.isfinite(trigger.saturation) else ""
        after = f", {' and '.join(limits)} after it" if limits else ""
        return f"when silence has cost {trigger.c:.3g} per second since its last packet{for_how_long}{after}"

    @property
    def called(self) -> str:
        """Name of the policy in error messages about options that it does not support."""
        return f"{self.kind} without a period"

    @property
    def why_it_cannot_run(self) -> str:
        """Reason, with a remedy, why nodes cannot run this policy; error messages quote it."""
        return (
            f"{self.called} is triggered in continuous time and cannot run as a loop of nodes; expected policy.period, "
            "the seconds between checks of the error"
        )

    def measure(self, loop: None, request: Request, progress: Progress | None) -> Measured:
        """Estimate cost and send rate by simulating the intervals between sends."""
        if request.method not in ("auto", "simulation"):
            raise ProblemError(
                f"method is {request.method!r}; expected 'auto' or 'simulation' for the policy {self.kind}"
            )
        found = average_events(
            self, seed=request.seed, standard_error=request.standard_error, steps=request.steps, progress=progress
        )
        return Measured(found, "simulation", "a policy in continuous time is always simulated")

    def bound(self, interval: float = 0.0) -> float | None:
        """Return an upper bound on the cost for a mean interval between sends; 0 gives a bound for every interval.

        The result is None if a shortest interval allows the cost of an interval to exceed the threshold.
        """
        if self.trigger.h_min > 0:
            return None
        share = min(1.0, self.trigger.saturation / interval) if interval > 0 else 1.0
        return self.cost_all_time + self.trigger.c * share

    def bound_error(self, interval: Estimate) -> float:
        """Return the standard error of the cost bound, which follows from the standard error of the mean interval."""
        if self.trigger.h_min > 0 or interval.value <= self.trigger.saturation:
            return 0.0
        return self.trigger.c * self.trigger.saturation / interval.value**2 * interval.standard_error


EVENTS = Coverage(
    LINEAR_PLANT | JUMPS | LIMIT | WEIGHTS | ENDING,
    "policies in continuous time do not model",
    "a linear plant, or a policy with a period",
)
