"""Policies that can be analysed but that no node can run: triggers in continuous time, and the optimal schedule.

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
    """A policy that can be analysed but that no node can run.

    Its subclasses have the name of the ``kind``. ``looked_at`` is a policy with the same nodes and another trigger,
    which supplies the properties of the loop, or None if the policy has no steps in time. If it has one, the policy is
    solved and never simulated.
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
    def why_it_cannot_run(self) -> str:
        """The reason why nodes cannot run the policy, and the remedy."""

    @property
    def called(self) -> str:
        """The kind of the policy in messages about what it does not use."""
        return self.kind

    @abstractmethod
    def measure(self, loop: Any, request: Any, progress: Progress | None) -> Any:
        """Return cost and rates as ``Measured`` for a ``Request`` (``study.measure``), of ``looked_at`` as a loop."""

    def bound(self, interval: float = 0.0) -> float | None:
        """Return an upper bound on the cost for a mean interval between sends; for 0, it holds for all intervals."""
        del interval
        return None

    def bound_error(self, interval: Estimate) -> float:
        """Return the standard error of the bound that is due to the standard error of the mean interval."""
        del interval
        return 0.0

    def short(self) -> str:
        """Return the kind of the policy."""
        return self.kind

    def refuse(self, given: Mapping[str, bool]) -> None:
        """Raise a ``ProblemError`` if an argument is given that this policy does not use."""
        for name in (name for name, is_given in given.items() if is_given):
            raise ProblemError(
                f"{name} is given, which {self.called} does not use; expected {self.instead}, or no {name}"
            )

    def refuse_what_is_only_simulated(self, plant: Plant | ContinuousPlant) -> None:
        """Raise a ``ProblemError`` if a plant has data that only a simulation uses."""
        self.refuse({
            "plant.input_limit": plant.input_limit is not None,
            "plant.input_rate": plant.input_rate is not None,
            "plant.initial.mean": bool(plant.mean.any()),
            "plant.initial.covariance": bool(plant.covariance.any()),
        })  # fmt: skip


def nodes_of(policy: Policy | PolicyWithoutSteps) -> Policy | None:
    """Return the policy whose steps the nodes of a policy have, or None if it has no steps."""
    return policy.looked_at if isinstance(policy, PolicyWithoutSteps) else policy
