"""Exact cost of a given controller with periodic packets, at every q-th step and by the same means as the policy.

Between packets, the receiver keeps its last value or predicts it, as in the policy. The controller may also be
discretised for q steps, if its parameters are continuous, and then measures only when it sends. The cheaper of the two
is the comparison.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from taciturn._display import Displayed
from taciturn.design.base import Attempts, Base, advantage
from taciturn.design.routes import actuator_base
from taciturn.errors import ProblemError, UnstableError
from taciturn.lqg.discrete import Discrete
from taciturn.lqg.periodic import lift
from taciturn.model.controller import Controller
from taciturn.model.kept import Kept
from taciturn.model.plant import Plant

UNSTABLE = "expected fewer steps between packets"


@dataclass(frozen=True, eq=False, repr=False)
class SameControl(Displayed):
    """Function of the steps between packets that returns the exact cost per step, without inter-sample noise cost.

    Args:
        problem: the discrete-time problem.
        kept: the controller, which may depend on the step.
        base: the loop that sends every sample, with the receiver's own value in silence.
    """

    problem: Discrete
    kept: Kept
    base: Base

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
        try:
            return advantage(self.base, UNSTABLE, Attempts(tuple(k == 0 for k in range(steps)))).cost
        except UnstableError:
            return None

    def discretised(self, steps: int) -> float | None:
        """Return the cost of the controller at its discretisation for several steps; None if there is none."""
        problem, plant = self.problem, self.problem.plant
        if isinstance(self.kept, Controller) or steps == 1:
            return None
        long = lift(plant.A, plant.B, problem.Q, problem.R, problem.N, plant.W, steps)
        dt = None if plant.dt is None else plant.dt * steps
        try:
            slow = replace(
                problem,
                plant=Plant(long.A, long.B, long.W, plant.C, plant.V, dt),
                Q=long.Q,
                R=long.R,
                N=long.N,
                exact=None,
                deviations=None,
            )
            base = actuator_base(slow, self.kept.at(dt, plant.inputs, plant.outputs))
            return (advantage(base, UNSTABLE).cost + long.noise_cost) / steps
        except (ProblemError, UnstableError):  # such as a filter that is faster than these steps
            return None
