"""Cost and rate of a policy under a constant disturbance, after a step from zero to one deviation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from taciturn._display import Displayed
from taciturn._progress import Progress, Stages
from taciturn.design.estimation import SEND
from taciturn.design.given import send_every_sample
from taciturn.loop import close
from taciturn.model.estimate import Estimate
from taciturn.model.placement import placed
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Decide, Policy
from taciturn.model.trigger import Form, Trigger
from taciturn.problem import Problem
from taciturn.simulation.average import average
from taciturn.simulation.sampling import Averages
from taciturn.study.measure import Request

ACCURACY = 1e-3  # standard error relative to the cost of sending every sample
NEVER = 1e150  # a cost of silence above that of any packet


@dataclass(frozen=True, repr=False)
class AfterStep(Displayed):
    """Averages of a loop with a constant disturbance, when the transient after the step has decayed.

    Args:
        size: the disturbance at each input.
        cost: cost of the policy.
        cost_all_time: cost of the same control if it sends every sample, under the same disturbance.
        rates: sends per step or per second, by scheduled link.
        settled: whether the transient has decayed within the steps.
    """

    size: tuple[float, ...]
    cost: Estimate
    cost_all_time: Estimate
    rates: Mapping[str, Estimate] = field(hash=False)
    settled: bool = True

    def document(self) -> dict[str, Any]:
        """Return the part of the JSON document of ``taciturn evaluate --json``."""
        costs = {"cost": self.cost, "cost_all_time": self.cost_all_time}
        found: dict[str, Any] = {name: cost.document("value", "standard_error") for name, cost in costs.items()}
        rates = {link: rate.document("value", "standard_error") for link, rate in self.rates.items()}
        return {"size": list(self.size), **found, "rates": rates, "settled": self.settled}

    def text(self, unit: str) -> str:
        """Return the averages as one sentence."""
        size = ", ".join(f"{value:.4g}" for value in self.size)
        rates = ", ".join(f"{rate} sends {unit}" for rate in self.rates.values())
        late = "" if self.settled else "; the transient has not decayed: more steps are required"
        return f"of {size} at the input: cost {self.cost}, with every sample {self.cost_all_time}; {rates}{late}"


def averages_after_step(
    problem: Problem, policy: Policy, request: Request, progress: Progress | None = None
) -> AfterStep | None:
    """Return the averages after a step of the disturbance that the policy assumes, or None if it assumes none.

    Args:
        problem: the problem.
        policy: its policy.
        request: seed and steps; a standard error applies if it is larger than 0.1 % of the cost of every sample.
        progress: callback that receives the fraction done.
    """
    assumed = policy.disturbance
    if assumed is None or assumed.deviation is None:
        return None
    plant, told = problem.actual or problem.plant, Stages(progress)
    if isinstance(plant, Plant) and plant.stated == policy.model.stated:  # a policy without a problem: its own model
        plant = assumed.removed_from(plant)
    plant = assumed.stepped(plant)
    precise = precisely(request, policy)
    found = averages_on(plant, problem, policy, precise, told.stage(0.0, 0.5))
    always = averages_on(plant, problem, _with_every_sample(problem, policy), precise, told.stage(0.5, 1.0))
    size = tuple(float(value) for value in np.atleast_1d(assumed.deviation))
    return AfterStep(size, found.cost, always.cost, found.rates, found.settled and always.settled)


def precisely(request: Request, policy: Policy) -> Request:
    """Return the request with a standard error of 0.1 % of the cost of every sample, unless it wants a larger one."""
    return replace(request, standard_error=max(ACCURACY * policy.cost_all_time, request.standard_error or 0.0))


def averages_on(
    plant: Plant | ContinuousPlant, problem: Problem, policy: Policy, request: Request, progress: Progress | None
) -> Averages:
    """Return the averages of a policy on a plant with another disturbance than that of its design.

    The loop recovers from such a disturbance as slowly as from a fault, so this time constant decides how many steps
    are dropped.
    """
    policy = replace(policy, theory=replace(policy.theory, settling=policy.theory.recovers))
    network = problem.network if policy.network.nodes == problem.network.nodes else policy.network
    loop = close(plant, policy, network.with_intervals(policy.network), problem.cost)
    error = None if request.steps else request.standard_error
    return average(loop, seed=request.seed, standard_error=error, steps=request.steps, progress=progress)


def _with_every_sample(problem: Problem, policy: Policy) -> Policy:
    """Return the same control with a packet at every sample; some rules, such as levels of the output, have none."""
    if problem.controller is None:
        return sends_every_sample(policy)
    period = policy.tick if isinstance(problem.plant, ContinuousPlant) else None
    network, links = problem.network, policy.scheduled
    # over several links, which are ideal, the loop with every sample is that of one link
    sensed = len(links) == 1 and bool(network.nodes[links[0]].measures)
    link = "sensor" if sensed else "actuator"
    always = send_every_sample(policy.kind, problem.plant, problem.cost, period, problem.controller, link)
    return placed(always, network.with_intervals(None)) if len(links) == 1 else always


def sends_every_sample(policy: Policy) -> Policy:
    """Return the policy with triggers that always send, whatever the limits of the intervals between sends."""

    def always(trigger: Trigger) -> Trigger:
        return Trigger({**trigger.options, "silent": Form(constant=NEVER)})

    steps = tuple(
        replace(step, trigger=always(step.trigger)) if isinstance(step, Decide) and step.decision == SEND else step
        for step in policy.steps
    )
    return replace(policy, steps=steps, network=policy.network.with_intervals(None))
