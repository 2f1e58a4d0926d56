"""Loops in a simulation, each with the estimator of its cost."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taciturn._arrays import Array
from taciturn._display import Displayed
from taciturn.errors import UnstableError
from taciturn.loop import COST, Loop
from taciturn.program.controls import controlled
from taciturn.program.ir import Program
from taciturn.program.names import Control, Name, Sent

RUNAWAY = 1e12  # a path has diverged if it costs more than this multiple of the median path


@dataclass(frozen=True, eq=False, repr=False)
class Estimator(Displayed):
    """Estimator of a loop's cost: a simulation program, and the relation cost = offset + scale·(mean of a sum).

    Args:
        program: program of one step of the loop.
        whole: the complete program, from which control variates are derived; None for finite-horizon runs.
        sum: name of the sum.
        offset: constant term, in the units of the cost.
        scale: factor of the mean per step.
    """

    program: Program
    whole: Program | None
    sum: str
    offset: float
    scale: float

    @cached_property
    def controlled(self) -> Program | None:
        """The simulation program with control variates as additional sums; None for finite-horizon runs."""
        return None if self.whole is None else controlled(self.whole, self.program)


@dataclass(frozen=True, eq=False, repr=False)
class Part(Displayed):
    """A loop in a simulation, with its cost estimator and the sign with which its cost and rates are added.

    Args:
        loop: the closed loop.
        estimator: estimator of its cost.
        sign: 1, or −1 if cost and rates are subtracted.
    """

    loop: Loop
    estimator: Estimator
    sign: float = 1.0

    @property
    def names(self) -> list[Name]:
        """Names of the simulated sums that are read: the sum of the cost estimator, then the sends on each link."""
        return [self.estimator.sum, *sends(self.loop)]

    @property
    def controls(self) -> list[Control]:
        """Names of the control variates of this loop's cost, whose mean is 0."""
        program = self.estimator.controlled
        return [] if program is None else [name for name in program.sums if isinstance(name, Control)]

    @property
    def settling(self) -> float:
        """Slowest time constant of the loop, in steps."""
        return self.loop.policy.theory.settling

    @property
    def distance(self) -> float:
        """Number of time constants in which a large initial state decays to noise level: ln(1 + |mean|/deviation)."""
        plant = self.loop.problem.plant
        deviation = float(np.sqrt(np.diag(plant.W).max()))
        return float(np.log1p(np.abs(plant.mean).max() / deviation)) if deviation > 0 else 0.0

    def diverges(self, how: str) -> UnstableError:
        """Return the exception for a diverging loop, with the observation that shows the divergence."""
        ranges = ", the range of the payload" if self.loop.network.payload != "float64" else ""
        return UnstableError(
            f"the loop of {self.loop.policy.kind} diverges: {how}; expected a stable loop: send more often, "
            f"or check [plant.actual]{ranges} and input_limit"
        )

    def refuse_runaways(self, costs: Array, ticks: int) -> None:
        """Raise an error if one path has diverged, as is possible for an unstable plant with limited inputs."""
        size = np.sort(np.abs(costs))  # np.median would load all of masked arrays
        largest, typical = float(size[-1]), float(size[len(size) // 2])
        all_time = (self.loop.policy.theory.cost_all_time or 0.0) * self.loop.policy.tick
        if self.estimator.sum == COST and typical > 0 and largest > max(RUNAWAY * typical, ticks * all_time):
            raise self.diverges(f"one path costs {largest / typical:.1g} times as much as the median path")


def sends(loop: Loop) -> list[Sent]:
    """Return the names of a program's sums that count the sends on each link with a send decision."""
    return [Sent(link) for link in loop.policy.scheduled]
