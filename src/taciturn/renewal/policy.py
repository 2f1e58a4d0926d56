"""Policies that can be analysed but not run on nodes: triggers in continuous time, and the optimal schedule."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from taciturn._display import Displayed
from taciturn.errors import ProblemError
from taciturn.model.cost import Cost
from taciturn.model.coverage import ENDING, JUMPS, LIMIT, LINEAR_PLANT, WEIGHTS, Coverage
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.renewal.events import IntegralTrigger, JumpProcess

EVENTS = Coverage(
    LINEAR_PLANT | JUMPS | LIMIT | WEIGHTS | ENDING,
    "policies in continuous time do not model",
    "a linear plant, or a policy with a period",
)


@dataclass(frozen=True, eq=False, repr=False)
class EventPolicy(Displayed):
    """Policy in continuous time: sensor and actuator predict the state, and an integral trigger decides on sends.

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

    def __post_init__(self) -> None:
        """Check the plant."""
        EVENTS.check(self.plant, self.cost)
        self.refuse(_only_simulated(self.plant))

    def summary(self) -> Mapping[str, object]:
        """Return kind, cost, guarantee and trigger of the policy."""
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

    def short(self) -> str:
        """Return the kind of the policy."""
        return self.kind

    def refuse(self, given: Mapping[str, bool]) -> None:
        """Raise an error if an argument is given that this policy does not use."""
        _refuse(f"{self.kind} without a period", given, "policy.period")

    def bound(self, interval: float = 0.0) -> float | None:
        """Return an upper bound on the cost for a given mean interval between sends; for 0, it holds for all intervals.

        The result is None if a shortest interval allows the cost of an interval to exceed the threshold.
        """
        if self.trigger.h_min > 0:
            return None
        share = min(1.0, self.trigger.saturation / interval) if interval > 0 else 1.0
        return self.cost_all_time + self.trigger.c * share

    def bound_error(self, interval: Estimate) -> float:
        """Return the standard error of the bound that is due to the standard error of the mean interval."""
        if self.trigger.h_min > 0 or interval.value <= self.trigger.saturation:
            return 0.0
        return self.trigger.c * self.trigger.saturation / interval.value**2 * interval.standard_error


@dataclass(frozen=True, eq=False, repr=False)
class OptimalPolicy(Displayed):
    """Policy with the optimal send schedule, at a given price per send, of an error that a send resets.

    Its boundary is computed by quadrature and is not a quadratic form, so that no node can run it.

    Args:
        kind: name in the catalogue.
        looked_at: a policy with the same nodes and another trigger, which supplies the properties of the loop.
        price: λ, the price of a send, in units of the cost times units of time.
        instead: the policy kind that approximates this policy on nodes.

    Raises:
        ProblemError: the plant has data that only a simulation uses: limits of the input, or an initial state.
    """

    kind: str
    looked_at: Policy
    price: float
    instead: str

    def __post_init__(self) -> None:
        """Check the plant."""
        self.refuse(_only_simulated(self.looked_at.model))

    def summary(self) -> Mapping[str, object]:
        """Return the policy's kind, its price per send, and the cost of sending every sample."""
        plant = self.looked_at.model.short()
        return {"kind": self.kind, "price": self.price, "cost_all_time": self.cost_all_time, "plant": plant}

    def short(self) -> str:
        """Return the kind of the policy."""
        return self.kind

    def refuse(self, given: Mapping[str, bool]) -> None:
        """Raise an error if an argument is given that this policy does not use."""
        _refuse(self.kind, given, self.instead)

    @property
    def cost_all_time(self) -> float:
        """Cost of sending at every step, in the user's units."""
        return self.looked_at.cost_all_time


def _only_simulated(plant: Plant | ContinuousPlant) -> Mapping[str, bool]:
    return {
        "plant.input_limit": plant.input_limit is not None,
        "plant.input_rate": plant.input_rate is not None,
        "plant.initial.mean": bool(plant.mean.any()),
        "plant.initial.covariance": bool(plant.covariance.any()),
    }


def _refuse(what: str, given: Mapping[str, bool], instead: str) -> None:
    for name in (name for name, is_given in given.items() if is_given):
        raise ProblemError(f"{name} is given, which {what} does not use; expected {instead}, or no {name}")
