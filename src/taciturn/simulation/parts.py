"""What a simulation runs: loops with the sum of each whose mean gives the cost."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taciturn._arrays import Array
from taciturn.errors import UnstableError
from taciturn.loop import COST, SENT, Loop
from taciturn.program.controls import CONTROL, controlled
from taciturn.program.ir import Program

RUNAWAY = 1e12  # times the cost of the median path


@dataclass(frozen=True, eq=False)
class Estimator:
    """Which program is run, and how the mean of a sum gives the cost: offset + scale·mean.

    Args:
        program: one tick of the loop.
        whole: the same before anything was left out, of which control variates are made; None for missions.
        sum: name of the sum.
        offset: what is added, in the units of the cost.
        scale: factor of the mean per tick.
    """

    program: Program
    whole: Program | None
    sum: str
    offset: float
    scale: float

    @cached_property
    def controlled(self) -> Program | None:
        """The program with control variates among its sums, for long runs; None for missions."""
        return None if self.whole is None else controlled(self.whole, self.program)


@dataclass(frozen=True, eq=False)
class Part:
    """A loop, how its cost is estimated, and the factor with which cost and rates are added up.

    Args:
        loop: the closed loop.
        estimator: of its cost.
        sign: 1, or −1 for what is subtracted.
    """

    loop: Loop
    estimator: Estimator
    sign: float = 1.0

    @property
    def names(self) -> list[str]:
        """The sums that are read: that of the estimator, then the sends on each link."""
        return [self.estimator.sum, *sends(self.loop)]

    @property
    def controls(self) -> list[str]:
        """The sums whose mean is 0."""
        program = self.estimator.controlled
        return [] if program is None else [name for name in program.sums if name.startswith(CONTROL)]

    @property
    def settling(self) -> float:
        """Ticks of the slowest time constant of the loop."""
        return self.loop.policy.settling

    def diverges(self, how: str) -> UnstableError:
        """Return the error that says so."""
        return UnstableError(
            f"the loop of {self.loop.policy.kind} diverges: {how}; expected a stable loop; send more often, "
            "or check [plant.actual] and input_limit"
        )

    def refuse_runaways(self, costs: Array, ticks: int) -> None:
        """Refuse paths that have left the others for good, as a clipped input leaves an unstable plant."""
        size = np.sort(np.abs(costs))  # np.median would load all of masked arrays
        largest, typical = float(size[-1]), float(size[len(size) // 2])
        all_time = self.loop.policy.cost_all_time * self.loop.policy.tick
        if self.estimator.sum == COST and typical > 0 and largest > max(RUNAWAY * typical, ticks * all_time):
            raise self.diverges(f"one path costs {largest / typical:.1g} times as much as another")


def sends(loop: Loop) -> list[str]:
    """Return the sums that count the sends on each link that decides."""
    return [f"{SENT} {link}" for link in loop.policy.scheduled]
