"""Exact cost of a given controller with periodic packets, at every q-th step and by the same means as the policy.

Between packets, the receiver keeps its last value or predicts it, as in the policy. The controller may also be
discretised for q steps, if its parameters are continuous, and then measures only when it sends. The cheaper of the two
is the comparison.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from taciturn._arrays import Array, block_diagonal, symmetrised
from taciturn._display import Displayed
from taciturn.design.base import Base, advantage, cycle_value, held_steps
from taciturn.design.routes import actuator_base
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.kalman import Filter
from taciturn.lqg.periodic import lift
from taciturn.model.controller import Controller, Kept
from taciturn.model.plant import Plant

UNSTABLE = "expected fewer steps between packets"


@dataclass(frozen=True, eq=False, repr=False)
class SameControl(Displayed):
    """Function of the steps between packets that returns the exact cost per step, without inter-sample noise cost.

    Args:
        problem: the discrete-time problem.
        kept: the controller, which may depend on the step.
        base: the loop that sends every sample.
        filter: the filter whose estimate starts the receiver's prediction; None if the receiver keeps its last value.
    """

    problem: Discrete
    kept: Kept
    base: Base
    filter: Filter | None

    def __call__(self, steps: int) -> float:
        """Return the cost.

        Raises:
            UnstableError: the loop is unstable, for this controller and as it is discretised for these steps.
        """
        found = [cost for cost in (self.at_its_step(steps), self.discretised(steps)) if cost is not None]
        if not found:
            raise UnstableError(f"the controller is unstable with a packet every {steps} steps; {UNSTABLE}")
        return min(found)

    def at_its_step(self, steps: int) -> float | None:
        """Return the cost of the controller that computes at every step; None if the loop is unstable."""
        base, unseen = self.base, 0.0
        n, c = base.Gamma.shape
        noise = block_diagonal(base.noise, np.zeros((c, c)))
        (send, M_send), (silent, M_silent) = held_steps(base)
        if self.filter is not None:  # (ẑ, z̃): the estimate of z, and its prediction from the last packet
            closed, none = base.Phi + base.Gamma @ base.K, np.zeros((n, n))
            used, first = np.vstack([np.eye(n), base.K]), block_diagonal(np.eye(n), base.K)
            send, M_send = np.block([[closed, none], [closed, none]]), block_diagonal(used.T @ base.stage @ used, none)
            silent = np.block([[base.Phi, base.Gamma @ base.K], [none, closed]])
            M_silent = first.T @ base.stage @ first
            gain = np.zeros((n, len(self.filter.innovation)))
            gain[: len(self.filter.gain)] = self.filter.gain
            gain[n - len(self.filter.innovation) :] = np.eye(len(self.filter.innovation))
            noise = block_diagonal(gain @ self.filter.innovation @ gain.T, none)
            unseen = float(np.sum(self.problem.Q * self.filter.posterior))
        parts = [(send, M_send), *[(silent, M_silent)] * (steps - 1)]
        found = _cycle_cost(parts, noise)
        return None if found is None else found + unseen

    def discretised(self, steps: int) -> float | None:
        """Return the cost of the controller at its discretisation for several steps; None if there is none."""
        problem, plant = self.problem, self.problem.plant
        if isinstance(self.kept, Controller) or steps == 1:
            return None
        long = lift(plant.A, plant.B, problem.Q, problem.R, problem.N, plant.W, steps)
        dt = None if plant.dt is None else plant.dt * steps
        try:
            slow = replace(
                problem, plant=Plant(long.A, long.B, long.W, plant.C, plant.V, dt), Q=long.Q, R=long.R, N=long.N
            )
            base = actuator_base(slow, self.kept.at(dt, plant.inputs, plant.outputs))
            return (advantage(base, UNSTABLE).cost + long.noise_cost) / steps
        except (ProblemError, UnstableError):  # such as a filter that is faster than these steps
            return None


def _cycle_cost(parts: list[tuple[Array, Array]], noise: Array) -> float | None:
    """Return the average cost per step of a cycle of linear steps with white noise; None if it is unstable."""
    value, slowest = cycle_value(parts)
    if slowest >= 1:
        return None
    total = 0.0
    for step, stage in reversed(parts):
        total += float(np.sum(value * noise))
        value = symmetrised(stage + step.T @ value @ step)
    return total / len(parts)
