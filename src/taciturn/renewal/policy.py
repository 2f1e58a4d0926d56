"""Policies that are analysed and not run: watched between ticks, or decided by a boundary that is no quadratic."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from taciturn.errors import ProblemError
from taciturn.model.cost import Cost
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy
from taciturn.renewal.events import IntegralTrigger, JumpProcess


@dataclass(frozen=True, eq=False)
class EventPolicy:
    """Both ends predict the state; the sensor sends it when the cost of the prediction's error reaches what is allowed.

    It is analysed as a renewal process. A loop of nodes that exchange packets has ticks: give the policy a period.

    Args:
        kind: name in the catalogue.
        plant: the plant it was designed for.
        cost: the cost it was designed for.
        process: the error between sends.
        trigger: when it is sent.
        cost_all_time: cost per second of a state that is always known, tr(PλW).
        alpha: α, with c = αC; with a standard error where it was computed.
        statement: the theorem in one line, or None.
        source: key in ``docs/sources.bib``.
        notes: what a reader of its numbers must know.

    Raises:
        ProblemError: the plant has what only a simulation uses: limits of the input, or an initial state.
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
        self.refuse(_only_simulated(self.plant))

    def refuse(self, given: Mapping[str, bool]) -> None:
        """Refuse what this policy would ignore, by name, where it is given."""
        _refuse(f"{self.kind} without a period", given, "policy.period")

    def bound(self, interval: float = 0.0) -> float | None:
        """Return what the cost cannot exceed at a mean interval between sends; at 0: at any.

        None where a shortest interval lets the cost of an interval pass what is allowed.
        """
        if self.trigger.h_min > 0:
            return None
        share = min(1.0, self.trigger.saturation / interval) if interval > 0 else 1.0
        return self.cost_all_time + self.trigger.c * share


@dataclass(frozen=True, eq=False)
class OptimalPolicy:
    """The best schedule of an error that a send resets, at a price per send.

    Its boundary is found by quadrature and is no quadratic, so that no node runs it.

    Args:
        kind: name in the catalogue.
        looked_at: a policy of the same nodes, with another trigger: what is known of the loop is read from it.
        price: λ, of a send, in the units of the cost times those of time.

    Raises:
        ProblemError: the plant has what only a simulation uses: limits of the input, or an initial state.
    """

    kind: str
    looked_at: Policy
    price: float

    def __post_init__(self) -> None:
        """Check the plant."""
        self.refuse(_only_simulated(self.looked_at.model))

    def refuse(self, given: Mapping[str, bool]) -> None:
        """Refuse what this policy would ignore, by name, where it is given."""
        _refuse(self.kind, given, "near-optimal")

    @property
    def cost_all_time(self) -> float:
        """Cost of sending at every tick, in the units of the cost."""
        return self.looked_at.cost_all_time


def _only_simulated(plant: Plant | ContinuousPlant) -> Mapping[str, bool]:
    return {
        "plant.input_limit": plant.input_limit is not None,
        "plant.initial.mean": bool(plant.mean.any()),
        "plant.initial.covariance": bool(plant.covariance.any()),
    }


def _refuse(what: str, given: Mapping[str, bool], instead: str) -> None:
    for name in (name for name, is_given in given.items() if is_given):
        raise ProblemError(f"{name} is given, which {what} does not use; expected {instead}, or none")
