"""Policies that can be analysed, but that nodes cannot run: triggers in continuous time, and the optimal schedule.

Packages that use the library register kinds of such policies. Studies ask a policy through this class, and do not know
which of them it is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from taciturn._display import Displayed
from taciturn._progress import Progress
from taciturn.errors import ProblemError
from taciturn.model.estimate import Estimate
from taciturn.model.plant import ContinuousPlant, Plant
from taciturn.model.policy import Policy


class PolicyWithoutSteps(Displayed, ABC):
    """A policy that can be analysed, although nodes cannot run it.

    ``looked_at`` is a policy with the same nodes and another trigger, from which studies take the properties of the
    loop. It is None if the policy has no steps in time. A policy with ``looked_at`` is solved and never simulated.
    """

    kind: str
    cost_all_time: float  # cost of sending every sample, or of a state that is always known
    instead: str  # the key or the kind that leads to a policy that nodes can run
    looked_at: Policy | None
    statement: str | None  # the theorem in one line
    source: str  # key in ``docs/sources.bib``
    notes: tuple[str, ...]  # remarks that are shown with its results

    @property
    @abstractmethod
    def sends_when(self) -> str:
        """When the policy sends a packet, as a clause of a sentence."""

    @property
    @abstractmethod
    def why_it_cannot_run(self) -> str:
        """Reason why nodes cannot run the policy, and a remedy, as text."""

    @property
    def called(self) -> str:
        """Name of the policy's kind, for messages about options that it does not support."""
        return self.kind

    @abstractmethod
    def measure(self, loop: Any, request: Any, progress: Progress | None) -> Any:
        """Compute cost and rates of the policy with the requested accuracy, from the loop of the policy
        ``looked_at``.
        """

    def bound(self, interval: float = 0.0) -> float | None:
        """Return an upper bound on the cost for a mean interval between sends; for the interval 0, it is valid
        for all.
        """
        del interval
        return None

    def bound_error(self, interval: Estimate) -> float:
        """Return the standard error of the cost bound that follows from the standard error of the mean interval."""
        del interval
        return 0.0

    def short(self) -> str:
        """Return the name of the policy's kind."""
        return self.kind

    def refuse(self, given: Mapping[str, bool]) -> None:
        """Raise ``ProblemError`` if the user has set an option that this policy does not support."""
        for name in (name for name, is_given in given.items() if is_given):
            raise ProblemError(
                f"the option {name} is given, which the policy {self.called} does not use; expected {self.instead}, or "
                f"no {name}"
            )

    def refuse_what_is_only_simulated(self, plant: Plant | ContinuousPlant) -> None:
        """Raise ``ProblemError`` if the plant has a property that only simulations use, such as input limits."""
        self.refuse({
            "plant.input_limit": plant.input_limit is not None,
            "plant.input_rate": plant.input_rate is not None,
            "plant.initial.mean": bool(plant.mean.any()),
            "plant.initial.covariance": bool(plant.covariance.any()),
        })  # fmt: skip


def nodes_of(policy: Policy | PolicyWithoutSteps) -> Policy | None:
    """Return the policy that nodes run instead of the given one; None if there is none."""
    return policy.looked_at if isinstance(policy, PolicyWithoutSteps) else policy
