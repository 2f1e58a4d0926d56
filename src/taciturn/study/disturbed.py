"""Cost and rate of a policy under a constant disturbance, after a step from zero to one deviation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from taciturn._display import Displayed
from taciturn.design.certainty import SEND
from taciturn.design.kinds.excess import excess
from taciturn.loop import close
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Decide, Policy
from taciturn.model.trigger import Form, Trigger
from taciturn.problem import Problem
from taciturn.simulation.average import average
from taciturn.simulation.sampling import Averages

ACCURACY = 1e-3  # standard error relative to the cost of sending every sample


@dataclass(frozen=True, repr=False)
class AfterStep(Displayed):
    """Averages of a loop with a constant disturbance, when the transient after the step has decayed.

    Args:
        size: the disturbance at each input.
        cost: cost of the policy.
        cost_all_time: cost of the same control if it sends every sample, under the same disturbance.
        rates: sends per step or per second, by scheduled link.
    """

    size: tuple[float, ...]
    cost: Estimate
    cost_all_time: Estimate
    rates: Mapping[str, Estimate]

    def document(self) -> dict[str, Any]:
        """Return the part of the JSON document of ``taciturn evaluate --json``."""
        costs = {"cost": self.cost, "cost_all_time": self.cost_all_time}
        found: dict[str, Any] = {name: cost.document("value", "standard_error") for name, cost in costs.items()}
        rates = {link: rate.document("value", "standard_error") for link, rate in self.rates.items()}
        return {"size": list(self.size), **found, "rates": rates}

    def text(self, unit: str) -> str:
        """Return the averages as one sentence."""
        size = ", ".join(f"{value:.4g}" for value in self.size)
        rates = ", ".join(f"{rate} sends {unit}" for rate in self.rates.values())
        return f"of {size} at the input: cost {self.cost}, with every sample {self.cost_all_time}; {rates}"


def averages_after_step(problem: Problem, policy: Policy, seed: int) -> AfterStep | None:
    """Return the averages after a step of the disturbance that the policy assumes, or None if it assumes none."""
    assumed = policy.disturbance
    if assumed is None or assumed.deviation is None:
        return None
    plant, cost = problem.actual or problem.plant, problem.cost
    if isinstance(plant, Plant) and plant.states == policy.model.states:  # a policy without a problem: its own model
        plant = assumed.removed_from(plant)
    plant = assumed.stepped(plant)

    def averaged(policy: Policy) -> Averages:
        loop = close(plant, policy, problem.network, cost)
        return average(loop, seed=seed, standard_error=ACCURACY * policy.cost_all_time)

    found, always = averaged(policy), averaged(_with_every_sample(problem, policy))
    size = tuple(float(value) for value in np.atleast_1d(assumed.deviation))
    return AfterStep(size, found.cost, always.cost, found.rates)


def _with_every_sample(problem: Problem, policy: Policy) -> Policy:
    """Return the same controller with a packet at every sample; some rules, such as levels of the output, have none."""
    if problem.controller is None:
        return sends_every_sample(policy)
    period = policy.tick if isinstance(problem.plant, ContinuousPlant) else None
    return sends_every_sample(
        excess(problem.plant, problem.cost, delta=0.0, period=period, controller=problem.controller)
    )


def sends_every_sample(policy: Policy) -> Policy:
    """Return the policy with triggers that always send."""
    always = Trigger({"silent": Form(constant=1.0), SEND: Form()})
    steps = tuple(
        replace(step, trigger=always) if isinstance(step, Decide) and step.decision == SEND else step
        for step in policy.steps
    )
    return replace(policy, steps=steps)
